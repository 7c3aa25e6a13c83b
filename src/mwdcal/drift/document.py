"""The statements about the drift of a tool and of a fleet: pure data, as pages, screens and JSON have it."""

from __future__ import annotations

import msgspec

from mwdcal.calibration.record import Finding


class ComparedCalibration(msgspec.Struct, frozen=True, kw_only=True):
    """One calibration of the history: `used` in the comparison or not, and what of it is not compared."""

    date: str
    run: str
    sha256: str
    used: bool
    notes: list[str]


class ParameterCourse(msgspec.Struct, frozen=True, kw_only=True):
    """A parameter in the calibrations that are compared, in their order.

    `standard_uncertainties` None: undetermined. `low` and `high`: control limits, within which a value is
    expected by the calibration before, both uncertainties and the tool's random walk (99.7 %); None
    where there is nothing to expect it by. `score`: the largest of a step of this parameter alone.
    """

    triad: str
    name: str
    unit: str
    values: list[float | None]
    standard_uncertainties: list[float | None]
    low: list[float | None]
    high: list[float | None]
    score: float | None
    outside: list[bool]


class ParameterStep(msgspec.Struct, frozen=True, kw_only=True):
    """A change of one parameter between two calibrations.

    `score`: the change over its standard uncertainty if nothing else changed.
    """

    triad: str
    name: str
    unit: str
    after: str
    by: str
    change: float
    standard_uncertainty: float
    score: float


class Transition(msgspec.Struct, frozen=True, kw_only=True):
    """Two successive calibrations compared: misfit (χ²) of one set of parameters to both.

    `probability` that an unchanged tool shows this much; it is drawn, and 0.0005 (1 of 2,000) means 0.0005 or less.
    """

    start: str
    end: str
    misfit: float
    degrees_of_freedom: int
    probability: float


class ChangeVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """Whether a tool changed: `probability` that an unchanged one shows this much, over all parameters and transitions.

    `largest_score` of all steps of one parameter, and the `critical_score` that raises an alarm; `misfit` (χ²)
    of one set of parameters to all calibrations. Probabilities are drawn: 0.0001 (1 of 10,000) means 0.0001 or less.
    """

    changed: bool
    level: float
    probability: float
    largest_score: float
    critical_score: float
    misfit: float
    degrees_of_freedom: int
    misfit_probability: float
    steps: list[ParameterStep]
    transitions: list[Transition]


class WalkRate(msgspec.Struct, frozen=True, kw_only=True):
    """Random walk of a kind of parameters: standard deviation of what they move by in a year, 90 % interval."""

    triad: str
    kind: str
    unit: str
    per_root_year: float
    low: float
    high: float


class DueDate(msgspec.Struct, frozen=True, kw_only=True):
    """When the largest error of an angle over azimuth and toolface, at 45° inclination, exceeds its limit.

    `due`: the day on which it does with a probability of `risk`, or earlier where the tool left a limit in a shorter
    time. It leaves the limit by `expected` with 50 %; `not_before` and `not_after` hold that day with 90 %. `now_deg`:
    95 % bound of the error on the day of the calibration. `capped`: `not_after` stands for a day beyond five years.
    """

    angle: str
    limit_deg: float
    now_deg: float
    due: str
    risk: float
    not_before: str
    expected: str
    not_after: str
    capped: bool


class AccuracyForecast(msgspec.Struct, frozen=True, kw_only=True):
    """1σ of an angle, degrees, by years after the latest calibration: expected, and 90 % interval."""

    angle: str
    years: list[float]
    sd_deg: list[float]
    low_deg: list[float]
    high_deg: list[float]


class ServiceRow(msgspec.Struct, frozen=True, kw_only=True):
    """One limit as left and as found: what changed in service, with its standard uncertainty."""

    calibrated: str
    as_left_date: str
    as_found_date: str
    name: str
    unit: str
    limit: float
    as_left: float | None
    as_found: float | None
    change: float | None
    standard_uncertainty: float | None
    score: float | None
    as_left_passed: bool
    as_found_passed: bool


class ToolDrift(msgspec.Struct, frozen=True, kw_only=True):
    """How one tool changes from calibration to calibration, and when the next one is due.

    `basis` of the rates: "tool and peers", "peers" or none. `change` is None of a single calibration, `due` empty
    where nothing can be predicted. `next_due`: the day on which the tool is beyond any of its limits with the risk
    of these, or the earlier one that a limit it has left before allows.
    """

    serial: str
    type: str
    simulated: bool
    temperature_c: tuple[float, float] | None
    calibrations: list[ComparedCalibration]
    parameters: list[ParameterCourse]
    change: ChangeVerdict | None
    basis: str
    peers: int
    rates: list[WalkRate]
    forecast: list[AccuracyForecast]
    due: list[DueDate]
    next_due: str | None
    service: list[ServiceRow]
    findings: list[Finding]


class FleetTool(msgspec.Struct, frozen=True, kw_only=True):
    """A tool among others: when calibrated last, whether changed and by what, and when due.

    `probability` as in `ChangeVerdict`: 0.0001 means 0.0001 or less.
    """

    serial: str
    type: str
    calibrations: int
    calibrated: str
    changed: bool | None
    probability: float | None
    largest_score: float | None
    parameter: str
    next_due: str | None
    not_before: str | None
    overdue: bool
    left_limits: bool


class FleetDrift(msgspec.Struct, frozen=True, kw_only=True):
    """The drift of many tools: counts, the worst first, those due first.

    `scores`: counts of the largest score of each tested tool by `score_edges`, over the critical one of the tool.
    `by_chance`: how many tools would be called changed if none had.
    """

    simulated: bool
    level: float
    today: str
    tools: int
    tested: int
    changed: int
    by_chance: float
    left_limits: int
    overdue: int
    unpredicted: int
    refused: dict[str, str]
    score_edges: list[float]
    scores: list[int]
    rates: dict[str, list[WalkRate]]
    worst: list[FleetTool]
    due: list[FleetTool]
