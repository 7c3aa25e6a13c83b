"""Runs in the order of a plan: what `plan` states beforehand, what `calibrate` states, and what is true.

Run: `make coverage STUDY=plans`, or `python examples/coverage/plans.py`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import world
from msgspec.structs import replace as with_changes

from mwdcal.calibration import results
from mwdcal.calibration.automatic.drift import by_drift
from mwdcal.calibration.diagnosis.findings import LEAST_SHOWN
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.results import middle_temperature
from mwdcal.estimation.problem import ANGLES
from mwdcal.files.profiles import load_profile
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import Array, tool_from_earth
from mwdcal.planning.expected import expected, planned_fit
from mwdcal.planning.planned import best_plan
from mwdcal.planning.plans import drawn, simulated
from mwdcal.planning.session import Session
from mwdcal.sensor.profile import PRACTICES, Profile

RUNS, SEED, INCLINATION = 400, 29, np.radians(45.0)
SERVO = load_profile("servo")[0]
STANDS = ((0.01, 0.05, 0.02), (0.1, 0.3, 0.05))
COUNTS = (16, 24, 48)
WORDS = dict(zip((*PRACTICES, ""), ("direction", "station", "not stated"), strict=True))
AROUND = tuple(axis.ravel() for axis in np.meshgrid(*[np.radians([20.0, 140.0, 260.0])] * 2))
"""Azimuths and toolfaces at which errors are taken."""
HEADS = (
    "stations", "stand σ", "set per", "stated", "set apart", "drift", "σ / plan", "with drift, σ / plan",
    "error / plan", *ANGLES,
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A number of stations, a stand's σ (degrees), how it is set and what is stated of that."""

    count: int
    stand: tuple[float, float, float]
    practice: str
    stated: str

    @property
    def profile(self) -> Profile:
        """The profile of the tool, with what is stated of the stand."""
        sd = dict(zip((f"{name}_deg" for name in ANGLES), self.stand, strict=True))
        stated = {"settings": self.stated} if self.stated else {}
        return with_changes(SERVO, stand=with_changes(SERVO.stand, **sd, **stated))


def cases() -> Iterator[Case]:
    """Both practices, stated and not."""
    for count in COUNTS:
        for stand in STANDS[: 1 + (count == 24)]:
            for practice in PRACTICES:
                yield from (Case(count, stand, practice, stated) for stated in (practice, ""))


def around(truth: object, result: object, plan: object) -> dict[str, Array]:
    """Errors (B, k) of each angle at 45° inclination, radians, of corrected readings without noise."""
    at = dict(zip(ANGLES, (np.full(AROUND[0].shape, INCLINATION), *AROUND), strict=True))
    attitude = tool_from_earth(*at.values())
    earth = (
        np.array([0.0, 0.0, truth.gravity]),
        truth.field * np.array([np.cos(truth.dip), 0.0, np.sin(truth.dip)]),
    )
    warmth = np.full(AROUND[0].shape, middle_temperature(plan))
    raws = truth.readings(tuple(attitude @ vector for vector in earth), warmth).values()
    fields = [
        triad.model.fields(result.state.params[:, where], raw, warmth)
        for triad, where, raw in zip(
            result.problem.triads, result.problem.slices(), raws, strict=True
        )
    ]
    return {n: OBSERVABLES[n].difference(OBSERVABLES[n].value(*fields), at[n]) for n in ANGLES}


def row(case: Case, rng: np.random.Generator) -> list[str]:
    """One row of the table."""
    profile = case.profile
    table = best_plan(None, case.count, SERVO).plan
    planned = expected(table, profile)
    choice, session = planned_fit(table, profile)[0], Session.of(table, profile)
    truth = drawn(rng, profile, 0, (RUNS,))
    nature = replace(session.readings, settings=case.practice)
    made = simulated(truth, nature, rng).readings
    result = fit(replace(made, settings=case.stated), choice.options)
    apart = result.problem.evidence.apart > LEAST_SHOWN
    error = {name: np.zeros((RUNS, len(AROUND[0]))) for name in ANGLES}
    sd, drift = {name: np.zeros(RUNS) for name in ANGLES}, np.zeros(RUNS, bool)
    for places, part in by_drift(result, choice.options):
        drift[places] = bool(part.problem.walks)
        some = replace(
            truth,
            accelerometer=truth.accelerometer[places],
            magnetometer=truth.magnetometer[places],
        )
        tools = results.calibrated_tools(
            part, [[] for _ in places], planned.reference_temperature, prior=None
        )
        covariance = results.StatedCovariance(part).total
        for name, stated in results.accuracy(tools, covariance).items():
            sd[name][places] = stated
        for name, off in around(some, part, planned).items():
            error[name][places] = off
    forecast = results.accuracy_at(planned, [INCLINATION])
    over = {name: sd[name] / forecast[name][0] for name in ANGLES}

    def mean(some: Array) -> str:
        if not some.any():
            return "–"
        return " / ".join(f"{over[name][some].mean():.2f}" for name in ANGLES)

    true = [np.sqrt(np.mean(error[name] ** 2)) / forecast[name][0] for name in ANGLES]
    wide = {name: np.broadcast_to(sd[name][:, None], error[name].shape) for name in ANGLES}
    covered = [world.covered(error[name], wide[name]) for name in ANGLES]
    return [
        str(case.count), " / ".join(f"{value:g}°" for value in case.stand), WORDS[case.practice],
        WORDS[case.stated], world.percent(apart.mean()), world.percent(drift.mean()), mean(~drift), mean(drift),
        " / ".join(f"{value:.2f}" for value in true), *map(world.percent, covered),
    ]  # fmt: skip


def main() -> None:
    """Write the page."""
    rng = np.random.default_rng(SEED)
    text = (
        "The best stations of `mwdcal plan` in its order, with the noise of `servo`. *Stand σ* is of inclination, "
        "azimuth and toolface. *Set apart*: runs with the finding `settings-apart`, 1 % of those where it is "
        "wrong. *Drift*: runs whose fit allows for a drift; no run has one. *σ / plan* is the stated 1σ of "
        "inclination / azimuth / toolface at 45° over that of the plan, the mean of the runs without and with such "
        "a drift, and *error / plan* the root mean square error. The last columns are the errors within 1.96 "
        "stated standard uncertainties.\n"
    )
    facts = {"Runs per row": RUNS, "Seed": SEED}
    parts = [text, world.table(HEADS, [row(case, rng) for case in cases()])]
    world.write("plans", "Coverage: runs in the order of a plan", *parts, facts=facts)


if __name__ == "__main__":
    main()
