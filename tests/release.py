"""A release as its users install it: `python tests/release.py WHEEL PYTHON...`.

For each interpreter the wheel goes into empty environments: alone, with all extras in the newest versions, and with all
extras in the lowest versions that have wheels for this interpreter. In each the validation of the installation must say
PASS; alone the example must run, with all extras every line of the README. Needs uv.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

from oldest_versions import declared, lowest
from page_lines import follow_each_other, lines_of

EXAMPLE = (
    "example demo",
    "calibrate demo/run.csv --tool demo/tool.toml -o tool.json",
    "verify tool.json demo/rolltest.csv",
)
"""The lines that `make demo` shows, without its page."""


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


def main(wheel: Path, pythons: list[str]) -> None:
    """Print a line for each environment."""
    everything = f"mwdcal[all] @ {wheel.resolve().as_uri()}"
    for python in pythons:
        for kind in ("alone", "newest", "lowest"):
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                if kind == "alone":
                    place = install(python, folder, str(wheel.resolve()))
                    for line in EXAMPLE:
                        output(place, "-m", "mwdcal", *line.split(), folder=folder)
                    ran = "example"
                else:
                    least = [each.replace("==", ">=") for each in lowest(declared())]
                    options = ["--resolution", "lowest-direct", "--only-binary", ":all:", *least]
                    options = options if kind == "lowest" else []
                    place = install(python, folder, everything, *options)
                    ran = f"{readme(place, folder)} lines of the README"
                version = output(place, "-V", folder=folder).strip()
                print(f"{version}, {kind}: {validated(place, folder)}; {ran}", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
