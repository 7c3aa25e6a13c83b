"""Refusals: runs that no fit can calibrate, and fits whose result cannot be trusted.

Each check looks at a batch of runs and returns a flag; its id is the status in a fleet's table. A
single run is refused by the first flag that holds, and so is each tool of a fleet.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import permutations, product
from typing import Any

import numpy as np

from mwdcal.calibration.automatic.courses import orders_of, share_beyond
from mwdcal.calibration.diagnosis.flags import FittedRuns, Flag, listed, spaced
from mwdcal.calibration.diagnosis.plausibility import (
    excessive_errors,
    gain_shares,
    has_sensor_gains,
    inseparable,
    is_bad,
    is_covariance,
    off_earth,
    overturned,
    straying,
)
from mwdcal.calibration.diagnosis.structure import COLUMN, described
from mwdcal.calibration.estimate import Fit, fit
from mwdcal.calibration.methods import EVIDENCE
from mwdcal.calibration.options import DIRECTION, Options, settings_of
from mwdcal.calibration.readings import (
    CONSTANTS,
    EARTH_RANGES,
    HIGHEST,
    TRIADS,
    Readings,
    highest_order,
    soaks,
)
from mwdcal.calibration.residuals import nominal, shown_in
from mwdcal.calibration.results import temperature_range
from mwdcal.errors import FitError, InputError, MwdcalError
from mwdcal.estimation.batch import batch_of_one
from mwdcal.estimation.problem import WALKS
from mwdcal.estimation.solvers import LOSSES, Status
from mwdcal.estimation.uncertainty import free_directions, station_misfit
from mwdcal.geometry.circle import resultant
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import Array, Bools, length
from mwdcal.sensor.models import Basis, Factors, Polynomial, Whole, restricted
from mwdcal.sensor.profile import COMMON, Profile

# --------------------------------------------------------------------------
# Which `axes` of the tool profile would explain a run that the declared ones do not.
#
# A linear triad absorbs any exchange and reversal of its channels into its gain: raw readings that
# are fitted with their references give the gain, and the signed permutation nearest to it says how
# the channels lie.

CROSS_GAIN = 0.3
"""Largest gain across the axes, as a share of those along them, of a triad in its right axes."""
FITTING_SHARE = 0.05
"""Residuals of a run in its right axes are less than this share of the field."""
SIGNED = np.array(
    [
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
)
"""The 48 signed permutations (48, 3, 3)."""


def nearest(gain: Array) -> Array:
    """The signed permutation Q (3, 3) that a gain M (3, 3) is nearest to: trace M Qᵀ is largest.

    >>> nearest(np.array([[0.01, -1.1, 0], [0.9, 0.02, 0], [0, 0.01, 1.0]])).astype(int).tolist()
    [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    """
    return np.asarray(SIGNED[int(np.argmax(np.sum(SIGNED * gain, (-1, -2))))])


def named(permutation: Array) -> tuple[str, ...]:
    """The `axes` of a profile (tool axes from channels, (3, 3)).

    >>> named(np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]]))
    ('+y', '-x', '+z')
    """
    rows = np.argmax(np.abs(permutation), 0).tolist()
    signs = ["+" if permutation[row, channel] > 0 else "-" for channel, row in enumerate(rows)]
    return tuple(f"{sign}{'xyz'[row]}" for sign, row in zip(signs, rows, strict=True))


def explaining(readings: Readings, profile: Profile) -> dict[str, tuple[str, ...]]:
    """The `axes` with which a run fits, by triad, where they are not those of the profile."""
    try:
        result = fit(readings)
    except (MwdcalError, np.linalg.LinAlgError):
        return {}
    free = free_directions(result.problem, result.state, result.analysis.determined)[0]
    if result.status[0] != Status.OK or not _fits(result) or any(map(is_bad, free)):
        return {}
    axes, problem = {}, result.problem
    for name, triad, where in zip(TRIADS, problem.triads, problem.slices(), strict=False):
        slope = triad.model.slope(result.state.params[:, where], triad.raw, problem.temperature)
        gain = slope[0].mean(0)
        if name == "magnetometer" and np.isfinite(overturned(result)[0]):
            gain = -gain
        permutation = nearest(gain)
        if not _is_near(gain @ permutation.transpose()):
            return {}
        if not np.array_equal(permutation, np.eye(3)):
            axes[name] = named(permutation @ getattr(profile, name).permutation)
    return axes


def _is_near(gain: Array) -> bool:
    """Whether a gain is along its axes."""
    along = np.diagonal(gain)
    across = np.abs(gain - np.diag(along)).max()
    return bool(along.min() > 0 and across < CROSS_GAIN * along.min())


def _fits(result: Fit) -> bool:
    """Whether the readings are explained at all."""
    triads = result.problem.triads
    noise = np.sqrt(result.analysis.variance_factor[0]) * [triad.sd.mean() for triad in triads]
    moved = [np.linalg.norm(t.raw[0] - t.raw[0].mean(0), axis=-1).mean() for t in triads]
    return bool(np.all(noise < FITTING_SHARE * np.array(moved)))


# --------------------------------------------------------------------------
# The possible causes of a refusal: a station, wrong axes, a column that is not used, the span of temperatures.


CULPRIT_SHARE = 0.3
"""Share of all misfit at which a single station is named as the cause."""


def _axes(fitted: FittedRuns, place: int) -> str:
    """The axes with which a run would fit, in words; nothing if there are none."""
    each = [
        f"axes = {json.dumps(axes)} of [{name}]"
        for name, axes in explaining(*fitted.alone(place)).items()
    ]
    return f" The run fits with {' and '.join(each)}." if each else ""


def _culprit(fitted: FittedRuns, place: int) -> str:
    """The station to look at first, if a single one has most of the misfit."""
    square = station_misfit(fitted.member(place).analysis)[0][0]
    worst = int(np.argmax(square))
    share = square[worst] / max(float(square.sum()), 1e-300)
    if share < CULPRIT_SHARE:
        return ""
    label = fitted.alone(place)[0].labels[worst]
    return (
        f" Station {label} alone has {share:.0%} of the misfit: `exclude` {label}, or fit with "
        "`robust` student-t."
    )


def _column(fitted: FittedRuns, place: int) -> str:
    """The column that the run does not use and that explains most of the residuals, in words."""
    if not fitted.readings.others:
        return ""
    named = [effect for effect in fitted.effects(place) if effect.name.startswith(COLUMN)]
    return "".join(f" {described(effect, fitted.alone(place)[0])}" for effect in named[:1])


REFUSAL_ENDINGS = {"culprit": _culprit, "axes": _axes, "column": _column}
"""The possible ends of a refusal, for one run."""


def spanned(fitted: FittedRuns, index: int) -> dict[str, Any]:
    """The order of a triad, the span of temperatures, and what to do."""
    temperature, order = fitted.result.problem.temperature, orders_of(fitted.result)[index]
    higher = np.minimum(highest_order(temperature), HIGHEST) > order
    remedy = np.where(
        higher & (fitted.options.method != "swarm"),
        "Use `order` auto, or a higher one",
        "Measure over a narrower range, or let the tool come to rest at each temperature",
    )
    return {"order": order, "span": np.ptp(temperature, axis=-1), "remedy": remedy}


GAIN_RANGE = (0.3, 3.0)
"""An own-axis gain outside this share of nominal is a wrong profile, not a sensor error."""
MOTION_RANGE = (1e-2, 30.0)
"""A channel that moves by less or more than this share of the field has not seen the field."""
DECLARED_NOISE = 0.3
"""Declared noise of more than this share of the field at every station is a wrong unit."""
PARAMETERS_NAMED = 4
"""Most undetermined parameters that a message lists."""
MOST_SHOWN = 1000.0
"""Ratios beyond this, or its inverse, have no figures in a message."""
ABSURD_RATIO = 30.0
"""Residuals of more than this many times the declared noise mean that something is plain wrong."""
COARSE_NOISE = 0.05
"""Estimated noise of more than this share of the field likewise."""
MOST_SETTINGS = 6_000_000
"""Most stations times settings that they share: 6,000 times 250 take 10 s and 1.3 GB, and memory goes with both."""
BAD_INPUT = "bad-input"
"""The status of what is wrong with the input itself: an `InputError` of a single run."""
NEEDS = {
    "newton": ("inclination",),
    "swarm": ("inclination", "toolface", "azimuth", "dip"),
    "least-squares": ("inclination", "toolface", "azimuth"),
    "toolface-inclination": ("inclination", "toolface"),
}
"""Reference angles that a method needs at every station, those of the field for a magnetometer."""
STRENGTH_COLUMNS = {
    "gravity": ("ref_gravity_g", 1.0, "g", ""),
    "field": ("ref_field_nt", 1e-3, "µT", "; of a run in a coil, say coil = true under [stand]"),
}
"""Column of each strength, factor and unit in which a message has it, and a remedy besides."""
OTHER_ANGLES = {
    "inclination": "other inclinations (at least three, well apart, up and down)",
    "toolface": "other toolfaces (six or more)",
}
"""The stations to add where all have one angle; one azimuth alone leaves nothing undetermined."""
ONE_ANGLE = 0.9998, 0.985
"""Mean resultant length of angles that are one: of references within 1°, by raw readings within 10°."""
TOOL_AXES = np.array([*"xyz"])
Run = Callable[[int], Readings]
"""Readings of one member of a batch, without leading axis: their labels and source."""
Words = dict[str, Any]
"""The values in the words of a flag, by name."""

OF_OPTIONS = {
    "method": f"`method` must be one of {', '.join(EVIDENCE)}; got {{options.method!r}}.",
    "parameters": "`parameters` must be 6, 9 or 12; got {options.parameters}.",
    "robust": f"`robust` must be one of {', '.join(LOSSES)}; got {{options.robust!r}}.",
    "ignore": f"`ignore` must be of {', '.join(CONSTANTS)}; got {{unknown[0]!r}}.",
    "ignore and method": "`ignore` needs `method` joint; got {options.method!r}, which says itself what it uses.",
    "nonlinearity and model": "`nonlinearity` {curved[0]}: the model of factors has no own-axis terms. Use `model` "
    "polynomial with it.",
    "robust and minimiser": "`robust` cannot weigh the stations of {minimiser}. Use `method` joint with it.",
    "nonlinearity and minimiser": "`nonlinearity` cannot be combined with {minimiser}: own-axis terms need their "
    "prior. Use `method` joint, or `nonlinearity` none.",
    "order and swarm": "method swarm finds the 12 parameters of one temperature: use `order` 0 for it, or `method` "
    "joint for temperature terms.",
    "parameters and swarm": "`parameters` {options.parameters} cannot be combined with method swarm, which finds all "
    "twelve. Use `method` least-squares: both meet on the same cost.",
    "weights and joint": "`paper_weights`: method joint does not come from a paper. Name the paper's method: "
    "least-squares, swarm, newton, toolface-inclination or scalar.",
    "prior and nonlinearity": "`prior` cannot be combined with own-axis nonlinearity. Use `method` joint, without "
    "`paper_weights` and with `nonlinearity` none.",
    "prior and minimiser": "`prior` cannot be combined with {minimiser}. Use `method` joint, without `paper_weights` "
    "and with `nonlinearity` none.",
}
"""Why options do not go together."""
UNSOUND_ADVICE = (
    "Check 'noise' and 'repeatability' in the tool profile and the columns sd_: all are in the raw units of their "
    "channel; without them the noise is estimated."
)
"""The advice where a fit has no valid covariance."""
OF_READINGS = {
    "few": "{source} has {count} stations; the model has {size} parameters per triad and needs {needed} or more. Add "
    "stations at other attitudes{remedy}.",
    "settings": "{source}: {count} stations share {settings} settings of the stand. To fit the errors of so many takes "
    'minutes and many GB of memory. If the stand is set anew at every station, say settings = "per-station" under '
    "[stand] in the tool profile; if not, calibrate a part of the run.",
    "common": "{takes} the stand as exact and the run as steady, and the tool profile declares {declared}: no "
    "uncertainty would include it. Use `method` least-squares or joint without `paper_weights`, or take it out of "
    "the profile.",
    "relative": "`field_drift_nt` of [stand] in the tool profile is in nT, and the run does not state the strength of "
    "the field. Give ref_field_nt, or take it out of the profile.",
    "dead": "{source}: the {triad} channel on tool axis {axis} does not move: the same value at all {count} stations. "
    "A dead sensor, a wrong column, or all stations in one attitude; check the wiring and the columns.",
    "little": "{source}: the {triad} channel on tool axis {axis} moves by {moved:.3g} {unit} over the run, too little "
    "to calibrate it{alike[cause]}. Add stations at {alike[ways]}; if there are, look for a dead sensor, a wrong "
    "column, or a wrong 'scale' of [{triad}] in the tool profile.",
    "much": "{source}: the {triad} channel on tool axis {axis} moves by {moved:.3g} {unit} over the run, more than any "
    "field explains. Look for a wrong column or cell, or a wrong 'scale' of [{triad}] in the tool profile.",
    "reference": "{source}: {column} is {mean:.4g} {unit}, and the {triad} on tool axis {axis} moves by {moved:.3g} "
    "{unit}. Is the reference in another unit? Give {column} in {unit}. In a coil, check 'scale' of [{triad}] in the "
    "tool profile.",
    "noise": "the declared noise of the {triad} is {share:.2g} times the field that it measures, or more. 'noise' and "
    "'repeatability' of [{triad}] in the tool profile and the columns sd_ are in the raw units of the channels, such "
    "as V: correct them, or leave them out and the noise is estimated.",
    "no temperature": "`order` {order} needs the column 'temperature_c'; use `order` 0.",
    "span": "the run spans {span:.1f} °C with {levels} temperature{plural} more than 5 °C apart: too little for "
    "`order` {order}, which needs {needed} of them over {range} °C or more. Add temperatures, or lower `order`.",
    "blank": "method {method} needs {needed} at every station; 'ref_{name}_deg' is blank at {blank} of {count} "
    "(first: station {first}). Fill it in, or use `method` joint, which takes what is known.",
}
"""Why no fit of a run can be good."""
OF_FITS = {
    "inseparable": "`estimate` {errors}: these stations cannot tell it from the sensors' own errors. Add stations at "
    "other azimuths and inclinations with references, or leave it out.",
    "unsettled": "the fit failed: {message}.{axes}",
    "residuals": "the {triad}'s residuals are {much}: no sensor model explains these readings. Check that columns, "
    "reference angles and groups belong to the stations they stand at, the gravity, field and dip that are stated, "
    "and 'axes' and 'noise' in the tool "
    "profile.{column}{culprit}{axes}",
    "temperature": "the {triad}'s residuals are {much}, because its readings vary with temperature more than `order` "
    "{order} follows: this run spans {span:.0f} °C. {remedy}.",
    "weak-geometry": "the stations are too weak to fit the model{alike[cause]}: nothing determines {names}. Add "
    "stations at {alike[ways]}{alike[other]}{lower}.{axes}",
    "no-redundancy": "the {triad} has no redundancy ({freedom:.1f} degrees of freedom): its noise cannot be estimated. "
    "Add stations, or declare 'noise' in the tool profile.",
    "gain": "the {triad}'s gain on tool axis {axis} comes out at {gain} times nominal and {wrong} (accepted: "
    "{range[0]}…{range[1]}). Check 'axes' and 'scale' of [{triad}] in the tool profile, and the reference "
    "angles.{axes}",
    "overturned": "the dip comes out at {dip:.1f}°, beyond vertical (accepted: -90…90): the magnetometer reads the "
    "reverse of the field, or the reference azimuths are 180° off. Check 'axes' of [magnetometer] in the tool "
    "profile, and ref_azimuth_deg.{axes}",
    "off earth": "no place on Earth has a {what} of {value:.4g} {unit} ({low:g}…{high:g}): {given} so. Check "
    "{column} and its unit, and 'scale' in the tool profile{coil}.",
    "errors": "the errors of {of[name]} after calibration are {of[after]:.3g}{of[unit]} (root mean square), where the "
    "misfit of the run explains {of[expected]:.2g}{of[unit]}. Check the references of {of[name]} and 'axes' in the "
    "tool profile, or declare 'noise' and [stand] as they are.{looks}{culprit}{axes}",
    "unsound": "the fit gives no valid covariance, or gains that no sensor has: {noise}. {advice}{axes}",
}
"""Why a fit cannot be trusted."""


def check(refusals: Iterable[Flag]) -> None:
    """Refuse a single run, a batch of one, by the first flag that holds of it.

    Raises `FitError`, or `InputError` where the input itself is wrong.
    """
    for refusal in refusals:
        if refusal.members[0]:
            error = InputError if refusal.id == BAD_INPUT else FitError
            raise error(refusal.sentence(0))


def check_readings(readings: Readings, options: Options) -> None:
    """Refuse a run that no fit can calibrate, and options that do not go together."""
    check_options(options)
    check(reading_refusals(batch_of_one(readings), options, lambda _: readings))


def check_options(options: Options) -> None:
    """Refuse choices that do not go together."""
    alone, swarm = options.separate_solver, options.method == "swarm"
    unknown = [name for name in options.ignore if name not in CONSTANTS]
    models = dict(zip(TRIADS, map(options.kind, options.orders), strict=True))
    curved = [name for name in TRIADS if name in options.curved and models[name] != "polynomial"]
    wrong = {
        "method": options.method not in EVIDENCE,
        "parameters": options.parameters not in (6, 9, 12),
        "robust": options.robust not in (None, *LOSSES),
        "ignore": unknown,
        "ignore and method": options.ignore and options.method != "joint",
        "nonlinearity and model": curved,
        "robust and minimiser": alone and options.robust,
        "nonlinearity and minimiser": alone and options.curved,
        "order and swarm": swarm and max(options.orders),
        "parameters and swarm": swarm and options.parameters < 12,
        "weights and joint": options.paper_weights and options.method == "joint",
        "prior and nonlinearity": options.prior and options.curved,
        "prior and minimiser": options.prior and alone,
    }
    first = next((name for name, holds in wrong.items() if holds), None)
    if first:
        error = FitError if first == "order and swarm" else InputError
        values = {"options": options, "unknown": unknown, "curved": curved}
        raise error(OF_OPTIONS[first].format(minimiser=minimiser(options), **values))


def minimiser(options: Options) -> str:
    """The name of a method that minimises by itself."""
    return "the paper's weights" if options.paper_weights else f"method {options.method}"


def check_curves(readings: Readings, wanted: Iterable[str]) -> None:
    """Refuse own-axis terms of a triad that the run does not have."""
    for name in wanted:
        if name not in readings.triads:
            raise InputError(
                f"`nonlinearity` {name}: {readings.source} has no {name}. Leave it out."
            )


def reading_refusals(readings: Readings, options: Options, run: Run) -> Iterator[Flag]:
    """Defects that no fit of runs (B, n, ...) can repair, in order of precedence."""

    def source(place: int) -> str:
        return run(place).source or "the run"

    words = {"source": source, "count": readings.count, "alike": lambda place: _alike(run(place))}
    yield _few_stations(readings, options, words)
    yield _many_settings(readings, words)
    yield _common_errors(readings, options)
    yield _field_in_nanotesla(readings)
    for triad in readings.triads:
        yield from _channels(readings, triad, options.knowledge is not None, words)
        if triad in readings.sd:
            yield _coarse_noise(readings, triad)
    if options.knowledge is None or options.knowledge.temperature is None:
        yield from _temperatures(readings, max(options.orders))
    yield from _blanks(readings, options.method, run)


def _all(readings: Readings, hold: bool) -> Bools:
    """A flag that holds for all runs (B,) of one shape, or for none."""
    return np.full(len(readings.accelerometer), hold)


def _few_stations(readings: Readings, options: Options, words: Words) -> Flag:
    """Fewer readings than parameters; with a prior any number will do."""
    order = max(options.orders)
    basis, factors = Basis(order), options.kind(order) == "factors"
    model: Whole = Factors(basis) if factors else Polynomial(basis)
    size = restricted(model, options.parameters).size
    few = 3 * readings.count < size and options.knowledge is None
    remedy = ", or lower `order`" if order else ""
    values = words | {"size": size, "needed": -(-size // 3), "remedy": remedy}
    return Flag("too-few-stations", _all(readings, few), OF_READINGS["few"], values)


def _many_settings(readings: Readings, words: Words) -> Flag:
    """Errors of settings of an uncertain stand that are too many to be fitted at once."""
    uncertain = any(bool((readings.uncertainty(name) > 0).any()) for name in DIRECTION)
    members, several = _all(readings, False), np.zeros(len(readings.accelerometer), int)
    if uncertain and readings.count**2 > 2 * MOST_SETTINGS:
        number = np.broadcast_to(settings_of(readings), readings.accelerometer.shape[:-1])
        several = np.array([np.count_nonzero(np.bincount(each) > 1) for each in number])
        members = several * readings.count > MOST_SETTINGS
    return Flag(BAD_INPUT, members, OF_READINGS["settings"], words | {"settings": several})


def _common_errors(readings: Readings, options: Options) -> Flag:
    """Declared errors that all stations share where the method cannot have them as unknowns."""
    declared = [name for name in (*COMMON, *WALKS) if name in readings.sd]
    exact = options.method == "swarm" or options.paper_weights
    takes = f"{minimiser(options)} take{'' if options.paper_weights else 's'}"
    values = {"takes": takes, "declared": ", ".join(declared)}
    held = _all(readings, bool(declared) and exact)
    return Flag("common-errors", held, OF_READINGS["common"], values)


def _field_in_nanotesla(readings: Readings) -> Flag:
    """A declared drift of a field whose strength is not known."""
    lost = readings.relative and bool(readings.uncertainty("field-drift").any())
    return Flag("common-errors", _all(readings, lost), OF_READINGS["relative"], {})


def _channels(readings: Readings, triad: str, prior: bool, words: Words) -> Iterator[Flag]:
    """Channels that are dead or cannot have seen the field; a prior needs no motion."""
    values = getattr(readings, triad)
    spread = np.ptp(np.ascontiguousarray(values.mT), axis=-1)
    dead = spread <= 1e-12 * np.abs(values).max((-1, -2))[:, None]
    name, unit = ("gravity", "g") if triad == "accelerometer" else ("field", "nT")
    known = readings.reference(name)
    given = np.sum(~np.isnan(known), -1)
    mean = np.where(given > 0, np.nansum(known, -1) / np.maximum(given, 1), np.nan)
    share = spread / mean[:, None]
    odd = (share < (0.0 if prior else MOTION_RANGE[0])) | (share > MOTION_RANGE[1])
    words = words | {"triad": triad, "unit": unit}
    still = words | {"axis": TOOL_AXES[np.argmax(dead, -1)]}
    yield Flag("channel", np.any(dead, -1), OF_READINGS["dead"], still)
    axis = np.argmax(odd, -1)
    first = np.arange(len(axis)), axis
    moving = words | {"axis": TOOL_AXES[axis], "moved": spread[first]}
    low, high = EARTH_RANGES[name]
    foreign = np.any(odd, -1) & ((mean < low) | (mean > high)) & (not readings.relative)
    reference = {"column": STRENGTH_COLUMNS[name][0], "mean": mean}
    yield Flag("earth", foreign, OF_READINGS["reference"], moving | reference)
    little = share[first] < MOTION_RANGE[0]
    yield Flag("channel", np.any(odd, -1) & little, OF_READINGS["little"], moving)
    yield Flag("channel", np.any(odd, -1) & ~little, OF_READINGS["much"], moving)


def _coarse_noise(readings: Readings, triad: str) -> Flag:
    """Declared noise that leaves nothing of the field, on some channel at every station."""
    values = getattr(readings, triad)
    least = np.broadcast_to(readings.sd[triad], values.shape).min(-2)
    share = least / _strength(values)[:, None]
    coarse = np.any(share > DECLARED_NOISE, -1)
    return Flag("noise", coarse, OF_READINGS["noise"], {"triad": triad, "share": share.max(-1)})


def _strength(raw: Array) -> Array:
    """Mean strength (...) of readings (..., n, 3), at least 1e-30."""
    return np.asarray(np.maximum(length(raw).mean(-1), 1e-30))


def no_temperature(order: int) -> InputError:
    """The error of an order that needs temperatures in a run without them."""
    return InputError(OF_READINGS["no temperature"].format(order=order))


def _temperatures(readings: Readings, order: int) -> Iterator[Flag]:
    """Temperatures that are too few or too close for an order."""
    if order == 0:
        return
    needs = {"order": order, "needed": order + 1, "range": 10 * order}
    if readings.temperature is None:
        yield Flag(BAD_INPUT, _all(readings, True), OF_READINGS["no temperature"], needs)
        return
    levels, span = soaks(readings.temperature).max(-1) + 1, np.ptp(readings.temperature, axis=-1)
    few = highest_order(readings.temperature) < order
    values = {"span": span, "levels": levels, "plural": np.where(levels > 1, "s", "")}
    yield Flag("temperature-span", few, OF_READINGS["span"], needs | values)


def _blanks(readings: Readings, method: str, run: Run) -> Iterator[Flag]:
    """Blanks of reference angles that a method needs at every station."""
    magnetic = () if readings.magnetometer is not None else ("azimuth", "dip")
    needed = [name for name in NEEDS.get(method, ()) if name not in magnetic]
    words = {"method": method, "needed": ", ".join(needed), "count": readings.count}
    for name in needed:
        blank = np.isnan(readings.reference(name))
        values = {"name": name, "blank": blank.sum(-1), "first": partial(_first, run, blank)}
        yield Flag("missing-reference", np.any(blank, -1), OF_READINGS["blank"], words | values)


def _first(run: Run, stations: Bools, place: int) -> str:
    """The label of the first of some stations (B, n) of a run."""
    return run(place).labels[int(np.argmax(stations[place]))]


def fit_refusals(fitted: FittedRuns) -> Iterator[Flag]:
    """Reasons not to trust a fit, in order of precedence.

    A fit that explains nothing may have ended anywhere, or not at all: its residuals are judged before
    its rank, its gains, and whether it settled. Refusals that a wrong axis may have caused name the axes
    with which the run fits.
    """
    sound = np.ones(fitted.count, bool)
    for flag in _by_arrays(fitted):
        sound &= ~flag.members
        yield flag
    yield _unexplained_errors(fitted, sound)


def _by_arrays(fitted: FittedRuns) -> Iterator[Flag]:
    """Refusals that operations on arrays find."""
    result, refusal = fitted.result, partial(_refusal, fitted)
    triads = range(len(result.problem.triads))
    if fitted.options.estimate:
        errors = ",".join(fitted.options.estimate)
        yield refusal("inseparable", inseparable(result), errors=errors)
    yield _unsettled(fitted, Status.NOT_FINITE)
    for triad in triads:
        yield from _absurd(fitted, triad)
    yield _unsettled(fitted, Status.NOT_CONVERGED)
    yield _too_weak(fitted)
    for triad in triads:
        freedom = result.analysis.freedom[:, triad]
        bare = np.isfinite(result.noise[:, triad]) & (freedom < 1)
        least = np.maximum(freedom, 0)
        yield refusal("no-redundancy", bare, triad=TRIADS[triad], freedom=least)
    for triad in triads:
        yield _odd_gain(fitted, triad)
    dip = np.degrees(overturned(result))
    yield refusal("overturned", np.isfinite(dip), "earth", dip=dip)
    for name in EARTH_RANGES:
        yield _nowhere_on_earth(fitted, name)
    yield _unsound(fitted)


def _refusal(
    fitted: FittedRuns, words: str, members: Bools, status: str = "", **values: Any
) -> Flag:
    """A refusal of fits by its words, whose name is the status if no other is given.

    The words may end with the station to look at first, and with the axes with which the run would fit.
    """
    ends = {word: partial(end, fitted) for word, end in REFUSAL_ENDINGS.items()}
    return Flag(status or words, members, OF_FITS[words], ends | values)


def _unsettled(fitted: FittedRuns, status: Status) -> Flag:
    """Fits that ended with this status: they did not converge."""
    members = fitted.result.status == int(status)
    name = status.name.lower().replace("_", "-")
    return _refusal(fitted, "unsettled", members, name, message=status.message)


def _absurd(fitted: FittedRuns, index: int) -> Iterator[Flag]:
    """Residuals that no error of a sensor explains: columns, references or groups are mixed up."""
    result, raw = fitted.result, fitted.result.problem.triads[index].raw
    excess = np.sqrt(np.nan_to_num(result.analysis.variance_factor[:, index]))
    noise = result.noise[:, index]
    spread = np.ascontiguousarray(raw.mT).std(-1).max(-1)
    declared, signal = np.isnan(noise), np.minimum(_strength(raw), 2 * spread)

    def is_absurd(share: Array | float) -> Bools:
        return np.where(
            declared, excess * share > ABSURD_RATIO, noise * share > COARSE_NOISE * signal
        )

    def much(place: int) -> str:
        if declared[place]:
            return f"{_bounded(excess[place], '{:.0f}')} times the declared noise"
        return f"{_bounded(noise[place] / signal[place], '{:.0%}')} of the field"

    absurd = is_absurd(1.0) & (result.analysis.freedom[:, index] >= 1)
    absurd &= declared | (result.status == int(Status.OK))  # an unfinished fit estimates no noise
    warmed = absurd & ~is_absurd(share_beyond(result, index, absurd))
    words: dict[str, Any] = {"triad": TRIADS[index], "much": much}
    yield _refusal(
        fitted, "temperature", warmed, "temperature-order", **words, **spanned(fitted, index)
    )
    yield _refusal(fitted, "residuals", absurd & ~warmed, **words)


def _bounded(ratio: float, form: str) -> str:
    """A ratio in words: beyond `MOST_SHOWN`, or its inverse, its figures mean nothing.

    >>> _bounded(3.5e150, "{:.0f}"), _bounded(-4e-124, "{:.3g}"), _bounded(0.25, "{:.3g}")
    ('more than 1000', '0', '0.25')
    """
    if abs(ratio) < 1 / MOST_SHOWN:
        return form.format(0)
    if abs(ratio) <= MOST_SHOWN:
        return form.format(ratio)
    return f"{'less than -' if ratio < 0 else 'more than '}{form.format(MOST_SHOWN)}"


def _alike(readings: Readings) -> dict[str, str]:
    """The angles of the stand that all stations of a run share, and the stations to add, in words."""
    same: dict[str, str] = {}
    count, raw = readings.count, nominal(readings)
    for name in OTHER_ANGLES:
        known = readings.reference(name)
        by_stand = bool(~np.isnan(known).any())
        angles = known if by_stand else OBSERVABLES[name].value(*raw)
        mean = resultant(angles)
        if abs(mean) > ONE_ANGLE[not by_stand]:
            degrees = np.degrees(np.angle(mean)) % 360
            same[name] = f"{degrees:.4g}°" if by_stand else f"about {degrees:.0f}°"
    if not same:
        ways = f"{OTHER_ANGLES['inclination']} with six or more toolfaces each"
        return {"cause": "", "ways": ways, "other": ", or more reference angles"}
    shared = " and ".join(f"{name} {angle}" for name, angle in same.items())
    ways = " and ".join(OTHER_ANGLES[name] for name in same)
    return {"cause": f" (all {count} stations have {shared})", "ways": ways, "other": ""}


def _in_words(name: str) -> str:
    """A parameter in words: the scale or offset of an axis, the misalignment of two.

    >>> [_in_words(n) for n in ("gain-yy", "gain-zy", "offset-x", "gain-xx-temperature-1")]
    ['y scale', 'z-y misalignment', 'x offset', 'x scale over temperature']
    """
    steady, _, power = name.partition("-temperature-")
    kind, _, axes = steady.partition("-")
    if kind == "gain":
        kind = "scale" if axes[:1] == axes[1:] else "misalignment"
    axis = "-".join(dict.fromkeys(axes))
    return f"{axis} {kind}{' over temperature' if power else ''}"


def _too_weak(fitted: FittedRuns) -> Flag:
    """Rotations and scales may stay free; anything else is a design too weak to fit."""
    bad = [[entry for entry in free if is_bad(entry)] for free in fitted.free]

    def names(place: int) -> str:
        each = [
            f"{TRIADS[t]} {_in_words(e.id.removeprefix('weak-'))}"
            for e in bad[place]
            for t in e.triads
        ]
        return listed([*dict.fromkeys(each)], PARAMETERS_NAMED)

    thermal = any(orders_of(fitted.result))
    lower = ", or repeat attitudes at other temperatures, or lower `order`" if thermal else ""
    members = np.array([*map(bool, bad)])
    values: Words = {
        "names": names,
        "lower": lower,
        "alike": lambda place: _alike(fitted.alone(place)[0]),
    }
    return _refusal(fitted, "weak-geometry", members, **values)


def _odd_gain(fitted: FittedRuns, index: int) -> Flag:
    """Own-axis gains far from nominal; from each other where no scale is known."""
    name = TRIADS[index]
    unscaled = getattr(fitted.profile, name).scale is None
    gain, share = gain_shares(fitted.result, index)
    value = share if unscaled or (index == 1 and fitted.readings.relative) else gain
    odd = ~((value >= GAIN_RANGE[0]) & (value <= GAIN_RANGE[1]))
    axis = np.argmax(odd, -1)
    first = value[np.arange(len(axis)), axis]
    wrong = np.where(first < 0, "has the wrong sign", "is far from nominal")
    shown = np.array([_bounded(each, "{:.3g}") for each in first])
    values = {"triad": name, "axis": TOOL_AXES[axis], "gain": shown, "wrong": wrong}
    return _refusal(fitted, "gain", np.any(odd, -1), range=GAIN_RANGE, **values)


def _nowhere_on_earth(fitted: FittedRuns, name: str) -> Flag:
    """A gravity or field that no place on Earth has."""
    problem, state = fitted.result.problem, fitted.result.state
    outside = off_earth(fitted.result, name, fitted.profile.stand.coil)
    column, factor, unit, coil = STRENGTH_COLUMNS[name]
    first = np.arange(fitted.count), np.argmax(outside, -1)
    given = np.where(
        problem.evidence.is_known(name)[first], f"'{column}' gives", "the fit makes it"
    )
    low, high = (limit * factor for limit in EARTH_RANGES[name])
    values = {"value": problem.constant(state, name)[first] * factor, "given": given}
    words = {"what": name, "unit": unit, "low": low, "high": high, "column": column, "coil": coil}
    return _refusal(fitted, "off earth", np.any(outside, -1), "earth", **words, **values)


def _unexplained_errors(fitted: FittedRuns, sound: Bools) -> Flag:
    """Errors against the references that the misfit of the run does not explain.

    They are looked at in `sound` runs (B,) of which some reading is far off.
    """
    places = np.flatnonzero(straying(fitted.result) & sound).tolist()
    errors = {p: excessive_errors(fitted.alone(p)[0], fitted.member(p)) for p in places}
    flags = np.array([bool(errors.get(place)) for place in range(fitted.count)])
    relative = fitted.readings.relative

    def worst(place: int) -> dict[str, Any]:
        rms = errors[place]
        name = max(rms, key=lambda n: rms[n][0] / max(rms[n][1], 1e-300))
        factor, unit = shown_in(name, relative)
        after, expected = (value * factor for value in rms[name])
        return {"name": name, "after": after, "expected": expected, "unit": spaced(unit)}

    def looks(place: int) -> str:
        first = fitted.effects(place)[:1]
        return "".join(f" {described(each, fitted.alone(place)[0])}" for each in first)

    return _refusal(fitted, "errors", flags, of=worst, looks=looks)


def _unsound(fitted: FittedRuns) -> Flag:
    """Fits with an invalid covariance or implausible gains."""
    result, zero = fitted.result, fitted.profile.reference_temperature_c
    low, high = temperature_range(result, fitted.options.knowledge)
    with np.errstate(all="ignore"):  # of members that earlier refusals hold of
        sound = is_covariance(fitted.covariance.in_file(zero))
        sound &= has_sensor_gains(result, np.stack([low, high, np.clip(zero, low, high)], -1))

    def noise(place: int) -> str:
        shares = [triad.sd[place] / _strength(triad.raw[place]) for triad in result.problem.triads]
        return ", ".join(
            f"the {name}'s noise is {share.min():.1g} to {share.max():.1g} of the field"
            for name, share in zip(TRIADS, shares, strict=False)
        )

    return _refusal(fitted, "unsound", ~sound, noise=noise, advice=UNSOUND_ADVICE)
