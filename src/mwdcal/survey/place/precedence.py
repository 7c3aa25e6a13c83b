"""Which source counts where several state a quantity of a place, and where two of them contradict each other.

One order for gravity, field, dip, declination and convergence: the table of the readings, as it was measured with
them; then the reference of the place, in which a measured value comes before that of a model; then a model. The
source that does not count is still compared with the one that does.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mwdcal.calibration.record import Finding
from mwdcal.geometry.vectors import Array, ArrayLike

FARTHEST = 2.0
"""Combined standard uncertainties beyond which one value contradicts another."""
LARGEST_TURN = 0.01
"""Convergences that differ by no more agree, degrees: they have no uncertainty."""
QUANTITIES = {
    "gravity": ("g", 5),
    "field": ("nT", 0),
    "dip": ("°", 2),
    "declination": ("°", 2),
    "convergence": ("°", 2),
}
"""Unit of each quantity, and decimals of a message."""
FROM_TABLE, FROM_REFERENCE, FROM_MODEL, NO_SOURCE = "table", "reference", "field model", "none"
"""Sources, in their order."""
_LEAST_SHARE = 1e-9


class Claim(NamedTuple):
    """What a source states of a quantity: values (n,) in the unit of `QUANTITIES`, with standard uncertainties.

    NaN where it states none.
    """

    source: str
    values: ArrayLike
    sd: ArrayLike = 0.0


def contradictions(name: str, counts: Claim, other: Claim, remedy: str) -> list[Finding]:
    """The finding `NAME-disagrees` if two claims differ by more than their uncertainties; the first one counts.

    Definition: at `FARTHEST` standard uncertainties for one value, farther for several, so that claims that agree are
    named as seldom, however many they are.
    """
    there = ~np.isnan(np.asarray(counts.values, float)) & ~np.isnan(np.asarray(other.values, float))
    values, others, sd = (
        np.broadcast_to(array, there.shape)[there]
        for array in (counts.values, other.values, np.hypot(counts.sd, other.sd))
    )
    if not values.size:
        return []
    from scipy.special import ndtr, ndtri

    off = values - others
    if name in ("declination", "convergence"):
        off = (off + 180.0) % 360.0 - 180.0
    limit = -ndtri(ndtr(-FARTHEST) / off.size) * sd + _LEAST_SHARE * np.abs(others)
    excess = np.abs(off) - np.maximum(limit, LARGEST_TURN if name == "convergence" else 0.0)
    if not (excess > 0).any():
        return []
    return [
        Finding(
            id=f"{name}-disagrees",
            text=_text(name, counts, other, (values, off, sd, excess)) + f" {remedy}",
        )
    ]


def _text(name: str, counts: Claim, other: Claim, parts: tuple[Array, Array, Array, Array]) -> str:
    """Both values where they differ most, and what counts."""
    values, off, sd, excess = parts
    unit, decimals = QUANTITIES[name]
    worst, gap = int(np.argmax(excess)), "" if unit == "°" else " "
    rows = f" at {np.count_nonzero(excess > 0)} of {off.size} rows" if off.size > 1 else ""
    first, second, apart = (
        f"{number:+.{decimals}f}" if unit == "°" else f"{number:.{decimals}f}"
        for number in (values[worst], values[worst] - off[worst], off[worst])
    )
    spread = f" ± {sd[worst]:.{decimals}f}" if sd[worst] else ""
    return (
        f"{name}: {counts.source} states {first}{gap}{unit}{rows}, {other.source} {second}{gap}{unit}: they differ by "
        f"{apart}{spread}{gap}{unit}. The value of {counts.source} counts."
    )


def source_of(stated: Array, otherwise: str) -> str:
    """Where the values of rows come from, of which the table has `stated` (n,) true, and the rest `otherwise`."""
    count = int(np.count_nonzero(stated))
    if count in (0, len(stated)):
        return FROM_TABLE if count else otherwise
    return f"{FROM_TABLE} at {count} of {len(stated)} rows, else {otherwise}"
