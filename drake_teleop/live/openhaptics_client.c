/* Example client for `drake-teleop drive --device udp://127.0.0.1:PORT`: a Touch or Phantom by the
 * HDAPI of OpenHaptics 3, on Linux. It was built and tested against stubs of HDAPI, never with a
 * device: hold the stylus loosely and try small forces first (`FORCE`).
 *
 *   cc -O2 openhaptics_client.c -o openhaptics_client -lHD -lm && ./openhaptics_client PORT [FORCE]
 *
 * FORCE limits the force [N]; default: what the device reports as its continuous force. The clutch
 * is open while button 2 is pressed. HDAPI: x right, y up, z towards the operator, mm. Frame B of
 * the packets: x towards the operator, y right, z up, m. The functions of `guard` are those of
 * device_guard.py, without torques. */
#include <HD/hd.h>
#include <arpa/inet.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "drake_teleop_device.h"

#define TIMEOUT_S 0.05
#define FADE_START_S 0.02
#define FORCE_RETURN_N_S 100.0
#define SLEW_N_S 5000.0
#define MAX_ENERGY_J 0.3
#define RESERVE_J 3e-5
#define MAX_DAMPING_NS_M 100.0

typedef struct { /* begin with zeros, and max_force */
  double max_force, stored, limit, force[3], position[3], velocity[3];
  int started, heard;
} guard;

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static void limit_norm(double *a, double longest) {
  double length = sqrt(dot(a, a));
  for (int i = 0; i < 3 && length > longest; i++) a[i] *= longest / length;
}

/* Write the force to display [N] for the last command [N] of this age, after this period [s]. */
static void guard_tick(guard *g, const double *x, const double *command, double age, double period,
                       double *force) {
  double motion[3], next[3], velocity[3], step[3], share = 0.0;
  int fresh = age < TIMEOUT_S, finite = isfinite(command[0] + command[1] + command[2]);
  for (int i = 0; i < 3; i++) {
    motion[i] = g->started ? x[i] - g->position[i] : 0.0;
    velocity[i] = motion[i] / period;
    next[i] = period * (2.0 * velocity[i] - g->velocity[i]);
  }
  g->stored = fmin(g->stored - dot(g->force, motion), MAX_ENERGY_J);
  g->started = 1;
  memcpy(g->position, x, sizeof g->position);
  memcpy(g->velocity, velocity, sizeof g->velocity);

  if (fresh && !g->heard) g->limit = 0.0;
  g->heard = fresh;
  g->limit = fmin(g->limit + FORCE_RETURN_N_S * period, g->max_force);
  if (fresh) share = fmin(fmax((TIMEOUT_S - age) / (TIMEOUT_S - FADE_START_S), 0.0), 1.0);
  for (int i = 0; i < 3; i++) force[i] = finite ? share * command[i] : 0.0;
  limit_norm(force, fmin(g->max_force, g->limit));
  for (int i = 0; i < 3; i++) step[i] = force[i] - g->force[i];
  limit_norm(step, SLEW_N_S * period);
  for (int i = 0; i < 3; i++) force[i] = share > 0.0 ? g->force[i] + step[i] : 0.0;

  double distance = sqrt(dot(next, next)), left = g->stored - RESERVE_J, back = dot(force, next);
  if (dot(force, force) > 0.0 && back > left && distance >= 1e-12) { /* the passivity observer */
    double most = fmax(left / distance, -MAX_DAMPING_NS_M * sqrt(dot(velocity, velocity)));
    double reduction = fmax(back / distance - most, 0.0) / distance;
    for (int i = 0; i < 3; i++) force[i] -= reduction * next[i];
  }
  limit_norm(force, g->max_force);
  memcpy(g->force, force, sizeof g->force);
}

/* Write the quaternion w, x, y, z in B of a transform of HDAPI (column-major). */
static void quaternion_B(const double *T, double *q) {
  static const int axis[3] = {2, 0, 1}; /* of HDAPI for x, y, z of B */
  double R[3][3], trace;
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) R[i][j] = T[axis[i] + 4 * axis[j]];
  trace = R[0][0] + R[1][1] + R[2][2];
  int k = 0;
  for (int i = 1; i < 3; i++)
    if (R[i][i] > R[k][k]) k = i;
  if (trace > R[k][k]) {
    q[0] = 1.0 + trace;
    for (int i = 0; i < 3; i++) q[i + 1] = R[(i + 2) % 3][(i + 1) % 3] - R[(i + 1) % 3][(i + 2) % 3];
  } else {
    int i = (k + 1) % 3, j = (k + 2) % 3;
    q[0] = R[j][i] - R[i][j];
    q[k + 1] = 1.0 + R[k][k] - R[i][i] - R[j][j];
    q[i + 1] = R[i][k] + R[k][i];
    q[j + 1] = R[j][k] + R[k][j];
  }
  double length = sqrt(q[0] * q[0] + dot(q + 1, q + 1));
  for (int i = 0; i < 4; i++) q[i] /= length;
}

static double now_s(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

typedef struct {
  HHD device;
  int socket;
  uint64_t number;
  double last;
  dt_device_force command;
  guard guard;
} client;

static HDCallbackCode HDCALLBACK tick(void *data) {
  client *c = data;
  dt_device_state state = {.magic = {'D', 'T', 'D', '1'}};
  dt_device_force packet;
  double T[16], force[3], now = now_s(), age = HUGE_VAL;
  double period = c->last > 0.0 ? fmin(fmax(now - c->last, 1e-5), 0.1) : 1e-3;
  int buttons = 0;
  c->last = now;
  while (recv(c->socket, &packet, sizeof packet, MSG_DONTWAIT) == (ssize_t)sizeof packet)
    if (!memcmp(packet.magic, "DTF1", 4) && packet.number <= c->number &&
        packet.number >= c->command.number)
      c->command = packet;
  if (c->command.number > 0) age = now - c->command.t;

  hdBeginFrame(c->device);
  hdGetDoublev(HD_CURRENT_TRANSFORM, T);
  hdGetIntegerv(HD_CURRENT_BUTTONS, &buttons);
  for (int i = 0; i < 3; i++) state.position[i] = 1e-3 * T[12 + (i + 2) % 3];
  guard_tick(&c->guard, state.position, c->command.force, age, period, force);
  HDdouble shown[3] = {force[1], force[2], force[0]};
  hdSetDoublev(HD_CURRENT_FORCE, shown);
  hdEndFrame(c->device);
  if (HD_DEVICE_ERROR(hdGetError())) return HD_CALLBACK_DONE; /* HDAPI switches the motors off */

  state.flags = buttons & HD_DEVICE_BUTTON_2 ? DT_CLUTCH_OPEN : 0;
  state.number = ++c->number;
  state.t = now;
  state.behind = age < 1.0 ? age : 0.0;
  quaternion_B(T, state.orientation);
  send(c->socket, &state, sizeof state, MSG_DONTWAIT); /* if it is lost, the next one is newer */
  return HD_CALLBACK_CONTINUE;
}

int main(int count, char **words) {
  static client c;
  struct sockaddr_in station = {.sin_family = AF_INET};
  if (count < 2) {
    fprintf(stderr, "usage: %s PORT [FORCE]\n", words[0]);
    return 2;
  }
  station.sin_port = htons((uint16_t)atoi(words[1]));
  station.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  c.socket = socket(AF_INET, SOCK_DGRAM, 0);
  if (c.socket < 0 || connect(c.socket, (struct sockaddr *)&station, sizeof station)) {
    perror("socket");
    return 1;
  }
  c.device = hdInitDevice(HD_DEFAULT_DEVICE);
  if (HD_DEVICE_ERROR(hdGetError())) {
    fprintf(stderr, "error: no device of OpenHaptics; run its setup and calibration first\n");
    return 1;
  }
  hdGetDoublev(HD_NOMINAL_MAX_CONTINUOUS_FORCE, &c.guard.max_force);
  if (count > 2) c.guard.max_force = fmin(fabs(atof(words[2])), c.guard.max_force);
  hdEnable(HD_FORCE_OUTPUT);
  HDSchedulerHandle handle = hdScheduleAsynchronous(tick, &c, HD_MAX_SCHEDULER_PRIORITY);
  hdStartScheduler();
  printf("forces up to %.2f N; end with Enter\n", c.guard.max_force);
  fflush(stdout);
  getchar();
  hdStopScheduler();
  hdUnschedule(handle);
  hdDisableDevice(c.device);
  close(c.socket);
  return 0;
}
