"""Drift within a run: how often 95 % intervals hold the tool as it was when the run began."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import world
from world import FIELD, Array

from mwdcal.calibration.automatic.drift import by_drift
from mwdcal.calibration.estimate import Fit, fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.results import StatedCovariance, unseen_drifts
from mwdcal.estimation import drift
from mwdcal.estimation.batch import take

RUNS, SEED = 200, 20260
NOISE = (1e-4, 15.0)
PROBES = [np.array(a, float) for a in ([20, 60, 100, 150], [10, 100, 200, 300], [15, 75, 160, 301])]
ANGLES = ("inclination", "azimuth", "toolface", "dip")
STEP = 1e-6
ROUNDS = (8, drift.VARIANCE_ROUNDS, 1000)
"""Repetitions of the estimate of variances that are compared; the last is its end."""


@dataclass(frozen=True)
class Case:
    """A drift of field (nT) or accelerometer (mg): 1σ per axis from end to end of a walk, or of a trend.

    `declared`: "noise", or "drift" of its true size.
    """

    kind: str
    size: float
    shape: str
    order: str
    declared: str = "–"

    @property
    def words(self) -> str:
        """The drift in words."""
        unit = "nT" if self.kind == "field" else "mg"
        return f"{self.kind} {self.size:g} {unit}, {self.shape}" if self.size else "none"


def cases() -> list[Case]:
    """The rows of the table."""
    rows = [Case("field", 0, "walk", "one after the other")]
    for order in ("one after the other", "there and back", "mixed"):
        for shape in ("walk", "trend"):
            rows += [Case("field", size, shape, order) for size in (20, 40, 60)]
            rows += [Case("accelerometer", size, shape, order) for size in (0.1, 0.2, 0.3)]
    hard = "one after the other"
    rows.append(Case("field", 40, "walk", hard, declared="noise"))
    rows.append(Case("accelerometer", 0.2, "walk", hard, declared="noise"))
    for shape in ("walk", "trend"):
        rows.append(Case("field", 40, shape, hard, declared="drift"))
        rows += [Case("accelerometer", size, shape, hard, "drift") for size in (0.1, 0.2, 0.3)]
    rows.append(Case("field", 0, "walk", "there and back"))
    return rows


def path(rng: np.random.Generator, count: int, shape: str) -> Array:
    """A drift of three axes (count, 3) from zero on."""
    if shape == "trend":
        return np.linspace(0, 1, count)[:, None] * rng.normal(size=3)
    steps = np.cumsum(rng.normal(size=(count, 3)), 0) / np.sqrt(count)
    return steps - steps[0]


def simulated(
    rng: np.random.Generator, case: Case
) -> tuple[Readings, list[tuple[world.Triad, world.Triad]]]:
    """Runs of so many tools at four directions and twelve toolfaces."""
    angles = world.grid()
    count = len(angles[0])
    path_out = np.arange(count)
    orders = {
        "one after the other": path_out,
        "there and back": np.append(path_out[::2], path_out[1::2][::-1]),
        "mixed": rng.permutation(count),
    }
    angles = tuple(each[orders[case.order]] for each in angles)
    tools = [world.tool(rng) for _ in range(RUNS)]
    turn = world.axes(*angles)
    raw: list[list[Array]] = [[], []]
    for first, second in tools:
        g, b = world.vectors(*angles)
        if case.kind == "field":
            b = b + np.einsum("nij,nj->ni", turn, case.size * path(rng, count, case.shape))
        a, m = first.raw(g), second.raw(b)
        if case.kind == "accelerometer":
            a = a + 1e-3 * case.size * path(rng, count, case.shape)
        for store, values, noise in zip(raw, (a, m), NOISE, strict=True):
            store.append(values + noise * rng.normal(size=values.shape))
    known = dict(zip(("inclination", "azimuth", "toolface"), np.radians(angles), strict=True))
    known |= {"gravity": np.ones(count), "field": np.full(count, FIELD)}
    known |= {"dip": np.full(count, np.radians(world.DIP))}
    noise = zip(("accelerometer", "magnetometer"), NOISE, strict=True)
    sd = {n: np.full((count, 3), s) for n, s in noise} if case.declared == "noise" else {}
    if case.declared == "drift":
        unit = 1.0 if case.kind == "field" else 1e-3
        sd = {f"{case.kind}-drift": np.full(count, case.size * unit)}
    return Readings(np.array(raw[0]), np.array(raw[1]), known=known, sd=sd), tools


def corrected(result: Fit, place: int, params: Array, raw: tuple[Array, Array]) -> dict[str, Array]:
    """Angles that parameters (p,) give of noise-free raw readings."""
    vectors = []
    for triad, where, values in zip(
        result.problem.triads, result.problem.slices(), raw, strict=True
    ):
        model = triad.model
        one = type(model)(model.basis, model.centre[[place]], model.scale[[place]], model.curved)
        vectors.append(one.fields(params[None, where], values[None], np.zeros((1, len(values))))[0])
    return world.angles(*vectors)


def scores(
    case: Case, rng: np.random.Generator
) -> tuple[dict[str, float], float, float, dict[str, float]]:
    """Shares of intervals that hold the truth, by quantity, of runs with a drift fitted, and with one unseen.

    And 1σ of each angle, degrees, root mean square.
    """
    readings, tools = simulated(rng, case)
    options, hits, drifted = Options(order=0), {name: [] for name in ("parameters", *ANGLES)}, 0
    widths: dict[str, list[Array]] = {name: [] for name in ANGLES}
    plain = fit(readings, options)
    unseen = [unseen_drifts(take(plain, [k])) for k in range(RUNS)]
    names = [f"{case.kind}-drift"] if case.size else [*unseen[0]]
    hidden = np.mean([any(each[name].any() for name in names) for each in unseen])
    g, b = world.vectors(*PROBES)
    truth = world.angles(g, b)
    for places, result in by_drift(plain, options):
        drifted += len(places) * bool(result.problem.walks)
        covariance = StatedCovariance(result).total
        for row, place in enumerate(places.tolist()):
            pair = tools[place]
            raw = pair[0].raw(g), pair[1].raw(b)
            params = result.state.params[row]
            true = exact(result, row, pair)
            sd = np.sqrt(np.diag(covariance[row]))
            hits["parameters"] += [np.abs(params - true) < 1.96 * sd]
            middle = corrected(result, row, params, raw)
            moved = [
                corrected(result, row, params + STEP * sd * unit, raw) for unit in np.eye(len(sd))
            ]
            root = np.linalg.cholesky(covariance[row] / np.outer(sd, sd))
            for name in ANGLES:
                slope = (
                    np.stack([world.turned(each[name] - middle[name]) for each in moved], -1) / STEP
                )
                spread = np.linalg.norm(slope @ root, axis=-1)
                widths[name] += [spread]
                hits[name] += [np.abs(world.turned(middle[name] - truth[name])) < 1.96 * spread]
    shares = {name: float(np.mean(each)) for name, each in hits.items()}
    sigmas = {name: float(np.sqrt(np.mean(np.square(each)))) for name, each in widths.items()}
    return shares, drifted / RUNS, hidden, sigmas


def exact(result: Fit, row: int, pair: tuple[world.Triad, world.Triad]) -> Array:
    """True parameters (p,) of a tool in the terms of its fit: from readings of the axes."""
    parts = []
    for triad, tool in zip(result.problem.triads, pair, strict=True):
        gain = (np.eye(3) - tool.cross) @ np.diag(1 / tool.scale[:, 0])
        offset = -(np.eye(3) - tool.cross) @ tool.bias[:, 0]
        batch = len(result.status)
        whole = triad.model.start(np.tile(gain, (batch, 1, 1)), np.tile(offset, (batch, 1)))
        parts.append(whole[row])
    return np.concatenate(parts)


def by_rounds() -> list[list[str]]:
    """Rows of some drifts, the same runs with variances after 8, 25 and 1000 rounds."""
    there = "there and back"
    some = [Case("field", 0, "walk", there), Case("field", 20, "walk", there)]
    some += [Case("accelerometer", 0.1, shape, there) for shape in ("walk", "trend")]
    some.append(Case("field", 60, "walk", "mixed"))
    usual, rows = drift.VARIANCE_ROUNDS, []
    for number, case in enumerate(some):
        for rounds in ROUNDS:
            drift.VARIANCE_ROUNDS = rounds
            shares, _, _, sigmas = scores(case, np.random.default_rng([SEED, number]))
            cells = [world.percent(share) for share in shares.values()]
            cells += [f"{sigmas[name]:.4f}°" for name in ANGLES[:2]]
            rows.append([case.words, case.order, str(rounds), *cells])
            print(*rows[-1], sep="  ", flush=True)
    drift.VARIANCE_ROUNDS = usual
    return rows


def main() -> None:
    """Simulate every row and write the page."""
    rng, rows = np.random.default_rng(SEED), []
    for case in cases():
        shares, drifted, hidden, _ = scores(case, rng)
        what = case.words
        cells = [world.percent(share) for share in shares.values()]
        rows.append([what, case.order, case.declared, f"{drifted:.0%}", f"{hidden:.0%}", *cells])
        print(*rows[-1], sep="  ", flush=True)
    heads = [
        "drift",
        "directions",
        "declared",
        "drift fitted",
        "steadiness assumed",
        "parameters",
        *ANGLES,
    ]
    more = ["drift", "directions", "rounds", "parameters", *ANGLES, "1σ inclination", "1σ azimuth"]
    world.write("drifting", "Drift within a run", INTRODUCTION, world.table(heads, rows),
                VARIANCES, world.table(more, by_rounds()),
                facts={"Runs of each row": RUNS, "Seed": SEED})  # fmt: skip


INTRODUCTION = """\
Four directions of twelve toolfaces; noise 0.1 mg and 15 nT. The drift starts at zero with the first station; its
size is 1σ per axis of where a walk ends, or of the slope of a trend. The truth is the tool, and the field of the
references, at the first station. "Drift fitted" counts the runs in which
[a drift](../../explanation/effects.md#drift-within-a-run) joined the fit. Shares are of 95 % intervals that hold the
truth.

*There and back*: every second toolface of each direction on the way out, the rest on the way back, as `plan` orders
its stations.

*Declared*: noise as it is, or the drift in its true size (`drift` and `field_drift_nt` of the
[tool profile](../../reference/profile.md)); all else is estimated.

*Steadiness assumed* counts the runs whose calibration says that this drift would not show, or any if there is none
(`assumed_exact`).

**Shortfall, and its remedy.** Where directions follow each other, a drift of the accelerometer keeps step with the
attitude and hides in gains and misalignments. No residual shows it, and those intervals cover too little unless the
drift is declared. A calibration says what it takes for granted, and what a small drift would do (`unseen`). Measure
there and back, or mix the directions; or declare the drift: the last rows hold what they state. Trends are covered
too often, because a calibration cannot know at which moment of the run its tool will be used.
"""

VARIANCES = """
## How long the variances are iterated

mwdcal stops Schall's iteration for the variances of a drift after 25 rounds, before its maximum. The same runs with
fewer and more rounds, 1σ as root mean square over the runs:
"""

if __name__ == "__main__":
    main()
