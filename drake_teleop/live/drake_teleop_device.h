/* The packets of `drake-teleop drive --device udp://...`. Little-endian, IEEE 754, no padding.
 *
 * Base frame B of the device, SI: x towards the operator, z up. Send your state at 1 kHz or so to
 * the port; forces come back to the port that you send from, one for each slice of the station. Hold
 * the last one in between. When none has come for 50 ms the force has to be zero: nobody else can
 * see to that. Limit it, and observe its passivity: device_guard.py says how. */
#ifndef DRAKE_TELEOP_DEVICE_H
#define DRAKE_TELEOP_DEVICE_H
#include <stdint.h>

enum { DT_CLUTCH_OPEN = 1 /* its motion shall not go to the slave */ };

#pragma pack(push, 1)
typedef struct { /* from the device: 88 bytes */
  char magic[4]; /* "DTD1"; the 1 is the version */
  uint32_t flags; /* DT_CLUTCH_OPEN or 0 */
  uint64_t number; /* one more in each packet */
  double t; /* when it was there, on any steady clock [s] */
  double position[3]; /* [m] */
  double orientation[4]; /* w, x, y, z; 1, 0, 0, 0 if it does not turn */
  double behind; /* your clock now less `t` of the force that you display [s]; 0 if there is none */
} dt_device_state;

typedef struct { /* to the device: 72 bytes */
  char magic[4]; /* "DTF1" */
  uint32_t flags; /* 0 */
  uint64_t number; /* of the state that it answers */
  double t; /* likewise */
  double force[3], torque[3]; /* on the hand [N, N m] */
} dt_device_force;
#pragma pack(pop)
#endif
