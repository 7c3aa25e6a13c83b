"""What a fleet says of itself: options, choices, errors of the stand, noise that nobody declared."""

import html
import json
import os
import re
import statistics
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from cli_support import EXAMPLE, mwdcal
from test_fleet import short_run, write_fleet
from test_fleet_findings import said
from test_fleet_options import bent, drifting
from test_fleet_page import table_of, worst_tools

pq = pytest.importorskip("pyarrow.parquet")
pytestmark = pytest.mark.usefixtures("without_pictures")

from mwdcal.calibration.diagnosis.findings import REMARKS  # noqa: E402
from mwdcal.files.formats import table as tables  # noqa: E402
from mwdcal.presentation import (  # noqa: E402
    fleet_figures,
    fleet_page,
)
from mwdcal.use import plots  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]


def test_table_screen_page_and_summary_name_the_options(tmp_path):
    runs = {f"T{i}": short_run(i) for i in range(2)}
    options = ("--robust", "huber", "--parameters", 9, "--ignore", "dip", "--nonlinearity", "none")
    ran, page = said(tmp_path, runs, *options)
    line = "options: 9 parameters, without dip, robust (huber)"
    assert line in ran.out.splitlines()
    assert "9 parameters; without dip; robust (huber)" in page
    made = tables.read(tmp_path / "o.parquet").metadata["options"]
    ran, _ = said(tmp_path, runs, *options, "--json")
    assert ran.json["options"] == made
    alone = tmp_path / "alone.json"
    of_one = ("calibrate", EXAMPLE / "run.csv", "--tool", EXAMPLE / "tool.toml", *options, "-o")
    assert mwdcal(*of_one, alone).code == 0
    expected = json.loads(alone.read_bytes())
    assert {name: made[name] for name in expected["options"]} == expected["options"]
    assert (made["method"], made["order"], made["nonlinearity"]) == ("joint", 0, "none")
    ran, page = said(tmp_path, runs)
    assert "options:" not in ran.out
    assert "<dt>options</dt><dd>defaults</dd>" in page


def test_errors_of_the_stand_are_on_screen_and_page(tmp_path):
    runs = {f"T{i}": short_run(i) for i in range(5)}
    ran, page = said(tmp_path, runs, "--estimate", "azimuth-zero,tilt")
    for name in ("azimuth zero", "azimuth zero uncertainty", "tilt", "tilt azimuth"):
        assert f"stand: {name}, °" in ran.out
        assert f'<td class="text">{name}</td>' in page
    zeros = [row["azimuth_zero_deg"] for row in pq.read_table(tmp_path / "o.parquet").to_pylist()]
    assert f"{np.median(zeros):.2g}".replace("-", "−")[:3] in page


def test_tools_that_took_own_axis_terms_are_counted(tmp_path):
    runs = {"T0": short_run(0), "bent": bent(8, 0.004)}
    path = write_fleet(tmp_path / "runs.parquet", runs)
    given = ("--tool", EXAMPLE / "tool.toml", "--workers", 1, "--nonlinearity", "accelerometer")
    ran = mwdcal("fleet", path, "-o", tmp_path / "o.parquet", *given)
    assert "own-axis terms in 2 tools: accelerometer" in ran.out
    ran = mwdcal("fleet", path, "-o", tmp_path / "o.parquet", *given, "--json")
    assert ran.json["nonlinear"] == {"accelerometer": 2}


def test_a_tool_without_a_magnetometer_has_model_and_order(tmp_path):
    bare = drifting(4, 2) | dict.fromkeys(("mx", "my", "mz"), np.full(96, np.nan))
    _, page = said(tmp_path, {"whole": drifting(2, 2), "bare": bare}, "--order", "auto")
    whole, bare = pq.read_table(tmp_path / "o.parquet").to_pylist()
    assert (bare["status"], bare["magnetometer_order"]) == ("ok", None)
    assert bare["order"] == bare["accelerometer_order"] == 2
    assert bare["model"] == whole["model"] == "factors"
    assert "Chosen orders" in page


@pytest.mark.parametrize(("tool", "declared"), [("servo", True), ("generic", False)])
def test_estimated_noise_is_shown_where_residuals_cannot_be_judged(
    tmp_path, monkeypatch, tool, declared
):
    drawn = []

    def quality(panels, serials, doubtful):
        drawn.extend(panels)
        return plots.new_figure("", 1.0)[0]

    monkeypatch.setattr(fleet_figures, "draw_quality", quality)
    _, page = said(tmp_path, {f"T{i}": short_run(i) for i in range(4)}, "--tool", tool)
    triads = [] if declared else ["accelerometer", "magnetometer"]
    assert tables.read(tmp_path / "o.parquet").metadata["noise_estimated"] == triads
    assert ("No tool has residuals more" in page) == declared
    assert ("accelerometer and magnetometer is not declared" in page) == (not declared)
    made = pq.read_table(tmp_path / "o.parquet")
    if declared:
        assert set(drawn[1].series) == {"accelerometer", "magnetometer"}
        return
    shown = {name: values for panel in drawn[1:] for name, values in panel.series.items()}
    for triad, factor in zip(triads, (1e3, 1.0), strict=True):
        expected = made.column(f"{triad}_noise").to_numpy() * factor
        np.testing.assert_allclose(shown[triad], expected)


# The page says what an independent reader of the table counts


def mixed():
    """Sound, doubtful, refused and partly undetermined tools, one with a field of one, one without a magnetometer."""
    kicked = {name: np.array(values) for name, values in short_run(3).items()}
    kicked["ax"][5] += 0.05
    noisy = {name: np.array(values) for name, values in short_run(4).items()}
    noisy["mz"] = noisy["mz"] + np.random.default_rng(4).normal(0.0, 2e-3, 28)
    blank = np.full(28, np.nan)
    dead = short_run(6)
    dead["my"] = np.full(28, 1.5)
    hole = short_run(7)
    hole["az"] = np.append(hole["az"][:-1], np.nan)
    return {
        **{f"T{seed}": short_run(seed) for seed in range(3)},
        "kicked": kicked,
        "noisy": noisy,
        "no azimuth": short_run(5, ref_azimuth_deg=blank),
        "no toolface": short_run(8, ref_toolface_deg=blank, ref_azimuth_deg=blank),
        "relative": short_run(9, ref_field_nt=blank),
        "bare": short_run(10, mx=None, my=None, mz=None),
        "dead": dead,
        "hole": hole,
        "short": {name: values[:3] for name, values in short_run(11).items()},
    }


DOUBTFUL = {
    "accelerometer-residuals", "magnetometer-residuals", "no-redundancy", "repeated-readings", "prior-conflict",
}  # fmt: skip


def plain(page):
    """The text of a page."""
    return html.unescape(re.sub(r"<[^>]*>", "", page))


def check_page(page, rows):
    """Counts, accuracy and order of the worst tools against the rows of the table."""
    sound = [row for row in rows if row["status"] == "ok"]
    doubtful = [row for row in sound if DOUBTFUL & set(row["findings"])]
    text = plain(page)
    headline = f"{len(sound)} of {len(rows)} tools calibrated – "
    counts = {"refused": len(rows) - len(sound), "doubtful": len(doubtful)}
    shown = [f"{count} {word}" for word, count in counts.items() if count]
    assert headline + ", ".join([*shown, "none verified yet"]) in text
    for status, count in Counter(row["status"] for row in rows if row not in sound).items():
        assert re.search(rf"{count} tools? refused: [^()]*\({status}\)", text)
    for finding, count in Counter(f for row in sound for f in row["findings"]).items():
        kind = " doubtful" if finding in DOUBTFUL else ""
        assert re.search(rf"{count} tools?{kind}: .*?\({finding}\)", text)
    check_accuracy(page, sound)
    check_order(page, sound, doubtful)


def two_digits(value):
    """A standard uncertainty as pages state it."""
    return float(f"{value:.1e}")


def check_accuracy(page, sound):
    table = {row[0]: row[1:] for row in table_of(page, "outcome")}
    text = plain(page)
    for angle in ("inclination", "toolface", "azimuth"):
        column = [(row[f"{angle}_sd_deg"], row["serial"]) for row in sound]
        known = sorted((sd, serial) for sd, serial in column if sd is not None)
        free = [
            row for row in sound
            if row[f"{angle}_sd_deg"] is None and (angle != "azimuth" or row["field_unit"])
        ]  # fmt: skip
        middle, (worst, serial) = statistics.median(sd for sd, _ in known), known[-1]
        tools, median, _, highest, named, undetermined = table[angle]
        assert (int(tools), named) == (len(known), str(serial))
        assert undetermined == f"{len(free)} tool{'' if len(free) == 1 else 's'}"
        assert [float(median), float(highest)] == [two_digits(middle), two_digits(worst)]
        words = re.search(rf"{angle} (\S+)° median, (\S+)° worst", text)
        assert [*map(float, words.groups())] == [two_digits(middle), two_digits(worst)]


def check_order(page, sound, doubtful):
    worst = worst_tools(page)
    serials = [str(row["serial"]) for row in sound]
    assert set(worst) <= set(serials)
    assert len(worst) == min(len(serials), 25)
    first = list(worst)[: len(doubtful)]
    assert set(first) <= {str(row["serial"]) for row in doubtful}
    by_serial = {str(row["serial"]): row for row in sound}
    for serial, cells in worst.items():
        row = by_serial[serial]
        assert cells[0].startswith("▲") == (row in doubtful)
        for angle, cell in zip(("inclination", "toolface", "azimuth"), cells[1:], strict=False):
            sd = row[f"{angle}_sd_deg"]
            if sd is None:
                lacks = angle == "azimuth" and not row["field_unit"]
                assert cell == ("–" if lacks else "undetermined")
            else:
                assert float(cell) == two_digits(sd)
        for triad in ("accelerometer", "magnetometer"):
            times = re.search(rf"residuals of the {triad} are (\S+) times", cells[-1], re.I)
            assert bool(times) == (f"{triad}-residuals" in row["findings"])
            if times:
                square = float(times[1]) ** 2
                assert square == pytest.approx(row[f"{triad}_variance_factor"], rel=0.011)
        assert ("re-measure station" in cells[-1].lower()) == bool(row["reshoot"])


def test_the_page_says_what_the_table_holds(tmp_path):
    _, page = said(tmp_path, mixed())
    rows = pq.read_table(tmp_path / "o.parquet").to_pylist()
    assert {row["status"] for row in rows} >= {"ok", "bad-input", "channel", "too-few-stations"}
    check_page(page, rows)


def test_tools_of_different_orders_and_own_axis_terms_share_a_page(tmp_path):
    runs = {f"T{seed}": drifting(seed, power) for seed, power in enumerate((0, 1, 2))}
    runs["bent"] = bent(8, 0.004)
    _, page = said(
        tmp_path, runs, "--order", "auto", "--model", "polynomial", "--nonlinearity", "auto"
    )
    rows = pq.read_table(tmp_path / "o.parquet").to_pylist()
    assert len({row["accelerometer_order"] for row in rows if row["status"] == "ok"}) > 1
    check_page(page, rows)


def test_a_fleet_of_which_no_tool_is_calibrated(tmp_path):
    dead = {f"T{seed}": {**short_run(seed), "my": np.full(28, 1.5)} for seed in range(4)}
    path, page = write_fleet(tmp_path / "runs.parquet", dead), tmp_path / "fleet.html"
    given = ("--tool", "servo", "--workers", 1, "--report", page)
    assert mwdcal("fleet", path, "-o", tmp_path / "o.parquet", *given).code == 3
    text = plain(page.read_text("utf-8"))
    assert "0 of 4 tools calibrated" in text
    assert "None calibrated" in text
    assert "4 tools refused: a channel is dead" in text
    assert "<svg" not in page.read_text("utf-8")
    assert "Worst tools" not in text


def test_a_fleet_without_field_strength_and_one_without_magnetometers(tmp_path):
    blank = np.full(28, np.nan)
    runs = {f"T{seed}": short_run(seed, ref_field_nt=blank) for seed in range(4)}
    _, page = said(tmp_path, runs)
    check_page(page, pq.read_table(tmp_path / "o.parquet").to_pylist())
    assert "magnetometer, field = 1" in page
    bare = {f"T{seed}": short_run(seed, mx=None, my=None, mz=None) for seed in range(4)}
    _, page = said(tmp_path, bare)
    assert [row[0] for row in table_of(page, "outcome")] == ["inclination", "toolface"]
    assert all(len(row) == 4 for row in table_of(page, "worst"))


def test_one_tool(tmp_path):
    _, page = said(tmp_path, {"only": short_run(1)})
    [row] = pq.read_table(tmp_path / "o.parquet").to_pylist()
    text = plain(page)
    assert "1 of 1 tool calibrated – not verified yet" in text
    inclination = re.search(r"inclination (\S+)°; toolface", text)[1]
    assert float(inclination) == two_digits(row["inclination_sd_deg"])
    assert worst_tools(page)["only"][-1] == "Nothing unusual."


HOSTILE = (
    "<script>alert(1)</script>",
    "--><img src=x>",
    "\x1b[2Jerased",
    "a\u202eb",
    "&amp;\"'",
    "$x^2$ {{ 7*7 }}",
    "S" * 300,
)


def test_hostile_serials_are_harmless(tmp_path):
    """Every one of them once in a list, in the table of tools, and beside a figure."""
    runs = {name: short_run(seed) for seed, name in enumerate(HOSTILE)}
    for name, station in zip(HOSTILE[:4], (3, 9, 17, 20), strict=True):
        runs[name]["mx"] = np.array(runs[name]["mx"])
        runs[name]["mx"][station] += 0.4
    path, page = write_fleet(tmp_path / "runs.parquet", runs), tmp_path / "fleet.html"
    given = ("--tool", "servo", "--workers", 1, "--report", page)
    assert mwdcal("fleet", path, "-o", tmp_path / "o.parquet", *given).code == 0
    text = page.read_text("utf-8")
    assert not re.search("[\x00-\x09\x0b-\x1f\x7f\u202a-\u202e]", text)
    seen = Reader()
    seen.feed(text)
    assert "img" not in seen.elements
    assert text.count("<script") == 1  # that of all pages
    shown = " ".join(seen.text)
    for name in (*HOSTILE[:2], r"\x1b[2Jerased", r"a\u202eb", *HOSTILE[4:]):
        assert name in shown


class Reader(HTMLParser):
    """Elements and text of a page."""

    def __init__(self):
        super().__init__()
        self.elements, self.text = set(), []

    def handle_starttag(self, tag, attrs):
        self.elements.add(tag)

    def handle_data(self, data):
        self.text.append(data)


def test_the_page_has_its_dates_and_the_same_table_gives_the_same_bytes(tmp_path, monkeypatch):
    runs = {f"T{seed}": short_run(seed) for seed in range(2)}
    path = write_fleet(tmp_path / "runs.parquet", runs, {"date": "2026-03-04"})
    output, pages = tmp_path / "o.parquet", []
    original = fleet_page.render

    def render(calibrations, summary):
        os.utime(calibrations, (0, 1_700_000_000))  # 2023-11-14 22:13:20 UTC
        pages.extend(original(calibrations, summary) for _ in range(2))
        return pages[0]

    monkeypatch.setattr(fleet_page, "render", render)
    given = ("--tool", "servo", "--workers", 1, "--report", tmp_path / "fleet.html")
    for _ in range(2):
        assert mwdcal("fleet", path, "-o", output, *given).code == 0
    assert len(pages) == 4
    assert len(set(pages)) == 1
    assert "calibrations written 2023-11-14 22:13 UTC" in pages[0]
    assert "date of the runs: 2026-03-04" in pages[0]


def test_every_status_and_every_finding_has_its_sentence():
    documented = (ROOT / "docs" / "howto" / "fleet.md").read_text("utf-8")
    statuses = documented.partition("| status |")[2].partition("\n\n")[0]
    named = [re.findall(r"`([a-z-]+)`", row.split("|")[1]) for row in statuses.splitlines()[2:]]
    assert {name for names in named for name in names} - {"ok"} == set(fleet_page.REFUSED)
    assert set(REMARKS) <= set(fleet_page.REMARKED)
    page = (ROOT / "docs" / "reference" / "findings.md").read_text("utf-8")
    listed = set(re.findall(r"`([a-z-]+)`", page))
    for remark in REMARKS:
        names = {name for name in listed if name == remark or name.endswith(f"-{remark}")}
        assert names, remark
        assert all(" " in fleet_page.remark(name) for name in names)
        assert not any("{" in fleet_page.remark(name) for name in names)


def test_a_fleet_that_determines_no_angle(tmp_path):
    runs = {f"T{seed}": short_run(seed) for seed in range(3)}
    _, page = said(tmp_path, runs, "--method", "scalar")
    assert "inclination undetermined; toolface undetermined; azimuth undetermined" in plain(page)
    assert [row[5:] for row in table_of(page, "outcome")] == [["–", "3 tools"]] * 3
    for row in worst_tools(page).values():
        assert row[1:4] == ["undetermined"] * 3
        assert row[-1].startswith("Inclination, toolface, azimuth undetermined; nothing determines")
