"""Constants of a run, and drifts within it, as a calibration file states them."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

SHOWN_DRIFT = 3.0
"""A drift is a finding if it is so many times its standard uncertainty; smaller ones are in the uncertainty too."""

LEAST_ADDED = 5e-5
"""Smallest effect of a drift on an angle that is named, degrees…"""
ADDED_SHARE = 0.05
"""…and as a share of its effect on the angle that it moves most."""

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


def blindness(unseen: Sequence[UnseenDrift] | msgspec.UnsetType) -> str:
    """A sentence on what small drifts would do that no residual would show; blank if there are none.

    >>> blindness([UnseenDrift(name="field", change=10.0, unit="nT", inclination_deg=0.0, azimuth_deg=0.0213)])
    'an unseen drift from the first station to the last, 1σ, would add: 10 nT of the field 0.0213° to azimuth'
    """
    each = [] if isinstance(unseen, msgspec.UnsetType) else map(_added, unseen)
    words = "an unseen drift from the first station to the last, 1σ, would add"
    added = "; ".join(filter(None, each))
    return f"{words}: {added}" if added else ""


def _added(unseen: UnseenDrift) -> str:
    """The contribution of one drift to the angles that it moves."""
    angles = ("inclination", "toolface", "azimuth")
    sizes = {name: getattr(unseen, f"{name}_deg") or 0.0 for name in angles}
    least = max(LEAST_ADDED, ADDED_SHARE * max(sizes.values()))
    words = ", ".join(f"{size:.4f}° to {name}" for name, size in sizes.items() if size >= least)
    return f"{unseen.change:g} {unseen.unit} of the {unseen.name} {words}" if words else ""
