"""The report: self-contained, deterministic, safe, whole; and the predictions behind it."""

from __future__ import annotations

import hashlib
import re
import sys
import warnings
from base64 import b64decode
from dataclasses import dataclass, field, replace
from functools import cache
from html.parser import HTMLParser

import msgspec
import numpy as np
import pytest
from markupsafe import Markup

from mwdcal import extras
from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Finding
from mwdcal.calibration.results import accuracy_at, accuracy_curves, readings_at, typical_accuracy
from mwdcal.errors import InputError
from mwdcal.geometry.vectors import reference_vectors
from mwdcal.planning import plans
from mwdcal.presentation import calibration as screen
from mwdcal.presentation import calibration_page, conversion
from mwdcal.presentation.calibration_page import render
from mwdcal.presentation.numbers import fixed, measured, number, quantity, signed
from mwdcal.presentation.page import css, svg
from mwdcal.presentation.typed import leading_findings
from mwdcal.sensor.profile import Profile, TriadProfile
from mwdcal.use import plots
from mwdcal.use.notation import convert
from simulation import DEG, Tool, plan

SERVO = Profile(
    name="servo",
    accelerometer=TriadProfile(scale=3.0, noise=3e-4),
    magnetometer=TriadProfile(scale=5e-5, noise=7.5e-4),
)
SECTIONS = (
    "outcome", "errors", "figures", "measures", "residuals", "stations", "parameters",
    "undetermined", "accuracy", "conditions", "signatures",
)  # fmt: skip


def run(drop=(), magnetometer=True, moved=True, **metadata):
    tool = Tool.random(7)
    inc, azi, face = plan()
    a, m = (v[0] for v in tool.readings(np.random.default_rng(1), 1, inc, azi, face))
    if moved:
        a[6] += [3e-4, 6e-4, 0]
    known = {
        "inclination": inc, "azimuth": azi, "toolface": face,
        "field": np.full(48, tool.field), "dip": np.full(48, tool.dip), "gravity": np.ones(48),
    }  # fmt: skip
    return Readings(
        a,
        m if magnetometer else None,
        known={k: v for k, v in known.items() if k not in drop},
        sd={"accelerometer": np.array(1e-4), "magnetometer": np.array(15.0)},
        station=tuple(f"P{i + 1}" for i in range(48)),
        metadata={"serial": "MWD-123", **metadata},
        source="run.csv",
        run_sha256="ab" * 32,
    )


@cache
def calibrated(drop=(), magnetometer=True, moved=True, profile=SERVO, **metadata):
    made = calibrate(run(drop, magnetometer, moved, **metadata), profile)
    return msgspec.structs.replace(made, time="2025-01-02T03:04:05+00:00")


@cache
def soaked(unknown=()):
    stations = plans.grid([5.0, 45.0, 90.0, 135.0], 6, [0, 90, 200, 300], [25.0, 65.0, 105.0])
    made = plans.run(plans.servo(np.random.default_rng(5)), stations, np.random.default_rng(6))
    known = {k: v for k, v in made.known.items() if k not in unknown}
    return replace(made, source="hot.csv", known=known)


@cache
def heated(model=None):
    return calibrate(soaked(), SERVO, Options(model=model, order=1))


@cache
def judged(order="auto", unknown=()):
    """Calibrated with the table of errors at temperatures left out."""
    return calibrate(soaked(unknown), SERVO, Options(order=order))


@dataclass
class Row:
    name: str = "spread of azimuth"
    unit: str = "°"
    value: float | None = 1.23
    raw: float | None = 1.45
    limit: float = 1.0
    uncertainty: float | None = 0.04
    passed: bool = False
    note: str = "roll set 1; stations 3 to 9"
    sets: list = field(default_factory=list)
    degrees_of_freedom: float | None = 8.0
    judged_raw: bool = False

    @property
    def freedom(self):
        return self.degrees_of_freedom


@dataclass
class Outcome:
    passed: bool
    rows: list[Row]
    rule: str = "simple acceptance"
    limits: str = "moosavi"
    source: str = ""
    data: str = "roll.csv"
    run: str = "roll.csv"
    stations: int = 12
    risk: float | None = 0.02
    settings: str = "assumed"
    findings: list = field(default_factory=list)
    station_rows: list = field(default_factory=list)
    not_judged: tuple[str, ...] = ()
    left_open: str = ""


@pytest.fixture(scope="module")
def whole():
    return calibrated()


@pytest.fixture
def words(monkeypatch):
    """`render` without its pictures, for tests of what it says."""
    for name in (
        *("errors", "deviations", "accuracy", "orders", "temperature", "sphere", "errors_of_all"),
        *("accuracy_over_temperature", "errors_by_temperature"),
    ):
        monkeypatch.setattr(plots.Plots, name, lambda *arguments: "")
    monkeypatch.setattr("mwdcal.presentation.page.svg", lambda figure, key: Markup(figure))
    return render


@pytest.fixture(scope="module")
def page(whole):
    return render(whole)


class Page(HTMLParser):
    """Tags that stay open, ids, and attributes that could load something."""

    VOID = ("meta", "br", "link", "img", "path", "use")

    def __init__(self):
        super().__init__()
        self.open, self.ids, self.links, self.tags = [], [], [], set()

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        if tag not in ("meta", "br"):
            self.open.append(tag)
        self.handle_startendtag(tag, attrs)

    def handle_startendtag(self, tag, attrs):
        self.tags.add(tag)
        self.ids += [v for k, v in attrs if k == "id"]
        self.links += [v for k, v in attrs if k in ("src", "href", "xlink:href", "srcset", "data")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def parsed(text):
    found = Page()
    found.feed(text)
    return found


def test_self_contained_and_well_formed(page):
    found = parsed(page)
    assert not found.open
    assert page.count("<script") == page.count("<script>") == 1
    assert not found.tags & {"link", "img", "iframe", "object", "image"}
    assert all(link.startswith("#") for link in found.links)
    assert not re.search(r"https?://|@import|url\((?!#)", page)
    assert len(found.ids) == len(set(found.ids))
    assert {link[1:] for link in found.links} <= set(found.ids)
    assert len(page) < 1_000_000


def test_the_only_script_is_the_one_that_the_security_policy_allows(page):
    (script,) = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    (allowed,) = re.findall(r"script-src 'sha256-([^']+)'", page)
    assert b64decode(allowed) == hashlib.sha256(script.encode()).digest()
    assert "default-src 'none'" in page


def test_points_have_the_names_and_values_of_their_stations(whole):
    drawn = svg(whole.plot.deviations(), "k")
    names = re.findall(r"<title>station (\S+): (\S+) σ</title>", drawn)
    expected = {row.station: row.deviation for row in whole.station_rows}
    assert {name: float(value) for name, value in names} == pytest.approx(expected, rel=6e-3)
    assert len(names) == len(expected)
    assert drawn == svg(whole.plot.deviations(), "k")


def test_no_point_has_the_name_of_another(whole):
    figure = whole.plot.deviations()
    line = figure.findobj(lambda artist: artist.get_gid())[0]
    line.set_label(f"{line.get_label()}\none too many")
    names = re.findall("<title>", svg(figure, "k"))
    assert len(names) == sum(row.reshoot for row in whole.station_rows)


def test_spheres_show_the_readings_before_and_after(whole):
    """The vectors that are drawn follow from angles and errors; these are the readings themselves."""
    made = run()
    raw = [made.accelerometer, made.magnetometer]  # in nominal units
    fitted = whole.fields(made)
    sizes = 1.0, whole.earth["field"]
    for name, wanted in (("errors_before", raw), ("errors", fitted)):
        for drawn, vector, size in zip(
            plots._unit_vectors(whole, name), wanted, sizes, strict=True
        ):
            np.testing.assert_allclose(drawn, vector / size, atol=1e-9)


def test_columns_of_panels_are_pictures_of_their_own(whole):
    """Nothing of the picture is lost, and each part begins where the last one ends."""
    for figure, columns, legends in (
        (whole.plot.sphere(), 2, 1),
        (whole.plot.errors_of_all(), 2, 0),
        (whole.plot.accuracy(), 2, 1),
    ):
        drawn = svg(figure, "k")
        parsed(drawn)
        assert drawn.count("<svg") == columns + legends
        assert drawn.count('class="legend"') == legends
        assert len(re.findall(r'<g id="k-axes_\d+">', drawn)) == len(figure.axes)
        boxes = re.findall(r'tabindex="0" viewBox="(\S+) (\S+) (\S+) (\S+)"', drawn)
        ends = [(float(left), float(left) + float(width)) for left, _, width, _ in boxes]
        assert ends[0][0] == 0
        assert ends[0][1] == pytest.approx(ends[1][0], abs=0.02)
        assert ends[1][1] == pytest.approx(72 * figure.get_figwidth(), abs=0.02)
        used = set(re.findall(r'(?:href="#|url\(#)([^")]+)', drawn))
        assert used <= set(parsed(drawn).ids)


def test_gauges_show_value_and_expanded_uncertainty_against_the_limit(whole):
    row = Row(name="error of azimuth", value=0.3, uncertainty=0.1, passed=True)
    worse = Row(name="spread of azimuth", value=0.9, uncertainty=0.1, degrees_of_freedom=4.0)
    inclination, toolface, azimuth = calibration_page._gauges(
        whole, Outcome(False, [row, worse]), None
    )
    assert (azimuth.name, azimuth.word, azimuth.limit) == ("spread of azimuth", "FAIL", "limit 1°")
    assert azimuth.shown == "0.90 ± 0.28°"  # t(95 %, 4) = 2.776 of a table
    assert azimuth.value / azimuth.bound == pytest.approx(0.9)
    assert azimuth.span[1] / azimuth.bound == pytest.approx(0.9 + 0.2776, rel=1e-3)
    assert {each.word for each in (inclination, toolface)} == {"not tested"}
    assert inclination.bound is None


def test_an_angle_whose_limit_was_not_judged_does_not_say_that_it_has_none(whole):
    verdict = Outcome(True, [Row(passed=True)], not_judged=("error of inclination",))
    inclination, toolface, _ = calibration_page._gauges(whole, verdict, None)
    assert (inclination.word, inclination.limit) == ("not judged", "")
    assert (toolface.word, toolface.limit) == ("not tested", "no limit given")


def test_a_raw_figure_beyond_its_limit_has_a_gauge_without_uncertainty(whole):
    """Beyond its limit: scatter that is not noise has no U, and 13 times 1σ would hide the decision."""
    row = Row(value=0.73, uncertainty=0.6, limit=0.1, degrees_of_freedom=1.0, judged_raw=True)
    *_, azimuth = calibration_page._gauges(whole, Outcome(False, [row]), None)
    assert azimuth.shown == "0.73° raw"
    assert azimuth.span == pytest.approx((azimuth.value, azimuth.value))
    met = replace(row, value=0.05, uncertainty=0.006, passed=True)
    *_, azimuth = calibration_page._gauges(whole, Outcome(True, [met]), None)
    assert azimuth.shown == "0.050 ± 0.076° raw"  # t(95 %, 1) = 12.71 of a table
    guarded = replace(met, value=0.07, passed=False)  # U alone makes it fail
    *_, azimuth = calibration_page._gauges(whole, Outcome(False, [guarded]), None)
    assert azimuth.shown == "0.070 ± 0.076° raw"


def test_every_limit_that_is_not_met_has_a_gauge(whole):
    rows = [
        Row(name="spread of gravity", unit="g", value=0.01, limit=0.003),
        Row(passed=True, value=0.1),
    ]
    shown = [each.name for each in calibration_page._gauges(whole, Outcome(False, rows), None)]
    assert shown == ["inclination", "toolface", "spread of azimuth", "spread of gravity"]


def finding(name, text="words", station=None):
    return Finding(id=name, text=text, station=station)


def test_findings_are_grouped_by_cause_and_the_most_important_come_first():
    again = [finding("reshoot", f"station {i} moved. Re-shoot it", str(i)) for i in range(3)]
    shown, left = leading_findings(
        [finding("not-used"), finding("settings-apart"), *again, finding("altered")]
    )
    assert [each.id for each in shown] == ["altered", "reshoot", "settings-apart", "not-used"]
    assert shown[1].text == "station 0 moved. Re-shoot it. Also stations 1, 2"
    assert left == 0
    for suspects in ([finding("settings"), *again], [*again, finding("settings")]):
        shown, _ = leading_findings([finding("magnetometer-residuals"), *suspects])
        assert [each.id for each in shown[:2]] == [suspects[0].id, suspects[-1].id]
    many = [finding("reshoot", "moved", str(i)) for i in range(20)]
    assert leading_findings(many)[0][0].text.endswith(", 12 and 7 more")
    causes = [finding(f"cause-{i}") for i in range(9)]
    assert leading_findings([*causes, finding("path-from-first")])[0][0].id == "path-from-first"
    shown, left = leading_findings(causes)
    assert (len(shown), left) == (6, 3)


def test_an_edge_with_more_behind_it_is_shaded(page):
    style = page[: page.index("</style>")]
    assert "var(--shade), transparent) 100% 0" in style
    assert style.count("--shade: #") == 2  # light and dark


def test_where_a_well_path_starts_is_never_among_the_findings_left_out():
    shown, _ = leading_findings([*map(finding, "abcdefgh"), finding("path-from-first")])
    assert shown[0].id == "path-from-first"


def test_every_section_is_present(page):
    assert set(SECTIONS) <= set(parsed(page).ids)
    for words in (
        "MWD-123", "run.csv", "2025-01-02 03:04 UTC", "12 of 12", "ab" * 32, "Not verified",
        "Approved by", "degrees of freedom", "RMSE", "toolface·sin I", "Accuracy to expect",
    ):  # fmt: skip
        assert words in page


def test_user_settings_of_matplotlib_change_nothing(whole, page):
    import matplotlib as mpl

    with mpl.rc_context({"font.size": 20, "axes.facecolor": "red", "svg.fonttype": "none"}):
        assert svg(whole.plot.errors_of_all(), "errors-after") in page
        assert mpl.rcParams["font.size"] == 20


def test_station_to_reshoot_is_first_and_marked(page):
    assert "Fit accepted – 1 station to re-shoot" in page
    assert page.index("Station P7: residual") < page.index('id="signatures"')
    assert re.search(
        r'<tr class="mark" data-point="station P7"><td>P7</td>.*?re-shoot', page, re.DOTALL
    )


def test_facts_that_nobody_stated_are_not_given(words):
    """Gravity is assumed; a profile that is named by the serial is no type; misalignments are radians."""
    page = words(calibrated(moved=False))
    stated = '1 g</td><td class="text">'
    record = calibrated(moved=False)
    for known, word in ((False, "assumed"), (True, "given")):
        of_run = msgspec.structs.replace(record, gravity_stated=known)
        assert f"{stated}{word}</td>" in words(of_run)
    assert "<dt>Type</dt><dd>servo</dd>" in page
    named = msgspec.structs.replace(record.profile, name="MWD-123")
    assert "<dt>Type</dt>" not in words(msgspec.structs.replace(record, profile=named))
    assert re.search(r"<td>m<sub>xy</sub></td>.*?<td class=\"text\">rad</td>", page)
    assert "Degrees of freedom: readings that check the fit" in page


def test_clean_fit_says_so(words):
    page = words(calibrated(moved=False))
    assert '<p class="headline">Calibrated – not yet verified</p>' in page
    assert (
        "<p>Fit accepted – no temperature recorded. Accuracy to expect (1σ, calibration alone, at 45° inclination): "
        "inclination 0.0" in page
    )
    assert "No findings" in page
    assert 'class="over"' not in page


def test_errors_of_more_than_twice_what_is_expected_are_marked(words):
    record = calibrated(moved=False)
    one = record.errors[0]
    wide = msgspec.structs.replace(one, after=2.5 * one.expected)
    page = words(msgspec.structs.replace(record, errors=[wide, *record.errors[1:]]))
    assert page.count('class="over"') == 1
    assert "2.5 !</td>" in page


def test_tables_scroll_and_colours_follow_the_reader(words):
    """Every table of a page lies in a region that scrolls on a narrow screen."""
    page = words(calibrated(moved=False))
    assert page.count("<table") == page.count('<div class="scroll" role="region"') > 5
    assert "@media (max-width: 640px)" in page
    assert "@media (prefers-color-scheme: dark)" in page


def test_metadata_is_escaped(words):
    evil = "<script>alert(1)</script>\"'</style>"
    page = words(calibrated(serial=evil, operator=evil, tool=evil, lab=evil, date=evil))
    assert page.count("<script") == page.count("</style>") == 1
    assert "&lt;script&gt;" in page


def test_option_names_are_put_into_findings_and_into_no_text_of_the_user(words):
    said = Finding(id="x", text="Use `order` auto")
    record = calibrated(serial="X1 `date`", operator="`order`")
    page = words(msgspec.structs.replace(record, findings=[*record.findings, said]))
    assert "X1 `date`" in page
    assert "X1 &#39;date&#39;" not in page
    assert "<dd>`order`" in page
    assert "Use &#39;order&#39; auto" in page


def test_station_labels_may_be_anything(whole):
    rows = [
        msgspec.structs.replace(r, station=s)
        for r, s in zip(whole.station_rows, ["$x_", "--><script>", "井", *"a" * 45], strict=True)
    ]
    odd = msgspec.structs.replace(whole, station_rows=rows)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figures = {"a": odd.plot.errors("field"), "b": odd.plot.deviations()}
        found = "".join(svg(figure, key) for key, figure in figures.items())
    assert "<script" not in found
    parsed(found)


def test_undetermined_toolface_shows(words):
    page = words(calibrated(("toolface",), moved=False))
    assert '<p class="headline">Calibrated – not yet verified</p>' in page
    assert "<p>Toolface zero undetermined – no temperature recorded. Accuracy to expect" in page
    assert "11 of 12" in page
    assert '<td class="free">undetermined</td>' in page
    assert "Not shown, for want of a reference: toolface·sin I." in page
    assert "Not stated: these measures need" in page
    assert '<span class="value"><a href="#undetermined">undetermined</a></span>' in page
    assert "Undetermined: this run cannot tell it" in page
    assert "Undetermined: this run cannot" not in words(calibrated(moved=False))
    assert '<td>30 °C</td><td class="text">default of a profile</td>' in page
    assert '<td class="text">1</td>' not in page
    assert re.search(r"± 0\.0\d+° expected \(U, k = 2(\.\d)?\)", page)


def test_undetermined_parameters_are_those_of_the_free_turn(words):
    page = words(calibrated(("toolface",), moved=False))
    in_brackets = r"<td class=\"soft\">\([^<]*\)</td><td class=\"free\">undetermined</td>"
    rows = re.findall(rf"<td>(\w+)<sub>(\w+)</sub></td>{in_brackets}", page)
    assert rows[:2] == [("m", "xy"), ("m", "yx")]
    assert {name for name, _ in rows} <= {"m", "B"}


def test_without_magnetometer():
    page = render(calibrated(magnetometer=False))
    assert "no magnetometer was calibrated" in page
    assert "nT" not in re.sub(r"<svg.*?</svg>", "", page, flags=re.DOTALL)
    assert "azimuth, °" not in page


def test_relative_field_has_no_unit(words):
    page = words(calibrated(("field", "toolface"), moved=False))
    assert "magnetic field relative, not in nT" in page
    assert "calibrated to field = 1" in page
    assert "‰ of the field" in page


def test_no_reference_angles_at_all(words):
    page = words(calibrated(("inclination", "azimuth", "toolface", "dip"), moved=False))
    assert "estimated from the run, 1σ" in page
    assert "inclination, toolface·sin I, azimuth·sin I" in page


def test_verdict_comes_first(whole, words):
    failed = words(whole, Outcome(False, [Row(), Row(passed=True, value=0.5, note="<b>")]))
    assert "Verification failed – 1 of 2 limits not met" in failed
    assert failed.index("Verification failed") < failed.index("Fit accepted")
    assert "1.230°" in failed  # two digits of the uncertainty…
    assert "0.040°" in failed  # …and that
    assert "1.450°" in failed
    assert '0.040°</td><td data-title="DoF">8</td>' in failed
    assert "Risk of a wrong verdict, all roll sets and limits together: 0.02." in failed
    assert "&lt;b&gt;" in failed
    assert "Not verified" not in failed
    passed = words(whole, Outcome(True, [Row(passed=True, value=0.5, uncertainty=None)]))
    assert "Verification passed – 1 limit met" in passed
    assert "roll.csv -o verdict.json" in passed
    assert "--verification verdict.json -o certificate.pdf" in passed
    free = words(whole, Outcome(False, [Row(uncertainty=None)], left_open="toolface zero"))
    assert "Not verified – nothing wrong was found, toolface zero left open" in free
    assert "Give reference toolfaces in the calibration run" in free
    assert "not stated" in passed


@pytest.mark.parametrize("model", [None, "polynomial"])
def test_temperature_terms_and_annex(model, words):
    made = heated(model)
    page = words(made)
    assert "SIMULATED DATA" in page
    assert {"annex", "stations"} <= set(parsed(page).ids)
    assert "/°C" in page
    assert "105.0 °C" in page
    assert ("SF<sub>" in page) == (model is None)


def test_errors_at_left_out_temperatures(words, monkeypatch):
    monkeypatch.setattr(plots.Plots, "orders", lambda self: "<svg>by order</svg>")
    made = judged()
    page = words(made)
    parsed(page)
    assert 'id="orders"' in page
    assert "by order" in page
    for score in made.orders:
        row = rf"<tr><td>{score.triad}</td><td>{score.order}</td>.*?</tr>"
        row = re.search(row, page, re.DOTALL)[0]
        for value in (score.error_inside, score.error_ends, score.noise, score.inside, score.ends):
            assert f">{number(value)}<" in row
        assert f">{number(score.error_ends_deg, 2)}<" in row
        assert ("chosen" in row) == score.chosen
    for said in ("interpolation", "extrapolation", "above which none is below 0.001", "25.0 to 105.0 °C",
                 "--outside refuse", "--outside extrapolate", "The course with temperature is simulated"):  # fmt: skip
        assert said in page


def test_a_given_order_has_errors_but_nothing_to_compare(words):
    page = words(judged(1))
    assert 'id="orders"' in page
    assert "above which none" not in page
    assert ">chosen<" not in page


def test_errors_of_a_relative_field_are_per_mille(words):
    page = words(judged(1, ("field", "dip")))
    assert "‰: of the field" in page
    assert re.search(r'<td>magnetometer</td><td>1</td>.*?<td class="text">‰</td>', page, re.DOTALL)


def test_a_course_that_nothing_tests_says_so(words, whole):
    page = words(msgspec.structs.replace(heated(), orders=[]))
    assert 'id="orders"' not in page
    assert "nothing tests its course" in page
    assert "--outside extrapolate" in page
    assert "--outside" not in words(whole)


def test_picture_of_the_orders_has_both_triads():
    made = judged()

    def drawn(scores):
        return msgspec.structs.replace(made, orders=scores).plot.orders()

    both = drawn(made.orders)
    parsed(svg(both, "orders"))
    alone = drawn([s for s in made.orders if s.triad == "accelerometer"])
    assert (len(alone.axes), len(both.axes)) == (1, 2)
    blank = [msgspec.structs.replace(s, error_inside=None) for s in made.orders]
    parsed(svg(drawn(blank), "orders"))


@cache
def asked(parameters=9, robust="huber"):
    return calibrate(run(moved=False), SERVO, Options(parameters=parameters, robust=robust))


def test_what_was_asked_for_stands_in_the_method_line(words, whole):
    page = words(asked())
    assert "joint; polynomial of order 0; 9 parameters; robust (huber)" in page
    assert "<dd>joint; polynomial of order 0</dd>" in words(whole)


def test_different_orders_name_their_triad():
    made = heated()
    other = msgspec.structs.replace(made.magnetometer, order=2)
    made = msgspec.structs.replace(made, magnetometer=other)
    wanted = "accelerometer: factors of order 1, magnetometer: factors of order 2"
    assert screen.model(made) == wanted
    assert wanted in screen.heading(made)
    assert screen.how(made) == ["joint", wanted]
    assert "factors of order 1   " in screen.heading(heated())


def left_out_rows(page):
    table = page[page.index('id="left-out"') :]
    table = table[: table.index("</table>")]
    return [re.findall(r"<td>([^<]*)</td>", row) for row in table.split("<tr")[3:]]


def test_every_station_shows_its_error_left_out_and_what_it_does(words, whole):
    page = words(whole)
    assert parsed(page).ids.count("left-out") == 1
    decimals = calibration_page._decimals(whole)
    names = [row.observable for row in whole.errors]
    rows = left_out_rows(page)
    assert len(rows) == 48
    for cells, station in zip(rows, whole.station_rows, strict=True):
        alone = [signed(station.errors_left_out[n], decimals[n]) for n in names]
        moves = [fixed(station.influence[n], decimals[n] + 1) for n in names]
        assert cells == [station.station, *alone, *moves]
    assert "weight</th>" not in page


def test_the_weight_of_a_station_is_shown_where_the_fit_was_robust(words):
    made = asked()
    page = words(made)
    assert "weight</th>" in page
    shown = [cells[-1] for cells in left_out_rows(page)]
    assert shown == [fixed(row.weight, 2) for row in made.station_rows]


def test_a_record_without_errors_left_out_has_no_such_table(words, whole):
    rows = [
        msgspec.structs.replace(r, errors_left_out={}, influence={}) for r in whole.station_rows
    ]
    page = words(msgspec.structs.replace(whole, station_rows=rows))
    assert "left-out" not in parsed(page).ids


@pytest.mark.parametrize("parameters", [12, 9, 6])
def test_held_parameters_are_said_to_be_held(words, parameters):
    made = asked(parameters)
    page = words(made)
    count = 2 * (12 - parameters)
    assert page.count("<td>0</td><td>held</td>") == count
    assert ("A held parameter" in page) == (parameters != 12)
    for notation in ("factors", "forward", "affine"):
        shown = conversion.notation(convert(made, notation))
        assert len(re.findall(r" 0 +held$", shown, re.MULTILINE)) == count
        assert not re.search(r" -0( |$)", shown, re.MULTILINE)


def test_zero_has_no_sign():
    assert number(-0.0) == quantity(-0.0, "") == "0"


def test_summary_says_what_was_asked_for(tmp_path):
    made = asked()
    found = screen.summary(made, [], tmp_path / "tool.json", None)
    found = msgspec.to_builtins(found)
    assert found["options"]["parameters"] == 9
    assert found["options"]["robust"] == "huber"
    for triad in found["triads"].values():
        assert (triad["model"], triad["order"]) == ("polynomial", 0)
    assert {row["when"] for row in found["measures"]} == {"before", "after"}
    assert found["temperature_c"] is None
    assert "seed" in found


def test_curved_axes_have_the_parameters_of_the_record(words):
    curved = msgspec.structs.replace(
        SERVO, accelerometer=TriadProfile(scale=3.0, noise=3e-4, nonlinearity=1e-3)
    )
    made = calibrate(run(moved=False), curved, Options(nonlinearity=("accelerometer",)))
    assert "square<sub>x</sub>" in words(made)
    check_inverse(made)


def test_real_data_is_not_called_simulated(page):
    assert "SIMULATED" not in page


def test_missing_extra_says_what_to_install(whole, monkeypatch):
    monkeypatch.setitem(sys.modules, "jinja2", None)
    with pytest.raises(InputError, match=re.escape(extras.command("report"))):
        render(whole)


def check_inverse(made):
    rng = np.random.default_rng(2)
    inc = np.r_[0, np.pi, rng.uniform(0, np.pi, 40)]
    azi, face = rng.uniform(0, 2 * np.pi, (2, 42))
    earth = made.earth
    dip = earth.get("dip_deg", 0.0) * DEG
    field = earth.get("field", 1.0)
    for temperature in (None, 80.0):
        found = made.fields(readings_at(made, inc, azi, face, temperature))
        wanted = reference_vectors(inc, azi, face, earth["gravity_g"], field, dip)
        np.testing.assert_allclose(found[0], wanted[0], atol=1e-12)
        if made.has_field:
            np.testing.assert_allclose(found[1] / field, wanted[1] / field, atol=1e-12)


@pytest.mark.parametrize("drop", [(), ("field",), ("toolface", "dip")])
@pytest.mark.parametrize("magnetometer", [True, False])
def test_readings_at_invert_the_model(drop, magnetometer):
    check_inverse(calibrated(drop, magnetometer))


@pytest.mark.parametrize("model", ["factors", "polynomial"])
def test_readings_at_invert_the_model_at_any_temperature(model):
    check_inverse(heated(model))


def test_readings_at_broadcast(whole):
    made = readings_at(whole, np.full((2, 1, 3), 0.5), 0.1, np.zeros(3))
    assert made.accelerometer.shape == (2, 1, 3, 3)


def test_accuracy_agrees_with_refits():
    rng, tool = np.random.default_rng(4), Tool.random(7)
    inc, azi, face = plan(toolfaces=6)
    values = []
    wanted = (45 * DEG, 30 * DEG, 70 * DEG)
    clean = [v[None] for v in tool.clean(*(np.array(w) for w in wanted))]
    known = {"inclination": inc, "azimuth": azi, "toolface": face, "dip": np.full(24, tool.dip)}
    known["field"] = np.full(24, tool.field)
    sd = {"accelerometer": np.array(1e-4), "magnetometer": np.array(15.0)}
    for _ in range(24):
        a, m = (v[0] for v in tool.readings(rng, 1, inc, azi, face))
        made = calibrate(Readings(a, m, known=known, sd=sd), SERVO)
        g, _ = made.fields(Readings(*clean))
        values.append(np.arctan2(np.hypot(g[0, 0], g[0, 1]), g[0, 2]))
    stated = made.uncertainty("inclination", readings_at(made, *(np.array([w]) for w in wanted)))
    assert 0.7 < np.std(values, ddof=1) / stated[0] < 1.4


def test_accuracy_tables(whole):
    alone, one = (accuracy_at(whole, np.radians([5, 45, 90]), noise) for noise in (False, True))
    for name in ("inclination", "toolface", "azimuth"):
        assert (one[name] > alone[name]).all()
    assert alone["toolface"][0] > 3 * alone["toolface"][2]
    typical = typical_accuracy(whole)
    assert typical["azimuth"] == pytest.approx(np.degrees(alone["azimuth"][1]))


def test_no_accuracy_is_quoted_for_what_is_undetermined():
    made = calibrated(("toolface",), moved=False)
    assert np.isnan(accuracy_curves(made, np.radians([45.0]))["toolface"].typical).all()
    assert typical_accuracy(made)["toolface"] is None
    assert typical_accuracy(made)["inclination"] is not None
    assert "azimuth" not in typical_accuracy(calibrated(magnetometer=False))


@pytest.mark.parametrize(
    ("value", "uncertainty", "text"),
    [
        (0.123456, 0.00123, ("0.1235", "0.0012")),
        (-0.00001, 0.0996, ("0.00", "0.10")),
        (-274.512, 2.166, ("−274.5", "2.2")),
        (48012.3, 123.0, ("48010", "120")),
        (2.34567e-5, 1.2e-9, ("2.34567×10⁻⁵", "0.00012×10⁻⁵")),
        (0.5, None, ("0.500000", "undetermined")),
        (0.5, float("nan"), ("0.500000", "undetermined")),
    ],
)
def test_values_are_rounded_to_their_uncertainty(value, uncertainty, text):
    assert measured(value, uncertainty) == text


def test_numbers():
    assert [number(v) for v in (0, 22.44, -0.0649, 1.5e-7, None, float("nan"), 12345)] == [
        "0", "22.4", "−0.0649", "1.5×10⁻⁷", "–", "–", "12345",
    ]  # fmt: skip
    assert [signed(v, 2) for v in (1, -1, -0.001, None)] == ["+1.00", "−1.00", "0.00", "–"]
    assert set(css("a<é\n}")) <= set("0123456789abcdef\\ ")
