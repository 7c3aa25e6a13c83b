"""Ugly runs through `mwdcal calibrate`: one clear refusal, no file; or a result that says what it lacks."""

import re
import time

import numpy as np
import pytest

from cli_support import RAW, mwdcal, refused, servo_run, write_csv

HEADER = ",".join(servo_run())
FIRST = HEADER + "\n" + ",".join("1" for _ in HEADER.split(",")) + "\n"
THREE = (0.0, 30.0, 60.0)


def calibrate(folder, run, *options, tool="servo"):
    return mwdcal("calibrate", run, "-o", folder / "cal.json", "--tool", tool, *options)


def left(folder):
    """Names of the files in a folder but for what the test put there."""
    return {f.name for f in folder.iterdir()} - {"run.csv", "tool.toml", "folder"}


def ran(folder, columns, *options, tool="servo"):
    return calibrate(folder, write_csv(folder / "run.csv", columns), *options, tool=tool)


UNREADABLE = {
    "empty": b"",
    "only the header": HEADER.encode(),
    "binary": bytes(range(256)) * 50,
    "picture": b"\x89PNG\r\n\x1a\n" + bytes(200),
    "UTF-16": FIRST.encode("utf-16"),
    "Latin-1": FIRST.replace("1", "25 \N{DEGREE SIGN}", 1).encode("latin-1"),
    "NUL": FIRST.replace("1", "\0", 1).encode(),
    "ragged": FIRST.encode() + b"1,2,3\n",
    "decimal commas": FIRST.replace(",", ";").replace("1;", "1,5;").encode(),
    "3 million columns": b"a," * 3_000_000 + b"a\n",
    "3 million cells": FIRST.encode() + b"1," * 3_000_000 + b"1\n",
    "duplicate header": FIRST.replace("ay", "ax").encode(),
    "no az": FIRST.replace("az", "q").encode(),
    "newline in a label": FIRST.encode() + FIRST.splitlines()[1].replace("1", '"a\nb"', 1).encode(),
}


@pytest.mark.parametrize("content", UNREADABLE.values(), ids=UNREADABLE)
def test_unreadable_files(tmp_path, content):
    (tmp_path / "run.csv").write_bytes(content)
    start = time.process_time()
    assert "run.csv" in refused(calibrate(tmp_path, tmp_path / "run.csv"), 2)
    assert time.process_time() - start < 5
    assert not left(tmp_path)


CELLS = [
    ("ax", "nan"),
    ("mz", "inf"),
    ("ay", "1e308"),
    ("ay", "1e400"),
    ("ax", ""),
    ("temperature_c", "-400"),
    ("ref_inclination_deg", "1000"),
    ("ref_azimuth_deg", "1000"),
    ("ref_toolface_deg", "-1000"),
    ("ref_field_nt", "0"),
    ("ref_gravity_g", "-1"),
    ("ref_gravity_g", "0"),
    ("ref_dip_deg", "200"),
]


@pytest.mark.parametrize(("column", "text"), CELLS, ids=[f"{c} {t}" for c, t in CELLS])
def test_impossible_cells(tmp_path, column, text):
    columns = {k: list(map(str, v)) for k, v in servo_run().items()}
    columns[column][7] = text
    message = refused(ran(tmp_path, columns), 2)
    assert f"run.csv, line 9, column '{column}'" in message
    assert not left(tmp_path)


def every(change, *names):
    return lambda run: {k: change(v) if k in names else v for k, v in run.items()}


def constant(value, *names):
    return every(lambda v: np.full(len(v), value), *names)


def one_attitude(run):
    """One station again and again, with noise of a tenth of a millivolt."""
    rng = np.random.default_rng(5)
    run = {k: np.repeat(v[14:15], len(v)) for k, v in run.items()}
    return {k: v + 1e-4 * rng.normal(size=len(v)) if k in RAW else v for k, v in run.items()}


def random_angles(*names):
    rng = np.random.default_rng(9)
    return every(lambda v: rng.uniform(0, 180, len(v)), *(f"ref_{n}_deg" for n in names))


def swapped(first, second):
    return lambda run: {**run, first: run[second], second: run[first]}


UNFIT = {
    "1e308 everywhere": (constant(1e308, *RAW), 2),
    "dead accelerometer channel": (constant(0.123, "ay"), 3),
    "dead magnetometer channel": (constant(0.123, "mz"), 3),
    "all channels constant": (constant(0.5, *RAW), 3),
    "all channels zero": (constant(0.0, *RAW), 3),
    "1e-308 everywhere": (constant(1e-308, *RAW), 3),
    "readings of 1e-308": (every(lambda v: v * 1e-308, *RAW), 3),
    "readings of 1e14": (every(lambda v: v * 1e14, *RAW), 3),
    "one station": (lambda run: {k: v[:1] for k, v in run.items()}, 3),
    "three stations": (lambda run: {k: v[[0, 20, 40]] for k, v in run.items()}, 3),
    "identical rows": (lambda run: {k: np.repeat(v[9:10], len(v)) for k, v in run.items()}, 3),
    "one attitude": (one_attitude, 3),
    "wrong sign of ay": (every(lambda v: -v, "ay"), 3),
    "wrong sign of mx": (every(lambda v: -v, "mx"), 3),
    "gravity counted upwards": (every(lambda v: -v, "ax", "ay", "az"), 3),
    "accelerometer scale 10 times": (every(lambda v: 10 * v, "ax", "ay", "az"), 3),
    "accelerometer scale a tenth": (every(lambda v: v / 10, "ax", "ay", "az"), 3),
    "magnetometer scale 10 times": (every(lambda v: 10 * v, "mx", "my", "mz"), 3),
    "swapped channels": (swapped("ax", "ay"), 3),
    "swapped magnetometer channels": (swapped("my", "mz"), 3),
    "volts, millivolts, microvolts": (
        lambda run: {**run, "ay": 1e3 * run["ay"], "az": 1e6 * run["az"]},
        3,
    ),
    "one cell of a million": (
        lambda run: {**run, "ax": np.where(np.arange(len(run["ax"])) == 5, 1e6, run["ax"])},
        3,
    ),
}
IDS = [f"{name}, {soaks}" for name in UNFIT for soaks in ("one soak", "three soaks")]
CASES = [(*case, soaks) for case in UNFIT.values() for soaks in ((25.0,), THREE)]


@pytest.mark.parametrize(("spoilt", "code", "soaks"), CASES, ids=IDS)
def test_runs_that_cannot_be_calibrated(tmp_path, spoilt, code, soaks):
    refused(ran(tmp_path, spoilt(servo_run(temperatures=soaks))), code)
    assert not left(tmp_path)


@pytest.mark.parametrize("method", ["joint", "least-squares"])
@pytest.mark.parametrize(
    "names",
    [("inclination",), ("azimuth",), ("toolface",), ("inclination", "azimuth", "toolface")],
    ids="-".join,
)
def test_references_that_contradict_each_other_never_pass_in_silence(tmp_path, names, method):
    made = ran(tmp_path, random_angles(*names)(servo_run()), "--method", method)
    if made.code:
        refused(made, 3)
        assert not left(tmp_path)
    else:
        assert "times the declared noise" in made.err


GENERIC = {
    "one attitude": one_attitude,
    "wrong sign of ay": every(lambda v: -v, "ay"),
    "volts, millivolts, microvolts": UNFIT["volts, millivolts, microvolts"][0],
    "noise alone": every(lambda v: np.random.default_rng(len(v)).normal(size=len(v)), *RAW),
    "random angles": random_angles("inclination", "azimuth", "toolface"),
}


@pytest.mark.parametrize("spoilt", GENERIC.values(), ids=GENERIC)
def test_the_same_with_a_tool_of_which_nothing_is_known(tmp_path, spoilt):
    refused(ran(tmp_path, spoilt(servo_run()), tool="generic"), 3)
    assert not left(tmp_path)


def test_a_tool_of_which_nothing_is_known_may_have_any_unit(tmp_path):
    for size in (1e-308, 1e-100, 1e12):
        run = every(lambda v, size=size: v * size, *RAW)(servo_run())
        assert ran(tmp_path, run, tool="generic").code == 0


def test_vertical_attitudes_alone_are_too_weak(tmp_path):
    message = refused(ran(tmp_path, servo_run(inclinations=(0, 180))), 3)
    assert "Add stations" in message


OPTIONS = {
    "order 3 at one temperature": (("--order", 3), 3, "lower --order"),
    "method unknown": (("--method", "magic"), 2, "must be one of joint"),
    "model unknown": (("--model", "magic"), 2, "polynomial"),
    "order unknown": (("--order", "4"), 2, "0, 1, 2, 3 or auto"),
    "order below": (("--order", "-1"), 2, "0, 1, 2, 3 or auto"),
    "tool unknown": (("--tool", "servoo"), 2, "Did you mean 'servo'"),
    "tool is a folder": (("--tool", "."), 2, "is not a tool profile"),
    "station unknown": (("--exclude", "49"), 2, "no such station"),
    "all stations left out": ([f"--exclude={i}" for i in range(1, 49)], 3, "0 stations"),
    "decimal unknown": (("--decimal", ";"), 2, "must be '.' or ','"),
    "option unknown": (("--polynom", "3"), 2, "No such option"),
}


@pytest.mark.parametrize(("options", "code", "part"), OPTIONS.values(), ids=OPTIONS)
@pytest.mark.parametrize("soaks", [(25.0,), (25.0, 25.1)], ids=["a", "b"])
def test_options_that_cannot_be_meant(tmp_path, options, code, part, soaks):
    half = servo_run(toolfaces=12 // len(soaks), temperatures=soaks)
    assert part in refused(ran(tmp_path, half, *options), code)
    assert not left(tmp_path)


@pytest.mark.parametrize("method", ["magic", "Joint", ""])
def test_an_unknown_method_is_named_before_the_order_is_chosen(tmp_path, method):
    message = refused(ran(tmp_path, servo_run(temperatures=THREE), "--method", method), 2)
    assert message.startswith("mwdcal: --method must be one of joint, least-squares")


def test_order_1_over_5_degrees(tmp_path):
    message = refused(ran(tmp_path, servo_run(temperatures=(20.0, 25.0)), "--order", 1), 3)
    assert "spans 5.0 °C" in message


def test_order_1_without_temperatures(tmp_path):
    run = servo_run()
    del run["temperature_c"]
    assert "temperature_c" in refused(ran(tmp_path, run, "--order", 1), 2)


def test_least_squares_names_the_blank_references(tmp_path):
    run = constant(np.nan, "ref_azimuth_deg")(servo_run(temperatures=THREE))
    message = refused(ran(tmp_path, run, "--method", "least-squares"), 3)
    assert "'ref_azimuth_deg' is blank at 144 of 144" in message


def test_folders_missing_files_and_outputs_that_cannot_be_written(tmp_path):
    run = write_csv(tmp_path / "run.csv", servo_run())
    (tmp_path / "folder").mkdir()
    bytes_before = run.read_bytes()
    for source in (tmp_path / "folder", tmp_path / "missing.csv", tmp_path / "run", "/dev/null"):
        refused(calibrate(tmp_path, source), 2)
    for output in (tmp_path / "no" / "cal.json", tmp_path / "folder", run, "/dev/full"):
        refused(mwdcal("calibrate", run, "-o", output), 2)
    for report in (tmp_path / "no" / "r.html", tmp_path / "folder", run, tmp_path / "cal.json"):
        refused(calibrate(tmp_path, run, "--report", report), 2)
    assert run.read_bytes() == bytes_before
    assert not left(tmp_path)


def test_a_tool_profile_is_not_overwritten(tmp_path):
    tool = tmp_path / "tool.toml"
    tool.write_text('name = "t"\n')
    run = write_csv(tmp_path / "run.csv", servo_run())
    refused(mwdcal("calibrate", run, "--tool", tool, "-o", tool), 2)
    assert tool.read_text() == 'name = "t"\n'


def test_labels_of_markup_are_only_labels(tmp_path):
    run = servo_run()
    run["station"] = [f"<script>alert({i})</script>" for i in range(48)]
    run["ax"] = np.where(np.arange(48) == 20, run["ax"] + 0.1, run["ax"])
    made = ran(tmp_path, run)
    assert made.code == 0
    assert "! station <script>alert(20)</script>: residual" in made.err


def test_groups_of_one_are_no_groups(tmp_path):
    run = servo_run()
    alone = ran(tmp_path, run, "--json").json
    grouped = ran(tmp_path, {**run, "group": [f"g{i}" for i in range(48)]}, "--json").json
    for before, after in zip(alone["errors"], grouped["errors"], strict=True):
        assert after["after"] == pytest.approx(before["after"], rel=1e-6)
    assert grouped["triads"]["magnetometer"]["rank"] == 12


def test_only_toolface_known_determines_both_triads(tmp_path):
    """Strengths fix all but turns, toolface the accelerometer's three, dip the other three."""
    names = ("ref_inclination_deg", "ref_azimuth_deg")
    made = ran(tmp_path, constant(np.nan, *names)(servo_run()), "--json")
    assert made.code == 0
    assert {t["rank"] for t in made.json["triads"].values()} == {12}


def test_what_nothing_determines_is_said(tmp_path):
    """Without reference angles the three turns common to both triads are free, and no more."""
    angles = ("ref_inclination_deg", "ref_azimuth_deg", "ref_toolface_deg")
    made = ran(tmp_path, constant(np.nan, *angles, "ref_field_nt")(servo_run()))
    assert made.code == 0
    each = ("accelerometer 9 of 12 determined, (.*)", "magnetometer 9 of 12 determined, (.*)")
    freedom = re.search("   ".join(f"{words} degrees of freedom" for words in each), made.out)
    assert (
        sum(map(float, freedom.groups())) == 3 * 48 - 2 * 9 - 3
    )  # strengths and dip; the mounting
    for words in ("rotation about the tool's x axis", "y axis", "toolface zero", "strength"):
        assert sum(words in s for s in made.err.splitlines() if s.startswith("! ")) == 1


@pytest.mark.parametrize("missing", ["magnetometer", "temperature_c", "station"])
def test_optional_columns_may_be_absent(tmp_path, missing):
    run = {k: v for k, v in servo_run().items() if k != missing}
    if missing == "magnetometer":
        run = {k: v for k, v in run.items() if not k.startswith("m")}
    assert ran(tmp_path, run).code == 0


def test_rows_of_several_tools_are_refused(tmp_path):
    columns = servo_run()
    several = {"serial": ["A"] * 24 + ["B"] * 24, **columns}
    message = refused(ran(tmp_path, several), 2)
    assert "run.csv has rows of more than one tool (serial A, B)" in message
    made = ran(tmp_path, {"serial": ["A"] * 48, **columns})
    assert made.out.startswith("run.csv   A   48 stations")
    test = write_csv(tmp_path / "run.csv", several)
    assert "more than one tool" in refused(mwdcal("verify", tmp_path / "cal.json", test), 2)
    assert "more than one tool" in refused(mwdcal("compare", test), 2)


@pytest.mark.parametrize("mark", ["time_s", "sampling_hz"])
def test_a_log_is_no_run(tmp_path, mark):
    few, many = (servo_run(toolfaces=count) for count in (12, 251))
    for columns in (few, many):
        if mark == "time_s":
            columns["time_s"] = np.arange(len(columns["ax"])) * 1.0
    metadata = ["sampling_hz = 100"] if mark == "sampling_hz" else []
    path = write_csv(tmp_path / "run.csv", many, *metadata)
    message = refused(calibrate(tmp_path, path, "--order", 0), 2)
    assert "run.csv is a continuous log (1004 rows): its rows are not stations." in message
    assert message.endswith("If each row is a station, remove time_s and sampling_hz.")
    assert "continuous log" in refused(mwdcal("compare", path), 2)
    assert not left(tmp_path)
    short = write_csv(tmp_path / "short.csv", few, *metadata)
    assert calibrate(tmp_path, short, "--order", 0).code == 0
    assert "continuous log" in refused(mwdcal("verify", tmp_path / "cal.json", path), 2)


def test_a_blank_reading_of_a_run_has_no_way_round(tmp_path):
    columns = servo_run()
    columns["ax"][5] = np.nan
    assert "--missing" not in refused(ran(tmp_path, columns), 2)


def test_the_screen_names_thirteen_stations_to_shoot_again(tmp_path):
    columns = servo_run(inclinations=(5, 25, 45, 65, 90, 110, 135), toolfaces=24)
    moved = np.arange(3, 168, 11)
    columns["az"][moved] += 0.006 * (-1.0) ** np.arange(len(moved))
    shown = ran(tmp_path, columns, "--order", 0)
    told = ran(tmp_path, columns, "--order", 0, "--json").json["findings"]
    count = sum(finding["id"] == "reshoot" for finding in told)
    lines = [line for line in shown.err.splitlines() if line.startswith("! ")]
    assert count > 12
    (again,) = [line for line in lines if "Re-shoot it" in line]
    also = again.rpartition("Also stations ")[2].partition(" and ")[0].split(", ")
    assert len(also) == min(count - 1, 12)
    assert len(lines) == len(told) - count + 1


@pytest.mark.parametrize("seed", range(4))
def test_references_of_other_stations_are_named_before_the_design(tmp_path, seed):
    run = {name: np.array(values) for name, values in servo_run().items()}
    order = np.random.default_rng(seed).permutation(48)
    for name in ("ref_inclination_deg", "ref_azimuth_deg", "ref_toolface_deg"):
        run[name] = run[name][order]
    message = refused(ran(tmp_path, run), 3)
    assert "times the declared noise" in message
    assert "reference angles and groups belong to the stations they stand at" in message
