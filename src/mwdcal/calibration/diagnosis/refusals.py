"""Refusals: runs that no fit can calibrate, and fits whose result cannot be trusted.

Each check looks at a batch of runs and returns a flag; its id is the status in a fleet's table. A
single run is refused by the first flag that holds, and so is each tool of a fleet.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from mwdcal.calibration.diagnosis.axes import explaining
from mwdcal.calibration.diagnosis.flags import FittedRuns, Flag
from mwdcal.calibration.diagnosis.noise_refusals import coarse_noise, unsound
from mwdcal.calibration.diagnosis.plausibility import (
    excessive_errors,
    gain_shares,
    inseparable,
    is_bad,
    off_earth,
    overturned,
    straying,
)
from mwdcal.calibration.diagnosis.structure import described, effects
from mwdcal.calibration.methods import EVIDENCE
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import CONSTANTS, EARTH_RANGES, TRIADS, Readings
from mwdcal.calibration.residuals import shown_in
from mwdcal.calibration.soaks import soaks
from mwdcal.errors import FitError, InputError
from mwdcal.estimation.batch import batch_of_one
from mwdcal.estimation.robust import LOSSES
from mwdcal.estimation.solvers import Status
from mwdcal.estimation.uncertainty import station_misfit
from mwdcal.geometry.vectors import Array, Bools
from mwdcal.sensor.profile import COMMON

GAIN_RANGE = (0.3, 3.0)
"""An own-axis gain outside this share of nominal is a wrong profile, not a sensor error."""
MOTION_RANGE = (1e-2, 30.0)
"""A channel that moves by less or more than this share of the field has not seen the field."""
PARAMETERS_NAMED = 4
"""Most undetermined parameters that a message lists."""
ABSURD_RATIO = 30.0
"""Residuals of more than this many times the declared noise mean that something is plain wrong."""
CULPRIT_SHARE = 0.3
"""Share of all misfit at which a single station is named as the cause."""
COARSE_NOISE = 0.05
"""Estimated noise of more than this share of the field likewise."""
BAD_INPUT = "bad-input"
"""The status of what is wrong with the input itself: an `InputError` of a single run."""
NEEDS = {
    "newton": ("inclination",),
    "swarm": ("inclination", "toolface"),
    "least-squares": ("inclination", "toolface"),
    "toolface-inclination": ("inclination", "toolface"),
}
"""Reference angles that a method needs at every station."""
Run = Callable[[int], Readings]
"""Readings of one member of a batch, without leading axis: their labels and source."""


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
    method = options.method
    if method not in EVIDENCE:
        raise InputError(f"`method` must be one of {', '.join(EVIDENCE)}; got {method!r}.")
    if options.parameters not in (6, 9, 12):
        raise InputError(f"`parameters` must be 6, 9 or 12; got {options.parameters}.")
    if options.robust not in (None, *LOSSES):
        raise InputError(f"`robust` must be one of {', '.join(LOSSES)}; got {options.robust!r}.")
    _check_ignored(options)
    _check_curved_models(options)
    minimiser = "the paper's weights" if options.paper_weights else f"method {method}"
    if options.separate_solver and options.robust:
        raise InputError(
            f"`robust` cannot weigh the stations of {minimiser}. Use `method` joint with it."
        )
    if options.separate_solver and options.curved:
        raise InputError(
            f"`nonlinearity` cannot be combined with {minimiser}: own-axis terms need their prior. Use "
            "`method` joint, or `nonlinearity` none."
        )
    if method == "swarm" and max(options.orders):
        raise FitError(
            "method swarm finds the 12 parameters of one temperature: use `order` 0 for it, or "
            "`method` joint for temperature terms."
        )
    if method == "swarm" and options.parameters < 12:
        raise InputError(
            f"`parameters` {options.parameters} cannot be combined with method swarm, which finds all "
            "twelve. Use `method` least-squares: both meet on the same cost."
        )
    if options.paper_weights and method == "joint":
        raise InputError(
            "`paper_weights`: method joint does not come from a paper. Name the paper's method: least-squares, "
            "swarm, newton, toolface-inclination or scalar."
        )
    if options.prior and (options.separate_solver or options.curved):
        what = "own-axis nonlinearity" if options.curved else minimiser
        raise InputError(
            f"`prior` cannot be combined with {what}. Use `method` joint, without "
            "`paper_weights` and with `nonlinearity` none."
        )


def _check_curved_models(options: Options) -> None:
    """Refuse own-axis terms of a model that has none."""
    for name, order in zip(TRIADS, options.orders, strict=True):
        if name in options.curved and options.kind(order) != "polynomial":
            raise InputError(
                f"`nonlinearity` {name}: the model of factors has no own-axis terms. Use "
                "`model` polynomial with it."
            )


def check_curves(readings: Readings, wanted: Sequence[str]) -> None:
    """Refuse own-axis terms of a triad that the run does not have."""
    for name in wanted:
        if getattr(readings, name) is None:
            raise InputError(
                f"`nonlinearity` {name}: {readings.source} has no {name}. Leave it out."
            )


def _check_ignored(options: Options) -> None:
    """Refuse to ignore anything but strengths and dip, or with a method that fixes what it uses."""
    unknown = [name for name in options.ignore if name not in CONSTANTS]
    if unknown:
        raise InputError(f"`ignore` must be of {', '.join(CONSTANTS)}; got {unknown[0]!r}.")
    if options.ignore and options.method != "joint":
        raise InputError(
            f"`ignore` needs `method` joint; got {options.method!r}, which says itself what it uses."
        )


def reading_refusals(readings: Readings, options: Options, run: Run) -> Iterator[Flag]:
    """What no fit of runs (B, n, ...) can make good, in order of precedence."""
    yield _few_stations(readings, options, run)
    yield _common_errors(readings, options)
    for triad in TRIADS:
        yield from _channels(readings, triad, options.knowledge is not None, run)
        yield coarse_noise(readings, triad)
    if options.knowledge is None or options.knowledge.temperature is None:
        yield from _temperatures(readings, max(options.orders))
    needed = _references(options.method, readings.magnetometer is not None)
    for name in needed:
        yield _blank(readings, options.method, needed, name, run)


def _all(readings: Readings, hold: bool) -> Bools:
    """A flag that holds for all runs (B,) of one shape, or for none."""
    return np.full(len(readings.accelerometer), hold)


def _few_stations(readings: Readings, options: Options, run: Run) -> Flag:
    """Fewer readings than parameters; with a prior any number will do."""
    highest = max(options.orders)
    factors = options.kind(highest) == "factors"
    size = 6 * (highest + 1) + 6 if factors else 12 * (highest + 1)
    size -= (12 - options.parameters) * (1 if factors else highest + 1)

    def sentence(place: int) -> str:
        return (
            f"{run(place).source or 'the run'} has {readings.count} stations; the model has {size} "
            f"parameters per triad and needs {-(-size // 3)} or more. Add stations at other "
            f"attitudes{', or lower `order`' if highest else ''}."
        )

    few = 3 * readings.count < size and options.knowledge is None
    return Flag("too-few-stations", _all(readings, few), sentence)


def holds_stand(options: Options) -> bool:
    """Whether a method takes the stand as exact: errors common to its stations have no place in it."""
    return options.method == "swarm" or options.paper_weights


def _common_errors(readings: Readings, options: Options) -> Flag:
    """Declared errors that all stations share where the method cannot have them as unknowns."""
    declared = [name for name in COMMON if name in readings.sd]
    method = f"method {options.method} takes"
    what = "the paper's weights take" if options.paper_weights else method
    text = (
        f"{what} the stand as exact, and [stand] of the tool profile declares {', '.join(declared)}: no "
        "uncertainty would include it. Use `method` least-squares or joint without `paper_weights`, or "
        "take it out of the profile."
    )
    held = bool(declared) and holds_stand(options)
    return Flag("common-errors", _all(readings, held), lambda _: text)


def _channels(readings: Readings, triad: str, prior: bool, run: Run) -> Iterator[Flag]:
    """Channels that are dead or cannot have seen the field; a prior needs no motion."""
    values = getattr(readings, triad)
    if values is None:
        return
    spread = np.ptp(np.ascontiguousarray(values.mT), axis=-1)
    dead = spread <= 1e-12 * np.abs(values).max((-1, -2))[:, None]
    name, unit = ("gravity", "g") if triad == "accelerometer" else ("field", "nT")
    known = readings.reference(name)
    given = np.sum(~np.isnan(known), -1)
    share = (
        spread / np.where(given > 0, np.nansum(known, -1) / np.maximum(given, 1), np.nan)[:, None]
    )
    odd = (share < (0.0 if prior else MOTION_RANGE[0])) | (share > MOTION_RANGE[1])

    def where(place: int, flags: Bools) -> tuple[int, str]:
        axis = int(np.argmax(flags[place]))
        source = run(place).source or "the run"
        return axis, f"{source}: the {triad} channel on tool axis {'xyz'[axis]}"

    def still(place: int) -> str:
        return (
            f"{where(place, dead)[1]} does not move: the same value at all {readings.count} stations. "
            "A dead sensor, a wrong column, or all stations in one attitude; check the wiring and "
            "the columns."
        )

    def moving(place: int) -> str:
        axis, channel = where(place, odd)
        moves = f"{channel} moves by {spread[place, axis]:.3g} {unit} over the run, "
        scale = f"a wrong 'scale' of [{triad}] in the tool profile"
        if share[place, axis] < MOTION_RANGE[0]:
            return (
                f"{moves}too little to calibrate it. Add stations at other inclinations and "
                f"toolfaces; if there are, look for a dead sensor, a wrong column, or {scale}."
            )
        return f"{moves}more than any field explains. Look for a wrong column or cell, or {scale}."

    yield Flag("channel", np.any(dead, -1), still)
    yield Flag("channel", np.any(odd, -1), moving)


def no_temperature(order: int) -> InputError:
    """The error of an order that needs temperatures in a run without them."""
    return InputError(f"`order` {order} needs the column 'temperature_c'; use `order` 0.")


def _temperatures(readings: Readings, order: int) -> Iterator[Flag]:
    """Temperatures that are too few or too close for an order."""
    if order == 0:
        return
    if readings.temperature is None:
        yield Flag(BAD_INPUT, _all(readings, True), lambda _: str(no_temperature(order)))
        return
    levels, span = soaks(readings.temperature).max(-1) + 1, np.ptp(readings.temperature, axis=-1)

    def sentence(place: int) -> str:
        count = int(levels[place])
        return (
            f"the run spans {span[place]:.1f} °C with {count} temperature{'s' * (count > 1)} more than 5 °C "
            f"apart: too little for `order` {order}, which needs {order + 1} of them over {10 * order} °C or more. "
            "Add temperatures, or lower `order`."
        )

    yield Flag("temperature-span", (levels < order + 1) | (span < 10 * order), sentence)


def _references(method: str, magnetometer: bool) -> list[str]:
    """Reference angles that a method needs at every station of a run."""
    needed = list(NEEDS.get(method, ()))
    if magnetometer and method in ("least-squares", "swarm"):
        needed += ["azimuth", "dip"][: 1 + (method == "swarm")]
    return needed


def _blank(readings: Readings, method: str, needed: list[str], name: str, run: Run) -> Flag:
    """Blanks of a reference, of those that a method needs at every station."""
    blank = np.isnan(readings.reference(name))

    def sentence(place: int) -> str:
        first = run(place).labels[int(np.argmax(blank[place]))]
        return (
            f"method {method} needs {', '.join(needed)} at every station; 'ref_{name}_deg' is "
            f"blank at {int(blank[place].sum())} of {readings.count} (first: station {first}). Fill it "
            "in, or use `method` joint, which takes what is known."
        )

    return Flag("missing-reference", np.any(blank, -1), sentence)


def fit_refusals(fitted: FittedRuns) -> Iterator[Flag]:
    """Reasons not to trust a fit, in order of precedence.

    A fit that explains nothing may have ended anywhere: its residuals are judged before its rank and
    its gains. Refusals that a wrong axis may have caused name the axes with which the run fits.
    """
    sound = np.ones(fitted.count, bool)
    for flag in _by_arrays(fitted):
        sound &= ~flag.members
        yield flag
    yield _naming_axes(fitted, _unexplained_errors(fitted, sound))


def _by_arrays(fitted: FittedRuns) -> Iterator[Flag]:
    """Refusals that operations on arrays find."""
    triads, named = range(len(fitted.result.problem.triads)), partial(_naming_axes, fitted)
    if fitted.options.estimate:
        yield _inseparable(fitted)
    for status in (Status.NOT_CONVERGED, Status.NOT_FINITE):
        yield named(_unsettled(fitted, status))
    for triad in triads:
        yield named(_absurd(fitted, triad))
    yield named(_too_weak(fitted))
    for triad in triads:
        yield _without_redundancy(fitted, triad)
    for triad in triads:
        yield named(_odd_gain(fitted, triad))
    yield named(_beyond_vertical(fitted))
    for name in EARTH_RANGES:
        yield _nowhere_on_earth(fitted, name)
    yield named(unsound(fitted))


def _naming_axes(fitted: FittedRuns, flag: Flag) -> Flag:
    """A refusal that also names the axes with which the run would fit, if there are any."""

    def sentence(place: int) -> str:
        text = flag.sentence(place)
        each = [
            f"axes = {json.dumps(axes)} of [{name}]"
            for name, axes in explaining(*fitted.alone(place)).items()
        ]
        return f"{text} The run fits with {' and '.join(each)}." if each else text

    return replace(flag, sentence=sentence)


def _inseparable(fitted: FittedRuns) -> Flag:
    """Stand errors that the stations cannot tell from the sensors' own errors."""
    text = (
        f"`estimate` {','.join(fitted.options.estimate)}: these stations cannot tell it from the sensors' own "
        "errors. Add stations at other azimuths and inclinations with references, or leave it out."
    )
    return Flag("inseparable", inseparable(fitted.result), lambda _: text)


def _unsettled(fitted: FittedRuns, status: Status) -> Flag:
    """Fits that did not end well."""
    name, text = status.name.lower().replace("_", "-"), f"the fit failed: {status.message}."
    return Flag(name, fitted.result.status == int(status), lambda _: text)


def _absurd(fitted: FittedRuns, index: int) -> Flag:
    """Residuals that no error of a sensor explains: columns, references or groups are mixed up."""
    result, raw = fitted.result, fitted.result.problem.triads[index].raw
    excess = np.sqrt(np.nan_to_num(result.analysis.variance_factor[:, index]))
    noise = result.noise[:, index]
    declared = np.isnan(noise)
    absurd = declared & (excess > ABSURD_RATIO)
    if not declared.all():
        absurd |= noise > COARSE_NOISE * _signal(raw)

    def sentence(place: int) -> str:
        much = (
            f"{excess[place]:.0f} times the declared noise"
            if declared[place]
            else f"{noise[place] / _signal(raw)[place]:.0%} of the field"
        )
        return (
            f"the {TRIADS[index]}'s residuals are {much}: no sensor model explains these readings. Check "
            "that columns, reference angles and groups belong to the stations they stand at, and "
            f"'axes' and 'noise' in the tool profile.{_culprit(fitted, place)}"
        )

    return Flag("residuals", absurd & (result.analysis.freedom[:, index] >= 1), sentence)


def _signal(raw: Array) -> Array:
    """Size (B,) of what readings (B, n, 3) measure, at least 1e-300."""
    strength = np.linalg.norm(raw, axis=-1).mean(-1)
    return np.asarray(np.maximum(np.minimum(strength, 2 * raw.std(axis=1).max(-1)), 1e-300))


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


def _too_weak(fitted: FittedRuns) -> Flag:
    """Rotations and scales may stay free; anything else is a design too weak to fit."""
    bad = [[entry for entry in free if is_bad(entry)] for free in fitted.free]

    def sentence(place: int) -> str:
        each = [f"{TRIADS[t]} {e.id.removeprefix('weak-')}" for e in bad[place] for t in e.triads]
        each = list(dict.fromkeys(each))
        more = f" and {len(each) - PARAMETERS_NAMED} more" if len(each) > PARAMETERS_NAMED else ""
        names = ", ".join(each[:PARAMETERS_NAMED]) + more
        return (
            f"the stations are too weak to fit the model: nothing determines {names}. Add stations "
            "at other inclinations (at least three, well apart, up and down) with six or more "
            "toolfaces each, or give more reference angles."
        )

    return Flag("weak-geometry", np.array([*map(bool, bad)]), sentence)


def _without_redundancy(fitted: FittedRuns, index: int) -> Flag:
    """Triads without redundancy whose noise would have to be estimated from the residuals."""
    freedom = fitted.result.analysis.freedom[:, index]

    def sentence(place: int) -> str:
        return (
            f"the {TRIADS[index]} has no redundancy ({max(freedom[place], 0):.1f} degrees of freedom): its noise "
            "cannot be estimated. Add stations, or declare 'noise' in the tool profile."
        )

    bare = np.isfinite(fitted.result.noise[:, index]) & (freedom < 1)
    return Flag("no-redundancy", bare, sentence)


def _odd_gain(fitted: FittedRuns, index: int) -> Flag:
    """Own-axis gains far from nominal; from each other where no scale is known."""
    name = TRIADS[index]
    unscaled = getattr(fitted.profile, name).scale is None
    gain, share = gain_shares(fitted.result, index)
    value = share if unscaled or (index == 1 and fitted.readings.relative) else gain
    odd = ~((value >= GAIN_RANGE[0]) & (value <= GAIN_RANGE[1]))

    def sentence(place: int) -> str:
        axis = int(np.argmax(odd[place]))
        wrong = "has the wrong sign" if value[place, axis] < 0 else "is far from nominal"
        return (
            f"the {name}'s gain on tool axis {'xyz'[axis]} comes out at {value[place, axis]:.3g} times "
            f"nominal and {wrong} (accepted: {GAIN_RANGE[0]}…{GAIN_RANGE[1]}). Check 'axes' and 'scale' "
            f"of [{name}] in the tool profile, and the reference angles."
        )

    return Flag("gain", np.any(odd, -1), sentence)


def _beyond_vertical(fitted: FittedRuns) -> Flag:
    """A dip beyond vertical: north of the field opposite to that of the azimuths."""
    dip = np.degrees(overturned(fitted.result))

    def sentence(place: int) -> str:
        return (
            f"the dip comes out at {dip[place]:.1f}°, beyond vertical (accepted: -90…90): the magnetometer "
            "reads the reverse of the field, or the reference azimuths are 180° off. Check 'axes' of "
            "[magnetometer] in the tool profile, and ref_azimuth_deg."
        )

    return Flag("earth", np.isfinite(dip), sentence)


def _nowhere_on_earth(fitted: FittedRuns, name: str) -> Flag:
    """A gravity or field that no place on Earth has."""
    problem, state = fitted.result.problem, fitted.result.state
    outside = off_earth(fitted.result, name, fitted.profile.stand.coil)
    column, factor, unit = {
        "gravity": ("ref_gravity_g", 1.0, "g"),
        "field": ("ref_field_nt", 1e-3, "µT"),
    }[name]

    def sentence(place: int) -> str:
        station = int(np.argmax(outside[place]))
        value = float(problem.constant(state, name)[place, station]) * factor
        given = bool(problem.evidence.is_known(name)[place, station])
        low, high = (limit * factor for limit in EARTH_RANGES[name])
        source = f"'{column}' gives" if given else "the fit makes it"
        coil = "; of a run in a coil, say coil = true under [stand]" if name == "field" else ""
        return (
            f"no place on Earth has a {name} of {value:.4g} {unit} ({low:g}…{high:g}): {source} so. "
            f"Check {column} and its unit, and 'scale' in the tool profile{coil}."
        )

    return Flag("earth", np.any(outside, -1), sentence)


def _unexplained_errors(fitted: FittedRuns, sound: Bools) -> Flag:
    """Errors against the references that the misfit of the run does not explain.

    They are looked at in `sound` runs (B,) of which some reading is far off.
    """
    places = np.flatnonzero(straying(fitted.result) & sound).tolist()
    errors = {p: excessive_errors(fitted.alone(p)[0], fitted.member(p)) for p in places}
    flags = np.array([bool(errors.get(place)) for place in range(fitted.count)])
    relative = fitted.readings.relative

    def sentence(place: int) -> str:
        rms = errors[place]
        name = max(rms, key=lambda n: rms[n][0] / max(rms[n][1], 1e-300))
        factor, unit = shown_in(name, relative)
        first = effects(fitted.member(place))[:1]
        looks = [f" {described(each, shown_in('field', relative)[1])}" for each in first]
        gap = "" if unit == "°" else " "
        after, expected = (value * factor for value in rms[name])
        return (
            f"the errors of {name} after calibration are {after:.3g}{gap}{unit} (root mean square), where the "
            f"misfit of the run explains {expected:.2g}{gap}{unit}. Check the references of {name} and 'axes' in the "
            f"tool profile, or declare 'noise' and [stand] as they are.{''.join(looks)}"
            f"{_culprit(fitted, place)}"
        )

    return Flag("errors", flags, sentence)
