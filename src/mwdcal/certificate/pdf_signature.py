"""PAdES signatures in the PDF of a certificate (ETSI EN 319 142-1, level B-B), by the key that signs its JSON.

Needs pyHanko, of the extra `certificate`. The X.509 certificate in the PDF is that of a certification authority, or one
that the key signs itself. Trust rests on the public key, as with every document.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from importlib import import_module
from typing import Any, NamedTuple

from mwdcal.certificate.signature import PrivateKey, TrustedKey, public_key
from mwdcal.errors import InputError

SIGNATURE_FIELD = "Signature"
"""The field of the PDF that holds the signature."""
ATTACHMENT = "certificate.json"
"""The name of the JSON that is attached to the PDF."""
YEARS = 10
"""Validity of a certificate that the key signs itself."""


class PdfParts(NamedTuple):
    """Contents of a PDF: the attached JSON, and the key of its signature, if that is sound."""

    attached: bytes
    key: TrustedKey | None
    intact: bool


def _pyhanko(module: str) -> Any:
    """A module of pyHanko, or what to install."""
    try:
        return import_module(f"pyhanko.{module}")
    except ImportError:
        raise InputError(
            "a signature in a PDF needs pyHanko, which is not installed. Install mwdcal[certificate]: "
            'pip install "mwdcal[certificate]"'
        ) from None


def pdf_signatures_available() -> bool:
    """Whether a PDF can be signed and checked here."""
    try:
        _pyhanko("sign.signers")
    except InputError:
        return False
    return True


def sign_pdf(pdf: bytes, key: PrivateKey, owner: str, certificate: bytes = b"") -> bytes:
    """A PDF with the signature of a key, which covers all of it.

    `owner` is named in the certificate that the key signs itself; `certificate`, PEM, is used instead, if there is one.

    Raises:
        InputError: pyHanko is not installed, or the certificate is of another key.
    """
    signers, writer = _pyhanko("sign.signers"), _pyhanko("pdf_utils.incremental_writer")
    fields = _pyhanko("sign.fields")
    x509, algorithms = import_module("asn1crypto.x509"), import_module("asn1crypto.algos")
    der = _certificate_of(key, certificate) if certificate else _self_signed(key, owner)

    class Ed25519Signer(signers.Signer):  # type: ignore[misc, name-defined]
        """The key in pyHanko's terms."""

        async def async_sign_raw(self, data: bytes, *_: Any, dry_run: bool = False) -> bytes:
            return bytes(64) if dry_run else key.sign(data)

    signer = Ed25519Signer(
        signing_cert=x509.Certificate.load(der),
        signature_mechanism=algorithms.SignedDigestAlgorithm({"algorithm": "ed25519"}),
    )
    stated = signers.PdfSignatureMetadata(
        field_name=SIGNATURE_FIELD,
        md_algorithm="sha512",
        subfilter=fields.SigSeedSubFilter.PADES,
        name=owner or None,
    )
    stream = io.BytesIO()
    signers.sign_pdf(
        writer.IncrementalPdfFileWriter(io.BytesIO(pdf)), stated, signer=signer, output=stream
    )
    return stream.getvalue()


def _certificate_of(key: PrivateKey, pem: bytes) -> bytes:
    """The certificate in a PEM file, DER; refused where it is not of this key."""
    x509 = import_module("cryptography.x509")
    try:
        loaded = x509.load_pem_x509_certificate(pem)
        raw = loaded.public_key().public_bytes_raw()
    except Exception as error:  # many kinds, by the version of cryptography
        raise InputError(
            "`x509` is not an X.509 certificate of an Ed25519 key in PEM form. Name another file."
        ) from error
    if public_key(raw).key != key.public.key:
        raise InputError(
            f"`x509` is of key {public_key(raw).key}, the private key is {key.public.key}. Name the certificate of "
            "this key."
        )
    forms = import_module("cryptography.hazmat.primitives.serialization")
    return bytes(loaded.public_bytes(forms.Encoding.DER))


def _self_signed(key: PrivateKey, owner: str) -> bytes:
    """A certificate of the key that the key signs itself, DER."""
    x509, forms = (
        import_module(f"cryptography.{name}")
        for name in ("x509", "hazmat.primitives.serialization")
    )
    name = x509.Name(
        [x509.NameAttribute(x509.NameOID.COMMON_NAME, (owner or f"key {key.public.key}")[:64])]
    )
    raw, now = base64.b64decode(key.public.public), datetime.now(UTC)
    usage = x509.KeyUsage(
        digital_signature=True, content_commitment=True, key_encipherment=False, data_encipherment=False,
        key_agreement=False, key_cert_sign=False, crl_sign=False, encipher_only=False, decipher_only=False,
    )  # fmt: skip
    built = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.secret.public_key())
        .serial_number(int.from_bytes(raw[:16], "big") | 1)
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=365 * YEARS))
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(usage, critical=True)
        .sign(key.secret, None)
    )
    return bytes(built.public_bytes(forms.Encoding.DER))


def read_pdf(data: bytes, name: str, trusted: Mapping[str, TrustedKey]) -> PdfParts:
    """The JSON that is attached to a PDF, and what its signature is worth.

    `key`: the trusted key that signed, else the public key that the PDF states; None where it is not signed.

    Raises:
        InputError: it is not a PDF with a certificate attached, or pyHanko is not installed.
    """
    reader, embed = _pyhanko("pdf_utils.reader"), _pyhanko("pdf_utils.misc")
    try:
        opened = reader.PdfFileReader(io.BytesIO(data))
        attached = _attached(opened)
        signatures = list(opened.embedded_signatures)
    except (embed.PdfError, KeyError, IndexError, ValueError, TypeError) as error:
        raise InputError(
            f"{name}: no certificate is attached to it, or it is damaged. Name the PDF as mwdcal wrote it."
        ) from error
    if not signatures:
        return PdfParts(attached, None, False)
    key, intact = _checked(signatures[-1], trusted)
    return PdfParts(attached, key, intact and len(signatures) == 1)


def _attached(opened: Any) -> bytes:
    """The content of the attachment."""
    names = opened.root["/Names"]["/EmbeddedFiles"]["/Names"]
    for place in range(0, len(names), 2):
        if str(names[place]) == ATTACHMENT:
            return bytes(names[place + 1]["/EF"]["/F"].data)
    raise KeyError(ATTACHMENT)


def _checked(signature: Any, trusted: Mapping[str, TrustedKey]) -> tuple[TrustedKey | None, bool]:
    """The key of a signature, and whether the signature is sound and covers the whole file."""
    validation, context = _pyhanko("sign.validation"), import_module("pyhanko_certvalidator")
    coverage = _pyhanko("sign.validation.status").SignatureCoverageLevel.ENTIRE_FILE
    certificate = signature.signer_cert
    raw = bytes(certificate.public_key["public_key"].native)
    if len(raw) != len(base64.b64decode(public_key(bytes(32)).public)):
        return None, False
    key = public_key(raw)
    try:
        status = validation.validate_pdf_signature(
            signature,
            context.ValidationContext(trust_roots=[certificate], allow_fetching=False),
            skip_diff=True,
        )
    except Exception:  # whatever a damaged signature makes the validation stumble over
        return trusted.get(key.key, key), False
    sound = status.intact and status.valid and status.coverage == coverage
    return trusted.get(key.key, key), bool(sound)
