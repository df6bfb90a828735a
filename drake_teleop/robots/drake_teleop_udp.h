/* The packets of `drake-teleop compensate udp://...` and `posed://...`. Little-endian, IEEE 754, no padding.
 *
 * Frame S of the sensor, SI: N, N m, m/s^2, rad/s, rad/s^2. Sign: wrench of the sensor on the load;
 * most sensors report the opposite. Specific force is acceleration minus gravity, of the origin of S:
 * at rest, 9.81 m/s^2 upwards. */
#ifndef DRAKE_TELEOP_UDP_H
#define DRAKE_TELEOP_UDP_H
#include <stdint.h>

enum {
  DT_SATURATED = 1, DT_DAMAGED = 2, DT_NOT_FINITE = 4, DT_OUT_OF_RANGE = 8, DT_REORDERED = 16,
  DT_STALE = 32, DT_CLOCK_JUMP = 64, DT_RESTART = 128, DT_GAP = 256,
  DT_WRONG_RATE = 512, DT_CLIPPED = 1024, /* from this flag on the wrench is not zero */
  DT_IN_CONTACT = 2048, DT_OTHER_LOAD = 4096
};

#pragma pack(push, 1)
typedef struct { /* to drake-teleop: 144 bytes */
  char magic[4]; /* "DTW1" */
  uint32_t flags; /* DT_SATURATED or 0 */
  uint64_t number; /* increases by one in each packet */
  double t; /* time of the measurement, on any steady clock [s] */
  double wrench[6]; /* force, torque */
  double specific_force[3], angular_velocity[3], angular_acceleration[3];
} dt_reading;

/* posed://: the pose of any frame on the wrist, in a frame with z upwards. The wrench is inverted,
 * unless the address ends in ?sign=1. */
typedef struct { /* to drake-teleop: 128 bytes */
  char magic[4]; /* "DTP1" */
  uint32_t flags; /* DT_SATURATED or 0 */
  uint64_t number;
  double t;
  double wrench[6];
  double quaternion[4]; /* w x y z */
  double position[3]; /* m */
} dt_posed;

typedef struct { /* from drake-teleop: 120 bytes */
  char magic[4]; /* "DTC1" */
  uint32_t flags;
  uint64_t number; /* of the reading */
  double t; /* of the reading */
  double contact[6]; /* without the load */
  double scaled[6]; /* gamma contact + sigma load */
} dt_wrench;
#pragma pack(pop)
#endif
