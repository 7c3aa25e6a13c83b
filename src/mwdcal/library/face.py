"""The public names: a command loads the modules that it needs, not all of these."""

from mwdcal.calibration.options import Options as Options
from mwdcal.calibration.readings import Readings as Readings
from mwdcal.calibration.record import Calibration as Calibration
from mwdcal.errors import FitError as FitError
from mwdcal.errors import InputError as InputError
from mwdcal.library import shown as shown  # puts words, document and page on results
from mwdcal.library.arrays import readings as readings
from mwdcal.library.planning import plan as plan
from mwdcal.library.planning import propose_profile as propose_profile
from mwdcal.library.records import certificate as certificate
from mwdcal.library.records import check_signature as check_signature
from mwdcal.library.records import fleet as fleet
from mwdcal.library.records import registry as registry
from mwdcal.library.records import sign as sign
from mwdcal.library.simulation import simulate as simulate
from mwdcal.library.tasks import apply as apply
from mwdcal.library.tasks import calibrate as calibrate
from mwdcal.library.tasks import compare as compare
from mwdcal.library.tasks import diagnose as diagnose
from mwdcal.library.tasks import load as load
from mwdcal.library.tasks import load_profile as load_profile
from mwdcal.library.tasks import noise as noise
from mwdcal.library.tasks import read_run as read_run
from mwdcal.library.tasks import save as save
from mwdcal.library.tasks import stations as stations
from mwdcal.library.tasks import verify as verify
from mwdcal.library.wells import convert as convert
from mwdcal.library.wells import export as export
from mwdcal.library.wells import reference as reference
from mwdcal.library.wells import survey as survey
from mwdcal.sensor.profile import Profile as Profile
from mwdcal.use import plots as plots  # puts `plot` on calibrations and verdicts
