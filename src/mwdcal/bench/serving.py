"""A bench opened on a folder, and served until it is stopped."""

from __future__ import annotations

import contextlib
import socket
import webbrowser
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mwdcal
from mwdcal.bench.session import ROLLTEST, RUN, Session
from mwdcal.bench.simulated import DemoStand
from mwdcal.bench.sources import Source, source_of
from mwdcal.errors import InputError
from mwdcal.files.formats import atomic
from mwdcal.files.profiles import read_toml

if TYPE_CHECKING:
    from mwdcal.bench.server import Bench

TOOL = "tool.toml"


def require() -> None:
    """Refuse to serve without the libraries that serve, which the extra `bench` installs."""
    for name in ("starlette", "uvicorn", "jinja2"):
        try:
            import_module(name)
        except ImportError as error:
            raise InputError(
                f'the bench needs {error.name}, which is not installed. Install mwdcal[bench]: pip install "mwdcal[bench]"'
            ) from None


def opened(
    folder: Path, plan: str, tool: str, source: str, registry: str | None, laboratory: Path | None,
    speed: float, settle: float, host: str, port: int,
) -> Bench:  # fmt: skip
    """The bench of a folder. A tool profile that lies there already is that of the session."""
    require()
    from mwdcal.bench.server import Bench

    path = folder / TOOL
    if not path.exists():
        data, _ = read_toml(tool, "profiles", "tool profile")
        atomic.write(path, data)
    profile = mwdcal.load_profile(path)
    planned = mwdcal.plan(profile, plan=plan)
    plans: dict[str, Mapping[str, Any]] = {RUN: planned.columns, ROLLTEST: _rolltest()}
    demo = source == "demo"
    session: Session | None = None

    def order() -> tuple[tuple[float, float, float] | None, int]:
        if session is None or session.waiting or (where := session.part.order) is None:
            return None, -1
        if session.calibrated and not session.testing:
            return None, -1
        return session.part.attitude(where), session.attempts

    stand = DemoStand(profile, order, speed) if demo else None
    feed: Source = stand if stand is not None else source_of(source)
    session = Session(
        folder, profile, plans, source=source, window=settle, registry=registry, laboratory=laboratory,
        earth=stand.earth if stand else None, simulated=demo, plan_name=plan, expected=planned.accuracy_deg,
    )  # fmt: skip
    names = {host, "localhost", "127.0.0.1", "[::1]"} | ({f"[{host}]"} if ":" in host else set())
    return Bench(session, feed, tuple(f"{name}:{port}" for name in names))


def _rolltest() -> Mapping[str, Any]:
    """The positions of the roll test: one roll at 45°, at azimuth 0."""
    from mwdcal.library.planning import plan_table
    from mwdcal.library.results import arrays_of

    return arrays_of(plan_table("roll-test"))


def serve(bench: Bench, listening: socket.socket, browser: bool) -> None:
    """Serve until Ctrl-C."""
    import uvicorn

    host, port = listening.getsockname()[:2]
    if browser:
        webbrowser.open(
            f"http://{'127.0.0.1' if host == '0.0.0.0' else host}:{port}/?token={bench.token}"
        )
    config = uvicorn.Config(
        bench.app(), log_level="warning", access_log=False, timeout_graceful_shutdown=2
    )
    with contextlib.suppress(KeyboardInterrupt):  # the usual end
        uvicorn.Server(config).run(sockets=[listening])
