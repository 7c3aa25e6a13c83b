"""The quality of a fit: covariance, rank, free directions by name, residuals per station.

Nothing is quoted for a direction that the evidence does not determine.

Strengths, dip and the direction of a group are constants of the model. Real instruments are held by
hand, near iron: each such constant may have a scatter of its own beside the noise of the sensors.
Its variance is estimated like the noise, by restricted maximum likelihood (REML).

Reference: D. A. Harville, J. Am. Stat. Assoc. 72, 320 (1977).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain, product
from math import erfc

import numpy as np

from mwdcal.estimation.batch import is_once, repeated, take
from mwdcal.estimation.problem import GEOMETRIC_NOISE, Problem, State
from mwdcal.estimation.solvers import RANK_TOLERANCE, Determined, Linear
from mwdcal.geometry.vectors import (
    Array,
    Bools,
    Ints,
    are_positive,
    diagonal,
    distinct,
    dot,
    eigen,
    finite,
    inverse,
    inverse_of_three,
    nearest_rotation,
    outer,
    quotient,
    rotation,
)
from mwdcal.sensor.models import Model

# --------------------------------------------------------------------------
# The free directions of a fit, named: rotations, scales, or the parameters they consist of.


EXACT = 1 - 1e-6
"""A named direction with this share in the null space is taken as it is, free of rounding."""
MOVED = 0.01
"""A direction without a name moves a triad that has more than this share of its square."""


@dataclass(frozen=True)
class Free:
    """One free direction: its name, the triads it moves, and the change of parameters (p,)."""

    id: str
    triads: tuple[int, ...]
    direction: Array


# What overflows belongs to a fit that is refused.
@np.errstate(over="ignore", invalid="ignore")
def free_directions(problem: Problem, state: State, determined: Determined) -> list[list[Free]]:
    """Name the free directions of every member of a batch.

    Each triad's own turns and scale are tried first, then common ones, then single
    parameters; any other direction is called `weak` after its largest part.
    """
    directions: list[list[Free]] = [[] for _ in determined.keep]
    missing = np.sum(~determined.keep, -1)
    for count in distinct(missing[missing > 0]):
        index = np.flatnonzero(missing == count)
        every = _named(*take((problem, state, determined), index), int(count))
        for place, each in zip(index, every, strict=True):
            directions[place] = each
    return directions


def _named(problem: Problem, state: State, determined: Determined, count: int) -> list[list[Free]]:
    """Names of the `count` free directions of each member.

    The best candidate is taken in turn, and the null space goes on without it.
    """
    ids, directions = _candidates(problem, state)
    norms, members = determined.norms, np.arange(len(state.params))
    scaled = directions * norms[:, None]
    length = np.sum(scaled**2, -1)
    null = determined.basis[..., -count:]
    free: list[list[Free]] = [[] for _ in members]
    used = np.zeros(length.shape, bool)
    for _ in range(count):
        inside = np.sum((scaled @ null) ** 2, -1) / np.where(length > 0, length, 1.0)
        best = np.argmax(np.where(used, -1.0, np.round(inside, 3)), -1)
        score = inside[members, best]
        clear = score > COUPLED
        used[members, best] |= clear
        chosen = scaled[members, best]
        part = (null @ (null.mT @ chosen[..., None]))[..., 0]
        chosen = np.where((score < EXACT)[:, None], part, chosen)
        chosen = np.where(clear[:, None], chosen, null[..., -1])
        for place, index in enumerate(best):
            name, triads = ids[index] if clear[place] else _weak(problem, chosen[place])
            free[place].append(Free(name, triads, chosen[place] / norms[place]))
        null = _without(null, chosen)
    return free


def _candidates(problem: Problem, state: State) -> tuple[list[tuple[str, tuple[int, ...]]], Array]:
    """Directions (B, c, p) that have a name, and their names and triads, in order of preference."""
    every = tuple(range(len(problem.triads)))
    groups = dict.fromkeys([*product(every), every])
    turns = {(n, g): d for g in groups for n, d in candidates(problem, state, list(g)).items()}
    alone = [(n, (t,)) for t in every for n in problem.triads[t].model.names]
    unit = np.broadcast_to(np.eye(len(alone)), (*state.params.shape, len(alone)))
    return [*turns, *alone], np.concatenate([np.stack([*turns.values()], 1), unit], 1)


def _weak(problem: Problem, direction: Array) -> tuple[str, tuple[int, ...]]:
    """Name and triads of a direction (p,), in normalised units, that is no candidate."""
    names = [name for triad in problem.triads for name in triad.model.names]
    shares = [np.sum(direction[where] ** 2) for where in problem.slices()]
    triads = tuple(triad for triad, share in enumerate(shares) if share > MOVED)
    return f"weak-{names[int(np.argmax(np.abs(direction)))]}", triads


def _without(null: Array, direction: Array) -> Array:
    """Null spaces (B, p, k) less their part along a direction (B, p), as orthonormal bases."""
    inside = (null.mT @ direction[..., None])[..., 0]
    length = np.linalg.norm(inside, axis=-1, keepdims=True)
    inside = inside / np.where(length > 0, length, 1.0)
    size = null.shape[-1]
    unit = np.broadcast_to(np.eye(size), (len(null), size, size))
    whole = np.linalg.qr(np.concatenate([inside[..., None], unit], -1))[0]
    return np.asarray(null @ whole[..., 1:size])


# --------------------------------------------------------------------------
# Chances of large values, in NumPy alone: SciPy's functions take longer to load than a run to calibrate.

LAST_DIGIT = 1e-15
"""Relative change at which an iteration has converged."""
MOST_FRACTIONS = 10_000
"""Most terms of a continued fraction: degrees of freedom up to 10⁹ need fewer."""
STIRLING = (1 / 12, -1 / 360, 1 / 1260, -1 / 1680, 1 / 1188)
"""Coefficients of Stirling's series of ln Γ(z), at z⁻¹, z⁻³, …"""
EXACT_FROM = 10
"""Argument from which Stirling's series is exact to the last digit."""


def fisher_tail(over: Array, under: Array, ratio: Array) -> Array:
    """Chance of a larger ratio of two variances with `over` and `under` degrees of freedom: Fisher's F.

    Definition: the regularised incomplete beta function I_x(n₂/2, n₁/2) at x = n₂ / (n₂ + n₁F).
    Reference: A. R. DiDonato and A. H. Morris, ACM Trans. Math. Softw. 18, 360 (1992), equation 9.

    >>> fisher_tail(np.array([1, 2]), np.array([10, 20]), np.array([4.964603, 3.492828])).round(6)
    array([0.05, 0.05])
    """
    over, under, ratio = (np.asarray(each, float) for each in (over, under, ratio))
    below = ratio < 1  # the continued fraction is for ratios above one
    a, b = (np.where(below, *pair) / 2 for pair in ((over, under), (under, over)))
    upside = np.divide(1, ratio, out=np.full(below.shape, np.inf), where=ratio > 0)
    chance = _beta(a, b, np.where(below, upside, ratio))
    return np.asarray(np.where(below, 1 - chance, chance))


def _beta(a: Array, b: Array, ratio: Array) -> Array:
    """I_x(a, b) at x = a / (a + bF), for F from one to infinity."""
    finite = np.minimum(ratio, 1e280 / np.maximum(b, 1.0))
    whole = a + b * finite
    x, beyond = a / whole, a * (b * ((finite - 1) / whole))
    value = last = a * (beyond + 1) / (a + 1)
    share = np.zeros_like(last)
    for m in range(1, MOST_FRACTIONS):  # Lentz
        part = a + 2 * m - 1
        lower = m * (b - m) * x / part
        upper = (a + m - 1) * ((a + b + m - 1) * x / part) * lower
        term = m + lower + (a + m) * (beyond + 1 + m * (2 - x)) / (part + 2)
        share, last = 1 / (term + upper * share), term + upper / last
        value = value * share * last
        if (np.abs(share * last - 1) <= LAST_DIGIT).all():
            break
    return np.asarray(np.where(np.isinf(ratio), 0.0, _density(a, b, finite, whole) / value))


def _density(a: Array, b: Array, ratio: Array, whole: Array) -> Array:
    """xᵃ(1 − x)ᵇ / B(a, b) without differences of large logarithms.

    Reference: C. Loader, Fast and accurate computation of binomial probabilities (2000).
    """
    log = np.log((a + b) / whole)
    shift = (1 - ratio) / whole
    exponent = _deviance(a, b * shift, log) + _deviance(b, -a * shift, log + np.log(ratio))
    exponent += _stirling(a) + _stirling(b) - _stirling(a + b)
    return np.asarray(np.sqrt(a * b / (2 * np.pi * (a + b))) * np.exp(-exponent))


def _deviance(size: Array, excess: Array, log: Array) -> Array:
    """N (e − ln(1 + e)), with ln(1 + e) given for where e is not small."""
    small = np.abs(excess) < 0.5
    return np.asarray(size * (excess - np.where(small, np.log1p(np.where(small, excess, 0)), log)))


def _stirling(z: Array) -> Array:
    """Remainder of Stirling's formula for ln Γ(z)."""
    steps = z[..., None] + np.arange(EXACT_FROM)
    series = sum(c / (z + EXACT_FROM) ** (2 * k + 1) for k, c in enumerate(STIRLING))
    return np.asarray(series + ((steps + 0.5) * np.log1p(1 / steps) - 1).sum(-1))


def normal_quantile(chance: Array) -> Array:
    """Standard deviations z that a normal value exceeds, on either side, with a chance above 0.

    By Newton's method for the logarithm of the chance, which is concave: it comes from above. Each row of chances
    (..., n) goes on until all of it has come.

    >>> normal_quantile(np.array([1.0, 0.05, 0.0027])).round(4)
    array([0.  , 1.96, 3.  ])
    """
    chance = np.asarray(chance, float)
    z, moving = np.sqrt(2 * np.log(1 / chance)), np.ones(chance.shape, bool)
    for _ in range(MOST_FRACTIONS):
        tail = np.vectorize(erfc, otypes=[float])(z / np.sqrt(2))
        step = np.log(tail / chance) * tail / (np.sqrt(2 / np.pi) * np.exp(-(z**2) / 2))
        z = z + np.where(moving, step, 0.0)
        moving = moving & np.any(np.abs(step) > LAST_DIGIT * np.maximum(z, 1), -1, keepdims=True)
        if not moving.any():
            break
    return np.asarray(np.maximum(z, 0))


LEAST_FREEDOM = 1e-9
"""Degrees of freedom that are more than what rounding leaves of none."""
LEAST_SHARE = 0.05
"""A free direction with less than this share on a triad does not move the triad."""
TESTED = 1e-3
"""A direction of a station's readings counts if this share of its variance is left by the fit."""
LEFT_OUT_AT_ONCE = 1024
"""Stations that are left out at once, each by itself."""
ROTATIONS = ("rotation-x", "rotation-y", "toolface-zero")
"""Names of the turns of a triad about the tool's three axes."""
TANGENT_STEP = 1e-5
"""Turn, or stretch, of all fields by which its direction among the parameters is taken."""
CHANGES = {
    **dict(zip(ROTATIONS, rotation(TANGENT_STEP * np.eye(3)), strict=True)),
    "scale": np.eye(3) * (1 + TANGENT_STEP),
}
"""Turns of all fields about the tool's axes, and a stretch: what evidence may leave free, by name."""
COUPLED = 0.9
"""Share of a candidate direction that must lie in the null space to be called free."""
FIRST_SCATTER = 1e-3
"""Scatter at which its estimation begins, as a share or in radians."""
LEAST_SCATTER = 1e-5
"""Scatter below which there is none."""
LARGEST_CHANGE = 20.0
"""A variance changes by this factor at most in one round."""
AT_REST = 1e-11
"""Stations and groups are at their best where no step turns them further, rad, or moves them by more σ."""
PIN = 0.05
"""Parameters are known to this share of the field when runs are compared by their probability."""


@dataclass(frozen=True)
class Analysis:
    """A fit at its solution, with leading batch axis B and t triads.

    `covariance` (B, p, p) with declared noise; `determined` says which directions;
    `variance_factor` (B, t) is s² and `freedom` (B, t) its degrees of freedom;
    `residual` (B, n, m) are whitened residuals C⁻¹ρ left on the readings, and `spread`
    (B, n, m, m) their expected covariance C⁻¹ - C⁻¹X V XᵀC⁻¹, so that residual · spread⁺ · residual is χ²;
    `constants` (B, q, q) is the covariance of the constants of the run; `effects` (B, p, q) is
    what one standard uncertainty of each does to the parameters, zero for unknown constants, and
    `of_settings` (B, p, s) what one of each setting of the stand does.
    `influence` (B, n, u, m) is how an error of a station's whitened reading moves X's unknowns,
    where that is not as the likelihood has it.
    Where it is known already: `squares` (B, t), the tr(S²) of `effective_freedom`, and `of_stand` (B, p, p), what the
    angles that each station has for itself add to the covariance.
    """

    covariance: Array
    determined: Determined
    variance_factor: Array
    freedom: Array
    residual: Array
    spread: Array
    constants: Array
    effects: Array
    of_settings: Array
    influence: Array | None = None
    squares: Array | None = None
    of_stand: Array | None = None

    @property
    def finite(self) -> Bools:
        """Members (B,) of which covariance, and residuals with theirs, are finite."""
        each = (self.covariance[:, None], self.residual[..., None], self.spread)
        return np.asarray(np.all([np.isfinite(x).all((1, 2, 3)) for x in each], axis=0))


def analyse(problem: Problem, state: State, determined: Determined | None = None) -> Analysis:
    """Covariance, rank and residuals at a state; `determined` if it is known there already."""
    linear = problem.linear(state)
    determined = determined or Determined.of(problem, state)
    whole = whole_covariance(linear, determined)
    weighed, residual = linear.weighed[..., :-1], linear.weighed[..., -1].copy()
    spread = linear.weight - weighed @ whole[:, None] @ weighed.mT
    spread = spread * problem.evidence.include[..., None, None]
    factor, freedom = variance_factors(residual, spread)
    p, q = linear.size, len(problem.evidence.constants)
    settings = whole.shape[-1] - state.settings.shape[-1]
    return Analysis(
        whole[:, :p, :p],
        determined,
        factor,
        freedom,
        residual,
        spread,
        whole[:, p : p + q, p : p + q],
        effects_of(problem, whole[:, :p, p : p + q]),
        whole[:, :p, settings:],
    )


def effects_of(problem: Problem, cross: Array) -> Array:
    """Effects (B, p, q) from the covariance (B, p, q) of parameters and constants."""
    constants = problem.evidence.constants
    each = [
        np.zeros_like(cross[..., i]) if c.unknown else cross[..., i] / c.sd[:, None]
        for i, c in enumerate(constants)
    ]
    return np.stack(each, -1) if each else cross


def determined_apart(problem: Problem, state: State, known: dict[int, Array]) -> Determined:
    """Which directions are determined when some triads are fitted to less than all evidence.

    `known` (B, p_t, p_t), by triad, is the information of what those are fitted to, in relative
    units and radians. The other triad follows them: what is free in them is free in both, however
    much its own evidence would say of it.
    """
    linear = problem.linear(state, geometry=True)
    whole, _, _ = linear.normal.reduced
    slices, information = problem.slices(), np.zeros_like(whole)
    for index, where in enumerate(slices):
        fitted = known[index] / GEOMETRIC_NOISE**2 if index in known else whole[:, where, where]
        information[:, where, where] = fitted
    if len(known) < len(slices):
        (first, second), scales = slices, outer(linear.norms)
        scaled = whole / np.where(scales > 0, scales, 1.0)
        cross, block = scaled[:, second, first], scaled[:, second, second]
        back = np.linalg.pinv(finite(block), rcond=RANK_TOLERANCE**2, hermitian=True)
        information[:, first, first] += cross.mT @ back @ cross * scales[:, first, first]
        information[:, second, first] = block @ back @ cross * scales[:, second, first]
        information[:, first, second] = information[:, second, first].mT
    return Determined.by(information, linear.norms)


def sandwich(
    analysis: Analysis, problem: Problem, state: State, influence: dict[int, Array]
) -> Analysis:
    """The analysis when triads minimise sums of their own: covariance, residuals' spread and s².

    `influence` (B, n, p_t, 3), by triad, is how an error of a station's whitened reading moves those.
    All other unknowns then follow as in the likelihood, those being held. Every error is counted
    with all that it does: of the readings, of the stand (in C = I + GGᵀ), of common references.
    """
    linear = problem.linear(state)
    design, u = linear.design, linear.prior.shape[-1]
    moved, follow, back, fixed = _followed(problem, linear, influence)
    noise = np.eye(design.shape[2]) + linear.private @ linear.private.mT
    covariance = np.einsum("bnim,bnmk,bnjk->bij", moved, noise, moved, optimize=True)
    independent = covariance
    p, constants, rest = linear.size, problem.evidence.constants, ~fixed
    effects = np.zeros((len(moved), p, u - p))
    known, settings = (
        [p + i for i, c in enumerate(constants) if not c.unknown],
        u - state.settings.shape[-1],
    )
    for column in [*known, *range(settings, u)]:
        common = np.zeros((len(moved), u))
        common[:, fixed] = -np.einsum("bnim,bnm->bi", moved[:, :, fixed], design[..., column])
        pulled = np.einsum("bij,bj->bi", follow, common[:, fixed]) + linear.prior[:, rest, column]
        common[:, rest] = -np.einsum("bij,bj->bi", back, pulled)
        common = common / np.sqrt(linear.prior[:, column, column])[:, None]
        covariance = covariance + outer(common)
        effects[..., column - p] = common[:, :p]
    crossed = design @ moved @ noise
    left = noise + design @ independent[:, None] @ design.mT
    left = left + crossed + crossed.mT
    weight = linear.weight
    spread = weight @ left @ weight * problem.evidence.include[..., None, None]
    factor, freedom = variance_factors(analysis.residual, spread)
    q = len(constants)
    return replace(
        analysis,
        covariance=covariance[:, :p, :p],
        variance_factor=factor,
        freedom=freedom,
        spread=spread,
        constants=covariance[:, p : p + q, p : p + q],
        effects=effects[..., :q],
        of_settings=effects[..., settings - p :],
        influence=moved,
    )


def _followed(
    problem: Problem, linear: Linear, influence: dict[int, Array]
) -> tuple[Array, Array, Array, Bools]:
    """Influence (B, n, u, m) of errors on all unknowns when some triads have their own `influence`.

    Also how the gradient of the others follows those, the inverse of their information, and which
    unknowns (u,) are fixed by pulls.
    """
    design, weighed, u = linear.design, linear.weighed[..., :-1], linear.prior.shape[-1]
    moved = np.zeros((*design.shape[:2], u, design.shape[2]))
    fixed = np.zeros(u, bool)
    for index, pull in influence.items():
        where = problem.slices()[index]
        moved[:, :, where, 3 * index : 3 * index + 3] = pull
        fixed[where] = True
    rest = ~fixed
    whole = np.einsum("bnmi,bnmj->bij", design, weighed, optimize=True)
    back = _inverse_where_known((whole + linear.prior)[:, rest][:, :, rest])
    follow = whole[:, rest][:, :, fixed]
    pull_columns = weighed[..., rest].mT
    moved[:, :, rest] = -back[:, None] @ (follow[:, None] @ moved[:, :, fixed] + pull_columns)
    return moved, follow, back, fixed


def unweighted_pulls(problem: Problem, even: Problem, state: State) -> dict[int, Array]:
    """Pulls (B, n, p_t, 3) of least squares with the noise of `even`, all references being exact."""
    linear = even.linear(state)
    determined = Determined.of(even, state)
    reduced, _, eliminate = linear.normal.reduced
    p = linear.size
    rows = linear.design[..., :p] - linear.design[..., p:] @ eliminate[:, None]
    moved = -determined.inverse(reduced)[:, None] @ rows.mT
    ratios = [t.sd / e.sd for t, e in zip(problem.triads, even.triads, strict=True)]
    return {
        index: moved[:, :, where, 3 * index : 3 * index + 3] * ratios[index][..., None, :]
        for index, where in enumerate(problem.slices())
    }


def _inverse_where_known(information: Array) -> Array:
    """Inverse (B, k, k) of an information matrix, zero along directions that it says nothing of."""
    scales = outer(np.sqrt(np.maximum(diagonal(information), 1e-300)))
    scaled = np.clip(finite(information / scales), -1.0, 1.0)  # beyond by rounding alone
    inner = np.linalg.pinv(scaled, rcond=1e-12, hermitian=True)
    return np.asarray(inner / scales)


def whole_covariance(linear: Linear, determined: Determined) -> Array:
    """Covariance (B, p + s, p + s) of parameters and shared unknowns."""
    normal = linear.normal
    reduced, _, eliminate = normal.reduced
    params = determined.inverse(reduced)
    cross = -params @ eliminate.mT
    p = normal.size
    shared = inverse(normal.information[..., p:, p:]) - eliminate @ cross
    top = np.concatenate([params, cross], -1)
    return np.concatenate([top, np.concatenate([cross.mT, shared], -1)], -2)


def variance_factors(residual: Array, spread: Array) -> tuple[Array, Array]:
    """s² and degrees of freedom (B, t) of each triad: restricted maximum likelihood."""
    freedom = triad_sums(diagonal(spread))
    return per_freedom(triad_sums(residual**2), freedom), freedom


def variance_factors_at(
    problem: Problem, state: State, determined: Determined
) -> tuple[Array, Array]:
    """The s² and degrees of freedom (B, t) of `analyse`, without the covariance of each station's residuals."""
    linear = problem.linear(state)
    whole, weighed = whole_covariance(linear, determined), linear.weighed
    each = [np.sum(whole * normal[..., :-1], (1, 2)) for _, normal in _triad_normals(weighed)]
    whole_freedom = diagonal(linear.weight) * problem.evidence.include[..., None]
    freedom = triad_sums(whole_freedom) - np.stack(each, -1)
    return per_freedom(triad_sums(weighed[..., -1] ** 2), freedom), freedom


def _triad_normals(weighed: Array) -> Iterator[tuple[slice, Array]]:
    """Axes of each triad, and sums (B, u, u + 1) over its rows of C⁻¹X times C⁻¹(X ρ), both of (B, n, m, u + 1)."""
    for first in range(0, weighed.shape[-2], 3):
        axes = slice(first, first + 3)
        rows = weighed[:, :, axes].reshape(len(weighed), -1, weighed.shape[-1])
        yield axes, rows[..., :-1].mT @ rows


def per_freedom(squares: Array, freedom: Array) -> Array:
    """Sums of squares per degree of freedom; NaN without any freedom beyond rounding."""
    return np.asarray(squares / np.where(freedom > LEAST_FREEDOM, freedom, np.nan))


def scaled_freedom(freedom: Array, squares: Array) -> Array:
    """Effective degrees of freedom tr(S)² / tr(S²); none where tr(S²) is left by rounding alone."""
    return np.asarray(freedom**2 / np.where(squares > LEAST_FREEDOM, squares, np.inf))


def triad_sums(values: Array) -> Array:
    """Sums (B, t) over the stations and axes of each triad, of values (B, n, m)."""
    by_triad = values.reshape(*values.shape[:-1], values.shape[-1] // 3, 3)
    return np.asarray(np.sum(by_triad, (1, 3)))


def triad_squares(spread: Array) -> Array:
    """Sums (B, t) of the squares of each triad's own blocks of a spread (B, n, m, m)."""
    blocks = [spread[..., k : k + 3, k : k + 3] for k in range(0, spread.shape[-1], 3)]
    return np.stack([np.sum(block**2, (1, 2, 3)) for block in blocks], -1)


def effective_freedom(problem: Problem, state: State, analysis: Analysis) -> Array:
    """Degrees of freedom (B, t) of the χ² that s² times them follows: tr(S)² / tr(S²).

    S = C⁻¹ - C⁻¹X V XᵀC⁻¹ is the covariance of a triad's whitened residuals, of all stations. It is
    a projection where references are exact; else uncertain angles take a share of some residuals,
    and s² scatters less than its `freedom` says. Reference: F. E. Satterthwaite, Biometrics
    Bulletin 2, 110 (1946).
    """
    return scaled_freedom(analysis.freedom, _squares(problem, state, analysis))


def _squares(problem: Problem, state: State, analysis: Analysis) -> Array:
    """tr(S²) (B, t) of `effective_freedom`."""
    if analysis.squares is not None:
        return analysis.squares
    linear = problem.linear(state)
    whole = whole_covariance(linear, analysis.determined)
    weighed, count = linear.weighed[..., :-1], linear.residual.shape[-1]
    inner = linear.weight * problem.evidence.include[..., None, None]
    each = []
    for first in range(0, count, 3):
        axes = slice(first, first + 3)
        rows, block = weighed[..., axes, :], inner[..., axes, axes]
        mixed = np.einsum("bnij,bnjp,bnip->bp", block, rows @ whole[:, None], rows, optimize=True)
        gram = np.einsum("bnip,bniq->bpq", rows, rows, optimize=True) @ whole
        twice = np.einsum("bpq,bqp->b", gram, gram)
        each.append(np.sum(block**2, (1, 2, 3)) - 2 * mixed.sum(-1) + twice)
    return np.stack(each, -1)


def of_stand(problem: Problem, state: State, analysis: Analysis) -> Array:
    """Covariance (B, p, p) from errors of angles that the stand sets at every station, before scaling.

    A station's reading has the covariance C = I + GGᵀ in units of its noise, the columns of G being
    what its unknowns do; those of known angles are meant here.
    """
    if analysis.of_stand is not None:
        return analysis.of_stand
    if not any(problem.evidence.sd[n].any() for n in ("inclination", "azimuth", "toolface")):
        return np.zeros_like(analysis.covariance)
    linear = problem.linear(state)
    return sum_of_squares(moved_by_readings(linear, analysis) @ linear.private)


def moved_by_readings(linear: Linear, analysis: Analysis) -> Array:
    """How an error of a station's whitened reading moves the parameters (B, n, p, m)."""
    p = linear.size
    if analysis.influence is not None:
        return np.asarray(analysis.influence[:, :, :p])
    rows, information = linear.weighed[..., :-1].mT, linear.normal.information
    cross = np.linalg.solve(information[:, p:, p:], information[:, p:, :p])
    return analysis.covariance[:, None] @ (rows[:, :, :p] - cross.mT[:, None] @ rows[:, :, p:])


def sum_of_squares(effect: Array) -> Array:
    """Covariance (B, p, p) of what independent errors of unit size do (B, n, p, a)."""
    return np.asarray(np.einsum("bnia,bnja->bij", effect, effect, optimize=True))


def completed(problem: Problem, state: State, analysis: Analysis) -> Analysis:
    """The analysis with all that can be known of it."""
    return replace(
        analysis,
        squares=_squares(problem, state, analysis),
        of_stand=of_stand(problem, state, analysis),
    )


def station_misfit(analysis: Analysis) -> tuple[Array, Array]:
    """Misfit d² (B, n) of every station, χ² when all is as declared, and its degrees of freedom.

    Directions of a station's readings that nothing tests (share below `TESTED`) do not count.
    """
    back, freedom = tested_inverse(analysis.spread)
    along = _along(back, analysis.residual)
    if along.shape[-1] == 3:
        return dot(analysis.residual, along), freedom
    return np.sum(analysis.residual * along, -1), freedom


def left_out_residual(analysis: Analysis) -> Array:
    """Whitened residual (B, n, m) of each station against the fit without it: spread⁺ C⁻¹ρ.

    Exact for a linear problem. Directions of a station's readings that nothing else tests have none.
    """
    return _along(tested_inverse(analysis.spread)[0], analysis.residual)


def left_out_variances(
    problem: Problem, state: State, analysis: Analysis, tool: Ints, station: Ints
) -> tuple[Array, Array]:
    """s² and degrees of freedom (k, t) of each triad in the fits of some tools (k,), each without one station (k,).

    Exact for a linear problem: a station left out moves the residuals of the others by -S_ji S_ii⁺ C⁻¹ρ, S being the
    covariance of all residuals. s² is NaN where the others leave no freedom.
    """
    linear, squares, freedom = problem.linear(state), [], []
    weighed, whole = linear.weighed, whole_covariance(linear, analysis.determined)
    for index, (axes, normal) in enumerate(_triad_normals(weighed)):
        factor, left = np.nan_to_num(analysis.variance_factor[:, index]), analysis.freedom[:, index]
        parts = [
            _shares_of_stations(weighed[t, s], whole[t], normal[t], analysis.spread[t, s], axes)
            for t, s in _blocks(tool, station)
        ]
        each = [np.concatenate(part) for part in zip(*parts, strict=True)]
        squares.append((factor * left)[tool] - each[0])
        freedom.append(left[tool] - each[1])
    rest = np.stack(freedom, -1)
    return np.maximum(per_freedom(np.stack(squares, -1), rest), 0.0), rest


def _blocks(tool: Ints, station: Ints) -> Iterator[tuple[Ints, Ints]]:
    """Tools (k,) and stations (k,), so many at once that their matrices fit the cache."""
    for first in range(0, len(tool), LEFT_OUT_AT_ONCE):
        yield tool[first : first + LEFT_OUT_AT_ONCE], station[first : first + LEFT_OUT_AT_ONCE]


def _shares_of_stations(
    weighed: Array, whole: Array, normal: Array, spread: Array, axes: slice
) -> tuple[Array, Array]:
    """Shares of stations (k,), each left out, in the sum of squares and degrees of freedom of a triad, its `axes`.

    By the rows C⁻¹ (X ρ) (k, m, p + 1) of the station and their products `normal` (k, p, p + 1) over all stations.
    """
    rows, residual, back = weighed[..., :-1], weighed[..., -1:], _inverse_of_tested(spread)[0]
    reach = rows @ whole
    moved = reach.mT @ (back @ residual)
    gram, before = normal[..., :-1], normal[..., -1:]
    itself = residual[:, axes] + rows[:, axes] @ moved
    change = np.sum(moved * (2 * before + gram @ moved), (-2, -1))
    cross = reach @ rows[:, axes].mT
    inner = reach @ gram @ reach.mT - cross @ cross.mT
    trace = np.trace(spread[:, axes, axes], axis1=-2, axis2=-1)
    return np.sum(itself**2, (-2, -1)) - change, trace + np.sum(back * inner, (-2, -1))


def by_triad(analysis: Analysis) -> list[Analysis]:
    """The residuals of each triad by itself, with their covariance."""
    residual, spread = analysis.residual, analysis.spread
    axes = [slice(first, first + 3) for first in range(0, residual.shape[-1], 3)]
    return [
        replace(analysis, residual=residual[..., each], spread=spread[..., each, each])
        for each in axes
    ]


def _along(back: Array, residual: Array) -> Array:
    """Products (B, n, m) of matrices (B, n, m, m) with residuals; station by station where the first are held once."""
    if is_once(back):
        return np.asarray((np.moveaxis(residual, 1, 0) @ back[0].mT).swapaxes(0, 1))
    return np.asarray((back @ residual[..., None])[..., 0])


def tested_inverse(spread: Array) -> tuple[Array, Array]:
    """Inverse (B, n, m, m) along the directions that are tested, and their number (B, n)."""
    if is_once(spread):
        back, freedom = _inverse_of_tested(spread[:1])
        return repeated(back, len(spread)), repeated(freedom, len(spread))
    if spread.shape[-1] == 6 and not spread[..., :3, 3:].any():  # no error moves both triads
        each = [_inverse_of_tested(spread[..., k : k + 3, k : k + 3]) for k in (0, 3)]
        back = np.zeros(spread.shape)
        back[..., :3, :3], back[..., 3:, 3:] = each[0][0], each[1][0]
        return back, each[0][1] + each[1][1]
    return _inverse_of_tested(spread)


def _inverse_of_tested(spread: Array) -> tuple[Array, Array]:
    """The same, whatever the members and the triads have in common."""
    three = spread.shape[-1] == 3
    back = inverse_of_three(spread) if three else inverse(spread)
    freedom = np.full(spread.shape[:-2], float(spread.shape[-1]))
    with np.errstate(invalid="ignore", over="ignore"):
        some = ~(np.sum(back**2, (-1, -2)) < TESTED**-2)  # else no eigenvalue is nearer to zero
    if three:
        some |= ~are_positive(spread)
    elif not _all_positive(spread[~some]):
        some[...] = True
    if some.any():
        values, vectors = eigen(spread[some])
        tested = values > TESTED
        along = vectors * quotient(np.ones_like(values), values, tested)[:, None]
        back[some], freedom[some] = along @ vectors.mT, np.count_nonzero(tested, -1)
    return back, freedom


def _all_positive(spread: Array) -> bool:
    """Whether no matrix has a negative eigenvalue: a robust fit may leave a variance below zero."""
    try:
        np.linalg.cholesky(spread)
    except np.linalg.LinAlgError:
        return False
    return True


def without_station(problem: Problem, state: State, analysis: Analysis) -> Array:
    """Change (B, n, p) of the parameters when one station is left out, for each station.

    Exact for a linear problem: Cov Xᵀ C⁻¹ spread⁺ C⁻¹ρ, every term as the fit has it.
    Directions of a station's readings that nothing else tests are left as they are.
    """
    linear = problem.linear(state)
    if analysis.influence is not None:
        p = linear.size
        leverage = linear.design @ analysis.influence
        stay = inverse(np.eye(leverage.shape[-1]) + leverage) @ linear.residual[..., None]
        return np.asarray(-(analysis.influence[:, :, :p] @ stay)[..., 0])
    whole = whole_covariance(linear, analysis.determined)[:, : linear.size]
    pulled = left_out_residual(analysis)
    pulled = np.einsum("bnmu,bnm->bnu", linear.weighed[..., :-1], pulled)
    return np.asarray(np.einsum("bpu,bnu->bnp", whole, pulled))


def candidates(problem: Problem, state: State, triads: list[int]) -> dict[str, Array]:
    """Directions (B, p) of parameter space that have a name: turns and scales of some triads.

    Those in proportion to a power of temperature follow, named `…-temperature-k`.
    """
    powers = range(1, 1 + min(problem.triads[t].model.basis.order for t in triads))
    courses = {name: [f"{name}-temperature-{power}" for power in powers] for name in CHANGES}
    names = [*CHANGES, *chain(*courses.values())]
    directions = {name: np.zeros_like(state.params) for name in names}
    for triad in triads:
        where, model = problem.slices()[triad], problem.triads[triad].model
        steady = changed(model, state.params[:, where])
        for name, direction in zip(CHANGES, np.moveaxis(steady, 1, 0), strict=True):
            directions[name][:, where] = direction
            for power, course in enumerate(courses[name], 1):
                directions[course][:, where] = model.with_course(direction, power)
    return directions


def changed(model: Model, params: Array) -> Array:
    """Changes (B, 4, p) of the parameters (B, p) by those of all fields in `CHANGES`."""
    return tangent(model, params[:, None], np.stack([*CHANGES.values()]))


def tangent(model: Model, params: Array, change: Array) -> Array:
    """Change of the parameters (..., p) when all fields are turned or scaled, per `TANGENT_STEP`."""
    return np.asarray((model.transformed(params, change) - params) / TANGENT_STEP)


def free_share(determined: Determined, directions: Array) -> Array:
    """Shares (B, c), 0…1, of directions (B, c, p) of parameter space that lie in the free subspace."""
    scaled = directions * determined.norms[:, None]
    inside, total = np.sum((scaled @ determined.null()) ** 2, -1), np.sum(scaled**2, -1)
    return quotient(inside, total, total > 0)


def marginal_rank(determined: Determined, where: slice) -> Ints:
    """Rank (B,) of one triad: its size less the dimension of the free subspace as seen by it."""
    seen = np.linalg.svd(determined.null()[..., where, :], compute_uv=False)
    return np.asarray(where.stop - where.start - np.sum(seen > LEAST_SHARE, -1))


def settle_gauge(problem: Problem, state: State, determined: Determined) -> State:
    """Put free directions where they belong by convention, whatever solver or model came here.

    Free rotation: the gain's polar factor has none. Free scale: the mean strength of the field
    is the nominal one.
    """
    every = list(range(len(problem.triads)))
    each = np.zeros((len(state.params), len(every), len(CHANGES), state.params.shape[-1]))
    for triad, where in enumerate(problem.slices()):
        each[:, triad, :, where] = changed(problem.triads[triad].model, state.params[:, where])
    sets, moved = [[triad] for triad in every], each
    if len(every) > 1:
        sets, moved = [every, *sets], np.concatenate([each.sum(1, keepdims=True), each], 1)
    share = free_share(determined, moved.reshape(len(each), -1, each.shape[-1]))
    free = share.reshape(moved.shape[:-1]) > COUPLED
    for index, triads in enumerate(sets):
        turned = free[:, index, : len(ROTATIONS)]
        if turned.any():
            turn = _polar_turn(problem, state, triads[0], turned)
            state = _turn(problem, state, triads, turn)
    scaled = free[:, -len(every) :, -1]
    for triad in every:
        if scaled[:, triad].any():
            state = _rescale(problem, state, triad, scaled[:, triad])
    return readjusted(problem, state)


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def readjusted(problem: Problem, state: State) -> State:
    """The state with stations' and groups' own unknowns at their best for the parameters."""
    for _ in range(4):
        linear = problem.linear(state)
        normal = linear.normal
        fixed = linear.size + len(problem.evidence.constants)
        step = np.zeros((len(state.params), linear.design.shape[-1]))
        groups = inverse(normal.information[:, fixed:, fixed:])
        step[:, fixed:] = -(groups @ normal.gradient[:, fixed:, None])[..., 0]
        turned, private = np.abs(step).max(initial=0.0), linear.private_step(step)
        if max(turned, np.abs(private - linear.held).max(initial=0.0)) < AT_REST:
            break
        state = problem.move(state, linear, step)
        if max(turned, np.abs(private * linear.loose).max(initial=0.0)) < AT_REST:
            break
    return state


def _rescale(problem: Problem, state: State, triad: int, free: Bools) -> State:
    """Bring the mean strength of a triad of free scale to the nominal one."""
    name = ("gravity", "field")[triad]
    known = problem.evidence.known[name]
    nominal = np.nan_to_num(known).sum(-1) / np.maximum((~np.isnan(known)).sum(-1), 1)
    factor = np.where(free, nominal / problem.constant(state, name).mean(-1), 1.0)
    where, params = problem.slices()[triad], state.params.copy()
    matrix = factor[:, None, None] * np.eye(3)
    params[:, where] = problem.triads[triad].model.transformed(params[:, where], matrix)
    departures = state.departures.copy()
    if name in problem.evidence.absent:
        place = problem.evidence.absent.index(name)
        base = problem.constant(state, name) - departures[..., place]
        departures[..., place] = factor[:, None] * problem.constant(state, name) - base
    return replace(state, params=params, departures=departures)


def _polar_turn(problem: Problem, state: State, triad: int, free: Bools) -> Array:
    """Rotation (B, 3, 3) about the free axes that leaves the triad's gain without rotation."""
    where = problem.slices()[triad]
    chosen = problem.triads[triad]
    gain = chosen.model.slope(state.params[:, where], chosen.raw, problem.temperature).mean(1)
    return unrotating(np.where(np.isfinite(gain), gain, np.eye(3)), free)


def unrotating(gain: Array, free: Bools) -> Array:
    """Turn (..., 3, 3) about the free axes (..., 3) that leaves a gain (..., 3, 3) without rotation.

    Definition: the transposed polar factor where all axes are free; else its part about z alone.
    """
    polar = nearest_rotation(gain)
    about_z = np.arctan2(polar[..., 0, 1] - polar[..., 1, 0], polar[..., 0, 0] + polar[..., 1, 1])
    along = np.where(free[..., 2], about_z, 0.0)[..., None] * np.array([0.0, 0.0, 1.0])
    whole = polar.mT
    return np.where(np.all(free, -1)[..., None, None], whole, rotation(along))


def _turn(problem: Problem, state: State, triads: list[int], turn: Array) -> State:
    """The state with some triads turned; with all of them the stations turn too."""
    params = state.params.copy()
    for triad in triads:
        where = problem.slices()[triad]
        params[:, where] = problem.triads[triad].model.transformed(params[:, where], turn)
    whole = len(triads) == len(problem.triads)
    attitude = turn[:, None] @ state.attitude if whole else state.attitude
    return replace(state, params=params, attitude=attitude)


def scatter_ratios(problem: Problem, state: State, analysis: Analysis) -> dict[str, Array]:
    """New variance (B,) of each scatter over its present one; REML has the fixed point at one.

    Definition: with q = P y and P the covariance of the weighed residuals, qᵀVq / tr(PV) for the
    component V = GGᵀ of unit variance. One where nothing tests a component.
    """
    ratios = {}
    for name, columns in problem.scatter_columns(state).items():
        share = problem.evidence.scatter[name][..., None]
        share = share / np.maximum(share.max(1, keepdims=True), LEAST_SCATTER)
        along = np.einsum("bnmk,bnm->bnk", columns, analysis.residual) * share
        tested = columns * share[..., None]
        whole = np.einsum("bnmk,bnml,bnlk->b", tested, analysis.spread, tested, optimize=True)
        square = np.sum(along**2, (-1, -2))
        ratio = np.where(whole > 0, square / np.where(whole > 0, whole, 1.0), 1.0)
        ratios[name] = np.clip(np.nan_to_num(ratio, nan=1.0), 1 / LARGEST_CHANGE, LARGEST_CHANGE)
    return ratios


def with_scatter(problem: Problem, state: State, ratios: dict[str, Array]) -> Problem:
    """The problem with each scatter's variance times a ratio (B,).

    A strength scatters no more than the noise of its triad: else nothing would be left to tell
    that noise by.
    """
    scatter = {
        name: np.maximum(value * np.sqrt(ratios[name])[:, None], LEAST_SCATTER)
        for name, value in problem.evidence.scatter.items()
    }
    sizes = [p.strength.mean(-1) for p in problem.predictions(state)]
    for name, triad, size in zip(("gravity", "field"), problem.triads, sizes, strict=False):
        if name in scatter:
            noise = np.sqrt(np.mean(triad.sd**2, (1, 2))) / size
            scatter[name] = np.minimum(scatter[name], np.maximum(noise, LEAST_SCATTER)[:, None])
    return problem.with_noise(problem.triads, replace(problem.evidence, scatter=scatter))


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def log_evidence(problem: Problem, state: State) -> Array:
    """Logarithm (B,) of the probability of the readings, parameters integrated out.

    Definition: Laplace's approximation at the fit, exact for a linear problem. Parameters without
    a prior get one of `PIN` times the field, the same in all models that are compared; a free
    direction then counts the same in all.
    """
    linear = problem.linear(state)
    include = problem.evidence.include
    noise = sum((np.log(t.sd).sum(-1) * include).sum(-1) for t in problem.triads)
    private = -np.linalg.slogdet(linear.core)[1].sum(-1)
    known = diagonal(problem.prior.precision)
    pin = np.zeros((len(known), linear.prior.shape[-1]))
    for name, where in zip(("gravity", "field"), problem.slices(), strict=False):
        size = problem.constant(state, name).mean(-1)[:, None]
        pin[:, where] = (PIN * size) ** -2
    information = linear.normal.information + pin[:, :, None] * np.eye(pin.shape[-1])
    prior = np.log(np.where(known > 0, known, pin[:, : linear.size])).sum(-1)
    determinant = np.linalg.slogdet(information)[1]
    whole = 2 * noise + private + determinant - prior + linear.normal.cost
    return np.asarray(-0.5 * whole)
