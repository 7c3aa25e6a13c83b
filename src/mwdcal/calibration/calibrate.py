"""`calibrate`: readings and profile in, a `Calibration` out, or a refusal with its reason."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from itertools import pairwise

import msgspec
import numpy as np

from mwdcal import __version__
from mwdcal.calibration.automatic.nonlinearity import with_nonlinearity
from mwdcal.calibration.automatic.stand import check_names, check_separable, stand_errors
from mwdcal.calibration.covariance import (
    PRIOR,
    assumed_exact,
    common_source,
    constants_covariance,
    error_name,
    shares,
    stated_covariance,
)
from mwdcal.calibration.diagnosis.findings import Findings, described
from mwdcal.calibration.diagnosis.refusals import check_fit, check_readings
from mwdcal.calibration.estimate import Fit, fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.prediction import typical_budget
from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.calibration.record import (
    FREE_SHARE,
    BudgetRow,
    Calibration,
    Choices,
    Constant,
    OrderScore,
    TriadCalibration,
    Undetermined,
    rounded,
)
from mwdcal.calibration.residuals import error_rows, measure_rows, station_rows
from mwdcal.estimation.evidence import STAND_ERRORS
from mwdcal.estimation.rank import Free, free_directions
from mwdcal.estimation.uncertainty import marginal_rank
from mwdcal.geometry.vectors import Array
from mwdcal.sensor.profile import Profile

IDENTITY = ("serial", "tool", "operator", "lab", "date", "stand", "simulated")


def calibrate(
    readings: Readings,
    profile: Profile,
    options: Options | None = None,
    *,
    profile_sha256: str = "",
    run_sha256: str = "",
    orders: Sequence[OrderScore] = (),
    excluded: Sequence[str] = (),
    progress: Callable[[str], None] = lambda text: None,
) -> Calibration:
    """Fit the sensor model to a run and state what it is worth.

    For the record: `orders`, what chose the order and left-out temperatures say of it
    (`mwdcal.calibration.automatic.order_selection`), and `excluded`, labels of stations of the run
    that the readings no longer have.
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
    record = made.calibration(profile_sha256, run_sha256)
    also = {
        "orders": list(orders),
        "excluded": list(excluded),
        "budget": made.budget(record),
    }
    return rounded(msgspec.structs.replace(record, **also))


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
                ignore=list(options.ignore),
                robust=options.robust,
                paper_weights=options.paper_weights,
                prior=options.prior.source if options.prior else None,
            ),
            seed=options.seed if options.method == "swarm" else None,
            time=datetime.now(UTC).isoformat(timespec="seconds"),
            field_unit=readings.field_unit,
            stations=readings.count,
            temperature_c=self.temperatures,
            accelerometer=self.triad(0),
            magnetometer=self.triad(1) if readings.magnetometer is not None else None,
            covariance_rows=self.covariance.tolist(),
            free=[d.tolist() for d in self.directions],
            singular_values=result.analysis.determined.values[0].tolist(),
            constants=self.constants(),
            stand=stand_errors(result),
            earth=self.earth(),
            assumed_exact=self.assumed,
            errors=error_rows(readings, result),
            measures=measure_rows(readings, result),
            station_rows=stations,
            inherited=list(options.prior.stations) if options.prior else [],
            findings=self._findings.all(stations),
        )

    @cached_property
    def _findings(self) -> Findings:
        return Findings(self.readings, self.profile, self.options, self.result, self.free)

    @property
    def temperatures(self) -> tuple[float, float] | None:
        """Coldest and hottest station, °C; those behind the prior count too."""
        temperature, prior = self.readings.temperature, self.options.prior
        if temperature is None:
            return None
        low, high = float(temperature.min()), float(temperature.max())
        known = (prior.temperature if prior else None) or (low, high)
        return min(low, known[0]), max(high, known[1])

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
    def covariance(self) -> Array:
        """Covariance (p, p) of the file's parameters."""
        return self._mapped(stated_covariance(self.result))

    def _mapped(self, covariance: Array) -> Array:
        """A covariance (1, p, p) of the fit's parameters as one of the file's."""
        return np.asarray(self.map @ covariance[0] @ self.map.transpose())

    def budget(self, record: Calibration) -> list[BudgetRow]:
        """What each source of error adds to the accuracy to expect; tilt is one source."""
        found: dict[str, Array] = {}
        for name, share in shares(self.result).items():
            source = name if " " in name or name == PRIOR else common_source(name)
            found[source] = found.get(source, 0.0) + self._mapped(share)
        rows = typical_budget(record, found)
        return [
            BudgetRow(source=source, **{f"{n}_deg": sd for n, sd in row.items()})
            for source, row in rows.items()
        ]

    @cached_property
    def directions(self) -> list[Array]:
        """Free directions (p,) in the file's parameters, turning or stretching by one."""
        return [self.map @ entry.direction for entry in self.free]

    @property
    def assumed(self) -> list[str]:
        """References taken as exact that no residual tests; a field of one is no reference."""
        found = assumed_exact(self.result)
        return [n for n in found if not (n.startswith("field") and self.readings.relative)]

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
        spread = np.sqrt(np.diag(constants_covariance(self.result)[0]))
        for index, constant in enumerate(self.result.problem.evidence.constants):
            lone = constant.name == "dip" and len(self.result.problem.triads) == 1
            asked = constant.unknown and constant.name in STAND_ERRORS  # these stand in `stand`
            if lone or asked:
                continue
            unit = {"gravity": "g", "field": "nT"}.get(constant.name, "°")
            degrees = float(np.degrees(1)) if unit == "°" else 1.0
            found.append(
                Constant(
                    name=constant.name if constant.unknown else error_name(constant.name),
                    value=float(self.result.state.constants[0, index]) * degrees,
                    standard_uncertainty=float(spread[index]) * degrees,
                    unit=unit,
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
        freedom, chance = float(analysis.freedom[0, index]), self._findings.chances[0, index]
        return TriadCalibration(
            name=TRIADS[index],
            unit="g" if index == 0 else ("1 (field = 1)" if self.readings.relative else "nT"),
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
            misfit_probability=None if np.isnan(chance) else float(chance),
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


def _own_values(result: Fit, where: slice) -> Array:
    """Singular values of one triad when all that is shared with the other is free."""
    reduced, _, _ = result.problem.linear(result.state, geometry=True).normal.reduced()
    norms = result.analysis.determined.norms[0]
    scaled = reduced[0] / np.outer(norms, norms)
    other = np.ones(len(norms), bool)
    other[where] = False
    cross = scaled[other][:, where]
    inverse = np.linalg.pinv(scaled[np.ix_(other, other)], rcond=1e-6, hermitian=True)
    values = np.linalg.eigvalsh(scaled[where, where] - cross.transpose() @ inverse @ cross)
    values = np.sqrt(np.clip(values[::-1], 0, None))
    return np.asarray(values / values[0])
