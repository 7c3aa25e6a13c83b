"""`calibrate`: readings and profile in, a `Calibration` out, or a refusal with its reason."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from itertools import pairwise

import numpy as np

from mwdcal import __version__
from mwdcal.calibration import (
    FREE_SHARE,
    Calibration,
    Choices,
    Constant,
    Finding,
    StationRow,
    TriadCalibration,
    Undetermined,
    rounded,
)
from mwdcal.checks import check_fit, check_readings
from mwdcal.core.observability import Free, free_directions
from mwdcal.core.problem import STAND
from mwdcal.core.uncertainty import marginal_rank
from mwdcal.core.vectors import Array
from mwdcal.estimate import Fit, fit
from mwdcal.options import Options
from mwdcal.profile import Profile
from mwdcal.readings import TRIADS, Readings
from mwdcal.residuals import REASONS, error_rows, measure_rows, shown_in, station_rows
from mwdcal.stand import check_names, check_separable, stand_errors

SUSPECT = 3.0
"""A fit whose residuals exceed the declared noise this many times is reported."""
IDENTITY = ("serial", "tool", "operator", "lab", "date", "stand", "simulated")


def calibrate(
    readings: Readings,
    profile: Profile,
    options: Options | None = None,
    *,
    profile_sha256: str = "",
    run_sha256: str = "",
    progress: Callable[[str], None] = lambda text: None,
) -> Calibration:
    """Fit the sensor model to a run and state what it is worth.

    Raises `FitError` where the data cannot give a calibration to be trusted.
    """
    options = with_nonlinearity(options or Options(), profile)
    check_readings(readings, options)
    check_names(options.estimate, options.method)
    progress(f"fitting {readings.count} stations, method {options.method}, order {options.order}")
    result = fit(readings, options)
    if options.estimate:
        check_separable(result, options.estimate)
    free = free_directions(result.problem, result.state, result.analysis.determined)
    check_fit(result, free, profile, readings)
    made = _Record(readings, profile, options, result, free)
    return rounded(made.calibration(profile_sha256, run_sha256))


def with_nonlinearity(options: Options, profile: Profile) -> Options:
    """The options with the own-axis terms that the profile declares, unless they say otherwise.

    Only the polynomial model has such terms.
    """
    if options.nonlinearity is not None:
        return options
    found = {}
    for name, order in zip(TRIADS, options.orders, strict=True):
        value = getattr(profile, name).nonlinearity
        if value and options.kind(order) == "polynomial":
            found[name] = value
    return replace(options, nonlinearity=found)


TEXTS = {
    "toolface-zero": "toolface zero is undetermined: no evidence fixes rotation about the tool axis; kept at nominal. "
    "Give ref_toolface_deg at some stations to determine it",
    "rotation-x": "rotation about the tool's x axis is undetermined: no evidence fixes it; kept at nominal. Give "
    "reference inclinations, or roll sets at three or more directions",
    "rotation-y": "rotation about the tool's y axis is undetermined: no evidence fixes it; kept at nominal. Give "
    "reference inclinations, or roll sets at three or more directions",
    "scale": "overall scale is undetermined: no evidence fixes it; kept at nominal. Give a reference strength",
}


def described(name: str) -> str:
    """What a free direction means, and what would determine it."""
    steady, _, power = name.partition("-temperature-")
    course = f" (its course with temperature, power {power})" if power else ""
    return TEXTS.get(steady, steady) + course


@dataclass(frozen=True)
class _Record:
    """The parts of a calibration file, from one fit."""

    readings: Readings
    profile: Profile
    options: Options
    result: Fit
    free: list[Free]

    def calibration(self, profile_sha256: str, run_sha256: str) -> Calibration:
        """The whole record."""
        readings, result, options = self.readings, self.result, self.options
        stations = station_rows(readings, result)
        return Calibration(
            tool={k: str(v) for k, v in readings.metadata.items() if k in IDENTITY},
            profile=self.profile,
            profile_sha256=profile_sha256,
            run=readings.source,
            run_sha256=run_sha256,
            software=f"mwdcal {__version__}",
            method=options.method,
            options=Choices(
                parameters=options.parameters,
                robust=options.robust,
                paper_weights=options.paper_weights,
                prior=options.prior.source if options.prior else None,
            ),
            seed=options.seed if options.method == "swarm" else None,
            time=datetime.now(UTC).isoformat(timespec="seconds"),
            field_unit="relative (field = 1)" if self.relative else "nT",
            stations=readings.count,
            temperature_c=self.temperatures,
            accelerometer=self.triad(0),
            magnetometer=self.triad(1) if readings.magnetometer is not None else None,
            covariance=self.covariance.tolist(),
            free=[d.tolist() for d in self.directions],
            singular_values=result.analysis.determined.values[0].tolist(),
            constants=self.constants(),
            stand=stand_errors(result, float(np.sqrt(self.factors.max()))),
            earth=self.earth(),
            errors=error_rows(readings, result),
            measures=measure_rows(readings, result),
            station_rows=stations,
            findings=self.findings(stations),
        )

    @property
    def temperatures(self) -> tuple[float, float] | None:
        """Coldest and hottest station, °C."""
        temperature = self.readings.temperature
        return None if temperature is None else (float(temperature.min()), float(temperature.max()))

    @property
    def relative(self) -> bool:
        """Whether the magnetometer is calibrated to a field of one."""
        return self.readings.magnetometer is not None and bool(
            np.isnan(self.readings.reference("field")).all()
        )

    @cached_property
    def map(self) -> Array:
        """Linear map from the fit's parameters (p,) to the file's, held ones included."""
        slices, ours = self.result.problem.slices(), self.slices
        whole = np.zeros((ours[-1].stop, slices[-1].stop))
        for triad, mine, where in zip(self.result.problem.triads, ours, slices, strict=True):
            model, one = triad.model.finished(self.profile.reference_temperature_c)
            whole[mine, where] = one.reshape(-1, model.size, triad.model.size)[0]
        return whole

    @cached_property
    def slices(self) -> list[slice]:
        """Where each triad's parameters lie in the file."""
        reference = self.profile.reference_temperature_c
        sizes = [t.model.finished(reference)[0].size for t in self.result.problem.triads]
        ends = np.cumsum([0, *sizes])
        return [slice(int(a), int(b)) for a, b in pairwise(ends)]

    @cached_property
    def factors(self) -> Array:
        """What scales each triad's variances: s², or 1 where there is no redundancy."""
        analysis = self.result.analysis
        usable = analysis.freedom[0] >= 1
        return np.where(usable, np.nan_to_num(analysis.variance_factor[0], nan=1.0), 1.0)

    @cached_property
    def covariance(self) -> Array:
        """Covariance (p, p) of the file's parameters, scaled by s²."""
        sizes = [t.model.size for t in self.result.problem.triads]
        spread = np.sqrt(np.repeat(self.factors, sizes))
        scaled = self.result.analysis.covariance[0] * np.outer(spread, spread)
        return np.asarray(self.map @ scaled @ self.map.transpose())

    @cached_property
    def directions(self) -> list[Array]:
        """Free directions (p,) in the file's parameters, turning or stretching by one."""
        return [self.map @ entry.direction for entry in self.free]

    def earth(self) -> dict[str, float]:
        """Mean gravity, field and dip of the run: given or estimated."""
        state, problem = self.result.state, self.result.problem
        found = {"gravity_g": float(problem.constant(state, "gravity").mean())}
        if len(problem.triads) > 1:
            found["field"] = float(problem.constant(state, "field").mean())
            found["dip_deg"] = float(np.degrees(problem.constant(state, "dip").mean()))
        return found

    def constants(self) -> list[Constant]:
        """Estimated constants of the run with their uncertainty."""
        found = []
        scale = float(np.sqrt(self.factors.max()))
        for index, constant in enumerate(self.result.problem.evidence.constants):
            lone = constant.name == "dip" and len(self.result.problem.triads) == 1
            if lone or constant.name in STAND:
                continue
            degrees = float(np.degrees(1)) if constant.name == "dip" else 1.0
            found.append(
                Constant(
                    name=constant.name if constant.unknown else f"{constant.name} reference error",
                    value=float(self.result.state.constants[0, index]) * degrees,
                    standard_uncertainty=(
                        float(np.sqrt(self.result.analysis.constants[0, index, index]))
                        * scale
                        * degrees
                    ),
                    unit={"dip": "°", "gravity": "g", "field": "nT"}[constant.name],
                )
            )
        return found

    def triad(self, index: int) -> TriadCalibration:
        """The record of one triad."""
        problem, analysis = self.result.problem, self.result.analysis
        triad, where, mine = problem.triads[index], problem.slices()[index], self.slices[index]
        free = [f for f in self.free if index in f.triads]
        noise, declared = self.result.noise[0, index], np.isnan(self.result.noise[0, index])
        curved = TRIADS[index] in (self.options.nonlinearity or {})
        finished, _ = triad.model.finished(self.profile.reference_temperature_c)
        freedom = float(analysis.freedom[0, index])
        return TriadCalibration(
            name=TRIADS[index],
            unit="g" if index == 0 else ("1 (field = 1)" if self.relative else "nT"),
            model=triad.model.kind,
            order=triad.model.basis.order,
            curved=curved,
            centre=(finished.centre.reshape(-1, 3)[0]).tolist() if curved else [0.0, 0.0, 0.0],  # type: ignore[union-attr]
            radius=float(finished.scale.ravel()[0]) if curved else 1.0,  # type: ignore[union-attr]
            parameter_names=list(finished.names),
            parameters=(self.map[mine, where] @ self.result.state.params[0, where]).tolist(),
            standard_uncertainties=self._uncertainties(index),
            rank=int(marginal_rank(analysis.determined, where)[0]),
            size=triad.model.size,
            singular_values=(_own_values(self.result, where)).tolist(),
            undetermined=[
                Undetermined(id=f.id, text=f"{TRIADS[index]}: {described(f.id)}") for f in free
            ],
            noise=float(triad.sd[0].mean() if declared else noise),
            noise_source="declared" if declared else "estimated from the residuals",
            variance_factor=float(analysis.variance_factor[0, index]) if freedom >= 1 else None,
            degrees_of_freedom=freedom,
        )

    def _uncertainties(self, index: int) -> list[float | None]:
        """Standard uncertainties; None for parameters that a free direction moves.

        A parameter is moved if its share of the direction changes the field by more than
        `FREE_SHARE` of its strength, over the stations of the run.
        """
        problem, where = self.result.problem, self.result.problem.slices()[index]
        triad, temperature = problem.triads[index], problem.temperature
        params = self.result.state.params[:, where]
        strength = np.linalg.norm(triad.model.fields(params, triad.raw, temperature)[0], axis=-1)
        finished, mine = (
            triad.model.finished(self.profile.reference_temperature_c)[0],
            self.slices[index],
        )
        moved = self.map[mine, where] @ params[0]
        columns = finished.jacobian(moved, triad.raw[0], temperature[0]).reshape(-1, 3, len(moved))
        effect = np.sqrt(np.mean(np.sum(columns**2, 1), 0)) / strength.mean()
        share = np.abs([d[mine] for d in self.directions] or [np.zeros(len(effect))]).max(0)
        values = np.sqrt(np.diag(self.covariance)[mine])
        return [
            None if s * e > FREE_SHARE else float(v)
            for v, s, e in zip(values, share, effect, strict=True)
        ]

    def findings(self, stations: list[StationRow]) -> list[Finding]:
        """What the reader should know, in order of weight."""
        found = []
        made = [self.triad(i) for i in range(len(self.result.problem.triads))]
        for triad in made:
            excess = triad.variance_factor
            if triad.noise_source == "declared" and excess is not None and excess > SUSPECT**2:
                found.append(
                    Finding(
                        id=f"{triad.name}-residuals",
                        text=f"{triad.name}: residuals are {excess**0.5:.1f} times the declared noise: "
                        "the noise figure, a reference, or the model is wrong. Uncertainties are "
                        "scaled up accordingly.",
                    )
                )
        bare = [t.name for t in made if t.degrees_of_freedom < 1]
        if bare:
            text = f"{' and '.join(bare)}: no redundancy, so nothing in this run checks the fit. Add stations."
            found.append(Finding(id="no-redundancy", text=text))
        for entry in self.free:
            names = " and ".join(TRIADS[t] for t in entry.triads)
            found.append(Finding(id=entry.id, text=f"{names}: {described(entry.id)}."))
        bent = self.options.nonlinearity or {}
        kinds = {t.name: t.model for t in made if t.name not in bent}
        ignored = [
            n
            for n, kind in kinds.items()
            if kind == "factors" and getattr(self.profile, n).nonlinearity
        ]
        if ignored:
            text = (
                f"nonlinearity of the {' and '.join(ignored)} is not fitted: the model of factors "
            )
            text += "has no such terms. Use --model polynomial for it."
            found.append(Finding(id="nonlinearity-ignored", text=text))
        if self.relative:
            text = "field strength is known at no station: the magnetometer is calibrated to field = 1. "
            found.append(Finding(id="field-unknown", text=text + "Give ref_field_nt to have nT."))
        return found + [self._reshoot(row) for row in stations if row.reshoot]

    def _reshoot(self, row: StationRow) -> Finding:
        worst = row.worst or "gravity"
        _, unit = shown_in(worst, self.relative)
        gap = "" if unit == "°" else " "
        value = row.errors.get(worst, float("nan"))
        text = (
            f"station {row.station}: residual {row.deviation:.1f}σ, most in {worst} ({value:+.3g}{gap}{unit}): "
            f"{REASONS[worst]} Re-shoot it, or --exclude {row.station}"
        )
        return Finding(id="reshoot", text=text, station=row.station)


def _own_values(result: Fit, where: slice) -> Array:
    """Singular values of one triad when all that is shared with the other is free."""
    from mwdcal.core.solvers import Normal

    normal = Normal.of(result.problem.linear(result.state, geometry=True))
    reduced, _, _ = normal.reduced()
    norms = normal.norms()[0]
    scaled = reduced[0] / np.outer(norms, norms)
    other = np.ones(len(norms), bool)
    other[where] = False
    cross = scaled[other][:, where]
    inverse = np.linalg.pinv(scaled[np.ix_(other, other)], rcond=1e-6, hermitian=True)
    values = np.linalg.eigvalsh(scaled[where, where] - cross.transpose() @ inverse @ cross)
    values = np.sqrt(np.clip(values[::-1], 0, None))
    return np.asarray(values / values[0])
