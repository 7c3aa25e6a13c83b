"""The documentation: its words, its patterns, its search index."""

import ast
import json
import re
import shutil
import subprocess
import sys

import pytest

import words
from cli_support import ROOT


def test_the_documentation_is_short():
    assert words.too_long() == []


def test_no_sentence_is_long():
    assert words.long_sentences() == []


def test_no_pattern_is_found_that_made_readers_stumble():
    assert words.stumbles() == []


@pytest.mark.parametrize(
    "text",
    [
        "A covariance that is none.",
        "It is known. What is left counts as noise.",
        "What it holds is written.",
        "Two numbers stand beside it.",
        "Axes that are told by readings.",
        "More often than stated.",
        "No `5.83705e-21 ± 2e-05`.",
        "Whoever may read it.",
        "What differs, and it is said so.",
        "A list, empty if there are none.",
        "Have the owner of the database give you the right.",
        "Its name stands in the list.",
        "References taken as exact.",
        "The option, which comes before it.",
    ],
)
def test_a_pattern_is_found(text):
    assert any(re.search(pattern, text) for pattern in words.PATTERNS | words.OF_PAGES)


@pytest.mark.parametrize(
    "text",
    [
        "An empty list.",
        "What happened to it? Nothing.",
        "Mount the stand beside the oven.",
    ],
)
def test_good_english_is_left_alone(text):
    assert not any(re.search(pattern, text) for pattern in words.PATTERNS | words.OF_PAGES)


def test_a_sentence_of_a_cell_or_an_item_is_counted_alone():
    cells = words.sentences("| one two | three. Four: five |")
    assert [each.strip() for each in cells if each.strip()] == [
        "one two",
        "three.",
        "Four:",
        "five",
    ]
    assert words.sentences("- One. - Two")[1:] == ["One.", "Two"]


def test_code_formulas_and_results_are_no_words(tmp_path, monkeypatch):
    page = tmp_path / "docs" / "evidence" / "scatter.md"
    page.parent.mkdir(parents=True)
    monkeypatch.setattr(words, "ROOT", tmp_path)
    text = "# Two words\n\n```\nnot these three\n```\n\n$$\na b\n$$\n\nand $x y$ 0.13 four – more.\n\n| no | cells |\n"
    page.write_text(text, "utf-8")
    assert words.words(page) == len(["Two", "words", "and", "four", "more."])


FOUND = [
    ("feet", "howto/survey"),
    ("temperature", "explanation/temperature"),
    ("pandas", "howto/python"),
    ("undetermined", "tutorials/start"),
    ("undetermined", "reference/glossary"),
]
"""Words and a page that the search finds by each."""


@pytest.fixture(scope="module")
def index(tmp_path_factory):
    """The search index of the pages that are searched for, and of the first page."""
    pytest.importorskip("sphinx")
    pytest.importorskip("myst_parser")
    folder = tmp_path_factory.mktemp("docs")
    for name in ("index", *{page for _, page in FOUND}):
        page = folder / "docs" / f"{name}.md"
        page.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / "docs" / f"{name}.md", page)
    conf = 'extensions = ["myst_parser"]\nmyst_enable_extensions = ["dollarmath", "colon_fence"]\n'
    (folder / "docs" / "conf.py").write_text(conf, "utf-8")
    command = [sys.executable, "-m", "sphinx", "-Q", "-b", "html", folder / "docs", folder / "html"]
    subprocess.run(command, check=True)
    text = (folder / "html" / "searchindex.js").read_text("utf-8")
    return json.loads(text[text.index("(") + 1 : text.rindex(")")])


@pytest.mark.slow
@pytest.mark.parametrize(("word", "page"), FOUND)
def test_the_search_finds(index, word, page):
    from sphinx.search.en import SearchEnglish

    stem = SearchEnglish({}).stem(word)
    places = {}
    for terms in ("terms", "titleterms"):
        found = index[terms].get(stem, [])
        places[terms] = [found] if isinstance(found, int) else found
    names = {index["docnames"][number] for found in places.values() for number in found}
    assert page in names


@pytest.mark.slow
def test_words_of_the_glossary_are_the_first_hits(index):
    """Main entries of Sphinx's index score 100 in its search, titles 15, words of a page 5."""
    glossary = index["docnames"].index("reference/glossary")
    for word in ("undetermined", "soak", "roll test", "dip"):
        assert [glossary, f"term-{word.replace(' ', '-')}", True] in index["indexentries"][word]


LINK = re.compile(r"\]\((?![a-z]+:|#)([^)#\s]+)")


def test_links_between_pages_lead_to_files():
    """Sphinx follows those of the documentation; here also those of README and the other pages beside it."""
    pages = {*words.pages(), *ROOT.glob("*.md"), *ROOT.glob("design/*.md")}
    dead = [
        f"{page.relative_to(ROOT)}: {link}"
        for page in sorted(pages)
        for link in LINK.findall(page.read_text("utf-8"))
        if not (page.parent / link).exists()
    ]
    assert dead == []
    assert len(pages) > 80


def test_no_message_points_to_a_file_of_the_repository():
    """`pip install` brings no repository: messages name a page by its title, as in (docs, 'Glossary')."""
    for path in (ROOT / "src").rglob("*.py"):
        nodes = [*ast.walk(ast.parse(path.read_text("utf-8")))]
        docstrings = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
        texts = (n for n in nodes if isinstance(n, ast.Constant) and id(n) not in docstrings)
        assert [n.value for n in texts if "docs/" in str(n.value)] == [], path
