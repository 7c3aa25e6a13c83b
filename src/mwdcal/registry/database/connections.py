"""Connections to SQLite and PostgreSQL, transactions, and errors of either in words."""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import sqlite3
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path, PurePath
from typing import Any
from urllib.parse import quote

import sqlalchemy as sa

from mwdcal import extras
from mwdcal.errors import InputError
from mwdcal.files.formats.members import is_nearly_url

# --------------------------------------------------------------------------
# Whether a file lies on a network drive, whose locks and shared memory SQLite cannot rely on.

_NETWORK = re.compile(
    "nfs4?|cifs|smb[23]?|smbfs|ncpfs|afs|ceph|glusterfs|lustre|beegfs|davfs|"
    r"fuse\.(davfs2|sshfs|rclone|s3fs)"
)
"""File systems that several machines may write to, by Linux's names."""
_REMOTE_DRIVE = 4
_MOUNTS = Path("/proc/self/mounts")


def on_network(path: Path) -> bool:
    """Whether a file, or the folder where it is to be, is on a network drive; no where that cannot be known."""
    with contextlib.suppress(OSError, ValueError):
        place = path.resolve()
        if os.name == "nt":
            return _remote_drive(place)
        kind = file_system(place, _MOUNTS.read_text("utf-8", "replace"))
        return _NETWORK.fullmatch(kind) is not None
    return False


def file_system(place: Path, mounts: str) -> str:
    """The file system that holds a place, from Linux's list of mounts; the last of the longest that fit."""
    result, length = "", -1
    for line in mounts.splitlines():
        _, point, kind, *_ = line.split(" ")
        folder = Path(point.encode("latin-1", "replace").decode("unicode_escape"))
        if len(folder.parts) >= length and place.is_relative_to(folder):
            result, length = kind, len(folder.parts)
    return result


def _remote_drive(place: Path) -> bool:
    """Whether Windows counts the drive of a path as remote, or has it as a share."""
    if place.drive.startswith("\\\\"):
        return True
    kernel = getattr(ctypes, "windll").kernel32  # noqa: B009 - only Windows has it
    return int(kernel.GetDriveTypeW(place.anchor)) == _REMOTE_DRIVE


ROWS_AT_ONCE = 100
"""Rows of a table that are in memory at once."""
OBJECTS_AT_ONCE = 8
"""Files of a registry that are in memory at once."""
LONGEST_WAIT = 60.0
"""Seconds for which a writer waits for its turn."""
_LOCK = 0x6D776463616C
"""The key of PostgreSQL's advisory lock that lets one writer in at a time."""
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+]+://")
_WHAT_TO_DO = {
    "locked": "Try again when the programs that write to it have ended.",
    "full": "Make room on the disk; nothing of the last change was kept.",
    "readonly": "Give yourself the right to write to the file and its folder, or copy it elsewhere.",
    "read-only": "Give yourself the right to write to it.",
    "unable to open": "Give yourself the right to write to the file and its folder, or copy it elsewhere.",
    "malformed": "Restore it from a backup.",
    "not a database": "Name a registry that mwdcal made.",
    "disk i/o error": "Check the disk; SQLite needs a local one, or use PostgreSQL.",
    "password": "Correct the user and the password in the URL.",
    "permission denied": "Ask the database owner for access.",
    "does not exist": "Create it on the server, or correct the URL.",
    "resolve host": "Correct the name of the server in the URL.",
    **dict.fromkeys(
        ("connection failed", "connection refused", "connection is bad", "server closed"),
        "Check that the server runs, and the URL.",
    ),
}


@dataclass(frozen=True)
class Database:
    """A database by the name that messages have for it, without password; `file` is that of SQLite.

    `shared`: several programs may use it at once, for which SQLite keeps a log beside it; otherwise
    it is a file that only this program writes, as a backup that is not finished.
    """

    name: str
    engine: sa.Engine
    file: Path | None = None
    shared: bool = True

    @contextlib.contextmanager
    def reading(self) -> Iterator[sa.Connection]:
        """A transaction that sees one state of the database, whatever is written meanwhile."""
        options = {} if self.file else {"isolation_level": "REPEATABLE READ"}
        with as_input_error(self), self.engine.connect() as plain:
            connection = plain.execution_options(**options)
            try:
                with connection.begin():
                    yield connection
            finally:
                _refuse_torn(self, plain.connection.dbapi_connection)

    @contextlib.contextmanager
    def writing(self) -> Iterator[sa.Connection]:
        """A transaction of the only writer: on the disk when the block ends, or without effect."""
        with as_input_error(self), self.engine.connect() as plain:
            if self.file:
                _set_journal(plain, self.shared)
            connection = plain.execution_options(mwdcal_writing=True)
            with connection.begin():
                if self.file is None:
                    connection.execute(sa.text(f"SELECT pg_advisory_xact_lock({_LOCK})"))
                yield connection


def _set_journal(connection: sa.Connection, shared: bool) -> None:
    """Have SQLite write ahead into a log, so that readers and the writer do not wait for each other.

    A file that nobody else uses, and that is thrown away where its writer fails, needs no journal.
    """
    modes = ("journal_mode=WAL",) if shared else ("journal_mode=OFF", "synchronous=OFF")
    with contextlib.suppress(sqlite3.Error):  # no log on every disk; then they wait
        for mode in modes:
            connection.connection.cursor().execute(f"PRAGMA {mode}")


def _wait_for_the_disk(connection: Any, _record: object) -> None:
    """Let COMMIT return only when the write is durable, where the server is set not to wait."""
    with connection.cursor() as cursor:
        cursor.execute("SHOW synchronous_commit")
        if cursor.fetchone()[0] == "off":
            cursor.execute("SET synchronous_commit = on")
    connection.commit()


def is_url(database: str | os.PathLike[str]) -> bool:
    """Whether a database is named by a URL, rather than by the path of a file."""
    return isinstance(database, str) and _URL.match(database) is not None


def connect(database: str | os.PathLike[str], new: bool = False, shared: bool = True) -> Database:
    """The database behind a path or a URL; a file that does not exist is refused unless `new`."""
    if not is_url(database):
        if is_nearly_url(os.fspath(database)):
            raise _no_url()
        return _sqlite(Path(database), new, shared)
    url = _parsed(str(database))
    if url.get_backend_name() == "sqlite":
        return _sqlite(Path(url.database or ""), new, shared)
    name = url.set(query={}).render_as_string(hide_password=True)
    if url.get_backend_name() != "postgresql":
        raise InputError(
            f"`database` must be a file or a URL of PostgreSQL; got '{name}'. Correct it."
        )
    if find_spec("psycopg") is None:
        raise extras.missing("psycopg", f"{name}: PostgreSQL", "postgresql")
    engine = sa.create_engine(url.set(drivername="postgresql+psycopg"), hide_parameters=True)
    sa.event.listen(engine, "connect", _wait_for_the_disk)
    return Database(name, engine)


def _parsed(text: str) -> sa.URL:
    try:
        url = sa.make_url(text)
    except (sa.exc.ArgumentError, ValueError):
        raise _no_url() from None
    if "@" in (url.host or ""):  # the rest of a password
        raise _no_url()
    return url


def _no_url() -> InputError:
    """That a URL cannot be read, without a word of it."""
    return InputError(
        "`database` must be a file, or a URL such as postgresql://user:password@host/name, with %40 for an @ in the "
        "password; got neither. Correct it."
    )


def _sqlite(path: Path, new: bool, shared: bool) -> Database:
    """The database in a file."""
    if path.is_dir():
        raise InputError(f"{path}: a registry is a file, and this is a folder. Name the file.")
    if new and not path.absolute().parent.is_dir():
        raise InputError(f"{path}: its folder does not exist. Create it, or name another.")
    if not new and not path.is_file():
        raise InputError(f"{path}: no such file. Check the path, or create the registry.")
    if shared and on_network(path):
        raise InputError(
            f"{path}: it is on a network drive, where SQLite cannot keep the writers of several machines "
            "apart. Put the registry on a local disk, or into PostgreSQL."
        )
    engine = sa.create_engine(
        "sqlite://", creator=partial(_opened, path, new), poolclass=sa.QueuePool
    )
    sa.event.listen(engine, "begin", _begin)
    return Database(str(path), engine, path, shared)


def file_uri(path: PurePath) -> str:
    """The URI by which SQLite opens a file; of a Windows share, the server's name is part of the path."""
    text = path.as_posix()
    return f"file://{'' if text.startswith('/') else '/'}{quote(os.fsencode(text), safe='/:')}"


class _Connection(sqlite3.Connection):
    """A connection to a file; `unlocked`: its size and time, where it is read without locks."""

    unlocked: tuple[int, int] | None = None


def _state(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_size, status.st_mtime_ns


def _refuse_torn(database: Database, connection: object) -> None:
    """Refuse what was read without locks while others wrote: it may be of two states of the registry."""
    before = connection.unlocked if isinstance(connection, _Connection) else None
    if before and database.file and before != _state(database.file):
        raise InputError(f"{database.name}: it was written to while it was read. Try again.")


def _opened(path: Path, new: bool) -> _Connection:
    """A connection to a file: to read alone where it, or its folder, may not be written to.

    Without the right to write to the folder SQLite cannot keep the log by which readers and writers share a file.
    Where there is no log nobody writes, and it is read as it is.
    """
    try:
        return _connected(path, "mode=rwc" if new else "mode=rw")
    except sqlite3.OperationalError as error:
        log = path.with_name(f"{path.name}-wal")
        code = error.sqlite_errorcode & 0xFF
        unwritable = code in (sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_READONLY)
        if new or not unwritable or log.exists():
            raise
    state = _state(path)
    connection = _connected(path, "mode=ro&immutable=1")
    connection.unlocked = state
    return connection


def _connected(path: Path, how: str) -> _Connection:
    """A connection to a file, opened with some parameters of its URI."""
    connection = _Connection(
        f"{file_uri(path.absolute())}?{how}",
        uri=True,
        timeout=LONGEST_WAIT,
        isolation_level=None,
        check_same_thread=False,
    )
    try:
        connection.execute("PRAGMA schema_version")  # fails where the file cannot be read
        connection.execute("PRAGMA synchronous=EXTRA")
        connection.execute("PRAGMA foreign_keys=ON")
        connection.execute("PRAGMA trusted_schema=OFF")
    except BaseException:
        connection.close()
        raise
    return connection


def _begin(connection: sa.Connection) -> None:
    writing = connection.get_execution_options().get("mwdcal_writing")
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writing else "BEGIN")


@contextlib.contextmanager
def as_input_error(database: Database) -> Iterator[None]:
    """Turn what the database refuses into one sentence without passwords."""
    try:
        yield
    except (UnicodeError, OverflowError):
        raise InputError(f"{database.name}: it is damaged. Restore it from a backup.") from None
    except (sa.exc.SQLAlchemyError, sqlite3.Error) as error:
        raise InputError(f"{database.name}: {error_text(error, database)}") from None


def error_text(error: Exception, database: Database) -> str:
    """The refusal of a database, without passwords, and what to do about it."""
    lines = str(getattr(error, "orig", None) or error).strip().splitlines()
    text = lines[0].strip() if lines else type(error).__name__
    password = database.engine.url.password
    if password:
        text = text.replace(str(password), "***")
    advice = (advice for word, advice in _WHAT_TO_DO.items() if word in text.lower())
    return f"{text.rstrip('.')}. {next(advice, 'Check the database.')}"
