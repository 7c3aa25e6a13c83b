"""A bench opened on a folder, and served until it is stopped."""

from __future__ import annotations

import contextlib
import json
import socket
import webbrowser
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mwdcal
from mwdcal import extras
from mwdcal.bench.journal import JOURNAL_NAME
from mwdcal.bench.opening import TOOL_FILE, rolltest_plan, session_plan, tools_in
from mwdcal.bench.positions import SessionPlan
from mwdcal.bench.session import BenchSession
from mwdcal.bench.simulated import DemoStand
from mwdcal.bench.sources import source_of
from mwdcal.errors import InputError
from mwdcal.files.formats import atomic
from mwdcal.files.profiles import read_toml

if TYPE_CHECKING:
    from mwdcal.bench.server import Bench

DEFAULTS: Mapping[str, Any] = {
    "plan": "twenty-four-state", "tool": "servo", "source": "manual", "speed": 1.0, "settle": 5.0,
    "registry": None, "laboratory": None, "countersign": None,
}  # fmt: skip
"""Options of a bench that nothing states."""
EVERYWHERE = ("0.0.0.0", "::")
"""Hosts that are all addresses of the machine."""


def require() -> None:
    """Refuse to serve without the libraries that serve, which the extra `bench` installs."""
    for name in ("starlette", "uvicorn", "jinja2"):
        extras.load(name, "the bench", "bench")


def bench_of(folder: Path, given: Mapping[str, Any], host: str, port: int) -> Bench:
    """The bench of a folder. Options that are not `given` are those of the session there, if it was begun before.

    A tool profile that lies there already is that of the session.
    """
    require()
    from mwdcal.bench.server import Bench

    before = _options_before(folder)
    options = {**DEFAULTS, **before, **given}
    demo = options["source"] == "demo"
    if before and demo != (before["source"] == "demo"):
        raise InputError(
            f"session '{folder}' was begun with source '{before['source']}'. Simulated and real readings do not mix: "
            "name another folder."
        )
    path = folder / TOOL_FILE
    if not path.exists():
        data, _ = read_toml(str(options["tool"]), "profiles", "tool profile")
        atomic.write(path, data)
    profile = mwdcal.load_profile(path)
    stand = DemoStand(profile, float(options["speed"])) if demo else None
    source = stand or source_of(str(options["source"]))
    plan = SessionPlan("", {}) if before else session_plan(profile, options["plan"])
    registry, files = (
        options["registry"],
        {name: _path(options[name]) for name in ("laboratory", "countersign")},
    )
    session = BenchSession(
        folder, profile, plan, rolltest_plan(), window=float(options["settle"]), registry=registry,
        earth=stand.earth if stand else None, options=options, tools=tools_in(registry), **files,
    )  # fmt: skip
    if stand:
        stand.order = partial(_order, session)
    names = [host, "localhost", "127.0.0.1", "[::1]", *([f"[{host}]"] if ":" in host else [])]
    return Bench(
        session, source, [f"{name}:{port}" for name in names], any_address=host in EVERYWHERE
    )


def _path(name: object) -> Path | None:
    return Path(str(name)) if name else None


def _options_before(folder: Path) -> dict[str, Any]:
    """The options of a session that was begun in a folder; none if none was."""
    try:
        with (folder / JOURNAL_NAME).open("rb") as stream:
            event = json.loads(stream.readline())
        return dict(event["options"])
    except (OSError, ValueError, KeyError, TypeError):  # the journal says what is wrong
        return {}


def _order(session: BenchSession) -> tuple[tuple[float, float, float] | None, int]:
    """Where the simulated stand is to go, and the number of the attempt."""
    if session.waiting or (order := session.order) is None:
        return None, -1
    return session.part.attitude(order), session.attempts


def listening(host: str, port: int) -> socket.socket:
    """A socket that listens."""
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        opened = socket.socket(family, socket.SOCK_STREAM)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        opened.bind((host, port))
        opened.listen(128)  # a browser that is faster than the server waits
        return opened
    except OSError as error:
        raise InputError(
            f"cannot listen at host {host}, port {port}: {error.strerror}. Choose another host or port."
        ) from error


def address(host: str, port: int, token: str) -> str:
    """The address of the page, as a browser takes it."""
    if host in EVERYWHERE:
        host = _local_address()
    return f"http://{f'[{host}]' if ':' in host else host}:{port}/?token={token}"


def _local_address() -> str:
    """This machine's address in its network. The socket only looks up a route: it sends nothing."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
            return str(probe.getsockname()[0])
        except OSError:
            return "127.0.0.1"


def serve(bench: Bench, opened: socket.socket, url: str) -> None:
    """Serve until Ctrl-C. A `url` is opened in the browser."""
    import uvicorn

    if url:
        webbrowser.open(url)
    config = uvicorn.Config(
        bench.app(), log_level="warning", access_log=False, timeout_graceful_shutdown=2
    )
    with contextlib.suppress(KeyboardInterrupt):  # the usual end
        uvicorn.Server(config).run(sockets=[opened])
