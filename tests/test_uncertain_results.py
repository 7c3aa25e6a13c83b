"""Corrected readings: angles without a value, standard uncertainties beside the values, axes that are swapped."""

from dataclasses import replace

import numpy as np
import pytest

import mwdcal
from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.files import profiles
from mwdcal.files.formats import table
from mwdcal.geometry.observables import OUTPUTS, UNCERTAINTIES
from mwdcal.planning.plans import grid, run, servo
from mwdcal.sensor.profile import Profile, TriadProfile
from mwdcal.use import correction
from mwdcal.use.uncertainty import with_uncertainty
from simulation import DEG, Tool, attitude, plan

NOISE = {"accelerometer": np.array(1e-4), "magnetometer": np.array(15.0)}
TOOL = Tool.random(7)
PROFILE = Profile(
    name="test", accelerometer=TriadProfile(scale=1.0), magnetometer=TriadProfile(scale=1.0)
)
SD = dict(zip(OUTPUTS.values(), UNCERTAINTIES, strict=True))


@pytest.fixture(scope="module")
def cal():
    inc, azi, face = plan()
    a, m = TOOL.readings(np.random.default_rng(0), 1, inc, azi, face)
    known = {"inclination": inc, "azimuth": azi, "toolface": face}
    known |= {"field": np.full(48, TOOL.field), "dip": np.full(48, TOOL.dip)}
    return calibrate(Readings(a[0], m[0], np.full(48, 25.0), known, NOISE), PROFILE)


def shot(inc, azi, face, seed=0, dip=65.0, noise=1.0, temperature=25.0):
    """Readings of the tool at attitudes in degrees."""
    inc, azi, face = np.broadcast_arrays(inc, azi, face)
    g, b = attitude(inc * DEG, azi * DEG, face * DEG)(1.0, TOOL.field, dip * DEG)
    rng = np.random.default_rng(seed)
    raw = [v @ TOOL.matrix[t].T + TOOL.offset[t] for t, v in enumerate((g, b))]
    raw = [v + noise * s * rng.normal(size=v.shape) for v, s in zip(raw, TOOL.noise, strict=True)]
    return Readings(*raw, np.full(inc.shape, temperature))


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("tilt", [1e-4, 179.9999])
def test_azimuth_and_toolface_of_a_vertical_tool_are_blank_and_the_others_are_not(
    cal, tilt, stated
):
    readings = shot(np.array([tilt, 0.5, 45.0]), 30.0, 200.0, noise=0.0)
    columns, findings = correction.correct(cal, readings, uncertainty=stated)
    for name in ("azimuth_deg", "toolface_deg"):
        np.testing.assert_array_equal(np.isnan(columns[name]), [True, False, False])
    for name in ("inclination_deg", "gravity_g", "field_nt", "dip_deg", "magnetic_toolface_deg"):
        assert np.isfinite(columns[name]).all()
    assert [f.id for f in findings] == ["no-serial", "without-value"]
    assert "in 1 of 3 rows" in findings[1].text
    assert (SD["azimuth_deg"] in columns) == stated


@pytest.mark.parametrize("stated", [True, False])
def test_azimuth_of_a_vertical_field_is_blank_and_toolface_is_not(cal, stated):
    readings = shot(np.array([45.0, 45.0]), 30.0, 200.0, dip=np.array([89.999, 80.0]), noise=0.0)
    columns, _ = correction.correct(cal, readings, uncertainty=stated)
    np.testing.assert_array_equal(np.isnan(columns["azimuth_deg"]), [True, False])
    assert np.isfinite([columns["toolface_deg"], columns["magnetic_toolface_deg"]]).all()


def test_the_rule_is_the_same_with_and_without_uncertainties(cal):
    """Tilts of 0 to 2°, of which those below three of their σ are blank."""
    readings = shot(np.linspace(0.0, 2.0, 400), 77.0, 10.0)
    with_sd, without = (correction.correct(cal, readings, uncertainty=u)[0] for u in (True, False))
    for name in OUTPUTS.values():
        np.testing.assert_array_equal(with_sd[name], without[name])
    face, sd = with_sd["toolface_deg"], with_sd["sd_toolface_deg"]
    np.testing.assert_array_equal(np.isnan(face), np.isnan(sd))
    assert np.nanmax(sd) <= np.degrees(1 / 3)
    across = cal.uncertainty("inclination", shot(0.5, 77.0, np.arange(2) * 90.0), noise=True)
    tilt = with_sd["inclination_deg"] * DEG / across.max()
    assert tilt[np.isnan(face)].max() < 3.5
    assert tilt[np.isfinite(face)].min() > 2.5


def test_uncertainties_are_those_of_calibration_and_noise(cal):
    readings = shot(
        np.array([20.0, 70, 110]), np.array([10.0, 130, 260]), np.array([40.0, 200, 350])
    )
    columns = mwdcal.apply(cal, readings).columns
    for name, column in OUTPUTS.items():
        factor = 1.0 if name in ("gravity", "field") else 1 / DEG
        expected = factor * cal.uncertainty(name, readings, noise=True)
        np.testing.assert_allclose(columns[SD[column]], expected, rtol=1e-9)
    louder = replace(readings, sd={"accelerometer": np.array(1e-2)})
    assert (correction.correct(cal, louder)[0]["sd_gravity_g"] > 0.009).all()


@pytest.mark.parametrize("model", ["polynomial", "factors"])
@pytest.mark.parametrize("order", [0, 1, 3])
def test_uncertainties_of_all_models_are_those_of_each_row(model, order):
    profile, _ = profiles.load_profile("servo")
    rng = np.random.default_rng(order)
    stations = grid([5, 45, 90, 135], 8, [0, 90, 180, 270], [-10.0, 30.0, 75.0, 120.0])
    made = calibrate(run(servo(rng), stations, rng), profile, Options(model=model, order=order))
    g, b = rng.normal(size=(2, 50, 40, 3))
    noise = {"accelerometer": rng.uniform(1e-5, 1e-3, (50, 40, 3)), "magnetometer": np.array(9.0)}
    readings = Readings(g, 4e4 * b, rng.uniform(-12, 122, (50, 40)), sd=noise)
    columns = correction.reference(made, readings)
    stated, _ = with_uncertainty(made, readings, columns, True)
    for name, column in OUTPUTS.items():
        factor = 1.0 if name in ("gravity", "field") else 1 / DEG
        expected = factor * made.uncertainty(name, readings, noise=True)
        expected[np.isnan(stated[column])] = np.nan  # near vertical
        np.testing.assert_allclose(stated[SD[column]], expected, rtol=1e-9)
        assert np.isfinite(expected).mean() > 0.9


def test_nothing_is_stated_outside_the_calibrated_temperatures(cal):
    hot = shot(np.array([20.0, 70, 110]), 30.0, 40.0, temperature=80.0)
    for name in ("inclination", "azimuth", "toolface", "gravity", "field", "dip"):
        assert np.isnan(cal.uncertainty(name, hot)).all()
        assert np.isnan(cal.expanded_uncertainty(name, hot)).all()
        assert np.isfinite(cal.uncertainty(name, replace(hot, temperature=np.full(3, 26.0)))).all()
    columns, _ = correction.correct(cal, hot, "extrapolate")
    assert np.isfinite(columns["azimuth_deg"]).all()
    assert np.isnan(columns["sd_azimuth_deg"]).all()


def attitudes(count, seed=1):
    rng = np.random.default_rng(seed)
    return rng.uniform(20, 100, count), rng.uniform(0, 360, count), rng.uniform(0, 360, count)


SWAPPED = {"x and y": [1, 0, 2], "y and z": [0, 2, 1], "x and z": [2, 1, 0]}


@pytest.mark.parametrize("count", [6, 40, 3000])
@pytest.mark.parametrize("order", SWAPPED.values(), ids=SWAPPED)
def test_swapped_axes_are_named(cal, count, order):
    right = shot(*attitudes(count))
    wrong = replace(right, magnetometer=right.magnetometer[:, order])
    assert "unsteady" not in [f.id for f in correction.correct(cal, right)[1]]
    [text] = [f.text for f in correction.correct(cal, wrong)[1] if f.id == "unsteady"]
    assert "dip" in text


@pytest.mark.parametrize("count", [2, 3])
def test_swapped_axes_of_two_or_three_rows_are_named(cal, count):
    right = shot(*(each[:count] for each in attitudes(6)))
    wrong = replace(right, magnetometer=right.magnetometer[:, [1, 0, 2]])
    assert not {"unsteady", "odd-rows"} & {f.id for f in correction.correct(cal, right)[1]}
    assert "unsteady" in [f.id for f in correction.correct(cal, wrong)[1]]


@pytest.mark.parametrize("count", [6, 40, 3000])
@pytest.mark.parametrize("row", [0, 2, -1])
def test_a_single_row_of_the_wrong_sign_is_named(cal, count, row):
    """One cell of the magnetometer; the dip there is that of the mirrored vector."""
    right = shot(*attitudes(count))
    assert "odd-rows" not in [f.id for f in correction.correct(cal, right)[1]]
    field = right.magnetometer.copy()
    field[row, np.argmax(np.abs(field[row]))] *= -1
    columns, findings = correction.correct(cal, replace(right, magnetometer=field))
    [text] = [f.text for f in findings if f.id == "odd-rows"]
    assert "dip at 1 of " in text
    assert f"as far as {columns['dip_deg'][row]:.1f}°" in text


@pytest.mark.parametrize("axis", range(3))
def test_an_axis_of_the_wrong_sign_is_named(cal, axis):
    sign = np.where(np.arange(3) == axis, -1.0, 1.0)
    right = shot(*attitudes(50))
    wrong = replace(right, magnetometer=right.magnetometer * sign)
    assert "unsteady" in [f.id for f in correction.correct(cal, wrong)[1]]
    wrong = replace(right, accelerometer=right.accelerometer * sign)
    assert "unsteady" in [f.id for f in correction.correct(cal, wrong)[1]]


def test_repeated_shots_do_not_hide_swapped_axes(cal):
    inc, azi, face = (np.repeat(each, 3) for each in attitudes(30))
    right = shot(inc, azi, face)
    wrong = replace(right, magnetometer=right.magnetometer[:, [1, 0, 2]])
    assert "unsteady" in [f.id for f in correction.correct(cal, wrong)[1]]
    assert "unsteady" not in [f.id for f in correction.correct(cal, right)[1]]


def test_a_dip_that_drifts_and_tables_of_two_places_are_no_error(cal):
    for dip in (np.linspace(40.0, 75.0, 400), np.repeat([-30.0, 75.0], 200)):
        readings = shot(*attitudes(400), dip=dip)
        assert "unsteady" not in [f.id for f in correction.correct(cal, readings)[1]]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_the_command_writes_uncertainties_unless_told_otherwise(tmp_path, cal, suffix):
    from cli_support import mwdcal as command

    mwdcal.save(cal, tmp_path / "c.json")
    mwdcal.save(shot(*attitudes(20)), tmp_path / f"r{suffix}")
    for option, wanted in (((), True), (("--no-uncertainty",), False)):
        out = tmp_path / f"o{suffix}"
        command("apply", tmp_path / "c.json", tmp_path / f"r{suffix}", "-o", out, *option)
        found = table.read(out)
        assert (set(UNCERTAINTIES) <= set(found.columns)) == wanted
        assert bool(set(UNCERTAINTIES) & set(found.columns)) == wanted
