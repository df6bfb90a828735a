/* Compare the compiled code with the readings of Python in test_vector.h, bit by bit. */
#include <stdio.h>
#include <string.h>

#include "test_vector.h"

int main(void) {
  static wrench_compensator c;
  double out[12];
  unsigned flags;
  int k, wrong = 0;
  wrench_compensator_init(&c, &test_settings);
  for (k = 0; k < TEST_COUNT; ++k) {
    const double *in = test_inputs[k];
    flags = wrench_compensator_step(&c, in, in + 6, in + 9, in + 12, in + 15, out, out + 6);
    wrong += flags != test_flags[k] || memcmp(out, test_outputs[k], sizeof out) != 0;
  }
  printf("%d of %d readings differ from Python\n", wrong, TEST_COUNT);
  return wrong != 0;
}
