"""Import order, rank questions in the core, sizes, and words that do not belong here."""

from __future__ import annotations

import ast
import re
import subprocess
from collections.abc import Callable
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "mwdcal"

# From the bottom up: a room imports from rooms below it. Rooms of one floor are strangers.
FLOORS = (
    ("errors", "digests"),
    ("signals", "extras"),
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
    ("bench",),
    ("app",),
    ("selftest",),
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


class Trees(dict[str, ast.Module]):
    """Syntax trees of the modules, each parsed when it is first looked at."""

    def __missing__(self, name: str) -> ast.Module:
        self[name] = ast.parse(PATHS[name].read_text("utf-8"), str(PATHS[name]))
        return self[name]


TREES = Trees()


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


@cache
def imports() -> dict[str, set[str]]:
    """Of each module, the modules of the package that it imports."""
    return {name: targets(name) for name in PATHS}


def none(offences: dict[str, Any], advice: str) -> None:
    """Every module that breaks a rule is named, with what breaks it."""
    broken = [f"mwdcal.{name}: {offence}" for name, offence in offences.items() if offence]
    assert not broken, "\n".join([advice, *broken])


def test_every_room_lies_on_a_floor() -> None:
    known = {room for rooms in FLOORS for room in rooms}
    strange = {name for name in PATHS if name.split(".", 1)[0] not in known}
    none(dict.fromkeys(strange, "its room"), "enter rooms in the floors above")


def upward(name: str) -> list[str]:
    """Modules that a module imports from a room above or beside its room."""
    room = name.split(".", 1)[0]
    others = {target for target in imports()[name] if target.split(".", 1)[0] != room}
    return sorted(target for target in others if floor(target) >= floor(name))


def test_imports_point_downwards() -> None:
    none({name: upward(name) for name in PATHS}, "imports from a room above or beside it")


ROOMS = sorted(name for name, path in PATHS.items() if path.name == "__init__.py" and name)


def test_contributing_lists_the_rooms_with_their_purpose() -> None:
    table = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    rows = re.findall(r"^\| `([a-z./]+)/` \| (.*?) \|", table, re.M)
    purposes = {room: (ast.get_docstring(TREES[room]) or "").split("\n")[0] for room in ROOMS}
    assert all(purposes.values()), "each room says in its __init__ in one line what it holds"
    assert {room.replace("/", "."): said for room, said in rows} == purposes
    assert [floor(room.replace("/", ".")) for room, _ in rows] == sorted(map(floor, ROOMS))


def test_contributing_names_where_things_are_decided() -> None:
    table = (ROOT / "CONTRIBUTING.md").read_text("utf-8").partition("## Where is it decided?")[2]
    rows = re.findall(r"^\| [^|]+ \| `([a-z_.]+)` \| `?(\w*)`? *\|", table, re.M)
    assert len(rows) >= 20
    known = {module: {*constants(TREES[module]), *identifiers(TREES[module])} for module, _ in rows}
    assert not [row for row in rows if row[1] and row[1] not in known[row[0]]]


def test_no_import_cycle() -> None:
    try:
        TopologicalSorter(imports()).prepare()
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


def test_array_code_asks_no_rank() -> None:
    questions = {n: rank_questions(TREES[n]) for n in PATHS if n.startswith(ARRAY_ROOMS)}
    none(questions, "broadcast over leading axes; use swapaxes(-1, -2) or [..., None]")


def function_lines(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines from 'def' to the end, without the docstring."""
    total = (node.end_lineno or node.lineno) - node.lineno + 1
    if ast.get_docstring(node, clean=False) is None:
        return total
    first = node.body[0]
    return total - ((first.end_lineno or first.lineno) - first.lineno + 1)


def long_functions(tree: ast.AST) -> dict[str, int]:
    """Lines of each function that has too many."""
    defined = ast.FunctionDef | ast.AsyncFunctionDef
    functions = (node for node in ast.walk(tree) if isinstance(node, defined))
    sizes = {f"{node.name} (line {node.lineno})": function_lines(node) for node in functions}
    return {where: size for where, size in sizes.items() if size > MAX_FUNCTION_LINES}


def test_functions_are_short() -> None:
    none({n: long_functions(TREES[n]) for n in PATHS}, f"lines over {MAX_FUNCTION_LINES}")


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
    for module in PATHS:
        for name in names(TREES[module]):
            places.setdefault(name, []).append(module)
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


def options_in_words(tree: ast.AST) -> list[tuple[int, str]]:
    """Line and text of each string that spells an option."""
    strings = (n for n in ast.walk(tree) if isinstance(n, ast.Constant))
    return [(n.lineno, n.value) for n in strings if re.search(r"(?<![\w-])--[a-z]", str(n.value))]


def test_messages_of_the_library_name_arguments_not_options() -> None:
    shown = ("presentation", "app", "selftest", "__main__")
    typed = {n: options_in_words(TREES[n]) for n in PATHS if n.split(".")[0] not in shown}
    none(typed, "write `order`, of which the command makes --order")


ONCE = {
    "9.80665": "geometry.units",
    "0.3048": "geometry.units",
    "1e-9, freedom": "",
    ".hexdigest()": "digests",
    'text == "undetermined"': "",
}
"""Pieces of code that only one module may have, or none."""


@pytest.mark.parametrize("piece", ONCE)
def test_a_rule_stands_in_one_place(piece: str) -> None:
    """Text in quotes may name a figure; a fleet's `parts` and `sources` hash pieces of a table."""
    quoted = re.compile(r'"""(?:.|\n)*?"""|"[^"\n]*"')
    code = {n: quoted.sub("", PATHS[n].read_text("utf-8")) for n in PATHS if n != ONCE[piece]}
    fleet = ("fleet.parts", "fleet.sources")
    none({n: "again" for n, text in code.items() if piece in text and n not in fleet}, piece)


def identifiers(tree: ast.Module) -> set[str]:
    """Names that a module gives to variables, arguments, attributes, functions and classes."""
    names = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name)}
    names |= {n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute)}
    names |= {n.arg for n in ast.walk(tree) if isinstance(n, ast.arg)}
    defined = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
    return names | {n.name for n in ast.walk(tree) if isinstance(n, defined)}


def test_names_are_nouns_not_participles() -> None:
    """`as_found` is the term of calibration laboratories for a tool before it is adjusted."""
    vague = re.compile(r"(^|_)(own(?!_ax)|told|(?<!as_)found|made|asked)(_|$)", re.IGNORECASE)
    odd = {name: set(filter(vague.search, identifiers(TREES[name]))) for name in PATHS}
    none(odd, "name what it is, not what was done")


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
