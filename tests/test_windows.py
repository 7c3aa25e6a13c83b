"""What is different on Windows, as far as it can be had elsewhere.

No file can be removed or renamed there while it is open, nor a folder in which one is: here the calls refuse it for
the files that this process has open. No `fcntl`; processes are spawned; standard output is in a code page.
"""

import errno
import gc
import io
import json
import multiprocessing
import os
import shlex
import shutil
import sys
from concurrent.futures import Future
from enum import Enum
from pathlib import Path
from types import SimpleNamespace

import pytest

from cli_support import EXAMPLE, mwdcal, refused, servo_run, write_csv
from mwdcal import pool
from mwdcal import signals as signals_to_end
from mwdcal.app import cli, interruption, messages
from mwdcal.certificate import signature as key_files
from mwdcal.errors import InputError, shell_word
from mwdcal.files.formats import atomic, sinks
from test_fleet import pa, pq
from test_fleet_kept import fleet, parts_of, small_fleet, small_parts  # noqa: F401

fcntl = pytest.importorskip("fcntl")

pytestmark = pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="needs Linux")


def open_files():
    """The files, not folders, that this process has open."""
    for descriptor in os.listdir("/proc/self/fd"):
        path = f"/proc/self/fd/{descriptor}"
        if os.path.isfile(path):
            yield os.readlink(path)


def refusing(call):
    """A call that changes a name, which refuses the names of open files and of folders above them."""

    def refuse(path, *given, dir_fd=None, **named):
        folder = os.readlink(f"/proc/self/fd/{dir_fd}") if dir_fd is not None else "."
        for each in (os.path.join(folder, path), *given[:1]):
            name = os.path.realpath(os.path.dirname(each) or ".") + "/" + os.path.basename(each)
            if any(file == name or file.startswith(f"{name}/") for file in open_files()):
                raise PermissionError(errno.EACCES, "it is open in another process", str(each))
        return call(path, *given, **named, **({} if dir_fd is None else {"dir_fd": dir_fd}))

    return refuse


@pytest.fixture
def windows(monkeypatch):
    """Open files that stay, and locks by `msvcrt`, which refuse with another error."""

    def locking(descriptor, mode, count):
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise PermissionError(errno.EACCES, "Permission denied") from None

    monkeypatch.setattr(atomic, "fcntl", None)
    fake = SimpleNamespace(locking=locking, LK_NBLCK=2)
    monkeypatch.setattr(atomic, "msvcrt", fake, raising=False)
    monkeypatch.setattr(atomic, "_PAUSES", (0.0, 0.0))
    for name in ("replace", "rename", "unlink", "remove", "rmdir"):
        monkeypatch.setattr(os, name, refusing(getattr(os, name)))


def names(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_an_open_file_refuses_here_as_it_does_there(tmp_path, windows):
    (tmp_path / "folder").mkdir()
    file = tmp_path / "folder" / "file"
    with file.open("w"):
        for refuse in (
            file.unlink,
            lambda: file.rename(tmp_path / "other"),
            lambda: shutil.move(tmp_path / "folder", tmp_path / "other"),
            lambda: (tmp_path / "new").touch() or (tmp_path / "new").replace(file),
            lambda: shutil.rmtree(tmp_path / "folder"),
        ):
            with pytest.raises(PermissionError):
                refuse()
    shutil.rmtree(tmp_path / "folder")


# ------------------------------------------------------------------------ files that are open


@pytest.mark.parametrize("mixed", [False, True], ids=["in order", "dealt"])
@pytest.mark.usefixtures("without_pictures")
def test_a_fleet_is_written_and_leaves_nothing(tmp_path, windows, small_parts, mixed):  # noqa: F811
    path = small_fleet(tmp_path, mixed)
    for _ in range(2):  # the second one replaces the first
        ran, output = fleet(path, "--records", "--report", tmp_path / "fleet.html")
        assert ran.code == 0, ran
        assert pq.read_table(output).num_rows == 6
        gc.collect()  # a page is a cycle that holds the table until the process ends
    assert names(tmp_path) == ["cals.parquet", "fleet.html", "runs.parquet"]


def test_a_second_fleet_for_the_same_output_is_refused(tmp_path, windows, small_parts):  # noqa: F811
    path = small_fleet(tmp_path)
    with atomic.holding(parts_of(path) / "lock") as ours:
        assert ours
        assert "another fleet is writing" in refused(fleet(path)[0], 2)
    assert names(tmp_path) == ["runs.parquet"]
    assert fleet(path)[0].code == 0


def test_a_refused_correction_leaves_nothing(tmp_path, windows, monkeypatch):
    run = write_csv(tmp_path / "run.csv", servo_run(1))
    cal, table = tmp_path / "cal.json", tmp_path / "table.parquet"
    assert mwdcal("calibrate", run, "--tool", "servo", "-o", cal).code == 0
    pq.write_table(pa.table(servo_run(1)), table)
    before = names(tmp_path)
    for name, problem in (("write", InputError("refused")), ("finish", OSError(28, "No space"))):
        with monkeypatch.context() as patch:

            def fail(*given, problem=problem):
                raise problem

            patch.setattr(sinks.ParquetSink, name, fail)
            assert mwdcal("apply", cal, table, "-o", tmp_path / "new.parquet").code == 2
        assert names(tmp_path) == before
    assert mwdcal("apply", cal, table, "-o", tmp_path / "new.parquet").code == 0


def test_documents_and_the_registry_are_written_and_leave_nothing(tmp_path, windows, monkeypatch):
    monkeypatch.chdir(tmp_path)
    registry = ("registry", "--registry", "tools.sqlite")
    verified = mwdcal_all(
        ("calibrate", EXAMPLE / "run.csv", "--tool", EXAMPLE / "tool.toml", "-o", "tool.json"),
        ("verify", "tool.json", EXAMPLE / "rolltest.csv", "--json"),
    )
    Path("v.json").write_text(verified, "utf-8")
    mwdcal_all(
        ("certificate", "tool.json", "--verification", "v.json", "-o", "c.json", "-o", "c.xml"),
        ("certificate", "key", "create", "-o", "lab.key", "--owner", "Lab"),
        ("certificate", "sign", "c.json", "--key", "lab.key"),
        ("certificate", "key", "trust", "keys.json", "lab.key.pub"),
        (*registry, "init"),
        (*registry, "add", "tool.json", "v.json", "c.json"),
        (*registry, "backup", "backup.sqlite"),
        (*registry, "backup", "backup.sqlite"),
        ("registry", "--registry", "new.sqlite", "restore", "backup.sqlite"),
        ("registry", "--registry", "new.sqlite", "check"),
        (*registry, "export", "out"),
        (*registry, "get", "SIM-0001", "-o", "again.json"),
    )
    whole = "again.json backup.sqlite c.json c.xml keys.json lab.key lab.key.pub new.sqlite out tool.json tools.sqlite"
    assert sorted(path.name for path in tmp_path.iterdir()) == [*whole.split(), "v.json"]
    assert list(open_files()).count(str(tmp_path / "tools.sqlite")) == 0


def mwdcal_all(*lines):
    """Run commands; what the last one printed."""
    for line in lines:
        ran = mwdcal(*line)
        assert ran.code == 0, ran
    return ran.out


# ------------------------------------------------------------------------- names and locks


@pytest.mark.parametrize("refusals", [0, 1, 2])
def test_a_file_that_is_held_for_a_moment_is_renamed_later(
    tmp_path, monkeypatch, windows, refusals
):
    real, left = os.replace, [PermissionError(errno.EACCES, "Permission denied")] * refusals

    def held_for_a_moment(*given):
        if left:
            raise left.pop()
        real(*given)

    monkeypatch.setattr(os, "replace", held_for_a_moment)
    atomic.write(tmp_path / "a.txt", "new")
    assert not left
    assert names(tmp_path) == ["a.txt"]


def test_a_file_that_stays_open_keeps_its_content(tmp_path, windows):
    file = tmp_path / "a.txt"
    file.write_text("old")
    with file.open(), pytest.raises(InputError, match="Close the program that has it open"):
        atomic.write(file, "new")
    assert file.read_text() == "old"
    assert names(tmp_path) == ["a.txt"]


def test_no_stream_inside_a_file_is_written(tmp_path, windows):
    for write in (atomic.write, lambda path, text: key_files.create(path, "Lab", "")):
        with pytest.raises(InputError, match="stream inside the file"):
            write(tmp_path / "lab.json:key", "new")
    assert names(tmp_path) == []


def test_a_temporary_file_that_is_about_to_be_renamed_is_not_swept(tmp_path, windows):
    left = tmp_path / ".mwdcal-00000000-0123456789abcdef.tmp"
    left.write_text("whole, and closed")
    atomic.sweep.cache_clear()
    atomic.write(tmp_path / "a.txt", "new")
    assert left.exists()
    os.utime(left, (1e9, 1e9))
    atomic.sweep.cache_clear()
    atomic.write(tmp_path / "a.txt", "new")
    assert not left.exists()


def test_ctrl_break_ends_a_command_as_ctrl_c_does(monkeypatch):
    signals = Enum("Signals", ["SIGBREAK"])
    handlers = {signals.SIGBREAK: 0}
    fake = SimpleNamespace(
        Signals=signals, SIG_DFL=0, SIG_IGN=1, default_int_handler=2,
        getsignal=handlers.get, signal=handlers.__setitem__,
    )  # fmt: skip
    monkeypatch.setattr(interruption, "signal", fake)
    monkeypatch.setattr(signals_to_end, "signal", fake)
    with pytest.raises(interruption.Ended), interruption.orderly_end():
        handlers[signals.SIGBREAK](21, None)


# ---------------------------------------------------------------------------------- workers


def test_no_pool_has_more_processes_than_windows_can_wait_for(monkeypatch):
    """61: CPython's documentation of ProcessPoolExecutor."""
    asked = []

    class Pool:
        def __init__(self, workers, *given):
            asked.append(workers)

        def __enter__(self):
            return self

        def __exit__(self, *given):
            pass

        def submit(self, solve, task):
            (done := Future()).set_result(solve(task))
            return done

        def shutdown(self, **how):
            pass

    monkeypatch.setattr(pool, "ProcessPoolExecutor", Pool)
    steps = pool.Steps(str, str.encode)
    assert len(list(pool.results(steps, range(500), 128, None))) == 500
    assert asked == [61]


def test_waiting_for_workers_is_done_a_moment_at_a_time(monkeypatch):
    """So that an interruption comes through, which on Windows ends no wait; and nothing is done twice."""
    real, waits = pool.wait, []

    def wait(running, seconds, when):
        waits.append(seconds)
        return SimpleNamespace(done=set()) if len(waits) % 3 else real(running, seconds, when)

    monkeypatch.setattr(pool, "wait", wait)
    ready = [Future() for _ in range(3)]
    for future in ready:
        future.set_result(b"")
    assert pool._ready(ready) == set(ready)
    assert len(waits) == 3
    assert 0 < max(waits) <= 1


def test_spawned_workers_calibrate_the_same(tmp_path, monkeypatch, small_parts):  # noqa: F811
    path = small_fleet(tmp_path)
    assert fleet(path)[0].code == 0
    alone = pq.read_table(path.with_name("cals.parquet"))
    monkeypatch.setattr(multiprocessing, "get_all_start_methods", lambda: ["spawn"])
    ran = fleet(path, "--workers", 2)[0]
    assert ran.code == 0, ran
    assert pq.read_table(path.with_name("cals.parquet")).equals(alone)


# --------------------------------------------------------------------------- what is printed


def bytes_printed(monkeypatch, encoding, *arguments):
    """What a command writes to a file by `>`: in a code page, and with line ends of Windows."""
    stream = io.TextIOWrapper(io.BytesIO(), encoding, newline="\r\n")
    monkeypatch.setattr(sys, "stdout", stream)
    with pytest.raises(SystemExit) as stop:
        cli.main([str(a) for a in arguments])
    assert not stop.value.code
    return stream.buffer.getvalue()


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """A calibration of a tool whose serial has a letter that every western code page has, and a roll test."""
    folder = tmp_path_factory.mktemp("calibrated")
    run = write_csv(folder / "run.csv", servo_run(1), 'serial = "Süd 1"')
    roll = servo_run(1, inclinations=(46, 91), toolfaces=6)
    roll = write_csv(folder / "roll.csv", roll, 'serial = "Süd 1"')
    assert mwdcal("calibrate", run, "--tool", "servo", "-o", folder / "cal.json").code == 0
    return folder / "cal.json", roll


@pytest.mark.parametrize("encoding", ["cp1252", "cp850", "cp437"])
def test_redirected_json_is_utf_8_whatever_the_code_page(monkeypatch, calibrated, encoding):
    printed = bytes_printed(monkeypatch, encoding, "verify", *calibrated, "--json")
    assert json.loads(printed.decode("utf-8"))["serial"] == "Süd 1"


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8-sig", "utf-8"])
def test_json_that_powershell_saved_is_read(tmp_path, monkeypatch, calibrated, encoding):
    """`>` of Windows PowerShell writes UTF-16 with a mark, `Out-File -Encoding utf8` UTF-8 with one."""
    monkeypatch.chdir(tmp_path)
    printed = bytes_printed(monkeypatch, "cp1252", "verify", *calibrated, "--json")
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    Path("v.json").write_bytes(printed.decode("ascii").encode(encoding))
    registry = ("registry", "--registry", "tools.sqlite")
    mwdcal_all(
        ("certificate", calibrated[0], "--verification", "v.json", "-o", "c.json"),
        ("certificate", "key", "create", "-o", "lab.key", "--owner", "Lab"),
        (*registry, "init"),
        (*registry, "add", calibrated[0], "v.json"),
    )
    assert json.loads(Path("c.json").read_bytes())["as_left"]["passed"] is True
    listed = json.loads(mwdcal_all((*registry, "drift", "Süd 1", "--json")))
    assert listed["command"] == "registry drift"
    mwdcal_all(("certificate", "sign", "v.json", "--key", "lab.key"))
    assert json.loads(Path("v.json").read_text("utf-8"))["serial"] == "Süd 1"


def test_wrong_utf_16_is_refused_in_words(tmp_path, calibrated):
    (tmp_path / "v.json").write_bytes(b"\xff\xfe{\xd8")
    ran = mwdcal("certificate", calibrated[0], "--verification", tmp_path / "v.json")
    assert "v.json is not a verification" in refused(ran, 2)


@pytest.mark.parametrize("number", [errno.EPIPE, errno.EINVAL])
def test_a_reader_that_has_left_is_no_error(monkeypatch, number):
    """Windows reports a pipe without a reader as an invalid argument."""

    class Pipe:
        encoding = "utf-8"

        def write(self, text):
            raise OSError(number, "the reader has left")

        def fileno(self):
            raise OSError(errno.EBADF, "none here")

    monkeypatch.setattr(messages, "READER_HAS_LEFT", {errno.EPIPE, errno.EINVAL})
    messages.Screen(Pipe()).write("text")
    monkeypatch.setattr(messages, "READER_HAS_LEFT", set())
    with pytest.raises(InputError, match="cannot write the result"):
        messages.Screen(Pipe()).write("text")


@pytest.mark.parametrize(
    "name", ["run.csv", "my run.csv", "a$HOME b.csv", "tool `x`.json", "it's.csv", 'a"b.csv']
)
def test_a_suggested_command_names_the_file_and_nothing_else(name):
    """The reading of a POSIX shell by the standard library; no sign of it stays alive in double quotes."""
    word = shell_word(name)
    assert shlex.split(word) == [name]
    assert word.startswith("'") or not {*word} & {*"$`!"}
