"""Before a measurement: plans, simulated runs and procedures, profiles from tables as they come."""

from __future__ import annotations

from typing import Any


def plan(*arguments: Any, **choices: Any) -> Any:
    """To be written."""
    raise NotImplementedError


def propose_profile(*arguments: Any, **choices: Any) -> Any:
    """To be written."""
    raise NotImplementedError
