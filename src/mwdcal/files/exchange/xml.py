"""Text that XML can hold."""

import re

UNWRITABLE = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")
"""Characters that XML 1.0 has no way to write."""


def one_line(value: object) -> str:
    """A value as text of one line, without characters that XML cannot hold."""
    return " ".join(UNWRITABLE.sub(" ", str(value)).split())


def lines(text: str) -> str:
    """Text with its line breaks, without characters that XML cannot hold and without outer blanks."""
    return "\n".join(UNWRITABLE.sub(" ", text).splitlines()).strip()
