"""`mwdcal example`: the files of the bundled example."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result
from mwdcal.errors import InputError, shell_word

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

CONTENTS = {
    "run.csv": "a calibration run of 48 stations",
    "tool.toml": "its tool profile",
    "laboratory.toml": "what a laboratory states on its certificates",
    "rolltest.csv": "a roll test of the same tool",
    "surveys.csv": "readings to correct",
    "well.csv": "surveys of a well, with measured depths",
    "export.csv": "the run as a German spreadsheet program exports it",
    "log.csv": "a continuous log in which the tool rests six times",
    "static.csv": "a log of the tool at rest",
    "truth.json": "what the tool was simulated with",
}
"""The files and what they hold."""


@options.command()
@options.argument("folder", metavar="DIR")
@options.JSON
def command(folder: Path, as_json: bool) -> None:
    """Write the files of the bundled example into DIR: runs and logs of a simulated tool.

    DIR is created where there is none; no file in it is replaced.

    \b
    Example: mwdcal example demo
    Exit: 0 written, 2 a file of the same name is there, or DIR cannot be written.
    """
    from mwdcal.calibration.readings import SIMULATED
    from mwdcal.files.formats import atomic
    from mwdcal.presentation.envelope import ExampleDocument, json_document
    from mwdcal.presentation.text import one_line, page_option, table

    if folder.exists() and not folder.is_dir():
        raise InputError(f"cannot write into '{folder}': it is not a folder. Name another one.")
    files = [folder / name for name in CONTENTS]
    for file in files:
        if file.exists() or file.is_symlink():
            raise InputError(f"cannot write '{file}': it exists already. Name another folder.")
    source = bundled()
    contents = [source.joinpath(name).read_bytes() for name in CONTENTS]
    folder.mkdir(parents=True, exist_ok=True)
    atomic.write_all(zip(files, contents, strict=True))
    names = ("run.csv", "tool.toml", "tool.json")
    run, tool, result = (shell_word(str(folder / name)) for name in names)
    rows = [[str(file), what] for file, what in zip(files, CONTENTS.values(), strict=True)]
    screen = f"{table(rows, [f'wrote, all {SIMULATED}', ''])}\n\n"
    page = page_option(folder / "tool.html")
    screen += one_line(f"next: mwdcal calibrate {run} --tool {tool} -o {result}{page}")
    written = ExampleDocument(folder=str(folder), files=[str(file) for file in files])
    document = json_document("example", written, {"simulated": True})
    print_result(document if as_json else screen)


def bundled() -> Traversable:
    """The folder of the files: in the package, or, in a copy of the repository, beside its source."""
    package = resources.files("mwdcal")
    installed = package.joinpath("example")
    return installed if installed.is_dir() else package.joinpath("..", "..", "examples", "servo")
