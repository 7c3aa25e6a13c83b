"""`import mwdcal`: the public names, conversion and refusal of arrays, and the ten lines of a first script."""

import inspect
import os
import re
import shutil
import subprocess
import sys
import typing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mwdcal
from cli_support import EXAMPLE, numbers, read_csv
from cli_support import mwdcal as command
from mwdcal.app.commands.example import CONTENTS
from mwdcal.calibration.record import Calibration
from mwdcal.files import documents
from mwdcal.sensor.profile import TriadProfile

TOOL = 3


@pytest.fixture(scope="module")
def simulated():
    return mwdcal.simulate(tool=TOOL, noise=(1e-4, 15.0), seed=1)


@pytest.fixture(scope="module")
def rolltest():
    return mwdcal.simulate([45], 12, [60], tool=TOOL, seed=2)


@pytest.fixture(scope="module")
def run(simulated):
    known = {n: simulated.known[n] for n in ("inclination", "azimuth", "toolface")}
    return mwdcal.readings(
        simulated.accelerometer, simulated.magnetometer, temperature=25.0, field=48_000.0, **known
    )


@pytest.fixture(scope="module")
def cal(run):
    return mwdcal.calibrate(run)


def columns(simulated):
    """Arguments of `readings` as arrays."""
    return simulated.accelerometer, simulated.magnetometer


def process(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


def test_importing_the_package_loads_no_numpy():
    loaded = "import sys, mwdcal; mwdcal.__version__, dir(mwdcal); print('numpy' in sys.modules)"
    assert process(loaded).stdout.strip() == "False"
    assert (
        process("import sys, mwdcal; mwdcal.readings; print('numpy' in sys.modules)").stdout
        == "True\n"
    )


def test_drawing_and_its_library_wait_until_they_are_used():
    code = "import sys, mwdcal; mwdcal.calibrate; print('matplotlib' in sys.modules)"
    assert process(code).stdout.strip() == "False"


def test_every_public_name_is_there_and_has_a_docstring():
    from mwdcal.library import face

    assert all(hasattr(face, name) for name in mwdcal.__all__)
    assert len(mwdcal.__all__) <= 32
    for name in mwdcal.__all__:
        assert getattr(mwdcal, name).__doc__, name
        assert name in dir(mwdcal)
    with pytest.raises(AttributeError, match="no attribute 'reading'"):
        mwdcal.reading  # noqa: B018


def test_the_citation_states_the_version():
    text = (EXAMPLE.parents[1] / "CITATION.cff").read_text("utf-8")
    assert f"version: {mwdcal.__version__}\n" in text


def test_ten_lines(simulated, rolltest, tmp_path, monkeypatch):
    """The script of the design, with its own names."""
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    a, m, t = simulated.accelerometer, simulated.magnetometer, simulated.temperature
    inc, azi, tf = (simulated.known[n] for n in ("inclination", "azimuth", "toolface"))
    survey = rolltest

    run = mwdcal.readings(
        a, m, temperature=t, inclination=inc, azimuth=azi, toolface=tf, field=48_000.0
    )
    cal = mwdcal.calibrate(run)
    g, b = cal.fields(survey)
    sd = cal.uncertainty("azimuth", survey, noise=True)
    both = cal.covariance(("inclination", "azimuth"), survey)
    passed = mwdcal.verify(cal, rolltest).passed
    mwdcal.save(cal, "tool.json")
    cal = mwdcal.load("tool.json")
    figure = cal.plot.accuracy()

    assert g.shape == b.shape == (12, 3)
    assert sd.shape == (12,)
    assert both.shape == (12, 2, 2)
    assert passed is True
    assert type(figure).__module__ == "matplotlib.figure"
    assert np.abs(np.linalg.norm(g, axis=-1) - 1).max() < 1e-3


def test_covariance_of_two_angles_is_that_of_their_sensitivities(cal, rolltest):
    names = ("inclination", "azimuth")
    both = cal.covariance(names, rolltest)
    rows = np.stack([cal.sensitivity(n, rolltest) for n in names], -2)
    expected = rows @ cal.parameter_covariance @ np.swapaxes(rows, -1, -2)
    np.testing.assert_allclose(both, expected, rtol=1e-9)
    for index, name in enumerate(names):
        sd = np.sqrt(both[:, index, index])
        np.testing.assert_allclose(sd, cal.uncertainty(name, rolltest), rtol=1e-12)
    assert np.abs(both[:, 0, 1]).max() > 0
    with pytest.raises(mwdcal.InputError, match="`names` must be observables"):
        cal.covariance(("inclination", "yaw"), rolltest)


def test_covariance_with_noise_is_what_many_readings_scatter(cal):
    """Sample covariance of corrected inclination and azimuth of one attitude read 4,000 times."""
    one = mwdcal.simulate([60], 1, [30], tool=TOOL, noise=(0.0, 0.0))
    rng = np.random.default_rng(5)
    shape = (4000, 3)
    many = mwdcal.readings(
        one.accelerometer + cal.accelerometer.noise * rng.normal(size=shape),
        one.magnetometer + cal.magnetometer.noise * rng.normal(size=shape),
        temperature=25.0,
    )
    corrected = mwdcal.apply(cal, many)
    sample = np.cov(corrected.inclination, corrected.azimuth)
    names = ("inclination", "azimuth")
    stated = cal.covariance(names, one, noise=True)[0] - cal.covariance(names, one)[0]
    scale = np.sqrt(np.outer(np.diag(stated), np.diag(stated)))
    assert np.abs((sample - stated) / scale).max() < 5 / np.sqrt(4000)


def test_an_observable_without_uncertainty_leaves_those_of_the_others(simulated):
    """That method leaves the scale of the accelerometer free: gravity rests on it, no angle does."""
    known = {n: simulated.known[n] for n in ("inclination", "toolface")}
    run = mwdcal.readings(*columns(simulated), field=48_000.0, **known)
    cal = mwdcal.calibrate(run, method="toolface-inclination")
    both = cal.covariance(("inclination", "gravity"), simulated)
    assert np.isfinite(both[:, 0, 0]).all()
    assert np.isnan(both[:, 1]).all()
    assert np.isnan(both[:, 0, 1]).all()


def test_lists_degrees_and_scalars_give_the_same_readings(simulated):
    a, m = columns(simulated)
    known = {n: simulated.known[n] for n in ("inclination", "azimuth", "toolface", "dip")}
    arrays = mwdcal.readings(a, m, temperature=25.0, field=48_000.0, **known)
    degrees = {f"{n}_deg": np.degrees(v).tolist() for n, v in known.items()}
    lists = mwdcal.readings(
        a.tolist(), m.tolist(), temperature=[25] * 48, field=[48_000] * 48, **degrees
    )
    assert arrays.digest == lists.digest
    for name, values in arrays.known.items():
        np.testing.assert_allclose(lists.known[name], values, rtol=1e-15, atol=1e-15)
        assert lists.known[name].shape == (48,)
    np.testing.assert_array_equal(arrays.temperature, lists.temperature)


def test_the_arrays_given_are_neither_kept_nor_changed(simulated):
    a = simulated.accelerometer.copy()
    azimuth = np.full(48, -np.pi / 2)
    made = mwdcal.readings(a, azimuth=azimuth)
    a[:] = 0
    assert np.abs(made.accelerometer).max() > 0.5
    np.testing.assert_allclose(made.known["azimuth"], 1.5 * np.pi)
    assert (azimuth == -np.pi / 2).all()


def test_unknown_references_are_left_out_and_blank_ones_stay_nan(simulated):
    inclination = np.where(np.arange(48) < 40, 0.5, np.nan)
    made = mwdcal.readings(
        *columns(simulated), inclination=inclination, azimuth=np.nan, toolface=None
    )
    assert list(made.known) == ["inclination"]
    assert np.isnan(made.known["inclination"]).sum() == 8


@pytest.mark.parametrize(
    ("metadata", "magnetic"),
    [
        ({"azimuth_reference": "magnetic", "declination_deg": 3.0}, 2.0),
        ({"azimuth_reference": "true", "declination_deg": 3.0}, 359.0),
        ({"azimuth_reference": "grid", "declination_deg": 3.0, "convergence_deg": 1.5}, 0.5),
    ],
)
def test_metadata_of_arrays_say_what_those_of_a_file_do(simulated, tmp_path, metadata, magnetic):
    stated = {**metadata, "ref_field_nt": 50000, "ref_dip_deg": 70.0, "ref_gravity_g": 1.001}
    given = {"inclination_deg": 30.0, "azimuth_deg": 2.0, "toolface_deg": 10.0, "gravity": 0.999}
    run = mwdcal.readings(simulated.accelerometer, simulated.magnetometer, metadata=stated, **given)
    path = tmp_path / "run.csv"
    mwdcal.save(run, path)
    assert (
        f"azimuth_reference = {metadata['azimuth_reference']!r}".replace("'", '"')
        in path.read_text()
    )
    for each in (run, mwdcal.read_run(path)):
        np.testing.assert_allclose(np.degrees(each.known["azimuth"]), magnetic, atol=1e-12)
        np.testing.assert_allclose(np.degrees(each.known["dip"]), 70.0)
        assert {*each.known["field"].tolist()} == {50000.0}
        assert {*each.known["gravity"].tolist()} == {0.999}


def test_uncertainties_by_name_and_unit(simulated):
    sd = {
        "accelerometer": 1e-4,
        "magnetometer": (14.0, 15.0, 16.0),
        "inclination_deg": 0.02,
        "azimuth": np.full(48, 0.001),
        "azimuth_zero_deg": 0.5,
        "tilt": 1e-4,
        "field": 50.0,
    }
    made = mwdcal.readings(*columns(simulated), sd=sd)
    assert made.sd["accelerometer"].shape == made.sd["magnetometer"].shape == (48, 3)
    assert made.sd["magnetometer"][7].tolist() == [14.0, 15.0, 16.0]
    np.testing.assert_allclose(made.sd["inclination"], np.radians(0.02))
    np.testing.assert_allclose(made.sd["azimuth-zero"], np.radians(0.5))
    assert made.sd["tilt"][0] == 1e-4
    assert made.sd["field"][0] == 50.0


def test_groups_by_number_or_name(simulated):
    names = ["B", "", "A", None, float("nan"), "B"] * 8
    numbers = [7, -1, 2, -1, -1, 7] * 8
    for group in (names, numbers, np.array(numbers)):
        made = mwdcal.readings(*columns(simulated), group=group)
        assert made.group[:6].tolist() == [0, -1, 1, -1, -1, 0]


def worse(values, at=(5, 1), bad=np.nan):
    values = values.copy()
    values[at] = bad
    return values


REFUSED = {
    "reading": (lambda a, m: ((worse(a), m), {}), r"`accelerometer` must be finite; got nan at station 6"),
    "infinite": (lambda a, m: ((a, worse(m, bad=np.inf)), {}), r"`magnetometer` must be finite; got inf"),
    "axes first": (lambda a, m: ((a.T, m.T), {}), r"shape \(n, 3\); got \(3, 48\). Put the axes last"),
    "stations": (lambda a, m: ((a, m[:9]), {}), r"shape of `accelerometer`, \(48, 3\); got \(9, 3\)"),
    "text": (lambda a, m: ((a, m), {"dip": "steep"}), r"`dip` must be numbers"),
    "name": (lambda a, m: ((a, m), {"inclinaton": 1}), r"unknown name 'inclinaton'.*Did you mean 'incl"),
    "degrees": (lambda a, m: ((a, m), {"inclination": 90}), r"rad; got 90 .* Degrees go to `inclination_deg`"),
    "range": (lambda a, m: ((a, m), {"dip_deg": -91}), r"between -90 and 90 °; got -91 at station 1"),
    "field": (lambda a, m: ((a, m), {"field": 0}), r"`field` must be above 0 and at most 200000 nT; got 0"),
    "twice": (lambda a, m: ((a, m), {"dip_deg": 1, "dip": 0.1}), r"are the same quantity"),
    "length": (lambda a, m: ((a, m), {"azimuth": [1, 2]}), r"the shape \(48,\); got \(2,\)"),
    "temperature": (lambda a, m: ((a, m), {"temperature": np.nan}), r"`temperature` must be a number; got nan"),
    "kelvin": (lambda a, m: ((a, m), {"temperature": 2980}), r"at most 1000|and 1000 °C; got 2980"),
    "group": (lambda a, m: ((a, m), {"group": [1, 2]}), r"`group` must have one value for each of 48"),
    "sd name": (lambda a, m: ((a, m), {"sd": {"noise": 1}}), r"unknown name 'noise'"),
    "sd zero": (lambda a, m: ((a, m), {"sd": {"accelerometer": 0}}), r"must be above 0 .*; got 0"),
    "sd blank": (lambda a, m: ((a, m), {"sd": {"magnetometer": np.nan}}), r"must be a number; got nan"),
    "sd below zero": (lambda a, m: ((a, m), {"sd": {"tilt": -1}}), r"must be between 0 and 3.14159 rad; got -1"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_refused_arrays(case, simulated):
    given, message = REFUSED[case]
    arrays, keywords = given(*columns(simulated))
    with pytest.raises(mwdcal.InputError, match=message) as caught:
        mwdcal.readings(*arrays, **keywords)
    assert "\n" not in str(caught.value)


def test_calibrate_refuses_what_is_no_run(simulated):
    with pytest.raises(mwdcal.InputError, match=r"got object of shape \(0,\). Or make readings by"):
        mwdcal.calibrate(object())
    many = mwdcal.readings(np.stack([simulated.accelerometer] * 2))
    with pytest.raises(mwdcal.InputError, match=r"one run, \(n, 3\); got \(2, 48, 3\)"):
        mwdcal.calibrate(many)
    with pytest.raises(mwdcal.InputError, match="unknown option 'methd'.*Did you mean 'method'"):
        mwdcal.calibrate(simulated, methd="scalar")
    with pytest.raises(mwdcal.InputError, match="given as `profile`, not as `tool`"):
        mwdcal.calibrate(simulated, tool="servo")


def test_options_by_name_are_those_of_options(run):
    by_name = mwdcal.calibrate(run, robust="huber", ignore=("field",))
    whole = mwdcal.calibrate(run, options=mwdcal.Options(robust="huber", ignore=("field",)))
    assert by_name.options == whole.options
    assert by_name.parameters.tolist() == whole.parameters.tolist()
    assert by_name.options.robust == "huber"


def test_one_name_is_a_tuple_of_one(run, cal):
    by_name = mwdcal.Options(nonlinearity="accelerometer", estimate="azimuth-zero", ignore="dip")
    assert by_name.nonlinearity == ("accelerometer",)
    assert (by_name.estimate, by_name.ignore) == (("azimuth-zero",), ("dip",))
    assert mwdcal.Options(nonlinearity="none").nonlinearity == ()
    one, alone = cal.covariance("azimuth", run), cal.uncertainty("azimuth", run)
    np.testing.assert_allclose(np.sqrt(one[..., 0, 0]), alone, rtol=1e-14)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"model": "factor"}, "`model` must be polynomial or factors; got 'factor'"),
        ({"nonlinearity": "gyroscope"}, "got 'gyroscope'"),
        ({"prior": "tool.json"}, "Read a file with mwdcal.load"),
        ({"method": "joit"}, "`method` must be one of"),
        ({"robust": "hubr"}, "`robust` must be one of"),
        ({"parameters": 7}, "`parameters` must be 6, 9 or 12"),
    ],
)
def test_refused_options(change, words, run):
    with pytest.raises(mwdcal.InputError, match=words):
        mwdcal.calibrate(run, **change)


def test_refused_arguments(run, cal, simulated):
    a, m = columns(simulated)
    batch = mwdcal.readings(np.stack([a, a]), np.stack([m, m]))
    labels = mwdcal.readings(a, m, station=np.arange(48) - 1.0).station[:3]
    assert labels == ("-1", "0", "1")
    for call, words in (
        (lambda: mwdcal.calibrate(run, mwdcal.Options()), "`profile` must be a tool profile"),
        (lambda: mwdcal.verify(cal, batch), "`rolltest` must have readings of one run"),
        (lambda: mwdcal.apply(cal, a[:, :2]), r"got ndarray of shape \(48, 2\)"),
        (lambda: cal.fields([1.0, 0.0, 0.0]), r"got list of shape \(3,\)"),
        (lambda: cal.covariance((), run), "one observable or more"),
        (lambda: mwdcal.readings(a + 0j, m), "`accelerometer` must be numbers; got complex128"),
        (lambda: mwdcal.readings(a > 0, m), "must be numbers; got bool"),
        (lambda: mwdcal.readings(a, m, sd=1e-4), "`sd` must be a mapping"),
        (lambda: mwdcal.readings(a, m, group=1), "one value for each of 48 stations; got 1"),
        (lambda: mwdcal.read_run({"ax": [1, 2], "ay": [1], "az": [1, 2]}), "column 'ay' has 1"),
        (lambda: mwdcal.read_run({"ax": 1, "ay": 1, "az": 1}), "column 'ax' must be numbers"),
        (lambda: mwdcal.simulate([200]), "between 0 and 180"),
        (lambda: mwdcal.simulate([45], 0), "`toolfaces` 1 or more"),
        (lambda: mwdcal.simulate(tool=([1.0], [1.0])), r"30 factors of each triad; got \(1,\)"),
        (lambda: mwdcal.save(a, "run.csv"), "`result` must be"),
        (lambda: mwdcal.save(run, "run.dat"), "run.dat"),
        (lambda: mwdcal.calibrate(run, prior=cal), "the calibration of unnamed readings was made"),
    ):
        with pytest.raises(mwdcal.InputError, match=words):
            call()


def test_a_calibration_knows_the_stations_of_its_fit(cal, run):
    with pytest.raises(
        mwdcal.InputError, match=r"^the readings: 48 of 48 stations were in the fit"
    ):
        mwdcal.verify(cal, run)


def test_short_representations(cal, rolltest):
    verdict = mwdcal.verify(cal, rolltest)
    for thing in (cal, verdict, rolltest):
        assert len(repr(thing)) < 400
        assert "\n" not in repr(thing)
    assert "accelerometer 12 of 12" in repr(cal)
    assert "findings gravity-unknown, no-serial" in repr(cal)
    assert repr(verdict).startswith("<Verdict: passed, ")
    for html in (cal._repr_html_(), verdict._repr_html_()):
        assert html.startswith("<table>")
        assert html.count("<tr>") == html.count("</tr>") > 2


def test_accuracy_of_the_representation_is_the_typical_one(cal):
    from mwdcal.calibration.results import typical_accuracy

    accuracy = cal.glance()["accuracy"]
    for name, value in typical_accuracy(cal).items():
        assert f"{name} {value:.2g}°" in accuracy


def test_the_practice_of_the_stand_is_stated_where_the_readings_are_from(tmp_path):
    """The simulated stand is set anew at each station of moosavi-12, whose rolls share a direction."""
    sd = {"inclination_deg": 0.05, "azimuth_deg": 0.05, "toolface_deg": 0.02}
    tool = mwdcal.load_profile("servo").with_stand(**sd, settings="per-station")
    run = mwdcal.simulate("moosavi-12", tool, seed=1)
    mwdcal.save(run, tmp_path / "run.csv", tool)
    silent = mwdcal.load_profile("servo").with_stand(**sd)
    vectors = (run.accelerometer, run.magnetometer)
    made = {
        "mwdcal.readings(…)": mwdcal.calibrate(mwdcal.readings(*vectors, sd=sd, **run.known)),
        "[stand] of the profile": mwdcal.calibrate(tmp_path / "run.csv", silent),
    }
    for where, cal in made.items():
        text = next(finding.text for finding in cal.findings if finding.id == "settings-apart")
        assert f'State settings = "per-station" or "per-direction" in {where}.' in text
    stated = mwdcal.readings(*vectors, sd=sd, settings="per-station", **run.known)
    assert "settings-apart" not in {finding.id for finding in mwdcal.calibrate(stated).findings}


def test_a_run_file_brings_its_profile_along(tmp_path):
    tool, source = EXAMPLE / "tool.toml", EXAMPLE / "run.csv"
    run = mwdcal.read_run(source, tool)
    cal = mwdcal.calibrate(run)
    assert cal.profile.accelerometer.scale == mwdcal.load_profile(tool).accelerometer.scale == 3.0
    assert (len(cal.run_sha256), len(cal.profile_sha256)) == (64, 64)
    survey = mwdcal.read_run(EXAMPLE / "rolltest.csv", cal.profile)
    mwdcal.save(cal, tmp_path / "tool.json")
    ran = command(
        "apply", tmp_path / "tool.json", EXAMPLE / "rolltest.csv", "-o", tmp_path / "out.csv"
    )
    assert ran.code == 0
    cells = read_csv(tmp_path / "out.csv")
    written = {name: numbers(cells[name]) for name in ("azimuth_deg", "by_nt")}
    corrected = mwdcal.apply(cal, survey)
    np.testing.assert_allclose(np.degrees(corrected.azimuth), written["azimuth_deg"], rtol=1e-9)
    np.testing.assert_allclose(corrected.field[:, 1], written["by_nt"], rtol=1e-9)
    assert corrected.gravity.shape == (12, 3)


def test_columns_in_memory_are_read_like_a_file():
    from mwdcal.files.formats import table

    whole = table.read(EXAMPLE / "run.csv")
    columns = {
        name: cells if name in ("station", "group") else [float(cell) for cell in cells]
        for name, cells in whole.columns.items()
    }
    file = mwdcal.read_run(EXAMPLE / "run.csv", EXAMPLE / "tool.toml")
    memory = mwdcal.read_run(columns, EXAMPLE / "tool.toml")
    assert memory.digest == file.digest
    assert memory.station == file.station
    np.testing.assert_array_equal(memory.accelerometer, file.accelerometer)
    for name, values in file.known.items():
        np.testing.assert_array_equal(memory.known[name], values)


def test_saved_and_loaded_is_the_same(cal, tmp_path):
    path = tmp_path / "tool.json"
    mwdcal.save(cal, path)
    assert mwdcal.load(path) == cal
    assert isinstance(mwdcal.load(path), Calibration)
    assert path.read_bytes() == documents.encode(cal)
    assert b'"covariance":' in path.read_bytes()


def test_compare_takes_arrays(run):
    found = mwdcal.compare(run, order=0)
    assert "joint" in [row.method for row in found.rows]
    assert found.advice.startswith("use ")


def log(seconds=40.0, rate=50.0):
    """A simulated log: two rests with a move between them."""
    rng = np.random.default_rng(1)
    time = np.arange(int(seconds * rate)) / rate
    turn = np.clip((time - 18) / 4, 0, 1) * np.pi / 2
    vectors = {"ax": np.sin(turn), "ay": 0 * turn, "az": np.cos(turn)}
    return {"time_s": time} | {n: v + 1e-3 * rng.normal(size=len(time)) for n, v in vectors.items()}


def test_stations_of_columns_are_those_of_the_file(tmp_path):
    columns = log()
    found = mwdcal.stations(columns)
    assert found.table.count == 2
    np.savetxt(
        tmp_path / "log.csv", np.stack([*columns.values()], -1), "%.17g", ",",
        header=",".join(columns), comments="",
    )  # fmt: skip
    file = mwdcal.stations(tmp_path / "log.csv")
    np.testing.assert_array_equal(file.table.columns["ax"], found.table.columns["ax"])
    run = mwdcal.read_run(found.table)
    assert run.count == 2
    assert np.abs(np.degrees(run.accelerometer[0, 2]) - np.degrees(run.accelerometer[1, 0])) < 1


def test_noise_of_columns():
    rng = np.random.default_rng(2)
    columns = {n: rng.normal(0.1, 2e-3, 6000) for n in ("ax", "ay", "az")}
    found = mwdcal.noise(columns, sampling_hz=100.0)
    white = found.channels["ax"].terms["white"].value
    assert white == pytest.approx(2e-3 / 10, rel=0.1)


def test_pandas_columns(simulated):
    pandas = pytest.importorskip("pandas")
    a, m = columns(simulated)
    frame = pandas.DataFrame({"inc": np.degrees(simulated.known["inclination"]), "t": 25})
    axes = pandas.DataFrame(a, columns=["x", "y", "z"])
    frame.loc[3, "inc"] = None
    made = mwdcal.readings(axes, m, temperature=frame["t"], inclination_deg=frame["inc"])
    np.testing.assert_array_equal(made.accelerometer, a)
    assert np.flatnonzero(np.isnan(made.known["inclination"])).tolist() == [3]
    assert mwdcal.stations(pandas.DataFrame(log())).table.count == 2


def test_polars_columns(simulated):
    polars = pytest.importorskip("polars")
    a, m = columns(simulated)
    inclination = [None, *np.degrees(simulated.known["inclination"])[1:]]
    frame = polars.DataFrame({"inc": inclination, "t": [25] * 48})
    axes = polars.DataFrame({"x": a[:, 0], "y": a[:, 1], "z": a[:, 2]})
    made = mwdcal.readings(axes, m, temperature=frame["t"], inclination_deg=frame["inc"])
    np.testing.assert_array_equal(made.accelerometer, a)
    assert np.flatnonzero(np.isnan(made.known["inclination"])).tolist() == [0]
    assert mwdcal.stations(polars.DataFrame(log())).table.count == 2


def test_noise_by_an_unknown_deviation_is_refused():
    with pytest.raises(mwdcal.InputError, match="`kind` must be overlapping or modified"):
        mwdcal.noise(log(), kind="standard")


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_saved_run_is_read_as_it_was(tmp_path, suffix):
    """Channels in other units and axes: what is read back with the profile are the same vectors."""
    profile = mwdcal.Profile(
        name="turned",
        accelerometer=TriadProfile(axes=("+y", "-x", "+z"), scale=3.0),
        magnetometer=TriadProfile(axes=("+x", "+y", "+z"), scale=5e-5),
    )
    run = mwdcal.simulate([20, 70], 6, [0, 130], tool=TOOL, seed=5)
    path = tmp_path / f"run{suffix}"
    mwdcal.save(run, path, profile)
    again = mwdcal.read_run(path, profile)
    for name in ("accelerometer", "magnetometer", "temperature"):
        np.testing.assert_allclose(getattr(again, name), getattr(run, name), rtol=1e-12)
    for name, known in run.known.items():
        np.testing.assert_allclose(again.known[name], known, rtol=1e-12)
    assert again.metadata["simulated"]
    mwdcal.save(again, tmp_path / "again.csv")  # with the profile that it was read with
    twice = mwdcal.read_run(tmp_path / "again.csv", profile)
    np.testing.assert_allclose(twice.accelerometer, run.accelerometer, rtol=1e-12)


def test_a_run_is_saved_with_so_many_places(tmp_path):
    run = mwdcal.simulate([45], 3, [60], tool=TOOL)
    mwdcal.save(run, tmp_path / "run.csv", decimals=3)
    lines = [s for s in (tmp_path / "run.csv").read_text("utf-8").splitlines() if s[0] != "#"]
    first = dict(zip(lines[0].split(","), lines[1].split(","), strict=True))
    assert float(first["ax"]) == round(run.accelerometer[0, 0], 3)
    assert float(first["mx"]) == round(run.magnetometer[0, 0], 3)
    assert float(first["ref_inclination_deg"]) == 45.0


def test_a_simulated_tool_is_the_one_of_its_factors():
    """SF = 1 + 1e-4 (T - 30) on x alone, B = 0.01 on y: raw = SF (field + B), Moosavi's equation."""
    accelerometer, magnetometer = np.zeros((2, 30))
    for factors in (accelerometer, magnetometer):
        factors[[0, 4, 8]] = 1.0
    accelerometer[1], accelerometer[16] = 1e-4, 0.01
    run = mwdcal.simulate(
        [60], 4, [0], [50.0], tool=(accelerometer, magnetometer), noise=(0.0, 0.0), drift=10.0
    )
    np.testing.assert_allclose(run.temperature, [45.0, 50 - 5 / 3, 50 + 5 / 3, 55.0])
    toolface, inclination = run.known["toolface"], np.radians(60)
    x, y = -np.sin(inclination) * np.sin(toolface), -np.sin(inclination) * np.cos(toolface)
    expected = [(1 + 1e-4 * (run.temperature - 30)) * x, y + 0.01, np.full(4, 0.5)]
    np.testing.assert_allclose(run.accelerometer.T, expected, atol=1e-12)


def test_a_simulated_stand_is_off_by_its_uncertainty():
    """By one error for the only direction, unless the stand is set at every station."""
    angles = {"noise": (0.0, 0.0), "tool": TOOL, "seed": 8}
    exact, off, together = (
        mwdcal.simulate([60], 2000, [0], stand_deg=stand, settings=settings, **angles)
        for stand, settings in (
            ((0.0, 0.0, 0.0), None),
            ((0.1, 0.0, 0.0), "per-station"),
            ((0.1, 0.0, 0.0), "per-direction"),
        )
    )
    change, shared = (
        run.accelerometer[:, 2] - exact.accelerometer[:, 2] for run in (off, together)
    )
    assert np.std(change) == pytest.approx(np.sin(np.radians(60)) * np.radians(0.1), rel=0.1)
    assert abs(shared.mean()) > 1e-5
    assert np.std(shared) < 0.01 * abs(shared.mean())
    assert (off.known["inclination"] == exact.known["inclination"]).all()


def test_the_bundled_example_is_what_its_script_writes(tmp_path):
    folder = Path("examples/servo").resolve()
    for name in ("make.py", "tool.toml", "laboratory.toml"):
        shutil.copy(folder / name, tmp_path / name)
    subprocess.run([sys.executable, tmp_path / "make.py"], check=True, env=os.environ)
    for name in CONTENTS:
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes()


# ------------------------------------------------------------------ masks


def hidden(values, where, wrong):
    """Values with something wrong below the mask at some places, in the forms that masks come in."""
    data, mask = np.array(values, float), np.zeros(np.shape(values), bool)
    data[where], mask[where] = wrong, True
    whole = np.ma.array(data, mask=mask)
    return [whole, list(whole)] if data.ndim > 1 else [whole]


def test_a_masked_reference_is_unknown(simulated):
    known = {n: simulated.known[n] for n in ("inclination", "azimuth", "toolface")}
    raw = simulated.accelerometer, simulated.magnetometer
    for name, angles in known.items():
        (masked,) = hidden(angles, [0, 3], 1.0)
        blank = np.where(np.isin(np.arange(len(angles)), [0, 3]), np.nan, angles)
        one, other = (
            mwdcal.readings(*raw, field=48_000.0, **{**known, name: values})
            for values in (masked, blank)
        )
        np.testing.assert_array_equal(one.known[name], other.known[name])
        np.testing.assert_array_equal(np.flatnonzero(np.isnan(one.known[name])), [0, 3])


def test_a_masked_reading_is_missing(simulated):
    for place, values in enumerate((simulated.accelerometer, simulated.magnetometer)):
        for masked in hidden(values, (5, 1), 0.5):
            both = [simulated.accelerometer, simulated.magnetometer]
            both[place] = masked
            with pytest.raises(mwdcal.InputError, match="finite; got nan at station 6"):
                mwdcal.readings(*both)
    temperature = np.ma.array(np.full(simulated.count, 25.0), mask=np.arange(simulated.count) == 2)
    with pytest.raises(mwdcal.InputError, match="`temperature` .*got nan at station 3"):
        mwdcal.readings(simulated.accelerometer, temperature=temperature)


def test_readings_that_keep_a_mask_are_refused(simulated):
    for name in ("accelerometer", "temperature"):
        values = (
            np.full(simulated.count, 25.0) if name == "temperature" else getattr(simulated, name)
        )
        run = replace(simulated, **{name: hidden(values, (5,), 0.5)[0]})
        with pytest.raises(mwdcal.InputError, match=r"mask.*mwdcal\.readings"):
            mwdcal.calibrate(run)


def test_masked_labels_are_blank(simulated):
    group = np.ma.array(np.arange(simulated.count) // 12, mask=np.arange(simulated.count) < 2)
    assert mwdcal.readings(simulated.accelerometer, group=group).groups[:3].tolist() == [-1, -1, 0]


def test_masked_cells_of_a_table_are_blank():
    columns = {
        name: numbers(cells) for name, cells in read_csv(EXAMPLE / "run.csv").items() if cells
    }
    name = "ref_inclination_deg"
    (columns[name],) = hidden(columns[name], [0, 1], 90.0)
    columns["serial"] = np.ma.array(["A"] * 48, mask=np.arange(48) < 3)
    run = mwdcal.read_run(columns, EXAMPLE / "tool.toml")
    assert np.flatnonzero(np.isnan(run.known["inclination"])).tolist() == [0, 1]
    assert run.metadata["serial"] == "A"
    (columns["ax"],) = hidden(columns["ax"], [4], 0.0)
    with pytest.raises(mwdcal.InputError, match="row 5, column 'ax'"):
        mwdcal.read_run(columns, EXAMPLE / "tool.toml")


# Arrays of readings, and results in notebooks


def test_arrays_are_accepted_where_readings_are(cal, rolltest):
    a, m = columns(rolltest)
    both, warm = np.hstack([a, m]), rolltest.temperature
    whole = both if warm is None else np.hstack([both, warm[:, None]])
    for ours, theirs in zip(cal.fields(whole), cal.fields(rolltest), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(cal.fields(whole.tolist())[0], cal.fields(rolltest)[0])
    plain = mwdcal.readings(a, m, temperature=warm)
    np.testing.assert_array_equal(
        cal.uncertainty("azimuth", whole), cal.uncertainty("azimuth", plain)
    )
    for name in ("jacobian", "noise_covariance", "outside", "unrecorded"):
        np.testing.assert_array_equal(getattr(cal, name)(whole), getattr(cal, name)(plain))
    assert mwdcal.apply(cal, whole).columns.keys() == mwdcal.apply(cal, plain).columns.keys()
    assert mwdcal.diagnose(cal, whole).fault == mwdcal.diagnose(cal, plain).fault
    hidden = np.ma.array(whole, mask=np.zeros(whole.shape, bool))
    hidden[0, 0] = np.ma.masked
    assert np.isnan(cal.fields(hidden)[0][0]).all()
    with pytest.raises(mwdcal.InputError, match="must be finite; got nan at station 1"):
        mwdcal.apply(cal, hidden)


def test_a_file_and_columns_are_accepted_where_readings_are(tmp_path):
    whole = mwdcal.read_run(EXAMPLE / "rolltest.csv", "servo")
    cal = mwdcal.calibrate(EXAMPLE / "run.csv", EXAMPLE / "tool.toml")
    by_file = mwdcal.apply(cal, EXAMPLE / "rolltest.csv")
    table = {name: whole.columns[name] for name in ("ax", "ay", "az", "mx", "my", "mz")}
    table["temperature_c"] = whole.columns["temperature_c"]
    by_columns = mwdcal.apply(cal, table)
    np.testing.assert_array_equal(by_file.inclination, by_columns.inclination)
    assert mwdcal.verify(cal, EXAMPLE / "rolltest.csv").passed


def test_results_show_themselves_in_notebooks(cal, rolltest):
    corrected = mwdcal.apply(cal, rolltest)
    shown = corrected._repr_html_()
    assert f"{rolltest.count} rows corrected" in shown
    assert "<td>inclination_deg</td>" in shown
    assert len(repr(corrected)) < 300
    assert len(corrected.to_dict()["columns"]["gx_g"]) == rolltest.count
    for result in (cal, rolltest, mwdcal.verify(cal, rolltest), mwdcal.diagnose(cal, rolltest)):
        assert result._repr_html_().startswith("<")


@pytest.mark.parametrize("name", [name for name in mwdcal.__all__ if name.islower()])
def test_keywords_are_typed(name):
    """An editor completes them, and a type checker finds a misspelt one."""
    function = getattr(mwdcal, name)
    for way in typing.get_overloads(function) or [function]:
        for argument in inspect.signature(way).parameters.values():
            if argument.kind is inspect.Parameter.VAR_KEYWORD:
                assert "Unpack" in str(argument.annotation)


@pytest.mark.parametrize("plan", [(), ("moosavi-12", "servo")])
@pytest.mark.parametrize("seed", ["a", -1, 1.5])
def test_a_seed_is_a_whole_number(plan, seed):
    with pytest.raises(mwdcal.InputError, match="`seed` must be a whole number"):
        mwdcal.simulate(*plan, seed=seed)


def test_the_changelog_begins_with_the_version():
    text = (EXAMPLE.parents[1] / "CHANGELOG.md").read_text("utf-8")
    dated = re.findall(r"^## \[(\d+\.\d+\.\d+)\] – (\d{4}-\d\d-\d\d)$", text, re.MULTILINE)
    cited = (EXAMPLE.parents[1] / "CITATION.cff").read_text("utf-8")
    assert dated[0][0] == mwdcal.__version__
    assert f"date-released: {dated[0][1]}\n" in cited
    assert len(text.splitlines()) <= 120


def test_readings_without_a_file_and_a_serial_have_a_name_in_every_message(cal, rolltest, run):
    """No brackets or words around a blank; the remedy is one that arrays have."""
    said = {finding.id: finding.text for finding in cal.findings}["no-serial"]
    assert 'in Python by metadata={"serial": "MWD-17"}' in said
    raw = {name: [float(3 * k + i) for i in range(12)] for k, name in enumerate(("ax", "ay", "az"))}
    raw |= {name: [0.5, -0.5] * 6 for name in ("mx", "my", "mz")}
    with pytest.raises(mwdcal.InputError, match="The calibration of unnamed readings is for"):
        mwdcal.apply(cal, raw)
    verdict, named = mwdcal.verify(cal, rolltest), "unnamed readings"
    assert verdict.summary().startswith(f"PASS   {named}   12 stations")
    assert f"run {named}" in mwdcal.convert(cal, "factors").summary()
    assert cal.summary().startswith(f"{named}   nominal   48 stations")
    certificate = mwdcal.certificate(cal, verification=verdict)
    assert f"as left   {named}   limits" in certificate.summary()
    blank = mwdcal.calibrate(replace(run, metadata={"serial": " "}))
    assert blank.glance()["tool"].startswith("nominal")
