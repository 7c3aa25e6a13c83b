"""Coverage of calibrations on stands that are set per direction or per station, cautious or coarse.

Run: `make coverage STUDY=stands`, or `python examples/coverage/stands.py`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import world

from mwdcal.calibration.estimate import Fit, fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.results import StatedCovariance, triad_results
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.library.arrays import readings
from mwdcal.sensor.profile import PRACTICES

RUNS, SEED, JUDGED = 200, 24, 20
NOISE = {"accelerometer": 1e-4, "magnetometer": 15.0}
STAND = ("inclination", "azimuth", "toolface")
ANGLES = (*STAND, "dip")
FINE, MIDDLE = (0.01, 0.05, 0.02), (0.1, 0.3, 0.05)
DIRECTION, STATION = PRACTICES
WORDS = {DIRECTION: "direction", STATION: "station", "": "not stated"}
HEADS = ("stand σ", "set per", "stated", "noise", "s", "parameters", *ANGLES)


@dataclass(frozen=True)
class Case:
    """A stand's σ (degrees), how it is set and what is stated, and what is declared of the noise (0: nothing)."""

    stand: tuple[float, float, float]
    practice: str
    stated: str
    declared: float = 1.0

    @property
    def words(self) -> list[str]:
        """The first cells of a row."""
        noise = f"declared × {self.declared:g}" if self.declared else "estimated"
        sd = " / ".join(f"{value:g}°" for value in self.stand)
        return [sd, WORDS[self.practice], WORDS[self.stated], noise]


def of_practice() -> Iterator[Case]:
    """Settings per direction and per station, stated and not, with noise declared and not."""
    for stand in (FINE, MIDDLE):
        for practice in PRACTICES:
            for stated in (practice, ""):
                yield from (Case(stand, practice, stated, declared) for declared in (1.0, 0.0))


def of_caution() -> Iterator[Case]:
    """Noise that is declared three and ten times too large."""
    for practice in PRACTICES:
        yield from (Case(FINE, practice, practice, declared) for declared in (3.0, 10.0))


def of_coarseness() -> Iterator[Case]:
    """Stands whose toolface, and then all of whose angles, are coarse."""
    for size in (0.5, 1.0, 2.0):
        for declared in (1.0, 0.0):
            yield Case((0.01, 0.05, size), DIRECTION, DIRECTION, declared)
    for stand in ((0.5, 0.5, 0.5), (0.5, 1.0, 2.0)):
        for practice in PRACTICES:
            yield from (Case(stand, practice, practice, declared) for declared in (1.0, 0.0))
        yield Case(stand, STATION, "", 0.0)


def fitted(case: Case, tools: list, rng: np.random.Generator) -> Fit:
    """Fits of one run of each tool, each on a stand with errors of its own."""
    attitude = world.grid()
    shape = (len(tools), len(attitude[0]))
    directions = np.arange(shape[1]) // 12 if case.practice == DIRECTION else np.arange(shape[1])
    setting = directions, directions, np.arange(shape[1])
    true = [
        angle + sd * rng.normal(size=shape)[:, number]
        for angle, sd, number in zip(attitude, case.stand, setting, strict=True)
    ]
    raw = [
        np.stack([pair[t].raw(field) for pair, field in zip(tools, fields, strict=True)])
        + noise * rng.normal(size=(*shape, 3))
        for t, (fields, noise) in enumerate(zip(world.vectors(*true), NOISE.values(), strict=True))
    ]
    known = {f"{n}_deg": np.broadcast_to(a, shape) for n, a in zip(STAND, attitude, strict=True)}
    sd = {f"{name}_deg": value for name, value in zip(STAND, case.stand, strict=True)}
    if case.declared:
        sd |= {name: case.declared * value for name, value in NOISE.items()}
    earth = {"gravity": 1.0, "field": world.FIELD, "dip_deg": world.DIP}
    return fit(readings(*raw, sd=sd, settings=case.stated, **known, **earth), Options(order=0))


def angles(
    result: Fit, covariance: np.ndarray, tools: list, rng: np.random.Generator
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Error and stated 1σ (B, JUDGED), degrees, of each angle at random attitudes."""
    size = (len(tools), JUDGED)
    tilt = np.degrees(np.arccos(rng.uniform(-0.9, 0.95, size)))
    attitude = tilt, rng.uniform(0, 360, size), rng.uniform(0, 360, size)
    vectors, change = [], np.zeros((*size, 6, covariance.shape[-1]))
    for t, (field, where) in enumerate(
        zip(world.vectors(*attitude), result.problem.slices(), strict=True)
    ):
        raw = np.stack([pair[t].raw(f) for pair, f in zip(tools, field, strict=True)])
        model, params = result.problem.triads[t].model, result.state.params[:, where]
        vectors.append(model.fields(params, raw, np.zeros(size)))
        change[..., 3 * t : 3 * t + 3, where] = model.jacobian(params, raw, np.zeros(size))
    seen, each = world.angles(*vectors), []
    for name, true in zip(ANGLES, (*attitude, world.DIP), strict=True):
        row = np.einsum("bni,bnip->bnp", OBSERVABLES[name].gradient(*vectors), change)
        sd = np.degrees(np.sqrt(np.einsum("bnp,bpq,bnq->bn", row, covariance, row)))
        each.append((world.turned(seen[name] - true), sd))
    return each


def parameters(result: Fit, covariance: np.ndarray, tools: list) -> tuple[np.ndarray, np.ndarray]:
    """Error and stated 1σ (B, 24) of the parameters of both triads: field = A raw + c."""
    errors, sds = [], []
    for t in (0, 1):
        triad = triad_results(result, t, covariance, [[]] * len(tools), reference=30.0)
        seen = [np.diag(p[t].scale[:, 0]) @ np.linalg.inv(np.eye(3) - p[t].cross) for p in tools]
        back = np.linalg.inv(seen)
        offset = np.stack([p[t].scale[:, 0] * p[t].bias[:, 0] for p in tools])
        true = triad.model.start(back, -np.einsum("bij,bj->bi", back, offset))
        errors.append(triad.parameters - true)
        sds.append(triad.sd)
    return np.concatenate(errors, -1), np.concatenate(sds, -1)


def row(case: Case, rng: np.random.Generator) -> list[str]:
    """One row of a table."""
    tools = [world.tool(rng) for _ in range(RUNS)]
    result = fitted(case, tools, rng)
    assert (result.status == 0).all(), case
    covariance = StatedCovariance(result).total
    judged = [parameters(result, covariance, tools), *angles(result, covariance, tools, rng)]
    s = np.sqrt(result.analysis.variance_factor.mean())
    return [*case.words, f"{s:.2f}", *(world.percent(world.covered(*each)) for each in judged)]


def main() -> None:
    """Write the page."""
    rng = np.random.default_rng(SEED)
    parts = [
        "Runs of twelve toolfaces at each of four directions (5°, 45°, 90° and 135°). The true noise is 0.1 mg and "
        "15 nT. Each cell is the share of errors within 1.96 stated standard uncertainties: of all parameters, and of "
        f"angles at {JUDGED} random attitudes of each run. With {RUNS} runs a share of 95 % scatters by 1.5 % where "
        "one error of a run moves all its attitudes alike. *stand σ* is of inclination, azimuth and toolface; *s* the "
        "root of the mean of s².\n"
    ]
    sections = {
        "How often the stand is set": of_practice(),
        "Noise declared too large": of_caution(),
        "Coarse stands": of_coarseness(),
    }
    for title, cases in sections.items():
        parts += [f"## {title}\n", world.table(HEADS, [row(case, rng) for case in cases])]
    facts = {"Runs per row": RUNS, "Seed": SEED}
    world.write("stands", "Coverage: settings and size of the stand's errors", *parts, facts=facts)


if __name__ == "__main__":
    main()
