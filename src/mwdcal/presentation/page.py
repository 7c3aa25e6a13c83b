"""Figures as files, and as elements of a page: the same figure, the same bytes.

What all pages share: the templates, what these call, and the box on top.
"""

from __future__ import annotations

import io
import itertools
import re
from base64 import b64encode
from collections.abc import Iterable, Mapping
from hashlib import sha256
from typing import TYPE_CHECKING, Any, TypeAlias

from mwdcal import __version__, extras
from mwdcal.calibration.readings import head
from mwdcal.presentation.numbers import (
    UNDETERMINED,
    capital,
    contribution,
    fixed,
    measured,
    number,
    quantity,
    root_sum_of_squares,
    signed,
    uncertainty,
    unit,
)
from mwdcal.presentation.text import chance, escape_controls, plural, raised
from mwdcal.presentation.typed import on_page
from mwdcal.use.plots import POINT_NAMES, style

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup
    from matplotlib.figure import Figure


def require(use: str, *libraries: str, extra: str = "report") -> None:
    """Refuse to draw without the libraries that draw, which an extra installs."""
    for name in libraries:
        extras.load(name, use, extra)


def picture(figure: Figure, suffix: str) -> bytes:
    """The figure as .png or .svg, without time and program: the same figure, the same bytes."""
    kind = suffix.lower()[1:]
    stream = io.BytesIO()
    nothing = {"Software": None} if kind == "png" else {"Date": None, "Creator": None}
    with style():
        figure.savefig(stream, format=kind, dpi=160, metadata=nothing)
    figure.set_layout_engine(
        "none"
    )  # a second layout would start from the first and differ by a hair
    return stream.getvalue()


def svg(figure: Figure, key: str) -> Markup:
    """An element to put into HTML: no prologue, no names of schemas, ids that start with `key`.

    Columns of panels are pictures side by side, which a narrow screen shows below each other. Each takes the focus,
    so that a picture wider than the screen can be scrolled by keys.
    """
    from markupsafe import Markup

    _label_each(figure)
    text = "<svg" + picture(figure, ".svg").decode().partition("<svg")[2]
    text = re.sub(
        r"<!--.*?-->\n|<metadata>.*?</metadata>\s*|<style.*?</style>\s*", "", text, flags=re.DOTALL
    )
    text = re.sub(r' xmlns(:\w+)?="[^"]*"', "", text)
    text = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{key}-", text)
    text = re.sub(r'\b(d|x|y)="[^"]*"', _shortened, text)
    text = re.sub(r'<g([^<>]*)>\s*((?:<use [^<>]* style="([^"]*)"/>\s*)+)</g>', _gathered, text)
    for line in figure.findobj(lambda artist: (artist.get_gid() or "").startswith(POINT_NAMES)):
        _, *names = str(line.get_label()).split("\n")
        text = _with_names(text, f'<g id="{key}-{line.get_gid()}">', names)
    head, rest = escape_controls(text).split(">", 1)
    text = re.sub(r' (width|height|version)="[^"]*"', "", head) + ">" + rest
    seen = f'<svg role="img" aria-label="{figure.get_label()}" tabindex="0"'
    text = text.replace("<svg", seen, 1)
    return Markup(_side_by_side(text, key, figure))


Box: TypeAlias = tuple[float, float, float, float]
"""Left, top, right and bottom of a part of a picture, in points."""
MOST_STACKED = 4
"""Columns of panels that a narrow screen shows below each other; more stay beside each other."""
STRIP_MARGIN = 2.0
"""Above and below the panels of a column, points."""


def _columns(figure: Figure) -> list[list[Any]]:
    """The panels of each column of a figure; empty where one spans several, or there is one column, or very many."""
    columns: dict[int, list[Any]] = {}
    for axes in figure.axes:
        place = axes.get_subplotspec()
        if place is None or len(place.colspan) > 1:
            return []
        if axes.get_visible():
            columns.setdefault(place.colspan.start, []).append(axes)
    return [columns[k] for k in sorted(columns)] if 1 < len(columns) <= MOST_STACKED else []


def _label_each(figure: Figure) -> None:
    """Numbers and a title along the y axis of each panel that shares that of the first column."""
    first, *others = _columns(figure) or [[]]
    for axes in itertools.chain(*others):
        for leader in first:
            if axes.get_shared_y_axes().joined(axes, leader) and not axes.get_ylabel():
                axes.tick_params(labelleft=True)
                axes.set_ylabel(leader.get_ylabel())


def _box(figure: Figure, *artists: Any) -> Box:
    """The box around what was drawn."""
    each = [artist.get_tightbbox().extents * 72 / figure.dpi for artist in artists]
    left, low, right, high = (
        pick(box[k] for box in each) for k, pick in enumerate((min, min, max, max))
    )
    height = 72 * figure.get_figheight()
    return left, height - high, right, height - low


@style()
def _side_by_side(text: str, key: str, figure: Figure) -> str:
    """A picture taken apart into its legends and its columns of panels, which a narrow screen shows below each other.

    It stays whole where it has one column, or more than panels and legends above or below them.
    """
    columns = _columns(figure)
    *groups, foot = re.split(r"^(?=  <g id=)|^(?= </g>\n)", text, flags=re.MULTILINE)
    drawn = {
        match[1]: part for part in groups if (match := re.match(rf'  <g id="{key}-(\w+)"', part))
    }
    drawn.pop("patch_1", None)
    visible = [axes for axes in figure.axes if axes.get_visible()]
    names: dict[Any, str] = {axes: f"axes_{place}" for place, axes in enumerate(visible, 1)}
    names |= {legend: f"legend_{place}" for place, legend in enumerate(figure.legends, 1)}
    if not columns or {*names.values()} != {*drawn}:
        return text
    width, height = 72 * figure.get_figwidth(), 72 * figure.get_figheight()
    boxes = [_box(figure, *column) for column in columns]
    top = max(min(box[1] for box in boxes) - STRIP_MARGIN, 0.0)
    low = min(max(box[3] for box in boxes) + STRIP_MARGIN, height)
    legends = [(legend, _box(figure, legend)) for legend in figure.legends]
    if any(box[1] < low - STRIP_MARGIN and box[3] > top + STRIP_MARGIN for _, box in legends):
        return text
    edges = [0.0, *((a[2] + b[0]) / 2 for a, b in itertools.pairwise(boxes)), width]
    label = figure.get_label()
    panels = "".join(
        _part(
            (left, top, right, low), [drawn[names[axes]] for axes in column], foot * (not left)
        ).replace(
            "<svg",
            f'<svg role="img" aria-label="{label}, {place} of {len(columns)}" tabindex="0"',
            1,
        )
        for place, (column, left, right) in enumerate(
            zip(columns, edges, edges[1:], strict=False), 1
        )
    )
    shares = " ".join(f"{right - left:.2f}fr" for left, right in itertools.pairwise(edges))
    panels = f'<div class="panels" style="--columns: {shares}">{panels}</div>'
    for legend, box in legends:
        left, wide = box[0], box[2] - box[0]
        place = f"--left: {left / width:.1%}; --width: {wide / width:.1%}; --most: {wide:.0f}pt"
        look = f'<svg class="legend" role="img" aria-label="legend" style="{place}"'
        drawing = _part(box, [drawn[names[legend]]], "").replace("<svg", look, 1)
        panels = drawing + panels if box[3] <= top + STRIP_MARGIN else panels + drawing
    return panels


def _part(box: Box, groups: Iterable[str], foot: str) -> str:
    """Some groups of a picture as a picture of their own; `foot` holds what all refer to."""
    left, top, right, low = box
    view = f'viewBox="{left:.2f} {top:.2f} {right - left:.2f} {low - top:.2f}"'
    shared = foot.partition("</g>\n")[2].removesuffix("</svg>\n").strip()
    return f"<svg {view}>{''.join(groups)}{shared}</svg>"


def _with_names(text: str, start: str, names: list[str]) -> str:
    """The markers of a line with their names, if all of them are in the picture."""
    from markupsafe import escape

    before, _, after = text.partition(start)
    markers, end, rest = after.partition("</g>")
    if not end or markers.count("<use ") != len(names):
        return text
    each = iter(names)
    titled = re.sub(
        "(<use [^<>]*)/>",
        lambda use: f"{use[1]}><title>{escape(next(each))}</title></use>",
        markers,
    )
    return before + start + titled + end + rest


def _shortened(path: re.Match[str]) -> str:
    """Coordinates of a path to a hundredth of a point, on fewer lines."""
    return re.sub(r"(\.\d\d)\d+", r"\1", path[0]).replace("\n", "")


def _gathered(group: re.Match[str]) -> str:
    """Markers of one series: their style said once."""
    attributes, markers, look = group.groups()
    if markers.count(f' style="{look}"') != markers.count("<use "):
        return group[0]
    markers = re.sub(r"\s*\n\s*", "", markers.replace(f' style="{look}"', ""))
    return f'<g{attributes} style="{look}">{markers}</g>'


def environment() -> Environment:
    """The templates, and what they call; refuses where what draws a page is missing."""
    require("the report", "matplotlib", "jinja2")
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    loader = PackageLoader("mwdcal.presentation")
    environment = Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        finalize=lambda shown: escape_controls(shown) if type(shown) is str else shown,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {function.__name__: function for function in FILTERS}
    environment.filters["svg"] = svg
    script = loader.get_source(environment, "page.js")[0]
    digest = b64encode(sha256(script.encode()).digest()).decode()
    environment.globals |= {
        "script": Markup(script),
        "script_sha256": digest,
        "UNDETERMINED": UNDETERMINED,
    }
    return environment


def rendered(template: str, *metadata: Mapping[str, object], **facts: Any) -> str:
    """A page: a template with its facts, and what all pages state: serial, whether simulated, the version."""
    whole = {**head(*metadata), "version": __version__, **facts}
    return environment().get_template(template).render(**whole)


def banner(level: str, word: str, headline: str, after: str) -> dict[str, str]:
    """The outcome on top of a page: level (good, attention, bad), word, headline, second line."""
    return {"level": level, "word": word, "headline": headline, "after": after}


def css(text: str) -> str:
    """Text as the inside of a CSS string: nothing but letters and digits is left bare."""
    return "".join(
        c if c.isascii() and c.isalnum() else f"\\{ord(c):x} " for c in escape_controls(text)
    )


FILTERS = (
    number, quantity, signed, fixed, measured, uncertainty, contribution, root_sum_of_squares, unit,
    raised, chance, plural, capital, css, on_page,
)  # fmt: skip
"""The functions that the templates call."""
