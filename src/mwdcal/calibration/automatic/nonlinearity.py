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

from mwdcal.calibration.automatic.order_selection import misfit
from mwdcal.calibration.estimate import fit, scatters
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.estimation.variance import log_evidence
from mwdcal.geometry.vectors import Array
from mwdcal.sensor.profile import Profile

USUAL = 0.005
"""Prior of own-axis terms, as a share of the field, where they are asked for and none is declared."""
BETTER = 0.98
"""Left-out χ² must fall to this share before own-axis terms are taken…"""
CLEAR = 2.0
"""…and by so many standard errors of its mean over the stations."""
PARTS = 32
"""Stations are left out one by one, or in so many parts where there are more."""
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
    """

    triads: tuple[str, ...]
    left_out: float | None
    chosen: bool
    odds: float | None = None


def declared(profile: Profile, options: Options) -> dict[str, float]:
    """Triads whose profile declares a nonlinearity and whose model can have it, with its prior.

    Only the polynomial model has such terms, and only the common estimator their prior.
    """
    found: dict[str, float] = {}
    if options.own_solver:
        return found
    for name, order in zip(TRIADS, options.orders, strict=True):
        value = getattr(profile, name).nonlinearity
        if value and options.kind(order) == "polynomial":
            found[name] = value
    return found


def with_nonlinearity(options: Options, profile: Profile) -> Options:
    """The options with the own-axis terms that the profile declares, unless they say otherwise."""
    if options.nonlinearity is not None:
        return options
    return replace(options, nonlinearity=declared(profile, options))


def with_chosen_curves(
    readings: Readings, options: Options, offered: Mapping[str, float]
) -> tuple[Options, list[CurveScore]]:
    """The options with those of the offered own-axis terms that the run speaks for, and the table.

    Where terms are offered and the noise is estimated, so is the scatter from station to station.
    """
    if not offered:
        return replace(options, nonlinearity={}), []
    options = replace(options, scatter=True)
    options = replace(options, scatter=scatters(readings, options))
    found, table = choose_curves(readings, options, offered)
    return replace(options, nonlinearity=found), table


def choose_curves(
    readings: Readings, options: Options, offered: Mapping[str, float]
) -> tuple[dict[str, float], list[CurveScore]]:
    """Of the offered own-axis terms those that the run speaks for clearly, and the table."""
    choices = choices_of(readings, offered)
    if len(choices) == 1:
        return {}, []
    if not any(name in readings.sd for name in TRIADS):
        every = {name: offered[name] for name in choices[-1]}
        odds = float(log_odds(readings, options, every, _trusted(readings, options, every))[0])
        taken = odds > ODDS
        table = [
            CurveScore((), None, not taken, 0.0),
            CurveScore(choices[-1], None, taken, odds / float(np.log(10))),
        ]
        return (every if taken else {}), table
    best, table = _by_left_out(readings, options, offered, choices)
    return {n: offered[n] for n in choices[best]}, table


def choices_of(readings: Readings, offered: Mapping[str, float]) -> list[tuple[str, ...]]:
    """Which triads may have terms: none first, then each offered one that the run has, then both."""
    names = [name for name in TRIADS if name in offered and getattr(readings, name) is not None]
    return [c for count in range(len(names) + 1) for c in combinations(names, count)]


def log_odds(
    readings: Readings, options: Options, offered: Mapping[str, float], include: Array
) -> Array:
    """Logarithm (B,) of how much more probable all offered terms make the readings than none.

    `include` (B, n) as of `fit`.
    """
    found = []
    for terms in ({}, dict(offered)):
        result = fit(readings, replace(options, robust=None, nonlinearity=terms), include)
        found.append(log_evidence(result.problem, result.state))
    return np.nan_to_num(found[1] - found[0], nan=-np.inf)


def _trusted(readings: Readings, options: Options, offered: Mapping[str, float]) -> Array:
    """Stations (1, n) that may decide: all, or those that a robust fit with all terms trusts."""
    if not options.robust:
        return np.ones((1, readings.count))
    every = replace(options, nonlinearity=dict(offered))
    return np.asarray(fit(readings, every).trust > TRUSTED, float)


def _by_left_out(
    readings: Readings,
    options: Options,
    offered: Mapping[str, float],
    choices: Sequence[tuple[str, ...]],
) -> tuple[int, list[CurveScore]]:
    """The choice by χ² of stations left out, and the table.

    More terms are taken only if they lower χ² clearly below that of fewer: by 2 %, and by two
    standard errors.
    """
    every = replace(options, nonlinearity={n: offered[n] for n in choices[-1]})
    noise = dict(zip(TRIADS, fit(readings, every).noise[0], strict=False))
    found = {name: np.array(sd) for name, sd in noise.items() if np.isfinite(sd)}
    readings = replace(readings, sd={**readings.sd, **found})
    scores = [
        _left_out(readings, replace(options, nonlinearity={n: offered[n] for n in choice}))
        for choice in choices
    ]
    best = 0
    for index, score in enumerate(scores):
        gain = scores[best] - score
        error = gain.std(ddof=1) / np.sqrt(len(gain))
        if score.mean() < BETTER * scores[best].mean() and gain.mean() > CLEAR * error:
            best = index
    pairs = enumerate(zip(choices, scores, strict=True))
    return best, [CurveScore(c, float(score.mean()), i == best) for i, (c, score) in pairs]


def _left_out(readings: Readings, options: Options) -> Array:
    """χ² per reading (n,) of stations, each judged by the fit without its part."""
    parts = min(readings.count, PARTS)
    own = np.arange(readings.count) % parts
    include = (np.arange(parts)[:, None] != own).astype(float)
    result = fit(readings, options, include)
    return np.asarray(misfit(result)[own, np.arange(readings.count)].mean(-1) / 3)
