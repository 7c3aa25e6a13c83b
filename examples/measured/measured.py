"""Calibrate measured sets of other projects and compare with what was published of them.

    make measured        (writes docs/measured.md)

Nothing here is in sample only where a left-out figure is possible. See docs/measured.md.
"""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mwdcal.calibrate import calibrate
from mwdcal.datasets import fetch
from mwdcal.errors import MwdcalError
from mwdcal.estimate import fit
from mwdcal.files.profiles import load_profile
from mwdcal.files.runs import read_run, to_readings
from mwdcal.files.table import Table
from mwdcal.notation import convert
from mwdcal.options import Options
from mwdcal.profile import Profile, TriadProfile
from mwdcal.readings import Readings
from mwdcal.scatter import directions, group_scatter, scatter

SAP = {
    "sap6/BB": (0.692, 0.389), "sap6/CF": (0.556, 0.414), "sap6/HC": (0.724, 0.181),
    "sap6/HC_improved": (0.785, 0.189), "sap6/IB": (0.569, 0.492),
    "sap5/ab": (0.773, 0.198), "sap5/ai": (0.255, 0.143), "sap5/bh": (0.458, 0.125),
    "sap5/fb": (0.458, 0.240), "sap5/hj": (0.465, 0.144), "sap5/hj2": (0.492, 0.239),
    "sap5/jd": (0.485, 0.238),
}  # fmt: skip
"""Accuracy that CircuitPython_mag_cal reaches on each set, degrees, in sample: axis fit, non-linear."""
DISTOX = {"distox_cal1": 0.597, "distox_cal2": 0.502}
"""Direction scatter of TopoDroid's coefficients within the four groups, degrees."""
LOO_GOAL = 0.45
"""Left-out scatter of the SAP sets that we are after, degrees, mean of all twelve."""
__all__ = [
    "DISTOX",
    "LOO_GOAL",
    "SAP",
    "MwdcalError",
    "distox",
    "fetch",
    "imucal",
    "mikov",
    "page",
    "sap",
    "xsens",
]


@dataclass(frozen=True)
class Sap:
    """Direction scatter of one SAP set, degrees."""

    name: str
    peer: float
    linear: float
    linear_left_out: float
    curved: float
    curved_left_out: float


def sap(name: str) -> Sap:
    """One SAP instrument from its two roll groups and spread shots alone, no reference at all."""
    profile, _ = load_profile(name.split("/")[0])
    readings, _ = read_run(fetch(f"{name}.csv"), profile)
    linear = np.degrees(scatter(readings))
    nonlinearity = profile.magnetometer.nonlinearity or 0.0
    curved = np.degrees(scatter(readings, Options(nonlinearity={"magnetometer": nonlinearity})))
    return Sap(name, SAP[name][0], *map(float, (*linear, *curved)))


def distox(name: str) -> tuple[float, ...]:
    """Scatter within the four groups, degrees: the peer's, ours linear and curved, each left out too."""
    path = fetch(f"distox/{name}_raw.csv")
    profile, _ = load_profile("distox")
    rows = list(csv.DictReader(path.read_text().splitlines()))
    names = {"ax": "gx", "ay": "gy", "az": "gz", "mx": "mx", "my": "my", "mz": "mz"}
    columns = {ours: [row[theirs] for row in rows] for ours, theirs in names.items()}
    columns["group"] = [
        "ABCD"[(int(r["shot"]) - 1) // 4] if int(r["shot"]) <= 16 else "" for r in rows
    ]
    readings, _ = to_readings(Table(columns, {}, path.name, range(2, len(rows) + 2)), profile)
    curved = {"accelerometer": profile.accelerometer.nonlinearity or 0.0}
    ours = np.degrees([*scatter(readings), *scatter(readings, Options(nonlinearity=curved))])
    return distox_peer(name, rows, readings.group), *map(float, ours)


def distox_peer(name: str, rows: list[dict[str, str]], group: np.ndarray) -> float:
    """Scatter with TopoDroid's linear coefficients: vector = raw / 24000 · a + b."""
    lines = fetch("distox/peer_results.jsonl").read_text().splitlines()
    found = [json.loads(line) for line in lines]
    peer = next(p for p in found if p["file"].startswith(name) and not p["nonlinear"])
    values = {
        kind: np.array([[float(r[f"{letter}{axis}"]) for axis in "xyz"] for r in rows]) / 24000
        for kind, letter in (("G", "g"), ("M", "m"))
    }
    g, m = (v @ np.array(peer[f"a{k}"]).T + peer[f"b{k}"] for k, v in values.items())
    turn = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]])  # the long axis x becomes z, right-handed
    return float(np.degrees(group_scatter(directions(g @ turn.T, m @ turn.T), group)))


def accelerometer_only(
    raw: np.ndarray, scale: float, sd: np.ndarray | None = None, **known: np.ndarray
):
    """Readings and profile of a lone accelerometer, axes as they come."""
    profile = Profile(name="accelerometer", accelerometer=TriadProfile(scale=float(scale)))
    spread = {} if sd is None else {"accelerometer": sd / scale}
    return Readings(
        raw / scale, known=known, sd=spread, station=tuple(map(str, range(1, len(raw) + 1)))
    ), profile


def triangular(matrix: np.ndarray) -> np.ndarray:
    """Upper triangular factor, positive diagonal, of matrix = rotation @ triangular."""
    _, upper = np.linalg.qr(matrix)
    return np.sign(np.diag(upper))[:, None] * upper


def xsens() -> dict[str, float]:
    """Accelerometer of an Xsens MTi from 38 hand-held positions, |g| alone: worst differences."""
    rows = list(csv.DictReader(fetch("xsens/static_means.csv").read_text().splitlines()))
    raw = np.array([[float(r[f"a{axis}_counts"]) for axis in "xyz"] for r in rows])
    numbers = [float(x) for x in fetch("xsens/published.calib").read_text().split()]
    skew, scale = np.array(numbers[:9]).reshape(3, 3), np.array(numbers[9:18]).reshape(3, 3)
    bias = np.array(numbers[18:21])
    gravity = 9.81744
    readings, profile = accelerometer_only(raw, 1 / np.diag(scale).mean() * gravity)
    found = convert(calibrate(readings, profile), "affine")["accelerometer"].values
    upper = triangular(found["M"]) * gravity
    gains = np.diag(upper)
    field = raw @ found["M"].T + found["b"]
    centre = -np.linalg.solve(found["M"], found["b"])
    return {
        "bias, counts": float(np.abs(centre - bias).max()),
        "scale, relative": float(np.abs(gains / np.diag(scale) - 1).max()),
        "misalignment, rad": float(np.abs(upper / gains - skew).max()),
        "residual of |g|, %": float(100 * np.std(np.linalg.norm(field, axis=-1))),
    }


def mikov() -> dict[str, tuple[float, float]]:
    """Three MPU-9150 accelerometers, |g| alone: worst and rms difference from the publication, in σ."""
    rows = list(csv.DictReader(fetch("mikov/static_means.csv").read_text().splitlines()))
    published = {
        r["param"]: r for r in csv.DictReader(fetch("mikov/published.csv").read_text().splitlines())
    }
    result = {}
    for unit in ("imu0", "imu1", "imu2"):
        own = [r for r in rows if r["imu"] == unit]
        raw = np.array([[float(r[f"a{axis}"]) for axis in "xyz"] for r in own])
        readings, _ = accelerometer_only(raw, 9.81)
        fitted = fit(readings)
        ours, sd = mikov_parameters(fitted)
        names = ("sx_pct", "sy_pct", "sz_pct", "myz_deg", "mxy_deg", "mxz_deg", "bx", "by", "bz")
        theirs = np.array([float(published[f"acc_{n}"][unit]) for n in names])
        ratio = (ours - theirs) / sd
        result[unit] = (float(np.abs(ratio).max()), float(np.sqrt(np.mean(ratio**2))))
    return result


def mikov_parameters(fitted) -> tuple[np.ndarray, np.ndarray]:
    """Scales in %, misalignments in degrees, biases in m/s² of raw = M a + b, M upper triangular."""
    model, params = fitted.problem.triads[0].model, fitted.state.params[0]
    _, whole = model.finished(0.0)
    covariance = (
        whole[0]
        @ fitted.analysis.covariance[0]
        @ whole[0].T
        * fitted.analysis.variance_factor[0, 0]
    )

    def published_form(values: np.ndarray) -> np.ndarray:
        matrix, offset = values[:9].reshape(3, 3), values[9:]
        forward = np.linalg.inv(matrix)
        upper = np.linalg.inv(triangular(np.linalg.inv(forward)))
        angle = np.degrees([upper[1, 2], upper[0, 1], upper[0, 2]])
        return np.concatenate([100 * (np.diag(upper) - 1), angle, -forward @ offset * 9.81])

    values = whole[0] @ params
    steps = 1e-6 * np.eye(12)
    slope = np.stack(
        [(published_form(values + h) - published_form(values - h)) / 2e-6 for h in steps], -1
    )
    return published_form(values), np.sqrt(np.diag(slope @ covariance @ slope.T))


FACES = {
    "x_p": (90, 270),
    "x_a": (90, 90),
    "y_p": (90, 180),
    "y_a": (90, 0),
    "z_p": (0, 0),
    "z_a": (180, 0),
}
"""Inclination and toolface of each face in the tool frame."""


def imucal() -> float:
    """Six static faces by least squares: largest difference from the published K_a R_a, relative."""
    rows = list(csv.DictReader(fetch("imucal/annotated_session.csv").read_text().splitlines()))
    means = {
        face: np.mean(
            [[float(r[f"acc_{axis}"]) for axis in "xyz"] for r in rows if r["part"] == face], axis=0
        )
        for face in FACES
    }
    raw = np.stack([means[face] for face in FACES])
    angles = np.radians([FACES[face] for face in FACES])
    readings, profile = accelerometer_only(
        raw, 2045.0, inclination=angles[:, 0], toolface=angles[:, 1]
    )
    found = convert(calibrate(readings, profile, Options("least-squares")), "forward")[
        "accelerometer"
    ].values
    published = json.loads(fetch("imucal/published.json").read_text())
    expected = np.array(published["K_a"]) @ np.array(published["R_a"])
    return float(np.abs(found["S"] / 9.81 - expected).max() / np.abs(expected).max())


def page() -> str:
    """The documentation page with every table, from the data."""
    results = [sap(name) for name in SAP]
    lines = [
        "# Measured data",
        "",
        "Instruments that nobody of this project built, calibrated by this version of mwdcal and",
        "compared with what was published of them. Regenerate this page with `make measured`;",
        "`MWDCAL_DATA` must name the folder of the sets, which are not part of the product.",
        "No open set has both triads at many temperatures: nothing here says anything about",
        "temperature.",
        "",
        "## Cave-survey instruments SAP5 and SAP6",
        "",
        "24 shots each: 8 spread, and two groups of 8 rolls of one unknown direction. No reference",
        "angle, no reference field: the groups, and a constant field and dip, are all the evidence.",
        "Scatter of the direction within the groups in degrees, by the peer's own measure. The peer",
        "is the axis fit of CircuitPython_mag_cal, in sample. *Left out*: direction of each shot from",
        "a fit without it; this is the figure that counts. *Curved*: with own-axis quadratic and cubic",
        "terms of the magnetometer under a prior of 0.5 % of the field, as the profiles `sap5` and",
        "`sap6` declare.",
        "",
        "| set | peer, in sample | linear, in sample | linear, left out | curved, in sample | curved, left out |",
        "|---|---|---|---|---|---|",
    ]
    for r in results:
        cells = (r.peer, r.linear, r.linear_left_out, r.curved, r.curved_left_out)
        lines.append(f"| {r.name} | " + " | ".join(f"{v:.3f}" for v in cells) + " |")
    columns = ("peer", "linear", "linear_left_out", "curved", "curved_left_out")
    mean = [np.mean([getattr(r, c) for r in results]) for c in columns]
    lines.append("| **mean** | " + " | ".join(f"**{v:.3f}**" for v in mean) + " |")
    lines += ["", *_distox_lines(), "", *_other_lines()]
    return "\n".join(lines) + "\n"


def _distox_lines() -> list[str]:
    lines = [
        "## DistoX",
        "",
        "56 shots, 14 directions × 4 rolls; the first 16 are four groups of equal direction. Scatter",
        "within these groups in degrees; the peer's coefficients are TopoDroid's linear ones. *Curved*:",
        "with own-axis quadratic and cubic terms of the accelerometer (prior 0.5 % of gravity), as the",
        "profile `distox` declares; TopoDroid's non-linear variant bends the accelerometer too.",
        "",
        "| set | peer | linear, in sample | linear, left out | curved, in sample | curved, left out |",
        "|---|---|---|---|---|---|",
    ]
    rows = ((name, distox(name)) for name in DISTOX)
    return lines + [
        f"| {name} | " + " | ".join(f"{v:.3f}" for v in found) + " |" for name, found in rows
    ]


def _other_lines() -> list[str]:
    return [
        "## Accelerometers alone",
        "",
        "Xsens MTi, 38 hand-held positions, |g| alone, against the published calibration (largest",
        "difference):",
        "",
        "| quantity | difference |",
        "|---|---|",
        *(f"| {name} | {value:.2g} |" for name, value in xsens().items()),
        "",
        "Three MPU-9150 (Mikov), static means of 22 to 24 positions, |g| alone, nine published",
        "parameters each, differences in units of our standard uncertainty:",
        "",
        "| unit | largest | rms |",
        "|---|---|---|",
        *(f"| {unit} | {worst:.2f} σ | {rms:.2f} σ |" for unit, (worst, rms) in mikov().items()),
        "",
        "imucal (Ferraris session), six static faces, least squares: largest difference from the",
        f"published K·R, relative: {imucal():.1e}.",
    ]


if __name__ == "__main__":
    target = Path(__file__).parents[2] / "docs" / "measured.md"
    target.write_text(page(), encoding="utf-8")
    print(f"wrote {target}")
