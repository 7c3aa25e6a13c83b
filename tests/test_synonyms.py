"""Columns under other names: nothing is missed in silence, and nothing taken for what it is not."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cli_support import calibrated, mwdcal, numbers, read_csv, refused, servo_run, write_csv
from mwdcal.errors import FitError, InputError
from mwdcal.files import documents, synonyms
from mwdcal.files.contract import COLUMNS
from mwdcal.files.synonyms import (
    ABOVE,
    ANTICLOCKWISE,
    ANTICLOCKWISE_FROM_LOW_SIDE,
    BELOW,
    CONVERSIONS,
    FROM_LOW_SIDE,
    Resemblance,
    check_evidence,
    resembled,
    unused,
)
from mwdcal.geometry.observables import RESULTS
from mwdcal.identification.columns import proposed
from simulation import Tool

ALIKE = {
    "ref_inclination_deg": "Inc, INC, Incl, inclination, inclination_deg, ref_inc, Inclination(deg), IncDeg, "
    "refinc, Inclination [°], ref_inclination, Incl. (rad)",
    "ref_azimuth_deg": "Azi, azimuth, ref_azi, AZM, azimuth_true, Azi_mag, azimuth_deg, ref_az, az_deg, "
    "Heading, magnetic_azimuth, Azi (°), Grid Azimuth, True azimuth [deg]",
    "ref_toolface_deg": "HS, TF, toolface, Highside, HSTF, high_side, toolface_deg, ref_tf, TFdeg, GTF, "
    "ToolFace, Gravity Toolface, High Side (deg)",
    "ref_dip_deg": "dip, Dip, dip_deg, MagDip, Dip Angle, ref_dip, magnetic dip (°)",
    "ref_gravity_g": "Gtotal, GTotal, gravity, gravity_g, g_total, total_g, ref_g, Gt, local gravity, "
    "G_TOTAL, Gtotal (m/s²), Gtotal [mg]",
    "ref_field_nt": "Btotal, BTotal, field_nt, B_total, ref_b, ref_field, total_field, Bt, Htotal, Field (µT), "
    "Btotal (nT), mag field, Total Magnetic Field [nT], Field [gauss]",
    "temperature_c": "temp, temperature, Temp, temp_f, temp_c, tempC, TempF, T_C, DegC, tool_temp, Temp 1, "
    "board_temperature, BHT, T_sens, Oven temp, Chamber T, Temp 2, tmp, TBoard, ambient_temp, MWD Temp, Kanal 3 [°C], "
    "PT100 (degC), Ofentemperatur, boardtemp, temp max, Temp (°F), T (°C), "
    "Temperature (K), Tool Temp [degC], Temp ℉, TEMP ºC",
    "sd_ref_inclination_deg": "sd_inc, inclination_sd_deg, sigma Inc",
    "ax": "gx, gx_g, Acc X [V], accel_x",
    "mz": "bz, bz_nt, MagZ, Hz",
    "serial": "SN, Serial No",
}  # fmt: skip
PAIRS = [(name, column) for column, names in ALIKE.items() for name in names.split(", ")]
OTHERS = [
    name
    for line in (
        "station comment operator date time md_m time_s depth_m field well rig inc_count",
        "pressure azimuth_error dls toolface_mode remarks samples drift_temperature_c mtf gain bias",
        "magnetic_toolface_deg index run b g t a az i voltage current x y z Datum group_2",
        "declination_deg ref_notes sd_temp temp_notes temp_rate template attempt T1 mag_t total",
    )
    for name in line.split()
] + ["Roll (azimuth) deg", "Inclination (desired) deg"]


@pytest.mark.parametrize(("name", "column"), PAIRS, ids=[name for name, _ in PAIRS])
def test_names_that_resemble_a_column(name, column):
    found = resembled(name)
    assert found is not None
    assert found.column == column


@pytest.mark.parametrize("name", OTHERS)
def test_names_that_resemble_none(name):
    assert resembled(name) is None


UNITS = {
    "Temp (°F)": "°F", "temp_f": "°F", "tempF": "°F", "Temp ℉": "°F", "Temp (K)": "K", "Inc (rad)": "rad",
    "Gtotal [mg]": "mg", "Gtotal (m/s^2)": "m/s²", "Field (µT)": "µT", "Btotal_uT": "µT", "B_total (nT)": "nT",
}  # fmt: skip


@pytest.mark.parametrize(("name", "unit"), UNITS.items())
def test_the_unit_that_a_name_states(name, unit):
    assert resembled(name).unit == unit


def test_conversions_are_those_of_the_units():
    """Each rule, computed as it is printed, on values known otherwise."""
    known = {
        "°F": (212.0, 100.0), "K": (373.15, 100.0), "rad": (np.pi, 180.0), "mg": (998.0, 0.998),
        "m/s²": (9.80665, 1.0), "µT": (48.0, 48_000.0), "mT": (0.048, 48_000.0), "gauss": (0.48, 48_000.0),
        "mG": (480.0, 48_000.0), "gal": (980.665, 1.0), "mGal": (980_665.0, 1.0),
        "ft/s²": (32.17404855643045, 1.0),  # the standard gravity, in feet of 0.3048 m
        "A/m": (79.577471545947667, 100_000.0),  # an oersted, a gauss in air
        "gon": (100.0, 90.0), ABOVE: (-90.0, 0.0), BELOW: (90.0, 0.0),
        ANTICLOCKWISE: (90.0, -90.0), FROM_LOW_SIDE: (270.0, 90.0), ANTICLOCKWISE_FROM_LOW_SIDE: (90.0, 90.0),
    }  # fmt: skip
    assert known.keys() == CONVERSIONS.keys()
    for unit, (given_as, wanted) in known.items():
        left, _, rule = CONVERSIONS[unit].partition(" = ")
        assert left in ("°C", "°", "g", "nT")
        found = eval(
            rule.replace(unit, "x").replace("·", "*").replace("π", "np.pi"),
            {"x": given_as, "np": np},
        )
        assert found == pytest.approx(wanted)


@given(st.text(max_size=30))
def test_any_name_is_taken_or_left(name):
    found = resembled(name)
    assert found is None or isinstance(found, Resemblance)


@given(st.lists(st.sampled_from(COLUMNS), unique=True))
def test_the_contract_s_own_names_are_never_refused_nor_listed(names):
    check_evidence(names, "run.csv")
    assert unused(names, COLUMNS) == ()


@pytest.mark.parametrize(("name", "column"), PAIRS, ids=[name for name, _ in PAIRS])
def test_what_may_not_be_missed_is_refused_only_where_the_column_is_absent(name, column):
    names = ["ax", "ay", "az", name]
    if column in synonyms.NOTICED:
        with pytest.raises(InputError, match=column):
            check_evidence(names, "run.csv")
    else:
        check_evidence(names, "run.csv")
    check_evidence([*names, column], "run.csv")
    assert f"(resembles '{column}')" in unused(names, COLUMNS)[0]


def test_two_temperatures_are_asked_about_and_one_of_the_very_name_is_taken():
    with pytest.raises(
        InputError, match=r"'Temp 1'.*So does 'Temp 2': take the one nearest.*under \[columns\]"
    ):
        check_evidence(["ax", "ay", "az", "Temp 1", "Temp 2"], "run.csv")
    check_evidence(["ax", "ay", "az", "Temp 1", "temperature_c"], "run.csv")
    with pytest.raises(
        FitError, match="'Temp 1' and 'Temp 2' may each be the temperature of the tool"
    ):
        profile_columns("Temp 1", "Temp 2")
    assert profile_columns("Oven temp")["temperature_c"].name == "Oven temp"
    assert profile_columns("Oven temp", "temperature_c")["temperature_c"].name == "temperature_c"


def profile_columns(*temperatures):
    """The columns that `mwdcal profile` takes of a table with these besides the channels."""
    names = ["ax", "ay", "az", *temperatures]
    return proposed(names, [""] * len(names), lambda _: np.array([20.0, 30.0]), "run.csv")[0]


def test_results_of_apply_are_never_references():
    """All of them together are known for what they are; one alone was meant as a reference."""
    names = ["ax", "ay", "az", *RESULTS]
    check_evidence(names, "run.csv")
    assert all("a result of mwdcal apply" in shown for shown in unused(names, COLUMNS))
    with pytest.raises(InputError, match="ref_inclination_deg"):
        check_evidence(["ax", "ay", "az", "inclination_deg"], "run.csv")


# By the commands

RENAMED = {
    "ref_inclination_deg": "Inc", "ref_azimuth_deg": "Azi", "ref_toolface_deg": "HS", "ref_gravity_g": "Gtotal",
    "ref_field_nt": "Btotal", "ref_dip_deg": "Dip", "temperature_c": "Temp (°F)",
}  # fmt: skip


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    return calibrated(tmp_path_factory.mktemp("fit"), servo_run())


def renamed(columns, *which):
    return {RENAMED[name] if name in which else name: value for name, value in columns.items()}


@pytest.mark.parametrize("column", RENAMED)
@pytest.mark.parametrize("command", ["calibrate", "verify", "compare", "fleet"])
def test_a_resembling_column_is_refused_with_name_and_unit(tmp_path, calibration, command, column):
    columns = renamed(servo_run(seed=2), column)
    run = write_csv(tmp_path / "run.csv", columns)
    arguments = {
        "calibrate": (run, "-o", tmp_path / "out.json"),
        "verify": (calibration, run),
        "compare": (run,),
        "fleet": (tmp_path / "runs.parquet", "-o", tmp_path / "out.parquet"),
    }[command]
    if command == "fleet":
        arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
        parquet.write_table(
            arrow.table({**columns, "serial": ["A"] * 48}), tmp_path / "runs.parquet"
        )
    message = refused(mwdcal(command, *arguments), 2)
    assert f"'{RENAMED[column]}'" in message
    assert f"'{column}' ({synonyms.NOTICED[column]}" in message
    if column == "temperature_c":
        assert "°C = (°F - 32) · 5/9" in message
    assert not [*tmp_path.glob("out.*")]


def test_several_are_named_at_once(tmp_path):
    columns = renamed(servo_run(), "ref_inclination_deg", "ref_azimuth_deg")
    run = write_csv(tmp_path / "run.csv", columns)
    message = refused(mwdcal("calibrate", run, "-o", tmp_path / "cal.json"), 2)
    assert "'Inc' resembles 'ref_inclination_deg'" in message
    assert "Likewise 'Azi' (ref_azimuth_deg, °" in message


def test_unused_columns_are_listed_by_calibrate_verify_and_compare(tmp_path, calibration):
    also = {"Inc": np.zeros(48), "remarks": np.zeros(48), "time_s": np.arange(48.0)}
    wanted = "columns not used: 'Inc' (resembles 'ref_inclination_deg'), 'remarks'."
    run = write_csv(tmp_path / "run.csv", {**servo_run(), **also})
    made = tmp_path / "cal.json"
    roll = write_csv(tmp_path / "roll.csv", {**servo_run(seed=1, inclinations=(30,) * 4), **also})
    for arguments in (
        ("calibrate", run, "--tool", "servo", "-o", made),
        ("verify", calibration, roll),
        ("compare", run, "--tool", "servo", "--order", "0"),
    ):
        ran = mwdcal(*arguments, "--json")
        assert ran.code in (0, 1), ran.err
        assert [f["text"] for f in ran.json["findings"] if f["id"] == "unused-columns"] == [wanted]
        assert f"! {wanted}" in ran.err
    stored = json.loads(made.read_bytes())["findings"]
    assert [f["text"] for f in stored if f["id"] == "unused-columns"] == [wanted]
    said = mwdcal("calibrate", run, "--tool", "servo", "-o", made)
    assert (said.out + said.err).count(wanted) == 1


@pytest.mark.parametrize(
    ("cells", "used"),
    [
        ([f"2026-03-13 10:{k:02d}:00" for k in range(48)], True),
        ([f"13.03.2026 10:{k:02d}" for k in range(48)], True),
        ([f"10:{k:02d}:00" for k in range(48)], False),
        ([f"2026-03-{13 + k % 2} 10:00:00" for k in range(48)], False),
    ],
)
@pytest.mark.parametrize("name", ["time", "datetime"])
def test_a_column_of_times_that_gave_the_day_of_the_run_is_used(tmp_path, name, cells, used):
    run, made = write_csv(tmp_path / "run.csv", {**servo_run(), name: cells}), tmp_path / "cal.json"
    ran = mwdcal("calibrate", run, "--tool", "servo", "-o", made, "--json")
    assert ran.code == 0, ran.err
    assert (json.loads(made.read_bytes())["tool"].get("date") == "2026-03-13") == used
    assert ("columns not used" not in ran.err) == used


def test_a_table_of_the_contract_alone_has_no_such_finding(tmp_path):
    run = write_csv(tmp_path / "run.csv", servo_run())
    ran = mwdcal("calibrate", run, "--tool", "servo", "-o", tmp_path / "cal.json", "--json")
    assert "columns not used" not in ran.err
    assert "unused-columns" not in [f["id"] for f in ran.json["findings"]]


def test_a_fleet_lists_them_once(tmp_path):
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    columns = {
        **servo_run(),
        "serial": ["A"] * 24 + ["B"] * 24,
        "Inc": np.zeros(48),
        "lab": ["x"] * 48,
    }
    parquet.write_table(arrow.table(columns), tmp_path / "runs.parquet")
    out = tmp_path / "cals.parquet"
    ran = mwdcal(
        "fleet", tmp_path / "runs.parquet", "-o", out, "--tool", "servo", "--workers", 1, "--json"
    )
    assert ran.code == 0, ran.err
    wanted = "columns not used: 'Inc' (resembles 'ref_inclination_deg'), 'lab'."
    assert ran.err.count(wanted) == 1
    found = [f for f in ran.json["findings"] if f["id"] == "unused-columns"]
    assert found == [
        {"id": "unused-columns", "text": wanted, "station": None, "tools": 2, "serials": []}
    ]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_apply_lists_the_survey_s_own_angles_and_carries_them_through(
    tmp_path, calibration, suffix
):
    columns = renamed(servo_run(seed=1), "ref_inclination_deg", "ref_azimuth_deg", "ref_dip_deg")
    source = tmp_path / f"surveys{suffix}"
    if suffix == ".csv":
        write_csv(source, columns)
    else:
        arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
        parquet.write_table(arrow.table(columns), source)
    out = tmp_path / "out.csv"
    ran = mwdcal("apply", calibration, source, "-o", out, "--json")
    assert ran.code == 0, ran.err
    anonymous, found = ran.json["findings"]
    assert (anonymous["id"], found["id"]) == ("no-serial", "unused-columns")
    assert (
        "'Inc' (resembles 'ref_inclination_deg'), 'Azi' (resembles 'ref_azimuth_deg')"
        in found["text"]
    )
    assert found["text"] in ran.err
    np.testing.assert_array_equal(numbers(read_csv(out)["Azi"]), columns["Azi"])
    assert "columns not used" not in out.read_text("utf-8")


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_fahrenheit_is_never_taken_for_celsius(tmp_path, calibration, suffix):
    """Needed, it is refused with the rule; not needed, it is listed."""
    warm = calibrated(
        tmp_path, servo_run(toolfaces=4, temperatures=(20.0, 60.0, 100.0)), "--order", 1
    )
    columns = renamed(servo_run(seed=1, tool=Tool.random(1)), "temperature_c")
    source = tmp_path / f"surveys{suffix}"
    if suffix == ".csv":
        write_csv(source, columns)
    else:
        arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
        parquet.write_table(arrow.table(columns), source)
    out = tmp_path / f"out{suffix}"
    message = refused(mwdcal("apply", warm, source, "-o", out), 2)
    assert "'Temp (°F)' resembles 'temperature_c'" in message
    assert "°C = (°F - 32) · 5/9" in message
    assert not out.exists()
    ran = mwdcal("apply", calibration, source, "-o", out)
    assert ran.code == 0
    assert "'Temp (°F)' (resembles 'temperature_c')" in ran.err


def test_a_corrected_table_is_a_run_like_any_other(tmp_path, calibration):
    """Its results are carried along, and never taken for references."""
    source = write_csv(tmp_path / "run.csv", servo_run())
    corrected = tmp_path / "corrected.csv"
    assert mwdcal("apply", calibration, source, "-o", corrected).code == 0
    ran = mwdcal("calibrate", corrected, "--tool", "servo", "-o", tmp_path / "cal.json")
    assert ran.code == 0, ran.err
    assert "'inclination_deg' (a result of mwdcal apply)" in ran.err
    first, again = (documents.read(path) for path in (calibration, tmp_path / "cal.json"))
    assert first.accelerometer.parameters == again.accelerometer.parameters


def test_logs_list_them_too(tmp_path):
    """A log of two rests: `stations` and `noise` say what they do not use."""
    rng = np.random.default_rng(1)
    count = 4000
    move = np.where((np.arange(count) // 1000) % 2 == 1, 1.0, 0.0)[:, None]
    raw = np.array([0.1, 0.2, 0.97]) + 1e-3 * rng.normal(size=(count, 3))
    moved = raw + 0.3 * move * rng.normal(size=(count, 3))
    columns = {
        "time_s": np.arange(count) * 0.01,
        **dict(zip(("ax", "ay", "az"), moved.T, strict=True)),
    }
    log = write_csv(tmp_path / "log.csv", {**columns, "Temp (°F)": np.full(count, 70.0)})
    wanted = "columns not used: 'Temp (°F)' (resembles 'temperature_c')."
    ran = mwdcal("stations", log, "-o", tmp_path / "stations.csv", "--json")
    assert wanted in [f["text"] for f in ran.json["findings"] if f["id"] == "unused-columns"]
    assert wanted in ran.err
    still = {**columns, **dict(zip(("ax", "ay", "az"), raw.T, strict=True)), "TF": np.zeros(count)}
    ran = mwdcal("noise", write_csv(tmp_path / "still.csv", still), "--json")
    assert ran.code == 0, ran.err
    assert "'TF' (resembles 'ref_toolface_deg')" in ran.err
