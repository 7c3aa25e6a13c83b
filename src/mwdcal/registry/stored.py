"""The one way of documents out of the database: each is, byte for byte, what the history says was added."""

from __future__ import annotations

import base64
import json
import math
import re
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from datetime import UTC, datetime
from typing import Any, NamedTuple

import msgspec
import sqlalchemy as sa

from mwdcal.calibration.readings import is_simulated, stated_day
from mwdcal.digests import sha256_of
from mwdcal.errors import FitError, InputError
from mwdcal.files import metadata
from mwdcal.registry.database import schema
from mwdcal.registry.database.connections import OBJECTS_AT_ONCE
from mwdcal.registry.database.models import history, objects, records, tools, withdrawals
from mwdcal.registry.database.schema import TOOL_KINDS, rows_of

# --------------------------------------------------------------------------
# The facts of a document, read from its bytes alone: one function for each kind.

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


LARGEST_OBJECT = 500_000_000
"""Bytes of the largest file that a registry takes."""
UNSUSPICIOUS, DENSEST = 50_000_000, 200
"""Bytes to which any object may unpack; a larger one to so many times what is stored, as no readings do."""
_next = history.alias("next")
_AFTER = (
    sa.select(_next.c.previous)
    .where(_next.c.number == records.c.number + 1)
    .scalar_subquery()
    .label("after")
)
Row = Mapping[str, Any]


class AlteredError(FitError):
    """A registry no longer holds what was added to it: `what` is wrong."""

    def __init__(self, what: str) -> None:
        super().__init__(
            f"{what}. Check the registry (mwdcal registry check), and restore it from a backup."
        )


class Stored(NamedTuple):
    """A document of a registry: its record, its bytes, and the row of the query that it came with."""

    record: dict[str, Any]
    data: bytes
    row: Any


def packed(data: bytes) -> bytes:
    """The bytes of an object as they are stored, of which `unpacked` makes the same again."""
    small = zlib.compress(data, 6)
    return zlib.compress(data, 0) if _is_dense(len(data), len(small)) else small


def _is_dense(size: int, stored: int) -> bool:
    return size > max(UNSUSPICIOUS, DENSEST * stored)


def unpacked(data: bytes, size: int, sha256: str, label: str = "a file") -> bytes:
    """An object's bytes from those stored, which have this size and SHA-256.

    Raises:
        AlteredError: they have not, or would unpack to more than memory bears.
    """
    unpacker, content = zlib.decompressobj(), None
    try:
        if 0 <= size <= LARGEST_OBJECT and not _is_dense(size, len(data)):
            content = unpacker.decompress(data, size + 1)
    except (zlib.error, TypeError, ValueError, OverflowError):
        pass
    if content is None or len(content) != size or not unpacker.eof or unpacker.unused_data:
        raise AlteredError(f"{label}: the bytes stored are damaged")
    if content_address(content) != sha256:
        raise AlteredError(f"{label}: the bytes stored are not those with the SHA-256 {sha256}")
    return content


def record_digest(record: Row, stored: Row | None) -> str:
    """The digest of a record, and of the object that came with it, whose bytes it covers as stored."""
    if stored is None:
        return schema.digest(record)
    as_stored = {**stored, "data": content_address(stored["data"])}
    return schema.digest({**record, "object": as_stored})


def with_objects(*more: sa.ColumnElement[Any]) -> sa.Select[Any]:
    """The query of records for `documents`; those whose object or event is missing are in it, to be refused."""
    return (
        sa.select(records, objects, history, _AFTER, *more)
        .outerjoin(objects, objects.c.sha256 == records.c.sha256)
        .outerjoin(history, history.c.number == records.c.number)
    )


def documents(connection: sa.Connection, name: str, query: sa.Select[Any]) -> Iterator[Stored]:
    """The documents of a query made of `with_objects`, in the registry of a name; a few in memory at once.

    Definition: of each the record, and the object that came with it, has the digest in its event; the event has its
    hash, which the next event repeats; the bytes have the size and the SHA-256 by which they are addressed.

    Raises:
        AlteredError: one of them is not what was added.
    """
    options = {"stream_results": True, "yield_per": OBJECTS_AT_ONCE}
    with closing(connection.execute(query, execution_options=options)) as result:
        for row in result.mappings():
            parts = (records, objects, history)
            record, stored, event = ({c.name: row[c] for c in part.columns} for part in parts)
            label = f"{name}: the {record['kind']} {record['name']!r} ({record['number']})"
            if not _is_as_added(record, stored, event, row["after"]):
                raise AlteredError(f"{label} was changed after it was added")
            data = unpacked(stored["data"], stored["size"], record["sha256"], label)
            yield Stored(record, data, row)


def _is_as_added(record: Row, stored: Row, event: Row, after: str | None) -> bool:
    """Whether a record is the one that its event tells of, and the event the one that the next follows."""
    brought = stored if stored["number"] == record["number"] else None
    try:
        return (
            event["row_sha256"] == record_digest(record, brought)
            and schema.follows(event, event["previous"])
            and after in (None, event["hash"])
        )
    except (TypeError, ValueError):  # no text or no number where one must be
        return False


def check_complete(connection: sa.Connection, name: str) -> None:
    """Refuse a registry in which a record, a withdrawal or a tool was removed, added or exchanged.

    The selection rests on all of them: without a withdrawal another calibration would be the latest.

    Raises:
        AlteredError: rows and history do not fit together.
    """
    at, event = records.c, history.c
    subject = sa.func.coalesce(sa.func.nullif(at.serial, ""), sa.func.nullif(at.label, ""), at.name)
    odd = (
        sa.select(event.number)
        .outerjoin(records, at.number == event.number)
        .outerjoin(withdrawals, withdrawals.c.number == event.number)
        .where(event.row_sha256.is_not(None))
        .where(
            sa.or_(
                sa.and_(at.number.is_(None), withdrawals.c.number.is_(None)),
                *(at.kind != event.kind, at.sha256 != event.sha256, subject != event.subject),
            )
        )
        .limit(1)
    )
    number = connection.scalar(odd)
    if number is None:
        number = next(_changed_withdrawals(connection), None)
    if number is not None:
        raise AlteredError(
            f"{name}: what event {number} of the history added was changed or removed"
        )
    serials = sa.select(sa.func.count(at.serial.distinct())).where(at.kind.in_(TOOL_KINDS))
    if connection.scalar(serials) != connection.scalar(sa.select(sa.func.count(tools.c.serial))):
        raise AlteredError(
            f"{name}: the table of tools has more or fewer rows than there are tools"
        )


def _changed_withdrawals(connection: sa.Connection) -> Iterator[int]:
    """Numbers of withdrawals that no event tells of."""
    query = sa.select(withdrawals, history.c.row_sha256).outerjoin(
        history, history.c.number == withdrawals.c.number
    )
    for row in connection.execute(query).mappings():
        withdrawal = {column.name: row[column] for column in withdrawals.columns}
        try:
            sound = schema.digest(withdrawal) == row["row_sha256"]
        except (TypeError, ValueError):
            sound = False
        if not sound:
            yield row["number"]


def check_tool(connection: sa.Connection, name: str, serial: str) -> None:
    """Refuse a tool whose row in the table of tools is not what its records give.

    Raises:
        AlteredError: it is not.
    """
    row = connection.execute(sa.select(tools).where(tools.c.serial == serial)).mappings().first()
    expected = next(rows_of(connection, [serial]), None)
    if (row and dict(row)) != expected:
        raise AlteredError(f"{name}: the row of tool {serial!r} is not what its records give")
