"""A simulated tool on a simulated stand, which goes where the page tells it. For demonstration and tests."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from threading import Event

import numpy as np

from mwdcal.files.contract import RAW
from mwdcal.geometry.vectors import Array
from mwdcal.planning.simulate import StationPlan, Truth, drawn, reading
from mwdcal.sensor.profile import Profile

RATE = 10.0
"""Samples a second."""
BLOCK = 5
"""Samples that are made at once."""
TURN = 6.0
"""Seconds of a move of the stand."""
KNOCK_DEG = 1.5
"""How far the tool stands off where it was knocked."""
TEMPERATURE = 25.0
Attitude = tuple[float, float, float]
"""Inclination, azimuth and toolface, degrees."""


class DemoStand:
    """The source of `--source demo`. `order` says where the tool is to be now, and the number of the attempt.

    `knocked` are attempts, counted from 0, at which the tool does not quite stand where the stand says.
    """

    def __init__(
        self, profile: Profile, order: Callable[[], tuple[Attitude | None, int]],
        speed: float = 1.0, seed: int = 1, knocked: Sequence[int] = (7, 15),
    ) -> None:  # fmt: skip
        self.note, self.drops = "", 0
        self.profile, self.order, self.speed, self.knocked = profile, order, speed, {*knocked}
        self.rng = np.random.default_rng(seed)
        self.tool: Truth = drawn(self.rng, profile, 0)
        self.here = np.array([10.0, 20.0, 30.0])

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
                goal, start, left = wanted, self.here, TURN
                end = self._setting(wanted[0], wanted[1])
            clock = (done + np.arange(BLOCK)) / RATE
            remaining = np.maximum(left - np.arange(1, BLOCK + 1) / RATE, 0.0)
            share = 0.5 + 0.5 * np.cos(np.pi * remaining / TURN)
            attitude = start + share[:, None] * (end - start)
            left, self.here = float(remaining[-1]), attitude[-1]
            for seconds, row in zip(clock, self._read(attitude), strict=True):
                yield (
                    float(seconds),
                    ",".join([f"{seconds:.1f}", *(f"{v:.7g}" for v in row), f"{TEMPERATURE}"]),
                )
            done += BLOCK
            ahead = done / RATE / self.speed - (time.monotonic() - began)
            if ahead > 0.002:
                stop.wait(ahead)

    def _setting(self, attitude: Attitude, attempt: int) -> Array:
        """Where the tool really stands after a move: the stand has its errors."""
        stand = self.profile.stand
        sd = np.array([stand.inclination_deg, stand.azimuth_deg, stand.toolface_deg])
        off = sd * self.rng.normal(size=3)
        if attempt in self.knocked:
            off = off + KNOCK_DEG
        return np.asarray(attitude) + off

    def _read(self, attitude_deg: Array) -> Array:
        """Raw channels (n, k) with noise at attitudes (n, 3)."""
        angles = np.radians(attitude_deg).T
        plan = StationPlan(*angles, np.full(len(attitude_deg), TEMPERATURE))
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
