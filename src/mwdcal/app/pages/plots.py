"""Figures as SVG to be put into HTML: deterministic, no text left to fonts."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

from mwdcal.use import plots as figures
from mwdcal.use.plots import (
    AFTER,
    BAND,
    BEFORE,
    MARKED,
    STYLE,
    TITLES,
    WIDTH,
    contour_levels,
    quantity,
)
from mwdcal.use.plots import style as _style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mwdcal.calibration.prediction import AccuracyMap
    from mwdcal.calibration.record import Calibration, OrderScore

__all__ = [
    "AFTER", "BAND", "BEFORE", "MARKED", "STYLE", "TITLES", "WIDTH", "_style", "contour_levels",
    "quantity",
]  # fmt: skip


def _figure(height: float, layout: Literal["constrained"] | None = "constrained") -> Figure:
    return figures.new_figure("", height, layout)


def _svg(figure: Figure, key: str, title: str) -> str:
    """An element to put into HTML: no prologue, no names of schemas, ids of its own."""
    stream = io.StringIO()
    nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    figure.savefig(stream, format="svg", metadata=nothing)
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(
        r"<!--.*?-->\s*|<metadata>.*?</metadata>\s*|<style.*?</style>\s*", "", text, flags=re.DOTALL
    )
    text = re.sub(r' xmlns(:\w+)?="[^"]*"', "", text)
    text = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{key}-", text)
    text = re.sub(r'\b(d|x|y)="[^"]*"', _shortened, text)
    text = re.sub(r'<g([^<>]*)>\s*((?:<use [^<>]* style="([^"]*)"/>\s*)+)</g>', _gathered, text)
    head, rest = text.split(">", 1)
    text = re.sub(r' (width|height|version)="[^"]*"', "", head) + ">" + rest
    return text.replace("<svg", f'<svg role="img" aria-label="{title}"', 1)


def _shortened(path: re.Match[str]) -> str:
    """Coordinates of a path to a hundredth of a point, on fewer lines."""
    return re.sub(r"(\.\d\d)\d+", r"\1", path[0]).replace("\n", "")


def _gathered(group: re.Match[str]) -> str:
    """Markers of one series: their style said once."""
    own, markers, style = group.groups()
    if markers.count(f' style="{style}"') != markers.count("<use "):
        return group[0]
    markers = re.sub(r"\s*\n\s*", "", markers.replace(f' style="{style}"', ""))
    return f'<g{own} style="{style}">{markers}</g>'


def _labelled(figure: Figure, key: str) -> str:
    with _style():
        return _svg(figure, key, str(figure.get_label()))


def station_errors(calibration: Calibration, name: str) -> str:
    """Errors of one observable per station: before and after, each on its own scale."""
    return _labelled(figures.station_errors(calibration, name), f"error-{name}")


def deviations(calibration: Calibration, limit: float) -> str:
    """Each station's misfit in σ, with the limit above which it is to be taken again."""
    return _labelled(figures.deviations(calibration, limit), "deviation")


def order_errors(scores: Sequence[OrderScore]) -> str:
    """Error at temperatures left out of the fit by order, inside and at the ends, per triad."""
    return _labelled(figures.order_errors(scores), "orders")


def accuracy(chart: AccuracyMap, names: Sequence[str]) -> str:
    """1σ of the angles over inclination and azimuth, degrees, in contours with their numbers."""
    return _labelled(figures.accuracy(chart, names), "accuracy")
