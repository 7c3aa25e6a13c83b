"""The search index of the documentation after a build of some pages."""

import io
import json
from pathlib import Path

from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parents[1]
CONFIGURATION = f"""
import sys
sys.path.insert(0, {str(ROOT / "docs" / "_extensions")!r})
extensions = ["search_index"]
"""
GLOSSARY = """
Words
=====

.. glossary::

   undetermined
      That of which the run says nothing.
"""


def index_built(source, folder):
    """The search index after a build of what has changed."""
    Sphinx(
        source, source, folder, folder / "doctrees", "html", status=None, warning=io.StringIO()
    ).build()
    text = (folder / "searchindex.js").read_text("utf-8")
    return json.loads(text[text.index("(") + 1 : text.rindex(")")])


def test_a_page_that_is_not_written_again_keeps_its_terms_in_the_search_index(tmp_path):
    """Sphinx alone has them after the first build only; all else of the index is that of a new build."""
    source, pages = tmp_path / "source", [tmp_path / "pages", tmp_path / "anew"]
    source.mkdir()
    (source / "conf.py").write_text(CONFIGURATION, "utf-8")
    (source / "words.rst").write_text(GLOSSARY, "utf-8")
    index = source / "index.rst"
    index.write_text("Start\n=====\n\n.. toctree::\n\n   words\n", "utf-8")
    assert list(index_built(source, pages[0])["indexentries"]) == ["undetermined"]
    index.write_text(index.read_text("utf-8") + "\nMore.\n", "utf-8")
    again, anew = (index_built(source, folder) for folder in pages)
    assert list(again["indexentries"]) == ["undetermined"]
    assert again == anew
