"""How often `verify` is wrong: roll tests of 1,000 good and 1,000 knocked tools, against the stated risk.

    make verification        (writes docs/evidence/verification.md)

Tools, knocks and true errors come from a forward model of this file alone; calibration and verdict
are the package's own. All data are simulated. It is about the verdict itself, and imports the core for its
limits and figures; a script of your own needs `import mwdcal` alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from math import erf, sqrt
from pathlib import Path

import numpy as np

import mwdcal
from mwdcal.files.limits import load_limits
from mwdcal.use.roll_test import extent, fitted
from mwdcal.use.verification import COVERAGE, Limits, VerdictRow

FIELD, DIP = 48_000.0, np.radians(63.0)
NOISES = ((1e-4, 15.0), (5e-4, 75.0))
"""Noise of one station, g and nT."""
PER_CALIBRATION = 50
KNOCKS = ("accelerometer bias", "magnetometer bias", "accelerometer gains", "magnetometer gains",
          "sensor block turned")  # fmt: skip
SIZES = (0.1, 3.0)
"""Smallest and largest knock: true worst figure, in units of its limit."""
SEED = 20261122
ROLL = np.arange(12) * np.pi / 6
DENSE = np.arange(360) * np.pi / 180
RULES = ("simple", "guarded")

Vectors = tuple[np.ndarray, np.ndarray]
Sensors = Callable[[Vectors], Vectors]


def vectors(inclination: np.ndarray, azimuth: np.ndarray, toolface: np.ndarray) -> Vectors:
    """Gravity (g) and field (nT) along the axes of a tool: x, y, scribe to the high side, z downhole."""
    i, a, t = np.broadcast_arrays(inclination, azimuth, toolface)
    zero = np.zeros(i.shape)
    high = np.stack([np.cos(i) * np.cos(a), np.cos(i) * np.sin(a), -np.sin(i)], -1)
    right = np.stack([-np.sin(a), np.cos(a), zero], -1)
    along = np.stack([np.sin(i) * np.cos(a), np.sin(i) * np.sin(a), np.cos(i)], -1)
    scribe = np.cos(t)[..., None] * high + np.sin(t)[..., None] * right
    axes = np.stack([np.cross(scribe, along), scribe, along], -2)  # rows: x, y, z in the earth
    earth_field = FIELD * np.array([np.cos(DIP), 0.0, np.sin(DIP)])
    return axes @ np.array([0.0, 0.0, 1.0]), axes @ earth_field


def measured(g: np.ndarray, b: np.ndarray) -> dict[str, np.ndarray]:
    """Inclination and azimuth (degrees) of the tool axis, and |g|, by geometry."""
    axis = np.array([0.0, 0.0, 1.0])
    strength = np.linalg.norm(g, axis=-1, keepdims=True)
    down = g / strength
    north = b - np.sum(b * down, -1, keepdims=True) * down
    east = np.cross(down, north)
    return {
        "inclination": np.degrees(np.arccos(down @ axis)),
        "azimuth": np.degrees(np.arctan2(east @ axis, north @ axis)),
        "gravity": strength[..., 0],
    }


def tool(rng: np.random.Generator) -> Sensors:
    """Sensors with gains, misalignments and offsets of a servo tool."""
    gain = np.eye(3) + np.stack([0.03 * rng.uniform(-1, 1, (3, 3)) for _ in range(2)])
    offset = rng.uniform(-1, 1, (2, 3)) * np.array([[0.01], [400.0]])
    return lambda pair: (pair[0] @ gain[0].T + offset[0], pair[1] @ gain[1].T + offset[1])


def knock(rng: np.random.Generator, kind: str) -> Callable[[float, Vectors], Vectors]:
    """What a knock of some size does to the vectors that the sensors see."""
    direction, matrix = rng.normal(size=3), rng.normal(size=(3, 3))
    turn = np.cross(np.eye(3), direction)

    def moved(size: float, pair: Vectors) -> Vectors:
        g, b = pair
        if kind == "accelerometer bias":
            return g + 1e-3 * size * direction, b
        if kind == "magnetometer bias":
            return g, b + 100.0 * size * direction
        if kind == "sensor block turned":
            return g + 1e-3 * size * (g @ turn), b + 1e-3 * size * (b @ turn)
        change = np.eye(3) + 1e-3 * size * matrix
        return (g @ change, b) if kind.startswith("accel") else (g, b @ change)

    return moved


def run(sensors: Sensors, pair: Vectors, rng: np.random.Generator, noise: tuple[float, float]):
    """Noisy readings of both triads."""
    return [v + s * rng.normal(size=v.shape) for v, s in zip(sensors(pair), noise, strict=True)]


def calibration(sensors: Sensors, rng: np.random.Generator, noise: tuple[float, float]):
    """The package's calibration of a sound tool: 48 stations on an exact stand."""
    inclination = np.repeat(np.radians([5.0, 45.0, 90.0, 135.0]), 12)
    azimuth, toolface = np.arange(48) * 77.0 % 360 * np.pi / 180, np.tile(ROLL, 4)
    a, m = run(sensors, vectors(inclination, azimuth, toolface), rng, noise)
    known = {"inclination": inclination, "azimuth": azimuth, "toolface": toolface}
    return mwdcal.calibrate(
        mwdcal.readings(a, m, **known, field=FIELD, dip=DIP, sd=stated(noise)), order=0
    )


def stated(noise: tuple[float, float]) -> dict[str, float]:
    """The noise as a profile declares it."""
    return dict(zip(("accelerometer", "magnetometer"), noise, strict=True))


def truth(
    made: mwdcal.Calibration, a: np.ndarray, m: np.ndarray, azimuth: float
) -> dict[str, float]:
    """The figures that `verify` judges, without noise, over the whole turn."""
    found = measured(*made.fields(mwdcal.Readings(a, m)))
    found["azimuth"] = (found["azimuth"] - np.degrees(azimuth) + 180) % 360 - 180
    spreads = {f"spread of {name}": float(np.ptp(value)) for name, value in found.items()}
    return spreads | {
        "error of inclination": float(np.abs(found["inclination"] - 45.0).max()),
        "error of azimuth": float(np.abs(found["azimuth"]).max()),
    }


@dataclass(frozen=True)
class Trial:
    """One roll test: its true figures, and what `verify` says of each."""

    true: dict[str, float]
    rows: list[VerdictRow]

    def passes(self, row: VerdictRow, rule: str) -> bool:
        """The decision on one limit."""
        guard = COVERAGE * row.uncertainty if rule == "guarded" else 0.0
        return row.value + guard <= row.limit

    def verdict(self, rule: str) -> bool:
        """The decision on all limits."""
        return all(self.passes(row, rule) for row in self.rows)

    @property
    def good(self) -> bool:
        """Whether every true figure is within its limit."""
        return all(self.true[row.name] <= row.limit for row in self.rows)

    @property
    def chance_good(self) -> float:
        """The chance that it is, by the values and uncertainties stated alone."""
        return float(np.prod([chance(row) for row in self.rows]))


def chance(row: VerdictRow) -> float:
    """The chance that a true figure is within its limit, as the row states it."""
    return 0.5 * (1 + erf((row.limit - row.value) / row.uncertainty / sqrt(2)))


def trials(rng: np.random.Generator, count: int, noise: tuple[float, float], knocked: bool):
    """Roll tests of many tools, each sort of knock alike often, sizes drawn evenly."""
    limits = load_limits("roll-test")[0]
    for number in range(count):
        if number % PER_CALIBRATION == 0:
            sensors = tool(rng)
            made = calibration(sensors, rng, noise)
        yield trial(
            rng, sensors, made, limits, noise, KNOCKS[number % len(KNOCKS)] if knocked else ""
        )


def trial(
    rng: np.random.Generator,
    sensors: Sensors,
    made: mwdcal.Calibration,
    limits: Limits,
    noise: tuple[float, float],
    kind: str,
) -> Trial:
    """One roll test at 45° and some azimuth."""
    azimuth, size = rng.uniform(0, 2 * np.pi), 0.0
    change = knock(rng, kind)
    turn = vectors(np.radians(45.0), azimuth, DENSE)
    bounds = {f"{k} of {n}": v for k in ("spread", "error") for n, v in getattr(limits, k).items()}

    def worst(at: float) -> float:
        true = truth(made, *sensors(change(at, turn)), azimuth)
        return max(true[name] / limit for name, limit in bounds.items())

    if kind:
        wanted, size = rng.uniform(*SIZES), 1.0
        for _ in range(3):
            size *= wanted / worst(size)
    a, m = run(sensors, change(size, vectors(np.radians(45.0), azimuth, ROLL)), rng, noise)
    roll_test = mwdcal.readings(a, m, inclination_deg=45.0, azimuth=azimuth, sd=stated(noise))
    result = mwdcal.verify(made, roll_test, limits)
    return Trial(truth(made, *sensors(change(size, turn)), azimuth), result.rows)


@dataclass(frozen=True)
class Rates:
    """Shares of all verdicts that are wrong, and what the stated uncertainties make of them."""

    passed: float
    passed_stated: float
    failed: float
    failed_stated: float


def rates(found: list[Trial], rule: str) -> Rates:
    """Wrong verdicts of one rule."""
    verdict = np.array([t.verdict(rule) for t in found])
    good = np.array([t.good for t in found])
    chances = np.array([t.chance_good for t in found])
    return Rates(
        passed=float((verdict & ~good).mean()),
        passed_stated=float((verdict * (1 - chances)).mean()),
        failed=float((~verdict & good).mean()),
        failed_stated=float((~verdict * chances).mean()),
    )


def at_the_limit(rng: np.random.Generator, noise: float, count: int) -> dict[str, float]:
    """Share of tools accepted whose true spread of inclination is its limit exactly, by rule."""
    share, phase = rng.uniform(0, 1, (count, 1)), rng.uniform(0, 2 * np.pi, (2, count, 1))

    def shape(t: np.ndarray) -> np.ndarray:
        return share * np.sin(t + phase[0]) + (1 - share) * np.sin(2 * t + phase[1])

    size = 0.1 / np.ptp(shape(DENSE), axis=-1)[:, None]
    value = size * shape(ROLL) + noise * rng.normal(size=(count, 12))
    curve = fitted(value, np.full(value.shape, noise), np.broadcast_to(ROLL, value.shape))
    found = extent(curve)
    return {
        "simple": float((found.range <= 0.1).mean()),
        "guarded": float((found.range + COVERAGE * found.range_sd <= 0.1).mean()),
    }


def percent(share: float, count: int = 0) -> str:
    """A share in percent, with the standard deviation of its counting where a count is given."""
    if not count:
        return f"{100 * share:.1f} %"
    return f"{100 * share:.1f} ± {100 * sqrt(max(share * (1 - share), 1 / count) / count):.1f} %"


def table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table of the page."""
    lines = [list(header)]
    lines += [["---"] * len(lines[0]), *(list(row) for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def verdict_rows(populations: dict[tuple[float, bool], list[Trial]]) -> Iterable[list[str]]:
    """Wrong verdicts by noise, tools and rule."""
    for (noise, knocked), found in populations.items():
        for rule in RULES:
            r, count = rates(found, rule), len(found)
            yield [
                f"{noise * 1e3:g} mg",
                f"{count:,} {'knocked' if knocked else 'good'}",
                rule,
                percent(r.passed, count),
                percent(r.passed_stated),
                percent(r.failed, count),
                percent(r.failed_stated),
            ]


def limit_rows(populations: dict[tuple[float, bool], list[Trial]]) -> Iterable[list[str]]:
    """Wrong decisions on each limit, knocked tools, simple rule; and the error over the 1σ."""
    for (noise, knocked), found in populations.items():
        for index, row in enumerate(found[0].rows if knocked else []):
            rows = [t.rows[index] for t in found]
            true = np.array([t.true[row.name] for t in found])
            value, sd = (np.array([getattr(r, n) for r in rows]) for n in ("value", "uncertainty"))
            wrong = (value <= row.limit) != (true <= row.limit)
            risk = np.array([min(chance(r), 1 - chance(r)) for r in rows])
            clear = true > 3 * sd
            ratio = np.sqrt(np.mean(((value - true) / sd)[clear] ** 2))
            yield [
                f"{noise * 1e3:g} mg",
                row.name,
                percent(wrong.mean(), len(found)),
                percent(risk.mean()),
                f"{ratio:.2f}",
            ]


PAGE = """# How often a verdict is wrong

Written by `make verification` (`examples/verification/verification.py`); do not edit. All data are
**simulated**, by a forward model of the script's own.

Each tool is calibrated with 48 stations and given a roll test of 12 toolfaces at 45° and any azimuth,
judged by the limits profile `roll-test`. A *good* tool is as it was at its calibration. A *knocked* one
has a bias, gains or a lean that make the worst of its true figures 0.1 to 3 times its limit, evenly
drawn. The true figures are those of the noise-free tool over the whole turn, the error of its
calibration in them.

## All limits together

A wrong PASS: some true figure is beyond its limit. A wrong FAIL: none is. *Stated*: what the values and
their 1σ in the verdicts alone make of it, with normal errors. Shares of all verdicts, with the
standard deviation of counting.

{verdicts}

The simple rule shares the risk: near a limit every other verdict is wrong, either way. The guarded one
puts it all on the tool: a wrong PASS is rare, and a tool whose true figure is less than about 4σ under
the limit may fail. That is its price, and the FAIL says so where the value itself is within the limit. At
0.5 mg one σ of the spread of inclination is a quarter of its limit: average longer before you guard.

The predicted risk does not know how many tools are good. Where all are, no PASS is wrong and more FAILs are than
predicted. And a spread that is nearly zero comes out too large, as it cannot be negative, with or without readbacks: of
95 % intervals of a spread of zero 86 % hold it, and the others lie above it.

## Each limit, knocked tools, simple rule

*Error/1σ*: root mean square of (value − true figure) over the stated 1σ, of tools whose true figure is
above 3σ; 1 is honest.

{limits}

## A tool exactly at its limit

Spread of inclination of 0.1°, limit 0.1°, first and second harmonic in any mix. By the stated risk a
simple rule accepts one in two, a guarded one 2.3 %.

{edge}
"""


def page(count: int = 1000) -> str:
    """The whole page."""
    rng = np.random.default_rng(SEED)
    populations = {
        (noise[0], knocked): list(trials(rng, count, noise, knocked))
        for noise in NOISES
        for knocked in (False, True)
    }
    edge = []
    for noise in (0.0057, 0.0115, 0.029):
        accepted = at_the_limit(rng, noise, 2 * count)
        edge.append([f"{noise}°", *(percent(accepted[rule], 2 * count) for rule in RULES)])
    return PAGE.format(
        verdicts=table(
            ["noise", "tools", "rule", "wrong PASS", "stated", "wrong FAIL", "stated"],
            verdict_rows(populations),
        ),
        limits=table(["noise", "limit", "wrong", "stated", "error/1σ"], limit_rows(populations)),
        edge=table(["noise of one inclination", "simple accepts", "guarded accepts"], edge),
    )


def main() -> None:
    """Write the page."""
    path = Path(__file__).parents[2] / "docs" / "evidence" / "verification.md"
    path.write_text(page(), encoding="utf-8")
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
