"""Verification: a calibration against independent readings and a limits profile. Pure data."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any, ClassVar, Literal

import msgspec
import numpy as np

from mwdcal.calibration.copies import in_fit
from mwdcal.calibration.diagnosis.identity import doubts, other_tool
from mwdcal.calibration.options import ASSUMED, UNSHARED, is_assumed, unshared
from mwdcal.calibration.readings import STAND_ANGLES_EXACT, Readings, stated_day
from mwdcal.calibration.record import (
    MARGIN,
    STATE_STAND,
    UNNAMED,
    Calibration,
    Finding,
    html_table,
    stated,
)
from mwdcal.calibration.results import unknown_gravity
from mwdcal.errors import InputError
from mwdcal.estimation.problem import ANGLES
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import AnyArray, Array, eigen
from mwdcal.sensor.profile import PRACTICES
from mwdcal.use.correction import UNKNOWN_TEMPERATURE
from mwdcal.use.roll_test import (
    DEPARTURE_CHANCE,
    HARMONICS,
    LEVEL,
    NO_ERROR_OF_A_TOOL,
    NOT_DETERMINED,
    Departures,
    Largest,
    RollTest,
    Statistic,
    largest,
)

# --------------------------------------------------------------------------
# How likely a tool is within its limits, by the values of a test and their uncertainties.
#
# A true value is normal about its value with its standard uncertainty, or follows Student's t where that has few
# degrees of freedom. Reference: JCGM 106:2012, 7.2 and 7.4; JCGM 100:2008, G.3.

COVERAGE = 2.0
"""Coverage factor of the guard band and of the remark that a value is close to its limit."""
RISK_DRAWS = 2000
RISK_SEED = 1


def cumulative(score: float, freedom: float | None) -> float:
    """Probability below a number of standard uncertainties; `freedom` None: unlimited."""
    from scipy.special import ndtr, stdtr

    unlimited = freedom is None or not np.isfinite(freedom)
    return float(ndtr(score) if unlimited else stdtr(max(freedom or 0.0, 1.0), score))


def guard_factor(freedom: float | None) -> float:
    """Factor k of a guard band beyond which as much lies as beyond `COVERAGE` standard deviations of a normal value.

    Definition: Student's t; less than one degree of freedom counts as one.
    """
    if freedom is None:
        return COVERAGE
    from scipy.special import ndtr, stdtrit

    return max(COVERAGE, float(stdtrit(max(freedom, 1.0), float(ndtr(COVERAGE)))))


def probability_within(
    value: float, sd: float, limit: float, two_sided: bool, freedom: float | None = None
) -> float:
    """Probability that the true value is at most `limit`; `two_sided`: and at least its negative.

    Definition: F((limit - value) / sd), for two sides less F((-limit - value) / sd), with F of the normal
    distribution, or of Student's t with `freedom`. Singular: without uncertainty 0 or 1.
    """
    if sd == 0:
        return float(value <= limit)
    below = cumulative((-limit - value) / sd, freedom) if two_sided else 0.0
    return cumulative((limit - value) / sd, freedom) - below


def risk_of_all(within: Sequence[float], passed: bool, errors: Array) -> float:
    """Probability that the verdict on all limits is wrong: a limit exceeded in a pass, none exceeded in a fail.

    `within`: probability for each of k limits, `errors` (d, k) of their values in tests like this one, from which
    their correlation is taken (a Gaussian copula). Both probabilities are drawn given that one limit is exceeded,
    or met, so that small ones are known too. Reference: Owen, Maximov and Chertkov 2019, ALOE.
    """
    from scipy.special import ndtr, ndtri

    chance = np.asarray(within, float)
    size = np.linalg.norm(errors, axis=0)
    correlation = errors.T @ errors / np.maximum(np.outer(size, size), 1e-300)
    values, vectors = eigen(correlation)
    rng = np.random.default_rng(RISK_SEED)
    normal = (
        rng.normal(size=(RISK_DRAWS, len(chance))) @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
    )
    uniform = (np.arange(RISK_DRAWS) + 0.5) / RISK_DRAWS

    def given(first: int, score: Array) -> Array:
        """Scores (d, k) of all limits where that of the first is known."""
        others = (
            normal - normal[:, [first]] * correlation[first] + score[:, None] * correlation[first]
        )
        others[:, first] = score
        return np.asarray(others)

    least = ndtri(chance)
    if not passed:
        first = int(chance.argmin())
        met = given(first, ndtri(chance[first] * uniform)) <= least
        met[:, first] = True
        return float(chance[first] * met.all(-1).mean())
    risk = 0.0
    for k, share in enumerate(ndtr(-least)):
        exceeded = given(k, -ndtri(share * uniform)) > least
        exceeded[:, k] = True
        risk += float(share * np.mean(1 / exceeded.sum(-1)))
    return min(risk, 1.0)


SPREAD_OF = "spread of "
"""How the name of a limit on a spread begins."""
SETTING_PRACTICES = {
    "assumed": ASSUMED,
    "per-direction": "The stand was set once per roll set: its error is common to the set.",
    "per-station": "The stand was set at every station: its errors average down over a roll set.",
}
"""How often the stand's direction was set, in words."""
DAILY_CHANGES = {
    "gravity": ("gravity_g", "gravity_g", 5e-4, 4),
    "field": ("field", "field_nt", 200.0, 0),
    "dip": ("dip_deg", "dip_deg", 0.2, 2),
}
"""Keys of `Calibration.earth` and `[stand]`, largest change in a day with the rounding of sheets, and decimals."""
WEAK = 0.5
"""A test whose 1σ is a larger share of the limit hardly distinguishes a good tool from a bad one."""
NAMED_HARMONIC = 3.0
"""Standard uncertainties above which a harmonic is named as a cause."""
STRAIGHT_BACK = 180.0
"""Error of an angle of the opposite direction, degrees."""
STEADY_OVER_TURN = 2.0
"""An error is the same over a turn where its mean is more than so many times its harmonics."""
FIRST_HARMONIC = {
    "inclination": "a bias of the accelerometer across the tool axis, or it leans",
    "azimuth": "a bias across the tool axis of either triad, or it leans",
    "gravity": "a bias of the accelerometer across the tool axis, or its x or y is not square to z",
}
"""Causes of a first harmonic of toolface; as for azimuth where not named."""
SECOND_HARMONIC = "a difference in scale, or a misalignment, of "
"""Causes of a second harmonic."""
VERDICT_FINDINGS = {
    "no-temperature": "the calibration has no temperature terms, and its run recorded no temperature: the verdict "
    "holds at the temperature of the test alone{tested}.",
    "outside-temperature": "{where} lie outside the calibrated range {calibrated} °C. The calibration has no "
    "temperature terms: drift over the difference counts as its error.",
    "temperature-unknown": f"{UNKNOWN_TEMPERATURE}.",
    "not-judged": "not judged: {limits}.",
    "contradicted": "the readings contradict references of the run that no limit judges: {what}. Check their unit, "
    "sign and place; or signs or axes of a sensor are exchanged. The verdict says nothing about it.",
    "contradicted-by-run": "the calibration's run and this test are of one day and state different references: {what}. "
    "Unless they were at two places, correct the wrong one; one of the run is an error of every survey.",
    "no-roll-set": "no roll set: spreads were not judged.",
    "stand-exact": "the angles of the stand count as exact in this test, and did not in the calibration's run: the "
    "errors and the risk are too small by those of the stand. State their 1σ, by `sd` of mwdcal.readings or in "
    "columns such as sd_ref_inclination_deg.",
    "harmonic-unseen": "{title}: the toolfaces hardly show the second harmonic of a turn, a difference of scales or a "
    "misalignment of x and y (four at right angles fit a mean and the first harmonic alone). The value may be "
    "too small by it: add toolfaces between them.",
    "little-scatter": "{title}: the readings scatter less about the curves than the {noise} noise explains (chance "
    "below {chance:g}). {stand}This noise is too large, or the tool moved, during the run of the calibration or as "
    "readbacks say: both count as noise. Else readings are repeated, or stations apart in the table share one "
    "setting of the stand (then give them one group: it is counted once). The 1σ comes from the {noise} noise.",
    "settings-doubted": "{title}: the readings scatter about the curves as if the stand was set at every station. Its "
    "error is counted both ways. State [stand] settings in the profile.",
    "settings-unshared": UNSHARED,
    "not-smooth": "{title}: the readings leave a smooth curve over toolface by far more than their noise. So the raw "
    "figure is judged with all its noise, and its 1σ comes from their scatter about that curve. A station was "
    "misread or moved, or the tool has an error that these toolfaces do not resolve.",
    "weak-test": "{row.name}: its 1σ of {size} is more than half of the limit: by this limit alone the "
    "test can hardly tell a good tool from a bad one. Average longer at each station, or take more toolfaces.",
    "constant-error": "{row.name}: every station is off by {size}° alike, which no tool does. The reference {angle} is "
    "most likely wrong by as much: {hint}? Correct it and verify again.",
    "roll-harmonics": "{row.name} over a turn of toolface: {causes}.",
}


class Bounds(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Limits of one kind, each optional."""

    inclination_deg: float | None = None
    azimuth_deg: float | None = None
    toolface_deg: float | None = None
    gravity_g: float | None = None
    field_nt: float | None = None
    dip_deg: float | None = None

    def items(self) -> Iterable[tuple[str, float]]:
        """Observable and limit, of those that are set; angles in degrees."""
        for name, value in msgspec.structs.asdict(self).items():
            if value is not None:
                yield name.rpartition("_")[0], value


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A limits profile: what a roll test may show, where the limits come from, and the rule.

    rule "simple": a noise-free value passes up to its limit. "guarded": value plus twice its
    standard uncertainty must not exceed the limit.
    """

    name: str
    source: str = ""
    rule: Literal["simple", "guarded"] = "simple"
    spread: Bounds = Bounds()
    error: Bounds = Bounds()


class JudgedSet(msgspec.Struct, frozen=True, kw_only=True):
    """The result of one roll set for one limit, or, without a `label`, the stations outside of roll sets.

    `stations` are their places in `Verdict.station_rows`, from 0. `coefficients` of the curve that
    was judged: mean, cos t, cos 2t, sin t, sin 2t of toolface t, in the unit of the limit; None:
    the set was not rolled, or the figure judged is the raw one of each station. With one of `harmonics`, as
    of four toolfaces at right angles, the coefficients of 2t are zero. `passed`: by this set alone.
    `degrees_of_freedom` of the uncertainty; None: unlimited, as the noise is declared. `raw`: the largest figure
    with the noise in it; None in documents of earlier versions.
    """

    label: str
    stations: list[int]
    coefficients: list[float] | None
    value: float
    uncertainty: float
    passed: bool
    harmonics: int = len(HARMONICS)
    degrees_of_freedom: float | None = None
    raw: float | None = None

    @property
    def judged_raw(self) -> bool:
        """Whether `value` is the raw figure of a rolled set, whose error is not smooth."""
        return self.coefficients is not None and self.value == self.raw


class VerifiedStation(msgspec.Struct, frozen=True, kw_only=True):
    """One station of the test: attitude as corrected, and what it shows of each limit, noise included.

    `toolface_deg` is the one by which the tool was rolled: near vertical the magnetic one.
    `departures`, by name of the limit and in its unit: of an error, the error; of a spread, the
    departure from the middle of its roll set's curve. `over` names the limits that they exceed; of a
    spread, by more than half of it.
    """

    station: str
    temperature_c: float | None
    inclination_deg: float | None
    azimuth_deg: float | None
    toolface_deg: float | None
    departures: dict[str, float]
    over: list[str]


CANNOT_BE_PASSED = "cannot be passed: "
"""Beginning of the note of a limit that no value could meet."""


class VerdictRow(msgspec.Struct, frozen=True, kw_only=True):
    """One limit: the noise-free value, its standard uncertainty, and the decision.

    `value` is that of the worst set or station; of several the largest, less what noise adds to it.
    `degrees_of_freedom` of `uncertainty`: None, unlimited, as the noise is declared; absent in documents of
    earlier versions. `probability_within`: that the true value is within the limit.

    `raw` is the same figure with the noise in it: largest minus smallest value of a set as the
    papers define a spread, or the largest departure of any station. `harmonics` are the
    amplitudes of the first and second harmonic of toolface in the set that decided. None: it
    cannot be stated.
    """

    name: str
    unit: str
    value: float | None
    uncertainty: float | None
    limit: float
    passed: bool
    note: str
    raw: float | None = None
    harmonics: tuple[float, float] | None = None
    sets: list[JudgedSet] = []
    degrees_of_freedom: float | msgspec.UnsetType | None = msgspec.UNSET
    probability_within: float | None = None

    @property
    def freedom(self) -> float | None:
        """Degrees of freedom of the uncertainty; None: unlimited, or not stated."""
        stated = self.degrees_of_freedom
        return None if isinstance(stated, msgspec.UnsetType) else stated

    @property
    def judged_raw(self) -> bool:
        """Whether `value` is the raw figure of a rolled set, whose error is not smooth."""
        return any(each.judged_raw and each.value == self.value for each in self.sets)

    @property
    def two_sided(self) -> bool:
        """Whether a true value may lie beyond the limit on either side: an error, not a spread."""
        return not self.name.startswith(SPREAD_OF)

    @property
    def bound(self) -> float:
        """Largest departure, up or down: the limit on an error, half of that on a spread."""
        return self.limit if self.two_sided else self.limit / 2


class Verdict(msgspec.Struct, frozen=True, kw_only=True, dict=True):
    """The outcome of a verification; `sheet` of the workbook `run`, blank of other files; `date` as the run states it.

    `degrees_of_freedom`: of the triad of the calibration with the fewest. None: a document of an earlier version.
    `risk`: probability that the verdict is wrong, all sets and limits together: that a true value is beyond
    its limit in a pass, that none is in a fail. None: a limit was not or cannot be judged, or readings are not smooth.
    `not_judged`: names of limits without a row, as the run lacks something; absent in documents of earlier versions.
    `settings`: how often the stand's direction was set, "per-direction", "per-station", or "assumed" to be once
    per direction; empty where nobody stated it and nothing rests on it.
    """

    passed: bool
    rule: str
    limits: str
    source: str
    run: str
    sheet: str = ""
    date: str = ""
    stations: int
    rows: list[VerdictRow]
    findings: list[Finding]
    station_rows: list[VerifiedStation] = []
    degrees_of_freedom: float | None = None
    risk: float | None = None
    not_judged: list[str] = []
    settings: str = ""

    plot: ClassVar[Any]
    """Figures of the verdict, as `Calibration.plot`."""
    summary: ClassVar[Callable[..., str]]
    to_dict: ClassVar[Callable[..., dict[str, Any]]]
    """As of `Calibration`."""
    columns: ClassVar[dict[str, AnyArray]]
    """The corrected stations with 1σ, by the names of `apply`; not of a verdict read from a file."""
    to_pandas: ClassVar[Callable[..., Any]]

    @property
    def data(self) -> str:
        """The file of the roll test, and its sheet."""
        return f"{self.run}, sheet '{self.sheet}'" if self.sheet else self.run or UNNAMED

    @property
    def left_open(self) -> str:
        """Directions that the calibration leaves undetermined, where these alone make it fail; else empty."""
        start = CANNOT_BE_PASSED + NOT_DETERMINED
        notes = [row.note for row in self.rows if not row.passed]
        if not notes or not all(note.startswith(start) for note in notes):
            return ""
        return max((note.removeprefix(start) for note in notes), key=len)

    def __repr__(self) -> str:
        failed = ", ".join(row.name for row in self.rows if not row.passed)
        decision = "passed" if self.passed else f"failed ({failed})"
        decision += f", {len(self.not_judged)} not judged" if self.not_judged else ""
        return f"<Verdict: {decision}, {len(self.rows)} limits of {self.limits}>"

    def _repr_html_(self) -> str:
        header = ("", "value", "1σ", "limit", "")
        lines = [
            (
                f"{row.name}, {row.unit}",
                *("" if v is None else f"{v:.3g}" for v in (row.value, row.uncertainty, row.limit)),
                "pass" if row.passed else "fail",
            )
            for row in self.rows
        ]
        without = f" (not judged: {', '.join(self.not_judged)})" if self.not_judged else ""
        return html_table(("Passed" if self.passed else "Failed") + without, [header, *lines])


RULES = {
    "simple": "simple acceptance: pass if the noise-free value is within the limit; 1σ is shown for information",
    "guarded": "guarded acceptance: noise-free value + 2 × its 1σ must not exceed the limit",
}
"""Decision rules in words. Of a 1σ with few degrees of freedom Student's factor takes the place of 2."""


def verify(calibration: Calibration, readings: Readings, limits: Limits) -> Verdict:
    """Apply a calibration to independent readings, and judge the result by a limits profile.

    Raises:
        InputError: stations of the fit, temperatures outside the calibrated range, or readings to
            which no limit applies.
    """
    for check in (_check_tool, _check_independent, _check_temperature):
        check(calibration, readings)
    test = RollTest(calibration, readings)
    _check_rolled(test)
    outcomes = [(SPREAD_OF + n, n, most, test.spread(n)) for n, most in limits.spread.items()]
    outcomes += [(f"error of {n}", n, most, test.error(n)) for n, most in limits.error.items()]
    reasons = {title: each.skipped for title, *_, each in outcomes if each.skipped}
    skipped = _skipped(reasons)
    outcomes = [outcome for outcome in outcomes if not outcome[-1].skipped]
    judged = [_judged(*outcome, limits.rule == "guarded") for outcome in outcomes]
    if not judged:
        raise InputError(
            f"{readings.name}: no limit of '{limits.name}' applies: {'; '.join(skipped)}. Add what "
            "is missing, or choose other `limits`."
        )
    rows = [each.row for each in judged]
    passed = all(row.passed for row in rows)
    return Verdict(
        passed=passed,
        rule=RULES[limits.rule],
        limits=limits.name,
        source=limits.source,
        run=readings.source,
        sheet=readings.sheet,
        date=str(readings.metadata.get("date", "")),
        stations=readings.count,
        rows=rows,
        findings=[
            *_findings(test, skipped),
            *_contradicted(test, limits),
            *_differing(test),
            *_remarks(
                test, judged, STATE_STAND * (STAND_ANGLES_EXACT in calibration.assumed_exact)
            ),
            *chain(*(j.findings for j in judged)),
        ],
        station_rows=_station_rows(test, rows, [outcome[-1] for outcome in outcomes]),
        degrees_of_freedom=fewest_degrees_of_freedom(calibration),
        risk=None if skipped else _risk(judged, passed),
        not_judged=list(reasons),
        settings="assumed" if is_assumed(readings) else readings.settings,
    )


@dataclass(frozen=True)
class _Judged:
    """A limit with its decision, the findings about it, and the `errors` (d,) of its value in tests like this one.

    `remarks`: ids of findings that several limits may share.
    """

    row: VerdictRow
    findings: list[Finding]
    remarks: tuple[str, ...]
    errors: Array | None = None


def _remarks(test: RollTest, judged: Sequence[_Judged], stand: str) -> Iterator[Finding]:
    """Findings that several limits share, each once; `stand`: of a calibration that took its angles as exact."""
    for name in dict.fromkeys(chain(*(each.remarks for each in judged))):
        rows = [each.row for each in judged if name in each.remarks]
        freedom = (test.noise_freedom(row.name.rpartition(" of ")[2]) for row in rows)
        noise = dict.fromkeys("estimated" if np.isfinite(each) else "stated" for each in freedom)
        title, whose = ", ".join(row.name for row in rows), " or ".join(noise)
        yield _finding(name, title=title, noise=whose, chance=DEPARTURE_CHANCE, stand=stand)


def _risk(judged: Sequence[_Judged], passed: bool) -> float | None:
    """Probability that the verdict on all limits is wrong; None where a limit could not be judged."""
    within = [each.row.probability_within for each in judged]
    errors = [each.errors for each in judged if each.errors is not None]
    known = [chance for chance in within if chance is not None]
    if not len(known) == len(errors) == len(judged):
        return None
    return risk_of_all(known, passed, np.stack(errors, -1))


def fewest_degrees_of_freedom(calibration: Calibration) -> float:
    """Degrees of freedom of the residuals of the triad that has the fewest."""
    return min(triad.degrees_of_freedom for triad in calibration.triads)


def _station_rows(
    test: RollTest, rows: Sequence[VerdictRow], outcomes: Sequence[Departures]
) -> list[VerifiedStation]:
    """Every station of the test, with its departures in each row that has statistics of it."""
    readings = test.readings
    departures: list[dict[str, float]] = [{} for _ in range(readings.count)]
    for row, outcome in zip(rows, outcomes, strict=True):
        factor = _scale(row.unit)
        for statistic in outcome.statistics:
            for i, part in zip(statistic.index, (statistic.part * factor).tolist(), strict=True):
                departures[i][row.name] = part
    bounds = {row.name: row.bound for row in rows}
    attitude = test.value("inclination"), test.value("azimuth"), test.toolface
    warmth = (
        np.full(readings.count, np.nan) if readings.temperature is None else readings.temperature
    )
    each = np.stack([warmth, *np.degrees(attitude)], -1)
    names = ("temperature_c", "inclination_deg", "azimuth_deg", "toolface_deg")
    return [
        VerifiedStation(
            station=label,
            **dict(zip(names, map(stated, values), strict=True)),
            departures=shown,
            over=[name for name, value in shown.items() if abs(value) > bounds[name]],
        )
        for label, values, shown in zip(readings.labels, each, departures, strict=True)
    ]


def _skipped(reasons: dict[str, str]) -> list[str]:
    """Limits that were not judged, by reason."""
    names: dict[str, list[str]] = {}
    for name, reason in reasons.items():
        names.setdefault(reason, []).append(name)
    return [f"{', '.join(names[reason])} ({reason})" for reason in names]


def _findings(test: RollTest, skipped: Sequence[str]) -> Iterator[Finding]:
    """Findings about the verdict as a whole, and about limits that were not judged."""
    calibration, readings = test.calibration, test.readings
    warmth = readings.temperature
    tested = "" if warmth is None else _span(float(warmth.min()), float(warmth.max()))
    yield from calibration.change_findings()
    yield from doubts(calibration, readings)
    if beyond := int(calibration.outside(readings, MARGIN).sum()):
        where = f"{beyond} of {readings.count} stations ({tested} °C)"
        calibrated = _span(*calibration.temperature_c or (np.nan, np.nan))
        yield _finding("outside-temperature", where=where, calibrated=calibrated)
    if warmth is None and calibration.temperature_c:
        yield _finding("temperature-unknown", calibrated=f"{_span(*calibration.temperature_c)} °C")
    free: dict[tuple[str, str], list[str]] = {}  # what both triads leave free is said once
    for entry in calibration.undetermined():
        triad, colon, text = entry.text.partition(": ")
        free.setdefault((entry.id, colon + text), []).append(triad)
    for (name, text), triads in free.items():
        yield Finding(id=name, text=f"{' and '.join(triads)}{text}.")
    if skipped:
        yield _finding("not-judged", limits="; ".join(skipped))
    if not test.sets:
        yield _finding("no-roll-set")
    exact = bool(readings.exact_angles[STAND_ANGLES_EXACT])
    if exact and STAND_ANGLES_EXACT not in calibration.assumed_exact:
        yield _finding("stand-exact")
    if readings.settings == PRACTICES[0] and (count := int(unshared(readings))):
        yield _finding("settings-unshared", count=count)
    if calibration.temperature_c is None:
        yield _finding("no-temperature", tested=f", {tested} °C" if tested else "")


def _contradicted(test: RollTest, limits: Limits) -> Iterator[Finding]:
    """References of the run far from what the tool reads, of quantities whose error is not judged."""
    judged = {name for name, _ in limits.error.items()}
    parts = []
    for name in NO_ERROR_OF_A_TOOL.keys() - judged:
        if departure := test.contradicted(name):
            unit = OBSERVABLES[name].unit.replace("rad", "°")
            size = departure * _scale(unit)
            parts.append(f"{name} by {size:+.3g}{'' if unit == '°' else ' '}{unit}")
    if parts:
        yield _finding("contradicted", what=", ".join(sorted(parts)))


def _differing(test: RollTest) -> Iterator[Finding]:
    """References that the calibration's run of the same day states otherwise; in a coil gravity alone counts."""
    calibration, readings, parts = test.calibration, test.readings, []
    stand, day = calibration.profile.stand, stated_day(readings.metadata)
    unstated = {constant.name for constant in calibration.constants}
    unstated |= {"gravity"} if unknown_gravity(calibration) else set()
    unstated |= {"field", "dip"} if calibration.relative or stand.coil else set()
    if day is None or day != stated_day(calibration.tool):
        return
    for name, (key, declared, most, decimals) in DAILY_CHANGES.items():
        here = np.asarray(readings.known.get(name, np.nan), float)
        if name in unstated or key not in calibration.earth or np.isnan(here).all():
            continue
        unit = OBSERVABLES[name].unit.replace("rad", "°")
        value, sd = (_scale(unit) * np.nanmean(x) for x in (here, readings.uncertainty(name)))
        theirs = calibration.earth[key]
        if abs(value - theirs) > most + COVERAGE * np.hypot(sd, stand.of(declared)):
            unit = unit if unit == "°" else f" {unit}"
            parts.append(f"{name} {theirs:.{decimals}f}{unit} and {value:.{decimals}f}{unit}")
    if parts:
        yield _finding("contradicted-by-run", what=", ".join(parts))


def _finding(name: str, **values: object) -> Finding:
    return Finding(id=name, text=VERDICT_FINDINGS[name].format(**values))


def _span(low: float, high: float) -> str:
    return f"{low:.1f}…{high:.1f}" if high - low >= 0.1 else f"{low:.1f}"


def _check_tool(calibration: Calibration, readings: Readings) -> None:
    if other := other_tool(calibration, readings):
        raise InputError(
            f"{readings.name} is of tool {other[1]}, the calibration of tool {other[0]}. Verify with a "
            "run of the same tool, or correct 'serial' in the file."
        )


def _check_independent(calibration: Calibration, readings: Readings) -> None:
    used = np.flatnonzero(in_fit(calibration, readings))
    if not used.size:
        return
    known, again = np.array(calibration.used(readings.digest), bool), ""
    if not known.any():
        again = (
            ", or repeat its readings more closely than noise allows: copies with other digits. If they are "
            "measurements, state the noise and the uncertainties of the stand in the tool profile of the calibration"
        )
    raise InputError(
        f"{readings.name}: {used.size} of {readings.count} stations were in the fit (first: "
        f"station {readings.labels[used[0]]}){again}. Verification needs data that the fit has not seen: take a roll "
        "test of its own: in another file, on another sheet of this one, or rows that a column marks as roll test."
    )


def _check_temperature(calibration: Calibration, readings: Readings) -> None:
    outside, valid = np.flatnonzero(calibration.outside(readings)), calibration.valid_temperatures
    if outside.size and valid:
        low, high = valid
        lie = "station lies" if outside.size == 1 else "stations lie"
        raise InputError(
            f"{readings.name}: {outside.size} {lie} outside the calibrated range, good for {low:.1f}…{high:.1f} °C "
            f"(first: station {readings.labels[outside[0]]}). Verify within the range, or calibrate over a wider one."
        )


def _check_rolled(test: RollTest) -> None:
    """Refuse a run that names no direction, where its stations are of several or no set of them is rolled."""
    readings, everything = test.readings, np.arange(test.readings.count)
    if (readings.groups >= 0).any() or np.isfinite(readings.reference("inclination")).any():
        return
    gaps = [test.loose(each.index) for each in test.sets]
    if test.off_plane(everything) > np.sin(NO_ERROR_OF_A_TOOL["inclination"]):
        angles = np.degrees(test.value("inclination"))
        why = (
            f"its stations, at inclinations from {angles.min():.1f}° to {angles.max():.1f}°, are of several "
            "directions. Name another table, or give ref_inclination_deg and ref_azimuth_deg, or a group for each "
            "direction"
        )
    elif gaps and all(gaps):
        why = f"{gaps[0]}, or name another table"
    else:
        return
    raise InputError(
        f"{readings.name} is no roll test, in which the tool is rolled all round about an axis that stands still: "
        f"{why}."
    )


def _judged(title: str, name: str, limit: float, outcome: Departures, guarded: bool) -> _Judged:
    """The decision on one limit, by the worst set or station, and the findings about it."""
    unit = OBSERVABLES[name].unit.replace("rad", "°")
    factor = _scale(unit)
    findings = [Finding(id="partly-judged", text=f"{title}: {text}.") for text in outcome.apart]
    remarks = (*(["harmonic-unseen"] if outcome.unseen else []), *outcome.remarks)
    most = max((each.raw * factor for each in outcome.statistics), default=None)
    sets = _sets(outcome, factor, guarded, limit)
    if outcome.blocked:
        row = VerdictRow(
            name=title, unit=unit, value=None if outcome.unrolled else most, uncertainty=None,
            limit=limit, passed=False, note=CANNOT_BE_PASSED + outcome.blocked, raw=most,
            sets=sets, degrees_of_freedom=None,
        )  # fmt: skip
        return _Judged(row, findings, remarks)
    overall = _largest(outcome)
    worst = outcome.statistics[int(overall.place)]
    value, sd, freedom = (
        float(overall.value) * factor,
        float(overall.uncertainty) * factor,
        stated_freedom(worst.freedom),
    )
    passed = value + guard(guarded, freedom) * sd <= limit
    taken = (worst.value - float(overall.value)) * factor
    note = worst.where + ("" if worst.rough else _choice(outcome, taken, unit))
    row = VerdictRow(
        name=title, unit=unit, value=value, uncertainty=sd, limit=limit, passed=passed,
        note=note + _remark(value, 0.0 if worst.rough else sd, limit, passed), raw=most,
        harmonics=_harmonics(worst, factor), sets=sets, degrees_of_freedom=freedom,
    )  # fmt: skip
    if worst.rough:  # by a station misread or moved, of which no probability is known
        remarks = (*remarks, "not-smooth")
    else:
        within = probability_within(value, sd, limit, row.two_sided, freedom)
        row = msgspec.structs.replace(row, probability_within=within)
    if sd > WEAK * limit and not worst.rough:
        size = f"{sd:.2g}{'' if row.unit == '°' else ' '}{row.unit}"
        findings.append(_finding("weak-test", row=row, size=size))
    if off := list(_constant_error(row, name, worst)):
        findings += off
    elif causes := _causes(row, name, worst):
        findings.append(_finding("roll-harmonics", row=row, causes="; ".join(causes)))
    return _Judged(row, findings, remarks, overall.errors)


def guard(guarded: bool, freedom: float | None) -> float:
    """Standard uncertainties by which a value must stay below its limit."""
    return guard_factor(freedom) if guarded else 0.0


def _largest(outcome: Departures) -> Largest:
    """The largest of all statistics, without the bias of the choice."""
    each = outcome.statistics
    values, sds = (np.array([getattr(x, n) for x in each]) for n in ("value", "uncertainty"))
    errors, rough = np.stack([x.errors for x in each], -1), np.array([x.rough for x in each])
    return largest(values, sds, errors, rough)


def stated_freedom(freedom: float) -> float | None:
    """Degrees of freedom as a document has them: None where they are unlimited."""
    return freedom if np.isfinite(freedom) else None


def _choice(outcome: Departures, taken: float, unit: str) -> str:
    """The amount taken off the largest of several noise-free figures."""
    each = [one for one in outcome.statistics if not one.rough]
    if len(each) == 1:
        return ""
    kind = "values" if any(not one.label for one in each) else "roll sets"
    size = f"{taken:.2g}{'' if unit == '°' else ' '}{unit}"
    return f"; the largest of {len(each)} {kind}: {size} taken off for the choice"


def _scale(unit: str) -> float:
    """Factor from the unit of calculation to that of a limit."""
    return float(np.degrees(1)) if unit == "°" else 1.0


def _sets(outcome: Departures, factor: float, guarded: bool, limit: float) -> list[JudgedSet]:
    """The roll sets behind a row, and the stations outside of them as one; none passes where no limit can."""
    by_label: dict[str, list[Statistic]] = {}
    for each in outcome.statistics:
        by_label.setdefault(each.label, []).append(each)
    sets = []
    for label, members in by_label.items():
        worst = max(members, key=lambda each: each.value)
        value, sd, curve = worst.value * factor, worst.uncertainty * factor, worst.curve
        freedom = stated_freedom(worst.freedom)
        sets.append(
            JudgedSet(
                label=label,
                stations=np.concatenate([each.index for each in members]).tolist(),
                coefficients=None if curve is None else (curve.coefficients * factor).tolist(),
                value=value,
                uncertainty=sd,
                passed=not outcome.blocked and value + guard(guarded, freedom) * sd <= limit,
                harmonics=len(HARMONICS) if curve is None else curve.harmonics,
                degrees_of_freedom=freedom,
                raw=max(each.raw for each in members) * factor,
            )
        )
    return sets


def _remark(value: float, sd: float, limit: float, passed: bool) -> str:
    """How close the decision was."""
    if value <= limit and not passed:
        return "; within the limit, but not by twice its uncertainty as the guarded rule asks"
    close = abs(value - limit) < COVERAGE * sd
    return "; closer to the limit than twice its uncertainty" if close else ""


def _harmonics(worst: Statistic, factor: float) -> tuple[float, float] | None:
    if worst.curve is None:
        return None
    first, second = (worst.curve.amplitudes * factor).tolist()
    return first, second


def _constant_error(row: VerdictRow, name: str, worst: Statistic) -> Iterator[Finding]:
    """That the error of a failed angle is the same over a turn, and larger than any tool's."""
    if row.passed or row.harmonics is None or worst.curve is None or name not in ANGLES:
        return
    mean, most = (
        float(np.degrees(worst.curve.coefficients[0])),
        np.degrees(NO_ERROR_OF_A_TOOL[name]),
    )
    if row.two_sided and abs(mean) > max(most, STEADY_OVER_TURN * sum(row.harmonics)):
        back = abs(abs(mean) - STRAIGHT_BACK) < most
        size = f"{abs(mean):.3g}" if back else f"{mean:+.3g}"
        hint = "the opposite direction" if back else "another zero, north or sense"
        yield _finding("constant-error", row=row, angle=name, size=size, hint=hint)


def _causes(row: VerdictRow, name: str, worst: Statistic) -> list[str]:
    """The likely causes of a failed limit, from the harmonics of the set that decided."""
    if row.passed or row.harmonics is None or worst.curve is None:
        return []
    unit = row.unit if row.unit == "°" else f" {row.unit}"
    clear = worst.curve.amplitudes / np.maximum(worst.curve.amplitude_sd, 1e-30) > NAMED_HARMONIC
    axes = "the accelerometer's x and y" if name in LEVEL else "x and y of either triad"
    causes = FIRST_HARMONIC.get(name, FIRST_HARMONIC["azimuth"]), SECOND_HARMONIC + axes
    each = zip(("first", "second"), row.harmonics, causes, strict=True)
    parts = [f"{which} harmonic {size:.2g}{unit} ({cause})" for which, size, cause in each]
    return [part for part, named in zip(parts, clear, strict=True) if named]
