"""Noise of a log: its tables on the screen, and the lines for the profile."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from mwdcal.calibration.diagnosis.findings import UNUSED
from mwdcal.calibration.readings import SIMULATED
from mwdcal.logs.noise import ChannelNoise, Noise, Term
from mwdcal.logs.regular import NOT_AT_REST
from mwdcal.presentation.numbers import channels_of, files_written, number
from mwdcal.presentation.page import banner, rendered
from mwdcal.presentation.text import one_line, plural, table
from mwdcal.use import plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TERM_TITLES = {
    "white": "white noise N, ·√s",
    "quantisation": "quantisation Q, ·s",
    "bias-instability": "bias instability B",
    "random-walk": "random walk K, /√s",
    "drift": "drift R, /h",
}
"""Terms as the tables call them, with what follows the unit of the channel."""
HOUR = 3600.0
Table = tuple[list[str], list[list[str]]]
"""Titles of the channels, and rows: what each is, then a cell for each channel."""
DISPLAY_UNITS = {"g": ("µg", 1e6), "nT": ("nT", 1.0)}
"""How physical units are written, and their number in one of them."""
UNSOUND_MARK = " (!)"
"""Behind the name of a channel whose figures do not hold."""


class NoiseSummary(Noise, frozen=True, kw_only=True):
    """The output of `noise`: the noise, and the files that were written."""

    plot: str
    report: str  # type: ignore[assignment,misc]  # a file here, a page of the noise there


def document(noise: Noise, plot: Path | None, report: Path | None) -> NoiseSummary:
    """The result for machines."""
    content = msgspec.structs.asdict(noise)
    return NoiseSummary(**content, plot=str(plot or ""), report=str(report or ""))


def screen(noise: Noise, plot: Path | None, report: Path | None) -> str:
    """The result for people."""
    blocks = [
        one_line("   ".join(heading(noise))),
        *(table(rows, ["", *header]) for header, rows in tables(noise)),
        "± 1σ; < bound of 95 %, where the log does not show the term. For the tool profile:",
        profile_lines(noise),
    ]
    if plot or report:
        blocks.append(files_written(picture=plot, report=report))
    return "\n\n".join(blocks)


def heading(noise: Noise) -> list[str]:
    """The data that were examined."""
    channels = list(noise.channels.values())
    rates = " and ".join(dict.fromkeys(f"{c.sampling_hz:.6g} Hz" for c in channels))
    return [
        noise.log,
        plural(len(channels), "channel"),
        f"{channels[0].samples} samples at {rates}",
        f"{noise.seconds:.6g} s",
        *([SIMULATED] if noise.simulated else []),
    ]


def tables(noise: Noise) -> list[Table]:
    """The noise terms of all channels, raw, and of those with a scale in g and nT."""
    physical = {name: c for name, c in noise.channels.items() if c.scale is not None}
    whole = [_table(noise, noise.channels, _powers)]
    return [*whole, _table(noise, physical, scaled)] if physical else whole


def _table(
    noise: Noise,
    channels: Mapping[str, ChannelNoise],
    unit_of: Callable[[ChannelNoise], tuple[str, float]],
) -> Table:
    """Terms of some channels, each in its own unit."""
    header, columns = [], []
    for name, channel in channels.items():
        unit, factor = unit_of(channel)
        header.append(f"{marked(name, channel)}, {unit}")
        columns.append(_cells(channel, factor))
    white, *others = TERM_TITLES.values()
    station = f"one station of {noise.station_seconds:.3g} s, 1σ"
    titles = [white, "its one-sided density, /√Hz", *others, station, "its 95 % interval"]
    rows = [list(row) for row in zip(titles, *columns, strict=True)]
    doubts = [", ".join(channel.doubts) for channel in channels.values()]
    return header, [*rows, ["does not hold" + UNSOUND_MARK, *doubts]] if any(doubts) else rows


def _cells(channel: ChannelNoise, factor: float) -> list[str]:
    """Row of the table for a channel of which a raw unit is `factor` shown ones."""
    doubtful = bool({*channel.doubts} - {"slow"})
    white, *others = (
        _term(channel.terms[name], factor * (HOUR if name == "drift" else 1.0), doubtful)
        for name in TERM_TITLES
    )
    density = "–" if channel.white_density is None else rounded(channel.white_density * factor)
    limits = (rounded(end * factor) for end in (channel.station.lower, channel.station.upper))
    interval = "?" if channel.doubts else "…".join(limits)
    return [white, density, *others, rounded(channel.station.noise * factor), interval]


def _powers(channel: ChannelNoise) -> tuple[str, float]:
    """The raw unit in the power of a thousand that suits a station, and its number in one."""
    power = 3 * int(np.floor(np.log10(channel.station.noise) / 3))
    return f"1e{power} raw" if power else "raw", 10.0**-power


def _term(term: Term, factor: float, doubtful: bool) -> str:
    if term.value is None or term.standard_uncertainty is None:
        return "?" if doubtful else f"< {rounded(term.upper * factor, 2)}"
    if doubtful:
        return f"{rounded(term.value * factor)} ± ?"
    share = 100 * term.standard_uncertainty / abs(term.value)
    return f"{rounded(term.value * factor)} ± {share:.2g} %"


def rounded(value: float, digits: int = 3) -> str:
    """A number to some significant digits, without trailing zeros."""
    return f"{float(f'{value:.{digits}g}'):.6g}"


def profile_lines(noise: Noise) -> str:
    """The lines of a tool profile (TOML) that this log recommends, or in a comment why not."""
    lines = []
    seconds = f"{noise.station_seconds:.3g} s"
    for kind, names in channels_of(noise.channels).items():
        if kind in noise.withheld:
            lines.append(f"# [{kind}] no noise from {noise.log}: {noise.withheld[kind]}")
        if kind in noise.profile:
            each = ", ".join(f"{n} {rounded(noise.channels[n].station.noise)}" for n in names)
            remark = f"raw, 1 sigma of one station of {seconds}; {each}; from {noise.log}"
            lines += [f"[{kind}]", f"noise = {noise.profile[kind]:.3g}   # {remark}"]
    return "\n".join(lines)


def marked(name: str, channel: ChannelNoise) -> str:
    """The name of a channel, with a mark where its figures do not hold."""
    return name + UNSOUND_MARK if channel.doubts else name


def scaled(channel: ChannelNoise) -> tuple[str, float]:
    """The unit in which a channel is best read, and how many of it a raw unit is."""
    if channel.unit is None or channel.scale is None:
        return "raw", 1.0
    unit, number = DISPLAY_UNITS[channel.unit]
    return unit, number / channel.scale


# --------------------------------------------------------------------------
# The page of the noise of a log, and its figure.


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
        heading=[part for part in heading(noise) if part != SIMULATED],  # a banner says so
        figure=figure(noise, titled=False),
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
def figure(noise: Noise, titled: bool = True) -> Figure:
    """One panel for each triad of the log; a page has the title already."""
    triads = channels_of(noise.channels)
    label = "Allan deviation of every channel over averaging time"
    figure, [panels] = plots.new_figure(label, 3.5, columns=len(triads))
    simulated = f"   {SIMULATED}" if noise.simulated else ""
    if titled:
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
