"""The summary page of a fleet: how many are calibrated and how well, the worst tools, and every tool as a mark.

It reads the table of calibrations column by column, whatever its length.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mwdcal.calibration.diagnosis.plausibility import NOISE_RATIO
from mwdcal.calibration.readings import TRIADS, is_simulated
from mwdcal.fleet.calibrate import OK
from mwdcal.fleet.sources import SERIAL
from mwdcal.geometry.vectors import Array, Ints
from mwdcal.presentation import fleet_figures
from mwdcal.presentation.fleet import (
    ERRORS,
    SERIALS_SHOWN,
    FleetFinding,
    FleetSummary,
    is_doubt,
    unusual,
)
from mwdcal.presentation.fleet_figures import (
    FAR,
    FEWEST_TOOLS,
    RELATIVE_KIND,
    FleetParameter,
    SoundTools,
    Strips,
    distance,
    kinds_of,
    nominal_unit,
    parameters_of,
)
from mwdcal.presentation.numbers import UNDETERMINED, capital, number, uncertainty, unit
from mwdcal.presentation.page import banner, rendered
from mwdcal.presentation.text import plural

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WORST_TOOLS = 25
"""Most tools in the table of the worst."""
WIDE_SIGMA = 2.0
"""Times the fleet's median beyond which the accuracy of a tool is remarked."""
STATIONS_OF_A_TOOL = 4
"""Most stations to re-measure that the table of tools names."""

REFUSED = {
    "bad-input": "a cell or an option is not what a run can have",
    "too-few-stations": "fewer stations than the parameters need",
    "common-errors": "the stand declares errors that all stations share, and this method takes it as exact",
    "channel": "a channel is dead, or moves as no field explains",
    "temperature-span": "temperatures too few or too close together for this order",
    "missing-reference": "a reference angle that this method needs is blank",
    "noise": "the declared noise is so large a share of the field that its unit is probably wrong",
    "not-converged": "the fit did not settle",
    "not-finite": "the fit did not settle",
    "unsound": "the fit has no valid covariance, or gains that no sensor has",
    "weak-geometry": "the readings do not determine all parameters",
    "no-redundancy": "no reading is left over to estimate the noise from",
    "gain": "a gain is far from nominal or has the wrong sign",
    "residuals": "no error of a sensor explains the residuals",
    "temperature-order": "readings vary with temperature more than the order follows",
    "earth": "a gravity, field or dip that no place on Earth has",
    "errors": "errors against the references far larger than the misfit explains",
    "inseparable": "the stations cannot tell errors of the stand from those of the sensors",
    "failed": "the fit stopped with an error",
}
"""Why tools of a status are refused."""
REMARKED = {
    "noise": "residuals of the {triad} are far below the declared noise",
    "residuals": "residuals of the {triad} are larger than the declared noise explains",
    "settings": "the stand at one or more of its settings is off by far more than declared",
    "stand-too-large": "the stated σ of the stand is far larger than its errors",
    "toolface-shared": "errors of the stand's toolface agree as if it had been set less often than at every station",
    "axis-noise": "residuals along one axis are far larger than along another",
    "settings-unshared": "stations almost of one direction count as settings of their own",
    "settings-apart": "stations of one direction scatter as if the stand had been set anew at each",
    "field-drift": "the field drifted during the run: fit and uncertainty include it",
    "drift": "offsets of the {triad} drifted during the run: fit and uncertainty include it",
    "column-explains": "the misfit or the drift goes with a column that is not used",
    "no-redundancy": "nothing in the run checks the fit",
    "few-degrees-of-freedom": "the residuals are too few to know the uncertainties better than to a quarter",
    "few-directions": "the tool axis has only two directions: a wrong angle of the stand may show nowhere",
    "hemisphere": "the dip is negative: a southern site, or a magnetometer with reversed signs",
    "gravity-reference": "the reference of gravity is one that no place on land has",
    "scatter": "strengths, dip or directions vary from station to station beyond the noise",
    "repeated-readings": "some stations are copies of others, and left out of the fit",
    "temperature-misfit": "the {triad} varies with temperature as its order does not follow",
    "temperature-untested": "nothing tests the terms of temperature between the temperatures of the run",
    "temperature-aligned": "attitudes followed the temperature: terms of temperature cannot be told apart",
    "prior-aged": "the prior allows for what the tool may have changed since",
    "prior-shared": "run and prior count a common error as two",
    "prior-only": "some parameters rest on the prior alone",
    "prior-conflict": "the run departs from the prior",
    "nonlinearity-ignored": "the model leaves out a nonlinearity that the profile declares",
    "gravity-unknown": "gravity is unknown, and 1 g assumed: scale factors of the accelerometer are off by up to 0.3 %",
    "field-unknown": "the strength of the field is unknown: the magnetometer is calibrated to field = 1",
    "no-magnetometer": "field or dip is stated, and the table has no magnetometers",
    "restricted": "the model leaves out misalignments",
    "reshoot": "one or more stations should be re-measured; chance alone gives one such tool in a hundred",
    "distrusted": "the robust fit gives some stations little weight",
    "unused-columns": "some columns are not used",
}
"""The statement of a finding about tools, by its id or the end of it."""


def remark(finding: str) -> str:
    """The statement of a finding about tools.

    >>> remark("magnetometer-noise")
    'residuals of the magnetometer are far below the declared noise'
    """
    triad, _, end = finding.partition("-")
    if triad in TRIADS:
        return REMARKED[end].format(triad=triad)
    if finding.startswith("looks-like-"):
        return f"residuals look like {finding.removeprefix('looks-like-').replace('-', ' ')}"
    return REMARKED.get(finding, finding.replace("-", " "))


def render(calibrations: Path, summary: FleetSummary) -> str:
    """The page as HTML: the same table, written at the same time, gives the same text."""
    fleet = Fleet(SoundTools(calibrations))
    tools = fleet.tools
    written = datetime.fromtimestamp(calibrations.stat().st_mtime, UTC)
    return rendered(
        "fleet.html",
        result=summary,
        metadata=tools.metadata,
        simulated=is_simulated(tools.metadata),
        written=written.strftime("%Y-%m-%d %H:%M UTC"),
        banner=_banner(summary, fleet),
        options="; ".join(unusual(summary.options)) or "defaults",
        stand={name: summary.spread[name] for name in ERRORS if summary.spread.get(name)},
        short=number,
        remark=remark,
        refused=[(k, REFUSED[k.status]) for k in summary.statuses if k.status != OK],
        is_doubt=is_doubt,
        fleet=fleet,
        figures=_figures(fleet) if tools.count else {},
        far=FAR,
        fewest=FEWEST_TOOLS,
        suspect=NOISE_RATIO,
        marks=fleet_figures,
    )  # fmt: skip


def _banner(summary: FleetSummary, fleet: Fleet) -> dict[str, str]:
    """How many are calibrated, and the accuracy to expect of them."""
    refused, doubtful = summary.tools - summary.sound, int(fleet.doubtful.sum())
    headline = f"{summary.sound} of {plural(summary.tools, 'tool')} calibrated"
    if not summary.sound:
        after = "No accuracy can be expected of any tool: see the reasons below."
        return banner("bad", "None calibrated", headline, after)
    counts = {"refused": refused, "doubtful": doubtful}
    rest = [f"{count} {word}" for word, count in counts.items() if count]
    headline += (
        f" – {', '.join([*rest, 'none verified yet' if summary.sound > 1 else 'not verified yet'])}"
    )
    each = "; ".join(map(_expected, fleet.accuracy))
    after = (
        f"Accuracy to expect (1σ, calibration alone, at 45° inclination): {each}. Verify each tool by a "
        "roll test that was not used in its fit: mwdcal verify."
    )
    if not rest:
        return banner("open", "All calibrated", headline, after)
    return banner("attention", f"Some {rest[0].split()[1]}", headline, after)


def _expected(row: AngleAccuracy) -> str:
    """The accuracy of an angle over the fleet in words."""
    if row.worst is None:
        return f"{row.angle} undetermined"
    values = f"{uncertainty(row.median)}° median, {uncertainty(row.worst)}° worst"
    free = f", undetermined in {plural(row.undetermined, 'tool')}" if row.undetermined else ""
    return f"{row.angle} {values if row.tools > 1 else f'{uncertainty(row.median)}°'}{free}"


@dataclass(frozen=True)
class AngleAccuracy:
    """1σ of an angle over the tools that have one, degrees, and how many do not determine it."""

    angle: str
    tools: int
    undetermined: int
    median: float | None = None
    high: float | None = None
    worst: float | None = None
    serial: Any = None


@dataclass(frozen=True)
class WorstTool:
    """A row of the table of the worst tools: 1σ by angle, degrees, and what is the matter with it."""

    serial: Any
    doubtful: bool
    accuracy: list[str]
    sentence: str


class Fleet:
    """The statements of the page about the calibrated tools."""

    def __init__(self, tools: SoundTools) -> None:
        self.tools = tools
        self.estimated: Any = tools.metadata["noise_estimated"]
        self.parameters = parameters_of(tools) if tools.count else []
        self.doubtful = tools.doubtful()
        self.serials = tools.words(SERIAL)
        self._sd = tools.accuracy()
        self._free = tools.undetermined()

    @cached_property
    def accuracy(self) -> list[AngleAccuracy]:
        """The accuracy to expect, by angle."""
        rows = []
        for angle, sd in self._sd.items():
            tools, free = int(np.sum(~np.isnan(sd))), int(self._free[angle].sum())
            if tools:
                worst = int(np.nanargmax(sd))
                median, high = np.nanquantile(sd, (0.5, 0.99)).tolist()
                ends = {"worst": float(sd[worst]), "serial": self.serials[worst]}
                rows.append(AngleAccuracy(angle, tools, free, median, high, **ends))
            elif free:
                rows.append(AngleAccuracy(angle, 0, free))
        return rows

    @property
    def suspects(self) -> FleetFinding:
        """Tools with residuals far larger than noise alone would give."""
        each = [np.nan_to_num(self.tools.residuals(triad)) for triad in self.tools.triads]
        return self._beyond("residuals", np.max(each, 0), NOISE_RATIO)

    @property
    def outliers(self) -> FleetFinding:
        """Tools with a parameter far from the fleet's median."""
        return self._beyond("outlier", self._away[1], FAR)

    def _beyond(self, name: str, values: Array, limit: float) -> FleetFinding:
        """Tools whose value is beyond a limit, the farthest first."""
        count = int(np.sum(values > limit))
        first = np.argsort(-values, kind="stable")[: min(count, SERIALS_SHOWN)]
        return FleetFinding(id=name, tools=count, serials=self.serials[first].tolist())

    @cached_property
    def _away(self) -> tuple[Ints, Array]:
        """The parameter that is farthest from the fleet, and how far, of each tool."""
        away = np.zeros((1, self.tools.count))
        if self.parameters:
            away = np.nan_to_num([distance(each.values) for each in self.parameters])
        return away.argmax(0), away.max(0)

    @cached_property
    def _ratio(self) -> dict[str, Array]:
        """Each 1σ over the fleet's median, 0 where there is none."""
        rows = [row for row in self.accuracy if row.median]
        return {r.angle: np.nan_to_num(self._sd[r.angle] / (r.median or 1.0)) for r in rows}

    @cached_property
    def worst(self) -> list[WorstTool]:
        """The worst tools first: doubtful ones, then those that leave an angle undetermined, then the others.

        Among equals by 1σ over the fleet's median, or by the farthest parameter.
        """
        none = np.zeros(self.tools.count)
        ratio = np.max([none, *self._ratio.values()], 0)
        score = np.maximum(ratio / WIDE_SIGMA, self._away[1] / FAR)
        free = np.sum([none, *self._free.values()], 0)
        first = np.lexsort((-score, -free, ~self.doubtful))[:WORST_TOOLS].tolist()
        reasons = _Reasons(self, first)
        return [
            WorstTool(
                self.serials[i],
                bool(self.doubtful[i]),
                [self._shown(angle, i) for angle in self._sd],
                capital("; ".join(reasons.of(i))) + ".",
            )
            for i in first
        ]

    def _shown(self, angle: str, tool: int) -> str:
        """The accuracy of one tool."""
        free = bool(self._free[angle][tool])
        return UNDETERMINED if free else number(float(self._sd[angle][tool]), 2)

    @property
    def titles(self) -> list[str]:
        """Titles of the columns of accuracy."""
        return [f"{angle} 1σ, °" for angle in self._sd]

    def of(self, tool: int) -> Iterator[str]:
        """The unusual figures in the accuracy and the parameters of one tool."""
        free = [angle for angle in self._sd if self._free[angle][tool]]
        if free:
            yield f"{', '.join(free)} undetermined"
        angle = max(self._ratio, key=lambda name: float(self._ratio[name][tool]), default="")
        if angle and self._ratio[angle][tool] > WIDE_SIGMA:
            yield f"1σ of {angle} {number(float(self._ratio[angle][tool]))} times the fleet's median"
        which, far = self._away
        if far[tool] > FAR:
            yield _outlier(self.parameters[which[tool]], tool, float(far[tool]))

    def typical(self, tool: int) -> str:
        """The accuracy of a tool without anything unusual."""
        if self.tools.count == 1 or not self._ratio:
            return "nothing unusual"
        angle = max(self._ratio, key=lambda name: float(self._ratio[name][tool]))
        ratio = number(float(self._ratio[angle][tool]))
        return f"nothing unusual: 1σ of {angle} is {ratio} times the fleet's median"


def _outlier(parameter: FleetParameter, tool: int, far: float) -> str:
    """How far the farthest parameter of a tool is from the fleet."""
    per = unit(parameter.unit)
    value, median = (number(v, 4) + per for v in (parameter.values[tool], parameter.quantiles[1]))
    name = f"{parameter.sensors} {parameter.title}"
    return (
        f"{name} is {value}, the fleet's median {median} ({number(far)} robust standard deviations)"
    )


class _Reasons:
    """The faults of some tools, from their findings and directions."""

    def __init__(self, fleet: Fleet, some: Sequence[int]) -> None:
        tools, names = fleet.tools, ("findings", "reshoot", *(f"{t}_undetermined" for t in TRIADS))
        columns = {name: tools.words(name) for name in names if name in tools.names}
        self._lists = {i: {name: cells[i] or [] for name, cells in columns.items()} for i in some}
        self._residuals = {triad: tools.residuals(triad) for triad in tools.triads}
        self._fleet = fleet

    def of(self, tool: int) -> list[str]:
        """Each in a few words, the gravest first; of a tool without any, its accuracy."""
        lists = self._lists[tool]
        each = [*self._doubts(tool, lists["findings"]), *self._fleet.of(tool)]
        each += self._directions(lists)
        stations, more = lists["reshoot"][:STATIONS_OF_A_TOOL], len(lists["reshoot"])
        if stations:
            dots = " …" if more > len(stations) else ""
            each.append(f"re-measure station {', '.join(stations)}{dots}")
        return each or [self._fleet.typical(tool)]

    def _doubts(self, tool: int, findings: Sequence[str]) -> Iterator[str]:
        """Why the fit is doubtful."""
        for finding in filter(is_doubt, findings):
            triad = finding.removesuffix("-residuals")
            if triad in self._residuals:
                times = number(float(self._residuals[triad][tool]))
                yield f"residuals of the {triad} are {times} times the declared noise"
            else:
                yield remark(finding)

    def _directions(self, lists: Mapping[str, Sequence[str]]) -> Iterator[str]:
        """The directions that nothing determines, and their triads."""
        free = {triad: lists.get(f"{triad}_undetermined") or () for triad in TRIADS}
        groups: dict[str, list[str]] = {}
        for name in dict.fromkeys(name for names in free.values() for name in names):
            triads = " and ".join(triad for triad, names in free.items() if name in names)
            groups.setdefault(triads, []).append(name.replace("-", " "))
        for triads, names in groups.items():
            yield f"nothing determines {', '.join(names)} of the {triads}"


def _figures(fleet: Fleet) -> dict[str, Figure]:
    """Accuracy, residuals and parameters as strips."""
    tools, estimated = fleet.tools, fleet.estimated
    # a triad without a parameter in any sound tool has no strip either
    triads = list(dict.fromkeys(p.triad for p in fleet.parameters))
    accuracy = {row.angle: tools.accuracy()[row.angle] for row in fleet.accuracy}
    panels = [
        Strips("1σ of the calibration at 45° inclination", "1σ, °", accuracy, "°", positive=True)
    ]
    s = {triad: tools.residuals(triad) for triad in triads if triad not in estimated}
    if s:
        lines = {"as noise: 1": 1.0, f"suspect: {number(NOISE_RATIO, 1)}": NOISE_RATIO}
        title = "residuals ÷ what noise alone would give, s"
        panels.append(Strips(title, "s (no unit)", s, lines=lines, positive=True))
    panels += [_noise(tools, triad) for triad in triads if triad in estimated]
    steady = [p for p in fleet.parameters if "τ" not in p.title]
    return {
        "quality": fleet_figures.draw_quality(panels, fleet.serials, fleet.doubtful),
        "parameters": fleet_figures.draw_parameters(steady),
    }


def _noise(tools: SoundTools, triad: str) -> Strips:
    """The panel of the noise estimated from each tool's residuals; of one kind of magnetometers."""
    values = tools.numbers(f"{triad}_noise")
    title = f"{triad}: estimated noise of one reading"
    if triad == TRIADS[0]:
        return Strips(title, "1σ, mg", {triad: 1e3 * values}, "mg", positive=True)
    kinds = kinds_of(tools)
    kind, which = next(iter(kinds.items()))
    relative = kind == RELATIVE_KIND and not nominal_unit(tools, kinds)
    scale, name = ("1σ of the field", "") if relative else ("1σ, nT", "nT")
    return Strips(title, scale, {triad: np.where(which, values, np.nan)}, name, positive=True)
