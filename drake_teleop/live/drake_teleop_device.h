/* The packets of `drake-teleop drive --device udp://...`. Little-endian, IEEE 754, no padding.
 *
 * Base frame B of the device, SI: x towards the operator, z up. Send your state to the port at about
 * 1 kHz. The station returns one force for each slice to the port of the sender. Hold the last force
 * in between. The client must set the force to zero after 50 ms without a packet, limit the force,
 * and observe its passivity, as in device_guard.py. */
#ifndef DRAKE_TELEOP_DEVICE_H
#define DRAKE_TELEOP_DEVICE_H
#include <stdint.h>

enum { DT_CLUTCH_OPEN = 1 /* motion is not transmitted to the slave */ };

#pragma pack(push, 1)
typedef struct { /* from the device: 88 bytes */
  char magic[4]; /* "DTD1"; the 1 is the version */
  uint32_t flags; /* DT_CLUTCH_OPEN or 0 */
  uint64_t number; /* increases by one in each packet */
  double t; /* time of the state, on any steady clock [s] */
  double position[3]; /* [m] */
  double orientation[4]; /* w, x, y, z; 1, 0, 0, 0 without rotation */
  double behind; /* your clock minus `t` of the displayed force [s]; 0 without a force */
} dt_device_state;

typedef struct { /* to the device: 72 bytes */
  char magic[4]; /* "DTF1" */
  uint32_t flags; /* 0 */
  uint64_t number; /* of the answered state */
  double t; /* of the answered state */
  double force[3], torque[3]; /* on the hand [N, N m] */
} dt_device_force;
#pragma pack(pop)
#endif
