"""A calibration wherever it is kept: in a file of its own, in the table of a fleet, in a registry."""

from __future__ import annotations

from pathlib import Path

from mwdcal.calibration.record import Calibration
from mwdcal.files import documents
from mwdcal.files.formats import members


def calibration_of(path: Path) -> tuple[Calibration, str]:
    """The calibration in a file, and its SHA-256: see `calibration_file`."""
    file = calibration_file(path)
    return documents.decoded(file), file.digest


def calibration_file(path: Path) -> members.Member:
    """A calibration file, or one tool in the table of a fleet or in a registry; its name and SHA-256.

    `registry.sqlite#SERIAL` is the latest calibration of that tool.
    """
    file, serial = members.split(path)
    if not members.is_database(file):
        return documents.contents(path)
    from mwdcal.registry.lookup import latest_file
    from mwdcal.registry.store import open_registry

    with open_registry(file) as registry:
        return latest_file(registry, serial)
