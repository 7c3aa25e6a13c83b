"""The findings on a calibration in plain words, each with its remedy."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import compress
from typing import Any

import numpy as np

from mwdcal.calibration.automatic.courses import (
    aligned,
    misfit_size,
    orders_of,
    terms_beyond,
    untested,
)
from mwdcal.calibration.automatic.drift import chances_without_drift
from mwdcal.calibration.copies import AGREEING, repeated
from mwdcal.calibration.diagnosis.flags import FittedRuns, Flag, listed, spaced
from mwdcal.calibration.diagnosis.plausibility import (
    NOISE_RATIO,
    departures,
    misfit_chances,
    robust,
    setting_chances,
    stations_to_reshoot,
    toolface_agreement,
    unchecked,
)
from mwdcal.calibration.diagnosis.structure import COLUMN, farthest_setting, is_shown, suspected
from mwdcal.calibration.diagnosis.structure import described as seen_as
from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.options import DIRECTION, UNSHARED, unshared
from mwdcal.calibration.readings import (
    EARTH_GRAVITY,
    EARTH_RANGES,
    HIGHEST,
    STAND_ANGLES_EXACT,
    TRIADS,
    Readings,
)
from mwdcal.calibration.record import MISFIT_CHANCE, SHOWN_DRIFT, STATE_STAND, Finding
from mwdcal.calibration.residuals import REASONS, chances, rms, shown_in, tail
from mwdcal.calibration.results import (
    common_source,
    drift_shares,
    drifts,
    reading_noise,
    unconfirmed_dip,
)
from mwdcal.estimation.batch import take
from mwdcal.estimation.problem import ANGLES, WALK_AXES, Prior
from mwdcal.estimation.solvers import Determined
from mwdcal.estimation.uncertainty import (
    fisher_tail,
    free_directions,
    per_freedom,
    station_misfit,
)
from mwdcal.geometry.vectors import Array, Bools, Ints, diagonal, quotient
from mwdcal.sensor.profile import PRACTICES, Profile

# --------------------------------------------------------------------------
# Stations that repeat the readings of an earlier one more closely than noise allows: copies, not measurements.


def copies(result: Fit) -> Bools:
    """Stations (B, n) whose readings agree with those of an earlier one, where noise does not explain it.

    All stations are compared only in runs where two agree that are near each other on one line through the readings.
    """
    less = np.minimum(np.nan_to_num(result.analysis.variance_factor, nan=1.0), 1.0)
    noise = reading_noise(result) * np.sqrt(less)  # as the residuals have it where more is declared
    noise = np.where(noise > 0, noise, 1.0)
    rows = np.concatenate(
        [t.raw / noise[:, [i], None] for i, t in enumerate(result.problem.triads)], -1
    )
    rows = np.nan_to_num(rows)
    weights = np.sqrt(2.0 + np.arange(rows.shape[-1]))
    line = np.einsum("bnk,k->bn", rows, weights)
    order = np.argsort(line, -1)
    line = np.take_along_axis(line, order, -1)
    farthest = len(weights) * AGREEING**2
    agree, again = np.zeros(len(rows), bool), np.zeros(rows.shape[:-1], bool)
    for apart in range(1, line.shape[-1]):
        close = (line[:, apart:] - line[:, :-apart]) ** 2 <= farthest * np.sum(weights**2)
        if not close.any():
            break
        tools, first = np.nonzero(close)
        one, other = (rows[tools, order[tools, at]] for at in (first, first + apart))
        agree[tools[np.sum((other - one) ** 2, -1) <= farthest]] = True
    for member in np.flatnonzero(agree):
        again[member] = repeated(rows[member])
    return again


NEARLY_ALL = 0.9
"""Share of an error to declare from which it is declared."""
AGREEMENT_CHANCE = 1e-4
"""Chance of as much agreement between errors of toolface, below which it is reported."""
LEAST_SHOWN = 0.1
"""A smaller share of the stand's σ by which stations of one setting scatter is no finding."""
COARSE_STAND = 3e-3
"""A σ of the stand of less, radians, is never called too large: 0.17°."""
COARSE_RATIO = 10.0
"""So many times its errors a stated σ of the stand is called too large."""
LEAST_ANGLES = 4
"""Fewest different angles that show so."""
LEAST_UNEQUAL = 1.5
"""A smaller ratio of the noises of two axes is no finding: a 95 % interval then still holds 88 %."""
FEW_FREEDOM = 8.0
"""Fewer degrees of freedom are reported: from them s is known no better than to a quarter."""
ONE_DIRECTION = 0.996
"""Tool axes have one direction where the cosine between them is larger: they differ by less than 5°."""
LOW_WEIGHT = 0.1
"""A station of less weight than this in a robust fit is reported."""
SCATTER_SHARE = 3e-4
"""A scatter from station to station beyond this share, or radians, is a finding."""
LARGEST_DEVIATION = 37.0
"""Larger deviations have no figure: a normal variable's chance is then below 1e-300."""
FOLLOWED = 0.9
"""Share of a drift within the run that goes with a column, from which the column is named."""
RARE_CHANCE = 1e-4
"""The share of runs below which a chance has no figure in words."""
UNUSED, MARKED_ROWS, ROLL_TEST_READ = "unused-columns", "marked-rows", "roll-test-read"
COLUMNS_READ, MISFIT_BY_COLUMN = "columns-read", "column-explains"
"""The ids of the findings with the names by which surveys were read, and on a column that explains misfit or drift."""
OF_ROLL_TEST = "the roll test"
"""How remarks begin on a roll test that was read by names of its own."""
COLUMNS_NAMED = 20
"""Most columns that the finding names."""
STATIONS_NAMED = 8
"""Most stations that a finding names."""

FREE_DIRECTIONS = {
    "toolface-zero": "toolface zero is undetermined: no evidence fixes rotation about the tool axis; kept at nominal. "
    "Give ref_toolface_deg at some stations to determine it",
    "rotation-x": "rotation about the tool's x axis is undetermined: no evidence fixes it; kept at nominal. Give "
    "reference inclinations, or roll sets at three or more directions, each with a name in the column 'group'",
    "rotation-y": "rotation about the tool's y axis is undetermined: no evidence fixes it; kept at nominal. Give "
    "reference inclinations, or roll sets at three or more directions, each with a name in the column 'group'",
    "scale": "overall scale is undetermined: no evidence fixes it; kept at nominal. Give a reference "
    "strength: ref_gravity_g or ref_field_nt",
}

_RADIANS = " In `sd` of Python '{name}' is in radians: {rad:.2g} rad is {deg:.3g}°. Degrees go to '{name}_deg'."
REMARKS = {
    "noise": "{triad}: residuals are only {times:.2f} of what noise and stand as declared would leave (chance "
    "{small:.0e}): the declared noise is too large, readings are copies of each other, or they were corrected by a "
    "fit before. Uncertainties stay as declared; check the noise of the profile and the columns sd_.",
    "axis-noise": "{triad}: residuals along {of[most]} are {of[times]:.1f} times those along {of[least]} (chance in "
    "equal noise {of[chance]:.0e}). {stand}Uncertainties take the axes as equal: they are too small where "
    "{of[most]} counts most. State the noise of each axis in the columns sd_ of run and readings, "
    "or find what acts along it.",
    "settings": "readings put the {angle} of {where} {value:+.3g}° from its reference: {size:.1f} σ of a setting of "
    "the stand. Check this reference, or declare a larger σ.",
    "settings-apart": "stations of one direction scatter by {share:.0%} of the stand's σ, as if the stand had been set "
    'anew at each, or as readbacks flicker. State settings = "per-station" or "per-direction" in {where}.',
    "settings-unshared": UNSHARED,
    "stand-too-large": "the stated σ of the stand is far larger than its errors in this run: {angles}. Uncertainties "
    "are too large: check it against the certificate.{radians}",
    "toolface-shared": "errors of the stand's toolface agree within each {by} (chance in noise {chance:.0e}), as if it "
    "had been set {groups} times in all. The stated uncertainty of toolface counts one error a station, and is too "
    "small: declare toolface_zero_deg = {size:.2g} under [stand] of the profile beside toolface_deg.",
    "residuals": "{triad}: residuals are {times:.2f} times the declared noise{rare}. {stand}The noise figure, a "
    "reference, or the model is wrong. The uncertainty is scaled up as if each station had an error of its own; an "
    "error that stations share may be larger than it says.",
    "field-drift": "Readings follow the order of the stations as if the field drifted by {change:.2g} {unit} (1σ "
    "{sd:.2g} {unit}) during the run{by_noise}. The fit allows for this drift, and the uncertainty includes it. Give "
    "ref_field_nt and ref_dip_deg of each station from a reference magnetometer, or repeat the run at a quiet time.",
    "drift": "Readings follow the order of the stations as if the offsets of the {triad} drifted by "
    "{change:.2g} {unit} (1σ {sd:.2g} {unit}) during the run{by_noise}. The fit allows for this drift, and the "
    "uncertainty includes it. Let the tool warm up, change inclination and azimuth in another order than from end "
    "to end, and measure at the first temperature again at the end.",
    "column-explains": "The drift within the run goes with the column {column!r}, which is not used. If it is the "
    "temperature of the tool, name it 'temperature_c' (°C), or under [columns] of the tool profile; else find out what "
    "it stands for.",
    "no-redundancy": "{triads}: no redundancy, so nothing in this run checks the fit. Add stations.",
    "few-degrees-of-freedom": "the {few}: another run like this one may state {share:.0f} % more or less (1σ), and an "
    "error of a single station is hard to see. Add stations.",
    "few-directions": "the tool axis has only two directions in this run, so a wrong angle of the stand at one of them "
    "may show nowhere. Add stations at a third inclination and azimuth.",
    "scatter": "beyond sensor noise, these vary from station to station: {what} (1σ, estimated; weights and "
    "uncertainties include it). Look for iron near the stand and play in the tool holder; or the model lacks "
    "something.",
    "hemisphere": "the dip comes out negative ({dip:.1f}°) and no reference confirms it: either the site is in the "
    "southern hemisphere, or all signs of the magnetometer are reversed and azimuths are wrong by 180°. "
    "Give ref_dip_deg, or ref_azimuth_deg at one direction.",
    "gravity-reference": "ref_gravity_g gives {value:.6g} g, and no place on land has less than {low} or more than "
    "{high}: the accelerometers are scaled to it. Check it, and its unit.",
    "repeated-readings": "station {stations}: the same readings as an earlier station, closer than noise allows. "
    "Copies are no measurements of their own. Left out of the fit: {count} of {of} stations. Remove them from the run, "
    "or measure anew.",
    "temperature-misfit": "{triad}: {of[cause]}, beyond what noise explains: {of[rms]:.2g} {of[unit]} rms per axis "
    "over the range ({of[angle]:.2g}° across the field). The uncertainties here include it. {of[remedy]}.",
    "temperature-untested": "{triads}: {levels} temperatures are as many as a course of order {order} takes, so "
    "nothing tests it between them, and {unsaid}. Add a temperature between them.",
    "prior-aged": "The prior ({source}) allows for what the tool may have changed since, {ageing}. State turn_on, "
    "bias_walk and scale_walk under [accelerometer.datasheet] and [magnetometer.datasheet] of the profile if you "
    "know better.",
    "temperature-aligned": "{triads}: this run cannot tell power {power} of temperature from the terms below it, and "
    "no uncertainty here includes it: attitudes and temperature went together, or the attitudes are too few. Repeat "
    "the same attitudes at other temperatures, on the way up and on the way down.",
    "prior-shared": "the prior ({source}) and this run both have {both} in their uncertainty, and count as independent "
    "there. On the same stand it is one error: what rests on it is then stated up to 1.4 times too small.",
    "prior-only": "this run does not determine {names}: there values and uncertainties rest on the prior ({source}).",
    "prior-conflict": "the run departs from the prior ({source}) by {ratio:.1f} times what both allow: the tool has "
    "changed, or the prior is too narrow. Leave `prior` out, or widen it.",
    "nonlinearity-ignored": "nonlinearity of the {triads} is not fitted: the model of factors has no such terms. Use "
    "`model` polynomial for it.",
    "field-unknown": "no station states the strength of the field, so the magnetometer is calibrated to field = 1 "
    "instead of nT. Give ref_field_nt to have nT.",
    "gravity-unknown": "no station states gravity: 1 g (9.80665 m/s²) is assumed, and the scale factors of the "
    "accelerometer are off as gravity at the stand is, by up to 0.3 %; angles are not. Give ref_gravity_g.",
    "restricted": "{parameters} parameters: {lost} of the sensors in the tool is taken as none, and no uncertainty "
    "here includes it. Use `parameters` 12 to fit it.",
    "reshoot": "station {of[station]}: residual {of[size]}σ, most in {of[worst]} ({of[value]:+.3g}{of[unit]}; "
    "{of[alone]:+.3g}{of[unit]} if left out of the fit, which it moves by up to {of[moves]:.2g}{of[unit]}): "
    "{of[reason]} Re-shoot it, or `exclude` {of[station]}",
    "distrusted": "robust fit: low weight for station {stations}. Look at what they have in common.",
}
"""The statement of a finding, by its id or the end of it."""

SCATTERED = {
    "gravity": "the strength of g by {:.2f} %",
    "field": "the strength of b by {:.2f} %",
    "dip": "the dip by {:.2f}°",
    "direction": "the direction within groups by {:.2f}°",
}


def described(name: str) -> str:
    """The meaning of a free direction, and the measurement that would determine it."""
    steady, _, power = name.partition("-temperature-")
    course = f" (its variation with temperature, power {power})" if power else ""
    return FREE_DIRECTIONS.get(steady, steady) + course


def unused_columns(columns: Sequence[str]) -> list[Finding]:
    """Columns of a file that are not used, each with what it resembles."""
    if not columns:
        return []
    return [Finding(id=UNUSED, text=f"columns not used: {listed(columns, COLUMNS_NAMED)}.")]


_OF_THE_EARTH = {
    "ref_gravity_g": ", or no gravity on Earth (9.76 to 9.84 m/s²)",
    "ref_field_nt": ", or no field on Earth ({:,.0f} to {:,.0f} nT)".format(*EARTH_RANGES["field"]),
}
"""A third reason why a line is not taken, by column of a run file."""


def references_not_taken(lines: Mapping[str, str]) -> list[Finding]:
    """A finding on each line that may state a reference, by column of a run file, which is not stated otherwise."""
    return [
        Finding(
            id="reference-not-taken",
            text=f"'{line}' is nominal or unclear{_OF_THE_EARTH.get(column, '')}, and not taken as '{column}', which "
            "the run does not state otherwise. If it holds, state it plainly, or in a column.",
        )
        for column, line in lines.items()
    ]


_OTHER_SIGN = str.maketrans("+-", "-+")


def is_left_handed(axes: Sequence[str]) -> bool:
    """Whether the `axes` of a triad make a left-handed set of its channels x, y, z.

    >>> is_left_handed(("+y", "+x", "+z")), is_left_handed(("-y", "+x", "+z"))
    (True, False)
    """
    text = "".join(axes)
    odd = text[1::2] not in ("xyz", "yzx", "zxy")
    return odd != (text.count("-") % 2 == 1)


def left_handed(axes: Mapping[str, Sequence[str]]) -> list[Finding]:
    """A finding on triads whose channels x, y, z are a left-handed set by their axes.

    Not on an accelerometer whose channels all read opposite to those of the magnetometer: positive upwards, as many do.
    A magnetometer that reads so is that of a tool turned by 180° of azimuth, and named.
    """
    triads = [*compress(axes, map(is_left_handed, axes.values()))]
    if not triads:
        return []
    others = [kind for kind in axes if kind not in triads]
    opposite = [tuple(axis.translate(_OTHER_SIGN) for axis in axes[kind]) for kind in triads]
    reversed_whole = bool(others) and opposite == [tuple(axes[others[0]])]
    if reversed_whole and triads == [TRIADS[0]]:
        return []
    reason = (
        "all azimuths of the stand are 180° off, and the dip has the wrong sign: correct both"
        if reversed_whole
        else f"two channels are exchanged or one is reversed, other than in the {others[0]}: correct that, or read "
        "roll test and surveys with the same wiring"
        if others
        else "a reference angle counts the other way: toolface anticlockwise, or inclination from below"
    )
    return [
        Finding(
            id="left-handed",
            text=f"{' and '.join(triads)}: by the `axes` of the profile the channels x, y, z are a left-handed set. If "
            f"the tool is not built so, {reason}.",
        )
    ]


def magnetometer_absent(references: Iterable[str]) -> list[Finding]:
    """A finding on references of the field that a table states which has no magnetometers."""
    stated = " and ".join(sorted({*references} & {"field", "dip"}, reverse=True))
    text = f"{stated} of the field are stated, and the table has no magnetometers: the accelerometers alone are used."
    return [Finding(id="no-magnetometer", text=text)] if stated else []


def of_table(readings: Readings) -> list[Finding]:
    """Rows of the table that its laboratory has marked, references that are not read, and columns not used."""
    marked = [
        Finding(id=ROLL_TEST_READ if text.startswith(OF_ROLL_TEST) else MARKED_ROWS, text=text)
        for text in readings.remarks
    ]
    unread = references_not_taken(readings.not_taken)
    known = [name for name, values in readings.known.items() if not np.isnan(values).all()]
    absent = magnetometer_absent(known) if readings.magnetometer is None else []
    return [*marked, *unread, *absent, *unused_columns(readings.unused)]


def angles_absent(profile: Profile, readings: Readings) -> list[Finding]:
    """A finding on a run without any angle of the stand, where the profile names columns of these."""
    if any(not np.isnan(readings.reference(name)).all() for name in ANGLES):
        return []
    columns = profile.columns or {}
    names = [f"'{columns[c].name}'" for n in ANGLES if (c := f"ref_{n}_deg") in columns]
    text = f"the table has no angles of the stand: the tool profile's columns {listed(names, len(names))} are absent."
    return [Finding(id="angles-absent", text=text)] if names else []


def findings(flags: Iterable[Flag], place: int, labels: Sequence[str]) -> list[Finding]:
    """The findings of one run, in order of weight, of the `flags` of its batch; `labels` of its stations."""
    return [
        Finding(
            id=flag.id,
            text=flag.sentence(place),
            station=None if flag.station is None else labels[flag.station[place]],
        )
        for flag in flags
        if flag.members[place]
    ]


def finding_flags(fitted: FittedRuns) -> Iterator[Flag]:
    """All findings of a batch, in order of weight: some ids come more than once."""
    causes = [*_followed(fitted), *_structure(fitted)]
    yield from [flag for flag in causes if flag.id == MISFIT_BY_COLUMN]
    yield from _noise(fitted)
    yield from _axis_noise(fitted)
    yield from _redundancy(fitted)
    yield from _settings(fitted)
    yield _hemisphere(fitted)
    yield _gravity(fitted)
    yield from _drifts(fitted)
    yield from [flag for flag in causes if flag.id != MISFIT_BY_COLUMN]
    yield _scatter(fitted)
    yield _repeated(fitted)
    yield from _beyond_order(fitted)
    yield _untested(fitted)
    yield _aligned(fitted)
    yield from _undetermined(fitted)
    yield from _prior(fitted)
    yield from _model(fitted)
    profile, count = fitted.profile, len(fitted.result.problem.triads)
    both = [profile.accelerometer.axes, profile.magnetometer.axes]
    axes = dict(zip(TRIADS, both[:count], strict=False))
    turned = both[:count].count(("+x", "+y", "+z")) < count
    of_run = [*angles_absent(profile, fitted.readings), *of_table(fitted.readings)]
    for each in [*(left_handed(axes) if turned else ()), *of_run]:
        yield _common(fitted, each.id, each.text, range(fitted.count))
    yield from _culprits(fitted)
    yield _distrusted(fitted)


def _remark(name: str, members: Bools, **values: Any) -> Flag:
    """A finding by its name, with what fills in its words."""
    return Flag(name, members, REMARKS[name], values)


def _common(fitted: FittedRuns, name: str, text: str, places: Sequence[int]) -> Flag:
    """One sentence for the members at some places."""
    members = np.isin(np.arange(fitted.count), places)
    return Flag(name, members, "{text}", {"text": text})


def _joined(triads: Bools, place: int) -> str:
    """The names of a member's flagged triads (B, t).

    >>> _joined(np.array([[True, True]]), 0)
    'accelerometer and magnetometer'
    """
    return " and ".join(TRIADS[index] for index in np.flatnonzero(triads[place]))


def _noise(fitted: FittedRuns) -> Iterator[Flag]:
    """Residuals far below the declared noise, then those far beyond it."""
    result, analysis, chances = fitted.result, fitted.result.analysis, fitted.chances
    declared, factor = np.isnan(result.noise), analysis.variance_factor
    small = misfit_chances(result, fitted.freedom, small=True)
    calm = declared & (small < MISFIT_CHANCE)
    weighed = robust(result)[:, None] & declared & ~unchecked(result)
    large = weighed & (factor > NOISE_RATIO**2) | (chances < MISFIT_CHANCE)

    times = np.sqrt(factor)
    stand = np.where(fitted.readings.exact_angles[STAND_ANGLES_EXACT], STATE_STAND, "")

    def rare(place: int, index: int) -> str:
        chance = chances[place, index]
        return "" if np.isnan(chance) else f" (chance in noise {chance:.0e})"

    for end, holds in (("noise", calm), ("residuals", large)):
        for index, triad in enumerate(TRIADS[: factor.shape[-1]]):
            of_triad = {"times": times[:, index], "small": small[:, index]}
            values = {
                "triad": triad,
                "rare": partial(rare, index=index),
                **of_triad,
                "stand": stand,
            }
            yield Flag(f"{triad}-{end}", holds[:, index], REMARKS[end], values)


def _axis_noise(fitted: FittedRuns) -> Iterator[Flag]:
    """Triads of which one axis has larger residuals than another, beyond what noise explains.

    Definition: Fisher's F of the largest and the smallest s² of an axis, for the six ordered pairs of axes, without the
    stations to take again. Of less noise than is declared an uncertainty makes no use.
    """
    result = fitted.result
    good = ~stations_to_reshoot(result)[..., None]
    shape = (len(good), -1, 3)  # members, triads, axes
    freedom = np.sum(diagonal(result.analysis.spread) * good, 1).reshape(shape)
    variance = per_freedom(np.sum(result.analysis.residual**2 * good, 1).reshape(shape), freedom)
    checked = (freedom.min(-1) >= 1) & ~robust(result)[:, None]
    ends = variance.argmax(-1), variance.argmin(-1)
    (most, over), (least, under) = (
        [np.take_along_axis(each, end[..., None], -1)[..., 0] for each in (variance, freedom)]
        for end in ends
    )
    ratio = quotient(most, least, checked & (least > 0))
    chance = 6 * fisher_tail(np.maximum(over, 1.0), np.maximum(under, 1.0), ratio)
    unequal = checked & (chance < MISFIT_CHANCE) & (ratio > LEAST_UNEQUAL**2) & (most > 1)

    def of(index: int, place: int) -> dict[str, Any]:
        names = ("xyz"[end[place, index]] for end in ends)
        times, rare = np.sqrt(ratio[place, index]), chance[place, index]
        return dict(zip(("most", "least", "times", "chance"), (*names, times, rare), strict=True))

    stand = np.where(fitted.readings.exact_angles[STAND_ANGLES_EXACT], STATE_STAND, "")
    for index, triad in enumerate(TRIADS[: variance.shape[1]]):
        values = {"triad": triad, "of": partial(of, index), "stand": stand}
        yield Flag(f"{triad}-axis-noise", unequal[:, index], REMARKS["axis-noise"], values)


def _settings(fitted: FittedRuns) -> Iterator[Flag]:
    """Stations of one direction that were set one by one, and toolfaces that were not."""
    share = fitted.result.problem.evidence.apart
    places = "mwdcal.readings(…)", "[stand] of the profile"
    yield _remark(
        "settings-apart", share > LEAST_SHOWN, share=share,
        where=lambda place: places[bool(fitted.alone(place)[0].source)],
    )  # fmt: skip
    if fitted.readings.settings == PRACTICES[0]:
        count = np.broadcast_to(unshared(fitted.readings), (fitted.count,))
        yield _remark("settings-unshared", count > 0, count=count)
    yield from _toolfaces(fitted.result)
    stated = {name: fitted.readings.uncertainty(name).max(-1) for name in ANGLES}
    if max(sd.max() for sd in stated.values()) > COARSE_STAND:
        yield _coarse_stand(fitted, stated)


def _coarse_stand(fitted: FittedRuns, stated: Mapping[str, Array]) -> Flag:
    """Angles of the stand whose `stated` σ (B,) is far larger than their errors: radians that were meant as degrees.

    Few angles may agree by chance: four different ones do so in 0.02 % of runs.
    """
    residuals = fitted.residuals
    left = {n: rms(each) for n, each in residuals.errors_after.items() if n in stated}
    coarse = np.zeros((fitted.count, len(ANGLES)), bool)
    for index, name in enumerate(ANGLES):
        if name in left and name not in residuals.fit.problem.evidence.absent:
            angles = np.sort(np.round(residuals.known[name], 6), -1)
            several = np.count_nonzero(np.diff(angles) > 0, -1) >= LEAST_ANGLES - 1
            expected = rms(residuals.expected[name])
            coarse[:, index] = several & (stated[name] > COARSE_STAND)
            coarse[:, index] &= expected > COARSE_RATIO * left[name]

    def angles_of(place: int) -> str:
        each = [name for name, far in zip(ANGLES, coarse[place], strict=True) if far]
        degrees = ((n, np.degrees([stated[n][place], left[n][place]])) for n in each)
        return ", ".join(f"{n} {sd:.2g}° (errors {error:.2g}°)" for n, (sd, error) in degrees)

    def radians_of(place: int) -> str:
        each = [n for n, far in zip(ANGLES, coarse[place], strict=True) if far]
        name = next((n for n in each if n in fitted.readings.in_radians), "")
        sd = stated[name][place] if name else 0.0
        return _RADIANS.format(name=name, rad=sd, deg=np.degrees(sd)) if name else ""

    words = {"angles": angles_of, "radians": radians_of}
    return _remark("stand-too-large", np.any(coarse, -1), **words)


def _toolfaces(result: Fit) -> Iterator[Flag]:
    """Toolfaces that were set less often than at every station, and whose error in common is not declared."""
    evidence, shown = result.problem.evidence, np.zeros(len(result.status), bool)
    declared = evidence.stand.get("toolface-zero", np.zeros(1))
    for by in ("setting", "direction", "toolface"):
        chance, groups = toolface_agreement(result, by)
        size = evidence.sd["toolface"].max(-1) / np.sqrt(np.maximum(groups, 1))
        members = (chance < AGREEMENT_CHANCE) & (declared < NEARLY_ALL * size) & ~shown
        shown |= members
        words = {
            "by": by.replace("setting", "direction"),
            "chance": chance,
            "groups": groups,
            "size": np.degrees(size),
        }
        yield _remark("toolface-shared", members, **words)


def _setting(fitted: FittedRuns, columns: Ints, seen: Array, place: int) -> str:
    """The statements about one setting's angle, of which `columns` has the unknown and `seen` the share seen of it."""
    evidence, state = fitted.result.problem.evidence, fitted.result.state
    column = int(columns[place])
    sd = evidence.set_together[place, :, column]
    second = column >= evidence.set_together.shape[-1] // 2
    angle, sign = DIRECTION[second], -1 if second else 1
    sigmas = float(state.settings[place, column] / seen[place, column])
    return REMARKS["settings"].format(
        where=f"stations {_from_to(fitted, place, np.flatnonzero(sd))}", angle=angle,
        size=abs(sigmas), value=sign * np.degrees(sigmas * sd.max()),
    )  # fmt: skip


def _redundancy(fitted: FittedRuns) -> Iterator[Flag]:
    """Triads without redundancy, or with too little to know s from, and runs in two directions of the tool axis."""
    bare, freedom = unchecked(fitted.result), fitted.freedom
    yield _remark("no-redundancy", np.any(bare, -1), triads=partial(_joined, bare))
    few = (freedom < FEW_FREEDOM) & ~bare

    def named(place: int) -> str:
        each = [f"{TRIADS[t]} has {freedom[place, t]:.0f}" for t in np.flatnonzero(few[place])]
        return f"{' and the '.join(each)} degrees of freedom"

    least = np.where(few, np.maximum(freedom, 1.0), np.inf).min(-1)
    share = 100 / np.sqrt(2 * least)
    yield _remark("few-degrees-of-freedom", np.any(few, -1), few=named, share=share)

    evidence, axis = fitted.result.problem.evidence, fitted.result.state.attitude[..., 2, :]
    each, used = np.arange(fitted.count), evidence.include > 0
    along = np.einsum("bni,bi->bn", axis, axis[each, used.argmax(-1)])
    other = axis[each, np.where(used, along, np.inf).argmin(-1)]
    near = np.maximum(along, np.einsum("bni,bi->bn", axis, other))
    referenced = (evidence.is_known("inclination") & used).any(-1)
    yield _remark("few-directions", referenced & np.all((near > ONE_DIRECTION) | ~used, -1))


def _hemisphere(fitted: FittedRuns) -> Flag:
    """A negative dip that only the signs of the magnetometer tell from a positive one."""
    dip = np.degrees(unconfirmed_dip(fitted.result))
    return _remark("hemisphere", dip < 0, dip=dip)


def _gravity(fitted: FittedRuns) -> Flag:
    """A reference of gravity that no place on land has."""
    evidence, (low, high) = fitted.result.problem.evidence, EARTH_GRAVITY
    given = np.broadcast_to(evidence.known["gravity"], evidence.include.shape)
    outside = evidence.is_known("gravity") & ~((given >= low) & (given <= high))
    first = given[np.arange(fitted.count), np.argmax(outside, -1)]
    return _remark("gravity-reference", np.any(outside, -1), value=first, low=low, high=high)


def _drifts(fitted: FittedRuns) -> Iterator[Flag]:
    """Drifts that are larger than what may be noise."""
    sizes = drifts(fitted.result)
    shown = {name: change > SHOWN_DRIFT * sd for name, (change, sd) in sizes.items()}
    chance = np.full(fitted.result.analysis.freedom.shape, np.nan)
    places = np.flatnonzero(np.any([np.zeros(fitted.count, bool), *shown.values()], 0))
    if places.size:
        chance[places] = chances_without_drift(take(fitted.result, places), fitted.options)
    for name, (change, sd) in sizes.items():
        triad = name.removesuffix("-drift")
        scale, unit = shown_in(
            "gravity" if triad == TRIADS[0] else "field", fitted.readings.relative
        )
        words = REMARKS["drift" if triad in TRIADS else name]
        values = {"triad": triad, "change": change * scale, "sd": sd * scale, "unit": unit}
        by_noise = partial(_by_noise, chance[:, 0 if triad == TRIADS[0] else 1])
        yield Flag(name, shown[name], words, {**values, "by_noise": by_noise})


def _by_noise(chance: Array, place: int) -> str:
    """How often noise leaves a member's evidence of a drift in runs without one; blank where it was not tested."""
    if np.isnan(chance[place]):
        return ""
    rare = chance[place] < RARE_CHANCE
    share = f"under {100 * RARE_CHANCE:g} %" if rare else f"{100 * chance[place]:.2g} %"
    return f"; noise alone shows as much in {share} of steady runs"


def _followed(fitted: FittedRuns) -> Iterator[Flag]:
    """Columns that the run does not use, and that its drift goes with: a temperature under another name.

    Not those that explain the residuals, which `_structure` names.
    """
    if not fitted.readings.others:
        return
    sizes = drifts(fitted.result)
    shown = fitted.shown(np.flatnonzero(suspected(fitted.result, fitted.chances))) if sizes else {}
    for column, values in fitted.readings.others.items():
        counter = np.all(np.diff(values) == 1, -1)
        follows = {
            name: (share > FOLLOWED) & ~counter & (sizes[name][0] > SHOWN_DRIFT * sizes[name][1])
            for name, share in drift_shares(fitted.result, values).items()
        }
        members = np.any([np.zeros(fitted.count, bool), *follows.values()], 0)
        known = COLUMN + column
        named = [place for place, each in shown.items() if known in each and is_shown(each, known)]
        members[named] = False
        yield _remark(MISFIT_BY_COLUMN, members, column=column)


def _structure(fitted: FittedRuns) -> Iterator[Flag]:
    """The likely cause of residuals that are more than noise."""
    looked_at = np.flatnonzero(suspected(fitted.result, fitted.chances))
    for place, shown in fitted.shown(looked_at).items():
        for name in filter(partial(is_shown, shown), shown):
            column = name.startswith(COLUMN)
            words = partial(_looks, fitted, name)
            finding = MISFIT_BY_COLUMN if column else f"looks-like-{name}"
            yield Flag(finding, np.arange(fitted.count) == place, "{looks}", {"looks": words})


def _looks(fitted: FittedRuns, name: str, place: int) -> str:
    """An effect that the residuals of one run show, in words."""
    [effect] = (each for each in fitted.effects(place) if each.name == name)
    looks = seen_as(effect, fitted.alone(place)[0])
    if name == "settings":
        member = fitted.member(place)
        angle, stations = farthest_setting(member.problem, member.state, effect)
        looks += f" Check the {angle} of stations {_from_to(fitted, place, stations)} first."
        exact = np.broadcast_to(fitted.readings.exact_angles[STAND_ANGLES_EXACT], fitted.count)
        looks += f" {STATE_STAND}".rstrip() if exact[place] else ""
    return looks


def _from_to(fitted: FittedRuns, place: int, stations: Ints) -> str:
    """The labels of the first and the last of some stations of one run."""
    labels = fitted.alone(place)[0].labels
    return f"{labels[stations[0]]} to {labels[stations[-1]]}"


def _scatter(fitted: FittedRuns) -> Flag:
    """The strengths that vary from station to station by more than the noise of the sensors."""
    scatter = fitted.result.problem.evidence.scatter
    sizes = {name: values.max(-1) for name, values in scatter.items()}
    large = np.max([np.zeros(fitted.count), *sizes.values()], 0) > SCATTER_SHARE

    def what(place: int) -> str:
        return ", ".join(
            SCATTERED[name].format(sd[place] * (100 if name in EARTH_RANGES else np.degrees(1)))
            for name, sd in sizes.items()
            if sd[place] > SCATTER_SHARE
        )

    return _remark("scatter", np.asarray(large), what=what)


def _repeated(fitted: FittedRuns) -> Flag:
    """Stations that were left out because their readings are those of another."""
    readings, count = fitted.readings, len(fitted.readings.copies)

    def stations(place: int) -> str:
        return listed([label for label, _ in fitted.alone(place)[0].copies], STATIONS_NAMED)

    members = np.full(fitted.count, count > 0)
    values = {"count": count, "of": count + readings.count}
    return _remark("repeated-readings", members, stations=stations, **values)


def _beyond_order(fitted: FittedRuns) -> Iterator[Flag]:
    """A variation with temperature that the order of a triad does not follow."""
    present = terms_beyond(fitted.result).present
    size = cache(lambda: misfit_size(fitted.result))
    for index, triad in enumerate(TRIADS[: present.shape[1]]):
        members = np.any(present[:, index], -1)
        words = {"triad": triad, "of": partial(_course, fitted, index, present[:, index], size)}
        yield Flag(f"{triad}-temperature-misfit", members, REMARKS["temperature-misfit"], words)


def _course(
    fitted: FittedRuns, index: int, present: Bools, size: Callable[[], Array], place: int
) -> dict[str, Any]:
    """Remarks on terms left out of a triad's course of temperature, of powers `present` (B, k) and a `size` (B, t)."""
    problem, state = fitted.result.problem, fitted.result.state
    order, observable = problem.triads[index].model.basis.order, ("gravity", "field")[index]
    scale, unit = shown_in(observable, fitted.readings.relative)
    share = float(size()[place, index])
    strength = float(np.mean(problem.constant(state, observable)[place]))
    powers = np.flatnonzero(present[place]) + 1
    cause = "readings differ from one temperature to the next as no course of order 3 does"
    remedy = (
        "Let the tool come to rest at each temperature, and return to one of them: that tells hysteresis or a "
        "reference that moved from a drift, which no fit includes beside this; more temperatures make the mean better"
    )
    if order < HIGHEST and powers.min() <= HIGHEST:
        cause = f"powers of temperature above order {order} are there"
        remedy = f"Use `order` auto, or `order` {min(int(powers.max()), HIGHEST)}"
        if fitted.options.method == "swarm":
            remedy = "Use another `method`: swarm has no temperature terms"
        elif aligned(fitted.result)[place, index]:
            remedy = "Repeat the same attitudes at other temperatures"
    figures = {"rms": share * strength * scale, "unit": unit, "angle": np.degrees(share)}
    return {"cause": cause, "remedy": remedy, **figures}


def _untested(fitted: FittedRuns) -> Flag:
    """Temperature terms that nothing tests."""
    bare = untested(fitted.result)
    order = np.where(bare, orders_of(fitted.result), 0).max(-1)
    last = "the uncertainty takes the next power to fall off as the last one did"
    unsaid = np.where(order == 1, "no uncertainty here includes a curvature", last)
    values = {"order": order, "levels": order + 1, "unsaid": unsaid}
    triads = partial(_joined, bare)
    return _remark("temperature-untested", np.any(bare, -1), triads=triads, **values)


def _aligned(fitted: FittedRuns) -> Flag:
    """Temperature terms that look like sensor errors at one temperature, because attitudes followed it."""
    hidden = aligned(fitted.result)
    power = np.where(hidden, orders_of(fitted.result), HIGHEST).min(-1) + 1
    triads = partial(_joined, hidden)
    return _remark("temperature-aligned", np.any(hidden, -1), triads=triads, power=power)


def _undetermined(fitted: FittedRuns) -> Iterator[Flag]:
    """Directions that nothing determines."""
    kinds = [tuple((entry.id, entry.triads) for entry in free) for free in fitted.free]
    for kind in dict.fromkeys(kinds):
        places = [place for place, each in enumerate(kinds) if each == kind]
        for name, triads in dict.fromkeys(kind):
            text = f"{' and '.join(TRIADS[triad] for triad in triads)}: {described(name)}."
            yield _common(fitted, name, text, places)


def _prior(fitted: FittedRuns) -> Iterator[Flag]:
    """Parameters that rest on the prior alone, and whether run and prior agree."""
    prior, constants = fitted.options.knowledge, fitted.result.problem.evidence.constants
    if prior is None:
        return
    lasting = [c for c in constants if not (c.unknown or c.name in WALK_AXES)]
    declared = {common_source(constant.name) for constant in lasting}
    both = ", ".join(name for name in prior.common if name in declared)
    every = np.ones(fitted.count, bool)
    yield _remark(
        "prior-aged", every & bool(prior.ageing), source=prior.source, ageing=prior.ageing
    )
    yield _remark("prior-shared", every & bool(both), source=prior.source, both=both)
    only = np.array([", ".join(names) for names in _prior_only(fitted)])
    yield _remark("prior-only", only != "", source=prior.source, names=only)
    square, tested = departures(fitted.result)
    unlikely = tail(square, np.maximum(tested, 1)) <= MISFIT_CHANCE
    ratio = np.sqrt(square / np.maximum(tested, 1))
    yield _remark("prior-conflict", unlikely, source=prior.source, ratio=ratio)


def _prior_only(fitted: FittedRuns) -> list[dict[str, None]]:
    """Parameters of each member that only the prior determines."""
    problem, state = fitted.result.problem, fitted.result.state
    bare = replace(problem, prior=Prior(0 * problem.prior.precision, problem.prior.expected))
    without = free_directions(bare, state, Determined.of(bare, state))
    return [
        dict.fromkeys(e.id.removeprefix("weak-") for e in each if e.id not in {f.id for f in free})
        for each, free in zip(without, fitted.free, strict=True)
    ]


def _model(fitted: FittedRuns) -> Iterator[Flag]:
    """Limits of the chosen model."""
    options = fitted.options
    ignored = [
        name
        for name, triad in zip(TRIADS, fitted.result.problem.triads, strict=False)
        if name not in options.curved
        and triad.model.kind == "factors"
        and getattr(fitted.profile, name).nonlinearity
    ]
    every = np.ones(fitted.count, bool)
    yield _remark("nonlinearity-ignored", every & bool(ignored), triads=" and ".join(ignored))
    used = "gravity" not in fitted.result.problem.evidence.absent
    yield _remark("gravity-unknown", ~fitted.readings.states("gravity") & used)
    yield _remark("field-unknown", every & fitted.readings.relative)
    lost = {6: "any misalignment", 9: "mounting rotation"}.get(options.parameters, "")
    yield _remark("restricted", every & bool(lost), parameters=options.parameters, lost=lost)


def _culprits(fitted: FittedRuns) -> Iterator[Flag]:
    """Stations to take again, and settings of the stand that are off by more than declared: the surest first."""
    result = fitted.result
    chance, seen = setting_chances(result)
    off, worst = chance < MISFIT_CHANCE / max(chance.shape[-1], 1), np.argsort(chance, -1)
    again = stations_to_reshoot(result)
    places = np.flatnonzero(off.any(-1) | again.any(-1))
    if not places.size:
        return
    some = result if places.size == fitted.count else take(result, places)
    of_stations, square = np.ones(again.shape), np.zeros(again.shape)
    of_stations[places], square[places] = chances(some), station_misfit(some.analysis)[0]
    of_stations[~again] = 1.0
    order = np.lexsort((-square, of_stations, ~again), -1)
    surer = chance.min(-1, initial=1.0) < of_stations.min(-1)
    each = np.arange(fitted.count)
    settings = [
        Flag(
            "settings",
            off[each, columns],
            "{of}",
            {"of": partial(_setting, fitted, columns, seen)},
        )
        for columns in worst.mT[: off.sum(-1).max(initial=0)]
    ]
    yield from (replace(flag, members=flag.members & surer) for flag in settings)
    for station in order.mT[: again.sum(-1).max()]:
        values = {"of": partial(_misfit, fitted, station)}
        yield Flag("reshoot", again[each, station], REMARKS["reshoot"], values, station)
    yield from (replace(flag, members=flag.members & ~surer) for flag in settings)


def _misfit(fitted: FittedRuns, stations: Ints, place: int) -> dict[str, Any]:
    """The misfit of a member's station, where it is worst, and why that may be."""
    row = fitted.stations(place)[stations[place]]
    worst = row.worst or "gravity"
    measurable = row.deviation < LARGEST_DEVIATION
    return {
        "station": row.station,
        "size": f"{row.deviation:.1f}" if measurable else f"more than {LARGEST_DEVIATION:.0f}",
        "worst": worst,
        "value": row.errors.get(worst, float("nan")),
        "alone": row.errors_left_out.get(worst, 0.0),
        "moves": row.influence.get(worst, 0.0),
        "unit": spaced(shown_in(worst, fitted.readings.relative)[1]),
        "reason": REASONS[worst],
    }


def _distrusted(fitted: FittedRuns) -> Flag:
    """Stations that a robust fit has nearly left out."""
    low = fitted.result.trust < LOW_WEIGHT

    def stations(place: int) -> str:
        labels, weight = fitted.alone(place)[0].labels, fitted.result.trust[place]
        each = [f"{labels[i]} ({weight[i]:.1g})" for i in np.flatnonzero(low[place])]
        return listed(each, STATIONS_NAMED)

    return _remark("distrusted", np.any(low, -1), stations=stations)
