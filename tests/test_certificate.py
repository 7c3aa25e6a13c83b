"""Contents of certificates: against second formulas, hand computations and draws."""

import hashlib
import json
import math
from dataclasses import replace as with_fields
from datetime import UTC, date, datetime

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from scipy import stats

import mwdcal
from cli_support import EXAMPLE, servo_run, write_csv
from mwdcal.calibration.record import Finding
from mwdcal.certificate import contents, decisions
from mwdcal.certificate.budget import budget
from mwdcal.certificate.contents import CertificateRequest, certificate
from mwdcal.certificate.document import (
    DecisionRule,
    Laboratory,
    LaboratoryCondition,
    Person,
    Recalibration,
)
from mwdcal.files import verifications
from mwdcal.presentation import certificate as presented
from mwdcal.sensor.profile import MeasurementStandard
from mwdcal.use.verification import JudgedSet, VerdictRow

SIXTH = np.radians(np.arange(0, 360, 30))


@pytest.fixture(scope="module")
def servo():
    """The calibration of the example run."""
    profile = mwdcal.load_profile(EXAMPLE / "tool.toml")
    return mwdcal.calibrate(mwdcal.read_run(EXAMPLE / "run.csv", profile))


@pytest.fixture(scope="module")
def thermal(tmp_path_factory):
    """A calibration over temperature with declared common errors of stand and references."""
    profile = mwdcal.load_profile(EXAMPLE / "tool.toml")
    common = {
        "azimuth_zero_deg": 0.03,
        "toolface_zero_deg": 0.02,
        "tilt_deg": 0.01,
        "tool_axis_deg": 0.03,
        "gravity_g": 2e-5,
    }
    stand = replace(profile.stand, field_nt=30.0, dip_deg=0.02, **common)
    columns = servo_run(temperatures=(10.0, 45.0, 80.0))
    run = write_csv(tmp_path_factory.mktemp("thermal") / "run.csv", columns, "date = 2026-03-15")
    return mwdcal.calibrate(mwdcal.read_run(run, replace(profile, stand=stand)), order=1)


def order(**values):
    return CertificateRequest(
        **{"issued": datetime.now(UTC).date(), "calibration_sha256": "0" * 64, **values}
    )


def issued(calibration, laboratory=None, **values):
    return certificate(calibration, order(**values), laboratory)


def table(document, name):
    (found,) = (each for each in document.results if each.id == name)
    return {quantity.id: quantity for quantity in found.quantities}


def named(findings):
    return {finding.id: finding.text for finding in findings}


# ------------------------------------------------------------------ uncertainty


def angles_of(g, b):
    """Inclination, toolface and azimuth (n, 3), radians, of vectors, by their definitions in the tool's frame."""
    size = np.linalg.norm(g, axis=-1)
    east = np.cross(
        b, g
    )  # of the earth, in the tool's frame: b × g points to magnetic west or east
    north = np.cross(g, east)
    azimuth = np.arctan2(-east[:, 2] * size, north[:, 2])
    return np.stack([np.arccos(g[:, 2] / size), np.arctan2(-g[:, 0], -g[:, 1]), azimuth], -1)


def propagated(calibration, inclination, temperature):
    """1σ (3,) in degrees of the angles at an inclination, rms over azimuth and toolface: differences of the angles
    of corrected readings, for steps along the parameters, in the covariance of the file."""
    azimuth, toolface = (a.ravel() for a in np.meshgrid(SIXTH, SIXTH))
    at = mwdcal.calibration.results.readings_at(
        calibration, inclination, azimuth, toolface, temperature
    )
    covariance = calibration.parameter_covariance
    sizes = np.sqrt(np.diag(covariance))
    changes = []
    for place, size in enumerate(sizes):
        both = []
        for sign in (1, -1):
            moved = calibration.parameters
            moved[place] += sign * size
            both.append(angles_of(*with_parameters(calibration, moved).fields(at)))
        change = (both[0] - both[1] + np.pi) % (2 * np.pi) - np.pi
        changes.append(change / (2 * size) if size else 0 * change)
    rows = np.stack(changes, -1)  # (n, 3, p)
    variance = np.einsum("nai,ij,naj->na", rows, covariance, rows)
    return np.degrees(np.sqrt(variance.mean(0)))


def with_parameters(calibration, parameters):
    parts = np.split(parameters, [len(calibration.accelerometer.parameters)])
    first, second = (
        replace(triad, parameters=part.tolist())
        for triad, part in zip(calibration.triads, parts, strict=True)
    )
    return replace(calibration, accelerometer=first, magnetometer=second)


def sums(document):
    line = document.combined
    return np.array([line.inclination_deg, line.toolface_deg, line.azimuth_deg])


@pytest.mark.parametrize("name", ["servo", "thermal"])
def test_the_lines_of_the_budget_add_up_to_the_covariance_propagated_by_differences(name, request):
    calibration = request.getfixturevalue(name)
    result = budget(calibration)
    warm = float(np.clip(30.0, *calibration.temperature_c))
    np.testing.assert_allclose(sums(result), propagated(calibration, math.pi / 4, warm), rtol=2e-5)
    squares = np.zeros(3)
    for line in result.lines:
        squares += np.square([line.inclination_deg, line.toolface_deg, line.azimuth_deg])
    np.testing.assert_allclose(np.sqrt(squares), sums(result), rtol=1e-9)


def test_every_source_that_is_declared_has_a_line_and_the_others_are_named_as_exact(servo, thermal):
    lines = {line.id: line for line in budget(thermal).lines}
    declared = {
        *("noise-of-the-readings", "settings-of-the-stand", "tilt-of-the-stand"),
        *("azimuth-zero-of-the-stand", "toolface-zero-of-the-stand"),
        "alignment-of-the-tool-in-the-stand",
        *("gravity-reference-error", "field-reference-error", "dip-reference-error"),
    }
    assert declared <= {*lines}
    assert lines["toolface-zero-of-the-stand"].toolface_deg == pytest.approx(0.02, rel=1e-3)
    lean = 0.03 / math.sqrt(
        2
    )  # one of two turns: inclination by it, azimuth by it over the sine of 45°
    assert lines["alignment-of-the-tool-in-the-stand"].inclination_deg == pytest.approx(
        lean, rel=1e-3
    )
    assert lines["alignment-of-the-tool-in-the-stand"].azimuth_deg == pytest.approx(0.03, rel=1e-3)
    exact = {key for key, line in lines.items() if line.basis.startswith("assumed exact")}
    steady = {key for key in exact if key.startswith("steady-")}
    warmed = "sensors-at-the-temperature-of-the-thermometer"
    assert exact - steady == {"inclination-zero-of-the-stand", warmed}
    assert len(steady) == 3  # its soaks only become hotter: a drift looks like temperature
    assert lines["noise-of-the-readings"].kind == "A"
    assert {lines[key].kind for key in declared - {"noise-of-the-readings"}} == {"B"}
    every = {line.id for line in budget(servo).lines if line.basis.startswith("assumed exact")}
    assert {"gravity-reference", "field-reference", "dip-reference", "tilt-of-the-stand"} <= every
    assert "gravity reference" in named(issued(servo).findings)["assumed-exact"]


def test_repeatability_takes_its_share_of_the_noise():
    """Of each triad by itself: squares of the shares add up."""
    profile = mwdcal.load_profile(EXAMPLE / "tool.toml")

    def split(accelerometer, magnetometer):
        triads = {}
        for name, share in (("accelerometer", accelerometer), ("magnetometer", magnetometer)):
            triad = getattr(profile, name)
            noise, repeated = triad.noise * math.sqrt(1 - share), triad.noise * math.sqrt(share)
            triads[name] = replace(triad, noise=noise, repeatability=repeated)
        run = mwdcal.read_run(EXAMPLE / "run.csv", replace(profile, **triads))
        rows = {row.source: row for row in mwdcal.calibrate(run).budget}
        names = ("noise of the readings", "repeatability of the readings")
        angles = ("inclination_deg", "toolface_deg", "azimuth_deg")
        both = [[getattr(rows[n], a) if n in rows else 0.0 for a in angles] for n in names]
        return np.square(both)

    whole, nothing = split(0.0, 0.0)
    assert not nothing.any()
    for shares in ((0.5, 0.5), (0.3, 0.0), (0.0, 0.6), (0.3, 0.6)):
        np.testing.assert_allclose(split(*shares).sum(0), whole, rtol=1e-6)
    np.testing.assert_allclose(split(0.5, 0.5)[1], whole / 2, rtol=1e-6)
    both = split(0.3, 0.0)[1] + split(0.0, 0.6)[1]
    np.testing.assert_allclose(split(0.3, 0.6)[1], both, rtol=1e-6)
    np.testing.assert_allclose(
        split(0.3, 0.0)[1] / 0.3 + split(0.0, 0.6)[1] / 0.6, whole, rtol=1e-6
    )


def test_the_line_of_repeatability_is_what_such_errors_do_to_the_angles():
    """Drawn: errors of the size of the accelerometer's repeatability in the readings of the run, and a new fit."""
    profile = mwdcal.load_profile(EXAMPLE / "tool.toml")
    repeated = 2.4e-4
    triad = replace(profile.accelerometer, noise=1.8e-4, repeatability=repeated)
    profile = replace(profile, accelerometer=triad)
    run = mwdcal.read_run(EXAMPLE / "run.csv", profile)
    first = mwdcal.calibrate(run)
    (row,) = (row for row in first.budget if row.source == "repeatability of the readings")
    grid = np.meshgrid([math.pi / 4], SIXTH, SIXTH)
    azimuth, toolface = (angle.ravel() for angle in grid[1:])
    at = mwdcal.calibration.results.readings_at(first, math.pi / 4, azimuth, toolface)
    here, rng, squares, count = angles_of(*first.fields(at)), np.random.default_rng(3), 0.0, 60
    for _ in range(count):
        error = rng.normal(0, repeated / triad.scale, run.accelerometer.shape)
        drawn = with_fields(run, accelerometer=run.accelerometer + error)
        change = angles_of(*mwdcal.calibrate(drawn).fields(at)) - here
        squares = squares + np.mean(((change + np.pi) % (2 * np.pi) - np.pi) ** 2, 0)
    scale = math.sqrt(first.accelerometer.variance_factor)
    stated = np.array([row.inclination_deg, row.toolface_deg]) / scale
    # each draw moves 12 parameters: the mean square over attitudes has several degrees of freedom
    np.testing.assert_allclose(
        np.degrees(np.sqrt(squares[:2] / count)), stated, rtol=4 / math.sqrt(2 * 2 * count)
    )


STUDENT = {1: 12.71, 2: 4.30, 3: 3.18, 5: 2.57, 10: 2.23, 20: 2.09, 50: 2.01, 100: 1.984}
"""JCGM 100:2008, table G.2, t for 95 %."""


def test_coverage_factors_are_those_of_the_table_of_student():
    for freedom, factor in STUDENT.items():
        assert float(decisions.student_factor(freedom)) == pytest.approx(factor, abs=0.005)
    assert float(decisions.student_factor(np.inf)) == pytest.approx(1.96, abs=5e-4)
    assert decisions.student_factor(0.2) == decisions.student_factor(1.0)


def test_parameters_have_the_coverage_factor_of_their_degrees_of_freedom(servo):
    scarce = {"degrees_of_freedom": 5.0, "noise_source": "estimated from the residuals"}
    few = replace(servo, accelerometer=replace(servo.accelerometer, **scarce))
    for quantity in table(issued(few), "accelerometer").values():
        assert quantity.coverage_factor == pytest.approx(2.57, abs=0.005)
        product = quantity.coverage_factor * quantity.standard_uncertainty
        assert quantity.expanded_uncertainty == pytest.approx(product, rel=1e-9)
    assert issued(few).budget.coverage_factor >= 2.57 - 0.005
    values = dict(
        zip(servo.accelerometer.parameter_names, servo.accelerometer.parameters, strict=True)
    )
    shown = table(issued(servo), "accelerometer")
    assert {name: quantity.value for name, quantity in shown.items()} == values
    assert {shown[n].unit for n in ("gain-xx", "offset-x")} == {"1", "g"}


def test_the_accuracy_is_that_of_the_calibration_at_the_attitudes_and_temperatures(thermal):
    rows = table(issued(thermal), "accuracy")
    assert len(rows) == 3 * 3 * 3  # angles, inclinations, temperatures
    for temperature in (10.0, 30.0, 80.0):
        for inclination in (5, 45, 90):
            expected = propagated(thermal, math.radians(inclination), temperature)
            names = ("inclination", "toolface", "azimuth")
            each = [rows[f"{name}-{inclination}-{temperature:.1f}c"] for name in names]
            assert [quantity.value for quantity in each] == [0.0, 0.0, 0.0]
            np.testing.assert_allclose([q.standard_uncertainty for q in each], expected, rtol=1e-3)
            assert all(1.9599 < q.coverage_factor < 2.6 for q in each), each


def test_the_coverage_factor_is_that_of_welch_and_satterthwaite(thermal):
    """Of lines with these degrees of freedom; computed by hand."""
    from mwdcal.calibration.record import NOISE, ORDER, BudgetRow

    def factor(noise, order, freedom):
        sizes = {NOISE: noise, ORDER: order, "tilt of the stand": 1.0}
        rows = [
            BudgetRow(source=source, inclination_deg=size, toolface_deg=size, azimuth_deg=size)
            for source, size in sizes.items()
        ]
        scarce = {"degrees_of_freedom": freedom, "noise_source": "estimated from the residuals"}
        first = replace(thermal.accelerometer, **scarce)
        odd = replace(thermal, budget=rows, accelerometer=first)
        return budget(odd).coverage_factor

    def student(freedom):
        return pytest.approx(stats.t.ppf(0.975, freedom), rel=1e-9)

    assert factor(1.0, 0.0, 5.0) == student(
        5.0
    )  # 4 / (1/5) = 20, and never more than the triad has
    assert factor(1.0, 3.0, 50.0) == student(121 / (1 / 50 + 27))
    assert factor(0.0, 4.0, 50.0) == student(289 / (256 / 3))


def test_parameters_over_temperature_have_units_per_degree(thermal):
    rows = table(issued(thermal), "magnetometer")
    units = {name: rows[name].unit for name in rows if name.startswith(("bias-x", "scale-x"))}
    assert {units["bias-x"], units["scale-x"]} == {"nT", "1"}
    for power, unit in (("1", "/°C"), ("2", "/°C2")):
        for name, whole in ((f"bias-x·{power}", f"nT{unit}"), (f"scale-x·{power}", f"1{unit}")):
            assert units.get(name, whole) == whole
    assert len(units) > 2


def test_what_is_undetermined_has_no_value_and_no_sum():
    profile = mwdcal.load_profile(EXAMPLE / "tool.toml")
    run = mwdcal.read_run(EXAMPLE / "run.csv", profile)
    free = mwdcal.calibrate(run, method="newton")
    assert free.undetermined()
    document = issued(free)
    states = dict(
        zip(
            free.accelerometer.parameter_names,
            free.accelerometer.standard_uncertainties,
            strict=True,
        )
    )
    lost = {name for name, sd in states.items() if sd is None}
    assert lost
    for name, quantity in table(document, "accelerometer").items():
        assert (quantity.value is None) == (name in lost)
        assert (quantity.expanded_uncertainty is None) == (name in lost)
    combined, expanded = document.budget.combined, document.budget.expanded
    assert (combined.toolface_deg, expanded.toolface_deg) == (None, None)
    assert combined.inclination_deg > 0
    angles = table(document, "accuracy")
    assert angles["toolface-45"].value is None
    assert angles["toolface-45"].expanded_uncertainty is None


# ------------------------------------------------------------------ decisions

HAND = (  # value, 1σ, limit, two-sided, probability within: tables of the normal distribution
    (0.08, 0.01, 0.10, False, 0.97725),
    (0.10, 0.01, 0.10, False, 0.5),
    (0.13, 0.02, 0.10, False, 0.06681),
    (0.00, 0.05, 0.10, True, 0.95450),
    (0.05, 0.05, 0.10, True, 0.84134 - 0.00135),
    (0.02, 0.00, 0.10, True, 1.0),
    (0.20, 0.00, 0.10, False, 0.0),
)


@pytest.mark.parametrize(("value", "sd", "limit", "two_sided", "expected"), HAND)
def test_probabilities_are_those_of_the_tables_and_of_draws(value, sd, limit, two_sided, expected):
    result = decisions.probability_within(value, sd, limit, two_sided)
    assert result == pytest.approx(expected, abs=6e-6)
    drawn = value + sd * np.random.default_rng(5).normal(size=200_000)
    share = np.mean(np.abs(drawn) <= limit if two_sided else drawn <= limit)
    assert result == pytest.approx(share, abs=4 * 0.5 / math.sqrt(200_000))


def row(value=0.08, sd=0.01, limit=0.1, name="spread of inclination"):
    passed = value <= limit
    return VerdictRow(
        name=name, unit="°", value=value, uncertainty=sd, limit=limit, passed=passed, note="here"
    )


def verification(calibration, *rows, rule="simple", **values):
    """What `verify` prints of some rows."""
    verdict = mwdcal.verify(
        calibration, mwdcal.read_run(EXAMPLE / "rolltest.csv", calibration.profile)
    )
    head = {"schema_version": 1, "command": "verify", "software": "mwdcal", "serial": "SIM-0001"}
    known = {
        "simulated": True,
        "calibration_sha256": "0" * 64,
        "run_sha256": None,
        "limits_sha256": None,
    }
    fields = {**msgspec.structs.asdict(verdict), **head, **known, **values}
    chosen = list(rows) or fields["rows"]
    passed = all(each.passed for each in chosen)
    rule = decisions.RULES[rule]
    return verifications.Verification(**{**fields, "rows": chosen, "passed": passed, "rule": rule})


def test_a_guard_band_shrinks_the_limit_and_a_changed_decision_is_a_finding(servo):
    test = verification(servo, row(), row(0.095, name="error of azimuth"))
    simple = issued(servo, verification=test).as_left
    assert simple.passed
    assert simple.rule == "simple"
    assert [d.acceptance_limit for d in simple.decisions] == [0.1, 0.1]
    assert [d.risk for d in simple.decisions] == pytest.approx([0.02275, 0.30854], abs=1e-5)
    rule = DecisionRule(rule="guarded", guard_factor=1.5, risk="agreed")
    document = issued(servo, Laboratory(decision=rule), verification=test)
    guarded = document.as_left
    assert (guarded.passed, guarded.rule) == (False, "guarded")
    # U = 2 u, as Student's factor for 70 degrees of freedom is below 2; guard band 1.5 U = 0.03
    assert [d.acceptance_limit for d in guarded.decisions] == pytest.approx([0.07, 0.07])
    assert [d.passed for d in guarded.decisions] == [False, False]
    assert [d.risk for d in guarded.decisions] == pytest.approx([0.97725, 0.69146], abs=1e-5)
    assert (
        "spread of inclination passed by the rule of the verification, failed"
        in (named(document.findings)["decision-changed"])
    )
    assert "agreed" in guarded.rule_text
    assert any("agreed" in statement for statement in document.statements)


def test_the_rule_of_a_guarded_verification_stands(servo):
    close = row(0.085)
    guarded = verification(servo, replace(close, passed=False), rule="guarded")
    for choice in (None, DecisionRule(rule="simple")):
        document = issued(servo, Laboratory(decision=choice), verification=guarded)
        assert document.as_left.rule == "guarded"
        assert not document.as_left.passed
        assert document.as_left.decisions[0].acceptance_limit == pytest.approx(0.08)
        assert "decision-changed" not in named(document.findings)


def test_each_roll_test_has_the_factor_of_the_calibration_that_it_tests(servo):
    """Student's factors of 95 % for 10 and 5 degrees of freedom by JCGM 100, table G.2."""
    as_found = verification(servo, row(), calibration_sha256="1" * 64, degrees_of_freedom=10.0)
    document = issued(servo, as_found=as_found, verification=verification(servo, row()))
    (before,), (after,) = document.as_found.decisions, document.as_left.decisions
    assert before.quantity.expanded_uncertainty == pytest.approx(2.23 * 0.01, abs=5e-5)
    assert after.quantity.expanded_uncertainty == pytest.approx(2.0 * 0.01)
    guarded = Laboratory(decision=DecisionRule(rule="guarded"))
    five = replace(as_found, degrees_of_freedom=5.0)
    (decision,) = issued(servo, guarded, as_found=five).as_found.decisions
    assert decision.acceptance_limit == pytest.approx(0.1 - 2.57 * 0.01, abs=5e-5)
    assert "freedom-not-stated" not in named(document.findings)


def test_a_test_that_does_not_state_its_degrees_of_freedom_has_a_finding(servo):
    """Of an earlier version: as left those of the calibration are known, as found they are not."""
    old = verification(servo, row(), degrees_of_freedom=None)
    assert "freedom-not-stated" not in named(issued(servo, verification=old).findings)
    document = issued(servo, as_found=replace(old, calibration_sha256="1" * 64))
    assert "freedom-not-stated" in named(document.findings)
    assert document.as_found.decisions[0].quantity.coverage_factor == 2.0


def test_the_risk_of_the_customer_is_kept_by_the_guard_band():
    """Drawn: tools whose true value is uniform about the limit; of those that pass by value, few are outside."""
    rng, limit, sd = np.random.default_rng(7), 0.1, 0.01
    true = rng.uniform(0.0, 0.2, 400_000)
    value = true + rng.normal(0, sd, true.size)
    rule = decisions.Rule("guarded", "", 1.0, 2.0)
    edge = rule.decision(row(limit - 2 * sd - 1e-9))
    assert edge.passed
    near = np.abs(value - edge.quantity.value) < sd / 20
    assert edge.risk == pytest.approx(np.mean(true[near] > limit), abs=4e-3)
    assert np.mean(true[value <= limit - 2 * sd] > limit) < edge.risk


def test_the_value_of_all_sets_together_decides(servo):
    """The largest of three sets of 0.1 ± 0.01 is judged less what choosing it adds, not by that set alone."""
    each = {"value": 0.101, "uncertainty": 0.01, "stations": [], "coefficients": None}
    sets = [JudgedSet(label=label, passed=False, **each) for label in "ABC"]
    judged = replace(row(0.093, 0.011), sets=sets, degrees_of_freedom=None)
    assert decisions.Rule("simple", "", 0.0, 2.0).decision(judged).passed


def test_few_degrees_of_freedom_widen_the_guard_band_the_coverage_and_the_risk(servo):
    """Student's t of 3 degrees of freedom: 3.18 for 95 %, and beyond 1.638 lies a tenth (JCGM 100, table G.2)."""
    judged = replace(row(0.1 - 1.638 * 0.01), degrees_of_freedom=3.0)
    rule = decisions.rule_of(verification(servo, judged), 70.0, None)
    assert rule.decision(judged).risk == pytest.approx(0.1, abs=1e-4)
    assert rule.decision(judged).quantity.coverage_factor == pytest.approx(3.18, abs=0.005)
    guarded = decisions.rule_of(
        verification(servo, replace(judged, passed=False), rule="guarded"), 70.0, None
    )
    wide = guarded.decision(judged)
    assert not wide.passed
    edge = replace(judged, value=wide.acceptance_limit)
    assert guarded.decision(edge).risk == pytest.approx(0.02275, abs=1e-5)


def test_a_raw_figure_is_marked_and_has_no_uncertainty_beyond_its_limit(servo):
    """t(95 %, 1) = 12.71 of a table: within the limit the U decides, beyond it 7.6° would say nothing of 1.3°."""
    words = "largest at toolface 90°; raw figure judged: the readings leave a smooth curve by 6.5 × their noise"
    raw = replace(row(1.3, 0.6, 1.0), note=words, raw=1.3, degrees_of_freedom=1.0, passed=False)
    within = replace(raw, name="error of azimuth", value=0.7, raw=0.7, limit=1.0)
    smooth = row(name="error of inclination")
    test = verification(servo, raw, within, smooth, rule="guarded")
    paper = issued(servo, verification=test)
    beyond = paper.as_left.decisions[0]
    assert beyond.quantity.expanded_uncertainty == pytest.approx(12.71 * 0.6, abs=0.01)
    lines = [" ".join(line.split()) for line in presented.screen(paper, []).splitlines()]
    assert any("inclination 1.30° 1.30° raw not stated 1° none FAIL" in line for line in lines)
    assert any("azimuth 0.7° 0.7° raw 7.6° 1° none FAIL" in line for line in lines)
    page = presented.render_page(paper)
    assert "± 7.6°" in page
    assert page.count("1.30° raw") == 2
    assert "A value marked raw is judged with its noise" in page
    usual = issued(servo, verification=verification(servo, smooth))
    assert "A value marked raw is judged with its noise" not in presented.render_page(usual)


def test_a_limit_that_cannot_be_judged_is_not_passed(servo):
    blocked = replace(row(), uncertainty=None, passed=False)
    document = issued(servo, verification=verification(servo, blocked))
    (decision,) = document.as_left.decisions
    assert (decision.passed, decision.probability_within, decision.risk) == (False, None, None)
    assert not document.as_left.passed


def test_repeatability_is_the_scatter_about_a_curve_of_two_harmonics(servo):
    test = verification(servo)
    rows = table(issued(servo, verification=test), "repeatability")
    stations = test.station_rows
    turn = np.radians([station.toolface_deg for station in stations])
    design = np.stack([turn**0, *(f(k * turn) for k in (1, 2) for f in (np.cos, np.sin))], -1)
    for name in ("inclination", "azimuth"):
        errors = np.array([station.departures[f"error of {name}"] for station in stations])
        left = errors - design @ np.linalg.lstsq(design, errors, rcond=None)[0]
        quantity = rows[f"repeatability-{name}-as-left"]
        assert quantity.value == pytest.approx(np.sqrt(np.sum(left**2) / (len(turn) - 5)), rel=1e-4)
        assert quantity.standard_uncertainty == pytest.approx(quantity.value / math.sqrt(14))
        assert quantity.coverage_factor == pytest.approx(2.36, abs=0.005)  # 7 degrees of freedom


# ------------------------------------------------------------------ what is stated, and what is not


def test_what_nobody_states_is_named(servo):
    text = named(issued(servo).findings)["not-stated"]
    gaps = ("laboratory", "place", "customer", "condition of the item", "authorised by")
    quantities = ("the stand", "gravity", "the field", "the dip")
    for gap in (*gaps, *(f"traceability of {name}" for name in quantities)):
        assert gap in text
    assert "measured by" not in text  # the run names its operator
    laboratory, _ = contents_of_example()
    complete = issued(servo, laboratory)
    assert "not-stated" not in named(complete.findings)
    assert complete.customer.name == "Fictitious Drilling Company"


def contents_of_example():
    from mwdcal.certificate.document import load_laboratory

    return load_laboratory(EXAMPLE / "laboratory.toml")


def test_what_is_particular_stands_before_the_laboratory_file(servo):
    laboratory, _ = contents_of_example()
    document = issued(servo, laboratory, customer="Other", condition="bent", number="N-1")
    assert (document.customer.name, document.item.condition) == ("Other", "bent")
    assert document.number == "N-1"


@pytest.mark.parametrize(
    ("when", "day", "named_as"),
    [
        ("as_found", "2026-03-15", None),
        ("as_found", "2026-03-16", "after the day of the calibration"),
        ("verification", "2026-03-15", None),
        ("verification", "2026-03-14", "before the day of the calibration"),
    ],
)
def test_a_roll_test_on_the_wrong_side_of_the_calibration_is_a_finding(
    thermal, when, day, named_as
):
    """The calibration is of 2026-03-15."""
    digest = "1" * 64 if when == "as_found" else "0" * 64
    test = verification(thermal, row(), date=day, calibration_sha256=digest)
    text = named(issued(thermal, **{when: test}).findings).get("test-date")
    assert (named_as in text) if named_as else (text is None)


def test_a_certificate_from_before_its_roll_test_is_refused(thermal):
    test = verification(thermal, row(), date="2026-04-02")
    with pytest.raises(mwdcal.InputError, match="must not be before the day of `verification`"):
        issued(thermal, verification=test, issued=date(2026, 4, 1))


def test_days_that_cannot_be_read_are_refused_though_older_files_state_them(thermal):
    test = verification(thermal, row(), date="15 March")
    with pytest.raises(mwdcal.InputError, match="`verification`: 'date' must be .* got '15 March'"):
        issued(thermal, verification=test)
    dated = replace(thermal, tool={**thermal.tool, "date": "15.03.2026"})
    with pytest.raises(mwdcal.InputError, match="the calibration: 'date' must be .*2026-01-31"):
        issued(dated)


def test_a_roll_test_whose_serial_is_unknown_is_said_to_be(servo, thermal):
    """The calibration `thermal` and the roll test as found state no serial; what a test says of its run counts too."""
    anonymous = verification(thermal, row(), serial=None, findings=[], calibration_sha256="1" * 64)
    texts = [each.text for each in issued(thermal, as_found=anonymous).findings]
    assert any("no serial in `as_found` and the calibration" in text for text in texts)
    said = Finding(id="no-serial", text="roll.csv states no serial")
    document = issued(servo, verification=verification(servo, row(), findings=[said]))
    assert said in document.findings
    assert "no-serial" not in named(issued(servo, verification=verification(servo, row())).findings)


def test_an_overdue_standard_is_marked_on_the_day_of_the_calibration(thermal):
    def standard(name, due):
        return MeasurementStandard(quantity="stand", name=name, due=due)

    days = {"before": date(2026, 3, 14), "on the day": date(2026, 3, 15), "none": None}
    standards = tuple(standard(name, due) for name, due in days.items())
    document = issued(thermal, Laboratory(standards=standards))
    assert [each.overdue for each in document.traceability] == [True, False, False]
    (text,) = (f.text for f in document.findings if f.id == "standard-overdue")
    assert "before was due on 2026-03-14" in text
    assert document.calibrated == "2026-03-15"


def test_a_standard_that_was_calibrated_later_is_a_finding(thermal):
    days = {
        "before": date(2026, 3, 14),
        "on the day": date(2026, 3, 15),
        "after": date(2026, 3, 16),
    }
    standards = tuple(
        MeasurementStandard(quantity="stand", name=name, issued=day) for name, day in days.items()
    )
    document = issued(thermal, Laboratory(standards=standards))
    (text,) = (f.text for f in document.findings if f.id == "standard-later")
    assert "stand standard after was calibrated on 2026-03-16" in text


def test_standards_of_the_laboratory_replace_those_of_the_profile(servo):
    def standard(quantity, name, certificate=""):
        return MeasurementStandard(quantity=quantity, name=name, certificate=certificate)

    ours = (standard("stand", "S", "old"), standard("field", "F"))
    profile = replace(servo.profile, standards=ours)
    theirs = (standard("stand", "S", "new"), standard("dip", "S"))
    document = issued(replace(servo, profile=profile), Laboratory(standards=theirs))
    shown = [(each.quantity, each.name, each.certificate) for each in document.traceability]
    assert shown == [("stand", "S", "new"), ("field", "F", ""), ("dip", "S", "")]


@pytest.mark.parametrize(
    ("day", "months", "due"),
    [
        ("2026-01-31", 1, "2026-02-28"),
        ("2027-01-31", 13, "2028-02-29"),
        ("2026-03-15", 12, "2027-03-15"),
        ("2026-12-31", 6, "2027-06-30"),
    ],
)
def test_the_next_calibration_is_due_after_whole_months(servo, day, months, due):
    dated = replace(servo, tool={**servo.tool, "date": day})
    document = issued(
        dated, Laboratory(recalibration=Recalibration(months=months)), issued=date(2028, 1, 1)
    )
    assert (document.calibrated, document.next_due) == (day, due)


def test_without_a_date_of_the_run_the_day_of_the_fit_stands_and_is_said_to(servo):
    document = issued(servo, issued=date(2999, 1, 1))
    assert document.calibrated == servo.time[:10]
    assert "is used as that of the measurements" in named(document.findings)["date-not-stated"]
    assert "2999-01-01, which is still to come" in named(document.findings)["future-date"]
    with pytest.raises(
        mwdcal.InputError, match=f"must not be before .*{servo.time[:10]}; got 2000-01-01"
    ):
        issued(servo, issued=date(2000, 1, 1))


def test_days_in_the_wrong_order_are_refused(thermal):
    with pytest.raises(mwdcal.InputError, match=r"`date` must not be before .*2026-03-15"):
        issued(thermal, issued=date(2026, 3, 14))
    with pytest.raises(mwdcal.InputError, match="`received` must not be after"):
        issued(thermal, received=date(2026, 3, 16))


def test_deviations_of_the_method_are_listed(servo):
    run = mwdcal.read_run(EXAMPLE / "run.csv", servo.profile)
    other = mwdcal.calibrate(run, robust="huber", ignore=("dip",), parameters=9)
    text = " ".join(issued(replace(other, excluded=["7"])).method.deviations)
    for word in ("7", "huber", "dip", "9 parameters"):
        assert word in text
    assert issued(servo).method.deviations == []
    held = issued(other).results[2]
    assert "Held at zero" in held.note
    assert len(held.quantities) == 9


def test_conditions_state_the_place_with_the_uncertainty_that_was_declared(thermal, servo):
    humidity = LaboratoryCondition(name="humidity", value=45.0, unit="%", uncertainty=2.0)
    document = issued(thermal, Laboratory(conditions=(humidity,)))
    rows = {quantity.id: quantity for quantity in document.conditions}
    assert 1.9e-5 < rows["gravity"].standard_uncertainty <= 2e-5  # never more than declared
    assert rows["field"].standard_uncertainty <= 30.0
    assert (rows["temperature-lowest"].value, rows["temperature-highest"].value) == (10.0, 80.0)
    assert rows["condition-1"].expanded_uncertainty == pytest.approx(2 * 1.95996, rel=1e-4)
    exact = {quantity.id: quantity for quantity in issued(servo).conditions}
    assert exact["gravity"].standard_uncertainty is None


def test_a_dip_that_the_readings_tell_has_the_factor_of_their_residuals():
    """Student's of 95 % for the degrees of freedom, by its distribution; declared gravity has the normal one."""
    profile = mwdcal.load_profile(EXAMPLE / "tool.toml")
    profile = replace(profile, stand=replace(profile.stand, gravity_g=2e-5, dip_deg=1.0))
    profile = replace(profile, magnetometer=replace(profile.magnetometer, noise=None))
    run = mwdcal.read_run(EXAMPLE / "run.csv", profile)
    few = mwdcal.calibrate(run.select(np.arange(run.count) % 4 == 0))
    rows = {quantity.id: quantity for quantity in issued(few).conditions}
    fewest = min(triad.degrees_of_freedom for triad in few.triads)
    assert fewest < 30
    assert rows["dip"].standard_uncertainty < 0.1
    assert rows["dip"].coverage_factor == pytest.approx(stats.t.ppf(0.975, fewest), rel=1e-9)
    assert rows["gravity"].coverage_factor == pytest.approx(1.95996, rel=1e-4)


def test_whatever_is_simulated_marks_the_certificate(servo):
    real = replace(
        servo, simulated=False, tool={k: v for k, v in servo.tool.items() if k != "simulated"}
    )
    test = verification(servo)
    measured = replace(test, simulated=False)
    assert issued(servo).simulated
    assert not issued(real).simulated
    assert not issued(real, verification=measured).simulated
    assert issued(real, verification=test).simulated
    other = replace(test, calibration_sha256="1" * 64)
    assert issued(real, as_found=other).simulated


# ------------------------------------------------------------------ number and bytes


def test_the_same_input_on_the_same_date_gives_the_same_bytes_and_another_one_another_number(servo):
    first = issued(servo)
    assert msgspec.json.encode(first) == msgspec.json.encode(issued(servo))
    assert first.number.startswith(f"SIM-0001-{first.issued.replace('-', '')}-")
    others = [
        issued(servo, customer="C"),
        issued(servo, condition="worn"),
        issued(servo, issued=date(2999, 4, 2)),
        issued(servo, Laboratory(place="P")),
        issued(servo, Laboratory(authorised_by=Person(name="B"))),
        issued(servo, verification=verification(servo)),
        issued(servo, verification=verification(servo, row())),
        issued(replace(servo, earth={**servo.earth, "dip_deg": 63.0000001})),
    ]
    assert len({first.number, *(each.number for each in others)}) == 1 + len(others)


def test_the_number_is_the_digest_of_all_else(servo):
    document = issued(servo)
    plain = json.dumps(
        {**msgspec.to_builtins(document), "number": ""},
        sort_keys=True, separators=(",", ":"),
    ).encode()  # fmt: skip
    assert document.number.rpartition("-")[2] == hashlib.sha256(plain).hexdigest()[:12]
    pattern = Laboratory(number="LAB {year}/{digest}")
    assert issued(servo, pattern).number.startswith("LAB 2026/")


@pytest.mark.parametrize("number", [" ", "a\nb", "x" * 65, "a\x1b[2J", "‮b"])
def test_a_number_that_no_page_can_bear_is_refused(servo, number):
    with pytest.raises(mwdcal.InputError, match="`number` must be"):
        issued(servo, number=number)


@settings(max_examples=25, deadline=None)
@given(
    st.text(max_size=40), st.text(max_size=40), st.dictionaries(st.text(), st.text(), max_size=2)
)
def test_any_names_go_into_a_certificate_and_out_again(servo, serial, customer, marks):
    odd = replace(servo, tool={**servo.tool, "serial": serial})
    from mwdcal.certificate.document import ItemDetails

    laboratory = Laboratory(item=ItemDetails(identification=marks))
    try:
        document = issued(odd, laboratory, customer=customer)
        data = msgspec.json.encode(document)
    except UnicodeEncodeError:  # half a character, which no file holds
        return
    assert msgspec.json.decode(data, type=contents.Certificate) == document
    assert document.number.isascii()
    assert document.number.isprintable()
    assert document.item.serial == serial
    assert (document.customer.name if document.customer else "") == (
        customer if customer.strip() else ""
    )
