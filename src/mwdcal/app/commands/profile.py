"""`mwdcal profile`: a tool profile proposed from a table as it comes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result
from mwdcal.errors import InputError, QuestionError, QuestionsError
from mwdcal.library.answers import Answers

if TYPE_CHECKING:
    from mwdcal.library.planning import ProposedProfile

MOST_ROUNDS = 20
"""Rounds of questions: each answer may open another."""


@options.command()
@options.RUN
@options.output(metavar="TOOL.toml", help="Tool profile to write.")
@click.option("--sheet", default="", metavar="NAME", help="Sheet of the workbook.")
@click.option(
    "--header-row", type=options.Whole(1), metavar="N", help="Row or line of the column names."
)
@click.option("--decimal", default="", metavar="SIGN", help="Decimal sign of numbers in text.")
@click.option("--serial", default="", metavar="S", help="Serial, where the table states none.")
@click.option("--date", default="", metavar="YYYY-MM-DD", help="Day, where the table states none.")
@click.option(
    "--column",
    multiple=True,
    metavar="OURS=THEIRS",
    help="Which column is which: ref_azimuth_deg='Azi 2', ref_field_nt='F [µT]'; blank: no column. Repeatable.",
)
@click.option(
    "--leave-out",
    multiple=True,
    metavar="COLUMN=TEXT",
    help="Rows with this text are rejected: QC=X; blank: rows without a reading there. Repeatable.",
)
@click.option(
    "--keep", multiple=True, metavar="COLUMN=TEXT", help="Rows with this text count. Repeatable."
)
@click.option(
    "--north",
    type=click.Choice(["magnetic", "true", "grid"]),
    help="North of the stand's azimuths, where the table does not say it.",
)
@options.number(
    "--declination-deg", "DEG", "Declination of azimuths from true or grid north, east."
)
@options.number("--convergence-deg", "DEG", "Convergence of azimuths from grid north, east.")
@click.option("--replace", is_flag=True, help="Replace a profile that exists.")
@options.JSON
def command(
    run: Path, output: Path, column: tuple[str, ...], leave_out: tuple[str, ...], keep: tuple[str, ...],
    replace: bool, as_json: bool, **given: Any
) -> None:  # fmt: skip
    """Propose a tool profile for a RUN as a logger or spreadsheet program has written it.

    Takes .csv .tsv .txt .dat .lvm .asc .prn .log .out .xlsx .xls .ods. Finds sheet, names and units of the columns, the
    last row of readings, decimal sign and encoding, the meaning of each column, and, from readings at known attitudes,
    the axes and nominal scales of both triads. calibrate, verify, compare and apply then take such tables with --tool
    TOOL.toml as they are, also where the table has moved. It asks what is open: on a terminal one question after the
    other, elsewhere all at once, each with the option that answers it.

    \b
    Example: mwdcal profile export.xlsx -o tool.toml --column temperature_c="Oven temp"
    Exit: 0 written, 2 input cannot be read, 3 questions are open (nothing is written).
    """
    options.check_outputs([output], [run], form=".toml")
    stated = {name: value for name, value in given.items() if value is not None}
    answers = Answers(stated)
    for name, texts in (("column", column), ("leave_out", leave_out), ("keep", keep)):
        for text in texts:
            answers.take(name, text)
    result = _proposed(run, answers, replace or not output.exists())
    if not replace and output.exists() and output.read_bytes() != result.to_toml().encode():
        raise InputError(
            f"'{output}' exists, and may have been completed by hand. Name another file, or add --replace."
        )
    result.save(output)
    print_result(result.to_dict() if as_json else result.summary(), result.findings)


def _proposed(run: Path, answers: Answers, may_ask: bool) -> ProposedProfile:
    """The proposal, after questions on a terminal where it may ask."""
    from mwdcal.app import inputs
    from mwdcal.library import planning

    for _ in range(MOST_ROUNDS):
        try:
            return planning.propose_profile(run, **answers)
        except (QuestionError, QuestionsError) as error:
            every = error.questions if isinstance(error, QuestionsError) else (error,)
            open_ones = [each for each in every if each.answers]
            if not open_ones or not may_ask or not inputs.on_terminal():
                raise
            for each in open_ones:
                _ask(each, answers)
    raise InputError(f"{run.name}: the answers open ever more questions. Answer them by options.")


def _ask(question: QuestionError, answers: Answers) -> None:
    """Ask a question, and note its answer with those given before."""
    from mwdcal.app import inputs

    place = inputs.choose(question.text, [answer.name for answer in question.answers])
    chosen = question.answers[place]
    for argument, value in chosen.arguments:
        answers.take(argument, value)
    for name in chosen.numbers:
        answers[name] = float(inputs.ask([f"{name} (degrees, east is positive)"], "0", _number))


def _number(text: str) -> None:
    """Refuse what is no angle."""
    try:
        if abs(float(text)) <= 180:
            return
    except ValueError:
        pass
    raise InputError(f"Type a number of degrees between -180 and 180; got {text!r}.")
