"""What processes of our own do without."""

from __future__ import annotations

import sys


class WithoutPandas:
    """An import finder by which pandas is not installed.

    PyArrow loads pandas, where there is one, at the first array that it makes. That takes a
    quarter of a second, and mwdcal has no use for it.
    """

    def find_spec(self, name: str, path: object = None, target: object = None) -> None:
        """Refuse pandas, and leave all other modules to the finders that follow."""
        if name == "pandas":
            raise ModuleNotFoundError("mwdcal does without pandas", name=name)


def without_pandas() -> None:
    """To be called by processes that are ours alone: a command's own, and its workers."""
    sys.meta_path.insert(0, WithoutPandas())
