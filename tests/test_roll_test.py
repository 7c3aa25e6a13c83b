"""Noise-free spreads of roll tests: bias, stated uncertainty, and which toolfaces allow them."""

import numpy as np
import pytest

from mwdcal.use.roll_test import (
    Curve,
    coverage,
    drawn,
    ends,
    extent,
    figure,
    fitted,
    largest,
    scatter,
)
from simulation import DEG

TWELVE = np.arange(12) * 30 * DEG
RANGE_OF_12 = 3.258
"""Mean range of twelve standard normal values: the control chart constant d2."""
CIRCLE = np.arange(720) * 0.5 * DEG


def tools(rng, count, spread):
    """Errors over toolface of `count` tools, as functions of it: one range, any mix of harmonics."""
    share, phase = rng.uniform(0, 1, (count, 1)), rng.uniform(0, 2 * np.pi, (2, count, 1))

    def shape(toolface):
        return share * np.sin(toolface + phase[0]) + (1 - share) * np.sin(2 * toolface + phase[1])

    size = spread / np.ptp(shape(CIRCLE), axis=-1)[:, None]
    return lambda toolface: 0.3 + size * shape(toolface)


def rolls(rng, count, spread, noise, toolface=TWELVE, stated=None):
    """Values of roll tests of many tools, and what is found in them."""
    clean = tools(rng, count, spread)(toolface)
    value = clean + noise * rng.normal(size=clean.shape)
    sd = np.full(value.shape, stated or noise)
    return value, fitted(value, sd, np.broadcast_to(toolface, value.shape))


def test_a_perfect_tool_passes_where_noise_alone_spreads_the_raw_values():
    """0.5 mg: 0.029° of one inclination. The raw spread of twelve is 3.258 σ; the limit 0.1°."""
    value, curve = rolls(np.random.default_rng(1), 1000, 0.0, 0.029)
    raw, turn = np.ptp(value, axis=-1), extent(curve)
    found = turn.range
    assert raw.mean() == pytest.approx(RANGE_OF_12 * 0.029, rel=0.02)
    assert (raw > 0.1).mean() > 0.3
    assert (found > 0.1).mean() < 0.01
    assert found.mean() == pytest.approx(0.029, abs=0.006)
    assert found.std() == pytest.approx(0.025, abs=0.004)
    assert (found < 1.96 * turn.range_sd).mean() == pytest.approx(0.86, abs=0.035)


@pytest.mark.parametrize(
    ("noise", "spread"), [(0.0057, 0.08), (0.0115, 0.08), (0.029, 0.1), (0.029, 0.15)]
)
def test_a_spread_has_no_bias_and_its_uncertainty_is_honest(noise, spread):
    _, curve = rolls(np.random.default_rng(2), 1000, spread, noise)
    found = extent(curve)
    departure = (found.range - spread) / found.range_sd
    assert abs(departure.mean()) < 0.1
    assert 0.9 < np.sqrt(np.mean(departure**2)) < 1.1
    accepted = found.range + 2 * found.range_sd <= spread
    assert accepted.mean() < 0.023 + 3 * np.sqrt(0.023 / 1000)


def test_a_largest_departure_is_honest_too():
    """Errors about 0.3: the curve's largest departure is its mean and part of its spread."""
    rng = np.random.default_rng(3)
    clean = tools(rng, 1000, 0.2)
    truth = np.abs(clean(CIRCLE)).max(-1)
    value = clean(TWELVE) + 0.03 * rng.normal(size=(1000, 12))
    shape = np.full(value.shape, 0.03), np.broadcast_to(TWELVE, value.shape)
    found = extent(fitted(value, *shape))
    departure = (found.largest - truth) / found.largest_sd
    assert abs(departure.mean()) < 0.1
    assert 0.9 < np.sqrt(np.mean(departure**2)) < 1.1


def test_harmonics_and_ends_of_a_known_curve():
    value = 1 + 0.2 * np.sin(TWELVE) - 0.05 * np.cos(2 * TWELVE)
    curve = fitted(value, np.full(12, 1e-6), TWELVE)
    assert curve.amplitudes == pytest.approx([0.2, 0.05])
    dense = 0.2 * np.sin(CIRCLE) - 0.05 * np.cos(2 * CIRCLE)
    assert extent(curve).range == pytest.approx(np.ptp(dense), rel=1e-3)
    assert extent(curve).largest == pytest.approx(1 + dense.max(), rel=1e-6)
    most, least, farthest = ends(curve)
    assert most == farthest
    assert most == pytest.approx(CIRCLE[dense.argmax()], abs=5 * DEG)
    assert np.interp(least, CIRCLE, dense) == pytest.approx(dense.min(), abs=1e-3)


LAYOUTS = {
    "twelve": (np.arange(12) * 30, 2),
    "eight": (np.arange(8) * 45, 2),
    "five": (np.arange(5) * 72, 2),
    "twelve without two neighbours": (np.arange(10) * 30, 2),
    "twelve without three neighbours": (np.arange(9) * 30, 0),
    "half a circle": (np.arange(12) * 15, 0),
    "four at right angles": (np.arange(4) * 90, 1),
    "four at right angles, three times": (np.tile(np.arange(4) * 90, 3), 1),
    "the same, set by hand": (np.tile(np.arange(4) * 90, 3) + np.arange(12) % 5 - 2, 1),
    "three of four": (np.arange(3) * 90, 0),
    "three": (np.arange(3) * 120, 0),
    "three, four times": (np.tile(np.arange(3) * 120, 4), 0),
    "one": (np.full(12, 40), 0),
    "three close ones": (np.array([0, 5, 10]), 0),
}


@pytest.mark.parametrize(("toolface", "harmonics"), LAYOUTS.values(), ids=LAYOUTS)
def test_which_toolfaces_are_a_roll_test(toolface, harmonics):
    turned = np.mod(toolface + 123.0, 360)
    for angles in (toolface * DEG, np.stack([toolface, turned[::-1]]) * DEG):
        assert np.all(coverage(angles).harmonics == harmonics)
        assert np.all(coverage(angles).rolled == (harmonics > 0))


@pytest.mark.parametrize("count", [5, 6, 8, 12])
def test_equal_steps_carry_the_noise_of_their_parameters(count):
    """An orthogonal design of n readings knows every point of a curve of k terms to σ √(k/n)."""
    found = coverage(np.arange(count) * 2 * np.pi / count)
    assert found.carried == pytest.approx([np.sqrt(3 / count), np.sqrt(5 / count)])
    assert found.gap == pytest.approx(2 * np.pi / count)


@pytest.mark.parametrize(("count", "seen"), [(3, (0.866, 0.866)), (4, (0.7071, 0.0))])
def test_how_much_of_a_harmonic_the_toolfaces_show(count, seen):
    """The largest |cos(k t - phase)| at the toolfaces, for the worst phase."""
    toolface = np.arange(count) * 360 / count * DEG
    phase = np.linspace(0, 2 * np.pi, 721)[:, None]
    for k in (1, 2):
        worst = np.abs(np.cos(k * toolface - phase)).max(-1).min()
        assert coverage(toolface).seen[k - 1] == pytest.approx(worst, abs=5e-3)
        assert worst == pytest.approx(seen[k - 1], abs=5e-3)


def test_a_station_that_moved_is_not_smoothed_away():
    rng = np.random.default_rng(4)
    value, curve = rolls(rng, 1000, 0.08, 0.01)
    assert curve.rough().mean() < 0.005
    value[:, 5] += 0.1
    shape = np.full(value.shape, 0.01), np.broadcast_to(TWELVE, value.shape)
    assert fitted(value, *shape).rough().mean() > 0.95


def test_overstated_noise_does_not_shrink_a_spread():
    """A true spread of 0.12 with noise of 0.005, stated as 0.05: it stays over a limit of 0.1."""
    _, curve = rolls(np.random.default_rng(5), 1000, 0.12, 0.005, stated=0.05)
    assert scatter([curve]).calm.mean() > 0.99
    assert (extent(curve).range > 0.1).mean() > 0.98


def test_a_curve_without_a_covariance_has_no_range():
    """NaN, which the verdict refuses; no error of the linear algebra."""
    nothing = np.full((5, 5), np.nan)
    curve = Curve(coefficients=np.zeros(5), covariance=nothing, square=np.array(0.0), freedom=7)
    with np.errstate(invalid="ignore"):
        assert np.isnan(extent(curve).range_sd)


FOUR = np.arange(4) * 90 * DEG


def test_four_toolfaces_give_the_mean_and_first_harmonic_whatever_the_second():
    value = 0.3 + 0.2 * np.cos(FOUR - 1.0) + 0.05 * np.sin(2 * FOUR + 0.4)
    curve = fitted(value, np.full(4, 0.01), FOUR, harmonics=1)
    assert curve.amplitudes == pytest.approx([0.2, 0.0])
    assert curve.coefficients[0] == pytest.approx(0.3)
    assert curve.freedom == 1
    # an orthogonal design of four: σ²/4 of the mean, σ²/2 of each part of the harmonic
    assert np.diagonal(curve.covariance) == pytest.approx([2.5e-5, 5e-5, 0, 5e-5, 0])
    assert curve.square == pytest.approx((0.05 * np.sin(0.4)) ** 2 * 4 / 0.01**2)


def test_a_few_small_residuals_never_replace_a_stated_noise():
    """Six toolfaces, one degree of freedom: whatever is left, the 1σ is that of the declared noise."""
    rng = np.random.default_rng(6)
    six = np.arange(6) * 60 * DEG
    _, curve = rolls(rng, 500, 0.1, 0.02, toolface=six)
    noise = scatter([curve])
    assert noise.scale == pytest.approx(1.0)
    found = extent(curve, noise)
    assert found.range_sd.min() > 0.6 * np.median(found.range_sd)


def test_an_estimated_noise_is_pooled_by_degrees_of_freedom():
    """10 of the calibration, and residuals of two curves: (10 + χ²) / (10 + ν), with ν more degrees of freedom."""
    value = np.zeros(12)
    value[::2] = 0.02
    curve = fitted(value, np.full(12, 0.01), TWELVE)
    noise = scatter([curve, curve], 10.0)
    left = value - 0.01  # an alternation that no harmonic takes
    square = np.sum((left / 0.01) ** 2)
    assert noise.freedom == 24
    assert noise.scale == pytest.approx(np.sqrt((10 + 2 * square) / 24))


def test_residuals_against_a_noise_of_few_degrees_of_freedom_follow_fisher():
    """F of 1 and 3 degrees of freedom: beyond 10.13 lies 5 %, beyond 167.03 a thousandth (tables)."""
    curve = Curve(np.zeros(5), np.eye(5), np.array([160.0, 175.0, 11.0]), 1)
    assert curve.rough(3.0).tolist() == [False, True, False]
    assert curve.rough().tolist() == [True, True, True]


@pytest.mark.parametrize("count", [2, 3, 6])
def test_the_largest_of_equal_figures_has_little_bias_left(count):
    """The largest of k normal values lies 0.56, 0.85, 1.27 σ above their common mean (d2 / 2 and so on)."""
    rng = np.random.default_rng(7)
    value = 1 + 0.05 * rng.normal(size=(1500, count))
    half = rng.normal(size=(300, count))
    errors = 0.05 * np.broadcast_to(np.concatenate([half, -half]), (1500, 600, count))
    found = largest(value, np.full(value.shape, 0.05), errors)
    bias = {2: 0.56, 3: 0.85, 6: 1.27}[count]
    assert (value.max(-1).mean() - 1) / 0.05 == pytest.approx(bias, abs=0.06)
    assert abs(found.value.mean() - 1) < 0.25 * bias * 0.05 + 0.003
    assert 0.38 < (found.value <= 1).mean() < 0.55
    departure = (found.value - 1) / found.uncertainty
    assert 0.85 < np.sqrt(np.mean(departure**2)) < 1.15


def test_a_raw_figure_stays_as_it_is_and_changes_no_other():
    """By hand: without the raw figure of 1σ = 0.5 the others are what they are alone."""
    rng = np.random.default_rng(3)
    value, sd = np.array([1.0, 1.0, 0.98]), np.array([0.05, 0.05, 0.5])
    errors = sd * rng.normal(size=(1000, 3))
    errors -= errors.mean(0)
    rough = np.array([False, False, True])
    alone = largest(value[:2], sd[:2], errors[:, :2])
    found = largest(value, sd, errors, rough)
    assert (found.value, found.uncertainty) == (0.98, 0.5)  # alone: less than 0.98
    assert alone.value < 0.98
    smaller = np.array([1.0, 1.0, 0.5])
    found = largest(smaller, sd, errors, rough)
    assert (found.value, found.uncertainty) == (alone.value, alone.uncertainty)
    batch = largest(np.stack([value, smaller]), np.stack([sd, sd]), np.stack([errors] * 2),
                    np.stack([rough, rough]))  # fmt: skip
    assert batch.value == pytest.approx([0.98, alone.value])
    assert batch.place.tolist() == [2, 0]


def test_the_largest_of_figures_far_apart_is_the_largest():
    rng = np.random.default_rng(8)
    errors = 0.01 * rng.normal(size=(1000, 3))
    found = largest(np.array([0.5, 1.0, 0.2]), np.full(3, 0.01), errors - errors.mean(0))
    assert found.value == pytest.approx(1.0, abs=1e-3)
    assert found.uncertainty == pytest.approx(0.01, rel=0.1)
    assert found.place == 1


def test_stations_of_one_setting_share_its_error():
    """Two passes of twelve, each set once: the mean has half the variance of a setting, and σ²/24 of noise."""
    toolface, number = np.tile(TWELVE, 2), np.repeat([0, 1], 12)
    shared = 0.1**2 * (number[:, None] == number)
    curve = fitted(np.zeros(24), np.full(24, 0.01), toolface, shared=shared)
    assert curve.covariance[0, 0] == pytest.approx(0.1**2 / 2 + 0.01**2 / 24, rel=1e-6)
    assert curve.covariance[1, 1] == pytest.approx(0.01**2 / 12, rel=1e-6)


def test_what_is_off_in_tests_like_this_one_has_the_stated_size():
    value = 0.1 * np.cos(TWELVE)
    curve = fitted(value, np.full(12, 0.005), TWELVE)
    one = figure(value, curve, scatter([curve]), error=False, moved=drawn(curve, "inclination", 3))
    assert one.errors.mean() == pytest.approx(0, abs=1e-12)
    assert one.errors.std() == pytest.approx(one.uncertainty, rel=0.05)
