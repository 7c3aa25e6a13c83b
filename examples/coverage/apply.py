"""Corrected readings against the truth: how often value ± 2σ of the columns of `mwdcal apply` contains it.

Run: python examples/coverage/apply.py
"""

from __future__ import annotations

import numpy as np
import world

import mwdcal

RUNS, SHOTS = 200, 12
NOISE = (1e-4, 15.0)
INCLINATIONS = (0.002, 0.01, 0.03, 0.1, 0.3, 1.0, 5.0, 30.0, 60.0, 90.0, 150.0, 179.9, 179.99)
SHOWN = ("inclination", "azimuth", "toolface", "gravity", "field", "dip")
COLUMNS = dict(
    zip(
        SHOWN,
        ("inclination_deg", "azimuth_deg", "toolface_deg", "gravity_g", "field_nt", "dip_deg"),
        strict=True,
    )
)
SEED = 8


def noisy(rng: np.random.Generator, tool: tuple[world.Triad, world.Triad], vectors: tuple) -> list:
    """Readings of both triads with noise."""
    pairs = zip(tool, vectors, NOISE, strict=True)
    return [triad.raw(v) + sd * rng.normal(size=v.shape) for triad, v, sd in pairs]


def calibrated(rng: np.random.Generator, tool: tuple, declared: bool) -> mwdcal.Calibration:
    """The calibration of a run of 48 stations with exact references."""
    inclination, azimuth, toolface = world.grid()
    readings = noisy(rng, tool, world.vectors(inclination, azimuth, toolface))
    run = mwdcal.readings(
        *readings,
        temperature=30.0,
        inclination=np.radians(inclination),
        azimuth=np.radians(azimuth),
        toolface=np.radians(toolface),
        gravity=1.0,
        field=world.FIELD,
        dip=np.radians(world.DIP),
        sd=dict(zip(("accelerometer", "magnetometer"), NOISE, strict=True)) if declared else None,
    )
    return mwdcal.calibrate(run)


def main() -> None:
    """Both tables, of declared and of estimated noise."""
    rng = np.random.default_rng(SEED)
    parts = []
    for declared in (True, False):
        errors = {name: np.full((len(INCLINATIONS), RUNS, SHOTS), np.nan) for name in SHOWN}
        sd = {name: errors[name].copy() for name in SHOWN}
        for run in range(RUNS):
            tool = world.tool(rng)
            made = calibrated(rng, tool, declared)
            inclination = np.repeat(INCLINATIONS, SHOTS)
            azimuth, toolface = rng.uniform(0, 360, (2, len(inclination)))
            vectors = world.vectors(inclination, azimuth, toolface)
            found = mwdcal.apply(
                made, mwdcal.readings(*noisy(rng, tool, vectors), temperature=30.0)
            ).columns
            truth = {
                "inclination": inclination,
                "azimuth": azimuth,
                "toolface": toolface,
                "gravity": 1.0,
            }
            truth |= {"field": world.FIELD, "dip": world.DIP}
            for name, column in COLUMNS.items():
                error = found[column] - truth[name]
                if name in ("azimuth", "toolface"):
                    error = world.turned(error)
                errors[name][:, run] = error.reshape(-1, SHOTS)
                sd[name][:, run] = found[f"sd_{column}"].reshape(-1, SHOTS)
        rows = []
        for k, inclination in enumerate(INCLINATIONS):
            blank = np.mean(np.isnan(sd["toolface"][k]))
            shares = [
                "–"
                if np.isnan(sd[name][k]).all()
                else world.percent(world.covered(errors[name][k], sd[name][k]))
                for name in SHOWN
            ]
            wrong = np.mean(np.abs(errors["toolface"][k]) > 1.96 * sd["toolface"][k])
            cells = (world.percent(share) for share in (blank, wrong))
            rows.append([f"{inclination:g}°", *cells, *shares])
        said = "declared" if declared else "estimated"
        parts.append(f"## Noise {said}\n")
        parts.append(world.table(["inclination", "toolface blank", "wrong", *SHOWN], rows))
    world.write(
        "apply",
        "Corrected readings",
        "Every run is another tool, calibrated at 48 attitudes with exact references, and read at twelve random "
        "azimuths and toolfaces at each inclination. The tables count the values within 1.96 of the σ printed "
        "beside them; *wrong* are toolfaces beyond it, as a share of all readings, blank ones included.\n",
        "Within about 3σ of vertical (here 0.02°) azimuth and toolface are blank. A tool that stands closer has a "
        "value only where noise tilts it further, and that value is often wrong: the intervals of the few that are"
        " left hold less often than 95 %. The inclination is then the length of a small vector, which noise can "
        "only lengthen; `Calibration.expanded_uncertainty` allows for that.\n",
        *parts,
        facts={"Runs of each table": RUNS, "readings of each row": RUNS * SHOTS, "seed": SEED},
    )


if __name__ == "__main__":
    main()
