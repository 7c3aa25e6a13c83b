"""Surveys: angles and strengths of calibrated readings in a well, each with its standard uncertainty.

The uncertainty is that of the calibration and of the noise of one reading, with the variance that is `added`, such as
that of an error model (`mwdcal.survey.well`); of true and grid azimuths also that of the declination.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from math import radians

import numpy as np

from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import LARGEST_ANGLE_SD, Calibration, Finding, Slopes
from mwdcal.errors import InputError
from mwdcal.files.contract import AZIMUTH_KEYS, REFERENCES, check_near_misses, stated_norths
from mwdcal.files.formats.columns import shown
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import Array, Bools, diagonal
from mwdcal.survey.references import (
    FROM_MODEL,
    FROM_REFERENCE,
    FROM_TABLE,
    NO_SOURCE,
    EarthReference,
    declination_sd,
    north_contradictions,
)
from mwdcal.use.uncertainty import rows_of, without_value

# --------------------------------------------------------------------------
# The norths that azimuths of a well count from, and how uncertain the declination is.

SD_KEY = "sd_declination_deg"
"""Metadata key of a table: standard uncertainty (1σ) of its declination, degrees."""
DECLINATIONS = tuple(f"{start}ref_declination_deg" for start in ("", "sd_", "sd_random_"))
"""Columns of a declination that varies by row: its value, 1σ that rows share, and 1σ that is new at each."""
USUAL_HORIZONTAL = 20_000.0
"""Horizontal field where neither a reference nor a reading states one, nT."""


@dataclass(frozen=True)
class North:
    """The norths that azimuths may count from, radians: true = magnetic + declination, grid = true - convergence.

    None: not known. `declination_sd`: standard uncertainty that the stations share, `declination_noise` that of
    what changes from one to the next; each one value, or one for each station (n,), of which `base` has the means.
    `findings`: where they are assumed, or sources disagree. `sources`: where each comes from, by name. `section`:
    azimuth of the vertical section, from the north of the path. `scale` of the grid: length on the map over that on the
    ground.
    """

    declination: float | Array | None = None
    declination_sd: float | Array = 0.0
    convergence: float | None = None
    declination_noise: float | Array = 0.0
    findings: tuple[Finding, ...] = ()
    sources: Mapping[str, str] = field(default_factory=dict)
    section: float = 0.0
    scale: float | None = None
    base: North | None = None

    @property
    def name(self) -> str:
        """The north of the well path: grid if it is known, else true, else magnetic."""
        if self.declination is None:
            return "magnetic"
        return "true" if self.convergence is None else "grid"

    @property
    def declination_uncertainty(self) -> Array:
        """Standard uncertainty of the declination at one station."""
        return np.asarray(np.hypot(self.declination_sd, self.declination_noise))

    @property
    def offset(self) -> Array:
        """The angle added to magnetic azimuths to count from that north."""
        turned = 0.0 if self.declination is None else self.declination
        return np.asarray(turned, float) - (self.convergence or 0.0)

    def of_path(self, count: int) -> tuple[Array, Array, Array]:
        """That angle (n,), its 1σ that all stations share, and what is new at each."""
        parts = self.offset, self.declination_sd, self.declination_noise
        offset, shared, alone = (np.broadcast_to(np.asarray(part, float), count) for part in parts)
        return offset, shared, alone

    @property
    def typical(self) -> North:
        """With one value for all stations."""
        return self if self.base is None else replace(self.base, section=self.section)

    @property
    def in_degrees(self) -> dict[str, float | None]:
        """Declination with its 1σ that stations share, and convergence, typical, by metadata key; None: not known.

        They have 12 significant digits: 1.5° that a table states is 1.5° in its results.
        """
        north = self.typical
        sd = None if north.declination is None else north.declination_sd
        angles = {
            "declination_deg": north.declination, SD_KEY: sd, "convergence_deg": north.convergence
        }  # fmt: skip
        return {
            key: None if angle is None else float(f"{np.degrees(angle):.12g}")
            for key, angle in angles.items()
        }

    def by_row(self, columns: Mapping[str, Array]) -> North:
        """The same with the columns (n,) of `DECLINATIONS` that a table has, degrees; blank cells keep what it has."""
        parts = self.declination, self.declination_sd, self.declination_noise
        new = [
            value if name not in columns else _where_blank(np.radians(columns[name]), value)
            for name, value in zip(DECLINATIONS, parts, strict=True)
        ]
        declination, shared, alone = new
        return replace(
            self, declination=declination, declination_sd=0.0 if shared is None else shared,
            declination_noise=0.0 if alone is None else alone, base=self,
        )  # fmt: skip


def norths_of(
    metadata: Mapping[str, object],
    source: str,
    readings: Callable[[], Iterable[Readings]],
    calibration: Calibration,
    reference: EarthReference | None,
    horizontal: Callable[[], Iterable[Array]] | None = None,
) -> North:
    """The statements of a table and a reference about declination and convergence; `readings` of the table in parts.

    `horizontal`: horizontal fields by its references, where these can be read by themselves.
    A declination whose table states no uncertainty has that of the reference, else that of a global field model.

    Raises:
        InputError: an uncertainty that cannot be.
    """
    stated = stated_norths(metadata, source)
    of_place = {} if reference is None else {
        "declination_deg": reference.declination_deg, "convergence_deg": reference.convergence_deg
    }  # fmt: skip
    both = {key: value for key, value in {**of_place, **stated}.items() if value is not None}
    known = {**dict.fromkeys(both, FROM_REFERENCE), **dict.fromkeys(stated, FROM_TABLE)}
    sources = {key.removesuffix("_deg"): known.get(key, NO_SOURCE) for key in AZIMUTH_KEYS[1:]}
    given, findings = _stated_sd(metadata, source), []
    if given and "declination_deg" not in stated:
        text = f"{source}: {SD_KEY} is not used: no declination_deg is beside it. State both, or neither."
        findings.append(Finding(id="declination-uncertainty-unused", text=text))
        given = 0.0
    if "declination_deg" not in both:
        convergence = _radians(both.get("convergence_deg"))
        return North(convergence=convergence, findings=tuple(findings), sources=sources)
    if given or reference is None:
        shared, alone = declination_sd(_horizontal(readings, calibration, horizontal))
    else:
        shared, alone = reference.declination_spread_deg
    sources["sd_declination"] = (
        FROM_TABLE if given else FROM_MODEL if reference is None else FROM_REFERENCE
    )
    if "declination_deg" in stated and not given:
        model = "the reference" if reference else "a global field model"
        text = (
            f"{source} states a declination without uncertainty: {shared:.2f}° (1σ) of {model} is taken. State "
            f"{SD_KEY}."
        )
        findings.append(Finding(id="declination-uncertainty-assumed", text=text))
    if reference is not None:
        findings += north_contradictions(source, stated, given, reference)
    return North(
        _radians(both["declination_deg"]),
        radians(given or shared),
        _radians(both.get("convergence_deg")),
        radians(alone),
        tuple(findings),
        sources,
        scale=None if reference is None else reference.grid_scale,
    )


def _where_blank(values: Array, otherwise: float | Array | None) -> Array:
    """Values (n,), and another one where they are blank."""
    return np.where(np.isnan(values), np.nan if otherwise is None else otherwise, values)


def _radians(angle: float | None) -> float | None:
    return None if angle is None else radians(angle)


def _horizontal(
    parts: Callable[[], Iterable[Readings]],
    calibration: Calibration,
    by_references: Callable[[], Iterable[Array]] | None,
) -> float:
    """The horizontal field by the references of the readings, else by the readings themselves, nT."""
    if by_references is None:
        known = np.concatenate([horizontal_field(each.known, each.count) for each in parts()])
    else:
        known = np.concatenate([*by_references()])
    if np.isnan(known).all():
        known = np.concatenate([_measured_field(readings, calibration) for readings in parts()])
    return USUAL_HORIZONTAL if np.isnan(known).all() else float(np.nanmedian(known))


def horizontal_field(known: Mapping[str, Array], count: int) -> Array:
    """Horizontal fields (n,) by references, nT; NaN where one lacks."""
    field, dip = (np.broadcast_to(known.get(name, np.nan), count) for name in ("field", "dip"))
    return np.asarray(field * np.cos(dip))


def _measured_field(readings: Readings, calibration: Calibration) -> Array:
    """Horizontal fields (n,) as measured; NaN where no nT were."""
    if not calibration.has_field or calibration.relative or readings.magnetometer is None:
        return np.full(readings.count, np.nan)
    g, b = calibration.fields(readings)
    return np.asarray(np.linalg.norm(np.cross(g, b), axis=-1) / np.linalg.norm(g, axis=-1))


def _stated_sd(metadata: Mapping[str, object], source: str) -> float:
    """1σ of the declination that a table states, degrees; 0 where it states none."""
    check_near_misses(list(metadata), (SD_KEY,), f"{source}: metadata")
    value = metadata.get(SD_KEY, 0.0)
    number = float(value) if isinstance(value, int | float) else float("nan")
    limits = REFERENCES["dip"].uncertainty
    if isinstance(value, bool) or not limits.low <= number <= limits.high:
        raise InputError(
            f"{source}, metadata '{SD_KEY}': must be {limits}; got {shown(value)}. State the standard "
            "uncertainty (1σ) of the declination."
        )
    return number


SURVEY_OBSERVABLES = (
    "inclination",
    "azimuth",
    "toolface",
    "north_toolface",
    "gravity",
    "field",
    "dip",
)
"""Observables of a survey, in the order of `Surveys.value`."""
TURNS = np.array([OBSERVABLES[name].period > 0 for name in SURVEY_OBSERVABLES])
"""Which of them are angles of a full turn."""
STRENGTHS = slice(4, 7)
"""Where |g|, |b| and dip lie in it."""
TOOLFACE_SWITCH = (np.radians(3.0), np.radians(5.0))
"""Inclinations below which the toolface counts from magnetic north, and above which from the high side."""
RANDOM = "random-"
"""Start of the names, in `Readings.sd`, of what a reference is uncertain by anew at every station: "random-field"."""
STATIONS_AT_ONCE = 1 << 12
"""Stations whose covariances are computed at once, so that memory does not grow with their number."""


@dataclass(frozen=True)
class Surveys:
    """Observables (n, 7) in the order of `SURVEY_OBSERVABLES`, radians, g, nT, and their standard uncertainties (n, 7).

    NaN: not there, such as azimuth and toolface within the uncertainty of vertical, or without a stated one.
    `strengths` (n, 3, 3): covariance of |g|, |b| and dip. `magnetic` (n,): the toolface counts from magnetic north.
    `ends_magnetic`: so it does behind the last station, until the inclination says otherwise.
    """

    value: Array
    sd: Array
    strengths: Array
    magnetic: Bools
    ends_magnetic: bool

    def of(self, name: str) -> tuple[Array, Array]:
        """An observable (n,) and its standard uncertainty; `toolface` is the one that counts."""
        place, north = SURVEY_OBSERVABLES.index(name), SURVEY_OBSERVABLES.index("north_toolface")
        value, sd = self.value[:, place], self.sd[:, place]
        if name != "toolface":
            return value, sd
        return (
            np.where(self.magnetic, self.value[:, north], value),
            np.where(self.magnetic, self.sd[:, north], sd),
        )


def survey_angles(
    calibration: Calibration,
    readings: Readings,
    switch: tuple[float, float] = TOOLFACE_SWITCH,
    advance: Callable[[int, int], None] = lambda done, total: None,
    added: Callable[[Array, Array, Array, slice], Array] | None = None,
    starts_magnetic: bool = False,
    vectors: tuple[Array, Array] | None = None,
    slopes: Slopes | None = None,
) -> Surveys:
    """Surveys from readings, in the order in which they were taken.

    `starts_magnetic`: the toolface counted from magnetic north at the station before.

    Shapes: `readings` of n stations without leading axes. Units: `switch` in radians. `advance` gets how many are
    done, and of how many. `added` gives the variance (m, 7) that some rows have besides, by their gradients
    (m, 7, 6) and both vectors (m, 3). `vectors` (n, 3) each as corrected and
    `slopes`, where they are known already.
    Singular: at vertical azimuth and toolface are NaN, the toolface from magnetic north is not.

    Raises:
        InputError: a switch that does not open above where it closes; temperatures are missing that the calibration
            needs.
    """
    low, high = switch
    if not 0 <= low <= high <= np.pi / 2:
        raise InputError(
            f"`switch` must be two inclinations between 0 and 90°, the lower one first; got {np.degrees(low):g}° and "
            f"{np.degrees(high):g}°."
        )
    value = np.empty((readings.count, len(SURVEY_OBSERVABLES)))
    sd, strengths, done = np.empty_like(value), np.empty((readings.count, 3, 3)), 0
    for part in blocks(readings):
        rows = slice(done, done + part.count)
        g, b = (each[rows] for each in vectors) if vectors else calibration.fields(part)
        value[rows] = np.stack([OBSERVABLES[name].value(g, b) for name in SURVEY_OBSERVABLES], -1)
        gradients = calibration.gradients(SURVEY_OBSERVABLES, part, (g, b))
        covariance = calibration.covariance(
            SURVEY_OBSERVABLES, part, True, gradients, slopes and slopes.part(rows)
        )
        sd[rows] = np.sqrt(np.maximum(diagonal(covariance), 0.0))
        lost = without_value(calibration, part, SURVEY_OBSERVABLES, value[rows], sd[rows])
        value[rows] = np.where(lost, np.nan, value[rows])
        sd[rows] = np.where(lost, np.nan, sd[rows])
        if added is not None:
            whole = np.sqrt(sd[rows] ** 2 + added(gradients, g, b, rows))
            sd[rows] = np.where(TURNS & (whole > LARGEST_ANGLE_SD), np.nan, whole)
        strengths[rows] = covariance[:, STRENGTHS, STRENGTHS]
        done = rows.stop
        advance(done, readings.count)
    there = calibration.has_field and readings.magnetometer is not None
    magnetic = switched(value[:, 0], low, high, starts_magnetic)
    ends = bool(magnetic[-1]) if magnetic.size else starts_magnetic
    return Surveys(value, sd, strengths, magnetic & there, ends)


def blocks(readings: Readings) -> Iterator[Readings]:
    """The readings in parts of `STATIONS_AT_ONCE`, without references and labels."""
    for start in range(0, readings.count, STATIONS_AT_ONCE):
        yield rows_of(readings, slice(start, start + STATIONS_AT_ONCE))


def switched(inclination: Array, low: float, high: float, before: bool = False) -> Bools:
    """Stations (n,) whose toolface is magnetic: from below `low` until above `high`, in their order.

    A first station between the two is as the one `before`, by default gravity toolface.
    """
    decided = np.where(inclination < low, 1, np.where(inclination > high, 0, -1))
    last = np.maximum.accumulate(np.where(decided >= 0, np.arange(len(decided)), -1))
    return np.where(last >= 0, decided[np.maximum(last, 0)] == 1, before)
