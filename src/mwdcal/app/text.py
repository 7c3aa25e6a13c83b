"""What commands print: one screen that a technician can act on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from mwdcal.calibration.automatic.nonlinearity import CurveScore
from mwdcal.calibration.readings import simulated
from mwdcal.calibration.record import (
    Calibration,
    Choices,
    ErrorRow,
    Finding,
    OrderScore,
    StandErrors,
)
from mwdcal.use.notation import Notation, powers
from mwdcal.use.verification import Verdict

WEIGHED = {
    "toolface": "toolface·sin I",
    "azimuth": "azimuth·sin I",
    "gravity": "|g|",
    "field": "|b|",
}
SUPERSCRIPT = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


WIDE = 300
"""Width of a table whose last column holds remarks, which are never cut."""
HELD = "held"
"""In place of the uncertainty of a parameter that a model of 9 or 6 keeps at zero."""


def is_held(value: float, uncertainty: float | None) -> bool:
    """Whether a parameter was not fitted but kept at zero."""
    return value == 0 and uncertainty == 0


def number(value: float | None) -> str:
    """Three significant digits, or a dash."""
    if value is None or np.isnan(value):
        return "–"
    return f"{value + 0.0:.3g}" if abs(value) < 100 else f"{value:.0f}"


def quantity(value: float | None, unit: str) -> str:
    """A value with its unit; no space before the degree sign."""
    return number(value) if value is None else f"{number(value)}{'' if unit == '°' else ' '}{unit}"


def plural(count: int, noun: str) -> str:
    """A count with its noun: 1 station, 2 stations."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def table(rows: list[list[str]], header: list[str], width: int = 160) -> str:
    """Columns aligned: the first to the left, the others to the right."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    made = Table(box=box.SIMPLE, pad_edge=False, show_edge=False)
    for index, title in enumerate(header):
        made.add_column(title, justify="left" if index == 0 else "right", no_wrap=True)
    for row in rows:
        made.add_row(*row)
    console = Console(width=width, color_system=None, legacy_windows=False)
    with console.capture() as capture:
        console.print(made)
    return "\n".join(line.rstrip() for line in capture.get().splitlines())


def heading(calibration: Calibration) -> str:
    """What was calibrated, from what, and how much of it is determined."""
    serial = calibration.tool.get("serial", calibration.profile.name)
    inclinations = [
        r.inclination_deg for r in calibration.station_rows if r.inclination_deg is not None
    ]
    parts = [calibration.run, serial, f"{calibration.stations} stations"]
    if calibration.temperature_c:
        parts.append("{:.1f}–{:.1f} °C".format(*calibration.temperature_c))
    parts.append(f"I {min(inclinations):.0f}–{max(inclinations):.0f}°")
    parts += simulated(calibration.tool)
    ranks = [f"{t.name} {t.rank} of {t.size} determined" for t in calibration.triads]
    how = ", ".join(
        [f"method {calibration.method}", model(calibration), *choices(calibration.options)]
    )
    left_out = ["left out by --exclude: station " + ", ".join(calibration.excluded)]
    lines = ["   ".join(parts), "   ".join([how, *ranks])]
    return "\n".join(lines + (left_out if calibration.excluded else []))


def model(calibration: Calibration) -> str:
    """Model and temperature order, of each triad where they differ."""
    found = {t.name: f"{t.model} of order {t.order}" for t in calibration.triads}
    if len(set(found.values())) == 1:
        return found["accelerometer"]
    return ", ".join(f"{name}: {how}" for name, how in found.items())


def choices(made: Choices) -> list[str]:
    """What was asked for beyond method, model and order."""
    return [
        *([f"{made.parameters} parameters"] if made.parameters != 12 else []),
        *([f"without {' and '.join(made.ignore)}"] if made.ignore else []),
        *([f"robust ({made.robust})"] if made.robust else []),
        *(["the paper's weights"] if made.paper_weights else []),
        *([f"prior {made.prior}"] if made.prior else []),
    ]


def errors(rows: list[ErrorRow]) -> str:
    """Errors before and after, with what was to be expected."""
    cells = [
        [
            f"{WEIGHED.get(r.observable, r.observable)} error, rms",
            *(quantity(v, r.unit) for v in (r.before, r.after, r.expected)),
        ]
        for r in rows
    ]
    return table(cells, ["", "before", "after", "1σ expected"])


def residuals(calibration: Calibration) -> str:
    """The size of the residuals over the declared noise, and how likely it is; empty where none is declared."""
    each = [
        f"{t.name} {number((t.variance_factor or 0.0) ** 0.5)} (chance {chance(t.misfit_probability)})"
        for t in calibration.triads
        if t.misfit_probability is not None
    ]
    return f"residuals over declared noise, s: {'   '.join(each)}" if each else ""


def chance(probability: float | None) -> str:
    """A probability to two digits; far below any decision a bound; a dash where there is none.

    >>> [chance(p) for p in (0.41234, 0.00012, 1e-30, None)]
    ['0.41', '0.00012', '< 1e-9', '–']
    """
    if probability is None:
        return number(probability)
    return "< 1e-9" if probability < 1e-9 else f"{probability:.2g}"


def stand(found: StandErrors) -> list[str]:
    """Estimated errors of the stand."""
    lines = []
    if found.azimuth_zero_deg is not None:
        sd = number(found.azimuth_zero_uncertainty_deg)
        lines.append(f"stand: azimuth zero {found.azimuth_zero_deg:+.4g}° ± {sd}°")
    if found.inclination_zero_deg is not None:
        sd = number(found.inclination_zero_uncertainty_deg)
        lines.append(f"stand: inclination zero {found.inclination_zero_deg:+.4g}° ± {sd}°")
    if found.tilt_deg is not None:
        lean = f"{found.tilt_deg:.3g}° ± {number(found.tilt_uncertainty_deg)}°"
        azimuth = f"{found.tilt_azimuth_deg:.0f}° ± {number(found.tilt_azimuth_uncertainty_deg)}°"
        lines.append(f"stand: its vertical leans by {lean} towards azimuth {azimuth}")
    return lines


def findings(found: list[Finding]) -> list[str]:
    """One line each."""
    return [f"! {finding.text}" for finding in found]


def orders(scores: list[OrderScore]) -> str:
    """Error at temperatures left out of the fit, by triad and order, and what chose the order."""
    word = "" if all(s.chosen for s in scores) else "chosen"
    rows = []
    for s in scores:
        values = (s.error_inside, s.error_ends, s.noise)
        shown = [quantity(value, s.unit.partition(" ")[0]) for value in values]
        row = [s.triad, str(s.order), number(s.inside), number(s.ends), *shown, chance(s.chance)]
        rows.append([*row, word if s.chosen else ""])
    header = [
        "temperatures left out",
        "order",
        "χ² inside",
        "χ² ends",
        "error inside",
        "at the ends",
    ]
    note = "error: rms per axis, with the noise; inside: interpolation, at the ends: extrapolation"
    if word:
        note += (
            "\nby chance: probability that noise alone gives such a term; chosen: the lowest order "
            "above which none is below 0.001"
        )
    return table(rows, [*header, "noise", "by chance", ""]) + "\n" + note


def curves(scores: list[CurveScore]) -> str:
    """The table that took or left the own-axis terms."""
    judged = any(s.odds is not None for s in scores)
    rows = [
        [
            " and ".join(s.triads) or "none",
            f"{s.odds:+.1f}" if s.odds is not None else number(s.left_out),
            "chosen" if s.chosen else "",
        ]
        for s in scores
    ]
    measure = "odds, powers of ten" if judged else "χ² left out"
    return table(rows, ["own-axis nonlinearity of", measure, ""])


def verdict(result: Verdict, *metadata: Mapping[str, object]) -> str:
    """The outcome first, then each limit; `metadata` of calibration and run."""
    rows = [
        [
            row.name,
            quantity(row.raw, row.unit),
            quantity(row.value, row.unit),
            "not stated" if row.uncertainty is None else quantity(row.uncertainty, row.unit),
            quantity(row.limit, row.unit),
            "pass" if row.passed else "FAIL",
            row.note,
        ]
        for row in result.rows
    ]
    outcome = "PASS" if result.passed else "FAIL"
    first = [outcome, result.run, f"{result.stations} stations", *simulated(*metadata)]
    lines = ["   ".join(first)]
    source = f" ({result.source})" if result.source else ""
    lines += [f"limits {result.limits}{source}", f"rule: {result.rule}"]
    header = ["", "raw", "noise-free", "1σ", "limit", "", "where"]
    return "\n".join(lines) + "\n\n" + table(rows, header, WIDE)


def notation(found: dict[str, Notation], reference: float | None = None) -> str:
    """Values with standard uncertainties, in as many digits as a firmware can hold.

    A course is told by its `reference` temperature: each coefficient then names its power of τ.
    """
    blocks = [] if reference is None else [f"τ = T - {reference:g} °C"]
    for triad, item in found.items():
        rows = []
        for name, value in item.values.items():
            power = powers(name, value)
            for index in np.ndindex(value.shape):
                label = _label(name, index, None if reference is None else int(power[index]))
                sd = float(item.uncertainty[name][index])
                own = name == "m" and index[0] == index[1]  # zero in every model
                stated = "undetermined" if np.isnan(sd) else f"{sd:.2g}"
                if is_held(float(value[index]), sd) and not own:
                    stated = HELD
                rows.append([label, f"{value[index] + 0.0:.12g}", stated])
        blocks.append(f"{triad}\n" + table(rows, ["", "value", "1σ"]))
    return "\n\n".join(blocks)


def _label(name: str, index: tuple[int, ...], power: int | None) -> str:
    """Name and place of a value; in a course its power of τ instead of that index."""
    if power is not None and name != "m":
        index = index[:-1] if name in ("SF", "B") else index[1:]
    course = "·τ" if power else ""
    if power and power > 1:
        course += str(power).translate(SUPERSCRIPT)
    return name + "".join(f"[{i}]" for i in index) + course


def plain(value: Any) -> Any:
    """Dataclasses and arrays as what JSON can hold."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if is_dataclass(value):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    return [plain(item) for item in value] if isinstance(value, list | tuple) else value
