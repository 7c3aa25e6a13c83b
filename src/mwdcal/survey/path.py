"""Well path: minimum curvature between survey stations, and its derivative.

Between two stations the hole is an arc of a circle. With unit vectors t₁, t₂ along the hole, dogleg β
between them and course length L the arc leads from one station to the next by

    L s (t₁ + t₂),    s = tan(β/2) / β

Positions are (north, east, down) from the start, m; north is that of the azimuths. Stations lie on the
last axis of depths and angles, wells on those before.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mwdcal.geometry.observables import VERTICAL
from mwdcal.geometry.vectors import Array, ArrayLike, outer

_SHORT = 0.03
"""Dogleg, rad, below which a series has more digits than the closed form."""


def hole_direction(inclination: ArrayLike, azimuth: ArrayLike) -> Array:
    """Unit vector (…, 3) along the hole: north, east, down.

    Units: radians. Singular: at vertical any azimuth will do, also NaN.
    """
    inc, azi = np.broadcast_arrays(np.asarray(inclination, float), np.asarray(azimuth, float))
    across = np.sin(inc)
    azi = np.where(np.abs(across) <= VERTICAL, 0.0, azi)
    return np.stack([across * np.cos(azi), across * np.sin(azi), np.cos(inc)], -1)


@dataclass(frozen=True)
class Arcs:
    """Arcs between neighbouring stations: unit vectors (…, n - 1, 3) at both ends, course length (…, n - 1), m.

    `balanced`: by the balanced tangential method, s = 1/2 whatever the dogleg.
    Singular: NaN where both ends point in exactly opposite directions, as the plane of the arc is not known.
    """

    upper: Array
    lower: Array
    length: Array
    balanced: bool = False

    @property
    def dogleg(self) -> Array:
        """Angle (…, n - 1) between both ends, rad; exact for small ones too."""
        return 2 * np.arctan2(*self._half())

    def _half(self) -> tuple[Array, Array]:
        """Sine and cosine of half the dogleg."""
        sine = np.linalg.norm(self.lower - self.upper, axis=-1) / 2
        return sine, np.linalg.norm(self.lower + self.upper, axis=-1) / 2

    def _share(self) -> Array:
        """The share s = tan(β/2) / β of the sum of both directions."""
        if self.balanced:
            return np.full_like(self.length, 0.5)
        sine, cosine = self._half()
        angle = 2 * np.arctan2(sine, cosine)
        straight = angle < _SHORT
        series = 0.5 + angle**2 / 24 + angle**4 / 240 + angle**6 * 17 / 40320
        cosine = np.where(cosine > VERTICAL, cosine, np.nan)
        return np.where(straight, series, sine / cosine / np.where(straight, 1.0, angle))

    @property
    def displacement(self) -> Array:
        """Steps (…, n - 1, 3) from each station to the next, m."""
        return (self.length * self._share())[..., None] * (self.upper + self.lower)

    @property
    def by_length(self) -> Array:
        """Derivative (…, n - 1, 3) of the step with respect to the course length."""
        return self._share()[..., None] * (self.upper + self.lower)

    def by_directions(self) -> tuple[Array, Array]:
        """Derivatives (…, n - 1, 3, 3) of the step, m, with respect to the direction at each end.

        Definition: d(s (t₁ + t₂)) with ds = s' (t₂·dt₁ + t₁·dt₂), s' = (sin β - β) / (2 β² cos²(β/2) sin β);
        directions change across themselves, so that they stay unit vectors.
        """
        total, length = self.upper + self.lower, self.length[..., None, None]
        straight = self._share()[..., None, None] * np.eye(3)
        bend = self._bend()[..., None, None]
        upper, lower = (straight + bend * outer(total, end) for end in (self.lower, self.upper))
        return length * upper, length * lower

    def _bend(self) -> Array:
        """The derivative s' of that share with respect to cos β."""
        if self.balanced:
            return np.zeros_like(self.length)
        sine, cosine = self._half()
        angle = 2 * np.arctan2(sine, cosine)
        straight = angle < _SHORT
        # s = tan(β/2)/β in powers of β, differentiated, over -sin β
        series = -(1 / 12 + angle**2 / 60 + angle**4 * 17 / 6720) / np.sinc(angle / np.pi)
        safe, cosine = np.where(straight, 1.0, angle), np.where(cosine > VERTICAL, cosine, np.nan)
        whole = 4 * sine * cosine**3 * safe**2
        return np.where(
            straight, series, (2 * sine * cosine - safe) / np.where(straight, 1.0, whole)
        )


def arcs(md: ArrayLike, direction: Array, balanced: bool = False) -> Arcs:
    """The arcs between stations at measured depths (…, n), m, with directions (…, n, 3)."""
    length = np.diff(np.asarray(md, float))
    return Arcs(direction[..., :-1, :], direction[..., 1:, :], length, balanced)


def well_path(
    md: ArrayLike,
    inclination: ArrayLike,
    azimuth: ArrayLike,
    start: ArrayLike = (0.0, 0.0, 0.0),
) -> Array:
    """Positions (…, n, 3) of survey stations by minimum curvature: north, east, true vertical depth.

    Units: m, radians. `start` (…, 3): position of the first station. North is that of the azimuths.
    Singular: at vertical the azimuth may be NaN; NaN from a station on that turns back by exactly 180°.
    Reference: Sawaryn and Thorogood, SPE 84246.
    """
    md, inc, azi = np.broadcast_arrays(md, inclination, azimuth)
    step = arcs(md, hole_direction(inc, azi)).displacement
    first = np.broadcast_to(np.asarray(start, float)[..., None, :], (*step.shape[:-2], 1, 3))
    return np.cumsum(np.concatenate([first, step], -2), -2)
