"""An error model of the industry: what its terms do to the direction and depth of surveys, and how they add up.

A term has a size (1σ), formulas for the errors of depth, inclination and azimuth by one unit of it, and a way it
propagates: *random* errors are new at every station; *systematic* ones last over a run, *well* ones over a well, and
*global* ones over all wells.
Reference: SPE 67616; ISCWSA MWD error model, revision 5; OWSG set A, Rev 5.1.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
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
from mwdcal.survey.formulas import Formula, parsed

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
    ) -> Hole:
        """A hole from its stations in their order; `azimuth` from the north of the path, `magnetic` from magnetic.

        `last`: depth, inclination and azimuth of the station before; None: the course to the first station is straight
        and as long as the next one. Where the hole was vertical the azimuth before is that of the station itself.
        """
        if last is None:
            course = md[1] - md[0] if len(md) > 1 else USUAL_COURSE
            last = (md[0] - (course or USUAL_COURSE), inclination[0], azimuth[0])
        each = zip(last, (md, inclination, azimuth), strict=True)
        before = [np.concatenate([[first], values[:-1]]) for first, values in each]
        before[0] = _depth_before(md, before[0])
        straight = np.abs(np.sin(before[1])) <= VERTICAL
        before[2] = np.where(straight, azimuth, before[2])
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
        values: dict[str, ArrayLike] = {**hole.quantities, **self.parameters, "pi": np.pi}
        terms = [term for term in self.terms if term.kind == kind]
        return {term.name: term.size * self._unit(term.name, values) for term in terms}

    @np.errstate(divide="ignore", invalid="ignore")
    def _unit(self, name: str, values: Mapping[str, ArrayLike]) -> Array:
        depth, inclination, azimuth = self.formulas[name]
        steep = np.maximum(np.asarray(values["inc"]), LEAST_INCLINATION)
        sideways = np.sin(steep) * azimuth({**values, "inc": steep})
        parts = (inclination(values), sideways, depth(values), steep)
        return np.stack(np.broadcast_arrays(*parts)[:3], -1)

    def errors(self, hole: Hole) -> tuple[Array, Array, Array]:
        """Shifts (n, k, 3) by terms that last, covariance (n, 3, 3) of random ones and (n, 2, 2) of courses."""
        systematic = _stacked(self.shifts(hole, "lasting"), hole)
        random, course = (_stacked(self.shifts(hole, kind), hole) for kind in ("random", "course"))
        course = course[..., :2]
        return systematic, random.mT @ random, course.mT @ course


def _depth_before(md: Array, before: Array) -> Array:
    """Depths (n,) of the last station above each: those `before` it, or before the first of several at one depth."""
    first = np.maximum.accumulate(np.where(before < md, np.arange(len(md)), 0))
    above = before[first]
    return np.where(above < md, above, md - USUAL_COURSE)


def _stacked(shifts: Mapping[str, Array], hole: Hole) -> Array:
    """Shifts (n, k, 3) of all terms."""
    none = np.zeros((len(hole.md), 0, 3))
    return np.concatenate([none, *(shift[:, None] for shift in shifts.values())], -2)


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
