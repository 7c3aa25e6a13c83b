"""Conditions and results of a calibration as quantities with their expanded uncertainties."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np

from mwdcal.calibration.prediction import TYPICAL, middle_temperature
from mwdcal.calibration.readings import NANOTESLA
from mwdcal.calibration.record import Calibration, TriadCalibration
from mwdcal.calibration.results import error_name
from mwdcal.certificate.budget import accuracy_with_factor, attitude_in_words
from mwdcal.certificate.decisions import PROBABILITY, student_factor
from mwdcal.certificate.document import Quantity, ResultTable
from mwdcal.certificate.laboratory import Laboratory
from mwdcal.geometry.observables import TITLES
from mwdcal.use.verification import fewest_degrees_of_freedom

STATED_INCLINATIONS = (float(np.radians(5.0)), TYPICAL, float(np.radians(90.0)))
"""Inclinations at which the accuracy of the angles is stated."""
ONE = "1"
"""Unit of a number."""
NUMBERS = ("gain", "scale", "misalignment")
"""Parameters without a unit, unless the triad is curved; all others have the unit of the field."""
AT_THE_PLACE = {
    "gravity": ("gravity", "gravity_g", "g", "gravity_g"),
    "field": ("strength of the magnetic field", "field", "nT", "field_nt"),
    "dip": ("dip of the magnetic field", "dip_deg", "°", "dip_deg"),
}
"""Title, key in `Calibration.earth`, unit, and key of `[stand]`, of what the place of the calibration had."""


def expanded(
    name: str,
    title: str,
    unit: str,
    value: float | None,
    sd: float | None,
    k: float | None,
    at: str = "",
) -> Quantity:
    """A quantity with standard and expanded uncertainty; without either where `sd` is None."""
    known = sd is not None and k is not None
    return Quantity(
        id=name,
        name=title,
        unit=unit,
        value=value,
        standard_uncertainty=sd,
        expanded_uncertainty=k * sd if sd is not None and k is not None else None,
        coverage_factor=k if known else None,
        coverage_probability=PROBABILITY if known else None,
        at=at,
    )


def conditions(calibration: Calibration, laboratory: Laboratory) -> list[Quantity]:
    """Temperatures of the run, gravity, field and dip at the place, and what the laboratory states beside."""
    normal = float(student_factor(np.inf))
    return [
        *_temperatures(calibration),
        *_place(calibration),
        *(
            expanded(f"condition-{i}", c.name, c.unit, c.value, c.uncertainty, normal)
            for i, c in enumerate(laboratory.conditions, 1)
        ),
    ]


def _temperatures(calibration: Calibration) -> Iterator[Quantity]:
    names = ("lowest", "highest")
    for name, value in zip(names, calibration.temperature_c or (), strict=False):
        yield Quantity(
            id=f"temperature-{name}", name=f"{name} tool temperature", unit="°C", value=value
        )


def _place(calibration: Calibration) -> Iterator[Quantity]:
    """Gravity, field and dip: estimated ones with the uncertainty of the estimate, others as declared.

    The coverage factor is Student's of the residuals where more is known by the readings than was declared.
    """
    fewest = fewest_degrees_of_freedom(calibration)
    constants = {constant.name: constant for constant in calibration.constants}
    for name, (title, key, unit, declared) in AT_THE_PLACE.items():
        if key not in calibration.earth or (name == "field" and calibration.relative):
            continue
        estimated, shared = constants.get(name), constants.get(error_name(name))
        sd = next((c.standard_uncertainty for c in (estimated, shared) if c), None)
        words = f"{title}, estimated" if estimated else title
        most = calibration.profile.stand.of(declared) ** 2 / 2
        by_readings = estimated or (shared and shared.standard_uncertainty**2 < most)
        k = float(student_factor(fewest if by_readings else np.inf))
        yield expanded(name, words, unit, calibration.earth[key], sd, k)


def result_tables(calibration: Calibration) -> list[ResultTable]:
    """Errors before and after, accuracy of the angles, and the parameters of each triad."""
    return [
        *([_errors(calibration)] if calibration.errors else []),
        _accuracy(calibration),
        *(_parameters(calibration, triad) for triad in calibration.triads),
    ]


def _errors(calibration: Calibration) -> ResultTable:
    """Root mean square errors of the stations before and after adjustment."""
    quantities = [
        Quantity(
            id=f"{row.observable}-{when}",
            name=f"error of {TITLES.get(row.observable, row.observable)}, rms, {when} adjustment",
            unit=row.unit,
            value=getattr(row, when),
        )
        for row in calibration.errors
        for when in ("before", "after")
    ]
    note = (
        f"{calibration.stations} stations. Before: with nominal scales and no bias or misalignment; after: "
        "with the parameters of this certificate, in the stations that they were fitted to."
    )
    return ResultTable(
        id="errors", title="Errors before and after adjustment", note=note, quantities=quantities
    )


def _accuracy(calibration: Calibration) -> ResultTable:
    """The error of each angle that a corrected reading has through the calibration: zero, with its uncertainty."""
    middle = middle_temperature(calibration)
    warm = dict.fromkeys(
        [middle, *(calibration.temperature_c or ())] if calibration.thermal else [middle]
    )
    quantities = []
    for temperature, inclination in product(sorted(warm), STATED_INCLINATIONS):
        each = accuracy_with_factor(calibration, inclination, temperature)
        at = attitude_in_words(inclination, temperature)
        for name, (sd, k) in each.items():
            place = f"{np.degrees(inclination):.0f}" + (
                f"-{temperature:.1f}c" if len(warm) > 1 else ""
            )
            value = None if sd is None else 0.0
            title = f"error of {name} after correction"
            quantities.append(expanded(f"{name}-{place}", title, "°", value, sd, k, at))
    note = "Of the calibration alone: the noise of a reading is not part of it."
    return ResultTable(
        id="accuracy", title="Accuracy of corrected angles", note=note, quantities=quantities
    )


def _parameters(calibration: Calibration, triad: TriadCalibration) -> ResultTable:
    """The parameters of a triad; none that the model holds at zero, and no value of an undetermined one."""
    k = float(student_factor(triad.freedom_of_noise))
    quantities, held = [], []
    columns = (triad.parameter_names, triad.parameters, triad.standard_uncertainties)
    for name, value, sd in zip(*columns, strict=True):
        if sd == 0 and value == 0:
            held.append(name)
            continue
        title, unit = parameter_in_words(triad, name)
        quantities.append(expanded(name, title, unit, None if sd is None else value, sd, k))
    notes = [
        f"Model {triad.model} of order {triad.order}, reference temperature "
        f"{calibration.reference_temperature:g} °C; {triad.rank} of {triad.size} parameters determined, "
        f"{triad.degrees_of_freedom:.0f} degrees of freedom.",
        *(f"{each.text}." for each in triad.undetermined),
        *([f"Held at zero by the model: {', '.join(held)}."] if held else []),
    ]
    title = f"Parameters of the {triad.name}"
    return ResultTable(id=triad.name, title=title, note=" ".join(notes), quantities=quantities)


def parameter_in_words(triad: TriadCalibration, name: str) -> tuple[str, str]:
    """A parameter's name without its power of temperature, and its unit.

    `gain-xy·2` is the coefficient of (T - reference)² in the gain of x by y, in 1/°C².
    """
    base, _, power = name.partition("·")
    kind = base.rpartition("-")[0]
    plain = triad.unit not in ("g", NANOTESLA) or (kind in NUMBERS and not triad.curved)
    unit = ONE if plain else triad.unit
    per = {"": "", "0": "", "1": "/°C"}.get(power, f"/°C{power}")
    title = base.replace("-", " ", 1)
    return (f"{title}, per (T − reference)^{power}" if per else title), unit + per
