"""Records: many tools at once, certificates, signatures, and the registry of tools."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Any, Unpack
from weakref import finalize

import numpy as np
from msgspec.structs import replace

from mwdcal.calibration.options import FLEET_NAMES, FleetChoices, Options, as_arguments
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.errors import InputError
from mwdcal.geometry.vectors import AnyArray
from mwdcal.library.arrays import nearest
from mwdcal.library.papers import certificate as certificate
from mwdcal.library.papers import check_signature as check_signature
from mwdcal.library.papers import sign as sign
from mwdcal.library.registries import registry as registry
from mwdcal.library.results import Result
from mwdcal.sensor.profile import Profile

if TYPE_CHECKING:
    from mwdcal.presentation.fleet import FleetSummary


@dataclass(repr=False)
class CalibratedFleet(Result):
    """Many calibrated tools: a table with one row per tool, in the file `path`.

    `content` has the counts of the JSON. `fleet["SERIAL"]` is the calibration of a tool, `len(fleet)` the number of
    tools.
    """

    content: FleetSummary
    path: Path
    page: Path | None = None

    @property
    def findings(self) -> Sequence[Finding]:
        """Why tools were refused, findings of the others, and columns that are not used."""
        from mwdcal.presentation.fleet import findings

        return findings(self.content)

    @property
    def calibrated(self) -> int:
        """Number of tools that were calibrated."""
        return self.content.sound

    @cached_property
    def columns(self) -> Mapping[str, AnyArray]:
        """Arrays by the columns of the table, one row per tool; the calibrations themselves are items of the fleet.

        Numbers are NaN where a tool has none; text and lists are None.
        """
        from mwdcal.files.formats import parquet
        from mwdcal.files.formats.members import RECORD

        _, pq = parquet.modules(self.path.name)
        with parquet.reading(self.path.name):
            names = [name for name in pq.read_schema(self.path).names if name != RECORD]
            table = pq.read_table(self.path, columns=names)
        return {name: _array(table.column(name)) for name in names}

    def __len__(self) -> int:
        return self.content.tools

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns["serial"].tolist())

    def __contains__(self, serial: object) -> bool:
        return serial in self.columns["serial"].tolist()

    def __getitem__(self, serial: str) -> Calibration:
        """The calibration of a tool.

        Raises:
            InputError: there is no such tool, it was not calibrated, or the table holds no calibrations.
        """
        from mwdcal.files import documents
        from mwdcal.files.formats.members import MARK

        return documents.read(f"{self.path}{MARK}{serial}")

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the table of calibrations (.parquet): the other commands take it, with `#SERIAL` behind its name.

        Raises:
            InputError: the suffix is another, or the file cannot be written.
        """
        from mwdcal.files.formats import atomic

        if Path(path).suffix.lower() != ".parquet":
            raise InputError(
                f"cannot write '{os.fspath(path)}': a fleet's calibrations are a Parquet table. Name a file that ends "
                "in .parquet."
            )
        with self.path.open("rb") as stream, atomic.replacing(path) as copy:
            shutil.copyfileobj(stream, copy)

    def save_calibrations(self, folder: str | os.PathLike[str]) -> int:
        """Write the calibration file of each tool into a new or empty folder, and count them."""
        from mwdcal.files.formats import atomic
        from mwdcal.fleet import kept

        atomic.check_new(Path(folder))
        return kept.write(self.path, Path(folder))

    def report(self, path: str | os.PathLike[str]) -> None:
        """Write the page of the command: self-contained HTML."""
        super().report(path)
        self.page = Path(path)

    def _page(self) -> str:
        from mwdcal.presentation.fleet_page import render

        return render(self.path, self.content)

    def _text(self) -> str:
        from mwdcal.presentation.fleet import text

        return text(self.content, self.page)

    def _document(self) -> dict[str, Any]:
        from mwdcal.presentation.fleet import document

        return document(self.content, self.page)


def _array(column: Any) -> AnyArray:
    """A column of a table as an array."""
    kind = str(column.type)
    if kind.startswith(("double", "float", "int", "uint")):
        return np.asarray(column.cast("float64").to_numpy(), float)
    cells = column.to_pylist()
    array = np.empty(len(cells), object)
    array[:] = cells
    return array


def fleet(
    runs: str | os.PathLike[str],
    tool: Profile | str | os.PathLike[str] | None = None,
    *,
    output: str | os.PathLike[str] | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    records: bool | None = None,
    progress: Callable[[str], None] = lambda text: None,
    **choices: Unpack[FleetChoices],
) -> CalibratedFleet:
    """Calibrate many tools: `runs` is a folder of run files, or a table with a column `serial`.

    `tool` is the profile of all of them. `output`: the table of calibrations to write (.parquet); interrupted, the
    same call goes on where it was. Without it the table lasts as long as the result. `workers`: processes, by default
    one per core; 1 is this process. `scheduler`: the address of a Dask scheduler, whose workers are used instead.
    `records`: whether the table holds the whole calibration of each tool; by default that of a fleet of at most 500
    tools with an `output`, and always without. `progress` hears how far it is. `choices` are attributes of `Options`.

    A tool that cannot be calibrated does not stop the others: `columns["status"]` and `columns["message"]` say why.

    Raises:
        InputError: the runs cannot be read, an option is unknown, or the output cannot be written.

    Example::

        fleet = mwdcal.fleet("runs.parquet", "servo", workers=1)
        fleet.columns["accelerometer_gain_xx"]
        fleet["SIM-0001"].uncertainty("azimuth", survey)
    """
    from mwdcal.library.fleet_table import calibrate_table, prior_of_fleet

    options = _options(choices)
    prior_of_fleet(choices.get("prior"))
    if workers is not None and workers < 1:
        raise InputError(
            f"`workers` must be 1 or more; got {workers}. Leave it out for one per core."
        )
    if tool is not None and not isinstance(tool, Profile):
        tool = os.fspath(tool)
    if output is not None:
        path = Path(output)
        _check_lost(path, Path(runs))
    else:
        path = Path(mkdtemp(prefix="mwdcal-fleet-"), "calibrations.parquet")
        records = True if records is None else records
    try:
        content = calibrate_table(
            Path(runs),
            path,
            tool,
            options,
            as_arguments(options),
            workers,
            scheduler,
            records,
            progress,
        )
    except BaseException:
        if output is None:
            shutil.rmtree(path.parent, ignore_errors=True)
        raise
    if output is not None:
        return CalibratedFleet(content, path)
    result = CalibratedFleet(replace(content, output=""), path)
    finalize(result, shutil.rmtree, path.parent, ignore_errors=True)
    return result


def _check_lost(output: Path, runs: Path) -> None:
    """Refuse an output that would replace its input."""
    with suppress(OSError):
        if output.samefile(runs):
            raise InputError(
                f"cannot write '{output}': it is an input, which would be lost. Name another file."
            )


def _options(choices: FleetChoices) -> Options:
    """Options of a fleet by name; its order is 0 unless it is chosen, without own-axis terms."""
    for name in choices:
        if name not in FLEET_NAMES:
            names = ", ".join(FLEET_NAMES)
            raise InputError(
                f"unknown option '{name}'; expected one of {names}.{nearest(name, FLEET_NAMES)}"
            )
    if not isinstance(choices.get("order", 0), int | str):
        raise InputError(
            f"`order` of a fleet must be 0, 1, 2, 3 or auto, the same for both triads; got {choices['order']!r}."
        )
    given: dict[str, Any] = {"order": 0, "nonlinearity": (), **choices}
    return Options(**given)
