/*
 * Corrects readings by the calibration in mwdcal_double.h, which alone differs from tool to tool.
 * C99, double precision.
 */
#define MWDCAL_DOUBLE_COEFFICIENTS
#include "mwdcal_double.h"

#include <math.h>

#define DEGREES 57.29577951308232
#define NOTHING 1e-12 /* a part of a vector that is no larger share of it has no direction */

static double course(const double powers[MWDCAL_DOUBLE_ORDER + 1], double tau)
{
    double value = powers[MWDCAL_DOUBLE_ORDER];
    int k;
    for (k = MWDCAL_DOUBLE_ORDER - 1; k >= 0; k--)
        value = value * tau + powers[k];
    return value;
}

static void correct(const mwdcal_double_triad *triad, const double raw[3], double tau, double field[3])
{
    double z[3];
    int i, j;
    for (i = 0; i < 3; i++) {
        double x = (raw[triad->channel[i]] / triad->unit[i] - triad->centre[i]) / triad->radius;
        z[i] = x / course(triad->scale[i], tau) - course(triad->bias[i], tau);
    }
    for (i = 0; i < 3; i++) {
        field[i] = course(triad->offset[i], tau) + (triad->square[i] + triad->cube[i] * z[i]) * z[i] * z[i];
        for (j = 0; j < 3; j++)
            field[i] += course(triad->gain[i][j], tau) * z[j];
    }
}

/* The direction of (x, y), 0 to 360 degrees. */
static double direction(double y, double x)
{
    double angle = DEGREES * atan2(y, x);
    if (angle < 0.0)
        angle += 360.0;
    return angle < 360.0 ? angle : 0.0;
}

static unsigned angles(const double g[3], const double b[3], mwdcal_double_result *result)
{
    double across = hypot(g[0], g[1]), gravity = hypot(across, g[2]);
    double magnetic = hypot(b[0], b[1]), field = hypot(magnetic, b[2]);
    double east = (g[0] * b[1] - g[1] * b[0]) * gravity;
    double north = b[2] * across * across - g[2] * (g[0] * b[0] + g[1] * b[1]);
    unsigned status = 0u;
    result->inclination_deg = result->azimuth_deg = 0.0;
    result->toolface_deg = result->magnetic_toolface_deg = 0.0;
    if (magnetic > NOTHING * field)
        result->magnetic_toolface_deg = direction(b[0], b[1]);
    else
        status |= MWDCAL_AXIAL_FIELD;
    if (!(gravity > 0.0))
        return status | MWDCAL_NO_GRAVITY;
    result->inclination_deg = DEGREES * atan2(across, g[2]);
    if (!(across > NOTHING * gravity))
        return status | MWDCAL_VERTICAL;
    result->toolface_deg = direction(-g[0], -g[1]);
    if (!(hypot(east, north) > NOTHING * field * across * gravity))
        return status | MWDCAL_NO_NORTH;
    result->azimuth_deg = direction(east, north);
    return status;
}

unsigned mwdcal_double(
    const double a[3], const double m[3], double temperature_c, mwdcal_double_result *result)
{
    const double *raw[2];
    double vectors[2][3] = {{0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}};
    unsigned status = 0u;
    int t, i;
    raw[0] = a;
    raw[1] = m;
    if (!(temperature_c >= MWDCAL_DOUBLE_LOWEST_C && temperature_c <= MWDCAL_DOUBLE_HIGHEST_C))
        status |= MWDCAL_OUTSIDE_TEMPERATURE;
    for (t = 0; t < MWDCAL_DOUBLE_TRIADS; t++)
        correct(&TRIADS[t], raw[t], temperature_c - MWDCAL_DOUBLE_REFERENCE_C, vectors[t]);
    for (i = 0; i < 3; i++) {
        result->gravity[i] = vectors[0][i];
        result->field[i] = vectors[1][i];
    }
    return status | angles(vectors[0], vectors[1], result);
}
