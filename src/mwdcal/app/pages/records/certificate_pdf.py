"""The certificate as PDF/A-3, set by typst from data, with its JSON attached.

Only the fonts that typst brings are used: the same input, and the same version of typst, give the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from functools import partial
from importlib import resources
from typing import Any, Literal

import msgspec

from mwdcal.app.pages.pictures import picture, require
from mwdcal.app.pages.records.certificate_blocks import mapped_texts
from mwdcal.app.pages.records.certificate_pictures import Picture
from mwdcal.app.pages.records.certificate_text import certificate_text
from mwdcal.calibration.record import canonical
from mwdcal.certificate.document import Certificate

STANDARD: Literal["a-3a"] = "a-3a"
"""Of PDF: for archives, tagged for readers of screens, with files attached."""
SHOW = b'#set document(title: "text")\n#set text(font: "Libertinus Serif")\n#sys.inputs.text'
"""A document of nothing but a text."""


def render_pdf(certificate: Certificate, pictures: Sequence[Picture] = ()) -> bytes:
    """The certificate as PDF: the same input gives the same bytes.

    Characters that no font has are shown by their code, such as [U+4E2D]; the attached JSON has them as
    they are.

    Raises:
        InputError: typst is not installed.
    """
    require("a certificate as PDF", "typst", extra="certificate")
    text = msgspec.to_builtins(certificate_text(certificate, pictures))
    lacking = _lacking("".join(sorted(_characters(text))))
    shown = mapped_texts(text, partial(_by_code, lacking))
    template = resources.files("mwdcal.app.pages").joinpath("templates", "certificate.typ")
    return _compiled(
        template.read_bytes(),
        _timestamp(certificate),
        text=_json(shown),
        pictures=_json({each.id: picture(each.figure, ".svg").decode() for each in pictures}),
        certificate=canonical(msgspec.to_builtins(certificate)).decode(),
    )


def _json(data: Any) -> str:
    return msgspec.json.encode(data).decode()


def _compiled(source: bytes, timestamp: int, **inputs: str) -> bytes:
    import typst

    result: bytes = typst.compile(
        source,
        format="pdf",
        ignore_system_fonts=True,
        sys_inputs=inputs,
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
