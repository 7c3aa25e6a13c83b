"""A batch of tools calibrated at once: one fit for all, each tool refused or reported as if alone.

Every tool of a `Batch` has the same number of stations and the same kinds of evidence. Refusals and
findings are those of `mwdcal.calibration.diagnosis`, of which a single run has the first member's.
What `calibrate` leaves to the data is decided for each tool (`mwdcal.fleet.choices`). Results are
columns, not objects: `names` says which.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from mwdcal.calibration import results
from mwdcal.calibration.automatic.auto import known_before
from mwdcal.calibration.automatic.nonlinearity import offered
from mwdcal.calibration.diagnosis.findings import finding_flags
from mwdcal.calibration.diagnosis.flags import Alone, FittedRuns, Flag
from mwdcal.calibration.diagnosis.refusals import BAD_INPUT, fit_refusals, reading_refusals
from mwdcal.calibration.estimate import Fit, fit
from mwdcal.calibration.methods import ESTIMABLE
from mwdcal.calibration.options import AUTO, Options
from mwdcal.calibration.prediction import STATED_ANGLES, accuracy
from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.calibration.record import StandErrors
from mwdcal.calibration.soaks import HIGHEST
from mwdcal.errors import MwdcalError
from mwdcal.estimation.batch import take
from mwdcal.fleet.choices import in_chunks, with_curves, with_orders
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
    last = (STATED_ANGLES, EARTH) if len(triads) > 1 else (STATED_ANGLES[:2], EARTH[:1])
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
    part, tools = take(readings, members), members
    fitted = FittedRuns.of(part, profile, options, result, lambda i: alone(int(tools[i])))
    _refuse(outcome, members, fit_refusals(fitted))
    good = np.flatnonzero(outcome.status[members] == OK)
    if not good.size:
        return
    if good.size < len(members):
        fitted, members = fitted.take(good), members[good]
    _note(outcome, members, fitted)
    for name, values in _columns(fitted, profile.reference_temperature_c).items():
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


def _columns(fitted: FittedRuns, reference: float) -> dict[str, Array]:
    """Columns of the results of sound fits."""
    result, free = fitted.result, fitted.free
    covariance = results.StatedCovariance(result).total
    columns: dict[str, Array] = {}
    for index, name in enumerate(TRIADS[: len(result.problem.triads)]):
        triad = results.triad_results(result, index, covariance, free, reference)
        columns |= _triad_columns(name, triad)
    tools = results.calibrated_tools(result, free, reference, fitted.options.knowledge)
    sd = accuracy(tools, covariance)
    columns |= {f"{angle}_sd_deg": np.degrees(values) for angle, values in sd.items()}
    return columns | results.earth(result) | results.stand_errors(result)


def _triad_columns(name: str, triad: results.TriadResults) -> dict[str, Array]:
    """Columns of one triad: facts, parameters and their standard uncertainties."""
    count, model = len(triad.rank), triad.model
    columns = {f"{name}_{fact}": np.asarray(getattr(triad, fact), float) for fact in FACTS}
    columns[f"{name}_order"] = np.full(count, float(model.basis.order))
    if isinstance(model, Polynomial) and model.curved:
        centre = model.centre[:, 0].transpose()
        columns |= {f"{name}_{end}": values for end, values in zip(CENTRES, centre, strict=True)}
        columns[f"{name}_radius"] = model.scale[:, 0, 0]
    for place, parameter in enumerate(model.names):
        columns[column(name, parameter)] = triad.parameters[:, place]
        columns[f"{column(name, parameter)}_sd"] = triad.sd[:, place]
    return columns
