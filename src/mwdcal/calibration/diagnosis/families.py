"""Columns of every effect that residuals may show: errors of the stand, drift, gradient, backlash, hysteresis, lag."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mwdcal.calibration.automatic.courses import TRIED, steady_columns, temperature_powers
from mwdcal.calibration.evidence import acts_on
from mwdcal.calibration.methods import ESTIMABLE
from mwdcal.calibration.readings import HIGHEST, LEAST_TEMPERATURE_SPAN, TRIADS, highest_order
from mwdcal.estimation.evidence import STAND_ERRORS
from mwdcal.estimation.problem import Problem, State
from mwdcal.geometry.vectors import Array, centred, quotient

DRIFTS = 2
"""Degree of the polynomial of order (or of the row) that a drift is looked for as."""
SMALLEST_SET = 3
"""Fewest stations of one direction that may share an error of its setting."""
SET_TURNS = ("inclination-zero", "azimuth-zero")
COURSE_SUFFIX = "-temperature"
"""What ends the names of the powers of temperature that the order of a triad leaves out."""
LEAST_MOVE = 0.05
"""Moves below this share of the run's largest have no side: of angles that are read off, noise would choose it."""


def families(problem: Problem, state: State) -> Iterator[tuple[str, Array]]:
    """Columns (B, n, m, k) of every effect that these runs could show, whitened; zero where one could not."""
    turns, by_earth = problem.station_columns(state)
    known = _turns(problem, state, turns)
    for name, parts in ESTIMABLE.items():
        each = [known[turn] for turn in parts if turn in known]
        if each:
            yield name, np.stack(each, -1)
    sets = _sets(problem)
    each = [known[n][..., None] * sets[..., None, :] for n in SET_TURNS if n in known]
    if each and sets.shape[-1] > 1:
        yield "settings", np.concatenate(each, -1)
    place = np.linspace(-1, 1, state.attitude.shape[1])
    order = np.asarray(np.polynomial.legendre.legvander(place, DRIFTS)[:, 1:], float)
    down = problem.stand_column(state, "azimuth-zero", turns)
    if len(problem.triads) > 1:
        given = problem.evidence.is_known("dip")[..., None]
        if given.any() and "dip" not in problem.evidence.absent:
            yield "dip-reference", (by_earth[..., 2] * given)[..., None]
        field = np.concatenate([by_earth[..., 1:], down[..., None]], -1)
        field[..., :3, :] = 0.0  # the declination of a field that turns does not turn gravity
        if not problem.walks:
            yield "field-drift", products(field, order)
        yield "field-gradient", products(field, state.attitude[..., 2, :])
    steps = _approach(problem)
    back = [known[n] * s[..., None] for n, s in steps.items() if n in known and s.any()]
    if back:
        yield "backlash", np.stack(back, -1)
    yield from _courses(problem, state)
    for index, name in enumerate(TRIADS[: len(problem.triads)]):
        yield from _of_sensor(problem, index, name, order)


def _sets(problem: Problem) -> Array:
    """Membership (B, n, k) of stations in directions that several share by their references; none of a single one."""
    known = problem.evidence.known
    pair = np.stack([known["inclination"], known["azimuth"]], -1)
    keys = np.round(np.nan_to_num(pair, nan=-1.0), 6)
    alike = bool((keys == keys[:1]).all())
    each = [_sets_of(key) for key in keys[: 1 if alike else None]]
    members = np.zeros((len(each), keys.shape[1], max(of.shape[-1] for of in each)))
    for place, of in enumerate(each):
        members[place, :, : of.shape[-1]] = of if of.shape[-1] > 1 else 0.0
    return members


def _sets_of(key: Array) -> Array:
    """Membership (n, k) of one run's stations in the directions (n, 2) that are not too few, nor too many."""
    _, number, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    usable = np.flatnonzero(count >= SMALLEST_SET)
    if len(usable) > len(key) / SMALLEST_SET:
        usable = usable[:0]
    return np.asarray(number.reshape(-1)[:, None] == usable, float)


def _courses(problem: Problem, state: State) -> Iterator[tuple[str, Array]]:
    """Powers of temperature that a triad's order leaves out: another finding names these."""
    varied = np.ptp(problem.temperature, -1) >= LEAST_TEMPERATURE_SPAN
    if not varied.any():
        return
    highest = np.clip(highest_order(problem.temperature), HIGHEST, TRIED)
    columns, most = steady_columns(problem, state), int(highest.max())
    tried = (np.arange(1, most + 1) <= highest[:, None]) & varied[:, None]
    powers = temperature_powers(problem.temperature, most) * tried[:, None]
    for index, triad in enumerate(problem.triads):
        order = triad.model.basis.order
        if order < most:
            of_triad = columns[..., 6 * index : 6 * index + 6]
            yield f"{TRIADS[index]}{COURSE_SUFFIX}", products(of_triad, powers[..., order:])


def _turns(problem: Problem, state: State, turns: Array) -> dict[str, Array]:
    """Columns (B, n, m) of errors of the stand that act on references, at stations that have them."""
    acting = {name: acts_on(problem.evidence, name)[..., None] for name in STAND_ERRORS}
    columns = {n: problem.stand_column(state, n, turns) * acts for n, acts in acting.items()}
    return {name: column for name, column in columns.items() if column.any()}


def products(columns: Array, factors: Array) -> Array:
    """Columns (B, n, m, a) times factors (n, b) or (B, n, b) of their stations: (B, n, m, a b)."""
    product = columns[..., :, None] * factors[..., None, None, :]
    return np.asarray(product.reshape(*columns.shape[:-1], -1))


def _approach(problem: Problem) -> dict[str, Array]:
    """From which side (B, n) each angle of the stand was reached: 1, -1, or 0 where it did not move."""
    known = problem.evidence.known
    angles = {name: known[name][..., None] for name in ("inclination", "azimuth", "toolface")}
    steps = {name: np.nan_to_num(centred(moves(angle))) for name, angle in angles.items()}
    return {f"{name}-zero": side(moved)[..., 0] for name, moved in steps.items()}


def moves(values: Array) -> Array:
    """Changes (B, n, k) of values from station to station, zero at the first."""
    return np.diff(values, axis=1, prepend=values[:, :1])


def side(moved: Array) -> Array:
    """The sign of each move (B, n, k), 0 for those too small to be more than the error of a statement."""
    least = np.maximum(LEAST_MOVE * np.abs(moved).max((1, 2), keepdims=True), 1e-6)
    return np.where(np.abs(moved) > least, np.sign(moved), 0.0)


def _of_sensor(
    problem: Problem, index: int, name: str, order: Array
) -> Iterator[tuple[str, Array]]:
    """Drift with the order of stations, hysteresis and thermal lag of one triad's readings."""
    triad = problem.triads[index]
    axes = np.zeros((*problem.temperature.shape, 3 * len(problem.triads), 3))
    weight = problem.evidence.include[..., None] / triad.sd
    axes[:, :, 3 * index : 3 * index + 3] = np.eye(3) * weight[..., None]
    if index == 0 and not problem.walks:
        yield f"{name}-drift", products(axes, order)
    yield f"{name}-hysteresis", axes * side(moves(triad.raw))[..., None, :]
    rate = moves(problem.temperature[..., None])
    varied = np.ptp(rate, 1, keepdims=True) > 1.0
    if varied.any():
        rate = quotient(rate, np.abs(rate).max(1, keepdims=True), varied)
        reading = (triad.raw - triad.raw.mean(1, keepdims=True)) / np.std(triad.raw, (1, 2))[
            :, None, None
        ]
        scale = axes * (rate * reading)[..., None, :]
        yield f"{name}-thermal-lag", np.concatenate([axes * rate[..., None, :], scale], -1)
