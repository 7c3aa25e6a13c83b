"""`Calibration`: what a fit leaves behind, and what is applied to readings ever after.

The record is the file: every number is rounded to 12 significant digits when it is made, so
a calibration in memory and one read back give the same results.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import date, datetime
from itertools import pairwise
from typing import Any, ClassVar, Literal, NamedTuple, TypeVar

import msgspec
import numpy as np

from mwdcal import __version__
from mwdcal.calibration.readings import (
    NANOTESLA,
    SOAK_GAP,
    Readings,
    ReadingsLike,
    as_readings,
    serial_of,
    simulated,
    stated_day,
)
from mwdcal.digests import sha256_of
from mwdcal.errors import InputError
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import Array, Bools, diagonal
from mwdcal.sensor.models import Basis, Factors, Polynomial, Whole
from mwdcal.sensor.profile import Profile

# --------------------------------------------------------------------------
# The interval of an inclination near vertical, where its error is the length of a vector.


def tilt_width(g: Array, spread: Array, width: Array, freedom: float, probability: float) -> Array:
    """Half width (…, n) of inclination: `width` away from vertical, that of a tilt near it.

    From gravity (…, n, 3) and the covariance `spread` (…, n, 2, 2) of its share across the tool axis.
    Definition: the tilt (gx, gy) / |g| has two errors, and with their larger uncertainty u its
    error is below k u, k² = ν ((1 - p)^(-2/ν) - 1), Hotelling's for two. The one takes over from
    the other between tilts of k u and 2 k u. Reference: JCGM 102, 7.
    """
    half, odd = (spread[..., 0, 0] + spread[..., 1, 1]) / 2, spread[..., 0, 1]
    largest = half + np.hypot((spread[..., 0, 0] - spread[..., 1, 1]) / 2, odd)
    factor = freedom * np.expm1(-2 / freedom * np.log1p(-probability))
    near = np.sqrt(np.maximum(largest, 0.0) * factor)
    tilt = np.linalg.norm(g[..., :2], axis=-1) / np.linalg.norm(g, axis=-1)
    share = np.clip(tilt / np.maximum(near, 1e-300) - 1, 0.0, 1.0)
    share = share**2 * (3 - 2 * share)
    return np.asarray(near + share * (width - near) + 0 * width)


# --------------------------------------------------------------------------
# How results show themselves in notebooks.


def html_table(caption: str, rows: Iterable[tuple[str, ...]]) -> str:
    """A table for notebooks: a heading, then the cells of each row as text."""
    from html import escape

    lines = ("".join(f"<td>{escape(cell)}</td>" for cell in row) for row in rows)
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f"<table><caption>{escape(caption)}</caption>{body}</table>"


# --------------------------------------------------------------------------
# Documents as they are hashed and signed: one form for all that say the same.

Record = TypeVar("Record", bound=msgspec.Struct)
DIGITS = 12
"""Significant digits of every number in a calibration file."""
POWERS = np.array([10**power for power in range(23)], float)
"""The powers of ten that are doubles."""
HALFWAY = 1e-3
"""What rounding may do to a whole number of that many digits, and more."""
UNHASHED = ("time", "sha256", "signature")
"""Fields of a calibration that its `sha256` is not of."""


class Signature(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A signature of the document that it stands in: of its `canonical` JSON, all but `value`.

    `key` is the SHA-256 of the raw public key, hexadecimal, its first 16 digits; `time` (UTC) is part
    of what is signed; `value` in base64.
    """

    algorithm: Literal["Ed25519"] = "Ed25519"
    key: str
    time: str
    value: str


SignatureState = Literal[
    "unsigned", "intact", "altered", "unknown", "revoked", "retired", "unchecked"
]
"""State of a document's signature: `mwdcal.certificate.signature.STATES` has a sentence for each."""


class SignatureCheck(msgspec.Struct, frozen=True, kw_only=True):
    """State of a document's signature: `state` for machines, `text` for people.

    `key`, `owner` and `time` (the signer's, UTC) as far as they are known. Only `intact` shows that the document is
    as it was signed, with a key that is trusted; `unchecked`: cryptography is not installed.
    """

    state: SignatureState
    key: str | None = None
    owner: str | None = None
    time: str | None = None
    text: str


def canonical(fields: Mapping[str, Any]) -> bytes:
    """The one form in which fields are hashed and signed: compact JSON in ASCII with sorted keys.

    Raises:
        InputError: a number is infinite or none.
    """
    try:
        text = json.dumps(fields, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except ValueError as error:
        raise InputError(
            "a number of the document is infinite, or none: values of extreme size make it so. Check the units and "
            "uncertainties of the input."
        ) from error
    return text.encode()


def signed_form(fields: Mapping[str, Any]) -> bytes:
    """The only form that the file of a signed document may have: `canonical` with two spaces of indent."""
    return json.dumps(fields, sort_keys=True, indent=2, allow_nan=False).encode() + b"\n"


def document_sha256(fields: Mapping[str, Any]) -> str:
    """The `content_sha256` of a calibration file, whose fields are these."""
    kept = {name: value for name, value in fields.items() if name not in UNHASHED}
    return sha256_of(canonical(kept))


def rounded(record: Record) -> Record:
    """The same record with every number at 12 significant digits, as files keep it.

    More digits would differ from machine to machine with the threads of its linear algebra.
    """
    fields = msgspec.to_builtins(record)
    return msgspec.convert(_with(iter(figures(numbers(fields))), fields), type(record))


def numbers(document: Any) -> Array:
    """All numbers with a fraction in a document, in their order."""
    values: list[float] = []
    _collect(document, values)
    return np.array(values)


def _collect(value: Any, values: list[float]) -> None:
    for item in value.values() if isinstance(value, dict) else value:
        if isinstance(item, float):
            values.append(item)
        elif isinstance(item, dict | list | tuple):
            _collect(item, values)


def _with(new: Iterator[float], value: Any) -> Any:
    """A document with other `numbers`."""
    items = [
        next(new)
        if isinstance(item, float)
        else _with(new, item)
        if isinstance(item, dict | list | tuple)
        else item
        for item in (value.values() if isinstance(value, dict) else value)
    ]
    return dict(zip(value, items, strict=True)) if isinstance(value, dict) else items


@np.errstate(all="ignore")
def figures(values: Array) -> Any:
    """Numbers (...) at so many significant digits as a file has, each the double nearest to its decimal, as lists.

    A whole number of that many digits over a power of ten, both exact doubles, is that nearest double. A number too
    small or too large for this, or so near to halfway that the product may have crossed it, is spelled.
    """
    size = np.abs(values)
    power = DIGITS - 1 - np.floor(np.log10(size))
    known = np.abs(power) < len(POWERS)
    scale = POWERS[np.where(known, np.abs(power), 0.0).astype(int)]
    scaled = np.where(power >= 0, size * scale, size / scale)
    whole = np.rint(scaled)
    known &= (whole >= POWERS[DIGITS - 1]) & (whole < POWERS[DIGITS])
    known &= np.abs(np.abs(scaled - whole) - 0.5) > HALFWAY
    rounded = np.array(np.copysign(np.where(power >= 0, whole / scale, whole * scale), values))
    spelled = [float(f"{value:.{DIGITS - 1}e}") for value in values[~known].tolist()]
    rounded[~known] = spelled
    return rounded.tolist()


# --------------------------------------------------------------------------
# Constants of a run, and drifts within it, as a calibration file states them.

SHOWN_DRIFT = 3.0
"""A drift is a finding if it is so many times its standard uncertainty; smaller ones are in the uncertainty too."""
LEAST_DRIFT = 0.01
"""Smallest drift, with its 1σ, that is stated, as a share of the noise of a reading: a smaller one moves no angle."""

LEAST_ADDED = 5e-5
"""Smallest effect of a drift on an angle that is named, degrees…"""
ADDED_SHARE = 0.05
"""…and as a share of its effect on the angle that it moves most."""

STEADINESS = {
    "accelerometer-drift": "steady accelerometer offsets",
    "magnetometer-drift": "steady magnetometer offsets",
    "field-drift": "steady field",
}
"""Assumption of a calibration whose run could not show a drift, by the name of the drift."""


STATE_STAND = (
    "The angles of the stand count as exact: first state their 1σ, under [stand] in the tool profile or by `sd` of "
    "mwdcal.readings. "
)
"""Of angles without uncertainty findings say so, where their errors may explain what is found."""
ALIGNMENT = "alignment of the tool in the stand"
"""The name of what a tool's axis that is not the one it is rolled about does."""
LEAN = "A tool that leans by 0.05° in the stand is off by up to 0.05° in inclination, 0.07° in azimuth at 45°"
"""The consequence: an error δ of inclination and δ / sin I of azimuth."""
THERMOMETER = "sensors at the temperature of the thermometer"
"""Assumption of a calibration over temperatures that went one way."""


def exact_and_steady(assumed: Sequence[str]) -> tuple[list[str], str]:
    """The references among things assumed exact, and sentences on other conditions; blank if none is assumed.

    >>> exact_and_steady(["gravity reference", "steady field"])[1].partition(". ")[0]
    'Assumed steady, as the order of the stations would hide a drift: field'
    """
    conditions = {*STEADINESS.values(), THERMOMETER}
    exact = [name for name in assumed if name not in conditions]
    steady = ", ".join(n.removeprefix("steady ") for n in assumed if n in STEADINESS.values())
    sentences = []
    if steady:
        words = "Assumed steady, as the order of the stations would hide a drift"
        remedy = "Measure out and back, or declare the drift in the tool profile"
        sentences.append(f"{words}: {steady}. {remedy}")
    if THERMOMETER in assumed:
        words = "as temperatures that go one way would hide a lead or lag"
        remedy = "Measure on the way back too"
        sentences.append(f"Assumed, {words}: {THERMOMETER}. {remedy}")
    return exact, ". ".join(sentences)


class Constant(msgspec.Struct, frozen=True, kw_only=True):
    """A constant of the run that was estimated, with its standard uncertainty."""

    name: str
    value: float
    standard_uncertainty: float
    unit: str


class Drift(msgspec.Struct, frozen=True, kw_only=True):
    """A drift within the run that is part of the fit: the largest change between two stations, 1σ, and unit.

    `name`: "field", or the triad whose offsets drifted. `declared`: 1σ per axis of the change from the first station
    to the last, as declared; absent where the drift is not declared, but seen in the residuals.
    """

    name: str
    change: float
    standard_uncertainty: float
    unit: str
    declared: float | msgspec.UnsetType = msgspec.UNSET


class UnseenDrift(msgspec.Struct, frozen=True, kw_only=True):
    """A drift that no residual would show, and what it would add to the accuracy to expect: 1σ at 45° inclination.

    `change`: 1σ per axis from the first station to the last, an example.
    """

    name: str
    change: float
    unit: str
    inclination_deg: float | None = None
    toolface_deg: float | None = None
    azimuth_deg: float | None = None


def declared_drift(drifts: Sequence[Drift]) -> str:
    """A sentence on the drifts that are declared, or blank.

    >>> declared_drift([Drift(name="field", change=31.0, standard_uncertainty=9.0, unit="nT", declared=40.0)])
    'declared drift from the first station to the last, 1σ, which the uncertainty includes: field 40 nT'
    """
    sizes = [
        f"{each.name} {each.declared:.3g} {each.unit}"
        for each in drifts
        if not isinstance(each.declared, msgspec.UnsetType)
    ]
    words = "declared drift from the first station to the last, 1σ, which the uncertainty includes"
    return f"{words}: {', '.join(sizes)}" if sizes else ""


def blindness(unseen: Sequence[UnseenDrift] | msgspec.UnsetType) -> str:
    """A sentence on what small drifts would do that no residual would show, or blank.

    >>> blindness([UnseenDrift(name="field", change=10.0, unit="nT", inclination_deg=0.0, azimuth_deg=0.0213)])
    'an unseen drift from the first station to the last, 1σ, would add: 10 nT of the field 0.0213° to azimuth'
    """
    each = [] if isinstance(unseen, msgspec.UnsetType) else map(_added, unseen)
    words = "an unseen drift from the first station to the last, 1σ, would add"
    added = "; ".join(filter(None, each))
    return f"{words}: {added}" if added else ""


def _added(unseen: UnseenDrift) -> str:
    """The contribution of one drift to the angles that it moves."""
    angles = ("inclination", "toolface", "azimuth")
    sizes = {name: getattr(unseen, f"{name}_deg") or 0.0 for name in angles}
    least = max(LEAST_ADDED, ADDED_SHARE * max(sizes.values()))
    words = ", ".join(f"{size:.4f}° to {name}" for name, size in sizes.items() if size >= least)
    return f"{unseen.change:g} {unseen.unit} of the {unseen.name} {words}" if words else ""


SCHEMA_VERSION = 1
DOCUMENT_VERSION = 1
"""Version of what commands print for machines: higher when a key goes, or changes its meaning."""
UNNAMED = "unnamed readings"
"""The name of readings without a file."""
SOFTWARE = f"mwdcal {__version__}"
"""Name and version of the program."""
MARGIN = 1.0
"""Degrees Celsius by which a temperature may lie outside the calibrated range without a remark.

Over one of them a servo instrument's bias drifts by 58 µg, 0.003° of inclination: little beside its usual 1σ.
"""
MAGNETIC = ("azimuth", "field", "dip", "magnetic_toolface", "north_toolface", "bx", "by", "bz")
"""Observables that need a magnetometer."""
NOISE, SETTINGS = "noise of the readings", "settings of the stand"
REPEATABILITY, ORDER = "repeatability of the readings", "order of the temperature terms"
"""Sources of a budget."""
MOST_FREEDOM = 1e6
"""Degrees of freedom that stand for infinitely many."""
DOUBT = 0.05
"""Chance of residuals so large, if all is as declared, from which on a declared noise counts as known."""
MISFIT_CHANCE = 1e-3
"""Chance of so large or so small residuals, or of so large a departure of what is declared, below which it is
reported."""
SCALED = (NOISE, REPEATABILITY, SETTINGS)
"""Sources whose variance is scaled by that of the residuals."""
AXES_OF_A_TERM = 3
"""Axes on which a term beyond the order is seen: as many degrees of freedom has its size."""
LARGEST_ANGLE_SD = 0.5
"""Largest standard uncertainty of a direction that is stated, rad: a fifth too small already, as the
error of a direction no longer follows that of its vector, and soon without meaning."""
FREE_SHARE = 5e-2
"""An output rests on a free direction if it moves by more than this share of it (rad per rad,
or of its own strength), the direction being scaled to turn or stretch the fields by one."""


class Finding(msgspec.Struct, frozen=True, kw_only=True):
    """Something the reader should know: `id` for machines, `text` for people, maybe a station."""

    id: str
    text: str
    station: str | None = None


class Undetermined(msgspec.Struct, frozen=True, kw_only=True):
    """A direction of parameter space that the evidence leaves free, in plain language."""

    id: str
    text: str


class BudgetRow(msgspec.Struct, frozen=True, kw_only=True):
    """The contribution of one source of error to the accuracy to expect, 1σ in degrees; None: undetermined."""

    source: str
    inclination_deg: float | None
    toolface_deg: float | None
    azimuth_deg: float | None = None


ANGLE_COLUMNS = ("inclination_deg", "toolface_deg", "azimuth_deg")
"""Fields of a `BudgetRow` with the share of a source in each angle."""


class StandErrors(msgspec.Struct, frozen=True, kw_only=True):
    """Errors of the stand, estimated: reference reading = value in the earth's frame + zero.

    The stand's vertical leans by `tilt_deg` towards the azimuth `tilt_azimuth_deg`: a reading
    of inclination at azimuth A is too large by tilt · cos(A - tilt azimuth). None: not asked for.
    """

    azimuth_zero_deg: float | None = None
    azimuth_zero_uncertainty_deg: float | None = None
    inclination_zero_deg: float | None = None
    inclination_zero_uncertainty_deg: float | None = None
    tilt_deg: float | None = None
    tilt_uncertainty_deg: float | None = None
    tilt_azimuth_deg: float | None = None
    tilt_azimuth_uncertainty_deg: float | None = None


class ErrorRow(msgspec.Struct, frozen=True, kw_only=True):
    """Root mean square error of one observable over the stations where it is known."""

    observable: str
    unit: str
    stations: int
    before: float
    after: float
    expected: float | None = None


class StationRow(msgspec.Struct, frozen=True, kw_only=True):
    """One station of the fit: errors left where references are known, and how unlikely they are.

    `deviation` is the station's χ² put as an equivalent number of standard deviations of one
    normal variable; `reshoot` marks the ones to take again. `errors_left_out` are the errors
    when the station has no part in the fit, `influence` the largest change it makes by itself
    at any station of the run, `weight` its share in a robust fit. `readings` of the accelerometer, g, and of the
    magnetometer, nT, are nominal, x, y and z of each; absent in earlier versions.
    """

    station: str
    digest: str
    readings: list[float] | msgspec.UnsetType = msgspec.UNSET
    temperature_c: float | None
    inclination_deg: float | None
    toolface_deg: float | None
    azimuth_deg: float | None
    errors: dict[str, float]
    errors_before: dict[str, float]
    errors_left_out: dict[str, float] = {}
    influence: dict[str, float] = {}
    weight: float = 1.0
    deviation: float
    reshoot: bool = False
    worst: str | None = None


class Measures(msgspec.Struct, frozen=True, kw_only=True):
    """Moradi's measures of the vector error |ideal - estimated|, as a share of the field."""

    triad: str
    when: str
    mean: float
    std: float
    mse: float
    rmse: float


class FitSettings(msgspec.Struct, frozen=True, kw_only=True):
    """How the fit was asked for, beyond method, model and order; see `mwdcal.calibration.options.Options`."""

    parameters: int = 12
    ignore: list[str] = []
    robust: str | None = None
    paper_weights: bool = False
    prior: str | None = None


class OrderScore(msgspec.Struct, frozen=True, kw_only=True):
    """How well a triad's model of one temperature order predicts soaks left out of the fit.

    `…inside`: soaks between the coldest and the hottest, predicted by interpolation; `…ends`:
    those two, by extrapolation. Of both: χ² per reading (`inside`, `ends`); root mean square
    error of the vector per axis in `unit` (`error_…`); of its two components across the field,
    as angles in degrees (`error_…_deg`). The noise of the readings is part of the errors:
    `noise` and `noise_deg` are what it alone would leave. None: no soak can be left out for it.
    `chance`: probability that noise alone makes the term of this order as large as it is, in a
    fit to all soaks; None at order 0, for an order that was given, and where nothing tests it.
    """

    triad: str
    order: int
    chosen: bool
    chance: float | None = None
    inside: float | None
    ends: float | None
    unit: str
    noise: float | None
    error_inside: float | None
    error_ends: float | None
    noise_deg: float | None
    error_inside_deg: float | None
    error_ends_deg: float | None


class TriadCalibration(msgspec.Struct, frozen=True, kw_only=True):
    """One triad: field = model(x, T - reference), x = P (raw / scale), in tool axes.

    model "polynomial": parameters are A (row by row) and c for each power of temperature,
    field = Σ τᵏ (A_k x + c_k); with `curved`, e₂ x² + e₃ x³ on each own axis follow, all
    terms then of (x - centre) / radius.
    model "factors": SF, B (temperature powers fastest) and m, field = (I - m)(x / SF - B).
    `misfit_probability` is the chance of a larger s² if noise and stand are as declared; None where
    the noise was estimated. `size` counts the fitted parameters, `rank` the determined ones: in a model of 9 or 6
    parameters the others stand in the list as zero, without uncertainty. Lists are those of the file:
    `numpy.asarray(triad.parameters)` is an array, and `Calibration.parameters` that of all triads.
    """

    name: str
    unit: str
    model: str
    order: int
    curved: bool
    centre: list[float]
    radius: float
    parameter_names: list[str]
    parameters: list[float]
    standard_uncertainties: list[float | None]
    rank: int
    size: int
    singular_values: list[float]
    undetermined: list[Undetermined]
    noise: float
    noise_source: str
    variance_factor: float | None
    degrees_of_freedom: float
    misfit_probability: float | None = None

    @property
    def freedom_of_noise(self) -> float:
        """Degrees of freedom of the residuals, or of a declared noise where these agree with it."""
        agrees = (self.misfit_probability or 0.0) > DOUBT and self.noise_source == "declared"
        return MOST_FREEDOM if agrees else self.degrees_of_freedom

    def noise_of(self, readings: Readings) -> Array:
        """Standard uncertainty (..., n, 3) of readings as they state it, or (), as the run does.

        Times s where residuals of the run are reported as too large for the noise that it declares.
        """
        chance = self.misfit_probability
        doubtful = chance is not None and chance < MISFIT_CHANCE
        excess = max(self.variance_factor or 1.0, 1.0) if doubtful else 1.0
        return np.asarray(readings.sd.get(self.name, self.noise) * np.sqrt(excess))

    def functions(self, reference: float) -> Whole:
        """The model that these parameters belong to."""
        basis = Basis(self.order, reference)
        if self.model == "factors":
            return Factors(basis)
        centre, radius = np.array([self.centre]), np.full((1, 3), self.radius)
        return Polynomial(basis, centre, radius, self.curved)


class Slopes(NamedTuple):
    """Derivative (…, n, 6, p) of both vectors by the parameters, and their covariance (…, n, 6, 6) by noise."""

    jacobian: Array
    noise: Array

    def part(self, rows: slice | Bools) -> Slopes:
        """Those of some readings (n,)."""
        return Slopes(self.jacobian[rows], self.noise[rows])


READ_AGAIN = "Read them by the calibration's: mwdcal.read_run(…, cal.profile)."
CALIBRATE_AGAIN = "Calibrate that run again."
"""Remedies where readings set their own scale, and where the calibration has kept none."""


class Calibration(msgspec.Struct, frozen=True, kw_only=True):
    """A calibrated tool: see `docs/reference/files.md` for every field.

    `covariance` is of the parameters of all triads in order, scaled by s² where that is
    estimated; `free` are directions (rows) of parameter space that no evidence determines.
    `budget` says what each source of error adds to the accuracy to expect; `assumed_exact` names
    what is assumed exact and no residual can test: references, signs, steadiness during the run. `unseen` says what
    a drift would do there; absent in earlier versions.
    `inherited` are the fingerprints of the stations behind the prior, if there was one;
    `excluded` the labels of stations of the run that were left out of the fit, on request or as copies of others;
    `copies` the fingerprints of copies, absent if no station is a copy.
    `serial` is that of the tool, absent where the run states none; `simulated`: of the run or the prior;
    `prior_sha256` of the file of the prior, absent where there was none. `settings_file`, `settings_sha256`: of the
    laboratory's settings that completed profile or options, absent where there were none.
    `settings`: whether the errors of the stand's direction are "per-direction" or "per-station", or
    "assumed" to be per direction; absent where the stand's direction is exact, and in earlier versions.
    `gravity_stated`: whether the run states gravity at any station; absent in earlier versions.
    `sha256` is `content_sha256` of the record as it was made; earlier versions have none.
    `signature` is absent until the file is signed, and in a record that is made from another.
    """

    schema_version: int = SCHEMA_VERSION
    command: str = "calibrate"
    tool: dict[str, str]
    serial: str | msgspec.UnsetType = msgspec.UNSET
    simulated: bool = False
    profile: Profile
    profile_sha256: str
    run: str
    sheet: str | msgspec.UnsetType = msgspec.UNSET
    run_sha256: str
    prior_sha256: str | msgspec.UnsetType = msgspec.UNSET
    settings_file: str | msgspec.UnsetType = msgspec.UNSET
    settings_sha256: str | msgspec.UnsetType = msgspec.UNSET
    software: str
    method: str
    options: FitSettings = FitSettings()
    seed: int | None = None
    time: str
    field_unit: str
    stations: int
    excluded: list[str] = []
    copies: list[str] | msgspec.UnsetType = msgspec.UNSET
    temperature_c: tuple[float, float] | None
    accelerometer: TriadCalibration
    magnetometer: TriadCalibration | None = None
    covariance_rows: list[list[float]] = msgspec.field(name="covariance")
    free: list[list[float]]
    singular_values: list[float]
    constants: list[Constant]
    drift: list[Drift] = []
    stand: StandErrors = StandErrors()
    earth: dict[str, float]
    gravity_stated: bool | msgspec.UnsetType = msgspec.UNSET
    settings: str | msgspec.UnsetType = msgspec.UNSET
    budget: list[BudgetRow] = []
    assumed_exact: list[str] = []
    unseen: list[UnseenDrift] | msgspec.UnsetType = msgspec.UNSET
    errors: list[ErrorRow]
    measures: list[Measures]
    orders: list[OrderScore] = []
    station_rows: list[StationRow]
    inherited: list[str] = []
    findings: list[Finding]
    sha256: str | msgspec.UnsetType = msgspec.UNSET
    signature: Signature | msgspec.UnsetType = msgspec.UNSET

    plot: ClassVar[Any]
    """Figures of the calibration: `use.plots` puts them here, so that a record needs no drawing."""
    summary: ClassVar[Callable[..., str]]
    to_dict: ClassVar[Callable[..., dict[str, Any]]]
    report: ClassVar[Callable[..., None]]
    """Text, JSON and page of the command: `library.shown` puts them here."""

    def __hash__(self) -> int:
        return hash((self.run_sha256, self.software, self.time))

    def __repr__(self) -> str:
        return f"<Calibration: {'; '.join(f'{k} {v}' for k, v in self.glance().items())}>"

    def _repr_html_(self) -> str:
        return html_table("Calibration", self.glance().items())

    def glance(self) -> dict[str, str]:
        """The calibration at a glance: tool, run, rank, accuracy and findings, in words."""
        rank = ", ".join(f"{t.name} {t.rank} of {t.size}" for t in self.triads)
        accuracy = ", ".join(f"{name} {text}" for name, text in self._accuracy().items())
        findings = ", ".join(dict.fromkeys(finding.id for finding in self.findings))
        return {
            "tool": " ".join([self.tool_name, *simulated(self.tool)]),
            "run": f"{self.stations} stations, method {self.method}",
            "rank": rank,
            "accuracy": f"{accuracy} (1σ at 45° inclination)" if accuracy else "not stated",
            "findings": findings or "none",
        }

    def _accuracy(self) -> dict[str, str]:
        """1σ of the calibration alone by angle, in words: all sources of the budget together."""
        words = {}
        for name in ("inclination", "toolface", "azimuth")[: 1 + len(self.triads)]:
            parts = [getattr(row, f"{name}_deg") for row in self.budget]
            if parts:
                words[name] = "undetermined" if None in parts else f"{np.linalg.norm(parts):.2g}°"
        return words

    @property
    def day(self) -> date:
        """The day of the measurement as its run states it, else that of the fit."""
        return stated_day(self.tool) or datetime.fromisoformat(self.time).date()

    @property
    def reference_temperature(self) -> float:
        """The temperature τ = 0 of the model, °C."""
        return self.profile.reference_temperature_c

    @property
    def fingerprints(self) -> list[str]:
        """Of the stations behind the fit: its own with their copies, and those of the prior."""
        return [*(row.digest for row in self.station_rows), *self.inherited, *(self.copies or ())]

    def used(self, digests: Iterable[str]) -> list[bool]:
        """Which stations, by their fingerprints, are behind the fit; by the triads both have."""
        fitted = {*self.fingerprints}
        first = {digest.partition("-")[0] for digest in fitted}
        whole = self.has_field
        return [
            d in fitted or (("-" not in d or not whole) and d.partition("-")[0] in first)
            for d in digests
        ]

    @property
    def changed(self) -> bool:
        """Whether anything but `time` has changed since the record was made; unknown without `sha256`.

        A signature that is not `intact` tells more: see `certificate.signature`.
        """
        return self.sha256 is not msgspec.UNSET and self.sha256 != content_sha256(self)

    def change_findings(self) -> list[Finding]:
        """A finding if the record was changed after it was made."""
        if not self.changed:
            return []
        text = (
            "the calibration was changed after mwdcal calibrate made it: its 'sha256' is of other contents. "
            "If that was not meant, use the file as it was written, or calibrate again."
        )
        return [Finding(id="changed", text=text)]

    @property
    def parameters(self) -> Array:
        """The parameters (p,) of all triads in order."""
        return np.concatenate([triad.parameters for triad in self.triads])

    @property
    def parameter_covariance(self) -> Array:
        """Covariance (p, p) of `parameters`."""
        return np.array(self.covariance_rows)

    @property
    def free_directions(self) -> Array:
        """Directions (k, p) of parameter space that no evidence determines."""
        return np.array(self.free, float).reshape(len(self.free), len(self.parameters))

    @property
    def triads(self) -> list[TriadCalibration]:
        """The calibrated triads, accelerometer first."""
        return [t for t in (self.accelerometer, self.magnetometer) if t is not None]

    @property
    def run_name(self) -> str:
        """The name of the run in messages: its file, if it had one, and its sheet."""
        return f"{self.run}, sheet '{self.sheet}'" if self.sheet else self.run or UNNAMED

    @property
    def tool_name(self) -> str:
        """The serial of the tool, else the name of its profile."""
        return serial_of(self.tool) or self.profile.name

    @property
    def tool_type(self) -> str:
        """The type of the tool as its run states it, else the name of its profile; blank if that is its serial."""
        named = "" if self.profile.name == self.tool.get("serial") else self.profile.name
        return self.tool.get("tool") or named

    @property
    def has_field(self) -> bool:
        """Whether the magnetometer was calibrated."""
        return self.magnetometer is not None

    @property
    def relative(self) -> bool:
        """Whether the magnetometer was calibrated to a field of one."""
        return self.has_field and self.field_unit != NANOTESLA

    @property
    def thermal(self) -> bool:
        """Whether the calibration has temperature terms."""
        return any(triad.order for triad in self.triads)

    def check_scales(self, readings: Readings) -> None:
        """Refuse readings that gave themselves another scale than that of the calibration's run."""
        for triad in self.triads:
            scale = getattr(self.profile, triad.name).scale
            given = readings.self_scaled.get(triad.name)
            if given and not np.isclose(given, scale or 1.0, rtol=1e-9, atol=0.0):
                of_run = f"{scale:.6g}). {READ_AGAIN}" if scale else f"not kept). {CALIBRATE_AGAIN}"
                raise InputError(
                    f"{readings.name}: the tool profile states no {triad.name} scale, and these readings give another "
                    f"one ({given:.6g}) than the run of the calibration ({of_run}"
                )

    def _temperature(self, readings: Readings) -> Array:
        if readings.temperature is None and self.thermal:
            raise InputError(
                f"{readings.name}: the calibration has temperature terms, and the "
                "column 'temperature_c' is missing or blank. Add it, or calibrate with `order` 0."
            )
        if readings.temperature is None:
            return np.full(readings.accelerometer.shape[:-1], self.reference_temperature)
        return readings.temperature

    def _measured(
        self, readings: Readings
    ) -> Iterator[tuple[TriadCalibration, Whole, tuple[Array, Array, Array], slice]]:
        """Triads with readings, their models and what these take, and where their vectors lie."""
        self.check_scales(readings)
        temperature = self._temperature(readings)
        for index, triad in enumerate(self.triads):
            raw, model = getattr(readings, triad.name), triad.functions(self.reference_temperature)
            if raw is not None:
                at = np.array(triad.parameters), raw, temperature
                yield triad, model, at, slice(3 * index, 3 * index + 3)

    def places(self) -> dict[str, slice]:
        """Where the parameters of each triad lie."""
        ends = np.cumsum([0, *(len(triad.parameters) for triad in self.triads)]).tolist()
        return {t.name: slice(*pair) for t, pair in zip(self.triads, pairwise(ends), strict=True)}

    def fields(self, readings: ReadingsLike) -> tuple[Array, Array]:
        """Gravity (…, n, 3), g, and magnetic field (…, n, 3), nT: NaN without magnetometer.

        Here and below `readings` are `Readings`, or an array as `as_readings` takes it.
        """
        fields = [model.fields(*at) for _, model, at, _ in self._measured(as_readings(readings))]
        return fields[0], fields[1] if len(fields) > 1 else np.full_like(fields[0], np.nan)

    def jacobian(self, readings: ReadingsLike) -> Array:
        """Derivative (…, n, 6, p) of both vectors with respect to the parameters of all triads."""
        readings = as_readings(readings)
        places = self.places()
        result = np.zeros((*readings.accelerometer.shape[:-1], 6, len(self.parameters)))
        for triad, model, at, vector in self._measured(readings):
            result[..., vector, places[triad.name]] = model.jacobian(*at)
        return result

    def noise_covariance(self, readings: ReadingsLike) -> Array:
        """Covariance (…, n, 6, 6) of both vectors from the noise of one reading."""
        readings = as_readings(readings)
        shape, parts = readings.accelerometer.shape[:-1], []
        for triad, model, (parameters, raw, temperature), vector in self._measured(readings):
            sd = triad.noise_of(readings)
            if not model.varies and np.ndim(sd) < raw.ndim:  # one for all readings
                raw, temperature = raw[..., :1, :], temperature[..., :1]
            slope, sd = model.slope(parameters, raw, temperature), np.broadcast_to(sd, raw.shape)
            parts.append((vector, slope * sd[..., None, :] ** 2 @ slope.mT))
        result = np.zeros((*np.broadcast_shapes(*(p.shape[:-2] for _, p in parts)), 6, 6))
        for vector, part in parts:
            result[..., vector, vector] = part
        return np.broadcast_to(result, (*shape, 6, 6))

    def slopes(self, readings: ReadingsLike) -> Slopes:
        """`jacobian` and `noise_covariance`."""
        return Slopes(self.jacobian(readings), self.noise_covariance(readings))

    def gradients(
        self,
        names: Sequence[str],
        readings: ReadingsLike,
        vectors: tuple[Array, Array] | None = None,
    ) -> Array:
        """Gradients (…, n, k, 6) of k observables with respect to both `vectors`, known already or of the readings."""
        g, b = vectors or self.fields(readings)
        gradient = np.stack([OBSERVABLES[name].gradient(g, b) for name in names], -2)
        return np.where(np.isnan(gradient), 0.0, gradient) if not self.has_field else gradient

    def sensitivity(self, name: str, readings: ReadingsLike) -> Array:
        """Gradient (…, n, p) of an observable with respect to the parameters."""
        gradient = self.gradients((name,), readings)
        return np.asarray((gradient @ self.jacobian(readings))[..., 0, :])

    def uncertainty(self, name: str, readings: ReadingsLike, noise: bool = False) -> Array:
        """Standard uncertainty (…, n) of an observable: of the calibration, or of a reading too.

        Units: radians, g or nT. `noise` adds that of one reading.
        NaN where no uncertainty can be stated: where the observable rests on a free direction, where
        that of azimuth or a toolface would exceed `LARGEST_ANGLE_SD`, as near vertical, and `outside` the
        calibrated temperatures.
        """
        variance = self.covariance((name,), readings, noise)[..., 0, 0]
        return np.sqrt(np.maximum(variance, 0.0))  # below zero by rounding alone

    def covariance(
        self,
        names: str | Sequence[str],
        readings: ReadingsLike,
        noise: bool = False,
        gradients: Array | None = None,
        slopes: Slopes | None = None,
    ) -> Array:
        """Covariance (…, n, k, k) of k observables at one reading, as `uncertainty` states each.

        `gradients` of the observables and `slopes`, where they are known already.
        Units: products of radians, g and nT. Singular: NaN in the rows and columns of an observable
        without a stated uncertainty.

        Raises:
            InputError: an observable is unknown, or none is named.
        """
        readings = as_readings(readings)
        names = (names,) if isinstance(names, str) else tuple(names)
        if not names:
            raise InputError("`names` must name one observable or more; got none.")
        for name in names:
            if name not in OBSERVABLES:
                raise InputError(
                    f"`names` must be observables ({', '.join(OBSERVABLES)}); got {name!r}. "
                    "Correct the name."
                )
        rows = self.gradients(names, readings) if gradients is None else gradients
        moved = slopes.jacobian if slopes else self.jacobian(readings)
        flat = moved.reshape(-1, moved.shape[-1])  # one product is faster than one for each reading
        vectors = (flat @ self.parameter_covariance).reshape(moved.shape) @ moved.mT
        if noise:
            vectors += slopes.noise if slopes else self.noise_covariance(readings)
        total = rows @ vectors @ rows.mT
        blank = self.without_uncertainty(names, readings, diagonal(total))
        return np.where(blank[..., :, None] | blank[..., None, :], np.nan, total)

    def without_uncertainty(
        self, names: Sequence[str], readings: Readings, variances: Array
    ) -> Bools:
        """Where (…, n, k) no uncertainty of observables with these variances can be stated, as in `uncertainty`."""
        turns = np.array([OBSERVABLES[n].period > 0 for n in names])
        blank = turns & (variances > LARGEST_ANGLE_SD**2)
        blank |= self.outside(readings)[..., None]
        if self.free:
            blank |= np.stack([self.rests_on_free(n, readings) for n in names], -1)
        if not self.has_field:
            blank |= np.isin(names, MAGNETIC)
        return np.asarray(blank)

    def expanded_uncertainty(
        self, name: str, readings: ReadingsLike, probability: float = 0.95
    ) -> Array:
        """Half width (…, n) of the interval that holds the calibration's error with a probability.

        Student's t with the `effective_freedom` of the observable; NaN as in `uncertainty`.
        Singular: near vertical an error across the tool axis tilts it whichever way it points, so
        that of the inclination is the length of a vector; see `tilt_width`.
        """
        from scipy.special import stdtrit

        freedom = self.effective_freedom(name)
        sd = self.uncertainty(name, readings)
        width = np.asarray(sd * stdtrit(freedom, (1 + probability) / 2))
        if name != "inclination":
            return width
        g, _ = self.fields(readings)
        rows = self.jacobian(readings)[..., :2, :] / np.linalg.norm(g, axis=-1)[..., None, None]
        spread = rows @ self.parameter_covariance @ rows.mT
        return tilt_width(g, spread, width, freedom, probability)

    def effective_freedom(self, name: str) -> float:
        """Effective degrees of freedom of the uncertainty of an observable, one or more.

        Definition: Welch-Satterthwaite for the sources of the budget, which are independent; the
        triads are not, by the errors that they share. Contributions that the residuals scale have the degrees of
        freedom of the triad with the fewest, the order of the temperature terms those of the axes
        that it is seen on, all else infinitely many: a declared noise too that the residuals agree
        with. No more are counted than that triad has, as the
        shares differ with attitude; an observable without a share has the fewest of any angle.
        Reference: JCGM 100:2008, G.4.
        """
        triads = self.triads if name in MAGNETIC else [self.accelerometer]
        fewest = max(min(triad.freedom_of_noise for triad in triads), 1.0)
        angles = [angle for angle in ANGLE_COLUMNS if angle == f"{name}_deg"] or ANGLE_COLUMNS
        return min(min(self._freedom_by_source(angle, fewest) for angle in angles), MOST_FREEDOM)

    def _freedom_by_source(self, angle: str, fewest: float) -> float:
        """Welch-Satterthwaite for an angle of the budget; `fewest`: of what the residuals scale."""
        variance = {row.source: (getattr(row, angle) or 0.0) ** 2 for row in self.budget}
        scaled = sum(variance.get(source, 0.0) for source in SCALED)
        spread = scaled**2 / fewest + variance.get(ORDER, 0.0) ** 2 / AXES_OF_A_TERM
        return min(sum(variance.values()) ** 2 / spread, fewest) if spread else fewest

    def rests_on_free(self, name: str, readings: ReadingsLike) -> Bools:
        """Where (…, n) an observable moves with a direction that no evidence determines."""
        readings = as_readings(readings)
        shape = readings.accelerometer.shape[:-1]
        if not self.free:
            return np.zeros(shape, bool)
        g, b = self.fields(readings)
        moved = np.einsum("...nip,kp->...nki", self.jacobian(readings), self.free_directions)
        gradient = np.nan_to_num(OBSERVABLES[name].gradient(g, b))
        change = np.abs(np.einsum("...ni,...nki->...nk", gradient, moved))
        scale = {"g": np.linalg.norm(g, axis=-1), "nT": np.linalg.norm(b, axis=-1)}
        limit = FREE_SHARE * scale.get(OBSERVABLES[name].unit, np.ones(shape))
        return np.asarray(np.any(change > np.nan_to_num(limit)[..., None], -1))

    def undetermined(self) -> list[Undetermined]:
        """Free directions of all triads, each once."""
        return [entry for triad in self.triads for entry in triad.undetermined]

    @property
    def margin(self) -> float:
        """Degrees Celsius by which a reading may lie outside the calibrated range.

        A calibration without temperature terms holds for the soak it was made in: `SOAK_GAP`.
        """
        return MARGIN if self.thermal else SOAK_GAP

    @property
    def valid_temperatures(self) -> tuple[float, float] | None:
        """Lowest and highest temperature, °C, at which readings have results; None: none was recorded."""
        if self.temperature_c is None:
            return None
        low, high = self.temperature_c
        return low - self.margin, high + self.margin

    def outside(self, readings: ReadingsLike, margin: float | None = None) -> Bools:
        """Stations (…, n) outside the calibrated temperature range by more than a margin, °C.

        The margin is the calibration's own unless another is given.
        """
        readings = as_readings(readings)
        shape = readings.accelerometer.shape[:-1]
        if self.temperature_c is None or readings.temperature is None:
            return np.zeros(shape, bool)
        (low, high), beyond = self.temperature_c, self.margin if margin is None else margin
        return np.asarray(
            (readings.temperature < low - beyond) | (readings.temperature > high + beyond)
        )

    def unrecorded(self, readings: ReadingsLike) -> bool:
        """Whether the readings have temperatures and the run of the calibration recorded none."""
        return self.temperature_c is None and as_readings(readings).temperature is not None


def content_sha256(calibration: Calibration) -> str:
    """SHA-256 of all fields but `UNHASHED`, as compact JSON with sorted keys."""
    return document_sha256(msgspec.to_builtins(calibration))


def with_checksum(calibration: Calibration) -> Calibration:
    """The record with the `sha256` of its contents, by which a later change shows; it is unsigned."""
    return msgspec.structs.replace(
        calibration, sha256=content_sha256(calibration), signature=msgspec.UNSET
    )


def stated(value: float) -> float | None:
    """A number as a file has it: None for NaN, of which nothing is stated."""
    return None if np.isnan(value) else float(value)
