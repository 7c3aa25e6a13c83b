"""A release as its users install it: `python tests/release.py WHEEL PYTHON...`.

For each interpreter the wheel goes into empty environments: alone, with the bench, with all extras in the newest
versions, and with all extras in the lowest versions that have wheels for this interpreter. In each the validation of
the installation must say PASS. Alone the example must run, with the bench its page must come, with all extras every
line of the README and its lines of Python must run. Needs uv.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import tempfile
import urllib.request
from pathlib import Path

from oldest_versions import declared, lowest
from page_lines import ROOT, follow_each_other, lines_of

EXAMPLE = (
    "example demo",
    "calibrate demo/run.csv --tool demo/tool.toml -o tool.json",
    "verify tool.json demo/rolltest.csv",
)
"""The lines that `make demo` shows, without its page."""
ARRAYS = """
import numpy as np

def table(name):
    return np.genfromtxt(f"demo/{name}.csv", delimiter=",", skip_header=4, names=True)

def channels(rows):
    a, m = (np.stack([rows[f"{kind}{axis}"] for axis in "xyz"], -1) for kind in "am")
    return a / 3.0, m / 5e-5  # the nominal scales of the tool profile

def angles(rows):
    return (rows[f"ref_{name}_deg"] for name in ("inclination", "azimuth", "toolface"))

rows = table("run")
(a, m), (inc, azi, tf) = channels(rows), angles(rows)
"""
"""The arrays that the README's lines of Python begin with, from the example; then a survey and a roll test."""
READINGS = """
rows = table("rolltest")
(a, m), (inc, azi, tf) = channels(rows), angles(rows)
rolltest = mwdcal.readings(a, m, inclination_deg=inc, azimuth_deg=azi, toolface_deg=tf)
survey = mwdcal.readings(*channels(table("surveys")))
"""


def output(*command: str | Path, folder: Path) -> str:
    """The output of a command; a failure ends the run with its message."""
    options = {"cwd": folder, "capture_output": True, "encoding": "utf-8"}
    done = subprocess.run([*map(str, command)], check=False, **options)
    if done.returncode:
        sys.exit(f"{shlex.join(map(str, command))}\n{done.stdout}{done.stderr}")
    return done.stdout


def install(python: str, folder: Path, what: str, *options: str) -> Path:
    """The interpreter of a new environment in which `what` is installed."""
    output("uv", "venv", "--quiet", "--python", python, "env", folder=folder)
    place = folder / "env" / "bin" / "python"
    output("uv", "pip", "install", "--quiet", "--python", place, *options, what, folder=folder)
    return place


def validated(python: Path, folder: Path) -> str:
    """First line of the validation of an installation, which must pass."""
    return output(python, "-m", "mwdcal.selftest", folder=folder).splitlines()[0]


def readme(python: Path, folder: Path) -> int:
    """Run each line of the README and compare what it shows; the number of lines."""
    runs = lines_of("README.md")
    for line, shown in runs:
        text = output(python, "-m", "mwdcal", *shlex.split(line), folder=folder)
        printed = "\n".join(map(str.rstrip, text.splitlines()))
        if shown and not follow_each_other(shown, printed):
            sys.exit(f"mwdcal {line}\nprints, other than the README says:\n{printed}")
    return len(runs)


def snippet(python: Path, folder: Path) -> None:
    """Run the README's lines of Python on the arrays of the example, whose roll test must pass."""
    text = (ROOT / "README.md").read_text("utf-8")
    first, *others = re.search(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)[1].split(
        "\n\n", 1
    )
    lines = "".join(others).rstrip().splitlines()
    program = "\n".join([first, ARRAYS, lines[0], READINGS, *lines[1:-1], f"assert {lines[-1]}"])
    output(python, "-c", program, folder=folder)


def bench(python: Path, folder: Path) -> None:
    """Start the README's bench on the simulated tool, and ask for its page."""
    command = [str(python), "-m", "mwdcal", "bench", "--demo", "--no-browser"]
    with subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, encoding="utf-8"
    ) as process:
        try:
            address = process.stdout.readline().strip()
            visitor = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
            with visitor.open(address, timeout=60) as page:
                shown = page.read().decode()
        finally:
            process.terminate()
    if "Start" not in shown:
        sys.exit(f"mwdcal bench --demo shows:\n{shown}")


def main(wheel: Path, pythons: list[str]) -> None:
    """Print a line for each environment."""
    with_extra = "mwdcal[{}] @ " + wheel.resolve().as_uri()
    for python in pythons:
        for kind in ("alone", "bench", "newest", "lowest"):
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                if kind == "alone":
                    place = install(python, folder, str(wheel.resolve()))
                    for line in EXAMPLE:
                        output(place, "-m", "mwdcal", *line.split(), folder=folder)
                    ran = "example"
                elif kind == "bench":
                    place = install(python, folder, with_extra.format("bench"))
                    bench(place, folder)
                    ran = "the page of the bench"
                else:
                    least = [each.replace("==", ">=") for each in lowest(declared())]
                    options = ["--resolution", "lowest-direct", "--only-binary", ":all:", *least]
                    options = options if kind == "lowest" else []
                    place = install(python, folder, with_extra.format("all"), *options)
                    ran = f"{readme(place, folder)} lines of the README, and its Python"
                    snippet(place, folder)
                version = output(place, "-V", folder=folder).strip()
                print(f"{version}, {kind}: {validated(place, folder)}; {ran}", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
