"""A batch of tools calibrated at once: one fit for all, and each tool checked as if it were alone.

Every tool of a `Batch` has the same number of stations and the same kinds of evidence. What
`calibrate` would refuse is refused here with the same words: a screen of array operations
picks the suspects, and the check of a single run decides and speaks. Results are columns, not
objects: `names` says which.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from mwdcal.calibration import FREE_SHARE
from mwdcal.checks import check_fit, check_readings
from mwdcal.core.models import Basis, Factors, Polynomial, Whole
from mwdcal.core.observability import Free
from mwdcal.core.uncertainty import marginal_rank
from mwdcal.core.vectors import AnyArray, Array, Ints
from mwdcal.errors import MwdcalError
from mwdcal.estimate import Fit, fit
from mwdcal.fleet_accuracy import ANGLES, typical_sd
from mwdcal.fleet_checks import free_of_batch, suspect_fits, suspect_readings
from mwdcal.options import Options
from mwdcal.profile import Profile
from mwdcal.readings import TRIADS, Readings

CHUNK = 256
"""Tools fitted in one call: few enough for the cache, many enough for NumPy."""
OK, BAD_INPUT, FAILED = "ok", "bad-input", "failed"
FACTS = ("rank", "size", "noise", "variance_factor", "degrees_of_freedom")
"""Columns of a triad besides its parameters and their standard uncertainties."""
EARTH = ("gravity_g", "field", "dip_deg")

Alone = Callable[[int], tuple[Readings, Profile]]
"""Readings and profile of one tool of a batch by themselves, as `calibrate` takes them."""


@dataclass(frozen=True)
class Outcome:
    """What became of B tools: a status and a message each, and columns (B,) of results.

    `columns` hold NaN where a tool has no result. `free` lists, for each tool and triad, the
    ids of directions that nothing determines.
    """

    status: AnyArray
    message: AnyArray
    columns: dict[str, Array]
    free: list[tuple[list[str], ...]]


def model_parameters(options: Options, triad: int) -> tuple[str, ...]:
    """Names of a triad's parameters, as in its calibration file."""
    order = options.orders[triad]
    basis = Basis(order)
    model: Whole = Factors(basis) if options.kind(order) == "factors" else Polynomial(basis)
    return model.names


def column(triad: str, parameter: str) -> str:
    """The column of a parameter.

    >>> column("magnetometer", "gain-xy·1")
    'magnetometer_gain_xy_t1'
    """
    return f"{triad}_{parameter}".replace("-", "_").replace("·", "_t")


def names(options: Options, triads: Sequence[str] = TRIADS) -> list[str]:
    """The columns of results, in order."""
    found: list[str] = []
    for index, triad in enumerate(triads):
        own = [column(triad, name) for name in model_parameters(options, index)]
        found += [f"{triad}_{fact}" for fact in FACTS]
        found += [name for pair in zip(own, (f"{n}_sd" for n in own), strict=True) for name in pair]
    last = (ANGLES, EARTH) if len(triads) > 1 else (ANGLES[:2], EARTH[:1])
    return [*found, *(f"{angle}_sd_deg" for angle in last[0]), *last[1]]


def calibrate_batch(
    readings: Readings, options: Options, reference: float, alone: Alone
) -> Outcome:
    """Calibrate tools of the same shape: readings (B, n, ...), parameters at `reference` °C.

    `alone` gives one tool's own readings where a check needs words for it.
    """
    count = len(readings.accelerometer)
    blank = {name: np.full(count, np.nan) for name in names(options)}
    free: list[tuple[list[str], ...]] = [([], []) for _ in range(count)]
    status, message = np.full(count, OK, object), np.full(count, "", object)
    outcome = Outcome(status, message, blank, free)
    _refuse(outcome, suspect_readings(readings, options), alone, options)
    sound = np.flatnonzero(status == OK)
    for start in range(0, len(sound), CHUNK):
        members = sound[start : start + CHUNK]
        for which, result in fitted(taken(readings, members), options):
            _record(outcome, members[which], result, options, reference, alone)
    return outcome


def _refuse(outcome: Outcome, suspects: dict[str, Any], alone: Alone, options: Options) -> None:
    """Give the suspects that the check of a single run refuses their status and message."""
    for name, flags in suspects.items():
        for index in np.flatnonzero(flags & (outcome.status == OK)):
            try:
                check_readings(alone(int(index))[0], options)
            except MwdcalError as error:
                outcome.status[index], outcome.message[index] = name, str(error)


def taken(readings: Readings, index: Ints) -> Readings:
    """Some members of a batch."""

    def rows(value: AnyArray | None) -> Any:
        return None if value is None else value[index]

    return replace(
        readings,
        accelerometer=readings.accelerometer[index],
        magnetometer=rows(readings.magnetometer),
        temperature=rows(readings.temperature),
        known={k: v[index] for k, v in readings.known.items()},
        sd={k: v[index] for k, v in readings.sd.items()},
        group=rows(readings.group),
    )


def fitted(readings: Readings, options: Options) -> Iterator[tuple[Ints, Fit | Exception]]:
    """Fits of a batch, with the members of each; halved where one member stops the whole."""
    count = len(readings.accelerometer)
    every = np.arange(count)
    try:
        yield every, fit(readings, options)
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
        if count == 1:
            yield every, error
            return
        for part in (every[: count // 2], every[count // 2 :]):
            for which, result in fitted(taken(readings, part), options):
                yield part[which], result


def member(result: Fit, index: Ints) -> Fit:
    """The fit of some members of a batch."""

    def part(value: Any) -> Any:
        return value.take(index) if hasattr(value, "problem") else value[index]

    analysis = result.analysis
    changed = {
        f.name: value.take(index) if f.name == "determined" else part(value)
        for f in fields(analysis)
        if (value := getattr(analysis, f.name)) is not None
    }
    return replace(
        result,
        problem=result.problem.take(index),
        state=result.state.take(index),
        status=result.status[index],
        iterations=result.iterations[index],
        noise=result.noise[index],
        trust=result.trust[index],
        analysis=replace(analysis, **changed),
    )


def _record(
    outcome: Outcome,
    members: Ints,
    result: Fit | Exception,
    options: Options,
    reference: float,
    alone: Alone,
) -> None:
    """Check a fit of some tools and write down the results of the sound ones."""
    if isinstance(result, Exception):
        outcome.status[members] = FAILED
        outcome.message[members] = (
            f"the fit failed: {result}. Calibrate this tool alone to see why."
        )
        return
    free = free_of_batch(result)
    for name, flags in suspect_fits(result, free).items():
        for index in np.flatnonzero(flags & (outcome.status[members] == OK)):
            tool = int(members[index])
            readings, profile = alone(tool)
            try:
                check_fit(member(result, np.array([index])), free[index], profile, readings)
            except MwdcalError as error:
                outcome.status[tool], outcome.message[tool] = name, str(error)
    good = np.flatnonzero(outcome.status[members] == OK)
    if not good.size:
        return
    if good.size < len(members):
        result, free = member(result, good), [free[index] for index in good]
    for name, values in _columns(result, free, reference).items():
        outcome.columns[name][members[good]] = values
    for place, each in zip(members[good], free, strict=True):
        if each:
            outcome.free[place] = tuple(
                [f.id for f in each if triad in f.triads] for triad in range(len(TRIADS))
            )


def _columns(result: Fit, free: list[list[Free]], reference: float) -> dict[str, Array]:
    """Columns of the results of sound fits."""
    usable = result.analysis.freedom >= 1
    factors = np.where(usable, np.nan_to_num(result.analysis.variance_factor, nan=1.0), 1.0)
    found: dict[str, Array] = {}
    for index in range(len(result.problem.triads)):
        found |= _triad_columns(result, index, factors[:, index], free, reference)
    sizes = [t.model.size for t in result.problem.triads]
    spread = np.sqrt(np.repeat(factors, sizes, axis=-1))
    covariance = result.analysis.covariance * spread[:, :, None] * spread[:, None, :]
    found |= typical_sd(result, covariance, free_rows(free, spread.shape[-1]), reference)
    problem, state = result.problem, result.state
    found["gravity_g"] = problem.constant(state, "gravity").mean(-1)
    if len(problem.triads) > 1:
        found["field"] = problem.constant(state, "field").mean(-1)
        found["dip_deg"] = np.degrees(problem.constant(state, "dip").mean(-1))
    return found


def free_rows(free: list[list[Free]], size: int) -> Array:
    """Free directions (B, k, p) of every member, rows of zeros where there are fewer than k."""
    most = max((len(each) for each in free), default=0)
    rows = np.zeros((len(free), most, size))
    for index, each in enumerate(free):
        for place, entry in enumerate(each):
            rows[index, place] = entry.direction
    return rows


def _triad_columns(
    result: Fit, index: int, factor: Array, free: list[list[Free]], reference: float
) -> dict[str, Array]:
    """Parameters at the reference temperature, uncertainties, rank and noise of one triad."""
    problem, analysis = result.problem, result.analysis
    triad, where = problem.triads[index], problem.slices()[index]
    name, params = TRIADS[index], result.state.params[:, where]
    finished, one = triad.model.finished(reference)
    one = np.broadcast_to(one, (len(params), *one.shape[-2:]))
    values = np.einsum("bij,bj->bi", one, params)
    inner = one @ analysis.covariance[:, where, where]
    sd = np.sqrt(np.einsum("bij,bij->bi", inner, one) * factor[:, None])
    size, rank = triad.model.size, np.full(len(params), triad.model.size)
    some = np.flatnonzero([bool(each) for each in free])
    if some.size:
        part = member(result, some)
        rank[some] = marginal_rank(part.analysis.determined, where)
        directions = free_rows([free[i] for i in some], problem.slices()[-1].stop)[..., where]
        moved = np.einsum("bij,bkj->bki", one[some], directions)
        triad = part.problem.triads[index]
        effect = _effect(finished, values[some], triad.raw, part.problem.temperature)
        sd[some] = np.where(np.abs(moved).max(1) * effect > FREE_SHARE, np.nan, sd[some])
    declared = np.isnan(result.noise[:, index])
    noise = np.where(declared, problem.triads[index].sd.mean((-1, -2)), result.noise[:, index])
    freedom = analysis.freedom[:, index]
    facts = (
        rank,
        np.full(len(params), size),
        noise,
        np.where(freedom >= 1, analysis.variance_factor[:, index], np.nan),
        freedom,
    )
    found = {f"{name}_{fact}": np.asarray(v, float) for fact, v in zip(FACTS, facts, strict=True)}
    for place, parameter in enumerate(finished.names):
        found[column(name, parameter)] = values[:, place]
        found[f"{column(name, parameter)}_sd"] = sd[:, place]
    return found


def _effect(model: Whole, params: Array, raw: Array, temperature: Array) -> Array:
    """By how much of the field each parameter (B, p) changes it, per unit."""
    strength = np.linalg.norm(model.fields(params, raw, temperature), axis=-1).mean(-1)
    squares = np.sum(model.jacobian(params, raw, temperature) ** 2, -2)
    return np.asarray(np.sqrt(squares.mean(-2)) / strength[:, None])
