"""The chances that NumPy alone computes, against exact series and SciPy."""

from __future__ import annotations

from decimal import Decimal, localcontext

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import fdtrc, ndtri

from mwdcal.estimation.uncertainty import fisher_tail, normal_quantile

FREEDOM = st.floats(1, 1e4)
BERNOULLI = [(1, 6), (-1, 30), (1, 42), (-1, 30), (5, 66), (-691, 2730), (7, 6), (-3617, 510)]
PI = Decimal("3.14159265358979323846264338327950288419716939937510582")


def log_gamma(z: Decimal) -> Decimal:
    """ln Γ in Decimal: Stirling's series from 60 on, DLMF 5.11.1."""
    below = Decimal(0)
    while z < 60:
        below, z = below + z.ln(), z + 1
    total = (z - Decimal("0.5")) * z.ln() - z + (2 * PI).ln() / 2 - below
    for k, (over, under) in enumerate(BERNOULLI, 1):
        total += Decimal(over) / under / (2 * k * (2 * k - 1) * z ** (2 * k - 1))
    return total


def exact_tail(over: float, under: float, ratio: float) -> float:
    """Fisher's F by the power series of the incomplete beta function, DLMF 8.17.8, in 60 digits."""
    with localcontext() as context:
        context.prec = 60
        a, b, f = Decimal(under) / 2, Decimal(over) / 2, Decimal(ratio)
        x = a / (a + b * f)
        front = a * x.ln() + b * (1 - x).ln() + log_gamma(a + b) - log_gamma(a) - log_gamma(b)
        total, term, k = Decimal(0), 1 / a, 0
        while term > total * Decimal("1e-30"):
            total, k = total + term, k + 1
            term *= (a + b + k - 1) / (a + k) * x
        return float(front.exp() * total)


OVERS = (0.5, 1.0, 3.0, 20.0, 300.0)
UNDERS = (1.0, 2.5, 40.0, 1_000.0, 9_235.118)
RATIOS = (0.3, 0.999, 1.0, 1.5, 8.0, 26.445, 1e3)


def grid():
    """All together for the study; always, a fifth of them in which every two of the values meet."""
    for i, j, k in np.ndindex(len(OVERS), len(UNDERS), len(RATIOS)):
        marks = [pytest.mark.study] if (i + j + k) % 5 else []
        yield pytest.param(OVERS[i], UNDERS[j], RATIOS[k], marks=marks)


@pytest.mark.parametrize(("over", "under", "ratio"), [*grid()])
def test_the_tail_is_that_of_the_exact_series(over, under, ratio):
    expected = exact_tail(over, under, ratio)
    if expected < 1e-290:
        pytest.skip("below the smallest number")
    found = float(fisher_tail(*map(np.array, (over, under, ratio))))
    assert found == pytest.approx(expected, 1e-12)


@given(FREEDOM, FREEDOM, st.floats(1e-3, 1e3))
def test_the_tail_is_that_of_scipy(over, under, ratio):
    expected = fdtrc(over, under, ratio)
    found = float(fisher_tail(*map(np.array, (over, under, ratio))))
    reach = 1e-12 if expected > 1e-100 else 1e-6  # SciPy has eight digits near 1e-270
    assert found == pytest.approx(expected, reach, 1e-290)


def test_the_tail_has_limits_and_shapes():
    over, under = np.array([[1.0], [7.0]]), np.array([3.0, 1e9, 50.0])
    found = fisher_tail(over, under, np.array([0.0, np.inf, 1e290]))
    assert found.shape == (2, 3)
    assert found[:, :2].tolist() == [[1.0, 0.0]] * 2
    assert found[:, 2] == pytest.approx(0.0, abs=1e-280)


def test_a_row_of_quantiles_does_not_depend_on_the_others():
    chances = 10.0 ** np.random.default_rng(3).uniform(-290, 0, (40, 7))
    alone = [normal_quantile(row).tolist() for row in chances]
    assert normal_quantile(chances).tolist() == alone


@given(st.floats(1e-300, 1.0))
def test_the_quantile_is_that_of_scipy(chance):
    found = float(normal_quantile(np.array(chance)))
    assert found == pytest.approx(-ndtri(chance / 2), 1e-12, 1e-14)
