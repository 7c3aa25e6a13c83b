"""What the misfit of a run looks like: zeros of the stand, drift, gradient, backlash, thermal lag.

Each effect is a family of columns that the residuals may have in common with it. A family is named
where it takes away more of the misfit than noise of any direction would (F test), the best one
first; the others are then judged by what that one leaves. Nothing is corrected here: what moves
with a parameter of the sensor has gone into the fit, and no residual shows it.

Reference: efficient scores, C. R. Rao, Proc. Camb. Phil. Soc. 44, 50 (1948).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from mwdcal.calibration.automatic.courses import TRIED, f_test, steady_columns, temperature_powers
from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.evidence import acts_on
from mwdcal.calibration.methods import ESTIMABLE
from mwdcal.calibration.readings import HIGHEST, LEAST_TEMPERATURE_SPAN, TRIADS, highest_order
from mwdcal.calibration.residuals import chances, to_reshoot
from mwdcal.calibration.results import variance_scales
from mwdcal.estimation.evidence import STAND_ERRORS
from mwdcal.estimation.problem import Problem, State
from mwdcal.estimation.uncertainty import whole_covariance
from mwdcal.geometry.vectors import Array, Bools, Ints, centred, eigen

EFFECT_CHANCE = 1e-4
"""Chance of so much common structure in noise, below which an effect is named."""
STRUCTURE_CHANCE = 0.01
"""Chance of residuals as large in declared noise, below which their structure is looked at."""
BAD_SHARE = 0.1
"""Share of bad stations up to which they are left out."""
LEFT_BY_FIT = 1e-3
"""A column counts if the fit leaves this share of its square: what is left of others is rounding."""
DRIFTS = 2
"""Degree of the polynomial of order (or of the row) that a drift is looked for as."""
SMALLEST_SET = 3
"""Fewest stations of one direction that may share an error of its setting."""
SET_TURNS = ("inclination-zero", "azimuth-zero")
COURSE_SUFFIX = "-temperature"
"""What ends the names of the powers of temperature that the order of a triad leaves out."""
COLUMN = "column "
"""What the names of columns that the run does not use begin with."""
COLUMN_EXPLAINS = (
    "Column {name!r} is not used, and explains {effect.share:.0%} of the misfit. If it is the temperature of the tool, "
    "name it 'temperature_c' (°C), or under [columns] of the tool profile; else find out what it stands for."
)
CLEAR_SHARE = 0.2
"""A column is reported if it explains this share of the misfit…"""
CLEAR_CHANCE = 1e-6
"""…and would by chance less often than this."""
FEWEST_TESTED = 20
"""Stations from which columns are tested: fewer are explained by anything."""
REPEATED = 0.02
"""A column repeats the attitudes if they leave no more than this share of its variance."""
ZEROS = ("azimuth-zero", "inclination-zero", "dip-reference")
"""Effects that are one angle."""
EFFECTS = {
    "azimuth-zero": "an azimuth zero of the stand: set the index, or fit it with `estimate` azimuth-zero, or declare "
    "its uncertainty (azimuth_zero_deg under [stand])",
    "inclination-zero": "an inclination zero of the stand: set the level, or fit it with `estimate` inclination-zero, "
    "or declare its uncertainty (inclination_zero_deg under [stand])",
    "tilt": "a stand whose vertical leans: level it, or fit it with `estimate` tilt, or declare its uncertainty "
    "(tilt_deg under [stand])",
    "settings": "settings of the stand that stations of one direction share: set it anew for each station, or give "
    "the roll sets as group without their reference angles",
    "dip-reference": "a wrong reference for the dip: check ref_dip_deg, or leave it blank to have it estimated",
    "field-drift": "a field that changes in the order of the stations (diurnal variation, traffic): give ref_field_nt "
    "and ref_dip_deg of each station from a reference magnetometer, or repeat the run at a quiet time",
    "field-gradient": "a field that depends on where the tool points (iron nearby, or sensors off the pivot): move "
    "iron away, or keep the sensors at one place while turning",
    "backlash": "backlash of the stand: its angles depend on the side they were reached from. Reach every angle "
    "from the same side",
    "drift": "a drift in the order of the stations: let the tool warm up, or repeat the first stations at the end",
    "hysteresis": "hysteresis: readings depend on the side they were reached from. Demagnetise, or look for play in "
    "the mounting",
    "thermal-lag": "thermal lag: readings follow the thermometer late. Wait longer after each change of temperature",
}
"""What the residuals look like, and what to do."""


@dataclass(frozen=True)
class Effect:
    """One effect: its name, the share of the misfit it takes, chance in noise, and its size.

    `values` and `uncertainties` belong to its columns, in their units (radians, g or nT); `size`
    (t,) is the root mean square of what it does to the readings of each triad, in g and nT.
    """

    name: str
    share: float
    chance: float
    values: Array
    uncertainties: Array
    size: Array


@dataclass(frozen=True)
class _Scores:
    """Efficient scores (k,) and their covariance (k, k) for columns of unit length, with lengths.

    `places` of the columns of each family; the `misfit` of all readings, with its degrees of freedom.
    """

    score: Array
    information: Array
    length: Array
    columns: Array
    places: dict[str, Ints]
    misfit: float
    freedom: float

    def gain(self, names: list[str]) -> tuple[float, int]:
        """By how much some families lower the cost, and how many directions they have."""
        value, vector, index = self._spanned(names)
        along = vector.transpose() @ self.score[index]
        return float(np.sum(along**2 / value)), len(value)

    def solution(self, names: list[str]) -> tuple[Array, Array]:
        """Values (k',) of the columns of some families, and their covariance (k', k')."""
        value, vector, index = self._spanned(names)
        inverse, length = (vector / value) @ vector.transpose(), self.length[index]
        return -inverse @ self.score[index] / length, inverse / np.outer(length, length)

    def _spanned(self, names: list[str]) -> tuple[Array, Array, Ints]:
        """Eigenvalues and vectors of the directions that the fit leaves to some families."""
        index = np.concatenate([self.places[name] for name in names])
        value, vector = eigen(self.information[np.ix_(index, index)])
        kept = value > LEFT_BY_FIT
        return value[kept], vector[:, kept], index


def effects(result: Fit, others: Mapping[str, Array] | None = None) -> list[Effect]:
    """Effects that the residuals of one fit (B = 1) show, the largest first.

    `others` (1, n) are numbers of columns that the fit does not use: each may explain the residuals too.
    """
    if result.analysis.influence is not None:
        return []
    result = _without_bad_stations(result)
    scales = np.maximum(variance_scales(result), 1e-12)
    triads = [
        replace(t, sd=t.sd * np.sqrt(scales[:, i, None, None]))
        for i, t in enumerate(result.problem.triads)
    ]
    problem = replace(result.problem, triads=tuple(triads))
    others = _testable(problem, result.state, others or {})
    scores = _scores(problem, result, others)
    left = scores.misfit
    shown: dict[str, tuple[float, float]] = {}
    while True:
        open_ = [name for name in scores.places if name not in shown]
        trials = [(*_trial(scores, [*shown], name, left), name) for name in open_]
        chance, change, best = min(trials, default=(1.0, 0.0, ""))
        if chance >= EFFECT_CHANCE:
            return [e for e in _described(result, shown, others) if is_shown(e)]
        shown[best] = chance, -change / scores.misfit
        left += change


def is_shown(effect: Effect) -> bool:
    """Whether an effect is reported: powers of temperature by another finding, columns where they explain much."""
    much = effect.share >= CLEAR_SHARE and effect.chance < CLEAR_CHANCE
    return much if effect.name.startswith(COLUMN) else not effect.name.endswith(COURSE_SUFFIX)


def _testable(problem: Problem, state: State, others: Mapping[str, Array]) -> dict[str, Array]:
    """Columns (n,) that vary, count no stations, and do not merely repeat the attitudes; centred, of unit size."""
    count = problem.temperature.shape[-1]
    turns = state.attitude[0].reshape(count, 9)
    basis = np.linalg.svd(np.column_stack([np.ones(count), turns]), full_matrices=False)[0]
    columns = {}
    for name, values in others.items():
        steps, spread = np.diff(values[0]), np.std(values[0])
        counter = np.all(steps == 1) and values[0, 0] in (0, 1)
        if count < FEWEST_TESTED or counter or not spread > 1e-12 * np.abs(values[0]).max():
            continue
        unit = (values[0] - values[0].mean()) / spread
        left = unit - basis @ (basis.transpose() @ unit)
        if np.mean(left**2) > REPEATED:
            columns[name] = unit
    return columns


def _without_bad_stations(result: Fit) -> Fit:
    """The fit less its stations to take again, if they are few: one bad station looks like anything."""
    bad = to_reshoot(chances(result))
    if bad.mean() > BAD_SHARE:
        return result
    evidence = result.problem.evidence
    fewer = replace(evidence, include=evidence.include * ~bad)
    return replace(result, problem=replace(result.problem, evidence=fewer))


def _trial(scores: _Scores, chosen: list[str], name: str, left: float) -> tuple[float, float]:
    """Chance in noise of one more family, and its change of the misfit `left` by those chosen."""
    before = scores.gain(chosen) if chosen else (0.0, 0)
    after = scores.gain([*chosen, name])
    gain, directions = after[0] - before[0], after[1] - before[1]
    rest = scores.freedom - before[1] - directions
    if directions < 1 or rest < 1:
        return 1.0, 0.0
    gain = min(gain, left * (1 - 1e-9))
    chance = f_test(*np.array([gain, directions, (left - gain) / rest, rest]))
    return float(chance), -gain


def _described(
    result: Fit, shown: Mapping[str, tuple[float, float]], others: Mapping[str, Array]
) -> list[Effect]:
    """The effects, of chance and share, with their sizes: all together, with the noise that they leave."""
    if not shown:
        return []
    problem, names = result.problem, [*shown]
    scores = _scores(problem, result, others)
    gain, directions = scores.gain(names)
    scale = np.sqrt(max(scores.misfit - gain, 0.0) / max(scores.freedom - directions, 1.0))
    values, covariance = scores.solution(names)
    spread, sized, end = np.sqrt(np.diag(covariance)) * scale, [], 0
    for name, (chance, share) in shown.items():
        where = scores.places[name]
        columns = slice(end, end := end + len(where))
        change = (scores.columns[..., where] * scores.length[where]) @ values[columns]
        size = [
            np.sqrt(np.mean(np.sum((change[..., 3 * i : 3 * i + 3] * t.sd) ** 2, -1)))
            for i, t in enumerate(problem.triads)
        ]
        sized.append(Effect(name, share, chance, values[columns], spread[columns], np.array(size)))
    return sized


def _scores(problem: Problem, result: Fit, others: Mapping[str, Array]) -> _Scores:
    """Efficient scores of the columns (1, n, m, k) of all families: what the fit's unknowns cannot take up."""
    families = dict(_families(problem, result.state))
    if others:
        steady = steady_columns(problem, result.state)
        families |= {COLUMN + n: _products(steady, v[:, None]) for n, v in others.items()}
    linear = problem.linear(result.state)
    whole, normal = whole_covariance(linear, result.analysis.determined)[0], linear.normal
    every = np.concatenate([*families.values()], -1)
    ends = np.cumsum([column.shape[-1] for column in families.values()])
    places = dict(zip(families, np.split(np.arange(ends[-1]), ends[:-1]), strict=True))
    square = np.einsum("bnmk,bnmk->k", every, linear.weigh(every))
    length = np.sqrt(np.maximum(square, 0.0))  # rounding may leave less where the noise is tiny
    length = np.where(length > 0, length, 1.0)
    unit = every / length
    weighed, gradient = linear.weigh(unit), normal.gradient[0]
    crossed = np.einsum("bnmu,bnmk->uk", linear.design, weighed)
    pull = np.einsum("bnmk,bnm->k", weighed, linear.residual)
    score = pull - crossed.transpose() @ whole @ gradient
    information = np.einsum("bnmk,bnml->kl", unit, weighed)
    information = information - crossed.transpose() @ whole @ crossed
    misfit = float(normal.cost[0] - gradient @ whole @ gradient)
    fitted = np.sum(whole * (normal.information - linear.prior)[0])
    count = float(problem.evidence.include.sum()) * linear.residual.shape[-1]
    freedom = count - float(fitted + _unknown(problem, result))
    return _Scores(score, information, length, unit, places, misfit, freedom)


def _unknown(problem: Problem, result: Fit) -> int:
    """Number of unknowns that stations have to themselves; none where one is left out."""
    evidence = problem.evidence
    if not (evidence.exact_turn_sd.any() or evidence.free.any() or evidence.absent):
        return 0
    private = problem.linear(result.state, geometry=True).private
    return int(np.sum(np.linalg.svd(private, compute_uv=False) > 1.0))


def _families(problem: Problem, state: State) -> Iterator[tuple[str, Array]]:
    """Columns (1, n, m, k) of every effect that this run could show, whitened."""
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
    count = state.attitude.shape[1]
    place = np.linspace(-1, 1, count)
    order = np.asarray(np.polynomial.legendre.legvander(place, DRIFTS)[:, 1:], float)
    down = problem.stand_column(state, "azimuth-zero", turns)
    if len(problem.triads) > 1:
        given = problem.evidence.is_known("dip")[..., None]
        if given.any() and "dip" not in problem.evidence.absent:
            yield "dip-reference", (by_earth[..., 2] * given)[..., None]
        field = np.concatenate([by_earth[..., 1:], down[..., None]], -1)
        field[..., :3, :] = 0.0  # the declination of a field that turns does not turn gravity
        if not problem.walks:
            yield "field-drift", _products(field, order)
        yield "field-gradient", _products(field, state.attitude[0, :, 2, :])
    steps = _approach(problem)
    back = [known[n] * s for n, s in steps.items() if n in known and s.any()]
    if back:
        yield "backlash", np.stack(back, -1)
    yield from _courses(problem, state)
    for index, name in enumerate(TRIADS[: len(problem.triads)]):
        yield from _of_sensor(problem, index, name, order)


def _sets(problem: Problem) -> Array:
    """Membership (n, k) of stations in directions that several of them share by their references."""
    known = problem.evidence.known
    pair = np.stack([known["inclination"][0], known["azimuth"][0]], -1)
    key = np.round(np.nan_to_num(pair, nan=-1.0), 6)
    _, number, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    usable = np.flatnonzero(count >= SMALLEST_SET)
    if len(usable) > len(key) / SMALLEST_SET:
        usable = usable[:0]
    return np.asarray(number.reshape(-1)[:, None] == usable, float)


def _courses(problem: Problem, state: State) -> Iterator[tuple[str, Array]]:
    """Powers of temperature that a triad's order leaves out: another finding names these."""
    if np.ptp(problem.temperature) < LEAST_TEMPERATURE_SPAN:
        return
    highest = int(np.clip(highest_order(problem.temperature)[0], HIGHEST, TRIED))
    columns = steady_columns(problem, state)
    powers = temperature_powers(problem.temperature, highest)[0]
    for index, triad in enumerate(problem.triads):
        order = triad.model.basis.order
        if order < highest:
            of_triad = columns[..., 6 * index : 6 * index + 6]
            yield f"{TRIADS[index]}{COURSE_SUFFIX}", _products(of_triad, powers[:, order:])


def _turns(problem: Problem, state: State, turns: Array) -> dict[str, Array]:
    """Columns (1, n, m) of errors of the stand that act on references, at stations that have them."""
    acting = {name: acts_on(problem.evidence, name)[..., None] for name in STAND_ERRORS}
    columns = {n: problem.stand_column(state, n, turns) * acts for n, acts in acting.items()}
    return {name: column for name, column in columns.items() if column.any()}


def _products(columns: Array, factors: Array) -> Array:
    """Columns (1, n, m, a) times factors (n, b) of their stations: (1, n, m, a b)."""
    product = columns[..., :, None] * factors[:, None, None, :]
    return np.asarray(product.reshape(*columns.shape[:-1], -1))


def _approach(problem: Problem) -> dict[str, Array]:
    """From which side (n, 1) each angle of the stand was reached: 1, -1, or 0 where it did not move."""
    sides = {}
    for name in ("inclination", "azimuth", "toolface"):
        angle = problem.evidence.known[name][0]
        step = np.diff(angle, prepend=angle[:1])
        step = np.nan_to_num(centred(step))
        sides[f"{name}-zero"] = np.where(np.abs(step) > 1e-6, np.sign(step), 0.0)[:, None]
    return sides


def _of_sensor(
    problem: Problem, index: int, name: str, order: Array
) -> Iterator[tuple[str, Array]]:
    """Drift with the order of stations, hysteresis and thermal lag of one triad's readings."""
    triad = problem.triads[index]
    axes = np.zeros((*problem.temperature.shape, 3 * len(problem.triads), 3))
    weight = problem.evidence.include[..., None] / triad.sd
    axes[:, :, 3 * index : 3 * index + 3] = np.eye(3) * weight[..., None]
    if index == 0 and not problem.walks:
        yield f"{name}-drift", _products(axes, order)
    moved = np.diff(triad.raw[0], axis=0, prepend=triad.raw[0, :1])
    typical = np.abs(moved).max() or 1.0
    side = np.where(np.abs(moved) > 0.05 * typical, np.sign(moved), 0.0)
    yield f"{name}-hysteresis", axes * side[:, None, :]
    rate = np.diff(problem.temperature[0], prepend=problem.temperature[0, :1])
    if np.ptp(rate) > 1.0:
        rate = rate / np.abs(rate).max()
        reading = (triad.raw[0] - triad.raw[0].mean(0)) / np.std(triad.raw[0])
        scale = axes * (rate[:, None] * reading)[:, None, :]
        yield f"{name}-thermal-lag", np.concatenate([axes * rate[:, None, None], scale], -1)


def suspected(result: Fit, chance: Array) -> Bools:
    """Fits (B,) whose residuals are looked at: where noise is estimated, or residuals exceed it.

    `chance` (B, t) is that of residuals as large as each triad's, NaN where noise is not declared.
    """
    estimated = np.isfinite(result.noise).any(-1)
    return np.asarray(estimated | (np.nan_to_num(chance, nan=1.0) < STRUCTURE_CHANCE).any(-1))


def described(effect: Effect, unit: str) -> str:
    """An effect in words; `unit` is that of the magnetometer."""
    if effect.name.startswith(COLUMN):
        return COLUMN_EXPLAINS.format(name=effect.name.removeprefix(COLUMN), effect=effect)
    triad, _, kind = effect.name.partition("-")
    of_triad = triad in TRIADS
    looks = EFFECTS[kind if of_triad else effect.name]
    if effect.name in ZEROS:
        size = f"{np.degrees(effect.values[0]):+.3g}° ± {np.degrees(effect.uncertainties[0]):.2g}°"
        reference = effect.name == "dip-reference"
        size += " (dip less its reference)" if reference else " (reading less true)"
    elif effect.name == "tilt":
        size = f"{np.degrees(np.linalg.norm(effect.values)):.3g}°"
    else:
        parts = [(1e3, "mg"), (1.0, unit)][: len(effect.size)]
        each = [f"{s * f:.3g} {u} rms" for s, (f, u) in zip(effect.size, parts, strict=True)]
        size = " and ".join(each[TRIADS.index(triad) :][:1] if of_triad else each)
    whose = f"{triad}: the" if of_triad else "The"
    return (
        f"{whose} residuals look like {looks}. Size {size}, {effect.share:.0%} of the misfit; chance in "
        f"noise {effect.chance:.0e}. The stated uncertainty does not include it."
    )
