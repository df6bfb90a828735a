/* Stub of the part of OpenHaptics' HDAPI that openhaptics_client.c uses, from its public reference
 * guide: names, signatures and meaning; the values of the constants are not the real ones. */
#ifndef HD_H
#define HD_H
#include <pthread.h>
#include <stdio.h>
#include <unistd.h>

typedef unsigned int HHD, HDenum, HDerror, HDCallbackCode, HDSchedulerHandle;
typedef double HDdouble;
typedef unsigned short HDushort;
typedef struct {
  HDerror errorCode;
  int internalErrorCode;
  HHD hHD;
} HDErrorInfo;
#define HDCALLBACK
#define HD_DEFAULT_DEVICE NULL
#define HD_DEVICE_ERROR(error) ((error).errorCode != 0)
enum { HD_CALLBACK_DONE, HD_CALLBACK_CONTINUE };
enum { HD_FORCE_OUTPUT = 1, HD_CURRENT_TRANSFORM, HD_CURRENT_BUTTONS, HD_CURRENT_FORCE,
       HD_NOMINAL_MAX_CONTINUOUS_FORCE, HD_MAX_SCHEDULER_PRIORITY };
enum { HD_DEVICE_BUTTON_1 = 1, HD_DEVICE_BUTTON_2 = 2 };

/* A device at x 10, y 20, z 30 mm, rotated by 90 deg about y (up), with button 2 pressed. Each force
 * is a line on stdout, with the number of frames that are open (1). */
static struct {
  HDCallbackCode (*callback)(void *);
  void *data;
  pthread_t thread;
  int frames, running, enabled;
} stub_;

static inline HHD hdInitDevice(const char *name) { return name == HD_DEFAULT_DEVICE ? 1 : 2; }
static inline void hdDisableDevice(HHD device) { (void)device; }
static inline HDErrorInfo hdGetError(void) { return (HDErrorInfo){0, 0, 1}; }
static inline void hdEnable(HDenum what) { stub_.enabled = what == HD_FORCE_OUTPUT; }
static inline void hdBeginFrame(HHD device) { stub_.frames += (int)device; }
static inline void hdEndFrame(HHD device) { stub_.frames -= (int)device; }
static inline void hdGetDoublev(HDenum what, HDdouble *value) {
  static const HDdouble T[16] = {0, 0, -1, 0, 0, 1, 0, 0, 1, 0, 0, 0, 10, 20, 30, 1};
  if (what == HD_NOMINAL_MAX_CONTINUOUS_FORCE) *value = 0.88;
  for (int i = 0; i < 16 && what == HD_CURRENT_TRANSFORM; i++) value[i] = T[i];
}
static inline void hdGetIntegerv(HDenum what, int *value) {
  if (what == HD_CURRENT_BUTTONS) *value = HD_DEVICE_BUTTON_2;
}
static inline void hdSetDoublev(HDenum what, const HDdouble *value) {
  if (what == HD_CURRENT_FORCE && stub_.enabled)
    printf("force %d %.17g %.17g %.17g\n", stub_.frames, value[0], value[1], value[2]);
  fflush(stdout);
}
static inline HDSchedulerHandle hdScheduleAsynchronous(HDCallbackCode (*callback)(void *),
                                                       void *data, HDushort priority) {
  stub_.callback = callback;
  stub_.data = data;
  return priority;
}
static inline void hdUnschedule(HDSchedulerHandle handle) { (void)handle; }
static void *stub_run(void *none) {
  while (stub_.running && stub_.callback(stub_.data) == HD_CALLBACK_CONTINUE) usleep(1000);
  return none;
}
static inline void hdStartScheduler(void) {
  stub_.running = 1;
  pthread_create(&stub_.thread, NULL, stub_run, NULL);
}
static inline void hdStopScheduler(void) {
  stub_.running = 0;
  pthread_join(stub_.thread, NULL);
}
#endif
