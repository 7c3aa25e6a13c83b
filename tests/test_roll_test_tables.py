"""Roll tests whose tables name their columns otherwise than the run's, in the run's workbook or a file of their own.

What is expected is the verdict on the same readings under the names of the run.
"""

from __future__ import annotations

import csv
import re

import numpy as np
import openpyxl
import pytest

import mwdcal as library
from cli_support import SCALE, mwdcal, refused, servo_run
from test_wrong_inputs import measured

SPANISH_RUN = {
    "station": "Punto", "temperature_c": "Temperatura (°C)",
    **{f"a{i}": f"Acelerómetros {i.upper()} (g)" for i in "xyz"},
    **{f"m{i}": f"Magnetómetros {i.upper()} (G)" for i in "xyz"},
    "ref_inclination_deg": "Inclinación (°)", "ref_azimuth_deg": "Azimut (°)",
    "ref_toolface_deg": "Cara de la herramienta (°)", "ref_gravity_g": "Gravedad local (g)",
    "ref_field_nt": "Campo total (nT)", "ref_dip_deg": "Echado magnético (°)",
}  # fmt: skip
"""Names of the columns of the run; gauss and g."""


def shorter(angles, raw, field, warmth, gravity="g", magnetic="G"):
    """Names of a roll test: of three angles, of channels with {} for the axis, and of the temperature."""
    names = zip(("ref_inclination_deg", "ref_azimuth_deg", "ref_toolface_deg"), angles, strict=True)
    return {
        **dict(names), "temperature_c": warmth,
        **{f"a{i}": f"{raw.format(i)} ({gravity})" for i in "xyz"},
        **{f"m{i}": f"{field.format(i)} ({magnetic})" for i in "xyz"},
    }  # fmt: skip


TESTS = {
    "Prueba de giro": shorter(("Inclinación °", "Azimut °", "Cara °"), "G{}", "B{}", "Temp °C"),
    "Rolltest": shorter(("Neigung [°]", "Azimut [°]", "Verdrehung [°]"), "Beschl. {}", "Magnetfeld {}", "Temp. [°C]"),
    "Rollprüfung": shorter(("Neigung °", "Azimut °", "HS °"), "G{}", "H{}", "T °C", "mg", "µT"),
    "Rulletest": shorter(("Helning (°)", "Asimut (°)", "Verktøyflate (°)"), "Aks {}", "Mag {}", "Temperatur (°C)"),
    "Teste de rotação": shorter(
        ("Inclinação (°)", "Azimute (°)", "TF grav (°)"), "G{}", "B{}", "Temp (°C)", "m/s²", "nT"
    ),
    "Проверка вращением": shorter(
        ("Зенитный угол, °", "Азимут, °", "Угол установки, °"), "G{}", "B{}", "Температура, °C", "mg", "mG"
    ),
    "滚转检验": shorter(("井斜角(°)", "方位角(°)", "工具面角(°)"), "加速度计{}", "磁通门{}", "温度(℃)", "mg", "nT"),
    "Roll check": shorter(("Inc", "Azi", "GTF"), "G{}", "B{}", "Temp"),
}  # fmt: skip
"""The name of its sheet, and those of its columns."""
UNITS = {"g": 1.0, "mg": 1e3, "m/s²": 9.80665, "G": 1e-5, "nT": 1.0, "µT": 1e-3, "mG": 1e-2}
"""Of a g, and of a nanotesla."""


def run_in_gauss(rows, names, decimals=9):
    """Columns under other names, their channels in the units that these state; stations numbered."""
    columns = {}
    for column, name in names.items():
        cells = np.asarray(rows[column], float)
        if column[0] in "am" and len(column) == 2:
            stated = re.search(r"\((.*)\)$", name)
            cells = cells / SCALE[column[0] == "m"] * UNITS[stated[1] if stated else "g"]
            cells = np.round(cells, decimals)
        columns[name] = cells
    return columns


def sheet_of(book, title, columns, above=()):
    sheet = book.create_sheet(title)
    for line in above:
        sheet.append([line])
    sheet.append([*columns])
    for row in zip(*(c.tolist() for c in columns.values()), strict=True):
        sheet.append(row)


def workbook(path, run=True, **tests):
    """A workbook with the run and sheets of roll tests."""
    book = openpyxl.Workbook()
    book.remove(book.active)
    if run:
        sheet_of(book, "Calibración", run_in_gauss(servo_run(), SPANISH_RUN))
    for title, columns in tests.items():
        sheet_of(book, title, columns)
    book.save(path)
    return path


def rolled(names, bias_g=0.0):
    rows = measured((45,), 12, noise=3, azimuth=1.0)
    rows["ax"] = rows["ax"] + bias_g * SCALE[0]
    return run_in_gauss(rows, names)


def rows_of(document):
    """The figures of a verdict that do not depend on the last digit of a reading in another unit."""
    return {r["name"]: (r["passed"], pytest.approx(r["value"], abs=2e-5)) for r in document["rows"]}


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory):
    """A folder with the run alone, its profile and calibration, and the verdict under the names of the run."""
    folder = tmp_path_factory.mktemp("laboratory")
    run = workbook(folder / "run.xlsx")
    ran = mwdcal("profile", run, "-o", folder / "tool.toml")
    assert ran.code == 0, ran
    ran = mwdcal("calibrate", run, "--tool", folder / "tool.toml", "-o", folder / "cal.json")
    assert ran.code == 0, ran
    kept = {n: SPANISH_RUN[n] for n in (*TESTS["Rolltest"],)}
    alone = workbook(folder / "roll.xlsx", run=False, Hoja1=rolled(kept))
    ran = mwdcal("verify", folder / "cal.json", alone, "--json")
    assert ran.code == 0, ran
    assert "roll-test-read" not in [each["id"] for each in ran.json["findings"]]
    return folder, rows_of(ran.json)


def read_of(document):
    """The findings on how a roll test was read."""
    (said,) = [f["text"] for f in document["findings"] if f["text"].startswith("the roll test was")]
    return said


@pytest.mark.parametrize("title", TESTS)
def test_a_roll_test_on_a_sheet_of_the_run_is_read_by_its_own_names(tmp_path, laboratory, title):
    expected, names = laboratory[1], TESTS[title]
    book = workbook(tmp_path / "T.xlsx", **{title: rolled(names)})
    ran = mwdcal("profile", book, "-o", tmp_path / "t.toml")
    assert f"--rolltest {book}" in ran.out, ran
    assert f"roll test on sheet '{title}', 12 rows" in ran.out + ran.err, ran
    cal = tmp_path / "c.json"
    tool = ("--tool", tmp_path / "t.toml", "-o", cal)
    ran = mwdcal("calibrate", book, *tool, "--rolltest", book, "--json")
    assert ran.code == 0, ran
    assert rows_of(ran.json["verification"]) == expected
    for command in ("verify", "diagnose"):
        ran = mwdcal(command, cal, book, "--json")
        assert ran.code == 0, ran
        said = read_of(ran.json)
        assert f"sheet '{title}'" in said
        assert all(f"{column} = '{name}'" in said for column, name in names.items()), said
    assert rows_of(mwdcal("verify", cal, book, "--json").json) == expected
    verdict = library.verify(cal, book)
    assert verdict.passed
    assert rows_of(verdict.to_dict()) == expected


def as_csv(path, columns, delimiter=";", decimal=","):
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, delimiter=delimiter)
        writer.writerow(columns)
        for row in zip(*(c.tolist() for c in columns.values()), strict=True):
            writer.writerow([repr(v).replace(".", decimal) for v in row])
    return path


@pytest.mark.parametrize("title", TESTS)
@pytest.mark.parametrize("suffix", ["xlsx", "csv"])
def test_a_roll_test_in_a_file_of_its_own_is_read_by_its_own_names(tmp_path, laboratory, title, suffix):  # fmt: skip
    folder, expected = laboratory
    columns = rolled(TESTS[title])
    path = tmp_path / f"test.{suffix}"
    if suffix == "csv":
        as_csv(path, columns)
    else:
        workbook(path, run=False, Sheet1=columns)
    ran = mwdcal("verify", folder / "cal.json", path, "--json")
    assert ran.code == 0, ran
    assert rows_of(ran.json) == expected
    both = ("--tool", folder / "tool.toml", "-o", tmp_path / "c.json", "--rolltest", path)
    ran = mwdcal("calibrate", folder / "run.xlsx", *both)
    assert ran.code == 0, ran
    assert "the roll test was read" in ran.err


def test_a_tool_that_is_off_fails_by_names_of_its_own(tmp_path, laboratory):
    names = TESTS["Rollprüfung"]
    book = workbook(tmp_path / "T.xlsx", Rollprüfung=rolled(names, bias_g=0.01))
    ran = mwdcal("verify", laboratory[0] / "cal.json", book)
    assert ran.code == 1, ran
    assert "FAIL" in ran.out


def test_the_only_other_table_of_channels_is_the_roll_test_and_of_two_the_sheet_is_asked(
    tmp_path, laboratory
):
    cal, expected = laboratory[0] / "cal.json", laboratory[1]
    columns = rolled(TESTS["Prueba de giro"])
    one = workbook(
        tmp_path / "one.xlsx", Hoja2=columns, Notas={"a": np.arange(9.0), "b": np.arange(9.0)}
    )
    assert rows_of(mwdcal("verify", cal, one, "--json").json) == expected
    two = workbook(tmp_path / "two.xlsx", Hoja2=columns, Hoja3=rolled(TESTS["Rolltest"], 0.01))
    message = refused(mwdcal("verify", cal, two), 3)
    assert "--sheet Hoja2 or --sheet Hoja3" in message
    assert mwdcal("verify", cal, two, "--sheet", "Hoja2").code == 0
    assert mwdcal("verify", cal, two, "--sheet", "Hoja3").code == 1
    assert library.verify(cal, two, sheet="Hoja2").passed
    assert not library.verify(cal, two, sheet="Hoja3").passed
    message = refused(mwdcal("verify", cal, two, "--sheet", "Hoja9"), 2)
    assert "no table on a sheet 'Hoja9'" in message
    shown = mwdcal("profile", two, "-o", tmp_path / "t.toml")
    assert all(f"sheet 'Hoja{n}', 12 rows" in shown.err for n in "23"), shown
    assert "--rolltest" not in shown.out


def test_a_roll_test_that_cannot_be_read_is_refused_before_anything_is_written(
    tmp_path, laboratory
):
    columns = rolled(TESTS["Prueba de giro"])
    columns["Kanal A"], columns["Kanal B"] = columns.pop("Gy (g)"), columns.pop("Bz (G)")
    book = workbook(tmp_path / "T.xlsx", **{"Prueba de giro": columns})
    cal = tmp_path / "c.json"
    tool = ("--tool", laboratory[0] / "tool.toml", "-o", cal, "--rolltest", book)
    message = refused(mwdcal("calibrate", book, *tool), 2)
    assert message.startswith("mwdcal: T.xlsx: ")
    assert "--rolltest-column ay=NAME --rolltest-column mz=NAME" in message
    plan = tmp_path / "plan.toml"
    plan.write_text('name = "p"\n[[stations]]\ninclination_deg = 45\n', "utf-8")
    assert "the suffix must be" in refused(mwdcal("calibrate", book, *tool[:-1], plan), 2)
    assert not cal.exists()
    assert mwdcal("calibrate", book, *tool[:-2]).code == 0
    said = ("--column", "ay=Kanal A", "--column", "mz=Kanal B (gauss)")
    assert mwdcal("verify", cal, book, *said).code == 0
    beside = [each.replace("--column", "--rolltest-column") for each in said]
    assert mwdcal("calibrate", book, *tool, *beside).code == 0


def test_verify_and_calibrate_agree_on_a_file_without_a_roll_test(tmp_path, laboratory):
    """Neither sends to the other."""
    run, cal = laboratory[0] / "run.xlsx", laboratory[0] / "cal.json"
    tool = ("--tool", laboratory[0] / "tool.toml", "-o", tmp_path / "c.json")
    messages = [
        refused(mwdcal("verify", cal, run), 2),
        refused(mwdcal("calibrate", run, *tool, "--rolltest", run), 2),
    ]
    assert "48 of 48 stations were in the fit" in messages[0]
    assert "no column marks a roll test in it" in messages[1]
    assert not any("mwdcal calibrate" in each or "mwdcal verify" in each for each in messages)


def test_a_roll_test_of_angles_alone_judges_nothing_and_is_named(tmp_path, laboratory):
    """Inclinations and toolfaces that the tool has computed, without its readings."""
    angles = {
        name: np.arange(8.0) * k
        for k, name in enumerate(("Inc set", "TF set", "Inc read", "TF read"), 3)
    }
    book = workbook(tmp_path / "T.xlsx", **{"Roll Test": angles})
    ran = mwdcal("profile", book, "-o", tmp_path / "t.toml")
    assert "the roll test of sheet 'Roll Test' has no columns called as channels" in ran.err, ran
    assert "--rolltest" not in ran.out
    cal = tmp_path / "c.json"
    tool = ("--tool", tmp_path / "t.toml", "-o", cal)
    assert mwdcal("calibrate", book, *tool).code == 0
    for message in (
        refused(mwdcal("verify", cal, book), 2),
        refused(mwdcal("calibrate", book, *tool, "--rolltest", book), 2),
    ):
        assert "'Roll Test' has no columns called as channels" in message


def test_names_that_differ_in_brackets_blanks_case_and_accents_are_the_same(tmp_path, laboratory):
    """Also those that say nothing by themselves."""
    run = {**SPANISH_RUN, "ref_toolface_deg": "P-2 (°)", "ax": "Canál uno (g)"}
    book = openpyxl.Workbook()
    book.remove(book.active)
    sheet_of(book, "Cal", run_in_gauss(servo_run(), run))
    test = {n: name for n, name in run.items() if n in TESTS["Rolltest"]}
    test |= {
        "ref_toolface_deg": "p-2 °",
        "ax": "CANAL UNO (g)",
        "ref_inclination_deg": "inclinacion°",
    }
    sheet_of(book, "Roll test", rolled(test))
    path = tmp_path / "T.xlsx"
    book.save(path)
    said = ("--column", "ref_toolface_deg=P-2 (°)", "--column", "ax=Canál uno (g)")
    ran = mwdcal("profile", path, "-o", tmp_path / "t.toml", *said)
    assert ran.code == 0, ran
    both = ("--tool", tmp_path / "t.toml", "-o", tmp_path / "c.json", "--rolltest", path, "--json")
    ran = mwdcal("calibrate", path, *both)
    assert ran.code == 0, ran
    assert rows_of(ran.json["verification"]) == laboratory[1]


def test_all_missing_columns_are_listed_at_once(tmp_path, laboratory):
    columns = rolled({n: SPANISH_RUN[n] for n in TESTS["Rolltest"]})
    less = {n: c for n, c in columns.items() if n not in (SPANISH_RUN["ay"], SPANISH_RUN["mz"])}
    path = workbook(tmp_path / "less.xlsx", run=False, Hoja1=less)
    message = refused(mwdcal("verify", laboratory[0] / "cal.json", path), 2)
    assert "no column for ay, mz" in message


@pytest.mark.parametrize("unit", ["counts", ""])
def test_readings_in_a_unit_that_is_not_that_of_the_run_are_refused(tmp_path, laboratory, unit):
    names = TESTS["Rollprüfung"]
    columns = {
        name.replace("(mg)", f"({unit})" if unit else "").strip(): cells
        for name, cells in rolled(names).items()
    }
    path = workbook(tmp_path / "T.xlsx", run=False, Hoja1=columns)
    message = refused(mwdcal("verify", laboratory[0] / "cal.json", path), 2, 3)
    assert "unit" in message or "Convert" in message


def test_python_says_where_a_roll_test_goes_and_which_names_it_expects(tmp_path, laboratory):
    run = laboratory[0] / "run.xlsx"
    with pytest.raises(library.InputError, match=r"mwdcal\.verify\(cal, FILE\)"):
        library.calibrate(run, laboratory[0] / "tool.toml", rolltest="roll.xlsx")
    cal = library.load(laboratory[0] / "cal.json")
    frame = {"gx": np.ones(3), "gy": np.zeros(3), "gz": np.zeros(3)}
    with pytest.raises(
        library.InputError,
        match=r"for mx, my, mz \(in the run 'Mag.* X \(G\)'.*'Magnetómetros Z \(G\)'",
    ):
        library.apply(cal, frame)
    pytest.importorskip("pandas")
    table = library.apply(cal, run).to_pandas()
    assert table["station"].tolist()[:2] == ["1", "2"]
    assert table["temperature_c"].tolist()[0] == 25.0
    assert [*table.columns][2:] == [*library.apply(cal, run).columns]


@pytest.mark.parametrize(
    ("line", "said"), [("Serial AB-17", False), ("Rulletest etter kalibrering AB-18", True)]
)
def test_a_roll_test_without_a_serial_of_its_own_is_said_to_have_none(
    laboratory, tmp_path, line, said
):
    """The run states AB-17; a number in a title without a word for it is no serial."""
    book = openpyxl.Workbook()
    book.remove(book.active)
    run = run_in_gauss(servo_run(), SPANISH_RUN)
    sheet_of(book, "Calibración", run, ["Serial AB-17"])
    sheet_of(book, "Rulletest", rolled(TESTS["Rulletest"]), [line])
    path = tmp_path / "run.xlsx"
    book.save(path)
    ran = mwdcal(
        "calibrate", path, "--tool", laboratory[0] / "tool.toml", "-o", tmp_path / "c.json",
        "--rolltest", path, "--json",
    )  # fmt: skip
    assert ran.code == 0, ran.err
    findings = [*ran.json["findings"], *ran.json["verification"]["findings"]]
    found = [f["text"] for f in findings if f["id"] == "no-serial"]
    assert [f.partition(": ")[0] for f in found] == [
        "no serial in run.xlsx, sheet 'Rulletest'"
    ] * said
