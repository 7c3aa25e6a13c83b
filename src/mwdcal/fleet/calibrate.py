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
from mwdcal.calibration.readings import HIGHEST, TRIADS, Readings
from mwdcal.calibration.record import StandErrors
from mwdcal.errors import MwdcalError
from mwdcal.estimation.batch import take
from mwdcal.fleet.choices import in_chunks, with_curves, with_orders
from mwdcal.geometry.vectors import AnyArray, Array, Ints
from mwdcal.sensor.models import Basis, Factors, Polynomial, Whole
from mwdcal.sensor.profile import Profile

OK, FAILED = "ok", "failed"
FACTS = ("rank", "size", "noise", "variance_factor", "degrees_of_freedom")
"""Columns of a triad besides its parameters and their standard uncertainties."""
EARTH_COLUMNS = ("gravity_g", "field", "dip_deg")
CENTRES = tuple(f"centre_{axis}" for axis in "xyz")
"""Columns of a triad with own-axis terms, and `radius`: its terms are of (reading - centre) / radius."""
STAND_COLUMNS = {
    name: tuple(f for f in StandErrors.__struct_fields__ if f.startswith(name.replace("-", "_")))
    for name in ESTIMABLE
}
"""Columns of each error of the stand that may be asked for."""


@dataclass(frozen=True)
class BatchOutcome:
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
    columns: list[str] = []
    for index, triad in enumerate(triads):
        values = [column(triad, name) for name in model_parameters(options, profile, index)]
        columns += [f"{triad}_{fact}" for fact in (*FACTS, "order")]
        if may_be_curved(options, profile, index):
            columns += [f"{triad}_{name}" for name in (*CENTRES, "radius")]
        columns += [name for value in values for name in (value, f"{value}_sd")]
    last = (
        (STATED_ANGLES, EARTH_COLUMNS)
        if len(triads) > 1
        else (STATED_ANGLES[:2], EARTH_COLUMNS[:1])
    )
    stand = [name for error in options.estimate for name in STAND_COLUMNS[error]]
    return [*columns, *(f"{angle}_sd_deg" for angle in last[0]), *last[1], *stand]


def calibrate_batch(
    readings: Readings, options: Options, profile: Profile, alone: Alone
) -> BatchOutcome:
    """Calibrate tools of the same shape: readings (B, n, ...), at the profile's temperature.

    `alone` gives one tool's own readings where a check needs words for it.
    """
    batch = _Batch(readings, _with_scales(profile), alone, names(options, profile))
    batch.calibrate(known_before(options, readings, batch.profile))
    return batch.outcome


def _with_scales(profile: Profile) -> Profile:
    """The profile with its scales stated: the readings are divided by those that it leaves open."""
    triads = {name: getattr(profile, name) for name in TRIADS}
    stated = {n: msgspec.structs.replace(t, scale=t.scale or 1.0) for n, t in triads.items()}
    return msgspec.structs.replace(profile, **stated)


class _Batch:
    """Tools on their way: readings (B, n, ...), and the outcome that steps fill in for some of them."""

    def __init__(
        self, readings: Readings, profile: Profile, alone: Alone, columns: Sequence[str]
    ) -> None:
        self.readings, self.profile, self.alone = readings, profile, alone
        self.every = np.arange(len(readings.accelerometer))
        self.outcome = BatchOutcome(
            status=np.full(len(self.every), OK, object),
            message=np.full(len(self.every), "", object),
            columns={name: np.full(len(self.every), np.nan) for name in columns},
            free=[([], []) for _ in self.every],
            findings=[[] for _ in self.every],
            reshoot=[[] for _ in self.every],
        )

    def calibrate(self, options: Options) -> None:
        """Choose what the options leave to the data, fit, and note what came of it."""
        readings, sound = self.readings, self.outcome.sound
        self._screen(self.every, options)
        for some, chosen in with_orders(readings, sound(self.every), options):
            if isinstance(chosen, Exception):
                self._fail(some, chosen)
                continue
            if chosen.order != options.order:
                self._screen(some, chosen)
            for part, final in with_curves(readings, sound(some), chosen, self.profile):
                if isinstance(final, Exception):
                    self._fail(part, final)
                else:
                    self._fit(part, final)

    def _screen(self, tools: Ints, options: Options) -> None:
        """Refuse those of some tools that no fit could mend."""
        readings = take(self.readings, tools)
        self._refuse(
            tools, reading_refusals(readings, options, lambda i: self.alone(int(tools[i]))[0])
        )

    def _fit(self, tools: Ints, options: Options) -> None:
        """Fit some tools, and note the results of the sound ones."""
        for part, result in in_chunks(self.readings, tools, lambda r: fit(r, options)):
            if isinstance(result, Exception):
                self._fail(part, result)
            else:
                self._note(part, options, result)

    def _fail(self, tools: Ints, error: Exception) -> None:
        """Give tools the status and message of an error: of the input, or of arithmetic."""
        status, message = self.outcome.status, self.outcome.message
        if isinstance(error, MwdcalError):
            status[tools], message[tools] = BAD_INPUT, str(error)
            return
        status[tools] = FAILED
        message[tools] = f"the fit failed: {error}. Calibrate this tool alone to see why."

    def _refuse(self, tools: Ints, refusals: Iterable[Flag]) -> None:
        """Give the first refusal of each of some tools as its status and message."""
        status, message = self.outcome.status, self.outcome.message
        for refusal in refusals:
            for place in np.flatnonzero(refusal.members & (status[tools] == OK)).tolist():
                status[tools[place]] = refusal.id
                message[tools[place]] = refusal.sentence(place)

    def _note(self, tools: Ints, options: Options, result: Fit) -> None:
        """Check a fit of some tools, and note results and findings of the sound ones."""
        readings = take(self.readings, tools)
        fitted = FittedRuns(
            readings, self.profile, options, result, lambda place: self.alone(int(tools[place]))
        )
        self._refuse(tools, fit_refusals(fitted))
        good = np.flatnonzero(self.outcome.status[tools] == OK)
        if not good.size:
            return
        if good.size < len(tools):
            fitted = fitted.take(good)
        self._note_findings(tools[good], fitted)
        for name, values in _columns(fitted, self.profile.reference_temperature_c).items():
            self.outcome.columns[name][tools[good]] = values

    def _note_findings(self, tools: Ints, fitted: FittedRuns) -> None:
        """The findings of sound tools; what is undetermined, by triad."""
        ids: list[dict[str, None]] = [{} for _ in tools]
        for flag in finding_flags(fitted):
            for place in np.flatnonzero(flag.members).tolist():
                ids[place][flag.id] = None
                if flag.station is not None:
                    self.outcome.reshoot[tools[place]].append(flag.station)
        for tool, flags, free in zip(tools, ids, fitted.free, strict=True):
            undetermined = {entry.id for entry in free}
            self.outcome.findings[tool] = [name for name in flags if name not in undetermined]
            by_triad = ([f.id for f in free if triad in f.triads] for triad in range(len(TRIADS)))
            self.outcome.free[tool] = tuple(by_triad)


def _columns(fitted: FittedRuns, reference: float) -> dict[str, Array]:
    """Columns of the results of sound fits."""
    result, free = fitted.result, fitted.free
    covariance = fitted.covariance.total
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
