"""`mwdcal calibrate`, step by step: read, choose, fit, write, and what is said of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, TypedDict

import msgspec

from mwdcal.app import text
from mwdcal.app.commands.choices import Typed, options_of, prior_of
from mwdcal.calibration.automatic.auto import Choice, choose
from mwdcal.calibration.calibrate import recorded
from mwdcal.calibration.diagnosis.findings import UNUSED
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.prediction import typical_accuracy
from mwdcal.calibration.prior import profile_for
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration, Finding
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
    run: Path,
    tool: str | None,
    decimal: str,
    prior: Calibration | Literal["datasheet"] | None = None,
) -> tuple[Readings, Profile, Digests]:
    """A run with its tool profile, and the digests of both files."""
    profile, profile_sha256 = profiles.load_profile(tool)
    profile = profile_for(prior, profile)
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
) -> tuple[Choice, Calibration]:
    """What was chosen for a run, and its calibration."""
    prior = prior_of(typed["prior"])
    readings, profile, digests = load(source, tool, decimal, prior)
    choice = choose(readings, profile, options_of(typed, prior, exclude), say)
    return choice, recorded(choice, fit(choice.readings, choice.options), **digests)


def write(made: Calibration, output: Path, report: Path | None) -> None:
    """The report, if asked for, then the calibration file."""
    if report:
        from mwdcal.app.pages.report import write_report

        write_report(report, made)
    documents.write(output, made)


def summary(made: Calibration, chosen: Choice, output: Path, report: Path | None) -> dict[str, Any]:
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


def screen(made: Calibration, chosen: Choice, output: Path, report: Path | None) -> str:
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
