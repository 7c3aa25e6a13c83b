"""One function for each task: read, calibrate, verify, correct, and logs."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, Literal, Protocol, Unpack, cast, runtime_checkable

import msgspec
import numpy as np

from mwdcal.calibration.calibrate import calibrate as fit_and_judge
from mwdcal.calibration.diagnosis.findings import of_table
from mwdcal.calibration.options import FitChoices, Options
from mwdcal.calibration.prior import profile_for
from mwdcal.calibration.readings import Readings, ReadingsLike, as_readings
from mwdcal.calibration.record import Calibration, Finding, html_table
from mwdcal.comparison.compare import Comparison
from mwdcal.comparison.compare import compare as compare_methods
from mwdcal.errors import InputError
from mwdcal.faults.diagnosis import Diagnosis
from mwdcal.faults.diagnosis import diagnose as explain
from mwdcal.files import documents, logs, profiles, runs, statements
from mwdcal.files import metadata as meta
from mwdcal.files.formats import table as tables
from mwdcal.files.formats.columns import LABELS, Column, as_text, plain_headings
from mwdcal.files.formats.table import Table
from mwdcal.files.formats.titles import dated
from mwdcal.files.limits import load_limits
from mwdcal.geometry.vectors import AnyArray, Array
from mwdcal.library.answers import Said, by_column
from mwdcal.library.arrays import nearest, readings, without_mask
from mwdcal.library.results import arrays_of, brief, frame
from mwdcal.library.shown import digest_of, stations_of, with_inputs
from mwdcal.logs.noise import Noise, find_noise
from mwdcal.logs.stations import Stations, find_stations
from mwdcal.sensor.profile import NOMINAL as NOMINAL
from mwdcal.sensor.profile import Profile
from mwdcal.use.correction import correct, warn_if_blank
from mwdcal.use.verification import Limits, Verdict
from mwdcal.use.verification import verify as judge

CORRECTED_ANGLES = ("inclination", "azimuth", "toolface", "dip", "magnetic_toolface")
"""Angles of corrected readings."""
Path = str | os.PathLike[str]


class WithProfile(Protocol):
    """A proposed profile, a calibration, or anything else with a tool profile."""

    @property
    def profile(self) -> Profile:
        """The tool profile."""
        ...


ProfileSource = Path | Profile | WithProfile
"""A tool profile: built in by name, a TOML file by path, the profile itself, or what has one."""
Tabular = Path | Table | Mapping[str, Any]
"""A file, a table, or columns by name: a dictionary of arrays, a pandas or a polars table."""
RunSource = ReadingsLike | Tabular
"""The readings of a run: `Readings`, an array of them, a file, or columns by name."""


def load_profile(name: Path = "generic") -> Profile:
    """A tool profile: a built-in one by name, or a TOML file by path.

    Raises:
        InputError: no such profile, or a file that is not one.
    """
    return profiles.load_profile(os.fspath(name))[0]


def read_run(
    source: Tabular,
    profile: ProfileSource = "generic",
    *,
    decimal: str = ".",
    metadata: Mapping[str, object] | None = None,
) -> Readings:
    """The readings of a run: of a CSV, TSV, Parquet, XLSX, WITSML or LAS file, or of columns with the same names.

    `profile` says which tool axis each raw channel measures and in which unit; it goes with the
    readings to `calibrate`. Readings to be corrected or verified are read with the profile of their
    calibration: `read_run("survey.csv", calibration.profile)`.

    `metadata` are those of the run, such as `serial`, `date` and `simulated`, beside those of a file or of the
    `attrs` of a pandas table: a table in memory has none of the lines above a file's table. `serial`,
    `simulated` and `date` may also be columns.

    Raises:
        InputError: a file that cannot be read, or a cell that is missing or out of range.
    """
    profile, profile_sha256 = _loaded(profile)
    read = partial(runs.read_export, profile=profile, decimal=decimal)
    table = table_of(source, "the run", read)
    if metadata:
        table = replace(table, metadata={**table.metadata, **meta.plain(metadata, table.source)})
    table = runs.station_table(table, profile)
    readings, profile = runs.read_stations(table, profile)
    whole = arrays_of(table)
    return replace(readings, profile=profile, profile_sha256=profile_sha256, table=whole)


def table_of(source: Tabular, name: str, read: Callable[[Path], Table]) -> Table:
    """The table of a file, or of columns that are in memory."""
    if isinstance(source, str | os.PathLike):
        return read(source)
    return table_in_memory(source, name)


def _name_of(key: object) -> str:
    """The name of a column, with single blanks as of a file; of a header of several rows ("MD", "m") it is MD m."""
    parts = [key]
    if isinstance(key, tuple):
        parts = [part for part in key if not str(part).startswith("Unnamed: ")]
    return " ".join(" ".join(map(str, parts)).split()) or str(key)


def table_in_memory(source: Any, name: str) -> Table:
    """The table of columns that are in memory."""
    if isinstance(source, Table):
        return source
    names = getattr(
        source, "column_names", getattr(source, "columns", source)
    )  # of pyarrow, of pandas
    if not isinstance(names, Iterable):
        raise InputError(f"{name} must be a file or columns by name; got {type(source).__name__}.")
    keys = [*names]
    called = plain_headings([_name_of(key) for key in keys])
    columns = {each: _column(each, source[key]) for each, key in zip(called, keys, strict=True)}
    count = max(map(len, columns.values()), default=0)
    for key, column in columns.items():
        if len(column) != count:
            raise InputError(
                f"{name}: column '{key}' has {len(column)} values; the longest has {count}. Give one "
                "value for each row, blank or NaN where unknown."
            )
    metadata = dated(meta.plain(getattr(source, "attrs", {}), name), columns.items())
    units = _units_below(columns)
    if units:
        columns = {key: column[1:] for key, column in columns.items()}
    return Table(columns, metadata, name, range(1, count + 1 - bool(units)), units=units)


def _units_below(columns: Mapping[str, Column]) -> dict[str, str]:
    """The units in a first row that holds nothing else, as a spreadsheet has them below the names."""
    from mwdcal.files.formats.layout import is_units

    first = {name: cells[0] for name, cells in columns.items() if isinstance(cells, list) and cells}
    return {n: cell for n, cell in first.items() if cell} if is_units([*first.values()]) else {}


def _is_missing(cell: Any) -> bool:
    """Whether a cell holds nothing: None, NaN, or the NA of pandas, which is neither equal to itself nor not."""
    try:
        return cell is None or bool(cell != cell)
    except TypeError:
        return True
    except ValueError:  # an array
        return False


def _column(name: str, values: Any) -> Column:
    """Numbers, or the text of labels and of any other values; a serial that is a number with a point stays one."""
    array = np.ma.array(values)
    kind = array.dtype.kind
    if not array.ndim:
        raise InputError(
            f"column '{name}' must be numbers or text, one for each row; got {array.item()!r}. Give a list."
        )
    if array.dtype.name.endswith("s]"):  # datetimes; those in ns would be whole numbers
        array = np.ma.array(array, dtype=f"{kind}8[us]")
    numbers = array.ndim == 1 and kind in "fiu"
    if not numbers or (name in LABELS and not (kind == "f" and name == "serial")):
        return ["" if _is_missing(cell) else as_text(cell) for cell in array.tolist()]
    return without_mask(array.astype(float))


def calibrate(
    run: RunSource,
    profile: ProfileSource | None = None,
    options: Options | None = None,
    **choices: Unpack[FitChoices],
) -> Calibration:
    """Fit the sensor model to a run, and state what the calibration is worth.

    `run` is what `read_run` or `readings` has given, or what they take: a file, columns by name, or an array (n, 3),
    (n, 6) or (n, 7) of accelerometer, magnetometer and temperature, as in all that follows.

    `profile` (also what `propose_profile` gives) is by default the one that the run was read with, else a nominal one:
    channels along the tool axes in g and nT. `choices` are attributes of `Options` by name, such as
    `method="scalar"` or `robust="huber"`; what is not chosen is chosen as by the command.

    Raises:
        FitError: the run cannot give a calibration to be trusted; the message says what to add.
        InputError: an option is unknown.
    """
    options = with_choices(options, choices)
    if options and isinstance(options.prior, Calibration) and not options.prior_sha256:
        options = replace(options, prior_sha256=digest_of(options.prior))
    run, stated = _run_with_profile(run, profile, options)
    whole = run if profile is None else replace(run, profile_sha256="")
    return fit_and_judge(whole, stated, options)


def _run_with_profile(
    run: RunSource, profile: ProfileSource | None, options: Options | None
) -> tuple[Readings, Profile]:
    """The readings of a run, and the profile as given, but with the axes and scales that made these readings."""
    if not isinstance(run, Readings):
        stated = NOMINAL if profile is None else _loaded(profile)[0]
        run = readings_of(run, "run", profile_for(options.prior if options else None, stated))
    _check_readings(run)
    stated = _profile(run, profile)
    triads = {}
    for name in run.triads:
        triad, of_run = getattr(stated, name), getattr(run.profile or stated, name)
        triads[name] = msgspec.structs.replace(triad, axes=of_run.axes, scale=of_run.scale or 1.0)
    return run, msgspec.structs.replace(stated, **triads)


def _loaded(profile: object) -> tuple[Profile, str]:
    """A tool profile, and the SHA-256 of the file that it was read from; refuses what has none."""
    return loaded_profile(getattr(profile, "profile", profile), "profile")


def loaded_profile(source: object, name: str) -> tuple[Profile, str]:
    """A tool profile that an argument of this `name` is or names, and the SHA-256 of its file; blank without one."""
    if isinstance(source, Profile):
        return source, ""
    if not isinstance(source, str | os.PathLike):
        raise InputError(
            f"`{name}` must be a tool profile, or the name or file of one; got {type(source).__name__}. Read one by "
            "mwdcal.load_profile(…)."
        )
    return profiles.load_profile(os.fspath(source))


def _profile(run: Readings, profile: object) -> Profile:
    """A profile as it is given, else that of the run, else `NOMINAL`."""
    if profile is None:
        return run.profile or NOMINAL
    if isinstance(profile, Options):
        raise InputError(
            "`profile` must be a tool profile; got options. Give them as options=…, or by name."
        )
    return _loaded(profile)[0]


def _check_readings(readings: object, name: str = "run", single: bool = True) -> None:
    """Refuse what is not `Readings`, or not those of one run where `single` ones are needed."""
    if not isinstance(readings, Readings):
        raise InputError(
            f"`{name}` must be readings; got {type(readings).__name__}. Make them by "
            "mwdcal.readings(…), or mwdcal.read_run(…) of a file."
        )
    values = (
        readings.accelerometer,
        readings.magnetometer,
        readings.temperature,
        *readings.known.values(),
        *readings.sd.values(),
    )
    if any(map(np.ma.isMaskedArray, values)):
        raise InputError(
            f"`{name}` has arrays with a mask, below which values would count. Make it by "
            "mwdcal.readings(…), which takes what is masked as unknown."
        )
    shape = readings.accelerometer.shape
    if single and len(shape) != 2:
        raise InputError(
            f"`{name}` must have readings of one run, (n, 3); got {shape}. Many runs at once are "
            "fitted by mwdcal.calibration.estimate.fit."
        )


def readings_of(
    source: RunSource, name: str, profile: ProfileSource, single: bool = True
) -> Readings:
    """The readings of a run: as they are, of an array as `as_readings` takes it, or by `read_run` of a table."""
    if isinstance(source, Readings):
        pass
    elif _is_tabular(source):
        source = read_run(cast(Tabular, source), profile)
    else:
        array = as_readings(cast(ReadingsLike, source))
        source = readings(array.accelerometer, array.magnetometer, temperature=array.temperature)
    _check_readings(source, name, single)
    return source


def _is_tabular(source: object) -> bool:
    """Whether readings are a file, a table, or columns by name."""
    return isinstance(source, str | os.PathLike | Table | Mapping) or hasattr(source, "columns")


def with_choices(options: Options | None, choices: Mapping[str, Any]) -> Options | None:
    """Options with choices by name; None where nothing was chosen."""
    names = [field.name for field in fields(Options)]
    for name in choices:
        if name == "rolltest":
            raise InputError(
                "a calibration is judged by a roll test in a step of its own: mwdcal.verify(cal, FILE)."
            )
        if name == "tool":
            raise InputError("a run's tool profile is given as `profile`, not as `tool`.")
        if name not in names:
            raise InputError(
                f"unknown option '{name}'; expected one of {', '.join(names)}.{nearest(name, names)}"
            )
    return replace(options or Options(), **choices) if choices else options


def compare(
    run: RunSource,
    profile: ProfileSource | None = None,
    options: Options | None = None,
    *,
    progress: Callable[[str], None] = lambda text: None,
    **choices: Unpack[FitChoices],
) -> Comparison:
    """Calibrate a run by every method, and judge each by stations left out of its fit.

    `options` and `choices` as of `calibrate`, the same for all methods; their method does not
    count. `progress` is called with a sentence at each step.
    """
    given = with_choices(options, choices)
    run, stated = _run_with_profile(run, profile, given)
    result = compare_methods(run, stated, given, progress=progress)
    return with_inputs(result, run.metadata, run=run.run_sha256, profile=run.profile_sha256)


def calibration_of(source: object) -> Calibration:
    """A calibration as it is, or read from its file; refuses anything else."""
    if isinstance(source, str | os.PathLike):
        return documents.read(source)
    if isinstance(source, Calibration):
        return source
    raise InputError(
        f"`calibration` must be a calibration or its file; got {type(source).__name__}. Make one by "
        "mwdcal.calibrate(…)."
    )


def _later(
    source: RunSource,
    name: str,
    calibration: Calibration,
    sheet: str,
    column: Mapping[str, str] | Said | None,
) -> Readings:
    """Readings after a calibration as they are given; those of a file, of that of the run those of its roll test."""
    if not isinstance(source, str | os.PathLike):
        return readings_of(source, name, calibration.profile)
    from mwdcal.identification import roll_tests

    said = statements.Said(sheet=sheet, columns=by_column("column", column))
    return roll_tests.read_later(source, calibration, said, is_test=name == "rolltest")


def verify(
    calibration: Calibration | Path,
    rolltest: RunSource,
    limits: Path | Limits = "roll-test",
    *,
    sheet: str = "",
    column: Mapping[str, str] | Said | None = None,
) -> Verdict:
    """Judge a calibration by readings that its fit has not seen: `.passed`, and `.rows` with each figure.

    `calibration` may be its file, and `rolltest` the file of its run, where that has a roll test too. A table with
    other names than the run's is read by those that it has; `sheet` and `column`, as of `propose_profile`, answer what
    it leaves open.
    `limits` is a shipped limits profile by name, a TOML file by path, or `Limits`.

    Raises:
        InputError: stations of the fit, temperatures outside the calibrated range, or readings to
            which no limit applies.
    """
    calibration = calibration_of(calibration)
    rolltest = _later(rolltest, "rolltest", calibration, sheet, column)
    bounds, digest = (limits, "") if isinstance(limits, Limits) else load_limits(limits)
    verdict = judge(calibration, rolltest, bounds)
    findings = [*verdict.findings, *of_table(rolltest)]
    verdict = msgspec.structs.replace(verdict, findings=findings)
    digests = {"calibration": digest_of(calibration), "limits": digest}
    stated = calibration.tool, rolltest.metadata
    return with_inputs(
        verdict, *stated, of=calibration, test=rolltest, run=rolltest.run_sha256, **digests
    )


def diagnose(
    calibration: Calibration | Path,
    later: RunSource,
    *,
    sheet: str = "",
    column: Mapping[str, str] | Said | None = None,
) -> Diagnosis:
    """Say which fault explains later readings of a calibrated tool best: `.fault` is "none" where none is needed.

    Definition: faults are compared by the density of the readings, all that is uncertain being integrated out;
    one is named where a sound tool gives as much evidence with a probability of at most 1 %. `sheet` and `column` as of
    `verify`.

    Raises:
        InputError: readings of another tool or of the fit itself, or none that can be used.
    """
    calibration = calibration_of(calibration)
    later = _later(later, "later", calibration, sheet, column)
    result = explain(calibration, later)
    findings = [*calibration.change_findings(), *result.findings, *of_table(later)]
    result = msgspec.structs.replace(result, findings=findings)
    stated, digest = (calibration.tool, later.metadata), digest_of(calibration)
    return with_inputs(result, *stated, calibration=digest, readings=later.run_sha256)


@dataclass(frozen=True)
class Corrected:
    """Corrected readings: vectors (n, 3) in g and nT, angles (n,) in radians, or NaN.

    `columns` are all results by the names of files, with their units (`inclination_deg`, `gx_g`, …),
    ready for a table; `findings` are what the reader should know. `stations` are labels and temperatures of the rows.
    """

    gravity: Array
    field: Array
    inclination: Array
    azimuth: Array
    toolface: Array
    dip: Array
    magnetic_toolface: Array
    columns: dict[str, AnyArray]
    findings: list[Finding]
    stations: Mapping[str, AnyArray]

    def __repr__(self) -> str:
        return brief(self, self.summary)

    def _repr_html_(self) -> str:
        ranges = ((name, *_range(values)) for name, values in self.columns.items())
        return html_table(self.summary(), [("", "least", "largest"), *ranges])

    def summary(self) -> str:
        """How many rows have results."""
        blank = int(np.isnan(self.gravity).any(-1).sum())
        rows = f"{self.gravity[..., 0].size} rows corrected"
        return f"{rows}, {blank} of them blank" if blank else rows

    def to_dict(self) -> dict[str, Any]:
        """The columns as lists, None where there is no result, and the findings."""
        lists = {
            name: [None if value != value else value for value in values.tolist()]
            for name, values in self.columns.items()
        }
        return {"columns": lists, "findings": msgspec.to_builtins(self.findings)}

    def to_pandas(self) -> Any:
        """The columns as a table of pandas, which must be installed, behind the stations where there are labels."""
        return frame({**self.stations, **self.columns})


def _range(values: AnyArray) -> tuple[str, str]:
    """The least and the largest of some numbers as text, or blank."""
    known = values[~np.isnan(values)] if values.dtype.kind == "f" else values[:0]
    return (f"{known.min():.6g}", f"{known.max():.6g}") if known.size else ("", "")


def apply(
    calibration: Calibration | Path,
    survey: RunSource,
    outside: Literal["blank", "refuse", "extrapolate"] = "blank",
    *,
    sheet: str = "",
    column: Mapping[str, str] | Said | None = None,
) -> Corrected:
    """Correct readings by a calibration or its file: vectors and angles.

    `outside`: what becomes of readings outside the calibrated temperatures. `sheet` and `column` as of `survey`.
    Singular: azimuth and toolface are NaN exactly at vertical; the magnetic toolface is not.

    Raises:
        InputError: readings that do not belong to the calibration.
        FitError: a column leaves a question open.
    """
    calibration = calibration_of(calibration)
    said = statements.Said(sheet=sheet, columns=by_column("column", column))
    survey, about = _named(survey, calibration, said)
    survey = runs.away_from_stand(survey, calibration.profile)
    columns, findings = correct(calibration, survey, outside)
    findings = [*about, *findings]
    warn_if_blank(columns, findings)
    return Corrected(
        gravity=np.stack([columns[f"g{axis}_g"] for axis in "xyz"], -1),
        field=np.stack([columns[f"b{axis}_nt"] for axis in "xyz"], -1),
        **{name: np.radians(columns[f"{name}_deg"]) for name in CORRECTED_ANGLES},
        columns=columns,
        findings=findings,
        stations=stations_of(survey),
    )


def _named(
    survey: RunSource, calibration: Calibration, said: statements.Said
) -> tuple[Readings, list[Finding]]:
    """Readings by the names of a calibration's run or those of their table, and the finding on these."""
    profile, findings = calibration.profile, list[Finding]()
    if not isinstance(survey, Readings) and _is_tabular(survey):
        from mwdcal.presentation.readings import read_surveys

        given = cast(Tabular, survey)
        table = given if isinstance(given, str | os.PathLike) else table_in_memory(given, "the run")
        named = read_surveys(table, calibration, said)
        survey, profile, findings = named.table, named.calibration.profile, named.findings
    return readings_of(survey, "survey", profile, single=False), findings


@runtime_checkable
class Savable(Protocol):
    """A result that writes itself, in the form that the suffix of a file names."""

    def save(self, path: Path) -> None:
        """Write the result."""


def save(
    result: Calibration | Readings | Verdict | Savable,
    path: Path,
    profile: Path | Profile | None = None,
    *,
    decimals: int | None = None,
) -> None:
    """Write a calibration file or a verdict (JSON), or the readings of a run as `read_run` reads them.

    A run is a CSV, TSV, Parquet or XLSX file, by the suffix. Its channels are raw: in the axes and
    units of the `profile`, by default the one that the run was read with, else g and nT along the
    tool axes. `decimals` are places after the point, by default as many as there are. A file is
    written whole or not at all. A result that has a form of its own for each suffix, such as a
    certificate, writes itself.
    """
    if isinstance(result, Savable):
        result.save(path)
        return
    if isinstance(result, Calibration):
        documents.write(path, result)
        return
    if isinstance(result, Verdict):
        from mwdcal.library.shown import VerdictFile

        VerdictFile(result).save(path)
        return
    _check_readings(result, "result")
    table = runs.from_readings(result, _profile(result, profile))
    if decimals is not None:
        columns = {
            name: cells if isinstance(cells, list) else np.round(cells, decimals)
            for name, cells in table.columns.items()
        }
        table = replace(table, columns=columns)
    tables.write(path, table)


def load(path: Path) -> Calibration:
    """Read a calibration file, or one tool in the table of a fleet: `cals.parquet#SERIAL`.

    Raises:
        InputError: the file cannot be read, is not a calibration file, or was damaged.
    """
    return documents.read(path)


def stations(
    log: Tabular,
    *,
    sampling_hz: float | None = None,
    min_seconds: float | None = None,
    trim_seconds: float | None = None,
    threshold: float | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Stations:
    """The standstills of a continuous log, each as a station: `.table` is a run for `read_run`.

    `log` is a file, or columns by the names of log files: `time_s`, `ax`, …, `temperature_c`. `sampling_hz` is the
    rate of a log without a column `time_s`; a station has at least `min_seconds` after `trim_seconds` are cut off each
    end; `threshold` is the movement that still counts as rest, in noise floors, found from the log where None. `say`
    is called with a sentence at each step.
    """
    table = _log(log)
    search = {"min_seconds": min_seconds, "trim_seconds": trim_seconds, "threshold": threshold}
    result = find_stations(table, sampling_hz=sampling_hz, say=say, **search)
    return with_inputs(result, table.metadata, log=table.digest)


def noise(
    log: Tabular,
    *,
    profile: Path | Profile | None = None,
    sampling_hz: float | None = None,
    between: tuple[float, float] = (-np.inf, np.inf),
    station_seconds: float | None = None,
    kind: Literal["overlapping", "modified"] = "overlapping",
    say: Callable[[str], None] = lambda text: None,
) -> Noise:
    """The noise of each raw channel of a log of a tool at rest, by Allan deviation.

    `log` is a file, or columns by the names of log files; `profile` has the scales, with which figures come in g and
    nT too. Only the seconds `between` two times are used; a station takes `station_seconds`, by default 30, or a tenth
    of a shorter log. `kind` of the deviation: overlapping or modified. `say` is called with a sentence at each step.
    """
    table = _log(log)
    tool = load_profile(profile) if isinstance(profile, str | os.PathLike) else profile
    result = find_noise(
        table, profile=tool, sampling_hz=sampling_hz, between=between,
        station_seconds=station_seconds, kind=kind, say=say,
    )  # fmt: skip
    return with_inputs(result, table.metadata, log=table.digest)


def _log(source: Tabular) -> Table:
    """A log: a file, or columns that are checked like one."""
    table = table_of(source, "the log", logs.read)
    return table if isinstance(source, str | os.PathLike) else logs.check(table)
