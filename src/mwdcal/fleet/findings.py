"""What `calibrate` would say of each sound tool of a batch: ids of its findings, stations to re-shoot.

Where a rule costs more than a few operations on arrays, a bound that no finding can escape picks
the tools for which it is asked.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from mwdcal.calibration.automatic.courses import terms_beyond, untested
from mwdcal.calibration.diagnosis.findings import (
    Findings,
    calm,
    conflicting,
    copies,
    departures,
    distrusted,
    excessive,
    misfit_chances,
    scattered,
    unchecked,
    without_prior,
)
from mwdcal.calibration.diagnosis.structure import effects, suspected
from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.calibration.residuals import RESHOOT, tail, to_reshoot
from mwdcal.calibration.residuals import chances as station_chances
from mwdcal.estimation.rank import Free
from mwdcal.estimation.uncertainty import TESTED, station_misfit
from mwdcal.fleet.refusals import free_of_batch, member
from mwdcal.geometry.vectors import Bools, Ints
from mwdcal.sensor.profile import Profile

SMALL = 1e-9
"""What is added to variances (of whitened readings: 0…1), so that they have an inverse."""
LEEWAY = 1.01
"""A station is suspect already if a bound is as unlikely as this many times the limit."""


def findings_of_batch(
    readings: Readings, profile: Profile, options: Options, result: Fit, free: list[list[Free]]
) -> tuple[list[list[str]], list[list[int]]]:
    """Ids of the findings of each member, and the numbers of its stations to take again.

    `readings` are those of the batch, which know the same of all. Undetermined directions are not
    among the findings.
    """
    again = stations_to_reshoot(result)
    chances = misfit_chances(result)
    kinds = (("noise", calm(result)), ("residuals", excessive(result, chances)))
    flags = {
        f"{name}-{kind}": flag
        for kind, each in kinds
        for name, flag in zip(TRIADS, each.transpose(), strict=False)
    }
    flags["no-redundancy"] = np.any(unchecked(result), -1)
    found: list[list[str]] = [[] for _ in result.status]
    _add(found, flags)
    for place in np.flatnonzero(suspected(result, chances)).tolist():
        one = member(result, np.array([place]))
        found[place] += [f"looks-like-{effect.name}" for effect in effects(one)]
    _add(found, {"scatter": scattered(result), "repeated-readings": _repeated(result)})
    _add(found, _of_temperature(result))
    if options.prior is not None:
        _add(found, _of_prior(result, free))
    common = [f.id for f in Findings(readings, profile, options, result, []).model()]
    for own in found if common else []:
        own += common
    _add(found, {"reshoot": np.any(again, -1), "distrusted": np.any(distrusted(result), -1)})
    stations: list[list[int]] = [[] for _ in found]
    for index, station in np.argwhere(again).tolist():
        stations[index].append(station)
    return found, stations


def _add(found: list[list[str]], flags: dict[str, Bools]) -> None:
    """Add the names of what is flagged (B,) to each member's."""
    for name, flag in flags.items():
        for index in np.flatnonzero(flag):
            found[index].append(name)


def _of_temperature(result: Fit) -> dict[str, Bools]:
    """Members (B,) whose orders leave out what is there, and those whose courses nothing tests."""
    misfits = terms_beyond(result).misfit.transpose()
    found = {f"{n}-temperature-misfit": f for n, f in zip(TRIADS, misfits, strict=False)}
    return found | {"temperature-untested": np.any(untested(result), -1)}


def _of_prior(result: Fit, free: list[list[Free]]) -> dict[str, Bools]:
    """Members (B,) of which something rests on the prior alone, and those that depart from it."""
    bare = [{entry.id for entry in each} for each in free_of_batch(without_prior(result))]
    only = [bool(own - {f.id for f in each}) for own, each in zip(bare, free, strict=True)]
    return {"prior-only": np.array(only), "prior-conflict": conflicting(*departures(result))}


def stations_to_reshoot(result: Fit) -> Bools:
    """Stations (B, n) that `calibrate` marks."""
    found = np.zeros(result.analysis.residual.shape[:2], bool)
    some = np.flatnonzero(_suspects(result))
    if some.size:
        found[some] = to_reshoot(station_chances(member(result, some)))
    return found


def _suspects(result: Fit) -> Bools:
    """Members (B,) of which some station's misfit may be too large.

    With declared noise and no robust weights χ² itself must be. It is bounded from above by what
    the trace of the residuals' covariance says, whose eigenvalues are 0…1, then by its inverse.
    """
    analysis = result.analysis
    residual, spread = analysis.residual, analysis.spread
    size, chance = spread.shape[-1], RESHOOT / len(result.trust[0])
    found = np.any(~np.isnan(result.noise), -1) | np.any(result.trust != 1, -1)
    smallest = np.trace(spread, axis1=-2, axis2=-1) - (size - 1)
    good = np.sum(residual**2, -1) < likely(size, chance) * smallest
    good &= (smallest > TESTED) & (analysis.influence is None)
    tool, station = np.nonzero(~good & ~found[:, None])
    own = residual[tool, station]
    whole = spread[tool, station] + SMALL * np.eye(size)
    bound = np.sum(own * np.linalg.solve(whole, own[..., None])[..., 0], -1)
    large = bound > likely(1, chance)
    tool, station, own = tool[large], station[large], own[large]
    some = replace(analysis, residual=own[None], spread=spread[None, tool, station])
    found[tool[tail(*station_misfit(some))[0] < LEEWAY * chance]] = True
    return np.asarray(found)


@cache
def likely(freedom: int, chance: float) -> float:
    """A χ² that is exceeded with more than this chance, to 0.1."""
    steps = 0.1 * np.arange(2001.0)
    return float(steps[np.sum(tail(steps, np.full(len(steps), freedom)) > LEEWAY * chance) - 1])


def _repeated(result: Fit) -> Bools:
    """Members (B,) of which a station has the readings of another."""
    problem = result.problem
    columns = [t.raw[..., axis] for t in problem.triads for axis in range(3)]
    columns.append(np.broadcast_to(problem.temperature, columns[0].shape))
    key = np.sort(sum(np.sqrt(2.0 + i) * column for i, column in enumerate(columns)), -1)
    some: Ints = np.flatnonzero(np.any(np.diff(key, axis=-1) == 0, -1))
    found = np.zeros(len(key), bool)
    for index in some:
        found[index] = copies(np.stack([c[index] for c in columns], -1)).size > 0
    return found
