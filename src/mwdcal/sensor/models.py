"""Sensor models: parameters and readings to field vectors, with Jacobian and slope.

Two families, composed and never subclassed:

polynomial   field = Σ_k φ_k(T) (A_k x + c_k) [+ e₂ x² + e₃ x³, own axis, if `curved`]
             linear in its 12 (n + 1) parameters [+ 6]
factors      field = (I - m) (x / SF(T) - B(T))          Moosavi 1-8: 6 (n + 1) + 6 parameters

Readings x are already in tool axes and nominal units (`files`), so an ideal triad has
A = I, c = 0, SF = 1, B = 0, m = 0. Shapes: parameters (..., p), readings (..., n, 3),
temperature (..., n); results (..., n, 3), Jacobian (..., n, 3, p), slope d field / d x
(..., n, 3, 3).

The order of the parameters is defined by `affine_parts` and `factor_parts`, and nowhere else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from mwdcal.geometry.vectors import AnyArray, Array, diagonal, inverse

OFF_DIAGONAL = tuple((i, j) for i in range(3) for j in range(3) if i != j)
"""Axes of the six misalignments, in their order."""
OFF_ROWS, OFF_COLUMNS = np.array(OFF_DIAGONAL).transpose()


def affine_parts(terms: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Matrix (..., 3, 3) and offset (..., 3) of twelve parameters (..., 12) at one power of T."""
    return terms[..., :9].reshape(*terms.shape[:-1], 3, 3), terms[..., 9:]


def affine_terms(matrix: AnyArray, offset: AnyArray) -> AnyArray:
    """Twelve parameters (..., 12) of a matrix (..., 3, 3) and an offset (..., 3)."""
    return np.concatenate([matrix.reshape(*matrix.shape[:-2], 9), offset], -1)


def factor_parts(params: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
    """SF and B (..., 3, K) by axis and power of T, and m (..., 3, 3), of factors (..., 6 K + 6)."""
    count = params.shape[-1] // 6 - 1
    linear = params[..., :-6].reshape(*params.shape[:-1], 2, 3, count)
    misalignment = np.zeros((*params.shape[:-1], 3, 3), params.dtype)
    misalignment[..., OFF_ROWS, OFF_COLUMNS] = params[..., -6:]
    return linear[..., 0, :, :], linear[..., 1, :, :], misalignment


def factor_params(scale: AnyArray, bias: AnyArray, misalignment: AnyArray) -> AnyArray:
    """Factors (..., 6 K + 6) of SF and B (..., 3, K) and m (..., 3, 3): its diagonal does not count."""
    linear = [
        part.reshape(*part.shape[:-2], part.shape[-2] * part.shape[-1]) for part in (scale, bias)
    ]
    return np.concatenate([*linear, misalignment[..., OFF_ROWS, OFF_COLUMNS]], -1)


@dataclass(frozen=True)
class Basis:
    """Polynomials of temperature up to `order`, in t = (T - middle) / half.

    Chebyshev polynomials keep a fit well conditioned (raw powers of 50 °C to the cube do
    not); plain powers with half = 1 are what files and firmware use.
    """

    order: int = 0
    middle: float = 0.0
    half: float = 1.0
    chebyshev: bool = False

    def __call__(self, temperature: Array) -> Array:
        """Values φ_k (..., n, order + 1)."""
        scaled = (np.asarray(temperature, float) - self.middle) / self.half
        if self.order == 0:
            return np.asarray(scaled * 0.0 + np.ones(1))[..., None]
        if self.chebyshev:
            return np.asarray(np.polynomial.chebyshev.chebvander(scaled, self.order))
        return np.asarray(np.polynomial.polynomial.polyvander(scaled, self.order))

    def powers(self, reference: float) -> Array:
        """Matrix (order + 1, order + 1): power coefficients of T - reference from ours."""
        size = self.order + 1
        if size == 1:
            return np.eye(1)
        shift, step = (reference - self.middle) / self.half, 1.0 / self.half
        nodes = np.cos(np.pi * (np.arange(size) + 0.5) / size)
        ours = self(self.middle + self.half * nodes)
        theirs = np.polynomial.polynomial.polyvander((nodes - shift) / step, self.order)
        return np.asarray(np.linalg.solve(theirs, ours))


@dataclass(frozen=True)
class Polynomial:
    """The model linear in its parameters: order n has A_k (row by row), then c_k, for each k.

    With `curved`, six more follow: e₂ and e₃ of each axis, its own quadratic and cubic terms.
    `centre` and `scale` (..., 1, 3) condition a fit with offsets of many times the field;
    they are zero and one in a finished calibration, but for a curved one, whose powers are
    always of the centred reading.
    """

    basis: Basis
    centre: Array = field(default_factory=lambda: np.zeros((1, 3)))
    scale: Array = field(default_factory=lambda: np.ones((1, 3)))
    curved: bool = False
    kind = "polynomial"

    @property
    def affine(self) -> int:
        """Number of parameters without the curved ones."""
        return 12 * (self.basis.order + 1)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.affine + 6 * self.curved

    @property
    def varies(self) -> bool:
        """Whether the slope differs from station to station."""
        return self.basis.order > 0 or self.curved

    def _scaled(self, raw: Array) -> Array:
        return np.asarray((raw - self.centre) / self.scale)

    def _blocks(self, params: Array) -> Array:
        return params[..., : self.affine].reshape(*params.shape[:-1], self.basis.order + 1, 12)

    def _terms(self, params: Array, temperature: Array) -> tuple[Array, Array]:
        phi = self.basis(temperature)
        return affine_parts(np.einsum("...nk,...kp->...np", phi, self._blocks(params)))

    def fields(self, params: Array, raw: Array, temperature: Array) -> Array:
        """Field vectors (..., n, 3)."""
        matrix, offset = self._terms(params, temperature)
        x = self._scaled(raw)
        result = np.einsum("...ij,...j->...i", matrix, x) + offset
        if self.curved:
            square, cube = params[..., None, -6:-3], params[..., None, -3:]
            result = result + (square + cube * x) * x * x
        return np.asarray(result)

    def slope(self, params: Array, raw: Array, temperature: Array) -> Array:
        """Derivative of the field with respect to the reading (..., n, 3, 3)."""
        matrix, _ = self._terms(params, temperature)
        if self.curved:
            x, axis = self._scaled(raw), np.arange(3)
            square, cube = params[..., None, -6:-3], params[..., None, -3:]
            matrix[..., axis, axis] += (2 * square + 3 * cube * x) * x
        return np.asarray(matrix / self.scale[..., None, :])

    def jacobian(self, params: Array, raw: Array, temperature: Array) -> Array:
        """Derivative of the field with respect to the parameters (..., n, 3, p): the basis."""
        x, values = self._scaled(raw), self.basis(temperature)
        by_matrix = values[..., None] * x[..., None, :]
        blocks = np.zeros((*by_matrix.shape[:-2], 3, values.shape[-1], 12))
        matrix, offset = affine_parts(blocks)
        for axis in range(3):
            matrix[..., axis, :, axis, :], offset[..., axis, :, axis] = by_matrix, values
        result = blocks.reshape(*blocks.shape[:-2], self.affine)
        if self.curved:
            curves = [np.eye(3) * (x**power)[..., None, :] for power in (2, 3)]
            result = np.concatenate([result, *curves], -1)
        return np.asarray(result)

    def divisor(self, params: Array, temperature: Array) -> Array:
        """Factor (..., n, 3) that each reading is divided by: one."""
        return np.ones((*temperature.shape, 3))

    def curvature(self, params: Array, raw: Array, temperature: Array, covector: Array) -> Array:
        """Second derivatives (..., p, p) of Σ covector (..., n, 3) · field: none, it is linear."""
        vectors = np.broadcast_shapes(raw.shape, covector.shape, (*temperature.shape, 3))
        lead = np.broadcast_shapes(params.shape[:-1], vectors[:-2])
        return np.zeros((*lead, self.size, self.size))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters: `gain-xy` is A[x, y], `offset-x` is c[x]; `·k` for T^k."""
        gains = np.array([[f"gain-{i}{j}" for j in "xyz"] for i in "xyz"])
        one = affine_terms(gains, np.array([f"offset-{i}" for i in "xyz"])).tolist()
        names = [_with_power(name, k) for k in range(self.basis.order + 1) for name in one]
        return (*names, *(f"{w}-{i}" for w in ("square", "cube") for i in "xyz" if self.curved))

    def start(self, matrix: Array, offset: Array) -> Array:
        """Parameters (..., p) of field = matrix · raw + offset."""
        offset = offset + np.einsum("...ij,...j->...i", matrix, self.centre[..., 0, :])
        first = affine_terms(matrix * self.scale, offset)
        later = np.zeros((*first.shape[:-1], self.size - 12))
        return np.concatenate([first, later], -1)

    def transformed(self, params: Array, turn: Array) -> Array:
        """Parameters of the model whose fields are a matrix `turn` (..., 3, 3) times ours.

        Curved terms are not turned: they and the turns are taken to be small.
        """
        matrix, offset = affine_parts(self._blocks(params))
        offset = np.einsum("...ij,...kj->...ki", turn, offset)
        blocks = affine_terms(turn[..., None, :, :] @ matrix, offset)
        flat = blocks.reshape(*blocks.shape[:-2], self.affine)
        rest = np.broadcast_to(params[..., self.affine :], (*flat.shape[:-1], 6 * self.curved))
        return np.concatenate([flat, rest], -1)

    def with_course(self, direction: Array, power: int) -> Array:
        """A change (..., p) of the steady parameters, moved to a power of temperature."""
        blocks = np.zeros((*direction.shape[:-1], self.basis.order + 1, 12))
        blocks[..., power, :] = self._blocks(direction)[..., 0, :]
        flat = blocks.reshape(*direction.shape[:-1], self.affine)
        return np.concatenate([flat, np.zeros_like(direction[..., self.affine :])], -1)

    def finished(self, reference: float) -> tuple[Polynomial, Array]:
        """The same model on plain readings and powers of T - reference, and the linear map to it.

        The map (..., p, p) takes our parameters to the finished model's: use it on the
        covariance as well.
        """
        basis = Basis(self.basis.order, reference)
        powers, size = self.basis.powers(reference), self.size
        if self.curved:
            whole = np.eye(size)
            whole[: self.affine, : self.affine] = np.kron(powers, np.eye(12))
            return Polynomial(basis, self.centre, self.scale, True), whole
        centre, scale = np.broadcast_arrays(self.centre, self.scale)
        one = np.zeros((*scale.shape[:-2], 12, 12))
        gains, offsets = affine_parts(np.arange(12))
        one[..., gains, gains] = 1 / scale
        one[..., offsets[:, None], gains] = -centre / scale
        one[..., offsets, offsets] = 1.0
        mixed = np.einsum("ab,...ij->...aibj", powers, one)
        return Polynomial(basis), mixed.reshape(*one.shape[:-2], size, size)


@dataclass(frozen=True)
class Factors:
    """Moosavi's factors, linear but for products: SF_i(T), B_i(T) and m_ij; see `factor_parts`."""

    basis: Basis
    kind = "factors"
    curved = False

    @property
    def size(self) -> int:
        """Number of parameters, 12 at order 0 and 30 at order 3."""
        return 6 * (self.basis.order + 1) + 6

    @property
    def varies(self) -> bool:
        """Whether the slope differs from station to station."""
        return self.basis.order > 0

    def _split(self, params: Array, temperature: Array) -> tuple[Array, Array, Array]:
        """SF(T) and B(T) (..., n, 3), and I - m (..., 3, 3)."""
        values, (scale, bias, misalignment) = self.basis(temperature), factor_parts(params)
        scale, bias = (np.einsum("...nk,...ik->...ni", values, part) for part in (scale, bias))
        return scale, bias, np.eye(3) - misalignment

    def fields(self, params: Array, raw: Array, temperature: Array) -> Array:
        """Field vectors (..., n, 3)."""
        scale, bias, mixing = self._split(params, temperature)
        return np.asarray(np.einsum("...ij,...nj->...ni", mixing, raw / scale - bias))

    def slope(self, params: Array, raw: Array, temperature: Array) -> Array:
        """Derivative of the field with respect to the reading (..., n, 3, 3)."""
        scale, _, mixing = self._split(params, temperature)
        return np.asarray(mixing[..., None, :, :] / scale[..., None, :])

    def jacobian(self, params: Array, raw: Array, temperature: Array) -> Array:
        """Derivative of the field with respect to the parameters (..., n, 3, p)."""
        scale, bias, mixing = self._split(params, temperature)
        values, column = self.basis(temperature), mixing[..., None, :, :]
        by_scale = -(raw / scale**2)[..., None, :, None] * column[..., None]
        by_scale = by_scale * values[..., None, None, :]
        by_bias = np.broadcast_to(-column[..., None] * values[..., None, None, :], by_scale.shape)
        by_misalignment = -np.einsum("ij,...k->...ijk", np.eye(3), raw / scale - bias)
        return factor_params(by_scale, by_bias, by_misalignment)

    def divisor(self, params: Array, temperature: Array) -> Array:
        """Factor (..., n, 3) that each reading is divided by: SF(T).

        The Jacobian is a polynomial of temperature times one affine in reading / SF².
        """
        return self._split(params, temperature)[0]

    def curvature(self, params: Array, raw: Array, temperature: Array, covector: Array) -> Array:
        """Second derivatives (..., p, p) of Σ covector (..., n, 3) · field, summed over stations."""
        scale, _, mixing = self._split(params, temperature)
        values = self.basis(temperature)
        pulled = np.einsum("...ni,...ij->...nj", covector, mixing)
        bend = np.einsum(
            "...nj,...nk,...nl->...jkl", 2 * pulled * raw / scale**3, values, values, optimize=True
        )
        both = np.stack([raw / scale**2, np.ones_like(scale)], -2)
        cross = np.einsum("...ni,...nsj,...nk->...isjk", covector, both, values, optimize=True)
        result = np.zeros((*cross.shape[:-4], self.size, self.size))
        scales, biases, misalignments = factor_parts(np.arange(self.size))
        for at, block in zip(scales, np.moveaxis(bend, -3, 0), strict=True):
            result[..., at[:, None], at] = block
        for i, j in OFF_DIAGONAL:
            column = misalignments[i, j]
            for s, rows in enumerate((scales[j], biases[j])):
                result[..., rows, column] = result[..., column, rows] = cross[..., i, s, j, :]
        return result

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters: `scale-x`, `bias-x` (with `·k` for T^k), `misalignment-xy`."""
        powers = range(self.basis.order + 1)
        scale, bias = (
            np.array([[_with_power(f"{name}-{i}", k) for k in powers] for i in "xyz"])
            for name in ("scale", "bias")
        )
        misalignment = np.array([[f"misalignment-{i}{j}" for j in "xyz"] for i in "xyz"])
        return tuple(factor_params(scale, bias, misalignment).tolist())

    def start(self, matrix: Array, offset: Array) -> Array:
        """Parameters (..., p) of field = matrix · raw + offset."""
        scale = 1 / diagonal(matrix)
        mixing = matrix * scale[..., None, :]
        bias = -np.einsum("...ij,...j->...i", inverse(mixing), offset)
        steady = np.arange(self.basis.order + 1) == 0
        return factor_params(scale[..., None] * steady, bias[..., None] * steady, -mixing)

    def transformed(self, params: Array, turn: Array) -> Array:
        """Parameters of the model whose fields are a matrix `turn` (..., 3, 3) times ours."""
        scale, bias, misalignment = factor_parts(params)
        mixing = turn @ (np.eye(3) - misalignment)
        gain = diagonal(mixing)
        scale, bias = scale * (1 / gain)[..., None], bias * gain[..., None]
        return factor_params(scale, bias, -(mixing / gain[..., None, :]))

    def with_course(self, direction: Array, power: int) -> Array:
        """A change (..., p) of the steady parameters, moved to a power of temperature.

        Misalignments have no course: what needs one is left as zero.
        """
        scale, bias, misalignment = factor_parts(direction)
        moved = np.arange(scale.shape[-1]) == power
        scale, bias = scale[..., :1] * moved, bias[..., :1] * moved
        return factor_params(scale, bias, np.zeros_like(misalignment))

    def finished(self, reference: float) -> tuple[Factors, Array]:
        """The same model in powers of T - reference, and the linear map to it."""
        whole, powers = np.eye(self.size), self.basis.powers(reference)
        scale, bias, _ = factor_parts(np.arange(self.size))
        for at in (*scale, *bias):
            whole[at[:, None], at] = powers
        return Factors(Basis(self.basis.order, reference)), whole


Whole = Polynomial | Factors


@dataclass(frozen=True)
class Restricted:
    """A model of which only some parameters are fitted, `kept`; the others are zero.

    It has no rotation of its own: what a turn needs of the parameters left out is dropped.
    """

    whole: Whole
    kept: tuple[int, ...]

    @property
    def kind(self) -> str:
        """The whole model's kind."""
        return self.whole.kind

    @property
    def curved(self) -> bool:
        """Whether the whole model has own-axis terms."""
        return self.whole.curved

    @property
    def varies(self) -> bool:
        """Whether the whole model's slope differs from station to station."""
        return self.whole.varies

    @property
    def basis(self) -> Basis:
        """The whole model's temperature basis."""
        return self.whole.basis

    @property
    def size(self) -> int:
        """Number of fitted parameters."""
        return len(self.kept)

    def full(self, params: Array) -> Array:
        """Parameters (..., all) of the whole model."""
        full = np.zeros((*params.shape[:-1], self.whole.size), params.dtype)
        full[..., self.kept] = params
        return full

    def fields(self, params: Array, raw: Array, temperature: Array) -> Array:
        """Field vectors (..., n, 3)."""
        return self.whole.fields(self.full(params), raw, temperature)

    def slope(self, params: Array, raw: Array, temperature: Array) -> Array:
        """Derivative of the field with respect to the reading (..., n, 3, 3)."""
        return self.whole.slope(self.full(params), raw, temperature)

    def jacobian(self, params: Array, raw: Array, temperature: Array) -> Array:
        """Derivative of the field with respect to the fitted parameters (..., n, 3, p)."""
        return self.whole.jacobian(self.full(params), raw, temperature)[..., self.kept]

    def curvature(self, params: Array, raw: Array, temperature: Array, covector: Array) -> Array:
        """Second derivatives (..., p, p) of Σ covector (..., n, 3) · field, summed over stations."""
        whole = self.whole.curvature(self.full(params), raw, temperature, covector)
        return whole[..., self.kept, :][..., self.kept]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the fitted parameters."""
        return tuple(self.whole.names[index] for index in self.kept)

    def start(self, matrix: Array, offset: Array) -> Array:
        """Parameters (..., p) near field = matrix · raw + offset."""
        return self.whole.start(matrix, offset)[..., self.kept]

    def transformed(self, params: Array, turn: Array) -> Array:
        """Parameters near those of the model whose fields are a matrix `turn` times ours."""
        return self.whole.transformed(self.full(params), turn)[..., self.kept]

    def with_course(self, direction: Array, power: int) -> Array:
        """A change (..., p) of the steady parameters, moved to a power of temperature."""
        return self.whole.with_course(self.full(direction), power)[..., self.kept]

    def finished(self, reference: float) -> tuple[Whole, Array]:
        """The whole model on plain readings, and the linear map (..., all, p) to it."""
        model, whole = self.whole.finished(reference)
        return model, whole[..., self.kept]


def restricted(model: Whole, parameters: int) -> Model:
    """A model of 6, 9 or 12 parameters per triad (at one temperature).

    12: all. 9: without the misalignments xy, xz, yz: the sensor x is the frame's x, and the
    sensor y lies in its x-y plane (the sensor frame, which has no mounting rotation).
    6: scale and bias alone.
    """
    dropped = {12: (), 9: ("xy", "xz", "yz"), 6: ("xy", "xz", "yz", "yx", "zx", "zy")}[parameters]
    if not dropped:
        return model
    cross = [name for name in model.names if name.startswith(("gain-", "misalignment-"))]
    lost = {n for n in cross if n.partition("-")[2].partition("·")[0] in dropped}
    return Restricted(model, tuple(i for i, n in enumerate(model.names) if n not in lost))


Model = Whole | Restricted


def stacked(models: Sequence[Model]) -> Polynomial | None:
    """Polynomials that differ in their centres and scales alone, as one with a leading axis; else None."""
    first = models[0]
    whole = [m for m in models if isinstance(m, Polynomial) and isinstance(first, Polynomial)]
    if len(whole) < len(models) or len({(m.basis, m.curved) for m in whole}) > 1:
        return None
    centre, scale = np.stack([m.centre for m in whole]), np.stack([m.scale for m in whole])
    return replace(whole[0], centre=centre, scale=scale)


def _with_power(name: str, power: int) -> str:
    return f"{name}·{power}" if power else name
