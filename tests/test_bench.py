"""The session of the bench: stations from a stream, what survives, and what is refused. No browser."""

import errno
import json
import os
import re
import shlex
import socket
import threading
import time
from itertools import pairwise
from pathlib import Path
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest
from scipy import stats

import mwdcal as mwdcal_package
from bench_support import (
    EARTH,
    HEADER,
    BenchProcess,
    Stand,
    StandServer,
    lines_of,
    measure,
)
from bench_tables import ROLLS, RUN, laboratory_table
from cli_support import EXAMPLE, RAW, ROOT, mwdcal, process
from mwdcal import load_profile
from mwdcal.bench import documents, opening, pages, serving
from mwdcal.bench.attitude import has_turned
from mwdcal.bench.journal import Journal
from mwdcal.bench.session import BenchSession
from mwdcal.bench.settling import (
    FALSE_CREEP,
    FALSE_MOVE,
    Settling,
    _largest_scatter,
    _lower_quartile,
    _trend_in_noise,
)
from mwdcal.bench.sources import GrowingFile, Lines, SerialPort, Socket, source_of
from mwdcal.bench.spreadsheet import DroppedTable
from mwdcal.bench.stream import Stream
from mwdcal.bench.warmth import Warmth
from mwdcal.certificate import signature
from mwdcal.errors import InputError
from mwdcal.logs.stations import means_of
from mwdcal.sensor.profile import StreamForm
from simulation import DEG

TOOL = EXAMPLE / "tool.toml"
PLAN = "twenty-four-state"
SERVO = Path(mwdcal_package.__file__).parent / "profiles" / "servo.toml"


def session_in(folder, plan=PLAN, start=True, tool=None, **options):
    """A session with a tool on the servo's scales; one that was begun there before goes on."""
    folder.mkdir(exist_ok=True)
    (folder / "tool.toml").write_text(tool or TOOL.read_text())
    profile = load_profile(folder / "tool.toml")
    planned = opening.session_plan(profile, plan)
    session = BenchSession(folder, profile, planned, opening.rolltest_plan(), window=2.0, **options)
    if start and not session.facts:
        session.start("T-1", "A. Example", earth=EARTH)
    elif start:
        session.resume()
    return session


@pytest.fixture(autouse=True)
def plans_once_and_papers_without_pictures(computed_once, without_pictures):
    """Papers of `finished` are drawn, and those in the browser."""


@pytest.fixture
def session(tmp_path):
    opened = session_in(tmp_path / "S")
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A session up to the roll test, two stations of which were knocked and measured again, and its stand."""
    folder, stand = tmp_path_factory.mktemp("bench") / "S", Stand()
    session = session_in(folder)
    session.line(0.0, HEADER)
    named = []
    while session.order is not None:
        knocked = session.order in (7, 15) and session.order not in session.part.done
        measure(session, stand, (1.5, 1.5, 1.5) if knocked else (0, 0, 0), seconds=3)
    session.wait_for_fits()
    named = [*session.bad]
    session.measure_again()
    while session.order is not None:
        measure(session, stand, seconds=3)
    session.calibrate()
    session.wait_for_fits()
    yield session, stand, named
    session.close()


def without_time(path):
    content = json.loads(Path(path).read_text("utf-8"))
    return {name: value for name, value in content.items() if name not in ("time", "sha256")}


# ------------------------------------------------------------------ the whole


def test_the_two_knocked_stations_are_named_and_no_other(finished):
    session, _, named = finished
    assert named == ["8", "16"]
    assert session.calibrated
    assert session.bad == {}


def test_the_calibration_is_as_accurate_as_it_says(finished):
    """Angles of noise-free readings at other attitudes, by formulas of their own, against the true ones."""
    session, stand, _ = finished
    inc, azi, face = (
        np.array(a) * DEG
        for a in ([45.0] * 6, [10, 70, 130, 190, 250, 310], [5, 65, 125, 185, 245, 305])
    )
    columns = np.concatenate(stand.tool.clean(inc, azi, face), -1)
    g, b = session.fit.calibration.fields(columns)
    east = np.cross(g, b)
    north = np.cross(east, g) / np.linalg.norm(g, axis=-1, keepdims=True)
    axis_north, axis_east = north[:, 2], east[:, 2]
    got = {
        "inclination": np.arctan2(np.hypot(g[:, 0], g[:, 1]), g[:, 2]) - inc,
        "toolface": np.arctan2(-g[:, 0], -g[:, 1]) - face,
        "azimuth": np.arctan2(axis_east, axis_north) - azi,
    }
    for name, error in got.items():
        error = np.degrees((error + np.pi) % (2 * np.pi) - np.pi)
        stated = session.fit.accuracy_deg[name]
        assert np.abs(error).max() < 4 * stated, (name, error, stated)
        assert stated < 0.05


def test_the_calibration_is_that_of_the_command(finished, tmp_path):
    session, *_ = finished
    run, again = session.folder / "run.csv", tmp_path / "again.json"
    ran = mwdcal("calibrate", run, "--tool", session.folder / "tool.toml", "-o", again)
    assert ran.code == 0, ran
    assert without_time(session.folder / "tool.json") == without_time(again)


@pytest.mark.slow
def test_roll_test_certificate_and_registry(finished, tmp_path):
    session, stand, _ = finished
    session.registry = str(tmp_path / "tools.sqlite")
    session.start_rolltest()
    while session.order is not None:
        measure(session, stand, seconds=3)
    session.wait_for_fits()
    assert session.verdict.passed
    ran = mwdcal("verify", session.folder / "tool.json", session.folder / "rolltest.csv", "--json")
    rows = {row["name"]: row["value"] for row in ran.json["rows"]}
    assert {row.name: row.value for row in session.verdict.rows} == pytest.approx(rows)
    session.certify("C-1")
    session.wait_for_fits()
    assert json.loads((session.folder / "certificate.json").read_text())["number"] == "C-1"
    listed = mwdcal("registry", "list", "--registry", session.registry, "--json").json
    assert [tool["serial"] for tool in listed["tools"]] == ["T-1"]
    with pytest.raises(InputError, match="certificate is issued"):
        session.reopen()


# ------------------------------------------------------------------ the start and the end


def key_of(folder, owner):
    created = mwdcal("certificate", "key", "create", "-o", folder / "k.key", "--owner", owner)
    assert created.code == 0, created
    return folder / "k.key"


def to_the_verdict(finished, folder, knocked=(), **options):
    """A session that goes on with the run of another, up to the verdict of its roll test.

    The tool is knocked at some positions of the test.
    """
    done, stand, _ = finished
    folder.mkdir()
    kept = [e for e in done.journal.events if e["event"] in ("started", "station", "again")]
    kept = [event for event in kept if event.get("part", "run") == "run"]
    (folder / "session.jsonl").write_text("".join(json.dumps(event) + "\n" for event in kept))
    session = session_in(folder, **options)
    session.line(0.0, HEADER)
    session.calibrate()
    session.wait_for_fits()
    session.start_rolltest()
    while (order := session.order) is not None:
        measure(session, stand, (1.5, 1.5, 1.5) if order in knocked else (0, 0, 0), seconds=3)
    session.wait_for_fits()
    return session


def test_a_failed_roll_test_names_the_station_to_look_at(finished, tmp_path):
    """The station that was knocked, what the readings look like, the next step; measured again, the test passes."""
    session = to_the_verdict(finished, tmp_path / "S", knocked=(3,))
    assert not session.verdict.passed
    page = pages.fragment(session, "")
    assert "A limit is exceeded, most at station 4. Check the setting of the stand there" in page
    assert "farthest off: spread of inclination" in page
    assert "No single fault explains these readings" in page
    session.measure_again()
    assert (session.order, session.verdict, session.bad) == (3, None, {})
    measure(session, finished[1], seconds=3)
    session.wait_for_fits()
    assert session.verdict.passed
    assert "station 4." not in pages.fragment(session, "")
    session.close()


@pytest.mark.slow
def test_as_found_and_a_second_signature(finished, tmp_path):
    """The calibration before judges the same roll test; the operator's own key is refused, the second person's signs,
    and only then the registry is written."""
    done, _, _ = finished
    database = str(tmp_path / "tools.sqlite")
    before = json.loads((done.folder / "tool.json").read_text())
    with mwdcal_package.registry(database, create=True) as tools:
        tools.add(done.folder / "tool.json")
    (tmp_path / "S").mkdir()
    opening.keep_previous(tmp_path / "S", database, "T-1", simulated=False)
    previous = (tmp_path / "S/previous.json").read_bytes()
    (tmp_path / "S/previous.json").unlink()
    (tmp_path / "S").rmdir()
    assert json.loads(previous)["sha256"] == before["sha256"]
    key = key_of(tmp_path, "A. Example")
    session = to_the_verdict(finished, tmp_path / "S", registry=database, countersign=key)
    assert session.as_found is None
    (session.folder / "previous.json").write_bytes(previous)
    session._judge()
    expected = mwdcal_package.verify(
        previous_of(tmp_path, previous), session.folder / "rolltest.csv", "roll-test"
    )
    assert [row.value for row in session.as_found.rows] == [row.value for row in expected.rows]
    session.certify("C-2")
    page = pages.fragment(session, "")
    assert "Certificate as PDF: being written" in page
    assert "Passphrase" not in page  # the key has none
    signature.create(tmp_path / "safe.key", "C. Third", "a word")
    assert documents.asks_passphrase(tmp_path / "safe.key")
    session.wait_for_fits()
    certificate = json.loads((session.folder / "certificate.json").read_text())
    assert certificate["as_found"]
    assert session.waits_for_signature
    with pytest.raises(InputError, match="nothing to enter"):
        session.enter()
    with pytest.raises(InputError, match="that of the operator"):
        session.sign()
    key.unlink()
    (tmp_path / "k.key.pub").unlink()
    session.countersign = key_of(tmp_path, "B. Second")
    session.sign()
    session.wait_for_fits()
    assert "registry" in session.papers
    checked = mwdcal(
        "certificate",
        "verify",
        session.folder / "certificate.json",
        "--key",
        tmp_path / "k.key.pub",
    )
    assert checked.code == 0, checked
    listed = json.loads((session.folder / "certificate.json").read_text())["files"]
    assert {"tool.json", "verification.json"} <= {
        file["name"] for file in listed
    }  # from its folder
    pdf = session.folder / "certificate.pdf"
    assert pdf.exists()
    checked = mwdcal("certificate", "verify", pdf, "--key", tmp_path / "k.key.pub")
    assert checked.code == 0, checked
    with pytest.raises(InputError, match="waits for a signature"):
        session.sign()
    session.close()


@pytest.mark.slow
def test_a_certificate_that_was_cut_off_gets_its_page_and_pdf(finished, tmp_path, monkeypatch):
    """Power goes after the certificate: the next start writes its page and its PDF."""
    session = to_the_verdict(finished, tmp_path / "S")
    with monkeypatch.context() as patch:
        patch.setattr(BenchSession, "_draw_certificate", lambda session: None)
        session.certify("C-3")
        session.wait_for_fits()
    assert {name for name in session.papers if "certificate" in name} == {"certificate"}
    session.close()
    issued = (session.folder / "certificate.json").read_bytes()
    session = session_in(session.folder)
    session.wait_for_fits()
    assert session.papers["certificate_pdf"] == "certificate.pdf"
    assert "C-3" in (session.folder / session.papers["certificate_html"]).read_text("utf-8")
    assert (session.folder / "certificate.json").read_bytes() == issued
    session.close()


def previous_of(folder, data):
    (folder / "before.json").write_bytes(data)
    return mwdcal_package.load(folder / "before.json")


def test_the_tool_of_a_registry_brings_its_profile(finished, tmp_path):
    """Its past is shown, newest first, and its profile is that of its latest calibration."""
    done, *_ = finished
    database = str(tmp_path / "tools.sqlite")
    with mwdcal_package.registry(database, create=True) as tools:
        tools.add(done.folder / "tool.json", done.folder / "run.csv")
    folder = tmp_path / "S"
    folder.mkdir()
    (folder / "tool.toml").write_bytes(SERVO.read_bytes())
    servo, test = load_profile(SERVO), opening.rolltest_plan()
    session = BenchSession(
        folder, servo, opening.session_plan(servo, PLAN), test, registry=database
    )
    with pytest.raises(InputError, match="no calibration of this tool"):
        session.start("T-1", tool="registry")
    session.choose("T-1")
    assert {each.kind for each in session.past.records} == {"calibration", "run"}
    with pytest.raises(InputError, match="serial"):
        session.start(" ", tool="registry")
    session.start("T-1", tool="registry", plan="moosavi-12")
    assert session.profile == load_profile(folder / "tool.toml") == done.profile
    assert session.plan.name == "moosavi-12"
    session.close()


def test_an_own_profile_and_an_own_plan(tmp_path):
    session = session_in(tmp_path / "S", start=False)
    with pytest.raises(InputError, match="axes"):
        session.start("T-1", tool_text='name = "x"\n[accelerometer]\naxes = ["+x"]\n')
    assert session.profile.name == load_profile(TOOL).name
    plan = "ref_inclination_deg,ref_azimuth_deg,ref_toolface_deg\n" + "10,20,30\n40,50,60\n" * 6
    with pytest.raises(InputError, match=r"\.csv"):
        session.start("T-1", plan_file=("mine.exe", plan))
    own = TOOL.read_text().replace('name = "', 'name = "own ', 1)
    session.start("T-1", tool_text=own, plan_file=("mine.csv", plan))
    assert load_profile(session.folder / "tool.toml").name.startswith("own ")
    assert session.plan.name == "mine"
    assert session.part.attitude(1) == (40.0, 50.0, 60.0)
    session.close()


def test_another_uncertainty_of_the_stand(tmp_path):
    """A 1σ that is typed goes into the tool profile of the session, with which the plan is judged; no other changes."""
    from mwdcal.bench.server import Bench

    session = session_in(tmp_path / "S", start=False)
    before, expected = session.profile, session.plan.accuracy_deg["azimuth"]
    bench = Bench(session, source_of("manual"), ["localhost:1"])
    shown = dict(pages.stand_fields(session))
    for text in ("-1", "0", "x"):
        with pytest.raises(InputError, match="1σ of azimuth"):
            bench.decide("start", {"serial": "T-1", **shown, "stand_azimuth_deg": text})
    assert (session.folder / "tool.toml").read_text() == TOOL.read_text()
    bench.decide("start", {"serial": "T-1", **shown, "stand_azimuth_deg": "0.7"})
    stand = msgspec.structs.replace(before.stand, azimuth_deg=0.7)
    assert load_profile(session.folder / "tool.toml") == session.profile
    assert session.profile == msgspec.structs.replace(before, stand=stand)
    assert session.plan.accuracy_deg["azimuth"] > expected  # the plan is planned anew
    session.close()


@pytest.mark.slow
def test_the_fewest_stations_reach_the_accuracy():
    profile = load_profile(SERVO)
    plan = opening.session_plan(profile, "azimuth_deg=0.05")
    assert plan.accuracy_deg["azimuth"] <= 0.05
    rougher = opening.session_plan(profile, "azimuth_deg=0.2")
    assert len(rougher.columns["ref_inclination_deg"]) <= len(plan.columns["ref_inclination_deg"])


def test_a_profile_without_noise_has_best_stations_and_no_accuracy():
    """The page could not say that the noise is assumed."""
    known = load_profile(SERVO)
    change, triads = msgspec.structs.replace, ("accelerometer", "magnetometer")
    bare = change(known, **{name: change(getattr(known, name), noise=None) for name in triads})
    plan = opening.session_plan(bare, "best-12")
    assert len(plan.columns["ref_inclination_deg"]) == 12
    assert not plan.accuracy_deg
    assert opening.session_plan(known, "best-12").accuracy_deg


# ------------------------------------------------------------------ decisions


def accept_some(session, stand, count):
    for _ in range(count):
        measure(session, stand, seconds=3)


def test_a_session_goes_on_after_a_restart(session):
    stand = Stand()
    session.line(0.0, HEADER)
    accept_some(session, stand, 3)
    session.skip()
    session.switch("auto", True)
    session.wait_for_fits()
    rows = lines_of(session.folder / "run.csv")
    session.close()
    again = session_in(
        session.folder, plan="moosavi-12", start=False
    )  # the plan is that of the session
    assert again.waiting
    assert again.plan.name == PLAN
    assert (again.order, again.auto, again.facts["serial"]) == (4, True, "T-1")
    assert lines_of(again.folder / "run.csv") == rows
    with pytest.raises(InputError, match="Resume"):
        again.accept()
    again.resume()
    again.line(0.0, HEADER)
    again.switch("auto", False)
    measure(again, stand, seconds=3)
    assert len(again.part.done) == 4
    again.close()


def test_a_last_line_that_was_cut_off_is_taken_away(session):
    session.line(0.0, HEADER)
    accept_some(session, Stand(), 2)
    session.close()
    path = session.folder / "session.jsonl"
    whole = path.read_bytes()
    for cut in (1, 20, len(whole.splitlines()[-1])):
        path.write_bytes(whole[:-cut])
        again = session_in(session.folder)
        assert len(again.part.done) == 1
        again.close()
        assert path.read_bytes().endswith(b"}\n")
    path.write_bytes(whole.replace(b'"event"', b'"evnt"', 1))
    with pytest.raises(InputError, match="line 1"):
        Journal(session.folder)


def test_a_standstill_is_one_station(session):
    """A pedal that bounces, a second browser, and an old page cannot take it twice."""
    session.line(0.0, HEADER)
    stand = Stand()
    attitude = session.part.attitude(0)
    for line in stand.lines(attitude):
        session.line(0.0, line)
    with pytest.raises(InputError, match="shown station 6"):
        session.accept(5)
    session.accept(0)
    with pytest.raises(InputError, match="shown station 1"):
        session.accept(0)
    with pytest.raises(InputError, match="has not moved"):
        session.accept(1)
    assert [*session.part.done] == [0]


def knocked(session, stand):
    """A knock of the tool where it stands ends the standstill; then it settles there again."""
    here = stand.here
    for attitude in (np.add(here, 1.5), here):
        for line in stand.lines(tuple(attitude), move=0.5, seconds=4):
            session.line(0.0, line)


@pytest.mark.parametrize("axes", ['"+x", "+y", "+z"', '"-x", "+z", "+y"'])
def test_a_tool_that_was_only_knocked_is_not_the_next_station(tmp_path, monkeypatch, axes):
    """Nominal signs that are right, or wrong: the reading of the station before tells; also after a restart."""
    tool = TOOL.read_text().replace('"+x", "+y", "+z"', axes, 1)
    clock = [100.0]
    monkeypatch.setattr("mwdcal.bench.session.monotonic", lambda: clock[0])
    session, stand = session_in(tmp_path / "S", tool=tool), Stand()
    session.line(0.0, HEADER)
    for line in stand.lines(session.part.attitude(0)):
        session.line(0.0, line)
    if '"-x"' in axes:
        with pytest.raises(InputError, match="nominal calibration"):
            session.accept(0)
        clock[0] += 2
    session.accept(0)
    knocked(session, stand)
    session.switch("auto", True)
    knocked(session, stand)
    session.switch("auto", False)
    assert session.settling.moves >= 2
    assert session.away == "not_turned"
    with pytest.raises(InputError, match="still stands at station 1. Turn it to station 2"):
        session.accept(1)
    clock[0] += 0.3
    with pytest.raises(InputError, match="still stands"):  # the pedal bounces
        session.accept(1)
    session.close()
    session = session_in(session.folder, tool=tool)
    session.line(0.0, HEADER)
    for line in stand.lines(stand.here):
        session.line(0.0, line)
    with pytest.raises(InputError, match="still stands"):
        session.accept(1)
    clock[0] += 2
    session.accept(1)
    assert session.journal.events[-1]["doubt"] == "not_turned"
    assert "doubt" not in session.part.done[1].row
    session.close()


def test_a_tool_in_another_attitude_is_asked_about_but_not_by_wrong_signs(tmp_path, monkeypatch):
    """The signs are wrong: the first stations are asked about, the others are not; none is taken for the one before."""
    clock = [100.0]
    monkeypatch.setattr("mwdcal.bench.session.monotonic", lambda: clock[0])
    session, stand, asked = session_in(tmp_path / "A"), Stand(), 0
    session.line(0.0, HEADER)
    for line in stand.lines((60.0, 10.0, 10.0)):
        session.line(0.0, line)
    with pytest.raises(InputError, match="not at station 1 by its nominal calibration"):
        session.accept(0)
    session.close()
    wrong = TOOL.read_text().replace('"+x", "+y", "+z"', '"+x", "-z", "+y"', 1)
    session = session_in(tmp_path / "B", tool=wrong)
    session.line(0.0, HEADER)
    while session.order is not None:
        clock[0] += 100.0
        for line in stand.lines(session.part.attitude(session.order), seconds=5):
            session.line(0.0, line)
        far = session.away
        assert far in ("", "not_there")
        if far:
            with pytest.raises(InputError, match="nominal calibration"):
                session.accept()
            clock[0] += 2.0
            asked += 1
        session.accept()
    assert 1 <= asked <= 3
    session.close()


@pytest.mark.parametrize("dip", [65.0, None])
@pytest.mark.parametrize("plan", ["twenty-four-state", "moosavi-12", "acceptance-104"])
def test_a_turn_is_told_from_a_knock(plan, dip):
    """Between all neighbours of a plan that are 6° apart in gravity or field, by vectors of another formula."""
    profile, stand = load_profile(TOOL), Stand(5)
    columns = opening.session_plan(profile, plan).columns
    names = ("ref_inclination_deg", "ref_azimuth_deg", "ref_toolface_deg")
    rows = zip(*(columns[name] for name in names), strict=True)
    attitudes = [tuple(value or 0.0 for value in row) for row in rows]

    def vectors(attitude):
        inc, azi, face = (np.array([value * DEG]) for value in attitude)
        return [v[0] / np.linalg.norm(v) for v in stand.tool.clean(inc, azi, face)]

    def raw(attitude):
        return dict(zip(RAW, map(float, stand.line(attitude).split(",")[1:7]), strict=True))

    told = 0
    for one, other in pairwise(attitudes):
        pairs = zip(vectors(one), vectors(other), strict=True)
        if max(np.degrees(np.arccos(np.clip(a @ b, -1, 1))) for a, b in pairs) < 6:
            continue
        told += 1
        ends = other, one
        assert has_turned(raw(other), raw(one), profile, ends, dip), ends
        assert not has_turned(raw(np.add(one, 1.5)), raw(one), profile, ends, dip), ends
    assert told > 10


@pytest.mark.parametrize("size", [1.5, 5.0])
@pytest.mark.parametrize("samples", [50, 200])
def test_bad_stations_do_not_hide_each_other(tmp_path, size, samples):
    """Stations 8 and 16 are off; one hides the other in a long standstill, and far off they prevent the fit.

    The stand sets a roll once, as the simulated one does, so that a bad station looks like a bad setting.
    """
    (tmp_path / "tool.toml").write_bytes(SERVO.read_bytes())
    plan, stand = opening.session_plan(load_profile(SERVO), PLAN).columns, Stand()
    rng, names = np.random.default_rng(1), ("inclination", "azimuth", "toolface")
    angles = np.transpose([plan[f"ref_{name}_deg"] for name in names]).astype(float)
    off = rng.normal(size=(24, 3)) * (0.01, 0.05, 0.02)
    for i in range(1, 24):
        if (angles[i, :2] == angles[i - 1, :2]).all():
            off[i, :2] = off[i - 1, :2]
    off[[7, 15]] += size
    lines = [HEADER.replace("time_s", "station") + "".join(f",sd_{name}" for name in RAW)]
    lines[0] += (
        "".join(f",ref_{name}_deg" for name in names) + ",ref_gravity_g,ref_field_nt,ref_dip_deg"
    )
    for i, attitude in enumerate(angles):
        many = [stand.line(attitude + off[i]).split(",")[1:] for _ in range(samples)]
        table = np.array(many, float)
        sd = table[:, :6].std(0, ddof=1) / np.sqrt(samples)
        lines.append(",".join(map(str, (i + 1, *table.mean(0), *sd, *attitude, *EARTH.values()))))
    (tmp_path / "run.csv").write_text("\n".join(lines) + "\n")
    fit = documents.fit(tmp_path, 24)
    assert {*fit.bad} == {"8", "16"}


def test_undo_gives_a_former_station_back(session):
    session.line(0.0, HEADER)
    stand = Stand()
    accept_some(session, stand, 2)
    before = session.part.done[1].row
    session.measure_again()
    assert session.order == 1
    measure(session, stand, seconds=3)
    assert session.part.done[1].row != before
    session.undo()
    assert session.part.done[1].row == before
    assert session.order == 1  # it is still asked for
    session.undo()
    session.undo()
    assert session.part.done == {}
    session.wait_for_fits()
    assert not (session.folder / "run.csv").exists()
    with pytest.raises(InputError, match="no station to take back"):
        session.undo()


@pytest.mark.slow
def test_a_bad_station_that_is_found_late_is_measured_again(finished, tmp_path):
    """Back to the run after calibration and roll test; the roll test is judged again without being measured again."""
    done, stand, _ = finished
    folder = tmp_path / "S"
    folder.mkdir()
    kept = [e for e in done.journal.events if e.get("files", {}).get("certificate") is None]
    kept = [e for e in kept if "registry" not in e.get("files", {})]
    (folder / "session.jsonl").write_text("".join(json.dumps(event) + "\n" for event in kept))
    for file in (done.folder / name for name in ("tool.json", "verification.json")):
        if file.exists():  # the verdict only where the test above has run in this process
            (folder / file.name).write_bytes(file.read_bytes())
    session = session_in(folder)
    session.line(0.0, HEADER)
    session.start_rolltest()
    while session.order is not None:
        measure(session, stand, seconds=3)
    session.wait_for_fits()
    assert session.verdict is not None
    before = json.loads((folder / "tool.json").read_text())["run_sha256"]
    session.reopen()
    session.measure_again(3)
    measure(session, stand, seconds=3)
    session.calibrate()
    session.wait_for_fits()
    assert json.loads((folder / "tool.json").read_text())["run_sha256"] != before
    session.start_rolltest()
    session.wait_for_fits()
    assert session.verdict is not None
    session.repeat_rolltest()
    assert session.verdict is None
    assert session.order == 0
    papers = session.papers
    session.close()
    session = session_in(folder)
    assert session.papers == papers  # a restart knows no verdict of the test that was cleared
    session.close()


def test_nothing_is_accepted_on_a_full_disk(session, monkeypatch):
    session.line(0.0, HEADER)
    stand = Stand()
    accept_some(session, stand, 1)
    size = (session.folder / "session.jsonl").stat().st_size
    for line in stand.lines(session.part.attitude(1)):
        session.line(0.0, line)

    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(InputError, match="No space left.*nothing was accepted"):
            session.accept()
    assert (session.folder / "session.jsonl").stat().st_size == size
    assert [*session.part.done] == [0]
    session.accept()
    assert [*session.part.done] == [0, 1]
    assert len(lines_of(session.folder / "session.jsonl")) == 3


def test_a_station_in_the_journal_is_safe_where_the_run_file_cannot_be_written(
    session, monkeypatch
):
    session.line(0.0, HEADER)
    stand = Stand()
    accept_some(session, stand, 1)
    with monkeypatch.context() as patch:
        refuse = InputError("cannot write 'run.csv': No space left on device. Make room.")
        patch.setattr("mwdcal.bench.session.tables.write", lambda *_: (_ for _ in ()).throw(refuse))
        measure(session, stand, seconds=3)
        session.wait_for_fits()
        assert "safe in session.jsonl" in session.message
    accept_some(session, stand, 1)
    session.wait_for_fits()
    rows = [line for line in lines_of(session.folder / "run.csv") if line[:1].isdigit()]
    assert len(rows) == 3


def test_stations_come_by_themselves(session):
    session.line(0.0, HEADER)
    session.switch("auto", True)
    stand = Stand()
    for line in stand.lines((90.0, 0.0, 0.0)):  # not the position that is asked for
        session.line(0.0, line)
    assert session.away == "not_there"
    for _ in range(3):
        for line in stand.lines(session.part.attitude(session.order)):
            session.line(0.0, line)
    assert [*session.part.done] == [0, 1, 2]
    session.switch("paused", True)
    for line in stand.lines(session.part.attitude(3)):
        session.line(0.0, line)
    assert len(session.part.done) == 3


def test_a_clock_that_starts_again_stops_nothing(session):
    session.line(0.0, HEADER)
    session.switch("auto", True)
    stand = Stand()
    stand.time = 1e6
    for _ in range(2):
        for line in stand.lines(session.part.attitude(session.order)):
            session.line(0.0, line)
        stand.time = 0.0
    assert len(session.part.done) == 2


def test_an_oven_has_to_be_warm(tmp_path):
    session = session_in(tmp_path / "S", plan="laboratory-thermal")
    session.line(0.0, HEADER)
    session.switch("auto", True)
    warm = session.part.temperature(0)
    stand = Stand(temperature=warm + 10)
    for line in stand.lines(session.part.attitude(0)):
        session.line(0.0, line)
    assert session.away == "not_warm"
    stand.temperature = warm
    for line in stand.lines(session.part.attitude(0), seconds=60):
        session.line(0.0, line)
    assert len(session.part.done) == 1
    assert session.part.is_new_soak(
        next(i for i in range(48) if session.part.temperature(i) != warm)
    )
    session.close()


def test_a_temperature_that_the_stream_has_not_is_typed(tmp_path):
    session = session_in(tmp_path / "S")
    names = ",".join(HEADER.split(",")[:-1])
    stand = Stand(stream=names)
    session.line(0.0, names)
    session.state_temperature(31.5)
    accept_some(session, stand, 1)
    assert session.part.done[0].row["temperature_c"] == 31.5
    session.close()


def test_simulated_and_real_readings_do_not_mix(tmp_path):
    bench = serving.bench_of(tmp_path, {"source": "demo"}, "127.0.0.1", 1)
    bench.session.start("D", "", "", {})
    bench.session.close()
    with pytest.raises(InputError, match="do not mix"):
        serving.bench_of(tmp_path, {"source": "manual"}, "127.0.0.1", 1)
    again = serving.bench_of(tmp_path, {}, "127.0.0.1", 1)
    assert again.session.source == "demo"
    again.session.close()


# ------------------------------------------------------------------ standing still


def fed(values, rate=10.0, window=3.0, least=None):
    """The states of a channel, one a sample, and the judge at the end."""
    judge = Settling(1, window, [least or 0.0])
    states = []
    for i, value in enumerate(values):
        judge.take(i / rate, (float(value),))
        states.append(judge.state)
    return states, judge


@pytest.mark.parametrize("seconds", [1.0, 3.0, 60.0, 300.0])
def test_a_tool_that_turns_is_never_settled(seconds):
    """Gravity turns about the tool axis, by a radian in so many seconds, in noise of 0.1 mg."""
    rng, judge, states = np.random.default_rng(1), Settling(3, 3.0), []
    for i, noise in enumerate(rng.normal(0, 1e-4, (1200, 3))):
        angle = i / 10 / seconds
        judge.take(i / 10, tuple(map(float, np.array([np.sin(angle), np.cos(angle), 0.3]) + noise)))
        states.append(judge.state)
    assert "settled" not in states


def test_a_tool_at_rest_settles():
    states, _ = fed(np.random.default_rng(1).normal(0, 1e-4, 1200))
    assert states[50:].count("settled") > 0.9 * len(states[50:])


def test_a_creeping_stand_is_waited_for():
    """A displacement of 20 times the noise dies away with τ = 8 s, seen through windows of 5 s.

    The trend over n = 50 samples has a standard deviation of √(12/n) = 0.49 of the noise; one of three times that,
    1.47, is refused. So much is left of an exponential as its change times τ/5 s = 1.6. Of 20 stands, each looked at
    about five times a standstill apart, the luckiest has its trend 2.6 of these deviations too small (one in a
    hundred): 1.6·(1.47 + 2.6·0.49) = 4.4, and 3·√(1/n) = 0.4 for the mean itself. On the average a look is one
    deviation too small at most, as the first that passes is taken: 1.6·(1.47 + 0.49) = 3.1.
    """
    time, left = np.arange(1500) / 10, []
    away = np.where(
        time < 40, 0.0, np.where(time < 44, (time - 40) * 250, 1000 + 20 * np.exp((44 - time) / 8))
    )
    for seed in range(20):
        noise = np.random.default_rng(seed).normal(0, 1.0, len(time))
        judge = Settling(1, 5.0, [0.0])
        for t, value in zip(time, away + noise, strict=True):
            judge.take(t, (value,))
            if t > 46 and judge.state == "settled":
                break
        assert judge.state == "settled"
        left.append(judge.means[0] - 1000)
    assert np.max(np.abs(left)) < 4.8
    assert np.mean(np.abs(left)) < 3.1


def noisy(rng, count, rate, seconds, sensors=1):
    """White noise, or AR(1) noise of a correlation time in seconds, of variance 1 (count, sensors)."""
    noise = rng.normal(size=(count, sensors))
    share = np.exp(-1 / rate / seconds) if seconds else 0.0
    for i in range(1, count):
        noise[i] = share * noise[i - 1] + np.sqrt(1 - share**2) * noise[i]
    return noise


def standstills(rate, seconds=0.0, step=0.0, count=100, sensors=1):
    """The judge of sensors, settled after each of so many moves, and where they really stand."""
    rng, judge, time, here = np.random.default_rng(7), Settling(sensors, 5.0), 0.0, 0.0
    for _ in range(count):
        goal = rng.uniform(-1000, 1000)
        course = np.concatenate([np.linspace(here, goal, 4 * rate), np.full(40 * rate, goal)])
        values = course[:, None] + noisy(rng, len(course), rate, seconds, sensors)
        values, here = np.round(values / step) * step if step else values, goal
        for i, row in enumerate(values.tolist()):
            judge.take(time, row)
            time += 1 / rate
            if i > 5 * rate and judge.state == "settled":
                break
        assert judge.state == "settled"
        yield judge, goal


def errors_of_means(rate, seconds=0.0, step=0.0):
    """Errors of the means of standstills of a sensor, a tool that moves between them, over their uncertainty."""
    rests, truths = [], []
    for judge, goal in standstills(rate, seconds, step):
        still = judge.station()
        rests.append((still.time, still.samples[:, 0]))
        truths.append(goal)
    row = means_of({"ax": rests}, {"ax": still.steps[0]})["ax"]
    return (row.mean - truths) / row.sd


@pytest.mark.parametrize("rate", [5, 10, 50])
@pytest.mark.parametrize("step", [0.0, 1e-3, 5.0])
def test_the_stated_uncertainty_of_a_mean_holds(rate, step):
    """Means of 100 standstills in white noise of 1 against the truth: errors over the stated uncertainty.

    Their rms exceeds sqrt(149.4/100) = 1.22 once in a thousand times, and is under 0.79 as seldom (χ²). Student's
    factor for 25 samples or more takes at most 5 % off. A step of five times the noise hides more than the noise: only
    the upper bound holds there.
    """
    errors = errors_of_means(rate, step=step)
    assert np.sqrt(np.mean(errors**2)) < 1.22
    if step != 5.0:
        assert np.sqrt(np.mean(errors**2)) > 0.79 * 0.95


@pytest.mark.slow
@pytest.mark.parametrize("rate", [10, 50])
@pytest.mark.parametrize("seconds", [0.05, 0.3, 1.0])
def test_the_uncertainty_holds_correlated_noise(rate, seconds):
    """AR(1) noise: of a hundred means 87 or more are within 1.96 of their uncertainty, as all but one in a thousand
    samples of a hundred are where 95 % are."""
    assert stats.binom.cdf(86, 100, 0.95) < 1e-3
    assert np.mean(np.abs(errors_of_means(rate, seconds)) < 1.96) >= 0.87


@pytest.mark.parametrize("rate", [10, 50])
def test_noise_that_wanders_is_said(rate):
    """Its correlation time is a whole standstill: most standstills say so, and hardly one in white noise."""
    said = [np.mean([j.wanders for j, _ in standstills(rate, s, 0.0, 24, 6)]) for s in (5.0, 0.0)]
    assert said[0] > 0.7
    assert said[1] < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("rate", [10, 50])
@pytest.mark.parametrize("seconds", [0.0, 0.3, 1.0])
def test_a_tool_at_rest_is_seldom_said_to_move_or_to_creep(rate, seconds):
    """Of 400 cells of six sensors in white or AR(1) noise: no more than so many times chance ends a standstill, or has
    the tool wait, as happens once in a thousand times. Neighbouring looks share nine of ten cells: of the looks a
    tenth are independent."""
    rng, judge, waits, looks = np.random.default_rng(11), Settling(6, 5.0), 0, 0
    for i, row in enumerate(noisy(rng, 200 * rate, rate, seconds, 6)):
        judge.take(i / rate, tuple(map(float, row)))
        if i > 20 * rate and i % (rate // 2) == 0:
            looks, waits = looks + 1, waits + (judge.state != "settled")
    assert judge.moves <= stats.binom.isf(1e-3, 400, FALSE_MOVE)
    assert waits <= 10 * stats.binom.isf(1e-3, looks // 10, FALSE_CREEP)


@pytest.mark.parametrize("count", range(1, 10))
def test_lower_quartiles_are_those_of_numpy(count):
    values = np.random.default_rng(count).normal(size=(count, 6))
    expected = np.quantile(values, 0.25, axis=0)
    np.testing.assert_allclose(_lower_quartile(values), expected, rtol=1e-14)


@pytest.mark.parametrize("step", [3.0, 10.0])
@pytest.mark.parametrize("turn", [0.0, 1.0])
def test_readings_coarser_than_correlated_noise(step, turn):
    """One sensor rests between two steps, and flips in AR(1) noise of 0.3 s, five read the same: the tool has settled.

    One that turns by a step a second has not.
    """
    rng, judge, looks = np.random.default_rng(5), Settling(6, 5.0), []
    course = step * turn * np.arange(3000)[:, None] / 50 + [step / 2, 0, 0, 0, 0, 0]
    for i, row in enumerate(noisy(rng, 3000, 50, 0.3, 6) + course):
        judge.take(i / 50, tuple(map(float, np.round(row / step) * step)))
        looks += [judge.state == "settled"] if i > 500 else []
    assert np.mean(looks) == 0.0 if turn else np.mean(looks) > 0.8


def test_the_limit_of_scatter_is_that_of_fisher():
    for freedom, known in ((4.0, 5.0), (24.0, 20.0), (2.5, 10.0)):
        quartile = stats.chi2.ppf(0.25, freedom) / freedom
        exact = np.sqrt(stats.f.isf(1e-4, freedom, known * freedom) / quartile)
        assert _largest_scatter(freedom, known, 1e-4) == pytest.approx(exact)


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.8])
def test_a_trend_in_correlated_noise(correlation):
    """Moments of the residuals and of the slope and curve, of simulated noise, against those that are stated."""
    rng, form = np.random.default_rng(2), _trend_in_noise(10)
    place = int(form.place(np.array([correlation]))[0])
    share = form.grid[place]
    noise = rng.normal(size=(10, 40_000))
    for i in range(1, 10):
        noise[i] = share * noise[i - 1] + np.sqrt(1 - share**2) * noise[i]
    fit = np.polynomial.legendre.legfit(np.arange(10) - 4.5, noise, 2)
    left = noise - np.polynomial.legendre.legval(np.arange(10) - 4.5, fit).T
    squares = np.sum(left**2, 0)
    assert form.left[place] == pytest.approx(squares.mean(), rel=0.02)
    assert form.variance[0, place] == pytest.approx(82.5 * fit[1].var(), rel=0.03)  # Σ x² = 82.5
    assert form.variance[1, place] == pytest.approx(1188 * fit[2].var(), rel=0.03)  # Σ (P2 - mean)²
    assert form.ratio[place] == pytest.approx(
        (left[1:] * left[:-1]).sum(0).mean() / squares.mean(), abs=0.01
    )
    assert form.freedom[place] == pytest.approx(2 * squares.mean() ** 2 / squares.var(), rel=0.05)


def test_a_gap_ends_a_standstill():
    judge = Settling(1, 2.0, [1e-4])
    rng = np.random.default_rng(1)
    for i in range(60):
        judge.take(i / 10, (float(rng.normal(0, 1e-3)),))
    assert judge.state == "settled"
    judge.take(20.0, (0.0,))
    assert judge.state == "moving"
    assert judge.moves == 1


def test_minutes_to_equilibrium():
    """Exponential warming with τ = 5 min: the rate falls to 0.2 °C/min when the closed form says so."""
    warmth, tau = Warmth(), 300.0
    for second in range(900):
        warmth.take(float(second), 100 - 80 * np.exp(-second / tau))
    rate = 80 / tau * 60 * np.exp(-900 / tau)
    assert warmth.rate == pytest.approx(rate, rel=0.15)
    assert warmth.minutes_left == pytest.approx(tau / 60 * np.log(rate / 0.2), abs=1.5)
    assert not warmth.is_steady


# ------------------------------------------------------------------ lines


def test_forms_of_lines():
    stated = Stream(
        StreamForm(
            columns=("time_s", "ax", "x", "ay", "az", "temperature_c"),
            separator=";",
            units={"temperature_c": "°F"},
        )
    )
    sample = stated.take("5; 1;9;2;3; 50")
    assert sample.time == 5
    assert sample.values == pytest.approx((1, 2, 3, 10))
    pattern = Stream(StreamForm(pattern=r"A (?P<ax>\S+) (?P<ay>\S+) (?P<az>\S+)"))
    assert pattern.take("> A 1 2 -3.5 *").values == (1, 2, -3.5)
    assert pattern.take("> B") is None
    header = Stream()
    assert header.take("AX,AY,AZ,status") is None
    assert header.take("1,2,3,4").values == (1, 2, 3)
    assert header.take("AX,AY,AZ,status") is None  # once more after a reconnect
    assert header.garbage == 0
    learned = Stream()
    taken = [learned.take("1 2 3 4 5 6 20") for _ in range(7)]
    assert learned.channels == (*RAW, "temperature_c")
    assert taken[-1].values == (1, 2, 3, 4, 5, 6, 20)


GARBAGE = (
    "",
    " ",
    "x",
    "1,2",
    "nan," * 7 + "nan",
    "1e400," * 7 + "1",
    "1,,3,4,5,6,7,8",
    "\x00\ufffd",
    "9" * 5000,
    "-,-",
    "1e300,1e300,1e300,1e300,1e300,1e300,1e300,1e300",
)


def fuzzed_lines(rng, count):
    good = Stand().line((45.0, 10.0, 20.0))
    for _ in range(count):
        if rng.random() < 0.3:
            yield str(rng.choice(GARBAGE))
        else:
            letters = list(good)
            for _ in range(rng.integers(0, 6)):
                letters[rng.integers(len(letters))] = chr(int(rng.integers(1, 0x250)))
            yield "".join(letters)


def test_no_line_breaks_a_session(session):
    session.switch("auto", True)
    for number, line in enumerate(
        fuzzed_lines(np.random.default_rng(1), int(os.environ.get("FUZZED", "400")))
    ):
        session.line(number / 10, line)
        if number % 50 == 0:
            session.line(number / 10, HEADER)
    assert "internal error" not in session.message
    assert session.stream.garbage > 50
    session.switch("auto", False)
    measure(session, Stand(), seconds=4)


def collected(source, count, seconds=20.0):
    """So many lines of a source, with its stop event."""
    stop, lines = threading.Event(), []
    for _, line in source.lines(stop):
        lines.append(line)
        if len(lines) >= count:
            stop.set()
    return lines


def test_lines_are_cut_at_any_end():
    lines = Lines()
    pieces = (b"a,1\r", b"\nb,2\nc", b",3\rd,4", b"\n")
    assert [line for piece in pieces for line in lines.take(piece)] == ["a,1", "b,2", "c,3", "d,4"]
    assert Lines(midway=True).take(b"9,9\n1,2\n") == ["1,2"]
    endless = Lines()
    for _ in range(100):
        endless.take(b"x" * 1000)
    assert len(endless.rest) < 5000


def test_a_growing_file_may_be_cut_or_replaced(tmp_path):
    path = tmp_path / "stream.csv"
    path.write_text("1\n2\n")

    def write():
        time.sleep(0.3)
        with path.open("a") as stream:
            stream.write("3\n")
        time.sleep(0.5)
        other = tmp_path / "other.csv"
        other.write_text("4\n5\n")
        other.replace(path)

    writer = threading.Thread(target=write)
    writer.start()
    source = GrowingFile(path)
    assert collected(source, 5) == ["1", "2", "3", "4", "5"]
    assert source.drops == 1
    writer.join()


def test_a_tcp_connection_is_made_again():
    server = StandServer(speed=20)
    source = Socket("127.0.0.1", server.port)
    threading.Timer(0.5, server.drop).start()
    lines = collected(source, 400)
    assert source.drops == 1
    assert lines.count(HEADER) == 2
    server.close()


@pytest.mark.slow
def test_a_serial_port_with_garbage_and_silence(session):
    """One line in ten has a damaged byte, and the line is silent for three seconds (`DROPOUT` of them) twice."""
    pytest.importorskip("serial", reason="pyserial is not installed")
    pty = pytest.importorskip("pty", reason="no pseudo-terminals here")
    master, slave = pty.openpty()
    source = SerialPort(os.ttyname(slave), 115_200)
    rng, stand, stop = np.random.default_rng(2), Stand(), threading.Event()
    session.line(0.0, HEADER)
    session.switch("auto", True)

    def send(line):
        data = bytearray(line.encode() + b"\r\n")
        for place in range(len(data)):
            if rng.random() < 0.01 / len(line) * 10:
                data[place] = rng.integers(1, 255)
        os.write(master, bytes(data))

    def read():
        for now, line in source.lines(stop):
            session.line(now, line)

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    time.sleep(0.3)
    for number in range(4):
        silence = float(os.environ.get("DROPOUT", "3")) + 0.5 if number in (1, 3) else 0
        for index, line in enumerate(stand.lines(session.part.attitude(session.order), seconds=9)):
            if silence and index == 40:
                time.sleep(silence)
                stand.time += silence
            send(line)
            time.sleep(0.002)
        limit = time.monotonic() + 5
        while len(session.part.done) <= number and time.monotonic() < limit:
            send(stand.line(stand.here))
            time.sleep(0.005)
    stop.set()
    assert [*session.part.done] == [0, 1, 2, 3]
    assert session.stream.garbage > 0
    reader.join(5)
    os.close(slave)
    os.close(master)


def test_sources_are_named():
    for text in ("serial:/dev/ttyUSB0@9600", "tcp:[::1]:5000", "tail:x.csv", "manual"):
        assert source_of(text) is not None
    for text in ("", "tcp:host", "tcp:host:99999", "tail:", "usb:1"):
        with pytest.raises(InputError, match="Correct it"):
            source_of(text)


# ------------------------------------------------------------------ the server

client_of = pytest.importorskip("starlette.testclient", reason="starlette is not installed")
HOST = "127.0.0.1:8000"


@pytest.fixture
def bench(tmp_path):
    opened = serving.bench_of(tmp_path, {"source": "manual", "tool": str(TOOL)}, "127.0.0.1", 8000)
    yield opened
    opened.stop.set()


@pytest.fixture
def client(bench):
    with client_of.TestClient(bench.app(), base_url=f"http://{HOST}") as client:
        client.get(f"/?token={bench.token}")
        yield client


def post(client, bench, name, headers=None, **form):
    return client.post(f"/do/{name}", data={"token": bench.token, **form}, headers=headers or {})


def drop(client, bench, kind, name, data):
    given = {"params": {"name": name}, "headers": {"x-bench-token": bench.token}}
    return client.post(f"/table/{kind}", content=data, **given)


def test_who_has_no_token_is_refused(bench):
    with client_of.TestClient(bench.app(), base_url=f"http://{HOST}") as client:
        for path in (
            "/",
            "/events",
            "/static/bench.js",
            "/files/run.csv",
            "/?token=x",
            "/?token=é",
        ):
            assert client.get(path).status_code == 403, path
        assert post(client, bench, "start", serial="T").status_code == 403
        client.get(f"/?token={bench.token}")
        assert client.get("/").status_code == 200
        assert client.post("/do/start", data={"serial": "T"}).status_code == 403
    assert bench.session.facts == {}


@pytest.mark.parametrize(
    "headers",
    [{"host": "evil.example:8000"}, {"host": "127.0.0.1:9"}, {"host": ""}, {"origin": "http://evil.example"},
     {"origin": "null"}, {"origin": "http://["}, {"sec-fetch-site": "cross-site"}, {"sec-fetch-site": "same-site"}],
)  # fmt: skip
def test_other_sites_are_refused(client, bench, headers):
    assert post(client, bench, "start", headers, serial="T").status_code in (403, 421)
    assert bench.session.facts == {}


def test_a_get_changes_nothing(client, bench):
    for name in ("start", "undo", "calibrate"):
        assert client.get(f"/do/{name}?token={bench.token}&serial=T").status_code == 405
    assert bench.session.journal.events == []


def test_everywhere_means_any_address_and_no_name():
    from mwdcal.bench.server import Bench

    bench = Bench(Mock(folder=Path("nowhere")), Mock(), ["0.0.0.0:80"], any_address=True)
    assert bench.answers_to("192.168.1.7:80")
    assert bench.answers_to("[fe80::1]:80")
    assert not bench.answers_to("evil.example:80")
    assert serving.address("0.0.0.0", 80, "t").startswith("http://")
    assert "0.0.0.0" not in serving.address("0.0.0.0", 80, "t")


def test_headers_keep_the_page_to_itself(client, bench):
    answer = client.get("/")
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert "http" not in re.sub(r"http://www.w3.org/\S+", "", answer.text)


def test_a_run_by_hand(client, bench):
    """Typed and pasted readings, one of them with decimal commas, to a calibration."""
    assert post(
        client, bench, "start", serial="T-1", **{k: str(v) for k, v in EARTH.items()}
    ).is_success
    stand, session = Stand(), bench.session

    def reading():
        position = session.part.open_positions[len(rows)]
        return stand.line(session.part.attitude(position)).split(",")[1:]

    rows: list[str] = []
    rows.append(" ".join(reading()))
    rows.append("\t".join(reading()).replace(".", ","))
    rows.append("; ".join(reading()))
    assert post(client, bench, "typed", reading="1 2 x 4 5 6").status_code == 409
    assert post(client, bench, "typed", reading="1 2").status_code == 409
    assert post(client, bench, "typed", reading="\n".join(rows) + "\n1 2").status_code == 409
    assert session.part.done == {}
    assert post(client, bench, "typed", reading="\n".join(rows), position="0").is_success
    assert len(session.part.done) == 3
    assert session.part.done[1].row["az"] == pytest.approx(
        float(rows[1].split()[2].replace(",", "."))
    )
    rows = []
    while len(rows) < 21:
        rows.append(", ".join(reading()))
    assert post(client, bench, "typed", reading="\n".join(rows)).is_success
    session.wait_for_fits()
    assert session.fit.calibration is not None
    page = client.get("/").text
    assert "All stations are measured" in page
    assert post(client, bench, "calibrate").is_success
    session.wait_for_fits()
    assert "Calibrated: T-1" in client.get("/").text
    assert client.get("/files/tool.json").status_code == 200
    for name in ("session.jsonl", "tool.toml", "../tool.json", "%2e%2e%2fx"):
        assert client.get(f"/files/{name}").status_code == 404


def test_no_request_is_an_internal_error(client, bench):
    rng = np.random.default_rng(int(os.environ.get("SEED", "5")))
    names = [*bench._forms, *bench._buttons, *bench._tables, "", "nothing", "..", "é"]
    values = [
        "",
        "0",
        "1e9",
        "-1",
        "nan",
        "x" * 90_000,
        "\x00",
        "é",
        "1 2 3 4 5 6",
        "1,2\n3",
        "99999999999999999999",
    ]
    fields = [
        "serial",
        "operator",
        "plan",
        "position",
        "on",
        "reading",
        "number",
        "temperature",
        "question",
        "place",
        "name",
        *EARTH,
    ]
    table = laboratory_table(Stand(), RUN[:16])
    for _ in range(int(os.environ.get("FUZZED", "400"))):
        chosen = rng.choice(fields, rng.integers(0, 5))
        form = {str(name): str(rng.choice(values)) for name in chosen}
        path = f"/{rng.choice(['do', 'files', 'static', 'table', 'table/files', 'x'])}/{rng.choice(names)}"
        kind = rng.integers(0, 7)
        if kind == 0:
            short = {name: value[:200] for name, value in form.items()}
            answer = client.get(path.replace("\x00", ""), params=short)
        elif kind == 1:
            answer = client.request(str(rng.choice(["PUT", "DELETE", "PATCH", "OPTIONS"])), path)
        elif kind == 2:
            answer = client.post(path, content=rng.bytes(int(rng.integers(0, 200))))
        elif kind == 3:
            damaged = bytearray(table)
            for _ in range(int(rng.integers(0, 9))):
                damaged[rng.integers(len(damaged))] = rng.integers(256)
            answer = drop(
                client, bench, "file", str(rng.choice(["a.csv", "b.xlsx", ""])), bytes(damaged)
            )
            answer = client.get("/table") if answer.status_code < 500 else answer
        else:
            answer = client.post(path, data={"token": bench.token, **form})
        assert answer.status_code < 500, (path, form, answer.text)
        assert "internal error" not in answer.text
    bench.session.wait_for_fits()
    assert "internal error" not in bench.session.message


# ------------------------------------------------------------------ a table


def on_table(client, bench, name, **form):
    return client.post(f"/table/{name}", data={"token": bench.token, **form})


def test_a_table_to_its_certificate(client, bench, tmp_path):
    """Dropped, asked about, calibrated, verified, documented: what the commands make of the same table."""
    stand, folder = Stand(), bench.table.folder
    run = laboratory_table(stand, RUN)
    assert "/table" not in re.findall('href="(.*?)"', bench.fragment())
    assert drop(client, bench, "file", "../Mess 1.csv", run).is_success
    assert "/table" in re.findall('href="(.*?)"', bench.fragment())  # what browsers are sent
    page = client.get("/table").text
    assert "Which one does the stand show?" in page
    assert on_table(client, bench, "calibrate").status_code == 409
    assert drop(client, bench, "rolltest", "r.csv", run).status_code == 409
    assert on_table(client, bench, "answer", question="7", place="0").status_code == 409
    assert on_table(client, bench, "answer", question="0", place="0").is_success
    page = client.get("/table").text
    heads = re.findall(r'<th scope="col" class="k-(\w+)">(.*?)<br><small>(.*?)</small>', page)
    kinds = {name: kind for kind, name, _ in heads}
    assert [kinds[name] for name in ("Gx (V)", "Hz (V)", "Neigung (°)", "Azimut 2 (°)")] == [
        "accelerometer", "magnetometer", "reference", "unused",
    ]  # fmt: skip
    assert ("reference", "Azimut (°)", "ref_azimuth_deg [°]") in heads
    assert on_table(client, bench, "calibrate").is_success
    assert bench.table.fit.reason == ""
    given, ours = folder / "given" / "Mess 1.csv", tmp_path / "by-command.toml"
    answers = ("--column", "ref_azimuth_deg=Azimut (°)")
    assert mwdcal("profile", given, "-o", ours, *answers).code == 0
    assert (folder / "tool.toml").read_text() == ours.read_text()
    ran = mwdcal("calibrate", given, "--tool", ours, "-o", tmp_path / "t.json")
    assert ran.code == 0
    assert without_time(folder / "tool.json") == without_time(tmp_path / "t.json")
    rolls = laboratory_table(stand, ROLLS, clear=True)
    off = laboratory_table(stand, [*ROLLS[:3], (61.5, 31.5, 91.5)], clear=True).splitlines()[-1]
    lines = rolls.splitlines()
    lines[6] = b";".join([*off.split(b";")[:8], *lines[6].split(b";")[8:]])  # knocked
    assert drop(client, bench, "rolltest", "off.csv", b"\n".join(lines)).is_success
    page = client.get("/table").text
    assert "FAIL" in page
    assert "A limit is exceeded, most at station 4." in page
    assert "No single fault explains these readings" in page
    with pytest.MonkeyPatch.context() as patch:  # one diagnosis for all views
        patch.setattr("mwdcal.bench.documents.failure", None)
        assert client.get("/table").text == page
    assert drop(client, bench, "rolltest", "roll.csv", rolls).is_success
    assert "PASS<" in client.get("/table").text
    cells = [line.split(b";") for line in rolls.splitlines()]
    without_azimuth = b"\n".join(b";".join([*row[:9], *row[10:]]) for row in cells)
    assert drop(client, bench, "rolltest", "part.csv", without_azimuth).is_success
    assert "PASS (not judged: spread of azimuth, error of azimuth)<" in client.get("/table").text
    assert drop(client, bench, "rolltest", "roll.csv", rolls).is_success
    assert on_table(client, bench, "certificate", number="C-7").is_success
    assert json.loads((folder / "certificate.json").read_text())["number"] == "C-7"
    assert client.get("/table/files/certificate.json").is_success
    for name in ("table.json", "tool.toml", "given", "..%2ftool.toml"):
        assert client.get(f"/table/files/{name}").status_code == 404
    again = DroppedTable(folder, None, None)
    assert again.verdict.passed
    assert again.papers == bench.table.papers
    assert again.questions == ()


def test_tables_that_are_none_and_uploads_of_others(client, bench):
    for name, data in (
        ("x.csv", b"\x00\xff" * 99),
        ("x.xlsx", b"PK no"),
        ("x.exe", b"1"),
        ("", b"1"),
        ("x.csv", b""),
    ):
        drop(client, bench, "file", name, data)
        page = client.get("/table")
        assert page.is_success
        assert on_table(client, bench, "calibrate").status_code == 409
    for headers in (
        {},
        {"x-bench-token": "x"},
        {"x-bench-token": bench.token, "origin": "http://evil.example"},
    ):
        refused = client.post("/table/file?name=a.csv", content=b"1;2", headers=headers)
        assert refused.status_code == 403
    assert client.post("/table/file?name=a.csv", content=b"1" * 70_000).status_code == 413
    many = {"x-bench-token": bench.token}
    assert (
        client.post("/table/file?name=a.csv", content=b"1" * 20_000_001, headers=many).status_code
        == 413
    )
    assert on_table(client, bench, "nothing").status_code == 404
    assert client.get(f"/table/file?token={bench.token}").status_code == 405


@pytest.mark.slow
def test_two_benches_on_one_folder_are_refused(tmp_path):
    first = BenchProcess("--source", "manual", folder=tmp_path / "S")
    try:
        second = process("bench", "--no-browser", "--session", tmp_path / "S", timeout=60)
        assert second.returncode == 2
        assert "another bench" in second.stderr
    finally:
        first.stop()


def test_the_start_says_which_settings_are_used(tmp_path, monkeypatch):
    (tmp_path / "mwdcal.toml").write_text("[stand]\ntilt_deg = 0.01\n")
    monkeypatch.chdir(tmp_path)
    bench = BenchProcess("--demo", folder=tmp_path / "S")
    assert f"Settings of {tmp_path / 'mwdcal.toml'}: stand.tilt_deg" in bench.page()
    bench.stop()


@pytest.mark.slow
def test_kills_lose_no_station(tmp_path):
    """The small twin of `python tests/bench_kills.py --count 200`."""
    import bench_kills

    assert bench_kills.run(count=4, seed=1, folder=tmp_path) == []


def read_of(process, source):
    """How many bytes of a file a process has read."""
    for link in (process / "fd").iterdir():
        if link.is_symlink() and link.readlink() == source:
            return int((process / "fdinfo" / link.name).read_text().split()[1])
    return 0


@pytest.mark.study
def test_eight_hours_leave_the_memory_flat(tmp_path):
    """Eight hours of 50 Hz from a file: memory within 20 MB after a tenth; a quarter of a core at real time."""
    if not Path("/proc/self/statm").exists():
        pytest.skip("memory is looked at in /proc")
    hours, rate, folder = float(os.environ.get("HOURS", "8")), 50, tmp_path / "S"
    count, source = int(hours * 3600 * rate), tmp_path / "stream.csv"
    stand, rng = Stand(), np.random.default_rng(1)
    block = [stand.line((45.0, 10.0, 20.0)).split(",", 1)[1] for _ in range(5000)]
    with source.open("w") as stream:
        stream.write(HEADER + "\n")
        for number in range(count):
            turned = number // 1500 % 2 and number % 1500 < 200  # a move now and then
            row = block[rng.integers(len(block))] if not turned else block[number % 7]
            stream.write(f"{number / rate},{row}\n" if rng.random() > 0.001 else "garb,age\n")
        stream.write("end\n" * 7)
    bench = BenchProcess("--source", f"tail:{source}", "--tool", TOOL, folder=folder)
    bench.do("start", serial="T-1", **EARTH)
    bench.do("auto", on="on")
    sizes, begun = [], time.monotonic()
    process, clock = Path("/proc") / str(bench.process.pid), os.sysconf("SC_CLK_TCK")
    while time.monotonic() - begun < 3600 * hours:
        time.sleep(1)
        sizes.append(
            int((process / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
        )
        if read_of(process, source) == source.stat().st_size:
            break
    else:
        raise AssertionError("the bench reads more slowly than in real time")
    used = sum(map(int, (process / "stat").read_text().rsplit(")", 1)[1].split()[11:13])) / clock
    bench.stop()
    later = sizes[len(sizes) // 10 :]
    print(
        f"{count} lines: {min(later):.0f} to {max(later):.0f} MB, {used / hours / 36:.1f} % of a core"
    )
    assert max(later) - min(later) < 20
    assert used < 0.25 * hours * 3600


TUTORIAL = (ROOT / "docs" / "tutorials" / "bench.md").read_text("utf-8")


def test_the_lines_of_the_tutorial_open_the_bench_they_describe(tmp_path, monkeypatch):
    served, listened = [], []

    def listening(host, port):
        listened.append((host, port))
        return socket.create_server(("127.0.0.1", 0))

    def serve(bench, opened, url):
        opened.close()
        bench.session.close()
        served.append((bench.session.source, bench.session.folder, url))

    monkeypatch.setattr(serving, "listening", listening)
    monkeypatch.setattr(serving, "serve", serve)
    monkeypatch.chdir(tmp_path)
    lines = re.findall(r"^mwdcal (bench .*)$", TUTORIAL, re.MULTILINE)
    for line in lines:
        ran = mwdcal(*shlex.split(line))
        assert ran.code == 0, (line, ran)
        assert ran.out.startswith("http://")
    assert lines[1].split()[-1] == served[1][1].name
    assert [source for source, _, _ in served] == ["demo", "manual", "tcp:192.168.1.20:5000"]
    assert listened == [("127.0.0.1", 0), ("127.0.0.1", 0), ("0.0.0.0", 8000)]
    assert all(url for _, _, url in served), "the browser opens"


def test_the_sources_of_the_tutorial_are_taken(tmp_path):
    table = TUTORIAL.split("| `--source` |")[1].split("\n\n")[0]
    named = re.findall(r"^\| `([^`]+)`", table, re.MULTILINE)
    assert len(named) == 5
    for form in named:
        spec = form.replace("HOST:PORT", "localhost:1").replace("FILE", str(tmp_path / "log"))
        folder = tmp_path / form.split(":")[0]
        folder.mkdir()
        bench = serving.bench_of(folder, {"source": spec}, "127.0.0.1", 1)
        bench.session.close()
        assert bench.session.source == spec


def test_help_tells_the_address_first():
    assert "first line printed is the address" in mwdcal("bench", "--help").out
    assert mwdcal("bench", "--source", "usb:1", "--session", "x/y").code == 2
