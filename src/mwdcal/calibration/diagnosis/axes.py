"""Which `axes` of the tool profile would explain a run that the declared ones do not.

A linear triad absorbs any exchange and reversal of its channels into its gain: raw readings that
are fitted with their references give the gain, and the signed permutation nearest to it says how
the channels lie.
"""

from __future__ import annotations

from itertools import permutations, product

import numpy as np

from mwdcal.calibration.diagnosis.plausibility import is_bad, overturned
from mwdcal.calibration.estimate import Fit, fit
from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.errors import MwdcalError
from mwdcal.estimation.rank import free_directions
from mwdcal.estimation.solvers import Status
from mwdcal.geometry.vectors import Array
from mwdcal.sensor.profile import Profile

CROSS_GAIN = 0.3
"""Largest gain across the axes, as a share of those along them, of a triad in its right axes."""
FITTING_SHARE = 0.05
"""Residuals of a run in its right axes are less than this share of the field."""
SIGNED = np.array(
    [
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
)
"""The 48 signed permutations (48, 3, 3)."""


def nearest(gain: Array) -> Array:
    """The signed permutation Q (3, 3) that a gain M (3, 3) is nearest to: trace M Qᵀ is largest.

    >>> nearest(np.array([[0.01, -1.1, 0], [0.9, 0.02, 0], [0, 0.01, 1.0]])).astype(int).tolist()
    [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    """
    return np.asarray(SIGNED[int(np.argmax(np.sum(SIGNED * gain, (-1, -2))))])


def named(permutation: Array) -> tuple[str, ...]:
    """The `axes` of a profile (tool axes from channels, (3, 3)).

    >>> named(np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]]))
    ('+y', '-x', '+z')
    """
    rows = np.argmax(np.abs(permutation), 0).tolist()
    signs = ["+" if permutation[row, channel] > 0 else "-" for channel, row in enumerate(rows)]
    return tuple(f"{sign}{'xyz'[row]}" for sign, row in zip(signs, rows, strict=True))


def explaining(readings: Readings, profile: Profile) -> dict[str, tuple[str, ...]]:
    """The `axes` with which a run fits, by triad, where they are not those of the profile."""
    try:
        result = fit(readings)
    except (MwdcalError, np.linalg.LinAlgError):
        return {}
    free = free_directions(result.problem, result.state, result.analysis.determined)[0]
    if result.status[0] != Status.OK or not _fits(result) or any(map(is_bad, free)):
        return {}
    axes, problem = {}, result.problem
    for name, triad, where in zip(TRIADS, problem.triads, problem.slices(), strict=False):
        slope = triad.model.slope(result.state.params[:, where], triad.raw, problem.temperature)
        gain = slope[0].mean(0)
        if name == "magnetometer" and np.isfinite(overturned(result)[0]):
            gain = -gain
        permutation = nearest(gain)
        if not _is_near(gain @ permutation.transpose()):
            return {}
        if not np.array_equal(permutation, np.eye(3)):
            axes[name] = named(permutation @ getattr(profile, name).permutation)
    return axes


def _is_near(gain: Array) -> bool:
    """Whether a gain is along its axes."""
    along = np.diagonal(gain)
    across = np.abs(gain - np.diag(along)).max()
    return bool(along.min() > 0 and across < CROSS_GAIN * along.min())


def _fits(result: Fit) -> bool:
    """Whether the readings are explained at all."""
    triads = result.problem.triads
    noise = np.sqrt(result.analysis.variance_factor[0]) * [triad.sd.mean() for triad in triads]
    moved = [np.linalg.norm(t.raw[0] - t.raw[0].mean(0), axis=-1).mean() for t in triads]
    return bool(np.all(noise < FITTING_SHARE * np.array(moved)))
