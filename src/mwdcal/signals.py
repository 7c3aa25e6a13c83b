"""Signals that ask a process to end: what handles them, and a block that they do not interrupt."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from threading import current_thread, main_thread
from typing import Any


@contextmanager
def held() -> Iterator[None]:
    """Signals to end wait until the block is over, as what it begins must not be left half begun."""
    waiting: list[int] = []
    handlers = replaced(lambda number, frame: waiting.append(number), callable)
    try:
        yield
    finally:
        for each, handler in handlers.items():
            signal.signal(each, handler)
        if waiting:
            signal.raise_signal(waiting[0])


def replaced(
    new: Callable[[int, object], None], replaceable: Callable[[Any], bool]
) -> Mapping[signal.Signals, Any]:
    """What handled the signals that ask a process to end, before `new` did; none outside the main thread."""
    if current_thread() is not main_thread():
        return {}
    names = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")  # the last is Ctrl-Break of Windows
    handlers = {s: signal.getsignal(s) for s in signal.Signals if s.name in names}
    before = {each: handler for each, handler in handlers.items() if replaceable(handler)}
    for each in before:
        signal.signal(each, new)
    return before
