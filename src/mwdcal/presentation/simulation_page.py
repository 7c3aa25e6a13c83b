"""The picture of many repetitions of a procedure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mwdcal.calibration.prediction import STATED_ANGLES
from mwdcal.calibration.readings import SIMULATED
from mwdcal.geometry.vectors import AnyArray
from mwdcal.planning.procedure import CALIBRATED, Judged
from mwdcal.presentation.text import plural
from mwdcal.use import plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
    _errors(errors, calibrated)
    _figures(figures, calibrated, judged, guard)
    return figure


def _errors(axes: Axes, columns: Mapping[str, AnyArray]) -> None:
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
