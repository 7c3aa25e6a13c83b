"""Noise of a log: its tables on the screen, the lines for the profile, the page and its figure."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from mwdcal import __version__
from mwdcal.app.pages.page import environment
from mwdcal.app.text import one_line, plural, table
from mwdcal.calibration.readings import SIMULATED
from mwdcal.files.contract import CHANNELS
from mwdcal.logs.noise import ChannelNoise, Noise, Term
from mwdcal.use import plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TERM_ROWS = {
    "white": ("white noise N", "·√s"),
    "quantisation": ("quantisation Q", "·s"),
    "bias-instability": ("bias instability B", ""),
    "random-walk": ("random walk K", "/√s"),
    "drift": ("drift R", "/h"),
}
"""Terms as the tables call them, with what follows the unit of the channel."""
HOUR = 3600.0
Line = tuple[str, list[str]]
"""A row of a table: what, and a cell for each channel."""
AXIS_LOOKS = {
    "x": (plots.AXES["x"], "o", "-"),
    "y": (plots.AXES["y"], "s", (0, (5, 1.5))),
    "z": (plots.AXES["z"], "^", (0, (1.5, 1.2))),
}
"""Colour, marker and line style of each axis."""
DISPLAY_UNITS = {"g": ("µg", 1e6), "nT": ("nT", 1.0)}
"""How physical units are written, and their number in one of them."""
MARK = " (!)"
"""Behind the name of a channel whose figures do not hold."""


def document(noise: Noise, plot: Path | None, report: Path | None) -> dict[str, Any]:
    """The result for machines."""
    return {**msgspec.to_builtins(noise), "plot": str(plot or ""), "report": str(report or "")}


def screen(noise: Noise, plot: Path | None, report: Path | None) -> str:
    """The result for people."""
    parts = [one_line("   ".join(heading(noise))), ""]
    for header, lines in tables(noise):
        parts += [table([[what, *cells] for what, cells in lines], ["", *header]), ""]
    parts += [
        "± 1σ; < bound of 95 %, where the log does not show the term. For the tool profile:",
        "",
        profile_lines(noise),
    ]
    files = [f"{path} ({what})" for path, what in ((plot, "picture"), (report, "report")) if path]
    return "\n".join(parts) + (f"\n\nwrote {one_line('   '.join(files))}" if files else "")


def heading(noise: Noise) -> list[str]:
    """What was looked at."""
    channels = list(noise.channels.values())
    rates = " and ".join(dict.fromkeys(f"{c.sampling_hz:.6g} Hz" for c in channels))
    return [
        noise.log,
        plural(len(channels), "channel"),
        f"{channels[0].samples} samples at {rates}",
        f"{noise.seconds:.6g} s",
        *([SIMULATED] if noise.simulated else []),
    ]


def tables(noise: Noise) -> list[tuple[list[str], list[Line]]]:
    """Header and rows of the noise terms: of all channels, raw, and of those with a scale in g and nT."""
    scaled_channels = {n: c for n, c in noise.channels.items() if c.scale is not None}
    return [
        _terms(noise, channels, physical)
        for channels, physical in ((noise.channels, False), (scaled_channels, True))
        if channels
    ]


def _terms(
    noise: Noise, channels: Mapping[str, ChannelNoise], physical: bool
) -> tuple[list[str], list[Line]]:
    units = [scaled(c) if physical else _powers(c) for c in channels.values()]
    pairs = [(c, factor) for c, (_, factor) in zip(channels.values(), units, strict=True)]
    lines: list[Line] = []
    for name, (what, unit) in TERM_ROWS.items():
        per = HOUR if name == "drift" else 1.0
        cells = [
            _term(c.terms[name], factor * per, bool({*c.doubts} - {"slow"})) for c, factor in pairs
        ]
        lines.append((_label(what, unit), cells))
    density = [
        "–" if c.white_density is None else _number(c.white_density * factor) for c, factor in pairs
    ]
    lines.insert(1, (_label("its one-sided density", "/√Hz"), density))
    station = [_number(c.station.noise * factor) for c, factor in pairs]
    limits = ["?" if c.doubts else _limits(c, factor) for c, factor in pairs]
    lines.append((f"one station of {noise.station_seconds:.3g} s, 1σ", station))
    lines.append(("its 95 % interval", limits))
    if any(c.doubts for c, _ in pairs):
        lines.append(("does not hold" + MARK, [", ".join(c.doubts) for c, _ in pairs]))
    named = zip(channels.items(), units, strict=True)
    return [f"{marked(name, c)}, {unit}" for (name, c), (unit, _) in named], lines


def _limits(channel: ChannelNoise, factor: float) -> str:
    return f"{_number(channel.station.lower * factor)}…{_number(channel.station.upper * factor)}"


def _powers(channel: ChannelNoise) -> tuple[str, float]:
    """The raw unit in the power of a thousand that suits a station, and its number in one."""
    power = 3 * int(np.floor(np.log10(channel.station.noise) / 3))
    return f"1e{power} raw" if power else "raw", 10.0**-power


def _label(what: str, unit: str) -> str:
    return f"{what}, {unit}" if unit else what


def _term(term: Term, factor: float, doubtful: bool) -> str:
    if term.value is None or term.standard_uncertainty is None:
        return "?" if doubtful else f"< {_number(term.upper * factor, 2)}"
    if doubtful:
        return f"{_number(term.value * factor)} ± ?"
    share = 100 * term.standard_uncertainty / abs(term.value)
    return f"{_number(term.value * factor)} ± {share:.2g} %"


def _number(value: float, digits: int = 3) -> str:
    return f"{float(f'{value:.{digits}g}'):.6g}"


def profile_lines(noise: Noise) -> str:
    """The lines of a tool profile (TOML) that this log recommends, or in a comment why not."""
    lines = []
    for kind, names in CHANNELS.items():
        if kind in noise.withheld:
            lines.append(f"# [{kind}] no noise from {noise.log}: {noise.withheld[kind]}")
        if kind not in noise.profile:
            continue
        each = [
            f"{n} {_number(noise.channels[n].station.noise)}" for n in names if n in noise.channels
        ]
        lines += [
            f"[{kind}]",
            f"noise = {noise.profile[kind]:.3g}   # raw, 1 sigma of one station of "
            f"{noise.station_seconds:.3g} s; {', '.join(each)}; from {noise.log}",
        ]
    return "\n".join(lines)


def render(noise: Noise) -> str:
    """The report: one HTML page that needs nothing else; the same noise, the same bytes."""
    template = environment().get_template("noise.html")
    return template.render(
        result=noise,
        simulated=noise.simulated,
        heading=heading(noise),
        figure=figure(noise),
        tables=tables(noise),
        toml=profile_lines(noise),
        deviations={name: _deviations(channel) for name, channel in noise.channels.items()},
        version=__version__,
    )


def _deviations(channel: ChannelNoise) -> list[list[str]]:
    columns = (channel.tau_s, channel.deviation, channel.lower, channel.upper)
    rows = zip(*columns, channel.fitted, channel.freedom, strict=True)
    return [[_number(value, 4) for value in row] for row in rows]


def marked(name: str, channel: ChannelNoise) -> str:
    """The name of a channel, with a mark where its figures do not hold."""
    return name + MARK if channel.doubts else name


def scaled(channel: ChannelNoise) -> tuple[str, float]:
    """The unit in which a channel is best read, and how many of it a raw unit is."""
    if channel.unit is None or channel.scale is None:
        return "raw", 1.0
    unit, number = DISPLAY_UNITS[channel.unit]
    return unit, number / channel.scale


@plots.styled
def figure(noise: Noise) -> Figure:
    """One panel for each triad of the log."""
    triads = [
        (kind, [name for name in names if name in noise.channels])
        for kind, names in CHANNELS.items()
        if any(name in noise.channels for name in names)
    ]
    figure = plots.new_figure("Allan deviation of every channel over averaging time", 3.5)
    simulated = f"   {SIMULATED}" if noise.simulated else ""
    figure.suptitle(f"{noise.log}, {noise.seconds:.4g} s{simulated}", fontsize=8)
    panels = figure.subplots(1, max(len(triads), 1), squeeze=False)[0]
    for axes, (kind, names) in zip(panels, triads, strict=True):
        _draw(axes, noise, names)
        unit = scaled(noise.channels[names[0]])[0]
        axes.set_ylabel(f"{kind}, {'' if noise.kind == 'overlapping' else 'modified '}σ(τ), {unit}")
    return figure


def _draw(axes: Axes, noise: Noise, names: list[str]) -> None:
    for name in names:
        channel = noise.channels[name]
        colour, marker, line = AXIS_LOOKS[name[-1]]
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
    axes.axvline(noise.station_seconds, color=plots.BEFORE, lw=0.7, ls=(0, (4, 3)))
    axes.annotate(
        f"station, {noise.station_seconds:.3g} s", (noise.station_seconds, 1.0), (-2, -2), rotation=90,
        xycoords=("data", "axes fraction"), textcoords="offset points", ha="right", va="top",
        fontsize=6.5, color="#374151",
    )  # fmt: skip
    axes.set(xscale="log", yscale="log", xlabel="averaging time τ, s")
    for axis in (axes.xaxis, axes.yaxis):
        crowded = np.log10(np.divide(*axis.get_view_interval()[::-1])) > 2
        plots.plain_numbers(axis, *((1.0,) if crowded else (1.0, 2.0, 5.0)))
    axes.grid(which="minor", lw=0.25)
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(handles, labels, ncols=len(names), loc="upper center", bbox_to_anchor=(0.5, 1.17))
