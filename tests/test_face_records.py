"""Records from Python against the command line: the same text, JSON and table, and errors with a remedy."""

import hashlib
import importlib
import json
import subprocess
import sys
from types import ModuleType

import msgspec
import pytest

import mwdcal
from cli_support import EXAMPLE, servo_run, write_csv
from cli_support import mwdcal as command
from mwdcal.errors import FitError, InputError
from mwdcal.files import documents
from mwdcal.library.results import LONGEST_LINE, Result

pytest.importorskip("sqlalchemy")
DAY = "2026-04-01"


def plain(document):
    """A document as JSON has it."""
    return json.loads(msgspec.json.encode(document))


def agrees(result, ran, *, without=()):
    """Whether a result says what a command printed: as text, or as JSON but for some keys."""
    assert isinstance(result, Result)
    assert len(repr(result)) <= LONGEST_LINE
    assert result._repr_html_().startswith("<pre>")
    if not ran.out.startswith("{"):
        assert result.summary() + "\n" == ran.out
        return
    stated, printed = plain(result.to_dict()), ran.json
    for name in without:
        stated.pop(name), printed.pop(name)
    assert stated == printed


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """Two calibrations of the example tool, and a roll test with each as JSON."""
    folder = tmp_path_factory.mktemp("records")
    run = "# date = 2026-03-15\n" + (EXAMPLE / "run.csv").read_text("utf-8")
    (folder / "run.csv").write_text(run, "utf-8")
    (folder / "roll.csv").write_bytes((EXAMPLE / "rolltest.csv").read_bytes())
    (folder / "lab.toml").write_bytes((EXAMPLE / "laboratory.toml").read_bytes())
    for name, options in {"new": (), "old": ("--exclude", "3")}.items():
        line = ("calibrate", folder / "run.csv", "--tool", EXAMPLE / "tool.toml", *options)
        assert command(*line, "-o", folder / f"{name}.json").code == 0
        test = command("verify", folder / f"{name}.json", folder / "roll.csv", "--json")
        (folder / f"{name}-test.json").write_text(test.out, "utf-8")
    return folder


@pytest.fixture
def here(work, monkeypatch):
    monkeypatch.chdir(work)
    return work


# ------------------------------------------------------------------------------ the registry


@pytest.fixture(scope="module")
def filled(work):
    """A registry with both calibrations and their tests, for questions."""
    with mwdcal.registry(work / "tools.sqlite", create=True, actor="A. Borg") as tools:
        files = [work / name for name in ("old.json", "new.json", "run.csv", "new-test.json")]
        assert tools.add(*files).new == {"calibration": 2, "run": 1, "verification": 1}
    return work / "tools.sqlite"


def test_adding_says_what_the_command_says(here, tmp_path):
    ours, theirs = tmp_path / "ours.sqlite", tmp_path / "theirs.sqlite"
    files = ("old.json", "new.json", "run.csv")
    command("registry", "init", "--registry", theirs, "--as", "A. Borg")
    with mwdcal.registry(ours, create=True, actor="A. Borg") as tools:
        for words in (["--json"], []):  # the second time everything is there already
            result = tools.add(*files)
            ran = command(
                "registry", "add", *files, "--registry", theirs, *words, "--as", "A. Borg"
            )
            if words:
                agrees(result, ran, without=("registry", "head"))
                assert result.findings == [
                    msgspec.convert(each, mwdcal.library.results.Finding)
                    for each in ran.json["findings"]
                ]
            else:
                said = [t.summary().splitlines()[0].partition("   ")[2] for t in (result,)]
                assert said == [ran.out.splitlines()[0].partition("   ")[2]]


def test_what_is_in_memory_is_added_as_save_writes_it(here, tmp_path):
    cal = mwdcal.load("new.json")
    run = mwdcal.read_run("run.csv", EXAMPLE / "tool.toml")
    with mwdcal.registry(tmp_path / "tools.sqlite", create=True) as tools:
        result = tools.add(cal, run)
        assert result.new == {"calibration": 1, "run": 1}
        assert [each.file for each in result.files] == ["SIM-0001.json", "SIM-0001.csv"]
        assert tools.get("SIM-0001").data == (here / "new.json").read_bytes()
        assert tools.latest("SIM-0001") == cal
        assert tools.add("new.json").known == 1
        assert (tools.list().rows[0].serial, len(tools.history("SIM-0001"))) == ("SIM-0001", 2)


def test_questions_to_a_registry_have_the_answers_of_the_commands(here, filled, tmp_path):
    where = ("--registry", filled)
    with mwdcal.registry(filled) as tools:
        for words in ((), ("--json",)):
            for result, line in (
                (tools.list(), ["list"]),
                (
                    tools.list("calibration", limit=1),
                    ["list", "--kind", "calibration", "--limit", 1],
                ),
                (tools.list(due="2999-01-01"), ["list", "--due", "2999-01-01"]),
                (tools.history("SIM-0001", offset=1), ["history", "SIM-0001", "--offset", 1]),
                (tools.check(), ["check"]),
                (tools.check(tools.head), ["check", "--head", tools.head]),
                (tools.get("SIM-0001", tmp_path / "a"), ["get", "SIM-0001", "-o", tmp_path / "a"]),
                (tools.backup(tmp_path / "b"), ["backup", tmp_path / "b"]),
            ):
                agrees(result, command("registry", *line, *where, *words))
        assert tools.check().sound
        assert (tmp_path / "a").read_bytes() == tools.get("SIM-0001").data
        listing = tools.history("SIM-0001")
        assert listing.columns["kind"].tolist() == [row.kind for row in listing.rows]
        assert listing.columns["number"].dtype.kind == "i"
        assert listing.columns["label"].tolist().count(None) == 0


def test_drift_is_that_of_the_command(here, filled, tmp_path):
    where = ("--registry", filled, "--date", "2027-01-01")
    limits = {"inclination_deg": 0.2}
    with mwdcal.registry(filled) as tools:
        one = tools.drift("SIM-0001", today="2027-01-01", limits=limits)
        every = tools.drift(today="2027-01-01")
        for words in ((), ("--json",)):
            line = ("SIM-0001", "--limit", "inclination_deg=0.2")
            agrees(one, command("registry", "drift", *line, *where, *words))
            agrees(every, command("registry", "drift", *where, *words))
    assert one.next_due == one.tool.next_due == plain(one.to_dict())["tool"]["next_due"]
    assert every.next_due == every.fleet.due[0].next_due if every.fleet.due else True


@pytest.mark.usefixtures("without_pictures")
def test_the_page_of_a_drift_is_that_of_the_command(here, filled, tmp_path):
    pytest.importorskip("matplotlib")
    with mwdcal.registry(filled) as tools:
        tools.drift("SIM-0001", today="2027-01-01").report(tmp_path / "ours.html")
        with pytest.raises(InputError, match="no page"):
            tools.list().report(tmp_path / "no.html")
    line = ("--date", "2027-01-01", "--report", tmp_path / "theirs.html", "--registry", filled)
    assert command("registry", "drift", "SIM-0001", *line).code == 0
    assert (tmp_path / "ours.html").read_bytes() == (tmp_path / "theirs.html").read_bytes()


def test_a_registry_is_withdrawn_from_exported_and_restored(here, filled, tmp_path):
    with mwdcal.registry(filled) as tools:
        noted = tools.backup(tmp_path / "backup.sqlite").head
    with mwdcal.registry(tmp_path / "new.sqlite", restore=tmp_path / "backup.sqlite") as tools:
        assert tools.check(noted).sound
        number = tools.history("SIM-0001").rows[0].number
        assert tools.withdraw(number, "wrong stand").reason == "wrong stand"
        with pytest.raises(InputError, match="withdrawn already"):
            tools.withdraw(number, "again")
        assert tools.export(tmp_path / "files").files == len(tools.history("SIM-0001"))
    with mwdcal.registry(tmp_path / "new.sqlite", create=True, upgrade=True) as tools:
        assert len(tools.history("SIM-0001")) == 4


def test_a_registry_refuses_with_a_remedy(here, filled, tmp_path):
    (tmp_path / "odd.json").write_text("{}", "utf-8")
    with pytest.raises(InputError, match="nothing|no such|not"):
        mwdcal.registry(tmp_path / "none.sqlite")
    with mwdcal.registry(filled) as tools:
        for wrong, words in (
            (lambda: tools.add(tmp_path / "odd.json"), r"not one of the files.*Leave it out\."),
            (lambda: tools.add(), "not one of the files"),
            (lambda: tools.add(tmp_path / "none.json"), "no such file"),
            (lambda: tools.latest("SIM-1000"), "Is it 'SIM-0001'"),
            (lambda: tools.get("SIM-1000"), "Correct the serial"),
            (lambda: tools.list("certificates"), "`kind` must be one of"),
            (lambda: tools.list(due="soon"), "`due` must be a day such as"),
            (lambda: tools.drift(level=1.0), "`level` must be"),
            (lambda: tools.drift(limits={"dip_deg": 1.0}), "`limit` must be one of"),
            (lambda: tools.backup(filled), "must not be the registry itself"),
        ):
            with pytest.raises(InputError, match=words):
                wrong()


# --------------------------------------------------------------- certificates and signatures


def test_a_certificate_of_files_is_that_of_the_command(here, tmp_path):
    line = [
        "certificate",
        "new.json",
        "--verification",
        "new-test.json",
        "--as-found",
        "old-test.json",
    ]
    line += ["--laboratory", "lab.toml", "--date", DAY, "--received", "2026-03-01"]
    line += ["--customer", "ACME", "--condition", "worn"]
    paper = mwdcal.certificate(
        "new.json", verification="new-test.json", as_found="old-test.json", laboratory="lab.toml",
        date=DAY, received="2026-03-01", customer="ACME", condition="worn",
    )  # fmt: skip
    agrees(paper, command(*line))
    agrees(paper, command(*line, "--json"))
    assert command(*line, "-o", "C.json", "-o", "C.xml").code == 0
    for name in ("C.json", "C.xml"):
        theirs = (here / name).read_bytes()
        (here / name).unlink()
        mwdcal.save(paper, name)
        assert (here / name).read_bytes() == theirs
        (here / name).unlink()
    agrees(paper, command(*line, "-o", "C.json", "-o", "C.xml"))
    assert [f.id for f in paper.findings] == [f["id"] for f in paper.to_dict()["findings"]]
    (here / "C.json").unlink()
    (here / "C.xml").unlink()


def test_a_certificate_names_files_from_its_folder(here, tmp_path):
    ran = command("certificate", "new.json", "--date", DAY, "-o", tmp_path / "C.json", "--json")
    agrees(mwdcal.certificate("new.json", date=DAY, folder=tmp_path), ran)


def test_a_certificate_of_results_in_memory_has_the_values_of_files(here):
    cal, old = mwdcal.load("new.json"), mwdcal.load("old.json")
    readings = mwdcal.read_run("roll.csv", cal.profile)
    paper = mwdcal.certificate(
        cal, verification=mwdcal.verify(cal, readings), as_found=mwdcal.verify(old, readings),
        laboratory="lab.toml", date=DAY,
    )  # fmt: skip
    files = mwdcal.certificate(
        "new.json",
        verification="new-test.json",
        as_found="old-test.json",
        laboratory="lab.toml",
        date=DAY,
    )
    ours, theirs = (plain(each.to_dict()) for each in (paper, files))
    assert (
        ours["files"][0]["sha256"] == hashlib.sha256((here / "new.json").read_bytes()).hexdigest()
    )
    for document in (ours, theirs):
        for name in ("files", "number"):
            document.pop(name)
        for test in ("as_found", "as_left"):
            document[test].pop("calibration_sha256")
    assert ours == theirs


@pytest.mark.usefixtures("without_layout")
@pytest.mark.parametrize("suffix", ["html", "pdf"])
def test_pages_and_pdf_are_those_of_the_command(here, tmp_path, suffix):
    pytest.importorskip("matplotlib")
    pytest.importorskip({"html": "jinja2", "pdf": "typst"}[suffix])
    ran = command("certificate", "new.json", "--date", DAY, "-o", tmp_path / f"theirs.{suffix}")
    assert ran.code == 0
    paper = mwdcal.certificate("new.json", date=DAY, folder=tmp_path)
    mwdcal.save(paper, tmp_path / f"ours.{suffix}")
    ours, theirs = (tmp_path / f"{name}.{suffix}" for name in ("ours", "theirs"))
    assert ours.read_bytes() == theirs.read_bytes()
    if suffix == "html":
        paper.report(tmp_path / "report.html")
        assert (tmp_path / "report.html").read_bytes() == theirs.read_bytes()


def test_a_certificate_shows_the_drift_of_a_registry(here, filled):
    ran = command("certificate", "new.json", "--date", DAY, "--registry", filled, "--json")
    agrees(mwdcal.certificate("new.json", date=DAY, registry=filled), ran)
    with mwdcal.registry(filled) as tools:
        agrees(mwdcal.certificate("new.json", date=DAY, registry=tools), ran)


def test_a_certificate_refuses_with_a_remedy(here, tmp_path):
    paper = mwdcal.certificate("new.json", date=DAY)
    for wrong, words in (
        (lambda: mwdcal.certificate("none.json"), "Check the path"),
        (lambda: mwdcal.certificate("new.json", date="soon"), "`date` must be a day such as"),
        (
            lambda: mwdcal.certificate("new.json", verification="old-test.json"),
            "another calibration",
        ),
        (lambda: mwdcal.certificate("new.json", date="2026-01-01"), "Correct one of them"),
        (lambda: mwdcal.save(paper, tmp_path / "C.docx"), "the suffix must be one of .json"),
        (lambda: mwdcal.sign(paper, "lab.key"), "`output` is missing"),
        (lambda: mwdcal.check_signature("new.json", []), "`keys` must name a public key"),
    ):
        with pytest.raises(InputError, match=words):
            wrong()


@pytest.fixture(scope="module")
def key(tmp_path_factory):
    pytest.importorskip("cryptography")
    from mwdcal.certificate import signature

    path = tmp_path_factory.mktemp("keys") / "lab.key"
    signature.create(path, "LAB", "")
    return path


def test_a_paper_is_signed_beside_its_form_and_checked(here, key, tmp_path):
    paper = mwdcal.certificate("new.json", date=DAY, folder=tmp_path)
    mwdcal.save(paper, tmp_path / "C.xml")
    signed = mwdcal.sign(paper, key)
    assert signed.file == str(tmp_path / "C.json")
    public = key.with_name("lab.key.pub")
    for keys in ([public], public):
        assert mwdcal.check_signature(tmp_path / "C.json", keys).state == "intact"
    with pytest.raises(InputError, match="signed already"):
        mwdcal.sign(paper, key)
    mwdcal.sign(paper, key, replace=True)
    checked = mwdcal.check_signature(tmp_path / "C.json", [public])
    for words in ((), ("--json",)):
        agrees(
            checked, command("certificate", "verify", tmp_path / "C.json", "--key", public, *words)
        )
    assert checked.passed
    assert checked.findings == []


def test_signing_a_file_says_what_the_command_says(here, key, tmp_path):
    public = key.with_name("lab.key.pub")
    file = tmp_path / "a.json"
    for words in ((), ("--json",)):
        ours = mwdcal.sign("new.json", key, output=file)
        file.unlink()
        line = ("certificate", "sign", "new.json", "--private-key", key, "-o", file)
        agrees(ours, command(*line, *words), without=("time",))
        if not words:
            file.unlink()
    assert ours.key == ours.to_dict()["key"]
    cal = (tmp_path / "a.json").read_text("utf-8")
    for name, text in {
        "b": cal.replace("SIM-0001", "SIM-0002"),
        "c": (here / "new.json").read_text("utf-8"),
    }.items():
        (tmp_path / f"{name}.json").write_text(text, "utf-8")
    states = [mwdcal.check_signature(tmp_path / f"{n}.json", [public]).state for n in "abc"]
    assert states == ["intact", "altered", "unsigned"]
    for name in "bc":
        result = mwdcal.check_signature(tmp_path / f"{name}.json", [public])
        assert not result.passed
        agrees(result, command("certificate", "verify", tmp_path / f"{name}.json", "--key", public))
        ran = command("certificate", "verify", tmp_path / f"{name}.json", "--key", public, "--json")
        agrees(result, ran)
    with pytest.raises(FitError, match="altered after it was made"):
        mwdcal.sign(tmp_path / "b.json", key, replace=True)


def test_an_encrypted_key_needs_its_passphrase(here, tmp_path, monkeypatch):
    pytest.importorskip("cryptography")
    from mwdcal.certificate import signature

    monkeypatch.delenv(signature.PASSPHRASE, raising=False)
    signature.create(tmp_path / "lab.key", "LAB", "word")
    with pytest.raises(
        InputError, match=f"Give its `passphrase`, or set the variable {signature.PASSPHRASE}"
    ):
        mwdcal.sign("new.json", tmp_path / "lab.key", output=tmp_path / "a.json")
    mwdcal.sign("new.json", tmp_path / "lab.key", output=tmp_path / "a.json", passphrase="word")
    monkeypatch.setenv(signature.PASSPHRASE, "word")
    mwdcal.sign("new.json", tmp_path / "lab.key", output=tmp_path / "b.json")
    assert documents.read(tmp_path / "b.json").serial == "SIM-0001"


# ------------------------------------------------------------------------------- many tools

UNEQUAL = ("seconds", "tools_per_second", "parts_done_before")
"""Facts of a fleet that no two calls have in common."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A folder of runs of three tools, one of which cannot be calibrated."""
    pytest.importorskip("pyarrow")
    folder = tmp_path_factory.mktemp("fleet") / "runs"
    folder.mkdir()
    for seed in (1, 2):
        write_csv(folder / f"T-{seed}.csv", servo_run(seed, (10, 60, 90, 130), 7))
    few = {name: column[:3] for name, column in servo_run(3).items()}
    write_csv(folder / "T-3.csv", few)
    return folder


def timeless(text):
    """The text of a fleet without its rate."""
    return text.rstrip("\n").rpartition("   ")[0]


@pytest.mark.parametrize(
    ("choices", "typed"),
    [
        ({}, ()),
        ({"robust": "huber", "prior": "datasheet"}, ("--robust", "huber", "--prior", "datasheet")),
        (
            {"nonlinearity": ("magnetometer",), "order": "auto"},
            ("--nonlinearity", "magnetometer", "--order", "auto"),
        ),
        (
            {"estimate": ("azimuth-zero",), "ignore": ("dip",)},
            ("--estimate", "azimuth-zero", "--ignore", "dip"),
        ),
    ],
    ids=lambda value: "" if isinstance(value, dict) else "-".join(value) or "defaults",
)
def test_a_fleet_is_that_of_the_command(runs, tmp_path, choices, typed):
    import pyarrow.parquet as pq

    output = tmp_path / "cals.parquet"
    line = ("fleet", runs, "-o", output, "--tool", "servo", "--workers", 1, *typed)
    ran, said = command(*line, "--json"), command(*line)
    theirs = pq.read_table(output)
    fleet = mwdcal.fleet(runs, "servo", output=output, workers=1, **choices)
    agrees(fleet, ran, without=UNEQUAL)
    assert timeless(fleet.summary()) == timeless(said.out)
    assert len(repr(fleet)) <= LONGEST_LINE
    assert [f"! {each.text}" for each in fleet.findings] == [
        line for line in said.err.splitlines() if line.startswith("! ")
    ]
    ours = pq.read_table(output)
    assert ours.drop_columns(["calibration"]) == theirs.drop_columns(["calibration"])
    assert (len(fleet), fleet.calibrated, [*fleet]) == (3, 2, ["T-1", "T-2", "T-3"])
    for name in set(theirs.column_names) - {"calibration"}:
        cells = [None if c != c else c for c in fleet.columns[name].tolist()]
        assert cells == theirs.column(name).to_pylist(), name


def test_a_fleet_in_memory_has_calibrations_and_goes_where_it_is_saved(runs, tmp_path):
    profile = mwdcal.load_profile("servo")
    heard = []
    fleet = mwdcal.fleet(runs, profile, workers=1, progress=heard.append)
    assert any("3 tools" in text for text in heard)
    assert "in memory" in fleet.summary()
    assert fleet.to_dict()["output"] == ""
    assert "T-2" in fleet
    cal = fleet["T-2"]
    readings = mwdcal.read_run(runs / "T-2.csv", profile)
    single = mwdcal.calibrate(readings, order=0, nonlinearity=())
    assert cal.serial == "T-2"
    assert cal.fields(readings)[0] == pytest.approx(single.fields(readings)[0], abs=1e-9)
    fleet.save(tmp_path / "cals.parquet")
    assert mwdcal.load(f"{tmp_path / 'cals.parquet'}#T-2") == cal
    mwdcal.save(fleet, tmp_path / "again.parquet")
    assert fleet.save_calibrations(tmp_path / "each") == 2
    assert mwdcal.load(tmp_path / "each" / "T-1.json") == fleet["T-1"]
    folder = fleet.path.parent
    assert folder.exists()
    del fleet
    assert not folder.exists()


def test_the_page_of_a_fleet_is_that_of_the_command(runs, tmp_path):
    pytest.importorskip("matplotlib")
    output, page = tmp_path / "cals.parquet", tmp_path / "page.html"
    fleet = mwdcal.fleet(runs, "servo", output=output, workers=1)
    fleet.report(page)
    assert "<html" in page.read_text("utf-8")
    assert f"{page} (report)" in fleet.summary()
    assert fleet.to_dict()["report"] == str(page)


def test_a_fleet_refuses_with_a_remedy(runs, tmp_path):
    for wrong, words in (
        ({"runs": tmp_path / "none"}, "no such|cannot be read"),
        ({"tool": "none"}, "none"),
        ({"workers": 0}, "`workers` must be 1 or more"),
        ({"output": tmp_path / "cals.csv"}, r"ends in \.parquet"),
        ({"output": runs / "cals.parquet"}, "part of the input folder"),
        ({"robst": "huber"}, "unknown option 'robst'.*Did you mean 'robust'"),
        ({"order": (0, 1)}, "`order` of a fleet must be"),
        ({"prior": "cal.json"}, "must be 'datasheet'|prior of a fleet"),
    ):
        given = {"runs": runs, "tool": "servo", "workers": 1, **wrong}
        with pytest.raises(InputError, match=words):
            mwdcal.fleet(**given)
    fleet = mwdcal.fleet(runs, "servo", workers=1)
    for wrong, words in (
        (lambda: fleet["T-3"], "was not calibrated"),
        (lambda: fleet["T-9"], "has no tool"),
        (lambda: fleet.save(tmp_path / "cals.csv"), r"ends in \.parquet"),
        (
            lambda: mwdcal.fleet(tmp_path / "a.parquet", output=tmp_path / "a.parquet"),
            "no such|cannot",
        ),
    ):
        with pytest.raises(InputError, match=words):
            wrong()


@pytest.mark.slow
def test_workers_do_not_run_the_script_of_the_caller_again(runs, tmp_path):
    """A script without a guard: three parts, by two processes."""
    script = tmp_path / "script.py"
    script.write_text(
        "import mwdcal\nfrom mwdcal import pool\nprint('once')\n"
        "steps = pool.Steps(int, bytes)\n"
        "print(sorted(pool.results(steps, [1, 2, 3], 2, None)))\n",
        "utf-8",
    )
    ran = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    assert ran.stdout.splitlines() == ["once", str([(n - 1, bytes(n)) for n in (1, 2, 3)])], ran


def test_rooms_do_not_take_the_place_of_functions():
    names = ("certificate", "fleet", "registry", "survey")
    for name in names:
        importlib.import_module(
            f"mwdcal.{name}.document" if name == "certificate" else f"mwdcal.{name}"
        )
        assert not isinstance(getattr(mwdcal, name), ModuleType), name
