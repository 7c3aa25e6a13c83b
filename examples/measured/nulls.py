"""Simulated runs like the measured SAP sets, with and without own-axis nonlinearity.

    MWDCAL_DATA is not needed: python examples/measured/nulls.py [COUNT]

24 shots, two groups of eight rolls, no reference. Noise, and scatter from shot to shot, are of the
size found in the measured sets; heavy tails are Student's t of three degrees of freedom, which
scales a shot or a single reading as the case may be. How often are own-axis terms taken falsely?
It is about the estimators, and imports the core.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from mwdcal import Options, Readings
from mwdcal.calibration.automatic.auto import ODDS, log_odds

SIZES = {
    "sap5": {"g": 0.0006, "b": 0.0015, "gravity": 0.0002, "field": 0.0015, "dip": 0.0035, "direction": 0.0016},
    "sap6": {"g": 0.0025, "b": 0.0010, "gravity": 0.0040, "field": 0.0005, "dip": 0.0020, "direction": 0.0022},
    "noise alone": {"g": 0.003, "b": 0.0025, "gravity": 0.0, "field": 0.0, "dip": 0.0, "direction": 0.0},
}  # fmt: skip
"""Noise of g and b as a share, scatter as a share or in radians, 1σ."""
OFFERED = {"accelerometer": 0.002, "magnetometer": 0.005}
"""As the profiles `sap5` and `sap6` declare them."""
TAILS = 3.0
GROUPS = np.repeat([-1, 0, 1], 8)
PARTS = 125
"""Runs fitted in one call."""


def vectors(
    inclination: np.ndarray, azimuth: np.ndarray, toolface: np.ndarray, dip: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Gravity and field of unit strength in the tool's frame, by the printed formulas."""
    (si, ci), (sa, ca), (st, ct), (sd, cd) = (
        (np.sin(x), np.cos(x)) for x in (inclination, azimuth, toolface, dip)
    )
    g = np.stack([-si * st, -si * ct, ci + 0 * st], -1)
    bx = cd * (ci * ca * st + sa * ct) - sd * si * st
    by = cd * (ci * ca * ct - sa * st) - sd * si * ct
    return g, np.stack([bx, by, cd * si * ca + sd * ci], -1)


def runs(
    count: int, kind: str, tails: bool, seed: int, bend: tuple[float, float] = (0.0, 0.0)
) -> tuple[Readings, dict[str, np.ndarray]]:
    """Readings (count, 24, 3) of simulated tools, and the truth: gain, offset and dip.

    `bend` is the size of quadratic and cubic terms of accelerometer and magnetometer.
    """
    rng, size = np.random.default_rng(seed), SIZES[kind]

    def drawn(*shape: int) -> np.ndarray:
        if not tails:
            return rng.normal(size=shape)
        return rng.standard_t(TAILS, size=shape) / np.sqrt(TAILS / (TAILS - 2))

    inclination = np.arccos(rng.uniform(-0.95, 0.95, (count, 24)))
    azimuth = rng.uniform(0, 2 * np.pi, (count, 24))
    toolface = rng.uniform(0, 2 * np.pi, (count, 24))
    for group in (0, 1):
        own = np.flatnonzero(group == GROUPS)
        inclination[:, own] = rng.uniform(0.9, 2.2, (count, 1)) + size["direction"] * drawn(
            count, 8
        )
        away = size["direction"] * drawn(count, 8) / np.sin(inclination[:, own])
        azimuth[:, own] = (1.5 * group + rng.uniform(0, 1, (count, 1))) + away
        start = rng.uniform(0, 2 * np.pi, (count, 1))
        toolface[:, own] = start + np.arange(8) * np.pi / 4 + rng.normal(0, 0.1, (count, 8))
    dip = rng.uniform(1.0, 1.25, (count, 1))
    both = vectors(inclination, azimuth, toolface, dip + size["dip"] * drawn(count, 24))
    gain = np.eye(3) + 0.05 * rng.uniform(-1, 1, (count, 2, 3, 3))
    offset = rng.uniform(-0.2, 0.2, (count, 2, 3))
    readings = []
    for t, (vector, strength, noise) in enumerate(
        zip(both, ("gravity", "field"), ("g", "b"), strict=True)
    ):
        vector = vector * (1 + size[strength] * drawn(count, 24))[..., None]
        bent = vector + bend[t] * (
            rng.normal(size=(count, 1, 3)) * vector**2 + rng.normal(size=(count, 1, 3)) * vector**3
        )
        raw = np.einsum("bij,bnj->bni", gain[:, t], bent) + offset[:, t, None]
        readings.append(raw + size[noise] * drawn(count, 24, 3))
    truth = {"gain": gain, "offset": offset, "dip": dip}
    return Readings(*readings, group=np.broadcast_to(GROUPS, (count, 24))), truth


def odds(readings: Readings) -> np.ndarray:
    """Logarithm (count,) of the odds for own-axis terms of each run, as the default has them."""
    found = []
    options = Options(nonlinearity={}, scatter=True)
    for first in range(0, len(readings.accelerometer), PARTS):
        part = slice(first, first + PARTS)
        some = replace(
            readings,
            accelerometer=readings.accelerometer[part],
            magnetometer=readings.magnetometer[part],
            group=readings.group[part],
        )
        found.append(log_odds(some, options, OFFERED, np.ones(24)))
    return np.concatenate(found)


def false_terms(count: int, seed: int = 1) -> dict[str, tuple[int, int]]:
    """Runs without nonlinearity in which terms are taken, and runs, by noise and tails."""
    kinds = [(kind, tails) for kind in SIZES for tails in (False, True)]
    found = {}
    for k, (kind, tails) in enumerate(kinds):
        share = len(range(k, count, len(kinds)))
        if share:
            each = odds(runs(share, kind, tails, seed + k)[0]) > ODDS
            name = f"{kind}, {'heavy tails' if tails else 'normal'}"
            found[name] = (int(np.sum(each)), share)
    return found


if __name__ == "__main__":
    for name, (wrong, of) in false_terms(int(sys.argv[1]) if sys.argv[1:] else 500).items():
        print(f"{name}: terms taken in {wrong} of {of} runs without nonlinearity")
