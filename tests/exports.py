"""Twenty tables of stations as loggers and spreadsheet programs export them, and the clean run behind them.

`python tests/exports.py DIR` writes them: a calibration run and a roll test of each dialect. Simulated.
"""

from __future__ import annotations

import csv
import io
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import openpyxl
import pyarrow as pa
import pyarrow.parquet as pq

from cli_support import RAW, SCALE, servo_run, write_csv

ANGLES = ("ref_inclination_deg", "ref_azimuth_deg", "ref_toolface_deg")
AXES = (
    (("+x", "+y", "+z"), ("+x", "+y", "+z")),
    (("-y", "+x", "+z"), ("+z", "+x", "+y")),
    (("-x", "-y", "+z"), ("-x", "-y", "+z")),
    (("-z", "+y", "+x"), ("-z", "+y", "+x")),
    (("+y", "-z", "-x"), ("+x", "-z", "+y")),
)
"""Axes of the channels, taken in turn."""

Columns = dict[str, Any]


def fahrenheit(t: Any) -> Any:
    return t * 9 / 5 + 32


def kelvin(t: Any) -> Any:
    return t + 273.15


def signed(a: Any) -> Any:
    """An angle in -180 … 180 degrees."""
    return (a + 180) % 360 - 180


@dataclass(frozen=True)
class Dialect:
    """How a table is written: names by the run file's, and what is done to each column's numbers.

    `order`: letters in the names of channels x, y and z.
    """

    names: dict[str, str]
    suffix: str = ".csv"
    delimiter: str = ","
    decimal: str = "."
    encoding: str = "utf-8"
    units: dict[str, str] = field(default_factory=dict)
    above: tuple[str, ...] = ()
    changes: dict[str, Callable[[Any], Any]] = field(default_factory=dict)
    raw_unit: tuple[float, float] = SCALE
    ends: int = 0
    quoting: int = csv.QUOTE_MINIMAL
    extra: dict[str, str] = field(default_factory=dict)
    order: str = "xyz"


def named(stations: str, raw: str, angles: str, field: str, warmth: str) -> dict[str, str]:
    """Names of the usual columns."""
    columns = ("station", *RAW, *ANGLES, "ref_field_nt", "temperature_c")
    return dict(
        zip(columns, (stations, *raw.split("|"), *angles.split("|"), field, warmth), strict=True)
    )


_G = "Gx|Gy|Gz|Bx|By|Bz"
_UNITS = {"ref_field_nt": "µT", "temperature_c": "°C", **dict.fromkeys(ANGLES, "°")}
_TESLA = {"ref_field_nt": lambda b: b / 1000}
DIALECTS = {
    "german": Dialect(
        named("Nr", _G, "Neigung|Azimut|Toolface", "Feldstärke", "Temp"),
        delimiter=";", decimal=",", encoding="cp1252", units=_UNITS, changes=_TESLA,
        above=("Kalibrierprotokoll Gerät 7", "Prüfer: Müller", ""), extra={"Bemerkung": "geprüft"},
    ),
    "german workbook": Dialect(
        named("Messpunkt", "Beschleunigung X|Beschleunigung Y|Beschleunigung Z|Magnetfeld X|Magnetfeld Y"
              "|Magnetfeld Z", "Neigung Soll|Azimut Soll|Rollwinkel Soll", "Gesamtfeld", "Temperatur"),
        suffix=".xlsx", units=_UNITS, changes=_TESLA, above=("Protokoll", ""),
    ),
    "excel utf-8": Dialect(
        named("Pos", _G, "Inc (°)|Azi (°)|TF (°)", "Btotal (µT)", "Temp (°C)"),
        delimiter=";", decimal=",", encoding="utf-8-sig", changes=_TESLA,
    ),
    "unicode text": Dialect(
        named("Station", _G, "Inclination [deg]|Azimuth [deg]|Toolface [deg]", "Total field [nT]", "Temp [°C]"),
        suffix=".tsv", delimiter="\t", decimal=",", encoding="utf-16",
    ),
    "milli-g": Dialect(
        named("Stn", "Gx (mg)|Gy (mg)|Gz (mg)|Bx (nT)|By (nT)|Bz (nT)", "Ref Inc (deg)|Ref Azi (deg)|Ref TF (deg)",
              "Ref Btotal (nT)", "Temp (degC)"),
        raw_unit=(1000.0, 1.0),
    ),
    "halliburton": Dialect(
        named("Shot", "Gx (g)|Gy (g)|Gz (g)|Bx (nT)|By (nT)|Bz (nT)", "Inc|Azm|GTF", "TotalField", "Temp"),
        raw_unit=(1.0, 1.0),
    ),
    "tensor": Dialect(
        named("No", "Gx (g)|Gy (g)|Gz (g)|Hx (gauss)|Hy (gauss)|Hz (gauss)", "Inc|Azm|GTF", "Htotal (gauss)", "Temp C"),
        raw_unit=(1.0, 1e-5), changes={"ref_field_nt": lambda b: b / 1e5},
    ),
    "schlumberger": Dialect(
        named("Survey", "Gz (mg)|Gy (mg)|Gx (mg)|Hz (nT)|Hy (nT)|Hx (nT)", "Inc|Azi|TF", "Htotal", "Temp"),
        raw_unit=(1000.0, 1.0), order="zyx",
    ),
    "standard": Dialect(
        named("Station", "Gx (m/s2)|Gy (m/s2)|Gz (m/s2)|Bx (nT)|By (nT)|Bz (nT)", "Inc|Azi|TF", "Btotal", "Temp"),
        raw_unit=(9.80665, 1.0), extra={"Ref Gravity (m/s2)": "9.80665"},
    ),
    "witsml": Dialect(
        named("station", "gravTran1Raw|gravTran2Raw|gravAxialRaw|magTran1Raw|magTran2Raw|magAxialRaw",
              "incl|azi|gtf", "magTotalField (nT)", "temp (degC)"),
        raw_unit=(9.80665, 1.0),
    ),
    "workbook": Dialect(
        named("Station", "Acc X (g)|Acc Y (g)|Acc Z (g)|Mag X (nT)|Mag Y (nT)|Mag Z (nT)",
              "Inclination (deg)|Azimuth (deg)|Toolface (deg)", "Field strength (nT)", "Temperature (°C)"),
        suffix=".xlsx", raw_unit=(1.0, 1.0),
    ),
    "parquet": Dialect(
        named("Station", _G, "Inc (deg)|Azi (deg)|TF (deg)", "Btotal (nT)", "Temp (°F)"),
        suffix=".parquet", changes={"temperature_c": fahrenheit},
    ),
    "fahrenheit": Dialect(
        named("Station", _G, "Inc|Azi|TF", "Btotal", "Temp (°F)"),
        delimiter="|", changes={"temperature_c": fahrenheit},
    ),
    "radians": Dialect(
        named("Station", _G, "Inc (rad)|Azi (rad)|TF (rad)", "Btotal (gauss)", "Temp (K)"),
        changes={**dict.fromkeys(ANGLES, np.radians), "temperature_c": kelvin, "ref_field_nt": lambda b: b / 1e5},
    ),
    "open ends": Dialect(
        named("Station", _G, "Inc|Azi|TF", "Btotal", "Temp"),
        delimiter=";", above=("Run 12",), ends=3, changes={"ref_field_nt": lambda b: b / 1000},
    ),
    "french": Dialect(
        named("Point", "Acc X|Acc Y|Acc Z|Mag X|Mag Y|Mag Z", "Inclinaison (°)|Azimut (°)|Toolface (°)",
              "Btotal (nT)", "Température (°C)"),
        delimiter=";", decimal=",", encoding="cp1252",
    ),
    "quoted": Dialect(
        named("Station", _G, "Inc|Azi|TF", "Btotal", "Temp"),
        decimal=",", quoting=csv.QUOTE_ALL,
    ),
    "signed angles": Dialect(
        named("Station", _G, "Inc (deg)|Azi (deg)|TF (deg)", "Btotal (nT)", "Temp (C)"),
        suffix=".tsv", delimiter="\t", changes=dict.fromkeys(ANGLES[1:], signed),
    ),
    "metadata": Dialect(
        named("Station", _G, "Inc (deg)|Azi (deg)|TF (deg)", "Btotal (nT)", "Temp (C)"),
        delimiter=";", above=('# serial = "MWD-9"', '# operator = "A. B."'), extra={"Time": "2024-05-01 12:00:00"},
    ),
    "measured beside": Dialect(
        named("Station", "GX|GY|GZ|HX|HY|HZ", "Ref Inclination|Ref Azimuth|Ref Toolface",
              "Ref Field (nT)", "Board temp (degC)"),
        extra={"Inclination": "1.5", "Azimuth": "2.5"},
    ),
}  # fmt: skip


def runs(place: int) -> tuple[Columns, Columns]:
    """A calibration run and a roll test of a tool, wired as this place in the list of axes says."""
    wiring = AXES[place % len(AXES)]
    return (
        wired(servo_run(place, (5, 45, 90, 130), 12), *wiring),
        wired(servo_run(place, (35,), 8), *wiring),
    )


def wired(run: Columns, *wiring: tuple[str, ...]) -> Columns:
    """A run of a tool whose channels measure these axes."""
    out = {k: np.asarray(v) for k, v in run.items() if k not in ("ref_gravity_g", "ref_dip_deg")}
    for kind, triad in zip("am", wiring, strict=True):
        for channel, axis in zip("xyz", triad, strict=True):
            out[kind + channel] = (1 if axis[0] == "+" else -1) * np.asarray(run[kind + axis[1]])
    return out


def axes(place: int, d: Dialect) -> list[tuple[str, ...]]:
    """The axes of the channels named x, y, z in the export at a place."""
    return [tuple(triad[d.order.index(c)] for c in "xyz") for triad in AXES[place % len(AXES)]]


def cells(run: Columns, d: Dialect) -> Columns:
    """Columns of an export under their names, as numbers."""
    out: Columns = {}
    for column, name in d.names.items():
        values = run.get(column, np.arange(1, len(run["ax"]) + 1))
        if column in RAW:
            values = values / SCALE[column[0] == "m"] * d.raw_unit[column[0] == "m"]
        out[name] = d.changes.get(column, lambda v: v)(values)
    return out


def write(path: Path, run: Columns, d: Dialect) -> Path:
    """A run in a dialect, as a file with its suffix."""
    columns = cells(run, d)
    count = len(run["ax"])
    path = path.with_suffix(d.suffix)
    units = [d.units.get(column, "") for column in d.names] + [""] * len(d.extra)
    rows: list[list[Any]] = [[line] for line in d.above]
    rows.append([*columns, *d.extra])
    rows += [units] if d.units else []
    body = zip(*(v.tolist() for v in columns.values()), strict=True)
    if d.suffix == ".parquet":
        pq.write_table(pa.table({**columns, **{k: [v] * count for k, v in d.extra.items()}}), path)
        return path
    if d.suffix == ".xlsx":
        book = openpyxl.Workbook()
        for row in [*rows, *([*row, *d.extra.values()] for row in body)]:
            book.active.append([cell or None if isinstance(cell, str) else cell for cell in row])
        book.save(path)
        return path
    stream = io.StringIO()
    writer = csv.writer(stream, delimiter=d.delimiter, lineterminator="\r\n", quoting=d.quoting)
    for row in rows[: len(d.above)]:
        stream.write(row[0] + d.delimiter * d.ends + "\r\n")
    for row in rows[len(d.above) :]:
        writer.writerow([*row, *[""] * d.ends])
    for row in body:
        texts = [repr(v).removesuffix(".0").replace(".", d.decimal) for v in row]
        writer.writerow([*texts, *d.extra.values(), *[""] * d.ends])
    path.write_bytes(stream.getvalue().encode(d.encoding))
    return path


def clean(folder: Path, place: int) -> tuple[Path, Path, Path]:
    """The run, the roll test and the profile as documented, without a word on tables."""
    run, roll = runs(place)
    accelerometer, magnetometer = AXES[place % len(AXES)]
    profile = folder / "tool.toml"
    profile.write_text(
        f'name = "clean"\n[accelerometer]\naxes = {[*accelerometer]}\nscale = {SCALE[0]}\n'
        f"[magnetometer]\naxes = {[*magnetometer]}\nscale = {SCALE[1]}\n"
    )
    return write_csv(folder / "run.csv", run), write_csv(folder / "roll.csv", roll), profile


if __name__ == "__main__":
    for place, (name, dialect) in enumerate(DIALECTS.items()):
        target = Path(sys.argv[1]) / name.replace(" ", "-")
        target.mkdir(parents=True, exist_ok=True)
        for stem, table in zip(("run", "roll"), runs(place), strict=True):
            print(write(target / stem, table, dialect))
