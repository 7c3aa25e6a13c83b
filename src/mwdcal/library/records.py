"""Records: many tools at once, certificates, signatures, and the registry of tools."""

from __future__ import annotations

from typing import Any

from mwdcal.library.papers import certificate as certificate
from mwdcal.library.papers import check_signature as check_signature
from mwdcal.library.papers import sign as sign
from mwdcal.library.registries import registry as registry


def fleet(*arguments: Any, **choices: Any) -> Any:
    """To be written."""
    raise NotImplementedError
