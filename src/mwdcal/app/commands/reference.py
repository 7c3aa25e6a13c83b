"""`mwdcal reference`: gravity, magnetic field and norths of a place and date."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result
from mwdcal.errors import InputError
from mwdcal.presentation.text import to_json

MEASURED = {
    "gravity_g": ("G", "Measured gravity, in g of 9.80665 m/s²"),
    "field_nt": ("NT", "Measured strength of the magnetic field"),
    "dip_deg": ("DEG", "Measured dip, positive down"),
    "declination_deg": ("DEG", "Measured declination, positive east"),
}
"""Values that may be measured, by key: metavar and what it is."""


def measured(function: options.Function) -> options.Function:
    """The options for measured values and their standard uncertainties."""
    for key, (metavar, text) in reversed(MEASURED.items()):
        option = key.replace("_", "-")
        sd = "Its standard uncertainty (1σ)."
        function = options.number(f"--sd-{option}", metavar, sd)(function)
        function = options.number(f"--{option}", metavar, f"{text}; overrides the model.")(function)
    return function


@options.command()
@click.option(
    "--latitude",
    "latitude_deg",
    type=options.NUMBER,
    required=True,
    metavar="DEG",
    help="Geodetic, north positive.",
)
@click.option(
    "--longitude",
    "longitude_deg",
    type=options.NUMBER,
    required=True,
    metavar="DEG",
    help="East positive.",
)
@click.option(
    "--altitude-m",
    type=options.NUMBER,
    required=True,
    metavar="M",
    help="Metres above the ellipsoid WGS84, negative below.",
)
@click.option(
    "--date",
    "field_day",
    type=options.Day(),
    required=True,
    metavar="YYYY-MM-DD",
    help="Day for which the field is wanted.",
)
@options.preset(
    "--model",
    "field_model",
    type=click.Choice(["wmm2025", "igrf14"]),
    default="wmm2025",
    help="Model of the main field: wmm2025 (2025 to 2030) or igrf14 (1900 to 2030).",
)
@click.option("--crs", metavar="EPSG:N", help="Grid of the well plan, for its convergence.")
@measured
@click.option(
    "--fill",
    "run",
    type=options.FILE,
    metavar="RUN",
    help="A run whose blank references are filled.",
)
@options.output(
    required=False,
    metavar="REF.json|RUN.csv",
    help="Reference to write; with --fill the filled run.",
)
@options.DECIMAL
@options.JSON
def command(
    latitude_deg: float, longitude_deg: float, altitude_m: float, field_day: datetime,
    field_model: str, crs: str | None, run: Path | None, output: Path | None, decimal: str, as_json: bool,
    **typed: float | None,
) -> None:  # fmt: skip
    """Gravity, magnetic field, dip, declination and convergence at a place and date, without a network.

    Normal gravity of WGS84; main field by WMM2025 or IGRF-14, which know neither the rocks nor the steel around:
    a value measured at the place overrides the model. Each value has its standard uncertainty. Survey takes
    the file with --reference.

    \b
    Example: mwdcal reference --latitude 60 --longitude 3.5 --altitude-m 40 --date 2026-07-01 -o ref.json
    Example: mwdcal reference --latitude 60 --longitude 3.5 --altitude-m 40 --date 2026-07-01 \\
               --fill run.csv -o filled.csv
    Exit: 0 done, 2 input cannot be read.
    """
    from mwdcal.files.formats import atomic, table
    from mwdcal.presentation import reference as screen
    from mwdcal.survey.references import MEASURABLE, fill, reference_at

    options.check_outputs([output], [run])
    if run and not output:
        raise InputError("`run` needs a file for the filled run. Add `output`.")
    if output and not run and output.suffix.lower() != ".json":
        raise InputError(
            f"`output` '{output}': a reference is written as JSON. Name a file that ends in .json, or add `run`."
        )
    values, sd = (
        {name: typed[prefix + key] for name, key in MEASURABLE.items()} for prefix in ("", "sd_")
    )
    reference = reference_at(
        latitude_deg, longitude_deg, altitude_m, field_day.date(), model=field_model, crs=crs,
        measured={name: value for name, value in values.items() if value is not None},
        uncertainties={name: value for name, value in sd.items() if value is not None},
    )  # fmt: skip
    filled = fill(table.read(run, decimal=decimal), reference) if run else None
    document = screen.document(reference, filled, output)
    if output:
        written = table.rendered(output, filled.table) if filled else to_json(document) + "\n"
        atomic.write(output, written)
    shown = document if as_json else screen.screen(reference, filled, output)
    print_result(shown, screen.findings(reference, filled))
