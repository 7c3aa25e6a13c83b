"""Sums of squared differences of observables, as the papers wrote them: weights are given.

    E = Σ_n Σ_o w_no (o(field_n) - reference_no)²

Minimised, this is no maximum of likelihood: its covariance is a sandwich (`Sums.covariance`).

"strength-squared" is |v|² of either triad, "inclination" and "toolface" are the
accelerometer's. Shapes: batch axis B, n stations, m observables, p parameters. Singular:
toolface of a reference or a reading that is vertical has weight zero, as it has no value.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mwdcal.core.observables import OBSERVABLES, is_vertical
from mwdcal.core.problem import Triad
from mwdcal.core.solvers import Determined, Linear, Normal
from mwdcal.core.vectors import Array, Bools, Ints, centred

STRENGTH = "strength-squared"


@dataclass(frozen=True)
class Params:
    """The state of such a sum: parameters (B, p) alone."""

    params: Array

    def take(self, index: Ints) -> Params:
        """Some members of the batch."""
        return Params(self.params[index])

    def put(self, index: Ints, other: Params) -> Params:
        """Ours with some members replaced."""
        changed = self.params.copy()
        changed[index] = other.params
        return Params(changed)


@dataclass(frozen=True)
class Sums:
    """One triad, the observables compared with `reference` (B, n, m), and their `weights`.

    `sd` (B, n, m) are the references' standard uncertainties, used for the covariance only.
    """

    triad: Triad
    temperature: Array
    names: tuple[str, ...]
    reference: Array
    sd: Array
    weights: Array

    def take(self, index: Ints) -> Sums:
        """The sums of some members of the batch."""
        triad = Triad(self.triad.model.take(index), self.triad.raw[index], self.triad.sd[index])
        return replace(
            self,
            triad=triad,
            temperature=self.temperature[index],
            reference=self.reference[index],
            sd=self.sd[index],
            weights=self.weights[index],
        )

    def compared(self, params: Array) -> tuple[Array, Array, Bools]:
        """Differences (B, n, m), gradients (B, n, m, 3) by the field, and whether each counts."""
        field = self.triad.model.fields(params, self.triad.raw, self.temperature)
        errors, gradients, counts = [], [], []
        for index, name in enumerate(self.names):
            if name == STRENGTH:
                value, gradient = np.sum(field**2, -1), 2 * field
            else:
                observable, blank = OBSERVABLES[name], np.zeros_like(field)
                value = observable.value(field, blank)
                gradient = observable.gradient(field, blank)[..., :3]
            error = value - self.reference[..., index]
            errors.append(centred(error, OBSERVABLES[name].period) if name == "toolface" else error)
            gradients.append(gradient)
            counts.append(np.logical_or(name != "toolface", is_vertical(field) == 0))
        counted = np.stack(counts, -1) & (self.weights > 0)
        error = np.where(counted, np.stack(errors, -1), 0.0)
        return error, np.where(counted[..., None], np.stack(gradients, -2), 0.0), counted

    def linear(self, state: Params, geometry: bool = False) -> Linear:
        """Linearise at a state; with `geometry` each observable is in units of its own size."""
        error, gradient, _ = self.compared(state.params)
        jacobian = self.triad.model.jacobian(state.params, self.triad.raw, self.temperature)
        root = np.sqrt(self.weights)
        if geometry:
            sizes = [np.abs(self.reference[..., k]) if n == STRENGTH else np.ones(root.shape[:-1])
                     for k, n in enumerate(self.names)]  # fmt: skip
            root = (self.weights > 0) / np.stack(sizes, -1)
        size = state.params.shape[-1]
        return Linear(
            error * root,
            gradient @ jacobian * root[..., None],
            np.zeros((*error.shape, 1)),
            np.zeros((len(error), size, size)),
            np.zeros((len(error), size)),
            size,
        )

    def move(self, state: Params, linear: Linear, step: Array) -> Params:
        """The state after a step."""
        return Params(state.params + step)

    def size_of(self, state: Params) -> Array:
        """Largest parameter (B, p): steps far below it are rounding."""
        largest = np.max(np.abs(state.params), -1, keepdims=True)
        return np.broadcast_to(largest, state.params.shape)

    def covariance(self, params: Array) -> Array:
        """Covariance (B, p, p) of the minimum on the determined subspace: A⁻¹ (Σ JᵀwVwJ) A⁻¹.

        V (m, m) per station is the spread of its observables, from the noise of the reading
        and the uncertainty of the references.
        """
        state = Params(params)
        determined = Determined.by(Normal.of(self.linear(state, geometry=True)))
        bread = determined.inverse(Normal.of(self.linear(state)).information)
        _, gradient, counted = self.compared(params)
        model, raw = self.triad.model, self.triad.raw
        noise = gradient @ model.slope(params, raw, self.temperature) * self.triad.sd[..., None, :]
        own = (self.sd**2 * counted)[..., None] * np.eye(len(self.names))
        spread = noise @ np.swapaxes(noise, -1, -2) + own
        rows = gradient @ model.jacobian(params, raw, self.temperature) * self.weights[..., None]
        filling = np.einsum("bnip,bnij,bnjq->bpq", rows, spread, rows, optimize=True)
        return np.asarray(bread @ filling @ bread)
