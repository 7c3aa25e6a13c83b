"""A whole procedure many times: tools, a plan, a stand, noise, the fit, a roll test and its verdict.

What many repetitions of a procedure show: distribution of errors, verdicts, wrong verdicts.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial

import msgspec
import numpy as np

from mwdcal.calibration import results
from mwdcal.calibration.calibrate import recorded
from mwdcal.calibration.diagnosis.flags import FittedRuns
from mwdcal.calibration.diagnosis.refusals import fit_refusals
from mwdcal.calibration.estimate import Fit, fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import CONSTANTS, TRIADS, Readings
from mwdcal.calibration.record import SOFTWARE, Calibration
from mwdcal.calibration.results import STATED_ANGLES, accuracy, middle_temperature
from mwdcal.errors import FitError, InputError
from mwdcal.estimation.problem import ANGLES
from mwdcal.estimation.uncertainty import Free
from mwdcal.files.formats.columns import Column
from mwdcal.files.formats.table import Table
from mwdcal.geometry.circle import resultant
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import AnyArray, Array, Bools, reference_vectors
from mwdcal.planning.expected import left_undetermined, planned_fit
from mwdcal.planning.planned import WORKING_INCLINATIONS
from mwdcal.planning.plans import Effects, Truth, drawn, stated_place, with_place
from mwdcal.planning.session import Session
from mwdcal.sensor.profile import Profile
from mwdcal.use import roll_test
from mwdcal.use.roll_test import LEVEL, UNDEFINED_AT_VERTICAL, RollSet, RollTest
from mwdcal.use.verification import COVERAGE, Limits

Part = tuple[int, int]
"""Number and size of a part of all tools."""
Tools = dict[str, AnyArray]
"""What became of tools, by column: a row for each."""
TOOLS_AT_ONCE = 200
"""Tools that are simulated and fitted at once, with random numbers of their own."""
SIXTHS = np.arange(6) * np.pi / 3
"""Azimuths and toolfaces at which errors over the working range are taken."""
CALIBRATED = "ok"
"""Status of a tool that is calibrated; else the id of the refusal."""


@dataclass(frozen=True)
class Judged:
    """A limit and the roll sets that it is judged by: `spread` or `error` of an observable."""

    kind: str
    name: str
    limit: float
    sets: tuple[RollSet, ...]

    @property
    def unit(self) -> str:
        """The unit of the limit."""
        inside = OBSERVABLES[self.name].unit
        return "°" if inside == "rad" else inside

    @property
    def factor(self) -> float:
        """How many of the unit are one inside."""
        return float(np.degrees(1)) if self.unit == "°" else 1.0

    def column(self, word: str = "") -> str:
        """The name of a column: spread_inclination_deg, or with a word before the unit."""
        unit = "deg" if self.unit == "°" else self.unit.lower()
        return "_".join(filter(None, (self.kind, self.name, word, unit)))


@dataclass(frozen=True)
class Procedure:
    """The subject of a repetition: both sessions, how to fit, the limits of the roll test, and the seed.

    `calibration` is that of a nominal tool that reads without noise, `options` say `auto` nowhere; `tool` is the
    one that is measured again and again, else each is drawn, of an `order`.
    """

    calibrating: Session
    testing: Session
    options: Options
    limits: Limits
    calibration: Calibration
    seed: int
    order: int
    tool: Truth | None = None

    @classmethod
    def of(
        cls, plan: Table, test: Table, profile: Profile, options: Options, limits: Limits, seed: int,
        effects: Effects | None = None, order: int | None = None, tool: Truth | None = None,
    ) -> Procedure:  # fmt: skip
        """The procedure of a plan and the plan of a roll test, which is taken at the place of the former.

        Raises:
            InputError: the plan does not state an attitude, the profile not the noise, or no limit can be judged.
            FitError: no calibration can come of the plan; the message says what to add.
        """
        choice, result = planned_fit(plan, profile, options)
        calibration = recorded(choice, result)
        if free := left_undetermined(calibration):
            raise FitError(f"{plan.source} leaves a direction undetermined: {free[0].text}.")
        testing = Session.of(with_place(test, stated_place(plan)), profile, effects)
        if tool and tool.magnetometer is None:  # no limit of azimuth, field or dip then
            testing = replace(testing, readings=replace(testing.readings, magnetometer=None))
        most = max(choice.options.orders) if order is None else order
        return cls(
            Session.of(plan, profile, effects), testing, choice.options, limits, calibration, seed,
            most, tool,
        )  # fmt: skip

    @cached_property
    def judged(self) -> list[Judged]:
        """The limits that the roll test can be judged by.

        Raises:
            InputError: there is none, or a limit that no tool could pass.
        """
        readings, calibration = self.testing.readings, self.calibration
        if calibration.outside(readings).any():
            low, high = calibration.valid_temperatures or (np.nan, np.nan)
            raise InputError(
                f"{self.testing.plan.source} lies outside the calibrated range, good for {low:.1f}…{high:.1f} °C. "
                "Choose a `rolltest` within it."
            )
        test, judged = RollTest(calibration, readings), []
        for kind in ("spread", "error"):
            for name, limit in getattr(self.limits, kind).items():
                outcome = getattr(test, kind)(name)
                if outcome.blocked:
                    raise InputError(f"{kind} of {name} cannot be passed: {outcome.blocked}.")
                sets = tuple(s for s in test.sets if _fits(test, kind, name, s))
                if not outcome.skipped and sets:
                    judged.append(Judged(kind, name, limit, sets))
        if not judged:
            raise InputError(
                f"{self.testing.plan.source}: no limit of '{self.limits.name}' applies to a roll set of it. Choose "
                "another `rolltest`, or other `limits`."
            )
        return judged

    @property
    def guard(self) -> float:
        """Standard uncertainties that a figure must stay away from its limit."""
        return COVERAGE if self.limits.rule == "guarded" else 0.0

    def parts(self, count: int) -> list[Part]:
        """Number and size of each part of so many tools."""
        return [
            (k, min(TOOLS_AT_ONCE, count - first))
            for k, first in enumerate(range(0, count, TOOLS_AT_ONCE))
        ]

    def repeated(self, part: Part) -> Tools:
        """What became of the tools of a part, by column: a row for each; the same for the same seed."""
        number, count = part
        rng = np.random.default_rng([self.seed, 3, number])
        profile = self.calibrating.profile
        tools = (
            drawn(rng, profile, self.order, (count,))
            if self.tool is None
            else _alike(self.tool, count)
        )
        common = self.calibrating.common(rng, (count,))
        calibrating = self.calibrating.measured(tools, rng, common)
        testing = self.testing.measured(tools, rng, common)
        readings, test = calibrating.readings, testing.readings
        result = fit(readings, self.options)
        columns: dict[str, AnyArray] = {"status": self._status(readings, result)}
        sound = columns["status"] == CALIBRATED
        tested = replace(tools, turn_on=testing.turn_on)  # the tool as the roll test has it
        tools = replace(tools, turn_on=calibrating.turn_on)  # the tool that was calibrated
        columns |= self._verdict(tested, result, test, sound)
        columns |= self._errors(tools, result) | self._parameters(result)
        return columns | _true_parameters(tools)

    def _status(self, readings: Readings, result: Fit) -> AnyArray:
        """Why a tool is refused, or that it is calibrated."""
        profile, count = self.calibrating.profile, len(result.status)
        fitted = FittedRuns(
            readings, profile, self.options, result, lambda k: (_member(readings, k), profile)
        )
        status = np.full(count, CALIBRATED, object)
        for flag in fit_refusals(fitted):
            status[flag.members & (status == CALIBRATED)] = flag.id
        return status

    def _verdict(
        self, tools: Truth, result: Fit, test: Readings, sound: Bools
    ) -> dict[str, AnyArray]:
        """Every figure of the roll test, what is true of it, and both verdicts."""
        guard = self.guard
        passed, good = sound.copy(), np.ones(len(sound), bool)
        columns: dict[str, AnyArray] = {}
        nominal = RollTest(self.calibration, self.testing.readings)
        seen, turned = _Seen(result, test, nominal), cache(partial(self._turned, tools, result))
        for limit in self.judged:
            value, sd = seen.figure(limit)
            true = self._true_figure(limit, turned)
            passed &= value + guard * sd <= limit.limit
            good &= true <= limit.limit
            columns |= {limit.column(): value, limit.column("sd"): sd, limit.column("true"): true}
        return {"passed": passed, "good": good, **columns}

    def _turned(self, tools: Truth, result: Fit, first: int) -> dict[str, Array]:
        """Every observable (B, t) over a whole turn at the direction of a station, without noise.

        With `…-error`, its departure from what is true there.
        """
        nominal, count = self.testing.readings, roll_test.CURVE_POINTS
        at = {name: np.full(count, value[first]) for name, value in nominal.known.items()}
        at["toolface"] = roll_test.CIRCLE
        fields = _through(tools, result, at, np.full(count, _warmth(nominal)[first]))
        turn = {name: OBSERVABLES[name].value(*fields) for name in at}
        return turn | {f"{n}-error": OBSERVABLES[n].difference(turn[n], at[n]) for n in at}

    def _true_figure(self, limit: Judged, turned: Callable[[int], dict[str, Array]]) -> Array:
        """The figure (B,) of a limit without noise, over the whole turn of its worst set."""
        figures = []
        for each in limit.sets:
            turn = turned(int(each.index[0]))
            off = turn[f"{limit.name}-error"]
            part = _centred(off if limit.name == "toolface" else turn[limit.name], limit.name)
            error = limit.kind == "error"
            figures.append(np.abs(off).max(-1) if error else np.ptp(part, axis=-1))
        return np.asarray(np.max(figures, 0) * limit.factor)

    def _errors(self, tools: Truth, result: Fit) -> dict[str, Array]:
        """Root mean square and largest error of each angle over the working range, and the accuracy stated."""
        calibration = self.calibration
        low, high = calibration.temperature_c or (0.0, 0.0)
        middle = middle_temperature(calibration)
        temperatures = sorted({low, middle, high}) if self.order else [middle]
        grid = np.meshgrid(WORKING_INCLINATIONS, SIXTHS, SIXTHS, temperatures, indexing="ij")
        *angles, warmth = (axis.ravel() for axis in grid)
        at = dict(zip(ANGLES, angles, strict=True))
        known = self.calibrating.readings.known
        at |= {name: np.full(warmth.shape, np.mean(known[name])) for name in CONSTANTS}
        fields = _through(tools, result, at, warmth)
        free: list[list[Free]] = [[] for _ in result.status]
        stated = results.calibrated_tools(
            result, free, calibration.reference_temperature, self.options.knowledge
        )
        sd = accuracy(stated, results.StatedCovariance(result).total)
        columns = {}
        for name, each in sd.items():
            off = np.degrees(
                OBSERVABLES[name].difference(OBSERVABLES[name].value(*fields), at[name])
            )
            columns[f"{name}_error_rms_deg"] = np.sqrt(np.mean(off**2, -1))
            columns[f"{name}_error_max_deg"] = np.abs(off).max(-1)
            columns[f"{name}_sd_deg"] = np.degrees(each)
        return columns

    def _parameters(self, result: Fit) -> dict[str, Array]:
        """Parameters as in a calibration file, and their standard uncertainties."""
        covariance = results.StatedCovariance(result).total
        free: list[list[Free]] = [[] for _ in result.status]
        columns = {}
        for index, triad in enumerate(TRIADS[: len(result.problem.triads)]):
            each = results.triad_results(
                result, index, covariance, free, self.calibration.reference_temperature
            )
            for place, name in enumerate(each.model.names):
                columns[column(triad, name)] = each.parameters[:, place]
                columns[f"{column(triad, name)}_sd"] = each.sd[:, place]
        return columns


def solved(repeated: Callable[[Part], Tools], part: Part) -> bytes:
    """`Procedure.repeated` in another process."""
    return pickle.dumps(repeated(part))


def column(triad: str, parameter: str) -> str:
    """The column of a parameter, as in a fleet's table: magnetometer_gain_xy_t1."""
    return f"{triad}_{parameter}".replace("-", "_").replace("·", "_t")


def _true_parameters(tools: Truth) -> dict[str, Array]:
    return {
        f"true_{column(triad, name)}": params[:, place]
        for triad, (model, params) in tools.parameters.items()
        for place, name in enumerate(model.finished(tools.reference)[0].names)
    }


def _alike(tool: Truth, count: int) -> Truth:
    """One tool so many times."""
    second = tool.magnetometer
    return replace(
        tool,
        accelerometer=np.tile(tool.accelerometer, (count, 1)),
        magnetometer=None if second is None else np.tile(second, (count, 1)),
    )


def _member(readings: Readings, place: int) -> Readings:
    """The readings of one tool of several."""
    magnetometer = readings.magnetometer
    return replace(
        readings, accelerometer=readings.accelerometer[place],
        magnetometer=None if magnetometer is None else magnetometer[place],
    )  # fmt: skip


def _fits(test: RollTest, kind: str, name: str, roll_set: RollSet) -> bool:
    """Whether a roll set has a figure of an observable."""
    steep = name in UNDEFINED_AT_VERTICAL and test.near[roll_set.index].any()
    level = roll_set.one_azimuth or name in LEVEL
    return bool(level and not steep and not test.loose(roll_set.index))


def _warmth(readings: Readings) -> Array:
    return np.zeros(readings.count) if readings.temperature is None else readings.temperature


def _corrected(result: Fit, raws: Sequence[Array], temperature: Array) -> tuple[Array, Array]:
    """Gravity and field (B, n, 3) that the fits make of nominal readings."""
    fields = [
        triad.model.fields(result.state.params[:, where], raw, temperature)
        for triad, where, raw in zip(
            result.problem.triads, result.problem.slices(), raws, strict=True
        )
    ]
    return fields[0], fields[1] if len(fields) > 1 else np.full_like(fields[0], np.nan)


def _through(
    tools: Truth, result: Fit, at: Mapping[str, Array], temperature: Array
) -> tuple[Array, Array]:
    """Gravity and field (B, n, 3) that calibrated tools give at attitudes (n,), without noise."""
    vectors = reference_vectors(*(at[name] for name in (*ANGLES, *CONSTANTS)))
    return _corrected(result, [*tools.readings(vectors, temperature).values()], temperature)


def _centred(value: Array, name: str) -> Array:
    """Values (..., n) about their middle."""
    periodic = OBSERVABLES[name].period
    middle = np.angle(resultant(value)) if periodic else value.mean(-1)
    return OBSERVABLES[name].difference(value, middle[..., None])


@dataclass(frozen=True)
class _Seen:
    """Roll tests of calibrated tools, as `RollTest` sees one: `nominal` has what all have in common."""

    result: Fit
    test: Readings
    nominal: RollTest

    @cached_property
    def raws(self) -> list[Array]:
        """Readings (B, n, 3) of each triad."""
        return [getattr(self.test, name) for name in self.test.triads]

    @cached_property
    def fields(self) -> tuple[Array, Array]:
        """Corrected vectors (B, n, 3)."""
        return _corrected(self.result, self.raws, _warmth(self.test))

    @cached_property
    def toolface(self) -> Array:
        """Toolface (B, n) by which the tools were rolled: near vertical the magnetic one."""
        name = "toolface" if len(self.raws) == 1 else "magnetic_toolface"
        near = OBSERVABLES[name].value(*self.fields)
        return np.where(self.nominal.near, near, OBSERVABLES["toolface"].value(*self.fields))

    def noise(self, name: str) -> Array:
        """Standard uncertainty (B, n) of an observable by the noise of the readings."""
        gradient, square = np.nan_to_num(OBSERVABLES[name].gradient(*self.fields)), 0.0
        problem = self.result.problem
        for k, (triad, where) in enumerate(zip(problem.triads, problem.slices(), strict=True)):
            slope = triad.model.slope(
                self.result.state.params[:, where], self.raws[k], _warmth(self.test)
            )
            moved = np.einsum("bni,bnij->bnj", gradient[..., 3 * k : 3 * k + 3], slope)
            square = square + np.sum((moved * self.test.sd[TRIADS[k]]) ** 2, -1)
        return np.asarray(np.sqrt(square))

    def figure(self, limit: Judged) -> tuple[Array, Array]:
        """Noise-free figure (B,) of a limit and its standard uncertainty, of all sets of each tool together."""
        name, error = limit.name, limit.kind == "error"
        value = OBSERVABLES[name].value(*self.fields)
        if error or name == "toolface":
            value = OBSERVABLES[name].difference(value, self.test.known[name])
        parts = [value[:, each.index] for each in limit.sets]
        parts = parts if error else [_centred(part, name) for part in parts]
        references = [self.nominal.reference_errors(name, each, error) for each in limit.sets]
        sd = self.noise(name)
        curves = [
            roll_test.fitted(
                part, np.hypot(sd[:, each.index], reference.individual), self.toolface[:, each.index],
                self.nominal.harmonics(each), reference.together,
            )
            for part, each, reference in zip(parts, limit.sets, references, strict=True)
        ]  # fmt: skip
        noise, figures = roll_test.scatter(curves), []
        for k, (part, curve) in enumerate(zip(parts, curves, strict=True)):
            first = int(limit.sets[k].index[0])
            one = roll_test.figure(part, curve, noise, error, roll_test.drawn(curve, name, first))
            common = self.nominal.common_errors(name, references[k], first)
            errors = one.errors + one.side[:, None] * common
            whole = np.hypot(one.uncertainty, references[k].shared)
            figures.append((one.value, whole, errors, one.rough))
        worst = roll_test.largest(*(np.stack(each, -1) for each in zip(*figures, strict=True)))
        return worst.value * limit.factor, worst.uncertainty * limit.factor


PERCENTILES = (5, 50, 95, 99)
"""Of each distribution that is stated."""
Percentiles = dict[str, float | None]
SIDE = 1.959963984540054
"""Standard deviations that hold 95 % of a normal distribution."""


class Share(msgspec.Struct, frozen=True, kw_only=True):
    """A share of all tools, counted, with its 95 % interval (Wilson)."""

    count: int
    share: float
    low: float
    high: float

    @classmethod
    def of(cls, members: Bools) -> Share:
        """The share of members that are true."""
        count, total = int(members.sum()), len(members)
        share, weight = count / total, SIDE**2 / total
        middle = (share + weight / 2) / (1 + weight)
        half = SIDE * np.sqrt(share * (1 - share) / total + weight / total / 4) / (1 + weight)
        low = 0.0 if count == 0 else float(middle - half)
        high = 1.0 if count == total else float(middle + half)
        return cls(count=count, share=share, low=low, high=high)


class LimitRow(msgspec.Struct, frozen=True, kw_only=True):
    """One limit over all tools: percentiles of the figure that the roll test gives, and of the true one."""

    name: str
    unit: str
    limit: float
    value: Percentiles
    true: Percentiles
    wrong: Share


class Repetition(msgspec.Struct, frozen=True, kw_only=True):
    """The results of many repetitions; shares are of all tools.

    A tool is `good` where every true figure, of noise-free readings over the whole turn, is within its limit.
    `wrong_pass`, the consumer's risk: passed and not good; `wrong_fail`, the producer's risk: good and not passed.
    `errors_deg`: percentiles over the tools of the root mean square (`rms`) and the largest (`max`) error of each
    angle over the working range, and of the accuracy that its calibration states at 45° (`stated`).
    """

    tools: int
    calibrated: Share
    refused: dict[str, int]
    passed: Share
    good: Share
    wrong_pass: Share
    wrong_fail: Share
    errors_deg: dict[str, dict[str, Percentiles]]
    limits: list[LimitRow]


def joined(parts: Sequence[Mapping[str, AnyArray]]) -> dict[str, AnyArray]:
    """The columns of all parts, in order, with the number of each tool first."""
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return {"tool": np.arange(1.0, len(columns["status"]) + 1), **columns}


def as_table(columns: Mapping[str, AnyArray], procedure: Procedure) -> Table:
    """The table of all tools, labelled as simulated."""
    cells: dict[str, Column] = {
        name: values.tolist() if values.dtype == object else values
        for name, values in columns.items()
    }
    labels = {
        "simulated": True, "seed": procedure.seed, "plan": procedure.calibrating.plan.source,
        "rolltest": procedure.testing.plan.source, "limits": procedure.limits.name,
        "tool": procedure.calibrating.profile.name, "software": SOFTWARE,
    }  # fmt: skip
    return Table(cells, labels, "tools")


def summarised(
    columns: Mapping[str, AnyArray], judged: Sequence[Judged], guard: float
) -> Repetition:
    """Summary of the rows of all tools; the verdict has kept `guard` standard uncertainties from each limit."""
    status, passed, good = (columns[name] for name in ("status", "passed", "good"))
    sound = np.asarray(status == CALIBRATED)
    refused, counts = np.unique(status[~sound].astype(str), return_counts=True)
    return Repetition(
        tools=len(status),
        calibrated=Share.of(sound),
        refused=dict(zip(refused.tolist(), counts.tolist(), strict=True)),
        passed=Share.of(passed),
        good=Share.of(good & sound),
        wrong_pass=Share.of(passed & ~good),
        wrong_fail=Share.of(sound & ~passed & good),
        errors_deg={
            name: {
                word: _percentiles(columns[f"{name}_{column}_deg"][sound])
                for word, column in (("rms", "error_rms"), ("max", "error_max"), ("stated", "sd"))
            }
            for name in STATED_ANGLES
            if f"{name}_sd_deg" in columns
        },
        limits=[_limit_row(each, columns, sound, guard) for each in judged],
    )


def _limit_row(
    limit: Judged, columns: Mapping[str, AnyArray], sound: Bools, guard: float
) -> LimitRow:
    value, sd, true = (columns[limit.column(word)] for word in ("", "sd", "true"))
    wrong = (value + guard * sd <= limit.limit) != (true <= limit.limit)
    return LimitRow(
        name=f"{limit.kind} of {limit.name}",
        unit=limit.unit,
        limit=limit.limit,
        value=_percentiles(value[sound]),
        true=_percentiles(true[sound]),
        wrong=Share.of(sound & wrong),
    )


def _percentiles(values: Array) -> Percentiles:
    """The percentiles of a column, by name such as p95; None where it is empty."""
    known = values[np.isfinite(values)]
    of = np.percentile(known, PERCENTILES).tolist() if known.size else [None] * len(PERCENTILES)
    return {f"p{percent}": value for percent, value in zip(PERCENTILES, of, strict=True)}
