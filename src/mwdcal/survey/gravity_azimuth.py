"""Azimuth from gravity alone: how far the hole turns between two packages of accelerometers.

The packages are joined by a pipe that bends along a circular arc and does not twist. Inclinations and
toolfaces at both ends then give the change of azimuth between them; a magnetic azimuth at one end,
away from iron, becomes one at the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mwdcal.calibration.record import Finding
from mwdcal.geometry.vectors import Array, ArrayLike, Bools, centred

LARGEST_AMPLIFICATION = 5.0
"""Errors of the toolface are passed on to the azimuth at most by this factor, about that at 78°."""


@dataclass(frozen=True)
class GravityAzimuth:
    """Change of azimuth (…) from the first package to the second, and what it is sensitive to.

    `gradient` (…, 3): by the first inclination, the second, and the change of toolface.
    """

    change: Array
    gradient: Array

    def uncertainty(self, first: ArrayLike, second: ArrayLike, toolface_change: ArrayLike) -> Array:
        """Standard uncertainty (…) from those of both inclinations and of the change of toolface, rad."""
        each = np.stack(np.broadcast_arrays(first, second, toolface_change), -1)
        return np.asarray(np.linalg.norm(self.gradient * each, axis=-1))

    @property
    def unreliable(self) -> Bools:
        """Where (…) an error of the toolface is multiplied by more than `LARGEST_AMPLIFICATION`."""
        return np.asarray(~(np.abs(self.gradient[..., 2]) <= LARGEST_AMPLIFICATION))

    def findings(self) -> list[Finding]:
        """A warning where errors of toolface are much amplified, as near horizontal."""
        count, worst = (
            int(np.count_nonzero(self.unreliable)),
            np.nanmax(np.abs(self.gradient[..., 2])),
        )
        if not count:
            return []
        text = (
            f"{count} of {self.change.size} azimuth changes from gravity are unreliable: near horizontal "
            f"an error of the toolface is multiplied by up to {worst:.3g}. Use them only up to about 78°."
        )
        return [Finding(id="gravity-azimuth-unreliable", text=text)]


def gravity_azimuth(
    first_inclination: ArrayLike, second_inclination: ArrayLike, toolface_change: ArrayLike
) -> GravityAzimuth:
    """Change of azimuth between two packages joined by a circular arc without twist.

    Definition: tan(ΔA/2) = -tan(ΔT/2) cos((I₁-I₂)/2) / cos((I₁+I₂)/2), ΔT = T₂ - T₁.
    Units: radians. Shapes: all broadcast to (…). Singular: NaN gradient where both packages hang
    symmetrically about horizontal and ΔT is zero; between straight up and straight down.
    """
    inputs = np.broadcast_arrays(first_inclination, second_inclination, toolface_change)
    first, second, turn = (np.asarray(each, float) for each in inputs)
    less, more = (first - second) / 2, (first + second) / 2
    sine, cosine = np.sin(turn / 2), np.cos(turn / 2)
    across, along = -sine * np.cos(less), cosine * np.cos(more)
    across_by = np.stack([sine * np.sin(less), -sine * np.sin(less), -cosine * np.cos(less)], -1)
    along_by = np.stack([-cosine * np.sin(more), -cosine * np.sin(more), -sine * np.cos(more)], -1)
    square = across**2 + along**2
    size = np.where(square > 0, square, np.nan)[..., None]
    gradient = (along[..., None] * across_by - across[..., None] * along_by) / size
    return GravityAzimuth(centred(2 * np.arctan2(across, along)), np.asarray(gradient))
