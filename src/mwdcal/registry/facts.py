"""The facts of a document, read from its bytes alone: one function for each kind."""

from __future__ import annotations

import base64
import json
import math
import re
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import Any

import msgspec

from mwdcal.calibration.readings import is_simulated, stated_day
from mwdcal.digests import sha256_of
from mwdcal.errors import InputError
from mwdcal.files import metadata

FACTS_VERSION = 2
"""Version of the functions below: higher when one of them reads the same bytes otherwise."""
LONGEST_NAME = 200
"""Characters of the longest serial, name or number that a registry takes."""
_OWNER = re.compile(rb"^Owner: ([^\r\n]*)", re.MULTILINE)
_PEM_KEY = re.compile(rb"-----BEGIN PUBLIC KEY-----\s(.*?)-----END PUBLIC KEY-----", re.DOTALL)
_RAW_KEY = 32
"""Bytes of a public key of Ed25519, the last ones of its SubjectPublicKeyInfo."""
_METADATA_LINES = 200
"""Lines of a text table in which metadata are looked for."""


class Facts(msgspec.Struct, frozen=True, kw_only=True):
    """The indexed facts of a document; None where it does not state them.

    `type`: of the tool, or the quantity of a standard. `label`: what people call it, such as a
    certificate's number. `time`: of the measurement, or of issue, ISO 8601 in UTC. `run`,
    `calibration`, `previous`: SHA-256 of the run and the calibration that it rests on, and of the
    calibration that was its prior. Angles: 1σ accuracy to expect, degrees. `next_due`: a date.
    `status`: `passed` or `failed`. `simulated`: 1 where it rests on simulated data.
    """

    serial: str | None = None
    type: str | None = None
    label: str | None = None
    time: str | None = None
    run: str | None = None
    calibration: str | None = None
    previous: str | None = None
    next_due: str | None = None
    status: str | None = None
    inclination_deg: float | None = None
    toolface_deg: float | None = None
    azimuth_deg: float | None = None
    simulated: int = 0


def facts(kind: str, data: bytes, name: str) -> Facts:
    """The facts of a document of a kind, from its bytes; `name` is the file's, for its format and for messages.

    Raises:
        InputError: the kind is unknown, or the bytes are not such a document.
    """
    if kind not in RECORD_KINDS:
        raise InputError(
            f"{name}: `kind` must be one of {', '.join(RECORD_KINDS)}; got {kind!r}. Correct it."
        )
    try:
        return RECORD_KINDS[kind](data, name)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise InputError(
            f"{name}: it cannot be read as a {kind} ({error}). Check the file, or its kind."
        ) from None


def _document(data: bytes) -> dict[str, Any]:
    fields = json.loads(data)
    if not isinstance(fields, dict):
        raise ValueError("it is not a JSON object")
    return fields


def _text(value: object) -> str | None:
    """A text for an index: without NUL and half characters, which databases refuse; None where empty."""
    if value is None or value == "":
        return None
    if not isinstance(value, str | int | float):
        raise ValueError(f"expected a text; got {type(value).__name__}")
    text = plain(str(value))
    if len(text) > LONGEST_NAME:
        raise ValueError(f"a text of {len(text)} characters; at most {LONGEST_NAME} can be indexed")
    return text


def plain(text: str) -> str:
    """Text that every database can hold: NUL and half characters written as escapes."""
    return text.encode("utf-8", "backslashreplace").decode().replace("\0", "\\x00")


def _instant(value: object) -> str | None:
    """A date or time as ISO 8601, in UTC to the second; as it stands where it is neither."""
    text = _text(value)
    try:
        moment = datetime.fromisoformat(text or "")
    except ValueError:
        return text
    if moment.tzinfo is None and len(text or "") <= len("2026-01-31"):
        return text
    moment = moment.replace(tzinfo=moment.tzinfo or UTC)
    return moment.astimezone(UTC).isoformat(timespec="seconds")


def _day(metadata: Mapping[str, object]) -> str | None:
    """The day of a measurement as metadata state it."""
    day = stated_day(metadata)
    return day.isoformat() if day else None


def _norm(rows: list[Mapping[str, Any]], key: str) -> float | None:
    """The root of the sum of squares of a column of the budget; None where a part is undetermined."""
    parts = [row.get(key) for row in rows]
    return None if not parts or None in parts else math.hypot(*map(float, parts))  # type: ignore[arg-type]


def _calibration(data: bytes, name: str) -> Facts:
    fields = _document(data)
    budget = fields.get("budget", [])
    tool = fields["tool"]
    return Facts(
        serial=_text(fields.get("serial") or tool.get("serial")),
        type=_text(fields["profile"].get("name")),
        time=_day(tool) or _instant(fields["time"]),
        run=_text(fields.get("run_sha256")),
        previous=_text(fields.get("prior_sha256")),
        inclination_deg=_norm(budget, "inclination_deg"),
        toolface_deg=_norm(budget, "toolface_deg"),
        azimuth_deg=_norm(budget, "azimuth_deg") if fields.get("magnetometer") else None,
        simulated=int(bool(fields.get("simulated"))),
    )


def _verification(data: bytes, name: str) -> Facts:
    fields = _document(data)
    return Facts(
        serial=_text(fields.get("serial")),
        label=_text(fields.get("limits")),
        time=_day(fields),
        run=_text(fields.get("run_sha256")),
        calibration=_text(fields.get("calibration_sha256")),
        status=_outcome(fields["passed"]),
        simulated=int(bool(fields.get("simulated"))),
    )


def _outcome(passed: object) -> str:
    return "passed" if passed is True else "failed"


def _certificate(data: bytes, name: str) -> Facts:
    fields = _document(data)
    files = {file.get("id"): file.get("sha256") for file in fields.get("files") or []}
    as_left = fields.get("as_left")
    return Facts(
        serial=_text(fields.get("serial") or fields["item"].get("serial")),
        type=_text(fields["item"].get("type")),
        label=_text(fields["number"]),
        time=_instant(fields["issued"]),
        calibration=_text(files.get("calibration")),
        next_due=_instant(fields.get("next_due")),
        status=_outcome(as_left.get("passed")) if as_left else None,
        simulated=int(bool(fields.get("simulated"))),
    )


def _tool(data: bytes, name: str) -> Facts:
    fields = _document(data)
    return Facts(
        serial=_text(fields["serial"]),
        type=_text(fields.get("type")),
        label=_text(fields.get("name")),
        simulated=int(bool(fields.get("simulated"))),
    )


def _standard(data: bytes, name: str) -> Facts:
    fields = _document(data)
    return Facts(
        serial=_text(fields.get("serial")),
        type=_text(fields["quantity"]),
        label=_text(fields["name"]),
        time=_instant(fields.get("issued")),
        next_due=_instant(fields.get("due")),
    )


def _person(data: bytes, name: str) -> Facts:
    fields = _document(data)
    return Facts(label=_text(fields["name"]), type=_text(fields.get("function")))


def _profile(data: bytes, name: str) -> Facts:
    return Facts(type=_text(metadata.load_toml(data.decode("utf-8-sig")).get("name")))


def _run(data: bytes, name: str) -> Facts:
    """Serial and mark of simulated data from the metadata at the head of a table."""
    values: dict[str, object] = {}
    for number, line in enumerate(
        data.decode("utf-8-sig", "replace").splitlines()[:_METADATA_LINES], 1
    ):
        if not line.startswith("#"):
            break
        try:
            values |= metadata.parse([(number, line)], name)
        except InputError:
            continue  # a remark of another program
    return Facts(
        serial=_text(values.get("serial")),
        time=_day(values),
        simulated=int(is_simulated(values)),
    )


def _limits(data: bytes, name: str) -> Facts:
    return Facts(label=_text(metadata.load_toml(data.decode("utf-8-sig")).get("name")))


def _laboratory(data: bytes, name: str) -> Facts:
    fields = metadata.load_toml(data.decode("utf-8-sig"))
    return Facts(label=_text(fields.get("laboratory", {}).get("name")))


def _public_key(data: bytes, name: str) -> Facts:
    """Owner and key, as its signatures name it, of a PEM file; both as `certificate key create` writes them."""
    owner, block = _OWNER.search(data), _PEM_KEY.search(data)
    if block is None:
        raise ValueError("no public key in PEM form")
    raw = base64.b64decode(b"".join(block[1].split()), validate=True)[-_RAW_KEY:]
    stated = owner[1].decode("utf-8", "replace").strip() if owner else ""
    return Facts(label=_text(stated), type=sha256_of(raw)[:16])


RECORD_KINDS: dict[str, Callable[[bytes, str], Facts]] = {
    "tool": _tool,
    "profile": _profile,
    "run": _run,
    "calibration": _calibration,
    "verification": _verification,
    "certificate": _certificate,
    "standard": _standard,
    "person": _person,
    "limits": _limits,
    "laboratory": _laboratory,
    "public-key": _public_key,
}
"""Kinds of records, and what reads the facts of each."""


def content_address(data: bytes) -> str:
    """The SHA-256 by which an object is addressed."""
    return sha256_of(data)
