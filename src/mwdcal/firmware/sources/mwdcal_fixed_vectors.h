/*
 * Test vectors of mwdcal_fixed.h: words of raw channels and temperature, then what mwdcal apply makes of them.
$about
 */
#ifndef MWDCAL_FIXED_VECTORS_H
#define MWDCAL_FIXED_VECTORS_H

typedef struct {
    mwdcal_word a[3], m[3], temperature;
    unsigned status;
    double gravity[3], field[3];
    double inclination_deg, azimuth_deg, toolface_deg, magnetic_toolface_deg;
} mwdcal_fixed_vector;

static const mwdcal_fixed_vector VECTORS[] = $vectors;

#endif
