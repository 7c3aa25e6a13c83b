"""Who acts, where nobody says it."""

from __future__ import annotations

from contextlib import suppress
from getpass import getuser


def system_user() -> str:
    """The name under which the user is known to the system; empty where there is none."""
    with suppress(KeyError, OSError, ImportError):
        return getuser()
    return ""
