"""A tool profile proposed for a table as it was exported.

Which tool axis each channel measures, and its nominal scale, from readings at known attitudes.

Each channel is a straight line of the component of the field along its tool axis, but for misalignment:
raw = scale · component + offset. Of all 48 signed permutations of a triad the right one leaves a few
per cent of the channels' variation, any other most of it, unless the attitudes do not tell them apart.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from itertools import permutations, product
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.calibration.record import Finding
from mwdcal.errors import FitError, InputError
from mwdcal.files.contract import CHANNELS, MAPPED, REFERENCES, units_of
from mwdcal.files.formats import table as tables
from mwdcal.files.formats.columns import shown
from mwdcal.files.formats.dialect import Export
from mwdcal.files.formats.table import Table
from mwdcal.files.metadata import toml
from mwdcal.files.runs import check_run, renamed, to_readings
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import Array, Bools, tool_from_earth
from mwdcal.identification.columns import proposed
from mwdcal.sensor.profile import ColumnSource, Profile, TriadProfile

EXPLAINED = 0.3
"""Largest share of the channels' variation that the right axes leave: misalignment, noise, bias."""
ALTERNATIVE = 0.2
"""By how much less they leave than any others."""
LEAST_WITHOUT, LEAST_RATIO = 0.1, 2.0
"""A sign is told where without the component that tells it this share would be left, and so many times as much."""
LEAST_STATIONS = 5


class Wiring(NamedTuple):
    """The axes and scale of a triad, the share that they leave, and others that fit about as well."""

    axes: tuple[str, ...]
    scale: float
    unexplained: float
    next_best: float
    alternatives: list[tuple[str, ...]]


def wiring(raw: Array, *parts: Array) -> Wiring:
    """The axes of a triad by its raw readings (n, 3) and the field along the tool axes.

    `parts` (n, 3) each: components of the field at right angles to each other, which may come in unknown
    shares; the sign of the first is known. The scale is in raw units per unit of the field.
    Singular: a channel or a component that hardly varies explains nothing; its axis and sign stay open. So does the
    sign where the other component explains the readings as well, as at two inclinations and one azimuth.
    """
    shares, sizes = np.ones((2, 3, 3)), np.zeros((3, 3))
    moved = raw - raw.mean(0)
    spread = np.sqrt(np.mean(moved**2, 0))
    for axis in range(3):
        design = np.stack([part[:, axis] - part[:, axis].mean() for part in parts], -1)
        size = np.sqrt(np.mean(design**2, 0))
        seen = size > 0.02 * np.sqrt(np.mean(np.square(parts), (1, 2)))
        if not seen[0]:
            continue
        columns = design[:, seen]
        slope, share = _line(columns, moved)
        sizes[:, axis] = np.linalg.norm(slope, axis=0)
        alive = spread > 0.02 * spread.max()
        bare = _line(columns[:, 1:], moved)[1]
        signed = (bare > np.maximum(LEAST_WITHOUT, LEAST_RATIO * share)) | (columns.shape[1] == 1)
        for sign in (0, 1):
            right = slope[0] > 0 if sign == 0 else slope[0] < 0
            shares[sign, :, axis] = np.where(alive & (right | ~signed), share, 1.0)
    ranked = sorted(
        (float(np.sqrt(np.mean(shares[signs, range(3), order] ** 2))), order, signs)
        for order in permutations(range(3))
        for signs in product((0, 1), repeat=3)
    )
    best, order, signs = ranked[0]
    near = [each for each in ranked if each[0] < best + ALTERNATIVE]
    scale = float(np.median(sizes[range(3), order]))
    return Wiring(
        _named(order, signs), scale, best, ranked[1][0], [_named(*each[1:]) for each in near]
    )


def _line(columns: Array, moved: Array) -> tuple[Array, Array]:
    """Slopes (K, 3) of the channels on columns (n, K), and the share of their variation that is left (3,).

    Per degree of freedom: few stations do not seem explained by many columns.
    """
    count, width = columns.shape
    slope, *_ = np.linalg.lstsq(columns, moved, rcond=1e-9)
    spread = np.sqrt(np.sum(moved**2, 0) / (count - 1))
    left = np.sqrt(np.sum((moved - columns @ slope) ** 2, 0) / (count - 1 - width))
    return np.asarray(slope), np.asarray(np.minimum(left / np.maximum(spread, 1e-300), 1.0))


def _named(order: tuple[int, ...], signs: tuple[int, ...]) -> tuple[str, ...]:
    return tuple("+-"[sign] + "xyz"[axis] for axis, sign in zip(order, signs, strict=True))


def is_clear(result: Wiring) -> bool:
    """Whether the readings leave no choice of axes."""
    return len(result.alternatives) == 1 and result.unexplained < EXPLAINED


NEEDED = {
    "accelerometer": ("inclination", "toolface"),
    "magnetometer": ("inclination", "azimuth", "toolface"),
}
"""References that tell the axes of a triad."""
UNRELATED = 0.9
"""Readings of which even the best axes leave more than this share have nothing to do with the references."""
SAME_ANGLE = np.radians(1e-4)
"""Inclinations of a stand never agree with raw readings to this, radians."""
LAST_PLACES = (0.1, 0.01, 0.001)
"""Units in the last place of angles, degrees."""
SAME_GRAVITY = 2e-4
"""A local gravity does not differ by more between stations, g; what tools measure does."""
MOST_NAMED = 6
"""Alternatives that a message names."""


class Proposal(NamedTuple):
    """A profile, how the axes of each triad in it were told, and the run that told.

    `unused` are columns of the table that are nothing of a run file, `by_value` columns of a run file whose
    unit no name states; `metadata` what the table says of itself.
    """

    profile: Profile
    wirings: dict[str, Wiring]
    stations: int
    unused: tuple[str, ...]
    by_value: set[str]
    metadata: Mapping[str, object]
    run_sha256: str


def propose(path: str | os.PathLike[str]) -> Proposal:
    """The profile with which a table of stations at known attitudes is a calibration run.

    Raises:
        InputError: the file cannot be read, or is no table of stations.
        FitError: columns, units or axes that names and readings leave open.
    """
    export = tables.recognised(path)
    form = None if _is_documented(path, export) else export.form
    table = tables.read(path, export=form)

    def values(name: str) -> Array | None:
        try:
            return tables.numbers(table, name)
        except InputError:
            return None

    stated = "azimuth_reference" in table.metadata
    columns, by_value = proposed(
        export.names, export.units, values, table.source, export.above, stated
    )
    profile = Profile(name=Path(path).stem, table=form or msgspec.UNSET, columns=columns)
    run = renamed(table, profile)
    check_run(run)
    readings, _ = to_readings(run, profile)
    _check_gravity(readings, columns)
    wirings = _wirings(run, readings)
    scales = {kind: _rounded(result.scale) for kind, result in wirings.items()}
    if readings.relative:
        scales["magnetometer"] = None
    triads = {
        kind: TriadProfile(axes=result.axes, scale=scales[kind])  # type: ignore[arg-type]
        for kind, result in wirings.items()
    }
    name = str(readings.metadata.get("serial", Path(path).stem))
    profile = msgspec.structs.replace(profile, name=name, **triads)
    return Proposal(
        _without_the_usual(profile),
        wirings,
        readings.count,
        readings.unused,
        by_value,
        readings.metadata,
        readings.run_sha256,
    )


def _is_documented(path: str | os.PathLike[str], export: Export) -> bool:
    """Whether a table, but for the names of its columns, is written as a run file is."""
    suffix, form = Path(path).suffix.lower(), export.form
    if form.first_line != form.header_line + 1 and suffix != ".parquet":
        return False
    if suffix in (".csv", ".tsv") and form.delimiter != {".csv": ",", ".tsv": "\t"}[suffix]:
        return False
    try:
        return [*tables.read(path).columns] == export.names and form.decimal == "."
    except InputError:
        return False


def _rounded(scale: float) -> float | None:
    """Four digits: a nominal scale says no more."""
    return float(f"{scale:.4g}")


def _without_the_usual(profile: Profile) -> Profile:
    """The profile without what it would say of a table that is a run file already."""
    columns = profile.columns
    assert not isinstance(columns, msgspec.UnsetType)
    usual = all(
        c == each.name and each.unit in ("", *units_of(c)[:1]) for c, each in columns.items()
    )
    is_run_file = usual and isinstance(profile.table, msgspec.UnsetType)
    return msgspec.structs.replace(profile, columns=msgspec.UNSET) if is_run_file else profile


def _wirings(run: Table, readings: Readings) -> dict[str, Wiring]:
    """The axes of the triads that the run has."""
    known = {name: readings.reference(name) for name in NEEDED["magnetometer"]}
    results = {}
    for kind in TRIADS:
        if getattr(readings, kind) is None:
            continue
        absent = [name for name in NEEDED[kind] if np.isnan(known[name]).all()]
        whole = np.all([~np.isnan(known[name]) for name in NEEDED[kind]], 0)
        if absent or whole.sum() < LEAST_STATIONS:
            raise _unknown(kind, absent, int(whole.sum()), readings)
        raw = np.stack([tables.numbers(run, name) for name in CHANNELS[kind]], -1)[whole]
        result = wiring(raw, *_parts(kind, readings, whole))
        if not is_clear(result):
            raise FitError(f"{run.source}: {_choice(kind, result)}")
        results[kind] = result
        _check_independent(readings, results)
    return results


def _check_gravity(readings: Readings, columns: Mapping[str, ColumnSource]) -> None:
    """Refuse a gravity that differs from station to station: the tool has measured it."""
    gravity = readings.reference("gravity")
    if np.ptp(gravity) <= SAME_GRAVITY:
        return
    name, apart = columns[REFERENCES["gravity"].column].name, 1000 * np.ptp(gravity)
    raise FitError(
        f"{readings.source}: {shown(name)} differs between stations by {apart:.2g} mg, as no local gravity does: "
        "the tool has measured it. Remove the column, or put the gravity of the place into it."
    )


def _check_independent(readings: Readings, results: dict[str, Wiring]) -> None:
    """Refuse inclinations that were computed from the readings: they are no reference."""
    result = results["accelerometer"]
    permutation = TriadProfile(axes=result.axes).permutation  # type: ignore[arg-type]
    vectors = readings.accelerometer @ permutation.transpose()
    computed = OBSERVABLES["inclination"].value(vectors, vectors)
    stated = readings.reference("inclination")
    same = SAME_ANGLE + _last_place(stated[~np.isnan(stated)]) / 2
    if np.nanmax(np.abs(computed - stated)) < same:
        raise FitError(
            f"{readings.source}: the inclinations are those that the readings themselves give, to "
            f"{np.degrees(same):.1g}°: they were computed from them. A calibration needs the angles of the "
            "stand: name their columns as references, such as 'Ref Inc'."
        )


def _last_place(angles: Array) -> float:
    """The unit in the last place, radians, of angles given to a hundredth or thousandth of a degree, else zero.

    Stands that are read to a tenth or less agree with a sound tool by chance.
    """
    steps = {place: np.degrees(angles) / place for place in LAST_PLACES}
    fine = (p for p, step in steps.items() if np.allclose(step, np.round(step), rtol=0, atol=1e-6))
    place = next(fine, LAST_PLACES[0])
    return 0.0 if place == LAST_PLACES[0] else float(np.radians(place))


def _unknown(kind: str, absent: list[str], stations: int, readings: Readings) -> FitError:
    """The refusal of a run without the references that tell the axes of a triad."""
    lacking = f" (no {absent[0]})" if absent else ""
    others = f" Columns not understood: {', '.join(readings.unused)}." if readings.unused else ""
    return FitError(
        f"{readings.source}: the axes of the {kind} are told by readings at known "
        f"{', '.join(NEEDED[kind])}: at least {LEAST_STATIONS} stations, got {stations}{lacking}. Add these "
        'columns, or write a profile with axes such as ["+x", "+y", "+z"] (all 48 orders and signs are open).'
        f"{others}"
    )


def _parts(kind: str, readings: Readings, whole: Bools) -> list[Array]:
    """Components of the field along the tool axes (n, 3), in g or nT; of an unknown dip, both of them."""
    angles = [
        np.nan_to_num(readings.reference(name)[whole])
        for name in ("inclination", "azimuth", "toolface")
    ]
    turn = tool_from_earth(*angles)
    north, down = turn[..., 0], turn[..., 2]
    if kind == "accelerometer":
        return [down]
    dip, field = (readings.reference(name)[whole] for name in ("dip", "field"))
    strength = np.where(np.isnan(field), 1.0, field)[:, None]
    if np.isnan(dip).any():
        return [north * strength, down * strength]
    return [strength * (north * np.cos(dip)[:, None] + down * np.sin(dip)[:, None])]


def _choice(kind: str, result: Wiring) -> str:
    """The sentence on axes that the readings leave open."""
    if len(result.alternatives) == 1 or result.unexplained > UNRELATED:
        return (
            f"no axes of the {kind} explain its readings: the best, {toml(result.axes)}, leave "
            f"{result.unexplained:.0%} of their variation. Check the reference angles, their units, and whether "
            "the columns are the raw channels."
        )
    named = " or ".join(toml(axes) for axes in result.alternatives[:MOST_NAMED])
    more = len(result.alternatives) - MOST_NAMED
    return (
        f"the readings leave the axes of the {kind} open: {named}{f' or {more} others' if more > 0 else ''}. "
        "Add stations at other inclinations and toolfaces, or write the axes into a profile."
    )


def left_handed(proposal: Proposal) -> list[Finding]:
    """A finding on triads whose channels x, y, z are a left-handed set by the axes proposed."""
    triads = [
        kind
        for kind, result in proposal.wirings.items()
        if np.linalg.det(TriadProfile(axes=result.axes).permutation) < 0  # type: ignore[arg-type]
    ]
    if not triads:
        return []
    return [
        Finding(
            id="left-handed",
            text=f"{' and '.join(triads)}: by the axes proposed the channels x, y, z are a left-handed set. If the "
            "tool is not built so, a reference angle counts the other way: toolface anticlockwise, or inclination "
            "from below.",
        )
    ]


def as_toml(proposal: Proposal, source: str) -> str:
    """The text of the profile, with how its entries were told."""
    profile = proposal.profile
    lines = [
        f"# Proposed by mwdcal profile from {source}, {proposal.stations} stations. Check and complete it.",
        f"name = {toml(profile.name)}",
    ]
    for kind, unit in (("accelerometer", "g"), ("magnetometer", "nT")):
        if kind in proposal.wirings:
            result = proposal.wirings[kind]
            lines += [
                "",
                f"[{kind}]",
                f"# {_sureness(result)}",
                f"axes = {toml(result.axes)}",
            ]
            if scale := getattr(profile, kind).scale:
                lines.append(f"scale = {scale!r}   # raw units per {unit}")
    if not isinstance(profile.table, msgspec.UnsetType):
        lines += ["", "[table]"]
        fields = msgspec.structs.asdict(profile.table)
        if source.lower().endswith(".xlsx"):
            fields = {key: fields[key] for key in ("header_line", "first_line")}
        lines += [f"{key} = {toml(value)}" for key, value in fields.items()]
    if not isinstance(profile.columns, msgspec.UnsetType):
        lines += [
            "",
            "[columns]   # of a run file = of this table; ref_ are angles of the stand, not the tool's",
        ]
        for column, each in in_order(profile.columns):
            guess = "   # unit by its values" if column in proposal.by_value else ""
            lines.append(f"{column} = {toml(_stated(each))}{guess}")
    return "\n".join(lines) + "\n"


def in_order(columns: dict[str, ColumnSource]) -> list[tuple[str, ColumnSource]]:
    """The columns in the order of a run file."""
    return sorted(columns.items(), key=lambda each: MAPPED.index(each[0]))


def _stated(each: ColumnSource) -> dict[str, str]:
    return {key: value for key, value in msgspec.structs.asdict(each).items() if value}


def _sureness(result: Wiring) -> str:
    return (
        f"these axes leave {result.unexplained:.1%} of the readings' variation, the next best "
        f"{result.next_best:.0%}"
    )
