"""Noise of the raw channels of a log of a tool at rest: Allan deviation, terms, one station.

A channel has a rate of its own where its cells are blank at regular places. A channel with a
fault is left out, with a finding; a fault of the log is an error.

The noise of a station of T seconds is the Allan deviation at T: 1 σ of a mean over T, as two
stations show it that follow each other. It is taken from the fitted terms or, where that has
far more degrees of freedom or the terms do not describe the channel, from the variance measured
at T itself.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, ClassVar, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from mwdcal.calibration.readings import is_simulated
from mwdcal.calibration.record import Finding
from mwdcal.calibration.residuals import rms
from mwdcal.errors import InputError
from mwdcal.files.contract import CHANNELS, RAW
from mwdcal.files.formats.columns import shown
from mwdcal.files.formats.table import Table
from mwdcal.files.logs import Say, silent
from mwdcal.geometry.vectors import Array
from mwdcal.logs import allan, regular
from mwdcal.logs.allan import Kind, Moments, NoiseTerms
from mwdcal.logs.regular import ANY, DURATION, RATE, SAME_DURATION, check_argument, is_number
from mwdcal.logs.standstill import Cells
from mwdcal.sensor.profile import Profile

KINDS = ("overlapping", "modified")
"""Allan deviations whose degrees of freedom, and so bands, are known here."""
STATION_SECONDS = 30.0
"""Duration of a station, unless the log is too short for it."""
AVERAGES = 4
"""Stations that a log has to hold at least."""
SOUND = 10
"""Stations that a log holds where their duration is chosen for it."""
EVENT = 8.0
"""Size of a difference, in robust standard deviations, that no noise reaches."""
ROBUST = 1.4826
"""Standard deviation of normal noise over its median size."""
STEP_ROUNDING = 1e-6
"""Rounding error of a ratio of whole numbers of steps of the converter."""
EVENT_PARTS = 256
"""Averages in a log between which events are looked for."""
UNEVEN = 2.0
"""Ratio of the noise of two channels of a triad that is reported."""
COARSE = 0.5
"""Noise of one sample, in steps of the converter, below which the steps hide it."""
DOUBTS = {
    regular.NOT_AT_REST: "the tool was not at rest",
    "event": "a spike or a move",
    "misfit": "noise that the five terms do not describe",
    "slow": "less than a sample in a station",
}
"""Findings after which the figures of a channel do not hold, in words; `slow`: that of a station."""
TERM_UNITS = {
    "quantisation": "·s",
    "white": "·√s",
    "bias-instability": "",
    "random-walk": "/√s",
    "drift": "/s",
}
"""What follows the unit of the channel in that of a term."""
PHYSICAL = {"accelerometer": "g", "magnetometer": "nT"}


class Term(msgspec.Struct, frozen=True, kw_only=True):
    """One noise term: `value` and `standard_uncertainty` are None where the log does not show it.

    `lower` and `upper` enclose it with 95 %; without a value `upper` is a bound of 95 %.
    """

    value: float | None
    standard_uncertainty: float | None
    lower: float
    upper: float
    unit: str


class StationNoise(msgspec.Struct, frozen=True, kw_only=True):
    """1 σ of one station's mean, its 95 % interval, and whether from `terms` or `measured`."""

    noise: float
    lower: float
    upper: float
    source: str


class ChannelNoise(msgspec.Struct, frozen=True, kw_only=True):
    """One channel, in its raw unit; lists are by averaging time.

    Attributes:
        deviation, lower, upper: Allan deviation with its 95 % band.
        freedom: its equivalent degrees of freedom.
        fitted: Allan deviation of the fitted terms.
        terms: by name, see `TERM_UNITS`.
        white_density: one-sided density per √Hz, √2 times the white term.
        fit_from_s: shortest averaging time that the terms describe.
        chance: probability of a misfit as large, if the terms describe the noise.
        doubts: findings (`DOUBTS`) after which terms and station, or station, do not hold.
        unit, scale: physical unit and raw units per it, where the profile says so.
    """

    samples: int
    sampling_hz: float
    mean: float
    tau_s: list[float]
    deviation: list[float]
    lower: list[float]
    upper: list[float]
    freedom: list[float]
    fitted: list[float]
    terms: dict[str, Term]
    white_density: float | None
    fit_from_s: float
    chance: float
    doubts: list[str]
    station: StationNoise
    unit: str | None = None
    scale: float | None = None


class Noise(msgspec.Struct, frozen=True, kw_only=True, dict=True):
    """The noise of a log; `profile` is the recommended `noise` of each triad, raw units.

    `withheld` says why there is none for a triad whose channels do not hold.
    """

    summary: ClassVar[Callable[..., str]]
    to_dict: ClassVar[Callable[..., dict[str, Any]]]
    report: ClassVar[Callable[..., None]]
    """As of `Calibration`."""

    log: str
    seconds: float
    kind: Kind
    station_seconds: float
    simulated: bool
    channels: dict[str, ChannelNoise]
    profile: dict[str, float]
    withheld: dict[str, str]
    findings: list[Finding]


def find_noise(
    log: Table,
    *,
    profile: Profile | None = None,
    sampling_hz: float | None = None,
    between: tuple[float, float] = (-np.inf, np.inf),
    station_seconds: float | None = None,
    kind: Kind = "overlapping",
    say: Say = silent,
) -> Noise:
    """The noise of each raw channel of a log (`files.logs.read`) of a tool at rest.

    `sampling_hz` comes before a column `time_s`; `between` are the first and last second to be
    used; `station_seconds` by default 30, or a tenth of a shorter log.
    Errors: a log without time, with gaps, too short, or without a channel that can be used.
    """
    check(between, station_seconds, sampling_hz)
    if kind not in KINDS:
        raise InputError(f"`kind` must be {' or '.join(KINDS)}; got {kind!r}.")
    findings: list[Finding] = []
    remarks: list[Finding] = []
    rows, rate = regular.section(log, sampling_hz, between, findings)
    seconds = (rows.stop - rows.start) / rate
    station = _station_seconds(station_seconds, seconds, rate, log.source)
    channels: dict[str, ChannelNoise] = {}
    cells: dict[str, Cells] = {}
    for name in (name for name in RAW if name in log.columns):
        say(f"Allan variances of {name}, {rows.stop - rows.start} samples")
        try:
            value, hertz = regular.samples(log, name, rows, rate, findings)
            record = _record(name, value, hertz * station)
        except regular.UnusableChannelError as error:
            findings.append(Finding(id="channel-left-out", text=f"{error} It was left out."))
            continue
        cells[name] = regular.cells_of(value, hertz)
        channel = _channel(name, record, hertz, station, kind, remarks)
        channels[name] = channel if profile is None else _physical(name, channel, profile)
    if not channels:
        reasons = " ".join(finding.text for finding in findings)
        raise InputError(f"{log.source}: no channel that could be used. {reasons}")
    moved = regular.movement(cells)
    findings = moved + findings if moved else findings + remarks
    if moved:
        channels = {name: replace(c, doubts=[moved[0].id]) for name, c in channels.items()}
    withheld = _withheld(channels)
    return Noise(
        log=log.source,
        seconds=seconds,
        kind=kind,
        station_seconds=station,
        simulated=is_simulated(log.metadata),
        channels=channels,
        profile=_recommended(channels, withheld, findings),
        withheld=withheld,
        findings=findings,
    )


def check(
    between: tuple[float, float], station_seconds: float | None, sampling_hz: float | None
) -> None:
    """Refuse times and a rate that are not possible in any log."""
    for name, value in zip(("start", "end"), between, strict=True):
        if not is_number(value, ANY):
            rule = f"`{name}` must be seconds from the start of the log"
            raise InputError(f"{rule}; got {shown(value)}. Correct it.")
    if not between[0] < between[1]:
        got = "`start` {:g} and `end` {:g}".format(*between)
        raise InputError(f"`start` must be less than `end`; got {got}. Swap them?")
    check_argument("station_seconds", station_seconds, DURATION)
    check_argument("sampling_hz", sampling_hz, RATE)


def _station_seconds(given: float | None, seconds: float, rate: float, source: str) -> float:
    if given is None:
        return max(min(STATION_SECONDS, seconds / SOUND), 1 / rate)
    if given < 1 / rate:
        raise InputError(
            f"`station_seconds` must be at least one sample of {source}, {1 / rate:g} s; got {given:g}. "
            "Ask for a longer station."
        )
    if given > seconds / AVERAGES:
        raise InputError(
            f"`station_seconds` must be at most a quarter of {source}, {seconds / AVERAGES:.4g} s; got {given:g}. "
            f"Record for at least {AVERAGES * given:g} s, better {SOUND * given:g} s, or ask for a "
            "shorter station."
        )
    return given


class _Record(NamedTuple):
    """A channel: samples (n,) and their `phase`, Allan variances (m,), plain and centred, at all octaves.

    `station`: Allan variance at the length of a station.
    """

    value: Array
    phase: Array
    plain: Array
    centred: Array
    station: float


def _record(name: str, value: Array, length: float) -> _Record:
    """A channel with its Allan variances; refused without noise at an octave or in `length`.

    Errors: `regular.UnusableChannelError`.
    """
    factors, phase = [*allan.octaves(len(value)), max(round(length), 1)], allan.phase_of(value)
    plain, centred = allan.variances(value, factors, phase=phase)
    regular.check_noise(name, value, factors, centred, phase)
    return _Record(value, phase, plain[:-1], centred[:-1], float(plain[-1]))


def _channel(
    name: str, record: _Record, rate: float, station: float, kind: Kind, findings: list[Finding]
) -> ChannelNoise:
    """The noise of one channel; samples are counted inside, seconds outside."""
    value, phase, plain, centred, _ = record
    moments, requested = _moments(len(value), "overlapping"), _moments(len(value), kind)
    if kind != "overlapping":
        plain, _ = allan.variances(value, allan.octaves(len(value)), kind, phase)
    slope = np.asarray(allan.drift(value))
    terms = allan.fit(centred[None], slope[None], moments)
    freedom = allan.freedom(requested, terms.bounded, terms.steady, terms.covariance)[0]
    deviation = np.sqrt(plain)
    lower, upper = allan.band(deviation, freedom)
    fitted = terms.bounded @ np.swapaxes(requested.plain_mean, -1, -2)
    fitted = np.sqrt(fitted[0] + (terms.steady * moments.averaging) ** 2 / 2)
    named = _terms(terms, rate)
    white = named["white"].value
    remarks = _findings(name, record, rate, station, moments, terms)
    findings += remarks
    return ChannelNoise(
        samples=len(value),
        sampling_hz=rate,
        mean=float(value.mean()),
        tau_s=(moments.averaging / rate).tolist(),
        deviation=deviation.tolist(),
        lower=lower.tolist(),
        upper=upper.tolist(),
        freedom=freedom.tolist(),
        fitted=fitted.tolist(),
        terms=named,
        white_density=None if white is None else float(np.sqrt(2)) * white,
        fit_from_s=float(moments.averaging[terms.start[0]] / rate),
        chance=float(terms.chance[0]),
        doubts=[finding.id for finding in remarks if finding.id in DOUBTS],
        station=_station(record, station * rate, moments, terms),
    )


@lru_cache(maxsize=4)
def _moments(count: int, kind: Kind) -> Moments:
    """The moments at all octaves of a record: channels of one length have the same."""
    return allan.moments(count, allan.octaves(count), kind)


def _terms(terms: NoiseTerms, rate: float) -> dict[str, Term]:
    """The terms of the one record, in units of the channel and seconds."""
    factors = dict(zip(TERM_UNITS, (1 / rate, rate**-0.5, 1.0, rate**0.5, rate), strict=True))
    by_name = {}
    for i, name in enumerate(allan.TERMS):
        shown = bool(terms.determined[0, i])
        size = float(np.sqrt(max(terms.square[0, i], 0.0))) * factors[name]
        spread = float(np.sqrt(terms.covariance[0, i, i])) * factors[name] ** 2
        by_name[name] = Term(
            value=size if shown else None,
            standard_uncertainty=spread / (2 * size) if shown else None,
            lower=float(np.sqrt(terms.lower[0, i])) * factors[name],
            upper=float(np.sqrt(terms.upper[0, i])) * factors[name],
            unit=TERM_UNITS[name],
        )
    return {**by_name, "drift": _drift(terms, rate)}


def _drift(terms: NoiseTerms, rate: float) -> Term:
    """The drift, with its sign; where it may be absent, a bound of its size."""
    from scipy.special import ndtr, ndtri

    slope, sd = float(terms.slope[0]) * rate, float(terms.slope_sd[0]) * rate
    tail = 1 - allan.CONFIDENCE
    shown = bool(2 * ndtr(-abs(terms.slope[0]) / terms.slope_sd[0]) < allan.DETECTED)
    reach = float(ndtri(1 - tail / 2)) * sd
    return Term(
        value=slope if shown else None,
        standard_uncertainty=sd if shown else None,
        lower=slope - reach if shown else 0.0,
        upper=slope + reach if shown else abs(slope) + float(ndtri(1 - tail)) * sd,
        unit=TERM_UNITS["drift"],
    )


def _station(record: _Record, length: float, moments: Moments, terms: NoiseTerms) -> StationNoise:
    """The noise of a mean over `length` samples, or of one."""
    seen = np.sqrt([record.station])
    noise, freedom, measured = allan.single(record.value[None], length, moments, terms, seen)
    lower, upper = (float(limit[0]) for limit in allan.band(noise, freedom))
    source = "measured" if measured[0] else "terms"
    return StationNoise(noise=float(noise[0]), lower=lower, upper=upper, source=source)


def _findings(
    name: str, record: _Record, rate: float, station: float, moments: Moments, terms: NoiseTerms
) -> list[Finding]:
    """Remarks for the reader on a channel."""
    value = record.value
    apart = np.diff(np.sort(value))
    step = float(np.min(apart, where=apart > 0, initial=np.inf))
    del apart
    sample = float(np.std(np.diff(value)) / np.sqrt(2))
    coarse = sample < COARSE * step
    texts = {"event": _event(name, record.phase, rate, COARSE * step, coarse)}
    if coarse:
        texts["coarse"] = (
            f"{name} is read in steps of {step:.3g}, above its noise of {sample:.2g}: the figures "
            "are those of the rounding. Read it with more digits."
        )
    start = moments.averaging[terms.start[0]] / rate
    if terms.chance[0] < allan.CONTRADICTED:
        texts["misfit"] = (
            f"{name}: the five terms do not describe the noise (χ² {terms.misfit[0]:.0f} for "
            f"{terms.freedom[0]}); their values and uncertainties do not hold, the Allan deviations do. Was the "
            "tool at rest, and is there a vibration?"
        )
    elif terms.start[0]:
        texts["filtered"] = (
            f"{name}: below {start:.3g} s its noise is not that of the five terms (a filter, a vibration, "
            "or repeated samples); from there on they hold, without a quantisation."
        )
    if station * rate < 1 - SAME_DURATION:
        seen = f"{name} is sampled every {1 / rate:.4g} s, and a station lasts {station:.4g} s"
        texts["slow"] = f"{seen}: its figure is the noise of one sample. Ask for a longer station."
    return [Finding(id=key, text=text) for key, text in texts.items() if text]


def _event(name: str, phase: Array, rate: float, least: float, coarse: bool) -> str:
    """The finding, if any, on a difference between averages too large for noise: a spike, or a move.

    `least` is the noise that the steps of the converter can hide: in single samples, and if they
    are `coarse` in averages.
    """
    for m in sorted({1, max((len(phase) - 1) // EVENT_PARTS, 1)}):
        largest, worst = allan.largest_difference(phase, m)
        quiet = largest / EVENT / ROBUST  # a median beyond it makes no event of the largest
        median = allan.usual_difference(phase, m, quiet)
        usual = max(ROBUST * median, least if coarse or m == 1 else 0.0)
        if usual > 0 and largest / usual > EVENT + STEP_ROUNDING:
            return (
                f"{name} changes by {largest:.3g} about {(worst + m) / rate:.4g} s after the start, "
                f"{largest / usual:.0f} times what is usual within {m / rate:.2g} s: a spike or a move. "
                "Choose a quiet part by `start` and `end`."
            )
    return ""


def _physical(name: str, channel: ChannelNoise, profile: Profile) -> ChannelNoise:
    """The same with its physical unit and scale, where the profile has one."""
    kind = next(kind for kind, names in CHANNELS.items() if name in names)
    scale = getattr(profile, kind).scale
    if scale is None:
        return channel
    return replace(channel, unit=PHYSICAL[kind], scale=float(scale))


def _withheld(channels: dict[str, ChannelNoise]) -> dict[str, str]:
    """Why no noise is recommended, for each triad that has none."""
    reasons = {}
    for kind, names in CHANNELS.items():
        by_reason: dict[str, list[str]] = {}
        for name in (name for name in names if name in channels and channels[name].doubts):
            reason = " and ".join(DOUBTS[doubt] for doubt in channels[name].doubts)
            by_reason.setdefault(reason, []).append(name)
        if by_reason:
            reasons[kind] = "; ".join(f"{', '.join(who)}: {why}" for why, who in by_reason.items())
    return reasons


def _recommended(
    channels: dict[str, ChannelNoise], withheld: dict[str, str], findings: list[Finding]
) -> dict[str, float]:
    """The noise of one station for each triad that holds: root mean square of its channels."""
    profile = {}
    for kind, names in CHANNELS.items():
        stations = {name: channels[name].station.noise for name in names if name in channels}
        if not stations or kind in withheld:
            continue
        profile[kind] = float(rms(np.array([*stations.values()])))
        noisy, quiet = (pick(stations, key=stations.__getitem__) for pick in (max, min))
        if stations[noisy] > UNEVEN * stations[quiet]:
            text = (
                f"{noisy} has {stations[noisy] / stations[quiet]:.1f} times the noise of {quiet}; the profile has one "
                f"figure for the {kind}, their root mean square. Is {noisy} working properly?"
            )
            findings.append(Finding(id="uneven", text=text))
    return profile
