"""Progress in words, now and then."""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE = 2.0
"""Seconds before there is anything to see."""


def slowly(say: Callable[[str], None], every: float = PATIENCE) -> Callable[[str], None]:
    """`say`, but silent for the first seconds and between two messages."""
    last = time.monotonic()

    def say_slowly(text: str) -> None:
        nonlocal last
        if time.monotonic() - last >= every:
            last = time.monotonic()
            say(text)

    return say_slowly
