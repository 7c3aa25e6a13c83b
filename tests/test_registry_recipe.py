"""The recipe of the documentation, line by line, with two tools instead of two hundred."""

import json
import re
import shlex

import pypdf
import pytest

from cli_support import ROOT, mwdcal

pytest.importorskip("pyarrow")
pytest.importorskip("sqlalchemy")
pytest.importorskip("cryptography")

from test_registry_files import laboratory

PAGE = ROOT / "docs" / "tutorials" / "year.md"
FAILS = "as-found.json"
"""What the roll test of the tool that was knocked is written to: it does not pass."""


def recipe():
    """The lines of the page's recipe."""
    blocks = re.findall(r"<!-- recipe -->\n```\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    return [line for block in blocks for line in block.splitlines()]


@pytest.mark.usefixtures("without_layout")
def test_the_recipe_leads_from_an_empty_folder_to_a_signed_certificate(tmp_path, monkeypatch):
    first, second, *lines = recipe()
    assert first == "python examples/registry/laboratory.py laboratory --tools 200"
    assert second == "cd laboratory"
    laboratory().laboratory(tmp_path / "laboratory", 2, 5)
    monkeypatch.chdir(tmp_path / "laboratory")
    shown = {}
    for line in lines:
        typed, _, target = line.partition(" > ")
        program, *words = shlex.split(typed)
        ran = mwdcal(*words)
        assert (program, ran.code) == ("mwdcal", int(target == FAILS)), (line, ran)
        shown[" ".join(words)] = ran.out
        if target:
            (tmp_path / "laboratory" / target).write_text(ran.out, "utf-8")
    assert any(out.startswith("PASS   tools.sqlite: sound") for out in shown.values())
    certificate = json.loads((tmp_path / "laboratory" / "certificate.json").read_bytes())
    assert (certificate["as_found"]["passed"], certificate["as_left"]["passed"]) == (False, True)
    assert certificate["simulated"]
    assert any(
        "accelerometer bias-y between 2025" in remark["text"] for remark in certificate["findings"]
    )
    pages = pypdf.PdfReader(tmp_path / "laboratory" / "certificate.pdf").pages
    assert any("Biases from calibration to calibration" in page.extract_text() for page in pages)
    ran = mwdcal("registry", "--registry", "tools.sqlite", "history", "SIM-0001", "--json")
    kinds = [record["kind"] for record in ran.json["records"]]
    expected = {"calibration": 5, "run": 7, "verification": 3, "certificate": 1}
    assert {kind: kinds.count(kind) for kind in kinds} == expected
    ran = mwdcal("registry", "--registry", "tools.sqlite", "drift", "SIM-0001", "--json")
    inclination = next(
        r for r in ran.json["tool"]["service"] if r["name"] == "spread of inclination"
    )
    assert (inclination["as_left_passed"], inclination["as_found_passed"]) == (True, False)
    due = mwdcal("registry", "--registry", "tools.sqlite", "list", "--due", "2027-06-01", "--json")
    assert [tool["next_due"] for tool in due.json["tools"]] == [certificate["next_due"]]
