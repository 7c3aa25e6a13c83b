"""Records: many tools at once, certificates, signatures, and the registry of tools."""

from __future__ import annotations

from typing import Any


def fleet(*arguments: Any, **choices: Any) -> Any:
    """To be written."""
    raise NotImplementedError


def certificate(*arguments: Any, **choices: Any) -> Any:
    """To be written."""
    raise NotImplementedError


def sign(*arguments: Any, **choices: Any) -> Any:
    """To be written."""
    raise NotImplementedError


def check_signature(*arguments: Any, **choices: Any) -> Any:
    """To be written."""
    raise NotImplementedError


def registry(*arguments: Any, **choices: Any) -> Any:
    """To be written."""
    raise NotImplementedError
