"""`mwdcal example`: the bundled files, also where only the package is installed, and the lines that use them."""

import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

import mwdcal as library
from cli_support import EXAMPLE, ROOT, mwdcal, refused
from mwdcal import extras
from mwdcal.app.commands.example import CONTENTS
from page_lines import follow_each_other, lines_of

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


FIRST_PAGES = (
    "README.md",
    *(f"docs/tutorials/{name}.md" for name in ("start", "campaign", "well")),
)
"""Pages whose every line runs, and whose outputs are those of the commands but for lines of dots."""


@pytest.mark.slow
@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize("page", FIRST_PAGES)
def test_every_line_of_the_first_pages_runs(tmp_path, monkeypatch, page):
    pytest.importorskip("matplotlib")
    runs = lines_of(page)
    assert runs[0][0] == "example demo"
    assert sum(shown is not None for _, shown in runs) >= 1
    monkeypatch.chdir(tmp_path)
    for line, shown in runs:
        ran = mwdcal(*shlex.split(line))
        assert ran.code == 0, (line, ran)
        if shown:
            printed = "\n".join(map(str.rstrip, ran.out.splitlines()))
            assert follow_each_other(shown, printed), (line, shown, printed)


def test_the_python_tutorial_calibrates_a_table_with_its_own_names(tmp_path, monkeypatch, capsys):
    """The references of the export are those of the stand; its last digits and the stand's σ leave 0.1°."""
    pytest.importorskip("pandas")
    page = (ROOT / "docs" / "tutorials" / "python.md").read_text("utf-8")
    lines = page.split("```python\n")[1].split("```")[0]
    assert len([line for line in lines.splitlines() if line and not line.startswith("import")]) <= 9
    monkeypatch.chdir(tmp_path)
    assert mwdcal("example", "demo").code == 0
    seen = {}
    exec(lines, seen)
    assert capsys.readouterr().out.splitlines() == [each.text for each in seen["cal"].findings]
    factors = seen["factors"].set_index(["triad", "name"])
    assert factors.unit["accelerometer"][["SFx", "Bx", "mxy"]].tolist() == ["mg/g", "g", "rad"]
    assert factors.unit["magnetometer"][["SFx", "Bx", "mxy"]].tolist() == ["nT/nT", "nT", "rad"]
    assert len(factors) == 24
    assert (factors["sd"] > 0).all()
    for triad in seen["cal"].triads:  # channel x measures the tool's z axis
        offsets = dict(zip(triad.parameter_names, triad.parameters, strict=True))
        assert offsets["offset-z"] == pytest.approx(-factors.value[triad.name, "Bx"], rel=0.02)
    angles = seen["angles"]
    assert angles["Messpunkt"].tolist() == list(range(1, 49))
    assert (angles["inclination_deg"] - angles["Neigung Soll (°)"]).abs().max() < 0.1
    again = library.calibrate(seen["df"], seen["profile"])
    np.testing.assert_allclose(again.accelerometer.parameters, seen["cal"].accelerometer.parameters)


def test_the_next_commands_are_those_of_the_first_page(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    lines = (ROOT / "README.md").read_text("utf-8").splitlines()
    for command in ("example demo", "profile demo/export.csv -o export.toml"):
        following = mwdcal(*command.split()).out.rpartition("next: ")[2].strip()
        assert following in [line.removeprefix("$ ") for line in lines]


def test_the_next_commands_run_with_blanks_in_the_names_of_files(tmp_path, monkeypatch):
    """As a shell takes them apart, from the example to the verdict."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my stand").mkdir()

    def following(*words):
        done = mwdcal(*words)
        assert done.code == 0, done
        name, *rest = shlex.split(done.out.rpartition("next: ")[2].splitlines()[0])
        assert name == "mwdcal"
        return rest

    verify = following(*following("example", "my stand/demo (2)"))
    assert verify[:2] == ["verify", str(Path("my stand", "demo (2)", "tool.json"))]
    shutil.copy("my stand/demo (2)/rolltest.csv", "roll test.csv")
    assert mwdcal("verify", verify[1], "roll test.csv").code == 0
    shutil.copy("my stand/demo (2)/export.csv", "my export.csv")
    calibrate = following("profile", "my export.csv", "-o", "my tool.toml")
    assert calibrate[:4] == ["calibrate", "my export.csv", "--tool", "my tool.toml"]
    shutil.copy("my stand/demo (2)/tool.toml", "my servo.toml")
    simulated = ("simulate", "--plan", "moosavi-12", "--tool", "my servo.toml", "-o", "my run.csv")
    repeated = following(*simulated, "--truth", "t.json")
    assert repeated[:4] == ["calibrate", "my run.csv", "--tool", "my servo.toml"]
    assert mwdcal(*repeated).code == 0
    assert following(*calibrate)[:2] == ["verify", "my tool.json"]
    for tool in ((), ("--tool", "my export.csv")):
        message = refused(mwdcal("calibrate", "my export.csv", "-o", "x.json", *tool), 2)
        assert 'mwdcal profile "my export.csv" -o tool.toml' in message


def test_a_page_that_shows_another_line_is_noticed():
    printed = "one\ntwo\nthree\nfour"
    assert follow_each_other(["one", "…", "three", "four"], printed)
    assert follow_each_other(["…", "two", "three", "…"], printed)
    assert not follow_each_other(["one", "…", "3", "four"], printed)
    assert not follow_each_other(["one", "…", "four", "three"], printed)
    assert not follow_each_other(["one", "three", "…"], printed)
    assert not follow_each_other(["one", "two", "three"], printed)


BASE = """
import sys
from mwdcal.app.cli import main

sys.modules |= dict.fromkeys(sys.argv[1].split(","))
for line in sys.stdin.read().splitlines():
    try:
        main(line.split())
    except SystemExit as stop:
        assert not stop.code, line
"""
"""Runs command lines where some modules are not installed."""


def test_without_extras_all_commands_on_text_tables_run(tmp_path):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    needed = [each for some in project["optional-dependencies"].values() for each in some]
    names = {re.split(r"[\[>=]", each)[0] for each in needed} - {"mwdcal"}
    absent = ",".join(sorted(name.replace("-", "_") for name in names))
    lines = (
        "example demo",
        "calibrate demo/run.csv --tool demo/tool.toml -o tool.json",
        "verify tool.json demo/rolltest.csv",
        "profile demo/export.csv -o export.toml",
        "stations demo/log.csv -o stations.csv",
        "noise demo/static.csv",
        "plan --plan six-state --tool demo/tool.toml -o plan.csv",
        "apply tool.json demo/surveys.csv -o corrected.csv",
        "survey tool.json demo/well.csv -o well.csv",
        "diagnose tool.json demo/rolltest.csv",
        "convert tool.json --notation forward",
        "certificate tool.json --laboratory demo/laboratory.toml",
    )
    command = [sys.executable, "-c", BASE, absent]
    environment = {**os.environ, "PYTHONUTF8": "1"}
    options = {"cwd": tmp_path, "env": environment, "capture_output": True, "text": True}
    done = subprocess.run(command, input="\n".join(lines), check=False, **options)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "-o demo/tool.json\n" in done.stdout
    assert "--report" not in done.stdout
    done = subprocess.run(
        command, input="registry --database tools.sqlite init", check=False, **options
    )
    assert extras.command("registry") in done.stderr
    assert done.returncode
