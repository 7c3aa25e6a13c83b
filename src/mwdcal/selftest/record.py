"""The record of a selftest: outcome, cases, versions, machine and the files of the package; screen, page and PDF."""

from __future__ import annotations

import platform
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from importlib import metadata

import msgspec

from mwdcal import __version__
from mwdcal.digests import sha256_of
from mwdcal.files.profiles import PACKAGE
from mwdcal.presentation.certificate import (
    Cell,
    CertificateText,
    Column,
    FactList,
    FactsBlock,
    Mark,
    OutcomesBlock,
    Section,
    Signatory,
    SignaturesBlock,
    TableBlock,
    TestOutcome,
    TextBlock,
    plain,
)
from mwdcal.presentation.numbers import quantity
from mwdcal.presentation.text import one_line, plural, table
from mwdcal.selftest.cases import SelftestRow, cases

LIBRARIES = (
    "numpy", "scipy", "msgspec", "click", "rich", "numba", "pyarrow", "jinja2", "matplotlib", "typst", "cryptography",
    "pyhanko", "pygeomag", "pyproj", "sqlalchemy",
)  # fmt: skip
"""Libraries whose versions the record states, those that compute first."""
CASE_TITLES = ("case", "authority", "values", "first expected", "largest difference", "allowed", "")


OUTCOME_MARKS: dict[str, Mark] = {"PASS": "good", "FAIL": "bad", "not run": "free"}
"""How an outcome stands out."""
PURPOSE = (
    "Software validation on the machine of the laboratory (ISO/IEC 17025:2017, 7.11.2): published figures and second "
    "formulas against what this installation computes. It validates the computation, not a measurement."
)
MEANING_OF_ALLOWED = (
    "Largest difference: of all values of a case, from what the authority printed or the second formula gives. "
    "Allowed: by the digits that are printed, or 1e-9 of a closed form."
)
"""The purpose of the record, and the meaning of its table."""


class SelftestRecord(msgspec.Struct, frozen=True, kw_only=True):
    """The cases of a self-test, with its time, place and software; `passed` if no case failed.

    `package_sha256`: SHA-256 of the lines "digest  path" of all files of the package, by path.
    """

    schema_version: int = 1
    command: str = "selftest"
    passed: bool
    time: str
    mwdcal: str
    python: str
    machine: str
    libraries: dict[str, str]
    files: int
    package_sha256: str
    rows: list[SelftestRow]


def selftest() -> SelftestRecord:
    """Run every case on this machine."""
    rows = [case.run() for case in cases()]
    files = _files()
    return SelftestRecord(
        passed=not any(row.outcome == "FAIL" for row in rows),
        time=datetime.now(UTC).isoformat(timespec="seconds"),
        mwdcal=__version__,
        python=f"{platform.python_implementation()} {platform.python_version()}",
        machine=f"{platform.platform()}, {platform.machine()}, {sys.byteorder}-endian",
        libraries=dict(_versions()),
        files=len(files),
        package_sha256=sha256_of("".join(f"{digest}  {path}\n" for path, digest in files).encode()),
        rows=rows,
    )


def _files() -> list[tuple[str, str]]:
    """Path and SHA-256 of the files of the package, without what Python compiled of them."""
    paths = (
        path for path in PACKAGE.rglob("*") if path.is_file() and "__pycache__" not in path.parts
    )
    return sorted((path.relative_to(PACKAGE).as_posix(), sha256_of(path)) for path in paths)


def _versions() -> Iterator[tuple[str, str]]:
    for name in LIBRARIES:
        try:
            yield name, metadata.version(name)
        except metadata.PackageNotFoundError:
            yield name, "not installed"


def _cells(row: SelftestRow) -> list[str]:
    count = str(row.count) if row.count else "–"
    shown = "–" if row.expected is None else plain(row.expected)
    sizes = [quantity(size, row.unit, 2) for size in (row.difference, row.allowed)]
    return [row.name, row.authority, count, shown, *sizes, row.outcome]


def _summary(record: SelftestRecord) -> str:
    """How many cases passed, failed, and were not run."""
    counts = {
        word: sum(row.outcome == word for row in record.rows)
        for word in ("PASS", "FAIL", "not run")
    }
    said = [f"{counts['PASS']} of {plural(len(record.rows), 'case')} passed"]
    said += [
        f"{counts[word]} {shown}"
        for word, shown in (("FAIL", "failed"), ("not run", "not run"))
        if counts[word]
    ]
    return ", ".join(said)


def screen(record: SelftestRecord) -> str:
    """The outcome first, then each case, then what was tested."""
    outcome = "PASS" if record.passed else "FAIL"
    head = f"{outcome}   mwdcal {record.mwdcal}   {_summary(record)}   {record.time}"
    notes = [f"{row.outcome}: {row.name}: {one_line(row.note)}" for row in record.rows if row.note]
    libraries = "   ".join(f"{name} {v}" for name, v in record.libraries.items() if v[0].isdigit())
    where = [record.python, record.machine]
    files = f"{record.files} files of the package, SHA-256 {record.package_sha256}"
    after = (
        []
        if record.passed
        else ["next: install mwdcal anew in an empty environment, and run the selftest there"]
    )
    rows = [_cells(row) for row in record.rows]
    lines = [*notes, "   ".join(where), libraries, files, *after]
    return "\n\n".join([head, table(rows, [*CASE_TITLES], names=2), "\n".join(lines)])


def as_text(record: SelftestRecord) -> CertificateText:
    """The record in blocks, of which page and PDF are made."""
    digest = [("Files", [str(record.files)]), ("SHA-256", [record.package_sha256])]
    machine = [("Python", [record.python]), ("Machine", [record.machine]), ("Time", [record.time])]
    libraries = [(name, [version]) for name, version in record.libraries.items()]
    installation = [
        FactsBlock([FactList("Machine", machine), FactList("Libraries", libraries)]),
        FactsBlock([FactList("Package", digest)]),
    ]
    people = SignaturesBlock([Signatory("Run by", []), Signatory("Released by", [])])
    sections = [
        Section("outcome", "1\u2002Outcome", [_outcome(record), TextBlock([PURPOSE])]),
        Section("cases", "2\u2002Cases", [_cases(record)]),
        Section("installation", "3\u2002Installation", [*installation]),
        Section("release", "4\u2002Release for use", [people]),
    ]
    return CertificateText(
        title="Software validation",
        number=f"mwdcal {record.mwdcal}",
        issued=record.time[:10],
        simulated="",
        laboratory="Record of the selftest",
        laboratory_lines=[record.time],
        sections=sections,
        end=f"End of the record of {record.time}",
    )


def _outcome(record: SelftestRecord) -> OutcomesBlock:
    word = "PASS" if record.passed else "FAIL"
    return OutcomesBlock([TestOutcome(OUTCOME_MARKS[word], word, _summary(record), "")])


def _cases(record: SelftestRecord) -> TableBlock:
    columns = [Column(title, 2 <= place <= 5) for place, title in enumerate(CASE_TITLES)]
    rows = [
        [
            *(Cell([cell]) for cell in _cells(row)[:-1]),
            Cell([row.outcome], OUTCOME_MARKS[row.outcome]),
        ]
        for row in record.rows
    ]
    notes = [MEANING_OF_ALLOWED, *(f"{row.name}: {row.note}" for row in record.rows if row.note)]
    return TableBlock(columns, rows, notes=notes)
