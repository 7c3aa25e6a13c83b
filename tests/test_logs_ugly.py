"""Hostile and unlucky logs and options: every one is refused in a sentence, or gives honest figures.

Warnings are errors here, so that none reaches the screen.
"""

import datetime
import json
import os

import numpy as np
import pytest

import mwdcal as mwdcal_library
from cli_support import mwdcal, refused, write_csv
from mwdcal.errors import InputError
from mwdcal.files import logs
from mwdcal.files.formats.table import Table
from mwdcal.logs.noise import find_noise
from mwdcal.logs.stations import find_stations
from test_stations import ACC, tumble, without

RATE = 20


def rest(**channels):
    """A log at rest: white noise of 1e-3 at 20 samples a second, but for these channels."""
    rng = np.random.default_rng(4)
    noise = dict(
        zip(ACC, [[0.0], [0.3], [0.9]] + 1e-3 * rng.standard_normal((3, 1200)), strict=True)
    )
    return {**noise, **channels}


@pytest.fixture(scope="module")
def plain():
    return noise_of(rest())


def noise_of(columns, **options):
    table = Table(columns, {}, "log.csv", range(2, len(columns["ax"]) + 2))
    return find_noise(table, **{"sampling_hz": RATE, **options})


def texts(found, identity):
    return [f.text for f in found.findings if f.id == identity]


def no_number_is_missing(shown):
    """Whether a result for machines holds finite numbers alone."""

    def refuse(constant):
        raise AssertionError(constant)

    json.loads(shown, parse_constant=refuse)


# Options


@pytest.mark.parametrize(
    "value", ["1e308", "1.7976931348623157e308", "1e10", "inf", "nan", "-1e-9"]
)
@pytest.mark.parametrize("option", ["--trim-seconds", "--min-seconds"])
def test_times_of_no_station_are_refused_with_what_they_may_be(tmp_path, option, value):
    path = write_csv(tmp_path / "log.csv", tumble(1, stations=2, still=(3.0, 4.0))[0].columns)
    told = refused(mwdcal("stations", path, "-o", tmp_path / "run.csv", option, value), 2)
    assert f"{option} must be a number between 0 and 1e+09 s" in told
    assert not (tmp_path / "run.csv").exists()


@pytest.mark.parametrize("command", ["stations", "noise"])
@pytest.mark.parametrize("rate", ["1e-308", "5e-324", "1e308", "0", "-5", "nan"])
def test_a_rate_that_no_log_has_is_refused(tmp_path, command, rate):
    path = write_csv(tmp_path / "log.csv", rest())
    output = ["-o", tmp_path / "run.csv"] if command == "stations" else []
    told = refused(mwdcal(command, path, *output, "--sampling-hz", rate), 2)
    assert "--sampling-hz must be a number between 1e-12 and 1e+09 Hz" in told


@pytest.mark.parametrize("rate", ["1e-308", "9" * 400, "true", '"100"', "[100]", "100 Hz", "nan"])
def test_a_rate_in_the_metadata_is_a_number_like_any_other(tmp_path, rate):
    path = write_csv(tmp_path / "log.csv", rest(), f"sampling_hz = {rate}")
    told = refused(mwdcal("noise", path), 2)
    assert "log.csv: sampling_hz must be a number between 1e-12 and 1e+09 Hz" in told
    assert "give --sampling-hz" in told


def test_a_station_longer_than_any_log_is_refused_in_finite_numbers(tmp_path):
    path = write_csv(tmp_path / "log.csv", rest(), "sampling_hz = 20")
    told = refused(mwdcal("noise", path, "--station-seconds", "1e308"), 2)
    assert "--station-seconds must be a number above 0 and at most 1e+09 s" in told
    assert "inf" not in told


@pytest.mark.parametrize("threshold", ["0", "5e-324", "1e15"])
def test_any_threshold_can_be_drawn(tmp_path, threshold):
    path, plot = (
        write_csv(tmp_path / "log.csv", tumble(1, stations=2, still=(3.0, 4.0))[0].columns),
        tmp_path / "p.svg",
    )
    ran = mwdcal(
        "stations", path, "-o", tmp_path / "r.csv", "--threshold", threshold, "--plot", plot
    )
    refused(ran, 2)
    assert b"<svg" in plot.read_bytes()


def test_options_are_named_as_where_they_are_given(tmp_path):
    """On the command line with dashes, in the library as arguments."""
    log, *_ = tumble(1, stations=3)
    path, run = write_csv(tmp_path / "log.csv", log.columns), tmp_path / "run.csv"
    ran = mwdcal("stations", path, "-o", run, "--sampling-hz", 100, "--json")
    assert "! --sampling-hz 100 was given" in ran.err
    assert "--sampling-hz 100 was given" in ran.json["findings"][0]["text"]
    (told,) = texts(find_stations(log, sampling_hz=100.0), "time-not-used")
    assert told.startswith("`sampling_hz` 100 was given")
    ran = mwdcal("stations", path, "-o", run, "--min-seconds", 500)
    message = refused(ran, 2)
    assert "lower --min-seconds or --trim-seconds, or set --threshold." in message
    assert "--plot shows" in ran.err
    with pytest.raises(InputError, match="lower `min_seconds` or `trim_seconds`"):
        find_stations(log, min_seconds=500.0)


def test_one_of_something_is_singular(tmp_path):
    log, *_ = tumble(13, stations=1, still=(9, 9), move=(3, 3))
    time = log.columns["time_s"].copy()
    time[300] = time[299]
    path = write_csv(tmp_path / "log.csv", {**log.columns, "time_s": time})
    ran = mwdcal("stations", path, "-o", tmp_path / "run.csv")
    assert "   1 station, " in ran.out
    assert "! 1 sample of ax has the time of the one before" in ran.err
    one = np.where(ROWS == 5, 0.1, np.nan)
    (left,) = texts(noise_of(rest(ax=one)), "channel-left-out")
    assert left.startswith("ax has 1 sample; 128 are needed.")


@pytest.mark.parametrize("task", [mwdcal_library.stations, mwdcal_library.noise])
def test_columns_in_memory_are_checked_like_a_file(task):
    columns = rest(time_s=ROWS / RATE)
    late = np.where(ROWS == 5, np.inf, columns["ay"])
    for wrong, words in (
        ({k: v for k, v in columns.items() if k != "ay"}, "'ay' is missing"),
        ({k: v[:0] for k, v in columns.items()}, "no samples"),
        ({**columns, "ay": late}, "row 6, column 'ay': expected a finite number"),
        ({**columns, "ay": np.minimum(late, 1e200)}, "row 6, column 'ay': must be between -1e"),
        ({**columns, "time_s": ["12:00:00"] * 1200}, "row 1, column 'time_s': expected seconds"),
    ):
        with pytest.raises(InputError, match=words):
            task(wrong)
    for rate in ("fast", True, np.ones(2)):
        with pytest.raises(InputError, match=r"`sampling_hz` must be a number between"):
            task(columns, sampling_hz=rate)


@pytest.mark.parametrize("between", [("a", 5), (0, None), (0, np.nan)])
def test_a_part_of_a_log_is_two_numbers(between):
    with pytest.raises(
        InputError, match=r"`(start|end)` must be seconds from the start of the log"
    ):
        noise_of(rest(), between=between)


# Channels


ROWS = np.arange(1200.0)
NOISELESS = {
    "ramp": ROWS, "ramp in steps no number has": 0.1 * ROWS, "ramp far from zero": 1e6 + 1e-9 * ROWS,
    "ramp of large numbers": 1e11 * ROWS, "alternating": (-1.0) ** ROWS,
    "period of a station": np.mod(ROWS, 10), "below all units": 1e-300 * np.sin(ROWS**2),
    "denormal": 5e-324 * np.mod(ROWS**2, 7),
}  # fmt: skip


@pytest.mark.parametrize("value", NOISELESS.values(), ids=NOISELESS)
def test_a_channel_without_noise_is_left_out_and_the_others_go_on(plain, value):
    found = noise_of(rest(ax=value))
    assert list(found.channels) == ["ay", "az"]
    assert found.channels["ay"] == plain.channels["ay"]
    (told,) = texts(found, "channel-left-out")
    assert told.startswith("ax has no noise above the rounding of numbers")


def test_a_log_without_noise_is_refused(tmp_path):
    columns = {"ax": ROWS, "ay": 2 * ROWS, "az": 5 - ROWS}
    told = refused(mwdcal("noise", write_csv(tmp_path / "l.csv", columns, "sampling_hz = 20")), 2)
    assert "l.csv: no channel that could be used. ax has no noise" in told


@pytest.mark.parametrize("drift", [1e-3, 1.0, 1e3])
def test_noise_on_a_steep_ramp_is_still_noise(drift):
    """A million times the noise from sample to sample: the drift is found, and the white term."""
    columns = rest()
    found = noise_of({**columns, "ax": columns["ax"] + drift * ROWS / RATE})
    terms = found.channels["ax"].terms
    assert terms["drift"].value == pytest.approx(drift, rel=1e-2)
    assert terms["white"].value == pytest.approx(1e-3 / RATE**0.5, rel=0.15)


@pytest.mark.parametrize("unit", [5e-324, 1e-200, 1e-80])
def test_stations_of_a_channel_of_hardly_anything_are_those_without_it(unit):
    log, *_ = tumble(2, stations=4, hz=50.0)
    rng = np.random.default_rng(1)
    odd = unit * rng.integers(0, 9, len(log.columns["ax"]))
    found = find_stations(without(log, ax=odd))
    assert found.table.count == 4
    for name, column in found.table.columns.items():
        assert isinstance(column, list) or np.isfinite(column).all(), name


# Clocks


UNITS = {"s": 1, "ms": 1e3, "us": 1e6, "ns": 1e9}


def epoch(year):
    """Seconds from 1970 to a day of the year."""
    day = datetime.datetime(year, 5, 3, tzinfo=datetime.UTC)
    return (day - datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)).total_seconds()


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("year", [1966, 2121])
def test_clocks_of_any_year_are_judged_by_their_steps_alone(year, unit):
    """Seconds from 1970 are seconds; anything finer is taken as seconds too, and reported."""
    log, starts, *_ = tumble(1, stations=3, hz=50.0)
    clock = (epoch(year) + log.columns["time_s"]) * UNITS[unit]
    found = find_stations(without(log, time_s=clock))
    odd = texts(found, "time-unit")
    assert bool(odd) == (unit != "s")
    if unit == "s":
        assert found.table.count == 3
        within = found.table.columns["start_s"] - epoch(year) - starts
        assert np.all((within > 0) & (within < 1.5))
    calm = rest(time_s=(epoch(year) + ROWS / RATE) * UNITS[unit])
    calm = {name: column[:256] for name, column in calm.items()}
    still = noise_of(calm, sampling_hz=None)
    assert bool(texts(still, "time-unit")) == (unit != "s")
    given = noise_of(calm, sampling_hz=20.0)  # which settles it
    assert not texts(given, "time-unit")
    assert given.channels["ax"].sampling_hz == RATE


@pytest.mark.parametrize("command", ["stations", "noise"])
@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_timestamps_in_place_of_seconds_are_refused_whatever_their_unit(tmp_path, command, unit):
    arrow = pytest.importorskip("pyarrow")
    path = tmp_path / "log.parquet"
    for year in (1966, 2121):
        ticks = round((epoch(year) + 3600) * UNITS[unit]) + np.arange(1200)
        stamps = arrow.array(ticks, arrow.timestamp(unit))
        table = arrow.table({"time_s": stamps, **rest()})
        pytest.importorskip("pyarrow.parquet").write_table(table, path)
        output = ["-o", tmp_path / "run.csv"] if command == "stations" else []
        told = refused(mwdcal(command, path, *output), 2)
        assert "row 1, column 'time_s': expected seconds as a number; got the date" in told
        assert f"'{year}-05-03T01:00:00" in told


CLOCKS = {
    "steps of nothing": (ROWS * 1e-300, "the rate must be a number between 1e-12 and 1e+09 Hz"),
    "the least steps": (ROWS * 5e-324, "the rate must be a number between"),
    "steps of ages": (ROWS * 1e16, "must be between -1e+19 and 1e+19 s"),
    "from end to end": (np.r_[-1e308, ROWS[2:], 1e308], "must be between -1e+19 and 1e+19 s"),
    "one jump": (np.r_[ROWS[:-1] / 20, 1e12], "must not jump so far"),
}  # fmt: skip


@pytest.mark.parametrize("command", ["stations", "noise"])
@pytest.mark.parametrize(("clock", "words"), CLOCKS.values(), ids=CLOCKS)
def test_clocks_that_are_none_are_refused(tmp_path, command, clock, words):
    path = write_csv(tmp_path / "log.csv", {"time_s": clock, **rest()})
    output = ["-o", tmp_path / "run.csv"] if command == "stations" else []
    told = refused(mwdcal(command, path, *output), 2)
    assert words in told
    assert "column 'time_s'" in told


STOPPED = {
    "stopped": np.full(1200, 5.0), "coarse": np.floor(ROWS / 600), "denormal": 5e-324 * ROWS,
    "blank at both ends": np.where((ROWS > 3) & (ROWS < 1000), ROWS / 40, np.nan),
    "blank": np.full(1200, np.nan),
}  # fmt: skip


@pytest.mark.parametrize("clock", STOPPED.values(), ids=STOPPED)
def test_a_clock_beside_a_given_rate_is_only_compared(tmp_path, clock):
    path = write_csv(tmp_path / "log.csv", {"time_s": clock, **rest()})
    ran = mwdcal("noise", path, "--sampling-hz", RATE, "--json")
    assert ran.code == 0, ran
    no_number_is_missing(ran.out)
    assert ran.json["channels"]["ax"]["sampling_hz"] == RATE
    (told,) = [f["text"] for f in ran.json["findings"] if f["id"] == "rate"] or [""]
    assert bool(told) == (not np.isnan(clock).all())
    assert "nan" not in told
    assert "inf" not in told


# Cells and files


CELLS = [
    "9" * 400, "-" + "9" * 400, "9" * 5000, "1e400", "1e16", "0x10", "1_000", "\u0661", "1\x00",
]  # fmt: skip


@pytest.mark.parametrize("command", ["stations", "noise"])
@pytest.mark.parametrize("cell", CELLS, ids=lambda cell: ascii(cell)[:12])
def test_cells_that_are_no_numbers_of_a_channel_are_refused(tmp_path, command, cell):
    columns = {n: [repr(float(v)) for v in c] for n, c in rest(time_s=ROWS / RATE).items()}
    columns["ay"][300] = cell
    path = write_csv(tmp_path / "log.csv", columns)
    output = ["-o", tmp_path / "run.csv"] if command == "stations" else []
    told = refused(mwdcal(command, path, *output), 2)
    assert "log.csv, line 302" in told


def test_digits_beyond_a_double_are_rounded(tmp_path):
    columns = {n: [repr(float(v)) for v in c] for n, c in rest(time_s=ROWS / RATE).items()}
    plain = mwdcal("noise", write_csv(tmp_path / "log.csv", columns), "--json").json
    columns["ay"][300] += "0" * 400
    columns["az"][7] = "0." + f"{float(columns['az'][7]):.17f}"[2:] + "1" * 400
    long = mwdcal("noise", write_csv(tmp_path / "log.csv", columns), "--json").json
    assert long["channels"]["ay"] == plain["channels"]["ay"]
    assert long["channels"]["az"]["station"] == pytest.approx(plain["channels"]["az"]["station"])


@pytest.mark.parametrize("command", ["stations", "noise"])
@pytest.mark.parametrize("suffix", [".csv", ".txt", ".parquet", ".xlsx"])
def test_what_never_ends_is_not_waited_for(tmp_path, command, suffix):
    output = ["-o", tmp_path / "run.csv"] if command == "stations" else []
    pipe, endless = tmp_path / f"pipe{suffix}", tmp_path / f"zero{suffix}"
    os.mkfifo(pipe)
    endless.symlink_to("/dev/zero")
    for path in (pipe, endless):
        assert "is not a regular file" in refused(mwdcal(command, path, *output), 2)


@pytest.mark.parametrize(
    "line", [b"," * 2_000_000, b"1 " * 2_000_000, b"# a = " + b"[" * 2_000_000]
)
def test_a_first_line_without_end_is_refused_before_it_is_split(tmp_path, line):
    path = tmp_path / "log.csv"
    path.write_bytes(line)
    told = refused(mwdcal("noise", path), 2)
    assert "log.csv, line 1: the line must have at most 1000000 bytes" in told


COLUMNS = {
    "time_s,ax,ay": "'az' is missing", "time_s,ax,ay,ay": "unique; got 'ay'", "1,2,3,4": "got numbers",
    "time_s;ax;ay;az": "'ax', 'ay', 'az' are missing", "time_s,ax,ay,": "column 4 has none",
    "time_s,ax,ay,az,mx,my,mz": "expected 7 cells", ",": "must have a name", "t,AX,ay,az": "'AX'",
}  # fmt: skip


@pytest.mark.parametrize(("names", "words"), COLUMNS.items(), ids=COLUMNS)
def test_wrong_names_of_columns_are_refused(tmp_path, names, words):
    path = write_csv(tmp_path / "log.txt", rest(time_s=ROWS / RATE))
    path.write_text(path.read_text("utf-8").split("\n", 1)[1], "utf-8")
    told = refused(mwdcal("noise", path, "--columns", names), 2)
    assert words in told


def test_a_log_of_many_pieces_is_that_of_one(tmp_path, monkeypatch):
    """Lines that grow shorter are more than there seemed to be room for."""
    rows = [(f"{k / 10:.{8 - k // 500}f}", k % 7 + 0.5) for k in range(3_000)]
    path = tmp_path / "log.csv"
    lines = (f"{t},{x},{x},{x}\n" for t, x in rows)
    path.write_text("time_s,ax,ay,az\n" + "".join(lines), "utf-8")
    whole = logs.read(path)
    monkeypatch.setattr(logs, "_PIECE", 1_000)
    in_pieces = logs.read(path)
    for name, column in whole.columns.items():
        np.testing.assert_array_equal(in_pieces.columns[name], column)
    np.testing.assert_array_equal(whole.columns["ax"], [x for _, x in rows])
