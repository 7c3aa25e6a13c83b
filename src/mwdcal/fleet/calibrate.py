"""A batch of tools calibrated at once: one fit for all, and each tool checked as if it were alone.

Every tool of a `Batch` has the same number of stations and the same kinds of evidence. What
`calibrate` would refuse is refused here with the same words: a screen of array operations
picks the suspects, and the check of a single run decides and speaks. What `calibrate` leaves to
the data is decided for each tool (`fleet_choices`). Results are columns, not objects: `names`
says which.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from mwdcal.calibration import results
from mwdcal.calibration.automatic.order_selection import mapped
from mwdcal.calibration.automatic.stand import check_separable
from mwdcal.calibration.diagnosis.refusals import check_readings, fit_checks
from mwdcal.calibration.estimate import Fit, fit
from mwdcal.calibration.methods import ESTIMABLE
from mwdcal.calibration.options import Options
from mwdcal.calibration.prediction import STATED_ANGLES, accuracy
from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.calibration.record import StandErrors
from mwdcal.errors import MwdcalError
from mwdcal.estimation.rank import Free
from mwdcal.fleet.choices import CHUNK, Alone, PerTool, halved, with_curves, with_orders
from mwdcal.fleet.findings import findings_of_batch
from mwdcal.fleet.refusals import free_of_batch, member, suspect_fits, suspect_readings
from mwdcal.geometry.vectors import AnyArray, Array, Ints
from mwdcal.sensor.models import Basis, Factors, Polynomial, Whole
from mwdcal.sensor.profile import Profile

OK, BAD_INPUT, FAILED = "ok", "bad-input", "failed"
ALIKE = PerTool()
"""Nothing is left to each tool."""
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


def model_parameters(options: Options, triad: int, per_tool: PerTool = ALIKE) -> tuple[str, ...]:
    """Names of the parameters that a triad may have, as in its calibration file."""
    found: dict[str, None] = {}
    highest = {options.kind(order): order for order in per_tool.orders(options, triad)}
    for kind, order in highest.items():
        curved = kind == "polynomial" and per_tool.curved(options, triad)
        basis = Basis(order)
        model: Whole = Factors(basis) if kind == "factors" else Polynomial(basis, curved=curved)
        found |= dict.fromkeys(model.names)
    return tuple(found)


def column(triad: str, parameter: str) -> str:
    """The column of a parameter.

    >>> column("magnetometer", "gain-xy·1")
    'magnetometer_gain_xy_t1'
    """
    return f"{triad}_{parameter}".replace("-", "_").replace("·", "_t")


def names(options: Options, triads: Sequence[str] = TRIADS, per_tool: PerTool = ALIKE) -> list[str]:
    """The columns of results, in order."""
    found: list[str] = []
    for index, triad in enumerate(triads):
        own = [column(triad, name) for name in model_parameters(options, index, per_tool)]
        found += [f"{triad}_{fact}" for fact in (*FACTS, "order")]
        if per_tool.curved(options, index):
            found += [f"{triad}_{name}" for name in (*CENTRES, "radius")]
        found += [name for pair in zip(own, (f"{n}_sd" for n in own), strict=True) for name in pair]
    last = (STATED_ANGLES, EARTH) if len(triads) > 1 else (STATED_ANGLES[:2], EARTH[:1])
    stand = [name for error in options.estimate for name in STAND[error]]
    return [*found, *(f"{angle}_sd_deg" for angle in last[0]), *last[1], *stand]


def calibrate_batch(
    readings: Readings,
    options: Options,
    profile: Profile,
    alone: Alone,
    per_tool: PerTool = ALIKE,
) -> Outcome:
    """Calibrate tools of the same shape: readings (B, n, ...), at the profile's temperature.

    `alone` gives one tool's own readings where a check needs words for it.
    """
    count = len(readings.accelerometer)
    blank = {name: np.full(count, np.nan) for name in names(options, per_tool=per_tool)}
    free: list[tuple[list[str], ...]] = [([], []) for _ in range(count)]
    status, message = np.full(count, OK, object), np.full(count, "", object)
    none: list[list[Any]] = [[] for _ in range(count)]
    outcome = Outcome(status, message, blank, free, list(none), list(none))
    options = per_tool.known(options, readings, profile)
    first, every = per_tool.before(options), np.arange(count)
    _refuse(outcome, every, suspect_readings(readings, first), alone, first)
    for some, chosen in with_orders(readings, outcome.sound(every), options, per_tool):
        if isinstance(chosen, Exception):
            _fail(outcome, some, chosen)
            continue
        if chosen != first:
            suspects = suspect_readings(taken(readings, some), chosen)
            _refuse(outcome, some, suspects, alone, chosen)
        for part, final in with_curves(outcome.sound(some), chosen, readings, per_tool, alone):
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
    for start in range(0, len(tools), CHUNK):
        part = tools[start : start + CHUNK]
        for which, result in halved(readings, part, lambda r: fit(r, options)):
            if isinstance(result, Exception):
                _fail(outcome, which, result)
            else:
                _record(outcome, which, result, options, readings, profile, alone)


def _fail(outcome: Outcome, tools: Ints, error: Exception) -> None:
    """Give tools the status and message of an error: of what was asked, or of arithmetic."""
    if isinstance(error, MwdcalError):
        outcome.status[tools], outcome.message[tools] = BAD_INPUT, str(error)
        return
    outcome.status[tools] = FAILED
    outcome.message[tools] = f"the fit failed: {error}. Calibrate this tool alone to see why."


def _refuse(
    outcome: Outcome, tools: Ints, suspects: dict[str, Any], alone: Alone, options: Options
) -> None:
    """Give the suspects that the check of a single run refuses their status and message."""
    for name, flags in suspects.items():
        for tool in outcome.sound(tools[flags & (outcome.status[tools] == OK)]):
            try:
                check_readings(alone(int(tool))[0], options)
            except MwdcalError as error:
                outcome.status[tool], outcome.message[tool] = name, str(error)


def taken(readings: Readings, index: Ints) -> Readings:
    """Some members of a batch."""
    return mapped(readings, lambda value: value[index])


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
    free = free_of_batch(result)
    _doubt(outcome, members, result, free, options, alone, profile)
    good = np.flatnonzero(outcome.status[members] == OK)
    if not good.size:
        return
    if good.size < len(members):
        result, free = member(result, good), [free[index] for index in good]
    findings, again = findings_of_batch(readings, profile, options, result, free)
    for place, own, stations in zip(members[good], findings, again, strict=True):
        outcome.findings[place], outcome.reshoot[place] = own, stations
    for name, values in _columns(result, free, options, profile.reference_temperature_c).items():
        outcome.columns[name][members[good]] = values
    for place, each in zip(members[good], free, strict=True):
        if each:
            outcome.free[place] = tuple(
                [f.id for f in each if triad in f.triads] for triad in range(len(TRIADS))
            )


def _doubt(
    outcome: Outcome,
    members: Ints,
    result: Fit,
    free: list[list[Free]],
    options: Options,
    alone: Alone,
    profile: Profile,
) -> None:
    """Give the suspects that the checks of a single fit refuse their status and message."""
    suspect = suspect_fits(result, free, options, profile) & (outcome.status[members] == OK)
    for index in np.flatnonzero(suspect):
        tool = int(members[index])
        readings, own_profile = alone(tool)
        own = member(result, np.array([index]))
        checks = [*fit_checks(own, free[index], own_profile, readings)]
        if options.estimate:
            checks.insert(0, ("inseparable", partial(check_separable, own, options.estimate)))
        for status, check in checks:
            try:
                check()
            except MwdcalError as error:
                outcome.status[tool], outcome.message[tool] = status, str(error)
                break


def _columns(
    result: Fit, free: list[list[Free]], options: Options, reference: float
) -> dict[str, Array]:
    """Columns of the results of sound fits."""
    covariance = results.StatedCovariance(result).total
    columns: dict[str, Array] = {}
    for index, name in enumerate(TRIADS[: len(result.problem.triads)]):
        triad = results.triad_results(result, index, covariance, free, reference)
        columns |= _triad_columns(name, triad)
    tools = results.calibrated_tools(result, free, reference, options.prior)
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
