"""What `plan` states beforehand against simulated calibrations: parameters and angles, plan by plan.

    make scatter        (writes docs/evidence/scatter.md)

All data are simulated. It is about the prediction itself, and imports the core for its figures; a script of
your own needs `import mwdcal` alone.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
from msgspec.structs import replace as with_changes
from scipy.stats import norm

from mwdcal.calibration import results
from mwdcal.calibration.estimate import Fit, fit
from mwdcal.calibration.readings import CONSTANTS, TRIADS, Readings
from mwdcal.calibration.record import Calibration
from mwdcal.calibration.results import TWELFTHS, accuracy_at, middle_temperature
from mwdcal.estimation.problem import ANGLES
from mwdcal.files.profiles import load_profile
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import Array, reference_vectors
from mwdcal.planning.expected import expected, planned_fit
from mwdcal.planning.planned import WORKING_INCLINATIONS
from mwdcal.planning.plans import Truth, drawn, load_plan
from mwdcal.planning.session import Session
from mwdcal.sensor.profile import Datasheet, Profile, StandProfile

PLANS = ("six-state", "twelve-state", "laboratory-thermal", "moosavi-12", "moosavi-30")
SERVO = load_profile("servo")[0]
COMMON = {"azimuth_zero_deg": 0.05, "tilt_deg": 0.02, "field_nt": 30.0, "dip_deg": 0.02}
STANDS = {
    "exact": StandProfile(),
    "uncertain": SERVO.stand,
    "shared": with_changes(SERVO.stand, **COMMON),
}
"""Stands by name: without errors; with errors of each setting; with errors that all stations share, too."""
TOOLS, MANY, AT_ONCE = 2_000, 20_000, 250
"""Calibrations of each plan, and where that is too few to tell; in one fit."""
LIMIT = 0.045
"""Departure from the prediction at which `MANY` calibrations have to decide."""
SEED = 20261122


@dataclass(frozen=True)
class Errors:
    """Errors of simulated calibrations over the 1σ that was expected.

    `parameters` (B, k), `own` (B, k) over what each fit itself states, `white` (B, k) with the expected
    covariance taken out, `angles` (B, a) root mean squares over azimuth and toolface, by angle and inclination.
    """

    parameters: Array
    own: Array
    white: Array
    angles: Array

    @classmethod
    def joined(cls, parts: Iterable[Errors]) -> Errors:
        """All parts, one after the other."""
        columns = zip(*((p.parameters, p.own, p.white, p.angles) for p in parts), strict=True)
        return cls(*map(np.concatenate, columns))


def size(errors: Array) -> Array:
    """Root mean square (k,) over the calibrations."""
    return np.asarray(np.sqrt(np.mean(errors**2, 0)))


def nominal(profile: Profile) -> Profile:
    """The profile of a tool without any tolerance."""
    none = dict.fromkeys(Datasheet.__struct_fields__, 0.0)
    exact = {
        name: with_changes(getattr(profile, name), datasheet=Datasheet(**none)) for name in TRIADS
    }
    return with_changes(profile, **exact)


def errors(plan: str, stand: str, tools: str, part: int) -> Errors:
    """Of `AT_ONCE` calibrations of "nominal" or "drawn" tools, the random numbers being those of a `part`."""
    profile = with_changes(SERVO, stand=STANDS[stand])
    table = load_plan(plan)
    choice, planned = planned_fit(table, profile)
    forecast = expected(table, profile)
    reference = choice.profile.reference_temperature_c
    session, rng = Session.of(table, profile), np.random.default_rng([SEED, part])
    maker = nominal(profile) if tools == "nominal" else profile
    truth = drawn(rng, maker, max(choice.options.orders), (AT_ONCE,))
    result = fit(session.measured(truth, rng).readings, choice.options)
    exact = fit(without_noise(truth, choice.readings), choice.options)
    off = in_file(result, reference) - in_file(exact, reference)
    stated = results.to_file(result, reference)
    own = np.diagonal(stated @ result.analysis.covariance @ stated.mT, axis1=-2, axis2=-1)
    covariance = results.StatedCovariance(planned).in_file(reference)[0]
    sd = np.sqrt(np.diag(covariance))
    root = np.linalg.cholesky(covariance / np.outer(sd, sd))
    return Errors(
        off / sd,
        off / np.sqrt(own),
        np.linalg.solve(root, (off / sd).transpose()).transpose(),
        angle_errors(result, truth, forecast, choice.readings),
    )


def in_file(result: Fit, reference: float) -> Array:
    """Parameters (B, k) as in a calibration file."""
    return np.einsum("bij,bj->bi", results.to_file(result, reference), result.state.params)


def without_noise(truth: Truth, plan: Readings) -> Readings:
    """What tools read at the stations of a plan, on an exact stand."""
    vectors = reference_vectors(*(plan.known[name] for name in (*ANGLES, *CONSTANTS)))
    sd = {name: plan.sd[name] for name in TRIADS}
    return replace(plan, **truth.readings(vectors, plan.temperature), sd=sd)


def angle_errors(result: Fit, truth: Truth, forecast: Calibration, plan: Readings) -> Array:
    """Root mean square errors over their expectation (B, a): each angle at each working inclination."""
    stated = accuracy_at(forecast, WORKING_INCLINATIONS.tolist())
    constants = [plan.known[name][0] for name in CONSTANTS]
    columns = {name: [] for name in stated}
    for inclination in WORKING_INCLINATIONS:
        grid = [axis.ravel() for axis in np.meshgrid([inclination], TWELFTHS, TWELFTHS)]
        at = dict(zip(ANGLES, grid, strict=True))
        warmth = np.full(grid[0].shape, middle_temperature(forecast))
        raws = truth.readings(reference_vectors(*grid, *constants), warmth).values()
        fields = [
            triad.model.fields(result.state.params[:, where], raw, warmth)
            for triad, where, raw in zip(
                result.problem.triads, result.problem.slices(), raws, strict=True
            )
        ]
        for name, column in columns.items():
            observable = OBSERVABLES[name]
            off = observable.difference(observable.value(*fields), at[name])
            column.append(np.sqrt(np.mean(off**2, -1)))
    return np.concatenate(
        [np.stack(column, -1) / stated[name] for name, column in columns.items()], -1
    )


def simulated(pool: ProcessPoolExecutor, plan: str, stand: str, tools: str, count: int) -> Errors:
    """Errors of so many calibrations."""
    return Errors.joined(pool.map(partial(errors, plan, stand, tools), range(count // AT_ONCE)))


def departure(found: Errors) -> float:
    """How far any parameter's or angle's scatter is from the 1σ that was expected, as a share."""
    return float(np.abs(np.concatenate([size(found.parameters), size(found.angles)]) - 1).max())


def interval(ratios: Array) -> str:
    """The least and the largest ratio."""
    return f"{ratios.min():.3f} … {ratios.max():.3f}"


def chance(count: int, parameters: int) -> float:
    """How far, by sampling, the farthest of so many ratios departs from 1 in one study of twenty."""
    return float(norm.isf(0.025 / parameters) / np.sqrt(2 * count))


def cells(plan: str, stand: str, found: Errors, drawn_tools: bool) -> list[str]:
    """A row of a table."""
    count, k = found.white.shape
    row = [plan, stand, f"{count:,}", str(k), interval(size(found.parameters))]
    row += [f"± {chance(count, k):.3f}", interval(size(found.angles))]
    row += [f"{np.mean(found.white**2):.4f} ± {np.sqrt(2 / k / count):.4f}"]
    if drawn_tools:
        kept = np.percentile(found.parameters / found.own, [2.5, 97.5], axis=0)
        row += [interval(size(found.own)), interval(kept)]
    return row


def study(pool: ProcessPoolExecutor, tools: str, many: int) -> dict[str, str]:
    """A table of all plans and stands, and the largest departure of its last row of each.

    Where something departs by more than `LIMIT`, a row of `many` calibrations follows.
    """
    body, worst = [], 0.0
    for plan, stand in product(PLANS, STANDS):
        for count in (TOOLS, many):
            found = simulated(pool, plan, stand, tools, count)
            body.append(cells(plan, stand, found, tools == "drawn"))
            off = departure(found)
            print(tools, plan, stand, count, f"{100 * off:.1f} %", flush=True)
            if off <= LIMIT:
                break
        worst = max(worst, off)
    header = HEADER + (OF_DRAWN if tools == "drawn" else [])
    return {tools: table(header, body), f"worst_{tools}": f"{100 * worst:.1f} %"}


def table(header: list[str], body: Iterable[list[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *body]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


HEADER = ["plan", "stand", "calibrations", "parameters", "parameters: least … largest", "by sampling",
          "angles: least … largest", "all together"]  # fmt: skip
OF_DRAWN = ["own: least … largest", "own over planned, 95 %"]
PAGE = """# What a plan promises, and what comes

Written by `make scatter` (`examples/planning/scatter.py`); do not edit. All data are **simulated**.

`mwdcal plan` states the 1σ of every parameter and of the angles before anything is measured. Here each plan
is carried out many times with the profile `servo`, every run is calibrated, and the root mean square error of
each parameter is divided by the 1σ that the plan stated: 1 is honest. The same for inclination, toolface and
azimuth at 5, 30, 60, 90 and 120° inclination.

*Stand*: `exact`; `uncertain`, each setting off by 0.01, 0.05 and 0.02° (inclination, azimuth, toolface, 1σ);
`shared`, the same and errors that all stations have in common: azimuth zero 0.05°, tilt 0.02°, field 30 nT,
dip 0.02°.

*By sampling*: a standard deviation from N calibrations is itself uncertain by 1/√(2N), 1.6 % at 2,000. In 19
studies of 20 even the farthest parameter stays within this of 1. Where a parameter or an angle is more than
{limit:g} % off, {many:,} calibrations follow in the next row.

*All together*: the mean square of the errors with the stated covariance taken out, correlations and all, and
its sampling error. It notices what no single ratio would.

## One nominal tool, again and again

{nominal}

The largest departure of any parameter or angle, in the longer study where there are two: {worst_nominal}.

## Tools drawn within the datasheet

A plan is of a nominal tool. Real ones depart from it, by up to 5 % in scale here, and so do their
uncertainties. *Own*: errors over the 1σ that each calibration itself states. *Own over planned*: the 1σ that
a calibration states over that of the plan; the range holds 95 % of the tools, for every parameter.

{drawn}

The largest departure of any parameter or angle from the plan's 1σ, in the longer study where there are two:
{worst_drawn}. Over many tools the differences even out; of one tool the plan's 1σ is as good as the last
column says.
"""


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--many", type=int, default=MANY, help="calibrations where 2,000 cannot tell"
    )
    parser.add_argument(
        "--output", type=Path, default=Path(__file__).parents[2] / "docs/evidence/scatter.md"
    )
    chosen, parts = parser.parse_args(), {}
    with ProcessPoolExecutor() as pool:
        for tools in ("nominal", "drawn"):
            parts |= study(pool, tools, chosen.many)
    chosen.output.write_text(
        PAGE.format(many=chosen.many, limit=100 * LIMIT, **parts), encoding="utf-8"
    )
    print(f"wrote {chosen.output}")


if __name__ == "__main__":
    main()
