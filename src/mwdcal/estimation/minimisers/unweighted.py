"""Sums of squared differences of observables, as the papers wrote them: weights are given.

    E = Σ_n Σ_o w_no (o(field_n) - reference_no)²

Minimised, this is no maximum of likelihood: its covariance is a sandwich (`estimation.uncertainty.sandwich`).

"strength-squared" is |v|² of either triad, "inclination" and "toolface" are the
accelerometer's. Shapes: batch axis B, n stations, m observables, p parameters. Singular:
toolface of a reference or a reading that is vertical has weight zero, as it has no value.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mwdcal.estimation.problem import State, Triad
from mwdcal.estimation.solvers import Determined, Linear
from mwdcal.geometry.observables import OBSERVABLES, is_vertical
from mwdcal.geometry.vectors import Array

STRENGTH = "strength-squared"


@dataclass(frozen=True)
class Sums:
    """One triad, the observables compared with `reference` (B, n, m), and their `weights`.

    The parameters of its states are those of this triad alone.
    """

    triad: Triad
    temperature: Array
    names: tuple[str, ...]
    reference: Array
    weights: Array

    def compared(self, field: Array) -> tuple[Array, Array]:
        """Differences (B, n, m) and gradients (B, n, m, 3) by the field (B, n, 3), zero if they do not count."""
        errors, gradients, counts = [], [], []
        for index, name in enumerate(self.names):
            if name == STRENGTH:
                errors.append(np.sum(field**2, -1) - self.reference[..., index])
                gradients.append(2 * field)
            else:
                observable, blank = OBSERVABLES[name], np.zeros_like(field)
                value = observable.value(field, blank)
                errors.append(observable.difference(value, self.reference[..., index]))
                gradients.append(observable.gradient(field, blank)[..., :3])
            counts.append(np.logical_or(name != "toolface", is_vertical(field) == 0))
        counted = np.stack(counts, -1) & (self.weights > 0)
        error = np.where(counted, np.stack(errors, -1), 0.0)
        return error, np.where(counted[..., None], np.stack(gradients, -2), 0.0)

    def linear(self, state: State, geometry: bool = False) -> Linear:
        """Linearise at a state; with `geometry` each observable is in units of its own size."""
        model, readings = self.triad.model, (self.triad.raw, self.temperature)
        error, gradient = self.compared(model.fields(state.params, *readings))
        jacobian = model.jacobian(state.params, *readings)
        root = np.sqrt(self.weights)
        if geometry:
            strong = np.array(self.names) == STRENGTH
            root = (self.weights > 0) / np.where(strong, np.abs(self.reference), 1.0)
        size = state.params.shape[-1]
        return Linear(
            error * root,
            (gradient @ jacobian * root[..., None],),
            np.zeros((*error.shape, 0)),
            np.zeros((*error.shape, 1)),
            np.zeros((len(error), size, size)),
            np.zeros((len(error), size)),
            np.zeros((*error.shape[:-1], 1)),
            np.ones((*error.shape[:-1], 1), bool),
        )

    def move(self, state: State, linear: Linear, step: Array) -> State:
        """The state after a step."""
        return replace(state, params=state.params + step)

    def information(self, state: State) -> Array:
        """Information (B, p, p) of the observables, in relative units and radians."""
        return self.linear(state, geometry=True).normal.information

    def influence(self, state: State, target: Array) -> Array:
        """Change (B, n, p, 3) of the minimum by an error of each station's whitened reading.

        On the determined subspace. The observables' gradients are taken at `target` (B, n, 3), the
        vectors that a perfect tool reads: along an unknown turn they are then exactly zero.
        """
        determined = Determined.of(self, state)
        bread = determined.inverse(self.linear(state).normal.information)
        model, raw, params = self.triad.model, self.triad.raw, state.params
        _, gradient = self.compared(target)
        noise = gradient @ model.slope(params, raw, self.temperature) * self.triad.sd[..., None, :]
        rows = gradient @ model.jacobian(params, raw, self.temperature) * self.weights[..., None]
        return -bread[:, None] @ rows.mT @ noise
