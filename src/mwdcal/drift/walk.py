"""How fast parameters wander: a random walk of each, its rate estimated with that of the tool's peers.

Between two calibrations t years apart a parameter moves by a normal variable of variance q t. Parameters of
a kind (`WALK_GROUPS`) have one rate; rates of tools of a type are log-normal about a common one, but
for a few (`UNLIKE_SHARE`) of any rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import logsumexp

from mwdcal.calibration.readings import TRIADS
from mwdcal.drift.comparable import FACTOR_NAMES, WALK_KINDS, History
from mwdcal.geometry.vectors import Array

WALK_GROUPS = tuple((triad, kind) for triad in TRIADS for kind in WALK_KINDS)
"""Triad and kind of the parameters that wander at one rate."""
LEAST_DECADE, DECADE = -4.0, 3.0
"""Least and, at least, largest rate that is tried: decimal logarithm of variance a year over a calibration's."""
BEYOND = 2.0
"""Decades by which the largest rate exceeds the square of the largest change of any tool."""
DECADE_STEP = 0.125
"""Between rates that are tried, decades."""
CENTRE_STEP, CENTRE_MARGIN = 0.2, 0.5
"""Between rates about which those of a type may lie, all equally probable beforehand, and from the ends, decades."""
RATE_SPREADS = np.linspace(0.05, 2.0, 40)
"""Standard deviations, in decades, of the rates of tools of a type; see `SPREAD_SCALE`."""
SPREAD_SCALE = 0.4
"""Most probable of these before there are data, of a Rayleigh distribution: it keeps away from none at all."""
UNLIKE_SHARE = 0.02
"""Share of the tools of a type, knocked or repaired ones, whose rates are unlike those of the others."""
VISIT = 7 / 365.25
"""Calibrations that are no further apart, years, are of one visit: the tool is repaired then, it does not wander."""


def group_places(names: Sequence[str], triad: str, kind: str) -> list[int]:
    """Places of the parameters of a group at the middle temperature."""
    members = {f"{triad} {title}" for title in FACTOR_NAMES if title.startswith(kind)}
    return [place for place, name in enumerate(names) if name in members]


@dataclass(frozen=True)
class Increments:
    """Changes (m,) of a group from visit to visit, in axes in which walk and noise are both white.

    Of variance q + `noise` (m,) at a rate q, variance per year.
    """

    change: Array
    noise: Array

    @classmethod
    def of(cls, history: History, places: Sequence[int]) -> Increments:
        """Those of the calibrations that have all parameters of the group and none of the others as a prior."""
        values, covariance = history.values[:, places], history.covariance
        block = covariance[:, places][..., places]
        known = np.diagonal(history.precision, axis1=-2, axis2=-1)[:, places]
        independent = True if history.has_prior is None else ~history.has_prior
        usable = np.flatnonzero(np.isfinite(values).all(-1) & (known > 0).all(-1) & independent)
        gaps = np.diff(history.years[usable])
        apart = gaps > VISIT
        count, size = int(np.count_nonzero(apart)), len(places)
        if not count or not size:
            return cls(np.zeros(0), np.zeros(0))
        gaps, step = gaps[apart], np.diff(np.eye(len(usable)), axis=0)[apart]
        noise = np.zeros((count, size, count, size))
        for column, calibration in enumerate(usable):
            weight = step[:, column, None] * step[:, column] / np.sqrt(np.outer(gaps, gaps))
            noise += weight[:, None, :, None] * block[calibration][None, :, None, :]
        spread, axes = np.linalg.eigh(noise.reshape(count * size, count * size))
        change = (step @ values[usable] / np.sqrt(gaps)[:, None]).ravel()
        return cls(change @ axes, np.maximum(spread, 0.0))

    def log_likelihood(self, rates: Array) -> Array:
        """Log likelihood (r,) of rates (r,), but for a constant."""
        variance = rates[:, None] + self.noise
        return np.asarray(-0.5 * np.sum(np.log(variance) + self.change**2 / variance, -1))


@dataclass(frozen=True)
class GroupRates:
    """Rates of a group in the tools of one type, learnt from some of them.

    `unit`: variance of a calibration, by which rates are counted; `decades` (r,) the logarithms of the rates that
    are tried, in it; `log_likelihood` (tools, r) of the rates of these tools.
    """

    unit: float
    decades: Array
    log_likelihood: Array

    @classmethod
    def of(cls, tools: Sequence[Increments]) -> GroupRates | None:
        """Of tools of a type; None where none of them has two calibrations of the group."""
        moved = [each for each in tools if each.noise.size]
        if not moved:
            return None
        unit = float(np.median(np.concatenate([each.noise for each in moved]))) or 1.0
        largest = max(float(np.max(each.change**2)) for each in moved)
        end = max(DECADE, BEYOND + np.log10(max(largest / unit, 1.0)))
        decades = np.arange(LEAST_DECADE, end + DECADE_STEP, DECADE_STEP)
        return cls(unit, decades, np.stack([e.log_likelihood(unit * 10.0**decades) for e in moved]))

    @property
    def rates(self) -> Array:
        """The rates (r,) that are tried, variance per year."""
        return np.asarray(self.unit * 10.0**self.decades)

    @cached_property
    def _centres(self) -> Array:
        """Decades (c,) about which the rates of the type may lie."""
        low, high = self.decades[0] + CENTRE_MARGIN, self.decades[-1] - CENTRE_MARGIN
        return np.arange(low, high + CENTRE_STEP / 2, CENTRE_STEP)

    @cached_property
    def _members(self) -> Array:
        """Share (c, s, r) of the tools of a type with each rate, by centre and spread of the type."""
        z = (self.decades - self._centres[:, None, None]) / RATE_SPREADS[:, None]
        density = np.exp(-0.5 * z**2)
        alike = density / density.sum(-1, keepdims=True)
        return np.asarray((1 - UNLIKE_SHARE) * alike + UNLIKE_SHARE / len(self.decades))

    def _evidence(self, log_likelihood: Array) -> Array:
        """Log probability (…, c, s) of a tool's calibrations, by centre and spread of its type."""
        largest = log_likelihood.max(-1, keepdims=True)
        by_type = self._members.reshape(-1, self._members.shape[-1])
        logs = np.log(np.maximum(np.exp(log_likelihood - largest) @ by_type.mT, 1e-300)) + largest
        return np.asarray(logs.reshape(*largest.shape[:-1], *self._members.shape[:2]))

    @cached_property
    def type_probability(self) -> Array:
        """Probability (c, s) of centre and spread of the type, by the tools it was learnt from."""
        prior = np.log(RATE_SPREADS) - 0.5 * (RATE_SPREADS / SPREAD_SCALE) ** 2
        logs = self._evidence(self.log_likelihood).sum(0) + prior
        return np.asarray(np.exp(logs - logsumexp(logs)))

    @property
    def peers_probability(self) -> Array:
        """Probability (r,) of each rate of a tool of the type of which nothing else is known."""
        return np.asarray(np.einsum("cs,csr->r", self.type_probability, self._members))

    def edge(self, tool: Increments | None) -> str | None:
        """The finding that the rate of a tool, or where its own say nothing its type, is likeliest at an end.

        That of changes within the uncertainties is, at the least rate.
        """
        likelihood = self.log_likelihood.sum(0)
        if tool is not None and tool.noise.size:
            likelihood = tool.log_likelihood(self.rates)
        return {0: "walk-unseen", len(self.decades) - 1: "walk-edge"}.get(
            int(np.argmax(likelihood))
        )

    def probability(self, tool: Increments, among: bool) -> Array:
        """Probability (r,) of each rate of a tool; `among` those that the type was learnt from or not."""
        likelihood = tool.log_likelihood(self.rates)
        weight = self.type_probability
        if among and tool.noise.size:
            logs = np.log(np.maximum(weight, 1e-300)) - self._evidence(likelihood)
            weight = np.exp(logs - logs.max())
        logs = likelihood + np.log(
            np.maximum(np.einsum("cs,csr->r", weight, self._members), 1e-300)
        )
        return np.asarray(np.exp(logs - logsumexp(logs)))


def quantiles(rates: Array, probability: Array, shares: Sequence[float]) -> Array:
    """Rates below which lie the given shares of a distribution (r,) over rates (r,), between them interpolated."""
    inner = np.cumsum(probability) - probability / 2
    return np.asarray(np.exp(np.interp(shares, inner, np.log(rates))))


def draws(rates: Array, probability: Array, count: int, rng: np.random.Generator) -> Array:
    """Rates (count,) drawn from a distribution over rates."""
    return quantiles(rates, probability, rng.uniform(size=count).tolist())
