"""Sensor models: parameters and readings to field vectors, with Jacobian and slope.

Two families, composed and never subclassed:

polynomial   field = Σ_k φ_k(T) (A_k x + c_k) [+ e₂ x² + e₃ x³, own axis, where asked for]
             linear in its 12 (n + 1) parameters [+ 6]
factors      field = (I - m) (x / SF(T) - B(T))          Moosavi 1-8: 6 (n + 1) + 6 parameters

Readings x are already in tool axes and nominal units (`files`), so an ideal triad has
A = I, c = 0, SF = 1, B = 0, m = 0. Shapes: parameters (..., p), readings (..., n, 3),
temperature (..., n); results (..., n, 3), Jacobian (..., n, 3, p), slope d field / d x
(..., n, 3, 3).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from math import prod

import numpy as np

from mwdcal.geometry.vectors import Array, inverse

OFF_DIAGONAL = tuple((i, j) for i in range(3) for j in range(3) if i != j)


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

    def _scaled(self, raw: Array) -> Array:
        return np.asarray((raw - self.centre) / self.scale)

    def _blocks(self, params: Array) -> Array:
        return params[..., : self.affine].reshape(*params.shape[:-1], self.basis.order + 1, 12)

    def _terms(self, params: Array, temperature: Array) -> tuple[Array, Array]:
        terms = np.einsum("...nk,...kp->...np", self.basis(temperature), self._blocks(params))
        return terms[..., :9].reshape(*terms.shape[:-1], 3, 3), terms[..., 9:]

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
            x, diagonal = self._scaled(raw), np.arange(3)
            square, cube = params[..., None, -6:-3], params[..., None, -3:]
            matrix[..., diagonal, diagonal] += (2 * square + 3 * cube * x) * x
        return np.asarray(matrix / self.scale[..., None, :])

    def jacobian(self, params: Array, raw: Array, temperature: Array) -> Array:
        """Derivative of the field with respect to the parameters (..., n, 3, p): the basis."""
        x = self._scaled(raw)
        rows = np.einsum("ij,...k->...ijk", np.eye(3), x).reshape(*x.shape[:-1], 3, 9)
        one = np.concatenate([rows, np.broadcast_to(np.eye(3), (*x.shape[:-1], 3, 3))], -1)
        blocks = np.einsum("...nk,...nip->...nikp", self.basis(temperature), one)
        result = blocks.reshape(*one.shape[:-1], self.affine)
        if self.curved:
            own = [np.eye(3) * (x**power)[..., None, :] for power in (2, 3)]
            result = np.concatenate([result, *own], -1)
        return np.asarray(result)

    def curvature(self, params: Array, raw: Array, temperature: Array, covector: Array) -> Array:
        """Second derivatives (..., p, p) of Σ covector (..., n, 3) · field: none, it is linear."""
        vectors = np.broadcast_shapes(raw.shape, covector.shape, (*temperature.shape, 3))
        lead = np.broadcast_shapes(params.shape[:-1], vectors[:-2])
        return np.zeros((*lead, self.size, self.size))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters: `gain-xy` is A[x, y], `offset-x` is c[x]; `·k` for T^k."""
        one = [f"gain-{i}{j}" for i in "xyz" for j in "xyz"] + [f"offset-{i}" for i in "xyz"]
        names = [_with_order(name, k) for k in range(self.basis.order + 1) for name in one]
        return (*names, *(f"{w}-{i}" for w in ("square", "cube") for i in "xyz" if self.curved))

    def start(self, matrix: Array, offset: Array) -> Array:
        """Parameters (..., p) of field = matrix · raw + offset."""
        offset = offset + np.einsum("...ij,...j->...i", matrix, self.centre[..., 0, :])
        matrix = matrix * self.scale
        first = np.concatenate([matrix.reshape(*matrix.shape[:-2], 9), offset], -1)
        later = np.zeros((*first.shape[:-1], self.size - 12))
        return np.concatenate([first, later], -1)

    def transformed(self, params: Array, turn: Array) -> Array:
        """Parameters of the model whose fields are a matrix `turn` (..., 3, 3) times ours.

        Curved terms stay on their own axes: they are small, and so are the turns asked for.
        """
        blocks = self._blocks(params)
        shape = blocks.shape[:-1]
        matrix = turn[..., None, :, :] @ blocks[..., :9].reshape(*shape, 3, 3)
        offset = np.einsum("...ij,...kj->...ki", turn, blocks[..., 9:])
        joined = np.concatenate([matrix.reshape(*shape, 9), offset], -1)
        flat = joined.reshape(*params.shape[:-1], self.affine)
        return np.concatenate([flat, params[..., self.affine :]], -1)

    def with_course(self, direction: Array, power: int) -> Array:
        """A change (..., p) of the steady parameters, moved to a power of temperature."""
        blocks = np.zeros((*direction.shape[:-1], self.basis.order + 1, 12))
        blocks[..., power, :] = self._blocks(direction)[..., 0, :]
        flat = blocks.reshape(*direction.shape[:-1], self.affine)
        return np.concatenate([flat, np.zeros_like(direction[..., self.affine :])], -1)

    @property
    def lead(self) -> tuple[int, ...]:
        """Leading axes of the model's own numbers."""
        return self.centre.shape[:-2]

    def flat(self, lead: tuple[int, ...]) -> Polynomial:
        """The model with one batch axis for these leading axes."""
        count = prod(lead)
        centre, scale = (np.broadcast_to(x, (*lead, 1, 3)) for x in (self.centre, self.scale))
        return replace(self, centre=centre.reshape(count, 1, 3), scale=scale.reshape(count, 1, 3))

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
        for row in range(3):
            for column in range(3):
                where = 3 * row + column
                one[..., where, where] = 1 / scale[..., 0, column]
                one[..., 9 + row, where] = -centre[..., 0, column] / scale[..., 0, column]
            one[..., 9 + row, 9 + row] = 1.0
        mixed = np.einsum("ab,...ij->...aibj", powers, one)
        return Polynomial(basis), mixed.reshape(*one.shape[:-2], size, size)


@dataclass(frozen=True)
class Factors:
    """Moosavi's factors: SF_i,k, then B_i,k (k fastest), then the six m_ij row by row."""

    basis: Basis
    kind = "factors"
    curved = False

    @property
    def size(self) -> int:
        """Number of parameters, 12 at order 0 and 30 at order 3."""
        return 6 * (self.basis.order + 1) + 6

    def _split(self, params: Array, temperature: Array) -> tuple[Array, Array, Array]:
        count = self.basis.order + 1
        values = self.basis(temperature)
        both = params[..., : 6 * count].reshape(*params.shape[:-1], 2, 3, count)
        both = np.einsum("...nk,...sik->...sni", values, both)
        return both[..., 0, :, :], both[..., 1, :, :], self._mixing(params)

    def _mixing(self, params: Array) -> Array:
        mixing = np.broadcast_to(np.eye(3), (*params.shape[:-1], 3, 3)).copy()
        for where, (i, j) in enumerate(OFF_DIAGONAL):
            mixing[..., i, j] = -params[..., 6 * (self.basis.order + 1) + where]
        return mixing

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
        by_bias = -column[..., None] * values[..., None, None, :]
        flat = (*by_scale.shape[:-2], by_scale.shape[-2] * by_scale.shape[-1])
        by_bias = np.broadcast_to(by_bias, by_scale.shape)
        unit = raw / scale - bias
        by_mixing = np.zeros((*unit.shape, 6))
        for where, (i, j) in enumerate(OFF_DIAGONAL):
            by_mixing[..., i, where] = -unit[..., j]
        return np.concatenate([by_scale.reshape(flat), by_bias.reshape(flat), by_mixing], -1)

    def curvature(self, params: Array, raw: Array, temperature: Array, covector: Array) -> Array:
        """Second derivatives (..., p, p) of Σ covector (..., n, 3) · field, summed over stations."""
        scale, _, mixing = self._split(params, temperature)
        values, count = self.basis(temperature), self.basis.order + 1
        pulled = np.einsum("...ni,...ij->...nj", covector, mixing)
        bend = np.einsum(
            "...nj,...nk,...nl->...jkl", 2 * pulled * raw / scale**3, values, values, optimize=True
        )
        both = np.stack([raw / scale**2, np.ones_like(scale)], -2)
        cross = np.einsum("...ni,...nsj,...nk->...isjk", covector, both, values, optimize=True)
        result = np.zeros((*cross.shape[:-4], self.size, self.size))
        for j in range(3):
            own = slice(j * count, (j + 1) * count)
            result[..., own, own] = bend[..., j, :, :]
        for where, (i, j) in enumerate(OFF_DIAGONAL):
            column = 6 * count + where
            for s in range(2):
                rows = slice((3 * s + j) * count, (3 * s + j + 1) * count)
                result[..., rows, column] = result[..., column, rows] = cross[..., i, s, j, :]
        return result

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters: `scale-x`, `bias-x` (with `·k` for T^k), `misalignment-xy`."""
        count = range(self.basis.order + 1)
        linear = [
            _with_order(f"{w}-{i}", k) for w in ("scale", "bias") for i in "xyz" for k in count
        ]
        return (*linear, *(f"misalignment-{'xyz'[i]}{'xyz'[j]}" for i, j in OFF_DIAGONAL))

    def start(self, matrix: Array, offset: Array) -> Array:
        """Parameters (..., p) of field = matrix · raw + offset."""
        scale = 1 / np.diagonal(matrix, axis1=-2, axis2=-1)
        mixing = matrix * scale[..., None, :]
        bias = -np.einsum("...ij,...j->...i", inverse(mixing), offset)
        count = self.basis.order + 1
        linear = np.zeros((*offset.shape[:-1], 6, count))
        linear[..., 0] = np.concatenate([scale, bias], -1)
        off = np.stack([-mixing[..., i, j] for i, j in OFF_DIAGONAL], -1)
        return np.concatenate([linear.reshape(*offset.shape[:-1], 6 * count), off], -1)

    def transformed(self, params: Array, turn: Array) -> Array:
        """Parameters of the model whose fields are a matrix `turn` (..., 3, 3) times ours."""
        count = self.basis.order + 1
        linear = params[..., : 6 * count].reshape(*params.shape[:-1], 2, 3, count)
        mixing = turn @ self._mixing(params)
        gain = np.diagonal(mixing, axis1=-2, axis2=-1)
        linear = linear * np.stack([1 / gain, gain], -2)[..., None]
        mixing = mixing / gain[..., None, :]
        off = np.stack([-mixing[..., i, j] for i, j in OFF_DIAGONAL], -1)
        return np.concatenate([linear.reshape(*params.shape[:-1], 6 * count), off], -1)

    def with_course(self, direction: Array, power: int) -> Array:
        """A change (..., p) of the steady parameters, moved to a power of temperature.

        Misalignments have no course: what needs one is left as zero.
        """
        count = self.basis.order + 1
        linear = direction[..., : 6 * count].reshape(*direction.shape[:-1], 6, count)
        moved = np.zeros_like(linear)
        moved[..., power] = linear[..., 0]
        flat = moved.reshape(*direction.shape[:-1], 6 * count)
        return np.concatenate([flat, np.zeros_like(direction[..., 6 * count :])], -1)

    @property
    def lead(self) -> tuple[int, ...]:
        """Leading axes of the model's own numbers: it has none."""
        return ()

    def flat(self, lead: tuple[int, ...]) -> Factors:
        """The model with one batch axis: the same for all."""
        return self

    def finished(self, reference: float) -> tuple[Factors, Array]:
        """The same model in powers of T - reference, and the linear map to it."""
        count = self.basis.order + 1
        whole = np.eye(self.size)
        whole[: 6 * count, : 6 * count] = np.kron(np.eye(6), self.basis.powers(reference))
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

    @property
    def lead(self) -> tuple[int, ...]:
        """Leading axes of the whole model's own numbers."""
        return self.whole.lead

    def flat(self, lead: tuple[int, ...]) -> Restricted:
        """The model with one batch axis for these leading axes."""
        return replace(self, whole=self.whole.flat(lead))

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


def _with_order(name: str, order: int) -> str:
    return f"{name}·{order}" if order else name
