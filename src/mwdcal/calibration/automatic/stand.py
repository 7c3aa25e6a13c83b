"""Errors of the stand as extra unknowns: their names, and whether they can be told apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mwdcal.calibration.estimate import Fit
from mwdcal.calibration.methods import ESTIMABLE
from mwdcal.errors import FitError, InputError
from mwdcal.estimation.evidence import STAND_ERRORS, UNKNOWN
from mwdcal.estimation.solvers import Determined

LOOSE = 0.1
"""A turn known no better than this share of no knowledge at all is not separated."""


def check_names(names: Sequence[str], method: str) -> None:
    """Refuse what `--estimate` cannot find, whatever the stations."""
    for name in names:
        if name == "toolface-zero":
            raise FitError(
                "--estimate toolface-zero: a zero of the stand's toolface can never be told from a "
                "rotation of the sensors in the tool, whatever the stations. Set it by an index mark."
            )
        if name not in ESTIMABLE:
            raise InputError(
                f"--estimate must be of {', '.join(ESTIMABLE)}; got {name!r}. Unknown field and dip "
                "are estimated without being asked for."
            )
    if names and method != "joint":
        raise InputError(f"--estimate needs --method joint; got {method!r}.")


def check_separable(result: Fit, names: Sequence[str]) -> None:
    """Refuse stand errors that these stations cannot tell from the sensors' own errors."""
    problem, state = result.problem, result.state
    evidence = problem.evidence
    asked = [c.unknown and c.name in STAND_ERRORS for c in evidence.constants]
    keep = [i for i, stand in enumerate(asked) if not stand]
    fewer = replace(evidence, constants=tuple(evidence.constants[i] for i in keep))
    bare = replace(problem, evidence=fewer)
    still = replace(state, constants=state.constants[:, keep])
    ranks = [int(Determined.of(p, s).rank[0]) for p, s in ((problem, state), (bare, still))]
    sd = np.sqrt(np.diag(result.analysis.constants[0]))
    loose = [
        c.name
        for c, s, stand in zip(evidence.constants, sd, asked, strict=True)
        if stand and s > LOOSE * UNKNOWN
    ]
    if loose or ranks[0] < ranks[1]:
        raise FitError(
            f"--estimate {','.join(names)}: these stations cannot tell it from the sensors' own "
            "errors. Add stations at other azimuths and inclinations with references, or leave it out."
        )
