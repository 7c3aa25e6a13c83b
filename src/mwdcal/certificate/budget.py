"""The uncertainty budget of the angles by source, and the results with their expanded uncertainties.

Everything is of the calibration itself. Sources are those of `Calibration.budget`; together they are what
the covariance of the calibration gives. Reference: JCGM 100:2008, 4, 5 and G.

Repeatability of one reading, from the roll tests: scatter about the curves over toolface that were judged.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from mwdcal.calibration.readings import STAND_ANGLES_EXACT, STAND_EXACT
from mwdcal.calibration.record import (
    NOISE,
    ORDER,
    REPEATABILITY,
    SETTINGS,
    BudgetRow,
    Calibration,
    TriadCalibration,
    declared_drift,
    stated,
)
from mwdcal.calibration.results import (
    PRIOR,
    TYPICAL,
    accuracy_at,
    angles,
    error_name,
    middle_temperature,
    typical_accuracy,
)
from mwdcal.certificate.decisions import PROBABILITY, When, student_factor
from mwdcal.certificate.document import Budget, BudgetLine, Quantity, ResultTable
from mwdcal.files.verifications import Verification
from mwdcal.geometry.vectors import Array
from mwdcal.sensor.profile import PRACTICES
from mwdcal.use.roll_test import FITTED, basis
from mwdcal.use.verification import VerdictRow

ABOUT_THE_CURVE = (
    "Standard deviation of one reading about the mean and harmonics over a turn of toolface, noise of the "
    "reading and setting of the stand included; by statistics of the roll test (type A)."
)


def repeatability(tests: Mapping[When, Verification | None]) -> list[ResultTable]:
    """A table of the repeatability that roll tests show; none where no test was rolled far enough."""
    quantities = [each for when, test in tests.items() if test for each in _of_test(when, test)]
    if not quantities:
        return []
    title = "Repeatability of a reading"
    return [
        ResultTable(id="repeatability", title=title, note=ABOUT_THE_CURVE, quantities=quantities)
    ]


def _of_test(when: When, test: Verification) -> Iterator[Quantity]:
    """A quantity for each observable, by its limit on the error where there is one, else on the spread."""
    by_observable = {row.name.rpartition(" ")[2]: row for row in test.rows}
    for name, row in by_observable.items():
        squares, freedom = scatter(test, row)
        if freedom > 0:
            value = float(np.sqrt(squares / freedom))
            sd, k = value / float(np.sqrt(2 * freedom)), float(student_factor(freedom))
            yield Quantity(
                id=f"repeatability-{name}-{when.replace(' ', '-')}",
                name=f"repeatability of {name}, {when}",
                unit=row.unit,
                value=value,
                standard_uncertainty=sd,
                expanded_uncertainty=k * sd,
                coverage_factor=k,
                coverage_probability=PROBABILITY,
                at=f"{test.stations} stations, {freedom} degrees of freedom",
            )


def scatter(test: Verification, row: VerdictRow) -> tuple[float, int]:
    """Sum of squares of a row's departures about the curves of its roll sets, and its degrees of freedom.

    Definition: of a set of n stations n - 5; n - 3 of a curve of one harmonic. Reference: JCGM 100:2008, 4.2 and H.3.
    """
    squares, freedom = 0.0, 0
    for each in row.sets:
        stations = [test.station_rows[place] for place in each.stations]
        known = [s for s in stations if s.toolface_deg is not None and row.name in s.departures]
        count = len(FITTED[each.harmonics])
        if each.coefficients is None or len(known) <= count:
            continue
        turn = np.radians([s.toolface_deg for s in known if s.toolface_deg is not None])
        departures = np.array([s.departures[row.name] for s in known])
        left = departures - basis(turn) @ np.array(each.coefficients)
        squares += float(np.sum(left**2))
        freedom += len(known) - count
    return squares, freedom


STAND_ANGLES = ("inclination", "azimuth", "toolface")
"""Angles that a stand sets."""
UNDECLARED = {
    "dip reference": "dip_deg",
    "azimuth zero of the stand": "azimuth_zero_deg",
    "inclination zero of the stand": "inclination_zero_deg",
    "tilt of the stand": "tilt_deg",
}
"""Common errors that leave residuals, and the key of `[stand]` that declares each."""
INVISIBLE = "no residual tests it"
VISIBLE = "a large error of it would show in the residuals"


def budget(calibration: Calibration) -> Budget:
    """The uncertainty budget at 45° inclination: the accuracy that `calibrate` states, by source.

    Definition: root mean square over azimuth and toolface, at `middle_temperature`. The coverage factor is the
    largest of any angle.
    """
    names = angles(calibration)
    rows = calibration.budget or [_whole(calibration)]
    lines = [_line(calibration, row) for row in rows] + _exact_lines(calibration)
    sums = {
        f"{name}_deg": _root_sum_of_squares([getattr(row, f"{name}_deg") for row in rows])
        for name in names
    }
    largest = max(coverage_factors(calibration).values())
    combined = BudgetLine(
        id="combined",
        source="combined standard uncertainty",
        kind="B",
        basis="root sum of squares",
        **sums,
    )
    grown = {key: None if sd is None else largest * sd for key, sd in sums.items()}
    freedom = min(calibration.effective_freedom(name) for name in names)
    basis = f"k = {largest:.3g}, {100 * PROBABILITY:.0f} %, {freedom:.3g} degrees of freedom"
    expanded = BudgetLine(
        id="expanded", source="expanded uncertainty", kind="B", basis=basis, **grown
    )
    return Budget(
        at=attitude_in_words(TYPICAL, middle_temperature(calibration)),
        lines=lines,
        combined=combined,
        expanded=expanded,
        coverage_factor=largest,
        coverage_probability=PROBABILITY,
    )


def attitude_in_words(inclination: float, temperature: float) -> str:
    """Where an accuracy holds: an inclination, radians, and a temperature."""
    return (
        f"inclination {np.degrees(inclination):.0f}°, root mean square over azimuth and toolface, "
        f"{temperature:.1f} °C"
    )


def coverage_factors(calibration: Calibration) -> dict[str, float]:
    """Coverage factor by angle: Student's for its `effective_freedom`."""
    return {n: float(student_factor(calibration.effective_freedom(n))) for n in angles(calibration)}


def accuracy_with_factor(
    calibration: Calibration, inclination: float, temperature: float
) -> dict[str, tuple[float | None, float]]:
    """1σ in degrees and coverage factor by angle at an inclination; None: undetermined."""
    sd: dict[str, Array] = accuracy_at(calibration, [inclination], temperature=temperature)
    k = coverage_factors(calibration)
    return {name: (stated(np.degrees(value[0])), k[name]) for name, value in sd.items()}


def assumed_exact(calibration: Calibration) -> list[str]:
    """References taken as exact: those whose error no residual would show, and then the others."""
    return [line.source for line in _exact_lines(calibration)]


def _exact_lines(calibration: Calibration) -> list[BudgetLine]:
    """A line for each reference without a declared uncertainty."""
    angles_exact = {STAND_ANGLES_EXACT, *map(STAND_EXACT.format, angles(calibration))}
    invisible = [
        (name, VISIBLE if name in angles_exact else INVISIBLE) for name in calibration.assumed_exact
    ]
    visible = [(name, VISIBLE) for name in _undeclared(calibration)]
    zeros = {f"{name}_deg": 0.0 for name in angles(calibration)}
    return [
        BudgetLine(
            id=_identifier(name),
            source=name,
            kind="B",
            basis=f"assumed exact: no uncertainty is declared, and {why}",
            **zeros,
        )
        for name, why in invisible + visible
    ]


def _undeclared(calibration: Calibration) -> Iterator[str]:
    """Common errors that could show in residuals, are in use, and are neither declared nor estimated."""
    used = {row.observable for row in calibration.errors} - {*calibration.options.ignore}
    known = {constant.name for constant in calibration.constants}
    known |= {row.source for row in calibration.budget}
    estimated = {
        "azimuth zero of the stand": calibration.stand.azimuth_zero_deg,
        "inclination zero of the stand": calibration.stand.inclination_zero_deg,
        "tilt of the stand": calibration.stand.tilt_deg,
    }
    for name, key in UNDECLARED.items():
        needed = {"tilt of the stand": "inclination"}.get(name, name.partition(" ")[0])
        declared = calibration.profile.stand.of(key) or estimated.get(name) is not None
        if needed in used and not declared and not {name, f"{name} error", needed} & known:
            yield name


def _whole(calibration: Calibration) -> BudgetRow:
    """The accuracy in one row, of a calibration whose sources were not recorded."""
    accuracy = {f"{n}_deg": sd for n, sd in typical_accuracy(calibration).items()}
    return BudgetRow(source="calibration as a whole", **accuracy)


def _line(calibration: Calibration, row: BudgetRow) -> BudgetLine:
    """A source of the calibration's budget with its kind and basis."""
    redundant = all(triad.variance_factor is not None for triad in calibration.triads)
    by_statistics = row.source == ORDER or (row.source == NOISE and redundant)
    return BudgetLine(
        id=_identifier(row.source),
        source=row.source,
        kind="A" if by_statistics else "B",
        basis=_basis(calibration, row.source),
        inclination_deg=row.inclination_deg,
        toolface_deg=row.toolface_deg,
        azimuth_deg=row.azimuth_deg if calibration.has_field else None,
    )


def _basis(calibration: Calibration, source: str) -> str:
    """Where the size of a source is known from."""
    if source == NOISE:
        each = "; ".join(f"{t.name}: {t.noise_source}{_scaled(t)}" for t in calibration.triads)
        apart = any(row.source == REPEATABILITY for row in calibration.budget)
        return each if apart else f"{each}; with the repeatability of the tool during the run"
    if source == REPEATABILITY:
        return "declared in the tool profile; no less than declared"
    if source == SETTINGS:
        common = {
            PRACTICES[0]: "common to stations of one direction",
            PRACTICES[1]: "set at every station",
        }
        practice = common.get(
            str(calibration.settings), "assumed common to stations of one direction"
        )
        return f"declared for the stand{settings_in_words(calibration)}; {practice}"
    if source == ORDER:
        return "scatter of the soaks about the temperature terms"
    if source == PRIOR:
        return f"prior: {calibration.options.prior or 'declared'}"
    for drift in calibration.drift:
        if source == error_name(f"{drift.name}-drift-x"):
            return declared_drift([drift]) or "sized by the order of the residuals"
    return "declared; common to all stations"


def _scaled(triad: TriadCalibration) -> str:
    factor = triad.variance_factor
    if factor is None:
        return ", not tested by residuals"
    shown = f"s = {factor**0.5:.3g}, {triad.degrees_of_freedom:.0f} degrees of freedom"
    confirmed = triad.noise_source == "declared" and factor <= 1.0
    return f", {'not exceeded' if confirmed else 'scaled'} by the residuals ({shown})"


def settings_in_words(calibration: Calibration) -> str:
    """The declared 1σ of the stand's settings, in words that follow a noun, or empty."""
    stand = calibration.profile.stand
    sd = {n: np.hypot(stand.of(f"{n}_deg"), stand.repeatability(f"{n}_deg")) for n in STAND_ANGLES}
    declared = [f"{name} {value:.2g}°" for name, value in sd.items() if value]
    return f": {', '.join(declared)}" if declared else ""


def _root_sum_of_squares(parts: list[float | None]) -> float | None:
    """The norm of the parts; None where one is undetermined, or there are none."""
    values = [part for part in parts if part is not None]
    return float(np.linalg.norm(values)) if values and len(values) == len(parts) else None


def _identifier(name: str) -> str:
    """A name in words as an identifier."""
    return name.replace(" ", "-")
