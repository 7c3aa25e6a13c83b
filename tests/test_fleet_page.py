"""The summary page of a fleet: units of its parameters, and axes that show the fleet, not its outliers."""

import re
from itertools import pairwise

import numpy as np
import pytest

from test_fleet import short_run
from test_fleet_findings import said

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

from mwdcal.app.pages import fleet_report, pictures  # noqa: E402


def unknown(seed):
    """A run whose stand knows no field."""
    return short_run(seed, ref_field_nt=np.full(28, np.nan))


def units(page):
    """Unit of each magnetometer parameter at a field of one, as the page has it."""
    rows = re.findall(r"<tr><td>magnetometer, field = 1</td>.*?</tr>", page)
    cells = [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in rows]
    return {row[1]: row[-1] for row in cells}


@pytest.mark.parametrize(
    ("tool", "model", "expected"),
    [
        ("servo", "polynomial", {"gain xx": "1/nT", "gain zy": "1/nT", "offset x": "of the field"}),
        (
            "servo",
            "factors",
            {"scale x": "nT", "bias y": "of the field", "misalignment xy": "share"},
        ),
        ("generic", "polynomial", {"gain xx": "share", "offset x": "of the field"}),
        ("generic", "factors", {"scale x": "share", "bias y": "of the field"}),
    ],
)
def test_units_of_a_relative_field_are_those_of_the_nominal_readings(
    tmp_path, tool, model, expected
):
    runs = {f"T{i}": unknown(i) for i in range(3)} | {"known": short_run(9)}
    _, page = said(tmp_path, runs, "--tool", tool, "--model", model)
    found = units(page)
    assert {name: found[name] for name in expected} == expected


def test_temperature_terms_are_per_degree():
    assert fleet_report._unit("scale_x_t1", "magnetometer", True, "nT") == ("nT/°C", 1.0)
    assert fleet_report._unit("gain_xy_t2", "magnetometer", True, "nT") == ("1/nT/°C²", 1.0)
    assert fleet_report._unit("gain_xy_t1", "magnetometer", True, "") == ("1/°C", 1.0)
    assert fleet_report._unit("scale_x", "magnetometer", False, "nT") == ("", 1.0)


def drawn(values, monkeypatch):
    """Ends of the axis and counted values of a panel."""
    edges = []
    original = np.histogram

    def histogram(series, bins):
        edges.append(bins)
        counts = original(series, bins)
        edges.append(counts[0].sum())
        return counts

    monkeypatch.setattr(fleet_report.np, "histogram", histogram)
    fleet_report.draw_quality([("", "", {"x": values})])
    return edges[0][0], edges[0][-1], edges[1]


def test_axes_leave_out_the_outliers_and_nothing_else(monkeypatch):
    values = np.random.default_rng(2).normal(0.0, 1.0, 39)
    values[5] = -9800.0
    low, high, counted = drawn(values, monkeypatch)
    others = np.delete(values, 5)
    assert low == pytest.approx(others.min(), abs=0.3)
    assert high == pytest.approx(others.max(), abs=0.3)
    assert counted == 38
    assert list(np.flatnonzero(fleet_report.distance(values) > fleet_report.FAR)) == [5]
    few = values[: fleet_report.FEWEST_TOOLS - 1]
    assert drawn(few, monkeypatch)[0] < -9800.0  # too few to call one of them an outlier


def test_the_axes_of_the_page_leave_out_what_its_table_of_outliers_lists(tmp_path, monkeypatch):
    seen = {}
    original = fleet_report._steps

    def steps(axes, series, abreast=3):
        original(axes, series, abreast)
        seen[axes.get_title("left")] = axes.get_xlim()

    runs = {f"T{i:02}": short_run(i) for i in range(24)}
    runs["T07"]["ax"] = runs["T07"]["ax"] + 3 * 0.4
    monkeypatch.setattr(fleet_report, "_steps", steps)
    _, page = said(tmp_path, runs, "--tool", "servo")
    assert re.search(r"<tr><td>T07</td><td class=\"text\">accelerometer offset x</td>", page)
    low, high = seen["accelerometer: offset"]
    assert -100 < low < high < 100  # mg
    assert "leave out what lies farther than 6 robust standard deviations" in page


def test_numbers_along_an_axis_do_not_run_into_each_other(monkeypatch):
    from matplotlib.figure import Figure

    panels = []
    original = Figure.savefig

    def savefig(self, *arguments, **options):
        original(self, *arguments, **options)
        for axes in self.axes:
            low, high = axes.get_xlim()
            shown = [t for t in axes.get_xticklabels() if low <= t.get_position()[0] <= high]
            panels.append([t.get_window_extent() for t in shown])

    monkeypatch.setattr(Figure, "savefig", savefig)
    values = np.linspace(-0.0051, 0.0057, 40)
    figure = fleet_report.draw_parameters(
        [
            fleet_report.FleetParameter(
                "magnetometer", "field = 1", name, "of the field", values, 0.0
            )
            for name in ("gain xx", "gain xy", "offset x")
        ]
    )
    pictures.svg(figure, "parameters")
    assert len(panels) == 3
    for boxes in panels:
        assert len(boxes) >= 2
        gap = boxes[0].height
        assert all(a.x1 + gap < b.x0 for a, b in pairwise(boxes))
