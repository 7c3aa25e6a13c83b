"""Members of a batch: some of them taken out of nested dataclasses of arrays, and put back.

Every array in a batch has a leading axis of members, one for each tool. Whatever is not an array
is common to all of them: names, orders, flags.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any, TypeVar

import numpy as np

from mwdcal.geometry.vectors import AnyArray, Ints

_T = TypeVar("_T")


def take(batch: _T, index: Ints | slice) -> _T:
    """The members at `index`, as a batch of their own."""
    members: _T = mapped(lambda array: array[index], batch)
    return members


def put(batch: _T, index: Ints, members: _T) -> _T:
    """A copy of a batch with other `members` at `index`."""

    def placed(ours: AnyArray, theirs: AnyArray) -> AnyArray:
        changed = ours.copy()
        changed[index] = theirs
        return changed

    changed: _T = mapped(placed, batch, members)
    return changed


def join(batches: Sequence[_T]) -> _T:
    """The members of batches of one kind as one batch."""
    if len(batches) == 1:
        return batches[0]
    whole: _T = mapped(lambda *arrays: np.concatenate(arrays), *batches)
    return whole


def kind_of(batch: Any) -> Any:
    """The common part of batches to be joined: all that is not an array, and the shapes of members."""
    if isinstance(batch, np.ndarray):
        return batch.shape[1:]
    if isinstance(batch, Mapping):
        return tuple((key, kind_of(value)) for key, value in batch.items())
    if isinstance(batch, tuple):
        return tuple(kind_of(part) for part in batch)
    names = _names(batch.__class__)
    return tuple(kind_of(getattr(batch, name)) for name in names) if names else batch


def batch_of_one(member: _T) -> _T:
    """A batch whose only member is one without a leading axis."""
    batch: _T = mapped(lambda array: array[None], member)
    return batch


def mapped(change: Callable[..., AnyArray], *trees: Any) -> Any:
    """A tree of dataclasses, mappings and tuples with every array changed.

    `change` is given the arrays at one place of all trees; what is not an array is that of the
    first. Fields that a constructor does not take are not carried over.
    """
    tree = trees[0]
    if isinstance(tree, np.ndarray):
        return change(*trees)
    if isinstance(tree, Mapping):
        return {key: mapped(change, *(each[key] for each in trees)) for key in tree}
    if isinstance(tree, tuple):
        return tuple(mapped(change, *parts) for parts in zip(*trees, strict=True))
    names = _names(tree.__class__)
    if not names:
        return tree
    parts = {name: mapped(change, *(getattr(each, name) for each in trees)) for name in names}
    return type(tree)(**parts)


@cache
def _names(kind: type) -> tuple[str, ...]:
    """What the constructor of a dataclass takes; nothing for any other type."""
    return tuple(f.name for f in fields(kind) if f.init) if is_dataclass(kind) else ()
