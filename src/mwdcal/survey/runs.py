"""Several runs in one well: each by its own tool and calibration, on a path that continues.

A run begins where the one before ended: its position, direction and covariance are the tie-in. Errors that are new at
every station, or last over a run (drift, interference, sag, misalignment), are independent between runs. Those that
last over the well, or over all wells (declination, some of depth), are the same in all, and so are errors of one
calibration that is used twice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mwdcal.calibration.record import Finding
from mwdcal.errors import InputError
from mwdcal.files.formats.columns import Column
from mwdcal.files.formats.table import Table
from mwdcal.geometry.vectors import AnyArray, Array, Bools
from mwdcal.survey.acceptance import Blindness, Judgement
from mwdcal.survey.axial import AxialCorrection
from mwdcal.survey.interference import Interference
from mwdcal.survey.path import TieIn
from mwdcal.survey.references import Claim, contradictions
from mwdcal.survey.stations import TOOLFACE_SWITCH, North, Surveys
from mwdcal.survey.surveying import SurveyedWell, WellInputs, survey_well
from mwdcal.survey.well import Position, Well

RUN_COLUMN = "run"
"""The column that says which run a station is of, counted from 1."""


def survey_runs(
    inputs: Sequence[WellInputs],
    analyses: Sequence[Interference | None],
    *,
    tie_in: tuple[float, float, float] | TieIn | None = None,
    switch: tuple[float, float] = TOOLFACE_SWITCH,
    outside: str = "blank",
    axial: bool = False,
) -> SurveyedWell:
    """The surveys of the runs of a well, in the order in which they were drilled; as of `survey_well` if it is one.

    Raises:
        InputError: runs whose azimuths count from different norths, or whose tools measure different things.
    """
    runs: list[SurveyedWell] = []
    how: dict[str, Any] = {"tie_in": tie_in, "switch": switch, "outside": outside, "axial": axial}
    for each, analysis in zip(inputs, analyses, strict=True):
        follows = runs[-1].well.after.next_run() if runs else None
        runs.append(survey_well(each, analysis, follows=follows, **how))
    if len(runs) == 1:
        return runs[0]
    _check_alike([run.well for run in runs])
    together = _joined_well([run.well for run in runs])
    findings = [
        Finding(id=finding.id, text=f"run {i}: {finding.text}")
        for i, run in enumerate(runs, 1)
        for finding in (*run.well.findings, *_other_norths(run.well, runs[0].well))
    ]
    together = replace(together, findings=findings)
    first = replace(
        runs[0].inputs,
        table=_joined_table(runs),
        rows=_joined_rows(runs),
        tie_ins=_joined_tie_ins(runs),
    )
    alone = AxialCorrection.joined([run.axial for run in runs if run.axial]) if axial else None
    return SurveyedWell(first, together, together.counts, None, tuple(runs), alone)


def _check_alike(wells: Sequence[Well]) -> None:
    norths = [well.north.name for well in wells]
    if len(set(norths)) > 1:
        raise InputError(
            f"the runs count azimuths from different norths: {', '.join(norths)}. State declination_deg and "
            "convergence_deg in all tables, or give `reference`."
        )
    kinds = {(w.calibration.has_field, w.calibration.relative, w.position is None) for w in wells}
    if len(kinds) > 1:
        raise InputError(
            "the runs do not all measure the same: magnetic field, its size and depth must be in all, or in none. "
            "Survey them one by one."
        )


def _other_norths(run: Well, first: Well) -> list[Finding]:
    """Declination and convergence of a run that are not those of the first one: a well has one of each."""
    return [
        finding
        for name in ("declination", "convergence")
        for finding in contradictions(
            name, _claim_of(run, name), _claim_of(first, name), "Check sign, place and date."
        )
    ]


def _claim_of(well: Well, name: str) -> Claim:
    """The declination or convergence of a run, with its 1σ, degrees."""
    north = well.north.typical
    angle, sd = getattr(north, name), north.declination_sd if name == "declination" else 0.0
    value = np.nan if angle is None else np.degrees(angle)
    return Claim(well.readings.source, [value], np.degrees(sd))


def _joined_well(wells: Sequence[Well]) -> Well:
    """The surveys of all runs, one after the other."""
    first = wells[0]

    def together(name: str) -> Any:
        return np.concatenate([getattr(well, name) for well in wells])

    blind = [well.blindness for well in wells if well.blindness is not None]
    extrapolated = [well.extrapolated for well in wells if well.extrapolated is not None]
    whole = len(wells)
    position = None
    if first.position is not None:
        position = Position(
            *(
                np.concatenate([getattr(well.position, n) for well in wells])
                for n in _POSITION_PARTS
            )
        )
    readings = replace(
        first.readings,
        accelerometer=np.concatenate([well.readings.accelerometer for well in wells]),
        magnetometer=_if_all([well.readings.magnetometer for well in wells]),
        temperature=_if_all([well.readings.temperature for well in wells]),
        known={}, sd={}, group=None, digest=(), others={}, table={},
        station=tuple(f"{i}:{label}" for i, w in enumerate(wells, 1) for label in w.readings.labels),
        source=", ".join(well.readings.source for well in wells),
    )  # fmt: skip
    return replace(
        first, readings=readings, position=position, north=_joined_north(wells),
        surveys=_joined(Surveys, [well.surveys for well in wells], ends_magnetic=wells[-1].surveys.ends_magnetic),
        judgement=_joined(Judgement, [well.judgement for well in wells], tests=None),
        blindness=_joined(Blindness, blind) if len(blind) == whole else None,
        vectors=(_stack([w.vectors[0] for w in wells]), _stack([w.vectors[1] for w in wells])),
        extrapolated=together("extrapolated") if len(extrapolated) == whole else None,
        after=wells[-1].after,
    )  # fmt: skip


def _stack(parts: Sequence[Array]) -> Array:
    return np.concatenate(parts)


_POSITION_PARTS = ("md", "place", "covariance", "dogleg")


def _joined(kind: type, parts: Sequence[Any], **others: object) -> Any:
    """The arrays of some values of a kind, one after the other, with its `others`."""
    names = [name for name in kind.__dataclass_fields__ if name not in others]  # type: ignore[attr-defined]
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return kind(**arrays, **others)


def _if_all(arrays: Sequence[Array | None]) -> Array | None:
    present = [array for array in arrays if array is not None]
    return np.concatenate(present) if len(present) == len(arrays) else None


def _joined_north(wells: Sequence[Well]) -> North:
    first, counts = wells[0].north, [well.readings.count for well in wells]
    if first.declination is None:
        return first
    each = [well.north.of_path(count) for well, count in zip(wells, counts, strict=True)]
    offset, shared, alone = (np.concatenate(values) for values in zip(*each, strict=True))
    turn = np.repeat([well.north.convergence or 0.0 for well in wells], counts)
    return replace(
        first, declination=offset + turn, declination_sd=shared, declination_noise=alone, base=first.typical
    )  # fmt: skip


def _joined_rows(runs: Sequence[SurveyedWell]) -> Bools | None:
    """Rows of the joined table that have readings; None: all."""
    rows = [
        np.ones(run.inputs.table.count, bool) if run.inputs.rows is None else run.inputs.rows
        for run in runs
    ]
    together = np.concatenate(rows)
    return None if together.all() else together


def _joined_tie_ins(runs: Sequence[SurveyedWell]) -> dict[int, TieIn]:
    """The tie-in stations of all runs by the row of the joined table."""
    starts = np.cumsum([0, *(run.inputs.table.count for run in runs)]).tolist()
    return {
        start + row: tie_in
        for start, run in zip(starts, runs, strict=False)
        for row, tie_in in run.inputs.tie_ins.items()
    }


def _joined_table(runs: Sequence[SurveyedWell]) -> Table:
    """The tables of all runs, one below the other, behind a column of the run."""
    tables = [run.inputs.table for run in runs]
    for table in tables:
        if RUN_COLUMN in table.columns:
            raise InputError(
                f"{table.source}: the column '{RUN_COLUMN}' is there already. Rename it."
            )
    names = dict.fromkeys(name for table in tables for name in table.columns)
    columns: dict[str, Column] = {
        RUN_COLUMN: [str(i) for i, table in enumerate(tables, 1) for _ in range(table.count)]
    }
    for name in names:
        columns[name] = _joined_column([(t.columns.get(name), t.count) for t in tables])
    shared = {
        key: value
        for key, value in tables[0].metadata.items()
        if all(table.metadata.get(key) == value for table in tables)
    }
    return replace(
        tables[0], columns=columns, metadata=shared, lines=[], digest="",
        source=", ".join(table.source for table in tables),
    )  # fmt: skip


def _joined_column(parts: Sequence[tuple[Column | None, int]]) -> Column:
    """A column of several tables, blank where one lacks it; text where it is in any."""
    if any(isinstance(cells, list) for cells, _ in parts):
        texts: list[str] = []
        for cells, count in parts:
            if cells is None:
                texts += [""] * count
            else:
                texts += cells if isinstance(cells, list) else [_text(v) for v in cells.tolist()]
        return texts
    arrays: list[AnyArray] = [
        np.full(count, np.nan) if cells is None else np.asarray(cells) for cells, count in parts
    ]
    return np.concatenate(arrays)


def _text(value: float) -> str:
    return "" if np.isnan(value) else repr(value)
