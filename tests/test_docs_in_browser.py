"""The documentation as a reader sees it: accessible and readable at two widths, light and dark.

Looks at build/docs, which `make docs` and `make check` build; without it the tests are skipped.
"""

import re

import pytest

from chromium import AXE, CHROMIUM, RUN_AXE, browser
from cli_support import ROOT

BUILT = ROOT / "build" / "docs"
LARGEST = 1_000_000
"""Bytes: axe takes minutes for larger pages, of the core alone, which has the same parts as the others."""
PAGES = sorted(
    page.relative_to(BUILT).as_posix()
    for page in BUILT.rglob("*.html")
    if page.stat().st_size <= LARGEST
)
KINDS = [
    *("index.html", "search.html", "gallery.html", "changelog.html", "tutorials/start.html"),
    *("howto/survey.html", "explanation/theory.html", "evidence/errata.html"),
    *("reference/tables.html", "reference/glossary.html", "reference/commands/calibrate.html"),
]
"""A page of each kind; all others are looked at by the studies."""
LOOKS = [(1280, "light"), (1280, "dark"), (420, "light"), (420, "dark")]
__all__ = ["browser"]

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed"),
    pytest.mark.skipif(not PAGES, reason="the documentation is not built: make docs"),
]


def violations(page):
    """Faults that axe finds on a page, a line for each rule: the rule, and the first elements."""
    page.evaluate(AXE)
    found = page.evaluate(RUN_AXE)["violations"]
    return [
        f"{each['id']}: {each['help']}: {[node['html'][:120] for node in each['nodes'][:3]]}"
        for each in found
    ]


def page_of(name):
    """A page to test; by the studies alone if it is one of many of its kind."""
    return pytest.param(name, marks=() if name in KINDS else pytest.mark.study)


def test_there_is_a_page_of_each_kind():
    assert set(KINDS) <= set(PAGES)


def test_options_of_commands_keep_their_hyphens_and_examples_their_lines():
    pages = [*(BUILT / "reference" / "commands").glob("*.html")]
    assert len(pages) > 15
    for page in pages:
        text = page.read_text("utf-8")
        assert "Example: mwdcal" in text or "Examples: mwdcal" in text, page.name
        assert not re.search(r"\| Examples?:|–[a-z]+ [a-z]+\.", text), page.name


@pytest.mark.parametrize("name", [*map(page_of, PAGES)])
def test_a_page_is_accessible_and_no_wider_than_the_window(browser, name):
    page = browser.new_page()
    page.goto((BUILT / name).as_uri())
    wrong = []
    for width, scheme in LOOKS:
        page.set_viewport_size({"width": width, "height": 900})
        page.emulate_media(color_scheme=scheme)
        wrong += [f"{width} {scheme}: {each}" for each in violations(page)]
        wide = page.evaluate("document.documentElement.scrollWidth")
        wrong += [f"{width} {scheme}: {wide} px wide"] if wide > width else []
    page.close()
    assert wrong == []


@pytest.mark.parametrize(
    ("word", "page"),
    [
        ("temperature", "explanation/temperature.html"),
        ("noise", "howto/noise.html"),
        ("uncertainty", "explanation/uncertainty.html"),
        ("pandas", "tutorials/python.html"),
        ("undetermined", "reference/glossary.html"),
        ("feet", "howto/survey.html"),
        ("fahrenheit", "reference/tables.html"),
        ("merged", "reference/exports.html"),
    ],
)
def test_a_search_finds_the_page_before_objects_of_the_python_interface(browser, word, page):
    opened = browser.new_page()
    opened.goto(f"{(BUILT / 'search.html').as_uri()}?q={word}")
    opened.wait_for_selector("#search-results .search-summary, #search-results > p:not(:empty)")
    opened.wait_for_timeout(1500)
    places = opened.eval_on_selector_all(
        "#search-results ul.search li > a", "links => links.map(link => link.href)"
    )
    opened.close()
    found = [place.partition("/build/docs/")[2] for place in places]
    pages = [place.partition("#")[0].partition("?")[0] for place in found]
    assert page in pages[:8], found[:8]
    assert not pages[0].startswith("reference/api"), found[:8]
