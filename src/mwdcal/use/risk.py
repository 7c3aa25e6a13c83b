"""How likely a tool is within its limits, by the values of a test and their uncertainties.

A true value is normal about its value with its standard uncertainty, or follows Student's t where that has few
degrees of freedom. Reference: JCGM 106:2012, 7.2 and 7.4; JCGM 100:2008, G.3.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mwdcal.geometry.vectors import Array, eigen

COVERAGE = 2.0
"""Coverage factor of the guard band and of the remark that a value is close to its limit."""
RISK_DRAWS = 2000
RISK_SEED = 1


def cumulative(score: float, freedom: float | None) -> float:
    """Probability below a number of standard uncertainties; `freedom` None: unlimited."""
    from scipy.special import ndtr, stdtr

    unlimited = freedom is None or not np.isfinite(freedom)
    return float(ndtr(score) if unlimited else stdtr(max(freedom or 0.0, 1.0), score))


def guard_factor(freedom: float | None) -> float:
    """Factor k of a guard band beyond which as much lies as beyond `COVERAGE` standard deviations of a normal value.

    Definition: Student's t; less than one degree of freedom counts as one.
    """
    if freedom is None:
        return COVERAGE
    from scipy.special import ndtr, stdtrit

    return max(COVERAGE, float(stdtrit(max(freedom, 1.0), float(ndtr(COVERAGE)))))


def probability_within(
    value: float, sd: float, limit: float, two_sided: bool, freedom: float | None = None
) -> float:
    """Probability that the true value is at most `limit`; `two_sided`: and at least its negative.

    Definition: F((limit - value) / sd), for two sides less F((-limit - value) / sd), with F of the normal
    distribution, or of Student's t with `freedom`. Singular: without uncertainty 0 or 1.
    """
    if sd == 0:
        return float(value <= limit)
    below = cumulative((-limit - value) / sd, freedom) if two_sided else 0.0
    return cumulative((limit - value) / sd, freedom) - below


def risk_of_all(within: Sequence[float], passed: bool, errors: Array) -> float:
    """Probability that the verdict on all limits is wrong: a limit exceeded in a pass, none exceeded in a fail.

    `within`: probability for each of k limits, `errors` (d, k) of their values in tests like this one, from which
    their correlation is taken (a Gaussian copula). Both probabilities are drawn given that one limit is exceeded,
    or met, so that small ones are known too. Reference: Owen, Maximov and Chertkov 2019, ALOE.
    """
    from scipy.special import ndtr, ndtri

    chance = np.asarray(within, float)
    size = np.linalg.norm(errors, axis=0)
    correlation = errors.T @ errors / np.maximum(np.outer(size, size), 1e-300)
    values, vectors = eigen(correlation)
    rng = np.random.default_rng(RISK_SEED)
    normal = (
        rng.normal(size=(RISK_DRAWS, len(chance))) @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
    )
    uniform = (np.arange(RISK_DRAWS) + 0.5) / RISK_DRAWS

    def given(first: int, score: Array) -> Array:
        """Scores (d, k) of all limits where that of the first is known."""
        others = (
            normal - normal[:, [first]] * correlation[first] + score[:, None] * correlation[first]
        )
        others[:, first] = score
        return np.asarray(others)

    least = ndtri(chance)
    if not passed:
        first = int(chance.argmin())
        met = given(first, ndtri(chance[first] * uniform)) <= least
        met[:, first] = True
        return float(chance[first] * met.all(-1).mean())
    risk = 0.0
    for k, share in enumerate(ndtr(-least)):
        exceeded = given(k, -ndtri(share * uniform)) > least
        exceeded[:, k] = True
        risk += float(share * np.mean(1 / exceeded.sum(-1)))
    return min(risk, 1.0)
