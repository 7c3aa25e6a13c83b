"""Sphinx configuration. The build needs no network, and neither do the pages."""

from __future__ import annotations

import importlib.util
import re
import sys
import textwrap
from pathlib import Path

import mwdcal

sys.path.insert(0, str(Path(__file__).parent / "_extensions"))

project = "mwdcal"
author = "The mwdcal authors"
project_copyright = author
version = release = mwdcal.__version__

extensions = [
    "accessible",
    "mathml",
    "myst_parser",
    "screens",
    "search_index",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_click",
    "sphinx_design",
]
exclude_patterns = ["_build"]
source_suffix = {".md": "markdown"}

myst_enable_extensions = ["colon_fence", "dollarmath", "fieldlist"]
myst_heading_anchors = 3

default_role = "code"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True, "undoc-members": False}
autodoc_type_aliases = {"Array": "Array", "ArrayLike": "ArrayLike"}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True

COMMANDS = "reference/commands"
man_pages = [(COMMANDS, project, "calibration of MWD directional tools", [author], 1)]
today = release  # in place of a date: the same sources, the same manual

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["print.css"]
smartquotes_action = "qe"  # two hyphens begin an option
html_title = f"mwdcal {release}"
html_math_renderer = "mathml"
html_copy_source = False
html_search_scorer = str(Path(__file__).with_name("search.js"))
html_show_sphinx = False

# A section of a page whose only content is the documentation of one module.
MODULE_SECTION = re.compile(
    r"^##+ [^\n]+\n\n```\{eval-rst\}\n\.\. (?:automodule|click):: ([\w.]+).*?\n```\n", re.M | re.S
)


def exists(module: str) -> bool:
    """Whether a module can be found, without importing it."""
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        return False


def leave_out_missing(app, docname, source) -> None:
    """Drop the sections about modules that do not exist (yet)."""
    source[0] = MODULE_SECTION.sub(lambda m: m[0] if exists(m[1]) else "", source[0])


def escaped(line: str) -> str:
    """A line in which |g| and sd_, outside backticks, stand for themselves."""
    pieces = re.split(r"(`+[^`]*`+_*)", line)
    return "".join(
        p if p.startswith("`") else re.sub(r"(?<=\w)_(?!\w)", r"\_", p.replace("|", r"\|"))
        for p in pieces
    )


def escape_docstring(app, what, name, obj, options, lines) -> None:
    """Let docstrings be plain text, in which bars and a last underscore mean nothing."""
    literal = False
    for index, line in enumerate(lines):
        literal = line == "::" or (literal and (not line or line.startswith("    ")))
        lines[index] = line if literal else escaped(line)


def escape_command(app, context, lines) -> None:
    """The same for the help texts of commands, whose lines that stand for themselves begin with a bar."""
    for index, line in enumerate(lines):
        bar = re.match(r"\s*(?:\.\..*|\| )?", line)[0]
        lines[index] = bar + escaped(line[len(bar) :])


def literal_columns(app, what, name, obj, options, lines) -> None:
    """Keep the layout of paragraphs in module docstrings that are set in columns."""
    if what != "module":
        return
    paragraphs = re.split(r"\n\s*\n", "\n".join(lines).strip("\n"))
    kept = [
        "::\n\n" + textwrap.indent(p, "    ") if re.search(r"\S {3,}\S", p) else p
        for p in paragraphs
    ]
    lines[:] = [*"\n\n".join(kept).split("\n"), ""]


def commands_are_outdated(app, env, added, changed, removed) -> list[str]:
    """The pages of the commands, which are not known to depend on the code they are read from."""
    return [name for name in env.found_docs if name.startswith(COMMANDS)]


def setup(app) -> None:
    app.connect("source-read", leave_out_missing)
    app.connect("env-get-outdated", commands_are_outdated)
    app.connect("autodoc-process-docstring", literal_columns)
    app.connect("autodoc-process-docstring", escape_docstring)
    for part in ("description", "options", "arguments", "epilog"):
        app.connect(f"sphinx-click-process-{part}", escape_command)
