"""What a calibration leaves to the software, and what it chooses: prior, order, own-axis terms."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from mwdcal.calibration.automatic.ageing import aged
from mwdcal.calibration.automatic.nonlinearity import (
    CurveScore,
    choose_curves,
    offered,
    scattered,
    with_strengths,
)
from mwdcal.calibration.automatic.order_selection import Progress, choose_order, order_errors
from mwdcal.calibration.diagnosis.refusals import check_curves, check_readings
from mwdcal.calibration.methods import check_stand_errors
from mwdcal.calibration.options import AUTO, Options
from mwdcal.calibration.prior import DATASHEET, for_run, from_datasheet, profile_for
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration, OrderScore
from mwdcal.errors import InputError
from mwdcal.sensor.profile import Profile


@dataclass(frozen=True)
class Choice:
    """What a run is calibrated with, and the tables that decided what was left to the data.

    `readings` are without the stations left out on request, whose labels are `excluded`; `options`
    say `auto` nowhere. `orders` are empty where no temperature can be left out, `curves` where no
    own-axis terms were tried.
    """

    readings: Readings
    profile: Profile
    options: Options
    orders: list[OrderScore] = field(default_factory=list)
    curves: list[CurveScore] = field(default_factory=list)
    excluded: list[str] = field(default_factory=list)


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def choose(readings: Readings, profile: Profile, options: Options, progress: Progress) -> Choice:
    """The options of one run; what they leave to the software is decided by the run.

    Raises `FitError` or `InputError` for readings and options that no fit could use.
    """
    check_stand_errors(options.estimate, options.method)
    excluded = [label for label in readings.labels if label in options.exclude]
    readings = without(readings, options.exclude)
    options, orders, curves = resolved(options, readings, profile, progress)
    orders = orders or order_errors(readings, options, progress)
    return Choice(readings, profile, options, orders, curves, excluded)


def tables_of(readings: Readings, given: Options, chosen: Options) -> list[OrderScore]:
    """The table of orders of one run, for which others have chosen the options."""
    orders: list[OrderScore] = []
    if given.order == AUTO:
        orders = choose_order(readings, replace(chosen, order=AUTO, nonlinearity={}), _silent)[1]
    return orders or order_errors(readings, chosen, _silent)


def _silent(text: str) -> None:
    """Nobody waits for a word on the way."""


def resolved(
    options: Options, readings: Readings, profile: Profile, progress: Progress
) -> tuple[Options, list[OrderScore], list[CurveScore]]:
    """The options without `auto`, and the tables of what was chosen among."""
    options = with_prior(options, readings, profile)
    check_readings(readings, options)
    orders: list[OrderScore] = []
    if options.order == AUTO:
        order, orders = choose_order(readings, replace(options, nonlinearity={}), progress)
        options = replace(options, order=order)
        check_readings(readings, options)
    options, curves = _with_curves(options, readings, profile, progress)
    return options, orders, curves


def with_prior(options: Options, readings: Readings, profile: Profile) -> Options:
    """The options with what is known of one or many tools beforehand, as their prior.

    A previous calibration brings its model and order along; own-axis terms asked for by name get
    their prior.
    """
    options = with_strengths(options, profile)
    profile_for(options.prior, profile)
    if options.prior == DATASHEET:
        return replace(options, prior=from_datasheet(profile, readings.relative))
    if not isinstance(options.prior, Calibration):
        return options
    previous = options.prior
    parameters = previous.options.parameters
    if options.parameters not in (12, parameters):
        raise InputError(
            f"`prior`: the calibration of {previous.run_name} has {parameters} parameters per triad, not "
            f"{options.parameters}. Leave `parameters` out, or calibrate without `prior`."
        )
    kinds = {triad.model for triad in previous.triads}
    order = (previous.triads[0].order, previous.triads[-1].order)
    return replace(
        options,
        model=options.model or (kinds.pop() if len(kinds) == 1 else None),
        order=order if options.order == AUTO else options.order,
        parameters=parameters,
        prior=aged(for_run(previous, readings), previous, readings, profile),
    )


def _with_curves(
    options: Options, readings: Readings, profile: Profile, progress: Progress
) -> tuple[Options, list[CurveScore]]:
    """The options with own-axis terms as asked for, or with those that the run shows."""
    options, terms = scattered(readings, options), offered(profile, options)
    if not terms:
        check_curves(readings, tuple(options.curved))
        return replace(options, nonlinearity=options.curved), []
    progress("own-axis nonlinearity: comparing fits with and without it")
    chosen, curves = choose_curves(readings, replace(options, nonlinearity={}), terms)
    return replace(options, nonlinearity=chosen), curves


def without(readings: Readings, exclude: tuple[str, ...]) -> Readings:
    """The readings less the stations of these labels."""
    if not exclude:
        return readings
    labels = readings.labels
    twice = [label for label in exclude if labels.count(label) > 1]
    if twice:
        raise InputError(
            f"`exclude` {twice[0]}: {labels.count(twice[0])} stations of {readings.source} "
            "have this label. Give each its own in the column 'station'."
        )
    missing = [label for label in exclude if label not in labels]
    if missing:
        raise InputError(
            f"`exclude` {missing[0]}: no such station in {readings.source}; "
            f"stations are {labels[0]} … {labels[-1]}."
        )
    return readings.select(np.array([label not in exclude for label in labels]))
