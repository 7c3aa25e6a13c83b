"""The outside of the command line: exit codes, help, completion, pipes, and calibration files not to be trusted."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import click
import numpy as np
import pytest
from click.shell_completion import ShellComplete
from click.testing import CliRunner

from cli_support import (
    EXAMPLE,
    SCALE,
    calibrated,
    commands,
    mwdcal,
    numbers,
    process,
    read_csv,
    refused,
    servo_run,
    write_csv,
)
from mwdcal.app.cli import cli
from mwdcal.app.commands import Group, options
from mwdcal.errors import InputError
from mwdcal.files import documents
from mwdcal.library.drifts import limits_of
from mwdcal.presentation.plan import wanted_accuracy
from mwdcal.use.correction import OUTSIDE
from schemas import of_calibration_files

PACKAGE = Path(documents.__file__).parents[1]
COMMANDS = sorted({*commands(), *cli.commands})


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A calibration file, readings, and a roll test."""
    folder = tmp_path_factory.mktemp("files")
    calibration = calibrated(folder, servo_run())
    roll = write_csv(folder / "roll.csv", servo_run(seed=1, inclinations=(30,)))
    return calibration, roll


def every_command(calibration, roll, folder):
    """The three commands that read a calibration file."""
    return {
        "apply": ("apply", calibration, roll, "-o", folder / "out.csv"),
        "verify": ("verify", calibration, roll),
        "convert": ("convert", calibration, "--notation", "forward"),
    }


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_an_example(command):
    for option in ("-h", "--help"):
        ran = mwdcal(*command.split(), option)
        assert ran.code == 0
        assert ran.err == ""
        assert f"mwdcal {command} " in ran.out.split("Example", 1)[1]


@pytest.mark.parametrize("words", [(), ("registry",), ("certificate",), ("certificate", "key")])
def test_each_command_is_one_whole_line(words):
    lines = mwdcal(*words, "--help").out.splitlines()
    listed = lines[lines.index("Commands:" if words else "Calibrate:") :]
    rows = [line for line in listed if line.startswith("  ")]
    assert max(map(len, rows)) <= 80
    group = cli
    for word in words:
        group = group.commands[word]
    assert sorted(row.split()[0] for row in rows) == sorted(group.commands)
    assert not [row for row in rows if row.endswith(("...", ",", " a", " the", " of"))]


def test_options_are_grouped():
    shown = mwdcal("calibrate", "--help").out
    parts = re.split(
        r"^(Options|Table options|Fit options|Output options):$", shown, flags=re.MULTILINE
    )
    groups = dict(zip(parts[1::2], parts[2::2], strict=True))
    where = {
        "Options": "--tool",
        "Table options": "--serial",
        "Fit options": "--order",
        "Output options": "--report",
    }
    for title, option in where.items():
        assert [name for name, text in groups.items() if f"  {option} " in text] == [title]


def test_only_options_of_a_fit_are_grouped_as_such():
    shown = mwdcal("reference", "--help").out
    assert "Fit options:" not in shown
    assert shown.index("--model") < shown.index("Table options:")


def test_missing_arguments_are_listed_without_escapes():
    message = mwdcal("list").err
    assert "\\t" not in message
    assert [line.strip(" ,") for line in message.splitlines()[-4:]] == [
        "plans", "profiles", "limits", "methods",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("plan", "--stations", "abc"), "'abc' is not a valid whole number"),
        (("plan", "--stations", "2.5"), "'2.5' is not a valid whole number"),
        (("reference", "--latitude", "abc"), "'abc' is not a valid number"),
        (("bench", "--settle", "abc"), "'abc' is not a valid number"),
    ],
)
def test_a_wrong_number_is_named_in_plain_words(words, reason):
    ran = mwdcal(*words)
    assert ran.code == 2
    assert reason in ran.err


def test_help_and_version_of_the_whole():
    ran = mwdcal("--help")
    assert ran.code == 0
    for command in ("calibrate", "apply", "verify", "convert", "completion"):
        assert f"\n  {command} " in ran.out
    assert mwdcal("--version").out.startswith("mwdcal, version ")


@pytest.mark.parametrize(
    "arguments", [("calibrat",), ("calibrate",), ("--colour",), ("apply", "x")]
)
def test_misused_it_exits_with_2(arguments):
    ran = mwdcal(*arguments)
    assert ran.code == 2
    assert ran.out == ""
    assert ran.err.startswith("Usage: mwdcal")
    assert len(ran.messages) == 1


@pytest.mark.parametrize(
    ("shell", "part"), [("bash", "complete -o"), ("zsh", "compdef"), ("fish", "complete")]
)
def test_completion(shell, part):
    try:
        ran = mwdcal("completion", shell)
    except RuntimeError:
        pytest.skip(f"no {shell} here")
    assert ran.code == 0
    assert part in ran.out
    assert "_MWDCAL_COMPLETE" in ran.out


def test_completion_completes():
    environment = {
        **os.environ,
        "_MWDCAL_COMPLETE": "bash_complete",
        "COMP_WORDS": "mwdcal ca",
        "COMP_CWORD": "1",
    }
    done = process(env=environment)
    assert done.stdout.splitlines() == ["plain,calibrate"]


def test_the_package_runs_as_the_command():
    command = [sys.executable, "-m", "mwdcal", "--version"]
    done = subprocess.run(command, capture_output=True, encoding="utf-8", check=True)
    assert done.stdout == mwdcal("--version").out


def test_help_imports_neither_numpy_nor_scipy():
    script = (
        "import sys\nfrom mwdcal.app.cli import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "heavy = {'numpy', 'scipy', 'matplotlib', 'rich', 'pyarrow', 'openpyxl', 'jinja2',"
        " 'sqlalchemy', 'alembic', 'cryptography', 'typst'}\n"
        "print(sorted(heavy & set(sys.modules)), file=sys.stderr)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, encoding="utf-8", check=True
    )
    assert done.stderr.strip() == "[]"


def test_a_plain_calibration_loads_only_what_it_uses(tmp_path):
    script = (
        "import sys\nfrom mwdcal.app.cli import main\n"
        "try:\n    main(sys.argv[1:])\nexcept SystemExit as end:\n    assert not end.code\n"
        "unused = {'scipy', 'rich.console', 'mwdcal.certificate', 'mwdcal.use.verification',"
        " 'mwdcal.files.formats.workbook', 'mwdcal.files.exchange'}\n"
        "sys.exit(str(sorted(unused & set(sys.modules))))\n"
    )
    run = EXAMPLE / "run.csv"
    command = [sys.executable, "-c", script, "calibrate", str(run), "--tool", "servo"]
    command += ["-o", str(tmp_path / "tool.json")]
    done = subprocess.run(command, capture_output=True, encoding="utf-8", check=False)
    assert done.stderr.splitlines()[-1] == "[]"


@pytest.mark.skipif(os.name == "nt", reason="POSIX pipes")
@pytest.mark.parametrize("reader", ["head -1", "true"])
def test_a_reader_that_leaves_early_sees_no_traceback(files, reader):
    mine = f"'{sys.executable}' -m mwdcal"
    line = f"{mine} convert '{files[0]}' --notation forward --json | {reader}"
    done = subprocess.run(line, shell=True, capture_output=True, encoding="utf-8", check=False)
    assert done.returncode == 0
    assert done.stderr == ""


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_a_full_disk_behind_stdout_is_told(files):
    with open("/dev/full", "w") as full:
        arguments = (sys.executable, "-m", "mwdcal")
        done = subprocess.run(
            [*arguments, "convert", str(files[0]), "--notation", "forward"],
            stdout=full,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            check=False,
        )
    assert done.returncode == 2
    assert done.stderr.startswith("mwdcal: cannot write the result: No space left on device")
    assert done.stderr.count("\n") == 1


def test_a_defect_is_called_one_and_shows_no_traceback(tmp_path, monkeypatch):
    def broken(*arguments):
        raise ZeroDivisionError("oh")

    monkeypatch.setattr(documents, "contents", broken)
    monkeypatch.delenv("MWDCAL_DEBUG", raising=False)
    ran = mwdcal("convert", tmp_path / "c.json", "--notation", "affine")
    assert ran.code == 70
    assert "internal error (ZeroDivisionError: oh)" in ran.err
    assert "Traceback" not in ran.err
    monkeypatch.setenv("MWDCAL_DEBUG", "1")
    with pytest.raises(ZeroDivisionError):
        mwdcal("convert", tmp_path / "c.json", "--notation", "affine")


def test_not_enough_memory_is_told(tmp_path, monkeypatch):
    def big(*arguments):
        raise MemoryError

    monkeypatch.setattr(documents, "contents", big)
    assert "not enough memory" in refused(mwdcal("convert", "c", "--notation", "affine"), 2)


def test_json_of_calibrate_holds_the_numbers_of_the_text(tmp_path):
    run = write_csv(tmp_path / "run.csv", servo_run())
    arguments = ("calibrate", run, "--tool", "servo", "-o", tmp_path / "cal.json")
    said, told = mwdcal(*arguments), mwdcal(*arguments, "--json").json
    lines = [" ".join(s.split()) for s in said.out.splitlines()]
    names = {
        "toolface": "toolface·sin I",
        "azimuth": "azimuth·sin I",
        "gravity": "|g|",
        "field": "|b|",
    }

    for row in told["errors"]:
        places = max(1 - int(f"{row['expected']:.1e}".partition("e")[2]), 0)  # two digits
        cells = [
            f"{row[k]:.{places}f}{'' if row['unit'] == '°' else ' '}{row['unit']}"
            for k in ("before", "after", "expected")
        ]
        assert (
            f"{names.get(row['observable'], row['observable'])} error, rms {' '.join(cells)}"
            in lines
        )
    accuracy = "  ".join(f"{n} {v:.2g}°" for n, v in told["accuracy_1sigma_deg"].items())
    assert f"accuracy to expect (1σ, calibration alone, at 45° inclination): {accuracy}" in said.out
    for name, triad in told["triads"].items():
        assert f"{name} {triad['rank']} of {triad['size']} determined" in said.out
    assert told["calibration"] == str(tmp_path / "cal.json")
    shown = " ".join(said.err.split())
    assert [f["id"] for f in told["findings"]] == ["no-serial"]
    assert all(f"! {finding['text']}" in shown for finding in told["findings"])


@pytest.mark.parametrize("toolface", [True, False])
def test_the_screen_of_a_calibration_ends_with_the_files_and_the_next_command(tmp_path, toolface):
    """A line for each; *undetermined* is explained where it is printed, and a page of the documentation named."""
    columns = servo_run()
    if not toolface:
        del columns["ref_toolface_deg"]
    made = {"calibration": tmp_path / "cal.json", "report": tmp_path / "page.html"}
    run = write_csv(tmp_path / "run.csv", columns)
    outputs = ("-o", made["calibration"], "--report", made["report"])
    lines = mwdcal("calibrate", run, "--tool", "servo", *outputs).out.splitlines()
    files = [f"wrote {path} ({name})" for name, path in made.items()]
    assert lines[-4:] == ["", *files, f"next: mwdcal verify {made['calibration']} ROLLTEST.csv"]
    [*meaning] = [line for line in lines if line.startswith("Undetermined: ")]
    assert len(meaning) == (not toolface)
    for page in re.findall(r"docs/\S+", "".join(meaning)):
        words = (Path(__file__).parents[1] / page).read_text("utf-8")
        assert "\nundetermined\n" in words


def test_json_of_apply_holds_the_numbers_of_the_text(tmp_path, files):
    arguments = ("apply", *files, "-o", tmp_path / "out.csv")
    said, told = mwdcal(*arguments), mwdcal(*arguments, "--json").json
    ranges = "   ".join(
        f"{name} {each['least_deg']:.2f}° to {each['largest_deg']:.2f}°, 1σ at most {each['sd_deg']:#.2g}°"
        for name, each in told["angles"].items()
    )
    assert said.out == (
        f"{told['rows']} rows corrected   wrote {told['output']}\n"
        f"{ranges}\n"
        f"1σ: {', '.join(told['error_terms'])}. Not in it: {', '.join(told['not_included'])}.\n"
    )
    assert said.err == "".join(f"! {f['text']}\n" for f in told["findings"])


def test_json_of_the_order_table(tmp_path):
    run = write_csv(tmp_path / "run.csv", servo_run(temperatures=(0.0, 30.0, 60.0)))
    arguments = ("calibrate", run, "--tool", "servo", "-o", tmp_path / "cal.json")
    said, told = mwdcal(*arguments), mwdcal(*arguments, "--json").json
    for triad in ("accelerometer", "magnetometer"):
        own = [o for o in told["orders"] if o["triad"] == triad]
        assert [o["order"] for o in own] == [0, 1, 2]
        assert sum(o["chosen"] for o in own) == 1
    for score in told["orders"]:
        values = (score["inside"], score["ends"])
        judged = ["–" if value is None else f"{value:.3g}" for value in values]
        assert (judged == ["–", "–"]) == (score["order"] == 2)
        cells = " ".join([score["triad"], str(score["order"]), *judged])
        assert any(" ".join(s.split()).startswith(cells) for s in said.out.splitlines())


# Calibration files


def test_the_published_schema_is_that_of_the_code():
    assert documents.published_schema() == of_calibration_files()


RUNS = {
    "both triads": lambda: (servo_run(), ()),
    "accelerometer alone": lambda: (
        {k: v for k, v in servo_run().items() if not k.startswith("m")},
        (),
    ),
    "order 1": lambda: (servo_run(temperatures=(0.0, 40.0)), ("--order", 1)),
    "polynomial of order 1": lambda: (
        servo_run(temperatures=(0.0, 40.0)),
        ("--order", 1, "--model", "polynomial"),
    ),
    "no temperature": lambda: (
        {k: v for k, v in servo_run().items() if k != "temperature_c"},
        (),
    ),
    "nothing known": lambda: ({k: v for k, v in servo_run().items() if "ref" not in k}, ()),
    "least squares": lambda: (servo_run(), ("--method", "least-squares")),
    "unknown noise": lambda: (servo_run(), ("--tool", "generic")),
    "curved": lambda: (servo_run(toolfaces=24), ("--tool", "distox")),
}


@pytest.mark.parametrize("make", RUNS.values(), ids=RUNS)
def test_every_calibration_file_is_valid(tmp_path, make):
    validator = pytest.importorskip("jsonschema").Draft202012Validator
    run, options = make()
    if "distox" in options:
        scale = dict.fromkeys(("ax", "ay", "az"), 14000 / 3) | dict.fromkeys(
            ("mx", "my", "mz"), 1e7
        )
        own = {"ax": "az", "ay": "ax", "az": "ay", "mx": "mz", "my": "mx", "mz": "my"}
        sign = {"ay": -1, "az": -1, "my": -1, "mz": -1}
        run = {**run, **{k: run[own[k]] * scale[k] * sign.get(k, 1) for k in own}}
    path = calibrated(tmp_path, run, *options)
    validator.check_schema(of_calibration_files())
    validator(documents.published_schema()).validate(json.loads(path.read_bytes()))
    assert documents.encode(documents.read(path)) == path.read_bytes()


def shortened(document):
    document["accelerometer"]["parameters"].pop()


def with_value(*keys, value):
    def change(document):
        entry = document
        for key in keys[:-1]:
            entry = entry[key]
        entry[keys[-1]] = value

    return change


def without(*keys):
    def change(document):
        entry = document
        for key in keys[:-1]:
            entry = entry[key]
        del entry[keys[-1]]

    return change


EDITED = {
    "parameter list shortened": shortened,
    "parameter of no number": with_value("accelerometer", "parameters", 0, value="1,02"),
    "parameter missing": with_value("accelerometer", "parameters", 0, value=None),
    "names shortened": without("magnetometer", "parameter_names", 3),
    "names exchanged": with_value("magnetometer", "parameter_names", 0, value="gain-xy"),
    "uncertainties shortened": without("magnetometer", "standard_uncertainties", 3),
    "covariance shortened": without("covariance", 5),
    "covariance row shortened": without("covariance", 5, 5),
    "covariance one-sided": with_value("covariance", 0, 1, value=1.0),
    "variance negative": with_value("covariance", 3, 3, value=-1.0),
    "free direction of another length": with_value("free", value=[[1.0, 0.0]]),
    "no schema version": without("schema_version"),
    "schema version 0": with_value("schema_version", value=0),
    "schema version 2": with_value("schema_version", value=2),
    "schema version text": with_value("schema_version", value="1"),
    "schema version true": with_value("schema_version", value=True),
    "another model": with_value("accelerometer", "model", value="spline"),
    "factors for polynomial": with_value("accelerometer", "model", value="factors"),
    "another order": with_value("accelerometer", "order", value=1),
    "order negative": with_value("accelerometer", "order", value=-1),
    "order huge": with_value("accelerometer", "order", value=10**9),
    "order beyond 64 bits": with_value("accelerometer", "order", value=10**30),
    "curved": with_value("accelerometer", "curved", value=True),
    "no accelerometer": without("accelerometer"),
    "triads exchanged": with_value("accelerometer", "name", value="magnetometer"),
    "triad of another name": with_value("accelerometer", "name", value="gyro"),
    "no magnetometer": with_value("magnetometer", value=None),
    "radius zero": with_value("accelerometer", "radius", value=0.0),
    "centre shortened": with_value("accelerometer", "centre", value=[0.0]),
    "gains zero": with_value("accelerometer", "parameters", value=[0.0] * 12),
    "gains huge": with_value("accelerometer", "parameters", 4, value=1e300),
    "axes repeated": with_value("profile", "accelerometer", "axes", value=["+x", "+x", "+z"]),
    "axes unknown": with_value("profile", "accelerometer", "axes", value=["+x", "+y", "+w"]),
    "scale zero": with_value("profile", "accelerometer", "scale", value=0.0),
    "scale negative": with_value("profile", "magnetometer", "scale", value=-5e-5),
    "temperatures reversed": with_value("temperature_c", value=[60.0, 20.0]),
    "temperatures of three": with_value("temperature_c", value=[20.0, 30.0, 40.0]),
    "no stations": without("station_rows"),
    "time unknown": with_value("time", value="yesterday"),
    "earth unknown": with_value("earth", value={}),
}


def refused_by_all(folder, calibration, roll):
    for name, arguments in every_command(calibration, roll, folder).items():
        message = refused(mwdcal(*arguments), 2)
        assert calibration.name in message, name
    assert not (folder / "out.csv").exists()


@pytest.mark.parametrize("change", EDITED.values(), ids=EDITED)
def test_an_edited_calibration_file_is_refused(tmp_path, files, change):
    document = json.loads(files[0].read_bytes())
    change(document)
    path = tmp_path / "edited.json"
    path.write_text(json.dumps(document))
    refused_by_all(tmp_path, path, files[1])


CONTENTS = {
    "empty": lambda data: b"",
    "truncated": lambda data: data[: len(data) // 2],
    "without its last brace": lambda data: data.rstrip()[:-1],
    "followed by more": lambda data: data + b"{}",
    "a list": lambda data: b"[" + data + b"]",
    "a number": lambda data: b"1",
    "null": lambda data: b"null",
    "an empty object": lambda data: b"{}",
    "no JSON": lambda data: b"schema_version = 1\n",
    "binary": lambda data: bytes(range(256)),
    "UTF-16": lambda data: data.decode().encode("utf-16"),
    "Latin-1": lambda data: data.replace(b'"run": "', b'"run": "\xe9'),
    "NaN": lambda data: data.replace(b'"parameters": [', b'"parameters": [NaN,', 1),
    "1e999": lambda data: data.replace(b'"parameters": [', b'"parameters": [1e999,', 1),
    "deep": lambda data: b"[" * 100_000,
    "a run": lambda data: (EXAMPLE / "run.csv").read_bytes(),
}


@pytest.mark.parametrize("content", CONTENTS.values(), ids=CONTENTS)
def test_a_damaged_calibration_file_is_refused(tmp_path, files, content):
    path = tmp_path / "damaged.json"
    path.write_bytes(content(files[0].read_bytes()))
    refused_by_all(tmp_path, path, files[1])


def test_a_calibration_that_is_not_there(tmp_path, files):
    for path in (tmp_path / "missing.json", tmp_path):
        refused_by_all(tmp_path, path, files[1])


def leaves(value, path=()):
    """Every place in a document where a value stands, long lists by their first entry only."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from leaves(item, (*path, key))
    elif isinstance(value, list) and value:
        yield path
        yield from leaves(value[0], (*path, 0))
    else:
        yield path


VALUES = [None, 0, -1e300, 1e300, "", [], {}]


@pytest.mark.slow
@pytest.mark.parametrize("every", [7, pytest.param(1, marks=pytest.mark.study)])
@pytest.mark.parametrize("value", VALUES, ids=repr)
def test_whatever_stands_in_a_calibration_file_there_is_no_internal_error(
    tmp_path, files, value, every
):
    """Each value in every seventh place: the next value begins one place later, so all places are met."""
    text = files[0].read_text("utf-8")
    path = tmp_path / "edited.json"
    for place in list(leaves(json.loads(text)))[VALUES.index(value) % every :: every]:
        document = json.loads(text)
        with_value(*place, value=value)(document)
        path.write_text(json.dumps(document))
        for arguments in every_command(path, files[1], tmp_path).values():
            ran = mwdcal(*arguments)
            assert ran.code in (0, 1, 2), (place, ran)
            assert ran.code != 2 or len(ran.messages) == 1, (place, ran)


def test_12_digits_are_enough_to_give_the_same_corrections(tmp_path, files):
    """The file says what was fitted: its parameters by the documented formula are what `apply` gives."""
    document = json.loads(files[0].read_bytes())
    found = tmp_path / "out.csv"
    assert mwdcal("apply", *files, "-o", found, "--json").code == 0
    table = read_csv(found)
    for index, (name, raw, field) in enumerate(
        [
            ("accelerometer", ("ax", "ay", "az"), ("gx_g", "gy_g", "gz_g")),
            ("magnetometer", ("mx", "my", "mz"), ("bx_nt", "by_nt", "bz_nt")),
        ]
    ):
        parameters = np.array(document[name]["parameters"])
        x = np.stack([numbers(table[n]) for n in raw], -1) / SCALE[index]
        wanted = x @ parameters[:9].reshape(3, 3).T + parameters[9:]
        got = np.stack([numbers(table[n]) for n in field], -1)
        np.testing.assert_allclose(got, wanted, rtol=1e-12, atol=1e-12 * np.abs(wanted).max())


@pytest.mark.parametrize("word", ['simulated = "yes"', "simulated = true", "simulated = false"])
def test_screens_say_what_is_simulated(tmp_path, word):
    """Of calibration and roll test: also where only one of them is."""
    said = not word.endswith("false")
    made, test = servo_run(1), servo_run(1, inclinations=(45,))
    run = write_csv(tmp_path / "run.csv", made, word)
    calibrate = ("calibrate", run, "--tool", "servo", "-o", tmp_path / "cal.json")
    apply = ("apply", tmp_path / "cal.json", run, "-o", tmp_path / "out.csv")
    for metadata, expected in (([], said), (["simulated = 1"], True)):
        roll = write_csv(tmp_path / "roll.csv", test, *metadata)
        ran = mwdcal(*calibrate)
        assert ("SIMULATED DATA" in ran.out.splitlines()[0]) == said
        ran = mwdcal("verify", tmp_path / "cal.json", roll)
        assert ("SIMULATED DATA" in ran.out.splitlines()[0]) == expected
        assert ran.out.count("SIMULATED DATA") == expected
        assert ("SIMULATED DATA" in mwdcal(*apply).out) == said


def test_a_wrong_word_for_outside_is_refused(tmp_path, files):
    ran = mwdcal("apply", *files, "-o", tmp_path / "out.csv", "--outside", "clip")
    assert "--outside must be one of blank, refuse, extrapolate; got 'clip'" in refused(ran, 2)
    words = "|".join(OUTSIDE)
    assert words in mwdcal("apply", "--help").out


@pytest.mark.usefixtures("without_pictures")
def test_excluded_stations_are_named_wherever_the_calibration_is(tmp_path):
    """In the file, in JSON, on the screen and in the report; the run's other stations are fitted."""
    run = write_csv(tmp_path / "run.csv", servo_run())
    made, page = tmp_path / "cal.json", tmp_path / "cal.html"
    options = ("--exclude", "30", "--exclude", "7", "-o", made)
    ran = mwdcal("calibrate", run, "--tool", "servo", *options, "--report", page)
    assert ran.code == 0, ran.err
    assert "station 7, 30" in ran.out
    record = json.loads(made.read_bytes())
    assert record["excluded"] == ["7", "30"]
    assert record["stations"] == 46
    assert "<dt>Excluded</dt><dd>7, 30</dd>" in page.read_text("utf-8")
    shown = mwdcal("calibrate", run, "--tool", "servo", *options, "--json").json
    assert shown["excluded"] == ["7", "30"]
    whole = mwdcal("calibrate", run, "--tool", "servo", "-o", made)
    assert "left out" not in whole.out
    assert json.loads(made.read_bytes())["excluded"] == []


@pytest.mark.usefixtures("without_pictures")
def test_copies_are_named_like_excluded_stations_and_may_not_verify(tmp_path):
    """Also copies with a digit that differs."""
    whole = servo_run()
    columns = {name: np.append(v, np.asarray(v)[12:24]) for name, v in whole.items()}
    columns["ax"][48:] += 1e-9
    run, made, page = (
        write_csv(tmp_path / "run.csv", columns),
        tmp_path / "c.json",
        tmp_path / "c.html",
    )
    options = ("--tool", "servo", "--exclude", "7", "-o", made, "--report", page)
    ran = mwdcal("calibrate", run, *options)
    left = ", ".join(["7", *(f"{row - 36} (row {row})" for row in range(49, 61))])
    assert f"left out of the fit: station {left}" in ran.out
    assert "12 of 59 stations are copies of others" in ran.err
    assert "! station 13 (row 49), 14 (row 50), " in ran.err
    assert f"<dt>Excluded</dt><dd>{left}</dd>" in page.read_text("utf-8")
    assert json.loads(made.read_bytes())["stations"] == 47
    test = write_csv(tmp_path / "roll.csv", {name: v[48:] for name, v in columns.items()})
    assert mwdcal("verify", made, test).code == 2


def test_excluded_stations_may_verify_the_calibration(tmp_path):
    """They had no part in the fit; those that had are refused."""
    columns = servo_run()
    run = write_csv(tmp_path / "run.csv", columns)
    made = tmp_path / "cal.json"
    options = [f"--exclude={label}" for label in range(13, 25)]
    assert mwdcal("calibrate", run, "--tool", "servo", *options, "-o", made).code == 0
    own = np.arange(48)
    for rows, codes in ((own[12:24], (0, 1)), (own[11:24], (2,))):
        part = {name: np.asarray(values)[rows] for name, values in columns.items()}
        test = write_csv(tmp_path / "roll.csv", part)
        assert mwdcal("verify", made, test).code in codes


# Options by name


@options.command()
@click.option("--sampling-hz", type=float)
@click.option("--from", "start")
@click.argument("log")
def failing(sampling_hz, start, log):
    raise InputError("`sampling_hz` and `start` of `log`; see `# key = value`, `order` and -o.")


def test_a_wrong_value_of_any_length_stays_short():
    """What a message repeats of a value that nobody can have meant is cut."""
    done = mwdcal("registry", "drift", "tools.sqlite", "--date", "x" * 5_000)
    assert done.code == 2
    assert "--date" in done.err
    assert "such as 2026-11-28" in done.err
    assert len(done.err) < 1_000


@pytest.mark.parametrize(
    ("option", "line"),
    [("--declination", "# declination_deg = "), ("--declination-deg", "# declination_deg = "),
     ("--ref-field-nt", "# ref_field_nt = "), ("--dip", "# ref_dip_deg = "), ("--stationn", "")],
)  # fmt: skip
def test_an_option_for_what_a_table_states_says_where_it_goes(option, line):
    done = mwdcal("survey", "tool.json", "well.csv", "-o", "out.csv", option, "2.4")
    assert done.code == 2
    assert f"No such option '{option}'" in done.err
    assert ("a line above the table" in done.err) == bool(line)
    assert line in done.err
    assert ("Did you mean '--station'?" in done.err) != bool(line)


@pytest.mark.parametrize(
    ("typed", "said"),
    [("calibrate run.csv --sheet X", "mwdcal profile TABLE --sheet … -o TOOL.toml"),
     ("verify cal.json run.csv --msa", "It is an option of mwdcal survey."),
     ("plan --replace", "mwdcal init, mwdcal profile, mwdcal certificate sign."),
     ("survey cal.json run.csv --limit x", "Did you mean '--limits'?")],
)  # fmt: skip
def test_an_option_of_another_command_is_named_with_that_command(typed, said):
    done = mwdcal(*typed.split())
    assert done.code == 2
    assert said in done.err


def test_errors_name_options_as_they_are_typed():
    with pytest.raises(InputError) as refusal:
        failing.main(["run.csv"], standalone_mode=False)
    wanted = "--sampling-hz and --from of `log`; see `# key = value`, `order` and -o."
    assert str(refusal.value) == wanted


def test_a_command_imports_no_other_command():
    script = (
        "import sys\nfrom mwdcal.app.cli import main\n"
        "try:\n    main(['verify', '--help'])\nexcept SystemExit:\n    pass\n"
        "names = {n.removeprefix('mwdcal.app.commands.') for n in sys.modules}\n"
        f"print(sorted(names & set({COMMANDS})), 'numpy' in sys.modules, file=sys.stderr)\n"
    )
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, encoding="utf-8", check=True)
    assert done.stderr.strip() == "['verify'] False"


# Commands with subcommands


def echoing(name):
    parameters = [click.Argument(["words"], nargs=-1), click.Option(["-o"])]
    return click.Command(name, params=parameters, callback=lambda words, o: click.echo(name))


@click.group(cls=Group, default="issue", commands={n: echoing(n) for n in ("issue", "sign")})
def grouped():
    """A group whose default is `issue`."""


@pytest.mark.parametrize(
    ("typed", "called"),
    [
        ("cal.json -o c.pdf", "issue"),
        ("-o c.pdf cal.json", "issue"),
        ("issue sign", "issue"),
        ("./sign", "issue"),
        ("", "issue"),
        ("sign cal.json", "sign"),
    ],
)
def test_a_first_word_that_is_no_subcommand_belongs_to_the_default(typed, called):
    assert CliRunner().invoke(grouped, typed).output == f"{called}\n"


def test_a_misspelt_subcommand_is_no_file_of_the_default(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ran = CliRunner().invoke(grouped, "sing")
    assert ran.exit_code == 2
    assert "Did you mean sign" in ran.output
    (tmp_path / "sing").touch()
    assert CliRunner().invoke(grouped, "sing").output == "issue\n"


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("certificate ", ["issue", ""]),
        ("certificate --o", ["--output"]),
        ("certificate c.json --o", ["--output"]),
    ],
)
def test_completion_in_a_group_offers_its_commands_and_what_the_default_takes(typed, offered):
    *words, incomplete = typed.split(" ")
    items = ShellComplete(cli, {}, "mwdcal", "").get_completions(words, incomplete)
    assert {*offered} <= {item.value for item in items}


OLD_NAMES = {
    "plan": {"--html": "--report"},
    "survey": {"--html": "--report"},
    "registry": {"--database": "--registry"},
    "registry list": {"--database": "--registry"},
    "registry drift": {"--html": "--report", "--today": "--date", "--database": "--registry"},
    "certificate sign": {"--key": "--private-key"},
}
"""Names of options before they were unified, by command."""


@pytest.mark.parametrize("command", OLD_NAMES)
def test_old_names_of_options_are_taken_and_hidden(command):
    found = {**commands(), **cli.commands}[command]
    shown = mwdcal(*command.split(), "--help").out
    for old, new in OLD_NAMES[command].items():
        context = click.Context(found)
        parser = found.make_parser(context)
        values = [parser.parse_args([name, "x.file"])[0] for name in (old, new)]
        assert values[0] == values[1] != {}
        assert new in shown
        assert not re.search(rf"{old}\b", shown)
        assert old not in [item.value for item in found.shell_complete(context, "--")]


def test_a_hidden_page_of_the_analysis_stays_for_one_release():
    option = next(o for o in commands()["survey"].params if o.name == "msa_html")
    assert option.hidden


def test_angles_of_limits_and_accuracies_have_their_unit_in_their_name():
    for typed, read in ((wanted_accuracy, {"azimuth": 0.1}), (limits_of, {"azimuth": 0.1})):
        assert typed(["azimuth_deg=0.1"]) == typed(["azimuth=0.1"]) == read


@pytest.mark.parametrize(
    ("line", "kind", "beside"),
    [
        ("calibrate run.csv --tool", "profiles", "generic"),
        ("verify tool.json run.csv --limits", "limits", "roll-test"),
        ("survey tool.json run.csv --limits", "survey_limits", "owsg-mwd"),
        ("plan --plan", "plans", "moosavi-12"),
        ("list", "", "methods"),
    ],
)
def test_completion_offers_what_is_built_in(line, kind, beside):
    first, *rest = line.split()
    items = ShellComplete(cli, {}, "mwdcal", "_MWDCAL_COMPLETE").get_completions([first, *rest], "")
    offered = {item.value for item in items if item.type == "plain"}
    assert beside in offered
    if kind:
        assert {file.stem for file in (PACKAGE / kind).glob("*.toml")} == offered
