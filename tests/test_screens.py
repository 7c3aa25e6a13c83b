"""Screens on terminals of 80 and 120 columns, of every command, on the bundled example.

`python tests/test_screens.py` rewrites the stored ones in `tests/screens`.
"""

import hashlib
import io
import json
import os
import re
import shutil
import sys
import tempfile
from collections import Counter
from contextlib import redirect_stderr, redirect_stdout, suppress
from datetime import UTC, datetime
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from cli_support import called, commands, mwdcal, read_csv, servo_run, write_csv
from mwdcal.app import cli, messages
from mwdcal.certificate import signature
from mwdcal.presentation import text

STORED = Path(__file__).parent / "screens"
WIDTHS = (80, 120)
PLACE = ("--latitude", "60", "--longitude", "3.5", "--altitude-m", "40", "--date", "2026-07-01")
REGISTRY = ("--registry", "tools.sqlite")
NEW_REGISTRY = ("--registry", "new.sqlite")
SCREENS = {
    "example": ("example", "new"),
    "calibrate": ("calibrate", "demo/run.csv", "--tool", "demo/tool.toml", "-o", "made.json"),
    "calibrate-moved": ("calibrate", "moved.csv", "--tool", "demo/tool.toml", "-o", "made.json"),
    "calibrate-soaks": ("calibrate", "soaks.csv", "--tool", "demo/tool.toml", "-o", "made.json"),
    "calibrate-refused": ("calibrate", "few.csv", "--tool", "demo/tool.toml", "-o", "made.json"),
    "verify": ("verify", "tool.json", "demo/rolltest.csv"),
    "verify-failed": ("verify", "tool.json", "demo/rolltest.csv", "--limits", "tight.toml"),
    "verify-not-rolled": ("verify", "tool.json", "part.csv"),
    "apply": ("apply", "tool.json", "hot.csv", "-o", "made.csv"),
    "certificate": ("certificate", "dated.json", "--verification", "v.json", "--laboratory",
                    "demo/laboratory.toml", "--date", "2026-04-01", "--number", "EX-1", "-o", "C.json"),
    "certificate-failed": ("certificate", "dated.json", "--verification", "failed.json", "--date",
                           "2026-04-01", "--number", "EX-2"),
    "compare": ("compare", "demo/run.csv", "--tool", "demo/tool.toml"),
    "compare-parameters": ("compare", "demo/run.csv", "--tool", "demo/tool.toml", "--parameters"),
    "convert": ("convert", "tool.json", "--notation", "forward", "--temperature", "90"),
    "diagnose": ("diagnose", "tool.json", "demo/rolltest.csv"),
    "diagnose-named": ("diagnose", "tool.json", "knocked.csv"),
    "fleet": ("fleet", "fleet.parquet", "--tool", "demo/tool.toml", "-o", "made.parquet",
              "--workers", "1"),
    "noise": ("noise", "demo/static.csv", "--tool", "demo/tool.toml"),
    "plan": ("plan", "--tool", "demo/tool.toml", "--plan", "six-state", "--plan", "moosavi-30"),
    "plan-best": ("plan", "--tool", "demo/tool.toml", "--stations", "8"),
    "profile": ("profile", "demo/export.csv", "-o", "made.toml"),
    "reference": ("reference", *PLACE, "--crs", "EPSG:23031", "--field-nt", "50500"),
    "reference-fill": ("reference", *PLACE, "--model", "igrf14", "--fill", "blank.csv", "-o",
                       "made.csv"),
    "registry-init": ("registry", "init", *NEW_REGISTRY),
    "registry-add": ("registry", "add", "moved.csv", "stand.toml", *REGISTRY),
    "registry-list": ("registry", "list", *REGISTRY),
    "registry-list-due": ("registry", "list", "--due", "2030-01-01", *REGISTRY),
    "registry-history": ("registry", "history", "SIM-0001", *REGISTRY),
    "registry-drift": ("registry", "drift", "SIM-0001", "--date", "2026-11-22", *REGISTRY),
    "registry-get": ("registry", "get", "SIM-0001", "-o", "made.json", *REGISTRY),
    "registry-withdraw": ("registry", "withdraw", "2", "--reason", "wrong stand angles", *REGISTRY),
    "registry-export": ("registry", "export", "new", *REGISTRY),
    "registry-check": ("registry", "check", *REGISTRY),
    "registry-check-altered": ("registry", "check", "--head", "0" * 64, *REGISTRY),
    "registry-backup": ("registry", "backup", "made.sqlite", *REGISTRY),
    "registry-restore": ("registry", "restore", "unchanged.sqlite", *NEW_REGISTRY),
    "registry-upgrade": ("registry", "upgrade", *REGISTRY),
    "init": ("init", "laboratory", "--defaults"),
    "list": ("list", "limits"),
    "simulate": ("simulate", "--plan", "six-state", "--effects", "stand.toml", "-o", "made.csv"),
    "simulate-repeat": ("simulate", "--plan", "six-state", "--repeat", "20", "--limits", "tight.toml",
                        "--workers", "1", "-o", "made.parquet"),
    "stations": ("stations", "demo/log.csv", "-o", "stations.csv"),
    "survey": ("survey", "tool.json", "demo/well.csv", "-o", "made.csv"),
    "certificate-sign": ("certificate", "sign", "certificate.json", "--private-key", "lab.key", "-o", "made.json"),
    "certificate-verify": ("certificate", "verify", "signed.json", "--key", "lab.key.pub"),
    "certificate-altered": ("certificate", "verify", "altered.json", "--key", "lab.key.pub"),
    "key-list": ("certificate", "key", "list", "keys.json"),
    "key-retire": ("certificate", "key", "retire", "old.json", "139e", "--at", "2027-01-01"),
    "verify-signed": ("verify", "signed-tool.json", "demo/rolltest.csv", "--key", "keys.json"),
    "misused": ("calibrate", "demo/run.csv"),
}  # fmt: skip
"""Commands and what they run on."""
WITHOUT_A_SCREEN = {
    "bench",  # serves until it is stopped
    "completion",
    *(f"certificate key {name}" for name in ("create", "trust", "revoke")),
}
"""Commands whose result is a script, or a key or time that is new each time; those of keys show a list of them."""


class Terminal(io.TextIOWrapper):
    """A stream that says it is a terminal."""

    def __init__(self, encoding="utf-8"):
        super().__init__(io.BytesIO(), encoding, newline="\n")

    def isatty(self):
        return True

    def text(self):
        self.flush()
        return self.buffer.getvalue().decode(self.encoding)


def seen(width, *arguments, encoding="utf-8", **variables):
    """Exit status, stdout and stderr of a command on a terminal of a width."""
    out, err = Terminal(encoding), Terminal(encoding)
    typed = {"COLUMNS": str(width), "TERM": "dumb", "NO_COLOR": "", **variables}
    with (
        patch.dict(os.environ, typed),
        redirect_stdout(out),
        redirect_stderr(err),
        pytest.raises(SystemExit) as stop,
    ):
        cli.main(list(arguments))
    return stop.value.code or 0, out.text(), err.text()


def changed(source, target, change):
    """A file of the example with changed columns; `change` works on lists of cells."""
    comments = [s for s in source.read_text("utf-8").splitlines() if s.startswith("#")]
    columns = read_csv(source)
    change(columns)
    write_csv(target, columns, *(comment[2:] for comment in comments))


def prepared(folder):
    """The files that the screens are of."""
    assert mwdcal("example", folder / "demo").code == 0
    demo = folder / "demo"
    fit = ("calibrate", demo / "run.csv", "--tool", demo / "tool.toml", "-o", folder / "tool.json")
    assert mwdcal(*fit).code == 0

    def moved(columns):
        columns["az"][6] = f"{float(columns['az'][6]) + 0.0039:.6f}"
        columns["remark"] = ["as it came"] * 48

    def knocked(columns):
        columns["ay"] = [f"{float(value) + 0.015:.6f}" for value in columns["ay"]]

    def some(count):
        return lambda columns: columns.update({k: v[:count] for k, v in columns.items()})

    def hot(columns):
        columns["temperature_c"][3] = "80.0"

    def without_references(columns):
        del columns["ref_gravity_g"]
        columns["ref_field_nt"][1:] = [""] * 47

    changed(demo / "run.csv", folder / "moved.csv", moved)
    changed(demo / "run.csv", folder / "few.csv", some(3))
    changed(demo / "run.csv", folder / "blank.csv", without_references)
    changed(demo / "rolltest.csv", folder / "part.csv", some(4))
    changed(demo / "rolltest.csv", folder / "knocked.csv", knocked)
    changed(demo / "surveys.csv", folder / "hot.csv", hot)
    write_csv(folder / "soaks.csv", servo_run(temperatures=(0.0, 40.0, 80.0)))
    dated(demo, folder)
    limits = 'name = "tight"\n[error]\ninclination_deg = 0.001\nazimuth_deg = 2\n'
    (folder / "tight.toml").write_text(limits, "utf-8")
    (folder / "stand.toml").write_text(
        "[stand]\nazimuth_zero_deg = 0.1\ntilt_deg = 0.05\n", "utf-8"
    )
    for name, *limits in (("v.json",), ("failed.json", "--limits", folder / "tight.toml")):
        test = mwdcal("verify", folder / "dated.json", demo / "rolltest.csv", "--json", *limits)
        (folder / name).write_text(test.out, "utf-8")
    fleet(folder)
    registry(folder)
    signatures(folder)


def registry(folder):
    """A registry with a calibration, its run, roll test and verdict, a certificate and the laboratory."""
    pytest.importorskip("sqlalchemy")
    whole = ("registry", "--registry", folder / "unchanged.sqlite")
    assert mwdcal(*whole, "init", "--as", "A. Borg").code == 0
    certificate = [folder / each if "." in each else each for each in SCREENS["certificate"]]
    assert mwdcal(*certificate).code == 0
    (folder / "C.json").rename(folder / "issued.json")
    names = (
        *("dated.json", "dated.csv", "v.json", "demo/rolltest.csv", "demo/laboratory.toml"),
        "issued.json",
    )
    added = mwdcal(*whole, "add", *(folder / name for name in names), "--as", "A. Borg")
    assert (added.code, added.err) == (0, "")
    undone(folder)


def undone(folder):
    """Take back what a command has left: its output, a new folder or registry, and what the registry was given."""
    shutil.rmtree(folder / "new", ignore_errors=True)
    (folder / "laboratory").mkdir(exist_ok=True)
    (folder / "laboratory" / "mwdcal.toml").unlink(missing_ok=True)
    for left in (*folder.glob("new.sqlite*"), *folder.glob("made.*")):
        left.unlink()
    with suppress(FileNotFoundError):
        shutil.copy(folder / "unchanged.sqlite", folder / "tools.sqlite")


def signatures(folder):
    """Documents signed with a key that is the same each time, one of them altered; a list of keys."""
    pytest.importorskip("cryptography")
    write_key(folder / "lab.key", "Calibration laboratory")
    document = {
        "schema_version": 1,
        "command": "certificate",
        "serial": "SIM-0001",
        "simulated": True,
    }
    files = [("calibration", "tool.json"), ("run", "demo/run.csv"), ("verification", "lost.json")]
    listed = [
        {
            "id": name,
            "name": path,
            "sha256": hashlib.sha256((folder / path).read_bytes()).hexdigest(),
        }
        for name, path in files[:1]
    ] + [{"id": name, "name": path, "sha256": "0" * 64} for name, path in files[1:]]
    (folder / "certificate.json").write_text(json.dumps({**document, "files": listed}), "utf-8")
    with patch.object(signature, "now", lambda: "2026-07-01T12:00:00+00:00"):
        for name, target in (("certificate", "signed"), ("tool", "signed-tool")):
            typed = (
                folder / f"{name}.json",
                "--private-key",
                folder / "lab.key",
                "-o",
                folder / f"{target}.json",
            )
            assert mwdcal("certificate", "sign", *typed).code == 0
    altered = (folder / "signed.json").read_bytes().replace(b"SIM-0001", b"SIM-0002")
    (folder / "altered.json").write_bytes(altered)
    for name in ("keys.json", "old.json"):
        typed = (folder / name, folder / "lab.key.pub")
        assert mwdcal("certificate", "key", "trust", *typed).code == 0


def write_key(path, owner):
    """A key that is the same each time."""
    curve = pytest.importorskip(
        "cryptography.hazmat.primitives.asymmetric.ed25519"
    ).Ed25519PrivateKey
    private = curve.from_private_bytes(bytes(32))
    with (
        patch.object(curve, "generate", lambda: private),
        patch.object(signature, "now", lambda: "2026-01-01T00:00:00+00:00"),
    ):
        signature.create(path, owner, "")


def dated(demo, folder):
    """The calibration of the run with a date, which a certificate shows."""
    run = "# date = 2026-03-15\n" + (demo / "run.csv").read_text("utf-8")
    (folder / "dated.csv").write_text(run, "utf-8")
    line = ("calibrate", folder / "dated.csv", "--tool", demo / "tool.toml", "-o")
    assert mwdcal(*line, folder / "dated.json").code == 0


def fleet(folder):
    """The example run as three tools, one with a station that moved and one with three stations."""
    pq = pytest.importorskip("pyarrow.parquet")
    pa = pytest.importorskip("pyarrow")
    runs = [read_csv(folder / name) for name in ("demo/run.csv", "moved.csv", "few.csv")]
    names = [name for name in runs[0] if name != "station"]
    columns = {n: np.array([float(v) for run in runs for v in run[n]]) for n in names}
    serials = [f"SIM-000{i}" for i, run in enumerate(runs, 1) for _ in run["ax"]]
    pq.write_table(pa.table({"serial": serials, **columns}), folder / "fleet.parquet")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("screens")
    prepared(folder)
    return folder


@pytest.fixture
def work(files, computed_once, tmp_path, monkeypatch):
    """A copy of the files to run in; nothing is said of how far a command is."""
    monkeypatch.setattr(messages.slowly, "__defaults__", (600.0,))
    monkeypatch.setattr(messages, "PATIENCE", 600.0)
    monkeypatch.chdir(shutil.copytree(files, tmp_path / "work"))


def screen(width, *arguments, **variables):
    """What a terminal shows, with measured times and what varies with them blotted out."""
    code, out, err = seen(width, *arguments, **variables)
    shown = f"exit {code}\n--- stdout\n{out}--- stderr\n{err}"
    shown = re.sub(r"[\d.]+ s, [\d.]+ tools/s", "? s, ? tools/s", shown)
    libraries = (rf"(?<={name} )\d[\w.]+" for name in ("mwdcal", "pygeomag", "ppigrf", "pyproj"))
    today = f"{datetime.now(UTC).date()}"
    for varying in (
        "[0-9a-f]{64}",
        r"(?<=\d{8}-)[0-9a-f]{12}\b",
        r"(?<= )[0-9a-f]{12}\b",
        r"(?<=probability of 0\.\d)\d",  # of fixed draws, of which one may lie on the edge
        today,
        *libraries,
    ):
        shown = re.sub(varying, lambda part: "?" * len(part[0]), shown)
    times = re.compile(r"^(time of one fit, s)(.*)$", re.MULTILINE)
    return times.sub(lambda line: line[1] + re.sub(r"\d", "0", line[2]), shown)


def rounded(shown):
    """Values of twelve digits to five, which are the same on every machine; blanks vary with their length."""
    return re.sub("[ ─]+", " ", re.sub(r"(\d\.\d{4})\d*", r"\1", shown))


def stored(name, width):
    return STORED / f"{name}-{width}.txt"


def words(shown):
    """Words, without the rules of tables and the marks of comments."""
    return re.findall(r"[^\s─#]+", shown)


def test_every_command_has_a_screen():
    shown = {called(arguments) for arguments in SCREENS.values()}
    assert shown | WITHOUT_A_SCREEN == {*commands()}


@pytest.mark.parametrize("name", SCREENS)
def test_screens_are_the_stored_ones_and_nothing_is_lost_or_too_wide(work, name):
    undone(Path())
    whole = screen(160, *SCREENS[name])
    for width in WIDTHS:
        undone(Path())
        shown = screen(width, *SCREENS[name])
        assert max(map(len, shown.splitlines())) <= width
        assert not Counter(words(whole)) - Counter(words(shown))
        assert {*words(shown)} == {*words(whole)}
        compared = rounded if name == "convert" else str
        assert compared(shown) == compared(stored(name, width).read_text("utf-8"))


@pytest.mark.parametrize("width", [1, 80, 160, 1000])
def test_a_terminal_counts_as_80_to_160_columns(work, width):
    clamped = min(max(width, 80), 160)
    assert screen(width, *SCREENS["verify"]) == screen(clamped, *SCREENS["verify"])


@pytest.mark.parametrize("encoding", ["ascii", "cp1252", "cp850"])
def test_lines_are_folded_in_the_characters_that_are_shown(work, encoding):
    for name in ("calibrate", "verify", "compare"):
        _, out, err = seen(80, *SCREENS[name], encoding=encoding)
        assert max(map(len, (out + err).splitlines())) <= 80


@pytest.mark.parametrize("name", sorted({*commands(), *cli.cli.commands}))
def test_help_fits_80_columns(name):
    code, out, _ = seen(80, *name.split(), "--help")
    assert code == 0
    assert max(map(len, out.splitlines())) <= 80


def test_a_comment_of_a_profile_goes_on_as_a_comment():
    tomllib = pytest.importorskip("tomllib")
    line = (
        "noise = 0.1   # raw, 1 sigma of one station of 12 s; ax 0.0001, ay 0.0001; from static.csv"
    )
    out = Terminal()
    with patch.dict(os.environ, COLUMNS="80"):
        folded = text.laid_out(line, out)
    assert "\n" in folded
    assert tomllib.loads(folded) == {"noise": 0.1}


def test_words_longer_than_a_line_stay_whole():
    word = "a" * 100
    assert text.fold(f"one {word} two", 80, "  ") == f"one\n  {word}\n  two"


# Colour

ESCAPE = re.compile(r"\x1b\[[0-9;]*m")


@pytest.mark.parametrize("name", ["verify", "verify-failed", "calibrate-moved", "fleet"])
def test_colour_is_on_a_terminal_alone_and_carries_nothing(work, name):
    screen(160, *SCREENS[name])  # later ones replace its files, and say so
    plain, shown = (screen(160, *SCREENS[name], TERM=term) for term in ("dumb", "xterm"))
    assert ESCAPE.search(shown)
    assert ESCAPE.sub("", shown) == plain
    assert screen(160, *SCREENS[name], TERM="xterm", NO_COLOR="1") == plain
    with patch.dict(os.environ, COLUMNS="80", TERM="xterm", FORCE_COLOR="1"):
        piped = mwdcal(*SCREENS[name])
    assert "\x1b" not in piped.out + piped.err


def coloured(shown):
    """Words in colour, each with the colour's number."""
    return {(w, n) for n, w in re.findall(r"\x1b\[(\d+)m\x1b\[1m([^\x1b]*)\x1b\[0m", shown)}


def test_verdicts_and_findings_have_their_colours(work):
    assert coloured(seen(80, *SCREENS["verify"], TERM="xterm")[1]) == {
        ("PASS", "32"),
        ("pass", "32"),
    }
    failed = seen(80, *SCREENS["verify-failed"], TERM="xterm")[1]
    assert coloured(failed) == {("FAIL", "31"), ("pass", "32")}
    assert coloured(seen(80, *SCREENS["calibrate-moved"], TERM="xterm")[2]) == {("!", "33")}


# Findings, and --quiet


@pytest.mark.parametrize("name", SCREENS)
def test_findings_are_on_stderr_alone_and_once(work, name):
    ran = mwdcal(*SCREENS[name])
    assert not [line for line in ran.out.splitlines() if line.startswith("!")]
    findings = [line for line in ran.err.splitlines() if line.startswith("! ")]
    assert len({*findings}) == len(findings)
    if name in ("calibrate-moved", "fleet", "apply", "convert"):
        assert findings


@pytest.mark.parametrize("name", SCREENS)
@pytest.mark.parametrize("terminal", [False, True])
def test_a_quiet_command_prints_errors_alone(work, name, terminal):
    arguments = SCREENS[name]
    usual = mwdcal(*arguments)
    undone(Path())
    if terminal:
        code, out, err = seen(80, *arguments, "--quiet")
    else:
        ran = mwdcal(*arguments, "--quiet")
        code, out, err = ran.code, ran.out, ran.err
    assert code == usual.code
    assert out == ""
    if code in (0, 1):
        assert err == ""
    else:
        assert words(err)[-5:] == words(usual.err)[-5:]


def untimed(document):
    """A document without measured times."""
    timed = ("seconds", "tools_per_second", "time", "parts_done_before", "head")
    if isinstance(document, dict):
        return {k: untimed(v) for k, v in document.items() if k not in timed}
    return [untimed(v) for v in document] if isinstance(document, list) else document


@pytest.mark.parametrize("name", [n for n in SCREENS if n not in ("misused", "calibrate-refused")])
def test_a_quiet_command_prints_its_json_all_the_same(work, name):
    usual = mwdcal(*SCREENS[name], "--json")
    undone(Path())
    quiet = mwdcal(*SCREENS[name], "--json", "--quiet")
    assert quiet.err == ""
    assert untimed(quiet.json) == untimed(usual.json)
    assert quiet.code == usual.code


def test_a_quiet_completion_prints_nothing():
    ran = mwdcal("completion", "zsh", "--quiet")
    assert (ran.code, ran.out, ran.err) == (0, "", "")


if __name__ == "__main__":
    messages.PATIENCE = 600.0
    messages.slowly.__defaults__ = (600.0,)
    with tempfile.TemporaryDirectory() as place:
        prepared(Path(place))
        os.chdir(place)
        for each, words_typed in SCREENS.items():
            for columns in WIDTHS:
                undone(Path())
                stored(each, columns).write_text(screen(columns, *words_typed), "utf-8")
        os.chdir("/")
    sys.exit(0)
