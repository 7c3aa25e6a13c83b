/*
 * Meets the test vectors, each within the stated error: ends with 0 if all are met.
 *
 *     cc -std=c99 mwdcal_fixed.c mwdcal_fixed_test.c -lm -o mwdcal_fixed_test && ./mwdcal_fixed_test
 */
#include "mwdcal_fixed.h"
#include "mwdcal_fixed_vectors.h"

#include <math.h>
#include <stdio.h>

/* Whether a value is off by more than its error. */
static int off(int vector, const char *name, double value, double expected, double error)
{
    if (fabs(value - expected) <= error)
        return 0;
    printf("vector %d, %s: %.12g, expected %.12g\n", vector + 1, name, value, expected);
    return 1;
}

/* The same of an angle, whose difference counts by the share of the vector that it is read from. */
static int turned(int vector, const char *name, double angle, double expected, double share, double error)
{
    double difference = remainder(angle - expected, 360.0);
    return off(vector, name, expected + difference * share, expected, error);
}

static double degrees(mwdcal_angle angle)
{
    return ldexp(360.0 * (double)angle, -MWDCAL_FIXED_BITS);
}

static int failures(int i, const mwdcal_fixed_vector *v)
{
    mwdcal_fixed_result r;
    double across = hypot(v->gravity[0], v->gravity[1]) / hypot(hypot(v->gravity[0], v->gravity[1]), v->gravity[2]);
    unsigned status = mwdcal_fixed(v->a, v->m, v->temperature, &r);
    int bad = off(i, "status", (double)status, (double)v->status, 0.0), k;
    for (k = 0; k < 3; k++) {
        bad += off(i, "gravity", ldexp(r.gravity[k], -MWDCAL_FIXED_GRAVITY_FRACTION), v->gravity[k], MWDCAL_FIXED_ERROR_GRAVITY);
        bad += off(i, "field", ldexp(r.field[k], -MWDCAL_FIXED_FIELD_FRACTION), v->field[k], MWDCAL_FIXED_ERROR_FIELD);
    }
    bad += off(i, "inclination", degrees(r.inclination), v->inclination_deg, MWDCAL_FIXED_ERROR_INCLINATION);
    if (!(status & MWDCAL_VERTICAL))
        bad += turned(i, "toolface", degrees(r.toolface), v->toolface_deg, across, MWDCAL_FIXED_ERROR_TOOLFACE);
    if (!(status & (MWDCAL_VERTICAL | MWDCAL_NO_NORTH)))
        bad += turned(i, "azimuth", degrees(r.azimuth), v->azimuth_deg, across, MWDCAL_FIXED_ERROR_AZIMUTH);
    if (!(status & MWDCAL_AXIAL_FIELD)) {
        double level = hypot(v->field[0], v->field[1]), share = level / hypot(level, v->field[2]);
        bad += turned(i, "magnetic toolface", degrees(r.magnetic_toolface), v->magnetic_toolface_deg, share,
                      MWDCAL_FIXED_ERROR_MAGNETIC_TOOLFACE);
    }
    return bad;
}

int main(void)
{
    int count = (int)(sizeof VECTORS / sizeof VECTORS[0]), bad = 0, i;
    for (i = 0; i < count; i++)
        bad += failures(i, &VECTORS[i]);
    printf("%d vectors, %d values off\n", count, bad);
    return bad != 0;
}
