"""Measured data sets of other projects: fetched by hash, never shipped.

A local copy is used where the environment variable MWDCAL_DATA names its folder; nothing is
downloaded unless MWDCAL_DATA_URL names a place to download from. Needs `mwdcal[data]`.
"""

from __future__ import annotations

import os
from importlib import resources
from pathlib import Path

from mwdcal import extras
from mwdcal.errors import InputError

FOLDER = "MWDCAL_DATA"
ADDRESS = "MWDCAL_DATA_URL"


def registry() -> dict[str, str]:
    """SHA-256 of every file of the measured sets, by path."""
    text = resources.files("mwdcal").joinpath("datasets.sha256").read_text("utf-8")
    pairs = (line.split(maxsplit=1) for line in text.splitlines() if line.strip())
    return {name.strip(): digest for digest, name in pairs}


def fetch(name: str) -> Path:
    """The local path of a measured file, checked against its hash.

    Errors: unknown name; no local copy and no address; a file that is not the published one.
    """
    known = registry()
    if name not in known:
        raise InputError(
            f"{name!r} is not a file of the measured sets; see mwdcal.files.datasets.registry()."
        )
    if not {FOLDER, ADDRESS} & os.environ.keys():
        raise InputError(
            f"{name}: set {FOLDER} to the folder of a local copy of the measured sets, or "
            f"{ADDRESS} to the address of one."
        )
    pooch = extras.load("pooch", "a measured set", "data")
    if FOLDER in os.environ:
        return _local(Path(os.environ[FOLDER]), name, known[name])
    cache = pooch.create(pooch.os_cache("mwdcal"), os.environ[ADDRESS], registry=known)
    try:
        return Path(cache.fetch(name))
    except (ValueError, OSError) as error:
        raise InputError(f"{name} could not be fetched: {error}. Check {ADDRESS}.") from None


def _local(folder: Path, name: str, digest: str) -> Path:
    """A file of a local copy, read-only, checked against its hash."""
    import pooch

    path = folder / name
    if not path.exists():
        raise InputError(f"{name} is not in {folder} ({FOLDER}). Complete the local copy.")
    if pooch.file_hash(str(path)) != digest:
        raise InputError(f"{path} is not the published file (its SHA-256 differs). Replace it.")
    return path
