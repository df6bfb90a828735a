/* Feed lines of x (3), command (3), age, period from stdin to the client's guard; print the forces. */
#define main client_main
#include "openhaptics_client.c"
#undef main

int main(void) {
  static guard g = {.max_force = 3.3};
  double v[8], f[3];
  while (scanf("%lf%lf%lf%lf%lf%lf%lf%lf", v, v + 1, v + 2, v + 3, v + 4, v + 5, v + 6, v + 7) == 8) {
    guard_tick(&g, v, v + 3, v[6], v[7], f);
    printf("%.17g %.17g %.17g\n", f[0], f[1], f[2]);
  }
  return 0;
}
