"""`mwdcal convert`: a calibration in another notation."""

from __future__ import annotations

from pathlib import Path

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result, to_json
from mwdcal.app.text import one_line
from mwdcal.errors import InputError


@options.command()
@options.CALIBRATION
@click.option(
    "--notation",
    required=True,
    type=click.Choice(["factors", "forward", "affine"]),
    help="Form to print.",
)
@click.option(
    "--temperature",
    metavar="°C|course",
    help="One temperature, or 'course': coefficients by power of T - reference. "
    "Default: the reference temperature.",
)
@options.output(metavar="OUT.json", help="Write JSON here instead of printing.", required=False)
@options.JSON
def command(
    calibration: Path, notation: str, temperature: str | None, output: Path | None, as_json: bool
) -> None:
    """Print a CALIBRATION in another notation, in raw units, with covariance.

    \b
    forward: raw = S·field + o    affine: field = M·raw + b    factors: SF, B, m (Moosavi)
    Example: mwdcal convert tool.json --notation forward --json
    Example: mwdcal convert tool.json --notation forward --temperature course
    """
    from mwdcal.app.pages import conversion
    from mwdcal.files.formats import atomic

    options.check_outputs([output], [calibration])
    converted = conversion.convert_file(calibration, notation, _temperature(temperature))
    document = conversion.document(converted)
    shown = f"wrote {one_line(output)}" if output else conversion.screen(converted)
    if output:
        atomic.write(output, to_json(document) + "\n")
    print_result(document if as_json else shown, converted.findings)


def _temperature(typed: str | None) -> float | str | None:
    """A temperature in °C if it is a number; a word is left to the conversion."""
    from mwdcal.files.contract import TEMPERATURE

    try:
        value = float(typed or "")
    except ValueError:
        return typed
    if not TEMPERATURE.low <= value <= TEMPERATURE.high:
        raise InputError(f"`temperature` must be {TEMPERATURE}; got {value:g}.")
    return value
