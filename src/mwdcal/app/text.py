"""What commands print: one screen that a technician can act on."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from mwdcal.calibration import Calibration, ErrorRow, Finding, StandErrors
from mwdcal.compare import Comparison, Row
from mwdcal.notation import Notation
from mwdcal.quality import Verdict
from mwdcal.selection import OrderScore

WEIGHED = {
    "toolface": "toolface·sin I",
    "azimuth": "azimuth·sin I",
    "gravity": "|g|",
    "field": "|b|",
}


def number(value: float | None) -> str:
    """Three significant digits, or a dash."""
    return (
        "–"
        if value is None or np.isnan(value)
        else f"{value:.3g}"
        if abs(value) < 100
        else f"{value:.0f}"
    )


def quantity(value: float | None, unit: str) -> str:
    """A value with its unit; no space before the degree sign."""
    return number(value) if value is None else f"{number(value)}{'' if unit == '°' else ' '}{unit}"


def table(rows: list[list[str]], header: list[str]) -> str:
    """Columns aligned: the first to the left, the others to the right."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    made = Table(box=box.SIMPLE, pad_edge=False, show_edge=False)
    for index, title in enumerate(header):
        made.add_column(title, justify="left" if index == 0 else "right", no_wrap=True)
    for row in rows:
        made.add_row(*row)
    console = Console(width=160, color_system=None, legacy_windows=False)
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
    if "simulated" in calibration.tool:
        parts.append("SIMULATED DATA")
    ranks = [f"{t.name} {t.rank} of {t.size} determined" for t in calibration.triads]
    models = dict.fromkeys(f"{t.model} of order {t.order}" for t in calibration.triads)
    model = " and ".join(models)
    return "   ".join(parts) + "\n" + "   ".join([f"method {calibration.method}, {model}", *ranks])


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


def stand(found: StandErrors) -> list[str]:
    """Estimated errors of the stand."""
    lines = []
    if found.azimuth_zero_deg is not None:
        sd = number(found.azimuth_zero_uncertainty_deg)
        lines.append(f"stand: azimuth zero {found.azimuth_zero_deg:+.4g}° ± {sd}°")
    if found.tilt_deg is not None:
        lean = f"{found.tilt_deg:.3g}° ± {number(found.tilt_uncertainty_deg)}°"
        azimuth = f"{found.tilt_azimuth_deg:.0f}° ± {number(found.tilt_azimuth_uncertainty_deg)}°"
        lines.append(f"stand: its vertical leans by {lean} towards azimuth {azimuth}")
    return lines


def findings(found: list[Finding]) -> list[str]:
    """One line each."""
    return [f"! {finding.text}" for finding in found]


def orders(scores: list[OrderScore]) -> str:
    """The table that chose the temperature order."""
    rows = [
        [s.triad, str(s.order), number(s.inside), number(s.ends), "chosen" if s.chosen else ""]
        for s in scores
    ]
    return table(rows, ["", "order", "χ² left out, inside", "χ² left out, ends", ""])


def verdict(result: Verdict) -> str:
    """The outcome first, then each limit."""
    rows = [
        [
            row.name,
            quantity(row.value, row.unit),
            "not stated" if row.uncertainty is None else quantity(row.uncertainty, row.unit),
            quantity(row.limit, row.unit),
            "pass" if row.passed else "FAIL",
            row.note,
        ]
        for row in result.rows
    ]
    lines = [f"{'PASS' if result.passed else 'FAIL'}   {result.run}   {result.stations} stations"]
    lines += [f"limits {result.limits} ({result.source})", f"rule: {result.rule}"]
    return "\n".join(lines) + "\n\n" + table(rows, ["", "worst", "1σ", "limit", "", "where"])


def comparison(found: Comparison) -> str:
    """Errors of every method on left-out stations, then the reasons for refusals and the advice."""
    able = [row for row in found.rows if not row.refused]
    lines = [f"{found.run}   {found.stations} stations"]
    if able:
        lines += ["", table(_compared(found, able), ["", *(row.method for row in able)])]
    lines += [f"{row.method} refused: {row.refused}" for row in found.rows if row.refused]
    lines += [
        f"{row.method} leaves undetermined: {', '.join(row.undetermined)}"
        for row in able
        if row.undetermined
    ]
    return "\n".join([*lines, "", found.advice])


def _compared(found: Comparison, able: list[Row]) -> list[list[str]]:
    rows = []
    for kind in ("held_out", "in_sample"):
        for name, unit in found.units.items():
            values = [quantity(getattr(row, kind).get(name), unit) for row in able]
            label = f"{WEIGHED.get(name, name)}, rms {kind.replace('held_out', 'left out').replace('_', ' ')}"
            rows.append([label, *values])
    rows += [
        [f"rank, {triad}", *("{} of {}".format(*row.ranks[triad]) for row in able)]
        for triad in able[0].ranks
    ]
    rows.append(["iterations", *(str(row.iterations) for row in able)])
    return [*rows, ["time", *(f"{row.seconds:.2f} s" for row in able)]]


def notation(found: dict[str, Notation]) -> str:
    """Values with standard uncertainties, in as many digits as a firmware can hold."""
    blocks = []
    for triad, item in found.items():
        rows = []
        for name, value in item.values.items():
            for index in np.ndindex(value.shape):
                where = "".join(f"[{i}]" for i in index)
                sd = float(item.uncertainty[name][index])
                stated = "undetermined" if np.isnan(sd) else f"{sd:.2g}"
                rows.append([f"{name}{where}", f"{value[index]:.12g}", stated])
        blocks.append(f"{triad}\n" + table(rows, ["", "value", "1σ"]))
    return "\n\n".join(blocks)


def plain(value: Any) -> Any:
    """Dataclasses and arrays as what JSON can hold."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if is_dataclass(value):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    return [plain(item) for item in value] if isinstance(value, list | tuple) else value
