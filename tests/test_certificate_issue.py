"""`mwdcal certificate`: files in and out, refusals, and the laboratory file."""

import hashlib
import json
import re
import shlex
import sys
from datetime import UTC, datetime

import msgspec
import pytest

from cli_support import EXAMPLE, ROOT, mwdcal, refused
from mwdcal.certificate.document import Certificate, load_laboratory
from mwdcal.errors import InputError
from mwdcal.library.papers import Paper
from test_schemas import checked

pytest.importorskip("jsonschema")
DATES = ("--date", "2026-04-01")


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """A calibration, the one before, a roll test with each, and a failed one."""
    folder = tmp_path_factory.mktemp("certificates")
    run = "# date = 2026-03-15\n" + (EXAMPLE / "run.csv").read_text("utf-8")
    (folder / "run.csv").write_text(run, "utf-8")
    tight = 'name = "tight"\n[error]\ninclination_deg = 0.001\nazimuth_deg = 2\n'
    (folder / "tight.toml").write_text(tight, "utf-8")
    for name, options in {"new": (), "old": ("--exclude", "3")}.items():
        line = ("calibrate", folder / "run.csv", "--tool", EXAMPLE / "tool.toml", *options)
        assert mwdcal(*line, "-o", folder / f"{name}.json").code == 0
    for name, cal, *limits in (
        ("left", "new"),
        ("found", "old"),
        ("failed", "new", "--limits", folder / "tight.toml"),
    ):
        line = ("verify", folder / f"{cal}.json", EXAMPLE / "rolltest.csv", "--json", *limits)
        (folder / f"{name}.json").write_text(mwdcal(*line).out, "utf-8")
    return folder


@pytest.fixture
def here(work, monkeypatch):
    monkeypatch.chdir(work)
    return work


def sha256(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def edited(source, target, change):
    document = json.loads(source.read_text("utf-8"))
    change(document)
    target.write_text(json.dumps(document), "utf-8")
    return target


def test_the_json_is_valid_the_same_in_file_and_on_screen_and_names_its_files(here, tmp_path):
    line = ("certificate", "new.json", "--verification", "left.json", "--as-found", "found.json")
    line += ("--laboratory", EXAMPLE / "laboratory.toml", *DATES, "-o", tmp_path / "C.json")
    ran = mwdcal(*line, "--json")
    assert ran.code == 0, ran
    document = checked("certificate", ran.json)
    assert json.loads((tmp_path / "C.json").read_text("utf-8")) == document
    assert document["serial"] == "SIM-0001"
    assert document["simulated"] is True
    assert (document["as_left"]["passed"], document["as_found"]["passed"]) == (True, True)
    by_id = {each["id"]: each for each in document["files"]}
    sources = {"calibration": "new.json", "verification": "left.json", "as-found": "found.json"}
    assert {*by_id} == {*sources, "laboratory"}
    for name, file in sources.items():
        assert (tmp_path / by_id[name]["name"]).resolve() == (here / file).resolve()
        assert by_id[name]["sha256"] == sha256(here / file)
    first = (tmp_path / "C.json").read_bytes()
    assert mwdcal(*line).code == 0
    assert (tmp_path / "C.json").read_bytes() == first
    assert msgspec.json.decode(first, type=Certificate).number == document["number"]


def test_a_failed_test_is_shown_and_no_reason_to_refuse(here, tmp_path):
    ran = mwdcal("certificate", "new.json", "--verification", "failed.json", "-o", tmp_path / "C.json")  # fmt: skip
    assert ran.code == 0
    assert "FAIL   as left" in ran.out
    assert "SIMULATED DATA" in ran.out
    document = json.loads((tmp_path / "C.json").read_text("utf-8"))
    assert document["as_left"]["passed"] is False


def test_without_a_test_it_says_that_conformity_was_not_tested(here):
    ran = mwdcal("certificate", "new.json", *DATES)
    assert ran.code == 0
    assert "conformity was not tested" in ran.out
    assert "not stated: laboratory" in ran.err
    document = mwdcal("certificate", "new.json", *DATES, "--json").json
    assert any("not tested" in statement for statement in document["statements"])


def test_numbers_on_the_screen_have_two_digits_of_their_uncertainty(here):
    lines = mwdcal("certificate", "new.json", "--verification", "left.json", *DATES).out.splitlines()  # fmt: skip
    (line,) = (line for line in lines if line.startswith("spread of inclination"))
    assert line.split()[4:7] == ["0.021°", "0.025°", "0.1°"]
    (line,) = (line for line in lines if line.startswith("expanded uncertainty"))
    assert line.split()[2:] == ["0.0046°", "0.0091°", "0.030°"]


# ------------------------------------------------------------------ refusals


def test_tests_of_the_wrong_calibration_or_tool_are_refused(here, tmp_path):
    message = refused(mwdcal("certificate", "new.json", "--verification", "found.json"), 2)
    assert "--verification is a test of another calibration" in message
    assert sha256(here / "new.json")[:16] in message
    message = refused(mwdcal("certificate", "new.json", "--as-found", "left.json"), 2)
    assert "--as-found is a test of this very calibration" in message
    other = edited(here / "left.json", tmp_path / "other.json", lambda d: d.update(serial="X"))
    message = refused(mwdcal("certificate", "new.json", "--verification", other), 2)
    assert "is of tool X, the calibration of tool SIM-0001" in message


def first_row(document):
    return document["rows"][0]


DAMAGED = {
    "another command": lambda d: d.update(command="apply"),
    "another version": lambda d: d.update(schema_version=2),
    "an unknown key": lambda d: d.update(more=1),
    "a missing key": lambda d: d.pop("calibration_sha256"),
    "a text for a number": lambda d: first_row(d).update(value="0.1"),
    "a decision": lambda d: first_row(d).update(passed=False),
    "a value": lambda d: first_row(d).update(value=7.0),
    "a limit below zero": lambda d: first_row(d).update(limit=-1.0),
    "an uncertainty below zero": lambda d: first_row(d).update(uncertainty=-1.0),
    "the verdict": lambda d: d.update(passed=False),
    "no decisions": lambda d: d.update(rows=[]),
    "an unknown rule": lambda d: d.update(rule="as we like it"),
    "a long number": lambda d: d.update(stations=10**40),
}


@pytest.mark.parametrize("change", DAMAGED.values(), ids=DAMAGED)
def test_a_changed_verification_is_refused(here, tmp_path, change):
    path = edited(here / "left.json", tmp_path / "v.json", change)
    line = ("certificate", "new.json", "--verification", path, "-o", tmp_path / "C.json")
    message = refused(mwdcal(*line), 2)
    assert "v.json" in message
    assert not (tmp_path / "C.json").exists()


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace('"limit": 0.1', '"limit": NaN', 1),
        lambda text: text.replace('"passed"', '"passed": true, "passed"', 1),
        lambda text: text[: len(text) // 2],
        lambda text: "",
        lambda text: "[" * 100_000,
        lambda text: text.replace("{", "\xff", 1),
    ],
    ids=["NaN", "twice", "half", "empty", "deep", "bytes"],
)
def test_a_damaged_verification_is_refused(here, tmp_path, change):
    text = (here / "left.json").read_text("utf-8")
    (tmp_path / "v.json").write_text(change(text), "latin-1", "replace")
    refused(mwdcal("certificate", "new.json", "--verification", tmp_path / "v.json"), 2)


def test_what_is_no_verification_or_not_there_is_refused(here):
    assert "new.json is not a verification" in refused(
        mwdcal("certificate", "new.json", "--verification", "new.json"), 2
    )
    assert "cannot be read" in refused(
        mwdcal("certificate", "new.json", "--verification", "none.json"), 2
    )


@pytest.mark.parametrize("name", ["C.txt", "C", "C.docx"])
def test_an_unknown_suffix_is_refused_before_any_work(here, tmp_path, name):
    message = refused(mwdcal("certificate", "none.json", "-o", tmp_path / name), 2)
    assert "the suffix must be one of .json, .html, .pdf, .xml" in message


def test_a_day_of_issue_that_is_refused_is_named_as_it_was_typed(here, tmp_path):
    day = json.loads((here / "new.json").read_bytes())["tool"].get("date")
    assert day, "the run states its day"
    line = ("certificate", "new.json", "-o", tmp_path / "C.json", "--date", "1999-01-01")
    assert "--date must not be before the day of the calibration" in refused(mwdcal(*line), 2)


@pytest.mark.parametrize("name", ["c.pdf", "c.html"])
def test_without_matplotlib_one_sentence_says_what_to_install(here, tmp_path, monkeypatch, name):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    ran = mwdcal("certificate", "new.json", "-o", tmp_path / name)
    assert "needs matplotlib, which is not installed" in refused(ran, 2)
    assert not (tmp_path / name).exists()


def test_all_files_are_written_or_none(here, tmp_path, monkeypatch):
    def fails(*_):
        raise InputError("`output` cannot be made. Try another form.")

    whole = Paper.form
    monkeypatch.setattr(
        Paper, "form", lambda paper, p: fails() if p.name == "D.json" else whole(paper, p)
    )
    line = ("certificate", "new.json", "-o", tmp_path / "C.json", "-o", tmp_path / "D.json")
    refused(mwdcal(*line), 2)
    assert not [*tmp_path.iterdir()]
    refused(mwdcal(*line[:4], "-o", tmp_path / "no" / "E.json"), 2)
    assert not [*tmp_path.iterdir()]


def test_an_input_is_not_replaced_and_an_output_not_named_twice(here, tmp_path):
    before = (here / "left.json").read_bytes()
    line = ("certificate", "new.json", "--verification", "left.json", "-o", "left.json")
    assert "it is an input" in refused(mwdcal(*line), 2)
    assert (here / "left.json").read_bytes() == before
    both = ("-o", tmp_path / "C.json", "-o", tmp_path / "C.json")
    assert "named twice" in refused(mwdcal("certificate", "new.json", *both), 2)


# ------------------------------------------------------------------ the laboratory file

LABORATORY = (EXAMPLE / "laboratory.toml").read_text("utf-8")
WRONG = {
    "unknown key": ("place =", "plaice ="),
    "blank name": ('"Plumbline Example Laboratory"', '" "'),
    "unknown rule": ('rule = "guarded"', 'rule = "lenient"'),
    "guard factor": ("guard_factor = 1.0", "guard_factor = 0.0"),
    "endless guard": ("guard_factor = 1.0", "guard_factor = nan"),
    "no month": ("months = 12", "months = 0"),
    "half a month": ("months = 12", "months = 1.5"),
    "no such day": ("2026-01-15", "2026-02-30"),
    "due before issued": ("due = 2036-01-15", "due = 2020-01-15"),
    "quantity": ('quantity = "dip"', 'quantity = "length"'),
    "endless value": ("value = 45.0", "value = inf"),
    "negative uncertainty": ("uncertainty = 2.0", "uncertainty = -2.0"),
    "number without digest": ("place =", 'number = "LAB-{year}"\nplace ='),
    "number with other fields": ("place =", 'number = "{digest}{serial.__class__}"\nplace ='),
    "number with width": ("place =", 'number = "{digest:>999999999}"\nplace ='),
    "twice": ("place =", 'place = "here"\nplace ='),
}


@pytest.mark.parametrize(("old", "new"), WRONG.values(), ids=WRONG)
def test_what_a_laboratory_cannot_state_is_refused(here, tmp_path, old, new):
    assert old in LABORATORY
    (tmp_path / "lab.toml").write_text(LABORATORY.replace(old, new, 1), "utf-8")
    refused(mwdcal("certificate", "new.json", "--laboratory", tmp_path / "lab.toml"), 2)


def test_nothing_in_a_laboratory_file_is_mandatory(here, tmp_path):
    (tmp_path / "lab.toml").write_text("", "utf-8")
    assert mwdcal("certificate", "new.json", "--laboratory", tmp_path / "lab.toml").code == 0
    assert "path of a TOML file" in refused(
        mwdcal("certificate", "new.json", "--laboratory", "x"), 2
    )


def test_a_pattern_makes_the_number(here, tmp_path):
    text = 'number = "EX/{year}/{serial}/{digest}"\n' + LABORATORY
    (tmp_path / "lab.toml").write_text(text, "utf-8")
    line = ("certificate", "new.json", "--laboratory", tmp_path / "lab.toml", *DATES, "--json")
    assert mwdcal(*line).json["number"].startswith("EX/2026/SIM-0001/")
    assert mwdcal(*line, "--number", "7").json["number"] == "7"


def test_the_digest_is_that_of_the_file():
    assert load_laboratory(EXAMPLE / "laboratory.toml")[1] == sha256(EXAMPLE / "laboratory.toml")


@pytest.mark.usefixtures("without_pictures")
def test_every_line_of_the_page_runs(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    text = (ROOT / "docs" / "howto" / "certificate.md").read_text("utf-8")
    lines = re.findall(r"^mwdcal (.*)", re.search(r"^```\n(.*?)^```", text, re.S | re.M)[1], re.M)
    monkeypatch.chdir(tmp_path)
    for line in lines:
        typed, _, target = line.partition(" > ")
        ran = mwdcal(*shlex.split(typed))
        assert ran.code == 0, (line, ran)
        if target:
            (tmp_path / target).write_text(ran.out, "utf-8")
    assert {"C.json", "C.html", "short.json"} <= {path.name for path in tmp_path.iterdir()}
    document = json.loads((tmp_path / "short.json").read_text("utf-8"))
    assert (document["number"], document["issued"]) == ("EX-1", f"{datetime.now(UTC).date()}")


def test_a_calibration_that_is_not_signed_by_a_trusted_key_is_a_finding(here, tmp_path):
    pytest.importorskip("cryptography")
    made = mwdcal("certificate", "key", "create", "-o", tmp_path / "lab.key")
    assert made.code == 0, made
    (public,) = tmp_path.glob("*.pub")
    line = ("certificate", "new.json", *DATES, "--json")

    def findings(*keys):
        return " ".join(finding["text"] for finding in mwdcal(*line, *keys).json["findings"])

    assert "unsigned" not in findings()
    assert "unsigned" in findings("--key", public)
