"""Formulas of error models as text: parsed once, evaluated on arrays, and nothing but arithmetic.

The syntax is that of ISCWSA's error model files, such as ``Sin(Inc)^0.25`` or ``Max(1, Sqr(10 / (MD - MDPrev)))``.
"""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Mapping

import numpy as np

from mwdcal.errors import InputError
from mwdcal.geometry.vectors import Array, ArrayLike

FUNCTIONS: dict[str, tuple[Callable[..., Array], int]] = {
    "sin": (np.sin, 1),
    "cos": (np.cos, 1),
    "tan": (np.tan, 1),
    "sqr": (np.sqrt, 1),
    "sqrt": (np.sqrt, 1),
    "abs": (np.abs, 1),
    "max": (np.maximum, 2),
    "min": (np.minimum, 2),
}
"""Functions of formulas and how many arguments each takes; angles in radians."""
LONGEST_FORMULA = 500
"""Characters; published ones have at most 120."""
_OPERATORS: dict[type[ast.operator], Callable[[Array, Array], Array]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}

Formula = Callable[[Mapping[str, ArrayLike]], Array]
"""The value of a formula for quantities by name, in lower case."""


def parsed(text: str, names: frozenset[str]) -> Formula:
    """A formula from its text; `names` are the quantities that it may use, in lower case.

    Raises:
        InputError: the text is no formula, or uses another name.
    """
    try:
        if len(text) > LONGEST_FORMULA:
            raise SyntaxError
        body = ast.parse(text.replace("^", "**").strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise InputError(f"'{text[:80]}' is not a formula.") from None
    return _evaluated(body, names, text)


def _evaluated(node: ast.expr, names: frozenset[str], text: str) -> Formula:
    match node:
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            return lambda values: np.asarray(float(number))
        case ast.Name(id=name) if name.lower() in names:
            return lambda values: np.asarray(values[name.lower()], float)
        case ast.UnaryOp(op=ast.USub() | ast.UAdd() as sign, operand=operand):
            of = _evaluated(operand, names, text)
            return (lambda values: -of(values)) if isinstance(sign, ast.USub) else of
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            apply, pair = _OPERATORS[type(op)], [_evaluated(n, names, text) for n in (left, right)]
            return lambda values: np.asarray(apply(pair[0](values), pair[1](values)))
        case ast.Call(func=ast.Name(id=name), args=args, keywords=[]) if FUNCTIONS.get(
            name.lower(), (None, -1)
        )[1] == len(args):
            function, parts = FUNCTIONS[name.lower()][0], [_evaluated(n, names, text) for n in args]
            return lambda values: np.asarray(function(*(part(values) for part in parts)))
    raise InputError(
        f"'{text}': '{ast.unparse(node)}' is not understood. Formulas use {', '.join(sorted(names))}, "
        f"numbers, + - * / ^ and {', '.join(FUNCTIONS)}."
    )
