"""What a run's readings say about its stations: references, uncertainties, groups, constants."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from mwdcal.calibration.readings import CONSTANTS, Readings
from mwdcal.calibration.settings import DIRECTION, numbered
from mwdcal.estimation.drift import walk_constants
from mwdcal.estimation.evidence import ANGLES, UNKNOWN, WALKS, Evidence, SharedConstant
from mwdcal.geometry.vectors import AnyArray, Array, Ints
from mwdcal.sensor.profile import COMMON

STAND_TURNS = {"tilt": ("stand-north", "stand-east")}
"""Errors of the stand that consist of several turns of its frame."""


def flat(value: AnyArray, lead: tuple[int, ...], *tail: int) -> AnyArray:
    """A value with one batch axis: (B, n, *tail)."""
    shape = (*lead, *tail)
    value = np.asarray(value)
    whole = value if value.shape == shape else np.broadcast_to(value, shape)
    return whole.reshape(math.prod(lead[:-1]), lead[-1], *tail)


def evidence_of(readings: Readings, include: Array) -> Evidence:
    """References and uncertainties of all stations of readings, with one batch axis (B, n)."""
    lead = np.broadcast_shapes(readings.accelerometer.shape[:-1], include.shape)
    known = {n: flat(readings.reference(n), lead) for n in ANGLES + CONSTANTS}
    sd = {n: flat(readings.uncertainty(n), lead) for n in ANGLES + CONSTANTS}
    group = _shared_groups(flat(readings.groups, lead))
    included = flat(include, lead).astype(float)
    nowhere = np.isnan(known["field"]).all(-1, keepdims=True)
    known["field"] = np.where(nowhere, 1.0, known["field"])
    if readings.magnetometer is None:  # unread: any value will do
        known |= {name: np.nan_to_num(known[name], nan=1.0) for name in ("field", "dip")}
        sd |= {name: np.zeros(group.shape) for name in ("field", "dip")}
    alone = np.full(group.shape, -1)
    apart, stand = np.zeros(len(group)), _stand(readings, lead)
    drift = _declared(readings, [*WALKS][: 2 * len(readings.triads) - 1], lead)
    bare = Evidence(known, sd, group, alone, apart, included, (), stand=stand, drift=drift)
    known, sd = _share_known(bare)
    setting = _settings(readings, group, known, sd)
    settings, assumed = int(setting.max(initial=-1)) + 1, not readings.settings
    bare = replace(bare, known=known, sd=sd, setting=setting, settings=settings, assumed=assumed)
    return replace(bare, constants=constants(bare))


def _settings(
    readings: Readings, group: Ints, known: dict[str, Array], sd: dict[str, Array]
) -> Ints:
    """Number (B, n) of the setting of the stand that a station shares with others, -1 of its own.

    Exact references have none.
    """
    angles = [known[name] for name in DIRECTION]
    uncertain = np.any([sd[name] > 0 for name in DIRECTION], 0)
    if not uncertain.any():
        return np.full(group.shape, -1)
    number = numbered(group, angles, readings.settings)
    return _shared_groups(np.where(uncertain, number, -1))


def _stand(readings: Readings, lead: tuple[int, ...]) -> dict[str, Array]:
    """Standard uncertainties (B,) of errors of the stand, of each turn that they consist of.

    A tilt of known size leans to any azimuth: each of its two turns has half the variance.
    """
    turn_sd: dict[str, Array] = {}
    for name, size in _declared(readings, COMMON, lead).items():
        turns = STAND_TURNS.get(name, (name,))
        turn_sd |= dict.fromkeys(turns, size / math.sqrt(len(turns)))
    return turn_sd


def _declared(readings: Readings, names: Iterable[str], lead: tuple[int, ...]) -> dict[str, Array]:
    """Declared standard uncertainties (B,) of errors that all stations share."""
    given = [name for name in names if name in readings.sd]
    return {name: flat(readings.uncertainty(name), lead).max(-1) for name in given}


def acts_on(evidence: Evidence, name: str) -> Array:
    """Stations (B, n), as zeros and ones, whose references have an error of the stand."""
    angle = name.removesuffix("-zero") if name.endswith("-zero") else "inclination"
    return evidence.is_known(angle).astype(float)


def _shared_groups(group: Ints) -> Ints:
    """Group numbers (B, n) without gaps, -1 where a station is alone in its group."""
    if (group < 0).all():
        return np.full(group.shape, -1)
    labels, compact = np.unique(group, return_inverse=True)
    keys = compact.reshape(group.shape) + len(labels) * np.arange(len(group))[:, None]
    _, where, counts = np.unique(keys, return_inverse=True, return_counts=True)
    shared = (counts[where].reshape(group.shape) > 1) & (group >= 0)
    kept = np.unique(group[shared])
    return np.where(shared, np.searchsorted(kept, group), -1)


def _share_known(evidence: Evidence) -> tuple[dict[str, Array], dict[str, Array]]:
    """References and their σ where blank angles of a group take the mean of its filled cells.

    One error is then common to the group: that of its filled cells, whose mean has no smaller one.
    """
    known, spread = dict(evidence.known), dict(evidence.sd)
    if (evidence.group < 0).all():
        return known, spread
    for name in ("inclination", "azimuth"):
        given = evidence.is_known(name)
        if given.all() or not given.any():
            continue
        filled = evidence.members * given[..., None]
        count, total = filled.sum(-2), evidence.members.sum(-2)
        turn = np.einsum("bnk,bn->bk", filled, np.exp(1j * np.nan_to_num(known[name])))
        square = np.einsum("bnk,bn->bk", filled, evidence.sd[name] ** 2)
        partly = (count > 0) & (count < total)
        common = np.sqrt(square / np.maximum(count, 1)) * partly
        common = np.einsum("bnk,bk->bn", evidence.members, common)
        mean = np.einsum("bnk,bk->bn", evidence.members, np.angle(turn))
        within = np.einsum("bnk,bk->bn", evidence.members, partly) > 0
        known[name] = np.where(within & ~given, mean, known[name])
        spread[name] = np.where(within, common, evidence.sd[name])
    return known, spread


def constants(evidence: Evidence) -> tuple[SharedConstant, ...]:
    """Constants of the run to estimate: unknown ones, and errors of uncertain references."""
    shared = []
    for name, size in (("gravity", 1.0), ("field", 0.0), ("dip", UNKNOWN)):
        if name in evidence.absent:
            continue
        known = evidence.is_known(name)
        if not known.all():
            value = np.nansum(evidence.known[name], -1) / np.maximum(known.sum(-1), 1)
            value = np.nan_to_num(value)
            scale = np.full(len(value), size) if size else np.where(value > 0, value, 1.0)
            shared.append(SharedConstant(name, (~known).astype(float), value, scale, unknown=True))
        sd = np.max(np.where(known, evidence.sd[name], 0.0), -1)
        shared += _common_error(name, known.astype(float), sd)
    for name, sd in evidence.stand.items():
        shared += _common_error(name, acts_on(evidence, name), sd)
    return (*shared, *walk_constants(declared_sizes(evidence), evidence.include.shape[-1]))


def declared_sizes(evidence: Evidence) -> dict[str, Array]:
    """Trend and walk (B, 2) of each declared drift: nobody knows which it is, so each has half of the variance."""
    parts = np.full(2, math.sqrt(0.5))
    sizes = {name: np.maximum(size, 1e-12) for name, size in evidence.drift.items() if size.any()}
    return {name: size[:, None] * parts for name, size in sizes.items()}


def _common_error(name: str, mask: Array, sd: Array) -> list[SharedConstant]:
    """An error of standard uncertainty `sd` (B,) that stations share; none where all of that is zero."""
    if not ((sd > 0).any() and mask.any()):
        return []
    floor = np.where(sd > 0, sd, 1e-12)
    return [SharedConstant(name, mask, np.zeros(len(sd)), floor, unknown=False)]
