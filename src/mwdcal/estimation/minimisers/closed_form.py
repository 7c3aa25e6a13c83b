"""Runs whose reference vectors are all exactly known: the minimum and its analysis in closed form.

With nothing private and nothing shared, a station says raw = S f + o + noise with f known. That is
linear in Φ = [S o], separately for each axis, and the model's own parameters Θ = [A c] follow it:

    δΘ = -M δΦ T,     M = S⁻¹,  T = [A c; 0 1],  field = A x + c,  x = (raw - centre) / scale

so that all covariances and ranks are products of 3 × 3 and 4 × 4 matrices. These are the same
figures as the general way gives, for a hundredth of the work; they are tested against it. Moosavi's
factors come apart by axis as well (`closed_form_factors`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from mwdcal.estimation.batch import for_all, is_once
from mwdcal.estimation.minimisers import closed_form_factors
from mwdcal.estimation.problem import GEOMETRIC_NOISE, Problem, State, Triad
from mwdcal.estimation.solvers import RANK_TOLERANCE, Determined, regress
from mwdcal.estimation.uncertainty import Analysis, per_freedom
from mwdcal.geometry.vectors import (
    Array,
    Bools,
    diagonal,
    eigenvalues,
    inverse,
    outer,
    tool_from_earth,
)
from mwdcal.sensor.models import Factors, Polynomial, affine_terms

_ELEMENTS = np.arange(12).reshape(3, 4)
PLACES = affine_terms(_ELEMENTS[:, :3], _ELEMENTS[:, 3])
"""Places of the parameters among the elements of Θ, row by row."""


def applies(problem: Problem) -> bool:
    """Whether all that the triads should read is exactly known, and the models come apart by axis."""
    return not problem.evidence.constants and but_for_constants(problem)


def but_for_constants(problem: Problem) -> bool:
    """Whether the closed form would apply if the run had no constants."""
    evidence = problem.evidence
    angles = ("inclination", "toolface", "azimuth")[: 1 + len(problem.triads)]
    return (
        all(is_closed(triad) for triad in problem.triads)
        and not evidence.absent
        and all(evidence.is_known(name).all() for name in angles)
        and not any(evidence.sd[name].any() for name in angles)
        and problem.prior.is_none
    )


def is_affine(triad: Triad) -> bool:
    """Whether a triad's model is a gain and an offset that do not vary."""
    return isinstance(triad.model, Polynomial) and not triad.model.varies


def is_closed(triad: Triad) -> bool:
    """Whether a triad's model comes apart by axis."""
    return is_affine(triad) or isinstance(triad.model, Factors)


@dataclass(frozen=True)
class AffineMinimum:
    """One triad: terms f̃ = [f 1] (B, n, 4), Φ (B, 3, 4), F⁻¹ by axis (B, 3, 4, 4), M and T.

    `include` (B, n, 1) is 1 for stations that count; `left` (B, n, 3) are whitened residuals, `open`
    (B, n, 3) their expected variances. `settled` (B,): the stations span what the model needs.
    """

    include: Array
    terms: Array
    forward: Array
    spread: Array
    back: Array
    turn: Array
    left: Array
    open: Array
    settled: Bools

    @property
    def params(self) -> Array:
        """Parameters (B, 12) of the model."""
        return np.asarray(self.turn[:, :3].reshape(-1, 12)[:, PLACES])

    @property
    def covariance(self) -> Array:
        """Covariance (B, 12, 12) of the parameters."""
        spread, both = self.spread, self.back[:, :, None] * self.back[:, None]
        if not spread.strides[1]:  # alike for all axes
            spread, both = spread[:, :1], both.sum(-1, keepdims=True)
        inner = self.turn.mT[:, None] @ spread @ self.turn[:, None]
        whole = both.reshape(len(both), 9, -1) @ inner.reshape(len(both), -1, 16)
        whole = np.swapaxes(whole.reshape(-1, 3, 3, 4, 4), 2, 3).reshape(-1, 12, 12)
        return np.asarray(whole[:, PLACES[:, None], PLACES])

    @property
    def known(self) -> tuple[Array, Array]:
        """Singular values (B, 12) of the evidence, and norms of its columns.

        Normalised, the information is a Kronecker product.
        """
        return known_at(self.include, self.terms, self.forward, self.turn)


def known_at(include: Array, terms: Array, forward: Array, turn: Array) -> tuple[Array, Array]:
    """Singular values and norms (see `AffineMinimum`) at Φ and T."""
    gain, batch = forward[..., :3], len(forward)
    square = gain.mT @ gain
    pairs = for_all(_pairs, terms)
    strength = _over_stations(square.reshape(batch, 9), pairs[..., _OF_VECTOR].mT)
    weight = include[..., 0] / (GEOMETRIC_NOISE**2 * strength)
    undo = inverse(turn)
    parts = [square, undo @ _over_stations(weight, pairs).reshape(batch, 4, 4) @ undo.mT]
    sizes = [np.sqrt(diagonal(part)) for part in parts]
    pair = [eigenvalues(m / outer(s)) for m, s in zip(parts, sizes, strict=True)]
    squares, norms = (np.einsum("bi,bj->bij", *p).reshape(batch, 12) for p in (pair, sizes))
    return np.sqrt(np.clip(squares, 0, None)), norms[:, PLACES]


_OF_VECTOR = np.array([0, 1, 2, 4, 5, 6, 8, 9, 10])
"""Products of the elements of the vector, without the one, among the `_pairs` of f̃."""


def _pairs(terms: Array) -> Array:
    """Products (B, n, 16) of the elements of f̃ with each other."""
    return outer(terms).reshape(*terms.shape[:2], 16)


def _over_stations(values: Array, columns: Array) -> Array:
    """Sums (B, k) of values (B, n) times columns (B, n, k): one product where these are held once."""
    if is_once(columns):
        return np.asarray(values @ columns[0])
    return np.asarray((values[:, None] @ columns)[:, 0])


Minima = list[AffineMinimum | closed_form_factors.FactorsMinimum]


def minima(problem: Problem, at: State) -> Minima:
    """The minimum of each triad at known attitudes, where the stations span what a model needs."""
    include = problem.evidence.include
    pairs = list(zip(problem.triads, problem.targets(at), strict=False))
    factored = [pair for pair in pairs if isinstance(pair[0].model, Factors)]
    apart = iter(closed_form_factors.minima(factored, problem.temperature, include))
    return [
        next(apart)
        if isinstance(triad.model, Factors)
        else _affine_minimum(triad, target, include[..., None])
        for triad, target in pairs
    ]


def start(problem: Problem) -> State:
    """The known attitudes, with parameters of zero."""
    known, shape = problem.evidence.known, problem.temperature.shape
    azimuth = known["azimuth"]
    if len(problem.triads) == 1:
        azimuth = for_all(np.zeros_like, azimuth)
    attitude = for_all(tool_from_earth, known["inclination"], azimuth, known["toolface"])
    params = np.zeros((shape[0], problem.slices()[-1].stop))
    return problem.start(params, attitude)


def minimum(problem: Problem, at: State) -> tuple[State, Array]:
    """State and whitened residuals (B, n, m) at the minimum for the attitudes of a state."""
    triads = minima(problem, at)
    state = replace(at, params=np.concatenate([h.params for h in triads], -1))
    return state, np.concatenate([h.left for h in triads], -1)


def solution(problem: Problem, at: State) -> tuple[State, Analysis, Bools]:
    """State and analysis at the minimum for the attitudes of a state, and members (B,) that came there."""
    include, triads = problem.evidence.include, minima(problem, at)
    state = replace(at, params=np.concatenate([h.params for h in triads], -1))
    p = state.params.shape[-1]
    covariance = np.zeros((len(include), p, p))
    for triad, where in zip(triads, problem.slices(), strict=True):
        covariance[:, where, where] = triad.covariance
    left = np.concatenate([h.left for h in triads], -1)
    spread = for_all(_diagonal_matrices, *(h.open for h in triads))
    squares = np.stack([np.sum(h.left**2, (1, 2)) for h in triads], -1)
    freedom = np.stack([for_all(lambda x: np.sum(x, (1, 2)), h.open) for h in triads], -1)
    factor = per_freedom(squares, freedom)
    none = np.zeros((len(include), p, 0))
    known = determined(triads)
    nothing = none[:, :0], none, none
    analysis = Analysis(covariance, known, factor, freedom, left, spread, *nothing)
    return state, analysis, np.all([triad.settled for triad in triads], axis=0)


def rescaled(problem: Problem, quieter: Problem, analysis: Analysis) -> Analysis:
    """The analysis of a problem of which the noise of a triad alone is another: its minimum stays."""
    pairs = zip(problem.triads, quieter.triads, strict=True)
    ratio = np.stack([(new.sd / old.sd)[:, 0, 0] for old, new in pairs], -1)
    of_params = np.repeat(ratio, [t.model.size for t in problem.triads], -1)
    return replace(
        analysis,
        covariance=analysis.covariance * outer(of_params),
        variance_factor=analysis.variance_factor / ratio**2,
        residual=analysis.residual / np.repeat(ratio, 3, -1)[:, None],
    )


def _diagonal_matrices(*parts: Array) -> Array:
    """Matrices (B, n, m, m) of which the parts (B, n, 3) are the diagonal."""
    free = np.concatenate(parts, -1)
    spread = np.zeros((*free.shape, free.shape[-1]))
    np.einsum("...ii->...i", spread)[...] = free
    return spread


def _affine_minimum(triad: Triad, target: Array, include: Array) -> AffineMinimum:
    """The minimum of one triad; at vectors that are held once, two products of all readings."""
    level, shape = noise_level(triad), triad.raw.shape
    if level is None:
        return _uneven_minimum(triad, target, include)
    some = slice(1 if is_once(target, include) else None)
    fit = regress(triad.raw[some], target[some], include[some])
    terms, cofactor = fit.terms, fit.cofactor[:, 0]
    pull = (terms @ cofactor).mT * include[some].mT
    forward = (pull @ triad.raw).mT
    free = include[some] - np.sum(pull.mT * terms, -1, keepdims=True)
    return AffineMinimum(
        include,
        np.broadcast_to(terms, (*shape[:2], 4)),
        forward,
        np.broadcast_to((cofactor * level**2)[:, None], (len(level), 3, 4, 4)),
        *centred_parts(triad, forward),
        (triad.raw - terms @ forward.mT) * (include / level),
        np.broadcast_to(free, shape),
        np.broadcast_to(fit.spanned, shape[:1]),
    )


def _uneven_minimum(triad: Triad, target: Array, include: Array) -> AffineMinimum:
    """The same where the noise differs from reading to reading."""
    weight = include / triad.sd**2
    fit = regress(triad.raw, target, weight)
    terms, forward, spread = fit.terms, fit.forward.mT, fit.cofactor
    left = (triad.raw - terms @ forward.mT) * np.sqrt(weight)
    share = np.einsum("banj,bnj->bna", terms[:, None] @ spread, terms) * weight
    parts = centred_parts(triad, forward)
    free = include - share
    return AffineMinimum(include, terms, forward, spread, *parts, left, free, fit.spanned)


def noise_level(triad: Triad) -> Array | None:
    """The noise (B, 1, 1) of all readings of a triad; None where they differ in it."""
    level = triad.sd[:, :1, :1]
    if any(triad.sd.strides[1:]) and (triad.sd != level).any():
        return None
    return level


def centred_parts(triad: Triad, forward: Array) -> tuple[Array, Array]:
    """M (B, 3, 3) and T (B, 4, 4) of Φ in the model's own centred and scaled reading."""
    model = triad.model
    assert isinstance(model, Polynomial)
    back = inverse(forward[..., :3])
    turn = np.zeros((len(forward), 4, 4))
    turn[:, :3, :3] = back * model.scale
    turn[:, :3, 3] = np.einsum("bij,bj->bi", back, model.centre[:, 0] - forward[..., 3])
    turn[:, 3, 3] = 1.0
    return back, turn


def determined(triads: Minima) -> Determined:
    """How well all triads' parameters are determined; the directions themselves are not worked out."""
    return determined_by([triad.known for triad in triads])


def determined_by(known: Iterable[tuple[Array, Array]]) -> Determined:
    """The same from singular values and norms (B, p) of each triad."""
    values, norms = (np.concatenate(each, -1) for each in zip(*known, strict=True))
    values = -np.sort(-values, -1)
    values = values / np.maximum(values[:, :1], 1e-300)
    size = values.shape[-1]
    directions = np.broadcast_to(np.eye(size), (*values.shape, size))
    return Determined(directions, values, norms, values > RANK_TOLERANCE)
