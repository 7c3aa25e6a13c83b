"""Allan deviations against allantools: the same record, the same octaves of averaging."""

from __future__ import annotations

from functools import partial

import numpy as np
from measuring import Row, against

from mwdcal.logs.allan import deviation, octaves

COUNT = 2**18
"""Samples of a record: 44 minutes at 100 Hz."""
KINDS = {"standard": "adev", "overlapping": "oadev", "modified": "mdev"}


def rows(count: int = COUNT) -> list[Row]:
    """Standard, overlapping and modified deviation of one channel."""
    import allantools

    rng = np.random.default_rng(100)
    values = 1e-3 * rng.normal(size=count) + 1e-6 * np.cumsum(rng.normal(size=count))
    factors, found = octaves(count)[:-1], []
    for kind, name in KINDS.items():
        ours = partial(deviation, values, factors, kind)
        theirs = partial(getattr(allantools, name), values, 1.0, "freq", factors)
        apart = np.max(np.abs(theirs()[1] / ours() - 1))
        word = f"allantools {name}"
        same = {
            word: f"relative difference at most {apart:.0e}"
            if apart
            else "the same to the last digit"
        }
        label = f"{kind} deviation, {count} samples"
        found += against(label, ours, {word: theirs}, same)
    return found
