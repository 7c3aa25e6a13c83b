"""What the command line shows: any encoding, any stream, and text of others that must not act on a terminal."""

import ast
import functools
import io
import json
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from contextlib import redirect_stderr, redirect_stdout, suppress
from pathlib import Path

import numpy as np
import pytest

from cli_support import calibrated, mwdcal, refused, servo_run, write_csv
from mwdcal.app import cli, messages
from mwdcal.presentation import text

SOURCE = Path(cli.__file__).parents[1]
ENCODINGS = ("cp1252", "cp850", "latin-1", "ascii")
pytestmark = pytest.mark.usefixtures("computed_once")
posix = pytest.mark.skipif(os.name == "nt", reason="POSIX names, pipes and descriptors")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Inputs of every command, by a short name."""
    folder = tmp_path_factory.mktemp("screen")
    (folder / "made").mkdir()
    calibrated(folder, servo_run())
    write_csv(folder / "roll.csv", servo_run(inclinations=(30,)))
    write_csv(folder / "soaks.csv", servo_run(toolfaces=4, temperatures=(0.0, 40.0)))
    write_csv(folder / "other.csv", servo_run(seed=2, inclinations=(30,)))  # of another tool
    (folder / "mine.toml").write_text('name = "mine"\n[spread]\ninclination_deg = 1\n')
    columns = servo_run()
    tools = {"serial": ["A"] * 48 + ["B"] * 48, **{k: np.tile(v, 2) for k, v in columns.items()}}
    pq = pytest.importorskip("pyarrow.parquet")
    pq.write_table(pytest.importorskip("pyarrow").table(tools), folder / "fleet.parquet")
    angle = np.interp(np.arange(1000) * 0.05, [0, 20, 24, 50], [0.5, 0.5, 1.5, 1.5])
    raw = 3 * np.stack([np.sin(angle), 0.1 + 0 * angle, np.cos(angle)])
    raw += 1e-3 * np.random.default_rng(1).normal(size=raw.shape)
    log = dict(zip(("ax", "ay", "az"), raw, strict=True))
    write_csv(folder / "log.csv", {"time_s": np.arange(1000) * 0.05, **log})
    return folder


COMMANDS = {
    "calibrate": ("run.csv", "--tool", "servo", "-o", "made/new.json"),
    "apply": ("cal.json", "roll.csv", "-o", "made/out.csv"),
    "verify": ("cal.json", "roll.csv"),
    "convert": ("cal.json", "--notation", "affine", "--temperature", "90"),
    "compare": ("soaks.csv", "--tool", "servo", "--order", "0"),
    "fleet": ("fleet.parquet", "--tool", "servo", "-o", "made/cals.parquet", "--workers", "1"),
    "noise": ("log.csv", "--to", "19", "--tool", "servo"),
    "stations": ("log.csv", "-o", "made/run2.csv"),
    "profile": ("run.csv", "-o", "made/tool.toml"),
}
OTHERS = {name: (name, "--help") for name in COMMANDS} | {
    "failed": ("verify", "cal.json", "other.csv"),
    "refused": ("verify", "cal.json", "run.csv"),
    "misused": ("verify", "cal.json"),
}
LINES = {name: (name, *arguments) for name, arguments in COMMANDS.items()} | {
    f"{name} {arguments[-1]}": arguments for name, arguments in OTHERS.items()
}


def shown(encoding, *arguments):
    """Exit status, stdout and stderr of a command, in streams of an encoding, at the width that is set."""
    return shown_at(os.environ.get("COLUMNS"), encoding, *arguments)


@functools.cache
def shown_at(_width, encoding, *arguments):
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding, newline="\n") for _ in range(2))
    with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as stop:
        cli.main(list(arguments))
    return stop.value.code, *(stream.buffer.getvalue().decode(encoding) for stream in (out, err))


def shown_on_a_terminal(encoding, *arguments):
    """The same in two terminals: one has stdout, one has stderr."""
    pairs = [os.openpty() for _ in range(2)]
    printed = [b"", b""]

    def listen(k):
        with suppress(OSError):  # the end of what was written, on Linux
            while part := os.read(pairs[k][0], 1 << 16):
                printed[k] += part

    listeners = [threading.Thread(target=listen, args=(k,)) for k in range(2)]
    for listener in listeners:
        listener.start()
    out, err = (open(inner, "w", encoding=encoding) for _, inner in pairs)  # noqa: SIM115
    with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as stop:
        cli.main(list(arguments))
    for stream in (out, err):
        stream.close()
    for listener, (outer, _) in zip(listeners, pairs, strict=True):
        listener.join()
        os.close(outer)
    return stop.value.code, *(part.decode(encoding).replace("\r\n", "\n") for part in printed)


def timeless(printed):
    """What was printed, without measured times."""
    return re.sub(r"\b[\d.]+ (s|tools/s)\b|time of one fit.*", "", printed)


def uncoloured(printed):
    """What a terminal was sent, without the colours of `click.style`; every other escape stays."""
    return re.sub(r"\x1b\[(0|1|3[123])m", "", printed)


def words(printed):
    """Words in plain characters, without rules between them and without measured times."""
    return re.sub("-{5,}", "", timeless(text.transliterate(printed, "ascii"))).split()


def untimed(document):
    """A JSON document without measured times."""
    if isinstance(document, dict):
        timed = ("seconds", "tools_per_second", "time")
        return {k: untimed(v) for k, v in document.items() if k not in timed}
    return [untimed(v) for v in document] if isinstance(document, list) else document


@pytest.fixture
def no_progress(monkeypatch):
    """Nothing is said of how far a command is, however slow the machine."""
    monkeypatch.setattr(messages, "PATIENCE", 600.0)
    monkeypatch.setattr(messages.slowly, "__defaults__", (600.0,))


@pytest.mark.parametrize("command", COMMANDS)
def test_status_and_result_are_the_same_in_every_encoding(files, monkeypatch, no_progress, command):
    monkeypatch.chdir(files)
    # the next ones say that they replace the file of the first
    shown_at("0", "utf-8", command, *COMMANDS[command])
    code, *said = shown("utf-8", command, *COMMANDS[command])
    assert code == 0, said
    for encoding in ENCODINGS:
        other, *printed = shown(encoding, command, *COMMANDS[command])
        assert other == code
        assert [words(part) for part in printed] == [words(part) for part in said]


@posix
@pytest.mark.parametrize("encoding", ["utf-8", *ENCODINGS])
@pytest.mark.parametrize("arguments", LINES.values(), ids=LINES)
def test_a_terminal_sees_what_a_file_holds(files, monkeypatch, no_progress, arguments, encoding):
    """The same words in the same order, but for colours and where lines are folded."""
    monkeypatch.chdir(files)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "160")
    shown_at("0", encoding, *arguments)  # both say that they replace its file
    code, *printed = shown_on_a_terminal(encoding, *arguments)
    other, *said = shown(encoding, *arguments)
    assert code == other
    for part, expected in zip(map(uncoloured, printed), said, strict=True):
        assert "\x1b" not in part
        assert "\x1b" not in expected
        assert words(part) == words(expected)
        assert max(map(len, [*part.splitlines(), ""])) <= 160


@posix
@pytest.mark.parametrize("encoding", ["utf-8", *ENCODINGS])
def test_a_progress_bar_is_drawn_in_every_encoding(files, monkeypatch, encoding):
    monkeypatch.chdir(files)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(messages, "PATIENCE", 0.0)
    code, out, err = shown_on_a_terminal(encoding, "apply", *COMMANDS["apply"])
    assert code == 0
    assert "\x1b" in err
    assert words(out) == words(shown(encoding, "apply", *COMMANDS["apply"])[1])


@pytest.mark.parametrize("arguments", OTHERS.values(), ids=OTHERS)
def test_so_are_help_verdicts_and_refusals(files, monkeypatch, arguments):
    monkeypatch.chdir(files)
    code, *said = shown("utf-8", *arguments)
    for encoding in ENCODINGS:
        other, *printed = shown(encoding, *arguments)
        assert other == code
        assert [words(part) for part in printed] == [words(part) for part in said]


@pytest.mark.parametrize("command", sorted({*COMMANDS} - {"compare"}))
def test_json_says_the_same_in_every_encoding(files, monkeypatch, command):
    monkeypatch.chdir(files)
    results = [shown(e, command, *COMMANDS[command], "--json") for e in ("utf-8", "ascii")]
    first, second = ((code, untimed(json.loads(out))) for code, out, _ in results)
    assert first == second


def test_plain_twins_of_what_an_encoding_lacks():
    assert (
        text.transliterate("1σ ± 0.1° – χ² 10⁻³ µT …", "ascii")
        == "1sigma +/- 0.1deg - chi^2 10^-3 uT ..."
    )
    assert text.transliterate("1σ ± 0.1° – χ² …", "cp1252") == "1sigma ± 0.1° – chi² …"
    assert text.transliterate("1σ ± 0.1° – χ² …", "cp850") == "1sigma ± 0.1° - chi² ..."
    assert text.transliterate("1σ ± 0.1° – χ² …", "utf-8") == "1σ ± 0.1° – χ² …"
    assert (
        text.transliterate("Größe 号", "ascii") == r"Gr\xf6\xdfe \u53f7"
    )  # other names stay other names


VOCABULARIES = (
    "words.py", "titles.py", "title_references.py", "settings.py", "marks.py", "depths.py", "encodings.py",
)  # fmt: skip


def printed_characters():
    """Characters beyond ASCII in the strings of the package; of docstrings only those that are help.

    Patterns that are looked for, and vocabularies of other languages, are not printed.
    """
    found = set()
    for path in SOURCE.rglob("*.py"):
        if path.name in VOCABULARIES:
            continue
        tree = ast.parse(path.read_text("utf-8"))
        documented = [n for n in ast.walk(tree) if isinstance(n, ast.Expr)]
        silent = {id(n.value) for n in documented} if path.parent.name != "commands" else set()
        patterns = [
            n for n in ast.walk(tree) if isinstance(n, ast.Call) and "compile" in ast.dump(n.func)
        ]
        silent |= {id(each) for call in patterns for each in ast.walk(call)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found |= set() if id(node) in silent else set(node.value)
    return {character for character in found if character > "~"}


def test_every_character_that_the_package_prints_has_a_plain_twin():
    characters = printed_characters()
    assert {"°", "σ", "χ", "…"} <= characters
    controls = {c for c in characters if not c.isprintable() and c not in text.TWINS}
    lacking = [c for c in characters - controls if text.transliterate(c, "ascii").startswith("\\")]
    assert lacking == []


def test_a_table_keeps_its_columns_in_every_encoding(monkeypatch):
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), "ascii"))
    lines = text.table([["a", "0.1°", "x"], ["b", "12.5°", "y"]], ["", "1σ", "z"]).splitlines()
    assert len({len(line) for line in lines}) == 1
    assert lines[0].split() == ["1sigma", "z"]


# Streams


def process(*arguments, **streams):
    """The command line as its own process."""
    command = [sys.executable, "-m", "mwdcal", *map(str, arguments)]
    return subprocess.run(command, check=False, encoding="utf-8", **streams)


@posix
@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-"])
def test_a_closed_stream_costs_nothing(files, tmp_path, closed):
    table = tmp_path / "out.csv"
    command = [sys.executable, "-m", "mwdcal", "apply", "cal.json", "roll.csv", "-o", str(table)]
    line = " ".join(f"'{word}'" for word in command)
    done = subprocess.run(["sh", "-c", f"{line} {closed}"], cwd=files, capture_output=True)
    assert done.returncode == 0
    assert (
        done.stderr == b""
        if "2>&-" in closed
        else done.stderr.startswith(b"! no serial in the calibration")
    )
    mwdcal("apply", files / "cal.json", files / "roll.csv", "-o", tmp_path / "second.csv")
    assert table.read_bytes() == (tmp_path / "second.csv").read_bytes()


@posix
@pytest.mark.parametrize(("run", "verdict"), [("roll.csv", 0), ("other.csv", 1)])
def test_the_verdict_stands_where_its_reader_has_left(files, run, verdict):
    reader, writer = os.pipe()
    os.close(reader)
    arguments = ("verify", "cal.json", run)
    done = process(*arguments, cwd=files, stdout=writer, stderr=subprocess.PIPE)
    os.close(writer)
    assert done.returncode == verdict
    assert "rror:" not in done.stderr


@posix
def test_neither_help_nor_misuse_fails_where_the_reader_has_left():
    for arguments, status in ((("--help",), 0), (("verify",), 2)):
        reader, writer = os.pipe()
        os.close(reader)
        assert process(*arguments, stdout=writer, stderr=writer).returncode == status
        os.close(writer)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_a_full_disk_is_never_a_failed_test(files):
    with open("/dev/full", "w") as full:
        arguments = ("verify", "cal.json", "other.csv")
        done = process(*arguments, cwd=files, stdout=full, stderr=subprocess.PIPE)
    assert done.returncode == 2
    assert "mwdcal: cannot write the result: No space left on device." in done.stderr


# What others have written

ACTIVE = "[/b]S[a1] :bell: \x1b[2J\x1b[31mPASS\x9b0m\x07\u202e$\\frac$"
CONTROL = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")


def test_text_of_others_is_one_line_without_control_characters():
    assert text.one_line("a\x1b[2Jb\rc\nd\x9b\u202e\x07\u2028é") == (
        r"a\x1b[2Jb\rc\nd\x9b\u202e\x07\u2028é"
    )
    assert text.one_line(os.fsdecode(b"r\xff.csv")) in ("r\\xff.csv", "r�.csv")


def test_markup_is_text_in_a_table():
    cells = ["[/b]", "S[a1]", "[red]x[/red]", ":bell:", "[link=x]y"]
    lines = text.table([[cell, "1"] for cell in cells], ["[b]", ""]).splitlines()
    assert [line.split()[0] for line in lines if "─" not in line] == ["[b]", *cells]


@pytest.fixture(scope="module")
def active(tmp_path_factory):
    """A run and a roll test with the like in labels, serial, keys and names of columns."""
    folder = tmp_path_factory.mktemp("active")
    told = json.dumps(ACTIVE + "\nPASS")
    for name, columns in (("run", servo_run()), ("roll", servo_run(inclinations=(30,)))):
        labels = [f"{ACTIVE}{i}" for i in range(len(columns["ax"]))]
        columns = {**columns, "station": labels, "note" + ACTIVE: labels}
        write_csv(folder / f"{name}.csv", columns, f"serial = {told}", f'"k{ACTIVE[:4]}" = "x"')
    return folder


@pytest.mark.slow
@pytest.mark.usefixtures("without_layout")
def test_no_command_shows_control_characters_or_takes_markup(active, monkeypatch):
    monkeypatch.chdir(active)
    commands = [
        ("calibrate", "run.csv", "--tool", "servo", "-o", "cal.json", "--report", "run.html"),
        ("apply", "cal.json", "roll.csv", "-o", "out.csv"),
        ("verify", "cal.json", "roll.csv", "--report", "roll.html"),
        ("verify", "cal.json", "roll.csv"),
        ("verify", "cal.json", "roll.csv", "--json"),
        ("convert", "cal.json", "--notation", "affine"),
        ("convert", "cal.json", "--notation", "affine", "--json"),
    ]
    ran = [mwdcal(*arguments) for arguments in commands]
    for each in ran:
        assert each.code == 0, each
        assert not CONTROL.search(each.out + each.err)
    assert all("note[/b]S[a1] :bell: \\x1b[2J" in each.err for each in ran[:5])
    assert ran[0].out.startswith("run.csv   [/b]S[a1] :bell: \\x1b[2J")
    assert "\nPASS" not in ran[0].out
    told = " ".join(ran[3].out.split("where", 1)[1].split())  # rows fold
    assert "[/b]S[a1] :bell: \\x1b[2J" in told
    assert ran[6].json["serial"] == ACTIVE + "\nPASS"
    for page in ("run.html", "roll.html"):
        content = (active / page).read_text("utf-8")
        assert "[/b]S[a1] :bell: \\x1b[2J" in content
        assert not CONTROL.search(content.replace("\t", ""))


def test_markup_and_control_characters_in_messages(active, monkeypatch):
    monkeypatch.chdir(active)
    name = "a[/b]\x1b[2J\nx.csv"
    message = refused(mwdcal("calibrate", name, "-o", "new.json"), 2)
    assert "a[/b]\\x1b[2J\\nx.csv" in message
    misused = mwdcal("calibrate", "run.csv", "-o", "new.json", name)
    assert misused.code == 2
    assert not CONTROL.search(misused.err)


@posix
def test_a_name_that_is_not_utf_8_is_refused_before_anything_is_written(files, tmp_path):
    name = os.fsdecode(os.fsencode(tmp_path) + b"/r\xff.csv")
    shutil.copy(files / "run.csv", name)
    output = ("--tool", "servo", "-o", tmp_path / "cal.json", "--report", tmp_path / "cal.html")
    message = refused(mwdcal("calibrate", name, *output), 2)
    assert message.endswith("r\\xff.csv': a name must be valid UTF-8. Rename the file.")
    assert len(list(tmp_path.iterdir())) == 1


# Outputs and inputs


def kept(arguments, *paths):
    """A command that refuses to write, in one sentence, and leaves the files as they were."""
    before = [path.read_bytes() for path in paths]
    message = refused(mwdcal(*arguments), 2)
    assert [path.read_bytes() for path in paths] == before
    return message


@pytest.fixture
def folder(files, tmp_path):
    """The inputs, to be overwritten."""
    return Path(shutil.copytree(files, tmp_path / "in", ignore=lambda *_: ["made"]))


def other_names(path):
    """Names of one file: another spelling, a link and a hard link."""
    (path.parent / "soft").symlink_to(path)
    (path.parent / "hard").hardlink_to(path)
    return [path, path.parent / ".." / path.parent.name / path.name, path.parent / "soft",
            path.parent / "hard"]  # fmt: skip


@posix
@pytest.mark.parametrize("name", ["mine.toml", "tool.toml", "prior.json"])
def test_limits_profile_and_prior_are_inputs_under_all_their_names(folder, name):
    shutil.copy(SOURCE / "profiles" / "servo.toml", folder / "tool.toml")
    shutil.copy(folder / "cal.json", folder / "prior.json")
    run = ("calibrate", folder / "run.csv", "--tool", folder / "tool.toml")
    cases = {
        "mine.toml": ("verify", folder / "cal.json", folder / "roll.csv", "--limits",
                      folder / "mine.toml", "--report"),
        "tool.toml": (*run, "-o", folder / "new.json", "--report"),
        "prior.json": (*run, "--prior", folder / "prior.json", "-o"),
    }  # fmt: skip
    for spelling in other_names(folder / name):
        message = kept((*cases[name], spelling), folder / name)
        assert message.endswith("it is an input, which would be lost. Name another file.")
    assert not (folder / "new.json").exists()


def test_every_file_of_a_folder_of_runs_is_an_input(folder):
    runs = folder / "runs" / "day=1"
    runs.mkdir(parents=True)
    run = Path(shutil.copy(folder / "fleet.parquet", runs / "a.parquet"))
    arguments = ("fleet", runs.parent, "-o", folder / "o.parquet", "--tool", "servo", "--report")
    assert "would be lost" in kept((*arguments, run), run)


@pytest.mark.parametrize("second", ["new.json", "NEW.json", "../in/new.json"])
def test_two_outputs_have_two_names(folder, second):
    arguments = ("calibrate", folder / "run.csv", "--tool", "servo", "-o", folder / "new.json")
    assert "it is named twice" in kept((*arguments, "--report", folder / second))
    assert not (folder / "new.json").exists()


@posix
def test_what_is_printed_is_not_replaced(folder):
    listing = folder / "listing.txt"
    for name in ("listing.txt", "/dev/stdout"):
        with listing.open("w") as stream:
            arguments = ("verify", "cal.json", "roll.csv", "--report", name)
            done = process(*arguments, cwd=folder, stdout=stream, stderr=subprocess.PIPE)
        assert done.returncode == 2
        assert f"cannot write '{name}': what the command prints goes there." in done.stderr
        assert listing.read_text() == ""


def test_a_conversion_to_a_file_prints_json_where_json_is_asked_for(folder):
    arguments = ("convert", folder / "cal.json", "--notation", "affine", "-o", folder / "out.json")
    assert mwdcal(*arguments).out == f"wrote {folder / 'out.json'}\n"
    assert mwdcal(*arguments, "--json").json == json.loads((folder / "out.json").read_bytes())


@pytest.mark.usefixtures("without_pictures")
def test_a_report_that_cannot_be_written_leaves_no_calibration(folder, monkeypatch):
    real, replaced = os.fsync, []

    def full(descriptor):
        replaced.append(descriptor)
        if len(replaced) == 2:
            raise OSError(28, "No space left on device")
        real(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    before = sorted(folder.iterdir())
    arguments = ("calibrate", folder / "run.csv", "--tool", "servo", "-o", folder / "new.json")
    assert "No space left" in kept((*arguments, "--report", folder / "new.html"))
    assert sorted(folder.iterdir()) == before


def test_a_message_with_a_serial_of_any_length_stays_short(tmp_path):
    """Its beginning and what to do about it are shown."""
    run = {"serial": ["S1", "A" * 30_000] * 24, **servo_run(1)}
    path = write_csv(tmp_path / "run.csv", run)
    before = time.process_time()
    ran = mwdcal("calibrate", path, "--tool", "servo", "-o", tmp_path / "c.json")
    assert (
        time.process_time() - before < 5
    )  # a search for passwords once took the square of the length
    message = ran.err.strip()
    assert ran.code == 2
    assert message.startswith("mwdcal: run.csv has rows of more than one tool")
    assert "mwdcal fleet" in message
    assert len(message) < 2000
