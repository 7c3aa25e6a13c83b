"""`calibrate`: readings and profile in, a `Calibration` out, or a refusal with its reason."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from typing import Any

import msgspec
import numpy as np

from mwdcal.calibration import results
from mwdcal.calibration.automatic.auto import Choice, Progress, choose
from mwdcal.calibration.automatic.drift import fit_run
from mwdcal.calibration.diagnosis.findings import copies, described, finding_flags, findings
from mwdcal.calibration.diagnosis.flags import FittedRuns, Flag
from mwdcal.calibration.diagnosis.identity import dated, overdue, unidentified
from mwdcal.calibration.diagnosis.plausibility import inconsistency
from mwdcal.calibration.diagnosis.refusals import UNSOUND_ADVICE, check, fit_refusals
from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.options import ASSUMED_PRACTICE, DIRECTION, Options, is_assumed
from mwdcal.calibration.prior import PriorInformation
from mwdcal.calibration.readings import TRIADS, WORDS, Readings, is_simulated, serial_of
from mwdcal.calibration.record import (
    LEAST_DRIFT,
    NOISE,
    SOFTWARE,
    BudgetRow,
    Calibration,
    Constant,
    Drift,
    Finding,
    FitSettings,
    StandErrors,
    TriadCalibration,
    Undetermined,
    UnseenDrift,
    figures,
    rounded,
    stated,
    with_checksum,
)
from mwdcal.calibration.residuals import error_rows, measure_rows
from mwdcal.calibration.results import accuracy
from mwdcal.errors import FitError, MwdcalError
from mwdcal.estimation import drift
from mwdcal.estimation.batch import batch_of_one, mapped
from mwdcal.estimation.problem import STAND_ERRORS, WALK_AXES, WALKS
from mwdcal.geometry.vectors import Array, diagonal
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

    Choices that the options leave open are made as `mwdcal calibrate` does
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
    """The record of a fit that nothing refuses, a batch of one. Raises as `Records.of`."""
    return Records(fitted, [*finding_flags(fitted)]).of(0, choice)


def one_run(choice: Choice, result: Fit) -> FittedRuns:
    """The fit of a run as refusals and findings look at it: a batch of one."""
    readings, profile = choice.readings, choice.profile
    return FittedRuns(
        batch_of_one(readings), profile, choice.options, result, lambda _: (readings, profile)
    )


@dataclass(frozen=True)
class Records:
    """Calibration files of fitted runs, with the `flags` of their findings.

    All figures are worked out for the batch: a file is a row of them.
    """

    fitted: FittedRuns
    flags: Sequence[Flag]

    def of(self, place: int, choice: Choice) -> Calibration:
        """The record of one run with the options chosen for it.

        Raises `FitError` where it would not be one.
        """
        calibration = with_checksum(self._whole(place, choice))
        if problem := inconsistency(calibration):
            raise FitError(f"the fit gives no usable calibration: {problem}. {UNSOUND_ADVICE}")
        return calibration

    def _whole(self, place: int, choice: Choice) -> Calibration:
        """The calibration file of one fit."""
        readings, options, result = choice.readings, choice.options, self.fitted.result
        prior = options.knowledge
        tool = _identity(readings, prior is not None and prior.simulated)
        return Calibration(
            tool=tool,
            serial=serial_of(tool) or msgspec.UNSET,
            simulated=is_simulated(tool),
            profile=rounded(choice.profile),
            profile_sha256=readings.profile_sha256,
            run=readings.source,
            sheet=readings.sheet or msgspec.UNSET,
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
            singular_values=figures(result.analysis.determined.values[place]),
            gravity_stated=bool(readings.states("gravity")),
            settings=self._practice(place, readings),
            orders=[*map(rounded, choice.orders)],
            station_rows=self.fitted.stations(place),
            inherited=list(prior.stations) if prior else [],
            findings=[*self._findings(place, choice), *_doubts(choice, prior)],
            **{name: each[place] for name, each in self._figures.items()},
        )

    @cached_property
    def _figures(self) -> dict[str, Sequence[Any]]:
        """Fields of the files by name, an entry for each run."""
        fitted, result = self.fitted, self.fitted.result
        reference, count = fitted.profile.reference_temperature_c, self.fitted.count
        ends = results.temperature_range(result, fitted.options.knowledge)
        triads = [_triads(fitted, index) for index in range(len(result.problem.triads))]
        stand = _by_run(results.stand_errors(result), count)
        return {
            "temperature_c": [None] * count
            if fitted.readings.temperature is None
            else [*zip(*(figures(end) for end in ends), strict=True)],
            **dict(zip(TRIADS, triads, strict=False)),
            "covariance_rows": figures(fitted.covariance.in_file(reference)),
            "free": _free(fitted),
            "constants": _constants(result),
            "drift": _drifts(result, fitted.readings.field_unit),
            "stand": [StandErrors(**errors) for errors in stand],
            "earth": _by_run(results.earth(result), count),
            "budget": _budget(fitted),
            "assumed_exact": results.assumed_exact(
                result, fitted.readings.relative, fitted.readings.exact_angles
            ),
            "unseen": _unseen(fitted),
            "errors": error_rows(fitted.residuals),
            "measures": measure_rows(fitted.residuals),
        }

    def _findings(self, place: int, choice: Choice) -> list[Finding]:
        """The findings of one run; its file may have columns that the table of a fleet has not."""
        readings, fitted = choice.readings, self.fitted
        flags: Iterable[Flag] = self.flags
        if (readings.unused, {*readings.others}) != (
            fitted.readings.unused,
            {*fitted.readings.others},
        ):
            flags = finding_flags(fitted.alone_as(place, (readings, choice.profile)))
            place = 0
        return findings(flags, place, readings.labels)

    def _practice(self, place: int, readings: Readings) -> str | msgspec.UnsetType:
        """How often the stand's direction was taken to be set, where its errors count."""
        evidence = self.fitted.result.problem.evidence
        if not any(
            np.any(evidence.sd[n][place, evidence.is_known(n)[place]] > 0) for n in DIRECTION
        ):
            return msgspec.UNSET
        if is_assumed(readings):
            return ASSUMED_PRACTICE
        return PRACTICES[0] if evidence.set_together[place].any() else PRACTICES[1]


def _doubts(choice: Choice, prior: PriorInformation | None) -> list[Finding]:
    """Findings on the identity of a run and its prior, on its day, and on standards that were overdue then."""
    readings = choice.readings
    alone = unidentified({readings.run_name: serial_of(readings.metadata)})
    doubts = [*prior.doubts] if prior and prior.doubts else alone
    late = overdue(choice.profile.standards, readings.metadata)
    return doubts + dated(readings.metadata, readings.name) + late


def _identity(readings: Readings, simulated: bool) -> dict[str, str]:
    """The statements of the run about the tool, of whom and where it was measured; `simulated`: so is its prior."""
    north = readings.north
    stated = {**readings.metadata, **north}
    tool = {k: str(v) for k, v in stated.items() if k in IDENTITY or k in north}
    return {**tool, "simulated": str(True)} if simulated else tool


def _settings(options: Options) -> FitSettings:
    """The settings of the fit that a record states beyond method, model and order."""
    settings = {name: getattr(options, name) for name in FitSettings.__struct_fields__}
    prior = options.knowledge
    named = {"ignore": [*options.ignore], "prior": prior.source if prior else None}
    return FitSettings(**settings | named)


def _by_run(values: dict[str, Array], count: int) -> list[dict[str, Any]]:
    """The values (B, ...) of each of `count` runs by name."""
    rows = zip(*map(figures, values.values()), strict=True)
    return [dict(zip(values, row, strict=True)) for row in rows] if values else [{}] * count


def _free(fitted: FittedRuns) -> list[list[list[float]]]:
    """The free directions of each run among the parameters of its file."""
    if not any(fitted.free):
        return [[] for _ in fitted.free]
    maps = results.to_file(fitted.result, fitted.profile.reference_temperature_c)
    return [
        [figures(each @ entry.direction) for entry in free]
        for each, free in zip(maps, fitted.free, strict=True)
    ]


def _budget(fitted: FittedRuns) -> list[list[BudgetRow]]:
    """The contribution of each source of error to the accuracy to expect, run by run."""
    repeatability = np.array([getattr(fitted.profile, name).repeatability for name in TRIADS])
    needed = bool(repeatability.any())
    shares = fitted.covariance.by_source(repeatability / _nominal(fitted, needed))
    present = [np.asarray(share.any((-1, -2)) | (n == NOISE)) for n, share in shares.items()]
    accuracies = _accuracies(fitted, shares)
    return [
        [
            BudgetRow(source=name, **sd[place])
            for (name, sd), there in zip(accuracies.items(), present, strict=True)
            if there[place]
        ]
        for place in range(fitted.count)
    ]


def _nominal(fitted: FittedRuns, needed: bool) -> Array:
    """Nominal scales (B, t) of both triads, which a profile may leave to each run; 1 where they are not `needed`."""
    scales = np.ones((fitted.count, len(TRIADS)))
    for place in range(fitted.count) if needed else ():
        with suppress(MwdcalError):  # such a run has no record
            profile = fitted.alone(place)[1]
            scales[place] = [getattr(profile, name).scale or 1.0 for name in TRIADS]
    return scales


def _accuracies(
    fitted: FittedRuns, shares: dict[str, Array]
) -> dict[str, list[dict[str, float | None]]]:
    """The contribution of each share (B, p, p) of the covariance to the accuracy to expect, degrees by angle."""
    reference, prior = fitted.profile.reference_temperature_c, fitted.options.knowledge
    tools = results.calibrated_tools(fitted.result, fitted.free, reference, prior)
    sd = accuracy(tools, np.stack([*shares.values()]))
    names = [f"{angle}_deg" for angle in sd]
    degrees = figures(np.degrees(np.stack([*sd.values()], -1)))
    return {
        source: [dict(zip(names, map(stated, row), strict=True)) for row in each]
        for source, each in zip(shares, degrees, strict=True)
    }


def _constants(result: Fit) -> list[list[Constant]]:
    """Estimated constants of each run with their uncertainty."""
    constants: list[list[Constant]] = [[] for _ in result.status]
    problem = result.problem
    sd = np.sqrt(diagonal(results.constants_covariance(result)))
    triples = zip(result.state.constants.T, sd.T, problem.evidence.constants, strict=True)
    for values, uncertainties, constant in triples:
        lone = constant.name == "dip" and len(problem.triads) == 1
        in_stand = constant.unknown and constant.name in STAND_ERRORS
        if lone or in_stand or constant.name in WALK_AXES:  # those are in `stand`, or `drift`
            continue
        unit = {"gravity": "g", "field": "nT"}.get(constant.name, "°")
        factor = float(np.degrees(1)) if unit == "°" else 1.0
        name = constant.name if constant.unknown else results.error_name(constant.name)
        numbers = figures(values * factor), figures(uncertainties * factor)
        for each, value, uncertainty in zip(constants, *numbers, strict=True):
            each.append(
                Constant(name=name, value=value, standard_uncertainty=uncertainty, unit=unit)
            )
    return constants


def _drifts(result: Fit, field_unit: str) -> list[list[Drift]]:
    """How far field and offsets drifted within each run, but for drifts that are as good as none."""
    declared = result.problem.evidence.drift
    drifts: list[list[Drift]] = [[] for _ in result.status]
    noise = drift.noise(result.problem)
    for name, (change, sd) in results.drifts(result).items():
        factor, unit = _shown_drift(name, field_unit)
        size = declared.get(name, np.zeros(len(change)))
        numbers = (figures(each * factor) for each in (change, sd, size))
        counts = (size > 0) | (np.hypot(change, sd) > LEAST_DRIFT * noise[name])
        for place, (moved, uncertainty, stated_size) in enumerate(zip(*numbers, strict=True)):
            if not counts[place]:
                continue
            drifts[place].append(
                Drift(
                    name=name.removesuffix("-drift"),
                    change=moved,
                    standard_uncertainty=uncertainty,
                    unit=unit,
                    declared=stated_size or msgspec.UNSET,
                )
            )
    return drifts


def _shown_drift(name: str, field_unit: str) -> tuple[float, str]:
    """Factor and unit in which a drift is stated."""
    return (1e3, "mg") if name == "accelerometer-drift" else (1.0, field_unit)


def _unseen(fitted: FittedRuns) -> list[list[UnseenDrift] | msgspec.UnsetType]:
    """The effect of drifts that no residual of a run would show."""
    members = results.unseen_drifts(fitted.result)
    field = 2e-4 if fitted.readings.relative else 10.0
    sizes = dict(zip(WALKS, (1e-4, field, field), strict=True))
    shares = {n: sizes[n] ** 2 * each for n, each in results.unseen_shares(fitted.result).items()}
    unseen: list[list[UnseenDrift]] = [[] for _ in range(fitted.count)]
    for name, sd in (_accuracies(fitted, shares) if shares else {}).items():
        factor, unit = _shown_drift(name, fitted.readings.field_unit)
        word, size = name.removesuffix("-drift"), figures(np.array(sizes[name] * factor))
        for place in np.flatnonzero(members[name]).tolist():
            unseen[place].append(UnseenDrift(name=word, change=size, unit=unit, **sd[place]))
    return [each or msgspec.UNSET for each in unseen]


def _triads(fitted: FittedRuns, index: int) -> list[TriadCalibration]:
    """The record of one triad of each run."""
    name, reference = TRIADS[index], fitted.profile.reference_temperature_c
    # in the order in memory that a run alone has: sums then end in the same digit
    result = replace(fitted.result, state=mapped(np.ascontiguousarray, fitted.result.state))
    covariance, count = fitted.covariance.total, fitted.count
    triad = results.triad_results(result, index, covariance, fitted.free, reference)
    model = triad.model
    powers = model if isinstance(model, Polynomial) else Polynomial(model.basis)
    centre, scale = (np.broadcast_to(x, (count, 1, 3))[:, 0] for x in (powers.centre, powers.scale))
    numbers = {
        "centre": centre,
        "radius": scale[:, 0],
        "parameters": triad.parameters,
        "singular_values": results.triad_singular_values(fitted.result, index),
        "noise": triad.noise,
        "degrees_of_freedom": triad.degrees_of_freedom,
    }
    some = {
        "variance_factor": triad.variance_factor,
        "misfit_probability": fitted.chances[:, index],
    }
    field_unit = "1 (field = 1)" if fitted.readings.relative else "nT"
    counts = (each.tolist() for each in (triad.rank, triad.size, triad.declared))
    rows = zip(
        *(_by_run(numbers, count), _by_run(some, count), figures(triad.sd), fitted.free, *counts),
        strict=True,
    )
    return [
        TriadCalibration(
            name=name,
            unit="g" if index == 0 else field_unit,
            model=model.kind,
            order=model.basis.order,
            curved=model.curved,
            parameter_names=list(model.names),
            standard_uncertainties=[*map(stated, sd)],
            rank=rank,
            size=size,
            undetermined=[
                Undetermined(id=each.id, text=f"{name}: {described(each.id)}")
                for each in free
                if index in each.triads
            ],
            noise_source="declared" if declared else "estimated from the residuals",
            variance_factor=stated(doubtful["variance_factor"]),
            misfit_probability=stated(doubtful["misfit_probability"]),
            **known,
        )
        for known, doubtful, sd, free, rank, size, declared in rows
    ]
