"""The results of the tasks of `import mwdcal`: values by name, and the words, document and page of the command."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from html import escape
from importlib import import_module
from typing import Any

import numpy as np

from mwdcal.calibration.record import Finding
from mwdcal.errors import InputError
from mwdcal.files.formats.columns import as_text
from mwdcal.files.formats.table import Table
from mwdcal.geometry.observables import EXTRAPOLATED
from mwdcal.geometry.vectors import AnyArray

LONGEST_LINE = 300
"""Most characters of a `repr`."""
FLAGS = ("accepted", "axial_no_go", EXTRAPOLATED)
"""Columns of results that are true, false or blank."""
_FLAG_WORDS = {"true": True, "false": False, "": None}


class Result:
    """A result. Its findings, `columns` where it is a table, and three forms of the whole.

    Subclasses give `_text`, `_document` and, where the command has one, `_page`.
    """

    @property
    def findings(self) -> Sequence[Finding]:
        """The findings, each with an `id` and a `text`."""
        return []

    @property
    def columns(self) -> Mapping[str, AnyArray]:
        """Arrays by the names of the command's table."""
        raise AttributeError(f"{type(self).__name__} is no table: it has no columns")

    def _text(self) -> str:
        raise NotImplementedError

    def _document(self) -> dict[str, Any]:
        raise NotImplementedError

    def _page(self) -> str:
        raise InputError(f"a {type(self).__name__} has no page. Print its `summary()`.")

    def summary(self) -> str:
        """The text that the command prints."""
        return self._text()

    def to_dict(self) -> dict[str, Any]:
        """The command's JSON as a dictionary."""
        return self._document()

    def report(self, path: str | os.PathLike[str]) -> None:
        """Write the page of the command: self-contained HTML.

        Raises:
            InputError: there is no such page, or the file cannot be written.
        """
        from mwdcal.files.formats import atomic

        atomic.write(os.fspath(path), self._page())

    def to_pandas(self) -> Any:
        """The columns as a table of pandas, with what is stated of them in `attrs`; pandas must be installed."""
        return frame(self.columns)

    def __repr__(self) -> str:
        return brief(self, self._text)

    def _repr_html_(self) -> str:
        return f"<pre>{escape(self._text())}</pre>"


def brief(result: object, text: Callable[[], str]) -> str:
    """One line that says what a result is: its type, and the first words of its text.

    >>> brief(1.0, lambda: "PASS   rolltest.csv\\n12 stations")
    '<float: PASS rolltest.csv>'
    """
    lines = [" ".join(line.split()) for line in text().splitlines()]
    line = f"<{type(result).__name__}: {next(filter(None, lines), '')}"
    return f"{line[: LONGEST_LINE - 2]}…>" if len(line) >= LONGEST_LINE else f"{line}>"


def arrays_of(table: Table) -> dict[str, AnyArray]:
    """The columns of a table; labels as text."""
    return {name: np.asarray(cells) for name, cells in table.columns.items()}


def frame(columns: Mapping[str, AnyArray], stated: Mapping[str, object] | None = None) -> Any:
    """Columns as a table of pandas, with what is `stated` of them in its `attrs`; `FLAGS` are nullable booleans.

    Raises:
        InputError: pandas is not installed.
    """
    try:
        pandas = import_module("pandas")
    except ModuleNotFoundError as error:
        raise InputError(
            "`to_pandas` needs pandas, which is not installed: pip install pandas."
        ) from error
    flags = {}
    for name in {*FLAGS}.intersection(columns):
        words = [*map(as_text, columns[name].tolist())]
        if {*words} <= {*_FLAG_WORDS}:
            flags[name] = pandas.array([_FLAG_WORDS[word] for word in words], dtype="boolean")
    whole = pandas.DataFrame({**columns, **flags})
    whole.attrs.update(stated or {})
    return whole
