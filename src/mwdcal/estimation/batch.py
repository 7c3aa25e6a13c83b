"""Members of a batch: some of them taken out of nested dataclasses of arrays, and put back.

Every array in a batch has a leading axis of members, one for each tool. Whatever is not an array
is common to all of them: names, orders, flags. An array whose members are equal may be held once
(`held_once`): a view that repeats its first, from which no work on it needs more.
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

    def taken(array: AnyArray) -> AnyArray:
        if not isinstance(index, np.ndarray) or 0 not in array.strides:
            return array[index]
        if is_once(array):
            count = len(index)
            return array[:count] if count <= len(array) else repeated(array, count)
        return np.broadcast_to(_compact(array)[index], (len(index), *array.shape[1:]))

    members: _T = mapped(taken, batch)
    return members


def held_once(batch: _T) -> _T:
    """A batch in which arrays whose members are equal are held once."""

    def held(array: AnyArray) -> AnyArray:
        if is_once(array):
            return array
        equal = (
            len(array) and _same(array[-1], array[0]) and _same(array, repeated(array, len(array)))
        )
        return repeated(array, len(array)) if equal else array

    same: _T = mapped(held, batch)
    return same


def is_once(*arrays: AnyArray) -> bool:
    """Whether all arrays are held once."""
    return all(array.strides[0] == 0 for array in arrays)


def repeated(array: AnyArray, count: int) -> AnyArray:
    """The first member of an array as that of so many equal ones, held once."""
    return np.broadcast_to(array[:1], (count, *array.shape[1:]))


def for_all(work: Callable[..., AnyArray], *arrays: AnyArray) -> AnyArray:
    """An array worked out from others; of the first member alone where these are held once."""
    if not is_once(*arrays):
        return work(*arrays)
    return repeated(work(*(array[:1] for array in arrays)), len(arrays[0]))


def put(batch: _T, index: Ints, members: _T) -> _T:
    """A copy of a batch with other `members` at `index`."""

    def placed(ours: AnyArray, theirs: AnyArray) -> AnyArray:
        if _same_once(ours, theirs):
            return ours
        changed = ours.copy()
        changed[index] = theirs
        return changed

    changed: _T = mapped(placed, batch, members)
    return changed


def join(batches: Sequence[_T]) -> _T:
    """The members of batches of one kind as one batch."""
    if len(batches) == 1:
        return batches[0]

    def joined(*arrays: AnyArray) -> AnyArray:
        if _same_once(*arrays):
            return repeated(arrays[0], sum(map(len, arrays)))
        if is_once(*arrays) or len({tuple(map(bool, array.strides)) for array in arrays}) > 1:
            return np.concatenate(arrays)
        whole = np.concatenate([_compact(array) for array in arrays])
        return np.broadcast_to(whole, (len(whole), *arrays[0].shape[1:]))

    whole: _T = mapped(joined, *batches)
    return whole


def _same_once(*arrays: AnyArray) -> bool:
    """Whether arrays are held once, and equal."""
    first = arrays[0][:1]
    return is_once(*arrays) and all(_same(array[:1], first) for array in arrays[1:])


def _same(one: AnyArray, other: AnyArray) -> bool:
    """Whether arrays are equal; NaN equals NaN."""
    if one.shape != other.shape:
        return False
    differ = one != other
    return not differ.any() or bool(np.all((one != one) & (other != other) | ~differ))


def _compact(array: AnyArray) -> AnyArray:
    """An array with one element along the axes that a view of it repeats."""
    return array[tuple(slice(None if stride else 1) for stride in array.strides)]


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
    """Arguments of a dataclass's constructor; nothing for any other type."""
    return tuple(f.name for f in fields(kind) if f.init) if is_dataclass(kind) else ()
