"""How the tool was calibrated, in the words of a certificate."""

from __future__ import annotations

from collections.abc import Iterator

from mwdcal.calibration.prediction import without_temperature
from mwdcal.calibration.record import Calibration, TriadCalibration
from mwdcal.certificate.document import Method

DOCUMENTATION = "mwdcal documentation, Methods"
MOOSAVI = "S. M. Seyed Moosavi et al., Error Analysis in Accelerometers Calibration of MWD Instruments (2016)"
MORADI = "M. Moradi, I. Izadi, calibration of MWD sensors by particle swarm optimisation (2019)"
PROCEDURE = (
    "Readings of the tool at rest in many attitudes are taken, and the parameters of the sensor model "
    "are fitted "
)
METHODS: dict[str, tuple[str, tuple[str, ...]]] = {
    "joint": ("to all references at once by weighted least squares.", ()),
    "least-squares": ("to the reference vectors by least squares.", (MORADI,)),
    "swarm": ("to the reference vectors by a particle swarm.", (MORADI,)),
    "newton": ("to the strength of gravity and the inclination by Newton's method.", (MOOSAVI,)),
    "toolface-inclination": ("to toolface and inclination alone.", ()),
    "scalar": ("to the strengths of gravity and field alone.", ()),
}
"""What each method fits the parameters to, and where it is published."""


def method(calibration: Calibration) -> Method:
    """The method of a calibration, its model, and how it deviates from the usual procedure."""
    text, papers = METHODS.get(calibration.method, (f"by the method {calibration.method}.", ()))
    stand = calibration.tool.get("stand", "")
    return Method(
        name=calibration.method,
        text=PROCEDURE + text,
        software=calibration.software,
        model="; ".join(map(_model, calibration.triads)),
        stations=calibration.stations,
        references=[DOCUMENTATION, *papers, *([f"stand: {stand}"] if stand else [])],
        deviations=list(_deviations(calibration)),
    )


def _model(triad: TriadCalibration) -> str:
    curved = ", with own-axis quadratic and cubic terms" if triad.curved else ""
    return f"{triad.name}: {triad.model}, temperature order {triad.order}{curved}"


def _deviations(calibration: Calibration) -> Iterator[str]:
    """What was done other than the usual procedure, a phrase each."""
    options = calibration.options
    if without_temperature(calibration):
        yield f"{without_temperature(calibration)}: the results hold at the temperature of the calibration alone"
    if calibration.excluded:
        yield f"stations excluded from the fit: {', '.join(calibration.excluded)}"
    if options.robust:
        yield f"robust fit ({options.robust}): stations that do not agree have less weight"
    if options.ignore:
        yield f"references not used: {', '.join(options.ignore)}"
    if options.parameters != 12:
        yield f"{options.parameters} parameters of each triad, the others held at zero"
    if options.paper_weights:
        yield "unweighted sums, as the method's paper has them"
    if options.prior:
        yield f"prior knowledge of the parameters: {options.prior}"
    if calibration.relative:
        yield "strength of the field unknown: the magnetometer is calibrated to a field of 1"
