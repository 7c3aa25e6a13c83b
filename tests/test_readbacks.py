"""Stand angles as an encoder reads them back: verdicts, spreads and calibrations of tools whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom, t

import mwdcal
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.results import StatedCovariance
from mwdcal.files.limits import load_limits
from simulation import DEG, Tool, attitude, plan
from test_efficiency import affine

LIMITS = load_limits("roll-test")[0]
LEAN, KNOCK = 45 * DEG, 6e-3
SPREADS = {"spread of inclination", "spread of azimuth", "spread of gravity"}
COUNT = 24


def stated(noise):
    return dict(zip(("accelerometer", "magnetometer"), noise, strict=True))


@pytest.fixture(scope="module")
def calibrated():
    """Tools, and their calibrations on an exact stand."""
    rng, pairs = np.random.default_rng(1), []
    for seed in range(6):
        tool, angles = Tool.random(seed), plan()
        a, m = (raw[0] for raw in tool.readings(rng, 1, *angles))
        known = dict(zip(("inclination", "azimuth", "toolface"), angles, strict=True))
        known |= {"field": tool.field, "dip": tool.dip, "sd": stated(tool.noise)}
        pairs.append((tool, mwdcal.calibrate(mwdcal.readings(a, m, **known), order=0)))
    return pairs


def roll_tests(calibrated, count, jitter, toolfaces=12, bias=0.0, follows=True):
    """Verdicts of tests at 45° whose references read back up to `jitter` degrees off the setting, and the calibrations.

    `follows`: the tool is where the encoder says; otherwise it is at the setting.
    """
    rng, turn = np.random.default_rng(2), np.arange(toolfaces) * 2 * np.pi / toolfaces
    for number in range(count):
        tool, calibration = calibrated[number % len(calibrated)]
        tool = replace(tool, offset=tool.offset + np.array([[bias, 0, 0], [0, 0, 0]]))
        setting = np.array([[LEAN], [rng.uniform(0, 2 * np.pi)]])
        shown = setting + rng.uniform(-jitter, jitter, (2, toolfaces)) * DEG
        lean, north = shown if follows else setting + 0 * shown
        shown = np.mod(shown, 2 * np.pi)
        a, m = (raw[0] for raw in tool.readings(rng, 1, lean, north, turn))
        run = mwdcal.readings(a, m, inclination=shown[0], azimuth=shown[1], sd=stated(tool.noise))
        yield mwdcal.verify(calibration, run, LIMITS), tool, calibration


@pytest.mark.slow
@pytest.mark.parametrize("toolfaces", [5, 12])
@pytest.mark.parametrize("jitter", [0.0, 0.02, 0.05])
def test_readbacks_of_one_direction_judge_sound_and_knocked_tools(calibrated, jitter, toolfaces):
    """A bias of 6 mg across the axis spreads the inclination by 2 · 6 mg · cos 45° = 0.49°."""
    for bias in (0.0, KNOCK):
        for verdict, _, _ in roll_tests(calibrated, COUNT, jitter, toolfaces, bias):
            assert not verdict.not_judged
            assert verdict.passed == (bias == 0)


@pytest.mark.slow
def test_readbacks_too_far_apart_pass_no_spread(calibrated):
    """Of tools with 12 toolfaces: a PASS of the knocked tool's errors says that its spreads were not judged."""
    for bias in (0.0, KNOCK):
        for verdict, _, _ in roll_tests(calibrated, COUNT, 0.08, bias=bias):
            assert set(verdict.not_judged) == SPREADS
            assert verdict.passed or bias


def spread_of_inclination(tool, calibration):
    """The true spread in degrees: of readings without noise all round, by the angle to gravity."""
    turn = np.arange(360) * DEG
    clean = tool.clean(np.full(360, LEAN), np.zeros(360), turn)
    g, _ = calibration.fields(mwdcal.Readings(*clean))
    return np.ptp(np.degrees(np.arccos(g[:, 2] / np.linalg.norm(g, axis=-1))))


@pytest.mark.slow
@pytest.mark.parametrize("follows", [True, False])
@pytest.mark.parametrize("jitter", [0.02, 0.05])
def test_a_spread_among_readbacks_is_as_uncertain_as_it_says(calibrated, jitter, follows):
    """Student's 95 % intervals hold it at least as often as all but one in a thousand such counts would."""
    count, inside = 2 * COUNT, 0
    for verdict, *made in roll_tests(calibrated, count, jitter, bias=KNOCK / 2, follows=follows):
        row = next(each for each in verdict.rows if each.name == "spread of inclination")
        error = row.value - spread_of_inclination(*made)
        inside += abs(error) < t.ppf(0.975, row.degrees_of_freedom) * row.uncertainty
    assert inside >= binom.ppf(1e-3, count, 0.95)


def test_the_scatter_of_readbacks_has_its_degrees_of_freedom(calibrated):
    """Without noise: 12 - 1 of the readbacks, and 12 - 5 of the residuals from a curve of five coefficients."""
    quiet = [(replace(tool, noise=(1e-8, 1e-3)), calibration) for tool, calibration in calibrated]
    for verdict, _, _ in roll_tests(quiet, 2, 0.05, follows=False):
        row = next(each for each in verdict.rows if each.name == "spread of inclination")
        assert row.degrees_of_freedom == pytest.approx(18, abs=0.01)


def test_readbacks_leave_a_stated_noise_stated(calibrated):
    """The readings follow the readbacks, whose scatter counts as noise: they scatter less than both."""
    quiet = [(replace(tool, noise=(1e-6, 1.0)), calibration) for tool, calibration in calibrated]
    for verdict, _, _ in roll_tests(quiet, 2, 0.05):
        (text,) = (each.text for each in verdict.findings if each.id == "little-scatter")
        assert "the stated noise explains" in text
        assert "estimated" not in text


RUNS = 200
STAND = {
    "true readbacks": (True, 0.0, {}, ""),
    "misread": (False, 0.0, {}, ""),
    "misread, as stated": (False, 0.0, {"inclination_deg": 0.029, "azimuth_deg": 0.029}, "per-station"),
    "settings that err": (True, 0.02, {"inclination_deg": 0.02, "azimuth_deg": 0.02}, "per-direction"),
}  # fmt: skip


@pytest.mark.parametrize(("follows", "error", "sd", "settings"), STAND.values(), ids=STAND)
@pytest.mark.parametrize("jitter", [0.02, 0.05])
def test_calibrations_by_readbacks_cover(jitter, follows, error, sd, settings):
    """95 % intervals of all parameters; one that is misread in σ that nobody states counts as noise."""
    rng, tool, direction = np.random.default_rng(3), Tool.random(7), np.arange(48) // 12
    setting = np.array([[5.0, 45, 90, 135], [0.0, 90, 180, 270]])[:, None, direction] * DEG
    shown = setting + rng.uniform(-jitter, jitter, (2, RUNS, 48)) * DEG
    true = shown if follows else setting + 0 * shown
    true = true + error * DEG * rng.normal(size=(2, RUNS, 4))[..., direction]
    turn = np.broadcast_to(np.arange(48) % 12 * 30 * DEG, shown.shape[1:])
    raw = [
        v @ tool.matrix[k].T + tool.offset[k] + tool.noise[k] * rng.normal(size=v.shape)
        for k, v in enumerate(attitude(*true, turn)(tool.gravity, tool.field, tool.dip))
    ]
    if sd and not follows:
        sd = dict.fromkeys(sd, jitter / 3**0.5)
    known = {"inclination": shown[0], "azimuth": shown[1], "toolface": turn}
    known |= {"field": tool.field, "dip": tool.dip, "settings": settings}
    run = mwdcal.readings(*raw, **known, sd={**stated(tool.noise), **sd})
    result = fit(run, Options(order=0))
    whole = replace(result.analysis, covariance=StatedCovariance(result).total)
    found, covariance = affine(replace(result, analysis=whole))
    back = [np.linalg.inv(matrix) for matrix in tool.matrix]
    truth = [(k.ravel(), -k @ o) for k, o in zip(back, tool.offset, strict=True)]
    truth = np.concatenate([*truth[0], *truth[1]])
    sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    assert 0.93 < np.mean(np.abs(found - truth) < 1.96 * sigma) < 0.97
