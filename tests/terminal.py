"""The command line at a pseudo-terminal, with what somebody types there."""

from __future__ import annotations

import os
import pty
import select
import sys
import time
from collections.abc import Sequence

PROMPT = "> "
LONGEST_SECONDS_AT_TERMINAL = 60.0


def at_terminal(arguments: Sequence[str], typed: Sequence[str]) -> tuple[int, str]:
    """Exit status and screen of a command; each line of `typed` answers a prompt."""
    child, descriptor = pty.fork()
    if child == 0:
        program = "from mwdcal.app.cli import main; main()"
        os.execv(sys.executable, [sys.executable, "-c", program, *arguments])
    waiting, screen, answered = list(typed), "", 0
    until = time.monotonic() + LONGEST_SECONDS_AT_TERMINAL
    while time.monotonic() < until:
        if select.select([descriptor], [], [], 0.2)[0]:
            try:
                part = os.read(descriptor, 65_536)
            except OSError:
                break
            if not part:
                break
            screen += part.decode("utf-8", "replace")
        elif waiting and screen[answered:].rstrip(" ").endswith(("]:", ">", "]")):
            answered = len(screen)
            os.write(descriptor, f"{waiting.pop(0)}\n".encode())
    _, status = os.waitpid(child, 0)
    os.close(descriptor)
    return os.waitstatus_to_exitcode(status), screen
