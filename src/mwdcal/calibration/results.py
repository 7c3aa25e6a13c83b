"""The results of a fit for its tools, as arrays: a calibration file is one row of them, a fleet table all.

Parameters, their uncertainties, constants of the run, errors of the stand; and the covariance, by
source of error. The effect of the readings' noise and of angles that the stand sets at every
station is independent from station to station and scales with s² where that is above one: residuals smaller
than declared are no evidence that a declaration was too cautious. Errors that stations have in
common (settings of a direction, zeros and tilt of the stand, the references for gravity, field and
dip) and a prior are as large as they were declared: no residual says how large they are. Temperature terms
beyond the order are added to both.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import compress

import numpy as np
from msgspec import UNSET

from mwdcal.calibration.automatic.courses import misfit_covariance, orders_of
from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.prior import PriorInformation
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import (
    ALIGNMENT,
    FREE_SHARE,
    NOISE,
    ORDER,
    REPEATABILITY,
    SETTINGS,
    STEADINESS,
    THERMOMETER,
    Calibration,
    stated,
)
from mwdcal.estimation import drift
from mwdcal.estimation.batch import take
from mwdcal.estimation.problem import STAND_ERRORS, WALK_AXES
from mwdcal.estimation.uncertainty import (
    Free,
    marginal_rank,
    moved_by_readings,
    of_stand,
    sum_of_squares,
)
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import (
    Array,
    ArrayLike,
    Bools,
    Ints,
    diagonal,
    dot,
    length,
    outer,
    reference_vectors,
)
from mwdcal.sensor.models import Model, Whole

# --------------------------------------------------------------------------
# Forecasts of a calibration: readings at a wanted attitude, and 1σ over the attitude sphere.
#
# Everything here is of the calibration at the run's mean gravity, field and dip
# (`Calibration.earth`). Angles are radians, shapes broadcast; no drawing.

STATED_ANGLES = ("inclination", "toolface", "azimuth")
"""Angles whose accuracy is stated; the first two need no magnetometer."""
TWELFTHS = np.arange(12) * np.pi / 6
"""Azimuths, and toolfaces, over which an uncertainty is averaged (root mean square)."""
LATTICE = (89, 55)
"""Numbers of Fibonacci: so many azimuths, and by how many times each the toolface, that cover both evenly."""
TYPICAL = float(np.radians(45))
"""The inclination that stands for a tool's accuracy where one number must do."""
UNKNOWN_GRAVITY = 0.0015
"""Standard uncertainty of |g| in units of a laboratory's gravity that was taken as 1 g: that is anything from
9.780 to 9.832 m/s²."""
CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
"""Four fields, in units of their strength, from which an affine function of the field is known."""
CORNER_SHARES = np.array([[1.0, -1, -1, -1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
"""Shares of these four in the field of unit components (1, x, y, z)."""
_STEPS = 8


def angles(calibration: Calibration) -> tuple[str, ...]:
    """Names of the angles that the calibrated triads can give."""
    return STATED_ANGLES[: 1 + len(calibration.triads)]


def unknown_gravity(calibration: Calibration) -> bool:
    """Whether gravity was taken as 1 g without a reference; in files of earlier versions, whether it is 1 g."""
    if calibration.gravity_stated is UNSET:
        return calibration.earth["gravity_g"] == 1.0
    return not calibration.gravity_stated


def middle_temperature(calibration: Calibration) -> float:
    """The reference temperature, moved into the calibrated range where it lies outside, °C."""
    low, high = calibration.temperature_c or (-np.inf, np.inf)
    return float(np.clip(calibration.reference_temperature, low, high))


def without_temperature(calibration: Calibration) -> str:
    """What headlines say of a calibration whose run recorded no temperature; empty if it did."""
    return "" if calibration.temperature_c else "no temperature recorded"


def readings_at(
    calibration: Calibration,
    inclination: ArrayLike,
    azimuth: ArrayLike,
    toolface: ArrayLike,
    temperature: ArrayLike | None = None,
) -> Readings:
    """The readings (…, n) that this calibration turns into given attitudes (…, n).

    Units: radians; °C, of all or of each (…, n), by default `middle_temperature`. Singular: nowhere; a vertical tool
    reads a definite vector.
    """
    inc, azi, face = np.broadcast_arrays(inclination, azimuth, toolface)
    vectors = reference_vectors(inc, azi, face, *_earth(calibration))
    at = middle_temperature(calibration) if temperature is None else temperature
    warmth = np.broadcast_to(np.asarray(at, float), vectors[0].shape[:-1])
    raw = [
        raw_reading(
            t.functions(calibration.reference_temperature), np.array(t.parameters), v, warmth
        )
        for t, v in zip(calibration.triads, vectors, strict=False)
    ]
    return Readings(raw[0], raw[1] if len(raw) > 1 else None, temperature=warmth)


def _earth(calibration: Calibration) -> tuple[float, float, float]:
    """Gravity, g, field, nT, and dip, radians, of a calibration; 1 and 0 where it has no field."""
    earth = calibration.earth
    return earth["gravity_g"], earth.get("field", 1.0), np.radians(earth.get("dip_deg", 0.0))


def raw_reading(model: Model, params: Array, field: Array, temperature: Array) -> Array:
    """Readings (…, n, 3) that a triad's model turns into `field` (…, n, 3).

    Reference: the sensor model inverted by Newton steps, one of which is exact unless an axis is
    curved.
    """
    raw = np.zeros(field.shape)
    for _ in range(_STEPS if model.curved else 1):
        error = field - model.fields(params, raw, temperature)
        raw = raw + np.linalg.solve(model.slope(params, raw, temperature), error[..., None])[..., 0]
    return raw


@dataclass(frozen=True)
class CalibratedTools:
    """Calibrated tools as arrays with a leading tool axis B.

    `models` and `parameters` (B, k) by triad; `earth` (B, 3): gravity, field, dip; `temperature`
    (B,), °C; `free` (B, f, p): directions of all parameters that no evidence determines; `noise`
    (B, t): standard deviation of one reading.
    """

    models: tuple[Model, ...]
    parameters: tuple[Array, ...]
    earth: Array
    temperature: Array
    free: Array
    noise: Array

    def changes(self, fields: Sequence[Array], noise: bool) -> Array:
        """Changes (B, t, n, 3, c) of each triad's field, where these are `fields` (B, n, 3).

        By the parameters of all triads and, with `noise`, by that of three readings of each.
        """
        ends = np.cumsum([params.shape[-1] for params in self.parameters])
        size = ends[-1] + 3 * noise * len(self.models)
        result = np.zeros((len(self.earth), len(self.models), *fields[0].shape[1:], size))
        for triad, (model, params) in enumerate(zip(self.models, self.parameters, strict=True)):
            warmth = np.broadcast_to(self.temperature[:, None], fields[triad].shape[:-1])
            raw = raw_reading(model, params, fields[triad], warmth)
            change, end = result[:, triad], ends[triad]
            change[..., end - params.shape[-1] : end] = model.jacobian(params, raw, warmth)
            if noise:
                slope, first = model.slope(params, raw, warmth), ends[-1] + 3 * triad
                change[..., first : first + 3] = slope * self.noise[:, triad, None, None, None]
        return result

    @classmethod
    def of(cls, calibration: Calibration, temperature: float | None = None) -> CalibratedTools:
        """One calibration as a batch of one, at `middle_temperature` unless another is given."""
        triads, reference = calibration.triads, calibration.reference_temperature
        at = middle_temperature(calibration) if temperature is None else temperature
        return cls(
            models=tuple(t.functions(reference) for t in triads),
            parameters=tuple(np.array([t.parameters]) for t in triads),
            earth=np.array([_earth(calibration)]),
            temperature=np.array([at]),
            free=calibration.free_directions[None],
            noise=np.array([[t.noise for t in triads]]),
        )


def _gradients(
    earth: Array, triads: int, inclination: float, azimuth: Array, toolface: Array
) -> tuple[tuple[Array, Array], Array, dict[str, Array]]:
    """Fields (E, a, 3) of both triads at attitudes (a,), those of `triads`, and gradients by angle."""
    attitudes = (np.full((1, len(azimuth)), inclination), azimuth[None], toolface[None])
    both = reference_vectors(*attitudes, *(earth[:, i, None] for i in range(3)))
    vectors = np.stack(both[:triads], -2)
    gradients = {
        name: OBSERVABLES[name].gradient(*both)[..., : 3 * triads].reshape(vectors.shape)
        for name in STATED_ANGLES[: 1 + triads]
    }
    return both, vectors, gradients


def angle_changes(tools: CalibratedTools, inclination: float = TYPICAL) -> dict[str, Array]:
    """Change (B, a, p) of each angle by all parameters, radians, at an inclination and a = 89 attitudes.

    These cover azimuth and toolface evenly (`LATTICE`). Singular: NaN at exactly vertical for toolface and azimuth.
    """
    turns = 2 * np.pi * np.arange(LATTICE[0]) / LATTICE[0]
    both, _, gradients = _gradients(
        tools.earth, len(tools.models), inclination, turns, turns * LATTICE[1]
    )
    change = tools.changes(both, noise=False)
    return {n: np.einsum("bati,btaip->bap", g, change) for n, g in gradients.items()}


def accuracy(
    tools: CalibratedTools, covariance: Array, inclination: float = TYPICAL, noise: bool = False
) -> dict[str, Array]:
    """1σ (…, B) by angle, radians, at an inclination: root mean square over azimuth and toolface.

    `covariance` (…, B, p, p) is of all parameters; `noise` adds that of one reading.
    Singular: NaN at exactly vertical for toolface and azimuth, and where an angle rests on a free
    direction.
    Method: unless an axis is curved, a field is affine in the reading at one temperature, and so
    is its change by the parameters in the field: four fields tell it everywhere.
    """
    earth, number = tools.earth, np.arange(len(tools.earth))
    curved = any(model.curved for model in tools.models)
    if not curved:
        earth, number = np.unique(earth, axis=0, return_inverse=True)
    azimuth, toolface = (turn.ravel() for turn in np.meshgrid(TWELFTHS, TWELFTHS, indexing="ij"))
    both, vectors, gradients = _gradients(earth, len(tools.models), inclination, azimuth, toolface)
    free = tools.free
    if noise:
        covariance, free = _with_noise(covariance, free, 3 * len(tools.models))
    if curved:
        change = tools.changes(both, noise)
        rows = {n: np.einsum("bati,btaic->bac", g, change) for n, g in gradients.items()}
    else:
        strengths = tools.earth[:, :2].transpose()
        change = tools.changes([s[:, None, None] * CORNERS for s in strengths], noise)
        change = change.reshape(len(change), -1, change.shape[-1])
        covariance = change @ covariance @ change.mT
        free = np.einsum("bip,bkp->bki", change, free)
        unit = vectors / earth[:, None, : len(tools.models), None]
        share = np.concatenate([np.ones_like(unit[..., :1]), unit], -1) @ CORNER_SHARES.transpose()
        size = (*share.shape[:2], -1)
        rows = {n: (share[..., None] * g[..., None, :]).reshape(size) for n, g in gradients.items()}
    return {n: _root_mean_square(each, number, covariance, free) for n, each in rows.items()}


def _root_mean_square(rows: Array, number: Ints, covariance: Array, free: Array) -> Array:
    """1σ (…, B) of what changes by `rows` (E, a, c), those of each tool having a `number` (B,).

    NaN where a row moves with a direction in `free` (B, f, c), and beyond a half turn, which tells nothing.
    """
    weights = rows.mT @ rows / rows.shape[1]
    variance = np.einsum("bij,...bij->...b", weights[number], covariance)
    sd = np.sqrt(np.maximum(variance, 0.0))
    sd = np.where(sd > np.pi, np.nan, sd)
    if not free.size:
        return np.asarray(sd)
    moved = np.abs(np.einsum("bai,bki->bak", rows[number], free)).max((-1, -2))
    return np.where(moved > FREE_SHARE, np.nan, sd)


def _with_noise(covariance: Array, free: Array, count: int) -> tuple[Array, Array]:
    """Covariance and free directions with `count` more parameters: readings in units of their noise."""
    size = covariance.shape[-1]
    whole = np.zeros((*covariance.shape[:-2], size + count, size + count))
    whole[..., :size, :size] = covariance
    whole[..., np.arange(size, size + count), np.arange(size, size + count)] = 1.0
    return whole, np.pad(free, ((0, 0), (0, 0), (0, count)))


@dataclass(frozen=True)
class AccuracyCurve:
    """1σ (n,) of an angle over inclination, radians: root mean square over toolface.

    `typical`: over azimuth too; `least` and `largest`: at the best and the worst azimuth. NaN where
    no uncertainty can be stated at some azimuth or toolface, as in `Calibration.uncertainty`.
    """

    typical: Array
    least: Array
    largest: Array


def accuracy_curves(
    calibration: Calibration, inclination: Array, noise: bool = False
) -> dict[str, AccuracyCurve]:
    """1σ by angle at inclinations (n,), radians: of the calibration, or of one reading too."""
    grid = np.meshgrid(inclination, TWELFTHS, indexing="ij")
    square = {name: np.zeros(grid[0].shape) for name in angles(calibration)}
    for toolface in TWELFTHS:  # one at a time, for memory
        readings = readings_at(calibration, *grid, toolface)
        for name, total in square.items():
            total += calibration.uncertainty(name, readings, noise) ** 2 / len(TWELFTHS)
    return {
        name: AccuracyCurve(np.sqrt(s.mean(-1)), np.sqrt(s.min(-1)), np.sqrt(s.max(-1)))
        for name, s in square.items()
    }


def accuracy_at(
    calibration: Calibration,
    inclinations: Sequence[float],
    noise: bool = False,
    temperature: float | None = None,
) -> dict[str, Array]:
    """1σ (n,) by angle at inclinations (n,), by `accuracy`, of the calibration or one reading.

    Units: radians; °C, by default `middle_temperature`.
    """
    tools = CalibratedTools.of(calibration, temperature)
    covariance = calibration.parameter_covariance[None]
    each = [accuracy(tools, covariance, angle, noise) for angle in inclinations]
    return {name: np.concatenate([sd[name] for sd in each]) for name in each[0]}


def typical_accuracy(calibration: Calibration) -> dict[str, float | None]:
    """1σ of the calibration alone by angle, degrees, at 45° inclination; None: undetermined."""
    sd = accuracy_at(calibration, [TYPICAL])
    return {name: stated(np.degrees(value[0])) for name, value in sd.items()}


PRIOR = "prior"
"""The source of a budget that a prior is."""
SIGNS = (
    "signs of the magnetometer at a northern site",
    "signs of the magnetometer at a southern site",
)
"""The assumption where only the profile says which hemisphere the dip is of: northern, southern."""
EVEN = 1e-6
"""Departure of a correlation matrix from symmetry that is left as it is."""


def variance_scales(result: Fit) -> Array:
    """What scales each triad's variances (B, t): s², or 1 where there is no redundancy.

    No less than 1 for declared noise, which residuals never shrink.
    """
    usable = result.analysis.freedom >= 1
    factor = np.nan_to_num(result.analysis.variance_factor, nan=1.0)
    least = np.where(np.isnan(result.noise), 1.0, 0.0)
    return np.where(usable, np.maximum(factor, least), 1.0)


@dataclass(frozen=True)
class StatedCovariance:
    """The covariance of a fit's parameters that is stated, and what each source of error adds to it."""

    result: Fit

    @cached_property
    def _parts(self) -> tuple[Array, Array, Array, Array]:
        """From independent errors, from shared ones and a prior, from the prior alone, from the order.

        Errors of a prior of precision Λ do V Λ V to a fit of covariance V.
        """
        analysis, precision = self.result.analysis, self.result.problem.prior.precision
        effects, covariance = analysis.effects, analysis.covariance
        prior = covariance @ precision @ covariance if precision.any() else 0 * precision
        common = np.concatenate([effects, analysis.of_settings], -1)
        shared = common @ common.mT + prior
        noise = _scaled(self.result, covariance - shared - self._unscaled_settings)
        return noise + self._lone_settings, shared, prior, misfit_covariance(self.result)

    @cached_property
    def _unscaled_settings(self) -> Array:
        """From angles that the stand sets at every station, as they are declared."""
        return _of_lone_settings(self.result)

    @property
    def _lone_settings(self) -> Array:
        """The same, scaled: times s² of both triads together if that is above one.

        One turn of the stand moves both triads: one factor, so that what they share stays alike.
        """
        analysis = self.result.analysis
        squares = np.nan_to_num(analysis.variance_factor * analysis.freedom).sum(-1)
        together = np.maximum(squares / np.maximum(analysis.freedom.sum(-1), 1.0), 1.0)
        return np.asarray(self._unscaled_settings * together[:, None, None])

    @cached_property
    def total(self) -> Array:
        """Covariance (B, p, p): independent errors times s² if that is above one, others as they are."""
        independent, shared, _, order = self._parts
        return np.asarray(independent + shared + order)

    def in_file(self, reference: float) -> Array:
        """The total (B, k, k) of the file's parameters, of all triads and held ones.

        Rounding leaves it uneven where the noise of the triads is far apart: only its even part says
        anything then.
        """
        maps = to_file(self.result, reference)
        whole = maps @ self.total @ maps.mT
        sd = np.sqrt(np.maximum(diagonal(whole), 1e-300))
        uneven = np.any(np.abs(whole - whole.mT) > EVEN * outer(sd), (-1, -2))
        if uneven.any():
            whole = np.where(uneven[:, None, None], (whole + whole.mT) / 2, whole)
        return np.asarray(whole)

    def by_source(self, repeatability: Array | None = None) -> dict[str, Array]:
        """Covariance (B, p, p) by source; all together they are `total`.

        A common error comes under its `common_source`. `repeatability` (B, t) of each triad, in its field, is
        the part of the declared noise that comes under this name.
        """
        result, (independent, _, prior, order) = self.result, self._parts
        lone = self._lone_settings
        repeated = _scaled(result, _of_repeatability(result, repeatability))
        noise, together = independent - lone - repeated, result.analysis.of_settings
        settings = lone + together @ together.mT
        shares = {NOISE: noise, REPEATABILITY: repeated, SETTINGS: settings}
        for index, constant in enumerate(result.problem.evidence.constants):
            name, effect = common_source(constant.name), result.analysis.effects[..., index]
            shares[name] = shares.get(name, 0.0) + outer(effect)
        shares |= {ORDER: order, PRIOR: prior}
        return {name: share for name, share in shares.items() if name == NOISE or share.any()}


def constants_covariance(result: Fit) -> Array:
    """Covariance (B, q, q) of the constants of the run; what the readings do to it is times s² above one.

    Errors of references and stand that were declared with a precision Λ do V Λ V to their covariance V, whatever
    the residuals are. None is more uncertain than it was declared.
    """
    whole, shared = result.analysis.constants, result.problem.evidence.constants
    known = [np.where(c.unknown, 0.0, 1.0) / c.sd**2 for c in shared]
    precision = np.reshape(known, (len(shared), len(whole))).T
    declared = (whole * precision[:, None, :]) @ whole
    scaled = variance_scales(result).max(-1)[:, None, None] * (whole - declared) + declared
    less = np.ones(scaled.shape[:2])
    for place, constant in enumerate(shared):
        if not constant.unknown:
            sd = np.sqrt(np.maximum(scaled[:, place, place], 1e-300))
            less[:, place] = np.minimum(constant.sd / sd, 1.0)
    return np.asarray(scaled * outer(less))


LEAST_RETURN = 0.2
"""Share of the span of temperatures by which they return where a lag of the thermometer would show."""
TWO_TURNS = {"stand-": "tilt of the stand", "tool-axis-": ALIGNMENT}
"""The names of errors of two turns each, by how the names of these begin."""


def error_name(constant: str) -> str:
    """The name of a common error: of a reference, of the stand, or a drift.

    >>> [error_name(name) for name in ("dip", "azimuth-zero", "stand-north")]
    ['dip reference error', 'azimuth zero of the stand', 'tilt of the stand about north']
    >>> error_name("tool-axis-x")
    'alignment of the tool in the stand about x'
    >>> error_name("field-drift-north")
    'drift of the field during the run'
    """
    if constant in WALK_AXES:
        return f"drift of the {constant.partition('-')[0]} during the run"
    if constant.endswith("-zero"):
        return f"{constant.replace('-', ' ')} of the stand"
    for prefix, words in TWO_TURNS.items():
        if constant.startswith(prefix):
            return f"{words} about {constant.removeprefix(prefix)}"
    return f"{constant} reference error"


def common_source(name: str) -> str:
    """The name of a source of error in a budget: two turns are one source.

    >>> [common_source(name) for name in ("stand-north", "azimuth-zero", "gravity", "prior")]
    ['tilt of the stand', 'azimuth zero of the stand', 'gravity reference error', 'prior']
    """
    if name in (NOISE, REPEATABILITY, SETTINGS, ORDER, PRIOR):
        return name
    return error_name(name).partition(" about ")[0]


def assumed_exact(
    result: Fit, relative: bool, exact_angles: Mapping[str, Bools] | None = None
) -> list[list[str]]:
    """References and conditions that each run assumes exact whose error moves no residual, but the calibration.

    And first the `exact_angles` of the stand (B,), by name: their errors pass for noise.
    A toolface zero, or a tool that leans in the stand, turns both triads, and a strength scales one, as sensors of
    other mounting or scale would have it. The field = 1 of a `relative` magnetometer is no reference. The signs of the
    magnetometer are assumed where nothing confirms the hemisphere: see `unconfirmed_dip`. The sensors of a
    model of order 1 or more have the temperature of the thermometer: one that is ahead of them by as much at all
    stations shifts the model alone. Offsets are
    taken as steady where attitudes follow the order of the stations so closely that a trend would look like the
    sensors: see `unseen_drifts`.
    """
    evidence, quantities = result.problem.evidence, ("toolface", "gravity", "field")
    declared = {c.name.removesuffix("-zero") for c in evidence.constants} | set(evidence.absent)
    if relative:
        declared.add("field")
    aligned = evidence.is_known("inclination").any(-1) & ("tool-axis-x" not in declared)
    holds = {
        "toolface zero of the stand" if name == "toolface" else f"{name} reference": (
            evidence.is_known(name).any(-1)
        )
        for name in quantities[: 1 + len(result.problem.triads)]
        if name not in declared
    }
    holds[ALIGNMENT] = aligned
    dip = unconfirmed_dip(result)
    holds |= {SIGNS[0]: dip >= 0, SIGNS[1]: dip < 0}
    temperature = result.problem.temperature
    fall = np.max(np.maximum.accumulate(temperature, -1) - temperature, -1)
    rise = np.max(temperature - np.minimum.accumulate(temperature, -1), -1)
    one_way = np.asarray(np.minimum(rise, fall) < LEAST_RETURN * np.ptp(temperature, -1))
    holds[THERMOMETER] = one_way & any(orders_of(result))
    holds |= {STEADINESS[name]: members for name, members in unseen_drifts(result).items()}
    holds = {**(exact_angles or {}), **holds}
    return [[*compress(holds, each)] for each in np.stack([*holds.values()], -1).tolist()]


def unseen_drifts(result: Fit) -> dict[str, Bools]:
    """Members (B,) whose residuals would not show the trend of a drift that is not in the fit, by its name."""
    return result.problem.once("unseen drifts", result.state, lambda _: _unseen_drifts(result))


def _unseen_drifts(result: Fit) -> dict[str, Bools]:
    if result.analysis.influence is not None:
        return {}
    unseen = drift.held_trends(result.problem)
    if {*drift.families(result.problem)} <= {*unseen}:
        return unseen
    scores = drift.walk_scores(result.problem, result.state, result.analysis)
    return unseen | {name: scores.shown(name) < drift.LEAST_TREND for name in scores.places}


def unseen_shares(result: Fit) -> dict[str, Array]:
    """Covariance (B, p, p) that each drift which a run would not show adds, per 1σ of 1 g or nT from end to end."""
    problem, state, analysis = result.problem, result.state, result.analysis
    unseen = [name for name, members in unseen_drifts(result).items() if members.any()]
    effects = {name: drift.trend_effect(problem, state, analysis, name) for name in unseen}
    return {name: effect @ effect.mT for name, effect in effects.items()}


def unconfirmed_dip(result: Fit) -> Array:
    """Dip (B,), radians, whose sign rests on the signs of the magnetometer in the profile alone, else NaN.

    Definition: with all signs reversed a field of dip D reads like one of dip -D with north and south exchanged.
    A known dip tells the two apart, and so does an azimuth, unless the zero of azimuth is unknown.
    """
    problem, known = result.problem, result.problem.evidence.is_known
    if len(problem.triads) == 1:
        return np.full(len(result.status), np.nan)
    unknown = {constant.name for constant in problem.evidence.constants if constant.unknown}
    confirmed = known("dip").any(-1)
    if "azimuth-zero" not in unknown:
        confirmed |= known("azimuth").any(-1)
    dip = np.arcsin(np.sin(problem.constant(result.state, "dip").mean(-1)))
    return np.asarray(np.where(confirmed, np.nan, dip))


def _scaled(result: Fit, covariance: Array) -> Array:
    """A covariance (B, p, p) of independent errors of the readings times the `variance_scales`."""
    sizes = [t.model.size for t in result.problem.triads]
    grown = np.repeat(np.sqrt(variance_scales(result)), sizes, axis=-1)
    return np.asarray(covariance * outer(grown))


def _of_lone_settings(result: Fit) -> Array:
    """Covariance (B, p, p) from errors of angles that the stand sets at every station, before scaling."""
    return of_stand(result.problem, result.state, result.analysis)


def _of_repeatability(result: Fit, repeatability: Array | None) -> Array:
    """Covariance (B, p, p) from the repeatability of each triad's readings, before scaling.

    It is a part of the noise that is declared; where the noise is estimated it is in the estimate.
    """
    declared = np.isnan(result.noise)
    if repeatability is None or not (declared.any() and repeatability.any()):
        return np.zeros_like(result.analysis.covariance)
    shares = [
        (known * sd)[:, None, None] / triad.sd
        for known, sd, triad in zip(
            declared.mT, repeatability.mT, result.problem.triads, strict=False
        )
    ]
    moved = moved_by_readings(result.problem.linear(result.state), result.analysis)
    return sum_of_squares(moved * np.concatenate(shares, -1)[:, :, None])


@dataclass(frozen=True)
class TriadResults:
    """One triad of B tools, at the reference temperature.

    `model` is that of the calibration file, of `parameters` (B, k); `sd` (B, k) are their standard
    uncertainties, NaN where a free direction moves one. By tool (B,): `rank` of the `size` fitted
    parameters, `noise` of one reading and whether it was `declared`, s² as `variance_factor` with
    its `degrees_of_freedom`; NaN without any.
    """

    model: Whole
    parameters: Array
    sd: Array
    rank: Array
    size: Array
    noise: Array
    declared: Bools
    variance_factor: Array
    degrees_of_freedom: Array


def triad_results(
    result: Fit, index: int, covariance: Array, free: Sequence[list[Free]], reference: float
) -> TriadResults:
    """The results of one triad, `free` directions of each tool and `covariance` (B, p, p) being known."""
    triad, where = result.problem.triads[index], result.problem.slices()[index]
    model, to_file = triad.model.finished(reference)
    params = result.state.params[:, where]
    to_file = np.broadcast_to(to_file, (len(params), *to_file.shape[-2:]))
    inner = to_file @ covariance[:, where, where]
    variance = np.einsum("bij,bij->bi", inner, to_file)
    sd = np.sqrt(np.where(variance >= 0, variance, np.nan))  # below 0: lost in rounding
    values = np.einsum("bij,bj->bi", to_file, params)
    size = np.full(len(params), triad.model.size)
    rank = size.copy()
    some = np.flatnonzero([bool(each) for each in free])
    if some.size:
        rank[some] = marginal_rank(take(result.analysis.determined, some), where)
        rows = free_rows([free[i] for i in some.tolist()], covariance.shape[-1])[..., where]
        moved = np.abs(np.einsum("bij,bkj->bki", to_file[some], rows)).max(1)
        part = take(result.problem, some)
        file_model = part.triads[index].model.finished(reference)[0]
        effect = _effect(file_model, values[some], part.triads[index].raw, part.temperature)
        sd[some] = np.where(moved * effect > FREE_SHARE, np.nan, sd[some])
    declared, freedom = np.isnan(result.noise[:, index]), result.analysis.freedom[:, index]
    noise = reading_noise(result)[:, index]
    factor = np.where(freedom >= 1, result.analysis.variance_factor[:, index], np.nan)
    return TriadResults(model, values, sd, rank, size, noise, declared, factor, freedom)


def reading_noise(result: Fit) -> Array:
    """Standard deviation (B, t) of one reading of each triad, estimated or the mean of what is declared."""
    declared = np.stack([triad.sd.mean((-1, -2)) for triad in result.problem.triads], -1)
    return np.where(np.isnan(result.noise), declared, result.noise)


def _effect(model: Whole, params: Array, raw: Array, temperature: Array) -> Array:
    """By how much of the field each parameter (B, k) changes it, per unit, over the run's stations."""
    strength = np.linalg.norm(model.fields(params, raw, temperature), axis=-1).mean(-1)
    squares = np.sum(model.jacobian(params, raw, temperature) ** 2, -2)
    return np.asarray(np.sqrt(squares.mean(-2)) / strength[:, None])


def free_rows(free: Sequence[list[Free]], size: int) -> Array:
    """Free directions (B, k, p) of every tool, rows of zeros where there are fewer than k."""
    count = max(map(len, free), default=0)
    nothing = [np.zeros(size)] * count
    rows = [([entry.direction for entry in each] + nothing)[:count] for each in free]
    return np.reshape(rows, (len(free), count, size))


def to_file(result: Fit, reference: float) -> Array:
    """Linear maps (B, k, p) from the fit's parameters to the file's, of all triads, held ones included."""
    maps = [triad.model.finished(reference)[1] for triad in result.problem.triads]
    rows = np.cumsum([0, *(each.shape[-2] for each in maps)])
    whole = np.zeros((len(result.status), rows[-1], result.state.params.shape[-1]))
    for start, each, where in zip(rows, maps, result.problem.slices(), strict=False):
        whole[:, start : start + each.shape[-2], where] = each
    return whole


def triad_singular_values(result: Fit, index: int) -> Array:
    """Singular values (B, p_t) of one triad when all that is shared with the other is free.

    Largest first, as shares of it.
    """
    reduced, _, _ = result.problem.linear(result.state, geometry=True).normal.reduced
    norms, where = result.analysis.determined.norms, result.problem.slices()[index]
    scaled = reduced / outer(norms)
    other = np.ones(norms.shape[-1], bool)
    other[where] = False
    cross = scaled[:, other][..., where]
    inverse = np.linalg.pinv(scaled[:, other][..., other], rcond=1e-6, hermitian=True)
    values = np.linalg.eigvalsh(scaled[:, where, where] - cross.mT @ inverse @ cross)
    values = np.sqrt(np.clip(values[:, ::-1], 0, None))
    return np.asarray(values / values[:, :1])


def temperature_range(result: Fit, prior: PriorInformation | None) -> tuple[Array, Array]:
    """Coldest and hottest station (B,) each, °C; those behind the prior count too."""
    low, high = prior.temperature if prior and prior.temperature else (np.inf, -np.inf)
    temperature = result.problem.temperature
    return np.minimum(temperature.min(-1), low), np.maximum(temperature.max(-1), high)


def calibrated_tools(
    result: Fit, free: Sequence[list[Free]], reference: float, prior: PriorInformation | None
) -> CalibratedTools:
    """The tools at the reference temperature, moved into their range where it lies outside."""
    problem, state = result.problem, result.state
    means = [problem.constant(state, name).mean(-1) for name in ("gravity", "field", "dip")]
    return CalibratedTools(
        models=tuple(triad.model for triad in problem.triads),
        parameters=tuple(state.params[:, where] for where in problem.slices()),
        earth=np.stack(means, -1),
        temperature=np.clip(reference, *temperature_range(result, prior)),
        free=free_rows(free, state.params.shape[-1]),
        noise=reading_noise(result),
    )


def earth(result: Fit) -> dict[str, Array]:
    """Mean gravity, g, field and dip (B,) of each run, given or estimated."""
    problem, state = result.problem, result.state
    gravity, field, dip = (problem.constant(state, n).mean(-1) for n in ("gravity", "field", "dip"))
    magnetic = {"field": field, "dip_deg": np.degrees(dip)} if len(problem.triads) > 1 else {}
    return {"gravity_g": gravity, **magnetic}


def drifts(result: Fit) -> dict[str, tuple[Array, Array]]:
    """How far each drift went within the run and the standard uncertainty of that (B,): g or nT.

    Definition: the largest distance between two of its stations, along which its uncertainty is taken.
    """
    changes = {}
    for name in drift.places(result.problem.evidence):
        path, terms = drift.walk(result.problem, result.state, name)
        size = dot(path, path)
        square = size[:, :, None] + size[:, None] - 2 * (path @ path.mT)
        far = square.reshape(len(path), -1).argmax(-1)
        first, second = np.unravel_index(far, square.shape[1:])
        every = np.arange(len(path))
        apart = path[every, first] - path[every, second]
        change = length(apart)
        along = apart / np.maximum(change, 1e-300)[:, None]
        pull = outer(along, terms[first] - terms[second]).reshape(len(path), -1)
        spread = drift.walk_covariance(result.problem, result.analysis, name)
        changes[name] = change, np.sqrt(np.sum((spread @ pull[..., None])[..., 0] * pull, -1))
    return changes


def drift_shares(result: Fit, values: Array) -> dict[str, Array]:
    """Share (B,) of each drift within the run that goes with some values (B, n) of its stations.

    Definition: r² of the drift, all axes together, with what of the values the terms of a drift can follow.
    """
    shares = {}
    for name in drift.places(result.problem.evidence):
        path, terms = drift.walk(result.problem, result.state, name)
        basis = np.linalg.qr(terms - terms.mean(0))[0]
        column = basis @ (basis.mT @ (values - values.mean(-1, keepdims=True))[..., None])
        unit = column / np.maximum(np.linalg.norm(column, axis=-2, keepdims=True), 1e-300)
        path = path - path.mean(-2, keepdims=True)
        size = np.maximum(np.sum(path**2, (-2, -1)), 1e-300)
        shares[name] = np.sum((unit.mT @ path) ** 2, (-2, -1)) / size
    return shares


def stand_errors(result: Fit) -> dict[str, Array]:
    """Estimated errors (B,) of the stand by field of `StandErrors`, degrees: those that are unknowns."""
    constants = result.problem.evidence.constants
    names = [c.name if c.unknown and c.name in STAND_ERRORS else "" for c in constants]
    if not any(names):
        return {}
    value, covariance = np.degrees(result.state.constants), constants_covariance(result)
    covariance = np.degrees(np.degrees(covariance))
    errors = {}
    for place, name in enumerate(names):
        if name.endswith("-zero"):
            word = name.replace("-", "_")
            errors[f"{word}_deg"] = value[:, place]
            errors[f"{word}_uncertainty_deg"] = np.sqrt(covariance[:, place, place])
    if "stand-north" in names:
        pair = [names.index("stand-north"), names.index("stand-east")]
        errors |= _tilt(value[:, pair], covariance[:, pair][..., pair])
    return errors


def _tilt(turn: Array, covariance: Array) -> dict[str, Array]:
    """Size and azimuth of a tilt from its turns (B, 2) about north and east, degrees."""
    size = np.linalg.norm(turn, axis=-1)
    along = turn / size[:, None]
    across = np.stack([-along[:, 1], along[:, 0]], -1)
    sd, sd_across = (
        np.sqrt(np.einsum("bi,bij,bj->b", axis, covariance, axis)) for axis in (along, across)
    )
    return {
        "tilt_deg": size,
        "tilt_uncertainty_deg": sd,
        "tilt_azimuth_deg": np.degrees(np.arctan2(-turn[:, 0], turn[:, 1])) % 360,
        "tilt_azimuth_uncertainty_deg": np.degrees(sd_across / size),
    }
