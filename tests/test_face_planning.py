"""Plans, simulations and proposed profiles from Python: the same text, document and files as those of the command."""

from __future__ import annotations

import json
import re
import typing
from dataclasses import replace

import numpy as np
import pytest

import mwdcal
from cli_support import EXAMPLE, numbers, read_csv, refused, servo_run, write_csv
from cli_support import mwdcal as command
from mwdcal.calibration.options import FitChoices, Options, SeedlessFitChoices
from mwdcal.files.formats import table as tables
from mwdcal.library.results import LONGEST_LINE
from mwdcal.planning import procedure

LARGE = {"stations": 24, "plan": "candidates", "reach": {"inclination": (0, 90)}, "criterion": "D"}
pytestmark = pytest.mark.usefixtures("computed_once")
PLANS = {
    "built in": ({"plan": "moosavi-12"}, ("--plan", "moosavi-12")),
    "default": ({}, ()),
    "side by side": (
        {"plan": ["six-state", "twelve-state"]},
        ("--plan", "six-state", "--plan", "twelve-state"),
    ),
    "best": (LARGE, ("--stations", 24, "--plan", "candidates", "--reach", "inclination_deg=0:90", "--criterion", "D")),
    "accurate": ({"accuracy_deg": {"azimuth": 0.1}}, ("--accuracy", "azimuth_deg=0.1")),
    "stand": (
        {"plan": "laboratory-thermal", "speed": 2.0, "settle": 60, "soak": 120.0, "order": 1},
        ("--plan", "laboratory-thermal", "--speed", 2, "--settle", 60, "--soak", 120, "--order", 1),
    ),
    "fit": (
        {"plan": "moosavi-12", "parameters": 9, "ignore": ("dip",), "prior": "datasheet"},
        ("--plan", "moosavi-12", "--parameters", 9, "--ignore", "dip", "--prior", "datasheet"),
    ),
    "measured": (
        {"stations": 4, "measured": EXAMPLE / "run.csv"},
        ("--stations", 4, "--measured", EXAMPLE / "run.csv"),
    ),
}  # fmt: skip


def same(result, ran, as_json):
    """Whether a result prints, on both streams, what a command has printed."""
    assert ran.code == as_json.code == 0, ran
    assert ran.out == result.summary() + "\n"
    assert as_json.json == json.loads(json.dumps(result.to_dict()))
    assert list(as_json.json) == list(result.to_dict())
    shown = [line.removeprefix("! ") for line in ran.err.splitlines()]
    assert len(shown) == len(result.findings)
    for line, finding in zip(shown, result.findings, strict=True):
        assert line.split()[0] == finding.text.split()[0]
    assert len(repr(result)) <= LONGEST_LINE
    assert result._repr_html_()
    return True


@pytest.mark.parametrize("name", PLANS)
def test_a_plan_is_that_of_the_command(name):
    keywords, typed = PLANS[name]
    result = mwdcal.plan("servo", **keywords)
    line = ("plan", "--tool", "servo", *typed)
    assert same(result, command(*line), command(*line, "--json"))
    assert result.accuracy_deg == result.to_dict()["accuracy_deg"]


def test_a_plan_is_written_as_by_the_command(tmp_path):
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    ours.mkdir()
    theirs.mkdir()
    line = ("plan", "--stations", 24, "--tool", "servo")
    result = mwdcal.plan(mwdcal.load_profile("servo"), stations=24)
    result.save(ours / "plan.csv")
    result.report(ours / "sheet.html")
    ran = command(*line, "-o", theirs / "plan.csv", "--report", theirs / "sheet.html")
    for name in ("plan.csv", "sheet.html"):
        assert (ours / name).read_bytes() == (theirs / name).read_bytes()
    assert ran.out == result.summary().replace(str(ours), str(theirs)) + "\n"
    assert result.to_dict()["output"] == str(ours / "plan.csv")
    sheet = read_csv(theirs / "plan.csv")
    for name, values in result.columns.items():
        if name != "station":
            np.testing.assert_array_equal(values, numbers(sheet[name]))
    assert result.columns["station"].tolist() == sheet["station"]


def test_plans_from_files_columns_and_results_are_one():
    columns = mwdcal.plan("servo", plan="moosavi-12").columns
    plain = {name: values for name, values in columns.items() if name != "station"}
    whole, again = mwdcal.plan("servo", plan=columns), mwdcal.plan("servo", plan=plain)
    chained = mwdcal.plan("servo", plan=mwdcal.plan("servo", plan="moosavi-12"))
    assert whole.accuracy_deg == again.accuracy_deg == chained.accuracy_deg
    pandas = pytest.importorskip("pandas")
    framed = mwdcal.plan("servo", plan=pandas.DataFrame(columns))
    assert framed.accuracy_deg == whole.accuracy_deg
    assert framed.to_pandas()["ref_toolface_deg"].tolist() == columns["ref_toolface_deg"].tolist()


def test_measured_stations_are_a_file_a_table_or_readings():
    profile = mwdcal.load_profile("servo")
    path = EXAMPLE / "run.csv"
    given = (path, tables.read(path), mwdcal.read_run(path, profile))
    first, *others = (mwdcal.plan(profile, stations=3, measured=each).columns for each in given)
    for other in others:
        for name, values in first.items():
            if name != "station":
                np.testing.assert_allclose(
                    values.astype(float), other[name].astype(float), rtol=1e-12
                )


@pytest.mark.parametrize("seed", [0, 1])
def test_a_run_is_that_of_the_command(tmp_path, seed):
    run, truth = tmp_path / "run.csv", tmp_path / "truth.json"
    line = ("simulate", "--plan", "moosavi-12", "--tool", "servo", "--seed", seed)
    ran = command(*line, "-o", run, "--truth", truth)
    result = mwdcal.simulate("moosavi-12", "servo", seed=seed)
    read = mwdcal.read_run(run, "servo")
    for name in ("accelerometer", "magnetometer", "temperature"):
        np.testing.assert_array_equal(getattr(result, name), getattr(read, name))
    for name, values in read.known.items():
        np.testing.assert_array_equal(result.known[name], values)
    for name in ("digest", "metadata", "profile", "profile_sha256", "station"):
        assert getattr(result, name) == getattr(read, name)
    written = json.loads(truth.read_text("utf-8"))
    nowhere = {**written, "output": "", "truth": ""}
    assert result.truth == result.to_dict() == nowhere

    before = run.read_bytes(), truth.read_bytes()
    result.save(run, truth)
    assert before == (run.read_bytes(), truth.read_bytes())
    assert same(result, ran, command(*line, "-o", run, "--truth", truth, "--json"))
    for name, values in result.columns.items():
        if values.dtype.kind == "f":
            np.testing.assert_array_equal(values, numbers(read_csv(run)[name]))


def test_a_simulated_run_is_calibrated_as_its_file(tmp_path):
    plan = mwdcal.plan("servo", plan="twenty-four-state")
    result = mwdcal.simulate(plan, "servo", seed=1)
    mwdcal.save(result, tmp_path / "saved.csv")
    result.save(tmp_path / "run.csv")
    files = [mwdcal.read_run(tmp_path / name, "servo") for name in ("saved.csv", "run.csv")]
    first, *others = (mwdcal.calibrate(run).accelerometer.parameters for run in (result, *files))
    for other in others:
        np.testing.assert_allclose(first, other, rtol=1e-9, atol=1e-12)
    assert isinstance(result, mwdcal.Readings)
    assert len(repr(result)) <= LONGEST_LINE
    assert result.findings == []


def test_the_tool_of_a_calibration(tmp_path):
    run = mwdcal.simulate("twenty-four-state", seed=3)
    calibration = mwdcal.calibrate(run)
    path = tmp_path / "tool.json"
    mwdcal.save(calibration, path)
    line = ("simulate", "--plan", "roll-test", "--calibration", path, "-o", tmp_path / "roll.csv")
    document = command(*line, "--json").json
    of_file = mwdcal.simulate("roll-test", calibration=path)
    assert of_file.truth == {**document, "output": ""}
    np.testing.assert_allclose(
        mwdcal.simulate("roll-test", calibration=calibration).accelerometer,
        of_file.accelerometer,
        rtol=1e-9,
    )


def run_at_70():
    """A simulated run of 24 stations at a dip of 70°."""
    attitudes = mwdcal.plan("servo").columns
    return mwdcal.simulate({**attitudes, "ref_dip_deg": np.full(24, 70.0)}, seed=3)


def test_a_plan_is_at_the_place_of_the_calibration_unless_it_states_one():
    """The plan predicts at the dip that the run estimated, near the true 70°; it states it as no reference."""
    run = run_at_70()
    known = {"field": np.full(len(run), 51_000.0), "gravity": np.full(len(run), 0.998)}
    angles = {name: run.known[name] for name in ("inclination", "azimuth", "toolface")}
    place = mwdcal.calibrate(replace(run, known=angles | known))
    for made in (mwdcal.plan(place), mwdcal.plan(place, stations=12)):
        columns = made.columns
        assert set(columns["ref_field_nt"]) == {51_000.0}
        assert set(columns["ref_gravity_g"]) == {0.998}
        assert np.isnan(columns.get("ref_dip_deg", [np.nan])).all()
        shown = made.summary()
        assert "\nplace, from the calibration: field 51,000 nT, gravity 0.998 g\n" in shown
        dip = float(re.search(r"place, estimated by the calibration: dip (\S+)°\n", shown)[1])
        assert abs(dip - 70) < 0.1
    stated = {**mwdcal.plan(place).columns, "ref_field_nt": np.full(24, 45_000.0)}
    other = mwdcal.plan(place, plan=stated)
    assert set(other.columns["ref_field_nt"]) == {45_000.0}
    assert "\nplace: field 45,000 nT\nplace, estimated by" in other.summary()


@pytest.mark.parametrize("run", [None, "measured"])
def test_a_plan_is_as_accurate_as_at_the_dip_that_the_calibration_estimated(run):
    """As one of the same profile that states this dip."""
    bare = {name: cells for name, cells in run_at_70().columns.items() if name != "ref_dip_deg"}
    place = mwdcal.calibrate(bare, "servo")
    [dip] = [constant.value for constant in place.constants]
    stated = {**bare, "ref_dip_deg": np.full(24, dip)}
    if run:
        made = mwdcal.plan(place, measured=bare, stations=2)
        same = mwdcal.plan("servo", measured=stated, stations=2)
        assert same.accuracy_deg != mwdcal.plan("servo", measured=bare, stations=2).accuracy_deg
    else:
        made, same = mwdcal.plan(place), mwdcal.plan("servo", plan=stated)
        assert same.accuracy_deg != mwdcal.plan("servo").accuracy_deg
    assert made.accuracy_deg == pytest.approx(same.accuracy_deg, rel=1e-6)


def test_what_has_a_profile_is_taken_for_it():
    table = EXAMPLE / "export.csv"
    proposed = mwdcal.propose_profile(table)
    stand = proposed.profile.with_stand(inclination_deg=0.01, settings="per-station").stand
    assert (stand.inclination_deg, stand.azimuth_deg, stand.practice) == (0.01, 0.0, "per-station")
    for profile in (proposed, mwdcal.calibrate(table, proposed)):
        assert (
            mwdcal.calibrate(table, profile).profile
            == mwdcal.calibrate(table, proposed.profile).profile
        )
    with pytest.raises(mwdcal.InputError, match="`profile` must be a tool profile.*got int"):
        mwdcal.read_run(table, 3)


def test_a_procedure_is_that_of_the_command(tmp_path, monkeypatch):
    monkeypatch.setattr(procedure, "TOOLS_AT_ONCE", 3)
    output = tmp_path / "tools.parquet"
    line = ("simulate", "--plan", "moosavi-12", "--tool", "servo", "--seed", 1, "--repeat", 5)
    line = (*line, "--workers", 1, "-o", output)
    ran, steps = command(*line), []
    many = mwdcal.simulate(
        "moosavi-12", "servo", seed=1, repeat=5, progress=lambda *each: steps.append(each)
    )
    assert steps == [(1, 2), (2, 2)]
    before = output.read_bytes()
    many.save(output)
    assert before == output.read_bytes()
    assert same(many, ran, command(*line, "--json"))
    read = tables.read(output)
    assert [*many.columns] == [*read.columns]
    risk = many.to_dict()["repetition"]
    assert many.risk["wrong_pass"].count == risk["wrong_pass"]["count"]
    assert many.risk["wrong_fail"].high == risk["wrong_fail"]["high"]
    backwards = mwdcal.simulate(
        "moosavi-12", "servo", seed=1, repeat=5, mapper=lambda f, parts: [f(p) for p in parts[::-1]][::-1]
    )  # fmt: skip
    np.testing.assert_array_equal(many.columns["passed"], backwards.columns["passed"])


@pytest.mark.parametrize(
    "wanted", [{"accuracy_deg": {"azimuth": 0.1}}, {"stations": 8}, {"plan": "six-state"}]
)
def test_a_plan_tells_the_share_that_is_done(wanted):
    steps = []
    mwdcal.plan("servo", **wanted, progress=lambda *each: steps.append(each))
    assert steps == sorted(steps)
    assert all(0 <= done <= total for done, total in steps)
    assert "plan" in wanted or len({done for done, _ in steps}) > 1


def test_a_procedure_takes_options_of_the_fit_and_says_no_more_than_it_wrote(tmp_path):
    line = ("simulate", "--plan", "moosavi-12", "--repeat", 3, "--method", "least-squares")
    ran = command(*line, "--limits", "moradi", "-o", tmp_path / "tools.csv")
    many = mwdcal.simulate("moosavi-12", repeat=3, method="least-squares", limits="moradi")
    text = many.summary()
    assert "wrote" not in text
    assert ran.out.startswith(text + "\n")


@pytest.mark.parametrize("name", ["run.csv", "export.csv"])
def test_a_proposed_profile_is_that_of_the_command(tmp_path, name):
    table = EXAMPLE / name
    line = ("profile", table, "-o", tmp_path / "tool.toml")
    ran = command(*line)
    result = mwdcal.propose_profile(table)
    assert "wrote" not in result.summary()
    assert (tmp_path / "tool.toml").read_text("utf-8") == result.to_toml()
    result.save(tmp_path / "tool.toml")
    assert same(result, ran, command(*line, "--json"))
    assert isinstance(result.profile, mwdcal.Profile)
    read = [mwdcal.read_run(table, each) for each in (result.profile, tmp_path / "tool.toml")]
    np.testing.assert_array_equal(read[0].accelerometer, read[1].accelerometer)
    assert mwdcal.calibrate(read[0], order=0).accelerometer.rank == 12
    with pytest.raises(mwdcal.InputError, match="a ProposedProfile has no page"):
        result.report(tmp_path / "page.html")


def test_keywords_of_the_fit_are_the_attributes_of_options():
    assert typing.get_type_hints(FitChoices) == typing.get_type_hints(Options)
    assert FitChoices.__total__ is False
    seedless = typing.get_type_hints(SeedlessFitChoices)
    assert seedless == {k: v for k, v in typing.get_type_hints(Options).items() if k != "seed"}
    assert "Unpack[FitChoices]" in str(mwdcal.plan.__annotations__["choices"])
    ways = typing.get_overloads(mwdcal.simulate)
    assert len(ways) == 3
    assert "Unpack[SeedlessFitChoices]" in str(ways[-1].__annotations__["choices"])


REFUSED = {
    "tool": (lambda: mwdcal.plan(3), r"`tool` must be a tool profile.*got int. Read one by"),
    "no such tool": (lambda: mwdcal.plan("servoo"), r"servo"),
    "no such plan": (lambda: mwdcal.plan("servo", plan="moosavi"), r"moosavi-12"),
    "stations": (lambda: mwdcal.plan("servo", stations=0), r"`stations` must be a whole number of 1 or more; got 0"),
    "halves": (lambda: mwdcal.plan("servo", stations=2.5), r"`stations` must be a whole number .*; got 2.5"),
    "accuracy": (lambda: mwdcal.plan("servo", accuracy_deg={"azimuth": 0}), r"`accuracy_deg` must be above 0"),
    "angle": (lambda: mwdcal.plan("servo", accuracy_deg={"yaw": 1.0}), r"accuracy of yaw cannot be wanted"),
    "reach": (lambda: mwdcal.plan("servo", reach={"inclination": 90}), r"`reach` must be the least and the largest"),
    "reach of": (lambda: mwdcal.plan("servo", reach={"yaw": (0, 1)}), r"`reach` must be of inclination"),
    "criterion": (lambda: mwdcal.plan("servo", criterion="E"), r"`criterion` must be one of D, A, I; got 'E'"),
    "speed": (lambda: mwdcal.plan("servo", speed=0), r"`speed` must be more than 0"),
    "option": (lambda: mwdcal.plan("servo", methd="scalar"), r"unknown option 'methd'.*Did you mean 'method'"),
    "several": (lambda: mwdcal.plan("servo", plan=["six-state", "roll-test"], stations=3), r"Name it alone"),
    "columns": (lambda: mwdcal.plan("servo", plan={"ref_inclination_deg": [1, 2]}), r"station 1 has no ref_azimuth"),
    "seed": (lambda: mwdcal.simulate("moosavi-12", seed=-1), r"`seed` must be a whole number of 0 or more"),
    "repeat": (lambda: mwdcal.simulate("moosavi-12", repeat=0), r"`repeat` must be a whole number of 1 or more"),
    "keyword": (lambda: mwdcal.simulate("moosavi-12", sed=1), r"unknown keyword 'sed'.*Did you mean 'seed'"),
    "of a grid": (lambda: mwdcal.simulate([45], toolface=3), r"unknown keyword 'toolface'.*'toolfaces'"),
    "of many": (lambda: mwdcal.simulate("moosavi-12", method="scalar"), r"`method` goes with `repeat`"),
    "limits": (lambda: mwdcal.simulate("moosavi-12", repeat=1, limits="strict"), r"roll-test"),
    "effects": (lambda: mwdcal.simulate("moosavi-12", effects="storm"), r"storm"),
    "order": (lambda: mwdcal.simulate("moosavi-12", order=7), r"`order` must be 0, 1, 2, 3 or auto; got 7"),
    "both": (lambda: mwdcal.simulate("moosavi-12", "servo", calibration="c.json"), r"Leave out `tool`"),
    "table": (lambda: mwdcal.propose_profile("nowhere.csv"), r"nowhere.csv"),
    "no file": (lambda: mwdcal.propose_profile(5), r"table must be a file or columns by name; got int"),
    "sheet of columns": (lambda: mwdcal.propose_profile({"ax": [1.0]}, sheet="A"), r"`sheet` is of tables in files"),
    "no tool": (lambda: mwdcal.plan("generic"), r"'generic' \(the default without `tool`\) does not state the noise"),
    "stand": (lambda: mwdcal.load_profile("servo").with_stand(tilt=1.0), r"the stand: .*unknown field `tilt`"),
    "stand's 1σ": (lambda: mwdcal.load_profile("servo").with_stand(azimuth_deg="1"), r"the stand: Expected `float`"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_refused_keywords(case):
    call, message = REFUSED[case]
    with pytest.raises(mwdcal.InputError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_a_plan_that_gives_no_calibration_is_refused_as_by_the_command():
    ran = command("plan", "--plan", "roll-test", "--tool", "servo", "--method", "scalar")
    with pytest.raises(mwdcal.FitError) as caught:
        mwdcal.plan("servo", plan="roll-test", method="scalar")
    assert str(caught.value).split("`")[0] in refused(ran, 3)


def test_a_plan_from_a_calibration_is_at_its_place_and_temperature_and_says_what_was_asked(
    tmp_path,
):
    """The gravity of the sheet has six digits; the file keeps all of them."""
    columns = servo_run(1, (5, 45, 90), 8, temperatures=(21.8,))
    columns["ref_gravity_g"] = np.full(len(columns["ax"]), 0.997853497372)
    run = write_csv(tmp_path / "run.csv", columns, "serial = A")
    command("calibrate", run, "--tool", "servo", "-o", tmp_path / "cal.json")
    files = "-o", tmp_path / "plan.csv", "--report", tmp_path / "sheet.html"
    command("plan", "--stations", 24, "--tool", tmp_path / "cal.json", *files)
    assert (tmp_path / "plan.csv").read_text("utf-8").startswith('# plan = "best 24 stations"\n')
    rows = read_csv(tmp_path / "plan.csv")
    assert set(rows["temperature_c"]) == {"22.0"}
    assert set(rows["ref_gravity_g"]) == {"0.997853497372"}
    sheet = (tmp_path / "sheet.html").read_text("utf-8")
    assert "<dd>0.997853</dd>" in sheet
    assert "<dt>Serial</dt><dd>A</dd>" in sheet
    more = mwdcal.plan("servo", stations=2, measured=run)
    more.report(tmp_path / "more.html")
    assert "<dt>Serial</dt><dd>A</dd>" in (tmp_path / "more.html").read_text("utf-8")
    assert "per direction / at every station" in sheet
