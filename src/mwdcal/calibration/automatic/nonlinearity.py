"""Own-axis nonlinearity, taken only where the run itself says clearly that it is there.

Where the noise is estimated, the probability of all readings with the terms is compared with that
without them, shot-to-shot scatter of strengths, dip and directions being estimated for each; where
the noise is declared, stations left out of the fit decide.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from mwdcal.calibration.automatic.order_selection import with_noise
from mwdcal.calibration.estimate import fit, scatters
from mwdcal.calibration.options import AUTO, USUAL, Options
from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.calibration.record import stated
from mwdcal.estimation.batch import batch_of_one
from mwdcal.estimation.uncertainty import left_out_residual, log_evidence, without_station
from mwdcal.geometry.vectors import Array, Ints, directions, group_scatter
from mwdcal.sensor.profile import Profile

BETTER_SHARE = 0.98
"""Left-out χ² must fall to this share before own-axis terms are taken…"""
CLEAR_ERRORS = 2.0
"""…and by so many standard errors of its mean over the stations."""
ODDS = float(np.log(1000.0))
"""All offered terms are taken if they make the readings so many times (ln) as probable as none.

A run without nonlinearity does so in at most one case of as many, whatever its stations.
"""
TRUSTED = 0.2
"""Stations of less weight in a robust fit have no say in the choice."""


@dataclass(frozen=True)
class CurveScore:
    """What speaks for own-axis terms of some triads.

    `left_out`: χ² per reading of stations left out, in units of a declared noise; `odds`: decimal
    logarithm of the probability of the readings over that without terms, where it is estimated.
    `group_scatter_deg`: how far directions within groups scatter at stations left out, if there are groups.
    """

    triads: tuple[str, ...]
    left_out: float | None
    chosen: bool
    odds: float | None = None
    group_scatter_deg: float | None = None


@dataclass(frozen=True)
class Curves:
    """The choice of own-axis terms of B tools among `choices`, by what speaks for each.

    `chosen` (B,) is the place of the choice; `score` (B, choices) are χ² of stations left out, or
    `odds`: natural logarithms of the probability over that without terms.
    """

    choices: list[tuple[str, ...]]
    chosen: Ints
    score: Array
    odds: bool


def declared(profile: Profile, options: Options) -> dict[str, float]:
    """Triads whose profile declares a nonlinearity and whose model can have it, with its prior.

    Only the polynomial model has such terms, and only the common estimator their prior.
    """
    values = {name: getattr(profile, name).nonlinearity for name in TRIADS}
    return {
        name: values[name]
        for name, order in zip(TRIADS, options.orders, strict=True)
        if values[name] and options.kind(order) == "polynomial" and not options.separate_solver
    }


def offered(profile: Profile, options: Options) -> dict[str, float]:
    """Own-axis terms that are left to the run to take or leave: none beside a prior."""
    auto = options.nonlinearity == AUTO and options.prior is None
    return declared(profile, options) if auto else {}


def with_strengths(options: Options, profile: Profile) -> Options:
    """The options with the prior of own-axis terms asked for by name: the profile's, or the usual."""
    if isinstance(options.nonlinearity, Mapping) or options.nonlinearity == AUTO:
        return options
    strength = {n: getattr(profile, n).nonlinearity or USUAL for n in options.nonlinearity}
    return replace(options, nonlinearity=strength)


def scattered(readings: Readings, options: Options) -> Options:
    """The options of every fit of a run: where the noise is estimated and groups exist, so is the scatter."""
    return replace(options, scatter=scatters(readings, replace(options, scatter=True)))


def choose_curves(
    readings: Readings, options: Options, terms: Mapping[str, float]
) -> tuple[dict[str, float], list[CurveScore]]:
    """Of the offered own-axis terms those that one run shows clearly, and the table, if there is a choice."""
    curves = compare_curves(batch_of_one(readings), options, terms)
    chosen, table = int(curves.chosen[0]), []
    for place, triads in enumerate(curves.choices):
        value = float(curves.score[0, place])
        left_out, odds = (None, value / float(np.log(10))) if curves.odds else (value, None)
        scatter = None
        if len(curves.choices) > 1:
            each = replace(options, robust=None, nonlinearity={n: terms[n] for n in triads})
            scatter = _group_scatter(readings, each)
        table.append(CurveScore(triads, left_out, place == chosen, odds, scatter))
    return {n: terms[n] for n in curves.choices[chosen]}, table if len(table) > 1 else []


def _group_scatter(readings: Readings, options: Options) -> float | None:
    """How far directions within groups scatter, degrees, each station being corrected by the fit without it."""
    if readings.magnetometer is None or not (readings.groups >= 0).any():
        return None
    result = fit(batch_of_one(readings), options)
    problem, state = result.problem, result.state
    params = state.params[0] + without_station(problem, state, result.analysis)[0]
    g, b = (
        t.model.fields(params[:, where], t.raw[0, :, None], problem.temperature[0, :, None])[:, 0]
        for t, where in zip(problem.triads, problem.slices(), strict=True)
    )
    return stated(np.degrees(group_scatter(directions(g, b), readings.groups)))


def compare_curves(readings: Readings, options: Options, terms: Mapping[str, float]) -> Curves:
    """Which of the offered own-axis terms each run (B, n, …) shows clearly."""
    choices, count = choices_of(readings, terms), len(readings.accelerometer)
    if len(choices) == 1:
        return Curves(choices, np.zeros(count, int), np.zeros((count, 1)), False)
    each = [{name: terms[name] for name in choice} for choice in choices]
    if any(name in readings.sd for name in TRIADS):
        return Curves(choices, *_by_left_out(readings, options, each), False)
    include = np.ones(readings.accelerometer.shape[:-1])
    if options.robust:  # those that a robust fit with all terms trusts
        trust = fit(readings, replace(options, nonlinearity=each[-1])).trust
        include = np.asarray(trust > TRUSTED, float)
    odds = log_odds(readings, options, each[-1], include)
    score = np.stack([np.zeros(count), odds], -1)
    return Curves([(), choices[-1]], np.asarray(odds > ODDS, int), score, True)


def choices_of(readings: Readings, terms: Mapping[str, float]) -> list[tuple[str, ...]]:
    """Which triads may have terms: none first, then each offered one that the run has, then both."""
    names = [name for name in readings.triads if name in terms]
    return [c for count in range(len(names) + 1) for c in combinations(names, count)]


def log_odds(
    readings: Readings, options: Options, terms: Mapping[str, float], include: Array
) -> Array:
    """Logarithm (B,) of how much more probable all offered terms make the readings than none.

    `include` (B, n) as of `fit`.
    """
    evidence = []
    for curved in ({}, terms):
        result = fit(readings, replace(options, robust=None, nonlinearity=curved), include)
        evidence.append(log_evidence(result.problem, result.state))
    return np.nan_to_num(evidence[1] - evidence[0], nan=-np.inf)


def _by_left_out(
    readings: Readings, options: Options, choices: Sequence[Mapping[str, float]]
) -> tuple[Ints, Array]:
    """The choices (B,) by χ² of stations left out, and its mean (B, choices).

    More terms are taken only if they lower χ² clearly below that of fewer: by 2 %, and by two
    standard errors.
    """
    readings = with_noise(readings, replace(options, nonlinearity=choices[-1]))
    scores = [_left_out(readings, replace(options, nonlinearity=terms)) for terms in choices]
    best, least = np.zeros(len(scores[0]), int), scores[0]
    for index, score in enumerate(scores):
        gain = least - score
        error = gain.std(-1, ddof=1) / np.sqrt(readings.count)
        clear = gain.mean(-1) > CLEAR_ERRORS * error
        better = clear & (score.mean(-1) < BETTER_SHARE * least.mean(-1))
        best, least = np.where(better, index, best), np.where(better[:, None], score, least)
    return best, np.stack([score.mean(-1) for score in scores], -1)


def _left_out(readings: Readings, options: Options) -> Array:
    """χ² per reading (B, n) of stations, each judged by the fit without it."""
    result = fit(readings, options)
    left = left_out_residual(result.analysis)
    weighed = result.problem.linear(result.state).weigh(left[..., None])[..., 0]
    return np.asarray(np.mean(left * weighed, -1))
