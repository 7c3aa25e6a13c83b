"""Calibration files: JSON with a published schema, written atomically."""

from __future__ import annotations

import hashlib
import json
import os
from importlib import resources
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from mwdcal.calibration.readings import TRIADS
from mwdcal.calibration.record import SCHEMA_VERSION, Calibration
from mwdcal.calibration.soaks import HIGHEST
from mwdcal.errors import InputError, reason
from mwdcal.files.formats import atomic
from mwdcal.files.profiles import check_profile

LARGEST = 1e30
"""Magnitude that no number of a calibration reaches."""
WORST = 1e4
"""Condition number that the gains of a real sensor never reach."""


def encode(calibration: Calibration) -> bytes:
    """The bytes of a calibration file: two spaces of indent, one newline at the end."""
    return msgspec.json.format(msgspec.json.encode(calibration), indent=2) + b"\n"


def write(path: str | os.PathLike[str], calibration: Calibration) -> None:
    """Write a calibration file: the old one or the new one exists at any moment, never a part."""
    atomic.write(path, encode(calibration))


def read(path: str | os.PathLike[str]) -> Calibration:
    """Read a calibration file, or say what is wrong with it."""
    return load(path)[0]


def load(path: str | os.PathLike[str]) -> tuple[Calibration, str]:
    """A calibration file, and the SHA-256 of its bytes."""
    name = Path(path).name
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({reason(error)}). Check the path.") from None
    try:
        version = msgspec.json.decode(data, type=dict[str, Any]).get("schema_version")
        if version != SCHEMA_VERSION:
            raise InputError(
                f"{name}: 'schema_version' must be {SCHEMA_VERSION}; got {version!r}. It is not "
                "a calibration file, or another version of mwdcal wrote it: calibrate again."
            )
        calibration = check(msgspec.json.decode(data, type=Calibration), name)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InputError(
            f"{name} is not a calibration file: {error}. Use a file that mwdcal calibrate wrote."
        ) from None
    return calibration, hashlib.sha256(data).hexdigest()


def check(calibration: Calibration, name: str) -> Calibration:
    """Refuse a file whose parts do not fit together, or whose numbers are not possible."""
    problem = _misfit(calibration)
    if problem:
        raise InputError(
            f"{name}: {problem}; the file was changed by hand or damaged. Use the file as mwdcal "
            "calibrate wrote it."
        )
    check_profile(calibration.profile, name)
    return calibration


def _misfit(calibration: Calibration) -> str:
    """What does not fit together in a calibration; empty where all does."""
    for triad, expected in zip(calibration.triads, TRIADS, strict=False):
        if triad.name != expected:
            return f"the triad '{triad.name}' stands where the {expected} belongs"
        if triad.model not in ("polynomial", "factors") or not 0 <= triad.order <= HIGHEST:
            return f"the {triad.name} has the unknown model '{triad.model}' of order {triad.order}"
        if len(triad.centre) != 3 or not 0 < triad.radius < np.inf:
            return f"the {triad.name} has no usable centre and radius"
        names = triad.functions(calibration.reference_temperature).names
        given = (triad.parameter_names, triad.parameters, triad.standard_uncertainties)
        if list(names) != triad.parameter_names or {len(g) for g in given} != {len(names)}:
            return f"the parameters of the {triad.name} are not those of its model"
        if not 0 <= triad.rank <= triad.size <= len(names):
            return f"rank and size of the {triad.name} are not those of its parameters"
    size = sum(len(t.parameters) for t in calibration.triads)
    if [len(row) for row in calibration.covariance_rows] != [size] * size:
        return "parameters and covariance do not fit together"
    if any(len(row) != size for row in calibration.free):
        return "parameters and undetermined directions do not fit together"
    low, high = calibration.temperature_c or (0.0, 0.0)
    needed = {"gravity_g", "field", "dip_deg"} if calibration.has_field else {"gravity_g"}
    if not -LARGEST <= low <= high <= LARGEST or not needed <= set(calibration.earth):
        return "temperature range or earth's field are not usable"
    return _unusable(calibration)


def _unusable(calibration: Calibration) -> str:
    """Which numbers cannot be used; empty where all can."""
    covariance = calibration.parameter_covariance
    lists = [[t.radius, t.noise, *t.centre, *t.parameters] for t in calibration.triads]
    lists += [*calibration.free, covariance.ravel().tolist(), list(calibration.earth.values())]
    if max(abs(v) for numbers in lists for v in numbers) > LARGEST:
        return f"a number is beyond {LARGEST:g}"
    diagonal = np.diag(covariance)
    norm = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scaled = covariance / np.outer(norm, norm)
    even = np.allclose(scaled, scaled.transpose(), atol=1e-6)
    if not even or (diagonal < 0).any() or np.linalg.eigvalsh(scaled)[0] < -1e-6:
        return "the covariance is not a valid covariance matrix: it is not symmetric, or has negative variances"
    middle = np.array([calibration.reference_temperature])
    for triad in calibration.triads:
        parameters = np.array(triad.parameters)
        with np.errstate(all="ignore"):
            model = triad.functions(calibration.reference_temperature)
            slope = model.slope(parameters, np.zeros((1, 3)), middle)[0]
        if not np.isfinite(slope).all() or np.linalg.cond(slope) > WORST:
            return f"the gains of the {triad.name} cannot be inverted"
    return ""


def published_schema() -> dict[str, Any]:
    """The schema of a calibration file, as shipped with the package."""
    text = resources.files("mwdcal").joinpath("calibration.schema.json").read_text("utf-8")
    loaded: dict[str, Any] = json.loads(text)
    return loaded
