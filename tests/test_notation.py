"""Notations of temperature-dependent calibrations, against the definitions and a second formula."""

from functools import partial

import msgspec
import numpy as np
import pytest

from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration
from mwdcal.errors import InputError
from mwdcal.use.notation import COURSE, convert, powers

TRIADS = ("accelerometer", "magnetometer")
AXES = {
    "straight": (("+x", "+y", "+z"), ("+x", "+y", "+z")),
    "turned": (("+z", "-x", "-y"), ("+y", "+z", "+x")),
    "left-handed": (("+y", "+x", "+z"), ("-x", "-y", "-z")),
    "flipped and permuted": (("-z", "-y", "+x"), ("+z", "-y", "+x")),
}
SCALES = (3.0, 5e-5)
STRENGTHS = (1.0, 50_000.0)
REFERENCE = 20.0
RANGE = (0.0, 80.0)
HALF = 40.0
ORDERS = [(0, 0), (1, 1), (2, 1), (0, 3), (3, 3)]
TEMPERATURES = np.linspace(-20.0, 120.0, 57)


def signed(axes):
    """P with field = P · channels for a perfect tool."""
    matrix = np.zeros((3, 3))
    for channel, (sign, axis) in enumerate(axes):
        matrix["xyz".index(axis), channel] = 1 if sign == "+" else -1
    return matrix


def drawn(rng, model, order, strength):
    """Parameters of a plausible triad: gains within 5 %, offsets of 1 %, course of 5 % over the range."""
    course = 0.05 / HALF ** np.arange(order + 1)
    if model == "polynomial":
        gain = rng.uniform(-1, 1, (order + 1, 9)) * course[:, None]
        gain[0] += np.eye(3).ravel()
        offset = rng.uniform(-1, 1, (order + 1, 3)) * 0.2 * strength * course[:, None]
        return np.concatenate([gain, offset], -1).ravel()
    scale, bias = rng.uniform(-1, 1, (2, 3, order + 1)) * course
    scale[:, 0] += 1
    return np.concatenate([scale.ravel(), (0.2 * strength * bias).ravel(), rng.normal(0, 5e-3, 6)])


def triad(name, model, order, params, fitted):
    values = [float(p) for p in params]
    return {
        "name": name, "unit": "g", "model": model, "order": order, "curved": False,
        "centre": [0.0] * 3, "radius": 1.0, "parameter_names": ["-"] * len(values),
        "parameters": values, "standard_uncertainties": [None] * len(values), "rank": fitted,
        "size": fitted, "singular_values": [], "undetermined": [], "noise": 1e-4,
        "noise_source": "declared", "variance_factor": 1.0, "degrees_of_freedom": 9.0,
    }  # fmt: skip


def made(model, orders=(2, 1), axes="left-handed", *, seed=1, free=None, left_out=0):
    """A calibration of drawn parameters with a full covariance of both triads."""
    rng = np.random.default_rng(seed)
    params = [drawn(rng, model, n, s) for n, s in zip(orders, STRENGTHS, strict=True)]
    root = np.concatenate([1e-4 * (np.abs(p) + np.abs(p).max() * 1e-3) for p in params])
    root = root[:, None] * rng.normal(size=(len(root), len(root)))
    rows = zip(TRIADS, orders, params, strict=True)
    record = {name: triad(name, model, n, p, len(p) - left_out) for name, n, p in rows}
    pairs = zip(TRIADS, AXES[axes], SCALES, strict=True)
    profile = {name: {"axes": own, "scale": scale} for name, own, scale in pairs}
    record |= {
        "tool": {}, "profile_sha256": "", "run": "", "run_sha256": "", "software": "",
        "method": "joint", "time": "2026-01-02", "field_unit": "nT", "stations": 1, "singular_values": [],
        "temperature_c": RANGE, "covariance": (root @ root.T).tolist(), "constants": [],
        "profile": {"name": "own", "reference_temperature_c": REFERENCE, **profile},
        "free": [] if free is None else [free(params).tolist()],
        "earth": {"gravity_g": 1.0, "field": STRENGTHS[1], "dip_deg": 60.0}, "errors": [],
        "measures": [], "station_rows": [], "findings": [],
    }  # fmt: skip
    return msgspec.convert(record, Calibration)


def readings(calibration, axes, temperature, seed=2):
    """Raw channels, and the fields that the calibration itself gives at temperatures (n,)."""
    rng, raw, nominal = np.random.default_rng(seed), [], []
    for own, scale, strength in zip(AXES[axes], SCALES, STRENGTHS, strict=True):
        raw.append(rng.uniform(-1, 1, (len(temperature), 3)) * strength * scale)
        nominal.append(raw[-1] @ signed(own).T / scale)
    return raw, calibration.fields(Readings(*nominal, temperature=temperature))


def at(coefficients, temperature):
    """Σ c_k τ^k with the powers first."""
    return np.polynomial.polynomial.polyval(temperature - REFERENCE, coefficients)


def close(found, expected, tolerance=1e-12):
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * np.abs(expected).max())


def mixed(misalignment):
    return np.eye(3) - misalignment


@pytest.mark.parametrize("orders", ORDERS, ids=str)
@pytest.mark.parametrize("axes", AXES)
def test_the_forward_course_of_factors_gives_back_the_reading(axes, orders):
    calibration = made("factors", orders, axes)
    raw, fields = readings(calibration, axes, TEMPERATURES)
    for name, order, v, f in zip(TRIADS, orders, raw, fields, strict=True):
        values = convert(calibration, "forward", COURSE)[name].values
        assert values["S"].shape == (order + 1, 3, 3)
        assert values["o"].shape == (2 * order + 1, 3)
        matrix, offset = (at(values[n], TEMPERATURES) for n in "So")
        close(np.einsum("ijn,nj->ni", matrix, f) + offset.T, v)


@pytest.mark.parametrize("orders", ORDERS, ids=str)
@pytest.mark.parametrize("axes", AXES)
def test_the_affine_course_of_a_polynomial_gives_the_field(axes, orders):
    calibration = made("polynomial", orders, axes)
    raw, fields = readings(calibration, axes, TEMPERATURES)
    for name, order, v, f in zip(TRIADS, orders, raw, fields, strict=True):
        values = convert(calibration, "affine", COURSE)[name].values
        assert values["M"].shape == (order + 1, 3, 3)
        assert values["b"].shape == (order + 1, 3)
        matrix, offset = (at(values[n], TEMPERATURES) for n in "Mb")
        close(np.einsum("ijn,nj->ni", matrix, v) + offset.T, f)


@pytest.mark.parametrize("temperature", [None, 55.0, COURSE])
@pytest.mark.parametrize("axes", AXES)
def test_factors_of_the_channels_give_the_field_by_their_definition(axes, temperature):
    calibration = made("factors", (3, 2), axes)
    raw, fields = readings(calibration, axes, TEMPERATURES)
    found = convert(calibration, "factors", temperature)
    for name, own, v, f in zip(TRIADS, AXES[axes], raw, fields, strict=True):
        values = found[name].values
        unit = v / at(values["SF"].T, TEMPERATURES).T - at(values["B"].T, TEMPERATURES).T
        close(unit @ mixed(values["m"]).T @ signed(own).T, f)


@pytest.mark.parametrize("temperature", [-10.0, REFERENCE, 75.0])
@pytest.mark.parametrize("axes", AXES)
def test_round_trip_at_one_temperature_by_the_definitions(axes, temperature):
    """Factors, forward, affine and factors again, each step by the formulas of docs/theory."""
    calibration = made("factors", (3, 2), axes)
    found = {n: convert(calibration, n, temperature) for n in ("factors", "forward", "affine")}
    course = convert(calibration, "forward", COURSE)
    for name, own in zip(TRIADS, AXES[axes], strict=True):
        factors, forward, affine = (item[name].values for item in found.values())
        turn, mixing = signed(own), mixed(factors["m"])
        scale, bias = (at(factors[n].T, temperature) for n in ("SF", "B"))
        close(forward["S"], np.diag(scale) @ np.linalg.solve(mixing, turn.T))
        close(forward["o"], scale * bias)
        for key in "So":
            close(at(course[name].values[key], temperature), forward[key])
        close(affine["M"], np.linalg.inv(forward["S"]))
        close(affine["b"], -np.linalg.solve(forward["S"], forward["o"]))
        channels = turn.T @ affine["M"]
        close(1 / np.diag(channels), scale)
        again = np.where(np.eye(3) == 1, 0.0, -channels / np.diag(channels))
        close(again, factors["m"], 1e-12 / np.abs(factors["m"]).max())
        close(-np.linalg.solve(mixed(again), turn.T @ affine["b"]), bias)


@pytest.mark.parametrize("model", ["factors", "polynomial"])
@pytest.mark.parametrize("notation", ["factors", "forward", "affine"])
@pytest.mark.parametrize("axes", AXES)
def test_without_temperature_terms_everything_is_a_course(axes, notation, model):
    calibration = made(model, (0, 0), axes)
    for name, item in convert(calibration, notation).items():
        course = convert(calibration, notation, COURSE)[name]
        for key, value in item.values.items():
            lead = value if notation == "factors" else value[None]
            close(course.values[key], lead, 1e-15 / max(np.abs(lead).max(), 1e-300))
            assert course.uncertainty[key].shape == lead.shape
        close(course.covariance, item.covariance, 1e-9)


def theory(params, model, order, turn, scale, tau):
    """Matrix and offset of field = matrix · raw + offset at τ, from stored parameters."""
    course = tau ** np.arange(order + 1)
    if model == "polynomial":
        terms = course @ params.reshape(order + 1, 12)
        matrix, offset = terms[:9].reshape(3, 3), terms[9:]
    else:
        gain, bias = params[:-6].reshape(2, 3, order + 1) @ course
        mixing = np.eye(3)
        mixing[~np.eye(3, dtype=bool)] = -params[-6:]
        matrix, offset = mixing @ np.diag(1 / gain), -mixing @ bias
    return matrix @ turn / scale, offset


def fitted(params, model, order, turn, scale):
    """Course of the notation a model has, from its values at Chebyshev nodes: flat, powers slowest."""
    degrees = (order, 2 * order if model == "factors" else order)
    found = []
    for place, degree in enumerate(degrees):
        nodes = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
        values = []
        for node in nodes:
            matrix, offset = theory(params, model, order, turn, scale, HALF * node)
            if model == "factors":
                matrix = np.linalg.inv(matrix)
                offset = -matrix @ offset
            values.append((matrix, offset)[place].ravel())
        course = np.linalg.solve(np.vander(nodes, increasing=True), np.array(values))
        found.append((course / HALF ** np.arange(degree + 1)[:, None]).ravel())
    return np.concatenate(found)


CASES = {"factors": "forward", "polynomial": "affine"}


def second(calibration, axes, model):
    """Per triad what the course is by interpolation, as a function of the parameters."""
    for item, own, scale in zip(calibration.triads, AXES[axes], SCALES, strict=True):
        fixed = {"model": model, "order": item.order, "turn": signed(own), "scale": scale}
        yield item, partial(fitted, **fixed)


def covariances(calibration):
    """Covariance of each triad's own parameters."""
    whole, count = calibration.parameter_covariance, len(calibration.accelerometer.parameters)
    return whole[:count, :count], whole[count:, count:]


def slopes(course, params):
    """Central differences of a course: error of the order of the squared step, 1e-8."""
    step = np.maximum(np.abs(params), 1e-3 * np.abs(params).max()) * 1e-4
    columns = [
        (course(params + one * h) - course(params - one * h)) / (2 * h)
        for one, h in zip(np.eye(len(params)), step, strict=True)
    ]
    return np.stack(columns, -1)


@pytest.mark.parametrize("model", CASES)
@pytest.mark.parametrize("orders", ORDERS, ids=str)
@pytest.mark.parametrize("axes", AXES)
def test_course_and_covariance_are_those_of_interpolation(axes, orders, model):
    """Entry by entry, in units of its own standard uncertainty; left-out parameters change nothing."""
    calibration = made(model, orders, axes, left_out=3)
    found = convert(calibration, CASES[model], COURSE)
    rows = zip(second(calibration, axes, model), covariances(calibration), strict=True)
    for (item, course), covariance in rows:
        params, result = np.array(item.parameters), found[item.name]
        jacobian = slopes(course, params)
        expected = jacobian @ covariance @ jacobian.T
        sd = np.sqrt(np.diag(expected))
        values = np.concatenate([v.ravel() for v in result.values.values()])
        np.testing.assert_array_less(np.abs(values - course(params)), 1e-6 * sd)
        stated = np.concatenate([u.ravel() for u in result.uncertainty.values()])
        np.testing.assert_allclose(stated, sd, rtol=1e-5)
        difference = (result.covariance - expected) / np.outer(sd, sd)
        assert np.abs(difference).max() < 1e-5


def test_the_course_covariance_is_that_of_drawn_parameters():
    """4000 draws: a standard deviation is known to 1.1 %, a correlation to 0.016."""
    axes, rng = "flipped and permuted", np.random.default_rng(7)
    calibration = made("factors", (2, 1), axes)
    found = convert(calibration, "forward", COURSE)
    rows = zip(second(calibration, axes, "factors"), covariances(calibration), strict=True)
    for (item, course), covariance in rows:
        size = np.sqrt(np.diag(covariance))
        draws = rng.multivariate_normal(0 * size, covariance / np.outer(size, size), 4000)
        values = np.array([course(p) for p in np.array(item.parameters) + draws * size])
        claimed = found[item.name].covariance
        sd = np.sqrt(np.diag(claimed))
        np.testing.assert_allclose(values.std(0, ddof=1), sd, rtol=0.06)
        correlation = claimed / np.outer(sd, sd)
        np.testing.assert_allclose(np.corrcoef(values.T), correlation, atol=0.08)


def turn_about_z(params, power):
    """Free turn about the tool axis in proportion to (τ / half range)^power, of order-2 polynomials."""
    terms = params[0].reshape(3, 12)
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    moved = np.zeros_like(terms)
    moved[power, :9] = (turn @ terms[0, :9].reshape(3, 3)).ravel() / HALF**power
    return np.concatenate([moved.ravel(), 0 * params[1]])


@pytest.mark.parametrize("power", [0, 1, 2])
def test_a_free_turn_blanks_the_power_it_moves_and_no_other(power):
    calibration = made("polynomial", (2, 1), "straight", free=lambda p: turn_about_z(p, power))
    blank = np.isnan(convert(calibration, "affine", COURSE)["accelerometer"].uncertainty["M"])
    expected = np.zeros((3, 3, 3), bool)
    expected[power, [0, 1], [1, 0]] = True
    assert (blank == expected).all()
    other = convert(calibration, "affine", COURSE)["magnetometer"]
    assert all(np.isfinite(u).all() for u in other.uncertainty.values())


@pytest.mark.parametrize("power", [0, 1, 2])
def test_a_free_scale_blanks_the_gains_of_the_power_it_moves(power):
    """The fields stretched in proportion to a power of τ: SF falls, B grows, o stays as it is."""

    def stretch(params):
        scale, bias = params[0][:-6].reshape(2, 3, 3)
        moved = np.zeros((2, 3, 3))
        moved[0, :, power] = -scale[:, 0] / HALF**power
        moved[1, :, power] = bias[:, 0] / HALF**power
        return np.concatenate([moved.ravel(), np.zeros(6), 0 * params[1]])

    calibration = made("factors", (2, 1), "straight", free=stretch)
    found = convert(calibration, "forward", COURSE)["accelerometer"]
    expected = np.zeros((3, 3, 3), bool)
    expected[power] = np.eye(3, dtype=bool)
    assert (np.isnan(found.uncertainty["S"]) == expected).all()
    assert np.isfinite(found.uncertainty["o"]).all()
    factors = convert(calibration, "factors")["accelerometer"]
    assert (np.isnan(factors.uncertainty["SF"]) == (np.arange(3) == power)).all()


@pytest.mark.parametrize(
    ("model", "notation", "temperature", "remedies"),
    [
        ("polynomial", "forward", COURSE, ("affine", "`model` factors", "°C")),
        ("factors", "affine", COURSE, ("forward", "`model` polynomial", "°C")),
        ("polynomial", "factors", COURSE, ("affine", "`model` factors")),
        ("polynomial", "factors", None, ("affine", "`model` factors")),
    ],
)
def test_what_no_polynomial_can_carry_is_refused_with_a_remedy(
    model, notation, temperature, remedies
):
    for orders, name in (((2, 1), "accelerometer"), ((0, 1), "magnetometer")):
        with pytest.raises(InputError, match=name) as caught:
            convert(made(model, orders), notation, temperature)
        for word in remedies:
            assert word in str(caught.value)


def test_a_word_that_is_no_temperature_is_refused():
    with pytest.raises(InputError, match=r"'course'.*got 'warm'"):
        convert(made("factors"), "forward", "warm")


def test_powers_name_the_power_of_each_value():
    calibration = made("factors", (2, 1))
    course = convert(calibration, "forward", COURSE)["accelerometer"].values
    assert powers("S", course["S"])[:, 1, 2].tolist() == [0, 1, 2]
    assert powers("o", course["o"])[:, 2].tolist() == [0, 1, 2, 3, 4]
    steady = convert(calibration, "forward")["accelerometer"].values
    assert not powers("S", steady["S"]).any()
    factors = convert(calibration, "factors")["accelerometer"].values
    assert powers("B", factors["B"])[1].tolist() == [0, 1, 2]
    assert not powers("m", factors["m"]).any()
