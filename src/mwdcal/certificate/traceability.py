"""What the references of a calibration are traceable to, and whether that held on its day."""

from __future__ import annotations

from datetime import date

import msgspec

from mwdcal.calibration.readings import CONSTANTS
from mwdcal.calibration.record import Calibration
from mwdcal.certificate.budget import STAND_ANGLES, settings_in_words
from mwdcal.certificate.document import TracedStandard
from mwdcal.certificate.laboratory import Laboratory
from mwdcal.sensor.profile import MeasurementStandard


def references_in_use(calibration: Calibration) -> list[str]:
    """Quantities whose references the results rest on: the stand, gravity, field, dip, temperature."""
    known = {row.observable for row in calibration.errors}
    estimated = {constant.name for constant in calibration.constants}
    unused = (
        estimated | {*calibration.options.ignore} | ({"field"} if calibration.relative else set())
    )
    return [
        *(["stand"] if known.intersection(STAND_ANGLES) else []),
        *(name for name in CONSTANTS if name in known - unused),
        *(["temperature"] if calibration.thermal else []),
    ]


def traced(calibration: Calibration, laboratory: Laboratory, day: date) -> list[TracedStandard]:
    """The standards of profile and laboratory, which replaces one of the same quantity and name."""
    declared = calibration.profile.standards
    standards = () if isinstance(declared, msgspec.UnsetType) else declared
    named = {(each.quantity, each.name): each for each in (*standards, *laboratory.standards)}
    return [_traced(calibration, standard, day) for standard in named.values()]


def _traced(calibration: Calibration, standard: MeasurementStandard, day: date) -> TracedStandard:
    issued, due = standard.issued, standard.due
    return TracedStandard(
        quantity=standard.quantity,
        name=standard.name,
        serial=standard.serial,
        certificate=standard.certificate,
        issuer=standard.issuer,
        date=issued.isoformat() if issued else "",
        due=due.isoformat() if due else "",
        overdue=due is not None and due < day,
        standard_uncertainty=_uncertainty(calibration, standard.quantity),
    )


def _uncertainty(calibration: Calibration, quantity: str) -> str:
    """The declared 1σ of a reference in words; empty where none is."""
    stand = calibration.profile.stand
    if quantity == "stand":
        return settings_in_words(calibration).removeprefix(": ")
    units = {"gravity": "g", "field": "nT", "dip": "°"}
    sd = getattr(
        stand,
        {"field": "field_nt", "gravity": "gravity_g", "dip": "dip_deg"}.get(quantity, ""),
        0.0,
    )
    unit = units.get(quantity, "")
    return f"{sd:.2g}{'' if unit == '°' else ' '}{unit}" if sd else ""
