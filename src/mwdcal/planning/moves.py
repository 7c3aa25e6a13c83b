"""How long a session at the stand takes, and the order of stations that makes it short."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from mwdcal.errors import InputError
from mwdcal.estimation.evidence import ANGLES
from mwdcal.geometry.vectors import Array, Bools, Ints

MOST_ORDERED = 2_000
"""Stations of one soak that are put in order; a longer plan keeps its own."""
AT_ENDS_WITHIN = 1e-6
"""A setting so little beyond what the stand reaches is within it, degrees."""


@dataclass(frozen=True)
class Stand:
    """How fast a stand is: its axes move at the same time.

    `degrees_per_second` of an axis, `settle_seconds` between the end of a move and the reading,
    `soak_minutes` until the tool has the temperature of the next soak. `reach`: the least and the largest
    setting by angle, degrees; azimuth and toolface without one turn round and round.
    """

    degrees_per_second: float = 5.0
    settle_seconds: float = 30.0
    soak_minutes: float = 90.0
    reach: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse a stand that does not move or reaches nothing, and times below zero.

        Raises `InputError`.
        """
        if not 0 < self.degrees_per_second < np.inf:
            raise InputError(
                f"`speed` must be more than 0 degrees per second; got {self.degrees_per_second:g}."
            )
        for name, value in (("settle", self.settle_seconds), ("soak", self.soak_minutes)):
            if not 0 <= value < np.inf:
                raise InputError(f"`{name}` must be a time of 0 or more; got {value:g}.")
        for name, (low, high) in self.reach.items():
            least, most = (0, 180) if name == ANGLES[0] else (-360, 360)
            if name not in ANGLES or not (least <= low <= high <= most and high - low <= 360):
                raise InputError(
                    f"`reach` must be of {', '.join(ANGLES)}, such as inclination=0:120, from the least setting to "
                    f"the largest; got {name}={low:g}:{high:g}."
                )

    def settings(self, attitude: Array) -> Array:
        """Settings (n, 3) of attitudes (n, 3), degrees: whole turns added to be above the least."""
        settings = attitude.copy()
        for place, name in enumerate(ANGLES):
            if name in self.reach and place:
                low = self.reach[name][0] - AT_ENDS_WITHIN
                settings[:, place] = low + (attitude[:, place] - low) % 360
        return settings

    def within(self, attitude: Array) -> Bools:
        """Which angles (n, 3) of attitudes (n, 3), degrees, the stand reaches."""
        low, high = np.transpose([self.reach.get(name, (-np.inf, np.inf)) for name in ANGLES])
        settings = self.settings(attitude)
        return np.asarray((settings >= low - AT_ENDS_WITHIN) & (settings <= high + AT_ENDS_WITHIN))


USUAL_STAND = Stand()
"""A stand of usual speed."""


def move_seconds(attitude: Array, stand: Stand) -> Array:
    """Seconds (n, n) from each station to each other, of attitudes (n, 3) in degrees.

    Azimuth and toolface go the shorter way round, but for one whose reach has ends.
    """
    settings = stand.settings(attitude)
    difference = np.abs(settings[:, None] - settings)
    round_and_round = [name != ANGLES[0] and name not in stand.reach for name in ANGLES]
    shorter = np.minimum(difference % 360, -difference % 360)
    difference = np.where(round_and_round, shorter, difference)
    return np.asarray(difference.max(-1) / stand.degrees_per_second + stand.settle_seconds)


def session_seconds(attitude: Array, soak: Ints, stand: Stand) -> float:
    """Duration of a session, from its first soak to its last reading, of stations in order.

    `soak` (n,) numbers the temperatures; each change of it is a soak, and so is the first.
    """
    seconds = move_seconds(attitude, stand)
    moves = float(seconds[np.arange(len(soak) - 1), np.arange(1, len(soak))].sum())
    soaks = 1 + int(np.count_nonzero(np.diff(soak)))
    return stand.settle_seconds + moves + 60.0 * stand.soak_minutes * soaks


def measuring_order(attitude: Array, soak: Ints, stand: Stand) -> Ints:
    """An order (n,) of the stations of each soak with short moves that go there and back; the soaks keep theirs.

    Method: a short path by the nearest station next and 2-opt, of which every other station is measured on
    the way out and the rest on the way back. Neighbours on the path then lie alike before and after the
    middle of the session, so that a slow drift does not keep step with the attitude.
    """
    order: list[int] = []
    for each in dict.fromkeys(soak.tolist()):
        some = np.flatnonzero(soak == each)
        if len(some) > MOST_ORDERED:
            return np.arange(len(soak))
        path = some[_tour(move_seconds(attitude[some], stand))]
        order += [*path[::2].tolist(), *path[1::2][::-1].tolist()]
    return np.array(order)


def _tour(seconds: Array) -> Ints:
    """A short path through all stations, from the first on."""
    left, path = set(range(1, len(seconds))), [0]
    while left:
        path.append(min(left, key=lambda other: (seconds[path[-1], other], other)))
        left.remove(path[-1])
    tour = np.array(path)
    while _turned(tour, seconds):
        pass
    return tour


def _turned(tour: Ints, seconds: Array) -> bool:
    """Turn round, in place, each stretch whose turning shortens the path; whether one was."""
    improved = False
    for first in range(1, len(tour) - 1):
        before, start, ends = tour[first - 1], tour[first], tour[first + 1 :]
        after = np.append(tour[first + 2 :], -1)
        gain = seconds[before, start] - seconds[before, ends]
        leave = np.where(after >= 0, seconds[ends, after] - seconds[start, after], 0.0)
        best = int(np.argmax(gain + leave))
        if gain[best] + leave[best] > 1e-9:
            last = first + 1 + best
            tour[first : last + 1] = tour[first : last + 1][::-1]
            improved = True
    return improved
