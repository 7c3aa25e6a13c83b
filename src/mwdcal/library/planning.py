"""Before a measurement: plans, and profiles from tables as they come."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Unpack, cast

import numpy as np

from mwdcal.calibration.options import FitChoices, Options
from mwdcal.calibration.readings import Readings, serial_of
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.errors import FitError, InputError
from mwdcal.files import documents, runs
from mwdcal.files.formats.table import Table
from mwdcal.geometry.vectors import AnyArray
from mwdcal.library.answers import Said, by_column
from mwdcal.library.results import Result, arrays_of
from mwdcal.library.shown import digest_of
from mwdcal.library.tasks import (
    NOMINAL,
    Tabular,
    loaded_profile,
    table_in_memory,
    table_of,
    with_choices,
)
from mwdcal.sensor.profile import Profile

if TYPE_CHECKING:
    from mwdcal.identification.proposal import Proposal
    from mwdcal.planning.planned import Planned

FilePath = str | os.PathLike[str]
ToolSource = FilePath | Profile | Calibration
"""A tool profile: built in by name, a TOML file by path, or the profile itself; or a calibration, with its noise."""


def silent(done: int, total: int) -> None:
    """Take no notice of progress."""


@dataclass(frozen=True, eq=False, repr=False)
class PlanResult(Result):
    """A plan and what a calibration from it will give: the first of `plans`; the others are compared with it.

    `columns` are those of the plan's table, `accuracy_deg` 1σ by angle at 45° inclination (None: undetermined).
    """

    plans: Sequence[Planned]
    digests: Mapping[str, str]
    files: dict[str, Path] = field(default_factory=dict)
    serial: str = ""

    @property
    def table(self) -> Table:
        """The plan as the table of a run without readings."""
        return self.plans[0].stated

    @property
    def columns(self) -> dict[str, AnyArray]:
        """Stations, temperatures and references of the plan by the names of run files."""
        return arrays_of(self.table)

    @property
    def calibration(self) -> Calibration:
        """The calibration that the plan will give, of a nominal tool."""
        return self.plans[0].calibration

    @property
    def accuracy_deg(self) -> dict[str, float | None]:
        """Standard uncertainty of each angle at 45° inclination, as `calibrate` states it; None: undetermined."""
        from mwdcal.calibration.results import typical_accuracy

        return typical_accuracy(self.calibration)

    @property
    def findings(self) -> list[Finding]:
        """The directions that the plans leave undetermined, and other findings."""
        from mwdcal.presentation.plan import findings

        return findings(self.plans)

    def save(self, path: FilePath) -> None:
        """Write the plan to be filled in: a run file with blank readings (CSV, TSV, Parquet or XLSX), and the serial.

        Raises:
            InputError: the file cannot be written.
        """
        from mwdcal.files.formats import table
        from mwdcal.planning.plans import run_sheet

        has_magnetometer = self.calibration.profile.has_magnetometer
        table.write(path, run_sheet(self.table, has_magnetometer, self.serial))
        self.files["output"] = Path(path)

    def report(self, path: FilePath) -> None:
        """Write the run sheet to print and tick off: self-contained HTML.

        Raises:
            InputError: the file cannot be written.
        """
        super().report(path)
        self.files["html"] = Path(path)

    def _named(self) -> tuple[Sequence[Planned], Mapping[str, str], Path | None, Path | None]:
        return self.plans, self.digests, self.files.get("output"), self.files.get("html")

    def _text(self) -> str:
        from mwdcal.presentation.plan import screen

        return screen(*self._named())

    def _document(self) -> dict[str, Any]:
        from mwdcal.presentation.plan import document

        return document(*self._named(), self.serial)

    def _page(self) -> str:
        from mwdcal.presentation.plan import render

        return render(self.plans, self.serial)


PlanSource = Tabular | PlanResult
"""A plan: built in by name, a file of attitudes or a run file, columns of a run, or what `plan` has given."""


def plan(
    tool: ToolSource,
    *,
    stations: int | None = None,
    plan: PlanSource | Sequence[PlanSource] | None = None,
    accuracy_deg: Mapping[str, float] | None = None,
    measured: Tabular | Readings | None = None,
    reach: Mapping[str, tuple[float, float]] | None = None,
    criterion: Literal["D", "A", "I"] = "I",
    speed: float = 5.0,
    settle: float = 30.0,
    soak: float | None = None,
    serial: str = "",
    options: Options | None = None,
    progress: Callable[[int, int], None] = silent,
    **choices: Unpack[FitChoices],
) -> PlanResult:
    """State how accurate a calibration will be before anything is measured, or choose the stations for it.

    Definition: the calibration of a nominal `tool` that reads without noise, at the stations of a `plan`; several
    plans are compared. With `stations` the best so many out of the candidates in `plan`, with `accuracy_deg` (1σ)
    the fewest that give it, with `measured` the best to add to a run that exists. `criterion` says what `stations`
    are best in: "D", all parameters together; "A", each of them; "I", the angles. `serial` is the tool's, for the
    sheet; by default that of the calibration or run behind the plan. `options` and `choices` are those
    of `calibrate`. Where the plan does not state the place, it is that of a calibration given as `tool`.

    Units: degrees for accuracies and for `reach` of the stand, degrees per second for its `speed`; `settle` in
    seconds from the end of a move to the reading, `soak` in minutes to reach a temperature, by default 90,
    and 0 where a plan has one temperature from 10 to 35 °C.

    Raises:
        InputError: a plan, profile or keyword that cannot be read, or a profile without scale and noise.
        FitError: the stations cannot give a calibration; the message says what to add.

    >>> import mwdcal
    >>> sheet = mwdcal.plan("servo", plan="moosavi-12")
    >>> len(sheet.columns["ref_inclination_deg"])
    48
    >>> sheet.accuracy_deg["azimuth"] < 0.1
    True
    """
    from mwdcal.planning import planned
    from mwdcal.planning.planned import Stand

    several = plan if isinstance(plan, list | tuple) else [] if plan is None else [plan]
    if len(several) > 1 and (accuracy_deg or stations or measured is not None):
        raise InputError("`plan`: one plan holds the candidates to choose from. Name it alone.")
    _check_wanted(stations, accuracy_deg or {})
    planned.check_criterion(criterion)
    profile, digest = profile_of(tool := loaded_tool(tool))
    chosen, ends = with_choices(options, choices), _ends(reach or {})
    stand = Stand(speed, settle, soak, ends)
    tables = [plan_table(cast(PlanSource, each)) for each in several]
    done = None if measured is None else _measured(measured, profile)
    if isinstance(tool, Calibration):
        usual = "candidates" if accuracy_deg or stations else "twenty-four-state"
        tables, done = _placed(tables, done, tool, usual)
    candidates = tables[0] if tables else None
    if accuracy_deg:
        wanted = accuracy_deg, profile, chosen, stand, done, stations
        result = [planned.smallest_plan(candidates, *wanted, progress=progress)]
    elif stations or done:
        search = profile, chosen, criterion, stand, done
        result = [planned.best_plan(candidates, stations or 1, *search, progress=progress)]
    else:
        result, tables = [], tables or [plan_table("twenty-four-state")]
        for each in tables:
            result.append(planned.judged(each, profile, chosen, stand))
            progress(len(result), len(tables))
    result = [planned.with_tool(each, tool) for each in result]
    digests = {"profile": digest, "measured": done.digest if done else ""}
    return PlanResult(result, digests, serial=serial or _serial(tool, done or result[0].plan))


def _placed(
    tables: list[Table], done: Table | None, tool: Calibration, usual: str
) -> tuple[list[Table], Table | None]:
    """Plans, or else stations measured already, at the place of a calibration; without either the `usual` plan."""
    from mwdcal.planning.plans import at_place_of, at_temperature_of

    if done:
        return tables, at_place_of(done, tool)
    tables = tables or [at_temperature_of(plan_table(usual), tool)]
    return [at_place_of(each, tool) for each in tables], None


def _serial(tool: object, run: Table) -> str:
    """The serial of the tool by its calibration, else by a run; blank where unknown."""
    return serial_of(tool.tool if isinstance(tool, Calibration) else run.metadata) or ""


def _check_wanted(stations: int | None, accuracy_deg: Mapping[str, float]) -> None:
    """Refuse a number of stations or an accuracy that cannot be wanted."""
    if stations is not None:
        check_whole("stations", stations, 1)
    for name, value in accuracy_deg.items():
        if not (_is_number(value) and 0 < value < 180):
            raise InputError(
                f"`accuracy_deg` must be above 0 and below 180 degrees for each angle; got {value!r} for {name!r}. "
                "Give it such as {'azimuth': 0.1}."
            )


def check_whole(name: str, value: object, least: int) -> None:
    """Refuse what is not a whole number of at least so much."""
    if not isinstance(value, int | np.integer) or value < least:
        raise InputError(
            f"`{name}` must be a whole number of {least} or more; got {value!r}. Correct it, or leave it out."
        )


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.number)


def _ends(reach: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
    """The least and the largest setting of each angle as numbers."""
    ends = {}
    for name, pair in reach.items():
        try:
            low, high = map(float, pair)
        except (TypeError, ValueError):
            raise InputError(
                f"`reach` must be the least and the largest setting of each angle, degrees; got {pair!r} for "
                f"{name!r}. Give it such as {{'inclination': (0, 120)}}."
            ) from None
        ends[name] = low, high
    return ends


def loaded_tool(tool: Any) -> Any:
    """A tool as it is given, or the calibration in the file that it names."""
    file = isinstance(tool, str | os.PathLike) and Path(tool).suffix.lower() == ".json"
    return documents.read(tool) if file else tool


def profile_of(tool: object) -> tuple[Profile, str]:
    """A profile and the SHA-256 of its file, or of its calibration; without one for a profile in memory."""
    tool = loaded_tool(tool)
    if isinstance(tool, Calibration):
        from mwdcal.planning.session import calibrated_profile

        return calibrated_profile(tool), digest_of(tool)
    return loaded_profile(tool, "tool")


def plan_table(source: PlanSource) -> Table:
    """A plan as the table of a run without readings."""
    from mwdcal.planning.plans import load_plan

    if isinstance(source, PlanResult):
        return source.table
    if isinstance(source, str | os.PathLike):
        return load_plan(os.fspath(source))
    return load_plan(table_of(source, "the plan", _unread))


def _measured(run: Tabular | Readings, profile: Profile) -> Table:
    """The stations of a run that is measured already."""
    from mwdcal.planning.plans import load_measured

    if isinstance(run, Readings):
        run = runs.from_readings(run, run.profile or NOMINAL)
    if isinstance(run, str | os.PathLike):
        return load_measured(os.fspath(run), profile.has_magnetometer)
    return load_measured(table_of(run, "the run", _unread), profile.has_magnetometer)


def _unread(path: FilePath) -> Table:
    raise AssertionError(f"{path} is a file, not columns")


@dataclass(frozen=True, eq=False, repr=False)
class ProposedProfile(Result):
    """A tool profile proposed for a table as it comes, and how sure it is."""

    proposal: Proposal
    path: Path
    files: dict[str, Path] = field(default_factory=dict)

    @property
    def profile(self) -> Profile:
        """The profile with which the table is a calibration run.

        Raises:
            FitError: the table does not tell the axes of a triad: they are to be filled in.
        """
        from mwdcal.identification.proposal import axes_open

        if open_ones := axes_open(self.proposal):
            raise FitError(f"{self.path.name}: {' '.join(each.text for each in open_ones)}")
        return self.proposal.profile

    @property
    def findings(self) -> list[Finding]:
        """Triads whose axes are open, or a left-handed set by those proposed, and columns that are not used."""
        from mwdcal.identification.proposal import findings_on

        return findings_on(self.proposal)

    def to_toml(self) -> str:
        """The text of the profile, with how its entries were recognised."""
        from mwdcal.identification.proposal import as_toml

        return as_toml(self.proposal, self.path.name)

    def save(self, path: FilePath) -> None:
        """Write the profile (TOML), to be checked and completed.

        Raises:
            InputError: the file cannot be written.
        """
        from mwdcal.files.formats import atomic

        atomic.write(os.fspath(path), self.to_toml())
        self.files["output"] = Path(path)

    def _text(self) -> str:
        from mwdcal.identification.proposal import has_test_beside
        from mwdcal.presentation.proposal import screen

        test = has_test_beside(self.proposal)
        return screen(self.proposal, self.path, self.files.get("output"), test)

    def _document(self) -> dict[str, Any]:
        from mwdcal.presentation.proposal import summary

        return summary(self.proposal, self.path, self.files.get("output"))


def propose_profile(
    table_path: Tabular,
    *,
    sheet: str = "",
    header_row: int = 0,
    decimal: str = "",
    serial: str = "",
    date: str = "",
    column: Mapping[str, str] | Said | None = None,
    north: str = "",
    declination_deg: float | None = None,
    convergence_deg: float | None = None,
    leave_out: Mapping[str, Sequence[str]] | Said | None = None,
    keep: Mapping[str, Sequence[str]] | Said | None = None,
) -> ProposedProfile:
    """Propose a tool profile for a table as a laboratory keeps it: text or workbook, of any layout, or a DataFrame.

    Definition: where the table is, how its numbers are written, the meaning and unit of each column, and, from
    readings at known attitudes, the axes and nominal scales of both triads. `read_run(table_path, proposed.profile)`
    then takes the table as it is. A table of pandas or polars has its names as columns, and may have their units in
    its first row; the profile finds the same names in files too.

    `sheet`, `header_row` (of the column names) and `decimal` ("." or ",") say what is open about the table, `column`
    which column holds what, by the name of the run file: {"ref_azimuth_deg": "Azi 2"}, with the unit in brackets
    behind the name where the table does not state it; a blank name for a column that is absent, a number for a
    reference of all stations. `serial` and `date`
    of the run where the table states none. `north` ("magnetic", "true" or "grid") is what its azimuths count from,
    with the declination and the convergence (degrees east) that turn them magnetic. `leave_out` says by the texts of a
    column which rows are rejected, {"QC": ["X"]}, and `keep` which are not. These three also take texts as the
    command does: "ref_azimuth_deg=Azi 2", or a list of such.

    Where the table does not tell the axes of a triad, as one of rolls alone, a finding `axes-open` says so, and the
    profile that is saved has lines to fill in.

    Raises:
        InputError: the file cannot be read, or is not a table of stations.
        FitError: names and readings leave something open; the message has all questions, each with what answers it.

    Example::

        proposed = mwdcal.propose_profile("export.csv")
        print(proposed.summary())
        proposed.save("tool.toml")
    """
    from mwdcal.identification.proposal import propose

    source: FilePath | Table
    if isinstance(table_path, str | os.PathLike):
        source, path = table_path, Path(table_path)
    else:
        source = table_in_memory(table_path, "table")
        path = Path(source.source)
        _check_only_of_files({"sheet": sheet, "header_row": header_row, "decimal": decimal})
    stated = {"serial": serial, "date": date}
    norths = {
        "azimuth_reference": north,
        "declination_deg": declination_deg,
        "convergence_deg": convergence_deg,
    }
    proposal = propose(
        source,
        sheet=sheet,
        header_row=header_row,
        decimal=decimal,
        answers=by_column("column", column),
        stated={key: value for key, value in stated.items() if value},
        north={key: value for key, value in norths.items() if value not in ("", None)},
        leave_out=by_column("leave_out", leave_out),
        keep=by_column("keep", keep),
    )
    return ProposedProfile(proposal, path)


def _check_only_of_files(said: Mapping[str, object]) -> None:
    """Refuse answers about the place and the writing of a table in a file, for one in memory."""
    for name in (each for each, value in said.items() if value):
        raise InputError(f"`{name}` is of tables in files; got a table in memory. Leave it out.")
