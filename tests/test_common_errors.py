"""Errors that all stations of a stand share: declared, they widen the stated uncertainty as they should.

The forward model turns the stand's own readings into true attitudes by plain trigonometry; nothing
of the package is used for it.
"""

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from cli_support import EXAMPLE, mwdcal, servo_run, write_csv
from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.diagnosis.plausibility import misfit_chances
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.prior import from_calibration
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.results import StatedCovariance, assumed_exact, typical_accuracy
from mwdcal.errors import FitError
from mwdcal.estimation.batch import batch_of_one, take
from mwdcal.files import documents
from mwdcal.files.runs import read_run as runs_of
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import centred
from mwdcal.sensor.profile import Profile
from simulation import DEG, Tool, attitude, plan

COUNT = 200
SETTINGS = np.array([0.01, 0.05, 0.02]) * DEG
SIZES = {
    "azimuth-zero": 0.1 * DEG,
    "toolface-zero": 0.1 * DEG,
    "inclination-zero": 0.03 * DEG,
    "tilt": 0.02 * DEG,
    "tool-axis": 0.05 * DEG,
    "gravity": 1e-3,
    "field": 50.0,
    "dip": 0.1 * DEG,
}


def leaning(inc, azi, face, tilt, towards):
    """True attitudes where the stand's vertical leans by `tilt` towards an azimuth, to first order."""
    along, across = tilt * np.cos(azi - towards), tilt * np.sin(azi - towards)
    return inc - along, azi + across / np.tan(inc), face - across / np.sin(inc)


def runs(name, size, declared=True, seed=0, count=COUNT, stations=None, noise_declared=True):
    """A batch of runs whose references share an error of standard deviation `size`."""
    tool, rng = Tool.random(3, noise=(1e-4, 15.0)), np.random.default_rng(seed)
    inc, azi, face = stations or plan((10, 45, 90, 135))
    error = size * rng.normal(size=(count, 1))
    shape = (count, len(inc))
    true = [a + s * rng.normal(size=shape) for a, s in zip((inc, azi, face), SETTINGS, strict=True)]
    zeros = ("inclination-zero", "azimuth-zero", "toolface-zero")
    if name in zeros:
        true[zeros.index(name)] = true[zeros.index(name)] - error
    if name == "tilt":
        true = leaning(*true, error, rng.uniform(0, 2 * np.pi, (count, 1)))
    strengths = {"gravity": tool.gravity, "field": tool.field, "dip": tool.dip}
    earth = {k: v + (error if k == name else 0.0) + 0 * error for k, v in strengths.items()}
    g, b = attitude(*true)(1.0, 1.0, earth["dip"])
    pair = (g * earth["gravity"][..., None], b * earth["field"][..., None])
    if name == "tool-axis":
        side = rng.uniform(0, 2 * np.pi, (count, 1))
        lean = error * np.concatenate([np.cos(side), np.sin(side), 0 * side], -1)
        turn = Rotation.from_rotvec(lean).as_matrix()
        pair = tuple(np.einsum("bij,bnj->bni", turn, v) for v in pair)
    raw = [v @ tool.matrix[t].T + tool.offset[t] for t, v in enumerate(pair)]
    raw = [r + s * rng.normal(size=r.shape) for r, s in zip(raw, tool.noise, strict=True)]
    angles = ("inclination", "azimuth", "toolface")
    known = dict(zip(angles, (inc, azi, face), strict=True))
    known |= {k: np.full(len(inc), v) for k, v in strengths.items()}
    sd = {n: np.full(len(inc), s) for n, s in zip(angles, SETTINGS, strict=True)}
    if noise_declared:
        sd |= {"accelerometer": np.array(1e-4), "magnetometer": np.array(15.0)}
    if declared:
        sd[name] = np.full(len(inc), size)
    return tool, Readings(raw[0], raw[1], known=known, sd=sd, settings="per-station")


def ratios(tool, result):
    """Error over stated uncertainty, root mean square over attitudes and runs, by observable."""
    azimuth, toolface = (x.ravel() for x in np.meshgrid(np.arange(8) * 45.0, np.arange(8) * 45.0))
    inc, azi, face = np.full(64, 45.0) * DEG, azimuth * DEG + 0.1, toolface * DEG + 0.2
    pair = attitude(inc, azi, face)(tool.gravity, tool.field, tool.dip)
    wanted = {
        "inclination": inc,
        "azimuth": azi,
        "toolface": face,
        "gravity": 1.0,
        "field": tool.field,
    }
    covariance, found = StatedCovariance(result).total, {}
    count = len(result.status)
    fields, rows = [], []
    for t, (triad, where) in enumerate(
        zip(result.problem.triads, result.problem.slices(), strict=True)
    ):
        raw = np.broadcast_to(pair[t] @ tool.matrix[t].T + tool.offset[t], (count, 64, 3))
        params = result.state.params[:, where]
        fields.append(triad.model.fields(params, raw, np.zeros((count, 64))))
        rows.append(triad.model.jacobian(params, raw, np.zeros((count, 64))))
    for name, value in wanted.items():
        observable = OBSERVABLES[name]
        error = observable.value(*fields) - value
        error = centred(error) if observable.period else error
        gradient = observable.gradient(*fields)
        parts = [gradient[..., 3 * t : 3 * t + 3] for t in (0, 1)]
        change = np.concatenate(
            [np.einsum("bni,bnip->bnp", p, r) for p, r in zip(parts, rows, strict=True)], -1
        )
        variance = np.einsum("bnp,bpq,bnq->bn", change, covariance, change, optimize=True)
        found[name] = np.sqrt(np.mean(error**2) / np.mean(variance))
    return found


@pytest.mark.parametrize("name", SIZES)
def test_declared_common_errors_are_in_the_stated_uncertainty(name):
    tool, data = runs(name, SIZES[name])
    result = fit(data)
    assert (result.status == 0).all()
    for observable, ratio in ratios(tool, result).items():
        assert 0.9 < ratio < 1.1, observable


def test_a_toolface_zero_is_understated_where_it_is_not_declared_and_said_to_be_taken_as_exact():
    tool, data = runs("toolface-zero", SIZES["toolface-zero"], declared=False)
    result = fit(data)
    assert ratios(tool, result)["toolface"] > 10
    assert np.nanmean(result.analysis.variance_factor) == pytest.approx(1.0, abs=0.05)
    first = {names[0] for names in assumed_exact(result, relative=False)}
    assert first == {"toolface zero of the stand"}
    _, data = runs("toolface-zero", SIZES["toolface-zero"])
    left = {name for names in assumed_exact(fit(data), relative=False) for name in names}
    assert left
    assert "toolface zero of the stand" not in left


def test_a_tool_that_leans_in_the_stand_is_understated_where_it_is_not_declared():
    """No residual shows it: tool and stand cannot be told apart, so it is among what is assumed exact."""
    tool, data = runs("tool-axis", SIZES["tool-axis"], declared=False)
    result = fit(data)
    assert ratios(tool, result)["inclination"] > 5
    assert np.nanmean(result.analysis.variance_factor) == pytest.approx(1.0, abs=0.05)
    assert all(
        "alignment of the tool in the stand" in names for names in assumed_exact(result, False)
    )
    _, data = runs("tool-axis", SIZES["tool-axis"])
    problem, state = result.problem, result.state
    turns, _ = problem.station_columns(state)
    parameters = np.zeros((len(state.params), *turns.shape[1:3], 24))
    for where, block in zip(problem.slices(), problem.linear(state).blocks, strict=True):
        rows = slice(where.start // 4, where.stop // 4)
        parameters[..., rows, where] = block
    flat = parameters[0].reshape(-1, 24)
    for name in ("tool-axis-x", "tool-axis-y"):
        column = problem.stand_column(state, name, turns)[0].ravel()
        left = column - flat @ np.linalg.lstsq(flat, column)[0]
        assert np.linalg.norm(left) < 1e-3 * np.linalg.norm(
            column
        )  # the noise, as a share of the field
    left = {name for names in assumed_exact(fit(data), relative=False) for name in names}
    assert "toolface zero of the stand" in left
    assert "alignment of the tool in the stand" not in left


def test_a_thermometer_is_trusted_where_temperatures_go_one_way():
    """Ahead of the sensors by as much at every station, it shifts the model: the run cannot show it."""
    words = "sensors at the temperature of the thermometer"
    for temperatures, trusted in (
        ((20, 50, 80), True),
        ((80, 50, 20), True),
        ((20, 80, 50), False),
    ):
        run = servo_run(temperatures=temperatures)
        raw = [np.stack([run[f"{t}{axis}"] for axis in "xyz"], -1) for t in "am"]
        names = ("inclination", "azimuth", "toolface")
        known = {name: np.radians(run[f"ref_{name}_deg"]) for name in names}
        known["gravity"] = np.ones(len(raw[0]))
        for order in (0, 1):
            data = Readings(*raw, np.asarray(run["temperature_c"]), known=known, sd={})
            [found] = assumed_exact(fit(batch_of_one(data), Options(order=order)), relative=True)
            assert (words in found) == (trusted and order > 0)


def test_the_lean_of_a_tool_turns_what_a_roll_test_reads():
    """Errors of tools of any lean, to any side, at one inclination, over what their references state."""
    size, inc = 0.1 * DEG, 50 * DEG
    side, face = np.meshgrid(np.arange(24) * 15 * DEG, np.arange(12) * 30 * DEG, indexing="ij")
    g, b = attitude(np.full(face.shape, inc), 0 * face, face)(1.0, 1.0, 1.2)
    lean = size * np.stack([np.cos(side), np.sin(side), 0 * side], -1).reshape(-1, 3)
    turn = Rotation.from_rotvec(lean).as_matrix().reshape(*side.shape, 3, 3)
    g, b = (np.einsum("...ij,...j->...i", turn, v) for v in (g, b))
    stated = Readings(g[0], b[0], sd={"tool-axis": np.array(size)})
    for name, true in (("inclination", inc), ("azimuth", 0.0), ("toolface", face)):
        error = centred(OBSERVABLES[name].value(g, b) - true)
        sd = stated.common_uncertainty(name, np.full(12, inc))
        assert np.sqrt(np.mean(error**2)) == pytest.approx(sd[0], rel=0.01)


def test_shares_add_up_to_the_stated_covariance():
    for name in ("azimuth-zero", "tilt", "gravity"):
        _, data = runs(name, SIZES[name], count=3)
        result = fit(data)
        whole = StatedCovariance(result).total
        total = sum(StatedCovariance(result).by_source().values())
        np.testing.assert_allclose(total, whole, rtol=1e-6, atol=1e-9 * np.abs(whole).max())


def test_the_share_of_settings_is_what_they_do():
    """Scatter of the parameters when only the stand's settings vary, the noise being left out."""
    tool = Tool.random(3, noise=(1e-9, 1e-4))
    rng = np.random.default_rng(1)
    inc, azi, face = plan((10, 45, 90, 135))
    angles = [
        a + s * rng.normal(size=(400, 48)) for a, s in zip((inc, azi, face), SETTINGS, strict=True)
    ]
    pair = attitude(*angles)(tool.gravity, tool.field, tool.dip)
    raw = [v @ tool.matrix[t].T + tool.offset[t] for t, v in enumerate(pair)]
    names = ("inclination", "azimuth", "toolface")
    known = dict(zip(names, (inc, azi, face), strict=True))
    known |= {"field": np.full(48, tool.field), "dip": np.full(48, tool.dip)}
    sd = {n: np.full(48, s) for n, s in zip(names, SETTINGS, strict=True)}
    sd |= {"accelerometer": np.array(1e-4), "magnetometer": np.array(15.0)}
    result = fit(Readings(raw[0], raw[1], known=known, sd=sd, settings="per-station"))
    settings, where = (
        StatedCovariance(result).by_source()["settings of the stand"],
        result.problem.slices(),
    )
    for triad, own in enumerate(where):
        one = result.problem.triads[triad].model.finished(30.0)[1]
        values = np.einsum("bij,bj->bi", one, result.state.params[:, own])
        share = one @ settings[:, own, own] @ np.swapaxes(one, -1, -2)
        assert (result.analysis.variance_factor < 1).all(), "nothing declared shrinks"
        stated = np.diagonal(share, axis1=1, axis2=2).mean(0)
        np.testing.assert_allclose(values.var(0) / stated, 1.0, atol=0.3)


def test_budget_of_the_record_adds_up_and_names_its_sources():
    _, data = runs("azimuth-zero", SIZES["azimuth-zero"], count=1)
    record = calibrate(member_readings(data, 0), Profile(name="x"))
    sources = [row.source for row in record.budget]
    assert sources == [
        "noise of the readings",
        "settings of the stand",
        "azimuth zero of the stand",
    ]
    expected = typical_accuracy(record)
    for angle in ("inclination", "toolface", "azimuth"):
        total = sum(getattr(row, f"{angle}_deg") ** 2 for row in record.budget) ** 0.5
        assert total == pytest.approx(expected[angle], rel=1e-3)
    assert record.constants[0].name == "azimuth zero of the stand"


def member_readings(data, index):
    """One run of a batch."""
    return Readings(
        data.accelerometer[index], data.magnetometer[index], known=data.known, sd=data.sd
    )


def test_chance_of_the_residuals_is_uniform_where_all_is_as_declared():
    _, data = runs("azimuth-zero", 0.0, declared=False, count=600, seed=5)
    chances = misfit_chances(fit(data))
    for limit in (0.05, 0.2, 0.5, 0.8):
        expected = limit * chances.size
        seen = (chances < limit).sum()
        assert abs(seen - expected) < 4 * np.sqrt(expected * (1 - limit)), limit


def test_noise_half_as_large_again_is_reported_and_the_expected_errors_stay():
    _, data = runs("azimuth-zero", 0.0, declared=False, count=1)
    louder = Readings(
        data.accelerometer[0], data.magnetometer[0], known=data.known,
        sd={**data.sd, "accelerometer": np.array(1e-4 / 1.5), "magnetometer": np.array(10.0)},
    )  # fmt: skip
    record = calibrate(louder, Profile(name="x"))
    ids = [finding.id for finding in record.findings]
    assert "magnetometer-residuals" in ids
    assert record.magnetometer.misfit_probability < 1e-3
    field = next(row for row in record.errors if row.observable == "field")
    assert field.expected < 10.0 < field.after


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_an_error_that_no_residual_shows_stays_as_uncertain_as_it_was_declared(factor):
    """The toolface zero of a stand turns every reading alike; the readings are quieter or louder than declared."""
    _, data = runs("toolface-zero", 0.02 * DEG, declared=True, count=1)
    declared = {
        "accelerometer": np.array(1e-4 / factor),
        "magnetometer": np.array(10.0 / factor),
    }
    readings = Readings(
        data.accelerometer[0], data.magnetometer[0], known=data.known,
        sd={**data.sd, **declared},
    )  # fmt: skip
    record = calibrate(readings, Profile(name="x"))
    (zero,) = [c for c in record.constants if c.name == "toolface zero of the stand"]
    assert zero.standard_uncertainty == pytest.approx(0.02, rel=1e-6)


def test_estimated_inclination_zero_is_unbiased_with_honest_uncertainty():
    _, data = runs("inclination-zero", 0.2 * DEG, declared=False)
    result = fit(data, Options(estimate=("inclination-zero",)))
    rng = np.random.default_rng(0)
    true = 0.2 * DEG * rng.normal(size=(COUNT, 1))[:, 0]
    index = [c.name for c in result.problem.evidence.constants].index("inclination-zero")
    sd = np.sqrt(result.analysis.constants[:, index, index])
    score = (result.state.constants[:, index] - true) / sd
    assert abs(score.mean()) < 3 / np.sqrt(COUNT)
    assert score.std() == pytest.approx(1.0, abs=0.15)


def test_fits_of_one_member_and_of_a_batch_state_the_same():
    _, data = runs("tilt", SIZES["tilt"], count=3)
    result = fit(data)
    one = StatedCovariance(take(result, np.array([1]))).total[0]
    np.testing.assert_allclose(one, StatedCovariance(result).total[1], rtol=1e-9, atol=1e-20)


def test_gravity_under_stand_counts_where_no_run_gives_gravity(tmp_path):
    """Results are then in units of local gravity, which the stand knows to 1 mg."""
    columns = servo_run(3)
    del columns["ref_gravity_g"]
    run, tool = write_csv(tmp_path / "run.csv", columns), tmp_path / "tool.toml"
    text = (EXAMPLE / "tool.toml").read_text("utf-8")
    tool.write_text(text + "gravity_g = 0.001\n", "utf-8")
    ran = mwdcal("calibrate", run, "--tool", tool, "-o", tmp_path / "cal.json", "--json")
    assert ran.code == 0, ran
    assert "gravity reference error" in [row["source"] for row in ran.json["budget"]]
    assert "gravity reference" not in ran.json["assumed_exact"]
    cal = documents.read(tmp_path / "cal.json")
    readings, _ = runs_of(run, cal.profile)
    sd = cal.uncertainty("gravity", readings)
    assert (sd > 0.99e-3).all()
    assert (sd < 1.1e-3).all()


@pytest.mark.parametrize(
    "options", [{"method": "swarm"}, {"method": "scalar", "paper_weights": True}]
)
def test_methods_that_hold_the_stand_refuse_declared_common_errors(options):
    _, data = runs("azimuth-zero", SIZES["azimuth-zero"], count=1)
    with pytest.raises(FitError, match="azimuth-zero"):
        calibrate(member_readings(data, 0), Profile(name="x"), Options(**options))


def test_a_prior_of_the_same_stand_is_reported():
    _, data = runs("toolface-zero", SIZES["toolface-zero"], count=2)
    first = calibrate(member_readings(data, 0), Profile(name="x"))
    options = Options(prior=from_calibration(first))
    record = calibrate(member_readings(data, 1), Profile(name="x"), options)
    (finding,) = [f for f in record.findings if f.id == "prior-shared"]
    assert "toolface zero of the stand" in finding.text
    bare = runs("toolface-zero", 0.0, declared=False, count=1, seed=4)[1]
    record = calibrate(member_readings(bare, 0), Profile(name="x"), options)
    assert not [f for f in record.findings if f.id == "prior-shared"]


@pytest.mark.parametrize("count", [40, pytest.param(120, marks=pytest.mark.study)])
def test_intervals_hold_95_percent_where_the_triads_share_errors(count):
    """Their errors are correlated by those of the stand: Student's t is of the sources, not of the triads.

    Of the triads it would make k 4 and more, and hold 98.5 % or more of azimuths and dips.
    """
    tool, data = runs("dip", SIZES["dip"], count=count)
    rng, covered, ratios_to_student = np.random.default_rng(7), {"azimuth": [], "dip": []}, []
    for pair in zip(data.accelerometer, data.magnetometer, strict=True):
        record = calibrate(Readings(*pair, known=data.known, sd=data.sd), Profile(name="tool"))
        attitudes = rng.uniform(20, 160, 20) * DEG, *rng.uniform(0, 2 * np.pi, (2, 20))
        probe = Readings(*tool.clean(*attitudes))
        # a declared noise that the residuals agree with is known
        excess = [t.degrees_of_freedom for t in record.triads if t.misfit_probability <= 0.05]
        fewest = min(excess, default=1e6)
        for name, true in (("azimuth", attitudes[1]), ("dip", tool.dip)):
            error = centred(OBSERVABLES[name].value(*record.fields(probe)) - true)
            width = record.expanded_uncertainty(name, probe)
            covered[name].append(np.abs(error) < width)
            ratios_to_student.append(
                width / record.uncertainty(name, probe) / stats.t.ppf(0.975, fewest)
            )
    np.testing.assert_allclose(ratios_to_student, 1.0, rtol=1e-9)
    for name, inside in covered.items():
        assert 0.93 < np.mean(inside) < 0.975, name  # 0.95 with a deviation of 0.01, or 0.006
