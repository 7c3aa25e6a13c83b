"""A plan with what it will give, and the best plan that candidate stations allow."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import cast

import numpy as np

from mwdcal.calibration import results
from mwdcal.calibration.calibrate import recorded
from mwdcal.calibration.options import Options
from mwdcal.calibration.prediction import TWELFTHS, accuracy_at, angles, readings_at
from mwdcal.calibration.record import Calibration
from mwdcal.errors import FitError, InputError
from mwdcal.files.formats.table import Table
from mwdcal.geometry.vectors import Array
from mwdcal.planning.expected import expected, planned_fit
from mwdcal.planning.moves import USUAL_STAND, Stand, session_seconds, shortest_order
from mwdcal.planning.optimal import Information, best, efficiency
from mwdcal.planning.plans import at_temperatures, attitudes, joined, load_plan, soak_numbers, taken
from mwdcal.sensor.profile import Profile

WORKING_INCLINATIONS = np.radians([5.0, 30.0, 60.0, 90.0, 120.0])
"""Inclinations over which an I-optimal plan makes the angles accurate."""
WORKING_TEMPERATURES = 7
"""Temperatures, evenly from the coldest to the hottest soak, at which a wanted accuracy holds."""
FEWEST_PLANNED = 8
"""Stations with which the search for the smallest plan begins."""
CRITERIA = ("D", "A", "I")
"""What a best plan is best in: all parameters together, each of them, the angles."""


@dataclass(frozen=True)
class Planned:
    """A plan and the calibration that it will give.

    `efficiency` is at least the share of the best possible D-value, per parameter, that as many stations
    could have; `seconds` the session at the stand.
    """

    plan: Table
    calibration: Calibration
    efficiency: float
    seconds: float


def judged(
    plan: Table,
    profile: Profile,
    options: Options | None = None,
    stand: Stand = USUAL_STAND,
    candidates: Table | None = None,
) -> Planned:
    """What a plan will give; its efficiency is among its own stations and the `candidates` at its temperatures.

    Raises:
        InputError: the plan does not state an attitude, or the profile not the noise.
        FitError: no calibration can come of the plan; the message says what to add.
    """
    calibration = expected(plan, profile, options)
    whole = joined(plan, at_temperatures(candidates or load_plan("candidates"), plan))
    information, *_ = _information(whole, profile, options)
    share = efficiency(information, np.arange(whole.count) < plan.count)
    return Planned(
        plan, calibration, share, session_seconds(attitudes(plan), soak_numbers(plan), stand)
    )


def best_plan(
    candidates: Table,
    count: int,
    profile: Profile,
    options: Options | None = None,
    criterion: str = "D",
    stand: Stand = USUAL_STAND,
    measured: Table | None = None,
) -> Planned:
    """The best stations out of candidates, `count` of them beside those already `measured`.

    They come in an order of short moves; the order of temperature terms is that of all candidates. Raises as
    `judged`.
    """
    if criterion not in CRITERIA:
        raise InputError(f"`criterion` must be one of {', '.join(CRITERIA)}; got {criterion!r}.")
    before = measured.count if measured else 0
    whole = joined(measured, candidates) if measured else candidates
    if not 1 <= count <= candidates.count:
        raise InputError(
            f"`stations` must be between 1 and the {candidates.count} candidates; got {count}."
        )
    information, turn, calibration, fixed = _information(whole, profile, options)
    wanted = _wanted(criterion, turn, calibration)
    kept = np.arange(whole.count) < before
    design = best(information, before + count, wanted, kept)
    new = design.chosen[design.chosen >= before]
    new = new[np.argsort(soak_numbers(taken(whole, new)), kind="stable")]
    chosen = taken(whole, new)
    new = new[shortest_order(attitudes(chosen), soak_numbers(chosen), stand)]
    plan = replace(taken(whole, new), source=f"{count} of {candidates.source}")
    everything = taken(whole, np.concatenate([np.arange(before), new]))
    given = expected(everything, profile, fixed)
    return Planned(
        plan, given, design.efficiency, session_seconds(attitudes(plan), soak_numbers(plan), stand)
    )


def smallest_plan(
    candidates: Table,
    accuracy_deg: Mapping[str, float],
    profile: Profile,
    options: Options | None = None,
    criterion: str = "I",
    stand: Stand = USUAL_STAND,
) -> Planned:
    """The best plan of the fewest stations that gives wanted accuracies, 1σ in degrees by angle.

    An accuracy holds at every one of `WORKING_INCLINATIONS`, from the coldest soak to the hottest. Raises as
    `judged`, and `InputError` where all candidates together do not give it.
    """
    if not _reached(expected(candidates, profile, options), accuracy_deg):
        raise InputError(
            f"all {candidates.count} candidates together do not give the wanted accuracy. Add candidates, "
            "average longer at each, or use a more exact stand."
        )

    @cache
    def plan(count: int) -> Planned | None:
        """The best plan of so many stations; None where they are too few for a calibration."""
        try:
            return best_plan(candidates, count, profile, options, criterion, stand)
        except FitError:
            return None

    def enough(count: int) -> bool:
        result = plan(count)
        return result is not None and _reached(result.calibration, accuracy_deg)

    high = FEWEST_PLANNED
    while high < candidates.count and not enough(high):
        high = min(2 * high, candidates.count)
    counts = range(1 + high // 2, high + 1)
    least = counts[min(bisect_left(counts, True, key=enough), len(counts) - 1)]
    return cast(Planned, plan(least))


def _reached(calibration: Calibration, accuracy_deg: Mapping[str, float]) -> bool:
    """Whether every wanted accuracy holds at all working inclinations and temperatures."""
    span = calibration.temperature_c
    temperatures = np.linspace(*span, WORKING_TEMPERATURES).tolist() if span else [None]
    each = [
        accuracy_at(calibration, WORKING_INCLINATIONS.tolist(), temperature=t) for t in temperatures
    ]
    sd = {name: np.stack([one[name] for one in each]) for name in each[0]}
    unknown = [name for name in accuracy_deg if name not in sd]
    if unknown:
        raise InputError(
            f"the accuracy of {unknown[0]} cannot be wanted: the tool gives {', '.join(sd)}."
        )
    return all(np.degrees(sd[name]).max() <= limit for name, limit in accuracy_deg.items())


def _information(
    plan: Table, profile: Profile, options: Options | None
) -> tuple[Information, Array, Calibration, Options]:
    """Of every station of a plan, the directions it is in, the calibration that all give, and how it is fitted."""
    choice, result = planned_fit(plan, profile, options)
    information, turn = Information.of_fit(result)
    to_file = results.to_file(result, choice.profile.reference_temperature_c)[0]
    return information, to_file @ turn, recorded(choice, result), choice.options


def _wanted(criterion: str, turn: Array, calibration: Calibration) -> Array | None:
    """The weights W of `best` (r, r); `turn` (k, r) gives the file's parameters."""
    if criterion == "D":
        return None
    if criterion == "A":
        sd = np.sqrt(np.diag(calibration.parameter_covariance))
        scaled = turn / np.where(sd > 0, sd, np.inf)[:, None]
        return np.asarray(scaled.T @ scaled)
    grid = np.meshgrid(WORKING_INCLINATIONS, TWELFTHS, TWELFTHS, indexing="ij")
    whole = np.zeros((turn.shape[1],) * 2)
    for temperature in calibration.temperature_c or (None,):
        readings = readings_at(
            calibration, grid[0].ravel(), grid[1].ravel(), grid[2].ravel(), temperature
        )
        for name in angles(calibration):
            moved = calibration.sensitivity(name, readings) @ turn
            whole += moved.T @ moved / np.sum(moved**2)
    return whole
