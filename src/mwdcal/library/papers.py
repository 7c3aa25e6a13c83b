"""Certificates of calibrations from Python: issued, written in any form, signed, and checked."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, date, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mwdcal.calibration.record import Calibration, Finding, SignatureState
from mwdcal.digests import sha256_of
from mwdcal.errors import InputError
from mwdcal.files.formats.members import Member
from mwdcal.files.profiles import source_of_settings
from mwdcal.library.registries import ToolRegistry, day_of
from mwdcal.library.results import Result
from mwdcal.library.shown import digest_of
from mwdcal.use.verification import Verdict

if TYPE_CHECKING:
    from mwdcal.certificate.contents import CertificateRequest
    from mwdcal.certificate.document import Certificate, SourceFile
    from mwdcal.certificate.signature import PrivateKey
    from mwdcal.drift.document import ToolDrift
    from mwdcal.files.verifications import Verification
    from mwdcal.presentation.certificate import Picture
    from mwdcal.presentation.signature import CheckedDocument, SignedDocument

CERTIFICATE_FORMS = (".json", ".html", ".pdf", ".xml")
"""Suffixes of the forms of a certificate."""
Place = str | os.PathLike[str]
"""The path of a file."""


@dataclass(frozen=True, repr=False)
class PaperSigner:
    """Signing of a certificate as it is issued: the key, its X.509 certificate (PEM) for PDF, and the signed JSON."""

    key: PrivateKey
    x509: bytes
    signed: bytes


@dataclass(repr=False)
class Paper(Result):
    """A calibration certificate. `record` has all that it states; `save` writes it in any of its forms."""

    record: Certificate
    calibration: Calibration
    order: CertificateRequest
    drift: ToolDrift | None = None
    signer: PaperSigner | None = None
    saved: list[Path] = field(default_factory=list)

    @property
    def number(self) -> str:
        """The number of the certificate."""
        return self.record.number

    @property
    def serial(self) -> str | None:
        """The serial of the tool."""
        return self.record.serial

    @property
    def findings(self) -> Sequence[Finding]:
        """The findings: gaps, overdue standards, doubts of the calibration."""
        return self.record.findings

    @cached_property
    def pictures(self) -> list[Picture]:
        """The figures of page and PDF; Matplotlib must be installed."""
        from mwdcal.presentation.page import require

        require("a certificate as page or PDF", "matplotlib")
        from mwdcal.presentation.certificate import certificate_pictures

        tests = self.order.verification, self.order.as_found
        return certificate_pictures(self.calibration, *tests, self.drift)

    def form(self, path: Place) -> bytes | str:
        """The certificate in the form that the suffix of a file names.

        Raises:
            InputError: the suffix names no form.
        """
        check_form(path)
        suffix = Path(path).suffix.lower()
        if suffix == ".json":
            return self._json()
        if suffix == ".xml":
            from mwdcal.certificate.dcc import to_xml

            return to_xml(self.record)
        if suffix == ".pdf":
            return self._pdf()
        return self._page()

    def _json(self) -> bytes:
        """Its JSON, signed where it is issued with a key."""
        from mwdcal.certificate.document import encode

        return self.signer.signed if self.signer else encode(self.record)

    def _pdf(self) -> bytes:
        """Its PDF, with its JSON attached, both signed where it is issued with a key."""
        from mwdcal.presentation.certificate import render_pdf

        if self.signer is None:
            return render_pdf(self.record, self.pictures)
        from mwdcal.certificate.pdf_signature import sign_pdf

        laboratory = self.record.laboratory
        owner = laboratory.name if laboratory else ""
        pdf = render_pdf(self.record, self.pictures, self.signer.signed)
        return sign_pdf(pdf, self.signer.key, owner, self.signer.x509)

    def save(self, path: Place) -> None:
        """Write the certificate: JSON, a page, PDF, or PTB's DCC as XML, by the suffix.

        Raises:
            InputError: the suffix names no form, or the file cannot be written.
        """
        from mwdcal.files.formats import atomic

        atomic.write(path, self.form(path))
        self.saved.append(Path(path))

    def _text(self) -> str:
        from mwdcal.presentation.certificate import screen

        return screen(self.record, list(dict.fromkeys(self.saved)))

    def _document(self) -> dict[str, Any]:
        from msgspec import to_builtins

        document: dict[str, Any] = to_builtins(self.record)
        return document

    def _page(self) -> str:
        from mwdcal.presentation.certificate import render_page

        return render_page(self.record, self.pictures)


def check_form(path: Place) -> None:
    """Refuse a file whose suffix names no form of a certificate."""
    if Path(path).suffix.lower() not in CERTIFICATE_FORMS:
        allowed = ", ".join(CERTIFICATE_FORMS)
        raise InputError(
            f"`output` '{os.fspath(path)}': the suffix must be one of {allowed}. Rename it."
        )


def certificate(
    cal: Calibration | Place,
    *,
    verification: Verdict | Place | None = None,
    as_found: Verdict | Place | None = None,
    laboratory: Place | None = None,
    registry: ToolRegistry | Place | None = None,
    number: str = "",
    customer: str = "",
    condition: str = "",
    received: date | str | None = None,
    date: date | str | None = None,
    keys: Sequence[Place] = (),
    folder: Place = ".",
    private_key: Place | None = None,
    x509: Place | None = None,
    passphrase: str | Callable[[], str] | None = None,
) -> Paper:
    """The certificate of a calibration: ISO/IEC 17025 contents, uncertainty budget, decisions with their risk.

    `cal` is a calibration or its file. `verification` is a roll test with this calibration (as left), `as_found` one
    with the calibration before: a verdict, or the file in which the JSON of `mwdcal verify` was saved. `laboratory`:
    a TOML file with what the laboratory states. `registry`: with the earlier calibrations, whose drift is then shown.
    `received` and `date` (of issue; today, UTC) are days, such as "2026-01-31". `keys`: public keys whose signatures
    are trusted. `folder`: that of the certificate, from which its paths to other files are seen. `private_key` signs
    the JSON, and the PDF by PAdES with the certificate in the PEM file `x509`, or one that the key signs itself;
    `passphrase` as of `sign`.

    Raises:
        InputError: a file cannot be read, a roll test is of another tool or calibration, or a day is impossible.

    Example::

        paper = mwdcal.certificate(cal, verification=test, laboratory="lab.toml")
        mwdcal.save(paper, "C.pdf")
    """
    from mwdcal.certificate.contents import CertificateRequest
    from mwdcal.certificate.contents import certificate as contents
    from mwdcal.certificate.document import load_laboratory

    files = _Sources(Path(folder).resolve())
    calibration, digest, doubts = _loaded(cal, keys, files)
    as_left = _verification(verification, "verification", digest, files)
    before = _verification(as_found, "as-found", "", files)
    stated = None
    if laboratory is not None:
        stated, laboratory_digest = load_laboratory(Path(laboratory))
        files.add("laboratory", Path(laboratory), laboratory_digest)
    settings, settings_sha256 = source_of_settings()
    if settings:
        files.add("settings", Path(settings), settings_sha256)
    issued = day_of(date, "date") or datetime.now(UTC).date()
    drift = _drift(registry, calibration, digest, issued) if registry is not None else None
    order = CertificateRequest(
        issued=issued, number=number, customer=customer, condition=condition, received=day_of(received, "received"),
        verification=as_left, as_found=before, calibration_sha256=digest, files=tuple(files.listed),
        findings=(*doubts, *(drift.findings if drift else ())),
    )  # fmt: skip
    record, signer = _signed_record(
        contents(calibration, order, stated), private_key, x509, passphrase
    )
    return Paper(record, calibration, order, drift, signer)


def _signed_record(
    record: Certificate,
    private_key: Place | None,
    x509: Place | None,
    passphrase: str | Callable[[], str] | None,
) -> tuple[Certificate, PaperSigner | None]:
    """The contents of a certificate, where there is a key with their signature, and what signs its PDF."""
    if private_key is None:
        if x509 is not None:
            raise InputError("`x509` needs the key that it belongs to. Name it: `private_key`.")
        return record, None
    from msgspec import json

    from mwdcal.certificate.document import Certificate, encode
    from mwdcal.certificate.signature import read_file, read_private, signed

    key = read_private(Path(private_key), lambda: _passphrase(passphrase))
    pem = read_file(Path(x509)) if x509 is not None else b""
    data = encode(record)
    whole = signed(Member(data, "C.json", sha256_of(data)), key)
    return json.decode(whole, type=Certificate), PaperSigner(key, pem, whole)


@dataclass
class _Sources:
    """The files behind a certificate, by their paths from its folder."""

    folder: Path
    listed: list[SourceFile] = field(default_factory=list)

    def add(self, name: str, path: Path, digest: str) -> None:
        """List a file; its path is whole where it is on another drive."""
        from mwdcal.certificate.document import SourceFile

        whole = path.resolve()
        try:
            seen = Path(os.path.relpath(whole, self.folder)).as_posix()
        except ValueError:
            seen = whole.as_posix()
        self.listed.append(SourceFile(id=name, name=seen, sha256=digest))

    def add_memory(self, name: str, file: str, digest: str) -> None:
        """List what `save` would write under some name: its SHA-256 tells it."""
        from mwdcal.certificate.document import SourceFile

        self.listed.append(SourceFile(id=name, name=file, sha256=digest))


def _loaded(
    cal: Calibration | Place, keys: Sequence[Place], files: _Sources
) -> tuple[Calibration, str, list[Finding]]:
    """A calibration, the SHA-256 of its file, and doubts of its signature."""
    from mwdcal.presentation.signature import load_calibration

    loaded = load_calibration(cal, [Path(key) for key in keys])
    calibration, digest = loaded.calibration, loaded.digest
    if isinstance(cal, Calibration):
        digest = digest_of(cal)
        files.add_memory("calibration", f"{cal.serial or 'calibration'}.json", digest)
    else:
        files.add("calibration", Path(cal), digest)
    return calibration, digest, loaded.findings


def _verification(
    test: Verdict | Place | None, name: str, digest: str, files: _Sources
) -> Verification | None:
    """A roll test that a certificate shows; a verdict in memory is one of the calibration with this SHA-256."""
    from msgspec import convert

    from mwdcal.files.verifications import Verification, load_verification

    if test is None or isinstance(test, Verification):
        return test
    if not isinstance(test, Verdict):
        read, file_digest = load_verification(test)
        files.add(name, Path(test), file_digest)
        return read
    document = test.to_dict()
    unknown = document["calibration_sha256"] is None
    return convert(
        {**document, **({"calibration_sha256": digest} if unknown else {})}, Verification
    )


def _drift(
    registry: ToolRegistry | Place, calibration: Calibration, digest: str, today: date
) -> ToolDrift | None:
    """How the tool changed up to its calibration; None where the registry has no earlier one."""
    from mwdcal.library.drifts import drift_of
    from mwdcal.registry.store import open_registry

    if isinstance(registry, ToolRegistry):
        return drift_of(registry.opened, calibration, digest, today)
    with open_registry(registry) as opened:
        return drift_of(opened, calibration, digest, today)


@dataclass(repr=False)
class SignedPaper(Result):
    """A document that was signed: its `file`, by which `key` and at what `time` (UTC)."""

    content: SignedDocument
    fields: Mapping[str, Any]
    digest: str

    @property
    def file(self) -> str:
        """The file that was written."""
        return self.content.file

    @property
    def key(self) -> str:
        """The digits of the key."""
        return self.content.key

    @property
    def time(self) -> str:
        """When it was signed, UTC, ISO 8601."""
        return self.content.time

    @property
    def findings(self) -> Sequence[Finding]:
        """Files of a certificate that have changed since it was issued."""
        return self.content.findings

    def _text(self) -> str:
        from mwdcal.presentation.signature import signed

        return signed(self.content, self.fields)

    def _document(self) -> dict[str, Any]:
        from mwdcal.presentation.signature import for_machines

        return for_machines("sign", self.content, self.fields, self.digest)


def sign(
    document: Paper | Place,
    private_key: Place,
    *,
    output: Place | None = None,
    replace: bool = False,
    passphrase: str | Callable[[], str] | None = None,
) -> SignedPaper:
    """Sign a document: a certificate, or the file of a calibration, a verification or a certificate.

    `output` is the file to write. By default a file is replaced, and of a certificate in memory that was saved, its
    JSON: `C.json` beside `C.pdf`. `replace` the signature of a document that is signed already. `passphrase`: of an
    encrypted key; by default the value of the variable MWDCAL_KEY_PASSPHRASE.

    Raises:
        InputError: the document or the key cannot be read, or the document is signed already.
        FitError: the document was changed since it was made.

    Example: `mwdcal.sign("C.json", "laboratory.key")`
    """
    from mwdcal.certificate.signature import read_private, signed
    from mwdcal.files import documents
    from mwdcal.files.formats import atomic
    from mwdcal.presentation import signature as screens

    if isinstance(document, Paper):
        target = Path(output) if output is not None else _json_of(document)
        data = document.form("C.json")
        whole = data if isinstance(data, bytes) else data.encode()
        file = Member(whole, target.name, sha256_of(whole))
        if target in document.saved and target.exists():
            file = documents.whole_file(target)
        folder = target.parent
    else:
        target, folder = Path(output or document), Path(document).parent
        file = documents.whole_file(Path(document))
    atomic.target(target)
    private = read_private(Path(private_key), lambda: _passphrase(passphrase))
    signed_data = signed(file, private, replace)
    result, fields = screens.signed_document(signed_data, target, folder)
    atomic.write(target, signed_data)
    if isinstance(document, Paper):
        document.saved.append(target)
    return SignedPaper(result, fields, file.digest)


def _json_of(paper: Paper) -> Path:
    """The JSON file of a certificate that was saved, or its place beside another form."""
    saved = [path for path in paper.saved if path.suffix.lower() == ".json"] or paper.saved
    if not saved:
        raise InputError(
            "`output` is missing: the certificate was not saved yet. Name a file such as C.json, or save it first."
        )
    return saved[-1].with_suffix(".json")


def _passphrase(given: str | Callable[[], str] | None) -> str:
    """The passphrase of a private key."""
    from mwdcal.certificate.signature import PASSPHRASE

    if callable(given):
        return given()
    word = given if given is not None else os.environ.get(PASSPHRASE)
    if not word:
        raise InputError(
            f"the private key is encrypted. Give its `passphrase`, or set the variable {PASSPHRASE}."
        )
    return word


@dataclass(repr=False)
class SignatureVerdict(Result):
    """Whether a document is as it was signed. `content` has the check of the signature, and of each file."""

    content: CheckedDocument
    fields: Mapping[str, Any]
    digest: str

    @property
    def passed(self) -> bool:
        """Whether the signature is intact, and no file of a certificate has changed."""
        return self.content.passed

    @property
    def state(self) -> SignatureState:
        """The state of the signature, such as "intact", "altered", "unsigned", or "unknown": its key is not trusted."""
        state: SignatureState = self.content.check.state
        return state

    @property
    def findings(self) -> Sequence[Finding]:
        """Why it did not pass."""
        return self.content.findings

    def _text(self) -> str:
        from mwdcal.presentation.signature import checked

        return checked(self.content, self.fields)

    def _document(self) -> dict[str, Any]:
        from mwdcal.presentation.signature import for_machines

        return for_machines("verify", self.content, self.fields, self.digest)


def check_signature(
    document: Place, keys: Sequence[Place] | Place, *, files: Sequence[Place] = ()
) -> SignatureVerdict:
    """Whether a document is as it was signed, by public keys that are trusted; of a certificate also its files.

    `document`: a calibration file, the JSON of a verification or certificate, or its PDF. `keys`: public keys, or
    files of trusted keys. `files`: those that the certificate rests on, where they do not lie as it says.

    Raises:
        InputError: a file cannot be read, or no key is named.

    Example: `mwdcal.check_signature("C.json", keys=["laboratory.key.pub"]).state`
    """
    from mwdcal.certificate.signature import trusted
    from mwdcal.files import documents
    from mwdcal.presentation import signature as screens

    named = [Path(k) for k in ([keys] if isinstance(keys, str | os.PathLike) else keys)]
    if not named:
        raise InputError("`keys` must name a public key; got none. Name one that you trust.")
    trust, path = trusted(named), Path(document)
    file = documents.whole_file(path)
    if path.suffix.lower() == ".pdf":
        result, fields = screens.checked_pdf(file, path, trust, [Path(each) for each in files])
        return SignatureVerdict(result, fields, file.digest)
    result, fields = screens.checked_document(file, path, trust, [Path(each) for each in files])
    return SignatureVerdict(result, fields, file.digest)
