"""How much readings speak for each fault: evidence over none, shares, and the chance of as much from a sound tool."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mwdcal.errors import InputError
from mwdcal.estimation.batch import put, take
from mwdcal.faults.dead import DeadChannels, dead_channels
from mwdcal.faults.likelihood import Explanation, Suspect, explained, ratios, repeated
from mwdcal.faults.physics import DEAD, FAULTS, NONE, SIZE, FaultForm
from mwdcal.geometry.vectors import Array, Ints

FALSE_ALARMS = 0.01
"""Probability that a fault is named where there is none."""
DEAD_SHARE = 0.05
"""Share of it that goes to dead channels, whose evidence has a bound and needs no simulation."""
DRAWS = 9_999
"""Simulated changes without a fault, by which the evidence is judged."""
WITHIN, SHARE_WITHIN = 50.0, 0.2
"""Log evidence, and share of the best one, by which the linearised evidence of a form may be behind to be refined."""
UNEXPLAINED = 1e-4
"""Probability of the misfit of the best explanation below which it explains too little."""
LIKELY = 0.05
"""A fault with a larger share of the likelihood than this is not excluded."""
DISTINCT = float(np.log(1 / LIKELY))
"""Logarithm of the evidence ratio that tells two faults apart."""


@dataclass(frozen=True)
class FaultEvidence:
    """What readings of one tool say of all faults; `forms` are the ways in which faults show.

    `none` explains the readings without a fault, `best` by each form that is not far behind and by the first of
    each kind, those at `likely`, as a batch; `dead` are dead channels. `by_form` (F,) is the log evidence of each
    form over none.
    """

    suspect: Suspect
    forms: list[FaultForm]
    none: Explanation
    by_form: Array
    likely: Ints
    best: Explanation
    dead: DeadChannels

    @classmethod
    def of(cls, suspect: Suspect, forms: list[FaultForm]) -> FaultEvidence:
        """Of a batch of one."""
        none = explained(suspect, np.zeros((1, SIZE, 0)), suspect.start())
        roughly = by_form(forms, none.information[0], none.gradient[0])
        if not np.isfinite(roughly).all():
            raise InputError(
                "faults cannot be weighed: values or uncertainties of the calibration and the readings are out of "
                "all proportion. Check units, noise and standard uncertainties of both."
            )
        near_best = roughly >= roughly.max() - WITHIN - SHARE_WITHIN * abs(roughly.max())
        likely = np.union1d(np.flatnonzero(near_best), _best_of_each(forms, roughly))
        near = take(none, 0 * likely)
        mixing = padded([forms[i] for i in likely])
        best = explained(repeated(suspect, 0 * likely), mixing, near.state, near)
        exactly = np.asarray(best.evidence - none.evidence)
        exactly = put(np.minimum(roughly, exactly.max() - WITHIN), likely, exactly)
        return cls(suspect, forms, none, exactly, likely, best, dead_channels(suspect))

    @property
    def information(self) -> Array:
        """Information (SIZE, SIZE) of all departures of a sound tool."""
        return np.asarray(self.none.information[0])

    def misfit(self, kind: str) -> float:
        """χ² of the readings as a fault, or none, explains them best."""
        if kind == DEAD:
            return float(self.dead.misfit[np.argmax(self.dead.evidence)])
        if kind == NONE:
            return float(self.none.misfit[0])
        return float(self.best.misfit[self._best(kind)])

    def _best(self, kind: str) -> int:
        """The place of the best form of a fault among those at `likely`."""
        where = [i for i in self.likely.tolist() if self.forms[i].kind == kind]
        return int(np.searchsorted(self.likely, max(where, key=lambda i: self.by_form[i])))

    def _whole(self, place: int) -> int:
        """The place of the fullest form of the same fault and channel as one among those at `likely`."""
        chosen = self.forms[self.likely[place]]
        same = (chosen.kind, chosen.channel, chosen.larger)
        forms = [self.forms[i] for i in self.likely]
        alike = [i for i, f in enumerate(forms) if (f.kind, f.channel, f.larger) == same]
        return max(alike, key=lambda i: len(forms[i].terms))

    def sizes(self, kind: str, whole: bool = False) -> tuple[FaultForm, Array, Array]:
        """The best form of a fault, its sizes (k,) and their covariance (k, k), in units of the usual ones.

        `whole`: with all sizes that such a fault may have, so that the uncertainty of each is not that of a simpler
        form, in which the others are exactly zero.
        """
        place = self._best(kind)
        place = self._whole(place) if whole else place
        form = self.forms[self.likely[place]]
        count = form.mixing.shape[1]
        covariance = self.best.covariance[place, :count, :count]
        return form, self.best.sizes[place, :count], covariance

    @cached_property
    def dead_ratios(self) -> Array:
        """Log evidence (C,) of each dead channel over none."""
        return np.asarray(self.dead.evidence - self.none.evidence)

    @cached_property
    def by_fault(self) -> dict[str, float]:
        """Log evidence of each fault over none: the mean over its forms; none for one that has no form here."""
        others = over_forms(self.forms, self.by_form) | {DEAD: log_mean(self.dead_ratios)}
        return {NONE: 0.0} | {name: float(others.get(name, -np.inf)) for name in FAULTS}

    def likelihoods(self) -> dict[str, float]:
        """Share of each fault, all being as likely beforehand."""
        values = np.array(list(self.by_fault.values()))
        shares = np.exp(values - values.max())
        return dict(zip(self.by_fault, (shares / shares.sum()).tolist(), strict=True))

    def probability(self, freedom: float, draws: int = DRAWS) -> float:
        """Bound on the chance of so much evidence for any fault, from a sound tool.

        Definition: a Monte Carlo test. Without a fault the gradient by all departures is Gaussian with their
        information as covariance, so that the evidence of all faults can be drawn together; it is inflated by
        Student's factor of `freedom` degrees of freedom behind the noise. An evidence ratio has the mean 1
        under none, so that for dead channels Markov's inequality bounds it.
        """
        observed = log_mean(_linear(self.forms, self.information, self.none.gradient[0]))
        rng = np.random.default_rng(0)
        values, vectors = np.linalg.eigh(self.information)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        sound = rng.normal(size=(draws, SIZE)) @ root.transpose()
        if np.isfinite(freedom):
            sound *= np.sqrt(freedom / rng.chisquare(freedom, draws))[:, None]
        beyond = log_mean(_linear(self.forms, self.information, sound)) >= observed
        by_chance = (1 + np.count_nonzero(beyond)) / (draws + 1)
        dead = np.exp(min(0.0, -self.by_fault[DEAD]))
        return float(min(1.0, by_chance / (1 - DEAD_SHARE), dead / DEAD_SHARE))


def _best_of_each(forms: list[FaultForm], evidence: Array) -> Ints:
    """The places of the best form of each kind of fault."""
    kinds = np.array([form.kind for form in forms])
    places = [np.flatnonzero(kinds == kind) for kind in dict.fromkeys(kinds.tolist())]
    return np.array([where[np.argmax(evidence[where])] for where in places], int)


def padded(forms: list[FaultForm]) -> Array:
    """Departures (F, SIZE, k) of each form, columns of zeros where it has fewer than k sizes."""
    whole = np.zeros((len(forms), SIZE, max(form.mixing.shape[1] for form in forms)))
    for place, form in enumerate(forms):
        whole[place, :, : form.mixing.shape[1]] = form.mixing
    return whole


def _linear(forms: list[FaultForm], information: Array, gradient: Array) -> Array:
    """Log evidence (..., faults) of faults over none, linearised at none, of gradients (..., SIZE)."""
    each = by_form(forms, information, gradient)
    return np.stack(list(over_forms(forms, each).values()), -1)


def by_form(forms: list[FaultForm], information: Array, gradient: Array) -> Array:
    """Log evidence (..., F) of each form over none, linearised at none, of gradients (..., SIZE)."""
    return np.stack([ratios(information, gradient, form.mixing) for form in forms], -1)


def over_forms(forms: list[FaultForm], each: Array) -> dict[str, Array]:
    """Log evidence (...) of each fault, of those (..., F) of its forms, each as likely beforehand."""
    kinds = dict.fromkeys(form.kind for form in forms)
    places = {kind: [i for i, form in enumerate(forms) if form.kind == kind] for kind in kinds}
    return {kind: log_mean(each[..., where]) for kind, where in places.items()}


def log_mean(values: Array) -> Array:
    """Logarithm (...,) of the mean of exp(values (..., k))."""
    most = values.max(-1, keepdims=True)
    most = np.where(np.isfinite(most), most, 0.0)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(np.mean(np.exp(values - most), -1)) + most[..., 0])
