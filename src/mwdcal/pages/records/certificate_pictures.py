"""Pictures of a certificate, from the calibration and the roll tests behind it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mwdcal.calibration.record import Calibration
from mwdcal.geometry.observables import TITLES
from mwdcal.use import plots as plots  # puts `plot` on calibrations
from mwdcal.use.verification import Verdict

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mwdcal.drift.document import ToolDrift


@dataclass(frozen=True)
class Picture:
    """A figure with its title, which needs no picture to be understood, and a note on how to read it.

    `id` is of letters, digits and hyphens.
    """

    id: str
    title: str
    figure: Figure
    note: str = ""

    @property
    def alt(self) -> str:
        """What the figure shows, for readers who do not see it."""
        return str(self.figure.get_label()) or self.title


def certificate_pictures(
    calibration: Calibration,
    as_left: Verdict | None = None,
    as_found: Verdict | None = None,
    drift: ToolDrift | None = None,
) -> list[Picture]:
    """What the results look like: errors before and after, residuals, 1σ, roll tests, earlier calibrations."""
    tests = _roll_tests(as_found, as_left)
    return [*_fit(calibration), *_accuracy(calibration), *tests, *_past(drift)]


def _past(drift: ToolDrift | None) -> Iterator[Picture]:
    if drift is None:
        return
    from mwdcal.pages.records.drift_figures import drift_picture

    note = (
        "Differences from the first calibration, with 95 % bars. Pale columns: control limits, three standard "
        "deviations of what both uncertainties and the random walk allow. Dashed: a change that the uncertainties do "
        "not explain."
    )
    yield Picture("drift", "Biases from calibration to calibration", drift_picture(drift), note)


def _fit(calibration: Calibration) -> Iterator[Picture]:
    for row in calibration.errors:
        title = f"Error of {TITLES[row.observable]} at each station, before and after"
        yield Picture(f"error-{row.observable}", title, calibration.plot.errors(row.observable))
    if calibration.station_rows:
        title = "Residuals: misfit of each station"
        note = "A station above the dashed line should be measured again."
        yield Picture("residuals", title, calibration.plot.deviations(), note)


def _accuracy(calibration: Calibration) -> Iterator[Picture]:
    note = "Standard uncertainty, typical over toolface and azimuth."
    title = "Standard uncertainty (1σ) over inclination"
    band = f"{note} Band: from the best to the worst azimuth."
    yield Picture("accuracy", title, calibration.plot.accuracy(), band)
    if calibration.plot.over_temperature:
        title = "Standard uncertainty (1σ) over temperature, at 45° inclination"
        figure = calibration.plot.accuracy_over_temperature()
        yield Picture("accuracy-temperature", title, figure, note)


def _roll_tests(as_found: Verdict | None, as_left: Verdict | None) -> Iterator[Picture]:
    note = "Markers: stations, noise included. Curves: mean and harmonics over a turn of toolface."
    for when, verdict in (("as found", as_found), ("as left", as_left)):
        if verdict is not None and any(row.sets for row in verdict.rows):
            title = f"Roll test {when}: departures over toolface"
            yield Picture(when.replace(" ", "-"), title, verdict.plot.toolface(), note)
