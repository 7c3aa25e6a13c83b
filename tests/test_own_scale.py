"""The scale that a run gives where its profile states none: every route keeps it, and no later table has its own.

Expected values are those of the simulated tool and stand.
"""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

import mwdcal

FIELD, AZIMUTH, TRIADS = 48_000.0, 60.0, ("accelerometer", "magnetometer")
AXES = {"accelerometer": ("ax", "ay", "az"), "magnetometer": ("mx", "my", "mz")}
COUNTS = {"accelerometer": 3.0, "magnetometer": 0.05}
"""Raw units per g and nT, which the profile does not state."""
LATER = ("verify", "diagnose", "apply", "survey")


def columns(readings, references=True):
    """The table of a simulated run in raw units."""
    table = {"temperature_c": readings.temperature}
    for kind, names in AXES.items():
        raw = getattr(readings, kind) * COUNTS[kind]
        table |= dict(zip(names, raw.transpose(), strict=True))
    if references:
        angles = {f"ref_{name}_deg": np.degrees(each) for name, each in readings.known.items()
                  if name in ("inclination", "azimuth", "toolface")}  # fmt: skip
        table |= {"ref_field_nt": np.full(len(readings), FIELD)} | angles
    return table


RUN = columns(mwdcal.simulate(tool=4, seed=1))
ROLL = mwdcal.simulate([45], 12, [AZIMUTH], tool=4, seed=3)


def by_path(folder):
    path = folder / "run.csv"
    rows = np.stack([*RUN.values()], -1)
    np.savetxt(path, rows, delimiter=",", header=",".join(RUN), comments="", fmt="%.12g")
    return mwdcal.calibrate(path, "generic")


ROUTES = {
    "columns": lambda folder: mwdcal.calibrate(RUN, "generic"),
    "file": by_path,
    "readings": lambda folder: mwdcal.calibrate(mwdcal.read_run(RUN, "generic")),
    "both": lambda folder: mwdcal.calibrate(mwdcal.read_run(RUN, "generic"), "generic"),
}


@pytest.fixture(scope="module")
def cal():
    return mwdcal.calibrate(RUN, "generic")


@pytest.mark.parametrize("route", ROUTES)
def test_every_route_keeps_the_scale_of_its_run(route, tmp_path):
    """Nominal scales are true to 10 %; corrected by them a table without references has the true field."""
    made = ROUTES[route](tmp_path)
    mwdcal.save(made, tmp_path / "tool.json")
    made = mwdcal.load(tmp_path / "tool.json")
    scales = {kind: getattr(made.profile, kind).scale for kind in TRIADS}
    assert scales == pytest.approx(COUNTS, rel=0.1)
    corrected = mwdcal.apply(made, columns(ROLL, references=False))
    np.testing.assert_allclose(corrected.columns["field_nt"], FIELD, rtol=2e-3)
    np.testing.assert_allclose(corrected.columns["azimuth_deg"], AZIMUTH, atol=0.2)
    assert mwdcal.verify(made, columns(ROLL)).passed


@pytest.mark.parametrize("function", LATER)
def test_later_readings_that_scaled_themselves_are_refused(cal, function):
    """The offset of the magnetometer makes the radius about a roll circle another than that of the run."""
    later = mwdcal.read_run(columns(ROLL), "generic")
    with pytest.raises(mwdcal.InputError, match=r"states no \w+ scale.* by the calibration's"):
        getattr(mwdcal, function)(cal, later)
    getattr(mwdcal, function)(cal, mwdcal.read_run(columns(ROLL), cal.profile))


def test_a_calibration_without_a_scale_reads_no_table_by_one_of_its_own(cal):
    """Such as earlier versions made."""
    triads = {k: msgspec.structs.replace(getattr(cal.profile, k), scale=None) for k in TRIADS}
    bare = msgspec.structs.replace(cal, profile=msgspec.structs.replace(cal.profile, **triads))
    for function in LATER:
        with pytest.raises(
            mwdcal.InputError, match=r"accelerometer scale.*\(not kept\)\. Calibrate"
        ):
            getattr(mwdcal, function)(bare, columns(ROLL))


def test_a_run_is_corrected_in_the_scale_that_it_gave(cal):
    run = mwdcal.read_run(RUN, "generic")
    assert run.self_scaled == pytest.approx(COUNTS, rel=0.1)
    np.testing.assert_allclose(mwdcal.apply(cal, run).columns["field_nt"], FIELD, rtol=2e-3)


def test_a_table_is_read_in_the_scale_of_its_prior(cal):
    later = mwdcal.calibrate(columns(mwdcal.simulate(tool=4, seed=9)), "generic", prior=cal)
    for kind in TRIADS:
        assert getattr(cal.profile, kind).scale == pytest.approx(COUNTS[kind], rel=0.1)
        assert getattr(later.profile, kind).scale == getattr(cal.profile, kind).scale


def test_arrays_are_in_nominal_units_whatever_the_profile():
    run = mwdcal.simulate(tool=4, seed=1)
    run = replace(run, profile=None)
    made = mwdcal.calibrate(run, "generic")
    assert {getattr(made.profile, kind).scale for kind in TRIADS} == {1.0}
