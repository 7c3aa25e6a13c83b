"""A certificate for people, as text in blocks: page and PDF lay out the same words and numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import msgspec

from mwdcal.calibration.readings import SIMULATED
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
from mwdcal.presentation.certificate import EXACT_DIGITS, plain, probability, quantity_numbers
from mwdcal.presentation.numbers import UNDETERMINED, capital, contribution, measured, unit
from mwdcal.presentation.text import NOT_STATED, chance, escape_controls, plural
from mwdcal.sensor.profile import Person

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
    """A numbered section of the certificate."""

    id: str
    title: str
    blocks: list[Block]


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
    parts = [f"k = {factor:.2f}" if factor else "", _percent(covered) if covered else ""]
    return ", ".join(filter(None, parts))


def _cell(text: str, mark: Mark = "") -> Cell:
    return Cell([text], "free" if text in (UNDETERMINED, NOT_STATED) else mark)


# ------------------------------------------------------------------ sections


def _sections(certificate: Certificate, pictures: Sequence[Picture]) -> Iterator[Section]:
    """The sections in their order, those without contents left out."""
    each: list[tuple[str, str, Iterable[Block]]] = [
        ("item", "Item and customer", _item(certificate)),
        ("conformity", "Conformity, as found and as left", _conformity(certificate)),
        ("results", "Results", map(_results, certificate.results)),
        ("budget", "Uncertainty budget", [_budget(certificate.budget)]),
        ("method", "Method and conditions", _method(certificate)),
        ("traceability", "Metrological traceability", [_traceability(certificate.traceability)]),
        ("statements", "Statements and findings", _statements(certificate)),
        ("authorisation", "Authorisation", _authorisation(certificate)),
        ("files", "Files that this certificate rests on", _files(certificate)),
        ("pictures", "Pictures", (PictureBlock(p.id, p.title, p.alt, p.note) for p in pictures)),
    ]
    filled = [(key, title, blocks) for key, title, given in each if (blocks := list(given))]
    for place, (key, title, blocks) in enumerate(filled, 1):
        yield Section(key, f"{place}\u2002{title}", blocks)


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
    yield _decisions(tests)
    yield _test_facts(tests)
    findings = [f"{capital(t.when)}: {finding.text}" for t in tests for finding in t.findings]
    if findings:
        yield TextBlock(findings, "Findings of the roll tests", bullets=True)


def _outcome(test: ConformityTest) -> TestOutcome:
    missed = [each.quantity.name for each in test.decisions if not each.passed]
    count = plural(len(test.decisions), "limit")
    level: Mark = "good" if test.passed else "bad"
    headline = f"Pass – {count} met" if test.passed else f"Fail – {len(missed)} of {count} not met"
    if not test.passed and not missed:
        headline = "Fail"
    after = f"Not met: {', '.join(missed)}. " if missed else ""
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
        "Risk of a wrong verdict": lambda test: "" if test.risk is None else chance(test.risk),
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
    titles = ["value ± U; raw", *["acceptance limit"][:guarded], "decision", "P within; risk"]
    columns += [Column(title, True, title is titles[0]) for _ in tests for title in titles]
    groups = [("", 2), *((test.when, len(titles)) for test in tests)]
    by_test = [{_key(each): each for each in test.decisions} for test in tests]
    rows = []
    for key, each in keys.items():
        name, symbol = each.quantity, unit(each.quantity.unit)
        where = [name.name, *filter(None, [name.at])]
        row = [Cell(where), _cell(plain(each.limit) + symbol)]
        for decisions in by_test:
            row += _decision(decisions.get(key), guarded)
        rows.append(row)
    return TableBlock(columns, rows, groups=groups, notes=_decision_notes(tests))


def _key(decision: LimitDecision) -> tuple[str, str, str, float]:
    """The subjects of decisions: decisions of one key stand in one row."""
    quantity = decision.quantity
    return quantity.id, quantity.at, quantity.unit, decision.limit


def _decision(decision: LimitDecision | None, guarded: bool) -> list[Cell]:
    """Cells of one decision: value, acceptance limit, decision, probability and risk."""
    if decision is None:
        return [Cell(["–"])] * (4 if guarded else 3)
    value, _, expanded = quantity_numbers(decision.quantity)
    within, risk = decision.probability_within, decision.risk
    odds = [
        NOT_STATED if within is None else probability(within),
        f"risk {NOT_STATED if risk is None else chance(risk)}",
    ]
    shown = [f"± {expanded}"] if decision.quantity.expanded_uncertainty is not None else []
    symbol, most = unit(decision.quantity.unit), decision.acceptance_limit
    raw = measured(decision.raw or 0.0, decision.quantity.expanded_uncertainty)[0] + symbol
    noisy = [] if decision.raw is None else [f"raw {raw}"]
    accepted = (
        NOT_STATED
        if most is None
        else measured(most, decision.quantity.expanded_uncertainty)[0] + symbol
    )
    return [
        Cell([value, *(shown or [f"U {NOT_STATED}"]), *noisy]),
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


def _budget(budget: Budget) -> TableBlock:
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
        "Method": method.name,
        "Procedure": method.text,
        "Sensor model": method.model,
        "Stations": str(method.stations),
        "Software": method.software,
        "References": method.references,
        "Deviations": method.deviations or "none from the method",
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
    if certificate.findings:
        texts = [capital(finding.text) for finding in certificate.findings]
        yield TextBlock(texts, "Findings", bullets=True)


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
        "Check by": "mwdcal certificate verify, on the JSON of this certificate",
    }
    yield FactsBlock([_facts("Digital signature", facts)])


def _files(certificate: Certificate) -> Iterator[Block]:
    if not certificate.files:
        return
    columns = [Column("file"), Column("name"), Column("SHA-256")]
    cells = [[Cell([f.id]), Cell([f.name]), Cell([f.sha256], "code")] for f in certificate.files]
    yield TableBlock(columns, cells, notes=[f"Made by {certificate.software}."])
