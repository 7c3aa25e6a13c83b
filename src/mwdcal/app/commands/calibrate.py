"""`mwdcal calibrate`, step by step: read, choose, fit, write, and what is said of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypedDict

import msgspec
import numpy as np

from mwdcal.app import text
from mwdcal.app.commands.choices import Chosen, Typed, choose, prior_profile
from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.diagnosis.findings import UNUSED
from mwdcal.calibration.prediction import typical_accuracy
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.errors import InputError
from mwdcal.files import documents, profiles, runs
from mwdcal.files.formats import table
from mwdcal.sensor.profile import Profile

RESHOT = 12
"""Most stations to re-shoot that the screen names."""


class Digests(TypedDict):
    """What the calibration file says about its sources."""

    profile_sha256: str
    run_sha256: str


def load(
    run: Path, tool: str | None, decimal: str, prior: str | None = None
) -> tuple[Readings, Profile, Digests]:
    """A run with its tool profile, and the digests of both files."""
    profile, profile_sha256 = profiles.load_profile(tool)
    profile = prior_profile(prior, profile)
    read = table.read(run, decimal=decimal)
    runs.check_run(read)
    readings, profile = runs.to_readings(read, profile)
    digests = Digests(profile_sha256=profile_sha256, run_sha256=read.digest)
    return readings, profile, digests


def run(
    source: Path,
    tool: str | None,
    exclude: tuple[str, ...],
    decimal: str,
    typed: Typed,
    say: Callable[[str], None],
) -> tuple[Chosen, Calibration]:
    """What was chosen for a run, and its calibration."""
    readings, profile, digests = load(source, tool, decimal, typed["prior"])
    excluded = [label for label in readings.station if label in exclude]
    readings = without(readings, exclude)
    chosen = choose(readings, profile, typed, say)
    made = calibrate(
        readings, profile, chosen.options, orders=chosen.orders, excluded=excluded, **digests
    )
    return chosen, made


def without(readings: Readings, exclude: tuple[str, ...]) -> Readings:
    """The readings less the stations of these labels."""
    twice = [label for label in exclude if readings.station.count(label) > 1]
    if twice:
        raise InputError(
            f"--exclude {twice[0]}: {readings.station.count(twice[0])} stations of {readings.source} "
            "have this label. Give each its own in the column 'station'."
        )
    missing = [label for label in exclude if label not in readings.station]
    if missing:
        raise InputError(
            f"--exclude {missing[0]}: no such station in {readings.source}; "
            f"stations are {readings.station[0]} … {readings.station[-1]}."
        )
    return readings.select(np.array([label not in exclude for label in readings.station]))


def write(made: Calibration, output: Path, report: Path | None) -> None:
    """The report, if asked for, then the calibration file."""
    if report:
        from mwdcal.app.pages.report import write_report

        write_report(report, made)
    documents.write(output, made)


def summary(made: Calibration, chosen: Chosen, output: Path, report: Path | None) -> dict[str, Any]:
    """The result for machines."""
    named = (
        "model",
        "order",
        "rank",
        "size",
        "undetermined",
        "variance_factor",
        "misfit_probability",
    )
    return {
        "run": made.run,
        "stations": made.stations,
        "excluded": made.excluded,
        "temperature_c": made.temperature_c,
        "method": made.method,
        "options": made.options,
        "seed": made.seed,
        "triads": {t.name: {n: getattr(t, n) for n in named} for t in made.triads},
        "errors": made.errors,
        "measures": made.measures,
        "accuracy_1sigma_deg": typical_accuracy(made),
        "budget": made.budget,
        "assumed_exact": made.assumed_exact,
        "constants": made.constants,
        "stand": made.stand,
        "findings": made.findings,
        "orders": made.orders,
        "nonlinearity": [msgspec.to_builtins(score) for score in chosen.curves],
        "calibration": str(output),
        "report": str(report or ""),
    }


def _told(found: list[Finding]) -> list[str]:
    """The findings, of stations to re-shoot the first ones; unused columns are said before."""
    again = [finding for finding in found if finding.id == "reshoot"]
    left = again[RESHOT:]
    lines = text.findings([f for f in found if f not in left and f.id != UNUSED])
    return lines + ([f"! … and {len(left)} more to re-shoot"] if left else [])


def screen(made: Calibration, chosen: Chosen, output: Path, report: Path | None) -> str:
    """The result for people."""
    tables = [
        text.heading(made),
        *([text.orders(made.orders)] if made.orders else []),
        *([text.curves(chosen.curves)] if chosen.curves else []),
        text.errors(made.errors),
    ]
    accuracy = "  ".join(
        f"{n} {text.number(v)}{'°' if v is not None else ''}"
        for n, v in typical_accuracy(made).items()
    )
    lines = [text.residuals(made)] if text.residuals(made) else []
    lines += [f"accuracy to expect (1σ, calibration alone, typical): {accuracy}"]
    if made.assumed_exact:
        without = ", ".join(made.assumed_exact)
        lines.append(
            f"taken as exact, and no residual tests it: {without} (see [stand] of the tool profile)"
        )
    for constant in made.constants:
        value = f"{constant.value:.6g} ± {constant.standard_uncertainty:.2g} {constant.unit}"
        lines.append(f"estimated constant of the run: {constant.name} {value}")
    lines += text.stand(made.stand) + _told(made.findings)
    wrote = f"wrote {output} (calibration)" + (f"   {report} (report)" if report else "")
    lines.append(f"{wrote}   next: mwdcal verify {output} ROLLTEST.csv")
    return "\n\n".join([*tables, "\n".join(lines)])
