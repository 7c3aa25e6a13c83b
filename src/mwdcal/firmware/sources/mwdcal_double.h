/*
$about
 *
 * Each triad, raw channels in the order and the units of the run file, tau = T - reference temperature:
 *
 *     x[i] = (raw[channel[i]] / unit[i] - centre[i]) / radius
 *     z[i] = x[i] / scale[i](tau) - bias[i](tau)
 *     field[i] = gain[i][0](tau) z[0] + gain[i][1](tau) z[1] + gain[i][2](tau) z[2] + offset[i](tau)
 *                + (square[i] + cube[i] z[i]) z[i] z[i]
 *
 * in tool axes: z along the tool downhole, y the toolface scribe, x to the left of y looking downhole.
 * Gravity points down. The coefficients of scale, bias, gain and offset are by power of tau.
 */
#ifndef MWDCAL_DOUBLE_H
#define MWDCAL_DOUBLE_H

#define MWDCAL_DOUBLE_SERIAL "$serial"
#define MWDCAL_DOUBLE_CALIBRATION "$sha256"

#define MWDCAL_DOUBLE_TRIADS $triads
#define MWDCAL_DOUBLE_ORDER $order
#define MWDCAL_DOUBLE_REFERENCE_C $reference
#define MWDCAL_DOUBLE_LOWEST_C $lowest
#define MWDCAL_DOUBLE_HIGHEST_C $highest

$status

$errors

typedef struct {
    int channel[3];
    double unit[3], centre[3], radius;
    double scale[3][MWDCAL_DOUBLE_ORDER + 1], bias[3][MWDCAL_DOUBLE_ORDER + 1];
    double gain[3][3][MWDCAL_DOUBLE_ORDER + 1], offset[3][MWDCAL_DOUBLE_ORDER + 1];
    double square[3], cube[3];
} mwdcal_double_triad;

typedef struct {
    double gravity[3]; /* g, along the tool axes x, y, z */
    double field[3];   /* $field_unit, along the tool axes x, y, z; 0 without a magnetometer */
    double inclination_deg, azimuth_deg, toolface_deg, magnetic_toolface_deg; /* azimuth from magnetic north */
} mwdcal_double_result;

/*
 * Corrects the raw channels a and m, read at a temperature in degrees C. m is not read where the
 * calibration has no magnetometer. Returns the status; an angle that does not exist is 0.
 */
unsigned mwdcal_double(
    const double a[3], const double m[3], double temperature_c, mwdcal_double_result *result);

#ifdef MWDCAL_DOUBLE_COEFFICIENTS /* mwdcal_double.c alone needs them */
static const mwdcal_double_triad TRIADS[MWDCAL_DOUBLE_TRIADS] = $coefficients;
#endif

#endif
