"""The bench as an operator has it: in Chromium, from Start to the certificate, by mouse and by keyboard.

Skips where Chromium or what drives it (the extra `dev`) is missing.
"""

import json
import re
import time
from pathlib import Path

import numpy as np
import pytest

import chromium
from bench_support import EARTH, BenchProcess, Stand
from bench_tables import ROLLS, RUN, laboratory_table
from chromium import AXE, CHROMIUM, RUN_AXE, playwright
from cli_support import EXAMPLE, mwdcal

pytest.importorskip("starlette", reason="starlette is not installed")

browser = chromium.browser
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed: the bench was not looked at"),
]  # fmt: skip
VIEWS = [(1280, "light"), (800, "dark"), (420, "light")]
"""Widths and schemes; a place does not depend on the colours (`test_only_colours_change_in_the_dark`)."""
LONGEST = 120_000
DEMO = ("--demo", "--speed", "30")
"""Faster, and the simulated readings take a whole core while the browser and the papers are waited for."""


class Operator:
    """A page of the bench, and what the browser complained of."""

    def __init__(self, browser, url):
        # axe is injected into the page, which the page's own policy would not let in
        self.context = browser.new_context(viewport={"width": 1280, "height": 900}, bypass_csp=True)
        self.page, self.complaints, self.host = self.context.new_page(), [], url.split("/?")[0]
        self.page.set_default_timeout(LONGEST)
        self.page.on("console", lambda message: self._complaint(message.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", self._request)
        self.page.goto(url)

    def _complaint(self, text):
        if " 409 " not in text:  # a decision that was refused, as the page says
            self.complaints.append(text)

    def _request(self, request):
        if not request.url.startswith((self.host, "data:")):
            self.complaints.append(request.url)

    def button(self, name):
        return self.page.get_by_role("button", name=name, exact=True)

    def status(self):
        return self.page.get_by_role("status").inner_text()

    def wait_for_status(self, pattern):
        self.page.get_by_role("status").filter(has_text=re.compile(pattern)).wait_for(
            timeout=LONGEST
        )

    def accept_by_key(self, last, seconds=180):
        """Press space whenever the tool has settled at the ordered position, until the status says what `last` is."""
        status, until = self.page.get_by_role("status"), time.monotonic() + seconds
        settled = self.page.locator("[data-live=state_text]").filter(
            has_text=re.compile("^settled$")
        )
        while not re.search(last, status.inner_text()):
            assert time.monotonic() < until, self.page.inner_text("body")
            if settled.count():
                self.page.keyboard.press(" ")
            self.page.wait_for_timeout(100)

    def heading(self, name):
        try:
            self.page.get_by_role("heading", name=re.compile(name)).wait_for(timeout=LONGEST)
        except playwright.TimeoutError:
            raise AssertionError(self.page.inner_text("body")) from None

    def look(self):
        """Faults by axe-core and pages wider than the screen, at each width and scheme."""
        faults = []
        for width, scheme in VIEWS:
            self.page.set_viewport_size({"width": width, "height": 900})
            self.page.emulate_media(color_scheme=scheme)
            self.page.evaluate(AXE)
            found = self.page.evaluate(RUN_AXE)["violations"]
            faults += [
                f"{width} {scheme} {rule['id']}: {rule['nodes'][0]['html'][:200]}" for rule in found
            ]
            if self.page.evaluate("document.documentElement.scrollWidth > innerWidth"):
                faults.append(f"{width} {scheme}: wider than the screen")
        self.page.set_viewport_size({"width": 1280, "height": 900})
        return faults


@pytest.fixture
def demo(tmp_path, browser, request):
    folder = tmp_path / "S"
    key = tmp_path / "second.key"
    created = mwdcal("certificate", "key", "create", "-o", key, "--owner", "B. Second")
    assert created.code == 0, created
    laboratory = (
        *("--countersign", key),
        "--laboratory",
        EXAMPLE / "laboratory.toml",
        "--registry",
        tmp_path / "tools.sqlite",
    )
    pictures = "keyboard" not in request.node.name  # once is enough
    bench = BenchProcess(*DEMO, *laboratory, folder=folder, pictures=pictures)
    operator = Operator(browser, bench.url)
    yield bench, operator, folder
    operator.context.close()
    bench.stop()


def without_time(path):
    content = json.loads(Path(path).read_text("utf-8"))
    return {name: value for name, value in content.items() if name not in ("time", "sha256")}


def test_the_whole_story(demo, tmp_path):
    """24 stations, two of them disturbed; both named and measured again; roll test, certificate, registry."""
    _, operator, folder = demo
    page, faults = operator.page, operator.look()
    operator.button("Start").click()
    operator.wait_for_status("Station 1")
    faults += operator.look()
    page.get_by_label("Accept when settled").check()
    operator.wait_for_status("All stations are measured")
    page.get_by_text(re.compile("^Stations 8, 16 do not fit")).wait_for(timeout=LONGEST)
    faults += operator.look()
    operator.button("Re-measure").click()
    operator.wait_for_status("Next: Calibrate")
    operator.button("Calibrate").click()
    operator.heading("^Calibrated: DEMO-1")
    faults += operator.look()
    operator.button("Start roll test").click()
    operator.heading("^PASS")
    operator.button("Issue certificate").click()
    operator.wait_for_status("Next: a second person checks the certificate")
    faults += operator.look()
    operator.button("Sign certificate").click()
    page.get_by_text(re.compile("^Registry: (?!being)")).wait_for(timeout=LONGEST)
    page.get_by_text("Signed by: B. Second").wait_for(timeout=LONGEST)
    faults += operator.look()
    assert faults == []
    assert operator.complaints == []
    page.get_by_role("link", name=re.compile("certificate.pdf")).wait_for(timeout=LONGEST)
    ran = mwdcal(
        "calibrate", folder / "run.csv", "--tool", folder / "tool.toml", "-o", tmp_path / "t.json"
    )
    assert ran.code == 0, ran
    assert without_time(folder / "tool.json") == without_time(tmp_path / "t.json")
    listed = mwdcal("registry", "list", "--registry", tmp_path / "tools.sqlite", "--json").json
    assert [tool["serial"] for tool in listed["tools"]] == ["DEMO-1"]


def is_as_ordered(row):
    """Whether the simulated tool, whose axes are not swapped, lay about where a row says, by the law of gravity."""
    inc, face = (np.radians(row[f"ref_{name}_deg"]) for name in ("inclination", "toolface"))
    g = np.array([-np.sin(inc) * np.sin(face), -np.sin(inc) * np.cos(face), np.cos(inc)])
    return np.abs(np.array([row["ax"], row["ay"], row["az"]]) / 3.0 - g).max() < 0.15


def test_the_story_by_keyboard_alone(demo):
    """The same without a mouse; every position is measured once, but for the two disturbed ones."""
    _, operator, folder = demo
    page = operator.page
    page.keyboard.press("Tab")  # into the page: the first field is the serial
    for _ in range(20):
        if page.evaluate("document.activeElement.id") == "b-start":
            break
        page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    operator.wait_for_status("Station 1")
    operator.accept_by_key("All stations are measured")
    page.get_by_text(re.compile("^Stations 8, 16 do not fit")).wait_for(timeout=LONGEST)
    page.keyboard.press("r")
    operator.wait_for_status(r"^Station 8\.")
    operator.accept_by_key("Next: Calibrate")
    page.keyboard.press("c")
    operator.heading("^Calibrated")
    page.keyboard.press("t")
    operator.wait_for_status(r"^Station 1\.")
    operator.accept_by_key("Next: the certificate")
    operator.heading("^PASS")
    for _ in range(40):
        if page.evaluate("document.activeElement.id") == "b-certificate":
            break
        page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    operator.button("Sign certificate").wait_for(timeout=LONGEST)
    operator.button("Sign certificate").focus()
    page.keyboard.press("Enter")
    page.get_by_text(re.compile("^Registry: (?!being)")).wait_for(timeout=LONGEST)
    assert operator.complaints == []
    events = [json.loads(line) for line in (folder / "session.jsonl").read_text().splitlines()]
    taken = [event for event in events if event["event"] == "station"]
    order = [event["position"] for event in taken]
    assert order == [*range(24), 7, 15, *range(12)]
    assert not any("doubt" in event for event in taken)
    for event in taken:
        assert is_as_ordered(event["row"])


def test_two_browsers_and_a_restart(tmp_path, browser):
    """The office sees what the tablet accepts; after a kill the session goes on where it was."""
    bench = BenchProcess(*DEMO, folder=tmp_path / "S")
    tablet, office = Operator(browser, bench.url), Operator(browser, bench.url)
    tablet.button("Start").click()
    tablet.page.get_by_label("Accept when settled").check()
    office.wait_for_status(r"^Station 1\d\.")
    shown = int(re.search(r"Stations: (\d+)", office.page.inner_text("#main"))[1])
    bench.kill()
    tablet.page.get_by_text("The bench does not answer").wait_for(timeout=LONGEST)
    again = BenchProcess(*DEMO[1:], folder=tmp_path / "S")
    late = Operator(browser, again.url)
    assert int(re.search(r"Stations: (\d+)", late.page.inner_text("#main"))[1]) >= shown
    late.button("Resume").click()
    late.wait_for_status("All stations are measured")
    for each in (tablet, office, late):
        each.context.close()
    again.stop()


def test_readings_by_hand(tmp_path, browser):
    """Rows pasted from the vendor's program; the page shows a station at once."""
    given = ("--source", "manual", "--tool", EXAMPLE / "tool.toml", "--plan", "moosavi-12")
    bench = BenchProcess(*given, folder=tmp_path / "S")
    operator, stand = Operator(browser, bench.url), Stand()
    page = operator.page
    page.get_by_label("Serial of the tool").fill("T-1")
    for label, name in (
        ("Field at", "field_nt"),
        ("Dip at", "dip_deg"),
        ("Gravity at", "gravity_g"),
    ):
        page.get_by_label(re.compile(label)).fill(str(EARTH[name]))
    operator.button("Start").click()
    operator.wait_for_status("Station 1")
    plan = json.loads((tmp_path / "S/session.jsonl").read_text().splitlines()[0])["plan"]["columns"]
    names = ("ref_inclination_deg", "ref_azimuth_deg", "ref_toolface_deg")
    rows = [
        stand.line([plan[name][i] or 0.0 for name in names]).split(",", 1)[1] for i in range(48)
    ]
    page.get_by_label(re.compile("^Reading")).fill("\n".join(rows[:46]))
    operator.button("Take reading").click()
    operator.wait_for_status("Station 47")
    assert operator.look() == []
    page.get_by_text("Accuracy so far").wait_for(timeout=LONGEST)
    page.get_by_label(re.compile("^Reading")).fill(rows[46])
    begun = time.monotonic()
    page.keyboard.press("Enter")
    operator.wait_for_status("Station 48")
    assert time.monotonic() - begun < 1.0  # 0.3 s on a quiet machine
    page.get_by_label(re.compile("^Reading")).fill(rows[47])
    operator.button("Take reading").click()
    operator.wait_for_status("Next: Calibrate")
    operator.context.close()
    bench.stop()


def test_a_tool_of_the_registry_and_an_own_plan(tmp_path, browser):
    """The past of a tool is shown; its profile, and a plan by its file, are those of the session."""
    database = tmp_path / "tools.sqlite"
    fit = (
        "calibrate",
        EXAMPLE / "run.csv",
        "--tool",
        EXAMPLE / "tool.toml",
        "-o",
        tmp_path / "c.json",
    )
    for words in (fit, ("registry", "init"), ("registry", "add", tmp_path / "c.json")):
        ran = mwdcal(*words, *(("--registry", database) if words[0] == "registry" else ()))
        assert ran.code == 0, ran
    serial = json.loads((tmp_path / "c.json").read_text())["tool"]["serial"]
    plan = "ref_inclination_deg,ref_azimuth_deg,ref_toolface_deg\n" + "10,20,30\n40,50,60\n" * 6
    (tmp_path / "mine.csv").write_text(plan)
    bench = BenchProcess("--registry", database, folder=tmp_path / "S")
    operator = Operator(browser, bench.url)
    page = operator.page
    page.get_by_label("Operator").fill("A. First")
    operator.button(f"Choose {serial}").click()
    page.get_by_role("heading", name=f"Past of {serial}").wait_for(timeout=LONGEST)
    page.locator("summary").click()
    assert operator.look() == []
    assert page.get_by_label("Serial of the tool").input_value() == serial
    assert page.get_by_label("Operator").input_value() == "A. First"
    assert page.locator("#f-tool").input_value() == "registry"
    page.get_by_label("Your own plan").set_input_files(tmp_path / "mine.csv")
    operator.button("Start").click()
    operator.wait_for_status(r"^Station 1\. Go to inclination 10°, toolface 30°, azimuth 20°")
    assert "mine" in page.inner_text("[data-part=head]")
    assert operator.complaints == []
    operator.context.close()
    bench.stop()


DROP = """([text, name]) => {
  const data = new DataTransfer();
  data.items.add(new File([Uint8Array.from(text)], name));
  const area = document.querySelector("[data-drop]");
  area.dispatchEvent(new DragEvent("drop", { dataTransfer: data, bubbles: true, cancelable: true }));
}"""


def test_a_table_by_drag_and_drop_and_by_keyboard(tmp_path, browser):
    """Dropped on the start page, its question answered, calibrated, verified by a file that was chosen, certified."""
    bench = BenchProcess("--source", "manual", folder=tmp_path / "S")
    operator, stand = Operator(browser, bench.url), Stand()
    page = operator.page
    page.evaluate(DROP, [[*laboratory_table(stand, RUN)], "Mess 1.csv"])
    page.get_by_text("Which one does the stand show?").wait_for(timeout=LONGEST)
    faults = operator.look()
    page.get_by_role("button", name=re.compile(r"^Azimut \(°\)")).focus()
    page.keyboard.press("Enter")
    operator.wait_for_status("Every column is clear")
    faults += operator.look()
    operator.button("Calibrate").focus()
    page.keyboard.press("Enter")
    operator.heading("^Calibrated: T-77")
    (tmp_path / "roll.csv").write_bytes(laboratory_table(stand, ROLLS, clear=True))
    page.get_by_label(re.compile("^Table of the roll test")).set_input_files(tmp_path / "roll.csv")
    operator.heading("^PASS")
    operator.button("Issue certificate").click()
    page.get_by_role("link", name=re.compile("certificate.json")).wait_for(timeout=LONGEST)
    faults += operator.look()
    assert faults == []
    assert operator.complaints == []
    page.get_by_role("link", name="To the stand").click()
    page.wait_for_function("document.body.dataset.state")  # the first event has come
    page.get_by_role("link", name="Go on with the table").wait_for(timeout=LONGEST)
    operator.context.close()
    bench.stop()
