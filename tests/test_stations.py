"""Standstills found in logs: simulated ones whose standstills are known, and measured ones.

What is expected comes from the simulation, from the statistics of white and AR(1) noise, and
from what was published of the measured sets; never from our own output.
"""

import os
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from cli_support import mwdcal, numbers, read_csv, refused, write_csv
from mwdcal.calibration.calibrate import calibrate
from mwdcal.files import logs
from mwdcal.files.formats.table import Table
from mwdcal.logs import standstill
from mwdcal.logs.station_means import summarise
from mwdcal.logs.stations import find_stations
from mwdcal.use.notation import convert

ACC, MAG = ("ax", "ay", "az"), ("mx", "my", "mz")


def directions(rng, count):
    """Unit vectors, each at least 20 degrees from the one before."""
    found = [np.array([0.0, 0.0, 1.0])]
    while len(found) < count:
        v = rng.standard_normal(3)
        v /= np.linalg.norm(v)
        if v @ found[-1] < np.cos(np.radians(20)):
            found.append(v)
    return np.array(found)


def fields(rng, gravity):
    """Field vectors of unit strength, 65° below the level of these directions of gravity."""
    dip = np.radians(65)
    level = np.cross(gravity, rng.standard_normal(gravity.shape))
    level = level / np.linalg.norm(level, axis=-1, keepdims=True)
    return np.sin(dip) * gravity + np.cos(dip) * level


def ar1(rng, count, rho):
    """Correlated noise of unit variance, (count, 3)."""
    drive = rng.standard_normal((count + 1000, 3)) * np.sqrt(1 - rho**2)
    return lfilter([1.0], [1.0, -rho], drive, axis=0)[1000:]


def tumble(seed=0, stations=12, hz=100.0, still=(5.0, 12.0), move=(1.0, 3.0), noise=5e-3, rho=0.0):
    """A log that stands still at known times: table, starts, ends and true vectors.

    Between two standstills the tool turns along a smooth path; there is movement at both ends.
    """
    rng = np.random.default_rng(seed)
    aims = directions(rng, stations + 2)
    lasts = rng.uniform(*still, stations)
    moves = rng.uniform(*move, stations + 1)
    ends = np.cumsum(lasts + moves[:-1])
    starts = ends - lasts
    time = np.arange(int((ends[-1] + moves[-1]) * hz)) / hz
    knots = np.concatenate([[0.0], np.stack([starts, ends], -1).ravel(), [ends[-1] + moves[-1]]])
    level = np.concatenate([[0], np.repeat(np.arange(1, stations + 1), 2), [stations + 1]])
    place = np.clip(np.searchsorted(knots, time, "right") - 1, 0, len(knots) - 2)
    share = (time - knots[place]) / (knots[place + 1] - knots[place])
    smooth = (0.5 - 0.5 * np.cos(np.pi * share))[:, None]
    true = aims[level[place]] * (1 - smooth) + aims[level[place + 1]] * smooth
    read = true + noise * ar1(rng, len(time), rho)
    columns = {"time_s": time, **dict(zip(ACC, read.T, strict=True))}
    return Table(columns, {}, "log.csv", range(2, len(time) + 2)), starts, ends, aims[1:-1]


def means(found, names=ACC):
    return np.stack([found.table.columns[n] for n in names], -1)


def spiked(table, seed, share=0.05, names=ACC):
    """The log with spikes of up to its whole range in every channel."""
    rng = np.random.default_rng(seed)
    columns = dict(table.columns)
    for name in names:
        value = columns[name].copy()
        hit = rng.random(len(value)) < share
        value[hit] += (
            rng.choice([-1, 1], hit.sum()) * rng.uniform(0.02, 1, hit.sum()) * np.ptp(value)
        )
        columns[name] = value
    return Table(columns, table.metadata, table.source, table.lines)


def without(table, *names, **new):
    columns = {k: v for k, v in {**table.columns, **new}.items() if k not in names}
    return Table(columns, table.metadata, table.source, table.lines)


# Counts and edges


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    "kind",
    [
        {},
        {"noise": 1e-4},
        {"noise": 2e-2},
        {"rho": 0.9},
        {"hz": 10.0, "still": (8, 20)},
        {"hz": 1000.0, "stations": 5},
        {"hz": 1.0, "still": (40, 80), "move": (6, 20)},
    ],
    ids=lambda k: ",".join(f"{a}={b}" for a, b in k.items()) or "plain",
)
def test_every_standstill_is_found_within_its_edges(seed, kind):
    log, starts, ends, aims = tumble(seed, **kind)
    found = find_stations(log)
    assert found.table.count == len(starts)
    first, last = (found.table.columns[n] for n in ("start_s", "end_s"))
    step = 1 / kind.get("hz", 100.0)
    # A movement that starts smoothly is noise-sized at first: 3 % of it in its first tenth.
    slack = 0.1 * max(kind.get("move", (0, 3))) + step
    assert np.all(first >= starts - slack)
    assert np.all(last <= ends + slack)
    window = standstill.WINDOW * max(standstill.CELL, standstill.FEWEST * step)
    lost = 2 * (found.trim_seconds + window) + 2 * step
    assert np.all(last - first >= ends - starts - lost)
    sd = means(found, tuple(f"sd_{n}" for n in ACC))
    assert np.abs((means(found) - aims) / sd).max() < 6


def test_many_stations():
    log, starts, *_ = tumble(3, stations=300, still=(4, 6))
    assert find_stations(log).table.count == len(starts)


def test_options_say_what_counts():
    log, starts, ends, _ = tumble(1, stations=20, still=(3, 20))
    long = find_stations(log, min_seconds=8.0)
    lasting = ends - starts - 2 * long.trim_seconds
    assert np.sum(lasting > 8.4) <= long.table.count <= np.sum(lasting > 7.6)
    assert (long.table.columns["end_s"] - long.table.columns["start_s"]).min() > 7.9
    assert long.intervals.short.sum() == len(starts) - long.table.count
    given = find_stations(log, threshold=12.0)
    assert given.threshold == 12.0
    assert given.stretch is None
    near, far = (find_stations(log, trim_seconds=t).table.columns for t in (0.0, 0.6))
    assert np.all(far["start_s"] - near["start_s"] == pytest.approx(0.6, abs=0.02))


@pytest.mark.parametrize("seed", range(5))
def test_coarse_readings(seed):
    """Steps of 5 mg, noise of 0.5 mg: most samples repeat the one before.

    Rounded noise of a tenth of a step errs by 0.19 steps in the mean: the integral over all places
    between two steps (`test_station_means`), as far as twelve stations tell the noise.
    """
    log, starts, _, aims = tumble(seed, noise=5e-4)
    coarse = {n: np.round(log.columns[n] * 200) / 200 for n in ACC}
    found = find_stations(without(log, **coarse))
    assert found.table.count == len(starts)
    sd = means(found, tuple(f"sd_{n}" for n in ACC))
    assert np.mean(np.abs(means(found) - aims) <= 1.96 * sd) > 0.95
    assert 0.19 < np.sqrt(np.mean(sd**2)) / 0.005 < 0.29


@pytest.mark.parametrize("noise", [0.1, 0.2, 0.3, 0.4, 0.45])
def test_coarse_readings_lose_and_split_no_standstill(noise):
    """Noise in steps: where a reading lies between two it goes up and down at rest."""
    for seed in (10, 11, 13):
        log, starts, ends, _ = tumble(seed, stations=24, still=(8, 14), noise=1e-3)
        coarse = {n: np.round(log.columns[n] * noise / 1e-3) * 1e-3 / noise for n in ACC}
        found = find_stations(without(log, **coarse))
        first, last = (found.table.columns[n] for n in ("start_s", "end_s"))
        own = np.searchsorted(ends, (first + last) / 2)
        np.testing.assert_array_equal(own, np.arange(24))
        assert np.all((first > starts - 0.1) & (last < ends + 0.1))


# Uncertainty


def coverage(rho, seconds=20.0, seeds=120, spikes=0.0):
    """Share of |mean - truth| <= 1.96 sd over simulated standstills of one channel."""
    inside = []
    for seed in range(seeds):
        rng = np.random.default_rng(1000 + seed)
        value = ar1(rng, int(seconds * 100), rho)[:, :2]
        hit = rng.random(value.shape) < spikes
        value[hit] += rng.uniform(-200, 200, hit.sum())
        time = np.arange(len(value)) / 100
        for channel in value.T:
            made = summarise([(time, channel)], 1e-9)
            inside.append(abs(made.mean) <= 1.96 * made.sd)
    return np.mean(inside)


@pytest.mark.parametrize("spikes", [0.0, 0.05])
@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9, 0.95])
def test_sd_of_the_mean_covers(rho, spikes):
    """240 trials: 95 % has a standard error of 1.4 %."""
    assert 0.91 <= coverage(rho, spikes=spikes) <= 0.99


def test_sd_is_that_of_theory():
    """AR(1): variance of the mean is close to (1 + ρ)/(1 - ρ)/n, with its exact sum."""
    rng = np.random.default_rng(5)
    n = 2000
    for rho in (0.0, 0.9):
        lags = np.arange(1, n)
        exact = np.sqrt((1 + 2 * np.sum((1 - lags / n) * rho**lags)) / n)
        sds = [summarise([(np.arange(n) / 100, x)], 1e-9).sd for x in ar1(rng, n, rho).T]
        for _ in range(30):
            sds += [summarise([(np.arange(n) / 100, x)], 1e-9).sd for x in ar1(rng, n, rho).T]
        assert 0.95 < np.sqrt(np.mean(np.square(sds))) / exact < 1.3


def test_sd_covers_through_the_whole_command():
    """Stations of whole logs: misses of 1.96 sd among 10 logs × 12 stations × 3 channels."""
    misses = []
    for seed in range(10):
        log, *_, aims = tumble(seed, rho=0.8, still=(10, 20))
        found = find_stations(log)
        sd = means(found, tuple(f"sd_{n}" for n in ACC))
        misses.append(np.abs(means(found) - aims) > 1.96 * sd)
    assert np.mean(misses) < 0.1


def test_a_reading_that_never_changes_is_known_to_its_resolution():
    made = summarise([(np.arange(100) / 100, np.full(100, 7.0))], 1.0)
    assert made.sd == pytest.approx(1 / np.sqrt(12))
    assert made.spread == 0.0
    assert not made.drifts


# Spikes


@pytest.mark.parametrize("seed", range(5))
def test_spikes_do_not_reach_the_means(seed):
    log, starts, ends, aims = tumble(seed, stations=15)
    found = find_stations(spiked(log, seed))
    assert found.table.count >= len(starts)
    centre = (found.table.columns["start_s"] + found.table.columns["end_s"]) / 2
    own = np.searchsorted(ends, centre)
    sd = means(found, tuple(f"sd_{n}" for n in ACC))
    assert np.abs((means(found) - aims[own]) / sd).max() < 6
    assert [f.id for f in found.findings].count("spikes") == 1


# Drift, temperature, rates


def test_drift_is_flagged_where_it_is():
    log, starts, ends, _ = tumble(2, stations=10, still=(8, 12))
    time, value = log.columns["time_s"], log.columns["ay"].copy()
    inside = (time >= starts[4]) & (time <= ends[4])
    value[inside] += 5e-3 * (time[inside] - starts[4]) / (ends[4] - starts[4])
    found = find_stations(without(log, ay=value))
    assert [i for i, text in enumerate(found.table.columns["drifting"]) if text] == [4]
    assert found.table.columns["drifting"][4] == "ay"
    share = (ends[4] - starts[4] - 2) / (ends[4] - starts[4])
    assert found.table.columns["drift_ay"][4] == pytest.approx(5e-3 * share, abs=1.5e-3)
    (finding,) = [f for f in found.findings if f.id == "drift"]
    assert finding.station == "5"


@pytest.mark.parametrize(("rho", "most"), [(0.0, 2), (0.9, 6)])
def test_steady_channels_are_seldom_said_to_drift(rho, most):
    rng = np.random.default_rng(9)
    time = np.arange(1500) / 100
    channels = [summarise([(time, x)], 1e-9) for _ in range(150) for x in ar1(rng, 1500, rho).T]
    assert sum(channel.drifts.sum() for channel in channels) <= most  # of 450


def multi_rate(seed=4):
    """Accelerometer at 100 Hz, magnetometer at 20 Hz, temperature every 4 s, lagging by 60 s.

    The fields of the standstills come with it, and the course of the temperature.
    """
    log, starts, ends, aims = tumble(seed, still=(8, 15))
    time = log.columns["time_s"]
    rng = np.random.default_rng(seed + 500)
    field = fields(rng, aims)
    middles = np.stack([starts, ends], -1).ravel()
    course = np.stack([np.interp(time, middles, np.repeat(own, 2)) for own in field.T], -1)
    read = np.where(np.arange(len(time))[:, None] % 5 == 2, course, np.nan)
    read += 0.003 * rng.standard_normal(read.shape)
    warmth = 80 - 55 * np.exp(-np.maximum(time - 60, 0) / 300)
    columns = {**log.columns, **dict(zip(MAG, read.T, strict=True))}
    columns["temperature_c"] = np.where(np.arange(len(time)) % 400 == 7, warmth, np.nan)
    return Table(columns, {}, "log.csv", range(2, len(time) + 2)), starts, ends, field, warmth


def test_channels_at_rates_of_their_own():
    log, starts, _, field, warmth = multi_rate()
    found = find_stations(log)
    columns = found.table.columns
    assert found.table.count == len(starts)
    sd = means(found, tuple(f"sd_{n}" for n in MAG))
    assert np.abs((means(found, MAG) - field) / sd).max() < 6
    ratio = columns["samples_ax"] / columns["samples_mx"]
    assert np.all(np.abs(ratio - 5) < 0.2)
    time = log.columns["time_s"]
    for i in range(len(starts)):
        inside = (time >= columns["start_s"][i]) & (time <= columns["end_s"][i])
        assert columns["temperature_c"][i] == pytest.approx(warmth[inside].mean(), abs=0.05)
        assert columns["drift_temperature_c"][i] == pytest.approx(np.ptp(warmth[inside]), abs=0.2)


def test_rows_of_several_sensors_at_one_time():
    """One row per sensor and time, as loggers with a queue write them."""
    log, starts, *_ = multi_rate()
    time = log.columns["time_s"]
    there = ~np.isnan(log.columns["mx"])
    rows = np.argsort(np.concatenate([time, time[there]]), kind="stable")
    columns = {"time_s": np.concatenate([time, time[there]])[rows]}
    for name in ACC:
        columns[name] = np.concatenate([log.columns[name], np.full(there.sum(), np.nan)])[rows]
    for name in MAG:
        columns[name] = np.concatenate([np.full(len(time), np.nan), log.columns[name][there]])[rows]
    found = find_stations(Table(columns, {}, "log.csv", range(2, len(rows) + 2)))
    assert found.table.count == len(starts)
    assert "duplicate-time" not in [f.id for f in found.findings]


# Logs with something wrong in them


def finding_ids(found):
    return [f.id for f in found.findings]


def test_all_still():
    rng = np.random.default_rng(1)
    read = np.array([0.1, -0.2, 0.97]) + 1e-3 * ar1(rng, 30_000, 0.5)
    columns = dict(zip(ACC, read.T, strict=True))
    found = find_stations(Table(columns, {"sampling_hz": 100}, "log.csv", range(2, 30_002)))
    assert found.table.count == 1
    assert "all-still" in finding_ids(found)


@pytest.mark.parametrize("seconds", [5, 10, 19])
def test_all_still_for_a_short_time(seconds):
    read = 1 + 1e-3 * np.random.default_rng(1).standard_normal((100 * seconds, 3))
    log = Table(dict(zip(ACC, read.T, strict=True)), {}, "log.csv", range(2, 100 * seconds + 2))
    assert "all-still" in finding_ids(find_stations(log, sampling_hz=100.0))


@pytest.mark.parametrize("period", [3.0, 10.0, 60.0, 300.0])
@pytest.mark.parametrize("noise", [0.0, 5e-3])
def test_never_still(period, noise):
    time = np.arange(20_000) / 100
    turn = 2 * np.pi * time / period
    read = np.stack([np.sin(turn), np.cos(turn), 0.3 * np.sin(0.37 * turn)], -1)
    read += noise * np.random.default_rng(1).standard_normal(read.shape)
    log = Table(dict(zip(ACC, read.T, strict=True)), {}, "log.csv", range(2, len(time) + 2))
    with pytest.raises(Exception, match="no standstill of at least"):
        find_stations(log, sampling_hz=100.0)


def test_a_gap_ends_a_standstill():
    log, starts, ends, _ = tumble(6, stations=8, still=(12, 16))
    time = log.columns["time_s"]
    middle = (starts[3] + ends[3]) / 2
    keep = np.abs(time - middle) > 1.0
    columns = {k: v[keep] for k, v in log.columns.items()}
    found = find_stations(Table(columns, {}, "log.csv", np.arange(len(time))[keep] + 2))
    assert "gaps" in finding_ids(found)
    assert found.table.count == len(starts) + 1
    first, last = (found.table.columns[n] for n in ("start_s", "end_s"))
    assert not np.any((first < middle) & (last > middle))


def test_times_written_twice_are_told_and_used():
    log, starts, *_ = tumble(7)
    time = np.floor(log.columns["time_s"] * 50) / 50
    found = find_stations(without(log, time_s=time))
    assert found.table.count == len(starts)
    assert "duplicate-time" in finding_ids(found)


def test_a_reference_in_the_log_goes_with_its_station():
    log, starts, ends, _ = tumble(8)
    time = log.columns["time_s"]
    reference = np.full(len(time), np.nan)
    for i, (a, b) in enumerate(zip(starts, ends, strict=True)):
        reference[(time >= a) & (time <= b)] = 10.0 * i
    reference[(time >= starts[2]) & (time <= ends[2])] = np.nan
    found = find_stations(without(log, ref_inclination_deg=reference, gx=time))
    expected = 10.0 * np.arange(len(starts))
    expected[2] = np.nan
    np.testing.assert_array_equal(found.table.columns["ref_inclination_deg"], expected)
    assert "unused-columns" in finding_ids(found)


@pytest.mark.parametrize("name", ["ref_azimuth_deg", "ref_toolface_deg"])
@pytest.mark.parametrize("cut", [0.0, -180.0])
def test_an_encoder_that_flickers_about_the_cut_of_its_circle_is_read_there(name, cut):
    """Expected: the setting; the median of n readings is uncertain by 1.25 sigma over the root of n."""
    log, starts, *_ = tumble(8)
    shown = np.random.default_rng(2).normal(cut, 0.05, log.count)
    found = find_stations(without(log, **{name: (shown - cut) % 360.0 + cut}))
    table = found.table.columns
    off = (table[name] - cut + 180.0) % 360.0 - 180.0
    assert len(off) == len(starts)
    assert np.all(np.abs(off) <= 4 * 1.2533 * 0.05 / np.sqrt(table["samples"]))


# The command


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A log as CSV with blanks, and the same without names."""
    folder = tmp_path_factory.mktemp("logs")
    log, *_ = multi_rate()
    named = write_csv(folder / "log.csv", log.columns, 'serial = "A-7"')
    bare = folder / "bare.txt"
    rows = np.stack([log.columns[n] for n in ("time_s", *ACC)], -1)
    np.savetxt(bare, rows, fmt="%.8f")
    return named, bare


def test_the_command_writes_a_run_that_calibrates(tmp_path, files):
    picture = tmp_path / "log.png"
    ran = mwdcal("stations", files[0], "-o", tmp_path / "run.csv", "--plot", picture)
    assert ran.code == 0, ran
    assert picture.read_bytes().startswith(b"\x89PNG")
    text = (tmp_path / "run.csv").read_text()
    assert '# serial = "A-7"' in text
    table = read_csv(tmp_path / "run.csv")
    assert table["station"] == [str(i) for i in range(1, 13)]
    assert numbers(table["samples"]).min() > 100
    ran = mwdcal("calibrate", tmp_path / "run.csv", "--order", 0, "-o", tmp_path / "cal.json")
    assert ran.code == 0, ran


def test_every_format_gives_the_same(tmp_path, files):
    told = {}
    for suffix in (".csv", ".parquet"):
        out = tmp_path / f"run{suffix}"
        told[suffix] = mwdcal("stations", files[0], "-o", out, "--json").json["stations"]
        assert out.exists()
    assert told[".csv"] == told[".parquet"]
    table = read_csv(tmp_path / "run.csv")
    for name in ("ax", "sd_ax", "start_s"):
        np.testing.assert_array_equal(numbers(table[name]), [s[name] for s in told[".csv"]])


def test_a_log_without_names(tmp_path, files):
    out = tmp_path / "run.csv"
    picture = tmp_path / "log.svg"
    ran = mwdcal("stations", files[1], "--columns", "time_s,ax,ay,az", "-o", out, "--plot", picture)
    assert ran.code == 0, ran
    assert b"<svg" in picture.read_bytes()
    rows = np.loadtxt(files[1])[:, 1:]
    half = tmp_path / "half.csv"
    np.savetxt(half, rows, fmt="%.8f", delimiter=";")
    half.write_text(half.read_text().replace(".", ","))
    options = ("--columns", "ax,ay,az", "--sampling-hz", 100, "--decimal", ",")
    again = mwdcal("stations", half, *options, "-o", tmp_path / "again.csv", "--json")
    assert again.code == 0, again
    first = read_csv(out)
    for name in ACC:
        assert [s[name] for s in again.json["stations"]] == pytest.approx(
            numbers(first[name]), 1e-9
        )


def test_metadata_can_hold_the_rate(tmp_path, files):
    rows = np.loadtxt(files[1])[:, 1:]
    columns = dict(zip(ACC, rows.T, strict=True))
    log = write_csv(tmp_path / "log.csv", columns, "sampling_hz = 100")
    assert mwdcal("stations", log, "-o", tmp_path / "r.csv").code == 0
    log = write_csv(tmp_path / "log.csv", columns, "sampling_hz = fast")
    assert "sampling_hz must be a number" in refused(
        mwdcal("stations", log, "-o", tmp_path / "r.csv"), 2
    )
    told = refused(mwdcal("stations", log, "--sampling-hz", 0, "-o", tmp_path / "r.csv"), 2)
    assert "--sampling-hz must be a number between" in told
    assert "give --sampling-hz" not in told
    log = write_csv(tmp_path / "log.csv", columns)
    assert "--sampling-hz 100" in refused(mwdcal("stations", log, "-o", tmp_path / "r.csv"), 2)


def changed(columns, name, row, value):
    cells = [repr(float(v)) if not np.isnan(v) else "" for v in columns[name]]
    cells[row] = value
    return {**columns, name: cells}


BAD = {
    "text in a cell": (lambda c: changed(c, "ay", 40, "0.1V"), ("line 42", "column 'ay'", "'0.1V'")),
    "nan": (lambda c: changed(c, "ay", 40, "nan"), ("line 42", "column 'ay'", "'nan'")),
    "a decimal comma": (lambda c: changed(c, "az", 7, "0,5"), ("line 9",)),
    "time that goes back": (lambda c: changed(c, "time_s", 500, "1.0"), ("line 502", "'time_s'", "1 s after")),
    "time that jumps": (lambda c: changed(c, "time_s", -1, "1e12"), ("'time_s'", "must not jump so far")),
    "time blank": (lambda c: changed(c, "time_s", 9, ""), ("line 11", "'time_s'", "blank")),
    "a channel blank": (lambda c: {**c, "ay": np.full(len(c["ay"]), np.nan)}, ("column 'ay'", "every cell is blank")),
    "a channel missing": (lambda c: {k: v for k, v in c.items() if k != "ay"}, ("'ay' is missing",)),
    "a near miss": (lambda c: {"Time [s]" if k == "time_s" else k: v for k, v in c.items()}, ("'time_s'",)),
    "half a magnetometer": (lambda c: {**c, "mx": c["ax"]}, ("mx, my, mz",)),
    "a huge number": (lambda c: changed(c, "ax", 3, "1e999"), ("line 5", "column 'ax'", "too large")),
    "too short": (lambda c: {k: v[:20] for k, v in c.items()}, ("too short", "20 rows")),
    "a single row": (lambda c: {k: v[:1] for k, v in c.items()}, ("too short", "got 1 row over")),
    "no rows": (lambda c: {k: v[:0] for k, v in c.items()}, ("no samples",)),
}  # fmt: skip


@pytest.mark.parametrize(("change", "words"), BAD.values(), ids=BAD)
def test_a_wrong_log_is_refused_with_its_place(tmp_path, change, words):
    log, *_ = tumble(1, stations=2)
    path = write_csv(tmp_path / "log.csv", change(dict(log.columns)))
    out = tmp_path / "run.csv"
    ran = mwdcal("stations", path, "-o", out)
    message = refused(ran, 2)
    assert "log.csv" in message
    for word in words:
        assert word in message
    assert not out.exists()


def test_a_blank_magnetometer_is_a_finding(tmp_path):
    log, *_ = tumble(1, stations=4)
    columns = {**log.columns, **dict.fromkeys(MAG, np.full(len(log.columns["ax"]), np.nan))}
    ran = mwdcal(
        "stations", write_csv(tmp_path / "log.csv", columns), "-o", tmp_path / "run.csv", "--json"
    )
    assert ran.code == 0, ran
    assert "no-magnetometer" in [f["id"] for f in ran.json["findings"]]
    assert "mx" not in ran.json["stations"][0]


CONTENTS = {
    "empty": (b"", "the file is empty"),
    "binary": (bytes(range(1, 256)) + b"\0" * 40, "expected UTF-8 text"),
    "UTF-16": ("time_s,ax,ay,az\n0,1,2,3\n".encode("utf-16"), "expected UTF-8 text"),
    "numbers only": (b"0,1,2,3\n1,1,2,3\n", "--columns time_s,ax,ay,az"),
    "ragged": (b"time_s,ax,ay,az\n0,1,2,3\n1,1,2\n", "line 3"),
    "too many cells": (b"time_s,ax,ay,az\n0,1,2,3\n1,1,2,3,4\n", "line 3"),
}


@pytest.mark.parametrize(("data", "word"), CONTENTS.values(), ids=CONTENTS)
def test_a_damaged_log_is_refused(tmp_path, data, word):
    path = tmp_path / "log.csv"
    path.write_bytes(data)
    assert word in refused(mwdcal("stations", path, "-o", tmp_path / "run.csv"), 2)


def test_misused_options(tmp_path, files):
    out = tmp_path / "run.csv"
    for options, word in [
        (("--plot", tmp_path / "p.pdf"), "suffix must be one of"),
        (("--min-seconds", "-1"), "--min-seconds must be"),
        (("--threshold", "inf"), "--threshold must be"),
        (("--columns", "time_s,ax,ay,az"), "Leave --columns out"),
        (("--min-seconds", "1000"), "no standstill of at least 1000 s"),
    ]:
        assert word in refused(mwdcal("stations", files[0], "-o", out, *options), 2)
    for path in (tmp_path, tmp_path / "none.csv"):
        assert str(path) in refused(mwdcal("stations", path, "-o", out), 2)
    assert "would be lost" in refused(mwdcal("stations", files[0], "-o", files[0]), 2)
    wrong = mwdcal("stations", files[1], "--columns", "time_s,ax,ay", "-o", out)
    assert "'az' is missing" in refused(wrong, 2)
    wrong = mwdcal("stations", files[1], "--columns", "time_s,ax,ay,az,mx,my,mz", "-o", out)
    assert "expected 7 cells" in refused(wrong, 2)


def test_reading_in_pieces_is_reading_at_once(monkeypatch, files):
    whole = logs.read(files[0])
    monkeypatch.setattr(logs, "_PIECE", 10_000)
    pieces = logs.read(files[0])
    assert list(pieces.lines) == list(whole.lines)
    for name, column in whole.columns.items():
        np.testing.assert_array_equal(column, pieces.columns[name])
    written = numbers(read_csv(files[0])["mx"])
    np.testing.assert_array_equal(whole.columns["mx"], written)


# Measured logs


measured = pytest.importorskip("measured")
on_measured = pytest.mark.skipif(
    "MWDCAL_DATA" not in os.environ, reason="measured sets: set MWDCAL_DATA to a local copy"
)


def xsens_differences(run):
    """Largest differences of the calibrated stations from the published calibration."""
    raw = np.stack([numbers(run[n]) for n in ACC], -1)
    values = [float(x) for x in measured.fetch("xsens/published.calib").read_text().split()]
    skew, scale = np.array(values[:9]).reshape(3, 3), np.array(values[9:18]).reshape(3, 3)
    gravity = 9.81744
    sd = np.stack([numbers(run[f"sd_{n}"]) for n in ACC], -1)
    nominal = gravity / np.diag(scale).mean()
    readings, profile = measured.accelerometer_only(raw, nominal, None)
    readings = replace(readings, sd={"accelerometer": sd / nominal})
    found = convert(calibrate(readings, profile), "affine")["accelerometer"].values
    upper = measured.triangular(found["M"]) * gravity
    bias = -np.linalg.solve(found["M"], found["b"]) - values[18:21]
    field = np.linalg.norm(raw @ found["M"].T + found["b"], axis=-1)
    gains = np.diag(upper)
    return (
        np.abs(bias).max(),
        np.abs(gains / np.diag(scale) - 1).max(),
        np.abs(upper / gains - skew).max(),
        100 * np.std(field),
    )


def stations_of(table, folder, *options):
    path = write_csv(folder / "log.csv", table.columns)
    ran = mwdcal("stations", path, "-o", folder / "run.csv", *options)
    assert ran.code == 0, ran
    return read_csv(folder / "run.csv")


@on_measured
@pytest.mark.parametrize("seed", [None, 1, 2])
def test_xsens_38_standstills_and_the_published_calibration(tmp_path, seed):
    """Thresholds as in test_measured; with and without 5 % of spikes."""
    log = logs.read(measured.fetch("xsens/xsens_acc.mat"), ["time_s", *ACC])
    run = stations_of(log if seed is None else spiked(log, seed), tmp_path)
    assert len(run["ax"]) == 38
    starts, ends = numbers(run["start_s"]), numbers(run["end_s"])
    own = np.genfromtxt(measured.fetch("xsens/static_means.csv"), delimiter=",", names=True)
    middle = log.columns["time_s"][((own["sample_start"] + own["sample_end"]) / 2).astype(int)]
    assert np.all((starts < middle) & (middle < ends))
    bias, scale, skew, residual = xsens_differences(run)
    assert bias < 1
    assert scale < 3e-4
    assert skew < 1e-3
    assert residual <= 0.015


@on_measured
@pytest.mark.parametrize("unit", ["imu0", "imu1", "imu2"])
@pytest.mark.parametrize("seed", [None, 1, 2])
def test_mikov_22_standstills_and_the_published_calibration(tmp_path, unit, seed):
    """1.5 of our standard uncertainty as in test_measured. With spikes the standstills and the
    samples of a mean are no longer quite the same ones: 2, for the worst of nine."""
    log = logs.read(measured.fetch(f"mikov/{unit}.log"), [*ACC, "gx", "gy", "gz"])
    log = without(log, "gx", "gy", "gz")
    run = stations_of(log if seed is None else spiked(log, seed), tmp_path, "--sampling-hz", 100)
    assert 22 <= len(run["ax"]) <= 24
    raw = np.stack([numbers(run[n]) for n in ACC], -1)
    made = calibrate(*measured.accelerometer_only(raw, 9.81, None))
    found = convert(made, "affine")["accelerometer"]
    ours, sd = measured.mikov_form(**found.values), measured.mikov_spread(found)
    rows = measured.fetch("mikov/published.csv").read_text().splitlines()
    names, column = rows[0].split(","), rows[0].split(",").index(unit)
    assert names[0] == "param"
    published = {r.split(",")[0]: float(r.split(",")[column]) for r in rows[1:]}
    order = ("sx_pct", "sy_pct", "sz_pct", "myz_deg", "mxy_deg", "mxz_deg", "bx", "by", "bz")
    theirs = np.array([published[f"acc_{n}"] for n in order])
    assert np.abs((ours - theirs) / sd).max() < (1.5 if seed is None else 2.0)
