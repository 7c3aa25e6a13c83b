"""WITSML trajectories as they come: tie-in stations, several runs, statuses, covariance, and nothing lost."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
import pytest

from cli_support import mwdcal, read_csv, refused, write_csv
from mwdcal.files.formats.table import read, write
from mwdcal.survey.path import well_path
from simulation import attitude
from test_witsml import SERIES, ideal_calibration, same

pytest.importorskip("defusedxml")
RUNS = (slice(0, 8), slice(8, 15), slice(15, 21))
FIELD, DIP = 50_000.0, 60.0
WELLS = {
    "metres": {"unit": "m", "metres": 1.0, "north": "true north", "declination": 3.0, "convergence": None},
    "feet": {"unit": "ft", "metres": 0.3048, "north": "grid north", "declination": -4.0, "convergence": 1.5},
}  # fmt: skip


@pytest.fixture(scope="module")
def tool(tmp_path_factory):
    return ideal_calibration(tmp_path_factory.mktemp("tool"))


def drilled(facts):
    """Depths, angles from the north of the path and positions (m) of a well, from its surface to its end."""
    md = np.arange(22) * 30.0 + np.where(np.arange(22) > 9, 7.0, 0.0)
    inclination = np.linspace(3, 66, 22)
    azimuth = np.linspace(20, 60, 22) + (0 if facts["convergence"] is None else 30)
    return md, inclination, azimuth, well_path(md, np.radians(inclination), np.radians(azimuth))


def tie_in(facts, md, angles, place, covariance):
    length = f'uom="{facts["unit"]}"'
    depth, north, east, tvd = (repr(float(v) / facts["metres"]) for v in (md, *place))
    variances = "".join(
        f'<variance{name} uom="m2">{value!r}</variance{name}>'
        for name, value in zip(
            ("NN", "NE", "NVert", "EE", "EVert", "VertVert"), covariance, strict=True
        )
    )
    return (
        f'<trajectoryStation uid="tie"><typeTrajStation>tie in point</typeTrajStation><md {length}>{depth}</md>'
        f'<tvd {length}>{tvd}</tvd><incl uom="dega">{angles[0]!r}</incl><azi uom="dega">{angles[1]!r}</azi>'
        f"<dispNs {length}>{north}</dispNs><dispEw {length}>{east}</dispEw><matrixCov>{variances}</matrixCov>"
        "</trajectoryStation>"
    )


def station(facts, label, md, raw, status):
    names = (
        "gravTran1Raw",
        "gravTran2Raw",
        "gravAxialRaw",
        "magTran1Raw",
        "magTran2Raw",
        "magAxialRaw",
    )
    cells = "".join(
        f'<{name} uom="{"nT" if "mag" in name else "gn"}">{float(value)!r}</{name}>'
        for name, value in sorted(zip(names, raw, strict=True))
    )
    return (
        f'<trajectoryStation uid="{label}"><typeTrajStation>magnetic MWD</typeTrajStation>'
        f'<md uom="{facts["unit"]}">{float(md) / facts["metres"]!r}</md>{status}'
        '<gravTotalFieldReference uom="gn">1</gravTotalFieldReference>'
        f'<magTotalFieldReference uom="nT">{FIELD}</magTotalFieldReference>'
        f'<magDipAngleReference uom="dega">{DIP}</magDipAngleReference>'
        f"<rawData>{cells}</rawData></trajectoryStation>"
    )


def trajectories(folder, facts, covariance=(0.0,) * 6, rejected=()):
    """Three files of three runs, each with its tie-in station, as another program writes them."""
    md, inclination, azimuth, place = drilled(facts)
    turned = azimuth - facts["declination"] + (facts["convergence"] or 0.0)
    face = np.radians(np.arange(22) * 67.0)
    g, b = attitude(np.radians(inclination), np.radians(turned), face)(1.0, FIELD, np.radians(DIP))
    convergence = facts["convergence"]
    head = f'<magDeclUsed uom="dega">{facts["declination"]}</magDeclUsed>'
    head += "" if convergence is None else f'<gridConUsed uom="dega">{convergence}</gridConUsed>'
    files = []
    for i, rows in enumerate(RUNS, 1):
        first = rows.start
        at = (float(inclination[first]), float(azimuth[first]))
        inside = tie_in(facts, md[first], at, place[first], covariance if i == 1 else (0.0,) * 6)
        for k in range(rows.start + 1, rows.stop + 1):
            status = "<statusTrajStation>rejected</statusTrajStation>" if k in rejected else ""
            inside += station(facts, f"{i}-{k}", md[k], (*g[k], *b[k]), status)
        text = (
            '<?xml version="1.0"?><trajectorys xmlns="http://www.witsml.org/schemas/1series" version="1.4.1.1">'
            f'<trajectory uid="t{i}"><nameWell>W</nameWell><nameWellbore>B</nameWellbore><name>run {i}</name>{head}'
            f"<aziRef>{facts['north']}</aziRef>{inside}</trajectory></trajectorys>"
        )
        path = folder / f"run{i}.xml"
        path.write_text(text, "utf-8")
        files.append(path)
    return files


def typed(tool, files, out):
    runs = [part for file in files[1:] for part in ("--run", tool, file)]
    return ("survey", tool, files[0], *runs, "-o", out)


@pytest.mark.parametrize("name", WELLS)
def test_three_runs_with_tie_in_stations_are_one_well(tool, tmp_path, name):
    """Expected: minimum curvature of the hole as it was drilled, from the first tie-in station on."""
    facts = WELLS[name]
    md, inclination, _, place = drilled(facts)
    north = facts["north"].split()[0]
    out = tmp_path / "well.csv"
    ran = mwdcal(*typed(tool, trajectories(tmp_path, facts), out), "--json")
    assert ran.code == 0, ran
    columns = read_csv(out)
    surveys = [i for i, label in enumerate(columns["station"]) if label != "tie"]
    assert len(surveys) == 21
    for k, column in enumerate(("north_m", "east_m", "tvd_m")):
        values = [float(columns[column][i]) for i in surveys]
        np.testing.assert_allclose(values, place[1:, k], atol=2e-6)
    angles = [float(columns["inclination_deg"][i]) for i in surveys]
    np.testing.assert_allclose(angles, inclination[1:], atol=1e-6)
    ids = [finding["text"] for finding in ran.json["findings"]]
    assert not [text for text in ids if "tie-in" in text]
    assert ran.json["north"] == north
    assert [run["end"]["md_m"] for run in ran.json["runs"]] == pytest.approx(md[[8, 15, 21]])
    # tie-in stations keep their rows, with what they state
    assert columns["station"].count("tie") == 3
    assert float(columns["tvd_m"][0]) == pytest.approx(place[0, 2], abs=1e-9)
    assert float(columns[f"azimuth_{north}_deg"][9]) == pytest.approx(float(drilled(facts)[2][8]))


@pytest.mark.parametrize("name", WELLS)
def test_a_well_written_as_a_trajectory_has_covariance_and_loses_nothing(tool, tmp_path, name):
    facts = WELLS[name]
    files = trajectories(tmp_path, facts, rejected=(5, 17))
    out, again = tmp_path / "well.xml", tmp_path / "again.xml"
    unit = facts["unit"]
    ran = mwdcal(*typed(tool, files, out), "--length-unit", unit, "--json")
    assert ran.code == 0, ran
    table = read(out)
    write(again, table)
    assert again.read_bytes() == out.read_bytes()
    same(table, read(again))
    root = ElementTree.parse(out).getroot()
    stations = root.findall(f".//{SERIES}trajectoryStation")
    assert len(stations) == 24
    last = stations[-1]
    variance = last.find(f"{SERIES}matrixCov/{SERIES}varianceEE")
    assert variance.get("uom") == f"{unit}2"
    stated = ran.json["end"]["covariance_m2"][1][1] / facts["metres"] ** 2
    assert float(variance.text) == pytest.approx(stated, rel=1e-12)
    assert last.find(f"{SERIES}rawData/{SERIES}magAxialRaw") is not None
    statuses = [each.findtext(f"{SERIES}statusTrajStation") for each in stations]
    assert statuses.count("rejected") == 2
    columns = table.columns
    given = [cell for file in files for cell in read(file).columns["mz"].tolist()]
    np.testing.assert_array_equal(columns["mz"], given)
    rejected = [i for i, word in enumerate(statuses) if word == "rejected"]
    assert np.isnan(columns[f"north_{unit}"][rejected]).all()
    assert any("2 rejected" in f["text"] or "1 rejected" in f["text"] for f in ran.json["findings"])


def test_the_covariance_of_a_tie_in_adds_to_that_of_the_path(tool, tmp_path):
    facts, out = WELLS["metres"], tmp_path / "o.csv"
    known = (4.0, 1.0, 0.5, 9.0, -0.25, 2.25)
    tied = mwdcal("survey", tool, trajectories(tmp_path, facts, known)[0], "-o", out, "--json").json
    exact = mwdcal("survey", tool, trajectories(tmp_path, facts)[0], "-o", out, "--json").json
    added = np.subtract(tied["end"]["covariance_m2"], exact["end"]["covariance_m2"])
    whole = [[4.0, 1.0, 0.5], [1.0, 9.0, -0.25], [0.5, -0.25, 2.25]]
    np.testing.assert_allclose(added, whole, atol=1e-9)
    causes = {each["cause"]: each for each in tied["contributions"]["causes"]}
    assert causes["tie-in"]["sd_east_m"][-1] == pytest.approx(3.0)
    squares = sum(each["sd_tvd_m"][-1] ** 2 for each in tied["contributions"]["causes"])
    assert np.sqrt(squares) == pytest.approx(tied["end"]["sd_tvd_m"], rel=1e-5)
    bad = trajectories(tmp_path, facts, (4.0, 9.0, 0.0, 1.0, 0.0, 1.0))[0]
    assert "must not be negative" in refused(mwdcal("survey", tool, bad, "-o", out), 2)


def test_a_tie_in_that_cannot_be_used_is_named(tool, tmp_path):
    facts, out = WELLS["feet"], tmp_path / "o.csv"
    files = trajectories(tmp_path, facts)
    text = files[0].read_text("utf-8")
    files[0].write_text(text.replace('<gridConUsed uom="dega">1.5</gridConUsed>', ""), "utf-8")
    assert "grid north" in refused(mwdcal("survey", tool, files[0], "-o", out), 2)
    files[0].write_text(text.replace("<dispEw", "<dispXx").replace("</dispEw", "</dispXx"), "utf-8")
    ran = mwdcal("survey", tool, files[0], "-o", out, "--json")
    assert "tie-in-incomplete" in {each["id"] for each in ran.json["findings"]}
    moved = trajectories(tmp_path, facts)
    third = moved[0], moved[2]
    ran = mwdcal(*typed(tool, third, out), "--json")
    assert "tie-in-differs" in {each["id"] for each in ran.json["findings"]}


def test_statuses_of_a_table(tool, tmp_path):
    """Rejected and superseded surveys keep their rows and are not on the path; the words reach WITSML."""
    source, out = tmp_path / "in.csv", tmp_path / "o.xml"
    file = trajectories(tmp_path, WELLS["metres"])[0]
    columns = {n: c for n, c in read(file).columns.items() if not n.startswith("witsml")}
    rows = {name: list(cells[1:]) for name, cells in columns.items()}
    words = ["definitive", "rejected", "superseded", "", "Definitive", "", "", "definitive"]
    metadata = ('accelerometer_unit = "g"', 'magnetometer_unit = "nT"')
    write_csv(source, rows | {"status": words}, *metadata)
    ran = mwdcal("survey", tool, source, "-o", out, "--json")
    assert ran.code == 0, ran
    table = read(out)
    assert table.columns["status"] == words
    assert np.isnan(table.columns["north_m"]).tolist() == [False, True, True] + [False] * 5
    assert not np.isnan(table.columns["inclination_deg"]).any()
    elements = ElementTree.parse(out).getroot().findall(f".//{SERIES}statusTrajStation")
    assert [each.text for each in elements] == [
        "position",
        "rejected",
        "open",
        "position",
        "position",
    ]
    write_csv(source, rows | {"status": ["final"] * 8}, *metadata)
    assert "'final'" in refused(mwdcal("survey", tool, source, "-o", out), 2)


def test_a_sag_correction_of_the_trajectory_is_named(tool, tmp_path):
    """Its inclinations are of another program; ours come of the raw readings, without sag."""
    [file, *_] = trajectories(tmp_path, WELLS["metres"])
    text = file.read_text("utf-8")
    sags = iter(("0.07", "-0.12"))
    parts = text.split("<rawData>")
    for k in (1, 3):
        parts[k] = parts[k].replace(
            "</rawData>",
            f'</rawData><corUsed><sagIncCor uom="dega">{next(sags)}</sagIncCor></corUsed>',
            1,
        )
    file.write_text("<rawData>".join(parts), "utf-8")
    done = mwdcal("survey", tool, file, "-o", tmp_path / "well.csv")
    assert done.code == 0
    assert "corrects inclinations for sag, by up to -0.12°. mwdcal corrects no sag" in done.err
    assert (
        "sag-not"
        not in mwdcal(
            "survey", tool, trajectories(tmp_path, WELLS["metres"])[0], "-o", tmp_path / "w.csv"
        ).err
    )


def test_the_screen_says_where_and_from_which_north_the_path_is_tied_in(tool, tmp_path):
    """A tie-in turned by 3°, as from another north, bends the first course by 3° sin(inclination)."""
    [file, *_] = trajectories(tmp_path, WELLS["feet"])
    md, inclination, azimuth, place = drilled(WELLS["feet"])
    for turn in (0.0, 40.0):
        numbers = (md[0] / 0.3048, inclination[0], azimuth[0] + turn, *(place[0] / 0.3048))
        start = ",".join(f"{float(number):.6f}" for number in numbers)
        done = mwdcal(
            "survey",
            tool,
            file,
            "-o",
            tmp_path / "w.csv",
            "--length-unit",
            "ft",
            f"--tie-in={start}",
        )
        assert done.code == 0, done.err
        a, b = (np.radians([inclination[k], azimuth[k] + turn * (k == 0)]) for k in (0, 1))
        cosine = np.cos(a[0]) * np.cos(b[0]) + np.sin(a[0]) * np.sin(b[0]) * np.cos(b[1] - a[1])
        severity = np.degrees(np.arccos(cosine)) / ((md[1] - md[0]) / 30.48)
        north = f"azimuth {azimuth[0] + turn:.2f}° taken from grid north"
        words = f"{north}; {severity:.1f}°/100 ft from there to station 1-1"
        assert words in done.out.replace("\n", " ")
        assert "convergence +1.50°: magnetic −5.50°" in done.out.replace("\n", " ")
