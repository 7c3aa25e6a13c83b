"""Errors of the stand as extra unknowns: their names, and whether they can be told apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.methods import ESTIMABLE
from mwdcal.errors import FitError, InputError
from mwdcal.estimation.batch import take
from mwdcal.estimation.evidence import STAND_ERRORS, UNKNOWN
from mwdcal.estimation.solvers import Determined
from mwdcal.geometry.vectors import Bools, diagonal

LOOSE = 0.1
"""A turn known no better than this share of no knowledge at all is not separated."""


def check_names(names: Sequence[str], method: str) -> None:
    """Refuse errors of the stand that cannot be estimated, whatever the stations."""
    for name in names:
        if name == "toolface-zero":
            raise FitError(
                "`estimate` toolface-zero: a zero of the stand's toolface can never be told from a "
                "rotation of the sensors in the tool, whatever the stations. Set it by an index mark."
            )
        if name not in ESTIMABLE:
            raise InputError(
                f"`estimate` must be of {', '.join(ESTIMABLE)}; got {name!r}. Unknown field and dip "
                "are estimated without being asked for."
            )
    if names and method != "joint":
        raise InputError(f"`estimate` needs `method` joint; got {method!r}.")


def inseparable(result: Fit) -> Bools:
    """Fits (B,) whose stand errors the stations cannot tell from the sensors' own errors.

    One of these is as good as unknown, or the rank is higher without them.
    """
    constants = result.problem.evidence.constants
    stand = np.array([c.unknown and c.name in STAND_ERRORS for c in constants])
    sd = np.sqrt(diagonal(result.analysis.constants)[:, stand])
    lost = np.any(sd > LOOSE * UNKNOWN, -1)
    some = np.flatnonzero(~lost & ~result.analysis.determined.keep.all(-1))
    if some.size:
        problem, state = take((result.problem, result.state), some)
        kept = np.flatnonzero(~stand)
        fewer = tuple(problem.evidence.constants[index] for index in kept)
        bare = replace(problem, evidence=replace(problem.evidence, constants=fewer))
        still = replace(state, constants=state.constants[:, kept])
        lost[some] = Determined.of(problem, state).rank < Determined.of(bare, still).rank
    return np.asarray(lost)
