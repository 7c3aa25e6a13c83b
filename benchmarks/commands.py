"""Times the commands against a bare import of SciPy: what a user waits for on every call."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from measuring import Row, medians

ROOT = Path(__file__).resolve().parents[1]
MWDCAL = Path(sys.executable).with_name("mwdcal")
EXAMPLE = ROOT / "examples" / "servo"
REFERENCE = "import numpy, scipy.special"


def cases(folder: Path) -> dict[str, list[str]]:
    """The commands to time, by the name in the table; the reference comes first."""
    calibrate = [
        *(str(MWDCAL), "calibrate", str(EXAMPLE / "run.csv")),
        *("--tool", str(EXAMPLE / "tool.toml"), "-o", str(folder / "tool.json")),
    ]
    return {
        REFERENCE: [sys.executable, "-c", REFERENCE],
        "mwdcal --help": [str(MWDCAL), "--help"],
        "mwdcal calibrate, 48 stations, 24 parameters": calibrate,
    }


def run(command: list[str]) -> None:
    """Run a command; stops the benchmark when it fails."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        sys.exit(f"{' '.join(command)} ended with {done.returncode}:\n{done.stderr.strip()}")


def rows() -> list[Row]:
    """Each command against the import."""
    with TemporaryDirectory() as folder:
        calls: dict[str, Callable[[], object]] = {
            name: partial(run, command) for name, command in cases(Path(folder)).items()
        }
        times = medians(calls)
    theirs = times.pop(REFERENCE)
    return [Row(f"{n}; {REFERENCE}", ours, theirs, theirs / ours) for n, ours in times.items()]
