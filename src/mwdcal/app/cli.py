"""The command line: a thin twin of the library. Results on stdout, messages on stderr."""

from __future__ import annotations

import contextlib
import gc
import io
import os
import re
import sys
from collections.abc import Iterable, Iterator
from itertools import chain

import click

from mwdcal import __version__
from mwdcal.app import interruption
from mwdcal.app.commands import Commands
from mwdcal.app.messages import OPTION_GROUPS, say, screens
from mwdcal.errors import MwdcalError, reason
from mwdcal.presentation.text import escape_controls, laid_out, without_passwords

INTERNAL = 70
"""Exit status of a defect of the program."""
COMPLETION = "_MWDCAL_COMPLETE"
"""Variable with which a shell asks for completions, which are bytes."""
NEW_OBJECTS = 50_000
"""Objects after which garbage is looked for: many times as often, it would take 5 % of a short command."""
SECTIONS = {
    "Calibrate": {
        "bench": "Calibrate a tool live, in the browser, beside the stand",
        "init": "Write the laboratory's settings once, for all commands",
        "profile": "Propose a tool profile for a table as it comes",
        "stations": "Turn a continuous log into a run, a row for each station",
        "noise": "Measure the noise of every channel of a tool at rest",
        "calibrate": "Fit the sensor model to a calibration run",
        "verify": "Test a calibration by a roll test: pass or fail",
        "compare": "Calibrate a run by every method, side by side",
        "fleet": "Calibrate many tools at once",
    },
    "Use": {
        "apply": "Correct readings by a calibration",
        "convert": "Write a calibration in another notation, or for firmware",
        "diagnose": "Name the fault of a tool that readings show",
    },
    "Plan": {
        "plan": "See how accurate a calibration will be, and find stations",
        "simulate": "Simulate a run, or a procedure many times",
        "list": "List built-in plans, profiles, limits or methods",
        "example": "Write the files of the example into a folder",
    },
    "Well": {
        "reference": "Gravity, magnetic field and convergence at a place",
        "survey": "Survey a well with uncertainty, and test for interference",
    },
    "Laboratory": {
        "certificate": "Issue, sign and verify certificates",
        "registry": "Keep every tool's past in a database",
    },
    "Shell": {"completion": "Print the completion script of a shell"},
}
"""Modules of `mwdcal.app.commands` with a command of their name, in the order of the work, and what each does."""
_EXTRA = re.compile(r"Got unexpected extra argument \((.*)\)")
_EXTRA_FILES = {"--tool": "the tool profile", "--rolltest": "the roll test", "--plan": "a plan"}
"""Options of a file that may be meant where a command takes no more files, and what each is."""
_OF_TABLES = {
    "declination": "declination_deg = 2.4",
    "convergence": "convergence_deg = 0.5",
    "gravity": "ref_gravity_g = 1.0012",
    "field": "ref_field_nt = 50460",
    "dip": "ref_dip_deg = 68.1",
}
"""Words of options for what tables state, and the line that does."""
ALIASES = {
    "help": "mwdcal --help",
    "correct": "mwdcal apply",
    "report": "mwdcal calibrate … --report R.html",
    "test": "mwdcal verify",
    "fit": "mwdcal calibrate",
}
"""Commands by other names that people type for them."""
_MOST_COMMANDS = 3
"""Commands that a message names."""
_LONG = re.compile(r"([^'\n]{300})[^'\n]+")
"""A value that a message about a wrong option repeats, where it is too long to be read."""


class Sections(click.Group):
    """The commands, shown by section."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The command of a name; of another name, which is like it or means it, say so."""
        name = args[0]
        if name not in self.commands and (
            near := ALIASES.get(name) or _nearest(name, self.commands)
        ):
            ctx.fail(f"No such command {name!r}. Did you mean {near}?")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the sections of the help, each command with what it does in one line."""
        width = max(map(len, self.commands))
        for title, commands in SECTIONS.items():
            with formatter.section(title):
                formatter.write_dl([(name.ljust(width), does) for name, does in commands.items()])


@click.group(
    cls=Sections,
    commands=Commands({name: name for names in SECTIONS.values() for name in names}),
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(__version__, prog_name="mwdcal")
def cli() -> None:
    """Calibrate MWD directional sensors, verify the result, and apply it to readings.

    \b
    mwdcal calibrate run.csv --tool servo -o tool.json --report tool.html
    mwdcal verify tool.json rolltest.csv
    mwdcal apply tool.json surveys.csv -o corrected.csv
    """


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; no traceback ever reaches the user.

    Without `arguments` those of this process, which then runs nothing else.
    """
    if arguments is None:
        gc.set_threshold(NEW_OBJECTS)
        without_pandas()
    with contextlib.nullcontext() if COMPLETION in os.environ else screens():
        sys.exit(_status(arguments))


def _status(arguments: list[str] | None) -> int:
    """Run the command line; its exit status."""
    try:
        with interruption.orderly_end():
            return cli.main(arguments, prog_name="mwdcal", standalone_mode=False) or 0
    except click.ClickException as error:
        error = _with_nearest(error)
        error.show(usage := io.StringIO())
        indented = usage.getvalue().replace("\n\t", "\n  ")
        text = _LONG.sub(r"\1…", escape_controls(without_passwords(indented)))
        click.echo(laid_out(text, sys.stderr), err=True, nl=False)
        return error.exit_code
    except (click.Abort, KeyboardInterrupt) as stop:
        return _ended(*interruption.report(stop.__cause__ or stop))
    except MwdcalError as error:
        return _ended(str(error), error.exit_code, *getattr(error, "__notes__", ()))
    except MemoryError:
        return _ended(
            "not enough memory for this input. Split the file, or use a larger machine.", 2
        )
    except OSError as error:
        place = f"'{error.filename}': " if error.filename else ""
        advice = "Make room or choose another place, and run the command again."
        return _ended(f"{place}{reason(error)}. {advice}", 2)
    except Exception as error:
        if os.environ.get("MWDCAL_DEBUG"):
            raise
        return _ended(
            f"internal error ({type(error).__name__}: {error}). This is a defect of "
            "mwdcal: please report it with the command and the file. MWDCAL_DEBUG=1 shows where.",
            INTERNAL,
        )


def _nearest(word: str, names: Iterable[str]) -> str:
    """The name that is most like a word; empty if none is."""
    from difflib import get_close_matches

    return next(iter(get_close_matches(word, [*names], n=1)), "")


def _named(option: str, command: click.Command) -> click.Parameter | None:
    """The option of a command that has a name."""
    return next((each for each in command.params if option in each.opts), None)


def _commands_with(option: str, group: click.Group, words: str) -> Iterator[str]:
    """The commands of a group that have an option, each as it is typed."""
    for name in group.commands:
        command = group.commands[name]
        if isinstance(command, click.Group):
            yield from _commands_with(option, command, f"{words} {name}")
        elif _named(option, command):
            yield f"{words} {name}"


def _option_of_others(option: str, command: click.Command) -> str:
    """Which commands have an option that one has not; or that a profile says it, by which that one reads."""
    of_profile = _named(option, cli.commands["profile"])
    says = of_profile and of_profile.name not in (*chain(*OPTION_GROUPS.values()), "replace")
    if says and _named("--tool", command):
        return f" The tool profile says it: mwdcal profile TABLE {option} … -o TOOL.toml"
    others = [*_commands_with(option, cli, "mwdcal")]
    named = ", ".join(others[:_MOST_COMMANDS]) + " and others" * (len(others) > _MOST_COMMANDS)
    return f" It is an option of {named}." if others else ""


def _with_nearest(error: click.ClickException) -> click.ClickException:
    """The same error; of a wrong option with the one that is nearest, of a second file with its option."""
    if isinstance(error, click.NoSuchOption):
        word = error.option_name.lstrip("-").removeprefix("ref-").partition("-")[0]
        if word in _OF_TABLES:
            place = f"State it in a line above the table, such as '# {_OF_TABLES[word]}'"
            return click.UsageError(
                f"{error.message} {place}: mwdcal reference gives it.", error.ctx
            )
        nearest = _nearest(error.option_name, error.possibilities or [])
        if error.ctx and not nearest.startswith(error.option_name):
            others = _option_of_others(error.option_name, error.ctx.command)
            if others:
                return click.UsageError(f"{error.message}{others}", error.ctx)
        return click.NoSuchOption(error.option_name, None, [nearest] if nearest else [], error.ctx)
    context = error.ctx if isinstance(error, click.UsageError) else None
    extra = _EXTRA.fullmatch(error.message)
    if context and extra:
        known = {name for parameter in context.command.params for name in parameter.opts}
        wanted = ("--tool",) if extra[1].lower().endswith(".toml") else ("--rolltest", "--plan")
        for option in (name for name in wanted if name in known):
            question = f"{error.message}. Is it {_EXTRA_FILES[option]}? {option} {extra[1]}"
            return click.UsageError(question, context)
    return error


def _ended(message: str, status: int, *notes: str) -> int:
    """Say why the command ends, and what goes with it, a line each; the exit status."""
    for line in (f"mwdcal: {message}", *notes):
        say(line)
    return status


class WithoutPandas:
    """An import finder by which pandas is not installed.

    PyArrow loads pandas, where there is one, at the first array that it makes. That takes a
    quarter of a second, and mwdcal has no use for it.
    """

    def find_spec(self, name: str, path: object = None, target: object = None) -> None:
        """Refuse pandas, and leave all other modules to the finders that follow."""
        if name == "pandas":
            raise ModuleNotFoundError("mwdcal does without pandas", name=name)


def without_pandas() -> None:
    """To be called by processes that are ours alone: a command's own, and its workers."""
    sys.meta_path.insert(0, WithoutPandas())
