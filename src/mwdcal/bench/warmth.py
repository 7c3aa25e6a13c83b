"""The course of the tool's temperature in the oven: how fast it changes, and how long until it is steady."""

from __future__ import annotations

from math import log

import numpy as np

COURSE_SECONDS = 600.0
"""Seconds of the course that are looked at."""
SHORTEST = 30.0
"""Seconds before which a rate is not stated."""
STEADY_RATE = 0.2
"""°C a minute below which the tool is in equilibrium with the oven."""


class Warmth:
    """Temperatures of the last ten minutes, one a second."""

    def __init__(self) -> None:
        self.course: list[tuple[float, float]] = []

    def take(self, time: float, value: float) -> None:
        """A temperature in °C at a time in seconds."""
        if self.course and time < self.course[-1][0]:
            self.course = []
        if not self.course or time - self.course[-1][0] >= 1:
            self.course.append((time, value))
            while time - self.course[0][0] > COURSE_SECONDS:
                del self.course[0]

    @property
    def value(self) -> float | None:
        """The latest temperature, °C."""
        return self.course[-1][1] if self.course else None

    @property
    def rate(self) -> float | None:
        """How fast the tool warms, °C a minute; None while the course is too short."""
        return _rate(self.course[-61:])

    @property
    def is_steady(self) -> bool:
        """Whether the tool is in equilibrium; a course that is too short tells nothing, and passes."""
        return abs(self.rate or 0.0) <= STEADY_RATE

    @property
    def minutes_left(self) -> float | None:
        """Minutes until the tool is steady, as its rate decays; None where that does not show."""
        half = len(self.course) // 2
        before, now = _rate(self.course[:half]), _rate(self.course[half:])
        if before is None or now is None or not 0 < now / before < 1 or self.is_steady:
            return None
        minutes = (self.course[-1][0] - self.course[0][0]) / 60 / 2
        return minutes * log(abs(now) / STEADY_RATE) / log(before / now) - minutes / 2


def _rate(course: list[tuple[float, float]]) -> float | None:
    """The slope of a course, °C a minute."""
    if len(course) < 3 or course[-1][0] - course[0][0] < SHORTEST:
        return None
    time, value = np.array(course).T
    return float(np.polyfit((time - time[0]) / 60, value, 1)[0])
