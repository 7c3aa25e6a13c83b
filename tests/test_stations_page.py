"""The page of `mwdcal stations`: what it says against the simulated log, and what it must never do."""

import hashlib
import re
from html.parser import HTMLParser
from itertools import pairwise

import numpy as np
import pytest

from cli_support import mwdcal, read_csv, refused, write_csv
from mwdcal.files import logs
from mwdcal.logs.stations import find_stations
from test_stations import ACC, tumble

pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")

from mwdcal.presentation.stations import figure

VOID = ("meta", "br", "use", "path")


class Page(HTMLParser):
    """Rows of every table by section, all text, and what could act: scripts, handlers, links."""

    def __init__(self, text):
        super().__init__()
        self.section, self.rows, self.text, self.active, self.open = "", {}, "", [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        if tag not in VOID:
            self.open.append(tag)
        names = dict(attributes)
        if tag == "section":
            self.section = names["id"]
        if tag == "tr":
            self.rows.setdefault(self.section, []).append([])
        if tag in ("td", "th"):
            self.rows[self.section][-1].append("")
        self.active += [tag] if tag in ("script", "img", "iframe", "object", "link") else []
        self.active += [name for name in names if name.startswith("on") or name == "src"]
        links = [v for k, v in attributes if k in ("href", "xlink:href")]
        self.active += [link for link in links if not link.startswith("#")]

    def handle_startendtag(self, tag, attributes):
        pass

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.text += data
        if self.rows.get(self.section) and {"td", "th"} & set(self.open):
            self.rows[self.section][-1][-1] += data


def number(text):
    """A number of the page, with its true minus sign."""
    return float(text.replace("−", "-"))


def shown(folder, table, *options, metadata=(), name="log.csv", **columns):
    """The page of a log, and the run beside it."""
    log = write_csv(folder / name, {**table.columns, **columns}, *metadata)
    report = folder / "log.html"
    ran = mwdcal("stations", log, "-o", folder / "run.csv", "--report", report, *options)
    return ran, Page(report.read_text("utf-8")), log


def test_the_page_has_the_stations_of_the_simulation(tmp_path):
    table, starts, ends, aims = tumble(3, stations=12)
    ran, page, log = shown(tmp_path, table, metadata=("simulated = true", "serial = 'T-7'"))
    assert ran.code == 0
    header, *rows = page.rows["found"]
    assert header == [
        "station",
        "start, s",
        "end, s",
        "samples",
        "ax, raw",
        "ay, raw",
        "az, raw",
        "drifts",
    ]
    assert [row[0] for row in rows] == [str(i + 1) for i in range(12)]
    first, last = (np.array([number(row[i]) for row in rows]) for i in (1, 2))
    # within the standstill, and no more than a second and two cells of it cut off each end
    assert np.all((first > starts) & (first < starts + 1.5) & (last < ends) & (last > ends - 1.5))
    assert [int(row[3]) for row in rows] == (np.round(100 * (last - first)) + 1).tolist()
    cells = [[cell.split("±") for cell in row[4:7]] for row in rows]
    means, sd = (np.array([[number(c[i]) for c in row] for row in cells]) for i in (0, 1))
    assert np.abs(means - aims).max() < 5 * sd.max()
    # white noise of 5e-3 a sample
    one_sample = sd * np.sqrt([[int(row[3])] for row in rows])
    assert np.median(one_sample) == pytest.approx(5e-3, rel=0.1)
    share = 100 * (last - first).sum() / table.columns["time_s"][-1]
    assert f"12 stations found – at rest {share:.0f} % of the time" in page.text
    assert "T-7" in page.text
    assert "SIMULATED DATA" in page.text
    assert hashlib.sha256(log.read_bytes()).hexdigest() in page.text
    assert f"mwdcal calibrate {tmp_path / 'run.csv'} -o CAL.json" in page.text


def test_the_page_rounds_the_run_file(tmp_path):
    table, *_ = tumble(4, stations=6)
    warm = 20 + np.linspace(0, 6, len(table.columns["time_s"]))
    _, page, _ = shown(tmp_path, table, temperature_c=warm)
    header, *rows = page.rows["found"]
    run = read_csv(tmp_path / "run.csv")
    assert header[4:6] == ["T, °C", "its drift, °C"]
    for i, row in enumerate(rows):
        for cell, name in zip(
            row[1:6],
            ("start_s", "end_s", "samples", "temperature_c", "drift_temperature_c"),
            strict=True,
        ):
            assert abs(number(cell) - float(run[name][i])) <= 0.0051
        for cell, name in zip(row[6:9], ACC, strict=True):
            mean, sd = cell.split("±")
            unit = 10.0 ** -len(mean.partition(".")[2])
            assert abs(number(mean) - float(run[name][i])) <= 0.501 * unit
            assert abs(number(sd) - float(run[f"sd_{name}"][i])) <= 0.501 * unit
        assert row[9] == run["drifting"][i]


def test_a_log_without_a_standstill_has_its_page(tmp_path):
    table, *_ = tumble(3, stations=4)
    ran, page, _ = shown(tmp_path, table, "--min-seconds", 60)
    assert ran.code == 2
    assert "wrote" in ran.err
    assert "log.html (report)" in ran.err
    assert not (tmp_path / "run.csv").exists()
    assert "No standstill found in this log" in page.text
    assert "lower --min-seconds or --trim-seconds" in page.text
    assert "found" not in page.rows
    _, *left = page.rows["left"]
    assert len(left) == 4
    assert {row[3] for row in left} == {"too short once trimmed"}
    for start, end, lasts, _ in left:
        assert number(end) - number(start) == pytest.approx(number(lasts), abs=0.011)


def test_without_a_page_the_refusal_names_it(tmp_path):
    log = write_csv(tmp_path / "log.csv", tumble(3, stations=4)[0].columns)
    ran = mwdcal("stations", log, "-o", tmp_path / "run.csv", "--min-seconds", 60)
    assert "--report or --plot shows the log." in ran.err
    assert ran.code == 2


def test_one_station_leads_to_noise(tmp_path):
    columns = {"time_s": np.arange(3000) / 50}
    rng = np.random.default_rng(1)
    columns |= {
        name: at + 1e-3 * rng.normal(size=3000)
        for name, at in zip(ACC, (0.1, 0.2, 0.9), strict=True)
    }
    log = write_csv(tmp_path / "log.csv", columns)
    report = tmp_path / "log.html"
    assert mwdcal("stations", log, "-o", tmp_path / "run.csv", "--report", report).code == 0
    page = Page(report.read_text("utf-8"))
    assert len(page.rows["found"]) == 2
    assert "1 station found – at rest 97 % of the time" in page.text
    assert "mwdcal noise log.csv" in page.text
    assert "°C" not in page.text
    assert "SIMULATED" not in page.text


@pytest.mark.usefixtures("without_pictures")
def test_what_is_left_out_and_what_drifts_is_on_the_page(tmp_path):
    table, starts, ends, _ = tumble(8, stations=8)
    time = table.columns["time_s"]
    inside = (time > starts[2]) & (time < ends[2])
    creep = np.where(inside, 0.05 * (time - starts[2]) / (ends[2] - starts[2]), 0.0)
    ran, page, _ = shown(
        tmp_path, table, "--min-seconds", 6, "--json", ax=table.columns["ax"] + creep
    )
    assert len(page.rows["left"]) == 1 + len(ran.json["left"]) > 1
    assert "ax" in [row[-1] for row in page.rows["found"]]
    assert all(finding["text"] in page.text for finding in ran.json["findings"])
    assert "See the " in page.text
    assert ran.json["report"] == str(tmp_path / "log.html")


@pytest.mark.usefixtures("without_pictures")
def test_the_same_log_gives_the_same_page(tmp_path):
    table, *_ = tumble(3, stations=5)
    log = write_csv(tmp_path / "log.csv", table.columns, "date = 2026-03-04")
    pages = []
    for _ in range(2):
        report = tmp_path / "log.html"
        mwdcal("stations", log, "-o", tmp_path / "run.csv", "--report", report)
        pages.append(report.read_bytes())
    assert pages[0] == pages[1]
    assert "recorded 2026-03-04" in pages[0].decode()
    assert not re.search(rb"https?:|@import|<script[^>]|url\((?!#)", pages[0])


@pytest.mark.usefixtures("without_pictures")
def test_text_of_others_does_nothing(tmp_path):
    """Markup in every text that a log and its name can bring."""
    table, *_ = tumble(3, stations=4)
    serial = "serial = '</h1><script>alert(1)</script>{{ 7 * 7 }}'"
    date = "date = '<img src=x onerror=alert(2)>'"
    name = "<img src=x onerror=alert(3)>&amp;.csv"
    _, page, log = shown(tmp_path, table, metadata=(serial, date), name=name)
    assert page.active == ["script"]  # that of all pages
    assert "{{ 7 * 7 }}" in page.text
    assert log.name in page.text
    ran, page, _ = shown(tmp_path, table, "--min-seconds", 60, metadata=(serial, date), name=name)
    assert ran.code == 2
    assert page.active == ["script"]  # that of all pages


def boxes(drawn):
    """Names and places of the stations above the picture, in pixels."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(drawn)
    canvas.draw()
    top = drawn.axes[0]
    title = top.findobj(lambda artist: "stations taken" in getattr(artist, "get_text", str)())
    return {text: text.get_window_extent(canvas.get_renderer()) for text in (*top.texts, *title)}


@pytest.mark.parametrize("stations", [1, 12, 300])
def test_the_picture_is_legible(tmp_path, stations):
    table, *_ = tumble(5, stations=stations, hz=20.0)
    log = write_csv(
        tmp_path / ("a-name-of-a-log-that-is-far-too-long-for-one-line" * 2 + ".csv"), table.columns
    )
    drawn = figure(find_stations(logs.read(log, [])))
    places = boxes(drawn)
    edges = sorted((box.x0, box.x1) for text, box in places.items() if text.get_text().isdigit())
    assert len(edges) >= min(stations, 10)
    assert all(end < start for (_, end), (start, _) in pairwise(edges))
    for text, box in places.items():
        assert text.get_fontsize() >= 6.5
        assert -1 < box.x0 < box.x1 < drawn.bbox.width + 1


def test_a_page_never_replaces_the_log(tmp_path):
    log = write_csv(tmp_path / "log.csv", tumble(3, stations=4)[0].columns)
    message = refused(mwdcal("stations", log, "-o", tmp_path / "run.csv", "--report", log), 2)
    assert "would be lost" in message
