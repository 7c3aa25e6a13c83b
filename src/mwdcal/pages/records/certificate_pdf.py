"""The certificate as PDF/A-3, set by typst from data, with its JSON attached.

Only the fonts that typst brings are used: the same input, and the same version of typst, give the same bytes.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence
from datetime import UTC, datetime
from functools import partial
from importlib import resources
from typing import Any, Literal

import msgspec

from mwdcal.certificate.document import Certificate
from mwdcal.files.documents import laid_out
from mwdcal.pages.pictures import picture, require
from mwdcal.pages.records.certificate_blocks import mapped_texts
from mwdcal.pages.records.certificate_pictures import Picture
from mwdcal.pages.records.certificate_text import certificate_text

STANDARD: Literal["a-3a"] = "a-3a"
"""Of PDF: for archives, tagged for readers of screens, with files attached."""
SHOW = b"""#set document(title: "text")
#set text(font: json(bytes(sys.inputs.fonts)), fallback: false)
#sys.inputs.text"""
"""A document of nothing but a text."""
FONTS = ("Libertinus Serif", "DejaVu Sans Mono", "New Computer Modern", "New Computer Modern Math")
"""Those that typst brings, in the order in which a character is looked for."""
SCRIPTS = ((0x80, 0x530), (0x1E00, 0x2C00))
"""Latin, Greek and Cyrillic letters, and signs: what these fonts have, and where they are asked."""


def render_pdf(certificate: Certificate, pictures: Sequence[Picture] = ()) -> bytes:
    """The certificate as PDF: the same input gives the same bytes.

    Characters that no font has are shown by their code, such as [U+4E2D]; the attached JSON has them as
    they are.

    Raises:
        InputError: typst is not installed.
    """
    require("a certificate as PDF", "typst", extra="certificate")
    text = msgspec.to_builtins(certificate_text(certificate, pictures))
    characters = _characters(text)
    odd = frozenset(filter(_odd, characters))
    lacking = odd | _lacking("".join(sorted(characters - odd)))
    shown = mapped_texts(text, partial(_by_code, lacking))
    template = resources.files("mwdcal.pages").joinpath("templates", "certificate.typ")
    return _compiled(
        template.read_bytes(),
        _timestamp(certificate),
        text=_json(shown),
        pictures=_json({each.id: picture(each.figure, ".svg").decode() for each in pictures}),
        certificate=laid_out(msgspec.json.encode(certificate)).decode(),
    )


def _json(data: Any) -> str:
    return msgspec.json.encode(data).decode()


def _compiled(source: bytes, timestamp: int, **inputs: str) -> bytes:
    import typst

    result: bytes = typst.compile(
        source,
        format="pdf",
        ignore_system_fonts=True,
        sys_inputs=inputs | {"fonts": _json(FONTS)},
        pdf_standards=[STANDARD],
        timestamp=timestamp,
    )
    return result


def _timestamp(certificate: Certificate) -> int:
    """The day of issue in seconds since 1970, or that of the calibration; 0 where neither is a date."""
    for stated in (certificate.issued, certificate.calibrated):
        try:
            day = datetime.fromisoformat(stated)
        except ValueError:
            continue
        return max(int(day.replace(tzinfo=day.tzinfo or UTC).timestamp()), 0)
    return 0


def _characters(data: Any) -> set[str]:
    """The characters beyond ASCII of all texts."""
    characters: set[str] = set()

    def gather(text: str) -> str:
        characters.update(c for c in text if not c.isascii())
        return text

    mapped_texts(data, gather)
    return characters


def _odd(character: str) -> bool:
    """Whether it is of another script, or not printed; typst fails on some of these next to others."""
    of_ours = any(low <= ord(character) < high for low, high in SCRIPTS)
    return not of_ours or unicodedata.category(character).startswith("C")


def _lacking(characters: str) -> frozenset[str]:
    """Those characters that no font of typst has, by halves: a text is refused that has one."""
    import typst

    if not characters:
        return frozenset()
    try:
        _compiled(SHOW, 0, text=" ".join(characters))
    except typst.TypstError:
        if len(characters) == 1:
            return frozenset(characters)
        middle = len(characters) // 2
        return _lacking(characters[:middle]) | _lacking(characters[middle:])
    return frozenset()


def _by_code(lacking: frozenset[str], text: str) -> str:
    """The text with the code in place of characters that cannot be shown."""
    return "".join(f"[U+{ord(c):04X}]" if c in lacking else c for c in text)
