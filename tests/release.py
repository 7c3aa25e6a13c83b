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
TABLES = """
import shutil
import sys
import types
import numpy as np

class Table(dict):
    def assign(self, **more):
        return Table(self, **more)

def read_csv(path):
    rows = np.genfromtxt(path, delimiter=",", names=True)
    return Table({name: rows[name] for name in rows.dtype.names})

try:
    import pandas
except ImportError:
    sys.modules["pandas"] = types.SimpleNamespace(read_csv=read_csv)
with open("demo/run.csv") as run, open("cal.csv", "w") as table:
    table.writelines(line for line in run if not line.startswith("#"))
shutil.copy("demo/rolltest.csv", "rolltest.csv")
"""
"""The tables that the README's lines of Python speak of, from the example; what of pandas they need."""


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
    """Run the README's lines of Python on the tables of the example, whose roll test must pass."""
    text = (ROOT / "README.md").read_text("utf-8")
    code = re.search(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)[1]
    *lines, last = code.rstrip().splitlines()
    output(python, "-c", "\n".join([TABLES, *lines, f"assert {last}"]), folder=folder)


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
