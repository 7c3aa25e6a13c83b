"""Rows that are readings of one station: expected values are means by NumPy, and the truth of simulated tools."""

import msgspec
import numpy as np
import pytest

import mwdcal as library
from cli_support import RAW, channels, mwdcal, refused, stations, write_csv
from mwdcal.files.formats.table import numbers
from mwdcal.files.runs import read_export, run_table
from mwdcal.sensor.profile import ColumnSource, Profile, StandProfile, TriadProfile
from simulation import DEG, Tool, plan
from test_tables_as_they_come import NAMES, findings_of

COUNT, READINGS = 24, 5
ANGLES = tuple(f"ref_{name}_deg" for name in ("inclination", "azimuth", "toolface"))
STAND = 0.02 * DEG
"""Error of a setting of the stand, 1 sigma."""


def repeated(seed=1, readings=READINGS, stand=STAND, noise=(1e-4, 15.0)):
    """A run of 24 attitudes, and the tool: the readings of an attitude share what the stand is off there."""
    rng = np.random.default_rng(seed)
    tool = Tool.random(seed, noise=noise)
    attitudes = plan((5, 45, 90, 130), COUNT // 4)
    at_stand = [np.repeat(each + stand * rng.normal(size=COUNT), readings) for each in attitudes]
    g, b = (
        clean + sd * rng.normal(size=(COUNT * readings, 3))
        for clean, sd in zip(tool.clean(*at_stand), noise, strict=True)
    )
    run = stations(*(np.repeat(each, readings) for each in attitudes), **channels(g, b))
    run["station"] = np.repeat(np.arange(1, COUNT + 1), readings)
    return run | {"temperature_c": np.full(COUNT * readings, 24.0)}, tool


def profile():
    """A tool profile that reads the columns by other names."""
    columns = {ours: ColumnSource(name=theirs) for ours, theirs in NAMES.items()}
    scales = {"accelerometer": 3.0, "magnetometer": 5e-5}
    triads = {kind: TriadProfile(axes=("+x", "+y", "+z"), scale=s) for kind, s in scales.items()}
    return Profile(name="tool", columns=columns, **triads)


def read(run, tool=None):
    """The readings of a run under other names."""
    return library.read_run(
        {NAMES.get(n, n): values for n, values in run.items()}, tool or profile()
    )


@pytest.mark.parametrize(
    ("off", "count"),
    [
        ([0.045, -0.05, 0.05, 0.01, -0.01], COUNT),
        ([-0.08, -0.03, 0.03, 0.08, 0.04], COUNT * READINGS),
    ],
)
def test_readbacks_of_one_setting_lie_about_their_middle(off, count):
    """Two of them may differ by 0.1°; where a row after the other goes further, each is a station."""
    run, _ = repeated()
    for name in ANGLES:
        run[name] = np.round(run[name] + np.tile(off, COUNT), 6)
    assert read(run).count == count


def test_a_profile_that_takes_means_says_so_where_only_the_angles_tell(tmp_path):
    """A table with the names of a run file and without labels: calibrate and fleet do what profile says."""
    run, _ = repeated()
    folder, tool, cal = tmp_path / "runs", tmp_path / "t.toml", tmp_path / "c.json"
    folder.mkdir()
    path = write_csv(folder / "A1.csv", {n: v for n, v in run.items() if n != "station"})
    proposed = mwdcal("profile", path, "-o", tool)
    ran = mwdcal("calibrate", path, "--tool", tool, "-o", cal)
    many = mwdcal("fleet", folder, "--tool", tool, "-o", tmp_path / "f.parquet", "--workers", 1)
    for each in (proposed, ran, many):
        assert each.code == 0, each.err
        assert "24 stations of 5 readings each: their means are taken" in each.err
    assert library.load(cal).stations == COUNT
    assert library.load(f"{tmp_path / 'f.parquet'}#A1").stations == COUNT


def test_a_fleet_in_parquet_takes_the_means_of_a_label_as_a_run_file_does(tmp_path):
    arrow, pq = (pytest.importorskip(name) for name in ("pyarrow", "pyarrow.parquet"))
    run, _ = repeated()
    parts = {n: [*values, *values] for n, values in run.items()}
    parts["serial"] = ["A1"] * COUNT * READINGS + ["A2"] * COUNT * READINGS
    pq.write_table(arrow.table(parts), tmp_path / "runs.parquet")
    fleet = library.fleet(tmp_path / "runs.parquet", workers=1)
    said = " ".join(each.text for each in fleet.findings)
    assert "48 stations of 5 readings each: their means are taken" in said
    alone = library.calibrate(
        write_csv(tmp_path / "a.csv", run), "generic", order=0, nonlinearity="none"
    )
    for serial in ("A1", "A2"):
        assert fleet[serial].stations == COUNT
        assert fleet[serial].parameters == pytest.approx(alone.parameters, rel=1e-9)


def test_rows_of_one_label_and_setting_are_one_station_at_their_means(tmp_path):
    run, _ = repeated()
    path, tool, cal = tmp_path / "a.csv", tmp_path / "t.toml", tmp_path / "c.json"
    write_csv(path, {NAMES.get(name, name): values for name, values in run.items()})
    proposed = mwdcal("profile", path, "-o", tool)
    ran = mwdcal("calibrate", path, "--tool", tool, "-o", cal, "--exclude", 7)
    sets = {name: np.reshape(run[name], (COUNT, READINGS)) for name in RAW}
    variance = np.array([each.var(1, ddof=1).mean() for each in sets.values()])
    mg, nt = np.sqrt([variance[:3].mean(), variance[3:].mean()]) / [3e-3, 5e-5]
    assert (mg, nt) == pytest.approx((0.1, 15.0), rel=0.15)
    sentence = (
        "24 stations of 5 readings each: their means are taken; scatter of a reading "
        f"{mg:.2g} mg, {nt:.2g} nT."
    )
    for each in (proposed, ran):
        assert each.code == 0
        assert f"! {sentence}\n" in each.err
    assert "24 stations" in proposed.out
    calibration = library.load(cal)
    assert (calibration.stations, calibration.excluded) == (23, ["7"])
    assert sentence in [finding.text for finding in calibration.findings]
    got = read(run)
    means = np.stack([each.mean(1) for each in sets.values()], -1)
    assert got.labels == tuple(map(str, range(1, COUNT + 1)))
    assert got.accelerometer == pytest.approx(means[:, :3] / 3.0, rel=1e-12)
    assert got.magnetometer == pytest.approx(means[:, 3:] / 5e-5, rel=1e-12)
    assert {len(column) for column in got.columns.values()} == {COUNT}


@pytest.mark.parametrize("seeds", [30, pytest.param(300, marks=pytest.mark.study)])
def test_stated_uncertainty_covers_the_errors_that_readings_of_a_setting_share(seeds):
    inc, azi, face = np.radians([[40.0, 75.0, 120.0], [70.0, 200.0, 310.0], [33.0, 160.0, 250.0]])
    stand = dict.fromkeys(("inclination_deg", "azimuth_deg", "toolface_deg"), STAND / DEG)
    declared = StandProfile(**stand, settings="per-station")
    with_stand = msgspec.structs.replace(profile(), stand=declared)
    errors, stated = [], []
    for seed in range(seeds):
        run, tool = repeated(seed)
        cal = library.calibrate(read(run, with_stand))
        point = library.readings(*tool.clean(inc, azi, face), temperature=np.full(3, 24.0))
        found = library.apply(cal, point)
        for name, true in (("inclination", inc), ("azimuth", azi)):
            errors.append((getattr(found, name) - true + np.pi) % (2 * np.pi) - np.pi)
            stated.append(cal.uncertainty(name, point))
        assert cal.drift == []
    share = np.mean(np.abs(errors) <= 1.96 * np.array(stated))
    assert share == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / (2 * seeds)))
    assert np.sqrt(np.mean((np.array(errors) / stated) ** 2)) == pytest.approx(1.0, abs=0.25)


def test_rows_that_are_numbered_stay_stations_and_are_asked_about():
    run, _ = repeated()
    run["station"] = np.arange(1, COUNT * READINGS + 1)
    got = read(run)
    assert got.count == COUNT * READINGS
    assert "24 stations of 5 readings each" in got.remarks[0]
    assert "one label" in got.remarks[0]


@pytest.mark.parametrize(
    "reading", [["a", "b", "c", "d", "e"], [f".{k + 1}" for k in range(READINGS)]]
)
def test_labels_of_readings_are_those_of_stations_where_the_angles_agree(reading):
    run, _ = repeated()
    names = [f"{k + 1}{each}" for k in range(COUNT) for each in reading]
    assert read(run | {"station": names}).count == COUNT
    shifted = [*names[1:], "25" + reading[0]]
    assert read(run | {"station": shifted}).count == COUNT * READINGS


def test_rows_without_labels_are_stations_where_most_come_in_sets_at_equal_angles():
    run, _ = repeated()
    del run["station"]
    got = read(run)
    assert (got.count, got.labels[-1]) == (COUNT, "24")
    assert "number the rows" in got.remarks[0]
    rows = np.arange(COUNT * READINGS)
    uneven = rows % READINGS < 3 + rows // READINGS % 3
    few = rows % READINGS < 1 + (rows // READINGS % 5 == 0)
    for kept, count in ((uneven, COUNT), (few, few.sum())):
        assert read({name: np.asarray(v)[kept] for name, v in run.items()}).count == count


@pytest.mark.parametrize("name", ["Posición", "Stellung", "№ точки", "测点号", "Lfd"])
def test_a_column_of_stations_is_known_by_its_name_or_by_the_angles(tmp_path, name):
    """`Lfd` is no word of ours: its cells change where the angles do."""
    run, _ = repeated()
    rows = np.arange(COUNT * READINGS)
    kept = rows % READINGS < 3 + rows // READINGS % 3
    names = {**NAMES, "station": name}
    columns = {names.get(n, n): np.asarray(v)[kept] for n, v in run.items()}
    write_csv(tmp_path / "a.csv", columns | {"Reading": (rows % READINGS + 1)[kept]})
    proposed = library.propose_profile(tmp_path / "a.csv")
    assert proposed.profile.columns["station"].name == name
    assert library.read_run(tmp_path / "a.csv", proposed.profile).count == COUNT


def test_settings_written_once_and_rows_of_means_leave_the_stations_of_the_readings(tmp_path):
    run, _ = repeated()
    raw = {name: np.reshape(run[name], (COUNT, READINGS)) for name in RAW}
    names = [*(NAMES[n] for n in ("station", *ANGLES)), "Reading", *(NAMES[n] for n in RAW)]
    lines = [names]
    for k in range(COUNT):
        setting = [str(run[n][k * READINGS]) for n in ("station", *ANGLES)]
        for reading in range(READINGS):
            cells = [repr(float(raw[n][k, reading])) for n in RAW]
            lines.append([*(setting if not reading else [""] * 4), str(reading + 1), *cells])
        lines.append([*setting, "MW", *(repr(float(raw[n][k].mean()) + 1.0) for n in RAW)])
    for means in (False, True):
        kept = [line for line in lines if means or line[4] != "MW"]
        path = tmp_path / f"{means}.csv"
        path.write_text("\n".join(map(",".join, kept)), "utf-8")
        proposed = library.propose_profile(path)
        assert set(proposed.profile.table.fill_down) == {NAMES[n] for n in ("station", *ANGLES)}
        got = run_table(read_export(path, proposed.profile), proposed.profile)
        assert numbers(got, "ax") == pytest.approx(raw["ax"].mean(1), rel=1e-12)


def test_rows_of_one_label_are_one_station_in_a_documented_run_file_too(tmp_path):
    """Truth: the means by NumPy, written as a file of one row for each station, give the same calibration."""
    run, _ = repeated()
    sets = {name: np.reshape(values, (COUNT, READINGS)) for name, values in run.items()}
    single = {n: v.mean(1) if n in RAW else v[:, 0] for n, v in sets.items()}
    fits = {}
    for name, columns in (("many", run), ("single", single)):
        write_csv(tmp_path / f"{name}.csv", columns)
        fit = tmp_path / f"{name}.json"
        ran = mwdcal("calibrate", tmp_path / f"{name}.csv", "--tool", "servo", "-o", fit)
        fits[name] = library.load(fit)
        means = "24 stations of 5 readings each: their means are taken; scatter of a reading "
        assert (means in ran.err) == (name == "many")
    assert fits["many"].stations == COUNT
    for kind in ("accelerometer", "magnetometer"):
        many, single = (getattr(fits[name], kind) for name in ("many", "single"))
        assert many.parameters == pytest.approx(single.parameters, rel=1e-9)


def test_a_label_of_several_stations_excludes_none_of_them(tmp_path):
    run, _ = repeated(readings=1)
    run["station"] = np.repeat(np.arange(COUNT // 2), 2)
    write_csv(tmp_path / "a.csv", run)
    refused(mwdcal("calibrate", tmp_path / "a.csv", "-o", tmp_path / "d.json", "--exclude", 7), 2)


@pytest.mark.parametrize("labels", [False, True])
def test_advice_for_rows_that_stay_stations_is_what_averages_them(labels):
    run, _ = repeated()
    one_label = run.pop("station")
    numbered = {"station": np.arange(1, COUNT * READINGS + 1)} if labels else {}
    got = library.read_run(run | numbered, "servo")
    assert got.count == COUNT * READINGS
    assert "one label in the column `station`" in got.remarks[0]
    assert "profile" not in got.remarks[0]
    assert library.read_run(run | {"station": one_label}, "servo").count == COUNT


def test_angles_are_those_of_the_first_reading_or_the_mean_of_an_encoder():
    run, _ = repeated(stand=0.0)
    first = np.arange(COUNT * READINGS) % READINGS == 0
    blank = {n: np.where(first, v, np.nan) for n, v in run.items() if n.startswith("ref_")}
    known, angles = read(run).known, ("inclination", "azimuth", "toolface")
    for name in angles:
        assert read(run | blank).known[name] == pytest.approx(known[name], abs=1e-12)
    azimuth = np.asarray(run["ref_azimuth_deg"])
    assert 0.0 in azimuth
    for shown in ([-0.01, 0.01, 0.0, -0.02, 0.02], [-0.01, 0.03, 0.03, 0.04, 0.01]):
        turned = (azimuth + np.tile(shown, COUNT)) % 360.0
        got = read(run | {"ref_azimuth_deg": turned}).known["azimuth"]
        off = (got - known["azimuth"] + np.pi) % (2 * np.pi) - np.pi
        assert off == pytest.approx(np.radians(np.mean(shown)), abs=1e-9)


def test_what_moves_under_one_label_is_no_station_of_many_readings():
    run, tool = repeated()
    rolled = {**run, "ref_toolface_deg": np.full(len(run["station"]), np.nan)}
    clean = tool.clean(
        *(np.radians(run[f"ref_{n}_deg"]) for n in ("inclination", "azimuth")),
        np.tile(np.arange(READINGS) * 72 * DEG, COUNT),
    )
    warming = np.tile(np.arange(READINGS) * 20.0, COUNT)
    for moved in (rolled | channels(*clean), run | {"temperature_c": warming}):
        got = read(moved)
        assert got.count == COUNT * READINGS
        assert not got.remarks
    turned = run | {"ref_toolface_deg": np.arange(COUNT * READINGS) * 3.0}
    assert read(turned).count == COUNT * READINGS


def test_the_noise_of_a_mean_is_that_of_its_readings_over_their_root():
    run, _ = repeated()
    run |= {f"sd_{name}": np.full(COUNT * READINGS, 3e-4) for name in ("ax", "ay", "az")}
    assert read(run).sd["accelerometer"] == pytest.approx(1e-4 / np.sqrt(READINGS))


def test_a_roll_test_in_repeated_rows_is_judged_by_its_means(tmp_path):
    run, tool = repeated()
    angles = (np.full(12, 55 * DEG), np.full(12, 140 * DEG), np.arange(12) * 30 * DEG)
    rng = np.random.default_rng(5)
    g, b = (
        each + sd * rng.normal(size=(36, 3))
        for each, sd in zip(
            tool.clean(*(np.repeat(a, 3) for a in angles)), (1e-4, 15.0), strict=True
        )
    )
    test = stations(*(np.repeat(a, 3) for a in angles), **channels(g, b))
    test |= {"station": np.repeat(np.arange(1, 13), 3), "temperature_c": np.full(36, 24.0)}
    verdict = library.verify(library.calibrate(read(run)), read(test))
    assert verdict.stations == 12
    assert "12 stations of 3 readings each" in findings_of(verdict)["marked-rows"]


def test_labels_of_directions_without_toolfaces_are_no_stations(tmp_path):
    """A tool rolled at 1.5° moves within 3 % of its range; rolled at 60° and 90° under one label it does not."""
    inclination = np.repeat([1.5, 60, 90], 8) * DEG
    toolface = np.tile(np.arange(8) * 45, 3) * DEG
    tool = Tool.random(3)
    g, _ = tool.clean(inclination, np.zeros(24), toolface)
    run = dict(zip(("ax", "ay", "az"), 3.0 * g.T, strict=True))
    run["station"] = np.repeat(["V", "S", "H"], 8)
    run |= {"ref_inclination_deg": inclination / DEG, "temperature_c": np.full(24, 24.0)}
    assert library.read_run(write_csv(tmp_path / "r.csv", run), profile="servo").count == 24
