"""Tables of readings to correct, for the commands and Python alike."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from mwdcal.calibration.record import Calibration
from mwdcal.errors import FitError, InputError, UnreadableFileError
from mwdcal.files import runs
from mwdcal.files.contract import CHANNELS
from mwdcal.files.formats.table import Table
from mwdcal.files.statements import Said, SurveyTable
from mwdcal.sensor.profile import Profile

if TYPE_CHECKING:
    from mwdcal.presentation.signature import LoadedCalibration
    from mwdcal.survey.surveying import WellInputs


def read_surveys(
    source: str | os.PathLike[str] | Table,
    calibration: Calibration,
    said: Said | None = None,
    rows: int = runs.MOST_ROWS,
) -> SurveyTable:
    """The readings in a file or table, by the names of the calibration's run where it has these, else by its own.

    `rows` as of `runs.read_export`.

    Raises:
        InputError: the file cannot be read, or has no table of readings.
        FitError: which table, or which columns, are meant is open.
    """
    said, profile = said or Said(), calibration.profile
    table: Table | None = None
    problem: InputError | FitError | None = None
    if isinstance(source, Table):
        table = source
    else:
        try:
            table = runs.read_export(
                source, profile, decimal=said.decimal, rows=rows, statements=said.statements
            )
        except UnreadableFileError:
            raise
        except (InputError, FitError) as error:
            problem = error
    if table and not said.answers and _has_names(table, profile):
        return SurveyTable(table, calibration)
    from mwdcal.identification.surveys import table_of_other_names

    return table_of_other_names(source, table, problem, calibration, said)


def inputs_of_run(tool: LoadedCalibration, named: SurveyTable, how: Sequence[Any]) -> WellInputs:
    """The inputs of a run in a well: its calibration, its table, and `how` it is surveyed.

    `how`: reference, limits, whether by `msa`, error model, rows without a reading, azimuth of the vertical section and
    unit of lengths, as of `well_inputs`.
    """
    from mwdcal.survey.surveying import well_inputs

    reference, limits, msa, error_model, missing, azimuth, unit = how
    return well_inputs(
        named.calibration, named.table, reference, limits, msa, tool.digest,
        [*tool.findings, *named.findings], error_model, missing, azimuth, unit,
    )  # fmt: skip


def _has_names(table: Table, profile: Profile) -> bool:
    """Whether a table has all channels by the names of a profile, or one of the accelerometer's by a run file's."""
    wanted, names = runs.channels_of(profile), {*table.columns}
    named = bool(wanted) and {*wanted} <= names
    return named or not names.isdisjoint(CHANNELS["accelerometer"])
