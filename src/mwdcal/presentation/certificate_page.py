"""The certificate as one HTML file that needs nothing else, and as PDF/A-3, set by typst, with its JSON attached.

Its pictures are drawn from the calibration and the roll tests behind it.

Only the fonts that typst brings are used: the same input, and the same version of typst, give the same bytes.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from functools import partial
from importlib import resources
from typing import TYPE_CHECKING, Any, Literal

import msgspec

from mwdcal.calibration.record import Calibration
from mwdcal.certificate.document import Certificate
from mwdcal.files.documents import laid_out
from mwdcal.geometry.observables import TITLES
from mwdcal.presentation.certificate_text import Picture, certificate_text, mapped_texts
from mwdcal.presentation.page import environment, picture, require
from mwdcal.use import plots as plots
from mwdcal.use.verification import Verdict

if TYPE_CHECKING:
    from markupsafe import Markup

    from mwdcal.drift.document import ToolDrift


def certificate_pictures(
    calibration: Calibration,
    as_left: Verdict | None = None,
    as_found: Verdict | None = None,
    drift: ToolDrift | None = None,
) -> list[Picture]:
    """Pictures of the results: errors before and after, residuals, 1σ, roll tests, earlier calibrations."""
    tests = _roll_tests(as_found, as_left)
    return [*_fit(calibration), *_accuracy(calibration), *tests, *_past(drift)]


def _past(drift: ToolDrift | None) -> Iterator[Picture]:
    if drift is None:
        return
    from mwdcal.presentation.drift_page import drift_picture

    note = (
        "Differences from the first calibration, with 95 % bars. Pale columns: control limits, three standard "
        "deviations of what both uncertainties and the random walk allow. Dashed: a change that the uncertainties do "
        "not explain."
    )
    yield Picture("drift", "Biases from calibration to calibration", drift_picture(drift), note)


def _fit(calibration: Calibration) -> Iterator[Picture]:
    for row in calibration.errors:
        title = f"Error of {TITLES[row.observable]} at each station, before and after"
        yield Picture(f"error-{row.observable}", title, calibration.plot.errors(row.observable))
    if calibration.station_rows:
        title = "Residuals: misfit of each station"
        note = "A station above the dashed line should be measured again."
        yield Picture("residuals", title, calibration.plot.deviations(), note)


def _accuracy(calibration: Calibration) -> Iterator[Picture]:
    note = "Standard uncertainty, typical over toolface and azimuth."
    title = "Standard uncertainty (1σ) over inclination"
    band = f"{note} Band: from the best to the worst azimuth."
    yield Picture("accuracy", title, calibration.plot.accuracy(), band)
    if calibration.plot.over_temperature:
        title = "Standard uncertainty (1σ) over temperature, at 45° inclination"
        figure = calibration.plot.accuracy_over_temperature()
        yield Picture("accuracy-temperature", title, figure, note)


def _roll_tests(as_found: Verdict | None, as_left: Verdict | None) -> Iterator[Picture]:
    note = "Markers: stations, noise included. Curves: mean and harmonics over a turn of toolface."
    for when, verdict in (("as found", as_found), ("as left", as_left)):
        if verdict is not None and any(row.sets for row in verdict.rows):
            title = f"Roll test {when}: departures over toolface"
            yield Picture(when.replace(" ", "-"), title, verdict.plot.toolface(), note)


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
    template = resources.files("mwdcal.presentation").joinpath("templates", "certificate.typ")
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
