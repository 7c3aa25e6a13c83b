"""Chromium, and the rules of axe-core, for tests of what is seen in a browser.

Skips the tests that import it where what drives the browser (the extra `dev`) is missing.
"""

import shutil
from importlib.resources import files

import pytest

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
axe = pytest.importorskip("axe_playwright_python", reason="axe-core is not installed")

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), None)
AXE = files(axe).joinpath("axe.min.js").read_text("utf-8")
ALIKE = ("svg *", "tbody tr:nth-child(n+7):not([class])")
"""Elements that axe-core would look at for minutes: the insides of pictures, rows like others."""
RUN_AXE = (
    f"axe.run({{exclude: {[[each] for each in ALIKE]}}}, "
    "{resultTypes: ['violations'], selectors: false, elementRef: false})"
)


@pytest.fixture(scope="module")
def browser():
    """Chromium, started."""
    with playwright.sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield chromium
        chromium.close()
