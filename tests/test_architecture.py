"""Import order, rank questions in the core, sizes, and words that do not belong here."""

from __future__ import annotations

import ast
import re
import subprocess
from collections.abc import Callable
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "mwdcal"

# From the bottom up: a room imports from rooms below it. Rooms of one floor are strangers.
FLOORS = (
    ("errors",),
    ("signals",),
    ("pool",),
    ("geometry",),
    ("sensor",),
    ("estimation",),
    ("calibration",),
    ("use",),
    ("files", "profiles"),
    ("faults",),
    (
        *("certificate", "comparison", "drift", "firmware", "fleet", "identification"),
        *("logs", "planning", "registry", "survey"),
    ),
    ("presentation",),
    ("library",),
    ("",),  # the package itself: its public names
    ("app",),
    ("__main__",),
)
ARRAY_ROOMS = ("geometry", "estimation", "sensor.models")

MAX_FUNCTION_LINES = 50

RANK_ATTRIBUTES = {"ndim", "T", "squeeze"}

# Spelt in pieces, so that this file does not contain them.
FORBIDDEN_WORDS = ("/" + "work" + "/", "shared" + "/" + "design")


def module_name(path: Path) -> str:
    """Dotted name below the package: 'core.vectors'; '' is the package itself."""
    parts = path.relative_to(SOURCE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


PATHS = {module_name(path): path for path in sorted(SOURCE.rglob("*.py"))}
TREES = {name: ast.parse(path.read_text("utf-8"), str(path)) for name, path in PATHS.items()}


def floor(name: str) -> int:
    """Index of the floor on which a module's room lies."""
    room = name.split(".", 1)[0]
    return next(index for index, rooms in enumerate(FLOORS) if room in rooms)


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
def test_every_room_lies_on_a_floor(name: str) -> None:
    assert any(name.split(".", 1)[0] in rooms for rooms in FLOORS), (
        f"mwdcal.{name}: enter its room in the floors above"
    )


@pytest.mark.parametrize("name", PATHS)
def test_imports_point_downwards(name: str) -> None:
    room = name.split(".", 1)[0]
    others = {target for target in IMPORTS[name] if target.split(".", 1)[0] != room}
    upward = sorted(target for target in others if floor(target) >= floor(name))
    assert not upward, f"mwdcal.{name} imports from a room above or beside it: {', '.join(upward)}"


ROOMS = sorted(name for name, path in PATHS.items() if path.name == "__init__.py" and name)


def test_contributing_lists_the_rooms_with_their_purpose() -> None:
    table = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    rows = re.findall(r"^\| `([a-z./]+)/` \| (.*?) \|", table, re.M)
    purposes = {room: (ast.get_docstring(TREES[room]) or "").split("\n")[0] for room in ROOMS}
    assert all(purposes.values()), "each room says in its __init__ in one line what it holds"
    assert {room.replace("/", "."): said for room, said in rows} == purposes
    assert [floor(room.replace("/", ".")) for room, _ in rows] == sorted(map(floor, ROOMS))


def test_no_import_cycle() -> None:
    try:
        TopologicalSorter(IMPORTS).prepare()
    except CycleError as error:
        pytest.fail("import cycle: " + " <- ".join(error.args[1]))


def rank_questions(tree: ast.AST) -> list[tuple[int, str]]:
    """Line and name of each attribute or imported name that asks for or forces a rank."""

    def asks(word: str) -> bool:
        return word in RANK_ATTRIBUTES or word.startswith("atleast_")

    attributes = [n for n in ast.walk(tree) if isinstance(n, ast.Attribute) and asks(n.attr)]
    imports = [n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)]
    names = [(n.lineno, a.name) for n in imports for a in n.names if asks(a.name)]
    return names + [(node.lineno, node.attr) for node in attributes]


@pytest.mark.parametrize("name", [n for n in PATHS if n.startswith(ARRAY_ROOMS)])
def test_array_code_asks_no_rank(name: str) -> None:
    found = [f"line {line}: {word}" for line, word in rank_questions(TREES[name])]
    advice = "broadcast over leading axes; use swapaxes(-1, -2) or [..., None]"
    assert not found, f"mwdcal.{name}, {'; '.join(found)}. {advice}"


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


def constants(tree: ast.Module) -> list[str]:
    """Upper-case names that a module assigns at its top level."""
    targets = [t for n in tree.body if isinstance(n, ast.Assign) for t in n.targets]
    targets += [n.target for n in tree.body if isinstance(n, ast.AnnAssign)]
    names = [n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)]
    return [name for name in names if name.isupper() and name.lstrip("_") != "T"]


def classes(tree: ast.Module) -> list[str]:
    """Names of all classes of a module."""
    return [node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]


@pytest.mark.parametrize("names", [classes, constants], ids=["classes", "constants"])
def test_a_name_means_one_thing(names: Callable[[ast.Module], list[str]]) -> None:
    places: dict[str, list[str]] = {}
    for module, tree in TREES.items():
        for name in names(tree):
            places.setdefault(name, []).append(module)
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


@pytest.mark.parametrize(
    "name", [n for n in PATHS if n.split(".")[0] not in ("presentation", "app", "__main__")]
)
def test_messages_of_the_library_name_arguments_not_options(name: str) -> None:
    strings = (n for n in ast.walk(TREES[name]) if isinstance(n, ast.Constant))
    typed = [(n.lineno, n.value) for n in strings if re.search(r"(?<![\w-])--[a-z]", str(n.value))]
    assert not typed, f"mwdcal.{name}: write `order`, of which the command makes --order: {typed}"


def identifiers(tree: ast.Module) -> set[str]:
    """Names that a module gives to variables, arguments, attributes, functions and classes."""
    names = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name)}
    names |= {n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute)}
    names |= {n.arg for n in ast.walk(tree) if isinstance(n, ast.arg)}
    defined = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
    return names | {n.name for n in ast.walk(tree) if isinstance(n, defined)}


@pytest.mark.parametrize("name", PATHS)
def test_names_are_nouns_not_participles(name: str) -> None:
    """`as_found` is the term of calibration laboratories for a tool before it is adjusted."""
    vague = re.compile(r"(^|_)(own(?!_ax)|told|(?<!as_)found|made|asked)(_|$)", re.IGNORECASE)
    odd = {word for word in identifiers(TREES[name]) if vague.search(word)}
    assert not odd, f"mwdcal.{name}: name what it is, not what was done: {odd}"


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
