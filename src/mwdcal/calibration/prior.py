"""Information on a tool before the run: its datasheet, or a previous calibration.

PriorInformation is of the parameters as files name them, at a reference temperature; `prior_of` puts it
into the parameters of a fit, where it is one more block of residuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from msgspec.structs import replace as replace_struct

from mwdcal.calibration.copies import in_fit
from mwdcal.calibration.diagnosis.identity import other_tool, unidentified
from mwdcal.calibration.readings import HIGHEST, TRIADS, Readings, is_simulated, serial_of
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.errors import FitError, InputError
from mwdcal.estimation.problem import Prior
from mwdcal.geometry.vectors import Array
from mwdcal.sensor.models import Model, Restricted
from mwdcal.sensor.profile import Datasheet, Profile

DATASHEET: Literal["datasheet"] = "datasheet"
"""The prior that the tolerances in the tool profile are."""
DRIFT_REACH = 50.0
"""A datasheet's drift per °C holds to this far from the reference: later powers add no more, °C."""


@dataclass(frozen=True)
class PriorInformation:
    """Expected values (k,) of named parameters and their precision (k, k).

    Names are "accelerometer scale-x" and so on, in nominal units and tool axes, of powers of
    T - `reference`. A direction without precision is not known. `loose`: names that a model
    does not have are of no account; else they are an error. `stations` are the fingerprints of
    those that the knowledge comes from, `temperature` their range, °C; `common` names errors of the
    stand and of references that are part of its uncertainty, as `budget` of a calibration does.
    `simulated`: it comes from simulated data. `ageing` says by how much the tool may have changed since, `doubts`
    that nothing shows that it is of the run's tool.
    """

    source: str
    reference: float
    names: tuple[str, ...]
    expected: Array
    precision: Array
    loose: bool = False
    stations: tuple[str, ...] = ()
    temperature: tuple[float, float] | None = None
    common: tuple[str, ...] = ()
    simulated: bool = False
    ageing: str = ""
    doubts: tuple[Finding, ...] = ()


def prior_of(knowledge: PriorInformation | None, models: Sequence[Model], batch: int) -> Prior:
    """PriorInformation as precision and expectation (B, p) of a fit's parameters; none: all free.

    Raises `FitError` where the knowledge is of another model.
    """
    size = sum(model.size for model in models)
    precision, nothing = np.zeros((batch, size, size)), np.zeros((batch, size))
    if knowledge is None:
        return Prior(precision, nothing)
    whole, names, start = np.zeros_like(precision), [], 0
    for triad, model in zip(TRIADS, models, strict=False):
        _, one = model.finished(knowledge.reference)
        kept = model.kept if isinstance(model, Restricted) else range(model.size)
        where = slice(start, start + model.size)
        whole[:, where, where] = one[..., list(kept), :]
        names += [f"{triad} {name}" for name in model.names]
        start += model.size
    strange = [name for name in knowledge.names if name not in names]
    if strange and not knowledge.loose:
        raise FitError(
            f"the prior ({knowledge.source}) has parameters that this model lacks, such as "
            f"{strange[0]}. Use the same `model`, `order` and `parameters` as it had."
        )
    rows = [i for i, name in enumerate(names) if name in knowledge.names]
    places = [knowledge.names.index(names[i]) for i in rows]
    values, known = np.zeros(size), np.zeros((size, size))
    values[rows] = knowledge.expected[places]
    known[np.ix_(rows, rows)] = knowledge.precision[np.ix_(places, places)]
    centre = np.linalg.solve(whole, np.broadcast_to(values, (batch, size))[..., None])[..., 0]
    return Prior(whole.mT @ known @ whole, np.asarray(centre))


def from_datasheet(profile: Profile, relative: bool = False) -> PriorInformation:
    """The datasheet's tolerances (1 σ) as knowledge of either model, at any order.

    `relative`: the field's strength is unknown, so that neither scale nor bias of the
    magnetometer is known in its units, and only misalignments are.
    """
    rows = []
    for triad in TRIADS:
        sheet = getattr(profile, triad).datasheet
        unknown = relative and triad == "magnetometer"
        for name, value, sd in _tolerances(sheet) if sheet else []:
            if not np.isnan(sd) and (not unknown or name.startswith("misalignment")):
                rows.append((f"{triad} {name}", value, sd))
    return PriorInformation(
        "datasheet",
        profile.reference_temperature_c,
        tuple(name for name, _, _ in rows),
        np.array([value for _, value, _ in rows]),
        np.diag(np.array([sd for _, _, sd in rows]) ** -2.0),
        loose=True,
    )


def profile_for(
    prior: PriorInformation | Calibration | Literal["datasheet"] | None, profile: Profile
) -> Profile:
    """The profile with what a prior needs of it: a previous calibration's scale where it has none.

    PriorInformation is of readings in nominal units; scales guessed from the run would give others.
    Raises `InputError` where profile and prior do not belong together.
    """
    if prior == DATASHEET:
        _check_datasheet(profile)
    if not isinstance(prior, Calibration):
        return profile
    known = {}
    for name in TRIADS:
        present, previous = getattr(profile, name), getattr(prior.profile, name)
        scale = previous.scale if present.scale is None else present.scale
        known[name] = replace_struct(present, scale=scale)
        if previous.scale is not None and (present.axes, scale) != (previous.axes, previous.scale):
            raise InputError(
                f"`prior`: the calibration of {prior.run_name} was made with {name} axes "
                f"{list(previous.axes)} and scale {previous.scale:g}; the tool profile "
                f"'{profile.name}' has {list(present.axes)} and {scale:g}. Use the tool profile that "
                "the previous calibration had."
            )
    return replace_struct(profile, **known)


def _check_datasheet(profile: Profile) -> None:
    """Refuse a profile without tolerances, or without the scale that they are a share of."""
    sheets = [t for t in TRIADS if getattr(profile, t).datasheet is not None]
    if not sheets:
        raise InputError(
            f"`prior` datasheet: the tool profile '{profile.name}' has none. Add a section "
            "[accelerometer.datasheet] with scale, bias and misalignment_deg (1 sigma)."
        )
    if bare := [t for t in sheets if getattr(profile, t).scale is None]:
        raise InputError(
            f"`prior` datasheet: the tool profile '{profile.name}' has no 'scale' in [{bare[0]}], "
            "which the tolerances are a share of. Add it."
        )


def for_run(previous: Calibration, readings: Readings) -> PriorInformation:
    """A previous calibration as knowledge of the triads that a run has.

    A run without a magnetometer has no unit of the field that could differ.
    Raises `InputError` for a run of another tool, or of stations that the calibration has used.
    """
    where = f"`prior`: the calibration of {previous.run_name}"
    if other := other_tool(previous, readings):
        raise InputError(
            f"{where} is of tool {other[0]}, the run is of {other[1]}. Give the previous calibration "
            "of the same tool."
        )
    if in_fit(previous, readings).any():
        raise InputError(
            f"{where} was made from stations of this run, which would count twice. Give a "
            "calibration from an earlier run."
        )
    alone = readings.magnetometer is None
    known = from_calibration(previous, previous.relative if alone else readings.relative)
    serials = {where: serial_of(previous.tool), readings.run_name: serial_of(readings.metadata)}
    known = replace(known, doubts=tuple(unidentified(serials)))
    if not alone or not previous.has_field:
        return known
    kept = [i for i, name in enumerate(known.names) if name.startswith(TRIADS[0])]
    covariance = np.linalg.pinv(known.precision, hermitian=True)[np.ix_(kept, kept)]
    return replace(
        known,
        names=tuple(known.names[i] for i in kept),
        expected=known.expected[kept],
        precision=np.linalg.pinv(covariance, hermitian=True),
    )


def from_calibration(previous: Calibration, relative: bool = False) -> PriorInformation:
    """A previous calibration of the same tool, with its covariance and what it left undetermined.

    Raises `InputError` for one with own-axis terms (they are centred on their own run), or in
    another unit of the field than this run's.
    """
    where = f"`prior`: the calibration of {previous.run_name}"
    if any(triad.curved for triad in previous.triads):
        raise InputError(
            f"{where} has own-axis quadratic and cubic terms, which belong to the readings of its own "
            "run. Calibrate that run with `nonlinearity` none to use it as a prior."
        )
    if previous.has_field and previous.relative != relative:
        raise InputError(
            f"{where} is in {previous.field_unit}, this run is not. Give both runs ref_field_nt, or "
            "neither."
        )
    names = [f"{t.name} {name}" for t in previous.triads for name in t.parameter_names]
    covariance = previous.parameter_covariance
    moving = np.flatnonzero(np.diag(covariance) > 0)
    return PriorInformation(
        previous.run_name,
        previous.reference_temperature,
        tuple(names[i] for i in moving),
        previous.parameters[moving],
        _precision(covariance[np.ix_(moving, moving)], previous.free_directions[:, moving]),
        stations=tuple(previous.fingerprints),
        temperature=previous.temperature_c,
        common=tuple(row.source for row in previous.budget),
        simulated=is_simulated(previous.tool),
    )


def _precision(covariance: Array, free: Array) -> Array:
    """Inverse (k, k) of a covariance of which some directions, the rows of `free`, are not known.

    The covariance is singular there; the precision says nothing along them: both have the
    oblique projector onto its range, along the free directions, in common.
    """
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    kept = np.argsort(values)[len(free) :]
    span = vectors[:, kept]
    whole = np.concatenate([span, (free / scale).transpose()], -1)
    onto = np.linalg.solve(whole, np.eye(len(scale)))[: len(kept)]
    inner = onto.transpose() / values[kept] @ onto
    return np.asarray(inner / np.outer(scale, scale))


def _tolerances(sheet: Datasheet) -> list[tuple[str, float, float]]:
    """Name, expected value and standard deviation of every parameter, for both models; NaN: not stated."""
    steady = np.array([sheet.scale, sheet.bias], float)
    drift = np.array([sheet.scale_per_c, sheet.bias_per_c], float)
    turn = np.radians(np.array(sheet.misalignment_deg, float))
    tolerances = []
    for power in range(HIGHEST + 1):
        scale, bias = drift / DRIFT_REACH ** (power - 1) if power else steady
        suffix = f"·{power}" if power else ""
        across = turn * scale if power else turn
        for i in "xyz":
            tolerances += [(f"scale-{i}{suffix}", float(power == 0), scale)]
            tolerances += [(f"gain-{i}{i}{suffix}", float(power == 0), scale)]
            tolerances += [(f"bias-{i}{suffix}", 0.0, bias), (f"offset-{i}{suffix}", 0.0, bias)]
            tolerances += [(f"gain-{i}{j}{suffix}", 0.0, across) for j in "xyz" if j != i]
    return tolerances + [
        (f"misalignment-{i}{j}", 0.0, turn) for i in "xyz" for j in "xyz" if j != i
    ]
