"""What the reader of a calibration should know, in plain words, each with its remedy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mwdcal.calibration.automatic.courses import Terms, misfit_size, terms_beyond, untested
from mwdcal.calibration.diagnosis.structure import described as seen_as
from mwdcal.calibration.diagnosis.structure import effects, suspected
from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.prior import Knowledge
from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.calibration.record import Finding, StationRow
from mwdcal.calibration.residuals import REASONS, chi_chance, shown_in, tail
from mwdcal.calibration.results import common_source
from mwdcal.calibration.soaks import HIGHEST
from mwdcal.estimation.minimisers import closed_form
from mwdcal.estimation.problem import Prior
from mwdcal.estimation.rank import Free, free_directions
from mwdcal.estimation.solvers import Determined
from mwdcal.estimation.uncertainty import effective_freedom
from mwdcal.geometry.vectors import Array, Bools, Ints, eigen
from mwdcal.sensor.profile import Profile

SUSPECT = 3.0
"""Residuals of a robust fit that exceed the declared noise this many times are reported."""
ENOUGH = 12.0
"""Degrees of freedom from which residuals far below the declared noise are no chance."""
UNLIKELY = 1e-3
"""Chance of so large residuals, or of so large a departure from the prior, below which it is reported."""
LARGEST = 37.0
"""Deviations are not told apart beyond this: a normal variable's chance is then below 1e-300."""
UNUSED = "unused-columns"
MOST_COLUMNS = 20
"""Most columns that the finding names."""
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


def unused_columns(columns: Sequence[str]) -> list[Finding]:
    """Columns of a file that are not used, each with what it resembles."""
    if not columns:
        return []
    more = f" and {len(columns) - MOST_COLUMNS} more" if len(columns) > MOST_COLUMNS else ""
    text = f"columns not used: {', '.join(columns[:MOST_COLUMNS])}{more}."
    return [Finding(id=UNUSED, text=text)]


def misfit_chances(result: Fit) -> Array:
    """Chance (B, t) of residuals as large as each triad's, if noise and stand are as declared.

    NaN where noise was estimated, nothing is redundant, or station weights hide what is large.
    """
    problem, analysis = result.problem, result.analysis
    freedom = analysis.freedom
    if not closed_form.applies(problem) and analysis.influence is None:
        freedom = effective_freedom(problem, result.state, analysis)
    untested = np.isfinite(result.noise) | unchecked(result) | robust(result)[:, None]
    freedom = np.where(untested, 1.0, freedom)
    return np.where(untested, np.nan, chi_chance(analysis.variance_factor * freedom, freedom))


def robust(result: Fit) -> Bools:
    """Fits (B,) with station weights."""
    return np.asarray((result.trust != 1).any(-1))


def excessive(result: Fit, chances: Array) -> Bools:
    """Triads (B, t) whose residuals noise and stand do not explain, by `misfit_chances`."""
    weighed = robust(result)[:, None] & np.isnan(result.noise) & ~unchecked(result)
    large = weighed & (result.analysis.variance_factor > SUSPECT**2)
    return np.asarray(large | (np.nan_to_num(chances, nan=1.0) < UNLIKELY))


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
            *self.structure(),
            *self.scatter(),
            *self.repeated(stations),
            *self.temperature(),
            *self.undetermined(),
            *self.prior(),
            *self.model(),
            *unused_columns(self.readings.unused),
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
        for index in np.flatnonzero(excessive(self.result, self.chances)[0]):
            excess = float(self.result.analysis.variance_factor[0, index])
            chance = self.chances[0, index]
            rare = "" if np.isnan(chance) else f" (chance in noise {chance:.0e})"
            text = (
                f"{TRIADS[index]}: residuals are {excess**0.5:.2f} times the declared noise{rare}: "
                "the noise figure, a reference, or the model is wrong. Uncertainties are "
                "scaled up accordingly."
            )
            found.append(Finding(id=f"{TRIADS[index]}-residuals", text=text))
        bare = [TRIADS[index] for index in np.flatnonzero(unchecked(self.result)[0])]
        if bare:
            text = f"{' and '.join(bare)}: no redundancy, so nothing in this run checks the fit. Add stations."
            found.append(Finding(id="no-redundancy", text=text))
        return found

    @cached_property
    def chances(self) -> Array:
        """Chance (1, t) of residuals as large as each triad's."""
        return misfit_chances(self.result)

    def structure(self) -> list[Finding]:
        """What the residuals look like, where they are more than noise."""
        if not suspected(self.result, self.chances)[0]:
            return []
        unit = shown_in("field", self.readings.relative)[1]
        return [
            Finding(id=f"looks-like-{effect.name}", text=seen_as(effect, unit))
            for effect in effects(self.result)
        ]

    def temperature(self) -> list[Finding]:
        """What the temperature orders leave out, and courses that nothing tests."""
        terms = terms_beyond(self.result)
        found = [self._misfit(int(t), terms) for t in np.flatnonzero(terms.misfit[0])]
        bare = np.flatnonzero(untested(self.result)[0])
        if bare.size:
            names = " and ".join(TRIADS[t] for t in bare)
            order = max(self.result.problem.triads[t].model.basis.order for t in bare)
            unsaid = (
                "no uncertainty here includes a curvature"
                if order == 1
                else "the uncertainty takes the next power to fall off as the last one did"
            )
            text = (
                f"{names}: {order + 1} temperatures are as many as a course of order {order} takes, so "
                f"nothing tests it between them, and {unsaid}. Add a temperature between them."
            )
            found.append(Finding(id="temperature-untested", text=text))
        return found

    def _misfit(self, index: int, terms: Terms) -> Finding:
        """A course with temperature that the order of a triad does not follow."""
        order = self.result.problem.triads[index].model.basis.order
        there = np.flatnonzero(terms.present[0, index]) + 1
        share = float(misfit_size(self.result, terms)[0, index])
        observable = ("gravity", "field")[index]
        strength = float(np.mean(self.result.problem.constant(self.result.state, observable)))
        scale, unit = shown_in(observable, self.readings.relative)
        if order < HIGHEST and there.min() <= HIGHEST:
            cause = f"powers of temperature above order {order} are there"
            remedy = f"Use --order auto, or --order {min(int(there.max()), HIGHEST)}"
            if self.options.method == "swarm":
                remedy = "Use another --method: swarm has no temperature terms"
        else:
            cause = "readings differ from one temperature to the next as no course of order 3 does"
            remedy = (
                "Let the tool come to rest at each temperature and look for hysteresis or a reference "
                "that moved; more temperatures make the mean better"
            )
        text = (
            f"{TRIADS[index]}: {cause}, beyond what noise explains: {share * strength * scale:.2g} {unit} "
            f"rms per axis over the range ({np.degrees(share):.2g}° across the field). The "
            f"uncertainties here include it. {remedy}."
        )
        return Finding(id=f"{TRIADS[index]}-temperature-misfit", text=text)

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
        if self.readings.relative:
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
        return [*self._shared(knowledge), *self._resting(knowledge)]

    def _shared(self, knowledge: Knowledge) -> list[Finding]:
        """Errors of the stand that both the prior and this run have declared."""
        ours = {
            common_source(c.name) for c in self.result.problem.evidence.constants if not c.unknown
        }
        both = [name for name in knowledge.common if name in ours]
        if not both:
            return []
        text = (
            f"the prior ({knowledge.source}) and this run both have {', '.join(both)} in their uncertainty, and "
            "count as independent there. On the same stand it is one error: what rests on it is then "
            "stated up to 1.4 times too small."
        )
        return [Finding(id="prior-shared", text=text)]

    def _resting(self, knowledge: Knowledge) -> list[Finding]:
        """What rests on the prior alone, and a departure from it."""
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
        _, unit = shown_in(worst, self.readings.relative)
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
