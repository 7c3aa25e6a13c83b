"""Which fault explains a change best: a calibration and later readings in, a `Diagnosis` out. Pure data."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import msgspec
import numpy as np

from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.estimation.evidence import ANGLES
from mwdcal.faults import advice, preparation
from mwdcal.faults.advice import NextReading
from mwdcal.faults.likelihood import Suspect, raw_of
from mwdcal.faults.physics import DEAD, FAULTS, HEAT, NONE, FaultForm, FaultTerm, faults, hypotheses
from mwdcal.faults.weighing import DRAWS, FALSE_ALARMS, UNEXPLAINED, FaultEvidence
from mwdcal.files.contract import CHANNELS
from mwdcal.geometry.vectors import Array

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
    """What else explains the readings, as a `Diagnosis` has it: the cause, where, and its largest size."""

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
    an attitude given, as in a hole.
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
    findings: list[Finding]


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # refused where it matters
def diagnose(calibration: Calibration, readings: Readings, *, draws: int = DRAWS) -> Diagnosis:
    """Say which fault explains later readings of a calibrated tool best, against none.

    Raises:
        InputError: readings of another tool or of the fit itself, or none that can be used.
    """
    prepared, findings = preparation.prepared(calibration, readings)
    unit = 1.0
    if calibration.relative:
        unit = 1 / preparation.NOMINAL_FIELD
    forms = [form for form in faults(calibration.profile, unit) if _can_show(form, prepared)]
    evidence = FaultEvidence.of(Suspect.of(calibration, prepared), hypotheses(forms))
    probability = evidence.probability(preparation.freedom(calibration, prepared), draws)
    shares = evidence.likelihoods()
    fault = max(FAULTS, key=lambda name: shares[name]) if probability <= FALSE_ALARMS else NONE
    findings += _unexplained(evidence, fault, preparation.freedom(calibration, prepared))
    confounded, remedies = advice.apart(calibration, prepared, evidence, fault, shares)
    if (other := advice.innocent(fault, confounded, shares)) != fault:
        fault = other
        confounded, remedies = advice.apart(calibration, prepared, evidence, fault, shares)
    named = _named(calibration, evidence, fault)
    return Diagnosis(
        fault=fault,
        **named,
        probability=probability,
        likelihoods=shares,
        confounded_with=confounded,
        rivals=[_rival(calibration, evidence, name) for name in confounded],
        tell_apart=remedies,
        unseen=advice.unseen(evidence),
        calibration=calibration.run_name,
        run=readings.name,
        stations=prepared.count,
        surveys=not any(np.isfinite(prepared.reference(name)).any() for name in ANGLES),
        findings=findings,
    )


def _unexplained(evidence: FaultEvidence, fault: str, freedom: float) -> list[Finding]:
    """A finding if even the best explanation leaves more than the noise does."""
    from scipy.special import chdtrc, fdtrc

    misfit, count = evidence.misfit(fault), raw_of(evidence.suspect.problem).size
    known = np.isinf(freedom)
    chance = chdtrc(count, misfit) if known else fdtrc(count, freedom, misfit / count)
    if not chance < UNEXPLAINED:
        return []
    text = (
        f"no single fault explains these readings: the best leaves {misfit / count:.3g} times the variance of the "
        "noise. Check that they are of this tool, in its units, with the right references and none that moved."
    )
    return [Finding(id="unexplained", text=text)]


def _rival(calibration: Calibration, evidence: FaultEvidence, name: str) -> Rival:
    """What a fault that is not named would be."""
    sized = _named(calibration, evidence, name)
    return Rival(fault=name, **{key: sized[key] for key in Rival.__struct_fields__[1:]})


def _can_show(form: FaultForm, readings: Readings) -> bool:
    """Whether a form can show in such readings at all."""
    if form.kind == HEAT and not preparation.warmed(readings):
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
        row = Moved(
            parameter=term.name,
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
    """Sign of a channel along its tool axis, for sizes that change with it."""
    if term.channel is None or not term.name.startswith(("bias", "constant")):
        return 1.0
    triad = list(CHANNELS)[term.channel // 3]
    return float(getattr(calibration.profile, triad).permutation[term.channel % 3].sum())
