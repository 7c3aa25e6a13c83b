"""What the reader of a calibration should know, in plain words, each with its remedy."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from mwdcal.calibration.automatic.courses import OmittedTerms, misfit_size, terms_beyond, untested
from mwdcal.calibration.diagnosis.flags import FittedRuns, Flag
from mwdcal.calibration.diagnosis.plausibility import (
    NOISE_RATIO,
    copies,
    departures,
    robust,
    stations_to_reshoot,
    unchecked,
)
from mwdcal.calibration.diagnosis.structure import described as seen_as
from mwdcal.calibration.diagnosis.structure import effects, suspected
from mwdcal.calibration.readings import EARTH_RANGES, TRIADS
from mwdcal.calibration.record import Finding
from mwdcal.calibration.residuals import REASONS, shown_in, tail
from mwdcal.calibration.results import common_source
from mwdcal.calibration.soaks import HIGHEST
from mwdcal.estimation.problem import Prior
from mwdcal.estimation.rank import free_directions
from mwdcal.estimation.solvers import Determined
from mwdcal.geometry.vectors import Bools

CALM_FREEDOM = 12.0
"""Degrees of freedom from which residuals far below the declared noise are not a coincidence."""
MISFIT_CHANCE = 1e-3
"""Chance of so large residuals, or of so large a departure from the prior, below which it is reported."""
LOW_WEIGHT = 0.1
"""A station of less weight than this in a robust fit is reported."""
SCATTER_SHARE = 3e-4
"""A scatter from station to station beyond this share, or radians, is a finding."""
LARGEST_DEVIATION = 37.0
"""Larger deviations have no figure: a normal variable's chance is then below 1e-300."""
UNUSED = "unused-columns"
COLUMNS_NAMED = 20
"""Most columns that the finding names."""
STATIONS_NAMED = 8
"""Most stations that a finding names."""

FREE_DIRECTIONS = {
    "toolface-zero": "toolface zero is undetermined: no evidence fixes rotation about the tool axis; kept at nominal. "
    "Give ref_toolface_deg at some stations to determine it",
    "rotation-x": "rotation about the tool's x axis is undetermined: no evidence fixes it; kept at nominal. Give "
    "reference inclinations, or roll sets at three or more directions",
    "rotation-y": "rotation about the tool's y axis is undetermined: no evidence fixes it; kept at nominal. Give "
    "reference inclinations, or roll sets at three or more directions",
    "scale": "overall scale is undetermined: no evidence fixes it; kept at nominal. Give a reference strength",
}

SCATTERED = {
    "gravity": "the strength of g",
    "field": "the strength of b",
    "dip": "the dip",
    "direction": "the direction within groups",
}


def described(name: str) -> str:
    """What a free direction means, and what would determine it."""
    steady, _, power = name.partition("-temperature-")
    course = f" (its variation with temperature, power {power})" if power else ""
    return FREE_DIRECTIONS.get(steady, steady) + course


def unused_columns(columns: Sequence[str]) -> list[Finding]:
    """Columns of a file that are not used, each with what it resembles."""
    if not columns:
        return []
    return [Finding(id=UNUSED, text=f"columns not used: {_listed(columns, COLUMNS_NAMED)}.")]


def findings(fitted: FittedRuns) -> list[Finding]:
    """All findings of a single run, a batch of one, in order of weight."""
    labels = fitted.alone(0)[0].labels
    return [
        Finding(
            id=flag.id,
            text=flag.sentence(0),
            station=None if flag.station is None else labels[flag.station],
        )
        for flag in finding_flags(fitted)
        if flag.members[0]
    ]


def finding_flags(fitted: FittedRuns) -> Iterator[Flag]:
    """All findings of a batch, in order of weight: some ids come more than once."""
    triads = range(len(fitted.result.problem.triads))
    yield from (_calm(fitted, triad) for triad in triads)
    yield from (_excessive(fitted, triad) for triad in triads)
    yield _no_redundancy(fitted)
    yield from _structure(fitted)
    yield _scatter(fitted)
    yield _repeated(fitted)
    terms = terms_beyond(fitted.result)
    yield from (_beyond_order(fitted, triad, terms) for triad in triads)
    yield _untested(fitted)
    yield from _undetermined(fitted)
    yield from _prior(fitted)
    yield from _model(fitted)
    for unused in unused_columns(fitted.readings.unused):
        yield _common(fitted, unused.id, unused.text)
    yield from _reshoot(fitted)
    yield _distrusted(fitted)


def _common(fitted: FittedRuns, name: str, text: str, places: Sequence[int] | None = None) -> Flag:
    """One sentence for all members, or for those at some places."""
    index = np.arange(fitted.count)
    members = np.ones(fitted.count, bool) if places is None else np.isin(index, places)
    return Flag(name, members, lambda _: text)


def _joined(triads: Bools) -> str:
    """The names of the flagged triads (t,).

    >>> _joined(np.array([True, True]))
    'accelerometer and magnetometer'
    """
    return " and ".join(TRIADS[index] for index in np.flatnonzero(triads))


def _listed(names: Sequence[str], most: int = STATIONS_NAMED) -> str:
    """The first few names, and how many more."""
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")


def _calm(fitted: FittedRuns, index: int) -> Flag:
    """Residuals far below the declared noise."""
    analysis = fitted.result.analysis
    tested = np.isnan(fitted.result.noise) & (analysis.freedom >= CALM_FREEDOM)
    calm = tested & (analysis.variance_factor < NOISE_RATIO**-2)

    def sentence(place: int) -> str:
        share = float(analysis.variance_factor[place, index]) ** 0.5
        return (
            f"{TRIADS[index]}: residuals are only {share:.2f} of the declared noise: the noise of "
            "the profile, or the columns sd_, are too large, and weigh the stations wrongly if "
            "not all by as much. Uncertainties are scaled down accordingly."
        )

    return Flag(f"{TRIADS[index]}-noise", calm[:, index], sentence)


def _excessive(fitted: FittedRuns, index: int) -> Flag:
    """Residuals far beyond the declared noise."""
    result, factor = fitted.result, fitted.result.analysis.variance_factor
    weighed = robust(result)[:, None] & np.isnan(result.noise) & ~unchecked(result)
    large = weighed & (factor > NOISE_RATIO**2)
    large |= np.nan_to_num(fitted.chances, nan=1.0) < MISFIT_CHANCE

    def sentence(place: int) -> str:
        excess = float(factor[place, index])
        chance = fitted.chances[place, index]
        rare = "" if np.isnan(chance) else f" (chance in noise {chance:.0e})"
        return (
            f"{TRIADS[index]}: residuals are {excess**0.5:.2f} times the declared noise{rare}: "
            "the noise figure, a reference, or the model is wrong. Uncertainties are "
            "scaled up accordingly."
        )

    return Flag(f"{TRIADS[index]}-residuals", large[:, index], sentence)


def _no_redundancy(fitted: FittedRuns) -> Flag:
    """Triads that nothing checks."""
    bare = unchecked(fitted.result)
    text = "no redundancy, so nothing in this run checks the fit. Add stations."
    return Flag("no-redundancy", np.any(bare, -1), lambda place: f"{_joined(bare[place])}: {text}")


def _structure(fitted: FittedRuns) -> Iterator[Flag]:
    """What the residuals look like, where they are more than noise."""
    unit = shown_in("field", fitted.readings.relative)[1]
    for place in np.flatnonzero(suspected(fitted.result, fitted.chances)).tolist():
        for effect in effects(fitted.member(place)):
            yield _common(fitted, f"looks-like-{effect.name}", seen_as(effect, unit), [place])


def _scatter(fitted: FittedRuns) -> Flag:
    """What varies from station to station by more than the noise of the sensors."""
    scatter = fitted.result.problem.evidence.scatter
    sizes = {name: values.max(-1) for name, values in scatter.items()}
    large = np.max([np.zeros(fitted.count), *sizes.values()], 0) > SCATTER_SHARE

    def sentence(place: int) -> str:
        words = [
            f"{SCATTERED[name]} by "
            + (f"{100 * size:.2f} %" if name in EARTH_RANGES else f"{np.degrees(size):.2f}°")
            for name, size in ((n, float(sd[place])) for n, sd in sizes.items())
            if size > SCATTER_SHARE
        ]
        return (
            f"beyond sensor noise, these vary from station to station: {', '.join(words)} "
            "(1σ, estimated; weights and uncertainties include it). Look for iron near the stand and "
            "play in the tool holder; or the model lacks something."
        )

    return Flag("scatter", np.asarray(large), sentence)


def _repeated(fitted: FittedRuns) -> Flag:
    """Stations whose readings are identical to another's."""
    repeated = copies(fitted.result)

    def sentence(place: int) -> str:
        labels = fitted.alone(place)[0].labels
        names = [labels[index] for index in np.flatnonzero(repeated[place])]
        return (
            f"station {_listed(names)}: readings identical to those of an earlier station. Copies count as "
            "measurements of their own, and uncertainties come out too small. Remove them."
        )

    return Flag("repeated-readings", np.any(repeated, -1), sentence)


def _beyond_order(fitted: FittedRuns, index: int, terms: OmittedTerms) -> Flag:
    """A variation with temperature that the order of a triad does not follow."""
    problem, state = fitted.result.problem, fitted.result.state
    order, observable = problem.triads[index].model.basis.order, ("gravity", "field")[index]
    scale, unit = shown_in(observable, fitted.readings.relative)

    def sentence(place: int) -> str:
        highest = np.flatnonzero(terms.present[place, index]) + 1
        share = float(misfit_size(fitted.result)[place, index])
        strength = float(np.mean(problem.constant(state, observable)[place]))
        if order < HIGHEST and highest.min() <= HIGHEST:
            cause = f"powers of temperature above order {order} are there"
            remedy = f"Use `order` auto, or `order` {min(int(highest.max()), HIGHEST)}"
            if fitted.options.method == "swarm":
                remedy = "Use another `method`: swarm has no temperature terms"
        else:
            cause = "readings differ from one temperature to the next as no course of order 3 does"
            remedy = (
                "Let the tool come to rest at each temperature and look for hysteresis or a reference "
                "that moved; more temperatures make the mean better"
            )
        return (
            f"{TRIADS[index]}: {cause}, beyond what noise explains: {share * strength * scale:.2g} {unit} "
            f"rms per axis over the range ({np.degrees(share):.2g}° across the field). The "
            f"uncertainties here include it. {remedy}."
        )

    return Flag(
        f"{TRIADS[index]}-temperature-misfit", np.any(terms.present[:, index], -1), sentence
    )


def _untested(fitted: FittedRuns) -> Flag:
    """Temperature terms that nothing tests."""
    bare = untested(fitted.result)
    orders = np.array([t.model.basis.order for t in fitted.result.problem.triads])

    def sentence(place: int) -> str:
        order = int(orders[bare[place]].max())
        unsaid = (
            "no uncertainty here includes a curvature"
            if order == 1
            else "the uncertainty takes the next power to fall off as the last one did"
        )
        return (
            f"{_joined(bare[place])}: {order + 1} temperatures are as many as a course of order {order} takes, so "
            f"nothing tests it between them, and {unsaid}. Add a temperature between them."
        )

    return Flag("temperature-untested", np.any(bare, -1), sentence)


def _undetermined(fitted: FittedRuns) -> Iterator[Flag]:
    """Directions that nothing determines."""
    places: dict[tuple[str, tuple[int, ...]], list[int]] = {}
    for place, free in enumerate(fitted.free):
        for entry in free:
            places.setdefault((entry.id, entry.triads), []).append(place)
    for (name, triads), some in places.items():
        text = f"{' and '.join(TRIADS[triad] for triad in triads)}: {described(name)}."
        yield _common(fitted, name, text, some)


def _prior(fitted: FittedRuns) -> Iterator[Flag]:
    """Parameters that rest on the prior alone, and whether run and prior agree."""
    prior, constants = fitted.options.knowledge, fitted.result.problem.evidence.constants
    if prior is None:
        return
    declared = {common_source(c.name) for c in constants if not c.unknown}
    both = [name for name in prior.common if name in declared]
    if both:
        text = (
            f"the prior ({prior.source}) and this run both have {', '.join(both)} in their uncertainty, and "
            "count as independent there. On the same stand it is one error: what rests on it is then "
            "stated up to 1.4 times too small."
        )
        yield _common(fitted, "prior-shared", text)
    yield _prior_only(fitted, prior.source)
    yield _prior_conflict(fitted, prior.source)


def _prior_only(fitted: FittedRuns, source: str) -> Flag:
    """Parameters that only the prior determines."""
    problem, state = fitted.result.problem, fitted.result.state
    bare = replace(problem, prior=Prior(0 * problem.prior.precision, problem.prior.expected))
    named = free_directions(bare, state, Determined.of(bare, state))
    ids = [{entry.id for entry in free} for free in fitted.free]
    only = [[e.id for e in each if e.id not in free] for each, free in zip(named, ids, strict=True)]

    def sentence(place: int) -> str:
        names = dict.fromkeys(name.removeprefix("weak-") for name in only[place])
        return (
            f"this run does not determine {', '.join(names)}: there values and uncertainties "
            f"rest on the prior ({source})."
        )

    return Flag("prior-only", np.array([*map(bool, only)]), sentence)


def _prior_conflict(fitted: FittedRuns, source: str) -> Flag:
    """A departure from the prior that is unlikely."""
    square, tested = departures(fitted.result)
    unlikely = tail(square, np.maximum(tested, 1)) <= MISFIT_CHANCE

    def sentence(place: int) -> str:
        ratio = np.sqrt(square[place] / tested[place])
        return (
            f"the run departs from the prior ({source}) by {ratio:.1f} times what both allow: the tool has "
            "changed, or the prior is too narrow. Leave `prior` out, or widen it."
        )

    return Flag("prior-conflict", unlikely, sentence)


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
    if ignored:
        text = (
            f"nonlinearity of the {' and '.join(ignored)} is not fitted: the model of factors "
            "has no such terms. Use `model` polynomial for it."
        )
        yield _common(fitted, "nonlinearity-ignored", text)
    if fitted.readings.relative:
        text = (
            "field strength is known at no station: the magnetometer is calibrated to field = 1. "
        )
        yield _common(fitted, "field-unknown", text + "Give ref_field_nt to have nT.")
    if options.parameters < 12:
        lost = "any misalignment" if options.parameters == 6 else "mounting rotation"
        text = (
            f"{options.parameters} parameters: {lost} of the sensors in the tool is taken as "
            "none, and no uncertainty here includes it. Use `parameters` 12 to fit it."
        )
        yield _common(fitted, "restricted", text)


def _reshoot(fitted: FittedRuns) -> Iterator[Flag]:
    """Stations to take again, with the reason."""
    again = stations_to_reshoot(fitted.result)

    def sentence(place: int, station: int) -> str:
        row = fitted.residuals(place).stations[station]
        worst = row.worst or "gravity"
        _, unit = shown_in(worst, fitted.readings.relative)
        gap = "" if unit == "°" else " "
        value = row.errors.get(worst, float("nan"))
        size = (
            f"{row.deviation:.1f}"
            if row.deviation < LARGEST_DEVIATION
            else f"more than {LARGEST_DEVIATION:.0f}"
        )
        alone, moves = (d.get(worst, 0.0) for d in (row.errors_left_out, row.influence))
        return (
            f"station {row.station}: residual {size}σ, most in {worst} "
            f"({value:+.3g}{gap}{unit}; {alone:+.3g}{gap}{unit} if left out of the fit, which it moves "
            f"by up to {moves:.2g}{gap}{unit}): {REASONS[worst]} Re-shoot it, or `exclude` {row.station}"
        )

    for station in np.flatnonzero(again.any(0)).tolist():
        yield Flag("reshoot", again[:, station], partial(sentence, station=station), station)


def _distrusted(fitted: FittedRuns) -> Flag:
    """Stations that a robust fit has nearly left out."""
    low = fitted.result.trust < LOW_WEIGHT

    def sentence(place: int) -> str:
        labels, weight = fitted.alone(place)[0].labels, fitted.result.trust[place]
        each = [f"{labels[i]} ({weight[i]:.1g})" for i in np.flatnonzero(low[place])]
        return (
            f"robust fit: low weight for station {_listed(each)}. Look at what they have in common."
        )

    return Flag("distrusted", np.any(low, -1), sentence)
