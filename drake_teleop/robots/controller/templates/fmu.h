/* Variables of the FMU; value references are places in `values`. */
#include <stdlib.h>
#include <string.h>

#include "load.h"
#include "token.h"

enum { INPUTS = 0, CONTACT = 18, SCALED = 24, FLAGS = 30, SIGMAS = 31, PHI = 34, OFFSETS = 44 };
enum { TIME = 50, COUNT = 51 };
enum { STATUS_OK = 0, STATUS_ERROR = 3 };

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

typedef struct {
  wrench_compensator c;
  double values[COUNT];
} instance;

static void reset(instance *fmu) {
  const wrench_compensator_settings *s = &wrench_compensator_load;
  memset(fmu, 0, sizeof *fmu);
  wrench_compensator_init(&fmu->c, s);
  fmu->values[SIGMAS] = s->sigma_weight;
  fmu->values[SIGMAS + 1] = s->sigma_inertia;
  fmu->values[SIGMAS + 2] = s->gamma;
  memcpy(fmu->values + PHI, s->phi, sizeof s->phi);
  memcpy(fmu->values + OFFSETS, s->offsets, sizeof s->offsets);
}

static instance *instantiate(const char *token) {
  instance *fmu = token && strcmp(token, TOKEN) == 0 ? malloc(sizeof *fmu) : NULL;
  if (fmu) reset(fmu);
  return fmu;
}

static int get(const instance *fmu, const unsigned *references, size_t count, double *values) {
  size_t i;
  for (i = 0; i < count; ++i) {
    if (references[i] >= COUNT) return STATUS_ERROR;
    values[i] = fmu->values[references[i]];
  }
  return STATUS_OK;
}

static int set(instance *fmu, const unsigned *references, size_t count, const double *values) {
  size_t i;
  for (i = 0; i < count; ++i) {
    const unsigned at = references[i];
    if (at >= TIME || (at >= CONTACT && at <= FLAGS)) return STATUS_ERROR;
    fmu->values[at] = values[i];
  }
  return STATUS_OK;
}

static int get_flags(const instance *fmu, const unsigned *references, size_t count, int *values) {
  size_t i;
  for (i = 0; i < count; ++i) {
    if (references[i] != FLAGS) return STATUS_ERROR;
    values[i] = (int)fmu->values[FLAGS];
  }
  return STATUS_OK;
}

/* One reading; the low-pass is valid for one step size only. */
static int step(instance *fmu, double time, double step_size) {
  const double error = step_size / WRENCH_COMPENSATOR_DT - 1.0;
  double *v = fmu->values;
  wrench_compensator_settings *s = &fmu->c.settings;
  if (!(error < 1e-6 && error > -1e-6)) return STATUS_ERROR;
  s->sigma_weight = v[SIGMAS];
  s->sigma_inertia = v[SIGMAS + 1];
  s->gamma = v[SIGMAS + 2];
  memcpy(s->phi, v + PHI, sizeof s->phi);
  memcpy(s->offsets, v + OFFSETS, sizeof s->offsets);
  v[FLAGS] = wrench_compensator_step(&fmu->c, v, v + 6, v + 9, v + 12, v + 15, v + CONTACT,
                                     v + SCALED);
  v[TIME] = time + step_size;
  return STATUS_OK;
}
