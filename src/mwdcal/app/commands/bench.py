"""`mwdcal bench`: a calibration session at the stand, live, in the browser."""

from __future__ import annotations

import socket
from datetime import datetime
from pathlib import Path

import click

from mwdcal.app.commands import options
from mwdcal.errors import InputError

LOCAL = "127.0.0.1"


@options.command()
@click.option(
    "--demo",
    is_flag=True,
    help="A simulated tool on a simulated stand, which goes where the page tells it.",
)
@click.option(
    "--plan",
    default="twenty-four-state",
    show_default=True,
    metavar="NAME|FILE",
    shell_complete=options.offers("plans"),
    help="A built-in plan, a TOML file of attitudes, or a run file.",
)
@options.tool(default="servo", show_default=True)
@click.option(
    "--source",
    metavar="SPEC",
    help="Where readings come from: serial:/dev/ttyUSB0@115200, tcp:HOST:PORT, tail:FILE, manual, or demo. "
    "[default: manual]",
)
@click.option(
    "--session",
    type=options.FILE,
    metavar="DIR",
    help="Folder of the session; one that was begun before goes on. [default: a new one by date and time]",
)
@options.renamed(
    "--registry",
    old=("--database",),
    metavar="FILE|URL",
    help="Registry in which the end is entered.",
)
@click.option(
    "--laboratory",
    type=options.FILE,
    metavar="LAB.toml",
    help="Laboratory file of the certificate.",
)
@click.option(
    "--host",
    default=LOCAL,
    show_default=True,
    help="Address to listen at: that of the laboratory's network for a tablet at the stand.",
)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=0,
    show_default="a free one",
    help="Port to listen at.",
)
@click.option("--no-browser", is_flag=True, help="Do not open the browser.")
@options.preset(
    "--speed",
    type=click.FloatRange(0.1, 1000),
    default=1.0,
    metavar="X",
    help="How many times as fast the simulated stand goes.",
)
@options.preset(
    "--settle",
    type=click.FloatRange(0.5, 600),
    default=5.0,
    metavar="S",
    help="How long the tool has to stand still for a station.",
)
def command(
    demo: bool, plan: str, tool: str, source: str | None, session: Path | None, registry: str | None, laboratory: Path | None,
    host: str, port: int, no_browser: bool, speed: float, settle: float,
) -> None:  # fmt: skip
    """Calibrate a tool live: the page says where to turn it, takes the stations, and ends with the certificate.

    The first line printed is the address of the page, with its token. Nothing leaves this machine. The folder of the
    session holds run.csv, rolltest.csv, tool.toml, tool.json and the documents; what was accepted survives a power cut.

    \b
    Example: mwdcal bench --demo
    Example: mwdcal bench --tool tool.toml --plan moosavi-12 --source serial:/dev/ttyUSB0@115200 --session S-117
    Exit: 0 ended, 2 input cannot be read.
    """
    from mwdcal.bench.serving import opened, serve
    from mwdcal.files.formats import atomic

    spec = source or ("demo" if demo else "manual")
    folder = session or Path(datetime.now().strftime("bench-%Y-%m-%d-%H%M%S"))
    with atomic.folder(folder), atomic.holding(folder / ".bench.lock") as ours:
        if not ours:
            raise InputError(
                f"another bench has the session '{folder}' open. Close it, or name another folder with --session."
            )
        listening = _listening(host, port)
        bench = opened(
            folder,
            plan,
            tool,
            spec,
            registry,
            laboratory,
            speed,
            settle,
            host,
            listening.getsockname()[1],
        )
        click.echo(f"http://{_shown(host)}:{listening.getsockname()[1]}/?token={bench.token}")
        click.echo(
            f"session {folder}   Ctrl-C ends; mwdcal bench --session {folder} goes on", err=True
        )
        serve(bench, listening, browser=not no_browser)


def _shown(host: str) -> str:
    """A host as addresses write it."""
    return f"[{host}]" if ":" in host else host


def _listening(host: str, port: int) -> socket.socket:
    """A socket that listens."""
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        listening = socket.socket(family, socket.SOCK_STREAM)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind((host, port))
        return listening
    except OSError as error:
        raise InputError(
            f"cannot listen at {host}:{port}: {error.strerror}. Choose another --host or --port."
        ) from error
