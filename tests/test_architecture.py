"""Import order, rank questions in the core, sizes, and words that do not belong here."""

from __future__ import annotations

import ast
import io
import subprocess
import tokenize
from fnmatch import fnmatchcase
from graphlib import CycleError, TopologicalSorter
from itertools import pairwise
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "mwdcal"

# From the bottom up: a module imports from its own layer or from one above it in this table.
LAYERS = (
    ("errors", "core.vectors"),
    ("core.observables", "core.models"),
    ("core.fast", "core.machine", "core.compiled"),
    ("core.fused", "core.kernels"),
    ("core.solvers",),
    (
        "core.newton",
        "core.evidence",
        "core.problem",
        "core.robust",
        "core.sums",
        "core.swarm",
        "core.uncertainty",
        "core.variance",
        "core.observability",
        "core.standstill",
        "core.station_means",
        "core.allan",
        "core.noise_terms",
        "core.start",
        "core.exact",
        "core.separable",
        "core",
    ),
    ("readings", "profile", "profiles", "soaks"),
    ("calibration",),
    ("evidence", "prior", "options"),
    ("methods", "estimate", "notation"),
    ("courses",),
    ("covariance",),
    (
        "axes",
        "checks",
        "curves",
        "correction",
        "plausibility",
        "residuals",
        "scatter",
        "selection",
        "stand",
        "strengths",
        "structure",
    ),
    ("findings",),
    (
        "calibrate",
        "compare",
        "departures",
        "gauge",
        "predict",
        "quality",
        "roll_sets",
        "roll_test",
        "simulate",
    ),
    ("fleet", "fleet_accuracy", "fleet_checks", "fleet_choices", "fleet_curves", "fleet_findings"),
    ("files", "files.*"),
    ("registry", "registry.*", "datasets", "station_findings", "stations", "noise"),
    ("",),  # the package itself: its public names
    (
        "app",
        "app.asked",
        "app.calibrating",
        "app.choices",
        "app.comparison",
        "app.comparison_plots",
        "app.conversion",
        "app.fleet_asked",
        "app.fleet_plots",
        "app.fleet_report",
        "app.fleet_summary",
        "app.fleets",
        "app.lean",
        "app.noise_asked",
        "app.noise_plots",
        "app.noises",
        "app.plots",
        "app.pool",
        "app.worker",
        "app.report",
        "app.report.*",
        "app.progress",
        "app.standstills",
        "app.streaming",
        "app.tables",
        "app.text",
    ),
    ("app.cli", "app.cli.*", "app.web", "app.web.*", "__main__"),
)
# Pairs that share a layer and still never import each other.
STRANGERS = (("app.cli", "app.web"),)

MAX_FUNCTION_LINES = 50
MAX_MODULE_LINES = 400

RANK_ATTRIBUTES = {"ndim", "T", "squeeze"}

# Spelt in pieces, so that this file does not contain them.
FORBIDDEN_WORDS = ("/" + "work" + "/", "shared" + "/" + "design")


def module_name(path: Path) -> str:
    """Dotted name below the package: 'core.vectors'; '' is the package itself."""
    parts = path.relative_to(SOURCE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


PATHS = {module_name(path): path for path in sorted(SOURCE.rglob("*.py"))}
TREES = {name: ast.parse(path.read_text("utf-8"), str(path)) for name, path in PATHS.items()}


def layer(name: str) -> int | None:
    """Index of a module's layer, None for one that is not in the table."""
    for index, patterns in enumerate(LAYERS):
        if any(fnmatchcase(name, pattern) for pattern in patterns):
            return index
    return None


def imported_base(name: str, node: ast.ImportFrom) -> str | None:
    """The module a 'from' statement names, None when it is not one of ours."""
    if node.level:
        package = name.split(".") if PATHS[name].name == "__init__.py" else name.split(".")[:-1]
        above = package[: len(package) - node.level + 1]
        return ".".join([*filter(None, above), *filter(None, [node.module])])
    if node.module == "mwdcal" or (node.module or "").startswith("mwdcal."):
        return (node.module or "").removeprefix("mwdcal").removeprefix(".")
    return None


def from_targets(name: str, node: ast.ImportFrom) -> set[str]:
    """Modules that a 'from' statement reaches: submodules by name, else the module itself."""
    base = imported_base(name, node)
    if base is None:
        return set()
    # The version is bound before the package imports anything: no dependency on its public names.
    names = [alias.name for alias in node.names if (base, alias.name) != ("", "__version__")]
    members = [f"{base}.{name}".lstrip(".") for name in names]
    return {member if member in PATHS else base for member in members}


def targets(name: str) -> set[str]:
    """All modules of the package that a module imports, at any depth of its code."""
    found: set[str] = set()
    for node in ast.walk(TREES[name]):
        if isinstance(node, ast.ImportFrom):
            found |= from_targets(name, node)
        elif isinstance(node, ast.Import):
            ours = [a.name for a in node.names if a.name.split(".")[0] == "mwdcal"]
            found |= {dotted.removeprefix("mwdcal").removeprefix(".") for dotted in ours}
    return found - {name}


IMPORTS = {name: targets(name) for name in PATHS}


@pytest.mark.parametrize("name", PATHS)
def test_module_is_in_the_layers_table(name: str) -> None:
    assert layer(name) is not None, f"mwdcal.{name}: add it to the layers table above"


@pytest.mark.parametrize("name", PATHS)
def test_imports_point_downwards(name: str) -> None:
    own = layer(name)
    known = {target: layer(target) for target in IMPORTS[name]}
    upward = [t for t, other in known.items() if None not in (own, other) and other > own]
    assert not upward, f"mwdcal.{name} imports from a higher layer: {', '.join(sorted(upward))}"


def test_no_import_cycle() -> None:
    try:
        TopologicalSorter(IMPORTS).prepare()
    except CycleError as error:
        pytest.fail("import cycle: " + " <- ".join(error.args[1]))


@pytest.mark.parametrize("pair", STRANGERS, ids="-".join)
def test_strangers_never_import_each_other(pair: tuple[str, str]) -> None:
    def inside(name: str, top: str) -> bool:
        return name == top or name.startswith(top + ".")

    crossings = [
        f"{name} imports {target}"
        for one, other in (pair, pair[::-1])
        for name in PATHS
        for target in IMPORTS[name]
        if inside(name, one) and inside(target, other)
    ]
    assert not crossings, "; ".join(crossings)


def rank_questions(tree: ast.AST) -> list[tuple[int, str]]:
    """Line and name of each attribute or imported name that asks for or forces a rank."""

    def asks(word: str) -> bool:
        return word in RANK_ATTRIBUTES or word.startswith("atleast_")

    attributes = [n for n in ast.walk(tree) if isinstance(n, ast.Attribute) and asks(n.attr)]
    imports = [n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)]
    names = [(n.lineno, a.name) for n in imports for a in n.names if asks(a.name)]
    return names + [(node.lineno, node.attr) for node in attributes]


@pytest.mark.parametrize("name", [n for n in PATHS if n == "core" or n.startswith("core.")])
def test_core_asks_no_rank(name: str) -> None:
    found = [f"line {line}: {word}" for line, word in rank_questions(TREES[name])]
    advice = "broadcast over leading axes; use swapaxes(-1, -2) or [..., None]"
    assert not found, f"mwdcal.{name}, {'; '.join(found)}. {advice}"


def docstring_lines(tree: ast.AST) -> set[int]:
    """Lines that belong to docstrings."""
    lines: set[int] = set()
    holders = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
    for node in ast.walk(tree):
        if isinstance(node, holders) and ast.get_docstring(node, clean=False) is not None:
            first = node.body[0]
            lines |= set(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    return lines


def code_lines(name: str) -> int:
    """Lines with code on them: not blank, not comment, not docstring."""
    silent = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}
    tokens = tokenize.generate_tokens(io.StringIO(PATHS[name].read_text("utf-8")).readline)
    spans = [range(t.start[0], t.end[0] + 1) for t in tokens if t.type not in silent and t.string]
    return len({line for span in spans for line in span} - docstring_lines(TREES[name]))


def function_lines(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines from 'def' to the end, without the docstring."""
    total = (node.end_lineno or node.lineno) - node.lineno + 1
    if ast.get_docstring(node, clean=False) is None:
        return total
    first = node.body[0]
    return total - ((first.end_lineno or first.lineno) - first.lineno + 1)


@pytest.mark.parametrize("name", PATHS)
def test_functions_are_short(name: str) -> None:
    functions = (
        n for n in ast.walk(TREES[name]) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)
    )
    sizes = {f"{node.name} (line {node.lineno})": function_lines(node) for node in functions}
    long = {where: size for where, size in sizes.items() if size > MAX_FUNCTION_LINES}
    assert not long, f"mwdcal.{name}: over {MAX_FUNCTION_LINES} lines: {long}"


@pytest.mark.parametrize("name", PATHS)
def test_modules_are_short(name: str) -> None:
    size = code_lines(name)
    assert size <= MAX_MODULE_LINES, f"mwdcal.{name} has {size} lines of code; split it"


def tracked_files() -> list[Path]:
    """Files under version control, and new ones that git does not ignore."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    try:
        listed = subprocess.run(command, cwd=ROOT, capture_output=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout")
    paths = (ROOT / name.decode() for name in listed.split(b"\0") if name)
    return [path for path in paths if path.is_file() and not path.is_symlink()]


def test_forbidden_words_do_not_occur() -> None:
    found = [
        f"{path.relative_to(ROOT)}: {word}"
        for path in tracked_files()
        for word in FORBIDDEN_WORDS
        if word.encode() in path.read_bytes()
    ]
    assert not found, "\n".join(found)


def test_layers_table_has_no_module_twice() -> None:
    names = sorted(pattern for patterns in LAYERS for pattern in patterns)
    assert all(one != other for one, other in pairwise(names))
