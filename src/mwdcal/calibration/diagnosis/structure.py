"""The likely causes of the misfit of a run: zeros of the stand, drift, gradient, backlash, thermal lag.

Each effect is a family of columns that the residuals may have in common with it. A family is named
where it takes away more of the misfit than noise of any direction would (F test), the best one
first; the others are then judged by what that one leaves. Nothing is corrected here: what moves
with a parameter of the sensor has gone into the fit, and no residual shows it.

Reference: efficient scores, C. R. Rao, Proc. Camb. Phil. Soc. 44, 50 (1948).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mwdcal.calibration.automatic.courses import f_test, steady_columns
from mwdcal.calibration.diagnosis.families import COURSE_SUFFIX, families, products
from mwdcal.calibration.diagnosis.first_look import EFFECT_CHANCE, LEFT_BY_FIT, may_show
from mwdcal.calibration.diagnosis.stand_look import on_stand_may_show
from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.readings import TRIADS
from mwdcal.calibration.residuals import chances, stations_to_remeasure
from mwdcal.calibration.results import variance_scales
from mwdcal.estimation.batch import take
from mwdcal.estimation.minimisers import uncertain_stand
from mwdcal.estimation.problem import Problem, State
from mwdcal.estimation.uncertainty import whole_covariance
from mwdcal.geometry.vectors import Array, Bools, Ints, eigen, outer, quotient

STRUCTURE_CHANCE = 0.01
"""Chance of residuals as large in declared noise, below which their structure is looked at."""
BAD_SHARE = 0.1
"""Share of bad stations up to which they are left out."""
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
AT_ONCE = 32
"""Fits that are looked at together: few enough for the cache."""
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
"""The likely cause of the residuals, and the remedy."""


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
    """Efficient scores (B, k) and their covariance (B, k, k) for columns of unit length, with lengths (B, k).

    `places` of the columns of each family; the `misfit` (B,) of all readings, with its degrees of freedom.
    """

    score: Array
    information: Array
    length: Array
    columns: Array
    places: dict[str, Ints]
    misfit: Array
    freedom: Array

    def of(self, members: Ints) -> _Scores:
        """Those of some fits."""
        names = ("score", "information", "length", "columns", "misfit", "freedom")
        return replace(self, **{name: getattr(self, name)[members] for name in names})

    def gain(self, names: Sequence[str]) -> tuple[Array, Ints]:
        """By how much (B,) some families lower the cost, and how many directions they have."""
        if not names:
            return 0.0 * self.misfit, np.zeros(self.misfit.shape, int)
        index = self._columns(names)
        value, vector = eigen(self.information[:, index[:, None], index])
        along = (vector.mT @ self.score[:, index, None])[..., 0]
        kept = value > LEFT_BY_FIT
        return quotient(along**2, value, kept).sum(-1), np.count_nonzero(kept, -1)

    def solution(self, names: Sequence[str]) -> tuple[Array, Array]:
        """Values (k',) of the columns of some families, and their covariance (k', k'), of a single fit."""
        index = self._columns(names)
        value, vector = eigen(self.information[0][np.ix_(index, index)])
        kept, length = value > LEFT_BY_FIT, self.length[0, index]
        inverse = (vector[:, kept] / value[kept]) @ vector[:, kept].transpose()
        return -inverse @ self.score[0, index] / length, inverse / outer(length)

    def _columns(self, names: Sequence[str]) -> Ints:
        return np.concatenate([self.places[name] for name in names])


Shown = dict[str, tuple[float, float]]
"""Chance and share of the misfit of each effect that a fit shows, by name."""


def shown_effects(result: Fit, others: Mapping[str, Array]) -> list[Shown]:
    """Effects that the residuals of each fit (B) show, in the order in which they are found.

    `others` (B, n) are numbers of columns that the fit does not use: each may explain the residuals too.
    """
    if result.analysis.influence is not None:
        return [{} for _ in result.status]
    include = result.problem.evidence.include
    every: list[Shown] = [{} for _ in result.status]
    stand = result.analysis.squares is not None and uncertain_stand.applies(result.problem)
    looked_at = (on_stand_may_show(result) if stand else may_show(result)) | bool(others)
    result = _without_bad_stations(result)
    looked_at |= (result.problem.evidence.include != include).any(-1)
    places = np.flatnonzero(looked_at)
    for first in range(0, len(places), AT_ONCE):
        some = places[first : first + AT_ONCE]
        shown = _searched(take(result, some), {n: v[some] for n, v in others.items()})
        for place, each in zip(some.tolist(), shown, strict=True):
            every[place] = each
    return every


def _searched(result: Fit, others: Mapping[str, Array]) -> list[Shown]:
    """Effects that residuals show: the least likely by chance first, then what its fit leaves, and so on."""
    scales = np.maximum(variance_scales(result), 1e-12)
    triads = [
        replace(t, sd=t.sd * np.sqrt(scales[:, i, None, None]))
        for i, t in enumerate(result.problem.triads)
    ]
    problem = replace(result.problem, triads=tuple(triads))
    scores = _scores(problem, result, others)
    shown: list[Shown] = [{} for _ in result.status]
    left = scores.misfit.copy()
    searched: dict[tuple[str, ...], Ints] = {(): np.arange(len(shown))}
    while searched:
        further: dict[tuple[str, ...], list[int]] = {}
        for chosen, members in searched.items():
            part = scores if len(members) == len(shown) else scores.of(members)
            open_ = sorted(scores.places.keys() - chosen)
            chance, change = _trials(part, chosen, open_, left[members])
            best = np.lexsort((change, chance), axis=0)[0]
            for place, number in enumerate(best.tolist()):
                if chance[number, place] < EFFECT_CHANCE:
                    member, taken = int(members[place]), -change[number, place]
                    share = float(taken / scores.misfit[member])
                    shown[member][open_[number]] = float(chance[number, place]), share
                    left[member] -= taken
                    further.setdefault((*chosen, open_[number]), []).append(member)
        whole = len(scores.places)
        searched = {names: np.array(m) for names, m in further.items() if len(names) < whole}
    return shown


def effects(
    result: Fit, others: Mapping[str, Array] | None = None, shown: Shown | None = None
) -> list[Effect]:
    """The effects that one fit (B = 1) shows, with their sizes, as far as they are reported.

    `shown` are those that `shown_effects` found, if it was asked before.
    """
    others = others or {}
    shown = shown_effects(result, others)[0] if shown is None else shown
    if not shown:
        return []
    every = _described(_without_bad_stations(result), shown, others)
    return [effect for effect in every if is_shown(shown, effect.name)]


def is_shown(shown: Shown, name: str) -> bool:
    """Whether an effect is reported: powers of temperature by another finding, columns where they explain much."""
    chance, share = shown[name]
    much = share >= CLEAR_SHARE and chance < CLEAR_CHANCE
    return much if name.startswith(COLUMN) else not name.endswith(COURSE_SUFFIX)


def _testable(problem: Problem, state: State, others: Mapping[str, Array]) -> dict[str, Array]:
    """Columns (B, n), centred and of unit size; zero for those that are constant, counters, or repeat the attitudes."""
    shape = problem.temperature.shape
    if not others or shape[-1] < FEWEST_TESTED:
        return {}
    turns = np.concatenate([np.ones((*shape, 1)), state.attitude.reshape(*shape, 9)], -1)
    basis = np.linalg.svd(turns, full_matrices=False)[0]
    columns = {}
    for name, values in others.items():
        spread = np.std(values, -1, keepdims=True)
        varies = spread > 1e-12 * np.abs(values).max(-1, keepdims=True)
        counter = np.all(np.diff(values) == 1, -1) & np.isin(values[:, 0], (0, 1))
        unit = quotient(values - values.mean(-1, keepdims=True), spread, varies)
        left = unit - (basis @ (basis.mT @ unit[..., None]))[..., 0]
        tested = ~counter & (np.mean(left**2, -1) > REPEATED)
        columns[name] = unit * tested[:, None]
    return columns


def _without_bad_stations(result: Fit) -> Fit:
    """The fits less their stations to take again, if they are few: one bad station looks like anything."""
    bad = stations_to_remeasure(chances(result))
    bad &= bad.mean(-1, keepdims=True) <= BAD_SHARE
    evidence = result.problem.evidence
    fewer = replace(evidence, include=evidence.include * ~bad)
    return replace(result, problem=replace(result.problem, evidence=fewer)) if bad.any() else result


def _trials(
    scores: _Scores, chosen: Sequence[str], names: Sequence[str], left: Array
) -> tuple[Array, Array]:
    """Chance (F, B) in noise of each of some families beside those chosen, and its change of the misfit `left`."""
    before, taken = scores.gain(chosen)
    each = [scores.gain([*chosen, name]) for name in names]
    gain, directions = (np.stack(part) for part in zip(*each, strict=True))
    gain, directions = np.minimum(gain - before, left * (1 - 1e-9)), directions - taken
    rest = scores.freedom - taken - directions
    tested = (directions >= 1) & (rest >= 1)
    scatter = quotient(left - gain, rest, tested)
    chance = f_test(gain, np.where(tested, directions, 0), scatter, rest)
    return np.nan_to_num(chance, nan=1.0), np.where(tested, -gain, 0.0)


def _described(result: Fit, shown: Shown, others: Mapping[str, Array]) -> list[Effect]:
    """The effects, of chance and share, with their sizes: all together, with the noise that they leave."""
    problem, names = result.problem, [*shown]
    scores = _scores(problem, result, others)
    gain, directions = (float(each[0]) for each in scores.gain(names))
    misfit, freedom = float(scores.misfit[0]), float(scores.freedom[0])
    scale = np.sqrt(max(misfit - gain, 0.0) / max(freedom - directions, 1.0))
    values, covariance = scores.solution(names)
    spread, sized, end = np.sqrt(np.diag(covariance)) * scale, [], 0
    for name, (chance, share) in shown.items():
        where = scores.places[name]
        columns = slice(end, end := end + len(where))
        change = (scores.columns[..., where] * scores.length[:, where]) @ values[columns]
        size = [
            np.sqrt(np.mean(np.sum((change[..., 3 * i : 3 * i + 3] * t.sd) ** 2, -1)))
            for i, t in enumerate(problem.triads)
        ]
        sized.append(Effect(name, share, chance, values[columns], spread[columns], np.array(size)))
    return sized


def _scores(problem: Problem, result: Fit, others: Mapping[str, Array]) -> _Scores:
    """Efficient scores of the columns (B, n, m, k) of all families: what the fit's unknowns cannot take up."""
    columns = dict(families(problem, result.state))
    if tested := _testable(problem, result.state, others):
        steady = steady_columns(problem, result.state)
        columns |= {COLUMN + n: products(steady, v[..., None]) for n, v in tested.items()}
    linear = problem.linear(result.state)
    whole, normal = whole_covariance(linear, result.analysis.determined), linear.normal
    every = np.concatenate([*columns.values()], -1)
    ends = np.cumsum([each.shape[-1] for each in columns.values()])
    places = dict(zip(columns, np.split(np.arange(ends[-1]), ends[:-1]), strict=True))
    flat = every.reshape(len(every), -1, every.shape[-1])
    weighed = linear.weigh(every).reshape(flat.shape)
    square = np.einsum("bik,bik->bk", flat, weighed)
    length = np.sqrt(np.maximum(square, 0.0))  # rounding may leave less where the noise is tiny
    length = np.where(length > 0, length, 1.0)
    crossed = linear.design.reshape(len(every), -1, whole.shape[-1]).mT @ weighed
    pull = (weighed.mT @ linear.residual.reshape(len(every), -1, 1))[..., 0]
    taken = whole @ np.concatenate([crossed, normal.gradient[..., None]], -1)
    score = pull - (crossed.mT @ taken[..., -1:])[..., 0]
    information = flat.mT @ weighed - crossed.mT @ taken[..., :-1]
    misfit = normal.cost - np.sum(normal.gradient * taken[..., -1], -1)
    fitted = np.sum(whole * (normal.information - linear.prior), (-1, -2))
    count = problem.evidence.include.sum(-1) * linear.residual.shape[-1]
    freedom = count - (fitted + _unknown(problem, result))
    unit = every / length[:, None, None]
    return _Scores(
        score / length, information / outer(length), length, unit, places, misfit, freedom
    )


def _unknown(problem: Problem, result: Fit) -> Ints:
    """Number (B,) of unknowns that stations have to themselves; none where one is left out."""
    evidence = problem.evidence
    if not (evidence.exact_turn_sd.any() or evidence.free.any() or evidence.absent):
        return np.zeros(len(result.status), int)
    private = problem.linear(result.state, geometry=True).private
    return np.asarray(np.sum(np.linalg.svd(private, compute_uv=False) > 1.0, (-1, -2)))


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
