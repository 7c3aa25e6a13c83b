"""What many repetitions of a procedure show: distribution of errors, verdicts, wrong verdicts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np

from mwdcal.calibration.prediction import STATED_ANGLES
from mwdcal.calibration.record import SOFTWARE
from mwdcal.files.formats.columns import Column
from mwdcal.files.formats.table import Table
from mwdcal.geometry.vectors import AnyArray, Array, Bools
from mwdcal.planning.procedure import CALIBRATED, Judged, Procedure

PERCENTILES = (5, 50, 95, 99)
"""Of each distribution that is stated."""
Percentiles = dict[str, float | None]
SIDE = 1.959963984540054
"""Standard deviations that hold 95 % of a normal distribution."""


class Share(msgspec.Struct, frozen=True, kw_only=True):
    """A share of all tools, counted, with its 95 % interval (Wilson)."""

    count: int
    share: float
    low: float
    high: float

    @classmethod
    def of(cls, members: Bools) -> Share:
        """The share of members that are true."""
        count, total = int(members.sum()), len(members)
        share, weight = count / total, SIDE**2 / total
        middle = (share + weight / 2) / (1 + weight)
        half = SIDE * np.sqrt(share * (1 - share) / total + weight / total / 4) / (1 + weight)
        low = 0.0 if count == 0 else float(middle - half)
        high = 1.0 if count == total else float(middle + half)
        return cls(count=count, share=share, low=low, high=high)


class LimitRow(msgspec.Struct, frozen=True, kw_only=True):
    """One limit over all tools: percentiles of the figure that the roll test gives, and of the true one."""

    name: str
    unit: str
    limit: float
    value: Percentiles
    true: Percentiles
    wrong: Share


class Repetition(msgspec.Struct, frozen=True, kw_only=True):
    """What many repetitions show; shares are of all tools.

    A tool is `good` where every true figure, of noise-free readings over the whole turn, is within its limit.
    `wrong_pass`, the consumer's risk: passed and not good; `wrong_fail`, the producer's risk: good and not passed.
    `errors_deg`: percentiles over the tools of the root mean square (`rms`) and the largest (`max`) error of each
    angle over the working range, and of the accuracy that its calibration states at 45° (`stated`).
    """

    tools: int
    calibrated: Share
    refused: dict[str, int]
    passed: Share
    good: Share
    wrong_pass: Share
    wrong_fail: Share
    errors_deg: dict[str, dict[str, Percentiles]]
    limits: list[LimitRow]


def joined(parts: Sequence[Mapping[str, AnyArray]]) -> dict[str, AnyArray]:
    """The columns of all parts, in order, with the number of each tool first."""
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return {"tool": np.arange(1.0, len(columns["status"]) + 1), **columns}


def as_table(columns: Mapping[str, AnyArray], procedure: Procedure) -> Table:
    """The table of all tools, labelled as simulated."""
    cells: dict[str, Column] = {
        name: values.tolist() if values.dtype == object else values
        for name, values in columns.items()
    }
    labels = {
        "simulated": True, "seed": procedure.seed, "plan": procedure.calibrating.plan.source,
        "rolltest": procedure.testing.plan.source, "limits": procedure.limits.name,
        "tool": procedure.calibrating.profile.name, "software": SOFTWARE,
    }  # fmt: skip
    return Table(cells, labels, "tools")


def summarised(
    columns: Mapping[str, AnyArray], judged: Sequence[Judged], guard: float
) -> Repetition:
    """What the rows of all tools show; the verdict has kept `guard` standard uncertainties from each limit."""
    status, passed, good = (columns[name] for name in ("status", "passed", "good"))
    sound = np.asarray(status == CALIBRATED)
    refused, counts = np.unique(status[~sound].astype(str), return_counts=True)
    return Repetition(
        tools=len(status),
        calibrated=Share.of(sound),
        refused=dict(zip(refused.tolist(), counts.tolist(), strict=True)),
        passed=Share.of(passed),
        good=Share.of(good & sound),
        wrong_pass=Share.of(passed & ~good),
        wrong_fail=Share.of(sound & ~passed & good),
        errors_deg={
            name: {
                word: _percentiles(columns[f"{name}_{column}_deg"][sound])
                for word, column in (("rms", "error_rms"), ("max", "error_max"), ("stated", "sd"))
            }
            for name in STATED_ANGLES
            if f"{name}_sd_deg" in columns
        },
        limits=[_limit_row(each, columns, sound, guard) for each in judged],
    )


def _limit_row(
    limit: Judged, columns: Mapping[str, AnyArray], sound: Bools, guard: float
) -> LimitRow:
    value, sd, true = (columns[limit.column(word)] for word in ("", "sd", "true"))
    wrong = (value + guard * sd <= limit.limit) != (true <= limit.limit)
    return LimitRow(
        name=f"{limit.kind} of {limit.name}",
        unit=limit.unit,
        limit=limit.limit,
        value=_percentiles(value[sound]),
        true=_percentiles(true[sound]),
        wrong=Share.of(sound & wrong),
    )


def _percentiles(values: Array) -> Percentiles:
    """The percentiles of a column, by name such as p95; None where it is empty."""
    known = values[np.isfinite(values)]
    of = np.percentile(known, PERCENTILES).tolist() if known.size else [None] * len(PERCENTILES)
    return {f"p{percent}": value for percent, value in zip(PERCENTILES, of, strict=True)}
