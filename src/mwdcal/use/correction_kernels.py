"""Compiled loops behind `correction_numba`: rows to vectors and angles in one pass over memory.

Rows are taken in tiles that stay in the innermost cache. Every loop runs over one scratch
array whose row length is a constant, which is what lets the compiler use the vector units;
arithmetic is plain IEEE, so that NaN and the sign of zero survive and a row has the same
digits wherever it stands. Importing this module needs Numba.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from numba import njit

from mwdcal.digests import sha256_of
from mwdcal.geometry.observables import VERTICAL
from mwdcal.geometry.vectors import AnyArray, Array

Floats = tuple[float, ...]
Triad = tuple[tuple[Floats, ...], Floats, bool]
"""The fields of `correction_numba.Numbers`."""
Channels = tuple[AnyArray, ...]

_VERSION = f"py{sys.version_info.major}{sys.version_info.minor}"
TILE = 128
DEGREES_PER_RADIAN = 180.0 / np.pi
FULL_TURN = 2.0 * np.pi

# Scratch rows: temperature, then the outputs in their order, then what angles are made of.
_T, _G, _B = 0, 1, 4
_INC, _AZI, _FACE, _GRAVITY, _FIELD, _DIP, _MAGNETIC = 7, 8, 9, 10, 11, 12, 13
_ACROSS, _EAST, _NORTH, _DOWN, _CROSS, _TAU, _ROWS = 14, 15, 16, 17, 18, 19, 20


_F = TypeVar("_F", bound=Callable[..., object])


def compiled(function: _F) -> _F:
    """The function as machine code, kept on disk where a folder for it can be written.

    Arithmetic is plain IEEE, and division by zero raises nothing: a result has the same bytes from
    code compiled just now and from code kept on disk.
    """
    try:
        loop = njit(nogil=True, cache=True, error_model="numpy")(function)
    except RuntimeError:  # no such folder
        loop = njit(nogil=True, error_model="numpy")(function)
    return cast(_F, loop)


@compiled
def angle(y: float, x: float) -> float:
    """atan2 without branches, after Cephes `atan` (S. L. Moshier): within 2 units of the last digit."""
    across, along = abs(y), abs(x)
    steep = across > along
    small = along if steep else across
    large = across if steep else along
    fold = small > 0.66 * large
    above = small - large if fold else small
    below = small + large if fold else large
    below = 1.0 if below == 0.0 else below
    z = above / below
    w = z * z
    p = -8.750608600031904122785e-1
    p = p * w - 1.615753718733365076637e1
    p = p * w - 7.500855792314704667340e1
    p = p * w - 1.228866684490136173410e2
    p = p * w - 6.485021904942025371773e1
    q = w + 2.485846490142306297962e1
    q = q * w + 1.650270098316988542046e2
    q = q * w + 4.328810604912902668951e2
    q = q * w + 4.853903996359136964868e2
    q = q * w + 1.945506571482613964425e2
    turn = z * (w * p / q) + z
    turn = turn + 0.25 * np.pi if fold else turn
    turn = 0.5 * np.pi - turn if steep else turn
    turn = np.pi - turn if np.copysign(1.0, x) < 0.0 else turn
    return float(np.copysign(turn, y))


@compiled
def cubic(c: Floats, t: float) -> float:
    """Σ c[k] tᵏ, k = 0…3."""
    return ((c[3] * t + c[2]) * t + c[1]) * t + c[0]


@compiled
def field(t: Array, x: Array, y: Array, z: Array, count: int, triad: Triad) -> None:
    """Nominal readings x, y, z become the field, in place; see `correction_numba.Numbers`."""
    c, shape, curved = triad
    for i in range(count):
        w = t[i]
        u = (x[i] - shape[0]) / (shape[3] * cubic(c[12], w))
        v = (y[i] - shape[1]) / (shape[4] * cubic(c[13], w))
        q = (z[i] - shape[2]) / (shape[5] * cubic(c[14], w))
        fx = cubic(c[0], w) * u + cubic(c[1], w) * v + cubic(c[2], w) * q + cubic(c[9], w)
        fy = cubic(c[3], w) * u + cubic(c[4], w) * v + cubic(c[5], w) * q + cubic(c[10], w)
        fz = cubic(c[6], w) * u + cubic(c[7], w) * v + cubic(c[8], w) * q + cubic(c[11], w)
        if curved:
            fx += (shape[6] + shape[9] * u) * u * u
            fy += (shape[7] + shape[10] * v) * v * v
            fz += (shape[8] + shape[11] * q) * q * q
        x[i], y[i], z[i] = fx, fy, fz


@compiled
def parts(s: Array, count: int) -> None:
    """Strengths, and the two legs of every angle, from the vectors in the scratch array."""
    for i in range(count):
        gx, gy, gz = s[_G, i], s[_G + 1, i], s[_G + 2, i]
        bx, by, bz = s[_B, i], s[_B + 1, i], s[_B + 2, i]
        level = gx * gx + gy * gy
        strength = np.sqrt(level + gz * gz)
        s[_ACROSS, i] = np.sqrt(level)
        s[_GRAVITY, i] = strength
        s[_FIELD, i] = np.sqrt(bx * bx + by * by + bz * bz)
        cross_x, cross_y, cross_z = gy * bz - gz * by, gz * bx - gx * bz, gx * by - gy * bx
        s[_EAST, i] = cross_z * strength
        s[_NORTH, i] = bz * level - gz * (gx * bx + gy * by)
        s[_DOWN, i] = gx * bx + gy * by + gz * bz
        s[_CROSS, i] = np.sqrt(cross_x * cross_x + cross_y * cross_y + cross_z * cross_z)


@compiled
def angles(s: Array, count: int) -> None:
    """The five angles in degrees; NaN where a direction does not exist."""
    for i in range(count):
        s[_INC, i] = DEGREES_PER_RADIAN * angle(s[_ACROSS, i], s[_G + 2, i])
    for i in range(count):
        turn = angle(s[_EAST, i], s[_NORTH, i])
        s[_AZI, i] = DEGREES_PER_RADIAN * (turn + FULL_TURN if turn < 0.0 else turn)
    for i in range(count):
        turn = angle(-s[_G, i], -s[_G + 1, i])
        s[_FACE, i] = DEGREES_PER_RADIAN * (turn + FULL_TURN if turn < 0.0 else turn)
    for i in range(count):
        s[_DIP, i] = DEGREES_PER_RADIAN * angle(s[_DOWN, i], s[_CROSS, i])
    for i in range(count):
        turn = angle(s[_B, i], s[_B + 1, i])
        s[_MAGNETIC, i] = DEGREES_PER_RADIAN * (turn + FULL_TURN if turn < 0.0 else turn)
    for i in range(count):
        still = s[_GRAVITY, i] == 0.0
        quiet = s[_FIELD, i] == 0.0
        vertical = s[_ACROSS, i] <= VERTICAL * s[_GRAVITY, i]
        s[_INC, i] = np.nan if still else s[_INC, i]
        s[_FACE, i] = np.nan if still | vertical else s[_FACE, i]
        s[_AZI, i] = np.nan if still | quiet | vertical else s[_AZI, i]
        s[_DIP, i] = np.nan if still | quiet else s[_DIP, i]
        s[_MAGNETIC, i] = np.nan if quiet else s[_MAGNETIC, i]


@compiled
def load(
    s: Array, row: int, column: AnyArray, start: int, count: int, unit: float, accepted: Floats
) -> int:
    """Copy a piece of a column, in its unit, into a scratch row; the number of values accepted."""
    sound = 0
    for i in range(count):
        value = column[start + i]
        sound += (value >= accepted[0]) & (value <= accepted[1])
        s[row, i] = value / unit
    return sound


@compiled
def mask(s: Array, count: int, low: float, high: float, blank: bool, last: int) -> int:
    """Number of rows whose temperature is beyond low…high; their results become NaN if asked."""
    beyond = 0
    for i in range(count):
        beyond += (s[_T, i] < low) | (s[_T, i] > high)
    if blank and beyond:
        for i in range(count):
            if (s[_T, i] < low) | (s[_T, i] > high):
                s[1 : last + 1, i] = np.nan
    return beyond


@compiled
def rows(
    columns: tuple[Channels, Channels, AnyArray],
    units: Floats,
    limits: tuple[Floats, Floats, Floats, bool],
    reference: float,
    triads: tuple[Triad, Triad],
    out: Array,
    start: int,
    stop: int,
) -> tuple[int, int, int]:
    """Fill rows start…stop of `out`; unsound cells, rows beyond the temperatures, NaN results.

    See `correction_numba.run`. `limits`: accepted raw values, accepted and calibrated temperatures,
    and whether results beyond these become NaN.
    """
    s = np.empty((_ROWS, TILE))
    last = len(out)
    gravity, magnetic, temperature = columns
    raw, bearable, (low, high), blank = limits
    sound, beyond, empty = 0, 0, 0
    for at in range(start, stop, TILE):
        count = min(TILE, stop - at)
        sound += load(s, _T, temperature, at, count, 1.0, bearable)
        for k in range(3):
            sound += load(s, _G + k, gravity[k], at, count, units[k], raw)
            sound += load(s, _B + k, magnetic[k], at, count, units[3 + k], raw)
        tau = s[_TAU]
        for i in range(count):
            tau[i] = s[_T, i] - reference
        field(tau, s[_G], s[_G + 1], s[_G + 2], count, triads[0])
        field(tau, s[_B], s[_B + 1], s[_B + 2], count, triads[1])
        if last > 6:
            parts(s, count)
            angles(s, count)
        beyond += mask(s, count, low, high, blank, last)
        for k in range(last):
            for i in range(count):
                value = s[k + 1, i]
                empty += value != value
                out[k, at + i] = value
    return 7 * (stop - start) - sound, beyond, empty


def check_kept() -> bool:
    """Whether the machine code kept on disk is as it was written; what is not is removed.

    Damaged machine code would end the process. Code without checksums, of a process that still
    compiles or was interrupted, is removed as well, and counts as sound.
    """
    kept = _kept()
    try:
        written = json.loads(_checksums().read_text("utf-8"))
    except OSError:
        written = {}
    except ValueError:
        written = None
    if written != kept:
        for name in kept:
            with contextlib.suppress(OSError):
                (_folder() / name).unlink()
    return written in (kept, {})


@cache
def write_checksums(compiled: int) -> None:
    """Write the checksums of the machine code on disk: once after so many compilations."""
    if compiled and _folder().is_dir():
        with contextlib.suppress(OSError):  # then it is compiled again next time
            temporary = _checksums().with_suffix(f".{os.getpid()}")
            temporary.write_text(json.dumps(_kept()), "utf-8")
            temporary.replace(_checksums())


def compilations() -> int:
    """How often loops had to be compiled in this process, for want of machine code on disk."""
    return sum(cast(Any, rows).stats.cache_misses.values())


def _folder() -> Path:
    return Path(cast(Any, rows).stats.cache_path or os.devnull)


def _checksums() -> Path:
    return _folder() / f"correction_kernels.{_VERSION}.json"


def _kept() -> dict[str, str]:
    """SHA-256 of the files that Numba keeps for this module and this Python."""
    files = _folder().glob(f"correction_kernels.*.{_VERSION}.*nb[ic]")
    return {p.name: sha256_of(p) for p in sorted(files)}
