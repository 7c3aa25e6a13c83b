"""How a run is to be calibrated: all options in one place, `auto` among their values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypedDict, cast

import numpy as np

from mwdcal.calibration.fit_options import FIT_OPTIONS, FitArguments, Prior, names, order_of
from mwdcal.calibration.prior import DATASHEET, PriorInformation
from mwdcal.calibration.readings import HIGHEST, ONE_SETTING, TRIADS, Readings, direction_numbers
from mwdcal.calibration.record import Calibration
from mwdcal.errors import InputError
from mwdcal.geometry.vectors import Array, Ints, centred

# --------------------------------------------------------------------------
# Settings of the stand: which stations share one, because the operator set the direction once and rolled the tool.
#
# The stand's error of inclination and azimuth is then common to these stations: it does not average
# down over the turn, and small scatter within the set is no evidence that it is small.

DIRECTION = ("inclination", "azimuth")
"""The angles that one setting of the stand gives to several stations."""
ASSUMED = (
    "Assumed: direction set once per roll set; state [stand] settings in the profile, as "
    '"per-direction" or "per-station".'
)
"""The assumption where nobody states the practice of the stand…"""
ASSUMED_PRACTICE = "assumed"
"""…and what a calibration says of it."""
ALMOST_ONE = 10 * ONE_SETTING
"""References closer than this to those of the station before may be meant as one direction, radians."""
FEW_APART = 2
"""As many of these occur by chance."""
UNSHARED = (
    "{count} stations count as settings of their own, although the profile says that the direction is set once: their "
    "references differ from those of the station before by less than 0.5°, but by more than an encoder shows one "
    'setting differently (0.05°). Give one reference for each direction, or state settings = "per-station".'
)


def settings_of(readings: Readings) -> Ints:
    """Number (..., n) of the setting of the stand that each station belongs to.

    Definition: stations that follow each other with one reference direction (`direction_numbers`) share a
    setting, unless the profile says that the stand is set at every station; so do stations of a
    group with one direction, wherever they are in the run. Returning to a direction later is a
    new setting. Stations without either angle have a setting of their own.
    """
    group = np.broadcast_to(readings.groups, readings.accelerometer.shape[:-1])
    return numbered(group, [readings.reference(name) for name in DIRECTION], readings.settings)


def numbered(group: Ints, angles: Sequence[Array], practice: str) -> Ints:
    """`settings_of` stations of groups (..., n) and reference inclination and azimuth (..., n), by a practice."""
    direction, given = direction_numbers(*angles), ~np.all(np.isnan(angles), 0)
    after, before, side = (..., slice(1, None)), (..., slice(None, -1)), (..., slice(None), None)
    shared = (
        (direction[after] == direction[before]) & given[after] & (group[after] == group[before])
    )
    if practice == "per-station":
        shared &= group[after] >= 0
    first = np.ones((*shared.shape[:-1], 1), bool)
    number = np.cumsum(np.concatenate([first, ~shared], -1), -1) - 1
    if (group < 0).all():
        return np.asarray(number)
    other = (..., None, slice(None))
    equal = (direction[side] == direction[other]) & (group[side] == group[other])
    earliest = np.argmax(equal, -1)
    return np.where((group >= 0) & given, np.take_along_axis(number, earliest, -1), number)


def unshared(readings: Readings) -> Ints:
    """Count (...) of stations almost in the direction before that share no setting with it."""
    lean, turn = readings.reference("inclination"), readings.reference("azimuth")
    steps = np.abs(centred(np.diff(lean))), np.abs(centred(np.diff(turn)))
    almost = np.fmax(*steps) < ALMOST_ONE
    count = np.sum(almost & (np.diff(settings_of(readings)) != 0), -1)
    return np.asarray(count * (count > FEW_APART))


def is_assumed(readings: Readings) -> bool:
    """Whether stations of uncertain directions are taken as one setting though neither profile nor run says so."""
    number, group = (
        settings_of(readings),
        np.broadcast_to(readings.groups, readings.accelerometer.shape[:-1]),
    )
    together = (np.diff(number, axis=-1) == 0) & (group[..., 1:] < 0)
    uncertain = any(readings.uncertainty(name).any() for name in DIRECTION)
    return not readings.settings and uncertain and bool(together.any())


MODELS = FIT_OPTIONS["model"].words
AUTO: Literal["auto"] = "auto"
"""The value of an option that the software chooses (`mwdcal.calibration.automatic.auto`)."""
USUAL = 0.005
"""Prior of own-axis terms, as a share of the field, where the profile declares none."""
Orders = int | tuple[int, int]
"""Temperature order of both triads, or of accelerometer and magnetometer."""


class CommonChoices(TypedDict, total=False):
    """Attributes of `Options` that mean the same for one tool and for a fleet."""

    method: str
    model: str | None
    order: Orders | Literal["auto"]
    parameters: int
    nonlinearity: Mapping[str, float] | tuple[str, ...] | Literal["auto"]
    estimate: tuple[str, ...]
    ignore: tuple[str, ...]
    robust: str | None
    paper_weights: bool


class FleetChoices(CommonChoices, total=False):
    """The options of the fit of a fleet, as keywords; its `order` is 0 by default, the same for both triads."""

    prior: Literal["datasheet"] | None
    seed: int


class SeedlessFitChoices(CommonChoices, total=False):
    """The attributes of `Options` but for the seed."""

    scatter: bool
    prior: PriorInformation | Calibration | Literal["datasheet"] | None
    prior_sha256: str
    exclude: tuple[str, ...]


class FitChoices(SeedlessFitChoices, total=False):
    """The attributes of `Options`, as keywords of what fits."""

    seed: int


FLEET_NAMES = (*CommonChoices.__annotations__, "prior", "seed")
"""The keywords of `FleetChoices`."""


@dataclass(frozen=True)
class Options:
    """Options of a calibration; the defaults are right for most runs.

    Attributes:
        method: "joint", "least-squares", "swarm", "newton", "toolface-inclination", "scalar".
        model: "polynomial" or "factors"; None: that of a previous calibration that is the prior,
            else polynomial at order 0, factors above.
        order: temperature order 0…3 of both triads, or of each; "auto": the lowest that leaves no
            term which noise does not explain, or that of the prior.
        parameters: per triad at one temperature: 12, 9 (sensor frame) or 6 (scale and bias). 12: as
            many as a previous calibration that is the prior.
        nonlinearity: triads with own-axis quadratic and cubic terms; a mapping also states their
            prior as a share of the field. "auto": of the triads whose profile declares them, where
            the run shows them clearly.
        scatter: estimate how far strengths, dip and the direction of a group depart from station to
            station, beside the noise; only where the noise of both triads is estimated.
        estimate: errors of the stand to estimate as well: "azimuth-zero", "inclination-zero", "tilt".
        ignore: what may not be used at any station, of "gravity", "field", "dip": they may then
            differ from station to station.
        robust: None, "huber" or "student-t": weights that bound what a bad station can do.
        paper_weights: sum the squares as the method's paper does, unweighted.
        prior: what is known beforehand: "datasheet" (the tolerances in the profile), a previous
            calibration of the same tool, or knowledge of its parameters.
        prior_sha256: of the file that a previous calibration was read from.
        exclude: labels of stations to leave out.
        seed: of the swarm.

    A fit takes `auto` as order 0 without own-axis terms; a calibration chooses first.
    """

    method: str = "joint"
    model: str | None = None
    order: Orders | Literal["auto"] = AUTO
    parameters: int = 12
    nonlinearity: Mapping[str, float] | tuple[str, ...] | Literal["auto"] = AUTO
    scatter: bool = False
    estimate: tuple[str, ...] = ()
    ignore: tuple[str, ...] = ()
    robust: str | None = None
    paper_weights: bool = False
    prior: PriorInformation | Calibration | Literal["datasheet"] | None = None
    prior_sha256: str = ""
    exclude: tuple[str, ...] = ()
    seed: int = 0

    def __post_init__(self) -> None:
        """Take one name for a tuple of one; refuse an order, a model, a triad or a prior that cannot be.

        Raises `InputError`.
        """
        for name in ("nonlinearity", "estimate", "ignore", "exclude"):
            value = getattr(self, name)
            if isinstance(value, str) and value != AUTO:
                object.__setattr__(self, name, () if value == "none" else (value,))
        given: Any = self.exclude
        labels = given if isinstance(given, Iterable) else (given,)
        object.__setattr__(self, "exclude", tuple(map(str, labels)))  # labels are text
        if self.model not in (None, *MODELS):
            raise InputError(f"`model` must be {' or '.join(MODELS)}; got {self.model!r}.")
        if isinstance(self.prior, str) and self.prior != DATASHEET:
            raise InputError(
                f"`prior` must be '{DATASHEET}' or a calibration; got {self.prior!r}. Read a file with "
                "mwdcal.load."
            )
        if self.order != AUTO and not {*self.orders} <= {*range(HIGHEST + 1)}:
            raise InputError(f"`order` must be 0, 1, 2, 3 or auto; got {self.order!r}.")
        if self.nonlinearity != AUTO and not {*self.nonlinearity} <= {*TRIADS}:
            names = ",".join(self.nonlinearity)
            raise InputError(
                f"`nonlinearity` must be auto, none, {' or '.join(TRIADS)}; got {names!r}."
            )

    @property
    def orders(self) -> tuple[int, int]:
        """Temperature order of accelerometer and magnetometer."""
        if self.order == AUTO:
            return 0, 0
        return self.order if isinstance(self.order, tuple) else (self.order, self.order)

    @property
    def curved(self) -> Mapping[str, float]:
        """Triads with own-axis terms, and the prior of these as a share of the field."""
        if isinstance(self.nonlinearity, Mapping):
            return self.nonlinearity
        return {} if self.nonlinearity == AUTO else dict.fromkeys(self.nonlinearity, USUAL)

    @property
    def knowledge(self) -> PriorInformation | None:
        """The prior information on the parameters.

        Raises `TypeError` for a prior that needs the readings to become knowledge of parameters.
        """
        if self.prior is None or isinstance(self.prior, PriorInformation):
            return self.prior
        raise TypeError("this prior needs the readings: use calibrate, not fit")

    @property
    def separate_solver(self) -> bool:
        """Whether the method minimises by its own means: no weights, priors or own-axis terms."""
        return self.paper_weights or self.method in ("newton", "swarm")

    def kind(self, order: int) -> str:
        """The model of a triad: at order 0 both are the same, and the linear one is simpler."""
        return self.model or ("factors" if order else "polynomial")


def options_of(
    arguments: FitArguments,
    prior: Prior = None,
    exclude: tuple[str, ...] = (),
    prior_sha256: str = "",
) -> Options:
    """The options of a command line, with the prior that its word names."""
    triads = arguments["nonlinearity"]
    curved = {"none": (), AUTO: AUTO}.get(triads, names(triads) or (triads,))
    read: dict[str, Any] = {
        "order": order_of(arguments["order"]),
        "parameters": int(arguments["parameters"] or 12),
        "nonlinearity": curved,
        "estimate": names(arguments["estimate"]),
        "ignore": names(arguments["ignore"]),
        "prior": prior,
    }
    return Options(**{**arguments, **read}, exclude=exclude, prior_sha256=prior_sha256)


def as_arguments(options: Options) -> FitArguments:
    """Options as the command line has them, in which a table of calibrations states them."""
    values: dict[str, Any] = {name: getattr(options, name) for name in FIT_OPTIONS}
    curved, words = options.nonlinearity, {n: ",".join(values[n]) for n in ("estimate", "ignore")}
    words["nonlinearity"] = curved if curved == AUTO else ",".join(sorted(curved)) or "none"
    words |= {name: str(values[name]) for name in ("order", "parameters")}
    prior = DATASHEET if options.prior else None
    return cast("FitArguments", {**values, **words, "prior": prior})
