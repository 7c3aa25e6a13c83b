"""`python -m mwdcal.selftest`: validate this installation, and write a record of it."""

from __future__ import annotations

import sys
from datetime import datetime
from pathlib import Path

import click
import msgspec

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result, screens
from mwdcal.errors import InputError, MwdcalError
from mwdcal.files.documents import laid_out
from mwdcal.files.formats import atomic
from mwdcal.presentation.certificate import text_as_page, text_as_pdf
from mwdcal.selftest.record import SelftestRecord, as_text, screen, selftest

RECORD_FORMS = (".json", ".html", ".pdf")
"""Suffixes of the forms of a record."""


@options.command()
@click.option(
    "--record",
    "records",
    type=options.FILE,
    multiple=True,
    metavar="R.html|.pdf|.json",
    help="Record to write, the form by its suffix; may be repeated. A page needs the extra report, a PDF certificate.",
)
@options.JSON
def command(records: tuple[Path, ...], as_json: bool) -> None:
    """Compare what this installation computes with published figures and closed forms.

    \b
    Example: python -m mwdcal.selftest --record validation.pdf
    Exit: 0 no case failed, 1 a case failed, 2 the record cannot be written.
    """
    for path in records:
        if path.suffix.lower() not in RECORD_FORMS:
            raise InputError(
                f"`record` {path}: the suffix must be one of {', '.join(RECORD_FORMS)}. Rename it."
            )
    options.check_outputs(records, [])
    record = selftest()
    atomic.write_all([(path, _form(record, path.suffix.lower())) for path in records])
    written = "".join(f"\nwrote {path}" for path in records)
    print_result(msgspec.to_builtins(record) if as_json else screen(record) + written)
    sys.exit(0 if record.passed else 1)


def _form(record: SelftestRecord, suffix: str) -> bytes | str:
    """The record as a file."""
    data = laid_out(msgspec.json.encode(record))
    if suffix == ".html":
        return text_as_page(as_text(record))
    if suffix == ".pdf":
        return text_as_pdf(
            as_text(record), data, int(datetime.fromisoformat(record.time).timestamp())
        )
    return data


def main() -> None:
    """Run the command; no traceback reaches the user."""
    with screens():
        try:
            command.main(prog_name="python -m mwdcal.selftest", standalone_mode=False)
        except click.ClickException as error:
            error.show()
            sys.exit(error.exit_code)
        except MwdcalError as error:
            click.echo(f"mwdcal: {error}", err=True)
            sys.exit(error.exit_code)


if __name__ == "__main__":
    main()
