"""How many words the documentation has, and the patterns that it avoids: `python tests/words.py [--count]`.

A word has a letter; formulas, blocks of code, and tables of pages that scripts write, do not count. The patterns are
those that made readers stumble. They are looked for in README, documentation, docstrings, help and messages.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
MOST_WORDS = 50_000
MOST_WORDS_OF_A_PAGE = 2_500
WRITTEN_BY_SCRIPTS = (
    *("benchmarks", "measured", "verification", "scatter", "drift-tables", "diagnosis"),
    *("coverage/", "papers/"),
)
"""Pages of `docs/evidence`, or folders of it, whose tables are results and not prose."""

PATTERNS = {
    r"(?<!there )(?<!where )\b(?:is|are|was|be) none\b": 'say what it is: "is not valid", "has no …"',
    r"(?:^|(?<=[.!] ))What (?:is|are|was|were|it|they|each|no|does|goes|comes|the|a) [^?]*?[.](?=\s|$)": (
        "begin with who does it, or with the noun"
    ),
    r"(?<!the )\bstands? (?:beside|before|for that)\b": "say who puts it where",
    r"\b(?:is|are|was|were|be) told by\b": "name the source: comes from, follows from",
    r"\b(?:as|than) (?:it is )?stated\b": "declared, expected, or the figure itself",
    r"\blest\b|\bwhoever stands\b|\bhand(?:s|ed)? out\b": "plain English",
    r"\bknow before you\b": "see … before you",
    r"\d\.\d{4,}e-\d\d ±": "round to the uncertainty",
    r"\bof which none\b|\bwhose \w+ (?:is|are) none\b": "say what is missing",
    r"(?i)\bwhoever\b": "name the person: a user, the laboratory",
    r"\bis said\b": "say who says it: mwdcal, the page",
    r"\b(?:empty|blank|null|None|NaN|zero) (?:where|if) there (?:is|are) none\b": "or empty, or None",
    r"\bHave the \w+ (?:of the \w+ )?give you\b": "ask … for",
    r"\bin the place of\b": "instead of",
}
"""Regular expressions, and what to write instead."""
OF_PAGES = {
    r"(?i)\b(?:its|the) (?:name|value|figure|text|row|column|number)s? stands?\b": "is, has",
    r"\bit stands (?:in|under|on)\b": "is, has",
    r"\btaken as exact\b": "assumed exact",
    r"\bbut for\b": "except",
    r"\bcomes? before (?:it|them)\b": "overrides",
    r"\banew\b": "again",
    r"\bis named\b(?! first| twice)|\bare mentioned\b": "say who reports it",
    r"\bof which no\w* \w+ (?:is|are|was)\b": "without",
}
"""The same, for pages alone."""
MOST_WORDS_OF_A_SENTENCE = 45


def pages() -> list[Path]:
    """README and the pages of the documentation."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def by_script(page: Path) -> bool:
    """Whether a script writes the tables of a page."""
    place = page.relative_to(ROOT).as_posix().removeprefix("docs/evidence/")
    return place.removesuffix(".md") in WRITTEN_BY_SCRIPTS or place.startswith(
        WRITTEN_BY_SCRIPTS[-2:]
    )


def prose(page: Path) -> str:
    """The text of a page, with empty lines in the place of blocks of code."""
    text, blocks = page.read_text("utf-8"), r"^(`{3,})[^`]*?\n.*?^\1$"
    return re.sub(blocks, lambda found: "\n" * found[0].count("\n"), text, flags=re.S | re.M)


def words(page: Path) -> int:
    """Words of a page."""
    lines = prose(page).splitlines()
    kept = [line for line in lines if not (by_script(page) and line.lstrip().startswith("|"))]
    text = re.sub(r"\$\$.*?\$\$|\$[^$\n]+\$", "", "\n".join(kept), flags=re.S)
    return sum(bool(re.search(r"[^\W\d_]", word)) for word in text.split())


def paragraphs(page: Path) -> Iterator[tuple[int, str]]:
    """Paragraphs of a page outside blocks of code, each with the number of its line."""
    start = 1
    for block in re.split(r"(\n\s*\n)", prose(page)):
        yield start, " ".join(block.split())
        start += block.count("\n")


def strings(module: Path) -> Iterator[tuple[int, str]]:
    """Texts of a module, docstrings and messages, each with the number of its line."""
    for node in ast.walk(ast.parse(module.read_text("utf-8"))):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield node.lineno, " ".join(node.value.split())


def stumbles() -> list[str]:
    """Where a pattern is found, with the words and the advice."""
    read = [*pages(), ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md"]
    of_pages = [(page, *found, PATTERNS | OF_PAGES) for page in read for found in paragraphs(page)]
    modules = sorted((ROOT / "src").rglob("*.py"))
    of_modules = [(module, *found, PATTERNS) for module in modules for found in strings(module)]
    return [
        f"{path.relative_to(ROOT)}:{line}: {match[0][:70]!r}: {advice}"
        for path, line, text, patterns in of_pages + of_modules
        for pattern, advice in patterns.items()
        for match in re.finditer(pattern, text)
    ]


def sentences(text: str) -> list[str]:
    """The sentences of a paragraph, of each cell of a table, of each item of a list; formulas are left out."""
    text = re.sub(r"\$\$.*?\$\$|\$[^$]+\$", "", text)
    parts = re.split(r"(?<!\\)\||(?:^| )(?:[-*]|\d+\.) (?=[A-Z`*\[])", text)
    return [each for part in parts for each in re.split(r"(?<=[.!?:;])\s+", part)]


def long_sentences() -> list[str]:
    """Sentences with more words than they may have."""
    return [
        f"{page.relative_to(ROOT)}:{line}: {count} words: {sentence[:70]!r}"
        for page in pages()
        for line, text in paragraphs(page)
        for sentence in sentences(text)
        if (count := sum(bool(re.search(r"[^\W\d_]", word)) for word in sentence.split()))
        > MOST_WORDS_OF_A_SENTENCE
    ]


def too_long() -> list[str]:
    """Pages, and the whole, that have more words than they may."""
    count = {page: words(page) for page in pages()[1:]}
    found = [
        f"{page.relative_to(ROOT)}: {number} words, at most {MOST_WORDS_OF_A_PAGE}"
        for page, number in count.items()
        if number > MOST_WORDS_OF_A_PAGE
    ]
    total = sum(count.values())
    return found + [f"docs: {total} words, at most {MOST_WORDS}"] * (total > MOST_WORDS)


def main() -> None:
    """Print the counts, or what is wrong."""
    if "--count" in sys.argv:
        count = sorted(
            ((words(page), page.relative_to(ROOT)) for page in pages()[1:]), reverse=True
        )
        print(*(f"{number:6} {page}" for number, page in count), sep="\n")
        print(f"{sum(number for number, _ in count):6} in all, at most {MOST_WORDS}")
    elif wrong := too_long() + stumbles() + long_sentences():
        sys.exit("\n".join(wrong))


if __name__ == "__main__":
    main()
