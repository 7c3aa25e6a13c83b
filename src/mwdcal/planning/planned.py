"""A plan with what it will give, and the best plan that candidate stations allow."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from mwdcal.calibration import results
from mwdcal.calibration.automatic.auto import Choice
from mwdcal.calibration.calibrate import recorded
from mwdcal.calibration.diagnosis.flags import listed
from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.prediction import TWELFTHS, accuracy_at, angles, readings_at
from mwdcal.calibration.record import Calibration
from mwdcal.errors import FitError, InputError
from mwdcal.estimation.evidence import ANGLES
from mwdcal.files.formats.table import Table, labels
from mwdcal.geometry.vectors import Array
from mwdcal.planning.expected import expected, left_undetermined, planned_fit
from mwdcal.planning.moves import USUAL_STAND, Stand, session_seconds, shortest_order
from mwdcal.planning.optimal import Design, Information, best
from mwdcal.planning.plans import (
    at_place,
    at_temperatures,
    attitudes,
    joined,
    load_plan,
    soak_numbers,
    taken,
)
from mwdcal.sensor.profile import Profile

WORKING_INCLINATIONS = np.radians([5.0, 30.0, 60.0, 90.0, 120.0])
"""Inclinations over which an I-optimal plan makes the angles accurate."""
WORKING_TEMPERATURES = 7
"""Temperatures, evenly from the coldest to the hottest soak, at which a wanted accuracy holds."""
FEWEST_PLANNED = 8
"""Stations with which the search for the smallest plan begins."""
MOST_SEARCHED = 1_000_000
"""Product of stations and candidates in a search: a minute."""
OUT_NAMED = 5
"""Stations out of reach that are named."""
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
        InputError: the plan does not state an attitude, or one that the stand cannot reach, or the profile not
            the noise.
        FitError: no calibration can come of the plan; the message says what to add.
    """
    _check_reached(plan, stand)
    calibration = expected(plan, profile, options)
    others = at_temperatures(_reached(candidates or load_plan("candidates"), stand), plan)
    whole = joined(plan, others)
    information, _ = Information.of_fit(planned_fit(whole, profile, options)[1])
    share = Design(information, np.arange(whole.count) < plan.count).efficiency
    return Planned(
        plan, calibration, share, session_seconds(attitudes(plan), soak_numbers(plan), stand)
    )


def best_plan(
    candidates: Table | None,
    count: int,
    profile: Profile,
    options: Options | None = None,
    criterion: str = "D",
    stand: Stand = USUAL_STAND,
    measured: Table | None = None,
) -> Planned:
    """The best stations out of candidates that the stand reaches, `count` of them beside those already `measured`.

    Without `candidates` the built-in ones, at the temperatures of those measured. They come in an order of short
    moves. Raises as `judged`.
    """
    search = Search.of(candidates, profile, options, criterion, stand, measured)
    return search.planned(search.best(count))


def smallest_plan(
    candidates: Table | None,
    accuracy_deg: Mapping[str, float],
    profile: Profile,
    options: Options | None = None,
    criterion: str = "I",
    stand: Stand = USUAL_STAND,
    measured: Table | None = None,
) -> Planned:
    """The best plan of the fewest stations that gives wanted accuracies, 1σ in degrees by angle.

    An accuracy holds at every one of `WORKING_INCLINATIONS`, from the coldest soak to the hottest. Raises as
    `judged`, and `InputError` where all candidates together do not give it.
    """
    search = Search.of(candidates, profile, options, criterion, stand, measured)
    _check_determined(search.calibration, accuracy_deg)
    if not _reaches(search.calibration, accuracy_deg):
        raise InputError(
            f"all {search.most} candidates together do not give the wanted accuracy. Add candidates, "
            "average longer at each, or use a more exact stand."
        )
    best = cache(search.best)

    def enough(count: int) -> bool:
        try:
            return _reaches(search.given(best(count)), accuracy_deg)
        except FitError:  # too few for a calibration
            return False

    high = min(FEWEST_PLANNED, search.most)
    while high < search.most and not enough(high):
        high = min(2 * high, search.most)
    counts = range(1 if high == FEWEST_PLANNED else 1 + high // 2, high + 1)
    least = counts[min(bisect_left(counts, True, key=enough), len(counts) - 1)]
    return search.planned(best(least))


@dataclass(frozen=True)
class Search:
    """A search among the stations of `plan`, of which the first `before` are measured already.

    `information` of each of them, the directions `turn` (k, r) in which it is, of the file's parameters; `choice`
    and `result` are of the fit of all.
    """

    plan: Table
    before: int
    profile: Profile
    options: Options | None
    criterion: str
    stand: Stand
    information: Information
    turn: Array
    choice: Choice
    result: Fit

    @classmethod
    def of(
        cls, candidates: Table | None, profile: Profile, options: Options | None, criterion: str, stand: Stand,
        measured: Table | None,
    ) -> Search:  # fmt: skip
        """The search among candidates, as far as the stand reaches. Raises as `judged`."""
        if criterion not in CRITERIA:
            raise InputError(
                f"`criterion` must be one of {', '.join(CRITERIA)}; got {criterion!r}."
            )
        inside = _reached(candidates or load_plan("candidates"), stand)
        whole = inside
        if measured:
            inside = at_place(inside, measured) if candidates else at_temperatures(inside, measured)
            whole = replace(joined(measured, inside), source=inside.source)
        choice, result = planned_fit(whole, profile, options)
        information, turn = Information.of_fit(result)
        to_file = results.to_file(result, choice.profile.reference_temperature_c)[0]
        before = whole.count - inside.count
        return cls(
            whole, before, profile, options, criterion, stand, information, to_file @ turn, choice, result
        )  # fmt: skip

    @property
    def most(self) -> int:
        """The number of candidates."""
        return self.plan.count - self.before

    @cached_property
    def calibration(self) -> Calibration:
        """The calibration that all candidates together give."""
        return recorded(self.choice, self.result)

    @cached_property
    def wanted(self) -> Array | None:
        """The weights W of `optimal.best` (r, r)."""
        if self.criterion == "D":
            return None
        if self.criterion == "A":
            sd = np.sqrt(np.sum(self.turn**2, -1))
            scaled = self.turn / np.where(sd > 0, sd, np.inf)[:, None]
            return np.asarray(scaled.mT @ scaled)
        return self._of_angles()

    def _of_angles(self) -> Array:
        """Mean variance of the angles over the working range, each in units of what all candidates give."""
        grid = np.meshgrid(WORKING_INCLINATIONS, TWELFTHS, TWELFTHS, indexing="ij")
        inclination, azimuth, toolface = (axis.ravel() for axis in grid)
        whole = np.zeros((self.turn.shape[1],) * 2)
        for temperature in self._temperatures():
            readings = readings_at(self.calibration, inclination, azimuth, toolface, temperature)
            for name in angles(self.calibration):
                moved = self.calibration.sensitivity(name, readings) @ self.turn
                whole += moved.mT @ moved / np.sum(moved**2)
        return whole

    def _temperatures(self) -> list[float] | list[None]:
        """Over the calibrated range, more than its temperature terms could pass through."""
        low, high = self.calibration.temperature_c or (0.0, 0.0)
        order = max(self.choice.options.orders)
        return np.linspace(low, high, order + 2).tolist() if order else [None]

    def best(self, count: int) -> Design:
        """The best so many stations beside those measured."""
        if not 1 <= count <= self.most:
            raise InputError(
                f"`stations` must be between 1 and the {self.most} candidates; got {count}."
            )
        if count * self.plan.count > MOST_SEARCHED:
            raise InputError(
                f"the best {count} of {self.most} candidates take too long to find: the product of both must not "
                f"exceed {MOST_SEARCHED}. Take a coarser grid of candidates, or fewer `stations`."
            )
        kept = np.arange(self.plan.count) < self.before
        return best(self.information, self.before + count, self.wanted, kept)

    def given(self, design: Design) -> Calibration:
        """The calibration that chosen stations and those measured give."""
        options = replace(self.options or Options(), order=self.choice.options.order)
        return expected(taken(self.plan, design.chosen), self.profile, options)

    def planned(self, design: Design) -> Planned:
        """The chosen stations, but those measured, in an order of short moves."""
        new = design.chosen[self.before :]
        new = new[np.argsort(soak_numbers(taken(self.plan, new)), kind="stable")]
        some = taken(self.plan, new)
        order = shortest_order(attitudes(some), soak_numbers(some), self.stand)
        source = f"{len(new)} of {self.plan.source}"
        plan = replace(taken(self.plan, new[order]), source=source)
        seconds = session_seconds(attitudes(plan), soak_numbers(plan), self.stand)
        return Planned(plan, self.given(design), design.efficiency, seconds)


def _check_reached(plan: Table, stand: Stand) -> None:
    """Refuse a plan with stations that the stand does not reach; the message names them."""
    inside = stand.within(attitudes(plan))
    for name, reached in zip(ANGLES, inside.mT, strict=True):
        if not reached.all():
            low, high = stand.reach[name]
            names = labels(plan, "station") or [str(k + 1) for k in range(plan.count)]
            out = listed([names[k] for k in np.flatnonzero(~reached)], OUT_NAMED)
            raise InputError(
                f"{plan.source}: the stand reaches {name} {low:g}:{high:g}°, and station {out} lie outside. Leave "
                "them out, or widen `reach`."
            )


def _reached(candidates: Table, stand: Stand) -> Table:
    """The candidates that the stand reaches; refuses where there are none."""
    inside = stand.within(attitudes(candidates)).all(-1)
    if not inside.any():
        reach = ", ".join(f"{name} {low:g}:{high:g}°" for name, (low, high) in stand.reach.items())
        raise InputError(
            f"{candidates.source}: no candidate is within what the stand reaches, {reach}. Name a plan of "
            "attitudes that it does reach."
        )
    return candidates if inside.all() else taken(candidates, np.flatnonzero(inside))


def _check_determined(calibration: Calibration, accuracy_deg: Mapping[str, float]) -> None:
    """Refuse to want the accuracy of an angle that cannot have any."""
    sd = accuracy_at(calibration, WORKING_INCLINATIONS.tolist())
    for name in accuracy_deg:
        if name not in sd:
            raise InputError(
                f"the accuracy of {name} cannot be wanted: the tool gives {', '.join(sd)}."
            )
        if np.isnan(sd[name]).any():
            free = left_undetermined(calibration)[0].text
            raise InputError(f"the accuracy of {name} cannot be wanted: {free}.")


def _reaches(calibration: Calibration, accuracy_deg: Mapping[str, float]) -> bool:
    """Whether every wanted accuracy holds at all working inclinations and temperatures."""
    span = calibration.temperature_c
    temperatures = np.linspace(*span, WORKING_TEMPERATURES).tolist() if span else [None]
    for at in temperatures:
        sd = accuracy_at(calibration, WORKING_INCLINATIONS.tolist(), temperature=at)
        if not all(np.degrees(sd[name]).max() <= most for name, most in accuracy_deg.items()):
            return False
    return True
