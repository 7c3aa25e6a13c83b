"""How a run is to be fitted: the choices that a calibration is made with, all in one place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from mwdcal.calibration.prior import Knowledge

Orders = int | tuple[int, int]
"""Temperature order of both triads, or of accelerometer and magnetometer."""


@dataclass(frozen=True)
class Options:
    """Choices of a fit; the defaults are right for most runs.

    Attributes:
        method: "joint", "least-squares", "swarm", "newton", "toolface-inclination", "scalar".
        model: "polynomial" or "factors"; None: polynomial at order 0, factors above.
        order: temperature order 0…3 of both triads, or of each.
        parameters: per triad at one temperature: 12, 9 (sensor frame) or 6 (scale and bias).
        nonlinearity: triads with own-axis quadratic and cubic terms, and their prior as a share
            of the field; None: what the profile declares.
        scatter: estimate how far strengths, dip and the direction of a group depart from station to
            station, beside the noise; only where the noise of both triads is estimated.
        estimate: errors of the stand to find as well: "azimuth-zero", "inclination-zero", "tilt".
        ignore: what may not be used at any station, of "gravity", "field", "dip": each station then
            has its own.
        robust: None, "huber" or "student-t": weights that bound what a bad station can do.
        paper_weights: sum the squares as the method's paper does, unweighted.
        prior: what is known of the parameters beforehand.
        seed: of the swarm.
        rounds: most repetitions of fit and estimate of the noise.
    """

    method: str = "joint"
    model: str | None = None
    order: Orders = 0
    parameters: int = 12
    nonlinearity: Mapping[str, float] | None = None
    scatter: bool = False
    estimate: tuple[str, ...] = ()
    ignore: tuple[str, ...] = ()
    robust: str | None = None
    paper_weights: bool = False
    prior: Knowledge | None = None
    seed: int = 0
    rounds: int = 8

    @property
    def orders(self) -> tuple[int, int]:
        """Temperature order of accelerometer and magnetometer."""
        return (self.order, self.order) if isinstance(self.order, int) else self.order

    @property
    def own_solver(self) -> bool:
        """Whether the method minimises by its own means: no weights, priors or own-axis terms."""
        return self.paper_weights or self.method in ("newton", "swarm")

    def kind(self, order: int) -> str:
        """The model of a triad: at order 0 both are the same, and the linear one is simpler."""
        return self.model or ("factors" if order else "polynomial")
