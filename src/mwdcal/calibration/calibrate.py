"""`calibrate`: readings and profile in, a `Calibration` out, or a refusal with its reason."""

from __future__ import annotations

from datetime import UTC, datetime

import msgspec
import numpy as np

from mwdcal.calibration import results
from mwdcal.calibration.automatic.auto import Choice, choose
from mwdcal.calibration.automatic.drift import fit_run
from mwdcal.calibration.automatic.order_selection import Progress
from mwdcal.calibration.canonical import rounded
from mwdcal.calibration.diagnosis.findings import described, findings
from mwdcal.calibration.diagnosis.flags import FittedRuns
from mwdcal.calibration.diagnosis.identity import dated, overdue, unidentified
from mwdcal.calibration.diagnosis.refusals import UNSOUND_ADVICE, check, fit_refusals
from mwdcal.calibration.diagnosis.repeats import copies
from mwdcal.calibration.diagnosis.soundness import inconsistency
from mwdcal.calibration.drift import Constant, Drift, UnseenDrift
from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.prediction import accuracy
from mwdcal.calibration.prior import PriorInformation
from mwdcal.calibration.readings import TRIADS, WORDS, Readings, is_simulated, serial_of
from mwdcal.calibration.record import (
    SOFTWARE,
    BudgetRow,
    Calibration,
    Finding,
    FitSettings,
    StandErrors,
    TriadCalibration,
    Undetermined,
    stated,
    with_checksum,
)
from mwdcal.calibration.residuals import error_rows, measure_rows
from mwdcal.calibration.settings import ASSUMED_PRACTICE, DIRECTION, is_assumed
from mwdcal.errors import FitError
from mwdcal.estimation.batch import batch_of_one
from mwdcal.estimation.evidence import STAND_ERRORS, WALKS
from mwdcal.estimation.problem import WALK_AXES
from mwdcal.geometry.vectors import Array
from mwdcal.sensor.models import Polynomial
from mwdcal.sensor.profile import PRACTICES, Profile

IDENTITY = (*WORDS, "simulated")


def calibrate(
    readings: Readings,
    profile: Profile,
    options: Options | None = None,
    *,
    progress: Progress = lambda text: None,
) -> Calibration:
    """Fit the sensor model to a run and state what it is worth.

    What the options leave to the software is chosen as `mwdcal calibrate` does
    (`mwdcal.calibration.automatic.auto`); `progress` gets a line for each trial.
    Raises `InputError` for options that do not go together, `FitError` where the data cannot give a
    calibration to be trusted.
    """
    return recorded(*chosen_fit(readings, profile, options or Options(), progress))


def chosen_fit(
    readings: Readings, profile: Profile, options: Options, progress: Progress
) -> tuple[Choice, Fit]:
    """Choices and fit of a run, without the stations that are copies of others.

    Raises as `calibrate`.
    """
    choice = choose(readings, profile, options, progress)
    result = fit_run(choice.readings, choice.options)
    repeated = copies(result)[0]
    if not repeated.any():
        return choice, result
    check(fit_refusals(one_run(choice, result)))
    progress(f"{repeated.sum()} of {repeated.size} stations are copies of others: without them")
    left = np.array([label not in options.exclude for label in readings.labels])
    left[left] = repeated
    return chosen_fit(readings.without_copies(left), profile, options, progress)


def recorded(choice: Choice, result: Fit) -> Calibration:
    """The record of a fit with the options chosen for a run.

    Raises `FitError` where the fit is not to be trusted.
    """
    fitted = one_run(choice, result)
    check(fit_refusals(fitted))
    return record_of(choice, fitted)


def record_of(choice: Choice, fitted: FittedRuns) -> Calibration:
    """The record of a fit that nothing refuses, a batch of one.

    Raises `FitError` where it would not be one.
    """
    calibration = with_checksum(rounded(_record(choice, fitted)))
    if problem := inconsistency(calibration):
        raise FitError(f"the fit gives no usable calibration: {problem}. {UNSOUND_ADVICE}")
    return calibration


def one_run(choice: Choice, result: Fit) -> FittedRuns:
    """The fit of a run as refusals and findings look at it: a batch of one."""
    readings, profile = choice.readings, choice.profile
    return FittedRuns(
        batch_of_one(readings), profile, choice.options, result, lambda _: (readings, profile)
    )


def _record(choice: Choice, fitted: FittedRuns) -> Calibration:
    """The calibration file of a fit, in full digits."""
    readings, options, result = choice.readings, choice.options, fitted.result
    reference, prior = choice.profile.reference_temperature_c, options.knowledge
    to_file = results.to_file(result, reference)[0]
    low, high = results.temperature_range(result, prior)
    triads = [_triad(fitted, index) for index in range(len(result.problem.triads))]
    tool = _identity(readings, prior is not None and prior.simulated)
    return Calibration(
        tool=tool,
        serial=serial_of(tool) or msgspec.UNSET,
        simulated=is_simulated(tool),
        profile=choice.profile,
        profile_sha256=readings.profile_sha256,
        run=readings.source,
        run_sha256=readings.run_sha256,
        prior_sha256=options.prior_sha256 or msgspec.UNSET,
        settings_file=readings.settings_source[0] or msgspec.UNSET,
        settings_sha256=readings.settings_source[1] or msgspec.UNSET,
        software=SOFTWARE,
        method=options.method,
        options=_settings(options),
        seed=options.seed if options.method == "swarm" else None,
        time=datetime.now(UTC).isoformat(timespec="seconds"),
        field_unit=readings.field_unit,
        stations=readings.count,
        excluded=[*choice.excluded, *(label for label, _ in readings.copies)],
        copies=[digest for _, digest in readings.copies] or msgspec.UNSET,
        temperature_c=None if readings.temperature is None else (float(low[0]), float(high[0])),
        accelerometer=triads[0],
        magnetometer=triads[1] if len(triads) > 1 else None,
        covariance_rows=fitted.covariance.in_file(reference)[0].tolist(),
        free=[(to_file @ entry.direction).tolist() for entry in fitted.free[0]],
        singular_values=result.analysis.determined.values[0].tolist(),
        constants=_constants(result),
        drift=_drifts(result, readings.field_unit),
        stand=StandErrors(**_first(results.stand_errors(result))),
        earth=_first(results.earth(result)),
        gravity_stated=readings.states("gravity"),
        settings=_practice(fitted),
        budget=_budget(fitted),
        assumed_exact=results.assumed_exact(result, readings.relative),
        unseen=_unseen(fitted),
        errors=error_rows(fitted.residuals(0)),
        measures=measure_rows(fitted.residuals(0)),
        orders=list(choice.orders),
        station_rows=fitted.residuals(0).stations,
        inherited=list(prior.stations) if prior else [],
        findings=[*findings(fitted), *_doubts(choice, prior)],
    )


def _doubts(choice: Choice, prior: PriorInformation | None) -> list[Finding]:
    """Findings on the identity of a run and its prior, on its day, and on standards that were overdue then."""
    readings = choice.readings
    alone = unidentified({readings.name: serial_of(readings.metadata)})
    doubts = [*prior.doubts] if prior and prior.doubts else alone
    late = overdue(choice.profile.standards, readings.metadata)
    return doubts + dated(readings.metadata, readings.name) + late


def _identity(readings: Readings, simulated: bool) -> dict[str, str]:
    """The statements of the run about the tool, of whom and where it was measured; `simulated`: so is its prior."""
    tool = {k: str(v) for k, v in readings.metadata.items() if k in IDENTITY}
    return {**tool, "simulated": str(True)} if simulated else tool


def _practice(fitted: FittedRuns) -> str | msgspec.UnsetType:
    """How often the stand's direction was taken to be set, where its errors count."""
    evidence, readings = fitted.result.problem.evidence, fitted.alone(0)[0]
    sd = [np.nan_to_num(evidence.sd[name] * evidence.is_known(name)) for name in DIRECTION]
    if not np.any(sd):
        return msgspec.UNSET
    if is_assumed(readings):
        return ASSUMED_PRACTICE
    return PRACTICES[0] if evidence.set_together.any() else PRACTICES[1]


def _settings(options: Options) -> FitSettings:
    """The settings of the fit that a record states beyond method, model and order."""
    settings = {name: getattr(options, name) for name in FitSettings.__struct_fields__}
    prior = options.knowledge
    named = {"ignore": [*options.ignore], "prior": prior.source if prior else None}
    return FitSettings(**settings | named)


def _budget(fitted: FittedRuns) -> list[BudgetRow]:
    """The contribution of each source of error to the accuracy to expect."""
    repeatability = [getattr(fitted.profile, name).repeatability for name in TRIADS]
    nominal = [getattr(fitted.profile, name).scale or 1.0 for name in TRIADS]
    shares = fitted.covariance.by_source(np.divide(repeatability, nominal).tolist())
    return [BudgetRow(source=name, **sd) for name, sd in _accuracies(fitted, shares).items()]


def _accuracies(fitted: FittedRuns, shares: dict[str, Array]) -> dict[str, dict[str, float | None]]:
    """The contribution of each share (1, p, p) of the covariance to the accuracy to expect, degrees by angle."""
    reference, prior = fitted.profile.reference_temperature_c, fitted.options.knowledge
    tools = results.calibrated_tools(fitted.result, fitted.free, reference, prior)
    sd = accuracy(tools, np.stack([*shares.values()]))
    degrees = {f"{angle}_deg": np.degrees(values[:, 0]) for angle, values in sd.items()}
    return {
        source: {name: stated(sd[place]) for name, sd in degrees.items()}
        for place, source in enumerate(shares)
    }


def _constants(result: Fit) -> list[Constant]:
    """Estimated constants of the run with their uncertainty."""
    constants, problem = [], result.problem
    sd = np.sqrt(np.diag(results.constants_covariance(result)[0]))
    triples = zip(result.state.constants[0], sd, problem.evidence.constants, strict=True)
    for value, uncertainty, constant in triples:
        lone = constant.name == "dip" and len(problem.triads) == 1
        in_stand = constant.unknown and constant.name in STAND_ERRORS
        if lone or in_stand or constant.name in WALK_AXES:  # those are in `stand`, or `drift`
            continue
        unit = {"gravity": "g", "field": "nT"}.get(constant.name, "°")
        factor = float(np.degrees(1)) if unit == "°" else 1.0
        constants.append(
            Constant(
                name=constant.name if constant.unknown else results.error_name(constant.name),
                value=float(value) * factor,
                standard_uncertainty=float(uncertainty) * factor,
                unit=unit,
            )
        )
    return constants


def _drifts(result: Fit, field_unit: str) -> list[Drift]:
    """How far field and offsets drifted within the run."""
    declared, drifts = result.problem.evidence.drift, []
    for name, (change, sd) in results.drifts(result).items():
        factor, unit = _shown_drift(name, field_unit)
        size = float(declared[name][0]) if name in declared else 0.0
        drifts.append(
            Drift(
                name=name.removesuffix("-drift"),
                change=float(change[0]) * factor,
                standard_uncertainty=float(sd[0]) * factor,
                unit=unit,
                declared=size * factor if size else msgspec.UNSET,
            )
        )
    return drifts


def _shown_drift(name: str, field_unit: str) -> tuple[float, str]:
    """Factor and unit in which a drift is stated."""
    return (1e3, "mg") if name == "accelerometer-drift" else (1.0, field_unit)


def _unseen(fitted: FittedRuns) -> list[UnseenDrift] | msgspec.UnsetType:
    """The effect of drifts that no residual would show."""
    readings = fitted.alone(0)[0]
    field = 2e-4 if readings.relative else 10.0
    sizes = dict(zip(WALKS, (1e-4, field, field), strict=True))
    shares = {n: sizes[n] ** 2 * each for n, each in results.unseen_shares(fitted.result).items()}
    unseen = []
    for name, sd in (_accuracies(fitted, shares) if shares else {}).items():
        factor, unit = _shown_drift(name, readings.field_unit)
        word = name.removesuffix("-drift")
        unseen.append(UnseenDrift(name=word, change=sizes[name] * factor, unit=unit, **sd))
    return unseen or msgspec.UNSET


def _triad(fitted: FittedRuns, index: int) -> TriadCalibration:
    """The record of one triad."""
    name, reference = TRIADS[index], fitted.profile.reference_temperature_c
    covariance = fitted.covariance.total
    triad = results.triad_results(fitted.result, index, covariance, fitted.free, reference)
    model = triad.model
    powers = model if isinstance(model, Polynomial) else Polynomial(model.basis)
    field_unit = "1 (field = 1)" if fitted.readings.relative else "nT"
    return TriadCalibration(
        name=name,
        unit="g" if index == 0 else field_unit,
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
        singular_values=results.triad_singular_values(fitted.result, index)[0].tolist(),
        undetermined=[
            Undetermined(id=free.id, text=f"{name}: {described(free.id)}")
            for free in fitted.free[0]
            if index in free.triads
        ],
        noise=float(triad.noise[0]),
        noise_source="declared" if triad.declared[0] else "estimated from the residuals",
        variance_factor=stated(triad.variance_factor[0]),
        degrees_of_freedom=float(triad.degrees_of_freedom[0]),
        misfit_probability=stated(fitted.chances[0, index]),
    )


def _first(values: dict[str, Array]) -> dict[str, float]:
    """The values of the first tool."""
    return {name: float(value[0]) for name, value in values.items()}
