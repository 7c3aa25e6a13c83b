"""Killed or interrupted at any moment: the old file or the new one, whole; and the same bytes again."""

import json
import os
import random
import re
import signal
import subprocess
import sys
import time

import pytest

from cli_support import EXAMPLE, mwdcal, process
from mwdcal.app.interruption import Ended, held, orderly_end, report
from mwdcal.library import fleet_table

pytestmark = pytest.mark.skipif(os.name == "nt", reason="POSIX signals")

SLOW_WRITE = """
import os, sys, time
real = os.fsync
def fsync(descriptor):
    print("writing", flush=True)
    time.sleep(0.25)
    real(descriptor)
    print("synced", flush=True)
os.fsync = fsync
from mwdcal.app.cli import main
main(sys.argv[1:])
"""
OLD = b"the old file\n"
CALIBRATE = ("calibrate", EXAMPLE / "run.csv", "--tool", EXAMPLE / "tool.toml", "-o")


def started(script, *arguments):
    """The command as a process, its output unbuffered."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    return subprocess.Popen(
        [sys.executable, "-c", script, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        encoding="utf-8",
        env=environment,
    )


def whole(path):
    """Whether the file is the old one, or a complete calibration."""
    content = path.read_bytes()
    return content == OLD or json.loads(content)["schema_version"] == 1


def kill_after(delay, target, *, writing=False):
    """Kill the command so many seconds after its start, or after it began to write."""
    child = started(SLOW_WRITE, *CALIBRATE, target)
    if writing:
        assert child.stdout.readline() == "writing\n"
    time.sleep(delay)
    child.kill()
    child.communicate()
    return child.returncode


def test_killed_at_any_moment_it_leaves_the_old_file_or_the_new_one(tmp_path):
    target, dice = tmp_path / "cal.json", random.Random(1)
    target.write_bytes(OLD)
    outcomes = []
    for _ in range(5):  # `make kills` does it a thousand times
        kill_after(dice.uniform(0, 0.7), target)
        outcomes.append(target.read_bytes() == OLD)
        assert whole(target)
        target.write_bytes(OLD)
    assert any(outcomes)


def test_killed_around_the_write_it_leaves_the_old_file_or_the_new_one(tmp_path):
    target = tmp_path / "cal.json"
    target.write_bytes(OLD)
    outcomes = set()
    for delay in (0.1, 0.249, 0.255, 0.3):
        assert kill_after(delay, target, writing=True) in (0, -signal.SIGKILL)
        outcomes.add(target.read_bytes() == OLD)
        assert whole(target)
        if delay < 0.15:  # what was written is not yet on the disk
            assert target.read_bytes() == OLD
        target.write_bytes(OLD)
    assert outcomes == {True, False}
    rerun = mwdcal(*CALIBRATE, target)
    assert rerun.code == 0
    assert json.loads(target.read_bytes())["stations"] == 48


def test_a_killed_first_run_leaves_no_file_of_that_name(tmp_path):
    assert kill_after(0.1, tmp_path / "cal.json", writing=True) == -signal.SIGKILL
    assert not (tmp_path / "cal.json").exists()


@pytest.mark.parametrize("when", ["fitting", "writing"])
def test_ctrl_c_ends_with_130_and_one_line(tmp_path, when):
    target = tmp_path / "cal.json"
    transliterate = (
        "import mwdcal.estimation.minimisers.closed_form as e, time\nreal = e.start\ndef slow(p):\n"
        + (
            "    print('writing', flush=True)\n    for _ in range(2000):\n        time.sleep(0.01)\n"
            "    return real(p)\ne.start = slow\n"
        )
    )
    child = started(("" if when == "writing" else transliterate) + SLOW_WRITE, *CALIBRATE, target)
    assert child.stdout.readline() == "writing\n"
    child.send_signal(signal.SIGINT)
    _, err = child.communicate(timeout=30)
    assert child.returncode == 130
    assert err.strip() == "mwdcal: interrupted. Files are as they were before."
    assert not list(tmp_path.iterdir())


ENDINGS = {"SIGTERM": "terminated", "SIGHUP": "terminated", "SIGINT": "interrupted"}


@pytest.mark.parametrize(("name", "word"), ENDINGS.items())
def test_every_orderly_end_tells_its_status_and_leaves_nothing(tmp_path, name, word):
    number = getattr(signal, name)
    child = started(SLOW_WRITE, *CALIBRATE, tmp_path / "cal.json")
    assert child.stdout.readline() == "writing\n"
    child.send_signal(number)
    _, err = child.communicate(timeout=30)
    assert child.returncode == 128 + number
    assert err.strip() == f"mwdcal: {word}. Files are as they were before."
    assert not list(tmp_path.iterdir())


TIDYING = """
import time
from pathlib import Path
from mwdcal.app import interruption
real_unlink = Path.unlink
def unlink(path, missing_ok=False):
    print("tidying", flush=True)
    time.sleep({seconds})
    real_unlink(path, missing_ok=missing_ok)
Path.unlink, interruption.CLEANUP_SECONDS = unlink, {patience}
"""


def signalled_while_tidying(target, first, second, pause=0.0, **given):
    """Status and messages of a command that a second signal meets while it tidies up."""
    child = started(TIDYING.format(**given) + SLOW_WRITE, *CALIBRATE, target)
    assert child.stdout.readline() == "writing\n"
    child.send_signal(getattr(signal, first))
    assert child.stdout.readline() == "tidying\n"
    time.sleep(pause)
    child.send_signal(getattr(signal, second))
    _, err = child.communicate(timeout=30)
    return child.returncode, err.strip()


@pytest.mark.parametrize(
    ("first", "second"), [("SIGTERM", "SIGHUP"), ("SIGHUP", "SIGINT"), ("SIGINT", "SIGTERM")]
)
def test_a_second_signal_does_not_disturb_the_tidying(tmp_path, first, second):
    target = tmp_path / "cal.json"
    code, err = signalled_while_tidying(target, first, second, seconds=0.2, patience=5)
    assert code == 128 + getattr(signal, first)
    assert err == f"mwdcal: {ENDINGS[first]}. Files are as they were before."
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("second", ENDINGS)
def test_a_second_signal_ends_a_tidying_that_hangs(tmp_path, second):
    target = tmp_path / "cal.json"
    given = {"seconds": 60, "patience": 0.1}
    code, err = signalled_while_tidying(target, "SIGINT", second, pause=0.2, **given)
    assert (code, err) == (128 + getattr(signal, second), "")
    assert not target.exists()


def test_an_ignored_hang_up_stays_ignored(tmp_path):
    """As `nohup` asks for."""
    ignoring = "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)\n" + SLOW_WRITE
    child = started(ignoring, *CALIBRATE, tmp_path / "cal.json")
    assert child.stdout.readline() == "writing\n"
    child.send_signal(signal.SIGHUP)
    child.communicate(timeout=40)
    assert child.returncode == 0
    assert (tmp_path / "cal.json").exists()


@pytest.mark.parametrize("stop", [KeyboardInterrupt(), Ended(signal.SIGTERM)], ids=repr)
def test_an_interrupted_fleet_says_that_finished_parts_are_kept(tmp_path, monkeypatch, stop):
    def interrupt(*given):
        raise stop

    monkeypatch.setattr(fleet_table, "calibrate_table", interrupt)
    (tmp_path / "runs.parquet").touch()
    before = [signal.getsignal(getattr(signal, name)) for name in ENDINGS]
    ran = mwdcal("fleet", tmp_path / "runs.parquet", "-o", tmp_path / "cals.parquet")
    assert ran.code == 128 + (signal.SIGTERM if isinstance(stop, Ended) else signal.SIGINT)
    word = ran.err.strip().removeprefix("mwdcal: ")
    assert word.endswith("ed. Finished parts are kept: the same command goes on from there.")
    assert [signal.getsignal(getattr(signal, name)) for name in ENDINGS] == before


@pytest.fixture
def handlers():
    """Handlers of signals that are put back."""
    numbers = [getattr(signal, name) for name in ENDINGS]
    before = {number: signal.getsignal(number) for number in numbers}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("name", ENDINGS)
def test_a_module_that_makes_another_error_of_a_signal_does_not_hide_it(handlers, name):
    """As extension modules do that are interrupted while they are loaded."""
    number = getattr(signal, name)

    def load():
        try:
            signal.raise_signal(number)
        except KeyboardInterrupt as cause:
            raise ImportError("initialization failed") from cause

    with pytest.raises(Ended) as stop, orderly_end():
        load()
    assert report(stop.value.__cause__ or stop.value)[1] == 128 + number


def test_a_signal_in_a_place_that_cannot_fail_ends_the_command_all_the_same(handlers, capfd):
    class Fragile:
        def __del__(self):
            signal.raise_signal(signal.SIGTERM)

    def work():
        each = Fragile()
        del each
        time.sleep(10)

    before = time.monotonic()
    with pytest.raises(Ended), orderly_end():
        work()
    assert time.monotonic() - before < 8  # seconds: the wait is not sat out
    assert capfd.readouterr().err == ""


def test_a_signal_waits_for_what_must_not_be_left_half_begun(handlers):
    done = []

    def work():
        with held():
            signal.raise_signal(signal.SIGTERM)
            done.append("begun")
        done.append("more")

    with pytest.raises(Ended) as stop, orderly_end():
        work()
    assert stop.value.args == (signal.SIGTERM,)
    assert done == ["begun"]


def test_other_errors_stay_what_they_are():
    with pytest.raises(ImportError), orderly_end():
        raise ImportError("no such module")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes on this system")
def test_no_command_waits_for_a_pipe(tmp_path):
    pipe = tmp_path / "tool.toml"
    os.mkfifo(pipe)
    arguments = ("calibrate", EXAMPLE / "run.csv", "--tool", pipe, "-o", tmp_path / "cal.json")
    ended = process(*arguments, timeout=60)
    assert ended.returncode == 2, ended
    assert "expected a TOML file" in ended.stderr


def without_time(path):
    """The bytes with the value of the time fields taken out."""
    return re.sub(rb'(_?time"?[: =]+")[^"]*"', rb"\1", path.read_bytes())


SEVERAL = """
import sys
from mwdcal.app.cli import main
for suffix in {suffixes}:
    try:
        main([*sys.argv[1:], "out" + suffix])
    except SystemExit as stop:
        assert not stop.code, stop
"""


def twice(tmp_path, *arguments, suffixes):
    """The folders of a command's outputs, with one and with four threads."""
    folders = []
    for threads in ("1", "4"):
        folder = tmp_path / threads
        folder.mkdir(exist_ok=True)
        names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
        environment = {**os.environ, **dict.fromkeys(names, threads), "PYTHONHASHSEED": threads}
        command = [sys.executable, "-c", SEVERAL.format(suffixes=suffixes), *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, cwd=folder, env=environment)
        assert done.returncode == 0, done
        folders.append(folder)
    return folders


def test_the_same_input_gives_the_same_corrected_readings(tmp_path):
    pytest.importorskip("pyarrow")
    pytest.importorskip("openpyxl")
    assert mwdcal(*CALIBRATE, tmp_path / "cal.json").code == 0
    arguments = ("apply", tmp_path / "cal.json", EXAMPLE / "rolltest.csv", "-o")
    suffixes = (".csv", ".parquet", ".xlsx")
    first, second = twice(tmp_path, *arguments, suffixes=suffixes)
    for suffix in suffixes:
        ours, theirs = (folder / f"out{suffix}" for folder in (first, second))
        assert ours.read_bytes() == theirs.read_bytes(), suffix


def test_the_same_input_gives_the_same_calibration_and_report(tmp_path):
    pytest.importorskip("mwdcal.presentation.calibration_page")
    folders = twice(tmp_path, *CALIBRATE, "cal.json", "--report", suffixes=(".html",))
    first, second = (folder / "cal.json" for folder in folders)
    assert without_time(first) == without_time(second)
    left, right = (json.loads(path.read_bytes()) for path in (first, second))
    assert {k for k in left if left[k] != right[k]} <= {"time"}
    times, texts = {left["time"], right["time"]}, []
    for folder in folders:
        text = (folder / "out.html").read_text("utf-8")
        for stamp in times:
            minute = stamp[:16].replace("T", " ")
            in_style = minute[11:].replace(":", r"\3a ")  # the page footer, escaped for CSS
            for form in (stamp, minute, in_style):
                text = text.replace(form, "")
        texts.append(text)
    assert texts[0] == texts[1]
