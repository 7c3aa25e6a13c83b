"""Conventions of tool makers: what each of their channels would read becomes our vectors and angles.

Ours are written out as numbers that SPE 67616's equations gave once (G = 9.80665 m/s², B = 50 000 nT);
each maker's readings of the same attitude are put down here channel by channel.
"""

import numpy as np
import pytest

from cli_support import mwdcal, stations
from mwdcal.files.formats.table import Table, read, write
from mwdcal.files.profiles import load_profile
from mwdcal.files.runs import to_readings
from simulation import attitude, plan

G = 9.80665
ATTITUDES = np.array(
    [(10.0, 45.0, 30.0, 60.0), (45.0, 120.0, 200.0, 72.0), (3.0, 10.0, 350.0, -65.0)]
)
"""Inclination, azimuth, toolface, dip, degrees."""
GRAVITY = np.array(
    [
        (-0.851453, -1.474761, 9.657665),
        (2.371687, 6.516156, 6.934349),
        (0.089123, -0.505443, 9.793210),
    ]
)
"""m/s² along x, y, z."""
FIELD = np.array(
    [
        (20254.2706, -273.9134, 45713.1217),
        (794.8897, 41306.8665, 28162.2253),
        (-406.8759, 23438.4211, -44164.1808),
    ]
)
"""nT along x, y, z."""


def schlumberger(g, b):
    """Their X is our z, their Y our y, and their Z points opposite to our x."""
    (gx, gy, gz), (bx, by, bz) = g.T, b.T
    return [1000 * gz / G, 1000 * gy / G, -1000 * gx / G, bz, by, -bx]


CHANNELS = {
    "standard": lambda g, b: [*g.T, *b.T],
    "inverted-xy": lambda g, b: [-g[:, 0], -g[:, 1], g[:, 2], *b.T],
    "halliburton": lambda g, b: [*g.T / G, *b.T],
    "tensor": lambda g, b: [*g.T / G, *b.T / 100_000.0],
    "schlumberger": schlumberger,
}
"""Channels ax … mz of each maker for a gravity in m/s² and a field in nT along our axes."""


def raw(convention, g, b):
    return dict(zip(["ax", "ay", "az", "mx", "my", "mz"], CHANNELS[convention](g, b), strict=True))


@pytest.mark.parametrize("convention", CHANNELS)
def test_a_known_vector_becomes_ours(convention):
    profile = load_profile(f"convention-{convention}")[0]
    readings, known = to_readings(Table(raw(convention, GRAVITY, FIELD)), profile)
    np.testing.assert_allclose(readings.accelerometer, GRAVITY / G, rtol=1e-12)
    np.testing.assert_allclose(readings.magnetometer, FIELD, rtol=1e-12)
    assert known == profile


def test_the_numbers_are_those_of_the_attitudes():
    """The forward model of the tests gives them, to the last digit printed."""
    inc, azi, face, dip = np.radians(ATTITUDES).T
    for row in range(3):
        g, b = attitude(inc[row : row + 1], azi[row : row + 1], face[row : row + 1])(
            G, 50_000.0, dip[row]
        )
        np.testing.assert_allclose(g[0], GRAVITY[row], atol=6e-7)
        np.testing.assert_allclose(b[0], FIELD[row], atol=6e-5)


@pytest.mark.parametrize("convention", CHANNELS)
def test_from_a_run_in_the_convention_to_the_angles_of_surveys(tmp_path, convention):
    inc, azi, face = plan((5, 60, 120), 6)
    g, b = attitude(inc, azi, face)(G, 50_000.0, np.radians(60.0))
    columns = {
        k: np.asarray(v, float) for k, v in stations(inc, azi, face, earth=(1.0, 5e4, 60.0)).items()
    }
    write(tmp_path / "run.csv", Table({**columns, **raw(convention, g, b)}))
    tool = ("--tool", f"convention-{convention}", "-o", tmp_path / "cal.json")
    ran = mwdcal("calibrate", tmp_path / "run.csv", *tool)
    assert ran.code == 0, ran.err
    write(tmp_path / "surveys.csv", Table(raw(convention, GRAVITY, FIELD)))
    out = tmp_path / "out.parquet"
    ran = mwdcal("apply", tmp_path / "cal.json", tmp_path / "surveys.csv", "-o", out)
    assert ran.code == 0, ran.err
    result = read(out).columns
    for name, angles in zip(
        ("inclination", "azimuth", "toolface", "dip"), ATTITUDES.T, strict=True
    ):
        # six printed decimals of a transverse gravity of 0.5 m/s²: 1e-4 degrees
        np.testing.assert_allclose(result[f"{name}_deg"], angles, atol=2e-4)


@pytest.mark.parametrize("convention", ["halliburton", "tensor", "schlumberger"])
def test_readings_in_the_units_of_another_maker_are_refused(tmp_path, convention):
    inc, azi, face = plan((5, 60, 120), 6)
    g, b = attitude(inc, azi, face)(G, 50_000.0, np.radians(60.0))
    columns = {
        k: np.asarray(v, float) for k, v in stations(inc, azi, face, earth=(1.0, 5e4, 60.0)).items()
    }
    write(tmp_path / "run.csv", Table({**columns, **raw(convention, g, b)}))
    tool = ("--tool", "convention-standard", "-o", tmp_path / "cal.json")
    assert mwdcal("calibrate", tmp_path / "run.csv", *tool).code == 3
