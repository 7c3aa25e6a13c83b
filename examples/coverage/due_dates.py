"""Are tools beyond their limits on the day they are due? Walks of 0.3 to 100 standard uncertainties a year.

And in fleets of mixed tools: do the rates and the forecast of accuracy hold the truth?

    python examples/coverage/due_dates.py        (writes docs/evidence/coverage/due_dates.md; a minute or two)

A tool is calibrated every year while its parameters walk, it walks on to the day on which `mwdcal registry drift` says
that it is due, and there the last calibration is applied to what it reads. The calibrations after the first are
the true parameters with errors drawn from its covariance: how well that holds is studied elsewhere.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from datetime import date, timedelta

import numpy as np
import world
from msgspec.structs import replace

import mwdcal
from mwdcal.calibration.record import Calibration
from mwdcal.drift.document import ToolDrift
from mwdcal.drift.histories import RISK
from mwdcal.drift.tool import MeasuredTool, TypeRates, measured, predicted
from mwdcal.drift.walk import WALK_GROUPS
from mwdcal.sensor.profile import Profile, StandProfile, TriadProfile

RATES = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
"""Walk of a year over the standard uncertainty of the parameters of a kind in one calibration."""
COUNTS = (2, 3, 5)
"""Yearly calibrations of each tool."""
LIMITS = {"inclination": 0.1, "azimuth": 1.0}
KINDS = [slice(0, 3), slice(3, 6), slice(6, 12), slice(12, 15), slice(15, 18), slice(18, 24)]
"""Scales, biases and misalignments of both triads among the parameters of a calibration."""
FLEETS, MEMBERS, KNOCKED = 5, 40, 0.05
"""Mixed fleets, tools of each, and the share that is knocked once: biases by 20 standard uncertainties."""
MIXED_RATES = dict(zip(WALK_GROUPS, (1.0, 3.0, 0.0, 1.0, 3.0, 0.0), strict=True))
"""Walk of a year of each kind in a mixed fleet, as above; that of a tool differs by a factor of 1.33 (1σ)."""
MIXED_LIMITS = {"inclination": 0.025, "azimuth": 0.12}
AHEAD = (0.5, 1.0, 2.0, 4.0)
"""Years after a calibration at which its error is compared with the forecast."""
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


def angle_errors(
    true: np.ndarray, applied: np.ndarray, azimuth: np.ndarray, toolface: np.ndarray
) -> dict[str, np.ndarray]:
    """Errors (n,) of the angles at 45° inclination of a tool with a calibration applied, degrees."""
    fields = world.vectors(45.0, azimuth, toolface)
    seen = [
        (triad.raw(field) / fit.scale[:, 0] - fit.bias[:, 0]) @ (np.eye(3) - fit.cross).T
        for triad, fit, field in zip(triads(true), triads(applied), fields, strict=True)
    ]
    got = world.angles(*seen)
    expected = {"inclination": 45.0, "azimuth": azimuth, "toolface": toolface}
    return {name: world.turned(got[name] - value) for name, value in expected.items()}


def largest_errors(true: np.ndarray, applied: np.ndarray) -> dict[str, float]:
    """The largest error of inclination and azimuth at 45° inclination of a tool with a calibration applied."""
    turns = np.meshgrid(np.arange(0, 360, 30), np.arange(0, 360, 30))
    errors = angle_errors(true, applied, *(turn.ravel() for turn in turns))
    return {name: float(np.abs(errors[name]).max()) for name in LIMITS}


class History:
    """A tool whose parameters walk, and its yearly calibrations."""

    def __init__(
        self, first: Calibration, rates: Sequence[float], gaps: Sequence[float], serial: str,
        rng: np.random.Generator, knock: int = 0,
    ):  # fmt: skip
        """`rates` by kind; `gaps`: years since the calibration before; `knock`: which follows a knock, if any."""
        sd = np.sqrt(np.diag(first.parameter_covariance))
        self.yearly, self.rng = np.zeros(24), rng
        for kind, rate in zip(KINDS, rates, strict=True):
            self.yearly[kind] = rate * np.sqrt(np.mean(sd[kind] ** 2))
        root = np.linalg.cholesky(first.parameter_covariance / np.outer(sd, sd))
        self.true, self.calibrations = first.parameters.copy(), []
        for number, gap in enumerate(gaps):
            self.true = self.true + np.sqrt(gap) * self.yearly * rng.normal(size=24)
            if knock and number == knock:
                self.true[KINDS[1]] += 20 * sd[KINDS[1]] * rng.normal(size=3)
            self.applied = self.true + sd * (root @ rng.normal(size=24))
            self.day = FIRST + timedelta(days=round(sum(gaps[: number + 1]) * YEAR))
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

    def later(self, years: float) -> np.ndarray:
        """True parameters some years after the last calibration."""
        return self.true + np.sqrt(years) * self.yearly * self.rng.normal(size=24)

    def beyond(self, drift: ToolDrift, limits: Mapping[str, float] = LIMITS) -> dict[str, bool]:
        """Whether the error is beyond each limit on the day it is due, and beyond any on that of the tool."""
        result = {}
        for name, day in [*((d.angle, d.due) for d in drift.due), ("any", drift.next_due)]:
            years = (date.fromisoformat(str(day)) - self.day).days / YEAR
            errors = largest_errors(self.later(years), self.applied)
            result[name] = any(errors[n] > limits[n] for n in limits if name in (n, "any"))
        return result

    def held(self, drift: ToolDrift) -> dict[str, list[bool]]:
        """Whether 90 % intervals of the rates, and 1σ and 1.96σ of the forecast, hold the truth."""
        result: dict[str, list[bool]] = {}
        for rate in drift.rates:
            kind = KINDS[WALK_GROUPS.index((rate.triad, rate.kind))]
            true = self.yearly[kind][0] * (np.degrees(1) if rate.unit == "°" else 1.0)
            if true:
                name = f"rate of {rate.kind}, 90 %"
                result.setdefault(name, []).append(rate.low <= true <= rate.high)
        for years in AHEAD:
            later = self.later(years)
            azimuth, toolface = self.rng.uniform(0, 360, (2, 40))
            errors = angle_errors(later, self.applied, azimuth, toolface)
            for each in drift.forecast:
                sd = np.interp(years, each.years, each.sd_deg)
                for width, share in ((1.0, 68), (1.96, 95)):
                    inside = np.abs(errors[each.angle]) < width * sd
                    result.setdefault(f"{each.angle}, {share} %", []).extend(inside.tolist())
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


def mixed(seed: int) -> Iterator[list[object]]:
    """Rows of mixed fleets: what is stated, and the shares with all tools and without peers."""
    shares: list[dict[str, list[bool]]] = [{}, {}]
    for fleet in range(FLEETS):
        rng = np.random.default_rng([seed, fleet])
        first = [calibrated(rng) for _ in range(4)]
        tools = [mixed_tool(first[i % len(first)], f"F{fleet}-{i}", rng) for i in range(MEMBERS)]
        together = TypeRates.of([each.tool for each in tools])
        for alone, store in enumerate(shares):
            for each in tools:
                rates = TypeRates.of([each.tool]) if alone else together
                drift = predicted(each.tool, rates, MIXED_LIMITS)
                due = each.beyond(drift, MIXED_LIMITS)
                beyond = {f"beyond {n} when due, 5 %": [value] for n, value in due.items()}
                for name, values in {**each.held(drift), **beyond}.items():
                    store.setdefault(name, []).extend(values)
    for name, values in shares[0].items():
        yield [name, *(world.percent(np.mean(v)) for v in (values, shares[1][name]))]


def mixed_tool(first: Calibration, serial: str, rng: np.random.Generator) -> History:
    """A tool of a mixed fleet: 3 to 8 calibrations at irregular dates."""
    rates = np.array([*MIXED_RATES.values()]) * 10 ** (0.125 * rng.normal(size=6))
    count = int(rng.integers(3, 9))
    gaps = [0.0, *rng.uniform(0.3, 2.0, count - 1)]
    knock = int(rng.integers(1, count)) if rng.uniform() < KNOCKED else 0
    return History(first, rates.tolist(), gaps, serial, rng, knock)


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
            History(
                first[i % len(first)], [rate] * 6, [0.0, *[1.0] * (calibrations - 1)], f"T-{i}", rng
            )
            for i, rate in enumerate(rates)
        ]
        for alone, words in ((True, "no other tool of the type"), (False, "all tools of one type")):
            parts += [
                f"\n## {calibrations} yearly calibrations, {words}\n",
                world.table(heads, rows(histories, rates, alone)),
            ]
    parts += [MIXED, world.table(["stated", "with peers", "no peers"], mixed(20261127))]
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

MIXED = f"""
## Mixed fleets

{FLEETS} fleets of {MEMBERS} tools, 3 to 8 calibrations at intervals of 0.3 to 2 years. Scales walk by 1 σ a year,
biases by 3 σ, misalignments not at all; the rates of the tools differ by a factor of 1.33 (1σ). One tool in 20 was
knocked. Limits: 0.025° in inclination, 0.12° in azimuth. The forecast is compared after 0.5, 1, 2 and 4 years:
"""


if __name__ == "__main__":
    main()
