"""The options of a fit as words, as a command line has them: it loads this without NumPy."""

from __future__ import annotations

from typing import TypedDict


class Typed(TypedDict):
    """The options of `mwdcal calibrate` that say how to fit, as they come from the command line."""

    method: str
    model: str | None
    order: str
    parameters: str | None
    nonlinearity: str
    estimate: str
    ignore: str
    robust: str | None
    paper_weights: bool
    prior: str | None
    seed: int


def names(text: str) -> tuple[str, ...]:
    """The words of a list with commas."""
    return tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
