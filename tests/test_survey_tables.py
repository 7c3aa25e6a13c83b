"""Tables of surveys under other names than those of the calibration's run, and in other units."""

from __future__ import annotations

import re

import numpy as np
import openpyxl
import pytest
from msgspec.structs import replace

import mwdcal as mc
from cli_support import EXAMPLE, read_csv, refused
from cli_support import mwdcal as cli
from mwdcal.errors import FitError, InputError
from mwdcal.files.depths import is_depth
from mwdcal.sensor.profile import TableFormat

RAW = ("ax", "ay", "az", "mx", "my", "mz")
PER = dict(zip(RAW, [1000 / 3] * 3 + [1 / 5e-5] * 3, strict=True))
"""Of mg and nT in a volt of the example."""
RUN = dict(zip(RAW, ("Ax", "Ay", "Az", "Mx", "My", "Mz"), strict=True))
LOGGER = dict(zip(RAW, ("Gx", "Gy", "Gz", "Bx", "By", "Bz"), strict=True))
UNITS = {"mg": 1.0, "g": 1e-3, "nT": 1.0, "µT": 1e-3}
ANGLES = {
    "ref_inclination_deg": "Inclination ref",
    "ref_azimuth_deg": "Azimuth ref",
    "ref_toolface_deg": "Toolface ref",
}


def measured(file, names, units, **others):
    """Columns of the example's table, each with its unit: channels in `units` under other names."""
    cells = {name: np.array(column, float) for name, column in read_csv(EXAMPLE / file).items()}
    each = dict(zip(RAW, [units[0]] * 3 + [units[1]] * 3, strict=True))
    columns = {names[c]: (each[c], cells[c] * PER[c] * UNITS[each[c]]) for c in RAW}
    return {**columns, **{theirs: (unit, cells[ours]) for ours, (theirs, unit) in others.items()}}


def workbook(path, **sheets):
    """A workbook with the names, a row of units and the rows of each sheet."""
    book = openpyxl.Workbook()
    book.remove(book.active)
    for title, columns in sheets.items():
        sheet = book.create_sheet(title)
        sheet.append([*columns])
        sheet.append([unit for unit, _ in columns.values()])
        for row in zip(*(cells for _, cells in columns.values()), strict=True):
            sheet.append([*map(float, row)])
    book.save(path)
    return path


def well_table(units=("mg", "nT"), names=LOGGER, **more):
    """Surveys as a logger writes them, with angles and a total of its own."""
    columns = measured("well.csv", names, units, md_m=("MD", "m"), temperature_c=("Temp", "°C"))
    count = len(columns["MD"][1])
    own = {
        "INC": ("deg", np.linspace(1, 50, count)),
        "AZI": ("deg", np.linspace(1, 90, count)),
        "Btotal": ("nT", np.linspace(40_000, 44_000, count)),
    }
    return {**columns, **own, **more}


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory):
    """A calibration file of a run in mg and nT, and the calibration."""
    folder = tmp_path_factory.mktemp("laboratory")
    angles = {ours: (theirs, "deg") for ours, theirs in ANGLES.items()}
    run = measured("run.csv", RUN, ("mg", "nT"), temperature_c=("Temp", "°C"), **angles)
    count = len(run["Temp"][1])
    path = workbook(folder / "run.xlsx", run={**run, "F ref": ("nT", np.full(count, 48_000.0))})
    profile = mc.propose_profile(path).profile
    cal = mc.calibrate(path, profile)
    mc.save(cal, folder / "tool.json")
    return folder / "tool.json", cal


@pytest.mark.parametrize("units", [("mg", "nT"), ("g", "µT")])
def test_surveys_are_read_by_the_names_and_units_of_their_table(tmp_path, laboratory, units):
    file, cal = laboratory
    wanted = mc.survey(cal, workbook(tmp_path / "run.xlsx", W=well_table(names=RUN)))
    assert "columns-read" not in {f.id for f in wanted.findings}
    path = workbook(tmp_path / "WELL.xlsx", W=well_table(units))
    out = tmp_path / "well.csv"
    ran = cli("survey", file, path, "-o", out, "--json")
    assert ran.code == 0, ran.err
    [text] = [f["text"] for f in ran.json["findings"] if f["id"] == "columns-read"]
    assert "ax = 'Gx'" in text
    assert "mz = 'Bz'" in text
    found = {f["id"] for f in ran.json["findings"]}
    assert "not-judged" in found
    assert "changed" not in found
    result = read_csv(out)
    assert {"Gx", "INC", "Btotal", "MD"} <= {*result}
    for name in ("inclination_deg", "azimuth_magnetic_deg", "tvd_m", "sd_tvd_m"):
        assert np.array(result[name], float) == pytest.approx(
            wanted.columns[name], rel=1e-9, abs=1e-6, nan_ok=True
        )
    assert {*result["accepted"]} == {""}


def test_apply_reads_them_so_too(tmp_path, laboratory):
    file, cal = laboratory
    path = workbook(tmp_path / "WELL.xlsx", W=well_table(("g", "µT")))
    ran = cli("apply", file, path, "-o", tmp_path / "out.csv", "--json")
    assert ran.code == 0, ran.err
    found = {f["id"] for f in ran.json["findings"]}
    assert "columns-read" in found
    assert "changed" not in found
    corrected = mc.apply(cal, path)
    assert [f.id for f in corrected.findings if f.id == "columns-read"] == ["columns-read"]
    wanted = mc.survey(cal, path).columns["inclination_deg"]
    for given in (
        corrected.columns["inclination_deg"],
        read_csv(tmp_path / "out.csv")["inclination_deg"],
    ):
        assert np.array(given, float) == pytest.approx(wanted, abs=1e-6)


def test_columns_in_memory_and_a_run_file_take_other_names(laboratory):
    """A calibration of a run file has no names but those of the contract."""
    profile = mc.load_profile(EXAMPLE / "tool.toml")
    cal = mc.calibrate(EXAMPLE / "run.csv", profile)
    given = read_csv(EXAMPLE / "well.csv")
    other = {LOGGER.get(name, name): cells for name, cells in given.items()}
    columns = [mc.survey(cal, each).columns["azimuth_magnetic_deg"] for each in (given, other)]
    assert columns[0] == pytest.approx(columns[1], nan_ok=True)
    angles = [mc.apply(cal, each).columns["dip_deg"] for each in (given, other)]
    assert angles[0] == pytest.approx(angles[1])
    del other["Bz"]
    with pytest.raises(FitError, match="no column for mz; .*column"):
        mc.survey(cal, other)


def test_a_channel_without_a_name_is_asked_for(tmp_path, laboratory):
    file, cal = laboratory
    path = workbook(tmp_path / "WELL.xlsx", W=well_table(names={**LOGGER, "mz": "chan 9"}))
    message = refused(cli("survey", file, path, "-o", tmp_path / "well.csv"), 3)
    assert "no column for mz (in the run 'Mz')" in message
    assert "'chan 9'" in message
    assert "--column mz=NAME" in message
    assert "mwdcal profile" not in message
    ran = cli("survey", file, path, "-o", tmp_path / "well.csv", "--column", "mz=chan 9")
    assert ran.code == 0, ran.err
    well = mc.survey(cal, path, column={"mz": "chan 9"})
    assert well.columns["inclination_deg"].size == len(read_csv(tmp_path / "well.csv")["MD"])
    assert mc.apply(cal, path, column="mz=chan 9").gravity.shape[0] == well.accepted.size
    bare = {name: f"chan {k}" for k, name in enumerate(RAW)}
    path = workbook(tmp_path / "BARE.xlsx", W=well_table(names=bare))
    assert "--column ax=NAME" in refused(cli("apply", file, path, "-o", tmp_path / "o.csv"), 3)


def test_of_two_sheets_the_user_says_which(tmp_path, laboratory):
    file, cal = laboratory
    short = {name: (unit, cells[:20]) for name, (unit, cells) in well_table().items()}
    path = workbook(
        tmp_path / "WELL.xlsx", First=well_table(), Second={**short, "QC": ("", short["INC"][1])}
    )
    message = refused(cli("survey", file, path, "-o", tmp_path / "well.csv"), 3)
    assert "--sheet Second" in message
    assert mc.survey(cal, path, sheet="Second").accepted.size == 20
    assert "found 'First', 'Second'" in refused(
        cli("survey", file, path, "-o", tmp_path / "well.csv", "--sheet", "Third"), 2
    )


def test_readings_in_no_unit_of_the_run_are_refused(tmp_path, laboratory):
    table = {
        n: ("" if n in LOGGER.values() else u, c) for n, (u, c) in well_table(("g", "nT")).items()
    }
    path = workbook(tmp_path / "WELL.xlsx", W=table)
    message = refused(cli("survey", laboratory[0], path, "-o", tmp_path / "well.csv"), 2)
    assert "no place on Earth" in message


def test_the_unit_of_a_run_without_one_may_be_stated(tmp_path):
    """The refusal of surveys in mg and nT says what to write; the run calibrated so reads them."""
    angles = {ours: (theirs, "deg") for ours, theirs in ANGLES.items()}
    names = {c: f"{name} raw" for c, name in RUN.items()}
    run = measured("run.csv", names, ("mg", "nT"), **angles)
    run = {name: ("" if name in names.values() else u, cells) for name, (u, cells) in run.items()}
    run |= {"F ref": ("nT", np.full(len(run["Ax raw"][1]), 48_000.0))}
    path, well = (
        workbook(tmp_path / "run.xlsx", run=run),
        workbook(tmp_path / "W.xlsx", W=well_table()),
    )
    profile, record = tmp_path / "tool.toml", tmp_path / "tool.json"
    assert cli("profile", path, "-o", profile).code == 0
    calibrate = ("calibrate", path, "--tool", profile, "-o", record)
    survey = ("survey", record, well, "-o", tmp_path / "well.csv")
    assert cli(*calibrate).code == 0
    message = refused(cli(*survey), 2)
    assert "reads in mg and the magnetometer reads in nT in this table, and in raw" in message
    text = profile.read_text("utf-8")
    for letter, unit in (("a", "mg"), ("m", "nT")):
        channels = ", ".join(f"{letter}{axis}" for axis in "xyz")
        assert f'unit = "{unit}" for {channels}' in message
        text = re.sub(rf'({letter}[xyz] = .*unit = )"raw"', rf'\1"{unit}"', text)
    profile.write_text(text, "utf-8")
    assert cli(*calibrate).code == 0
    done = cli(*survey)
    assert done.code == 0
    assert float(read_csv(tmp_path / "well.csv")["inclination_deg"][-1]) == pytest.approx(
        70.0, abs=0.1
    )


@pytest.mark.parametrize(("unit", "metres"), [("m", 1.0), ("(ft)", 0.3048)])
def test_the_unit_of_depths_is_read_below_their_name(tmp_path, laboratory, unit, metres):
    """In a workbook, and in text whose place a profile states."""
    _, cal = laboratory
    depths = well_table()["MD"][1]
    table = well_table(names=RUN, MD=(unit, depths / metres))
    path = workbook(tmp_path / "WELL.xlsx", W=table)
    assert mc.survey(cal, path).path.md == pytest.approx(depths)
    lines = [";".join(table), ";".join(unit for unit, _ in table.values())]
    cells = zip(*(cells for _, cells in table.values()), strict=True)
    lines += [";".join(f"{cell:.6f}" for cell in row) for row in cells]
    (tmp_path / "WELL.csv").write_text("\n".join(lines) + "\n", "utf-8")
    placed = replace(cal.profile, table=TableFormat(delimiter=";", first_line=3))
    text = replace(cal, profile=placed)
    assert mc.survey(text, tmp_path / "WELL.csv").path.md == pytest.approx(depths, abs=1e-5)


DEPTHS = (
    "MD;md_usft;M.D.;DEPT;Depth MD;Measured Depth (ft);Meas. depth;Hole depth [m];Bit depth;Survey depth;MD RKB (m);"
    "Along-hole depth;Depth (mMD);Depth ftUS;Tiefe;Messtiefe, m;Meßtiefe;Teufe;Gemessene Tiefe;Bohrlochtiefe;Tiefe MD;"
    "Dybde;Målt dybde (m);Målt dyp;Hulldybde;Borehullsdybde;Profundidad;Prof. medida;Profundidad medida (m);Prof.;"
    "Profundidad del pozo;Profundidade;Profundidade medida;Profundidade da broca;Profondeur mesurée;Profondeur (m);"
    "Глубина, м;Глубина по стволу;Измеренная глубина;Глубина скважины;井深;测深;测量深度(m);斜深;井深（米）;钻头深度"
)
"""Names of measured depth in English, German, Norwegian, Spanish, Portuguese, French, Russian and Chinese."""
NO_DEPTHS = (
    "TVD;Depth TVD;True vertical depth;Immersion depth;Water depth (m);Depth error;Delta depth;Vertikale Tiefe;"
    "Profundidad vertical;Глубина по вертикали;垂深;Department;Hole;Bit;m;Survey;sd_md"
)


def test_measured_depths_are_known_by_their_names():
    assert [name for name in DEPTHS.split(";") if not is_depth(name)] == []
    assert [name for name in NO_DEPTHS.split(";") if is_depth(name)] == []


@pytest.mark.parametrize(
    ("name", "metres"),
    [("Глубина по стволу, м", 1.0), ("Profundidad (pies)", 0.3048), ("Depth ftUS", 1200 / 3937)],
)
def test_depths_of_other_languages_count_in_the_unit_of_their_name(
    tmp_path, laboratory, name, metres
):
    path = workbook(tmp_path / "WELL.xlsx", W=deep(name, METRES / metres))
    assert mc.survey(laboratory[1], path).path.md == pytest.approx(METRES, rel=1e-12)


def deep(name, cells, unit=""):
    """Surveys whose measured depths have another name, and dates and times as text beside them."""
    table = {n: each for n, each in well_table(names=RUN).items() if n != "MD"}
    return {name: (unit, cells), **table}


def text_table(path, columns):
    """A table of text with a row of units, and the time of each survey."""
    stamps = [f"2026-03-01T{k // 2:02d}:{k % 2 * 30:02d}" for k in range(36)]
    lines = [
        ",".join(["Date and time", *columns]),
        ",".join(["", *(u for u, _ in columns.values())]),
    ]
    rows = zip(
        stamps, *(map(repr, map(float, cells)) for _, cells in columns.values()), strict=True
    )
    path.write_text("\n".join([*lines, *map(",".join, rows)]) + "\n", "utf-8")
    return path


METRES = np.array(read_csv(EXAMPLE / "well.csv")["md_m"], float)


@pytest.mark.parametrize(
    ("name", "unit", "typed", "metres"),
    [
        ("Strekning", "", "md_m=Strekning", 1.0),
        ("Strekning", "ft", "md_m=Strekning", 0.3048),
        ("Strekning", "", "md_ft=Strekning", 0.3048),
        ("Strekning", "", "md_usft=Strekning", 1200 / 3937),
        ("Strekning", "ft", "md_usft=Strekning", 1200 / 3937),
        ("Strekning", "m", "md_ft=Strekning", 1.0),
        ("Strekning", "", "md_m=Strekning (ft)", 0.3048),
        ("Strekning (ft)", "", "md_m=Strekning (ft)", 0.3048),
        ("Hole depth", "", "md_m=Hole depth", 1.0),
    ],
)
def test_the_user_names_the_measured_depth(tmp_path, laboratory, name, unit, typed, metres):
    """The path is that of the true depths; the table keeps the column, and its times."""
    file, cal = laboratory
    path = text_table(tmp_path / "WELL.csv", deep(name, METRES / metres, unit))
    ran = cli("survey", file, path, "-o", tmp_path / "out.csv", "--column", typed, "--json")
    assert ran.code == 0, ran.err
    assert ran.json["end"]["md_m"] == pytest.approx(METRES[-1])
    texts = {f["id"]: f["text"] for f in ran.json["findings"]}
    assert "no-path" not in texts
    assert name not in texts.get("unused-columns", "")
    result = read_csv(tmp_path / "out.csv")
    assert np.array(result[name], float) == pytest.approx(METRES / metres)
    assert result["Date and time"][3] == "2026-03-01T01:30"
    column, _, theirs = typed.partition("=")
    assert mc.survey(cal, path, column={column: theirs}).path.md == pytest.approx(METRES)
    assert cli("apply", file, path, "-o", tmp_path / "corrected.csv").code == 0
    corrected = (tmp_path / "corrected.csv").read_text("utf-8")
    assert all(f"\n{stamp}," in corrected for stamp in result["Date and time"])


def test_the_name_that_the_user_gives_comes_before_others(tmp_path, laboratory):
    """Of several depths by name the user says which: none is taken by its place in the table."""
    _, cal = laboratory
    table = {**deep("Bit depth (m)", METRES + 15), "Survey depth (m)": ("", METRES)}
    path = text_table(tmp_path / "WELL.csv", table)
    message = refused(cli("survey", laboratory[0], path, "-o", tmp_path / "out.csv"), 2)
    assert "'Bit depth (m)', 'Survey depth (m)'" in message
    assert '--column "md_m=Bit depth (m)"' in message
    for column in ("md_m", "md_ft"):
        well = mc.survey(cal, path, column={column: "Survey depth (m)"})
        assert well.path.md == pytest.approx(METRES)
    table = {**deep("md_m", METRES + 15), "Other": ("", METRES / 0.3048)}
    path = text_table(tmp_path / "WELL.csv", table)
    assert mc.survey(cal, path, column="md_ft=Other").path.md == pytest.approx(METRES)
    assert mc.survey(cal, path, column="md_m=").path is None


@pytest.mark.parametrize(
    ("name", "unit", "got"),
    [("Pos (km)", "", "km"), ("Pos", "cm", "cm"), ("Pos_mm", "m", "mm"), ("井 (千米)", "", "千米")],
)
def test_a_measured_depth_in_another_unit_of_length_is_refused(
    tmp_path, laboratory, name, unit, got
):
    """The user who knows better states the unit in the answer."""
    path = text_table(tmp_path / "WELL.csv", deep(name, METRES, unit))
    for column in "md_m", "md_ft":
        with pytest.raises(InputError, match=f"the unit must be m, ft or usft; got '{got}'"):
            mc.survey(laboratory[1], path, column={column: name})
    well = mc.survey(laboratory[1], path, column={"md_m": f"{name} (m)"})
    assert well.path.md == pytest.approx(METRES)


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        ("md_m=Foo", "there is no column 'Foo'; found"),
        ("md_m=Strekning (fathom)", "the unit must be m, ft or usft; got 'fathom'"),
        ("md=Strekning", "of surveys md_m"),
    ],
)
def test_an_answer_that_is_no_measured_depth_is_refused(tmp_path, laboratory, typed, message):
    path = text_table(tmp_path / "WELL.csv", deep("Strekning", METRES))
    ran = cli("survey", laboratory[0], path, "-o", tmp_path / "out.csv", "--column", typed)
    assert message in refused(ran, 2)


def test_a_table_without_a_depth_by_its_name_names_the_option_and_what_may_be_it(
    tmp_path, laboratory
):
    """Columns that never decrease may be depths; text, a constant and what goes up and down may not."""
    count = len(METRES)
    table = deep("Strekning", METRES)
    table |= {"pump": ("", np.full(count, 7.0)), "flow": ("", np.cos(np.arange(count)))}
    number = {"Svy": ("", np.arange(count) + 1.0)}
    for more, others in ({}, ""), ({"ticks": ("", np.arange(count) * 5.0)}, " or 'ticks'"):
        path = text_table(tmp_path / "WELL.csv", {**number, **table, **more})
        ran = cli("survey", laboratory[0], path, "-o", tmp_path / "out.csv")
        assert ran.code == 0, ran.err
        [line] = [line for line in ran.err.splitlines() if "no well path" in line]
        assert '--column "md_m=Strekning"' in line
        assert ("It may be 'Strekning'" + others in line) is bool(others)
        assert not {"pump", "flow", "Date", "NAME", "Svy"} & {*line.replace("'", " ").split()}


POSITIONS = (
    ("--tie-in", "0,0,0"), ("--tie-in", "0,0,0,1,2,3"), ("--section-azimuth", "30"), ("--covariance",),
    ("--listing", "list.csv"),
)  # fmt: skip


@pytest.mark.parametrize("option", POSITIONS)
def test_positions_that_are_asked_for_and_cannot_be_are_refused(tmp_path, laboratory, option):
    """Nothing is written then; with the depths named, or none of these options, it is."""
    path = text_table(tmp_path / "WELL.csv", deep("Strekning", METRES))
    out, *option = (
        tmp_path / "out.csv",
        *option[:1],
        *(tmp_path / o if o.endswith("csv") else o for o in option[1:]),
    )
    ran = cli("survey", laboratory[0], path, "-o", out, *option)
    assert f"{option[0]} needs a well path" in refused(ran, 2)
    assert '--column "md_m=Strekning"' in ran.err
    assert not out.exists()
    ran = cli("survey", laboratory[0], path, "-o", out, *option, "--column", "md_m=Strekning")
    assert ran.code == 0, ran


def test_positions_that_temperatures_leave_out_name_them(tmp_path, laboratory):
    """The refusal of an option has the cause that the finding without it has."""
    hot = well_table(Temp=("°C", np.full(len(METRES), 60.0)))
    survey = (
        "survey",
        laboratory[0],
        text_table(tmp_path / "WELL.csv", hot),
        "-o",
        tmp_path / "o.csv",
    )
    cause = "36 of 36 rows lie outside the calibrated range"
    assert cause in cli(*survey).err
    message = refused(cli(*survey, "--tie-in", "0,0,300"), 2)
    assert "--tie-in needs a well path" in message
    assert cause in message
    assert "--outside extrapolate" in message


def test_a_well_without_positions_says_so_first(tmp_path, laboratory):
    """Before surveys that nothing judges, and in the first line of the screen."""
    table = {n: each for n, each in deep("gone", METRES).items() if n != "gone"}
    bare = {n: each for n, each in table.items() if n not in ("Gtotal", "Btotal", "Dip")}
    for columns in (table, bare):
        ran = cli(
            "survey",
            laboratory[0],
            text_table(tmp_path / "WELL.csv", columns),
            "-o",
            tmp_path / "out.csv",
        )
        assert ran.code == 0
        assert "no positions" in ran.out.splitlines()[0]
        first = next(line for line in ran.err.splitlines() if line.startswith("!"))
        assert first.startswith("! no well path: no column has the measured depth.")
    path = text_table(tmp_path / "WELL.csv", deep("MD (m)", METRES))
    assert "no positions" not in cli("survey", laboratory[0], path, "-o", tmp_path / "out.csv").out


@pytest.mark.parametrize(("name", "unit"), [("Strekning (ft)", ""), ("Strekning", "m")])
def test_a_column_in_a_unit_of_length_is_offered_alone(tmp_path, laboratory, name, unit):
    rising = {"ticks": ("", np.arange(len(METRES)) * 5.0)}
    path = text_table(tmp_path / "WELL.csv", {**rising, **deep(name, METRES, unit)})
    ran = cli("survey", laboratory[0], path, "-o", tmp_path / "out.csv")
    [line] = [line for line in ran.err.splitlines() if "no well path" in line]
    assert f'--column "md_m={name}"' in line
    assert "ticks" not in line


def test_numbers_of_surveys_named_as_depths_raise_a_question(tmp_path, laboratory):
    """They make a well of as many metres as it has surveys."""
    count = len(METRES)
    number = {"Svy": ("", np.arange(count) + 1.0)}
    path = text_table(tmp_path / "WELL.csv", {**number, **deep("Strekning", METRES)})
    for column, asks in ("md_m=Svy", True), ("md_ft=Svy", True), ("md_m=Strekning", False):
        texts = {f.id: f.text for f in mc.survey(laboratory[1], path, column=column).findings}
        assert ("depths-count" in texts) is asks
        assert not asks or '"md_m=Strekning"' in texts["depths-count"]
    path = text_table(tmp_path / "WELL.csv", deep("Depth (m)", np.arange(count) + 1.0))
    assert "depths-count" in {f.id for f in mc.survey(laboratory[1], path).findings}


@pytest.mark.parametrize(
    ("more", "end"),
    [
        ({"Hole length": ("m", METRES)}, METRES[-1]),
        ({"Borehole length (ft)": ("", METRES / 0.3048)}, METRES[-1]),
        ({"Well length (m)": ("", METRES)}, METRES[-1]),
        ({"Well length (m)": ("", METRES), "Hole length (m)": ("", METRES)}, None),
        ({"Hole length (m)": ("", np.full(len(METRES), 9.1))}, None),
        ({"Hole length (m)": ("", METRES), "MD (m)": ("", METRES + 15)}, METRES[-1] + 15),
    ],
)
def test_a_length_of_hole_is_the_measured_depth_where_nothing_else_may_be(
    tmp_path, laboratory, more, end
):
    table = {name: each for name, each in deep("gone", METRES).items() if name != "gone"}
    path = text_table(tmp_path / "WELL.csv", {**table, **more})
    well = mc.survey(laboratory[1], path)
    assert (None if well.path is None else pytest.approx(well.path.md[-1])) == end


@pytest.mark.parametrize("name", ["Hole length (m)", "Strekning"])
@pytest.mark.parametrize("cell", ["", "x"])
def test_a_cell_without_a_number_does_not_lose_the_column_of_depths(
    tmp_path, laboratory, name, cell
):
    """A blank leaves its station out of the path; text is refused by its place, as in every column of depths."""
    table = {
        each: [*map(repr, map(float, cells))] for each, (_, cells) in deep(name, METRES).items()
    }
    table[name][5] = cell
    if name == "Strekning":
        [text] = [f.text for f in mc.survey(laboratory[1], table).findings if f.id == "no-path"]
        assert '"md_m=Strekning"' in text
    elif cell:
        with pytest.raises(
            InputError, match=r"column 'Hole length \(m\)': expected a number; got 'x'"
        ):
            mc.survey(laboratory[1], table)
    else:
        well = mc.survey(laboratory[1], table)
        assert well.path.md[-1] == pytest.approx(METRES[-1])
        assert np.isnan(well.columns["tvd_m"]).tolist() == [k == 5 for k in range(len(METRES))]


OTHER_LENGTHS = (
    "TVD (m);Water depth (m);Depth m TVD;Cable length (m);Depth (m) MSL;Subsea (m);Elevation (m);Altitude (m);"
    "Strekning (km);Strekning (cm);Strekning (mm);Vertikale Tiefe (m);Wassertiefe (m);Kabellänge (m);Höhe (m);"
    "Vanndybde (m);Høyde (m);Profundidad vertical (m);Profundidad de agua (m);Elevación (m);Lâmina d'água (m);"
    "Comprimento do cabo (m);Profondeur d'eau (m);Longueur de câble (m);Niveau de la mer (m);"
    "Глубина по вертикали (м);Глубина воды (м);Длина кабеля (м);Высота над уровнем моря (м);垂深 (m);水深 (m);海拔 (m)"
)
"""Names of vertical depths, water, cables, heights and other units in the languages of `DEPTHS`."""


def test_other_lengths_are_not_offered_as_measured_depths(tmp_path, laboratory):
    """A well with all of them, and one column that may be the depth, which alone is offered."""
    others = dict.fromkeys(OTHER_LENGTHS.split(";"), ("", METRES))
    path = text_table(tmp_path / "WELL.csv", {**others, **deep("Strekning", METRES)})
    [text] = [f.text for f in mc.survey(laboratory[1], path).findings if f.id == "no-path"]
    assert '"md_m=Strekning"' in text
    assert "It may be" not in text


@pytest.mark.parametrize(
    "cells",
    [9 + 0.013 * np.arange(len(METRES)), np.where(np.arange(len(METRES)) < 6, 15.2, 15.6), METRES],
    ids=["joints", "sensor", "hole"],
)
def test_a_bare_length_is_offered_and_not_taken(tmp_path, laboratory, cells):
    """It may be that of a joint, or from bit to sensor."""
    path = text_table(tmp_path / "WELL.csv", deep("Length (m)", cells))
    well = mc.survey(laboratory[1], path)
    assert well.path is None
    [text] = [f.text for f in well.findings if f.id == "no-path"]
    assert '"md_m=Length (m)"' in text


def test_profile_of_surveys_names_survey(tmp_path):
    table = {n: each for n, each in well_table().items() if n not in ("INC", "AZI", "Btotal")}
    path = workbook(tmp_path / "WELL.xlsx", W=table)
    ran = cli("profile", path, "-o", tmp_path / "tool.toml")
    assert "next: mwdcal survey TOOL.json" in ran.out
    assert "mwdcal calibrate" not in ran.out
    assert "measured depths ('MD') and no angles of a stand" in ran.err
    del table["MD"]
    path = workbook(tmp_path / "RUN.xlsx", W=table)
    assert "mwdcal calibrate" in cli("profile", path, "-o", tmp_path / "run.toml").out


@pytest.mark.parametrize(("stated", "east"), [("2,35 V", -2.35), ("2,35 N", None)])
def test_a_declination_is_used_or_its_line_is_named(tmp_path, laboratory, stated, east):
    """V is west in Norwegian; N is no direction of a declination."""
    path = workbook(tmp_path / "WELL.xlsx", W=well_table())
    book = openpyxl.load_workbook(path)
    book["W"].insert_rows(1, 2)
    book["W"]["A1"], book["W"]["B1"] = "Misvisning", stated
    book.save(path)
    well = mc.survey(laboratory[1], path)
    texts = [f.text for f in well.findings if f.id == "magnetic-north"]
    if east is None:
        assert [f"'Misvisning {stated}' is not understood" in text for text in texts] == [True]
    else:
        turned = well.columns["azimuth_true_deg"] - well.columns["azimuth_magnetic_deg"]
        assert np.nanmax(np.abs((turned - east + 180) % 360 - 180)) < 1e-9
