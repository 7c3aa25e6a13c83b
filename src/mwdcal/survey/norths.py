"""The norths that azimuths of a well count from, and how uncertain the declination is."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot, radians

import numpy as np

from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.errors import InputError
from mwdcal.files.contract import REFERENCES, check_near_misses, stated_norths
from mwdcal.files.formats.columns import shown
from mwdcal.files.formats.table import Table
from mwdcal.survey.place.references import EarthReference, declination_sd

SD_KEY = "sd_declination_deg"
"""Metadata key of a table: standard uncertainty (1σ) of its declination, degrees."""
FARTHEST_NORTH = 2.0
"""Standard uncertainties beyond which table and reference disagree."""
LARGEST_TURN = 0.01
"""Convergences of table and reference that differ by more disagree, degrees."""
USUAL_HORIZONTAL = 20_000.0
"""Horizontal field where neither a reference nor a reading states one, nT."""


@dataclass(frozen=True)
class North:
    """The norths that azimuths may count from, radians: true = magnetic + declination, grid = true - convergence.

    None: not known. `declination_sd`: standard uncertainty that the stations share, `declination_noise` that of
    what changes from one to the next. `findings`: where they are assumed, or sources disagree.
    """

    declination: float | None = None
    declination_sd: float = 0.0
    convergence: float | None = None
    declination_noise: float = 0.0
    findings: tuple[Finding, ...] = ()

    @property
    def name(self) -> str:
        """The north of the well path: grid if it is known, else true, else magnetic."""
        if self.declination is None:
            return "magnetic"
        return "true" if self.convergence is None else "grid"

    @property
    def declination_uncertainty(self) -> float:
        """Standard uncertainty of the declination at one station."""
        return hypot(self.declination_sd, self.declination_noise)

    @property
    def offset(self) -> float:
        """What is added to magnetic azimuths to count from that north."""
        return (self.declination or 0.0) - (self.convergence or 0.0)


def norths_of(
    table: Table, readings: Readings, calibration: Calibration, reference: EarthReference | None
) -> North:
    """What metadata and reference say of declination and convergence.

    A declination whose table states no uncertainty has that of the reference, else that of a global field model.

    Raises:
        InputError: an uncertainty that cannot be.
    """
    stated = stated_norths(table.metadata, table.source)
    of_place = {} if reference is None else {
        "declination_deg": reference.declination_deg, "convergence_deg": reference.convergence_deg
    }  # fmt: skip
    both = {**of_place, **stated}
    if both.get("declination_deg") is None:
        return North(convergence=_radians(both.get("convergence_deg")))
    shared, alone = _of_place(readings, calibration, reference)
    given = _stated_sd(table)
    sd = given or shared
    findings = []
    if "declination_deg" in stated and not given:
        source = "the reference" if reference else "a global field model"
        text = (
            f"{table.source} states a declination without uncertainty: {sd:.2f}° (1σ) of {source} is taken. State "
            f"{SD_KEY}."
        )
        findings.append(Finding(id="declination-uncertainty-assumed", text=text))
    if reference is not None:
        findings += _disagreements(table, stated, reference, hypot(given, shared))
    return North(
        _radians(both["declination_deg"]),
        radians(sd),
        _radians(both.get("convergence_deg")),
        radians(alone),
        tuple(findings),
    )


def _radians(angle: float | None) -> float | None:
    return None if angle is None else radians(angle)


def _of_place(
    readings: Readings, calibration: Calibration, reference: EarthReference | None
) -> tuple[float, float]:
    """1σ of the declination that all stations share, and of each its own, by reference or model, degrees."""
    if reference is not None and reference.sd_declination_deg:
        return reference.sd_declination_deg, reference.sd_random_declination_deg
    if reference is not None:
        return declination_sd(reference.field_nt * np.cos(radians(reference.dip_deg)))
    return declination_sd(_horizontal(readings, calibration))


def _horizontal(readings: Readings, calibration: Calibration) -> float:
    """The horizontal field by the references of the readings, else by the readings themselves, nT."""
    known = readings.reference("field") * np.cos(readings.reference("dip"))
    if np.isnan(known).all() and calibration.has_field and readings.magnetometer is not None:
        g, b = calibration.fields(readings)
        known = np.linalg.norm(np.cross(g, b), axis=-1) / np.linalg.norm(g, axis=-1)
        known = np.full(1, np.nan) if calibration.relative else known
    return USUAL_HORIZONTAL if np.isnan(known).all() else float(np.nanmedian(known))


def _stated_sd(table: Table) -> float:
    """1σ of the declination that the table states, degrees; 0 where it states none."""
    check_near_misses(list(table.metadata), (SD_KEY,), f"{table.source}: metadata")
    value = table.metadata.get(SD_KEY, 0.0)
    number = float(value) if isinstance(value, int | float) else float("nan")
    limits = REFERENCES["dip"].uncertainty
    if isinstance(value, bool) or not limits.low <= number <= limits.high:
        raise InputError(
            f"{table.source}, metadata '{SD_KEY}': must be {limits}; got {shown(value)}. State the standard "
            "uncertainty (1σ) of the declination."
        )
    return number


def _disagreements(
    table: Table, stated: dict[str, float], reference: EarthReference, sd: float
) -> list[Finding]:
    """Declination and convergence of the table that are not those of the reference, `sd` of their difference."""
    findings = []
    for key, allowed, plus_minus in (
        ("declination_deg", FARTHEST_NORTH * sd, f" ± {sd:.2f}°"),
        ("convergence_deg", LARGEST_TURN, ""),
    ):
        other, name = getattr(reference, key), key.removesuffix("_deg")
        if key not in stated or other is None:
            continue
        off = (stated[key] - other + 180.0) % 360.0 - 180.0
        if abs(off) > allowed:
            text = (
                f"{name}: {table.source} states {stated[key]:+.2f}°, the reference {other:+.2f}°: they differ by "
                f"{off:+.2f}°{plus_minus}. The table's is used. Check sign, place and date."
            )
            findings.append(Finding(id=f"{name}-disagrees", text=text))
    return findings
