"""Metadata lines `# key = value`, with values in TOML, at the head of text tables and sheets.

A bare word that is not a TOML value (`operator = Borg`) is taken as text. Dates become ISO
text, so that every format holds the same values: text, numbers, booleans, lists, tables. What
names a tool, a person, a place or a day (`WORDS`) is text as it stands: a serial 12.10 is not 12.1.
"""

from __future__ import annotations

import json
import math
import numbers
import re
import tomllib
from collections.abc import Iterable, Mapping
from datetime import date, time
from typing import Any

from mwdcal.calibration.readings import WORDS
from mwdcal.errors import InputError

_BARE = re.compile(r"([A-Za-z0-9_-]+)\s*=\s*([^\s\"'\[{].*)")
_LONGEST_VALUE = 60
LARGEST_TOML = 1_000_000
"""Characters of TOML text."""
DEEPEST = 20
"""Levels of lists and tables in a value, and parts of a key."""
_KEY_PART = r"""(?:[\w-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(
    rf"(?:^|[\[{{,])[ \t]*+(?:{_KEY_PART}[ \t]*+\.[ \t]*+){{{DEEPEST}}}", re.MULTILINE
)
"""A key of more parts, where keys may stand."""


def parse(lines: Iterable[tuple[int, str]], source: str, word: str = "line") -> dict[str, object]:
    """The metadata of numbered `#` lines; an empty comment line is skipped.

    >>> parse([(1, "# serial = MWD-123"), (2, "# declination_deg = 3.5")], "run.csv")
    {'serial': 'MWD-123', 'declination_deg': 3.5}
    """
    metadata: dict[str, object] = {}
    for number, line in lines:
        text = line.lstrip("#").strip()
        if not text:
            continue
        key, value = _entry(text, f"{source}, {word} {number}")
        if key in metadata:
            raise InputError(
                f"{source}, {word} {number}: metadata keys must be unique; got '{key}' a "
                "second time. Remove one of the two lines."
            )
        metadata[key] = value
    return metadata


def load_toml(text: str) -> dict[str, Any]:
    """The values of TOML text, for all such text that enters: a key of many parts takes memory as their square.

    Raises:
        ValueError: text that is not TOML, or a key of more than `DEEPEST` parts.
        RecursionError: lists and tables nested beyond what Python can follow.
    """
    if len(text) > LARGEST_TOML:
        raise ValueError(f"TOML text must have at most {LARGEST_TOML} characters; got {len(text)}")
    if long := _LONG_KEY.search(text):
        line = text.count("\n", 0, long.end()) + 1
        raise ValueError(
            f"a key must have at most {DEEPEST} parts with dots between them (line {line})"
        )
    return tomllib.loads(text)


def plain(metadata: Mapping[str, object], source: str) -> dict[str, object]:
    """The metadata in values that a line can hold; refuses what is nested more than `DEEPEST` deep.

    Refuses `WORDS` that are not text.
    """
    values = {}
    for key, value in metadata.items():
        try:
            values[key] = _plain(value)
        except RecursionError:
            raise InputError(
                f"{source}, metadata {_shown(key)}: values must be nested at most {DEEPEST} deep. "
                "Simplify or remove it."
            ) from None
        if key in WORDS and value is not None:
            values[key] = _word(key, values[key], f"{source}, metadata")
    return values


def _word(key: str, value: object, where: str) -> str:
    """Text as it stands; a whole number loses nothing as text."""
    if isinstance(value, bool) or not isinstance(value, str | numbers.Integral):
        raise InputError(
            f"{where}: '{key}' must be text; got {_shown(str(value))}, whose spelling is lost. Put it in quotes, as "
            f'in {key} = "12.10".'
        )
    return str(value)


def render(metadata: Mapping[str, object]) -> list[str]:
    """The lines that `parse` turns back into `metadata`; empty values are left out."""
    return [f"# {_key(k)} = {toml(v)}" for k, v in metadata.items() if v is not None]


def _entry(text: str, where: str) -> tuple[str, object]:
    """Key and value of one line."""
    bare = _BARE.fullmatch(text)
    try:
        pairs = {} if text.startswith("[") else load_toml(text)
    except (ValueError, RecursionError):
        pairs = {bare[1]: bare[2]} if bare else {}
    if len(pairs) != 1:
        raise InputError(
            f"{where}: a line that starts with '#' must read `# key = value`, the key of "
            f"letters, digits, '_' and '-', the value as in TOML; got {_shown(text)}. "
            "Correct or remove the line."
        )
    ((key, value),) = pairs.items()
    if bare and key in WORDS:
        return key, _word(key, bare[2], where)
    return key, _plain(value, bare[2]) if bare else plain(pairs, where)[key]


def _plain(value: object, text: str = "", left: int = DEEPEST) -> object:
    """The value in types that JSON has: dates, and numbers beyond its range, as text.

    Raises `RecursionError` where more than `left` lists and tables stand one within the other.
    """
    if isinstance(value, list | dict) and not left:
        raise RecursionError
    if isinstance(value, list):
        return [_plain(item, left=left - 1) for item in value]
    if isinstance(value, dict):
        return {key: _plain(item, left=left - 1) for key, item in value.items()}
    if isinstance(value, date | time):
        return value.isoformat()
    endless = isinstance(value, float) and not math.isfinite(value)
    if endless or (isinstance(value, int) and abs(value) >= 2**63):
        return text or str(value)
    return value


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _quoted(key)


def toml(value: object) -> str:
    """A value as TOML on one line."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int) or (isinstance(value, float) and math.isfinite(value)):
        return repr(value)
    if isinstance(value, list | tuple):
        return "[" + ", ".join(toml(item) for item in value) + "]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(k)} = {toml(v)}" for k, v in value.items()) + "}"
    return _quoted(str(value))


def _quoted(text: str) -> str:
    """A TOML string: JSON's escapes, and DEL, which JSON leaves alone."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _shown(text: str) -> str:
    return repr(text if len(text) <= _LONGEST_VALUE else text[:_LONGEST_VALUE] + "…")
