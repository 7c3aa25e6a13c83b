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
}
"""Regular expressions, and what to write instead."""


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
    texts = [(page, *found) for page in pages() for found in paragraphs(page)]
    modules = sorted((ROOT / "src").rglob("*.py"))
    texts += [(module, *found) for module in modules for found in strings(module)]
    return [
        f"{path.relative_to(ROOT)}:{line}: {match[0][:70]!r}: {advice}"
        for path, line, text in texts
        for pattern, advice in PATTERNS.items()
        for match in re.finditer(pattern, text)
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
    elif wrong := too_long() + stumbles():
        sys.exit("\n".join(wrong))


if __name__ == "__main__":
    main()
