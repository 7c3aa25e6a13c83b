"""Atomic writing: the whole file or the old one, and no temporary file left behind."""

import os

import pytest

from mwdcal.errors import InputError
from mwdcal.files import atomic


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
