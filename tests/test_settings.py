"""Settings of the stand: which stations share one."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.stats import binom

from mwdcal.calibration.diagnosis.refusals import BAD_INPUT, reading_refusals
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options, is_assumed, settings_of, unshared
from mwdcal.calibration.readings import TRIADS, direction_numbers
from mwdcal.errors import InputError
from mwdcal.estimation.batch import batch_of_one
from mwdcal.estimation.resetting import _variance
from mwdcal.files.profiles import load_profile
from mwdcal.library.arrays import readings
from mwdcal.planning.planned import best_plan
from mwdcal.planning.plans import drawn, simulated
from mwdcal.planning.session import Session

SERVO = load_profile("servo")[0]


def run(inclination, azimuth, **more):
    vectors = np.ones((len(inclination), 3))
    return readings(vectors, inclination_deg=inclination, azimuth_deg=azimuth, **more)


NAN = np.nan
CASES = {
    "two directions": ([5, 5, 45, 45], [0, 0, 0, 0], {}, "aabb"),
    "azimuth alone changes": ([45, 45, 45], [0, 90, 90], {}, "abb"),
    "back to a direction": ([5, 45, 5], [0, 0, 0], {}, "abc"),
    "a full turn is none": ([5, 5, 5], [0, 360, -360], {}, "aaa"),
    "rounding": ([5, 5 + 1e-9], [0, 360 - 1e-9], {}, "aa"),
    "readbacks of an encoder": ([45.01, 44.97, 45.02, 45.5], [0, 359.98, 0.03, 0], {}, "aaab"),
    "a tenth of a degree": ([5, 5.1], [0, 0], {}, "ab"),
    "a ramp": ([5, 5.04, 5.08, 5.12, 5.12], [0] * 5, {}, "abcdd"),
    "readbacks of a group": ([5, 45, 5.01], [0] * 3, {"group": ["x", "x", "x"]}, "aba"),
    "no azimuth": ([5, 5, 45], [NAN] * 3, {}, "aab"),
    "no direction": ([NAN] * 3, [NAN] * 3, {}, "abc"),
    "a blank between": ([5, NAN, 5], [0, NAN, 0], {}, "abc"),
    "stated per direction": ([5, 5], [0, 0], {"settings": "per-direction"}, "aa"),
    "stated per station": ([5, 5], [0, 0], {"settings": "per-station"}, "ab"),
    "groups, apart": ([5, 45, 5, 45], [0, 0, 0, 0], {"group": ["x", "y", "x", "y"]}, "abab"),
    "a group is stronger than the profile": (
        [5, 5, 5],
        [0, 0, 0],
        {"group": ["x", "x", ""], "settings": "per-station"},
        "aab",
    ),
    "a group of two references": ([5, 6, 5], [0, 0, 0], {"group": ["x", "x", "x"]}, "aba"),
    "groups end a set": ([5, 5], [0, 0], {"group": ["x", "y"]}, "ab"),
}


@pytest.mark.parametrize(("inclination", "azimuth", "more", "names"), CASES.values(), ids=CASES)
def test_stations_of_one_setting(inclination, azimuth, more, names):
    number = settings_of(run(inclination, azimuth, **more))
    together = np.array([[a == b for a in names] for b in names])
    np.testing.assert_array_equal(number[:, None] == number, together)
    assert number.max() < len(names)


def test_runs_of_a_batch_have_patterns_of_their_own():
    vectors = np.ones((2, 3, 3))
    whole = readings(vectors, inclination_deg=np.array([[5, 5, 45], [5, 45, 45]]), azimuth_deg=0.0)
    number = settings_of(whole)
    assert (number[0] == number[0, 0]).tolist() == [True, True, False]
    assert (number[1] == number[1, 2]).tolist() == [False, True, True]


@pytest.mark.parametrize(
    ("more", "expected"),
    [({}, True), ({"settings": "per-direction"}, False), ({"group": ["x", "x"]}, False)],
)
def test_the_assumption_is_one_where_nobody_states_the_practice(more, expected):
    uncertain = {"inclination": np.full(2, 1e-3)}
    assert is_assumed(replace(run([5, 5], [0, 0], **more), sd=uncertain)) is expected
    assert not is_assumed(replace(run([5, 45], [0, 0], **more), sd=uncertain))


def test_nothing_is_assumed_of_an_exact_direction():
    assert not is_assumed(run([5, 5], [0, 0]))


def test_an_unknown_practice_is_refused():
    with pytest.raises(InputError, match="per-direction or per-station; got 'daily'"):
        run([5, 5], [0, 0], settings="daily")


@pytest.mark.parametrize("practice", ["per-direction", "per-station"])
def test_more_settings_than_memory_holds_are_refused_with_a_remedy(practice):
    directions, each = 1250, 8
    rng = np.random.default_rng(1)
    inclination, azimuth = rng.uniform([5, 0], [135, 360], (directions, 2)).repeat(each, 0).T
    long = run(inclination, azimuth, settings=practice)
    vectors = rng.normal(size=(len(inclination), 3))
    long = replace(long, accelerometer=vectors, sd={"inclination": np.array(1e-4)})
    whole = batch_of_one(long)
    refused = [f for f in reading_refusals(whole, Options(), lambda _: long) if f.members.any()]
    assert [f.id for f in refused] == [BAD_INPUT] * (practice == "per-direction")
    for flag in refused:
        assert "10000 stations share 1250 settings" in flag.sentence(0)
        assert 'settings = "per-station"' in flag.sentence(0)


def planned_runs(practice, runs, count=16, seed=0):
    """Runs of the best stations in the order of `plan`, on a stand of a practice that nobody states."""
    session = Session.of(best_plan(None, count, SERVO).plan, SERVO)
    rng = np.random.default_rng(seed)
    tools = drawn(rng, SERVO, 0, (runs,))
    made = simulated(tools, replace(session.readings, settings=practice), rng).readings
    return replace(made, settings="")


def test_scatter_within_settings_has_the_variance_of_the_whole_matrix_of_residuals():
    """2 tr(GG) with G = ZᵀPZ of all stations at once, P = W - WX(XᵀWX + prior)⁻¹XᵀW."""
    fitted = fit(planned_runs("per-direction", 3), Options(order=0))
    problem, state = fitted.problem, fitted.state
    linear = problem.linear(state)
    for run in range(3):
        stations = linear.weight.shape[1]
        whole = block_diag(*linear.weight[run])
        x = linear.design[run].reshape(whole.shape[0], -1)
        z = block_diag(*problem.resetting_columns(state)[run])
        wx = whole @ x
        p = whole - wx @ np.linalg.inv(x.T @ wx + linear.prior[run]) @ wx.T
        variance = 2 * np.sum((z.T @ p @ z) ** 2)
        assert z.shape == (6 * stations, 2 * stations)
        given = _variance(problem, state, fitted.analysis, np.zeros((3, 2)))[run]
        np.testing.assert_allclose(given, variance, rtol=1e-6)


def set_apart(practice, runs, declared=True):
    """How many runs of a practice have a share of their own."""
    made = planned_runs(practice, runs, count=24)
    sd = made.sd if declared else {n: each for n, each in made.sd.items() if n not in TRIADS}
    return int((fit(replace(made, sd=sd), Options(order=0)).problem.evidence.apart > 0).sum())


@pytest.mark.parametrize("declared", [True, False])
def test_one_sound_run_in_a_hundred_is_taken_as_set_apart(declared):
    """Of 500 runs, many of whose settings are pairs, 1 to 13 by the binomial distribution (99 %)."""
    low, high = binom.ppf([0.005, 0.995], 500, 0.01)
    assert low <= set_apart("per-direction", 500, declared) <= high


def test_most_runs_that_were_set_apart_are_taken_so():
    assert set_apart("per-station", 60) > 40


def test_directions_meet_across_north_and_at_any_size():
    """A second formula: angles of pairs, joined one by one; runs of a batch apart."""
    rng = np.random.default_rng(3)
    middle = np.radians([[45, 0], [45, 180], [45.5, 0], [90, 359.99], [90, 270]])
    truth = rng.integers(0, 5, (4, 60))
    lean, turn = np.moveaxis(
        middle[truth] + np.radians(rng.uniform(-0.03, 0.03, (4, 60, 2))), -1, 0
    )
    number = direction_numbers(lean, np.mod(turn, 2 * np.pi))
    assert number.min() >= 0
    for each, of in zip(number, truth, strict=True):
        np.testing.assert_array_equal(each[:, None] == each, of[:, None] == of)


@pytest.mark.parametrize(
    ("inclination", "practice", "count"),
    [
        ([45, 45.2, 45.05, 45.3], "per-direction", 3),
        ([45, 45.02, 45.01, 45.03], "per-direction", 0),
        ([45, 46, 47, 48], "per-direction", 0),
    ],
)
def test_stations_almost_of_one_direction_that_share_no_setting(inclination, practice, count):
    assert unshared(run(inclination, [0] * 4, settings=practice)) == count
