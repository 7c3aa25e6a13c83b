"""Noise-free spreads and errors of a calibrated tool in a test run.

The uncertainty of each statistic is that of the test: noise of its readings, references, setting
of the stand. That of the calibration is not part of it: an error of the calibration is part of
what is measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import FREE_SHARE, MAGNETIC, Calibration
from mwdcal.calibration.settings import DIRECTION, is_assumed, settings_of
from mwdcal.errors import InputError
from mwdcal.estimation.evidence import ANGLES
from mwdcal.geometry.observables import OBSERVABLES, OUTPUTS
from mwdcal.geometry.vectors import Array, Bools, Ints
from mwdcal.use import roll_test
from mwdcal.use.roll_test import (
    FITTED,
    ROLL_SET,
    UNLIMITED,
    Coverage,
    Curve,
    NoiseScale,
    RollSet,
    draws,
    near_vertical,
    roll_sets,
)

NO_ERROR_OF_A_TOOL: dict[str, float] = {
    **dict.fromkeys(("inclination", "azimuth", "toolface"), float(np.radians(5.0))),
    "gravity": 0.01,
    "field": 0.03,
    "dip": float(np.radians(2.0)),
}
"""Departures from a reference of the run that are no error of a tool: radians, g, a share of the field."""
UNDEFINED_AT_VERTICAL = ("azimuth", "toolface")
"""Angles that do not exist at vertical."""
LEVEL = ("inclination", "gravity")
"""Observables that stations of one inclination share at every azimuth."""
REFERENCE_COLUMNS = {name: f"ref_{column}" for name, column in OUTPUTS.items()}
"""Reference column of each observable."""
NO_TOOLFACE = (
    f"the toolface of exactly vertical stations is not known. Give {REFERENCE_COLUMNS['toolface']}"
)
NOT_DETERMINED = "it rests on a direction that the calibration leaves undetermined"
SEEN = 0.7
"""Least share of the amplitude of each harmonic that stations should show."""
WORST_CONDITION = 1e10
"""Condition number of a curve's covariance above which its digits are those of rounding."""
TINY = 1e-15
LEAST_ALONE = 1e-6
"""Least noise of a value beside errors that it shares with others, in sizes of these: their matrix stays regular."""


@dataclass(frozen=True)
class Statistic:
    """Spread or error of an observable in a roll set, or error of one station: radians, g or nT.

    `value` is without noise, `raw` with it; `where` says in words what was judged, `label` which set.
    `part` (k,): what the stations `index` show, noise included: errors, or departures from the
    middle of the set. `freedom`: degrees of freedom of the uncertainty, infinite where all of it is
    declared; `errors` (d,): what `value` would be off by in tests like this one.
    """

    value: float
    uncertainty: float
    raw: float
    where: str
    index: Ints
    part: Array
    label: str = ""
    curve: Curve | None = None
    freedom: float = UNLIMITED
    errors: Array = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Departures:
    """All statistics of one observable in a run, or why there are none.

    `skipped`: why it cannot be judged. `blocked`: why no limit on it can be passed; `unrolled`:
    because the tool was not rolled all round: there is no noise-free value, and `statistics` have
    the raw one. `apart`: parts of the run that were left out, and why. `unseen`:
    the toolfaces hardly show one of the harmonics. `remarks`: ids of findings about the scatter.
    """

    statistics: tuple[Statistic, ...] = ()
    skipped: str = ""
    blocked: str = ""
    unrolled: bool = False
    apart: tuple[str, ...] = ()
    unseen: bool = False
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class ReferenceErrors:
    """Standard uncertainties of the references of a roll set of k stations.

    `individual` (k,): of each station alone; `together` (k, k): covariance of settings that some stations share, or
    None. `setting` or strength, and `zero` of the stand: of what all stations of the set share.
    """

    individual: Array
    together: Array | None
    setting: float
    zero: float

    @property
    def shared(self) -> float:
        """Standard uncertainty of what all stations of the set share."""
        return float(np.hypot(self.setting, self.zero))


@dataclass(frozen=True)
class _Rolled:
    """Values (k,) of a rolled set to judge, their curve, and the uncertainty of the references.

    `noisy`: share of the noise in the variance of a value, what all values share apart.
    """

    roll_set: RollSet
    part: Array
    curve: Curve
    noisy: float
    reference: ReferenceErrors


@dataclass(frozen=True)
class RollTest:
    """Readings that a fit has not seen, through its calibration."""

    calibration: Calibration
    readings: Readings

    @cached_property
    def fields(self) -> tuple[Array, Array]:
        """Both corrected vectors (n, 3) of every station."""
        return self.calibration.fields(self.readings)

    @cached_property
    def sets(self) -> list[RollSet]:
        """Roll sets of the run."""
        return roll_sets(self.readings)

    @cached_property
    def near(self) -> Bools:
        """Stations (n,) too near to vertical for azimuth and toolface."""
        return near_vertical(self.readings, self.value("inclination"))

    @cached_property
    def toolface(self) -> Array:
        """Toolface (n,) by which the tool was rolled: near vertical the magnetic one, if there is any."""
        magnetic = self.value("magnetic_toolface")
        upright = np.where(np.isnan(magnetic), self.readings.reference("toolface"), magnetic)
        return np.where(self.near & ~np.isnan(upright), upright, self.value("toolface"))

    def value(self, name: str) -> Array:
        """An observable (n,) of the corrected vectors."""
        return OBSERVABLES[name].value(*self.fields)

    @cached_property
    def settings(self) -> Ints:
        """Number (n,) of the setting of the stand that each station belongs to."""
        return settings_of(self.readings)

    def _noise(self, name: str) -> Array:
        """Standard uncertainty (n,) of an observable by the noise of the test's own readings."""
        gradient = np.nan_to_num(OBSERVABLES[name].gradient(*self.fields))
        noise = self.calibration.noise_covariance(self.readings)
        variance = np.einsum("ni,nij,nj->n", gradient, noise, gradient)
        return np.asarray(np.maximum(np.sqrt(variance), TINY))

    def noise_freedom(self, name: str) -> float:
        """Degrees of freedom of the noise of an observable: infinite where the noise of all triads is declared."""
        triads = self.calibration.triads[: 2 if name in MAGNETIC else 1]
        estimated = [
            t for t in triads if t.name not in self.readings.sd and t.noise_source != "declared"
        ]
        return min((t.degrees_of_freedom for t in estimated), default=UNLIMITED)

    def _common(self, name: str) -> Array:
        """Standard uncertainty (n,) of a reference by errors that all stations of the stand share."""
        return self.readings.common_uncertainty(name, self.value("inclination"))

    def _lacks(self, name: str) -> str:
        """The inputs that an observable lacks; empty if it lacks none."""
        if name not in ("azimuth", "field", "dip"):
            return ""
        if not self.calibration.has_field:
            return "the magnetometer is not calibrated"
        return "" if self.readings.magnetometer is not None else "no columns mx, my, mz"

    def _error(self, name: str) -> Array:
        """Departure (n,) from the reference that the run itself gives; NaN where it gives none."""
        known = self.readings.known.get(name, np.nan)
        return OBSERVABLES[name].difference(self.value(name), known)

    def contradicted(self, name: str) -> float:
        """Median departure from the run's own reference, where it is more than a sound tool shows; else zero."""
        named = self.readings.known.get(name)
        if named is None or self._lacks(name) or (name == "field" and self.calibration.relative):
            return 0.0
        error, most = self._error(name), NO_ERROR_OF_A_TOOL[name]
        error = error[~np.isnan(error) & ~(self.near & (name in UNDEFINED_AT_VERTICAL))]
        if not error.size or bool(self.calibration.rests_on_free(name, self.readings).any()):
            return 0.0
        most *= float(np.nanmedian(named)) if name == "field" else 1.0
        size = float(np.median(np.abs(error)))
        return float(np.copysign(size, np.median(error))) if size > most else 0.0

    def loose(self, index: Ints) -> str:
        """Why stations do not determine a curve of one harmonic or two; empty where they do."""
        if not index.size or np.isnan(self.toolface[index]).any():
            return NO_TOOLFACE
        circle = self._coverage(index)
        if circle.rolled:
            return ""
        return _gap(circle, roll_test.WIDEST_GAP) or (
            "the toolfaces do not determine a mean and a harmonic. Add toolfaces between them: four "
            "at right angles, or more"
        )

    def harmonics(self, roll_set: RollSet) -> int:
        """Harmonics of the curve that a rolled set determines, 1 or 2."""
        return int(self._coverage(roll_set.index).harmonics)

    def _coverage(self, index: Ints) -> Coverage:
        """How the toolfaces of stations cover the circle."""
        places = tuple(index.tolist())
        if places not in self._coverages:
            self._coverages[places] = roll_test.coverage(self.toolface[index])
        return self._coverages[places]

    @cached_property
    def _coverages(self) -> dict[tuple[int, ...], Coverage]:
        """Coverages by stations: a set is asked for again by every limit."""
        return {}

    def unfit(self, name: str, roll_set: RollSet) -> str:
        """Why a roll set has no spread of an observable; empty where it has."""
        if not roll_set.one_azimuth and name not in LEVEL:
            return f"stations of one direction need group or {REFERENCE_COLUMNS['azimuth']}"
        if name in UNDEFINED_AT_VERTICAL and self.near[roll_set.index].any():
            return "within 5° of vertical"
        blank = name == "toolface" and np.isnan(self._error(name)[roll_set.index]).any()
        return f"no {REFERENCE_COLUMNS[name]}" if blank else ""

    def spread(self, name: str) -> Departures:
        """The widest noise-free spread over the roll sets.

        A group that was not rolled cannot pass, nor can sets of equal reference directions of
        which none was; other sets that were not rolled are left out. Toolface: of its error.
        """
        lacks = self._lacks(name)
        if lacks or not self.sets:
            return Departures(skipped=lacks or f"no {ROLL_SET} stations of one direction")
        unfit = {s.label: self.unfit(name, s) for s in self.sets}
        fit = [s for s in self.sets if not unfit[s.label]]
        gaps = {s.label: self.loose(s.index) for s in fit}
        rolled = [s for s in fit if not gaps[s.label]]
        wrong = [s for s in fit if gaps[s.label] and (s.declared or (s.one_azimuth and not rolled))]
        kept = {s.label for s in (*rolled, *wrong)}
        apart = (
            *(f"{label}: {why}" for label, why in unfit.items() if why),
            *(f"{label}: not rolled, {gap}" for label, gap in gaps.items() if label not in kept),
        )
        if not kept:
            return Departures(skipped="; ".join(apart))
        free = any(self._free_spread(name, s.index) for s in fit)
        unrolled = f"{wrong[0].label} was not rolled: {gaps[wrong[0].label]}" if wrong else ""
        statistics, remarks = self._curves(name, rolled, False)
        statistics += [self._unrolled(name, s) for s in wrong]
        unseen = any(self.harmonics(s) < max(FITTED) for s in rolled)
        return self._outcome(name, statistics, free, unrolled, apart, unseen, remarks)

    def _unrolled(self, name: str, roll_set: RollSet) -> Statistic:
        """Spread, with its noise, of a set that was not rolled."""
        index, label = roll_set.index, roll_set.label
        part = self._centred(name, index)
        raw, middle = float(np.ptp(part)), (part.max() + part.min()) / 2
        return Statistic(raw, 0.0, raw, label, index, part - middle, label)

    def error(self, name: str) -> Departures:
        """The largest noise-free departure from the reference: of rolled sets, and other stations.

        Cannot be passed on stations that were not, taken together, rolled all round.
        """
        if lacks := self._lacks(name):
            return Departures(skipped=lacks)
        given = ~np.isnan(self._error(name))
        near = given & self.near & (name in UNDEFINED_AT_VERTICAL)
        judged = np.flatnonzero(given & ~near)
        if not judged.size:
            steep = "every station within 5° of vertical"
            return Departures(skipped=steep if near.any() else f"no {REFERENCE_COLUMNS[name]}")
        free = bool(self.calibration.rests_on_free(name, self.readings)[judged].any())
        known = self.toolface[judged][~np.isnan(self.toolface[judged])]
        circle = roll_test.coverage(known) if known.size else None
        gap = NO_TOOLFACE if circle is None else _gap(circle, roll_test.OPEN)
        unrolled = f"the stations were not rolled: {gap}" if gap else ""
        unseen = circle is not None and not gap and bool(circle.seen.min() < SEEN)
        left = f"{near.sum()} of {given.sum()} stations lie within 5° of vertical"
        apart = (left,) if near.any() else ()
        statistics, remarks = self._errors(name, judged)
        return self._outcome(name, statistics, free, unrolled, apart, unseen, remarks)

    def _outcome(
        self, name: str, statistics: list[Statistic], free: bool, unrolled: str,
        apart: tuple[str, ...], unseen: bool, remarks: tuple[str, ...],
    ) -> Departures:  # fmt: skip
        """The statistics, and why no limit can be passed: `free` and `unrolled` are reasons."""
        if name == "field" and self.calibration.relative:
            return Departures(blocked="the calibration is relative: field = 1, not nT", apart=apart)
        blocked = NOT_DETERMINED if free else unrolled
        return Departures(tuple(statistics), "", blocked, bool(unrolled), apart, unseen, remarks)

    def _errors(self, name: str, judged: Ints) -> tuple[list[Statistic], tuple[str, ...]]:
        """Largest errors of rolled sets, and of each station outside of them."""
        seen = [replace(s, index=s.index[np.isin(s.index, judged)]) for s in self.sets]
        whole = [s for s in seen if not self.loose(s.index) and (s.one_azimuth or name in LEVEL)]
        inside = np.concatenate([s.index for s in whole]) if whole else ()
        alone = judged[~np.isin(judged, inside)]
        curves, remarks = self._curves(name, whole, True)
        return curves + self._single(name, alone), remarks

    def _single(self, name: str, alone: Ints) -> list[Statistic]:
        """The error of each of some stations (k,)."""
        error, noise = self._error(name)[alone], self._noise(name)[alone]
        reference, common = self.readings.uncertainty(name)[alone], self._common(name)[alone]
        sd = np.sqrt(noise**2 + reference**2 + common**2)
        freedom = self.noise_freedom(name) * (sd / noise) ** 4
        drawn = noise * draws(f"noise of {name}", self.readings.count)[:, alone]
        drawn = drawn + reference * self._reference_draws(name, alone)
        errors = np.sign(error) * (drawn + common * draws(f"zero of {name}", 1))
        return [
            Statistic(
                abs(float(error[k])), float(sd[k]), abs(float(error[k])),
                f"station {self.readings.labels[i]}", alone[k : k + 1], error[k : k + 1],
                freedom=float(freedom[k]), errors=errors[:, k],
            )
            for k, i in enumerate(alone)
        ]  # fmt: skip

    def _reference_draws(self, name: str, index: Ints) -> Array:
        """Standard normal numbers (d, k) of the references of stations, the same for those of one setting."""
        numbers = draws(f"reference {name}", self.readings.count)
        if name in ANGLES:
            return numbers[:, self.settings[index] if name in DIRECTION else index]
        return np.broadcast_to(numbers[:, :1], (len(numbers), len(index)))

    def _curves(
        self, name: str, sets: Sequence[RollSet], error: bool
    ) -> tuple[list[Statistic], tuple[str, ...]]:
        """Noise-free spread, or largest error, of rolled sets, and remarks on their scatter."""
        if not sets:
            return [], ()
        rolled = [self._rolled(name, s, error) for s in sets]
        stated, doubted = self.noise_freedom(name), False
        if name in DIRECTION and is_assumed(self.readings):
            doubted = any(bool(each.curve.rough(stated)) for each in rolled)
        if doubted:  # that the direction was set once was an assumption
            rolled = [self._rolled(name, s, error, doubted) for s in sets]
        known = stated / max(each.noisy for each in rolled) ** 2
        noise = roll_test.scatter([each.curve for each in rolled], known)
        remarks = {"little-scatter": bool(noise.calm), "settings-doubted": doubted}
        statistics = [self._curve_of(name, each, noise, error) for each in rolled]
        return statistics, tuple(remark for remark, holds in remarks.items() if holds)

    def _rolled(self, name: str, roll_set: RollSet, error: bool, doubted: bool = False) -> _Rolled:
        """The values of a rolled set, their curve, and what their errors would be in other tests."""
        index = roll_set.index
        part = self._error(name)[index] if error else self._centred(name, index)
        noise, reference = self._noise(name)[index], self.reference_errors(name, roll_set, error)
        individual, together = reference.individual, reference.together
        if doubted and not roll_set.declared:
            individual = self.readings.uncertainty(name)[index]
        sd = np.hypot(noise, individual)
        among = np.zeros(sd.shape) if together is None else np.sqrt(np.diagonal(together))
        sd = np.maximum(sd, LEAST_ALONE * among)
        curve = roll_test.fitted(part, sd, self.toolface[index], self.harmonics(roll_set), together)
        places = FITTED[curve.harmonics]
        numbers = [*curve.coefficients, *curve.covariance.flat]
        covariance = curve.covariance[np.ix_(places, places)]
        if not np.isfinite(numbers).all() or np.linalg.cond(covariance) > WORST_CONDITION:
            raise InputError(
                f"{self.readings.source}: the uncertainties of {roll_set.label} are too far apart to judge "
                f"its {name}. Check the columns sd_: they are in the unit of their column."
            )
        noisy = float(np.mean(noise**2) / np.mean(sd**2 + among**2))
        return _Rolled(roll_set, part, curve, noisy, reference)

    def _curve_of(self, name: str, rolled: _Rolled, noise: NoiseScale, error: bool) -> Statistic:
        """Noise-free spread, or largest error, of a rolled set."""
        roll_set, part, curve = rolled.roll_set, rolled.part, rolled.curve
        first, reference = int(roll_set.index[0]), rolled.reference
        judged = roll_test.figure(part, curve, noise, error, roll_test.drawn(curve, name, first))
        most, least, farthest = np.degrees(roll_test.ends(curve))
        at = f"toolface {farthest:.0f}°" if error else f"toolfaces {least:.0f}° to {most:.0f}°"
        where = f"{roll_set.label}; {at}"
        if curve.rough(noise.known):
            where += f"; raw figure judged: {float(curve.scale):.2g} × the noise is left about a smooth curve"
        if not error:
            curve, middle = roll_test.about_middle(curve)
            part = part - middle
        sd = float(np.hypot(judged.uncertainty, reference.shared))
        share = float(judged.uncertainty / sd) ** 2
        freedom = float(judged.freedom) / max(share, TINY) ** 2
        return Statistic(
            float(judged.value), sd, float(judged.raw), where, roll_set.index, part, roll_set.label,
            curve, freedom, judged.errors + judged.side * self.common_errors(name, reference, first),
        )  # fmt: skip

    def reference_errors(self, name: str, roll_set: RollSet, error: bool) -> ReferenceErrors:
        """Standard uncertainties of the references of a set, as a spread or an error has them.

        The error of a setting of the stand is common to the stations that share it, and does not average down.
        """
        index = roll_set.index
        sd, number = self.readings.uncertainty(name)[index], self.settings[index]
        zero = float(self._common(name)[index].max()) if error else 0.0
        if name == "toolface":
            return ReferenceErrors(sd, None, 0.0, zero)
        if name in ANGLES and not roll_set.declared and len(set(number.tolist())) > 1:
            same = number[:, None] == number
            if np.trace(same) == same.sum():
                return ReferenceErrors(sd, None, 0.0, zero)
            return ReferenceErrors(np.zeros(sd.shape), same * np.outer(sd, sd), 0.0, zero)
        most = float(sd.max()) if error else 0.0
        whole = most * float(np.sqrt(np.mean((sd / most) ** 2))) if most else 0.0
        return ReferenceErrors(np.zeros(sd.shape), None, whole, zero)

    def common_errors(self, name: str, reference: ReferenceErrors, first: int) -> Array:
        """What a set (its `first` station) shares would be off by (d,) in tests like this one."""
        setting = self._reference_draws(name, np.array([first]))[:, 0]
        return reference.setting * setting + reference.zero * draws(f"zero of {name}", 1)[:, 0]

    def _centred(self, name: str, index: Ints) -> Array:
        """Values (k,) of a set about their middle; of toolface its errors."""
        part = (self._error(name) if name == "toolface" else self.value(name))[index]
        periodic = OBSERVABLES[name].period
        middle = np.angle(np.mean(np.exp(1j * part))) if periodic else part.mean()
        return OBSERVABLES[name].difference(part, middle)

    def _free_spread(self, name: str, index: Ints) -> bool:
        """Whether the spread of a set moves with a direction that no evidence determines."""
        if not self.calibration.free:
            return False
        rows = np.nan_to_num(self.calibration.sensitivity(name, self.readings)[index])
        moved = rows @ self.calibration.free_directions.transpose()
        size = self.calibration.earth.get("field", 1.0) if OBSERVABLES[name].unit == "nT" else 1.0
        return bool((np.ptp(moved, axis=0) > FREE_SHARE * size).any())


def _gap(circle: Coverage, most: float) -> str:
    """The sentence on toolfaces that leave a gap wider than `most` (radians); empty if they do not."""
    if circle.gap <= most + roll_test.SLACK:
        return ""
    width, start = round(float(np.degrees(circle.gap))), round(float(np.degrees(circle.start)))
    span = f"{width}° from {start % 360}° to {(start + width) % 360}°"
    return f"the toolfaces leave a gap of {span} (at most {np.degrees(most):.0f}°). Add toolfaces there"
