"""Errors of a fit where references are known: per observable, per station, per triad."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from math import erfc, gamma

import numpy as np

from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.calibration.record import ErrorRow, Measures, StationRow, figures, stated
from mwdcal.estimation.batch import take
from mwdcal.estimation.minimisers import closed_form, closed_form_drift
from mwdcal.estimation.problem import ANGLES, STAND_ERRORS
from mwdcal.estimation.uncertainty import (
    Analysis,
    by_triad,
    fisher_tail,
    left_out_variances,
    normal_quantile,
    per_freedom,
    station_misfit,
    whole_covariance,
    without_station,
)
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import Array, Bools, Ints, distinct

SHOWN = ("gravity", "inclination", "toolface", "azimuth", "field", "dip")
RESHOOT = 0.01
"""A station is marked when one in a hundred runs would have any station as bad as it."""
LEAST_ACROSS = 1e-9
"""An attitude is exactly vertical below this sine of its inclination."""
PROBES = 200
"""Stations at which the influence of each is looked at: no more, however long the run."""
CHANGES_AT_ONCE = 2_000_000
"""Changes of an observable, at one station by another, that are worked out at once: 16 MB."""
REASONS = {
    "gravity": "moved before it settled?",
    "inclination": "stand inclination misread?",
    "toolface": "stand toolface misread?",
    "azimuth": "stand azimuth misread, or iron nearby?",
    "field": "iron or current near the stand?",
    "dip": "iron near the stand, or the tool moved?",
}


def rms(values: Array) -> Array:
    """Root mean square (...) of what is not NaN of values (..., n); NaN where nothing is left."""
    each = np.full(values.shape[:-1], np.nan)
    for rows, kept in _filled(values):
        if kept.shape[-1]:
            each.flat[rows] = np.sqrt(np.mean(kept**2, -1))
    return each


def _filled(values: Array) -> Iterator[tuple[Ints, Array]]:
    """Values that are not NaN (..., n), as rows (b, k) that are filled at the same places, and their numbers (b,)."""
    rows = values.reshape(-1, values.shape[-1])
    blank = np.isnan(rows)
    patterns, number = blank[:1], np.zeros(len(rows), int)
    if (blank != patterns).any():
        patterns, number = np.unique(blank, axis=0, return_inverse=True)
    for place, pattern in enumerate(patterns):
        some = np.flatnonzero(number == place)
        yield some, np.compress(~pattern, rows[some], -1)


def shown_in(name: str, relative: bool = False) -> tuple[float, str]:
    """Factor and unit in which an observable's errors are shown: mg, nT, °, or per mille."""
    if name == "field" and relative:
        return 1e3, "‰ of the field"
    if name == "gravity":
        return 1e3, "mg"
    return (1.0, "nT") if name == "field" else (float(np.degrees(1)), "°")


def error_weight(name: str, inclination: Array, g: Array) -> Array:
    """What an error of an observable counts at reference inclinations (…, n), radians.

    Definition: sin(inclination) for toolface and azimuth, 1 for all else; where the inclination is
    NaN, that of g (…, n, 3) counts. Singular: NaN exactly at vertical, where toolface and azimuth
    do not exist.
    """
    if name not in ("toolface", "azimuth"):
        return np.ones(g.shape[:-1])
    measured = OBSERVABLES["inclination"].value(g, g)
    across = np.sin(np.where(np.isnan(inclination), measured, inclination))
    return np.where(across < LEAST_ACROSS, np.nan, across)


def departure(name: str, g: Array, b: Array, known: Mapping[str, Array]) -> Array:
    """Error (…, n) of an observable of two vectors against its reference, radians, g or nT.

    Definition: the difference times its `error_weight`, with the references `known` by name.
    Singular: NaN where there is no reference, and for toolface and azimuth exactly at vertical.
    """
    error = OBSERVABLES[name].difference(OBSERVABLES[name].value(g, b), known[name])
    return error * error_weight(name, known.get("inclination", np.full(error.shape, np.nan)), g)


def nominal(readings: Readings) -> tuple[Array, Array]:
    """Vectors (..., n, 3) that the tool reads uncalibrated; a field of unknown strength has a mean of one."""
    raw = readings.magnetometer
    if raw is None:
        return readings.accelerometer, np.full_like(readings.accelerometer, np.nan)
    if readings.relative:
        raw = raw / np.linalg.norm(raw, axis=-1).mean(-1)[..., None, None]
    return readings.accelerometer, raw


def vector_measures(triad: str, when: str, actual: Array, target: Array) -> list[list[Measures]]:
    """Moradi's measures of the vector error (B, n, 3), as a share of the target; none of one station."""
    error = np.linalg.norm(actual - target, axis=-1) / np.linalg.norm(target, axis=-1)
    each: list[list[Measures]] = [[] for _ in error]
    for rows, kept in _filled(error):
        if kept.shape[-1] < 2:
            continue
        square = np.mean(kept**2, -1)
        sizes = kept.mean(-1), kept.std(-1, ddof=1), square, square**0.5
        names = ("mean", "std", "mse", "rmse")
        for row, values in zip(rows.tolist(), figures(np.stack(sizes, -1)), strict=True):
            one = dict(zip(names, values, strict=True))
            each[row].append(Measures(triad=triad, when=when, **one))
    return each


@dataclass(frozen=True)
class Residuals:
    """The errors of fitted runs, before and after, with what was to be expected.

    Dictionaries have an entry for each observable, arrays in them are (B, n), vectors (B, n, 3).
    """

    readings: Readings
    fit: Fit

    @cached_property
    def after(self) -> tuple[Array, Array]:
        """Corrected vectors; the field is NaN without magnetometer."""
        return self.fit.problem.fields(self.fit.state)

    @cached_property
    def undrifted(self) -> tuple[Array, Array]:
        """Corrected vectors less the drifts within the run that are part of the fit."""
        problem, state = self.fit.problem, self.fit.state
        if not problem.walks:
            return self.after
        drift = (problem.walk_columns(state) @ state.constants[:, None, :, None])[..., 0]
        steady = [*self.after]
        for index, (triad, where) in enumerate(zip(problem.triads, problem.slices(), strict=True)):
            slope = triad.model.slope(state.params[:, where], triad.raw, problem.temperature)
            raw = drift[..., 3 * index : 3 * index + 3] * triad.sd
            steady[index] = steady[index] + np.einsum("bnij,bnj->bni", slope, raw)
        return steady[0], steady[1]

    @cached_property
    def targets(self) -> tuple[Array, Array]:
        """Vectors that a perfect tool would read at the fitted attitudes."""
        g, b = self.fit.problem.targets(self.fit.state)
        return g, b

    @cached_property
    def known(self) -> dict[str, Array]:
        """References: given, or the estimated constant; NaN where unknown.

        Angles of a stand whose common errors are unknowns of the fit: as they are without them, that
        is of the fitted attitudes; at vertical, where two angles do not exist, as given.
        """
        problem, state = self.fit.problem, self.fit.state
        evidence = problem.evidence
        known = {name: np.asarray(evidence.known[name]) for name in SHOWN}
        for name in {"gravity", "field", "dip"}.difference(evidence.absent):
            known[name] = problem.constant(state, name)
        if any(constant.name in STAND_ERRORS for constant in evidence.constants):
            north, _, down = np.moveaxis(state.attitude, -1, 0)
            for name in ANGLES:
                fitted = OBSERVABLES[name].value(down, north)
                known[name] = np.where(np.isnan(fitted + known[name]), known[name], fitted)
        return known

    @cached_property
    def weights(self) -> dict[str, Array]:
        """Weights of errors after the fit, zero where an observable does not exist."""
        inclination, g = self.known["inclination"], self.after[0]
        return {name: np.nan_to_num(error_weight(name, inclination, g)) for name in SHOWN}

    @cached_property
    def judged(self) -> dict[str, Bools]:
        """Stations whose error is known, of observables for which there is such a station in some run."""
        usable = SHOWN if len(self.fit.problem.triads) > 1 else SHOWN[:3]
        judged = {n: ~np.isnan(self.known[n]) & (self.weights[n] > 0) for n in usable}
        return {name: stations for name, stations in judged.items() if stations.any()}

    def errors(self, fields: tuple[Array, Array]) -> dict[str, Array]:
        """The `departure` of both vectors from the references of the run."""
        return {name: departure(name, *fields, self.known) for name in self.judged}

    @cached_property
    def errors_after(self) -> dict[str, Array]:
        """The `errors` that the fit leaves."""
        return self.errors(self.after)

    @cached_property
    def errors_before(self) -> dict[str, Array]:
        """The `errors` of the readings as they came."""
        return self.errors(nominal(self.readings))

    @cached_property
    def expected(self) -> dict[str, Array]:
        """Standard deviations of `errors` after the fit that noise and stand alone would give.

        NaN if the fit did not use an observable. Declared noise is not scaled by what the residuals
        come to: the two are compared. A reference keeps the error of its setting of the stand, of which
        the residual lacks what the fit estimates, X_s ŝ: with Cov(ŝ) = I - V_ss it adds
        X V_·s X_sᵀ + X_s V_s· Xᵀ + X_s (I - V_ss) X_sᵀ.
        """
        fit, problem, expected = self.fit, self.fit.problem, {}
        linear, trust = problem.linear(fit.state), fit.trust[..., None, None]
        total = np.eye(linear.private.shape[-2]) + linear.private @ linear.private.mT
        # Covariance (B, n, m, m) of the whitened misfit, in units of the noise whatever the weights.
        misfit = total @ _judged(fit).spread @ total
        if count := fit.state.settings.shape[-1]:
            design = linear.design
            settings = design[..., -count:]
            if fit.analysis.influence is not None:
                params = design[..., : linear.size]
                left = settings - params @ fit.analysis.of_settings[:, None]
                misfit = misfit + left @ left.mT
            else:
                whole = whole_covariance(linear, fit.analysis.determined)[:, None, :, -count:]
                scatter = np.eye(count) - whole[..., -count:, :]
                part = (trust * design @ whole + settings @ scatter / 2) @ settings.mT
                misfit = misfit + (part + part.mT) / trust
        noise = [triad.sd * np.sqrt(fit.trust)[..., None] for triad in problem.triads]
        slopes = [
            triad.model.slope(fit.state.params[:, where], triad.raw, problem.temperature)
            for triad, where in zip(problem.triads, problem.slices(), strict=True)
        ]
        for name in self.judged:
            parts = np.split(OBSERVABLES[name].gradient(*self.targets), [3], axis=-1)
            rows = [
                np.einsum("bni,bnij->bnj", part, slope) * sd
                for part, slope, sd in zip(parts, slopes, noise, strict=False)
            ]
            row = np.nan_to_num(np.concatenate(rows, -1) * self.weights[name][..., None])
            variance = np.einsum("bni,bnij,bnj->bn", row, misfit, row)
            unused = name in problem.evidence.absent
            expected[name] = np.where(unused, np.nan, np.sqrt(np.maximum(variance, 0)))
        return expected

    @cached_property
    def _moves(self) -> list[Array]:
        """Change (B, n, p) of each triad's parameters when a station is left out."""
        fit = self.fit
        moved = without_station(fit.problem, fit.state, fit.analysis)
        return [moved[..., where] for where in fit.problem.slices()]

    @cached_property
    def left_out(self) -> tuple[Array, Array]:
        """Corrected vectors of each station, by the fit without it."""
        problem, state = self.fit.problem, self.fit.state
        shape, fields = problem.temperature.shape, []
        each, warmth = np.repeat(np.arange(shape[0]), shape[1]), problem.temperature.reshape(-1, 1)
        for triad, where, moved in zip(problem.triads, problem.slices(), self._moves, strict=True):
            params = (state.params[:, None, where] + moved).reshape(each.size, -1)
            model = take(triad.model, each)
            fields.append(model.fields(params, triad.raw.reshape(-1, 1, 3), warmth))
        g, *others = (field.reshape(*shape, 3) for field in fields)
        return g, others[0] if others else np.full_like(g, np.nan)

    @cached_property
    def influence(self) -> dict[str, Array]:
        """Largest change that each station makes to an observable, at stations of the run."""
        some = distinct(np.linspace(0, self.readings.count - 1, PROBES).astype(int))
        problem, params, influence = self.fit.problem, self.fit.state.params, {}
        rows = [
            t.model.jacobian(params[:, where], t.raw[:, some], problem.temperature[:, some])
            for t, where in zip(problem.triads, problem.slices(), strict=True)
        ]
        size = max(1, CHANGES_AT_ONCE // (some.size * self.readings.count))
        for name in self.judged:
            gradient = np.nan_to_num(OBSERVABLES[name].gradient(*self.after)[:, some])
            triples = zip(np.split(gradient, [3], axis=-1), rows, self._moves, strict=False)
            pairs = [(np.einsum("bni,bnip->bnp", part, row), moved) for part, row, moved in triples]
            weights, parts = self.weights[name][:, some, None], []
            for first in range(0, len(params), size):
                runs = slice(first, first + size)
                change = np.sum([row[runs] @ moved[runs].mT for row, moved in pairs], 0)
                parts.append(np.abs(change * weights[runs]).max(1))
            influence[name] = np.concatenate(parts)
        return influence

    @cached_property
    def _chances(self) -> tuple[Bools, Array]:
        """Stations to take again, and the deviation of each."""
        chance = chances(self.fit)
        return stations_to_remeasure(chance), normal_quantile(np.clip(chance, 1e-300, 1.0))

    @cached_property
    def _angles(self) -> Array:
        """Corrected `ANGLES` (B, n, 3), degrees."""
        return np.degrees([OBSERVABLES[name].value(*self.after) for name in ANGLES]).transpose(
            1, 2, 0
        )

    @cached_property
    def _shown(self) -> list[Array]:
        """Errors after, before and left out, and influence, each (B, n, k), in the units they are shown in."""
        kinds = self.errors_after, self.errors_before, self.errors(self.left_out), self.influence
        factors = [shown_in(name, self.readings.relative)[0] for name in self.judged]
        missing = np.stack([~each.any(-1, keepdims=True) for each in self.judged.values()], -1)
        return [
            np.where(missing, np.nan, np.stack([*each.values()], -1) * factors) for each in kinds
        ]

    def stations(self, place: int, run: Readings) -> list[StationRow]:
        """Errors of every station of one `run`, with the ones to take again."""
        again, deviation = (each[place] for each in self._chances)
        names = [*self.judged]
        rows = zip(
            run.labels,
            run.digest or [""] * run.count,
            figures(np.concatenate([getattr(run, name) for name in run.triads], -1)),
            [None] * run.count if run.temperature is None else figures(run.temperature),
            figures(self._angles[place]),
            *(_named(names, each[place]) for each in self._shown),
            figures(self.fit.trust[place]),
            figures(deviation),
            again.tolist(),
            strict=True,
        )
        return [
            StationRow(
                station=label,
                digest=digest,
                readings=readings,
                temperature_c=warmth,
                **{f"{name}_deg": stated(angle) for name, angle in zip(ANGLES, angles, strict=True)},
                errors=errors,
                errors_before=before,
                errors_left_out=left_out,
                influence=influence,
                weight=weight,
                deviation=far,
                reshoot=bad,
                worst=self._worst(place, number, errors) if bad else None,
            )
            for number, (
                label, digest, readings, warmth, angles, errors, before, left_out, influence, weight, far, bad,
            ) in enumerate(rows)
        ]  # fmt: skip

    def _worst(self, place: int, station: int, errors: Mapping[str, float]) -> str | None:
        """The observable whose error is largest for what was to be expected."""

        def ratio(name: str) -> float:
            expected = np.nan_to_num(self.expected[name][place, station], nan=np.inf)
            return float(abs(self.errors_after[name][place, station]) / max(expected, 1e-30))

        return max(errors, key=ratio, default=None)


def _named(names: list[str], errors: Array) -> list[dict[str, float]]:
    """Errors (n, k) by name, station by station, those that are not NaN."""
    rows = figures(errors)
    if not np.isnan(errors).any():
        return [dict(zip(names, row, strict=True)) for row in rows]
    return [{n: e for n, e in zip(names, row, strict=True) if e == e} for row in rows]


def error_rows(residuals: Residuals) -> list[list[ErrorRow]]:
    """Root mean square errors of each run before and after, and what was to be expected after.

    Corrected readings keep a drift within the run that is part of the fit: it is expected besides noise and stand.
    """
    rows: list[list[ErrorRow]] = [[] for _ in residuals.fit.status]
    kinds = residuals.errors_before, residuals.errors_after, residuals.expected
    if residuals.fit.problem.walks:
        steady = residuals.errors(residuals.undrifted)
        kinds = *kinds[:2], {n: np.hypot(e, kinds[1][n] - steady[n]) for n, e in kinds[2].items()}
    for name, judged in residuals.judged.items():
        factor, unit = shown_in(name, residuals.readings.relative)
        sizes = (rms(np.where(judged, each[name], np.nan)) * factor for each in kinds)
        counts = np.count_nonzero(judged, -1).tolist()
        for row, count, before, after, expected in zip(
            rows, counts, *map(figures, sizes), strict=True
        ):
            if count:
                row.append(
                    ErrorRow(
                        observable=name,
                        unit=unit,
                        stations=count,
                        before=before,
                        after=after,
                        expected=stated(expected),
                    )
                )
    return rows


def measure_rows(residuals: Residuals) -> list[list[Measures]]:
    """Moradi's measures of the vector error of each run, where reference vectors are whole."""
    rows: list[list[Measures]] = [[] for _ in residuals.fit.status]
    for index, name in enumerate(TRIADS[: len(residuals.fit.problem.triads)]):
        needed = ("inclination", "toolface", "azimuth")[: 2 + index]
        whole = np.all([~np.isnan(residuals.known[n]) for n in needed], axis=0)
        target = np.where(whole[..., None], residuals.targets[index], np.nan)
        for when, fields in (("before", nominal(residuals.readings)), ("after", residuals.after)):
            for row, more in zip(
                rows, vector_measures(name, when, fields[index], target), strict=True
            ):
                row += more
    return rows


def _judged(fit: Fit) -> Analysis:
    """The analysis by which stations are judged: in a robust fit with their errors whole.

    A weight w takes a station's pull on the fit, not its noise: with V = C⁻¹ the residual V ρ has
    the covariance V + (1 - 2 w) V X Cov XᵀV, from V - … at w = 1 to V + … where it is left out.
    """
    trust, analysis = fit.trust[..., None, None], fit.analysis
    if (trust == 1).all():
        return analysis
    weight = fit.problem.linear(fit.state).weight
    pulled = (weight - analysis.spread) / trust
    include = fit.problem.evidence.include[..., None, None]
    spread = (weight + (1 - 2 * trust) * pulled) * include
    residual = analysis.residual / np.sqrt(fit.trust[..., None])
    return replace(analysis, residual=residual, spread=spread)


def chances(fit: Fit) -> Array:
    """How likely a misfit as large as each station's (B, n) is, if only noise is in it."""
    return fit.problem.once("chances", fit.state, lambda _: _chances(fit))


def _chances(fit: Fit) -> Array:
    by_left_out = is_by_left_out(fit)
    if by_left_out.all():
        chance = left_out_chances(fit, *np.indices(fit.trust.shape).reshape(2, -1))
        return chance.reshape(fit.trust.shape)
    square, freedom = station_misfit(_judged(fit))
    others = np.maximum(freedom.sum(-1, keepdims=True) - freedom, 1)
    variance = np.maximum((square.sum(-1, keepdims=True) - square) / others, 1e-30)
    declared = np.isnan(fit.noise).all(-1, keepdims=True)
    chance = tail(square / np.where(declared, np.maximum(variance, 1.0), variance), freedom)
    if by_left_out.any():
        some = np.flatnonzero(by_left_out)
        chance[some] = _chances(take(fit, some))
    return chance


def is_by_left_out(fit: Fit) -> Bools:
    """Fits (B,) whose stations are judged by the noise that the others show: it is estimated, and all count alike."""
    estimated = np.isfinite(fit.noise).any(-1) & (fit.trust == 1).all(-1)
    return np.asarray(estimated & (fit.analysis.influence is None))


def left_out_chances(fit: Fit, tool: Ints, station: Ints) -> Array:
    """Chances (k,) of some stations of some tools, by each triad's residuals and its noise without the station.

    By Fisher's F; the least of the triads', times their number. A gross error of a station is in the noise that is
    estimated with it, and hides there: with few stations no residual can exceed that three times.

    Reference: R. D. Cook and S. Weisberg, Residuals and Influence in Regression (1982), section 2.2: externally
    studentised residuals.
    """
    tests = left_out_tests(fit, tool, station)
    if not closed_form.applies(fit.problem):
        exact = _left_out_variances(fit, tool, station)
        others = zip(*(each.mT for each in exact), strict=True)
        tests = [(*one[:2], *other) for one, other in zip(tests, others, strict=True)]
    return chances_of_tests(tests, fit.noise[tool])


def _left_out_variances(fit: Fit, tool: Ints, station: Ints) -> tuple[Array, Array]:
    drifted = closed_form_drift.applies(fit.problem)
    variances = closed_form_drift.left_out_variances if drifted else left_out_variances
    return variances(fit.problem, fit.state, fit.analysis, tool, station)


def chances_of_tests(tests: list[tuple[Array, ...]], noise: Array) -> Array:
    """The same (k,) of the `left_out_tests` of each triad; `noise` (k, t) is NaN where it is declared."""
    square, freedom, variance, rest = (np.stack(each) for each in zip(*tests, strict=True))
    declared, tested = np.isnan(noise.mT), (freedom > 0) & (rest >= 1)
    ratio = square / np.maximum(np.where(tested, freedom * variance, 1.0), 1e-300)
    by_others = fisher_tail(np.maximum(freedom, 1.0), np.maximum(rest, 1.0), ratio)
    chance = np.where(tested, by_others, 1.0)
    if declared.any():
        by_noise = tail(square / np.maximum(np.nan_to_num(variance), 1.0), freedom)
        chance = np.where(declared, by_noise, chance)
    return np.asarray(np.minimum(chance.min(0) * len(tests), 1.0))


def left_out_tests(fit: Fit, tool: Ints, station: Ints) -> list[tuple[Array, ...]]:
    """χ² of some stations in each triad, s² in the fit without them, and the degrees of freedom of both, (k,) each.

    The covariance of a triad's residuals is taken as a projection, which it is where references are exact: the sum
    of squares falls by the χ² of the station.
    """
    analysis, tests = fit.analysis, list[tuple[Array, ...]]()
    for index, each in enumerate(by_triad(analysis)):
        square, tested = (part[tool, station] for part in station_misfit(each))
        freedom = analysis.freedom[tool, index]
        squares = np.nan_to_num(analysis.variance_factor[tool, index]) * freedom - square
        rest = freedom - tested
        tests.append((square, tested, np.maximum(per_freedom(squares, rest), 0.0), rest))
    return tests


def stations_to_remeasure(chance: Array) -> Bools:
    """Stations to take again, by the chances (..., n) of all."""
    return np.asarray(chance < RESHOOT / chance.shape[-1])


def tail(square: Array, freedom: Array) -> Array:
    """Chance of a larger χ² with whole degrees of freedom, 1 where there are none.

    In closed form: SciPy's takes as long to load as a fleet of some thousand tools to fit.

    >>> tail(np.array([3.841459, 5.991465]), np.array([1, 2])).round(6)
    array([0.05, 0.05])
    """
    chance = np.ones(square.shape)
    for degrees in distinct(freedom[freedom > 0]):
        some = freedom == degrees
        half = np.clip(square[some] / 2, 0, 700)
        power = 0.5 if degrees % 2 else 1.0
        small = np.exp(-half)
        total = np.vectorize(erfc)(np.sqrt(half)) if degrees % 2 else small
        while power < degrees / 2:
            total, power = total + half**power * small / gamma(power + 1), power + 1
        chance[some] = total
    return chance


def chi_chance(square: Array, freedom: Array, small: bool = False) -> Array:
    """Chance of a larger χ², or a smaller one, with any degrees of freedom, to a tenth of it from four on.

    Reference: E. B. Wilson and M. M. Hilferty, Proc. Natl. Acad. Sci. 17, 684 (1931).

    >>> chi_chance(np.array([18.467, 149.449]), np.array([4.0, 100.0])).round(4)
    array([0.0011, 0.001 ])
    """
    spread = 2 / (9 * np.maximum(freedom, 1e-9))
    normal = (np.cbrt(square / np.maximum(freedom, 1e-9)) - 1 + spread) / np.sqrt(2 * spread)
    return np.asarray(0.5 * np.vectorize(erfc, otypes=[float])(-normal if small else normal))
