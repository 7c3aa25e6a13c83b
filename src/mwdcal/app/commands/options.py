"""Arguments and options of the commands: each is declared once, as a decorator."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from datetime import datetime
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unicodedata import normalize

import click
from click.core import ParameterSource
from click.shell_completion import CompletionItem

from mwdcal.app.messages import Command
from mwdcal.calibration.fit_options import FIT_OPTIONS
from mwdcal.calibration.fit_options import FitArguments as FitArguments
from mwdcal.errors import InputError

if TYPE_CHECKING:
    from mwdcal.files.statements import Said

Function = Callable[..., Any]
Decorator = Callable[[Function], Function]
FILE = click.Path(path_type=Path)
REGISTRY = "MWDCAL_REGISTRY"
"""Environment variable with the registry that is meant where none is named."""
PICTURES = (".png", ".svg")
"""Suffixes of pictures."""


class Whole(click.IntRange):
    """A whole number in a range."""

    name = "whole number"


class Within(click.FloatRange):
    """A number in a range."""

    name = "number"


class Day(click.DateTime):
    """A day, year first."""

    def __init__(self) -> None:
        super().__init__(["%Y-%m-%d"])

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> datetime:
        """The day that a text states; refuse another form in words that name this one."""
        try:
            return super().convert(value, param, ctx)
        except click.BadParameter:
            self.fail(f"expected a day such as 2026-11-28; got '{value}'.", param, ctx)


class PointedNumber(click.types.FloatParamType):
    """A number with a decimal point."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number, or what is wrong with the word."""
        if isinstance(value, str) and re.fullmatch(r"[+-]?\d*,\d+", value.strip()):
            self.fail(f"{value!r} has a decimal comma. Write it with a decimal point.", param, ctx)
        return super().convert(value, param, ctx)


class Renamed(click.Option):
    """An option that is still taken by its `old` names, which neither help nor completion shows."""

    def __init__(self, *arguments: Any, old: tuple[str, ...], **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.old = old

    def add_to_parser(self, parser: Any, ctx: click.Context) -> None:
        """Let the parser take the old names too."""
        names, self.opts = self.opts, [*self.opts, *self.old]
        super().add_to_parser(parser, ctx)
        self.opts = names


def offers(folder: str) -> Callable[..., list[CompletionItem]]:
    """The completion of an option: what a folder of the package has built in, and files."""

    def complete(
        context: click.Context, option: click.Parameter, typed: str
    ) -> list[CompletionItem]:
        from mwdcal.files.profiles import built_in

        names = [name for name in built_in(folder) if name.startswith(typed)]
        return [CompletionItem(typed, type="file"), *map(CompletionItem, names)]

    return complete


NUMBER = PointedNumber()
command = partial(click.command, cls=Command)
argument = partial(click.argument, type=FILE)
output = partial(click.option, "-o", "--output", type=FILE, required=True)
tool = partial(
    click.option,
    "--tool",
    metavar="NAME|FILE",
    shell_complete=offers("profiles"),
    help="Tool profile: a name that mwdcal list profiles shows, or a TOML file.",
)
renamed = partial(click.option, cls=Renamed)
"""An option with `old` names that stay for one release."""
report = partial(
    renamed,
    "--report",
    old=(),
    type=FILE,
    metavar="R.html",
    help="Also write a self-contained HTML report.",
)
plot = partial(click.option, "--plot", type=FILE, metavar="FILE.png|svg")
preset = partial(click.option, show_default=True)
CALIBRATION = argument("calibration")
RUN = argument("run")
LOG = argument("log")
MISSING = preset(
    "--missing",
    type=click.Choice(["refuse", "blank"]),
    default="refuse",
    help="Rows with a blank reading or temperature: refuse the file, or leave their results blank.",
)
WHERE_OUTSIDE = preset(
    "--outside",
    default="blank",
    metavar="blank|refuse|extrapolate",
    help="Results of rows more than 1 °C (without temperature terms: 5 °C) outside the calibrated "
    "temperatures: none; refuse the file; or extrapolated, and marked as such.",
)
LIMITS = preset(
    "--limits", default="roll-test", metavar="NAME|FILE", shell_complete=offers("limits"),
    help="Limits of the roll test: roll-test, moosavi, moradi, or a TOML file with [error] and [spread]. Files of "
    "survey --limits do not fit.",
)  # fmt: skip
DECIMAL = preset(
    "--decimal", default=".", metavar="SIGN", help="Decimal sign of numbers in text files."
)
TRUSTED_KEYS = click.option(
    "--key",
    type=FILE,
    multiple=True,
    metavar="K.pub|KEYS.json",
    envvar="MWDCAL_KEYS",
    help="Public key, or file of keys, whose signatures are trusted; may be repeated. Default: the files that the "
    "variable MWDCAL_KEYS names.",
)
JSON = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
COLUMN_NAMES = click.option(
    "--columns", default="", metavar="NAMES",
    help="Columns of a text log without column names, such as time_s,ax,ay,az.",
)  # fmt: skip


RESULT = output(
    required=False, metavar="OUT.json", help="Also write the result as JSON, as --json prints it."
)


SAID_OF_RUN = "mwdcal.statements"
"""Where the context of a command has what the user says of a run."""
OPTIONS_OF_RUN = ("serial", "date", "operator")
"""Options that say of a run what its table does not."""
BESIDE_RUN = "rolltest_"
"""How options on the table of a roll test begin beside those on the run's."""


def _note(context: click.Context, option: click.Parameter, typed: Any) -> None:
    """Note what the user says of a run or a roll test."""
    if typed is not None:
        name = str(option.name).removeprefix(BESIDE_RUN)
        said = typed.date().isoformat() if isinstance(typed, datetime) else typed
        said = said.strip() if isinstance(said, str) else said
        context.meta.setdefault(SAID_OF_RUN, {})[name] = said


def of_run(function: Function) -> Function:
    """The options with which a user says of a run what its table does not, or otherwise."""
    noted = partial(click.option, callback=_note, expose_value=False)
    for option in (
        noted("--operator", metavar="NAME", help="Who measured; comes before the table's own."),
        noted(
            "--date",
            type=Day(),
            metavar="YYYY-MM-DD",
            help="Day of the run; likewise.",
        ),
        noted(
            "--serial",
            metavar="S",
            help="Serial of the tool; of several in the table, the one to take.",
        ),
    ):
        function = option(function)
    return function


def statements() -> dict[str, str]:
    """Serial, date and operator as the user says."""
    noted = click.get_current_context().meta.get(SAID_OF_RUN, {})
    return {name: noted[name] for name in OPTIONS_OF_RUN if name in noted}


def of_roll_test(
    function: Function,
    beside_run: bool = False,
    words: str = "the roll test",
    example: str = "ref_toolface_deg='Cara 2'",
) -> Function:
    """The options that answer what the table of a roll test, or of later readings, leaves open.

    Those of a command that also has a table of a run begin with `BESIDE_RUN`. `words` for the table, and an example.
    """
    noted = partial(click.option, callback=_note, expose_value=False)
    prefix = f"--{BESIDE_RUN.replace('_', '-')}" if beside_run else "--"
    for option in (
        noted(
            f"{prefix}column",
            multiple=True,
            metavar="OURS=THEIRS",
            help=f"Which column of {words} is which: {example}. Repeatable.",
        ),
        noted(f"{prefix}sheet", metavar="NAME", help=f"Sheet of {words}."),
    ):
        function = option(function)
    return function


def of_readings(function: Function) -> Function:
    """The same options of a command that corrects readings."""
    return of_roll_test(function, words="the readings", example="ax='Gx 1', md_m='Hole depth'")


def said(decimal: str) -> Said:
    """Statements of the user on tables: decimal sign, serial, date and operator, sheet and columns of the roll test."""
    from mwdcal.files.statements import Said

    noted = click.get_current_context().meta.get(SAID_OF_RUN, {})
    sheet, columns = noted.get("sheet", ""), noted.get("column")
    said = Said(decimal, {n: v for n, v in noted.items() if n in OPTIONS_OF_RUN}, sheet)
    if not columns:
        return said
    from mwdcal.library.answers import by_column

    return replace(said, columns=by_column("column", columns))


def number(name: str, metavar: str, text: str, *variable: str) -> Decorator:
    """An option with a number; `variable` where it is not named as the option."""
    return click.option(name, *variable, type=NUMBER, metavar=metavar, help=text)


SAMPLING_HZ = number("--sampling-hz", "HZ", "Rate of the log; wins over its column time_s.")


def fit_option(
    name: str, default: str | None = None, metavar: str | None = None, known: str = ""
) -> Decorator:
    """An option of the fit, as it is declared; its `default`, and words of what is `known`, vary by command."""
    each = FIT_OPTIONS[name]
    usual = each.default if default is None else default
    kind = click.Choice(each.words) if each.words else None
    return click.option(
        f"--{name.replace('_', '-')}", is_flag=usual is False,
        type=kind if each.least is None else Whole(each.least),
        default=usual, show_default=usual not in (None, "", False), metavar=metavar or each.metavar,
        help=each.help.format(known),
    )  # fmt: skip


SEED = fit_option("seed")


def fit_options(order: str, nonlinearity: str, prior: str, known: str) -> Decorator:
    """The options that say how to fit, which the command gets as `FitArguments`.

    With the defaults of two of them, and what a prior may be, as metavar and in words.
    """
    more: dict[str, Any] = {
        "order": (order,),
        "nonlinearity": (nonlinearity,),
        "prior": (None, prior, known),
    }

    def decorate(function: Function) -> Function:
        for name in reversed(FIT_OPTIONS):
            function = fit_option(name, *more.get(name, ()))(function)
        return function

    return decorate


def registry(**more: Any) -> Decorator:
    """The option that names a registry."""
    return renamed(
        "--registry",
        "database",
        old=("--database",),
        metavar="URL|FILE",
        help=f"The registry: a file, or the URL of a PostgreSQL database. Default: ${REGISTRY}.",
        **more,
    )


def _named_registry(context: click.Context, option: click.Parameter, typed: str | None) -> str:
    """The registry that a subcommand, its group or the environment names."""
    group = context.parent.params.get(option.name) if context.parent and option.name else None
    of_settings = context.get_parameter_source(option.name or "") is ParameterSource.DEFAULT_MAP
    named = (group or typed) if of_settings else (typed or group)
    if not named and not context.resilient_parsing:
        raise InputError(f"--registry must name the registry; got none. Or set ${REGISTRY}.")
    return named or ""


def _system_user() -> str:
    """The name under which the user is known to the system, or empty."""
    from mwdcal.registry.store import system_user

    return system_user()


DATABASE = registry(callback=_named_registry)
ACTOR = click.option(
    "--as", "actor", metavar="NAME", default=_system_user, show_default="the user of the system",
    help="Who acts, as the history states it.",
)  # fmt: skip


def check_outputs(
    outputs: Iterable[Path | None],
    inputs: Iterable[str | Path | None],
    picture: Path | None = None,
    page: Path | None = None,
    calibration: bool = False,
    form: str = "",
) -> None:
    """Refuse, before any work, an output that cannot be made or written, or would replace what must stay.

    That is an input, with every file in an input folder; a key; a file that a certificate lists; and a calibration,
    which another `calibration` alone may replace. `form` is the suffix of the outputs, where they have one form: with
    that of another they would be taken for it, as a page would.
    """
    from mwdcal.files.formats import atomic, members

    outputs = list(outputs)
    named = list(filter(None, [*outputs, picture, page]))
    targets = [atomic.target(path) for path in named]
    given = members.files_of(inputs)
    lost = _files(given) if any(target.exists() for target in targets) else set()
    taken: set[object] = set()
    for path, target in zip(named, targets, strict=True):
        file = atomic.identity(target)
        if file in lost:
            raise _refused(path, "it is an input, which would be lost")
        if file and file in (atomic.identity(1), atomic.identity(2)):
            raise _refused(path, "what the command prints goes there")
        names = {normalize("NFC", str(target)).casefold(), file} - {None}
        if names & taken:
            raise _refused(path, "it is named twice")
        if file:
            from mwdcal.files.documents import why_kept

            if why := why_kept(target, given, calibration and path not in (picture, page)):
                raise _refused(path, why)
        taken |= names
    _check_forms(outputs, form)
    _check_forms([page], ".html")
    if picture:
        from mwdcal.presentation.page import require

        if picture.suffix.lower() not in PICTURES:
            allowed = ", ".join(PICTURES)
            raise InputError(f"`plot` {picture}: the suffix must be one of {allowed}. Rename it.")
        require("a picture", "matplotlib")
    if page:
        from mwdcal.presentation.page import environment

        environment()


KNOWN_SUFFIXES = (
    ".json", ".toml", ".html", ".htm", ".pdf", ".png", ".svg", ".csv", ".tsv", ".xlsx", ".xls", ".ods", ".parquet",
)  # fmt: skip
"""Suffixes that say what a file holds."""
LIKENESS = 0.75
"""Share of letters in common, as of jsn or hmtl, from which a suffix is one of these, misspelt."""


def _check_forms(paths: Iterable[Path | None], form: str) -> None:
    """Refuse the suffix of another form than what is written, known or misspelt; any other is part of the name."""
    for path in filter(None, paths if form else ()):
        suffix = path.suffix.lower()
        names_form = suffix in KNOWN_SUFFIXES and suffix.startswith(form[:4])
        spellings = map(_letters, KNOWN_SUFFIXES)
        if not names_form and get_close_matches(_letters(suffix), spellings, cutoff=LIKENESS):
            why = f"it would hold {form[1:].upper()}, and its suffix says otherwise"
            raise _refused(path, why, path.with_suffix(form))


def _letters(suffix: str) -> str:
    """The letters of a suffix in the order of the alphabet: an exchange of two changes nothing."""
    return "".join(sorted(suffix[1:]))


def _refused(path: Path, why: str, better: Path | None = None) -> InputError:
    remedy = f"Write to '{better}'" if better else "Name another file"
    return InputError(f"cannot write '{path}': {why}. {remedy}.")


def _files(paths: Iterable[Path]) -> set[tuple[int, int] | None]:
    """The files behind the names, whatever their spelling; of a folder all that are in it."""
    from mwdcal.files.formats import atomic

    inside = [
        Path(folder, name) for path in paths for folder, _, names in os.walk(path) for name in names
    ]
    return {atomic.identity(path) for path in [*paths, *inside]} - {None}


def column_names(text: str) -> list[str]:
    """The names of a list with commas, each as typed."""
    return [name.strip() for name in text.split(",")] if text else []
