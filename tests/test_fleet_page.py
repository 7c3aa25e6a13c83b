"""The summary page of a fleet: units of its parameters, and axes that show the fleet, not its outliers."""

import html
import re
from itertools import pairwise

import numpy as np
import pytest

from test_fleet import short_run
from test_fleet_findings import said

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

from mwdcal.presentation import (  # noqa: E402
    fleet_figures,
    page,
)


def cells(row):
    """Text of the cells of a row of a table."""
    return [html.unescape(re.sub("<.*?>", "", cell)) for cell in re.findall("<td.*?</td>", row)]


def table_of(page, section):
    """Rows of the first table of a section, as text."""
    part = page.partition(f'<section id="{section}">')[2].partition("</table>")[0]
    return [cells(row) for row in re.findall("<tr>(<td.*?)</tr>", part, re.S)]


def worst_tools(page):
    """Rows of the table of the worst tools by serial, in its order."""
    return {row[0].removeprefix("▲ "): row for row in table_of(page, "worst")}


def unknown(seed):
    """A run whose stand knows no field."""
    return short_run(seed, ref_field_nt=np.full(28, np.nan))


def units(page):
    """Unit of each magnetometer parameter at a field of one, as the page has it."""
    rows = re.findall(r"<tr><td>magnetometer, field = 1</td>.*?</tr>", page)
    cells = [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in rows]
    return {row[1]: row[-1] for row in cells}


@pytest.mark.usefixtures("without_layout")
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
    assert fleet_figures._unit("scale_x_t1", "magnetometer", True, "nT") == ("nT/°C", 1.0)
    assert fleet_figures._unit("gain_xy_t2", "magnetometer", True, "nT") == ("1/nT/°C²", 1.0)
    assert fleet_figures._unit("gain_xy_t1", "magnetometer", True, "") == ("1/°C", 1.0)
    assert fleet_figures._unit("scale_x", "magnetometer", False, "nT") == ("", 1.0)


def parameter(values, name="gain xx"):
    return fleet_figures.FleetParameter("accelerometer", "", name, "", values, 0 * values)


def marks(axes):
    """Values of the marks of each strip of a panel, without those of its medians."""
    strips = {}
    for patch in axes.patches:
        ends = patch.get_path().vertices.reshape(-1, 2, 2)
        heights = ends[:, 1, 1] - ends[:, 0, 1]
        if heights.max(initial=0) < 0.95:
            for x, y in zip(ends[:, 0, 0], ends.mean(1)[:, 1], strict=True):
                strips.setdefault(round(y), []).append(x)
    return [np.sort(strips[row]) for row in sorted(strips)]


def test_axes_leave_out_the_outliers_and_count_them():
    values = np.random.default_rng(2).normal(0.0, 1.0, 39)
    values[5] = -9800.0
    [axes] = fleet_figures.draw_parameters([parameter(values)]).axes
    low, high = axes.get_xlim()
    others = np.delete(values, 5)
    assert others.min() - 1.0 < low < others.min()
    assert others.max() < high < others.max() + 0.3
    assert "◂ 1" in [text.get_text() for text in axes.texts]
    assert not any("▸" in text.get_text() for text in axes.texts)
    assert list(np.flatnonzero(fleet_figures.distance(values) > fleet_figures.FAR)) == [5]
    few = values[: fleet_figures.FEWEST_TOOLS - 1]
    [axes] = fleet_figures.draw_parameters([parameter(few)]).axes
    assert axes.get_xlim()[0] < -9800.0  # too few to call one of them an outlier
    assert not axes.texts


@pytest.mark.parametrize("count", [1, 2, 30, 200, fleet_figures.MARKS])
def test_a_strip_has_one_mark_for_each_tool(count):
    rng = np.random.default_rng(count)
    series = [rng.normal(1.0, 0.01, count) for _ in range(3)]
    series[1][0] = np.nan if count > 1 else 1.0
    names = ("gain xx", "gain yy", "gain zz")
    figure = fleet_figures.draw_parameters(list(map(parameter, series, names)))
    for shown, values in zip(marks(figure.axes[0]), series, strict=True):
        np.testing.assert_array_equal(shown, np.sort(values[~np.isnan(values)]))
    drawn = str(page.svg(figure, "x"))
    paths = re.findall(r' d="((?:M [-\d.]+ [-\d.]+ ?L [-\d.]+ [-\d.]+ ?)+)"', drawn)
    assert max(path.count("M") for path in paths) >= count  # nothing lost on the way


def test_marks_of_very_many_tools_stand_for_equal_groups_and_the_ends():
    values = np.random.default_rng(3).lognormal(-4.0, 0.5, 100_000)
    panel = fleet_figures.Strips("", "1σ, °", {"azimuth": values}, "°", positive=True)
    doubtful = np.zeros(len(values), bool)
    figure = fleet_figures.draw_quality([panel], np.arange(len(values)), doubtful)
    [shown] = marks(figure.axes[0])
    ordered = np.sort(values)
    ends = fleet_figures.ENDS
    assert len(shown) <= fleet_figures.GROUPS + 2 * ends
    np.testing.assert_array_equal(shown[:ends], ordered[:ends])
    np.testing.assert_array_equal(shown[-ends:], ordered[-ends:])
    places = np.searchsorted(ordered, shown[ends:-ends])
    assert np.ptp(np.diff(places)[1:-1]) <= 1
    worst = f"worst {values.max():.3f}°\n{values.argmax()}"
    assert worst in [text.get_text() for text in figure.axes[0].texts]


def test_the_axes_of_the_page_leave_out_what_it_names_as_an_outlier(tmp_path, monkeypatch):
    seen = {}
    original = fleet_figures._draw

    def draw(axes, panel, doubtful=None):
        original(axes, panel, doubtful)
        seen[axes.get_title("left")] = axes.get_xlim()

    runs = {f"T{i:02}": short_run(i) for i in range(24)}
    runs["T07"]["ax"] = runs["T07"]["ax"] + 3 * 0.4
    monkeypatch.setattr(fleet_figures, "_draw", draw)
    _, page = said(tmp_path, runs, "--tool", "servo")
    row = worst_tools(page)["T07"]
    value = re.match(r"Accelerometer offset x is −(.*?) mg, the fleet's median", row[-1])[1]
    assert float(value) == pytest.approx(
        400, abs=0.05 * 400 + 10 * 1.05
    )  # gain and offset of tools
    assert "1 tool has a parameter farther than 6 robust" in page
    assert "from the fleet's median (T07). An outlier is not a fault" in page
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
    figure = fleet_figures.draw_parameters(
        [
            fleet_figures.FleetParameter(
                "magnetometer", "field = 1", name, "of the field", values, 0.0
            )
            for name in ("gain xx", "gain xy", "offset x")
        ]
    )
    page.svg(figure, "parameters")
    assert len(panels) == 3
    for boxes in panels:
        assert len(boxes) >= 2
        gap = boxes[0].height
        assert all(a.x1 + gap < b.x0 for a, b in pairwise(boxes))
