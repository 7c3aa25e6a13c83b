"""The table of a fleet's calibrations as columns over its calibrated tools, and what is comparable among them.

It is read column by column, whatever its length.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mwdcal.calibration.prediction import STATED_ANGLES
from mwdcal.calibration.readings import TRIADS
from mwdcal.files.formats import parquet
from mwdcal.fleet.calibrate import OK
from mwdcal.geometry.vectors import AnyArray, Array, Bools
from mwdcal.screens.fleet import is_doubt, numbers, quantiles
from mwdcal.screens.text import raised

RELATIVE_KIND = "field = 1"
"""The kind of magnetometers of which the strength of the field is not known."""
FAR = 6.0
"""Robust standard deviations from the fleet's median beyond which a tool is an outlier."""
FEWEST_TOOLS = 20
"""Sound tools without which there is no fleet to be an outlier of."""
SPREAD = 1.4826
"""Standard deviation of a normal variable by its median absolute deviation."""


@dataclass(frozen=True)
class FleetParameter:
    """A column of parameters over the sound tools, NaN where a tool does not have it.

    Magnetometers calibrated to nT and to a field of one are of different `kind`.
    """

    triad: str
    kind: str
    title: str
    unit: str
    values: Array
    sd: Array

    @property
    def sensors(self) -> str:
        """What may be compared."""
        return f"{self.triad}, {self.kind}" if self.kind else self.triad

    @property
    def tools(self) -> int:
        """Number of tools that have it."""
        return int(np.sum(~np.isnan(self.values)))

    @property
    def quantiles(self) -> list[float]:
        """1 %, median and 99 %."""
        return quantiles(self.values)

    @property
    def typical_sd(self) -> float | None:
        """Median of the standard uncertainties."""
        return None if np.isnan(self.sd).all() else float(np.nanmedian(self.sd))


class SoundTools:
    """The calibrated tools of a table of calibrations, read column by column."""

    def __init__(self, path: Path) -> None:
        _, pq = parquet.modules(path.name)
        self._file = pq.ParquetFile(path)
        self.names: list[str] = self._file.schema_arrow.names
        self.metadata = parquet.metadata_of(self._file.schema_arrow.metadata, path.name)
        self._rows: Bools = np.array(self._column("status").to_pylist(), object) == OK
        self.count = int(self._rows.sum())

    def _column(self, name: str) -> Any:
        return self._file.read([name]).column(0)

    def numbers(self, name: str) -> Array:
        """A column of numbers, NaN where there is none."""
        return numbers(self._file, name)[self._rows]

    def words(self, name: str) -> AnyArray:
        """A column of text, labels, or lists of them."""
        cells = self._column(name).to_pylist()
        return np.fromiter(cells, object, len(cells))[self._rows]

    @property
    def has_magnetometer(self) -> Bools:
        """Which tools have a calibrated magnetometer."""
        return np.array([unit is not None for unit in self.words("field_unit")], bool)

    def accuracy(self) -> dict[str, Array]:
        """1σ of the calibration at 45° inclination by angle, degrees; NaN where it is undetermined."""
        columns = {angle: f"{angle}_sd_deg" for angle in STATED_ANGLES}
        return {a: self.numbers(name) for a, name in columns.items() if name in self.names}

    def undetermined(self) -> dict[str, Bools]:
        """Which tools have an angle without an accuracy, although their sensors give the angle."""
        magnetic = {STATED_ANGLES[-1]: self.has_magnetometer}
        return {a: np.isnan(sd) & magnetic.get(a, True) for a, sd in self.accuracy().items()}

    @property
    def triads(self) -> list[str]:
        """The triads that some tool of the table may have."""
        return [triad for triad in TRIADS if f"{triad}_rank" in self.names]

    def residuals(self, triad: str) -> Array:
        """Residuals of a triad divided by what noise alone would give."""
        return np.sqrt(self.numbers(f"{triad}_variance_factor"))

    def doubtful(self) -> Bools:
        """Which tools have a finding that says that their fit is doubtful."""
        return np.array([any(map(is_doubt, each)) for each in self.words("findings")], bool)


def parameters_of(tools: SoundTools) -> list[FleetParameter]:
    """All columns of parameters, with units that people use."""
    parameters = []
    kinds = kinds_of(tools)
    nominal = nominal_unit(tools, kinds)
    for name in tools.names:
        triad, _, rest = name.partition("_")
        if triad not in TRIADS or f"{name}_sd" not in tools.names:
            continue
        every, spread = _comparable(tools, triad, rest), tools.numbers(f"{name}_sd")
        for kind, which in kinds.items() if triad == TRIADS[1] else [("", True)]:
            values, sd = (np.where(which, v, np.nan) for v in (every, spread))
            if not np.isnan(values).all():
                unit, factor = _unit(rest, triad, bool(kind), nominal)
                each = FleetParameter(triad, kind, _title(rest), unit, values * factor, sd * factor)
                parameters.append(each)
    return sorted(parameters, key=lambda each: each.sensors)


def kinds_of(tools: SoundTools) -> dict[str, Bools]:
    """Which tools are calibrated to nT, and which to a field of one: they do not compare."""
    units = tools.words("field_unit")
    relative = np.array([unit not in (None, "nT") for unit in units])
    kinds = {"": units == "nT", RELATIVE_KIND: relative}
    return {name: which for name, which in kinds.items() if which.any()}


def nominal_unit(tools: SoundTools, kinds: Mapping[str, Bools]) -> str:
    """Unit of the nominal readings of magnetometers calibrated to a field of one.

    nT, or none where the profile states no scale: then they are relative too, and gains near 1, as
    the fit refuses others. In nT a gain is one over the strength, and a scale is the strength.
    """
    which = kinds.get(RELATIVE_KIND, np.zeros(tools.count, bool))
    for name in ("gain_xx", "scale_x", "radius"):
        if f"{TRIADS[1]}_{name}" in tools.names:
            values = _comparable(tools, TRIADS[1], name)[which]
            if not np.isnan(values).all():
                return "" if 0.01 < abs(np.nanmedian(values)) < 100.0 else "nT"
    return "nT"


def _comparable(tools: SoundTools, triad: str, name: str) -> Array:
    """A column but for tools with own-axis terms, whose other parameters are of scaled readings."""
    values, radius = tools.numbers(f"{triad}_{name}"), f"{triad}_radius"
    if radius not in tools.names or name.startswith(("square", "cube", "radius")):
        return values
    return np.where(np.isnan(tools.numbers(radius)), values, np.nan)


def _unit(name: str, triad: str, relative: bool, nominal: str) -> tuple[str, float]:
    """Unit and factor of a parameter: offsets in mg or nT, the rest as shares of nominal.

    A `relative` field has no unit, whatever that of the `nominal` readings: a factor's scale has
    theirs, and a gain one over it.
    """
    kind, _, rest = name.partition("_")
    per = raised("/°C", int(rest.partition("_t")[2] or 0))
    if kind in ("offset", "bias", "square", "cube"):
        field = "of the field" if relative else "nT"
        return (f"mg{per}", 1e3) if triad == TRIADS[0] else (f"{field}{per}", 1.0)
    if relative and nominal and kind in ("gain", "scale"):
        return (f"1/{nominal}" if kind == "gain" else nominal) + per, 1.0
    return per.replace("/", "1/"), 1.0


def _title(name: str) -> str:
    """The parameter as its calibration file calls it.

    >>> _title("gain_xy_t1")
    'gain xy·τ'
    """
    steady, _, power = name.partition("_t")
    return steady.replace("_", " ") + raised("·τ", int(power or 0))


def distance(values: Array) -> Array:
    """Robust standard deviations (n,) from the median; 0 for few values, or where most are equal."""
    if np.sum(~np.isnan(values)) < FEWEST_TOOLS:
        return np.zeros(len(values))
    away = np.abs(values - np.nanmedian(values))
    spread = SPREAD * np.nanmedian(away)
    return away / spread if spread > 0 else np.zeros(len(values))
