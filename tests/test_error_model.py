"""The industry's error model: ISCWSA's example well term by term, formulas, and files that are refused."""

from __future__ import annotations

import json

import numpy as np
import pytest

import published_wells
from mwdcal.errors import InputError
from mwdcal.survey.error_model import Hole, load_error_model, parsed
from mwdcal.survey.path import position_covariance, well_path
from test_tool_model import read_example, six
from test_well_path import needs_published_wells

DEPTHS = (1200, 2100, 5100, 8000)
NAMES = frozenset({"inc", "azt"})


def example_hole():
    md, inclination, azimuth, header, published = read_example()
    tvd = well_path(md, inclination, azimuth)[:, 2]
    magnetic = azimuth - header["declination"]
    earth = header["b_total"], header["dip"], header["G"]
    return Hole.along(md, tvd, inclination, azimuth, magnetic, *earth), published


def measured_from_the_second_station(shift):
    """Causes (n, n - 1, 3), each of one station; the published path begins with the direction of its second station."""
    count = len(shift)
    each, place = np.zeros((count, count - 1, 3)), np.arange(1, count)
    each[place, place - 1] = shift[1:]
    each[0, 0, :2] = shift[1, :2]
    return each


def covariances(hole):
    """Covariance (n, 6) of each term, by the balanced tangential method, as published."""
    model, path = load_error_model(), (hole.md, hole.inclination, hole.azimuth)
    for name, shift in model.shifts(hole, "lasting").items():
        shift[0, :2] = shift[1, :2]
        yield name, six(position_covariance(*path, shift[:, None], balanced=True))
    for name, shift in model.shifts(hole, "random").items():
        each = measured_from_the_second_station(shift)
        yield name, six(position_covariance(*path, each, balanced=True))
    for name, shift in model.shifts(hole, "course").items():
        course = shift[:, :2, None] * shift[:, None, :2]
        yield name, six(position_covariance(*path, balanced=True, course=course))


@needs_published_wells
def test_every_term_of_the_published_well_and_the_total():
    hole, published = example_hole()
    ours = dict(covariances(hole))
    assert set(ours) == {source for _, source in published} - {"TOTAL"}
    for depth in DEPTHS:
        row = hole.md == depth
        for name, covariance in ours.items():
            size = max(np.abs(published[depth, name]).max(), 1e-9)
            expected = published[depth, name]
            np.testing.assert_allclose(covariance[row][0], expected, rtol=0, atol=3e-6 * size)
        total = sum(covariance[row][0] for covariance in ours.values())
        np.testing.assert_allclose(total, published[depth, "TOTAL"], rtol=0, atol=1e-4)


@pytest.mark.parametrize("well", [2, 3])
def test_every_term_of_the_published_wells_2_and_3_to_the_printed_digits(well):
    """A hole that turns through all azimuths, in feet, and one that drops to vertical and rises beyond horizontal."""
    md, inclination, azimuth = published_wells.stations(well)
    field, dip, declination = published_wells.EARTH[well]
    tvd = well_path(md, inclination, azimuth)[:, 2]
    magnetic = azimuth - np.radians(declination)
    hole = Hole.along(md, tvd, inclination, azimuth, magnetic, field, np.radians(dip))
    ours = {name: covariance[-1] for name, covariance in covariances(hole)}
    expected = published_wells.published(well)
    assert set(ours) == set(expected) - {"TOTAL"}
    for name, covariance in ours.items():
        np.testing.assert_allclose(covariance, expected[name], rtol=0, atol=5.1e-5, err_msg=name)
    total = sum(ours.values())
    np.testing.assert_allclose(total, expected["TOTAL"], rtol=0, atol=5.1e-5)


def test_a_term_that_is_larger_has_errors_as_much_larger():
    md = np.arange(5) * 30.0
    angle = np.radians([10.0, 20.0, 30.0, 40.0, 50.0])
    hole = Hole.along(md, md, angle, angle, angle, 5e4, 1.2)
    shifts = load_error_model().shifts(hole, "lasting")
    once = np.sin(angle) * np.sin(angle) / (5e4 * np.cos(1.2)) * 220.0
    np.testing.assert_allclose(shifts["AMIL"][:, 1], np.sin(angle) * once, rtol=1e-12)
    np.testing.assert_allclose(shifts["DSFS"][:, 2], 0.00056 * md)


def test_formulas_are_arithmetic_of_named_quantities():
    formula = parsed("-Sin(Inc)^0.25 / Max(2, AzT) + Sqr(4) * Abs(-1)", NAMES)
    angle = np.array([0.3, 1.2])
    expected = -(np.sin(angle) ** 0.25) / np.maximum(2, 3.0) + 2.0
    np.testing.assert_allclose(formula({"inc": angle, "azt": 3.0}), expected)


@pytest.mark.parametrize(
    "text",
    ["", "Sin(", "Tfo", "__import__('os')", "Inc.real", "[Inc]", "Max(1)", "Sin(Inc, x=1)", "True", "'a'",
     "1 if Inc else 2", "lambda: 1", "Inc" + "+Inc" * 200],
)  # fmt: skip
def test_what_is_no_formula_is_refused(text):
    with pytest.raises(InputError):
        parsed(text, NAMES)


def changed(tmp_path, **changes):
    folder = load_error_model.__globals__["resources"].files("mwdcal") / "error_models"
    model = json.loads((folder / "owsg-mwd.json").read_text())
    model["terms"][0] |= changes
    path = tmp_path / "model.json"
    path.write_text(json.dumps(model))
    return path


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"value": -1.0}, "term 'DRFR'"),
        ({"name": "DSFS"}, "must stand once"),
        ({"depth_formula": "Exec(1)"}, "'Exec(1)' is not understood"),
        ({"units": "furlong"}, "not an error model"),
        ({"propagation_mode": "Sometimes"}, "not an error model"),
    ],
)
def test_models_that_are_not_understood_are_refused(tmp_path, changes, words):
    with pytest.raises(InputError, match="DRFR|DSFS|error model") as caught:
        load_error_model(changed(tmp_path, **changes))
    assert words in str(caught.value)


def test_a_model_from_a_file_has_its_own_sizes(tmp_path):
    model = load_error_model(changed(tmp_path, value=0.7))
    assert model.terms[0].size == 2 * load_error_model().terms[0].size
    assert model.digest != load_error_model().digest


def test_an_unknown_model_is_named_with_those_that_are_built_in():
    with pytest.raises(InputError, match="Built in: owsg-mwd"):
        load_error_model("nowhere.json")
