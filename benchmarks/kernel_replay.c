/* Replays readings of a file (18 doubles each) into a file (12 doubles and the flags each). */
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "load.h"

int main(int count, char **arguments) {
  static wrench_compensator c;
  wrench_compensator_settings settings = wrench_compensator_load;
  long size, readings, k;
  double *in, *out;
  clock_t start;
  FILE *file = fopen(arguments[1], "rb");
  if (count != 6 || !file) return 2;
  fseek(file, 0, SEEK_END);
  size = ftell(file);
  rewind(file);
  readings = size / (18 * (long)sizeof *in);
  in = malloc(size);
  out = calloc(readings, 13 * sizeof *out);
  if (fread(in, 1, size, file) != (size_t)size) return 2;
  settings.sigma_weight = atof(arguments[3]);
  settings.sigma_inertia = atof(arguments[4]);
  settings.gamma = atof(arguments[5]);
  wrench_compensator_init(&c, &settings);
  start = clock();
  for (k = 0; k < readings; ++k) {
    const double *x = in + 18 * k;
    double *y = out + 13 * k;
    y[12] = wrench_compensator_step(&c, x, x + 6, x + 9, x + 12, x + 15, y, y + 6);
  }
  printf("%g\n", 1e9 * (clock() - start) / CLOCKS_PER_SEC / readings);
  file = fopen(arguments[2], "wb");
  return fwrite(out, 13 * sizeof *out, readings, file) != (size_t)readings;
}
