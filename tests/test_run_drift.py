"""Slow drift within a run: seen, of the right size, in the uncertainty, and not seen in noise."""

import re
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from msgspec.structs import replace as with_changes
from scipy import special

from cli_support import calibrated, mwdcal, servo_run, write_csv
from mwdcal.calibration.automatic.drift import (
    by_drift,
    chances,
    chances_without_drift,
    drifting,
    with_drift,
)
from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.diagnosis.structure import shown_effects
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Drift, Finding
from mwdcal.calibration.residuals import Residuals, error_rows
from mwdcal.calibration.results import StatedCovariance, assumed_exact, drifts, unseen_drifts
from mwdcal.certificate.budget import budget
from mwdcal.errors import FitError
from mwdcal.estimation.drift import (
    FEWEST_USED,
    held_trends,
    student_squares,
    terms_of,
    walk_scores,
)
from mwdcal.estimation.minimisers import closed_form_drift
from mwdcal.estimation.uncertainty import left_out_variances
from mwdcal.files.formats.table import Table
from mwdcal.files.profiles import load_profile
from mwdcal.geometry.vectors import earth_field, earth_gravity, tool_from_earth
from mwdcal.planning.expected import expected
from mwdcal.planning.planned import judged, with_tool
from mwdcal.planning.plans import drifted, load_plan
from mwdcal.presentation.calibration import remarks
from mwdcal.sensor.profile import Profile, StandProfile, TriadProfile

COUNT = 48


def runs(seed, tools, field=0.0, offset=0.0, straight=False, noise=(1e-4, 15.0)):
    """Nominal tools at four directions, each rolled through twelve toolfaces, that drift away from their start.

    `field`, nT, and `offset` of the accelerometer, g: 1σ on each axis of what a walk reaches, or the slope.
    """
    rng = np.random.default_rng(seed)
    inc, azi = np.repeat(np.radians([[5, 45, 90, 135], [0, 90, 180, 270]]), 12, axis=1)
    face = np.tile(np.arange(12) * np.pi / 6, 4)
    attitude = tool_from_earth(inc, azi, face)

    def path():
        steps = rng.normal(size=(tools, COUNT, 3)) / np.sqrt(COUNT)
        walk = np.linspace(0, 1, COUNT)[:, None] * rng.normal(size=(tools, 1, 3))
        whole = walk if straight else np.cumsum(steps, 1)
        return whole - whole.mean(1, keepdims=True)

    moved = earth_field(np.full(COUNT, 48_000.0), np.full(COUNT, 1.1)) + field * path()
    g = np.einsum("nij,nj->ni", attitude, earth_gravity(np.ones(COUNT))) + offset * path()
    b = np.einsum("nij,bnj->bni", attitude, moved)
    raw = [v + s * rng.normal(size=(tools, COUNT, 3)) for v, s in zip((g, b), noise, strict=True)]
    known = {"inclination": inc, "azimuth": azi, "toolface": face, "gravity": np.ones(COUNT),
             "field": np.full(COUNT, 48_000.0), "dip": np.full(COUNT, 1.1)}  # fmt: skip
    return Readings(*raw, known=known, sd={})


def covered(readings):
    """Share of the parameters' 95 % intervals that hold the truth, of nominal tools: accelerometer, magnetometer."""
    shares, options = [], Options(order=0)
    for _, result in by_drift(fit(readings, options), options):
        for triad, where in zip(result.problem.triads, result.problem.slices(), strict=True):
            true = triad.model.start(
                np.broadcast_to(np.eye(3), (len(result.status), 3, 3)),
                np.zeros((len(result.status), 3)),
            )
            sd = np.sqrt(np.diagonal(StatedCovariance(result).total, axis1=1, axis2=2))[:, where]
            shares.append(np.abs(result.state.params[:, where] - true) < 1.96 * sd)
    return np.concatenate([s.mean(-1) for s in shares[::2]]), np.concatenate(
        [s.mean(-1) for s in shares[1::2]]
    )


def test_the_walk_is_that_of_brown():
    """Covariance of a walk less its mean: min(s, t) - s + s²/2 - t + t²/2 + 1/3."""
    values, (_, variance) = terms_of(400)
    place = (np.arange(400) + 0.5) / 400
    s, t = place[:, None], place
    exact = np.minimum(s, t) - s + s**2 / 2 - t + t**2 / 2 + 1 / 3
    part = (values[:, 2:] * variance[2:]) @ values[:, 2:].T
    assert np.abs(part - exact).max() < 0.026  # what cosines beyond the eighth hold: Σ 2/(πk)²
    assert variance[0] == pytest.approx(1 / 3)


def test_noise_is_seldom_taken_for_drift():
    result = fit(runs(0, 400), Options(order=0))
    share = (chances(result)[0] < 0.1).mean(0)
    assert np.all(share < 0.1 + 3 * np.sqrt(0.09 / 400))
    assert np.all(share > 0.02)


@pytest.mark.parametrize("straight", [False, True], ids=["walk", "straight"])
def test_intervals_include_a_drift_of_the_field(straight):
    """40 nT: without it in the model the gains' intervals cover three quarters."""
    readings = runs(1, 40, field=40.0, straight=straight)
    acc, mag = covered(readings)
    assert acc.mean() > 0.92
    assert mag.mean() > 0.92


def test_the_size_of_a_drift_is_stated():
    """0.6 mg along one axis from end to end, with noise of 0.02 mg; the magnetometer did not drift."""
    readings = runs(3, 1, noise=(2e-5, 15.0))
    slope = 6e-4 * np.linspace(-0.5, 0.5, COUNT)[:, None] * np.array([0.0, 1.0, 0.0])
    raw = readings.accelerometer[0] + slope
    one = Readings(raw, readings.magnetometer[0], known=readings.known, sd={})
    record = calibrate(one, Profile(name="x"), Options(order=0))
    (drift,) = [each for each in record.drift if each.name == "accelerometer"]
    assert drift.unit == "mg"
    assert abs(drift.change - 0.6) < 3 * drift.standard_uncertainty < 0.2
    (finding,) = [f for f in record.findings if f.id == "accelerometer-drift"]
    assert "uncertainty includes it" in finding.text
    assert "drift of the accelerometer during the run" in {row.source for row in record.budget}


def test_a_drift_is_stated_with_the_share_of_steady_runs_that_show_as_much():
    """Run 43 of these, all without drift, is beyond the threshold by chance; a drift of 40 nT is far beyond."""
    for field, member, share in ((0.0, 43, "0.9 %"), (40.0, 0, "under 0.01 %")):
        readings = runs(11, 120, field=field)
        raw = readings.accelerometer[member], readings.magnetometer[member]
        one = Readings(*raw, known=readings.known, sd={})
        record = calibrate(one, Profile(name="x"), Options(order=0))
        [finding] = [each for each in record.findings if each.id.endswith("-drift")]
        first, *_ = finding.text.split(". ")
        assert first.startswith("Readings follow the order of the stations as if")
        assert first.endswith(f"noise alone shows as much in {share} of steady runs")


def test_a_drift_that_no_finding_names_is_on_the_screen_too():
    """Small ones may be noise, and widen the uncertainty beyond what a plan has said."""
    steady = expected(load_plan("twelve-state"), load_profile("servo")[0])
    drift = Drift(name="field", change=31.0, standard_uncertainty=11.0, unit="nT")
    finding = Finding(id="field-drift", text="readings follow the order")
    possible = "a possible drift within the run (noise alone shows one in a fifth to a third of steady runs)"
    for more, shown in (
        ({"drift": []}, False),
        ({"drift": [drift]}, True),
        ({"drift": [drift], "findings": [finding]}, False),
        ({"drift": [with_changes(drift, declared=40.0)]}, False),
    ):
        said = [line for line in remarks(with_changes(steady, **more)) if possible in line]
        assert [line.endswith("does not foresee: field 31 ± 11 nT") for line in said] == [
            True
        ] * shown


def test_a_plan_by_a_calibration_whose_run_drifted_says_that_it_does_not_foresee_that():
    plan, profile = load_plan("twelve-state"), load_profile("servo")[0]
    steady, planned = expected(plan, profile), judged(plan, profile)
    drift = Drift(name="field", change=31.0, standard_uncertainty=11.0, unit="nT")
    for drifts_of_run, said in (
        ([], []),
        ([drift], ["field 31 nT (1σ 11 nT)"]),
        ([with_changes(drift, declared=40.0)], []),
    ):
        result = with_tool(planned, with_changes(steady, drift=drifts_of_run))
        texts = [each.text for each in result.findings if each.id == "drift-unforeseen"]
        assert [f"seems to have drifted: {each}. A plan" in text
                for each, text in zip(said, texts, strict=True)] == [True] * len(said)  # fmt: skip


@pytest.mark.parametrize("practice", [None, "per-station"], ids=["exact", "per station"])
def test_the_noise_beside_a_drift_leaves_s_at_one(practice):
    """Three times the noise, at stations whose angles err by more than it: it is still near that of the simulation."""
    readings, rng = runs(44, 30, field=45.0, offset=3e-4), np.random.default_rng(44)
    if practice:
        sd = {name: np.radians(0.02) for name in ("inclination", "azimuth", "toolface")}
        known = {n: readings.known[n] + s * rng.normal(size=(30, COUNT)) for n, s in sd.items()}
        readings = replace(readings, known=readings.known | known, sd=sd, settings=practice)
    options, seen = Options(order=0), 0
    for _, result in by_drift(fit(readings, options), options):
        np.testing.assert_allclose(result.analysis.variance_factor, 1, atol=2e-3)
        if all(name in drifts(result) for name in ("accelerometer-drift", "field-drift")):
            np.testing.assert_allclose(np.median(result.noise, 0), [1e-4, 15.0], rtol=0.15)
            seen += len(result.noise)
    assert seen > 10


def test_the_chance_of_a_drift_is_that_of_the_run_as_a_steady_one():
    """As the decision had it, by noise that the fit without the drift has."""
    readings, rng = runs(44, 30, offset=3e-4), np.random.default_rng(44)
    sd = {name: np.radians(0.02) for name in ("inclination", "azimuth", "toolface")}
    known = {n: readings.known[n] + s * rng.normal(size=(30, COUNT)) for n, s in sd.items()}
    readings = replace(readings, known=readings.known | known, sd=sd, settings="per-station")
    options = Options(order=0)
    steady = fit(readings, options)
    decided = chances(steady)[0]
    for places, result in by_drift(steady, options):
        if result.problem.walks:
            later = chances_without_drift(result, options)
            np.testing.assert_allclose(np.log(later), np.log(decided[places]), atol=0.01)


def test_the_expected_errors_include_the_drift_that_corrected_readings_keep():
    """Three times the noise: by noise and stand alone the ratios of most observables would be above 1.3."""
    readings, options, rows = runs(45, 60, field=45.0, offset=3e-4), Options(order=0), []
    for places, result in by_drift(fit(readings, options), options):
        if all(name in drifts(result) for name in ("accelerometer-drift", "field-drift")):
            raw = readings.accelerometer[places], readings.magnetometer[places]
            rows += error_rows(Residuals(Readings(*raw, known=readings.known, sd={}), result))
    assert len(rows) > 30
    for each in zip(*rows, strict=True):
        after, expected = np.transpose([(row.after, row.expected) for row in each])
        ratio = np.sqrt(np.mean(after**2) / np.mean(expected**2))
        assert ratio == pytest.approx(1.0, abs=0.1), each[0].observable


def test_a_member_of_a_batch_drifts_as_it_does_alone():
    readings, options = runs(4, 12, field=40.0), Options(order=0)
    each = {}
    for places, result in by_drift(fit(readings, options), options):
        change = drifts(result).get("field-drift", (np.zeros(len(places)),))[0]
        each |= dict(zip(places.tolist(), change.tolist(), strict=True))
    for place in (0, 5, 11):
        one = Readings(
            readings.accelerometer[[place]],
            readings.magnetometer[[place]],
            known=readings.known,
            sd={},
        )
        [(_, result)] = by_drift(fit(one, options), options)
        alone = drifts(result).get("field-drift", (np.zeros(1),))[0]
        np.testing.assert_allclose(each[place], alone[0], rtol=1e-9)


def test_a_large_drift_is_no_error_against_the_references():
    """20 mg from end to end, two hundred times the noise: the errors of gravity are those of the drift."""
    readings = runs(5, 1)
    slope = 0.02 * np.linspace(0.0, 1.0, COUNT)[:, None] * np.array([0.0, 1.0, 0.0])
    raw = readings.accelerometer[0] + slope
    declared = {"accelerometer": np.array(1e-4), "magnetometer": np.array(15.0)}
    one = Readings(raw, readings.magnetometer[0], known=readings.known, sd=declared)
    record = calibrate(one, Profile(name="x"), Options(order=0))
    assert {finding.id for finding in record.findings} >= {"accelerometer-drift"}


@pytest.mark.parametrize(
    ("places", "said"),
    [(np.arange(COUNT), True), (np.r_[0:COUNT:2, COUNT - 1 : 0 : -2], False)],
    ids=["one direction after the other", "there and back"],
)
def test_steadiness_that_no_residual_tests_is_said(places, said):
    readings = runs(2, 1)
    known = {name: value[places] for name, value in readings.known.items()}
    raw = (values[0, places] for values in (readings.accelerometer, readings.magnetometer))
    record = calibrate(Readings(*raw, known=known, sd={}), Profile(name="x"), Options(order=0))
    assert ("steady accelerometer offsets" in record.assumed_exact) == said


def test_the_share_of_a_trend_is_that_of_a_regression():
    """Second formula: regression of accelerometer trends on the sensors' parameters, at exact attitudes."""
    result = fit(runs(2, 1), Options(order=0))
    attitude = result.state.attitude[0]
    g = attitude[..., 2]
    trend = (np.arange(COUNT) + 0.5) / COUNT - 0.5
    known = np.column_stack([g, np.ones(COUNT)])
    left = trend - known @ np.linalg.lstsq(known, trend, rcond=None)[0]
    scores = walk_scores(result.problem, result.state, result.analysis)
    share = scores.shown("accelerometer-drift")[0]
    assert share == pytest.approx(left @ left / (trend @ trend), rel=1e-3)


def test_the_misfit_of_a_trend_is_that_of_a_regression():
    """Second formula: what an accelerometer trend takes off the squares of residuals, axis by axis."""
    readings = runs(2, 3, offset=3e-4, straight=True)
    readings = replace(
        readings, sd={"accelerometer": np.full(3, 1e-4), "magnetometer": np.full(3, 15.0)}
    )
    result = fit(readings, Options(order=0))
    g = np.einsum("nij,nj->ni", result.state.attitude[0], earth_gravity(np.ones(COUNT)))
    known, trend = np.column_stack([g, np.ones(COUNT)]), np.arange(COUNT, dtype=float)
    scores = walk_scores(result.problem, result.state, result.analysis)
    for place, raw in enumerate(readings.accelerometer):
        whole = np.column_stack([known, trend])
        squares = [np.sum(np.linalg.lstsq(each, raw, rcond=None)[1]) for each in (known, whole)]
        expected = (squares[0] - squares[1]) / 1e-8
        assert scores.trend("accelerometer-drift")[place] == pytest.approx(expected, rel=1e-2)


def thermal(seed, tools, offset):
    """Nominal tools at four directions, four temperatures one after the other, with an accelerometer trend, 1σ in g."""
    rng = np.random.default_rng(seed)
    parts = [runs(seed * 10 + k, tools) for k in range(4)]
    raw = [
        np.concatenate([getattr(p, n) for p in parts], 1) for n in ("accelerometer", "magnetometer")
    ]
    trend = np.linspace(-0.5, 0.5, 4 * COUNT)[:, None] * rng.normal(size=(tools, 1, 3))
    known = {n: np.tile(v, 4) for n, v in parts[0].known.items()}
    warmth = np.broadcast_to(np.repeat([25.0, 45.0, 65.0, 85.0], COUNT), (tools, 4 * COUNT))
    return Readings(raw[0] + offset * trend, raw[1], warmth, known=known, sd={})


def test_a_trend_that_a_term_of_temperature_takes_up_is_seen_within_the_soaks():
    """2 mg over a run that only warms: most of it looks like the first power of temperature."""
    options = Options(order=1, model="polynomial")
    for offset, low, high in ((2e-3, 0.9, 1.0), (0.0, 0.0, 0.25)):
        named = 0
        for _, result in by_drift(fit(thermal(7, 60, offset), options), options):
            named += len(result.status) * ("accelerometer-drift" in drifts(result))
        assert low <= named / 60 <= high


@pytest.mark.slow
def test_a_trend_that_would_hardly_show_is_seldom_seen_in_noise():
    """Of steady runs that only warm at most one in a hundred by each triad: there the angles are many times worse."""
    options, tools = Options(order=1, model="polynomial"), 200
    drifted, _ = drifting(fit(thermal(8, tools, 0.0), options), options)
    trends, walks = drifted.mean(0)
    assert np.all(trends < 0.01 + 3 * np.sqrt(0.01 * 0.99 / tools))
    assert np.all(walks < 0.1 + 3 * np.sqrt(0.1 * 0.9 / tools))
    assert np.all(walks > 0.02)


def offset_errors(result):
    """Errors (B,) of the field of nominal accelerometers at two temperatures, root mean square, g."""
    axes, warmth = np.tile(np.vstack([np.eye(3), -np.eye(3)]), (2, 1)), np.repeat([25.0, 85.0], 6)
    model, where = result.problem.triads[0].model, result.problem.slices()[0]
    found = model.fields(result.state.params[:, where], axes[None], warmth[None])
    return np.sqrt(np.mean((found - axes) ** 2, (1, 2)))


def test_a_walk_without_its_trend_costs_no_accuracy_and_the_trend_stays_unseen():
    options = Options(order=1, model="polynomial")
    steady = fit(thermal(8, 80, 0.0), options)
    alone, count = offset_errors(steady), 0
    for places, result in by_drift(steady, options):
        for name, held in held_trends(result.problem).items():
            np.testing.assert_array_equal(unseen_drifts(result)[name][held], True)
            if name == "accelerometer-drift" and held.all():
                count += len(places)
                assert np.mean(offset_errors(result)) < 1.2 * np.mean(alone)
                assert "steady accelerometer offsets" in assumed_exact(result, relative=False)[0]
    assert count > 2


def test_a_drift_of_next_to_no_size_is_not_stated():
    """Run 10 of these follows its order as if the field drifted; beside it the magnetometer's walk came out at zero."""
    readings = runs(11, 120)
    raw = readings.accelerometer[10], readings.magnetometer[10]
    record = calibrate(
        Readings(*raw, known=readings.known, sd={}), Profile(name="x"), Options(order=0)
    )
    [drift] = record.drift
    assert drift.name == "field"
    assert drift.standard_uncertainty > 0.1  # nT, of 15 nT of noise


def test_a_wrong_prior_is_no_drift(tmp_path):
    """The calibration of another tool leaves residuals that go with attitude, and so with the order of stations."""
    previous = calibrated(tmp_path, servo_run(1))
    run = write_csv(tmp_path / "later.csv", servo_run(3))
    given = ("--tool", "servo", "--prior", previous, "-o", tmp_path / "later.json")
    made = mwdcal("calibrate", run, *given, "--json")
    assert made.code == 0, made
    found = {finding["id"] for finding in made.json["findings"]}
    assert "prior-conflict" in found
    assert not found & {"accelerometer-drift", "magnetometer-drift", "field-drift"}


def off(readings, name, degrees):
    """The readings with all references of one name off by so many degrees."""
    return replace(
        readings, known={**readings.known, name: readings.known[name] + np.radians(degrees)}
    )


def found(readings):
    """The number of runs with a drift in their fit, and how often each effect is named."""
    drifted, named = 0, Counter()
    for places, result in by_drift(fit(readings, Options(order=0)), Options(order=0)):
        drifted += len(places) * bool(result.problem.walks)
        named.update(name for shown in shown_effects(result, {}) for name in shown)
    return drifted, named


CONSTANT = {"azimuth": "azimuth-zero", "inclination": "inclination-zero", "dip": "dip-reference"}


@pytest.mark.parametrize(
    ("name", "wrong"),
    [("azimuth", 0.1), ("azimuth", 2.0), ("inclination", 0.05), ("dip", 0.1), ("dip", -0.5)],
)
def test_a_constant_error_of_the_references_is_named_and_no_drift(name, wrong):
    """A walk would follow its residuals too, and be so uncertain that nothing shows.

    Noise alone gives each of two triads a drift beside it with a chance of 0.01: 4 of 200 runs, 2 of them 1σ.
    """
    readings = off(runs(31, 200), name, wrong)
    drifted, named = found(readings)
    assert drifted <= 10
    assert named[CONSTANT[name]] >= 196
    one = replace(
        readings,
        accelerometer=readings.accelerometer[0],
        magnetometer=readings.magnetometer[0],
    )
    calibration = calibrate(one, Profile(name="x"), Options(order=0))
    [finding] = [f for f in calibration.findings if f.id == f"looks-like-{CONSTANT[name]}"]
    size, sd = (float(x) for x in re.findall(r"Size (\S+)° ± (\S+)°", finding.text)[0])
    true = -wrong if name == "dip" else wrong
    assert abs(size - true) < 4 * sd + 0.01 * abs(wrong)


def test_a_drift_beside_a_constant_error_is_fitted_and_the_error_named():
    drifted, named = found(off(runs(33, 50, field=60.0), "azimuth", 1.0))
    assert drifted >= 45
    assert named["azimuth-zero"] >= 48


def test_no_drift_is_larger_than_the_fiftieth_part_of_the_field():
    """A second half of the run at another place: half of the field away, or with the axes exchanged."""
    readings = runs(34, 10)
    raw = readings.magnetometer.copy()
    raw[:5, COUNT // 2 :] += 24_000.0
    raw[5:, COUNT // 2 :] = raw[5:, COUNT // 2 :, ::-1]
    result = fit(replace(readings, magnetometer=raw), Options(order=0))
    assert np.all(chances(result)[0][:, 1] < 1e-3)
    drifted, _ = found(replace(readings, magnetometer=raw))
    assert not drifted


def test_a_drift_of_the_field_is_no_wrong_dip():
    for straight in (False, True):
        for _, result in by_drift(
            fit(runs(32, 100, field=60.0, straight=straight), Options(order=0)), Options(order=0)
        ):
            if len(result.status) > 50:
                assert result.problem.walks


def test_what_held_parameters_leave_is_no_drift():
    """A misaligned tool that is fitted with scales and biases alone: its residuals follow the attitudes."""
    readings = runs(5, 1)
    tilted = np.eye(3) + np.array([[0, 0.01, 0], [0, 0, -0.008], [0.005, 0, 0]])
    bent = replace(readings, accelerometer=readings.accelerometer @ tilted)
    options = Options(order=0, parameters=6)
    [(_, result)] = by_drift(fit(bent, options), options)
    assert not result.problem.walks
    assert chances(result)[0][0, 0] < 1e-6


# Declared drifts


def with_sd(readings, **sizes):
    """The readings with declared drifts, g or nT."""
    sd = {f"{name}-drift": np.full(COUNT, size) for name, size in sizes.items()}
    return replace(readings, sd={**readings.sd, **sd})


def one_run(readings, place=0):
    """One of several runs by itself."""
    return Readings(readings.accelerometer[place], readings.magnetometer[place],
                    known=readings.known, sd=readings.sd)  # fmt: skip


def sizes_of(result, name):
    """1σ of the change from the first station to the last that a fit allows for on an axis before the readings."""
    drift = [c for c in result.problem.evidence.constants if c.name == name]
    change = np.array([c.mask[0, -1] - c.mask[0, 0] for c in drift])
    return float(np.linalg.norm(change * [c.sd[0] for c in drift]))


@pytest.mark.parametrize("straight", [False, True], ids=["walk", "straight"])
def test_intervals_include_a_declared_drift_that_no_residual_shows(straight):
    """0.2 mg in runs of one direction after the other: undeclared, the gains' intervals cover less."""
    readings = runs(11, 60, offset=2e-4, straight=straight)
    declared, _ = covered(with_sd(readings, accelerometer=2e-4))
    assert declared.mean() > 0.94
    if straight:
        assert covered(readings)[0].mean() < 0.9


def test_a_declared_drift_is_the_change_from_the_first_station_to_the_last():
    """Half of the variance is a walk, of which cosines hold most; nothing drifts here, and nothing shrinks."""
    options = Options(order=0)
    [(_, result)] = by_drift(fit(with_sd(runs(2, 1), accelerometer=3e-4), options), options)
    assert sizes_of(result, "accelerometer-drift-x") == pytest.approx(3e-4, rel=0.06)


def test_the_larger_of_a_declared_and_a_seen_drift_counts():
    """There and back, 0.6 mg: declared as 0.01 mg it is as large, and no surer, as if nothing had been declared."""
    readings = runs(3, 1, noise=(2e-5, 15.0))
    places = np.r_[0:COUNT:2, COUNT - 1 : 0 : -2]
    slope = 6e-4 * np.linspace(-0.5, 0.5, COUNT)[:, None] * np.array([0.0, 1.0, 0.0])
    known = {name: value[places] for name, value in readings.known.items()}
    raw = readings.accelerometer[0, places] + slope, readings.magnetometer[0, places]
    bare = Readings(*raw, known=known, sd={})
    profile, options = Profile(name="x"), Options(order=0)
    each = [calibrate(r, profile, options) for r in (bare, with_sd(bare, accelerometer=1e-5))]
    seen, declared = (next(d for d in c.drift if d.name == "accelerometer") for c in each)
    assert declared.declared == pytest.approx(0.01)
    assert declared.change == pytest.approx(seen.change, rel=1e-3)
    assert 1 < declared.standard_uncertainty / seen.standard_uncertainty < 1.1


def test_a_declared_drift_of_a_triad_that_shows_none_stays_as_declared():
    """Accelerometers that drift say nothing of magnetometers: those keep the accuracy of a steady run."""
    readings = runs(5, 40, offset=6e-4, straight=True)
    for _, result in by_drift(
        fit(with_sd(readings, magnetometer=0.01), Options(order=0)), Options(order=0)
    ):
        if sizes_of(result, "accelerometer-drift-x") > 1e-5:
            assert sizes_of(result, "magnetometer-drift-x") < 0.05
            break
    else:
        pytest.fail("no drift was seen")


def test_the_closed_form_of_a_declared_drift_is_the_general_fit():
    """A member that leaves a station out takes the batch to the general minimiser."""
    sd = {"accelerometer": np.array(1e-4), "magnetometer": np.array(15.0)}
    readings = replace(with_sd(runs(2, 2), accelerometer=2e-4, field=40.0))
    readings = replace(readings, sd={**readings.sd, **sd})
    include = np.ones((2, COUNT))
    include[1, 5] = 0
    closed, general = (fit(readings, Options(order=0), use) for use in (include[0], include))
    for name in ("params", "constants"):
        a, b = (getattr(each.state, name)[0] for each in (closed, general))
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-6 * np.abs(b).max())
    a, b = (np.diag(each.analysis.covariance[0]) for each in (closed, general))
    np.testing.assert_allclose(a, b, rtol=1e-6)
    assert closed.analysis.freedom[0] == pytest.approx(general.analysis.freedom[0], rel=1e-6)


def test_noise_without_a_station_of_a_run_that_drifted_is_by_the_sums_over_the_others():
    """Against the general way, for drifts of one triad and of both."""
    for offset, field in ((2e-3, 0.0), (0.0, 300.0), (2e-3, 300.0)):
        result = fit(runs(3, 5, field, offset))
        triads = np.array([offset > 0, field > 0])
        drifted = with_drift(result, Options(), triads)
        assert closed_form_drift.applies(drifted.problem)
        at = drifted.problem, drifted.state, drifted.analysis, np.arange(5), np.arange(0, 45, 9)
        found = closed_form_drift.left_out_variances(*at)
        for ours, general in zip(found, left_out_variances(*at), strict=True):
            np.testing.assert_allclose(ours, general, rtol=1e-9)


@pytest.mark.parametrize(
    "changes",
    [{"robust": "huber"}, {"parameters": 6}, {"method": "newton"}, {"method": "least-squares"},
     {"method": "toolface-inclination", "paper_weights": True}],
    ids=str,
)  # fmt: skip
def test_every_fit_includes_a_declared_drift(changes):
    """As independent errors: where the drift is much larger than the noise, σ is in proportion to it."""
    profile, options = Profile(name="x"), Options(order=0, **changes)
    readings = one_run(runs(2, 1))
    if "paper_weights" in changes:
        with pytest.raises(FitError, match="accelerometer-drift"):
            calibrate(with_sd(readings, accelerometer=2e-3), profile, options)
        return
    each = [calibrate(with_sd(readings, accelerometer=u), profile, options) for u in (2e-3, 4e-3)]
    small, large = (next(r for r in c.budget if "accelerometer" in r.source) for c in each)
    assert small.inclination_deg > 0.02
    assert large.inclination_deg == pytest.approx(2 * small.inclination_deg, rel=0.1)


def test_a_field_drift_needs_a_field_in_nanotesla():
    readings = one_run(with_sd(runs(2, 1), field=40.0))
    known = {name: value for name, value in readings.known.items() if name != "field"}
    with pytest.raises(FitError, match="Give ref_field_nt"):
        calibrate(replace(readings, known=known), Profile(name="x"), Options(order=0))


def test_what_is_declared_is_not_taken_as_steady():
    readings = one_run(with_sd(runs(2, 1), accelerometer=2e-4))
    record = calibrate(readings, Profile(name="x"), Options(order=0))
    assert "steady accelerometer offsets" not in record.assumed_exact
    assert "accelerometer" not in {each.name for each in record.unseen}
    assert any(
        "declared drift" in line and "accelerometer 0.2 mg" in line for line in remarks(record)
    )
    [line] = [x for x in budget(record).lines if x.source.startswith("drift of the accelerometer")]
    assert "0.2 mg" in line.basis


def errors_at_45(gain, offset):
    """Root mean squares of inclination and toolface errors, degrees, of a nominal accelerometer so corrected."""
    azimuth_free = np.radians(np.arange(0.0, 360.0, 5.0))
    down = np.sqrt(0.5) * np.column_stack(
        [-np.cos(azimuth_free), np.sin(azimuth_free), 0 * azimuth_free + 1]
    )
    change = down @ (gain - np.eye(3)).T + offset
    across = np.column_stack(
        [-np.cos(azimuth_free), np.sin(azimuth_free), -1 + 0 * azimuth_free]
    ) / np.sqrt(2)
    around = np.column_stack([np.sin(azimuth_free), np.cos(azimuth_free), 0 * azimuth_free])
    inclination = np.sum(change * across, 1)
    toolface = np.sum(change * around, 1) / np.sqrt(0.5)
    return np.degrees([np.sqrt(np.mean(inclination**2)), np.sqrt(np.mean(toolface**2))])


def test_what_an_unseen_drift_would_do_is_what_it_does():
    """Second formula: 0.1 mg put on one axis after the other of noise-free readings, and regression.

    The tool is used as it was at the first station or at the last: half the squares of both.
    """
    readings = one_run(runs(2, 1))
    record = calibrate(readings, Profile(name="x"), Options(order=0))
    [unseen] = [each for each in record.unseen if each.name == "accelerometer"]
    assert (unseen.change, unseen.unit) == (pytest.approx(0.1), "mg")
    known = readings.known
    g = tool_from_earth(*(known[n] for n in ("inclination", "azimuth", "toolface")))[..., 2]
    place, squares = np.linspace(0, 1, COUNT), np.zeros(2)
    for start in (0.0, 1.0):
        for axis in np.eye(3):
            raw = g + 1e-4 * (place - start)[:, None] * axis
            fitted = np.linalg.lstsq(np.column_stack([g, np.ones(COUNT)]), raw, rcond=None)[0].T
            gain = np.linalg.inv(fitted[:, :3])
            squares += errors_at_45(gain, -gain @ fitted[:, 3]) ** 2 / 2
    stated = unseen.inclination_deg, unseen.toolface_deg
    assert stated == pytest.approx(np.sqrt(squares), rel=0.03)


def test_a_plan_includes_a_declared_drift_and_a_simulation_draws_it():
    inc, azi = np.repeat([[5, 45, 90, 135], [0, 90, 180, 270]], 12, axis=1)
    face = np.tile(np.arange(12) * 30.0, 4)
    names = (f"ref_{name}_deg" for name in ("inclination", "azimuth", "toolface"))
    plan = Table(
        dict(zip(names, (inc * 1.0, azi * 1.0, face), strict=True)), {}, "plan", range(1, 49)
    )
    sensors = {"accelerometer": TriadProfile(scale=1.0, noise=1e-4, drift=2e-4),
               "magnetometer": TriadProfile(scale=1.0, noise=15.0)}  # fmt: skip
    profile = Profile(name="x", stand=StandProfile(field_drift_nt=40.0), **sensors)
    sources = {row.source: row for row in expected(plan, profile).budget}
    assert sources["drift of the accelerometer during the run"].inclination_deg > 0.002
    assert sources["drift of the field during the run"].azimuth_deg > 0.005
    session = with_sd(one_run(runs(2, 1)), accelerometer=2e-4)
    moved = drifted(np.random.default_rng(1), session, "accelerometer-drift", (4000,))
    assert np.all(moved[:, 0] == 0)
    assert moved[:, -1].std() == pytest.approx(2e-4, rel=0.03)


def test_student_s_t_is_that_of_scipy():
    freedom = np.geomspace(FEWEST_USED, 1e9, 500)
    np.testing.assert_allclose(
        student_squares()(1 / freedom), special.stdtrit(freedom, 0.975) ** 2, rtol=1e-13
    )
