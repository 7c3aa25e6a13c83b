"""The particle swarm against least squares on the same cost, and Moradi's tables."""

import importlib.util
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from mwdcal.estimation.minimisers.swarm import (
    CONSTRICTION,
    swarm,
    swarm_forward,
    vector_cost,
)
from mwdcal.sensor.models import affine_parts
from simulation import attitude, plan

EXAMPLE = Path(__file__).parents[1] / "examples" / "papers" / "moradi.py"
SPEC = importlib.util.spec_from_file_location("moradi", EXAMPLE)
moradi = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(moradi)

SIX = moradi.STATES
NOISE = moradi.RESIDUAL / np.sqrt(3)


def references(triad, inclinations=(5, 45, 90, 135), toolfaces=3):
    """Unit gravity (0) or field (1) of a plan."""
    return attitude(*plan(inclinations, toolfaces))(1.0, 1.0, 1.1)[triad]


def simulated(seed, reference, offset, noise, lead=()):
    """Readings (*lead, n, 3) of a random triad whose offset has a given length."""
    rng = np.random.default_rng(seed)
    matrix = np.eye(3) * (1 + rng.uniform(-0.1, 0.1, (*lead, 1, 3)))
    matrix = matrix + rng.uniform(-0.02, 0.02, (*lead, 3, 3))
    bias = rng.normal(size=(*lead, 1, 3))
    bias *= offset / np.linalg.norm(bias, axis=-1, keepdims=True)
    clean = reference @ np.swapaxes(matrix, -1, -2) + bias
    return clean + noise * rng.normal(size=clean.shape)


def apart(one, other, raw, reference):
    """Largest difference of two sets of forward parameters: as parameters, and as fields."""
    fields = []
    for matrix, offset in map(affine_parts, (one, other)):
        back = np.swapaxes(np.linalg.inv(matrix), -1, -2)
        fields.append((raw - offset[..., None, :]) @ back)
    return max(np.abs(fields[0] - fields[1]).max(), np.abs(one - other).max())


MISSES = 6
CASES = {
    "six states": (SIX, 0.01, NOISE),
    "hard iron of five fields": (references(1), 5.0, 3e-4),
}


@pytest.mark.slow
@pytest.mark.parametrize("error", ["field", "reading"])
@pytest.mark.parametrize("case", CASES)
def test_swarm_and_least_squares_meet_for_every_seed(case, error):
    reference, offset, noise = CASES[case]
    worst = 0.0
    for seed in range(50):
        raw = simulated(seed, reference, offset, noise)
        found = moradi.swarmed(raw, reference, error, seed=seed)
        worst = max(
            worst,
            apart(found.position, moradi.least_squares(raw, reference, error), raw, reference),
        )
    print(case, error, worst)
    assert worst < 1e-8


@pytest.mark.parametrize("error", ["field", "reading"])
def test_stations_close_together_are_no_obstacle(error):
    reference = references(0, inclinations=(0, 10, 20, 30))
    raw = simulated(np.arange(12), reference, 0.01, 1e-4, lead=(12,))
    found = moradi.swarmed(raw, reference, error)
    solved = moradi.least_squares(raw, reference, error)
    offsets = [
        moradi.mean_square(raw, reference, error, params) for params in (found.position, solved)
    ]
    assert offsets[0] == pytest.approx(offsets[1], rel=1e-12)
    assert apart(found.position, solved, raw, reference) < 1e-8


def affine_miss(readings, reference, reach, seed):
    """Largest departure in field of a swarm in M and b of field = M · reading + b."""
    middle = np.concatenate([np.eye(3).ravel(), np.zeros(3)])

    def fields(params):
        matrix, offset = affine_parts(params)
        return readings @ np.swapaxes(matrix, -1, -2) + offset[..., None, :]

    def cost(params):
        return np.mean(np.sum((fields(params) - reference) ** 2, -1), -1)

    found = fields(swarm(cost, middle - reach, middle + reach, seed=seed).position)
    terms = np.concatenate([readings, np.ones((len(readings), 1))], -1)
    return np.abs(found - terms @ np.linalg.lstsq(terms, reference)[0]).max()


def test_in_matrix_and_offset_of_uncentred_readings_the_swarm_misses():
    """Hard iron of five fields, box that holds the truth; on centred readings it arrives."""
    reference = references(1)
    for seed in range(MISSES):
        raw = simulated(seed, reference, 5.0, 3e-4)
        assert affine_miss(raw, reference, np.repeat([0.5, 6.0], [9, 3]), seed) > 1e-5
        centred = raw - raw.mean(0)
        assert affine_miss(centred, reference, np.repeat([0.5, 1.0], [9, 3]), seed) < 1e-8


@pytest.mark.parametrize("error", ["field", "reading"])
def test_least_squares_is_the_minimum_of_its_cost(error):
    """Against an independent solver of the normal equations, and against its neighbours."""
    raw, rng = simulated(3, references(0), 0.01, 0.01), np.random.default_rng(0)
    reference, one = references(0), np.ones((len(raw), 1))
    solved = moradi.least_squares(raw, reference, error)
    known, target = (raw, reference) if error == "field" else (reference, raw)
    found = np.linalg.lstsq(np.concatenate([known, one], -1), target)[0]
    matrix, offset = found[:3].T, found[3]
    if error == "field":
        matrix, offset = np.linalg.inv(matrix), -np.linalg.solve(matrix, offset)
    assert solved == pytest.approx(np.concatenate([matrix.ravel(), offset]), abs=1e-12)
    cost = partial(moradi.mean_square, raw, reference, error)
    assert (cost(solved + 1e-4 * rng.normal(size=(200, 12))) > cost(solved)).all()


def test_costs_are_those_of_the_paper():
    raw, params = simulated(5, SIX, 0.01, NOISE), moradi.TABLE_2
    matrix, offset = params[:9].reshape(3, 3), params[9:]
    estimated = np.array([np.linalg.solve(matrix, v - offset) for v in raw])
    predicted = np.array([matrix @ a + offset for a in SIX])
    for error, misfit in (("field", estimated - SIX), ("reading", raw - predicted)):
        expected = np.mean(np.sum(misfit**2, -1))
        found = moradi.mean_square(raw, SIX, error, params)
        assert found == pytest.approx(expected, rel=1e-12)


def test_equations_12_and_13_are_different_estimators():
    """48 stations, Euclidean distance of the parameters: 6e-8 for 0.1 mg per axis; 8e-5 for a
    noise vector of 6.5 mg rms (3.75 mg per axis; 6.5 mg per axis would give 2.5e-4)."""
    reference = moradi.plan_48()
    assert moradi.apart(reference, 1e-4 * np.sqrt(3)) == pytest.approx(6e-8, rel=0.1)
    assert moradi.apart(reference, 6.5e-3) == pytest.approx(8e-5, rel=0.1)
    assert moradi.apart(reference, 6.5e-3 * np.sqrt(3)) == pytest.approx(2.5e-4, rel=0.1)
    gain = [
        np.linalg.det(affine_parts(moradi.least_squares(*noisy(), e))[0])
        for e in ("field", "reading")
    ]
    assert gain[0].mean() > gain[1].mean()  # M too small: S too large


def noisy():
    reference = moradi.plan_48()
    return simulated(np.arange(100), reference, 0.01, 0.01, lead=(100,)), reference


def test_same_seed_same_result_and_other_seed_another_path():
    raw = simulated(1, SIX, 0.01, NOISE)
    one, two, other = (swarm_forward(raw, SIX, iterations=60, seed=s) for s in (4, 4, 5))
    assert (one.position == two.position).all()
    assert (one.history == two.history).all()
    assert (one.history != other.history).any()


@pytest.mark.parametrize("lead", [(1,), (4,), (3, 1, 2)])
@pytest.mark.parametrize("error", ["field", "reading"])
def test_batch_is_each_tool_alone(lead, error):
    reference = references(1)
    raw = simulated(np.arange(7), reference, 2.0, 3e-4, lead=lead)
    batch = moradi.swarmed(raw, reference, error, seed=2)
    assert batch.position.shape == (*lead, 12)
    assert batch.cost.shape == lead
    assert batch.history.shape == (*lead, batch.iterations)
    for index in np.ndindex(*lead):
        alone = moradi.swarmed(raw[index], reference, error, seed=2)
        assert batch.position[index] == pytest.approx(alone.position, abs=1e-9)
        assert batch.cost[index] == pytest.approx(alone.cost, rel=1e-12)


def test_history_never_rises_and_ends_at_the_cost():
    raw = simulated(np.arange(3), SIX, 0.01, NOISE, lead=(3,))
    found = swarm_forward(raw, SIX)
    assert found.history.shape == (3, 600)
    assert (np.diff(found.history, axis=-1) <= 0).all()
    assert (found.history[..., -1] == found.cost).all()
    assert found.cost == pytest.approx(
        vector_cost(raw, SIX)(found.position[:, None])[:, 0], rel=1e-9
    )


def test_finds_the_lowest_of_many_minima():
    """Rastrigin's function, 11⁴ minima in the box."""

    def cost(x):
        return np.sum((x - 0.3) ** 2 + 10 * (1 - np.cos(2 * np.pi * (x - 0.3))), -1)

    found = [swarm(cost, np.full(4, -5.0), np.full(4, 5.0), seed=s) for s in range(20)]
    reached = [np.abs(f.position - 0.3).max() < 1e-7 for f in found]
    assert np.mean(reached) >= 0.9


def test_unchanged_best_cost_does_not_stop_it():
    calls = []

    def flat(x):
        calls.append(np.abs(x).max())
        return np.zeros(x.shape[:-1])

    found = swarm(flat, [-2.0, -2.0], [2.0, 2.0], iterations=300)
    assert len(calls) == 301
    assert found.iterations == 300
    assert max(calls) <= 2.0


def test_stays_inside_the_box_when_the_minimum_lies_outside():
    found = swarm(lambda x: np.sum((x - 3.0) ** 2, -1), np.zeros(3), np.array([1.0, 2.0, 4.0]))
    assert found.position == pytest.approx([1.0, 2.0, 3.0], abs=1e-6)


def test_cost_that_is_not_finite_never_wins():
    def cost(x):
        with np.errstate(invalid="ignore"):
            return np.sqrt(x[..., 0]) + np.sum(x**2, -1)

    found = swarm(cost, [-1.0, -1.0], [1.0, 1.0])
    assert 0 <= found.cost < 1e-5
    lost = swarm(lambda x: np.full(x.shape[:-1], np.nan), [-1.0], [1.0], iterations=3)
    assert lost.cost == np.inf


def test_constriction_is_the_published_one():
    assert pytest.approx(0.729844, abs=1e-6) == CONSTRICTION


def test_moradi_bias_of_table_3_is_that_of_table_2_with_the_sign_flipped():
    assert (moradi.TABLE_3[9:] == -moradi.TABLE_2[9:]).all()
    assert np.abs(moradi.TABLE_3[:9] - moradi.TABLE_2[:9]).max() < 1.01e-4


def test_moradi_table_4_follows_from_that_sign():
    errors = moradi.resized(moradi.noise(4000))
    for truth in (moradi.TABLE_2, moradi.TABLE_3):
        found = {name: v.mean(-1) for name, v in moradi.table_4(errors, truth).items()}
        assert found["none"] == pytest.approx([0.0371, 0.0357, 0.0109], abs=1e-4)
        assert found["bias sign flipped"] == pytest.approx([0.0184, 0.0181, 0.0035], abs=1e-4)
        assert found["as printed"] == pytest.approx([0.0065, 0.0061, 0.0024], abs=1e-4)
    for name, row in moradi.TABLE_4.items():
        low, high = np.quantile(moradi.table_4(errors)[name][0], [0.05, 0.95])
        assert low - 1e-9 < row[0] < high + 1e-9
    refit = list(moradi.refitted(4000).values())
    assert refit == pytest.approx([0.0371, 0.0182, 0.0036], abs=1e-4)


@pytest.mark.parametrize("error", ["field", "reading"])
def test_moradi_swarm_and_least_squares_meet(error):
    params, cost = moradi.meeting(error, 3)
    assert params < 1e-8
    assert cost < 1e-12


@pytest.mark.slow
def test_moradi_page_and_figure_are_written_from_figures():
    pytest.importorskip("matplotlib")
    text = moradi.page(draws=500, seeds=1)
    assert "{" not in text
    committed = EXAMPLE.parents[2] / "docs" / "evidence" / "papers" / "moradi.md"
    if committed.exists():
        headings = [line for line in text.splitlines() if line.startswith("#")]
        assert [x for x in committed.read_text("utf-8").splitlines() if x[:1] == "#"] == headings
    assert moradi.figure(200) == moradi.figure(200)
