"""Allan deviations, their statistics, noise terms, and `mwdcal noise`.

Simulated records come from filters written here, not from the covariances of the package.
"""

import hashlib
import os
import re
from functools import cache

import numpy as np
import pytest

from cli_support import mwdcal, refused, write_csv
from mwdcal.files import logs
from mwdcal.files.profiles import load_profile
from mwdcal.logs import allan, noise
from mwdcal.logs.noise import find_noise
from test_stations import tumble

KINDS = ("overlapping", "modified", "standard")
BATCHES = [(), (1,), (3, 1, 2)]
PHASE = np.array(
    [0, 103.11111, 123.22222, 157.33333, 166.44444, 48.55555, -96.33333, -2.22222, 111.88889, 0]
)
"""NBS14: NIST SP 1065, section 12."""
RATE = 50.0


remembered = cache(allan.moments)


@pytest.fixture(autouse=True)
def equal_moments_once(monkeypatch, computed_once):
    """The moments of records of one length are the same in many tests: computed once.

    And so is the noise of one log, whatever is shown of it, and of a channel that logs share.
    """

    def moments(count, averaging, kind="overlapping"):
        return remembered(count, tuple(averaging), kind)

    monkeypatch.setattr(allan, "moments", moments)


def thousand():
    """The 1000 frequencies of NIST SP 1065, section 12.4."""
    number, found = 1234567890, []
    for _ in range(1000):
        found.append(number / 2147483647)
        number = 16807 * number % 2147483647
    return np.array(found)


# --- deviations -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "printed"),
    [
        ("standard", ("91.22945", "115.8082")),
        ("overlapping", ("91.22945", "85.95287")),
        ("modified", ("91.22945", "74.78849")),
    ],
)
def test_ten_points_of_nist(kind, printed):
    found = allan.deviation(np.diff(PHASE), [1, 2], kind)
    assert tuple(f"{v:.7g}" for v in found) == printed


@pytest.mark.parametrize(
    ("kind", "printed"),
    [
        ("standard", (0.2922319, 0.09965736, 0.03897804)),
        ("overlapping", (0.2922319, 0.09159953, 0.03241343)),
        ("modified", (0.2922319, 0.06172376, 0.02170921)),
    ],
)
def test_thousand_points_of_nist(kind, printed):
    found = allan.deviation(thousand(), [1, 10, 100], kind)
    assert [float(f"{v:.7g}") for v in found] == list(printed)


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("kind", KINDS)
def test_equals_allantools(kind, batch):
    allantools = pytest.importorskip("allantools")
    function = {"overlapping": "oadev", "modified": "mdev", "standard": "adev"}[kind]
    factors = [1, 2, 3, 7, 32, 100, 250]
    values = np.random.default_rng(5).normal(size=(*batch, 1003)).cumsum(-1) + 3e4
    found = allan.deviation(values, factors, kind)
    assert found.shape == (*batch, len(factors))
    for index in np.ndindex(*batch):
        _, theirs, _, _ = getattr(allantools, function)(
            values[index] - values[index].mean(), rate=1.0, data_type="freq", taus=factors
        )
        np.testing.assert_allclose(found[index], theirs, rtol=1e-10)


def test_an_offset_of_a_billion_noises_costs_no_digits():
    values = np.random.default_rng(1).normal(size=4096)
    found = allan.deviation(values + 2.0**30, [1, 16, 1024])
    np.testing.assert_allclose(found, allan.deviation(values, [1, 16, 1024]), rtol=1e-5)


@pytest.mark.parametrize("kind", ["standard", "overlapping", "modified"])
def test_variances_of_blocks_are_those_of_the_whole(kind):
    """Both variances by their definition, from averages of the readings, in a record of several blocks with a drift."""
    count = 2 * allan.BLOCK_SAMPLES + 777
    values = np.random.default_rng(3).normal(size=(2, count)) + 1e-3 * np.arange(count) + 5.0
    plain, centred = allan.variances(values, [1, 4, 1000], kind)
    for k, m in enumerate((1, 4, 1000)):
        sums = np.cumsum(np.insert(values, 0, 0.0, -1), -1)
        averages = (sums[:, m:] - sums[:, :-m]) / m
        steps = averages[:, m:] - averages[:, :-m]
        if kind == "standard":
            steps = steps[:, ::m]
        elif kind == "modified":
            sums = np.cumsum(np.insert(steps, 0, 0.0, -1), -1)
            steps = (sums[:, m:] - sums[:, :-m]) / m
        np.testing.assert_allclose(plain[:, k], (steps**2).mean(-1) / 2, rtol=1e-7)
        np.testing.assert_allclose(centred[:, k], steps.var(-1) / 2, rtol=1e-7)


def test_nan_stays_nan_and_other_records_do_not_see_it():
    values = np.random.default_rng(1).normal(size=(2, 100))
    values[0, 50] = np.nan
    found = allan.deviation(values, [1, 4])
    assert np.isnan(found[0]).all()
    assert np.isfinite(found[1]).all()


@pytest.mark.parametrize(
    ("factor", "kind"), [(0, "overlapping"), (51, "standard"), (34, "modified")]
)
def test_factors_that_a_record_cannot_have(factor, kind):
    with pytest.raises(ValueError, match="averaging"):
        allan.deviation(np.zeros(100), [factor], kind)


def test_a_line_is_drift_alone():
    line = 0.25 * np.arange(600.0) + 7
    np.testing.assert_allclose(allan.deviation(line, [1, 8]), 0.25 * np.array([1, 8]) / np.sqrt(2))
    np.testing.assert_allclose(allan.variance(line, [1, 8], centred=True), 0, atol=1e-20)
    assert allan.drift(line) == pytest.approx(0.25)


# --- expectations and covariances -------------------------------------------------------------


def dense(count, m, k):
    """Covariance matrix (4, M, K) of differences over m and over k, from generalised covariances."""
    first, second = np.arange(count - 2 * m + 1)[:, None], np.arange(count - 2 * k + 1)
    total = 0
    for p, one in enumerate((1, -2, 1)):
        for q, other in enumerate((1, -2, 1)):
            lag = np.abs(first + p * m - second - q * k).astype(float)
            log = np.log(np.where(lag > 0, lag, 1))
            terms = [lag == 0, -lag / 2, lag**2 * log / (2 * np.pi), lag**3 / 12]
            total = total + one * other * np.stack(terms)
    return total / (m * k)


@cache
def products(count, m, k):
    """Mean products (4, 4) of the elements of the matrices of two terms, and mean diagonals (4,).

    Both after the mean of the differences is taken off.
    """
    matrix = dense(count, m, k)
    matrix -= matrix.mean(1, keepdims=True)
    matrix -= matrix.mean(2, keepdims=True)
    flat = matrix.reshape(4, -1)
    return flat @ flat.T / flat.shape[1], np.diagonal(matrix, axis1=1, axis2=2).mean(1)


@pytest.mark.parametrize("squares", [*np.eye(4), (1, 0.3, 0.1, 0.01), (0, 1, 0, 1e-4)], ids=str)
def test_moments_equal_those_of_whole_covariance_matrices(squares):
    count, factors = 512, [1, 2, 16, 64, 128]
    found = allan.moments(count, factors)
    weights = np.asarray(squares, float)
    ours = np.einsum("mnac,a,c->mn", found.covariance, weights, weights)
    theirs = np.zeros_like(ours)
    for i, m in enumerate(factors):
        for j, k in enumerate(factors):
            squares_of, diagonal = products(count, m, k)
            theirs[i, j] = weights @ squares_of @ weights / 2
            if i == j:
                assert found.mean[i] @ weights == pytest.approx(diagonal @ weights / 2, rel=0.002)
    scale = np.sqrt(np.diag(theirs))
    np.testing.assert_allclose(
        ours / np.outer(scale, scale), theirs / np.outer(scale, scale), atol=0.03
    )


@pytest.mark.parametrize(("kind", "first"), [("overlapping", 32), ("modified", 8)])
@pytest.mark.parametrize(("term", "slope"), [(0, 2), (1, 0), (2, -1), (3, -2)])
def test_degrees_of_freedom_are_those_of_greenhall_and_riley(kind, first, term, slope):
    allantools = pytest.importorskip("allantools")
    count = 4096
    factors = allan.octaves(count)
    ours = allan.freedom(allan.moments(count, factors, kind), np.eye(4)[term], np.array(0.0))
    theirs = [
        allantools.edf_greenhall(
            slope, 2, m, count + 1, overlapping=True, modified=kind == "modified"
        )
        for m in factors
    ]
    near = np.array(factors) >= first
    np.testing.assert_allclose(ours[near], np.array(theirs)[near], rtol=0.06 if first > 8 else 0.02)


def test_degrees_of_freedom_of_white_noise_in_closed_form():
    """Differences of successive white readings: variance 2, covariance -1 with their neighbours."""
    moments = allan.moments(1000, allan.octaves(1000))
    found = allan.freedom(moments, np.array([0, 1.0, 0, 0]), np.array(0.0))
    terms = 999
    assert found[0] == pytest.approx(
        2 * terms**2 * 4 / (2 * (4 * terms + 2 * (terms - 1))), rel=1e-12
    )


# --- statistics over many seeds ---------------------------------------------------------------

SEEDS, COUNT = 200, 8192
WALK, FLICKER = np.sqrt(3) / 80, 0.2
CASES = {
    "white": (0, 1, 0, 0, 0),
    "white and random walk": (0, 1, 0, WALK, 0),
    "quantisation, white and random walk": (2, 1, 0, WALK, 0),
    "bias instability": (0, 1, FLICKER, 0, 0),
    "random walk and drift": (0, 1, 0, WALK / 4, 40 / COUNT),
    "drift": (0, 1, 0, 0, 1 / COUNT),
}
TRUE = {name: np.square(case[:4]) for name, case in CASES.items()}


def simulated(seed, count, quantisation, white, bias, walk, drift):
    """Records (SEEDS, count); bias instability by a half integration (Kasdin 1995)."""
    rng = np.random.default_rng(seed)
    values = white * rng.normal(size=(SEEDS, count)) + drift * np.arange(count)
    values += quantisation * np.diff(rng.normal(size=(SEEDS, count + 1)), axis=-1)
    values += walk * np.cumsum(rng.normal(size=(SEEDS, count)), -1)
    if bias:
        length = 4 * count
        half = np.cumprod(np.concatenate([[1], 1 - 0.5 / np.arange(1, length)]))
        filtering = np.fft.rfft(half, 2 * length)
        for row in values:
            source = np.fft.rfft(rng.normal(size=length), 2 * length)
            row += bias * np.fft.irfft(source * filtering)[length - count : length]
    return values


@cache
def fitted(name):
    values = simulated(7, COUNT, *CASES[name])
    factors = allan.octaves(COUNT)
    moments = allan.moments(COUNT, factors)
    centred = allan.variance(values, factors, centred=True)
    terms = allan.fit(centred, allan.drift(values), moments)
    return terms, moments, allan.deviation(values, factors)


@pytest.mark.parametrize("name", CASES)
def test_terms_are_unbiased(name):
    terms = fitted(name)[0]
    spread = terms.square.std(0, ddof=1)
    # Kasdin's process has a little more noise at single samples than an averaging sensor
    bias = (terms.square.mean(0) - TRUE[name])[1 if CASES[name][2] else 0 :]
    spread = spread[1 if CASES[name][2] else 0 :]
    assert np.all(np.abs(bias) < 3.3 * spread / np.sqrt(SEEDS))
    slopes = terms.slope - CASES[name][4]
    assert abs(slopes.mean()) < 3.3 * slopes.std() / np.sqrt(SEEDS)


@pytest.mark.parametrize("name", CASES)
def test_intervals_hold_what_they_promise(name):
    """95 % nominal; a term that is absent is covered by every bound."""
    terms = fitted(name)[0]
    inside = ((terms.lower <= TRUE[name]) & (TRUE[name] <= terms.upper)).mean(0)
    present = TRUE[name] > 0
    assert np.all((inside[present] >= 0.91) & (inside[present] <= 0.99)), inside
    assert np.all(inside[~present] >= 0.95), inside
    drift = np.abs(terms.slope - CASES[name][4]) < 1.96 * terms.slope_sd
    assert drift.mean() >= 0.93


def test_coverage_of_all_terms_that_are_present():
    inside = []
    for name in CASES:
        terms, present = fitted(name)[0], TRUE[name] > 0
        inside.append(((terms.lower <= TRUE[name]) & (TRUE[name] <= terms.upper))[:, present])
    assert 0.935 < np.mean(np.concatenate([own.ravel() for own in inside])) < 0.965


@pytest.mark.parametrize("name", CASES)
def test_standard_uncertainty_is_the_spread(name):
    terms = fitted(name)[0]
    good = terms.start == 0
    stated = np.sqrt(np.median(np.einsum("bjj->bj", terms.covariance), 0))
    np.testing.assert_allclose(terms.square[good].std(0), stated, rtol=0.25)


def test_absent_terms_are_not_claimed_and_present_ones_are_found():
    terms = fitted("white")[0]
    assert np.all(terms.determined.mean(0)[[0, 2, 3]] <= 0.03)
    assert terms.determined[:, 1].all()
    assert fitted("quantisation, white and random walk")[0].determined[:, [0, 1, 3]].mean() > 0.98
    assert fitted("bias instability")[0].determined[:, 2].mean() > 0.95
    drifting = fitted("random walk and drift")[0]
    assert np.mean(drifting.slope > 2.81 * drifting.slope_sd) > 0.95


@pytest.mark.parametrize("name", CASES)
def test_bands_hold_what_they_promise(name):
    terms, moments, deviation = fitted(name)
    drift = CASES[name][4] * moments.averaging
    truth = np.sqrt(moments.plain_mean @ TRUE[name] + drift**2 / 2)
    freedom = allan.freedom(
        moments, terms.bounded, np.full(SEEDS, CASES[name][4]), terms.covariance
    )
    lower, upper = allan.band(deviation, freedom)
    inside = ((lower <= truth) & (truth <= upper)).mean(0)[1 if CASES[name][2] else 0 :]
    assert np.all(inside >= 0.90), inside
    assert 0.93 < inside.mean() < 0.985


def test_the_fit_is_not_contradicted_by_its_own_noise():
    chances = np.concatenate([fitted(name)[0].chance for name in CASES])
    assert np.mean(chances < 0.01) < 0.03


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "white", "walk"),
    [
        (200, 1, 0.3),
        (1024, 1, 0.3),
        pytest.param(COUNT, 1, 0.1, marks=pytest.mark.study),
    ],
)
def test_short_averages_are_left_out_as_seldom_as_stated(count, white, walk):
    """1 in 1000 stated, 10 in 1000 before: variances of few degrees of freedom are skew.

    2000 records: at the stated rate 8 or more alarms would come with a chance of 0.1 %.
    """
    alarms = 0
    for seed in range(10):
        values = simulated(seed, count, 0, white, 0, walk, 0)
        terms = allan.fit(*observed(values), moments_of(count))
        alarms += np.sum((terms.start > 0) | (terms.chance < allan.CONTRADICTED))
    assert alarms < 8


def test_a_short_record_claims_no_term_that_is_absent():
    """200 samples of white noise and random walk: bias instability in 18 % of the records before."""
    claimed = []
    for seed in range(10):
        values = simulated(seed, 200, 0, 1, 0, 0.3, 0)
        terms = allan.fit(*observed(values), moments_of(200))
        claimed.append(terms.determined)
        inside = (terms.lower <= [0, 1, 0, 0.09]) & (terms.upper >= [0, 1, 0, 0.09])
        assert inside.mean() > 0.95
    assert np.mean(np.concatenate(claimed)[:, [0, 2]]) < 0.015


def test_correlated_noise_is_no_quantisation():
    """Gauss-Markov noise of 10 s in white noise: a quantisation in 4 of 5 records before."""
    rng, count, decay = np.random.default_rng(4), 16384, np.exp(-0.01)
    values = 3 * rng.normal(size=(60, count))
    state = rng.normal(size=60)
    for k in range(count):
        values[:, k] += state
        state = decay * state + np.sqrt(1 - decay**2) * rng.normal(size=60)
    terms = allan.fit(*observed(values), moments_of(count))
    assert terms.determined[:, 0].mean() < 0.25
    assert not terms.determined[terms.start > 0, 0].any()


@pytest.mark.slow
@pytest.mark.parametrize(
    "drift", [0, 2e-5, *(pytest.param(each, marks=pytest.mark.study) for each in (1e-5, 1e-4))]
)
def test_the_interval_of_one_station_holds_at_any_drift(drift):
    """N 1e-3 raw·√s, K 1e-4 raw/√s at 5 Hz, station of 30 s: 61 % at 2e-5 raw/s before.

    600 records: the share of intervals is known to 0.9 %, and its limits are 2.8 of that away.
    """
    rate, seconds = 5.0, 30.0
    white, walk = 1e-3 * np.sqrt(rate), 1e-4 / np.sqrt(rate)
    truth = np.sqrt(1e-6 / seconds + 1e-8 * seconds / 3 + (drift * seconds) ** 2 / 2)
    inside = []
    for seed in range(3):
        values = simulated(100 + seed, COUNT, 0, white, 0, walk, drift / rate)
        terms = allan.fit(*observed(values), moments_of(COUNT))
        noise, freedom, _ = allan.single(values, seconds * rate, moments_of(COUNT), terms)
        lower, upper = allan.band(noise, freedom)
        inside.append((lower <= truth) & (truth <= upper))
    assert 0.925 < np.mean(inside) < 0.975


def observed(values):
    """What a fit takes of records."""
    return allan.variance(values, allan.octaves(values.shape[-1]), centred=True), allan.drift(
        values
    )


@cache
def moments_of(count):
    return allan.moments(count, allan.octaves(count))


def test_filtered_noise_is_fitted_where_the_terms_describe_it():
    rng = np.random.default_rng(3)
    values = np.convolve(rng.normal(size=20_004), np.ones(5) / 5, "valid")[None]
    factors = allan.octaves(values.shape[-1])
    moments = allan.moments(values.shape[-1], factors)
    terms = allan.fit(allan.variance(values, factors, centred=True), allan.drift(values), moments)
    assert terms.start[0] >= 2
    assert terms.chance[0] > 1e-3
    assert terms.lower[0, 1] < 1 < terms.upper[0, 1]


def test_too_few_factors_are_refused():
    moments = allan.moments(64, allan.octaves(64))
    with pytest.raises(ValueError, match="variance"):
        allan.fit(np.ones((1, 5)), np.zeros(1), moments)


# --- the command ------------------------------------------------------------------------------


def static(rows=6000, seed=1):
    """Columns of a log at rest, V: white noise of 3e-4 and 7e-4 a sample."""
    rng = np.random.default_rng(seed)
    level = {"ax": 0.01, "ay": -0.02, "az": 2.99, "mx": 0.9, "my": -0.01, "mz": 2.2}
    return {
        name: at + (3e-4 if name[0] == "a" else 7e-4) * rng.normal(size=rows)
        for name, at in level.items()
    }


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("noise") / "static.csv"
    return write_csv(path, static(), f"sampling_hz = {RATE}", "simulated = true")


def test_the_screen_ends_in_lines_for_the_profile(log):
    ran = mwdcal("noise", log, "--tool", "servo", "--station-seconds", 10)
    assert ran.code == 0
    progress = ("Allan variances of ", "reading ")  # on a busy machine
    assert all(line.startswith(progress) for line in ran.err.splitlines())  # no findings
    assert "SIMULATED DATA" in ran.out
    assert "6000 samples at 50 Hz" in ran.out
    for part in ("ax, µg", "mz, nT", "white noise N", "bias instability B", "< "):
        assert part in ran.out
    toml = ran.out[ran.out.index("[accelerometer]") :]
    path = log.with_name("tool.toml")
    path.write_text('name = "tool"\n' + toml, "utf-8")
    profile = load_profile(str(path))[0]
    assert profile.accelerometer.noise == pytest.approx(3e-4 / np.sqrt(10 * RATE), rel=0.25)
    assert profile.magnetometer.noise == pytest.approx(7e-4 / np.sqrt(10 * RATE), rel=0.25)


def test_json_has_the_same_in_raw_units_and_seconds(log):
    found = mwdcal("noise", log, "--tool", "servo", "--json").json
    assert found["station_seconds"] == pytest.approx(12, rel=0.01)
    assert found["seconds"] == pytest.approx(6000 / RATE)
    assert list(found["channels"]) == ["ax", "ay", "az", "mx", "my", "mz"]
    for name, channel in found["channels"].items():
        white = channel["terms"]["white"]
        truth = (3e-4 if name[0] == "a" else 7e-4) / np.sqrt(RATE)
        assert abs(white["value"] - truth) < 3 * white["standard_uncertainty"]
        assert white["lower"] < white["value"] < white["upper"]
        assert channel["white_density"] == pytest.approx(np.sqrt(2) * white["value"])
        assert channel["terms"]["random-walk"]["value"] is None
        assert channel["terms"]["random-walk"]["unit"] == "/√s"
        assert channel["tau_s"][0] == 1 / RATE
        assert (channel["unit"], channel["scale"]) == (
            ("g", 3.0) if name[0] == "a" else ("nT", 5e-5)
        )
        assert channel["station"]["lower"] < truth / np.sqrt(12) * 1.5
    assert set(found["profile"]) == {"accelerometer", "magnetometer"}
    assert found["findings"] == []


@pytest.mark.parametrize(("kind", "times"), [("overlapping", 1), ("modified", 2)])
def test_channels_of_one_length_share_their_moments(log, monkeypatch, kind, times):
    asked, compute = [], allan.moments

    def counted(*given):
        asked.append(given)
        return compute(*given)

    monkeypatch.setattr(allan, "moments", counted)
    noise._moments.cache_clear()
    find_noise(logs.read(str(log)), kind=kind)
    assert len(asked) == times


def test_units_do_not_depend_on_the_rate(tmp_path):
    """The same noise, sampled as it is and averaged over five samples."""
    columns = static(40_000)
    mean = {name: own.reshape(-1, 5).mean(-1) for name, own in columns.items()}
    fast = write_csv(tmp_path / "fast.csv", columns, "sampling_hz = 500")
    slow = write_csv(tmp_path / "slow.csv", mean, "sampling_hz = 100")
    one, other = (mwdcal("noise", path, "--json").json for path in (fast, slow))
    for name in columns:
        pair = [found["channels"][name]["terms"]["white"]["value"] for found in (one, other)]
        assert pair[0] == pytest.approx(pair[1], rel=0.1)
        pair = [found["channels"][name]["station"]["noise"] for found in (one, other)]
        assert pair[0] == pytest.approx(pair[1], rel=0.15)


def test_time_column_rate_option_and_headerless_log_agree(tmp_path, log):
    columns = static()
    timed = write_csv(tmp_path / "t.csv", {"time_s": np.arange(6000) / RATE, **columns})
    bare = tmp_path / "bare.txt"
    np.savetxt(bare, np.stack(list(columns.values()), -1))
    names = ",".join(columns)
    ways = [
        (log,),
        (timed,),
        (bare, "--columns", names, "--sampling-hz", RATE),
    ]
    found = [mwdcal("noise", *way, "--json").json["profile"] for way in ways]
    assert found[0] == pytest.approx(found[1], rel=1e-6)
    assert found[0] == pytest.approx(found[2], rel=1e-6)


def test_modified_shows_other_deviations_and_the_same_terms(log):
    plain, other = (mwdcal("noise", log, "--json", *o).json for o in ((), ("--modified",)))
    assert other["kind"] == "modified"
    for name, channel in plain["channels"].items():
        assert other["channels"][name]["terms"] == channel["terms"]
        assert other["channels"][name]["deviation"][4] < 0.85 * channel["deviation"][4]
        fitted = np.array(other["channels"][name]["fitted"][:6])
        np.testing.assert_allclose(fitted, other["channels"][name]["deviation"][:6], rtol=0.15)


def test_a_channel_of_its_own_rate(tmp_path):
    columns = static()
    for name in ("mx", "my", "mz"):
        columns[name][np.arange(6000) % 5 != 2] = np.nan
    path = write_csv(tmp_path / "two.csv", columns, "sampling_hz = 50")
    found = mwdcal("noise", path, "--json").json
    assert found["channels"]["mx"]["sampling_hz"] == 10
    assert found["channels"]["ax"]["sampling_hz"] == 50
    assert found["findings"] == []


def test_a_channel_slower_than_a_station_is_told(tmp_path):
    """Every 5 s: in stations of 2 s the figure is that of a sample, and none for the profile."""
    columns = static(8000)
    for name in ("mx", "my", "mz"):
        columns[name][np.arange(8000) % 50 != 0] = np.nan
    path = write_csv(tmp_path / "two.csv", columns, "sampling_hz = 10")
    found = mwdcal("noise", path, "--station-seconds", 2, "--json").json
    told = [f["text"] for f in found["findings"] if f["id"] == "slow"]
    assert told[0].startswith("mx is sampled every 5 s, and a station lasts 2 s")
    assert len(told) == 3
    assert list(found["profile"]) == ["accelerometer"]
    assert "mx, my, mz: less than a sample in a station" in found["withheld"]["magnetometer"]
    assert found["channels"]["mx"]["station"]["noise"] == pytest.approx(7e-4, rel=0.2)
    out = mwdcal("noise", path, "--station-seconds", 2).out
    assert [line[:18] for line in out.splitlines() if "?" in line] == ["its 95 % interval "]
    found = mwdcal("noise", path, "--station-seconds", 5, "--json").json
    assert found["findings"] == []
    assert list(found["profile"]) == ["accelerometer", "magnetometer"]


def test_a_station_of_a_slow_log_has_a_sample(tmp_path):
    """One sample a minute: the station of 30 s that is the default elsewhere would have none."""
    columns = {"time_s": 60.0 * np.arange(2000), **static(2000)}
    path = write_csv(tmp_path / "slow.csv", columns)
    ran = mwdcal("noise", path, "--json")
    assert ran.json["station_seconds"] == pytest.approx(60)
    assert "slow" not in {f["id"] for f in ran.json["findings"]}
    assert ran.json["channels"]["ax"]["station"]["noise"] == pytest.approx(3e-4, rel=0.1)
    assert "one station of 60 s, 1σ" in mwdcal("noise", path).out


@pytest.mark.parametrize(
    ("change", "part"),
    [
        (lambda c: c["ay"].fill(1.5), "ay reads 1.5 from end to end"),
        (lambda c: c["ay"].fill(-0.0), "ay reads 0 from end to end"),
        (lambda c: c["ay"].fill(np.nan), "ay is blank from end to end"),
        (lambda c: c["ay"].__setitem__(slice(70, 72), np.nan), "first in line 73"),
        (lambda c: c["ay"].__setitem__(slice(70, 75, 2), np.nan), "first in line 73"),
        (lambda c: c["ay"].__setitem__(slice(50, None), np.nan), "ay has 50 samples; 128"),
    ],
)
def test_a_bad_channel_is_left_out_and_the_others_go_on(tmp_path, change, part):
    columns = static(1000)
    change(columns)
    path = write_csv(tmp_path / "log.csv", columns, "sampling_hz = 50")
    ran = mwdcal("noise", path, "--json")
    assert ran.code == 0
    assert part in ran.err
    assert list(ran.json["channels"]) == ["ax", "az", "mx", "my", "mz"]


@pytest.mark.parametrize("every", [1, 3])
def test_a_single_blank_is_the_mean_of_its_neighbours_and_told(tmp_path, every):
    columns = static()
    columns["ay"][np.arange(6000) % every != 0] = np.nan
    known = {name: own.copy() for name, own in columns.items()}
    known["ay"][300] = (known["ay"][300 - every] + known["ay"][300 + every]) / 2
    columns["ay"][300] = np.nan
    found = [
        mwdcal("noise", write_csv(tmp_path / "log.csv", own, "sampling_hz = 50"), "--json").json
        for own in (columns, known)
    ]
    assert found[0]["channels"] == found[1]["channels"]
    assert [f["id"] for f in found[0]["findings"]] == ["filled"]
    assert f"1 of {6000 // every} samples, first in line 303" in found[0]["findings"][0]["text"]


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize(
    ("change", "doubt", "words"),
    [
        (lambda c: c["ax"] + 0.1 * (np.arange(6000) > 3000), "event", "a spike or a move"),
        (
            lambda c: c["ax"] + 3e-3 * np.sin(np.arange(6000) / 9),
            "misfit",
            "five terms do not describe",
        ),
    ],
)
def test_what_does_not_hold_is_marked_and_not_recommended(tmp_path, change, doubt, words):
    columns = static()
    columns["ax"] = change(columns)
    path = write_csv(tmp_path / "log.csv", columns, "sampling_hz = 50")
    found = mwdcal("noise", path, "--json").json
    assert doubt in found["channels"]["ax"]["doubts"]
    assert found["channels"]["ay"]["doubts"] == []
    assert list(found["profile"]) == ["magnetometer"]
    assert words in found["withheld"]["accelerometer"]
    out = mwdcal("noise", path, "--report", tmp_path / "r.html").out
    header, *rows = out.splitlines()[2:]
    assert "ax (!), 1e-" in header
    assert "ay, 1e-" in header
    cells = {row[:24].strip(): row[24:].split() for row in rows if row[:1].strip()}
    assert cells["drift R, /h"][0] == "?"
    assert next(row for row in rows if row.startswith("its 95 %")).split()[4] == "?"
    assert doubt in next(row for row in rows if row.startswith("does not hold (!)"))
    assert "# [accelerometer] no noise from log.csv: ax: " in out
    assert "\n[accelerometer]" not in out
    assert "ax (!)" in (tmp_path / "r.html").read_text("utf-8")


def moving(seed=3):
    """Columns of a log with twelve standstills."""
    table, *_ = tumble(seed, stations=12, hz=RATE)
    return {name: value for name, value in table.columns.items() if name != "time_s"}


def turned_slowly(columns, degrees_a_second=2.0):
    """The log at rest, turned about its y axis for half a minute in the middle."""
    angle = np.radians(degrees_a_second) * np.clip(np.arange(6000) / RATE - 45, 0, 30)
    x, z = columns["ax"], columns["az"]
    turned = {
        "ax": x * np.cos(angle) + z * np.sin(angle),
        "az": z * np.cos(angle) - x * np.sin(angle),
    }
    return {**columns, **turned}


def warmed(columns, share=0.1):
    """The log at rest with a warming-up of a tenth of the signal, time constant 20 s."""
    course = 1 - np.exp(-np.arange(6000) / RATE / 20)
    return {
        name: value + share * np.median(np.abs(value)) * course for name, value in columns.items()
    }


def altered(columns, names, add):
    return {n: v + add if n in names else v for n, v in columns.items()}


SECONDS = np.arange(6000) / RATE


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize(
    ("columns", "moves"),
    [
        (moving, True),
        (lambda: turned_slowly(static()), True),
        (lambda: altered(static(), ("mx", "mz"), 0.3 * (SECONDS > 60)), True),
        (static, False),
        (lambda: warmed(static()), False),
        (lambda: altered(static(), ("ax",), 1.0 * (SECONDS > 60)), False),  # one channel: a fault
        (lambda: altered(static(), ("ax", "ay"), 2.0 * (np.arange(6000) == 3000)), False),
        (lambda: altered(static(), ("ax", "ay", "az"), 3e-3 * (SECONDS > 60)), False),
        (lambda: altered(static(), ("ax", "ay", "az"), 0.3 * np.sin(40 * SECONDS)), False),
        (lambda: {n: v - v.mean() for n, v in static().items()}, False),  # without any signal
    ],
    ids=["log", "slow", "iron", "rest", "warm", "fault", "spike", "knock", "vibration", "zero"],
)
def test_a_log_that_is_not_at_rest_is_called_so_and_no_other(tmp_path, columns, moves):
    path = write_csv(tmp_path / "log.csv", columns(), f"sampling_hz = {RATE}")
    ran = mwdcal("noise", path, "--json", "--report", tmp_path / "n.html")
    page = (tmp_path / "n.html").read_text("utf-8")
    ids = [finding["id"] for finding in ran.json["findings"]]
    assert (ids[:1] == ["not-at-rest"]) == ("not-at-rest" in ids) == moves
    assert ("This log is not at rest: run mwdcal stations" in page) == moves
    assert ("Run mwdcal stations" in ran.err) == moves
    if moves:
        assert not {"event", "misfit"} & set(ids)
        assert ran.json["profile"] == {}
        assert {c["doubts"][0] for c in ran.json["channels"].values()} == {"not-at-rest"}
        assert "At rest –" not in page


def test_the_move_that_is_named_is_that_of_the_log(tmp_path):
    columns = altered(static(), ("ax", "ay"), 0.5 * (SECONDS > 60))
    columns["ay"] = columns["ay"] + 0.25 * (SECONDS > 60)
    path = write_csv(tmp_path / "log.csv", columns, f"sampling_hz = {RATE}")
    (text,) = (f["text"] for f in mwdcal("noise", path, "--json").json["findings"])
    name, size, place = re.search(r"(\w+) changes by (\S+) within 5 s about (\S+) s", text).groups()
    assert name == "ay"
    assert float(size) == pytest.approx(0.75, abs=0.01)
    assert abs(float(place) - 60) <= 2.5


@pytest.mark.usefixtures("without_pictures")
def test_the_verdict_of_the_page(tmp_path, log):
    page, report = tmp_path / "n.html", ("--report", tmp_path / "n.html")
    found = mwdcal("noise", log, "--json", *report).json
    sound = page.read_text("utf-8")
    assert "At rest – noise of 6 channels found" in sound
    for kind, names in (("accelerometer", "ax ay az"), ("magnetometer", "mx my mz")):
        each = [found["channels"][name]["station"]["noise"] for name in names.split()]
        figure = f"{np.sqrt(np.mean(np.square(each))):.2e}"
        digits, power = figure.split("e")
        raised = power.lstrip("-0").translate(str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹"))
        decimal = f"{float(figure):.{2 + int(power.lstrip('-'))}f}"
        assert f"{kind} {digits}×10⁻{raised} raw" in sound or f"{kind} {decimal} raw" in sound
    bad = altered(static(), ("ay",), 0.5 * (np.arange(6000) == 3000))
    mwdcal("noise", write_csv(tmp_path / "bad.csv", bad, "sampling_hz = 50"), *report)
    assert "Some figures do not hold – 1 of 6 channels" in page.read_text("utf-8")
    bad = {name: v + 3e-3 * np.sin(np.arange(6000) / 9) for name, v in static().items()}
    mwdcal("noise", write_csv(tmp_path / "bad.csv", bad, "sampling_hz = 50"), *report)
    assert "The figures do not hold – 6 of 6 channels" in page.read_text("utf-8")
    dead = {**static(), "my": np.full(6000, 0.5)}
    mwdcal("noise", write_csv(tmp_path / "bad.csv", dead, "sampling_hz = 50"), *report)
    text = page.read_text("utf-8")
    assert "At rest – noise of 5 channels found" in text
    assert 'class="banner attention"' in text
    assert text.index('class="banner') < text.index("my reads 0.5") < text.index("<h2>")


def test_noise_between_two_codes_is_no_event(tmp_path):
    """Noise of 0.3 steps on the edge of a code: most differences are 0, none is an event."""
    rng = np.random.default_rng(3)
    columns = {n: 1e-3 * np.round(0.5 + 0.3 * rng.normal(size=16384)) for n in ("ax", "ay", "az")}
    path = write_csv(tmp_path / "log.csv", columns, "sampling_hz = 10")
    assert "event" not in {f["id"] for f in mwdcal("noise", path, "--json").json["findings"]}
    columns["ay"][9000:] += 0.006
    path = write_csv(tmp_path / "moved.csv", columns, "sampling_hz = 10")
    texts = {f["id"]: f["text"] for f in mwdcal("noise", path, "--json").json["findings"]}
    assert texts["event"].startswith("ay changes by")
    assert "about 900 s" in texts["event"]


@pytest.mark.parametrize(
    ("change", "identity", "part"),
    [
        (lambda c: np.round(c["ax"], 3), "coarse", "in steps of 0.001"),
        (lambda c: c["ax"] + 0.1 * (np.arange(6000) > 3000), "event", "about 60"),
        (lambda c: c["ax"] * 5, "uneven", "times the noise"),
        (
            lambda c: np.convolve(c["ax"], np.ones(4) / 4, "same"),
            "filtered",
            "not that of the five",
        ),
        (lambda c: c["ax"] + 3e-3 * np.sin(np.arange(6000) / 9), "misfit", "vibration"),
    ],
)
def test_what_is_told_of_a_channel(tmp_path, change, identity, part):
    columns = static()
    columns["ax"] = change(columns)
    path = write_csv(tmp_path / "log.csv", columns, "sampling_hz = 50")
    ran = mwdcal("noise", path, "--json")
    assert ran.code == 0
    texts = {f["id"]: f["text"] for f in ran.json["findings"]}
    assert part in texts[identity]
    assert texts[identity] in ran.err


def times(rows=1000):
    return {"time_s": np.arange(rows) / RATE, **static(rows)}


@pytest.mark.parametrize(
    ("columns", "metadata", "options", "parts"),
    [
        (static(1000), (), (), ("log.csv", "time_s", "--sampling-hz")),
        (static(1000), ("sampling_hz = 50",), ("--sampling-hz", "0"), ("--sampling-hz", "got 0")),
        (static(100), ("sampling_hz = 50",), (), ("128", "got 100", "Record for longer")),
        (times(), (), ("--from", "19"), ("128", "50 of 1000 rows", "lasts 19.98 s")),
        (times(), (), ("--station-seconds", "60"), ("--station-seconds", "5 s", "got 60")),
        (times(), (), ("--station-seconds", "0.001"), ("one sample", "0.02 s", "a longer station")),
        (times(), (), ("--station-seconds", "nan"), ("--station-seconds", "above 0", "got nan")),
        (times(), (), ("--station-seconds", "0"), ("--station-seconds", "above 0", "got 0")),
        (times(), (), ("--from", "15", "--to", "5"), ("--from 15", "--to 5", "less than --to")),
        (times(), (), ("--from", "nan"), ("--from", "got nan")),
        (times(), (), ("--to", "nan"), ("--to", "got nan")),
        (
            {k: v[np.arange(1000) != 400] for k, v in times().items()}, (), (),
            ("log.csv, line 402, column 'time_s'", "0.04 s after 7.98 s", "--from"),
        ),
        (
            {**times(), "time_s": np.round(np.arange(1000) / RATE, 0)}, (), (),
            ("time_s", "too few digits", "--sampling-hz"),
        ),
        (
            {k: np.ones_like(v) for k, v in static(1000).items()}, ("sampling_hz = 50",), (),
            ("no channel", "ax reads 1"),
        ),
        (times(), (), ("--plot", "n.jpg"), (".png", ".svg")),
        (times(), (), ("--tool", "none"), ("tool profile", "none")),
        (times(), (), ("--columns", "time_s,ax,ay,az,mx,my,mz"), ("Leave --columns out",)),
    ],
)  # fmt: skip
def test_wrong_inputs_are_refused_with_a_remedy(tmp_path, columns, metadata, options, parts):
    path = write_csv(tmp_path / "log.csv", columns, *metadata)
    message = refused(mwdcal("noise", path, *options), 2)
    for part in parts:
        assert part in message


def test_a_text_cell_is_named_with_its_place(tmp_path):
    path = tmp_path / "log.csv"
    rows = ["time_s,ax,ay,az", *(f"{i / 50},1.{i % 7},2.{i % 5},3.{i % 3}" for i in range(300))]
    rows[200] = rows[200].replace(",2.", ",x2.")
    path.write_text("\n".join(rows) + "\n", "utf-8")
    message = refused(mwdcal("noise", path), 2)
    assert "log.csv, line 201, column 'ay'" in message


def test_a_coarse_clock_is_overruled_by_a_rate(tmp_path):
    columns = {**times(), "time_s": np.round(np.arange(1000) / RATE, 0)}
    path = write_csv(tmp_path / "log.csv", columns)
    right, wrong = (mwdcal("noise", path, "--sampling-hz", rate, "--json") for rate in (50, 100))
    assert right.json["findings"] == []
    assert [finding["id"] for finding in wrong.json["findings"]] == ["rate"]
    assert "1000 rows last 9.99 s, but time_s goes from 0 to 20 s" in wrong.err


@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_the_picture_is_the_same_twice(tmp_path, log, suffix):
    pytest.importorskip("matplotlib")
    paths = [tmp_path / f"{i}{suffix}" for i in range(2)]
    for path in paths:
        ran = mwdcal("noise", log, "--plot", path)
        assert ran.code == 0
        assert f"{path} (picture)" in ran.out
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_the_report_needs_nothing_else(tmp_path, log):
    pytest.importorskip("jinja2")
    path = tmp_path / "noise.html"
    ran = mwdcal("noise", log, "--tool", "servo", "--report", path)
    assert ran.code == 0
    text = path.read_text("utf-8")
    for part in (
        "[accelerometer]",
        "<svg",
        "white noise N",
        "ax, µg",
        "degrees of freedom",
        "SIMULATED",
        hashlib.sha256(log.read_bytes()).hexdigest(),
    ):
        assert part in text
    assert "http:" not in text
    assert "https:" not in text


def test_an_output_never_replaces_the_log(log):
    assert "would be lost" in refused(mwdcal("noise", log, "--report", log), 2)


# --- measured logs ----------------------------------------------------------------------------


@pytest.mark.skipif("MWDCAL_DATA" not in os.environ, reason="measured logs: set MWDCAL_DATA")
@pytest.mark.parametrize(("unit", "seconds"), [("imu0", 6.5), ("imu1", 6.5), ("imu2", 6.5)])
def test_measured_first_standstill(unit, seconds):
    """White noise of MPU-9150 accelerometers, against the published scatter of their samples."""
    folder = os.path.join(os.environ["MWDCAL_DATA"], "mikov")
    log = logs.read(os.path.join(folder, f"{unit}.log"), ["ax", "ay", "az", "p", "q", "r"])
    found = find_noise(log, sampling_hz=100.0, between=(0, seconds))
    with open(os.path.join(folder, "static_means.csv"), encoding="utf-8") as stream:
        names, *rows = (line.strip().split(",") for line in stream)
    row = dict(zip(names, next(r for r in rows if r[:2] == [unit, "0"]), strict=True))
    for name, channel in found.channels.items():
        published = float(row[f"sd_{name}"])
        # the scatter holds the slow terms as well
        assert 0.75 * published < channel.deviation[0] < 1.05 * published
        assert channel.terms["white"].value * 10 == pytest.approx(channel.deviation[0], rel=0.5)


@pytest.mark.skipif("MWDCAL_DATA" not in os.environ, reason="measured logs: set MWDCAL_DATA")
def test_measured_first_minute_of_a_hand_held_sensor():
    """Noise that the terms do not describe below 0.02 s, and a bias instability in z."""
    path = os.path.join(os.environ["MWDCAL_DATA"], "xsens", "xsens_acc.mat")
    log = logs.read(path, ["time_s", "ax", "ay", "az"])
    found = find_noise(log, between=(0.5, 51.0))
    assert "filtered" in {finding.id for finding in found.findings}
    assert not {"event", "misfit", "coarse"} & {finding.id for finding in found.findings}
    for channel in found.channels.values():
        assert channel.sampling_hz == pytest.approx(100, rel=0.001)
        assert channel.terms["white"].value == pytest.approx(0.36, rel=0.1)


@pytest.mark.parametrize("m", [1, 7, 3000])
def test_differences_of_averages_in_blocks_are_those_of_averages(m):
    values = np.random.default_rng(2).normal(5.0, 1.0, 30_001)
    values[20_000] += 100.0
    sums = np.concatenate([[0.0], np.cumsum(values)])
    averages = (sums[m:] - sums[:-m]) / m
    size = np.abs(averages[m:] - averages[:-m])
    phase = allan.phase_of(values)
    largest, place = allan.largest_difference(phase, m)
    assert largest == pytest.approx(size.max(), rel=1e-9)
    assert size[place] == pytest.approx(size.max(), rel=1e-9)
    median = float(np.median(size))
    assert allan.usual_difference(phase, m, 1.01 * median) == pytest.approx(median, rel=1e-9)
    assert allan.usual_difference(phase, m, 0.99 * median) == np.inf
