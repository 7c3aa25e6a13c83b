"""A verdict on the screen."""

from __future__ import annotations

from collections.abc import Mapping

from mwdcal.app.text import WIDE, one_line, quantity, table
from mwdcal.calibration.readings import simulated
from mwdcal.use.verification import Verdict


def screen(result: Verdict, *metadata: Mapping[str, object]) -> str:
    """The outcome first, then each limit; `metadata` of calibration and run."""
    rows = [
        [
            row.name,
            quantity(row.raw, row.unit),
            quantity(row.value, row.unit),
            "not stated" if row.uncertainty is None else quantity(row.uncertainty, row.unit),
            quantity(row.limit, row.unit),
            "pass" if row.passed else "FAIL",
            row.note,
        ]
        for row in result.rows
    ]
    outcome = "PASS" if result.passed else "FAIL"
    first = [outcome, result.run, f"{result.stations} stations", *simulated(*metadata)]
    lines = ["   ".join(first)]
    source = f" ({result.source})" if result.source else ""
    lines += [f"limits {result.limits}{source}", f"rule: {result.rule}"]
    header = ["", "raw", "noise-free", "1σ", "limit", "", "where"]
    return "\n".join(map(one_line, lines)) + "\n\n" + table(rows, header, WIDE)
