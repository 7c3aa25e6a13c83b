"""Creation of a registry, and the change of its schema from version to version."""

from __future__ import annotations

import os

from mwdcal.registry.database import migrating
from mwdcal.registry.database.connections import connect
from mwdcal.registry.database.schema import SCHEMA_VERSION_OF_REGISTRY
from mwdcal.registry.store import person


def create(database: str | os.PathLike[str], actor: str) -> None:
    """Create a registry in a new file, or in an empty database by its URL.

    Raises:
        InputError: it exists already, or cannot be created.
    """
    who, target = person(actor), connect(database, new=True)
    try:
        migrating.initialise(target, who)
    finally:
        target.engine.dispose()


def upgrade(database: str | os.PathLike[str], actor: str) -> tuple[str, str]:
    """Bring the schema of a registry to this program's version; from which to which."""
    return move_to(database, SCHEMA_VERSION_OF_REGISTRY, actor)


def move_to(database: str | os.PathLike[str], target: str, actor: str) -> tuple[str, str]:
    """Bring the schema of a registry to a version, up or down; from which to which."""
    who, place = person(actor), connect(database)
    try:
        return migrating.change(place, target, who)
    finally:
        place.engine.dispose()
