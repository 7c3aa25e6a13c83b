"""Progress of work that takes more than two seconds: a bar where stderr is a terminal, or words."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from mwdcal.app.messages import quiet
from mwdcal.presentation.text import PATIENCE
from mwdcal.presentation.text import slowly as slowly

MOMENT = 0.1
"""Seconds after which a bar moves."""


@contextmanager
def bar(label: str) -> Iterator[Callable[[int, int], None]]:
    """A function to call with how much is done, and of how much.

    The bar also moves while that is not known.
    """
    if quiet() or not sys.stderr.isatty():
        yield lambda done, total: None
        return
    known: dict[str, Any] = {"completed": 0, "total": None}
    over = threading.Event()
    shows = threading.Thread(target=_show, args=(label, known, over))
    shows.start()
    try:
        yield lambda done, total: known.update(completed=done, total=total)
    finally:
        over.set()
        shows.join()


def _show(label: str, known: Mapping[str, Any], over: threading.Event) -> None:
    """Show what is known until it is over, unless that is soon."""
    if over.wait(PATIENCE):
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as shown:
        task = shown.add_task(escape(label), **known)
        while not over.wait(MOMENT):
            shown.update(task, **known)
        shown.update(task, **known)
