"""`mwdcal fleet`: a table of many tools to a table of calibrations, in parts that are kept."""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Callable, Generator, Iterator
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import msgspec

from mwdcal import __version__
from mwdcal.app import pool
from mwdcal.app.commands.choices import options_of, prior_of
from mwdcal.app.commands.fleet_options import Asked
from mwdcal.app.pages.fleet_summary import Summary, document, options_asked, summarise, text
from mwdcal.app.text import plural
from mwdcal.calibration.automatic.nonlinearity import with_strengths
from mwdcal.calibration.automatic.stand import check_names
from mwdcal.calibration.diagnosis.findings import unused_columns
from mwdcal.calibration.diagnosis.refusals import check_options, no_temperature
from mwdcal.calibration.options import Options
from mwdcal.calibration.prior import DATASHEET, profile_for
from mwdcal.errors import InputError
from mwdcal.files import profiles
from mwdcal.files.formats import atomic, parquet
from mwdcal.fleet.parts import Plan, is_whole, load, solve
from mwdcal.fleet.sources import SERIAL, Source, open_source
from mwdcal.fleet.tables import Partition, Tools, find_tools, in_several_folders, partitions
from mwdcal.sensor.profile import Profile
from mwdcal.use.correction_numba import cores

REFUSED = 3
"""Exit code where not a single tool could be calibrated."""
EVERY = 5.0
"""Seconds between two lines of progress."""


def run(asked: Asked, say: Callable[[str], None]) -> tuple[int, Any]:
    """Number of calibrated tools, and what to print: a document, or text."""
    report = asked["report"]
    if report:
        from mwdcal.app.pages.fleet_report import environment, write_report

        environment()
    found = calibrate_table(asked, say)
    if report:
        write_report(report, asked["output"], found)
    return found.sound, (document if asked["as_json"] else text)(found, report)


def calibrate_table(asked: Asked, say: Callable[[str], None]) -> Summary:
    """Calibrate every tool of the table; the output is written at the end, as a whole."""
    begun = time.perf_counter()
    profile, digest = profiles.load_profile(asked["tool"])
    options = _options(asked, profile)
    source = open_source(asked["runs"])
    if max(options.orders) and "temperature_c" not in source.columns:
        raise no_temperature(max(options.orders))
    unused = unused_columns(source.unused)
    for finding in unused:
        say(f"! {finding.text}")
    target = atomic.target(asked["output"])
    _check_target(target, asked["runs"])
    folder = target.with_name(target.name + ".parts")
    plan = Plan.of(source, profile, options)
    with _alone(folder, asked["output"]):
        tools = find_tools(source)
        if not tools.together:
            say("the rows of a tool are not together: dealing them into files of whole tools first")
        notes = [*source.notes, *_split(source, tools)]
        parts = partitions(source, tools, folder)
        paths = [folder / f"{plan.key(part)}.arrow" for part in parts]
        before = sum(map(is_whole, paths))
        counts = {"tool": tools.count, "station": source.rows, "part": len(parts)}
        counted = ", ".join(plural(count, noun) for noun, count in counts.items())
        say(f"{counted}, {before} done before")
        with contextlib.closing(_parts_made(plan, parts, paths, asked, say)) as made:
            _merge(paths, made, target, _metadata(source, plan, asked, digest))
        _tidy(folder)
        seconds = time.perf_counter() - begun
        return summarise(asked, target, source.rows, len(parts), before, seconds, notes, unused)


@contextlib.contextmanager
def _alone(folder: Path, output: Path) -> Iterator[None]:
    """Refuse a second command with the same output, as long as the first one lives."""
    with atomic.holding(folder / "lock") as ours:
        if not ours:
            raise InputError(
                f"cannot write '{output}': another fleet is writing this output. Wait for it, or choose "
                "another -o."
            )
        yield


def _metadata(source: Source, plan: Plan, asked: Asked, digest: str) -> dict[str, object]:
    """What the table of calibrations says of itself: the input's own, and how it was made."""
    return {
        **{k: v for k, v in source.metadata.items() if k != SERIAL},
        "fleet": source.name,
        "software": f"mwdcal {__version__}",
        "options": options_asked(asked),
        "profile": plan.profile.name,
        "profile_sha256": digest,
        "reference_temperature_c": plan.profile.reference_temperature_c,
        "noise_estimated": list(plan.noise_estimated),
    }


def _split(source: Source, tools: Tools) -> list[str]:
    """What to say of tools of which several folders have rows."""
    count = in_several_folders(source, tools)
    if not count:
        return []
    return [
        f"tools with rows in several folders: {count}. All rows of a serial are one run; where they are "
        "runs of their own, calibrate folder by folder."
    ]


def _options(asked: Asked, profile: Profile) -> Options:
    """Options of the fleet; refuses what could be right for no tool, and the prior of a single one."""
    if asked["prior"] not in (None, DATASHEET):
        raise InputError(
            f"--prior {asked['prior']}: the prior of a fleet is 'datasheet', the tolerances in the tool "
            "profile. A previous calibration is of one tool: use it with mwdcal calibrate."
        )
    options = with_strengths(options_of(asked, prior_of(asked["prior"])), profile)
    profile_for(options.prior, profile)
    check_names(options.estimate, options.method)
    check_options(options)
    return options


def _check_target(target: Path, runs: Path) -> None:
    """Refuse an output that is no Parquet file or would become part of the input."""
    if target.suffix.lower() != ".parquet":
        raise InputError(
            f"cannot write '{target}': a fleet's calibrations are a Parquet table. Name a file "
            "that ends in .parquet."
        )
    if runs.is_dir() and runs.resolve() in target.parents:
        raise InputError(
            f"cannot write '{target}': it would become part of the input folder. Name a file "
            "outside it."
        )


def _parts_made(
    plan: Plan,
    parts: list[Partition],
    paths: list[Path],
    asked: Asked,
    say: Callable[[str], None],
) -> Generator[Path, None, None]:
    """Do the parts that are not there yet, one by one; each is written when it is whole."""
    missing = [index for index, path in enumerate(paths) if not is_whole(path)]
    if not missing:
        return
    workers = asked["workers"] or cores()
    begun = told = time.perf_counter()
    tools = 0
    tasks = [parts[index] for index in missing]
    _load_what_the_end_needs()
    steps = pool.Steps(partial(load, plan), partial(solve, plan))
    found = pool.results(steps, tasks, workers, asked["scheduler"])
    for count, (index, content) in enumerate(found, 1):
        atomic.write(paths[missing[index]], content, durable=False)
        tools += tasks[index].tools
        now = time.perf_counter()
        if now - told > EVERY:
            told = now
            say(f"part {count} of {len(missing)}   {tools / (now - begun):.0f} tools/s")
        yield paths[missing[index]]


def _load_what_the_end_needs() -> None:
    """While the workers start: at the end nothing else is left to do, and it would be waited for."""
    for name in ("pyarrow.compute", "rich.console", "rich.table"):
        import_module(name)


def _merge(
    paths: list[Path], made: Iterator[Path], target: Path, metadata: dict[str, object]
) -> None:
    """One Parquet table of all parts, in their order; one part in memory at a time.

    A part is added when it and all before it are `made`, while workers go on with others.
    """
    arrow, pq = parquet.modules(target.name)
    described = {parquet.KEY: msgspec.json.encode(metadata, enc_hook=str)}
    writer = None
    with atomic.replacing(target) as stream:
        try:
            for path in paths:
                while not is_whole(path) and next(made, None):
                    continue
                with arrow.memory_map(str(path)) as file:
                    part = arrow.ipc.open_stream(file).read_all()
                    if writer is None:
                        schema = part.schema.with_metadata(described)
                        texts = [f.name for f in schema if not arrow.types.is_floating(f.type)]
                        writer = pq.ParquetWriter(stream.name, schema, use_dictionary=texts)
                    writer.write_table(part.cast(writer.schema))
            for _ in made:
                pass
            if writer is not None:
                writer.close()
        except OSError as error:
            raise InputError(
                f"cannot write '{target}': {error.strerror or error}. Finished parts are kept: make "
                "room, or choose another place, and run the same command again."
            ) from error


def _tidy(folder: Path) -> None:
    """Remove what was kept for a restart, and nothing that is not ours."""
    atomic.sweep(folder)
    for path in folder.glob("*.arrow"):
        path.unlink()
    for path in folder.glob("sorted-*"):
        shutil.rmtree(path)
