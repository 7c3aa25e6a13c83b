"""How long the page of the bench takes to show a station and a fit, in Chromium, and the load of the machine.

The simulated stand gives 48 stations; the operator accepts each by the space bar. From the key to the station in the
page's list, and from the key to the fit that knows the station, as the script of the page sees them: wall time.

    python benchmarks/bench_page.py --plan best-48 --speed 50
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
from pathlib import Path
from threading import Thread
from typing import cast

import numpy as np
from playwright.sync_api import Page, sync_playwright

from mwdcal.bench import serving
from mwdcal.bench.simulated import DemoStand

WATCH = """() => {
  window.times = [];
  const now = () => performance.now();
  document.addEventListener("keydown", (e) => { if (e.key === " ") window.pressed = now(); }, true);
  const count = () => document.querySelector("[data-part=stations] h2").textContent;
  const fit = () => document.querySelector("[data-part=side] dl")?.textContent || "";
  let last = [count(), fit()];
  new MutationObserver(() => {
    const next = [count(), fit()];
    next.forEach((text, i) => { if (text !== last[i]) window.times.push([i, now() - window.pressed]); });
    last = next;
  }).observe(document.getElementById("main"), { childList: true, subtree: true, characterData: true });
}"""
HOST = "127.0.0.1"
PAUSE = 1500
"""Milliseconds after a key before the next."""
LONGEST = 240_000
"""Milliseconds that a station may take."""


def measure(page: Page, stations: int) -> list[tuple[int, float]]:
    """Times of stations (0) and fits (1) after the key, ms."""
    page.get_by_role("button", name="Start", exact=True).click()
    page.get_by_role("status").filter(has_text="Station 1.").wait_for(timeout=LONGEST)
    page.evaluate(WATCH)
    for number in range(1, stations + 1):
        settled = "() => document.querySelector('[data-live=state_text]').textContent === 'settled'"
        page.wait_for_function(settled, timeout=LONGEST)
        heading = page.locator("[data-part=stations] h2")
        while f": {number} /" not in heading.inner_text():  # one that is refused is pressed again
            page.keyboard.press(" ")
            page.wait_for_timeout(PAUSE)
    page.wait_for_timeout(3000)
    return [(int(kind), float(time)) for kind, time in page.evaluate("window.times")]


def main() -> None:
    """Measure, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plan", default="best-48")
    parser.add_argument("--stations", type=int, default=48)
    parser.add_argument("--speed", type=float, default=50.0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        options = {"source": "demo", "plan": given.plan, "speed": given.speed}
        opened = serving.listening(HOST, 0)
        port = opened.getsockname()[1]
        bench = serving.bench_of(Path(folder), options, HOST, port)
        cast(DemoStand, bench.source).knocked = set()  # a bad station may prevent the fit
        Thread(target=serving.serve, args=(bench, opened, ""), daemon=True).start()
        browser = driver.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        page = browser.new_page()
        page.goto(serving.address(HOST, port, bench.token))
        times = measure(page, given.stations)
        browser.close()
        bench.stop.set()
    for kind, name in ((0, "station shown"), (1, "new fit shown")):
        each = [time / 1000 for which, time in times if which == kind]
        median, most = np.median(each), np.quantile(each, 0.95)
        last = ", ".join(f"{time:.2f}" for time in each[-3:])
        print(f"{name}: {len(each)}, median {median:.2f} s, 95 % {most:.2f} s, the last {last} s")
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


if __name__ == "__main__":
    main()
