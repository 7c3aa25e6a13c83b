"""The registry of tools from Python: `with mwdcal.registry("tools.sqlite") as tools:` and what it answers."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import UTC, date, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from mwdcal.calibration.record import Calibration, Finding
from mwdcal.errors import InputError
from mwdcal.geometry.vectors import AnyArray
from mwdcal.library.results import Result

if TYPE_CHECKING:
    from mwdcal.calibration.readings import Readings
    from mwdcal.library.tasks import Savable
    from mwdcal.registry.imports import Source
    from mwdcal.registry.lookup import Listing
    from mwdcal.registry.store import Registry

FilePath = str | os.PathLike[str]
"""The path of a file."""


def registry(
    database: FilePath,
    *,
    create: bool = False,
    upgrade: bool = False,
    restore: FilePath | None = None,
    actor: str | None = None,
) -> ToolRegistry:
    """Open the registry of tools in a file (SQLite) or, by its URL, in PostgreSQL; a context that closes it.

    `create` makes an empty registry where there is none. `upgrade` brings its tables to the form that this version
    needs. `restore` fills a new registry from a backup. `actor` is who acts, as the history states it: by default
    the user of the system.

    Raises:
        InputError: there is no registry, it needs an upgrade, or SQLAlchemy is not installed.

    Example::

        with mwdcal.registry("tools.sqlite", create=True) as tools:
            tools.add("tool.json", "runs")
            tools.latest("SIM-0001").uncertainty("azimuth", survey)
            tools.drift("SIM-0001").next_due
    """
    from mwdcal.registry import exports, store
    from mwdcal.registry.store import open_registry, system_user

    who = system_user() if actor is None else actor
    if restore is not None:
        exports.restore(restore, database, who)
    elif create and _is_new(database):
        store.create(database, who)
    elif upgrade:
        store.upgrade(database, who)
    stack = ExitStack()
    return ToolRegistry(stack.enter_context(open_registry(database)), who, stack)


def _is_new(database: FilePath) -> bool:
    """Whether there is no registry at a place, or none that answers."""
    from mwdcal.registry.database.connections import connect, is_url
    from mwdcal.registry.database.schema import known_version

    if not is_url(database):
        return not Path(database).exists()
    target = connect(database, new=True)
    try:
        with target.reading() as connection:
            known_version(connection, target.name)
        return False
    except InputError:
        return True
    finally:
        target.engine.dispose()


@dataclass(repr=False)
class RegistryAnswer(Result):
    """The answer of a registry: `content` has all values of the JSON; its fields are attributes too."""

    content: Any
    text: str
    document: dict[str, Any] = field(default_factory=dict)
    remarks: Sequence[Finding] = ()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "content":
            raise AttributeError(name)
        return getattr(self.content, name)

    @property
    def findings(self) -> Sequence[Finding]:
        """The findings, each with an `id` and a `text`."""
        return self.remarks

    def _text(self) -> str:
        return self.text

    def _document(self) -> dict[str, Any]:
        return self.document


@dataclass(repr=False)
class RegistryListing(RegistryAnswer):
    """Tools or records, one in a row: `total` there are, `rows` are here from the one of number `offset` on."""

    @property
    def rows(self) -> Sequence[Any]:
        """Tools, or else records, each with its fields as attributes."""
        rows: Sequence[Any] = self.content.tools or self.content.records
        return rows

    @property
    def columns(self) -> Mapping[str, AnyArray]:
        """Arrays by the fields of the rows: numbers with NaN for missing ones, or text."""
        names = self.rows[0].__struct_fields__ if self.rows else ()
        return {name: _column([getattr(row, name) for row in self.rows]) for name in names}

    def __len__(self) -> int:
        return len(self.rows)


def _column(cells: Sequence[Any]) -> AnyArray:
    """Numbers with NaN for missing ones; text with empty ones."""
    filled = [cell for cell in cells if cell is not None]
    if filled and all(isinstance(cell, float) for cell in filled):
        return np.array([np.nan if cell is None else cell for cell in cells])
    if len(filled) < len(cells):
        return np.array(["" if cell is None else str(cell) for cell in cells], object)
    return np.array(cells, object if any(isinstance(cell, str) for cell in cells) else None)


@dataclass(repr=False)
class StoredDocument(RegistryAnswer):
    """A document of a registry: its `data` as they were added, with `kind`, `name`, `number` and `sha256`."""

    data: bytes = b""

    def save(self, path: FilePath) -> None:
        """Write the document as it was added."""
        from mwdcal.files.formats import atomic

        atomic.write(path, self.data)


@dataclass(repr=False)
class DriftAnswer(RegistryAnswer):
    """How a tool (`tool`), or every tool (`fleet`), changes from calibration to calibration."""

    @property
    def next_due(self) -> str | None:
        """The day, ISO 8601, on which the tool is to be calibrated again; None where nothing can be predicted.

        Of all tools the earliest one.
        """
        if self.content.tool:
            due: str | None = self.content.tool.next_due
            return due
        days = [tool.next_due for tool in (*self.content.fleet.due, *self.content.fleet.worst)]
        return min(filter(None, days), default=None)

    def _page(self) -> str:
        from mwdcal.presentation.drift import render

        return render(self.content.tool, self.content.fleet)


class ToolRegistry:
    """An open registry: every tool's past. Nothing in it is ever changed or removed.

    `name` is its file, or its URL without password. Close it by `close()`, or use it in a `with` block.
    """

    def __init__(self, opened: Registry, actor: str, stack: ExitStack) -> None:
        self.opened, self._actor, self._stack = opened, actor, stack

    def __enter__(self) -> ToolRegistry:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the registry."""
        self._stack.close()

    @property
    def name(self) -> str:
        """Its file, or its URL without password."""
        return self.opened.name

    @property
    def head(self) -> str:
        """The hash of the newest event of the history: noted elsewhere, it shows later whether all is still there."""
        return self.opened.head()[1]

    def __repr__(self) -> str:
        return f"<ToolRegistry: {self.name[-250:]}>"

    def add(
        self,
        *items: FilePath | Calibration | Readings | Savable,
        actor: str | None = None,
        workers: int = 1,
    ) -> RegistryAnswer:
        """Add files, all files of folders, or calibrations, readings and certificates that are in memory.

        The content of a file shows its kind. Files already there are not added again. A file that cannot be added
        does not stop the others: it is among `files` and `findings`. `new` counts what was added by kind.

        Raises:
            InputError: a file is missing, or not one could be added.

        Example: `tools.add("tool.json", cal, "runs").new` is `{"calibration": 2, "run": 12}`.
        """
        from mwdcal.presentation import registry as screen
        from mwdcal.registry import imports

        sources: list[Source] = []
        for item in items:
            if isinstance(item, str | os.PathLike):
                sources += imports.sources([Path(item)])
            else:
                sources.append(_in_memory(item))
        adding = imports.Adding(self.opened, self._actor if actor is None else actor)
        imports.add_all(adding, imports.portions(sources), workers, lambda done, total: None)
        result = screen.added(self.opened, adding)
        if not (result.new or result.known):
            why = f" {result.findings[0].text}" if result.findings else " Name some."
            raise InputError(f"{self.name}: not one of the files could be added.{why}")
        document = screen.document("registry add", result, {"simulated": adding.simulated})
        text = screen.added_text(result, adding.simulated)
        return RegistryAnswer(result, text, document, result.findings)

    def latest(self, serial: str) -> Calibration:
        """The latest calibration of a tool.

        Raises:
            InputError: there is no such tool, or it has no calibration.
        """
        from mwdcal.files import documents
        from mwdcal.registry.lookup import latest_file

        return documents.decoded(latest_file(self.opened, serial))

    def get(self, record: str | int, path: FilePath | None = None) -> StoredDocument:
        """A document: the latest calibration of a serial, or any by its number or the beginning of its SHA-256.

        `path`: a file to write it to, as it was added.

        Raises:
            InputError: there is no such record, or the file cannot be written.
        """
        from mwdcal.presentation import registry as screen
        from mwdcal.registry import lookup

        row, data = lookup.document(self.opened, str(record))
        about = {name: row[name] for name in screen.KEYS}
        content = screen.RegistryDocument(**about, output=os.fspath(path or ""))
        document = screen.document("registry get", content, row)
        result = StoredDocument(content, screen.got_text(content), document, data=data)
        if path is not None:
            result.save(path)
        return result

    def history(self, serial: str, *, limit: int = 50, offset: int = 0) -> RegistryListing:
        """The past of a tool: its records in the order in which they were added, who added them and when.

        Raises:
            InputError: there is no such tool.
        """
        from mwdcal.presentation import registry as screen
        from mwdcal.registry import lookup

        result = lookup.past_of(self.opened, serial, offset, limit)
        document = screen.document("registry history", result, {"serial": serial})
        return RegistryListing(result, screen.history_text(result), document)

    def drift(
        self,
        serial: str | None = None,
        *,
        limits: Mapping[str, float] | None = None,
        level: float = 0.01,
        today: date | str | None = None,
        progress: Callable[[int, int], None] = lambda done, total: None,
    ) -> DriftAnswer:
        """Compare the calibrations of a tool, or of every tool: did it change, and when is it due?

        `limits`: what the 95 % accuracy of an angle may be until the next calibration, in degrees, such as
        `{"inclination_deg": 0.1}`; by default the errors that the limits profile roll-test allows. `level`: share of
        unchanged tools that are called changed. `today`: the day by which tools are overdue. `progress` hears how
        many tools are done, and of how many.

        Raises:
            InputError: there is no calibration of such a tool, or a limit is of no angle.
        """
        from mwdcal.library import drifts
        from mwdcal.presentation import drift as screen

        typed = [f"{name}={value}" for name, value in (limits or {}).items()]
        if not 0.001 <= level <= 0.2:
            raise InputError(f"`level` must be from 0.001 to 0.2; got {level}. Choose such a one.")
        day = day_of(today, "today") or datetime.now(UTC).date()
        result = drifts.of_registry(
            self.opened, serial, drifts.limits_of(typed), level, day, progress
        )
        remarks = result.tool.findings if result.tool else []
        return DriftAnswer(result, screen.text(result, None), screen.document(result), remarks)

    def check(self, head: str | None = None) -> RegistryAnswer:
        """Check that nothing was changed, removed or added beside the program: `sound`, and `discrepancies`.

        `head`: the hash of an event that must be there, as an earlier check or a backup gave it.
        """
        from mwdcal.presentation import registry as screen
        from mwdcal.registry import checking

        result = screen.checked(self.opened, checking.check(self.opened, head))
        document = screen.document("registry check", result)
        return RegistryAnswer(
            result, screen.check_text(result), document, screen.problems_of(result)
        )

    def backup(self, path: FilePath) -> RegistryAnswer:
        """Write a backup while others go on writing; `head` is the hash to note of it.

        Raises:
            FitError: the registry was altered; an older backup stays.
            InputError: it cannot be written.
        """
        from mwdcal.presentation import registry as screen
        from mwdcal.registry import exports

        head = exports.backup(self.opened, path)
        result = screen.RegistryCopied(file=os.fspath(path), head=head)
        document = screen.document("registry backup", result)
        return RegistryAnswer(result, screen.copied_text(result), document)

    def export(self, folder: FilePath) -> RegistryAnswer:
        """Write all documents as files into a new folder, with the history and a manifest.

        Raises:
            InputError: the folder is not empty, or cannot be written.
        """
        from mwdcal.files.formats.atomic import check_new
        from mwdcal.presentation import registry as screen
        from mwdcal.registry.exports import export

        check_new(Path(folder))
        manifest = export(self.opened, Path(folder), lambda done, total: None)
        files, events = len(manifest.files), manifest.events
        result = screen.RegistryExported(
            folder=os.fspath(folder), files=files, events=events, head=manifest.head
        )
        document = screen.document("registry export", result, {"simulated": manifest.simulated})
        return RegistryAnswer(result, screen.exported_text(result), document)

    def withdraw(
        self, record: str | int, reason: str, *, actor: str | None = None
    ) -> RegistryAnswer:
        """Withdraw a record, by its number or SHA-256: it stays in the history, and no longer counts.

        Raises:
            InputError: there is no such record, or it is withdrawn already.
        """
        from mwdcal.presentation import registry as screen
        from mwdcal.registry.lookup import one_record

        row = one_record(self.opened, str(record))
        self.opened.withdraw(row["number"], reason, self._actor if actor is None else actor)
        result = screen.withdrawn(self.opened, row, reason)
        document = screen.document("registry withdraw", result, row)
        return RegistryAnswer(result, screen.withdrawn_text(result), document)

    def list(
        self,
        kind: str | None = None,
        *,
        search: str = "",
        due: date | str | None = None,
        limit: int = 50,
        offset: int = 0,
    ) -> RegistryListing:
        """Tools with last calibration, accuracy to expect, next due date and last verdict; or records of a `kind`.

        `search`: only tools with this in serial or type. `due`: only what is due before this day.

        Raises:
            InputError: there is no such kind of records.
        """
        from mwdcal.presentation import registry as screen
        from mwdcal.registry import lookup

        day = day_of(due, "due")
        before = day.isoformat() if day else ""
        result: Listing = lookup.listed(self.opened, kind, search, before, offset, limit)
        document = screen.document("registry list", result)
        return RegistryListing(result, screen.list_text(result), document)


def day_of(day: date | str | None, name: str) -> date | None:
    """A day that is a date, or its text in ISO 8601; `name` is that of the argument.

    Raises:
        InputError: it is neither.
    """
    if isinstance(day, datetime):
        return day.date()
    if day is None or isinstance(day, date):
        return day
    try:
        return date.fromisoformat(str(day))
    except ValueError:
        raise InputError(
            f"`{name}` must be a day such as 2026-01-31; got {str(day)[:80]!r}. Correct it."
        ) from None


def _in_memory(item: Calibration | Readings | Savable) -> Source:
    """A result that is in memory as the file that `save` would write."""
    from mwdcal.library.tasks import save
    from mwdcal.registry.imports import Source

    run = not isinstance(item, Calibration) and not hasattr(item, "save")
    about: Mapping[str, Any] = getattr(item, "metadata", {}) if run else {}
    serial = about.get("serial") if run else getattr(item, "serial", None)
    name = "".join(c if c.isalnum() or c in "-_." else "_" for c in str(serial or "unknown"))
    with TemporaryDirectory() as folder:
        file = Path(folder, f"{name}{'.csv' if run else '.json'}")
        save(item, file)
        return Source(Path(file.name), data=file.read_bytes())
