/*
 * Meets the test vectors, each within the stated error: ends with 0 if all are met.
 *
 *     cc -std=c99 mwdcal_double.c mwdcal_double_test.c -lm -o mwdcal_double_test && ./mwdcal_double_test
 */
#include "mwdcal_double.h"
#include "mwdcal_double_vectors.h"

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

static int failures(int i, const mwdcal_double_vector *v)
{
    mwdcal_double_result r;
    double across = hypot(v->gravity[0], v->gravity[1]) / hypot(hypot(v->gravity[0], v->gravity[1]), v->gravity[2]);
    unsigned status = mwdcal_double(v->a, v->m, v->temperature_c, &r);
    int bad = off(i, "status", (double)status, (double)v->status, 0.0), k;
    for (k = 0; k < 3; k++) {
        bad += off(i, "gravity", r.gravity[k], v->gravity[k], MWDCAL_DOUBLE_ERROR_GRAVITY);
        bad += off(i, "field", r.field[k], v->field[k], MWDCAL_DOUBLE_ERROR_FIELD);
    }
    bad += off(i, "inclination", r.inclination_deg, v->inclination_deg, MWDCAL_DOUBLE_ERROR_INCLINATION);
    if (!(status & MWDCAL_VERTICAL))
        bad += turned(i, "toolface", r.toolface_deg, v->toolface_deg, across, MWDCAL_DOUBLE_ERROR_TOOLFACE);
    if (!(status & (MWDCAL_VERTICAL | MWDCAL_NO_NORTH)))
        bad += turned(i, "azimuth", r.azimuth_deg, v->azimuth_deg, across, MWDCAL_DOUBLE_ERROR_AZIMUTH);
    if (!(status & MWDCAL_AXIAL_FIELD)) {
        double level = hypot(v->field[0], v->field[1]), share = level / hypot(level, v->field[2]);
        bad += turned(i, "magnetic toolface", r.magnetic_toolface_deg, v->magnetic_toolface_deg, share,
                      MWDCAL_DOUBLE_ERROR_MAGNETIC_TOOLFACE);
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
