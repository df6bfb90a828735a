/* Contact wrench of a wrist force/torque sensor: measured wrench minus weight and inertia of the
 * load. C99, no heap, no libc, no global state.
 *
 * Vectors are in the sensor frame S, about its origin, in SI units. Wrenches [f; tau] are those of
 * the sensor on the load: at rest f = -m g. A sensor that reports the wrench of the load on the
 * sensor, as most do, needs the opposite sign at the input.
 */
#ifndef WRENCH_COMPENSATOR_H
#define WRENCH_COMPENSATOR_H

#ifdef __cplusplus
extern "C" {
#endif

/* Flags. The wrench is zero with every flag except CLIPPED. */
enum {
  WRENCH_COMPENSATOR_SATURATED = 1,     /* a channel is at its range */
  WRENCH_COMPENSATOR_NOT_FINITE = 4,    /* NaN or infinity */
  WRENCH_COMPENSATOR_OUT_OF_RANGE = 8,  /* beyond any sensor or motion */
  WRENCH_COMPENSATOR_CLIPPED = 1024,    /* limited to the range of the sensor */
  WRENCH_COMPENSATOR_NO_GRAVITY = 16384 /* gravity is NULL, and the two sigmas differ */
};

/* State of a tare. It changes the offsets only if it is DONE. */
enum {
  WRENCH_COMPENSATOR_TARE_DONE = 0,
  WRENCH_COMPENSATOR_TARE_MOVES = 1,   /* refused: the sensor moves */
  WRENCH_COMPENSATOR_TARE_VARIES = 2,  /* refused: the wrench varies, as in contact */
  WRENCH_COMPENSATOR_TARE_TOO_FAR = 3, /* refused: more than the drift of offsets */
  WRENCH_COMPENSATOR_TARE_RUNS = 4
};

typedef struct {
  double phi[10];         /* [m, m c (3), Ixx, Ixy, Ixz, Iyy, Iyz, Izz] about the origin of S */
  double offsets[6];      /* wrench of the sensor without load [N, N m] */
  double sigma_weight;    /* share of the weight in the scaled wrench */
  double sigma_inertia;   /* share of the inertia in the scaled wrench */
  double gamma;           /* scale of the contact wrench in the scaled wrench */
  double low_pass[7];     /* see wrench_compensator_low_pass */
  int low_pass_count;     /* 7; 0: no low-pass */
  double range[6];        /* range of the sensor [N, N m] */
  double largest[15];     /* largest valid values of wrench and motion */
  double noise_limits[6]; /* largest standard deviation of the wrench in a tare [N, N m] */
  int stale_steps;        /* more invalid readings restart the low-pass */
  int tare_steps;         /* readings of a tare */
} wrench_compensator_settings;

typedef struct {
  wrench_compensator_settings settings; /* can change between two steps */
  double memory[2][12];
  double row[1][21];
  double mean[21], squares[21];
  int invalid_steps, tare_count, tare_state;
} wrench_compensator;

void wrench_compensator_init(wrench_compensator *c, const wrench_compensator_settings *settings);

/* Compensate one reading; return the flags.
 *
 * gravity: g in S [m/s^2]; needed only if sigma_weight differs from sigma_inertia, else NULL.
 * specific_force: a - g of the origin of S: upwards at rest, as an accelerometer measures it.
 * contact: contact wrench. scaled: gamma contact + sigma_weight weight + sigma_inertia inertia.
 */
unsigned wrench_compensator_step(wrench_compensator *c, const double wrench[6],
                                 const double specific_force[3], const double angular_velocity[3],
                                 const double angular_acceleration[3], const double *gravity,
                                 double contact[6], double scaled[6]);

/* Start a tare at rest and without contact: c->tare_state, after tare_steps valid readings. */
void wrench_compensator_tare(wrench_compensator *c);

/* Write a low-pass of second order with half the amplitude at the cut-off frequency.
 *
 * dt: period of the readings [s]. tangent: tan(pi cutoff dt). ahead_s: extrapolation [s], or 0.
 */
void wrench_compensator_low_pass(double dt, double tangent, double ahead_s, double low_pass[7]);

#ifdef __cplusplus
}
#endif

#endif
