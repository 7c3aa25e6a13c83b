"""Mutations of the numeric core: what a wrong operator or constant in it would be noticed by.

    python tests/mutation_run.py [--every N] [--only REGEX] [--list]

A copy of the tree is changed at one place at a time; the tests of that module are run on it, and
what they let pass is a survivor. `design/mutations.md` lists and judges the survivors.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy.random  # noqa: F401 - loaded once, here: each mutation is tested in a fork
import pytest
import scipy.linalg
import scipy.stats  # noqa: F401

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = Path("src/mwdcal")
TESTS = {
    "geometry": ("test_vectors", "test_observables", "test_expectations"),
    "sensor": ("test_models", "test_derivatives", "test_expectations"),
    "estimation": ("test_derivatives", "test_expectations", "test_efficiency", "test_robust"),
    "estimation/minimisers": ("test_newton", "test_papers_methods", "test_swarm"),
    "calibration": ("test_expectations", "test_calibrate", "test_common_errors", "test_robust"),
    "calibration/automatic": ("test_courses", "test_selection", "test_curves", "test_stand"),
    "calibration/diagnosis": ("test_calibrate", "test_refusals", "test_axes", "test_structure"),
}
"""Test files by folder: those that look at its numbers most closely, cheapest first."""
PATIENCE = 180.0
"""Seconds after which the tests of one mutation count as failed: a loop that never ends."""
OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
}
COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.GtE,
    ast.LtE: ast.Gt,
    ast.Gt: ast.LtE,
    ast.GtE: ast.Lt,
}


@dataclass(frozen=True)
class Mutation:
    """A span of one line of a file, and what stands there instead."""

    file: Path
    line: int
    start: int
    stop: int
    text: str

    def apply(self, source: str) -> str:
        """The source with the mutation."""
        lines = source.splitlines(keepends=True)
        row = lines[self.line - 1].encode()
        lines[self.line - 1] = (row[: self.start] + self.text.encode() + row[self.stop :]).decode()
        return "".join(lines)

    def described(self, source: str) -> str:
        """Place, line and change in one row."""
        before = source.splitlines()[self.line - 1]
        after = self.apply(source).splitlines()[self.line - 1]
        return f"{self.file}:{self.line}: `{before.strip()}` → `{after.strip()}`"


def replacement(node: ast.AST) -> tuple[ast.expr, str] | None:
    """An expression, and the text that it is changed into."""
    if isinstance(node, ast.Constant) and type(node.value) is float and node.value != 0:
        return node, repr(1.5 * node.value)
    if isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
        changed = ast.BinOp(node.left, OPERATORS[type(node.op)](), node.right)
        return node, f"({ast.unparse(changed)})"
    if isinstance(node, ast.Compare) and type(node.ops[0]) in COMPARISONS:
        turned = ast.Compare(node.left, [COMPARISONS[type(node.ops[0])]()], node.comparators)
        return node, f"({ast.unparse(turned)})"
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        return node, f"({ast.unparse(node.operand)})"
    return None


def numeric(node: ast.AST) -> Iterator[ast.AST]:
    """The nodes below one that compute: no indices, axes, annotations and texts."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "slice"):
            continue
        for part in value if isinstance(value, list) else [value]:
            signed_number = isinstance(part, ast.UnaryOp) and isinstance(part.operand, ast.Constant)
            if isinstance(part, ast.JoinedStr) or signed_number or not isinstance(part, ast.AST):
                continue
            yield part
            yield from numeric(part)


def mutations(file: Path) -> list[Mutation]:
    """All mutations of a file: constants × 1.5, operators, comparisons and signs turned round."""
    found = []
    for node in numeric(ast.parse((ROOT / file).read_text("utf-8"))):
        changed = replacement(node)
        if changed is None or changed[0].lineno != changed[0].end_lineno:
            continue
        place, text = changed
        assert place.end_col_offset is not None
        found.append(Mutation(file, place.lineno, place.col_offset, place.end_col_offset, text))
    return sorted(found, key=lambda m: (m.line, m.start, m.stop))


def tests_of(file: Path) -> list[str]:
    """Test files that look at a module: of its folder, or of the one above."""
    folder = file.relative_to(PACKAGE).parent
    names = TESTS[folder.as_posix()]
    return [f"tests/{name}.py" for name in names if (ROOT / "tests" / f"{name}.py").exists()]


def survives(mutation: Mutation, folder: Path) -> bool:
    """Whether the tests of the module pass with the mutation."""
    path = folder / mutation.file
    source = path.read_text("utf-8")
    path.write_text(mutation.apply(source), "utf-8")
    try:
        return passes(mutation.file, folder)
    finally:
        path.write_text(source, "utf-8")


def passes(file: Path, folder: Path) -> bool:
    """Whether the tests of a module pass on the copy as it is."""
    child = os.fork()
    if child == 0:
        _test(folder, tests_of(file))
    return _ended(child) == 0


def _test(folder: Path, tests: Sequence[str]) -> NoReturn:
    """Run tests on a copy of the tree in this process, silently, and end it with their status."""
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)
    os.dup2(silent, 2)
    os.chdir(folder)
    sys.path[:0] = [str(folder / "src"), str(folder / "tests")]
    options = ["-q", "-x", "-n0", "-p", "no:cacheprovider", "-m", "not slow"]
    status = 1
    try:
        status = int(pytest.main([*options, *tests]))
    finally:
        os._exit(status)


def _ended(child: int) -> int:
    """The status of a child process; one that takes too long is killed."""
    limit = time.monotonic() + PATIENCE
    while time.monotonic() < limit:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return status
        time.sleep(0.05)
    os.kill(child, signal.SIGKILL)
    return os.waitpid(child, 0)[1]


def chosen(every: int, word: str) -> list[Mutation]:
    """Each `every`th mutation of the modules whose path matches a regular expression."""
    files = [
        path.relative_to(ROOT)
        for folder in TESTS
        for path in sorted((ROOT / PACKAGE / folder).glob("*.py"))
        if re.search(word, path.as_posix())
    ]
    return [m for file in files for m in mutations(file)[every // 2 :: every]]


def main() -> None:
    """Run the mutations and print the survivors as a list."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--every", type=int, default=40, help="run one mutation in so many")
    parser.add_argument(
        "--only", default="", help="modules whose path matches this regular expression"
    )
    parser.add_argument("--list", action="store_true", help="list the mutations, run nothing")
    options = parser.parse_args()
    todo, survivors, start = chosen(options.every, options.only), 0, time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "copy"
        skipped = shutil.ignore_patterns(".git", ".venv", "build", "__pycache__", "shared")
        shutil.copytree(ROOT, folder, ignore=skipped)
        for file in {} if options.list else {m.file.parent: m.file for m in todo}.values():
            if not passes(file, folder):
                sys.exit(f"the tests of {file} fail without any mutation; repair them first")
        for mutation in todo:
            row = mutation.described((ROOT / mutation.file).read_text("utf-8"))
            if options.list:
                print(row)
                continue
            left = survives(mutation, folder)
            survivors += left
            print(f"{'SURVIVED' if left else 'killed  '} {row}", flush=True)
    print(f"{len(todo)} mutations, {survivors} survivors, {time.monotonic() - start:.0f} s")


if __name__ == "__main__":
    main()
