"""Calibration files: JSON with a published schema, written atomically."""

from __future__ import annotations

import json
import os
from importlib import resources
from pathlib import Path
from typing import Any

import msgspec

from mwdcal.calibration import SCHEMA_VERSION, Calibration
from mwdcal.errors import InputError
from mwdcal.files import atomic


def encode(calibration: Calibration) -> bytes:
    """The bytes of a calibration file: two spaces of indent, one newline at the end."""
    return msgspec.json.format(msgspec.json.encode(calibration), indent=2) + b"\n"


def write(path: str | os.PathLike[str], calibration: Calibration) -> None:
    """Write a calibration file: the old one or the new one exists at any moment, never a part."""
    atomic.write(path, encode(calibration))


def read(path: str | os.PathLike[str]) -> Calibration:
    """Read a calibration file, or say what is wrong with it."""
    name = Path(path).name
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"{path}: cannot be read ({reason}). Check the path.") from None
    try:
        version = msgspec.json.decode(data, type=dict[str, Any]).get("schema_version")
        if version != SCHEMA_VERSION:
            raise InputError(
                f"{name}: 'schema_version' must be {SCHEMA_VERSION}; got {version!r}. It is no "
                "calibration file, or one of another version of mwdcal: calibrate again."
            )
        return check(msgspec.json.decode(data, type=Calibration), name)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InputError(
            f"{name} is not a calibration file: {error}. Use a file that mwdcal calibrate wrote."
        ) from None


def check(calibration: Calibration, name: str) -> Calibration:
    """Refuse a file whose parts do not fit together."""
    size = sum(t.size for t in calibration.triads)
    square = [len(row) for row in calibration.covariance] == [size] * size
    lengths = all(len(t.parameters) == len(t.parameter_names) == t.size for t in calibration.triads)
    if not square or not lengths:
        raise InputError(
            f"{name}: parameters and covariance do not fit together; the file was changed by "
            "hand or damaged. Use the file as mwdcal calibrate wrote it."
        )
    return calibration


def schema() -> dict[str, Any]:
    """JSON Schema of a calibration file, from its definition in code."""
    made = msgspec.json.schema(Calibration)
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"mwdcal calibration file, schema version {SCHEMA_VERSION}",
        **made,
    }


def published_schema() -> dict[str, Any]:
    """The schema as shipped with the package; equal to `schema()`, which a test checks."""
    text = resources.files("mwdcal").joinpath("calibration.schema.json").read_text("utf-8")
    loaded: dict[str, Any] = json.loads(text)
    return loaded
