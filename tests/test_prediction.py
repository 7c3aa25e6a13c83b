"""Accuracy to expect, against the uncertainty of single attitudes."""

from __future__ import annotations

import numpy as np
import pytest

from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.options import Options
from mwdcal.calibration.results import accuracy_at, readings_at
from test_calibrate import PROFILE, make

CIRCLE = np.arange(12) * np.pi / 6


@pytest.mark.parametrize("curved", [(), ("magnetometer",)], ids=["affine", "curved"])
@pytest.mark.parametrize("noise", [False, True])
def test_accuracy_is_the_root_mean_square_over_attitudes(curved, noise):
    options = Options(order=0, nonlinearity=curved)
    calibration = calibrate(make(), PROFILE, options)
    azimuth, toolface = (each.ravel() for each in np.meshgrid(CIRCLE, CIRCLE))
    readings = readings_at(calibration, 0.7, azimuth, toolface)
    for name, sd in accuracy_at(calibration, [0.7], noise).items():
        each = calibration.uncertainty(name, readings, noise)
        assert sd[0] == pytest.approx(np.sqrt(np.mean(each**2)), rel=1e-9)
