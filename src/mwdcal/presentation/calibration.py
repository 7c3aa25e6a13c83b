"""A calibration on the screen and for machines: one screen that a technician can act on."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from mwdcal.calibration.automatic.auto import CurveScore
from mwdcal.calibration.diagnosis.flags import listed
from mwdcal.calibration.fit_options import unusual
from mwdcal.calibration.options import ASSUMED, ASSUMED_PRACTICE
from mwdcal.calibration.readings import serial_of, simulated
from mwdcal.calibration.record import (
    ALIGNMENT,
    LEAN,
    BudgetRow,
    Calibration,
    Constant,
    Drift,
    ErrorRow,
    Finding,
    FitSettings,
    Measures,
    OrderScore,
    StandErrors,
    Undetermined,
    UnseenDrift,
    blindness,
    declared_drift,
    exact_and_steady,
)
from mwdcal.calibration.results import typical_accuracy, without_temperature
from mwdcal.errors import shell_word
from mwdcal.files import documents
from mwdcal.files.contract import AZIMUTH_KEYS
from mwdcal.geometry.observables import TITLES
from mwdcal.presentation.envelope import json_document
from mwdcal.presentation.numbers import (
    degrees_of_freedom,
    estimate,
    files_written,
    norths,
    number,
    quantity,
    uncertainty,
)
from mwdcal.presentation.text import chance, one_line, table
from mwdcal.presentation.typed import findings_with_option_names

if TYPE_CHECKING:
    from mwdcal.use.verification import Verdict

MOST_EXCLUDED = 20
"""Most stations left out of the fit that the screen names."""
VALID = "good for {:.1f}…{:.1f} °C: beyond, results are blank (--outside of apply)"
"""The temperatures of readings."""
NEXT_ROLL_TEST = "ROLLTEST.csv"
"""The file of a roll test that is still to be made, in the next commands."""
PLACE = "1σ, calibration alone, at 45° inclination"
"""The conditions of the accuracy to expect."""
MEANING = (
    "Undetermined: any value of it fits this run equally well, so it has no uncertainty, and no limit that needs it "
    "passes (docs, 'Glossary')."
)
"""The meaning of the word on the lines above."""
PROFILE = " (see [stand] of the tool profile)"
ORDERS = "error: rms per axis, with the noise; inside: interpolation, at the ends: extrapolation"
COMPARED = """
by chance: probability that noise alone gives such a term; chosen: the lowest order above which \
none is below 0.001"""
"""The meaning of the table of orders, and where orders were compared."""


class TriadSummary(msgspec.Struct, frozen=True, kw_only=True):
    """A triad as the summary states it: the fields of `TriadCalibration` without its parameters."""

    model: str
    order: int
    rank: int
    size: int
    undetermined: list[Undetermined]
    variance_factor: float | None
    degrees_of_freedom: float
    misfit_probability: float | None


class CalibrationSummary(msgspec.Struct, frozen=True, kw_only=True):
    """The output of `calibrate`: fields of `Calibration`, accuracy, comparisons, and the files written."""

    run: str
    sheet: str | msgspec.UnsetType = msgspec.UNSET
    stations: int
    excluded: list[str]
    temperature_c: tuple[float, float] | None
    method: str
    options: FitSettings
    seed: int | None
    triads: dict[str, TriadSummary]
    errors: list[ErrorRow]
    measures: list[Measures]
    accuracy_1sigma_deg: dict[str, float | None]
    budget: list[BudgetRow]
    assumed_exact: list[str]
    unseen: list[UnseenDrift] | msgspec.UnsetType = msgspec.UNSET
    constants: list[Constant]
    drift: list[Drift]
    stand: StandErrors
    findings: list[Finding]
    orders: list[OrderScore]
    nonlinearity: list[CurveScore]
    calibration: str
    report: str
    verification: dict[str, Any] | msgspec.UnsetType = msgspec.UNSET
    """The document of `verify` on the roll test, without its head."""


def _recorded(kind: type[msgspec.Struct], record: msgspec.Struct) -> dict[str, Any]:
    """The fields of a summary that the record has too."""
    names = {*kind.__struct_fields__} & {*record.__struct_fields__}
    return {name: getattr(record, name) for name in names}


def summary(
    calibration: Calibration,
    tried: list[CurveScore],
    output: Path | None,
    report: Path | None,
    verdict: Verdict | None = None,
) -> dict[str, Any]:
    """The result for machines, with the verdict of a roll test if there was one."""
    findings = findings_with_option_names(calibration.findings)
    content = CalibrationSummary(
        **{**_recorded(CalibrationSummary, calibration), "findings": findings},
        triads={t.name: TriadSummary(**_recorded(TriadSummary, t)) for t in calibration.triads},
        accuracy_1sigma_deg=typical_accuracy(calibration),
        nonlinearity=tried,
        calibration=str(output or ""),
        report=str(report or ""),
        verification=msgspec.to_builtins(verdict) if verdict else msgspec.UNSET,
    )
    return json_document(
        "calibrate",
        content,
        calibration.tool,
        run=calibration.run_sha256,
        profile=calibration.profile_sha256,
        prior=calibration.prior_sha256 or "",
    )


def body(calibration: Calibration, tried: list[CurveScore]) -> str:
    """The calibration for people, with the own-axis terms that were tried."""
    blocks = [
        heading(calibration),
        *([orders(calibration.orders)] if calibration.orders else []),
        *([curves(tried)] if tried else []),
        errors(calibration.errors),
        *remarks(calibration),
    ]
    return "\n\n".join(blocks)


def screen(
    calibration: Calibration,
    tried: list[CurveScore],
    output: Path,
    report: Path | None,
    judged: tuple[str, str] = ("", ""),
    rolltest: Path | None = None,
) -> str:
    """The result for people, the files that were written, and what to do next.

    `judged`: the verdict of a roll test, which comes first, and what to do after it.
    """
    what = "calibration"
    if output.exists():
        serial = documents.serial_in(output)
        other = serial and serial != serial_of(calibration.tool)
        what += f", in place of {f'that of {serial}' if other else 'an earlier file'}"
    files = [files_written(**{what: output})]
    if report:
        files.append(files_written(report=report))
    verdict, step = judged
    if not verdict:
        tested = shell_word(str(rolltest or NEXT_ROLL_TEST))
        step = "\n" + one_line(f"next: mwdcal verify {shell_word(str(output))} {tested}")
    ending = "\n".join(files) + step
    return "\n\n".join([*filter(None, [verdict]), body(calibration, tried), ending])


def remarks(calibration: Calibration) -> list[str]:
    """Size of the residuals, accuracy to expect, and estimated constants; below, what the run cannot show."""
    exact = ", ".join(exact_and_steady(calibration.assumed_exact)[0])
    lean, _, *included = unseen_remarks(calibration)
    shown = [
        *residuals(calibration),
        *(north_in_words(calibration) if AZIMUTH_KEYS[0] in calibration.tool else []),
        f"accuracy to expect ({PLACE}): {'  '.join(accuracy_in_words(calibration))}",
        *([MEANING] if any(t.undetermined for t in calibration.triads) else []),
        *([VALID.format(*valid)] if (valid := calibration.valid_temperatures) else []),
        *included,
        *(
            f"estimated constant of the run: {c.name} {estimate(c.value, c.standard_uncertainty, c.unit)}"
            for c in calibration.constants
        ),
        *stand(calibration),
    ]
    hidden = [
        f"Assumed exact; this run cannot check it: {exact}{PROFILE}" if exact else "",
        lean,
        *steadiness(calibration),
        ASSUMED if calibration.settings == ASSUMED_PRACTICE else "",
    ]
    return ["\n".join(filter(None, lines)) for lines in (shown, hidden) if any(lines)]


def north_in_words(calibration: Calibration) -> list[str]:
    """A line on the declination, and the convergence, that turned the azimuths of the run magnetic."""
    stated = norths(calibration.tool, calibration.profile.form.north)
    angles = ", ".join(f"{name} {angle} ({source})" for name, angle, source in stated)
    kind = calibration.tool.get(AZIMUTH_KEYS[0])
    return [f"azimuths of the run from {kind} north: {angles}"]


def steadiness(calibration: Calibration) -> list[str]:
    """Blocks of lines on the drifts that a run would not show, and on their effect; or blank."""
    _, steady = exact_and_steady(calibration.assumed_exact)
    unseen = blindness(calibration.unseen).replace(": ", ":\n  ", 1).replace("; ", "\n  ")
    return [steady.replace(". ", ".\n  "), unseen]


def unseen_remarks(calibration: Calibration) -> list[str]:
    """Lines on a tool that leans and a drift, which no residual shows, and on drifts declared or possible; or blank."""
    lean = LEAN if ALIGNMENT in calibration.assumed_exact else ""
    drifts = (
        blindness(calibration.unseen),
        declared_drift(calibration.drift),
        _possible(calibration),
    )
    return [lean, *drifts]


def _possible(calibration: Calibration) -> str:
    """A sentence on drifts that the fit allows for and no finding names, or blank."""
    named = {finding.id for finding in calibration.findings}
    sizes = [
        f"{each.name} {estimate(each.change, each.standard_uncertainty, each.unit)}"
        for each in calibration.drift
        if each.declared is msgspec.UNSET and f"{each.name}-drift" not in named
    ]
    words = "a possible drift within the run (noise alone shows one in a fifth to a third of steady runs), which the "
    words += "uncertainty includes and a plan does not foresee"
    return f"{words}: {', '.join(sizes)}" if sizes else ""


def heading(calibration: Calibration) -> str:
    """Tool, run, method and rank of a calibration."""
    inclinations = known_inclinations(calibration)
    parts = [calibration.run_name, calibration.tool_name, f"{calibration.stations} stations"]
    if calibration.temperature_c:
        parts.append("{:.1f}–{:.1f} °C".format(*calibration.temperature_c))
    else:
        parts.append(without_temperature(calibration))
    parts.append(f"I {min(inclinations):.0f}–{max(inclinations):.0f}°")
    parts += simulated(calibration.tool)
    ranks = [
        f"{t.name} {t.rank} of {t.size} determined, {degrees_of_freedom(t.degrees_of_freedom)}"
        for t in calibration.triads
    ]
    lines = ["   ".join(parts), "   ".join([f"method {', '.join(how(calibration))}", *ranks])]
    if calibration.excluded:
        lines.append(f"left out of the fit: station {listed(calibration.excluded, MOST_EXCLUDED)}")
    return "\n".join(map(one_line, lines))


def accuracy_in_words(calibration: Calibration) -> list[str]:
    """1σ to expect of the calibration alone, by angle."""
    accuracy = typical_accuracy(calibration).items()
    return [f"{name} {uncertainty(sd)}{'°' * (sd is not None)}" for name, sd in accuracy]


def known_inclinations(calibration: Calibration) -> list[float]:
    """Inclinations of the stations that have one, degrees."""
    rows = calibration.station_rows
    return [row.inclination_deg for row in rows if row.inclination_deg is not None]


def how(calibration: Calibration) -> list[str]:
    """Method, model, and what was asked for beyond them."""
    return [calibration.method, model(calibration), *unusual(calibration.options, "heading")]


def model(calibration: Calibration) -> str:
    """Model and temperature order, of each triad where they differ."""
    models = {t.name: f"{t.model} of order {t.order}" for t in calibration.triads}
    if len(set(models.values())) == 1:
        return models["accelerometer"]
    return ", ".join(f"{name}: {model}" for name, model in models.items())


def errors(rows: list[ErrorRow]) -> str:
    """Errors before and after, with what was to be expected."""
    cells = [
        [f"{TITLES.get(row.observable, row.observable)} error, rms"]
        + [quantity(value, row.unit, uncertainty=row.expected) for value in (row.before, row.after)]
        + [quantity(row.expected, row.unit, 2)]
        for row in rows
    ]
    return table(cells, ["", "before", "after", "1σ expected"])


def residuals(calibration: Calibration) -> list[str]:
    """The size of the residuals over the declared noise, and how likely it is, where it is declared."""
    each = [
        f"{t.name} {number((t.variance_factor or 0.0) ** 0.5)} (chance {chance(t.misfit_probability)})"
        for t in calibration.triads
        if t.misfit_probability is not None
    ]
    return [f"residuals over declared noise, s: {'   '.join(each)}"] if each else []


def stand(calibration: Calibration) -> list[str]:
    """Estimated errors of the stand."""
    errors, lines = calibration.stand, []
    for name in ("azimuth", "inclination"):
        zero = getattr(errors, f"{name}_zero_deg")
        if zero is not None:
            sd = getattr(errors, f"{name}_zero_uncertainty_deg")
            lines.append(f"stand: {name} zero {estimate(zero, sd, '°')}")
    if errors.tilt_deg is not None:
        lean = estimate(errors.tilt_deg, errors.tilt_uncertainty_deg, "°")
        azimuth = estimate(errors.tilt_azimuth_deg or 0.0, errors.tilt_azimuth_uncertainty_deg, "°")
        lines.append(f"stand: its vertical leans by {lean} towards azimuth {azimuth}")
    return lines


def orders(scores: list[OrderScore]) -> str:
    """Error at temperatures left out of the fit, by triad and order, and what chose the order."""
    compared = not all(s.chosen for s in scores)
    rows = []
    for s in scores:
        unit, chosen = s.unit.partition(" ")[0], "chosen" if compared and s.chosen else ""
        errors = [quantity(value, unit) for value in (s.error_inside, s.error_ends, s.noise)]
        each = [s.triad, str(s.order), number(s.inside), number(s.ends), *errors, chance(s.chance)]
        rows.append([*each, chosen])
    header = ["temperatures left out", "order", "χ² inside", "χ² ends", "error inside"]
    header += ["at the ends", "noise", "by chance", ""]
    return f"{table(rows, header, names=2)}\n{ORDERS}{COMPARED if compared else ''}"


def curves(scores: list[CurveScore]) -> str:
    """The table that took or left the own-axis terms."""
    rows = []
    for s in scores:
        shown = number(s.left_out) if s.odds is None else f"{s.odds:+.1f}"
        grouped = [] if s.group_scatter_deg is None else [quantity(s.group_scatter_deg, "°")]
        names = " and ".join(s.triads) or "none"
        rows.append([names, shown, *grouped, "chosen" if s.chosen else ""])
    judged = any(s.odds is not None for s in scores)
    measures = ["odds, powers of ten" if judged else "χ² left out"]
    measures += ["scatter in groups, left out"] * (len(rows[0]) - 3)
    return table(rows, ["own-axis nonlinearity of", *measures, ""])
