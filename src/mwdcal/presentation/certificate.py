"""The numbers of a certificate as text: the same on screen, page and PDF.

A certificate on the screen: what it is of, its decisions with their risk, and its uncertainty budget.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from importlib import resources
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import msgspec

from mwdcal.calibration.readings import SIMULATED
from mwdcal.calibration.record import Calibration
from mwdcal.calibration.results import STATED_ANGLES
from mwdcal.certificate.decisions import PROBABILITY
from mwdcal.certificate.document import (
    Budget,
    BudgetLine,
    Certificate,
    ConformityTest,
    LimitDecision,
    Party,
    Quantity,
    ResultTable,
    TracedStandard,
)
from mwdcal.errors import shell_word
from mwdcal.files.documents import laid_out
from mwdcal.presentation.numbers import (
    UNDETERMINED,
    capital,
    contribution,
    exponent,
    files_written,
    fixed,
    measured,
    number,
    unit,
)
from mwdcal.presentation.numbers import quantity as in_unit
from mwdcal.presentation.page import environment, picture, require
from mwdcal.presentation.text import NOT_STATED, chance, escape_controls, one_line, plural, table
from mwdcal.presentation.verification import RAW_RULE, VERDICT_RISK, outcome_of, risk_text
from mwdcal.sensor.profile import Person
from mwdcal.use import plots as plots
from mwdcal.use.roll_test import RAW_JUDGED
from mwdcal.use.verification import Verdict

if TYPE_CHECKING:
    from markupsafe import Markup
    from matplotlib.figure import Figure

    from mwdcal.drift.document import ToolDrift

EXACT_DIGITS = 6
"""Significant digits of a number without uncertainty, at most."""
NEARLY_CERTAIN = 1e-6
"""A probability nearer to one than this is given as a bound."""


def quantity_numbers(quantity: Quantity, digits: int = EXACT_DIGITS) -> tuple[str, str, str]:
    """Value, standard and expanded uncertainty with their unit.

    Uncertainties have two significant digits, the value the last decimal place of the expanded one; a value
    without uncertainty has `digits` at most.
    """
    symbol = unit("" if quantity.unit == "1" else quantity.unit)
    value, u = quantity.value, quantity.standard_uncertainty
    widest = u if quantity.expanded_uncertainty is None else quantity.expanded_uncertainty
    blank = UNDETERMINED if value is None else NOT_STATED
    first, last = blank, None
    if value is not None:
        first, last = (
            measured(value, widest) if widest is not None else (plain(value, digits), None)
        )
        first += symbol
    stated = blank if u is None else _two_digits(u, last or "") + symbol
    if quantity.expanded_uncertainty is None:
        return first, stated, blank
    return first, stated, (last or number(widest, 2)) + symbol


def _two_digits(value: float, beside: str) -> str:
    """An uncertainty to two digits, with a power of ten only where the one beside it has one."""
    return (
        fixed(value, 1 - exponent(value))
        if value and "." in beside and "×" not in beside
        else number(value, 2)
    )


def plain(value: float, digits: int = EXACT_DIGITS) -> str:
    """A number as it was set, such as a limit, or to some significant digits."""
    text = f"{value:.{digits}g}".replace("-", "−")
    return number(value, digits) if "e" in text else text


def probability(value: float) -> str:
    """A probability with two significant digits of what is missing to one.

    >>> [probability(p) for p in (0.123, 0.99871, 1.0, 0.0)]
    ['0.12', '0.9987', '> 0.999999', '< 1e-9']
    """
    missing = 1 - value
    if missing > 0.5:
        return chance(value)
    if missing < NEARLY_CERTAIN:
        return f"> {1 - NEARLY_CERTAIN:.6f}"
    return f"{value:.{1 - exponent(missing)}f}"


ACCURACY_TABLE = "accuracy"
"""The id of the results that the first pages show."""
UNCERTAINTY = f"U {100 * PROBABILITY:.0f} %"
"""Title of expanded uncertainties on the screen."""
ASSUMED_EXACT = "exact"
"""In place of the share of a source that is assumed exact."""


def screen(certificate: Certificate, outputs: Sequence[Path]) -> str:
    """The certificate for people."""
    tests = [test for test in (certificate.as_found, certificate.as_left) if test]
    blocks = [
        "\n".join(map(one_line, heading(certificate))),
        *(_test(test) for test in tests),
        *([] if certificate.as_left else ["conformity was not tested"]),
        *_after_failed(certificate),
        _budget(certificate.budget),
        *(
            [files_written(**{path.suffix[1:].upper(): path for path in outputs})]
            if outputs
            else []
        ),
    ]
    return "\n\n".join(blocks)


def _after_failed(certificate: Certificate) -> Iterator[str]:
    """The next command where the roll test as left failed."""
    test = certificate.as_left
    if test and not test.passed:
        names = [file.name for file in certificate.files if file.id == "calibration"]
        files = " ".join(map(shell_word, (names[0] if names else "CAL.json", test.run)))
        yield f"next: mwdcal diagnose {one_line(files)}   (what the failure looks like)"


def heading(certificate: Certificate) -> list[str]:
    """Number and item, days, and who stands for it."""
    item, people = certificate.item, (certificate.measured_by, certificate.authorised_by)
    simulated = [SIMULATED] if certificate.simulated else []
    measured_by, authorised_by = (person.name if person else NOT_STATED for person in people)
    customer = certificate.customer.name if certificate.customer else NOT_STATED
    first = [f"certificate {certificate.number}", item.serial or NOT_STATED, item.type, *simulated]
    days = [f"calibrated {certificate.calibrated}", f"issued {certificate.issued}"]
    due = [f"next due {certificate.next_due}"] if certificate.next_due else []
    names = [f"customer {customer}", f"measured by {measured_by}", f"authorised by {authorised_by}"]
    return ["   ".join(parts) for parts in (first, days + due, names)]


def _test(test: ConformityTest) -> str:
    """A roll test: verdict, rule, and each decision with its risk."""
    outcome = outcome_of(test.passed, test.not_judged)
    lines = [
        f"{outcome}   {test.when}   {test.run}   limits {test.limits}",
        f"rule: {test.rule_text}",
        *([test.settings] if test.settings else []),
        *([f"{VERDICT_RISK}: {risk}"] if (risk := _risk(test)) else []),
    ]
    header = [
        "",
        "raw",
        "value",
        UNCERTAINTY,
        "limit",
        "accepted up to",
        "",
        "P within limit",
        "risk",
    ]
    rows = [_decision(decision) for decision in test.decisions]
    return "\n".join(map(one_line, lines)) + "\n\n" + table(rows, header)


def _risk(test: ConformityTest) -> str:
    """The risk of the verdict of a roll test, or why it is not stated."""
    return risk_text(test.risk, test.not_judged, any(map(_is_raw, test.decisions)))


def _decision(decision: LimitDecision) -> list[str]:
    quantity = decision.quantity
    value, expanded = _judged(decision)
    limits = (decision.limit, decision.acceptance_limit)
    shown = [in_unit(limit, quantity.unit) for limit in limits]
    shown[1] = "none" if _accepts_none(decision) else shown[1]
    verdict = "pass" if decision.passed else "FAIL"
    chances = [chance(p) for p in (decision.probability_within, decision.risk)]
    return [quantity.name, _raw(decision), value, expanded, *shown, verdict, *chances]


def _judged(decision: LimitDecision) -> tuple[str, str]:
    """The figure that was judged and its U, which a raw figure beyond its limit has not: its scatter is no noise."""
    quantity = decision.quantity
    value, _, expanded = quantity_numbers(quantity)
    if not _is_raw(decision):
        return value, expanded
    if quantity.value is not None and quantity.value > decision.limit:
        value = measured(quantity.value, quantity.standard_uncertainty)[0] + unit(quantity.unit)
        expanded = NOT_STATED
    return f"{value} raw", expanded


def _accepts_none(decision: LimitDecision) -> bool:
    """Whether the guard band is wider than the limit, so that no value is accepted."""
    return decision.acceptance_limit is not None and decision.acceptance_limit < 0


def _is_raw(decision: LimitDecision) -> bool:
    """Whether the raw figure was judged, as the readings are not smooth over toolface."""
    return RAW_JUDGED in decision.note


def _budget(budget: Budget) -> str:
    """The budget by source, with its sum and its expansion; no azimuth of a tool that has none."""
    lines = (*budget.lines, budget.combined, budget.expanded)
    names = [
        n
        for n in STATED_ANGLES
        if n != "azimuth" or any(line.azimuth_deg is not None for line in lines)
    ]
    rows = [_source(line, names, budget.combined) for line in lines]
    covered = f"k = {budget.coverage_factor:.3g}, {_percent(budget.coverage_probability)}"
    head = f"uncertainty budget (1σ), {budget.at}; {covered}"
    return f"{one_line(head)}\n{table(rows, ['', 'type', *names])}"


def _source(line: BudgetLine, names: Sequence[str], combined: BudgetLine) -> list[str]:
    total = line.id in ("combined", "expanded")
    keys = [f"{name}_deg" for name in names]
    shares = [_share(line, getattr(line, key), getattr(combined, key)) for key in keys]
    return [line.source, "" if total else line.kind, *shares]


def _share(line: BudgetLine, value: float | None, combined: float | None) -> str:
    """The contribution of a source to the uncertainty of an angle."""
    if line.basis.startswith("assumed exact"):
        return ASSUMED_EXACT
    return contribution(value, combined) + "°" * (value is not None)


# --------------------------------------------------------------------------
# A certificate for people, as text in blocks: page and PDF lay out the same words and numbers.


Mark: TypeAlias = Literal["", "good", "bad", "free", "key", "code"]
"""The cells that stand out: passed, failed or overdue, undetermined or not stated, a total, a digest."""


@dataclass(frozen=True)
class Picture:
    """A figure with its title, which needs no picture to be understood, and a note on how to read it.

    `id` is of letters, digits and hyphens.
    """

    id: str
    title: str
    figure: Figure
    note: str = ""

    @property
    def alt(self) -> str:
        """A description of the figure for readers who do not see it."""
        return str(self.figure.get_label()) or self.title


class Cell(msgspec.Struct, frozen=True):
    """A cell of a table: its lines, and how it stands out."""

    lines: list[str]
    mark: Mark = ""


class Column(msgspec.Struct, frozen=True):
    """A column of a table: of numbers or of words; `opens` a group of columns."""

    title: str
    number: bool = False
    opens: bool = False


class FactList(msgspec.Struct, frozen=True):
    """Labels and what each says, in lines."""

    title: str
    facts: list[tuple[str, list[str]]]


class FactsBlock(msgspec.Struct, frozen=True, tag="facts", tag_field="kind"):
    """Lists of facts side by side."""

    lists: list[FactList]


class TableBlock(msgspec.Struct, frozen=True, tag="table", tag_field="kind"):
    """A table, with a title above and notes below.

    `groups`: titles above groups of columns and how many each spans, where there are any; of all columns,
    those of no group with an empty title.
    """

    columns: list[Column]
    rows: list[list[Cell]]
    title: str = ""
    groups: list[tuple[str, int]] = []
    notes: list[str] = []


class TextBlock(msgspec.Struct, frozen=True, tag="text", tag_field="kind"):
    """Paragraphs, or the items of a list with a title."""

    texts: list[str]
    title: str = ""
    bullets: bool = False


class TestOutcome(msgspec.Struct, frozen=True):
    """The decision of one test in a box: level, word, headline and second line."""

    level: Mark
    word: str
    headline: str
    after: str


class OutcomesBlock(msgspec.Struct, frozen=True, tag="outcomes", tag_field="kind"):
    """Decisions side by side."""

    outcomes: list[TestOutcome]


class Signatory(msgspec.Struct, frozen=True):
    """A place to sign: in which role, and the lines that name the person."""

    role: str
    lines: list[str]


class SignaturesBlock(msgspec.Struct, frozen=True, tag="signatures", tag_field="kind"):
    """Places to sign, side by side."""

    people: list[Signatory]


class PictureBlock(msgspec.Struct, frozen=True, tag="picture", tag_field="kind"):
    """A picture by its id, with what it shows."""

    id: str
    title: str
    alt: str
    note: str = ""


Block: TypeAlias = (
    FactsBlock | TableBlock | TextBlock | OutcomesBlock | SignaturesBlock | PictureBlock
)


class Section(msgspec.Struct, frozen=True):
    """A numbered section of the certificate, or, by a letter, of its annex."""

    id: str
    title: str
    blocks: list[Block]
    annex: bool = False


class CertificateText(msgspec.Struct, frozen=True, kw_only=True):
    """A certificate as text: head, sections, and the line that ends it.

    `simulated` is empty, or what every page says.
    """

    title: str
    number: str
    issued: str
    simulated: str
    laboratory: str
    laboratory_lines: list[str]
    sections: list[Section]
    end: str


def mapped_texts(value: Any, each: Callable[[str], str]) -> Any:
    """Nested data with a function applied to every text, keys apart."""
    if isinstance(value, str):
        return each(value)
    if isinstance(value, dict):
        return {key: mapped_texts(item, each) for key, item in value.items()}
    return (
        [mapped_texts(item, each) for item in value] if isinstance(value, list | tuple) else value
    )


RESULT_DIGITS = 3
"""Significant digits of a result without uncertainty, such as the mean of errors."""
_NOT_STATED_CELL = Cell([NOT_STATED], "free")


def certificate_text(certificate: Certificate, pictures: Sequence[Picture] = ()) -> CertificateText:
    """The certificate in words: the same for every form, harmless in any of them."""
    simulated = f"{SIMULATED} – this certificate describes no real tool"
    name, lines = _laboratory(certificate.laboratory)
    text = CertificateText(
        title=certificate.title,
        number=certificate.number,
        issued=certificate.issued,
        simulated=simulated if certificate.simulated else "",
        laboratory=name,
        laboratory_lines=lines,
        sections=list(_sections(certificate, pictures)),
        end=f"End of certificate {certificate.number}",
    )
    return msgspec.convert(
        mapped_texts(msgspec.to_builtins(text), escape_controls), CertificateText
    )


def _percent(share: float) -> str:
    return f"{100 * share:.4g} %"


def _coverage(factor: float | None, covered: float | None) -> str:
    """Coverage factor and probability: k = 2.00, 95.45 %."""
    parts = [f"k\u00a0=\u00a0{factor:.2f}" if factor else "", _percent(covered) if covered else ""]
    return ", ".join(filter(None, parts))


def _cell(text: str, mark: Mark = "") -> Cell:
    return Cell([text], "free" if text in (UNDETERMINED, NOT_STATED) else mark)


# ------------------------------------------------------------------ sections


def _sections(certificate: Certificate, pictures: Sequence[Picture]) -> Iterator[Section]:
    """The sections in their order, those without contents left out: what a customer asks for, then the annex."""
    main: list[tuple[str, str, Iterable[Block]]] = [
        ("item", "Item and customer", _item(certificate)),
        ("conformity", "Conformity, as found and as left", _conformity(certificate)),
        ("results", "Expanded uncertainty of corrected angles", _accuracy_by_angle(certificate)),
        ("method", "Method", _method(certificate)),
        ("traceability", "Metrological traceability", [_traceability(certificate.traceability)]),
        ("statements", "Statements", _statements(certificate)),
        ("authorisation", "Authorisation", _authorisation(certificate)),
    ]
    annex: list[tuple[str, str, Iterable[Block]]] = [
        ("tables", "Results", map(_results, certificate.results)),
        ("decisions", "Roll tests and their decisions", _decided(certificate)),
        ("budget", "Uncertainty budget", [_budget_block(certificate.budget)]),
        ("conditions", "Procedure and conditions", _conditions(certificate)),
        ("remarks", "Remarks on the results", _remarks(certificate)),
        ("files", "Files that this certificate rests on", _files(certificate)),
        ("pictures", "Pictures", (PictureBlock(p.id, p.title, p.alt, p.note) for p in pictures)),
    ]
    for marks, sections in (("123456789", main), ("ABCDEFGHI", annex)):
        filled = [(key, title, blocks) for key, title, given in sections if (blocks := list(given))]
        for mark, (key, title, blocks) in zip(marks, filled, strict=False):
            yield Section(key, f"{mark}\u2002{title}", blocks, sections is annex)


FOR_THE_LABORATORY = re.compile(
    r"`|--|\[[a-z]+\]|mwdcal|\.toml|profile|json|^(add|average|calibrate|check|correct|declare|give|install|leave|measure|"
    r"name|re-shoot|save|see|state|take|use|verify|what the failure)\b",
    re.IGNORECASE,
)
"""Words by which advice to the laboratory is told from a statement about the result."""


def without_advice(text: str) -> str:
    """The statement of a finding without its advice to the laboratory on the program; empty if nothing is left.

    >>> without_advice("assumed exact: dip reference. State its uncertainty in [stand] of the tool profile.")
    'assumed exact: dip reference.'
    """
    sentences = re.split(r"(?<=[.?;]) +", text)
    return " ".join(each for each in sentences if not FOR_THE_LABORATORY.search(each))


def _accuracy_by_angle(certificate: Certificate) -> Iterator[Block]:
    """U of each angle, an attitude in each row."""
    for result in certificate.results:
        if result.id != ACCURACY_TABLE:
            continue
        names = list(dict.fromkeys(q.name for q in result.quantities))
        places = list(dict.fromkeys(q.at for q in result.quantities))
        shown = {(q.at, q.name): quantity_numbers(q)[2] for q in result.quantities}
        rows = [
            [Cell([at]), *(_cell(shown.get((at, name), NOT_STATED)) for name in names)]
            for at in places
        ]
        titles = [
            f"U, {name.removeprefix('error of ').removesuffix(' after correction')}"
            for name in names
        ]
        columns = [Column("at"), *(Column(title, True) for title in titles)]
        notes = [f"{result.note} {_coverages(result.quantities)}."]
        yield TableBlock(columns, rows, notes=notes)


def _laboratory(party: Party | None) -> tuple[str, list[str]]:
    """Name of the laboratory, and the lines below it."""
    if party is None:
        return "Laboratory not stated", []
    accredited = f"Accreditation: {party.accreditation}" if party.accreditation else ""
    return party.name, list(
        filter(None, [*party.address, party.country, party.contact, accredited])
    )


def _facts(title: str, facts: Mapping[str, str | Sequence[str]]) -> FactList:
    """Facts, without those that are empty."""
    lines = {name: [said] if isinstance(said, str) else [*said] for name, said in facts.items()}
    return FactList(title, [(name, said) for name, said in lines.items() if any(said)])


def _item(certificate: Certificate) -> Iterator[Block]:
    item, customer = certificate.item, certificate.customer
    identified = {capital(name): said for name, said in item.identification.items()}
    facts = _facts(
        "Item",
        {
            "Type": item.type or NOT_STATED,
            "Serial number": item.serial or NOT_STATED,
            "Manufacturer": item.manufacturer,
            **identified,
            "Condition": item.condition,
        },
    )
    lines = _laboratory(customer)[1] if customer else []
    dates = {
        "Customer": [customer.name if customer else NOT_STATED, *lines],
        "Received": item.received,
        "Calibrated": certificate.calibrated or NOT_STATED,
        "At": certificate.place or NOT_STATED,
        "Issued": certificate.issued or NOT_STATED,
        "Next due": certificate.next_due or NOT_STATED,
    }
    yield FactsBlock([facts, _facts("Customer and dates", dates)])


def _tests(certificate: Certificate) -> list[ConformityTest]:
    return [test for test in (certificate.as_found, certificate.as_left) if test is not None]


def _conformity(certificate: Certificate) -> Iterator[Block]:
    """Both decisions, what each rests on, and the decision on each limit, side by side."""
    tests = _tests(certificate)
    if not tests:
        text = "No roll test: nothing is stated about conformity, as found or as left."
        yield TextBlock([text])
        return
    yield OutcomesBlock([_outcome(test) for test in tests])
    for test in tests:
        yield _limits(test)


def _limits(test: ConformityTest) -> TableBlock:
    """Each limit of a test: the noise-free value ± U, the raw figure beside it, and the decision."""
    titles = ("limit", "noise-free value", "U", "raw", "decision")
    columns = [
        Column("limit on"),
        *(Column(title, True) for title in titles[:-1]),
        Column(titles[-1]),
    ]
    rows = []
    for each in test.decisions:
        value, expanded = _judged(each)
        passed = Cell(["PASS" if each.passed else "FAIL"], "good" if each.passed else "bad")
        limit = plain(each.limit) + unit(each.quantity.unit)
        rows.append(
            [Cell([each.quantity.name]), *map(_cell, (limit, value, expanded, _raw(each))), passed]
        )
    covered = _coverages([each.quantity for each in test.decisions])
    noted = f"Roll test of {test.date or 'a day that is not stated'}, {test.stations} stations. "
    meant = "Raw: with the noise of the readings in it; the noise-free value is judged"
    notes = [f"{noted}{meant}; U: {covered}.", *_raw_rule([test])]
    return TableBlock(columns, rows, capital(test.when), notes=notes)


def _raw_rule(tests: Sequence[ConformityTest]) -> list[str]:
    """The note on raw figures that were judged, if there are any."""
    said = (
        f"{RAW_RULE}. Its U has the few degrees of freedom of this scatter, hence a large k; beyond its limit it has "
        "no U, as this scatter is not noise."
    )
    return [said] * any(_is_raw(each) for test in tests for each in test.decisions)


def _raw(decision: LimitDecision) -> str:
    """The figure with the noise in it, to the digits of the value."""
    if decision.raw is None:
        return NOT_STATED
    if _is_raw(decision):
        return _judged(decision)[0].removesuffix(" raw")
    shown = measured(decision.raw, decision.quantity.expanded_uncertainty)[0]
    return shown + unit(decision.quantity.unit)


def _decided(certificate: Certificate) -> Iterator[Block]:
    """The basis of each test, and the decision on each limit with its risk, side by side."""
    tests = _tests(certificate)
    if tests:
        yield _test_facts(tests)
        yield _decisions(tests)


def _outcome(test: ConformityTest) -> TestOutcome:
    missed = [each.quantity.name for each in test.decisions if not each.passed]
    count = plural(len(test.decisions), "limit")
    level: Mark = "good" if test.passed else "bad"
    headline = f"Pass – {count} met" if test.passed else f"Fail – {len(missed)} of {count} not met"
    if not test.passed and not missed:
        headline = "Fail"
    headline += f", {len(test.not_judged)} not judged" if test.not_judged else ""
    after = f"Not met: {', '.join(missed)}. " if missed else ""
    after += f"Not judged: {', '.join(test.not_judged)}. " if test.not_judged else ""
    return TestOutcome(level, test.when, headline, f"{after}Decision rule: {test.rule}.")


def _test_facts(tests: Sequence[ConformityTest]) -> TableBlock:
    """The subject of each roll test, a test in each column."""
    digest = "Calibration applied, SHA-256"
    facts: dict[str, Callable[[ConformityTest], str]] = {
        "Date": lambda test: test.date,
        "Readings": lambda test: test.run,
        "Stations": lambda test: str(test.stations),
        "Limits": lambda test: test.limits,
        "Source of the limits": lambda test: test.source,
        "Decision rule": lambda test: test.rule_text or test.rule,
        "Setting of the stand": lambda test: test.settings,
        "Risk of a wrong verdict": _risk,
        digest: lambda test: test.calibration_sha256,
    }
    rows = {name: [fact(test) for test in tests] for name, fact in facts.items()}
    columns = [Column("roll test"), *(Column(test.when) for test in tests)]
    cells = [
        [
            Cell([name]),
            *(_cell(text or NOT_STATED, "code" if name == digest else "") for text in said),
        ]
        for name, said in rows.items()
        if any(said)
    ]
    return TableBlock(columns, cells)


def _decisions(tests: Sequence[ConformityTest]) -> TableBlock:
    """Every limit with its decision as found and as left."""
    keys = {_key(each): each for each in chain(*(test.decisions for test in tests))}
    guarded = any(each.acceptance_limit not in (None, each.limit) for each in keys.values())
    columns = [Column("limit on"), Column("limit", number=True)]
    titles = ["value ± U", *["acceptance limit"][:guarded], "decision", "P within; risk"]
    columns += [Column(title, True, title is titles[0]) for _ in tests for title in titles]
    groups = [("", 2), *((test.when, len(titles)) for test in tests)]
    by_test = [{_key(each): each for each in test.decisions} for test in tests]
    rows = []
    for key, each in keys.items():
        name, symbol = each.quantity, unit(each.quantity.unit)
        where = [name.name, *filter(None, [name.at])]
        row = [Cell(where), _cell(plain(each.limit) + symbol)]
        for decisions in by_test:
            row += _decision_cells(decisions.get(key), guarded)
        rows.append(row)
    return TableBlock(columns, rows, groups=groups, notes=_decision_notes(tests))


def _key(decision: LimitDecision) -> tuple[str, str, str, float]:
    """The subjects of decisions: decisions of one key stand in one row."""
    quantity = decision.quantity
    return quantity.id, quantity.at, quantity.unit, decision.limit


def _decision_cells(decision: LimitDecision | None, guarded: bool) -> list[Cell]:
    """Cells of one decision: value, acceptance limit, decision, probability and risk."""
    if decision is None:
        return [Cell(["–"])] * (4 if guarded else 3)
    value, expanded = _judged(decision)
    unknown = expanded in (UNDETERMINED, NOT_STATED)
    within, risk = decision.probability_within, decision.risk
    odds = [
        NOT_STATED if within is None else probability(within),
        f"risk {NOT_STATED if risk is None else chance(risk)}",
    ]
    symbol, most = unit(decision.quantity.unit), decision.acceptance_limit
    accepted = "none" if _accepts_none(decision) else NOT_STATED
    if most is not None and most >= 0:
        accepted = measured(most, decision.quantity.expanded_uncertainty)[0] + symbol
    return [
        Cell([value, f"U {NOT_STATED}" if unknown else f"± {expanded}"]),
        *([_cell(accepted)] if guarded else []),
        Cell(["PASS" if decision.passed else "FAIL"], "good" if decision.passed else "bad"),
        Cell(odds if within is not None or risk is not None else [NOT_STATED]),
    ]


def _decision_notes(tests: Sequence[ConformityTest]) -> list[str]:
    """The meaning of the table of decisions, and the remarks on single decisions."""
    each = [(test.when, decision) for test in tests for decision in test.decisions]
    factors = {test.when: _coverages([d.quantity for d in test.decisions]) for test in tests}
    apart = len(set(factors.values())) > 1
    said = [f"{when}: {factor}" if apart else factor for when, factor in factors.items() if factor]
    covered = "; ".join(dict.fromkeys(said))
    notes = [
        f"U: expanded uncertainty{f' ({covered})' if covered else ''}. Decisions are by the rule stated below, on "
        "values that are not rounded. P within: probability that the true value is within the limit, given "
        "the value and its uncertainty; risk: of a wrong decision."
    ]
    notes += _raw_rule(tests)
    notes += [f"{capital(when)}, {d.quantity.name}: {d.note}" for when, d in each if d.note]
    return notes


def _coverages(quantities: Iterable[Quantity]) -> str:
    """Coverage factors and probabilities that occur."""
    said = (_coverage(q.coverage_factor, q.coverage_probability) for q in quantities)
    return "; ".join(dict.fromkeys(filter(None, said)))


def _results(table: ResultTable) -> TableBlock:
    return quantity_table(table.quantities, table.title, table.note, RESULT_DIGITS)


def quantity_table(
    quantities: Sequence[Quantity], title: str, note: str = "", digits: int = EXACT_DIGITS
) -> TableBlock:
    """Quantities with values and uncertainties; columns of which nothing is stated are left out."""
    covered = [_coverage(q.coverage_factor, q.coverage_probability) for q in quantities]
    coverages = _coverages(quantities)
    stated = {
        "at": any(q.at for q in quantities),
        "u": any(q.standard_uncertainty is not None for q in quantities),
        "U": any(q.expanded_uncertainty is not None for q in quantities),
        "k, coverage": len(set(covered) - {""}) > 1,
    }
    rows = []
    for q, coverage in zip(quantities, covered, strict=True):
        value, u, expanded = quantity_numbers(q, digits)
        cells = {"at": q.at or "–", "u": u, "U": expanded, "k, coverage": coverage or NOT_STATED}
        shown = [_cell(value), *(_cell(cells[name]) for name in stated if stated[name])]
        rows.append([Cell([q.name]), *shown])
    order = [Column("quantity"), Column("value", True)]
    order += [Column(name, name != "at") for name in stated if stated[name]]
    if stated["at"]:
        order.insert(1, order.pop(2))
        rows = [[row[0], row[2], row[1], *row[3:]] for row in rows]
    meant = "u: standard uncertainty" if stated["u"] else ""
    if stated["U"]:
        meant += f"{'; ' if meant else ''}U: expanded uncertainty"
        meant += f", {coverages}" if coverages and not stated["k, coverage"] else ""
    notes = [note, f"{meant}." if meant else ""]
    return TableBlock(order, rows, title, notes=[*filter(None, notes)])


def _budget_block(budget: Budget) -> TableBlock:
    """Sources and their contributions to each angle, their combination, and its expansion."""
    every = [*budget.lines, budget.combined, budget.expanded]
    angles = ["inclination", "toolface", "azimuth"]
    if all(line.azimuth_deg is None for line in every):
        angles.remove("azimuth")
    columns = [Column("source"), Column("type"), Column("basis")]
    columns += [Column(f"u of {angle}", number=True) for angle in angles]
    rows = [
        [
            *(Cell([text]) for text in (line.source, line.kind, line.basis)),
            *_angles(line, angles, budget.combined),
        ]
        for line in budget.lines
    ]
    for line in every[-2:]:
        name = [Cell([line.source], "key"), Cell([""]), Cell([line.basis], "key")]
        rows.append([*name, *_angles(line, angles, line, "key")])
    coverage = _coverage(budget.coverage_factor, budget.coverage_probability)
    note = (
        "Standard uncertainties; type A by statistics of the readings, type B otherwise. The last line is the expanded "
        f"uncertainty, {coverage}."
    )
    return TableBlock(columns, rows, f"At {budget.at}" if budget.at else "", notes=[note])


def _angles(
    line: BudgetLine, angles: Sequence[str], combined: BudgetLine, mark: Mark = ""
) -> Iterator[Cell]:
    for angle in angles:
        value, total = (getattr(each, f"{angle}_deg") for each in (line, combined))
        yield _cell(contribution(value, total) + unit("°") * (value is not None), mark)


def _method(certificate: Certificate) -> Iterator[Block]:
    method = certificate.method
    facts = {
        "Procedure": method.text,
        "Stations": str(method.stations),
        "Deviations": method.deviations or "none from the method",
    }
    yield FactsBlock([_facts("", facts)])


def _conditions(certificate: Certificate) -> Iterator[Block]:
    method = certificate.method
    facts = {
        "Method": method.name,
        "Sensor model": method.model,
        "Software": method.software,
        "References": method.references,
    }
    yield FactsBlock([_facts("", facts)])
    if certificate.conditions:
        yield quantity_table(certificate.conditions, "Conditions")


def _traceability(standards: Sequence[TracedStandard]) -> Block:
    if not standards:
        return TextBlock(
            ["No measurement standard is stated: the results are not shown to be traceable."]
        )
    titles = ["quantity", "standard", "certificate", "date", "due", "u"]
    rows = []
    for each in standards:
        serial = f"serial {each.serial}" if each.serial else ""
        by = f"by {each.issuer}" if each.issuer else ""
        due = Cell([each.due or NOT_STATED, "OVERDUE"], "bad") if each.overdue else None
        rows.append(
            [
                Cell([each.quantity]),
                Cell([each.name, *filter(None, [serial])]),
                Cell([*filter(None, [each.certificate, by])])
                if each.certificate or by
                else _NOT_STATED_CELL,
                _cell(each.date or NOT_STATED),
                due or _cell(each.due or NOT_STATED),
                _cell(each.standard_uncertainty or NOT_STATED),
            ]
        )
    return TableBlock([Column(title) for title in titles], rows, notes=["u: standard uncertainty."])


def _statements(certificate: Certificate) -> Iterator[Block]:
    if certificate.statements:
        yield TextBlock(certificate.statements)


def _remarks(certificate: Certificate) -> Iterator[Block]:
    """The statements of the findings about the results, without advice that only the laboratory needs."""
    remarks = [without_advice(finding.text) for finding in certificate.findings]
    for test in _tests(certificate):
        about = (without_advice(finding.text) for finding in test.findings)
        remarks += [f"{test.when}: {text}" for text in about if text]
    if texts := [capital(text) for text in remarks if text]:
        yield TextBlock(texts, bullets=True)


def _person(role: str, person: Person | None) -> Signatory:
    return Signatory(role, [*filter(None, [person.name, person.function])] if person else [])


def _authorisation(certificate: Certificate) -> Iterator[Block]:
    people = {"Measured by": certificate.measured_by, "Authorised by": certificate.authorised_by}
    yield SignaturesBlock([_person(role, person) for role, person in people.items()])
    signature = certificate.signature
    if isinstance(signature, msgspec.UnsetType):
        return
    facts = {
        "Algorithm": signature.algorithm,
        "Key": signature.key,
        "Time": signature.time,
        "Value": signature.value,
        "Covers": "the JSON that is attached to the PDF of this certificate",
    }
    yield FactsBlock([_facts("Digital signature", facts)])


def _files(certificate: Certificate) -> Iterator[Block]:
    if not certificate.files:
        return
    columns = [Column("file"), Column("name"), Column("SHA-256")]
    cells = [[Cell([f.id]), Cell([f.name]), Cell([f.sha256], "code")] for f in certificate.files]
    yield TableBlock(columns, cells, notes=[f"Made by {certificate.software}."])


# --------------------------------------------------------------------------
# The certificate as one HTML file that needs nothing else, and as PDF/A-3, set by typst, with its JSON attached.
#
# Its pictures are drawn from the calibration and the roll tests behind it.
#
# Only the fonts that typst brings are used: the same input, and the same version of typst, give the same bytes.


def certificate_pictures(
    calibration: Calibration,
    as_left: Verdict | None = None,
    as_found: Verdict | None = None,
    drift: ToolDrift | None = None,
) -> list[Picture]:
    """Pictures of the results: errors before and after, residuals, 1σ, roll tests, earlier calibrations."""
    tests = _roll_tests(as_found, as_left)
    return [*_fit(calibration), *_accuracy(calibration), *tests, *_past(drift)]


def _past(drift: ToolDrift | None) -> Iterator[Picture]:
    if drift is None:
        return
    from mwdcal.presentation.drift import drift_picture

    note = (
        "Differences from the first calibration, with 95 % bars. Pale columns: control limits, three standard "
        "deviations of what both uncertainties and the random walk allow. Dashed: a change that the uncertainties do "
        "not explain."
    )
    yield Picture("drift", "Biases from calibration to calibration", drift_picture(drift), note)


def _fit(calibration: Calibration) -> Iterator[Picture]:
    if calibration.errors:
        for before, when in ((False, "after"), (True, "before")):
            title = f"Errors at each station, {when} calibration"
            yield Picture(f"errors-{when}", title, calibration.plot.errors_of_all(before))
    if calibration.station_rows:
        title = "Residuals: misfit of each station"
        note = "A station above the dashed line should be measured again."
        yield Picture("residuals", title, calibration.plot.deviations(), note)


def _accuracy(calibration: Calibration) -> Iterator[Picture]:
    note = "Standard uncertainty, typical over toolface and azimuth."
    title = "Standard uncertainty (1σ) over inclination"
    band = f"{note} Band: from the best to the worst azimuth."
    yield Picture("accuracy", title, calibration.plot.accuracy(), band)
    if calibration.plot.over_temperature:
        title = "Standard uncertainty (1σ) over temperature, at 45° inclination"
        figure = calibration.plot.accuracy_over_temperature()
        yield Picture("accuracy-temperature", title, figure, note)


def _roll_tests(as_found: Verdict | None, as_left: Verdict | None) -> Iterator[Picture]:
    note = "Markers: stations, noise included. Curves: mean and harmonics over a turn of toolface."
    for when, verdict in (("as found", as_found), ("as left", as_left)):
        if verdict is not None and any(row.sets for row in verdict.rows):
            title = f"Roll test {when}: departures over toolface"
            yield Picture(when.replace(" ", "-"), title, verdict.plot.toolface(), note)


LONGEST_WORD = 16
"""A longer word may break every `BREAKS` characters."""
BREAKS = 8


def render_page(certificate: Certificate, pictures: Sequence[Picture] = ()) -> str:
    """The certificate as HTML: the same input gives the same text, byte for byte."""
    return text_as_page(certificate_text(certificate, pictures), pictures)


def text_as_page(text: CertificateText, pictures: Sequence[Picture] = ()) -> str:
    """A document in blocks as HTML."""
    templates = environment()
    templates.filters["breakable"] = breakable
    template = templates.get_template("certificate.html")
    shown = {picture.id: picture.figure for picture in pictures}
    return template.render(text=msgspec.to_builtins(text), simulated=text.simulated, figures=shown)


def breakable(text: str) -> Markup:
    """Text as HTML that may break inside words too long for a narrow column, but not in dates and short names."""
    from markupsafe import Markup, escape

    def markup(word: str) -> Markup:
        if len(word) > LONGEST_WORD:
            parts = (word[start : start + BREAKS] for start in range(0, len(word), BREAKS))
            return Markup("<wbr>").join(map(escape, parts))
        return Markup("<span class=whole>{}</span>").format(word) if "-" in word else escape(word)

    return Markup(" ").join(map(markup, text.split(" ")))


STANDARD: Literal["a-3a"] = "a-3a"
"""Of PDF: for archives, tagged for readers of screens, with files attached."""
SHOW = b"""#set document(title: "text")
#set text(font: json(bytes(sys.inputs.fonts)), fallback: false)
#sys.inputs.text"""
"""A document of nothing but a text."""
FONTS = ("Libertinus Serif", "DejaVu Sans Mono", "New Computer Modern", "New Computer Modern Math")
"""Those that typst brings, in the order in which a character is looked for."""
SCRIPTS = ((0x80, 0x530), (0x1E00, 0x2C00))
"""Latin, Greek and Cyrillic letters, and signs: what these fonts have, and where they are asked."""


def render_pdf(
    certificate: Certificate, pictures: Sequence[Picture] = (), attached: bytes = b""
) -> bytes:
    """The certificate as PDF: the same input gives the same bytes.

    `attached`: its JSON as it was signed, else as it is.

    Characters that no font has are shown by their code, such as [U+4E2D]; the attached JSON has them as
    they are.

    Raises:
        InputError: typst is not installed.
    """
    whole = attached or laid_out(msgspec.json.encode(certificate))
    stamp = _timestamp(certificate.issued, certificate.calibrated)
    return text_as_pdf(certificate_text(certificate, pictures), whole, stamp, pictures)


def text_as_pdf(
    document: CertificateText, attached: bytes, timestamp: int, pictures: Sequence[Picture] = ()
) -> bytes:
    """A document in blocks as PDF, with its JSON attached; `timestamp` in seconds since 1970.

    Raises:
        InputError: typst is not installed.
    """
    require("a certificate as PDF", "typst", extra="certificate")
    text = msgspec.to_builtins(document)
    characters = _characters(text)
    odd = frozenset(filter(_odd, characters))
    lacking = odd | _lacking("".join(sorted(characters - odd)))
    shown = mapped_texts(text, partial(_by_code, lacking))
    template = resources.files("mwdcal.presentation").joinpath("templates", "certificate.typ")
    return _compiled(
        template.read_bytes(),
        timestamp,
        text=_json(shown),
        pictures=_json({each.id: picture(each.figure, ".svg").decode() for each in pictures}),
        certificate=attached.decode(),
    )


def _json(data: Any) -> str:
    return msgspec.json.encode(data).decode()


def _compiled(source: bytes, timestamp: int, **inputs: str) -> bytes:
    import typst

    result: bytes = typst.compile(
        source,
        format="pdf",
        ignore_system_fonts=True,
        sys_inputs=inputs | {"fonts": _json(FONTS)},
        pdf_standards=[STANDARD],
        timestamp=timestamp,
    )
    return result


def _timestamp(*days: str) -> int:
    """The first day that is a date in seconds since 1970; 0 where none is."""
    for stated in days:
        try:
            day = datetime.fromisoformat(stated)
        except ValueError:
            continue
        return max(int(day.replace(tzinfo=day.tzinfo or UTC).timestamp()), 0)
    return 0


def _characters(data: Any) -> set[str]:
    """The characters beyond ASCII of all texts."""
    characters: set[str] = set()

    def gather(text: str) -> str:
        characters.update(c for c in text if not c.isascii())
        return text

    mapped_texts(data, gather)
    return characters


def _odd(character: str) -> bool:
    """Whether it is of another script, or not printed; typst fails on some of these next to others."""
    of_ours = any(low <= ord(character) < high for low, high in SCRIPTS)
    return not of_ours or unicodedata.category(character).startswith("C")


def _lacking(characters: str) -> frozenset[str]:
    """Those characters that no font of typst has, by halves: a text is refused that has one."""
    import typst

    if not characters:
        return frozenset()
    try:
        _compiled(SHOW, 0, text=" ".join(characters))
    except typst.TypstError:
        if len(characters) == 1:
            return frozenset(characters)
        middle = len(characters) // 2
        return _lacking(characters[:middle]) | _lacking(characters[middle:])
    return frozenset()


def _by_code(lacking: frozenset[str], text: str) -> str:
    """The text with the code in place of characters that cannot be shown."""
    return "".join(f"[U+{ord(c):04X}]" if c in lacking else c for c in text)
