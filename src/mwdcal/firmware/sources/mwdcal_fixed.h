/*
$about
 *
 * Whole numbers of $bits bits. Inputs and outputs are values times a power of two, rounded:
 *
$formats
 *
 * Each triad, raw words in the order of the run file, tau = T - reference temperature:
 *
 *     z[j] = raw[j], or for factors raw[j] / scale[j](tau) - bias[j](tau)
 *     field[i] = gain[i][0](tau) z[0] + gain[i][1](tau) z[1] + gain[i][2](tau) z[2] + offset[i](tau)
 *
 * in tool axes: z along the tool downhole, y the toolface scribe, x to the left of y looking downhole.
 * Gravity points down. The coefficients are by power of tau. Sums and products have 64 bits and saturate.
 */
#ifndef MWDCAL_FIXED_H
#define MWDCAL_FIXED_H

#include <stdint.h>

#define MWDCAL_FIXED_SERIAL "$serial"
#define MWDCAL_FIXED_CALIBRATION "$sha256"

#define MWDCAL_FIXED_BITS $bits
#define MWDCAL_FIXED_TRIADS $triads
#define MWDCAL_FIXED_ORDER $order

/* Powers of two of inputs and outputs. */
$fractions

/* Temperatures as words, and the power of two by which a product with tau shrinks. */
#define MWDCAL_FIXED_REFERENCE $reference
#define MWDCAL_FIXED_LOWEST $lowest
#define MWDCAL_FIXED_HIGHEST $highest
#define MWDCAL_FIXED_TAU $tau

/* Words of gravity and field below which they have no direction: sixteen times their error. */
#define MWDCAL_FIXED_WEAK_GRAVITY $weak_gravity
#define MWDCAL_FIXED_WEAK_FIELD $weak_field

$status

$errors

typedef int${storage}_t mwdcal_word;
typedef uint${storage}_t mwdcal_angle;

typedef struct {
    mwdcal_word scale[3][MWDCAL_FIXED_ORDER + 1], bias[3][MWDCAL_FIXED_ORDER + 1];
    mwdcal_word gain[3][3][MWDCAL_FIXED_ORDER + 1], offset[3][MWDCAL_FIXED_ORDER + 1];
    int factors;  /* whether scale and bias apply */
    int quotient; /* power of two of raw before it is divided by the scale */
    int lift;     /* power of two of the offset in the sum */
    int sum;      /* power of two by which the sum exceeds the result */
} mwdcal_fixed_triad;

typedef struct {
    mwdcal_word gravity[3]; /* along the tool axes x, y, z */
    mwdcal_word field[3];   /* along the tool axes x, y, z; 0 without a magnetometer */
    mwdcal_angle inclination, azimuth, toolface, magnetic_toolface; /* azimuth from magnetic north */
} mwdcal_fixed_result;

/*
 * Corrects the raw words a and m, read at a temperature. m is not read where the calibration has no
 * magnetometer. Outside the temperatures of the calibration the nearest of them counts. Returns the
 * status; an angle that does not exist is 0.
 */
unsigned mwdcal_fixed(
    const mwdcal_word a[3], const mwdcal_word m[3], mwdcal_word temperature, mwdcal_fixed_result *result);

#ifdef MWDCAL_FIXED_COEFFICIENTS /* mwdcal_fixed.c alone needs them */
static const mwdcal_fixed_triad TRIADS[MWDCAL_FIXED_TRIADS] = $coefficients;
#endif

#endif
