"""What a plan will give: the calibration of a nominal tool that reads without noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mwdcal.calibration.automatic.auto import Choice, choose
from mwdcal.calibration.calibrate import recorded
from mwdcal.calibration.estimate import Fit, fit
from mwdcal.calibration.options import AUTO, Options
from mwdcal.calibration.readings import HIGHEST, LEAST_TEMPERATURE_SPAN, SOAK_GAP, Readings
from mwdcal.calibration.record import Calibration
from mwdcal.errors import InputError
from mwdcal.files.contract import CHANNELS
from mwdcal.files.runs import from_readings, to_readings
from mwdcal.geometry.vectors import Array, reference_vectors
from mwdcal.planning.simulate import Earth, StationPlan
from mwdcal.sensor.profile import Profile


def nominal_run(plan: StationPlan, profile: Profile, earth: Earth) -> tuple[Readings, Profile]:
    """What a nominal tool reads at the stations of a plan (n,), with the noise and stand of a profile.

    Raises:
        InputError: the profile does not state the noise of a triad.
    """
    for kind in CHANNELS:
        if getattr(profile, kind).noise is None:
            raise InputError(
                f"the profile {profile.name} does not state the noise of the {kind}, on which all "
                f"uncertainties rest. Add 'noise' to its [{kind}]; mwdcal noise measures it."
            )
    fields = reference_vectors(plan.inclination, plan.azimuth, plan.toolface, *earth)
    known = {name: getattr(plan, name) for name in ("inclination", "azimuth", "toolface")}
    known |= {name: np.full(plan.count, value) for name, value in earth._asdict().items()}
    readings = Readings(*fields, plan.temperature, known, metadata={"simulated": True})
    return to_readings(from_readings(readings, profile), profile)


def highest_order(temperature: Array) -> int:
    """The highest order of temperature terms that soaks at temperatures (n,) carry, °C."""
    steps = np.sort(temperature)
    soaks = 1 + int(np.count_nonzero(np.diff(steps) > SOAK_GAP))
    return min(HIGHEST, soaks - 1, int(np.ptp(steps) // LEAST_TEMPERATURE_SPAN))


def planned_fit(
    plan: StationPlan, profile: Profile, options: Options, earth: Earth
) -> tuple[Choice, Fit]:
    """The fit of a plan's noise-free readings: its information is that of the plan.

    Nothing is left to be seen in the readings: an order of "auto" is `highest_order`, and own-axis terms are
    those that the options name.
    """
    readings, scaled = nominal_run(plan, profile, earth)
    if options.order == AUTO:
        options = replace(options, order=highest_order(plan.temperature))
    if options.nonlinearity == AUTO:
        options = replace(options, nonlinearity=())
    choice = choose(readings, scaled, options, lambda _: None)
    result = fit(choice.readings, choice.options)
    one = np.ones_like(result.analysis.variance_factor)
    return choice, replace(result, analysis=replace(result.analysis, variance_factor=one))


def expected(
    plan: StationPlan,
    profile: Profile,
    options: Options | None = None,
    earth: Earth | None = None,
) -> Calibration:
    """The calibration that a plan will give, but for its values: uncertainties, rank, accuracy to expect.

    Its parameters are those of a nominal tool, its residuals zero, and it is marked as simulated.
    Source: to first order the covariance of a fit depends on the tool by its departures from nominal,
    a few per cent, and on the noise not at all but for its size.

    Raises:
        InputError: the profile does not state the noise.
        FitError: no calibration can come of the plan; the message says what to add.
    """
    return recorded(*planned_fit(plan, profile, options or Options(), earth or Earth()))
