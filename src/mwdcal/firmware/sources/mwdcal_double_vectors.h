/*
 * Test vectors of mwdcal_double.h: raw channels and temperature, then what mwdcal apply makes of them.
$about
 */
#ifndef MWDCAL_DOUBLE_VECTORS_H
#define MWDCAL_DOUBLE_VECTORS_H

typedef struct {
    double a[3], m[3], temperature_c;
    unsigned status;
    double gravity[3], field[3];
    double inclination_deg, azimuth_deg, toolface_deg, magnetic_toolface_deg;
} mwdcal_double_vector;

static const mwdcal_double_vector VECTORS[] = $vectors;

#endif
