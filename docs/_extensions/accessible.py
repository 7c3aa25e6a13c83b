"""Labels and focus for readers with a keyboard or a screen reader, which the theme's pages lack."""

import re
from pathlib import Path

LACKING = {
    r'<aside class="sidebar-drawer">': '<aside class="sidebar-drawer" aria-label="Site">',
    r'<aside class="(toc-drawer[^"]*)">': r'<aside class="\1" aria-label="Page">',
    r"<pre>": '<pre tabindex="0">',
    r'<div class="(table-wrapper[^"]*|math)"(?! tabindex)': r'<div class="\1" tabindex="0"',
    r'(<article role="main" id="furo-main-content">)\s*(?=<noscript>)': r"\1<h1>Search</h1>",
    r'<th class="head"><p></p></th>': '<td class="head"></td>',
}
"""Patterns of a page and their replacements: labels, wide blocks that scroll by key, cells that head nothing."""


def mend(text):
    """A page with what it lacks."""
    for pattern, instead in LACKING.items():
        text = re.sub(pattern, instead, text)
    return text


def mend_pages(app, error):
    """Mend the pages that were written."""
    if error or app.builder.name != "html":
        return
    for page in Path(app.outdir).rglob("*.html"):
        text = page.read_text("utf-8")
        if (mended := mend(text)) != text:
            page.write_text(mended, "utf-8")


def setup(app):
    app.connect("build-finished", mend_pages)
    return {"parallel_read_safe": True}
