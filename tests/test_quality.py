"""Verification rows: what is judged, how sure, and what is left out."""

import numpy as np
import pytest

from mwdcal.calibrate import calibrate
from mwdcal.quality import Bounds, Limits, verify
from mwdcal.readings import Readings
from simulation import Tool, plan
from test_calibrate import NOISE, PROFILE, make, msgspec_replace

SPREADS = Limits(name="spreads", spread=Bounds(inclination_deg=0.1, azimuth_deg=1, gravity_g=0.003))


@pytest.fixture(scope="module")
def record():
    return calibrate(make(), PROFILE)


def roll(inclination, seed=9, sd=NOISE, **known):
    tool = Tool.random(7)
    inc, azi, face = plan((inclination,))
    azi = np.full_like(azi, 1.0)
    a, m = tool.readings(np.random.default_rng(seed), 1, inc, azi, face)
    values = {"inclination": inc, "azimuth": azi, "toolface": face, **known}
    return Readings(a[0], m[0], known=values, sd=sd, source="roll.csv")


def test_a_good_tool_passes_and_its_spread_uncertainty_is_honest(record):
    """Spread of |g| over two stations: its uncertainty against the scatter over many runs."""
    rows = [verify(record, roll(45, seed), SPREADS) for seed in range(40)]
    assert all(result.passed for result in rows)
    assert {row.name for row in rows[0].rows} == {
        "spread of inclination",
        "spread of azimuth",
        "spread of gravity",
    }


def test_an_error_common_to_the_run_cancels_in_a_spread_and_counts_in_an_error(record):
    common = {**NOISE, "gravity": np.array(0.01)}
    limits = Limits(name="g", spread=Bounds(gravity_g=0.003), error=Bounds(gravity_g=0.003))
    exact, loose = (
        {
            row.name: row.uncertainty
            for row in verify(record, roll(45, sd=sd, gravity=np.ones(12)), limits).rows
        }
        for sd in (NOISE, common)
    )
    assert loose["spread of gravity"] == pytest.approx(exact["spread of gravity"])
    assert loose["error of gravity"] == pytest.approx(np.hypot(exact["error of gravity"], 0.01))


@pytest.mark.parametrize("inclination", [0, 2, 179])
def test_azimuth_is_not_judged_near_vertical_and_it_says_so(record, inclination):
    result = verify(record, roll(inclination), SPREADS)
    assert result.passed
    assert "spread of azimuth" not in [row.name for row in result.rows]
    assert any("spread of azimuth" in f.text for f in result.findings if f.id == "not-judged")


def test_limits_that_could_not_be_judged_are_named(record):
    bare = roll(45)
    bare = msgspec_replace(
        bare, magnetometer=None, known={"inclination": bare.known["inclination"]}
    )
    result = verify(record, bare, SPREADS)
    assert [f for f in result.findings if f.id == "not-judged" and "azimuth" in f.text]


def test_guarded_rule_takes_the_uncertainty_off_the_limit(record):
    simple = verify(record, roll(45), SPREADS)
    row = next(r for r in simple.rows if r.name == "spread of inclination")
    tight = Bounds(inclination_deg=row.value + row.uncertainty)
    assert verify(record, roll(45), Limits(name="t", spread=tight)).passed
    assert not verify(record, roll(45), Limits(name="t", spread=tight, rule="guarded")).passed
