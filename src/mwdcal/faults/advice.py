"""Which faults readings cannot tell apart or do not show at all, and which further readings would."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import msgspec
import numpy as np

from mwdcal.calibration.prediction import raw_reading
from mwdcal.calibration.readings import CONSTANTS, TRIADS, Readings
from mwdcal.calibration.record import Calibration
from mwdcal.estimation.evidence import ANGLES
from mwdcal.faults.likelihood import Suspect, explained
from mwdcal.faults.physics import DEAD, DEPARTURES, FAULTS, NONE, SIZE, SURROUNDINGS
from mwdcal.faults.weighing import DISTINCT, LIKELY, FaultEvidence, over_forms
from mwdcal.geometry.vectors import Array, reference_vectors

QUARTERS = np.arange(4) * np.pi / 2
"""Toolfaces of a further roll."""
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
    """A roll of four toolfaces that could be read as well: its inclination, temperature, and what it is without."""

    text: str
    inclination: float
    azimuth: float
    temperature: float | None = None
    without: tuple[str, ...] = ()

    def __str__(self) -> str:
        """What to measure, in words."""
        inclination, azimuth = np.degrees(self.inclination), np.degrees(self.azimuth) % 360
        return (
            f"four stations {self.text}, at {inclination:.0f}° inclination, {azimuth:.0f}° azimuth and toolfaces of "
            "0°, 90°, 180° and 270°,"
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
    turns = np.broadcast_arrays(offer.inclination, offer.azimuth, QUARTERS)
    more = dict(zip(ANGLES, turns, strict=True)) | {n: np.full(4, here[n]) for n in CONSTANTS}
    warmth, usual = readings.temperature, calibration.reference_temperature
    if warmth is not None:
        usual = float(np.mean(warmth)) if offer.temperature is None else offer.temperature
        warmth = np.append(warmth, np.full(4, usual))
    dip = (
        np.radians(calibration.earth.get("dip_deg", 0.0)) if np.isnan(here["dip"]) else here["dip"]
    )
    inclination, azimuth, toolface = turns
    vectors = reference_vectors(inclination, azimuth, toolface, here["gravity"], here["field"], dip)
    raw, sd = _rolled(calibration, readings, vectors, np.full(4, usual))
    for name in readings.sd.keys() - {*TRIADS} | set(ANGLES):
        stated = readings.uncertainty(name)
        least = SETTING if name in ANGLES else 0.0
        sd[name] = np.append(stated, np.full(4, max(stated.max(), least)))
    return replace(
        readings, accelerometer=raw[TRIADS[0]], magnetometer=raw.get(TRIADS[1]), temperature=warmth,
        sd=sd, station=(), digest=(),
        known={name: np.append(known[name], more[name]) for name in known},
        group=np.append(readings.groups, np.full(4, -1)),
    )  # fmt: skip


def _rolled(
    calibration: Calibration, readings: Readings, vectors: tuple[Array, Array], warmth: Array
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Readings and their noise (n + 4, 3) by triad, those of a sound tool at `vectors` (4, 3) after the others."""
    raw, sd = {}, {}
    for triad, vector in zip(calibration.triads[: len(readings.triads)], vectors, strict=False):
        model, before = (
            triad.functions(calibration.reference_temperature),
            getattr(readings, triad.name),
        )
        added = raw_reading(model, np.array(triad.parameters), vector, warmth)
        stated = np.broadcast_to(readings.sd.get(triad.name, triad.noise), before.shape)
        raw[triad.name] = np.concatenate([before, added])
        sd[triad.name] = np.concatenate([stated, np.tile(stated.mean(0), (4, 1))])
    return raw, sd
