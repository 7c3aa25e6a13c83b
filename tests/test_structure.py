"""What residuals look like: simulated effects are named as what they are, and noise is not."""

from dataclasses import replace

import numpy as np
import pytest

from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.diagnosis.structure import effects, shown_effects
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.estimation.batch import take
from mwdcal.geometry.vectors import earth_field, earth_gravity, rotation, tool_from_earth
from mwdcal.library.simulation import simulate
from mwdcal.library.tasks import NOMINAL
from mwdcal.sensor.profile import Profile
from simulation import DEG, Tool, plan

NOISE = {"accelerometer": np.array(1e-4), "magnetometer": np.array(15.0)}
SETTINGS = {"inclination": 0.01 * DEG, "azimuth": 0.05 * DEG, "toolface": 0.02 * DEG}


def order(count):
    return np.linspace(-1, 1, count)[:, None]


def steps(values):
    return np.sign(np.diff(values, prepend=values[:1], axis=0))


def settling(temperatures):
    """Temperature of 48 stations at each of some soaks, which it approaches over some stations."""
    before = np.array([temperatures[0], *temperatures[:-1]])[:, None]
    soak = np.array(temperatures, float)[:, None]
    return (soak + (before - soak) * np.exp(-np.arange(1, 49) / 6)).ravel()


def run(effect="", seed=0, noise=NOISE, unknown=(), group=None, temperatures=(25.0,)):
    """One run (n stations in serpentine order) of a tool and a stand with one effect."""
    tool, rng = Tool.random(3, noise=(1e-4, 15.0)), np.random.default_rng(seed)
    inc, azi, face = (np.tile(a, len(temperatures)) for a in plan((10, 45, 90, 135)))
    face = np.where((np.arange(len(inc)) // 12) % 2, face[::-1], face)
    warmth = settling(temperatures)
    n, known = len(inc), dict(zip(SETTINGS, (inc, azi, face), strict=True))
    actual = {k: v + SETTINGS[k] * rng.normal(size=n) for k, v in known.items()}
    if effect == "backlash":
        actual["toolface"] = actual["toolface"] + 0.1 * DEG * steps(face)
    attitude = tool_from_earth(*actual.values())
    field = earth_field(np.full(n, tool.field), np.full(n, tool.dip))
    if effect == "field-drift":
        field = field + np.array([30.0, -25.0, 40.0]) * order(n) + 25.0 * order(n) ** 2
    if effect == "field-gradient":
        gradient = np.array([[40.0, 30.0, -20.0], [30.0, -60.0, 25.0], [-20.0, 25.0, 20.0]])
        field = field + attitude[:, 2] @ gradient
    if effect == "dip-reference":
        field = field @ rotation(np.array([0.0, 0.1 * DEG, 0.0]))
    g = np.einsum("nij,nj->ni", attitude, earth_gravity(np.ones(n)))
    b = np.einsum("nij,nj->ni", attitude, field)
    raw = [v @ tool.matrix[t].T + tool.offset[t] for t, v in enumerate((g, b))]
    if effect == "accelerometer-drift":
        raw[0] = raw[0] + np.array([6e-4, -5e-4, 4e-4]) * order(n)
    if effect == "magnetometer-hysteresis":
        raw[1] = raw[1] + 25.0 * steps(raw[1])
    if effect == "accelerometer-thermal-lag":
        raw[0] = raw[0] + 8e-5 * np.diff(warmth, prepend=warmth[0])[:, None]
    raw = [r + s * rng.normal(size=(n, 3)) for r, s in zip(raw, (1e-4, 15.0), strict=True)]
    known |= {"field": np.full(n, tool.field), "dip": np.full(n, tool.dip)}
    return Readings(
        *raw,
        temperature=warmth,
        known={k: v for k, v in known.items() if k not in unknown},
        sd={**noise, **{k: np.full(n, v) for k, v in SETTINGS.items() if k not in unknown}},
        group=group,
        station=tuple(str(i) for i in range(n)),
    )


@pytest.mark.parametrize("declared", [True, False])
@pytest.mark.parametrize(
    "effect",
    ["field-drift", "field-gradient", "backlash", "dip-reference", "accelerometer-drift",
     "magnetometer-hysteresis"],
)  # fmt: skip
def test_an_effect_is_named_as_what_it_is(effect, declared):
    more = 0
    for seed in range(4):
        found = effects(fit(run(effect, seed, NOISE if declared else {})))
        assert found[0].name == effect
        more += len(found) - 1
    assert more <= 1


def test_thermal_lag_is_named_where_temperatures_change():
    data = run("accelerometer-thermal-lag", temperatures=(25.0, 85.0, 55.0, 115.0))
    found = effects(fit(data))
    assert [e.name for e in found][:1] == ["accelerometer-thermal-lag"]
    steady = run("accelerometer-thermal-lag")
    assert not effects(fit(steady))


@pytest.mark.parametrize("noise", [NOISE, {}])
@pytest.mark.parametrize("unknown", [(), ("azimuth", "dip"), ("toolface",)])
@pytest.mark.parametrize("count", [10, pytest.param(25, marks=pytest.mark.study)])
def test_noise_alone_has_no_name(noise, unknown, count):
    """Eleven families at 1e-4: one run in nine hundred has a name, and two in 150 have a chance of 1 %."""
    named = [e.name for seed in range(count) for e in effects(fit(run("", seed, noise, unknown)))]
    assert len(named) <= 1


def test_the_size_of_a_zero_is_right():
    """A dip 0.1° above its reference, within its stated uncertainty (scaled by what it explains)."""
    scores = []
    for seed in range(20):
        effect = effects(fit(run("dip-reference", seed)))[0]
        scores.append((effect.values[0] - 0.1 * DEG) / effect.uncertainties[0])
    assert abs(np.mean(scores)) < 3 / np.sqrt(20)
    assert 0.4 < np.std(scores) < 1.3


def test_a_course_that_the_order_leaves_out_is_not_taken_for_a_drift():
    """Rising temperatures keep step with the order of the stations."""
    data = run(temperatures=(25.0, 55.0, 85.0, 115.0))
    bent = 4e-4 * ((data.temperature - 70) / 45) ** 2
    raw = data.accelerometer * (1 + bent[:, None]) + bent[:, None]
    result = fit(Readings(raw, data.magnetometer, data.temperature, data.known, data.sd))
    assert not effects(result)
    assert result.analysis.variance_factor[0, 0] > 1.2


def test_findings_name_the_effect_and_what_to_do():
    record = calibrate(run("field-drift"), Profile(name="x"))
    (finding,) = [f for f in record.findings if "drift" in f.id or f.id.startswith("looks-like")]
    assert finding.id == "field-drift"
    assert "reference magnetometer" in finding.text
    (drift,) = [each for each in record.drift if each.name == "field"]
    north, east, down = 60.0, 50.0, 80.0  # from end to end; 25 nT of bend cancel there
    assert (
        abs(drift.change - np.sqrt(north**2 + east**2 + down**2)) < 3 * drift.standard_uncertainty
    )
    assert f"{drift.change:.2g} nT" in finding.text


def test_settings_that_a_roll_set_shares_are_not_taken_for_another_effect():
    """The stand is set once for twelve toolfaces: 0.02° of inclination, 0.1° of azimuth."""
    tool, others = Tool.random(3, noise=(1e-4, 15.0)), 0
    inc, azi = np.repeat([10, 45, 90, 135], 12) * DEG, np.repeat([0, 90, 180, 270], 12) * DEG
    face = np.tile(np.arange(12) * 30, 4) * DEG
    for seed in range(12):
        rng = np.random.default_rng(seed)
        shared = [np.repeat(s * DEG * rng.normal(size=4), 12) for s in (0.02, 0.1)]
        attitude = tool_from_earth(inc + shared[0], azi + shared[1], face)
        earth = earth_gravity(np.ones(48)), earth_field(np.full(48, tool.field), tool.dip)
        raw = [np.einsum("nij,nj->ni", attitude, e) for e in earth]
        raw = [v @ tool.matrix[t].T + tool.offset[t] for t, v in enumerate(raw)]
        raw = [r + s * rng.normal(size=(48, 3)) for r, s in zip(raw, (1e-4, 15.0), strict=True)]
        known = {"inclination": inc, "azimuth": azi, "toolface": face}
        known |= {"field": np.full(48, tool.field), "dip": np.full(48, tool.dip)}
        names = [e.name for e in effects(fit(Readings(*raw, known=known)))]
        others += len([n for n in names if n != "settings"])
    assert others <= 1


def test_what_the_sensors_take_up_is_not_seen():
    """A toolface zero turns both triads alike: residuals stay as they are."""
    data = run()
    turned = {**data.known, "toolface": data.known["toolface"] + 0.5 * DEG}
    result = fit(Readings(data.accelerometer, data.magnetometer, known=turned, sd=data.sd))
    assert not effects(result)
    assert result.analysis.variance_factor.max() < 1.5


@pytest.mark.parametrize("seed", [2, 4])
def test_readings_almost_without_noise_are_judged_without_a_warning_of_numpy(seed):
    """Warnings are errors here: rounding made the squared length of an effect negative."""
    readings = simulate(toolfaces=16, noise=(1e-8, 1e-3), seed=seed)
    calibration = calibrate(readings, NOMINAL, Options("scalar", order=0))
    assert calibration.accelerometer.noise == pytest.approx(1e-8, rel=0.3)


def stacked(runs):
    """Runs of one shape as a batch."""
    each = {n: np.stack([getattr(r, n) for r in runs]) for n in ("accelerometer", "magnetometer")}
    each |= {"temperature": np.stack([r.temperature for r in runs])}
    for name in ("known", "sd"):
        every = [{k: v for k, v in getattr(r, name).items() if np.ndim(v)} for r in runs]
        each[name] = {k: np.stack([e[k] for e in every]) for k in every[0]}
    return Readings(**each)


@pytest.mark.parametrize("temperatures", [(25.0,), (25.0, 85.0, 55.0, 115.0)])
def test_many_runs_together_show_what_each_shows_alone(temperatures):
    names = ("", "field-drift", "backlash", "dip-reference", "accelerometer-thermal-lag")
    runs = [run(name, seed, {}, temperatures=temperatures) for seed, name in enumerate(names)]
    together = fit(stacked(runs))
    every = shown_effects(together, {})
    for place, shown in enumerate(every):
        alone = shown_effects(take(together, np.array([place])), {})[0]
        assert shown.keys() == alone.keys()
        for name, (chance, share) in shown.items():
            assert (chance, share) == pytest.approx(alone[name], rel=1e-6)
    assert [bool(shown) for shown in every[:4]] == [False, True, True, True]


def test_angles_that_are_read_off_have_no_side_from_their_noise():
    """An encoder's noise at an angle that did not change is no move: its sign is part of the error itself."""
    runs = []
    for seed in range(60):
        data, rng = run("", seed, {}), np.random.default_rng([5, seed])
        error = {
            k: v + SETTINGS[k] * rng.normal(size=len(v))
            for k, v in data.known.items()
            if k in SETTINGS
        }
        runs.append(replace(data, known={**data.known, **error}))
    assert not [shown for shown in shown_effects(fit(stacked(runs)), {}) if "backlash" in shown]
