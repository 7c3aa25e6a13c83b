"""`Readings`: what the sensors of a tool read at each station, and what is known about it.

Raw channels have already been mapped to the tool axes and divided by their nominal scale
(`files.runs` does it): values are nominal g and nominal nT, angles are radians, temperatures
are °C. An unknown value is NaN, never zero.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, date, datetime, timedelta
from itertools import compress, pairwise
from typing import Any, ClassVar

import numpy as np

from mwdcal.digests import sha256_of
from mwdcal.errors import InputError
from mwdcal.estimation.problem import ANGLES
from mwdcal.geometry.vectors import AnyArray, Array, ArrayLike, Bools, Ints, centred
from mwdcal.sensor.profile import Profile

TRIADS = ("accelerometer", "magnetometer")
SIMULATED = "SIMULATED DATA"
CONSTANTS = ("gravity", "field", "dip")
EARTH_RANGES = {"gravity": (0.9, 1.1), "field": (15_000.0, 80_000.0)}
"""Least and greatest strength of any place on Earth, with room for a doubtful unit: g, nT."""
EARTH_GRAVITY = (0.995, 1.004)
"""The least and the largest gravity on land, in standard gravity: 9.764 to 9.834 m/s², and a little more."""
STAND_EXACT = "{} of the stand"
STAND_ANGLES_EXACT = STAND_EXACT.format("angles")
"""The name of reference angles without any uncertainty; of a single one beside uncertain ones by its own name."""
DIGEST_LENGTH = 16
NANOTESLA = "nT"
RELATIVE = "relative (field = 1)"
"""Unit of the calibrated field where its strength is known at no station."""
SOAK_GAP = 5.0
"""Temperatures closer than this belong to one soak, °C."""
ONE_SETTING = float(np.radians(0.05))
"""Radians by which the encoder of a stand shows one setting differently at most."""
EQUAL = 1e-6
"""References closer than this differ by rounding alone, radians."""
_BLANK = 10.0
"""Takes the place of a blank angle where stations are compared."""
RAMP_PARTS = 6
"""A ramp is judged in parts of about this share of the run's span: enough for every order and one more to test it."""
LEAST_TEMPERATURE_SPAN = 10.0
"""A run that spans less has no temperature terms, °C. An order needs as much for each power."""
HIGHEST = 3
"""The highest temperature order of a model."""
IN_TABLE = "_in_table"
"""End of the key of what a table states otherwise than the user says."""
WORDS = ("serial", "tool", "operator", "lab", "date", "stand")
"""Metadata that are text, whatever they look like: a serial 12.10 is not 12.1."""
_ISO_DAY = re.compile(r"(\d{4}-?\d\d-?\d\d)([T ].*)?", re.ASCII | re.DOTALL)
_FIRST_ON_EARTH = timedelta(hours=14)
"""By how much the clocks of the easternmost places are ahead of UTC."""


def is_simulated(metadata: Mapping[str, object]) -> bool:
    """Whether metadata say that the data are simulated."""
    return str(metadata.get("simulated", "")).lower() not in ("", "0", "false", "no")


def serial_of(metadata: Mapping[str, object]) -> str | None:
    """The serial of the tool that metadata state, as it is written there; None where they state none."""
    serial = metadata.get("serial")
    return None if serial is None or not str(serial).strip() else str(serial)


def stated_day(metadata: Mapping[str, object]) -> date | None:
    """The day of a measurement: the ISO date, with a time or without, that metadata state as `date`.

    Returns None if there is no such date: `unread_day` says why.
    """
    day = _ISO_DAY.fullmatch(str(metadata.get("date")).strip())
    try:
        return date.fromisoformat(day[1]) if day else None
    except ValueError:
        return None


def unread_day(metadata: Mapping[str, object], where: str) -> str:
    """The problem with a `date` that is not a valid ISO date; empty if it is valid or blank."""
    text = metadata.get("date")
    if text is None or not str(text).strip() or stated_day(metadata):
        return ""
    return (
        f"{where}: 'date' must be a day of the calendar, written year-month-day such as 2026-01-31; got "
        f"{str(text)[:40]!r}. Correct it: a day that cannot be read is not guessed, and counts as not stated."
    )


def check_day(metadata: Mapping[str, object], where: str) -> None:
    """Refuse a `date` that is not an ISO date of the calendar."""
    if problem := unread_day(metadata, where):
        raise InputError(problem)


def future_day(metadata: Mapping[str, object]) -> date | None:
    """The day that metadata state, if it has not begun anywhere on Earth; else None."""
    day = stated_day(metadata)
    return day if day and day > (datetime.now(UTC) + _FIRST_ON_EARTH).date() else None


def simulated(*metadata: Mapping[str, object]) -> list[str]:
    """`SIMULATED`, for a heading, if the calibration, run or log is simulated; else nothing."""
    return [SIMULATED] if any(map(is_simulated, metadata)) else []


def group_numbers(labels: Sequence[str], starts: Sequence[int] = ()) -> Ints | None:
    """Group numbers (n,) in order of appearance, -1 for a blank label; None if all are blank.

    `starts`: where each tool's labels begin, and the end, if they are of several tools: numbers
    then start again at each.

    >>> group_numbers(["B", "", "A", "B"]).tolist()
    [0, -1, 1, 0]
    """
    numbers: list[int] = []
    for first, last in pairwise(starts or (0, len(labels))):
        seen: dict[str, int] = {}
        numbers += [seen.setdefault(n, len(seen)) if n else -1 for n in labels[first:last]]
    return np.array(numbers, int) if any(labels) else None


def fingerprints(triads: Sequence[Array]) -> tuple[str, ...]:
    """One hash per station and triad (n, 3) over the reading to 12 significant digits.

    Accelerometer first, then after a dash the magnetometer: stations of a fit are recognised
    without their magnetometer too.
    """
    texts = ([f"{x:.12g},{y:.12g},{z:.12g}" for x, y, z in (t + 0.0).tolist()] for t in triads)
    hashes = ([sha256_of(text.encode())[:DIGEST_LENGTH] for text in each] for each in texts)
    return tuple(map("-".join, zip(*hashes, strict=True)))


@dataclass(frozen=True, eq=False)
class Readings:
    """Static stations of one tool (or of many: leading axes).

    Shapes: `accelerometer` and `magnetometer` (..., n, 3); `temperature`, `group` and
    each entry of `known` (..., n).

    Attributes:
        accelerometer: nominal g along the tool axes.
        magnetometer: nominal nT along the tool axes, or None.
        temperature: °C, or None (then no model can have temperature terms).
        known: reference values by name, of `ANGLES` and `CONSTANTS`; NaN where blank.
            A missing key is blank everywhere; gravity is then 1 g.
        sd: standard uncertainties: of `accelerometer` and `magnetometer` (..., n, 3) per
            station and axis (missing: estimated from the residuals), of reference angles
            (..., n) independent per station, of gravity, field and dip (..., n) common
            to the run, and so are those of the errors of the stand in `profile.COMMON` (tilt: of
            its amplitude). Missing or NaN reference uncertainties are zero.
        group: stations of the same non-negative number share one direction of the tool
            axis; -1: no group.
        settings: what one setting of the stand's inclination and azimuth is good for, "per-direction"
            or "per-station"; blank: not stated.
        station: labels, for messages and tables.
        digest: `fingerprints` of the raw readings: they tell verification data from the fit's.
        copies: label and fingerprint of each station that was left out as a copy of an earlier one.
        metadata: serial, date, operator, …, as the file states them.
        north: what turned stated azimuths magnetic, under the keys of metadata; the tool profile may state it too.
        source: name of the file.
        sheet: name of its sheet, of a workbook.
        unused: columns of the file that are not used, each with what it resembles.
        remarks: sentences on rows of the file that are left out.
        not_taken: lines of the file with a reference that is not read, by column of a run file.
        others: the numbers (..., n) in those of them that have one at every station, by name.
        table: all columns (n,) of the file or table that was read, as they stand there.
        profile: the tool profile by which raw channels became these readings, if there was one.
        self_scaled: scales that these readings gave themselves, as the profile stated none, by triad.
        in_radians: angles of which `sd` was given in radians.
        run_sha256, profile_sha256: of the files that both come from.
        settings_source: path and SHA-256 of the laboratory's settings that completed the profile.
    """

    accelerometer: Array
    magnetometer: Array | None = None
    temperature: Array | None = None
    known: Mapping[str, Array] = field(default_factory=dict)
    sd: Mapping[str, Array] = field(default_factory=dict)
    group: Ints | None = None
    settings: str = ""
    station: tuple[str, ...] = ()
    digest: tuple[str, ...] = ()
    copies: tuple[tuple[str, str], ...] = ()
    metadata: Mapping[str, object] = field(default_factory=dict)
    north: Mapping[str, object] = field(default_factory=dict)
    source: str = ""
    sheet: str = ""
    unused: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    not_taken: Mapping[str, str] = field(default_factory=dict)
    others: Mapping[str, Array] = field(default_factory=dict)
    table: Mapping[str, AnyArray] = field(default_factory=dict)
    columns: ClassVar[Mapping[str, AnyArray]]
    """The table, or one made of the readings: `library.shown` puts it here."""
    profile: Profile | None = None
    self_scaled: Mapping[str, float] = field(default_factory=dict)
    in_radians: tuple[str, ...] = ()
    run_sha256: str = ""
    profile_sha256: str = ""
    settings_source: tuple[str, str] = ("", "")

    def __repr__(self) -> str:
        known = ", ".join(self.known) or "none"
        triads = " and ".join(self.triads)
        return f"<Readings: {self.count} stations; {triads}; references: {known}>"

    @property
    def name(self) -> str:
        """The name of the readings in messages: the name of the file, if there is one."""
        return self.source or "the readings"

    @property
    def run_name(self) -> str:
        """The name, with that of the sheet of a workbook, where another sheet may state otherwise."""
        return f"{self.name}, sheet '{self.sheet}'" if self.sheet else self.name

    @property
    def triads(self) -> tuple[str, ...]:
        """The triads that were read, of `TRIADS`."""
        return TRIADS[: 1 if self.magnetometer is None else 2]

    @property
    def count(self) -> int:
        """Number of stations."""
        return int(self.accelerometer.shape[-2])

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the stations: the given ones, else their numbers from 1."""
        return self.station or tuple(str(i) for i in range(1, self.count + 1))

    @property
    def groups(self) -> Ints:
        """Group numbers (..., n): -1 everywhere where none are given."""
        return np.full(self.count, -1) if self.group is None else self.group

    @property
    def relative(self) -> bool:
        """Whether there is a magnetometer and the field strength is known at no station.

        It is then calibrated to a field of one. Without a magnetometer nothing is relative.
        """
        return self.magnetometer is not None and bool(np.isnan(self.reference("field")).all())

    @property
    def field_unit(self) -> str:
        """Unit in which a magnetometer is calibrated from these readings."""
        return RELATIVE if self.relative else NANOTESLA

    def states(self, name: str) -> Bools:
        """Whether the value `name` is given at any station (...)."""
        return np.asarray(~np.isnan(self._per_station(self.known.get(name, np.nan))).all(-1))

    def reference(self, name: str) -> Array:
        """The known value `name` (..., n), NaN where blank.

        Blank gravity is the mean of what is given at other stations, or 1 g.
        """
        value = self._per_station(self.known.get(name, np.nan))
        if name != "gravity":
            return value
        blank = np.isnan(value)
        if blank.all():
            return np.ones(value.shape)
        count = np.maximum((~blank).sum(-1, keepdims=True), 1)
        mean = np.where(blank, 0.0, value).sum(-1, keepdims=True) / count
        return np.where(blank, np.where(blank.all(-1, keepdims=True), 1.0, mean), value)

    def uncertainty(self, name: str) -> Array:
        """Standard uncertainty of the known value `name` (..., n); 0 where not stated."""
        if name not in self.sd:
            return np.zeros(self.accelerometer.shape[:-1])
        return self._per_station(np.nan_to_num(np.asarray(self.sd[name], float)))

    @property
    def exact_angles(self) -> dict[str, Bools]:
        """Whether angles of the stand are known (...) without any uncertainty, by `STAND_EXACT`: all, or just one."""
        seen = [name for name in ANGLES if name != "azimuth" or self.magnetometer is not None]
        known = ~np.isnan([self.reference(name) for name in seen])
        certain = ~(known & (np.array([self.uncertainty(name) for name in seen]) > 0)).any(-1)
        exact = known.any(-1) & certain
        every = np.asarray(exact.any(0) & certain.all(0))
        of_one = zip(map(STAND_EXACT.format, seen), exact & ~every, strict=True)
        return {STAND_ANGLES_EXACT: every, **dict(of_one)}

    def common_uncertainty(self, name: str, inclination: Array) -> Array:
        """Standard uncertainty of the reference `name` (..., n) by what all stations of a stand share.

        The zero of its scale, and the lean of its vertical towards any azimuth: at `inclination`
        (..., n) that turns azimuths by its cotangent and toolfaces by its cosecant. The lean of the tool in the
        stand turns azimuths by the cosecant and toolfaces by the cotangent. Singular: at
        vertical these are held to those of 0.1°.
        """
        zero, tilt, lean = (self.uncertainty(n) for n in (f"{name}-zero", "tilt", "tool-axis"))
        across = np.maximum(np.abs(np.sin(inclination)), 2e-3)
        cotangent, cosecant = np.cos(inclination) / across, 1 / across
        shares = {"azimuth": (cotangent, cosecant), "toolface": (cosecant, cotangent)}
        same = float(name == "inclination") + 0 * across
        by_tilt, by_lean = shares.get(name, (same, same))
        return np.asarray(np.sqrt(zero**2 + ((tilt * by_tilt) ** 2 + (lean * by_lean) ** 2) / 2))

    def _per_station(self, value: ArrayLike) -> Array:
        whole, shape = np.asarray(value, float), self.accelerometer.shape[:-1]
        return whole if whole.shape == shape else np.broadcast_to(whole, shape)

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, where: slice | Bools | Ints) -> Readings:
        """The stations of a slice, a mask or places, in their order."""
        return self._at(np.arange(self.count)[where])

    def select(self, keep: Bools) -> Readings:
        """The stations where `keep` (n,) is true."""
        return self._at(np.flatnonzero(keep))

    def _at(self, chosen: Ints) -> Readings:
        """The stations at some places."""

        def rows(value: AnyArray | None, axis: int = -1) -> Any:
            return None if value is None else np.take(value, chosen, axis)

        whole = self.accelerometer.shape
        shapes = {k: whole if k in TRIADS else whole[:-1] for k in self.sd}
        return replace(
            self,
            accelerometer=rows(self.accelerometer, -2),
            magnetometer=rows(self.magnetometer, -2),
            temperature=rows(self.temperature),
            known={k: rows(self.reference(k)) for k in self.known},
            sd={
                k: rows(np.broadcast_to(v, shapes[k]), -2 if k in TRIADS else -1)
                for k, v in self.sd.items()
            },
            group=rows(self.group),
            others={name: rows(values) for name, values in self.others.items()},
            table={name: rows(values) for name, values in self.table.items()},
            station=tuple(self.station[i] for i in chosen) if self.station else (),
            digest=tuple(self.digest[i] for i in chosen) if self.digest else (),
        )

    def without_copies(self, repeated: Bools) -> Readings:
        """The readings as if the stations where `repeated` (n,) is true were not in the run: `copies` has them.

        A label that others have too is followed by the number of the row.
        """
        kept = replace(self, station=self.labels).select(~repeated)
        known = {k: self._per_station(v)[..., ~repeated] for k, v in self.known.items()}
        times, numbered = Counter(self.labels), enumerate(self.labels, 1)
        names = [n if times[n] == 1 else f"{n} (row {i})" for i, n in numbered]
        left = compress(zip(names, self.digest or [""] * self.count, strict=True), repeated)
        return replace(kept, known=known, copies=(*self.copies, *left))


ReadingsLike = Readings | ArrayLike
"""Readings, or an array of them."""


def as_readings(source: ReadingsLike) -> Readings:
    """Readings as they are, or those in the columns of an array (..., n, 3 or 6, and one more for the temperature).

    Columns: accelerometer x, y, z; magnetometer x, y, z; temperature. Units: nominal g and nT along the tool axes, °C.

    Raises:
        InputError: an array of another shape, or of something else than numbers; a table, whose names would not count.
    """
    if isinstance(source, Readings):
        return source
    if hasattr(source, "columns") or isinstance(source, Mapping):
        raise InputError(
            "a table is read by the names of its columns: make readings of it by mwdcal.read_run(table, cal.profile). "
            "Or give an array, whose columns count by their place: table[[…]].to_numpy()."
        )
    try:
        array: Array = np.asarray(np.ma.filled(np.ma.array(source, dtype=float), np.nan))
    except (TypeError, ValueError):
        array = np.empty(0)
    triads, more = divmod(array.shape[-1] if array.shape[1:] else 0, 3)
    if triads not in (1, 2) or more > 1:
        raise InputError(
            "readings must be an array of the shape (n, 3), (n, 6) or (n, 7), with the columns ax, ay, az, mx, my, mz, "
            f"temperature; got {type(source).__name__} of shape {array.shape}. Or make readings by "
            "mwdcal.readings(…), or mwdcal.read_run(…) of a file."
        )
    return Readings(
        accelerometer=array[..., :3],
        magnetometer=array[..., 3:6] if triads == 2 else None,
        temperature=array[..., -1] if more else None,
    )


def head(*metadata: Mapping[str, object]) -> dict[str, Any]:
    """Serial and whether it is simulated, of what rests on inputs with these metadata."""
    serial = next(filter(None, map(serial_of, metadata)), None)
    return {"serial": serial, "simulated": any(map(is_simulated, metadata))}


def soaks(temperature: Array) -> Ints:
    """Number (..., n) of the soak that each station belongs to, coldest first.

    Soaks are more than `SOAK_GAP` apart. Temperatures without such a gap, a ramp, count as one soak up to
    10 °C (`LEAST_TEMPERATURE_SPAN`) and a `RAMP_PARTS`th of the run's span, and are beyond that cut into
    soaks of equal width.
    """
    order = np.argsort(temperature, -1, kind="stable")
    ascending = np.take_along_axis(temperature, order, -1)
    width = np.maximum(LEAST_TEMPERATURE_SPAN, np.ptp(ascending, -1)[..., None] / RAMP_PARTS)
    apart = np.diff(ascending, prepend=-np.inf, append=np.inf, axis=-1) > SOAK_GAP
    low = np.maximum.accumulate(np.where(apart[..., :-1], ascending, -np.inf), -1)
    ends = np.flip(np.where(apart[..., 1:], ascending, np.inf), -1)
    span = np.flip(np.minimum.accumulate(ends, -1), -1) - low
    parts = np.floor(span / width) + 1
    part = np.floor((ascending - low) * parts / np.where(span > 0, span, 1.0))
    part = np.minimum(part, parts - 1)
    new = apart[..., :-1] | (np.diff(part, prepend=0, axis=-1) != 0)
    numbers = np.empty(order.shape, int)
    np.put_along_axis(numbers, order, np.cumsum(new, -1) - 1, -1)
    return numbers


def direction_numbers(inclination: Array, azimuth: Array) -> Ints:
    """Number (..., n) of the reference direction of each station of a run; a blank angle equals a blank one.

    Definition: both angles of the stations of a direction lie within `ONE_SETTING` of their middle, as an encoder
    shows one setting, so that in order of size they follow each other by less than twice that. Where
    they go further, as on a ramp, only stations of equal angles are of one direction.
    """
    inclination, azimuth = np.broadcast_arrays(inclination, azimuth)
    shape, count = inclination.shape, max(inclination.shape[-1], 1)
    known = np.stack([inclination, np.cos(azimuth), np.sin(azimuth)]).reshape(3, -1)
    known = np.nan_to_num(known, nan=_BLANK)
    angles = np.nan_to_num(np.stack([inclination, azimuth]).reshape(2, -1))
    number = run = np.arange(known.shape[-1]) // count
    for most in (2 * ONE_SETTING - EQUAL, EQUAL):
        last = -1
        while last != (last := number.max(initial=0)):
            for each in known:
                order = np.lexsort((each, number))
                new = (np.diff(number[order]) != 0) | (np.diff(each[order]) > most)
                number = np.zeros(len(order), int)
                number[order[1:]] = np.cumsum(new)
        order = np.argsort(number, kind="stable")
        starts = np.flatnonzero(np.diff(number[order], prepend=-1))
        away = centred(angles - angles[:, order[starts]][:, number])[:, order]
        span = np.maximum.reduceat(away, starts, -1) - np.minimum.reduceat(away, starts, -1)
        wide = np.max(span, 0)[number] > 2 * ONE_SETTING
        if not wide.any():
            break
        number, known = 2 * number + wide, np.where(wide, known, 0.0)
    first = np.minimum.reduceat(number, np.arange(0, len(run), count))
    return np.asarray((number - first[run]).reshape(shape))


def usable_soaks(temperature: Array) -> Ints:
    """Number (..., n) of each station's soak: all 0 where temperatures span less than `LEAST_TEMPERATURE_SPAN`."""
    wide = np.ptp(temperature, axis=-1, keepdims=True) >= LEAST_TEMPERATURE_SPAN
    return np.where(wide, soaks(temperature), 0) if wide.any() else np.zeros(temperature.shape, int)


def highest_order(temperature: Array) -> Ints:
    """The highest order (...,) that soaks (..., n) can carry: one less than they are, 10 °C for each."""
    levels = usable_soaks(temperature).max(-1) + 1
    return np.asarray(
        np.minimum(levels - 1, np.ptp(temperature, axis=-1) // LEAST_TEMPERATURE_SPAN), int
    )
