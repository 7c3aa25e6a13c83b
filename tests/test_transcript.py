"""The lines of docs/tutorials/transcript.md, run again on the tables that it names: what it shows is printed."""

import json
import re
import shutil
import time

import pytest

from cli_support import ROOT, mwdcal

PAGE = (ROOT / "docs" / "tutorials" / "transcript.md").read_text("utf-8")
BLOCKS = re.findall(r"```console\n(.*?)```", PAGE, re.DOTALL)
FIVE_MINUTES = 300.0


def commands_of(block):
    """The command lines of a block, each with the lines that it shows of its output."""
    parts = re.split(r"^\$ mwdcal ", block.replace("\\\n", ""), flags=re.MULTILINE)[1:]
    return [(part.split("\n")[0].split(), part.strip().split("\n")[1:]) for part in parts]


def plain(line):
    return " ".join(line.split())


@pytest.fixture
def folder(tmp_path, monkeypatch):
    for path in (ROOT / "examples" / "laboratories").iterdir():
        if path.suffix in (".csv", ".xlsx"):
            shutil.copy(path, tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("place", range(len(BLOCKS)))
def test_the_transcript_is_what_the_commands_print(folder, place):
    begun = time.process_time()
    tables = {path: path.read_bytes() for path in folder.iterdir()}
    for arguments, shown in commands_of(BLOCKS[place]):
        ran = mwdcal(*arguments)
        asked = any(line.startswith("mwdcal: ") for line in shown)
        assert ran.code == (3 if asked else 0), ran
        printed = "\n".join(map(plain, (ran.out + ran.err).splitlines()))
        assert set(shown) != {"…"}
        assert [line for line in shown if line != "…" and plain(line) not in printed] == []
    assert time.process_time() - begun < FIVE_MINUTES
    assert all(path.read_bytes() == data for path, data in tables.items()), "no table is touched"


def test_three_tables_reach_a_verdict():
    assert sum("PASS" in block for block in BLOCKS) == 3


def test_the_stand_of_the_first_step_is_one_of_a_profile(folder):
    """The table that the page tells to add, below a proposal that has it as a comment."""
    stand = re.search(r"```toml\n(\[stand\].*?)```", PAGE, re.DOTALL)[1]
    assert PAGE.index(stand) < PAGE.index("## ")
    assert mwdcal("profile", "celle_c1187.csv", "-o", "tool.toml").code == 0
    with open("tool.toml", "a", encoding="utf-8") as profile:
        profile.write(stand)
    ran = mwdcal("calibrate", "celle_c1187.csv", "--tool", "tool.toml", "-o", "tool.json", "--json")
    assert ran.code == 0
    record = json.loads((folder / "tool.json").read_text("utf-8"))
    assert record["profile"]["stand"]["azimuth_deg"] == 0.05
