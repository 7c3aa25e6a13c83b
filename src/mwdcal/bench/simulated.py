"""A simulated tool on a simulated stand, which goes where the page tells it. For demonstration and tests."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from threading import Event

import numpy as np

from mwdcal.bench.attitude import Attitude
from mwdcal.files.contract import RAW
from mwdcal.geometry.vectors import Array
from mwdcal.planning.plans import StationPlan, Truth, drawn, reading
from mwdcal.sensor.profile import Profile

SAMPLE_HZ = 10.0
"""Samples a second."""
SAMPLES_AT_ONCE = 5
"""Samples that are made at once."""
TURN_SECONDS = 6.0
"""Seconds of a move of the stand."""
KNOCKED_DEG = 1.5
"""How far a knocked tool stands off."""
ROOM_C = 25.0
"""Temperature of the simulated tool, °C."""


class DemoStand:
    """The source of simulated readings: a tool, and a stand that goes where `order` says.

    `order` gives an attitude and the number of the attempt. `knocked` are attempts, counted from 0, at which somebody
    knocks the tool off the angles that the stand shows.
    """

    def __init__(
        self, profile: Profile, speed: float = 1.0, seed: int = 1, knocked: Sequence[int] = (7, 15)
    ) -> None:
        self.note, self.drops = "", 0
        self.order: Callable[[], tuple[Attitude | None, int]] = lambda: (None, -1)
        self.profile, self.speed, self.seed, self.knocked = profile, speed, seed, {*knocked}
        self.rng = np.random.default_rng(seed)
        self.tool: Truth = drawn(self.rng, profile, 0)
        self.here, self._off = np.array([10.0, 20.0, 30.0]), np.zeros(3)
        self._direction: tuple[float, ...] = ()

    @property
    def header(self) -> str:
        """The line of names that comes first."""
        return ",".join(("time_s", *self.channels, "temperature_c"))

    @property
    def channels(self) -> tuple[str, ...]:
        """Raw channels of the tool."""
        return RAW if self.profile.has_magnetometer else RAW[:3]

    def lines(self, stop: Event) -> Iterator[tuple[float, str]]:
        """Lines at the pace of the clock, `speed` times as fast."""
        yield 0.0, self.header
        began, done = time.monotonic(), 0
        goal: tuple[object, int] = (None, -1)
        start = end = self.here
        left = 0.0
        while not stop.is_set():
            wanted = self.order()
            if wanted[0] is not None and wanted != goal:
                goal, start, left = wanted, self.here, TURN_SECONDS
                end = self._setting(wanted[0], wanted[1])
            clock = (done + np.arange(SAMPLES_AT_ONCE)) / SAMPLE_HZ
            remaining = np.maximum(left - np.arange(1, SAMPLES_AT_ONCE + 1) / SAMPLE_HZ, 0.0)
            share = 0.5 + 0.5 * np.cos(np.pi * remaining / TURN_SECONDS)
            attitude = start + share[:, None] * (end - start)
            left, self.here = float(remaining[-1]), attitude[-1]
            for seconds, row in zip(clock, self._read(attitude), strict=True):
                yield (
                    float(seconds),
                    ",".join([f"{seconds:.1f}", *(f"{v:.7g}" for v in row), f"{ROOM_C}"]),
                )
            done += SAMPLES_AT_ONCE
            ahead = done / SAMPLE_HZ / self.speed - (time.monotonic() - began)
            if ahead > 0.002:
                stop.wait(ahead)

    def _setting(self, attitude: Attitude, attempt: int) -> Array:
        """Where the tool really stands after a move: the stand has its errors.

        Those of inclination and azimuth stay in a roll, unless the profile says that the stand is set at each station.
        They follow from the attempt alone, however long the tool has stood.
        """
        stand = self.profile.stand
        sd = np.array([stand.inclination_deg, stand.azimuth_deg, stand.toolface_deg])
        off = sd * np.random.default_rng((self.seed, attempt)).normal(size=3)
        if attitude[:2] == self._direction and stand.settings != "per-station":
            off[:2] = self._off[:2]
        self._direction, self._off = attitude[:2], off
        if attempt in self.knocked:
            off = off + KNOCKED_DEG
        return np.asarray(attitude) + off

    def _read(self, attitude_deg: Array) -> Array:
        """Raw channels (n, k) with noise at attitudes (n, 3)."""
        inclination, azimuth, toolface = np.radians(attitude_deg).T
        plan = StationPlan(inclination, azimuth, toolface, np.full(len(attitude_deg), ROOM_C))
        columns = []
        for vectors, name in zip(
            reading(self.tool, plan), ("accelerometer", "magnetometer"), strict=False
        ):
            triad = getattr(self.profile, name)
            raw = vectors @ triad.permutation * (triad.scale or 1.0)
            columns.append(raw + (triad.noise or 0.0) * self.rng.normal(size=raw.shape))
        return np.concatenate(columns, -1)

    @property
    def earth(self) -> Mapping[str, float]:
        """References of the simulated place: g, nT, degrees."""
        tool = self.tool
        return {
            "gravity_g": tool.gravity,
            "field_nt": tool.field,
            "dip_deg": float(np.degrees(tool.dip)),
        }
