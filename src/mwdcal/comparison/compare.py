"""Every applicable method on the same run, side by side, judged by stations left out.

One gauge for several calibrations of a run, so that their parameters can be compared.

A turn or a stretch that no evidence determines is put by convention: the mean gain of a triad,
split into rotation and symmetric stretch, has no rotation, and the mean strength of its field
is that of the references. Here every calibration is put there, also the one that determines
the direction; the turn and the stretch that are taken out of each are kept beside, with their
uncertainty. (In geodesy: an S-transformation.)
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any, ClassVar

import msgspec
import numpy as np

from mwdcal.calibration.automatic.auto import Choice, Progress, resolved, without
from mwdcal.calibration.automatic.drift import fit_run
from mwdcal.calibration.calibrate import recorded
from mwdcal.calibration.diagnosis.refusals import check_readings
from mwdcal.calibration.estimate import Fit, fit
from mwdcal.calibration.methods import EVIDENCE, SWARM_ITERATIONS, evidence_of
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import CONSTANTS, TRIADS, Readings, is_simulated
from mwdcal.calibration.record import FREE_SHARE, Calibration, Measures, TriadCalibration
from mwdcal.calibration.residuals import SHOWN, departure, nominal, rms, shown_in, vector_measures
from mwdcal.errors import FitError, MwdcalError
from mwdcal.estimation.minimisers.swarm import least_squares_forward, swarm_forward, vector_cost
from mwdcal.estimation.problem import ANGLES
from mwdcal.estimation.solvers import Status
from mwdcal.estimation.uncertainty import ROTATIONS, Free, free_directions, unrotating
from mwdcal.geometry.vectors import Array, directions, group_scatter, reference_vectors
from mwdcal.sensor.models import Model
from mwdcal.sensor.profile import Profile
from mwdcal.use.notation import Notation, convert

SCALE = "scale"
DERIVATIVE_STEP = 1e-6
"""Step of a derivative, as the share of the field by which it changes the field."""


@dataclass(frozen=True)
class Gauge:
    """Directions put by convention, each with the triads that it turns or stretches together."""

    free: frozenset[tuple[str, tuple[int, ...]]]

    @classmethod
    def of(cls, free: Iterable[Free]) -> Gauge:
        """All that any of several calibrations leaves free, but for courses with temperature."""
        return cls(frozenset((f.id, f.triads) for f in free if f.id in (*ROTATIONS, SCALE)))

    def names(self, triad: int) -> list[str]:
        """The directions that are put by convention for one triad, in their usual order."""
        free = {name for name, triads in self.free if triad in triads}
        return [name for name in (*ROTATIONS, SCALE) if name in free]


def in_gauge(
    calibration: Calibration, readings: Readings, gauge: Gauge
) -> tuple[dict[str, Notation], dict[str, Notation]]:
    """Factors of each triad in a gauge, and what was taken out to put them there.

    Taken out: `rotation_deg` (3,), the rotation vector in degrees about the tool axes, and
    `scale` (1,), each with uncertainty: NaN where this calibration does not determine it.
    Own-axis terms do not count: factors are those of the tangent at the centre of the readings.
    """
    calibration = _straight(calibration)
    settle = _Settle.of(calibration, readings, gauge)
    params, size = calibration.parameters, len(calibration.parameters)
    settled, slope = settle(params), settle.slope(calibration, readings, params)
    covariance, free = _carried(calibration, slope)
    triads = [
        msgspec.structs.replace(triad, parameters=settled[where].tolist())
        for triad, where in zip(calibration.triads, settle.slices, strict=True)
    ]
    record = _replaced(calibration, triads, covariance[:size, :size], free[:, :size])
    names, rest = [t.name for t in triads], (covariance[size:, size:], free[:, size:])
    return convert(record, "factors"), _taken_out(names, settled[size:], *rest)


def _carried(calibration: Calibration, slope: Array) -> tuple[Array, Array]:
    """Covariance and free directions of the parameters, through a linear map."""
    covariance = slope @ calibration.parameter_covariance @ slope.transpose()
    return covariance, calibration.free_directions @ slope.transpose()


def _taken_out(
    triads: list[str], taken: Array, covariance: Array, free: Array
) -> dict[str, Notation]:
    """Rotation and scale of each triad, from those (4 t,) of all in radians."""
    unit = np.array([*np.full(3, np.degrees(1)), 1.0])
    moved = np.abs(free).max(0, initial=0.0)
    sd = np.where(moved > FREE_SHARE, np.nan, np.sqrt(np.maximum(np.diag(covariance), 0)))
    each = np.stack([taken, sd]).reshape(2, len(triads), 4) * unit
    notations = {}
    for index, name in enumerate(triads):
        block = slice(4 * index, 4 * index + 4)
        value, spread = ({"rotation_deg": v[:3], "scale": v[3:]} for v in each[:, index])
        notations[name] = Notation(value, spread, covariance[block, block] * np.outer(unit, unit))
    return notations


@dataclass(frozen=True)
class _Settle:
    """The map from the parameters (p,) of all triads to those in the gauge."""

    gauge: Gauge
    models: list[Model]
    slices: list[slice]
    raw: list[Array]
    temperature: Array
    nominal: list[float]

    @classmethod
    def of(cls, calibration: Calibration, readings: Readings, gauge: Gauge) -> _Settle:
        reference, triads = calibration.reference_temperature, calibration.triads
        temperature = readings.temperature
        if temperature is None:
            temperature = np.full(readings.count, reference)
        strengths = [readings.reference(name) for name in ("gravity", "field")[: len(triads)]]
        return cls(
            gauge,
            [t.functions(reference) for t in triads],
            [*calibration.places().values()],
            [getattr(readings, t.name) for t in triads],
            temperature,
            [1.0 if np.isnan(s).all() else float(np.nanmean(s)) for s in strengths],
        )

    def __call__(self, params: Array) -> Array:
        """Parameters in the gauge, then per triad the rotation vector, rad, and scale taken out."""
        parts = [params[w] for w in self.slices]
        every = tuple(range(len(parts)))
        turned = [np.eye(3) for _ in every]
        for triads in dict.fromkeys([every, *((t,) for t in every)]):
            turn = self._turn(parts[triads[0]], triads)
            for t in triads:
                parts[t] = self.models[t].transformed(parts[t], turn)
                turned[t] = turn @ turned[t]
        taken = []
        for t in every:
            factor = self._factor(parts[t], t)
            parts[t] = self.models[t].transformed(parts[t], factor * np.eye(3))
            taken += [*_rotation_vector(turned[t].transpose()), 1 / factor]
        return np.concatenate([*parts, taken])

    def slope(self, calibration: Calibration, readings: Readings, params: Array) -> Array:
        """Derivative (p + 4 t, p) of the map, by central differences."""
        effect, fields = calibration.jacobian(readings), calibration.fields(readings)
        steps: list[float] = []
        for t, where in enumerate(self.slices):
            strength = np.linalg.norm(fields[t], axis=-1).mean()
            rows = effect[:, 3 * t : 3 * t + 3, where]
            sizes = np.sqrt(np.mean(np.sum(rows**2, 1), 0)) / strength
            steps += (DERIVATIVE_STEP / sizes).tolist()
        moves = np.diag(steps)
        changes = [self(params + move) - self(params - move) for move in moves]
        return np.asarray(np.stack(changes, -1) / (2 * np.array(steps)))

    def _turn(self, params: Array, triads: tuple[int, ...]) -> Array:
        """The turn that leaves the first triad's gain without rotation about the free axes."""
        first, free = triads[0], [(axis, triads) in self.gauge.free for axis in ROTATIONS]
        gain = self.models[first].slope(params, self.raw[first], self.temperature).mean(0)
        return unrotating(gain, np.array(free))

    def _factor(self, params: Array, triad: int) -> float:
        """What brings the triad's mean strength to that of the references, if its scale is free."""
        if SCALE not in self.gauge.names(triad):
            return 1.0
        fields = self.models[triad].fields(params, self.raw[triad], self.temperature)
        return self.nominal[triad] / float(np.linalg.norm(fields, axis=-1).mean())


def _rotation_vector(turn: Array) -> Array:
    """Rotation vector (3,), rad, of a rotation by less than half a turn."""
    odd = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    sine = np.linalg.norm(odd)
    angle = np.arctan2(sine, (np.trace(turn) - 1) / 2)
    return odd * (angle / sine if sine > 0 else 1.0)


def _straight(calibration: Calibration) -> Calibration:
    """The calibration with own-axis terms replaced by the tangent at the centre of the readings."""
    from scipy.linalg import block_diag

    if not any(t.curved for t in calibration.triads):
        return calibration
    blocks = [_tangent(t, calibration.reference_temperature) for t in calibration.triads]
    triads = [
        msgspec.structs.replace(
            triad,
            curved=False,
            parameter_names=triad.parameter_names[: len(block)],
            parameters=(block @ triad.parameters).tolist(),
        )
        for triad, block in zip(calibration.triads, blocks, strict=True)
    ]
    return _replaced(calibration, triads, *_carried(calibration, block_diag(*blocks)))


def _replaced(
    calibration: Calibration, triads: list[TriadCalibration], covariance: Array, free: Array
) -> Calibration:
    """The calibration with other parameters, their covariance and their free directions."""
    return msgspec.structs.replace(
        calibration,
        accelerometer=triads[0],
        magnetometer=triads[1] if len(triads) > 1 else None,
        covariance_rows=covariance.tolist(),
        free=free.tolist(),
    )


def _tangent(triad: TriadCalibration, reference: float) -> Array:
    """Linear map from a triad's parameters to those of its tangent on plain readings."""
    if not triad.curved:
        return np.eye(len(triad.parameters))
    _, plain = msgspec.structs.replace(triad, curved=False).functions(reference).finished(reference)
    return np.concatenate([plain, np.zeros((len(plain), 6))], -1)


SCATTER = "scatter within groups"
FOLDS = 8
"""Parts into which the stations are dealt; each is left out once."""
SINGLY = 24
"""Runs of no more stations have each left out by itself."""
NEAR_BEST = 1.02
"""A simpler preference stands if its held-out error is within this ratio of the best."""


@dataclass(frozen=True)
class Row:
    """One method on the run: what it reached, or why it was refused.

    `in_sample` and `held_out` are root mean square errors by observable in shown units, only
    where the run has references, whichever of them the method used; `resting` names those that
    rest on a convention, because the method leaves a direction free. `lost` counts stations
    that no fit without them could judge. `measures` are Moradi's, after the fit and left out.
    `parameters` are factors by triad, in the gauge of the comparison, and `taken_out` what puts
    them there (`mwdcal.comparison.compare`). `station_errors` (n,) are left out, in shown units; `course`
    is the swarm's: excess of its cost over the least after each iteration, by triad.
    """

    method: str
    refused: str = ""
    ranks: dict[str, tuple[int, int]] = field(default_factory=dict)
    undetermined: tuple[str, ...] = ()
    iterations: int = 0
    seconds: float = 0.0
    in_sample: dict[str, float] = field(default_factory=dict)
    held_out: dict[str, float] = field(default_factory=dict)
    resting: tuple[str, ...] = ()
    lost: int = 0
    measures: tuple[Measures, ...] = ()
    parameters: dict[str, Notation] = field(default_factory=dict)
    taken_out: dict[str, Notation] = field(default_factory=dict)
    station_errors: dict[str, Array] = field(default_factory=dict)
    course: dict[str, Array] = field(default_factory=dict)


@dataclass(frozen=True)
class Comparison:
    """All methods on one run, the units of their errors, and which to use and why.

    `orders` are the temperature orders of the triads, `curved` those with own-axis terms;
    `parts` counts the parts of the stations that were left out in turn. `before` and
    `measures_before` are errors of the nominal readings; `gauge` names, by triad, the
    directions that some method leaves free and all are therefore stripped of.
    """

    summary: ClassVar[Callable[..., str]]
    to_dict: ClassVar[Callable[..., dict[str, Any]]]
    report: ClassVar[Callable[..., None]]
    """As of `Calibration`."""

    run: str
    profile: Profile
    stations: int
    labels: tuple[str, ...]
    simulated: bool
    orders: tuple[int, int]
    curved: tuple[str, ...]
    parts: int
    seed: int
    units: dict[str, str]
    before: dict[str, float]
    measures_before: tuple[Measures, ...]
    gauge: dict[str, list[str]]
    rows: tuple[Row, ...]
    advice: str


@dataclass(frozen=True)
class _Calibrated:
    """One method's calibration, its fit and the time that took, and the free directions."""

    options: Options
    record: Calibration
    fit: Fit
    seconds: float
    free: list[Free]


def compare(
    readings: Readings,
    profile: Profile,
    options: Options | None = None,
    *,
    progress: Progress = lambda text: None,
) -> Comparison:
    """Calibrate a run by every method and judge each by stations left out of its fit.

    Choices that the `options` leave open are made as the joint method does, the same for all
    methods; their method does not count. A method that is refused gives its reason and leaves the
    others alone.
    """
    options = options or Options()
    readings = without(readings, options.exclude)
    options = _options(readings, profile, options, progress)
    results: list[_Calibrated | Row] = []
    for method in EVIDENCE:
        progress(f"{method}: fit")
        results.append(_calibrated(readings, profile, replace(options, method=method)))
    usable = [one for one in results if isinstance(one, _Calibrated)]
    gauge = Gauge.of(entry for one in usable for entry in one.free)
    judge = _Judge(readings, usable[0].record.earth if usable else {})
    rows = [one if isinstance(one, Row) else _row(one, judge, gauge, progress) for one in results]
    return _compared(judge, profile, options, gauge, tuple(rows))


def _compared(
    judge: _Judge, profile: Profile, options: Options, gauge: Gauge, rows: tuple[Row, ...]
) -> Comparison:
    """The rows with what they have in common."""
    readings, bare = judge.readings, nominal(judge.readings)
    return Comparison(
        run=readings.source,
        profile=profile,
        stations=readings.count,
        labels=readings.labels,
        simulated=is_simulated(readings.metadata),
        orders=options.orders,
        curved=tuple(options.curved),
        parts=judge.parts,
        seed=options.seed,
        units=judge.units,
        before=judge.summary(*bare),
        measures_before=judge.measures("before", *bare),
        gauge={name: gauge.names(i) for i, name in enumerate(TRIADS) if gauge.names(i)},
        rows=rows,
        advice=advice(rows),
    )


def _options(readings: Readings, profile: Profile, options: Options, progress: Progress) -> Options:
    """The options without `auto`; a run that cannot be chosen for is left to the methods to refuse."""
    options = replace(options, method="joint")
    try:
        return resolved(options, readings, profile, progress)[0]
    except FitError:
        return replace(options, order=options.orders, nonlinearity=options.curved)


def _calibrated(readings: Readings, profile: Profile, options: Options) -> _Calibrated | Row:
    """A method's calibration, or the row that says why there is none."""
    try:
        check_readings(readings, options)
        started = time.perf_counter()
        result = fit_run(readings, options)
        seconds = time.perf_counter() - started
        record = recorded(Choice(readings, profile, options), result)
    except MwdcalError as error:  # what is wrong for all methods was refused before
        return Row(options.method, refused=str(error))
    except np.linalg.LinAlgError as error:
        weak = f"the stations are too weak to fit the model ({error}). Add stations."
        return Row(options.method, refused=weak)
    free = free_directions(result.problem, result.state, result.analysis.determined)[0]
    return _Calibrated(options, record, result, seconds, free)


def _row(calibrated: _Calibrated, judge: _Judge, gauge: Gauge, progress: Progress) -> Row:
    """The errors of a method, in the fit and left out."""
    record, readings, method = calibrated.record, judge.readings, calibrated.options.method
    progress(f"{method}: {judge.parts} fits without a part of the stations each")
    left_out = judge.left_out(calibrated.options)
    inside = record.fields(readings)
    parameters, taken_out = in_gauge(record, readings, gauge)
    return Row(
        method,
        ranks={t.name: (t.rank, t.size) for t in record.triads},
        undetermined=tuple(dict.fromkeys(u.id for u in record.undetermined())),
        iterations=int(calibrated.fit.iterations[0]),
        seconds=calibrated.seconds,
        in_sample=judge.summary(*inside),
        held_out=judge.summary(*left_out),
        resting=tuple(n for n in judge.units if _rests(n, record, readings)),
        lost=int(np.isnan(left_out[0]).any(-1).sum()),
        measures=judge.measures("after", *inside) + judge.measures("left out", *left_out),
        parameters=parameters,
        taken_out=taken_out,
        station_errors=judge.errors(*left_out),
        course=_course(calibrated) if method == "swarm" else {},
    )


def _rests(name: str, record: Calibration, readings: Readings) -> bool:
    """Whether an error moves with a direction that a method leaves free."""
    moving = ("inclination", "azimuth") if name == SCATTER else (name,)
    return any(bool(record.rests_on_free(n, readings).any()) for n in moving)


def _course(calibrated: _Calibrated) -> dict[str, Array]:
    """Excess of the swarm's best cost over the least one, as a share of it, by triad."""
    problem, seed = calibrated.fit.problem, calibrated.options.seed
    targets, courses = problem.targets(calibrated.fit.state), {}
    for name, triad, target in zip(TRIADS, problem.triads, targets, strict=False):
        swarm = swarm_forward(triad.raw, target, iterations=SWARM_ITERATIONS, seed=seed)
        least = least_squares_forward(triad.raw, target)[:, None]
        cost = vector_cost(triad.raw, target)(least)[0, 0]
        courses[name] = swarm.history[0] / cost - 1
    return courses


def _referenced(readings: Readings) -> list[str]:
    """Observables that have a reference somewhere in the run."""
    usable = SHOWN if readings.magnetometer is not None else SHOWN[:3]
    return [n for n in usable if not np.isnan(readings.reference(n)).all()]


def errors(readings: Readings, g: Array, b: Array) -> dict[str, Array]:
    """Error (n,) of each observable against the run's own reference, as `calibrate` states it.

    Of angles that is the group's where a station of a group has none of its own.
    """
    shared = evidence_of(readings, np.ones(readings.count)).known
    known = {n: shared[n][0] if n in ANGLES else readings.reference(n) for n in SHOWN}
    return {name: departure(name, g, b, known) for name in _referenced(readings)}


@dataclass(frozen=True)
class _Judge:
    """How well vectors agree with a run's references, the same for every method.

    `earth` stands in where field and dip have no reference.
    """

    readings: Readings
    earth: Mapping[str, float]

    @property
    def parts(self) -> int:
        """Number of parts into which the stations are dealt."""
        return self.readings.count if self.readings.count <= SINGLY else FOLDS

    @property
    def grouped(self) -> bool:
        """Whether directions within groups can be compared."""
        return bool((self.readings.groups >= 0).any()) and self.readings.magnetometer is not None

    @property
    def units(self) -> dict[str, str]:
        """Units in which errors are shown."""
        relative = self.readings.relative
        units = {name: shown_in(name, relative)[1] for name in _referenced(self.readings)}
        return {**units, SCATTER: "°"} if self.grouped else units

    def errors(self, g: Array, b: Array) -> dict[str, Array]:
        """Errors (n,) of two vectors by observable, in shown units."""
        relative = self.readings.relative
        each = errors(self.readings, g, b)
        return {name: error * shown_in(name, relative)[0] for name, error in each.items()}

    def left_out(self, options: Options) -> tuple[Array, Array]:
        """Vectors (n, 3) of each station from the fit that left its part out; NaN if that failed."""
        part = np.arange(self.readings.count) % self.parts
        include = (np.arange(self.parts)[:, None] != part).astype(float)
        result = fit(self.readings, options, include)
        lost = (result.status != Status.OK)[part][:, None]
        vectors = result.problem.fields(result.state)
        g, b = (np.where(lost, np.nan, v[part, range(len(part))]) for v in vectors)
        return g, b

    def summary(self, g: Array, b: Array) -> dict[str, float]:
        """Root mean square errors by observable, and the scatter within groups, in shown units."""
        result = {name: float(rms(error)) for name, error in self.errors(g, b).items()}
        if self.grouped:
            scatter = group_scatter(directions(g, b), self.readings.groups)
            result[SCATTER] = float(np.degrees(scatter))
        return result

    def measures(self, when: str, *fields: Array) -> tuple[Measures, ...]:
        """Moradi's measures of the vector error, as a share of the reference vector."""
        known = {name: self.readings.reference(name) for name in (*ANGLES, *CONSTANTS)}
        dip = np.radians(self.earth.get("dip_deg", np.nan))
        for name, value in (("field", self.earth.get("field", np.nan)), ("dip", dip)):
            known[name] = np.where(np.isnan(known[name]), value, known[name])
        blind = {**known, "azimuth": np.zeros(self.readings.count)}
        ideal = reference_vectors(**blind)[0], reference_vectors(**known)[1]
        each = zip(TRIADS, fields, ideal, strict=True)
        measures = [vector_measures(name, when, f[None], i[None])[0] for name, f, i in each]
        return tuple(chain.from_iterable(measures))


def score(row: Row, best: Mapping[str, float]) -> float:
    """Mean ratio of a method's held-out errors to the best of any method."""
    ratios = np.array([row.held_out[n] / value for n, value in best.items() if value > 0])
    known = ratios[~np.isnan(ratios)]
    return float(known.mean()) if known.size else float("inf")


def able(rows: Iterable[Row]) -> list[Row]:
    """The methods that could calibrate the run."""
    return [row for row in rows if not row.refused]


def _gaps(row: Row) -> tuple[int, int]:
    """Directions that a method leaves free, and stations that it could not be judged by."""
    return len(row.undetermined), row.lost


def advice(rows: tuple[Row, ...]) -> str:
    """Which method to use on this run, and why."""
    usable = able(rows)
    if not usable:
        return "no method can calibrate this run: see why each was refused."
    names = usable[0].held_out
    best = {n: float(np.fmin.reduce([row.held_out[n] for row in usable])) for n in names}
    scores = {row.method: score(row, best) for row in usable}
    winner = min(usable, key=lambda row: (*_gaps(row), scores[row.method]))
    for joint in (row for row in usable if row.method == "joint" and _gaps(row) <= _gaps(winner)):
        winner = joint if scores["joint"] <= NEAR_BEST * scores[winner.method] else winner
    why = f"{winner.method}: held-out errors {scores.pop(winner.method):.2f} times the best of each"
    free = f"; leaves {', '.join(winner.undetermined)} undetermined" if winner.undetermined else ""
    others = ", ".join(
        f"{m} {s:.2f}" for m, s in sorted(scores.items(), key=lambda x: round(x[1], 2))
    )
    return f"use {why}{free}" + (f" (others: {others})." if others else ".")
