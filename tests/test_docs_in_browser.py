"""The documentation as a reader sees it: accessible and readable at two widths, light and dark.

Looks at build/docs, which `make docs` and `make check` build; without it the tests are skipped.
"""

from pathlib import Path

import pytest

from chromium import AXE, CHROMIUM, RUN_AXE, browser
from cli_support import ROOT

BUILT = ROOT / "build" / "docs"
PAGES = sorted(
    page.relative_to(BUILT).as_posix()
    for page in BUILT.rglob("*.html")
    if not {"_static", "_modules"} & set(page.relative_to(BUILT).parts)
)
LOOKS = [(1280, "light"), (1280, "dark"), (420, "light"), (420, "dark")]
FAULTS = (Path(__file__).parent / "page_faults.js").read_text("utf-8")
__all__ = ["browser"]

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed"),
    pytest.mark.skipif(not PAGES, reason="the documentation is not built: make docs"),
]


def violations(page):
    """What axe finds on a page, a line for each rule: the rule, and the first elements."""
    page.evaluate(AXE)
    found = page.evaluate(RUN_AXE)["violations"]
    return [
        f"{each['id']}: {each['help']}: {[node['html'][:120] for node in each['nodes'][:3]]}"
        for each in found
    ]


@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_accessible_and_not_cut(browser, name):
    page = browser.new_page()
    page.goto((BUILT / name).as_uri())
    wrong = []
    for width, scheme in LOOKS:
        page.set_viewport_size({"width": width, "height": 900})
        page.emulate_media(color_scheme=scheme)
        wrong += [f"{width} {scheme}: {each}" for each in violations(page)]
    page.close()
    assert wrong == []
