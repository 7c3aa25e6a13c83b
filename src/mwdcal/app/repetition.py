"""Many repetitions of a procedure, by all cores; the result does not depend on how many these are."""

from __future__ import annotations

import pickle
from functools import partial

import numpy as np

from mwdcal.app import pool, progress
from mwdcal.calibration.record import SOFTWARE
from mwdcal.files.formats.columns import Column
from mwdcal.files.formats.table import Table
from mwdcal.geometry.vectors import AnyArray
from mwdcal.planning.procedure import Procedure, solved
from mwdcal.planning.repetition import Repetition, joined, summarised
from mwdcal.use.correction_numba import cores


def repeated(
    procedure: Procedure, count: int, workers: int | None
) -> tuple[dict[str, AnyArray], Repetition]:
    """The columns of all tools, and what they show."""
    judged, parts = procedure.judged, procedure.parts(count)
    steps, done = pool.Steps(tuple, partial(solved, procedure)), {}
    with progress.bar("simulating") as show:
        for index, result in pool.results(steps, parts, workers or cores(), None):
            done[index] = pickle.loads(result)  # of our own workers
            show(len(done), len(parts))
    columns = joined([done[index] for index in range(len(parts))])
    return columns, summarised(columns, judged, procedure.guard)


def as_table(columns: dict[str, AnyArray], procedure: Procedure) -> Table:
    """The table of all tools, labelled as simulated."""
    cells: dict[str, Column] = {
        name: values.tolist() if values.dtype == object else np.asarray(values)
        for name, values in columns.items()
    }
    labels = {
        "simulated": True, "seed": procedure.seed, "plan": procedure.calibrating.plan.source,
        "rolltest": procedure.testing.plan.source, "limits": procedure.limits.name,
        "tool": procedure.calibrating.profile.name, "software": SOFTWARE,
    }  # fmt: skip
    return Table(cells, labels, "tools")
