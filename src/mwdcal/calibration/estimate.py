"""From readings to a fitted problem: evidence, noise, weights, gauge, uncertainty."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import ModuleType

import numpy as np

from mwdcal.calibration.methods import (
    EVIDENCE,
    Solved,
    evidence_of,
    flat,
    solve,
    with_stand_errors,
    without,
)
from mwdcal.calibration.options import Options
from mwdcal.calibration.prior import prior_of
from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.estimation.batch import held_once, put, take
from mwdcal.estimation.minimisers import (
    closed_form,
    closed_form_drift,
    stand_factors,
    uncertain_stand,
)
from mwdcal.estimation.problem import ANGLES, Evidence, Problem, State, Triad
from mwdcal.estimation.resetting import set_apart, with_share
from mwdcal.estimation.solvers import (
    LOSSES,
    Determined,
    Status,
    consistency,
    inflation,
    stepped,
    weight,
    weighted,
)
from mwdcal.estimation.uncertainty import (
    FIRST_SCATTER,
    LEAST_SCATTER,
    Analysis,
    analyse,
    completed,
    determined_apart,
    per_freedom,
    sandwich,
    scatter_ratios,
    settle_gauge,
    station_misfit,
    triad_squares,
    triad_sums,
    variance_factors_at,
    with_scatter,
)
from mwdcal.geometry.vectors import Array, Bools, Ints, diagonal, over_stations
from mwdcal.sensor.models import Basis, Factors, Polynomial, Whole, restricted

LEAST_NOISE = 1e-9
"""Smallest noise, as a share of the signal, that an estimate from residuals may reach."""
TEMPERATURE_STEP = 10.0
"""The range of temperatures that a model is conditioned for ends at multiples of this, °C."""
ROBUST_ROUNDS = 40
MOST_STEPS_IN_TURN = 200
"""Steps of all fits of a run after which weights or noise that have not settled never will."""
MOST_AHEAD = 3.0
"""Largest power of s² that an estimate of the noise takes at once."""
NOISE_ROUNDS = 8
"""Most repetitions of fit and estimate of the noise."""
ROUNDS_ANEW = 40
"""Most repetitions of the same with more unknowns in the fit: in simulations all have settled by then."""
SETTLED = 1e-3
"""Change of noise and station weights, as a share, at which weighing and fitting in turn ends."""
FEWEST_CHECKS = 20
"""Checks of the parameters that a run has to have for its scatter to be estimated."""
SCATTER_ROUNDS = 16
"""Most repetitions where a scatter from station to station is estimated too…"""
SCATTER_SETTLED = 0.02
"""…and the change of it, as a share, at which they end."""
ROUNDS_WITHOUT = 3
"""Rounds in which noise is estimated without stations that are left out."""


@dataclass(frozen=True)
class Fit:
    """A batch of fitted problems: shapes lead with the batch axis B.

    `noise` (B, triads) is the estimated standard deviation, NaN where it was declared;
    `status` holds `Status` codes; `trust` (B, n) are the weights of a robust fit, else 1.
    """

    problem: Problem
    state: State
    status: Ints
    iterations: Ints
    noise: Array
    trust: Array
    analysis: Analysis


def model_of(
    kind: str, order: int, raw: Array, temperature: Array, include: Array, curved: bool = False
) -> Whole:
    """A conditioned model for readings (B, n, 3): centred, scaled, Chebyshev in temperature.

    The range of temperatures is common to the batch: see `temperature_ranges`.
    """
    ranges = temperature_ranges(temperature)
    low, high = float(ranges[:, 0].min()), float(ranges[:, 1].max())
    half = (high - low) / 2 or 1.0
    basis = Basis(order, (low + high) / 2, half, chebyshev=True)
    if kind == "factors":
        return Factors(basis)
    weight = include[..., None] / include.sum(-1)[:, None, None]
    centre = over_stations(raw * weight)[..., None, :]
    radius = np.sqrt(np.sum((raw - centre) ** 2 * weight, (-2, -1)))
    radius = np.where(radius > 0, radius, 1.0)
    return Polynomial(
        basis, centre, np.broadcast_to(radius[:, None, None], centre.shape).copy(), curved
    )


def temperature_ranges(temperature: Array) -> Array:
    """Range (B, 2) of each member's temperatures (B, n), widened to multiples of `TEMPERATURE_STEP`.

    Members of equal range have the same model in a batch as alone.
    """
    low = np.floor(temperature.min(-1) / TEMPERATURE_STEP)
    high = np.ceil(temperature.max(-1) / TEMPERATURE_STEP)
    return np.stack([low, high], -1) * TEMPERATURE_STEP


def _problem(
    readings: Readings, evidence: Evidence, lead: tuple[int, ...], options: Options
) -> tuple[Problem, Bools]:
    """The problem, and which members (B,) are finite.

    Estimation of noise begins at a thousandth of the readings' size. Members with readings that are
    not finite get stand-ins, so that the batch goes on.
    """
    cold = np.zeros(readings.count)
    temperature = flat(cold if readings.temperature is None else readings.temperature, lead)
    temperature = held_once(temperature)
    curved = options.curved
    names = readings.triads
    raws = [flat(getattr(readings, name), lead, 3) for name in names]
    finite = np.all([np.isfinite(raw).all((-1, -2)) for raw in raws], axis=0)
    triads: list[Triad] = []
    for name, raw, order in zip(names, raws, options.orders, strict=False):
        kind, sound = options.kind(order), raw if finite.all() else _sound(raw, finite)
        whole = model_of(kind, order, sound, temperature, evidence.include, name in curved)
        declared = name in readings.sd
        sd = readings.sd[name] if declared else 1e-3 * _size(raw)
        sd = flat(sd, lead, 3) if declared else np.broadcast_to(sd, raw.shape)
        triads.append(Triad(restricted(whole, options.parameters), sound, sd, declared))
    prior = prior_of(options.knowledge, [t.model for t in triads], len(evidence.include))
    problem = Problem(tuple(triads), temperature, evidence, prior)
    _bound_curves(problem, curved)
    return problem, finite


def _sound(raw: Array, finite: Bools) -> Array:
    """Readings with stand-ins of harmless size for members that are not finite."""
    pattern = np.sin(np.arange(raw[0].size) ** 1.5).reshape(-1, 3)
    return np.where(finite[:, None, None], raw, pattern)


def _bound_curves(problem: Problem, curved: Mapping[str, float]) -> None:
    """Give the own-axis terms, the last six of a triad, their prior."""
    for name, strength, where in zip(TRIADS, ("gravity", "field"), problem.slices(), strict=False):
        if name in curved:
            last = np.arange(where.stop - 6, where.stop)
            size = np.nanmean(problem.evidence.known[strength], -1)[:, None]
            problem.prior.precision[:, last, last] += (curved[name] * size) ** -2


def _size(raw: Array) -> Array:
    """Root mean square departure of readings from their mean (B, 1, 1)."""
    mean = over_stations(raw)[..., None, :] / raw.shape[-2]
    size = np.sqrt(np.mean((raw - mean) ** 2, (-2, -1), keepdims=True))
    return np.where(size > 0, size, 1.0)


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def fit(readings: Readings, options: Options | None = None, include: Array | None = None) -> Fit:
    """Fit a run, or a batch of runs (leading axes of the readings, or of `include`).

    `include` (..., n) is 1 for stations that count and 0 for those left out. Nothing is raised for
    a member that cannot be fitted: its `status` says so.
    """
    options = options or Options()
    include = np.ones(readings.count) if include is None else np.asarray(include, float)
    evidence = held_once(_evidence(readings, include, options))
    lead = np.broadcast_shapes(readings.accelerometer.shape[:-1], include.shape)
    problem, finite = _problem(readings, evidence, lead, options)
    closed, good = _special(problem, options, finite)
    if closed is None or not good.any():
        return _general(problem, options, finite)
    if good.all():
        return closed
    rest = np.flatnonzero(~good)
    other = _general(take(problem, rest), options, finite[rest])
    return put(closed, rest, other if closed.analysis.squares is None else with_all(other))


def scatters(readings: Readings, options: Options) -> bool:
    """Whether a scatter from station to station is estimated: in a joint fit that estimates the noise of both.

    It takes groups, and redundancy to tell it from the noise: in runs of eight stations it does harm.
    """
    noisy = not any(name in readings.sd for name in TRIADS) and readings.magnetometer is not None
    wanted = options.scatter and noisy and options.method == "joint"
    return wanted and _checks(readings, options) >= FEWEST_CHECKS


def _checks(readings: Readings, options: Options) -> int:
    """Statements about stations beyond the number of parameters; 0 without a group.

    Definition: strengths and dip, reference angles, and two for each station of a group but its first; the fewest
    of a batch.
    """
    group = np.sort(readings.groups, -1)
    again = np.count_nonzero((group[..., 1:] >= 0) & (np.diff(group, axis=-1) == 0), axis=-1)
    angles = sum(np.count_nonzero(~np.isnan(readings.reference(n)), axis=-1) for n in ANGLES)
    parameters = 12 * sum(1 + order for order in options.orders)
    checks = 3 * readings.count + np.asarray(angles) + 2 * again - parameters
    return int(np.min(np.where(again > 0, checks, 0)))


def _evidence(readings: Readings, include: Array, options: Options) -> Evidence:
    """The part of a run that the options use, with the stand errors and the scatter to be estimated."""
    evidence = EVIDENCE[options.method](evidence_of(readings, include))
    if options.ignore:
        evidence = without(evidence, *options.ignore)
    if options.estimate:
        evidence = with_stand_errors(evidence, options.estimate)
    if scatters(readings, options):
        names = [name for name in ("gravity", "field", "dip") if name not in evidence.absent]
        first = np.full(evidence.include.shape, FIRST_SCATTER)
        evidence = replace(evidence, scatter=dict.fromkeys((*names, "direction"), first))
    return evidence


def _general(problem: Problem, options: Options, finite: Bools) -> Fit:
    """The fit by the method's minimiser, with estimated noise and station weights in turn."""
    solved = solve(problem, None, options)
    iterations, trust = solved.iterations, np.ones(problem.evidence.include.shape)
    determined = _determined(problem, solved.state, solved)
    stage = _Iterate(problem, solved, trust, np.zeros_like(iterations), determined)
    if not _all_declared(problem):
        stage = _estimate_noise(stage, options)
    stage = _set_apart(stage, options)
    if options.robust:
        stage = _downweigh(stage, options)
    return _finished(stage, options, finite, iterations)


def with_noise_anew(result: Fit, options: Options) -> Fit:
    """The fits, and the noise that they estimate, in turn until s² is one; a member that has settled stays."""
    for _ in range(ROUNDS_ANEW):
        scale = _noise_scale(result.analysis, ahead=False)
        scale = np.where(np.isnan(result.noise), 1.0, np.nan_to_num(scale, nan=1.0))
        rest = np.flatnonzero(np.any(np.abs(scale - 1) >= SETTLED, -1))
        if not rest.size:
            break
        part = take(result, rest)
        again = refitted(part, part.problem, part.state, scale[rest], options, anew=True)
        result = put(result, rest, again)
    return result


def refitted(
    result: Fit, problem: Problem, state: State, scale: Array, options: Options, anew: bool = False
) -> Fit:
    """A fit of a problem that has more unknowns than that of `result`, the noise times `scale` (B, triads).

    `anew`: where the fit can estimate the noise on its way, that counts.
    """
    problem = _rescaled(problem, scale)
    finite = result.status != int(Status.NOT_FINITE)
    if result.analysis.squares is not None and uncertain_stand.applies(problem):
        return _refined(result, problem, state, options, anew)
    if form := _form(problem):
        there, analysis, good = form.solution(problem, state)
        if (good & analysis.determined.keep.all(-1)).all():
            once = result.iterations + 1
            trust, status = result.trust, np.where(finite, result.status, int(Status.NOT_FINITE))
            return Fit(problem, there, status, once, _noise(problem), trust, analysis)
    return _refitted_anyhow(result, problem, state, options)


def _refitted_anyhow(result: Fit, problem: Problem, state: State, options: Options) -> Fit:
    """The same by the method's minimiser."""
    finite = result.status != int(Status.NOT_FINITE)
    solved = solve(problem, state, options)
    known = result.analysis.determined
    stage = _Iterate(problem, solved, result.trust, solved.iterations, known)
    return _finished(stage, options, finite, result.iterations + solved.iterations)


def _refined(result: Fit, problem: Problem, state: State, options: Options, anew: bool) -> Fit:
    """The same on a stand of known angles; by the method's minimiser where not all directions are determined."""
    there = uncertain_stand.refined(problem, state, anew)
    problem = _rescaled(problem, there.scale)
    analysis = uncertain_stand.analysis_of(problem, there)
    good = there.good & analysis.finite & (result.status != int(Status.NOT_FINITE))
    status, steps = (
        np.where(good, int(Status.OK), int(Status.NOT_FINITE)),
        result.iterations + there.steps,
    )
    whole = Fit(problem, there.state, status, steps, _noise(problem), result.trust, analysis)
    if good.all():
        return whole
    rest = np.flatnonzero(~good)
    return put(
        whole, rest, with_all(_refitted_anyhow(*take((result, problem, state), rest), options))
    )


def fewer_stations(problem: Problem, left: Bools) -> Problem:
    """The problem without the stations `left` out (B, n)."""
    evidence = problem.evidence
    return replace(problem, evidence=replace(evidence, include=evidence.include * ~left))


def without_stations(result: Fit, left: Bools) -> Fit:
    """The fits without the stations `left` out (B, n), to first order, with noise estimated anew where it was."""
    problem = fewer_stations(result.problem, left)
    state = stepped(problem, result.state, Determined.of(problem, result.state))
    determined = Determined.of(problem, state)
    for _ in range(0 if _all_declared(problem) else ROUNDS_WITHOUT):
        factor, freedom = variance_factors_at(problem, state, determined)
        problem = _rescaled(problem, np.sqrt(np.where(freedom >= 1, factor, np.nan)))
    analysis = analyse(problem, state, determined)
    return replace(result, problem=problem, state=state, analysis=analysis)


def with_all(result: Fit) -> Fit:
    """The fit, of no robust loss, with all that can be known of it where its angles are known with an error."""
    problem, state, analysis = result.problem, result.state, result.analysis
    known = analysis.determined
    if uncertain_stand.applies(problem) and known.keep.all():
        return replace(result, analysis=uncertain_stand.analysed(problem, state, known))
    if stand_factors.applies(problem) and known.clear.all():
        return replace(result, analysis=stand_factors.completed(problem, state, analysis))
    return replace(result, analysis=completed(problem, state, analysis))


def _finished(stage: _Iterate, options: Options, finite: Bools, iterations: Ints) -> Fit:
    """The fit at the end of all turns: by axis where that tells all, with the gauge settled elsewhere."""
    if options.robust or options.separate_solver or not stand_factors.applies(stage.problem):
        return _ended(stage, options, finite, iterations)
    problem, state = stage.problem, stage.solved.state
    determined = stand_factors.determined(problem, state)
    analysis = stand_factors.analysed(problem, state, determined)
    variances = (diagonal(each) for each in (analysis.covariance, analysis.constants))
    good = determined.clear & analysis.finite
    good &= np.all([(each >= 0).all(-1) for each in variances], 0)  # rounding alone makes others
    status = np.where(finite, stage.solved.status, int(Status.NOT_FINITE))
    whole = Fit(problem, state, status, iterations, _noise(problem), stage.trust, analysis)
    if good.all():
        return whole
    rest = np.flatnonzero(~good)
    other = _ended(take(stage, rest), options, finite[rest], iterations[rest])
    return put(whole, rest, other) if good.any() else other


def _ended(stage: _Iterate, options: Options, finite: Bools, iterations: Ints) -> Fit:
    """The same, whatever the problem."""
    problem, solved, trust = stage.problem, stage.solved, stage.trust
    trusted, state = _trusting(problem, trust), solved.state
    determined = _determined(trusted, state, solved)
    if len(state.params) and not determined.keep.all():
        state = settle_gauge(trusted, state, determined)
        determined = _determined(trusted, state, solved)
    analysis, influence = analyse(trusted, state, determined), solved.influence(trusted, state)
    if influence:
        analysis = sandwich(analysis, trusted, state, influence)
    if options.robust:
        analysis = _robustly(analysis, trusted, state, options.robust, trust)
    trusted.memo.clear()
    finite = finite & analysis.finite
    status = np.where(finite, solved.status, int(Status.NOT_FINITE))
    return Fit(trusted, state, status, iterations, _noise(problem), trust, analysis)


def _form(problem: Problem) -> ModuleType | None:
    """The closed form of a problem, without drift or with it, if there is one."""
    forms = () if problem.evidence.scatter else (closed_form, closed_form_drift)
    return next((form for form in forms if form.applies(problem)), None)


def _special(problem: Problem, options: Options, finite: Bools) -> tuple[Fit | None, Bools]:
    """The fit by a shorter way, if there is one, and for which members (B,) it holds."""
    if options.robust or options.separate_solver:
        return None, finite
    if _form(problem) is not None:
        return _closed(problem, finite)
    if uncertain_stand.applies(problem):
        return _on_stand(problem, finite)
    return None, finite


def _on_stand(problem: Problem, finite: Bools) -> tuple[Fit, Bools]:
    """The fit on a stand of known angles, and for which members (B,) it holds: all directions are determined."""
    there = uncertain_stand.solution(problem)
    problem = _rescaled(problem, there.scale)
    analysis = uncertain_stand.analysis_of(problem, there)
    good = there.good & finite & analysis.finite
    status = np.where(good, int(Status.OK), int(Status.NOT_FINITE))
    trust = np.ones(problem.evidence.include.shape)
    return Fit(problem, there.state, status, there.steps, _noise(problem), trust, analysis), good


def _closed(problem: Problem, finite: Bools) -> tuple[Fit, Bools]:
    """The fit in closed form, and for which members (B,) it holds: all directions are determined."""
    at, form = closed_form.start(problem), _form(problem) or closed_form
    state, analysis, good = form.solution(problem, at)
    good = good & analysis.determined.keep.all(-1)
    if form is closed_form and good.any() and not _all_declared(problem):
        quieter = _rescaled(problem, np.sqrt(analysis.variance_factor))
        analysis = closed_form.rescaled(problem, quieter, analysis)
        problem = quieter
    free, moving = np.array([not triad.declared for triad in problem.triads]), good[:, None]
    for _ in range(NOISE_ROUNDS if problem.walks else 0):
        if not (moving & free).any():
            break
        scale = np.where(moving & free, np.sqrt(analysis.variance_factor), 1.0)
        problem = _rescaled(problem, scale)
        state, analysis, settled = form.solution(problem, at)
        good &= settled
        moving = moving & np.any(np.abs(scale - 1) >= SETTLED, -1, keepdims=True)
    sound = finite & np.isfinite(state.params).all(-1)
    status = np.where(sound, int(Status.OK), int(Status.NOT_FINITE))
    trust = np.ones(problem.evidence.include.shape)
    once = np.ones(len(status), int)
    return Fit(problem, state, status, once, _noise(problem), trust, analysis), good


def _all_declared(problem: Problem) -> bool:
    return all(triad.declared for triad in problem.triads)


def _noise(problem: Problem) -> Array:
    """Estimated noise (B, triads) of one reading, NaN where it was declared."""
    return np.stack([np.where(t.declared, np.nan, t.sd[:, 0, 0]) for t in problem.triads], -1)


def _determined(problem: Problem, state: State, solved: Solved) -> Determined:
    """Which directions the evidence that the method uses determines."""
    if solved.known:
        return determined_apart(problem, state, solved.known)
    if stand_factors.applies(problem):
        determined = stand_factors.determined(problem, state)
        if determined.clear.all():
            return determined
    return Determined.of(problem, state)


def _robustly(
    analysis: Analysis, problem: Problem, state: State, loss: str, trust: Array
) -> Analysis:
    """The analysis of a fit with station weights: they cost information of the data, none of the prior."""
    freedom = _tested(station_misfit(analysis)[1])
    louder = np.sqrt([inflation(loss, k) for k in freedom])[:, None]
    wider = analyse(_with_inflated_noise(problem, louder), state, analysis.determined)
    return replace(
        analysis,
        covariance=wider.covariance,
        constants=wider.constants,
        effects=wider.effects,
        of_settings=wider.of_settings,
        variance_factor=_bounded_factor(analysis, trust, loss, freedom),
    )


def _bounded_factor(analysis: Analysis, trust: Array, loss: str, freedom: Array) -> Array:
    """s² (B, t) of a fit with station weights `trust`, from the pulls w d that they bound."""
    squares = triad_sums(analysis.residual**2 * trust[..., None])
    share = np.array([consistency(loss, k) for k in freedom])[:, None]
    return np.asarray(per_freedom(squares, analysis.freedom) / share)


@dataclass(frozen=True)
class _Iterate:
    """Where weighing and fitting in turn have come to: problem, solution, station weights (B, n).

    `steps` (B,) counts the steps of all fits so far; `determined` is known of a state nearby.
    """

    problem: Problem
    solved: Solved
    trust: Array
    steps: Ints
    determined: Determined


def _alternate(
    stage: _Iterate, rounds: int, turn: Callable[[_Iterate], tuple[_Iterate, Bools]]
) -> tuple[_Iterate, Bools]:
    """The stage after turns that also say who has settled, and who did: each member ends as if it were alone."""
    whole, active = stage, np.arange(len(stage.trust))
    ended = np.zeros(len(active), bool)
    for _ in range(rounds):
        stage, settled = turn(stage)
        ended[active[settled]] = True
        if settled.all():
            break
        if settled.any():
            done, rest = np.flatnonzero(settled), np.flatnonzero(~settled)
            whole = put(whole, active[done], take(stage, done))
            stage, active = take(stage, rest), active[rest]
    return (stage if len(active) == len(ended) else put(whole, active, stage)), ended


def _set_apart(stage: _Iterate, options: Options) -> _Iterate:
    """The stage with stations of a setting set apart where residuals clearly show it, and noise anew."""
    evidence = stage.problem.evidence
    if options.separate_solver or not (evidence.assumed and evidence.set_together.any()):
        return stage
    problem, state = stage.problem, stage.solved.state
    shown = np.flatnonzero(set_apart(problem, state, _analysed(problem, state, options)))
    if not shown.size:
        return stage
    part = take(stage, shown)
    evidence = replace(part.problem.evidence, apart=np.ones(len(shown)))
    problem = part.problem.with_noise(part.problem.triads, evidence)
    part = replace(part, problem=problem, solved=solve(problem, part.solved.state, options))
    return put(stage, shown, _estimate_noise(part, options))


def _estimate_noise(stage: _Iterate, options: Options) -> _Iterate:
    """Variance per triad by restricted maximum likelihood, fit and estimate in turn.

    A triad without redundancy keeps its start: its residuals are rounding, and say nothing. Where every direction is
    clearly determined, the first turns take one step of the fit each: whole fits then have little left to do.
    """
    evidence = stage.problem.evidence
    slow = bool(evidence.scatter) or bool(evidence.apart.any())
    rounds, least = (SCATTER_ROUNDS, SCATTER_SETTLED) if slow else (NOISE_ROUNDS, SETTLED)
    clear = np.flatnonzero(stage.determined.clear)
    if clear.size and not options.separate_solver:
        turn = partial(_noise_turn, options=options, least=least, whole=False)
        part, settled = _alternate(take(stage, clear), rounds, turn)
        if settled.any():
            stage = put(stage, clear[settled], take(part, np.flatnonzero(settled)))
    turn = partial(_noise_turn, options=options, least=least, whole=True)
    return _alternate(stage, rounds, turn)[0]


def _noise_turn(
    now: _Iterate, options: Options, least: float, whole: bool
) -> tuple[_Iterate, Bools]:
    """The noise as residuals have it, then a fit with it, or a step; and who has settled."""
    evidence, at = now.problem.evidence, now.solved.state
    free = [i for i, triad in enumerate(now.problem.triads) if not triad.declared]
    analysis = _analysed(now.problem, at, options, None if whole else now.determined)
    scale = _noise_scale(analysis, ahead=not (whole or evidence.scatter or evidence.apart.any()))
    problem, solved, steps = _rescaled(now.problem, scale), now.solved, now.steps
    settled = ~np.any(np.abs(scale[:, free] - 1) >= least, -1)
    if evidence.scatter:
        ratios = scatter_ratios(now.problem, at, analysis)
        problem = with_scatter(problem, at, ratios)
        settled &= _steady(now.problem, problem)
    if evidence.apart.any():
        problem = with_share(problem, at, analysis)
        before, share = (p.evidence.apart for p in (now.problem, problem))
        settled &= np.abs(share - before) <= SCATTER_SETTLED * before
    if not whole:
        by_axis = stand_factors.applies(now.problem)
        moved = (
            stand_factors.stepped(now.problem, at)
            if by_axis
            else stepped(now.problem, at, now.determined)
        )
        solved = replace(solved, state=moved)
    elif options.method != "swarm":
        solved = solve(problem, at, options)
        steps = steps + solved.iterations
        settled |= steps > MOST_STEPS_IN_TURN
    return replace(now, problem=problem, solved=solved, steps=steps), settled


def _analysed(
    problem: Problem, state: State, options: Options, known: Determined | None = None
) -> Analysis:
    """The analysis of fits on their way, some directions of which may be `known` to be determined."""
    if not options.separate_solver and stand_factors.applies(problem):
        determined = stand_factors.determined(problem, state)
        if determined.clear.all():
            return stand_factors.analysed(problem, state, determined)
    return analyse(problem, state, known)


def _noise_scale(analysis: Analysis, ahead: bool) -> Array:
    """The next estimate of the noise over the present one (B, t); NaN where nothing is left to tell it by.

    Going `ahead` takes the step of Fisher's scoring, to first order: where uncertain angles take a share of the
    residuals, s² alone comes closer only slowly. C⁻¹ is taken as that of each station by itself.
    """
    freedom, squares = analysis.freedom, triad_squares(analysis.spread)
    factor = np.where(freedom >= 1, analysis.variance_factor, np.nan)
    power = np.clip(freedom / np.maximum(squares, 1e-9), 1.0, MOST_AHEAD) if ahead else 1.0
    return np.asarray(factor ** (power / 2))


def _steady(old: Problem, new: Problem) -> Bools:
    """Members (B,) whose scatter has settled: changed little, or is zero."""
    before, now = (p.evidence.scatter for p in (old, new))
    each = [
        (np.abs(now[name] / value - 1).max(-1) < SCATTER_SETTLED)
        | (now[name].max(-1) < 10 * LEAST_SCATTER)
        for name, value in before.items()
    ]
    return np.asarray(np.all(each, 0))


def _downweigh(stage: _Iterate, options: Options) -> _Iterate:
    """Weigh the stations by their misfit and fit in turn."""
    loss, declared = options.robust or LOSSES[0], _all_declared(stage.problem)

    def turn(now: _Iterate) -> tuple[_Iterate, Bools]:
        problem, solved = now.problem, now.solved
        weighed = _trusting(problem, now.trust)
        analysis = analyse(weighed, solved.state)
        square, freedom = station_misfit(analysis)
        square = square / now.trust
        excess = _typical(square, freedom)
        excess = np.maximum(excess, 1.0) if declared else excess
        trust = weight(loss, square / excess[:, None], freedom)
        if not declared:
            factor = _bounded_factor(analysis, now.trust, loss, _tested(freedom))
            problem = _rescaled(problem, np.sqrt(factor))
            if problem.evidence.scatter:
                share = np.array([weighted(loss, k) for k in _tested(freedom)])
                ratios = scatter_ratios(weighed, solved.state, analysis)
                ratios = {n: r / share for n, r in ratios.items()}
                problem = with_scatter(problem, solved.state, ratios)
        solved = solve(_trusting(problem, trust), solved.state, options)
        steps = now.steps + solved.iterations
        settled = ~np.any(np.abs(trust / now.trust - 1) >= SETTLED, -1)
        now = _Iterate(problem, solved, trust, steps, now.determined)
        return now, settled | (steps > MOST_STEPS_IN_TURN)

    return _alternate(stage, ROBUST_ROUNDS, turn)[0]


def _typical(square: Array, freedom: Array) -> Array:
    """Misfit (B,) of the median station, over what is to be expected of good ones."""
    from scipy.special import chdtri

    ratio = square / chdtri(np.maximum(freedom, 1.0), 0.5)
    ratio = np.where(freedom > 0, ratio, np.nan)
    nothing = np.isnan(ratio).all(-1, keepdims=True)
    return np.asarray(np.nanmedian(np.where(nothing, 1.0, ratio), -1))


def _tested(freedom: Array) -> Array:
    """Mean degrees of freedom (B,) of the stations that anything tests, to a tenth."""
    mean = freedom.sum(-1) / np.maximum(np.count_nonzero(freedom, axis=-1), 1)
    return np.asarray(np.maximum(np.round(mean, 1), 1.0))


def _trusting(problem: Problem, trust: Array) -> Problem:
    """The problem with the covariance of each station, readings and angles, over its weight."""
    if (trust == 1).all():
        return problem
    return _with_inflated_noise(problem, 1 / np.sqrt(trust))


def _with_inflated_noise(problem: Problem, factor: Array) -> Problem:
    """The problem with the readings and angles of each station noisier by a factor (B, n)."""
    triads = tuple(replace(t, sd=t.sd * factor[..., None]) for t in problem.triads)
    evidence = problem.evidence
    lone = {n: np.where(evidence.alone(n), factor, 1.0) for n in ANGLES}
    sd = {n: s * lone.get(n, 1.0) for n, s in evidence.sd.items()}
    scatter = {n: s * factor for n, s in evidence.scatter.items()}
    return problem.with_noise(triads, replace(evidence, sd=sd, scatter=scatter))


def _rescaled(problem: Problem, scale: Array) -> Problem:
    """The problem with the noise of triads that declare none times `scale` (B, triads)."""
    factors = np.moveaxis(np.where(np.isfinite(scale), scale, 1.0), -1, 0)[..., None, None]
    triads = tuple(
        t if t.declared else replace(t, sd=_noise_times(t, factor))
        for t, factor in zip(problem.triads, factors, strict=True)
    )
    return problem.with_noise(triads, problem.evidence)


def _noise_times(triad: Triad, factor: Array) -> Array:
    """The noise of a triad times a factor (B, 1, 1), held once for all readings where it is alike."""
    level = closed_form.noise_level(triad)
    least = LEAST_NOISE * _size(triad.raw)
    sd = np.maximum((triad.sd if level is None else level) * factor, least)
    return np.broadcast_to(sd, triad.sd.shape)
