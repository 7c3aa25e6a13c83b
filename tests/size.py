"""Code lines and modules by room: without docstrings, comments and blank lines. `make size` prints them."""

from __future__ import annotations

import ast
import io
import sys
import tokenize
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
HOLDERS = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
SILENT = {
    *(tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT),
    tokenize.ENDMARKER,
}


def docstring_lines(tree: ast.AST) -> set[int]:
    """Lines of docstrings."""
    lines: set[int] = set()
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(node, HOLDERS) and ast.get_docstring(node, clean=False) is not None and body:
            lines |= set(range(body[0].lineno, (body[0].end_lineno or body[0].lineno) + 1))
    return lines


def code_lines(text: str) -> int:
    """Lines with code on them."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    spans = [range(t.start[0], t.end[0] + 1) for t in tokens if t.type not in SILENT]
    return len({line for span in spans for line in span} - docstring_lines(ast.parse(text)))


def print_rooms(folder: Path) -> None:
    """Print modules and code lines of each room below a folder, and of all."""
    lines: Counter[str] = Counter()
    modules: Counter[str] = Counter()
    for path in folder.rglob("*.py"):
        room = str(path.parent.relative_to(folder))
        lines[room] += code_lines(path.read_text("utf-8"))
        modules[room] += 1
    for room in sorted(lines):
        print(f"{room:32}{modules[room]:8}{lines[room]:8}")
    print(f"{folder.relative_to(ROOT)!s:32}{modules.total():8}{lines.total():8}")


if __name__ == "__main__":
    for name in sys.argv[1:] or ("src/mwdcal", "tests"):
        print_rooms(ROOT / name)
