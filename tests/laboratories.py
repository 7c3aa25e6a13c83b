"""Forty invented tables of calibration laboratories, made without a look at the reader that they test.

Each table is a file as a technician has it: from a spreadsheet program, LabVIEW, a logger, or typed by hand. Readings
and references follow design/theory.md: z along the tool and downhole, y the toolface scribe, inclination from the
downward vertical, azimuth magnetic, toolface clockwise looking downhole. Compare angles of `truth` modulo 360.

Keys of `truth`: ax ay az mx my mz are raw, as they stand in the columns (only decimal and thousands signs read);
references are in the units of their names whatever the file has, gravity in standard g (9.80665 m/s²).
"""

from __future__ import annotations

import io
import json
import re
import sys
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
STANDARD_GRAVITY = 9.80665


class Formula(NamedTuple):
    """A formula cell with the value its program has stored; `{r}` in the text is the cell's own row."""

    text: str
    value: float


Cell = str | int | float | datetime | Formula | None
Grid = tuple[tuple[Cell, ...], ...]
Rows = Sequence[Sequence[Cell]]


class Sheet(NamedTuple):
    """A sheet: merged are (row, column, last row, last column) from 0, hidden are row numbers from 0."""

    name: str
    grid: Grid
    merged: tuple[tuple[int, int, int, int], ...] = ()
    hidden: tuple[int, ...] = ()


class Text(NamedTuple):
    """How a text file is written. Delimiter "  " stands for columns filled up with blanks."""

    delimiter: str
    encoding: str = "utf-8"
    newline: str = "\r\n"
    quote: Literal["needed", "text", "all"] = "needed"
    padded: bool = False


@dataclass(frozen=True)
class Form:
    """What a file is written from; `rows` are the stations' rows, `keys` what of the truth each column is."""

    sheets: tuple[Sheet, ...]
    header: int
    rows: tuple[int, ...]
    keys: tuple[str, ...]
    at: int = 0
    text: Text | None = None
    movable: bool = True


@dataclass(frozen=True, eq=False)
class Laboratory:
    """One table, its truth, and what an intelligent reader does with it.

    `changes` is set by `mutated`: "nothing", the truth still holds, or "values", a reading or a reference was changed
    or lost. `mutation` says what was done.
    """

    name: str
    file: str
    content: bytes = field(repr=False)
    truth: dict[str, Any] = field(repr=False)
    trap: str
    expected: Literal["taken", "asks"]
    question: str
    form: Form = field(repr=False)
    changes: Literal["", "nothing", "values"] = ""
    mutation: str = ""


# --- The stand and the tool -------------------------------------------------------------------


class Place(NamedTuple):
    gravity: float
    field: float
    dip: float


HOUSTON, ABERDEEN = Place(0.99861, 46812.0, 58.52), Place(1.00104, 50743.0, 71.34)
CALGARY, PERTH = Place(1.00015, 56120.0, 73.21), Place(0.99872, 58214.0, -66.08)
CELLE, STAVANGER = Place(1.00063, 49633.0, 67.92), Place(1.00122, 50911.0, 72.31)
NEUQUEN, MACAE = Place(0.99902, 24845.0, -39.12), Place(0.99803, 23127.0, -39.87)
PERM, XIAN = Place(1.00108, 56803.0, 74.05), Place(0.99875, 53618.0, 54.33)
BOGOTA, VILLAHERMOSA = Place(0.99669, 29522.0, 30.41), Place(0.99770, 41508.0, 46.24)
ANCHORAGE, DUBAI = Place(1.00128, 55317.0, 73.94), Place(0.99829, 44530.0, 39.06)

FOUR = ((5.0, 0.0), (45.0, 90.0), (90.0, 180.0), (135.0, 270.0))
FIVE = ((0.0, 0.0), (30.0, 70.0), (60.0, 140.0), (90.0, 215.0), (120.0, 290.0))
SIX = ((2.0, 0.0), (30.0, 60.0), (60.0, 120.0), (90.0, 180.0), (120.0, 240.0), (150.0, 300.0))
CUBE = tuple((inclination, azimuth) for inclination in (1.0, 90.0, 179.0) for azimuth in (0, 90))


def rolls(directions: Iterable[tuple[float, float]], faces: int, first: float = 0.0) -> Array:
    """Every toolface at every direction: rows of inclination, azimuth, toolface, degrees."""
    turns = [(first + 360.0 * k / faces) % 360 for k in range(faces)]
    return np.array([(i, a, t) for i, a in directions for t in turns])


@dataclass(frozen=True, eq=False)
class Run:
    """References as the stand shows them, and readings along the tool axes in standard g and nT."""

    inclination: Array
    azimuth: Array
    toolface: Array
    temperature: Array
    gravity: Array
    field: Array
    dip: Array
    g: Array
    b: Array

    def __len__(self) -> int:
        return len(self.inclination)

    def accelerometer(
        self, scale: float, digits: int, axes: str = "+x+y+z", offset: float = 0.0
    ) -> Array:
        """Columns of the laboratory's three channels, each along one axis of the tool, as printed."""
        return _channels(self.g, scale, digits, axes, offset)

    def magnetometer(
        self, scale: float, digits: int, axes: str = "+x+y+z", offset: float = 0.0
    ) -> Array:
        return _channels(self.b, scale, digits, axes, offset)


def _channels(vectors: Array, scale: float, digits: int, axes: str, offset: float) -> Array:
    picked = [float(axes[k] + "1") * vectors[:, "xyz".index(axes[k + 1])] for k in (0, 2, 4)]
    return np.round(scale * np.array(picked).T + offset, digits) + 0.0


def directions_of(angles: Array, dip: Array) -> tuple[Array, Array]:
    """Unit vectors of gravity and field in the tool frame, theory section 1."""
    (si, sa, st), (ci, ca, ct) = np.sin(angles.T), np.cos(angles.T)
    sd, cd = np.sin(dip), np.cos(dip)
    gravity = np.array([-si * st, -si * ct, ci]).T
    bx = cd * (ci * ca * st + sa * ct) - sd * si * st
    by = cd * (ci * ca * ct - sa * st) - sd * si * ct
    return gravity, np.array([bx, by, cd * si * ca + sd * ci]).T


def measure(
    plan: Array, place: Place, seed: int, *, setting: float = 0.03, digits: int = 2,
    temperatures: Sequence[float] = (25.0,),
) -> Run:  # fmt: skip
    """Carry out a plan with a tool drawn by the seed; `setting` is how far the stand stops off the plan."""
    rng = np.random.default_rng([20260314, seed])
    angles = np.tile(plan, (len(temperatures), 1))
    n = len(angles)
    angles = np.round(angles + rng.normal(0, setting, (n, 3)) * (setting > 0), digits)
    inclination, azimuth, toolface = np.abs(angles[:, 0]), angles[:, 1] % 360, angles[:, 2] % 360
    temperature = np.repeat(temperatures, len(plan)) + rng.normal(0, 0.25, n).cumsum() / 4
    field_nt = np.round(place.field + rng.normal(0, 2.5, n).cumsum())
    dip = np.round(place.dip + rng.normal(0, 0.002, n).cumsum(), 2)
    seen = np.round(np.array([inclination, azimuth, toolface]).T, digits)
    stand = np.radians(seen + rng.normal(0, 0.008, (n, 3)))
    down, north = directions_of(stand, np.radians(dip))
    warm = (temperature - 25)[:, None]
    g = _sensed(place.gravity * down, warm, rng, (0.01, 0.002, 3e-3, 4e-5, 1.5e-5, 1e-4))
    b = _sensed(field_nt[:, None] * north, warm, rng, (0.01, 0.003, 180.0, 4e-5, 0.8, 12.0))
    constant = np.full(n, place.gravity)
    inclination, azimuth, toolface = seen.T
    warmth = np.round(temperature, 1)
    return Run(inclination, azimuth, toolface, warmth, constant, field_nt, dip, g, b)


def _sensed(
    vectors: Array, warm: Array, rng: np.random.Generator, errors: tuple[float, ...]
) -> Array:
    scale, skew, bias, scale_drift, bias_drift, noise = errors
    gain = np.eye(3) + np.diag(rng.normal(0, scale, 3)) + rng.normal(0, skew, (3, 3))
    changing = 1 + rng.normal(0, scale_drift, 3) * warm
    shift = rng.normal(0, bias, 3) + rng.normal(0, bias_drift, 3) * warm
    return vectors @ gain.T * changing + shift + rng.normal(0, noise, vectors.shape)


LETTERS = {
    "T": ("temperature_c", "temperature"), "I": ("ref_inclination_deg", "inclination"),
    "A": ("ref_azimuth_deg", "azimuth"), "F": ("ref_toolface_deg", "toolface"),
    "G": ("ref_gravity_g", "gravity"), "B": ("ref_field_nt", "field"), "D": ("ref_dip_deg", "dip"),
}  # fmt: skip


def facts(run: Run, a: Array, m: Array, letters: str = "TIAF", **more: Any) -> dict[str, Any]:
    """The truth of a table: raw channels, the references that its file has, and what else is said of it."""
    known: dict[str, Any] = dict(
        zip(("ax", "ay", "az", "mx", "my", "mz"), [*a.T, *m.T], strict=True)
    )
    known |= {LETTERS[k][0]: getattr(run, LETTERS[k][1]) for k in letters}
    return known | more


# --- Cells, columns and rows ------------------------------------------------------------------


class Column(NamedTuple):
    key: str
    header: str
    cells: Sequence[Cell]


def typed(values: Array, digits: int, decimal: str = ".", group: str = "") -> list[str]:
    """Numbers as a program prints them."""
    texts = [f"{value:,.{digits}f}" for value in values + 0.0]
    return [text.translate({44: group, 46: decimal}) for text in texts]


def triad(
    kind: str, header: str, values: Array, digits: int | None = None, *signs: str
) -> list[Column]:
    """Three columns of a sensor; `{}` of the header is its letter. Without digits: numbers for a spreadsheet."""
    cells = [v.tolist() if digits is None else typed(v, digits, *signs) for v in values.T]
    names = [header.format(letter) for letter in "XYZ"]
    return [Column(kind + "xyz"[k], names[k], cells[k]) for k in range(3)]


def references(
    run: Run, letters: str, headers: Sequence[str], digits: int | None = None, *signs: str
) -> list[Column]:
    """A column of each reference or temperature in the letters; temperature and field with fewer digits."""
    columns = []
    for letter, header in zip(letters, headers, strict=True):
        key, name = LETTERS[letter]
        values: Array = getattr(run, name)
        fewer = {"T": 1, "B": 0, "G": 5}.get(letter, digits or 0)
        cells = values.tolist() if digits is None else typed(values, fewer, *signs)
        columns.append(Column(key, header, cells))
    return columns


def other(header: str, cells: Iterable[Cell]) -> Column:
    """A column that is not of the truth."""
    return Column("", header, list(cells))


def numbers(run: Run, header: str, form: str = "{}") -> Column:
    return other(header, [form.format(k + 1) for k in range(len(run))])


def times(run: Run, header: str, start: datetime, form: str | None, step: int = 95) -> Column:
    """When each station was read; without a form: real dates of a spreadsheet."""
    moments = [start + timedelta(seconds=step * k + (k * 37) % 11) for k in range(len(run))]
    return other(header, [t.strftime(form) if form else t for t in moments])


def remarks(run: Run, header: str, said: Mapping[int, str]) -> Column:
    return other(header, [said.get(k, "") for k in range(len(run))])


class Layout(NamedTuple):
    grid: Grid
    header: int
    rows: tuple[int, ...]
    keys: tuple[str, ...]


def laid_out(
    columns: Sequence[Column], *, before: Rows = (), over: Rows = (), under: Rows = (),
    after: Rows = (), breaks: Mapping[int, Rows] | None = None, headed: bool = True,
) -> Layout:  # fmt: skip
    """Stack title block, header rows, unit rows, stations with rows between them, and footer."""
    names: Rows = [[column.header for column in columns]] if headed else []
    grid = [list(row) for part in (before, over, names, under) for row in part]
    rows = []
    for station, cells in enumerate(zip(*(column.cells for column in columns), strict=True)):
        grid += [list(row) for row in (breaks or {}).get(station, ())]
        rows.append(len(grid))
        grid.append([*cells])
    grid += [list(row) for row in after]
    keys = tuple(column.key for column in columns)
    return Layout(tuple(tuple(row) for row in grid), len(before), tuple(rows), keys)


def statistics(
    columns: Sequence[Column], labels: Sequence[str], digits: int | None, *signs: str
) -> list[list[Cell]]:
    """Footer rows of mean and standard deviation; the label stands in the first column."""
    footer: list[list[Cell]] = []
    for label, of in zip(labels, (_mean, _deviation), strict=False):
        row: list[Cell] = [label]
        for column in columns[1:]:
            if not column.key:
                row.append("" if digits is not None else None)
                continue
            value = np.array([of(_numbers(column.cells))])
            row.append(
                round(float(value[0]), 3) if digits is None else typed(value, digits, *signs)[0]
            )
        footer.append(row)
    return footer


def _mean(values: Array) -> float:
    return float(np.mean(values))


def _deviation(values: Array) -> float:
    return float(np.std(values, ddof=1))


def _numbers(cells: Iterable[Cell]) -> Array:
    """Numbers of cells that are numbers, formulas or texts with a decimal point or comma, not grouped."""
    plain = [cell.value if isinstance(cell, Formula) else cell for cell in cells]
    return np.array([float(str(cell).replace(",", ".")) for cell in plain])


# --- Files ------------------------------------------------------------------------------------


def rendered(form: Form, file: str) -> bytes:
    if form.text is not None:
        return _text_file(form.sheets[0].grid, form.text)
    return _ods(form.sheets) if file.endswith(".ods") else _xlsx(form.sheets)


def _text_file(grid: Grid, text: Text) -> bytes:
    rows = [["" if cell is None else str(cell) for cell in row] for row in grid]
    width = max(map(len, rows))
    if text.delimiter == "  ":
        broad = [row for row in rows if len(row) > 2]
        columns = [max(len(row[k]) for row in broad if k < len(row)) for k in range(width)]
        lines = [_filled(row, columns) for row in rows]
    else:
        if text.padded:
            rows = [row + [""] * (width - len(row)) for row in rows]
        lines = [text.delimiter.join(_quoted(cell, text) for cell in row) for row in rows]
    return (text.newline.join(lines) + text.newline).encode(text.encoding)


def _filled(row: list[str], widths: list[int]) -> str:
    if len(row) <= 2:
        return "  ".join(row)
    return "  ".join(cell.rjust(widths[k]) for k, cell in enumerate(row)).rstrip()


def _quoted(cell: str, text: Text) -> str:
    is_number = re.fullmatch(r"[-+]?[\d.,]+", cell) is not None
    wanted = {"all": True, "text": bool(cell) and not is_number, "needed": False}[text.quote]
    if wanted or '"' in cell or text.delimiter in cell:
        return '"' + cell.replace('"', '""') + '"'
    return cell


def _xlsx(sheets: Sequence[Sheet]) -> bytes:
    from openpyxl import Workbook

    book = Workbook()
    book.remove(book.active)
    stored: dict[str, dict[str, float]] = {}
    for number, sheet in enumerate(sheets, 1):
        page = book.create_sheet(sheet.name)
        values = stored.setdefault(f"xl/worksheets/sheet{number}.xml", {})
        for r, row in enumerate(sheet.grid, 1):
            for c, cell in enumerate(row, 1):
                if cell is None or cell == "":
                    continue
                place = page.cell(r, c)
                if isinstance(cell, Formula):
                    place.value = "=" + cell.text.replace("{r}", str(r))
                    values[place.coordinate] = cell.value
                else:
                    place.value = cell
        for top, left, bottom, right in sheet.merged:
            page.merge_cells(None, top + 1, left + 1, bottom + 1, right + 1)
        for hidden in sheet.hidden:
            page.row_dimensions[hidden + 1].hidden = True
    raw = io.BytesIO()
    book.save(raw)
    return _settled(raw.getvalue(), stored)


def _settled(content: bytes, stored: Mapping[str, Mapping[str, float]]) -> bytes:
    """The workbook with the values of its formulas, and the same bytes at any time."""

    def with_value(match: re.Match[str]) -> str:
        return f"{match[1]}<v>{values[match[2]]!r}</v></c>"

    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(out, "w") as new:
        for name in old.namelist():
            part = old.read(name)
            values = stored.get(name, {})
            if values:
                pattern = r'(<c r="([A-Z]+\d+)"[^>]*><f>[^<]*</f>)<v ?/?>(?:</v>)?</c>'
                part = re.sub(pattern, with_value, part.decode()).encode()
            if name == "docProps/core.xml":
                part = re.sub(rb"\d{4}-\d\d-\d\dT[\d:]+Z", b"2026-03-14T10:00:00Z", part)
            _put(new, name, part)
    return out.getvalue()


def _put(archive: zipfile.ZipFile, name: str, part: bytes, packed: bool = True) -> None:
    entry = zipfile.ZipInfo(name, (2026, 3, 14, 10, 0, 0))
    entry.compress_type = zipfile.ZIP_DEFLATED if packed else zipfile.ZIP_STORED
    archive.writestr(entry, part)


ODS_TYPE = "application/vnd.oasis.opendocument.spreadsheet"
ODS_NAMES = "urn:oasis:names:tc:opendocument:xmlns:"


def _ods(sheets: Sequence[Sheet]) -> bytes:
    """A small OpenDocument spreadsheet, with the repeated blanks that real programs write."""
    spaces = " ".join(f'xmlns:{k}="{ODS_NAMES}{k}:1.0"' for k in ("office", "table", "text"))
    tables = "".join(_ods_sheet(sheet) for sheet in sheets)
    content = (
        f'<?xml version="1.0" encoding="UTF-8"?><office:document-content {spaces} office:version="1.2">'
        f"<office:body><office:spreadsheet>{tables}</office:spreadsheet></office:body>"
        "</office:document-content>"
    )
    entry = '<manifest:file-entry manifest:full-path="{}" manifest:media-type="{}"/>'
    manifest = (
        f'<?xml version="1.0" encoding="UTF-8"?><manifest:manifest xmlns:manifest="{ODS_NAMES}manifest:1.0">'
        + entry.format("/", ODS_TYPE) + entry.format("content.xml", "text/xml") + "</manifest:manifest>"
    )  # fmt: skip
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        _put(archive, "mimetype", ODS_TYPE.encode(), packed=False)
        _put(archive, "content.xml", content.encode())
        _put(archive, "META-INF/manifest.xml", manifest.encode())
    return out.getvalue()


def _ods_sheet(sheet: Sheet) -> str:
    spans = {(top, left): (bottom, right) for top, left, bottom, right in sheet.merged}
    covered = {
        (r, c) for (top, left), (bottom, right) in spans.items()
        for r in range(top, bottom + 1) for c in range(left, right + 1)
    } - set(spans)  # fmt: skip
    lines = []
    for r, row in enumerate(sheet.grid):
        hidden = ' table:visibility="collapse"' if r in sheet.hidden else ""
        cells = [_ods_cell(cell, (r, c), spans, covered) for c, cell in enumerate(row)]
        rest = '<table:table-cell table:number-columns-repeated="1003"/>'
        lines.append(f"<table:table-row{hidden}>{''.join(cells)}{rest}</table:table-row>")
    blank = '<table:table-cell table:number-columns-repeated="1024"/>'
    lines.append(f'<table:table-row table:number-rows-repeated="1048000">{blank}</table:table-row>')
    return f'<table:table table:name="{escape(sheet.name)}">{"".join(lines)}</table:table>'


def _ods_cell(
    cell: Cell, at: tuple[int, int], spans: Mapping[tuple[int, int], tuple[int, int]],
    covered: set[tuple[int, int]],
) -> str:  # fmt: skip
    if at in covered:
        return "<table:covered-table-cell/>"
    said = ""
    if at in spans:
        down, across = spans[at][0] - at[0] + 1, spans[at][1] - at[1] + 1
        said = f' table:number-columns-spanned="{across}" table:number-rows-spanned="{down}"'
    if cell is None or cell == "":
        return f"<table:table-cell{said}/>"
    if isinstance(cell, Formula):
        formula = escape(cell.text.replace("{r}", str(at[0] + 1)), {'"': "&quot;"})
        said, cell = said + f' table:formula="of:={formula}"', cell.value
    if isinstance(cell, datetime):
        shown = cell.strftime("%d/%m/%Y %H:%M:%S")
        said += f' office:value-type="date" office:date-value="{cell.isoformat()}"'
    elif isinstance(cell, str):
        shown, said = cell, said + ' office:value-type="string"'
    else:
        shown = f"{cell:.2f}".replace(".", ",")
        said += f' office:value-type="float" office:value="{cell!r}"'
    return f"<table:table-cell{said}><text:p>{escape(shown)}</text:p></table:table-cell>"


def laboratory(
    file: str, layout: Layout, truth: dict[str, Any], *, text: Text | None = None, trap: str = "",
    question: str = "", sheets: tuple[Sheet, ...] = (), at: int = 0, sheet: str = "Sheet1",
    merged: tuple[tuple[int, int, int, int], ...] = (), hidden: tuple[int, ...] = (), movable: bool = True,
) -> Laboratory:  # fmt: skip
    """A table from its layout; `sheets` stand around the sheet of the data, which is put in at `at`."""
    data = Sheet(sheet, layout.grid, merged, hidden)
    every = (*sheets[:at], data, *sheets[at:])
    form = Form(every, layout.header, layout.rows, layout.keys, at, text, movable and not merged)
    expected: Literal["taken", "asks"] = "asks" if question else "taken"
    name = file.rsplit(".", 1)[0]
    return Laboratory(name, file, rendered(form, file), truth, trap, expected, question, form)


# --- English ----------------------------------------------------------------------------------


def houston_counts() -> Laboratory:
    """ADC counts without units, comment lines with #."""
    run = measure(rolls(SIX, 4), HOUSTON, 1)
    a, m = run.accelerometer(2_000_000, 0, "-x-y+z"), run.magnetometer(80.0, 0)
    columns = [
        numbers(run, "Sta"), *triad("a", "G{}_ADC", a, 0), *triad("m", "H{}_ADC", m, 0),
        *references(run, "T", ["T_sens (degC)"], 1), *references(run, "IAF", ["Inc", "Az", "TF"], 2),
        remarks(run, "Comment", {0: "start of run", 11: "re-seated v-blocks"}),
    ]  # fmt: skip
    before = [
        ["# Directional Module Tumble Test"], ["# Tool S/N: DM-4471"], ["# Date: 03/14/2026"],
        ["# Operator: R. Tate   Stand: NM-2   local field 46.8 uT nominal"],
    ]  # fmt: skip
    truth = facts(run, a, m, serial="DM-4471", date="2026-03-14")
    return laboratory("houston_tumble.csv", laid_out(columns, before=before), truth, text=Text(","))


def _title(serial: str, date: Cell, operator: str) -> list[list[Cell]]:
    return [
        ["Roll test data sheet"], [], ["Tool S/N:", None, serial], ["Date:", None, date],
        ["Operator:", None, operator], [],
    ]  # fmt: skip


def aberdeen_workbook() -> Laboratory:
    """Cover sheet, title block, merged header of two rows, unit row, mean, std and signatures."""
    run = measure(rolls(FOUR, 8), ABERDEEN, 2)
    a, m = run.accelerometer(3000, 1), run.magnetometer(0.001, 4)
    columns = [
        other("No", range(1, len(run) + 1)), *triad("a", "{}", a), *triad("m", "{}", m),
        *references(run, "IAFTBD", ["Inc", "Azi", "TF", "T", "Btotal", "Dip"]),
    ]  # fmt: skip
    groups: list[Cell] = [
        None, "Accelerometer", None, None, "Magnetometer", None, None, "Stand", None, None, "Tool",
        "Observatory", None,
    ]  # fmt: skip
    units = ["", *["mV"] * 3, *["µT"] * 3, *["deg"] * 3, "°C", "nT", "deg"]
    after: Rows = [
        [], *statistics(columns, ["Mean", "Std"], None), [],
        ["Signed:", None, "____________", None, "Checked:", None, "____________"],
    ]  # fmt: skip
    layout = laid_out(
        columns, before=_title("ABZ-2207-B", datetime(2026, 2, 19), "I. Farquhar"), over=[groups],
        under=[units], after=after,
    )  # fmt: skip
    h = layout.header
    merged = ((0, 0, 0, 6), (h, 1, h, 3), (h, 4, h, 6), (h, 7, h, 9), (h, 11, h, 12))
    cover = Sheet(
        "Cover",
        (
            ("DIRECTIONAL SENSOR CALIBRATION",),
            (),
            ("Job", "AB-26-0117"),
            ("Client", "North Sea Survey Ltd"),
        ),
    )
    truth = facts(run, a, m, "TIAFBD", serial="ABZ-2207-B", date="2026-02-19")
    return laboratory(
        "aberdeen_job_0117.xlsx",
        layout,
        truth,
        sheets=(cover,),
        at=1,
        sheet="Calibration",
        merged=merged,
    )


def calgary_quoted() -> Laboratory:
    """Everything in quotes, tabs, reference field, dip and gravity in m/s²."""
    run = measure(rolls(FIVE, 4, 45), CALGARY, 3, digits=3)
    a, m = run.accelerometer(1000, 2, "+x+y-z"), run.magnetometer(1, 1)
    gravity = np.round(run.gravity * STANDARD_GRAVITY, 4)
    columns = [
        times(run, "UTC", datetime(2026, 1, 22, 16, 4), "%Y-%m-%dT%H:%M:%SZ"),
        *triad("a", "Accel {} [mg]", a, 2), *triad("m", "Mag {} [nT]", m, 1),
        *references(run, "T", ["Probe Temp [C]"], 1),
        *references(run, "IAF", ["Inclination [deg]", "Mag Azimuth [deg]", "GTF [deg]"], 3),
        *references(run, "BD", ["Btotal ref [nT]", "Dip ref [deg]"], 2),
        Column("ref_gravity_g", "Local g [m/s2]", typed(gravity, 4)), other("", [""] * len(run)),
    ]  # fmt: skip
    truth = facts(run, a, m, "TIAFBD", ref_gravity_g=gravity / STANDARD_GRAVITY, date="2026-01-22")
    text = Text("\t", quote="all", newline="\n")
    return laboratory("calgary_export.tsv", laid_out(columns), truth, text=text)


def conroe_labview() -> Laboratory:
    """Header lines of LabVIEW, X_Value and a Comment column."""
    run = measure(rolls(FOUR, 6), HOUSTON, 4, digits=3)
    a, m = run.accelerometer(3, 6), run.magnetometer(1e-4, 6)
    seconds = [f"{95 * k + 0.25:.6f}" for k in range(len(run))]
    columns = [
        other("X_Value", seconds), *triad("a", "Acc_{} (V)", a, 6), *triad("m", "Fluxgate_{} (V)", m, 6),
        *references(run, "T", ["RTD (deg C)"], 6),
        *references(run, "IAF", ["Inclination", "Azimuth", "HS Toolface"], 6),
        remarks(run, "Comment", {6: "next inclination"}),
    ]  # fmt: skip
    said = [
        "LabVIEW Measurement", "Writer_Version\t2", "Reader_Version\t2", "Separator\tTab",
        "Decimal_Separator\t.", "Multi_Headings\tNo", "X_Columns\tOne", "Time_Pref\tRelative",
        "Operator\tcalbench", "Description\tSN 10983 tumble", "Date\t2026/03/02",
        "Time\t08:41:07.1234560", "***End_of_Header***", "", f"Channels\t{len(columns) - 2}",
        "Samples\t1", "***End_of_Header***",
    ]  # fmt: skip
    layout = laid_out(columns, before=[line.split("\t") for line in said])
    truth = facts(run, a, m, serial="10983", date="2026-03-02")
    return laboratory("conroe_10983.lvm", layout, truth, text=Text("\t"))


def midland_typed() -> Laboratory:
    """Typed by hand: runs of blanks, a rule of dashes, nominal angles, units on the line below."""
    run = measure(rolls(FOUR, 4), HOUSTON, 5, setting=0.0, digits=1)
    a, m = run.accelerometer(STANDARD_GRAVITY, 3), run.magnetometer(1, 0)
    columns = [
        *references(run, "IAF", ["INC", "AZI", "TFACE"], 1), *triad("a", "G{}", a, 3),
        *triad("m", "B{}", m, 0), *references(run, "T", ["TEMP"], 1),
    ]  # fmt: skip
    units = [*["deg"] * 3, *["m/s2"] * 3, *["nT"] * 3, "C"]
    rule = [["-" * 6] * len(columns)]
    before = [
        ["Probe 88-115 after rebuild, JT"], ["3/9/26, shop stand, field from Fredericksburg 46,812"], [],
    ]  # fmt: skip
    layout = laid_out(columns, before=before, under=[units, *rule], after=[*rule, ["end"]])
    truth = facts(run, a, m, serial="88-115", date="2026-03-09")
    return laboratory("midland_88-115.txt", layout, truth, text=Text("  ", newline="\n"))


def perth_logger() -> Laboratory:
    """A logger's four header rows: station, names, units, processing; the oven's temperature beside the tool's."""
    run = measure(rolls(FIVE, 4), PERTH, 6, temperatures=(25.0, 85.0, 125.0))
    a, m = run.accelerometer(1000, 2), run.magnetometer(0.02, 3)
    oven = typed(np.repeat([25.0, 90.0, 132.0], 20), 1)
    columns = [
        times(run, "TIMESTAMP", datetime(2026, 3, 3, 7, 30), "%Y-%m-%d %H:%M:%S"), numbers(run, "RECORD"),
        other("Batt_V", ["12.61"] * len(run)), *triad("a", "Acc{}_Avg", a, 2),
        *triad("m", "Flux{}_Avg", m, 3), *references(run, "T", ["TSens_Avg"], 1),
        other("Oven_temp", oven), *references(run, "IAF", ["Table_Inc", "Table_Az", "Table_Roll"], 2),
    ]  # fmt: skip
    count = len(columns)
    units = ["TS", "RN", "Volts", *["mV"] * 6, "Deg C", "Deg C", *["deg"] * 3]
    process = ["", "", "Min", *["Avg"] * 7, "Smp", *["Smp"] * 3]
    station = [
        "TOA5",
        "CalBay",
        "CR6",
        "10422",
        "CR6.Std.12.02",
        "CPU:tumble.CR6",
        "41237",
        "Stations",
    ]
    station += [""] * (count - len(station))
    layout = laid_out(columns, before=[station], under=[units, process])
    truth = facts(run, a, m, date="2026-03-03")
    return laboratory("perth_CR6_Stations.dat", layout, truth, text=Text(",", quote="text"))


def aberdeen_pipes() -> Laboratory:
    """Pipes, thousands commas beside decimal points, blank rows between roll sets, row numbers."""
    run = measure(rolls(SIX, 8), ABERDEEN, 7)
    a, m = run.accelerometer(500_000, 1), run.magnetometer(1, 1, "-x-y-z")
    columns = [
        numbers(run, "#", "{:03d}"), *references(run, "IAF", ["Inc (°)", "MagAz (°)", "TF (°)"], 2),
        *triad("a", "A{} (counts)", a, 1, ".", ","), *triad("m", "B{} (nT)", m, 1, ".", ","),
        *references(run, "T", ["Temp (°C)"], 1),
        Column("ref_field_nt", "Bt obs (nT)", typed(run.field, 0, ".", ",")),
    ]  # fmt: skip
    breaks: dict[int, Rows] = {k: [[]] for k in range(8, len(run), 8)}
    layout = laid_out(columns, before=[["Serial No", "ABZ-3301"], []], breaks=breaks)
    truth = facts(run, a, m, "TIAFB", serial="ABZ-3301")
    text = Text("|", encoding="utf-8-sig")
    return laboratory("aberdeen_rollsets.txt", layout, truth, text=text)


def pune_computed_totals() -> Laboratory:
    """Totals and dip that are computed from the readings: no references, though their names look like it."""
    run = measure(rolls(CUBE, 4), Place(0.9981, 42510.0, 26.1), 8)
    a, m = run.accelerometer(1, 5), run.magnetometer(1e-5, 6)
    gt, bt = np.linalg.norm(a, axis=1), np.linalg.norm(m, axis=1) * 1e5
    dip = np.degrees(np.arcsin(np.sum(a * m, axis=1) / gt / bt * 1e5))
    columns = [
        times(run, "Time", datetime(2026, 2, 5, 11, 2), "%d-%b-%y %H:%M:%S"),
        *triad("a", "G{} (g)", a, 5), *triad("m", "B{} (Gauss)", m, 6),
        other("Gtotal calc (g)", typed(gt, 4)), other("Btotal calc (nT)", typed(bt, 0)),
        other("Dip calc (deg)", typed(dip, 2)), *references(run, "T", ["Sensor Temp (C)"], 1),
        *references(run, "IAF", ["Set Inc", "Set Azm", "Set TF"], 2),
    ]  # fmt: skip
    before = [["Survey probe calibration"], ["Probe No.", "IN-0552"], ["Date", "05-Feb-2026"], []]
    truth = facts(run, a, m, serial="IN-0552", date="2026-02-05")
    return laboratory(
        "pune_probe_0552.csv", laid_out(columns, before=before), truth, text=Text(",", padded=True),
        trap="totals and dip are computed from the uncalibrated readings, not references",
    )  # fmt: skip


def perth_elevation() -> Laboratory:
    """The stand counts from the horizontal, up positive."""
    run = measure(rolls(FIVE, 6), PERTH, 9)
    a, m = run.accelerometer(1000, 2), run.magnetometer(0.001, 4)
    elevation = np.round(run.inclination - 90, 2)
    columns = [
        numbers(run, "Shot"), Column("ref_inclination_deg", "Elev (deg)", typed(elevation, 2)),
        *references(run, "AF", ["Bearing (deg mag)", "Roll (deg)"], 2), *triad("a", "Acc {} (mg)", a, 2),
        *triad("m", "Mag {} (uT)", m, 4), *references(run, "T", ["Temp (C)"], 1),
        *references(run, "B", ["TMI (nT)"], 0),
    ]  # fmt: skip
    before = [
        [
            "Elev = elevation of tool axis (downhole end) above horizontal; -90 = pointing straight down"
        ]
    ]
    truth = facts(run, a, m, "TIAFB")
    return laboratory(
        "perth_elevation.csv", laid_out(columns, before=before), truth, text=Text(","),
        trap="elevation from the horizontal: inclination = elevation + 90",
    )  # fmt: skip


def houston_fahrenheit() -> Laboratory:
    run = measure(rolls(FIVE, 4), HOUSTON, 10, temperatures=(24.0, 105.0))
    a, m = run.accelerometer(2.5, 5, "+y-x+z"), run.magnetometer(1, 1, "+y-x+z")
    fahrenheit = np.round(run.temperature * 1.8 + 32, 1)
    columns = [
        times(run, "Date/Time", datetime(2026, 3, 11, 13, 5), "%m/%d/%Y %I:%M:%S %p"),
        *triad("a", "G{}(V)", a, 5), *triad("m", "M{}(nT)", m, 1),
        Column("temperature_c", "Tool Temp(F)", typed(fahrenheit, 1)),
        *references(run, "IAFBD", ["INC(deg)", "AZ(deg)", "HSTF(deg)", "Bref(nT)", "Dip(deg)"], 2),
    ]  # fmt: skip
    truth = facts(run, a, m, "IAFBD", temperature_c=(fahrenheit - 32) / 1.8, date="2026-03-11")
    return laboratory(
        "houston_two_soaks.csv", laid_out(columns), truth, text=Text(","), trap="temperature in °F"
    )


def _sexagesimal(degrees: Array) -> tuple[list[str], Array]:
    """Degrees, minutes and seconds as a theodolite's book has them, and the degrees they stand for."""
    seconds = np.rint(degrees * 3600).astype(int)
    texts = [f"{s // 3600}°{s // 60 % 60:02d}'{s % 60:02d}\"" for s in seconds]
    return texts, seconds / 3600


def denver_theodolite() -> Laboratory:
    run = measure(rolls(SIX, 4), CALGARY, 11, digits=4)
    a, m = run.accelerometer(1000, 2), run.magnetometer(1, 1)
    angles = [_sexagesimal(v) for v in (run.inclination, run.azimuth, run.toolface)]
    names = [LETTERS[k][0] for k in "IAF"]
    headers = ["Tool incl.", "Mag. bearing", "Tool roll"]
    columns = [
        other("Station", range(1, len(run) + 1)),
        *[Column(names[k], headers[k], angles[k][0]) for k in range(3)],
        *triad("a", "Accel {}, mg", a), *triad("m", "Mag {}, nT", m), *references(run, "T", ["Temp, °C"]),
    ]  # fmt: skip
    before: Rows = [
        ["Stand read by T2 theodolite"],
        ["S/N", "CO-771"],
        ["Date", datetime(2026, 1, 30)],
        [],
    ]
    truth = facts(run, a, m, "T", serial="CO-771", date="2026-01-30")
    truth |= {names[k]: angles[k][1] for k in range(3)}
    return laboratory(
        "denver_theodolite.xlsx", laid_out(columns, before=before), truth,
        trap="angles in degrees, minutes and seconds",
    )  # fmt: skip


def tulsa_two_tools() -> Laboratory:
    """Two tools taken in turn at every attitude, named in a column."""
    plan = rolls(FOUR, 4)
    runs = [measure(plan, HOUSTON, seed, setting=0.0) for seed in (12, 112)]
    serials = ["TU-301", "TU-305"]
    each = []
    for run in runs:
        a, m = run.accelerometer(1000, 2), run.magnetometer(1, 1)
        columns = [
            *references(run, "IAF", ["Inc", "Azm", "TF"], 2), *triad("a", "G{} (mg)", a, 2),
            *triad("m", "H{} (nT)", m, 1), *references(run, "T", ["Temp (C)"], 1),
        ]  # fmt: skip
        each.append((columns, facts(run, a, m)))
    merged = [
        Column(first.key, first.header, [c for pair in zip(first.cells, second.cells, strict=True) for c in pair])
        for first, second in zip(each[0][0], each[1][0], strict=True)
    ]  # fmt: skip
    columns = [other("Tool SN", serials * len(plan)), *merged]
    tools = {serial: known for serial, (_, known) in zip(serials, each, strict=True)}
    truth = {
        key: np.array([runs_of[key] for runs_of in tools.values()]).T.ravel()
        for key in tools["TU-301"]
    }
    return laboratory(
        "tulsa_pair.csv", laid_out(columns), truth | {"tools": tools}, text=Text(","),
        trap="two tools in one sheet, by a column of serials",
        question="which of the tools TU-301 and TU-305, or a calibration of each",
    )  # fmt: skip


def lafayette_side_by_side() -> Laboratory:
    """Two tools on one stand: their blocks of columns stand side by side under merged titles."""
    plan = rolls(FIVE, 4)
    left, right = (measure(plan, HOUSTON, seed, setting=0.0) for seed in (13, 113))
    blocks, tools = [], {}
    for serial, run in (("LA-18", left), ("LA-19", right)):
        a, m = run.accelerometer(3000, 1), run.magnetometer(1, 0)
        blocks.append([
            *triad("a", "A{} mV", a), *triad("m", "M{} nT", m), *references(run, "T", ["Temp C"]),
        ])  # fmt: skip
        tools[serial] = facts(run, a, m, serial=serial)
    second = [column._replace(key="") for column in blocks[1]]
    gap = other("", [None] * len(left))
    columns = [*references(left, "IAF", ["Inc", "Azi", "TF"]), *blocks[0], gap, *second]
    groups = ["Stand", None, None, "Tool LA-18", *[None] * 7, "Tool LA-19"]
    layout = laid_out(columns, over=[groups])
    return laboratory(
        "lafayette_pair.xlsx", layout, tools["LA-18"] | {"tools": tools},
        merged=((0, 0, 0, 2), (0, 3, 0, 9), (0, 11, 0, 17)),
        trap="two tools in one sheet, blocks side by side (truth: the first)",
        question="which of the tools LA-18 and LA-19, or a calibration of each",
    )  # fmt: skip


def _quadrant(degrees: float) -> tuple[str, float]:
    quarter = int(degrees // 90) % 4
    rest = (degrees % 90, 90 - degrees % 90, degrees % 90, 90 - degrees % 90)[quarter]
    rest = round(rest, 1)
    start, sense = ((0, 1), (180, -1), (180, 1), (360, -1))[quarter]
    return f"{'NSSN'[quarter]}{rest:.1f}{'EEWW'[quarter]}", (start + sense * rest) % 360


def oklahoma_bearings() -> Laboratory:
    """Old survey style: bearings of quadrants."""
    run = measure(rolls(SIX, 4, 10), HOUSTON, 14, digits=1)
    a, m = run.accelerometer(1, 5), run.magnetometer(1e-5, 6)
    bearings = [_quadrant(float(v)) for v in run.azimuth]
    columns = [
        *references(run, "I", ["Drift angle"], 1),
        Column("ref_azimuth_deg", "Mag. Bearing", [text for text, _ in bearings]),
        *references(run, "F", ["High side TF"], 1), *triad("a", "Accel {} (g)", a, 5),
        *triad("m", "Mag {} (gauss)", m, 6), *references(run, "T", ["Deg C"], 1),
        remarks(run, "Remarks", {3: "OK", 9: "wind, door shut"}),
    ]  # fmt: skip
    truth = facts(run, a, m, "TIF", ref_azimuth_deg=np.array([value for _, value in bearings]))
    return laboratory(
        "oklahoma_bearings.csv", laid_out(columns), truth, text=Text(","),
        trap="azimuths as quadrant bearings; inclination called drift angle",
    )  # fmt: skip


def anchorage_true_north() -> Laboratory:
    """The ring is set to true north; the declination stands in the title block."""
    run = measure(rolls(FIVE, 8), ANCHORAGE, 15)
    a, m = run.accelerometer(1000, 2), run.magnetometer(1, 1)
    true = np.round((run.azimuth + 14.62) % 360, 2)
    columns = [
        other("Pt", range(1, len(run) + 1)), *references(run, "I", ["Inc (deg)"]),
        Column("ref_azimuth_deg", "True Az (deg)", true.tolist()), *references(run, "F", ["TF (deg)"]),
        *triad("a", "A{} (mg)", a), *triad("m", "M{} (nT)", m),
        *references(run, "TBD", ["Temp (C)", "F obs (nT)", "Dip obs (deg)"]),
    ]  # fmt: skip
    before = [
        ["Azimuth ring aligned to TRUE north (sun shot)"], ["Magnetic declination", "14.62 deg East"],
        ["Tool", "AK-0093"], [],
    ]  # fmt: skip
    truth = facts(
        run, a, m, "TIAFBD", serial="AK-0093", declination_deg=14.62, ref_azimuth_true_deg=true
    )
    return laboratory(
        "anchorage_true_north.xlsx", laid_out(columns, before=before), truth,
        trap="true azimuths; magnetic by the stated declination 14.62° E",
    )  # fmt: skip


def broussard_left_handed() -> Laboratory:
    run = measure(rolls(FOUR, 8), HOUSTON, 16)
    a, m = run.accelerometer(1000, 2), run.magnetometer(1, 1)
    counted = np.round((360 - run.toolface) % 360, 2)
    columns = [
        numbers(run, "Shot"), *triad("a", "G{} mg", a, 2), *triad("m", "H{} nT", m, 1),
        *references(run, "IA", ["Inc deg", "Azi deg"], 2),
        Column("ref_toolface_deg", "Roll deg CCW", typed(counted, 2)),
        *references(run, "T", ["Temp degC"], 1),
    ]  # fmt: skip
    before = [["Roll ring counts counter-clockwise looking downhole, 0 = scribe at high side"], []]
    return laboratory(
        "broussard_ccw.csv", laid_out(columns, before=before), facts(run, a, m), text=Text(","),
        trap="left-handed toolface, stated: toolface = 360 - roll",
    )  # fmt: skip


def dubai_gauss() -> Laboratory:
    run = measure(rolls(CUBE, 8), DUBAI, 17)
    a, m = run.accelerometer(1, 5), run.magnetometer(1e-5, 6)
    columns = [
        *references(run, "IAF", ["Incl", "Azim", "TF"], 2), *triad("a", "A{}", a, 5),
        *triad("m", "B{}", m, 6), *references(run, "TBDG", ["Temp", "Btot ref", "Dip ref", "G ref"], 2),
    ]  # fmt: skip
    units = [*["deg"] * 3, *["g"] * 3, *["G"] * 3, "degC", "nT", "deg", "g"]
    before = [["Tool: DXB-51 / Date: 17-Mar-2026 / magnetometer in Gauss, reference in nT"]]
    layout = laid_out(columns, before=before, under=[units])
    truth = facts(run, a, m, "TIAFBDG", serial="DXB-51", date="2026-03-17")
    return laboratory(
        "dubai_gauss.csv", layout, truth, text=Text(","),
        trap="magnetometer in gauss (unit G) beside a reference in nT and accelerometers in g",
    )  # fmt: skip


def headerless() -> Laboratory:
    """Numbers only."""
    run = measure(rolls(FOUR, 6), ABERDEEN, 18)
    a, m = run.accelerometer(3000, 1), run.magnetometer(0.1, 1)
    columns = [
        *references(run, "IAF", ["", "", ""], 2), *triad("a", "", a, 1), *triad("m", "", m, 1),
        *references(run, "T", [""], 1),
    ]  # fmt: skip
    layout = laid_out(columns, headed=False)
    return laboratory(
        "stand3_0042.csv", layout, facts(run, a, m), text=Text(",", newline="\n"), movable=False,
        trap="no header: columns are inc, azi, toolface, three mV, three of 10 nT, temperature",
        question="what the columns are, and their units",
    )  # fmt: skip


# --- German -----------------------------------------------------------------------------------

GERMAN = ("Neigung", "Azimut", "Verdrehung")


def celle_semicolons() -> Laboratory:
    """Semicolons, decimal commas, cp1252, empty cells at the ends of the title lines."""
    run = measure(rolls(SIX, 4), CELLE, 21)
    a, m = run.accelerometer(3000, 1, "-x-y+z"), run.magnetometer(0.001, 4)
    columns = [
        numbers(run, "Lfd. Nr."), *references(run, "IAF", [f"{name} (°)" for name in GERMAN], 2, ","),
        *triad("a", "Beschleunigung {} (mV)", a, 1, ","), *triad("m", "Magnetfeld {} (µT)", m, 4, ","),
        *references(run, "T", ["Temperatur (°C)"], 1, ","), remarks(run, "Bemerkung", {4: "Tür zu"}),
    ]  # fmt: skip
    before = [["Kalibrierung Richtsensor"], ["Geräte-Nr.:", "C-1187"], ["Datum:", "14.03.2026"],
              ["Prüfer:", "Krüger"], []]  # fmt: skip
    truth = facts(run, a, m, serial="C-1187", date="2026-03-14")
    text = Text(";", encoding="cp1252", padded=True)
    return laboratory("celle_c1187.csv", laid_out(columns, before=before), truth, text=text)


def hannover_formulas() -> Laboratory:
    """Angles by formula from the encoders' steps, a hidden row, footer of formulas."""
    run = measure(rolls(FOUR, 6), CELLE, 22, digits=2)
    a, m = run.accelerometer(250, 2), run.magnetometer(0.02, 2)
    steps = [np.rint(v * 100) for v in (run.inclination, run.azimuth, run.toolface)]
    cells = [[Formula(f"{letter}{{r}}/100", v) for v in (s / 100).tolist()] for s, letter in
             zip(steps, "BCD", strict=True)]  # fmt: skip
    columns = [
        other("Nr.", range(1, len(run) + 1)),
        *[other(f"Geber {k + 1}", steps[k].astype(int).tolist()) for k in range(3)],
        *[Column(LETTERS["IAF"[k]][0], f"{GERMAN[k]} [°]", cells[k]) for k in range(3)],
        *triad("a", "Beschl. {} [mV]", a), *triad("m", "Fluxgate {} [mV]", m),
        *references(run, "T", ["Sensortemp. [°C]"]),
    ]  # fmt: skip
    before: Rows = [
        ["Prüfprotokoll Rollversuch"],
        ["Seriennummer", "H-20-44"],
        ["Datum", datetime(2026, 2, 27)],
        [],
    ]
    said: list[list[Cell]] = [["Geber nach Werksabgleich, Schritte zu 0,01°"]]
    after: list[list[Cell]] = [[]]
    for label, name in (("Mittelwert", "AVERAGE"), ("Standardabw.", "STDEV")):
        row: list[Cell] = [label, *[None] * 6]
        for k, column in enumerate(columns[7:], 7):
            values = _numbers(column.cells)
            value = values.mean() if name == "AVERAGE" else values.std(ddof=1)
            row.append(Formula(f"{name}({chr(65 + k)}7:{chr(65 + k)}30)", round(float(value), 4)))
        after.append(row)
    layout = laid_out(columns, before=[*before, *said], after=after)
    truth = facts(run, a, m, serial="H-20-44", date="2026-02-27")
    return laboratory(
        "hannover_rollversuch.xlsx", layout, truth, hidden=(layout.rows[5],),
        sheet="Messung", trap="one station's row is hidden (it is a station like the others)",
    )  # fmt: skip


def clausthal_ods() -> Laboratory:
    """LibreOffice, real dates, spanned header, a second sheet of remarks."""
    run = measure(rolls(FIVE, 8), CELLE, 23)
    a, m = run.accelerometer(1, 5), run.magnetometer(1, 1)
    columns = [
        times(run, "Zeit", datetime(2026, 3, 5, 9, 12), None),
        *triad("a", "{}", a), *triad("m", "{}", m), *references(run, "IAF", GERMAN),
        *references(run, "TB", ["Temperatur", "Totalfeld"]),
    ]  # fmt: skip
    groups: list[Cell] = [None, "Beschleunigungsaufnehmer", None, None, "Magnetometer", None, None,
                          "Prüfstand", None, None, None, None]  # fmt: skip
    units = ["", *["g"] * 3, *["nT"] * 3, *["°"] * 3, "°C", "nT"]
    layout = laid_out(
        columns, before=[["Werkzeug", "CLZ 7"], []], over=[groups], under=[units],
        after=[*statistics([columns[0], *columns[1:7]], ["Mittel"], None)],
    )  # fmt: skip
    h = layout.header
    notes = Sheet("Hinweise", (("Prüfstand 2, Messraum Süd",), ("Totalfeld vom Observatorium",)))
    return laboratory(
        "clausthal_clz7.ods", layout, facts(run, a, m, "TIAFB", serial="CLZ 7"), sheet="Daten",
        sheets=(notes,), at=0, merged=((h, 1, h, 3), (h, 4, h, 6), (h, 7, h, 9)),
    )  # fmt: skip


def freiberg_gon() -> Laboratory:
    """Angles of a mine surveyor's instrument in gon."""
    run = measure(rolls(FIVE, 5), CELLE, 24, digits=3)
    a, m = run.accelerometer(1000, 2), run.magnetometer(0.001, 4)
    names = [LETTERS[k][0] for k in "IAF"]
    gon = [np.round(v / 0.9, 3) for v in (run.inclination, run.azimuth, run.toolface)]
    columns = [
        numbers(run, "Punkt"),
        *[Column(names[k], f"{GERMAN[k]} [gon]", typed(gon[k], 3, ",")) for k in range(3)],
        *triad("a", "a{} [mg]", a, 2, ","), *triad("m", "H{} [µT]", m, 4, ","),
        *references(run, "T", ["T [°C]"], 1, ","),
    ]  # fmt: skip
    truth = facts(run, a, m, "T", date="2026-02-11") | {names[k]: gon[k] * 0.9 for k in range(3)}
    return laboratory(
        "freiberg_gon.txt", laid_out(columns, before=[["Datum: 11.02.2026"]]), truth,
        text=Text("\t", encoding="cp1252"), trap="angles in gon",
    )  # fmt: skip


def muenchen_unicode() -> Laboratory:
    """Excel's "Unicode text": UTF-16, tabs, thousands points and decimal commas."""
    run = measure(rolls(FIVE, 4), CELLE, 25)
    a, m = run.accelerometer(2500, 1, "+x+y+z", 5000), run.magnetometer(1, 1)
    columns = [
        times(run, "Uhrzeit", datetime(2026, 3, 6, 14, 0), "%H:%M:%S"),
        *references(run, "IAF", GERMAN, 2, ","), *triad("a", "ACC_{}", a, 1, ",", "."),
        *triad("m", "MAG_{}", m, 1, ",", "."), *references(run, "T", ["Temp."], 1, ","),
    ]  # fmt: skip
    units = ["hh:mm:ss", *["Grad"] * 3, *["mV"] * 3, *["nT"] * 3, "°C"]
    before = [["Sensor M-0915, 06.03.2026, Nullpunkt der Beschleunigung bei 5 V"], []]
    layout = laid_out(columns, before=before, under=[units])
    truth = facts(run, a, m, serial="M-0915", date="2026-03-06")
    return laboratory("muenchen_m0915.txt", layout, truth, text=Text("\t", encoding="utf-16"))


# --- Norwegian --------------------------------------------------------------------------------

NORWEGIAN = ("Inklinasjon", "Asimut", "Verktøyflate")


def stavanger_semicolons() -> Laboratory:
    """UTF-8 with a byte order mark, semicolons, decimal commas, ISO times, comments with commas."""
    run = measure(rolls(FOUR, 12), STAVANGER, 26)
    a, m = run.accelerometer(3, 5, "+x+y+z"), run.magnetometer(1, 1)
    columns = [
        times(run, "Tidspunkt", datetime(2026, 2, 23, 8, 15), "%d.%m.%Y %H:%M:%S"),
        *triad("a", "Akselerometer {} (V)", a, 5, ","), *triad("m", "Magnetometer {} (nT)", m, 1, ","),
        *references(run, "T", ["Følertemperatur (°C)"], 1, ","),
        *references(run, "IAF", [f"{name} (°)" for name in NORWEGIAN], 2, ","),
        *references(run, "BD", ["Totalfelt ref. (nT)", "Dip ref. (°)"], 2, ","),
        remarks(run, "Kommentar", {0: "oppstart, 25 °C", 30: "pause, lunsj"}),
    ]  # fmt: skip
    truth = facts(run, a, m, "TIAFBD", date="2026-02-23")
    text = Text(";", encoding="utf-8-sig")
    return laboratory("stavanger_rulletest.csv", laid_out(columns), truth, text=text)


def bergen_soak_sheets() -> Laboratory:
    """A sheet for each temperature."""
    plan = rolls(FIVE, 4)
    run = measure(plan, STAVANGER, 27, temperatures=(25.0, 80.0, 120.0))
    a, m = run.accelerometer(1000, 2), run.magnetometer(1, 1)
    columns = [
        other("Nr", [k % 20 + 1 for k in range(len(run))]),
        *references(run, "IAF", [f"{n} [grader]" for n in NORWEGIAN]), *triad("a", "Aks {} [mg]", a),
        *triad("m", "Mag {} [nT]", m), *references(run, "T", ["Temp [°C]"]),
    ]  # fmt: skip
    layouts = [
        laid_out([c._replace(cells=c.cells[at : at + 20]) for c in columns]) for at in (0, 20, 40)
    ]
    more = tuple(
        Sheet(name, part.grid) for name, part in zip(("80C", "120C"), layouts[1:], strict=True)
    )
    return laboratory(
        "bergen_tre_temperaturer.xlsx", layouts[0], facts(run, a, m), sheets=more, at=0, sheet="25C",
        trap="one sheet per temperature (truth: the three one after the other)",
    )  # fmt: skip


def trondheim_swapped() -> Laboratory:
    """The electronics' channel X lies along the tool; y and z across it."""
    run = measure(rolls(SIX, 4), STAVANGER, 28)
    a, m = run.accelerometer(1000, 2, "+z+x+y"), run.magnetometer(0.001, 4, "+z-y+x")
    columns = [
        numbers(run, "Mål"), *references(run, "IAF", [f"{n} (°)" for n in NORWEGIAN], 2, ","),
        *triad("a", "A{} (mg)", a, 2, ","), *triad("m", "B{} (µT)", m, 4, ","),
        *references(run, "T", ["Temp (°C)"], 1, ","),
    ]  # fmt: skip
    before = [
        ["Verktøy S/N: T-6608"],
        ["Kanal X er langs verktøyets lengdeakse"],
        ["Dato: 2026-03-10"],
        [],
    ]
    truth = facts(run, a, m, serial="T-6608", date="2026-03-10")
    return laboratory(
        "trondheim_t6608.txt", laid_out(columns, before=before), truth, text=Text("\t"),
        trap="channel X along tool z: accelerometer channels +z +x +y, magnetometer +z -y +x",
    )  # fmt: skip


def haugesund_commas() -> Laboratory:
    """Decimal comma and delimiter comma, numbers in quotes where they have a comma."""
    run = measure(rolls(FIVE, 4), STAVANGER, 29)
    a, m = run.accelerometer(1, 5), run.magnetometer(1, 0)
    columns = [
        numbers(run, "Nr"), *references(run, "IAF", NORWEGIAN, 2, ","), *triad("a", "G{} [g]", a, 5, ","),
        *triad("m", "B{} [nT]", m, 0), *references(run, "T", ["Temperatur [°C]"], 1, ","),
    ]  # fmt: skip
    return laboratory(
        "haugesund_komma.csv", laid_out(columns), facts(run, a, m), text=Text(","),
        trap="decimal comma and delimiter comma; quotes tell them apart",
    )  # fmt: skip


def forus_rejected() -> Laboratory:
    """One reading failed, one station was rejected and taken again."""
    run = measure(rolls(FOUR, 8), STAVANGER, 30)
    a, m = run.accelerometer(3000, 1), run.magnetometer(1, 1)
    a[9, 1], m[20] = np.nan, m[20] + [410.0, -220.0, 150.0]
    columns = [
        other("Stasjon", [str(k + 1) for k in range(21)] + ["21R"] + [str(k) for k in range(22, 32)]),
        *references(run, "IAF", [f"{n} (°)" for n in NORWEGIAN], 2),
        *triad("a", "Aks {} (mV)", a, 1), *triad("m", "Mag {} (nT)", m, 1),
        *references(run, "T", ["T (°C)"], 1),
        remarks(run, "Merknad", {20: "FORKASTET - truck utenfor, målt på nytt", 21: "ny måling av 21"}),
    ]  # fmt: skip
    columns = [c._replace(cells=["OVL" if v == "nan" else v for v in c.cells]) for c in columns]
    kept = [k for k in range(len(run)) if k not in (9, 20)]
    truth = {key: np.asarray(each)[kept] for key, each in facts(run, a, m).items()}
    return laboratory(
        "forus_forkastet.csv", laid_out(columns, before=[["Verktøy", "FO-12"], []]),
        truth | {"serial": "FO-12"}, text=Text(",", newline="\n"),
        trap="station 10 has OVL for ay, station 21 is marked as rejected: both are left out",
    )  # fmt: skip


# --- Spanish and Portuguese -------------------------------------------------------------------

SPANISH = ("Inclinación", "Azimut", "Cara de herramienta")


def neuquen_semicolons() -> Laboratory:
    """Southern dip, cp1252, day first, an empty column between the groups."""
    run = measure(rolls(SIX, 4), NEUQUEN, 31)
    a, m = run.accelerometer(3000, 1, "-x-y-z"), run.magnetometer(0.001, 4)
    columns = [
        times(run, "Fecha y hora", datetime(2026, 3, 4, 10, 5), "%d/%m/%Y %H:%M"),
        *references(run, "IAF", [f"{n} (grados)" for n in SPANISH], 2, ","), other("", [""] * len(run)),
        *triad("a", "Acelerómetro {} (mV)", a, 1, ","), other("", [""] * len(run)),
        *triad("m", "Magnetómetro {} (µT)", m, 4, ","), *references(run, "T", ["Temp. sensor (°C)"], 1, ","),
        *references(run, "BD", ["Campo total ref. (nT)", "Inclinación magnética (°)"], 2, ","),
    ]  # fmt: skip
    before = [["N° de serie: NQN-205"], ["Técnico: Muñoz"], []]
    truth = facts(run, a, m, "TIAFBD", serial="NQN-205", date="2026-03-04")
    return laboratory(
        "neuquen_205.csv", laid_out(columns, before=before), truth, text=Text(";", encoding="cp1252"),
        trap="two columns called inclination: that of the tool and the magnetic one (dip)",
    )  # fmt: skip


def macae_text_numbers() -> Laboratory:
    """A workbook whose numbers are texts with decimal commas, pasted from a report."""
    run = measure(rolls(FIVE, 4), MACAE, 32)
    a, m = run.accelerometer(1000, 2), run.magnetometer(1, 1)
    columns = [
        other("Posição", range(1, len(run) + 1)),
        *references(run, "IAF", ["Inclinação (°)", "Azimute (°)", "Face da ferramenta (°)"], 2, ","),
        *triad("a", "Acelerômetro {} (mg)", a, 2, ","), *triad("m", "Magnetômetro {} (nT)", m, 1, ","),
        *references(run, "T", ["Temperatura (°C)"], 1, ","), remarks(run, "Observações", {7: "repetido"}),
    ]  # fmt: skip
    before: Rows = [
        ["Ensaio de rolagem"],
        ["Número de série:", None, "MC-0418"],
        ["Data:", None, "09/02/2026"],
        [],
    ]
    after: Rows = [
        [],
        ["Executado por:", None, "A. Conceição"],
        ["Aprovado por:", None, "________"],
    ]
    truth = facts(run, a, m, serial="MC-0418", date="2026-02-09")
    return laboratory(
        "macae_ensaio.xlsx", laid_out(columns, before=before, after=after), truth, sheet="Plan1"
    )


def comodoro_repeated_header() -> Laboratory:
    """The header again at each inclination, means at the end."""
    run = measure(rolls(FOUR, 6), NEUQUEN, 33)
    a, m = run.accelerometer(2, 5), run.magnetometer(5e-5, 6)
    columns = [
        numbers(run, "N°"), *references(run, "IAF", ["Incl", "Azim", "TF"], 2),
        *triad("a", "Acel {} [V]", a, 5), *triad("m", "Mag {} [V]", m, 6),
        *references(run, "T", ["Temp [°C]"], 1),
    ]  # fmt: skip
    again = [[], [column.header for column in columns]]
    layout = laid_out(
        columns, before=[["Herramienta", "CR-77"], ["Fecha", "18-02-2026"], []],
        breaks=dict.fromkeys((6, 12, 18), again),
        after=[[], *statistics(columns, ["Promedio", "Desv. est."], 4), ["Total de estaciones: 24"]],
    )  # fmt: skip
    truth = facts(run, a, m, serial="CR-77", date="2026-02-18")
    return laboratory("comodoro_cr77.tsv", layout, truth, text=Text("\t"), movable=False)


def villahermosa_field_units() -> Laboratory:
    """Total field in µT and gravity in m/s² beside components in nT and mg."""
    run = measure(rolls(FIVE, 6), VILLAHERMOSA, 34)
    a, m = run.accelerometer(1000, 2), run.magnetometer(1, 1)
    total, gravity = np.round(run.field / 1000, 3), np.round(run.gravity * STANDARD_GRAVITY, 4)
    columns = [
        *triad("a", "A{} (mg)", a, 2), *triad("m", "M{} (nT)", m, 1), *references(run, "T", ["T (C)"], 1),
        *references(run, "IAF", SPANISH, 2), Column("ref_field_nt", "Campo total", typed(total, 3)),
        *references(run, "D", ["Echado"], 2), Column("ref_gravity_g", "Gravedad", typed(gravity, 4)),
    ]  # fmt: skip
    before = [
        ["Campo total del observatorio en microteslas; gravedad local en m/s2; angulos en grados"]
    ]
    truth = facts(
        run, a, m, "TIAFD", ref_field_nt=total * 1000, ref_gravity_g=gravity / STANDARD_GRAVITY
    )
    return laboratory(
        "villahermosa_campo.csv", laid_out(columns, before=before), truth, text=Text(","),
        trap="total field in µT (said in the first line) beside components in nT; dip called echado",
    )  # fmt: skip


def bogota_radians() -> Laboratory:
    run = measure(rolls(SIX, 4), BOGOTA, 35, digits=3)
    a, m = run.accelerometer(STANDARD_GRAVITY, 4), run.magnetometer(1, 1)
    names = [LETTERS[k][0] for k in "IAF"]
    turns = [run.inclination, run.azimuth, (run.toolface + 180) % 360 - 180]
    radians = [np.round(np.radians(v), 5) for v in turns]
    columns = [
        numbers(run, "i"), *[Column(names[k], SPANISH[k], typed(radians[k], 5)) for k in range(3)],
        *triad("a", "a{} (m/s²)", a, 4), *triad("m", "B{} (nT)", m, 1),
        *references(run, "T", ["temperatura (°C)"], 1),
    ]  # fmt: skip
    truth = facts(run, a, m, "T") | {names[k]: np.degrees(radians[k]) for k in range(3)}
    return laboratory(
        "bogota_radianes.csv", laid_out(columns), truth, text=Text(",", newline="\n"),
        trap="angles in radians, toolface from -π to π; their headers have no unit",
    )  # fmt: skip


def salvador_grid_north() -> Laboratory:
    """Azimuths from grid north, and nothing that says how far that is from magnetic north."""
    run = measure(rolls(FIVE, 4), MACAE, 36)
    a, m = run.accelerometer(1000, 2), run.magnetometer(1, 1)
    grid = np.round((run.azimuth - 23.4) % 360, 2)
    columns = [
        other("Ponto", range(1, len(run) + 1)), *references(run, "I", ["Inclinação (°)"]),
        other("Azimute de quadrícula UTM (°)", grid.tolist()), *references(run, "F", ["Toolface (°)"]),
        *triad("a", "Acel. {} (mg)", a), *triad("m", "Mag. {} (nT)", m),
        *references(run, "T", ["Temp. (°C)"]),
    ]  # fmt: skip
    before: Rows = [["Ferramenta", "SSA-31"], ["Data", datetime(2026, 1, 15)], []]
    truth = facts(run, a, m, "TIF", serial="SSA-31", date="2026-01-15", ref_azimuth_grid_deg=grid)
    return laboratory(
        "salvador_quadricula.ods", laid_out(columns, before=before), truth, sheet="Planilha1",
        trap="azimuths are from grid north", question="declination and convergence at the stand",
    )  # fmt: skip


# --- Russian ----------------------------------------------------------------------------------

RUSSIAN = ("Зенитный угол", "Азимут", "Угол установки отклонителя")


def perm_semicolons() -> Laboratory:
    run = measure(rolls(FOUR, 8), PERM, 37)
    a, m = run.accelerometer(3000, 1), run.magnetometer(0.001, 4, "+x-y+z")
    columns = [
        numbers(run, "№ п/п"), *references(run, "IAF", [f"{n}, град" for n in RUSSIAN], 2, ","),
        *triad("a", "Акселерометр {}, мВ", a, 1, ","), *triad("m", "Магнитометр {}, мкТл", m, 4, ","),
        *references(run, "T", ["Температура, °C"], 1, ","), remarks(run, "Примечание", {8: "поворот стола"}),
    ]  # fmt: skip
    before = [["Протокол калибровки инклинометра"], ["Зав. №", "П-1153"], ["Дата", "12.03.2026"],
              ["Оператор", "Иванова"], []]  # fmt: skip
    truth = facts(run, a, m, serial="П-1153", date="2026-03-12")
    text = Text(";", encoding="cp1251")
    return laboratory("perm_p1153.csv", laid_out(columns, before=before), truth, text=text)


def ufa_workbook() -> Laboratory:
    """Merged header of two rows, unit row, mean and deviation, signatures."""
    run = measure(rolls(SIX, 6), PERM, 38)
    a, m = run.accelerometer(100_000, 0), run.magnetometer(50, 0)
    columns = [
        other("№", range(1, len(run) + 1)), *references(run, "IAF", ["Зенит", "Азимут", "Визир"]),
        *triad("a", "{}", a), *triad("m", "{}", m), *references(run, "T", ["Темп."]),
        *references(run, "BD", ["Модуль поля", "Наклонение"]),
    ]  # fmt: skip
    groups: list[Cell] = [None, "Установка", None, None, "Акселерометры", None, None, "Феррозонды", None,
                          None, None, "Обсерватория", None]  # fmt: skip
    units = [None, *["град"] * 3, *["код АЦП"] * 6, "°C", "нТл", "град"]
    before: Rows = [["Прибор зав. № 0447"], ["Дата:", datetime(2026, 2, 2)], []]
    after: Rows = [
        *statistics(columns, ["Среднее", "СКО"], None),
        [],
        ["Подпись ____________ /Гареев/"],
    ]
    layout = laid_out(columns, before=before, over=[groups], under=[units], after=after)
    h = layout.header
    merged = ((h, 1, h, 3), (h, 4, h, 6), (h, 7, h, 9), (h, 11, h, 12))
    truth = facts(run, a, m, "TIAFBD", serial="0447", date="2026-02-02")
    return laboratory("ufa_0447.xlsx", layout, truth, sheet="Лист1", merged=merged)


def tyumen_minutes() -> Laboratory:
    """Degrees and minutes in columns of their own, UTF-16."""
    run = measure(rolls(FIVE, 4), PERM, 39, digits=3)
    a, m = run.accelerometer(1, 5), run.magnetometer(1, 1)
    columns, truth = [numbers(run, "Точка")], facts(run, a, m, "T", serial="72-016")
    for letter, header in zip("IAF", RUSSIAN, strict=True):
        key, name = LETTERS[letter]
        minutes = np.rint(getattr(run, name) * 60).astype(int)
        whole, rest = np.divmod(minutes, 60)
        columns.append(Column(key, f"{header}, град", [str(v) for v in whole]))
        columns.append(Column(key, f"{header}, мин", [f"{v:02d}" for v in rest]))
        truth[key] = minutes / 60
    columns += [
        *triad("a", "G{}, g", a, 5, ","), *triad("m", "T{}, нТл", m, 1, ","),
        *references(run, "T", ["Темп., °C"], 1, ","),
    ]  # fmt: skip
    return laboratory(
        "tyumen_016.txt", laid_out(columns, before=[["Прибор № 72-016"], []]), truth, movable=False,
        text=Text("\t", encoding="utf-16"), trap="degrees and minutes of each angle in two columns",
    )  # fmt: skip


def izhevsk_set_and_read() -> Laboratory:
    """Blanks between columns; the angles that were set beside those that were read off the stand."""
    run = measure(rolls(FOUR, 5), PERM, 40, setting=0.2)
    a, m = run.accelerometer(1000, 1), run.magnetometer(1, 0)
    planned = rolls(FOUR, 5)
    columns = [
        numbers(run, "N"), *[other(f"{n}_зад", typed(planned[:, k], 0)) for k, n in enumerate("ZAV")],
        *references(run, "IAF", ["Z_изм", "A_изм", "V_изм"], 2), *triad("a", "G{}_мВ", a, 1),
        *triad("m", "H{}_нТл", m, 0), *references(run, "T", ["T_C"], 1),
    ]  # fmt: skip
    before = [["Z - зенитный угол, A - магнитный азимут, V - визирный угол, градусы"],
              ["зад - заданный, изм - отсчёт по лимбам стенда"], []]  # fmt: skip
    text = Text("  ", encoding="cp1251")
    return laboratory(
        "izhevsk.txt", laid_out(columns, before=before), facts(run, a, m), text=text,
        trap="set angles (зад) beside read angles (изм), which are the references",
    )  # fmt: skip


# --- Chinese ----------------------------------------------------------------------------------

CHINESE = ("井斜角", "方位角", "工具面角")


def xian_gb18030() -> Laboratory:
    run = measure(rolls(SIX, 4), XIAN, 41)
    a, m = run.accelerometer(2500, 1, "+y+x+z"), run.magnetometer(1, 1, "+y+x+z")
    columns = [
        numbers(run, "序号"), *triad("a", "加速度计{}(mV)", a, 1), *triad("m", "磁通门{}(nT)", m, 1),
        *references(run, "T", ["温度(℃)"], 1), *references(run, "IAF", [f"{n}(°)" for n in CHINESE], 2),
        remarks(run, "备注", {0: "开始", 12: "复位"}),
    ]  # fmt: skip
    before = [["定向探管标定记录"], ["仪器编号:", "XA-2309"], ["日期:", "2026年3月8日"], []]
    truth = facts(run, a, m, serial="XA-2309", date="2026-03-08")
    text = Text(",", encoding="gb18030")
    return laboratory("xian_2309.csv", laid_out(columns, before=before), truth, text=text)


def chengdu_workbook() -> Laboratory:
    """Merged headers, a station's number merged over each roll set, means below."""
    run = measure(rolls(FOUR, 6), XIAN, 42)
    a, m = run.accelerometer(1, 5), run.magnetometer(0.001, 4)
    sets = [f"第{k // 6 + 1}组" if k % 6 == 0 else None for k in range(len(run))]
    columns = [
        other("组别", sets), *references(run, "IAF", CHINESE), *triad("a", "{}", a), *triad("m", "{}", m),
        *references(run, "TB", ["探管温度", "总场"]),
    ]  # fmt: skip
    groups = [
        None,
        "转台 (°)",
        None,
        None,
        "加速度计 (g)",
        None,
        None,
        "磁力计 (µT)",
        None,
        None,
        "(℃)",
        "(nT)",
    ]
    before: Rows = [["仪器号", "CD-88"], ["标定日期", datetime(2026, 1, 27)]]
    after: Rows = [*statistics(columns, ["平均值"], None), ["检验员:", None, None, "审核:"]]
    layout = laid_out(columns, before=before, over=[groups], after=after)
    h, first = layout.header, layout.rows[0]
    merged = ((h, 1, h, 3), (h, 4, h, 6), (h, 7, h, 9))
    merged += tuple((first + k, 0, first + k + 5, 0) for k in (0, 6, 12, 18))  # type: ignore[assignment]
    truth = facts(run, a, m, "TIAFB", serial="CD-88", date="2026-01-27")
    return laboratory("chengdu_cd88.xlsx", layout, truth, sheet="标定", merged=merged)


# --- A fourth hand: kinds of tables that another person's forty had -----------------------------


def _one_line(place: Place, form: str) -> list[list[Cell]]:
    """The references of a place, all in one line."""
    return [[form.format(place.field, place.dip, place.gravity * STANDARD_GRAVITY)]]


def regina_pages() -> Laboratory:
    """A printed listing: fixed columns, the first without a unit, and the head again on each page."""
    run = measure(rolls(SIX, 4), CALGARY, 51)
    run = replace(run, field=np.full(len(run), 56120.0), dip=np.full(len(run), 73.21))
    a, m = run.accelerometer(2_000_000, 0), run.magnetometer(80, 0)
    columns = [
        numbers(run, "STN"), *references(run, "IAF", ["INC", "AZI", "TF"], 2), *triad("a", "A{}", a, 0),
        *triad("m", "M{}", m, 0), *references(run, "T", ["TEMP"], 1),
    ]  # fmt: skip
    title = [
        ["REGINA DIRECTIONAL"],
        ["TOOL S/N 7741D"],
        *_one_line(CALGARY, "REF FIELD {:.0f} NT DIP {:.2f} G {:.4f}"),
    ]
    units = ["   ", "DEG", "DEG", "DEG", *["CNT"] * 6, "DEGC"]
    again: Rows = [[], *title, [each.header for each in columns], units]
    layout = laid_out(columns, before=title, under=[units], breaks={16: again})
    truth = facts(run, a, m, "TIAFBD", serial="7741D")
    return laboratory("regina.prn", layout, truth, text=Text("  ", padded=True))


def pau_dos() -> Laboratory:
    """Written by a program for DOS: ° and é as there; a roll test below the run."""
    run = measure(rolls(FIVE, 4), CELLE, 52)
    a, m = run.accelerometer(1000, 2), run.magnetometer(1, 0)
    columns = [
        numbers(run, "N°"), *references(run, "IAF", ["Incl (°)", "Azim (°)", "TF (°)"], 2, ","),
        *triad("a", "G{} (mg)", a, 2, ","), *triad("m", "B{} (nT)", m, 0, ","),
        *references(run, "T", ["T (°C)"], 1, ","),
    ]  # fmt: skip
    before: Rows = [["Étalonnage d'une sonde"], ["Numéro de série : PA-3307"], ["1. Positions"]]
    below = [[*row] for row in zip(*(each.cells[:12] for each in columns), strict=True)]
    after: Rows = [[], ["2. Essai en roulis"], [each.header for each in columns], *below]
    layout = laid_out(columns, before=before, after=after)
    truth = facts(run, a, m, serial="PA-3307")
    return laboratory("pau.txt", layout, truth, text=Text(";", encoding="cp850"))


def natal_upwards() -> Laboratory:
    """South of the magnetic equator: a dip in words, titles in plural, a title over the angles of the table."""
    run = measure(rolls(FIVE, 4), MACAE, 53)
    run = replace(run, field=np.full(len(run), 23127.0), dip=np.full(len(run), -39.87))
    a, m = run.accelerometer(1, 5), run.magnetometer(1, 0)
    columns = [
        other("Estação", range(1, len(run) + 1)), *references(run, "IAF", ["Incl.", "Azim.", "TF"]),
        *triad("a", "{}", a), *triad("m", "{}", m), *references(run, "T", [""]),
    ]  # fmt: skip
    over = ["Ponto", "Ângulos da mesa (°)", None, None, "Acelerômetros (g)", None, None,
            "Magnetômetros (nT)", None, None, "Temp. (°C)"]  # fmt: skip
    columns[0] = columns[0]._replace(header="")
    cover = Sheet("Capa", (
        ("CERTIFICADO", None), ("Nº de série", "RN-2051"), ("Campo magnético total", "23.127 nT"),
        ("Inclinação magnética", "39,87° para cima"), ("Gravidade local", "9,7873 m/s²"),
    ))  # fmt: skip
    truth = facts(run, a, m, "TIAFBD", serial="RN-2051")
    return laboratory(
        "natal.xlsx", laid_out(columns, over=[over]), truth, sheet="Leituras", sheets=(cover,), at=1
    )


def reynosa_remarks() -> Laboratory:
    """Stations measured twice: a remark rejects the row, or the row before it."""
    run = measure(rolls(FIVE, 4), VILLAHERMOSA, 54)
    a, m = run.accelerometer(3, 4), run.magnetometer(5e-5, 4)
    said = {
        4: "mala - pasó un montacargas",
        11: "se movió la base",
        12: "repetida, la anterior es mala",
    }
    columns = [
        numbers(run, "Est."),
        *references(run, "IAF", ["Inclinación (grados)", "Azimut (grados)", "Cara de herr. (grados)"], 2),
        *triad("a", "A{} volts", a.copy(), 4), *triad("m", "M{} volts", m, 4), remarks(run, "Observaciones", said),
    ]  # fmt: skip
    kept = [k for k in range(len(run)) if k not in (4, 11)]
    truth = {key: np.asarray(each)[kept] for key, each in facts(run, a, m, "IAF").items()}
    return laboratory("reynosa.csv", laid_out(columns), truth, text=Text(","))


def dongying_void() -> Laboratory:
    """An aborted run on a sheet that says so; inclinations from the horizontal, downwards."""
    run = measure(rolls(FIVE, 4), XIAN, 55)
    a, m = run.accelerometer(20_000, 0), run.magnetometer(1 / 3, 0)
    columns = [
        other("序号", range(1, len(run) + 1)), other("倾角(与水平面夹角,向下为正)", (90 - run.inclination).tolist()),
        *references(run, "AF", ["磁方位", "工具面"]), *triad("a", "加速度计{}(码值)", a),
        *triad("m", "磁通门{}(码值)", m),
        *references(run, "T", ["温度℃"]),
    ]  # fmt: skip
    title: Rows = [["随钻测斜仪标定"], ["仪器编号", "CD-131"]]
    layout = laid_out(columns, before=title)
    void = Sheet("第一次(作废)", (*layout.grid[:14], ("电源故障,中止",)))
    truth = facts(run, a, m, serial="CD-131")
    return laboratory("dongying.xlsx", layout, truth, sheet="第二次", sheets=(void,), at=1)


def jubail_gaps() -> Laboratory:
    """Two stations without a reading, as cells say; the set and the read angles of the stand."""
    run = measure(rolls(FIVE, 4), DUBAI, 56, setting=0.2)
    a, m = run.accelerometer(1, 4), run.magnetometer(1, 0)
    cells = triad("a", "G{} (g)", a, 4), triad("m", "B{} (nT)", m, 0)
    cells[0][1] = cells[0][1]._replace(cells=[*cells[0][1].cells[:6], "", *cells[0][1].cells[7:]])
    cells[1][1] = cells[1][1]._replace(
        cells=[*cells[1][1].cells[:13], "N/A", *cells[1][1].cells[14:]]
    )
    plan = rolls(FIVE, 4)
    columns = [
        numbers(run, "Station"),
        *[other(f"Set {n} (deg)", typed(plan[:, k], 0)) for k, n in enumerate(["Inc", "Azi", "TF"])],
        *references(run, "IAF", ["Stand actual Inc (deg)", "Stand actual Azi (deg)", "Stand actual TF (deg)"], 2),
        *cells[0], *cells[1], *references(run, "T", ["Temp (degC)"], 1),
    ]  # fmt: skip
    kept = [k for k in range(len(run)) if k not in (6, 13)]
    truth = {key: np.asarray(each)[kept] for key, each in facts(run, a, m).items()}
    return laboratory("jubail.csv", laid_out(columns), truth, text=Text(","))


# --- All of them ------------------------------------------------------------------------------

TABLES: tuple[Callable[[], Laboratory], ...] = (
    houston_counts, aberdeen_workbook, calgary_quoted, conroe_labview, midland_typed, perth_logger,
    aberdeen_pipes, pune_computed_totals, perth_elevation, houston_fahrenheit, denver_theodolite,
    tulsa_two_tools, lafayette_side_by_side, oklahoma_bearings, anchorage_true_north,
    broussard_left_handed, dubai_gauss, headerless, celle_semicolons, hannover_formulas, clausthal_ods,
    freiberg_gon, muenchen_unicode, stavanger_semicolons, bergen_soak_sheets, trondheim_swapped,
    haugesund_commas, forus_rejected, neuquen_semicolons, macae_text_numbers, comodoro_repeated_header,
    villahermosa_field_units, bogota_radians, salvador_grid_north, perm_semicolons, ufa_workbook,
    tyumen_minutes, izhevsk_set_and_read, xian_gb18030, chengdu_workbook,
    regina_pages, pau_dos, natal_upwards, reynosa_remarks, dongying_void, jubail_gaps,
)  # fmt: skip


@cache
def laboratories() -> list[Laboratory]:
    """Every table, the same bytes each time."""
    return [table() for table in TABLES]


# --- Mutations --------------------------------------------------------------------------------


class Changed(NamedTuple):
    form: Form
    changes: Literal["nothing", "values"]
    what: str


def mutated(laboratory: Laboratory, rng: np.random.Generator) -> Laboratory | None:
    """The table with one random change, or None where the one that was drawn cannot be made to it."""
    mutation = MUTATIONS[int(rng.integers(len(MUTATIONS)))]
    done = mutation(laboratory.form, rng)
    if done is None:
        return None
    try:
        content = rendered(done.form, laboratory.file)
    except UnicodeEncodeError:
        return None
    if content == laboratory.content:
        return None
    return replace(
        laboratory, content=content, form=done.form, changes=done.changes, mutation=done.what,
        name=f"{laboratory.name}+{mutation.__name__.strip('_')}",
    )  # fmt: skip


def _grid(form: Form) -> list[list[Cell]]:
    return [list(row) for row in form.sheets[form.at].grid]


def _with_grid(form: Form, grid: Rows) -> Form:
    sheet = form.sheets[form.at]._replace(grid=tuple(tuple(row) for row in grid))
    return replace(form, sheets=(*form.sheets[: form.at], sheet, *form.sheets[form.at + 1 :]))


def _inserted(form: Form, at: int, row: Sequence[Cell]) -> Form:
    """One more row, everything below it moved down."""

    def down(r: int) -> int:
        return r + (r >= at)

    grid = _grid(form)
    form = _with_grid(form, [*grid[:at], row, *grid[at:]])
    sheet = form.sheets[form.at]
    merged = tuple((down(t), left, down(b), right) for t, left, b, right in sheet.merged)
    sheet = sheet._replace(merged=merged, hidden=tuple(map(down, sheet.hidden)))
    sheets = (*form.sheets[: form.at], sheet, *form.sheets[form.at + 1 :])
    return replace(form, sheets=sheets, header=down(form.header), rows=tuple(map(down, form.rows)))


def _spot(form: Form, rng: np.random.Generator) -> tuple[int, int]:
    """Row and column of a random cell that the truth holds."""
    keyed = [c for c, key in enumerate(form.keys) if key]
    return int(rng.choice(form.rows)), int(rng.choice(keyed))


def _name(form: Form, column: int) -> str:
    """A column's header for a message; a table may have none."""
    row = _grid(form)[form.header]
    headed = form.header not in form.rows and column < len(row)
    return f"{form.keys[column]} ({row[column]})" if headed else form.keys[column]


def _remark(form: Form, rng: np.random.Generator) -> Changed:
    said = (
        "power cut at 10:42, resumed",
        "checked by QA",
        "see logbook p. 114",
        "stand levelled again",
    )
    row = int(rng.choice([form.header, form.rows[-1] + 1, *form.rows[1:]]))
    text = str(rng.choice(said))
    return Changed(_inserted(form, row, [text]), "nothing", f"remark in row {row + 1}: {text}")


def _blank_row(form: Form, rng: np.random.Generator) -> Changed:
    row = int(rng.choice(form.rows))
    return Changed(_inserted(form, row, []), "nothing", f"blank row {row + 1}")


def _duplicate_row(form: Form, rng: np.random.Generator) -> Changed:
    row = int(rng.choice(form.rows))
    changed = _inserted(form, row + 1, _grid(form)[row])
    return Changed(changed, "values", f"row {row + 1} stands twice")


def _column_moved(form: Form, rng: np.random.Generator) -> Changed | None:
    if not form.movable:
        return None
    width = len(form.keys)
    source, goal = (int(k) for k in rng.choice(width, 2, replace=False))
    if any(isinstance(cell, Formula) for row in _grid(form) for cell in row):
        return None

    def shuffled(cells: Sequence[Any], blank: Any) -> list[Any]:
        full = [*cells, *[blank] * (width - len(cells))]
        full.insert(goal, full.pop(source))
        return full

    last = form.rows[-1]
    grid = [
        shuffled(row, None) if form.header <= r <= last and len(row) > 2 else row
        for r, row in enumerate(_grid(form))
    ]
    changed = replace(_with_grid(form, grid), keys=tuple(shuffled(form.keys, "")))
    return Changed(
        changed, "nothing", f"{_name(form, source)} moved from column {source + 1} to {goal + 1}"
    )


def _sheet_added(form: Form, rng: np.random.Generator) -> Changed | None:
    if form.text is not None:
        return None
    extra = (
        Sheet("Notes", (("Heating failed on the first try",), ("Repeat next week",))),
        Sheet("Sheet9", ()),
        Sheet(
            "Limits", (("Quantity", "Limit"), ("G total", 0.003), ("B total", 300), ("Dip", 0.3))
        ),
    )
    sheet, first = extra[int(rng.integers(len(extra)))], bool(rng.integers(2))
    sheets = (sheet, *form.sheets) if first else (*form.sheets, sheet)
    changed = replace(form, sheets=sheets, at=form.at + first)
    return Changed(changed, "nothing", f"sheet {sheet.name} added")


UNIT = re.compile(r"\s*[\[(]([^\])]*)[\])]")
PLAIN_UNITS = ("mv", "v", "mg", "g", "nt", "µt", "ut", "deg", "°", "°c", "c", "degc", "℃", "grados")


def _case_changed(form: Form, rng: np.random.Generator) -> Changed | None:
    """Names in capitals or small letters; units, which capitals would change, stay."""
    if form.header in form.rows:
        return None
    grid = _grid(form)
    change: Callable[[str], str] = (str.upper, str.lower)[int(rng.integers(2))]
    found = False
    for column, cell in enumerate(grid[form.header]):
        name, *rest = re.split(
            r"(\s*[\[(].*|,.*|\s(?:mg|mV|nT|deg)\b.*|_[мн].*)", str(cell or ""), maxsplit=1
        )
        grid[form.header][column] = change(name) + "".join(rest) if cell else cell
        found = found or change(name) != name
    return (
        Changed(_with_grid(form, grid), "nothing", f"header {change.__name__}") if found else None
    )


def _unit_dropped(form: Form, rng: np.random.Generator) -> Changed | None:
    grid = _grid(form)
    header = grid[form.header]
    units = [UNIT.search(str(cell or "")) for cell in header]
    able = [
        c for c, key in enumerate(form.keys)
        if key and c < len(units) and (unit := units[c]) and unit[1].strip().lower() in PLAIN_UNITS
    ]  # fmt: skip
    if not able or form.header in form.rows:
        return None
    column = int(rng.choice(able))
    header[column] = UNIT.sub("", str(header[column]))
    return Changed(_with_grid(form, grid), "nothing", f"unit dropped of {_name(form, column)}")


def _decimal_changed(form: Form, rng: np.random.Generator) -> Changed | None:
    """Every number of the stations with the other decimal sign, as after a change of country."""
    grid = _grid(form)
    swap = str.maketrans(".,", ",.")
    if form.text is not None and form.text.delimiter == ",":
        return None
    for row in grid[: form.header]:  # LabVIEW says which sign it writes
        if row and row[0] == "Decimal_Separator":
            row[1] = str(row[1]).translate(swap)
    for r in form.rows:
        for c, key in enumerate(form.keys):
            cell = grid[r][c]
            if key and isinstance(cell, str | int | float):
                grid[r][c] = str(cell).translate(swap)
    return Changed(_with_grid(form, grid), "nothing", "decimal sign changed in every station")


def _cell_deleted(form: Form, rng: np.random.Generator) -> Changed:
    grid = _grid(form)
    row, column = _spot(form, rng)
    grid[row][column] = None
    return Changed(
        _with_grid(form, grid), "values", f"{_name(form, column)} of row {row + 1} deleted"
    )


def _letter_typed(form: Form, rng: np.random.Generator) -> Changed | None:
    grid = _grid(form)
    row, column = _spot(form, rng)
    cell = grid[row][column]
    text = str(cell.value if isinstance(cell, Formula) else cell)
    digits = [k for k, sign in enumerate(text) if sign.isdigit()]
    if not digits:
        return None
    at = int(rng.choice(digits))
    letter = {"0": "O", "1": "l", "5": "S", "8": "B"}.get(text[at], "x")
    grid[row][column] = text[:at] + letter + text[at + 1 :]
    what = f"{_name(form, column)} of row {row + 1}: {text} became {grid[row][column]}"
    return Changed(_with_grid(form, grid), "values", what)


def _last_line_cut(form: Form, rng: np.random.Generator) -> Changed:
    """The file ends in the middle of the last station."""
    grid = _grid(form)[: form.rows[-1] + 1]
    keyed = [c for c, key in enumerate(form.keys) if key]
    column = int(rng.integers(2, keyed[-1] + 1))
    grid[-1] = grid[-1][:column]
    sheet = form.sheets[form.at]
    kept = tuple(part for part in sheet.merged if part[2] < len(grid))
    form = _with_grid(form, grid)
    sheet = form.sheets[form.at]._replace(merged=kept)
    sheets = (*form.sheets[: form.at], sheet, *form.sheets[form.at + 1 :])
    return Changed(
        replace(form, sheets=sheets), "values", f"cut in the last station at column {column + 1}"
    )


MUTATIONS: tuple[Callable[[Form, np.random.Generator], Changed | None], ...] = (
    _remark, _blank_row, _duplicate_row, _column_moved, _sheet_added, _case_changed, _unit_dropped,
    _decimal_changed, _cell_deleted, _letter_typed, _last_line_cut,
)  # fmt: skip


# --- To look at -------------------------------------------------------------------------------


def write(folder: Path) -> None:
    """Every table as a file, and its truth beside it."""
    folder.mkdir(parents=True, exist_ok=True)
    for lab in laboratories():
        (folder / lab.file).write_bytes(lab.content)
        said = {
            "expected": lab.expected,
            "trap": lab.trap,
            "question": lab.question,
            "truth": lab.truth,
        }
        text = json.dumps(said, ensure_ascii=False, indent=1, default=np.ndarray.tolist)
        (folder / f"{lab.file}.truth.json").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    write(Path(sys.argv[1] if len(sys.argv) > 1 else "/tmp/labs40"))
