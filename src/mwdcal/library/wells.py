"""In the well and after: references, surveys, other notations and forms of a calibration."""

from __future__ import annotations

from typing import Any


def reference(*arguments: Any, **choices: Any) -> Any:
    """To be written."""
    raise NotImplementedError


def survey(*arguments: Any, **choices: Any) -> Any:
    """To be written."""
    raise NotImplementedError


def convert(*arguments: Any, **choices: Any) -> Any:
    """To be written."""
    raise NotImplementedError


def export(*arguments: Any, **choices: Any) -> Any:
    """To be written."""
    raise NotImplementedError
