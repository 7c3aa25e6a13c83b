"""The orderly end of a command that is interrupted or told to terminate."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Timer, main_thread

from mwdcal.signals import held as held
from mwdcal.signals import replaced

SIGNAL = 128
"""Exit status of a command ended by a signal, less the number of the signal."""
CLEANUP_SECONDS = 5.0
"""Seconds of cleaning up after which another signal ends the command at once."""


AGAIN = 0.05
"""Seconds after which an end is raised again where it was raised in a place that cannot fail."""


class Ended(KeyboardInterrupt):
    """The command is asked to end, by Ctrl-C or otherwise; the argument is the signal's number."""


@contextmanager
def orderly_end() -> Iterator[None]:
    """Raise `Ended` at the first signal to end; later ones do not interrupt the cleaning up."""
    received: list[tuple[int, float]] = []

    def end(number: int, frame: object) -> None:
        if not received:
            received.append((number, time.monotonic()))
            raise Ended(number)
        if time.monotonic() - received[0][1] > CLEANUP_SECONDS:
            os._exit(SIGNAL + number)

    defaults = (signal.SIG_DFL, signal.default_int_handler)
    handlers = replaced(end, lambda handler: handler in defaults)
    try:
        with _raised_again(received):
            yield
    except Exception as error:  # of a module that was interrupted while it was loaded
        if not received:
            raise
        raise _cause(error) or Ended(received[0][0]) from None
    finally:
        for each, handler in handlers.items():
            signal.signal(each, signal.SIG_IGN if received else handler)  # only the exit is left


@contextmanager
def _raised_again(received: list[tuple[int, float]]) -> Iterator[None]:
    """Where Python has to swallow what it is asked to raise, such as in a destructor, raise it soon after."""
    before = sys.unraisablehook

    def hook(lost: sys.UnraisableHookArgs) -> None:
        if not isinstance(lost.exc_value, Ended):
            before(lost)
            return
        received.clear()
        Timer(AGAIN, _signal_main_thread, lost.exc_value.args).start()

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = before


def _signal_main_thread(number: int) -> None:
    """A signal that also ends a wait of the main thread, where the system can send it there."""
    if sys.platform == "win32":
        signal.raise_signal(number)
    else:
        signal.pthread_kill(main_thread().ident or 0, number)


def _cause(error: BaseException | None) -> Ended | None:
    """The end that an error was raised for."""
    while error is not None and not isinstance(error, Ended):
        error = error.__cause__ or error.__context__
    return error


def report(stop: BaseException) -> tuple[str, int]:
    """The words on what an interruption leaves, and the exit status."""
    left = getattr(stop, "__notes__", ["Files are as they were before."])
    number = stop.args[0] if isinstance(stop, Ended) else signal.SIGINT
    word = "interrupted" if number == signal.SIGINT else "terminated"
    return f"{word}. {' '.join(left)}", SIGNAL + int(number)
