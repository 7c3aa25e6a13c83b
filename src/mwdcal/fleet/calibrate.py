"""A batch of tools calibrated at once: one fit for all, and each tool checked as if it were alone.

Every tool of a `Batch` has the same number of stations and the same kinds of evidence. What
`calibrate` would refuse is refused here with the same words: a screen of array operations
picks the suspects, and the check of a single run decides and speaks. What `calibrate` leaves to
the data is decided for each tool (`mwdcal.fleet.choices`). Results are columns, not objects: `names`
says which.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from mwdcal.calibration.automatic.auto import known_before
from mwdcal.calibration.automatic.nonlinearity import offered
from mwdcal.calibration.automatic.stand import stand_errors
from mwdcal.calibration.covariance import stated_covariance
from mwdcal.calibration.diagnosis.findings import finding_flags
from mwdcal.calibration.diagnosis.flags import Alone, FittedRuns, Flag
from mwdcal.calibration.diagnosis.refusals import BAD_INPUT, fit_refusals, reading_refusals
from mwdcal.calibration.estimate import Fit, fit
from mwdcal.calibration.methods import ESTIMABLE
from mwdcal.calibration.options import AUTO, Options
from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.calibration.record import FREE_SHARE, StandErrors
from mwdcal.calibration.soaks import HIGHEST
from mwdcal.errors import MwdcalError
from mwdcal.estimation.batch import take
from mwdcal.estimation.rank import Free
from mwdcal.estimation.uncertainty import marginal_rank
from mwdcal.fleet.accuracy import ANGLES, typical_sd
from mwdcal.fleet.choices import in_chunks, with_curves, with_orders
from mwdcal.fleet.curves import curved_sd
from mwdcal.geometry.vectors import AnyArray, Array, Ints
from mwdcal.sensor.models import Basis, Factors, Polynomial, Whole
from mwdcal.sensor.profile import Profile

OK, FAILED = "ok", "failed"
FACTS = ("rank", "size", "noise", "variance_factor", "degrees_of_freedom")
"""Columns of a triad besides its parameters and their standard uncertainties."""
EARTH = ("gravity_g", "field", "dip_deg")

CENTRES = tuple(f"centre_{axis}" for axis in "xyz")
"""Columns of a triad with own-axis terms, and `radius`: its terms are of (reading - centre) / radius."""
STAND = {
    name: tuple(f for f in StandErrors.__struct_fields__ if f.startswith(name.replace("-", "_")))
    for name in ESTIMABLE
}
"""Columns of each error of the stand that may be asked for."""


@dataclass(frozen=True)
class Outcome:
    """What became of B tools: a status and a message each, and columns (B,) of results.

    `columns` hold NaN where a tool has no result. `free` lists, for each tool and triad, the
    ids of directions that nothing determines; `findings` the ids of each tool's findings, and
    `reshoot` the numbers of its stations to take again.
    """

    status: AnyArray
    message: AnyArray
    columns: dict[str, Array]
    free: list[tuple[list[str], ...]]
    findings: list[list[str]]
    reshoot: list[list[int]]

    def sound(self, tools: Ints) -> Ints:
        """Those of the given tools that nothing has refused."""
        return np.asarray(tools[self.status[tools] == OK])


def model_parameters(options: Options, profile: Profile, triad: int) -> tuple[str, ...]:
    """Names of the parameters that a triad may have, as in its calibration file."""
    tried = options.order == AUTO and options.method != "swarm"
    orders = range(HIGHEST + 1) if tried else (options.orders[triad],)
    names: dict[str, None] = {}
    for kind, order in {options.kind(order): order for order in orders}.items():
        curved = kind == "polynomial" and may_be_curved(options, profile, triad)
        basis = Basis(order)
        model: Whole = Factors(basis) if kind == "factors" else Polynomial(basis, curved=curved)
        names |= dict.fromkeys(model.names)
    return tuple(names)


def may_be_curved(options: Options, profile: Profile, triad: int) -> bool:
    """Whether a triad has own-axis terms, or may come to have them."""
    return TRIADS[triad] in {*offered(profile, options), *options.curved}


def column(triad: str, parameter: str) -> str:
    """The column of a parameter.

    >>> column("magnetometer", "gain-xy·1")
    'magnetometer_gain_xy_t1'
    """
    return f"{triad}_{parameter}".replace("-", "_").replace("·", "_t")


def names(options: Options, profile: Profile, triads: Sequence[str] = TRIADS) -> list[str]:
    """The columns of results, in order."""
    found: list[str] = []
    for index, triad in enumerate(triads):
        own = [column(triad, name) for name in model_parameters(options, profile, index)]
        found += [f"{triad}_{fact}" for fact in (*FACTS, "order")]
        if may_be_curved(options, profile, index):
            found += [f"{triad}_{name}" for name in (*CENTRES, "radius")]
        found += [name for pair in zip(own, (f"{n}_sd" for n in own), strict=True) for name in pair]
    last = (ANGLES, EARTH) if len(triads) > 1 else (ANGLES[:2], EARTH[:1])
    stand = [name for error in options.estimate for name in STAND[error]]
    return [*found, *(f"{angle}_sd_deg" for angle in last[0]), *last[1], *stand]


def calibrate_batch(
    readings: Readings, options: Options, profile: Profile, alone: Alone
) -> Outcome:
    """Calibrate tools of the same shape: readings (B, n, ...), at the profile's temperature.

    `alone` gives one tool's own readings where a check needs words for it.
    """
    count, profile = len(readings.accelerometer), _with_scales(profile)
    blank = {name: np.full(count, np.nan) for name in names(options, profile)}
    free: list[tuple[list[str], ...]] = [([], []) for _ in range(count)]
    status, message = np.full(count, OK, object), np.full(count, "", object)
    none: list[list[str]] = [[] for _ in range(count)]
    again: list[list[int]] = [[] for _ in range(count)]
    outcome = Outcome(status, message, blank, free, none, again)
    options, every = known_before(options, readings, profile), np.arange(count)
    _screen(outcome, every, readings, options, alone)
    for some, chosen in with_orders(readings, outcome.sound(every), options):
        if isinstance(chosen, Exception):
            _fail(outcome, some, chosen)
            continue
        if chosen.order != options.order:
            _screen(outcome, some, readings, chosen, alone)
        for part, final in with_curves(readings, outcome.sound(some), chosen, profile):
            if isinstance(final, Exception):
                _fail(outcome, part, final)
            else:
                _fit(outcome, readings, part, final, alone, profile)
    return outcome


def _fit(
    outcome: Outcome,
    readings: Readings,
    tools: Ints,
    options: Options,
    alone: Alone,
    profile: Profile,
) -> None:
    """Fit the given tools, and write down what came of it."""
    for part, result in in_chunks(readings, tools, lambda r: fit(r, options)):
        if isinstance(result, Exception):
            _fail(outcome, part, result)
        else:
            _record(outcome, part, result, options, readings, profile, alone)


def _fail(outcome: Outcome, tools: Ints, error: Exception) -> None:
    """Give tools the status and message of an error: of what was asked, or of arithmetic."""
    if isinstance(error, MwdcalError):
        outcome.status[tools], outcome.message[tools] = BAD_INPUT, str(error)
        return
    outcome.status[tools] = FAILED
    outcome.message[tools] = f"the fit failed: {error}. Calibrate this tool alone to see why."


def _screen(
    outcome: Outcome, tools: Ints, readings: Readings, options: Options, alone: Alone
) -> None:
    """Refuse those of some tools that no fit could mend."""
    refusals = reading_refusals(take(readings, tools), options, lambda i: alone(int(tools[i]))[0])
    _refuse(outcome, tools, refusals)


def _with_scales(profile: Profile) -> Profile:
    """The profile with its scales stated: the readings are divided by those that it leaves open."""
    triads = {name: getattr(profile, name) for name in TRIADS}
    stated = {n: msgspec.structs.replace(t, scale=t.scale or 1.0) for n, t in triads.items()}
    return msgspec.structs.replace(profile, **stated)


def _refuse(outcome: Outcome, tools: Ints, refusals: Iterable[Flag]) -> None:
    """Give the first refusal of each of some tools as its status and message."""
    for refusal in refusals:
        for place in np.flatnonzero(refusal.members & (outcome.status[tools] == OK)).tolist():
            outcome.status[tools[place]] = refusal.id
            outcome.message[tools[place]] = refusal.sentence(place)


def _record(
    outcome: Outcome,
    members: Ints,
    result: Fit,
    options: Options,
    readings: Readings,
    profile: Profile,
    alone: Alone,
) -> None:
    """Check a fit of some tools and write down the results of the sound ones."""
    own = take(readings, members)
    fitted = FittedRuns.of(own, profile, options, result, lambda i: alone(int(members[i])))
    _refuse(outcome, members, fit_refusals(fitted))
    good = np.flatnonzero(outcome.status[members] == OK)
    if not good.size:
        return
    if good.size < len(members):
        fitted, members = fitted.take(good), members[good]
    _note(outcome, members, fitted)
    result, free = fitted.result, fitted.free
    reference = profile.reference_temperature_c
    covariance = stated_covariance(result)
    found = _columns(result, covariance, free, reference)
    found |= _besides(result, covariance, free, options, reference)
    for name, values in found.items():
        outcome.columns[name][members] = values


def _note(outcome: Outcome, members: Ints, fitted: FittedRuns) -> None:
    """Write down the findings of sound tools; what is undetermined, by triad."""
    free = [{entry.id for entry in each} for each in fitted.free]
    ids: list[dict[str, None]] = [{} for _ in members]
    for flag in finding_flags(fitted):
        for place in np.flatnonzero(flag.members).tolist():
            if flag.id not in free[place]:
                ids[place][flag.id] = None
            if flag.station is not None:
                outcome.reshoot[members[place]].append(flag.station)
    for place, tool in enumerate(members):
        outcome.findings[tool] = [*ids[place]]
        if free[place]:
            outcome.free[tool] = tuple(
                [f.id for f in fitted.free[place] if triad in f.triads]
                for triad in range(len(TRIADS))
            )


def _besides(
    result: Fit, covariance: Array, free: list[list[Free]], options: Options, reference: float
) -> dict[str, Array]:
    """Columns of what was chosen for these tools, and of what they were asked for besides."""
    count, found = len(result.status), {}
    for index, (name, triad) in enumerate(zip(TRIADS, result.problem.triads, strict=False)):
        found[f"{name}_order"] = np.full(count, float(options.orders[index]))
        model, _ = triad.model.finished(reference)
        if isinstance(model, Polynomial) and model.curved:
            ends = zip(CENTRES, model.centre[:, 0].transpose(), strict=True)
            found |= {f"{name}_{end}": values for end, values in ends}
            found[f"{name}_radius"] = model.scale[:, 0, 0]
    if any(f"{name}_radius" in found for name in TRIADS):
        rows = free_rows(free, result.state.params.shape[-1])
        found |= curved_sd(result, covariance, rows, reference)
    if options.estimate:
        errors = [stand_errors(take(result, np.array([i]))) for i in range(count)]
        for name in (name for error in options.estimate for name in STAND[error]):
            found[name] = np.array([getattr(each, name) for each in errors])
    return found


def _columns(
    result: Fit, covariance: Array, free: list[list[Free]], reference: float
) -> dict[str, Array]:
    """Columns of the results of sound fits."""
    found: dict[str, Array] = {}
    for index in range(len(result.problem.triads)):
        found |= _triad_columns(result, index, covariance, free, reference)
    found |= typical_sd(result, covariance, free_rows(free, covariance.shape[-1]), reference)
    problem, state = result.problem, result.state
    found["gravity_g"] = problem.constant(state, "gravity").mean(-1)
    if len(problem.triads) > 1:
        found["field"] = problem.constant(state, "field").mean(-1)
        found["dip_deg"] = np.degrees(problem.constant(state, "dip").mean(-1))
    return found


def free_rows(free: list[list[Free]], size: int) -> Array:
    """Free directions (B, k, p) of every member, rows of zeros where there are fewer than k."""
    most = max((len(each) for each in free), default=0)
    rows = np.zeros((len(free), most, size))
    for index, each in enumerate(free):
        for place, entry in enumerate(each):
            rows[index, place] = entry.direction
    return rows


def _triad_columns(
    result: Fit, index: int, covariance: Array, free: list[list[Free]], reference: float
) -> dict[str, Array]:
    """Parameters at the reference temperature, uncertainties, rank and noise of one triad."""
    problem, analysis = result.problem, result.analysis
    triad, where = problem.triads[index], problem.slices()[index]
    name, params = TRIADS[index], result.state.params[:, where]
    finished, one = triad.model.finished(reference)
    one = np.broadcast_to(one, (len(params), *one.shape[-2:]))
    values = np.einsum("bij,bj->bi", one, params)
    inner = one @ covariance[:, where, where]
    sd = np.sqrt(np.einsum("bij,bij->bi", inner, one))
    size, rank = triad.model.size, np.full(len(params), triad.model.size)
    some = np.flatnonzero([bool(each) for each in free])
    if some.size:
        part = take(result, some)
        rank[some] = marginal_rank(part.analysis.determined, where)
        directions = free_rows([free[i] for i in some], problem.slices()[-1].stop)[..., where]
        moved = np.einsum("bij,bkj->bki", one[some], directions)
        triad = part.problem.triads[index]
        effect = _effect(finished, values[some], triad.raw, part.problem.temperature)
        sd[some] = np.where(np.abs(moved).max(1) * effect > FREE_SHARE, np.nan, sd[some])
    declared = np.isnan(result.noise[:, index])
    noise = np.where(declared, problem.triads[index].sd.mean((-1, -2)), result.noise[:, index])
    freedom = analysis.freedom[:, index]
    facts = (
        rank,
        np.full(len(params), size),
        noise,
        np.where(freedom >= 1, analysis.variance_factor[:, index], np.nan),
        freedom,
    )
    found = {f"{name}_{fact}": np.asarray(v, float) for fact, v in zip(FACTS, facts, strict=True)}
    for place, parameter in enumerate(finished.names):
        found[column(name, parameter)] = values[:, place]
        found[f"{column(name, parameter)}_sd"] = sd[:, place]
    return found


def _effect(model: Whole, params: Array, raw: Array, temperature: Array) -> Array:
    """By how much of the field each parameter (B, p) changes it, per unit."""
    strength = np.linalg.norm(model.fields(params, raw, temperature), axis=-1).mean(-1)
    squares = np.sum(model.jacobian(params, raw, temperature) ** 2, -2)
    return np.asarray(np.sqrt(squares.mean(-2)) / strength[:, None])
