"""Risk of a verdict: Student's t, guard bands, and all limits together."""

import numpy as np
import pytest

from mwdcal.use.verification import guard_factor, probability_within, risk_of_all


@pytest.mark.parametrize(
    ("freedom", "factor"), [(1, 13.97), (2, 4.53), (5, 2.65), (10, 2.28), (50, 2.05), (None, 2.0)]
)
def test_guard_bands_are_those_of_the_guide(freedom, factor):
    """JCGM 100:2008, table G.2, 95.45 % two-sided."""
    assert guard_factor(freedom) == pytest.approx(factor, abs=0.006)


def test_a_value_of_few_degrees_of_freedom_is_never_certain():
    """One degree of freedom is Cauchy's distribution: 1/2 + atan(x)/π."""
    within = probability_within(0.05, 0.01, 0.1, two_sided=False, freedom=1.0)
    assert within == pytest.approx(0.5 + np.arctan(5) / np.pi)


CORRELATIONS = [0.0, 0.5, 0.95]
CHANCES = [(0.5, 0.5), (0.9, 0.8), (0.999, 0.2), (0.9999, 0.999)]


def errors(correlation):
    """Two errors (d, 2) of this very correlation."""
    rng = np.random.default_rng(1)
    half = rng.normal(size=(500, 2))
    even = np.linalg.solve(np.linalg.cholesky(half.T @ half / 500), half.T).T
    root = np.linalg.cholesky([[1, correlation], [correlation, 1]])
    return np.concatenate([even, -even]) @ root.T


@pytest.mark.parametrize("correlation", CORRELATIONS)
@pytest.mark.parametrize("chances", CHANCES)
def test_all_limits_together(correlation, chances):
    """Against the share of a million draws of two normal values."""
    from scipy.special import ndtri

    rng = np.random.default_rng(2)
    root = np.linalg.cholesky([[1, correlation], [correlation, 1]])
    within = (rng.normal(size=(1_000_000, 2)) @ root.T <= ndtri(chances)).all(-1).mean()
    passed = risk_of_all(chances, True, errors(correlation))
    failed = risk_of_all(chances, False, errors(correlation))
    assert passed == pytest.approx(1 - within, rel=0.06, abs=2e-5)
    assert failed == pytest.approx(within, rel=0.06)


def test_a_small_risk_is_not_lost_among_the_draws():
    """Independent: the sum of 1e-9 and 2e-9; of one limit twice: 1e-9."""
    assert risk_of_all([1 - 1e-9, 1 - 2e-9], True, errors(0.0)) == pytest.approx(3e-9, rel=1e-3)
    one = errors(0.0)[:, [0, 0]]
    assert risk_of_all([1 - 1e-9, 1 - 1e-9], True, one) == pytest.approx(1e-9, rel=1e-3)
