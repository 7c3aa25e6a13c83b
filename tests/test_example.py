"""`mwdcal example`: the bundled files, also where only the package is installed, and the lines that use them."""

import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib

import pytest

from cli_support import EXAMPLE, ROOT, mwdcal, refused
from mwdcal.app.commands.example import CONTENTS

WHEEL = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["hatch"]["build"]
INCLUDED = WHEEL["targets"]["wheel"]["force-include"]


def test_the_files_are_those_of_the_repository(tmp_path):
    ran = mwdcal("example", tmp_path / "new" / "demo", "--json")
    assert ran.code == 0
    assert ran.json["simulated"] is True
    written = sorted((tmp_path / "new" / "demo").iterdir())
    assert sorted(ran.json["files"]) == [str(file) for file in written]
    assert {file.name for file in written} == {*CONTENTS}
    for file in written:
        assert file.read_bytes() == (EXAMPLE / file.name).read_bytes()
        assert file.name in mwdcal("example", tmp_path / "again" / file.name).out


@pytest.mark.parametrize("name", ["run.csv", "truth.json"])
def test_no_file_is_replaced(tmp_path, name):
    (tmp_path / name).write_text("mine")
    assert name in refused(mwdcal("example", tmp_path), 2)
    assert [file.name for file in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "mine"


def test_a_file_is_not_a_folder(tmp_path):
    (tmp_path / "demo").write_text("mine")
    assert "it is not a folder" in refused(mwdcal("example", tmp_path / "demo"), 2)


def test_an_installed_package_has_the_files(tmp_path):
    """As the wheel is built: the package, and what the build configuration adds."""
    assert {f"mwdcal/example/{name}" for name in CONTENTS} == {*INCLUDED.values()}
    shutil.copytree(ROOT / "src" / "mwdcal", tmp_path / "site" / "mwdcal")
    (tmp_path / "site" / "mwdcal" / "example").mkdir()
    for source, target in INCLUDED.items():
        shutil.copy(ROOT / source, tmp_path / "site" / target)
    command = [sys.executable, "-m", "mwdcal", "example", "demo"]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "site")}
    subprocess.run(command, cwd=tmp_path, env=environment, check=True, capture_output=True)
    for name in CONTENTS:
        assert (tmp_path / "demo" / name).read_bytes() == (EXAMPLE / name).read_bytes()


@pytest.mark.slow
@pytest.mark.usefixtures("without_layout")
@pytest.mark.parametrize("page", ["README.md", "docs/start.md"])
def test_every_line_of_the_first_pages_runs(tmp_path, monkeypatch, page):
    pytest.importorskip("matplotlib")
    text = (ROOT / page).read_text("utf-8")
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    of_line = re.compile(r"^(\$ )?mwdcal (.*)\n((?:(?!\$ |mwdcal ).*\n)*)", re.MULTILINE)
    runs = [run for language, block in blocks if not language for run in of_line.findall(block)]
    lines = [line for _, line, _ in runs]
    assert lines[0] == "example demo"
    assert "compare demo/run.csv --tool demo/tool.toml" in lines
    monkeypatch.chdir(tmp_path)
    for dollar, line, output in runs:
        ran = mwdcal(*shlex.split(line))
        assert ran.code == 0, (line, ran)
        if dollar and output.strip():
            assert [*map(str.rstrip, ran.out.splitlines())] == output.rstrip().split("\n"), line
