"""Which fault explains a change best: a calibration and later readings in, a `Diagnosis` out. Pure data.

Readings as a diagnosis takes them: checked, and with what is not stated made an honest uncertainty.

Which faults readings cannot tell apart or do not show at all, and which further readings would.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple

import msgspec
import numpy as np

from mwdcal.calibration.copies import in_fit
from mwdcal.calibration.diagnosis.identity import doubts, other_tool
from mwdcal.calibration.readings import CONSTANTS, LEAST_TEMPERATURE_SPAN, TRIADS, Readings
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.calibration.results import UNKNOWN_GRAVITY, raw_reading, unknown_gravity
from mwdcal.errors import InputError
from mwdcal.estimation.problem import ANGLES
from mwdcal.faults.likelihood import (
    DEAD,
    DEPARTURES,
    DISTINCT,
    DRAWS,
    FALSE_ALARMS,
    FAULTS,
    HEAT,
    LIKELY,
    NONE,
    SIZE,
    SURROUNDINGS,
    UNEXPLAINED,
    FaultEvidence,
    FaultForm,
    FaultTerm,
    Suspect,
    explained,
    faults,
    hypotheses,
    over_forms,
    raw_of,
    stand_offsets,
)
from mwdcal.files.contract import CHANNELS
from mwdcal.files.runs import away_from_stand
from mwdcal.geometry.vectors import Array, reference_vectors

NOMINAL_FIELD = 50_000.0
"""Field of the Earth, nT, by which sizes in nT are taken for a magnetometer that is calibrated to a field of 1."""
FIELD_SD = 0.3
"""Standard uncertainty of a field strength that the readings do not state, as a share of the laboratory's."""


def prepared(calibration: Calibration, readings: Readings) -> tuple[Readings, list[Finding]]:
    """The stations that a diagnosis can use, and what the reader should know of them.

    Raises:
        InputError: readings of another tool or of the fit itself, or none that can be used.
    """
    _check(calibration, readings)
    calibration.fields(readings)  # refuses readings that lack what the calibration needs
    findings = doubts(calibration, readings)
    if readings.magnetometer is not None and not calibration.has_field:
        readings = replace(readings, magnetometer=None)
    if calibration.has_field and readings.magnetometer is None:
        findings.append(
            _finding("no-magnetometer", "the readings have no magnetometer: no result for it.")
        )
    whole = [getattr(readings, name) for name in readings.triads]
    sound = np.isfinite(np.concatenate(whole, -1)).all(-1)
    if not sound.any():
        raise InputError(
            f"{readings.name}: no station has all readings. Fill in the columns of raw readings."
        )
    if not sound.all():
        lacking = np.count_nonzero(~sound)
        findings.append(
            _finding("missing-reading", f"{lacking} stations lack a reading, and are left out.")
        )
        readings = readings.select(sound)
    if calibration.outside(readings).any():
        text = "some stations lie outside the calibrated temperature range: drift beyond it counts as a change."
        findings.append(_finding("outside-temperature", text))
    if not warmed(readings):
        text = "all readings are at one temperature: a fault of heat is no candidate. It needs two temperatures."
        findings.append(_finding("one-temperature", text))
    if calibration.unrecorded(readings):
        findings.append(
            _finding("no-temperature", "the tool was calibrated at unrecorded temperatures.")
        )
    if "gravity" not in readings.known:
        readings, text = _with_gravity(calibration, readings)
        findings.append(_finding("assumed-gravity", text))
    return _with_field(calibration, readings, findings), findings


def warmed(readings: Readings) -> bool:
    """Whether readings are at temperatures far enough apart to show what changes with temperature."""
    warmth = readings.temperature
    return warmth is not None and float(np.ptp(warmth)) >= LEAST_TEMPERATURE_SPAN


def _finding(name: str, text: str) -> Finding:
    return Finding(id=name, text=text)


def _check(calibration: Calibration, readings: Readings) -> None:
    """Refuse readings that say nothing of this calibration."""
    if other := other_tool(calibration, readings):
        raise InputError(
            f"{readings.name} is of tool {other[1]}, the calibration of tool {other[0]}. Give readings of the "
            "same tool, or correct 'serial' in the file."
        )
    if in_fit(calibration, readings).any():
        raise InputError(
            f"{readings.name}: stations of the calibration's own fit cannot show what has changed since. Give "
            "later readings."
        )


def _with_gravity(calibration: Calibration, readings: Readings) -> tuple[Readings, str]:
    """The readings with the gravity that the calibration states, which is uncertain at their place, and the finding.

    Where that states none either, both are in units of the same gravity.
    """
    if unknown_gravity(calibration):
        return readings, "no ref_gravity_g: gravity is taken to be exactly 1 g."
    shape, gravity = readings.accelerometer.shape[:-1], calibration.earth["gravity_g"]
    known = {**readings.known, "gravity": np.full(shape, gravity)}
    sd = {**readings.sd, "gravity": np.full(shape, UNKNOWN_GRAVITY)}
    text = f"no ref_gravity_g: that of the calibration is taken, {gravity:.5g} g, 1σ {1000 * UNKNOWN_GRAVITY:g} mg."
    return replace(readings, known=known, sd=sd), text


def _with_field(calibration: Calibration, readings: Readings, findings: list[Finding]) -> Readings:
    """The readings with a field strength at every station, and an honest uncertainty where they state none."""
    if readings.magnetometer is None:
        return readings
    field, sd = readings.reference("field"), readings.uncertainty("field")
    if calibration.relative:
        field = np.full(field.shape, np.nan)
        text = "the magnetometer is calibrated to field = 1: sizes in nT are as if that were 50,000 nT."
        findings.append(_finding("relative-field", text))
    blank = np.isnan(field)
    if blank.all():
        earth = calibration.earth.get("field", 1.0)
        known = {**readings.known, "field": np.full(field.shape, earth)}
        return replace(
            readings,
            known=known,
            sd={**readings.sd, "field": np.full(field.shape, FIELD_SD * earth)},
        )
    filled = np.where(blank, np.nanmean(field), field)
    return replace(
        readings, known={**readings.known, "field": filled}, sd={**readings.sd, "field": sd}
    )


def freedom(calibration: Calibration, readings: Readings) -> float:
    """Degrees of freedom behind the noise of the readings: the fewest of any triad that states none."""
    triads = calibration.triads[: len(readings.triads)]
    estimated = [t.degrees_of_freedom for t in triads if t.name not in readings.sd]
    return max(1.0, min(estimated)) if estimated else np.inf


FURTHER_ROLL = np.arange(6) * np.pi / 3
"""Toolfaces of a further roll: as many as a roll test needs to show both harmonics."""
SETTING = float(np.radians(0.02))
"""Standard uncertainty of the angles of a further roll, where the readings do not state a larger one."""
COLD, HOT = 20.0, 100.0
"""Temperatures of further readings where the calibration states no range, °C."""


class NextReading(msgspec.Struct, frozen=True, kw_only=True):
    """What would tell the fault named from another: `evidence` is the logarithm of the ratio to be expected."""

    fault: str
    reading: str | None
    evidence: float


class Further(NamedTuple):
    """A roll of `FURTHER_ROLL` that could be read as well: its inclination, temperature, and what it is without."""

    text: str
    inclination: float
    azimuth: float
    temperature: float | None = None
    without: tuple[str, ...] = ()

    def __str__(self) -> str:
        """The further measurement in words."""
        inclination, azimuth = np.degrees(self.inclination), np.degrees(self.azimuth) % 360
        return (
            f"six stations {self.text}, at {inclination:.0f}° inclination, {azimuth:.0f}° azimuth "
            "and toolfaces 60° apart,"
        )


def expected_ratios(evidence: FaultEvidence, information: Array, departures: Array) -> Array:
    """Log evidence (F,) over none that each form gains on average, the tool having `departures` (SIZE,)."""
    mean = information @ departures
    result = []
    for form in evidence.forms:
        inner = form.mixing.transpose() @ information @ form.mixing
        whole = np.eye(len(inner)) + inner
        along = form.mixing.transpose() @ mean
        gained = along @ np.linalg.solve(whole, along) + np.trace(np.linalg.solve(whole, inner))
        result.append(0.5 * (gained - np.linalg.slogdet(whole)[1]))
    return np.array(result)


def unseen(evidence: FaultEvidence) -> list[str]:
    """Faults that readings would not show, on average over faults of the usual size in their best form.

    Definition: the log evidence for the fault is tr(A) / 2 - log det(I + A) / 2 on average, A being the
    information on its sizes.
    """
    seen = set()
    for form in (each for each in evidence.forms if each.larger == 1):
        inner = form.mixing.transpose() @ evidence.information @ form.mixing
        gain = 0.5 * (np.trace(inner) - np.linalg.slogdet(np.eye(len(inner)) + inner)[1])
        seen |= {form.kind} if gain >= DISTINCT else set()
    return [kind for kind in FAULTS if kind not in seen and kind != DEAD]


def innocent(fault: str, rivals: Sequence[str], shares: Mapping[str, float]) -> str:
    """The fault, or where readings do not exclude that the tool is sound, what about it is at fault instead.

    A field fixed in the tool or in the Earth is no fault of the sensors: none is condemned while one of these explains
    as much.
    """
    outside = [name for name in rivals if name in SURROUNDINGS]
    return (
        max(outside, key=lambda name: shares[name])
        if fault not in SURROUNDINGS and outside
        else fault
    )


def apart(
    calibration: Calibration, readings: Readings, evidence: FaultEvidence, fault: str,
    shares: Mapping[str, float],
) -> tuple[list[str], list[NextReading]]:  # fmt: skip
    """Faults that cannot be told from the one named, and for each the further reading that would tell."""
    if fault == NONE:
        return [], []
    rivals = [
        name for name, share in shares.items() if name not in (fault, NONE) and share > LIKELY
    ]
    if fault == DEAD:
        return rivals, []
    departures = _departures(evidence, fault)
    expected = expected_ratios(evidence, evidence.information, departures)
    margins = _margins(evidence, expected, fault)
    rivals += [name for name, margin in margins.items() if margin < DISTINCT and name not in rivals]
    if not rivals:
        return [], []
    offers = _offers(calibration, readings, evidence)
    later = {
        text: _margins(evidence, expected_ratios(evidence, whole, departures), fault)
        for text, whole in offers.items()
    }
    return rivals, [_best(name, margins, later) for name in rivals if name in margins]


def _departures(evidence: FaultEvidence, fault: str) -> Array:
    """Departures (SIZE,) of the best form of a fault, of the sizes that were estimated."""
    form, sizes, _ = evidence.sizes(fault)
    return np.asarray(form.mixing @ sizes)


def _margins(evidence: FaultEvidence, each: Array, fault: str) -> dict[str, float]:
    """By how much the log evidence of a fault is expected to exceed that of each other."""
    kinds = over_forms(evidence.forms, each)
    return {name: float(kinds[fault] - value) for name, value in kinds.items() if name != fault}


def _best(
    rival: str, margins: Mapping[str, float], later: Mapping[str, Mapping[str, float]]
) -> NextReading:
    """The first further reading that tells a rival, else the best if it helps at all."""
    enough = [text for text, each in later.items() if each[rival] >= DISTINCT]
    text = enough[0] if enough else max(later, key=lambda name: later[name][rival])
    gained = later[text][rival]
    if not enough and gained < margins[rival] + 0.5 * DISTINCT:
        return NextReading(fault=rival, reading=None, evidence=gained)
    return NextReading(fault=rival, reading=text, evidence=gained)


def _offers(
    calibration: Calibration, readings: Readings, evidence: FaultEvidence
) -> dict[str, Array]:
    """Information (SIZE, SIZE) of the departures by the readings and each further roll, by its description."""
    state, problem = evidence.none.state, evidence.suspect.problem
    axis = state.attitude[0, :, 2, :].mean(0)
    here = float(np.arctan2(np.hypot(axis[0], axis[1]), axis[2]))
    azimuth = float(np.arctan2(axis[1], axis[0]))
    level = min(np.radians([5.0, 90.0, 45.0, 135.0]), key=lambda angle: -abs(angle - here))
    low, high = calibration.temperature_c or (COLD, HOT)
    middle = float(problem.temperature.mean())
    far = high if abs(high - middle) > abs(low - middle) else low
    offers = [
        Further("on a stand", level, azimuth),
        Further("on a stand", here, azimuth + np.pi / 2),
        Further("after switching off and on", here, azimuth, without=("turn-on",)),
        Further("elsewhere, away from casing and steel", here, azimuth, without=("disturbance",)),
        Further(
            "without string and collar, or after demagnetising them",
            here,
            azimuth,
            without=("iron",),
        ),
    ]
    if readings.temperature is not None and abs(far - middle) > calibration.margin:
        offers.append(Further(f"at {far:.0f} °C", here, azimuth, far))
    return {str(offer): _informed(calibration, readings, offer) for offer in offers}


def _informed(calibration: Calibration, readings: Readings, offer: Further) -> Array:
    """Information (SIZE, SIZE) of the departures by the readings and a further roll."""
    longer = _extended(calibration, readings, offer)
    suspect = Suspect.of(calibration, longer)
    held = np.ones((longer.count, 1, SIZE))
    for name in offer.without:
        held[readings.count :, :, DEPARTURES[name]] = 0.0
    nothing = np.zeros((1, SIZE, 0))
    return np.asarray(explained(suspect, nothing, suspect.start(), held=held).information[0])


def _extended(calibration: Calibration, readings: Readings, offer: Further) -> Readings:
    """The readings, and those of a sound tool in a further roll of known attitudes at the same place."""
    known = {name: readings.reference(name) for name in (*ANGLES, *CONSTANTS)}
    here = {
        n: np.mean(known[n][np.isfinite(known[n])] if np.isfinite(known[n]).any() else np.nan)
        for n in CONSTANTS
    }
    count = len(FURTHER_ROLL)
    turns = np.broadcast_arrays(offer.inclination, offer.azimuth, FURTHER_ROLL)
    more = dict(zip(ANGLES, turns, strict=True)) | {n: np.full(count, here[n]) for n in CONSTANTS}
    warmth, usual = readings.temperature, calibration.reference_temperature
    if warmth is not None:
        usual = float(np.mean(warmth)) if offer.temperature is None else offer.temperature
        warmth = np.append(warmth, np.full(count, usual))
    dip = (
        np.radians(calibration.earth.get("dip_deg", 0.0)) if np.isnan(here["dip"]) else here["dip"]
    )
    inclination, azimuth, toolface = turns
    vectors = reference_vectors(inclination, azimuth, toolface, here["gravity"], here["field"], dip)
    raw, sd = _rolled(calibration, readings, vectors, np.full(count, usual))
    for name in readings.sd.keys() - {*TRIADS} | set(ANGLES):
        stated = readings.uncertainty(name)
        least = SETTING if name in ANGLES else 0.0
        sd[name] = np.append(stated, np.full(count, max(stated.max(), least)))
    return replace(
        readings, accelerometer=raw[TRIADS[0]], magnetometer=raw.get(TRIADS[1]), temperature=warmth,
        sd=sd, station=(), digest=(),
        known={name: np.append(known[name], more[name]) for name in known},
        group=np.append(readings.groups, np.full(count, -1)),
    )  # fmt: skip


def _rolled(
    calibration: Calibration, readings: Readings, vectors: tuple[Array, Array], warmth: Array
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Readings and their noise (n + k, 3) by triad, those of a sound tool at `vectors` (k, 3) after the others."""
    raw, sd = {}, {}
    for triad, vector in zip(calibration.triads[: len(readings.triads)], vectors, strict=False):
        model, before = (
            triad.functions(calibration.reference_temperature),
            getattr(readings, triad.name),
        )
        added = raw_reading(model, np.array(triad.parameters), vector, warmth)
        stated = np.broadcast_to(triad.noise_of(readings), before.shape)
        raw[triad.name] = np.concatenate([before, added])
        sd[triad.name] = np.concatenate([stated, np.tile(stated.mean(0), (len(warmth), 1))])
    return raw, sd


BLIND = 0.9
"""A size of which the readings leave so much of the uncertainty that it had beforehand is not stated."""


class Moved(msgspec.Struct, frozen=True, kw_only=True):
    """One size of the fault, with its standard uncertainty; `channel` None: of a triad or the whole tool."""

    parameter: str
    channel: str | None
    size: float
    uncertainty: float
    unit: str


class Rival(msgspec.Struct, frozen=True, kw_only=True):
    """Another explanation of the readings, as a `Diagnosis` has it: the cause, where, and its largest size."""

    fault: str
    channel: str | None
    parameter: str | None
    size: float | None
    size_uncertainty: float | None
    unit: str | None


class Diagnosis(msgspec.Struct, frozen=True, kw_only=True, dict=True):
    """The outcome: `fault` is "none" or one of `physics.FAULTS`, and the first of `parameters` its `size`.

    `channel`: "ax" …, a triad, or None for the whole tool. `probability` bounds the chance that a sound tool gives
    readings that speak so much for a fault. `likelihoods` are the shares of all faults, each as likely
    beforehand. `confounded_with` are faults that these readings cannot tell from the one named, `rivals` their sizes,
    `tell_apart` what would; `unseen` are faults of the usual size that they would not show. `surveys`: no station has
    an attitude given, as in a hole. `stand_offset` is an error that all references of an angle share, where that
    explains the readings as well as `fault` or better.
    """

    summary: ClassVar[Callable[..., str]]
    to_dict: ClassVar[Callable[..., dict[str, Any]]]
    """As of `Calibration`."""

    fault: str
    channel: str | None
    parameter: str | None
    size: float | None
    size_uncertainty: float | None
    unit: str | None
    above_c: float | None = None
    probability: float
    likelihoods: dict[str, float]
    parameters: list[Moved]
    confounded_with: list[str]
    rivals: list[Rival]
    tell_apart: list[NextReading]
    unseen: list[str]
    calibration: str
    run: str
    stations: int
    surveys: bool
    stand_offset: Moved | None = None
    findings: list[Finding]


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # refused where it matters
def diagnose(calibration: Calibration, readings: Readings, *, draws: int = DRAWS) -> Diagnosis:
    """Say which fault explains later readings of a calibrated tool best, against none.

    Raises:
        InputError: readings of another tool or of the fit itself, or none that can be used.
    """
    if not any(readings.states(name) for name in ANGLES):
        readings = away_from_stand(readings, calibration.profile)
    usable, findings = prepared(calibration, readings)
    unit = 1.0
    if calibration.relative:
        unit = 1 / NOMINAL_FIELD
    forms = [form for form in faults(calibration.profile, unit) if _can_show(form, usable)]
    evidence = FaultEvidence.of(Suspect.of(calibration, usable), hypotheses(forms))
    probability = evidence.probability(freedom(calibration, usable), draws)
    shares = evidence.likelihoods()
    fault = max(FAULTS, key=lambda name: shares[name]) if probability <= FALSE_ALARMS else NONE
    findings += _unexplained(evidence, fault, freedom(calibration, usable))
    offset = _stand_offset(evidence, fault, freedom(calibration, usable))
    confounded, remedies = apart(calibration, usable, evidence, fault, shares)
    if (other := innocent(fault, confounded, shares)) != fault:
        fault = other
        confounded, remedies = apart(calibration, usable, evidence, fault, shares)
    named = _named(calibration, evidence, fault)
    return Diagnosis(
        fault=fault,
        **named,
        probability=probability,
        likelihoods=shares,
        confounded_with=confounded,
        rivals=[_rival(calibration, evidence, name) for name in confounded],
        tell_apart=remedies,
        unseen=unseen(evidence),
        calibration=calibration.run_name,
        run=readings.name,
        stations=usable.count,
        surveys=not any(np.isfinite(usable.reference(name)).any() for name in ANGLES),
        stand_offset=offset,
        findings=findings,
    )


def _chance(square: float, count: int, freedom: float) -> float:
    """Chance of a larger χ² of `count` degrees of freedom, the noise being known with those of `freedom`."""
    from scipy.special import chdtrc, fdtrc

    if np.isinf(freedom):
        return float(chdtrc(count, square))
    return float(fdtrc(count, freedom, square / count))


def _stand_offset(evidence: FaultEvidence, fault: str, freedom: float) -> Moved | None:
    """The common error of the references of one angle that explains readings no worse than `fault` does."""
    information, offsets = stand_offsets(evidence.suspect, evidence.none)
    square = information * offsets**2
    best = int(np.argmax(square))
    left = evidence.misfit(NONE) - float(square[best])
    count = raw_of(evidence.suspect.problem).size
    if (
        len(square) * _chance(float(square[best]), 1, freedom) > FALSE_ALARMS
        or _chance(left, count, freedom) < UNEXPLAINED
        or (fault != NONE and left > evidence.misfit(fault) + 2 * DISTINCT)
    ):
        return None
    size, spread = np.degrees([offsets[best], information[best] ** -0.5]).tolist()
    return Moved(parameter=ANGLES[best], channel=None, size=size, uncertainty=spread, unit="°")


def _unexplained(evidence: FaultEvidence, fault: str, freedom: float) -> list[Finding]:
    """A finding if even the best explanation leaves more than the noise does."""
    misfit, count = evidence.misfit(fault), raw_of(evidence.suspect.problem).size
    if not _chance(misfit, count, freedom) < UNEXPLAINED:
        return []
    text = (
        f"no single fault explains these readings: the best leaves {misfit / count:.3g} times the variance of the "
        "noise. Check that they are of this tool, in its units, with the right references and none that moved."
    )
    return [Finding(id="unexplained", text=text)]


def _rival(calibration: Calibration, evidence: FaultEvidence, name: str) -> Rival:
    """A fault that is possible but not named."""
    sized = _named(calibration, evidence, name)
    return Rival(fault=name, **{key: sized[key] for key in Rival.__struct_fields__[1:]})


def _can_show(form: FaultForm, readings: Readings) -> bool:
    """Whether a form can show in such readings at all."""
    if form.kind == HEAT and not warmed(readings):
        return False
    return readings.magnetometer is not None or not _magnetic(form)


def _magnetic(form: FaultForm) -> bool:
    """Whether a form needs a magnetometer to show at all."""
    if form.channel is None:
        return form.kind in ("magnetised", "casing")
    return form.channel >= 3 or form.channel == -2


def _named(calibration: Calibration, evidence: FaultEvidence, fault: str) -> dict[str, Any]:
    """Channel, sizes and onset of the best form of a fault."""
    if fault == NONE:
        nothing = dict.fromkeys(("channel", "parameter", "size", "size_uncertainty", "unit"))
        return {**nothing, "parameters": []}
    if fault == DEAD:
        channel, moved, onset = _dead(calibration, evidence)
        extra = {"above_c": None if np.isinf(onset) else onset}
    else:
        form, sizes, covariance = evidence.sizes(fault, whole=True)
        channel = channel_name(calibration, form.channel)
        moved, extra = _moved(calibration, form, sizes, covariance), {"above_c": None}
    sized: dict[str, Any] = {"parameters": moved, "channel": channel, **extra}
    for first in moved[:1]:
        names = {"size_uncertainty": first.uncertainty, "unit": first.unit}
        sized |= {"parameter": first.parameter, "size": first.size, **names}
    return dict.fromkeys(("parameter", "size", "size_uncertainty", "unit")) | sized


def _moved(
    calibration: Calibration, form: FaultForm, sizes: Array, covariance: Array
) -> list[Moved]:
    """The sizes of a form that the readings show, the one that stands out most first."""
    rows = []
    for term, value, variance, usual in zip(
        form.terms, sizes, covariance.diagonal(), form.usual, strict=True
    ):
        spread = float(np.sqrt(variance))
        if spread > BLIND:
            continue
        towards = channel_name(calibration, term.towards)
        row = Moved(
            parameter=" ".join(filter(None, [term.name, towards])),
            channel=channel_name(calibration, term.channel),
            size=float(_polarity(calibration, term) * value * usual),
            uncertainty=float(spread * usual),
            unit=term.unit,
        )
        rows.append((abs(value) / spread, row))
    return [row for _, row in sorted(rows, key=lambda pair: -pair[0])]


def _dead(
    calibration: Calibration, evidence: FaultEvidence
) -> tuple[str | None, list[Moved], float]:
    """Channel, constant and onset of the best dead channel."""
    dead, best = evidence.dead, int(np.argmax(evidence.dead_ratios))
    place = int(dead.channel[best])
    term = FaultTerm("constant", "g" if place < 3 else calibration.field_unit, 1.0, place)
    value = _polarity(calibration, term) * dead.value[best]
    name = channel_name(calibration, place)
    moved = Moved(
        parameter=term.name, channel=name, size=float(value),
        uncertainty=float(dead.sd[best]), unit=term.unit,
    )  # fmt: skip
    return name, [moved], float(dead.onset[best])


def channel_name(calibration: Calibration, component: int | None) -> str | None:
    """The channel, as files name it, of a component of both triads; of -1 and -2 the triad."""
    if component is None:
        return None
    if component < 0:
        return list(CHANNELS)[-1 - component]
    triad = list(CHANNELS)[component // 3]
    permutation = getattr(calibration.profile, triad).permutation
    return CHANNELS[triad][int(np.argmax(np.abs(permutation[component % 3])))]


def _polarity(calibration: Calibration, term: FaultTerm) -> float:
    """Sign of a channel along its tool axis, for sizes that change with it; of a turn, times that of the other."""

    def sign(component: int) -> float:
        triad = list(CHANNELS)[component // 3]
        return float(getattr(calibration.profile, triad).permutation[component % 3].sum())

    if term.channel is None or not term.name.startswith(("axis", "bias", "constant")):
        return 1.0
    return sign(term.channel) * (1.0 if term.towards is None else sign(term.towards))
