"""The result of a plan: the calibration of a nominal tool that reads without noise."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
from msgspec.structs import replace as with_fields

from mwdcal.calibration.automatic.auto import Choice, choose
from mwdcal.calibration.calibrate import recorded
from mwdcal.calibration.estimate import Fit, fit
from mwdcal.calibration.options import AUTO, Options
from mwdcal.calibration.readings import HIGHEST, TRIADS, Readings
from mwdcal.calibration.readings import highest_order as carried_order
from mwdcal.calibration.record import Calibration, Finding, Undetermined
from mwdcal.errors import FitError, InputError
from mwdcal.estimation.problem import ANGLES, EARTH
from mwdcal.files.contract import REFERENCES, channels
from mwdcal.files.formats.table import Table
from mwdcal.files.runs import check_references, from_readings, to_readings
from mwdcal.geometry.vectors import Array, reference_vectors
from mwdcal.planning.plans import Earth, attitudes
from mwdcal.sensor.profile import USUAL_NOISE, Profile, TriadProfile

STILL = 1e-6
"""A channel that moves by no more than this share of gravity or field over a plan does not move."""
NOISE_RANGE = {"accelerometer": (1e-9, 1.0, "g"), "magnetometer": (1e-4, 1e5, "nT")}
"""Noise that a sensor of these can have, and its unit: not less than the best one, not more than what it measures."""


def _with_noise(profile: Profile, kind: str) -> Profile:
    """A profile with noise of a triad: its own, else that of a servo instrument; refuses without scale and noise."""
    triad: TriadProfile = getattr(profile, kind)
    if triad.noise is None and triad.scale is None:
        default = " (the default without `tool`)" if profile.name == "generic" else ""
        raise InputError(
            f"the profile '{profile.name}'{default} does not state the noise of the {kind}, on which every "
            f"uncertainty rests. Add 'noise' to its [{kind}], which mwdcal noise measures; or name a calibration of "
            "the tool by `tool`, which has estimated it."
        )
    noise = USUAL_NOISE[kind] * (triad.scale or 1.0) if triad.noise is None else triad.noise
    return with_fields(profile, **{kind: with_fields(triad, noise=noise)})


def assumed_noise(profile: Profile) -> list[Finding]:
    """That a plan or a simulation takes the noise of a servo instrument, where the profile does not state it."""
    kinds = [k for k in channels(profile.has_magnetometer) if getattr(profile, k).noise is None]
    sizes = [
        f"{1e3 * USUAL_NOISE[k]:g} mg" if k == TRIADS[0] else f"{USUAL_NOISE[k]:g} nT"
        for k in kinds
    ]
    text = (
        f"the profile '{profile.name}' does not state the noise of the {' and '.join(kinds)}; assumed is that of a "
        f"servo instrument, {' and '.join(sizes)}. Name a calibration of the tool by `tool`: it brings the tool's own."
    )
    return [Finding(id="noise-assumed", text=text)] if kinds else []


def temperature_terms_lost(tool: Calibration, planned: Calibration) -> list[Finding]:
    """That a plan gives no temperature terms, where the calibration of the tool has them; and the plan that does."""
    if not tool.thermal or planned.thermal or tool.temperature_c is None:
        return []
    low, high = tool.temperature_c
    levels = np.linspace(low, high, max(triad.order for triad in tool.triads) + 2)
    text = (
        f"the calibration that `tool` names has temperature terms, {low:.1f}…{high:.1f} °C, and this plan gives none. "
        f"To get them, name a plan file with temperature_c = [{', '.join(f'{each:.0f}' for each in levels)}] by `plan` "
        "(docs, 'Planning')."
    )
    return [Finding(id="temperature-terms-lost", text=text)]


def drift_unforeseen(tool: Calibration) -> list[Finding]:
    """That the run of a calibration drifted by more than it declares, which no plan from it includes."""
    sizes = [
        f"{each.name} {each.change:.2g} {each.unit} (1σ {each.standard_uncertainty:.2g} {each.unit})"
        for each in tool.drift
        if each.declared is msgspec.UNSET
    ]
    text = (
        f"the run of the calibration that `tool` names seems to have drifted: {', '.join(sizes)}. A plan does not "
        "foresee it: a run that drifts as much will be less accurate than planned."
    )
    return [Finding(id="drift-unforeseen", text=text)] if sizes else []


def _check_scale(profile: Profile, kind: str) -> None:
    """Refuse noise that no sensor has, as by a scale that is upside down."""
    triad: TriadProfile = getattr(profile, kind)
    (least, most, unit), scale = NOISE_RANGE[kind], triad.scale
    if triad.noise and scale is not None and not least <= triad.noise / scale <= most:
        raise InputError(
            f"the profile '{profile.name}', [{kind}]: noise {triad.noise:g} with scale {scale:g} is "
            f"{triad.noise / scale:.2g} {unit}; a sensor has from {least:g} to {most:g} {unit}. Scale is in raw units "
            f"per {unit}: is it upside down ({1 / scale:.4g})?"
        )


def nominal_run(plan: Table, profile: Profile) -> tuple[Readings, Profile]:
    """The readings of a nominal tool at the stations of a plan, with the noise and the stand of a profile.

    Where the plan does not state gravity, field or dip they are those of `Earth`. A profile that says nothing of a
    magnetometer is of a tool without one; noise that it does not state is that of a servo instrument.

    Raises:
        InputError: the plan does not state an attitude, or the profile neither scale nor noise of a triad.
    """
    for kind in channels(profile.has_magnetometer):
        profile = _with_noise(profile, kind)
    known = check_references(plan, profile, [])
    attitudes(plan)
    known |= dict(zip(EARTH, planned_earth(plan), strict=True))
    gravity, field = reference_vectors(*(known[name] for name in (*ANGLES, *EARTH)))
    read = Readings(gravity, field if profile.has_magnetometer else None, known=known)
    nominal = from_readings(read, profile)
    columns = {**nominal.columns, **plan.columns}
    whole = replace(plan, columns=columns, metadata={**plan.metadata, "simulated": True})
    return to_readings(whole, profile)


def planned_earth(plan: Table) -> list[Array]:
    """Gravity, g, field, nT, and dip, radians, at each station (n,) of a plan; blank cells take the mean."""
    earth = []
    for name, usual in Earth()._asdict().items():
        reference = REFERENCES[name]
        given = np.asarray(plan.columns.get(reference.column, np.full(plan.count, np.nan)), float)
        blank = np.isnan(given)
        stated = given[~blank] * reference.factor
        earth.append(
            np.where(blank, stated.mean() if stated.size else usual, given * reference.factor)
        )
    return earth


def highest_order(temperature: Array | None) -> int:
    """The highest order of temperature terms that a plan's temperatures (n,) carry, °C; None: it states none."""
    return 0 if temperature is None else min(HIGHEST, int(carried_order(temperature)))


def planned_fit(
    plan: Table, profile: Profile, options: Options | None = None
) -> tuple[Choice, Fit]:
    """The fit of a plan's noise-free readings: its information is that of the plan.

    Nothing is to be seen in such readings: an order of "auto" is the highest that the temperatures carry, and
    own-axis terms are those that the options name.
    """
    options = options or Options()
    readings, scaled = nominal_run(plan, profile)
    for kind in channels(profile.has_magnetometer):
        _check_scale(profile, kind)
    _check_moves(readings)
    if options.order == AUTO:
        options = replace(options, order=highest_order(readings.temperature))
    if options.nonlinearity == AUTO:
        options = replace(options, nonlinearity=())
    choice = choose(readings, scaled, options, lambda _: None)
    result = fit(choice.readings, choice.options)
    one = np.ones_like(result.analysis.variance_factor)
    return choice, replace(result, analysis=replace(result.analysis, variance_factor=one))


def _check_moves(readings: Readings) -> None:
    """Refuse a plan at all of whose stations a channel reads the same."""
    for triad, strength in zip(readings.triads, EARTH, strict=False):
        moved = np.ptp(getattr(readings, triad), axis=0) / readings.known[strength].max()
        for axis in (axis for axis, share in zip("xyz", moved, strict=True) if share < STILL):
            raise FitError(
                f"{readings.source}: the {triad} on tool axis {axis} would read the same at all {readings.count} "
                "stations, and nothing could be learnt of it. Add stations at other inclinations and toolfaces."
            )


def expected(plan: Table, profile: Profile, options: Options | None = None) -> Calibration:
    """The calibration that a plan will give, but for its values: uncertainties, rank, accuracy to expect.

    Its parameters are those of a nominal tool, its residuals zero, and it is marked as simulated. What real
    tools depart from nominal, a few per cent, their uncertainties depart from these. Its findings are those of
    `calibrate`.

    Raises:
        InputError: the plan does not state an attitude, or the profile neither scale nor noise of a triad.
        FitError: no calibration can come of the plan; the message says what to add.
    """
    return carried_out(plan, profile, options)[0]


def carried_out(
    plan: Table, profile: Profile, options: Options | None = None
) -> tuple[Calibration, Fit]:
    """The calibration that a plan will give, as `expected`, and the fit that it is the record of."""
    choice, result = planned_fit(plan, profile, options)
    return recorded(choice, result), result


def left_undetermined(calibration: Calibration) -> list[Undetermined]:
    """Undetermined directions of a plan, with a remedy: it states every reference, and not every method uses them."""
    entries = calibration.undetermined()
    if calibration.method == "joint":
        return entries
    advice = f"Method {calibration.method} does not use the reference that would fix it; joint does"
    return [with_fields(each, text=f"{each.text.partition('. ')[0]}. {advice}") for each in entries]
