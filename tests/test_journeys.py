"""How much of the package a command runs through: modules, folders, and functions."""

import subprocess
import sys
from pathlib import Path

import pytest

import mwdcal
from cli_support import EXAMPLE

PACKAGE = Path(mwdcal.__file__).parent
MODULES, FUNCTIONS, FOLDERS = 64, 792, 15
TRACED = """
import inspect
import sys
from pathlib import Path
package, seen = sys.argv[1], set()
def note(frame, event, argument):
    code = frame.f_code
    named = code.co_flags & inspect.CO_OPTIMIZED and code.co_name[0] != "<"
    if event == "call" and named and code.co_filename.startswith(package):
        seen.add((code.co_filename, code.co_firstlineno))
from mwdcal.app import cli
try:  # places of panels are found by Matplotlib alone, which takes most of the time
    from matplotlib.figure import Figure
    Figure.set_layout_engine = lambda *given, **options: None
except ImportError:
    pass
sys.setprofile(note)
try:
    cli.main(sys.argv[2:])
except SystemExit as end:
    assert not end.code, end.code
finally:
    sys.setprofile(None)
    for file, line in sorted(seen):
        print(Path(file).relative_to(package).as_posix(), line, file=sys.stderr)
"""


def journey(*arguments):
    """The functions of the package that a command calls, without bodies of classes: (module, line)."""
    command = [sys.executable, "-c", TRACED, str(PACKAGE), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, encoding="utf-8", check=True)
    lines = (line.rpartition(" ") for line in done.stderr.splitlines() if not line.startswith("!"))
    return {(module, line) for module, _, line in lines if module.endswith(".py")}


@pytest.fixture(scope="module")
def tool(tmp_path_factory):
    path = tmp_path_factory.mktemp("journey") / "tool.json"
    return path, journey("calibrate", EXAMPLE / "run.csv", "--tool", "servo", "-o", path)


def test_a_calibration_runs_through_few_modules(tool):
    """The aim was 45; each module more is one that a reader of this command must open."""
    modules = {module for module, _ in tool[1]}
    assert len(modules) <= MODULES, sorted(modules)
    assert len(tool[1]) <= FUNCTIONS


def test_a_page_of_surveys_runs_through_few_folders(tool, tmp_path):
    """The aim was 12. Two of these are the estimator's, which says whether the axes are those of the columns."""
    pytest.importorskip("matplotlib")
    pytest.importorskip("jinja2")
    page = ("-o", tmp_path / "out.csv", "--report", tmp_path / "out.html")
    seen = journey("survey", tool[0], EXAMPLE / "well.csv", *page)
    folders = {str(Path(module).parent) for module, _ in seen}
    assert len(folders) <= FOLDERS, sorted(folders)
