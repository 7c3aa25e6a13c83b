"""References, surveys, conversions and exports from Python: what the command line gives for the same files."""

from __future__ import annotations

import json
import re
from datetime import date, datetime

import numpy as np
import pytest

import mwdcal as mc
from cli_support import EXAMPLE, numbers, read_csv
from cli_support import mwdcal as command

PLACE = {"latitude": 60.4, "longitude": 5.3, "altitude_m": 40.0, "date": "2026-11-23"}
TYPED = ("--latitude", 60.4, "--longitude", 5.3, "--altitude-m", 40, "--date", "2026-11-23")
WELL = EXAMPLE / "well.csv"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("wells")
    ran = command(
        *("calibrate", EXAMPLE / "run.csv", "--tool", EXAMPLE / "tool.toml"),
        *("-o", path / "tool.json"),
    )
    assert ran.code == 0, ran
    return path


@pytest.fixture(scope="module")
def cal(folder):
    return mc.load(folder / "tool.json")


@pytest.fixture(scope="module")
def here():
    return mc.reference(**PLACE)


def ran(*typed):
    result = command(*typed)
    assert result.code == 0, result
    return result


def forms_are_short(result):
    """What every result has."""
    assert len(repr(result)) <= 300
    assert "\n" not in repr(result)
    assert result._repr_html_().startswith("<pre>")
    assert json.loads(json.dumps(result.to_dict())) == result.to_dict()
    assert all(finding.id and finding.text for finding in result.findings)


# References


def test_a_reference_is_that_of_the_command(here, tmp_path):
    forms_are_short(here)
    assert here.summary() + "\n" == ran("reference", *TYPED).out
    document = ran("reference", *TYPED, "--json").json
    assert here.to_dict() == document
    for name in ("gravity_g", "field_nt", "dip_deg", "declination_deg", "convergence_deg"):
        assert getattr(here, name) == document[name]
    for name in ("gravity_g", "field_nt", "dip_deg", "declination_deg"):
        assert getattr(here, f"sd_{name}") == document[f"sd_{name}"]
    ran("reference", *TYPED, "-o", tmp_path / "here.json")
    typed = (tmp_path / "here.json").read_bytes()
    mc.save(here, tmp_path / "here.json")
    assert (tmp_path / "here.json").read_bytes() == typed


def test_a_measured_reference_with_a_grid(tmp_path):
    options = ("--crs", "EPSG:23031", "--dip-deg", 73.1, "--sd-dip-deg", 0.1, "--model", "igrf14")
    typed = ran("reference", *TYPED, *options, "--json").json
    made = mc.reference(
        **PLACE | {"date": date(2026, 11, 23)},
        crs="EPSG:23031",
        dip_deg=73.1,
        sd_dip_deg=0.1,
        model="igrf14",
    )
    assert made.to_dict() == typed
    assert made.convergence_deg == typed["convergence_deg"]
    assert mc.reference(**PLACE | {"date": datetime(2026, 11, 23, 12)}).to_dict()["date"] == (
        "2026-11-23"
    )


def test_findings_name_arguments_of_python():
    texts = [finding.text for finding in mc.reference(**PLACE, field_nt=51_000.0).findings]
    assert any("State `sd_field_nt`" in text for text in texts)


def test_a_run_is_filled_as_by_the_command(here, tmp_path):
    columns = read_csv(EXAMPLE / "run.csv")
    run = tmp_path / "run.csv"
    blank = [name for name in columns if not name.endswith(("gravity_g", "field_nt", "dip_deg"))]
    rows = zip(*(columns[name] for name in blank), strict=True)
    text = ["# date = 2026-01-01", ",".join(blank), *map(",".join, rows)]
    run.write_text("\n".join(text) + "\n", "utf-8")
    typed = ran("reference", *TYPED, "--fill", run, "-o", tmp_path / "typed.csv", "--json").json
    filled = here.fill(run)
    forms_are_short(filled)
    mc.save(filled, tmp_path / "filled.csv")
    assert (tmp_path / "filled.csv").read_bytes() == (tmp_path / "typed.csv").read_bytes()
    assert filled.cells == typed["filled"]
    assert filled.columns["ref_field_nt"][0] == here.field_nt
    mine = filled.to_dict()
    assert "Check `date`" in mine["findings"][0]["text"]
    for document in (mine, typed):
        del document["findings"], document["output"]
    assert mine == typed


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"latitude": 95}, "`latitude` must be between -90 and 90"),
        ({"longitude": "east"}, "`longitude` must be a number; got 'east'"),
        ({"date": "23.11.2026"}, "`date` must be a day, written year-month-day"),
        ({"date": "2040-01-01"}, "`date`: wmm2025 holds from"),
        ({"model": "wmm2020"}, "`model` must be one of wmm2025"),
        ({"sd_dip_deg": 0.1}, "Add `dip_deg`"),
        ({"crs": "EPSG:none"}, "`crs`"),
    ],
)
def test_a_bad_reference_is_refused(changed, message):
    with pytest.raises(mc.InputError) as refusal:
        mc.reference(**PLACE | changed)
    assert message in str(refusal.value)


def test_a_reference_needs_an_altitude_as_the_command_does():
    with pytest.raises(TypeError, match="altitude_m"):
        mc.reference(**{name: value for name, value in PLACE.items() if name != "altitude_m"})


def test_a_reference_is_json(here, tmp_path):
    with pytest.raises(mc.InputError, match=r"ends in \.json"):
        mc.save(here, tmp_path / "here.csv")


# Surveys


def without_files(document):
    return {key: value for key, value in document.items() if key not in ("output", "html")}


def test_a_roll_test_of_arrays_without_the_stand_that_the_run_has_says_so():
    run = mc.simulate([30, 60, 90, 120], 6, [0, 90], tool=4, seed=1)
    roll = mc.simulate([45], 12, [60], tool=4, seed=3)
    sd = {"inclination_deg": 0.02, "azimuth_deg": 0.05, "toolface_deg": 0.05}

    def arrays(of, sd):
        known = {
            name: of.known[name] for name in ("inclination", "azimuth", "toolface", "field", "dip")
        }
        return mc.readings(
            of.accelerometer, of.magnetometer, temperature=of.temperature, sd=sd, **known
        )

    cal, exact = (mc.calibrate(arrays(run, each)) for each in (sd, {}))
    tests = [(cal, sd), (cal, {}), (exact, {})]
    named = [
        "stand-exact" in {f.id for f in mc.verify(c, arrays(roll, s)).findings} for c, s in tests
    ]
    assert named == [False, True, False]


@pytest.mark.parametrize("msa", [False, True])
@pytest.mark.usefixtures("without_pictures")
def test_surveys_are_those_of_the_command(folder, here, tmp_path, msa):
    mc.save(here, tmp_path / "here.json")
    out, page = tmp_path / "out.csv", tmp_path / "out.html"
    options = ("--reference", tmp_path / "here.json", *(["--msa"] if msa else []), "-o", out)
    typed = ran("survey", folder / "tool.json", WELL, *options, "--report", page)
    table, drawn = out.read_bytes(), page.read_text("utf-8")
    well = mc.survey(folder / "tool.json", WELL, reference=tmp_path / "here.json", msa=msa)
    forms_are_short(well)
    shown, _, files = typed.out.rstrip("\n").rpartition("\n")
    assert files.startswith("wrote ")
    assert well.summary() == shown
    document = ran("survey", folder / "tool.json", WELL, *options, "--json").json
    assert without_files(well.to_dict()) == without_files(document)
    assert document["calibration_sha256"]
    assert document["readings_sha256"]
    mc.save(well, out)
    assert out.read_bytes() == table
    well.report(page)
    in_words = page.read_text("utf-8")
    assert len(in_words) > 0.9 * len(drawn)
    assert document["readings_sha256"] in in_words
    assert (well.interference is None) == (not msa)
    assert (well.analysis is None) == (not msa)


def test_columns_of_surveys_are_those_of_the_table(cal, tmp_path):
    well = mc.survey(cal, WELL)
    well.save(tmp_path / "out.csv")
    table = read_csv(tmp_path / "out.csv")
    assert [*well.columns] == [*table]
    assert well.columns["md_m"] == pytest.approx(numbers(table["md_m"]))
    assert well.columns["tvd_m"] == pytest.approx(numbers(table["tvd_m"]), nan_ok=True)
    assert well.columns["accepted"].tolist() == table["accepted"]
    assert well.accepted.tolist() == [cell == "true" for cell in table["accepted"]]
    assert well.path.place[:, 2] == pytest.approx(numbers(table["tvd_m"]))


def test_surveys_from_memory_are_those_of_the_file(folder, cal, here):
    columns = read_csv(WELL)
    labels = ("station",)
    arrays = {n: cells if n in labels else numbers(cells) for n, cells in columns.items()}
    run = mc.read_run(WELL, cal.profile)
    from_file = mc.survey(folder / "tool.json", WELL, reference=here)
    results = from_file.surveyed.well.columns
    for readings in (arrays, run):
        well = mc.survey(cal, readings, reference=here)
        for name in {*results} - {"finding"}:
            if results[name].dtype.kind == "f" and not name.startswith(("azimuth_true", "sd_az")):
                same = np.allclose(well.columns[name], results[name], equal_nan=True, atol=1e-6)
                assert same or readings is arrays, name  # a dictionary states no declination
        document = well.to_dict()
        assert document["calibration_sha256"] is None
        assert document["readings_sha256"] is None
        assert document["calibration_signature"]["state"] == "unsigned"
    assert mc.survey(cal, run, reference=here).to_dict()["end"]["md_m"] == pytest.approx(
        from_file.to_dict()["end"]["md_m"]
    )


def test_parts_of_readings_keep_their_depths(cal):
    run = mc.read_run(WELL, cal.profile)
    part = mc.survey(cal, run[:12])
    assert part.path.md == pytest.approx(mc.survey(cal, WELL).path.md[:12])
    arrays = mc.readings(run.accelerometer, run.magnetometer, temperature=run.temperature)
    well = mc.survey(cal, arrays)
    assert well.path is None
    assert len(well.columns["inclination_deg"]) == run.count


def test_surveys_as_a_table_of_pandas(cal):
    pandas = pytest.importorskip("pandas")
    well = mc.survey(cal, WELL)
    frame = well.to_pandas()
    assert [*frame.columns] == [*well.columns]
    assert frame.attrs["survey_limits"] == "owsg-mwd"
    assert frame.attrs["serial"] == cal.tool["serial"]
    given = pandas.read_csv(WELL, comment="#")
    again = mc.survey(cal, given)
    assert again.columns["inclination_deg"] == pytest.approx(
        well.columns["inclination_deg"], nan_ok=True
    )


def test_true_and_false_are_booleans_in_pandas(cal):
    pandas = pytest.importorskip("pandas")
    columns = {name: [*cells] for name, cells in read_csv(WELL).items()}
    columns["ref_gravity_g"][1] = "1.05"
    columns["temperature_c"][3] = "90"
    words = {True: "true", False: "false", pandas.NA: ""}
    for axial in (True, False):
        for name in () if axial else ("ref_gravity_g", "ref_field_nt", "ref_dip_deg"):
            columns[name][2] = ""
        well = mc.survey(cal, columns, outside="extrapolate", axial_correction=axial)
        frame = well.to_pandas()
        flags = {"accepted", "axial_no_go", "extrapolated"} & {*frame.columns}
        assert len(flags) == 2 + axial
        for name in flags:
            assert str(frame[name].dtype) == "boolean"
            assert [words[cell] for cell in frame[name]] == well.columns[name].tolist()
        assert well.accepted.tolist() == frame["accepted"].fillna(False).tolist()
    assert {*well.columns["accepted"]} == {"true", "false", ""}
    run = mc.read_run(WELL, cal.profile)
    assert str(mc.apply(cal, run, "extrapolate").to_pandas()["extrapolated"].dtype) == "boolean"


def test_surveys_without_references_are_not_judged_and_a_serial_is_a_column(cal, tmp_path):
    names = ("md_m", "temperature_c", "ax", "ay", "az", "mx", "my", "mz")
    table = {name: read_csv(EXAMPLE / "well.csv")[name] for name in names}
    well = mc.survey(cal, table)
    assert "off:" not in well.summary()
    reason = "36 not judged: gravity, field and dip of the place are not given"
    assert reason in well.summary()
    known = mc.survey(cal, {**table, "ref_gravity_g": [1.0, *["" for _ in range(35)]]}).summary()
    assert "35 not judged " in known.replace("\n", " ")
    well.report(tmp_path / "well.html")
    assert "36 surveys not judged by the limits owsg-mwd" in (tmp_path / "well.html").read_text()
    said = {finding.id: finding.text for finding in well.findings}
    assert said["no-serial"].startswith("no serial in the readings: mwdcal cannot check")
    with_serial = mc.survey(cal, {**table, "serial": ["SIM-0001"] * 36})
    assert said.keys() - {f.id for f in with_serial.findings} == {"no-serial"}


def test_options_of_surveys_are_those_of_the_command(folder, tmp_path):
    typed = ran(
        *("survey", folder / "tool.json", WELL, "--limits", "fixed", "--tie-in", "1,2,3"),
        *("--switch", "10,12", "--outside", "extrapolate", "-o", tmp_path / "out.csv", "--json"),
    ).json
    well = mc.survey(
        folder / "tool.json",
        WELL,
        limits="fixed",
        tie_in=(1, 2, 3),
        switch=(10, 12),
        outside="extrapolate",
    )
    assert without_files(well.to_dict()) == without_files(typed)


def test_arrays_are_surveyed_with_the_depths_given():
    """Courses of 30 m at 60° inclination and 30° azimuth, by the simulated tool: 15 m deeper, 22.5 m north each."""
    made = mc.calibrate(mc.simulate(tool=4, seed=1))
    hole = mc.simulate([60], 8, [30], tool=4, seed=2)
    vectors = (hole.accelerometer, hole.magnetometer)
    depths = 30.0 * np.arange(8)
    given = mc.readings(*vectors, temperature=hole.temperature, md_m=depths)
    np.testing.assert_array_equal(given.columns["md_m"], depths)
    well = mc.survey(made, given)
    np.testing.assert_allclose(well.columns["tvd_m"], 15.0 * np.arange(8), atol=0.2)
    np.testing.assert_allclose(well.columns["north_m"], 22.5 * np.arange(8), atol=0.2)
    array = mc.survey(made, np.column_stack([*vectors, hole.temperature]))
    np.testing.assert_allclose(array.columns["azimuth_magnetic_deg"], 30.0, atol=0.2)
    lacking = next(finding.text for finding in array.findings if finding.id == "no-path")
    assert "mwdcal.readings(…, md_m=…)" in lacking


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"reference": {}}, "`reference` must be that of a place, or its file; got dict"),
        ({"switch": 4}, "`switch` must be 2 finite numbers; got 4"),
        ({"tie_in": (1, 2)}, "north, east and TVD; got 2 numbers"),
        ({"tie_in": (1, 2, float("nan"))}, "`tie_in` must be 3 finite numbers"),
        ({"tie_in": (100, 200, 0, 1, 2, 3)}, "an inclination of 0 to 180°; got 100 and 200"),
        ({"section_azimuth": 400}, "`section_azimuth` must be an azimuth"),
        ({"outside": "drop"}, "`outside` must be one of blank, refuse, extrapolate; got 'drop'"),
        ({"limits": "strict"}, "strict"),
        ({"sensor_drift": "owsg"}, "`sensor_drift` goes with `msa`"),
        ({"readings": 3}, "readings must be an array of the shape (n, 3), (n, 6) or (n, 7)"),
        ({"cal": 3}, "`cal` must be a calibration or its file; got int"),
        ({"cal": "no.json"}, "no.json: cannot be read"),
    ],
)
def test_bad_arguments_of_surveys_are_refused(cal, options, message):
    with pytest.raises(mc.InputError) as refusal:
        mc.survey(**{"cal": cal, "readings": WELL} | options)
    assert message in str(refusal.value)


@pytest.mark.usefixtures("without_pictures")
def test_page_of_the_analysis(cal, here, tmp_path):
    well = mc.survey(cal, WELL, reference=here, msa=True, sensor_drift="none")
    assert well.interference.sd_axial_nt > 0
    well.msa_report(tmp_path / "msa.html")
    assert "<html" in (tmp_path / "msa.html").read_text("utf-8")
    with pytest.raises(mc.InputError, match="msa=True"):
        mc.survey(cal, WELL).msa_report(tmp_path / "none.html")


# Notations and firmware


@pytest.mark.parametrize("notation", ["factors", "forward", "affine"])
def test_a_notation_is_that_of_the_command(folder, cal, notation, tmp_path):
    given = ("convert", folder / "tool.json", "--notation", notation, "--temperature", 35)
    made = mc.convert(folder / "tool.json", notation, temperature=35.0)
    forms_are_short(made)
    assert made.summary() + "\n" == ran(*given).out
    document = ran(*given, "--json").json
    assert made.to_dict() == document
    ran(*given, "-o", tmp_path / "typed.json")
    mc.save(made, tmp_path / "made.json")
    assert (tmp_path / "made.json").read_bytes() == (tmp_path / "typed.json").read_bytes()
    in_memory = mc.convert(cal, notation, temperature=35.0)
    for triad in ("accelerometer", "magnetometer"):
        for name, values in getattr(in_memory, triad).items():
            assert values == pytest.approx(np.array(document[triad][name]))
            assert in_memory.uncertainty[triad][name].shape == values.shape
        assert len(in_memory.covariance[triad]) == len(document[triad]["covariance"])
    assert in_memory.to_dict()["calibration_sha256"] is None
    assert "SHA-256" not in in_memory.summary()


def test_factors_in_pandas_are_those_of_the_report(cal, tmp_path):
    pytest.importorskip("pandas")
    cal.report(tmp_path / "tool.html")
    page = (tmp_path / "tool.html").read_text("utf-8")
    made = mc.convert(cal, "factors")
    table = made.to_pandas().set_index(["triad", "name"])
    names = re.findall(r"<td>(SF|B|m)<sub>([xyz]+)</sub>", page)
    assert [*dict.fromkeys(name for _, name in table.index)] == [
        *dict.fromkeys(map("".join, names))
    ]
    assert table.unit["accelerometer"][["SFx", "By", "mxy"]].tolist() == ["raw/g", "g", "rad"]
    assert table.unit["magnetometer"][["SFx", "By", "mxy"]].tolist() == ["raw/nT", "nT", "rad"]
    assert table.value["magnetometer", "mxy"] == made.magnetometer["m"][0, 1]
    assert table.sd["magnetometer", "By"] == made.uncertainty["magnetometer"]["B"][1, 0]


def test_values_of_a_course_name_their_power_in_pandas():
    pytest.importorskip("pandas")
    cal = mc.calibrate(mc.simulate("laboratory-thermal", "servo", seed=1), order=1)
    for notation, temperature, names, units in (
        ("factors", None, ["SFx·τ", "Bz·τ", "mxy"], ["raw/nT/°C", "nT/°C", "rad"]),
        ("forward", "course", ["Sxy·τ", "oz·τ²", "ox"], ["raw/nT/°C", "raw/°C²", "raw"]),
    ):
        table = mc.convert(cal, notation, temperature=temperature).to_pandas()
        unit = table.set_index(["triad", "name"]).unit["magnetometer"]
        assert unit[names].tolist() == units


@pytest.mark.parametrize(
    ("notation", "temperature"),
    [("factors", None), ("forward", 60.0), ("forward", None), ("forward", "course")],
)
def test_values_in_pandas_name_the_temperature_that_the_screen_names(notation, temperature):
    pytest.importorskip("pandas")
    cal = mc.calibrate(mc.simulate("laboratory-thermal", "servo", seed=1), order=1)
    made = mc.convert(cal, notation, temperature=temperature)
    stated = made.to_pandas().attrs["temperature_c"]
    assert stated == {"course": "course", 60.0: 60.0}.get(temperature, cal.reference_temperature)
    assert stated == made.to_dict()["temperature_c"]
    words = stated if isinstance(stated, str) else f"{stated:g} °C"
    assert f"temperature {words} " in made.summary()


@pytest.mark.parametrize(("form", "typed"), [("c", "c-header"), ("fixed-point", "fixed-point")])
def test_sources_are_those_of_the_command(folder, cal, tmp_path, form, typed):
    to = ("convert", folder / "tool.json", "--to", typed, "-o", tmp_path / "typed", "--json")
    document = ran(*to).json
    made = mc.export(folder / "tool.json", "firmware", form=form)
    forms_are_short(made)
    made.save(tmp_path / "made")
    assert sorted(made.files) == sorted(document["files"])
    for name, text in made.files.items():
        assert (tmp_path / "made" / name).read_text("utf-8") == text
        assert (tmp_path / "typed" / name).read_text("utf-8") == text
    mine = made.to_dict()
    assert mine.pop("folder") == ""
    assert document.pop("folder")
    assert mine == document
    shown = ran(*to[:-1]).out.rstrip("\n").rpartition("\n")
    assert made.summary().rpartition("\n")[0] == shown[0]
    in_memory = mc.export(cal, "firmware", form=form)
    assert not any("SHA-256" in text for text in in_memory.files.values())


def test_a_tool_model_is_that_of_the_command(folder, cal, tmp_path):
    to = ("convert", folder / "tool.json", "--to", "tool-model", "-o", tmp_path / "typed.json")
    document = ran(*to, "--json").json
    made = mc.export(folder / "tool.json", "tool-model")
    forms_are_short(made)
    mc.save(mc.export(cal, "tool-model"), tmp_path / "made.json")
    assert (tmp_path / "made.json").read_bytes() == (tmp_path / "typed.json").read_bytes()
    assert made.to_dict() | {"files": document["files"]} == document
    assert [term.name for term in made.terms] == [term["name"] for term in document["terms"]]
    assert made.summary() == ran(*to).out.rstrip("\n").rpartition("\n")[0]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda cal: mc.convert(cal, "forwards"), "`notation` must be one of"),
        (lambda cal: mc.convert(cal, "forward", temperature=1e4), "`temperature` must be between"),
        (lambda cal: mc.convert(cal, "forward", temperature="warm"), "`temperature` must be"),
        (lambda cal: mc.export(cal, "firmwar"), "Did you mean 'firmware'?"),
        (lambda cal: mc.export(cal, "firmware", form="rust"), "`form` must be one of c, c-header"),
        (lambda cal: mc.export(cal, "firmware", word_bits=24), "`word_bits` goes with `form`"),
        (lambda cal: mc.export(cal, "firmware", temperature=20.0), "hold for all temperatures"),
        (lambda cal: mc.export(cal, "tool-model", form="c"), "`form` goes with the kind firmware"),
        (lambda cal: mc.export(cal, "tool-model", temperature="course"), "must be a number in °C"),
        (lambda cal: mc.export([], "firmware"), "`cal` must be a calibration or its file"),
    ],
)
def test_bad_words_are_refused(cal, call, message):
    with pytest.raises(mc.InputError) as refusal:
        call(cal)
    assert message in str(refusal.value)


def test_results_that_are_no_table_or_page_say_so(here, tmp_path):
    with pytest.raises(AttributeError, match="no columns"):
        here.columns  # noqa: B018
    with pytest.raises(mc.InputError, match="has no page"):
        here.report(tmp_path / "here.html")
