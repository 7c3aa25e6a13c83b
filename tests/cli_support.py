"""Running the command line in process, and run files made by an independent forward model."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np

from mwdcal.app import cli, messages
from simulation import DEG, Tool, plan

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "examples" / "servo"
RAW = ("ax", "ay", "az", "mx", "my", "mz")
SCALE = (3.0, 5e-5)
"""Nominal scales of the shipped profile `servo`: V per g, V per nT."""
SERVO_NOISE = (1e-4, 15.0)


messages.LINE_AFTER = 3600.0  # what a command says does not depend on how fast the machine is


@dataclass(frozen=True)
class Ran:
    """What a command left: exit code, stdout, stderr."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        return json.loads(self.out)

    @property
    def messages(self) -> list[str]:
        """The messages that end a command: ours, or those of the option parser."""
        return [s for s in self.err.splitlines() if s.startswith(("mwdcal: ", "Error: "))]


def commands(group: click.Group = cli.cli, *before: str) -> dict[str, click.Command]:
    """Every command that runs something, by the words that call it; a default by those of its group."""
    found: dict[str, click.Command] = {}
    for name in sorted(group.commands):
        command = group.commands[name]
        words = before if name == getattr(group, "default", None) else (*before, name)
        inner = isinstance(command, click.Group)
        found |= commands(command, *words) if inner else {" ".join(words): command}
    return found


def called(typed: Sequence[object]) -> str:
    """The name in `commands` of what a command line calls."""
    names = (" ".join(map(str, typed[:count])) for count in (3, 2, 1))
    return next(name for name in names if name in commands())


def mwdcal(*arguments: object) -> Ran:
    """Run the command line in this process."""
    out, err = io.StringIO(), io.StringIO()
    code = 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            cli.main([str(a) for a in arguments])
        except SystemExit as stop:
            code = int(stop.code or 0)
    return Ran(code, out.getvalue(), err.getvalue())


def process(*arguments: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run the command line as its own process."""
    command = [
        sys.executable,
        "-c",
        "from mwdcal.app.cli import main; main()",
        *map(str, arguments),
    ]
    return subprocess.run(command, capture_output=True, encoding="utf-8", check=False, **options)


def refused(ran: Ran, *codes: int) -> str:
    """The one message of a refusal, checked for what must never be met."""
    assert ran.code in codes, ran
    assert ran.out == ""
    assert len(ran.messages) == 1, ran.err
    (message,) = ran.messages
    told = ran.err.replace("got nan", "").replace("got 'nan'", "").replace("= ['nan']", "")
    for word in ("Traceback", "Warning", "internal error", "nan", "array("):
        assert word not in told, ran.err
    assert 30 < len(message) < 1000
    return message


def stations(inc, azi, tool, *, earth=(1.0, 50_000.0, 65.0), **columns):
    """Reference columns of a run at attitudes in radians."""
    angles = {"inclination": inc, "azimuth": azi, "toolface": tool}
    references = {f"ref_{name}_deg": np.degrees(value) for name, value in angles.items()}
    names = ("ref_gravity_g", "ref_field_nt", "ref_dip_deg")
    constants = {n: np.full(len(inc), v) for n, v in zip(names, earth, strict=True)}
    return {"station": np.arange(1, len(inc) + 1), **columns, **references, **constants}


def channels(g, b):
    """Raw channel columns of tool vectors, along the tool axes at the servo's scales."""
    raw = np.concatenate([g * SCALE[0], b * SCALE[1]], -1)
    return dict(zip(RAW, raw.T, strict=True))


def servo_run(seed=1, inclinations=(5, 45, 90, 135), toolfaces=12, temperatures=(25.0,), tool=None):
    """Columns of a sound run of a servo tool: every attitude at every temperature."""
    tool = tool or Tool.random(seed, noise=SERVO_NOISE)
    inc, azi, face = plan(inclinations, toolfaces)
    rng = np.random.default_rng(seed + 1000)
    soaks = len(temperatures)
    inc, azi, face = (np.tile(a, soaks) for a in (inc, azi, face))
    g, b = (v[0] for v in tool.readings(rng, 1, inc, azi, face))
    warmth = np.repeat(np.asarray(temperatures, float), len(inc) // soaks)
    earth = (tool.gravity, tool.field, tool.dip / DEG)
    columns = stations(inc, azi, face, earth=earth, temperature_c=warmth)
    return {**columns, **channels(g, b)}


def cell(value: object) -> str:
    if isinstance(value, str):
        return value
    return "" if np.isnan(value) else repr(value.item() if hasattr(value, "item") else value)


def cells(column):
    """The same of a whole column."""
    if isinstance(column, np.ndarray) and column.dtype.kind == "f":
        return ["" if value != value else repr(value) for value in column.tolist()]
    return [cell(value) for value in column]


def write_csv(path: Path, columns: dict[str, Any], *metadata: str, delimiter: str = ",") -> Path:
    """A run file by a writer that is not the package's own."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        stream.writelines(f"# {line}\n" for line in metadata)
        writer = csv.writer(stream, delimiter=delimiter, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*map(cells, columns.values()), strict=True))
    return path


def read_csv(path: Path) -> dict[str, list[str]]:
    """Columns of text by the standard library, metadata lines left out."""
    lines = [s for s in path.read_text("utf-8").splitlines() if not s.startswith("#")]
    rows = list(csv.reader(lines))
    return {name: [row[i] for row in rows[1:]] for i, name in enumerate(rows[0])}


def numbers(cells: list[str]) -> np.ndarray:
    return np.array([float(c) if c else np.nan for c in cells])


def calibrated(
    folder: Path, columns: dict[str, Any], *options: object, tool: object = "servo"
) -> Path:
    """The calibration file of a run that must succeed."""
    run = write_csv(folder / "run.csv", columns)
    ran = mwdcal("calibrate", run, "--tool", tool, "-o", folder / "cal.json", *options)
    assert ran.code == 0, ran
    return folder / "cal.json"
