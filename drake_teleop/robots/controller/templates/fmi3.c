/* FMI 3.0 for co-simulation. */
#include "fmu.h"

#include <stdbool.h>

typedef void (*logger)(void *, int, const char *, const char *);

EXPORT const char *fmi3GetVersion(void) { return "3.0"; }

EXPORT void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources,
                                         bool visible, bool logging, bool events, bool early,
                                         const unsigned *references, size_t count,
                                         void *environment, logger log, void *update) {
  instance *fmu = instantiate(token);
  (void)name, (void)resources, (void)visible, (void)logging, (void)events, (void)early;
  (void)references, (void)count, (void)update;
  if (!fmu && log) log(environment, STATUS_ERROR, "logStatusError", "wrong instantiation token");
  return fmu;
}

EXPORT void *fmi3InstantiateModelExchange(void) { return NULL; }
EXPORT void *fmi3InstantiateScheduledExecution(void) { return NULL; }
EXPORT void fmi3FreeInstance(void *fmu) { free(fmu); }

EXPORT int fmi3Reset(void *fmu) {
  reset(fmu);
  return STATUS_OK;
}

EXPORT int fmi3GetFloat64(void *fmu, const unsigned *references, size_t count, double *values,
                          size_t size) {
  return size == count ? get(fmu, references, count, values) : STATUS_ERROR;
}

EXPORT int fmi3SetFloat64(void *fmu, const unsigned *references, size_t count,
                          const double *values, size_t size) {
  return size == count ? set(fmu, references, count, values) : STATUS_ERROR;
}

EXPORT int fmi3GetInt32(void *fmu, const unsigned *references, size_t count, int *values,
                        size_t size) {
  return size == count ? get_flags(fmu, references, count, values) : STATUS_ERROR;
}

EXPORT int fmi3DoStep(void *fmu, double time, double step_size, bool no_earlier_state,
                      bool *event_needed, bool *terminate, bool *early_return, double *last_time) {
  const int status = step(fmu, time, step_size);
  (void)no_earlier_state;
  *event_needed = *terminate = *early_return = false;
  *last_time = status == STATUS_OK ? time + step_size : time;
  return status;
}

/* Functions without effect, and those of abilities that the FMU does not have. */
#define EMPTY(name) \
  EXPORT int name(void *fmu) { return (void)fmu, STATUS_OK; }
#define NONE(name) \
  EXPORT int name(void *fmu) { return (void)fmu, STATUS_ERROR; }
EMPTY(fmi3SetDebugLogging) EMPTY(fmi3EnterInitializationMode) EMPTY(fmi3ExitInitializationMode)
EMPTY(fmi3Terminate) EMPTY(fmi3EnterConfigurationMode) EMPTY(fmi3ExitConfigurationMode)
NONE(fmi3GetFloat32) NONE(fmi3SetFloat32) NONE(fmi3GetInt8) NONE(fmi3SetInt8) NONE(fmi3GetUInt8)
NONE(fmi3SetUInt8) NONE(fmi3GetInt16) NONE(fmi3SetInt16) NONE(fmi3GetUInt16) NONE(fmi3SetUInt16)
NONE(fmi3SetInt32) NONE(fmi3GetUInt32) NONE(fmi3SetUInt32) NONE(fmi3GetInt64) NONE(fmi3SetInt64)
NONE(fmi3GetUInt64) NONE(fmi3SetUInt64) NONE(fmi3GetBoolean) NONE(fmi3SetBoolean)
NONE(fmi3GetString) NONE(fmi3SetString) NONE(fmi3GetBinary) NONE(fmi3SetBinary)
NONE(fmi3GetClock) NONE(fmi3SetClock) NONE(fmi3GetNumberOfVariableDependencies)
NONE(fmi3GetVariableDependencies) NONE(fmi3GetFMUState) NONE(fmi3SetFMUState)
NONE(fmi3FreeFMUState) NONE(fmi3SerializedFMUStateSize) NONE(fmi3SerializeFMUState)
NONE(fmi3DeserializeFMUState) NONE(fmi3GetDirectionalDerivative) NONE(fmi3GetAdjointDerivative)
NONE(fmi3EnterEventMode) NONE(fmi3EnterStepMode) NONE(fmi3GetIntervalDecimal)
NONE(fmi3GetIntervalFraction) NONE(fmi3GetShiftDecimal) NONE(fmi3GetShiftFraction)
NONE(fmi3SetIntervalDecimal) NONE(fmi3SetIntervalFraction) NONE(fmi3SetShiftDecimal)
NONE(fmi3SetShiftFraction) NONE(fmi3EvaluateDiscreteStates) NONE(fmi3UpdateDiscreteStates)
NONE(fmi3EnterContinuousTimeMode) NONE(fmi3CompletedIntegratorStep) NONE(fmi3SetTime)
NONE(fmi3SetContinuousStates) NONE(fmi3GetContinuousStateDerivatives)
NONE(fmi3GetEventIndicators) NONE(fmi3GetContinuousStates)
NONE(fmi3GetNominalsOfContinuousStates) NONE(fmi3GetNumberOfEventIndicators)
NONE(fmi3GetNumberOfContinuousStates) NONE(fmi3GetOutputDerivatives)
NONE(fmi3ActivateModelPartition)
