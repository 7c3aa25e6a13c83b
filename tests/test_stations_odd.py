"""Logs in which something is odd: what is found, what is told, and what is refused how.

What is expected comes from the simulation: where it stood still, what was broken, and where.
"""

import numpy as np
import pytest

from cli_support import mwdcal, refused, write_csv
from mwdcal.errors import InputError
from mwdcal.files.formats.table import Table
from mwdcal.logs import standstill
from mwdcal.logs.regular import unlikely_seconds
from mwdcal.logs.stations import StandstillError, find_stations
from test_stations import ACC, MAG, means, multi_rate, tumble, without


def finding(found, name):
    """The only finding of this id."""
    (one,) = [f for f in found.findings if f.id == name]
    return one


def ids(found):
    return [f.id for f in found.findings]


def inside(time, start, end):
    return (time >= start) & (time <= end)


# Channels


def test_a_channel_at_its_limit_is_told_and_not_trusted():
    log, *_, aims = tumble(3, stations=20)
    limit = 0.6
    found = find_stations(without(log, ax=np.minimum(log.columns["ax"], limit)))
    beyond = np.flatnonzero(aims[:, 0] > limit + 0.02)
    assert len(beyond) > 2
    told = finding(found, "stuck-channel")
    for station in beyond + 1:
        assert f"{station}" in told.text.replace(")", ",")
    sd = found.table.columns["sd_ax"]
    assert sd[beyond].min() > 0.2  # of a range of 1.6
    fine = np.flatnonzero(aims[:, 0] < limit - 0.02)
    assert sd[fine].max() < 1e-3


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_a_dead_channel_is_told_whatever_the_unit(unit):
    log, starts, *_ = tumble(2)
    columns = {n: unit * log.columns[n] for n in ACC}
    columns["ay"] = np.full(len(columns["ay"]), 1.2345 * unit)
    found = find_stations(without(log, **columns))
    assert found.table.count == len(starts)
    assert "ay reads" in finding(found, "dead-channel").text


def test_a_dead_channel_reads_no_less_than_nothing():
    log, *_ = tumble(2, stations=3)
    found = find_stations(without(log, ay=np.full(len(log.columns["ay"]), -0.0)))
    assert "ay reads 0 from" in finding(found, "dead-channel").text


def test_nothing_but_dead_channels():
    dead = dict.fromkeys(ACC, np.full(3000, 0.5))
    log = Table({"time_s": np.arange(3000) / 100, **dead}, {}, "log.csv", range(2, 3002))
    with pytest.raises(InputError, match="no channel ever changes"):
        find_stations(log)


def test_a_knock_within_a_standstill_is_told():
    """Fifteen standard deviations of a sample, too small to be a movement."""
    log, starts, ends, _ = tumble(5, noise=1e-3, stations=15)
    time, value = log.columns["time_s"], log.columns["ay"].copy()
    value[inside(time, (starts[6] + ends[6]) / 2, ends[6])] += 0.015
    told = finding(find_stations(without(log, ay=value)), "unsteady")
    assert told.station == "7"
    assert "ay" in told.text
    assert "1 station of 15" in told.text


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("hz", [1, 2, 5])
def test_a_slow_magnetometer_tells_turns_about_the_vertical(seed, hz):
    """Six turns that the accelerometer hardly sees: nothing but noise in its readings."""
    rng = np.random.default_rng(seed)
    azimuth = np.radians(60.0 * np.arange(6))
    ends = np.cumsum(rng.uniform(20, 24, 6) + 3.0)
    starts = ends - rng.uniform(18, 20, 6)
    time = np.arange(int((ends[-1] + 5) * 100)) / 100
    knots = np.stack([starts, ends], -1).ravel()
    turned = np.interp(time, knots, np.repeat(azimuth, 2))
    field = np.stack([0.4 * np.cos(turned), 0.4 * np.sin(turned), 0.9 + 0 * turned], -1)
    field += 2e-3 * rng.standard_normal(field.shape)
    field[np.arange(len(time)) % (100 // hz) != 0] = np.nan
    gravity = [0, 0, 1] + 1e-3 * rng.standard_normal((len(time), 3))
    columns = {"time_s": time, **dict(zip(ACC, gravity.T, strict=True))}
    columns |= dict(zip(MAG, field.T, strict=True))
    found = find_stations(Table(columns, {}, "log.csv", range(2, len(time) + 2)))
    assert found.table.count == 6
    first, last = (found.table.columns[n] for n in ("start_s", "end_s"))
    assert np.all(first[1:] >= starts[1:] - 0.1)  # before the first turn it stands as well
    assert np.all(last[:-1] <= ends[:-1] + 0.1)
    expected = 0.4 * np.stack([np.cos(azimuth), np.sin(azimuth)], -1)
    sd = means(found, ("sd_mx", "sd_my"))
    assert sd.max() < 2e-3
    assert np.abs((means(found, ("mx", "my")) - expected) / sd).max() < 5


# Temperature


def test_a_thermometer_that_stops_leaves_blanks():
    log, *_, warmth = multi_rate()
    time = log.columns["time_s"]
    stop = 0.5 * time[-1]
    found = find_stations(
        without(log, temperature_c=np.where(time < stop, log.columns["temperature_c"], np.nan))
    )
    given = ~np.isnan(found.table.columns["temperature_c"])
    late = found.table.columns["start_s"] > stop + 5 * 4.0
    early = found.table.columns["end_s"] < stop
    assert given[early].all()
    assert not given[late].any()
    assert f"{np.count_nonzero(~given)} station" in finding(found, "no-temperature-nearby").text
    for i in np.flatnonzero(early):
        there = inside(time, found.table.columns["start_s"][i], found.table.columns["end_s"][i])
        own = found.table.columns["temperature_c"][i]
        assert own == pytest.approx(warmth[there].mean(), abs=0.05)


def test_impossible_temperatures_are_left_out_and_told():
    log, *_ = multi_rate()
    reading = log.columns["temperature_c"]
    there = ~np.isnan(reading)
    found = find_stations(without(log, temperature_c=np.where(there, -999.0, np.nan)))
    assert "temperature_c" not in found.table.columns
    assert "-999" in finding(found, "impossible-temperature").text
    plain = find_stations(log).table.columns["temperature_c"]
    one = reading.copy()
    one[np.flatnonzero(there)[3]] = 1e5
    found = find_stations(without(log, temperature_c=one))
    assert "1 of" in finding(found, "impossible-temperature").text
    np.testing.assert_allclose(found.table.columns["temperature_c"], plain, atol=0.2)


# Rates and clocks


@pytest.mark.parametrize("slower", [5, 20])
def test_a_rate_that_drops_half_way_loses_no_standstill(slower):
    log, _, ends, aims = tumble(4, stations=20, still=(8, 14))
    half = len(log.columns["time_s"]) // 2
    rows = np.r_[0:half, half : 2 * half : slower]
    columns = {n: c[rows] for n, c in log.columns.items()}
    found = find_stations(Table(columns, {}, "log.csv", range(2, len(rows) + 2)))
    first, last = (found.table.columns[n] for n in ("start_s", "end_s"))
    own = np.searchsorted(ends, (first + last) / 2)
    assert set(own) == set(range(20))  # the one in which it drops may be two
    assert found.table.count <= 21
    sd = means(found, tuple(f"sd_{n}" for n in ACC))
    assert np.abs((means(found) - aims[own]) / sd).max() < 6


@pytest.mark.parametrize("ticks", [1, 2, 10])
def test_a_coarse_clock(ticks):
    """Time written in whole seconds, halves and tenths: a hundred samples a second all the same."""
    log, starts, _, aims = tumble(4, stations=15)
    coarse = np.floor(log.columns["time_s"] * ticks + 1e-9) / ticks
    found = find_stations(without(log, time_s=coarse))
    assert found.table.count == len(starts)
    sd = means(found, tuple(f"sd_{n}" for n in ACC))
    assert np.abs((means(found) - aims) / sd).max() < 6
    assert "duplicate-time" in ids(found)


def test_a_given_rate_wins_and_says_so():
    log, starts, *_ = tumble(1)
    found = find_stations(log, sampling_hz=50.0)
    assert found.table.count == len(starts)
    assert found.time[-1] == pytest.approx((len(found.time) - 1) / 50)
    assert "'time_s' is not used" in finding(found, "time-not-used").text


@pytest.mark.parametrize("offset", [0.0, 0.3, 1.77e9])
@pytest.mark.parametrize("hz", [15, 20, 50, 100])
def test_equal_dropouts_are_judged_alike_whatever_the_clock_shows(hz, offset):
    """All but one sample of a cell lost in a row are no gap, a whole cell is one."""
    size = max(3, round(0.2 * hz))
    for lost, least in ((size - 1, 0), (size, 20)):
        starts = np.arange(10, 20_000, 15 * size + 1)  # anywhere in a cell
        kept = np.setdiff1d(np.arange(20_000), np.add.outer(starts, np.arange(lost)))
        cells = standstill.cells_of(offset + kept / hz, np.sin(kept), 0.2)
        own = kept[: len(cells.torn) * size].reshape(-1, size)
        np.testing.assert_array_equal(cells.torn, np.diff(own).max(-1) > size)
        assert (cells.torn.sum() > 0) == (least > 0)
        assert cells.torn.sum() >= least


@pytest.mark.parametrize("shift", [0, 1, 7, 13, 19])
def test_blanks_of_one_channel_end_a_standstill_and_are_told(shift):
    """Half a second, within cells of 20 samples or between: the times of the rows do not show it."""
    log, starts, ends, _ = tumble(2, stations=5, still=(8, 12))
    ay = log.columns["ay"].copy()
    first = 20 * int(5 * (starts[2] + ends[2]) / 2) + shift
    ay[first : first + 50] = np.nan
    plain, found = find_stations(log), find_stations(without(log, ay=ay))
    assert "gaps" not in ids(plain)
    assert found.table.count == 6
    told = finding(found, "gaps").text
    assert told.startswith("ay has 1 gap of several samples, the first after ")
    at = float(told.split("the first after ")[1].split()[0])
    assert 0 <= first / 100 - at <= 0.21
    start, end = (found.table.columns[n] for n in ("start_s", "end_s"))
    assert not np.any((start < first / 100) & (end > (first + 50) / 100))


@pytest.mark.parametrize(
    ("hz", "hours", "told"),
    [
        (100, 0.2, ""), (1, 1, ""), (1, 12, ""), (20, 27, ""),
        (1, 27, "samples are 1 s apart and the log lasts 1.125 days by time_s"),
        (0.01, 220, "samples are 100 s apart and the log lasts 9.1667 days by time_s"),
        (0.05, 5, "samples are 20 s apart and the log lasts 1.8e+04 s by time_s"),
    ],
)  # fmt: skip
def test_times_that_can_hardly_be_seconds(hz, hours, told):
    found = unlikely_seconds(np.arange(round(hours * 3600 * hz) + 1) / hz)
    assert [f.id for f in found] == ["time-unit"] * bool(told)
    assert not told or found[0].text.startswith(f"{told}: is it in milliseconds")


@pytest.mark.parametrize("unit", [1e3, 1e6])
def test_a_clock_in_milliseconds_is_told(unit):
    log, *_ = tumble(1, hz=20.0)
    assert "time-unit" in ids(find_stations(without(log, time_s=unit * log.columns["time_s"])))
    assert "time-unit" not in ids(find_stations(log))


@pytest.mark.parametrize("name", ["t", "time", "timestamp", "time_ms", "Clock (ms)"])
def test_a_clock_of_another_name_is_named(tmp_path, name):
    log, *_ = tumble(1, stations=2)
    columns = {name if n == "time_s" else n: c for n, c in log.columns.items()}
    told = refused(mwdcal("stations", write_csv(tmp_path / "log.csv", columns), "-o", "r.csv"), 2)
    assert f"got '{name}'. Rename it to 'time_s'" in told
    assert "--sampling-hz 100" in told
    del columns[name]
    columns["T"] = columns["ax"]  # a temperature
    told = refused(mwdcal("stations", write_csv(tmp_path / "log.csv", columns), "-o", "r.csv"), 2)
    assert "got neither" in told


@pytest.mark.parametrize("command", [("stations", "-o", "run.csv"), ("noise",)])
def test_a_parquet_log_without_rows(tmp_path, command):
    arrow = pytest.importorskip("pyarrow")
    path = tmp_path / "log.parquet"
    none = arrow.table({n: arrow.array([], arrow.float64()) for n in ("time_s", *ACC)})
    pytest.importorskip("pyarrow.parquet").write_table(none, path)
    told = refused(mwdcal(command[0], path, *command[1:]), 2)
    assert "log.parquet: the log has no samples" in told


# Standstills that are not taken


@pytest.mark.parametrize("command", ["stations", "noise"])
@pytest.mark.parametrize("value", ["1e200", "-1e308"])
def test_numbers_that_no_channel_reads_are_refused(tmp_path, command, value):
    """Their squares would overflow; a run file may not have them either."""
    log, *_ = tumble(2)
    columns = {name: [f"{v:.6f}" for v in log.columns[name]] for name in ("time_s", *ACC)}
    columns["ay"][300] = value
    path = write_csv(tmp_path / "log.csv", columns)
    output = ["-o", tmp_path / "run.csv"] if command == "stations" else []
    message = refused(mwdcal(command, path, *output), 2)
    assert "log.csv, line 302, column 'ay': must be between -1e+15 and 1e+15" in message


def test_noisy_rests_are_told_with_the_threshold_that_takes_them():
    log, starts, ends, _ = tumble(6, stations=20, still=(8, 14), noise=1e-3)
    time = log.columns["time_s"]
    rng = np.random.default_rng(8)
    columns = {n: log.columns[n].copy() for n in ACC}
    for a, b in zip(starts[1::2], ends[1::2], strict=True):
        there = inside(time, a, b)
        for name in ACC:
            columns[name][there] += 0.02 * rng.standard_normal(there.sum())
    shaken = without(log, **columns)
    found = find_stations(shaken)
    told = finding(found, "noisy-rest").text
    assert found.table.count + int(told.split()[0]) == 20
    threshold = float(told.split("`threshold` ")[1].split()[0])
    assert find_stations(shaken, threshold=threshold).table.count == 20


@pytest.mark.parametrize("period", [20.0, 60.0])
def test_slow_turns_are_no_noisy_rests(period):
    time = np.arange(20_000) / 100
    turn = 2 * np.pi * time / period
    read = np.stack([np.sin(turn), np.cos(turn), 0.3 * np.sin(0.37 * turn)], -1)
    read += 5e-3 * np.random.default_rng(1).standard_normal(read.shape)
    log = Table(dict(zip(ACC, read.T, strict=True)), {}, "log.csv", range(2, len(time) + 2))
    with pytest.raises(InputError) as told:
        find_stations(log, sampling_hz=100.0)
    assert "noisy-rest" not in ids(told.value.analysis)


@pytest.mark.filterwarnings("error")
def test_a_channel_of_one_sample_warns_of_nothing():
    log, *_ = tumble(6, stations=3)
    once = np.where(np.arange(len(log.columns["ax"])) == 700, 0.3, np.nan)
    with pytest.raises(InputError, match="no standstill of at least"):
        find_stations(without(log, **dict.fromkeys(MAG, once)))


@pytest.mark.parametrize("share", [0.3, 0.5, 0.8])
@pytest.mark.parametrize("later", [20.0, 42.7, 300.0])
def test_a_clock_of_two_readings(later, share):
    """Samples of one time are spread over the step to the next, the last ones beyond the log."""
    log, *_ = tumble(2)
    first = int(share * log.count)
    clock = np.repeat([0.0, later], [first, log.count - first])
    try:
        table = find_stations(without(log, time_s=clock)).table
    except StandstillError:
        return
    assert table.columns["samples"].min() >= 3
    assert set(table.columns["start_s"]) | set(table.columns["end_s"]) <= {0.0, later}


def test_a_refusal_says_how_long_it_stood_still(tmp_path):
    log, starts, ends, _ = tumble(3, stations=10, still=(5, 8))
    path = write_csv(tmp_path / "log.csv", {**log.columns, "gx": np.zeros(len(log.columns["ax"]))})
    out, plot = tmp_path / "run.csv", tmp_path / "log.svg"
    ran = mwdcal("stations", path, "-o", out, "--min-seconds", 12, "--plot", plot)
    told = refused(ran, 2)
    longest = float(told.split("longest calm interval lasts ")[1].split()[0])
    assert longest == pytest.approx((ends - starts).max() - 2, abs=1.0)
    assert "! columns not used: 'gx' (resembles 'ax')." in ran.err
    assert b"<svg" in plot.read_bytes()
    assert not out.exists()
    told = refused(mwdcal("stations", path, "-o", out, "--trim-seconds", 20), 2)
    assert "nothing is left after 20 s" in told


@pytest.mark.parametrize(
    "clock", ["2024-01-01T00:00:00.00", "2024-01-01 00:00:01", "00:00:01.5", "1.2.2024"]
)
def test_dates_in_place_of_seconds_are_refused_as_such(tmp_path, clock):
    path = tmp_path / "log.txt"
    path.write_text(f"time_s;ax;ay;az\n0;1;2;3\n{clock};1;2;3\n")
    told = refused(mwdcal("stations", path, "-o", tmp_path / "run.csv"), 2)
    assert "log.txt, line 3, column 'time_s': expected seconds" in told
