"""`mwdcal noise`: what is read, found, shown, drawn and written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from mwdcal import __version__
from mwdcal.app import progress
from mwdcal.app.commands.noise_options import Asked
from mwdcal.app.pages import noise_plots, plots, report
from mwdcal.app.pages.noise_plots import marked, scaled
from mwdcal.app.text import table
from mwdcal.calibration.diagnosis.findings import unused_columns
from mwdcal.calibration.readings import SIMULATED
from mwdcal.calibration.record import Finding
from mwdcal.errors import InputError
from mwdcal.files import logs, synonyms
from mwdcal.files.contract import CHANNELS, COLUMNS
from mwdcal.files.formats import atomic
from mwdcal.files.profiles import load_profile
from mwdcal.logs.noise import ChannelNoise, Noise, Term, check, find_noise

ROWS = {
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


def run(asked: Asked, say: Callable[[str], None]) -> tuple[list[Finding], Any]:
    """Find, draw and write: the findings, and the result for people or for machines."""
    _check(asked)
    found = find(asked, say)
    for path, content in _files(asked, found):
        atomic.write(path, content)
    names = {"plot": str(asked["plot"] or ""), "report": str(asked["report"] or "")}
    if asked["as_json"]:
        return found.findings, {**msgspec.to_builtins(found), **names}
    wrote = [
        f"{names[k]} ({w})" for k, w in (("plot", "picture"), ("report", "report")) if names[k]
    ]
    return found.findings, screen(found) + (f"\n\nwrote {'   '.join(wrote)}" if wrote else "")


def _check(asked: Asked) -> None:
    """Refuse, before any work, what cannot be drawn or used."""
    plot, rate = asked["plot"], asked["sampling_hz"]
    if plot and plot.suffix.lower() not in noise_plots.SUFFIXES:
        allowed = ", ".join(noise_plots.SUFFIXES)
        raise InputError(f"--plot {plot}: the suffix must be one of {allowed}. Rename it.")
    if plot:
        noise_plots.require()
    if asked["report"]:
        report._environment()
    check(_between(asked), asked["station_seconds"])
    if rate is not None and not 0 < rate <= 1e9:
        raise InputError(
            f"--sampling-hz must be above 0 and at most 1e9 Hz; got {rate:g}. Correct it."
        )


def _between(asked: Asked) -> tuple[float, float]:
    """First and last second that were asked for."""
    start, end = asked["start"], asked["end"]
    return -np.inf if start is None else start, np.inf if end is None else end


def find(asked: Asked, say: Callable[[str], None]) -> Noise:
    """The noise of a log file; says how far it is where it takes long."""
    names = [name.strip() for name in asked["columns"].split(",")] if asked["columns"] else []
    profile = load_profile(asked["tool"])[0] if asked["tool"] else None
    slowly = progress.slowly(say)
    log = logs.read(asked["log"], names, decimal=asked["decimal"], say=slowly)
    found = find_noise(
        log,
        profile=profile,
        sampling_hz=asked["sampling_hz"],
        between=_between(asked),
        station_seconds=asked["station_seconds"],
        kind="modified" if asked["modified"] else "overlapping",
        say=slowly,
    )
    unused = unused_columns(synonyms.unused(list(log.columns), COLUMNS))
    return msgspec.structs.replace(found, findings=[*found.findings, *unused])


def _files(asked: Asked, found: Noise) -> list[tuple[Path, bytes | str]]:
    """What is to be written, all of it made before the first is written."""
    files: list[tuple[Path, bytes | str]] = []
    if asked["plot"]:
        kind = asked["plot"].suffix.lower()
        files.append((asked["plot"], noise_plots.picture(found, kind)))
    if asked["report"]:
        files.append((asked["report"], page(found)))
    return files


def screen(found: Noise) -> str:
    """What was found, for people."""
    parts = ["   ".join(heading(found)), ""]
    for physical in (False, True):
        header, lines = terms(found, physical)
        if header:
            parts += [table([[what, *cells] for what, cells in lines], ["", *header]), ""]
    parts += [
        "± 1σ; < bound of 95 %, where the log does not show the term. For the tool profile:",
        "",
        profile_lines(found),
    ]
    return "\n".join(parts)


def heading(found: Noise) -> list[str]:
    """What was looked at."""
    channels = list(found.channels.values())
    rates = " and ".join(dict.fromkeys(f"{c.sampling_hz:.6g} Hz" for c in channels))
    return [
        found.log,
        f"{len(channels)} channel{'s' if len(channels) > 1 else ''}",
        f"{channels[0].samples} samples at {rates}",
        f"{found.seconds:.6g} s",
        *([SIMULATED] if found.simulated else []),
    ]


def terms(found: Noise, physical: bool) -> tuple[list[str], list[Line]]:
    """Header and rows of the terms of all channels, raw, or of those with a scale in g and nT."""
    shown = {n: c for n, c in found.channels.items() if c.scale is not None or not physical}
    units = [scaled(c) if physical else _powers(c) for c in shown.values()]
    lines: list[Line] = []
    for name, (what, unit) in ROWS.items():
        per = HOUR if name == "drift" else 1.0
        cells = [
            _term(c.terms[name], factor * per, bool({*c.doubts} - {"slow"}))
            for c, (_, factor) in zip(shown.values(), units, strict=True)
        ]
        lines.append((_label(what, unit), cells))
    density = [
        "–" if c.white_density is None else _number(c.white_density * factor)
        for c, (_, factor) in zip(shown.values(), units, strict=True)
    ]
    lines.insert(1, (_label("its one-sided density", "/√Hz"), density))
    pairs = [(c, factor) for c, (_, factor) in zip(shown.values(), units, strict=True)]
    station = [_number(c.station.noise * factor) for c, factor in pairs]
    limits = ["?" if c.doubts else _limits(c, factor) for c, factor in pairs]
    lines.append((f"one station of {found.station_seconds:.3g} s, 1σ", station))
    lines.append(("its 95 % interval", limits))
    if any(c.doubts for c in shown.values()):
        lines.append(
            ("does not hold" + noise_plots.MARK, [", ".join(c.doubts) for c in shown.values()])
        )
    header = [
        f"{marked(n, c)}, {unit}" for (n, c), (unit, _) in zip(shown.items(), units, strict=True)
    ]
    return header, lines


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


def profile_lines(found: Noise) -> str:
    """The lines of a tool profile (TOML) that this log recommends, or in a comment why not."""
    lines = []
    for kind, names in CHANNELS.items():
        if kind in found.withheld:
            lines.append(f"# [{kind}] no noise from {found.log}: {found.withheld[kind]}")
        if kind not in found.profile:
            continue
        own = [
            f"{n} {_number(found.channels[n].station.noise)}" for n in names if n in found.channels
        ]
        lines += [
            f"[{kind}]",
            f"noise = {found.profile[kind]:.3g}   # raw, 1 sigma of one station of "
            f"{found.station_seconds:.3g} s; {', '.join(own)}; from {found.log}",
        ]
    return "\n".join(lines)


def page(found: Noise) -> str:
    """The report: one HTML page that needs nothing else; the same noise, the same bytes."""
    template = report._environment().get_template("noise.html")
    return template.render(
        found=found,
        heading=heading(found),
        figure=_inline(found),
        tables=[made for made in (terms(found, False), terms(found, True)) if made[0]],
        toml=profile_lines(found),
        deviations={name: _deviations(channel) for name, channel in found.channels.items()},
        version=__version__,
    )


def _inline(found: Noise) -> str:
    """The picture as an element of the page."""
    with plots._style():
        figure = noise_plots.figure(found)
        return plots._svg(figure, "noise", "Allan deviation of every channel over averaging time")


def _deviations(channel: ChannelNoise) -> list[list[str]]:
    columns = (channel.tau_s, channel.deviation, channel.lower, channel.upper)
    rows = zip(*columns, channel.fitted, channel.freedom, strict=True)
    return [[_number(value, 4) for value in row] for row in rows]
