"""The tool profile: which axis each channel measures, nominal scales, noise, stand.

Instrument polarity and raw units live here and nowhere else: `files.runs` turns
raw channels into nominal readings along the tool axes with it, and `notation`
turns fitted parameters back into the instrument's own channels.

The datasheet of a servo instrument: what tolerances are where a profile states none; and its noise, for plans.
"""

from __future__ import annotations

from datetime import date
from typing import Literal

import msgspec
import numpy as np

from mwdcal.errors import InputError
from mwdcal.geometry.vectors import Array

COMMON = ("azimuth-zero", "toolface-zero", "inclination-zero", "tilt", "tool-axis")
"""Errors of the stand that all its stations have in common; in a profile `azimuth_zero_deg` …"""

PRACTICES = ("per-direction", "per-station")
"""How often the operator sets the direction of a stand: once for a roll set, or at every station."""

Axis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]


class Datasheet(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The maker's tolerances of a triad, 1 σ, used as a prior where the options say so.

    `scale` as a share, `bias` in g or nT, `misalignment_deg`; `scale_per_c` and `bias_per_c`
    their drift per °C. Missing values are unknown.
    `turn_on` is the bias that each switching on leaves, `bias_walk` and `scale_walk` what bias and
    scale change by in a year; they grow with the square root of time. They age the prior that an
    earlier calibration is.
    """

    scale: float | None = None
    bias: float | None = None
    misalignment_deg: float | None = None
    scale_per_c: float | None = None
    bias_per_c: float | None = None
    turn_on: float | None = None
    bias_walk: float | None = None
    scale_walk: float | None = None


class TriadProfile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Three channels of one kind: axes, nominal scale and noise, in raw units.

    `scale` is raw units per g (accelerometer) or per nT (magnetometer); None means
    unknown: it is then taken from the readings and cannot serve as a check.
    `noise` is the standard uncertainty of one station's raw reading (None: it is
    estimated from the residuals); `repeatability` is added to it in quadrature. `drift` is how far an
    axis's offset moves from the first station of a run to the last.
    `nonlinearity` is the linearity error of the datasheet as a share of the field (1 σ, for
    example 0.005): each axis then has its own quadratic and cubic term with that prior.
    `datasheet` are the maker's tolerances.
    """

    axes: tuple[Axis, Axis, Axis] = ("+x", "+y", "+z")
    scale: float | None = None
    noise: float | None = None
    repeatability: float = 0.0
    drift: float = 0.0
    nonlinearity: float | None = None
    datasheet: Datasheet | None = None

    @property
    def permutation(self) -> Array:
        """The signed permutation P (3, 3): tool axes from channels."""
        matrix = np.zeros((3, 3))
        for channel, (sign, axis) in enumerate(self.axes):
            matrix["xyz".index(axis), channel] = 1.0 if sign == "+" else -1.0
        return matrix


class StandProfile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Standard uncertainties (1 σ) of the references that a stand gives.

    `inclination_deg` … are of one setting, where the run does not state its own; `repeatability_…` is
    added to either in quadrature. Toolface is set at every station. The others are errors
    that all stations have in common: zeros of the three scales, the lean of the stand's vertical, that of the tool's
    axis from the one that the stand rolls it about, and the references for gravity, field and dip where the run does
    not state their uncertainty.
    `field_drift_nt` is how far north, east and down of the field move from the first station to the last.
    `coil`: the field is made by a coil or simulated, and may be of any strength.
    `settings`: "per-direction" where the operator sets inclination and azimuth once and rolls the
    tool, "per-station" where the stand is set anew at every station.
    """

    inclination_deg: float = 0.0
    azimuth_deg: float = 0.0
    toolface_deg: float = 0.0
    repeatability_inclination_deg: float = 0.0
    repeatability_azimuth_deg: float = 0.0
    repeatability_toolface_deg: float = 0.0
    inclination_zero_deg: float = 0.0
    azimuth_zero_deg: float = 0.0
    toolface_zero_deg: float = 0.0
    tilt_deg: float = 0.0
    tool_axis_deg: float = 0.0
    gravity_g: float = 0.0
    field_nt: float = 0.0
    field_drift_nt: float = 0.0
    dip_deg: float = 0.0
    coil: bool = False
    settings: Literal["per-direction", "per-station"] | msgspec.UnsetType = msgspec.UNSET

    def of(self, column: str) -> float:
        """Standard uncertainty of a reference such as "azimuth_deg" where the run states none."""
        return float(getattr(self, column))

    @property
    def practice(self) -> str:
        """Its `settings`; blank where they are not stated."""
        return self.settings if isinstance(self.settings, str) else ""

    def repeatability(self, column: str) -> float:
        """Repeatability to add to the standard uncertainty of an angle in quadrature; strengths have none."""
        return float(getattr(self, f"repeatability_{column}", 0.0))

    def common(self) -> dict[str, float]:
        """Standard uncertainties, in degrees, of errors of the stand that all stations share."""
        values = {name: self.of(f"{name.replace('-', '_')}_deg") for name in COMMON}
        return {name: value for name, value in values.items() if value}


class TableFormat(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How the tables of a logger or a spreadsheet program are written.

    `header_line` holds the column names, `first_line` the first readings; what stands above and
    between is not read. A workbook has only these two, which count its rows. Where `find` is set, the table is
    looked for by the names of its columns instead, on the sheet named, if any. `azimuth_reference` and its angles are
    those of tables that do not state them. `ignore` are columns, and references above them, that are no evidence
    whatever they are called. `leave_out` and `keep` say by the texts of a column which rows of a run are rejected, and
    which are not. A blank cell in the columns of `fill_down` is that of the row above: angles written once for a
    series of rolls.
    """

    encoding: Literal[
        "utf-8",
        "utf-16",
        "utf-16-le",
        "utf-16-be",
        "cp1252",
        "cp1251",
        "gb18030",
        "cp932",
        "cp949",
        "cp1250",
        "cp1254",
        "cp850",
        "cp866",
        "koi8-r",
        "iso8859-5",
        "mac-roman",
    ] = "utf-8"
    delimiter: Literal[",", ";", "\t", "|"] = ","
    decimal: Literal[".", ","] = "."
    header_line: int = 1
    first_line: int = 2
    find: bool = False
    sheet: str = ""
    azimuth_reference: Literal["", "magnetic", "true", "grid"] = ""
    declination_deg: float | None = None
    convergence_deg: float | None = None
    ignore: tuple[str, ...] = ()
    leave_out: dict[str, tuple[str, ...]] = {}
    keep: dict[str, tuple[str, ...]] = {}
    fill_down: tuple[str, ...] = ()

    @property
    def north(self) -> dict[str, object]:
        """What its azimuths count from, as metadata of a run state it; empty where it is not stated."""
        keys = ("azimuth_reference", "declination_deg", "convergence_deg")
        return {key: value for key in keys if (value := getattr(self, key)) not in ("", None)}


class ColumnSource(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The column of a table that holds a quantity under another name, and the unit it is in there.

    Without `unit` it is in the unit of the run file. `instead_of` is the unit that the table states for it wrongly.
    """

    name: str
    unit: str = ""
    instead_of: str = ""


class StreamForm(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How a line of the tool's live stream is read, by `mwdcal bench`.

    `columns` are `ax` … `mz`, `temperature_c` and `time_s` in their order, any other name is not read; `separator` is
    blank for white space. Instead of both a regular expression `pattern` with groups of these names. `units` of the
    temperature, such as "°F"; channels are raw.
    """

    columns: tuple[str, ...] = ()
    separator: str = ","
    pattern: str = ""
    units: dict[str, str] = {}


class MeasurementStandard(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The standards to which the references of a calibration are traceable: a stand, a magnetometer, a gravity survey.

    `certificate` is the number of its own calibration certificate, of `issued`, by `issuer`; `due` the
    day from which it no longer holds.
    """

    quantity: Literal["stand", "gravity", "field", "dip", "temperature"]
    name: str
    serial: str = ""
    certificate: str = ""
    issuer: str = ""
    issued: date | None = None
    due: date | None = None


class Person(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Who measured, or who authorised the certificate."""

    name: str
    function: str = ""


class Profile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A tool as its maker describes it: see `docs/reference/files.md` for the TOML form.

    `standards` are what the references of its calibrations are traceable to.
    `table` and `columns` say how its tables are written, and which of their columns is which of the
    run file's; without them tables are run files as documented.
    """

    name: str
    reference_temperature_c: float = 30.0
    accelerometer: TriadProfile = TriadProfile()
    magnetometer: TriadProfile = TriadProfile()
    stand: StandProfile = StandProfile()
    standards: tuple[MeasurementStandard, ...] | msgspec.UnsetType = msgspec.UNSET
    table: TableFormat | msgspec.UnsetType = msgspec.UNSET
    columns: dict[str, ColumnSource] | msgspec.UnsetType = msgspec.UNSET
    stream: StreamForm | msgspec.UnsetType = msgspec.UNSET

    @property
    def form(self) -> TableFormat:
        """How its tables are written; the usual form where it does not say."""
        return TableFormat() if isinstance(self.table, msgspec.UnsetType) else self.table

    @property
    def has_magnetometer(self) -> bool:
        """Whether it says anything of a magnetometer; with readings of one it may still say nothing."""
        return self.magnetometer != TriadProfile()

    def with_stand(self, **values: float | str) -> Profile:
        """The profile with other values of its stand, by the names and in the units of `StandProfile`.

        Raises:
            InputError: a name or a value that a stand cannot have.

        >>> NOMINAL.with_stand(inclination_deg=0.02, settings="per-station").stand.inclination_deg
        0.02
        """
        stated = {**msgspec.to_builtins(self.stand), **values}
        try:
            stand = msgspec.convert(stated, StandProfile)
        except msgspec.ValidationError as error:
            raise InputError(
                f"the stand: {error}. Give it as in [stand] of a tool profile."
            ) from None
        return msgspec.structs.replace(self, stand=stand)


_UNSCALED = TriadProfile(scale=1.0)
NOMINAL = Profile(name="nominal", accelerometer=_UNSCALED, magnetometer=_UNSCALED)
"""The profile of arrays: raw readings are nominal g and nT along the tool axes."""


ROOT3 = np.sqrt(3.0)
"""Half the width of a uniform distribution, in its standard deviations."""
SERVO = {
    "accelerometer": Datasheet(
        scale=0.05 / ROOT3, bias=0.010 / ROOT3, misalignment_deg=np.degrees(2e-3) / ROOT3,
        scale_per_c=180e-6 / ROOT3, bias_per_c=100e-6 / ROOT3,
    ),
    "magnetometer": Datasheet(
        scale=0.02 / ROOT3, bias=500.0 / ROOT3, misalignment_deg=np.degrees(4e-3) / ROOT3,
        scale_per_c=100e-6 / ROOT3, bias_per_c=2.0 / ROOT3,
    ),
}  # fmt: skip
"""A servo instrument within the limits of Moosavi's Table 1, 1σ of uniform distributions.

Scale ± 5 %, bias ± 10 mg, axis alignment ± 2 mrad, scale drift ± 180 ppm/°C, bias drift ± 100 µg/°C.
The magnetometer: scale ± 2 %, hard iron ± 1 % of 50 µT, alignment ± 4 mrad.
"""
USUAL_NOISE = {"accelerometer": 1e-4, "magnetometer": 15.0}
"""Noise of one station's reading of a servo instrument, g and nT, 1σ."""
AGEING = ("turn_on", "bias_walk", "scale_walk")
"""The changes of a tool between calibrations."""
USUAL_AGEING = {
    "accelerometer": Datasheet(turn_on=4e-4, bias_walk=4e-4, scale_walk=5e-4),
    "magnetometer": Datasheet(turn_on=70.0, bias_walk=70.0, scale_walk=1.6e-3),
}
"""Allowance of the OWSG error model (Rev 5.1, MWD) for a sensor between calibrations, 1σ, taken as a year's walk.

ABXY, ABXY, ASXY; MBXY, MBXY, MSXY.
"""


def ageing(profile: Profile, triad: str, name: str) -> float:
    """Turn-on bias or walk in a year of a triad: as its profile states it, else that of `USUAL_AGEING`."""
    sheet, usual = getattr(profile, triad).datasheet, USUAL_AGEING[triad]
    stated = None if sheet is None else getattr(sheet, name)
    return float(getattr(usual, name) if stated is None else stated)


def tolerance(profile: Profile, triad: str, name: str) -> float:
    """A tolerance of a triad, such as "bias_per_c": as its profile states it, else that of `SERVO`."""
    sheet, usual = getattr(profile, triad).datasheet, SERVO[triad]
    stated = None if sheet is None else getattr(sheet, name)
    return float(getattr(usual, name) if stated is None else stated)
