"""The certificate as one HTML file that needs nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import msgspec

from mwdcal.certificate.document import Certificate
from mwdcal.pages.page import environment
from mwdcal.pages.records.certificate_pictures import Picture
from mwdcal.pages.records.certificate_text import certificate_text

if TYPE_CHECKING:
    from markupsafe import Markup

LONGEST_WORD = 16
"""A longer word may break every `BREAKS` characters."""
BREAKS = 8


def render_page(certificate: Certificate, pictures: Sequence[Picture] = ()) -> str:
    """The certificate as HTML: the same input gives the same text, byte for byte."""
    text = certificate_text(certificate, pictures)
    templates = environment()
    templates.filters["breakable"] = breakable
    template = templates.get_template("certificate.html")
    shown = {picture.id: picture.figure for picture in pictures}
    return template.render(text=msgspec.to_builtins(text), simulated=text.simulated, figures=shown)


def breakable(text: str) -> Markup:
    """Text as HTML that may break inside words too long for a narrow column, but not in dates and short names."""
    from markupsafe import Markup, escape

    def markup(word: str) -> Markup:
        if len(word) > LONGEST_WORD:
            parts = (word[start : start + BREAKS] for start in range(0, len(word), BREAKS))
            return Markup("<wbr>").join(map(escape, parts))
        return Markup("<span class=whole>{}</span>").format(word) if "-" in word else escape(word)

    return Markup(" ").join(map(markup, text.split(" ")))
