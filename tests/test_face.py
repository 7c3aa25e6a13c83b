"""What `import mwdcal` offers for each command, and that its results say what the commands print."""

import datetime
import json
import re
from hashlib import sha256
from pathlib import Path

import msgspec
import numpy as np
import pytest

import mwdcal
from cli_support import EXAMPLE, RAW, servo_run, write_csv
from cli_support import mwdcal as command
from mwdcal.app.cli import SECTIONS, cli
from mwdcal.calibration.methods import EVIDENCE
from mwdcal.library.tasks import table_in_memory

PROFILE = EXAMPLE / "tool.toml"
ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """The example's calibration, its file and what the command printed."""
    folder = tmp_path_factory.mktemp("face")
    path = folder / "tool.json"
    done = command("calibrate", EXAMPLE / "run.csv", "--tool", PROFILE, "-o", path)
    assert done.code == 0
    run = mwdcal.read_run(EXAMPLE / "run.csv", PROFILE)
    return mwdcal.calibrate(run), path, done


def without_files(text):
    """A screen without its last lines, that name files and what comes next."""
    return re.sub(r"\n+wrote (.|\n)*$", "", text.rstrip())


def same(ours, theirs, but=()):
    """Equal documents, but for what a file alone has."""
    left = {key: value for key, value in ours.items() if key not in but}
    right = {key: value for key, value in theirs.items() if key not in but}
    assert json.loads(json.dumps(left, default=str)) == right


@pytest.mark.usefixtures("without_pictures")
def test_a_calibration_says_what_the_command_prints(calibrated, tmp_path):
    made, path, done = calibrated
    assert made.summary() == without_files(done.out)
    printed = command(
        "calibrate", EXAMPLE / "run.csv", "--tool", PROFILE, "-o", path, "--json"
    ).json
    same(made.to_dict(), printed, ("calibration", "report", "nonlinearity"))
    made.report(tmp_path / "tool.html")
    assert "<html" in (tmp_path / "tool.html").read_text("utf-8")


def test_a_verdict_and_a_diagnosis_say_what_the_commands_print(calibrated):
    _, path, _ = calibrated
    made = mwdcal.load(path)
    test = mwdcal.read_run(EXAMPLE / "rolltest.csv", made.profile)
    for result, name in (
        (mwdcal.verify(made, test), "verify"),
        (mwdcal.diagnose(made, test), "diagnose"),
    ):
        shown = command(name, path, EXAMPLE / "rolltest.csv").out.rstrip()
        assert result.summary() == shown
        printed = command(name, path, EXAMPLE / "rolltest.csv", "--json").json
        same(result.to_dict(), printed, ("calibration_signature",))


def test_a_verdict_has_the_corrected_roll_test_as_columns(calibrated):
    made, *_ = calibrated
    verdict = mwdcal.verify(made, EXAMPLE / "rolltest.csv")
    corrected = mwdcal.apply(made, EXAMPLE / "rolltest.csv")
    for name, values in corrected.columns.items():
        np.testing.assert_array_equal(verdict.columns[name], values)
    assert verdict.columns["sd_azimuth_deg"].min() > 0
    shown = [row.azimuth_deg for row in verdict.station_rows]
    np.testing.assert_allclose(verdict.columns["azimuth_deg"], shown)
    pytest.importorskip("pandas")
    assert verdict.to_pandas().equals(corrected.to_pandas())
    with pytest.raises(mwdcal.InputError, match="read from a file has no columns"):
        _ = msgspec.structs.replace(verdict).columns


def test_a_verdict_has_its_limits_as_a_table(calibrated):
    """Printed by pandas, no column is left out in 80 columns, and no text is cut."""
    pandas = pytest.importorskip("pandas")
    made, *_ = calibrated
    verdict = mwdcal.verify(made, EXAMPLE / "rolltest.csv")
    table = msgspec.structs.replace(verdict).to_pandas("limits")  # of one read from a file too
    for row, shown in zip(verdict.rows, table.itertuples(index=False), strict=True):
        expected = (row.name, row.raw, row.value, shown.U, row.limit, row.unit, "pass")
        assert tuple(shown) == expected
        assert pytest.approx(2 * row.uncertainty) == shown.U  # the noise is declared
        rest = {name: values[row.name] for name, values in table.attrs.items()}
        assert rest == {"sd": row.uncertainty, "degrees_of_freedom": np.inf, "where": row.note}
    assert table.columns[3:].tolist() == ["U", "limit", "unit", "verdict"]
    with pandas.option_context("display.width", 80, "display.max_columns", 0):
        assert "..." not in str(table)
    part = mwdcal.read_run(EXAMPLE / "rolltest.csv", made.profile).select(np.arange(12) < 4)
    open_ones = mwdcal.verify(made, part).to_pandas("limits")
    assert open_ones[["value", "U"]].isna().all(axis=None)
    assert np.isnan([*open_ones.attrs["degrees_of_freedom"].values()]).all()
    assert (open_ones["verdict"] == "FAIL").all()
    with pytest.raises(mwdcal.InputError, match="`rows` must be stations or limits; got 'limit'"):
        verdict.to_pandas("limit")


@pytest.mark.usefixtures("without_pictures")
def test_pages_of_a_verdict_and_a_diagnosis_are_those_of_the_commands(calibrated, tmp_path):
    _, path, _ = calibrated
    made = mwdcal.load(path)
    test = mwdcal.read_run(EXAMPLE / "rolltest.csv", made.profile)
    ours, theirs = tmp_path / "ours.html", tmp_path / "theirs.html"
    for result in (mwdcal.verify(made, test), mwdcal.diagnose(made, test)):
        name = "verify" if hasattr(result, "passed") else "diagnose"
        result.report(ours)
        command(name, path, EXAMPLE / "rolltest.csv", "--report", theirs)
        page = theirs.read_text("utf-8")
        if name == "verify":  # the command knows the file, which its next step names
            assert f"mwdcal certificate {path.name} --verification" in page
            for step in ("verify", "certificate"):
                page = page.replace(f"mwdcal {step} {path.name}", f"mwdcal {step} CAL.json")
        assert ours.read_text("utf-8") == page
        assert "<h1>SIM-0001</h1>" in ours.read_text("utf-8")


@pytest.mark.usefixtures("without_pictures")
def test_a_comparison_and_logs_say_what_the_commands_print(tmp_path):
    run = mwdcal.read_run(EXAMPLE / "run.csv", PROFILE)
    found = mwdcal.compare(run)
    assert len(repr(found)) <= 300
    printed = command("compare", EXAMPLE / "run.csv", "--tool", PROFILE).out.rstrip()
    pairs = zip(found.summary().splitlines(), printed.splitlines(), strict=True)
    other = [(ours, theirs) for ours, theirs in pairs if ours != theirs]  # seconds that they took
    assert len(other) <= 1
    assert all(re.sub(r"[\d.\s]", "", a) == re.sub(r"[\d.\s]", "", b) for a, b in other)
    noise = mwdcal.noise(EXAMPLE / "static.csv")
    assert noise.summary() == command("noise", EXAMPLE / "static.csv").out.rstrip()
    same(noise.to_dict(), command("noise", EXAMPLE / "static.csv", "--json").json)
    log = mwdcal.stations(EXAMPLE / "log.csv")
    done = command("stations", EXAMPLE / "log.csv", "-o", tmp_path / "run.csv")
    assert log.summary() == without_files(done.out)
    for result in (found, noise, log):
        result.report(tmp_path / "page.html")
        assert "<pre>" in result._repr_html_()


def test_readings_have_the_columns_of_their_table_and_parts():
    run = mwdcal.read_run(EXAMPLE / "run.csv", PROFILE)
    assert len(run) == run.count == len(run.columns["ax"])
    assert {"ref_inclination_deg", "temperature_c"} <= run.columns.keys()
    some = run[3:9:2]
    assert len(some) == 3
    assert some.columns["ax"].tolist() == run.columns["ax"][3:9:2].tolist()
    assert some.station == run.station[3:9:2]
    assert run[::-1].accelerometer.tolist() == run.accelerometer[::-1].tolist()
    made = mwdcal.simulate((20, 70), 4, seed=3)
    assert len(made.columns["mx"]) == 8
    frame = made.to_pandas()
    assert list(frame) == list(made.columns)
    assert "simulated" in frame.attrs
    assert np.allclose(frame[["ax", "ay", "az"]], made.accelerometer)


def test_verdicts_and_diagnoses_are_written_as_they_are_printed(calibrated, tmp_path):
    _, path, _ = calibrated
    for name in ("verify", "diagnose"):
        words = (name, path, EXAMPLE / "rolltest.csv")
        command(*words, "-o", tmp_path / f"{name}.json")
        written = json.loads((tmp_path / f"{name}.json").read_text("utf-8"))
        assert written == command(*words, "--json").json


def test_verify_says_what_its_third_argument_is(calibrated):
    with pytest.raises(
        mwdcal.InputError, match="`limits` must be the name .* got Profile. Leave it out"
    ):
        mwdcal.verify(calibrated[0], EXAMPLE / "rolltest.csv", mwdcal.Profile(name="x"))


@pytest.mark.parametrize("kind", ["plans", "profiles", "limits", "methods"])
def test_all_that_is_built_in_is_listed(kind):
    shown, listed = command("list", kind), command("list", kind, "--json").json["entries"]
    assert shown.code == 0
    names = [entry["name"] for entry in listed]
    folder = Path(mwdcal.__file__).parent / kind
    wanted = {file.stem for file in folder.glob("*.toml")} if kind != "methods" else {*EVIDENCE}
    assert wanted <= set(names)
    assert all(entry["what"] and entry["name"] in shown.out for entry in listed)


def test_the_help_shows_every_command_once():
    shown = command("--help").out
    assert sorted(name for names in SECTIONS.values() for name in names) == sorted(cli.commands)
    for name in cli.commands:
        assert len(re.findall(rf"^  {name} ", shown, re.M)) == 1


def test_the_documented_table_has_every_command_and_function():
    """What `docs/howto/python.md` promises is all there, and nothing is left out of it."""
    text = (ROOT / "docs" / "howto" / "python.md").read_text("utf-8")
    rows = re.findall(r"^\| `(\w+)` \| (`mwdcal\.[^|]*) \|$", text, re.M)
    named = {name for _, functions in rows for name in re.findall(r"`mwdcal\.(\w+)`", functions)}
    assert {name for name, _ in rows} == {*cli.commands} - {
        *("bench", "completion", "example", "init", "list")
    }
    assert named <= {*mwdcal.__all__}
    helpers = {"load", "load_profile", "read_run", "readings", "save"}
    assert {n for n in mwdcal.__all__ if n.islower()} - named == helpers


def test_a_calibration_takes_no_table_by_the_place_of_its_columns(calibrated):
    """Else the fields would silently be those of other columns."""
    made, _, _ = calibrated
    names = ["mz", "my", "mx", "az", "ay", "ax"]
    for table in (
        pytest.importorskip("pandas").DataFrame(np.ones((2, 6)), columns=names),
        {name: [1.0, 1.0] for name in names},
    ):
        for ask in (made.fields, lambda t: made.uncertainty("azimuth", t)):
            with pytest.raises(mwdcal.InputError, match=r"mwdcal\.read_run\(table, cal\.profile\)"):
                ask(table)


def test_a_calibration_may_be_its_file(calibrated, tmp_path):
    made, _, _ = calibrated
    mwdcal.save(made, tmp_path / "tool.json")
    roll = mwdcal.simulate([45], 12, [60], tool=4, seed=3)
    for task in (mwdcal.apply, mwdcal.verify, mwdcal.diagnose):
        assert task(tmp_path / "tool.json", roll).to_dict() == task(made, roll).to_dict()
        with pytest.raises(mwdcal.InputError, match="`calibration` must be a calibration or its f"):
            task(3, roll)


def test_a_previous_calibration_is_named_by_its_digest(tmp_path):
    path = tmp_path / "previous.json"
    mwdcal.save(mwdcal.calibrate(mwdcal.simulate(tool=4, seed=1)), path)
    again = mwdcal.calibrate(mwdcal.simulate(tool=4, seed=2), prior=mwdcal.load(path))
    assert again.prior_sha256 == sha256(path.read_bytes()).hexdigest()


def test_arrays_in_another_unit_are_refused_by_theirs(calibrated):
    """Raw readings, which the unit of the calibration's run would explain, are no arrays."""
    made, _, _ = calibrated
    roll = mwdcal.simulate([45], 12, [60], tool=4, seed=3)
    arrays = np.hstack([roll.accelerometer, roll.magnetometer / 1000])
    with pytest.raises(mwdcal.InputError, match="Arrays are in nT; give"):
        mwdcal.apply(made, arrays)


def test_stations_left_out_may_be_given_as_numbers():
    run = mwdcal.simulate(tool=4, seed=1)
    for exclude, left in ((3, ["3"]), ([3, 4], ["3", "4"]), ("34", ["34"])):
        assert mwdcal.calibrate(run, exclude=exclude).excluded == left
    with pytest.raises(mwdcal.InputError, match="no such station in the readings; .*by itself"):
        mwdcal.calibrate(run, exclude="8,21")


def test_a_header_of_two_rows_in_pandas_is_one_name(tmp_path):
    pandas = pytest.importorskip("pandas")
    path = tmp_path / "run.csv"
    path.write_text("Gx,Note\nV,\n1.5,a\n2.5,b\n")
    frame = pandas.read_csv(path, header=[0, 1])
    assert [*table_in_memory(frame, "run").columns] == ["Gx V", "Note"]


def test_a_column_that_is_no_number_is_text_and_refused_only_where_it_is_needed(calibrated):
    made, *_ = calibrated
    run = mwdcal.read_run(EXAMPLE / "run.csv", PROFILE)
    table, count = {**run.columns}, len(run)
    seconds = np.arange(count).astype("m8[s]")
    moments = np.datetime64("2026-01-31T10:00") + seconds
    moments[1] = np.datetime64("NaT")
    beside = {
        "Time": moments.astype("M8[ns]"),
        "Day": moments.astype("M8[D]"),
        "Clock": [moment.time() for moment in (moments[:1].tolist() * count)],
        "Since": seconds,
        "Good": np.ones(count, bool),
        "Trace": [np.ones(3)] * count,
    }
    read = mwdcal.read_run({**table, **beside}, PROFILE).columns
    assert read["Time"].tolist()[:3] == ["2026-01-31T10:00:00", "", "2026-01-31T10:00:02"]
    assert read["Day"].tolist()[:2] == ["2026-01-31", ""]
    assert [read[n][1] for n in ("Clock", "Since", "Good")] == ["10:00:00", "0:00:01", "true"]
    (unused,) = mwdcal.calibrate({**table, **beside}, PROFILE).findings[:1]
    others = [name for name in beside if name not in ("Time", "Day")]  # these say the day
    assert unused.text == f"columns not used: {', '.join(map(repr, others))}."
    for task in (mwdcal.apply, mwdcal.survey):
        assert np.isfinite(task(made, {**table, **beside}).columns["inclination_deg"]).all()
    with pytest.raises(mwdcal.InputError, match=r"row 1, column 'ax': expected a number; .*Write"):
        mwdcal.read_run({**table, "ax": beside["Time"]}, PROFILE)


@pytest.mark.parametrize("library", ["pandas", "polars"])
def test_a_profile_of_a_table_in_memory_is_that_of_its_file(library, tmp_path):
    """Names with blanks too many, and times as times: as the same table as CSV."""
    tables = pytest.importorskip(library)
    run = servo_run()
    dates = [datetime.datetime(2026, 3, 5, 8, 0) + datetime.timedelta(minutes=k) for k in range(48)]
    named = {
        "Pos": run["station"], "Time": dates, "Inc  (deg)": run["ref_inclination_deg"],
        "Azi ": run["ref_azimuth_deg"], "TF": run["ref_toolface_deg"], "Btotal (nT)": run["ref_field_nt"],
        **{f"{'GH'[n > 2]}{'xyz'[n % 3]} (V)": run[name] for n, name in enumerate(RAW)},
    }  # fmt: skip
    cells = {name: [*map(str, column)] for name, column in named.items()}
    path = write_csv(tmp_path / "a.csv", cells)
    table = tables.DataFrame(named)
    of_file, of_table = mwdcal.propose_profile(path), mwdcal.propose_profile(table)
    for part in ("columns", "accelerometer", "magnetometer", "stand"):
        assert getattr(of_file.profile, part) == getattr(of_table.profile, part)
    assert of_file.findings == of_table.findings
    assert "delimiter" not in of_table.summary()
    one, two = mwdcal.calibrate(path, of_file.profile), mwdcal.calibrate(table, of_table.profile)
    assert (one.accelerometer, one.magnetometer) == (two.accelerometer, two.magnetometer)
    of_table.save(tmp_path / "tool.toml")
    three = mwdcal.calibrate(path, tmp_path / "tool.toml")
    assert (one.accelerometer, one.magnetometer) == (three.accelerometer, three.magnetometer)


def test_names_that_differ_in_blanks_only_stay_two_columns():
    table = table_in_memory({"Note": ["a"], "Note ": ["b"], "ax": [1.0]}, "run")
    assert [*table.columns] == ["Note", "Note (2)", "ax"]


def test_units_below_the_names_of_a_table_in_memory_are_its_columns_units():
    pandas = pytest.importorskip("pandas")
    columns = {name.split(" (")[0]: cells for name, cells in own_names().items()}
    units = {name: name.split("(")[1].strip(")") if "(" in name else "" for name in own_names()}
    below = {name.split(" (")[0]: [unit] for name, unit in units.items()}
    table = pandas.concat([pandas.DataFrame(below), pandas.DataFrame(columns)])
    profile = mwdcal.propose_profile(table).profile
    assert {each.name: each.unit for each in profile.columns.values()} == {
        "Pos": "", "Gx": "V", "Gy": "V", "Gz": "V", "Inc": "°", "TF": "°",
    }  # fmt: skip
    named = mwdcal.calibrate(own_names(), mwdcal.propose_profile(own_names()).profile)
    assert mwdcal.calibrate(table, profile).accelerometer == named.accelerometer


def own_names():
    """A run of accelerometers under the names of a laboratory, with units in them."""
    run = servo_run()
    return {
        "Pos": run["station"], "Inc (deg)": run["ref_inclination_deg"], "TF (deg)": run["ref_toolface_deg"],
        **{f"G{axis} (V)": run[f"a{axis}"] for axis in "xyz"},
    }  # fmt: skip


def test_a_row_of_units_below_the_names_in_pandas_is_no_station(tmp_path):
    pandas = pytest.importorskip("pandas")
    path = tmp_path / "run.csv"
    path.write_text("Gx,Gy,MD,Note\nV,V,m,\n1.5,0.5,10,a\n2.5,0.25,20,b\n")
    table = table_in_memory(pandas.read_csv(path), "run")
    assert table.units == {"Gx": "V", "Gy": "V", "MD": "m"}
    assert [*table.columns["Gx"]] == ["1.5", "2.5"]
    assert [*table.lines] == [1, 2]
