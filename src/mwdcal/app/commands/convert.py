"""`mwdcal convert`: a calibration in another notation, or as C sources for firmware."""

from __future__ import annotations

from pathlib import Path

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result
from mwdcal.errors import InputError
from mwdcal.presentation.text import one_line, to_json


@options.command()
@options.CALIBRATION
@click.option(
    "--notation", type=click.Choice(["factors", "forward", "affine"]), help="Form to print."
)
@click.option(
    "--to",
    "form",
    type=click.Choice(["c-header", "fixed-point", "tool-model"]),
    help="C sources with test vectors, in double precision or in whole numbers; or the sensor terms of the calibration "
    "as a tool model for error-model programs.",
)
@click.option(
    "--word-bits",
    metavar="12…32",
    type=int,
    help="Bits of the whole numbers of fixed-point. Default: 32.",
)
@click.option(
    "--temperature",
    metavar="°C|course",
    help="One temperature, or 'course': coefficients by power of T - reference. "
    "Default: the reference temperature.",
)
@click.option(
    "--toolface",
    type=float,
    metavar="DEG",
    help="With tool-model: the gravity toolface of a tool that does not turn; terms are then of each axis. Default: "
    "averaged over toolface.",
)
@options.output(
    metavar="OUT.json|DIR",
    required=False,
    help="Write JSON here instead of printing; with --to the folder of the sources, or the tool model.",
)
@options.JSON
def command(
    calibration: Path, notation: str | None, form: str | None, word_bits: int | None,
    temperature: str | None, toolface: float | None, output: Path | None, as_json: bool,
) -> None:  # fmt: skip
    """Print a CALIBRATION in another notation, in raw units, with covariance, or write it as C sources.

    \b
    forward: raw = S·field + o    affine: field = M·raw + b    factors: SF, B, m (Moosavi)
    Example: mwdcal convert tool.json --notation forward --json
    Example: mwdcal convert tool.json --notation forward --temperature course
    Example: mwdcal convert tool.json --to c-header -o firmware
    Example: mwdcal convert tool.json --to fixed-point --word-bits 24 -o firmware
    Example: mwdcal convert tool.json --to tool-model -o model.json
    """
    from mwdcal.presentation.conversion import check_bits

    _check_choice(notation, form, temperature, output)
    check_bits(form, word_bits)
    if toolface is not None and form != "tool-model":
        raise InputError("`toolface` goes with `form` tool-model. Leave it out.")
    if form == "tool-model" and output:
        _write_model(calibration, temperature, toolface, output, as_json)
    elif form and output:
        _write_sources(calibration, form, word_bits, output, as_json)
    elif notation:
        _convert(calibration, notation, temperature, output, as_json)


def _check_choice(
    notation: str | None, form: str | None, temperature: str | None, output: Path | None
) -> None:
    """Refuse options that do not go together."""
    if (notation is None) == (form is None):
        raise InputError("`notation` or `form` must be given, and not both. Choose one.")
    if form and output is None:
        raise InputError("`form` needs the folder or file to write to. Add `output`.")
    if form and form != "tool-model" and temperature is not None:
        raise InputError(
            "`temperature` goes with `notation`: sources hold for all temperatures. Omit it."
        )


def _convert(
    calibration: Path, notation: str, temperature: str | None, output: Path | None, as_json: bool
) -> None:
    """Print a calibration in a notation, or write it as JSON."""
    from mwdcal.files.formats import atomic
    from mwdcal.presentation import conversion

    options.check_outputs([output], [calibration], form=".json")
    converted = conversion.converted(calibration, notation, _temperature(temperature))
    document = conversion.document(converted)
    shown = f"wrote {one_line(output)}" if output else conversion.screen(converted)
    if output:
        atomic.write(output, to_json(document) + "\n")
    print_result(document if as_json else shown, converted.findings)


def _write_sources(
    calibration: Path, form: str, word_bits: int | None, folder: Path, as_json: bool
) -> None:
    """Write the C sources of a calibration into a folder, all or none."""
    from mwdcal.files.formats import atomic
    from mwdcal.presentation import conversion

    exported = conversion.exported(calibration, form, word_bits)
    files = {folder / name: text for name, text in exported.sources.files.items()}
    with atomic.folder(folder):
        options.check_outputs(files, [calibration])
        atomic.write_all(files.items())
    document = conversion.export_document(exported, folder)
    print_result(
        document if as_json else conversion.export_screen(exported, folder), exported.findings
    )


def _write_model(
    calibration: Path, temperature: str | None, toolface: float | None, output: Path, as_json: bool
) -> None:
    """Write the sensor terms of a calibration as a tool model, and print them."""
    from mwdcal.files.formats import atomic
    from mwdcal.presentation import conversion

    options.check_outputs([output], [calibration], form=".json")
    at = _temperature(temperature)
    converted, terms, model = conversion.terms_at(calibration, at, toolface)
    atomic.write(output, model)
    document = conversion.terms_document(converted, terms, output)
    print_result(
        document if as_json else conversion.terms_screen(converted, terms, output),
        converted.findings,
    )


def _temperature(typed: str | None) -> float | str | None:
    """A temperature in °C if it is a number, else the word."""
    try:
        return float(typed or "")
    except ValueError:
        return typed
