"""No output of a command replaces a key, a calibration, or a file that a certificate lists."""

import pytest

from cli_support import calibrated, mwdcal, process, refused, servo_run, write_csv

pytest.importorskip("cryptography")


@pytest.fixture
def folder(tmp_path):
    """A calibration, readings, a key, a certificate that lists the calibration, and a calibration that none lists."""
    calibrated(tmp_path, servo_run(1)).rename(tmp_path / "tool.json")
    calibrated(tmp_path, servo_run(2)).rename(tmp_path / "other.json")
    write_csv(tmp_path / "readings.csv", servo_run(1, inclinations=(46, 91), toolfaces=6))
    (tmp_path / "issued").mkdir()
    issued = tmp_path / "issued" / "C.json"
    for words in (
        ("certificate", tmp_path / "tool.json", "-o", issued),
        ("certificate", "key", "create", "-o", tmp_path / "lab.key", "--owner", "laboratory"),
        ("certificate", "key", "trust", tmp_path / "keys.json", tmp_path / "lab.key.pub"),
    ):
        ran = mwdcal(*words)
        assert ran.code == 0, ran.err
    return tmp_path


def commands(folder, output):
    """Commands that would write to the output."""
    calibration, readings = folder / "tool.json", folder / "readings.csv"
    key = folder / "lab.key"
    return {
        "apply": ("apply", folder / "third.json", readings, "-o", output),
        "report": ("verify", folder / "third.json", readings, "--report", output),
        "certificate": ("certificate", folder / "third.json", "-o", output),
        "sign": ("certificate", "sign", folder / "issued" / "C.json", "--key", key, "-o", output),
        "convert": ("convert", folder / "third.json", "--notation", "forward", "-o", output),
    }
