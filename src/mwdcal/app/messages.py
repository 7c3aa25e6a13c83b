"""The output of commands: results on stdout, messages and findings on stderr, errors in their words.

Both streams take any text in any encoding; one that is closed, or that nobody reads, is not an error.
"""

from __future__ import annotations

import codecs
import contextlib
import errno
import json
import os
import re
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import click

from mwdcal.app import laboratory
from mwdcal.calibration.fit_options import FIT_OPTIONS
from mwdcal.errors import InputError, MwdcalError, QuestionError, QuestionsError, reason
from mwdcal.presentation.text import (
    PATIENCE,
    UNSAFE_BUT_LINES,
    escape_controls,
    laid_out,
    one_line,
    to_json,
    transliterate,
    without_passwords,
)
from mwdcal.presentation.text import slowly as slowly
from mwdcal.presentation.typed import leading_findings, with_option_names

if TYPE_CHECKING:
    from mwdcal.calibration.record import Finding


# --------------------------------------------------------------------------
# Progress of work that takes more than two seconds: a bar where stderr is a terminal, or words.


MOMENT = 0.1
"""Seconds after which a bar moves."""
LINE_AFTER = 5.0
"""Seconds after which a line says what is being done, where no terminal shows a bar."""


@contextmanager
def bar(label: str) -> Iterator[Callable[[int, int], None]]:
    """A function to call with how much is done, and of how much.

    The bar also moves while that is not known. Without a terminal a line says once what is being done.
    """
    if quiet():
        yield lambda done, total: None
        return
    known: dict[str, Any] = {"completed": 0, "total": None}
    over = threading.Event()
    show = _show if sys.stderr.isatty() else _say_once
    shows = threading.Thread(target=show, args=(label, known, over))
    shows.start()
    try:
        yield lambda done, total: known.update(completed=done, total=total)
    finally:
        over.set()
        shows.join()


def _show(label: str, known: Mapping[str, Any], over: threading.Event) -> None:
    """Show what is known until it is over, unless that is soon."""
    if over.wait(PATIENCE):
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as shown:
        task = shown.add_task(escape(label), **known)
        while not over.wait(MOMENT):
            shown.update(task, **known)
        shown.update(task, **known)


def _say_once(label: str, known: Mapping[str, Any], over: threading.Event) -> None:
    """Say what is being done, unless it is over soon."""
    if not over.wait(LINE_AFTER):
        share = f": {known['completed']} of {known['total']}" if known["total"] else ""
        say(f"{label}{share} …")


LONGEST_MESSAGE = 2000
"""Characters of a message that are shown: what a file is named or says may be of any length."""
ONLY_ERRORS = "mwdcal.quiet"
"""Where the context of a command says that it prints only errors, and JSON."""
LABORATORY = "mwdcal.settings"
"""Where the context of a command has the laboratory's settings."""
COLOURS = {"!": "yellow", "PASS": "green", "pass": "green", "FAIL": "red"}
"""Colours of marks and verdicts on a terminal, where the words alone say the same."""
READER_HAS_LEFT = {errno.EPIPE, errno.EINVAL} if sys.platform == "win32" else {errno.EPIPE}
"""Numbers of the error of a pipe that nobody reads; Windows calls it an invalid argument."""
_MARKED = re.compile(r"^(!|PASS|FAIL)(?=:? )|(?<=   )(pass|FAIL)(?=   |$)", re.MULTILINE)
"""A mark or verdict at the beginning of a line, or alone in a cell of a table."""


OPTION_GROUPS = {
    "Table options": (
        "serial",
        "day",
        "date",
        "operator",
        "decimal",
        "columns",
        "missing",
        "outside",
        "sampling_hz",
    ),
    "Fit options": (*FIT_OPTIONS, "exclude"),
    "Output options": ("output", "report", "plot", "as_json", "quiet", "help"),
}
"""Titles of the groups of a command's options below its own, and the names of those in each."""
FEW_OPTIONS = 8
"""A command with no more options shows them in one group."""


class Command(click.Command):
    """A command whose errors name its options as they are typed, and which can be quiet."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        words = "Print nothing but errors and, with --json, the result."
        self.params.append(
            click.Option(
                ["--quiet"], is_flag=True, expose_value=False, callback=_be_quiet, help=words
            )
        )

    def parse_args(self, context: click.Context, args: list[str]) -> list[str]:
        """Read the arguments, which are all text: outputs name the files that they are made of."""
        for word in args:
            if word != word.encode("utf-8", "ignore").decode():
                raise InputError(f"'{word}': a name must be valid UTF-8. Rename the file.")
        if used := laboratory.settings_of(self, context, args):
            context.meta[LABORATORY] = used
        return super().parse_args(context, args)

    def get_help(self, context: click.Context) -> str:
        """The help, as wide as the terminal."""
        return laid_out(super().get_help(context), sys.stdout)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options in groups: those of the command first."""
        shown = [(p.name, p.get_help_record(ctx)) for p in self.get_params(ctx)]
        records = [(name, record) for name, record in shown if record is not None]
        titles = {name: title for title, names in OPTION_GROUPS.items() for name in names}
        groups: dict[str, list[tuple[str, str]]] = {"Options": []}
        groups |= {title: [] for title in OPTION_GROUPS}
        few = len(records) <= FEW_OPTIONS
        for name, record in records:
            groups["Options" if few else titles.get(name or "", "Options")].append(record)
        for title, rows in groups.items():
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)

    def invoke(self, context: click.Context) -> Any:
        """Run the command with the laboratory's settings, and say what it used of them."""
        used = context.meta.get(LABORATORY)
        if used:
            laboratory.note_options(context, used)
        try:
            with laboratory.using(used):
                return super().invoke(context)
        except MwdcalError as error:
            error.args = (with_option_names(self._with_remedy(error)),)
            raise
        finally:
            if used and (line := laboratory.line_on(used)):
                say(line)

    def _with_remedy(self, error: MwdcalError) -> str:
        """The text of an error; of a question that only a profile can answer here, with how to make one."""
        if not isinstance(error, QuestionError | QuestionsError):
            return str(error)
        options = {parameter.name for parameter in self.params}
        if isinstance(error, QuestionsError) or not error.answers:
            return error.with_options
        needed = {name for answer in error.answers for name, _ in answer.arguments}
        if needed <= options:
            return error.with_options
        remedy = f"mwdcal profile TABLE {error.answers[0].options} -o TOOL.toml"
        return f"{error.text} Say it in a profile ({remedy}), and give `tool` TOOL.toml."


def _be_quiet(context: click.Context, option: click.Parameter, typed: bool) -> None:
    """Note that `--quiet` was typed."""
    context.meta[ONLY_ERRORS] = typed


def quiet() -> bool:
    """Whether the command that runs was told to print nothing but errors and JSON."""
    context = click.get_current_context(silent=True)
    return bool(context and context.meta.get(ONLY_ERRORS))


class Screen:
    """A standard stream that shows any text in the characters that its encoding has.

    Without a `stream`, or once its reader has left, what is written goes nowhere. A stream that fails
    otherwise is a refusal; not one of messages, which could not be read either.
    """

    def __init__(self, stream: IO[str] | None, messages: bool = False) -> None:
        self._stream = stream or Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115
        self._messages = messages

    def __getattr__(self, name: str) -> Any:
        """The attributes that a terminal is asked for: its encoding, its descriptor; not its bytes."""
        if name not in ("closed", "encoding", "fileno", "isatty"):
            raise AttributeError(name)
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write text; control characters in it are up to the writer."""
        shown = transliterate(text, self.encoding)
        with self._given_up_when_it_fails():
            if shown:  # click tries with nothing, and takes no notice of a failure
                self._stream.write(shown)
        return len(text)

    def flush(self) -> None:
        """Write what is still kept back."""
        with self._given_up_when_it_fails():
            self._stream.flush()

    @contextlib.contextmanager
    def _given_up_when_it_fails(self) -> Iterator[None]:
        """So that what is left in it does not fail once more when the process ends."""
        try:
            yield
        except OSError as error:
            with contextlib.suppress(OSError), Path(os.devnull).open("wb") as nothing:
                os.dup2(nothing.fileno(), self._stream.fileno())
            if not self._messages and error.errno not in READER_HAS_LEFT:
                message = f"cannot write the result: {reason(error)}. Send it elsewhere."
                raise InputError(message) from error


@contextlib.contextmanager
def screens() -> Iterator[None]:
    """Stdout and stderr as `Screen`s."""
    _occupy_closed_descriptors()
    out: Any = Screen(sys.stdout)
    messages: Any = Screen(sys.stderr, messages=True)
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(messages):
        yield


def _occupy_closed_descriptors() -> None:
    """No file that is opened later becomes stdin, stdout or stderr of this process or its workers."""
    while (descriptor := os.open(os.devnull, os.O_RDWR)) < 3:
        os.set_inheritable(descriptor, True)
    os.close(descriptor)


def say(text: str) -> None:
    """A message for people, on stderr, unless the command is quiet; of a very long one both ends."""
    if quiet():
        return
    line = one_line(without_passwords(text))
    if len(line) > LONGEST_MESSAGE:
        line = f"{line[: LONGEST_MESSAGE // 2]} … {line[-LONGEST_MESSAGE // 4 :]}"
    click.echo(_on_screen(line, sys.stderr), err=True)


def _on_screen(text: str, stream: Any) -> str:
    """Text as a stream gets it: a terminal, folded lines, and colours if it shows them."""
    shown = laid_out(text, stream)
    if not stream.isatty() or os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return shown
    return _MARKED.sub(lambda word: click.style(word[0], fg=COLOURS[word[0]], bold=True), shown)


def lines(findings: Iterable[Finding]) -> list[str]:
    """Findings, one line each."""
    return [one_line(f"! {with_option_names(finding.text)}") for finding in findings]


def print_result(result: Any, findings: Iterable[Finding] = ()) -> None:
    """The result on stdout, text for people or else JSON; then findings on stderr, the most important first."""
    if not isinstance(result, str):
        click.echo(_shown(to_json(result)))
    elif not quiet():
        click.echo(_on_screen(escape_controls(result), sys.stdout))
    shown, left = leading_findings(findings)
    for line in lines(shown):
        say(line)
    if left:
        say(f"! and {left} more: see the report, or --json")


def _shown(document: str) -> str:
    """JSON in characters that do not control a terminal; in ASCII where stdout is not in UTF-8, as JSON must be."""
    unicode = codecs.lookup(sys.stdout.encoding or "utf-8").name == "utf-8"
    others = UNSAFE_BUT_LINES if unicode else re.compile(r"[^\x00-\x7e]")
    return others.sub(lambda character: json.dumps(character[0])[1:-1], document)


@contextlib.contextmanager
def offering_blank() -> Iterator[None]:
    """Name the option that leaves the results of a row without readings blank, where one is refused."""
    from mwdcal.files.contract import BlankReadingError

    try:
        yield
    except BlankReadingError as error:
        raise InputError(
            f"{error} Or leave the results of such rows blank: --missing blank."
        ) from None
