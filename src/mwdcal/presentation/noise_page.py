"""The page of the noise of a log, and its figure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mwdcal.calibration.diagnosis.findings import UNUSED
from mwdcal.calibration.readings import SIMULATED
from mwdcal.logs.noise import ChannelNoise, Noise
from mwdcal.logs.regular import NOT_AT_REST
from mwdcal.presentation.noise import heading, marked, profile_lines, rounded, scaled, tables
from mwdcal.presentation.numbers import channels_of, number
from mwdcal.presentation.page import banner, rendered
from mwdcal.presentation.text import plural
from mwdcal.use import plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

AXIS_MARKERS = {"x": "o", "y": "s", "z": "^"}
"""Markers of the channels of a triad."""


def render(noise: Noise, log_sha256: str = "", profile: str = "", profile_sha256: str = "") -> str:
    """The report as HTML, with the name of its tool profile and the SHA-256 of its sources."""
    return rendered(
        "noise.html",
        result=noise,
        simulated=noise.simulated,
        banner=_banner(noise),
        findings=[f for f in noise.findings if f.id != NOT_AT_REST],
        heading=heading(noise),
        figure=figure(noise),
        tables=tables(noise),
        toml=profile_lines(noise),
        rounded=rounded,
        log_sha256=log_sha256,
        profile=profile,
        profile_sha256=profile_sha256,
    )


def _banner(noise: Noise) -> dict[str, str]:
    """Whether the log is one of a tool at rest, which figures hold, and what to do."""
    moved = next((f for f in noise.findings if f.id == NOT_AT_REST), None)
    if moved:
        headline = "This log is not at rest: run mwdcal stations"
        return banner("bad", "Not at rest", headline, moved.text.partition(": ")[2])
    count = plural(len(noise.channels), "channel")
    if noise.withheld:
        doubtful = sum(bool(channel.doubts) for channel in noise.channels.values())
        some = "Some" if doubtful < len(noise.channels) else "The"
        headline = f"{some} figures do not hold – {doubtful} of {count}"
        why = "; ".join(f"{kind}: {reason}" for kind, reason in noise.withheld.items())
        return banner("attention", "Attention", headline, f"No noise for the profile of the {why}.")
    headline = f"At rest – noise of {count} found"
    named = ", ".join(f"{kind} {number(value)} raw" for kind, value in noise.profile.items())
    after = f"1σ of a station of {rounded(noise.station_seconds)} s, for the tool profile: {named}."
    if any(finding.id != UNUSED for finding in noise.findings):
        return banner("attention", "Attention", headline, f"See the findings below. {after}")
    return banner("good", "OK", headline, after)


@plots.style()
def figure(noise: Noise) -> Figure:
    """One panel for each triad of the log."""
    triads = channels_of(noise.channels)
    label = "Allan deviation of every channel over averaging time"
    figure, [panels] = plots.new_figure(label, 3.5, columns=len(triads))
    simulated = f"   {SIMULATED}" if noise.simulated else ""
    figure.suptitle(f"{noise.log}, {noise.seconds:.4g} s{simulated}", fontsize=8)
    modified = "" if noise.kind == "overlapping" else "modified "
    for axes, (kind, names) in zip(panels, triads.items(), strict=True):
        _draw(axes, noise, names)
        axes.set_ylabel(f"{kind}, {modified}σ(τ), {scaled(noise.channels[names[0]])[0]}")
    return figure


def _draw(axes: Axes, noise: Noise, names: list[str]) -> None:
    """The channels of a triad over the averaging time, and the duration of a station."""
    for name in names:
        _draw_channel(axes, name, noise.channels[name])
    axes.axvline(noise.station_seconds, color=plots.BEFORE, lw=0.7, ls=(0, (4, 3)))
    place = {"xycoords": ("data", "axes fraction"), "ha": "right", "va": "top", "rotation": 90}
    look = plots.NOTE | place | {"fontsize": 6.5, "color": "#374151"}
    title = f"station, {noise.station_seconds:.3g} s"
    axes.annotate(title, (noise.station_seconds, 1.0), (-2, -2), **look)
    axes.set(xscale="log", yscale="log", xlabel="averaging time τ, s")
    for axis in (axes.xaxis, axes.yaxis):
        crowded = np.log10(np.divide(*axis.get_view_interval()[::-1])) > 2
        plots.plain_numbers(axis, *((1.0,) if crowded else (1.0, 2.0, 5.0)))
    axes.grid(which="minor", lw=0.25)
    axes.legend(ncols=len(names), loc="upper center", bbox_to_anchor=(0.5, 1.17))


def _draw_channel(axes: Axes, name: str, channel: ChannelNoise) -> None:
    """Deviations with their band, and the terms as fitted."""
    axis = name[-1]
    colour, marker, line = plots.AXES[axis], AXIS_MARKERS[axis], plots.LINES[axis]
    factor, tau = scaled(channel)[1], np.array(channel.tau_s)
    columns = (channel.lower, channel.deviation, channel.upper, channel.fitted)
    low, middle, high, fitted = (np.array(column) * factor for column in columns)
    look: dict[str, Any] = {"ms": 3.6, "mfc": "white", "mew": 0.9, "label": marked(name, channel)}
    axes.fill_between(tau, low, high, color=colour, alpha=0.13, lw=0)
    axes.plot(tau, middle, marker, color=colour, **look)
    axes.plot(tau, fitted, color=colour, ls=line, lw=1.0, label=f"{name}, terms")
