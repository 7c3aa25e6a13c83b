"""Progress of work that takes more than two seconds: a bar where stderr is a terminal, or words."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

PATIENCE = 2.0
"""Seconds before there is anything to see."""


@contextmanager
def bar(label: str) -> Iterator[Callable[[int, int], None]]:
    """A function to call with how much is done, and of how much.

    The bar also moves while that is not known.
    """
    shown: list[Any] = []
    known: dict[str, int] = {}
    if not sys.stderr.isatty():
        yield lambda done, total: None
        return

    def advance(done: int, total: int) -> None:
        known.update(completed=done, total=total)
        for each in shown:
            each.update(each.task_ids[0], **known)

    def begin() -> None:
        shown.append(_bar(label))  # before what is known is read: nothing told meanwhile is lost
        shown[0].update(shown[0].task_ids[0], **known)
        shown[0].start()

    clock = threading.Timer(PATIENCE, begin)
    clock.start()
    try:
        yield advance
    finally:
        clock.cancel()
        clock.join()
        for each in shown:
            each.stop()


def slowly(say: Callable[[str], None], every: float = PATIENCE) -> Callable[[str], None]:
    """`say`, but silent for the first seconds and between two messages."""
    last = time.monotonic()

    def say_slowly(text: str) -> None:
        nonlocal last
        if time.monotonic() - last >= every:
            last = time.monotonic()
            say(text)

    return say_slowly


def _bar(label: str) -> Any:
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import Progress

    shown = Progress(console=Console(stderr=True), transient=True)
    shown.add_task(escape(label), total=None)
    return shown
