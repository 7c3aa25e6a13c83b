"""Allan deviations of a log as a picture: measured with its band, and the fitted terms.

Every axis has a colour, a marker and a line style of its own.
"""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np

from mwdcal.app.pages import plots
from mwdcal.calibration.readings import SIMULATED
from mwdcal.errors import InputError
from mwdcal.files.contract import CHANNELS
from mwdcal.logs.noise import ChannelNoise, Noise

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SUFFIXES = (".png", ".svg")
LOOKS = {
    "x": (plots.AFTER, "o", "-"),
    "y": (plots.MARKED, "s", (0, (5, 1.5))),
    "z": ("#111827", "^", (0, (1.5, 1.2))),
}
"""Colour, marker and line style of each axis."""
SHOWN = {"g": ("µg", 1e6), "nT": ("nT", 1.0)}
"""How physical units are written, and their number in one of them."""

MARK = " (!)"
"""Behind the name of a channel whose figures do not hold."""


def marked(name: str, channel: ChannelNoise) -> str:
    """The name of a channel, with a mark where its figures do not hold."""
    return name + MARK if channel.doubts else name


def scaled(channel: ChannelNoise) -> tuple[str, float]:
    """The unit in which a channel is best read, and how many of it a raw unit is."""
    if channel.unit is None or channel.scale is None:
        return "raw", 1.0
    unit, number = SHOWN[channel.unit]
    return unit, number / channel.scale


def require() -> None:
    """Refuse, before any work, to draw without the library that draws."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise InputError(
            "a picture needs matplotlib, which is not installed. Install mwdcal[report]: "
            "pip install 'mwdcal[report]'"
        ) from None


def picture(found: Noise, kind: str) -> bytes:
    """The picture as PNG or SVG (`kind` the suffix); the same noise, the same bytes."""
    import matplotlib as mpl

    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(plots.STYLE)
        stream = io.BytesIO()
        nothing = {"Software": None} if kind == ".png" else {"Date": None, "Creator": None}
        figure(found).savefig(stream, format=kind[1:], dpi=160, metadata=nothing)
    return stream.getvalue()


def figure(found: Noise) -> Figure:
    """One panel for each triad of the log."""
    from matplotlib.figure import Figure

    triads = [
        (kind, [name for name in names if name in found.channels])
        for kind, names in CHANNELS.items()
        if any(name in found.channels for name in names)
    ]
    made = Figure(figsize=(plots.WIDTH, 3.5), layout="constrained")
    simulated = f"   {SIMULATED}" if found.simulated else ""
    made.suptitle(f"{found.log}, {found.seconds:.4g} s{simulated}", fontsize=8)
    panels = made.subplots(1, max(len(triads), 1), squeeze=False)[0]
    for axes, (kind, names) in zip(panels, triads, strict=True):
        _draw(axes, found, names)
        unit = scaled(found.channels[names[0]])[0]
        axes.set_ylabel(f"{kind}, {'' if found.kind == 'overlapping' else 'modified '}σ(τ), {unit}")
    return made


def _draw(axes: Axes, found: Noise, names: list[str]) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter

    for name in names:
        channel = found.channels[name]
        colour, marker, line = LOOKS[name[-1]]
        factor, tau = scaled(channel)[1], np.array(channel.tau_s)
        low, middle, high, fitted = (
            np.array(v) * factor
            for v in (channel.lower, channel.deviation, channel.upper, channel.fitted)
        )
        axes.fill_between(tau, low, high, color=colour, alpha=0.13, lw=0)
        axes.plot(
            tau,
            middle,
            marker,
            color=colour,
            ms=3.6,
            mfc="white",
            mew=0.9,
            label=marked(name, channel),
        )
        axes.plot(tau, fitted, color=colour, ls=line, lw=1.0, label=f"{name}, terms")
    axes.axvline(found.station_seconds, color=plots.BEFORE, lw=0.7, ls=(0, (4, 3)))
    axes.annotate(
        f"station, {found.station_seconds:.3g} s", (found.station_seconds, 1.0), (-2, -2), rotation=90,
        xycoords=("data", "axes fraction"), textcoords="offset points", ha="right", va="top",
        fontsize=6.5, color="#374151",
    )  # fmt: skip
    axes.set(xscale="log", yscale="log", xlabel="averaging time τ, s")
    for axis in (axes.xaxis, axes.yaxis):
        crowded = np.log10(np.divide(*axis.get_view_interval()[::-1])) > 2
        axis.set_major_locator(LogLocator(subs=(1.0,) if crowded else (1.0, 2.0, 5.0)))
        axis.set_major_formatter(lambda value, _: f"{value:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.grid(which="minor", lw=0.25)
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(handles, labels, ncols=len(names), loc="upper center", bbox_to_anchor=(0.5, 1.17))
