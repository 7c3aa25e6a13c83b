"""The command line: a thin twin of the library. Results on stdout, messages on stderr."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping
from importlib import import_module

import click

from mwdcal import __version__
from mwdcal.app import interruption
from mwdcal.app.block_pandas import without_pandas
from mwdcal.app.messages import say
from mwdcal.errors import MwdcalError

INTERNAL = 70
"""Exit status of a defect of the program."""
COMMANDS = (
    *("apply", "calibrate", "compare", "completion", "convert"),
    *("fleet", "noise", "stations", "verify"),
)
"""Modules of `mwdcal.app.commands` with a command of their name."""


class Commands(Mapping[str, click.Command]):
    """The commands by name; each is imported when it is asked for."""

    def __getitem__(self, name: str) -> click.Command:
        """The command of the module of that name."""
        if name not in COMMANDS:
            raise KeyError(name)
        command: click.Command = import_module(f"mwdcal.app.commands.{name}").command
        return command

    def __iter__(self) -> Iterator[str]:
        """The names of the commands."""
        return iter(COMMANDS)

    def __len__(self) -> int:
        """The number of commands."""
        return len(COMMANDS)


@click.group(
    commands=Commands(),
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
        without_pandas()
    try:
        with interruption.orderly_end():
            code = cli.main(arguments, prog_name="mwdcal", standalone_mode=False)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except (click.Abort, KeyboardInterrupt) as stop:
        message, code = interruption.report(stop.__cause__ or stop)
        _end(message, code)
    except MwdcalError as error:
        _end(str(error), error.exit_code)
    except MemoryError:
        _end("not enough memory for this input. Split the file, or use a larger machine.", 2)
    except OSError as error:
        _end(_unwritable(error), 2)
    except Exception as error:
        if os.environ.get("MWDCAL_DEBUG"):
            raise
        _end(
            f"internal error ({type(error).__name__}: {error}). This is a defect of "
            "mwdcal: please report it with the command and the file. MWDCAL_DEBUG=1 shows where.",
            INTERNAL,
        )
    if isinstance(code, int):
        sys.exit(code)


def _unwritable(error: OSError) -> str:
    """Give up stdout; why, but for a reader that has left."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if isinstance(error, BrokenPipeError):
        return ""
    return f"cannot write the result: {error.strerror or error}. Send it elsewhere."


def _end(message: str, code: int) -> None:
    """Print why the command ends, if there is anything to say, and exit."""
    if message:
        say(f"mwdcal: {message}")
    sys.exit(code)
