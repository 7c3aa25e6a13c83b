"""Exchanged axes of surveys: named where offsets and scales differ from axis to axis, and never in sound runs."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from msgspec.structs import replace as replace_struct

from cli_support import EXAMPLE, mwdcal
from mwdcal.calibration.record import Calibration
from mwdcal.survey import long_table
from mwdcal.survey.axes import NAMED_BY_CHANCE, exchanged_axes
from test_interference import laboratory
from wells import DEVIATED, Path, horizontal_east, one, path, surveyed

XY = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]])
TURN = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
Z_REVERSED = np.diag([1.0, 1, -1])
SAME = np.eye(3)
TURNED = {
    "x and y of both": (XY, XY, "ax = ay, ay = ax, mx = my, my = mx"),
    "x and y of the accelerometer": (XY, SAME, "ax = ay, ay = ax"),
    "x and y of the magnetometer": (SAME, XY, "mx = my, my = mx"),
    "a quarter turn": (TURN, TURN, "ax = −ay, ay = ax, mx = −my, my = mx"),
    "z reversed": (Z_REVERSED, Z_REVERSED, "az = −az, mz = −mz"),
}
"""The columns as an operator names them, from the right ones, of both triads; and what puts them right."""


@cache
def tool(
    seed: int, offset_g: float = 5e-3, offset_nt: float = 500.0, scale: float = 1e-2
) -> Calibration:
    """A calibration whose axes differ in offset and scale by these 1σ: field = (1 + s) raw + c."""
    rng, record = np.random.default_rng(seed), laboratory()
    parts = {}
    for triad, offset in zip(record.triads, (offset_g, offset_nt), strict=True):
        matrix = np.diag(1 + scale * rng.normal(size=3))
        parameters = [*matrix.ravel(), *(offset * rng.normal(size=3))]
        parts[triad.name] = replace_struct(triad, parameters=parameters)
    return replace_struct(record, **parts)


def wells(calibration: Calibration, where: Path, count: int, seed: int, **off: float):
    """Surveys by a tool that drifted, in interference, by 1σ of the error model: each axis by itself."""
    rng = np.random.default_rng(seed)
    size = (count, 1, 3)
    iron = rng.normal(size=size) * (40, 40, 220) + 70 * rng.normal(size=size)
    gravity = 5e-4 * rng.normal(size=size), 4.1e-4 * rng.normal(size=size)
    scale = 1.6e-3 * rng.normal(size=size)
    return surveyed(calibration, where, count, seed, iron=iron, scale=scale, gravity=gravity, **off)


def named(calibration: Calibration, readings) -> str:
    """The text of the finding, or nothing."""
    return "".join(finding.text for finding in exchanged_axes(calibration, readings))


@pytest.mark.parametrize("kind", TURNED)
@pytest.mark.parametrize("seed", [2, 6])
def test_columns_are_put_right(kind, seed):
    first, second, words = TURNED[kind]
    right = one(wells(tool(seed), DEVIATED, 1, seed))
    wrong = replace(
        right,
        accelerometer=right.accelerometer @ first.T,
        magnetometer=right.magnetometer @ second.T,
    )
    assert f"fit the calibration with {words}, and not" in named(tool(seed), wrong)
    assert not named(tool(seed), right)


def test_of_several_that_fit_the_simplest_is_named():
    """A tool of almost no offset along z: whether z is reversed too cannot be told."""
    right = one(wells(tool(5), DEVIATED, 1, 5))
    both = {name: getattr(right, name) @ XY for name in ("accelerometer", "magnetometer")}
    words = "with ax = ay, ay = ax, mx = my, my = mx, or with others like it, and not"
    assert words in named(tool(5), replace(right, **both))


@pytest.mark.parametrize(
    ("count", "offsets"),
    [(3, (2e-4, 20.0, 2e-4)), (3, (1e-3, 100.0, 1e-3)), (3, (1e-2, 1000.0, 2e-2)),
     pytest.param(100, (1e-3, 100.0, 1e-3), marks=pytest.mark.study)],
)  # fmt: skip
def test_sound_runs_are_not_named(count, offsets):
    """Wells of several kinds: at most one in a thousand, as Markov's inequality has it."""
    places = (
        DEVIATED,
        horizontal_east(),
        path((0.5, 6), (10, 300), 20),
        path((30, 30.5), (120, 121), 5),
    )
    alarms = total = 0
    for seed in range(count):
        calibration = tool(seed, *offsets)
        for where in places:
            readings = wells(calibration, where, 10, 100 + seed)
            alarms += sum(bool(named(calibration, one(readings, k))) for k in range(10))
            total += 10
    assert alarms <= np.ceil(NAMED_BY_CHANCE * total) - (total < 1 / NAMED_BY_CHANCE)


def test_axes_alike_cannot_be_told_apart():
    """A tool whose axes differ by less than they drift: nothing is named, right or wrong."""
    calibration = tool(3, 1e-4, 10.0, 1e-4)
    right = one(wells(calibration, DEVIATED, 1, 3))
    both = {name: getattr(right, name) @ XY for name in ("accelerometer", "magnetometer")}
    assert not named(calibration, replace(right, **both))


def test_nothing_is_said_without_references():
    right = one(wells(tool(1), DEVIATED, 1, 1))
    wrong = replace(
        right, accelerometer=right.accelerometer @ XY, magnetometer=right.magnetometer @ XY
    )
    assert named(tool(1), wrong)
    assert not named(tool(1), replace(wrong, known={}))


@pytest.mark.parametrize("parts", [False, True])
def test_the_command_says_so(tmp_path, monkeypatch, parts):
    """The bundled well with its columns exchanged, as a whole and in parts."""
    fit = ("calibrate", EXAMPLE / "run.csv", "--tool", EXAMPLE / "tool.toml")
    assert mwdcal(*fit, "-o", tmp_path / "tool.json").code == 0
    stated, _, table = (EXAMPLE / "well.csv").read_text("utf-8").partition("md_m,")
    head, *rows = table.splitlines()
    assert "ax,ay,az,mx,my,mz" in head
    head = head.replace("ax,ay,az,mx,my,mz", "ay,ax,az,my,mx,mz")
    if parts:  # the same surveys again and again, without depths
        rows = [row.partition(",")[2] for row in rows] * 20
        monkeypatch.setattr(long_table, "LONG_TEXT", 1)
    else:
        head = f"md_m,{head}"
    (tmp_path / "well.csv").write_text("\n".join([stated + head, *rows]), "utf-8")
    done = mwdcal(
        "survey", tmp_path / "tool.json", tmp_path / "well.csv", "-o", tmp_path / "out.csv"
    )
    assert done.code == 0
    assert "fit the calibration with ax = ay, ay = ax, mx = my, my = mx, and not" in done.err


def test_an_estimate_that_fails_is_said(monkeypatch):
    def fails(*_):
        raise np.linalg.LinAlgError("Singular matrix")

    right = one(wells(tool(2), DEVIATED, 1, 2))
    monkeypatch.setattr(sys.modules[exchanged_axes.__module__], "chi_square", fails)
    [finding] = exchanged_axes(tool(2), right)
    assert finding.id == "not-judged"
    assert "could not be judged: Singular" in finding.text
    assert exchanged_axes(tool(2), replace(right, magnetometer=None)) == []


def test_exchanged_columns_are_named_beside_a_misfit():
    """Noise above the calibration's: the right axes do not fit either, and leave a small share of the misfit."""
    rng, right = np.random.default_rng(3), one(wells(tool(2), DEVIATED, 1, 2))
    noise = 40.0 * rng.normal(size=right.magnetometer.shape)
    noisy = replace(right, magnetometer=right.magnetometer + noise)
    both = {name: getattr(noisy, name) @ XY for name in ("accelerometer", "magnetometer")}
    assert "fit the calibration with ax = ay, ay = ax, mx" in named(tool(2), replace(noisy, **both))
    assert not named(tool(2), noisy)


@pytest.mark.parametrize("row", [0, 3])
def test_one_wrong_sign_is_no_exchange(row):
    right = one(wells(tool(2), DEVIATED, 1, 2))
    wrong = right.magnetometer.copy()
    wrong[row, 0] *= -1
    assert not named(tool(2), replace(right, magnetometer=wrong))


def test_surveys_of_another_tool_say_that_alone(tmp_path):
    """The serial comes first, without a word about a prior; multi-station analysis refuses it."""
    fit = ("calibrate", EXAMPLE / "run.csv", "--tool", EXAMPLE / "tool.toml")
    assert mwdcal(*fit, "-o", tmp_path / "tool.json").code == 0
    survey = ("survey", tmp_path / "tool.json", EXAMPLE / "well.csv", "-o", tmp_path / "out.csv")
    done = mwdcal(*survey, "--serial", "OTHER")
    assert done.code == 0
    assert done.err.startswith("! the readings are of tool OTHER, the calibration of tool ")
    assert "prior" not in done.err
    done = mwdcal(*survey, "--serial", "OTHER", "--msa")
    assert done.code == 2
    assert "well.csv is of tool OTHER" in done.err
    assert "prior" not in done.err
