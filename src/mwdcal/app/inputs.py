"""Inputs that a command line names: a run with its tool profile, and what is known before the fit."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from mwdcal.app.messages import quiet, say
from mwdcal.calibration.fit_options import Prior
from mwdcal.calibration.prior import DATASHEET, profile_for
from mwdcal.calibration.readings import Readings
from mwdcal.errors import InputError
from mwdcal.files import profiles, runs
from mwdcal.files.formats.table import Table
from mwdcal.files.profiles import source_of_settings
from mwdcal.files.statements import Said
from mwdcal.presentation.calibration_source import calibration_of
from mwdcal.presentation.text import one_line
from mwdcal.sensor.profile import Profile

if TYPE_CHECKING:
    from mwdcal.identification.roll_tests import RollTestTable

# --------------------------------------------------------------------------
# Questions on a terminal: one line each, with what is believed first.


def on_terminal() -> bool:
    """Whether somebody can be asked: keys come from a terminal, and questions go to one."""
    return not quiet() and bool(sys.stdin and sys.stdin.isatty()) and sys.stderr.isatty()


def ask(lines: Sequence[str], default: str, check: Callable[[str], object]) -> str:
    """The answer to a question of some lines, until it passes a check; the return key alone takes the default."""
    for line in lines:
        say(line)
    while True:
        answer = click.prompt(">", default=default, prompt_suffix=" ", err=True, type=str)
        try:
            check(str(answer).strip())
        except InputError as error:
            say(str(error))
            continue
        return str(answer).strip()


def choose(question: str, choices: Sequence[str]) -> int:
    """The place of the choice taken, which is typed by its number; the first is what is believed."""

    def check(answer: str) -> None:
        if not answer.isdecimal() or not 1 <= int(answer) <= len(choices):
            raise InputError(f"Type a number from 1 to {len(choices)}; got {answer!r}.")

    listed = [f"  {n}  {one_line(text)}" for n, text in enumerate(choices, 1)]
    return int(ask([question, *listed], "1", check)) - 1


def load_run(
    run: Path,
    tool: str | None,
    decimal: str,
    prior: Prior = None,
    statements: Mapping[str, str] | None = None,
) -> tuple[Readings, Profile]:
    """A run, with the digests of its files, and its tool profile; `statements` as of `runs.read_run`."""
    profile, digest = profiles.load_profile(tool)
    readings, profile = runs.read_run(
        run, profile_for(prior, profile), decimal=decimal, statements=statements
    )
    return replace(readings, profile_sha256=digest, settings_source=source_of_settings()), profile


def load_runs(
    run: Path, rolltest: Path | None, tool: str | None, prior: Prior, said: Said
) -> tuple[Readings, Profile, RollTestTable | None, bool]:
    """A run, its tool profile and its roll test, which is still to be read, and whether its file has one unnamed.

    `said` as of `roll_tests.read_roll_test`. Both may be in one file: on two sheets, or in one table with a column that
    marks the roll test.
    """
    stated, digest = profiles.load_profile(tool)
    stated = profile_for(prior, stated)
    first = runs.read_export(
        run, stated, decimal=said.decimal, rows=runs.MOST_ROWS, statements=said.statements
    )
    test, has_test = None, False
    if rolltest is not None or stated.form.find:
        first, test, has_test = _with_roll_test(run, rolltest, first, stated, said)
    readings, profile = runs.read_run(first, stated)
    source = source_of_settings()
    readings = replace(readings, profile_sha256=digest, settings_source=source)
    return readings, profile, test, has_test


def _with_roll_test(
    run: Path, rolltest: Path | None, table: Table, profile: Profile, said: Said
) -> tuple[Table, RollTestTable | None, bool]:
    """The rows of a run in its table, its roll test, and whether the file has one where none is named."""
    from mwdcal.identification.beside import has_roll_test
    from mwdcal.identification.roll_tests import RollTestTable, beside, parted_run

    if rolltest is None:
        return table, None, has_roll_test(beside(run, table, profile))
    if rolltest.exists() and run.exists() and run.samefile(rolltest):
        return *parted_run(run, table, profile, said), False
    return table, RollTestTable(rolltest, replace(said, of_run=table.metadata)), False


def prior_of(word: str | None) -> tuple[Prior, str]:
    """The prior that a word names, and the SHA-256 of its file.

    A calibration file; or the tolerances of the profile, or nothing, which have no file.
    """
    if not word:
        return None, ""
    return (DATASHEET, "") if word == DATASHEET else calibration_of(Path(word))
