"""Which members of a batch a check of a single run may refuse: found by arrays, all at once.

The suspects of each kind come under the name of its status, in the order in which the checks
of a single run are made. To suspect a sound tool costs time and nothing else: `checks` decides.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np

from mwdcal.calibration.automatic.stand import LOOSE
from mwdcal.calibration.diagnosis.plausibility import (
    gain_shares,
    is_bad,
    off_earth,
    overturned,
    straying,
)
from mwdcal.calibration.diagnosis.refusals import ABSURD, COARSE, GAIN, MOTION, NEEDS, holds_stand
from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import EARTH, TRIADS, Readings
from mwdcal.calibration.soaks import GAP
from mwdcal.estimation.evidence import STAND_ERRORS, UNKNOWN
from mwdcal.estimation.problem import Problem, State
from mwdcal.estimation.rank import EXACT, Free, free_directions
from mwdcal.estimation.solvers import Determined, Status
from mwdcal.estimation.uncertainty import COUPLED, candidates
from mwdcal.geometry.vectors import Array, Bools, Ints
from mwdcal.sensor.profile import COMMON, Profile


def suspect_readings(readings: Readings, options: Options) -> dict[str, Bools]:
    """Suspects (B,) before the fit: too few stations, channels, temperatures, references."""
    count, method, highest = len(readings.accelerometer), options.method, max(options.orders)
    none = np.zeros(count, bool)
    few = 3 * readings.count < _size(options)
    channels = none.copy()
    for triad in TRIADS:
        channels |= _odd_channels(readings, triad)
    blank = readings.temperature is None and method != "swarm"  # as where there is no such column
    common = holds_stand(options) and any(name in readings.sd for name in COMMON)
    return {
        "too-few-stations": none | few,
        "common-errors": none | common,
        "channel": channels,
        "bad-input" if blank else "temperature-span": (
            _short_span(readings, highest, method) if highest else none
        ),
        "missing-reference": none | _lacking(readings, method),
    }


def _size(options: Options) -> int:
    """Parameters of a triad that stations must determine: with a prior, none."""
    if options.knowledge is not None:
        return 0
    highest = max(options.orders)
    factors, fewer = options.kind(highest) == "factors", 12 - options.parameters
    if factors:
        return 6 * (highest + 1) + 6 - fewer
    return (12 - fewer) * (highest + 1)


def _odd_channels(readings: Readings, triad: str) -> Bools:
    """Where (B,) a channel moves by less, or more, than a field of that strength allows."""
    values = getattr(readings, triad)
    if values is None:
        return np.zeros(len(readings.accelerometer), bool)
    lines = np.ascontiguousarray(np.swapaxes(values, -1, -2))
    spread = lines.max(-1) - lines.min(-1)
    dead = spread <= 1e-12 * np.abs(values).max((-1, -2))[:, None]
    known = readings.reference("gravity" if triad == "accelerometer" else "field")
    given = ~np.isnan(known)
    mean = np.nan_to_num(known).sum(-1) / np.maximum(given.sum(-1), 1)
    mean = np.asarray(np.where(mean > 0, mean, 1.0))
    share = spread / mean[:, None]
    odd = np.any((share < MOTION[0]) | (share > MOTION[1]), -1) & given.any(-1)
    return np.asarray(dead.any(-1) | odd)


def _short_span(readings: Readings, order: int, method: str) -> Bools:
    """Where (B,) temperatures are too few or too close for the order, or the method has none."""
    if readings.temperature is None or method == "swarm":
        return np.ones(len(readings.accelerometer), bool)
    steps = np.diff(np.sort(readings.temperature, -1), axis=-1)
    levels = 1 + np.sum(steps > GAP, -1)
    span = readings.temperature.max(-1) - readings.temperature.min(-1)
    return np.asarray((levels < order + 1) | (span < 10 * order))


def _lacking(readings: Readings, method: str) -> Bools:
    """Where (B,) a station lacks a reference that the method may need."""
    needed = list(NEEDS.get(method, ()))
    if method in ("least-squares", "swarm") and readings.magnetometer is not None:
        needed += ["azimuth", "dip"]
    blank = [np.isnan(readings.reference(name)).any(-1) for name in needed]
    return np.asarray(np.any(blank, axis=0)) if blank else np.zeros(1, bool)


def suspect_fits(result: Fit, free: list[list[Free]], options: Options, profile: Profile) -> Bools:
    """Suspects (B,) after the fit: not settled, too weak, without redundancy, absurd."""
    suspect = result.status != int(Status.OK)
    suspect |= [any(map(is_bad, each)) for each in free]
    suspect |= np.any(np.isfinite(result.noise) & (result.analysis.freedom < 1), -1)
    suspect |= _odd_gains(result) | _absurd(result) | straying(result)
    suspect |= np.isfinite(overturned(result))
    for name in EARTH:
        suspect |= off_earth(result, name, profile.stand.coil).any(-1)
    return np.asarray(suspect | _inseparable(result) if options.estimate else suspect)


def _inseparable(result: Fit) -> Bools:
    """Where (B,) errors of the stand may not be told from those of the sensors."""
    constants = result.problem.evidence.constants
    stand = [i for i, c in enumerate(constants) if c.unknown and c.name in STAND_ERRORS]
    variance = np.diagonal(result.analysis.constants, axis1=-2, axis2=-1)[:, stand]
    loose = np.any(~(np.sqrt(variance) <= LOOSE * UNKNOWN), -1)
    return np.asarray(loose | ~result.analysis.determined.keep.all(-1))


def _odd_gains(result: Fit) -> Bools:
    """Where (B,) an own-axis gain is not near nominal, or not near the others."""
    found = np.zeros(len(result.status), bool)
    for index in range(len(result.problem.triads)):
        inside = [(share >= GAIN[0]) & (share <= GAIN[1]) for share in gain_shares(result, index)]
        found |= ~np.all(inside, (0, -1))
    return found


def _absurd(result: Fit) -> Bools:
    """Where (B,) residuals are larger than any error of a sensor."""
    problem, analysis = result.problem, result.analysis
    found = np.zeros(len(result.status), bool)
    for index, triad in enumerate(problem.triads):
        noise, factor = result.noise[:, index], analysis.variance_factor[:, index]
        found |= np.isnan(noise) & (factor > ABSURD**2) & (analysis.freedom[:, index] >= 1)
        if np.isfinite(noise).any():
            strength = np.linalg.norm(triad.raw, axis=-1).mean(-1)
            size = np.minimum(strength, 2 * triad.raw.std(axis=1).max(-1))
            found |= np.nan_to_num(noise) > COARSE * size
    return found


def free_of_batch(result: Fit) -> list[list[Free]]:
    """The free directions of every member by name, as `free_directions` has them for one."""
    determined = result.analysis.determined
    found: list[list[Free]] = [[] for _ in result.status]
    settled = result.status == int(Status.OK)
    missing = np.sum(~determined.keep, -1)
    for count in np.unique(missing[settled & (missing > 0)]):
        which = np.flatnonzero(settled & (missing == count))
        problem, state = result.problem.take(which), result.state.take(which)
        own = determined.take(which)
        named, odd = _named(problem, state, own, int(count))
        for place, index in enumerate(which):
            one = np.array([place])
            found[index] = (
                free_directions(problem.take(one), state.take(one), own.take(one))
                if odd[place]
                else named[place]
            )
    return found


def _named(
    problem: Problem, state: State, determined: Determined, count: int
) -> tuple[list[list[Free]], Bools]:
    """Names of `count` free directions of each member, and members (B,) that need another look.

    The best candidate is taken in turn, and the null space goes on without it.
    """
    ids, directions = _candidates(problem, state)
    norms, members = determined.norms, np.arange(len(state.params))
    scaled = directions * norms[:, None]
    length = np.sum(scaled**2, -1)
    null = determined.basis[..., -count:]
    found: list[list[Free]] = [[] for _ in members]
    odd = np.zeros(len(members), bool)
    used = np.zeros(length.shape, bool)
    for _ in range(count):
        inside = np.sum((scaled @ null) ** 2, -1) / np.where(length > 0, length, 1.0)
        scores = np.where(used, -1.0, np.round(inside, 3))
        best = np.argmax(scores, -1)
        score = inside[members, best]
        odd |= score <= COUPLED
        used[members, best] = True
        chosen = directions[members, best]
        part = np.einsum("bpk,bqk,bq->bp", null, null, scaled[members, best]) / norms
        chosen = np.where((score < EXACT)[:, None], part, chosen)
        for place, index in enumerate(best):
            found[place].append(Free(ids[index][0], ids[index][1], chosen[place]))
        null = _without(null, chosen * norms)
    return found, odd


def _candidates(problem: Problem, state: State) -> tuple[list[tuple[str, tuple[int, ...]]], Array]:
    """Directions (B, c, p) that have a name, and their names and triads, in order of preference."""
    every = tuple(range(len(problem.triads)))
    ids: list[tuple[str, tuple[int, ...]]] = []
    directions = []
    for group in [(t,) for t in every] + ([every] if len(every) > 1 else []):
        for name, direction in candidates(problem, state, list(group)).items():
            ids.append((name, group))
            directions.append(direction)
    names = [name for triad in problem.triads for name in triad.model.names]
    unit = np.eye(len(names))
    for triad, where in enumerate(problem.slices()):
        for index in range(where.start, where.stop):
            ids.append((names[index], (triad,)))
            directions.append(np.broadcast_to(unit[index], state.params.shape))
    return ids, np.stack(directions, 1)


def _without(null: Array, direction: Array) -> Array:
    """Null spaces (B, p, k) less their part along a direction (B, p), as orthonormal bases."""
    inside = np.einsum("bpk,bp->bk", null, direction)
    length = np.linalg.norm(inside, axis=-1, keepdims=True)
    inside = inside / np.where(length > 0, length, 1.0)
    size: Ints | int = null.shape[-1]
    unit = np.broadcast_to(np.eye(int(size)), (len(null), int(size), int(size)))
    whole = np.linalg.qr(np.concatenate([inside[..., None], unit], -1))[0]
    return np.asarray(null @ whole[..., 1:size])


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
