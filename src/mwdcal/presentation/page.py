"""Figures as files, and as elements of a page: the same figure, the same bytes.

What all pages share: the templates, what these call, and the box on top.
"""

from __future__ import annotations

import io
import re
from base64 import b64encode
from collections.abc import Mapping
from hashlib import sha256
from typing import TYPE_CHECKING, Any

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

    It takes the focus, so that a picture wider than the screen can be scrolled by keys.
    """
    from markupsafe import Markup

    text = "<svg" + picture(figure, ".svg").decode().partition("<svg")[2]
    text = re.sub(
        r"<!--.*?-->\s*|<metadata>.*?</metadata>\s*|<style.*?</style>\s*", "", text, flags=re.DOTALL
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
    return Markup(text.replace("<svg", seen, 1))


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
    raised, chance, plural, capital, css,
)  # fmt: skip
"""The functions that the templates call."""
