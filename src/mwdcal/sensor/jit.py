"""The one way to machine code: imported by modules of compiled loops alone. Needs Numba."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

from numba import njit

_F = TypeVar("_F", bound=Callable[..., object])


def compiled(function: _F) -> _F:
    """The function as machine code, kept on disk where a folder for it can be written.

    Arithmetic is plain IEEE, and division by zero is no exception: a result is the same bytes from
    code compiled just now and from code kept on disk, and no member of a batch stops the others.
    """
    try:
        made = njit(nogil=True, cache=True, error_model="numpy")(function)
    except RuntimeError:  # no such folder
        made = njit(nogil=True, error_model="numpy")(function)
    return cast(_F, made)
