"""Verification: a calibration against independent readings and a limits profile. Pure data."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np

from mwdcal.calibration import FREE_SHARE, Calibration, Finding
from mwdcal.core.observables import OBSERVABLES
from mwdcal.core.vectors import AnyArray, Array, Bools, centred
from mwdcal.errors import InputError
from mwdcal.readings import ANGLES, Readings

COVERAGE = 2.0
"""Coverage factor of the guard band and of the remark that a value is close to its limit."""
UPRIGHT = ("azimuth", "toolface")
NEAR_VERTICAL = np.radians(5.0)
"""Spreads of azimuth and toolface are not judged nearer to vertical than this."""
ROLL_SET = 3
"""Fewest stations that make a roll set."""


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
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if value is not None:
                yield name.rpartition("_")[0], value


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A limits profile: what a roll test may show, where the limits come from, and the rule.

    rule "simple": a value passes up to its limit. "guarded": value plus twice its standard
    uncertainty must not exceed the limit.
    """

    name: str
    source: str = ""
    rule: Literal["simple", "guarded"] = "simple"
    spread: Bounds = Bounds()
    error: Bounds = Bounds()


class VerdictRow(msgspec.Struct, frozen=True, kw_only=True):
    """One limit: the worst value found, its standard uncertainty, and the decision."""

    name: str
    unit: str
    value: float | None
    uncertainty: float | None
    limit: float
    passed: bool
    note: str


class Verdict(msgspec.Struct, frozen=True, kw_only=True):
    """The outcome of a verification."""

    passed: bool
    rule: str
    limits: str
    source: str
    run: str
    stations: int
    rows: list[VerdictRow]
    findings: list[Finding]


RULES = {
    "simple": "simple acceptance: a value passes up to its limit; its standard uncertainty is stated beside it",
    "guarded": "guarded acceptance: value + 2 × standard uncertainty must not exceed the limit",
}


def verify(calibration: Calibration, readings: Readings, limits: Limits) -> Verdict:
    """Apply a calibration to independent readings and judge by a limits profile.

    Errors: stations of the fit, temperatures outside the calibrated range, or nothing that
    any of the limits could be applied to.
    """
    _check_tool(calibration, readings)
    _check_independent(calibration, readings)
    _check_temperature(calibration, readings)
    test = _Test(calibration, readings, limits)
    judged = {f"spread of {n}": test.spread(n, limit) for n, limit in limits.spread.items()}
    judged |= {f"error of {n}": test.error(n, limit) for n, limit in limits.error.items()}
    found = [row for row in judged.values() if row is not None]
    skipped = [name for name, row in judged.items() if row is None]
    if not found:
        raise InputError(
            f"{readings.source}: no limit of '{limits.name}' applies: there is neither a roll set "
            f"({ROLL_SET} or more stations of one direction, by 'group' or equal reference angles) "
            "nor a reference angle. Add one of them, or choose other --limits."
        )
    return Verdict(
        passed=all(row.passed for row in found),
        rule=RULES[limits.rule],
        limits=limits.name,
        source=limits.source,
        run=readings.source,
        stations=readings.count,
        rows=found,
        findings=test.findings(skipped),
    )


def _check_tool(calibration: Calibration, readings: Readings) -> None:
    other = calibration.other_tool(readings)
    if other is not None:
        ours, theirs = other
        raise InputError(
            f"{readings.source} is of tool {theirs}, the calibration of tool {ours}. Verify with a "
            "run of the same tool, or correct 'serial' in the file."
        )


def _check_independent(calibration: Calibration, readings: Readings) -> None:
    used = [
        label
        for label, seen in zip(readings.labels, calibration.used(readings.digest), strict=False)
        if seen
    ]
    if used:
        raise InputError(
            f"{readings.source}: {len(used)} of {readings.count} stations were in the fit (first: "
            f"station {used[0]}). Verification needs data that the fit has not seen: take a roll "
            "test of its own."
        )


def _check_temperature(calibration: Calibration, readings: Readings) -> None:
    outside = calibration.outside(readings)
    if outside.any() and calibration.temperature_c is not None:
        low, high = calibration.temperature_c
        first = int(np.flatnonzero(outside)[0])
        raise InputError(
            f"{readings.source}: {int(outside.sum())} stations lie outside the calibrated range "
            f"{low:.1f}…{high:.1f} °C (first: station {readings.labels[first]}). Verify within "
            "the range, or calibrate over a wider one."
        )


@dataclass(frozen=True)
class _Test:
    calibration: Calibration
    readings: Readings
    limits: Limits

    def _value(self, name: str) -> Array:
        return OBSERVABLES[name].value(*self.calibration.fields(self.readings))

    def _scale(self, name: str) -> tuple[float, str]:
        unit = OBSERVABLES[name].unit
        return (float(np.degrees(1)), "°") if unit == "rad" else (1.0, unit)

    def _applies(self, name: str) -> bool:
        magnetic = name in ("azimuth", "field", "dip")
        return not magnetic or (
            self.calibration.has_field and self.readings.magnetometer is not None
        )

    def sets(self) -> list[tuple[str, AnyArray]]:
        """Roll sets: label and station numbers."""
        found = []
        for label, members in _directions(self.readings):
            index = np.flatnonzero(members)
            if len(index) >= ROLL_SET:
                found.append((label, index))
        return found

    def _upright(self, index: AnyArray) -> bool:
        """Whether a roll set is too close to vertical for a spread of azimuth or toolface."""
        across = np.sin(self._value("inclination")[index])
        return bool(across.mean() < np.sin(NEAR_VERTICAL))

    def spread(self, name: str, limit: float) -> VerdictRow | None:
        """The widest spread over the roll sets, or None where there is none."""
        if not self._applies(name):
            return None
        value, period = self._value(name), OBSERVABLES[name].period
        worst: tuple[float, AnyArray, str] | None = None
        for label, index in self.sets():
            part = value[index]
            if np.isnan(part).any() or (name in UPRIGHT and self._upright(index)):
                continue
            middle = np.angle(np.mean(np.exp(1j * part))) if period else 0.0
            part = centred(part - middle, period) if period else part
            ends = index[[int(np.argmax(part)), int(np.argmin(part))]]
            if worst is None or np.ptp(part) > worst[0]:
                worst = (float(np.ptp(part)), ends, label)
        if worst is None:
            return None
        width, ends, label = worst
        contrast = np.zeros((1, self.readings.count))
        contrast[0, ends] = 1.0, -1.0
        labels = " to ".join(self.readings.labels[i] for i in sorted(ends))
        free = any(self._free_spread(name, index) for _, index in self.sets())
        return self._row(
            f"spread of {name}", name, width, contrast, limit, free, f"{label}; stations {labels}"
        )

    def error(self, name: str, limit: float) -> VerdictRow | None:
        """The largest departure from the reference, or None where there is no reference."""
        reference = self.readings.reference(name)
        if not self._applies(name):
            return None
        error = self._value(name) - reference
        error = centred(error, OBSERVABLES[name].period) if OBSERVABLES[name].period else error
        if np.isnan(error).all():
            return None
        worst = int(np.nanargmax(np.abs(error)))
        contrast = np.zeros((1, self.readings.count))
        contrast[0, worst] = 1.0
        free = bool(self.calibration.rests_on_free(name, self.readings)[~np.isnan(error)].any())
        note = f"station {self.readings.labels[worst]}"
        return self._row(
            f"error of {name}", name, abs(float(error[worst])), contrast, limit, free, note
        )

    def _free_spread(self, name: str, index: AnyArray) -> bool:
        """Whether the spread of a set moves with a direction that no evidence determines."""
        if not self.calibration.free:
            return False
        rows = np.nan_to_num(self.calibration.sensitivity(name, self.readings)[index])
        moved = rows @ np.array(self.calibration.free).transpose()
        size = {"g": 1.0, "nT": self.calibration.earth.get("field", 1.0)}.get(
            OBSERVABLES[name].unit, 1.0
        )
        return bool((np.ptp(moved, axis=0) > FREE_SHARE * size).any())

    def _uncertainty(self, name: str, contrast: Array, common_cancels: bool) -> float:
        """Calibration, noise and references, of a sum of stations; common references may cancel."""
        rows = np.nan_to_num(contrast @ self.calibration.sensitivity(name, self.readings))
        variance = float((rows @ np.array(self.calibration.covariance) @ rows.transpose())[0, 0])
        gradient = OBSERVABLES[name].gradient(*self.calibration.fields(self.readings))
        gradient = np.nan_to_num(gradient)
        noise = self.calibration.noise_covariance(self.readings)
        each = np.einsum("ni,nij,nj->n", gradient, noise, gradient)
        if not common_cancels:
            each = each + self.readings.uncertainty(name) ** 2
        return float(np.sqrt(variance + np.sum(contrast[0] ** 2 * each)))

    def _row(
        self,
        title: str,
        name: str,
        value: float,
        contrast: Array,
        limit: float,
        free: bool,
        note: str,
    ) -> VerdictRow:
        factor, unit = self._scale(name)
        cancels = title.startswith("spread") and name not in ANGLES
        uncertainty = self._uncertainty(name, contrast, cancels) * factor
        value = value * factor
        guard = COVERAGE * uncertainty if self.limits.rule == "guarded" else 0.0
        relative = name == "field" and self.calibration.field_unit != "nT"
        if free or relative:
            reason = "it rests on a direction that the calibration leaves undetermined"
            reason = "the calibration is relative: field = 1, not nT" if relative else reason
            return VerdictRow(
                name=title,
                unit=unit,
                value=None if relative else value,
                uncertainty=None,
                limit=limit,
                passed=False,
                note=f"cannot be passed: {reason}",
            )
        if abs(value - limit) < COVERAGE * uncertainty:
            note += "; closer to the limit than twice its uncertainty"
        return VerdictRow(
            name=title, unit=unit, value=value, uncertainty=uncertainty, limit=limit,
            passed=value + guard <= limit, note=note,
        )  # fmt: skip

    def findings(self, skipped: list[str]) -> list[Finding]:
        """What was left out, and what to know."""
        found = [Finding(id=u.id, text=f"{u.text}.") for u in self.calibration.undetermined()]
        if skipped:
            text = f"not judged, for want of references, roll sets or magnetometer: {', '.join(skipped)}."
            found.append(Finding(id="not-judged", text=text))
        if not self.sets():
            found.append(Finding(id="no-roll-set", text="no roll set: spreads were not judged."))
        return found


def _directions(readings: Readings) -> list[tuple[str, Bools]]:
    """Stations of one direction: by group, else by equal reference angles, else all of them."""
    group = np.full(readings.count, -1) if readings.group is None else readings.group
    found = [
        (f"roll set {k + 1}", np.asarray(group == k)) for k in range(int(group.max(initial=-1)) + 1)
    ]
    inclination, azimuth = readings.reference("inclination"), readings.reference("azimuth")
    if not found and np.isnan(inclination).all():
        return [("all stations", np.ones(readings.count, bool))]
    key = np.round(np.degrees(np.stack([inclination, np.nan_to_num(azimuth, nan=-1.0)], -1)), 3)
    for pair in np.unique(key[(group < 0) & ~np.isnan(inclination)], axis=0):
        where = f", azimuth {pair[1]:g}°" if pair[1] >= 0 else ""
        found.append((f"inclination {pair[0]:g}°{where}", np.all(key == pair, -1) & (group < 0)))
    return found
