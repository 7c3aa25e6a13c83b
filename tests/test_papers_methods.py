"""Newton-Raphson and the swarm as methods of the package, at the numbers the papers' claims need."""

from dataclasses import replace

import numpy as np
import pytest

from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.errors import FitError
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.sensor.profile import Profile
from simulation import DEG, attitude, factor_readings, factors_within_limits, plan

FIELD, DIP = 50_000.0, 65 * DEG
NOISE = np.repeat([1e-4, 15.0], 3)


def instruments(count):
    return factors_within_limits(np.random.default_rng(count), count)


def clean(tools, stations):
    """Readings (tools, n, 6) at 30 °C without noise."""
    vectors = np.concatenate(attitude(*stations)(1.0, FIELD, DIP), -1)
    return factor_readings(tools, np.full(len(stations[0]), 30.0), vectors)


def simulated(stations, tools, iron=None):
    """Readings of instruments; `iron` is the length of the hard iron, of random direction."""
    count, rng = len(tools), np.random.default_rng(len(tools))
    raw = clean(tools, stations)
    raw = raw + NOISE * rng.normal(size=raw.shape)
    if iron:
        turned = rng.normal(size=(count, 1, 3))
        raw[..., 3:] += iron * turned / np.linalg.norm(turned, axis=-1, keepdims=True)
    known = dict(zip(("inclination", "azimuth", "toolface"), stations, strict=True))
    known |= {"field": np.full(len(stations[0]), FIELD), "dip": np.full(len(stations[0]), DIP)}
    sd = {"accelerometer": NOISE[:3], "magnetometer": NOISE[3:]}
    return Readings(raw[..., :3], raw[..., 3:], known=known, sd=sd)


@pytest.mark.parametrize("model", ["polynomial", "factors"])
def test_newton_on_moosavis_plan_for_200_instruments(model):
    """Twelve stations exactly vertical; under ten iterations; toolface zero within 0.1°."""
    readings = simulated(plan((0, 45, 90, 135)), instruments(200))
    result = fit(readings, Options("newton", model))
    assert (result.status == 0).all()
    assert result.iterations.max() < 10
    g, _ = result.problem.fields(result.state)
    assert np.abs(np.linalg.norm(g, axis=-1) - 1).max() < 6 * NOISE[0]
    tilt = np.arctan2(np.hypot(g[..., 0], g[..., 1]), g[..., 2]) - readings.known["inclination"]
    assert np.abs(tilt).max() < 6 * NOISE[0]
    triad, where = result.problem.triads[0], result.problem.slices()[0]
    gain = triad.model.slope(result.state.params[:, where], triad.raw, result.problem.temperature)
    gain = gain.mean(1)
    turn = np.arctan2(gain[:, 0, 1] - gain[:, 1, 0], gain[:, 0, 0] + gain[:, 1, 1])
    assert np.abs(turn).max() < 0.1 * DEG


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("paper_weights", [False, True])
@pytest.mark.parametrize("method", ["newton", "scalar"])
def test_noise_that_differs_by_fifteen_decades_is_refused_or_fitted(method, paper_weights):
    """Sums of squares overflow or cancel there: a refusal, never an error of linear algebra."""
    readings = simulated(plan((5, 45, 90, 135), 6), instruments(1))
    known = {name: readings.known[name] for name in ("inclination", "toolface")}
    for seed in range(5):
        rng = np.random.default_rng(seed)
        sd = {"accelerometer": 10.0 ** rng.uniform(-13, 2, readings.accelerometer.shape)}
        accelerometer = readings.accelerometer[0]
        sd = {name: values[0] for name, values in sd.items()}
        run = Readings(accelerometer, None, known=known, sd=sd)
        options = Options(method, order=0, paper_weights=paper_weights)
        try:
            calibration = calibrate(run, Profile(name="servo"), options)
        except FitError:
            continue
        triad = calibration.accelerometer
        assert np.isfinite(np.array(triad.parameters)).all()
        assert np.isfinite([sd for sd in triad.standard_uncertainties if sd is not None]).all()


OTHER = plan((20, 40, 70, 80, 110, 150), 7)
NAMES = ("gravity", "inclination", "azimuth", "field", "dip")


@pytest.mark.parametrize("method", ["newton", "joint"])
def test_errors_are_as_large_as_newton_states_them(method):
    """Elsewhere, 300 instruments: error over stated uncertainty is 1 within four deviations."""
    tools = instruments(300)
    readings = simulated(plan((5, 45, 90, 135)), tools)
    known = {k: v for k, v in readings.known.items() if k != "toolface"}
    result = fit(replace(readings, known=known), Options(method))
    raw, warmth = clean(tools, OTHER), np.full(len(OTHER[0]), 30.0)
    fields, slopes = [], np.zeros((*raw.shape, 24))
    for t, (triad, where) in enumerate(
        zip(result.problem.triads, result.problem.slices(), strict=True)
    ):
        own, params = slice(3 * t, 3 * t + 3), result.state.params[:, where]
        fields.append(triad.model.fields(params, raw[..., own], warmth))
        slopes[:, :, own, where] = triad.model.jacobian(params, raw[..., own], warmth)
    true = attitude(*OTHER)(1.0, FIELD, DIP)
    astray = {}
    for name in NAMES:
        observable = OBSERVABLES[name]
        error = observable.value(*fields) - observable.value(*true)
        error = np.angle(np.exp(1j * error)) if observable.period else error
        rows = np.einsum("tni,tnip->tnp", observable.gradient(*fields), slopes)
        stated = rows @ result.analysis.covariance @ np.swapaxes(rows, -1, -2)
        size = np.sqrt(np.diagonal(stated, axis1=1, axis2=2))
        ratio = np.sqrt(np.mean((error / size) ** 2))
        correlation = stated / (size[:, :, None] * size[:, None, :])
        deviation = np.sqrt(2 * np.sum(correlation**2)) / (2 * size.size)
        print(f"{method} {name} {ratio:.3f} ± {deviation:.3f}")
        if abs(ratio - 1) > 4 * deviation:
            astray[name] = round(float(ratio), 3)
    assert astray == {}


@pytest.mark.parametrize("iron", [None, 5 * FIELD], ids=["soft", "hard iron of five fields"])
def test_swarm_and_least_squares_are_one_calibration_for_50_tools(iron):
    readings = simulated(plan((5, 45, 90, 135), 3), instruments(50), iron)
    swarm, solved = (fit(readings, Options(m)) for m in ("swarm", "least-squares"))
    assert (swarm.status == 0).all()
    apart = [
        np.abs(one - other).max() / strength
        for one, other, strength in zip(
            swarm.problem.fields(swarm.state),
            solved.problem.fields(solved.state),
            (1.0, FIELD),
            strict=True,
        )
    ]
    print(iron, apart)
    assert max(apart) < 1e-8
