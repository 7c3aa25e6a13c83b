"""Libraries that an extra of the package installs, and the command that installs them."""

from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from mwdcal.errors import InputError


def load(library: str, use: str, extra: str) -> Any:
    """The module of a library; `use` begins the sentence of the refusal: "a certificate as PDF".

    Raises:
        InputError: it is not installed; the message says what installs it.
    """
    try:
        return import_module(library)
    except ImportError as error:
        raise missing((error.name or library).split(".")[0], use, extra) from None


def missing(library: str, use: str, extra: str) -> InputError:
    """The refusal of a use whose library is not installed."""
    return InputError(
        f"{use} needs {library}, which is not installed. Install it with: {command(extra)}"
    )


def command(extra: str) -> str:
    """The command that installs an extra from where mwdcal itself came from.

    No index has a package of this name, or has one of somebody else: the command names the folder or the wheel,
    or PATH where they are not known or no longer there.
    """
    source = _source()
    if source is None:
        return (
            f'pip install "PATH[{extra}]", where PATH is the folder or the wheel of mwdcal that you '
            "installed from"
        )
    option, path = source
    return f'pip install {option}"{path}[{extra}]"'


@cache
def _source() -> tuple[str, Path] | None:
    """How and from where mwdcal was installed, as PEP 610 records it: `-e ` or nothing, and a path."""
    import json
    from importlib.metadata import PackageNotFoundError, distribution
    from urllib.parse import urlsplit
    from urllib.request import url2pathname

    try:
        written = distribution("mwdcal").read_text("direct_url.json")
    except PackageNotFoundError:
        return None
    stated = json.loads(written or "{}")
    address = urlsplit(stated.get("url", ""))
    path = Path(url2pathname(address.path))
    if address.scheme != "file" or not path.exists():
        return None
    return "-e " * stated.get("dir_info", {}).get("editable", False), path
