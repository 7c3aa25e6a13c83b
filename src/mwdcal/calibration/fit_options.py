"""The options of a fit, each declared once: for the command line, for tables of calibrations, in words.

`Options` holds their values. A command line loads this without NumPy.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias, TypedDict

if TYPE_CHECKING:
    from mwdcal.calibration.record import Calibration, FitSettings

Prior: TypeAlias = "Calibration | Literal['datasheet'] | None"
"""The information before a fit: a calibration, the tolerances of the profile, or nothing."""


class FitOption(NamedTuple):
    """An option of a fit.

    Attributes:
        help: for the command line, where it is given as `metavar`, or as one of the `words`, with a `default`, or as an
            integer from the `least` on.
        heading: how the head of a screen and a page states it.
        deviation: how a certificate states it.
    """

    help: str
    metavar: str | None = None
    words: tuple[str, ...] = ()
    default: str | int | bool | None = None
    least: int | None = None
    heading: str = ""
    deviation: str = ""


FIT_OPTIONS = {
    "method": FitOption(
        "joint: all evidence, weighted. least-squares: reference vectors only. swarm: the same "
        "by particle swarm. newton: Newton-Raphson on |g| and inclination. toolface-inclination: the "
        "accelerometer by angles alone. scalar: |g| and |b| alone.",
        "METHOD",
        default="joint",
    ),
    "seed": FitOption(
        "Seed of all that is drawn at random.", default=0, least=0, heading="seed {}"
    ),
    "model": FitOption(
        "Default: polynomial at order 0, factors above.",
        words=("polynomial", "factors"),
        heading="model {}",
    ),
    "order": FitOption(
        "Order of temperature terms. auto: of each triad, the terms that noise does not explain.",
        "0…3|auto",
    ),
    "nonlinearity": FitOption(
        "Own-axis quadratic and cubic terms. auto: of the triads whose profile declares them, where the run shows "
        "them. NAMES: accelerometer, magnetometer, or both with a comma.",
        "auto|none|NAMES",
        heading="own-axis terms {}",
    ),
    "estimate": FitOption(
        "Errors of the stand to find as well: azimuth-zero, inclination-zero, tilt, or several with commas.",
        "NAMES",
        default="",
        heading="stand: {}",
    ),
    "parameters": FitOption(
        "Per triad at one temperature; default 12. 9: the sensor frame, without mounting rotation. 6: scale and bias "
        "alone.",
        words=("12", "9", "6"),
        heading="{} parameters",
        deviation="{} parameters of each triad, the others held at zero",
    ),
    "ignore": FitOption(
        "References that may not be used at any station: gravity, field, dip, or several with commas.",
        "NAMES",
        default="",
        heading="without {}",
        deviation="references not used: {}",
    ),
    "robust": FitOption(
        "Bound what a bad station can do: huber keeps a little of its pull, student-t loses it.",
        words=("huber", "student-t"),
        heading="robust ({})",
        deviation="robust fit ({}): stations that do not agree have less weight",
    ),
    "paper_weights": FitOption(
        "Sum the squares as the method's paper does, unweighted, instead of by their uncertainty.",
        default=False,
        heading="the paper's weights",
        deviation="unweighted sums, as the method's paper has them",
    ),
    "prior": FitOption(
        "Prior information: {}.",
        heading="prior {}",
        deviation="prior knowledge of the parameters: {}",
    ),
}
"""The options in the order of the help."""


class FitArguments(TypedDict):
    """The options of a fit as the command line has them: words, and names with commas between them."""

    method: str
    seed: int
    model: str | None
    order: str
    nonlinearity: str
    estimate: str
    parameters: str | None
    ignore: str
    robust: str | None
    paper_weights: bool
    prior: str | None


def names(text: str) -> tuple[str, ...]:
    """The words of a list with commas, each once."""
    return tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))


def order_of(word: str) -> int | Literal["auto"]:
    """The order as an integer, or the text unchanged if it is not one."""
    from mwdcal.calibration.readings import HIGHEST

    orders: dict[str, Any] = {str(order): order for order in range(HIGHEST + 1)}
    order: int | Literal["auto"] = orders.get(word, word)
    return order


def stated_arguments(arguments: FitArguments) -> dict[str, Any]:
    """Arguments as a table of calibrations and its document state them: lists and numbers."""
    words: dict[str, Any] = dict(arguments)
    words["seed"] = arguments["seed"] if arguments["method"] == "swarm" else None
    words["parameters"] = int(arguments["parameters"] or 12)
    words["order"] = order_of(arguments["order"])
    words |= {name: list(names(words[name])) for name in ("estimate", "ignore")}
    return {name: words[name] for name in FIT_OPTIONS}


def unusual(settings: FitSettings, wording: Literal["heading", "deviation"]) -> Iterator[str]:
    """Settings of a record beyond method, model and order, in the words of a screen or of a certificate."""
    usual, between = type(settings)(), {"heading": " and ", "deviation": ", "}[wording]
    for name in settings.__struct_fields__:
        value = getattr(settings, name)
        if value != getattr(usual, name):
            words = between.join(value) if isinstance(value, list) else value
            yield str(getattr(FIT_OPTIONS[name], wording)).format(words)
