"""Wrong verdicts of simulated roll tests, good and knocked, against the risk that they state."""

import numpy as np
import pytest
import verification

from mwdcal.geometry.observables import OBSERVABLES
from simulation import attitude

NOISE = (5e-4, 75.0)
COUNT = 100


@pytest.fixture(scope="module")
def knocked():
    return list(verification.trials(np.random.default_rng(3), COUNT, NOISE, True))


def test_the_model_of_the_page_is_that_of_the_tests():
    """Vectors by axes against the printed formulas, angles by geometry against the package's."""
    rng = np.random.default_rng(1)
    angles = rng.uniform(0.1, 3.0, (3, 100))
    g, b = verification.vectors(*angles)
    wanted = attitude(*angles)(1.0, verification.FIELD, verification.DIP)
    np.testing.assert_allclose(g, wanted[0], atol=1e-12)
    np.testing.assert_allclose(b, wanted[1], atol=1e-8)
    found = verification.measured(g, b)
    for name in ("inclination", "azimuth"):
        turned = np.mod(found[name], 360)
        np.testing.assert_allclose(turned, np.degrees(OBSERVABLES[name].value(g, b)), atol=1e-8)


def test_verdicts_are_wrong_as_often_as_they_say(knocked):
    """Within three standard deviations of counting, of 100 tools."""
    for rule in verification.RULES:
        found = verification.rates(knocked, rule)
        for share, stated in (
            (found.passed, found.passed_stated),
            (found.failed, found.failed_stated),
        ):
            scatter = np.sqrt(max(stated * (1 - stated), 1 / COUNT) / COUNT)
            assert abs(share - stated) < 3 * scatter, (rule, share, stated)
    assert verification.rates(knocked, "guarded").passed < 0.023


def test_a_knock_has_the_size_that_was_drawn(knocked):
    """Evenly from 0.1 to 3 limits."""
    limits = {row.name: row.limit for row in knocked[0].rows}
    worst = [max(t.true[name] / limit for name, limit in limits.items()) for t in knocked]
    assert 1.3 < np.mean(worst) < 1.8
    assert 0.05 < np.min(worst) < 0.5
    assert 2.7 < np.max(worst) < 3.2


def test_the_rule_of_the_page_is_that_of_the_verdict(knocked):
    for one in knocked:
        assert [one.passes(row, "simple") for row in one.rows] == [row.passed for row in one.rows]


def test_good_tools_pass_the_simple_rule():
    good = verification.trials(np.random.default_rng(4), 20, verification.NOISES[0], False)
    assert all(one.verdict("simple") and one.verdict("guarded") for one in good)
