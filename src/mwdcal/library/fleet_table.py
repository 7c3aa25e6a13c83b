"""A table of many tools to a table of calibrations, in parts that are kept."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import msgspec

from mwdcal import pool
from mwdcal.calibration.automatic.auto import with_strengths
from mwdcal.calibration.diagnosis.findings import unused_columns
from mwdcal.calibration.diagnosis.refusals import check_options, no_temperature
from mwdcal.calibration.fit_options import FitArguments, stated_arguments
from mwdcal.calibration.methods import check_stand_errors
from mwdcal.calibration.options import Options
from mwdcal.calibration.prior import DATASHEET, profile_for
from mwdcal.digests import sha256_of
from mwdcal.errors import InputError, reason
from mwdcal.files import profiles, synonyms
from mwdcal.files.formats import atomic, parquet
from mwdcal.files.formats.members import RECORD
from mwdcal.fleet import kept
from mwdcal.fleet.parts import Plan, Task, load, solve
from mwdcal.fleet.sources import SERIAL, FleetTable, check_unchanged, open_source
from mwdcal.fleet.tables import (
    Tools,
    close_rows,
    find_tools,
    in_several_folders,
    partitions,
)
from mwdcal.presentation.envelope import json_document
from mwdcal.presentation.fleet import FleetSummary, summarise
from mwdcal.presentation.text import plural, slowly
from mwdcal.sensor.profile import Profile
from mwdcal.use.correction_numba import cores

RECORDED = 500
"""Most tools of a fleet whose table holds their whole calibrations unless asked otherwise."""
EVERY = 5.0
"""Seconds between two lines of progress."""
NEEDED_AT_THE_END = ("pyarrow.compute", "rich.console", "rich.table")
"""Modules that are loaded before, as nothing else is left to do then."""


def calibrate_table(
    runs: Path,
    output: Path,
    tool: Profile | str | None,
    options: Options,
    typed: FitArguments,
    workers: int | None,
    scheduler: str | None,
    records: bool | None,
    say: Callable[[str], None],
) -> FleetSummary:
    """Calibrate every tool of the table; the output is written at the end, as a whole.

    `tool`: its profile, or the name or file of one. `options` are those that were `typed`. `workers`: processes, one
    per core if None, or else those of a Dask `scheduler`. `records`: whether the table holds the whole calibration
    of each tool; by default that of a few. `say` hears how far it is.
    """
    begun = time.perf_counter()
    profile, digest = (tool, "") if isinstance(tool, Profile) else profiles.load_profile(tool)
    options = _checked(options, profile)
    source = open_source(runs, profile, slowly(say, EVERY))
    if max(options.orders) and "temperature_c" not in source.columns:
        raise no_temperature(max(options.orders))
    unused = unused_columns(synonyms.unused(source.columns, source.used))
    target = atomic.target(output)
    _check_target(target, runs)
    with _place_of_parts(target, output) as folder:
        tools = find_tools(source)
        plan = Plan.of(source, profile, options)
        if records or (records is None and tools.count <= RECORDED):
            plan = _with_records(plan, digest, runs)
        steps = pool.Steps(partial(load, plan), partial(solve, plan))
        whole = partitions(source, tools, folder, say)
        parts = {folder / f"{plan.key(part)}.arrow": part for part in whole}
        done = _finished(parts, tools, source, say)
        tasks = [Task(part, path) for path, part in parts.items() if path not in done]
        computing = _computed(pool.results(steps, tasks, workers or cores(), scheduler), tasks, say)
        with contextlib.closing(computing) as computed:
            tables = _in_order(parts, done, computed)
            _merge(tables, target, _metadata(source, plan, typed, digest), source)
    return summarise(
        target,
        typed,
        notes=[*source.notes, *in_several_folders(source, tools)],
        runs=runs.name,
        output=str(output),
        stations=source.stations,
        parts=len(parts),
        parts_done_before=len(done),
        seconds=round(time.perf_counter() - begun, 3),
        unused=unused,
    )


def _with_records(plan: Plan, profile_sha256: str, runs: Path) -> Plan:
    """The plan with the whole calibration of each tool, which states where it comes from."""
    runs_sha256 = ""
    if runs.is_file():
        with runs.open("rb") as stream:
            runs_sha256 = sha256_of(stream)
    return replace(plan, records=True, profile_sha256=profile_sha256, runs_sha256=runs_sha256)


@contextlib.contextmanager
def _place_of_parts(target: Path, output: Path) -> Iterator[Path]:
    """The folder of finished parts: of one command as long as it lives, and tidied where that succeeds."""
    folder = target.with_name(target.name + ".parts")
    kept.check_folder(folder)
    with atomic.holding(folder / kept.LOCK) as ours:
        if not ours:
            raise InputError(
                f"cannot write '{output}': another fleet is writing this output. Wait for it, or choose "
                "another -o."
            )
        yield folder
        close_rows()  # the dealt rows: Windows removes no open file
        atomic.sweep(folder)
        kept.remove(folder)


def _finished(
    paths: Collection[Path], tools: Tools, source: FleetTable, say: Callable[[str], None]
) -> set[Path]:
    """The parts that were done before; says how many there are, and are to do again."""
    done, damaged = kept.finished(paths)
    fleet = f"{plural(tools.count, 'tool')}, {plural(source.stations, 'station')}"
    say(f"{fleet}, {plural(len(paths), 'part')}, {len(done)} done before")
    if damaged:
        say(f"! {plural(damaged, 'part')} done before, but damaged: computed again")
    return done


def _metadata(
    source: FleetTable, plan: Plan, typed: FitArguments, digest: str
) -> dict[str, object]:
    """The statements of the table of calibrations about itself: the input's own, and how it was made."""
    metadata = {k: v for k, v in source.metadata.items() if k != SERIAL}
    content = {
        "fleet": source.name,
        "options": stated_arguments(typed),
        "profile": plan.profile.name,
        "reference_temperature_c": plan.profile.reference_temperature_c,
        "noise_estimated": list(plan.noise_estimated),
    }
    return {**metadata, **json_document("fleet", content, metadata, profile=digest)}


def prior_of_fleet(word: str | None) -> Literal["datasheet"] | None:
    """The prior of a fleet: the tolerances in the tool profile, or nothing; refuses that of a single tool."""
    if word not in (None, DATASHEET):
        raise InputError(
            f"`prior` {word}: the prior of a fleet is 'datasheet', the tolerances in the tool "
            "profile. A previous calibration is of one tool: use it with mwdcal calibrate."
        )
    return DATASHEET if word else None


def _checked(options: Options, profile: Profile) -> Options:
    """Options of the fleet with the strengths of the profile; refuses what could be right for no tool."""
    options = with_strengths(options, profile)
    profile_for(options.prior, profile)
    check_stand_errors(options.estimate, options.method)
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


def _computed(
    results: Iterator[tuple[int, None]], tasks: Sequence[Task], say: Callable[[str], None]
) -> Generator[Path, None, None]:
    """The parts that are missing, one by one as workers have written them."""
    if not tasks:
        return
    begun, tools, say_slowly = time.perf_counter(), 0, slowly(say, EVERY)
    for name in NEEDED_AT_THE_END:  # while the workers start: later it would be waited for
        import_module(name)
    disk = ThreadPoolExecutor(1)  # the next part is computed while one goes to the disk
    try:
        for count, (index, _) in enumerate(results, 1):
            task = tasks[index]
            check_unchanged(task.partition.pieces)
            disk.submit(kept.to_disk, task.path)
            tools += task.partition.tools
            rate = tools / (time.perf_counter() - begun)
            say_slowly(f"part {count} of {len(tasks)}   {rate:.0f} tools/s")
            yield task.path
    except InputError:
        check_unchanged(
            piece for task in tasks for piece in task.partition.pieces
        )  # if that is why
        raise
    finally:
        disk.shutdown(cancel_futures=True)


def _in_order(paths: Iterable[Path], done: set[Path], computed: Iterator[Path]) -> Iterator[Any]:
    """The tables of all parts, each when it and all before it are done, while workers go on with others."""
    arrow, _ = parquet.modules("fleet")
    ready = set(done)
    for path in paths:
        while path not in ready:
            ready.add(next(computed))
        content = kept.read_part(path)
        if content is None:
            raise InputError(
                f"'{path}': the finished part was changed or removed. Run the same command again: it is "
                "computed anew."
            )
        yield arrow.ipc.open_stream(content).read_all()
    ready.update(computed)  # to its end, with that of the workers


def _merge(
    parts: Iterator[Any], target: Path, metadata: dict[str, object], source: FleetTable
) -> None:
    """One Parquet table of all parts; one part in memory at a time."""
    arrow, pq = parquet.modules(target.name)
    described = {parquet.KEY: msgspec.json.encode(metadata, enc_hook=str)}
    writer = None
    with atomic.replacing(target) as stream:
        try:
            for part in parts:
                if writer is None:
                    schema = part.schema.with_metadata(described)
                    texts = [
                        f.name
                        for f in schema
                        if not arrow.types.is_floating(f.type) and f.name != RECORD
                    ]
                    packing = {n: "zstd" if n == RECORD else "snappy" for n in schema.names}
                    writer = pq.ParquetWriter(
                        stream.name, schema, use_dictionary=texts, compression=packing
                    )
                writer.write_table(part.cast(writer.schema))
            parquet.close(writer)
        except OSError as error:
            raise InputError(
                f"cannot write '{target}': {reason(error)}. Finished parts are kept: make "
                "room, or choose another place, and run the same command again."
            ) from error
        finally:
            with contextlib.suppress(OSError):
                parquet.close(writer)
        check_unchanged(source.pieces)
