"""Measured data sets of other projects: fetched by hash, never shipped.

A local copy is used where the environment variable MWDCAL_DATA names its folder; nothing is
downloaded unless MWDCAL_DATA_URL names a place to download from. Needs `mwdcal[data]`.
"""

from __future__ import annotations

import os
from importlib import resources
from pathlib import Path

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
            f"{name!r} is no measured file of the registry; see mwdcal.datasets.registry()."
        )
    if FOLDER not in os.environ and ADDRESS not in os.environ:
        raise InputError(
            f"{name}: set {FOLDER} to the folder of a local copy of the measured sets, or "
            f"{ADDRESS} to the address of one."
        )
    try:
        import pooch
    except ImportError:
        raise InputError(
            "measured sets need the extra 'data': pip install 'mwdcal[data]'."
        ) from None
    cache = pooch.create(
        path=pooch.os_cache("mwdcal"),
        base_url=os.environ.get(ADDRESS, "https://localhost/"),
        registry=known,
        env=FOLDER,
    )
    if ADDRESS not in os.environ and not (Path(cache.path) / name).exists():
        raise InputError(f"{name} is not in {cache.path} ({FOLDER}). Complete the local copy.")
    try:
        return Path(cache.fetch(name))
    except ValueError as error:
        raise InputError(f"{name}: {error}") from None
