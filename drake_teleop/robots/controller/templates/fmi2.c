/* FMI 2.0 for co-simulation. */
#include "fmu.h"

typedef struct {
  void (*logger)(void *, const char *, int, const char *, const char *, ...);
} callbacks;

EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }

EXPORT void *fmi2Instantiate(const char *name, int type, const char *token, const char *resources,
                             const callbacks *functions, int visible, int logging) {
  instance *fmu = type == 1 ? instantiate(token) : NULL;
  (void)resources, (void)visible, (void)logging;
  if (!fmu && functions && functions->logger)
    functions->logger(NULL, name, STATUS_ERROR, "logStatusError", "wrong type or GUID");
  return fmu;
}

EXPORT void fmi2FreeInstance(void *fmu) { free(fmu); }

EXPORT int fmi2Reset(void *fmu) {
  reset(fmu);
  return STATUS_OK;
}

EXPORT int fmi2GetReal(void *fmu, const unsigned *references, size_t count, double *values) {
  return get(fmu, references, count, values);
}

EXPORT int fmi2SetReal(void *fmu, const unsigned *references, size_t count, const double *values) {
  return set(fmu, references, count, values);
}

EXPORT int fmi2GetInteger(void *fmu, const unsigned *references, size_t count, int *values) {
  return get_flags(fmu, references, count, values);
}

EXPORT int fmi2DoStep(void *fmu, double time, double step_size, int no_earlier_state) {
  (void)no_earlier_state;
  return step(fmu, time, step_size);
}

/* Functions without effect, and those of abilities that the FMU does not have. */
#define EMPTY(name) \
  EXPORT int name(void *fmu) { return (void)fmu, STATUS_OK; }
#define NONE(name) \
  EXPORT int name(void *fmu) { return (void)fmu, STATUS_ERROR; }
EMPTY(fmi2SetDebugLogging) EMPTY(fmi2SetupExperiment) EMPTY(fmi2EnterInitializationMode)
EMPTY(fmi2ExitInitializationMode) EMPTY(fmi2Terminate)
NONE(fmi2SetInteger) NONE(fmi2GetBoolean) NONE(fmi2SetBoolean) NONE(fmi2GetString)
NONE(fmi2SetString) NONE(fmi2GetFMUstate) NONE(fmi2SetFMUstate) NONE(fmi2FreeFMUstate)
NONE(fmi2SerializedFMUstateSize) NONE(fmi2SerializeFMUstate) NONE(fmi2DeSerializeFMUstate)
NONE(fmi2GetDirectionalDerivative) NONE(fmi2SetRealInputDerivatives)
NONE(fmi2GetRealOutputDerivatives) NONE(fmi2CancelStep) NONE(fmi2GetStatus)
NONE(fmi2GetRealStatus) NONE(fmi2GetIntegerStatus) NONE(fmi2GetBooleanStatus)
NONE(fmi2GetStringStatus)
