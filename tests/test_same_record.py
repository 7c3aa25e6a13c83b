"""The library makes the same choices as the command: the same calibration file, byte for byte."""

import dataclasses
import hashlib
import os
import re
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from cli_support import EXAMPLE, calibrated, mwdcal, servo_run, write_csv
from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.options import Options
from mwdcal.errors import MwdcalError
from mwdcal.files import documents
from mwdcal.files.profiles import load_profile
from mwdcal.files.runs import read_run
from test_fleet import roll_run
from test_fleet_options import bent, drifting

DATA = os.environ.get("MWDCAL_DATA", "")
MEASURED = pytest.mark.skipif(not DATA, reason="measured sets: set MWDCAL_DATA to a local copy")


def without_magnetometer():
    return {name: v for name, v in servo_run(4).items() if name not in ("mx", "my", "mz")}


def on_loose_stand(seed=5):
    return {**servo_run(seed), "sd_ref_azimuth_deg": np.full(48, 0.1)}


RUNS = {
    "servo": (EXAMPLE / "run.csv", EXAMPLE / "tool.toml", (), {}),
    "orders": (drifting(4, 2), "servo", (), {}),
    "order given": (drifting(5, 1), "servo", ("--order", 1), {"order": 1}),
    "roll sets": (roll_run(6), "servo", (), {}),
    "scalar": (servo_run(7), "servo", ("--method", "scalar"), {"method": "scalar"}),
    "robust": (servo_run(8), "servo", ("--robust", "huber"), {"robust": "huber"}),
    "datasheet": (servo_run(9), "servo", ("--prior", "datasheet"), {"prior": "datasheet"}),
    "own-axis terms": (
        bent(8, 0.004),
        "servo",
        ("--nonlinearity", "accelerometer,magnetometer"),
        {"nonlinearity": ("accelerometer", "magnetometer")},
    ),
    "stand": (
        on_loose_stand(),
        "servo",
        ("--estimate", "azimuth-zero,tilt"),
        {"estimate": ("azimuth-zero", "tilt")},
    ),
    "excluded": (
        servo_run(10),
        "servo",
        ("--exclude", 3, "--exclude", 17),
        {"exclude": ("3", "17")},
    ),
    "accelerometer": (without_magnetometer(), "servo", (), {}),
    "guessed scales": (servo_run(11), "generic", ("--parameters", 9), {"parameters": 9}),
}
FAMILIES = {"sap5/hj.csv": "sap5", "sap6/BB.csv": "sap6"}


def timeless(content: bytes) -> bytes:
    return re.sub(rb'"time": "[^"]*"', b"", content)


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def by_library(run, tool, **options):
    """The calibration file that the library makes of a run file."""
    profile, digest = load_profile(str(tool))
    readings, profile = read_run(run, profile)
    assert readings.run_sha256 == sha256(run)
    readings = dataclasses.replace(readings, profile_sha256=digest)
    return documents.encode(calibrate(readings, profile, Options(**options)))


def check(folder, run, tool, typed, options):
    path = folder / "same.json"
    ran = mwdcal("calibrate", run, "--tool", tool, "-o", path, *typed)
    assert ran.code == 0, ran.err
    assert timeless(by_library(run, tool, **options)) == timeless(path.read_bytes())
    return documents.read(path)


@pytest.mark.parametrize("name", RUNS)
def test_library_and_command_write_the_same_bytes(tmp_path, name):
    run, tool, typed, options = RUNS[name]
    path = run if isinstance(run, Path) else write_csv(tmp_path / "run.csv", run)
    record = check(tmp_path, path, tool, typed, options)
    if name == "orders":
        assert [t.order for t in record.triads] == [2, 2]
    assert bool(record.orders) == name.startswith("order")
    assert record.excluded == list(options.get("exclude", ()))


@MEASURED
@pytest.mark.parametrize("name", FAMILIES)
def test_own_axis_terms_are_chosen_alike(tmp_path, name):
    check(tmp_path, Path(DATA) / name, FAMILIES[name], (), {})


def test_a_previous_calibration_is_the_same_prior(tmp_path):
    previous = calibrated(tmp_path, servo_run(1), "--parameters", 9)
    run = write_csv(tmp_path / "later.csv", servo_run(2))
    prior, digest = documents.load(previous)
    options = {"prior": prior, "prior_sha256": digest}
    record = check(tmp_path, run, "servo", ("--prior", previous), options)
    assert record.options.parameters == 9
    assert record.prior_sha256 == sha256(previous)


@pytest.mark.parametrize(
    ("typed", "options"),
    [
        (("--order", "4"), {"order": "4"}),
        (("--nonlinearity", "thermometer"), {"nonlinearity": ("thermometer",)}),
        (("--exclude", 99), {"exclude": ("99",)}),
        (("--estimate", "roll"), {"estimate": ("roll",)}),
        (("--prior", "datasheet"), {"prior": "datasheet"}),
        (("--order", 3), {"order": 3}),
    ],
)
def test_library_and_command_refuse_alike(tmp_path, typed, options):
    """In the same words, but for the dashes of the command line."""
    run = write_csv(tmp_path / "run.csv", servo_run(3))
    ran = mwdcal("calibrate", run, "--tool", "generic", "-o", tmp_path / "cal.json", *typed)
    with pytest.raises(MwdcalError) as refusal:
        by_library(run, "generic", **options)
    assert ran.code == refusal.value.exit_code
    dashed = re.sub("`([a-z]+)`", r"--\1", str(refusal.value))
    assert ran.err == f"mwdcal: {dashed}\n"


def test_a_prior_of_another_profile_is_refused_without_a_file(tmp_path):
    previous = documents.read(calibrated(tmp_path, servo_run(1)))
    profile = replace(
        previous.profile, accelerometer=replace(previous.profile.accelerometer, scale=2.0)
    )
    readings, _ = read_run(write_csv(tmp_path / "later.csv", servo_run(2)), profile)
    with pytest.raises(MwdcalError, match="Use the tool profile that the previous calibration had"):
        calibrate(readings, profile, Options(prior=previous))
