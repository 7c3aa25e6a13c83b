"""Which north a run's reference azimuths count from: `Readings` hold magnetic azimuth.

True azimuth = magnetic + declination; grid azimuth = true - convergence. Metadata
`azimuth_reference` is "magnetic" (the default), "true" or "grid". `declination_deg` without
`azimuth_reference` changes nothing: the azimuths are magnetic.
"""

from __future__ import annotations

from collections.abc import Mapping

from mwdcal.errors import InputError
from mwdcal.files.contract import AZIMUTH_KEYS, ROTATION, check_near_misses
from mwdcal.files.formats.table import shown

_NEEDED: dict[str, tuple[str, ...]] = {
    "magnetic": (),
    "true": ("declination_deg",),
    "grid": ("declination_deg", "convergence_deg"),
}


def magnetic_offset(metadata: Mapping[str, object], source: str) -> float:
    """Stated azimuth minus magnetic azimuth, degrees.

    >>> magnetic_offset({"azimuth_reference": "true", "declination_deg": 3.0}, "run.csv")
    3.0
    """
    check_near_misses(list(metadata), AZIMUTH_KEYS, f"{source}: metadata")
    kind = metadata.get("azimuth_reference", "magnetic")
    if kind is True:  # the bare word `true` in a metadata line
        kind = "true"
    stated = {
        key: _degrees(metadata[key], key, source) for key in AZIMUTH_KEYS[1:] if key in metadata
    }
    if not isinstance(kind, str) or kind not in _NEEDED:
        raise InputError(
            f"{source}, metadata 'azimuth_reference': must be one of "
            f"{', '.join(_NEEDED)}; got {shown(kind)}. Say which north the azimuths count from."
        )
    for key in _NEEDED[kind]:
        if key not in stated:
            raise InputError(
                f"{source}: {kind} azimuths need the metadata '{key}'; got none. Add a line "
                f"`# {key} = …`, or give magnetic azimuths."
            )
    sign = {"declination_deg": 1.0, "convergence_deg": -1.0}
    return sum((sign[key] * stated[key] for key in _NEEDED[kind]), 0.0)


def _degrees(value: object, key: str, source: str) -> float:
    number = float(value) if isinstance(value, int | float) else float("nan")
    if isinstance(value, bool) or not ROTATION.low <= number <= ROTATION.high:
        raise InputError(
            f"{source}, metadata '{key}': must be a number {ROTATION}; got {shown(value)}. "
            "East is positive; write it with a decimal point."
        )
    return number
