"""Methods side by side: what each reaches where theory says so, refusals, advice, JSON."""

import json

import numpy as np
import pytest

from cli_support import mwdcal
from mwdcal.compare import compare
from test_calibrate import PROFILE, make, msgspec_replace

EXAMPLE = "examples/servo/run.csv"


@pytest.fixture(scope="module")
def whole():
    return compare(make(1), PROFILE)


def test_ranks_and_free_directions_are_those_of_theory(whole):
    ranks = {row.method: [rank for rank, _ in row.ranks.values()] for row in whole.rows}
    assert ranks == {
        "joint": [12, 12], "least-squares": [12, 12],
        "newton": [11, 11], "swarm": [12, 12], "toolface-inclination": [11, 12], "scalar": [9, 9],
    }  # fmt: skip
    free = {row.method: row.undetermined for row in whole.rows}
    assert free["joint"] == free["least-squares"] == ()
    assert free["newton"] == ("toolface-zero",)
    assert free["toolface-inclination"] == ("scale",)
    assert set(free["scalar"]) == {"rotation-x", "rotation-y", "toolface-zero"}


def test_left_out_errors_exceed_those_in_sample_and_equal_evidence_agrees(whole):
    rows = {row.method: row for row in whole.rows}
    for row in rows.values():
        assert np.mean([row.held_out[n] / row.in_sample[n] for n in row.held_out]) > 1.0
    # with exact references all weights are the same, so joint and least squares are one estimator
    assert rows["joint"].held_out == pytest.approx(rows["least-squares"].held_out, rel=1e-5)
    assert rows["swarm"].held_out == pytest.approx(rows["least-squares"].held_out, rel=1e-5)
    # Newton-Raphson with propagated weights is the maximum likelihood of its evidence, but for
    # the little that the magnetometer tells of the accelerometer
    assert rows["newton"].held_out["inclination"] < 1.1 * rows["joint"].held_out["inclination"]
    assert rows["newton"].iterations < 10
    assert "joint" in whole.advice


def test_methods_that_do_not_apply_say_why():
    found = compare(make(1, unknown=("toolface",)), PROFILE)
    refused = {row.method: row.refused for row in found.rows if row.refused}
    assert set(refused) == {"least-squares", "swarm", "toolface-inclination"}
    assert all("ref_toolface_deg" in reason for reason in refused.values())


def test_a_run_that_nothing_can_calibrate():
    found = compare(msgspec_replace(make(1).select(np.arange(48) < 3)), PROFILE)
    assert all(row.refused for row in found.rows)
    assert "no method" in found.advice


def test_command_prints_the_same_as_its_json():
    screen = mwdcal("compare", EXAMPLE, "--tool", "servo")
    document = json.loads(mwdcal("compare", EXAMPLE, "--tool", "servo", "--json").out)
    assert screen.code == 0
    assert document["advice"] in screen.out
    assert [row["method"] for row in document["rows"]][:2] == ["joint", "least-squares"]
    assert set(document["units"]) == set(document["rows"][0]["held_out"])
