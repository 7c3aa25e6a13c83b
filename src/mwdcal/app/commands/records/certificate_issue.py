"""`mwdcal certificate CAL`: the certificate of a calibration, in any of its forms."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, date, datetime
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result
from mwdcal.errors import InputError

if TYPE_CHECKING:
    from mwdcal.calibration.record import Calibration
    from mwdcal.certificate.contents import Order
    from mwdcal.certificate.document import Certificate, SourceFile
    from mwdcal.drift.document import ToolDrift
    from mwdcal.pages.records.certificate_pictures import Picture
    from mwdcal.screens.records.calibrations import LoadedCalibration

Read = TypeVar("Read")
CERTIFICATE_FORMS = (".json", ".html", ".pdf", ".xml")
"""Suffixes of the forms of a certificate."""
ISO_DAY = click.DateTime(["%Y-%m-%d"])
"""A day as it is typed."""


@options.command()
@options.CALIBRATION
@click.option(
    "-o",
    "--output",
    type=options.FILE,
    multiple=True,
    metavar="C.json|.html|.pdf|.xml",
    help="Certificate to write, the form by its suffix; may be repeated.",
)
@click.option(
    "--verification",
    type=options.FILE,
    metavar="V.json",
    help="Roll test with this calibration (as left), as mwdcal verify --json printed it.",
)
@click.option(
    "--as-found",
    type=options.FILE,
    metavar="V.json",
    help="Roll test before the adjustment, with the previous calibration.",
)
@click.option(
    "--laboratory",
    type=options.FILE,
    metavar="LAB.toml",
    help="What the laboratory states: name, people, standards, decision rule.",
)
@click.option(
    "--registry",
    metavar="URL|FILE",
    help="Registry with the earlier calibrations of the tool, whose drift the certificate then shows.",
)
@click.option("--number", default="", metavar="N", help="Number of the certificate.")
@click.option("--customer", default="", metavar="NAME", help="Customer.")
@click.option("--condition", default="", metavar="TEXT", help="Condition of the tool when it came.")
@click.option("--received", type=ISO_DAY, metavar="YYYY-MM-DD", help="Day of receipt of the tool.")
@click.option(
    "--date",
    "day",
    type=ISO_DAY,
    metavar="YYYY-MM-DD",
    help="Day of issue; today (UTC) if not given.",
)
@options.TRUSTED_KEYS
@options.JSON
def command(
    calibration: Path, output: tuple[Path, ...], verification: Path | None, as_found: Path | None,
    laboratory: Path | None, registry: str | None, number: str, customer: str, condition: str,
    received: datetime | None, day: datetime | None, key: tuple[Path, ...], as_json: bool,
) -> None:  # fmt: skip
    """Issue the certificate of a CALIBRATION: ISO/IEC 17025 contents, uncertainty budget, decisions with their risk.

    What the laboratory file does not state is named in the certificate. A failed roll test is shown as failed.

    \b
    Example: mwdcal certificate tool.json --verification v.json --laboratory lab.toml -o C.json -o C.pdf
    Exit: 0 written, 2 input cannot be read or does not belong to the calibration.
    """
    from msgspec import to_builtins

    from mwdcal.certificate.contents import Order, certificate
    from mwdcal.certificate.laboratory import load_laboratory
    from mwdcal.files import verifications
    from mwdcal.files.formats import atomic
    from mwdcal.screens.records.calibrations import load_calibration
    from mwdcal.screens.records.certificate_issue import screen

    _check_forms(output)
    paths = {"calibration": calibration, "verification": verification, "as-found": as_found}
    paths["laboratory"] = laboratory
    options.check_outputs(output, [*paths.values(), registry, *key])
    loaded = load_calibration(calibration, key)
    as_left, left_digest = _read(verifications.load_verification, verification)
    before, before_digest = _read(verifications.load_verification, as_found)
    stated, laboratory_digest = _read(load_laboratory, laboratory)
    issued = day.date() if day else datetime.now(UTC).date()
    drift = _drift(registry, loaded, issued) if registry else None
    digests = (loaded.digest, left_digest, before_digest, laboratory_digest)
    order = Order(
        issued=issued,
        number=number,
        customer=customer,
        condition=condition,
        received=received.date() if received else None,
        verification=as_left,
        as_found=before,
        calibration_sha256=loaded.digest,
        files=tuple(_sources(paths, digests, output)),
        findings=(*loaded.findings, *(drift.findings if drift else ())),
    )
    result = certificate(loaded.calibration, order, stated)
    pictures = cache(partial(_pictures, loaded.calibration, order, drift))
    forms = [(path, _form(path, result, pictures)) for path in output]
    atomic.write_all(forms)
    print_result(to_builtins(result) if as_json else screen(result, output), result.findings)


def _read(load: Callable[[Path], tuple[Read, str]], path: Path | None) -> tuple[Read | None, str]:
    """What a file holds, and its SHA-256; nothing where none is named."""
    return load(path) if path else (None, "")


def _check_forms(outputs: Sequence[Path]) -> None:
    """Refuse a file whose suffix names no form, before any work."""
    for path in outputs:
        if path.suffix.lower() not in CERTIFICATE_FORMS:
            allowed = ", ".join(CERTIFICATE_FORMS)
            raise InputError(f"`output` '{path}': the suffix must be one of {allowed}. Rename it.")


def _sources(
    paths: Mapping[str, Path | None], digests: Sequence[str], outputs: Sequence[Path]
) -> Iterator[SourceFile]:
    """The files behind the certificate, by their paths from its folder: that of its JSON, else of the first form."""
    from mwdcal.certificate.document import SourceFile

    first = [path for path in outputs if path.suffix.lower() == CERTIFICATE_FORMS[0]] or list(
        outputs
    )
    folder = first[0].resolve().parent if first else Path.cwd()
    for (name, path), digest in zip(paths.items(), digests, strict=True):
        if path:
            yield SourceFile(id=name, name=_from(path, folder), sha256=digest)


def _from(path: Path, folder: Path) -> str:
    """A path as seen from a folder, with slashes; whole where there is none, as from another drive."""
    whole = path.resolve()
    try:
        return Path(os.path.relpath(whole, folder)).as_posix()
    except ValueError:
        return whole.as_posix()


def _drift(registry: str, loaded: LoadedCalibration, today: date) -> ToolDrift | None:
    """How the tool changed up to its calibration; None where the registry has no earlier one."""
    from mwdcal.app.commands.records.drift_sources import drift_of
    from mwdcal.registry.store import open_registry

    with open_registry(registry) as opened:
        return drift_of(opened, loaded.calibration, loaded.digest, today)


def _pictures(calibration: Calibration, order: Order, drift: ToolDrift | None) -> list[Picture]:
    from mwdcal.pages.pictures import require

    require("a certificate as page or PDF", "matplotlib")
    from mwdcal.pages.records.certificate_pictures import certificate_pictures

    return certificate_pictures(calibration, order.verification, order.as_found, drift)


def _form(
    path: Path, certificate: Certificate, pictures: Callable[[], list[Picture]]
) -> bytes | str:
    """The certificate in the form that the suffix of its file names."""
    suffix = path.suffix.lower()
    if suffix == ".json":
        from mwdcal.certificate.document import encode

        return encode(certificate)
    if suffix == ".xml":
        from mwdcal.certificate.dcc import to_xml

        return to_xml(certificate)
    if suffix == ".pdf":
        from mwdcal.pages.records.certificate_pdf import render_pdf

        return render_pdf(certificate, pictures())
    from mwdcal.pages.records.certificate_page import render_page

    return render_page(certificate, pictures())
