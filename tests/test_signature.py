"""Signatures: against RFC 8032, the library called directly, OpenSSL, and every kind of change to a file."""

import base64
import hashlib
import json
import os
import random
import re
import shlex
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from cli_support import EXAMPLE, ROOT, calibrated, mwdcal, process, refused, servo_run, write_csv
from mwdcal import extras
from mwdcal.certificate import signature
from mwdcal.certificate import signature as key_files
from mwdcal.errors import InputError
from mwdcal.files import documents
from mwdcal.files.formats.members import Member

ed25519 = pytest.importorskip("cryptography.hazmat.primitives.asymmetric.ed25519")
serialization = pytest.importorskip("cryptography.hazmat.primitives.serialization")
POSIX = pytest.mark.skipif(os.name != "posix", reason="permissions are those of POSIX")
CERTIFICATE = {
    "schema_version": 1,
    "command": "certificate",
    "serial": "T-7",
    "simulated": True,
    "number": "C-1",
    "values": [0.0, -0.0, 1.0, 1, 1e-5, 1e22, 123456789012, 0.1],
    "texts": ["Lübeck", "\u2028", "a\nb", "</script>", "\\u00fc"],
    "empty": [{}, [], None, False],
}


@pytest.fixture(scope="module")
def key(tmp_path_factory):
    """The path of a private key, whose public one lies beside it."""
    path = tmp_path_factory.mktemp("keys") / "lab.key"
    key_files.create(path, "LAB", "")
    return path


@pytest.fixture
def public(key):
    return key.with_name("lab.key.pub")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A calibration file and a roll test."""
    folder = tmp_path_factory.mktemp("files")
    roll = write_csv(folder / "roll.csv", servo_run(1, inclinations=(46, 91), toolfaces=6))
    return calibrated(folder, servo_run(1)), roll


def no_passphrase():
    raise AssertionError("a passphrase was asked for")


def signed(path, key, *options):
    ran = mwdcal("certificate", "sign", path, "--private-key", key, *options)
    assert ran.code == 0, ran
    return path


def certificate(folder, **fields):
    path = folder / "c.json"
    path.write_text(json.dumps({**CERTIFICATE, **fields}), encoding="utf-8")
    return path


def state(path, *arguments):
    """Exit status and state of the signature of a file."""
    ran = mwdcal("certificate", "verify", path, *arguments, "--json")
    return ran.code, ran.json["check"]["state"]


# ------------------------------------------------------------------- what is signed


def hand_built(fields):
    """What the documentation says is signed: built without mwdcal."""
    rest = {k: v for k, v in fields["signature"].items() if k != "value"}
    text = json.dumps({**fields, "signature": rest}, sort_keys=True, separators=(",", ":"))
    return text.encode("ascii")


@pytest.mark.usefixtures("without_pictures")
def test_the_signature_is_that_of_the_canonical_json(tmp_path, key, public):
    path = signed(certificate(tmp_path), key)
    fields = json.loads(path.read_bytes())
    assert {k: v for k, v in fields.items() if k != "signature"} == CERTIFICATE
    assert path.read_text() == json.dumps(fields, sort_keys=True, indent=2) + "\n"
    value = base64.b64decode(fields["signature"]["value"])
    loaded = serialization.load_pem_public_key(public.read_bytes())
    loaded.verify(value, hand_built(fields))
    raw = loaded.public_bytes_raw()
    assert fields["signature"]["key"] == hashlib.sha256(raw).hexdigest()[:16]
    assert fields["signature"]["algorithm"] == "Ed25519"


@pytest.mark.skipif(not shutil.which("openssl"), reason="no openssl here")
def test_openssl_agrees(tmp_path, key, public):
    """It reads both keys, and checks the signature over the message built by hand."""
    path = signed(certificate(tmp_path), key)
    fields = json.loads(path.read_bytes())
    message, value = tmp_path / "message", tmp_path / "value"
    message.write_bytes(hand_built(fields))
    value.write_bytes(base64.b64decode(fields["signature"]["value"]))

    def openssl(*arguments):
        return subprocess.run(["openssl", *map(str, arguments)], capture_output=True, check=False)

    check = ("pkeyutl", "-verify", "-pubin", "-inkey", public, "-rawin", "-sigfile", value)
    assert openssl(*check, "-in", message).returncode == 0
    message.write_bytes(hand_built({**fields, "number": "C-2"}))
    assert openssl(*check, "-in", message).returncode != 0
    derived = openssl("pkey", "-in", key, "-pubout").stdout
    assert derived.strip() in public.read_bytes()


def test_a_key_of_openssl_signs(tmp_path):
    if not shutil.which("openssl"):
        pytest.skip("no openssl here")
    path = tmp_path / "other.key"
    subprocess.run(["openssl", "genpkey", "-algorithm", "ed25519", "-out", path], check=True)
    path.chmod(0o600)
    public = tmp_path / "other.key.pub"
    subprocess.run(["openssl", "pkey", "-in", path, "-pubout", "-out", public], check=True)
    assert state(signed(certificate(tmp_path), path), "--key", public) == (0, "intact")


RFC_8032 = (
    (
        "9d61b19deffd5a60ba844af492ec2cc44449c5697b326919703bac031cae7f60",
        "d75a980182b10ab7d54bfed3c964073a0ee172f3daa62325af021a68f707511a",
        "",
        "e5564300c360ac729086e2cc806e828a84877f1eb8e5d974d873e065224901555fb8821590a33bacc61e39701cf9b46b"
        "d25bf5f0595bbe24655141438e7a100b",
    ),
    (
        "c5aa8df43f9f837bedb7442f31dcb7b166d38535076f094b85ce3a2e0b4458f7",
        "fc51cd8e6218a1a38da47ed00230f0580816ed13ba3303ac5deb911548908025",
        "af82",
        "6291d657deec24024827e69c3abe01a30ce548a284743a445e3680d7db5ac3ac18ff9b538d16f290ae67f760984dc659"
        "4a7c15e9716ed28dc027beceea1ec40a",
    ),
)
"""RFC 8032, 7.1, tests 1 and 3: secret key, public key, message, signature."""


@pytest.mark.parametrize(("secret", "public", "message", "value"), RFC_8032)
def test_vectors_of_rfc_8032(tmp_path, secret, public, message, value):
    path = tmp_path / "rfc.key"
    forms = (serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8)
    private = ed25519.Ed25519PrivateKey.from_private_bytes(bytes.fromhex(secret))
    path.write_bytes(private.private_bytes(*forms, serialization.NoEncryption()))
    path.chmod(0o600)
    loaded = key_files.read_private(path, no_passphrase)
    assert base64.b64decode(loaded.public.public).hex() == public
    assert loaded.sign(bytes.fromhex(message)).hex() == value
    assert loaded.public.verifies(bytes.fromhex(value), bytes.fromhex(message))
    assert not loaded.public.verifies(bytes.fromhex(value), bytes.fromhex(message) + b"\0")


# ----------------------------------------------------------------------- changes


def changed_bytes(data, draw, count):
    """Files with a byte changed, removed or added at random, each other than the file."""
    for _ in range(count):
        at, byte = draw.randrange(len(data)), bytes([draw.randrange(256)])
        kind = draw.randrange(3)
        other = data[:at] + (b"" if kind == 1 else byte) + data[at + (kind < 2) :]
        if other != data:
            yield other


@pytest.mark.parametrize("document", ["calibration", "verification", "certificate"])
def test_a_changed_byte_is_detected_in_1000_of_1000(tmp_path, files, key, document):
    """Changed, removed or added anywhere in the file: never intact."""
    path = tmp_path / "signed.json"
    if document == "verification":
        path.write_text(mwdcal("verify", *files, "--json").out, encoding="utf-8")
    elif document == "calibration":
        path.write_bytes(files[0].read_bytes())
    else:
        path = certificate(tmp_path)
    data = signed(path, key).read_bytes()
    trusted = signature.trusted([key.with_name("lab.key.pub")])
    assert signature.check(data, trusted).state == "intact"
    trials = list(changed_bytes(data, random.Random(8032), 1100))[:1000]
    states = [signature.check(other, trusted).state for other in trials]
    assert len(states) == 1000
    assert "intact" not in states
    assert {*states} <= {"altered", "unsigned", "unknown"}


def test_every_character_of_the_signature_counts(tmp_path, key, public):
    """Base64 has several spellings of the same bytes; only one is accepted."""
    data = signed(certificate(tmp_path), key).read_bytes()
    trusted = signature.trusted([public])
    value = json.loads(data)["signature"]["value"]
    for at, character in enumerate(value):
        for other in "ABQgw019+/=":
            if other != character:
                edited = data.replace(
                    value.encode(), (value[:at] + other + value[at + 1 :]).encode()
                )
                assert signature.check(edited, trusted).state == "altered"


ALIKE = {
    "a blank": lambda d: d.replace(b'"number": ', b'"number":  '),
    "no last line break": lambda d: d[:-1],
    "a line break more": lambda d: d + b"\n",
    "a zero byte behind": lambda d: d + b"\0",
    "line breaks of Windows": lambda d: d.replace(b"\n", b"\r\n"),
    "a byte order mark": lambda d: b"\xef\xbb\xbf" + d,
    "UTF-16": lambda d: d.decode().encode("utf-16"),
    "compact": lambda d: json.dumps(json.loads(d)).encode(),
    "-0.0 for 0.0": lambda d: d.replace(b" 0.0,", b" -0.0,", 1),
    "1 for 1.0": lambda d: d.replace(b" 1.0,", b" 1,"),
    "1.00 for 1.0": lambda d: d.replace(b" 1.0,", b" 1.00,"),
    "1e0 for 1.0": lambda d: d.replace(b" 1.0,", b" 1e0,"),
    "digits that no float has": lambda d: d.replace(b" 0.1\n", b" 0.10000000000000000001\n"),
    "an escape": lambda d: d.replace(b'"C-1"', b'"\\u0043-1"'),
    "an escape in capitals": lambda d: d.replace(b"\\u00fcbeck", b"\\u00FCbeck"),
    "the letter for its escape": lambda d: d.replace(b"\\u00fcbeck", "übeck".encode()),
    "an escaped slash": lambda d: d.replace(b"</script>", b"<\\/script>"),
    "a key twice": lambda d: d.replace(b'"number"', b'"number": "C-1",\n  "number"'),
    "a key twice, the first other": lambda d: d.replace(
        b'"number"', b'"number": "C-2",\n  "number"'
    ),
    "keys exchanged": lambda d: d.replace(
        b'  "schema_version": 1,\n  "serial": "T-7",', b'  "serial": "T-7",\n  "schema_version": 1,'
    ),
    "a field more": lambda d: d.replace(b'"number"', b'"a": 1,\n  "number"'),
    "another time": lambda d: d.replace(b'"time": "2', b'"time": "3'),
    "another algorithm": lambda d: d.replace(b"Ed25519", b"Ed448"),
    "a signature beyond ASCII": lambda d: d.replace(b'"value": "', '"value": "ü'.encode()),
    "a field in the signature": lambda d: d.replace(b'"algorithm"', b'"a": 1,\n    "algorithm"'),
    "NaN": lambda d: d.replace(b" 0.1\n", b" NaN\n"),
    "too large a number": lambda d: d.replace(b" 0.1\n", b" 1e999\n"),
    "half": lambda d: d[: -len(d) // 3],
    "deep": lambda d: b"[" * 100_000 + d,
}


@pytest.mark.parametrize("change", ALIKE.values(), ids=ALIKE)
def test_what_only_looks_the_same_is_altered(tmp_path, key, public, change):
    path = signed(certificate(tmp_path), key)
    data = path.read_bytes()
    assert change(data) != data
    path.write_bytes(change(data))
    assert state(path, "--key", public) == (1, "altered")
    ran = mwdcal("certificate", "verify", path, "--key", public)
    simulated = (
        "   SIMULATED DATA" if "SIMULATED" in ran.out else ""
    )  # unless it is no JSON any more
    first, after = ran.out.splitlines()
    assert (ran.code, first) == (1, f"FAIL   {path}{simulated}")
    assert after.startswith("next: mwdcal certificate verify ")
    assert ran.err.count("altered after it was signed") == 1


def test_a_signature_taken_off_or_moved_to_another_document_shows(tmp_path, key, public):
    path = signed(certificate(tmp_path), key)
    fields = json.loads(path.read_bytes())
    stolen = fields.pop("signature")
    path.write_text(json.dumps(fields))
    assert state(path, "--key", public) == (1, "unsigned")
    other = {**fields, "command": "verify", "signature": stolen}
    path.write_bytes(signature.signed_form(other))
    assert state(path, "--key", public) == (1, "altered")


# --------------------------------------------------------------- keys and their standing


def test_who_is_trusted(tmp_path, key, public):
    """By a public key, several, a list of keys, or the variable; not by another."""
    path = signed(certificate(tmp_path), key)
    other = tmp_path / "other.key"
    assert mwdcal("certificate", "key", "create", "-o", other).code == 0
    other_public, listed = tmp_path / "other.key.pub", tmp_path / "keys.json"
    assert mwdcal("certificate", "key", "trust", listed, public).code == 0
    for named in (["--key", public], ["--key", other_public, "--key", public], ["--key", listed]):
        assert state(path, *named) == (0, "intact")
    assert state(path, "--key", other_public) == (1, "unknown")
    assert state(path, "--key", public.with_name("lab.pub")) == (0, "intact")
    assert "MWDCAL_KEYS" in refused(mwdcal("certificate", "verify", path), 2)


def test_the_variable_names_several_files(tmp_path, key, public, monkeypatch):
    path, other = signed(certificate(tmp_path), key), tmp_path / "other.key"
    mwdcal("certificate", "key", "create", "-o", other)
    monkeypatch.setenv("MWDCAL_KEYS", os.pathsep.join((f"{other}.pub", str(public))))
    assert state(path) == (0, "intact")


def test_rotation_and_revocation(tmp_path, key, public):
    """What a retired key has signed before stays valid; a revoked one has never signed."""
    path, listed = signed(certificate(tmp_path), key), tmp_path / "keys.json"
    mwdcal("certificate", "key", "trust", listed, public)
    digits = json.loads(path.read_bytes())["signature"]["key"]

    def changed(*arguments):
        ran = mwdcal("certificate", "key", *arguments, "--json")
        assert ran.code == 0, ran
        assert json.loads(listed.read_bytes())["keys"] == ran.json["keys"]
        return state(path, "--key", listed)

    before = listed.read_bytes()
    assert changed("retire", listed, digits[:6], "--at", "2999-01-01") == (0, "intact")
    listed.write_bytes(before)
    assert changed("retire", listed, public, "--at", "2001-01-01T00:00:00Z") == (1, "retired")
    listed.write_bytes(before)
    assert changed("revoke", listed, digits, "--reason", "laptop stolen") == (1, "revoked")
    ran = mwdcal("certificate", "verify", path, "--key", listed)
    assert "laptop stolen" in ran.err
    assert state(path, "--key", listed, "--key", public) == (1, "revoked")
    assert state(path, "--key", public, "--key", listed) == (1, "revoked")
    assert "laptop stolen" in mwdcal("certificate", "key", "list", listed).out
    written = before.decode()
    for place, retired in enumerate(("2001-01-02T00:00:00+12:00", "2001-01-01T13:00:00+00:00")):
        other = written.replace('"retired": ""', f'"retired": "{retired}"')
        (tmp_path / f"{place}.json").write_text(other)
    both = signature.trusted([tmp_path / "1.json", tmp_path / "0.json"])
    assert (
        both[digits].retired == "2001-01-02T00:00:00+12:00"
    )  # the earlier: 12:00 UTC of the first
    assert "already" in refused(mwdcal("certificate", "key", "trust", listed, public), 2)


def test_a_key_is_named_by_enough_digits(tmp_path, public):
    listed = tmp_path / "keys.json"
    mwdcal("certificate", "key", "trust", listed, public)
    before = listed.read_bytes()
    for name in ("", "a", "zzzzzz", "0000000000000000"):
        refused(mwdcal("certificate", "key", "revoke", listed, name), 2)
    refused(mwdcal("certificate", "key", "retire", listed, public, "--at", "tomorrow"), 2)
    assert listed.read_bytes() == before


@POSIX
def test_a_private_key_is_its_owners_alone(tmp_path, key):
    path = tmp_path / "new.key"
    os.umask(previous := os.umask(0))
    try:
        os.umask(0)
        mwdcal("certificate", "key", "create", "-o", path)
    finally:
        os.umask(previous)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    for mode in (0o640, 0o604, 0o660):
        path.chmod(mode)
        message = refused(
            mwdcal("certificate", "sign", certificate(tmp_path), "--private-key", path), 2
        )
        assert "chmod 600" in message


@pytest.mark.parametrize("taken", ["new.key", "new.key.pub"])
def test_keys_are_never_overwritten(tmp_path, taken):
    path = tmp_path / "new.key"
    (tmp_path / taken).write_text("precious")
    message = refused(mwdcal("certificate", "key", "create", "-o", path), 2)
    assert "never overwritten" in message
    assert [p.name for p in tmp_path.iterdir()] == [taken]
    assert (tmp_path / taken).read_text() == "precious"


def test_a_passphrase(tmp_path, monkeypatch):
    path = tmp_path / "new.key"
    monkeypatch.setenv("MWDCAL_KEY_PASSPHRASE", "correct horse")
    assert mwdcal("certificate", "key", "create", "-o", path).code == 0
    assert b"ENCRYPTED" in path.read_bytes()
    signed(certificate(tmp_path), path)
    monkeypatch.setenv("MWDCAL_KEY_PASSPHRASE", "wrong")
    other = ("certificate", "sign", certificate(tmp_path), "--private-key", path)
    assert "passphrase is wrong" in refused(mwdcal(*other), 2)
    monkeypatch.delenv("MWDCAL_KEY_PASSPHRASE")
    monkeypatch.setattr(sys, "stdin", None)
    assert "MWDCAL_KEY_PASSPHRASE" in refused(mwdcal(*other), 2)
    nothing = ("certificate", "key", "create", "-o", tmp_path / "b.key", "--passphrase")
    refused(mwdcal(*nothing), 2)
    assert not (tmp_path / "b.key").exists()


def pem(private, kind="private"):
    forms = serialization
    if kind == "public":
        form = forms.PublicFormat.SubjectPublicKeyInfo
        return private.public_key().public_bytes(forms.Encoding.PEM, form)
    form = {"private": forms.PrivateFormat.PKCS8, "openssh": forms.PrivateFormat.OpenSSH}[kind]
    return private.private_bytes(forms.Encoding.PEM, form, forms.NoEncryption())


def other_keys():
    ec = pytest.importorskip("cryptography.hazmat.primitives.asymmetric.ec")
    rsa = pytest.importorskip("cryptography.hazmat.primitives.asymmetric.rsa")
    mine = ed25519.Ed25519PrivateKey.generate()
    curve, old = ec.generate_private_key(ec.SECP256R1()), rsa.generate_private_key(65537, 2048)
    return {
        "private": pem(mine), "public": pem(mine, "public"), "openssh": pem(mine, "openssh"),
        "EC": pem(curve), "EC public": pem(curve, "public"),
        "RSA": pem(old), "RSA public": pem(old, "public"),
        "half": pem(mine)[:60], "half public": pem(mine, "public")[:70] + b"\n-----END PUBLIC KEY-----\n",
        "two": pem(mine, "public") * 2, "empty": b"", "zeros": bytes(5000), "text": b"not a key",
        "huge": b"A" * 2_000_000, "list": b"{}", "list of nothing": b'{"keys": [1]}', "deep": b'{"keys":' * 99_999,
        "wrong digits": trusted_json(key="0" * 16), "short": trusted_json(public="AAAA"),
        "time": trusted_json(retired="soon"), "field": trusted_json(trusted="yes"),
    }  # fmt: skip


def trusted_json(**fields):
    raw = bytes(range(32))
    entry = {"key": hashlib.sha256(raw).hexdigest()[:16], "public": base64.b64encode(raw).decode()}
    head = {"schema_version": 1, "command": "certificate key"}
    return json.dumps({**head, "keys": [{**entry, **fields}]}).encode()


def test_what_is_not_the_key_is_refused_in_a_sentence(tmp_path, key):
    document = signed(certificate(tmp_path), key)
    data, path = document.read_bytes(), tmp_path / "rogue"
    for name, content in other_keys().items():
        path.write_bytes(content)
        path.chmod(0o600)
        if name != "private":
            refused(mwdcal("certificate", "sign", document, "--replace", "--private-key", path), 2)
        if name not in ("public", "list"):
            message = refused(mwdcal("certificate", "verify", document, "--key", path), 2)
            assert ("private" in message) == (name in ("private", "openssh", "EC", "RSA")), name
            refused(mwdcal("certificate", "key", "trust", tmp_path / "k.json", path), 2)
    for place in (tmp_path, tmp_path / "missing", tmp_path / "missing.pub", "/dev/zero"):
        refused(mwdcal("certificate", "sign", document, "--replace", "--private-key", place), 2)
        refused(mwdcal("certificate", "verify", document, "--key", place), 2)
    assert document.read_bytes() == data
    assert not (tmp_path / "k.json").exists()


def test_an_owner_controls_no_terminal(tmp_path, key):
    path = tmp_path / "new.key"
    refused(mwdcal("certificate", "key", "create", "-o", path, "--owner", "a\x1b[2J"), 2)
    public = tmp_path / "evil.pub"
    public.write_bytes(b"Owner: a\x1b[2J\x9b\n" + key.with_name("lab.key.pub").read_bytes())
    document = signed(certificate(tmp_path), key)
    for arguments in (("verify", document, "--key", public), ("key", "list", public)):
        ran = mwdcal("certificate", *arguments)
        assert "\x1b" not in ran.out + ran.err
        assert "a\\x1b[2J" in ran.out
        assert "\x1b" not in mwdcal("certificate", *arguments, "--json").out


# ------------------------------------------------------------------------- signing


def test_signing_again_is_meant_or_refused(tmp_path, key, public):
    path = signed(certificate(tmp_path), key)
    data = path.read_bytes()
    again = ("certificate", "sign", path, "--private-key", key)
    assert "is signed already, by key" in refused(mwdcal(*again), 2)
    assert path.read_bytes() == data
    signed(path, key, "--replace")
    assert state(path, "--key", public) == (0, "intact")
    path.write_bytes(data.replace(b'"C-1"', b'"C-2"'))
    assert "was altered" in refused(mwdcal(*again, "--replace"), 3)


def test_signing_into_another_file_leaves_the_first(tmp_path, key, public):
    path, output = certificate(tmp_path), tmp_path / "signed.json"
    data = path.read_bytes()
    signed(path, key, "-o", output)
    assert path.read_bytes() == data
    assert state(output, "--key", public) == (0, "intact")
    for lost in (key, path):
        refused(mwdcal("certificate", "sign", path, "--private-key", key, "-o", lost), 2)


def test_a_calibration_that_was_changed_is_not_signed(tmp_path, files, key):
    fields = json.loads(files[0].read_bytes())
    fields["accelerometer"]["parameters"][9] += 1e-9
    path = tmp_path / "edited.json"
    path.write_text(json.dumps(fields))
    assert "altered" in refused(mwdcal("certificate", "sign", path, "--private-key", key), 3)


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[]",
        "{}",
        '{"a": NaN}',
        "1",
        '{"command": "x"}',
        "[" * 99_999,
        '{"schema_version": 1, "command": "certificate", "value": 1e999}',
        '{"schema_version": 1, "command": "certificate", "item": {"serial": "A", "serial": "B"}}',
    ],
)
def test_what_is_no_document_is_not_signed_or_verified(tmp_path, key, public, content):
    path = tmp_path / "other.json"
    path.write_text(content)
    refused(mwdcal("certificate", "sign", path, "--private-key", key), 2)
    refused(mwdcal("certificate", "verify", path, "--key", public), 2)
    for place in (tmp_path, tmp_path / "missing"):
        refused(mwdcal("certificate", "sign", place, "--private-key", key), 2)
        refused(mwdcal("certificate", "verify", place, "--key", public), 2)


# ------------------------------------------------------------ the files of a certificate


def listed(path, name=""):
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return {"id": "calibration", "name": name or path.name, "sha256": digest}


def test_the_files_of_a_certificate_are_checked(tmp_path, files, key, public):
    calibration = tmp_path / "cal.json"
    shutil.copy(files[0], calibration)
    path = signed(certificate(tmp_path, files=[listed(calibration)]), key)
    verify = ("certificate", "verify", path, "--key", public)

    def states(*named):
        ran = mwdcal(*verify, *named, "--json")
        return ran.code, [file["state"] for file in ran.json["files"]]

    assert states() == states(calibration) == (0, ["unchanged"])
    draw = random.Random(1)
    data = calibration.read_bytes()
    for other in list(changed_bytes(data, draw, 30)):
        calibration.write_bytes(other)
        assert states() == (1, ["changed"])
    assert "CHANGED" in mwdcal(*verify).out
    assert "! changed since the certificate was issued: cal.json." in mwdcal(*verify).err
    moved = tmp_path / "elsewhere" / "renamed.json"
    moved.parent.mkdir()
    moved.write_bytes(data)
    assert states(moved) == (0, ["unchanged"])
    calibration.unlink()
    assert states() == (0, ["missing"])
    assert "not checked" in mwdcal(*verify).out
    other = tmp_path / "other.txt"
    other.write_text("another")
    assert "not among the files" in refused(mwdcal(*verify, other), 2)


def test_a_changed_file_is_named_beside_a_copy_of_the_original(tmp_path, files, key, public):
    """Every file that is named must be as it was; files of one name in two folders are told apart by content."""
    folders = [tmp_path / name for name in ("left", "found", "changed")]
    for folder, extra in zip(folders, (b"", b"\n", b" "), strict=True):
        folder.mkdir()
        (folder / "cal.json").write_bytes(files[0].read_bytes() + extra)
    left, found, changed = (folder / "cal.json" for folder in folders)
    copy = Path(shutil.copy(left, tmp_path / "copy.json"))
    rows = [listed(left, "left/cal.json"), listed(found, "found/cal.json")]
    path = signed(certificate(tmp_path, files=rows), key)

    def states(*named):
        ran = mwdcal("certificate", "verify", path, *named, "--key", public, "--json")
        return ran.code, [file["state"] for file in ran.json["files"]]

    assert states() == states(found, left) == states(copy, found) == (0, ["unchanged"] * 2)
    assert states(changed, copy, found) == (1, ["changed"] * 2)
    one = signed(certificate(tmp_path, files=rows[:1]), key)
    ran = mwdcal("certificate", "verify", one, changed, copy, "--key", public, "--json")
    assert (ran.code, ran.json["files"][0]["path"]) == (1, str(changed))


def test_a_folder_in_place_of_a_file_is_a_change(tmp_path, files, key, public):
    calibration = Path(shutil.copy(files[0], tmp_path / "cal.json"))
    path = signed(certificate(tmp_path, files=[listed(calibration)]), key)
    calibration.unlink()
    calibration.mkdir()
    ran = mwdcal("certificate", "verify", path, "--key", public, "--json")
    assert (ran.code, ran.json["files"][0]["state"]) == (1, "changed")


def test_files_lie_where_the_certificate_says_or_beside_it(tmp_path, files, key, public):
    for place in ("calibrations/cal.json", "calibrations\\cal.json"):
        shutil.rmtree(tmp_path / "calibrations", ignore_errors=True)
        (tmp_path / "calibrations").mkdir()
        there = shutil.copy(files[0], tmp_path / "calibrations" / "cal.json")
        path = signed(certificate(tmp_path, files=[listed(there, place)]), key)
        verify = ("certificate", "verify", path, "--key", public, "--json")
        assert mwdcal(*verify).json["files"][0]["state"] == "unchanged"
        there.rename(tmp_path / "cal.json")
        assert mwdcal(*verify).json["files"][0]["state"] == "unchanged"
        (tmp_path / "cal.json").unlink()


@pytest.mark.parametrize(
    ("time", "said"),
    [
        ("2000-01-01T00:00:00+00:00", "before the key was created"),
        ("2999-01-01T00:00:00+00:00", "in the future"),
        ("0001-01-01T00:00:00+00:00", "before the key was created"),
        ("9999-12-31T23:59:59+00:00", "in the future"),
        ("", "cannot be read"),
        (None, ""),
    ],
)
def test_a_date_that_cannot_be_is_said(tmp_path, key, public, monkeypatch, time, said):
    """The date is the signer's claim: the signature is intact nevertheless."""
    if time is not None:
        monkeypatch.setattr(signature, "now", lambda: time)
    path = signed(certificate(tmp_path), key)
    monkeypatch.undo()
    ran = mwdcal("certificate", "verify", path, "--key", public, "--json")
    assert (ran.code, ran.json["check"]["state"]) == (0, "intact")
    after = (
        ran.json["check"]["text"]
        .partition(" signed it on ")[2]
        .removeprefix(f"{ran.json['check']['time']}.")
    )
    assert (said in after) if said else (after == "")


@pytest.mark.parametrize("named", [False, True])
def test_the_table_of_a_fleet_is_looked_up_by_its_file(tmp_path, files, key, public, named):
    """A certificate of one tool of a table lists the SHA-256 of the table."""
    table = shutil.copy(files[0], tmp_path / "cals.parquet")
    path = signed(certificate(tmp_path, files=[listed(table, "cals.parquet#T-1#b")]), key)
    verify = ("certificate", "verify", path, *[table] * named, "--key", public, "--json")
    assert mwdcal(*verify).json["files"][0]["state"] == "unchanged"
    table.write_bytes(b"other")
    ran = mwdcal(*verify)
    assert (ran.code, ran.json["files"][0]["state"]) == (1, "changed")


@pytest.mark.parametrize("slash", ["/", "\\"])
def test_no_other_machine_is_asked_for_a_file(tmp_path, files, key, public, slash):
    """Windows logs in at the machine that a name with two slashes begins with; elsewhere one is as good as two."""
    (tmp_path / "other").mkdir()
    there = shutil.copy(files[0], tmp_path / "other" / "elsewhere.json")
    name = f"/{there}".replace("/", slash)
    path = signed(certificate(tmp_path, files=[listed(there, name)]), key)
    verify = ("certificate", "verify", path, "--key", public, "--json")
    assert mwdcal(*verify).json["files"][0]["state"] == "missing"
    assert mwdcal(*verify[:3], there, *verify[3:]).json["files"][0]["state"] == "unchanged"


def test_an_altered_certificate_makes_nobody_look_for_files(tmp_path, files, key, public):
    path = signed(certificate(tmp_path, files=[listed(files[0], str(files[0]))]), key)
    path.write_bytes(path.read_bytes().replace(b'"C-1"', b'"C-2"'))
    assert mwdcal("certificate", "verify", path, "--key", public, "--json").json["files"] == []


# ------------------------------------------------------------------ use of a calibration


def used(calibration, roll, folder):
    """The commands that say what the signature of a calibration is, of the first surveys of a well."""
    well = folder / "well.csv"
    rows = (EXAMPLE / "well.csv").read_text("utf-8").splitlines(keepends=True)
    well.write_text("".join(rows[:14]), "utf-8")
    return {
        "apply": ("apply", calibration, roll, "-o", folder / "out.csv"),
        "verify": ("verify", calibration, roll),
        "survey": ("survey", calibration, well, "-o", folder / "out.csv"),
    }


SAID = {
    "unsigned": ("", None),
    "intact": ("signature intact, key", None),
    "unknown": ("signed by unknown key", "signature-unknown"),
    "altered": ("signature ALTERED", "changed"),
    "altered by hand": ("signature ALTERED", "changed"),
}


@pytest.mark.parametrize("expected", SAID)
@pytest.mark.parametrize("command", ["apply", "verify", "survey"])
def test_what_is_said_of_the_calibration(tmp_path, files, key, public, command, expected):
    path = tmp_path / "cal.json"
    shutil.copy(files[0], path)
    named = [] if expected in ("unsigned", "unknown") else ["--key", public]
    if expected != "unsigned":
        signed(path, key)
    if expected.startswith("altered"):  # with the hash of the new contents, and without
        fields = json.loads(path.read_bytes())
        fields["accelerometer"]["parameters"][9] += 1e-9
        if expected == "altered":
            fields["sha256"] = documents.document_sha256(fields)
        path.write_bytes(signature.signed_form(fields))
    arguments = used(path, files[1], tmp_path)[command]
    short, finding = SAID[expected]
    shown, told = mwdcal(*arguments, *named), mwdcal(*arguments, *named, "--json").json
    head = shown.out.partition("\n")[0]
    assert short in head
    assert ("sign" in head) == bool(short)
    assert told["calibration_signature"]["state"] == expected.split()[0]
    ids = [each["id"] for each in told["findings"]]
    assert [i for i in ids if i == "changed" or i.startswith("signature")] == [finding] * bool(
        finding
    )
    assert len(re.findall("^! the calibration (?:is|was) ", shown.err, re.M)) == bool(finding)


def test_an_unsigned_calibration_is_a_finding_where_keys_are_named(tmp_path, files, public):
    ran = mwdcal("verify", *files, "--key", public)
    assert ran.err.count("! the calibration is unsigned") == 1


def test_a_signed_calibration_is_the_same_to_all_else(tmp_path, files, key, public):
    """Read, saved again, as a prior; whoever makes another record of it has none of its signature."""
    path = tmp_path / "cal.json"
    shutil.copy(files[0], path)
    before = documents.read(path)
    signed(path, key)
    calibration = documents.read(path)
    assert not calibration.changed
    assert calibration.sha256 == before.sha256
    documents.write(tmp_path / "again.json", calibration)
    assert (tmp_path / "again.json").read_bytes() == path.read_bytes()
    assert state(tmp_path / "again.json", "--key", public) == (0, "intact")
    from mwdcal.calibration.record import with_checksum

    assert with_checksum(calibration) == before
    jsonschema = pytest.importorskip("jsonschema")
    record = json.loads(path.read_bytes())
    jsonschema.Draft202012Validator(documents.published_schema()).validate(record)


def test_without_cryptography_it_says_what_to_install(tmp_path, files, key, public, monkeypatch):
    path = tmp_path / "cal.json"
    shutil.copy(files[0], path)
    signed(path, key)
    monkeypatch.setitem(sys.modules, "cryptography.hazmat.primitives.asymmetric.ed25519", None)
    ran = mwdcal("verify", path, files[1], "--key", public)
    assert "signature not checked" in ran.out
    assert extras.command("certificate") in ran.err
    message = refused(mwdcal("certificate", "sign", path, "--private-key", key), 2)
    assert extras.command("certificate") in message
    refused(mwdcal("certificate", "key", "create", "-o", tmp_path / "n.key"), 2)
    ran = mwdcal("certificate", "verify", path, "--key", public)
    assert ran.code == 1
    assert "not checked" in ran.err


def test_cryptography_is_loaded_only_for_a_signature(tmp_path, files):
    script = (
        "import sys\nfrom mwdcal.app.cli import main\n"
        "try:\n    main(sys.argv[1:])\nexcept SystemExit:\n    pass\n"
        "print('cryptography' in sys.modules, 'matplotlib' in sys.modules, file=sys.stderr)\n"
    )
    command = [sys.executable, "-c", script]
    for arguments in (("certificate", "--help"), ("verify", *map(str, files))):
        done = subprocess.run(
            [*command, *arguments], capture_output=True, encoding="utf-8", check=True
        )
        assert done.stderr.splitlines()[-1] == "False False"


@pytest.mark.parametrize("created", ["0001-01-01T00:00:00+00:00", "9999-12-31T23:59:59-12:00"])
def test_a_key_of_any_year_is_read(tmp_path, key, public, created):
    other = tmp_path / "other.pub"
    text = public.read_text("utf-8")
    line = next(line for line in text.splitlines() if line.startswith("Created:"))
    other.write_text(text.replace(line, f"Created: {created}"), "utf-8")
    assert state(signed(certificate(tmp_path), key), "--key", other) == (0, "intact")


@pytest.mark.parametrize("listed_files", [[None], [1], "x", {"a": 1}])
@pytest.mark.parametrize("output", [True, False])
def test_what_cannot_be_listed_is_refused_before_anything_is_written(
    tmp_path, key, listed_files, output
):
    path = certificate(tmp_path, files=listed_files)
    data, out = path.read_bytes(), tmp_path / "signed.json"
    options = ("-o", out) if output else ()
    refused(mwdcal("certificate", "sign", path, "--private-key", key, *options), 2)
    assert path.read_bytes() == data
    assert not out.exists()


def test_an_interrupted_or_refused_signature_leaves_the_file(tmp_path, key, monkeypatch):
    path = certificate(tmp_path)
    data = path.read_bytes()
    path.chmod(0o444)
    refused(mwdcal("certificate", "sign", path, "--private-key", key), 2)
    assert path.read_bytes() == data


def test_signed_files_are_in_memory_what_they_are_on_disk(key):
    """`check` takes bytes: no file is read twice between what is used and what was checked."""
    private = key_files.read_private(key, no_passphrase)
    data = signature.signed(Member(json.dumps(CERTIFICATE).encode(), "c.json", ""), private)
    trusted = {private.public.key: private.public}
    assert signature.check(data, trusted).state == "intact"
    with pytest.raises(InputError):
        signature.signed(Member(data, "c.json", ""), private)


def test_the_command_in_a_process_of_its_own(tmp_path, key, public):
    path = signed(certificate(tmp_path), key)
    assert process("certificate", "verify", path, "--key", public).returncode == 0


# --------------------------------------------------------------------------- the page


@pytest.fixture
def chain(tmp_path, files, key):
    """Calibration, verification and certificate, each signed before the next is made."""
    calibration, verification = tmp_path / "tool.json", tmp_path / "verification.json"
    shutil.copy(files[0], calibration)
    signed(calibration, key)
    verification.write_text(mwdcal("verify", calibration, files[1], "--json").out, encoding="utf-8")
    signed(verification, key)
    path = tmp_path / "certificate.json"
    ran = mwdcal("certificate", calibration, "--verification", verification, "-o", path)
    assert ran.code == 0, ran
    return signed(path, key)


def test_a_certificate_and_all_that_it_rests_on(chain, key, public):
    verify = ("certificate", "verify", chain, "--key", public, "--json")
    listed = {file["name"]: file["state"] for file in mwdcal(*verify).json["files"]}
    assert {"tool.json", "verification.json"} <= {*listed}
    assert {*listed.values()} <= {"unchanged", "missing"}
    for name in ("tool.json", "verification.json", "certificate.json"):
        path = chain.with_name(name)
        assert state(path, "--key", public) == (0, "intact")
        data = path.read_bytes()
        for other in changed_bytes(data, random.Random(name), 8):
            path.write_bytes(other)
            assert mwdcal("certificate", "verify", chain, "--key", public).code == 1
        path.write_bytes(data)


def test_a_calibration_that_is_signed_too_late_is_named(tmp_path, files, key):
    calibration, path = tmp_path / "tool.json", tmp_path / "certificate.json"
    shutil.copy(files[0], calibration)
    assert mwdcal("certificate", calibration, "-o", path).code == 0
    signed(calibration, key)
    ran = mwdcal("certificate", "sign", path, "--private-key", key)
    assert "! changed since the certificate was issued: tool.json." in ran.err


def test_the_recipe_of_the_page_checks_a_certificate(chain, public, monkeypatch):
    """Python code that does without mwdcal, as the page prints it."""
    page = (ROOT / "docs" / "howto" / "signature.md").read_text("utf-8")
    (recipe,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    monkeypatch.chdir(chain.parent)
    shutil.copy(public, "laboratory.key.pub")
    exec(recipe, {})
    chain.write_bytes(chain.read_bytes().replace(b'"simulated": ', b'"simulated":  '))
    with pytest.raises(AssertionError):
        exec(recipe, {})


def test_the_commands_of_the_page_run(tmp_path, files, monkeypatch):
    """Those that make, list, rotate and revoke keys, in their order."""
    page = (ROOT / "docs" / "howto" / "signature.md").read_text("utf-8")
    monkeypatch.chdir(tmp_path)
    shutil.copy(files[0], "tool.json")
    verdict = mwdcal("verify", "tool.json", files[1], "--json").out
    Path("verification.json").write_text(verdict, encoding="utf-8")
    issue = ("tool.json", "--verification", "verification.json", "-o", "certificate.json")
    assert mwdcal("certificate", *issue).code == 0
    blocks = re.findall(r"```\n((?:mwdcal .*\n)+)```", page)
    lines = [shlex.split(line)[1:] for line in "".join(blocks).splitlines()]
    assert len(lines) >= 10
    for words in lines:
        ran = mwdcal(*words)
        assert ran.code == 0, (words, ran)
