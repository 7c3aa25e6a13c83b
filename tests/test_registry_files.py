"""Files into a registry and out of it: what each is, what is refused, and tools named by their serial."""

import hashlib
import importlib.util
import json
import shutil

import pytest

from cli_support import EXAMPLE, ROOT, mwdcal, refused
from registry_support import empty_database

pq = pytest.importorskip("pyarrow.parquet")
pa = pytest.importorskip("pyarrow")
pytest.importorskip("sqlalchemy")

from mwdcal.registry.imports import Adding  # noqa: E402
from test_schemas import checked  # noqa: E402

LABORATORY = ROOT / "examples" / "registry" / "laboratory.py"
LAB = """place = "Hall 2"
[laboratory]
name = "Example laboratory"
[measured_by]
name = "B. Lind"
[authorised_by]
name = "C. Moe"
function = "head"
[[standards]]
quantity = "temperature"
name = "thermometer"
serial = "T-1"
due = 2027-01-31
"""


def laboratory():
    """The script of the example."""
    spec = importlib.util.spec_from_file_location("laboratory", LABORATORY)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run(*arguments, code=0):
    ran = mwdcal(*arguments)
    assert ran.code == code, ran
    return ran


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    """Three tools in two years: run files, tables of calibrations, the roll test, its verification."""
    folder = tmp_path_factory.mktemp("registry") / "lab"
    laboratory().laboratory(folder, 3, 2)
    tool = ("--tool", folder / "tool.toml", "--workers", 1)
    for year in (2022, 2023):
        run("fleet", folder / "runs" / str(year), *tool, "-o", folder / f"{year}.parquet")
    run("fleet", folder / "runs" / "2023", *tool, "-o", folder.parent / "x.parquet",
        "--calibrations", folder.parent / "tools")  # fmt: skip
    tool_1 = folder / "2023.parquet#SIM-0001"
    ran = run(
        "verify", folder.parent / "tools" / "SIM-0001.json", folder / "rolltest-2023.csv", "--json"
    )
    (folder / "verified.json").write_text(ran.out, "utf-8")
    (folder / "guest.toml").write_text(LAB, "utf-8")
    (folder / ".hidden.csv").write_text("x", "utf-8")
    assert run("verify", tool_1, folder / "rolltest-2023.csv").code == 0
    return folder


@pytest.fixture(scope="module")
def filled(example):
    """A registry of them, in a file."""
    path = example.parent / "tools.sqlite"
    run("registry", "--registry", path, "init", "--as", "A. Borg")
    run("registry", "--registry", path, "add", example, "--as", "A. Borg", "--workers", 1)
    return path


def registry(path, *arguments, code=0):
    """The document of a subcommand, valid by its published schema."""
    ran = run("registry", "--registry", path, *arguments, "--json", code=code)
    return checked(f"registry {arguments[0]}", ran.json)


def sha256(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_every_kind_of_file_is_what_it_is(example, tmp_path):
    path = tmp_path / "r.sqlite"
    registry(path, "init")
    result = registry(path, "add", example)
    assert result["new"] == {
        "calibration": 6, "laboratory": 2, "person": 4, "standard": 5, "profile": 1, "verification": 1,
        "run": 8,
    }  # fmt: skip
    assert (result["known"], result["refused"], result["simulated"]) == (0, 0, True)
    assert sum(result["new"].values()) + 1 == result["events"]
    again = registry(path, "add", example)
    assert (again["new"], again["known"], again["head"]) == ({}, 27, result["head"])
    assert registry(path, "check")["sound"]


def test_records_are_linked_by_the_sha256_of_files(example, filled):
    past = registry(filled, "history", "SIM-0001")["records"]
    assert [r["kind"] for r in past].count("calibration") == 2
    by_kind = {(r["kind"], r["time"]): r for r in past}
    assert by_kind["run", "2023-03-01"]["sha256"] in {
        sha256(example / "runs" / "2023" / "SIM-0001.csv"), sha256(example / "rolltest-2023.csv")
    }  # fmt: skip
    fitted = by_kind["calibration", "2023-03-01"]
    assert fitted["sha256"] == sha256(example.parent / "tools" / "SIM-0001.json")
    verified = by_kind["verification", "2023-03-01"]
    assert verified["status"] == "passed"
    assert (
        json.loads((example / "verified.json").read_text())["calibration_sha256"]
        == (fitted["sha256"])
    )
    assert {r["actor"] for r in past} == {"A. Borg"}


def test_a_row_of_a_fleet_is_the_calibration_file_that_the_fleet_writes_of_it(
    example, filled, tmp_path
):
    for serial in ("SIM-0001", "SIM-0002"):
        registry(filled, "get", serial, "-o", tmp_path / "got.json")
        expected = (example.parent / "tools" / f"{serial}.json").read_bytes()
        assert (tmp_path / "got.json").read_bytes() == expected


def test_list_shows_the_last_calibration_and_its_accuracy(example, filled):
    rows = registry(filled, "list")["tools"]
    assert [row["serial"] for row in rows] == ["SIM-0001", "SIM-0002", "SIM-0003"]
    assert [row["calibrated"] for row in rows] == ["2023-03-01", "2023-03-01", "2023-03-02"]
    table = pq.read_table(example / "2023.parquet")
    for angle in ("inclination", "toolface", "azimuth"):
        stated = table.column(f"{angle}_sd_deg").to_pylist()
        assert [row[f"{angle}_deg"] for row in rows] == pytest.approx(stated, rel=2e-2)
    found = registry(filled, "list", "--search", "0002")["tools"]
    assert [row["serial"] for row in found] == ["SIM-0002"]


def test_standards_are_listed_when_they_are_due(filled):
    due = registry(filled, "list", "--due", "2036-02-01")["records"]
    assert [(r["label"], r["next_due"]) for r in due] == [
        ("thermometer", "2027-01-31"),
        ("non-magnetic calibration stand", "2036-01-15"),
    ]
    assert registry(filled, "list", "--due", "2027-01-31")["records"] == []


COMMANDS = {
    "apply": lambda tool, roll, out: ("apply", tool, roll, "-o", out / "a.csv"),
    "verify": lambda tool, roll, out: ("verify", tool, roll),
    "convert": lambda tool, roll, out: ("convert", tool, "--notation", "forward"),
    "diagnose": lambda tool, roll, out: ("diagnose", tool, roll),
    "prior": lambda tool, roll, out: (
        "calibrate", roll, "--tool", "servo", "--prior", tool, "-o", out / "c.json"
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", COMMANDS)
def test_a_tool_of_a_registry_is_named_as_one_of_a_fleet(example, filled, tmp_path, name):
    roll = example / "rolltest-2023.csv"
    whole, alone = (
        mwdcal(*COMMANDS[name](tool, roll, tmp_path), "--json")
        for tool in (f"{filled}#SIM-0001", example.parent / "tools" / "SIM-0001.json")
    )
    assert whole.code == alone.code, whole
    results = [ran.json for ran in (whole, alone)]
    for result in results:
        result.pop("calibration", None)
    assert results[0] == results[1]


@pytest.mark.parametrize(
    ("serial", "words"),
    [("SIM-001", "Is it 'SIM-0001'"), ("", "has no tool ''"), (None, "has 3 tools. Name one")],
)
def test_a_tool_that_is_not_there_is_named_with_those_that_are(filled, serial, words):
    tool = filled if serial is None else f"{filled}#{serial}"
    assert words in refused(mwdcal("convert", tool, "--notation", "forward"), 2)


def test_the_registry_behind_a_tool_is_an_input_which_no_output_replaces(filled, example):
    ran = mwdcal("apply", f"{filled}#SIM-0001", example / "rolltest-2023.csv", "-o", filled)
    assert "would be lost" in refused(ran, 2)
    assert "would be lost" in refused(mwdcal("registry", "--registry", filled, "backup", filled), 2)


def test_an_export_makes_the_same_registry(filled, example, tmp_path):
    registry(filled, "export", tmp_path / "out")
    copy = tmp_path / "copy.sqlite"
    registry(copy, "init")
    added = registry(copy, "add", tmp_path / "out")
    assert (added["refused"], sum(added["new"].values())) == (0, 27)
    registry(copy, "export", tmp_path / "again")
    first, second = (
        json.loads((tmp_path / name / "manifest.json").read_bytes()) for name in ("out", "again")
    )
    keys = ("kind", "name", "sha256", "serial", "path")
    assert [{k: f[k] for k in keys} for f in first["files"]] == [
        {k: f[k] for k in keys} for f in second["files"]
    ]
    for file in first["files"]:
        assert sha256(tmp_path / "out" / file["path"]) == file["sha256"]
    history = (tmp_path / "out" / "history.jsonl").read_bytes()
    assert hashlib.sha256(history).hexdigest() == first["history_sha256"]
    assert len(history.splitlines()) == first["events"]
    assert json.loads(history.splitlines()[-1])["hash"] == first["head"]


def test_a_changed_file_of_an_export_is_refused_and_the_others_added(filled, tmp_path):
    registry(filled, "export", tmp_path / "out")
    file = next((tmp_path / "out" / "calibration").iterdir())
    file.write_bytes(file.read_bytes().replace(b"SIM", b"SIN", 1))
    copy = tmp_path / "copy.sqlite"
    registry(copy, "init")
    added = registry(copy, "add", tmp_path / "out")
    assert (added["refused"], sum(added["new"].values())) == (1, 26)
    assert "changed since it was exported" in added["findings"][0]["text"]


def test_a_withdrawn_calibration_counts_no_longer_also_in_an_export(filled, example, tmp_path):
    work = tmp_path / "work.sqlite"
    shutil.copy(filled, work)
    digest = sha256(example.parent / "tools" / "SIM-0001.json")
    registry(work, "withdraw", digest[:12], "--reason", "wrong stand angles")
    assert registry(work, "list", "--search", "SIM-0001")["tools"][0]["calibrated"] == "2022-03-01"
    registry(work, "export", tmp_path / "out")
    copy = tmp_path / "copy.sqlite"
    registry(copy, "init")
    registry(copy, "add", tmp_path / "out")
    for path in (work, copy):
        past = registry(path, "history", "SIM-0001")["records"]
        assert [r["sha256"] for r in past if r["reason"]] == [digest]
    assert registry(copy, "list", "--search", "SIM-0001")["tools"][0]["calibrated"] == "2022-03-01"
    assert registry(work, "check")["sound"]
    again = mwdcal("registry", "--registry", work, "withdraw", digest, "--reason", "x")
    assert "withdrawn already" in refused(again, 2)


def test_an_interrupted_import_leaves_no_withdrawn_calibration_that_counts(
    filled, example, tmp_path, monkeypatch
):
    work, copy = tmp_path / "work.sqlite", tmp_path / "copy.sqlite"
    shutil.copy(filled, work)
    digest = sha256(example.parent / "tools" / "SIM-0001.json")
    registry(work, "withdraw", digest[:12], "--reason", "wrong stand angles")
    registry(work, "export", tmp_path / "out")
    registry(copy, "init")

    def stopped(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:  # stopped as soon as the first transaction is on the disk
        patch.setattr(Adding, "_note", stopped)
        mwdcal("registry", "--registry", copy, "add", tmp_path / "out", "--workers", 1)
    registry(copy, "add", tmp_path / "out")
    past = registry(copy, "history", "SIM-0001")["records"]
    assert [r["sha256"] for r in past if r["reason"]] == [digest]


def test_a_reason_that_many_files_have_is_given_once(example, tmp_path):
    for number in range(30):
        (tmp_path / f"notes{number:02d}.txt").write_text(f"to do {number}", "utf-8")
    shutil.copy(example / "tool.toml", tmp_path)
    path = tmp_path / "r.sqlite"
    registry(path, "init")
    findings = registry(path, "add", *sorted(tmp_path.glob("[nt]*.t*")))["findings"]
    assert [f["id"] for f in findings] == ["refused-file"]
    assert "30 files, such as notes00.txt: a registry keeps" in findings[0]["text"]


def test_days_and_serials_that_people_write_otherwise_are_named(example, tmp_path):
    text = (example / "runs" / "2022" / "SIM-0001.csv").read_text("utf-8")
    runs = tmp_path / "runs"
    runs.mkdir()
    for number, serial in enumerate(("Ab-1", "AB -1", "ab\u20101", "AB-11", "AB-11b")):
        changed = text.replace("SIM-0001", serial)
        if number == 3:
            changed = changed.replace('date = "2022-03-01"', 'operator = "B"')
        (runs / f"{number}.csv").write_text(changed, "utf-8")
    tool = ("--tool", example / "tool.toml", "--workers", 1)
    run("fleet", runs, *tool, "-o", tmp_path / "all.parquet")
    path = tmp_path / "r.sqlite"
    registry(path, "init")
    findings = {
        f["id"]: f["text"] for f in registry(path, "add", tmp_path / "all.parquet")["findings"]
    }
    assert set(findings) == {"no-date", "similar-serials"}
    assert (
        "1 calibration without a day of the measurement, such as AB-11.json" in findings["no-date"]
    )
    assert "'AB -1' and 'Ab-1' and 'ab\u20101'" in findings["similar-serials"]
    assert "AB-11" not in findings["similar-serials"]
    assert registry(path, "add", tmp_path / "all.parquet")["findings"] == []  # nothing new


def test_a_calibration_that_was_changed_is_added_and_said_to_be(example, tmp_path):
    """A number of it, beside its hash; the file as it was written is not named."""
    sound = example.parent / "tools" / "SIM-0001.json"
    fields = json.loads(sound.read_bytes())
    fields["accelerometer"]["parameters"][0] += 1e-3
    altered = tmp_path / "altered.json"
    altered.write_text(json.dumps(fields))
    database = tmp_path / "r.sqlite"
    registry(database, "init")
    result = registry(database, "add", sound, altered)
    findings = {finding["id"]: finding["text"] for finding in result["findings"]}
    assert findings["changed"].startswith("1 calibration changed after mwdcal calibrate made it")
    assert "altered.json" in findings["changed"]


def test_a_page_behind_the_last_one_is_empty(filled):
    shown = run("registry", "--registry", filled, "list", "--offset", 99).out
    assert shown == "3 tools\n"


def test_nothing_replaces_a_registry_but_a_backup_another(filled, tmp_path):
    other = tmp_path / "other.sqlite"
    registry(other, "init")
    before = other.read_bytes()
    for words in (["backup", other], ["get", "SIM-0001", "-o", other]):
        ran = mwdcal("registry", "--registry", filled, *words)
        assert "it is a registry, which would be lost" in refused(ran, 2)
    assert other.read_bytes() == before
    for _ in range(2):
        registry(filled, "backup", tmp_path / "backup.sqlite")


def test_what_is_no_file_of_a_registry_is_named_and_stops_nothing(example, tmp_path):
    mixed = tmp_path / "mixed"
    mixed.mkdir()
    (mixed / "notes.txt").write_text("to do", "utf-8")
    (mixed / "other.json").write_text('{"command": "survey"}', "utf-8")
    (mixed / "key.pem").write_text("-----BEGIN PRIVATE KEY-----\nAAAA\n-----END PRIVATE KEY-----")
    (mixed / "table.csv").write_text("a,b\n1,2\n", "utf-8")
    sound = example.parent / "tools" / "SIM-0002.json"
    shutil.copy(sound, mixed / "sound.json")
    edited = json.loads(sound.read_bytes())
    edited["accelerometer"]["parameters"].pop()
    (mixed / "edited.json").write_text(json.dumps(edited), "utf-8")
    path = tmp_path / "r.sqlite"
    registry(path, "init")
    result = registry(path, "add", mixed)
    assert result["new"] == {"calibration": 1}
    words = {
        f["file"].rpartition("/")[2].rpartition("\\")[2]: f["message"] for f in result["files"]
    }
    assert words.pop("sound.json") == ""
    for name, word in {
        "notes.txt": "something else", "other.json": "something else", "key.pem": "private key",
        "table.csv": "columns of a run are missing (ax, ay, az)", "edited.json": "edited.json",
    }.items():  # fmt: skip
        assert word in words[name], name
    alone = mwdcal("registry", "--registry", path, "add", mixed / "notes.txt")
    assert alone.code == 2
    assert "not added" in alone.err


def test_a_table_of_a_fleet_without_records_is_not_taken_for_a_run(example, tmp_path):
    runs, table, path = (
        example / "runs" / "2022",
        tmp_path / "c.parquet",
        tmp_path / "r.sqlite",
    )
    run("fleet", runs, "--tool", example / "tool.toml", "--no-records", "-o", table)
    registry(path, "init")
    ran = mwdcal("registry", "--registry", path, "add", table)
    assert ran.code == 2
    assert "no column 'calibration'" in ran.err
    assert "--records" in ran.err


def test_a_laboratory_whose_people_have_no_name_is_not_added(tmp_path):
    lab = tmp_path / "lab.toml"
    lab.write_text(LAB.replace('name = "C. Moe"\n', ""))
    registry(tmp_path / "r.sqlite", "init")
    ran = mwdcal("registry", "--registry", tmp_path / "r.sqlite", "add", lab)
    assert ran.code == 2
    assert "`name`" in ran.err


def test_no_file_of_a_folder_is_left_out_but_those_that_systems_hide(example, tmp_path):
    folder = tmp_path / "mixed" / "_old"
    folder.mkdir(parents=True)
    for name in ("_SIM-0002.json", ".SIM-0002.json", "~$SIM-0002.json"):
        shutil.copy(example.parent / "tools" / "SIM-0002.json", folder / name)
    path = tmp_path / "r.sqlite"
    registry(path, "init")
    result = registry(path, "add", folder.parent)
    assert result["new"] == {"calibration": 1}
    assert [f["file"] for f in result["files"]] == [str(folder / "_SIM-0002.json")]


def test_a_table_of_other_columns_is_a_run_if_a_calibration_was_made_of_it(example, tmp_path):
    exported = EXAMPLE / "export.csv"
    run("profile", exported, "-o", tmp_path / "tool.toml")
    run("calibrate", exported, "--tool", tmp_path / "tool.toml", "-o", tmp_path / "cal.json")
    path = tmp_path / "r.sqlite"
    registry(path, "init")
    assert (
        "Add it together with a calibration"
        in run("registry", "--registry", path, "add", exported, code=2).err
    )
    result = registry(path, "add", exported, tmp_path / "cal.json", tmp_path / "tool.toml")
    assert result["new"] == {"calibration": 1, "profile": 1, "run": 1}


def test_workers_add_the_same_in_the_same_order(example, tmp_path):
    heads = []
    for workers in (1, 2):
        path = tmp_path / f"{workers}.sqlite"
        registry(path, "init")
        registry(path, "add", example, "--workers", workers)
        registry(path, "export", tmp_path / str(workers))
        manifest = json.loads((tmp_path / str(workers) / "manifest.json").read_bytes())
        heads.append([(f["number"], f["sha256"]) for f in manifest["files"]])
    assert heads[0] == heads[1]


def test_a_backup_is_a_registry_and_restores_one(filled, tmp_path):
    made = registry(filled, "backup", tmp_path / "b.sqlite")
    assert registry(tmp_path / "b.sqlite", "check", "--head", made["head"])["sound"]
    registry(tmp_path / "new.sqlite", "restore", tmp_path / "b.sqlite")
    assert registry(tmp_path / "new.sqlite", "check", "--head", made["head"])["sound"]
    assert registry(tmp_path / "new.sqlite", "list")["tools"] == registry(filled, "list")["tools"]


def test_the_registry_is_named_by_option_group_or_environment(filled, tmp_path, monkeypatch):
    lists = [run("registry", "--registry", filled, "list").out]
    lists.append(run("registry", "list", "--registry", filled).out)
    other = tmp_path / "other.sqlite"
    run("registry", "init", "--registry", other)
    monkeypatch.setenv("MWDCAL_REGISTRY", str(other))
    lists.append(run("registry", "--registry", filled, "list").out)
    assert len(set(lists)) == 1
    assert run("registry", "list").out != lists[0]
    monkeypatch.delenv("MWDCAL_REGISTRY")
    assert "--registry must name the registry" in refused(mwdcal("registry", "list"), 2)


def test_the_commands_work_on_postgresql_and_tell_no_password(
    example, filled, postgresql, tmp_path
):
    url = empty_database(postgresql)
    registry(url, "init")
    added = registry(url, "add", example, "--workers", 1)
    assert sum(added["new"].values()) + 1 == added["events"]
    assert registry(url, "list")["tools"] == registry(filled, "list")["tools"]
    registry(url, "get", "SIM-0001", "-o", tmp_path / "got.json")
    assert (tmp_path / "got.json").read_bytes() == (
        example.parent / "tools" / "SIM-0001.json"
    ).read_bytes()
    registry(url, "export", tmp_path / "out")
    backup = registry(url, "backup", tmp_path / "b.sqlite")
    assert registry(tmp_path / "b.sqlite", "check", "--head", backup["head"])["sound"]
    secret = url.replace("://postgres", "://user:s3cret", 1)
    ran = mwdcal("registry", "--registry", secret, "list")
    assert ran.code == 2
    assert "s3cret" not in ran.out + ran.err + str(added)


def test_an_altered_registry_is_found_and_a_text_of_others_stays_a_text(filled, tmp_path):
    import sqlite3

    work = tmp_path / "work.sqlite"
    shutil.copy(filled, work)
    with sqlite3.connect(work) as connection:
        connection.execute("DROP TRIGGER records_no_update")
        connection.execute(
            "UPDATE records SET name = ? WHERE kind = 'profile'", ("\x1b[2J<b>x</b>",)
        )
    connection.close()
    ran = mwdcal("registry", "--registry", work, "check")
    assert ran.code == 1
    assert ran.out.startswith("FAIL")
    assert "\x1b" not in mwdcal("registry", "--registry", work, "list", "--kind", "profile").out
