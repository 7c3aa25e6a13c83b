"""The datasheet of a servo instrument: what tolerances are where a profile states none."""

from __future__ import annotations

import numpy as np

from mwdcal.sensor.profile import Datasheet, Profile

ROOT3 = np.sqrt(3.0)
"""Half the width of a uniform distribution, in its standard deviations."""
SERVO = {
    "accelerometer": Datasheet(
        scale=0.05 / ROOT3, bias=0.010 / ROOT3, misalignment_deg=np.degrees(2e-3) / ROOT3,
        scale_per_c=180e-6 / ROOT3, bias_per_c=100e-6 / ROOT3,
    ),
    "magnetometer": Datasheet(
        scale=0.02 / ROOT3, bias=500.0 / ROOT3, misalignment_deg=np.degrees(4e-3) / ROOT3,
        scale_per_c=100e-6 / ROOT3, bias_per_c=2.0 / ROOT3,
    ),
}  # fmt: skip
"""A servo instrument within the limits of Moosavi's Table 1, 1σ of uniform distributions.

Scale ± 5 %, bias ± 10 mg, axis alignment ± 2 mrad, scale drift ± 180 ppm/°C, bias drift ± 100 µg/°C.
The magnetometer: scale ± 2 %, hard iron ± 1 % of 50 µT, alignment ± 4 mrad.
"""
AGEING = ("turn_on", "bias_walk", "scale_walk")
"""What a tool changes by between calibrations."""
USUAL_AGEING = {
    "accelerometer": Datasheet(turn_on=4e-4, bias_walk=4e-4, scale_walk=5e-4),
    "magnetometer": Datasheet(turn_on=70.0, bias_walk=70.0, scale_walk=1.6e-3),
}
"""What the OWSG error model (Rev 5.1, MWD) allows a sensor between calibrations, 1σ, taken as a year's walk.

ABXY, ABXY, ASXY; MBXY, MBXY, MSXY.
"""


def ageing(profile: Profile, triad: str, name: str) -> float:
    """Turn-on bias or walk in a year of a triad: as its profile states it, else that of `USUAL_AGEING`."""
    sheet, usual = getattr(profile, triad).datasheet, USUAL_AGEING[triad]
    stated = None if sheet is None else getattr(sheet, name)
    return float(getattr(usual, name) if stated is None else stated)


def tolerance(profile: Profile, triad: str, name: str) -> float:
    """A tolerance of a triad, such as "bias_per_c": as its profile states it, else that of `SERVO`."""
    sheet, usual = getattr(profile, triad).datasheet, SERVO[triad]
    stated = None if sheet is None else getattr(sheet, name)
    return float(getattr(usual, name) if stated is None else stated)
