"""Refusals: what no fit could mend, and what no fit result may be trusted with."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from mwdcal.calibration.diagnosis.axes import explaining
from mwdcal.calibration.diagnosis.plausibility import (
    excessive_errors,
    gain_shares,
    is_bad,
    off_earth,
    overturned,
)
from mwdcal.calibration.diagnosis.structure import described, effects
from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.methods import EVIDENCE
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import CONSTANTS, EARTH, TRIADS, Readings
from mwdcal.calibration.residuals import shown_in
from mwdcal.calibration.soaks import soaks
from mwdcal.errors import FitError, InputError
from mwdcal.estimation.rank import Free
from mwdcal.estimation.robust import LOSSES
from mwdcal.estimation.solvers import Status
from mwdcal.estimation.uncertainty import station_misfit
from mwdcal.sensor.profile import COMMON, Profile

GAIN = (0.3, 3.0)
"""An own-axis gain outside this share of nominal is a wrong profile, not a sensor error."""
MOTION = (1e-2, 30.0)
"""A channel that moves by less or more than this share of the field has not seen the field."""


NAMED = 4
"""Most undetermined parameters that a message lists."""


ABSURD = 30.0
"""Residuals of more than this many times the declared noise mean that something is plain wrong."""
MOST = 0.3
"""Share of all misfit at which a single station is named as the cause."""
COARSE = 0.05
"""Estimated noise of more than this share of the field likewise."""


def check_fit(result: Fit, free: list[Free], profile: Profile, readings: Readings) -> None:
    """Refuse a fit that did not settle, is too weak, has no redundancy, or absurd gains."""
    for _, check in fit_checks(result, free, profile, readings):
        check()


def fit_checks(
    result: Fit, free: list[Free], profile: Profile, readings: Readings
) -> Iterator[tuple[str, Callable[[], None]]]:
    """The checks in turn, each with the status that a fleet gives to what it refuses.

    Where nothing fits, the state is anywhere: that comes before what it leaves undetermined, and
    before its gains. What a wrong axis may have caused names the axes that would fit.
    """

    def wired(check: Callable[[], None]) -> Callable[[], None]:
        return partial(_naming_axes, check, readings, profile)

    status = Status(int(result.status[0]))
    yield status.name.lower().replace("_", "-"), wired(partial(_check_status, status))
    yield "residuals", wired(partial(_check_residuals, result, readings))
    yield "weak-geometry", wired(partial(_check_geometry, free))
    yield "no-redundancy", partial(_check_freedom, result)
    yield "gain", wired(partial(_check_gains, result, profile, readings))
    yield "earth", wired(partial(_check_dip, result))
    yield "earth", partial(_check_strengths, result, profile)
    yield "errors", wired(partial(_check_errors, result, readings))


def check_options(options: Options) -> None:
    """Refuse choices that do not go together."""
    method = options.method
    if method not in EVIDENCE:
        raise InputError(f"--method must be one of {', '.join(EVIDENCE)}; got {method!r}.")
    if options.parameters not in (6, 9, 12):
        raise InputError(f"--parameters must be 6, 9 or 12; got {options.parameters}.")
    if options.robust not in (None, *LOSSES):
        raise InputError(f"--robust must be one of {', '.join(LOSSES)}; got {options.robust!r}.")
    _check_ignored(options)
    _check_curved_models(options)
    own = "the paper's weights" if options.paper_weights else f"method {method}"
    if options.own_solver and options.robust:
        raise InputError(
            f"--robust cannot weigh the stations of {own}. Use --method joint with it."
        )
    if options.own_solver and options.curved:
        raise InputError(
            f"--nonlinearity cannot be combined with {own}: own-axis terms need their prior. Use "
            "--method joint, or --nonlinearity none."
        )
    if method == "swarm" and max(options.orders):
        raise FitError(
            "method swarm finds the 12 parameters of one temperature: use --order 0 for it, or "
            "--method joint for temperature terms."
        )
    if method == "swarm" and options.parameters < 12:
        raise InputError(
            f"--parameters {options.parameters} cannot be combined with method swarm, which finds all "
            "twelve. Use --method least-squares: both meet on the same cost."
        )
    if options.paper_weights and method == "joint":
        raise InputError(
            "--paper-weights: method joint is of no paper. Name the paper's method: least-squares, "
            "swarm, newton, toolface-inclination or scalar."
        )
    if options.prior and (options.own_solver or options.curved):
        what = "own-axis nonlinearity" if options.curved else own
        raise InputError(
            f"--prior cannot be combined with {what}. Use --method joint, without "
            "--paper-weights and with --nonlinearity none."
        )


def _check_curved_models(options: Options) -> None:
    """Refuse own-axis terms of a model that has none."""
    for name, order in zip(TRIADS, options.orders, strict=True):
        if name in options.curved and options.kind(order) != "polynomial":
            raise InputError(
                f"--nonlinearity {name}: the model of factors has no own-axis terms. Use "
                "--model polynomial with it."
            )


def check_curves(readings: Readings, wanted: Sequence[str]) -> None:
    """Refuse own-axis terms of a triad that the run does not have."""
    for name in wanted:
        if getattr(readings, name) is None:
            raise InputError(
                f"--nonlinearity {name}: {readings.source} has no {name}. Leave it out."
            )


def _check_ignored(options: Options) -> None:
    """Refuse to ignore what is no strength, or with a method that says itself what it uses."""
    unknown = [name for name in options.ignore if name not in CONSTANTS]
    if unknown:
        raise InputError(f"--ignore must be of {', '.join(CONSTANTS)}; got {unknown[0]!r}.")
    if options.ignore and options.method != "joint":
        raise InputError(
            f"--ignore needs --method joint; got {options.method!r}, which says itself what it uses."
        )


def check_readings(readings: Readings, options: Options) -> None:
    """Refuse what no fit could mend, before trying."""
    check_options(options)
    method, highest = options.method, max(options.orders)
    factors = options.kind(highest) == "factors"
    size = 6 * (highest + 1) + 6 if factors else 12 * (highest + 1)
    size -= (12 - options.parameters) * (1 if factors else highest + 1)
    if 3 * readings.count < size and options.knowledge is None:
        raise FitError(
            f"{readings.source or 'the run'} has {readings.count} stations; the model has {size} "
            f"parameters per triad and needs {-(-size // 3)} or more. Add stations at other "
            f"attitudes{', or lower --order' if highest else ''}."
        )
    _check_common_errors(readings, options)
    for triad in TRIADS:
        _check_channels(readings, triad, options.knowledge is not None)
    if options.knowledge is None or options.knowledge.temperature is None:
        _check_temperature(readings, highest)
    _check_needs(readings, method)


def holds_stand(options: Options) -> bool:
    """Whether a method takes the stand as it reads: its uncertainty has no errors in common."""
    return options.method == "swarm" or options.paper_weights


def _check_common_errors(readings: Readings, options: Options) -> None:
    """Refuse declared errors that all stations share where the method cannot have them as unknowns."""
    found = [name for name in COMMON if name in readings.sd]
    if found and holds_stand(options):
        what = (
            "the paper's weights take"
            if options.paper_weights
            else f"method {options.method} takes"
        )
        raise FitError(
            f"{what} the stand as exact, and [stand] of the tool profile declares {', '.join(found)}: no "
            "uncertainty would include it. Use --method least-squares or joint without --paper-weights, or "
            "take it out of the profile."
        )


def _check_channels(readings: Readings, triad: str, prior: bool) -> None:
    """Refuse channels that are dead or cannot have seen the field; a prior needs no motion."""
    values = getattr(readings, triad)
    if values is None:
        return
    spread = np.ptp(values, axis=-2)
    where = f"{readings.source or 'the run'}: the {triad} channel on tool axis "
    for axis in np.flatnonzero(spread <= 1e-12 * np.abs(values).max()):
        raise FitError(
            f"{where}{'xyz'[axis]} does not move: the same value at all {readings.count} stations. "
            "A dead sensor, a wrong column, or all stations in one attitude; check the wiring and "
            "the columns."
        )
    name, unit = ("gravity", "g") if triad == "accelerometer" else ("field", "nT")
    known = readings.reference(name)
    if np.isnan(known).all():
        return
    share = spread / np.nanmean(known)
    least = 0.0 if prior else MOTION[0]
    for axis in np.flatnonzero((share < least) | (share > MOTION[1])):
        moves = f"{where}{'xyz'[axis]} moves by {spread[axis]:.3g} {unit} over the run, "
        scale = f"a wrong 'scale' of [{triad}] in the tool profile"
        if share[axis] < MOTION[0]:
            raise FitError(
                f"{moves}too little to calibrate it. Add stations at other inclinations and "
                f"toolfaces; if there are, look for a dead sensor, a wrong column, or {scale}."
            )
        raise FitError(
            f"{moves}more than any field explains. Look for a wrong column or cell, or {scale}."
        )


def no_temperature(order: int) -> InputError:
    """Of an order that needs temperatures where none are read."""
    return InputError(f"--order {order} needs the column 'temperature_c'; use --order 0.")


def _check_temperature(readings: Readings, order: int) -> None:
    if order == 0:
        return
    if readings.temperature is None:
        raise no_temperature(order)
    levels = int(soaks(readings.temperature).max()) + 1
    span = float(np.ptp(readings.temperature))
    if levels < order + 1 or span < 10 * order:
        raise FitError(
            f"the run spans {span:.1f} °C with {levels} temperature{'s' * (levels > 1)} more than 5 °C "
            f"apart: too little for --order {order}, which needs {order + 1} of them over {10 * order} °C or more. "
            "Add temperatures, or lower --order."
        )


NEEDS = {
    "newton": ("inclination",),
    "swarm": ("inclination", "toolface"),
    "least-squares": ("inclination", "toolface"),
    "toolface-inclination": ("inclination", "toolface"),
}
"""Reference angles that a method needs at every station."""


def _check_needs(readings: Readings, method: str) -> None:
    needed = list(NEEDS.get(method, ()))
    if method in ("least-squares", "swarm") and readings.magnetometer is not None:
        needed += ["azimuth", "dip"][: 1 + (method == "swarm")]
    for name in needed:
        blank = np.isnan(readings.reference(name))
        if blank.any():
            first = readings.labels[int(np.flatnonzero(blank)[0])]
            raise FitError(
                f"method {method} needs {', '.join(needed)} at every station; 'ref_{name}_deg' is "
                f"blank at {int(blank.sum())} of {readings.count} (first: station {first}). Fill it "
                "in, or use --method joint, which takes what is known."
            )


def _check_status(status: Status) -> None:
    if status is not Status.OK:
        raise FitError(f"the fit failed: {status.message}.")


def _check_geometry(free: list[Free]) -> None:
    """Rotations and scales may stay free; anything else is a design too weak to fit."""
    bad = [entry for entry in free if is_bad(entry)]
    if bad:
        each = [f"{TRIADS[t]} {e.id.removeprefix('weak-')}" for e in bad for t in e.triads]
        each = list(dict.fromkeys(each))
        more = f" and {len(each) - NAMED} more" if len(each) > NAMED else ""
        names = ", ".join(each[:NAMED]) + more
        raise FitError(
            f"the stations are too weak to fit the model: nothing determines {names}. Add stations "
            "at other inclinations (at least three, well apart, up and down) with six or more "
            "toolfaces each, or give more reference angles."
        )


def _check_freedom(result: Fit) -> None:
    for name, noise, freedom in zip(
        TRIADS, result.noise[0], result.analysis.freedom[0], strict=False
    ):
        if np.isfinite(noise) and freedom < 1:
            raise FitError(
                f"the {name} has no redundancy ({max(freedom, 0):.1f} degrees of freedom): its noise cannot "
                "be estimated. Add stations, or declare 'noise' in the tool profile."
            )


def _check_gains(result: Fit, profile: Profile, readings: Readings) -> None:
    for index in range(len(result.problem.triads)):
        name = TRIADS[index]
        unknown = getattr(profile, name).scale is None or (index == 1 and readings.relative)
        gain, share = (each[0] for each in gain_shares(result, index))
        for axis, value in enumerate(share if unknown else gain):
            if not GAIN[0] <= value <= GAIN[1]:
                wrong = "has the wrong sign" if value < 0 else "is far from nominal"
                raise FitError(
                    f"the {name}'s gain on tool axis {'xyz'[axis]} comes out at {value:.3g} times "
                    f"nominal and {wrong} (accepted: {GAIN[0]}…{GAIN[1]}). Check 'axes' and 'scale' "
                    f"of [{name}] in the tool profile, and the reference angles."
                )


def _check_residuals(result: Fit, readings: Readings) -> None:
    """Refuse what no error of a sensor explains: columns, references or groups are mixed up."""
    problem, analysis = result.problem, result.analysis
    for index, name in enumerate(TRIADS[: len(problem.triads)]):
        excess = float(np.sqrt(np.nan_to_num(analysis.variance_factor[0, index])))
        noise = result.noise[0, index]
        strength = np.linalg.norm(problem.triads[index].raw[0], axis=-1)
        spread = float(np.std(problem.triads[index].raw[0], axis=0).max())
        size = max(min(float(strength.mean()), 2 * spread), 1e-300)
        declared = bool(np.isnan(noise))
        absurd = excess > ABSURD if declared else noise > COARSE * size
        if absurd and analysis.freedom[0, index] >= 1:
            much = (
                f"{excess:.0f} times the declared noise"
                if declared
                else f"{noise / size:.0%} of the field"
            )
            raise FitError(
                f"the {name}'s residuals are {much}: no sensor model explains these readings. Check "
                "that columns, reference angles and groups belong to the stations they stand at, and "
                f"'axes' and 'noise' in the tool profile.{_culprit(result, readings)}"
            )


def _culprit(result: Fit, readings: Readings) -> str:
    """The station to look at first, if a single one has most of the misfit."""
    square, _ = station_misfit(result.analysis)
    worst = int(np.argmax(square[0]))
    share = square[0, worst] / max(float(square[0].sum()), 1e-300)
    if share < MOST:
        return ""
    label = readings.labels[worst]
    return (
        f" Station {label} alone has {share:.0%} of the misfit: --exclude {label}, or fit with "
        "--robust student-t."
    )


def _naming_axes(check: Callable[[], None], readings: Readings, profile: Profile) -> None:
    """A check whose refusal names the axes with which the run would fit, if there are any."""
    try:
        check()
    except FitError as error:
        each = [
            f"axes = {json.dumps(axes)} of [{name}]"
            for name, axes in explaining(readings, profile).items()
        ]
        if not each:
            raise
        raise FitError(f"{error} The run fits with {' and '.join(each)}.") from None


def _check_dip(result: Fit) -> None:
    """Refuse a dip beyond vertical: north of the field opposite to that of the azimuths."""
    dip = float(np.degrees(overturned(result)[0]))
    if np.isfinite(dip):
        raise FitError(
            f"the dip comes out at {dip:.1f}°, beyond vertical (accepted: -90…90): the magnetometer "
            "reads the reverse of the field, or the reference azimuths are 180° off. Check 'axes' of "
            "[magnetometer] in the tool profile, and ref_azimuth_deg."
        )


def _check_strengths(result: Fit, profile: Profile) -> None:
    """Refuse a gravity or field that no place on Earth has."""
    columns = {"gravity": ("ref_gravity_g", 1.0, "g"), "field": ("ref_field_nt", 1e-3, "µT")}
    for name, (column, factor, unit) in columns.items():
        outside = off_earth(result, name, profile.stand.coil)[0]
        if not outside.any():
            continue
        place = int(np.flatnonzero(outside)[0])
        value = float(result.problem.constant(result.state, name)[0, place]) * factor
        given = bool(result.problem.evidence.is_known(name)[0, place])
        low, high = (limit * factor for limit in EARTH[name])
        source = f"'{column}' gives" if given else "the fit makes it"
        coil = "; of a run in a coil, say coil = true under [stand]" if name == "field" else ""
        raise FitError(
            f"no place on Earth has a {name} of {value:.4g} {unit} ({low:g}…{high:g}): {source} so. "
            f"Check {column} and its unit, and 'scale' in the tool profile{coil}."
        )


def _check_errors(result: Fit, readings: Readings) -> None:
    """Refuse errors against the references that the misfit of the run does not explain."""
    found = excessive_errors(readings, result)
    if not found:
        return
    name = max(found, key=lambda n: found[n][0] / max(found[n][1], 1e-300))
    factor, unit = shown_in(name, readings.relative)
    seen = effects(result)[:1]
    looks = [f" {described(each, shown_in('field', readings.relative)[1])}" for each in seen]
    gap = "" if unit == "°" else " "
    after, expected = (value * factor for value in found[name])
    raise FitError(
        f"the errors of {name} after calibration are {after:.3g}{gap}{unit} (root mean square), where the "
        f"misfit of the run explains {expected:.2g}{gap}{unit}. Check the references of {name} and 'axes' in the "
        f"tool profile, or declare 'noise' and [stand] as they are.{''.join(looks)}"
        f"{_culprit(result, readings)}"
    )
