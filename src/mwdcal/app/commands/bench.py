"""`mwdcal bench`: a calibration session at the stand, live, in the browser."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import click

from mwdcal.app.commands import options
from mwdcal.errors import InputError


@options.command()
@click.option(
    "--demo",
    is_flag=True,
    help="A simulated tool on a simulated stand, which goes where the page tells it.",
)
@click.option(
    "--plan",
    metavar="NAME|FILE",
    shell_complete=options.offers("plans"),
    help="A built-in plan, a TOML file of attitudes, a run file, best-N, the best N stations for the tool, or "
    "azimuth_deg=0.05, the fewest stations for this accuracy.  "
    "[default: twenty-four-state]",
)
@options.tool(help="Tool profile: a built-in name or a TOML file.  [default: servo]")
@click.option(
    "--source",
    metavar="SPEC",
    help="Where readings come from: serial:/dev/ttyUSB0@115200, tcp:HOST:PORT, tail:FILE, manual, or demo. "
    " [default: manual]",
)
@click.option(
    "--session",
    type=options.FILE,
    metavar="DIR",
    help="Folder of the session; one that was begun before goes on, with its options.  [default: a new one by date "
    "and time]",
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
    "--countersign",
    type=options.FILE,
    metavar="KEY",
    help="Private key with which a second person signs the certificate, on the page.",
)
@click.option(
    "--host",
    default="127.0.0.1",
    show_default=True,
    help="Address to listen at; 0.0.0.0 for a tablet at the stand, in the laboratory's network.",
)
@click.option(
    "--port",
    type=options.Whole(0, 65535),
    default=0,
    show_default="a free one",
    help="Port to listen at.",
)
@click.option("--no-browser", is_flag=True, help="Do not open the browser.")
@click.option(
    "--speed",
    type=options.Within(0.1, 1000),
    metavar="X",
    help="How many times as fast as real time the simulated stand goes.  [default: 1]",
)
@click.option(
    "--settle",
    type=options.Within(0.5, 600),
    metavar="S",
    help="How long, in seconds, the tool has to stand still for a station.  [default: 5]",
)
def command(
    demo: bool, session: Path | None, host: str, port: int, no_browser: bool, **chosen: object
) -> None:
    """Calibrate a tool live: the page says where to turn it, takes the stations, and ends with the certificate.

    The first line printed is the address of the page, with its token. Nothing leaves this machine. The folder of the
    session holds run.csv, rolltest.csv, tool.toml, tool.json and the documents; what was accepted survives a power cut.

    \b
    Example: mwdcal bench --demo
    Example: mwdcal bench --tool tool.toml --plan moosavi-12 --source serial:/dev/ttyUSB0@115200 --session S-117
    Exit: 0 ended, 2 input cannot be read.
    """
    from mwdcal.app.laboratory import line_on
    from mwdcal.bench import serving
    from mwdcal.files.formats import atomic
    from mwdcal.files.profiles import in_use

    serving.require()
    given = {name: value for name, value in chosen.items() if value is not None}
    given |= {name: str(given[name]) for name in ("laboratory", "countersign") if name in given}
    given |= {"source": "demo"} if demo else {}
    folder = session or Path(datetime.now().strftime("bench-%Y-%m-%d-%H%M%S"))
    with atomic.folder(folder), atomic.holding(folder / ".bench.lock") as ours:
        if not ours:
            raise InputError(
                f"another bench has the session '{folder}' open. Close it, or name another folder with --session."
            )
        opened = serving.listening(host, port)
        port = opened.getsockname()[1]
        bench = serving.bench_of(folder, given, host, port)
        if used := in_use():
            bench.session.settings_used = line_on(used)
        url = serving.address(host, port, bench.token)
        click.echo(url)
        click.echo(
            f"session {folder}   Ctrl-C ends; mwdcal bench --session {folder} goes on", err=True
        )
        if bench.session.settings_used:
            click.echo(bench.session.settings_used, err=True)
        serving.serve(bench, opened, "" if no_browser else url)
