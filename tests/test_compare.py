"""Methods side by side: what each reaches where theory says so, refusals, advice, text, JSON, HTML."""

import json
import re
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser

import msgspec
import numpy as np
import pytest
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

from cli_support import mwdcal, refused, servo_run, write_csv
from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.methods import EVIDENCE
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.comparison import compare as module
from mwdcal.comparison.compare import SCATTER, Gauge, compare, in_gauge
from mwdcal.errors import InputError
from mwdcal.estimation.uncertainty import Free, unrotating
from mwdcal.geometry.vectors import group_scatter
from mwdcal.planning import plans
from mwdcal.presentation import comparison as command
from mwdcal.presentation.comparison import render
from mwdcal.sensor.profile import ColumnSource, Profile, TriadProfile
from simulation import Tool, attitude, plan
from test_calibrate import NOISE, PROFILE, make

EXAMPLE = "examples/servo/run.csv"
TURNS = ("rotation-x", "rotation-y", "toolface-zero")
EVERYTHING = Gauge(
    frozenset((name, (t,)) for t in (0, 1) for name in (*TURNS, "scale")),
)


@pytest.fixture(scope="module")
def whole():
    return compare(make(1), PROFILE)


@cache
def heated():
    stations = plans.grid([5.0, 45.0, 90.0, 135.0], 6, [0, 90, 200, 300], [25.0, 65.0, 105.0])
    tool = plans.servo(np.random.default_rng(5))
    made = plans.run(tool, stations, np.random.default_rng(6))
    sd = {"accelerometer": np.array(1e-4), "magnetometer": np.array(15.0)}
    return compare(replace(made, source="hot.csv", sd=sd), PROFILE)


def by_method(found):
    return {row.method: row for row in found.rows}


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


def test_what_rests_on_a_convention_is_named(whole):
    resting = {row.method: row.resting for row in whole.rows}
    assert resting["joint"] == resting["swarm"] == ()
    assert resting["newton"] == ("toolface",)
    assert resting["toolface-inclination"] == ("gravity",)
    assert resting["scalar"] == ("inclination", "toolface", "azimuth", "dip")


def test_left_out_errors_exceed_those_in_sample_and_equal_evidence_agrees(whole):
    rows = by_method(whole)
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


def test_small_runs_leave_each_station_out():
    readings = make(2, (20, 60, 120), 8)
    found = compare(readings, PROFILE)
    assert found.parts == readings.count == 24
    shown = {"gravity": 1e3, "field": 1.0}
    for index in (0, 11, 23):
        rest = np.arange(24) != index
        for method in ("joint", "newton"):
            made = calibrate(readings.select(rest), PROFILE, Options(method))
            g, b = (v[index] for v in made.fields(readings))
            errors = by_method(found)[method].station_errors
            for name, strength, expected in (("gravity", g, 1.0), ("field", b, 50_000.0)):
                error = (np.linalg.norm(strength) - expected) * shown[name]
                assert errors[name][index] == pytest.approx(error, rel=1e-6)


def moradi(error):
    mse = sum(e**2 for e in error) / len(error)
    mean = sum(error) / len(error)
    std = (sum((e - mean) ** 2 for e in error) / (len(error) - 1)) ** 0.5
    return pytest.approx((mean, std, mse, mse**0.5), rel=1e-9)


@pytest.mark.parametrize("method", ["joint", "newton", "scalar"])
def test_moradis_measures_are_those_of_the_corrected_vectors(whole, method):
    readings = make(1)
    ideal = attitude(*plan())(1.0, 50_000.0, np.radians(65.0))
    fields = calibrate(readings, PROFILE, Options(method)).fields(readings)
    nominal = (readings.accelerometer, readings.magnetometer)
    stated = [*whole.measures_before, *by_method(whole)[method].measures]
    for when, vectors in (("before", nominal), ("after", fields)):
        for name, vector, target in zip(
            ("accelerometer", "magnetometer"), vectors, ideal, strict=True
        ):
            one = next(m for m in stated if (m.triad, m.when) == (name, when))
            error = [
                np.hypot.reduce(v - t) / np.hypot.reduce(t)
                for v, t in zip(vector, target, strict=True)
            ]
            assert (one.mean, one.std, one.mse, one.rmse) == moradi(error)


def test_measures_of_the_joint_method_are_those_of_its_calibration(whole):
    own = calibrate(make(1), PROFILE).measures
    assert {(m.triad, m.when): m.rmse for m in own} == pytest.approx(
        {
            (m.triad, m.when): m.rmse
            for m in (*whole.measures_before, *whole.rows[0].measures)
            if m.when != "left out"
        },
        rel=1e-6,
    )


def test_all_methods_give_the_same_parameters_in_one_gauge_without_noise():
    tool = Tool.random(7, noise=(0.0, 0.0))
    sd = {"accelerometer": np.array(1e-6), "magnetometer": np.array(0.05)}
    found = compare(make(tool=tool, sd=sd), PROFILE)
    assert set(found.gauge["accelerometer"]) == {*TURNS, "scale"}
    first = found.rows[0]
    for row in found.rows:
        assert not row.refused
        for triad, size in (("accelerometer", 1.0), ("magnetometer", 50_000.0)):
            ours, theirs = row.parameters[triad].values, first.parameters[triad].values
            for name, one in (("SF", 1.0), ("B", size), ("m", 1.0)):
                np.testing.assert_allclose(ours[name], theirs[name], atol=1e-6 * one)
            assert np.isfinite(row.parameters[triad].uncertainty["SF"]).all()


def test_what_is_taken_out_is_the_rotation_and_the_stretch_is_left():
    tool = Tool.random(7, noise=(0.0, 0.0))
    sd = {"accelerometer": np.array(1e-6), "magnetometer": np.array(0.05)}
    made = calibrate(make(tool=tool, sd=sd), PROFILE)
    factors, taken = in_gauge(made, make(tool=tool, sd=sd), EVERYTHING)
    for index, triad in enumerate(("accelerometer", "magnetometer")):
        turn, stretch = polar(np.linalg.inv(tool.matrix[index]))
        angles = Rotation.from_matrix(turn).as_rotvec(degrees=True)
        np.testing.assert_allclose(taken[triad].values["rotation_deg"], angles, atol=1e-7)
        assert taken[triad].values["scale"][0] == pytest.approx(1, abs=1e-9)
        values = factors[triad].values
        np.testing.assert_allclose(values["SF"][:, 0], 1 / np.diag(stretch), rtol=1e-9)
        np.testing.assert_allclose(np.eye(3) - values["m"], stretch / np.diag(stretch), atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["joint", "scalar"])
def test_uncertainties_in_the_gauge_are_those_of_repeated_runs(method):
    found, stated = [], []
    for seed in range(24):
        readings = make(seed, (10, 60, 120), 8)
        factors, _ = in_gauge(calibrate(readings, PROFILE, Options(method)), readings, EVERYTHING)
        own = factors["magnetometer"]
        found.append(np.concatenate([own.values[n].ravel() for n in ("SF", "B")]))
        stated.append(np.concatenate([own.uncertainty[n].ravel() for n in ("SF", "B")]))
    ratio = np.var(found, axis=0, ddof=1) / np.mean(np.square(stated), axis=0)
    assert 0.7 < ratio.mean() < 1.4


def test_undetermined_is_said_of_what_a_method_leaves_free(whole):
    rows = by_method(whole)
    turned = {m: row.taken_out["accelerometer"].uncertainty for m, row in rows.items()}
    assert np.isfinite(turned["joint"]["rotation_deg"]).all()
    assert list(np.isnan(turned["newton"]["rotation_deg"])) == [False, False, True]
    assert np.isnan(turned["scalar"]["rotation_deg"]).all()
    assert np.isnan(turned["toolface-inclination"]["scale"]).all()


def test_a_turn_of_both_triads_together_is_taken_out_together():
    readings = make(3)
    made = calibrate(readings, PROFILE)
    common = Gauge.of(
        [Free("toolface-zero", (0, 1), np.zeros(24)), Free("weak-gain-xx", (0,), np.zeros(24))]
    )
    assert common.names(0) == common.names(1) == ["toolface-zero"]
    _, taken = in_gauge(made, readings, common)
    turns = [item.values["rotation_deg"] for item in taken.values()]
    np.testing.assert_allclose(turns[0], turns[1])
    np.testing.assert_allclose(turns[0][:2], 0)
    assert abs(turns[0][2]) > 1e-3


@pytest.mark.parametrize("reflected", [False, True])
def test_a_gain_is_turned_back_by_a_rotation_even_where_it_reflects(reflected):
    turn = Rotation.from_euler("zyx", [0.3, -0.2, 0.1]).as_matrix()
    stretch = np.diag([1.1, 0.9, -0.02 if reflected else 1.0])
    back = unrotating(turn @ stretch, np.ones(3, bool))
    assert np.linalg.det(back) == pytest.approx(1.0)
    np.testing.assert_allclose(back @ turn, np.eye(3), atol=1e-12)


def test_scatter_is_that_of_groups_of_two_stations_or_more():
    axis = np.array([[0.0, 0, 1], [0.02, 0, 1], [0, 0.5, 1], [9, 9, 9], [np.nan] * 3])
    assert group_scatter(axis, np.array([3, 3, 5, -1, 3])) == pytest.approx(0.02 / np.sqrt(2))
    assert np.isnan(group_scatter(axis, np.array([0, 1, 2, -1, 0])))


def test_own_axis_terms_leave_the_tangent():
    readings = make(1)
    raw = readings.accelerometer
    readings = replace(readings, accelerometer=raw - 2e-3 * raw**2 - 1e-3 * raw**3)
    made = calibrate(readings, PROFILE, Options(nonlinearity={"accelerometer": 0.005}))
    assert made.accelerometer.curved
    factors, _ = in_gauge(made, readings, Gauge(frozenset()))
    centre, step = np.array(made.accelerometer.centre), 1e-4
    near = Readings(
        np.concatenate([[centre], centre + step * np.eye(3), centre - step * np.eye(3)])
    )
    at = made.fields(near)[0]
    slope = (at[1:4] - at[4:]).T / (2 * step)
    gain = np.diag(slope)
    values = factors["accelerometer"].values
    np.testing.assert_allclose(values["SF"][:, 0], 1 / gain, rtol=1e-6)
    np.testing.assert_allclose(np.eye(3) - values["m"], slope / gain, atol=1e-6)
    bias = np.linalg.solve(slope / gain, slope @ centre - at[0])
    np.testing.assert_allclose(values["B"][:, 0], bias, atol=1e-6)


def test_order_is_chosen_and_shown_and_the_swarm_says_why_it_cannot():
    found = heated()
    assert min(found.orders) >= 1
    rows = by_method(found)
    assert [m for m, row in rows.items() if row.refused] == ["swarm"]
    assert "one temperature" in rows["swarm"].refused
    assert rows["joint"].parameters["accelerometer"].values["SF"].shape == (3, found.orders[0] + 1)
    text = command.text(found, parameters=True)
    assert f"temperature order {found.orders[0]}" in text
    assert "SF x·τ, raw/g/°C" in text
    assert "swarm refused: " in text
    assert "SIMULATED DATA" in text


def test_scales_are_in_the_unit_of_the_channels_where_the_profile_names_it(whole):
    text, meaning = command.text(whole, parameters=True), "raw: the unit of the readings in the run"
    assert text.count("SF x, raw/") == 2
    assert text.count(meaning) == 1
    units = {"a": "mV", "m": "V"}
    columns = {
        f"{k}{i}": ColumnSource(name=f"{k} {i}", unit=units[k]) for k in units for i in "xyz"
    }
    named = replace(whole, profile=msgspec.structs.replace(whole.profile, columns=columns))
    text = command.text(named, parameters=True)
    assert {"SF x, mV/g", "SF x, V/nT"} <= {line.split("  ")[0] for line in text.splitlines()}
    assert meaning not in text


def test_methods_that_do_not_apply_say_why():
    found = compare(make(1, unknown=("toolface",)), PROFILE)
    refusals = {row.method: row.refused for row in found.rows if row.refused}
    assert set(refusals) == {"least-squares", "swarm", "toolface-inclination"}
    assert all("ref_toolface_deg" in reason for reason in refusals.values())


def test_methods_that_cannot_carry_what_the_run_shows_say_so_and_leave_the_others_alone():
    readings = make(1)
    raw = readings.accelerometer
    bent = replace(readings, accelerometer=raw - 2e-2 * raw**2 - 1e-2 * raw**3)
    profile = Profile(name="bent tool", accelerometer=TriadProfile(nonlinearity=0.01))
    comparison = compare(bent, profile)
    assert comparison.curved == ("accelerometer",)
    refusals = {row.method: row.refused for row in comparison.rows if row.refused}
    assert set(refusals) == {"newton", "swarm"}
    assert all("own-axis terms need their prior" in reason for reason in refusals.values())
    assert comparison.advice.startswith("use joint")


def test_what_no_method_can_do_is_an_error_of_the_call():
    """Temperatures that are missing are missing for all."""
    with pytest.raises(InputError, match="temperature_c"):
        compare(make(1), PROFILE, Options(order=1))


def test_options_that_one_method_cannot_have_are_its_own_refusal():
    comparison = compare(make(1), PROFILE, Options(order=0, robust="huber"))
    refusals = {row.method for row in comparison.rows if row.refused}
    assert refusals == {"newton", "swarm"}


def test_a_run_that_nothing_can_calibrate():
    found = compare(make(1).select(np.arange(48) < 3), PROFILE)
    assert all(row.refused for row in found.rows)
    assert "no method" in found.advice
    page = render(found)
    assert all(row.refused.split("'")[0] in page for row in found.rows)
    assert "before" not in command.text(found)
    assert command.text(found).count("refused: ") == page.count("refused:</b>") == 1
    assert "every method refused: " in command.text(found)


@pytest.mark.usefixtures("without_pictures")
def test_a_failing_part_is_counted_and_its_method_not_preferred(monkeypatch):
    original = module.fit

    def failing(readings, options=None, include=None):
        result = original(readings, options, include)
        if include is not None and options.method in ("joint", "least-squares"):
            result.status[2] = 1
        return result

    monkeypatch.setattr(module, "fit", failing)
    readings = replace(make(1), group=np.repeat(np.arange(4), 12))
    found = compare(readings, PROFILE)
    rows = by_method(found)
    assert rows["joint"].lost == 6
    assert rows["swarm"].lost == 0
    assert np.isnan(rows["joint"].station_errors["gravity"]).sum() == 6
    assert np.isfinite(list(rows["joint"].held_out.values())).all()
    assert SCATTER in rows["joint"].held_out
    assert "use swarm" in found.advice
    assert "stations no fit could judge" in command.text(found)
    assert "stations no fit could judge" in render(found)


class Page(HTMLParser):
    """Tags balanced, and all that could point outside."""

    VOID = ("meta", "br", "use", "path")

    def __init__(self):
        super().__init__()
        self.open, self.links, self.ids = [], [], []

    def handle_starttag(self, tag, attributes):
        if tag not in self.VOID:
            self.open.append(tag)
        self.ids += [v for k, v in attributes if k == "id"]
        self.links += [v for k, v in attributes if k in ("src", "href", "xlink:href")]

    def handle_startendtag(self, tag, attributes):
        self.ids += [v for k, v in attributes if k == "id"]
        self.links += [v for k, v in attributes if k in ("src", "href", "xlink:href")]

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self.open.pop() == tag


@pytest.mark.usefixtures("without_layout")
def test_the_page_is_whole_and_needs_nothing_else(whole):
    page = render(whole, "<tool>", "ab" * 32)
    parsed = Page()
    parsed.feed(page)
    assert parsed.open == []
    assert all(link.startswith("#") for link in parsed.links)
    assert not re.search(r"https?:|@import|<script[^>]|url\((?!#)", page)
    assert len(parsed.ids) == len(set(parsed.ids))
    assert all(f"<th>{method}</th>" in page for method in EVIDENCE)
    assert page.count("<figure>") == 4
    assert page.index("Use joint") < page.index("<svg")
    assert "&lt;tool&gt;" in page
    assert "ab" * 32 in page
    assert "SIMULATED" not in page
    assert page == render(whole, "<tool>", "ab" * 32)


@pytest.mark.usefixtures("without_pictures")
def test_the_page_says_what_is_simulated_and_what_is_refused():
    page = render(heated())
    assert "SIMULATED DATA" in page
    assert "<b>swarm refused:</b>" in page
    assert "SF x·τ" in page
    assert page.count("<figure>") == 3


def worse(comparison, method, factor):
    """The same with errors of one method this many times as large."""

    def times(values):
        return {name: value * factor for name, value in values.items()}

    rows = tuple(
        replace(
            row,
            in_sample=times(row.in_sample),
            held_out=times(row.held_out),
            station_errors=times(row.station_errors),
        )
        if row.method == method
        else row
        for row in comparison.rows
    )
    return replace(comparison, rows=rows, advice=module.advice(rows))


def texts(figure):
    """What stands in a figure, with its place in pixels and size."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return {
        text: text.get_window_extent(canvas.get_renderer())
        for axes in figure.axes
        for text in axes.texts
    }


def separate(figure):
    """Texts of the figure that overlap another one or the edge of the page, or are small."""
    places = list(texts(figure).items())
    boxes = [box for _, box in places]
    return [
        text.get_text()
        for i, (text, box) in enumerate(places)
        if text.get_fontsize() < 6.5
        or not -1 < box.x0 < box.x1 < figure.bbox.width + 1
        or any(box.overlaps(other) for j, other in enumerate(boxes) if j != i)
    ]


@pytest.mark.parametrize("method", ["joint", "scalar"])
def test_a_method_far_worse_flattens_no_other(whole, method):
    figures = pytest.importorskip("mwdcal.presentation.comparison")
    bad = worse(whole, method, 100)
    index = [row.method for row in whole.rows].index(method)
    others = [i for i in range(6) if i != index]
    figure = figures.draw_stations(bad)
    panels = np.reshape(figure.axes, (6, 6))
    for line, name in zip(panels, whole.units, strict=True):
        reach = [np.nanmax(np.abs(row.station_errors[name])) for row in bad.rows]
        edges = [min(np.abs(axes.get_ylim())) for axes in line]
        assert all(edge >= each for edge, each in zip(edges, reach, strict=True))  # nothing cut
        # of every method's panel at least a fifth is used, whatever another needs
        assert all(edge <= 5 * each for edge, each in zip(edges, reach, strict=True))
        (said,) = (text.get_text() for text in line[index].texts)
        value = float(re.match(r"to ([\d.]+)", said)[1])
        assert value == pytest.approx(reach[index], rel=0.01)
        assert said.endswith(whole.units[name].partition(" ")[0])
        labelled = [axes for axes in line if axes.yaxis.get_tick_params()["labelleft"]]
        assert len(labelled) == 1
        assert not labelled[0].texts
        assert len({line[i].get_ylim() for i in others if not line[i].texts}) == 1
    assert separate(figure) == []


@pytest.mark.parametrize("method", ["joint", "scalar"])
def test_ratios_beyond_the_axis_have_their_value_at_its_edge(whole, method):
    figures = pytest.importorskip("mwdcal.presentation.comparison")
    bad = worse(whole, method, 100)
    figure = figures.draw_errors(bad)
    (axes,) = figure.axes
    low, high = axes.get_xlim()
    assert high <= 12
    expected = []
    for name in whole.units:
        best = min(row.held_out[name] for row in bad.rows)
        each = {row.method: row.held_out[name] / best for row in bad.rows}
        expected += [(who, ratio) for who, ratio in each.items() if ratio > 10]
    said = [re.match(r"(\S+): ([\d.]+)", text.get_text()).groups() for text in axes.texts]
    assert sorted(who for who, _ in said) == sorted(who for who, _ in expected)
    values = sorted(float(value) for _, value in said)
    np.testing.assert_allclose(values, sorted(ratio for _, ratio in expected), rtol=0.01)
    assert len(said) >= 6
    for line in (line for line in axes.lines if line.get_marker() != "None"):
        drawn = np.asarray(line.get_xdata(), float)
        assert np.all((drawn[~np.isnan(drawn)] > low) & (drawn[~np.isnan(drawn)] < high))
    assert separate(figure) == []


@pytest.mark.usefixtures("without_layout")
def test_parameters_beyond_the_axis_have_an_arrow_and_the_largest_its_value(whole):
    figures = pytest.importorskip("mwdcal.presentation.comparison")
    rows = list(whole.rows)
    first, last = rows[0].parameters["accelerometer"], rows[-1].parameters["accelerometer"]
    values = {name: value.copy() for name, value in last.values.items()}
    values["B"][1, 0] = first.values["B"][1, 0] - 345 * first.uncertainty["B"][1, 0]
    changed = {**rows[-1].parameters, "accelerometer": replace(last, values=values)}
    rows[-1] = replace(rows[-1], parameters=changed)
    figure = figures.draw_parameters(replace(whole, rows=tuple(rows)))
    top = figure.axes[0]
    assert max(np.abs(top.get_ylim())) <= 15
    assert [text.get_text() for text in top.texts] == ["−345"]
    place = [label.get_text() for label in top.get_xticklabels()].index("B y")
    assert abs(top.texts[0].xy[0] - place) < 0.5
    assert separate(figure) == []


@pytest.mark.usefixtures("without_pictures")
def test_the_page_has_serial_and_dates_as_text(whole):
    stated = {"serial": "<b>S</b>", "date": "2026-03-04"}
    page = render(whole, metadata=stated, time="2026-11-22 17:00 UTC")
    assert "&lt;b&gt;S&lt;/b&gt;" in page
    assert "<b>S</b>" not in page
    assert "measured 2026-03-04" in page
    assert "2026-11-22 17:00 UTC" in page
    assert not re.search(r"measured \d", render(whole))


@pytest.mark.usefixtures("without_pictures")
def test_a_relative_field_has_no_nanotesla_on_the_page():
    found = compare(make(1, unknown=("field",)), PROFILE)
    page = render(found)
    assert not re.search(r"\bnT\b", re.sub(r"<svg.*?</svg>", "", page, flags=re.DOTALL))
    assert page.index("banner good") < page.index("<svg")


def test_long_runs_show_the_worst_of_each_part():
    from mwdcal.presentation.comparison import MOST_STATIONS, _largest

    values = np.sin(np.arange(1000) ** 2) * 1e-3
    values[737] = 9.0
    values[:20] = np.nan
    where, shown = _largest(values)
    assert len(shown) <= MOST_STATIONS
    assert shown[np.flatnonzero(where == 738)] == 9.0


@pytest.mark.parametrize(
    ("pair", "text"),
    [
        (("2.93051", "0.00010"), "2.93051(10)"),
        (("−304.7", "2.9"), "−304.7(29)"),
        (("48010", "120"), "48010(120)"),
        (("5.06292×10⁻⁵", "0.00056×10⁻⁵"), "5.06292(56)×10⁻⁵"),
        (("1", "0"), "1(0)"),
        (("0.5", "undetermined"), "undetermined"),
    ],
)
def test_uncertainty_in_parentheses(pair, text):
    assert command._joined(*pair) == text


@pytest.mark.usefixtures("without_pictures", "computed_once")
def test_command_prints_the_same_as_its_json(tmp_path):
    report = tmp_path / "methods.html"
    screen = mwdcal("compare", EXAMPLE, "--tool", "servo", "--report", report)
    ran = mwdcal("compare", EXAMPLE, "--tool", "servo", "--json")
    document = json.loads(ran.out)
    assert screen.code == 0
    assert document["advice"] in screen.out
    assert [row["method"] for row in document["rows"]][:2] == ["joint", "least-squares"]
    assert set(document["units"]) == set(document["rows"][0]["held_out"])
    assert document["orders"] == [0, 0]
    assert document["simulated"] is True
    assert len(document["rows"][0]["parameters"]["accelerometer"]["values"]["SF"]) == 3
    newton = next(row for row in document["rows"] if row["method"] == "newton")
    assert newton["taken_out"]["accelerometer"]["uncertainty"]["rotation_deg"][2] is None
    assert all(f"{method}: fit" in ran.err for method in EVIDENCE)
    assert "RMSE left out" in screen.out
    assert "SF x" not in screen.out
    assert "SIMULATED DATA" in report.read_text("utf-8")


def test_seed_and_parameters(tmp_path):
    run = write_csv(tmp_path / "run.csv", servo_run(3, (20, 70, 120), 8))
    ran = mwdcal("compare", run, "--tool", "servo", "--parameters", "--seed", 5)
    assert ran.code == 0
    assert "each station left out in turn" in ran.out
    assert "toolface-zero, °" in ran.out
    assert "…" not in ran.out.split("Factors of the raw channels")[1]


def test_what_cannot_be_done_is_refused_at_once(tmp_path):
    columns = servo_run(3)
    run = write_csv(tmp_path / "run.csv", columns)
    bare = write_csv(
        tmp_path / "cold.csv", {n: v for n, v in columns.items() if n != "temperature_c"}
    )
    assert "temperature_c" in refused(mwdcal("compare", bare, "--tool", "servo", "--order", 1), 2)
    assert mwdcal("compare", run, "--tool", "servo", "--order", 4).code == 2
    lost = mwdcal("compare", run, "--tool", "servo", "--report", run)
    assert "lost" in refused(lost, 2)
    refused(mwdcal("compare", tmp_path / "none.csv"), 2)


def test_where_every_method_is_refused_the_command_fails_and_says_why(tmp_path):
    few = {name: column[:3] for name, column in servo_run(3).items()}
    run, page = write_csv(tmp_path / "run.csv", few), tmp_path / "methods.html"
    for options in ((), ("--json",), ("--report", page)):
        ran = mwdcal("compare", run, "--tool", "servo", *options)
        assert ran.code == 3
        assert "no method can calibrate this run" in ran.out
        assert "needs 4 or more" in ran.out
    assert page.exists()


def near_vertical(inclinations, blank=()):
    """A run with stations near vertical, of which some references may be blank."""
    tool = Tool.random(7)
    inc, azi, face = plan(inclinations, 12)
    a, m = tool.readings(np.random.default_rng(11), 1, inc, azi, face)
    stated = np.where(np.isin(np.arange(len(inc)), blank), np.nan, inc)
    known = {
        "inclination": stated, "azimuth": azi, "toolface": face,
        "field": np.full(len(inc), tool.field), "dip": np.full(len(inc), tool.dip),
    }  # fmt: skip
    return Readings(a[0], m[0], known=known, sd=NOISE), (inc, azi, face)


@pytest.mark.parametrize("blank", [(), (0, 5, 14)], ids=["all known", "some blank"])
def test_errors_near_vertical_are_those_that_calibrate_states(blank):
    """Weighted by sin(I) of the reference, not of the reading: 0.02° is a third of the noise there."""
    data, (inc, _, face) = near_vertical((0.02, 45, 90, 135), blank)
    made = calibrate(data, PROFILE, Options(order=0))
    found = module.errors(data, *made.fields(data))
    stated = {row.observable: row.after for row in made.errors}
    for name in ("toolface", "azimuth", "inclination"):
        rms = np.degrees(np.sqrt(np.nanmean(found[name] ** 2)))
        # a record has 12 digits of each parameter: 1e-10° of a vector, by which the fit itself differs by 1e-12
        assert rms == pytest.approx(stated[name], rel=1e-9, abs=1e-10), name
    g, _ = made.fields(data)
    own = np.arctan2(np.hypot(g[:, 0], g[:, 1]), g[:, 2])
    across = np.sin(np.where(np.isnan(data.known["inclination"]), own, inc))
    turned = np.arctan2(-g[:, 0], -g[:, 1]) - face
    assert found["toolface"] == pytest.approx(np.angle(np.exp(1j * turned)) * across, abs=1e-12)


@pytest.mark.parametrize("vertical", [0.0, 180.0])
def test_exactly_vertical_references_have_no_error_of_azimuth_and_toolface(vertical):
    """They are left out, not counted as zeros, which would make the others look better."""
    data, (inc, _, face) = near_vertical((vertical, 45, 90, 135))
    made = calibrate(data, PROFILE, Options(order=0))
    rows = {row.observable: row for row in made.errors}
    assert rows["inclination"].stations == 48
    assert rows["toolface"].stations == rows["azimuth"].stations == 36
    g, _ = made.fields(data)
    tilted = np.arange(48) >= 12
    turned = np.angle(np.exp(1j * (np.arctan2(-g[:, 0], -g[:, 1]) - face))) * np.sin(inc)
    rms = np.degrees(np.sqrt(np.mean(turned[tilted] ** 2)))
    assert rows["toolface"].after == pytest.approx(rms, rel=1e-9)
    found = module.errors(data, *made.fields(data))
    assert (np.isnan(found["toolface"]) == ~tilted).all()
    assert "toolface" not in made.station_rows[0].errors
    assert "inclination" in made.station_rows[0].errors


def test_a_channel_of_no_noise_ends_in_refusals(tmp_path):
    """Information of one channel so far above all other that rounding makes their squares negative."""
    columns = servo_run(2, (10, 60, 110), 6, (25.0, 75.0, 130.0))
    run = write_csv(tmp_path / "run.csv", {**columns, "sd_mx": np.full(54, 1e-11)})
    ran = mwdcal("compare", run, "--tool", "servo")
    assert ran.code == 3
    assert "newton refused" in ran.out
