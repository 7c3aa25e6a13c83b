"""`mwdcal profile`: a tool profile proposed from a table as it comes."""

from __future__ import annotations

from pathlib import Path

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result
from mwdcal.errors import InputError


@options.command()
@options.RUN
@options.output(metavar="TOOL.toml", help="Tool profile to write.")
@click.option("--sheet", default="", metavar="NAME", help="Sheet of the workbook.")
@click.option(
    "--header-row", type=click.IntRange(1), metavar="N", help="Row or line of the column names."
)
@click.option("--decimal", default="", metavar="SIGN", help="Decimal sign of numbers in text.")
@click.option("--serial", default="", metavar="S", help="Serial, where the table states none.")
@click.option("--date", default="", metavar="YYYY-MM-DD", help="Day, where the table states none.")
@click.option(
    "--column",
    multiple=True,
    metavar="OURS=THEIRS",
    help="What a column is: ref_azimuth_deg='Azi 2', ref_field_nt='F [µT]'. Repeatable.",
)
@click.option("--replace", is_flag=True, help="Replace a profile that exists.")
@options.JSON
def command(
    run: Path,
    output: Path,
    sheet: str,
    header_row: int | None,
    decimal: str,
    serial: str,
    date: str,
    column: tuple[str, ...],
    replace: bool,
    as_json: bool,
) -> None:
    """Propose a tool profile for a RUN as a logger or spreadsheet program has written it.

    Takes .csv .tsv .txt .dat .lvm .xlsx .xls .ods. Finds sheet, names and units of the columns, the last row of
    readings, decimal sign and encoding, the meaning of each column, and, from readings at known attitudes, the axes
    and nominal scales of both triads. calibrate, verify, compare and apply then take such tables with
    --tool TOOL.toml as they are, also where the table has moved. What is open is asked, all at once.

    \b
    Example: mwdcal profile export.xlsx -o tool.toml --column temperature_c="Oven temp"
    Exit: 0 written, 2 input cannot be read, 3 questions are open (nothing is written).
    """
    from mwdcal.library import planning

    options.check_outputs([output], [run])
    answers = dict(_answer(each) for each in column)
    result = planning.propose_profile(
        run,
        sheet=sheet,
        header_row=header_row or 0,
        decimal=decimal,
        serial=serial,
        date=date,
        column=answers,
    )
    if not replace and output.exists() and output.read_bytes() != result.to_toml().encode():
        raise InputError(
            f"'{output}' exists, and may have been completed by hand. Name another file, or add --replace."
        )
    result.save(output)
    print_result(result.to_dict() if as_json else result.summary(), result.findings)


def _answer(text: str) -> tuple[str, str]:
    """The name in a run file and the column of the table, as typed."""
    ours, sign, theirs = text.partition("=")
    if not sign:
        raise InputError(
            f"--column {text!r}: expected OURS=THEIRS, such as ref_azimuth_deg='Azi 2'."
        )
    return ours.strip(), theirs.strip()
