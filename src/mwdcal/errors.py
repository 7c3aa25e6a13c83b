"""Exceptions of the package: one base, one subclass per kind of reader.

Every message names what is wrong, where, the value met, and what to do about it.
"""

from __future__ import annotations


class MwdcalError(Exception):
    """Base of all errors that a user of mwdcal can do something about."""

    exit_code = 2


class InputError(MwdcalError):
    """A file, a profile or an option cannot be read or understood (exit code 2)."""


class FitError(MwdcalError):
    """The input is understood but not calibratable or not trustworthy (exit code 3)."""

    exit_code = 3


def reason(error: Exception) -> str:
    """The error of the operating system, without its error number and the path."""
    text: str = getattr(error, "strerror", None) or str(error)
    return text.partition("[errno ")[2].partition("] ")[2] or text
