"""A verdict on the screen."""

from __future__ import annotations

from collections.abc import Mapping

from mwdcal.app.screens.records.signature import in_short
from mwdcal.app.text import WIDE, one_line, quantity, table
from mwdcal.calibration.readings import simulated
from mwdcal.certificate.signature import SignatureCheck
from mwdcal.use.verification import Verdict


def screen(result: Verdict, signature: SignatureCheck, *metadata: Mapping[str, object]) -> str:
    """The outcome first, then each limit; `signature` of the calibration, `metadata` of calibration and run."""
    rows = []
    for row in result.rows:
        sd = "not stated" if row.uncertainty is None else quantity(row.uncertainty, row.unit)
        raw, value, limit = (quantity(v, row.unit) for v in (row.raw, row.value, row.limit))
        verdict = "pass" if row.passed else "FAIL"
        rows.append([row.name, raw, value, sd, limit, verdict, row.note])
    outcome = "PASS" if result.passed else "FAIL"
    first = [outcome, result.run, f"{result.stations} stations", in_short(signature)]
    first += simulated(*metadata)
    source = f" ({result.source})" if result.source else ""
    lines = ["   ".join(first), f"limits {result.limits}{source}", f"rule: {result.rule}"]
    header = ["", "raw", "noise-free", "1σ", "limit", "", "where"]
    return "\n".join(map(one_line, lines)) + "\n\n" + table(rows, header, WIDE)
