"""Constants of a run, and drifts within it, as a calibration file states them."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

SHOWN_DRIFT = 3.0
"""A drift is a finding if it is so many times its standard uncertainty; smaller ones are in the uncertainty too."""

STEADINESS = {
    "accelerometer-drift": "steady accelerometer offsets",
    "magnetometer-drift": "steady magnetometer offsets",
    "field-drift": "steady field",
}
"""Assumption of a calibration whose run could not show a drift, by the name of the drift."""


def exact_and_steady(assumed: Sequence[str]) -> tuple[list[str], str]:
    """The references among things assumed exact, and a sentence on the steadiness; blank if none is assumed.

    >>> exact_and_steady(["gravity reference", "steady field"])[1].partition(". ")[0]
    'taken as steady during the run, whose order of stations would hide a drift: field'
    """
    exact = [name for name in assumed if name not in STEADINESS.values()]
    steady = ", ".join(n.removeprefix("steady ") for n in assumed if n not in exact)
    words = "taken as steady during the run, whose order of stations would hide a drift"
    remedy = "Measure there and back, or declare the drift in the tool profile"
    return exact, f"{words}: {steady}. {remedy}" if steady else ""


class Constant(msgspec.Struct, frozen=True, kw_only=True):
    """A constant of the run that was estimated, with its standard uncertainty."""

    name: str
    value: float
    standard_uncertainty: float
    unit: str


class Drift(msgspec.Struct, frozen=True, kw_only=True):
    """A drift within the run that is part of the fit: the largest change between two stations, 1σ, and unit.

    `name`: "field", or the triad whose offsets drifted. `declared`: 1σ per axis of the change from the first station
    to the last, as declared; absent where the drift is not declared, but seen in the residuals.
    """

    name: str
    change: float
    standard_uncertainty: float
    unit: str
    declared: float | msgspec.UnsetType = msgspec.UNSET


class UnseenDrift(msgspec.Struct, frozen=True, kw_only=True):
    """A drift that no residual would show, and what it would add to the accuracy to expect: 1σ at 45° inclination.

    `change`: 1σ per axis from the first station to the last, an example.
    """

    name: str
    change: float
    unit: str
    inclination_deg: float | None = None
    toolface_deg: float | None = None
    azimuth_deg: float | None = None


def declared_drift(drifts: Sequence[Drift]) -> str:
    """A sentence on the drifts that are declared; blank if there are none.

    >>> declared_drift([Drift(name="field", change=31.0, standard_uncertainty=9.0, unit="nT", declared=40.0)])
    'declared drift from the first station to the last, 1σ, which the uncertainty includes: field 40 nT'
    """
    sizes = [
        f"{each.name} {each.declared:.3g} {each.unit}"
        for each in drifts
        if not isinstance(each.declared, msgspec.UnsetType)
    ]
    words = "declared drift from the first station to the last, 1σ, which the uncertainty includes"
    return f"{words}: {', '.join(sizes)}" if sizes else ""


def blindness(unseen: Sequence[UnseenDrift] | msgspec.UnsetType) -> list[str]:
    """A sentence on each drift that no residual would show: what a small one would do.

    >>> blindness([UnseenDrift(name="field", change=10.0, unit="nT", inclination_deg=0.0, azimuth_deg=0.0213)])
    ['field: an unseen drift of 10 nT would add 0.0213° to azimuth (1σ), and no uncertainty here includes it']
    """
    sentences = []
    for each in [] if isinstance(unseen, msgspec.UnsetType) else unseen:
        added = [(n, getattr(each, f"{n}_deg")) for n in ("inclination", "toolface", "azimuth")]
        words = ", ".join(f"{size:.4f}° to {name}" for name, size in added if size)
        what = f"an unseen drift of {each.change:g} {each.unit}"
        if words:
            rest = "(1σ), and no uncertainty here includes it"
            sentences.append(f"{each.name}: {what} would add {words} {rest}")
    return sentences
