"""The peer of the cave instruments, refitted without each shot: writes examples/measured/peers.csv.

    build/bench-venv/bin/python examples/measured/peers.py

Needs circuitpython-mag-cal (`make bench` installs it) and the sets in MWDCAL_DATA. `make measured` prints the figures.
"""

from __future__ import annotations

import csv
import os
from pathlib import Path

import numpy as np
from mag_cal import Calibration

SETS = (
    *(f"sap6/{name}" for name in ("BB", "CF", "HC", "HC_improved", "IB")),
    *(f"sap5/{name}" for name in ("ab", "ai", "bh", "fb", "hj", "hj2", "jd")),
)
AXES = {"sap6": ("+X+Y-Z", "-Y-X+Z"), "sap5": ("+X+Y+Z", "+X+Y+Z")}
"""Axes of magnetometer and accelerometer, as the instruments' own configuration has them."""
ROUTINES = ("axis", "non-linear", "fast non-linear")


def shots(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Accelerometer, magnetometer and group of every shot."""
    with (Path(os.environ["MWDCAL_DATA"]) / f"{name}.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    g, m = (np.array([[float(row[p + c]) for c in "xyz"] for row in rows]) for p in "am")
    return g, m, np.array([row["group"] for row in rows])


def fitted(name: str, routine: str, g: np.ndarray, m: np.ndarray, group: np.ndarray) -> Calibration:
    """The peer's fit; its groups are those of the set."""
    made = Calibration(*AXES[name.split("/")[0]])
    made.fit_ellipsoid(m, g)
    rolls = [(m[group == label], g[group == label]) for label in sorted({*group} - {""})]
    made.fit_to_axis(rolls)
    if routine == "non-linear":
        made.fit_non_linear(rolls)
    elif routine == "fast non-linear":
        made.fit_non_linear_quick(rolls)
    return made


def scatter(axis: np.ndarray, group: np.ndarray) -> float:
    """The peer's measure: the norm of the standard deviations in a group, mean of the groups, degrees."""
    each = [
        np.linalg.norm(axis[group == label].std(0, ddof=1)) for label in sorted({*group} - {""})
    ]
    return float(np.degrees(np.mean(each)))


def figures(name: str, routine: str) -> tuple[float, float]:
    """Scatter of a set by a routine, in sample and left out."""
    g, m, group = shots(name)
    inside = fitted(name, routine, g, m, group).get_orientation_vector(m, g)
    outside = np.zeros_like(inside)
    for shot in np.flatnonzero(group != ""):
        kept = np.arange(len(g)) != shot
        made = fitted(name, routine, g[kept], m[kept], group[kept])
        outside[shot] = np.ravel(
            made.get_orientation_vector(m[shot : shot + 1], g[shot : shot + 1])
        )
    return scatter(inside, group), scatter(outside, group)


def main() -> None:
    """Fit every set by every routine, print and store the figures."""
    with Path(__file__).with_suffix(".csv").open("w", encoding="utf-8", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(["set", "routine", "in_sample_deg", "left_out_deg"])
        for name in SETS:
            for routine in ROUTINES:
                found = figures(name, routine)
                out.writerow([name, routine, *(f"{value:.3f}" for value in found)])
                print(name, routine, *(f"{value:.3f}" for value in found))


if __name__ == "__main__":
    main()
