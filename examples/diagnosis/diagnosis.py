"""How often `diagnose` names the right fault: simulated tools with each fault, and without.

    make diagnosis        (writes docs/evidence/diagnosis.md; hours with 1000 tools)

Every case has a tool, a calibration and later readings of its own. Faults are simulated by their physics
(`mwdcal.faults.likelihood`: exact, not to first order), of the sizes that `mwdcal simulate` draws. All data are
simulated. A script of your own needs `import mwdcal` alone; this one makes thousands of tools at once.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.faults.diagnosis import diagnose
from mwdcal.faults.likelihood import FAULTS, HEAT, NONE
from mwdcal.files.profiles import load_profile
from mwdcal.planning.plans import (
    Effects,
    FaultEffect,
    StationPlan,
    drawn,
    grid,
    load_plan,
    simulated,
)
from mwdcal.planning.session import Session

KINDS = (NONE, *FAULTS)
SCENES = {
    "roll": "a roll test on the stand, 12 stations at 25 °C, with references",
    "two soaks": "the same at 25 °C and at 100 °C, 24 stations",
    "surveys": "12 surveys in a well, at 50 °C to 105 °C, without references for the attitude",
}
PROFILE = load_profile("servo")[0]
EARTH_SD = {"gravity": 1e-4, "field": 20.0, "dip": np.radians(0.03)}
"""Uncertainty of the references of surveys: in-field referencing (OWSG, IFR)."""
DRAWS = 999
SEED = 20261123


def later(scene: str, rng: np.random.Generator) -> Readings:
    """The session of later readings, with references and uncertainties, readings blank."""
    if scene == "surveys":
        count = 12
        angles = np.radians(np.linspace(8, 88, count)), rng.uniform(0, 2 * np.pi, (2, count))
        plan = StationPlan(angles[0], *angles[1], np.linspace(50.0, 105.0, count))
    else:
        plan = grid([5, 45, 90], 4, [0, 120, 240], [25.0] if scene == "roll" else [25.0, 100.0])
    model = Session.of(load_plan("roll-test"), PROFILE).readings
    sd = {name: np.broadcast_to(value.ravel()[0], (plan.count, 3) if name.endswith("meter") else plan.count)
          for name, value in ((n, np.asarray(v)) for n, v in model.sd.items())}  # fmt: skip
    blank = np.zeros((plan.count, 3))
    known = {"inclination": plan.inclination, "azimuth": plan.azimuth, "toolface": plan.toolface}
    known |= {"gravity": np.ones(plan.count), "field": np.full(plan.count, 48_000.0)}
    known |= {"dip": np.full(plan.count, np.radians(63.0))}
    if scene == "surveys":
        sd = {name: value for name, value in sd.items() if name.endswith("meter")}
        sd |= {name: np.full(plan.count, size) for name, size in EARTH_SD.items()}
    return Readings(blank, blank, plan.temperature, known, sd, profile=PROFILE)


def case(task: tuple[int, str, str]) -> tuple[str, str, str, bool, list[float]]:
    """One tool: what was named first, whether the true fault was reported, and errors of its sizes in their 1σ."""
    number, scene, kind = task
    calibration, truth = tool(number)
    rng = np.random.default_rng([SEED, number, list(SCENES).index(scene), KINDS.index(kind)])
    fault = FaultEffect(kind=kind)
    if kind == "dead-channel":
        channel = ("ax", "ay", "az", "mx", "my", "mz")[rng.integers(6)]
        reading = rng.uniform(-1, 1) * (1.0 if channel[0] == "a" else 48_000.0)
        hot = 80.0 if scene != "roll" and rng.random() < 0.5 else None
        fault = FaultEffect(kind=kind, channel=channel, reading=reading, above_c=hot)
    result = simulated(truth, later(scene, rng), rng, Effects(fault=fault))
    readings = result.readings
    if scene == "surveys":
        known = {name: readings.known[name] for name in EARTH_SD}
        readings = replace(readings, known=known)
    named = diagnose(calibration, readings, draws=DRAWS)
    reported = kind in (named.fault, *named.confounded_with)
    return kind, scene, named.fault, reported, scores(named, result, kind, scene)


def scores(named, result, kind: str, scene: str) -> list[float]:
    """Errors of the sizes over their 1σ of a fault that is named rightly."""
    if named.fault != kind or kind in (NONE, "dead-channel", "impact"):
        return []
    damage, each = result.damage, []
    for row in named.parameters:
        name, factor, place = located(row, kind)
        true = damage.departures[_places(name)][place] * factor
        if row.parameter == "field north" and scene == "surveys":
            true = strengthened(*damage.part("disturbance")[0, :2])
        each.append((row.size - true) / row.uncertainty)
    return each


def strengthened(north: float, east: float) -> float:
    """By how much a disturbance changes the horizontal strength of the field: all that no azimuth is needed for."""
    level = 48_000.0 * np.cos(np.radians(63.0))
    return float(np.hypot(level + north, east) - level)


def _places(name: str) -> slice:
    from mwdcal.faults.likelihood import DEPARTURES

    return DEPARTURES[name]


def located(row, kind: str) -> tuple[str, float, int]:
    """Where the true value of a size is among the departures, and its unit."""
    channels = ("ax", "ay", "az", "mx", "my", "mz")
    if kind == "magnetised":
        return "iron", 1.0, "xyz".index(row.parameter[-1])
    if kind == "casing":
        return "disturbance", 1.0, ("north", "east", "down").index(row.parameter.split()[-1])
    place = channels.index(row.channel)
    if row.parameter == "scale drift":
        return "drift-scale", 1e6, place
    factor = 1e3 if place < 3 else 1.0
    return ("drift-bias" if kind == "heat" else "turn-on"), factor, place


@cache
def tool(number: int):
    """A tool and its calibration, with the errors of 12 attitudes at 4 soaks."""
    rng = np.random.default_rng([SEED, number])
    session = Session.of(load_plan("laboratory-thermal"), PROFILE)
    truth = drawn(rng, PROFILE, 1)
    readings = session.measured(truth, rng).readings
    return calibrate(
        replace(readings, profile=PROFILE), PROFILE, Options(order=1, nonlinearity="none")
    ), truth


def cases_of(number: int) -> list:
    """All cases of one tool."""
    done = [case((number, scene, kind)) for scene in SCENES for kind in KINDS]
    tool.cache_clear()
    return done


def studied(count: int, first: int = 0) -> list:
    """All cases of many tools, by all cores."""
    with multiprocessing.Pool() as pool:
        return [
            c
            for many in pool.imap(cases_of, range(first, first + count), chunksize=4)
            for c in many
        ]


def page(results: list, count: int) -> str:
    """The page of documentation."""
    lines = [HEAD.format(count=count)]
    for scene, words in SCENES.items():
        lines += [f"## {words[0].upper()}{words[1:]}", "", *confusion(results, scene), ""]
    lines += ["## Sizes", "", SIZES, "", *coverage(results)]
    return "\n".join(lines) + "\n"


def confusion(results: list, scene: str) -> Iterable[str]:
    """Rows: what the tool has; columns: what is named first, per cent; then how often it is reported at all."""
    yield "| has | " + " | ".join(KINDS) + " | reported | 95 % interval |"
    yield "|---" * (len(KINDS) + 3) + "|"
    for kind in KINDS:
        if kind == HEAT and scene == "roll":
            continue
        named = [r[2] for r in results if r[0] == kind and r[1] == scene]
        shares = [100 * named.count(other) / len(named) for other in KINDS]
        cells = [
            f"**{s:.1f}**" if other == kind else f"{s:.1f}"
            for other, s in zip(KINDS, shares, strict=True)
        ]
        right = sum(r[3] for r in results if r[0] == kind and r[1] == scene)
        low, high = binomtest(right, len(named)).proportion_ci(method="wilson")
        share = f" | {100 * right / len(named):.1f} | {100 * low:.1f}…{100 * high:.1f} |"
        yield f"| {kind} | " + " | ".join(cells) + share


def coverage(results: list) -> Iterable[str]:
    """How often the true size lies within 1σ and 1.96σ, of faults that are named rightly."""
    yield "| readings | fault | sizes | within 1σ | within 1.96σ |"
    yield "|---|---|---|---|---|"
    for scene in SCENES:
        for kind in FAULTS:
            each = np.array([z for r in results if r[0] == kind and r[1] == scene for z in r[4]])
            if each.size:
                inside = [f"{100 * np.mean(np.abs(each) < k):.1f} %" for k in (1, 1.96)]
                yield f"| {scene} | {kind} | {each.size} | {inside[0]} | {inside[1]} |"


HEAD = """# Which fault: the confusion tables

Written by `make diagnosis`. SIMULATED DATA: {count} tools for each row, each with a calibration of its own
(`laboratory-thermal`, profile `servo`, order 1) and later readings. Faults have the sizes of
[the table](../howto/diagnose.md#the-faults), drawn between half and one and a half times that, of either sign; a dead
channel reads any constant, in half of the cases with more than one temperature only above 80 °C. Rows: what the tool
has; columns: what `diagnose` names first, per cent. *Reported*: named first, or as a cause that these readings
cannot tell from it, with the 95 % interval. A bias of a magnetometer channel and the field of a string along it are one
thing at any attitude: then the string is named first. Heat does not show at one temperature.
"""
SIZES = """Of the faults that are named rightly: how often the true size lies within the stated uncertainty (68.3 % and
95 % if it is right)."""


def main() -> None:
    """Write the page, or print it."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=1000, help="tools; 40 take ten minutes")
    parser.add_argument(
        "--output",
        type=Path,
        default=Path(__file__).parents[2] / "docs" / "evidence" / "diagnosis.md",
    )
    options = parser.parse_args()
    options.output.write_text(page(studied(options.count), options.count), "utf-8")


if __name__ == "__main__":
    main()
