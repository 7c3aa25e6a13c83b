"""Noise-free spreads of roll tests: bias, stated uncertainty, and which toolfaces allow them."""

import numpy as np
import pytest

from mwdcal.use.roll_test import Curve, coverage, ends, extent, fitted, scatter
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
    raw, found = np.ptp(value, axis=-1), extent(curve).range
    assert raw.mean() == pytest.approx(RANGE_OF_12 * 0.029, rel=0.02)
    assert (raw > 0.1).mean() > 0.3
    assert (found > 0.1).mean() < 0.01
    assert found.mean() == pytest.approx(0.029, abs=0.006)
    assert found.std() == pytest.approx(0.025, abs=0.004)


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
