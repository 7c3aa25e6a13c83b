"""Calibrations with an earlier one of the same tool as prior, after another turn-on and a walk since.

make coverage STUDY=priors        (writes docs/evidence/coverage/priors.md)
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import world

import mwdcal

RUNS, SEED = 200, 20261124
NOISE = {"accelerometer": 1e-4, "magnetometer": 15.0}
TURN_ON, BIAS_WALK, SCALE_WALK = (4e-4, 70.0), (4e-4, 70.0), (5e-4, 1.6e-3)
"""1σ of the bias of a turn-on, of the walk of bias and of scale in a year: g and nT, shares."""
ATTITUDES = 20
ANGLES = ("inclination", "azimuth", "toolface", "dip")
CASES = ((12, 0.5, 1.0), (12, 1.0, 1.0), (12, 2.0, 1.0), (24, 1.0, 1.0), (12, 1.0, 0.0))
"""Stations of the later run, years between the runs, and the changes in units of their 1σ."""


def later(
    rng: np.random.Generator, tool: tuple[world.Triad, ...], years: float, size: float
) -> list[world.Triad]:
    """The tool after some years, before it is switched on."""
    root, aged = size * np.sqrt(years), []
    for triad, bias, scale in zip(tool, BIAS_WALK, SCALE_WALK, strict=True):
        walked = triad.bias + root * bias * rng.normal(size=triad.bias.shape)
        stretched = triad.scale * (1 + root * scale * rng.normal(size=triad.scale.shape))
        aged.append(replace(triad, bias=walked, scale=stretched))
    return aged


def switched_on(
    rng: np.random.Generator, tool: tuple[world.Triad, ...] | list[world.Triad], size: float
) -> list[world.Triad]:
    """The tool with the biases of one turn-on."""
    pairs = zip(tool, TURN_ON, strict=True)
    return [replace(t, bias=t.bias + size * sd * rng.normal(size=t.bias.shape)) for t, sd in pairs]


def run(
    rng: np.random.Generator, tool: list[world.Triad], toolfaces: int, date: str
) -> mwdcal.Readings:
    """A run at four directions on an exact stand."""
    attitude = world.grid(toolfaces=toolfaces)
    fields = world.vectors(*attitude)
    raw = [
        triad.raw(field) + sd * rng.normal(size=field.shape)
        for triad, field, sd in zip(tool, fields, NOISE.values(), strict=True)
    ]
    names = ("inclination_deg", "azimuth_deg", "toolface_deg")
    known = dict(zip(names, attitude, strict=True))
    known |= {"gravity": 1.0, "field": world.FIELD, "dip_deg": world.DIP}
    return mwdcal.readings(*raw, **known, sd=NOISE, metadata={"serial": "A1", "date": date})


def covers(rng: np.random.Generator, stations: int, years: float, size: float) -> dict[str, list]:
    """Whether 95 % intervals of angles, with the earlier calibration as prior, hold the truth."""
    tool = world.tool(rng)
    first = mwdcal.calibrate(run(rng, switched_on(rng, tool, size), 12, "2025-01-01"), order=0)
    now = switched_on(rng, later(rng, tool, years, size), size)
    day = str(np.datetime64("2025-01-01") + int(365.25 * years))
    made = mwdcal.calibrate(run(rng, now, stations // 4, day), order=0, prior=first)
    tilt = np.degrees(np.arccos(rng.uniform(-0.9, 0.95, ATTITUDES)))
    attitude = (tilt, rng.uniform(0, 360, ATTITUDES), rng.uniform(0, 360, ATTITUDES))
    fields = world.vectors(*attitude)
    readings = mwdcal.readings(*(t.raw(f) for t, f in zip(now, fields, strict=True)))
    seen = world.angles(*made.fields(readings))
    truth = dict(zip(ANGLES, (*attitude, np.full(ATTITUDES, world.DIP)), strict=True))
    hits = {}
    for name in ANGLES:
        sd = np.degrees(made.uncertainty(name, readings))
        hits[name] = [world.covered(world.turned(seen[name] - truth[name]), sd)]
    conflict = any(
        "prior" in finding.id and finding.id != "prior-aged" for finding in made.findings
    )
    return hits | {"conflict": [float(conflict)]}


def main() -> None:
    """Write the page."""
    rows = []
    for number, case in enumerate(CASES):
        rng, found = np.random.default_rng([SEED, number]), {}
        for _ in range(RUNS):
            for name, hit in covers(rng, *case).items():
                found.setdefault(name, []).extend(hit)
        cells = [world.percent(np.mean(found[name])) for name in (*ANGLES, "conflict")]
        rows.append([case[0], f"{case[1]:g}", f"{case[2]:g}", *cells])
        print(*rows[-1], flush=True)
    heads = ["stations", "years", "changes, in their 1σ", *ANGLES, "conflict found"]
    world.write("priors", "Priors that age", ABOUT, world.table(heads, rows),
                facts={"Runs of each row": RUNS, "Seed": SEED})  # fmt: skip


ABOUT = """\
A tool is calibrated with 48 stations. Years later it is switched on again and calibrated with few stations, the
earlier calibration being the prior. Between the runs each bias changes by two turn-ons (0.4 mg, 70 nT) and a walk
(0.4 mg, 70 nT in a year), each scale by a walk (0.05 %, 0.16 % in a year): what mwdcal assumes where the profile states
nothing. Noise 0.1 mg and 15 nT, declared; stand and references exact. Each cell is the share of errors of noise-free
readings at 20 random attitudes within 1.96 stated standard uncertainties.
"""

if __name__ == "__main__":
    main()
