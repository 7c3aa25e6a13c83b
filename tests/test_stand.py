"""Errors of the stand: found with honest uncertainty, refused where they cannot be told apart."""

import numpy as np
import pytest

from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.errors import FitError, InputError
from mwdcal.geometry.vectors import earth_field, earth_gravity, rotation, tool_from_earth
from mwdcal.sensor.profile import Profile
from simulation import DEG, Tool, plan

NOISE = {"accelerometer": np.array(1e-4), "magnetometer": np.array(15.0)}
ZERO, TILT, TOWARDS = 0.4, 0.2, 70.0


def crooked(count, unknown=(), stations=None):
    """A run on a stand whose azimuth reads 0.4° too much and whose vertical leans 0.2° to 70°."""
    tool = Tool.random(3)
    inc, azi, face = stations or plan()
    turn = TILT * DEG * np.array([-np.sin(TOWARDS * DEG), np.cos(TOWARDS * DEG), 0.0])
    attitude = tool_from_earth(inc, azi - ZERO * DEG, face) @ rotation(turn)
    rng = np.random.default_rng(0)
    raw = []
    for index, earth in enumerate((earth_gravity(1.0), earth_field(tool.field, tool.dip))):
        clean = attitude @ earth @ tool.matrix[index].T + tool.offset[index]
        raw.append(clean + tool.noise[index] * rng.normal(size=(count, len(inc), 3)))
    values = {
        "inclination": inc, "azimuth": azi, "toolface": face,
        "field": np.full(len(inc), tool.field), "dip": np.full(len(inc), tool.dip),
    }  # fmt: skip
    known = {k: v for k, v in values.items() if k not in unknown}
    return attitude, Readings(raw[0], raw[1], known=known, sd=NOISE)


def test_sign_convention_of_tilt():
    """Reference inclination = true inclination + tilt · cos(azimuth - tilt azimuth)."""
    inc, azi, _ = plan((45, 90, 135))
    attitude, _ = crooked(1, stations=plan((45, 90, 135)))
    down = attitude[:, :, 2]
    true = np.arctan2(np.hypot(down[:, 0], down[:, 1]), down[:, 2])
    expected = TILT * np.cos(azi - ZERO * DEG - TOWARDS * DEG)
    np.testing.assert_allclose((inc - true) / DEG, expected, atol=2e-3)


@pytest.mark.parametrize("unknown", [(), ("dip", "field"), ("toolface",)])
def test_stand_errors_are_unbiased_and_their_uncertainty_is_honest(unknown):
    _, data = crooked(200, unknown)
    result = fit(data, Options(estimate=("tilt", "azimuth-zero")))
    assert (result.status == 0).all()
    found = result.state.constants[:, -3:] / DEG
    stated = np.sqrt(np.diagonal(result.analysis.constants, axis1=1, axis2=2))[:, -3:] / DEG
    true = TILT * np.array([-np.sin(TOWARDS * DEG), np.cos(TOWARDS * DEG), ZERO / TILT])
    scale = stated.mean(0)
    order = ZERO * TILT * DEG  # turns of zero and tilt do not commute: their product in degrees
    assert (np.abs(found.mean(0) - true) < 3 * scale / np.sqrt(200) + order).all()
    np.testing.assert_allclose(found.std(0) / scale, 1.0, atol=0.15)
    np.testing.assert_allclose(result.analysis.variance_factor.mean(0), 1.0, atol=0.05)


def test_record_of_stand_errors():
    _, data = crooked(1)
    single = Readings(data.accelerometer[0], data.magnetometer[0], known=data.known, sd=NOISE)
    stand = calibrate(
        single,
        Profile(name="x"),
        Options(
            estimate=(
                "azimuth-zero",
                "tilt",
            )
        ),
    ).stand
    assert stand.azimuth_zero_deg == pytest.approx(ZERO, abs=4 * stand.azimuth_zero_uncertainty_deg)
    assert stand.tilt_deg == pytest.approx(TILT, abs=4 * stand.tilt_uncertainty_deg)
    assert stand.tilt_azimuth_deg == pytest.approx(
        TOWARDS, abs=4 * stand.tilt_azimuth_uncertainty_deg
    )


def test_errors_of_the_stand_that_are_not_asked_for_are_named():
    _, data = crooked(1)
    raw, known = (data.accelerometer[0], data.magnetometer[0]), data.known
    angles = ("inclination", "azimuth", "toolface")
    rough = {name: np.full(48, 0.1 * DEG) for name in angles}
    for sd in (NOISE, {**NOISE, **rough}):
        record = calibrate(Readings(*raw, known=known, sd=sd), Profile(name="x"))
        ids = [finding.id for finding in record.findings]
        assert {"looks-like-azimuth-zero", "looks-like-tilt"} <= set(ids)
        assert record.stand.azimuth_zero_deg is None


def test_toolface_zero_is_never_separable_and_unknown_names_are_listed():
    _, data = crooked(1)
    single = Readings(data.accelerometer[0], data.magnetometer[0], known=data.known, sd=NOISE)
    with pytest.raises(FitError, match="never be told"):
        calibrate(single, Profile(name="x"), Options(estimate=("toolface-zero",)))
    with pytest.raises(InputError, match="azimuth-zero"):
        calibrate(single, Profile(name="x"), Options(estimate=("azimut",)))
    with pytest.raises(InputError, match="joint"):
        calibrate(single, Profile(name="x"), Options("least-squares", estimate=("tilt",)))


def test_not_separable_without_magnetometer():
    _, data = crooked(1)
    lone = Readings(
        data.accelerometer[0], known=data.known, sd={"accelerometer": NOISE["accelerometer"]}
    )
    with pytest.raises(FitError, match="cannot tell"):
        calibrate(lone, Profile(name="x"), Options(estimate=("azimuth-zero",)))
