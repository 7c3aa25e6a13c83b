"""Whole wells with errors drawn from an error model: stated angles and positions against the truth."""

from __future__ import annotations

import warnings
from collections.abc import Mapping

import numpy as np
from world import Array, covered, percent, table, turned, vectors, write

from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration
from mwdcal.survey.acceptance import load_survey_limits
from mwdcal.survey.error_model import load_error_model
from mwdcal.survey.stations import North
from mwdcal.survey.well import Well, well
from wells import NOISE, laboratory

SEED = 29
TOOLS, WELLS, SURVEYS, COURSE = 10, 1000, 60, 30.0
DRIFT = {"scale": (0.0005, 0.0016), "bias": (0.004 / 9.80665, 70.0)}
"""1σ of each axis since the laboratory: accelerometer (g), magnetometer (nT)."""
AXIAL = 220.0
DECLINATION, SD_DECLINATION, NOISE_DECLINATION = 2.0, 0.36, 0.1
TORTUOSITY = np.radians(1.0) / 30.48
INSIDE_95 = 7.814727903251179
"""Chi squared with 3 degrees of freedom that 95 % lie below."""


def trajectories() -> dict[str, tuple[Array, Array, float, float]]:
    """Inclinations and azimuths (from magnetic north) of wells, degrees, with field, nT, and dip, degrees."""
    up, part = np.linspace, SURVEYS // 3
    flat, rest = np.full(SURVEYS - part, 90.0), SURVEYS - 2 * part
    lateral = np.r_[up(3, 90, part), flat]
    return {
        "build": (up(3, 60, SURVEYS), up(40, 75, SURVEYS), 50_000.0, 65.0),
        "lateral east-west": (lateral, np.r_[up(80, 92, part), flat + 2], 50_000.0, 65.0),
        "lateral north": (lateral, np.full(SURVEYS, 8.0), 50_000.0, 65.0),
        "S": (np.r_[up(3, 40, part), np.full(rest, 40.0), up(40, 5, part)], np.full(SURVEYS, 40.0), 50_000.0, 65.0),
        "southern hemisphere": (up(3, 75, SURVEYS), up(200, 260, SURVEYS), 57_000.0, -64.0),
        "high dip": (up(3, 80, SURVEYS), up(20, 110, SURVEYS), 57_000.0, 80.0),
    }  # fmt: skip


def directions(inclination: Array, azimuth: Array) -> Array:
    """Unit vectors (…, 3) along the hole, north, east, down; degrees."""
    i, a = np.radians(inclination), np.radians(azimuth)
    return np.stack([np.sin(i) * np.cos(a), np.sin(i) * np.sin(a), np.cos(i)], -1)


def places(md: Array, along: Array) -> Array:
    """Positions (n, 3) by minimum curvature: the ratio factor on the dogleg."""
    dogleg = np.arccos(np.clip(np.sum(along[1:] * along[:-1], -1), -1, 1))
    bent = dogleg > 1e-6
    half = np.where(bent, dogleg, 1.0) / 2
    factor = np.where(bent, np.tan(half) / half, 1.0)
    steps = (np.diff(md) / 2 * factor)[:, None] * (along[1:] + along[:-1])
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, 0)])


def turns(inclination: Array, azimuth: Array) -> tuple[Array, Array]:
    """Unit vectors (n, 3) upward and sideways of a hole; degrees."""
    i, a = np.radians(inclination), np.radians(azimuth)
    zero = np.zeros(i.shape)
    upward = np.stack([np.cos(i) * np.cos(a), np.cos(i) * np.sin(a), -np.sin(i)], -1)
    return upward, np.stack([-np.sin(a), np.cos(a), zero], -1)


def drawn(
    sensors: tuple, path: tuple[Array, Array, float, float], axial: float, rng: np.random.Generator
) -> tuple[Readings, Array, Mapping[str, Array], Array]:
    """Readings of a well with their stated depths, and its true angles (from true north) and positions."""
    inclination, magnetic, field, dip = path
    sine, cosine = np.sin(np.radians(inclination)), np.abs(np.cos(np.radians(inclination)))
    declination = (
        DECLINATION + SD_DECLINATION * rng.normal() + NOISE_DECLINATION * rng.normal(size=SURVEYS)
    )
    azimuth = magnetic + declination
    md = 300.0 + COURSE * np.arange(SURVEYS)
    along = directions(inclination, azimuth)
    upward, sideways = turns(inclination, azimuth)
    # the tool in the hole: sag, and misalignment that turns with it or is new at every station
    sag, first, second = rng.normal(size=3) * (0.2, 0.1, 0.1)
    third, fourth = 0.3 * rng.normal(size=(2, SURVEYS))
    north, east = np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))
    up = sag * sine**0.25 + first * sine + cosine * (third * north + fourth * east)
    side = -second * sine + cosine * (fourth * north - third * east)
    leaning = along + np.radians(up)[:, None] * upward + np.radians(side)[:, None] * sideways
    leaning /= np.linalg.norm(leaning, axis=-1, keepdims=True)
    seen = (
        np.degrees(np.arccos(leaning[:, 2])),
        np.degrees(np.arctan2(leaning[:, 1], leaning[:, 0])),
    )
    g, b = vectors(
        seen[0],
        seen[1] - declination,
        rng.uniform(0, 360, SURVEYS),
        1.0,
        np.full(SURVEYS, field),
        np.full(SURVEYS, dip),
    )
    b = b + np.array([0.0, 0.0, axial])
    moved = [
        v * (1 + s * rng.normal(size=3)) + o * rng.normal(size=3)
        for v, s, o in zip((g, b), *DRIFT.values(), strict=True)
    ]
    raw = [
        triad.raw(v) + s * rng.normal(size=v.shape)
        for triad, v, s in zip(sensors, moved, NOISE, strict=True)
    ]
    # the true hole: its depths, and what happens between stations
    tvd = places(md, along)[:, 2] + 300.0
    depth = (
        md
        - 0.35 * rng.normal(size=SURVEYS)
        - 0.00056 * md * rng.normal()
        - 2.5e-7 * md * tvd * rng.normal()
    )
    place = places(depth, along) + (depth[0] - md[0]) * along[0]
    bend = np.abs(np.diff(np.radians(inclination)))
    swing = sine[1:] * np.abs(np.sin(np.diff(np.radians(azimuth))))
    across = (
        np.maximum(x, TORTUOSITY * COURSE) * 0.167 * COURSE * rng.normal(size=SURVEYS - 1)
        for x in (bend, swing)
    )
    wander = sum(x[:, None] * t[1:] for x, t in zip(across, (upward, sideways), strict=True))
    place[1:] -= np.cumsum(wander, 0)
    sd = {
        n: np.full((SURVEYS, 3), s)
        for n, s in zip(("accelerometer", "magnetometer"), NOISE, strict=True)
    }
    sd |= {
        "gravity": np.full(SURVEYS, 2e-5),
        "field": np.full(SURVEYS, 130.0),
        "dip": np.full(SURVEYS, np.radians(0.2)),
    }
    known = {
        "gravity": np.full(SURVEYS, 1.0),
        "field": np.full(SURVEYS, field),
        "dip": np.full(SURVEYS, np.radians(dip)),
    }
    return (
        Readings(*raw, None, known, sd),
        md,
        {"inclination": inclination, "azimuth": azimuth},
        place,
    )


def surveyed(calibration: Calibration, readings: Readings, md: Array) -> Well:
    """The surveys that the product makes of a well."""
    north = North(
        np.radians(DECLINATION), np.radians(SD_DECLINATION), None, np.radians(NOISE_DECLINATION)
    )
    limits, _ = load_survey_limits()
    return well(
        calibration, readings, limits, north, md, (0.0, 0.0, 300.0), model=load_error_model()
    )


def row(labs: list, path: tuple[Array, Array, float, float], times: float, rng) -> list[str]:  # type: ignore[no-untyped-def]
    """Coverage of one trajectory, and findings where the azimuth is off by more than 3σ."""
    inside, middle, off, found = [], [], 0, 0
    errors: dict[str, list[Array]] = {"inclination": [], "azimuth": []}
    stated: dict[str, list[Array]] = {name: [] for name in errors}
    for k in range(WELLS):
        sensors, calibration = labs[k % len(labs)]
        axial = AXIAL * (rng.normal() if times == 1 else times * rng.choice([-1, 1]))
        readings, md, truth, place = drawn(sensors, path, axial, rng)
        result = surveyed(calibration, readings, md)
        assert result.position is not None
        for name, sd in (
            ("inclination", result.surveys.of("inclination")[1]),
            ("azimuth", result.sd_azimuth),
        ):
            value = np.degrees(result.surveys.of(name)[0]) + (
                DECLINATION if name == "azimuth" else 0.0
            )
            errors[name].append(turned(value - truth[name]))
            stated[name].append(np.degrees(sd))
        position = result.position
        for at, cases in ((-1, inside), (SURVEYS // 2, middle)):
            error = position.place[at] - place[at] - (0.0, 0.0, 300.0)
            cases.append(error @ np.linalg.solve(position.covariance[at], error) <= INSIDE_95)
        if (np.abs(errors["azimuth"][-1]) > 3 * stated["azimuth"][-1]).any():
            off += 1
            found += bool({"blind-to-interference", "rejected"} & {f.id for f in result.findings})
    e, s = ({name: np.concatenate(v) for name, v in each.items()} for each in (errors, stated))
    cells = [percent(covered(e[name], s[name])) for name in errors]
    cells += [percent(float(np.mean(middle))), percent(float(np.mean(inside)))]
    return [*cells, f"{off}", f"{found} of {off}" if off else "–"]


def main() -> None:
    """All trajectories, with the model's interference and with five times as much."""
    warnings.simplefilter("ignore")
    labs = [laboratory(np.random.default_rng([SEED, k])) for k in range(TOOLS)]
    heads = ["well", "inclination within 95 %", "azimuth", "position in 95 % ellipsoid, middle", "at the end",
             "wells with an azimuth off by over 3σ", "of these with a finding"]  # fmt: skip
    parts = []
    for title, times in (
        ("Errors of the model's size", 1.0),
        ("Five times the model's interference along the tool", 5.0),
    ):
        rows = [
            [name, *row(labs, path, times, np.random.default_rng([SEED, 100, index, int(times)]))]
            for index, (name, path) in enumerate(trajectories().items())
        ]
        parts += [f"## {title}\n", table(heads, rows)]
    write(
        "whole_wells",
        "Wells under the error model",
        f"{WELLS} wells of {SURVEYS} surveys for each row, by {TOOLS} tools with their own calibrations. All errors "
        "are drawn from OWSG set A Rev 5.1 (MWD) by a forward model of the script alone: drift of biases and scales of "
        "every axis, interference along the tool, sag, misalignment, declination, depths and the course between "
        "stations. The truth is where the hole lies. A finding is `rejected` or `blind-to-interference`.\n",
        *parts,
        facts={"Seed": SEED, "Wells in each row": WELLS},
    )


if __name__ == "__main__":
    main()
