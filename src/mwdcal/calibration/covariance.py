"""The covariance that a calibration states, and what each source of error adds to it.

What the readings' noise and the settings of the stand do is independent from station to station
and scales with s². Errors that all stations have in common (zeros and tilt of the stand, the
references for gravity, field and dip) and a prior are as large as they were declared: no residual
says how large they are. What the order of the temperature terms leaves out is added to both.
"""

from __future__ import annotations

import numpy as np

from mwdcal.calibration.automatic.courses import misfit_covariance
from mwdcal.calibration.estimate import Fit
from mwdcal.geometry.vectors import Array

NOISE, SETTINGS, PRIOR = "noise of the readings", "settings of the stand", "prior"
ORDER = "order of the temperature terms"


def variance_scales(result: Fit) -> Array:
    """What scales each triad's variances (B, t): s², or 1 where there is no redundancy."""
    usable = result.analysis.freedom >= 1
    return np.where(usable, np.nan_to_num(result.analysis.variance_factor, nan=1.0), 1.0)


def stated_covariance(result: Fit) -> Array:
    """Covariance (B, p, p) of the fit's parameters: independent errors times s², others as they are."""
    apart = _common(result)
    return _scaled(result, result.analysis.covariance - apart) + apart + misfit_covariance(result)


def constants_covariance(result: Fit) -> Array:
    """Covariance (B, q, q) of the constants of the run, times s².

    The error of a reference is never more uncertain than it was declared.
    """
    analysis, constants = result.analysis, result.problem.evidence.constants
    scaled = analysis.constants * variance_scales(result).max(-1)[:, None, None]
    most = [np.full(len(scaled), np.inf) if c.unknown else c.sd for c in constants]
    if not most:
        return np.asarray(scaled)
    sd = np.sqrt(np.maximum(np.diagonal(scaled, axis1=-2, axis2=-1), 1e-300))
    less = np.minimum(np.stack(most, -1) / sd, 1.0)
    return np.asarray(scaled * less[:, :, None] * less[:, None, :])


def error_name(constant: str) -> str:
    """What a common error is called: of a reference, or of the stand.

    >>> [error_name(name) for name in ("dip", "azimuth-zero", "stand-north")]
    ['dip reference error', 'azimuth zero of the stand', 'tilt of the stand about north']
    """
    if constant.endswith("-zero"):
        return f"{constant.replace('-', ' ')} of the stand"
    if constant.startswith("stand-"):
        return f"tilt of the stand about {constant.removeprefix('stand-')}"
    return f"{constant} reference error"


def common_source(constant: str) -> str:
    """What a budget calls the source of a common error: a tilt is one source.

    >>> [common_source(name) for name in ("stand-north", "azimuth-zero", "gravity")]
    ['tilt of the stand', 'azimuth zero of the stand', 'gravity reference error']
    """
    return "tilt of the stand" if constant.startswith("stand-") else error_name(constant)


def assumed_exact(result: Fit) -> list[str]:
    """References taken as exact whose error moves no residual: it goes into the calibration whole.

    A toolface zero turns both triads, and a strength scales one, as sensors of other mounting or
    scale would have it.
    """
    evidence, names = result.problem.evidence, ("toolface", "gravity", "field")
    declared = [c.name.removesuffix("-zero") for c in evidence.constants]
    found = [
        n
        for n in names[: 1 + len(result.problem.triads)]
        if evidence.is_known(n).any() and n not in declared and n not in evidence.absent
    ]
    return ["toolface zero of the stand" if n == "toolface" else f"{n} reference" for n in found]


def shares(result: Fit) -> dict[str, Array]:
    """Covariance (B, p, p) by source; all together they are `stated_covariance`.

    A common error comes under the name of its constant of the run.
    """
    analysis, found = result.analysis, {}
    independent = _scaled(result, analysis.covariance - _common(result))
    settings = _scaled(result, _of_settings(result))
    found[NOISE] = independent - settings
    if settings.any():
        found[SETTINGS] = settings
    for index, constant in enumerate(result.problem.evidence.constants):
        effect = analysis.effects[..., index]
        if effect.any():
            outer = effect[:, :, None] * effect[:, None, :]
            found[constant.name] = found.get(constant.name, 0.0) + outer
    order = misfit_covariance(result)
    if order.any():
        found[ORDER] = order
    if result.problem.prior.precision.any():
        found[PRIOR] = _of_prior(result)
    return found


def _scaled(result: Fit, covariance: Array) -> Array:
    sizes = [t.model.size for t in result.problem.triads]
    grown = np.repeat(np.sqrt(variance_scales(result)), sizes, axis=-1)
    return np.asarray(covariance * grown[:, :, None] * grown[:, None, :])


def _common(result: Fit) -> Array:
    """Covariance (B, p, p) from errors that all stations share, and from a prior."""
    effects = result.analysis.effects
    return effects @ np.swapaxes(effects, -1, -2) + _of_prior(result)


def _of_prior(result: Fit) -> Array:
    """V Λ V: what errors of a prior of precision Λ do to a fit of covariance V."""
    precision, covariance = result.problem.prior.precision, result.analysis.covariance
    return covariance @ precision @ covariance if precision.any() else np.zeros_like(covariance)


def _of_settings(result: Fit) -> Array:
    """Covariance (B, p, p) from independent errors of the stand's angles, before scaling.

    A station's reading has the covariance C = I + GGᵀ in units of its noise, the columns of G being
    what its own unknowns do; those of known angles are meant here.
    """
    analysis, problem = result.analysis, result.problem
    if not any(problem.evidence.sd[n].any() for n in ("inclination", "azimuth", "toolface")):
        return np.zeros_like(analysis.covariance)
    linear = problem.linear(result.state)
    if analysis.influence is None:
        rows = np.swapaxes(linear.weigh(linear.design), -1, -2)
        p = linear.size
        moved = analysis.covariance[:, None] @ _reduced(rows, linear.normal.information, p)
    else:
        moved = analysis.influence[:, :, : linear.size]
    own = moved @ linear.own
    return np.asarray(np.einsum("bnia,bnja->bij", own, own, optimize=True))


def _reduced(rows: Array, information: Array, p: int) -> Array:
    """Rows (B, n, u, m) of XᵀC⁻¹ with the unknowns behind the first p eliminated: (B, n, p, m)."""
    if rows.shape[2] == p:
        return rows
    cross = np.linalg.solve(information[:, p:, p:], information[:, p:, :p])
    return np.asarray(rows[:, :, :p] - np.swapaxes(cross, -1, -2)[:, None] @ rows[:, :, p:])
