"""In the well and after: references, surveys, other notations and forms of a calibration."""

from __future__ import annotations

import datetime
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np

from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.errors import InputError
from mwdcal.files import runs
from mwdcal.files.contract import COLUMNS
from mwdcal.files.formats import atomic
from mwdcal.files.formats import table as tables
from mwdcal.files.formats.columns import LABELS, as_text
from mwdcal.files.formats.table import Table
from mwdcal.files.statements import Said, SurveyTable
from mwdcal.geometry.vectors import AnyArray, Array, Bools
from mwdcal.library.answers import Said as Answered
from mwdcal.library.answers import by_column
from mwdcal.library.arrays import nearest
from mwdcal.library.results import Result, frame
from mwdcal.library.tasks import (
    RunSource,
    Tabular,
    _is_tabular,
    readings_of,
    table_in_memory,
    table_of,
)
from mwdcal.sensor.profile import Profile
from mwdcal.use.correction import warn_if_blank

if TYPE_CHECKING:
    from mwdcal.calibration.record import SignatureCheck
    from mwdcal.presentation.conversion import Converted, Exported
    from mwdcal.presentation.signature import LoadedCalibration
    from mwdcal.presentation.survey import SurveySummary
    from mwdcal.survey.acceptance import SurveyLimits
    from mwdcal.survey.error_model import ErrorModel
    from mwdcal.survey.interference import InterferenceSize, MultiStationAnalysis
    from mwdcal.survey.references import EarthReference, FilledRun
    from mwdcal.survey.surveying import SurveyedWell, WellInputs
    from mwdcal.survey.tool_model import SensorTerm
    from mwdcal.survey.well import Position

FilePath = str | os.PathLike[str]
KINDS_OF_EXPORT = ("firmware", "tool-model")
FORMS_OF_FIRMWARE = {"c": "c-header", "c-header": "c-header", "fixed-point": "fixed-point"}
"""Forms of firmware sources, and what the command calls them."""


@dataclass(frozen=True, repr=False, eq=False)
class PlaceReference(Result):
    """Gravity and magnetic field at a place and date, and what turns magnetic azimuths.

    Definition: true azimuth = magnetic + declination; grid azimuth = true - convergence.
    Units: as in the names; dip is positive down, declination and convergence are positive east. 1 g is 9.80665 m/s².
    `convergence_deg` is None where no grid was named. `sd_…` is the standard uncertainty that all stations share.
    `earth` is the whole record: `place`, model, sources and the uncertainty of each station alone.
    """

    gravity_g: float
    field_nt: float
    dip_deg: float
    declination_deg: float
    convergence_deg: float | None
    sd_gravity_g: float
    sd_field_nt: float
    sd_dip_deg: float
    sd_declination_deg: float
    earth: EarthReference

    @property
    def findings(self) -> list[Finding]:
        """The findings about the reference."""
        return self.earth.findings

    def _text(self) -> str:
        from mwdcal.presentation import reference as screen

        return screen.screen(self.earth, None, None)

    def _document(self, output: Path | None = None) -> dict[str, Any]:
        from mwdcal.presentation import reference as screen

        return _as_json(screen.document(self.earth, None, output))

    def save(self, path: FilePath) -> None:
        """Write the reference as JSON, the file that `survey` takes.

        Raises:
            InputError: the name does not end in .json, or the file cannot be written.
        """
        from mwdcal.presentation.text import to_json

        if Path(path).suffix.lower() != ".json":
            raise InputError(
                f"`path` '{path}': a reference is written as JSON. Name a file that ends in .json."
            )
        atomic.write(path, to_json(self._document(Path(path))) + "\n")

    def fill(self, run: Tabular, *, decimal: str = ".") -> FilledReferences:
        """The table of a run with blank gravity, field and dip filled; cells with a value keep it.

        `run` is a file, or columns by name.

        Raises:
            InputError: the run cannot be read, or states a north that the reference lacks.
        """
        from mwdcal.survey.references import fill

        table = table_of(run, "the run", lambda path: tables.read(path, decimal=decimal))
        return FilledReferences(self.earth, fill(table, self.earth))


@dataclass(frozen=True, repr=False, eq=False)
class FilledReferences(Result):
    """A run with the references of a place: `columns` of its table, and `cells` filled by column."""

    earth: EarthReference
    run: FilledRun

    @property
    def findings(self) -> list[Finding]:
        """The findings about the reference and of the run."""
        return [*self.earth.findings, *self.run.findings]

    @property
    def columns(self) -> Mapping[str, AnyArray]:
        """All columns of the filled table."""
        return _arrays(self.run.table, ())

    @property
    def cells(self) -> Mapping[str, int]:
        """How many cells were filled in each column."""
        return self.run.cells

    def _text(self) -> str:
        from mwdcal.presentation import reference as screen

        return screen.screen(self.earth, self.run, None)

    def _document(self) -> dict[str, Any]:
        from mwdcal.presentation import reference as screen

        return _as_json(screen.document(self.earth, self.run, None))

    def save(self, path: FilePath) -> None:
        """Write the filled table; the suffix is the format."""
        tables.write(path, self.run.table)


@dataclass(frozen=True, repr=False, eq=False)
class WellSurvey(Result):
    """The surveys of a well: their directions with uncertainties, whether each is accepted, and the path of the hole.

    `columns` has the names of the command's table; `signature` is what the signature of the calibration says.
    """

    surveyed: SurveyedWell
    signature: SignatureCheck

    @cached_property
    def _facts(self) -> SurveySummary:
        from mwdcal.presentation.survey import result_summary

        return result_summary(self.surveyed)

    @cached_property
    def _whole_table(self) -> Table:
        return self.surveyed.table

    @property
    def findings(self) -> list[Finding]:
        """The findings: of the multi-station analysis, then of the surveys."""
        from mwdcal.presentation.survey import all_findings

        return all_findings(self._facts)

    @cached_property
    def columns(self) -> Mapping[str, AnyArray]:
        """All columns of the readings, then the results; `accepted` is "true", "false", or blank if not judged."""
        results = self.surveyed.well.columns
        words = [name for name, values in results.items() if values.dtype.kind != "f"]
        return _arrays(self._whole_table, words)

    @property
    def accepted(self) -> Bools:
        """Surveys (n,) that were judged and lie within the limits."""
        judgement = self.surveyed.well.judgement
        return np.asarray(judgement.judged & judgement.accepted)

    @property
    def interference(self) -> InterferenceSize | None:
        """Axial and cross-axial interference, nT, with uncertainty; None without `msa`."""
        return self._facts.interference

    @property
    def analysis(self) -> MultiStationAnalysis | None:
        """The multi-station analysis, with a row for each survey; None without `msa`."""
        return self._facts.msa

    @property
    def path(self) -> Position | None:
        """Measured depth, and north, east and TVD (n, 3) with covariance, m; None without measured depths."""
        return self.surveyed.well.position

    @cached_property
    def contributions(self) -> Mapping[str, AnyArray] | None:
        """The causes of every 1σ: a row for each station and cause; None beyond 2000 surveys, and without azimuths."""
        from mwdcal.presentation.contributions import contribution_columns

        parts = self.surveyed.contributions
        if parts is None:
            return None
        columns = contribution_columns(parts, self.surveyed.well.length_unit).items()
        return {k: np.array(v, object) if isinstance(v, list) else v for k, v in columns}

    def save_listing(self, path: FilePath) -> None:
        """Write a survey listing for well-planning programs: MD, angles, position, section, closure, covariance.

        Raises:
            InputError: there is no path.
        """
        from mwdcal.presentation.listing import listing

        tables.write(path, listing(self.surveyed))

    def to_pandas(self) -> Any:
        """The columns as a table of pandas, with what the command's table states of itself in `attrs`."""
        return frame(self.columns, self._whole_table.metadata)

    def _text(self) -> str:
        from mwdcal.presentation.survey import whole_screen

        return whole_screen(self.surveyed, self._facts, self.signature)

    def _document(self) -> dict[str, Any]:
        from mwdcal.presentation.survey import document

        return _as_json(document(self.surveyed.inputs, self._facts, self.signature))

    def _page(self) -> str:
        from mwdcal.presentation.survey_page import render

        return render(self.surveyed, self.surveyed.well.findings)

    def msa_report(self, path: FilePath) -> None:
        """Write the page of the multi-station analysis.

        Raises:
            InputError: there is no such analysis.
        """
        from mwdcal.presentation.interference_page import render

        if self.surveyed.analysis is None:
            raise InputError("the surveys have no multi-station analysis. Survey with msa=True.")
        atomic.write(path, render(self.surveyed.analysis, self.surveyed.inputs.named))

    def save(self, path: FilePath) -> None:
        """Write the table of the command: the readings with the results beside them; the suffix is the format.

        WITSML has the covariance of the positions too.
        """
        with_covariance = Path(path).suffix.lower() == ".xml"
        whole = self.surveyed.table_with(True) if with_covariance else self._whole_table
        tables.write(path, whole)


@dataclass(frozen=True, repr=False, eq=False)
class Conversion(Result):
    """A calibration in another notation, in raw units: the arrays of each triad by name.

    `accelerometer["S"]` and so on; `magnetometer` is empty where the calibration has none.
    """

    converted: Converted

    @property
    def findings(self) -> list[Finding]:
        """The findings, such as a temperature outside the calibrated range."""
        return self.converted.findings

    @property
    def columns(self) -> Mapping[str, AnyArray]:
        """A row for each value: triad, name (as in the report: SFx, mxy), value, sd (NaN: undetermined) and unit."""
        from mwdcal.presentation.conversion import value_table

        return value_table(self.converted)

    def to_pandas(self) -> Any:
        """The columns as a table of pandas, with the temperature of the values, `temperature_c`, in `attrs`."""
        from mwdcal.presentation.conversion import stated_temperature

        return frame(self.columns, {"temperature_c": stated_temperature(self.converted)})

    @property
    def accelerometer(self) -> Mapping[str, Array]:
        """Arrays of the accelerometer: S and o, M and b, or SF, B and m."""
        return self._values("accelerometer")

    @property
    def magnetometer(self) -> Mapping[str, Array]:
        """The same of the magnetometer."""
        return self._values("magnetometer")

    @property
    def uncertainty(self) -> Mapping[str, Mapping[str, Array]]:
        """Standard uncertainties of the arrays by triad and name; NaN: undetermined."""
        return {name: triad.uncertainty for name, triad in self.converted.triads.items()}

    @property
    def covariance(self) -> Mapping[str, Array]:
        """Covariance by triad of all its values in their order, row by row."""
        return {name: triad.covariance for name, triad in self.converted.triads.items()}

    def _values(self, triad: str) -> Mapping[str, Array]:
        triads = self.converted.triads
        return triads[triad].values if triad in triads else {}

    def _text(self) -> str:
        from mwdcal.presentation.conversion import screen

        return screen(self.converted)

    def _document(self) -> dict[str, Any]:
        from mwdcal.presentation.conversion import document

        return _as_json(document(self.converted))

    def save(self, path: FilePath) -> None:
        """Write what the command writes: JSON."""
        from mwdcal.presentation.text import to_json

        atomic.write(path, to_json(self._document()) + "\n")


@dataclass(frozen=True, repr=False, eq=False)
class FirmwareExport(Result):
    """A calibration as C sources with test vectors."""

    exported: Exported

    @property
    def findings(self) -> list[Finding]:
        """The findings about the calibration."""
        return self.exported.findings

    @property
    def files(self) -> Mapping[str, str]:
        """The text of each file by its name."""
        return self.exported.sources.files

    @property
    def errors(self) -> Mapping[str, float]:
        """The largest differences from `apply`: vectors in g and the unit of the field, angles in degrees."""
        return self.exported.sources.errors

    def _text(self) -> str:
        from mwdcal.presentation.conversion import export_screen

        return export_screen(self.exported)

    def _document(self) -> dict[str, Any]:
        from mwdcal.presentation.conversion import export_document

        return _as_json(export_document(self.exported))

    def save(self, path: FilePath) -> None:
        """Write the files into the folder `path`, all or none."""
        with atomic.folder(Path(path)):
            atomic.write_all([(Path(path) / name, text) for name, text in self.files.items()])


@dataclass(frozen=True, repr=False, eq=False)
class ToolModelExport(Result):
    """The sensor terms of a calibrated tool, and its tool model for error-model programs: `text` is its JSON."""

    converted: Converted
    terms: Sequence[SensorTerm]
    text: str

    @property
    def findings(self) -> list[Finding]:
        """The findings, such as a temperature outside the calibrated range."""
        return self.converted.findings

    def _text(self) -> str:
        from mwdcal.presentation.conversion import terms_screen

        return terms_screen(self.converted, [*self.terms])

    def _document(self) -> dict[str, Any]:
        from mwdcal.presentation.conversion import terms_document

        return _as_json(terms_document(self.converted, [*self.terms]))

    def save(self, path: FilePath) -> None:
        """Write the tool model."""
        atomic.write(path, self.text)


def reference(
    *,
    latitude: float,
    longitude: float,
    altitude_m: float,
    date: str | datetime.date,
    model: Literal["wmm2025", "igrf14"] = "wmm2025",
    crs: str | None = None,
    gravity_g: float | None = None,
    field_nt: float | None = None,
    dip_deg: float | None = None,
    declination_deg: float | None = None,
    sd_gravity_g: float | None = None,
    sd_field_nt: float | None = None,
    sd_dip_deg: float | None = None,
    sd_declination_deg: float | None = None,
) -> PlaceReference:
    """Gravity, magnetic field and the norths of a place and date, each with its standard uncertainty.

    Definition: normal gravity of WGS84; main field by WMM2025 or IGRF-14. A measured value overrides the model.
    Units: degrees, metres above the ellipsoid, g of 9.80665 m/s², nT; north, east and down are positive.

    Args:
        latitude: geodetic.
        longitude: east positive.
        altitude_m: negative below the ellipsoid.
        date: a day, or text such as 2026-11-23.
        model: of the main field.
        crs: grid of the well plan, such as EPSG:23031, for its convergence.
        gravity_g: measured at the place; so are the three that follow.
        field_nt: strength of the magnetic field.
        dip_deg: positive down.
        declination_deg: positive east.
        sd_gravity_g: 1σ of the measured value; so are the three that follow.
        sd_field_nt: as above.
        sd_dip_deg: as above.
        sd_declination_deg: as above.

    Raises:
        InputError: a value that no place on Earth has, a date that cannot be read, an unknown model or grid.

    Example:
        `mwdcal.reference(latitude=60.4, longitude=5.3, altitude_m=40, date="2026-11-23").declination_deg`
    """
    from mwdcal.survey.references import MEASURABLE, reference_at

    given = {
        "gravity_g": gravity_g, "field_nt": field_nt, "dip_deg": dip_deg, "declination_deg": declination_deg,
        "sd_gravity_g": sd_gravity_g, "sd_field_nt": sd_field_nt, "sd_dip_deg": sd_dip_deg,
        "sd_declination_deg": sd_declination_deg,
    }  # fmt: skip
    values = {key: _number(key, value) for key, value in given.items() if value is not None}
    place = {"latitude": latitude, "longitude": longitude, "altitude_m": altitude_m}
    where = [_number(name, value) for name, value in place.items()]
    earth = reference_at(
        where[0], where[1], where[2], _day(date), model=model, crs=crs,
        measured={n: values[key] for n, key in MEASURABLE.items() if key in values},
        uncertainties={
            n: values[f"sd_{key}"] for n, key in MEASURABLE.items() if f"sd_{key}" in values
        },
    )  # fmt: skip
    names = [field.name for field in fields(PlaceReference) if field.name != "earth"]
    return PlaceReference(**{name: getattr(earth, name) for name in names}, earth=earth)


def survey(
    cal: Calibration | FilePath,
    readings: RunSource,
    *,
    reference: PlaceReference | EarthReference | FilePath | None = None,
    msa: bool = False,
    axial_correction: bool = False,
    limits: FilePath | SurveyLimits = "owsg-mwd",
    sensor_drift: FilePath | None = None,
    error_model: FilePath | ErrorModel = "owsg-mwd",
    runs: Sequence[tuple[Calibration | FilePath, RunSource]] = (),
    registry: FilePath | None = None,
    switch: tuple[float, float] = (3.0, 5.0),
    tie_in: Sequence[float] | None = None,
    section_azimuth: float = 0.0,
    length_unit: Literal["", "m", "ft", "usft"] = "",
    column: Mapping[str, str] | Answered | None = None,
    sheet: str = "",
    outside: Literal["blank", "refuse", "extrapolate"] = "blank",
    missing: Literal["refuse", "blank"] = "refuse",
    decimal: str = ".",
    keys: Iterable[FilePath] = (),
) -> WellSurvey:
    """The surveys of a well: readings in their order, corrected by the calibration of their tool.

    Definition: inclination, azimuth, toolface, |g|, |b| and dip with standard uncertainties; whether each survey lies
    within the limits; with measured depths (`md_m`, `md_ft`, `md_usft`) north, east and TVD by minimum curvature.
    Singular: at vertical azimuth and gravity toolface are NaN.

    Args:
        cal: a calibration, or its file; `cals.parquet#SERIAL` and `tools.sqlite#SERIAL` too.
        readings: a file, columns by name, a table of pandas or polars, or `Readings`: those of `read_run` have the
            depths of their table, those of arrays `mwdcal.readings(…, md_m=…)`. Or an array, as of `calibrate`.
        reference: gravity, field, dip and declination of the place, from `reference` or its file.
        msa: take the interference of the drill string off the magnetometer, by multi-station analysis.
        axial_correction: also correct each survey by itself: columns `azimuth_…_axial_deg`, with a no-go zone.
        limits: on |g|, |b| and dip: owsg-mwd, iscwsa-fixed, fixed, or a TOML file.
        sensor_drift: with `msa`, drift of the sensors since the calibration, 1σ: owsg (the default), none, or a file.
        error_model: what the standard uncertainties hold besides calibration, noise and declination: owsg-mwd,
            none, or a file in ISCWSA's JSON form.
        runs: the runs of the same well that follow, each a calibration and readings: their path goes on where the run
            before ended.
        registry: URL or file of a registry; the random walk of the tool that its calibrations show is the drift
            since the calibration, instead of that of the error model.
        switch: inclinations, degrees, below which the toolface counts from magnetic north, and above which from the
            high side.
        tie_in: north, east and TVD of the first station, in `length_unit`; or measured depth, inclination, azimuth
            (degrees, from the north of the path), north, east and TVD of the point where the path is tied in.
        section_azimuth: of the vertical section, degrees from the north of the path.
        length_unit: of the results and of `tie_in`, and of depths whose column states none: m (the default), ft, or
            usft (1200/3937 m).
        column: answers which column is which, as of `propose_profile`: `{"ax": "Gx 1", "md_m": "Hole depth"}`.
        sheet: of a workbook.
        outside: what becomes of readings outside the calibrated temperatures.
        missing: rows without a reading, such as a tie-in station: refuse the table, or leave their results blank.
        decimal: decimal sign of a text file.
        keys: files of public keys to trust, by which the signature of the calibration is checked.

    Raises:
        InputError: an input that cannot be read or does not belong to the calibration, or an unknown word.
        FitError: a column leaves a question open; with `msa`, the surveys do not separate interference from azimuth.

    Example:
        `here = mwdcal.reference(latitude=60.4, longitude=5.3, altitude_m=40, date="2026-11-23")`, then
        `well = mwdcal.survey(cal, "well.csv", reference=here, msa=True)`, then
        `well.columns["azimuth_true_deg"]` and `well.interference.axial_nt`.
    """
    from mwdcal.presentation.signature import load_calibration
    from mwdcal.survey.runs import survey_runs
    from mwdcal.survey.surveying import analysed, check_drift, start_of

    check_drift(sensor_drift, msa)
    ends: Any = tuple(np.radians(_finite("switch", switch, 2)).tolist())
    numbers = None if tie_in is None else _finite("tie_in", tie_in, len(tie_in))
    start = None if numbers is None else start_of(numbers, length_unit or "m")
    loaded = [
        load_calibration(_source(tool), [Path(key) for key in keys])
        for tool in (cal, *(tool for tool, _ in runs))
    ]
    said = Said(decimal, sheet=sheet, columns=by_column("column", column))
    azimuth = _number("section_azimuth", section_azimuth)
    how = (_earth(reference), limits, msa, error_model, missing, azimuth, length_unit, registry)
    tables = (readings, *(table for _, table in runs))
    inputs = [_inputs(tool, table, said, how) for tool, table in zip(loaded, tables, strict=True)]
    analyses = [analysed(each, sensor_drift) if msa else None for each in inputs]
    for analysis in filter(None, analyses):
        analysis.check()
    way: Any = {"tie_in": start, "switch": ends, "outside": outside, "axial": axial_correction}
    result = survey_runs(inputs, analyses, **way)
    warn_if_blank(result.well.columns, result.well.findings)
    return WellSurvey(result, loaded[0].signature)


def convert(
    cal: Calibration | FilePath,
    notation: Literal["factors", "forward", "affine"],
    *,
    temperature: float | Literal["course"] | None = None,
) -> Conversion:
    """A calibration in another notation, in raw units, with covariance.

    Definition: forward: raw = S · field + o; affine: field = M · raw + b; factors: SF, B and m (Moosavi).
    Units: `temperature` in °C, by default the reference temperature; "course": coefficients by power of
    T - reference.

    Raises:
        InputError: an unknown notation, a temperature that is not possible, or a course that is no polynomial.

    Example:
        `mwdcal.convert(cal, "forward").accelerometer["S"]`
    """
    from mwdcal.presentation.conversion import converted

    return Conversion(converted(_source(cal), notation, temperature))


@overload
def export(
    cal: Calibration | FilePath,
    kind: Literal["firmware"],
    *,
    form: Literal["c", "c-header", "fixed-point"] = "c",
    word_bits: int | None = None,
) -> FirmwareExport: ...


@overload
def export(
    cal: Calibration | FilePath,
    kind: Literal["tool-model"],
    *,
    temperature: float | None = None,
    toolface_deg: float | None = None,
) -> ToolModelExport: ...


def export(
    cal: Calibration | FilePath,
    kind: str,
    *,
    form: str | None = None,
    word_bits: int | None = None,
    temperature: float | None = None,
    toolface_deg: float | None = None,
) -> FirmwareExport | ToolModelExport:
    """A calibration for other programs: C sources for firmware, or a tool model for error-model programs.

    `form` of firmware is c (double precision) or fixed-point, with whole numbers of `word_bits` (12 to 32, by default
    32). `temperature`, °C, is that of a tool model, by default the middle of the calibrated range; `toolface_deg` the
    gravity toolface of a tool that does not turn, whose terms are of each axis (else they are averaged over toolface).

    Raises:
        InputError: an unknown kind or form, or an argument of the other kind.
        FitError: a term of the tool model is undetermined.

    Example:
        `mwdcal.export(cal, "firmware", form="c").save("firmware")`
    """
    from mwdcal.presentation import conversion

    _check_word("kind", kind, KINDS_OF_EXPORT)
    if kind == "tool-model":
        for name, value in (("form", form), ("word_bits", word_bits)):
            if value is not None:
                raise InputError(f"`{name}` goes with the kind firmware. Leave it out.")
        return ToolModelExport(*conversion.terms_at(_source(cal), temperature, toolface_deg))
    if temperature is not None:
        raise InputError("`temperature`: sources hold for all temperatures. Leave it out.")
    if toolface_deg is not None:
        raise InputError("`toolface_deg` goes with the kind tool-model. Leave it out.")
    form = "c" if form is None else form
    _check_word("form", form, FORMS_OF_FIRMWARE)
    return FirmwareExport(conversion.exported(_source(cal), FORMS_OF_FIRMWARE[form], word_bits))


def _with_walk(inputs: WellInputs, registry: FilePath | None) -> WellInputs:
    """The inputs with the random walk of their tool, where a registry is named."""
    if registry is None:
        return inputs
    from mwdcal.library.drifts import with_walk

    return with_walk(inputs, os.fspath(registry))


def _inputs(tool: LoadedCalibration, readings: RunSource, said: Said, how: Any) -> WellInputs:
    """The inputs of a run: its calibration and its table."""
    from mwdcal.presentation.readings import inputs_of_run

    *how, registry = how
    named = _survey_table(readings, tool.calibration, said)
    return _with_walk(inputs_of_run(tool, named, how), registry)


def _source(cal: object) -> Calibration | FilePath:
    """A calibration or its file; refuses anything else."""
    if isinstance(cal, Calibration | str | os.PathLike):
        return cal
    raise InputError(
        f"`cal` must be a calibration or its file; got {type(cal).__name__}. Make one by mwdcal.calibrate(…)."
    )


def _earth(reference: object) -> EarthReference | FilePath | None:
    """The reference of a place, or its file."""
    from mwdcal.survey.references import EarthReference

    if isinstance(reference, PlaceReference):
        return reference.earth
    if reference is None or isinstance(reference, EarthReference | str | os.PathLike):
        return reference
    raise InputError(
        f"`reference` must be that of a place, or its file; got {type(reference).__name__}. Make one by "
        "mwdcal.reference(…)."
    )


def _survey_table(readings: RunSource, calibration: Calibration, said: Said) -> SurveyTable:
    """The table of readings, under its own names."""
    from mwdcal.presentation.readings import read_surveys

    if isinstance(readings, Readings) or not _is_tabular(readings):
        readings = readings_of(readings, "readings", calibration.profile)
        calibration.check_scales(readings)
        return SurveyTable(_table_of(readings, calibration.profile), calibration)
    if not isinstance(readings, str | os.PathLike):
        readings = table_in_memory(readings, "the readings")
    return read_surveys(readings, calibration, said)


def _table_of(readings: Readings, profile: Profile) -> Table:
    """The table of readings in the raw units of a profile, with the columns of their own table that it lacks."""
    table = runs.from_readings(runs.away_from_stand(readings, profile), profile)
    beside = {
        name: [as_text(cell) for cell in values.tolist()] if values.dtype.kind in "OUS" else values
        for name, values in readings.table.items()
    }
    there = runs.renamed(Table(beside, {}, table.source), readings.profile or profile).columns
    others = {name: cells for name, cells in there.items() if name not in COLUMNS}
    return replace(table, columns={**readings.others, **table.columns, **others})


def _arrays(table: Table, words: Iterable[str]) -> dict[str, AnyArray]:
    """The columns of a table as arrays: numbers where all cells are, but labels and `words` as text."""
    arrays: dict[str, AnyArray] = {}
    for name, cells in table.columns.items():
        if not isinstance(cells, list):
            arrays[name] = cells
            continue
        arrays[name] = np.array(cells, dtype=object)
        if name not in (*LABELS, *words):
            try:
                arrays[name] = tables.numbers(table, name)
            except InputError:
                continue
    return arrays


def _as_json(document: dict[str, Any]) -> dict[str, Any]:
    """A document as its JSON reads: no NaN, no tuples."""
    import msgspec

    return msgspec.json.decode(msgspec.json.encode(document), type=dict[str, Any])


def _number(name: str, value: object) -> float:
    """A number; whether it can be is checked where it is used."""
    try:
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise InputError(
            f"`{name}` must be a number; got {value!r}. Give it without a unit."
        ) from None


def _finite(name: str, values: object, count: int) -> list[float]:
    """So many finite numbers."""
    numbers = [_number(name, value) for value in values] if isinstance(values, Iterable) else []
    if len(numbers) != count or not all(abs(value) < 1e9 for value in numbers):
        raise InputError(f"`{name}` must be {count} finite numbers; got {values!r}.")
    return numbers


def _day(date: object) -> datetime.date:
    """A day, from its text too."""
    if isinstance(date, datetime.datetime):
        return date.date()
    if isinstance(date, datetime.date):
        return date
    try:
        return datetime.date.fromisoformat(str(date))
    except ValueError:
        raise InputError(
            f"`date` must be a day, written year-month-day such as 2026-11-23; got {date!r}. Correct it."
        ) from None


def _check_word(name: str, word: str, words: Iterable[str]) -> None:
    """Refuse a word that is not one of some."""
    if word not in words:
        raise InputError(
            f"`{name}` must be one of {', '.join(words)}; got {word!r}.{nearest(str(word), words)}"
        )
