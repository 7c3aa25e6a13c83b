"""Slow drift within a run: seen in the residuals of a fit, and then part of its model.

A run is looked at without drift first. Where its residuals follow the order of the stations more than noise
does, walks of the field and of both triads' offsets are fitted with it, of sizes that the run itself tells.
A trend joins a walk unless it is as good as lost in terms of temperature, whose accuracy it takes away as an unknown:
then it needs evidence of its own. A declared drift is part of every fit, and no smaller than declared.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from mwdcal.calibration.automatic.courses import f_test, members, terms_beyond
from mwdcal.calibration.diagnosis.plausibility import departures
from mwdcal.calibration.diagnosis.structure import CONSTANT_ERRORS, shown_effects
from mwdcal.calibration.estimate import Fit, fit, refitted, with_all, with_noise_anew
from mwdcal.calibration.methods import declared_sizes, with_constant_errors
from mwdcal.calibration.options import Options
from mwdcal.calibration.prior import PriorInformation
from mwdcal.calibration.readings import TRIADS, Readings, stated_day
from mwdcal.calibration.record import Calibration
from mwdcal.calibration.residuals import tail
from mwdcal.estimation import drift
from mwdcal.estimation.batch import join, kind_of, put, take
from mwdcal.estimation.minimisers import closed_form, stand_factors
from mwdcal.estimation.minimisers.closed_form_drift import Alike, are_common, perfect
from mwdcal.estimation.problem import Prior
from mwdcal.estimation.solvers import Status
from mwdcal.geometry.vectors import Array, Bools, Ints, distinct
from mwdcal.sensor.profile import AGEING, Profile, ageing

ORDER_CHANCE = 0.2
"""Chance of residuals that follow the order of stations as much in noise, below which a drift is fitted.

One that is left out costs coverage: of walks as large as the noise of a reading 95 % intervals hold 90 % at a chance
of 0.1 and 93 % at 0.2. One that is not there costs width, 9 % on average over tools without drift.
"""
HIDDEN_CHANCE = 0.1
"""The same chance where a trend would not show: a drift then widens the uncertainty many times, on less evidence."""
TREND_CHANCE = 0.05
"""Chance of as much of a trend, of which little would show, below which it is a drift whatever its walk says."""
LOST_TREND = 0.05
"""Share of a trend that residuals keep, below which it joins the fit on its own evidence alone.

In a run that only warms it looks like a term of temperature, but for what is left within the soaks. One that is not
there makes the angles 5 to 25 times worse.
"""
LOST_CHANCE = 0.01
"""Chance of as much of such a trend: in steady runs that only warm 0.05 shows one in seven, 0.01 one in sixty."""
PRIOR_CHANCE = 1e-3
"""Chance of so large a departure from the prior, at which a drift is looked for in the run alone."""
DISPUTED_CHANCE = 0.01
"""The same chance where the run departs from its prior, or shows a constant error of its references.

A drift there would take up what is a conflict, or that error.
"""
EVERY_PARAMETER = 12
"""Parameters of a triad that are all fitted."""
TOGETHER = 320
"""Most fits whose drifts are fitted together: few enough for the cache."""
LARGEST_DRIFT = 0.02
"""Largest drift within a run (1σ), as a share of gravity or of the field."""
MOST_UNITS = 2000
"""Most residuals of a run whose scores are kept for each of them: their memory grows with the square."""
REDUNDANCY = 36.0
"""Fewest degrees of freedom of a triad that can tell a drift from noise."""


def chances(result: Fit) -> tuple[Array, Bools, Bools]:
    """Probability (B, t) that noise alone follows the order of stations as the residuals of a triad do.

    The least of those of the walks that act on a triad, times their number; whether a trend would not show (B, t), and
    whether trends can be fitted (B, t). That of a trend counts where little of it would show, if it is below
    `TREND_CHANCE`, or `LOST_CHANCE` of one that is as good as lost. The trends of a triad are fitted all or none: where
    field and offsets both drift, 95 % intervals then hold 93 %, and 67 % with the trend of the field alone.
    """
    analysis = result.analysis
    least, hidden = np.ones(analysis.freedom.shape), np.zeros(analysis.freedom.shape, bool)
    shown, held = np.zeros_like(hidden), np.zeros_like(hidden)
    for scores, trends in _scores(result):
        for name, triad in drift.acting(scores.places).items():
            scatter, rest = (x[:, triad] for x in (analysis.variance_factor, analysis.freedom))
            total, mean, square = scores.square(scores.places[name])
            ratio = np.where(square > 0, mean / np.where(square > 0, square, 1.0), 0.0)
            one = f_test(total * ratio, mean * ratio, np.nan_to_num(scatter), rest)
            one = np.nan_to_num(one, nan=1.0) * (1 + (triad > 0))
            little = trends[name] < drift.LEAST_TREND
            if little.any():
                seen = little & (trends[name] > drift.LEAST_KEPT)
                three, factor = np.full(1, 3.0), np.nan_to_num(scatter)
                trend = np.nan_to_num(f_test(scores.trend(name), three, factor, rest), nan=1.0)
                trend *= 1 + (triad > 0)
                lost = trends[name] < LOST_TREND
                seen = seen & (trend < np.where(lost, LOST_CHANCE, TREND_CHANCE))
                one = np.where(seen, np.minimum(one, trend), one)
                shown[:, triad] |= seen
                held[:, triad] |= lost
            least[:, triad] = np.minimum(least[:, triad], one)
            hidden[:, triad] |= little
    return least, hidden, shown | ~held


def chances_without_drift(result: Fit, options: Options) -> Array:
    """The probabilities (B, t) of fits without the drifts that they have; NaN where no drift is looked for."""
    if _apart(result, options):
        return np.full(result.analysis.freedom.shape, np.nan)
    return chances(_without_drift(result, options))[0]


def _scores(result: Fit) -> Iterator[tuple[drift.WalkScores, dict[str, Array]]]:
    """Scores of all walks, and how much of the trend of each is `shown`.

    Walk by walk on a stand, where what they have in common with each other would take most of the time.
    """
    problem, analysis = result.problem, result.analysis
    if closed_form.applies(problem) and are_common(problem):
        residual, design = analysis.residual, Alike.of(problem, result.state)
        if residual[0].size > MOST_UNITS:
            scores = drift.common_scores(*perfect(design), residual)
            yield scores, {name: scores.shown(name) for name in scores.places}
            return
        units, trends = _of_units(design, residual.shape[-1])
        yield replace(units, score=residual.reshape(len(residual), -1) @ units.score), trends
        return
    names = drift.families(problem)
    together = analysis.squares is None and not stand_factors.applies(problem)
    for walks in [names] if together else [[name] for name in names]:
        scores = drift.walk_scores(problem, result.state, analysis, walks)
        yield scores, {name: scores.shown(name) for name in scores.places}


@lru_cache(maxsize=16)
def _of_units(design: Alike, axes: int) -> tuple[drift.WalkScores, dict[str, Array]]:
    """The scores of perfect sensors whose residuals are one on one axis of one station."""
    problem, state = perfect(design)
    stations = problem.temperature.shape[1]
    residual = np.eye(stations * axes).reshape(-1, stations, axes)
    scores = drift.common_scores(problem, state, residual)
    return scores, {name: scores.shown(name) for name in scores.places}


def drifting(result: Fit, options: Options) -> tuple[Bools, Bools]:
    """Triads whose readings drifted within the run, and whether (B,) the run shows constant errors besides.

    (B, 2, t): by a trend that can be fitted, and by a walk.

    None where parameters are held: what these would take up follows the attitudes, and so the order of stations.
    """
    batch, triads = result.analysis.freedom.shape
    drifted, wrong = np.zeros((batch, 2, triads), bool), np.zeros(batch, bool)
    if _apart(result, options):
        return drifted, wrong
    sound = (result.status == int(Status.OK)) & result.analysis.finite
    sound &= result.analysis.freedom.min(-1) >= REDUNDANCY
    sound &= ~terms_beyond(result).present.any((1, 2))
    if not sound.any():
        return drifted, wrong
    part = result if sound.all() else take(result, np.flatnonzero(sound))
    alone, disputed = _undisputed(part, options)
    chance, hidden, straight = chances(alone)
    limit = np.where(hidden, HIDDEN_CHANCE, ORDER_CHANCE)
    shown = chance < np.where(disputed[:, None], DISPUTED_CHANCE, limit)
    off = np.zeros(len(shown), bool)
    for places, free in _by_constant_errors(alone, np.flatnonzero(shown.any(-1)), options):
        chance, _, straight[places] = chances(free)
        shown[places], off[places] = chance < DISPUTED_CHANCE, True
    drifted[sound], wrong[sound] = np.stack([shown & straight, shown], 1), off
    return drifted, wrong


def _by_constant_errors(result: Fit, some: Ints, options: Options) -> Iterator[tuple[Ints, Fit]]:
    """Those of some fits whose residuals show constant errors of the references: places, and the fit with these.

    Such an error leaves residuals that go with attitude, and attitude may go with the order of the stations. A walk
    would follow them too, so uncertain that the error does not show.
    """
    if not some.size:
        return
    each = [tuple(shown) for shown in shown_effects(take(result, some), {}, CONSTANT_ERRORS)]
    for names in sorted({*each} - {()}):
        places = some[[shown == names for shown in each]]
        yield places, _with_constant_errors(take(result, places), names, options)


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def _with_constant_errors(result: Fit, names: Sequence[str], options: Options) -> Fit:
    """The fits with constant errors of the references as unknowns, and noise estimated anew where it was."""
    problem, state = with_constant_errors(result.problem, result.state, names)
    result = refitted(result, problem, state, np.ones(result.noise.shape), options)
    return with_noise_anew(result, options)


def _apart(result: Fit, options: Options) -> bool:
    """Whether the residuals of a fit follow from more than the readings, so that no drift is looked for."""
    apart = options.robust or options.separate_solver or result.analysis.influence is not None
    return bool(apart) or options.parameters < EVERY_PARAMETER


def _undisputed(result: Fit, options: Options) -> tuple[Fit, Bools]:
    """Fits without the prior where the run departs from it (B,): it tests no drift then, and sizes none.

    A wrong prior leaves residuals that go with attitude, and attitude may go with the order of the stations.
    """
    if options.knowledge is None:
        return result, np.zeros(len(result.status), bool)
    square, tested = departures(result)
    disputed = np.asarray(tail(square, np.maximum(tested, 1)) <= PRIOR_CHANCE)
    places = np.flatnonzero(disputed)
    if not places.size:
        return result, disputed
    part = take(result, places)
    nothing = Prior(0 * part.problem.prior.precision, part.problem.prior.expected)
    alone = replace(part.problem, prior=nothing)
    same = np.ones(part.analysis.freedom.shape)
    return put(result, places, refitted(part, alone, part.state, same, options)), disputed


def fit_run(readings: Readings, options: Options) -> Fit:
    """The fit of one run, with the drift that it shows."""
    [(_, result)] = by_drift(fit(readings, options), options)
    return result


def by_drift(result: Fit, options: Options) -> Iterator[tuple[Ints, Fit]]:
    """Members without drift, as they are, and those with a drift of some triads, which is fitted."""
    return with_drifts([(np.arange(len(result.status)), result)], options)


def with_drifts(fits: Iterable[tuple[Ints, Fit]], options: Options) -> Iterator[tuple[Ints, Fit]]:
    """Tools and their fits: those without drift as they come, then those with a drift of the same triads together.

    A drift that is declared is looked for in a fit without it, and stays as declared where none is seen.
    """
    waiting: dict[tuple[Any, ...], list[tuple[Ints, Fit]]] = {}
    for tools, result in fits:
        declared = bool(result.problem.walks) and not _apart(result, options)
        steady = _without_drift(result, options) if declared else result
        drifted, wrong = drifting(steady, options)
        wrong &= drifted.any((1, 2))
        kinds = np.column_stack([drifted.reshape(len(drifted), -1), wrong])
        for kind in distinct(kinds, axis=0):
            places, triads = np.flatnonzero((kinds == kind).all(-1)), kind[:-1]
            part = steady if triads.any() else result
            part = part if len(places) == len(drifted) else members(part, places)
            if triads.any():
                same = tuple(triads.tolist()), bool(kind[-1]), kind_of(part)
                waiting.setdefault(same, []).append((tools[places], part))
            else:
                yield tools[places], _whole(part, options)
    for (triads, off, _), parts in waiting.items():
        every, whole = (join(each) for each in zip(*parts, strict=True))
        for first in range(0, len(every), TOGETHER):
            some = slice(first, first + TOGETHER)
            for places, result in _with_possible_drift(
                take(whole, some), options, np.reshape(triads, (2, -1)), off
            ):
                yield every[some][places], _whole(result, options)


def _with_possible_drift(
    result: Fit, options: Options, triads: Bools, wrong: bool
) -> Iterator[tuple[Ints, Fit]]:
    """Places and fits with walks, then those without whose walks would be larger than any drift, or not finite."""
    walking = with_drift(result, options, triads, wrong)
    before, after = (np.isfinite(r.analysis.variance_factor) for r in (result, walking))
    possible = _is_possible(walking) & (after | ~before).all(-1)
    if possible.all():
        yield np.arange(len(possible)), walking
        return
    declared = result.problem.evidence.drift
    other = with_drift(result, options, np.zeros_like(triads)) if declared else result
    for places, each in ((np.flatnonzero(possible), walking), (np.flatnonzero(~possible), other)):
        if places.size:
            yield places, take(each, places)


def _is_possible(result: Fit) -> Bools:
    """Fits (B,) whose drifts are no larger than one may be: a larger one is something else, and takes up anything."""
    problem, possible = result.problem, np.ones(len(result.status), bool)
    strength = [problem.constant(result.state, name).mean(-1) for name in ("gravity", "field")]
    places = drift.places(problem.evidence)
    for name, triad in drift.acting(places).items():
        if name not in problem.evidence.drift:
            size = np.max([problem.evidence.constants[i].sd for i in places[name].ravel()], 0)
            possible &= size <= LARGEST_DRIFT * strength[triad]
    return possible


def _whole(result: Fit, options: Options) -> Fit:
    """The fit with all of its analysis at once where that is short."""
    short = not _apart(result, options) and stand_factors.applies(result.problem)
    return with_all(result) if short else result


def _without_drift(result: Fit, options: Options) -> Fit:
    """The fit as if the run were steady, with the noise that it then has."""
    problem, state = drift.without_walks(result.problem, result.state)
    same = np.ones(result.analysis.freedom.shape)
    return with_noise_anew(refitted(result, problem, state, same, options, anew=True), options)


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def with_drift(result: Fit, options: Options, triads: Bools, wrong: bool = False) -> Fit:
    """A fit with walks of estimated size that act on some triads (t,), from one without.

    `triads` (2, t): those with a trend, and those with a walk.
    The noise is estimated with the walks in the fit. Where the references are `wrong` by constant errors it stays as
    the fit without walks has it: they are part of it.
    """
    alone, _ = _undisputed(result, options)
    sizes, left = _sized(alone, triads)
    some = np.arange(len(left) if wrong else 0)
    for places, free in _by_constant_errors(alone, some, options):
        left[places] = 1.0
        for name, size in _sized(free, triads)[0].items():
            sizes[name][places] = size
    walking, state = drift.with_walks(result.problem, result.state, sizes)
    result = refitted(result, walking, state, np.sqrt(left), options, anew=not wrong)
    return result if wrong else with_noise_anew(result, options)


def _sized(result: Fit, triads: Bools) -> tuple[dict[str, Array], Array]:
    """Trend and walk (B, 2) of each drift that acts on some triads (t,), and the variance of the noise left (B, t).

    A part that is not seen stays as declared.
    """
    trends, triads = np.broadcast_to(triads, (2, triads.shape[-1]))
    problem, analysis = result.problem, result.analysis
    known, noise = declared_sizes(problem.evidence), drift.noise(problem)
    acting = drift.acting(drift.families(problem)).items()
    walks = [name for name, triad in acting if triads[triad] or name in known]
    scores = drift.walk_scores(problem, result.state, analysis, walks)
    parts = [(known.get(n, np.zeros((1, 2)))[:, i], noise[n]) for n, i in scores.components()]
    least = np.stack([(size / one) ** 2 for size, one in parts], -1)
    sized = {name: (trends[triad], triads[triad]) for name, triad in acting}
    held = np.array([not sized[name][part] for name, part in scores.components()])
    theta, left = drift.walk_variances(
        scores, analysis.variance_factor, analysis.freedom, np.isnan(result.noise), least, held
    )
    sizes = {name: np.zeros((len(theta), 2)) for name in scores.places}
    for (name, part), variance in zip(scores.components(), theta.T, strict=True):
        sizes[name][:, part] = np.sqrt(variance) * noise[name]
    return sizes, left


# --------------------------------------------------------------------------
# What a tool may have changed since an earlier calibration that is the prior of a run: turn-on and walk.
#
# The offsets that a calibration finds are those of one switching on. The next one leaves others, and offsets
# and scales wander with time. Both add to the covariance of the prior.
#
# Reference: ISCWSA, OWSG error model Rev 5.1, MWD: ABXY and MBXY, ASXY and MSXY.

JULIAN_YEAR = 365.25
"""Days."""
UNSTATED_YEARS = 1.0
"""Time since the earlier calibration where a run does not state its date, years."""
USUAL_FIELD = 50_000.0
"""Strength of the field of which a magnetometer without nT reads shares, nT."""


@dataclass(frozen=True)
class Ageing:
    """Possible change of a triad, 1σ: `offset` in g or nT, `scale` as a share."""

    offset: float
    scale: float

    @classmethod
    def of(cls, profile: Profile, triad: str, years: float) -> Ageing:
        """After some years: two switchings on, and the walk between them."""
        turn_on, offset, scale = (ageing(profile, triad, name) for name in AGEING)
        return cls(float(np.sqrt(2 * turn_on**2 + offset**2 * years)), scale * np.sqrt(years))


def aged(
    known: PriorInformation, previous: Calibration, readings: Readings, profile: Profile
) -> PriorInformation:
    """A previous calibration as knowledge of a later run, with what the tool may have changed meanwhile."""
    years, when = _elapsed(previous, readings)
    each = {triad: Ageing.of(profile, triad, years) for triad in TRIADS}
    added = np.zeros(len(known.names))
    for place, name in enumerate(known.names):
        triad, _, parameter = name.partition(" ")
        kind, _, axes = parameter.partition("-")
        unit = USUAL_FIELD if readings.relative and triad == TRIADS[1] else 1.0
        if kind in ("offset", "bias") and "·" not in axes:
            added[place] = each[triad].offset / unit
        elif (kind == "scale" and "·" not in axes) or (
            kind == "gain" and axes in ("xx", "yy", "zz")
        ):
            added[place] = each[triad].scale
    first, second = (each[triad] for triad in TRIADS)
    words = f"{when}: offsets {1e3 * first.offset:.2g} mg and {second.offset:.2g} nT, scales {first.scale:.1g} and "
    return replace(
        known,
        precision=_widened(known.precision, added),
        ageing=f"{words}{second.scale:.1g} (1σ)",
    )


def _elapsed(previous: Calibration, readings: Readings) -> tuple[float, str]:
    """Years between the runs, and how that is known."""
    day = stated_day(readings.metadata)
    if day is None or stated_day(previous.tool) is None:
        return UNSTATED_YEARS, "a year, as not both runs state a date"
    days = abs((day - previous.day).days)
    return days / JULIAN_YEAR, f"{days} day{'s' * (days != 1)}"


def _widened(precision: Array, sd: Array) -> Array:
    """Precision (k, k) when independent errors of standard deviations (k,) come on top.

    P - P Q (I + Q P)⁻¹ P, also where P says nothing of some direction.
    """
    some = np.flatnonzero(sd)
    inner = precision[np.ix_(some, some)] + np.diag(sd[some] ** -2.0)
    across = precision[:, some]
    return np.asarray(precision - across @ np.linalg.solve(inner, across.transpose()))
