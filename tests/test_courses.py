"""What a temperature order leaves out: choice, misfit and stated uncertainty. All data are simulated."""

import re
from collections import Counter
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from scipy import stats

from mwdcal.calibration.automatic.auto import choose_order, choose_orders
from mwdcal.calibration.automatic.courses import course_misfit, misfit_covariance, terms_beyond
from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.errors import FitError
from mwdcal.estimation.batch import mapped, take
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.planning.plans import servo
from mwdcal.presentation.calibration_page import outcome
from mwdcal.presentation.typed import leading_findings
from mwdcal.sensor.profile import Profile
from simulation import DEG, attitude, factor_readings, factors_within_limits, plan

NOISE = (1e-4, 15.0)
EARTH = (1.0, 48_000.0, 63 * DEG)
SOAKS = {
    2: (25.0, 145.0),
    3: (25.0, 85.0, 145.0),
    4: (25.0, 65.0, 105.0, 145.0),
    5: (25.0, 55.0, 85.0, 115.0, 145.0),
    7: (25.0, 45.0, 65.0, 85.0, 105.0, 125.0, 145.0),
}
ANGLES = ("inclination", "azimuth", "gravity", "field", "dip")


def tools(count, seed, order=3):
    """Factors (count, 60) of servo tools whose scales and biases vary with powers up to an order."""
    rng = np.random.default_rng(seed)
    drawn = [servo(rng) for _ in range(count)]
    factors = np.stack([np.concatenate([t.accelerometer, t.magnetometer]) for t in drawn])
    for first in (0, 30):
        course = factors[:, first : first + 24].reshape(count, 6, 4)
        course[..., order + 1 :] = 0.0
        factors[:, first : first + 24] = course.reshape(count, 24)
    return factors


def vectors_at(inc, azi, face):
    return np.concatenate(attitude(inc, azi, face)(*EARTH), -1)


def runs(factors, temperatures, seed, declared=True, scatter=0.0, noise=NOISE):
    """A batch of runs, 24 stations at each temperature; `scatter` of gains and offsets by soak."""
    angles = [np.tile(a, len(temperatures)) for a in plan(toolfaces=6)]
    soak = np.repeat(np.arange(len(temperatures)), 24)
    return read(factors, angles, np.array(temperatures)[soak], seed, declared, scatter, noise, soak)


def read(factors, angles, warmth, seed, declared=True, scatter=0.0, noise=NOISE, soak=None):
    """A batch of runs with stations at some attitudes and temperatures (n,)."""
    rng, shape = np.random.default_rng(seed), (len(factors), len(warmth))
    field = np.broadcast_to(vectors_at(*angles), (*shape, 6))
    soak = np.zeros(len(warmth), int) if soak is None else soak
    raw = factor_readings(factors, warmth, scattered(field, soak, scatter, rng))
    raw = raw + np.repeat(noise, 3) * rng.normal(size=raw.shape)
    names = ("inclination", "azimuth", "toolface", "gravity", "field", "dip")
    known = {n: np.broadcast_to(v, shape) for n, v in zip(names, (*angles, *EARTH), strict=True)}
    sd = {n: np.full((len(raw), 1, 1), s) for n, s in zip(TRIADS, NOISE, strict=True)}
    return Readings(
        raw[..., :3], raw[..., 3:], np.broadcast_to(warmth, shape), known, sd=sd if declared else {}
    )


def scattered(field, soak, size, rng):
    """Fields (B, n, 6) as gains and offsets that differ from soak to soak make them."""
    change = size * rng.normal(size=(2, len(field), soak.max() + 1, 6))
    return field * (1 + change[0][:, soak]) + np.repeat(EARTH[:2], 3) * change[1][:, soak]


def fitted(readings, orders):
    """Fits of the members, by the orders that each has, with the places of the members."""
    for pair in np.unique(orders, axis=0):
        index = np.flatnonzero((orders == pair).all(-1))
        yield index, fit(take(readings, index), Options(order=(int(pair[0]), int(pair[1]))))


def covariance_of(result):
    """Of the parameters: noise scaled by s², and what the order leaves out."""
    sizes = [t.model.size for t in result.problem.triads]
    grown = np.sqrt(np.repeat(result.analysis.variance_factor, sizes, axis=-1))
    noise = result.analysis.covariance * grown[:, :, None] * grown[:, None, :]
    return noise + misfit_covariance(result)


def error_ratios(factors, readings, orders, seed, scatter=0.0):
    """Rms error over rms stated uncertainty by observable, between the coldest and the hottest soak."""
    rng = np.random.default_rng(seed + 1000)
    inc, azi, face = np.arccos(rng.uniform(-0.97, 0.97, 120)), *rng.uniform(0, 2 * np.pi, (2, 120))
    warmth = rng.uniform(readings.temperature.min(), readings.temperature.max(), 120)
    field = np.broadcast_to(vectors_at(inc, azi, face), (len(factors), 120, 6))
    raw = factor_readings(factors, warmth, scattered(field, np.arange(120), scatter, rng))
    squares = np.zeros((len(ANGLES), 2))
    for index, result in fitted(readings, orders):
        found, slopes = fields_of(result, raw[index], warmth)
        covariance = covariance_of(result)
        for place, name in enumerate(ANGLES):
            observable = OBSERVABLES[name]
            true = observable.value(field[index, :, :3], field[index, :, 3:])
            error = observable.value(found[..., :3], found[..., 3:]) - true
            error = np.angle(np.exp(1j * error)) if observable.period else error
            gradient = observable.gradient(found[..., :3], found[..., 3:])
            rows = (gradient[..., None, :] @ slopes)[..., 0, :]
            stated = np.sum((rows @ covariance) * rows, -1)
            weight = np.sin(inc) ** 2 if name == "azimuth" else 1.0
            squares[place] += [np.sum(weight * error**2), np.sum(weight * stated)]
    return dict(zip(ANGLES, np.sqrt(squares[:, 0] / squares[:, 1]), strict=True))


def fields_of(result, raw, warmth):
    """Fields (B, n, 6) of a fit, and their derivative (B, n, 6, p) by its parameters."""
    warmth = np.broadcast_to(warmth, raw.shape[:-1])
    slices = result.problem.slices()
    slopes = np.zeros((*raw.shape, slices[-1].stop))
    found = []
    for t, (triad, where) in enumerate(zip(result.problem.triads, slices, strict=True)):
        own, params = slice(3 * t, 3 * t + 3), result.state.params[:, where]
        found.append(triad.model.fields(params, raw[..., own], warmth))
        slopes[..., own, where] = triad.model.jacobian(params, raw[..., own], warmth)
    return np.concatenate(found, -1), slopes


@cache
def servo_runs(soaks, declared=True):
    factors = tools(50, soaks)
    readings = runs(factors, SOAKS[soaks], soaks, declared)
    return factors, readings, choose_orders(readings, Options())


@pytest.mark.parametrize("soaks", [3, 4, 5, 7])
def test_stated_uncertainty_is_that_of_a_chosen_order_simulated(soaks):
    """50 servo tools of order 3, whose small terms no run shows: 1σ over the range of temperatures."""
    ratios = error_ratios(*servo_runs(soaks), soaks)
    assert all(0.9 < ratio < 1.1 for ratio in ratios.values()), ratios


@pytest.mark.parametrize("soaks", [3, 4])
def test_powers_as_large_as_each_other_are_stated_too_simulated(soaks):
    """Tools of which each power reaches the datasheet's limits by itself."""
    factors = factors_within_limits(np.random.default_rng(soaks), 40)
    readings = runs(factors, SOAKS[soaks], soaks)
    ratios = error_ratios(factors, readings, choose_orders(readings, Options()), soaks)
    assert all(0.85 < ratio < 1.15 for ratio in ratios.values()), ratios


@pytest.mark.parametrize("declared", [True, False])
def test_three_soaks_give_the_second_order_that_they_show_simulated(declared):
    orders = servo_runs(3, declared)[2]
    assert (orders[:, 0] == 2).all()
    assert set(orders[:, 1]) == {1, 2}


@pytest.mark.parametrize("order", [0, 1])
@pytest.mark.parametrize("soaks", [2, 3, 5])
def test_terms_that_are_not_there_are_not_taken_simulated(soaks, order):
    """Rarely: one of 160 triads at most, with estimated noise."""
    factors = tools(80, 10 * soaks + order, order)
    readings = runs(factors, SOAKS[soaks], soaks, declared=False)
    chosen = choose_orders(readings, Options())
    assert (chosen >= order).all()
    assert np.sum(chosen > order) <= 1, Counter(map(tuple, chosen.tolist()))


def test_chances_are_uniform_where_nothing_is_left_out_simulated():
    readings = runs(tools(80, 3, 1), SOAKS[5], 3)
    chance = terms_beyond(fit(readings, Options(order=1))).chance
    assert np.isnan(chance[..., [0, 4]]).all()
    for sample in np.moveaxis(chance[..., 1:4], 0, -1).reshape(6, -1):
        assert stats.kstest(sample, "uniform").pvalue > 1e-3


@pytest.mark.parametrize("soaks", [5, 7])
def test_scatter_between_soaks_is_stated_simulated(soaks):
    """Gains and offsets that differ by 3e-4 from soak to soak: at another temperature they do again."""
    factors = tools(40, soaks, 1)
    readings = runs(factors, SOAKS[soaks], soaks, scatter=3e-4)
    orders = choose_orders(readings, Options())
    ratios = error_ratios(factors, readings, orders, soaks, scatter=3e-4)
    assert all(0.85 < ratio < 1.15 for ratio in ratios.values()), ratios


def test_the_size_of_what_is_left_out_is_that_of_the_truth_simulated():
    """Order 1 fitted to tools of order 2: against the error of a fit without noise."""
    factors = tools(20, 1, 2)
    readings = runs(factors, SOAKS[5], 1, declared=False, noise=(3e-5, 3.0))
    result = fit(readings, Options(order=1))
    still = fit(runs(factors, SOAKS[5], 1, noise=(0.0, 0.0)), Options(order=1))
    rng = np.random.default_rng(2)
    inc, azi, face = np.arccos(rng.uniform(-1, 1, 400)), *rng.uniform(0, 2 * np.pi, (2, 400))
    warmth = np.linspace(25, 145, 400)
    field = np.broadcast_to(vectors_at(inc, azi, face), (20, 400, 6))
    clean = factor_readings(factors, warmth, field)
    error = (fields_of(still, clean, warmth)[0] - field) / np.repeat(EARTH[:2], 3)
    wanted = np.sqrt(np.mean(error.reshape(20, 400, 2, 3) ** 2, (0, 1, 3)))
    gains, offsets = np.moveaxis(course_misfit(result), -1, 0)
    found = np.sqrt(np.mean(gains / 3 + offsets, 0))
    np.testing.assert_allclose(found, wanted, rtol=0.1)


def alone(soaks, seed=0):
    """One tool's run, as from a table."""
    readings = runs(tools(1, seed), SOAKS[soaks], seed)
    one = mapped(lambda value: value[0], readings)
    return replace(one, metadata={"simulated": True})


def test_an_order_too_low_is_a_finding_simulated():
    data = alone(5)
    found = {f.id: f.text for f in calibrate(data, PROFILE, Options(order=1)).findings}
    text = found["accelerometer-temperature-misfit"]
    assert " mg rms" in text
    assert "`order` 2" in text
    assert "temperature-untested" not in found
    order, _ = choose_order(data, Options(), lambda said: None)
    ids = {f.id for f in calibrate(data, PROFILE, Options(order=order)).findings}
    assert not any(name.startswith(("accelerometer-temp", "magnetometer-temp")) for name in ids)


@pytest.mark.parametrize(("soaks", "words"), [(2, "no uncertainty here"), (3, "falls off")])
def test_a_course_that_takes_all_temperatures_is_untested_simulated(soaks, words):
    data = alone(soaks)
    record = calibrate(data, PROFILE)
    (text,) = (f.text for f in record.findings if f.id == "temperature-untested")
    assert words.replace("falls", "fall") in text
    last = [row for row in record.orders if row.order == soaks - 1]
    assert all(row.ends is row.inside is row.error_inside is None for row in last)
    assert last[0].chosen
    assert last[0].chance < 1e-3


def test_no_temperatures_leave_nothing_out():
    data = replace(alone(2), temperature=None)
    assert not misfit_covariance(fit(data)).any()


PROFILE = Profile(name="test tool")


def bent(count, order):
    """Tools whose gains and offsets have every power up to an order, 0.05 to 0.1 % of the field 60 °C away."""
    rng, factors = np.random.default_rng(order), tools(count, 11, order)
    for first, strength in zip((0, 30), EARTH[:2], strict=True):
        course = factors[:, first : first + 24].reshape(count, 6, 4)
        unit = np.repeat([1.0, strength], 3)[:, None] / 60.0 ** np.arange(1, order + 1)
        size = (
            1e-3 * rng.uniform(0.5, 1, (count, 6, order)) * rng.choice([-1, 1], (count, 6, order))
        )
        course[..., 1 : order + 1] = size * unit
        factors[:, first : first + 24] = course.reshape(count, 24)
    return factors


def cooled():
    """A cold and a hot tumble, and the tool cooling from one to the other at two attitudes."""
    two = [np.tile(np.radians(pair), 24) for pair in ((40.0, 120.0), (30.0, 200.0), (50.0, 250.0))]
    tumble = plan(toolfaces=6)
    angles = [np.concatenate([a, a, b]) for a, b in zip(tumble, two, strict=True)]
    return angles, np.concatenate([np.full(24, 25.0), np.full(24, 145.0), np.linspace(145, 25, 48)])


def ramp(step, seed=3):
    """A ladder of small steps, each attitude of a tumble in turn, shuffled in every round."""
    levels = np.arange(25.0, 145.1, step)
    warmth, rng = np.repeat(levels, -(-96 // len(levels))), np.random.default_rng(seed)
    turns = np.concatenate([rng.permutation(24) for _ in range(6)])[: len(warmth)]
    return [a[turns] for a in plan(toolfaces=6)], warmth


@pytest.mark.parametrize("order", [1, 3])
@pytest.mark.parametrize("declared", [True, False])
@pytest.mark.parametrize("made", [partial(ramp, 1.0), partial(ramp, 4.0), cooled])
def test_ramps_ladders_and_cooling_records_calibrate_as_soaks_do(made, declared, order):
    """The order of the tool is found, and errors are as large as stated: no temperature stands apart."""
    factors, seed = bent(12, order), 5
    readings = read(factors, *made(), seed, declared)
    orders = choose_orders(readings, Options())
    assert np.mean(orders == order) > 0.8
    assert orders.max() <= order
    for name, ratio in error_ratios(factors, readings, orders, seed).items():
        assert 0.7 < ratio < 1.35, name


def single(readings):
    """The first run of a batch."""
    one = mapped(lambda value: value[0], readings)
    count = one.count
    return replace(one, sd={n: np.broadcast_to(v, (count, 3)) for n, v in one.sd.items()})


def in_order():
    """A ramp on which one inclination follows another, each at its own temperatures only."""
    return plan(toolfaces=24), np.linspace(25.0, 145.0, 96)


def test_attitudes_that_follow_the_temperature_are_a_finding_and_others_are_not():
    """The next power of temperature is then told by nothing: the stations see it as a sensor error."""
    factors = tools(1, 12, order=1)
    for made, named in ((in_order, True), (partial(ramp, 1.0), False), (cooled, False)):
        record = calibrate(single(read(factors, *made(), 6)), Profile(name="x"))
        assert record.thermal
        found = [f.text for f in record.findings if f.id == "temperature-aligned"]
        assert bool(found) == named
        assert all("power 2 of temperature" in text for text in found)


def test_an_order_that_does_not_follow_the_run_is_refused_for_its_temperatures():
    """Residuals that temperature explains are not those of columns that were mixed up."""
    readings = single(read(tools(1, 13), *ramp(1.0), 7))
    with pytest.raises(
        FitError, match=r"vary with temperature more than `order` 0 follows.*120 °C.*`order` auto"
    ):
        calibrate(readings, Profile(name="x"), Options(order=0))
    free = calibrate(replace(readings, sd={}), Profile(name="x"), Options(order=0))
    assert {f.id for f in free.findings} >= {"accelerometer-temperature-misfit"}


def unrecorded(seed, declared=False):
    """A run over 120 °C whose temperature is in a column of no telling name, and what else its table has."""
    angles, warmth = ramp(1.0)
    one = single(read(tools(1, seed), angles, warmth, seed, declared))
    rng, count = np.random.default_rng(seed), one.count
    others = {
        "X17": warmth,
        "number": np.arange(1.0, count + 1),
        "inclination of the tool": np.degrees(angles[0]) + 0.02 * rng.normal(size=count),
        "battery": rng.uniform(size=count),
        "wandering": np.cumsum(rng.normal(size=count)),
    }
    return replace(one, temperature=None, others=others)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_column_that_explains_the_residuals_is_named_and_others_are_not(seed):
    """The tool drifts with the only column that is its temperature; the others have nothing to do with it."""
    (found,) = [
        f.text
        for f in calibrate(unrecorded(seed), Profile(name="x")).findings
        if f.id == "column-explains"
    ]
    assert re.match(r"Column 'X17' is not used, and explains (8[5-9]|9\d)%", found)
    assert "name it 'temperature_c'" in found
    quiet = unrecorded(seed, declared=True)
    quiet = replace(quiet, sd={name: value / 10 for name, value in quiet.sd.items()})
    with pytest.raises(FitError, match="no sensor model explains.*Column 'X17' is not used"):
        calibrate(quiet, Profile(name="x"))


@pytest.mark.parametrize("levels", [(25, 80, 140), (140, 110, 80, 50, 25)])
def test_a_column_that_a_drift_within_the_run_goes_with_is_named(levels):
    """Soaks in turn, their temperature under no telling name, noise not declared: the fit takes it for a drift."""
    angles = [np.tile(a, len(levels)) for a in plan(toolfaces=6)]
    warmth = np.repeat(np.array(levels, float), 24)
    one = single(read(tools(1, 4, order=1), angles, warmth, 4, declared=False))
    others = {"X17": warmth, "battery": np.random.default_rng(1).uniform(size=one.count)}
    found = calibrate(replace(one, temperature=None, others=others), Profile(name="x")).findings
    assert "accelerometer-drift" in {f.id for f in found}
    assert ["'X17'" in f.text for f in found if f.id == "column-explains"] == [True]
    assert found[0].id == "column-explains"


def test_a_column_that_explains_the_misfit_comes_first_and_in_the_banner():
    """Before the drifts that it causes; the report does not call the fit accepted."""
    made = calibrate(unrecorded(1), Profile(name="x"))
    others = [f for f in made.findings if f.id != "column-explains"]
    assert [made.findings[0], *others] == made.findings
    assert others
    banner = outcome(made, None)
    assert banner["level"] == "attention"
    assert "Fit doubtful" in banner["after"]
    assert "a column that is not used explains" in banner["after"]
    assert leading_findings([*others, made.findings[0]])[0][0].id == "column-explains"


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_no_column_explains_the_residuals_of_a_tool_at_one_temperature(seed):
    warm = unrecorded(seed)
    still = single(read(tools(1, seed), ramp(1.0)[0], np.full(warm.count, 25.0), seed, False))
    still = replace(still, temperature=None, others=warm.others)
    assert "column-explains" not in {f.id for f in calibrate(still, Profile(name="x")).findings}
