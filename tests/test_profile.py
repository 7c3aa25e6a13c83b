"""`mwdcal profile`: exports as people have them, calibrated without an option typed by hand."""

import itertools
import os
import re

import numpy as np
import pytest

import exports
from cli_support import EXAMPLE, mwdcal, numbers, read_csv, refused, servo_run, write_csv
from mwdcal import propose_profile, read_run
from mwdcal.calibration.readings import TRIADS
from mwdcal.errors import FitError
from mwdcal.files.profiles import load_profile
from mwdcal.geometry.observables import RESULTS
from mwdcal.geometry.vectors import tool_from_earth
from mwdcal.identification.columns import meaning
from mwdcal.identification.proposal import is_clear, wiring
from terminal import at_terminal

DIALECTS = list(exports.DIALECTS)


@pytest.mark.parametrize("place", range(len(DIALECTS)), ids=DIALECTS)
def test_an_export_gives_the_results_of_the_clean_run(tmp_path, place):
    dialect = exports.DIALECTS[DIALECTS[place]]
    run, roll = (
        exports.write(tmp_path / f"x-{i}", r, dialect) for i, r in enumerate(exports.runs(place))
    )
    plain_run, plain_roll, plain_tool = exports.clean(tmp_path, place)
    ran = mwdcal("profile", run, "-o", tmp_path / "tool.toml.new", "--json")
    assert ran.code == 0, ran.err
    for kind, axes in zip(TRIADS, exports.axes(place, dialect), strict=True):
        assert tuple(ran.json[kind]["axes"]) == axes
    tool = tmp_path / "tool.toml.new"
    outputs = []
    for name, cal_run, cal_roll, profile in (
        ("export", run, roll, tool),
        ("clean", plain_run, plain_roll, plain_tool),
    ):
        cal = tmp_path / f"{name}.json"
        ran = mwdcal("calibrate", cal_run, "--tool", profile, "-o", cal)
        assert ran.code == 0, ran.err
        verdict = mwdcal("verify", cal, cal_roll, "--json")
        assert verdict.code == 0, verdict.err
        applied = tmp_path / f"{name}-out{cal_roll.suffix}"
        ran = mwdcal("apply", cal, cal_roll, "-o", applied)
        assert ran.code == 0, ran.err
        rows = [(r["name"], r["value"], r["limit"], r["passed"]) for r in verdict.json["rows"]]
        outputs.append((rows, applied))
    (rows, applied), (plain_rows, plain_applied) = outputs
    assert [(n, most, passed) for n, _, most, passed in rows] == [
        (n, most, passed) for n, _, most, passed in plain_rows
    ]
    np.testing.assert_allclose([r[1] for r in rows], [r[1] for r in plain_rows], rtol=1e-6)
    corrected, clean = results(applied, dialect), read_csv(plain_applied)
    for name in RESULTS:
        expected = numbers(clean[name])
        np.testing.assert_allclose(
            corrected[name], expected, rtol=0, atol=1e-9 * max(1.0, np.nanmax(np.abs(expected)))
        )


def results(path, dialect):
    """The results in an output, by a reader of its dialect that is not the package's own."""
    if dialect.suffix == ".parquet":
        columns = exports.pq.read_table(path).to_pydict()
    elif dialect.suffix == ".xlsx":
        rows = [
            r
            for r in exports.openpyxl.load_workbook(path).active.values
            if not str(r[0]).startswith("#")
        ]
        columns = dict(zip(rows[0], zip(*rows[1:], strict=True), strict=True))
    else:
        encoding = "utf-8-sig" if dialect.encoding == "utf-8" else dialect.encoding
        lines = [s for s in path.read_text(encoding).splitlines() if not s.startswith("#")]
        rows = list(exports.csv.reader(lines, delimiter=dialect.delimiter))
        columns = dict(zip(rows[0], zip(*rows[1:], strict=True), strict=True))
    assert (
        list(dialect.names.values())[1:7]
        == [n for n in columns if n in dialect.names.values()][1:7]
    )
    return {
        name: np.array(
            [
                np.nan if v in (None, "") else float(str(v).replace(dialect.decimal, "."))
                for v in columns[name]
            ]
        )
        for name in RESULTS
    }


# ----------------------------------------------------------------------------- open choices


def changed(**columns):
    """Columns of a sound run with other ones; None takes one away."""
    run = {k: v for k, v in servo_run().items() if columns.get(k, v) is not None}
    return {**run, **{k: v for k, v in columns.items() if v is not None}}


def renamed(run, **names):
    """The run with columns under other names."""
    return {names.get(k, k): v for k, v in run.items()}


def thousands(run):
    """Raw readings as whole numbers with a comma."""
    return {
        k: [f"{1 + abs(int(v * 1000)) // 1000},{abs(int(v * 1000)) % 1000:03d}" for v in run[k]]
        for k in exports.RAW
    }


OPEN = {
    "two azimuths": (
        {**renamed(servo_run(), ref_azimuth_deg="Azi stand", ), "Ref Azi": servo_run()["ref_azimuth_deg"]},
        "'Azi stand' and 'Ref Azi' may each be 'ref_azimuth_deg'",
    ),
    "true north": (renamed(servo_run(), ref_azimuth_deg="Azimuth true"), "counts from true or grid north"),
    "no unit of temperature": (
        renamed(changed(temperature_c=np.full(48, 77.0)), temperature_c="Temp"),
        "neither its name nor its values (77, 77, 77, 77) say whether it is in °C or °F or K",
    ),
    "gal or milli-g": (
        renamed(changed(ref_gravity_g=np.full(48, 981.2)), ref_gravity_g="Gtotal"), "in g or mg or m/s²",
    ),
    "a measured gravity": (
        renamed(changed(ref_gravity_g=1 + 1e-3 * np.arange(48) / 47), ref_gravity_g="Gtotal (g)"),
        "differs between stations by 1 mg",
    ),
    "cold and hot in °F": (
        renamed(changed(temperature_c=np.linspace(14, 248, 48)), temperature_c="Temp"), "in °C or °F or K",
    ),
    "two units in a triad": (renamed(servo_run(), ax="Gx (mg)", ay="Gy (mg)", az="Gz (g)"), "'Gx (mg)' is in mg"),
    "another unit of noise": (
        renamed(changed(sd_mx=np.full(48, 1.0)), mx="mx (nT)", sd_mx="sd_mx (uT)"), "'mx (nT)' is in nT, 'sd_mx (uT)'",
    ),
    "a field that is none": (
        renamed(changed(ref_field_nt=np.full(48, 5.0)), ref_field_nt="Btotal"),
        "in nT or µT or mT or gauss",
    ),
    "nameless channels beside copies of them": (
        changed(ax=None, ay=None, az=None, **{f"{t}{k}": servo_run()[n] + s for t, s in (("Ch", 0.0), ("Raw", 0.1))
                                              for k, n in enumerate(exports.RAW[:3])}),
        "could not tell which columns are the accelerometers (ax, ay, az)",
    ),
    "two magnetometers": (changed(mz=None), "the magnetometers (mz)"),
    "no relation": (
        changed(**{k: np.random.default_rng(1).normal(size=48) for k in exports.RAW}),
        "no axes of the accelerometer explain",
    ),
}  # fmt: skip


ROLLS = {
    "one inclination": (servo_run(inclinations=(90,)), "the stations do not tell the axes apart", 1),
    "no toolface": (changed(ref_toolface_deg=None), "there is no column of the stand's toolface", 2),
    "rolls alone": (
        changed(ref_inclination_deg=None, ref_azimuth_deg=None, ref_dip_deg=None),
        "there is no column of the stand's inclination",
        2,
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", ROLLS)
def test_axes_that_a_table_does_not_tell_are_left_open(tmp_path, case):
    """The profile is written; calibrate names the lines to fill in; filled in, it is a profile as any other."""
    columns, reason, count = ROLLS[case]
    run, tool = write_csv(tmp_path / "run.csv", columns), tmp_path / "tool.toml"
    ran = mwdcal("profile", run, "-o", tool, "--json")
    assert ran.code == 0, ran
    findings = [each for each in ran.json["findings"] if each["id"] == "axes-open"]
    assert len(findings) == count
    assert reason in findings[0]["text"]
    assert ran.json["accelerometer"]["axes"] == []
    text = tool.read_text("utf-8")
    lines = [n for n, line in enumerate(text.splitlines(), 1) if line == "axes = []"]
    assert len(lines) == count
    message = refused(mwdcal("calibrate", run, "--tool", tool, "-o", tmp_path / "cal.json"), 2)
    assert f"line{'s' if count > 1 else ''} {' and '.join(map(str, lines))}: the axes of" in message
    assert ("dip north and south" in message) == (count == 2)
    tool.write_text(text.replace("axes = []", 'axes = ["+x", "+y", "+z"]'), "utf-8")
    profile = load_profile(str(tool))[0]
    assert profile.accelerometer.scale == pytest.approx(3.0, rel=0.1)
    with pytest.raises(FitError, match="axes are open"):
        propose_profile(run).profile  # noqa: B018


@pytest.mark.skipif(os.name == "nt", reason="a pseudo-terminal")
def test_what_is_open_is_asked_on_a_terminal_and_the_answers_are_in_the_profile(tmp_path):
    """By two columns that may be the azimuth, a temperature without a unit, and true north with its declination."""
    run = renamed(servo_run(), ref_azimuth_deg="Azi true", temperature_c="Temp")
    run |= {"Azimuth": run["Azi true"] + 40.0, "Temp": np.full(48, 77.0)}
    path, tool = write_csv(tmp_path / "run.csv", run), tmp_path / "tool.toml"
    refused(mwdcal("profile", path, "-o", tool), 3)
    typed = ["9", "2", "1", "", "2.5"]
    code, screen = at_terminal(["profile", str(path), "-o", str(tool)], typed)
    assert code == 0, screen
    assert "Type a number from 1 to 3" in screen
    first = ", ".join(f"{value:.6g}" for value in run["Azi true"][:4])
    assert f"Azi true: {first}" in " ".join(screen.split())
    profile = load_profile(str(tool))[0]
    assert profile.columns["ref_azimuth_deg"].name == "Azi true"
    assert profile.columns["temperature_c"].unit == "°F"
    assert profile.table.north == {"azimuth_reference": "true", "declination_deg": 2.5}
    options = ("--column", "ref_azimuth_deg=Azi true", "--column", "temperature_c=Temp (°F)")
    by_options = (*options, "--north", "true", "--declination-deg", "2.5")
    ran = mwdcal("profile", path, "-o", tmp_path / "same.toml", *by_options)
    assert ran.code == 0, ran
    assert (tmp_path / "same.toml").read_bytes() == tool.read_bytes()
    ran = mwdcal("calibrate", path, "--tool", tool, "-o", tmp_path / "cal.json")
    assert ran.code == 0, ran
    magnetic = read_run(path, tool).reference("azimuth")
    turned = np.degrees(magnetic) - (run["Azi true"] - 2.5)
    np.testing.assert_allclose((turned + 180) % 360 - 180, 0.0, atol=1e-9)


@pytest.mark.parametrize("case", OPEN)
def test_what_is_open_is_asked_and_nothing_is_written(tmp_path, case):
    columns, expected = OPEN[case]
    run = write_csv(tmp_path / "run.csv", columns)
    message = refused(mwdcal("profile", run, "-o", tmp_path / "tool.toml"), 3)
    assert expected in message
    assert not (tmp_path / "tool.toml").exists()


def test_vectors_of_a_master_tool_whose_gravity_differs_are_left_out_by_the_answer(tmp_path):
    """Components that a second tool with its biases has measured: with the answer the profile is as without them."""
    run, rng = changed(ref_gravity_g=None), np.random.default_rng(3)
    inclination, azimuth, toolface, dip = (
        np.radians(np.asarray(run[f"ref_{n}_deg"]))
        for n in ("inclination", "azimuth", "toolface", "dip")
    )
    axes = tool_from_earth(inclination, azimuth, toolface)
    down = np.broadcast_to([0.0, 0.0, 1.0], (48, 3))
    field = np.stack([np.cos(dip), np.zeros(48), np.sin(dip)], -1) * 50_000.0
    master = {}
    for letter, unit, vector, bias in (("G", "g", down, 4e-3), ("B", "nT", field, 200.0)):
        turned = np.einsum("nij,nj->ni", axes, vector) + rng.normal(0, bias, 3)
        master |= {f"{letter}{a} reference ({unit})": turned[:, k] for k, a in enumerate("xyz")}
    path = write_csv(tmp_path / "run.csv", {**run, **master})
    with pytest.raises(
        FitError, match=r"the gravity of 'Gx reference \(g\)', .* a tool has"
    ) as asked:
        propose_profile(path)
    answer = asked.value.answers[0]
    left = propose_profile(path, column=[value for _, value in answer.arguments])
    plain = propose_profile(write_csv(tmp_path / "plain.csv", run))
    assert not {each.name for each in left.profile.columns.values()} & {*master}
    assert left.profile.accelerometer == plain.profile.accelerometer


def test_a_comma_that_may_separate_thousands_is_asked(tmp_path):
    run = {k: np.round(v) for k, v in servo_run().items()}
    path = write_csv(tmp_path / "run.csv", {**run, **thousands(servo_run())}, delimiter=";")
    path.write_text(path.read_text().replace(".0;", ";").replace(".0\n", "\n"))
    message = refused(mwdcal("profile", path, "-o", tmp_path / "tool.toml"), 3)
    assert "may be a decimal sign or separate thousands" in message


def test_a_point_that_may_separate_thousands_is_asked(tmp_path):
    run = {k: np.round(v) for k, v in servo_run().items()}
    raw = {k: [cell.replace(",", ".") for cell in v] for k, v in thousands(servo_run()).items()}
    path = write_csv(tmp_path / "run.csv", {**run, **raw}, delimiter=";")
    path.write_text(path.read_text().replace(".0;", ";").replace(".0\n", "\n"))
    message = refused(mwdcal("profile", path, "-o", tmp_path / "tool.toml"), 3)
    assert "the point in" in message


def test_three_decimals_below_one_do_not_separate_thousands(tmp_path):
    run = {
        k: v if k == "station" else [f"{x:.3f}".replace(".", ",") for x in v]
        for k, v in servo_run().items()
    }
    path = write_csv(tmp_path / "run.csv", run, delimiter=";")
    ran = mwdcal("profile", path, "-o", tmp_path / "tool.toml", "--json")
    assert ran.code == 0, ran.err
    assert ran.json["table"]["decimal"] == ","


@pytest.mark.parametrize("line", ["Azimuth reference: True North", "Azimut rechtweisend;;;"])
def test_north_by_a_line_above_the_table(tmp_path, line):
    path = write_csv(tmp_path / "run.csv", servo_run(), delimiter=";")
    text = path.read_text()
    path.write_text(f"{line}\n{text}")
    message = refused(mwdcal("profile", path, "-o", tmp_path / "tool.toml"), 3)
    assert "true or grid north by the line" in message
    path.write_text(f'# azimuth_reference = "magnetic"\n{line}\n{text}')
    assert mwdcal("profile", path, "-o", tmp_path / "tool.toml").code == 0


def test_a_column_from_true_north_with_its_declination_is_taken(tmp_path):
    run = renamed(servo_run(), ref_azimuth_deg="Azimuth true")
    lines = ('azimuth_reference = "true"', "declination_deg = 0.0")
    path = write_csv(tmp_path / "run.csv", run, *lines)
    assert mwdcal("profile", path, "-o", tmp_path / "tool.toml").code == 0


THEIRS = {"temperature_c": "Temp", "ax": "Gx", "ay": "Gy", "az": "Gz"}
UNITS = {"Temp": "°C", "Gx": "mg", "Gy": "mg", "Gz": "mg"}


@pytest.fixture
def with_units(tmp_path):
    """A table with a line of units below its names, and its profile."""
    path = write_csv(tmp_path / "run.csv", renamed(servo_run(), **THEIRS))
    _with_units(path, UNITS)
    tool = tmp_path / "tool.toml"
    ran = mwdcal("profile", path, "-o", tool, "--json")
    assert ran.code == 0, ran.err
    assert ran.json["table"]["first_line"] == 3
    assert ran.json["accelerometer"]["scale"] == pytest.approx(3.0, rel=0.1)
    return path, tool


def _with_units(path, units):
    names, *rows = path.read_text("utf-8").splitlines()
    line = ",".join(units.get(name, "") for name in names.split(","))
    path.write_text("\n".join([names, line, *rows]) + "\n", "utf-8")


def test_a_table_without_the_line_of_units_does_not_lose_a_station(with_units, tmp_path):
    _, tool = with_units
    other = write_csv(tmp_path / "other.csv", renamed(servo_run(2), **THEIRS))
    ran = mwdcal("calibrate", other, "--tool", tool, "-o", tmp_path / "cal.json")
    assert ran.code == 0
    assert "48 stations" in ran.out


@pytest.mark.parametrize("unit", [{"Temp": "°F"}, {"Gx": "g"}])
def test_other_units_below_the_names_are_refused(with_units, tmp_path, unit):
    path, tool = with_units
    path.write_text(path.read_text().replace(path.read_text().splitlines()[1] + "\n", ""))
    _with_units(path, UNITS | unit)
    message = refused(mwdcal("calibrate", path, "--tool", tool, "-o", tmp_path / "cal.json"), 2)
    assert (
        f"line 2: '{next(iter(unit))}' is in {next(iter(unit.values()))}, by the tool profile"
        in message
    )


def test_a_cell_of_another_decimal_sign_is_named_and_its_row_left_out(tmp_path):
    path = write_csv(tmp_path / "run.csv", servo_run(), delimiter=";")
    path.write_text(path.read_text().replace("\n1;25.0;", "\n1;25,5;"))
    message = refused(mwdcal("profile", path, "-o", tmp_path / "tool.toml"), 3)
    assert "line 2" in message
    option = ["--leave-out", "temperature_c=25,5"]
    assert " ".join(option).replace("temp", '"temp') + '"' in message
    ran = mwdcal("profile", path, "-o", tmp_path / "tool.toml", *option)
    assert ran.code == 0
    assert "line 2 ('temperature_c': 25,5)" in ran.err


def test_as_many_commas_as_points_are_refused(tmp_path):
    path = write_csv(tmp_path / "run.csv", servo_run(), delimiter=";")
    lines = path.read_text().split("\n")
    half = len(lines) // 2
    path.write_text("\n".join([line.replace(".", ",") for line in lines[:half]] + lines[half:]))
    message = refused(mwdcal("profile", path, "-o", tmp_path / "tool.toml"), 2)
    assert "are mixed. Say which one is the decimal sign by --decimal" in message


# ------------------------------------------------------------------------------------ axes


@pytest.mark.parametrize("unknown_dip", [False, True])
def test_all_signed_permutations_are_told(unknown_dip):
    rng = np.random.default_rng(3)
    field = rng.normal(size=(20, 3))
    other = np.cross(field, rng.normal(size=(20, 3)))
    gain = 3.0 * (np.eye(3) + 0.02 * rng.normal(size=(3, 3)))
    parts = [field, other] if unknown_dip else [field]
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            vector = field + 2 * other if unknown_dip else field
            raw = (vector @ gain)[:, list(order)] * signs + [5.0, -3.0, 0.2]
            result = wiring(raw, *parts)
            assert is_clear(result)
            assert result.axes == tuple(
                "+-"[s < 0] + "xyz"[o] for o, s in zip(order, signs, strict=True)
            )
            expected = 3.0 * np.sqrt(5) if unknown_dip else 3.0
            assert result.scale == pytest.approx(expected, rel=0.1)


def test_an_axis_without_variation_stays_open():
    field = np.random.default_rng(4).normal(size=(20, 3)) * [1, 1, 0] + [0, 0, 0.3]
    result = wiring(field * 2.0, field)
    assert not is_clear(result)
    assert sorted(result.alternatives) == [("+x", "+y", "+z"), ("+x", "+y", "-z")]


def attitudes(*turns):
    """North and down along the tool axes (n, 3), at attitudes in degrees."""
    turn = tool_from_earth(*np.radians(np.broadcast_arrays(*turns)))
    return turn[..., 0], turn[..., 2]


def test_a_sign_is_told_by_the_dip_that_all_channels_share():
    north, down = attitudes(np.repeat([45.0, 90.0], 12), 30.0, np.tile(np.arange(0, 360, 30), 2))
    field = north * np.cos(np.radians(65)) + down * np.sin(np.radians(65))
    result = wiring(field * 3.0, north, down)
    assert is_clear(result)
    assert result.axes == ("+x", "+y", "+z")
    reversed_z = wiring(field * [3.0, 3.0, -3.0], north, down)
    assert reversed_z.axes == ("+x", "+y", "-z")
    assert is_clear(wiring(field * 3.0, field))
    north, down = attitudes(np.full(12, 90.0), 30.0, np.arange(0, 360, 30))
    assert not is_clear(wiring(north + 2 * down, north, down)), "z is the same at all stations"


WORDS_OF_THE_FIELD = {
    "Accelerometers Gx (V)": "ax", "Magnetometers Hy (nT)": "my", "Accéléromètre Z (g)": "az", "Z (mg)": "az",
    "X (nT)": "mx", "Mag. X (G)": "mx", "Température (°С)": "temperature_c", "Face outil (°)": "ref_toolface_deg",
    "Mergulho (°)": "ref_dip_deg", "Feltinklinasjon (grader)": "ref_dip_deg", "地磁倾角(°)": "ref_dip_deg",
    "Т, град С": "temperature_c", "Gref": "ref_gravity_g", "Bancada Azimute mag. (graus)": "ref_azimuth_deg",
    "ax_mg_mean": "ax", "mx_uT_std": "sd_mx", "mag_x_cuentas": "mx",
    "参考总磁场/Gs": "ref_field_nt",


    "Angle from vertical (deg)": "ref_inclination_deg", "Helningsvinkel (°)": "ref_inclination_deg",
    "Ángulo de inclinación (°)": "ref_inclination_deg", "Отклонение от вертикали, °": "ref_inclination_deg",
    "顶角(°)": "ref_inclination_deg", "Kurs (°)": "ref_azimuth_deg", "Direção (°)": "ref_azimuth_deg",
    "TFO": "ref_toolface_deg", "Høyside (°)": "ref_toolface_deg", "Lado alto (°)": "ref_toolface_deg",
    "Угол крена": "ref_toolface_deg", "横滚角": "ref_toolface_deg", "Inklination Erdfeld (°)": "ref_dip_deg",
    "磁场总强度": "ref_field_nt", "Акс. Х": "ax", "Gу": "ay", "重力加速度Z": "az", "G axial (mg)": "az",
    "M radial 1 (uT)": "mx", "Felt X (nT)": "mx", "X轴磁场(nT)": "mx", "Eje X magn.": "mx", "Campo magn. Y": "my",
    "Угол установки, °": "ref_toolface_deg", "CAMPO_TOTAL_mGauss": "ref_field_nt", "Az (gon)": "ref_azimuth_deg",
}  # fmt: skip


@pytest.mark.parametrize("name", WORDS_OF_THE_FIELD)
def test_words_of_the_field(name):
    assert meaning(name).column == WORDS_OF_THE_FIELD[name]


def test_a_total_that_is_computed_from_the_channels_is_no_reference(tmp_path):
    run = servo_run()
    total = np.linalg.norm([run[name] for name in ("ax", "ay", "az")], axis=0)
    columns = {**renamed(run, ax="Ax (V)", ay="Ay (V)", az="Az (V)"), "Gtot (V)": total}
    del columns["ref_gravity_g"]
    path, tool = write_csv(tmp_path / "run.csv", columns), tmp_path / "tool.toml"
    ran = mwdcal("profile", path, "-o", tool)
    assert "'Gtot (V)' is not used: it is computed from the channels." in ran.err
    assert mwdcal("calibrate", path, "--tool", tool, "-o", tmp_path / "cal.json").code == 0


def test_a_toolface_that_the_readings_fit_anticlockwise_is_so_and_named(tmp_path):
    run = servo_run(inclinations=(20, 60, 100))
    path = write_csv(
        tmp_path / "run.csv", {**run, "ref_toolface_deg": (360.0 - run["ref_toolface_deg"]) % 360}
    )
    tool, toolface = tmp_path / "tool.toml", "ref_toolface_deg"
    ran = mwdcal("profile", path, "-o", tool)
    assert ran.code == 0, ran
    assert f"fit one answer alone: {toolface}={toolface} (° anticlockwise)" in ran.err
    turned = np.degrees(read_run(path, tool).reference("toolface")) - run[toolface]
    np.testing.assert_allclose((turned + 180) % 360 - 180, 0.0, atol=1e-9)


def test_few_stations_never_tell_wrong_axes():
    rng = np.random.default_rng(5)
    told = 0
    for case in range(300):
        angles = rng.uniform([0, 0, 0], [180, 360, 360], (5 + case % 4, 3)).T
        angles[1] = angles[1, 0] if case % 2 else angles[1]
        north, down = attitudes(*angles)
        dip = np.radians(rng.uniform(-85, 85))
        raw = (north * np.cos(dip) + down * np.sin(dip)) @ (
            np.eye(3) + 0.02 * rng.normal(size=(3, 3))
        )
        result = wiring(raw, north, down)
        told += is_clear(result)
        assert not is_clear(result) or result.axes == ("+x", "+y", "+z"), case
    assert told > 100


def test_a_left_handed_triad_is_said_to_be_one(tmp_path):
    run = changed(mx=None, my=None, mz=None)
    run["ref_toolface_deg"] = 360 - run["ref_toolface_deg"]
    path = write_csv(tmp_path / "run.csv", run)
    ran = mwdcal("profile", path, "-o", tmp_path / "tool.toml")
    assert ran.code == 0
    assert "left-handed" in ran.err
    fitted = mwdcal("calibrate", path, "--tool", tmp_path / "tool.toml", "-o", tmp_path / "c.json")
    assert "left-handed set" in fitted.err


def test_two_columns_of_exchanged_angles_are_named(tmp_path):
    run = servo_run(inclinations=(20, 60, 100))
    one, other = "ref_azimuth_deg", "ref_toolface_deg"
    path = write_csv(tmp_path / "run.csv", {**run, one: run[other], other: run[one]})
    ran = mwdcal("profile", path, "-o", tmp_path / "tool.toml")
    assert f"They fit with {one} and {other} exchanged" in ran.err, ran


# -------------------------------------------------------------------------- names and files


@pytest.mark.parametrize(
    ("name", "column", "unit"),
    [
        ("Neigung Soll (°)", "ref_inclination_deg", "°"),
        ("Azimut", "ref_azimuth_deg", ""),
        ("gravTran2Raw", "ay", "raw"),
        ("magAxialRaw", "mz", "raw"),
        ("Température (°C)", "temperature_c", "°C"),
        ("Feldstärke [µT]", "ref_field_nt", "µT"),
        ("Beschleunigung X (m/s²)", "ax", "m/s²"),
    ],
)
def test_names_of_other_houses(name, column, unit):
    assert tuple(meaning(name)) == (column, unit)


def test_a_documented_run_needs_neither_columns_nor_a_table(tmp_path):
    run = write_csv(tmp_path / "run.csv", servo_run(), 'serial = "A-1"')
    assert mwdcal("profile", run, "-o", tmp_path / "tool.toml").code == 0
    profile, _ = load_profile(str(tmp_path / "tool.toml"))
    assert profile.name == "A-1"
    assert "[columns]" not in (tmp_path / "tool.toml").read_text("utf-8")
    assert "[table]" not in (tmp_path / "tool.toml").read_text("utf-8")
    assert profile.accelerometer.scale == pytest.approx(3.0, rel=0.1)
    assert profile.magnetometer.scale == pytest.approx(5e-5, rel=0.1)


@pytest.fixture
def german(tmp_path):
    """A run, a roll test and a profile of a German export."""
    d = exports.DIALECTS["german"]
    run, roll = (
        exports.write(tmp_path / n, r, d)
        for n, r in zip(("run", "roll"), exports.runs(0), strict=True)
    )
    tool = tmp_path / "tool.toml"
    assert mwdcal("profile", run, "-o", tool).code == 0
    return run, roll, tool


def test_a_profile_of_an_export_also_takes_documented_runs(german, tmp_path):
    _, _, tool = german
    run = write_csv(tmp_path / "plain.csv", exports.runs(0)[0])
    assert mwdcal("calibrate", run, "--tool", tool, "-o", tmp_path / "cal.json").code == 0
    ran = mwdcal("apply", tmp_path / "cal.json", run, "-o", tmp_path / "out.csv")
    assert ran.code == 0
    assert "inclination_deg" in read_csv(tmp_path / "out.csv")


def test_a_missing_channel_is_named_and_a_line_more_makes_no_difference(german, tmp_path):
    run, _, tool = german
    text = run.read_bytes()
    (tmp_path / "less.csv").write_bytes(text.replace(b"Gx", b"Gq", 1))
    output = ("--tool", tool, "-o", tmp_path / "cal.json")
    assert "no column 'Gx' (ax)" in refused(mwdcal("calibrate", tmp_path / "less.csv", *output), 2)
    (tmp_path / "shifted.csv").write_bytes(b"one more line\r\n" + text)
    moved = mwdcal("calibrate", tmp_path / "shifted.csv", *output, "--json").json
    plain = mwdcal("calibrate", run, "--tool", tool, "-o", tmp_path / "plain.json", "--json").json
    assert moved["triads"] == plain["triads"]


def test_a_wrong_cell_is_named_in_the_words_of_the_export(german, tmp_path):
    run, _, tool = german
    lines = run.read_bytes().decode("cp1252").split("\r\n")
    cells = lines[7].split(";")
    lines[7] = ";".join([cells[0], "o,o", *cells[2:]])
    wrong = tmp_path / "wrong.csv"
    wrong.write_bytes("\r\n".join(lines).encode("cp1252"))
    message = refused(mwdcal("calibrate", wrong, "--tool", tool, "-o", tmp_path / "cal.json"), 2)
    assert "wrong.csv, line 8, column 'Gx'" in message


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ('aq = {name = "Gx"}', "must be a column of a run file"),
        ('temperature_c = {name = "T", unit = "nT"}', "must be one of °C, °F, K"),
        ('ax = {name = "G"}\nay = {name = "G"}', "is 'ax' already"),
        ("ax = 3", "columns"),
    ],
)
def test_wrong_columns_of_a_profile_are_refused(tmp_path, line, expected):
    (tmp_path / "tool.toml").write_text(f'name = "x"\n[columns]\n{line}\n', "utf-8")
    run = write_csv(tmp_path / "run.csv", servo_run())
    ran = mwdcal("calibrate", run, "--tool", tmp_path / "tool.toml", "-o", tmp_path / "cal.json")
    assert expected in refused(ran, 2)


def test_a_table_in_another_encoding_than_the_profile_says_is_read(german, tmp_path):
    run, _, tool = german
    tool.write_text(tool.read_text("utf-8").replace("cp1252", "utf-8"), "utf-8")
    ran = mwdcal("calibrate", run, "--tool", tool, "-o", tmp_path / "cal.json")
    assert ran.code == 0
    assert "48 stations" in ran.out


def test_a_simulated_run_is_said_to_be_one(tmp_path):
    run = write_csv(tmp_path / "run.csv", servo_run(), "simulated = true")
    ran = mwdcal("profile", run, "-o", tmp_path / "tool.toml")
    assert "48 stations   SIMULATED DATA" in ran.out
    assert mwdcal("profile", run, "-o", tmp_path / "tool.toml", "--json").json["simulated"] is True


def test_columns_that_are_not_understood_are_named(tmp_path):
    turned = changed(ref_azimuth_deg=(np.asarray(servo_run()["ref_azimuth_deg"]) + 8.0) % 360)
    run = write_csv(tmp_path / "run.csv", renamed(turned, ref_azimuth_deg="Lage 2"))
    message = refused(mwdcal("profile", run, "-o", tmp_path / "tool.toml"), 3)
    assert "no column is 'ref_azimuth_deg' by its name. Is it one of these?" in message
    assert '--column "ref_azimuth_deg=Lage 2" or --column ref_azimuth_deg=.' in message
    answer = ("--column", "ref_azimuth_deg=Lage 2", "--north", "true", "--declination-deg", "8")
    assert mwdcal("profile", run, "-o", tmp_path / "tool.toml", *answer).code == 0


@pytest.mark.parametrize(
    ("content", "status"),
    [
        (b"", 2),
        (b"\xff\xfe", 2),
        (b"\xff\xfea", 2),
        (b"\x81\x8d\x8f\n" * 9, 2),
        (b"a\0b;c;d;e\n1;2;3;4\n", 2),
        (b"x" * 200_000, 2),
        (b'"' + b"a;" * 100_000, 2),
        (b"1;2;3;4;5\n" * 9, 2),
        (b"a;b;c;d\n" * 9, 2),
        (b"\n\n;;;;\n", 2),
        (b"ax;ay;az;inc;tf\n1;2;3;4;5\n", 3),
        (b"ax;ax;az;inc;tf\n1;2;3;4;5\n", 3),
        (b"ax;ay;az;;tf\n1;2;3;4;5\n", 3),
        (b"ax;ay;az;inc;tf\n" + b"1;2;3;4\n" * 8, 3),
    ],
)
def test_what_is_no_table_ends_in_one_sentence(tmp_path, content, status):
    (tmp_path / "x.csv").write_bytes(content)
    refused(mwdcal("profile", tmp_path / "x.csv", "-o", tmp_path / "tool.toml"), status)
    assert not (tmp_path / "tool.toml").exists()


@pytest.mark.parametrize("decimals", [12, 3, 2])
def test_angles_computed_from_the_readings_are_no_reference(tmp_path, decimals):
    """A tool that writes its inclination beside the raw channels, and nothing of the stand."""
    run = servo_run()
    across = np.hypot(run["ax"], run["ay"])
    run["ref_inclination_deg"] = np.round(np.degrees(np.arctan2(across, run["az"])), decimals)
    path = write_csv(tmp_path / "run.csv", renamed(run, ref_inclination_deg="Inc (deg)"))
    message = refused(mwdcal("profile", path, "-o", tmp_path / "tool.toml"), 3)
    assert "computed from them" in message


@pytest.mark.parametrize("name", ["Inc measured", "Azi calc (deg)", "MWD Inclination", "TF corr"])
def test_what_the_tool_has_measured_is_no_reference(name):
    assert meaning(name) is None


def test_units_that_only_the_values_tell_are_said(tmp_path):
    run = {**servo_run(), "ref_field_nt": servo_run()["ref_field_nt"] / 1000}
    path = write_csv(tmp_path / "run.csv", renamed(run, ref_field_nt="Btotal"))
    ran = mwdcal("profile", path, "-o", tmp_path / "tool.toml")
    assert "µT, by its values" in ran.out
    assert "# unit by its values" in (tmp_path / "tool.toml").read_text("utf-8")
    assert mwdcal("profile", path, "-o", tmp_path / "tool.toml", "--json").json[
        "unit_by_values"
    ] == ["ref_field_nt"]


SAID = ("--column", "ref_inclination_deg={}")


@pytest.mark.parametrize("below", [True, False])
@pytest.mark.parametrize(
    ("unit", "ours", "size", "answers"),
    [("deg", "°", 1.0, ()), ("deg", "°", 1.0, SAID), ("rad", "rad", np.pi / 180, SAID)],
)
def test_the_unit_that_a_table_states_holds_for_a_column_that_an_answer_names(
    tmp_path, below, unit, ours, size, answers
):
    """The answer may be the user's or that of the readings; the unit is in the name or in a row of units."""
    name = "Deviation" if below else f"Deviation ({unit})"
    run = {k: v for k, v in servo_run().items() if "field" not in k and "dip" not in k}
    run["ref_inclination_deg"] = np.asarray(run["ref_inclination_deg"], float) * size
    names = dict(zip(exports.RAW, ("Gx", "Gy", "Gz", "Bx", "By", "Bz"), strict=True))
    angles = {f"ref_{each}_deg": each.capitalize() for each in ("azimuth", "toolface")}
    table = renamed(run, ref_inclination_deg=name, **names, **angles)
    units = {**dict.fromkeys(angles.values(), "deg"), **dict.fromkeys(names.values(), "V")}
    units |= {"ref_gravity_g": "g", "Deviation": unit}
    rows = {k: [units.get(k, ""), *v] for k, v in table.items()} if below else table
    path = write_csv(tmp_path / "run.csv", rows)
    typed = (each.format(name) for each in answers)
    ran = mwdcal("profile", path, "-o", tmp_path / "tool.toml", *typed, "--json")
    assert ran.code == 0, ran
    assert ran.json["columns"]["ref_inclination_deg"]["name"] == name
    assert ran.json["columns"]["ref_inclination_deg"]["unit"] == ours
    assert "ref_inclination_deg" not in ran.json["unit_by_values"]


@pytest.mark.parametrize("triad", ["A", "M"])
@pytest.mark.parametrize("unit", ["(mV)", "[ADC]", "_mV", "(1e-3 V)", "_adc", " digits", " uV"])
def test_no_unit_hides_a_channel(tmp_path, triad, unit):
    """Whether the unit is known or not, the readings give the scale."""
    run = servo_run(seed=2)
    names = {f"{t.lower()}{i}": f"{'GH'[t == 'M']}{i.upper()}" for t in "AM" for i in "xyz"}
    names = {k: v + unit * (k[0] == triad.lower()) for k, v in names.items()}
    columns = {names.get(name, name): cells for name, cells in run.items()}
    path = write_csv(tmp_path / "run.csv", columns, 'serial = "A"')
    ran = mwdcal("profile", path, "-o", tmp_path / "tool.toml")
    assert ran.code == 0, ran.err
    assert "readings fit one answer alone" not in ran.err
    cal = mwdcal(
        "calibrate", path, "--tool", tmp_path / "tool.toml", "-o", tmp_path / "c.json", "--json"
    )
    assert [name for name, each in cal.json["triads"].items() if each] == list(TRIADS)


def test_a_channel_of_a_run_file_with_any_unit_is_not_left_out(tmp_path):
    renamed = {f"m{i}": f"m{i} [ADC]" for i in "xyz"}
    columns = {renamed.get(name, name): cells for name, cells in servo_run(seed=2).items()}
    path = write_csv(tmp_path / "run.csv", columns)
    message = refused(mwdcal("calibrate", path, "--tool", "servo", "-o", tmp_path / "c.json"), 2)
    assert "'mx [ADC]' must be spelled exactly as documented. Did you mean 'mx'?" in message


def test_scales_are_in_the_unit_of_the_columns(tmp_path):
    pytest.importorskip("matplotlib")
    table, tool, made = EXAMPLE / "export.csv", tmp_path / "e.toml", tmp_path / "e.json"
    assert re.search(r"\d mg per g .*\n.*\d nT per nT ", mwdcal("profile", table, "-o", tool).out)
    page = tmp_path / "e.html"
    assert mwdcal("calibrate", table, "--tool", tool, "-o", made, "--report", page).code == 0
    text = page.read_text("utf-8")
    assert ">mg/g</td>" in text
    assert ">988.4 mg/g</td>" in text
    assert "raw/" not in text
    shown = mwdcal("convert", made, "--notation", "forward").out
    assert "accelerometer mg per g (nominal 988.4)" in shown
