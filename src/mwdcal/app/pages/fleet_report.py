"""The summary page of a fleet: statuses, distributions, outliers, in one HTML file.

It reads the table of calibrations column by column, whatever its length.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mwdcal.app.pages import fleet_plots, report
from mwdcal.app.pages.fleet_plots import FAR, FEWEST
from mwdcal.app.pages.fleet_summary import (
    ERRORS,
    Said,
    Summary,
    column,
    is_doubt,
    orders_table,
    unusual,
)
from mwdcal.app.text import number, plural
from mwdcal.calibration.diagnosis.misfit import NOISE_RATIO
from mwdcal.calibration.readings import TRIADS, is_simulated
from mwdcal.files.formats import atomic, parquet
from mwdcal.fleet.calibrate import OK
from mwdcal.fleet.sources import SERIAL
from mwdcal.geometry.vectors import Array, Bools, Ints

if TYPE_CHECKING:
    from jinja2 import Environment

RELATIVE = "field = 1"
"""The kind of magnetometers of which the strength of the field is not known."""


@dataclass(frozen=True)
class Parameter:
    """A column of parameters over the sound tools, NaN where a tool does not have it.

    Magnetometers calibrated to nT and to a field of one are of different `kind`.
    """

    triad: str
    kind: str
    title: str
    unit: str
    values: Array
    sd: float

    @property
    def sensors(self) -> str:
        """What may be compared."""
        return f"{self.triad}, {self.kind}" if self.kind else self.triad

    @property
    def tools(self) -> int:
        """Number of tools that have it."""
        return int(np.sum(~np.isnan(self.values)))

    @property
    def quantiles(self) -> tuple[float, float, float]:
        """1 %, median and 99 %."""
        low, middle, high = np.nanquantile(self.values, (0.01, 0.5, 0.99))
        return float(low), float(middle), float(high)


@dataclass(frozen=True)
class Outlier:
    """A tool far from the fleet: its farthest column."""

    serial: Any
    title: str
    value: float
    median: float
    unit: str
    distance: float


def environment() -> Environment:
    """The templates; refuses, before any work, where what draws the page is missing."""
    return report._environment()


def write_report(path: str | os.PathLike[str], calibrations: Path, summary: Summary) -> None:
    """Write the page; the old file or the new one exists at any moment, never a part."""
    atomic.write(path, render(calibrations, summary))


def render(calibrations: Path, summary: Summary) -> str:
    """The page as HTML: the same table gives the same text but for the time it took."""
    template = environment().get_template("fleet.html")
    metadata = _metadata(calibrations)
    sound = np.flatnonzero(_text(calibrations, "status") == OK)
    parameters = _parameters(calibrations, sound) if sound.size else []
    estimated = [triad for triad in TRIADS if triad in _list(metadata, "noise_estimated")]
    return template.render(
        found=summary,
        metadata=metadata,
        simulated=is_simulated(metadata),
        banner=_banner(summary),
        facts=_facts(summary, metadata),
        orders=orders_table(summary) if summary.orders else None,
        stand=_stand(summary),
        estimated=estimated,
        figures=_figures(calibrations, parameters, sound, estimated),
        parameters=parameters,
        outliers=_outliers(calibrations, parameters, sound),
        suspects=_suspects(calibrations, sound),
        far=FAR,
        fewest=FEWEST,
        suspect=NOISE_RATIO,
    )


def _metadata(path: Path) -> Mapping[str, object]:
    _, pq = parquet.modules(path.name)
    return parquet.metadata_of(pq.read_schema(path).metadata, path.name)


def _list(metadata: Mapping[str, object], name: str) -> list[object]:
    """A list in the metadata, empty where there is none."""
    found = metadata.get(name)
    return found if isinstance(found, list) else []


def _stand(summary: Summary) -> list[list[str]]:
    """Rows of the table of errors of the stand: name, and three points of the sound tools."""
    known = {name: summary.spread.get(name) for name in ERRORS}
    return [
        [name.removesuffix("_deg").replace("_", " "), *map(number, values)]
        for name, values in known.items()
        if values
    ]


def _text(path: Path, name: str) -> Any:
    _, pq = parquet.modules(path.name)
    return np.array(pq.read_table(path, columns=[name]).column(0).to_pylist(), object)


def _banner(summary: Summary) -> dict[str, str]:
    """The result in one sentence."""
    refused = summary.tools - summary.sound
    doubts = [said for said in summary.findings if is_doubt(said.id)]
    level = "bad" if not summary.sound else "attention" if refused or doubts else "good"
    word = "Some refused" if refused else "Some doubtful"
    word = {"good": "All calibrated", "attention": word, "bad": "None calibrated"}[level]
    after = "Every tool has parameters with their uncertainty."
    if refused:
        after = f"{plural(refused, 'tool')} without a result: see the reasons below."
    after = "; ".join([after.rstrip("."), *map(_doubt, doubts)]) + "." if doubts else after
    headline = f"{summary.sound} of {plural(summary.tools, 'tool')} calibrated"
    return {"level": level, "word": word, "headline": headline, "after": after}


def _doubt(said: Said) -> str:
    """A finding of a doubtful fit, with the number of its tools."""
    return f"{said.id.replace('-', ' ')} in {plural(said.tools, 'tool')}"


def _facts(summary: Summary, metadata: Mapping[str, object]) -> list[tuple[str, str]]:
    profile = str(metadata.get("profile", ""))
    found = [
        ("method", summary.method),
        ("stations", str(summary.stations)),
        ("order", str(summary.order)),
        ("options", "; ".join(unusual(summary.options)) or "defaults"),
        ("profile", profile),
    ]
    if summary.nonlinear:
        pairs = summary.nonlinear.items()
        terms = ", ".join(f"{triad} of {plural(count, 'tool')}" for triad, count in pairs)
        found.append(("own-axis terms", terms))
    if summary.order:
        found.append(("τ", f"temperature − {metadata.get('reference_temperature_c')} °C"))
    return found


def _parameters(path: Path, sound: Ints) -> list[Parameter]:
    """All columns of parameters, with units that people use."""
    _, pq = parquet.modules(path.name)
    found, names = [], pq.read_schema(path).names
    kinds = _kinds(path, sound)
    nominal = _nominal(path, sound, kinds)
    for name in names:
        triad = next((t for t in TRIADS if name.startswith(f"{t}_")), "")
        rest = name.removeprefix(f"{triad}_")
        if not triad or f"{name}_sd" not in names:
            continue
        every = _comparable(path, triad, rest, column(path, name), names)[sound]
        spread = column(path, f"{name}_sd")[sound]
        for kind, which in kinds.items() if triad != TRIADS[0] else [("", slice(None))]:
            values, sd = (np.full(len(sound), np.nan) for _ in range(2))
            values[which], sd[which] = every[which], spread[which]
            if np.isnan(values).all():
                continue
            unit, factor = _unit(rest, triad, bool(kind), nominal)
            middle = float(np.nanmedian(sd)) * factor if not np.isnan(sd).all() else float("nan")
            found.append(Parameter(triad, kind, _title(rest), unit, values * factor, middle))
    return sorted(found, key=lambda each: each.sensors)


def _kinds(path: Path, sound: Ints) -> dict[str, Bools]:
    """Which tools are calibrated to nT, and which to a field of one: they do not compare."""
    units = _text(path, "field_unit")[sound]
    relative = np.array([unit not in (None, "nT") for unit in units])
    found = {"": units == "nT", RELATIVE: relative}
    return {name: which for name, which in found.items() if which.any()}


def _nominal(path: Path, sound: Ints, kinds: Mapping[str, Bools]) -> str:
    """Unit of the nominal readings of magnetometers calibrated to a field of one.

    nT, or none where the profile states no scale: then they are relative too, and gains near 1, as
    the fit refuses others. In nT a gain is one over the strength, and a scale is the strength.
    """
    _, pq = parquet.modules(path.name)
    names, triad = pq.read_schema(path).names, TRIADS[1]
    which = kinds.get(RELATIVE, np.zeros(len(sound), bool))
    for name in ("gain_xx", "scale_x", "radius"):
        if f"{triad}_{name}" in names:
            every = _comparable(path, triad, name, column(path, f"{triad}_{name}"), names)
            if not np.isnan(values := every[sound][which]).all():
                return "" if 0.01 < abs(np.nanmedian(values)) < 100.0 else "nT"
    return "nT"


def _comparable(path: Path, triad: str, name: str, values: Array, names: list[str]) -> Array:
    """Values but for tools with own-axis terms, whose other parameters are of scaled readings."""
    if f"{triad}_radius" not in names or name.startswith(("square", "cube", "radius")):
        return values
    return np.where(np.isnan(column(path, f"{triad}_radius")), values, np.nan)


def _unit(name: str, triad: str, relative: bool, nominal: str) -> tuple[str, float]:
    """Unit and factor of a parameter: offsets in mg or nT, the rest as shares of nominal.

    A `relative` field has no unit, whatever that of the `nominal` readings: a factor's scale has
    theirs, and a gain one over it.
    """
    kind, _, rest = name.partition("_")
    power = rest.partition("_t")[2]
    per = f"/°C{_raised(power)}" if power else ""
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
    course = f"·τ{_raised(power)}" if power else ""
    return steady.replace("_", " ") + course


def _raised(power: str) -> str:
    """An exponent, none for the first power."""
    return power.translate(report.SUPERSCRIPT) if power != "1" else ""


def _figures(
    path: Path, parameters: list[Parameter], sound: Ints, estimated: list[str]
) -> dict[str, str]:
    if not sound.size:
        return {}
    triads = dict.fromkeys(p.triad for p in parameters)
    residuals = {
        f"{triad} s": np.sqrt(column(path, f"{triad}_variance_factor")[sound])
        for triad in triads
        if triad not in estimated
    }
    panels = [("residuals ÷ what the noise lets one expect, s", "s", residuals)]
    panels = panels if residuals else []
    panels += [_noise(path, triad, sound) for triad in triads if triad in estimated]
    accuracy = {
        angle: column(path, f"{angle}_sd_deg")[sound]
        for angle in ("inclination", "toolface", "azimuth")
        if angle != "azimuth" or len(triads) > 1
    }
    panels.append(("1σ of the calibration at 45°", "1σ, °", accuracy))
    steady = [p for p in parameters if "τ" not in p.title]
    return {
        "parameters": fleet_plots.parameters(steady),
        "quality": fleet_plots.quality(panels),
    }


def _noise(path: Path, triad: str, sound: Ints) -> tuple[str, str, dict[str, Array]]:
    """The panel of a noise that each tool's residuals tell; of one kind of magnetometers."""
    values = column(path, f"{triad}_noise")[sound]
    title = f"{triad}: estimated noise"
    if triad == TRIADS[0]:
        return title, "1σ, mg", {triad: 1e3 * values}
    kinds = _kinds(path, sound)
    kind, which = next(iter(kinds.items()))
    relative = kind == RELATIVE and not _nominal(path, sound, kinds)
    return title, "1σ of the field" if relative else "1σ, nT", {triad: values[which]}


def _outliers(path: Path, parameters: list[Parameter], sound: Ints) -> list[Outlier]:
    """Tools of which some parameter is far from the fleet's, the farthest first."""
    if len(sound) < FEWEST:
        return []
    distance, which = np.zeros(len(sound)), np.zeros(len(sound), int)
    for index, each in enumerate(parameters):
        mine = fleet_plots.distance(each.values)
        which = np.where(mine > distance, index, which)
        distance = np.fmax(mine, distance)
    far = np.argsort(-distance, kind="stable")[: int(np.sum(distance > FAR))]
    serials = _text(path, SERIAL)
    found = []
    for place in far:
        each = parameters[which[place]]
        title = f"{each.sensors} {each.title}"
        middle = float(np.nanmedian(each.values))
        value = float(each.values[place])
        serial = serials[sound[place]]
        found.append(Outlier(serial, title, value, middle, each.unit, float(distance[place])))
    return found


def _suspects(path: Path, sound: Ints) -> list[tuple[Any, str, float]]:
    """Sound tools with large residuals: serial, triad, s; the largest first."""
    serials = _text(path, SERIAL)
    _, pq = parquet.modules(path.name)
    names = pq.read_schema(path).names
    found = []
    for triad in TRIADS:
        if f"{triad}_variance_factor" in names:
            s = np.sqrt(column(path, f"{triad}_variance_factor")[sound])
            found += [
                (serials[sound[i]], triad, float(s[i])) for i in np.flatnonzero(s > NOISE_RATIO)
            ]
    return sorted(found, key=lambda row: -row[2])
