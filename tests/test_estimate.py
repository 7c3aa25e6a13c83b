"""The estimator: ranks, free directions, start values, gauges, noise estimates, groups."""

from dataclasses import replace

import numpy as np
import pytest

from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.estimation.solvers import gauss_newton, stepped
from mwdcal.estimation.uncertainty import free_directions, marginal_rank, readjusted
from mwdcal.geometry.vectors import rotation
from mwdcal.sensor.models import stacked
from simulation import DEG, Tool, plan

NOISE = {"accelerometer": np.array(1e-4), "magnetometer": np.array(15.0)}


def readings(tool, stations, known, seed=0, count=1, group=None, sd=NOISE):
    inc, azi, face = stations
    a, m = tool.readings(np.random.default_rng(seed), count, inc, azi, face)
    values = {
        "inclination": inc, "azimuth": azi, "toolface": face,
        "field": np.full(len(inc), tool.field), "dip": np.full(len(inc), tool.dip),
    }  # fmt: skip
    return Readings(a, m, known={k: values[k] for k in known}, sd=sd, group=group)


def names(result):
    determined = result.analysis.determined
    free = free_directions(result.problem, result.state, determined)[0]
    return {(f.id, f.triads) for f in free}


EVERYTHING = ("inclination", "azimuth", "toolface", "field", "dip")
RANKS = [
    (EVERYTHING, 24, set()),
    (("inclination", "azimuth", "toolface"), 24, set()),
    (("inclination", "azimuth", "field", "dip"), 23, {("toolface-zero", (0, 1))}),
    (("inclination", "field"), 23, {("toolface-zero", (0, 1))}),
    (("toolface", "azimuth", "field"), 24, set()),
    (("field",), 21, {("rotation-x", (0, 1)), ("rotation-y", (0, 1)), ("toolface-zero", (0, 1))}),
]


@pytest.mark.parametrize(("known", "rank", "free"), RANKS)
@pytest.mark.parametrize("inclinations", [(0.5, 45, 90, 135), (0, 45, 90, 180)])
def test_rank_and_names_of_free_directions(known, rank, free, inclinations):
    result = fit(readings(Tool.random(3), plan(inclinations), known))
    assert result.status[0] == 0
    assert result.analysis.determined.rank[0] == rank
    assert names(result) == free


@pytest.mark.parametrize(
    ("known", "rank"), [(("inclination", "toolface"), 12), (("inclination",), 11), ((), 9)]
)
def test_rank_of_the_accelerometer_alone(known, rank):
    whole = readings(Tool.random(3), plan((0.5, 45, 90, 135)), known)
    alone = Readings(
        whole.accelerometer, known=whole.known, sd={"accelerometer": NOISE["accelerometer"]}
    )
    assert fit(alone).analysis.determined.rank[0] == rank


@pytest.mark.parametrize(
    ("inclinations", "rank"), [((0, 45, 90, 135), 11), ((30, 80, 130), 11), ((35, 100), 10)]
)
def test_roll_groups_of_unknown_direction(inclinations, rank):
    inc, azi, face = plan(inclinations)
    group = np.repeat(np.arange(len(inclinations)), 12)
    azi = np.repeat(azi[::12], 12)
    tool = Tool.random(4)
    result = fit(readings(tool, (inc, azi, face), ("field",), group=group, count=20))
    assert (result.status == 0).all()
    for where in result.problem.slices():
        np.testing.assert_array_equal(marginal_rank(result.analysis.determined, where), rank)


def test_roll_group_at_exactly_zero_always_converges():
    inc, azi, face = plan((0, 45, 90, 135))
    azi = np.repeat(azi[::12], 12)
    group = np.repeat(np.arange(4), 12)
    result = fit(readings(Tool.random(5), (inc, azi, face), ("field",), group=group, count=60))
    assert np.count_nonzero(result.status == 0) == 60
    assert (result.analysis.variance_factor < 1.6).all()


@pytest.mark.parametrize("iron", [0.0, 50_000.0, 250_000.0])
@pytest.mark.parametrize(
    "known",
    [
        EVERYTHING,
        EVERYTHING[:4],
        ("inclination", "azimuth", "field", "dip"),
        ("inclination", "field"),
        ("field",),
    ],
)
def test_no_start_leads_astray(known, iron):
    """Scales 10 % off, hard iron up to five times the field: residuals are noise in every case."""
    found = []
    for seed in range(10):
        tool = Tool.random(100 + seed, iron=iron)
        scale = 1 + np.random.default_rng(seed).uniform(-0.1, 0.1, (2, 1, 3))
        tool.matrix = tool.matrix * scale
        result = fit(readings(tool, plan(), known, seed=seed, count=10))
        assert (result.status == 0).all()
        found.append(result.analysis.variance_factor)
    np.testing.assert_allclose(np.mean(found), 1.0, atol=0.05)
    assert np.max(found) < 1.8


@pytest.mark.parametrize("kind", ["polynomial", "factors"])
def test_free_toolface_zero_is_set_by_convention_not_by_the_solver(kind):
    """The gain's polar factor has no rotation about the tool axis, whatever the model."""
    tool = Tool.random(6)
    result = fit(
        readings(tool, plan(), ("inclination", "azimuth", "field", "dip")), Options(model=kind)
    )
    model, where = result.problem.triads[0].model, result.problem.slices()[0]
    gain = model.slope(
        result.state.params[:, where], result.problem.triads[0].raw, result.problem.temperature
    )
    u, _, vt = np.linalg.svd(gain[0, 0])
    polar = u @ vt
    assert abs(polar[0, 1] - polar[1, 0]) < 1e-9
    # and the truth differs from it by nothing but that rotation
    true = np.linalg.inv(tool.matrix[0])
    left = gain[0, 0] @ np.linalg.inv(true)
    angle = np.arctan2(left[1, 0] - left[0, 1], left[0, 0] + left[1, 1])
    np.testing.assert_allclose(rotation(np.array([0, 0, -angle])) @ left, np.eye(3), atol=3e-4)


def test_models_agree_at_order_zero():
    data = readings(Tool.random(8), plan(), EVERYTHING)
    fields = []
    for kind in ("polynomial", "factors"):
        result = fit(data, Options(model=kind))
        triad, where = result.problem.triads[1], result.problem.slices()[1]
        fields.append(
            triad.model.fields(result.state.params[:, where], triad.raw, result.problem.temperature)
        )
    np.testing.assert_allclose(fields[0], fields[1], atol=1e-4)


def test_leading_axes_do_not_matter():
    tool = Tool.random(9)
    data = readings(tool, plan(), EVERYTHING, count=6)
    many = fit(
        Readings(
            data.accelerometer.reshape(2, 3, -1, 3),
            data.magnetometer.reshape(2, 3, -1, 3),
            known=data.known,
            sd=NOISE,
        )
    )
    for index in range(6):
        one = fit(
            Readings(
                data.accelerometer[index], data.magnetometer[index], known=data.known, sd=NOISE
            )
        )
        np.testing.assert_allclose(
            one.state.params[0], many.state.params[index], rtol=1e-9, atol=1e-9
        )


def test_one_bad_member_does_not_harm_the_others():
    data = readings(Tool.random(9), plan(), EVERYTHING, count=3)
    broken = data.accelerometer.copy()
    broken[1, 5, 0] = np.nan
    with np.errstate(invalid="ignore"):
        result = fit(Readings(broken, data.magnetometer, known=data.known, sd=NOISE))
    assert result.status.tolist() == [0, 2, 0]


@pytest.mark.slow
def test_estimated_noise_is_unbiased_and_intervals_cover():
    """REML of both triads, from groups alone; 95 % intervals of |g| at other attitudes by Student t."""
    inc, azi, face = plan((10, 50, 90, 135), 6)
    azi = np.repeat(azi[::6], 6)
    group = np.repeat(np.arange(4), 6)
    tool = Tool.random(10)
    result = fit(readings(tool, (inc, azi, face), ("field",), group=group, count=200, sd={}))
    assert (result.status == 0).all()
    freedom = result.analysis.freedom.mean(0)
    for index, true in enumerate(tool.noise):
        variance = np.mean((result.noise[:, index] / true) ** 2)
        assert variance == pytest.approx(1.0, abs=4 * np.sqrt(2 / freedom[index] / 200))


def test_derivative_of_the_residual_is_the_design():
    """Design, private and shared columns against differences of the residual, near vertical too."""
    inc, azi, face = plan((0.01, 60, 120), 4)
    group = np.repeat([0, -1, 1], 4)
    data = readings(Tool.random(11), (inc, np.repeat(azi[::4], 4), face), ("field",), group=group)
    result = fit(data)
    problem, state = result.problem, result.state
    linear = problem.linear(state)
    for index in range(linear.design.shape[-1]):
        step = np.zeros((1, linear.design.shape[-1]))
        scale = 1e-5 / np.abs(linear.design[..., index]).max()
        sides = []
        for sign in (1, -1):
            step[0, index] = sign * scale
            sides.append(problem.linear(moved_without_private(problem, state, step)).residual)
        got = (sides[0] - sides[1]) / (2 * scale)
        size = np.abs(linear.design[..., index]).max()
        np.testing.assert_allclose(got / size, linear.design[..., index] / size, atol=3e-4)


def moved_without_private(problem, state, step):
    linear = problem.linear(state)
    p, q = linear.size, len(problem.evidence.constants)
    attitude = problem._turn_groups(state, step[:, p + q :])
    return replace(
        state,
        params=state.params + step[:, :p],
        attitude=attitude,
        constants=state.constants + step[:, p : p + q],
    )


def test_reference_uncertainty_common_to_the_run_is_not_averaged_away():
    tool = Tool.random(12)
    inc, azi, face = plan()
    known = {"inclination": inc, "azimuth": azi, "toolface": face, "gravity": np.full(48, 1.0)}
    a, m = tool.readings(np.random.default_rng(0), 1, inc, azi, face)
    known |= {"field": np.full(48, tool.field), "dip": np.full(48, tool.dip)}
    sd = {**NOISE, "field": np.array(100.0)}
    result = fit(Readings(a[0], m[0], known=known, sd=sd))
    gain = result.analysis.covariance[0, 12, 12] ** 0.5 / np.abs(result.state.params[0, 12])
    assert gain == pytest.approx(100 / tool.field, rel=0.05)


def test_attitude_of_unknown_stations_is_found():
    tool = Tool.random(13)
    inc, azi, face = plan((20, 70, 110, 150))
    known = ("inclination", "azimuth", "field", "dip")
    result = fit(readings(tool, (inc, azi, face), known))
    found = np.arctan2(-result.state.attitude[0, :, 0, 2], -result.state.attitude[0, :, 1, 2])
    turned = np.angle(np.exp(1j * (found - face)))
    assert np.std(turned) < 0.05 * DEG


def test_a_group_of_one_is_no_group():
    data = readings(Tool.random(4), plan((5, 45, 90, 135)), ("inclination", "field"))
    lonely = fit(
        Readings(
            data.accelerometer, data.magnetometer, known=data.known, sd=NOISE, group=np.arange(48)
        )
    )
    free = fit(data)
    np.testing.assert_allclose(lonely.state.params, free.state.params, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("stand", [(0.05, 0.2, 0.1), (0.2, 0.5, 0.5)])
@pytest.mark.parametrize("inclinations", [(5, 45, 90, 135), (0, 45, 90, 180)])
def test_a_coarse_stand_of_known_uncertainty_always_settles(stand, inclinations):
    """Weights depend on the state: a step is judged under the weights it was made with."""
    tool = Tool.random(20)
    inc, azi, face = plan(inclinations)
    rng = np.random.default_rng(3)
    true = [
        x + s * DEG * rng.normal(size=(60, 48))
        for x, s in zip((inc, azi, face), stand, strict=True)
    ]
    pair = [
        c + s * rng.normal(size=(60, 48, 3))
        for c, s in zip(tool.clean(*true), tool.noise, strict=True)
    ]
    known = {"inclination": inc, "azimuth": azi, "toolface": face}
    known |= {"field": np.full(48, tool.field), "dip": np.full(48, tool.dip)}
    angles = dict(zip(("inclination", "azimuth", "toolface"), np.radians(stand), strict=True))
    for sd in ({**NOISE, **{k: np.array(v) for k, v in angles.items()}}, angles):
        result = fit(Readings(*pair, known=known, sd={k: np.asarray(v) for k, v in sd.items()}))
        assert (result.status == 0).all()
        # 0.5° of error is 5 % of the inclination of a station at 5°: what is second order shows
        np.testing.assert_allclose(result.analysis.variance_factor.mean(0), 1.0, atol=0.1)


def test_a_group_with_few_filled_cells_is_as_uncertain_as_they_are():
    """One filled inclination of σ = 0.2° in each roll set: the error is common to the set."""
    tool = Tool.random(21)
    inc, azi, face = plan()
    group, sigma = np.repeat(np.arange(4), 12), 0.2 * DEG
    azi = np.repeat(azi[::12], 12)
    rng = np.random.default_rng(4)
    error = np.repeat(sigma * rng.normal(size=(300, 4)), 12, axis=1)
    a, m = tool.readings(rng, 300, inc, azi, face)
    filled = np.where(np.arange(48) % 12 == 0, inc + error, np.nan)
    known = {"inclination": filled, "toolface": face, "field": np.full(48, tool.field)}
    sd = {**NOISE, "inclination": np.array(sigma)}
    result = fit(Readings(a, m, known=known, sd=sd, group=group))
    assert (result.status == 0).all()
    model, where = result.problem.triads[0].model, result.problem.slices()[0]
    finished, whole = model.finished(0.0)
    params = np.einsum("bij,bj->bi", whole, result.state.params[:, where])
    spread = whole @ result.analysis.covariance[:, where, where] @ np.swapaxes(whole, -1, -2)
    true = np.linalg.inv(tool.matrix[0])
    row = true[2, :2]
    z = (params[:, 6:8] - row) / np.sqrt(np.diagonal(spread, axis1=1, axis2=2))[:, 6:8]
    assert 0.8 < np.sqrt(np.mean(z**2)) < 1.2
    assert finished.size == 12


WAYS = [(known, {}) for known, _, _ in RANKS] + [
    (("field",), {"group": np.repeat(np.arange(4), 12)}),
    (("field",), {"sd": {}}),
]


@pytest.mark.parametrize(("known", "others"), WAYS)
def test_a_fit_ends_where_further_steps_move_nothing(known, others):
    """A fit foretells that its next step would be nothing: here three more are taken."""
    inc, azi, face = plan((0.5, 45, 90, 135))
    azi = np.repeat(azi[::12], 12) if "group" in others else azi
    result = fit(readings(Tool.random(3), (inc, azi, face), known, **others))
    state, determined = result.state, result.analysis.determined
    for _ in range(3):
        state = stepped(result.problem, state, determined)
    sd = np.sqrt(np.diagonal(result.analysis.covariance, axis1=1, axis2=2))
    assert (result.status == 0).all()
    assert np.abs((state.params - result.state.params) / sd).max() < 1e-6


@pytest.mark.parametrize("away", [1e-1, 1e-4])
def test_a_fit_that_starts_near_its_end_goes_all_the_way(away):
    """No first step, however short, foretells the next."""
    result = fit(readings(Tool.random(3), plan((0.5, 45, 90, 135)), ("inclination", "field")))
    sd = np.sqrt(np.diagonal(result.analysis.covariance, axis1=1, axis2=2))
    start = replace(result.state, params=result.state.params + away * sd)
    state, status, iterations = gauss_newton(result.problem, start)
    left = (state.params - result.state.params)[0]
    [information] = result.problem.linear(result.state).normal.reduced[0]
    assert status == 0
    assert iterations >= 2
    # by the information: the difference of the costs is rounding; the first fit stops at 3e-8 σ
    assert left @ information @ left < 1e-10 * away**2 + 1e-15


@pytest.mark.parametrize("options", [Options(), Options(nonlinearity={"magnetometer": 0.005})])
def test_both_triads_in_one_call_are_those_one_by_one(options):
    result = fit(readings(Tool.random(4), plan(), ("field", "inclination"), count=2), options)
    problem, apart = result.problem, replace(result.problem)
    assert (problem.alike is None) == bool(options.nonlinearity != "auto")
    vars(apart)["alike"] = None
    for one, other in zip(
        problem.predictions(result.state), apart.predictions(result.state), strict=True
    ):
        for name, values in vars(one).items():
            np.testing.assert_allclose(values, vars(other)[name], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    "options", [Options(model="factors"), Options(order=(0, 1)), Options(parameters=9)]
)
def test_models_of_two_kinds_are_not_stacked(options):
    run = replace(readings(Tool.random(4), plan(), EVERYTHING), temperature=20 + np.arange(48.0))
    assert stacked([triad.model for triad in fit(run, options).problem.triads]) is None


def test_stations_are_readjusted_only_where_that_moves_them():
    """At the minimum nothing moves; errors of known angles come back, to second order, where a state has none."""
    free = fit(readings(Tool.random(5), plan(), ("field",)))
    assert readjusted(free.problem, free.state) is free.state
    sd = {**NOISE, "inclination": np.full(48, 1e-3), "azimuth": np.full(48, 1e-3)}
    known = fit(readings(Tool.random(5), plan(), EVERYTHING, sd=sd))
    blank = replace(known.state, errors=np.zeros_like(known.state.errors))
    errors = readjusted(known.problem, blank).errors
    size = np.abs(known.state.errors).max()
    assert size > 1e-4
    np.testing.assert_allclose(errors, known.state.errors, atol=4 * size**2)
