"""Runs: every conversion of unit and axis, checked against the same thing written by hand."""

import hashlib
import os
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mwdcal.calibration.readings import Readings
from mwdcal.errors import InputError
from mwdcal.files.contract import RAW, faults
from mwdcal.files.formats.table import SUFFIXES, Table, write
from mwdcal.files.profiles import built_in, load_profile
from mwdcal.files.runs import check_run, from_readings, read_run, to_readings
from mwdcal.sensor.profile import Profile, StandProfile, TriadProfile

DATA = os.environ.get("MWDCAL_DATA", "")
BARE = Profile(
    name="bare", accelerometer=TriadProfile(scale=2.0), magnetometer=TriadProfile(scale=0.5)
)
TURNED = Profile(
    name="turned",
    accelerometer=TriadProfile(axes=("-z", "+x", "-y"), scale=2.0, noise=0.02, repeatability=0.03),
    magnetometer=TriadProfile(axes=("+y", "+z", "+x"), scale=0.5),
    stand=StandProfile(inclination_deg=0.01),
)


def run(metadata=None, **columns):
    """A table of text cells; the raw channels are 1, 2, 3 unless given."""
    count = len(next(iter(columns.values()), ["1"]))
    raw = {name: [str(i)] * count for i, name in enumerate(("ax", "ay", "az"), 1)}
    return Table(raw | columns, metadata or {}, "run.csv", range(2, count + 2))


def read(profile=BARE, metadata=None, **columns):
    return to_readings(run(metadata, **columns), profile)[0]


def test_channels_become_nominal_readings_along_the_tool_axes():
    got = read(TURNED, mx=["5"], my=["7"], mz=["-9"])
    # ax = 1 measures -z, ay = 2 measures +x, az = 3 measures -y; 2 raw units are 1 g.
    np.testing.assert_array_equal(got.accelerometer, [[1.0, -1.5, -0.5]])
    np.testing.assert_array_equal(got.magnetometer, [[-18.0, 10.0, 14.0]])
    assert got.count == 1
    assert got.source == "run.csv"


def test_the_servo_accelerometers_of_the_paper_read_what_holds_the_tool_up():
    profile = load_profile("moosavi-servo")[0]
    hanging = read(profile, ax=["0", "3", "0"], ay=["0", "0", "3"], az=["-3", "0", "0"])
    # Vertical, then with the axis of A up, then with the axis of B up; gravity points down.
    np.testing.assert_array_equal(hanging.accelerometer, -np.eye(3)[[2, 0, 1]] * [1, 1, -1])


def test_references_become_radians_and_keep_blanks():
    got = read(
        ref_inclination_deg=["90", ""],
        ref_azimuth_deg=["-90", "360"],
        ref_toolface_deg=["-30", "45"],
        ref_dip_deg=["", "-60"],
        ref_gravity_g=["0.9987", ""],
        ref_field_nt=["50000", ""],
    )
    np.testing.assert_allclose(got.known["inclination"], [np.pi / 2, np.nan], rtol=1e-15)
    np.testing.assert_allclose(got.known["azimuth"], [1.5 * np.pi, 0.0], rtol=1e-15)
    np.testing.assert_allclose(got.known["toolface"], [np.deg2rad(330), np.pi / 4], rtol=1e-15)
    np.testing.assert_allclose(got.known["dip"], [np.nan, -np.pi / 3], rtol=1e-15)
    np.testing.assert_array_equal(got.known["gravity"], [0.9987, np.nan])
    np.testing.assert_array_equal(got.known["field"], [50000, np.nan])


def test_a_blank_column_is_no_reference():
    got = read(ref_dip_deg=["", " "], temperature_c=["", ""], group=["", ""])
    assert dict(got.known) == {}
    assert got.temperature is None
    assert got.group is None


@pytest.mark.parametrize(
    ("metadata", "magnetic"),
    [
        ({}, 10.0),
        ({"azimuth_reference": "magnetic", "declination_deg": 3.0}, 10.0),
        ({"declination_deg": 3.0, "convergence_deg": 1.0}, 10.0),
        ({"azimuth_reference": "true", "declination_deg": 3}, 7.0),
        ({"azimuth_reference": True, "declination_deg": 3}, 7.0),
        ({"azimuth_reference": "grid", "declination_deg": 3.0, "convergence_deg": 1.5}, 8.5),
        ({"azimuth_reference": "true", "declination_deg": 25.0}, 345.0),
    ],
)
def test_azimuths_become_magnetic(metadata, magnetic):
    got = read(metadata=metadata, ref_azimuth_deg=["10"])
    np.testing.assert_allclose(np.rad2deg(got.known["azimuth"]), [magnetic], rtol=1e-14)
    again = to_readings(from_readings(got, BARE), BARE)[0]
    np.testing.assert_allclose(again.known["azimuth"], got.known["azimuth"], rtol=1e-14)


def test_uncertainties_of_the_triads():
    got = read(TURNED, sd_ax=["0.04", ""], mx=["1", "1"], my=["1", "1"], mz=["1", "1"])
    full, profile = np.hypot(0.04, 0.03), np.hypot(0.02, 0.03)
    # ax measures z: its own uncertainty comes out there; blank cells are the profile's.
    expected = np.array([[profile, profile, full], [profile, profile, profile]]) / 2.0
    np.testing.assert_allclose(got.sd["accelerometer"], expected, rtol=1e-15)
    assert "magnetometer" not in got.sd


def test_uncertainties_stated_nowhere_are_left_to_the_fit():
    assert dict(read().sd) == {}
    assert dict(read(sd_ax=[""], sd_ay=[""]).sd) == {}


@pytest.mark.parametrize(
    ("columns", "place"),
    [
        ({"sd_ax": ["1", "1"]}, "line 2, column 'sd_ay': must be filled in; got no such column"),
        (
            {"sd_ax": ["1", ""], "sd_ay": ["1", "1"], "sd_az": ["1", "1"]},
            "line 3, column 'sd_ax': must be filled in; got a blank cell",
        ),
    ],
)
def test_uncertainties_of_some_channels_only(columns, place):
    with pytest.raises(InputError) as caught:
        read(**columns)
    assert str(caught.value).startswith(f"run.csv, {place}")
    assert "or state `noise` under [accelerometer]" in str(caught.value)


def test_uncertainties_of_references():
    got = read(
        TURNED,
        ref_inclination_deg=["10", "20"],
        ref_toolface_deg=["10", "20"],
        sd_ref_inclination_deg=["", "0.5"],
        sd_ref_gravity_g=["1e-5", "1e-5"],
        sd_ref_dip_deg=["1", "1"],
    )
    np.testing.assert_allclose(got.sd["inclination"], np.deg2rad([0.01, 0.5]), rtol=1e-15)
    np.testing.assert_array_equal(got.sd["gravity"], [1e-5, 1e-5])
    assert set(got.sd) == {"accelerometer", "inclination", "gravity"}  # no dip, no stand toolface


def test_an_unknown_scale_is_taken_from_the_readings():
    turns = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    raw = {
        "ax": 300.0 + 120.0 * np.cos(turns),
        "ay": -40.0 + 120.0 * np.sin(turns),
        "az": np.zeros(12),
        "mx": 7.0 + 25.0 * np.cos(turns),
        "my": 25.0 * np.sin(turns),
        "mz": np.zeros(12),
    }
    unknown = load_profile()[0]
    readings, profile = to_readings(Table(raw), unknown)
    assert profile.accelerometer.scale == pytest.approx(120.0)
    assert profile.magnetometer.scale == pytest.approx(25.0)
    np.testing.assert_allclose(readings.accelerometer[0], [3.5, -1 / 3, 0.0], atol=1e-12)
    known = {"ref_gravity_g": np.full(12, 0.5), "ref_field_nt": np.where(turns > 1, 5e4, np.nan)}
    profile = to_readings(Table(raw | known), unknown)[1]
    assert profile.accelerometer.scale == pytest.approx(240.0)
    assert profile.magnetometer.scale == pytest.approx(25.0 / 5e4)


@pytest.mark.parametrize("inclinations", [(5, 45, 90, 135), (0, 45, 90), (60, 90, 120), (40, 50)])
def test_an_unknown_scale_is_that_of_a_sphere_wherever_its_middle_is(inclinations):
    """Half way between the least and the largest reading of a channel lies off the centre of their sphere."""
    inc = np.repeat(np.radians(inclinations), 8)
    face = np.tile(np.arange(8) * np.pi / 4, len(inclinations))
    unit = np.stack([-np.sin(inc) * np.sin(face), -np.sin(inc) * np.cos(face), np.cos(inc)], -1)
    raw = 3.0 * unit + [2.5, 2.4, 2.6]
    columns = {
        name: list(map(repr, values.tolist())) for name, values in zip(RAW, raw.T, strict=False)
    }
    _, profile = to_readings(run(**columns), Profile(name="x"))
    assert profile.accelerometer.scale == pytest.approx(3.0, rel=1e-9)


def test_a_stated_scale_is_kept_also_where_the_field_is_unknown():
    columns = {name: ["1", "2"] for name in ("mx", "my", "mz")}
    assert to_readings(run(**columns), BARE)[1] == BARE


@pytest.mark.parametrize(("value", "scale"), [("0", 1.0), ("2", np.sqrt(12.0))])
def test_readings_that_never_move_still_have_a_scale(value, scale):
    columns = {name: [value] for name in ("ax", "ay", "az")}
    assert to_readings(run(**columns), load_profile()[0])[1].accelerometer.scale == scale


def test_groups_are_numbered_in_order_of_appearance():
    got = read(group=["", "B", "A", " B ", "C"])
    np.testing.assert_array_equal(got.group, [-1, 0, 1, 0, 2])
    assert got.group.dtype == int


def test_stations_without_a_label_are_numbered():
    assert read(ax=["1", "2"]).station == ("1", "2")
    assert read(station=["top", " ", "x "]).station == ("top", "2", "x")


def test_digests_are_of_the_raw_reading():
    got = read(temperature_c=["25"], mx=["4"], my=["5"], mz=["6.5"])
    assert got.digest == (
        f"{hashlib.sha256(b'1,2,3').hexdigest()[:16]}-{hashlib.sha256(b'4,5,6.5').hexdigest()[:16]}",
    )
    assert read().digest == (hashlib.sha256(b"1,2,3").hexdigest()[:16],)
    assert read(ax=["-0"]).digest == read(ax=["0.0"]).digest
    assert read(ax=["1.0000000000001"]).digest == read().digest
    assert read(TURNED).digest == read(BARE).digest


def test_a_magnetometer_without_readings_is_absent():
    assert read().magnetometer is None
    blank = {name: ["", ""] for name in ("mx", "my", "mz", "sd_mx")}
    assert read(**blank).magnetometer is None


def test_other_columns_are_the_users_own():
    got = read(operator=["me"], inclination_deg=["1000"], sd_temperature_c=["x"], ax_v=["9"])
    assert got.count == 1


def test_a_dead_channel_is_read():
    assert read(ax=["1"] * 5).count == 5


@st.composite
def runs(draw):
    """Readings with every optional part present or absent, and a profile."""
    count = draw(st.integers(1, 4))
    profile = draw(
        st.sampled_from([TURNED, BARE, *(load_profile(n)[0] for n in built_in("profiles"))])
    )

    def numbers(low, high, shape=(count,), blank=False):
        element = st.floats(low, high, allow_subnormal=False)
        return draw(arrays(float, shape, elements=element | st.just(np.nan) if blank else element))

    def maybe(make):
        return make() if draw(st.booleans()) else None

    triad = (count, 3)
    magnetometer = maybe(lambda: numbers(-1e5, 1e5, triad))
    temperature = maybe(lambda: numbers(-40, 200))
    known = {
        "inclination": maybe(lambda: numbers(0, np.pi, blank=True)),
        "azimuth": maybe(lambda: numbers(0, 6.28, blank=True)),
        "toolface": maybe(lambda: numbers(0, 6.28, blank=True)),
        "gravity": maybe(lambda: numbers(0.9, 1.1, blank=True)),
        "field": maybe(lambda: numbers(2e4, 7e4, blank=True)),
        "dip": maybe(lambda: numbers(-np.pi / 2, np.pi / 2, blank=True)),
    }
    known = {k: v for k, v in known.items() if v is not None and not np.isnan(v).all()}
    scales = {
        kind: msgspec.structs.replace(getattr(profile, kind), scale=draw(st.sampled_from(SCALES)))
        for kind in ("accelerometer", "magnetometer")
    }
    profile = msgspec.structs.replace(profile, **scales)

    def noise(triad):
        """Nominal noise, never below the repeatability that is part of it."""
        return np.hypot(numbers(1e-3, 0.2, (count, 3)), triad.repeatability) / triad.scale

    sd = {"accelerometer": maybe(lambda: noise(profile.accelerometer))}
    if magnetometer is not None:
        sd["magnetometer"] = maybe(lambda: noise(profile.magnetometer))
    sd |= {name: maybe(lambda: numbers(1e-4, 0.01)) for name in known}
    readings = Readings(
        accelerometer=numbers(-2, 2, triad),
        magnetometer=magnetometer,
        temperature=temperature,
        known=known,
        sd={name: value for name, value in sd.items() if value is not None},
        group=maybe(lambda: np.arange(count) // 2),
        station=tuple(f"s{i}" for i in range(count)),
    )
    return readings, profile


TINY = 1e-290  # below it doubles lose digits
SCALES = [1.0, 3.0, 5e-5, 1234.5]


@pytest.mark.parametrize("suffix", SUFFIXES)
@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(case=runs())
def test_a_written_run_is_read_as_it_was(tmp_path, suffix, case):
    readings, profile = case
    path = tmp_path / f"run{suffix}"
    write(path, from_readings(readings, profile, {"serial": "7"}))
    again, same = read_run(path, profile)
    assert same == profile
    assert again.station == readings.station
    assert again.metadata == {"serial": "7"}

    def close(got, want):
        assert (got is None) == (want is None)
        if want is not None:
            np.testing.assert_allclose(got, want, rtol=1e-15, atol=TINY)

    close(again.accelerometer, readings.accelerometer)
    close(again.magnetometer, readings.magnetometer)
    close(again.temperature, readings.temperature)
    close(again.group, readings.group)
    assert set(again.known) == set(readings.known)
    for name, value in readings.known.items():
        np.testing.assert_allclose(again.known[name], value, rtol=1e-15, atol=TINY)
    for name, value in readings.sd.items():  # the quadrature of repeatability costs digits
        np.testing.assert_allclose(again.sd[name], value, rtol=1e-11)


@pytest.mark.parametrize("profile", [BARE, TURNED, load_profile("moosavi-servo")[0]])
def test_digests_survive_writing(tmp_path, profile):
    raw = np.random.default_rng(1).normal(size=(50, 3))
    table = Table(dict(zip(("ax", "ay", "az"), raw.T, strict=True)))
    readings = to_readings(table, profile)[0]
    write(tmp_path / "run.csv", from_readings(readings, profile))
    assert read_run(tmp_path / "run.csv", profile)[0].digest == readings.digest


def test_what_the_profile_states_is_not_written():
    got = read(TURNED, ref_inclination_deg=["10"])
    assert not [name for name in from_readings(got, TURNED).columns if name.startswith("sd_")]


def test_angles_at_the_ends_of_their_range_survive():
    known = {"inclination": np.array([np.pi, 0.0]), "dip": np.array([np.pi / 2, -np.pi / 2])}
    readings = Readings(accelerometer=np.ones((2, 3)), known=known)
    again = to_readings(from_readings(readings, BARE), BARE)[0]
    for name, value in known.items():
        np.testing.assert_allclose(again.known[name], value, rtol=1e-15)


def dips(readings):
    """Dip of each station after centring: the angle between two centred readings."""
    g, b = (
        v - (v.max(axis=0) + v.min(axis=0)) / 2
        for v in (readings.accelerometer, readings.magnetometer)
    )
    unit = (g * b).sum(axis=-1) / np.linalg.norm(g, axis=-1) / np.linalg.norm(b, axis=-1)
    return np.rad2deg(np.arcsin(unit))


@pytest.mark.skipif(not DATA, reason="measured data: set MWDCAL_DATA to their folder")
@pytest.mark.parametrize("tool", ["sap5", "sap6"])
def test_measured_sets_have_one_dip_in_the_axes_of_their_profile(tool):
    for path in sorted((Path(DATA) / tool).glob("*.csv")):
        readings = read_run(path, load_profile(tool)[0])[0]
        assert readings.count == 24
        assert np.median(dips(readings)) == pytest.approx(67.0, abs=3.0)
        assert dips(readings).std() < 5.0
        assert list(np.unique(readings.group)) == [-1, 0, 1]


@pytest.mark.skipif(not DATA, reason="measured data: set MWDCAL_DATA to their folder")
@pytest.mark.parametrize("name", ["distox_cal1_raw.csv", "distox_cal2_raw.csv"])
def test_the_distox_lies_level_with_its_display_up_at_toolface_zero(name):
    counts = np.loadtxt(Path(DATA) / "distox" / name, delimiter=",", skiprows=1)[:, 1:]
    columns = dict(zip(("ax", "ay", "az", "mx", "my", "mz"), counts.T, strict=True))
    readings = to_readings(Table(columns), load_profile("distox")[0])[0]
    assert np.median(dips(readings)) == pytest.approx(67.8, abs=1.0)
    gx, gy, gz = readings.accelerometer[12:16].T  # level, four quarter turns to the right
    toolface = np.rad2deg(np.arctan2(-gx, -gy)) % 360.0
    turned = (toolface - [0.0, 90.0, 180.0, 270.0] + 180.0) % 360.0 - 180.0
    assert np.abs(turned).max() < 10.0
    assert np.abs(gz).max() < 0.15  # of which 0.1 g is the bias of the long axis


def tools(serials, **metadata):
    return run(metadata, serial=serials)


@pytest.mark.parametrize(
    ("table", "serial"),
    [
        (tools(["", " A 7 ", "A 7"]), "A 7"),
        (tools(["7", "7"], serial=7), "7"),
        (tools(["", ""], serial="B"), "B"),
        (run({"serial": 7}), 7),
        (tools(["", ""]), None),
    ],
)
def test_the_serial_of_a_run_may_be_a_column(table, serial):
    assert to_readings(table, BARE)[0].metadata.get("serial") == serial


@pytest.mark.parametrize(
    ("table", "named"),
    [
        (tools(["A", "", "B"]), "A, B)"),
        (tools(["A", "A"], serial="B"), "B, A)"),
        (tools(["A", "B", "C", "D"]), "A, B, …)"),
    ],
)
def test_rows_of_several_tools_are_no_run(table, named):
    with pytest.raises(InputError, match="run.csv has rows of more than one tool") as refusal:
        check_run(table)
    assert f"(serial {named}" in str(refusal.value)
    assert "mwdcal fleet" in str(refusal.value)


DAMAGES = [
    ("az", np.nan), ("ax", 2e15), ("mx", np.nan), ("temperature_c", np.nan), ("sd_ay", np.nan),
    ("temperature_c", 2000.0), ("sd_ax", 0.0), ("sd_ax", -1.0), ("sd_mx", -1.0), ("ref_gravity_g", 0.0),
    ("ref_azimuth_deg", 400.0), ("sd_ref_azimuth_deg", -1.0), ("sd_ref_gravity_g", 3.0),
    ("sd_ref_dip_deg", -1.0), ("ref_dip_deg", np.nan), ("group", 1.0),
]  # fmt: skip


@pytest.mark.parametrize("count", [1, 4])
def test_the_cells_of_a_tool_are_judged_without_those_of_others(count):
    """Rows of many tools have the faults of each tool's own rows."""
    names = (*RAW, "temperature_c", "ref_azimuth_deg", "ref_gravity_g", "sd_ax", "sd_ay", "sd_az")
    tools = []
    for name, value in DAMAGES:
        for rows in (slice(0, 1), slice(0, count)):
            tool = dict.fromkeys(names, np.ones(count)) | {name: np.ones(count)}
            tool[name] = np.where(np.arange(count) < rows.stop, value, tool[name])
            tools.append(tool)
    every = {
        name: np.concatenate([tool.get(name, np.full(count, np.nan)) for tool in tools])
        for name in dict.fromkeys(name for tool in tools for name in tool)
    }
    starts = np.arange(0, count * len(tools) + 1, count)
    wrong = np.zeros(starts[-1], bool)
    for fault in faults(every.get, starts, BARE):
        wrong |= fault.cells.any(0)
    alone = [bool([*faults(tool.get, np.array([0, count]), BARE)]) for tool in tools]
    assert wrong.reshape(-1, count).any(-1).tolist() == alone
    assert {True, False} == set(alone)
