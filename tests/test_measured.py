"""Measured sets of other projects against what was published of them, by every way that applies.

The sets are not part of the project: MWDCAL_DATA names the folder of a local copy, and
without it these tests are skipped.
"""

import os
from dataclasses import replace

import numpy as np
import pytest

from mwdcal.calibration.estimate import fit
from mwdcal.geometry.vectors import directions, group_scatter

measured = pytest.importorskip("measured")

pytestmark = pytest.mark.skipif(
    "MWDCAL_DATA" not in os.environ, reason="measured sets: set MWDCAL_DATA to a local copy"
)

ONE_OF_EACH = ("sap5/ab", "distox_cal1", "xsens", "imu0")
NEEDY = ("least-squares", "swarm", "newton", "toolface-inclination")
"""Methods that need reference angles, which only imucal has."""
LINEAR = "--nonlinearity none"


def parameters(name, words):
    return np.array(measured.trial(name, words).made.accelerometer.parameters)


# ── Against what was published ───────────────────────────────────────────────────────────────


SAP = tuple(measured.SAP)
LINES = {"linear": LINEAR, "curved": "--nonlinearity magnetometer", "chosen": ""}
"""Models of a SAP set, by the words that ask for them; the default chooses."""


def scatter(name, kind, left_out=True):
    """Direction scatter of a SAP set, degrees."""
    figures = measured.figures(name, LINES[kind])
    return figures.scatter_left_out if left_out else figures.scatter


LIKE_ALL = ("sap6/IB", "sap5/ab")
"""Two sets for what all twelve are asked in a study: curved hardly at all, and much."""


@pytest.mark.parametrize("names", [LIKE_ALL, pytest.param(SAP, marks=pytest.mark.study)])
def test_sap_sets_by_models_that_are_given(names):
    """Below the peer on every set."""
    for name in names:
        linear, curved = (scatter(name, kind, False) for kind in ("linear", "curved"))
        assert max(curved, linear) < measured.SAP[name][0], name
        assert linear < scatter(name, "linear"), name
        assert curved < scatter(name, "curved"), name
    linear, curved = (np.mean([scatter(n, kind) for n in names]) for kind in ("linear", "curved"))
    assert curved < linear


@pytest.mark.study
def test_sap_sets_reach_what_theory_gives_for_the_linear_model():
    """0.457° is that of the linear model without scatter from shot to shot."""
    linear, curved = (np.mean([scatter(n, kind) for n in SAP]) for kind in ("linear", "curved"))
    assert curved <= 0.45
    assert linear <= 0.457


@pytest.mark.parametrize("name", LIKE_ALL)
def test_sap_sets_by_the_model_that_is_chosen(name):
    """The choice nested: no station has a say in the model that judges it. One set is curved, one is not."""
    assert scatter(name, "chosen", False) < measured.SAP[name][0]
    assert scatter(name, "chosen") <= min(scatter(name, "linear"), scatter(name, "curved"))


@pytest.mark.study
def test_sap_goals():
    """The default's goal, its choice nested, over all twelve sets."""
    left_out = [scatter(name, "chosen") for name in measured.SAP]
    assert np.mean(left_out) <= measured.LOO_GOAL
    assert np.mean(left_out) <= np.mean([scatter(name, "curved") for name in measured.SAP])
    for name in measured.SAP:
        assert scatter(name, "chosen", False) < measured.SAP[name][0], name


@pytest.mark.parametrize(
    "names", [["distox_cal1"], pytest.param(tuple(measured.DISTOX), marks=pytest.mark.study)]
)
def test_distox_default_is_best_in_directions_that_no_fit_is_told_of(names):
    """Ten directions of four rolls: own-axis terms do harm there, estimated scatter helps."""
    others = np.array([-1] * 16 + [k // 4 for k in range(40)])
    default, linear, curved = (
        np.mean([measured.figures(name, words).scatter_in(others) for name in names])
        for words in ("", LINEAR, "--nonlinearity accelerometer")
    )
    plain = np.mean([without_scatter(name, others) for name in names])
    assert default == linear < 0.97 * plain
    assert linear < curved


def without_scatter(name, groups, words=LINEAR, *, left_out=True):
    """Scatter within groups, degrees, by fits that estimate noise alone."""
    readings, _ = measured.run(name)
    options = replace(measured.options(name, words), scatter=False)
    own = np.arange(readings.count)
    result = fit(readings, options, 1 - left_out * np.eye(readings.count))
    g, b = (vectors[own, own] for vectors in result.problem.fields(result.state))
    return np.degrees(group_scatter(directions(g, b), groups))


SETS = (*measured.SAP, *measured.DISTOX)
ROBUST = "--robust student-t"


@pytest.mark.parametrize(
    ("words", "names"),
    [
        ("", SETS[2::5]),
        (ROBUST, SETS[4::8]),
        pytest.param("", SETS, marks=pytest.mark.study),
        pytest.param(ROBUST, SETS, marks=pytest.mark.study),
    ],
)
def test_the_default_refuses_no_set(words, names):
    refused = {name: measured.trial(name, words).refused for name in names}
    assert {name: reason for name, reason in refused.items() if reason} == {}


def test_the_refitted_peer_is_the_published_one_in_sample():
    """What `peers.csv` holds of each set is what the author of the peer published, and pages quote its means."""
    path = measured.Path(measured.__file__).with_name("peers.csv")
    rows = measured.csv.DictReader(path.read_text("utf-8").splitlines())
    found = {(row["set"], row["routine"]): float(row["in_sample_deg"]) for row in rows}
    for name, published in measured.SAP.items():
        ours = found[name, "axis"], found[name, "non-linear"]
        assert ours == pytest.approx(published, abs=5.5e-4), name
    readme = (measured.Path(__file__).parents[1] / "README.md").read_text("utf-8")
    for routine in ("fast non-linear", "non-linear"):
        assert f"{measured.peers()[routine][1]:.3f}°" in readme


@pytest.mark.parametrize("name", measured.DISTOX)
def test_distox_scatter_below_the_peers_coefficients(name):
    peer = measured.distox_peer(name)
    assert peer == pytest.approx(measured.DISTOX[name], abs=5e-4)
    curved, linear = (
        without_scatter(name, measured.run(name)[0].groups, words, left_out=False)
        for words in ("--nonlinearity accelerometer", LINEAR)
    )
    assert curved < peer
    # without own-axis terms the peer is ahead in sample, but not by much
    assert peer < linear < 1.02 * peer


@pytest.mark.parametrize("words", ["", LINEAR, "--method scalar"])
def test_xsens_meets_the_published_calibration(words):
    found = measured.xsens(words)
    assert found["bias, counts"] < 1
    assert found["scale, relative"] < 3e-4
    assert found["misalignment, rad"] < 1e-3
    assert found["residual of |g|, %"] <= 0.015


@pytest.mark.parametrize("words", ["", LINEAR, "--method scalar"])
def test_mikov_meets_the_publication_within_its_uncertainty(words):
    assert max(worst for worst, _ in measured.mikov(words).values()) < 1.5


def test_imucal_is_reproduced_by_all_that_see_whole_vectors():
    """The swarm is least squares found by other means."""
    assert measured.imucal("") < 1e-9
    assert measured.imucal("--method least-squares") < 1e-9
    assert measured.imucal("--method least-squares --paper-weights") < 1e-9
    assert measured.imucal("--method swarm") < 1e-8
    swarm, squares = (parameters("imucal", f"--method {m}") for m in ("swarm", "least-squares"))
    assert swarm == pytest.approx(squares, abs=1e-8)


# ── Laws of the ways ─────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("name", ONE_OF_EACH)
@pytest.mark.parametrize("method", NEEDY)
def test_methods_of_the_papers_are_refused_for_want_of_references(name, method):
    for words in measured.PLAIN:
        reason = measured.trial(name, f"--method {method} {words}".strip()).refused
        if method == "swarm" and "--parameters" in words:
            assert "cannot be combined with method swarm" in reason
            continue
        assert "'ref_inclination_deg' is blank at" in reason
        assert "`method` joint" in reason


def test_every_way_gives_a_calibration_or_a_reason():
    for words in measured.ways("accelerometer"):
        trial = measured.trial("imucal", words)
        assert bool(trial.made) != bool(trial.refused), words
        assert trial.made or len(trial.refused) > 60, words


@pytest.mark.parametrize(
    ("name", "joint", "scalar"),
    [
        ("sap6/BB", ["11 of 12", "11 of 12"], ["9 of 12", "9 of 12"]),
        ("distox_cal1", ["11 of 12", "11 of 12"], ["9 of 12", "9 of 12"]),
        ("xsens", ["9 of 12"], ["9 of 12"]),
        ("imu0", ["9 of 12"], ["9 of 12"]),
    ],
)
def test_ranks_are_those_of_the_evidence(name, joint, scalar):
    assert measured.trial(name, LINEAR).ranks == joint
    assert measured.trial(name, f"--method scalar {LINEAR}").ranks == scalar
    for size in (9, 6):
        ranks = measured.trial(name, f"{LINEAR} --parameters {size}").ranks
        assert set(ranks) == {f"{size} of {size}"}


@pytest.mark.parametrize("name", ["xsens", *measured.MIKOV])
def test_strengths_alone_make_joint_and_scalar_one_estimator(name):
    joint, scalar = (parameters(name, words) for words in ("", "--method scalar"))
    assert scalar == pytest.approx(joint, abs=1e-9)
    assert parameters(name, "--method scalar --paper-weights") == pytest.approx(joint, abs=1e-5)


@pytest.mark.parametrize("name", ["xsens", "imu0"])
def test_fewer_parameters_fit_no_better(name):
    """Nine leave out just the rotations that the strength cannot see, six more than that."""
    ladder = ("--parameters 6", "--parameters 9", "", "--nonlinearity accelerometer")
    six, nine, twelve, eighteen = (measured.figures(name, words) for words in ladder)
    assert nine.gravity == pytest.approx(twelve.gravity, rel=1e-4)
    assert six.gravity > 3 * nine.gravity
    assert eighteen.gravity < twelve.gravity
    # left-out stations do not speak for own-axis terms, and they are not taken
    assert eighteen.gravity_left_out > twelve.gravity_left_out
    assert not measured.options(name).nonlinearity


def test_fewer_parameters_scatter_more():
    six, nine, twelve = (
        measured.figures("sap6/IB", f"{LINEAR} {more}".strip())
        for more in ("--parameters 6", "--parameters 9", "")
    )
    assert twelve.scatter < nine.scatter < six.scatter
    assert twelve.scatter_left_out < nine.scatter_left_out < six.scatter_left_out


def test_scatter_is_judged_only_where_it_is_determined():
    words = f"--method scalar {LINEAR}"
    scalar, joint = measured.figures("sap6/IB", words), measured.figures("sap6/IB", LINEAR)
    assert np.isnan([scalar.scatter, scalar.scatter_left_out]).all()
    # the strengths are all that it fits, and in sample it fits them better than joint
    assert scalar.gravity < joint.gravity
    # with the rotations set to zero the scatter is determined, and bad
    assert measured.figures("sap6/IB", f"{words} --parameters 9").scatter > 3 * joint.scatter


@pytest.mark.parametrize("loss", ["huber", "student-t"])
@pytest.mark.parametrize("name", ["xsens", "imu0"])
def test_robust_weights_do_not_spoil_clean_sets(name, loss):
    """Left-out residuals within 3 % of those with full weights."""
    plain, robust = (
        measured.figures(name, words) for words in (LINEAR, f"{LINEAR} --robust {loss}")
    )
    assert robust.gravity_left_out < 1.03 * plain.gravity_left_out


def test_robust_weights_do_not_spoil_a_roll_set():
    """Scatter of a set without bad shots within 5 % of that with full weights."""
    words = (LINEAR, f"{LINEAR} --robust student-t")
    plain, robust = (measured.figures("sap5/ai", w).scatter_left_out for w in words)
    assert robust < 1.05 * plain


# ── Page ─────────────────────────────────────────────────────────────────────────────────────


def test_rows_with_equal_figures_are_one():
    text = measured.compared(["imucal"], "accelerometer", ("from K·R",), lambda words: ["x"])
    assert "`--method least-squares`, also with `--paper-weights`" in text[2]
    assert {row.count("|") for row in text} == {4}


@pytest.mark.parametrize("method", NEEDY)
def test_refusals_of_the_lone_accelerometers_differ_in_numbers_alone(method):
    names = ("xsens", *measured.MIKOV)
    reasons = {measured.trial(name, f"--method {method}").refused for name in names}
    assert len({"".join(c for c in reason if not c.isdigit()) for reason in reasons}) == 1


def test_labels_name_each_method_once():
    words = ["", "--robust huber", *(f"--method swarm {w}".strip() for w in measured.PLAIN)]
    assert (
        measured.label(words)
        == "default, also with `--robust huber`; `--method swarm` in every form"
    )
    assert measured.label(["--method newton --parameters 9"]) == "`--method newton --parameters 9`"


def test_hashes_are_checked(tmp_path, monkeypatch):
    (tmp_path / "mikov").mkdir()
    (tmp_path / "mikov" / "published.csv").write_text("something else")
    monkeypatch.setenv("MWDCAL_DATA", str(tmp_path))
    with pytest.raises(measured.MwdcalError):
        measured.fetch("mikov/published.csv")
