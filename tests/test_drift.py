"""Drift: common parameters, the test of change, random walks and due dates, against other formulas and simulation."""

import re
from dataclasses import replace
from datetime import date

import numpy as np
import pytest
from msgspec.structs import replace as with_changes
from scipy.stats import binom, multivariate_normal, norm

from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import TRIADS, fingerprints
from mwdcal.calibration.results import typical_accuracy
from mwdcal.drift import walk
from mwdcal.drift.histories import RISK, Paths, ServiceTest, outlook, tool_history
from mwdcal.drift.tool import (
    ToolRecords,
    TypeRates,
    all_measured,
    fleet_drift,
    measured,
    predicted,
)
from mwdcal.drift.walk import (
    FACTOR_NAMES,
    NULL_DRAWS,
    STEP_SHARE,
    WALK_GROUPS,
    Contrasts,
    GroupRates,
    History,
    Increments,
    change_test,
    change_tests,
    common_noise_scale,
    parameter_names,
    precision,
    quantiles,
)
from mwdcal.errors import InputError
from mwdcal.files import documents
from mwdcal.files.formats.members import Member
from mwdcal.files.profiles import load_profile
from mwdcal.library import drifts
from mwdcal.planning.plans import drawn, load_plan
from mwdcal.planning.session import Session
from mwdcal.use.notation import convert
from mwdcal.use.verification import Verdict, VerdictRow

SERVO = load_profile("servo")[0]
NAMES = parameter_names(dict.fromkeys(TRIADS, 0))
SIZE = len(NAMES)
BIAS = NAMES.index("accelerometer bias-x")
LIMITS = {"inclination": 0.02, "azimuth": 0.2}
TODAY = date(2026, 11, 22)


class Bench:
    """A simulated tool on its stand: a calibration for each visit."""

    def __init__(self, plan, seed, order=0, profile=SERVO):
        self.session = Session.of(load_plan(plan), profile)
        self.rng = np.random.default_rng(seed)
        self.tool = drawn(self.rng, profile, order)

    def readings(self, day="2024-05-01", serial="T-1"):
        readings = self.session.measured(self.tool, self.rng).readings
        return replace(readings, metadata={**readings.metadata, "serial": serial, "date": str(day)})

    def calibration(self, day="2024-05-01", serial="T-1", **options):
        readings = self.readings(day, serial)
        return calibrate(readings, self.session.profile, Options(**{"order": 0, **options}))

    def shift(self, place, size):
        moved = self.tool.accelerometer.copy()
        moved[place] += size
        self.tool = replace(self.tool, accelerometer=moved)


@pytest.fixture(scope="module")
def years():
    """A tool with a step of 1 mg before its fourth calibration, one without, and one calibrated once."""
    tools = {}
    for serial, count in (("T-1", 5), ("T-2", 4), ("T-3", 1)):
        bench = Bench("twelve-state", len(tools))
        tools[serial] = []
        for year in range(count):
            if (serial, year) == ("T-1", 3):
                bench.shift(3, 1e-3)
            tools[serial].append(bench.calibration(f"{2020 + year}-05-01", serial))
    return tools


def history(values, covariance, freedom=np.inf, gap=1.0):
    """Calibrations with values (n, p) and one covariance."""
    count = len(values)
    whole = np.broadcast_to(covariance, (count, SIZE, SIZE))
    known = np.broadcast_to(np.linalg.inv(covariance), whole.shape)
    degrees = np.full(values.shape, freedom)
    same = np.zeros(values.shape, bool)
    return History(NAMES, values, whole, known, degrees, same, gap * np.arange(count))


def random_covariance(rng):
    root = rng.normal(size=(SIZE, SIZE))
    return root @ root.T / SIZE + np.eye(SIZE)


# Common parameters


@pytest.mark.parametrize("options", [{}, {"model": "factors"}])
def test_values_and_covariance_are_those_of_the_notation_in_factors(options):
    calibration = Bench("twelve-state", 3).calibration(**options)
    tool = tool_history([calibration])
    notations = convert(calibration, "factors", tool.temperature_c[0])
    for triad, notation in notations.items():
        scale = getattr(calibration.profile, triad).scale
        off = notation.values["m"][~np.eye(3, dtype=bool)]
        expected = [*notation.values["SF"][:, 0] / scale, *notation.values["B"][:, 0], *off]
        sd = [
            *notation.uncertainty["SF"][:, 0] / scale,
            *notation.uncertainty["B"][:, 0],
            *notation.uncertainty["m"][~np.eye(3, dtype=bool)],
        ]
        places = [NAMES.index(f"{triad} {title}") for title in FACTOR_NAMES]
        np.testing.assert_allclose(tool.history.values[0, places], expected, rtol=1e-9, atol=1e-13)
        stated = np.sqrt(np.diag(tool.covariance[0])[places])
        np.testing.assert_allclose(stated, sd, rtol=1e-8)


def test_models_of_temperature_give_one_set_of_parameters():
    bench = Bench("laboratory-thermal", 4, order=1)
    readings = bench.readings()
    forms = ({"model": "polynomial", "order": 2}, {"model": "factors", "order": 2})
    tool = tool_history([calibrate(readings, bench.session.profile, Options(**f)) for f in forms])
    assert len(tool.history.names) == 2 * 24
    apart = np.diff(tool.history.values, axis=0)[0] / np.sqrt(np.diag(tool.covariance[0]))
    turns = np.array(["misalignment" in name for name in tool.history.names])
    assert np.all(np.abs(apart[~turns]) < 1)
    assert np.all(
        np.abs(apart[turns]) < 4
    )  # constant in one model, of each temperature in the other
    assert any("differ by their own misfit" in note for note in tool.notes[0])


def test_a_calibration_without_temperature_terms_is_compared_at_the_temperature_of_its_run():
    """A tool that drifts with temperature and is as it was: terms over a range, then one soak of another run, away
    from the reference temperature of 30 °C."""
    bench = Bench("laboratory-thermal", 4, order=1)
    first, second = bench.readings("2024-05-01"), bench.readings("2025-05-01")
    soak = np.abs(second.temperature - second.temperature.min()) < 1
    plain = calibrate(second.select(soak), SERVO, Options(order=0))
    tool = tool_history([calibrate(first, SERVO, Options(order=1)), plain])
    assert tool.temperature_c[0] == pytest.approx(np.mean(plain.temperature_c))
    assert abs(tool.temperature_c[0] - 30) > 4
    assert not change_test(tool.history, 1e-3).changed
    assert not any("no temperature terms" in note for note in tool.notes[-1])


def test_calibrations_without_temperature_terms_of_other_temperatures_say_so():
    bench = Bench("laboratory-thermal", 4, order=1)
    runs = [bench.readings(day) for day in ("2024-05-01", "2025-05-01")]
    lowest = runs[0].temperature.min()
    soaks = [np.abs(run.temperature - lowest) < 1 for run in runs]
    first, second = (
        calibrate(
            replace(run.select(soak), temperature=run.temperature[soak] + shift),
            SERVO,
            Options(order=0),
        )
        for run, soak, shift in zip(runs, soaks, (0.0, 4.0), strict=True)
    )
    tool = tool_history([first, second])
    assert all("counts as a change" in " ".join(notes) for notes in tool.notes)


@pytest.mark.parametrize("scale", [3.06, 3.75])
def test_another_nominal_scale_is_no_change(scale):
    bench = Bench("twelve-state", 5)
    readings = bench.readings()
    other = with_changes(SERVO, accelerometer=with_changes(SERVO.accelerometer, scale=scale))
    shrunk = replace(
        readings,
        accelerometer=readings.accelerometer * 3.0 / scale,
        sd={**readings.sd, "accelerometer": readings.sd["accelerometer"] * 3.0 / scale},
        profile=other,
    )
    both = [
        calibrate(readings, SERVO, Options(order=0)),
        calibrate(shrunk, other, Options(order=0)),
    ]
    values = tool_history(both).history.values
    np.testing.assert_allclose(values[0], values[1], rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("latest", [0, 1])
def test_readings_in_millivolts_are_compared_with_those_in_volts(latest):
    """The same station readings, once in V and once in mV, whichever is the latest."""
    bench = Bench("twelve-state", 5)
    readings = bench.readings()
    milli = with_changes(SERVO, accelerometer=with_changes(SERVO.accelerometer, scale=3000.0))
    both = [
        calibrate(replace(readings, profile=profile), profile, Options(order=0))
        for profile in (SERVO, milli)[:: 1 if latest else -1]
    ]
    both = [
        with_changes(c, tool={**c.tool, "date": day}, station_rows=[])
        for c, day in zip(both, ("2024-05-01", "2025-05-01"), strict=True)
    ]
    tool = tool_history(both)
    np.testing.assert_allclose(*tool.history.values, rtol=1e-7, atol=1e-9)
    assert (
        "the readings of the accelerometer are in another unit than those of the latest: compared in nominal units"
        in tool.notes[0]
    )


def test_along_a_free_direction_nothing_is_known():
    rng = np.random.default_rng(1)
    covariance, free = random_covariance(rng), rng.normal(size=(2, SIZE))
    known = precision(covariance, free)
    assert np.abs(known @ free.T).max() < 1e-9
    wide = np.linalg.inv(covariance + 1e7 * free.T @ free)  # the same, as a limit
    np.testing.assert_allclose(known, wide, atol=1e-6)


def test_a_value_along_a_free_direction_is_no_walk():
    """Where a run leaves a turn free its value is a convention: as if its uncertainty were without bounds."""
    rng = np.random.default_rng(2)
    covariance, places = random_covariance(rng), [6, 7, 8, 9, 10, 11]
    steady = history(rng.normal(size=(3, SIZE)), covariance)
    free = np.zeros(SIZE)
    free[[6, 8, 12 + 6, 12 + 8]] = 1.0, -1.0, 0.5, -0.5

    def first_free(moved, known, wide):
        values, whole, each = (
            steady.values.copy(),
            steady.covariance.copy(),
            steady.precision.copy(),
        )
        values[0] += moved * free
        whole[0] += wide * np.outer(free, free)
        each[0] = known
        return replace(steady, values=values, covariance=whole, precision=each)

    known = precision(covariance, free[None])
    rates = np.geomspace(1e-3, 1e3, 30)
    limit = first_free(0.0, np.linalg.inv(covariance + 1e7 * np.outer(free, free)), 1e7)
    expected = Increments.of(limit, places).log_likelihood(rates)
    for moved in (0.0, 50.0):
        ours = Increments.of(first_free(moved, known, 0.0), places)
        assert len(ours.change) == 2 * len(places) - 1
        found = ours.log_likelihood(rates)
        np.testing.assert_allclose(found - found[0], expected - expected[0], atol=1e-4)
    together = History.of([steady, first_free(50.0, known, 0.0), steady])
    alone, _, also = Increments.of_tools(together, places)
    np.testing.assert_allclose(alone.change, Increments.of(steady, places).change)
    np.testing.assert_allclose(also.noise, alone.noise)


def test_what_cannot_be_compared_is_said():
    bench = Bench("twelve-state", 6)
    plain = bench.calibration("2024-01-01")
    elsewhere = with_changes(plain, temperature_c=(80.0, 81.0), time="2020-01-01T00:00:00+00:00")
    elsewhere = with_changes(elsewhere, tool={**plain.tool, "date": "2020-01-01"})
    alone = replace(bench.readings("2022-01-01"), magnetometer=None)
    level = calibrate(alone, bench.session.profile, Options(order=0))
    tool = tool_history([plain, with_changes(elsewhere), level])
    assert tool.used == (False, True, True) or tool.calibrations[-1].temperature_c is None
    assert any("no magnetometer" in note for note in tool.notes[1])
    relative = tool_history([with_changes(plain, field_unit="relative (field = 1)"), plain])
    assert any("common factor" in note for notes in relative.notes for note in notes)


def test_the_day_of_a_calibration_is_that_of_its_run():
    calibration = Bench("six-state", 7).calibration("2019-03-04")
    assert calibration.day == date(2019, 3, 4)
    undated = with_changes(calibration, tool={"date": "4 March"}, time="2026-01-02T03:04:05+00:00")
    assert undated.day == date(2026, 1, 2)
    assert with_changes(undated, time="20260102T030405Z").day == date(2026, 1, 2)


# The test of change


def test_scores_and_misfit_are_those_of_generalised_least_squares():
    rng = np.random.default_rng(2)
    values = rng.normal(size=(4, SIZE))
    covariances = [random_covariance(rng) for _ in range(4)]
    known = np.stack([np.linalg.inv(c) for c in covariances])
    contrasts = Contrasts(known)
    departures = contrasts.departures(values)
    pull = contrasts.pull(departures)
    scores = contrasts.scores(pull)[..., 0]
    white = [np.linalg.cholesky(p).T for p in known]
    right = np.concatenate([w @ v for w, v in zip(white, values, strict=True)])
    mean = np.concatenate(white)
    for after, place in ((1, 0), (2, 7), (3, 20)):
        step = np.concatenate([(k >= after) * w[:, place] for k, w in enumerate(white)])
        design = np.column_stack([mean, step])
        covariance = np.linalg.inv(design.T @ design)
        estimate = covariance @ design.T @ right
        expected = estimate[-1] / np.sqrt(covariance[-1, -1])
        assert scores[after - 1, place] == pytest.approx(expected, rel=1e-8)
    residual = right - mean @ np.linalg.lstsq(mean, right, rcond=None)[0]
    misfit, *_ = contrasts.misfits(departures, pull)
    assert misfit[0] == pytest.approx(residual @ residual, rel=1e-8)
    assert contrasts.freedom.tolist() == [3 * SIZE, SIZE, SIZE, SIZE]


@pytest.mark.parametrize("freedom", [np.inf, 12.0])
def test_unchanged_tools_are_called_changed_at_the_stated_level(freedom):
    rng = np.random.default_rng(3)
    covariance, count, level = random_covariance(rng), 50, 0.2
    root, called = np.linalg.cholesky(covariance), 0
    for _ in range(count):
        values = rng.normal(size=(2, SIZE)) @ root.T
        scale = np.ones(2) if np.isinf(freedom) else rng.chisquare(freedom, 2) / freedom
        stated = history(values, covariance, freedom)
        both = scale[:, None, None]
        stated = replace(
            stated, covariance=stated.covariance * both, precision=stated.precision / both
        )
        called += change_test(stated, level).changed
    low, high = binom.interval(0.9999, count, level)
    # With two estimates of the noise the judgement errs on the safe side (Behrens and Fisher).
    assert (low if np.isinf(freedom) else 0) <= called <= high


@pytest.mark.parametrize("level", [0.01, 0.1])
def test_few_draws_call_the_same_tools_changed(monkeypatch, level):
    rng = np.random.default_rng(5)
    covariance = random_covariance(rng)
    root = np.linalg.cholesky(covariance)
    tools = []
    for size in np.linspace(0, 5, 12):
        values = rng.normal(size=(3, SIZE)) @ root.T
        values[1:, BIAS] += size * np.sqrt(covariance[BIAS, BIAS])
        tools.append(history(values, covariance))
    few = [change_test(each, level) for each in tools]
    monkeypatch.setattr(walk, "FIRST_DRAWS", NULL_DRAWS)
    every = [change_test(each, level) for each in tools]
    assert [each.changed for each in few] == [each.changed for each in every]
    assert {each.changed for each in few} == {True, False}
    for one, other in zip(few, every, strict=True):
        sd = np.sqrt(other.probability * (1 - other.probability) / 999)
        assert abs(one.probability - other.probability) <= 5 * sd + 0.005
        if one.changed:
            assert one.probability == other.probability
            assert one.steps == other.steps


@pytest.mark.parametrize("equal", [False, True])
@pytest.mark.parametrize("level", [0.01, 0.2])
def test_draws_are_judged_by_their_ranks(level, equal):
    """Evidence is the smaller of both shares of draws that are as large, each over its part of the level."""
    rng = np.random.default_rng(6)
    drawn = [values.astype(np.float32) for values in rng.normal(size=(2, 999))]
    drawn = [np.round(values, 1) for values in drawn] if equal else drawn
    shares = [np.mean(each >= each[:, None], -1) for each in drawn]
    expected = np.minimum(shares[0] / STEP_SHARE, shares[1] / (1 - STEP_SHARE))
    alarm = np.quantile(drawn[0], 1 - STEP_SHARE * np.quantile(expected, level))
    evidence = walk.NullDistribution.of(*drawn)
    for least in (0.002, level, 0.5, 1.1):
        probability, critical = evidence.judged(least, level)
        assert probability == pytest.approx((1 + np.sum(expected <= least)) / 1000)
        assert critical == pytest.approx(alarm, abs=1e-6)
    assert evidence.beyond(0.5, -9.0) == [(1 + np.sum(drawn[0] >= 0.5)) / 1000, 1.0]


def test_calibrations_that_have_nothing_in_common_show_no_change():
    tool = history(np.random.default_rng(8).normal(size=(2, SIZE)), np.eye(SIZE))
    apart = replace(tool, precision=tool.precision * np.array([0.0, 1.0])[:, None, None])
    test = change_test(apart)
    assert (test.changed, test.probability, test.degrees_of_freedom) == (False, 1.0, 0)
    assert test.largest_score == test.critical_score == 0.0
    assert np.isnan(test.scores).all()


def test_tools_are_tested_together_as_alone():
    rng = np.random.default_rng(7)
    tools = [history(rng.normal(size=(3, SIZE)), random_covariance(rng), 30.0) for _ in range(3)]
    tools[1].values[2, BIAS] += 50.0
    together = change_tests(tools)
    assert [test.changed for test in together] == [False, True, False]
    for one, other in zip(together, map(change_test, tools), strict=True):
        assert one.probability == other.probability
        assert one.misfit == pytest.approx(other.misfit, rel=1e-9)
        assert one.scores == pytest.approx(other.scores, rel=1e-9)
        assert [(s.place, s.after) for s in one.steps] == [(s.place, s.after) for s in other.steps]


def test_power_against_a_step_is_that_of_its_score():
    rng = np.random.default_rng(4)
    covariance, count, signal = random_covariance(rng), 30, 4.0
    root = np.linalg.cholesky(covariance)
    contrasts = Contrasts(history(np.zeros((2, SIZE)), covariance).precision)
    unit = 1 / np.sqrt(np.diag(contrasts.precision[0])[BIAS] / 2)
    tests = []
    for _ in range(count):
        values = rng.normal(size=(2, SIZE)) @ root.T
        values[1, BIAS] += signal * unit
        tests.append(change_test(history(values, covariance)))
    critical = tests[0].critical_score
    expected = norm.sf(critical - signal)
    named = sum(any(s.place == BIAS for s in t.steps) for t in tests)
    low, high = binom.interval(0.9999, count, expected)
    assert low - 1 <= named <= high + 1
    assert 3.3 < critical < 3.9  # 24 independent scores at 0.8 %: 3.59


def test_the_largest_of_independent_scores_has_its_known_distribution(monkeypatch):
    monkeypatch.setattr(walk, "FIRST_DRAWS", NULL_DRAWS)
    test = change_test(history(np.zeros((2, SIZE)), np.eye(SIZE)))
    none = change_test(history(np.zeros((2, SIZE)), np.eye(SIZE)), 0.2)
    for each, level in ((test, 0.01), (none, 0.2)):
        alarm = 1 - (1 - 2 * norm.sf(each.critical_score)) ** SIZE
        assert 0.7 * level < alarm < 1.25 * level  # STEP_SHARE of it, and where both alarms agree


def test_a_proved_file_is_read_as_it_was_proved(years):
    record = documents.encode(years["T-1"][0])
    stored = Member(record, "T-1.json", "")
    assert documents.proved(stored) == documents.decoded(stored)
    for old, new in ((b'"schema_version": 1', b'"schema_version": 0'), (b"{", b"")):
        damaged = Member(record.replace(old, new, 1), "T-1.json", "")
        with pytest.raises(InputError) as refusal:
            documents.decoded(damaged)
        with pytest.raises(InputError, match=re.escape(str(refusal.value))):
            documents.proved(damaged)


def test_a_step_is_named_with_its_size(years):
    drift = measured("T-1", years["T-1"]).drift
    step = next(s for s in drift.change.steps if s.name == "bias-x")
    assert drift.change.changed
    assert step.triad == "accelerometer"
    assert (step.after, step.by) == ("2022-05-01", "2023-05-01")
    assert abs(step.change - 1e-3) < 4 * step.standard_uncertainty
    assert not measured("T-2", years["T-2"]).drift.change.changed


def test_noise_of_one_tool_is_pooled_unless_it_differs():
    freedom = np.full(4, 30.0)
    ratio, degrees, together = common_noise_scale(np.array([0.8, 1.0, 1.2, 1.0]), freedom)
    np.testing.assert_allclose(ratio, 1.0 / np.array([0.8, 1.0, 1.2, 1.0]))
    assert together.all()
    assert np.all(degrees == 120)
    ratio, degrees, together = common_noise_scale(np.array([0.8, 1.0, 9.0, 1.0]), freedom)
    assert not together.any()
    assert np.all(ratio == 1)
    assert np.all(degrees == 30)
    ratio, degrees, together = common_noise_scale(np.array([np.nan, 1.0]), freedom[:2])
    assert not together.any()
    assert np.isinf(degrees[0])


# Random walks and due dates


def walked(rng, rate, sd, times, count):
    """Values (tools, n) of one parameter that walks at a rate, measured with an uncertainty."""
    moves = rng.normal(size=(count, len(times))) * np.sqrt(
        rate[:, None] * np.diff(times, prepend=0.0)
    )
    return np.cumsum(moves, -1) + sd * rng.normal(size=(count, len(times)))


def one_group(values, sd, times):
    """Histories of tools whose first bias is given; all other parameters stay."""
    rows = []
    for each in values:
        whole = np.zeros((len(times), SIZE))
        whole[:, BIAS] = each
        rows.append(replace(history(whole, sd**2 * np.eye(SIZE)), years=times))
    return rows


def test_likelihood_of_a_rate_is_that_of_a_normal_vector():
    rng = np.random.default_rng(5)
    times, covariance = np.array([0.0, 0.5, 2.0, 3.1]), random_covariance(rng)
    tool = replace(history(rng.normal(size=(4, SIZE)), covariance), years=times)
    places = [BIAS, BIAS + 1, BIAS + 2]
    rates = np.array([0.1, 1.0, 5.0])
    ours = Increments.of(tool, places).log_likelihood(rates)
    block = covariance[np.ix_(places, places)]
    step = np.diff(np.eye(4), axis=0)
    noise = np.kron(step @ step.T, block)
    change = np.diff(tool.values[:, places], axis=0).ravel()
    expected = [
        multivariate_normal(np.zeros(9), q * np.kron(np.diag(np.diff(times)), np.eye(3)) + noise).logpdf(change)
        for q in rates
    ]  # fmt: skip
    np.testing.assert_allclose(np.diff(ours), np.diff(expected), rtol=1e-8)


def test_intervals_of_rates_hold_the_true_ones():
    rng = np.random.default_rng(6)
    count, sd, inside, peers = 60, 1.0, [], []
    for calibrations in (
        2,
        4,
    ) * 8:  # of types of their own: what one type teaches errs for all its tools
        times = np.arange(float(calibrations))
        centre = rng.uniform(-0.5, 1.0)
        rate, fresh = 10.0 ** rng.normal(centre, 0.3, (2, count))
        tools = one_group(walked(rng, rate, sd, times, count), sd, times)
        increments = [Increments.of(tool, [BIAS]) for tool in tools]
        learnt = GroupRates.of(increments)
        ends = [
            quantiles(learnt.rates, learnt.probabilities([i], [True])[0], (0.05, 0.95))
            for i in increments
        ]
        inside.append(np.mean([a <= true <= b for (a, b), true in zip(ends, rate, strict=True)]))
        a, b = quantiles(learnt.rates, learnt.peers_probability, (0.05, 0.95))
        peers.append(np.mean((fresh > a) & (fresh < b)))
    for shares in (inside, peers):
        assert 0.9 - 0.03 - 3 * np.std(shares) / np.sqrt(16) < np.mean(shares) < 0.98


def test_one_knocked_tool_does_not_spoil_the_rates_of_its_peers():
    rng = np.random.default_rng(21)
    times, rate = np.arange(3.0), np.full(21, 0.5)
    values = walked(rng, rate, 1.0, times, 21)
    values[-1, 2:] += 1e3
    tools = [Increments.of(tool, [BIAS]) for tool in one_group(values, 1.0, times)]
    alone, among = GroupRates.of(tools[:-1]), GroupRates.of(tools)
    quarters = [quantiles(g.rates, g.peers_probability, [0.25, 0.5, 0.75]) for g in (alone, among)]
    # Less than the centre of 20 log-normal rates is uncertain by (0.3 / √20 decades); without the share, 1.4.
    assert np.log10(quarters[1] / quarters[0]) == pytest.approx(0, abs=0.05)


def test_rates_of_tools_together_are_those_by_the_formula_of_each():
    """Bayes' rule by hand: a tool's likelihood times what its peers, without it, say of the type."""
    rng = np.random.default_rng(22)
    times, rate = np.arange(3.0), np.exp(rng.normal(size=6))
    histories = one_group(walked(rng, rate, 1.0, times, 6), 1.0, times)
    tools = [Increments.of(tool, [BIAS]) for tool in histories]
    tools.append(Increments(np.zeros(0), np.zeros(0)))  # one calibration
    learnt = GroupRates.of(tools)
    among = [True] * 5 + [False, True]
    together = learnt.probabilities(tools, among)
    for tool, own, found in zip(tools, among, together, strict=True):
        others = [t for t in tools if t.noise.size and not (own and t is tool)]
        expected = tool.log_likelihood(learnt.rates) + np.log(
            GroupRates(
                learnt.unit,
                learnt.decades,
                np.stack([t.log_likelihood(learnt.rates) for t in others]),
            ).peers_probability
        )
        expected = np.exp(expected - expected.max())
        assert found == pytest.approx(expected / expected.sum(), rel=1e-6, abs=1e-12)


def test_growth_begins_at_the_accuracy_that_is_stated(years):
    calibration = years["T-2"][-1]
    ahead = outlook(tool_history(years["T-2"]))
    each = {g.angle: g for g in ahead.growths}
    for angle, stated in typical_accuracy(calibration).items():
        assert np.degrees(np.sqrt(each[angle].calibration)) == pytest.approx(stated, rel=1e-6)
    # An error e of the gravity vector tilts it by its part along one direction: e / g, squared.
    bias = each["inclination"].yearly["accelerometer", "bias"]
    assert bias == pytest.approx(1 / calibration.earth["gravity_g"] ** 2, rel=1e-3)


def test_tools_are_measured_together_as_alone(years):
    """Histories of one form and of others: a single calibration, and one calibration less."""
    each = {**years, "T-3": years["T-1"][:1], "T-4": years["T-1"][1:]}
    together = all_measured([ToolRecords(*pair) for pair in each.items()])
    for (serial, calibrations), tool in zip(each.items(), together, strict=True):
        alone = measured(serial, calibrations)
        assert tool.drift.serial == serial
        assert [c.run for c in tool.drift.calibrations] == [c.run for c in alone.drift.calibrations]
        assert (tool.drift.change is None) == (len(calibrations) == 1)
        for one, other in zip(tool.outlook.growths, alone.outlook.growths, strict=True):
            assert one.calibration == pytest.approx(other.calibration, rel=1e-9)
            assert one.yearly == pytest.approx(other.yearly, rel=1e-9)
        for group, moved in tool.increments.items():
            assert moved.noise == pytest.approx(alone.increments[group].noise, rel=1e-9)
            found, expected = (
                i.log_likelihood(moved.noise) for i in (moved, alone.increments[group])
            )
            assert found == pytest.approx(expected, rel=1e-6)
        for one, other in zip(tool.departures, alone.departures, strict=True):
            assert (one.angle, one.start) == (other.angle, other.start)
            assert one.size == pytest.approx(other.size, rel=1e-6)


def test_a_tool_is_due_when_its_largest_error_is_beyond_the_limit_with_the_stated_risk(years):
    """Biases alone walk, of an exact calibration: an error (x, y, z) of gravity tilts the tool by its part along the
    direction of growing inclination, which 45° and the toolface t give as (sin t, cos t, 1) / √2."""
    ahead = outlook(tool_history(years["T-2"]))
    growth = next(g for g in ahead.growths if g.angle == "inclination")
    rng, rate, limit, draws = np.random.default_rng(8), (2e-4) ** 2, np.radians(0.02), 40_000
    rates = {group: np.zeros(draws) for group in WALK_GROUPS[:6]}
    rates["accelerometer", "bias"] = np.full(draws, rate)
    paths = Paths.of(np.zeros_like(ahead.covariance), ahead.places, rates, rng)
    span = np.quantile(growth.kept(paths, limit)[0], RISK)
    faces = np.arange(12) * np.pi / 6
    tilt = np.stack([np.sin(faces), np.cos(faces), np.ones(12)]) / np.sqrt(2)
    error = np.sqrt(span * rate) * rng.normal(size=(draws, 3)) @ tilt
    beyond = np.mean(np.abs(error).max(-1) > limit)
    assert beyond == pytest.approx(RISK, abs=4 * np.sqrt(2 * RISK / draws))


def test_due_dates_of_a_fleet_and_of_a_tool_calibrated_once(years):
    tools = [measured(serial, each) for serial, each in years.items()]
    fleet, (first, second, single) = fleet_drift(tools, LIMITS, TODAY, {"T-9": "no file"})
    assert (fleet.tools, fleet.tested, fleet.changed) == (3, 2, 1)
    assert fleet.worst[0].serial == "T-1"
    assert fleet.refused == {"T-9": "no file"}
    for drift in (first, second, single):
        for due in drift.due:
            assert drift.calibrations[-1].date <= due.due <= due.not_before <= due.expected
            assert due.expected <= due.not_after
            assert due.due <= str(int(drift.calibrations[-1].date[:4]) + 5) + "-05-01"
    assert (single.basis, single.change) == ("peers", None)
    assert {f.id for f in single.findings} >= {"single", "peers"}
    lonely = predicted(tools[2], TypeRates.of([tools[2]]), LIMITS)
    assert lonely.due == []
    assert "unpredicted" in {f.id for f in lonely.findings}


def test_a_tool_that_left_its_limits_in_service_says_so(years):
    sha256 = years["T-2"][1].sha256

    def test_of(day, value, passed):
        row = VerdictRow(
            name="error of inclination", unit="°", value=value, uncertainty=0.01, limit=0.25,
            passed=passed, note="",
        )  # fmt: skip
        verdict = Verdict(
            passed=passed, rule="", limits="roll-test", source="", run="", stations=12, rows=[row],
            findings=[],
        )  # fmt: skip
        return ServiceTest(date.fromisoformat(day), sha256, verdict)

    tests = [test_of("2022-04-30", 0.3, False), test_of("2021-05-02", 0.1, True)]
    drift = measured("T-2", years["T-2"], tests).drift
    (row,) = drift.service
    assert (row.as_left, row.as_found, row.as_left_passed, row.as_found_passed) == (
        0.1,
        0.3,
        True,
        False,
    )
    assert row.score == pytest.approx(0.2 / np.hypot(0.01, 0.01))
    whole = predicted(measured("T-2", years["T-2"], tests), TypeRates.of([]), LIMITS)
    assert {"left-limits", "shortened"} <= {finding.id for finding in whole.findings}
    assert (
        whole.next_due == "2023-10-30"
    )  # 364 days in which it failed: half of them after 2023-05-01
    kept = predicted(measured("T-2", years["T-2"], tests[1:]), TypeRates.of([]), LIMITS)
    assert kept.next_due is None
    alone = predicted(measured("T-2", years["T-2"], tests[:1]), TypeRates.of([]), LIMITS)
    assert alone.next_due == whole.next_due
    visit = [
        test_of("2021-05-02", 0.3, False)
    ]  # the calibration was bad, nothing happened in service
    assert not measured("T-2", years["T-2"], visit).failures


def walking(seed, size, days):
    """A tool whose accelerometer biases walk by a normal variable of this size from day to day."""
    bench, result = Bench("twelve-state", seed), []
    for day in days:
        result.append(bench.calibration(day))
        for place in (3, 4, 5):
            bench.shift(place, size * bench.rng.normal())
    return result


def test_a_walk_beyond_any_grid_is_found_and_shortens_the_interval():
    """10 mg a year is 300 standard uncertainties: the rate is that of the biases' own differences."""
    calibrations = walking(14, 1e-2, [f"{year}-05-01" for year in range(2021, 2026)])
    tool = measured("T-1", calibrations)
    drift = predicted(tool, TypeRates.of([tool]), {"inclination": 0.25})
    rate = next(r for r in drift.rates if (r.triad, r.kind) == ("accelerometer", "bias"))
    values = np.array([p.values for p in drift.parameters if p.name.startswith("bias")][:3])
    observed = np.sqrt(np.mean(np.diff(values, axis=-1) ** 2))
    assert rate.per_root_year == pytest.approx(observed, rel=0.15)
    assert rate.low < observed < rate.high
    assert drift.next_due < "2025-11-01"
    assert drift.due[0].risk == RISK


def test_one_large_step_shortens_the_interval_whatever_the_peers():
    """A knock of 6 mg (0.24° and more at 45° inclination) in a year: due within half a year."""
    bench = Bench("twelve-state", 15)
    calibrations = [bench.calibration("2024-05-01")]
    bench.shift(5, 6e-3)
    calibrations.append(bench.calibration("2025-05-01"))
    tool = measured("T-1", calibrations)
    (step,) = (each for each in tool.departures if each.angle == "inclination")
    assert step.size == pytest.approx(6e-3 / np.sqrt(2), abs=4 * step.uncertainty)
    (left,) = step.left({"inclination": 0.2})
    assert (left.start, left.end) == (date(2024, 5, 1), date(2025, 5, 1))
    assert not list(step.left({"inclination": 0.3}))
    peers = [measured(f"P-{k}", walking(k, 0.0, ("2024-05-01", "2025-05-01"))) for k in (16, 17)]
    drift = predicted(tool, TypeRates.of([tool, *peers]), {"inclination": 0.2})
    assert drift.next_due <= "2025-10-30"


def test_a_repair_between_two_calibrations_of_one_visit_is_no_walk():
    """As found and as left, on successive days, with a step of 6 mg: the walk is that of the years between."""
    days = ("2023-05-01", "2024-05-01", "2024-05-02", "2025-05-01")
    bench, calibrations = Bench("twelve-state", 18), []
    for day in days:
        if day == "2024-05-02":
            bench.shift(5, 6e-3)
        calibrations.append(bench.calibration(day))
    tool = measured("T-1", calibrations)
    assert tool.increments["accelerometer", "bias"].noise.size == 2 * 3
    assert not any(list(each.left({"inclination": 0.2})) for each in tool.departures)
    assert predicted(tool, TypeRates.of([tool]), {"inclination": 0.2}).next_due > "2026-05-01"


@pytest.mark.parametrize("stated", [0, 1])
def test_a_run_without_gravity_is_no_change_of_the_tool(stated):
    """Local gravity 0.9985 g, one of two runs does not say so: its scales are all wrong by 1.5 mg."""
    bench = Bench("acceptance-104", 19)
    calibrations = []
    for number, day in enumerate(("2024-05-01", "2025-05-01")):
        readings = bench.readings(day)
        local = readings.accelerometer.copy()
        sensed = bench.tool.triads["accelerometer"][0].fields(
            bench.tool.accelerometer, local, readings.temperature
        )
        slope = bench.tool.triads["accelerometer"][0].slope(
            bench.tool.accelerometer, local, readings.temperature
        )
        local = local - 0.0015 * np.linalg.solve(slope, sensed[..., None])[..., 0]
        known = {**readings.known, "gravity": np.full(readings.count, 0.9985)}
        if number != stated:
            known.pop("gravity")
        each = replace(readings, accelerometer=local, known=known)
        calibrations.append(calibrate(each, SERVO, Options(order=0)))
    drift = measured("T-1", calibrations).drift
    assert not drift.change.changed
    assert any("1.5 mg" in note for c in drift.calibrations for note in c.notes)
    unlike = with_changes(calibrations[1 - stated], gravity_stated=True)
    both = [unlike, calibrations[stated]]
    assert measured("T-1", both).drift.change.changed  # as if both had stated it


@pytest.mark.usefixtures("without_layout")
def test_pages_mark_simulated_data_and_escape_names(years):
    pytest.importorskip("matplotlib")
    from mwdcal.presentation.drift import (
        drift_picture,
        fleet_screen,
        render_fleet,
        render_tool,
        tool_screen,
    )

    name = "<script>alert(1)</script>\x1b[2J"
    tools = [measured(name, years["T-1"]), measured("T-2", years["T-2"])]
    fleet, (drift, _) = fleet_drift(tools, LIMITS, TODAY)
    pages = render_tool(drift), render_fleet(fleet)
    for page in pages:
        assert "SIMULATED DATA" in page
        assert "<script>alert" not in page
        assert "\x1b" not in page
    assert pages[1] == render_fleet(fleet)
    for screen in (tool_screen(drift), fleet_screen(fleet)):
        assert "SIMULATED DATA" in screen
        assert "\x1b" not in screen
    assert len(drift_picture(drift).axes) == 6


def recognised(readings):
    """Readings whose stations can be recognised, as those of a file."""
    return replace(readings, digest=fingerprints([readings.accelerometer, readings.magnetometer]))


def test_calibrations_of_the_same_stations_count_once():
    bench = Bench("twelve-state", 11)
    readings, other = (recognised(bench.readings(f"{year}-05-01")) for year in (2024, 2025))
    first, again = (calibrate(readings, SERVO, Options(order=0, seed=seed)) for seed in (0, 1))
    part = calibrate(readings, SERVO, Options(order=0, exclude=readings.station[:1]))
    last = calibrate(other, SERVO, Options(order=0))
    tool = tool_history([first, again, part, last])
    assert sum(tool.used) == 2
    assert tool.used[-1]
    assert sum("counts instead" in " ".join(notes) for notes in tool.notes) == 2
    alone = measured("T-1", [first, again]).drift
    assert alone.change is None


def test_a_calibration_with_a_prior_says_so_and_teaches_no_rate():
    bench = Bench("twelve-state", 12)

    def made(day, prior=None):
        return calibrate(recognised(bench.readings(day)), SERVO, Options(order=0, prior=prior))

    first = made("2023-05-01")
    second, third = made("2024-05-01", first), made("2025-05-01", first)
    tool = tool_history([first, second])
    assert tool.history.has_prior.tolist() == [False, True]
    assert any("prior" in note for note in tool.notes[1])
    assert all(not i.noise.size for i in measured("T-1", [first, second]).increments.values())
    # Without its prior in the history it is independent of what is there.
    assert not tool_history([made("2022-05-01"), third]).history.has_prior.any()


@pytest.mark.usefixtures("without_pictures")
def test_the_least_probability_that_is_drawn_is_a_bound(years):
    pytest.importorskip("matplotlib")
    from mwdcal.presentation.drift import fleet_screen, render_fleet, render_tool, tool_screen

    fleet, (drift, _) = fleet_drift(
        [measured("T-1", years["T-1"]), measured("T-2", years["T-2"])], LIMITS, TODAY
    )
    assert drift.change.probability == 1 / (NULL_DRAWS + 1)
    for text in (tool_screen(drift), fleet_screen(fleet), render_tool(drift), render_fleet(fleet)):
        assert "≤ 0.0001" in text
        assert text.count("0.0001 ") + text.count("0.0001<") <= text.count("≤ 0.0001")


def test_comparing_reports_its_progress(years, tmp_path):
    pytest.importorskip("sqlalchemy")
    from cli_support import mwdcal
    from mwdcal.files import documents
    from mwdcal.library.drifts import of_registry
    from mwdcal.registry.store import open_registry

    (tmp_path / "files").mkdir()
    for serial in ("T-1", "T-2"):
        for number, calibration in enumerate(years[serial]):
            documents.write(tmp_path / "files" / f"{serial}-{number}.json", calibration)
    database = tmp_path / "tools.sqlite"
    where = ("--registry", database)
    assert mwdcal("registry", "init", *where).code == 0
    assert mwdcal("registry", "add", tmp_path / "files", *where, "--workers", "1").code == 0
    for serial, total in ((None, 2), ("T-1", 1)):
        heard: list[tuple[int, int]] = []
        with open_registry(str(database)) as registry:
            of_registry(
                registry, serial, LIMITS, 0.01, TODAY, lambda *done, into=heard: into.append(done)
            )
        assert heard == [(done, total) for done in range(total)]


def test_the_command_reads_a_registry(years, tmp_path, monkeypatch):
    pytest.importorskip("sqlalchemy")
    from cli_support import mwdcal
    from mwdcal.files import documents

    (tmp_path / "files").mkdir()
    for serial, each in years.items():
        for number, calibration in enumerate(each):
            documents.write(tmp_path / "files" / f"{serial}-{number}.json", calibration)
    where = ("--registry", tmp_path / "tools.sqlite")
    assert mwdcal("registry", "init", *where).code == 0
    assert mwdcal("registry", "add", tmp_path / "files", *where, "--workers", "1").code == 0
    one = mwdcal("registry", "drift", "T-1", *where, "--json").json
    assert (one["command"], one["serial"], one["simulated"]) == ("registry drift", "T-1", True)
    assert one["tool"]["change"]["changed"]
    assert one["fleet"] is None
    every = mwdcal("registry", "drift", *where, "--limit", "inclination_deg=0.02", "--json").json
    assert (every["fleet"]["tools"], every["limits_deg"]) == (3, {"inclination": 0.02})
    monkeypatch.setattr("mwdcal.library.drifts.TOOLS_READ", 1)
    one_by_one = mwdcal("registry", "drift", *where, "--limit", "inclination_deg=0.02", "--json")
    assert one_by_one.json == every
    for wrong in (("T-0",), ("--limit", "dip_deg=1"), ("--limit", "inclination_deg=-1")):
        assert mwdcal("registry", "drift", *wrong, *where).code == 2


def test_surveys_drift_by_the_random_walk_of_their_tool(years, tmp_path):
    """Expected: what a parameter moves by in a year, as `registry drift` prints it, times the root of the years."""
    pytest.importorskip("sqlalchemy")
    import mwdcal as mc
    from cli_support import mwdcal
    from mwdcal.files import documents

    (tmp_path / "files").mkdir()
    for number, calibration in enumerate(years["T-1"]):
        documents.write(tmp_path / "files" / f"{number}.json", calibration)
    where = ("--registry", tmp_path / "tools.sqlite")
    assert mwdcal("registry", "init", *where).code == 0
    assert mwdcal("registry", "add", tmp_path / "files", *where, "--workers", "1").code == 0
    rows = mwdcal("registry", "drift", "T-1", *where, "--json").json["tool"]["rates"]
    rates = {(row["triad"], row["kind"]): row["per_root_year"] for row in rows}
    latest = years["T-1"][-1]
    day = date.fromisoformat(str(latest.tool["date"]))
    later = date.fromordinal(day.toordinal() + round(4 * 365.25))
    stations = Bench("twelve-state", 9).readings(later.isoformat())
    well = mc.survey(latest, stations, registry=where[1])
    errors = well.surveyed.well.errors
    assert errors.by_walk
    assert well.to_dict()["random_walk"] is True
    assert errors.years == pytest.approx(4.0, abs=0.003)
    moved = rates["magnetometer", "bias"] * 2.0
    assert errors.sensors.magnetometer_bias_nt == pytest.approx(moved, rel=1e-3)
    turned = np.radians(rates["accelerometer", "misalignment"])
    scale = np.sqrt(rates["accelerometer", "scale"] ** 2 + 2 * turned**2) * 2.0
    assert errors.sensors.accelerometer_scale == pytest.approx(scale, rel=1e-3)
    assert "random walk of this tool" in well.summary()
    plain = mc.survey(latest, stations)
    assert not plain.surveyed.well.errors.by_walk
    assert plain.surveyed.well.errors.sensors.magnetometer_bias_nt == pytest.approx(70.0)
    other = with_changes(latest, tool={**latest.tool, "serial": ""})
    with pytest.raises(InputError, match="no serial"):
        mc.survey(other, replace(stations, metadata={"date": later.isoformat()}), registry=where[1])


def test_a_tool_that_cannot_be_measured_does_not_stop_the_others(monkeypatch):
    def refusing(tools, level):
        if any(tool.serial == "odd" for tool in tools):
            raise InputError("not comparable")
        return [tool.serial for tool in tools]

    monkeypatch.setattr(drifts, "all_measured", refusing)
    refused = {}
    read = [ToolRecords(serial, (), (), {}) for serial in ("a", "odd", "c")]
    assert drifts._measured(read, 0.05, refused) == ["a", "c"]
    assert refused == {"odd": "not comparable"}
