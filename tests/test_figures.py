"""What the figures of report and verdict draw, against second formulas; and what they say instead."""

from __future__ import annotations

import io
from dataclasses import replace
from functools import cache, partial

import msgspec
import numpy as np
import pytest

from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.options import Options
from mwdcal.calibration.results import readings_at
from mwdcal.errors import InputError
from mwdcal.planning import plans
from mwdcal.presentation.calibration_page import render
from mwdcal.sensor.profile import Profile, TriadProfile
from mwdcal.use.verification import Bounds, Limits, verify
from simulation import DEG
from test_report import SERVO, Page, calibrated, heated, run

TOOL = plans.servo(np.random.default_rng(5))
LIMITS = Limits(
    name="all",
    spread=Bounds(inclination_deg=0.1, azimuth_deg=1.0, gravity_g=0.003, toolface_deg=0.1),
    error=Bounds(inclination_deg=0.25, azimuth_deg=2.0, toolface_deg=0.2, field_nt=300.0),
)
SETS = plans.grid([10.0, 45.0, 70.0, 90.0, 120.0], 8, [60.0, 120.0, 200.0, 300.0, 20.0], [25.0])
ONE = plans.grid([45.0], 12, [60.0], [25.0])


def readings(plan, seed, *, knock=0.0, drop=()):
    clean = plans.run(TOOL, plan, np.random.default_rng(seed))
    known = {name: value for name, value in clean.known.items() if name not in drop}
    moved = clean.accelerometer + np.array([knock, 0.0, 0.0])
    return replace(clean, accelerometer=moved, known=known, source="roll.csv")


@cache
def sound(*drop):
    plan = plans.grid([5.0, 45.0, 90.0, 135.0], 12, [0.0, 90.0, 180.0, 270.0], [25.0])
    return calibrate(readings(plan, 1, drop=drop), SERVO)


@cache
def verdict(plan="sets", knock=0.0):
    return verify(sound(), readings({"sets": SETS, "one": ONE}[plan], 3, knock=knock), LIMITS)


def curves(axes):
    """Curves of a panel by label: x and y."""
    return {line.get_label(): line.get_data() for line in axes.lines if line.get_label()[0] != "_"}


def texts(figure):
    return " ".join(text.get_text() for axes in figure.axes for text in axes.texts)


def angle(name, calibration, raw):
    """An angle (n,) of raw readings by its printed formula."""
    g, b = calibration.fields(raw)
    if name == "inclination":
        return np.arctan2(np.hypot(g[:, 0], g[:, 1]), g[:, 2])
    if name == "toolface":
        return np.arctan2(-g[:, 0], -g[:, 1])
    size = np.linalg.norm(g, axis=-1)
    across = size * (g[:, 0] * b[:, 1] - g[:, 1] * b[:, 0])
    along = b[:, 2] * (g[:, 0] ** 2 + g[:, 1] ** 2) - g[:, 2] * (g[:, :2] * b[:, :2]).sum(-1)
    return np.arctan2(across, along)


def with_parameters(calibration, values):
    split = len(calibration.accelerometer.parameters)
    parts = zip(calibration.triads, (values[:split], values[split:]), strict=True)
    return msgspec.structs.replace(
        calibration,
        **{t.name: msgspec.structs.replace(t, parameters=part.tolist()) for t, part in parts},
    )


def slopes(function, x):
    """Central differences of a function of x, one column for each."""
    steps = np.diag(1e-4 * np.maximum(np.abs(x), 1e-2))
    return np.stack([(function(x + h) - function(x - h)) / (2 * h.sum()) for h in steps], -1)


def propagated(calibration, name, inclination, noise, temperature=None):
    """1σ (12 azimuths, 12 toolfaces) of an angle, by differences in parameters and in readings."""
    turn = np.arange(12) * 30 * DEG
    azimuth, toolface = (v.ravel() for v in np.meshgrid(turn, turn, indexing="ij"))
    raw = readings_at(calibration, inclination * DEG, azimuth, toolface, temperature)

    def difference(here, there):
        return np.angle(np.exp(1j * (here - there)))

    middle = angle(name, calibration, raw)
    by_parameter = slopes(
        lambda p: difference(angle(name, with_parameters(calibration, p), raw), middle),
        calibration.parameters,
    )
    variance = np.sum((by_parameter @ calibration.parameter_covariance) * by_parameter, -1)
    for triad in calibration.triads if noise else ():
        for channel in np.eye(3):
            step = 1e-5 * (50_000.0 if triad.name == "magnetometer" else 1.0)
            ends = [
                angle(name, calibration, replace(raw, **{triad.name: getattr(raw, triad.name) + h}))
                for h in (step * channel, -step * channel)
            ]
            variance += (difference(*ends) / (2 * step) * triad.noise) ** 2
    return np.degrees(np.sqrt(variance)).reshape(12, 12)


@pytest.mark.parametrize("noise", [False, True])
@pytest.mark.parametrize("at", [2.0, 46.0, 90.0, 134.0])
def test_curves_over_inclination_are_the_propagated_covariance(at, noise):
    figure = sound().plot.accuracy()
    drawn, band = curves(figure.axes[int(noise)]), figure.axes[int(noise)].collections[-1]
    for name, (x, y) in drawn.items():
        sd = propagated(sound(), name, at, noise)
        assert y[np.argmin(abs(x - at))] == pytest.approx(np.sqrt(np.mean(sd**2)), rel=1e-4)
    assert set(drawn) == {"inclination", "toolface", "azimuth"}
    edge = band.get_paths()[0].vertices
    heights = edge[np.isclose(edge[:, 0], at), 1]
    over_toolface = np.sqrt(np.mean(propagated(sound(), "azimuth", at, noise) ** 2, -1))
    np.testing.assert_allclose(
        [heights.min(), heights.max()], [over_toolface.min(), over_toolface.max()], rtol=1e-4
    )


@pytest.mark.parametrize("noise", [False, True])
@pytest.mark.parametrize("model", [None, "polynomial"])
def test_curves_over_temperature_are_the_propagated_covariance(model, noise):
    calibration = heated(model)
    drawn = curves(calibration.plot.accuracy_over_temperature().axes[int(noise)])
    for name, (x, y) in drawn.items():
        for index in (0, 20):
            sd = propagated(calibration, name, 45.0, noise, x[index])
            assert y[index] == pytest.approx(np.sqrt(np.mean(sd**2)), rel=1e-4)


def scale_and_bias(triad, nominal, reference, temperature, values):
    """Reading per field along its axis, and reading at zero field, of three channels along x, y, z.

    By readings of the model, written here: u = x / SF - B, field = (1 - m) u, or field = A x + c.
    """
    powers = (temperature - reference) ** np.arange(triad.order + 1)
    if triad.model == "factors":
        count = 3 * (triad.order + 1)
        scale, bias = (values[k * count : (k + 1) * count].reshape(3, -1) @ powers for k in (0, 1))
        mixing = np.eye(3)
        off = values[2 * count :]
        places = [(0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)]
        for (i, j), value in zip(places, off, strict=True):
            mixing[i, j] -= value
        slope = np.diag(scale) @ np.linalg.inv(mixing)
        return np.diagonal(slope) * nominal, scale * bias * nominal
    course = values.reshape(triad.order + 1, 12)
    matrix = np.tensordot(powers, course[:, :9], 1).reshape(3, 3)
    inverse = np.linalg.inv(matrix)
    return np.diagonal(inverse) * nominal, -inverse @ (powers @ course[:, 9:]) * nominal


@pytest.mark.parametrize("model", ["factors", "polynomial"])
def test_scale_and_bias_over_temperature(model):
    """Changes from 30 °C and 1σ of both, by the formulas of the model and differences of them."""
    calibration = heated(model)
    figure = calibration.plot.temperature()
    split = len(calibration.accelerometer.parameters)
    halves = (slice(split), slice(split, None))
    for column, (triad, half) in enumerate(zip(calibration.triads, halves, strict=True)):
        nominal = getattr(SERVO, triad.name).scale
        values = np.array(triad.parameters)
        covariance = calibration.parameter_covariance[half, half]
        size = 1e3 if column == 0 else 1.0
        middle = scale_and_bias(triad, nominal, 30.0, 30.0, values)
        panels = [curves(figure.axes[2 * row + column]) for row in range(4)]
        for index in (0, 13, 40):
            at = panels[0]["ax" if column == 0 else "mx"][0][index]
            shown = np.array([[y[index] for _, y in panel.values()] for panel in panels])
            scale, bias = scale_and_bias(triad, nominal, 30.0, at, values)
            both = partial(scale_and_bias, triad, nominal, 30.0, at)
            jacobian = slopes(lambda p, both=both: np.concatenate(both(p)), values)
            sd = np.sqrt(np.diagonal(jacobian @ covariance @ jacobian.T))
            wanted = [
                100 * (scale / middle[0] - 1),
                100 * sd[:3] / middle[0],
                size * (bias - middle[1]) / middle[0],
                size * sd[3:] / middle[0],
            ]
            np.testing.assert_allclose(
                shown[[0, 2]], np.array(wanted)[[0, 2]], atol=1e-7, rtol=1e-6
            )
            np.testing.assert_allclose(shown[[1, 3]], np.array(wanted)[[1, 3]], rtol=1e-4)


def test_channels_against_the_tool_axes_have_positive_scales():
    """A tool whose channels point the other way has the same scales, and biases of its own readings."""
    soaked = plans.run(
        TOOL, plans.grid([5.0, 45.0, 90.0, 135.0], 6, [0, 90, 200, 300], [25.0, 65.0]),
        np.random.default_rng(6),
    )  # fmt: skip
    axes = Profile(
        name="turned",
        accelerometer=TriadProfile(axes=("-y", "-x", "-z"), scale=1.0),
        magnetometer=SERVO.magnetometer,
    )
    straight = Profile(
        name="straight", accelerometer=TriadProfile(scale=1.0), magnetometer=SERVO.magnetometer
    )
    one, other = (
        calibrate(soaked, profile, Options(order=1)).plot.temperature()
        for profile in (straight, axes)
    )
    for row, sign in ((0, 1.0), (1, 1.0), (2, -1.0), (3, 1.0)):
        first, second = (curves(figure.axes[2 * row]) for figure in (one, other))
        for here, there in (("ax", "ay"), ("ay", "ax"), ("az", "az")):
            np.testing.assert_allclose(
                sign * second[there][1], first[here][1], rtol=1e-4, atol=1e-6
            )


def test_relative_fields_are_per_mille():
    soaked = plans.run(
        TOOL, plans.grid([5.0, 45.0, 90.0, 135.0], 6, [0, 90, 200, 300], [25.0, 65.0]),
        np.random.default_rng(6),
    )  # fmt: skip
    known = {k: v for k, v in soaked.known.items() if k != "field"}
    calibration = calibrate(replace(soaked, known=known), SERVO, Options(order=1))
    titles = [axes.get_ylabel() for axes in calibration.plot.temperature().axes]
    assert titles.count("bias, ‰ of the field") == 1
    assert not any("nT" in title for title in titles)


def test_errors_by_temperature_have_the_mean_of_each_soak():
    calibration = heated()
    figure = calibration.plot.errors_by_temperature()
    shown = [axes for axes in figure.axes if axes.get_visible()]
    assert len(shown) == len(calibration.errors)
    for axes, row in zip(shown, calibration.errors, strict=True):
        errors, means = {}, axes.lines[-1].get_xydata()
        for station in calibration.station_rows:
            errors.setdefault(round(station.temperature_c), []).append(
                station.errors[row.observable]
            )
        assert [round(x) for x in means[:, 0]] == sorted(errors)
        np.testing.assert_allclose(means[:, 1], [np.mean(errors[t]) for t in sorted(errors)])


@pytest.mark.usefixtures("without_layout")
def test_without_temperature_nothing_is_drawn_against_it():
    for name in ("temperature", "accuracy_over_temperature"):
        with pytest.raises(InputError, match="no temperature terms"):
            getattr(calibrated().plot, name)()
    with pytest.raises(InputError, match="temperature_c"):
        calibrated().plot.errors_by_temperature()
    page = render(calibrated())
    for key in ("temperature", "temperature-errors", "accuracy-temperature"):
        assert f'id="{key}-' not in page


@pytest.mark.usefixtures("without_layout")
def test_a_thermal_report_has_all_figures_against_temperature():
    page = render(heated())
    for key in ("temperature", "temperature-errors", "accuracy-temperature"):
        assert f'id="{key}-' in page
    assert page.count("Simulated data.") >= 3


def test_what_is_undetermined_is_said_in_words():
    figure = calibrated(("toolface",), moved=False).plot.accuracy()
    assert "toolface" not in curves(figure.axes[0])
    assert texts(figure).count("toolface: undetermined") == 2
    assert "azimuth" not in texts(calibrated(magnetometer=False).plot.accuracy())


@pytest.mark.usefixtures("without_layout")
def test_a_calibration_without_any_angle_has_no_picture_of_them():
    drop = ("inclination", "azimuth", "toolface", "dip")
    loose = calibrate(run(drop, moved=False), SERVO, Options(method="scalar"))
    page = render(loose)
    assert 'id="accuracy-' not in page
    assert "inclination undetermined, toolface undetermined, azimuth undetermined" in page
    assert "inclination, toolface, azimuth: undetermined" in texts(loose.plot.accuracy())


def fitted_curve(toolface, values, sd):
    """Mean and two harmonics by a solver of least squares, with weights."""
    rows = np.stack([toolface**0, *(f(k * toolface) for f in (np.cos, np.sin) for k in (1, 2))], -1)
    return np.linalg.lstsq(rows / sd[:, None], values / sd, rcond=None)[0]


def course(coefficients, toolface):
    terms = [toolface**0, *(f(k * toolface) for f in (np.cos, np.sin) for k in (1, 2))]
    return np.tensordot(coefficients, np.stack(terms), 1)


@pytest.mark.parametrize("knock", [0.0, 0.005])
def test_the_curve_of_an_error_is_a_weighted_fit_of_its_stations(knock):
    tested, result = readings(SETS, 3, knock=knock), verdict("sets", knock)
    for name in ("inclination", "azimuth"):
        row = next(row for row in result.rows if row.name == f"error of {name}")
        error = np.angle(np.exp(1j * (angle(name, sound(), tested) - tested.known[name])))
        whole = sound().uncertainty(name, tested, noise=True)
        sd = np.sqrt(whole**2 - sound().uncertainty(name, tested) ** 2)
        assert len(row.sets) == 5
        for each in row.sets:
            rows = [result.station_rows[i] for i in each.stations]
            departures = np.array([station.departures[row.name] for station in rows])
            np.testing.assert_allclose(departures, np.degrees(error[each.stations]), atol=1e-9)
            toolface = np.radians([station.toolface_deg for station in rows])
            wanted = fitted_curve(toolface, departures, sd[each.stations])
            np.testing.assert_allclose(each.coefficients, wanted, atol=1e-7)


def test_what_is_drawn_is_what_is_judged():
    result = verdict("sets", 0.005)
    figure = result.plot.toolface()
    rows = [row for row in result.rows if row.sets]
    panels = [axes for axes in figure.axes if axes.get_visible()]
    assert [axes.get_title("left") for axes in panels] == [row.name for row in rows]
    for axes, row in zip(panels, rows, strict=True):
        lines = [line.get_xydata() for line in axes.lines if len(line.get_xdata()) > 60]
        for (x, y), each in zip((line.T for line in lines), row.sets, strict=True):
            np.testing.assert_allclose(y, course(np.array(each.coefficients), x * DEG), atol=1e-12)
        level = [line.get_ydata()[0] for line in axes.lines if line.get_label() == "limit"]
        half = row.limit / 2 if row.name.startswith("spread") else row.limit
        assert level in ([], [-half, half])
        assert bool(level) != ("off the picture" in " ".join(t.get_text() for t in axes.texts))
        assert axes.get_title("right").endswith(": pass" if row.passed else ": FAIL")


def test_a_spread_lies_about_the_middle_of_its_curve():
    row = next(r for r in verdict("sets", 0.005).rows if r.name == "spread of gravity")
    turn = np.arange(0, 2 * np.pi, 1e-3)
    for each in row.sets:
        values = course(np.array(each.coefficients), turn)
        assert values.max() == pytest.approx(-values.min(), rel=2e-3)
        inside = np.ptp(values) <= row.limit
        assert inside == (values.max() <= row.limit / 2 * (1 + 1e-3))
        assert each.value == pytest.approx(np.ptp(values), abs=2 * each.uncertainty)


def test_the_row_is_its_worst_set_less_what_choosing_it_adds():
    """At most 1.27 σ, for six alike; next to nothing where one stands out."""
    for row in verdict("sets", 0.005).rows:
        worst = max(row.sets, key=lambda each: each.value)
        assert 0 <= worst.value - row.value < 1.3 * worst.uncertainty


@pytest.mark.usefixtures("without_pictures")
def test_stations_over_a_limit_are_marked():
    result = verdict("sets", 0.001)
    limits = {row.name: row.limit / (1 + row.name.startswith("spread")) for row in result.rows}
    for station in result.station_rows:
        wanted = [n for n, value in station.departures.items() if abs(value) > limits[n]]
        assert station.over == wanted
    assert 0 < sum(bool(station.over) for station in result.station_rows) < 40
    page = render(sound(), result)
    assert page.count("▲&nbsp;over</td>") == sum(bool(s.over) for s in result.station_rows)
    assert not any(station.over for station in verdict("one").station_rows)


def test_stations_are_listed_with_their_attitude():
    result, tested = verdict("one"), readings(ONE, 3)
    for name in ("inclination", "azimuth", "toolface"):
        listed = [getattr(station, f"{name}_deg") for station in result.station_rows]
        wanted = np.degrees(angle(name, sound(), tested)) % 360
        np.testing.assert_allclose(np.mod(listed, 360), wanted, atol=1e-9)
    assert [station.temperature_c for station in result.station_rows] == [25.0] * 12


def test_stations_outside_of_roll_sets_are_drawn_without_a_curve():
    plan = plans.StationPlan(
        np.radians(np.linspace(20, 160, 12)), np.radians(np.arange(12) * 77.0 % 360),
        np.radians(np.arange(12) * 30.0), np.full(12, 25.0),
    )  # fmt: skip
    result = verify(sound(), readings(plan, 4), LIMITS)
    for row in result.rows:
        (only,) = row.sets
        assert (only.label, only.coefficients, len(only.stations)) == ("", None, 12)
        departures = [abs(station.departures[row.name]) for station in result.station_rows]
        assert only.value == pytest.approx(max(departures))
        assert row.value < only.value  # the largest of twelve is too large by what noise adds
    figure = result.plot.toolface()
    assert "stations outside of roll sets" in curves(figure.axes[0])


def test_more_roll_sets_than_looks_show_the_worst():
    plan = plans.grid([20.0, 40.0, 60.0, 80.0, 100.0, 120.0, 140.0], 8, [60.0], [25.0])
    result = verify(sound(), readings(plan, 4, knock=0.004), LIMITS)
    assert len(result.rows[0].sets) == 7
    assert {"worst roll set", "other roll sets"} <= set(curves(result.plot.toolface().axes[0]))


@pytest.mark.filterwarnings("error")
def test_long_names_of_a_verdict_leave_the_panels_their_room():
    result = verdict("sets", 0.005)
    plain = result.plot.toolface()
    rows = [
        msgspec.structs.replace(
            row,
            name="N" * 300 + row.name,
            sets=[msgspec.structs.replace(each, label="L" * 300) for each in row.sets],
        )
        for row in result.rows
    ]
    long = msgspec.structs.replace(result, rows=rows).plot.toolface()
    for figure in (plain, long):
        figure.savefig(io.BytesIO())
    for axes, usual in zip(long.axes, plain.axes, strict=True):
        assert axes.get_position().width > 0.5 * usual.get_position().width


@pytest.mark.usefixtures("without_layout")
def test_vertical_stations_have_no_azimuth_to_draw():
    plan = plans.grid([0.0, 45.0], 12, [0.0, 60.0], [25.0])
    result = verify(sound(), readings(plan, 5), LIMITS)
    names = {row.name: row for row in result.rows}
    (one,) = names["error of azimuth"].sets
    assert one.stations == list(range(12, 24))
    assert len(names["error of inclination"].sets) == 2
    for station in result.station_rows[:12]:
        assert "error of azimuth" not in station.departures
        assert "error of inclination" in station.departures
        assert station.toolface_deg is not None
    Page().feed(render(sound(), result))


@pytest.mark.usefixtures("without_layout")
def test_a_relative_calibration_draws_everything_but_the_field():
    result = verify(sound("field"), readings(ONE, 3), LIMITS)
    row = next(row for row in result.rows if row.name == "error of field")
    assert (row.sets, row.passed) == ([], False)
    titles = [axes.get_title("left") for axes in result.plot.toolface().axes if axes.get_visible()]
    assert "error of field" not in titles
    assert "error of azimuth" in titles
    Page().feed(render(sound("field"), result))


@pytest.mark.usefixtures("without_pictures")
def test_a_verdict_without_values_has_no_picture():
    only = Limits(name="field", error=Bounds(field_nt=300.0))
    result = verify(sound("field"), readings(ONE, 3), only)
    with pytest.raises(InputError, match="no values to draw"):
        _ = result.plot.toolface()
    assert "Nothing to draw" in render(sound("field"), result)


def test_a_set_that_was_not_rolled_is_drawn_and_fails():
    plan = plans.StationPlan(*(np.concatenate([v, v])[:12] for v in (
        np.full(12, 45 * DEG), np.full(12, 60 * DEG), np.radians(np.arange(12) * 10.0), np.full(12, 25.0)
    )))  # fmt: skip
    result = verify(sound(), readings(plan, 6), LIMITS)
    row = next(row for row in result.rows if row.name == "spread of inclination")
    (only,) = row.sets
    assert (row.passed, only.passed, only.coefficients) == (False, False, None)
    values = [station.departures[row.name] for station in result.station_rows]
    assert max(values) == pytest.approx(-min(values))
    assert np.ptp(values) == pytest.approx(row.raw)
    assert "not stated" in result.plot.toolface().axes[0].get_title("right")


@pytest.mark.usefixtures("without_pictures")
def test_signatures_are_on_the_first_printed_page():
    """In print they follow banner and facts, before findings of any length."""
    page = render(sound(), verdict("one"))
    outcome = page[page.index('<section id="outcome">') : page.index('<section id="verification">')]
    assert 'id="signatures"' in outcome
    printed = page[page.index("#outcome { min-height") : page.index("</style>")]
    assert "#outcome > .sign { order: 1" in printed
    assert "#outcome > .know { order: 2" in printed


@pytest.mark.usefixtures("without_pictures")
def test_a_simulated_roll_test_is_labelled_as_one():
    real = msgspec.structs.replace(sound(), tool={"serial": "MWD-7"}, simulated=False)
    result = verdict("one")
    assert "SIMULATED DATA" not in render(real, result)
    page = render(real, result, {"simulated": True})
    assert "SIMULATED DATA" in page
    assert "Simulated data." in page[page.index('id="verification"') : page.index('id="errors"')]


@pytest.mark.usefixtures("without_layout")
def test_labels_of_the_roll_test_are_escaped():
    result = verdict("one")
    rows = [msgspec.structs.replace(row, station="<script>") for row in result.station_rows]
    page = render(sound(), msgspec.structs.replace(result, station_rows=rows))
    assert page.count("<script") == 1  # that of the page
    assert page.count("<td>&lt;script&gt;</td>") == 12
