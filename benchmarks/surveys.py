"""Survey stations with their position covariance: against welleng, and against NumPy written for this one job.

    python benchmarks/surveys.py [--stations 1000000]

*14 sensor terms*: an error model over one long well, balanced tangential in all three. welleng evaluates the tool
model that mwdcal exports, on fewer stations, scaled: it keeps every term at every station. *Readings*: corrected by 24
parameters, position and covariance from all of these and from noise; welleng has nothing for it. NumPy holds all
stations at once.
"""

from __future__ import annotations

import argparse
import warnings

import numpy as np
from measuring import Row, peak, seconds

from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration
from mwdcal.calibration.results import readings_at
from mwdcal.files.profiles import load_profile
from mwdcal.planning.plans import drawn, load_plan
from mwdcal.planning.session import Session
from mwdcal.survey.path import calibrated_path, position_covariance
from mwdcal.survey.tool_model import sensor_terms, term_shifts, tool_model

STATIONS, SCALED = 1_000_000, 10_000
"""Stations of the well, and of the part that welleng takes."""
FIELD, DIP, GRAVITY, NORTH = 50_000.0, np.radians(65.0), 9.80665, np.radians(-3.0)
TERMS = [
    *("ABXY-TI1S", "ABXY-TI2S", "ABZ", "ASXY-TI1S", "ASXY-TI2S", "ASXY-TI3S", "ASZ"),
    *("MBXY-TI1S", "MBXY-TI2S", "MBZ", "MSXY-TI1S", "MSXY-TI2S", "MSXY-TI3S", "MSZ"),
]


def calibration() -> Calibration:
    """A servo tool, calibrated at 48 stations."""
    profile = load_profile("servo")[0]
    session, rng = Session.of(load_plan("moosavi-12"), profile), np.random.default_rng(0)
    runs = session.measured(drawn(rng, profile, 0, (1,)), rng).readings
    known = {name: np.broadcast_to(value, (1, 48))[0] for name, value in runs.known.items()}
    sd = {n: np.broadcast_to(runs.sd[n], (1, 48, 3))[0] for n in ("accelerometer", "magnetometer")}
    one = Readings(runs.accelerometer[0], runs.magnetometer[0], known=known, sd=sd)
    return calibrate(one, profile)


def well(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth, m, inclination and azimuth, rad, of a well that winds and is never vertical."""
    md = np.linspace(0.0, 10_000.0, count)
    return md, np.radians(50 + 40 * np.sin(md / 1500)), np.radians(30 + 60 * np.sin(md / 2500))


def ours(count: int, values: dict[str, float]) -> np.ndarray:
    """Covariance (n, 3, 3) by all terms."""
    md, inc, azi = well(count)
    shifts = term_shifts(inc, azi - NORTH, FIELD, DIP, GRAVITY)
    causes = np.stack([shifts[name] * values[name] for name in TERMS], -2)
    causes[0] = causes[1]
    return position_covariance(md, inc, azi, causes, balanced=True)


def weights(inc: np.ndarray, azm: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """The printed weighting functions: inclination and azimuth by term."""
    si, ci, sa, ca, t, zero = (
        np.sin(inc),
        np.cos(inc),
        np.sin(azm),
        np.cos(azm),
        np.tan(DIP),
        0 * inc,
    )
    root, across = np.sqrt(2), FIELD * np.cos(DIP)
    return {
        "ABXY-TI1S": (-ci / GRAVITY, t * ci * sa / GRAVITY),
        "ABXY-TI2S": (zero, (ci / si - t * ca) / GRAVITY),
        "ABZ": (-si / GRAVITY, t * si * sa / GRAVITY),
        "ASXY-TI1S": (si * ci / root, -t * si * ci * sa / root),
        "ASXY-TI2S": (si * ci / 2, -t * si * ci * sa / 2),
        "ASXY-TI3S": (zero, (t * si * ca - ci) / 2),
        "ASZ": (-si * ci, t * si * ci * sa),
        "MBXY-TI1S": (zero, -ci * sa / across),
        "MBXY-TI2S": (zero, ca / across),
        "MBZ": (zero, -si * sa / across),
        "MSXY-TI1S": (zero, si * sa * (t * ci + si * ca) / root),
        "MSXY-TI2S": (zero, sa * (t * si * ci - ci * ci * ca - ca) / 2),
        "MSXY-TI3S": (zero, (ci * (ca * ca - sa * sa) - t * si * ca) / 2),
        "MSZ": (zero, -(si * ca + t * ci) * si * sa),
    }


def plain(count: int, values: dict[str, float]) -> np.ndarray:
    """The same in NumPy, term by term over the whole well."""
    md, inc, azi = well(count)
    upward = np.stack([np.cos(inc) * np.cos(azi), np.cos(inc) * np.sin(azi), -np.sin(inc)], -1)
    sideways = np.sin(inc)[:, None] * np.stack([-np.sin(azi), np.cos(azi), 0 * azi], -1)
    half, total = np.diff(md)[:, None] / 2, np.zeros((count, 3, 3))
    for name, (by_inc, by_azi) in weights(inc, azi - NORTH).items():
        shift = values[name] * (by_inc[:, None] * upward + by_azi[:, None] * sideways)
        shift[0] = shift[1]
        moved = np.zeros((count, 3))
        np.cumsum(half * (shift[:-1] + shift[1:]), 0, out=moved[1:])
        total += moved[:, :, None] * moved[:, None, :]
    return total


def theirs(count: int, model: dict[str, object]) -> np.ndarray:
    """The same by welleng, with the exported tool model."""
    from welleng.survey import Survey, SurveyHeader

    md, inc, azi = well(count)
    header = SurveyHeader(
        latitude=60.0, longitude=5.0, b_total=FIELD, dip=np.degrees(DIP), G=GRAVITY,
        declination=np.degrees(NORTH), convergence=0.0, azi_reference="true",
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        angles = np.degrees(inc), np.degrees(azi)
        return Survey(md, *angles, header=header, error_model=model).cov_nev


def by_hand(tool: Calibration, readings: Readings, md: np.ndarray) -> np.ndarray:
    """Covariance (n, 3, 3) of the positions of readings by 24 parameters and noise, in NumPy, all stations at once."""
    fields, errors, noises = [], [], []
    for triad, raw in zip(
        tool.triads, (readings.accelerometer, readings.magnetometer), strict=True
    ):
        p, middle = np.array(triad.parameters), np.array(triad.centre)
        scaled = (raw - middle) / triad.radius
        matrix = p[:9].reshape(3, 3)
        fields.append(scaled @ matrix.T + p[9:])
        errors.append(np.concatenate([scaled, np.ones((len(raw), 1))], -1))
        noises.append(matrix @ matrix.T * (triad.noise / triad.radius) ** 2)
    g, b = fields
    strength = np.linalg.norm(g, axis=-1, keepdims=True)
    down = g / strength
    normal = np.cross(down, b)
    horizontal = np.linalg.norm(normal, axis=-1, keepdims=True)
    east = normal / horizontal
    ci, si = down[:, 2:], np.hypot(down[:, :1], down[:, 1:2])
    ahead = (np.array([0.0, 0.0, 1.0]) - ci * down) / si
    slope = np.sum(down * b, -1, keepdims=True) / horizontal
    rows = [-ahead / strength, (slope * si * east - ci * np.cross(down, ahead)) / strength]
    compass = -si * east / horizontal
    sa, ca = np.sum(ahead * east, -1), np.sum(ahead * np.cross(east, down), -1)
    ci, si, zero = ci[:, 0], si[:, 0], 0 * sa
    axes = np.stack([ci * ca, ci * sa, -si, -sa, ca, zero], -1).reshape(-1, 2, 3)
    change = np.zeros((len(md), 2, 24))
    for row, vector in enumerate(rows):
        change[:, row, :9] = (vector[:, :, None] * errors[0][:, None, :3]).reshape(-1, 9)
        change[:, row, 9:12] = vector
    change[:, 1, 12:21] = (compass[:, :, None] * errors[1][:, None, :3]).reshape(-1, 9)
    change[:, 1, 21:] = compass
    values, vectors = np.linalg.eigh(tool.parameter_covariance)
    factor = vectors * np.sqrt(np.maximum(values, 0))
    shift = np.einsum("nrp,nrc->npc", change @ factor, axes)
    half = np.diff(md)[:, None, None] / 2
    moved = np.zeros_like(shift)
    np.cumsum(half * (shift[:-1] + shift[1:]), 0, out=moved[1:])
    total = np.einsum("npc,npd->ncd", moved, moved)
    pairs = np.stack(rows, 1)
    tilt = pairs @ noises[0] @ pairs.swapaxes(1, 2)
    tilt[:, 1, 1] += np.einsum("ni,ij,nj->n", compass, noises[1], compass)
    spread = axes.swapaxes(1, 2) @ tilt @ axes
    before, after = np.zeros(len(md)), np.zeros(len(md))
    before[1:], after[:-1] = np.diff(md) / 2, np.diff(md) / 2
    settled = np.zeros_like(total)
    np.cumsum(((before + after)[:, None, None] ** 2 * spread)[:-1], 0, out=settled[1:])
    return total + settled + before[:, None, None] ** 2 * spread


def apart(first: np.ndarray, second: np.ndarray) -> str:
    """Largest difference at the last station, as a share of its largest element."""
    return f"{np.abs(first[-1] - second[-1]).max() / np.abs(second[-1]).max():.0e}"


def rows(stations: int = STATIONS, scaled: int = SCALED) -> list[Row]:
    """Both jobs at all stations, welleng's on some of them."""
    tool = calibration()
    terms = sensor_terms(tool)
    model = tool_model(terms, "servo", "benchmark", "2026-01-01")
    by_name = {term.name: term.value for term in terms}
    values = {name: by_name[name.partition("-")[0]] for name in TERMS}
    calls = (
        lambda: ours(stations, values), lambda: plain(stations, values), lambda: theirs(scaled, model),
    )  # fmt: skip
    mine, numpy, other = np.median(
        [[seconds(call) for call in calls] for _ in range(3)], 0
    ).tolist()
    other *= stations / scaled
    memory = [peak(call) for call in calls]
    name = f"position covariance, 14 sensor terms, {stations} stations"
    few = ours(scaled, values)
    result = [
        Row(
            f"{name}; welleng ({scaled} stations, scaled)", mine, other, other / mine, "s",
            apart(few, theirs(scaled, model)), (memory[0], memory[2] * stations / scaled),
        ),
        Row(
            f"{name}; NumPy", mine, numpy, numpy / mine, "s",
            apart(few, plain(scaled, values)), (memory[0], memory[1]),
        ),
    ]  # fmt: skip
    md, inc, azi = well(stations)
    readings = readings_at(tool, inc, azi, md % 6.28)
    pair = (
        lambda: calibrated_path(tool, readings, md)[1], lambda: by_hand(tool, readings, md),
    )  # fmt: skip
    mine, numpy = np.median([[seconds(call) for call in pair] for _ in range(3)], 0).tolist()
    name = f"readings to positions with covariance, 24 parameters and noise, {stations} stations; NumPy"
    equal = apart(pair[0](), pair[1]())
    memory = [peak(call) for call in pair]
    return [*result, Row(name, mine, numpy, numpy / mine, "s", equal, (memory[0], memory[1]))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--stations", type=int, default=STATIONS)
    count = parser.parse_args().stations
    for row in rows(count):
        print(f"{row.name}\n  ours {row.ours:.2f} s ({count / row.ours:.0f} stations/s)", end="   ")
        print(f"theirs {row.theirs:.2f} s   {row.ratio:.2f} x   {row.same}   MB {row.memory}")


if __name__ == "__main__":
    main()
