"""Python values as C source: text of others that stays text, numbers, initialisers and macros."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import resources
from string import Template

import numpy as np

from mwdcal.geometry.vectors import AnyArray

LONGEST_TEXT = 200
"""Characters of a text of others that are kept: C promises no more than 4095 in a string."""
_SPECIAL = '"\\*?'


def literal(text: object) -> str:
    r"""Text of others for a comment or a string, neither of which it can end.

    What C could take for more than text is an octal escape of its UTF-8 bytes, which a string gives back.

    >>> literal('A*/ "B"??/\n°')
    'A\\052/ \\042B\\042\\077\\077/\\012\\302\\260'
    """
    shown = str(text)
    cut = shown[:LONGEST_TEXT] + (" ..." if shown[LONGEST_TEXT:] else "")
    return "".join(c if " " <= c <= "~" and c not in _SPECIAL else _octal(c) for c in cut)


def _octal(character: str) -> str:
    return "".join(f"\\{byte:03o}" for byte in character.encode("utf-8", "surrogatepass"))


def initialiser(values: AnyArray | float) -> str:
    """Nested braces with every number in the digits it has; a negative zero is zero.

    >>> initialiser(np.array([[1.0, -0.0], [0.25, 1e-05]]))
    '{{1.0, 0.0}, {0.25, 1e-05}}'
    """
    if isinstance(values, np.ndarray) and values.shape:
        return "{" + ", ".join(map(initialiser, values)) + "}"
    return repr(np.asarray(values + 0).item())


def comment(lines: Iterable[str]) -> str:
    """The lines of a block comment, each with its star; blank ones without a space at the end."""
    return "\n".join(f" * {line}".rstrip() for line in lines)


def macro(name: str, value: str, remark: str = "") -> str:
    """A definition on one line."""
    return f"#define {name} {value}" + (f" /* {remark} */" if remark else "")


def source(name: str, **values: object) -> str:
    """A source file of the package, its `$names` replaced by values; without values as it stands."""
    text = resources.files("mwdcal.firmware").joinpath("sources", name).read_text("utf-8")
    return Template(text).substitute(values) if values else text
