"""`calibrate`: readings and profile in, a `Calibration` out, or a refusal with its reason."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property

import numpy as np

from mwdcal import __version__
from mwdcal.calibration import results
from mwdcal.calibration.automatic.auto import Choice, choose
from mwdcal.calibration.diagnosis.findings import described, findings
from mwdcal.calibration.diagnosis.flags import FittedRuns
from mwdcal.calibration.diagnosis.noise_refusals import UNSOUND_ADVICE
from mwdcal.calibration.diagnosis.refusals import check, fit_refusals
from mwdcal.calibration.diagnosis.soundness import inconsistency
from mwdcal.calibration.estimate import Fit, fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.prediction import accuracy
from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.calibration.record import (
    BudgetRow,
    Calibration,
    Choices,
    Constant,
    StandErrors,
    TriadCalibration,
    Undetermined,
    rounded,
    sealed,
    stated,
)
from mwdcal.calibration.residuals import error_rows, measure_rows
from mwdcal.errors import FitError
from mwdcal.estimation.evidence import STAND_ERRORS
from mwdcal.estimation.rank import Free
from mwdcal.geometry.vectors import Array
from mwdcal.sensor.models import Polynomial
from mwdcal.sensor.profile import Profile

IDENTITY = ("serial", "tool", "operator", "lab", "date", "stand", "simulated")


def calibrate(
    readings: Readings,
    profile: Profile,
    options: Options | None = None,
    *,
    progress: Callable[[str], None] = lambda text: None,
) -> Calibration:
    """Fit the sensor model to a run and state what it is worth.

    What the options leave to the software is chosen as `mwdcal calibrate` does
    (`mwdcal.calibration.automatic.auto`); `progress` gets a line for each trial.
    Raises `InputError` for options that do not go together, `FitError` where the data cannot give a
    calibration to be trusted.
    """
    choice = choose(readings, profile, options or Options(), progress)
    return recorded(choice, fit(choice.readings, choice.options))


def recorded(choice: Choice, result: Fit) -> Calibration:
    """The record of a fit with the options chosen for a run.

    Raises `FitError` where the fit is not to be trusted.
    """
    fitted = FittedRuns.single(choice.readings, choice.profile, choice.options, result)
    check(fit_refusals(fitted))
    calibration = sealed(rounded(_Record(choice, fitted).calibration()))
    problem = inconsistency(calibration)
    if problem:
        raise FitError(f"the fit gives no usable calibration: {problem}. {UNSOUND_ADVICE}")
    return calibration


@dataclass(frozen=True)
class _Record:
    """The parts of a calibration file, from one fit."""

    choice: Choice
    fitted: FittedRuns

    @property
    def result(self) -> Fit:
        """The fit."""
        return self.fitted.result

    @property
    def reference(self) -> float:
        """The temperature τ = 0 of the file's models, °C."""
        return self.choice.profile.reference_temperature_c

    @property
    def free(self) -> list[Free]:
        """Directions of the parameters that nothing determines."""
        return self.fitted.free[0]

    def calibration(self) -> Calibration:
        """The whole record."""
        readings, result, options = self.choice.readings, self.result, self.choice.options
        residuals = self.fitted.residuals(0)
        return Calibration(
            tool={k: str(v) for k, v in readings.metadata.items() if k in IDENTITY},
            profile=self.choice.profile,
            profile_sha256=readings.profile_sha256,
            run=readings.source,
            run_sha256=readings.run_sha256,
            software=f"mwdcal {__version__}",
            method=options.method,
            options=Choices(
                parameters=options.parameters,
                ignore=list(options.ignore),
                robust=options.robust,
                paper_weights=options.paper_weights,
                prior=options.knowledge.source if options.knowledge else None,
            ),
            seed=options.seed if options.method == "swarm" else None,
            time=datetime.now(UTC).isoformat(timespec="seconds"),
            field_unit=readings.field_unit,
            stations=readings.count,
            excluded=list(self.choice.excluded),
            temperature_c=self.temperatures,
            accelerometer=self.triad(0),
            magnetometer=self.triad(1) if readings.magnetometer is not None else None,
            covariance_rows=self.fitted.covariance.in_file(self.reference)[0].tolist(),
            free=[(self.to_file @ entry.direction).tolist() for entry in self.free],
            singular_values=result.analysis.determined.values[0].tolist(),
            constants=self.constants(),
            stand=StandErrors(**_first(results.stand_errors(result))),
            earth=_first(results.earth(result)),
            budget=self.budget(),
            assumed_exact=results.assumed_exact(result, readings.relative),
            errors=error_rows(residuals),
            measures=measure_rows(residuals),
            orders=list(self.choice.orders),
            station_rows=self.fitted.rows(0),
            inherited=list(options.knowledge.stations) if options.knowledge else [],
            findings=findings(self.fitted),
        )

    @cached_property
    def to_file(self) -> Array:
        """Linear map from the fit's parameters (p,) to the file's."""
        return np.asarray(results.to_file(self.result, self.reference)[0])

    @property
    def temperatures(self) -> tuple[float, float] | None:
        """Coldest and hottest station, °C; those behind the prior count too."""
        if self.choice.readings.temperature is None:
            return None
        low, high = results.temperature_range(self.result, self.choice.options.knowledge)
        return float(low[0]), float(high[0])

    def budget(self) -> list[BudgetRow]:
        """What each source of error adds to the accuracy to expect; tilt is one source."""
        shares: dict[str, Array] = {}
        for name, share in self.fitted.covariance.by_source().items():
            source = results.common_source(name)
            shares[source] = shares.get(source, 0.0) + share
        free, prior = self.fitted.free, self.choice.options.knowledge
        tools = results.calibrated_tools(self.result, free, self.reference, prior)
        sd = accuracy(tools, np.stack([*shares.values()]))
        degrees = {f"{angle}_deg": np.degrees(values[:, 0]) for angle, values in sd.items()}
        return [
            BudgetRow(source=source, **{name: stated(sd[place]) for name, sd in degrees.items()})
            for place, source in enumerate(shares)
        ]

    def constants(self) -> list[Constant]:
        """Estimated constants of the run with their uncertainty."""
        constants = []
        sd = np.sqrt(np.diag(results.constants_covariance(self.result)[0]))
        for index, constant in enumerate(self.result.problem.evidence.constants):
            lone = constant.name == "dip" and len(self.result.problem.triads) == 1
            if lone or (constant.unknown and constant.name in STAND_ERRORS):  # those are in `stand`
                continue
            unit = {"gravity": "g", "field": "nT"}.get(constant.name, "°")
            degrees = float(np.degrees(1)) if unit == "°" else 1.0
            constants.append(
                Constant(
                    name=constant.name if constant.unknown else results.error_name(constant.name),
                    value=float(self.result.state.constants[0, index]) * degrees,
                    standard_uncertainty=float(sd[index]) * degrees,
                    unit=unit,
                )
            )
        return constants

    def triad(self, index: int) -> TriadCalibration:
        """The record of one triad."""
        name, total = TRIADS[index], self.fitted.covariance.total
        triad = results.triad_results(self.result, index, total, self.fitted.free, self.reference)
        model = triad.model
        powers = model if isinstance(model, Polynomial) else Polynomial(model.basis)
        return TriadCalibration(
            name=name,
            unit="g"
            if index == 0
            else ("1 (field = 1)" if self.choice.readings.relative else "nT"),
            model=model.kind,
            order=model.basis.order,
            curved=model.curved,
            centre=powers.centre.ravel().tolist(),
            radius=float(powers.scale.ravel()[0]),
            parameter_names=list(model.names),
            parameters=triad.parameters[0].tolist(),
            standard_uncertainties=[stated(sd) for sd in triad.sd[0].tolist()],
            rank=int(triad.rank[0]),
            size=int(triad.size[0]),
            singular_values=results.triad_singular_values(self.result, index)[0].tolist(),
            undetermined=[
                Undetermined(id=f.id, text=f"{name}: {described(f.id)}")
                for f in self.free
                if index in f.triads
            ],
            noise=float(triad.noise[0]),
            noise_source="declared" if triad.declared[0] else "estimated from the residuals",
            variance_factor=stated(triad.variance_factor[0]),
            degrees_of_freedom=float(triad.degrees_of_freedom[0]),
            misfit_probability=stated(self.fitted.chances[0, index]),
        )


def _first(values: dict[str, Array]) -> dict[str, float]:
    """The values of the first tool."""
    return {name: float(value[0]) for name, value in values.items()}
