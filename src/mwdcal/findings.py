"""What the reader of a calibration should know, in plain words, each with its remedy."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mwdcal.calibration import Finding, StationRow
from mwdcal.core.observability import Free, free_directions
from mwdcal.core.problem import Prior
from mwdcal.core.solvers import Determined
from mwdcal.core.vectors import Array, Bools, Ints, eigen
from mwdcal.estimate import Fit
from mwdcal.options import Options
from mwdcal.profile import Profile
from mwdcal.readings import TRIADS, Readings
from mwdcal.residuals import REASONS, shown_in, tail

SUSPECT = 3.0
"""A fit whose residuals exceed the declared noise this many times is reported."""
ENOUGH = 12.0
"""Degrees of freedom from which residuals far below the declared noise are no chance."""
UNLIKELY = 1e-3
"""Chance of so large a departure from the prior, below which it is reported."""
LARGEST = 37.0
"""Deviations are not told apart beyond this: a normal variable's chance is then below 1e-300."""
DISTRUSTED = 0.1
"""A station of less weight than this in a robust fit is reported."""

TEXTS = {
    "toolface-zero": "toolface zero is undetermined: no evidence fixes rotation about the tool axis; kept at nominal. "
    "Give ref_toolface_deg at some stations to determine it",
    "rotation-x": "rotation about the tool's x axis is undetermined: no evidence fixes it; kept at nominal. Give "
    "reference inclinations, or roll sets at three or more directions",
    "rotation-y": "rotation about the tool's y axis is undetermined: no evidence fixes it; kept at nominal. Give "
    "reference inclinations, or roll sets at three or more directions",
    "scale": "overall scale is undetermined: no evidence fixes it; kept at nominal. Give a reference strength",
}

NOTABLE = 3e-4
"""A scatter from station to station beyond this share, or radians, is a finding."""
_CONSTANT = {
    "gravity": "the strength of g",
    "field": "the strength of b",
    "dip": "the dip",
    "direction": "the direction within groups",
}


def described(name: str) -> str:
    """What a free direction means, and what would determine it."""
    steady, _, power = name.partition("-temperature-")
    course = f" (its course with temperature, power {power})" if power else ""
    return TEXTS.get(steady, steady) + course


def is_relative(readings: Readings) -> bool:
    """Whether the magnetometer is calibrated to a field of one."""
    return readings.magnetometer is not None and bool(np.isnan(readings.reference("field")).all())


def excessive(result: Fit) -> Bools:
    """Triads (B, t) whose residuals are more than `SUSPECT` times the declared noise."""
    declared = np.isnan(result.noise) & ~unchecked(result)
    return np.asarray(declared & (result.analysis.variance_factor > SUSPECT**2))


def calm(result: Fit) -> Bools:
    """Triads (B, t) whose residuals are less than the declared noise over `SUSPECT`."""
    tested = np.isnan(result.noise) & (result.analysis.freedom >= ENOUGH)
    return np.asarray(tested & (result.analysis.variance_factor < SUSPECT**-2))


def unchecked(result: Fit) -> Bools:
    """Triads (B, t) without redundancy."""
    return np.asarray(result.analysis.freedom < 1)


def copies(rows: Array) -> Ints:
    """Stations whose readings (n, k) are those of an earlier one, to the last digit."""
    _, first, place = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    return np.flatnonzero(first[place.ravel()] != np.arange(len(rows)))


def scattered(result: Fit) -> Bools:
    """Whether (B,) strengths, dip or the directions of groups depart from station to station."""
    sizes = [value.max(-1) for value in result.problem.evidence.scatter.values()]
    return np.asarray(np.max([np.zeros(len(result.status)), *sizes], 0) > NOTABLE)


def distrusted(result: Fit) -> Bools:
    """Stations (B, n) that a robust fit all but left out."""
    return np.asarray(result.trust < DISTRUSTED)


def without_prior(result: Fit) -> Fit:
    """The fit with only those directions determined that the run itself determines."""
    prior = result.problem.prior
    bare = replace(result.problem, prior=Prior(0 * prior.precision, prior.expected))
    determined = Determined.of(bare, result.state)
    return replace(result, problem=bare, analysis=replace(result.analysis, determined=determined))


def departures(result: Fit) -> tuple[Array, Ints]:
    """The χ² (B,) of the departure from the prior, Λd with covariance Λ - ΛCΛ, and its freedom."""
    prior, covariance = result.problem.prior, result.analysis.covariance
    precision, away = prior.precision, result.state.params - prior.expected
    spread = precision - precision @ covariance @ precision
    scale = np.sqrt(np.maximum(np.diagonal(precision, axis1=-2, axis2=-1), 1e-300))
    values, vectors = eigen(spread / (scale[:, :, None] * scale[:, None, :]))
    pull = (precision @ away[..., None])[..., 0] / scale
    along = np.einsum("bij,bi->bj", vectors, pull) ** 2
    tested = values > 1e-6
    square = np.sum(np.where(tested, along / np.where(tested, values, 1.0), 0.0), -1)
    return square, np.sum(tested, -1)


def conflicting(square: Array, freedom: Ints) -> Bools:
    """Whether departures (B,) from the prior are unlikely."""
    return np.asarray(tail(square, np.maximum(freedom, 1)) <= UNLIKELY)


@dataclass(frozen=True)
class Findings:
    """The findings of one fit."""

    readings: Readings
    profile: Profile
    options: Options
    result: Fit
    free: list[Free]

    def all(self, stations: list[StationRow]) -> list[Finding]:
        """All of them, in order of weight."""
        return [
            *self.residuals(),
            *self.scatter(),
            *self.repeated(stations),
            *self.undetermined(),
            *self.prior(),
            *self.model(),
            *(self.reshoot(row) for row in stations if row.reshoot),
            *self.distrusted(stations),
        ]

    def residuals(self) -> list[Finding]:
        """Residuals far beyond or below the declared noise; no redundancy."""
        found = []
        for index in np.flatnonzero(calm(self.result)[0]):
            share = float(self.result.analysis.variance_factor[0, index]) ** 0.5
            text = (
                f"{TRIADS[index]}: residuals are only {share:.2f} of the declared noise: the noise of "
                "the profile, or the columns sd_, are too large, and weigh the stations wrongly if "
                "not all by as much. Uncertainties are scaled down accordingly."
            )
            found.append(Finding(id=f"{TRIADS[index]}-noise", text=text))
        for index in np.flatnonzero(excessive(self.result)[0]):
            excess = float(self.result.analysis.variance_factor[0, index])
            text = (
                f"{TRIADS[index]}: residuals are {excess**0.5:.1f} times the declared noise: "
                "the noise figure, a reference, or the model is wrong. Uncertainties are "
                "scaled up accordingly."
            )
            found.append(Finding(id=f"{TRIADS[index]}-residuals", text=text))
        bare = [TRIADS[index] for index in np.flatnonzero(unchecked(self.result)[0])]
        if bare:
            text = f"{' and '.join(bare)}: no redundancy, so nothing in this run checks the fit. Add stations."
            found.append(Finding(id="no-redundancy", text=text))
        return found

    def scatter(self) -> list[Finding]:
        """What departs from station to station beyond the noise of the sensors."""
        if not scattered(self.result)[0]:
            return []
        sizes = {n: float(v.max()) for n, v in self.result.problem.evidence.scatter.items()}
        words = [
            f"{_CONSTANT[name]} by "
            + (
                f"{np.degrees(size):.2f}°"
                if name in ("dip", "direction")
                else f"{100 * size:.2f} %"
            )
            for name, size in sizes.items()
            if size > NOTABLE
        ]
        text = (
            f"from station to station, beyond the noise of the sensors, there departs {', '.join(words)} "
            "(1σ, estimated; weights and uncertainties include it). Look for iron near the stand, and "
            "for what holds the tool in its direction; or the model lacks something."
        )
        return [Finding(id="scatter", text=text)]

    def repeated(self, stations: list[StationRow]) -> list[Finding]:
        """Stations whose readings are another's to the last digit."""
        columns = (
            self.readings.accelerometer,
            self.readings.magnetometer,
            self.readings.temperature,
        )
        again = copies(np.column_stack([c for c in columns if c is not None]))
        if not again.size:
            return []
        names = ", ".join(stations[i].station for i in again[:8])
        more = f" and {len(again) - 8} more" if len(again) > 8 else ""
        text = (
            f"station {names}{more}: the very readings of an earlier station. Copies count as "
            "measurements of their own, and uncertainties come out too small. Remove them."
        )
        return [Finding(id="repeated-readings", text=text)]

    def undetermined(self) -> list[Finding]:
        """Directions that nothing determines."""
        found = []
        for entry in self.free:
            names = " and ".join(TRIADS[t] for t in entry.triads)
            found.append(Finding(id=entry.id, text=f"{names}: {described(entry.id)}."))
        return found

    def model(self) -> list[Finding]:
        """What the chosen model cannot say."""
        found = []
        bent = self.options.nonlinearity or {}
        ignored = [
            name
            for name, triad in zip(TRIADS, self.result.problem.triads, strict=False)
            if name not in bent
            and triad.model.kind == "factors"
            and getattr(self.profile, name).nonlinearity
        ]
        if ignored:
            text = (
                f"nonlinearity of the {' and '.join(ignored)} is not fitted: the model of factors "
            )
            text += "has no such terms. Use --model polynomial for it."
            found.append(Finding(id="nonlinearity-ignored", text=text))
        if is_relative(self.readings):
            text = "field strength is known at no station: the magnetometer is calibrated to field = 1. "
            found.append(Finding(id="field-unknown", text=text + "Give ref_field_nt to have nT."))
        if self.options.parameters < 12:
            lost = "any misalignment" if self.options.parameters == 6 else "mounting rotation"
            text = (
                f"{self.options.parameters} parameters: {lost} of the sensors in the tool is taken as "
                "none, and no uncertainty here includes it. Use --parameters 12 to fit it."
            )
            found.append(Finding(id="restricted", text=text))
        return found

    def prior(self) -> list[Finding]:
        """What rests on the prior alone, and whether run and prior agree."""
        knowledge = self.options.prior
        if knowledge is None:
            return []
        bare = without_prior(self.result)
        named = free_directions(bare.problem, bare.state, bare.analysis.determined)
        free = [entry.id for entry in self.free]
        only = [e.id.removeprefix("weak-") for e in named if e.id not in free]
        if not only:
            return self._conflict(knowledge.source)
        text = (
            f"this run does not determine {', '.join(dict.fromkeys(only))}: there values and uncertainties "
            f"rest on the prior ({knowledge.source})."
        )
        return [Finding(id="prior-only", text=text), *self._conflict(knowledge.source)]

    def _conflict(self, source: str) -> list[Finding]:
        """A departure from the prior that is unlikely."""
        square, tested = departures(self.result)
        if not conflicting(square, tested)[0]:
            return []
        ratio = np.sqrt(square[0] / tested[0])
        text = (
            f"the run departs from the prior ({source}) by {ratio:.1f} times what both allow: the tool has "
            "changed, or the prior is too narrow. Leave --prior out, or widen it."
        )
        return [Finding(id="prior-conflict", text=text)]

    def reshoot(self, row: StationRow) -> Finding:
        """A station to take again, with the reason."""
        worst = row.worst or "gravity"
        _, unit = shown_in(worst, is_relative(self.readings))
        gap = "" if unit == "°" else " "
        value = row.errors.get(worst, float("nan"))
        size = f"{row.deviation:.1f}" if row.deviation < LARGEST else f"more than {LARGEST:.0f}"
        alone, moves = (d.get(worst, 0.0) for d in (row.errors_left_out, row.influence))
        text = (
            f"station {row.station}: residual {size}σ, most in {worst} "
            f"({value:+.3g}{gap}{unit}; {alone:+.3g}{gap}{unit} if left out of the fit, which it moves "
            f"by up to {moves:.2g}{gap}{unit}): {REASONS[worst]} Re-shoot it, or --exclude {row.station}"
        )
        return Finding(id="reshoot", text=text, station=row.station)

    def distrusted(self, stations: list[StationRow]) -> list[Finding]:
        """Stations that a robust fit all but left out."""
        low = [stations[index] for index in np.flatnonzero(distrusted(self.result)[0])]
        if not low:
            return []
        each = ", ".join(f"{row.station} ({row.weight:.1g})" for row in low[:8])
        more = f" and {len(low) - 8} more" if len(low) > 8 else ""
        text = f"robust fit: of little weight are station {each}{more}. Look at what they have in common."
        return [Finding(id="distrusted", text=text)]
