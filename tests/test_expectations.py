"""What a record states, against formulas and simulations that share nothing with the package.

Each test fails when the stated number is wrong by a factor of 1.5.
"""

import numpy as np
import pytest

from cli_support import SCALE, channels, mwdcal, stations, write_csv
from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.residuals import Residuals, error_rows, rms
from mwdcal.calibration.results import typical_accuracy
from simulation import DEG, Tool, attitude, bound, complex_steps, plan
from test_calibrate import NOISE, PROFILE, make
from test_observables import complex_value

ANGLES = ("inclination", "toolface", "azimuth")
SHOWN = {
    "gravity": 1e3, "field": 1.0, "inclination": 1 / DEG, "toolface": 1 / DEG,
    "azimuth": 1 / DEG, "dip": 1 / DEG,
}  # fmt: skip
"""Factors from g, nT and radians to the units of the record."""


def corrected(parameters, readings):
    """Both vectors (..., n, 6) of readings (..., n, 6): S⁻¹ (r - o), parameters S, o (..., 24)."""
    matrix = parameters[..., :18].reshape(*parameters.shape[:-1], 2, 3, 3)
    offset = parameters[..., 18:].reshape(*parameters.shape[:-1], 2, 3)
    inverse = np.linalg.inv(matrix)
    parts = [
        (readings[..., 3 * t : 3 * t + 3] - offset[..., None, t, :])
        @ np.swapaxes(inverse[..., t, :, :], -1, -2)
        for t in (0, 1)
    ]
    return np.concatenate(parts, -1)


def test_expected_errors_are_the_noise_less_what_the_fit_takes_of_it():
    """Least squares leaves σ √(1 - h) of a reading's noise, h the leverage of its station.

    The leverage of a linear regression on (target, 1), the gradient of the observable by complex
    step, S⁻¹ of the simulated tool: no figure of the package.
    """
    tool = Tool.random(7)
    inc, azi, face = plan()
    record = calibrate(make(1, tool=tool), PROFILE)
    ideal = np.concatenate(attitude(inc, azi, face)(tool.gravity, tool.field, tool.dip), -1)
    for row in record.errors:
        slope = complex_steps(lambda x, name=row.observable: complex_value(name, x), ideal)
        variance = 0.0
        for t, noise in enumerate(tool.noise):
            own = slice(3 * t, 3 * t + 3)
            design = np.column_stack([ideal[:, own], np.ones(len(inc))])
            leverage = np.sum(design @ np.linalg.inv(design.T @ design) * design, -1)
            by_reading = slope[:, own] @ np.linalg.inv(tool.matrix[t])
            variance = variance + noise**2 * (1 - leverage) * np.sum(by_reading**2, -1)
        weight = np.sin(inc) if row.observable in ("toolface", "azimuth") else 1.0
        expected = np.sqrt(np.mean(weight**2 * variance)) * SHOWN[row.observable]
        assert row.expected == pytest.approx(expected, rel=5e-3), row.observable


@pytest.mark.parametrize(
    ("practice", "options"),
    [
        ("per-direction", Options()),
        ("per-station", Options()),
        ("per-direction", Options(robust="student")),
        ("per-direction", Options(method="newton")),
    ],
    ids=["per-direction", "per-station", "robust", "newton"],
)
def test_expected_errors_are_the_scatter_of_runs_for_both_practices_of_the_stand(practice, options):
    """200 runs whose settings are off as declared, by a second forward model: rms after over expected is 1.

    Its standard deviation is at most 0.03. Without what a direction shares the ratio of inclination is 6.
    """
    tool, runs, names = Tool.random(7), 200, ("inclination", "azimuth", "toolface")
    inc, azi = np.repeat([(5, 40, 80, 110, 140), (10, 100, 190, 280, 30)], 6, 1) * DEG
    stated = inc, azi, np.tile(np.arange(6) * 60.0, 5) * DEG
    rng, sizes = np.random.default_rng(3), np.array([0.03, 0.06, 0.05]) * DEG
    off = rng.normal(size=(3, runs, 30))
    if practice == "per-direction":
        off[:2] = rng.normal(size=(2, runs, 5)).repeat(6, -1)
    clean = tool.clean(*(np.array(stated) + off.transpose(1, 0, 2) * sizes[:, None]).swapaxes(0, 1))
    raw = [v + sd * rng.normal(size=v.shape) for v, sd in zip(clean, tool.noise, strict=True)]
    known = dict(zip(names, stated, strict=True)) | {"gravity": np.ones(30)}
    known |= {name: np.full(30, getattr(tool, name)) for name in ("field", "dip")}
    sd = NOISE | {name: np.full(30, size) for name, size in zip(names, sizes, strict=True)}
    readings = Readings(*raw, known=known, sd=sd, settings=practice)
    every = error_rows(Residuals(readings, fit(readings, options)))
    for rows in zip(*every, strict=True):
        if rows[0].expected is not None:
            after, expected = np.transpose([(row.after, row.expected) for row in rows])
            assert rms(after) / rms(expected) == pytest.approx(1.0, abs=0.1), rows[0].observable


def lopsided():
    """Attitudes (3, 40) that leave the accuracy to depend on azimuth and toolface."""
    inc, azi, face = (
        each.ravel() for each in np.meshgrid([20, 60, 100, 150], [0, 40], np.arange(5))
    )
    return np.stack([inc, azi + 7 * face, 12 * face + inc]) * DEG


def test_typical_accuracy_is_the_root_mean_square_of_the_bound_at_45_degrees():
    """Over azimuth and toolface, from the Cramér-Rao bound of the simulated tool, noise as found."""
    tool, (inc, azi, face) = Tool.random(7), lopsided()
    a, m = (v[0] for v in tool.readings(np.random.default_rng(1), 1, inc, azi, face))
    known = {"inclination": inc, "azimuth": azi, "toolface": face}
    known |= {"field": np.full(len(inc), tool.field), "dip": np.full(len(inc), tool.dip)}
    record = calibrate(Readings(a, m, known=known, sd=NOISE), PROFILE)
    found = np.sqrt([max(triad.variance_factor, 1.0) for triad in record.triads])
    scale = np.concatenate([np.repeat(found, 9), np.repeat(found, 3)])
    limit = bound(tool, inc, azi, face) * scale[:, None] * scale
    turn = np.arange(0.0, 360.0, 15.0) * DEG
    azimuth, toolface = (each.ravel() for each in np.meshgrid(turn, turn))
    readings = np.concatenate(tool.clean(np.full(azimuth.shape, 45 * DEG), azimuth, toolface), -1)
    true = np.concatenate([tool.matrix.ravel(), tool.offset.ravel()])
    stated = typical_accuracy(record)
    for name in ANGLES:
        rows = complex_steps(lambda x, n=name: complex_value(n, corrected(x, readings)), true)
        sd = np.sqrt(np.einsum("ni,ij,nj->n", rows, limit, rows)) / DEG
        mean = np.sqrt(np.mean(sd**2))
        assert stated[name] == pytest.approx(mean, rel=0.02), name
        total = sum(getattr(row, f"{name}_deg") ** 2 for row in record.budget)
        assert np.sqrt(total) == pytest.approx(mean, rel=0.02), name
        assert sd.max() > 1.15 * mean, name  # so that a maximum would be another number


STAND = {"inclination": 0.1, "azimuth": 0.3, "toolface": 0.2}


@pytest.mark.parametrize("where", ["profile", "run", "repeatability"])
def test_errors_of_the_settings_are_those_declared_wherever_they_are_declared(tmp_path, where):
    """240 stations set with errors of known size, far above the noise: the residuals say so.

    The ratio of rms error to expectation has a standard deviation of 5 % or less.
    """
    tool = Tool.random(7, noise=(1e-6, 0.15))
    stated = plan((10, 40, 70, 100, 150), 48)
    rng = np.random.default_rng(8)
    true = [
        angle + sd * DEG * rng.normal(size=len(angle))
        for angle, sd in zip(stated, STAND.values(), strict=True)
    ]
    g, b = (v[0] for v in tool.readings(rng, 1, *true))
    columns = {**stations(*stated), **channels(g, b)}
    lines = ['name = "stand"']
    for triad, scale, noise in zip(
        ("accelerometer", "magnetometer"), SCALE, tool.noise, strict=True
    ):
        lines += [f"[{triad}]", f"scale = {scale}", f"noise = {scale * noise}"]
    lines.append("[stand]")
    for name, sd in STAND.items():
        if where == "run":
            columns[f"sd_ref_{name}_deg"] = np.full(len(stated[0]), sd)
        else:
            lines.append(f"{'repeatability_' if where == 'repeatability' else ''}{name}_deg = {sd}")
    profile = tmp_path / "tool.toml"
    profile.write_text("\n".join(lines), "utf-8")
    run = write_csv(tmp_path / "run.csv", columns)
    ran = mwdcal("calibrate", run, "--tool", profile, "-o", tmp_path / "cal.json", "--json")
    assert ran.code == 0, ran
    rows = {row["observable"]: row for row in ran.json["errors"]}
    for name in ANGLES:
        assert rows[name]["after"] / rows[name]["expected"] == pytest.approx(1.0, abs=0.15), name
    assert rows["inclination"]["expected"] == pytest.approx(STAND["inclination"], rel=0.05)
    across = np.sqrt(np.mean(np.sin(stated[0]) ** 2))
    assert rows["toolface"]["expected"] == pytest.approx(STAND["toolface"] * across, rel=0.05)
