"""Scalar, roll-group and six-position fits against the packages that offer them.

circuitpython-mag-cal: ellipsoid (|g| and |b| alone), and alignment by roll groups; imucal:
Ferraris' six positions. None of them gives an uncertainty or says what a run does not determine;
mwdcal does so within the times shown. What each reaches is judged at 300 other attitudes.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from measuring import Row, against

from mwdcal.calibration.estimate import Fit, fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.geometry.vectors import directions
from simulation import DEG, Tool

TOOL = Tool.random(7)
SD = {"accelerometer": np.full(3, TOOL.noise[0]), "magnetometer": np.full(3, TOOL.noise[1])}
SAMPLES, RATE = 100, 100.0
SIX = np.array([[90, 0, 270], [90, 0, 90], [90, 0, 180], [90, 0, 0], [0, 0, 0], [180, 0, 0]]) * DEG
"""Inclination, azimuth and toolface with gravity along +x, -x, +y, -y, +z and -z."""


def shots(seed: int = 24) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cave surveyors' 24 shots: 8 spread, and two directions of 8 rolls; with group numbers."""
    rng = np.random.default_rng(seed)
    spread = np.stack([np.arccos(rng.uniform(-0.9, 0.9, 8)), *rng.uniform(0, 2 * np.pi, (2, 8))])
    rolls = np.arange(8) * np.pi / 4
    aimed = [np.stack([np.full(8, i), np.full(8, a), rolls]) for i, a in ((1.4, 0.5), (0.9, 3.0))]
    angles = np.concatenate([spread, *aimed], -1)
    group = np.repeat([-1, 0, 1], 8)
    g, b = TOOL.readings(rng, 1, *angles)
    return g[0], b[0], group


def elsewhere() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Noiseless readings (300, 3) of both triads at other attitudes, and true directions."""
    rng = np.random.default_rng(300)
    inclination = np.arccos(rng.uniform(np.cos(170 * DEG), np.cos(10 * DEG), 300))
    angles = (inclination, *rng.uniform(0, 2 * np.pi, (2, 300)))
    perfect = Tool(np.stack([np.eye(3)] * 2), np.zeros((2, 3)))
    return *TOOL.clean(*angles), directions(*perfect.clean(*angles))


Correct = Callable[[np.ndarray, np.ndarray], list[np.ndarray]]


def by_us(found: Fit) -> Correct:
    """Corrected vectors by one of our fits."""

    def correct(*raw: np.ndarray) -> list[np.ndarray]:
        triads = zip(found.problem.triads, found.problem.slices(), raw, strict=True)
        cold = np.zeros((1, len(raw[0])))
        return [t.model.fields(found.state.params[:, w], r[None], cold)[0] for t, w, r in triads]

    return correct


def by_mag_cal(made: object) -> Correct:
    """The same by circuitpython-mag-cal."""
    return lambda g, b: [made.grav.apply(g.copy()), made.mag.apply(b.copy())]


def lengths(correct: Correct) -> str:
    """Departure of |g| and |b| from their mean, in %."""
    size = [np.linalg.norm(v, axis=-1) for v in correct(*elsewhere()[:2])]
    return " and ".join(f"{100 * s.std() / s.mean():.3f} %" for s in size)


def astray(correct: Correct) -> str:
    """Error of the direction of the tool axis, rms."""
    *raw, true = elsewhere()
    error = np.linalg.norm(directions(*correct(*raw)) - true, axis=-1)
    return f"{np.sqrt(np.mean(error**2)) / DEG:.3f}°"


def ellipsoid(g: np.ndarray, b: np.ndarray) -> object:
    """circuitpython-mag-cal by strengths alone."""
    from mag_cal import Calibration

    made = Calibration()
    made.fit_ellipsoid(b, g)
    return made


def aligned(g: np.ndarray, b: np.ndarray, group: np.ndarray) -> object:
    """The same, then aligned by its roll groups."""
    made = ellipsoid(g, b)
    made.fit_to_axis([(b[group == k], g[group == k]) for k in (0, 1)], "Z")
    return made


def mag_cal() -> list[Row]:
    """Scalar and roll-group fits of 24 shots, both triads."""
    g, b, group = shots()
    scale = np.full(len(g), TOOL.field)
    alone = Readings(g, b, known={"field": scale}, sd=SD)
    grouped = Readings(g, b, known={"field": scale}, sd=SD, group=group)
    found = []
    for name, judge, ours, theirs in (
        (
            "24 shots by strength alone; circuitpython-mag-cal, ellipsoid",
            lengths,
            partial(fit, alone, Options("scalar")),
            partial(ellipsoid, g, b),
        ),
        (
            "24 shots with two roll groups; circuitpython-mag-cal, ellipsoid and axis",
            astray,
            partial(fit, grouped),
            partial(aligned, g, b, group),
        ),
    ):
        words = [judge(by_us(ours())), judge(by_mag_cal(theirs()))]
        what = "spread of corrected strengths" if judge is lengths else "direction, rms"
        same = f"{what}: ours {words[0]}, theirs {words[1]}"
        name, _, other = name.partition("; ")
        found += against(name, ours, {other: theirs}, {other: same})
    return found


def imucal() -> list[Row]:
    """Six positions of 100 samples; imucal calibrates a gyroscope besides, from three rotations."""
    from imucal import FerrarisCalibration, FerrarisSignalRegions

    rng = np.random.default_rng(6)
    held = TOOL.clean(*SIX.transpose())[0][:, None] + 3e-3 * rng.normal(size=(6, SAMPLES, 3))
    still = 0.1 * rng.normal(size=(6, SAMPLES, 3))
    turned = np.stack([np.diag([-360.0] * 3)[i] + still[i] for i in range(3)])
    regions = FerrarisSignalRegions(*held, *still, *held[::2], *turned)
    known = dict(zip(("inclination", "azimuth", "toolface"), SIX.transpose(), strict=True))
    options = Options("least-squares")
    sd = {"accelerometer": np.full(3, 3e-3 / np.sqrt(SAMPLES))}

    def ours() -> Fit:
        return fit(Readings(held.mean(1), known=known, sd=sd), options)

    def theirs() -> object:
        made = FerrarisCalibration(grav=1.0)
        return made.compute(regions, RATE, from_acc_unit="g", from_gyr_unit="deg/s")

    found, other = ours(), theirs()
    zero = np.zeros((1, 1))
    slope = found.problem.triads[0].model.slope(found.state.params, np.zeros((1, 1, 3)), zero)[0, 0]
    apart = np.abs(np.linalg.inv(slope) - other.K_a @ other.R_a).max()
    word = "imucal, Ferraris"
    same = {word: f"gain matrices within {apart:.0e}"}
    return against("six positions, accelerometer", ours, {word: theirs}, same)


def rows() -> list[Row]:
    """All peers that are installed."""
    return mag_cal() + imucal()
