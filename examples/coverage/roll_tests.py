"""Wrong verdicts of roll tests near their limits, against the risk that each verdict states.

    make coverage STUDY=roll_tests        (writes docs/evidence/coverage/roll_tests.md)

A tool is knocked after its calibration so that the worst of its true figures is 0.8 to 1.2 of its limit, and given a
roll test. Tools, knocks, settings of the stand and true figures come from `world` alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import world
from scipy.stats import norm

import mwdcal
from mwdcal.files.limits import load_limits
from mwdcal.use.verification import Bounds, Limits, Verdict

SEED, RUNS, TOOLS = 20261123, 400, 4
NOISE = (2e-4, 30.0)
"""Noise of one station, g and nT."""
STAND = 0.05
"""1σ of a setting of the stand's inclination, where it counts, degrees."""
CIRCLE = np.arange(0.0, 360.0, 3.0)
SIZES = (0.8, 0.9, 1.0, 1.1, 1.2)
SPREADS = Limits(name="spreads", spread=load_limits("roll-test")[0].spread)
ERRORS = Limits(name="errors", error=Bounds(inclination_deg=0.25))


@dataclass(frozen=True)
class Case:
    """Roll sets of a test at inclinations, their toolfaces, and whether noise is declared.

    `stand`: each set has an error of its setting, references instead of groups, and is judged by its errors.
    """

    name: str
    inclinations: tuple[float, ...]
    toolfaces: int
    declared: bool = True
    stand: bool = False

    @property
    def limits(self) -> Limits:
        """What it is judged by."""
        return ERRORS if self.stand else SPREADS


def equal(sets: int, toolfaces: int, **more: bool) -> Case:
    """Sets of one direction."""
    return Case(f"{sets} alike" if sets > 1 else "1", (45.0,) * sets, toolfaces, **more)


def varied(sets: int, toolfaces: int, **more: bool) -> Case:
    """Sets at inclinations from 20° to 80°, where a knock shows differently."""
    return Case(f"{sets} different", tuple(np.linspace(20, 80, sets)), toolfaces, **more)


CASES = (
    *(equal(1, n) for n in (4, 6, 8, 12, 24)),
    *(equal(sets, n) for sets, n in ((2, 8), (4, 12), (6, 6))),
    *(varied(sets, n) for sets, n in ((2, 12), (3, 8), (5, 6), (6, 12), (6, 24))),
    *(equal(n, 6, declared=False) for n in (1, 6)),
    varied(3, 8, declared=False),
    *(equal(n, 12, stand=True) for n in (1, 3)),
)


@dataclass(frozen=True)
class Trial:
    """A verdict, and the worst true figure of the tool in units of its limit."""

    verdict: Verdict
    size: float

    @property
    def good(self) -> bool:
        """Whether the tool is within all limits."""
        return self.size <= 1

    @property
    def expected(self) -> float:
        """Chance of a wrong verdict on a tool of this size, if the stated 1σ of its worst row is right."""
        worst = max(self.verdict.rows, key=lambda row: row.value / row.limit)
        return float(norm.cdf(-abs(self.size - 1) * worst.limit / worst.uncertainty))

    @property
    def wrong(self) -> bool:
        """Whether the verdict is."""
        return self.verdict.passed != self.good


def calibration(rng: np.random.Generator, tool, declared: bool):
    """The package's calibration of a sound tool: 24 stations, references exact."""
    attitude = world.grid(toolfaces=6)
    names = ("inclination_deg", "azimuth_deg", "toolface_deg")
    raw = readings(rng, tool, world.vectors(*attitude))
    known = dict(zip(names, attitude, strict=True))
    return mwdcal.calibrate(
        mwdcal.readings(*raw, **known, field=world.FIELD, dip_deg=world.DIP, sd=noise(declared)),
        order=0,
    )


def readings(rng: np.random.Generator, tool, vectors: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Noisy readings of both triads."""
    each = zip(tool, vectors, NOISE, strict=True)
    return [triad.raw(v) + sd * rng.normal(size=v.shape) for triad, v, sd in each]


def noise(declared: bool) -> dict[str, float] | None:
    """The noise as a profile declares it, or nothing."""
    return dict(zip(("accelerometer", "magnetometer"), NOISE, strict=True)) if declared else None


@dataclass(frozen=True)
class Knocked:
    """A calibrated tool with a bias (3,) of its accelerometer that the calibration has not seen, in roll sets."""

    made: mwdcal.Calibration
    tool: tuple[world.Triad, world.Triad]
    case: Case
    inclination: np.ndarray
    azimuth: np.ndarray

    def worst(self, knock: np.ndarray) -> float:
        """The worst true figure of all sets over the whole turn, in units of its limit."""
        at = np.unique(np.stack([self.inclination, self.azimuth], -1), axis=0)[:, :, None]
        g, b = world.vectors(at[:, 0], at[:, 1], CIRCLE)
        raw = self.tool[0].raw(g + knock), self.tool[1].raw(b)
        seen = world.angles(*self.made.fields(mwdcal.Readings(*raw)))
        if self.case.stand:
            return float(
                np.abs(seen["inclination"] - at[:, 0]).max() / ERRORS.error.inclination_deg
            )
        seen["azimuth"] = world.turned(seen["azimuth"] - at[:, 1])
        limits = dict(SPREADS.spread.items())
        return max(float(np.ptp(seen[name], axis=-1).max() / most) for name, most in limits.items())

    def knock(self, rng: np.random.Generator, size: float) -> np.ndarray:
        """A bias by which the worst true figure is so many limits."""
        turn = rng.uniform(0, 2 * np.pi)
        along = np.array([0.0, 0.0, 1.0]) if self.case.stand else [np.cos(turn), np.sin(turn), 0.0]
        knock = 1e-3 * np.asarray(along)
        for _ in range(6):
            knock = knock * size / self.worst(knock)
        return knock


def trial(rng: np.random.Generator, made, tool, case: Case, size: float) -> Trial:
    """One roll test of a tool whose worst true figure is so many limits."""
    sets, count = len(case.inclinations), case.toolfaces
    nominal = np.array(case.inclinations)
    azimuth = (rng.uniform(0, 360) + 60.0 * np.arange(sets) * case.stand) % 360
    true = nominal + STAND * rng.normal(size=sets) * case.stand
    knocked = Knocked(made, tool, case, true, azimuth)
    knock = knocked.knock(rng, size)
    toolface = np.tile(np.arange(count) * 360.0 / count, sets)
    g, b = world.vectors(np.repeat(true, count), np.repeat(azimuth, count), toolface)
    raw, sd = readings(rng, tool, (g + knock, b)), noise(case.declared) or {}
    if case.stand:
        known = {
            "inclination_deg": np.repeat(nominal, count),
            "azimuth_deg": np.repeat(azimuth, count),
        }
        sd = sd | {"inclination_deg": STAND}
    else:
        known = {"group": [str(each) for each in np.repeat(np.arange(sets), count)]}
    verdict = mwdcal.verify(made, mwdcal.readings(*raw, **known, sd=sd), case.limits)
    return Trial(verdict, size)


def trials(rng: np.random.Generator, case: Case, sizes: Iterable[float]) -> list[Trial]:
    """Roll tests of a few tools in turn."""
    tools = [world.tool(rng) for _ in range(TOOLS)]
    made = [calibration(rng, tool, case.declared) for tool in tools]
    return [
        trial(rng, made[k % TOOLS], tools[k % TOOLS], case, size) for k, size in enumerate(sizes)
    ]


def row(rng: np.random.Generator, case: Case) -> tuple[list[str], list[Trial]]:
    """As many tests at each size: share that passes there, rate of wrong verdicts, and the mean of what they state."""
    found = trials(rng, case, np.resize(SIZES, RUNS))
    wrong, stated = np.mean([t.wrong for t in found]), np.mean([t.verdict.risk for t in found])
    last = found[-1].verdict.rows[0].degrees_of_freedom
    cells = [case.name, str(case.toolfaces), "declared" if case.declared else "estimated"]
    cells += ["error, set once" if case.stand else "spread", "∞" if last is None else f"{last:.0f}"]
    error = np.sqrt(wrong * (1 - wrong) / RUNS)
    passed = [
        np.mean([t.verdict.passed for t in found[k :: len(SIZES)]]) for k in range(len(SIZES))
    ]
    cells += [f"{100 * wrong:.1f} ± {100 * error:.1f} %", world.percent(stated)]
    cells.append(world.percent(np.mean([t.expected for t in found])))
    return [*cells, *(f"{share:.0%}" for share in passed)], found


def reliability(found: Sequence[Trial]) -> Iterable[list[str]]:
    """Verdicts by the risk that they state: how many are wrong."""
    risk = np.array([t.verdict.risk for t in found])
    wrong = np.array([t.wrong for t in found])
    edges = (0.0, 0.02, 0.1, 0.2, 0.3, 0.4, 0.5, 1.0)
    for low, high in pairwise(edges):
        some = (risk >= low) & (risk < high)
        if some.any():
            stated = world.percent(risk[some].mean())
            yield [
                f"{low:.0%} to {high:.0%}",
                str(some.sum()),
                stated,
                world.percent(wrong[some].mean()),
            ]


def main() -> None:
    """Write the page."""
    rows, found = [], []
    for number, case in enumerate(CASES):
        cells, each = row(np.random.default_rng([SEED, number]), case)
        print(*cells, flush=True)
        rows.append(cells)
        found += each
    heads = ["roll sets", "toolfaces", "noise", "judged", "DoF", "wrong", "stated", "by its 1σ"]
    world.write(
        "roll_tests",
        "Roll tests near their limits",
        ABOUT,
        world.table([*heads, *(f"passes at {size:g}" for size in SIZES)], rows),
        BY_RISK,
        world.table(["stated risk", "verdicts", "mean stated", "wrong"], reliability(found)),
        facts={"Runs of each row": RUNS, "Seed": SEED},
    )


ABOUT = """A tool is calibrated with 24 stations, and then knocked: its accelerometer has a bias by which the
worst of its true figures, over all roll sets and limits, is 0.8, 0.9, 1, 1.1 or 1.2 of its limit. A verdict is
*wrong* if it passes a tool beyond a limit, or fails one within all. *Stated*: the mean of `risk`. *By its 1σ*: the
chance of a wrong verdict on tools of these sizes, if the stated 1σ is right. Where it agrees with *wrong* the 1σ holds;
it lies above *stated*, because `risk` allows for tools of any size and these are all close to the limit. Noise 0.2 mg,
30 nT. Sets *alike* are of one direction, *different* ones at 20° to 80° of inclination. *Set once*: each set has its
own setting of the stand, 1σ 0.05°, and its error is judged. DoF: degrees of freedom of the 1σ of the first limit.
*Passes at*: share of tests by the worst true figure; at 1 it should be one half. Judged by the largest of six sets
alike it would be 1.6 %.
"""
BY_RISK = """
## By the risk that is stated

All verdicts above. A tool exactly at its limit counts as within, so that its fails are wrong. A stated risk
allows for tools of any size. Here all are within 20 % of their limit, so that small risks come out too small.
"""

if __name__ == "__main__":
    main()
