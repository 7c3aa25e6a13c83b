"""A tool's calibrations put into common parameters, and what of them cannot be compared."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date, timedelta
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.special import ndtri

from mwdcal.calibration.readings import NANOTESLA, SOAK_GAP, TRIADS
from mwdcal.calibration.record import FREE_SHARE, MARGIN, Calibration, TriadCalibration
from mwdcal.calibration.results import (
    UNKNOWN_GRAVITY,
    CalibratedTools,
    accuracy,
    angle_changes,
    raw_reading,
    unknown_gravity,
)
from mwdcal.drift.document import ServiceRow
from mwdcal.drift.walk import (
    ANY_TEMPERATURE,
    DAYS_PER_YEAR,
    FACTOR_NAMES,
    FIELD_DIRECTIONS,
    VISIT,
    WALK_GROUPS,
    History,
    common_noise_scale,
    factored,
    group_places,
    parameter_names,
    precisions,
    years,
)
from mwdcal.geometry.vectors import AnyArray, Array, Bools, outer, square_root
from mwdcal.sensor.models import Basis, Factors
from mwdcal.use.verification import Verdict, VerdictRow

NOTES = {
    "no-overlap": "not compared: its temperatures, {low:.0f}…{high:.0f} °C, and those of later calibrations, {others}, "
    "have none in common",
    "again": "not compared: it has stations in common with the calibration of {later}, which counts instead",
    "prior": "has an earlier calibration as its prior: a change shows less, and no rate is learnt from it",
    "unrecorded": "its run recorded no temperature: taken as made where the others were",
    "no-magnetometer": "has no magnetometer: only the accelerometer is compared",
    "relative": "its magnetometer is calibrated to field = 1: scale and bias are compared but for a common factor",
    "gravity": "its run states no ref_gravity_g: local gravity is unknown to 1.5 mg, which all scales of the "
    "accelerometer share; such a common change is no change of the tool",
    "gravity-alike": "its run states no ref_gravity_g, like all others: compared as if all were made at one "
    "place",
    "curved": "the {triad} has own-axis terms: its best straight line is compared",
    "held": "its model holds misalignments at zero: they are not compared",
    "free": "leaves undetermined: {free}: the others are compared",
    "model": "the {triad} has the model '{model}', that of the latest is '{latest}': over temperature the two "
    "differ by their own misfit",
    "unit": "the readings of the {triad} are in another unit than those of the latest: compared in nominal units",
    "elsewhere": "has no temperature terms and was made at {run:.1f} °C: compared at {middle:.1f} °C, what the tool "
    "drifts between them counts as a change",
    "order": "the {triad} has temperature terms of order {order}: compared to order {compared}",
}
"""The statements about a calibration that cannot be compared, or not in all of its parameters."""


SCALE_CHANGE = 0.1
"""Share by which the scale of a sensor never changes: nominal scales that differ by more may be of other units."""
DECLARED = "declared"
"""How a calibration says that the noise of its readings was declared."""
DEGREES = "°"
"""Unit in which misalignments are stated."""


def factor(unit: str) -> float:
    """Factor from the unit of calculation to the unit that is shown."""
    return float(np.degrees(1)) if unit == DEGREES else 1.0


@dataclass(frozen=True)
class ToolHistory:
    """The calibrations of one tool, oldest first, as a `History` of those that can be compared.

    `notes` of every calibration; `used`: which are in `history`; `temperature_c`: the range over which they
    are compared; `units` in which its parameters are stated (see `factor`); `earth`: gravity, field and dip;
    `covariance` (n, p, p) as each calibration states it, in `history` with the noise of all; `free`: directions
    (f, p) that each leaves undetermined.
    """

    calibrations: tuple[Calibration, ...]
    days: tuple[date, ...]
    used: tuple[bool, ...]
    notes: tuple[tuple[str, ...], ...]
    temperature_c: tuple[float, float]
    units: tuple[str, ...]
    earth: tuple[float, float, float]
    covariance: Array
    free: tuple[Array, ...]
    history: History

    @property
    def compared(self) -> list[Calibration]:
        """The calibrations in `history`."""
        return [c for c, used in zip(self.calibrations, self.used, strict=True) if used]

    @property
    def compared_days(self) -> list[date]:
        """The days of the calibrations in `history`."""
        return [day for day, used in zip(self.days, self.used, strict=True) if used]


def tool_history(calibrations: Sequence[Calibration]) -> ToolHistory:
    """Calibrations (one or more) of one tool, in any order, in common parameters.

    Those of the latest decide: one that has no temperature in common with it is left out, and says so.
    """
    ordered = sorted(calibrations, key=lambda c: (c.day, c.time))
    days = [each.day for each in ordered]
    used, span, notes = _in_common(ordered)
    compared = [each for each, use in zip(ordered, used, strict=True) if use]
    latest = ordered[-1]
    orders = _orders(compared, span)
    middle = _middle(compared, span)
    if not any(orders.values()):
        span = (middle, middle)
    form = _Form(latest, span, orders, compared)
    rows = [form.row(each) for each in compared]
    prior = _has_prior(compared)
    more = iter(
        [*([NOTES["prior"]] if rests else []), *form.notes(each)]
        for each, rests in zip(compared, prior, strict=True)
    )
    notes = [[*first, *(next(more) if use else ())] for first, use in zip(notes, used, strict=True)]
    kept = [day for day, use in zip(days, used, strict=True) if use]
    names = parameter_names(orders)
    values, covariance, free = ([row[i] for row in rows] for i in range(3))
    ratio, freedom, together = (
        np.concatenate(part, -1) for part in zip(*form.noise(), strict=True)
    )
    like = np.stack(covariance) * outer(np.sqrt(ratio))
    known = precisions(like, free)
    history = History(names, np.stack(values), like, known, freedom, together, years(kept), prior)
    units = tuple(map(form.unit, names))
    tool = tuple(ordered), tuple(days), tuple(used), tuple(map(tuple, notes))
    return ToolHistory(*tool, span, units, form.earth(), np.stack(covariance), tuple(free), history)


def _stations(calibration: Calibration) -> set[str]:
    """Fingerprints of the accelerometer at the stations of a calibration's own run."""
    return {row.digest.partition("-")[0] for row in calibration.station_rows} - {""}


def _has_prior(compared: Sequence[Calibration]) -> Bools:
    """Which calibrations (n,) had others of these as their prior, and so are not independent of them."""
    behind = [{digest.partition("-")[0] for digest in c.inherited} for c in compared]
    measured = set().union(*map(_stations, compared))
    return np.array([bool(each & measured) for each in behind])


def _range(calibration: Calibration) -> tuple[float, float]:
    """Temperatures that a calibration holds for, °C."""
    if calibration.temperature_c is None:
        return ANY_TEMPERATURE
    low, high = calibration.temperature_c
    return low - calibration.margin, high + calibration.margin


def _in_common(
    ordered: Sequence[Calibration],
) -> tuple[list[bool], tuple[float, float], list[list[str]]]:
    """Which calibrations have temperatures in common and no station, the temperatures, and notes; latest first."""
    used, notes, span = [], [], ANY_TEMPERATURE
    latest_of: dict[str, Calibration] = {}
    for each in reversed(ordered):
        stations = _stations(each)
        if again := [latest_of[station] for station in stations & latest_of.keys()]:
            later = max(each.day for each in again).isoformat()
            used.append(False)
            notes.append([NOTES["again"].format(later=later)])
            continue
        low, high = _range(each)
        both = max(low, span[0]), min(high, span[1])
        used.append(both[0] <= both[1])
        if used[-1]:
            span = both
            latest_of |= dict.fromkeys(stations, each)
            notes.append([NOTES["unrecorded"]] if each.temperature_c is None else [])
        else:
            others = f"{span[0]:.0f}…{span[1]:.0f} °C"
            notes.append([NOTES["no-overlap"].format(low=low, high=high, others=others)])
    return used[::-1], span, notes[::-1]


def _middle(compared: Sequence[Calibration], span: tuple[float, float]) -> float:
    """The temperature at which calibrations without a common course are compared.

    That of the runs of those without temperature terms, which say nothing of others; else the latest's reference.
    """
    runs = [np.mean(c.temperature_c) for c in compared if c.temperature_c and _constant(c)]
    return float(np.clip(np.mean(runs) if runs else compared[-1].reference_temperature, *span))


def _constant(calibration: Calibration) -> bool:
    """Whether a triad of a calibration has no temperature terms."""
    return not all(triad.order for triad in calibration.triads)


def _orders(compared: Sequence[Calibration], span: tuple[float, float]) -> dict[str, int]:
    """Order by triad to which temperature terms are compared: the lowest; none over a short range."""
    short = not span[1] - span[0] > 2 * SOAK_GAP or not np.isfinite(span).all()
    triads = [TRIADS[0], *TRIADS[1:][: any(c.has_field for c in compared)]]
    each = {
        name: [t.order for c in compared for t in c.triads if t.name == name] for name in triads
    }
    return {name: 0 if short else min(orders) for name, orders in each.items()}


@dataclass(frozen=True)
class _Form:
    """How calibrations are put into common parameters: those of `latest`, over a range of temperatures."""

    latest: Calibration
    span: tuple[float, float]
    orders: dict[str, int]
    compared: Sequence[Calibration]

    def noise(self) -> Iterator[tuple[Array, Array, Bools]]:
        """What variances (n, k) of each triad's parameters are multiplied by, their freedom, which are pooled."""
        for name, order in self.orders.items():
            triads = [getattr(each, name) for each in self.compared]
            factors = [None if t is None else t.variance_factor for t in triads]
            square = np.array([np.nan if factor is None else factor for factor in factors])
            freedom = np.array([t.degrees_of_freedom if t else 0.0 for t in triads])
            declared = np.array([t is not None and t.noise_source == DECLARED for t in triads])
            ratio, degrees, together = common_noise_scale(
                np.where(declared, square, np.nan), freedom
            )
            single = np.where(np.isnan(square) | (freedom < 1), np.inf, freedom)
            parts = ratio, np.where(declared, degrees, single), together
            first, second, third = (np.repeat(part[:, None], 12 + 6 * order, -1) for part in parts)
            yield first, second, third

    def row(self, calibration: Calibration) -> tuple[Array, Array, Array]:
        """Values (p,), covariance (p, p) of the file, and free directions (f, p) of one calibration."""
        places, parts = calibration.places(), []
        size = len(calibration.parameters)
        for name, order in self.orders.items():
            triad = getattr(calibration, name)
            if triad is None:
                count = 12 + 6 * order
                parts.append((np.full(count, np.nan), np.zeros((count, size))))
                continue
            values, slope = self._triad(calibration, triad)
            whole = np.zeros((len(values), size))
            whole[:, places[name]] = slope
            parts.append((values, whole))
        values, slope = (np.concatenate(part) for part in zip(*parts, strict=True))
        covariance = slope @ calibration.parameter_covariance @ slope.transpose()
        if self._assumed_gravity(calibration):
            common = np.zeros_like(values)
            first = slice(0, 12 + 6 * self.orders[TRIADS[0]])
            common[first] = UNKNOWN_GRAVITY * _stretched(values[first])
            covariance = covariance + np.outer(common, common)
        free = [
            *(calibration.free_directions @ slope.transpose()),
            *self._stretch(calibration, values),
        ]
        rows = np.nan_to_num(np.reshape(free, (-1, len(values))))
        return values, covariance, rows

    def _assumed_gravity(self, calibration: Calibration) -> bool:
        """Whether a calibration took gravity as 1 g and others did not: its local gravity is then unknown."""
        return unknown_gravity(calibration) and not all(map(unknown_gravity, self.compared))

    def _triad(self, calibration: Calibration, triad: TriadCalibration) -> tuple[Array, Array]:
        """Factors (k,) of a triad and their derivatives (k, p) by its parameters in the file."""
        values, jacobian = self._of_all[triad.name][id(calibration)]
        strength = self._strength(calibration, triad.name)
        powers = strength ** _powers_of_strength(len(values))
        return values * powers, jacobian * powers[:, None]

    @cached_property
    def _of_all(self) -> dict[str, dict[int, tuple[Array, Array]]]:
        """The same of all calibrations as their fields are, those of one model together."""
        result: dict[str, dict[int, tuple[Array, Array]]] = {name: {} for name in self.orders}
        for name, factors in result.items():
            alike: dict[tuple[float, object], list[Calibration]] = {}
            for each in self.compared:
                if (triad := getattr(each, name)) is not None:
                    ratio = self._unit_ratio(each, triad)
                    form = triad.model, triad.order, triad.curved, str(triad.centre), triad.radius
                    at = each.reference_temperature, _axes(each, name).tobytes()
                    alike.setdefault((ratio, (*form, *at)), []).append(each)
            for (ratio, _), some in alike.items():
                many = self._factors(some, name, ratio)
                factors |= {id(c): (v, j) for c, v, j in zip(some, *many, strict=True)}
        return result

    def _unit_ratio(self, calibration: Calibration, triad: TriadCalibration) -> float:
        """By what the unit of a triad's readings is another than the latest's: 1, or the ratio of nominal scales.

        The ratio, where nominal scales differ by more than a sensor's can, and by it the scales differ less.
        """
        last = self._latest[triad.name]
        now, then = (getattr(c.profile, triad.name).scale or 1.0 for c in (last, calibration))
        ratio = float(then / now)
        if abs(np.log(ratio)) <= np.log1p(SCALE_CHANGE):
            return 1.0
        scale, latest = (
            np.abs(
                self._strength(c, triad.name) ** -1.0
                * self._factors([c], triad.name, 1.0)[0][0, :3]
            ).mean()
            for c in (calibration, last)
        )
        return ratio if abs(np.log(scale / ratio / latest)) < abs(np.log(scale / latest)) else 1.0

    def _factors(
        self, alike: Sequence[Calibration], name: str, unit_ratio: float
    ) -> tuple[Array, Array]:
        """Factors (c, k) of a triad of calibrations with one model, and their derivatives (c, k, p).

        Their readings are in a unit of which the latest's is `unit_ratio`.
        """
        x, first = self._points[name], alike[0]
        axes = unit_ratio * (_axes(first, name) @ np.linalg.inv(_axes(self._latest[name], name)))
        model = getattr(first, name).functions(first.reference_temperature)
        raw, order = x @ axes.transpose(), self.orders[name]
        parameters = np.array([getattr(each, name).parameters for each in alike])
        result = factored(model, parameters, raw, self.span, order, x)
        return result.values, result.jacobian

    @cached_property
    def _latest(self) -> dict[str, Calibration]:
        """The latest calibration of each triad: one in nT before one to field = 1."""
        result = {}
        for triad in TRIADS:
            having = [each for each in self.compared if getattr(each, triad) is not None]
            known = (each for each in reversed(having) if not self._unknown(each, triad))
            if having:
                result[triad] = next(known, having[-1])
        return result

    @staticmethod
    def _unknown(calibration: Calibration, triad: str) -> bool:
        """Whether a triad is calibrated to a field of unknown strength."""
        return triad == TRIADS[1] and calibration.relative

    @cached_property
    def _points(self) -> dict[str, Array]:
        """Readings (m, 3) of the latest calibration of each triad where its field points every way."""
        return {name: self._readings(name) for name in self.orders}

    def _readings(self, triad: str) -> Array:
        """Those of one triad."""
        last = self._latest[triad]
        strength = last.earth.get("field", 1.0) if triad == TRIADS[1] else last.earth["gravity_g"]
        model = getattr(last, triad).functions(last.reference_temperature)
        warmth = np.full(len(FIELD_DIRECTIONS), np.clip(sum(self.span) / 2, *_range(last)))
        return raw_reading(
            model, np.array(getattr(last, triad).parameters), strength * FIELD_DIRECTIONS, warmth
        )

    def _strength(self, calibration: Calibration, triad: str) -> float:
        """The field that a triad calibrated to field = 1 is taken to have been in, where others are in nT."""
        last = self._latest[triad]
        alike = self._unknown(calibration, triad) == self._unknown(last, triad)
        return 1.0 if alike else float(last.earth["field"])

    def _stretch(self, calibration: Calibration, values: Array) -> Array:
        """The direction (0 or 1, p) along which a field of unknown strength stretches the parameters."""
        if not calibration.relative:
            return np.zeros((0, len(values)))
        first = 12 + 6 * self.orders[TRIADS[0]]
        row = np.zeros_like(values)
        row[first:] = _stretched(values[first:])
        return row[None]

    def earth(self) -> tuple[float, float, float]:
        """Gravity, g, field, in the unit of the values, and dip, radians."""
        earth = self._latest[TRIADS[-1] if TRIADS[-1] in self.orders else TRIADS[0]].earth
        return (
            earth["gravity_g"],
            earth.get("field", 1.0),
            float(np.radians(earth.get("dip_deg", 0.0))),
        )

    def notes(self, calibration: Calibration) -> Iterator[str]:
        """What of a calibration is not compared, or as something else."""
        for name, compared in self.orders.items():
            yield from self._notes_of(calibration, name, compared)
        middle, measured = sum(self.span) / 2, calibration.temperature_c
        if measured and _constant(calibration) and abs(np.mean(measured) - middle) > MARGIN:
            yield NOTES["elsewhere"].format(run=np.mean(measured), middle=middle)
        if unknown_gravity(calibration) and len(self.compared) > 1:
            yield NOTES["gravity" if self._assumed_gravity(calibration) else "gravity-alike"]
        if calibration.relative:
            yield NOTES["relative"]
        if calibration.options.parameters < 12:
            yield NOTES["held"]
        if free := calibration.undetermined():
            yield NOTES["free"].format(free=", ".join(dict.fromkeys(each.id for each in free)))

    def _notes_of(self, calibration: Calibration, name: str, compared: int) -> Iterator[str]:
        """The same of one triad, compared to some order."""
        triad: TriadCalibration | None = getattr(calibration, name)
        if triad is None:
            yield NOTES["no-magnetometer"]
            return
        if self._unit_ratio(calibration, triad) != 1.0:
            yield NOTES["unit"].format(triad=name)
        if triad.curved:
            yield NOTES["curved"].format(triad=name)
        latest = getattr(self._latest[name], name).model
        if compared and triad.model != latest:
            yield NOTES["model"].format(triad=name, model=triad.model, latest=latest)
        if triad.order > compared:
            yield NOTES["order"].format(triad=name, order=triad.order, compared=compared)

    def unit(self, name: str) -> str:
        """The unit of a parameter."""
        triad, _, title = name.partition(" ")
        if title.startswith("misalignment"):
            return DEGREES
        last = self._latest[triad]
        field = "" if last.relative and triad == TRIADS[1] else NANOTESLA
        return "" if title.startswith("scale") else ("g" if triad == TRIADS[0] else field)


def _axes(calibration: Calibration, triad: str) -> Array:
    """Matrix (3, 3) from the raw channels of a triad to its tool axes in nominal units."""
    profile = getattr(calibration.profile, triad)
    return np.asarray(profile.permutation / (profile.scale or 1.0))


def _stretched(values: Array) -> Array:
    """What parameters (size,) of a triad move by, over the share by which the strength of its field is another."""
    return values * _powers_of_strength(len(values))


def _powers_of_strength(size: int) -> Array:
    """By which power of the strength of the field each parameter (size,) of a triad goes: scale -1, bias 1."""
    course = np.tile(np.repeat([-1.0, 1.0], 3), 1 + (size - 12) // 6)
    return np.concatenate([course[:6], np.zeros(6), course[6:]])


# --------------------------------------------------------------------------
# How accurate a calibration will be some years after it, and when the tool no longer keeps a limit.
#
# All at `TYPICAL` inclination. Variance of an angle t years after: that of the calibration, and t times what each
# group's random walk adds in a year, both averaged over azimuth and toolface. A tool keeps a limit while the largest
# error over azimuth and toolface does, which is what a roll test sees.
#
# When a tool left a limit in service: what shortens the time to its next calibration.
#
# From as left to as found: what roll tests of one calibration, before and after service, show.


@dataclass(frozen=True)
class ServiceTest:
    """A roll test of a calibration: its day, the verdict, and the SHA-256 of the calibration that it names."""

    day: date
    calibration_sha256: str
    verdict: Verdict


def service_rows(
    calibrations: Sequence[tuple[Calibration, Sequence[str]]], tests: Sequence[ServiceTest]
) -> list[ServiceRow]:
    """Each limit of each calibration that was tested twice or more: the first test against the last.

    `calibrations` each with the SHA-256 by which a test may name it: of its contents, or of its file.
    """
    rows: list[ServiceRow] = []
    for calibration, names in calibrations:
        mine = sorted((t for t in tests if t.calibration_sha256 in names), key=lambda t: t.day)
        if len(mine) > 1 and mine[0].day < mine[-1].day:
            rows += _compared(calibration.day, mine[0], mine[-1])
    return rows


def _compared(calibrated: date, left: ServiceTest, last: ServiceTest) -> Iterator[ServiceRow]:
    """The limits that both tests judge."""
    before = {row.name: row for row in left.verdict.rows}
    for row in last.verdict.rows:
        if row.name not in before:
            continue
        first = before[row.name]
        change, sd = _change(first, row)
        yield ServiceRow(
            calibrated=calibrated.isoformat(),
            as_left_date=left.day.isoformat(),
            as_found_date=last.day.isoformat(),
            name=row.name,
            unit=row.unit,
            limit=row.limit,
            as_left=first.value,
            as_found=row.value,
            change=change,
            standard_uncertainty=sd,
            score=None if change is None or not sd else change / sd,
            as_left_passed=first.passed,
            as_found_passed=row.passed,
        )


def _change(left: VerdictRow, last: VerdictRow) -> tuple[float | None, float | None]:
    """Change of a figure and its standard uncertainty, the tests being independent."""
    if left.value is None or last.value is None:
        return None, None
    change = last.value - left.value
    if left.uncertainty is None or last.uncertainty is None:
        return change, None
    return change, float(np.hypot(left.uncertainty, last.uncertainty))


ACCURACY_PROBABILITY = 0.95
"""Share of directions whose error is to stay within a limit."""
RISK = 0.05
"""Probability that a tool is beyond a limit on the day when it is due."""
INTERVAL = (RISK, 0.5, 1 - RISK)
"""Shares of the probability below which lie the earliest, the expected and the latest value."""
LONGEST_INTERVAL = 5.0
"""No calibration is called good for longer, years."""
DRAWN_PATHS = 2_000
"""Draws of what is not known of a tool: its rates, the error of its calibration, and where it walks."""
LEAST_SPEED = np.float32(1e-12)
"""Walk of an angle in a year, rad, that keeps any limit."""
COVERAGE_FACTOR = float(ndtri((1 + ACCURACY_PROBABILITY) / 2))
"""Standard uncertainties within which that share of normal errors lies."""


@dataclass(frozen=True)
class Growth:
    """Variance of an angle, rad²: of the calibration, and by group what a rate of one adds in a year.

    `changes` (a, p) of the angle by the parameters of the triads at the middle temperature, over azimuth and
    toolface.
    """

    angle: str
    calibration: float
    yearly: dict[tuple[str, str], float]
    changes: Array

    def rate(self, rates: Mapping[tuple[str, str], Array]) -> Array:
        """Variance added in a year (…,), rad², at rates (…,) by group."""
        return np.asarray(sum(share * rates[group] for group, share in self.yearly.items()))

    def kept(self, paths: Paths, limit: float) -> tuple[Array, Array]:
        """On each of n paths the years (n,) after which the largest error exceeds a limit, and that error at first.

        A path is straight in √t, with the distribution that a walk has at each time: where it has left a limit
        it does not come back, so that the share of paths that have left by t is the probability to be beyond at t.
        Units: radians.
        """
        changes = self.changes.astype(np.float32)
        error, walk = changes @ paths.error.mT, changes @ paths.walk.mT
        largest = np.maximum(error.max(0), -error.min(0))
        error *= np.sign(walk)  # in place: no new array for each step
        left, speed = np.subtract(np.float32(limit), error, out=error), np.abs(walk, out=walk)
        span = np.min(np.divide(left, np.maximum(speed, LEAST_SPEED, out=speed), out=left), 0)
        return np.where(largest > limit, 0.0, np.maximum(span, 0.0)) ** 2, largest


@dataclass(frozen=True)
class Paths:
    """Draws of what parameters (n, p) are wrong by: on the day of the calibration, and by the walk of a year."""

    error: AnyArray
    walk: AnyArray

    @classmethod
    def of(
        cls, covariance: Array, places: Mapping[tuple[str, str], Sequence[int]],
        rates: Mapping[tuple[str, str], Array], rng: np.random.Generator,
    ) -> Paths:  # fmt: skip
        """By the covariance (p, p) of a calibration, and drawn rates (n,) of groups of parameters at `places`."""
        draws, root = len(next(iter(rates.values()))), square_root(covariance)
        sd = np.ones((len(covariance), draws), np.float32)
        for group, drawn in rates.items():
            sd[places[group]] = np.sqrt(drawn, dtype=np.float32)
        walk = rng.standard_normal((draws, len(covariance)), np.float32)
        walk *= sd.mT
        size = draws, root.shape[1]
        return cls(rng.standard_normal(size, np.float32) @ root.mT.astype(np.float32), walk)


@dataclass(frozen=True)
class Outlook:
    """Forecast from a calibration: the growth of each angle that it determines.

    `places` of all parameters of its triads in the history, of each group among them; `covariance` (p, p) of them.
    """

    growths: list[Growth]
    columns: list[int]
    places: dict[tuple[str, str], list[int]]
    covariance: Array


def outlook(tool: ToolHistory) -> Outlook:
    """The outlook of the latest calibration; no growth of an angle that it leaves undetermined."""
    return outlooks([tool])[0]


def outlooks(tools: Sequence[ToolHistory]) -> list[Outlook]:
    """The outlooks of tools in the same parameters, whose latest calibrations have as many triads."""
    latest, names = [tool.calibrations[-1] for tool in tools], tools[0].history.names
    triads = [triad.name for triad in latest[0].triads]
    columns = [names.index(f"{triad} {title}") for triad in triads for title in FACTOR_NAMES]
    places = {group: group_places([names[i] for i in columns], *group) for group in WALK_GROUPS}
    units = np.zeros((len(WALK_GROUPS), len(columns)))
    for row, some in zip(units, places.values(), strict=True):
        row[some] = 1.0
    places = {group: some for group, some in places.items() if some}
    blocks = np.stack([tool.covariance[-1][np.ix_(columns, columns)] for tool in tools])
    yearly = np.broadcast_to(
        (units[:, None] * np.eye(len(columns)))[:, None], (len(units), *blocks.shape)
    )
    each = np.concatenate([blocks[None], yearly])
    together = _as_factors(tools, columns, len(triads))
    changes, result = angle_changes(together), [Outlook([], columns, places, b) for b in blocks]
    for angle, sd in accuracy(together, each).items():
        for tool, (first, *others) in enumerate((sd.mT**2).tolist()):
            if np.isfinite(first):
                by_group = {g: v for g, v in zip(WALK_GROUPS, others, strict=True) if v > 0}
                growth = Growth(angle, first, by_group, changes[angle][tool])
                result[tool].growths.append(growth)
    return result


def _as_factors(
    tools: Sequence[ToolHistory], columns: Sequence[int], triads: int
) -> CalibratedTools:
    """The latest calibrations of tools at the middle temperature, by the parameters at `columns` of their histories."""
    values = np.stack([tool.history.values[-1][columns] for tool in tools])
    free = [tool.free[-1][:, columns] for tool in tools]
    directions = np.zeros((len(tools), max(map(len, free)), len(columns)))
    for rows, some in zip(directions, free, strict=True):
        rows[: len(some)] = some
    return CalibratedTools(
        models=(Factors(Basis()),) * triads,
        parameters=tuple(np.split(values, triads, -1)),
        earth=np.array([tool.earth for tool in tools]),
        temperature=np.array([sum(tool.temperature_c) / 2 for tool in tools]),
        free=directions,
        noise=np.zeros((len(tools), triads)),
    )


def day_after(start: date, span: float) -> date:
    """The day that is some years, at most `LONGEST_INTERVAL`, after another."""
    return start + timedelta(days=int(min(max(span, 0.0), LONGEST_INTERVAL) * DAYS_PER_YEAR))


CLEAR_STEP = 3.0
"""Standard uncertainties that a step between calibrations has, to be one."""
SHORTENED = 0.5
"""Share of a time in which a tool left a limit after which it is due: it may have left on any day of it."""
VISIT_DAYS = VISIT * DAYS_PER_YEAR


@dataclass(frozen=True)
class Left:
    """A time in which a tool left a limit, and in words how that is known."""

    start: date
    end: date
    how: str

    @property
    def span(self) -> timedelta:
        """How long after the calibration the tool may be used."""
        return SHORTENED * (self.end - self.start)


@dataclass(frozen=True)
class Departure:
    """The largest change of an angle between two successive calibrations, and its standard uncertainty, rad."""

    angle: str
    start: date
    end: date
    size: float
    uncertainty: float

    def left(self, limits: Mapping[str, float]) -> Iterator[Left]:
        """Its forecast of limits in degrees by angle."""
        degrees = float(np.degrees(self.size))
        if degrees > limits.get(self.angle, np.inf) and self.size > CLEAR_STEP * self.uncertainty:
            yield Left(self.start, self.end, f"{self.angle} changed by {degrees:.2g}°")


def departures(tool: ToolHistory, outlook: Outlook) -> list[Departure]:
    """The change of each angle from visit to visit, over azimuth and toolface at 45° inclination.

    None of an angle that rests on what one of two calibrations lacks or leaves undetermined.
    """
    history, columns, result = tool.history, outlook.columns, []
    moved = np.diff(history.values[:, columns], axis=0)
    covariance = history.covariance[:, columns][..., columns]
    covariance = covariance[:-1] + covariance[1:]
    visits = list(pairwise(tool.compared_days))
    for growth in outlook.growths:
        rows = growth.changes
        unknown = np.asarray(np.isnan(moved[:, np.abs(rows).max(0) > 0]).any(-1))
        free = [bool(np.any(np.abs(rows @ each[:, columns].mT) > FREE_SHARE)) for each in tool.free]
        changes = np.abs(np.nan_to_num(moved) @ rows.mT)
        row = rows[np.argmax(changes, -1)]
        sizes = changes.max(-1).tolist()
        sd = np.sqrt(np.einsum("kp,kpq,kq->k", row, covariance, row)).tolist()
        for k, (start, end) in enumerate(visits):
            if (end - start).days > VISIT_DAYS and not (unknown[k] or free[k] or free[k + 1]):
                result.append(Departure(growth.angle, start, end, sizes[k], sd[k]))
    return sorted(result, key=lambda departure: departure.start)


def failures(
    calibrations: Sequence[tuple[Calibration, Sequence[str]]], tests: Sequence[ServiceTest]
) -> Iterator[Left]:
    """Roll tests that found a tool beyond a limit in service, the first of each calibration.

    `calibrations`, oldest first, each with the SHA-256 by which a test may name it. A test in the visit of the
    calibration judges that, unless one before passed. No test was later than the next calibration.
    """
    ends = [*(c.day for c, _ in calibrations[1:]), date.max]
    for (calibration, names), end in zip(calibrations, ends, strict=True):
        passed = False
        mine = (t for t in tests if t.calibration_sha256 in names and t.day > calibration.day)
        for test in sorted(mine, key=lambda t: t.day):
            day = min(test.day, end)
            failed = [r.name for r in test.verdict.rows if r.value is not None and not r.passed]
            if failed and (passed or (day - calibration.day).days > VISIT_DAYS):
                what = f"the roll test of {day} failed ({', '.join(failed)})"
                yield Left(calibration.day, day, what)
                break
            passed = passed or not failed
