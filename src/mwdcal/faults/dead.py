"""Channels that stand at a constant: how well that explains readings, and what they then read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mwdcal.calibration.readings import LEAST_TEMPERATURE_SPAN, usable_soaks
from mwdcal.faults.likelihood import Suspect, explained, raw_of, repeated
from mwdcal.faults.physics import SIZE
from mwdcal.geometry.vectors import Array, Bools, Ints

UNSTEADY = 100.0
"""Negative log density of readings, over the root of their number, at which they are no constant."""
MOST_ONSETS = 12
"""Temperatures that are tried as the one above which a channel is dead, where there are no distinct soaks."""


@dataclass(frozen=True)
class DeadChannels:
    """Every channel at every onset, as a batch of explanations (C,).

    `channel` (C,) counts components of both triads; `onset` (C,) is the coldest temperature at which it is dead,
    -inf where it always is. `evidence` (C,) is the log density of the readings, `misfit` (C,) χ² of the others;
    `value` and `sd` (C,) are of the constant.
    """

    channel: Ints
    onset: Array
    evidence: Array
    misfit: Array
    value: Array
    sd: Array


def dead_channels(suspect: Suspect) -> DeadChannels:
    """The explanations by a dead channel of one tool.

    The constant may be anything of the size of the field. A channel that stands still may do so from some soak
    upwards, for heat breaks it.
    """
    raw, temperature = raw_of(suspect.problem)[0], suspect.problem.temperature[0]
    sd = np.concatenate([triad.sd for triad in suspect.problem.triads], -1)[0]
    onsets = _onsets(temperature)
    channel = np.repeat(np.arange(raw.shape[-1]), len(onsets))
    onset = np.tile(onsets, raw.shape[-1])
    broken = (temperature >= onset[:, None])[..., None] & (
        np.arange(raw.shape[-1]) == channel[:, None, None]
    )
    density, value, spread = _constant(raw, sd, broken, _strengths(suspect))
    steady = np.flatnonzero(density > -UNSTEADY * np.sqrt(broken.sum((-1, -2))))
    evidence, misfit = np.full((2, len(channel)), -np.inf)
    if steady.size:
        tools = repeated(suspect, np.zeros(len(steady), int))
        sound = tools.without(broken[steady])
        state = sound.start(_readable(tools, broken[steady]))
        live = explained(sound, np.zeros((len(steady), SIZE, 0)), state)
        evidence[steady], misfit[steady] = live.evidence + density[steady], live.misfit
    return DeadChannels(channel, onset, evidence, misfit, value, spread)


def _onsets(temperature: Array) -> Array:
    """Where a channel may have died: always, or from one of at most `MOST_ONSETS` temperatures upwards, °C."""
    warmer = np.unique(temperature)[1:]
    if np.ptp(temperature) < LEAST_TEMPERATURE_SPAN:
        warmer = warmer[:0]
    if len(warmer) > MOST_ONSETS:
        soak = usable_soaks(temperature)
        starts = [temperature[soak == number].min() for number in range(1, soak.max() + 1)]
        spread = np.quantile(warmer, np.linspace(0, 1, MOST_ONSETS), method="lower")
        warmer = np.unique(np.concatenate([starts, spread]) if len(starts) < 2 else starts)
    return np.concatenate([[-np.inf], warmer])


def _strengths(suspect: Suspect) -> Array:
    """Gravity and field (m,) of the stations, for each channel."""
    evidence = suspect.problem.evidence
    sizes = [np.mean(evidence.known[name]) for name in ("gravity", "field")]
    return np.repeat(sizes[: len(suspect.problem.triads)], 3)


def _constant(raw: Array, sd: Array, broken: Bools, strength: Array) -> tuple[Array, Array, Array]:
    """Log density (C,) of readings that are a constant and noise, the constant, and its uncertainty.

    The constant has the strength of the field as its standard uncertainty.
    """
    part = np.where(broken, 1 / sd**2, 0.0)
    weight = part.sum((-1, -2))
    prior = np.sum(broken.any(-2) / strength**2, -1)
    total = np.sum(part * raw, (-1, -2))
    value = total / (weight + prior)
    square = np.sum(part * raw**2, (-1, -2)) - total * value
    return -0.5 * (square + np.log1p(weight / prior)), value, 1 / np.sqrt(weight + prior)


def _readable(tools: Suspect, broken: Bools) -> Array:
    """Readings (C, n, m) with the dead ones replaced by what the strength of the field leaves for them.

    Of the two signs that which suits the dip better: only a start, from which to find the attitudes.
    """
    raw, evidence = raw_of(tools.problem).copy(), tools.problem.evidence
    best = None
    for sign in (1.0, -1.0):
        trial = raw.copy()
        for start, name in zip(range(0, raw.shape[-1], 3), ("gravity", "field"), strict=False):
            part, dead = trial[..., start : start + 3], broken[..., start : start + 3]
            square = evidence.known[name] ** 2 - np.sum(np.where(dead, 0.0, part) ** 2, -1)
            filled = sign * np.sqrt(np.maximum(square, 0.0))[..., None]
            trial[..., start : start + 3] = np.where(dead, filled, part)
        if best is None or raw.shape[-1] == 3:
            best = trial if best is None else best
            continue
        error, other = (_dip_error(each, evidence.known) for each in (best, trial))
        best = np.where((other < error)[..., None], trial, best)
    return np.asarray(best)


def _dip_error(raw: Array, known: dict[str, Array]) -> Array:
    """How far (C, n) g·b is from what strengths and dip say."""
    expected = known["gravity"] * known["field"] * np.sin(np.nan_to_num(known["dip"], nan=1.0))
    return np.asarray(np.abs(np.sum(raw[..., :3] * raw[..., 3:], -1) - expected))
