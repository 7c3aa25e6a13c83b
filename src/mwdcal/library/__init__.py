"""What `import mwdcal` offers: arrays converted and checked, and one function for each task."""

from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration
from mwdcal.errors import FitError, InputError
from mwdcal.library import shown as shown  # puts words, document and page on results
from mwdcal.library.arrays import readings
from mwdcal.library.planning import plan, propose_profile
from mwdcal.library.records import certificate, check_signature, fleet, registry, sign
from mwdcal.library.simulation import simulate
from mwdcal.library.tasks import (
    apply,
    calibrate,
    compare,
    diagnose,
    load,
    load_profile,
    noise,
    read_run,
    save,
    stations,
    verify,
)
from mwdcal.library.wells import convert, export, reference, survey
from mwdcal.sensor.profile import Profile
from mwdcal.use import plots as plots  # puts `plot` on calibrations and verdicts

__all__ = [
    "Calibration",
    "FitError",
    "InputError",
    "Options",
    "Profile",
    "Readings",
    "apply",
    "calibrate",
    "certificate",
    "check_signature",
    "compare",
    "convert",
    "diagnose",
    "export",
    "fleet",
    "load",
    "load_profile",
    "noise",
    "plan",
    "propose_profile",
    "read_run",
    "readings",
    "reference",
    "registry",
    "save",
    "sign",
    "simulate",
    "stations",
    "survey",
    "verify",
]
