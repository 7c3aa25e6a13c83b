"""Noise of a log: its tables on the screen, and the lines for the profile."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import msgspec
import numpy as np

from mwdcal.calibration.readings import SIMULATED
from mwdcal.logs.noise import ChannelNoise, Noise, Term
from mwdcal.presentation.numbers import channels_of, files_written
from mwdcal.presentation.text import one_line, plural, table

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
    """What the table says of a channel of which a raw unit is `factor` shown ones."""
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
