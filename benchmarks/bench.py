"""Times the commands against a bare import of SciPy, interleaved in one run.

The ratio to the import is what to watch: it hardly depends on the machine.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).resolve().parents[1]
MWDCAL = Path(sys.executable).with_name("mwdcal")
EXAMPLE = ROOT / "examples" / "servo"
REPEATS = 7
REFERENCE = "import scipy.optimize"


def cases(folder: Path) -> dict[str, list[str]]:
    """The commands to time, by the name in the table; the reference comes first."""
    calibrate = [
        *(str(MWDCAL), "calibrate", str(EXAMPLE / "run.csv")),
        *("--tool", str(EXAMPLE / "tool.toml"), "-o", str(folder / "tool.json")),
    ]
    return {
        REFERENCE: [sys.executable, "-c", "import numpy, scipy.optimize"],
        "mwdcal --help": [str(MWDCAL), "--help"],
        "mwdcal calibrate": calibrate,
    }


def seconds(command: list[str]) -> float:
    """Wall time of one run of a command; stops the benchmark when it fails."""
    start = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    elapsed = time.perf_counter() - start
    if done.returncode != 0:
        sys.exit(f"{' '.join(command)} ended with {done.returncode}:\n{done.stderr.strip()}")
    return elapsed


def medians(commands: dict[str, list[str]]) -> dict[str, float]:
    """Median wall time per command over interleaved rounds, after one unmeasured round."""
    rounds = [
        {name: seconds(command) for name, command in commands.items()} for _ in range(REPEATS + 1)
    ]
    return {name: statistics.median(r[name] for r in rounds[1:]) for name in commands}


def main() -> None:
    with TemporaryDirectory() as folder:
        times = medians(cases(Path(folder)))
    print(f"{'command':<24}{'median s':>10}{'ratio':>8}   ({REPEATS} rounds, interleaved)")
    for name, value in times.items():
        print(f"{name:<24}{value:>10.3f}{value / times[REFERENCE]:>8.2f}")


if __name__ == "__main__":
    main()
