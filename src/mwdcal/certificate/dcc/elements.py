"""Elements of a Digital Calibration Certificate: texts in English, single lines, types of content."""

from __future__ import annotations

import re
from collections.abc import Iterable
from datetime import date
from xml.etree import ElementTree as ET

from mwdcal.files.exchange.xml import lines, one_line

LANGUAGE = "en"
UNSTATED = "not stated"
"""What stands where the schema demands an element and the certificate says nothing."""
REF_TYPES = "mwdcal"
"""Namespace of our types of content, beside PTB's `basic`."""
_OUTSIDE_TOKEN = re.compile(r"[^A-Za-z0-9.-]+")

Child = ET.Element | None
"""An element, or none where there is nothing to say."""


def node(tag: str, *children: Child, **attributes: str | None) -> ET.Element:
    """An element with those of its children and attributes that exist; a tag without prefix is one of the DCC."""
    stated = {name: value for name, value in attributes.items() if value}
    element = ET.Element(_tag(tag), stated)
    element.extend(child for child in children if child is not None)
    return element


def leaf(tag: str, text: str, fallback: str = "", **attributes: str | None) -> Child:
    """An element of one line of text; none where text and fallback are blank."""
    line = one_line(text) or fallback
    if not line:
        return None
    element = node(tag, **attributes)
    element.text = line
    return element


def container(tag: str, children: Iterable[Child]) -> Child:
    """An element around others; none where there are none."""
    stated = [child for child in children if child is not None]
    return node(tag, *stated) if stated else None


def content(text: str) -> Child:
    """A text in English; none where it is blank."""
    body = lines(text)
    if not body:
        return None
    element = node("content", lang=LANGUAGE)
    element.text = body
    return element


def words(tag: str, text: str, fallback: str = "") -> Child:
    """An element of text for people, in English; none where text and fallback are blank."""
    return container(tag, [content(lines(text) or fallback)])


def title(text: str) -> Child:
    """The name of what surrounds it, which is never blank."""
    return words("name", one_line(text), UNSTATED)


def typed(
    tag: str, kind: str, *children: Child, basic: str = "", **attributes: str | None
) -> ET.Element:
    """An element with types of content: PTB's basic ones, blanks between them, then ours by its name."""
    token = _OUTSIDE_TOKEN.sub("-", kind).strip("-")
    types = [f"basic_{each}" for each in basic.split()]
    types += [f"{REF_TYPES}_{token}"] if token else []
    return node(tag, *children, refType=" ".join(types), **attributes)


def day(text: str) -> str:
    """The date of an ISO 8601 text; blank where it has none."""
    try:
        return date.fromisoformat(text.strip()[:10]).isoformat()
    except ValueError:
        return ""


def _tag(tag: str) -> str:
    return tag if ":" in tag else f"dcc:{tag}"
