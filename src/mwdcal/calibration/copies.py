"""Readings that agree more closely than independent ones do: copies, whatever their digits.

Two measurements at one attitude differ on each channel by a normal variable of √2 times its noise, and at least by
nothing where its resolution is coarser than that. So half the sum of their squared differences in units of the noise
is χ², with a degree of freedom for each channel, and the chance that so many pairs agree so closely is binomial.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from msgspec import UNSET

from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration
from mwdcal.geometry.vectors import Array, Bools, Ints

AGREEING = 0.05
"""Readings of a run agree that differ by no more than this share of their noise, root mean square over channels."""
NEAR = 10.0
"""Stations of one attitude differ on no channel by more than so many times its noise."""
BLOCK_OF_STATIONS = 256
"""Stations whose distances to all others are worked out at once."""
COINCIDENCE = 1e-3
"""Chance below which as many pairs of measurements that agree are not a coincidence."""
LEAST_STEP = 1e-3
"""A resolution below this share of the noise is as good as none."""
REPEATING = 10.0
"""Readings of two runs may repeat so many times better than the noise that residuals show: errors of the stand, or of
the model, that return with the attitude are in it."""


def repeated(rows: Array) -> Bools:
    """Stations (n,) of one run that agree with an earlier one, of readings (n, k) in units of their noise.

    None where so many pairs agree by chance, with a probability of `COINCIDENCE` or more.
    """
    pairs, near, again = 0, 0, np.zeros(len(rows), bool)
    none = np.zeros(rows.shape[-1])
    for some, square, largest in _differences(rows, rows, none):
        earlier = np.arange(len(rows)) < np.arange(len(rows))[some, None]
        agreeing = earlier & (square <= rows.shape[-1] * AGREEING**2)
        pairs += int(np.count_nonzero(agreeing))
        near += int(np.count_nonzero(earlier & (largest <= NEAR)))
        again[some] = agreeing.any(-1)
    if not pairs:
        return again
    chance = _at_least(np.array(pairs), near, np.array(agreement(resolutions(rows))))
    return again if chance < COINCIDENCE else np.zeros(len(rows), bool)


def _at_least(successes: Ints, trials: int, chance: Array) -> Array:
    """Chance (...) of as many successes (...) or more in so many trials: binomial."""
    from scipy.special import bdtrc

    return np.asarray(bdtrc(successes - 1, trials, chance))


def agreement(steps: Array) -> float:
    """Chance that two measurements of one value agree on channels of these resolutions (k,), in units of their noise.

    Definition: on channels with steps coarser than any difference that agrees they have to be equal.
    """
    from scipy.special import erf, gammainc

    square = len(steps) * AGREEING**2
    coarse = steps**2 > 4 * square
    equal = np.where(steps >= 1.0, 1.0, erf(steps / 4))[coarse]
    return float(np.prod(equal) * gammainc(float(np.sum(~coarse)) / 2, square / 4))


def in_fit(calibration: Calibration, readings: Readings) -> Bools:
    """Stations (n,) of readings that are behind the fit: by their fingerprints, or as copies with other digits.

    Definition: they agree with stations of the fit, on both triads or on one, as readings that repeat `REPEATING` times
    better than their noise would with a chance below `COINCIDENCE`. Files of earlier versions have fingerprints alone;
    readings without them are not compared.
    """
    if not readings.digest:
        return np.zeros(readings.count, bool)
    used = np.array(calibration.used(readings.digest), bool)
    stored = [row.readings for row in calibration.station_rows]
    triads = [getattr(readings, triad.name) for triad in calibration.triads]
    if used.all() or not stored or UNSET in stored or not _noise(calibration).all():
        return used
    ours = np.concatenate([triad for triad in triads if triad is not None], -1)
    size = min(ours.shape[-1], len(calibration.triads) * 3)
    unit = np.repeat(_noise(calibration), 3)[:size] / REPEATING
    ours, theirs = ours[:, :size] / unit, np.array(stored)[:, :size] / unit
    parts = [slice(0, 3)] if size == 3 else [slice(0, 3), slice(3, 6), slice(0, 6)]
    for part in parts:
        used |= _agreeing(ours[:, part], theirs[:, part], COINCIDENCE / len(parts))
    return used


def _noise(calibration: Calibration) -> Array:
    """Noise (t,) of a reading of each triad, as the residuals have it where more is declared."""
    less = [min(triad.variance_factor or 1.0, 1.0) for triad in calibration.triads]
    return np.array([triad.noise for triad in calibration.triads]) * np.sqrt(less)


def _agreeing(rows: Array, others: Array, coincidence: float) -> Bools:
    """Rows (m,) of readings (m, k) too close to one of `others` (n, k) for a chance of `coincidence`.

    Definition: k rows whose pairs have at most a chance p, where k of all pairs at one attitude would have it with a
    probability below a share 6 / (π k)² of `coincidence`: of any number of rows together, that is the chance.
    """
    from scipy.special import gammainc

    nearest, trials = np.zeros(len(rows)), len(rows)
    for some, square, largest in _differences(rows, others, resolutions(others) / 2):
        nearest[some] = square.min(-1)
        trials += int(np.count_nonzero(largest <= NEAR * REPEATING))
    chance = gammainc(rows.shape[-1] / 2, nearest / 4)
    closest, count = np.sort(chance), np.arange(1, len(rows) + 1)
    share = 6 / (np.pi * count) ** 2
    unlikely = closest[_at_least(count, trials, closest) < coincidence * share]
    return np.asarray(chance <= unlikely.max(initial=-1.0))


def _differences(rows: Array, others: Array, least: Array) -> Iterator[tuple[slice, Array, Array]]:
    """Squared and largest differences (b, n) of blocks of b rows (m, k) from `others` (n, k), at least `least` (k,)."""
    for first in range(0, len(rows), BLOCK_OF_STATIONS):
        some = slice(first, first + BLOCK_OF_STATIONS)
        square, largest = np.zeros((2, len(rows[some]), len(others)))
        for ours, theirs, step in zip(rows[some].T, others.T, least, strict=True):
            apart = np.maximum(np.abs(ours[:, None] - theirs), step)
            square += apart**2
            largest = np.maximum(largest, apart)
        yield some, square, largest


def resolutions(rows: Array) -> Array:
    """Resolution (k,) of each channel of readings (n, k)."""
    return np.array([resolution(channel) for channel in rows.T])


def resolution(values: Array) -> float:
    """Largest step of which all differences of values (n,) are multiples; 0 where none is above `LEAST_STEP`.

    Reference: Euclid's algorithm, to `LEAST_STEP`.
    """
    rest, step = np.abs(values - values[0]), 0.0
    while (left := rest[rest > LEAST_STEP]).size:
        step = float(left.min())
        rest = np.abs(rest - step * np.round(rest / step))
    return step if step > 10 * LEAST_STEP else 0.0
