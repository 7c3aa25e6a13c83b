"""An error model of the industry: what its terms do to the direction and depth of surveys, and how they add up.

A term has a size (1σ), formulas for the errors of depth, inclination and azimuth by one unit of it, and a way it
propagates: *random* errors are new at every station; *systematic* ones last over a run, *well* ones over a well, and
*global* ones over all wells.
Reference: SPE 67616; ISCWSA MWD error model, revision 5; OWSG set A, Rev 5.1.
"""

from __future__ import annotations

import ast
import operator
import os
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from mwdcal.digests import sha256_of
from mwdcal.errors import InputError, reason
from mwdcal.geometry.observables import VERTICAL
from mwdcal.geometry.units import STANDARD_GRAVITY
from mwdcal.geometry.vectors import Array, ArrayLike
from mwdcal.survey.path import arcs, hole_direction

# --------------------------------------------------------------------------
# Formulas of error models as text: parsed once, evaluated on arrays, and nothing but arithmetic.
#
# The syntax is that of ISCWSA's error model files, such as ``Sin(Inc)^0.25`` or ``Max(1, Sqr(10 / (MD - MDPrev)))``.

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


BUILT_IN = "owsg-mwd"
"""The error model that counts by default."""
LEAST_INCLINATION = 1e-8
"""Inclination, rad, at which errors of azimuth are taken where a hole is closer to vertical.

They go with 1/sin(inclination) there; sideways, with sin(inclination), they have a limit.
"""
USUAL_COURSE = 30.0
"""Distance between surveys where no depths state it, m."""
COURSE_TERMS = "XCL"
"""First letters of terms that shift a whole course, from one station to the next, and no survey."""
LARGEST_MODEL = 1_000_000
"""Bytes of a file; published models have about 20,000."""
MOST_ERROR_TERMS = 200
OF_STATIONS = (
    "md",
    "tvd",
    "inc",
    "azt",
    "azm",
    "bfield",
    "dip",
    "gfield",
    "mdprev",
    "incprev",
    "azprev",
)
"""Quantities of a hole by their names in formulas."""
FORMULA_NAMES = frozenset({*OF_STATIONS, "pi"})
"""Names that formulas may use, besides the parameters of the model."""


class ErrorTerm(msgspec.Struct, frozen=True, kw_only=True):
    """One term: 1σ in its units, how it propagates, and its formulas in the syntax of ISCWSA's files."""

    name: str
    value: float
    units: Literal["m", "-", "1/m", "m/s2", "nT", "deg", "deg.nT", "deg/nT", "rad"]
    propagation_mode: Literal["Random", "Systematic", "Well", "Global"]
    depth_formula: str = "0"
    inclination_formula: str = "0"
    azimuth_formula: str = "0"

    @property
    def size(self) -> float:
        """1σ with angles in radians."""
        return float(np.radians(self.value)) if self.units.startswith("deg") else self.value

    @property
    def kind(self) -> str:
        """One error for all stations ("lasting"), one for each ("random"), or one for each course ("course")."""
        if self.propagation_mode != "Random":
            return "lasting"
        return "course" if self.name.startswith(COURSE_TERMS) else "random"


class _Parameters(msgspec.Struct, frozen=True):
    inc_min: float = 0.0
    inc_max: float = 180.0
    XCLTortuosity: float = 0.0


class _Metadata(msgspec.Struct, frozen=True):
    short_name: str
    source: str = ""


class ErrorModelFile(msgspec.Struct, frozen=True, kw_only=True):
    """An error model as ISCWSA's JSON files hold it."""

    metadata: _Metadata
    terms: list[ErrorTerm]
    parameters: _Parameters = _Parameters()


@dataclass(frozen=True)
class Hole:
    """Stations (n,) of a well as formulas see them: values (n,) or one value by name, in m, rad, nT and m/s²."""

    quantities: Mapping[str, Array]

    @staticmethod
    def along(
        md: Array,
        tvd: Array,
        inclination: Array,
        azimuth: Array,
        magnetic: Array,
        field: ArrayLike,
        dip: ArrayLike,
        gravity: ArrayLike = STANDARD_GRAVITY,
        last: tuple[float, float, float] | None = None,
        above: float = np.nan,
    ) -> Hole:
        """A hole from its stations in their order; `azimuth` from the north of the path, `magnetic` from magnetic.

        `last`: depth, inclination and azimuth of the station before; None: a straight course of 30 m leads to the
        first, as to a station without depth. Where the hole was vertical the azimuth before is that of the station.
        `above`: depth of the station before the last, from which the course to one at the depth of the last counts.
        """
        last = (np.nan, inclination[0], azimuth[0]) if last is None else last
        each = zip(last, (md, inclination, azimuth), strict=True)
        before = [np.concatenate([[first], values[:-1]]) for first, values in each]
        straight = np.abs(np.sin(before[1])) <= VERTICAL
        before[2] = np.where(straight, azimuth, before[2])
        md = np.where(np.isfinite(md), md, 0.0)
        before[0] = _depth_before(np.append(last[0], md), np.append(above, before[0]))[1:]
        values = (md, tvd, inclination, azimuth, magnetic, field, dip, gravity, *before)
        return Hole({n: np.asarray(v, float) for n, v in zip(OF_STATIONS, values, strict=True)})

    def part(self, rows: slice) -> Hole:
        """Some of the stations."""
        return Hole({n: v[rows] if v.ndim else v for n, v in self.quantities.items()})

    @property
    def md(self) -> Array:
        """Measured depth (n,), m."""
        return self.quantities["md"]

    @property
    def inclination(self) -> Array:
        """Inclination (n,), rad."""
        return self.quantities["inc"]

    @property
    def azimuth(self) -> Array:
        """Azimuth (n,) from the north of the path, rad."""
        return self.quantities["azt"]

    @property
    def dogleg(self) -> Array:
        """Angle (n,) between the directions at a station and the one before, over the course between, rad/m."""
        ends = (
            hole_direction(self.inclination, self.azimuth),
            hole_direction(self.quantities["incprev"], self.quantities["azprev"]),
        )
        course = arcs(np.stack([self.quantities["mdprev"], self.md], -1), np.stack(ends, -2))
        return np.asarray(course.dogleg[..., 0] / course.length[..., 0])


@dataclass(frozen=True)
class ErrorModel:
    """Terms with their formulas parsed, and where they come from."""

    name: str
    source: str
    terms: tuple[ErrorTerm, ...]
    parameters: Mapping[str, float]
    formulas: Mapping[str, tuple[Formula, ...]]
    digest: str = ""

    def without(self, names: Collection[str]) -> ErrorModel:
        """The model without some terms."""
        kept = tuple(term for term in self.terms if term.name not in names)
        return ErrorModel(self.name, self.source, kept, self.parameters, self.formulas, self.digest)

    def shifts(self, hole: Hole, kind: str) -> dict[str, Array]:
        """Shifts (n, 3) by 1σ of each term of a kind: of the direction upward and sideways, rad, and of depth, m.

        Definition: upward is the error of inclination, sideways sin(inclination) times the error of azimuth.
        Singular: finite at vertical, as the limit for a hole that rises to the azimuth.
        """
        names = [term.name for term in self._of_kind(kind)]
        return dict(zip(names, self._stacked(hole, kind).swapaxes(0, 1), strict=True))

    def _of_kind(self, kind: str) -> list[ErrorTerm]:
        return [term for term in self.terms if term.kind == kind]

    @np.errstate(divide="ignore", invalid="ignore")
    def _stacked(self, hole: Hole, kind: str) -> Array:
        """The same of all terms (n, k, 3)."""
        values: dict[str, ArrayLike] = {**hole.quantities, **self.parameters, "pi": np.pi}
        steep = np.maximum(hole.inclination, LEAST_INCLINATION)
        sine, inclined = np.sin(steep), {**values, "inc": steep}
        terms = self._of_kind(kind)
        result = np.empty((len(hole.md), len(terms), 3))
        for place, term in enumerate(terms):
            depth, inclination, azimuth = self.formulas[term.name]
            parts = (inclination(values), sine * azimuth(inclined), depth(values))
            for axis, part in enumerate(parts):
                result[:, place, axis] = term.size * part
        return result

    def errors(self, hole: Hole) -> tuple[Array, Array, Array]:
        """Shifts (n, k, 3) by terms that last, covariance (n, 3, 3) of random ones and (n, 2, 2) of courses."""
        course = self._stacked(hole, "course")[..., :2]
        return *self.errors_of_stations(hole), course.mT @ course

    def errors_of_stations(self, hole: Hole) -> tuple[Array, Array]:
        """The same without courses."""
        systematic, random = (self._stacked(hole, kind) for kind in ("lasting", "random"))
        return systematic, random.mT @ random


def _depth_before(md: Array, before: Array) -> Array:
    """Depths (n,) of the last station above each, by those `before` it, NaN where these have none."""
    places = np.arange(len(md))
    known = before[np.maximum.accumulate(np.where(np.isfinite(before), places, 0))]
    above = known[np.maximum.accumulate(np.where(known < md, places, 0))]
    return np.where(above < md, above, md - USUAL_COURSE)


def load_error_model(name_or_path: str | os.PathLike[str] = BUILT_IN) -> ErrorModel:
    """An error model: built in by name, or a file in ISCWSA's JSON form by path.

    Raises:
        InputError: no such model, or one whose terms are not understood.
    """
    name = os.fspath(name_or_path)
    data = _bytes_of(name)
    try:
        model = msgspec.json.decode(data, type=ErrorModelFile)
    except msgspec.MsgspecError as problem:
        raise InputError(
            f"{name} is not an error model in ISCWSA's JSON form: {problem}."
        ) from None
    if not 0 < len(model.terms) <= MOST_ERROR_TERMS:
        raise InputError(f"{name} must have 1 to {MOST_ERROR_TERMS} terms; got {len(model.terms)}.")
    parameters = {"xcltortuosity": model.parameters.XCLTortuosity}
    names = FORMULA_NAMES | set(parameters)
    formulas = {}
    for term in model.terms:
        if term.name in formulas or not 0 <= term.value < np.inf:
            raise InputError(
                f"{name}: term '{term.name[:40]}' must stand once, with a finite value that is not negative."
            )
        texts = (term.depth_formula, term.inclination_formula, term.azimuth_formula)
        try:
            formulas[term.name] = tuple(parsed(text, names) for text in texts)
        except InputError as problem:
            raise InputError(f"{name}: term '{term.name[:40]}': {problem}") from None
    head = model.metadata
    return ErrorModel(
        head.short_name, head.source, tuple(model.terms), parameters, formulas,
        sha256_of(data),
    )  # fmt: skip


def _bytes_of(name: str) -> bytes:
    folder = resources.files("mwdcal") / "error_models"
    built_in = sorted(entry.name.removesuffix(".json") for entry in folder.iterdir())
    if name in built_in:
        return (folder / f"{name}.json").read_bytes()
    path = Path(name)
    try:
        if path.stat().st_size > LARGEST_MODEL:
            raise InputError(f"{name} is too large for an error model: over {LARGEST_MODEL} bytes.")
        return path.read_bytes()
    except OSError as problem:
        raise InputError(
            f"cannot read the error model {name}: {reason(problem)}. Built in: {', '.join(built_in)}."
        ) from None
