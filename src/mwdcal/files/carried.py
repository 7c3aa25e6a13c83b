"""The findings about the columns that were only copied into it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from mwdcal.calibration.record import Finding
from mwdcal.files.contract import RANGES
from mwdcal.files.formats.columns import Column, plain_names, shown
from mwdcal.files.formats.text import is_formula

_RENAMING = (".csv", ".tsv", ".xlsx")
"""Suffixes of formats in which the name of a column is one line of a table."""
NAMED = 10
"""Most columns that a finding names."""


def copied(names: Sequence[str], formulas: Collection[str], suffix: str) -> list[Finding]:
    """Columns that a table of this format has under another name, and those with formulas."""
    plain = plain_names(names) if suffix in _RENAMING else names
    renamed = [
        f"{shown(old)} is {shown(new)}" for old, new in zip(names, plain, strict=True) if old != new
    ]
    findings = []
    if renamed:
        text = f"columns renamed, as the format does not have such names: {_listed(renamed)}."
        findings.append(Finding(id="renamed-columns", text=text))
    if formulas:
        text = (
            "spreadsheet programs may run cells as formulas, which begin with =, +, -, @ or a tab "
            f"and are written as they are: {_listed([shown(n) for n in names if n in formulas])}."
        )
        findings.append(Finding(id="formula-cells", text=text))
    return findings


def _listed(entries: Sequence[str]) -> str:
    more = f" and {len(entries) - NAMED} more" if len(entries) > NAMED else ""
    return ", ".join(entries[:NAMED]) + more


def with_formulas(columns: Mapping[str, Column]) -> list[str]:
    """Columns with a name or a text cell that spreadsheet programs would run as a formula."""
    return [
        name
        for name, cells in columns.items()
        if name not in RANGES
        and (is_formula(name) or (isinstance(cells, list) and any(map(is_formula, cells))))
    ]


def stated_findings(metadata: Mapping[str, object]) -> list[str]:
    """The findings that a table's metadata state already."""
    stated = metadata.get("findings")
    if stated is None:
        return []
    return [str(each) for each in stated] if isinstance(stated, list) else [str(stated)]
