"""Own-axis terms taken where a run speaks for them, and scatter from shot to shot beside the noise."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.stats import multivariate_normal

from cli_support import mwdcal
from mwdcal.calibration.automatic import auto
from mwdcal.calibration.automatic.auto import ODDS, choices_of, choose_curves
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.estimation.batch import batch_of_one
from mwdcal.estimation.uncertainty import PIN, log_evidence, readjusted
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import centred
from mwdcal.library.simulation import simulate

nulls = pytest.importorskip("nulls")

SCATTER = Options(nonlinearity={}, scatter=True)


@cache
def handful(count=40):
    return nulls.runs(count, "sap5", False, 11)


@cache
def fitted(scatter):
    readings, truth = handful()
    return fit(readings, Options(nonlinearity={}, scatter=scatter)), truth


@pytest.mark.slow
def test_no_terms_are_taken_where_there_are_none():
    """Six kinds of noise; `python examples/measured/nulls.py` does it with 500 runs."""
    wrong = nulls.false_terms(6, seed=40)
    assert {count for count, _ in wrong.values()} == {0}
    assert sum(of for _, of in wrong.values()) == 6


def test_terms_are_taken_where_they_are_plain():
    bent, _ = nulls.runs(6, "sap5", False, 3, (0.0, 0.02))
    assert (nulls.odds(bent) > ODDS).all()


@pytest.mark.slow
def test_odds_of_straight_runs_are_against_the_terms():
    """Mostly below even, and clear in as many runs as their meaning allows: none of so few."""
    straight, _ = handful()
    found = nulls.odds(straight)
    assert np.mean(found < 0) > 0.8
    assert np.mean(np.exp(found)) < 1.5  # expected value of a likelihood ratio: one


@pytest.mark.parametrize("terms", [{}, {"accelerometer": 0.003, "magnetometer": 0.003}])
@pytest.mark.parametrize("stand", [{}, {"inclination": 2e-4, "azimuth": 9e-4, "toolface": 4e-4}])
def test_stations_are_judged_as_by_fits_without_them(terms, stand):
    """As by a fit for each; to first order, so closely where the problem is not linear and its stations few."""
    run = simulate((20, 70, 110), 12, seed=4)
    noise = {"accelerometer": np.full((36, 3), 1e-4), "magnetometer": np.full((36, 3), 15.0)}
    sd = noise | {name: np.full(36, each) for name, each in stand.items()}
    run = replace(run, sd=sd, settings="per-station")
    options = Options(nonlinearity=terms)
    found = auto._left_out(batch_of_one(run), options)[0]
    for station in range(36):
        include = (np.arange(36) != station).astype(float)
        result = fit(run, options, include)
        everyone = replace(result.problem.evidence, include=np.ones((1, 36)))
        problem = replace(result.problem, evidence=everyone)
        linear = problem.linear(readjusted(problem, result.state))
        square = (linear.residual * linear.weigh(linear.residual[..., None])[..., 0])[0, station]
        assert found[station] == pytest.approx(square.mean(), rel=0.05 if terms or stand else 1e-6)


def test_the_choice_of_one_run():
    readings, _ = nulls.runs(2, "sap5", False, 3, (0.0, 0.02))
    one = Readings(readings.accelerometer[0], readings.magnetometer[0], group=readings.group[0])
    found, table = choose_curves(one, SCATTER, nulls.OFFERED)
    assert found == nulls.OFFERED
    assert [(s.triads, s.chosen) for s in table] == [((), False), (tuple(nulls.OFFERED), True)]
    assert table[1].odds == pytest.approx(nulls.odds(readings)[0] / np.log(10), rel=1e-6)
    assert choose_curves(one, SCATTER, {}) == ({}, [])


@pytest.mark.slow
def test_scatter_is_what_was_simulated():
    """Variances of REML, mean over runs, against those of the simulation."""
    result, _ = fitted(True)
    assert (result.status == 0).all()
    size = nulls.SIZES["sap5"]
    for name in ("dip", "direction"):
        variance = np.mean(result.problem.evidence.scatter[name][:, 0] ** 2)
        assert np.sqrt(variance) == pytest.approx(size[name], rel=0.15)
    # of field strength and noise of b the sum is what |b| shows
    whole = np.mean(result.noise[:, 1] ** 2 + result.problem.evidence.scatter["field"][:, 0] ** 2)
    assert np.sqrt(whole) == pytest.approx(np.hypot(size["b"], size["field"]), rel=0.15)


@pytest.mark.parametrize("kind", nulls.SIZES)
def test_the_noise_keeps_its_degrees_of_freedom(kind):
    """Below one `calibrate` refuses, however strongly strengths scatter beside it."""
    readings, _ = nulls.runs(20, kind, True, 9)
    result = fit(readings, SCATTER)
    assert (result.analysis.freedom > 3).all()
    scatter = result.problem.evidence.scatter
    size = [p.strength.mean(-1) for p in result.problem.predictions(result.state)]
    for t, name in enumerate(("gravity", "field")):
        assert (scatter[name][:, 0] <= 1.001 * result.noise[:, t] / size[t]).all()


def errors(result, truth):
    """Error and stated σ of the inclination, by runs and attitudes that were not in the fit."""
    probe = [
        np.radians(v) for v in ([20.0, 60, 85, 120], [10.0, 100, 200, 300], [15.0, 95, 170, 280])
    ]
    g, b = nulls.vectors(*probe, truth["dip"])
    g = np.broadcast_to(g, b.shape)
    found = []
    for t, vector in enumerate((g, b)):
        raw = np.einsum("bij,bnj->bni", truth["gain"][:, t], vector) + truth["offset"][:, t, None]
        found.append(raw)
    problem, state, cold = result.problem, result.state, np.zeros((len(g), 4))
    fields, slopes = [], np.zeros((len(g), 4, 6, state.params.shape[-1]))
    for t, (triad, where) in enumerate(zip(problem.triads, problem.slices(), strict=True)):
        fields.append(triad.model.fields(state.params[:, where], found[t], cold))
        slopes[:, :, 3 * t : 3 * t + 3, where] = triad.model.jacobian(
            state.params[:, where], found[t], cold
        )
    pairs = {}
    for name in ("inclination", "azimuth"):
        gradient = OBSERVABLES[name].gradient(g, b)
        rows = np.einsum("bni,bnip->bnp", gradient, slopes)
        sd = np.sqrt(np.einsum("bnp,bpq,bnq->bn", rows, result.analysis.covariance, rows))
        error = centred(OBSERVABLES[name].value(*fields) - OBSERVABLES[name].value(g, b))
        pairs[name] = error, sd
    return pairs


@pytest.mark.parametrize("name", ["inclination", "azimuth"])
def test_stated_uncertainty_covers_and_is_smaller(name):
    with_it, without = (errors(*fitted(scatter))[name] for scatter in (True, False))
    ratio = [np.sqrt(np.mean((error / sd) ** 2)) for error, sd in (with_it, without)]
    assert 0.85 < ratio[0] < 1.2
    rms = [np.sqrt(np.mean(error**2)) for error, _ in (with_it, without)]
    assert rms[0] < rms[1]


def test_evidence_is_the_density_of_the_readings():
    """Ratio of two models' densities: log N(y; 0, C + X Λ⁻¹ Xᵀ) as one dense normal."""
    readings, _ = nulls.runs(1, "sap5", False, 5, (0.0, 0.005))
    readings = Readings(
        readings.accelerometer[0], readings.magnetometer[0], group=readings.group[0]
    )
    found, dense = [], []
    for terms in ({}, {"magnetometer": 0.005}):
        result = fit(readings, Options(nonlinearity=terms, scatter=True))
        problem, state = result.problem, result.state
        found.append(log_evidence(problem, state)[0])
        linear = problem.linear(state)
        design = linear.design[0].reshape(-1, linear.design.shape[-1])
        given = np.diagonal(linear.prior[0])
        free = np.append(given[: linear.size] == 0, np.zeros(len(given) - linear.size, bool))
        precision = given + np.append(np.full(linear.size, PIN**-2.0), 0 * given[linear.size :])
        covariance = design / precision @ design.transpose()
        for k in range(24):
            own, rows = linear.private[0, k], slice(6 * k, 6 * k + 6)
            covariance[rows, rows] += np.eye(6) + own @ own.transpose()
        # unpriored parameters are integrated about the fit itself
        y = linear.residual[0].ravel() - design @ np.where(free, 0, linear.pull[0])
        noise = sum(np.log(t.sd).sum() for t in problem.triads)
        dense.append(multivariate_normal.logpdf(y, cov=covariance) - noise)
    assert found[1] - found[0] == pytest.approx(dense[1] - dense[0], abs=0.1)


def test_a_declared_noise_leaves_the_choice_to_stations_left_out():
    readings, _ = nulls.runs(1, "noise alone", False, 5)
    sd = {"accelerometer": np.full(3, 0.003), "magnetometer": np.full(3, 0.0025)}
    one = Readings(
        readings.accelerometer[0], readings.magnetometer[0], group=readings.group[0], sd=sd
    )
    found, table = choose_curves(one, SCATTER, {"magnetometer": 0.005})
    assert found == {}
    assert [s.left_out is None for s in table] == [False, False]
    assert [s.odds for s in table] == [None, None]
    # χ² per reading of stations left out of a fit of the declared noise: one, not three or a third
    assert [s.left_out for s in table] == [pytest.approx(1.0, abs=0.3)] * 2
    assert not fit(one, SCATTER).problem.evidence.scatter
    assert choices_of(one, {"magnetometer": 0.005}) == [(), ("magnetometer",)]


PROFILE = """name = "held by hand"
[accelerometer]
scale = 1.0
nonlinearity = 0.002
[magnetometer]
scale = 2e-5
nonlinearity = 0.005
"""


def test_calibrate_and_fleet_choose_and_fit_alike(tmp_path):
    """One straight tool, one bent: terms, scatter, parameters and findings of both commands."""
    (tmp_path / "tool.toml").write_text(PROFILE)
    straight, bent = (nulls.runs(1, "sap5", False, 3, (0.0, bend))[0] for bend in (0.0, 0.01))
    names = ("ax", "ay", "az", "mx", "my", "mz")
    rows = []
    for serial, run in (("straight", straight), ("bent", bent)):
        raw = np.concatenate([run.accelerometer[0], run.magnetometer[0]], -1)
        own = [["", "A", "B"][g + 1] for g in nulls.GROUPS]
        rows += [[serial, g, *map(repr, map(float, r))] for g, r in zip(own, raw, strict=True)]
        text = "\n".join(",".join(row[1:]) for row in rows[-24:])
        (tmp_path / f"{serial}.csv").write_text(",".join(("group", *names)) + "\n" + text + "\n")
    columns = dict(zip(("serial", "group", *names), zip(*rows, strict=True), strict=True))
    table = {
        k: list(v) if k in ("serial", "group") else np.array(v, float) for k, v in columns.items()
    }
    pq.write_table(pa.table(table), tmp_path / "runs.parquet")
    given = ("--tool", tmp_path / "tool.toml", "--nonlinearity", "auto", "--order", "0")
    out = tmp_path / "cals.parquet"
    ran = mwdcal("fleet", tmp_path / "runs.parquet", "-o", out, *given, "--workers", "1")
    assert ran.code == 0, ran.err
    for row in pq.read_table(out).to_pylist():
        single = tmp_path / f"{row['serial']}.json"
        ran = mwdcal("calibrate", tmp_path / f"{row['serial']}.csv", "-o", single, *given)
        assert ran.code == 0, ran.err
        made = json.loads(single.read_text("utf-8"))
        curved = row["serial"] == "bent"
        for triad in ("accelerometer", "magnetometer"):
            own = made[triad]
            assert own["curved"] == curved
            assert (row[f"{triad}_radius"] is not None) == curved
            name = own["parameter_names"][0]
            column = f"{triad}_{name.replace('-', '_')}"
            assert row[column] == pytest.approx(own["parameters"][0], rel=1e-9)
        assert "scatter" in row["findings"]
        assert "scatter" in {f["id"] for f in made["findings"]}
