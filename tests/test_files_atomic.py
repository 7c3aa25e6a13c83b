"""Atomic writing: the whole file or the old one, and no temporary file left behind."""

import os
import subprocess
import sys
import threading
import time

import pytest

from mwdcal.errors import InputError
from mwdcal.files.formats import atomic


def test_writes_text_as_utf8_and_bytes_as_they_are(tmp_path):
    atomic.write(tmp_path / "a.txt", "30 °C\n")
    atomic.write(tmp_path / "b.bin", b"\x00\xff")
    assert (tmp_path / "a.txt").read_bytes() == "30 °C\n".encode()
    assert (tmp_path / "b.bin").read_bytes() == b"\x00\xff"


def test_replaces_the_old_file(tmp_path):
    target = tmp_path / "cal.json"
    target.write_text("old")
    atomic.write(target, "new")
    assert target.read_text() == "new"
    assert [file.name for file in tmp_path.iterdir()] == ["cal.json"]


def test_follows_a_link_and_keeps_it(tmp_path):
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to(tmp_path / "real.txt")
    atomic.write(tmp_path / "link.txt", "new")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "real.txt").read_text() == "new"


@pytest.mark.parametrize("interruption", [KeyboardInterrupt, SystemExit, MemoryError])
def test_an_interruption_leaves_the_old_file_alone(tmp_path, monkeypatch, interruption):
    target = tmp_path / "cal.json"
    target.write_text("old")

    def interrupt(descriptor):
        raise interruption

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(interruption):
        atomic.write(target, "new")
    assert target.read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == ["cal.json"]


def test_a_full_disk_is_an_input_error_and_leaves_nothing(tmp_path, monkeypatch):
    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match=r"No space left on device.*Choose another place"):
        atomic.write(tmp_path / "cal.json", "new")
    assert [file.name for file in tmp_path.iterdir()] == []


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(InputError, match=r"folder '.*nowhere' does not exist. Create it"):
        atomic.write(tmp_path / "nowhere" / "cal.json", "new")


def test_a_folder_is_no_target(tmp_path):
    with pytest.raises(InputError, match=r"it is a folder. Name a file"):
        atomic.write(tmp_path, "new")


@pytest.mark.skipif(os.name == "nt", reason="POSIX devices")
def test_a_device_is_never_replaced():
    with pytest.raises(InputError, match="not a regular file"):
        atomic.write(os.devnull, "new")


@pytest.mark.skipif(os.name == "nt", reason="POSIX files")
def test_a_pipe_and_a_link_to_itself_are_never_replaced(tmp_path):
    pipe, link = tmp_path / "pipe", tmp_path / "link"
    os.mkfifo(pipe)
    link.symlink_to(link)
    for path in (pipe, link):
        with pytest.raises(InputError, match="not a regular file"):
            atomic.write(path, "new")
    assert pipe.is_fifo()
    assert link.is_symlink()


def test_a_write_protected_file_stays_even_for_the_superuser(tmp_path):
    file = tmp_path / "cal.json"
    file.write_text("old")
    file.chmod(0o444)
    with pytest.raises(InputError, match=r"it is write-protected. Name another file"):
        atomic.write(file, "new")
    assert file.read_text() == "old"
    file.chmod(0o644)


@pytest.mark.skipif(os.name == "nt", reason="POSIX permissions")
@pytest.mark.parametrize("mode", [0o600, 0o664, 0o755])
def test_a_replaced_file_keeps_its_permissions(tmp_path, mode):
    file = tmp_path / "cal.json"
    file.write_text("old")
    file.chmod(mode)
    atomic.write(file, "new")
    assert file.stat().st_mode & 0o7777 == mode
    assert file.read_text() == "new"


def test_several_files_are_written_together_or_not_at_all(tmp_path):
    first, second = tmp_path / "cal.json", tmp_path / "report.html"
    atomic.write_all([(first, "1"), (None, ""), (second, b"2")])
    assert (first.read_text(), second.read_text()) == ("1", "2")
    with pytest.raises(InputError, match="nowhere"):
        atomic.write_all([(first, "3"), (tmp_path / "nowhere" / "x", "4")])
    assert first.read_text() == "1"
    assert {file.name for file in tmp_path.iterdir()} == {"cal.json", "report.html"}


def test_a_name_that_no_file_can_have(tmp_path):
    for name in ("a\0b", "x" * 5000):
        with pytest.raises(InputError, match="cannot write"):
            atomic.write(tmp_path / name, "new")


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root may write everywhere")
def test_a_locked_folder_is_an_input_error(tmp_path):
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(InputError, match=r"ermission denied.*choose a folder you may write"):
            atomic.write(tmp_path / "cal.json", "new")
    finally:
        tmp_path.chmod(0o700)


def test_a_refused_permission_is_an_input_error(tmp_path, monkeypatch):
    def refuse(descriptor):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(InputError, match="choose a folder you may write to"):
        atomic.write(tmp_path / "cal.json", "new")


KILLED = """
import os, sys
from mwdcal.files.formats import atomic
with atomic.replacing(sys.argv[1]) as stream:
    stream.write(b"half")
    stream.flush()
    os._exit(9)
"""


def left_behind(folder):
    """What a process that was killed while writing left, and a folder that was not yet looked at."""
    subprocess.run([sys.executable, "-c", KILLED, str(folder / "a.txt")], check=False)
    (left,) = folder.glob(".mwdcal-*.tmp")
    assert left.read_bytes() == b"half"
    if os.name == "nt":  # where no lock tells that nobody is about to rename it
        os.utime(left, (0, 0))
    atomic.sweep.cache_clear()
    return left


def test_what_a_killed_writer_left_is_removed_by_the_next(tmp_path):
    left = left_behind(tmp_path)
    with atomic.replacing(tmp_path / "b.txt") as stream:
        assert not left.exists()  # there is room for the new file
        stream.write(b"new")
    assert [file.name for file in tmp_path.iterdir()] == ["b.txt"]


def test_what_is_being_written_is_never_removed(tmp_path):
    with atomic.replacing(tmp_path / "a.txt") as stream:
        os.utime(stream.name, (0, 0))  # however long it takes
        atomic.sweep.cache_clear()
        atomic.write(tmp_path / "b.txt", "new")
        stream.write(b"done")
    assert (tmp_path / "a.txt").read_bytes() == b"done"


def test_many_writers_and_sweeps_at_once_lose_nothing(tmp_path):
    def write(number):
        for i in range(40):
            atomic.sweep.cache_clear()
            atomic.write(tmp_path / f"{number}-{i}", "x", durable=False)

    threads = [threading.Thread(target=write, args=(n,)) for n in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(list(tmp_path.iterdir())) == 240


@pytest.mark.skipif(os.name == "nt", reason="an open file cannot be removed there")
def test_files_of_another_machine_are_left_for_a_day(tmp_path, monkeypatch):
    left = left_behind(tmp_path)
    other = left.with_name(".mwdcal-00000000-" + left.name.partition("-")[2].partition("-")[2])
    left.rename(other)
    atomic.write(tmp_path / "b.txt", "new")
    assert other.exists()
    os.utime(other, (time.time() - 90_000,) * 2)
    atomic.sweep.cache_clear()
    atomic.write(tmp_path / "b.txt", "new")
    assert not other.exists()


@pytest.mark.skipif(os.name == "nt", reason="POSIX locks")
def test_a_disk_without_locks_is_written_to_and_not_swept(tmp_path, monkeypatch):
    left = left_behind(tmp_path)

    def refuse(*given):
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr(atomic.fcntl, "flock", refuse)
    atomic.write(tmp_path / "b.txt", "new")
    assert left.exists()
    assert (tmp_path / "b.txt").read_text() == "new"


def test_what_only_looks_like_a_temporary_file_stays(tmp_path):
    (tmp_path / ".mwdcal-folder.tmp").mkdir()
    atomic.sweep.cache_clear()
    atomic.write(tmp_path / "b.txt", "new")
    assert (tmp_path / ".mwdcal-folder.tmp").is_dir()
