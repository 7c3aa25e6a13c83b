"""Are tools beyond their limits on the day they are due? Walks of 0.3 to 100 standard uncertainties a year.

    python examples/coverage/due_dates.py        (writes docs/evidence/coverage/due_dates.md; a minute or two)

A tool is calibrated every year while its parameters walk, it walks on to the day on which `mwdcal registry drift` says
that it is due, and there the last calibration is applied to what it reads. The calibrations after the first are
the true parameters with errors drawn from its covariance: how well that holds is studied elsewhere.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from datetime import date, timedelta

import numpy as np
import world
from msgspec.structs import replace

import mwdcal
from mwdcal.calibration.record import Calibration
from mwdcal.drift.document import ToolDrift
from mwdcal.drift.histories import RISK
from mwdcal.drift.tool import MeasuredTool, TypeRates, measured, predicted
from mwdcal.sensor.profile import Profile, StandProfile, TriadProfile

RATES = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
"""Walk of a year over the standard uncertainty of the parameters of a kind in one calibration."""
COUNTS = (2, 3, 5)
"""Yearly calibrations of each tool."""
LIMITS = {"inclination": 0.1, "azimuth": 1.0}
KINDS = [slice(0, 3), slice(3, 6), slice(6, 12), slice(12, 15), slice(15, 18), slice(18, 24)]
"""Scales, biases and misalignments of both triads among the parameters of a calibration."""
CROSS = ~np.eye(3, dtype=bool)
FIRST = date(2020, 1, 1)
YEAR = 365.25
PROFILE = Profile(
    name="due",
    accelerometer=TriadProfile(noise=1e-4),
    magnetometer=TriadProfile(noise=15.0),
    stand=StandProfile(inclination_deg=0.01, azimuth_deg=0.05, toolface_deg=0.02),
)


def calibrated(rng: np.random.Generator) -> Calibration:
    """The first calibration of a tool, on a stand with 48 attitudes."""
    tools, attitudes = world.tool(rng), np.stack(world.grid())
    count = attitudes.shape[1]
    errors = np.array([[0.01], [0.05], [0.02]]) * rng.normal(size=attitudes.shape)
    fields = world.vectors(*(attitudes + errors))
    columns = {"temperature_c": np.full(count, 30.0), "ref_gravity_g": np.ones(count)}
    columns |= {
        "ref_field_nt": np.full(count, world.FIELD),
        "ref_dip_deg": np.full(count, world.DIP),
    }
    for name, angle in zip(("inclination", "azimuth", "toolface"), attitudes, strict=True):
        columns[f"ref_{name}_deg"] = angle
    for letter, triad, field, noise in zip("am", tools, fields, (1e-4, 15.0), strict=True):
        raw = triad.raw(field) + noise * rng.normal(size=field.shape)
        columns |= {f"{letter}{axis}": raw[:, i] for i, axis in enumerate("xyz")}
    readings = mwdcal.read_run(columns, PROFILE)
    return mwdcal.calibrate(readings, order=0, model="factors", nonlinearity="none")


def triads(parameters: np.ndarray) -> Iterator[world.Triad]:
    """Accelerometer and magnetometer of parameters (24,): scales, biases and cross-axis terms of each."""
    for scale, bias, off in (np.split(part, [3, 6]) for part in np.split(parameters, 2)):
        cross = np.zeros((3, 3))
        cross[CROSS] = off
        yield world.Triad(scale[:, None], bias[:, None], cross)


def largest_errors(true: np.ndarray, applied: np.ndarray) -> dict[str, float]:
    """The largest error of inclination and azimuth at 45° inclination of a tool with a calibration applied."""
    azimuth, toolface = (
        v.ravel() for v in np.meshgrid(np.arange(0, 360, 30), np.arange(0, 360, 30))
    )
    fields = world.vectors(45.0, azimuth, toolface)
    seen = [
        (triad.raw(field) / fit.scale[:, 0] - fit.bias[:, 0]) @ (np.eye(3) - fit.cross).T
        for triad, fit, field in zip(triads(true), triads(applied), fields, strict=True)
    ]
    got, expected = world.angles(*seen), {"inclination": 45.0, "azimuth": azimuth}
    return {n: float(np.abs(world.turned(got[n] - expected[n])).max()) for n in LIMITS}


class History:
    """A tool whose parameters walk, and its yearly calibrations."""

    def __init__(
        self, first: Calibration, rate: float, count: int, serial: str, rng: np.random.Generator
    ):
        sd = np.sqrt(np.diag(first.parameter_covariance))
        self.yearly, self.rng = np.zeros(24), rng
        for kind in KINDS:
            self.yearly[kind] = rate * np.sqrt(np.mean(sd[kind] ** 2))
        root = np.linalg.cholesky(first.parameter_covariance / np.outer(sd, sd))
        self.true, self.calibrations = first.parameters.copy(), []
        for year in range(count):
            self.true = self.true + bool(year) * self.yearly * rng.normal(size=24)
            self.applied = self.true + sd * (root @ rng.normal(size=24))
            self.day = FIRST + timedelta(days=round(year * YEAR))
            self.calibrations.append(self.stated(first, serial))
        self.tool: MeasuredTool = measured(serial, self.calibrations, tested=False)

    def stated(self, first: Calibration, serial: str) -> Calibration:
        """A calibration with other parameters, of another day."""
        parts = np.split(self.applied, 2)
        both = {
            t.name: replace(t, parameters=p.tolist())
            for t, p in zip(first.triads, parts, strict=True)
        }
        return replace(
            first, tool={"serial": serial, "date": str(self.day)}, station_rows=[], **both
        )

    def beyond(self, drift: ToolDrift) -> dict[str, bool]:
        """Whether the error is beyond each limit on the day it is due, and beyond any on that of the tool."""
        result = {}
        for name, day in [*((d.angle, d.due) for d in drift.due), ("any", drift.next_due)]:
            years = (date.fromisoformat(str(day)) - self.day).days / YEAR
            later = self.true + np.sqrt(years) * self.yearly * self.rng.normal(size=24)
            errors = largest_errors(later, self.applied)
            result[name] = any(errors[n] > LIMITS[n] for n in LIMITS if name in (n, "any"))
        return result


def rows(
    histories: Sequence[History], rates: Sequence[float], alone: bool
) -> Iterator[list[object]]:
    """Rows by rate: of tools that have no peers, or of one type with all others."""
    shared = TypeRates.of([each.tool for each in histories])
    drifts = [
        predicted(h.tool, TypeRates.of([h.tool]) if alone else shared, LIMITS) for h in histories
    ]
    beyond = [h.beyond(d) for h, d in zip(histories, drifts, strict=True)]
    days = np.array(
        [
            (date.fromisoformat(str(d.next_due)) - h.day).days
            for h, d in zip(histories, drifts, strict=True)
        ]
    )
    for rate in [*RATES, None]:
        mine = [i for i, each in enumerate(rates) if rate in (each, None)]
        shares = [world.percent(np.mean([beyond[i][n] for i in mine])) for n in (*LIMITS, "any")]
        name = "all" if rate is None else f"{rate:g} σ"
        yield [name, len(mine), f"{np.median(days[mine]):.0f}", *shares]


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser()
    parser.add_argument(
        "--count", type=int, default=60, help="tools of each rate and number of calibrations"
    )
    count = parser.parse_args().count
    rng = np.random.default_rng(20261124)
    first = [calibrated(rng) for _ in range(10)]
    error = world.percent(np.sqrt(RISK * (1 - RISK) / count))
    heads = ["walk a year", "histories", "days to due, median", *LIMITS, "any limit"]
    parts = [HEAD.format(risk=world.percent(RISK), count=count, error=error, **LIMITS)]
    for calibrations in COUNTS:
        rates = [rate for rate in RATES for _ in range(count)]
        histories = [
            History(first[i % len(first)], rate, calibrations, f"T-{i}", rng)
            for i, rate in enumerate(rates)
        ]
        for alone, words in ((True, "no other tool of the type"), (False, "all tools of one type")):
            parts += [
                f"\n## {calibrations} yearly calibrations, {words}\n",
                world.table(heads, rows(histories, rates, alone)),
            ]
    total = len(RATES) * count * len(COUNTS)
    world.write(
        "due_dates", "Due dates: share beyond the limit", *parts, facts={"Histories": total}
    )


HEAD = """Stated: on the day that is given as due a tool is beyond its limit with a probability of **{risk}**.
Measured: the share of tools whose largest error over azimuth and toolface, at 45° inclination, exceeds the limit on
that day ({inclination}° in inclination, {azimuth}° in azimuth). σ is the standard uncertainty of the parameters of a
kind in one calibration. Tools that are good for five years and more are due after five. Each history counts twice:
with no other tool of its type to learn the walk from, and among tools that walk at all of these rates. Where the true
risk is 5 %, a share of {count} histories has a standard error of {error}.
"""


if __name__ == "__main__":
    main()
