"""A simulated run and its truth, on the screen and for machines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from mwdcal.calibration.readings import SIMULATED
from mwdcal.calibration.record import Finding
from mwdcal.calibration.results import STATED_ANGLES
from mwdcal.errors import shell_word
from mwdcal.geometry.vectors import AnyArray
from mwdcal.planning.plans import Effects
from mwdcal.planning.procedure import CALIBRATED, PERCENTILES, Judged, Repetition, Share
from mwdcal.planning.session import Session
from mwdcal.presentation.envelope import json_document
from mwdcal.presentation.numbers import files_written, fixed, number, quantity
from mwdcal.presentation.text import one_line, plural, table
from mwdcal.use import plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIZES = {
    "inclination_zero_deg": ("inclination zero", "°"),
    "azimuth_zero_deg": ("azimuth zero", "°"),
    "toolface_zero_deg": ("toolface zero", "°"),
    "tilt_deg": ("tilt", "°"),
    "tool_axis_deg": ("lean of the tool", "°"),
    "tilt_azimuth_deg": ("tilt towards azimuth", "°"),
}
"""Errors of the stand in words, and their unit."""


class TrueAttitude(msgspec.Struct, frozen=True, kw_only=True):
    """The truth of a station: angles that the stand has turned to, and the temperature of the sensors."""

    station: str
    inclination_deg: float
    azimuth_deg: float
    toolface_deg: float
    temperature_c: float


class SimulationSummary(msgspec.Struct, frozen=True, kw_only=True):
    """The truth behind a run, as `simulate` writes and prints it.

    Parameters by triad in raw units, as `convert` prints them in this `notation`: factors (SF, B, m), or affine (M, b)
    for a calibration that is linear in its parameters above order 0. `stand`: errors common to the session, such
    that reading = value + zero. `turn_on`: bias of the channels along the tool axes, g or nT. `fault`: departures of
    a tool at fault, by kind. Of many repetitions
    `repetition` has what they show, and what is true of a single run is empty.
    """

    seed: int
    plan: str
    tool: str
    order: int
    reference_temperature_c: float
    notation: str = "factors"
    accelerometer: dict[str, Any] | None = None
    magnetometer: dict[str, Any] | None = None
    earth: dict[str, float] = {}
    stand: dict[str, float] = {}
    turn_on: dict[str, list[float]] = {}
    fault: dict[str, list[float]] = {}
    effects: Effects
    stations: list[TrueAttitude] = []
    repetition: Repetition | None = None
    findings: list[Finding]
    output: str
    truth: str
    plot: str


def document(
    session: Session,
    facts: Mapping[str, Any],
    digests: Mapping[str, str],
    serial: str | None,
    **files: Path | None,
) -> dict[str, Any]:
    """The result for machines: of a single run its truth file too."""
    named = {name: str(files.get(name) or "") for name in ("output", "truth", "plot")}
    fields = {"plan": session.plan.source, "tool": session.profile.name, "effects": session.effects}
    content = msgspec.convert(msgspec.to_builtins({**fields, **facts, **named}), SimulationSummary)
    labels = {"simulated": True, "serial": serial}
    return json_document("simulate", content, labels, **digests)


def screen(document: Mapping[str, Any], tool: str = "") -> str:
    """A single run for people; `tool` is the name or path of its tool profile."""
    head = [
        document["tool"], document["serial"], document["plan"], plural(len(document["stations"]), "station"),
        f"order {document['order']}", f"seed {document['seed']}", SIMULATED,
    ]  # fmt: skip
    rows = [
        [words, f"{number(document['stand'][name])}{unit}"]
        for name, (words, unit) in SIZES.items()
        if name in document["stand"]
    ]
    errors = (
        table(rows, ["error of the stand", "true"])
        if rows
        else "no error common to the stations of the stand"
    )
    blocks = [one_line("   ".join(head)), errors]
    if document["output"]:
        run, profile = shell_word(document["output"]), shell_word(tool) if tool else "TOOL.toml"
        follow = f"next: mwdcal calibrate {run} --tool {profile} -o CAL.json"
        files = files_written(run=document["output"], truth=document["truth"])
        blocks.append(f"{files}   {one_line(follow)}")
    return "\n\n".join(blocks)


def repeated(document: Mapping[str, Any]) -> str:
    """Many repetitions for people: the verdicts first."""
    result = msgspec.convert(document["repetition"], Repetition)
    head = [
        document["tool"], document["plan"], plural(result.tools, "tool"), f"order {document['order']}",
        f"seed {document['seed']}", SIMULATED,
    ]  # fmt: skip
    words = {
        "calibrated": result.calibrated, "passed": result.passed, "good": result.good,
        "passed, not good (consumer's risk)": result.wrong_pass,
        "good, not passed (producer's risk)": result.wrong_fail,
    }  # fmt: skip
    verdicts = table(
        [[name, str(share.count), *_percent(share)] for name, share in words.items()],
        ["of all tools", "tools", "share", "95 % interval"],
    )
    named = {"tools": document["output"], "picture": document["plot"]}
    files = [files_written(**named)] * any(named.values())
    refused = [f"refused: {', '.join(f'{k} {v}' for k, v in result.refused.items())}"] * bool(
        result.refused
    )
    blocks = [
        one_line("   ".join(head)),
        verdicts,
        *refused,
        _errors(result),
        _limits(result),
        *files,
    ]
    return "\n\n".join(blocks)


def _percent(share: Share) -> list[str]:
    """A share and its interval, in percent."""
    low, high = (fixed(100 * value, 2) for value in (share.low, share.high))
    return [f"{number(100 * share.share, 3)} %", f"{low}…{high} %"]


def _errors(result: Repetition) -> str:
    """Percentiles over the tools of the errors of each angle."""
    titles = {"rms": "rms error", "max": "largest error", "stated": "stated 1σ, 45°"}
    rows = [
        [f"{angle}, {title}", *(f"{number(value)}°" for value in each[word].values())]
        for angle, each in result.errors_deg.items()
        for word, title in titles.items()
    ]
    return table(rows, ["over the working range", *_titles()])


def _limits(result: Repetition) -> str:
    """Percentiles of the figures of the roll test, measured and true."""
    rows = [
        [f"{row.name}, {word}", *(quantity(v, row.unit) for v in values.values()), quantity(row.limit, row.unit), wrong]
        for row in result.limits
        for word, values, wrong in (
            ("roll test", row.value, _percent(row.wrong)[0]), ("true", row.true, ""),
        )
    ]  # fmt: skip
    return table(rows, ["roll test", *_titles(), "limit", "wrong"])


def _titles() -> list[str]:
    return [f"{percent} %" for percent in PERCENTILES]


# --------------------------------------------------------------------------
# The picture of many repetitions of a procedure.

ANGLE_LINES = dict(zip(STATED_ANGLES, plots.AXES, strict=True))
"""Axes whose colour and line the angles have."""
LIMIT_MARKERS = "osD^vP*X<>"


@plots.style()
def figure(
    columns: Mapping[str, AnyArray], judged: Sequence[Judged], plan: str, guard: float = 0.0
) -> Figure:
    """Errors of all tools, and figures of the roll test against the true ones, judged with a `guard`."""
    sound = columns["status"] == CALIBRATED
    label = "Largest error of each angle over the tools, and figures of the roll test against the true ones"
    figure, [[errors, figures]] = plots.new_figure(label, 3.4, columns=2)
    figure.suptitle(f"{plan}, {plural(len(sound), 'tool')}   {SIMULATED}", fontsize=8)
    calibrated = {name: values[sound] for name, values in columns.items()}
    _draw_errors(errors, calibrated)
    _figures(figures, calibrated, judged, guard)
    return figure


def _draw_errors(axes: Axes, columns: Mapping[str, AnyArray]) -> None:
    """The share of tools whose largest error of an angle is below a value."""
    for name, key in ANGLE_LINES.items():
        if f"{name}_error_max_deg" not in columns:
            continue
        values = np.sort(columns[f"{name}_error_max_deg"].astype(float))
        share = 100 * np.arange(1, len(values) + 1) / max(len(values), 1)
        axes.plot(values, share, color=plots.AXES[key], ls=plots.LINES[key], lw=1.2, label=name)
    axes.set(
        xscale="log", xlabel="largest error over the working range, °", ylabel="share of tools, %"
    )
    plots.plain_numbers(axes.xaxis, 1.0, 2.0, 5.0)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.06), ncols=3)


def _figures(
    axes: Axes, columns: Mapping[str, AnyArray], judged: Sequence[Judged], guard: float
) -> None:
    """Figures of the roll test over the true ones, both as shares of their limit; wrong verdicts are filled."""
    for place, each in enumerate(judged):
        value, sd, true = (columns[each.column(word)] / each.limit for word in ("", "sd", "true"))
        colour, marker = (
            plots.SERIES[place % len(plots.SERIES)][0],
            LIMIT_MARKERS[place % len(LIMIT_MARKERS)],
        )
        wrong = (value + guard * sd <= 1) != (true <= 1)
        look: dict[str, Any] = {
            "ls": "",
            "marker": marker,
            "mec": colour,
            "mew": 0.5,
            "rasterized": True,
        }
        axes.plot(true, value, mfc="none", ms=2.6, label=f"{each.kind} of {each.name}", **look)
        axes.plot(true[wrong], value[wrong], mfc=colour, ms=4.0, **look)
    axes.axhline(1.0, color=plots.BEFORE, lw=0.7, ls=(0, (4, 3)))
    axes.axvline(1.0, color=plots.BEFORE, lw=0.7, ls=(0, (4, 3)))
    axes.set(xlabel="true figure over its limit", ylabel="figure of the roll test over its limit")
    axes.set_title("filled: wrong decision")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.06), ncols=2, markerscale=1.5)
