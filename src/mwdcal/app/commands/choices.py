"""From what was typed at `calibrate` to the options of a fit: prior, order and own-axis terms."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypedDict

import numpy as np
from msgspec.structs import replace as replace_struct

from mwdcal.calibration.automatic.nonlinearity import (
    USUAL,
    CurveScore,
    declared,
    with_chosen_curves,
)
from mwdcal.calibration.automatic.order_selection import choose_order, order_errors
from mwdcal.calibration.automatic.stand import check_names
from mwdcal.calibration.diagnosis.refusals import (
    check_curve_names,
    check_curves,
    check_order,
    check_readings,
)
from mwdcal.calibration.options import Options
from mwdcal.calibration.prior import Knowledge, from_calibration, from_datasheet
from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.calibration.record import Calibration, OrderScore
from mwdcal.errors import InputError
from mwdcal.files import documents
from mwdcal.sensor.profile import Profile

DATASHEET = "datasheet"


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


@dataclass(frozen=True)
class Chosen:
    """Options of the fit, and the tables that decided what was left to the data."""

    options: Options
    orders: list[OrderScore]
    curves: list[CurveScore]


def choose(
    readings: Readings, profile: Profile, typed: Typed, say: Callable[[str], None]
) -> Chosen:
    """Options as typed; what was left to the data is decided by the data."""
    options, order = stated(typed), typed["order"]
    if typed["prior"]:
        options, order = _with_prior(options, order, typed, readings, profile)
    options, orders = _with_order(options, order, readings, say)
    options, curves = _with_curves(options, typed["nonlinearity"], readings, profile, say)
    if not orders:
        check_readings(readings, options)
        orders = order_errors(readings, options, say)
    return Chosen(options, orders, curves)


def stated(typed: Typed) -> Options:
    """The options as typed, at order 0 and without own-axis terms."""
    check_order(typed["order"])
    options = Options(
        method=typed["method"],
        model=typed["model"],
        parameters=int(typed["parameters"] or 12),
        nonlinearity={},
        estimate=tuple(names(typed["estimate"])),
        ignore=tuple(names(typed["ignore"])),
        robust=typed["robust"],
        paper_weights=typed["paper_weights"],
        seed=typed["seed"],
    )
    check_names(options.estimate, options.method)
    return options


def names(text: str) -> list[str]:
    """The words of a list with commas."""
    return list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))


def prior_profile(prior: str | None, profile: Profile) -> Profile:
    """The profile with what a prior needs of it: a previous calibration's scale where it has none.

    Knowledge is of readings in nominal units: guessed from the run, these would be others.
    """
    if not prior:
        return profile
    if prior == DATASHEET:
        sheets = [t for t in TRIADS if getattr(profile, t).datasheet is not None]
        if not sheets:
            raise InputError(
                f"--prior datasheet: the tool profile '{profile.name}' has none. Add a section "
                "[accelerometer.datasheet] with scale, bias and misalignment_deg (1 sigma)."
            )
        bare = [t for t in sheets if getattr(profile, t).scale is None]
        if bare:
            raise InputError(
                f"--prior datasheet: the tool profile '{profile.name}' has no 'scale' in [{bare[0]}], "
                "which the tolerances are a share of. Add it."
            )
        return profile
    previous = documents.read(Path(prior)).profile
    found = {}
    for name in TRIADS:
        ours, theirs = getattr(profile, name), getattr(previous, name)
        known = replace_struct(ours, scale=theirs.scale if ours.scale is None else ours.scale)
        found[name] = known
        if theirs.scale is not None and (known.axes, known.scale) != (theirs.axes, theirs.scale):
            raise InputError(
                f"--prior {prior} was made with {name} axes {list(theirs.axes)} and scale "
                f"{theirs.scale:g}; the tool profile '{profile.name}' has {list(known.axes)} and "
                f"{known.scale:g}. Use the tool profile that the previous calibration had."
            )
    return replace_struct(profile, **found)


def _with_prior(
    options: Options, order: str, typed: Typed, readings: Readings, profile: Profile
) -> tuple[Options, str]:
    """What is known beforehand; a previous calibration brings its model and order along."""
    prior = str(typed["prior"])
    if prior == DATASHEET:
        return replace(options, prior=from_datasheet(profile, readings.relative)), order
    previous = documents.read(Path(prior))
    other = previous.other_tool(readings)
    if other:
        raise InputError(
            f"--prior {prior} is of tool {other[0]}, the run is of {other[1]}. Give the previous "
            "calibration of the same tool."
        )
    if any(previous.used(readings.digest)):
        raise InputError(
            f"--prior {prior} was made from stations of this run, which would count twice. Give a "
            "calibration from an earlier run."
        )
    if typed["parameters"] and options.parameters != previous.options.parameters:
        raise InputError(
            f"--prior {prior} has {previous.options.parameters} parameters per triad, not "
            f"{options.parameters}. Leave --parameters out, or calibrate without --prior."
        )
    kinds = {triad.model for triad in previous.triads}
    options = replace(
        options,
        model=options.model or (kinds.pop() if len(kinds) == 1 else None),
        order=(previous.triads[0].order, previous.triads[-1].order),
        parameters=previous.options.parameters,
        prior=_of(previous, readings),
    )
    return options, "prior" if order == "auto" else order


def _of(previous: Calibration, readings: Readings) -> Knowledge:
    """A previous calibration's knowledge, of the triads that this run has.

    A run without a magnetometer has no unit of the field that could differ.
    """
    alone = readings.magnetometer is None
    known = from_calibration(previous, previous.relative if alone else readings.relative)
    if readings.magnetometer is not None or not previous.has_field:
        return known
    own = [i for i, name in enumerate(known.names) if name.startswith(TRIADS[0])]
    spread = np.linalg.pinv(known.precision, hermitian=True)[np.ix_(own, own)]
    return replace(
        known,
        names=tuple(known.names[i] for i in own),
        expected=known.expected[own],
        precision=np.linalg.pinv(spread, hermitian=True),
    )


def _with_order(
    options: Options, order: str, readings: Readings, say: Callable[[str], None]
) -> tuple[Options, list[OrderScore]]:
    """The order asked for, that of the prior, or the one whose terms noise does not explain."""
    if order == "prior":
        return options, []
    if order == "auto":
        check_readings(readings, replace(options, model=options.model or "polynomial"))
        chosen, scores = choose_order(readings, options, say)
        return replace(options, order=chosen), scores
    return replace(options, order=int(order)), []


def _with_curves(
    options: Options,
    asked: str,
    readings: Readings,
    profile: Profile,
    say: Callable[[str], None],
) -> tuple[Options, list[CurveScore]]:
    """Own-axis terms: as asked, or of the triads that declare them where the run speaks for them."""
    if asked == "none":
        return options, []
    offered = declared(profile, options)
    if asked == "auto":
        if not offered or options.prior:
            return options, []
        check_readings(readings, options)
        say("own-axis nonlinearity: comparing fits with and without it")
        return with_chosen_curves(readings, options, offered)
    wanted = curves_of(asked, offered)
    check_curves(readings, tuple(wanted))
    return replace(options, nonlinearity=wanted), []


def curves_of(asked: str, offered: Mapping[str, float]) -> dict[str, float]:
    """Strength of the own-axis terms of the triads named: the profile's own, or the usual one."""
    wanted = names(asked)
    check_curve_names(asked, wanted)
    return {name: offered.get(name, USUAL) for name in wanted}
