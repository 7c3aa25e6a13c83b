"""A plan with what it will give, and the best plan that candidate stations allow.

How long a session at the stand takes, and the order of stations that makes it short.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np
from msgspec.structs import replace as with_fields

from mwdcal.calibration import results
from mwdcal.calibration.automatic.auto import Choice
from mwdcal.calibration.calibrate import recorded
from mwdcal.calibration.diagnosis.detection import Detection, detections
from mwdcal.calibration.diagnosis.findings import FEW_FREEDOM
from mwdcal.calibration.diagnosis.flags import listed
from mwdcal.calibration.diagnosis.identity import UNIDENTIFIED
from mwdcal.calibration.diagnosis.plausibility import freedom_of
from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.options import ASSUMED_PRACTICE, Options
from mwdcal.calibration.readings import TRIADS
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.calibration.results import TWELFTHS, accuracy_at, angles, readings_at
from mwdcal.errors import FitError, InputError
from mwdcal.estimation.problem import ANGLES
from mwdcal.files.formats.table import Table, labels
from mwdcal.geometry.vectors import Array, Bools, Ints
from mwdcal.planning.expected import (
    assumed_noise,
    carried_out,
    drift_unforeseen,
    expected,
    left_undetermined,
    planned_fit,
    temperature_terms_lost,
)
from mwdcal.planning.optimal import (
    WEIGHINGS,
    Design,
    Information,
    best,
    evenly,
    exchanged,
    least_count,
    least_worst,
    typical_sd,
)
from mwdcal.planning.plans import (
    at_place,
    at_temperatures,
    attitudes,
    joined,
    load_plan,
    soak_numbers,
    soak_temperatures,
    taken,
    without_estimates,
)
from mwdcal.sensor.profile import PRACTICES, Profile

AT_ENDS_WITHIN = 1e-6
"""A setting so little beyond what the stand reaches is within it, degrees."""


USUAL_SOAK = 90.0
"""Minutes until a tool has the temperature of its next soak."""
WITHOUT_OVEN = (10.0, 35.0)
"""Coldest and hottest one temperature of a session that needs no oven, °C."""


@dataclass(frozen=True)
class Stand:
    """How fast a stand is: its axes move at the same time.

    `degrees_per_second` of an axis, `settle_seconds` between the end of a move and the reading,
    `soak_minutes` until the tool has the temperature of the next soak; None: `USUAL_SOAK`, and no soak at all where
    the session needs no oven. `reach`: the least and the largest
    setting by angle, degrees; azimuth and toolface without one turn round and round.
    """

    degrees_per_second: float = 5.0
    settle_seconds: float = 30.0
    soak_minutes: float | None = None
    reach: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse a stand that does not move or reaches nothing, and times below zero.

        Raises `InputError`.
        """
        if not 0 < self.degrees_per_second < np.inf:
            raise InputError(
                f"`speed` must be more than 0 degrees per second; got {self.degrees_per_second:g}."
            )
        for name, value in (
            ("settle", self.settle_seconds),
            ("soak", self.soak_minutes or 0.0),
        ):
            if not 0 <= value < np.inf:
                raise InputError(f"`{name}` must be a time of 0 or more; got {value:g}.")
        for name, (low, high) in self.reach.items():
            least, most = (0, 180) if name == ANGLES[0] else (-360, 360)
            if name not in ANGLES or not (least <= low <= high <= most and high - low <= 360):
                raise InputError(
                    f"`reach` must be of {', '.join(ANGLES)}, such as inclination_deg=0:120, from the least setting to "
                    f"the largest; got {name}={low:g}:{high:g}."
                )

    def settings(self, attitude: Array) -> Array:
        """Settings (n, 3) of attitudes (n, 3), degrees: whole turns added to be above the least."""
        settings = attitude.copy()
        for place, name in enumerate(ANGLES):
            if name in self.reach and place:
                low = self.reach[name][0] - AT_ENDS_WITHIN
                settings[:, place] = low + (attitude[:, place] - low) % 360
        return settings

    def within(self, attitude: Array) -> Bools:
        """Which angles (n, 3) of attitudes (n, 3), degrees, the stand reaches."""
        low, high = np.transpose([self.reach.get(name, (-np.inf, np.inf)) for name in ANGLES])
        settings = self.settings(attitude)
        return np.asarray((settings >= low - AT_ENDS_WITHIN) & (settings <= high + AT_ENDS_WITHIN))


USUAL_STAND = Stand()
"""A stand of usual speed."""


def move_seconds(attitude: Array, stand: Stand) -> Array:
    """Seconds (n, n) from each station to each other, of attitudes (n, 3) in degrees.

    Azimuth and toolface go the shorter way round, but for one whose reach has ends.
    """
    settings = stand.settings(attitude)
    difference = np.abs(settings[:, None] - settings)
    round_and_round = [name != ANGLES[0] and name not in stand.reach for name in ANGLES]
    shorter = np.minimum(difference % 360, -difference % 360)
    difference = np.where(round_and_round, shorter, difference)
    return np.asarray(difference.max(-1) / stand.degrees_per_second + stand.settle_seconds)


def session_seconds(plan: Table, stand: Stand) -> float:
    """Duration of a session, from its first soak to its last reading, of stations in order."""
    seconds = move_seconds(attitudes(plan), stand)
    moves = float(seconds[np.arange(plan.count - 1), np.arange(1, plan.count)].sum())
    return stand.settle_seconds + moves + soak_seconds(plan, stand)


def soak_seconds(plan: Table, stand: Stand) -> float:
    """Duration of all soaks of a session: one for each change of temperature, and the first."""
    warmth = soak_temperatures(plan)
    least, most = WITHOUT_OVEN
    oven = len(warmth) > 1 or bool(np.any((warmth < least) | (warmth > most)))
    usual = USUAL_SOAK if oven else 0.0
    changes = int(np.count_nonzero(np.diff(soak_numbers(plan))))
    return 60.0 * (usual if stand.soak_minutes is None else stand.soak_minutes) * (1 + changes)


def measuring_order(attitude: Array, soak: Ints) -> Ints:
    """An order (n,) of the stations of each soak for a stand turned by hand: its slow axes move last.

    `attitude` (n, 3) in degrees. Toolface turns at each station; of inclination and azimuth, which are levelled and
    aligned anew, one moves only when the other has been through all its settings, and the order of the two is the one
    with fewer moves. The slowest axis visits every other setting on its way out and the rest on its way back, the
    others go up and down in turn: a slow drift does not keep step with the attitude. The soaks keep their order.
    """
    _, first, number = np.unique(soak, return_index=True, return_inverse=True)
    visit, both = np.argsort(np.argsort(first))[number], []
    for axes in ([1, 0, 2], [0, 1, 2]):
        keys = attitude[:, axes]
        keys[:, 0] = _out_and_back(keys[:, 0])
        both.append(_serpentine(keys, visit))
    moves = [int(np.count_nonzero(np.diff(attitude[order, :2], axis=0))) for order in both]
    return both[int(np.argmin(moves))]


def _out_and_back(setting: Array) -> Ints:
    """The place (n,) of each setting among those visited: every other one upwards, the rest downwards.

    >>> _out_and_back(np.array([5.0, 30, 60, 90, 120])).tolist()
    [0, 4, 1, 3, 2]
    """
    levels, rank = np.unique(setting, return_inverse=True)
    upwards = np.arange(len(levels))
    visits = np.concatenate([upwards[::2], upwards[1::2][::-1]])
    return np.asarray(np.argsort(visits)[rank])


def _serpentine(keys: Array, soak: Ints) -> Ints:
    """An order (n,) by soak, then by each key (n, k): up and down in turn, so that no key jumps back to its start."""
    if keys.shape[-1] == 0:
        return np.argsort(soak, kind="stable")
    order = _serpentine(keys[:, :-1], soak)
    outer = np.column_stack([soak, keys[:, :-1]])[order]
    group = np.cumsum(np.any(np.diff(outer, axis=0, prepend=outer[:1]) != 0, axis=-1))
    return order[np.lexsort((keys[order, -1] * (-1.0) ** group, group))]


WORKING_INCLINATIONS = np.radians([5.0, 30.0, 60.0, 90.0, 120.0])
"""Inclinations over which an I-optimal plan makes the angles accurate; at 0° azimuth and toolface are undefined."""
WORKING_TEMPERATURES = 7
"""Temperatures, evenly from the coldest to the hottest soak, at which a wanted accuracy holds."""
ACCURACY_MARGIN = 1e-6
"""A search aims at wanted accuracies smaller by this share, for rounding not to decide."""
LEAP = 50
"""A search for the smallest plan adds one station at a time, beyond this many a share of one in as many."""
MOST_SEARCHED = 1_000_000
"""Product of stations and candidates in a search: a minute."""
FEW_LEVELS = 3
"""So many inclinations are few."""
OUT_NAMED = 5
"""Stations out of reach that are named."""
CRITERIA = ("D", "A", "I")
"""Aim of a best plan: all parameters together, each of them, the angles."""
SEARCH_STEPS = WEIGHINGS + 2 * len(CRITERIA)
"""Steps in which a number of stations is tried: weighings, then exchanges by each criterion, then plans of these."""


@dataclass(frozen=True)
class Levels:
    """The few inclinations of a best plan, of those that the candidates have, degrees.

    `cost`: how many times its 1σ, by its `criterion`, as many stations have that are evenly at all of them.
    """

    used: list[float]
    offered: list[float]
    criterion: str
    cost: float


@dataclass(frozen=True)
class Planned:
    """A plan and the calibration that it will give.

    `efficiency` is at least the share of the best possible D-value, per parameter, that as many stations
    could have; `seconds` the session at the stand, `soaking` those of them in soaks. `freedom` (t,) are the degrees of
    freedom of each triad's s, and `detections` (1, n) the errors of one station that `calibrate` will report, those
    `measured` already before the plan's. No plan of fewer than `bound` stations gives the wanted accuracy, if one is;
    `search` says what the search has to say, `assumed` which noise the profile does not state. `set_anew` works out
    the calibration on a stand that is set at every station, `compared` the inclinations of a best plan, if few.
    `tool` is the calibration whose profile, noise and place it takes, if it takes any.
    """

    plan: Table
    calibration: Calibration
    efficiency: float
    seconds: float
    freedom: Array
    soaking: float
    detections: Mapping[str, Detection]
    set_anew: Callable[[], Calibration]
    stand: Stand
    measured: int = 0
    bound: int | None = None
    search: list[Finding] = field(default_factory=list)
    assumed: list[Finding] = field(default_factory=list)
    compared: Callable[[], Levels | None] = lambda: None
    tool: Calibration | None = None

    @classmethod
    def of(
        cls, plan: Table, whole: Table, profile: Profile, options: Options | None, efficiency: float,
        stand: Stand, measured: int = 0,
    ) -> Planned:  # fmt: skip
        """A plan with the calibration that it will give; `whole` also has the stations measured already."""
        calibration, result = carried_out(whole, profile, options)
        anew = with_fields(profile, stand=with_fields(profile.stand, settings=PRACTICES[1]))
        return cls(
            plan,
            calibration,
            efficiency,
            seconds=session_seconds(plan, stand),
            freedom=freedom_of(result)[0],
            soaking=soak_seconds(plan, stand),
            detections=detections(result),
            set_anew=partial(expected, whole, anew, options),
            stand=stand,
            measured=measured,
            assumed=assumed_noise(profile),
        )

    @cached_property
    def per_station(self) -> Calibration | None:
        """The calibration on a stand that is set at every station, where nobody says how often it is."""
        return self.set_anew() if self.calibration.settings == ASSUMED_PRACTICE else None

    @property
    def stated(self) -> Table:
        """The plan as its run states it: without the field and dip that the calibration of the tool estimated."""
        return without_estimates(self.plan, self.tool) if self.tool else self.plan

    @property
    def inclinations(self) -> Array:
        """Working inclinations within the stand's reach, radians; all of them where none is."""
        low, high = self.stand.reach.get(ANGLES[0], (0.0, 180.0))
        inside = (np.radians(low) <= WORKING_INCLINATIONS) & (
            np.radians(high) >= WORKING_INCLINATIONS
        )
        return WORKING_INCLINATIONS[inside] if inside.any() else WORKING_INCLINATIONS

    @property
    def hidden(self) -> dict[str, list[int]]:
        """Stations of the plan, from 0, an error of which is never traced to them, by observable."""
        each = {n: np.isinf(d.named[0, self.measured :]) for n, d in self.detections.items()}
        return {name: np.flatnonzero(some).tolist() for name, some in each.items() if some.any()}

    @property
    def is_redundant(self) -> bool:
        """Whether s is known, and a wrong setting of any one station can be traced to it."""
        return bool(np.all(self.freedom >= FEW_FREEDOM)) and not set(self.hidden) & set(ANGLES)

    def hides(self) -> tuple[bool, int]:
        """Whether it is not redundant, and how many errors hide."""
        return not self.is_redundant, sum(map(len, self.hidden.values()))

    @property
    def findings(self) -> list[Finding]:
        """Remarks that calibration and search will make, and which errors hide."""
        stations = sorted({k for some in self.hidden.values() for k in some})
        named = [station_names(self.plan)[k] for k in stations]
        text = (
            f"calibrate cannot trace a wrong {', '.join(self.hidden)} to station {listed(named, OUT_NAMED)}, however "
            "wrong it is: the residuals of all stations grow alike. Add stations."
        )
        hidden = [Finding(id="hidden-errors", text=text)] if stations else []
        expected = [f for f in self.calibration.findings if f.id != UNIDENTIFIED]  # of no tool yet
        return [*expected, *hidden, *self.assumed, *self.search]


def with_tool(planned: Planned, tool: object) -> Planned:
    """A plan with its `tool`, a calibration: it says if it lacks temperature terms that this has, or a drift."""
    if not isinstance(tool, Calibration):
        return planned
    lost = temperature_terms_lost(tool, planned.calibration)
    remarks = [*planned.assumed, *lost, *drift_unforeseen(tool)]
    return replace(planned, assumed=remarks, tool=tool)


def judged(
    plan: Table,
    profile: Profile,
    options: Options | None = None,
    stand: Stand = USUAL_STAND,
    candidates: Table | None = None,
) -> Planned:
    """The result of a plan; its efficiency is among its own stations and the `candidates` at its temperatures.

    Raises:
        InputError: the plan does not state an attitude, or one that the stand cannot reach, or the profile
            neither scale nor noise of a triad.
        FitError: no calibration can come of the plan; the message says what to add.
    """
    _check_reached(plan, stand)
    others = at_temperatures(_reached(candidates or load_plan("candidates"), stand), plan)
    whole = joined(plan, others)
    information, _ = Information.of_fit(planned_fit(whole, _set_anew(profile), options)[1])
    share = Design(information, np.arange(whole.count) < plan.count).efficiency
    return Planned.of(plan, plan, profile, options, share, stand)


def best_plan(
    candidates: Table | None,
    count: int,
    profile: Profile,
    options: Options | None = None,
    criterion: str = "D",
    stand: Stand = USUAL_STAND,
    measured: Table | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Planned:
    """The best stations out of candidates that the stand reaches, `count` of them beside those already `measured`.

    Without `candidates` the built-in ones, at the temperatures of those measured. They come in an order of short
    moves. Raises as `judged`.
    """
    search = Search.of(candidates, profile, options, criterion, stand, measured)
    progress(1, 3)
    design = search.best(count)
    progress(2, 3)
    return search.planned(design)


def smallest_plan(
    candidates: Table | None,
    accuracy_deg: Mapping[str, float],
    profile: Profile,
    options: Options | None = None,
    stand: Stand = USUAL_STAND,
    measured: Table | None = None,
    count: int | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Planned:
    """The plan of the fewest stations that gives wanted accuracies, 1σ in degrees by angle, and is redundant.

    An accuracy holds at every one of `WORKING_INCLINATIONS`, from the coldest soak to the hottest. Redundant:
    `Planned.is_redundant`. With a `count` the plan has so many stations, whatever they give. Raises as `judged`, and
    `InputError` where all candidates together do not give the accuracy.
    """
    search = Search.of(candidates, profile, options, "I", stand, measured)
    _check_determined(search.calibration, accuracy_deg)
    wanted = search.variances(accuracy_deg)
    if count:
        return search.least_worst(count, wanted, partial(_tell, progress, 0))
    if not _reaches(search.calibration, accuracy_deg):
        raise InputError(
            f"all {search.most} candidates together do not give the wanted accuracy. Add candidates, "
            "average longer at each, or use a more exact stand."
        )
    bound = least_count(search.information, wanted, search.kept, search.plan.count) - search.before
    least = max(bound, search.fewest(0))
    result, enough = _grown(search, least, wanted, accuracy_deg, progress)
    bound = max(bound, search.fewest(FEW_FREEDOM))
    return replace(result, bound=bound, search=_of_search(bound, enough, result.plan.count))


def _tell(progress: Callable[[int, int], None], tried: int, done: int) -> None:
    """Tell how much of a search is done after a number of counts `tried`, and of how much known so far."""
    progress(SEARCH_STEPS * tried + done, SEARCH_STEPS * (tried + 1))


def _grown(
    search: Search, count: int, wanted: Array, accuracy_deg: Mapping[str, float],
    progress: Callable[[int, int], None],
) -> tuple[Planned, int]:  # fmt: skip
    """The first plan from a `count` of stations on that is accurate and redundant, and how many are accurate."""
    enough = tried = 0
    while True:
        count = min(count, search.most)
        try:
            result = search.least_worst(count, wanted, partial(_tell, progress, tried))
        except FitError:  # too few for a calibration
            if count == search.most:
                raise
        else:
            accurate = _reaches(result.calibration, accuracy_deg)
            enough = enough or count * accurate
            if (accurate and result.is_redundant) or count == search.most:
                return result, enough or count
        count += 1 + count // LEAP
        count = max(count, search.fewest(FEW_FREEDOM)) if enough else count
        tried += 1


def _of_search(bound: int, enough: int, count: int) -> list[Finding]:
    """Remark of a search that ends with a `count` of stations: `enough` gave the accuracy."""
    said = []
    if count > bound:
        text = (
            f"fewer may do: a plan of {bound} stations is not ruled out, although the search found none. Fewer than "
            f"{bound} cannot give the accuracy and {FEW_FREEDOM:.0f} degrees of freedom."
        )
        said.append(Finding(id="fewer-may-do", text=text))
    if count > enough:
        text = (
            f"{enough} stations give the accuracy. {count} also give {FEW_FREEDOM:.0f} degrees of freedom and trace a "
            f"wrong setting of any one station. For fewer add `stations` {enough}."
        )
        said.append(Finding(id="redundancy", text=text))
    return said


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
        check_criterion(criterion)
        inside = _reached(candidates or load_plan("candidates"), stand)
        whole = inside
        if measured:
            inside = at_place(inside, measured) if candidates else at_temperatures(inside, measured)
            whole = replace(joined(measured, inside), source=inside.source)
        choice, result = planned_fit(whole, _set_anew(profile), options)
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
    def kept(self) -> Bools:
        """Which stations (n,) are measured already."""
        return np.arange(self.plan.count) < self.before

    @cached_property
    def calibration(self) -> Calibration:
        """The calibration that all candidates together give."""
        return recorded(self.choice, self.result)

    @cached_property
    def wanted(self) -> dict[str, Array | None]:
        """The weights W of `optimal.best` (r, r) by criterion."""
        sd = np.sqrt(np.sum(self.turn**2, -1))
        scaled = self.turn / np.where(sd > 0, sd, np.inf)[:, None]
        return {"D": None, "A": scaled.mT @ scaled, "I": self._of_angles()}

    def _of_angles(self) -> Array:
        """Mean variance of the angles over the working range, each in units of what all candidates give."""
        whole = np.zeros((self.turn.shape[1],) * 2)
        for temperature in self._temperatures():
            for name in angles(self.calibration):
                moved = self._moved(name, temperature)
                whole += np.einsum("kai,kaj->ij", moved, moved) / np.sum(moved**2)
        return whole

    def variances(self, accuracy_deg: Mapping[str, float]) -> Array:
        """The variances (c, r, r) of wanted angles where `_reaches` looks at them, in units of their limits."""
        span = self.calibration.temperature_c
        each = []
        for temperature in np.linspace(*span, WORKING_TEMPERATURES).tolist() if span else [None]:
            for name, most in accuracy_deg.items():
                moved = self._moved(name, temperature)
                each.append(
                    moved.mT
                    @ moved
                    / moved.shape[1]
                    / (np.radians(most) * (1 - ACCURACY_MARGIN)) ** 2
                )
        return np.concatenate(each)

    def _moved(self, name: str, temperature: float | None) -> Array:
        """Changes (i, a, r) of an angle at `WORKING_INCLINATIONS` by the directions `turn`."""
        grid = np.meshgrid(WORKING_INCLINATIONS, TWELFTHS, TWELFTHS, indexing="ij")
        inclination, azimuth, toolface = (axis.ravel() for axis in grid)
        readings = readings_at(self.calibration, inclination, azimuth, toolface, temperature)
        moved = self.calibration.sensitivity(name, readings) @ self.turn
        return np.reshape(moved, (len(WORKING_INCLINATIONS), -1, moved.shape[-1]))

    def _temperatures(self) -> list[float] | list[None]:
        """Over the calibrated range, more than its temperature terms could pass through."""
        low, high = self.calibration.temperature_c or (0.0, 0.0)
        order = max(self.choice.options.orders)
        return np.linspace(low, high, order + 2).tolist() if order else [None]

    def best(self, count: int) -> Design:
        """The best so many stations beside those measured."""
        self._check_size(count)
        return best(self.information, self.before + count, self.wanted[self.criterion], self.kept)

    def least_worst(self, count: int, wanted: Array, tell: Callable[[int], None]) -> Planned:
        """The best so many stations by the largest of variances.

        Where all are within 1 there is freedom left: of plans that use it, each for another criterion, that is taken
        which hides the fewest errors. Raises `FitError` where no calibration can come of so few.
        """
        self._check_size(count)
        start, largest = least_worst(self.information, self.before + count, wanted, self.kept, tell)
        choices = [start]
        if largest <= 1:
            choices = []
            for done, criterion in enumerate(CRITERIA, WEIGHINGS):
                tell(done)
                aim = self.wanted[criterion]
                choices.append(exchanged(self.information, start, aim, self.kept, wanted))
        elif not np.isfinite(largest):
            raise FitError(f"{count} stations cannot give a calibration. Add stations.")
        plans = []
        for done, members in enumerate(choices, SEARCH_STEPS - len(choices)):
            tell(done)
            plans.append(self.planned(Design(self.information, members)))
        return min(plans, key=Planned.hides)

    def fewest(self, freedom: float) -> int:
        """Fewer stations, beside those measured, cannot give a triad so many degrees of freedom."""
        known = self.choice.options.knowledge is not None
        unknowns = 0 if known else max(triad.rank for triad in self.calibration.triads)
        return max(1, math.ceil((unknowns + freedom) / 3) - self.before)

    def _check_size(self, count: int) -> None:
        """Refuse more stations than candidates, and a search that would take hours."""
        if not 1 <= count <= self.most:
            raise InputError(
                f"`stations` must be between 1 and the {self.most} candidates; got {count}."
            )
        if count * self.plan.count > MOST_SEARCHED:
            raise InputError(
                f"the best {count} of {self.most} candidates take too long to find: the product of both must not "
                f"exceed {MOST_SEARCHED}. Take a coarser grid of candidates, or fewer `stations`."
            )

    def planned(self, design: Design) -> Planned:
        """The chosen stations, but those measured, in the order to measure them."""
        new = design.chosen[self.before :]
        new = new[np.argsort(soak_numbers(taken(self.plan, new)), kind="stable")]
        some = taken(self.plan, new)
        new = new[measuring_order(self.stand.settings(attitudes(some)), soak_numbers(some))]
        chosen, count = taken(self.plan, new), f"{len(new)} station{'s' * (len(new) > 1)}"
        stated = {**chosen.metadata, "plan": f"best {count}"}
        plan = replace(chosen, source=f"Best {count}", metadata=stated)
        whole = taken(self.plan, np.append(design.chosen[: self.before], new))
        options = replace(self.options or Options(), order=self.choice.options.order)
        result = Planned.of(
            plan, whole, self.profile, options, design.efficiency, self.stand, self.before
        )
        return replace(result, compared=partial(self._levels, design.members))

    def _levels(self, members: Bools) -> Levels | None:
        """The inclinations of a plan and the cost of more of them, where they are few and there are more."""
        offered, group = np.unique(attitudes(self.plan)[:, 0], return_inverse=True)
        used, count = np.unique(group[members]), np.count_nonzero(members)
        if self.before or len(used) > FEW_LEVELS or not len(used) < len(offered) <= count:
            return None
        wanted = self.wanted[self.criterion]
        even = evenly(self.information, members, wanted, group)
        least, spread = (typical_sd(self.information, some, wanted) for some in (members, even))
        return Levels(offered[used].tolist(), offered.tolist(), self.criterion, spread / least)


def check_criterion(criterion: str) -> None:
    """Refuse a criterion that is not one of `CRITERIA`."""
    if criterion not in CRITERIA:
        raise InputError(
            f"`criterion` must be one of {', '.join(CRITERIA)}; got {criterion!r}. Choose one of them."
        )


def station_names(plan: Table) -> list[str]:
    """The labels of the stations of a plan, their numbers where it has none."""
    return labels(plan, "station") or [str(k + 1) for k in range(plan.count)]


def _set_anew(profile: Profile) -> Profile:
    """The profile as it is for stations without an order: a stand that is set anew at each, and no drift.

    Only an order says which ones share a setting, and what a drift does.
    """
    steady = {name: with_fields(getattr(profile, name), drift=0.0) for name in TRIADS}
    stand = with_fields(profile.stand, settings="per-station", field_drift_nt=0.0)
    return with_fields(profile, stand=stand, **steady)


def _check_reached(plan: Table, stand: Stand) -> None:
    """Refuse a plan with stations that the stand does not reach; the message names them."""
    inside = stand.within(attitudes(plan))
    for name, reached in zip(ANGLES, inside.mT, strict=True):
        if not reached.all():
            low, high = stand.reach[name]
            names = station_names(plan)
            out = listed([names[k] for k in np.flatnonzero(~reached)], OUT_NAMED)
            raise InputError(
                f"{plan.source}: the stand reaches {name} {low:g}:{high:g}°, and station {out} lie outside. Let "
                "`stations` choose others, leave them out, or widen `reach`."
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
