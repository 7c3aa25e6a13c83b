"""Documents for machines: envelope, digests, and the published schemas over many kinds of inputs."""

import hashlib
import json

import numpy as np
import pytest

from cli_support import EXAMPLE, calibrated, commands, mwdcal, servo_run, write_csv
from mwdcal.files import documents
from mwdcal.presentation.envelope import INPUTS
from schemas import CONTENTS, of_command
from test_allan import static
from test_fleet import write_fleet
from test_stations import multi_rate

jsonschema = pytest.importorskip("jsonschema")
pq = pytest.importorskip("pyarrow.parquet")
pytestmark = pytest.mark.usefixtures("without_pictures")

IDENTITY = ("serial = 'MWD-7'", "simulated = true")
HEAD = ("schema_version", "command", "software", "serial", "simulated")


def sha256(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def checked(command, document):
    """The document, valid by the schema as shipped, which refuses one key more or less."""
    schema = documents.published_schema(command)
    validator = jsonschema.Draft202012Validator(schema)
    validator.validate(document)
    assert not validator.is_valid({**document, "undeclared": 1})
    for name in (*HEAD, *(f"{name}_sha256" for name in INPUTS[command])):
        assert not validator.is_valid({k: v for k, v in document.items() if k != name})
    assert (document["schema_version"], document["command"]) == (1, command)
    return document


def shown(command, *arguments, code=0):
    """The document that a command prints, checked."""
    ran = mwdcal(command, *arguments, "--json")
    assert ran.code == code, ran
    return checked(command, ran.json)


def without(run, *prefixes):
    return {name: cells for name, cells in run.items() if not name.startswith(prefixes)}


def moved(run, station=5):
    """A run with one station that moved before it settled."""
    ax = np.array(run["ax"])
    ax[station] += 0.02
    return {**run, "ax": ax}


RUNS = {
    "order 0": lambda: (servo_run(), ()),
    "thermal": lambda: (servo_run(temperatures=(0.0, 30.0, 60.0)), ()),
    "polynomial of order 1": lambda: (
        servo_run(temperatures=(0.0, 40.0)),
        ("--order", 1, "--model", "polynomial"),
    ),
    "accelerometer alone": lambda: (without(servo_run(), "m"), ()),
    "no temperature": lambda: (without(servo_run(), "temperature"), ()),
    "nothing known": lambda: (without(servo_run(), "ref"), ()),
    "relative field": lambda: (without(servo_run(), "ref_field"), ()),
    "unknown noise": lambda: (servo_run(), ("--tool", "generic")),
    "moved station": lambda: (moved(servo_run()), ("--robust", "student-t")),
    "station left out": lambda: (servo_run(), ("--exclude", "3", "--method", "swarm")),
    "errors of the stand": lambda: (servo_run(), ("--estimate", "azimuth-zero,tilt")),
    "unused column": lambda: ({**servo_run(), "gamma": np.ones(48)}, ()),
}
RUN = pytest.mark.parametrize("make", RUNS.values(), ids=RUNS)


def test_every_command_with_json_has_a_schema():
    with_json = {
        name
        for name, command in commands().items()
        if any(parameter.name == "as_json" for parameter in command.params)
    }
    assert with_json == set(CONTENTS) == set(INPUTS)


@pytest.mark.parametrize("command", CONTENTS)
def test_the_published_schemas_are_those_of_the_code(command):
    schema = of_command(command)
    jsonschema.Draft202012Validator.check_schema(schema)
    assert documents.published_schema(command) == schema


@RUN
def test_calibrate_and_what_is_done_with_a_calibration(tmp_path, make):
    columns, options = make()
    run = write_csv(tmp_path / "run.csv", columns, *IDENTITY)
    options = options if "--tool" in options else ("--tool", "servo", *options)
    made = tmp_path / "cal.json"
    document = shown("calibrate", run, *options, "-o", made, "--report", tmp_path / "r.html")
    facts = {key: document[key] for key in ("serial", "simulated", "run_sha256", "prior_sha256")}
    assert facts == {
        "serial": "MWD-7", "simulated": True, "run_sha256": sha256(run), "prior_sha256": None
    }  # fmt: skip
    record = json.loads(made.read_bytes())
    same = (*HEAD, "run_sha256", "profile_sha256", "prior_sha256")
    assert {k: record.get(k) for k in same} == {k: document[k] for k in same}
    assert None not in [record[k] for k in same if k in record]
    jsonschema.Draft202012Validator(documents.published_schema()).validate(record)
    converted = [
        shown("convert", made, "--notation", notation, "--temperature", "20")
        for notation in ("forward", "affine")
        if "curved" not in options
    ]
    for each in converted:
        assert (each["serial"], each["simulated"]) == ("MWD-7", True)
        assert (each["calibration_sha256"], each["run_sha256"]) == (sha256(made), sha256(run))
    out = shown("apply", made, run, "-o", tmp_path / "out.csv")
    digests = (out["calibration_sha256"], out["readings_sha256"])
    assert (out["serial"], out["simulated"], *digests) == ("MWD-7", True, sha256(made), sha256(run))


def test_the_software_is_the_one_that_ran(tmp_path):
    version = mwdcal("--version").out.split()[-1]
    made = calibrated(tmp_path, servo_run())
    old = json.loads(made.read_bytes()) | {"software": "mwdcal 0.0.1"}
    made.write_text(json.dumps(old), encoding="utf-8")
    document = shown("convert", made, "--notation", "affine")
    assert (document["software"], document["converted_by"]) == ("mwdcal 0.0.1", f"mwdcal {version}")
    assert shown("apply", made, tmp_path / "run.csv", "-o", tmp_path / "o.csv")["software"] == (
        f"mwdcal {version}"
    )


def test_convert_writes_the_document_that_it_prints(tmp_path):
    thermal = servo_run(temperatures=(0.0, 40.0))
    for options in (("--model", "factors"), ("--model", "polynomial")):
        made = calibrated(tmp_path, thermal, "--order", 1, *options)
        notation = "forward" if "factors" in options else "affine"
        arguments = (made, "--notation", notation, "--temperature", "course")
        document = shown("convert", *arguments, "-o", tmp_path / "c.json")
        assert checked("convert", json.loads((tmp_path / "c.json").read_bytes())) == document
        assert document["powers_of"] == "T - reference_temperature_c"
    made = calibrated(tmp_path, thermal, "--order", 1)
    assert shown("convert", made, "--notation", "factors")["serial"] is None


def test_profile_and_prior_are_traced(tmp_path):
    tool = EXAMPLE / "tool.toml"
    first = calibrated(tmp_path, servo_run(1), tool=tool)
    again = write_csv(tmp_path / "again.csv", servo_run(1, inclinations=(10, 50, 95, 140)))
    arguments = (again, "--tool", tool, "-o", tmp_path / "new.json")
    document = shown("calibrate", *arguments, "--prior", first)
    assert document["profile_sha256"] == sha256(tool)
    assert document["prior_sha256"] == sha256(first)
    assert json.loads((tmp_path / "new.json").read_bytes())["prior_sha256"] == sha256(first)
    assert (document["serial"], document["simulated"]) == (None, False)
    assert shown("calibrate", *arguments)["prior_sha256"] is None


def test_a_simulated_prior_makes_the_calibration_simulated_and_all_that_rests_on_it(tmp_path):
    first = write_csv(tmp_path / "first.csv", servo_run(1), "simulated = true")
    assert mwdcal("calibrate", first, "--tool", "servo", "-o", tmp_path / "first.json").code == 0
    again = servo_run(1, inclinations=(10, 50, 95, 140))
    run = write_csv(tmp_path / "again.csv", again, "simulated = false")
    made, out = tmp_path / "new.json", tmp_path / "out.csv"
    arguments = (run, "--tool", "servo", "-o", made)
    assert shown("calibrate", *arguments)["simulated"] is False
    assert shown("calibrate", *arguments, "--prior", tmp_path / "first.json")["simulated"] is True
    assert "SIMULATED DATA" in mwdcal("convert", made, "--notation", "affine").out
    assert shown("apply", made, run, "-o", out)["simulated"] is True
    assert "# simulated = true" in out.read_text("utf-8")


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_simulated_readings_or_calibration_mark_the_corrected_table(tmp_path, suffix):
    run = write_csv(tmp_path / "run.csv", servo_run(1), "serial = 'A'")
    marked = write_csv(tmp_path / "marked.csv", servo_run(1), *IDENTITY)
    cals = []
    for source in (run, marked):
        cals.append(tmp_path / f"{source.stem}.json")
        assert mwdcal("calibrate", source, "--tool", "servo", "-o", cals[-1]).code == 0
    readings = without(servo_run(1), "ref")
    plain = tmp_path / f"log{suffix}"
    simulated = tmp_path / f"simulated{suffix}"
    if suffix == ".csv":
        write_csv(plain, readings)
        write_csv(simulated, readings, "simulated = true")
    else:
        one = {"x": without(readings, "station")}
        write_fleet(plain, one)
        write_fleet(simulated, one, {"simulated": True})
    for cal, source, expected in (
        (cals[0], plain, False),
        (cals[1], plain, True),
        (cals[0], simulated, True),
    ):
        out = tmp_path / f"out{suffix}"
        document = shown("apply", cal, source, "-o", out)
        assert document["simulated"] is expected
        assert document["serial"] == ("MWD-7" if cal == cals[1] else "A")
        assert document["calibration_sha256"] == sha256(cal)
        assert document["readings_sha256"] == (sha256(source) if suffix == ".csv" else None)
        if suffix == ".parquet":
            stated = json.loads(pq.read_schema(out).metadata[b"mwdcal"])
        else:
            stated = {"simulated": "# simulated = true" in out.read_text("utf-8")}
        assert stated.get("simulated", False) is expected


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_without_a_serial_of_the_calibration_that_of_the_readings_is_stated(tmp_path, suffix):
    made, readings = calibrated(tmp_path, servo_run(1)), without(servo_run(1), "ref", "station")
    table = tmp_path / f"log{suffix}"
    if suffix == ".csv":
        write_csv(table, {"serial": ["MWD-9"] * 48, **readings})
    else:
        write_fleet(table, {"MWD-9": readings})
    assert shown("apply", made, table, "-o", tmp_path / f"out{suffix}")["serial"] == "MWD-9"


@pytest.mark.parametrize(("stated", "serial"), [("0", "0"), ('""', None), ("17", "17")])
def test_a_serial_may_be_a_number_or_blank(tmp_path, stated, serial):
    run = write_csv(tmp_path / "run.csv", servo_run(1), f"serial = {stated}")
    arguments = (run, "--tool", "servo", "-o", tmp_path / "cal.json")
    assert shown("calibrate", *arguments)["serial"] == serial
    record = json.loads((tmp_path / "cal.json").read_bytes())
    assert record.get("serial") == serial
    assert ("serial" in record) is (serial is not None)


@pytest.mark.parametrize("moved_by", [0.0, 0.02])
def test_verify(tmp_path, moved_by):
    made = calibrated(tmp_path, servo_run(1))
    roll = servo_run(1, inclinations=(30, 60))
    roll["ax"] = roll["ax"] + moved_by
    test = write_csv(tmp_path / "roll.csv", roll, *IDENTITY)
    document = shown("verify", made, test, code=1 if moved_by else 0)
    assert document["passed"] == (not moved_by)
    assert (document["serial"], document["simulated"]) == ("MWD-7", True)
    assert document["calibration_sha256"] == sha256(made)
    assert document["run_sha256"] == sha256(test)
    limits = tmp_path / "mine.toml"
    limits.write_text('name = "mine"\n[error]\ninclination_deg = 5.0\n', encoding="utf-8")
    report = ("--report", tmp_path / "v.html")
    document = shown("verify", made, test, "--limits", limits, *report)
    assert document["limits_sha256"] == sha256(limits)


def test_a_refusal_prints_no_document(tmp_path):
    made = calibrated(tmp_path, servo_run(1))
    ran = mwdcal("verify", made, tmp_path / "run.csv", "--json")  # stations of the fit
    assert (ran.code, ran.out) == (2, "")


@pytest.mark.parametrize("name", ["accelerometer alone", "moved station"])
def test_compare(tmp_path, name):
    run = write_csv(tmp_path / "run.csv", RUNS[name]()[0], *IDENTITY)
    tool = EXAMPLE / "tool.toml"
    document = shown("compare", run, "--tool", tool, "--report", tmp_path / "c.html")
    assert (document["serial"], document["simulated"]) == ("MWD-7", True)
    assert document["run_sha256"] == sha256(run)
    assert document["profile_sha256"] == sha256(tool)


def test_compare_with_every_method_refused(tmp_path):
    few = {name: cells[:3] for name, cells in servo_run().items()}
    run = write_csv(tmp_path / "run.csv", few)
    document = shown("compare", run, "--tool", "servo", code=3)
    assert all(row["refused"] for row in document["rows"])


def test_profile(tmp_path):
    for name, columns in (("both", servo_run()), ("alone", without(servo_run(), "m"))):
        run = write_csv(tmp_path / f"{name}.csv", columns, *IDENTITY)
        document = shown("profile", run, "-o", tmp_path / f"{name}.toml")
        assert (document["serial"], document["simulated"]) == ("MWD-7", True)
        assert document["run_sha256"] == sha256(run)
        assert document["profile"] == str(tmp_path / f"{name}.toml")


def test_profile_of_an_export(tmp_path):
    export = tmp_path / "export.csv"
    write_csv(export, servo_run(), delimiter=";")
    export.write_bytes(export.read_text("utf-8").replace(".", ",").encode("utf-16"))
    document = shown("profile", export, "-o", tmp_path / "tool.toml")
    assert document["run_sha256"] == sha256(export)
    assert document["table"]["encoding"] == "utf-16"
    assert (document["serial"], document["simulated"]) == (None, False)


@pytest.mark.parametrize("options", [(), ("--tool", "servo"), ("--modified",)])
def test_noise(tmp_path, options):
    log = write_csv(tmp_path / "log.csv", static(), "sampling_hz = 50", *IDENTITY)
    picture = ("--plot", tmp_path / "n.svg", "--report", tmp_path / "n.html")
    document = shown("noise", log, *options, *picture)
    assert (document["serial"], document["simulated"]) == ("MWD-7", True)
    assert document["log_sha256"] == sha256(log)
    assert (document["profile_sha256"] is None) == ("--tool" not in options)


def test_noise_of_channels_that_do_not_hold(tmp_path):
    columns = static(900)
    columns["ax"][400:] += 0.5
    columns["my"][:] = 0.0
    log = write_csv(tmp_path / "log.csv", columns, "sampling_hz = 50")
    document = shown("noise", log)
    assert document["findings"]
    assert document["serial"] is None


def test_stations(tmp_path):
    log = write_csv(tmp_path / "log.csv", multi_rate()[0].columns, *IDENTITY)
    out, plot = tmp_path / "run.csv", tmp_path / "log.svg"
    document = shown("stations", log, "-o", out, "--plot", plot)
    assert (document["serial"], document["simulated"]) == ("MWD-7", True)
    assert document["log_sha256"] == sha256(log)
    assert f'log_sha256 = "{sha256(log)}"' in out.read_text("utf-8")
    shown("stations", log, "-o", out, "--threshold", 25)


def test_fleet_and_the_metadata_of_its_table(tmp_path):
    tool = EXAMPLE / "tool.toml"
    sound, bad = servo_run(1), {name: cells[:3] for name, cells in servo_run(2).items()}
    stated = {"serial": "none of these", "simulated": True, "lab": "north"}
    runs = {"A": sound, "few": bad, "B": {**moved(servo_run(3)), "gamma": np.ones(48)}}
    path = write_fleet(tmp_path / "runs.parquet", runs, stated)
    out = tmp_path / "cals.parquet"
    given = ("--tool", tool, "--workers", 1)
    document = shown("fleet", path, "-o", out, *given, "--report", tmp_path / "f.html")
    assert (document["serial"], document["simulated"]) == (None, True)
    assert document["profile_sha256"] == sha256(tool)
    assert document["runs_sha256"] is None
    assert document["calibrated"] == 2
    metadata = json.loads(pq.read_schema(out).metadata[b"mwdcal"])
    same = (*HEAD, *(f"{name}_sha256" for name in INPUTS["fleet"]), "options")
    assert {k: metadata[k] for k in same} == {k: document[k] for k in same}
    assert (metadata["lab"], metadata["fleet"]) == ("north", "runs.parquet")
    options = ("--order", "auto", "--nonlinearity", "auto", "--estimate", "tilt")
    shown("fleet", path, "-o", out, *given, *options)


def test_a_fleet_without_a_sound_tool(tmp_path):
    bad = {name: cells[:3] for name, cells in servo_run(2).items()}
    path = write_fleet(tmp_path / "runs.parquet", {"few": bad})
    document = shown(
        "fleet", path, "-o", tmp_path / "o.parquet", "--tool", "servo", "--workers", 1, code=3
    )
    assert (document["simulated"], document["calibrated"]) == (False, 0)


def test_the_example(tmp_path):
    document = shown("example", tmp_path / "new")
    assert document["simulated"] is True
    assert len(document["files"]) == len(list((tmp_path / "new").iterdir()))


@pytest.mark.parametrize("form", ["c-header", "fixed-point"])
def test_sources_for_firmware(tmp_path, form):
    cal = calibrated(tmp_path, servo_run())
    document = shown("convert", cal, "--to", form, "-o", tmp_path / "out")
    assert document["to"] == form
    assert document["calibration_sha256"] == hashlib.sha256(cal.read_bytes()).hexdigest()


@pytest.mark.parametrize(
    "options",
    [
        ("--plan", "six-state", "--plan", "laboratory-thermal"),
        ("--plan", "moosavi-12", "--method", "scalar"),
        ("--stations", 8, "--criterion", "D"),
    ],
)
def test_plans(tmp_path, options):
    sheets = ("-o", tmp_path / "plan.csv", "--report", tmp_path / "plan.html")
    document = shown("plan", *options, "--tool", EXAMPLE / "tool.toml", *sheets)
    assert (document["serial"], document["simulated"]) == (None, True)
    assert document["profile_sha256"] == sha256(EXAMPLE / "tool.toml")
    assert document["measured_sha256"] is None
    more = ("--measured", tmp_path / "plan.csv", "--tool", EXAMPLE / "tool.toml")
    assert shown("plan", *more)["measured_sha256"] == sha256(tmp_path / "plan.csv")
