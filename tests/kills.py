"""Commands that are ended at random moments: what they leave, and what the next one makes of it.

    python tests/kills.py --count 1000 --seed 1 --commands calibrate,apply,stations,fleet

An output must be the old file or the new one, whole; a fleet's next run must give the table of an
undisturbed one, byte for byte; only a KILL may leave hidden files, which the next run removes.
"""

from __future__ import annotations

import argparse
import collections
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cli_support import EXAMPLE, channels, read_csv, servo_run, write_csv
from simulation import Tool, plan
from test_fleet import many

ROOT = Path(__file__).resolve().parents[1]
SIGNALS = ("SIGKILL", "SIGTERM", "SIGHUP", "SIGINT")
OLD = b"the old file\n"
LONGEST = 120.0
"""Seconds in which a command, ended or not, must be over."""
MWDCAL = (sys.executable, "-m", "mwdcal")


@dataclass(frozen=True)
class Case:
    """A command, its output, what the output is when nobody disturbs it, and how long that takes."""

    name: str
    arguments: tuple[object, ...]
    output: str
    expected: bytes = b""
    seconds: float = 0.0


def without_time(data: bytes) -> bytes:
    """The bytes of an output with its time fields blanked."""
    return re.sub(rb'(_?time"?[: =]+")[^"]*"', rb'\1"', data)


def standstills(path: Path, count: int = 60) -> Path:
    """A log of a tool that stands still at many attitudes, and turns in between."""
    rng = np.random.default_rng(4)
    tool = Tool.random(4, noise=(1e-4, 15.0))
    inc, azi, face = (each[:count] for each in plan((10, 60, 90, 130), 15))
    g, b = (vectors[0] for vectors in tool.readings(rng, 1, inc, azi, face))
    raw = channels(g, b)
    still, turning = 200, 60
    place = np.concatenate(
        [[*np.full(still, i), *np.linspace(i, i + 1, turning)] for i in range(count - 1)]
    )
    columns = {"time_s": np.arange(len(place)) / 20}
    for name, values in raw.items():
        noise = rng.normal(0, 3e-4, len(place))
        columns[name] = np.interp(place, np.arange(count), values) + noise
    return write_csv(path, columns)


def cases(folder: Path, names: list[str]) -> list[Case]:
    """The commands, with inputs made in `folder`."""
    tool = EXAMPLE / "tool.toml"
    run, readings, log, fleet = (
        folder / n for n in ("run.csv", "log.csv", "still.csv", "runs.parquet")
    )
    cal = folder / "tool.json"
    write_csv(run, servo_run(1))
    rows = {n: np.tile(np.array(v, float), 700) for n, v in read_csv(run).items() if n[0] in "amt"}
    write_csv(readings, rows)
    standstills(log)
    many(fleet)
    subprocess.run(
        [*MWDCAL, "calibrate", run, "--tool", tool, "-o", cal], check=True, capture_output=True
    )
    every = (
        Case("calibrate", ("calibrate", run, "--tool", tool, "-o"), "cal.json"),
        Case("apply", ("apply", cal, readings, "-o"), "out.csv"),
        Case("stations", ("stations", log, "-o"), "stations.csv"),
        Case("fleet", ("fleet", fleet, "--tool", "servo", "--workers", 2, "-o"), "cals.parquet"),
    )
    return [undisturbed(case, folder) for case in every if case.name in names]


def undisturbed(case: Case, folder: Path) -> Case:
    """The case with its output and its time, the second of two runs."""
    for _ in range(2):
        begun = time.perf_counter()
        code, _, error = finished(started(case, folder))
        assert code == 0, error
        seconds = time.perf_counter() - begun
    data = (folder / case.output).read_bytes()
    (folder / case.output).unlink()
    return Case(case.name, case.arguments, case.output, without_time(data), seconds)


def started(case: Case, folder: Path) -> subprocess.Popen[str]:
    """The command as the leader of a session of its own."""
    command = [*MWDCAL, *map(str, case.arguments), str(folder / case.output)]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )


def finished(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Exit status and words of a command."""
    try:
        out, error = process.communicate(timeout=LONGEST)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        out, error = process.communicate()
        return 999, out, f"{error}\nhung for {LONGEST:g} s"
    return process.returncode, out, error


def alive(session: int) -> bool:
    """Whether a process of a session lives, ten seconds later at the latest."""
    limit = time.monotonic() + 10
    while time.monotonic() < limit:
        listed = subprocess.run(
            ["ps", "-A", "-o", "sess=,stat="], capture_output=True, text=True, check=True
        )
        rows = [line.split() for line in listed.stdout.splitlines()]
        if not any(name == str(session) and state[0] != "Z" for name, state in rows):
            return False
        time.sleep(0.1)
    return True


def hidden(folder: Path) -> list[str]:
    """What commands may leave only when they are killed."""
    odd = [
        *folder.glob(".mwdcal-*"),
        *folder.glob("*.parts/.mwdcal-*"),
        *folder.glob("*.parts/*.tmp"),
    ]
    return sorted(str(each.relative_to(folder)) for each in odd)


def disturbed(
    case: Case, folder: Path, name: str, delay: float, old: bool
) -> tuple[str, list[str]]:
    """One command that gets a signal: how it ended, and what is wrong."""
    output, number = folder / case.output, getattr(signal, name)
    if old:
        output.write_bytes(OLD)
    process = started(case, folder)
    time.sleep(delay)
    try:
        if name == "SIGINT":
            os.killpg(process.pid, number)  # as a terminal does
        else:
            process.send_signal(number)
    except ProcessLookupError:
        pass  # it is over
    code, _, error = finished(process)
    wrong = ["a process is left"] if alive(process.pid) else []
    content = output.read_bytes() if output.exists() else None
    before = OLD if old else None
    new = content is not None and without_time(content) == case.expected
    if content != before and not new:
        wrong.append("the output is neither the old nor the new one")
    if code == 0 and not new:
        wrong.append("status 0 without the new output")
    starting = ("init_import_site", "Could not import runpy")  # Python itself was not ready
    unready = code == 1 and any(words in error for words in starting)
    early = (code == -number or unready) and name != "SIGKILL"
    if not early and code not in (0, -number if name == "SIGKILL" else 128 + number):
        wrong.append(f"status {code}: {error[-300:]!r}")
    # a process that workers are copied from says so where it is left behind
    orphan = name == "SIGKILL" and "multiprocessing/forkserver.py" in error
    if "Traceback" in error and not early and not orphan:
        wrong.append(f"a traceback: {error[-2000:]!r}")
    if hidden(folder) and name != "SIGKILL":
        wrong.append(f"left {hidden(folder)}")
    kind = "done" if code == 0 else "before it could say so" if early else f"status {code}"
    return kind, wrong


def rerun(case: Case, folder: Path) -> list[str]:
    """The same command again, undisturbed: what is wrong with what it makes."""
    code, _, error = finished(started(case, folder))
    output = folder / case.output
    wrong = [f"the next run ends with {code}: {error[-300:]!r}"] if code else []
    if not output.exists() or without_time(output.read_bytes()) != case.expected:
        wrong.append("the next run gives another output")
    left = [*hidden(folder), *(each.name for each in folder.glob("*.parts"))]
    if left:
        wrong.append(f"the next run leaves {left}")
    return wrong


def main() -> int:
    """Run, and print what was counted."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--commands", default="calibrate,apply,stations,fleet")
    given = parser.parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
    os.environ["PYTHONPATH"] = os.pathsep.join(
        [str(ROOT / "src"), os.environ.get("PYTHONPATH", "")]
    )
    dice, counts, failures = random.Random(given.seed), collections.Counter(), 0
    folder = Path(tempfile.mkdtemp(prefix="kills-"))
    every = cases(folder, given.commands.split(","))
    for case in every:
        print(f"{case.name}: {case.seconds:.1f} s undisturbed", flush=True)
    for index in range(given.count):
        case, name = every[index % len(every)], dice.choice(SIGNALS)
        delay, old = dice.uniform(0, 1.1 * case.seconds), dice.random() < 0.5
        kind, wrong = disturbed(case, folder, name, delay, old)
        again = case.name == "fleet" or name == "SIGKILL"
        wrong += rerun(case, folder) if again else []
        (folder / case.output).unlink(missing_ok=True)
        counts[case.name, name, kind] += 1
        failures += bool(wrong)
        for each in wrong:
            print(f"{index}: {case.name} {name} after {delay:.2f} s: {each}", flush=True)
    for (command, name, kind), count in sorted(counts.items()):
        print(f"{command:10} {name:8} {kind:24} {count}")
    print(f"{given.count} commands ended, {failures} of them wrongly")
    shutil.rmtree(folder)
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
