"""PAdES: the signature in the PDF of a certificate, against the bytes themselves, and every kind of change."""

import hashlib
import io
import re

import pytest

pytest.importorskip("pyhanko", reason="pyHanko is not installed: no PDF was signed")
pytest.importorskip("typst", reason="typst is not installed: no PDF was made")

from asn1crypto import cms
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from cli_support import EXAMPLE, mwdcal, refused
from mwdcal.certificate.pdf_signature import ATTACHMENT

pypdf = pytest.importorskip("pypdf", reason="pypdf is not installed")
pytestmark = pytest.mark.usefixtures("without_pictures")  # but for those of the signed certificate


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A certificate that was signed as it was issued."""
    folder = tmp_path_factory.mktemp("signed")
    for name in ("lab", "other"):
        made = mwdcal("certificate", "key", "create", "-o", folder / f"{name}.key", "--owner", name)
        assert made.code == 0, made
    run = (
        "calibrate",
        EXAMPLE / "run.csv",
        "--tool",
        EXAMPLE / "tool.toml",
        "-o",
        folder / "tool.json",
    )
    assert mwdcal(*run).code == 0
    issued = mwdcal(
        *("certificate", folder / "tool.json", "--laboratory", EXAMPLE / "laboratory.toml"),
        *("--private-key", folder / "lab.key", "-o", folder / "C.pdf", "-o", folder / "C.json"),
    )
    assert issued.code == 0, issued
    return folder


def verified(folder, file, key="lab"):
    return mwdcal("certificate", "verify", file, "--key", folder / f"{key}.key.pub", "--json")


def test_the_signature_covers_the_file_and_is_that_of_the_key(folder):
    """By the definitions: ISO 32000-2, 12.8.1 (byte range), RFC 5652 (signed attributes), RFC 8032."""
    data = (folder / "C.pdf").read_bytes()
    numbers = re.search(rb"/ByteRange *\[([\d ]+)\]", data)[1].split()
    start, length, again, rest = map(int, numbers)
    assert (start, again + rest) == (0, len(data))
    contents = bytes.fromhex(data[length + 1 : again - 1].decode())
    signed = cms.ContentInfo.load(contents)["content"]
    (signer,) = signed["signer_infos"]
    covered = data[:length] + data[again:]
    attributes = {each["type"].native: each["values"][0].native for each in signer["signed_attrs"]}
    assert attributes["message_digest"] == hashlib.sha512(covered).digest()
    assert "signing_certificate_v2" in attributes  # what makes it PAdES
    assert b"/ETSI.CAdES.detached" in data
    key = (folder / "lab.key.pub").read_text().split("-----")[2]
    raw = __import__("base64").b64decode(key)[-32:]
    message = signer["signed_attrs"].untag().dump()
    Ed25519PublicKey.from_public_bytes(raw).verify(signer["signature"].native, message)


def test_the_attached_json_is_the_signed_one(folder):
    attached = pypdf.PdfReader(folder / "C.pdf").attachments
    assert attached[ATTACHMENT] == [(folder / "C.json").read_bytes()]
    assert verified(folder, folder / "C.json").code == 0


def test_an_intact_certificate_passes(folder):
    checked = verified(folder, folder / "C.pdf")
    assert checked.code == 0, checked
    assert checked.json["check"]["state"] == "intact"
    assert {file["state"] for file in checked.json["files"]} == {"unchanged"}


def test_a_key_that_is_not_trusted_fails(folder):
    checked = verified(folder, folder / "C.pdf", "other")
    assert (checked.code, checked.json["check"]["state"]) == (1, "unknown")


def changes(data):
    """Damaged copies: a byte changed early and late, something appended, a page of another update."""
    for place in (3000, len(data) // 3):
        other = bytearray(data)
        other[place] ^= 1
        yield bytes(other)
    yield data + b"\n% more\n"
    writer = pypdf.PdfWriter(io.BytesIO(data), incremental=True)
    writer.add_metadata({"/Title": "another certificate"})
    stream = io.BytesIO()
    writer.write(stream)
    yield stream.getvalue()


@pytest.mark.parametrize("kind", range(4))
def test_an_altered_certificate_fails(folder, tmp_path, kind):
    altered = tmp_path / "C.pdf"
    altered.write_bytes([*changes((folder / "C.pdf").read_bytes())][kind])
    checked = verified(folder, altered)
    assert checked.code in (1, 2), checked
    if checked.code == 1:
        assert checked.json["check"]["state"] == "altered"
        assert checked.json["passed"] is False


def test_an_unsigned_certificate_fails(folder, tmp_path):
    assert mwdcal("certificate", folder / "tool.json", "-o", tmp_path / "U.pdf").code == 0
    checked = verified(folder, tmp_path / "U.pdf")
    assert (checked.code, checked.json["check"]["state"]) == (1, "unsigned")


def test_a_certificate_of_another_key_is_refused(folder, tmp_path):
    wrong = (
        "certificate",
        folder / "tool.json",
        "-o",
        tmp_path / "X.pdf",
        "--x509",
        folder / "lab.key.pub",
    )
    assert "--private-key" in refused(mwdcal(*wrong), 2)
    assert "--x509" in refused(mwdcal(*wrong, "--private-key", folder / "lab.key"), 2)


def test_another_pdf_is_refused(folder, tmp_path):
    writer = pypdf.PdfWriter()
    writer.add_blank_page(100, 100)
    writer.write(tmp_path / "blank.pdf")
    assert "no certificate is attached" in refused(verified(folder, tmp_path / "blank.pdf"), 2)
    (tmp_path / "text.pdf").write_text("no PDF")
    assert "no certificate is attached" in refused(verified(folder, tmp_path / "text.pdf"), 2)
