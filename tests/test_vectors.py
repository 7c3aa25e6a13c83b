"""Frame, attitudes and rotations: laws over batch shapes and singular attitudes."""

import numpy as np
import pytest

from mwdcal.geometry import observables as ob
from mwdcal.geometry.circle import means, unrolled
from mwdcal.geometry.vectors import (
    are_positive,
    centred,
    dot,
    inverse,
    inverse_of_positive,
    inverse_of_three,
    length,
    nearest_rotation,
    quadratic_form,
    reference_vectors,
    rotation,
    skew,
    solved,
    square_root,
    tool_from_earth,
    wrap,
)

SHAPES = [(), (1,), (3, 1, 2)]
DEG = np.pi / 180

# Published with the frame: G = 9.80665 m/s², B = 50 000 nT, (I, A, T, dip) in degrees.
FORWARD = [
    ((10, 45, 30, 60), (-0.851453, -1.474761, 9.657665), (20254.2706, -273.9134, 45713.1217)),
    ((45, 120, 200, 72), (2.371687, 6.516156, 6.934349), (794.8897, 41306.8665, 28162.2253)),
    ((3, 10, 350, -65), (0.089123, -0.505443, 9.793210), (-406.8759, 23438.4211, -44164.1808)),
]


@pytest.mark.parametrize(("angles", "g", "b"), FORWARD)
def test_forward_values_to_the_printed_digits(angles, g, b):
    inc, azi, tool, dip = np.radians(angles)
    got_g, got_b = reference_vectors(inc, azi, tool, 9.80665, 50_000.0, dip)
    np.testing.assert_allclose(got_g, g, rtol=0, atol=0.5000001e-6)
    np.testing.assert_allclose(got_b, b, rtol=0, atol=0.5000001e-4)


def test_without_strengths_both_vectors_are_of_length_one_and_the_field_is_horizontal():
    g, b = reference_vectors(0.7, 1.2, 0.3)
    assert np.hypot.reduce(g) == pytest.approx(1.0, rel=1e-12)
    assert np.hypot.reduce(b) == pytest.approx(1.0, rel=1e-12)
    assert g @ b == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("shape", SHAPES)
def test_round_trip_of_angles(shape):
    rng = np.random.default_rng(1)
    inc = rng.uniform(1e-3, np.pi - 1e-3, shape)
    azi, tool = rng.uniform(0, 2 * np.pi, (2, *shape))
    dip = rng.uniform(-1.4, 1.4, shape)
    g, b = reference_vectors(inc, azi, tool, 0.998, 47_000.0, dip)
    assert g.shape == (*shape, 3)
    np.testing.assert_allclose(ob.inclination(g, b), inc, atol=1e-14)
    near = rng.uniform(1, 2) * 1e-15 / np.sin(inc) * 1e2
    assert (np.abs(centred(ob.azimuth(g, b) - azi)) < 1e-13 + near / np.cos(dip)).all()
    assert (np.abs(centred(ob.toolface(g, b) - tool)) < 1e-13 + near).all()
    np.testing.assert_allclose(ob.dip(g, b), dip, atol=1e-14)
    np.testing.assert_allclose(ob.gravity(g, b), 0.998, rtol=1e-14)
    np.testing.assert_allclose(ob.field(g, b), 47_000.0, rtol=1e-14)


@pytest.mark.parametrize("inclination", [0.0, np.pi])
def test_exactly_vertical_has_no_azimuth_and_no_toolface(inclination):
    g, b = reference_vectors(inclination, 1.0, 0.5, 1.0, 50_000.0, 1.1)
    g[..., :2] = 0.0
    assert np.isnan(ob.azimuth(g, b))
    assert np.isnan(ob.toolface(g, b))
    assert ob.inclination(g, b) == inclination
    turn = 1.5 if inclination == 0 else np.pi + 1.0 - 0.5
    expected = wrap(turn) if inclination == 0 else wrap(np.arctan2(b[0], b[1]))
    np.testing.assert_allclose(ob.magnetic_toolface(g, b), expected, atol=1e-12)
    assert np.isfinite(ob.OBSERVABLES["inclination"].gradient(g, b)).all()
    assert np.isnan(ob.OBSERVABLES["azimuth"].gradient(g, b)).any()


def test_dip_is_exact_at_the_poles():
    g = np.array([0.0, 0.0, 1.0])
    b = np.array([1e-9, 0.0, 1.0])
    assert np.pi / 2 - ob.dip(g, b) == pytest.approx(1e-9, rel=1e-6)


@pytest.mark.parametrize("shape", SHAPES)
def test_rotation_matrices(shape):
    turn = np.random.default_rng(2).normal(size=(*shape, 3))
    matrix = rotation(turn)
    np.testing.assert_allclose(
        matrix @ np.swapaxes(matrix, -1, -2), np.broadcast_to(np.eye(3), (*shape, 3, 3)), atol=1e-14
    )
    np.testing.assert_allclose(np.einsum("...ij,...j->...i", matrix, turn), turn, atol=1e-14)
    np.testing.assert_allclose(rotation(np.zeros(3)), np.eye(3))
    # against the series of the exponential, a second formula
    cross, term, total = skew(turn), np.eye(3), np.eye(3)
    for k in range(1, 40):
        term = term @ cross / k
        total = total + term
    np.testing.assert_allclose(matrix, total, atol=1e-12)


@pytest.mark.parametrize("shape", SHAPES)
def test_nearest_rotation_is_proper_and_leaves_a_symmetric_stretch(shape):
    rng = np.random.default_rng(3)
    turn = rotation(rng.normal(size=(*shape, 3)))
    stretch = np.diag([1.2, 0.9, 0.5])
    np.testing.assert_allclose(nearest_rotation(turn @ stretch), turn, atol=1e-12)
    mirrored = nearest_rotation(turn @ np.diag([1.2, 0.9, -0.5]))  # nearest: the least gain flips
    np.testing.assert_allclose(mirrored, turn, atol=1e-12)


def test_attitude_is_a_proper_rotation():
    inc, azi, tool = np.random.default_rng(3).uniform(0, 6, (3, 50))
    matrix = tool_from_earth(inc, azi, tool)
    np.testing.assert_allclose(np.linalg.det(matrix), 1.0)
    np.testing.assert_allclose(
        matrix @ np.swapaxes(matrix, -1, -2), np.broadcast_to(np.eye(3), (50, 3, 3)), atol=1e-14
    )


@pytest.mark.filterwarnings("error")
def test_a_matrix_without_inverse_is_nan_and_spoils_no_other():
    good = np.array([[2.0, 1.0], [1.0, 3.0]])
    bad = [np.zeros((2, 2)), np.full((2, 2), np.inf), np.array([[np.nan, 1.0], [1.0, 0.0]])]
    stack, right = np.array([good, *bad]), np.ones((4, 2, 1))
    for found in (inverse(stack) @ right, solved(stack, right)):
        np.testing.assert_allclose(found[0, :, 0], [0.4, 0.2], rtol=1e-15)
        assert np.isnan(found[1:]).any((1, 2)).all()


def test_the_root_of_a_covariance_keeps_small_quantities_beside_large_ones():
    """Standard deviations over sixteen decades: g per °C beside nT, or informations about them."""
    rng = np.random.default_rng(5)
    mixed, sd = rng.normal(size=(12, 12)), 10.0 ** np.linspace(-8, 8, 12)
    covariance = mixed @ mixed.T * sd[:, None] * sd
    root = square_root(covariance)
    np.testing.assert_allclose((root @ root.T) / sd / sd[:, None], mixed @ mixed.T, atol=1e-12)


def test_the_root_of_a_covariance_has_no_column_for_what_does_not_vary():
    root = square_root(np.diag([4.0, 0.0, 9.0]))
    assert root.shape == (3, 2)
    np.testing.assert_allclose(root @ root.T, np.diag([4.0, 0.0, 9.0]), atol=1e-14)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("size", [3, 9, 10, 30, 57])
def test_inverses_of_symmetric_matrices_give_one(shape, size):
    rows = np.random.default_rng(size).standard_normal((*shape, size, 2 * size))
    matrix = rows @ rows.mT
    ways = [inverse_of_positive] + [inverse_of_three] * (size == 3)
    for way in ways:
        back = way(matrix)
        np.testing.assert_allclose(
            back @ matrix, np.broadcast_to(np.eye(size), matrix.shape), atol=1e-10
        )
        np.testing.assert_allclose(back, back.mT, atol=1e-12 * np.abs(back).max())


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("size", [1, 3, 6])
def test_quadratic_forms_are_those_of_the_inverse(shape, size):
    rng = np.random.default_rng(size)
    rows, vector = rng.standard_normal((*shape, size, 9)), rng.standard_normal((*shape, size))
    matrix = rows @ rows.mT
    expected = np.einsum("...i,...ij,...j->...", vector, np.linalg.inv(matrix), vector)
    np.testing.assert_allclose(quadratic_form(matrix, vector), expected, rtol=1e-9)
    matrix = matrix - 1.01 * np.linalg.eigvalsh(matrix)[..., :1, None] * np.eye(size)
    assert not np.isfinite(quadratic_form(matrix, vector)).any()


def test_positive_matrices_are_those_without_a_negative_eigenvalue():
    rng = np.random.default_rng(2)
    turns = rotation(rng.standard_normal((200, 3)))
    values = rng.uniform(-0.3, 1, (200, 3))
    positive = are_positive((turns * values[:, None]) @ turns.mT)
    assert 20 < positive.sum() < 180
    np.testing.assert_array_equal(positive, (values > 0).all(-1))
    assert not are_positive(np.full((3, 3), np.nan))
    assert not np.isfinite(inverse_of_three(np.ones((3, 3)))).any()


@pytest.mark.parametrize("shape", [(3,), (0, 3), (7, 3), (4, 5, 3)])
def test_lengths_and_products_have_the_digits_of_numpy(shape):
    rng = np.random.default_rng(6)
    first, second = rng.normal(size=(2, *shape)) * 10.0 ** rng.integers(-9, 9, (2, *shape))
    np.testing.assert_array_equal(length(first), np.linalg.norm(first, axis=-1))
    np.testing.assert_array_equal(dot(first, second), np.sum(first * second, -1))


@pytest.mark.parametrize("cut", [0.0, -180.0])
@pytest.mark.parametrize("centre", [0.0, 90.0, 180.0, 359.99])
def test_means_and_medians_of_angles_do_not_depend_on_the_cut_of_the_circle(centre, cut):
    """Expected: of the same angles about zero; and the direction of the sum of unit vectors, to second order."""
    about = np.random.default_rng(3).normal(0.0, 0.05, (40, 7))
    angles = (centre + about - cut) % 360.0 + cut
    found = means(angles.ravel(), 360.0, np.arange(40) * 7)
    assert found.min() >= cut
    assert found.max() <= cut + 360.0
    np.testing.assert_allclose(
        centred(found - centre, 360.0), about.mean(-1), rtol=0, atol=1e-12 * 360
    )
    vectors = np.degrees(np.angle(np.exp(1j * np.radians(angles)).sum(-1)))
    np.testing.assert_allclose(centred(found - vectors, 360.0), 0.0, atol=1e-6)
    medians = np.array([np.median(unrolled(each)) for each in angles])
    np.testing.assert_allclose(centred(medians - centre, 360.0), np.median(about, -1), atol=1e-9)
