"""What all pages share: the templates, what these call, and the box on top."""

from __future__ import annotations

from base64 import b64encode
from hashlib import sha256
from typing import TYPE_CHECKING

from mwdcal.pages import pictures
from mwdcal.screens.numbers import (
    capital,
    contribution,
    fixed,
    measured,
    number,
    root_sum_of_squares,
    signed,
    uncertainty,
    unit,
)
from mwdcal.screens.text import chance, harmless, plural, raised

if TYPE_CHECKING:
    from jinja2 import Environment


def environment() -> Environment:
    """The templates, and what they call; refuses where what draws a page is missing."""
    pictures.require("the report", "matplotlib", "jinja2")
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    loader = PackageLoader("mwdcal.pages")
    environment = Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        finalize=lambda shown: harmless(shown) if type(shown) is str else shown,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {function.__name__: function for function in FILTERS}
    environment.filters["svg"] = pictures.svg
    script = loader.get_source(environment, "page.js")[0]
    digest = b64encode(sha256(script.encode()).digest()).decode()
    environment.globals |= {"script": Markup(script), "script_sha256": digest}
    return environment


def banner(level: str, word: str, headline: str, after: str) -> dict[str, str]:
    """The outcome on top of a page: level (good, attention, bad), word, headline, second line."""
    return {"level": level, "word": word, "headline": headline, "after": after}


def css(text: str) -> str:
    """Text as the inside of a CSS string: nothing but letters and digits is left bare."""
    return "".join(c if c.isascii() and c.isalnum() else f"\\{ord(c):x} " for c in harmless(text))


FILTERS = (
    number, signed, fixed, measured, uncertainty, contribution, root_sum_of_squares, unit,
    raised, chance, plural, capital, css,
)  # fmt: skip
"""What the templates call."""
