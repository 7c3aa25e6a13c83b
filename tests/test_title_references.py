"""References in the words of laboratories: gravity (m/s²), field (nT) and dip (degrees) of lines beside a table."""

import pytest

from mwdcal.files.formats.title_references import stated_above

STANDARD = 9.80665
# fmt: off
STATED = [
    ([['LOCAL G: 9.81452'], ['LOCAL B: 49812'], ['LOCAL DIP: 69.73']], (9.81452, 49812, 69.73)),
    ([['Earth field per IFR1 02-Mar-2024: 48120 nT @ 62.35 deg dip']], (None, 48120, 62.35)),
    ([['Reference values (NOAA WMM 2020, 35.47N 97.52W, 395 m, 2024-05-21)'],
      ['Total Field', '48120.3', 'nT', '±145'], ['Inclination', '62.3512', 'deg', '±0.21'],
      ['Declination', '3.9', 'deg E', '±0.36']],
     (None, 48120.3, 62.3512)),
    ([["УСП = 981,56 Гал; F = 52,34 мкТл; наклонение 71°12'"]], (9.8156, 52340, 71.2)),
    ([['Сила тяжести 981 560 мГал'], ['Индукция МПЗ 52340 нТл'], ['Магн. накл. 71,20']], (9.8156, 52340, 71.2)),
    ([['Значение g в лаборатории - 9,8156 м/с^2; модуль МПЗ - 0,5234 Э; наклонение МПЗ - 71,2 град.']],
     (9.8156, 52340, 71.2)),
    ([['Gravité locale', '0,99974 g'], ['Champ total', '47210 nT'], ['Plongement', '61,05 °']],
     (9.804100271, 47210, 61.05)),
    ([['Valeur de g au banc : 9,8041 m/s² (incertitude 0,0001)']], (9.8041, None, None)),
    ([['Accelerazione di gravità locale: 9,8039 m/s2'], ['Intensità campo: 47,11 µT'],
      ['Inclinazione del campo: 61,70 gradi']],
     (9.8039, 47110, 61.7)),
    ([['Aceleración gravitatoria local 9,7970 m/s^2; campo total 23,9 µT; inclinación magnética 38,2° '
       'hacia arriba (hemisferio sur)']],
     (9.797, 23900, -38.2)),
    ([['g', 'B', 'dip'], ['m/s²', 'nT', '°'], ['9.8145', '49812', '69.73']], (9.8145, 49812, 69.73)),
    ([['Quantity', 'g', 'F', 'I'], ['Unit', 'm/s²', 'nT', 'deg'], ['Value', 9.8145, 49812, 69.73],
      ['U (k=2)', 0.0001, 60, 0.1]],
     (9.8145, 49812, 69.73)),
    ([['  "gravity_g_ms2": 9.8145,'], ['  "field_nT": 49812,'], ['  "dip_deg": 69.73']], (9.8145, 49812, 69.73)),
    ([['{"site":"ABZ","gravity_ms2":9.8145,"total_field_nT":49812,"dip_deg":69.73}']], (9.8145, 49812, 69.73)),
    ([['LocalGravity=9.8145'], ['LocalField=49812'], ['LocalDip=69.73']], (9.8145, 49812, 69.73)),
    ([['Gravity here 9.8145 m/s2 = 1.00080 g. Mag 49812 nT / 69.73 deg.']], (9.8145, 49812, 69.73)),
    ([['Gravity: 1.00080 g (9.8145 m/s²)']], (9.814495319999999, None, None)),
    ([['g0 = 9.80665 m/s2']], (None, None, None)),
    ([['Field measured by Overhauser GSM-19: 49812 nT']], (None, 49812, None)),
    ([['Mean field during calibration 49812 nT (variometer)']], (None, 49812, None)),
    ([['Gravity measured with Scintrex CG-5: 981452.3 mGal']], (9.814523, None, None)),
    ([['Champ mesuré au magnétomètre à protons : 47210 nT']], (None, 47210, None)),
    ([['Поле измерено протонным магнитометром: 52340 нТл']], (None, 52340, None)),
    ([['质子磁力仪测得总场 54620 nT']], (None, 54620, None)),
    ([['IGRF-13 2024.3 (57.15N, 2.09W): X=17250 Y=-120 Z=46730 F=49812 I=69.73 D=-0.40']], (None, 49812, 69.73)),
    ([['WMM2020 F 49812.4 nT, H 17260.1 nT, Z 46727.5 nT, I 69.73 deg']], (None, 49812.4, 69.73)),
    ([['IGRF: H=17260 nT, Z=46727 nT, F=49812 nT, I=69.73°, D=0.4°W']], (None, 49812, 69.73)),
    ([['Magnetic reference: 49812 nT, 69.73° (total field, dip)']], (None, 49812, 69.73)),
    ([['Field/dip: 49812 nT / 69.73°']], (None, 49812, 69.73)),
    ([['Local gravity 9.814 52 m/s²']], (9.81452, None, None)),
    ([['Gravity field strength 9.8145 N/kg']], (9.8145, None, None)),
    ([['Site', 'Aberdeen'], ['g', '9.8145'], ['F', '49812'], ['I', '69.73']], (9.8145, 49812, 69.73)),
    ([['Mag. ref: 51.230 µT @ 72.9°']], (None, 51230, 72.9)),
    ([['H0 = 0.4962 Oe; dip = 66.9; g = 980.62 cm/s2']], (9.8062, 49620, 66.9)),
    ([['Feldwerte (IGRF, 2024-03): Total 48870 nT / Inkl. 66,41° / Dekl. 4,1°']], (None, 48870, 66.41)),
    ([['Gravity 9.7865 m/sec^2, B 43150 nanotesla']], (9.7865, 43150, None)),
    ([['Operator T = 22.5 °C, RH 45 %, 1013 hPa']], (None, None, None)),
    ([['# Acc 16384 LSB/g, Mag 0.4 LSB/nT']], (None, None, None)),
    ([['sensitivity', '8192 counts per g, 0.5 counts per nT']], (None, None, None)),
    ([['Mag [µT/V] 50'], ['B: 0,25 nT/LSB']], (None, None, None)),
    ([['B: 0.4 LSB/nT, local field 51200 nT']], (None, 51200, None)),
    ([['Mag 24 bit, Acc 16 bit']], (None, None, None)),
    ([['Mag: 65000 counts'], ['Mag 50 µT FS'], ['Mag 30000 Hz']], (None, None, None)),
    ([['Field 0.512']], (None, None, None)),
    ([['Dip angle of table 45°'], ['Field at factory 47900 nT']], (None, None, None)),
    ([['Acc', '1203'], ['Mag', '48213']], (None, None, None)),
    ([['Mag: 48213 nT']], (None, 48213, None)),
    ([['# Acc 16384 LSB/g, Mag 0.4 LSB/nT']], (None, None, None)),
    ([['sensitivity', '8192 counts per g, 0.5 counts per nT']], (None, None, None)),
    ([['Mag [µT/V] 50'], ['B: 0,25 nT/LSB']], (None, None, None)),
    ([['B: 0.4 LSB/nT, local field 51200 nT']], (None, 51200, None)),
    ([['Mag 24 bit, Acc 16 bit']], (None, None, None)),
    ([['Mag: 65000 counts'], ['Mag 50 µT FS'], ['Mag 30000 Hz']], (None, None, None)),
    ([['Field 0.512']], (None, None, None)),
    ([['Acceptance: dG < 3 mg, dB < 300 nT, dDip < 0.3 deg']], (None, None, None)),
    ([['Gravity check at start 1.0008 g, at end 1.0007 g']], (None, None, None)),
    ([['Sampling 50.0 Hz, F = 50 Hz']], (None, None, None)),
    ([['mag sens 50000 nT/V']], (None, None, None)),
    ([['Vibration 9.8 m/s² rms']], (None, None, None)),
    ([['ρ = 1.2; I = 12.5 mA; U = 24.0 V']], (None, None, None)),
    ([['Gtotal mean: 1.0008 g'], ['Btotal mean: 49790 nT']], (None, None, None)),
    ([['BGS: 49812nT/69.73deg; g 9.8145']], (9.8145, 49812, 69.73)),
    ([['Gravity (CRC map)', '9.8145 m/s2'], ['IGRF field on 12/03/2024', '49812 nT'],
      ['IGRF dip on 12/03/2024', '69.73 deg']],
     (9.8145, 49812, 69.73)),
    ([['', 'F / nT', 'I / °', 'g / (m/s²)'], ['Pier 2', '49812', '69.73', '9.8145']], (9.8145, 49812, 69.73)),
    ([['Lokalt magnetfelt: 50,87 µT (fall 72,36°)']], (None, 50870, 72.36)),
    ([['Champ magnétique terrestre au banc (calculé IGRF-13) : 47210 nT, inclinaison 61,05°']], (None, 47210, 61.05)),
    ([['Computed by BGGM: total 49812 nT, dip 69.73°']], (None, 49812, 69.73)),
    ([['Grav:', 9.8145, 'Mag:', 49812, 'Dip:', 69.73]], (9.8145, 49812, 69.73)),
    ([["F", "49812", "nT"], ["I", "69.73", "deg"], ["H", "17258.6", "nT"], ["Z", "46727.1", "nT"]],
     (None, 49812, 69.73)),
]
# fmt: on


@pytest.mark.parametrize(("rows", "stated"), STATED, ids=range(len(STATED)))
def test_references_are_read_as_laboratories_write_them(rows, stated):
    columns = ("ref_gravity_g", "ref_field_nt", "ref_dip_deg")
    gravity, *others = stated
    expected = zip(columns, [gravity and gravity / STANDARD, *others], strict=True)
    found = {c: v for c, v in stated_above(rows).metadata.items() if c in columns}
    assert found == pytest.approx({c: v for c, v in expected if v is not None}, rel=1e-12)
