"""Pictures of the bench for its page in the documentation, by the simulated stand: `python examples/bench/pictures.py`.

Needs Chromium, and Playwright of the extra `dev`.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "bench"
TABLE = Path(__file__).resolve().parents[1] / "servo" / "export.csv"
VIEWS = ((1280, "light"), (1280, "dark"), (800, "light"), (800, "dark"))


def shoot(page: Page, name: str) -> None:
    """The page in both widths and schemes."""
    for width, scheme in VIEWS:
        page.set_viewport_size({"width": width, "height": 850 if width > 1000 else 1100})
        page.emulate_media(color_scheme=scheme)
        page.wait_for_timeout(300)
        page.screenshot(path=FOLDER / f"{name}-{width}-{scheme}.png")


def story(page: Page) -> None:
    """From Start to the certificate, with a picture of each stage."""
    page.get_by_role("button", name="Start", exact=True).click()
    status = page.get_by_role("status")
    page.get_by_label("Accept when settled").check()
    status.filter(has_text=re.compile(r"^Station 1[4-6]\.")).wait_for(timeout=120_000)
    page.get_by_role("button", name="Pause").click(timeout=20_000)
    page.locator("[data-live=state_text]").filter(has_text=re.compile("^settled$")).wait_for()
    shoot(page, "measuring")
    page.get_by_role("button", name="Go on").click()
    page.get_by_text(re.compile("^Stations 8, 16 do not fit")).wait_for(timeout=120_000)
    status.filter(has_text="Next: Re-measure").wait_for(timeout=120_000)
    shoot(page, "bad-stations")
    page.get_by_role("button", name="Re-measure").click()
    status.filter(has_text="Next: Calibrate").wait_for(timeout=120_000)
    page.get_by_role("button", name="Calibrate").click()
    page.get_by_role("button", name="Start roll test").click(timeout=120_000)
    page.get_by_role("heading", name="PASS").wait_for(timeout=120_000)
    page.get_by_role("button", name="Issue certificate").click()
    page.get_by_role("link", name=re.compile("certificate.pdf")).wait_for(timeout=120_000)
    shoot(page, "passed")


def table_story(page: Page) -> None:
    """From a table of a laboratory to its calibration, with a picture of the sheet."""
    page.get_by_label(re.compile("^Table of a run")).set_input_files(TABLE)
    page.get_by_role("status").filter(has_text="Every column is clear").wait_for(timeout=120_000)
    shoot(page, "table")


def main() -> None:
    """Run the bench, and take the pictures."""
    FOLDER.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        command = [
            sys.executable,
            "-m",
            "mwdcal",
            "bench",
            "--demo",
            "--speed",
            "50",
            "--no-browser",
        ]
        bench = subprocess.Popen(
            [*command, "--session", f"{folder}/S"], stdout=subprocess.PIPE, text=True
        )
        browser = driver.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        page = browser.new_page()
        page.goto(str(bench.stdout and bench.stdout.readline().strip()))
        shoot(page, "start")
        start = page.url
        table_story(page)
        page.goto(start)
        story(page)
        browser.close()
        bench.send_signal(2)
        bench.wait(20)


if __name__ == "__main__":
    main()
