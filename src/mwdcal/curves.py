"""Own-axis nonlinearity, taken only where stations left out of the fit speak for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from mwdcal.core.vectors import Array
from mwdcal.estimate import fit
from mwdcal.options import Options
from mwdcal.profile import Profile
from mwdcal.readings import TRIADS, Readings
from mwdcal.selection import misfit

USUAL = 0.005
"""Prior of own-axis terms, as a share of the field, where they are asked for and none is declared."""
BETTER = 0.98
"""Left-out χ² must fall to this share before own-axis terms are taken…"""
CLEAR = 2.0
"""…and by so many standard errors of its mean over the stations."""
PARTS = 32
"""Stations are left out one by one, or in so many parts where there are more."""


@dataclass(frozen=True)
class CurveScore:
    """Left-out χ² per reading, in units of the noise, with own-axis terms of some triads."""

    triads: tuple[str, ...]
    left_out: float
    chosen: bool


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


def choose_curves(
    readings: Readings, options: Options, offered: Mapping[str, float]
) -> tuple[dict[str, float], list[CurveScore]]:
    """Of the offered own-axis terms those that improve left-out stations, and the table.

    More terms are taken only if they lower χ² clearly below that of fewer: by 2 %, and by two
    standard errors.
    """
    names = [name for name in TRIADS if name in offered and getattr(readings, name) is not None]
    if not names:
        return {}, []
    choices = [(), *((name,) for name in names), *([tuple(names)] if len(names) > 1 else [])]
    every = replace(options, nonlinearity={n: offered[n] for n in names})
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
    table = [
        CurveScore(choice, float(score.mean()), index == best)
        for index, (choice, score) in enumerate(zip(choices, scores, strict=True))
    ]
    return {n: offered[n] for n in choices[best]}, table


def _left_out(readings: Readings, options: Options) -> Array:
    """χ² per reading (n,) of stations, each judged by the fit without its part."""
    parts = min(readings.count, PARTS)
    own = np.arange(readings.count) % parts
    include = (np.arange(parts)[:, None] != own).astype(float)
    result = fit(readings, options, include)
    return np.asarray(misfit(result)[own, np.arange(readings.count)].mean(-1) / 3)
