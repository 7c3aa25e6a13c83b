"""A batch of tools calibrated at once: one fit for all, each tool refused or reported as if alone.

Every tool of a `Batch` has the same number of stations and the same kinds of evidence. Refusals and
findings are those of `mwdcal.calibration.diagnosis`, of which a single run has the first member's.
What `calibrate` leaves to the data is decided for each tool (`mwdcal.fleet.choices`). Results are
columns, not objects: `names` says which.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial

import msgspec
import numpy as np

from mwdcal.calibration import results
from mwdcal.calibration.automatic.auto import Choice, offered, tables_of, with_prior
from mwdcal.calibration.automatic.drift import with_drifts
from mwdcal.calibration.calibrate import Records
from mwdcal.calibration.diagnosis.findings import copies, finding_flags
from mwdcal.calibration.diagnosis.flags import Alone, FittedRuns, Flag
from mwdcal.calibration.diagnosis.refusals import BAD_INPUT, fit_refusals, reading_refusals
from mwdcal.calibration.estimate import Fit, fit
from mwdcal.calibration.methods import ESTIMABLE
from mwdcal.calibration.options import AUTO, Options
from mwdcal.calibration.readings import HIGHEST, TRIADS, Readings
from mwdcal.calibration.record import StandErrors
from mwdcal.calibration.results import STATED_ANGLES, accuracy
from mwdcal.errors import MwdcalError
from mwdcal.estimation.batch import put, take
from mwdcal.fleet.choices import alike, in_chunks, with_curves, with_orders
from mwdcal.geometry.vectors import AnyArray, Array, Bools, Ints
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


LISTS = ("findings", "reshoot", *(f"{triad}_undetermined" for triad in TRIADS))
"""Columns of lists: ids of findings, stations to take again, ids of what nothing determines."""


@dataclass(frozen=True)
class Outcome:
    """What became of B tools: a status and a message each, and columns (B,) of results.

    Where a tool has no result, there are NaN among `numbers`, and None among `lists`, `records` and units. `copies`
    (B,) counts the stations that were left out as copies of others.
    """

    status: AnyArray
    message: AnyArray
    unit: AnyArray
    numbers: dict[str, Array]
    lists: dict[str, AnyArray]
    copies: Ints
    records: AnyArray

    @classmethod
    def blank(cls, count: int, numbers: Iterable[str]) -> Outcome:
        """Of tools that nothing has refused, and nothing calibrated."""
        return cls(
            status=np.full(count, OK, object),
            message=np.full(count, "", object),
            unit=np.full(count, None, object),
            numbers={name: np.full(count, np.nan) for name in numbers},
            lists={name: np.full(count, None, object) for name in LISTS},
            copies=np.zeros(count, int),
            records=np.full(count, None, object),
        )

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
    several = len(triads) > 1
    angles = STATED_ANGLES if several else STATED_ANGLES[:2]
    earth = EARTH_COLUMNS if several else EARTH_COLUMNS[:1]
    stand = [name for error in options.estimate for name in STAND_COLUMNS[error]]
    return [*columns, *(f"{angle}_sd_deg" for angle in angles), *earth, *stand]


def calibrate_batch(
    readings: Readings, options: Options, profile: Profile, alone: Alone, records: bool = False
) -> Outcome:
    """Calibrate tools of the same shape: readings (B, n, ...), at the profile's temperature.

    `alone` gives one tool's own readings where a check needs words for it. Stations to take again
    are counted from 0. `records`: also what `mwdcal calibrate` writes for each sound tool.
    """
    outcome = Outcome.blank(len(readings.accelerometer), names(options, profile))
    none = np.zeros(readings.accelerometer.shape[:-1], bool)
    batch = _Batch(readings, _with_scales(profile), alone, outcome, none, options, records)
    batch.calibrate(with_prior(options, readings, batch.profile))
    repeated = np.flatnonzero(batch.repeated.any(-1))
    blank = [np.isnan(readings.reference(name)[repeated]) for name in readings.known]
    patterns = np.concatenate([batch.repeated[repeated], *blank], -1)
    for pattern, tools in alike(repeated, patterns):
        again = _without_copies(batch, tools, pattern[: readings.count])
        outcome = put(outcome, tools, again)
    return outcome


def _without_copies(batch: _Batch, tools: Ints, repeated: Bools) -> Outcome:
    """Some tools of a batch as if the stations where `repeated` (n,) is true were not in their runs."""

    def alone(place: int) -> tuple[Readings, Profile]:
        readings, profile = batch.alone(int(tools[place]))
        return readings.without_copies(repeated), profile

    readings = take(batch.readings, tools).without_copies(repeated)
    outcome = calibrate_batch(readings, batch.given, batch.profile, alone, batch.records)
    outcome.copies[:] += np.count_nonzero(repeated)
    stations = np.flatnonzero(~repeated)
    for again in filter(None, outcome.lists["reshoot"]):
        again[:] = stations[again].tolist()
    return outcome


def _with_scales(profile: Profile) -> Profile:
    """The profile with its scales stated: the readings are divided by those that it leaves open."""
    triads = {name: getattr(profile, name) for name in TRIADS}
    stated = {n: msgspec.structs.replace(t, scale=t.scale or 1.0) for n, t in triads.items()}
    return msgspec.structs.replace(profile, **stated)


@dataclass(frozen=True)
class _Batch:
    """Tools on their way: readings (B, n, ...), and the outcome that steps fill in for some of them.

    `repeated` (B, n): the stations of sound fits that are copies of others. `given` are the options as they came.
    """

    readings: Readings
    profile: Profile
    alone: Alone
    outcome: Outcome
    repeated: Bools
    given: Options
    records: bool

    def calibrate(self, options: Options) -> None:
        """Choose what the options leave to the data, fit, and note what came of it."""
        readings, sound, fail = self.readings, self.outcome.sound, self._fail
        every = np.arange(len(readings.accelerometer))
        self._screen(every, options)
        for some, chosen in with_orders(readings, sound(every), options, fail):
            if chosen.order != options.order:
                self._screen(some, chosen)
            for part, final in with_curves(readings, sound(some), chosen, self.profile, fail):
                fits = in_chunks(readings, part, partial(fit, options=final), fail)
                for few, result in with_drifts(fits, final):
                    self._note(few, final, result)

    def _screen(self, tools: Ints, options: Options) -> None:
        """Refuse those of some tools that no fit could mend."""
        readings = take(self.readings, tools)
        self._refuse(
            tools, reading_refusals(readings, options, lambda i: self.alone(int(tools[i]))[0])
        )

    def _fail(self, tools: Ints, error: Exception) -> None:
        """Give tools the status and message of an error: of the input, or of arithmetic."""
        known = isinstance(error, MwdcalError)
        words = f"the fit failed: {error}. Calibrate this tool alone to see why."
        self.outcome.status[tools] = BAD_INPUT if known else FAILED
        self.outcome.message[tools] = str(error) if known else words

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
        alone = cache(lambda place: self.alone(int(tools[place])))
        fitted = FittedRuns(readings, self.profile, options, result, alone)
        self._refuse(tools, fit_refusals(fitted))
        good = np.flatnonzero(self.outcome.status[tools] == OK)
        if not good.size:
            return
        if good.size < len(tools):
            fitted = fitted.take(good)
        self.repeated[tools[good]] = copies(fitted.result)
        flags = [*finding_flags(fitted)]
        self._note_findings(tools[good], fitted, flags)
        if readings.magnetometer is not None:
            self.outcome.unit[tools[good]] = readings.field_unit
        if self.records:
            self._note_records(tools[good], Records(fitted, flags))
        for name, values in _columns(fitted, self.profile.reference_temperature_c).items():
            self.outcome.numbers[name][tools[good]] = values

    def _note_records(self, tools: Ints, records: Records) -> None:
        """Records of sound tools, as `mwdcal calibrate` writes them; of the time the day alone, so that runs repeat."""
        for place in np.flatnonzero(~self.repeated[tools].any(-1)).tolist():
            with suppress(MwdcalError):  # of a tool that is sound by a hair in the batch alone
                options, (readings, profile) = records.fitted.options, records.fitted.alone(place)
                orders = tables_of(readings, self.given, options)
                record = records.of(place, Choice(readings, profile, options, orders))
                day = msgspec.structs.replace(record, time=record.time.partition("T")[0])
                self.outcome.records[tools[place]] = msgspec.json.encode(day)

    def _note_findings(self, tools: Ints, fitted: FittedRuns, flags: Sequence[Flag]) -> None:
        """The findings of sound tools; what is undetermined, by triad."""
        lists = self.outcome.lists
        ids: list[dict[str, None]] = [{} for _ in tools]
        stations: list[list[int]] = [[] for _ in tools]
        for flag in flags:
            for place in np.flatnonzero(flag.members).tolist():
                ids[place][flag.id] = None
                if flag.station is not None:
                    stations[place].append(int(flag.station[place]))
        for tool, kinds, again, free in zip(tools, ids, stations, fitted.free, strict=True):
            undetermined = {entry.id for entry in free}
            lists["findings"][tool] = [name for name in kinds if name not in undetermined]
            lists["reshoot"][tool] = sorted(again)
            for index, triad in enumerate(TRIADS):
                free_here = [entry.id for entry in free if index in entry.triads]
                lists[f"{triad}_undetermined"][tool] = free_here


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
