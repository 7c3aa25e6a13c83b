"""Random commands on damaged files, and what is promised of every command. `make fuzz` runs it.

The commands, their arguments and their options are read from the command line itself, so that a
command added later is covered as soon as `SAMPLES` says which files its new arguments take. A seed
is one case, and the same one on every machine: `python tests/fuzz.py --seeds 17:18 --keep`.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import itertools
import json
import math
import multiprocessing
import random
import re
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections import Counter
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.sax.saxutils import escape

import click
import numpy as np
import openpyxl
import pyarrow as pa
import pyarrow.parquet as pq

import cli_support
import mwdcal
from cli_support import EXAMPLE, cell, servo_run, write_csv
from laboratories import laboratories, mutated
from mwdcal.files.formats import table
from test_fleet import roll_run

LONGEST_SECONDS = 10
"""Of processor time; twelve times as long by the clock, on a machine that may be busy."""
MOST_MEMORY = 500_000_000
QUIET = (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning)

# ------------------------------------------------------------------ samples: sound files by kind

SAMPLES = {
    "run": "run",
    "calibration": "calibration",
    "readings": "run",
    "log": "log",
    "runs": "fleet",
    "tool": "profile",
    "limits": "limits",
    "error_model": "model",
    "sensor_drift": "limits",
    "prior": "calibration",
    "effects": "effects",
    "plan": "plan",
    "rolltest": "plan",
    "plans": "plan",
    "measured": "run",
    "reference": "reference",
    "key": "key",
    "keys": "key",
    "public": "key",
    "private_key": "key",
    "x509": "any",
    "document": "signed",
    "verification": "verification",
    "as_found": "verification",
    "laboratory": "laboratory",
    "database": "registry",
    "source": "registry",
    "registry": "registry",
    "files": "any",
}
"""The kind of file that each argument or option takes, by its name."""
DOCUMENTS = ("calibration", "verification", "signed")
"""Kinds of files that are JSON."""
OUTPUTS = (
    "output",
    "report",
    "plot",
    "folder",
    "calibrations",
    "truth",
    "html",
    "msa_html",
    "contributions",
    "listing",
)
"""Arguments and options that name what to write."""
LIMITS = 'name = "lab"\n[spread]\ninclination_deg = 0.2\nazimuth_deg = 1.5\n'
SURVEY_LIMITS = (
    'name = "lab"\nprobability = 0.9973\nfield_nt = 900.0\n[sensor]\nmagnetometer_bias_nt = 70.0\n'
)
ERROR_MODEL = json.dumps(
    {
        "metadata": {"short_name": "lab"},
        "parameters": {"XCLTortuosity": 0.0006},
        "terms": [
            {
                "name": "AMIL",
                "value": 220.0,
                "units": "nT",
                "propagation_mode": "Systematic",
                "azimuth_formula": "Sin(Inc) * Sin(AzM) / (BField * Cos(Dip))",
            },
            {
                "name": "XYM3E",
                "value": 0.3,
                "units": "deg",
                "propagation_mode": "Random",
                "inclination_formula": "Abs(Cos(Inc)) * Max(1, Sqr(10 / (MD - MDPrev)))",
            },
        ],
    }
)
PLAN = 'name = "lab"\ntemperature_c = [25, 60]\n[[stations]]\ninclination_deg = [5, 60, 120]\ntoolface_deg = [0, 90]\n'
EFFECTS = "[accelerometer]\nturn_on = 2e-4\n[stand]\ntilt_deg = 0.1\n[earth]\nvariation_nt = 20.0\n"
SETTINGS = (
    'limits = "moradi"\ndecision = "guarded"\nlength_unit = "ft"\ntemperature_unit = "°C"\n[stand]\nazimuth_deg = 0.1\n'
    'settings = "per-station"\n[[standards]]\nquantity = "stand"\nname = "table"\ndue = 2026-01-31\n',
    'tool = "servo"\nkeys = ["lab.key.pub"]\nregistry = "out-tools.sqlite"\n[stand]\ninclination_deg = 0.02\n',
)
CALIBRATIONS = (
    ("servo.csv",),
    ("servo.csv", "--parameters", "9"),
    ("servo.csv", "--robust", "huber"),
    ("warm.csv", "--order", "1"),
    ("rolls.csv",),
    ("gravity.csv",),
    ("bent.csv", "--nonlinearity", "accelerometer"),
)


def log(seed: int, still: float, inclinations: tuple[float, ...]) -> dict[str, Any]:
    """Columns of a log at 20 Hz: tool positions held for so many seconds, turns between them."""
    rng = np.random.default_rng(seed)
    run = servo_run(seed, inclinations, 3)
    held = int(still * 20)
    raw = np.stack([run[name] for name in cli_support.RAW], -1)
    levels = np.concatenate(
        [
            np.concatenate([np.repeat(a[None], held, 0), np.linspace(a, b, 30)])
            for a, b in itertools.pairwise(raw)
        ]
    )
    levels += rng.normal(0, 3e-4, levels.shape)
    return {
        "time_s": np.arange(len(levels)) / 20,
        **dict(zip(cli_support.RAW, levels.T, strict=True)),
    }


def runs() -> dict[str, dict[str, Any]]:
    """Runs by file name."""
    servo = servo_run(1, (10, 60, 110), 8)
    return {
        "servo.csv": servo,
        "rolls.csv": roll_run(2),
        "warm.csv": servo_run(3, (10, 60, 110), 6, (25.0, 80.0, 130.0)),
        "well.csv": dict(cli_support.read_csv(EXAMPLE / "well.csv")),
        "gravity.csv": {k: v for k, v in servo.items() if not k.startswith("m")},
        "bent.csv": {**servo, **{a: servo[a] + 1e-4 * servo[a] ** 3 for a in ("ax", "ay", "az")}},
    }


def samples(folder: Path) -> dict[str, list[Any]]:
    """Sound files by kind: tables as columns, documents as text."""
    tables = runs()
    calibrations = []
    for k, (name, *options) in enumerate(CALIBRATIONS):
        run = write_csv(folder / name, tables[name], "simulated = true")
        target = folder / f"cal{k}.json"
        ran = cli_support.mwdcal("calibrate", run, "--tool", "servo", "-o", target, *options)
        assert ran.code == 0, ran
        calibrations.append(target.read_text("utf-8"))
    fleet = {
        name: np.concatenate([servo_run(seed, (10, 60, 110), 6)[name] for seed in range(4)])
        for name in servo_run(0, (10, 60, 110), 6)
    }
    fleet = {"serial": [f"T{i // 18}" for i in range(72)], **fleet}
    table = folder / "cals.parquet"
    runs_of_many = write_csv(folder / "fleet.csv", fleet, "simulated = true")
    ran = cli_support.mwdcal("fleet", runs_of_many, "-o", table, "--tool", "servo", "--workers", 1)
    assert ran.code == 0, ran
    place = cli_support.mwdcal(
        *(
            "reference",
            "--latitude",
            60,
            "--longitude",
            3.5,
            "--altitude-m",
            0,
            "--date",
            "2026-06-01",
        ),
        *("--crs", "EPSG:23031", "--json"),
    )
    assert place.code == 0, place
    roll = folder / "rolls.csv"
    tests = [
        cli_support.mwdcal("verify", folder / f"cal{k}.json", roll, "--json").out for k in (0, 1, 2)
    ]
    return {
        "run": list(tables.values()),
        "log": [log(4, 4.0, (20, 80, 120)), log(5, 20.0, (20,))],
        "fleet": [fleet],
        "calibration": [*calibrations, table.read_bytes()],
        "profile": [(EXAMPLE / "tool.toml").read_text("utf-8")],
        "limits": [LIMITS, SURVEY_LIMITS],
        "reference": [place.out],
        "model": [ERROR_MODEL],
        **signed(folder, calibrations[0]),
        "effects": [EFFECTS],
        "verification": tests,
        "laboratory": [(EXAMPLE / "laboratory.toml").read_text("utf-8")],
        "registry": [registry_of(folder / "tools.sqlite", folder / "cals.parquet", runs_of_many)],
        "plan": [PLAN],
    }


def registry_of(path: Path, *documents: Path) -> bytes:
    """The file of a registry that holds some documents."""
    for line in (("init",), ("add", *documents)):
        ran = cli_support.mwdcal("registry", "--registry", path, *line, "--as", "A. Borg")
        assert ran.code == 0, ran
    return path.read_bytes()


LABORATORIES = laboratories()


def laboratory_table(r: random.Random, stem: Path) -> tuple[Path, bool]:
    """A laboratory's own table, often changed, in a file; whether it has a magnetometer."""
    whole = r.choice(LABORATORIES)
    changed = (
        mutated(whole, np.random.default_rng(r.randrange(2**32))) if r.random() < 0.7 else None
    )
    each = changed or whole
    path = stem.with_suffix(Path(each.file).suffix)
    path.write_bytes(each.content)
    return path, "mx" in each.truth


# ------------------------------------------------------------------------------------- damage

NUMBERS = (
    *("0", "-0.0", "1", "-1", "360", "-360", "90", "-90", "180.0000001", "89.9999999", "1e-9"),
    *("1e-300", "1e300", "-1e300", "1e15", "-1e-15", "9" * 400, "0." + "0" * 400 + "1", "1e309"),
    *("nan", "-inf", "Infinity", "", " ", "1,5", "1_000", "0x1F", "1e", "--1", "5.", "½", "25 °C"),
    *("#DIV/0!", "=1+1", "TRUE", "None", "2024-02-30", "12:61", "-273.16", "1000000"),
)
TEXTS = (
    *("", " ", "a", "x" * 5000, "<script>alert(1)</script>", "[/b]", "[red]x", "S[a1]", "\\[x]"),
    *("\x1b[31mPASS\x1b[0m", "\x07", "\x9b2J", "\u202eabc", "\u2028", "\ufeff", "\x85", "\x00"),
    *("=1+2", "@sum", "+x", "-x", "'", '"', '""', "a,b", "a;b", "a\tb", "a\nb", "a\r\nb", "#x"),
    *("# y = 1", "%s%n", "{0}", "{{7*7}}", "$x$", "../x", "/dev/null", "CON", "é", "\U0001f600"),
    *("nan", "007", "1e5", "true", "None", "\ud800", "\\u0000", "*", "_x_", ":warning:"),
)
NAMES = (
    *("station", "group", "serial", "temperature_c", "time_s", "ax", "mz", "ref_dip_deg"),
    *("ref_azimuth_deg", "ref_gravity_g", "sd_ax", "sd_ref_field_nt", "gx_g", "azimuth_deg"),
    *("AX", "ax ", "Ax (mg)", "temp", "#", " #x", "", " ", "a\nb", "message", "status"),
)
DATES = (
    *(
        "2026-03-15",
        "15.03.2026",
        "03/15/26",
        "2026-3-5",
        "20260315",
        "2026-W11-7",
        "2026-074",
        "March 15",
    ),
    *("0001-01-01", "9999-12-31", "10000-01-01", "-0044-03-15", "2026-02-30", "2026-03-15T25:00"),
    *(
        "2026-03-15T12:00:00+14:00",
        "0001-01-01T00:00:00+14:00",
        "9999-12-31T23:59:59-12:00",
        "٢٠٢٦-٠٣-١٥",
    ),
)
SERIALS = (
    *(
        "007",
        "7",
        "0x7",
        "1e3",
        "1E3",
        "7.0",
        " T1",
        "T1 ",
        "t1",
        "Ｔ１",
        "T\u200b1",
        "e\u0301",
        "\u00e9",
        "A/B",
    ),
    *(
        "..",
        "A\\B",
        "a#b",
        "CON",
        "NaN",
        "null",
        "2026-03-15",
        "1_000",
        "#1",
        "-",
        "9" * 30,
        "T" * 300,
    ),
)
ODD = NUMBERS + TEXTS + DATES + SERIALS


class Columns:
    """Columns of text with metadata lines: what a table file holds."""

    def __init__(self, columns: dict[str, Any]):
        self.columns = {name: [cell(v) for v in values] for name, values in columns.items()}
        self.metadata = ["simulated = true"]

    @property
    def count(self) -> int:
        """Number of rows."""
        return len(next(iter(self.columns.values()), []))

    def change(self, r: random.Random, changes: tuple[Any, ...]) -> None:
        """One random damage."""
        if self.columns and self.count:
            r.choice(changes)(self, r, r.choice(list(self.columns)))

    def one_cell(self, r: random.Random, name: str) -> None:
        self.columns[name][r.randrange(self.count)] = r.choice(ODD)

    def whole_column(self, r: random.Random, name: str) -> None:
        self.columns[name] = [r.choice(ODD)] * self.count

    def every_cell(self, r: random.Random, name: str) -> None:
        self.columns[name] = [r.choice(ODD) for _ in range(self.count)]

    def numbers(self, r: random.Random, name: str) -> None:
        """Scaled, shifted, noisy, rounded or constant numbers."""
        size = 10.0 ** r.uniform(-12, 12 if r.random() < 0.3 else 0.5)
        change = r.choice(
            (
                lambda x: x * size,
                lambda x: x + size,
                lambda x: x + r.gauss(0, size),
                lambda x: -x,
                lambda x: round(x / size) * size,
                lambda x: size,
            )
        )
        for other in self.columns if r.random() < 0.2 else (name,):
            with contextlib.suppress(ValueError, OverflowError):
                self.columns[other] = [
                    repr(change(float(x))) if x else x for x in self.columns[other]
                ]

    def drop(self, r: random.Random, name: str) -> None:
        del self.columns[name]

    def rename(self, r: random.Random, name: str) -> None:
        new = r.choice(NAMES + TEXTS)
        self.columns = {new if k == name else k: v for k, v in self.columns.items()}

    def add(self, r: random.Random, name: str) -> None:
        source = r.choice([self.columns[name], [r.choice(ODD) for _ in range(self.count)]])
        self.columns[r.choice(NAMES)] = list(source)

    def swap(self, r: random.Random, name: str) -> None:
        other = r.choice(list(self.columns))
        self.columns[name], self.columns[other] = self.columns[other], self.columns[name]

    def rows(self, r: random.Random, name: str) -> None:
        """Some rows, in another order, or several times."""
        rows = list(range(self.count))
        picked = r.choice(
            (
                rows[: r.randrange(self.count + 1)],
                r.sample(rows, len(rows)),
                r.choices(rows, k=len(rows)),
                [*rows, rows[0]],
                [r.choice(rows)] * len(rows),
            )
        )
        self.columns = {k: [v[i] for i in picked] for k, v in self.columns.items()}

    def uncertainty(self, r: random.Random, name: str) -> None:
        self.columns[f"sd_{name}"] = [repr(10.0 ** r.uniform(-13, 4))] * self.count

    def blank(self, r: random.Random, name: str) -> None:
        share = r.choice((0.1, 0.5, 1.0))
        self.columns[name] = ["" if r.random() < share else v for v in self.columns[name]]

    def describe(self, r: random.Random, name: str) -> None:
        key = r.choice(
            ("serial", "date", "sampling_hz", "simulated", "azimuth_reference", "x", "findings")
        )
        value = r.choice(
            (
                *NUMBERS,
                *DATES,
                *SERIALS,
                *(json.dumps(t) for t in TEXTS + DATES + SERIALS),
                "[" * 500,
                "{a={b=1}}",
                "1979-05-27",
            )
        )
        self.metadata.append(f"{r.choice((key, key, r.choice(TEXTS)))} = {value}")


UNLUCKY = (Columns.numbers, Columns.numbers, Columns.rows, Columns.uncertainty, Columns.blank)
"""Damage that keeps a table readable."""
HOSTILE = (
    *(Columns.one_cell, Columns.whole_column, Columns.every_cell, Columns.drop, Columns.rename),
    *(Columns.add, Columns.swap, Columns.describe, *UNLUCKY),
)


def text_table(r: random.Random, t: Columns, path: Path) -> None:
    """As delimited text."""
    delimiter = "\t" if path.suffix == ".tsv" else r.choice(",,,,,,,,,,,,;\t ")
    with path.open("w", encoding="utf-8", errors="surrogatepass", newline="") as stream:
        stream.writelines(f"# {line}\n" for line in t.metadata)
        writer = csv.writer(stream, delimiter=delimiter, lineterminator="\n")
        writer.writerow(t.columns)
        writer.writerows(zip(*t.columns.values(), strict=True))


def parquet_table(r: random.Random, t: Columns, path: Path) -> None:
    """As Parquet, each column as numbers where it can be, or as text."""

    def typed(values: list[str]) -> Any:
        kind = r.random()
        try:
            numbers = [float(x) if x else None for x in values]
        except ValueError:
            return pa.array([x.encode("utf-8", "replace").decode() for x in values])
        if kind < 0.03:
            return pa.array([[x] for x in numbers])
        if kind < 0.06:
            return pa.array(numbers, pa.float64()).dictionary_encode()
        return pa.array(numbers, pa.float32() if kind < 0.1 else pa.float64())

    columns = {k.encode("utf-8", "replace").decode(): typed(v) for k, v in t.columns.items()}
    pairs = dict(line.split(" = ", 1) for line in t.metadata if " = " in line)
    metadata = {"mwdcal": json.dumps(pairs)[: None if r.random() < 0.95 else -1]}
    rows = r.choice((5, 1000, None))
    pq.write_table(pa.table(columns).replace_schema_metadata(metadata), path, row_group_size=rows)


def workbook_table(r: random.Random, t: Columns, path: Path) -> None:
    """As a workbook, numbers as numbers."""

    def value(x: str) -> Any:
        x = re.sub("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff]", "?", x)[:32_000]
        with contextlib.suppress(ValueError):
            number = float(x)
            return number if math.isfinite(number) else x
        return x

    book = openpyxl.Workbook()
    for row in (tuple(t.columns), *zip(*t.columns.values(), strict=True)):
        book.active.append([value(x) for x in row])
    book.save(path)


def log_table(r: random.Random, t: Columns, path: Path) -> None:
    """As LAS: the columns as curves, blanks as the header's NULL."""
    lines = ["~V", " VERS. 2.0 :", " WRAP. NO :", "~W", " NULL. -999.25 :", "~C", " DEPT.M :"]
    lines += [f" {name}.{r.choice(('', 'G', 'NT', 'DEGC'))} : x" for name in t.columns]
    lines += [f"~O{chr(10)}# {line}" for line in t.metadata if r.random() < 0.3]
    rows = zip(*([x.strip() or "-999.25" for x in v] for v in t.columns.values()), strict=True)
    lines += ["~A", *(f"{30 * k} {' '.join(row)}" for k, row in enumerate(rows))]
    path.write_text("\n".join(lines), "utf-8", "surrogatepass")


def trajectory_table(r: random.Random, t: Columns, path: Path) -> None:
    """As WITSML: raw channels as the elements of their triads, other columns as elements of their name."""
    words = {
        "a": ("grav", r.choice(("gn", "mgn", "m/s2"))),
        "m": ("mag", r.choice(("nT", "uT", "V"))),
    }
    axes = {"x": "Tran1", "y": "Tran2", "z": "Axial"}
    lines = ['<trajectorys xmlns="http://www.witsml.org/schemas/1series"><trajectory>']
    for k in range(t.count):
        cells = {name: escape(values[k]) for name, values in t.columns.items()}
        raw = [
            f'<{words[n[0]][0]}{axes[n[1]]}Raw uom="{words[n[0]][1]}">{cells[n]}</{words[n[0]][0]}{axes[n[1]]}Raw>'
            for n in cli_support.RAW
            if n in cells
        ]
        others = [f"<{n}>{x}</{n}>" for n, x in cells.items() if n not in cli_support.RAW]
        parts = f'<md uom="m">{30 * k}</md><rawData>{"".join(raw)}</rawData>{"".join(others)}'
        lines.append(f'<trajectoryStation uid="{k}">{parts}</trajectoryStation>')
    lines.append("</trajectory></trajectorys>")
    path.write_text("\n".join(lines), "utf-8", "replace")


WRITERS = {
    ".csv": text_table,
    ".tsv": text_table,
    ".txt": text_table,
    ".parquet": parquet_table,
    ".xlsx": workbook_table,
    ".las": log_table,
    ".xml": trajectory_table,
}


def table_file(
    r: random.Random, sample: dict[str, Any], stem: Path, suffixes: tuple[str, ...]
) -> Path:
    """A table, damaged or not, in a file."""
    t = Columns(sample)
    changes = r.choice((UNLUCKY, UNLUCKY, HOSTILE))
    for _ in range(r.choice((0, 1, 1, 2, 3))):
        t.change(r, changes)
    path = stem.with_suffix(r.choice(suffixes))
    WRITERS[path.suffix](r, t, path)
    return path


def leaves(node: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths to all members of a document."""
    pairs = (
        node.items()
        if isinstance(node, dict)
        else enumerate(node)
        if isinstance(node, list)
        else ()
    )
    return [p for key, value in pairs for p in ((*path, key), *leaves(value, (*path, key)))]


def signed(folder: Path, calibration: str) -> dict[str, list[str]]:
    """Keys, and documents that are signed or not."""
    key, listed = folder / "lab.key", folder / "keys.json"
    certificate = {
        "schema_version": 1,
        "command": "certificate",
        "serial": "T-1",
        "simulated": True,
    }
    certificate["files"] = [{"id": "run", "name": "in-files.csv", "sha256": "0" * 64}]
    unsigned, document = json.dumps(certificate), folder / "signed.json"
    document.write_text(unsigned, "utf-8")
    for typed in (
        ("key", "create", "-o", key, "--owner", "<b>L\u00e4b</b>"),
        ("key", "trust", listed, f"{key}.pub"),
        ("sign", document, "--private-key", key),
    ):
        ran = cli_support.mwdcal("certificate", *typed)
        assert ran.code == 0, ran
    keys = [path.read_text("utf-8") for path in (key, Path(f"{key}.pub"), listed)]
    return {"key": keys, "signed": [calibration, unsigned, document.read_text("utf-8")]}


def document_file(r: random.Random, sample: str, stem: Path) -> Path:
    """A calibration with some members changed."""
    document = json.loads(sample)
    for _ in range(r.choice((0, 0, 0, 1, 1, 2))):
        *parents, last = r.choice(leaves(document))
        node = document
        for key in parents:
            node = node[key]
        old = node[last]
        if isinstance(old, int | float) and r.random() < 0.6:
            near = max(min(old, 10**300), -(10**300))  # a longer integer is no float
            node[last] = near * r.choice((-1, 0, 2, 1 + 1e-9, 1e6, 1e200))
        elif isinstance(node, dict) and r.random() < 0.3:
            del node[last]
        else:
            odd = (*TEXTS[:-8], *DATES, *SERIALS)
            node[last] = r.choice((None, True, 0, -1, 1e308, 10**400, [], {}, [old], [None], *odd))
    path = stem.with_suffix(".json")
    text = json.dumps(document)
    if r.random() < 0.05:
        text = text.replace("{", '{"method": "x", ' if r.random() < 0.5 else '{"a":' * 2000, 1)
    path.write_text(text, "utf-8", "surrogatepass")
    return path


def toml_file(r: random.Random, sample: str, stem: Path) -> Path:
    """A profile or limits with some lines changed."""
    lines = sample.splitlines()
    for _ in range(r.choice((0, 0, 1, 2))):
        i = r.randrange(len(lines))
        key = lines[i].split("=")[0]
        value = r.choice(
            (
                *NUMBERS,
                *(json.dumps(t) for t in TEXTS[:-8] + DATES + SERIALS),
                "[" * 3000,
                '["+x", "-y", "+z"]',
            )
        )
        lines[i] = r.choice((f"{key} = {value}", "", f"{key} = {value}", f"{lines[i]}\n{lines[i]}"))
    path = stem.with_suffix(".toml")
    path.write_text("\n".join(lines), "utf-8", "surrogatepass")
    return path


# --------------------------------------------------------- bombs: small files that take everything


def toml_bomb(r: random.Random) -> str:
    """Keys of many parts, values of many levels, many keys."""
    many, few = r.choice((30, 3_000, 100_000)), r.choice((2, 20, 21, 200))
    key, short = ".".join(["a"] * many), ".".join(["a"] * few)
    line = r.choice(
        (f"{key} = 1", f"[{key}]", f"x = {{{key} = 1}}", f"x = {'[' * many}", f"x = {'{a=' * many}")
    )
    lines = "\n".join(f"b{i}.{short} = 1" for i in range(900_000 // (2 * few + 12)))
    return r.choice((line, line, lines))


def las_bomb(r: random.Random) -> str:
    """Equal or nearly equal mnemonics, many curves, many values of one wrapped row."""
    entries = "\n".join(
        (
            r.choice(("X. 1 :", f"X{i % 60}. 1 :", " : ", ".M 1 :", f"X:{i}. 1 :", "X..1 :"))
            * r.choice((1, 1, 50))
        )[:1900]
        for i in range(r.choice((60, 3_900, 5_000)))
    )
    if r.random() < 0.5:
        entries = (r.choice(("X. 1 :", " : ", "x .1 :a", "#")) + "\n") * r.choice(
            (60, 3_900, 30_000)
        )
    curves = " DEPT.M :\n" + "".join(f" {n}. :\n" for n in cli_support.RAW)
    sections = [f"~W\n NULL. -999.25 :\n{entries}", f"~C\n{curves}{r.choice(('', entries))}"]
    return "\n".join(
        ["~V\n VERS. 2.0 :\n WRAP. YES :", *sections, "~A", "1 " * r.choice((7, 400_000))]
    )


def trajectory_bomb(r: random.Random) -> str:
    """Encodings, entities, depth, floods of elements and attributes."""
    encoding = r.choice(
        ("utf-7", "utf-16-le", "utf-32", "big5", "idna", "rot13", "UTF-8", "UTF-8", "UTF-8")
    )
    inside = r.choice((
        "<a>" * 150_000, "<a/>" * 200_000, "<a " + " ".join(f'b{i}=""' for i in range(60_000)) + "/>",
        f"<a>{'x' * 900_000}</a>", "<trajectoryStation/>" * 40_000, "",
    ))  # fmt: skip
    types = r.choice(("", "", '<!DOCTYPE a [<!ENTITY b "c">]>'))
    return (
        f'<?xml version="1.0" encoding="{encoding}"?>{types}<trajectorys xmlns="http://www.witsml.org/schemas/1series">'
        f"<trajectory>{inside}</trajectory></trajectorys>"
    )


def workbook_bomb(r: random.Random, path: Path) -> None:
    """Long texts, texts of many parts, and cells that all point to them."""
    openpyxl.Workbook().save(path)
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    text = r.choice((
        "<t>" + "x" * 900_000 + "</t>", "<t>" + "x" * 30_000 + "</t>", "<r><t>x</t></r>" * 2_000_000,
        "<rPr/>" * 3_000_000, "<t>x</t>" * 1_000_000, '<t>x</t><rPh sb="0" eb="1"><t>y</t></rPh>' * 500_000,
    ))  # fmt: skip
    names = "".join(f'<c t="inlineStr"><is><t>{n}</t></is></c>' for n in (*cli_support.RAW, "note"))
    cell = r.choice(('<c t="s"><v>0</v></c>', f'<c t="inlineStr"><is>{text}</is></c>'))
    row = f"<row>{'<c><v>1</v></c>' * 6}{cell}</row>"
    sheet = f"<row>{names}</row>" + row * (2 if "inline" in cell else r.choice((2, 20_000)))
    space = 'xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main"'
    parts["xl/sharedStrings.xml"] = f"<sst {space}><si>{text}</si></sst>".encode()
    parts["xl/worksheets/sheet1.xml"] = (
        f"<worksheet {space}><sheetData>{sheet}</sheetData></worksheet>".encode()
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in parts.items():
            archive.writestr(name, content)


def bomb(r: random.Random, kind: str, stem: Path) -> Path:
    """A file of a kind that is small and takes much of whoever reads it without bounds."""
    if kind not in ("run", "log", "fleet"):
        path, text = stem.with_suffix(".toml"), toml_bomb(r)
    else:
        path = stem.with_suffix(r.choice((".csv", ".las", ".xml", ".xlsx")))
        if path.suffix == ".xlsx":
            workbook_bomb(r, path)
            return path
        header = ",".join(cli_support.RAW)
        text = {
            ".csv": lambda: f"# {toml_bomb(r)[:99_000]}\n{header}\n1,2,3,1,2,3\n",
            ".las": lambda: las_bomb(r),
            ".xml": lambda: trajectory_bomb(r),
        }[path.suffix]()
    path.write_text(text, "utf-8")
    return path


def damaged(r: random.Random, path: Path) -> None:
    """Change bytes of a file, at times."""
    data = bytearray(path.read_bytes())
    if not data or r.random() > 0.05:
        return
    i = r.randrange(len(data))
    kind = r.randrange(4)
    if kind == 0:
        data[i] ^= 1 << r.randrange(8)
    elif kind == 1:
        del data[i:]
    elif kind == 2:
        data[i : i + 64] = bytes(min(64, len(data) - i))
    else:
        data[i:i] = r.randbytes(r.randrange(1, 9))
    path.write_bytes(data)


# ------------------------------------------------------------------------------------ commands

WORDS = {
    "method": ("joint", "least-squares", "newton", "toolface-inclination", "scalar", "swarm"),
    "ignore": ("gravity", "field", "dip", "gravity,field,dip", ","),
    "estimate": ("azimuth-zero", "tilt", "inclination-zero,tilt"),
    "order": ("0", "1", "2", "3", "auto", "1,0", "4"),
    "nonlinearity": ("auto", "none", "accelerometer", "magnetometer,accelerometer"),
    "temperature": ("course", "20", "-300", "nan", "80"),
    "exclude": ("1", "7", "x"),
    "decimal": (".", ".", ".", ",", ";"),
    "columns": ("time_s,ax,ay,az,mx,my,mz", "ax,ay,az", "ax,ax,ax", ","),
    "limits": ("moosavi", "moradi", "x"),
    "error_model": ("owsg-mwd", "none", "x"),
    "tool": (*("servo",) * 12, "generic", "sap6", "x"),
    "prior": ("datasheet",),
    "plan": ("six-state", "moosavi-12", "roll-test", "x"),
    "rolltest": ("roll-test", "acceptance-104", "six-state"),
    "effects": ("none", "x"),
    "repeat": ("1", "3", "20", "0"),
    "workers": ("1",),
    "word_bits": ("32", "24", "16", "11"),
    "day": (*("2026-07-01",) * 20, "2025-01-01", "1950-06-30", *DATES),
    "received": (*("2026-07-01",) * 9, *DATES),
    "crs": (
        "EPSG:23031",
        "EPSG:4326",
        "EPSG:2048",
        "EPSG:22300",
        "EPSG:5773",
        "EPSG:4978",
        "EPSG:1",
    ),
    "field_nt": ("48000", "51000.5", "48"),
    "gravity_g": ("1.0013", "9.81"),
    "serial": (*("T0", "T1", "T9") * 5, *SERIALS),
    "record": ("T0", "T1", "1", "2", "900", "abcdef12"),
    "kind": ("calibration", "run", "tool", "standard", "x"),
    "due": ("2027-01-01", "2026-02-30", "x"),
    "target": ("0001", "0002", "x"),
    "head": ("0" * 64, "x"),
}
"""Values of options that are not read off the command line itself."""
USUAL = {
    "tool": 0.9,
    "notation": 0.6,
    "form": 0.5,
    "output": 0.7,
    "seed": 0.03,
    "decimal": 0.05,
    "report": 0.04,
    "plot": 0.04,
    "repeat": 0.5,
    "database": 0.95,
}
"""Share of command lines that have an option."""
OTHERWISE = 0.08
"""The same, of options not named there."""
REFUSED = {2, 3}
NETWORK = ("scheduler",)
"""Options that are left out: what they name is not a file."""
COMMANDS = {name: c for name, c in cli_support.commands().items() if name != "bench"}
"""All but the server, whose requests and lines `test_bench` makes up."""
WITH_FILES = [n for n, c in COMMANDS.items() if any(p.name in SAMPLES for p in c.params)]
"""Commands that read a file."""
RARE = {"compare": 0.05, "noise": 0.15, "profile": 4.0}
"""How often a command that takes long is run, against the others."""


TABLE_SUFFIXES = (*(".csv",) * 4, ".tsv", ".parquet", ".xlsx", ".las", ".xml")
"""Of runs and logs, the usual one more often."""


def files(r: random.Random, kind: str, sound: dict[str, list[Any]], stem: Path) -> Path:
    """A file of a kind, damaged or not."""
    if kind == "any":
        kinds = ("calibration", "run", "profile", "limits", "verification", "laboratory", "signed")
        some = files(r, r.choice(kinds), sound, stem)
        return Path(str(some).partition("#")[0])
    if r.random() < 0.02 and kind in (
        "run",
        "log",
        "fleet",
        "profile",
        "limits",
        "effects",
        "plan",
        "laboratory",
    ):
        return bomb(r, kind, stem)
    sample = r.choice(sound[kind])
    if kind in ("run", "log"):
        plain = (".txt",) if kind == "log" else ()
        path = table_file(r, sample, stem, TABLE_SUFFIXES + plain)
    elif kind == "fleet":
        path = table_file(r, sample, stem, (".parquet", ".parquet", ".csv", ".xlsx"))
        if r.random() < 0.2:
            return folder_of_runs(r, sound, stem)
    elif kind == "registry":
        path = stem.with_suffix(".sqlite")
        path.write_bytes(sample)
    elif isinstance(sample, bytes):
        path = stem.with_suffix(".parquet")
        path.write_bytes(sample)
        damaged(r, path)
        return Path(f"{path}#{r.choice(('T0', 'T1', 'T2', 'T9', '', '#', ' T0', '../T0'))}")
    else:
        path = (document_file if kind in DOCUMENTS else toml_file)(r, sample, stem)
        path.chmod(0o600)  # as that of a private key must be
    damaged(r, path)
    return path


def folder_of_runs(r: random.Random, sound: dict[str, list[Any]], folder: Path) -> Path:
    """A folder with run files, damaged or not, and a file that is none."""
    folder.mkdir()
    for place in range(r.choice((1, 2, 3))):
        files(r, r.choice(("run", "run", "fleet")), sound, folder / f"{place}")
    (folder / "notes.txt").write_text("not a run")
    return folder


def occupy(r: random.Random, path: Path, sound: dict[str, list[Any]]) -> None:
    """Put something where an output will be written: a file of any kind, a folder, a link."""
    kind = r.choice(("file", "file", "file", "empty", "read-only", "folder", "link", "dangling"))
    if kind == "folder":
        path.mkdir()
    elif kind in ("link", "dangling"):
        elsewhere = path.with_name(f"out-elsewhere{path.suffix}")
        path.symlink_to(elsewhere)
        if kind == "link":
            elsewhere.write_text("kept", "utf-8")
    else:
        sample = r.choice(
            [each for some in sound.values() for each in some if isinstance(each, str | bytes)]
        )
        data = sample.encode() if isinstance(sample, str) else sample
        path.write_bytes(b"" if kind == "empty" else data)
        path.chmod(0o444 if kind == "read-only" else 0o644)


def value(r: random.Random, p: click.Parameter, sound: dict[str, list[Any]], folder: Path) -> str:
    """A value of an argument or option."""
    name = str(p.name)
    metavar = str(getattr(p, "metavar", "") or "")
    if name == "folder" and metavar == "[DIR]":
        path = folder / "out-folder"
        path.mkdir(exist_ok=True)
        return str(path)
    if name in OUTPUTS:
        suffixes = re.findall(r"\.\w+", metavar) or sorted({*TABLE_SUFFIXES})
        path = folder / f"out-{name}{r.choice(suffixes)}"
        if r.random() < 0.1:
            occupy(r, path, sound)
        return str(path)
    if name == "database" and r.random() < 0.2:
        return str(folder / "out-database.sqlite")
    if name in SAMPLES and (name not in WORDS or r.random() < 0.3):
        return str(files(r, SAMPLES[name], sound, folder / f"in-{name}"))
    if isinstance(p.type, click.Choice):
        return str(r.choice(p.type.choices))
    if (
        isinstance(p.type, click.types.FloatParamType | click.types.IntParamType)
        and name not in WORDS
    ):
        return r.choice((*("1", "0.5", "3", "10", "50") * 15, *NUMBERS))
    words = WORDS.get(name) or tuple(w for w in metavar.split("|") if w.islower())
    return r.choice(words) if words and r.random() < 0.98 else r.choice(TEXTS).replace("\x00", "")


def command(r: random.Random, name: str, sound: dict[str, list[Any]], folder: Path) -> list[str]:
    """A command line."""
    line = name.split()
    for p in COMMANDS[name].params:
        usual = USUAL.get(str(p.name), OTHERWISE)
        if isinstance(p, click.Argument):
            line.append(value(r, p, sound, folder))
        elif p.name not in NETWORK and (p.required or p.name == "workers" or r.random() < usual):
            line.append(p.opts[-1] if p.opts[-1].startswith("--") else p.opts[0])
            if not getattr(p, "is_flag", False):
                line.append(value(r, p, sound, folder))
    return line


# ------------------------------------------------------------------------------------ promises


class Hang(BaseException):
    """A command took too long."""


def _hang(*_: object) -> None:
    raise Hang


@contextlib.contextmanager
def limited():
    """Interrupt a command that hangs."""
    if hasattr(signal, "SIGALRM"):
        signal.signal(signal.SIGALRM, _hang)
        signal.alarm(12 * LONGEST_SECONDS)
    try:
        yield
    finally:
        if hasattr(signal, "SIGALRM"):
            signal.alarm(0)


def memory(kind: str) -> int:
    """Bytes of memory that the process holds ("RSS") or has held at most ("HWM"); 0 where it cannot be known."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    return sum(int(line.split()[1]) * 1024 for line in lines if line.startswith(f"Vm{kind}:"))


def forget_peak() -> None:
    """Begin the highest memory anew (Linux)."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def not_a_number(name: str) -> None:
    raise ValueError(f"{name} in JSON")


def strict(text: str) -> Any:
    """JSON without NaN and infinity."""
    return json.loads(text, parse_constant=not_a_number)


def finite_columns(path: Path) -> list[str]:
    """Columns of a Parquet table with numbers that are not finite."""
    columns = pq.read_table(path)
    floats = [n for n in columns.column_names if pa.types.is_floating(columns[n].type)]
    return [
        n for n in floats if not all(math.isfinite(x) for x in columns[n].drop_null().to_pylist())
    ]


def readable(line: list[str], path: Path) -> list[str]:
    """What is wrong with a file that a command has written."""
    if line[0] == "registry":  # documents under any name
        return []
    if path.suffix == ".json" and line[0] == "calibrate":
        mwdcal.load(path)
    if path.suffix == ".json":
        strict(path.read_text("utf-8"))
    elif path.suffix == ".html":
        return ["unescaped text"] if "<script>alert" in path.read_text("utf-8") else []
    elif path.suffix == ".parquet" and line[0] == "fleet":
        return [f"not finite: {name}" for name in finite_columns(path)]
    elif path.suffix == ".xml" and line[0] == "certificate":
        ElementTree.parse(path)
    elif path.suffix in WRITERS:
        table.read(path)
    return []


def contents(folder: Path) -> dict[Path, bytes | None]:
    """What there is in a folder: files with their bytes, of those that a command may write."""
    return {
        path: path.read_bytes() if path.is_file() and path.name.startswith("out-") else None
        for path in folder.rglob("*")
    }


def promises(
    line: list[str], ran: cli_support.Ran, folder: Path, before: dict[Path, bytes | None]
) -> list[str]:
    """What of the promises to every command is not kept."""
    broken = []
    after = contents(folder)
    lost = before.keys() - after.keys()
    broken += [f"lost: {sorted(p.name for p in lost)}"] if lost else []
    journals = ("-wal", "-shm")  # which SQLite leaves beside a database that is damaged
    written = {
        p
        for p, data in after.items()
        if (p not in before or data != before[p]) and not p.name.endswith(journals)
    }
    named = {p for p in written if p.relative_to(folder).parts[0].startswith("out-")}
    shown = {
        p for p in named if p.name.startswith(("out-plot", "out-report"))
    }  # of a refused log too
    if ran.code not in (
        {0, 1, 2, 3}
        if line[0] in ("diagnose", "verify") or line[1:2] in (["verify"], ["check"])
        else {0, 2, 3}
    ):
        broken.append(f"exit {ran.code}")
    if written - named:
        broken.append(f"left behind: {sorted(p.name for p in written - named)}")
    if ran.code in REFUSED and line[0] not in ("fleet", "compare"):
        if len(ran.messages) != 1 or len(ran.err) > 5000:
            broken.append(f"{len(ran.messages)} messages, {len(ran.err)} characters")
        if ran.out.strip():
            broken.append("refused, and a result on stdout")
        if named - (shown if line[0] == "stations" else set()):
            broken.append(f"refused, and written: {sorted(p.name for p in named)}")
    if re.search(r"Traceback|Warning:|<class |array\(", ran.err):
        broken.append("a message of Python's")
    if ran.code in (0, 1):
        if "--json" in line:
            strict(ran.out)
        broken += [
            fault for path in sorted(named) if path.is_file() for fault in readable(line, path)
        ]
    return broken


def laboratory_case(r: random.Random, folder: Path) -> tuple[list[str], bool]:
    """The command line that proposes a profile for a laboratory's table; whether it has a magnetometer."""
    path, magnetic = laboratory_table(r, folder / "in-run")
    damaged(r, path)
    line = ["profile", str(path), "-o", str(folder / "out-output.toml")]
    answers = (
        "--decimal",
        ",",
        "--serial",
        "T-1",
        "--north",
        "true",
        "--header-row",
        "2",
        "--column",
        "ref_dip_deg=",
        "--leave-out",
        "Comment=bad",
        "--keep",
        "Remarks=see logbook",
    )
    for place in range(0, len(answers), 2):
        line += answers[place : place + 2] if r.random() < 0.1 else ()
    return line, magnetic


def calibrated_by(line: list[str], magnetic: bool, folder: Path) -> list[str]:
    """Promises broken by a calibration of a laboratory's table by the profile proposed for it."""
    before, output = contents(folder), folder / "out-cal.json"
    following = ["calibrate", line[1], "--tool", line[3], "-o", str(output)]
    ran = cli_support.mwdcal(*following)
    broken = promises(following, ran, folder, before)
    if ran.code == 0 and magnetic and mwdcal.load(output).magnetometer is None:
        broken.append("the magnetometer was lost")
    return broken


def case(
    seed: int, sound: dict[str, list[Any]], folder: Path, only: str = ""
) -> tuple[str, int, list[str]]:
    """Run a case: its command, exit code, and the promises it breaks."""
    r = random.Random(seed)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    (name,) = r.choices(WITH_FILES, [RARE.get(n, 1.0) for n in WITH_FILES])
    name = only or name
    from_laboratory = name == "profile" and r.random() < 0.8
    magnetic = False
    if from_laboratory:
        line, magnetic = laboratory_case(r, folder)
    else:
        line = command(r, name, sound, folder)
    if r.random() < 0.1:
        damaged(r, toml_file(r, r.choice(SETTINGS), folder / "mwdcal"))
    (folder / "command").write_text(json.dumps(line))
    before = contents(folder)
    forget_peak()
    held, start, code, broken = memory("RSS"), time.process_time(), -1, []
    with warnings.catch_warnings(record=True) as warned, limited():
        warnings.simplefilter("always")
        try:
            ran = cli_support.mwdcal(*line)
            code = ran.code
            broken = promises(line, ran, folder, before)
            if from_laboratory and code == 0 and not broken:
                broken = calibrated_by(line, magnetic, folder)
            elif code == 0 and not broken and r.random() < 0.03:
                broken = repeated(line, folder)
        except Hang:
            broken = ["interrupted as too slow"]
        except Exception:
            broken = [traceback.format_exc()]
    seconds = time.process_time() - start
    if seconds > LONGEST_SECONDS:
        broken.append(f"{seconds:.0f} s")
    taken = memory("HWM") - held
    if taken > MOST_MEMORY:
        broken.append(f"{taken / 1e9:.2f} GB")
    broken += [
        f"{w.category.__name__}: {w.message}" for w in warned if not issubclass(w.category, QUIET)
    ]
    return line[0], code, broken


def repeated(line: list[str], folder: Path) -> list[str]:
    """Outputs that a second run writes otherwise; times apart."""

    def written() -> dict[str, bytes]:
        paths = (
            p for stem in folder.glob("out-*") for p in (stem, *stem.rglob("*")) if p.is_file()
        )
        return {
            p.name: re.sub(
                rb'"(time|sha256)": *"[^"]*"|\d{4}-\d\d-\d\d[T ][\d:.+]*', b"", p.read_bytes()
            )
            for p in paths
        }

    first = written()
    cli_support.mwdcal(*line)
    again = written()
    return [f"differs when repeated: {name}" for name in first if first[name] != again.get(name)]


# ------------------------------------------------------------------------------------- running


def work(seeds: range, until: float, keep: bool, only: str = "") -> tuple[Counter[str], list[str]]:
    """Run cases until a time: how they ended, and what was found."""
    counts: Counter[str] = Counter()
    findings = []
    with tempfile.TemporaryDirectory() as place:
        sound = samples(Path(place))
        for seed in seeds:
            if time.time() > until:
                break
            name, code, broken = case(seed, sound, Path(place) / "case", only)
            counts[f"{name} {code}"] += 1
            if broken:
                findings.append(f"seed {seed} {name}: " + "; ".join(broken))
            if broken or keep:
                kept = Path("build/fuzz") / str(seed)
                shutil.rmtree(kept, ignore_errors=True)
                shutil.copytree(Path(place) / "case", kept)
    return counts, findings


def main() -> int:
    """Print what was found; exit 1 if there was anything."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="0:1000", help="first:last, the last apart")
    parser.add_argument("--minutes", type=float, default=10.0, help="stop after so long")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--keep", action="store_true", help="keep the files of sound cases as well")
    parser.add_argument("--only", default="", help="one command, such as profile")
    given = parser.parse_args()
    first, last = map(int, given.seeds.split(":"))
    until = time.time() + 60 * given.minutes
    shares = [
        (range(first + k, last, given.jobs), until, given.keep, given.only)
        for k in range(given.jobs)
    ]
    if given.jobs == 1:
        results = [work(*shares[0])]
    else:
        with multiprocessing.get_context("spawn").Pool(given.jobs) as pool:
            results = pool.starmap(work, shares)
    counts = sum((c for c, _ in results), Counter())
    findings = [f for _, found in results for f in found]
    print("\n".join(findings))
    print(", ".join(f"{name}: {n}" for name, n in sorted(counts.items())))
    print(f"{counts.total()} cases, {len(findings)} findings; their files are in build/fuzz")
    return bool(findings)


if __name__ == "__main__":
    sys.exit(main())
