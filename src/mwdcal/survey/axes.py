"""Axes of surveys that are exchanged or reversed, as the calibration shows them.

With x and y exchanged in both sensors a tool is its own mirror image: |g|, |b|, dip and inclination of perfect sensors
stay, and azimuth and toolface count the wrong way. Real sensors differ from axis to axis in offset and scale, which the
calibration then takes off the wrong axes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mwdcal.calibration.diagnosis.identity import other_tool
from mwdcal.calibration.diagnosis.refusals import SIGNED
from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.errors import MwdcalError
from mwdcal.geometry.vectors import Array
from mwdcal.survey.interference import LEAST_CHANCE, usable
from mwdcal.survey.interference_estimate import Assumed, chi_square, surveys

NAMED_BY_CHANCE = 1e-3
"""Largest share of sound runs that fit other axes so much better."""
AS_LIKELY = 100.0
"""Exchanges of which the likelihood is less than so many times smaller fit as well: the simplest is named."""
MISFIT_LEFT = 0.1
"""Other axes that leave less than this share of χ² explain a misfit, even where they do not fit by the noise."""
SURVEYS_COMPARED = 40
"""Surveys of a run that are looked at: offsets and scales are the same at all."""
_SAME = np.broadcast_to(np.eye(3), SIGNED.shape)
EXCHANGES = np.concatenate(
    [np.stack(pair, 1) for pair in ((SIGNED, SIGNED), (SIGNED, _SAME), (_SAME, SIGNED))]
)
"""Signed permutations (k, 2, 3, 3) of the tool axes in accelerometer and magnetometer: in both alike, or in one."""

CHANGED = (np.eye(3) != EXCHANGES).any(-1).sum((1, 2))
"""Axes (k,) that each changes."""


def exchanged_axes(calibration: Calibration, readings: Readings) -> list[Finding]:
    """The finding that surveys of one well (n,) fit the calibration with other axes, and not with their own.

    Definition: χ² as of `interference_estimate.chi_square`, with interference and drift. Other axes are named if the
    surveys fit with them or leave `MISFIT_LEFT` of χ², do not fit without, and their likelihood ratio exp(Δχ²/2)
    exceeds the number of alternatives over `NAMED_BY_CHANCE`. The mean of such a ratio over sound runs is one, so that
    by Markov's inequality at most that share of them is named. None where a magnetometer or references lack, the field
    is relative, the surveys are of another tool, or nothing tells the axes apart; where the estimate fails, the finding
    says so.
    """
    from scipy.special import chdtrc

    if not calibration.has_field or readings.magnetometer is None or calibration.relative:
        return []
    if other_tool(calibration, readings):
        return []
    rows = usable(calibration, readings)
    for name in ("field", "dip"):
        rows = rows & np.isfinite(readings.reference(name))
    places = np.flatnonzero(rows)
    if not places.size:
        return []
    chosen = places[np.linspace(0, places.size - 1, SURVEYS_COMPARED).round().astype(int)]
    rows = np.isin(np.arange(readings.count), chosen)
    try:
        some = surveys(calibration, readings.select(rows))
        named = chi_square(calibration, some, Assumed())[0]
        freedom = 3 * some.count
        if chdtrc(freedom, named) >= LEAST_CHANCE:
            return []
        others = chi_square(calibration, with_axes(calibration, some, EXCHANGES), Assumed())
        best = int(np.nanargmin(others))
    except (MwdcalError, ValueError) as error:  # LinAlgError is a ValueError
        text = f"whether columns are exchanged could not be judged: {error}"
        return [Finding(id="not-judged", text=text)]
    likelier = (named - others[best]) / 2 > np.log(len(EXCHANGES) / NAMED_BY_CHANCE)
    fits = chdtrc(freedom, others[best]) >= LEAST_CHANCE or others[best] < MISFIT_LEFT * named
    if not (likelier and fits):
        return []
    alike = others - others[best] < 2 * np.log(AS_LIKELY)
    simplest = EXCHANGES[int(np.argmin(np.where(alike, CHANGED, np.inf)))]
    like = ", or with others like it" if alike.sum() > 1 else ""
    text = (
        f"the readings fit the calibration with {_columns(calibration, simplest)}{like}, and not as their "
        "columns are named. Are columns exchanged, or a sign wrong? Azimuth and toolface are wrong then."
    )
    return [Finding(id="axes-exchanged", text=text)]


def with_axes(calibration: Calibration, readings: Readings, axes: Array) -> Readings:
    """Readings (k, n) as they would be with other axes (k, 2, 3, 3) of both triads, from those (n,) of one well."""
    shape = len(axes), readings.count

    def repeated(values: Array) -> Array:
        return np.broadcast_to(values, (*shape, *np.shape(values)[1:]))

    triads = {
        name: np.einsum(
            "kij,nj->kni", _channels(calibration, name, axes[:, i]), getattr(readings, name)
        )
        for i, name in enumerate(TRIADS)
    }
    warmth = readings.temperature
    return replace(
        readings, **triads, temperature=None if warmth is None else repeated(warmth),
        known={name: repeated(value) for name, value in readings.known.items()},
        sd={name: repeated(value) for name, value in readings.sd.items()},
        group=None, station=(), digest=(),
    )  # fmt: skip


def _channels(calibration: Calibration, triad: str, axes: Array) -> Array:
    """Signed permutations (..., 3, 3) of the channels of a triad, by those of the tool axes."""
    wiring = getattr(calibration.profile, triad).permutation
    return np.asarray(wiring.T @ axes @ wiring)


def _columns(calibration: Calibration, axes: Array) -> str:
    """The columns that would be right, in words: only those that change."""
    words = []
    for letter, name, each in zip("am", TRIADS, axes, strict=True):
        for row, channel in zip(_channels(calibration, name, each), "xyz", strict=True):
            place = int(np.argmax(np.abs(row)))
            right = f"{'−' if row[place] < 0 else ''}{letter}{'xyz'[place]}"
            words += [f"{letter}{channel} = {right}"] * (right != f"{letter}{channel}")
    return ", ".join(words)
