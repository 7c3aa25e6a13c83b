"""Blocks that a certificate for people consists of: text alone, for a page and a PDF to lay out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, TypeAlias

import msgspec

Mark: TypeAlias = Literal["", "good", "bad", "free", "key", "code"]
"""What stands out: passed, failed or overdue, undetermined or not stated, a total, a digest."""


class Cell(msgspec.Struct, frozen=True):
    """A cell of a table: its lines, and how it stands out."""

    lines: list[str]
    mark: Mark = ""


class Column(msgspec.Struct, frozen=True):
    """A column of a table: of numbers or of words; `opens` a group of columns."""

    title: str
    number: bool = False
    opens: bool = False


class FactList(msgspec.Struct, frozen=True):
    """Labels and what each says, in lines."""

    title: str
    facts: list[tuple[str, list[str]]]


class FactsBlock(msgspec.Struct, frozen=True, tag="facts", tag_field="kind"):
    """Lists of facts side by side."""

    lists: list[FactList]


class TableBlock(msgspec.Struct, frozen=True, tag="table", tag_field="kind"):
    """A table, with a title above and notes below.

    `groups`: titles above groups of columns and how many each spans, where there are any; of all columns,
    those of no group with an empty title.
    """

    columns: list[Column]
    rows: list[list[Cell]]
    title: str = ""
    groups: list[tuple[str, int]] = []
    notes: list[str] = []


class TextBlock(msgspec.Struct, frozen=True, tag="text", tag_field="kind"):
    """Paragraphs, or the items of a list with a title."""

    texts: list[str]
    title: str = ""
    bullets: bool = False


class TestOutcome(msgspec.Struct, frozen=True):
    """The decision of one test in a box: level, word, headline and second line."""

    level: Mark
    word: str
    headline: str
    after: str


class OutcomesBlock(msgspec.Struct, frozen=True, tag="outcomes", tag_field="kind"):
    """Decisions side by side."""

    outcomes: list[TestOutcome]


class Signatory(msgspec.Struct, frozen=True):
    """A place to sign: in which role, and the lines that name the person."""

    role: str
    lines: list[str]


class SignaturesBlock(msgspec.Struct, frozen=True, tag="signatures", tag_field="kind"):
    """Places to sign, side by side."""

    people: list[Signatory]


class PictureBlock(msgspec.Struct, frozen=True, tag="picture", tag_field="kind"):
    """A picture by its id, with what it shows."""

    id: str
    title: str
    alt: str
    note: str = ""


Block: TypeAlias = (
    FactsBlock | TableBlock | TextBlock | OutcomesBlock | SignaturesBlock | PictureBlock
)


class Section(msgspec.Struct, frozen=True):
    """A numbered section of the certificate."""

    id: str
    title: str
    blocks: list[Block]


class CertificateText(msgspec.Struct, frozen=True, kw_only=True):
    """A certificate as text: head, sections, and the line that ends it.

    `simulated` is empty, or what every page says.
    """

    title: str
    number: str
    issued: str
    simulated: str
    laboratory: str
    laboratory_lines: list[str]
    sections: list[Section]
    end: str


def mapped_texts(value: Any, each: Callable[[str], str]) -> Any:
    """Nested data with a function applied to every text, keys apart."""
    if isinstance(value, str):
        return each(value)
    if isinstance(value, dict):
        return {key: mapped_texts(item, each) for key, item in value.items()}
    return (
        [mapped_texts(item, each) for item in value] if isinstance(value, list | tuple) else value
    )
