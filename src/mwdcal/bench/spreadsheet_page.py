"""The page of a table that was dropped: the sheet and what its columns were taken for, questions, results."""

from __future__ import annotations

from typing import Any

from mwdcal.bench import pages
from mwdcal.bench.documents import RunFit
from mwdcal.bench.spreadsheet import DroppedTable
from mwdcal.calibration.readings import simulated
from mwdcal.files.contract import CHANNELS, REFERENCES
from mwdcal.identification.columns import meanings_of
from mwdcal.presentation.numbers import number

ROWS_SHOWN = 12
"""Rows of the table that the page shows."""
COLUMN_KINDS = {
    **dict.fromkeys(CHANNELS["accelerometer"], "accelerometer"),
    **dict.fromkeys(CHANNELS["magnetometer"], "magnetometer"),
    **{reference.column: "reference" for reference in REFERENCES.values()},
}
"""Kinds of columns, which have a colour and a name each; all others that are used are "other"."""


def page(table: DroppedTable, token: str) -> str:
    """The whole page."""
    with table.lock:
        return pages.environment().get_template("table.html").render(
            t=pages.texts(), token=token, name=table.name, **_sheet(table), **_open(table),
            **_results(table),
            papers=pages.papers(table.papers, table.folder), message=table.message,
        )  # fmt: skip


def _sheet(table: DroppedTable) -> dict[str, Any]:
    """The head and the first rows of the table."""
    if (sheet := table.sheet) is None:
        return {"head": [], "rows": [], "more": 0, "first": ""}
    t, meanings = pages.texts(), _meanings(table)
    head = []
    for name, unit in zip(sheet.names, sheet.units, strict=True):
        ours, in_unit = meanings.get(name, ("", ""))
        kind = COLUMN_KINDS.get(ours, "other" if ours else "unused")
        words = f"{ours} [{in_unit}]" if in_unit else ours
        head.append((f"{name} {unit}".strip(), kind, words or t["unused"], t[f"kind_{kind}"]))
    kinds = [kind for _, kind, *_ in head]
    shown = [*zip(*(column[:ROWS_SHOWN] for column in sheet.texts), strict=True)]
    rows = [
        (line, [*zip(kinds, row, strict=True)])
        for line, row in zip(sheet.lines, shown, strict=False)
    ]
    return {
        "head": head,
        "rows": rows,
        "more": max(len(sheet.lines) - ROWS_SHOWN, 0),
        "first": sheet.sheet,
    }


def _meanings(table: DroppedTable) -> dict[str, tuple[str, str]]:
    """The column of a run file and the unit of each column of the table, by name; by names alone until all is clear."""
    if table.proposal is not None:
        columns = table.proposal.proposal.profile.columns
        return {each.name: (ours, each.unit) for ours, each in dict(columns or {}).items()}
    sheet, said = table.sheet, table.answers.get("column", {})
    likely = meanings_of(sheet.names, sheet.units) if sheet else {}
    by_name = {
        name: (each.column, each.unit) for name, each in likely.items() if each.column not in said
    }
    return by_name | {theirs: (ours, "") for ours, theirs in said.items() if theirs}


def _open(table: DroppedTable) -> dict[str, Any]:
    """Questions with their answers, and what is wrong where nothing can be asked."""
    questions = [
        (place, question.text, [(answer.name, answer.numbers) for answer in question.answers])
        for place, question in enumerate(table.questions)
    ]
    findings = table.proposal.findings if table.proposal else []
    return {
        "questions": questions,
        "reason": "" if any(answers for *_, answers in questions) else table.reason,
        "findings": [finding.text for finding in findings],
        "axes": [(triad, ", ".join(axes)) for triad, axes in table.axes.items()],
        "serial": table.serial,
        "simulated": bool(table.proposal and simulated(table.proposal.proposal.metadata)),
        "answered": bool(table.answers),
        "can_calibrate": table.proposal is not None and not table.reason,
    }  # fmt: skip


def _results(table: DroppedTable) -> dict[str, Any]:
    """The calibration, the verdict, and what comes next."""
    t, fit, verdict = pages.texts(), table.fit or RunFit(), table.verdict
    heading, style = "", ""
    if verdict is not None:
        heading, style = pages.verdict_heading(verdict)
    elif fit.calibration is not None:
        heading = t["calibrated"].format(serial=table.serial)
    failure = table.failure
    accuracy = [
        (t[name], f"{number(value, 2)}°") for name, value in fit.accuracy_deg.items() if value
    ]
    return {
        "heading": heading, "heading_class": style, "accuracy": accuracy, "bad": [*fit.bad.items()],
        "fit_reason": fit.reason, "calibrated": fit.calibration is not None,
        "errors": pages.error_rows(fit.calibration.errors if fit.calibration else []),
        "limits": pages.limit_rows(verdict.rows if verdict else []),
        "can_certify": verdict is not None and "certificate" not in table.papers,
        "passed": bool(verdict and verdict.passed), "cause": failure.cause,
        "after_failure": pages.after_failure(failure, "table_failed"),
    }  # fmt: skip
