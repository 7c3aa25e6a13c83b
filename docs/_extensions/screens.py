"""The directive `screen`: a command and what it prints, from the screens that the tests store."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from docutils import nodes
from docutils.parsers.rst import Directive

if TYPE_CHECKING:
    from sphinx.application import Sphinx

TESTS = Path(__file__).resolve().parents[2] / "tests"
WIDTH = 80


def screen(name: str) -> str:
    """The line that was typed and the lines that it printed, as on a terminal of 80 columns."""
    sys.path.insert(0, str(TESTS))
    from test_screens import SCREENS

    stored = (TESTS / "screens" / f"{name}-{WIDTH}.txt").read_text("utf-8")
    printed = [line for line in stored.splitlines()[1:] if line not in ("--- stdout", "--- stderr")]
    return "\n".join([f"$ mwdcal {shlex.join(SCREENS[name])}", *printed])


class Screen(Directive):
    """`screen:: NAME` of a screen in `tests/screens`."""

    required_arguments = 1
    option_spec: ClassVar[dict[str, object]] = {}

    def run(self) -> list[nodes.Node]:
        """The literal block."""
        text = screen(self.arguments[0])
        return [nodes.literal_block(text, text, language="text", classes=["screen"])]


def setup(app: Sphinx) -> dict[str, bool]:
    """Add the directive."""
    app.add_directive("screen", Screen)
    return {"parallel_read_safe": True}
