"""What the test of change is worth, on simulated tools: false alarms and power.

    make drift        (writes docs/evidence/drift-tables.md)

All data are simulated. It is about the statistics themselves, and imports the core for its figures.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from msgspec.structs import replace as with_changes
from scipy.stats import norm

from mwdcal.calibration import results
from mwdcal.calibration.estimate import Fit, fit
from mwdcal.calibration.readings import TRIADS
from mwdcal.drift.walk import (
    CHANGE_LEVEL,
    FIELD_DIRECTIONS,
    Contrasts,
    History,
    change_test,
    common_noise_scale,
    factored,
    parameter_names,
    precision,
)
from mwdcal.files.profiles import load_profile
from mwdcal.geometry.vectors import Array, outer
from mwdcal.planning.expected import planned_fit
from mwdcal.planning.plans import drawn, load_plan
from mwdcal.planning.session import Session
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
STEP = 3.0
"""The step, in standard uncertainties of that bias in one calibration."""
SEED = 20261122
AT_ONCE = 100
FEWER = 400
"""Tools of settings other than the first."""


@dataclass(frozen=True)
class Setting:
    """What is simulated: a plan on a stand, so many calibrations before and after a step, and noise declared or not."""

    plan: str = "acceptance-104"
    stand: str = "settings"
    before: int = 3
    after: int = 2
    declared: bool = True
    one_stand: bool = False

    @property
    def count(self) -> int:
        """Calibrations of each tool."""
        return self.before + self.after


def histories(setting: Setting, part: int, tools: int = AT_ONCE) -> Iterator[History]:
    """Histories of tools calibrated again and again."""
    profile = with_changes(SERVO, stand=STANDS[setting.stand])
    table = load_plan(setting.plan)
    choice, _ = planned_fit(table, profile)
    session, rng = Session.of(table, profile), np.random.default_rng([SEED, part])
    truth = drawn(rng, profile, 0, (tools,))
    common = session.common(rng, (tools,)) if setting.one_stand else None
    rows = []
    for _ in range(setting.count):
        readings = session.measured(truth, rng, common).readings
        if not setting.declared:
            readings = replace(
                readings, sd={k: v for k, v in readings.sd.items() if k not in TRIADS}
            )
        rows.append(in_common(fit(readings, choice.options), profile))
    times = np.arange(setting.count) * 1.0
    names = parameter_names(dict.fromkeys(TRIADS, 0))
    for each in zip(*(zip(*row, strict=True) for row in rows), strict=True):
        values, covariance, factors, degrees = (np.stack(c) for c in zip(*each, strict=True))
        ratio, freedom, one = (
            p.mT.repeat(12, -1) for p in common_noise_scale(factors.mT, degrees.mT)
        )
        covariance = covariance * outer(np.sqrt(ratio))
        known = np.stack([precision(matrix, np.zeros((0, 24))) for matrix in covariance])
        yield History(names, values, covariance, known, freedom, one, times)


def in_common(result: Fit, profile: Profile) -> tuple[Array, Array, Array, Array]:
    """Values (B, 24) and their covariance, s² and its degrees of freedom (B, 2), of a fit of many tools."""
    reference = profile.reference_temperature_c
    covariance = results.StatedCovariance(result).in_file(reference)
    params = np.einsum("bij,bj->bi", results.to_file(result, reference), result.state.params)
    values, slopes, start = [], np.zeros((len(params), 24, params.shape[-1])), 0
    for index, triad in enumerate(result.problem.triads):
        model = triad.model.finished(reference)[0]
        where = slice(start, start + model.size)
        strength = result.problem.constant(result.state, ("gravity", "field")[index]).mean()
        points = FIELD_DIRECTIONS * strength
        put = factored(model, params[:, where], points, (reference, reference), 0)
        values.append(put.values)
        slopes[:, 12 * index : 12 * index + 12, where] = put.jacobian
        start += model.size
    analysis = result.analysis
    whole = slopes @ covariance @ slopes.mT
    return np.concatenate(values, -1), whole, analysis.variance_factor, analysis.freedom


STEPPED = {"accelerometer bias x": 3, "magnetometer bias x": 15}
"""Places of the parameters that take a step."""
FALSE_ALARMS = (
    Setting(),
    Setting(before=1, after=1),
    Setting(stand="shared"),
    Setting(stand="shared", one_stand=True),
    Setting(declared=False),
    Setting(plan="twelve-state"),
)
POWER = (
    *(Setting(before=b, after=a) for b, a in ((1, 1), (4, 1), (3, 2), (5, 5))),
    *(Setting(stand="exact", before=b, after=a) for b, a in ((3, 2), (5, 5), (8, 8))),
    Setting(stand="shared"),
    *(Setting(plan="twelve-state", before=b, after=a) for b, a in ((3, 2), (5, 5))),
)


@dataclass(frozen=True)
class Power:
    """A step in one setting: share of tools called changed, and what no test could exceed.

    `signal`: the step over its standard uncertainty in the difference of before and after, the other parameters
    being known not to have changed; `marginal`: not being known. `bound`: probability with which the best
    test of that one parameter and that one transition at the same level finds it.
    """

    called: int
    named: int
    tools: int
    signal: float
    marginal: float
    bound: float


def probabilities(setting: Setting, part: int) -> list[float]:
    """Probabilities of unchanged tools."""
    return [change_test(history).probability for history in histories(setting, part)]


def stepped(setting: Setting, part: int) -> dict[str, list[tuple[bool, bool, float, float]]]:
    """Of each tool with a step: called changed, rightly named, signal with the others known and unknown."""
    result: dict[str, list[tuple[bool, bool, float, float]]] = {name: [] for name in STEPPED}
    for history in histories(setting, 1000 + part):
        contrasts, after = Contrasts(history.precision), setting.before
        for name, place in STEPPED.items():
            sd = np.sqrt(np.mean(history.covariance[:, place, place]))
            moved = history.values.copy()
            moved[after:, place] += STEP * sd
            test = change_test(replace(history, values=moved))
            known = np.sqrt(contrasts.information[after - 1, place, place]) / contrasts._unit[place]
            alone = np.linalg.inv(contrasts.information[after - 1])[place, place]
            unknown = 1 / np.sqrt(alone) / contrasts._unit[place]
            named = any((s.place, s.after) == (place, after) for s in test.steps)
            result[name].append((test.changed, named, STEP * sd * known, STEP * sd * unknown))
    return result


def bound(signal: float, level: float = CHANGE_LEVEL) -> float:
    """Power of the best test of one normal variable, either sign, at a level."""
    limit = norm.isf(level / 2)
    return float(norm.sf(limit - signal) + norm.cdf(-limit - signal))


def interval(count: int, tools: int) -> str:
    """A share in per cent with its standard error."""
    share = count / tools
    return f"{100 * share:.1f} ± {100 * np.sqrt(max(share * (1 - share), 1e-9) / tools):.1f} %"


def words(setting: Setting) -> str:
    """A setting in words."""
    noise = "" if setting.declared else ", noise not declared"
    same = ", the same stand errors every time" if setting.one_stand else ""
    return f"{setting.plan}, stand {setting.stand}{noise}{same}"


def false_alarm_rows(tools: int, pool: ProcessPoolExecutor) -> Iterator[str]:
    """Rows of the table of false alarms."""
    for setting in FALSE_ALARMS:
        count = tools if setting == Setting() else min(tools, FEWER)
        parts = pool.map(partial(probabilities, setting), range(-(-count // AT_ONCE)))
        each = np.concatenate([np.array(part) for part in parts])
        shares = " | ".join(
            interval(int(np.sum(each <= level)), len(each)) for level in (0.01, 0.05, 0.2)
        )
        yield f"| {words(setting)} | {setting.count} | {len(each)} | {shares} |"


def power_rows(tools: int, pool: ProcessPoolExecutor) -> Iterator[str]:
    """Rows of the table of power."""
    for setting in POWER:
        parts = list(pool.map(partial(stepped, setting), range(-(-tools // AT_ONCE))))
        for name in STEPPED:
            rows = [row for part in parts for row in part[name]]
            called, named, known, unknown = (np.array(column) for column in zip(*rows, strict=True))
            best = np.mean([bound(s) for s in known])
            yield (
                f"| {words(setting)} | {name} | {setting.before} + {setting.after} | {np.mean(unknown):.2f} | "
                f"{np.mean(known):.2f} | {100 * best:.0f} % | {interval(int(called.sum()), len(called))} | "
                f"{interval(int(named.sum()), len(named))} |"
            )


HEAD = """# Drift: what the tests find (simulated)

Written by `examples/drift/drift.py`; SIMULATED DATA, all of it. See [drift](../howto/drift.md) for what is tested.

## False alarms

Unchanged tools that are called changed, of 12 parameters of each triad and all transitions together. Errors of the
noise estimate, of the settings of the stand and of what all stations of a run share are new for each calibration,
except in the row that says otherwise.

| plan and stand | calibrations | tools | at level 1 % | 5 % | 20 % |
|---|---|---|---|---|---|
"""
POWER_HEAD = """
## Power

A bias takes one step of three standard uncertainties, that of this bias in one calibration. *Signal*: the step over the
standard uncertainty of the difference of before and after, if the other parameters may change too (free), and if they
did not (directed). *Bound*: what the best test of this one parameter at this one transition finds at a level of 1 %
(Neyman and Pearson, either sign), which knows where to look. A signal of 3.42 is needed for 80 %.

| plan and stand | step of | before + after | signal, free | signal, directed | bound | changed | rightly named |
|---|---|---|---|---|---|---|---|
"""


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser()
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/evidence/drift-tables.md"))
    parser.add_argument("--tools", type=int, default=1000)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--workers", type=int)
    options = parser.parse_args()
    with ProcessPoolExecutor(options.workers) as pool:
        parts = [
            HEAD, *(f"{row}\n" for row in false_alarm_rows(options.tools, pool)),
            POWER_HEAD, *(f"{row}\n" for row in power_rows(options.steps, pool)),
        ]  # fmt: skip
    options.output.write_text("".join(parts), "utf-8")


if __name__ == "__main__":
    main()
