"""PriorInformation before the run: one more block of evidence, with its own finding where it is wrong."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from cli_support import SERVO_NOISE, calibrated, mwdcal, servo_run, write_csv
from mwdcal.calibration.automatic.drift import aged
from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.prior import from_calibration, from_datasheet
from mwdcal.calibration.readings import Readings
from mwdcal.errors import FitError, InputError
from mwdcal.files import documents
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import reference_vectors
from mwdcal.sensor.profile import Datasheet, Profile, TriadProfile
from simulation import Tool, plan
from test_calibrate import PROFILE, make

SHEET = Profile(
    name="with a datasheet",
    accelerometer=TriadProfile(datasheet=Datasheet(scale=0.03, bias=0.006, misalignment_deg=0.1)),
    magnetometer=TriadProfile(datasheet=Datasheet(scale=0.03, bias=300.0, misalignment_deg=0.1)),
)
ATTITUDES = np.radians([[20.0, 60, 100, 150], [10.0, 100, 200, 300], [15.0, 75, 160, 301]])
NAMES = ("gravity", "inclination", "toolface", "azimuth", "field", "dip")


def probe(tool):
    """Readings of a tool at other attitudes, and the vectors they should give."""
    g, b = reference_vectors(*ATTITUDES, tool.gravity, tool.field, tool.dip)
    raw = [v @ s.T + o for v, s, o in zip((g, b), tool.matrix, tool.offset, strict=True)]
    return Readings(raw[0], raw[1]), (g, b)


def errors(record, tool):
    """Departures of every observable, and the stated half widths of 95 %."""
    readings, truth = probe(tool)
    for name in NAMES:
        value = OBSERVABLES[name].value
        error = value(*record.fields(readings)) - value(*truth)
        yield error, record.expanded_uncertainty(name, readings)


@pytest.mark.parametrize("unknown", [(), ("toolface",)], ids=["whole", "toolface unknown"])
def test_two_runs_in_turn_are_as_good_as_both_together(unknown):
    """The first run's calibration as the prior of the second: the same as one fit of both."""
    first, second = make(1, unknown=unknown), make(2, (20, 60, 110, 160), unknown=unknown)
    both = replace(
        first,
        accelerometer=np.concatenate([first.accelerometer, second.accelerometer]),
        magnetometer=np.concatenate([first.magnetometer, second.magnetometer]),
        known={k: np.concatenate([first.known[k], second.known[k]]) for k in first.known},
    )
    before = fit(first)  # the file's covariance carries s² of its run: undone here
    record = calibrate(first, PROFILE)
    scale = np.sqrt(np.repeat(np.maximum(before.analysis.variance_factor[0], 1.0), 12))
    bare = (record.parameter_covariance / np.outer(scale, scale)).tolist()
    record = msgspec.structs.replace(record, covariance_rows=bare)
    turned = fit(second, Options(prior=from_calibration(record)))
    whole = fit(both)
    assert turned.analysis.determined.rank[0] == whole.analysis.determined.rank[0]
    readings, _ = probe(Tool.random(7))
    fields = []
    for result in (turned, whole):
        pairs = zip(result.problem.triads, result.problem.slices(), strict=True)
        raw = (readings.accelerometer, readings.magnetometer)
        fields.append([
            t.model.fields(result.state.params[:, w], r, np.zeros(4))[0]
            for (t, w), r in zip(pairs, raw, strict=True)
        ])  # fmt: skip
    for name in NAMES if not unknown else ("gravity", "inclination", "field", "dip"):
        values = [OBSERVABLES[name].value(*pair) for pair in fields]
        sd = np.abs(values[1]) * 1e-4 if name in ("gravity", "field") else 2e-5
        assert (np.abs(values[0] - values[1]) < 0.02 * sd).all(), name


@pytest.mark.parametrize("tools", [60, pytest.param(240, marks=pytest.mark.study)])
def test_intervals_cover_with_tools_drawn_from_their_datasheet(tools):
    """Six stations, no redundancy to speak of without it, on a new tool each time."""
    covered, widths = [], []
    sheet = {"noise": 1e-4}, {"noise": 15.0}
    profile = msgspec.structs.replace(
        SHEET,
        accelerometer=msgspec.structs.replace(SHEET.accelerometer, **sheet[0]),
        magnetometer=msgspec.structs.replace(SHEET.magnetometer, **sheet[1]),
    )
    for seed in range(tools):
        rng = np.random.default_rng(seed)
        turn = np.tan(np.radians(0.1))
        gain = (np.eye(3) - turn * rng.normal(size=(2, 3, 3)) * (1 - np.eye(3))) / (
            1 + 0.03 * rng.normal(size=(2, 1, 3))
        )
        offset = rng.normal(size=(2, 3)) * np.array([[0.006], [300.0]])
        matrix = np.linalg.inv(gain)
        tool = Tool(matrix, np.einsum("tij,tj->ti", matrix, offset))
        data = make(seed, (40, 100), 3, tool=tool)
        options = Options(prior=from_datasheet(profile))
        record = calibrate(data, profile, options)
        for error, width in errors(record, tool):
            covered.append(np.abs(error) < width)
            widths.append(width)
    assert np.isfinite(widths).all()
    assert 0.93 < np.mean(covered) < 0.97


def test_what_rests_on_the_prior_alone_is_said():
    data = make(3, unknown=("toolface",))
    record = calibrate(data, SHEET, Options(prior=from_datasheet(SHEET)))
    assert record.accelerometer.rank == record.accelerometer.size
    found = {f.id: f.text for f in record.findings}
    assert "toolface-zero" in found["prior-only"]
    assert "datasheet" in found["prior-only"]
    width = record.expanded_uncertainty("toolface", probe(Tool.random(7))[0])
    # a common turn is four misalignments of 0.1 degree (xy and yx of both triads): half of it
    assert width == pytest.approx(1.96 * np.radians(0.05), rel=0.03)
    without = calibrate(data, SHEET)
    assert [u.id for u in without.accelerometer.undetermined] == ["toolface-zero"]


def test_a_tool_that_has_changed_is_told():
    previous = calibrate(make(1), PROFILE)
    same = calibrate(make(2), PROFILE, Options(prior=from_calibration(previous)))
    assert not [f for f in same.findings if f.id == "prior-conflict"]
    data = make(2)
    bent = replace(data, accelerometer=data.accelerometer + np.array([0.001, 0, 0]))
    changed = calibrate(bent, PROFILE, Options(prior=from_calibration(previous)))
    assert [f for f in changed.findings if f.id == "prior-conflict"]


@pytest.mark.parametrize("tools", [15, pytest.param(60, marks=pytest.mark.study)])
def test_no_false_alarm_of_a_changed_tool(tools):
    previous = [calibrate(make(seed), PROFILE) for seed in range(tools)]
    alarms = [
        any(f.id == "prior-conflict" for f in calibrate(
            make(1000 + seed), PROFILE, Options(prior=from_calibration(record))).findings)
        for seed, record in enumerate(previous)
    ]  # fmt: skip
    assert sum(alarms) <= 1


def test_what_does_not_fit_together_is_refused():
    curved = Profile(name="bent", magnetometer=TriadProfile(nonlinearity=0.01))
    with pytest.raises(InputError, match="`nonlinearity` none"):
        from_calibration(calibrate(make(1), curved, Options(nonlinearity=("magnetometer",))))
    relative = calibrate(make(1, unknown=("field",)), PROFILE)
    with pytest.raises(InputError, match="ref_field_nt"):
        from_calibration(relative)
    previous = from_calibration(calibrate(make(1), PROFILE))
    with pytest.raises(FitError, match="`parameters`"):
        calibrate(make(2), PROFILE, Options(prior=previous, parameters=9))
    with pytest.raises(InputError, match="`prior`"):
        calibrate(make(2), PROFILE, Options("newton", prior=previous))


def test_a_datasheet_speaks_of_both_models_alike():
    data = make(3, (40, 100), 3)
    a, b = (
        fit(data, Options(model=k, prior=from_datasheet(SHEET))) for k in ("polynomial", "factors")
    )
    for pair in zip(a.problem.fields(a.state), b.problem.fields(b.state), strict=True):
        size = np.linalg.norm(pair[0], axis=-1).mean()
        assert np.abs(pair[0] - pair[1]).max() < 3e-4 * size  # scale 1/SF against SF: 3 % squared
    assert plan()[0].shape == (48,)


@pytest.mark.parametrize("stated", [True, False], ids=["prior in nT", "relative prior"])
def test_a_run_without_magnetometer_has_no_unit_that_could_differ_from_the_prior(stated, tmp_path):
    """The prior's accelerometer counts, whatever the unit of its magnetometer."""
    tool = Tool.random(1, noise=SERVO_NOISE)
    columns = servo_run(1, tool=tool)
    if not stated:
        columns = {k: v for k, v in columns.items() if k != "ref_field_nt"}
    previous = calibrated(tmp_path, columns)
    again = servo_run(2, tool=tool).items()
    alone = {k: v for k, v in again if k not in ("mx", "my", "mz", "ref_field_nt")}
    run = write_csv(tmp_path / "alone.csv", alone)
    made = tmp_path / "second.json"
    ran = mwdcal("calibrate", run, "--tool", "servo", "--prior", previous, "-o", made)
    assert ran.code == 0, ran.err
    first, second = (documents.read(path) for path in (previous, made))
    assert second.magnetometer is None
    assert second.accelerometer.rank == 12
    bare = (
        tmp_path / "bare.json"
    )  # the prior adds to what the run says alone, and ages as no date is stated
    assert mwdcal("calibrate", run, "--tool", "servo", "-o", bare).code == 0
    after, alone = (
        np.array(c.accelerometer.standard_uncertainties) for c in (second, documents.read(bare))
    )
    assert (after < alone).all()
    across = [1, 2, 5]  # misalignment does not age
    assert first.accelerometer.parameter_names[1] == "gain-xy"
    assert (after < np.array(first.accelerometer.standard_uncertainties))[across].all()


def later(seed, turn_on, date):
    """A run of a tool that was switched on again: offsets of both triads anew, g and nT."""
    rng = np.random.default_rng(seed)
    readings = make(seed, (20, 60, 110, 160))
    return replace(
        readings,
        accelerometer=readings.accelerometer + turn_on[0] * rng.normal(size=3),
        magnetometer=readings.magnetometer + turn_on[1] * rng.normal(size=3),
        metadata={"date": date},
    )


def test_a_prior_allows_for_switching_on_and_for_time():
    """Variance of an offset: that of the earlier run, twice that of a turn-on, and a year's walk times the years."""
    sheet = {"turn_on": 3e-4, "bias_walk": 6e-4, "scale_walk": 1e-3}
    profile = msgspec.structs.replace(
        PROFILE,
        accelerometer=msgspec.structs.replace(PROFILE.accelerometer, datasheet=Datasheet(**sheet)),
    )
    previous = calibrate(replace(make(1), metadata={"date": "2024-01-01"}), profile)
    run = later(2, (0.0, 0.0), "2026-01-01")
    known = aged(from_calibration(previous), previous, run, profile)
    covariance = np.linalg.inv(known.precision)
    years = 731 / 365.25
    extra = np.diag(covariance) - np.diag(previous.parameter_covariance)
    by_name = dict(zip(known.names, extra, strict=True))
    offset = 2 * 3e-4**2 + 6e-4**2 * years
    assert by_name["accelerometer offset-x"] == pytest.approx(offset, rel=1e-4)
    assert by_name["accelerometer gain-xx"] == pytest.approx(1e-6 * years, rel=1e-3)
    assert by_name["accelerometer gain-xy"] == pytest.approx(0.0, abs=1e-11)
    assert by_name["magnetometer offset-z"] == pytest.approx(70.0**2 * (2 + years), rel=1e-4)


def test_an_ordinary_turn_on_is_no_conflict_and_a_knock_is():
    previous = calibrate(replace(make(1), metadata={"date": "2026-01-01"}), PROFILE)
    usual = calibrate(later(2, (4e-4, 70.0), "2026-02-01"), PROFILE, Options(prior=previous))
    names = {finding.id: finding.text for finding in usual.findings}
    assert "prior-conflict" not in names
    assert "31 days" in names["prior-aged"]
    knocked = calibrate(later(2, (1e-2, 70.0), "2026-02-01"), PROFILE, Options(prior=previous))
    assert "prior-conflict" in {finding.id for finding in knocked.findings}
