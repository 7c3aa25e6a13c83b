"""The selftest: it passes here, fails where a number is wrong, and its record says what was tested."""

import json
import subprocess
import sys
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from mwdcal.errors import InputError
from mwdcal.selftest import cases as room
from mwdcal.selftest import record as records
from mwdcal.selftest.cases import SelftestCase, cases
from mwdcal.selftest.record import SelftestRecord, as_text, screen, selftest

EACH = cases()


@pytest.fixture(scope="module")
def record():
    return selftest()


def ran(*arguments):
    command = [sys.executable, "-m", "mwdcal.selftest", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, encoding="utf-8", check=False)


def test_every_case_passes_or_says_why_it_was_not_run(record):
    outcomes = {row.name: row.outcome for row in record.rows}
    assert "FAIL" not in outcomes.values()
    assert all(row.note for row in record.rows if row.outcome == "not run")
    assert len(outcomes) == len(EACH)
    assert sum(row.count for row in record.rows) > 1000


@pytest.mark.parametrize(
    "case", [case for case in EACH if "wheel" not in case.name], ids=lambda c: c.name
)
def test_a_case_fails_where_its_smallest_value_is_off(case):
    """By three times what is allowed: so no allowance hides an error of the last printed digit."""
    expected, computed = case.values()
    wrong = np.ravel(np.array(computed, float))
    wrong[np.abs(wrong).argmin()] += 3 * max(case.allowed, 1e-12)
    row = replace(case, values=lambda: (np.ravel(expected), wrong)).run()
    assert row.outcome == "FAIL"


def broken():
    raise ZeroDivisionError("no")


def absent():
    raise InputError("pygeomag is not installed")


@pytest.mark.parametrize(
    ("values", "outcome"),
    [
        (lambda: ([1.0], [1.0]), "PASS"),
        (lambda: ([1.0], [np.nan]), "FAIL"),
        (lambda: ([1.0, 2.0], [1.0]), "FAIL"),
        (lambda: ([], []), "FAIL"),
        (broken, "FAIL"),
        (absent, "not run"),
    ],
)
def test_outcomes(values, outcome):
    assert SelftestCase("n", "a", "", 1e-9, values).run().outcome == outcome


def test_a_failed_case_fails_the_whole(monkeypatch):
    wrong = SelftestCase("n", "a", "", 0.0, lambda: ([1.0], [2.0]))
    monkeypatch.setattr(records, "cases", lambda: [*EACH[:2], wrong])
    failed = selftest()
    assert not failed.passed
    assert screen(failed).startswith("FAIL")
    assert "next: " in screen(failed)
    assert as_text(failed).sections[0].blocks[0].outcomes[0].word == "FAIL"


def test_a_changed_file_of_the_package_shows_in_its_digest(record, monkeypatch, tmp_path):
    (tmp_path / "a.py").write_text("1")
    monkeypatch.setattr(records, "PACKAGE", tmp_path)
    first = selftest().package_sha256
    (tmp_path / "a.py").write_text("2")
    assert selftest().package_sha256 not in (first, record.package_sha256)


def test_files_are_compared_with_the_record_of_the_wheel(monkeypatch, tmp_path):
    """The record has the digest of `abc` by FIPS 180-4, in the form of PEP 376."""

    class Listed:
        hash = type("Hash", (), {"value": "ungWv48Bz-pBQUDeXa4iI7ADYaOWF3qctBD_YfIAFa0"})

        def locate(self):
            return tmp_path / "a.py"

    monkeypatch.setattr(room, "PACKAGE", tmp_path)
    monkeypatch.setattr(room.metadata, "files", lambda name: [Listed()])
    case = next(case for case in EACH if "wheel" in case.name)
    for content, outcome in (("abc", "PASS"), ("abd", "FAIL")):
        (tmp_path / "a.py").write_text(content)
        assert case.run().outcome == outcome


def test_the_command_writes_records(tmp_path):
    pytest.importorskip("matplotlib")
    done = ran("--record", tmp_path / "r.json", "--record", tmp_path / "r.html")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("PASS")
    document = json.loads((tmp_path / "r.json").read_text("utf-8"))
    assert msgspec.convert(document, SelftestRecord).passed
    page = (tmp_path / "r.html").read_text("utf-8")
    for words in (
        "Software validation",
        document["package_sha256"][:8],
        "NIST SP 1065",
        "7.11.2",
        "Released by",
    ):
        assert words in page


def test_the_record_as_pdf(tmp_path):
    pytest.importorskip("typst", reason="typst is not installed")
    pypdf = pytest.importorskip("pypdf", reason="pypdf is not installed")
    assert ran("--record", tmp_path / "r.pdf").returncode == 0
    text = "".join(page.extract_text() for page in pypdf.PdfReader(tmp_path / "r.pdf").pages)
    assert "Software validation" in text
    assert "PASS" in text


def test_another_form_is_refused(tmp_path):
    done = ran("--record", tmp_path / "r.txt")
    assert done.returncode == 2
    assert "--record" in done.stderr
    assert "Traceback" not in done.stderr
