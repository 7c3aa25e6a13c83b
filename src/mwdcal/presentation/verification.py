"""A verdict on the screen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from msgspec import UNSET
from msgspec.structs import replace

from mwdcal.calibration.readings import simulated
from mwdcal.calibration.record import Finding, SignatureCheck
from mwdcal.errors import shell_word
from mwdcal.presentation.numbers import capital, measured, quantity, unit
from mwdcal.presentation.signature import signature_status
from mwdcal.presentation.text import NOT_STATED, chance, one_line, table
from mwdcal.use.verification import COVERAGE, SETTING_PRACTICES, JudgedSet, Verdict, VerdictRow

FREEDOM = "DoF"
"""Title of a column of degrees of freedom."""
MANY = 10_000
"""As good as unlimited degrees of freedom."""
FREEDOM_RULE = (
    "DoF, degrees of freedom of the 1σ: with few it is uncertain itself, with ∞ it is known"
)
"""The line under the decision rule where a 1σ has few degrees of freedom."""
REFERENCES_OF = {
    "rotation": "reference inclinations", "toolface zero": "reference toolfaces", "scale": "reference strengths",
}  # fmt: skip
"""The references of a calibration run that determine a direction, by a word of its name."""
BETWEEN_SETS = "stations outside of roll sets"
VERDICT_RISK = "risk of a wrong verdict, all roll sets and limits together"

RAW_RULE = "A value marked raw is judged with its noise, as the readings do not follow a smooth curve over toolface"
"""The line under the decision rule where a raw figure was judged."""
FAR_BEYOND = 3.0
"""Values of more than this times their limit, in every roll set, point to the tool rather than to one station."""
WHOSE = "first check: is it this tool, and was it knocked or changed since?"


def screen(
    result: Verdict, signature: SignatureCheck | None, *metadata: Mapping[str, object]
) -> str:
    """The outcome first, then each limit.

    `signature` of the calibration's file, if there is one, `metadata` of calibration and run.
    """
    rows = []
    for row in result.rows:
        (value, sd), limit = noise_free(row, row.unit), quantity(row.limit, row.unit)
        raw = quantity(row.raw, row.unit, uncertainty=row.uncertainty)
        verdict = "pass" if row.passed else "FAIL"
        rows.append([row.name, raw, value, sd, freedom(row), limit, verdict, row.note])
    if _free_toolface(result):
        rows.append(["toolface", *["–"] * 5, "open", "zero undetermined"])
    outcome = outcome_of(result.passed, result.not_judged)
    if free := result.left_open:
        outcome += f": nothing wrong was found; the calibration leaves {free} open"
    first = [outcome, result.data, f"{result.stations} stations"]
    first += signature_status(signature) if signature else []
    first += simulated(*metadata)
    source = f" ({result.source})" if result.source else ""
    lines = [
        "   ".join(first),
        f"limits {result.limits}{source}",
        f"rule: {result.rule}",
    ]
    lines += filter(None, [raw_rule(result)])
    lines += [FREEDOM_RULE] * any(row[4][0].isdigit() for row in rows)
    lines += [SETTING_PRACTICES[result.settings]] if result.settings in SETTING_PRACTICES else []
    lines += [f"{VERDICT_RISK}: {risk}"] if (risk := verdict_risk(result)) else []
    header = ["", "raw", "noise-free", "1σ", FREEDOM, "limit", "", "where"]
    blocks = ["\n".join(map(one_line, lines)), table(rows, header, remarks=True), *_sets(result)]
    return "\n\n".join(blocks)


def outcome_of(passed: bool, not_judged: Sequence[str]) -> str:
    """The verdict in a word, with the names of the limits that it does not cover."""
    without = f" (not judged: {', '.join(not_judged)})" if not_judged else ""
    return ("PASS" if passed else "FAIL") + without


def risk_text(risk: float | None, not_judged: Sequence[str], raw: bool) -> str:
    """The risk of a verdict, or why it is not stated; empty where a limit cannot be passed. `raw`: one is judged."""
    if risk is not None:
        return chance(risk)
    if not_judged:
        return f"{NOT_STATED}, as limits were not judged"
    return f"{NOT_STATED}, as readings are not smooth over toolface" if raw else ""


def verdict_risk(result: Verdict) -> str:
    """The risk of a verdict, or why it is not stated."""
    return risk_text(result.risk, result.not_judged, bool(raw_rule(result)))


def _free_toolface(result: Verdict) -> bool:
    """Whether the calibration leaves the toolface zero undetermined, and no limit says so."""
    judged = any(row.name == "error of toolface" for row in result.rows)
    return not judged and any(finding.id == "toolface-zero" for finding in result.findings)


def next_step(result: Verdict, calibration: Path, run: Path) -> str:
    """Lines below a failed roll test: what to measure again, and the next command."""
    if result.passed:
        return ""
    again, command, reason = after_failure(result, calibration, run)
    return f"\n\n{again}\nnext: {command}   ({reason})"


def with_next_step(result: Verdict, calibration: Path, run: Path) -> Verdict:
    """The verdict with a finding `next-step` where it failed, for machines: files by name, wherever they lie."""
    if result.passed:
        return result
    again, command, reason = after_failure(result, Path(calibration.name), Path(run.name))
    text = f"{capital(again)}. Next: {command} ({reason})"
    return replace(result, findings=[*result.findings, Finding(id="next-step", text=text)])


def after_failure(
    result: Verdict, calibration: Path | str, run: Path | str
) -> tuple[str, str, str]:
    """Steps after a verdict: what to measure again or to add, the next command, and its purpose.

    Where values failed: each place once, and the fault that it looks like. Else no value could be stated.
    """
    record = one_line(shell_word(str(calibration)))
    failed = [row for row in result.rows if row.uncertainty is not None and not row.passed]
    places = dict.fromkeys(row.note.partition(";")[0] for row in failed)
    if places:
        tested = one_line(shell_word(str(run)))
        if sum(finding.id == "constant-error" for finding in result.findings) == len(failed):
            again = "nothing to measure again: correct the reference in the table"
            return again, f"mwdcal verify {record} {tested}", "with it"
        command = f"mwdcal diagnose {record} {tested}"
        again = f"measure again: {'; '.join(places)}"
        if any(finding.id == "harmonic-unseen" for finding in result.findings):
            again += ", at six or more toolfaces, evenly spread"
        if any(map(_far_everywhere, failed)):
            again = f"{WHOSE} Then {again}"
        return again, command, "what it looks like"
    if free := result.left_open:
        missing = [word for direction, word in REFERENCES_OF.items() if direction in free]
        again = f"not determined: {free}. Give {' and '.join(missing)} in the calibration run"
        return again, f"mwdcal calibrate RUN -o {record}", "with these references"
    again = "measure again: the roll test, with what is missing in it"
    return again, f"mwdcal verify {record} ROLLTEST.csv", "the new roll test"


def _far_everywhere(row: VerdictRow) -> bool:
    """Whether a value is far and clearly beyond its limit in every roll set: no single station explains that."""

    def far(each: JudgedSet) -> bool:
        doubt = 0.0 if each.judged_raw else COVERAGE * each.uncertainty
        return each.value > max(FAR_BEYOND * row.limit, row.limit + doubt)

    rolled = bool(row.sets) and all(each.coefficients is not None for each in row.sets)
    several = len(row.sets) > 1 or not row.judged_raw
    return rolled and several and all(map(far, row.sets))


def _sets(result: Verdict) -> list[str]:
    """The result of each roll set for each limit, where there are several."""
    rows = [
        [row.name, one_line(each.label or BETWEEN_SETS), *map(str, cells)]
        for row in result.rows
        if len(row.sets) > 1 and row.uncertainty is not None
        for each in row.sets
        for cells in [
            [
                quantity(each.raw, row.unit, uncertainty=each.uncertainty),
                *noise_free(each, row.unit),
                freedom(each),
            ]
        ]
    ]
    return (
        [table(rows, ["each roll set by itself", "", "raw", "noise-free", "1σ", FREEDOM])]
        if rows
        else []
    )


def raw_rule(result: Verdict) -> str:
    """The line under the decision rule if a raw figure was judged, else nothing."""
    return RAW_RULE * any(row.judged_raw for row in result.rows)


def noise_free(judged: VerdictRow | JudgedSet, symbol: str) -> tuple[str, str]:
    """Value and 1σ of a limit or roll set, both to two digits of the latter; or that it is not stated.

    A raw figure that was judged is marked.
    """
    if judged.uncertainty is None or judged.value is None:
        return quantity(judged.value, symbol), NOT_STATED
    value, sd = measured(judged.value, judged.uncertainty)
    return value + unit(symbol) + " raw" * judged.judged_raw, sd + unit(symbol)


def freedom(judged: VerdictRow | JudgedSet) -> str:
    """Degrees of freedom of the uncertainty of a limit or roll set: ∞ where the noise is declared."""
    if judged.uncertainty is None or judged.degrees_of_freedom is UNSET:
        return "–"
    many = judged.degrees_of_freedom is None or judged.degrees_of_freedom >= MANY
    return "∞" if many else f"{float(f'{judged.degrees_of_freedom:.3g}'):g}"
