"""`mwdcal apply`: the columns of the contract, against vectors and angles of a known tool."""

import json

import numpy as np
import pytest

from cli_support import (
    SCALE,
    calibrated,
    channels,
    mwdcal,
    numbers,
    read_csv,
    refused,
    servo_run,
    stations,
    write_csv,
)
from simulation import DEG, Tool, attitude

ADDED = [
    *("gx_g", "gy_g", "gz_g", "bx_nt", "by_nt", "bz_nt"),
    *("inclination_deg", "azimuth_deg", "toolface_deg", "gravity_g", "field_nt", "dip_deg"),
    "magnetic_toolface_deg",
    *(
        "sd_inclination_deg",
        "sd_azimuth_deg",
        "sd_toolface_deg",
        "sd_gravity_g",
        "sd_field_nt",
        "sd_dip_deg",
    ),
    "sd_magnetic_toolface_deg",
]
MAGNETIC = (
    "bx_nt",
    "by_nt",
    "bz_nt",
    "azimuth_deg",
    "field_nt",
    "dip_deg",
    "magnetic_toolface_deg",
    *("sd_azimuth_deg", "sd_field_nt", "sd_dip_deg", "sd_magnetic_toolface_deg"),
)
TOOL = Tool.random(4, noise=(1e-12, 1e-7))
SURVEYS = [  # inclination, azimuth, toolface
    (0.5, 359.0, 10.0),
    (33.0, 12.0, 200.0),
    (90.0, 123.0, 359.0),
    (120.0, 270.0, 45.0),
    (179.0, 1.0, 90.0),
]


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    """A tool calibrated without noise to speak of: what it corrects is the truth."""
    return calibrated(tmp_path_factory.mktemp("fit"), servo_run(tool=TOOL))


@pytest.fixture(scope="module")
def warm(tmp_path_factory):
    """A calibration of order 1 over 0…50 °C."""
    run = servo_run(tool=TOOL, temperatures=(0.0, 50.0))
    return calibrated(tmp_path_factory.mktemp("warm"), run, "--order", 1)


def surveys(temperature=25.0, tool=TOOL):
    inc, azi, face = np.radians(SURVEYS).T
    g, b = tool.clean(inc, azi, face)
    warmth = np.broadcast_to(np.asarray(temperature, float), inc.shape)
    run = {"station": [f"S{i}" for i in range(len(inc))], "temperature_c": warmth}
    return {**run, **channels(g, b)}


def applied(folder, calibration, columns, *options, name="out.csv"):
    source = write_csv(folder / "surveys.csv", columns)
    ran = mwdcal("apply", calibration, source, "-o", folder / name, *options)
    assert ran.code == 0, ran
    return ran, folder / name


def test_vectors_angles_and_strengths_are_those_of_the_attitude(tmp_path, calibration):
    _, path = applied(tmp_path, calibration, surveys())
    found = {k: numbers(v) for k, v in read_csv(path).items() if k != "station"}
    inc, azi, face = np.radians(SURVEYS).T
    g, b = attitude(inc, azi, face)(TOOL.gravity, TOOL.field, TOOL.dip)
    for index, axis in enumerate("xyz"):
        np.testing.assert_allclose(found[f"g{axis}_g"], g[:, index], atol=1e-9)
        np.testing.assert_allclose(found[f"b{axis}_nt"], b[:, index], atol=1e-4)
    wanted = dict(zip(("inclination", "azimuth", "toolface"), np.transpose(SURVEYS), strict=True))
    for name, value in wanted.items():
        np.testing.assert_allclose(found[f"{name}_deg"], value, atol=1e-6)
    np.testing.assert_allclose(found["gravity_g"], TOOL.gravity, atol=1e-9)
    np.testing.assert_allclose(found["field_nt"], TOOL.field, atol=1e-4)
    np.testing.assert_allclose(found["dip_deg"], TOOL.dip / DEG, atol=1e-6)
    magnetic = np.degrees(np.arctan2(b[:, 0], b[:, 1])) % 360
    np.testing.assert_allclose(found["magnetic_toolface_deg"], magnetic, atol=1e-6)


def test_the_order_of_the_columns_is_that_of_the_contract(tmp_path, calibration):
    _, path = applied(tmp_path, calibration, surveys())
    assert list(read_csv(path)) == [*surveys(), *ADDED]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_standard_uncertainty_stands_beside_what_it_leaves_out(tmp_path, calibration, suffix):
    """On screen, in JSON and in the table; without `sd_` columns there is nothing to say it of."""
    source = write_csv(tmp_path / "in.csv", surveys())
    left_out = ("interference of the drill string", "drift of the sensors", "sag", "misalignment")
    out = tmp_path / f"out{suffix}"
    ran = mwdcal("apply", calibration, source, "-o", out)
    document = json.loads(mwdcal("apply", calibration, source, "-o", out, "--json").out)
    table = out.read_bytes().decode("utf-8", "replace")
    for told in (ran.out, " ".join(document["not_included"]), table):
        assert all(name in " ".join(told.split()) for name in left_out)
    assert document["error_terms"] == ["calibration", "noise"]
    plain = mwdcal("apply", calibration, source, "-o", out, "--no-uncertainty")
    assert "1σ" not in plain.out
    assert b"not_included" not in out.read_bytes()


def test_input_columns_of_a_text_table_keep_every_character(tmp_path, calibration):
    run = {k: list(v) for k, v in surveys().items()}
    run["ax"] = [f"{v:+.14e}" for v in run["ax"]]
    run["temperature_c"] = ["25", "25.0", "+25.000", "2.5E1", ".25e2"]
    extra = {
        "station": ["007", "S 1", "", 'say "so"', "a, b"],
        "remark": ["", "0010", "1e3", "1/2", "30 °C; ok"],
        "lot": ["1.50", "1.5", "", "-0", "+1"],
    }
    source = {**extra, **{k: v for k, v in run.items() if k != "station"}}
    _, path = applied(tmp_path, calibration, source)
    found, given = read_csv(path), read_csv(tmp_path / "surveys.csv")
    assert {k: found[k] for k in given} == given


@pytest.mark.parametrize("suffix", [".tsv", ".parquet", ".xlsx"])
def test_every_format_holds_the_same_values(tmp_path, calibration, suffix):
    _, csv_path = applied(tmp_path, calibration, surveys())
    wanted = read_csv(csv_path)
    _, path = applied(tmp_path, calibration, surveys(), name=f"out{suffix}")
    if suffix == ".tsv":
        rows = [s.split("\t") for s in path.read_text().splitlines() if not s.startswith("#")]
    elif suffix == ".parquet":
        table = pytest.importorskip("pyarrow.parquet").read_table(path)
        rows = [table.column_names, *zip(*table.to_pydict().values(), strict=True)]
    else:
        book = pytest.importorskip("openpyxl").load_workbook(path)
        whole = [[c for c in row if c is not None] for row in book.active.values]
        start = next(i for i, row in enumerate(whole) if row and row[0] == "station")
        rows = whole[start:]
    assert list(rows[0]) == list(wanted)
    for index, name in enumerate(wanted):
        cells = [row[index] for row in rows[1:]]
        if name == "station":
            assert cells == wanted[name]
        else:
            np.testing.assert_array_equal(np.array(cells, float), numbers(wanted[name]))


def test_a_decimal_comma_in_gives_points_out(tmp_path, calibration):
    run = {
        k: [v.replace(".", ",") if k != "station" else v for v in map(str, c)]
        for k, c in surveys().items()
    }
    source = write_csv(tmp_path / "s.csv", run, delimiter=";")
    out = tmp_path / "out.csv"
    assert mwdcal("apply", calibration, source, "-o", out, "--decimal", ",").code == 0
    found = read_csv(out)
    np.testing.assert_allclose(
        numbers(found["inclination_deg"]), np.array(SURVEYS)[:, 0], atol=1e-6
    )
    np.testing.assert_array_equal(numbers(found["ax"]), surveys()["ax"])


@pytest.fixture(scope="module")
def perfect(tmp_path_factory, calibration):
    """The calibration of a perfect tool: gain one, no offset."""
    document = json.loads(calibration.read_bytes())
    for name in ("accelerometer", "magnetometer"):
        document[name]["parameters"] = [*np.eye(3).ravel().tolist(), 0.0, 0.0, 0.0]
    path = tmp_path_factory.mktemp("perfect") / "cal.json"
    path.write_text(json.dumps(document))
    return path


def test_exactly_vertical_readings_have_no_azimuth_and_no_toolface(tmp_path, perfect):
    b = np.array([[10_000.0, 10_000.0, 40_000.0], [-20_000.0, 0.0, -30_000.0]])
    g = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    run = {"temperature_c": np.full(2, 25.0), **channels(g, b)}
    _, path = applied(tmp_path, perfect, run)
    found = read_csv(path)
    assert found["azimuth_deg"] == found["toolface_deg"] == ["", ""]
    np.testing.assert_array_equal(numbers(found["inclination_deg"]), [0.0, 180.0])
    np.testing.assert_allclose(numbers(found["magnetic_toolface_deg"]), [45.0, 270.0], atol=1e-9)
    dip = np.degrees(np.arctan2([40_000.0, 30_000.0], [np.hypot(1e4, 1e4), 2e4]))
    np.testing.assert_allclose(numbers(found["dip_deg"]), dip, atol=1e-9)


OUTSIDE = [-20.0, -0.9, 25.0, 50.9, 52.0]


def test_readings_outside_the_calibrated_temperatures_are_blank(tmp_path, warm):
    ran, path = applied(tmp_path, warm, surveys(OUTSIDE))
    found = read_csv(path)
    for name in ADDED:
        assert [cell == "" for cell in found[name]] == [True, False, False, False, True]
    assert "! 2 of 5 rows lie outside the calibrated range 0.0…50.0 °C" in ran.err
    assert found["station"] == surveys()["station"]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_rows_whose_uncertainty_lacks_the_drift_with_temperature_are_named(
    tmp_path, calibration, suffix
):
    """Of a calibration at 25 °C; by the datasheet of a servo instrument 100 µg/√3 for each degree, beside 1 g."""
    near, _ = applied(tmp_path, calibration, surveys([24.1, 25.0, 25.4, 25.9, 24.9]))
    assert "!" not in near.err.replace("! no serial", "")
    out = tmp_path / f"out{suffix}"
    source = write_csv(tmp_path / "warm.csv", surveys([25.0, 25.9, 27.0, 29.9, 20.5]))
    ran = mwdcal("apply", calibration, source, "-o", out)
    turn = np.degrees(np.arctan(100e-6 / np.sqrt(3) * 4.9))
    assert "! 3 of 5 rows lie outside the calibrated range 25.0…25.0 °C by up to 4.9 °C." in ran.err
    assert f"1σ contains no drift over the difference: about {turn:.4f}° of inclination" in ran.err
    assert "drift of the sensors with temperature" in ran.out
    assert "3 of 5 rows" in out.read_bytes().decode("utf-8", "replace")


def test_rows_beyond_the_soak_are_blank_and_those_within_it_drift(tmp_path, calibration):
    ran, path = applied(tmp_path, calibration, surveys([25.0, 28.0, 31.0, 25.0, 10.0]))
    assert [cell == "" for cell in read_csv(path)["sd_gravity_g"]] == [
        *2 * (False,),
        True,
        False,
        True,
    ]
    assert (
        "2 of 5 rows lie outside the calibrated range 25.0…25.0 °C: their results are blank"
        in ran.err
    )
    assert "1 of 5 rows lie outside the calibrated range 25.0…25.0 °C by up to" in ran.err


def test_temperature_terms_are_in_the_uncertainty(tmp_path, warm):
    ran, _ = applied(tmp_path, warm, surveys([-0.9, 0.0, 25.0, 50.0, 50.9]))
    assert "outside the calibrated range" not in ran.err
    assert "with temperature" not in ran.out


def test_readings_outside_may_be_extrapolated(tmp_path, warm):
    ran, path = applied(tmp_path, warm, surveys(OUTSIDE), "--outside", "extrapolate", "--json")
    assert all(numbers(read_csv(path)["inclination_deg"]) >= 0)
    assert [f["id"] for f in ran.json["findings"]] == ["no-serial", "outside-temperature"]
    assert "extrapolated, with no statement of accuracy" in ran.err


def test_readings_outside_may_be_refused(tmp_path, warm):
    source = write_csv(tmp_path / "s.csv", surveys(OUTSIDE))
    out = tmp_path / "out.csv"
    message = refused(mwdcal("apply", warm, source, "-o", out, "--outside", "refuse"), 2)
    assert "2 of 5 rows lie outside" in message
    assert not out.exists()
    assert refused(mwdcal("apply", warm, source, "-o", out, "--outside", "guess"), 2)


@pytest.mark.parametrize("column", ["missing", "blank"])
def test_temperature_terms_need_temperatures(tmp_path, warm, column):
    run = {**surveys(), "temperature_c": [""] * 5}
    if column == "missing":
        del run["temperature_c"]
    source, out = write_csv(tmp_path / "s.csv", run), tmp_path / "out.csv"
    message = refused(mwdcal("apply", warm, source, "-o", out), 2)
    assert "'temperature_c' is missing or blank" in message
    assert not out.exists()


def test_without_temperature_terms_no_temperatures_are_needed(tmp_path, calibration):
    run = {k: v for k, v in surveys().items() if k != "temperature_c"}
    _, path = applied(tmp_path, calibration, run)
    inclination = numbers(read_csv(path)["inclination_deg"])
    np.testing.assert_allclose(inclination, np.array(SURVEYS)[:, 0], atol=1e-6)


@pytest.mark.parametrize("how", ["missing", "blank"])
def test_readings_without_magnetometer_have_blank_magnetic_results(tmp_path, calibration, how):
    run = surveys()
    for name in ("mx", "my", "mz"):
        run[name] = np.full(5, np.nan)
        if how == "missing":
            del run[name]
    ran, path = applied(tmp_path, calibration, run)
    found = read_csv(path)
    for name in ADDED:
        assert (found[name] == [""] * 5) == (name in MAGNETIC)
    assert "! no columns mx, my, mz: magnetic results are blank." in ran.err


def test_a_tool_calibrated_without_magnetometer_gives_no_magnetic_results(tmp_path):
    run = {k: v for k, v in servo_run(tool=TOOL).items() if not k.startswith("m")}
    _, path = applied(tmp_path, calibrated(tmp_path, run), surveys())
    found = read_csv(path)
    for name in ADDED:
        assert (found[name] == [""] * 5) == (name in MAGNETIC)


def test_a_field_known_nowhere_is_one_and_said_so(tmp_path):
    run = servo_run(tool=TOOL)
    del run["ref_field_nt"]
    ran, path = applied(tmp_path, calibrated(tmp_path, run), surveys())
    np.testing.assert_allclose(numbers(read_csv(path)["field_nt"]), 1.0, atol=1e-8)
    assert "relative, not nT" in ran.err
    assert '# field_unit = "relative (field = 1)"' in path.read_text("utf-8")


def test_undetermined_outputs_are_named(tmp_path):
    run = servo_run(tool=TOOL)
    del run["ref_toolface_deg"]
    ran, _ = applied(tmp_path, calibrated(tmp_path, run), surveys(), "--json")
    texts = " ".join(f["text"] for f in ran.json["findings"])
    assert "toolface" in texts
    assert "inclination" not in texts


def test_a_column_of_the_user_is_never_overwritten(tmp_path, calibration):
    source = write_csv(tmp_path / "s.csv", {**surveys(), "inclination_deg": np.arange(5.0)})
    out = tmp_path / "out.csv"
    message = refused(mwdcal("apply", calibration, source, "-o", out), 2)
    assert "'inclination_deg' is there already" in message
    assert not out.exists()


def test_outputs_that_cannot_be_written(tmp_path, calibration):
    source = write_csv(tmp_path / "s.csv", surveys())
    before = calibration.read_bytes()
    (tmp_path / "folder.csv").mkdir()
    for out in ("no/out.csv", "out", "out.txt", "folder.csv"):
        refused(mwdcal("apply", calibration, source, "-o", tmp_path / out), 2)
    refused(mwdcal("apply", calibration, source, "-o", calibration), 2)
    assert calibration.read_bytes() == before


def test_a_single_reading_and_many(tmp_path, calibration):
    one = {k: v[:1] for k, v in surveys().items()}
    _, path = applied(tmp_path, calibration, one)
    assert numbers(read_csv(path)["azimuth_deg"]) == pytest.approx([359.0], abs=1e-6)
    rng = np.random.default_rng(0)
    inc, azi, face = rng.uniform(0.1, 3, (3, 20_000))
    g, b = TOOL.clean(inc, azi, face)
    many = {**stations(inc, azi, face), **channels(g, b)}
    ran, path = applied(tmp_path, calibration, many, name="many.csv")
    assert ran.out.startswith("20000 rows corrected")
    np.testing.assert_allclose(numbers(read_csv(path)["inclination_deg"]), inc / DEG, atol=1e-5)
    least, largest = inc.min() / DEG, inc.max() / DEG
    assert f"inclination {least:.2f}° to {largest:.2f}°" in ran.out


def test_zero_readings_give_no_numbers_out_of_thin_air(tmp_path, perfect):
    """No field at all: strengths of zero, and no direction that would look like one."""
    zero, sound = np.zeros((2, 3)), np.eye(3)
    g, b = np.concatenate([zero, sound]), np.concatenate([zero, 50_000.0 * sound])
    run = {"temperature_c": np.full(5, 25.0), **channels(g, b)}
    ran, path = applied(tmp_path, perfect, run)
    assert "2 of 5 rows: corrected gravity is 0 g" in ran.err
    found = read_csv(path)
    assert numbers(found["gravity_g"])[:2].tolist() == [0.0, 0.0]
    for name in ADDED:
        if name.endswith("_deg"):
            assert found[name][:2] == ["", ""]


def test_huge_readings_raise_no_warning(tmp_path, calibration):
    run = surveys()
    run["ax"], run["mz"] = run["ax"].copy(), run["mz"].copy()
    run["ax"][:2], run["mz"][:2] = 1e15, -1e15
    _, path = applied(tmp_path, calibration, run)
    assert (numbers(read_csv(path)["gravity_g"])[:2] > 1e14 / SCALE[0]).all()
