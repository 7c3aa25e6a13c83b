"""What the test of change and the due date are worth, on simulated tools: false alarms, power, coverage.

    make drift        (writes docs/drift-tables.md)

All data are simulated. It is about the statistics themselves, and imports the core for its figures.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from msgspec.structs import replace as with_changes
from scipy.optimize import brentq
from scipy.stats import norm

from mwdcal.calibration import results
from mwdcal.calibration.estimate import Fit, fit
from mwdcal.calibration.readings import TRIADS
from mwdcal.drift.change import LEVEL, ChangeTest, Contrasts, change_test
from mwdcal.drift.comparable import DIRECTIONS, History, factored, parameter_names, precision
from mwdcal.files.profiles import load_profile
from mwdcal.geometry.vectors import Array
from mwdcal.planning.expected import planned_fit
from mwdcal.planning.plans import load_plan
from mwdcal.planning.session import Session
from mwdcal.planning.simulate import Truth, drawn
from mwdcal.sensor.profile import Profile, StandProfile

SERVO = load_profile("servo")[0]
STANDS = {
    "exact": StandProfile(),
    "settings": SERVO.stand,
    "shared": with_changes(
        SERVO.stand, azimuth_zero_deg=0.05, tilt_deg=0.02, field_nt=30.0, dip_deg=0.02
    ),
}
"""Stands by name: exact; with an error of each setting; also with errors that all stations of a run share."""
AXIS = 3
"""Place of the bias that takes a step: x of the accelerometer."""
STEP = 3.0
"""The step, in standard uncertainties of that bias in one calibration."""
SEED = 20261122
AT_ONCE = 100


@dataclass(frozen=True)
class Setting:
    """What is simulated: a plan on a stand, so many calibrations before and after a step, and noise declared or not."""

    plan: str = "twelve-state"
    stand: str = "settings"
    before: int = 3
    after: int = 2
    declared: bool = True
    one_stand: bool = False

    @property
    def count(self) -> int:
        """Calibrations of each tool."""
        return self.before + self.after


def walked(truth: Truth, moves: Array) -> Truth:
    """Tools whose parameters (…, 24) of both triads have moved."""
    moved = truth.accelerometer + moves[..., :12], truth.magnetometer + moves[..., 12:]
    return replace(truth, accelerometer=moved[0], magnetometer=moved[1])


def histories(
    setting: Setting, part: int, tools: int = AT_ONCE, moves: Callable[[int], Array] | None = None,
    years: Sequence[float] | None = None,
) -> Iterator[History]:  # fmt: skip
    """Histories of tools calibrated again and again; `moves` (tools, 24) of parameters before each calibration."""
    profile = with_changes(SERVO, stand=STANDS[setting.stand])
    table = load_plan(setting.plan)
    choice, _ = planned_fit(table, profile)
    session, rng = Session.of(table, profile), np.random.default_rng([SEED, part])
    truth = drawn(rng, profile, 0, (tools,))
    common = session.common(rng, (tools,)) if setting.one_stand else None
    rows = []
    for number in range(setting.count):
        if moves is not None:
            truth = walked(truth, moves(number))
        readings = session.measured(truth, rng, common).readings
        if not setting.declared:
            readings = replace(readings, sd={k: v for k, v in readings.sd.items() if k not in TRIADS})
        rows.append(in_common(fit(readings, choice.options), profile))
    times = np.arange(setting.count) if years is None else np.asarray(years)
    names = parameter_names(dict.fromkeys(TRIADS, 0))
    for each in zip(*(zip(*row, strict=True) for row in rows), strict=True):
        values, covariance, freedom = (np.stack(columns) for columns in zip(*each, strict=True))
        known = np.stack([precision(matrix, np.zeros((0, 24))) for matrix in covariance])
        yield History(names, values, covariance, known, freedom, times * 1.0)


def in_common(result: Fit, profile: Profile) -> tuple[Array, Array, Array]:
    """Values (B, 24), their covariance and degrees of freedom, of a fit of many tools."""
    reference = profile.reference_temperature_c
    covariance = results.StatedCovariance(result).in_file(reference)
    params = np.einsum("bij,bj->bi", results.to_file(result, reference), result.state.params)
    values, slopes, start = [], np.zeros((len(params), 24, params.shape[-1])), 0
    for index, triad in enumerate(result.problem.triads):
        model = triad.model.finished(reference)[0]
        where = slice(start, start + model.size)
        strength = result.problem.constant(result.state, ("gravity", "field")[index]).mean()
        points = DIRECTIONS * strength
        put = factored(model, params[:, where], points, (reference, reference), 0)
        values.append(put.values)
        slopes[:, 12 * index : 12 * index + 12, where] = put.jacobian
        start += model.size
    freedom = np.repeat(result.analysis.freedom, 12, axis=-1)
    return np.concatenate(values, -1), slopes @ covariance @ slopes.mT, freedom
