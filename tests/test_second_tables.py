"""Two runs in one file: each table has the serial, the day and the references of its own title block."""

from __future__ import annotations

from itertools import zip_longest
from pathlib import Path

import numpy as np
import openpyxl
import pytest

import mwdcal as library
from cli_support import mwdcal
from mwdcal.errors import InputError, QuestionError
from mwdcal.files.formats import layout
from mwdcal.files.formats import table as tables
from simulation import DEG, Tool
from simulation import plan as attitudes

NAMES = "Inc,Azi,TF,Gx,Gy,Gz,Bx,By,Bz"
FIRST = [f"{15 + k},{10 * k},{40 * k},0.1,0.2,0.9,1{k}00.5,{k}00.5,4836{k}.4" for k in range(9)]
SECOND = [f"{16 + k},{10 * k},{40 * k},0.1,0.2,0.9,1{k}10.5,{k}10.5,4837{k}.4" for k in range(9)]
A = ["Serial no.,DM-4471", "Date,2026-11-24"]
FIELD = "Total field,49820,nT"


def facts(folder: Path, *blocks: list[str]) -> list[tuple[object, ...]]:
    """Serial, day and field strength of each table of a file, by the lines above each."""
    path, rows = folder / "two.csv", [FIRST, SECOND, FIRST]
    lines = [x for block, each in zip(blocks, rows, strict=False) for x in (*block, NAMES, *each)]
    path.write_text("\n".join(lines) + "\n")
    keys = ("serial", "date", "ref_field_nt")
    return [tuple(t.titles.metadata.get(k) for k in keys) for t in tables.every_table(path)]


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        ([*A, FIELD], ["", "Serial no.,DM-4472", "Date,2026-11-25", "Total field,49790,nT"],
         ("DM-4472", "2026-11-25", 49790.0)),
        ([*A, FIELD], ["Serial no.,DM-4472", "Date,2026-11-25"], ("DM-4472", "2026-11-25", None)),
        ([*A, FIELD], ["", "Serial no.,DM-4472"], ("DM-4472", None, None)),
        (["Serial no.,DM-4471", "", "Date,2026-11-24", "", FIELD], ["", "Serial no.,DM-4472"],
         ("DM-4472", None, None)),
        (["Laboratory X", FIELD, "", *A, ""], ["", "Serial no.,DM-4472", "Date,2026-11-25", ""],
         ("DM-4472", "2026-11-25", 49820.0)),
        ([*A, FIELD], ["Date,2026-11-24", "", "Serial no.,DM-4472", "Date,2026-11-25"],
         ("DM-4472", "2026-11-25", None)),
        ([*A, FIELD], ["", "After adjustment", "Date,2026-11-25"], ("DM-4471", "2026-11-25", 49820.0)),
        ([*A, FIELD], ["", *A[:1], "Date,2026-11-25"], ("DM-4471", "2026-11-25", 49820.0)),
        ([*A, FIELD], ["", "Serial no.,DM-4472", "Date,03/04/2025"], ("DM-4472", None, None)),
        (["Tool DM-4471, 24.11.2026", FIELD], ["", "Tool DM-4472, 25.11.2026"],
         ("DM-4472", "2026-11-25", None)),
    ],
)  # fmt: skip
def test_a_second_table_has_the_facts_of_its_own_block(
    tmp_path: Path, first: list[str], second: list[str], expected: tuple[object, ...]
) -> None:
    """A cover of the file, apart by a blank line, holds for all tables; the block of another tool for none."""
    one, two = facts(tmp_path, first, second)
    assert one == ("DM-4471", "2026-11-24", 49820.0)
    assert two == expected


def test_a_third_table_without_a_block_is_of_the_tool_above_it(tmp_path: Path) -> None:
    every = facts(
        tmp_path, [*A, FIELD], ["", "Serial no.,DM-4472", "Date,2026-11-25"], ["", "Roll test"]
    )
    assert every[2][:2] == ("DM-4472", "2026-11-25")


def test_a_tool_that_comes_back_has_a_table_of_its_own(tmp_path: Path) -> None:
    again = ["", "Serial no.,DM-4471", "Date,2026-11-26"]
    every = facts(tmp_path, [*A, FIELD], ["", "Serial no.,DM-4472", "Date,2026-11-25"], again)
    assert [each[:2] for each in every][1:] == [
        ("DM-4472", "2026-11-25"),
        ("DM-4471", "2026-11-26"),
    ]


@pytest.mark.parametrize(("start", "count"), [(10, 1), (1, 2)])
def test_a_run_of_two_days_whose_numbers_go_on_is_one(
    tmp_path: Path, start: int, count: int
) -> None:
    """The same block is written again for the second day; numbers that begin anew are of another run."""
    path = tmp_path / "days.csv"
    first = [f"{k},{row}" for k, row in enumerate(FIRST, 1)]
    second = [f"{k},{row}" for k, row in enumerate(SECOND, start)]
    block = [A[0], "Date,2026-11-25"]
    names = f"No.,{NAMES}"
    path.write_text("\n".join([*A, names, *first, "", *block, names, *second]) + "\n")
    assert len(tables.every_table(path)) == count


WARM = [f"{row},{t}" for row, t in zip(FIRST, [25] * 9, strict=True)]
HOT = [f"{row},{t}" for row, t in zip(FIRST, [80] * 9, strict=True)]


@pytest.mark.parametrize(
    ("titles", "second", "count"),
    [
        (("Corrida 1", "Corrida 2 (se movió el sensor)"), WARM, 2),
        (("1. Messung", "2. Messung"), WARM, 2), (("第1次", "第2次"), WARM, 2),
        (("Первый замер", "Второй замер"), WARM, 2), (("Run A", "Run B"), WARM, 2),
        (("Run 1", "Run 1 (continued)"), WARM, 1),
        (("Run 1", "Run 2"), HOT, 1), (("Run 1, 25 °C", "Run 2, 80 °C"), WARM, 1),
        (("Series 1", "Series 2"), [f"{row},25" for row in SECOND], 1),
        (("Run 1", "Remark: see 2 below"), WARM, 1),
    ],
)  # fmt: skip
def test_lines_that_number_runs_of_the_same_settings_part_them(
    tmp_path: Path, titles: tuple[str, str], second: list[str], count: int
) -> None:
    """Soaks and series at other settings are one run, and so are stations that are numbered on."""
    path, names = tmp_path / "runs.csv", f"{NAMES},Temp (C)"
    one, two = titles
    path.write_text("\n".join([*A, "", one, names, *WARM, "", two, names, *second]) + "\n")
    assert len(tables.every_table(path)) == count
    if count == 2:
        with pytest.raises(QuestionError, match="2 tables of like columns"):
            library.propose_profile(path)
    for first, expected in ((10, 1), (1, count)):
        rows = [
            [f"{k},{row}" for k, row in enumerate(each, start)]
            for each, start in ((WARM, 1), (second, first))
        ]
        lines = [*A, "", one, f"No,{names}", *rows[0], "", two, f"No,{names}", *rows[1]]
        path.write_text("\n".join(lines) + "\n")
        assert len(tables.every_table(path)) == expected


def test_readings_of_another_table_state_no_reference(tmp_path: Path) -> None:
    """A strength of the channel Mz, with its unit in the name, is a reading."""
    path, names = tmp_path / "two.csv", NAMES.replace("Bz", "Mz raw (nT)")
    second = ["", "Serial no.,DM-4472", FIELD]
    path.write_text("\n".join([*A, FIELD, names, *FIRST, *second, names, *SECOND]) + "\n")
    for each in tables.every_table(path):
        assert (each.titles.metadata["ref_field_nt"], each.titles.choices) == (49820.0, {})


def sheet(name: str, channel: str = "Gx", count: int = 9, again: bool = False) -> layout.Sheet:
    """A sheet of readings, with a table more below where they come `again`."""
    rows = [
        NAMES.replace("Gx", channel).split(","),
        *([float(c) for c in x.split(",")] for x in FIRST[:count]),
    ]
    every = [*rows, ["Serial no.", "DM-4472"], *rows] if again else rows
    return layout.Sheet(name, [*enumerate(every, 1)])


WANTED = ("Gx", "Gy", "Gz", "Bx", "By", "Bz")


def test_a_sheet_with_a_renamed_column_is_not_passed_over_for_another() -> None:
    """An old sheet, or a roll test, is not the run because it still has all names."""
    renamed = sheet("Positions", "Accel X")
    with pytest.raises(
        QuestionError, match=r"'Positions' has no column 'Gx'; sheet 'Positions 2024' has"
    ):
        layout.laid_out([renamed, sheet("Positions 2024")], "w.xlsx", wanted=WANTED)
    with pytest.raises(
        InputError, match="'Positions' has no column 'Gx'; sheet 'Roll test' has, and is a roll"
    ):
        layout.laid_out([renamed, sheet("Roll test")], "w.xlsx", wanted=WANTED)


def test_a_sheet_of_another_name_or_the_one_that_is_named_is_read() -> None:
    alone = layout.laid_out(
        [sheet("Run 2025-03"), sheet("Roll test", count=8)], "w.xlsx", wanted=WANTED
    )
    assert alone.sheet == "Run 2025-03"
    both = [sheet("Positions", "Accel X"), sheet("Positions 2024")]
    assert (
        layout.laid_out(both, "w.xlsx", sheet="Positions 2024", wanted=WANTED).sheet == both[1].name
    )


def test_tables_on_two_sheets_and_twice_on_one_are_told_apart() -> None:
    with pytest.raises(QuestionError) as question:
        layout.laid_out([sheet("A", again=True), sheet("B")], "w.xlsx")
    answers = {each.arguments for each in question.value.answers}
    assert (("sheet", "B"),) in answers
    assert {
        (("sheet", "A"), ("header_row", "1")),
        (("sheet", "A"), ("header_row", "12")),
    } <= answers


def with_names(name: str, names: str, count: int = 9) -> layout.Sheet:
    """A sheet of readings under names of its own."""
    plain = sheet(name, count=count)
    return plain._replace(rows=[(1, names.split(",")), *plain.rows[1:]])


OTHERS = "Inc,Azi,TF,Accel X,Accel Y,Accel Z,Flux X,Flux Y,Flux Z"
ALL_OTHERS = OTHERS.replace("Inc,Azi,TF", "Neigung,Richtung,Rollwinkel")


@pytest.mark.parametrize("order", [1, -1])
def test_a_new_sheet_whose_channels_have_other_names_is_not_passed_over(order: int) -> None:
    """Last year's sheet still has the names of the profile: it is asked about, or a finding names the new one."""
    old, new = sheet("Run 2025"), with_names("Run 2026", OTHERS, 8)
    with pytest.raises(
        QuestionError, match=r"'Run 2026' has no columns 'Gx', .*; sheet 'Run 2025' has. If"
    ):
        layout.laid_out([old, new][::order], "w.xlsx", wanted=WANTED)
    for new, said in (
        (
            with_names("Run 2026", OTHERS),
            r"those of 'Run 2026' at the same stations are no part of",
        ),
        (
            with_names("Run 2026", ALL_OTHERS),
            "the 9 readings under other names on sheet 'Run 2026'",
        ),
    ):
        read = layout.laid_out([old, new][::order], "w.xlsx", wanted=WANTED)
        assert read.sheet == "Run 2025"
        assert any(said in each for each in read.remarks)
        assert not layout.laid_out([old], "w.xlsx", wanted=WANTED).remarks


def test_the_angles_of_a_run_are_those_of_the_sheet_with_its_channels() -> None:
    """Another year's sheet of the same stations, in front, has read other inclinations."""
    new = with_names("Run 2026", "No,Rolls,Inc,Azi,TF,Accel X,Accel Y,Accel Z")
    old = with_names("Run 2025", "No,Rolls,Inc,Azi,TF,Gx,Gy,Gz")
    for number, each in enumerate((new, old)):
        each.rows[1:] = [
            (k, [k, 7 * k % 5, 15 + k + 0.01 * number, 10 * k, 40 * k, *row[3:6]])
            for k, row in each.rows[1:]
        ]
    read = layout.laid_out([new, old], "w.xlsx", wanted=("Gx", "Gy", "Gz"))
    assert read.cells[read.names.index("Inc")][0] == "17.01"


def test_channels_of_two_sheets_are_joined_without_a_word_on_another_run() -> None:
    """A profile of both triads: each on a sheet of its own."""
    one = with_names("Acc", "Inc,Azi,TF,Gx,Gy,Gz")
    two = with_names("Mag", "Inc,Azi,TF,Bx,By,Bz")
    (said,) = layout.laid_out([one, two], "w.xlsx", wanted=WANTED).remarks
    assert "'Acc' and 'Mag' are one table" in said


TITLES = [
    "Inclination (°)",
    "Azimuth (°)",
    "Toolface (°)",
    *(f"{t}{a}" for t in "GB" for a in "xyz"),
]
FACTS: list[list[object]] = [["Tool", "DM-4471"], ["Serial no.", "DM-4471"], ["Date", "12.03.2026"]]


def measured(seed: int, *angles: np.ndarray) -> list[list[object]]:
    """The rows of a table of a simulated tool: its angles of the stand and readings."""
    tool, rng = Tool.random(7), np.random.default_rng(seed)
    clean = zip(tool.clean(*angles), tool.noise, strict=True)
    readings = [each + sd * rng.normal(size=each.shape) for each, sd in clean]
    return np.column_stack([*np.degrees(angles), *readings]).tolist()


RUN = measured(1, *attitudes((5, 45, 90, 135), 6))
ROLLS = measured(2, *(np.full(12, a * DEG) for a in (60, 30)), np.arange(12) * 30 * DEG)


def written(path: Path, rows: list[list[object]]) -> Path:
    """A workbook of these rows."""
    book = openpyxl.Workbook()
    for row in rows:
        book.active.append(row)
    book.save(path)
    return path


def beside(one: list[list[object]], other: list[list[object]]) -> list[list[object]]:
    """Two tables side by side, with a blank column between them."""
    wide = zip_longest(one, other, fillvalue=[])
    return [[*row, *[None] * (len(TITLES) + 1 - len(row)), *behind] for row, behind in wide]


@pytest.mark.parametrize("place", ["below", "beside"])
@pytest.mark.parametrize(
    ("first", "second", "day"),
    [
        ([*FACTS, ["Roll test"]], [["Calibration run"]], "2026-03-12"),
        ([*FACTS, ["Roll test 13.03.2026"]], [["Calibration run"]], "2026-03-13"),
        ([["Verification"], *FACTS], [["Calibration"], *FACTS], "2026-03-12"),
        ([["Roll test 13.03.2026"], *FACTS], [["Calibration"], *FACTS], "2026-03-13"),
    ],
)
def test_a_roll_test_above_or_beside_the_run_is_known_by_the_title_of_its_block(
    tmp_path: Path, place: str, first: list[list[object]], second: list[list[object]], day: str
) -> None:
    """The run has 24 stations, the roll test 12: no question which is which, whatever comes first."""
    high = max(len(first), len(second)) if place == "beside" else 0
    tables = [
        [*[[]] * (high - len(block)), *block, TITLES, *rows]
        for block, rows in ((first, ROLLS), (second, RUN))
    ]
    rows = beside(*tables) if place == "beside" else [*tables[0], [], *tables[1]]
    path, tool, fit = written(tmp_path / "w.xlsx", rows), tmp_path / "t.toml", tmp_path / "c.json"
    for words in (("profile", path, "-o", tool), ("calibrate", path, "--tool", tool, "-o", fit)):
        assert mwdcal(*words).code == 0
    calibration = library.load(fit)
    assert (calibration.stations, calibration.tool["date"]) == (len(RUN), "2026-03-12")
    judged = mwdcal("verify", fit, path, "--json").json
    assert (judged["stations"], judged["date"]) == (len(ROLLS), day)


@pytest.mark.parametrize(
    ("stated", "day"), [([["Date", "2026-03-13"]], "2026-03-13"), ([], "2024-03-12")]
)
def test_the_day_of_the_calibration_in_the_title_of_a_roll_test_is_not_its_own(
    tmp_path: Path, stated: list[list[object]], day: str
) -> None:
    """The title's day holds only where the block states none."""
    title = ["Roll test of calibration 12.03.2024"]
    path = written(tmp_path / "w.xlsx", [title, *stated, TITLES, *ROLLS])
    (table,) = tables.every_table(path)
    assert table.titles.metadata["date"] == day


@pytest.mark.parametrize(
    "line", ["Roll test 13.03.2026", "Check due 13.03.2026", "Verified 13.03.2026"]
)
def test_the_day_behind_a_title_is_that_of_a_roll_test_only(tmp_path: Path, line: str) -> None:
    """The day of the next check or of a signature is not the day of the measurement."""
    both = facts(tmp_path, A, ["", line])
    assert both[1][1] == ("2026-03-13" if line.startswith("Roll") else "2026-11-24")


@pytest.mark.parametrize(("title", "kind"), [("Roll 90°", "roll test"), ("Calibration run", "")])
def test_a_table_below_a_roll_test_is_one_too_unless_it_is_called_a_run(
    tmp_path: Path, title: str, kind: str
) -> None:
    """The inclination alone of a second set does not make it the run."""
    path = tmp_path / "two.csv"
    lines = [*A, "Roll test 45°", NAMES, *FIRST, "", title, NAMES, *SECOND]
    path.write_text("\n".join(lines) + "\n")
    assert [t.kind for t in tables.every_table(path)] == ["roll test", kind]


@pytest.mark.parametrize("suffix", ["csv", "xlsx"])
def test_names_repeated_below_a_roll_test_are_not_joined_to_it_in_silence(
    tmp_path: Path, suffix: str
) -> None:
    """Nothing calls the second table a run, nor are its rows numbered on: somebody must say what it is."""
    rows = [["Roll test"], *FACTS, TITLES, *ROLLS, [], TITLES, *RUN]
    path = tmp_path / f"two.{suffix}"
    if suffix == "xlsx":
        written(path, rows)
    else:
        path.write_text("\n".join(",".join(map(str, row)) for row in rows) + "\n")
    asked = mwdcal("profile", path, "-o", tmp_path / "t.toml")
    assert asked.code != 0
    line = len(FACTS) + len(ROLLS) + 4
    assert str(line) in asked.err
