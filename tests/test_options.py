"""Choices of a fit: fewer parameters, the papers' own sums, own-axis terms by left-out stations."""

import ast
import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

from cli_support import commands, mwdcal
from mwdcal.calibration import fit_options
from mwdcal.calibration.automatic.auto import choose_curves, compare_curves
from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options, as_arguments, options_of
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import FitSettings
from mwdcal.calibration.results import readings_at
from mwdcal.errors import InputError
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import centred
from simulation import Tool, information, plan
from test_calibrate import NOISE, PROFILE, make
from test_efficiency import sensitivity
from test_robust import NAMES

LOWER = np.tril(np.ones((3, 3), bool))
KEPT = {9: LOWER, 6: np.eye(3, dtype=bool)}


def framed(parameters, seed=7):
    """A tool whose gains have no more parameters than that."""
    tool = Tool.random(seed)
    tool.matrix = tool.matrix * KEPT[parameters]
    return tool


@pytest.mark.parametrize("kind", ["polynomial", "factors"])
@pytest.mark.parametrize("parameters", [9, 6])
def test_fewer_parameters_meet_their_own_bound(parameters, kind):
    tool, (inc, azi, face) = framed(parameters), plan()
    a, m = tool.readings(np.random.default_rng(5), 300, inc, azi, face)
    known = {"inclination": inc, "azimuth": azi, "toolface": face}
    known |= {"field": np.full(48, tool.field), "dip": np.full(48, tool.dip)}
    result = fit(Readings(a, m, known=known, sd=NOISE), Options(model=kind, parameters=parameters))
    assert (result.status == 0).all()
    assert (result.analysis.determined.rank == 2 * parameters).all()
    kept = np.concatenate([np.tile(KEPT[parameters].ravel(), 2), np.ones(6, bool)])
    whole = information(tool, inc, azi, face, ())[np.ix_(kept, kept)]
    scale = np.sqrt(np.diag(whole))
    limit = np.linalg.inv(whole / np.outer(scale, scale)) / np.outer(scale, scale)
    ratios = []
    for name in NAMES:
        forward = sensitivity(tool, name)[1][:, kept]
        clean = tool.clean(*np.array([[20.0, 33, 70, 110, 150], [10.0, 100, 200, 250, 333],
                                      [15.0, 75, 160, 222, 301]]) * np.pi / 180)  # fmt: skip
        pairs = zip(result.problem.triads, result.problem.slices(), clean, strict=True)
        fields = [
            t.model.fields(result.state.params[:, w], raw, np.zeros(5)) for t, w, raw in pairs
        ]
        true = [
            (r - o) @ np.linalg.inv(s).T
            for r, s, o in zip(clean, tool.matrix, tool.offset, strict=True)
        ]
        error = OBSERVABLES[name].value(*fields) - OBSERVABLES[name].value(*true)
        allowed = np.sqrt(np.einsum("ni,ij,nj->n", forward, limit, forward))
        error = error if name in ("gravity", "field") else centred(error)
        ratios.append(np.mean((error / allowed) ** 2))
    assert np.sqrt(np.mean(ratios)) == pytest.approx(1, abs=0.03)


def test_the_file_of_nine_parameters_is_a_whole_model_with_zeros():
    record = calibrate(make(tool=framed(9)), PROFILE, Options(parameters=9))
    triad = record.accelerometer
    assert (triad.rank, triad.size, len(triad.parameters)) == (9, 9, 12)
    held = dict(zip(triad.parameter_names, triad.parameters, strict=True))
    assert [held[f"gain-{n}"] for n in ("xy", "xz", "yz")] == [0, 0, 0]
    spread = dict(zip(triad.parameter_names, triad.standard_uncertainties, strict=True))
    assert [spread[f"gain-{n}"] for n in ("xy", "xz", "yz")] == [0, 0, 0]
    assert any(f.id == "restricted" for f in record.findings)
    again = calibrate(make(tool=framed(9)), PROFILE)
    probe = readings_at(again, np.radians([30.0, 80.0]), 1.0, 0.7)
    assert (record.uncertainty("azimuth", probe) < again.uncertainty("azimuth", probe)).all()


def alone(seed, count):
    """Runs with references for the papers' sums."""
    tool = Tool.random(seed)
    inc, azi, face = plan((20, 60, 110, 150))
    a, m = tool.readings(np.random.default_rng(seed), count, inc, azi, face)
    known = {"inclination": inc, "azimuth": azi, "toolface": face}
    known |= {"field": np.full(48, tool.field), "dip": np.full(48, tool.dip)}
    return tool, Readings(a, m, known=known, sd=NOISE)


def paper_sum(method, data, member=0):
    """Residuals of the printed sums, of twelve affine parameters of the accelerometer."""
    raw, known = data.accelerometer[member], data.known

    def residuals(x):
        g = raw @ x[:9].reshape(3, 3).T + x[9:]
        inclination = np.arctan2(np.hypot(g[:, 0], g[:, 1]), g[:, 2]) - known["inclination"]
        toolface = centred(np.arctan2(-g[:, 0], -g[:, 1]) - known["toolface"])
        square = np.sum(g**2, -1) - 1
        return np.concatenate({
            "newton": (square, inclination),
            "toolface-inclination": (toolface, inclination),
            "scalar": (square,),
        }[method])  # fmt: skip

    return residuals


@pytest.mark.parametrize("method", ["newton", "toolface-inclination", "scalar"])
def test_paper_weights_are_at_the_minimum_of_the_printed_sum(method):
    _, data = alone(3, 1)
    result = fit(data, Options(method, paper_weights=True))
    assert result.status[0] == 0
    model, where = result.problem.triads[0].model, result.problem.slices()[0]
    _, whole = model.finished(0.0)
    ours = whole[0] @ result.state.params[0, where]
    residuals = paper_sum(method, data)
    theirs = least_squares(residuals, ours, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert np.sum(residuals(ours) ** 2) == pytest.approx(2 * theirs.cost, rel=1e-9)
    weighted = fit(data, Options(method))
    ours = whole[0] @ weighted.state.params[0, where]
    assert np.sum(residuals(ours) ** 2) > 2 * theirs.cost * (1 + 1e-6)


OBSERVED = {
    "newton": ("gravity", "inclination", "field", "dip", "azimuth"),
    "toolface-inclination": ("inclination", "toolface", "azimuth", "dip"),
    "scalar": ("gravity", "field"),
    "least-squares": ("gravity", "inclination", "toolface", "azimuth", "field", "dip"),
}


@pytest.mark.parametrize(
    ("count", "within"), [(16, 0.03), pytest.param(40, 0.02, marks=pytest.mark.study)]
)
@pytest.mark.parametrize("method", OBSERVED)
def test_intervals_of_paper_weights_cover(method, count, within):
    """The share of intervals that cover is known to about 1 % from 40 runs."""
    tool, many = alone(4, count)
    covered = []
    for member in range(count):
        data = replace(
            many, accelerometer=many.accelerometer[member], magnetometer=many.magnetometer[member]
        )
        record = calibrate(data, PROFILE, Options(method, paper_weights=True))
        clean = tool.clean(*np.radians([[25.0, 70, 140], [10.0, 100, 200], [15.0, 75, 160]]))
        true = [(r - o) @ np.linalg.inv(s).T
                for r, s, o in zip(clean, tool.matrix, tool.offset, strict=True)]  # fmt: skip
        probe = Readings(*clean)
        for name in OBSERVED[method]:
            value = OBSERVABLES[name].value
            error = centred(
                value(*record.fields(probe)) - value(*true),
                2 * np.pi if name not in ("field", "gravity") else 1e9,
            )
            covered.append(np.abs(error) < record.expanded_uncertainty(name, probe))
    assert abs(np.mean(covered) - 0.95) < within


def test_paper_weights_are_of_papers():
    with pytest.raises(InputError, match="does not come from a paper"):
        calibrate(make(), PROFILE, Options(paper_weights=True))


def bent(seed, size):
    """Runs of a magnetometer with own-axis terms of a share `size` of the field."""
    data = make(seed)
    m = data.magnetometer / 50_000
    return replace(data, magnetometer=data.magnetometer + 50_000 * size * (m**2 - m**3))


def test_own_axis_terms_are_taken_only_where_left_out_stations_improve():
    offered = {"accelerometer": 0.005, "magnetometer": 0.005}
    for seed in range(3):
        straight, table = choose_curves(bent(seed, 0.0), Options(), offered)
        assert straight == {}
        assert [s.triads for s in table if s.chosen] == [()]
        curved, table = choose_curves(bent(seed, 0.004), Options(), offered)
        assert curved == {"magnetometer": 0.005}
        assert min(table, key=lambda s: s.left_out).left_out < 0.9 * table[0].left_out


@pytest.mark.parametrize("declared", [True, False])
def test_a_batch_of_runs_is_compared_as_each_run_alone(declared):
    terms = {"accelerometer": 0.005, "magnetometer": 0.005}
    runs = [bent(seed, size) for seed, size in ((0, 0.0), (1, 0.004), (2, 0.0))]
    runs = [run if declared else replace(run, sd={}) for run in runs]
    batch = replace(
        runs[0],
        accelerometer=np.stack([run.accelerometer for run in runs]),
        magnetometer=np.stack([run.magnetometer for run in runs]),
        known={n: np.stack([run.reference(n) for run in runs]) for n in runs[0].known},
        sd={n: np.stack([np.broadcast_to(run.sd[n], (48, 3)) for run in runs]) for n in runs[0].sd},
    )
    curves = compare_curves(batch, Options(), terms)
    for place, run in enumerate(runs):
        chosen, table = choose_curves(run, Options(), terms)
        assert curves.choices[curves.chosen[place]] == tuple(chosen)
        assert curves.odds == (not declared)
        for triads, score, row in zip(curves.choices, curves.score[place], table, strict=True):
            assert (row.triads, row.chosen) == (triads, triads == tuple(chosen))
            assert (row.left_out is None) == (row.odds is not None) == (not declared)
            alone = row.left_out if declared else row.odds * np.log(10)
            assert score == pytest.approx(alone, rel=1e-6, abs=1e-6)
    assert [bool(place) for place in curves.chosen] == [False, True, False]


SERVO = "examples/servo"


def test_choices_reach_the_file_and_the_screen(tmp_path):
    first = mwdcal("calibrate", f"{SERVO}/run.csv", "--tool", f"{SERVO}/tool.toml", "-o", tmp_path / "a.json",
                   "--parameters", "9", "--robust", "huber")  # fmt: skip
    assert first.code == 0
    assert "9 parameters" in first.out
    assert "robust (huber)" in first.out
    options = json.loads((tmp_path / "a.json").read_text("utf-8"))["options"]
    assert options == {
        "parameters": 9,
        "ignore": [],
        "robust": "huber",
        "paper_weights": False,
        "prior": None,
    }


@pytest.mark.parametrize(
    ("typed", "code", "said"),
    [
        (("--prior", "a.json"), 2, "count twice"),
        (("--prior", "datasheet"), 2, "datasheet"),
        (("--prior", "missing.json"), 2, "missing.json"),
        (("--paper-weights",), 2, "does not come from a paper"),
        (("--robust", "huber", "--method", "swarm"), 2, "--robust"),
        (("--nonlinearity", "thermometer"), 2, "--nonlinearity"),
        (("--nonlinearity", "magnetometer", "--model", "factors"), 2, "--model polynomial"),
        (("--parameters", "7"), 2, "7"),
    ],
)
def test_choices_that_make_no_sense_are_refused(tmp_path, monkeypatch, typed, code, said):
    run = ("calibrate", f"{SERVO}/run.csv", "--tool", f"{SERVO}/tool.toml", "-o")
    assert mwdcal(*run, tmp_path / "a.json").code == 0
    typed = [str(tmp_path / "a.json") if word == "a.json" else word for word in typed]
    ran = mwdcal(*run, tmp_path / "b.json", *typed)
    assert ran.code == code
    assert said in ran.err
    assert not (tmp_path / "b.json").exists()


def test_a_previous_calibration_is_taken_as_prior(tmp_path):
    out, tool = tmp_path / "a.json", f"{SERVO}/tool.toml"
    assert mwdcal("calibrate", f"{SERVO}/run.csv", "--tool", tool, "-o", out).code == 0
    ran = mwdcal("calibrate", f"{SERVO}/rolltest.csv", "--tool", tool, "-o", tmp_path / "b.json",
                 "--prior", out)  # fmt: skip
    assert ran.code == 0, ran.err
    assert "prior run.csv" in ran.out
    made = json.loads((tmp_path / "b.json").read_text("utf-8"))
    assert made["accelerometer"]["rank"] == 12


# Declared once

SOURCE = Path(fit_options.__file__).parents[1]


def declares(path, name):
    """Whether a module has a field or a string of a name."""
    text = path.read_text("utf-8")
    for node in ast.walk(ast.parse(text)) if name in text else ():
        target = node.target if isinstance(node, ast.AnnAssign) else None
        if getattr(target, "id", "") == name or getattr(node, "value", None) == name:
            return True
    return False


@pytest.mark.parametrize("name", ["estimate", "robust", "paper_weights"])
def test_an_option_of_the_fit_stands_in_four_files_at_most(name):
    """`survey` has a robust fit of its own."""
    modules = [path for path in SOURCE.rglob("*.py") if path.parent.name != "survey"]
    places = [str(path.relative_to(SOURCE)) for path in modules if declares(path, name)]
    assert len(places) <= 4, places


def test_every_option_of_the_fit_is_one_of_options_and_of_the_command():
    typed = {option.name for option in commands()["calibrate"].params}
    assert {*fit_options.FIT_OPTIONS} == {*fit_options.FitArguments.__annotations__}
    assert typed > {*fit_options.FIT_OPTIONS} < {field.name for field in fields(Options)}


def test_options_of_a_fleet_go_to_words_and_back():
    chosen = Options(
        order=0, nonlinearity=("magnetometer",), estimate=("tilt",), parameters=9, robust="huber"
    )
    words = as_arguments(chosen)
    assert (words["nonlinearity"], words["estimate"], words["parameters"]) == (
        "magnetometer",
        "tilt",
        "9",
    )
    assert options_of(words) == chosen
    assert as_arguments(Options(nonlinearity={}))["nonlinearity"] == "none"


def test_settings_are_worded_for_screens_and_certificates():
    settings = FitSettings(parameters=9, ignore=["field", "dip"], robust="huber")
    assert [*fit_options.unusual(settings, "heading")] == [
        "9 parameters",
        "without field and dip",
        "robust (huber)",
    ]
    words = "; ".join(fit_options.unusual(settings, "deviation"))
    assert "references not used: field, dip" in words
    assert not [*fit_options.unusual(FitSettings(), "heading")]
