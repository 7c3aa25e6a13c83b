"""Pages without their pictures, in this process or in one that a test starts."""

from __future__ import annotations

from collections.abc import Callable
from inspect import isfunction
from typing import Any


def leave_out(set_attribute: Callable[[Any, str, Any], None]) -> None:
    """Make the figures of pages empty and those of certificates none, by a function like `setattr`."""
    from markupsafe import Markup

    from mwdcal.presentation import certificate, page
    from mwdcal.use.plots import Plots

    for name, method in [*vars(Plots).items()]:
        if isfunction(method) and not name.startswith("_"):
            set_attribute(Plots, name, lambda *given: "")
    set_attribute(certificate, "certificate_pictures", lambda *given: [])
    set_attribute(page, "picture", lambda figure, suffix: b"<svg></svg>")
    set_attribute(page, "svg", lambda figure, key: Markup("<svg></svg>"))
