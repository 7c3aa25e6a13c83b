"""Digital calibration certificates: valid by PTB's schema, and two of its clients read every number back."""

import base64
import json
import math
import types
import typing
import warnings
from datetime import date
from xml.etree import ElementTree

import msgspec
import pytest
from hypothesis import HealthCheck, Phase, example, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

import dcc_clients
from cli_support import EXAMPLE, mwdcal
from dcc_clients import NAMESPACES, with_schema
from mwdcal.calibration.record import Finding
from mwdcal.certificate.dcc import to_xml
from mwdcal.certificate.dcc.administrative import dsi_unit
from mwdcal.certificate.document import (
    Budget,
    BudgetLine,
    Certificate,
    ConformityTest,
    Item,
    LimitDecision,
    Method,
    Party,
    Quantity,
    ResultTable,
    Signature,
    SourceFile,
    TracedStandard,
    encode,
)
from mwdcal.errors import InputError
from mwdcal.files.exchange import xml
from mwdcal.sensor.profile import Person

UNITS = {
    "1": (r"\one", 1.0),
    "": (r"\one", 1.0),
    "%": (r"\one", 0.01),
    "‰ of the field": (r"\one", 1e-3),
    "g": (r"\metre\second\tothe{-2}", 9.80665),
    "mg": (r"\metre\second\tothe{-2}", 9.80665e-3),
    "g/°C": (r"\metre\second\tothe{-2}\kelvin\tothe{-1}", 9.80665),
    "g/°C2": (r"\metre\second\tothe{-2}\kelvin\tothe{-2}", 9.80665),
    "nT": (r"\nano\tesla", 1.0),
    "nT/°C": (r"\nano\tesla\kelvin\tothe{-1}", 1.0),
    "nT/°C2": (r"\nano\tesla\kelvin\tothe{-2}", 1.0),
    "nT/°C³": (r"\nano\tesla\kelvin\tothe{-3}", 1.0),
    "1/°C": (r"\kelvin\tothe{-1}", 1.0),
    "1/°C2": (r"\kelvin\tothe{-2}", 1.0),
    "m/s²": (r"\metre\second\tothe{-2}", 1.0),
    "°": (r"\degree", 1.0),
    "°/°C": (r"\degree\kelvin\tothe{-1}", 1.0),
    "°C": (r"\degreecelsius", 1.0),
    "g/g": (r"\one", 1.0),
    "raw/g": ("|raw/g", 1.0),
}
"""Units of certificates: D-SI, and how many of it make one (1 g is 9.80665 m/s²; SI Brochure, 9th edition)."""
NORMAL = math.erf(2 / math.sqrt(2))
PER = r"The dsi string contains the token '.per'"
"""dsiUnits warns of a deprecated token in every unit, also where there is none."""
HOSTILE = [
    "",
    " ",
    "\x00\x1b[31m",
    "]]></dcc:name><x/>",
    "&lt;",
    "'\"><script>",
    "\x85\uffff",
    "a\r\nb\u2028c",
]


def quantity(name, unit, value, expanded=None, factor=2.0, probability=NORMAL, **others):
    known = expanded is not None
    return Quantity(
        id=name,
        name=name.replace("-", " "),
        unit=unit,
        value=value,
        standard_uncertainty=expanded / factor if known else None,
        expanded_uncertainty=expanded,
        coverage_factor=factor if known else None,
        coverage_probability=probability if known else None,
        **others,
    )


def decision(name, unit, value, limit, passed=True):
    u = 0.01 * limit
    return LimitDecision(
        quantity=quantity(name, unit, value, u),
        limit=limit,
        acceptance_limit=limit - u,
        passed=passed,
        probability_within=0.999,
        risk=0.001,
        note="Guard band: the expanded uncertainty.",
    )


def roll_test(when, passed, *decisions):
    return ConformityTest(
        when=when,
        passed=passed,
        date="2026-03-02" if when == "as found" else "2026-03-05",
        run="roll.csv",
        stations=24,
        limits="ISCWSA",
        source="operator's procedure 7",
        rule="guarded",
        rule_text="Passed if the value is within the limit less the expanded uncertainty.",
        calibration_sha256="ab" * 32,
        decisions=list(decisions),
        findings=[Finding(id="few-stations", text="Fewer than 30 stations.")],
    )


def whole():
    """A certificate with something in every field."""
    tables = [
        ResultTable(
            id="accelerometer",
            title="Parameters of the accelerometer",
            note="11 of 12 parameters determined.",
            quantities=[
                quantity("gain-xx", "1", 1.000123456789, 1.2e-4, 2.13, 0.9545),
                quantity("bias-x", "g", -1.23456789012e-3, 2.5e-6),
                quantity("bias-x·1", "g/°C", 3.3e-7, 1.1e-9, 2.6, 0.9545),
                quantity("bias-x·2", "g/°C2", -0.0, 0.0),
                quantity("gain-xy·1", "1/°C", 1e-7, 1e-9),
                quantity("toolface-zero", "°", None),
                Quantity(
                    id="k-1", name="standard only", unit="g", value=1.0, standard_uncertainty=7e-4
                ),
                quantity("narrow", "nT", 5.0, 1.0, 0.5, 0.38),
            ],
        ),
        ResultTable(
            id="magnetometer",
            title="Parameters of the magnetometer",
            quantities=[
                quantity("bias-y", "nT", 123.456789012, 8.7),
                quantity("bias-y·3", "nT/°C³", 1e-5, 1e-6),
                quantity("scale", "raw/g", 3.1),
            ],
        ),
        ResultTable(id="none", title="Nothing", quantities=[]),
        ResultTable(
            id="free", title="Free", quantities=[quantity("rotation-x", "°", None, at="all")]
        ),
        ResultTable(
            id="accuracy",
            title="Accuracy",
            quantities=[quantity("azimuth-5", "°", 0.0, 0.31, at="inclination 5°, 60.0 °C")],
        ),
    ]
    line = BudgetLine(
        id="noise",
        source="Sensor noise",
        kind="A",
        basis="24 stations",
        inclination_deg=0.011,
        toolface_deg=0.02,
        azimuth_deg=None,
    )
    blank = BudgetLine(
        id="dip", source="Dip", kind="B", basis="declared", inclination_deg=None, toolface_deg=None
    )
    return Certificate(
        software="mwdcal 1.2.3",
        serial="SN 7",
        simulated=True,
        number="SN7-2026-03-06-0123456789ab",
        issued="2026-03-06",
        laboratory=Party(
            name="Labor & Söhne <GmbH>",
            address=["Street 1", "12345 Town"],
            country="DE",
            contact="lab@example.org",
            accreditation="D-K-12345-01-00",
        ),
        place="Hut in the forest",
        customer=Party(name="Driller", address=["Rig 5"], contact="Phone 123"),
        item=Item(
            type="servo tool",
            serial="SN 7",
            manufacturer="Maker",
            identification={"asset": "A-17", "blank": ""},
            condition="Scratched.",
            received="2026-03-01",
        ),
        calibrated="2026-03-04T10:00:00Z",
        next_due="2027-03-04",
        method=Method(
            name="Joint least squares",
            text="All stations at once.",
            software="mwdcal 1.2.2",
            model="polynomial",
            stations=64,
            references=["Procedure 5", "JCGM 100"],
            deviations=["Room too warm."],
        ),
        conditions=[
            quantity("temperature-lowest", "°C", 21.5),
            quantity("gravity", "g", 1.00123, 2e-5),
            quantity("field", "nT", 48_123.4, 40.0),
            quantity("dip", "°", None),
        ],
        results=tables,
        budget=Budget(
            at="inclination 45°",
            lines=[line, blank],
            combined=replace(line, id="combined", source="Combined"),
            expanded=replace(line, id="expanded", source="Expanded", inclination_deg=0.022),
            coverage_factor=2.0,
            coverage_probability=0.9545,
        ),
        traceability=[
            TracedStandard(
                quantity="gravity",
                name="Gravimeter",
                serial="G1",
                certificate="PTB-1",
                issuer="PTB",
                date="2025-01-01",
                due="2026-01-01",
                overdue=True,
                standard_uncertainty="1e-6 g",
            ),
            TracedStandard(quantity="stand", name="Stand"),
        ],
        as_found=roll_test(
            "as found",
            False,
            decision("azimuth", "°", 0.91, 0.5, passed=False),
            replace(
                decision("toolface", "°", None, 0.5, passed=False), acceptance_limit=None, risk=None
            ),
        ),
        as_left=roll_test(
            "as left", True, decision("gravity", "mg", 0.4, 2.5), decision("field", "nT", 99, 300)
        ),
        measured_by=Person(name="Ms. M", function="technician"),
        authorised_by=Person(name="Mr. A", function="head"),
        statements=["The results relate only to the item that was calibrated."],
        findings=[Finding(id="overdue-standard", text="The gravimeter is overdue.")],
        files=[SourceFile(id="calibration", name="cal.json", sha256="cd" * 32)],
        signature=Signature(key="0" * 16, time="2026-03-06T12:00:00Z", value="AAAA"),
    )


def bare():
    """A certificate with nothing that may be missing."""
    full = whole()
    kept = ("software", "number", "issued", "calibrated", "method", "budget")
    return Certificate(
        **{name: getattr(full, name) for name in kept},
        serial=None,
        simulated=False,
        item=Item(type="", serial=""),
        conditions=[],
        results=[],
        traceability=[],
        statements=[],
        findings=[],
        files=[],
    )


def within(place, each):
    """A quantity as clients give it: they know it by its label alone."""
    return replace(each, id=f"{place}/{each.id}")


def decisions(certificate):
    found, left = certificate.as_found, certificate.as_left
    tests = {"as-found": found.decisions, "as-left": left.decisions}
    return [
        replace(each, quantity=within(place, each.quantity))
        for place, of_test in tests.items()
        for each in of_test
    ]


def budget_values(budget):
    for line in (*budget.lines, budget.combined, budget.expanded):
        for name in ("inclination", "toolface", "azimuth"):
            value = getattr(line, f"{name}_deg")
            yield Quantity(id=f"budget/{line.id}/{name}", name=name, unit="°", value=value)


def calibration_results(certificate):
    """All quantities among the results, in their order."""
    tables = [within(table.id, each) for table in certificate.results for each in table.quantities]
    tested = [each.quantity for each in decisions(certificate)]
    return [*tables, *budget_values(certificate.budget), *tested]


def all_quantities(certificate):
    """Results, conditions, and the limits and probabilities beside the decisions."""
    yield from calibration_results(certificate)
    yield from (within("condition", each) for each in certificate.conditions)
    for each in decisions(certificate):
        unit = each.quantity.unit
        numbers = {
            "limit": (unit, each.limit),
            "acceptance-limit": (unit, each.acceptance_limit),
            "probability-within": ("1", each.probability_within),
            "risk": ("1", each.risk),
        }
        for name, (of, value) in numbers.items():
            yield Quantity(id=f"{each.quantity.id}/{name}", name=name, unit=of, value=value)


def coverage(each):
    """Expanded uncertainty, factor and probability that are to be read; factor 1 where D-SI has no other form."""
    if each.expanded_uncertainty is not None and each.coverage_factor >= 1:
        return each.expanded_uncertainty, each.coverage_factor, each.coverage_probability
    if each.standard_uncertainty is not None:
        return each.standard_uncertainty, 1.0, 0.682689492137086
    return None


def close(value, expected):
    assert value == pytest.approx(expected, rel=1e-12, abs=0)


# ── The schema ───────────────────────────────────────────────────────────────────────────────


@pytest.fixture(scope="session")
def schemas(tmp_path_factory):
    return dcc_clients.schema_folder(tmp_path_factory.mktemp("dcc"))


@pytest.fixture(scope="session")
def schema(schemas):
    return dcc_clients.schema(schemas)


def errors(schema, written):
    return [f"{e.path}: {e.reason}" for e in schema.iter_errors(ElementTree.fromstring(written))]


@with_schema
@pytest.mark.parametrize("certificate", [whole(), bare()], ids=["whole", "bare"])
def test_valid_by_the_official_schema(schema, certificate):
    assert errors(schema, to_xml(certificate)) == []


def test_head_is_that_of_published_certificates():
    head = to_xml(whole()).decode("utf-8").splitlines()[:2]
    assert head[0] == '<?xml version="1.0" encoding="UTF-8"?>'
    for attribute in (
        'xmlns:dcc="https://ptb.de/dcc"',
        'xmlns:si="https://ptb.de/si"',
        'xsi:schemaLocation="https://ptb.de/dcc https://ptb.de/dcc/v3.3.0/dcc.xsd"',
        'schemaVersion="3.3.0"',
    ):
        assert attribute in head[1]


def anything(kind, name=""):
    """A strategy of any value of a type, structures included."""
    arguments = typing.get_args(kind)
    origin = typing.get_origin(kind)
    if origin is typing.Literal:
        return st.sampled_from(arguments)
    if origin in (typing.Union, types.UnionType):
        return st.one_of([anything(each, name) for each in arguments])
    if origin is list:
        return st.lists(anything(arguments[0], name), max_size=2)
    if origin is dict:
        return st.dictionaries(anything(arguments[0]), anything(arguments[1]), max_size=2)
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        hints = typing.get_type_hints(kind)
        return st.builds(kind, **{field: anything(of, field) for field, of in hints.items()})
    least, most = (0.0, 1.0) if "probability" in name else (0.0 if "uncert" in name else -1e9, 1e9)
    if name in ("calibrated", "issued"):
        return st.dates(min_value=date(1000, 1, 1)).map(str)
    return {
        float: st.floats(least, most),
        int: st.integers(0, 10**6),
        bool: st.booleans(),
        str: st.one_of(st.text(max_size=20), st.sampled_from(HOSTILE)),
        type(None): st.none(),
        msgspec.UnsetType: st.just(msgspec.UNSET),
    }[kind]


def in_order(certificate):
    """The roll test before the adjustment is "as found", the one after it "as left"."""
    found, left = certificate.as_found, certificate.as_left
    return replace(
        certificate,
        as_found=found and replace(found, when="as found"),
        as_left=left and replace(left, when="as left"),
    )


@with_schema
@settings(
    max_examples=60,
    deadline=None,
    suppress_health_check=list(HealthCheck),
    phases=[Phase.explicit, Phase.generate],  # to shrink a whole certificate takes minutes
)
@given(anything(Certificate).map(in_order))
@example(whole())
@example(bare())
def test_any_text_in_any_field_is_valid_and_kept(schema, certificate):
    written = to_xml(certificate)
    assert errors(schema, written) == []
    assert written == to_xml(certificate)
    root = ElementTree.fromstring(written)
    inside = root.find("dcc:document", NAMESPACES)
    assert inside.findtext("dcc:mimeType", None, NAMESPACES) == "application/json"
    data = base64.b64decode(inside.findtext("dcc:dataBase64", None, NAMESPACES))
    assert json.loads(data) == msgspec.to_builtins(certificate)
    assert data == encode(certificate)


def test_characters_that_xml_cannot_hold_are_left_out():
    assert xml.lines("a\x00b\ud800\r\nc\ufffe ") == "a b \nc"
    assert xml.one_line(" a\x1b[31m\n\ud800b ") == "a [31m b"


def test_without_a_date_there_is_no_certificate():
    with pytest.raises(InputError, match=r"`certificate.calibrated` must be a date .*'soon'"):
        to_xml(replace(bare(), calibrated="soon"))


# ── Units ────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("text", UNITS)
def test_units(text):
    name, factor = dsi_unit(text)
    assert name == UNITS[text][0]
    assert float(factor) == pytest.approx(UNITS[text][1], rel=1e-15, abs=0)


@pytest.mark.parametrize(
    ("name", "base", "scale"),
    [
        (r"\nano\tesla", r"\kilogram\second\tothe{-2}\ampere\tothe{-1}", 1e-9),
        (r"\metre\second\tothe{-2}", r"\metre\second\tothe{-2}", 1.0),
        (r"\degree\kelvin\tothe{-1}", r"\radian\kelvin\tothe{-1}", math.pi / 180),
    ],
)
def test_units_mean_what_ptb_says(name, base, scale):
    dsi = pytest.importorskip("dsi_unit")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", PER)
        factor = dsi.DsiUnit(base).get_scale_factor(dsi.DsiUnit(name))
    assert factor == pytest.approx(scale, rel=1e-14, abs=0)


# ── Clients ──────────────────────────────────────────────────────────────────────────────────


@pytest.fixture(scope="session")
def issued(tmp_path_factory):
    """A certificate of a thermal calibration with roll tests as found and as left, by the command line."""
    folder = tmp_path_factory.mktemp("issued")
    paths = {name: folder / f"{name}.json" for name in ("cal", "old", "left", "found", "truth")}
    run, roll = folder / "run.csv", folder / "roll.csv"
    outputs = folder / "C.json", folder / "C.xml"

    def simulated(seed, *words):
        mwdcal("simulate", "--seed", seed, "--truth", paths["truth"], *words)

    simulated(5, "--plan", "laboratory-thermal", "--tool", "servo", "-o", run)
    mwdcal("calibrate", run, "--tool", "servo", "-o", paths["cal"])
    simulated(7, "--plan", "six-state", "--tool", "servo", "-o", run)
    run.write_text(run.read_text("utf-8").replace("SIM-7", "SIM-5"), "utf-8")  # it has changed
    mwdcal("calibrate", run, "--tool", "servo", "-o", paths["old"])
    simulated(6, "--plan", "roll-test", "--calibration", paths["cal"], "-o", roll)
    for test, calibration in (("left", "cal"), ("found", "old")):
        paths[test].write_text(mwdcal("verify", paths[calibration], roll, "--json").out, "utf-8")
    ran = mwdcal(
        "certificate", paths["cal"], "--verification", paths["left"], "--as-found", paths["found"],
        "--laboratory", EXAMPLE / "laboratory.toml", "-o", outputs[0], "-o", outputs[1],
    )  # fmt: skip
    assert ran.code == 0, ran.err
    data, written = (path.read_bytes() for path in outputs)
    return msgspec.json.decode(data, type=Certificate), written, data


@with_schema
def test_a_certificate_of_the_command_is_valid_and_carries_its_json(schema, issued):
    certificate, written, data = issued
    assert errors(schema, written) == []
    root = ElementTree.fromstring(written)
    assert base64.b64decode(root.findtext("dcc:document/dcc:dataBase64", None, NAMESPACES)) == data
    units = {each.unit for each in calibration_results(certificate)}
    assert {"g", "g/°C", "nT", "nT/°C", "1", "1/°C", "°"} <= units, units
    assert certificate.as_found.passed != certificate.as_left.passed
    found = [e.text for e in root.iter(f"{{{NAMESPACES['dcc']}}}conformity")]
    expected = [test.passed for test in (certificate.as_found, certificate.as_left)]
    expected += [
        passed
        for test in (certificate.as_found, certificate.as_left)
        for passed in (*(each.passed for each in test.decisions), test.passed)
    ]
    assert found == ["pass" if passed else "fail" for passed in expected]


@pytest.fixture(params=["whole", "issued"])
def both(request):
    """A certificate, and its XML."""
    if request.param == "whole":
        return whole(), to_xml(whole())
    return request.getfixturevalue("issued")[:2]


def test_pydcc_reads_every_result(both):
    certificate, written = both
    client, results = dcc_clients.pydcc_results(written)
    assert client.uid() == certificate.number
    assert client.calibration_laboratory_name() == certificate.laboratory.name
    assert client.mandatory_language() == "en"
    assert certificate.item.serial in str(client.item_id())
    expected = [each for each in calibration_results(certificate) if each.value is not None]
    assert len(results) == len(expected) >= 20
    for each, (name, result) in zip(expected, results, strict=True):
        unit, factor = UNITS[each.unit]
        assert (result["label"], result["unit"]) == (each.id, unit)
        assert name.endswith(each.name)
        assert "SIMULATED DATA" in name
        close(float(result["value"]), each.value * factor)
        if (stated := coverage(each)) is None:
            assert "measurementUncertaintyUnivariate" not in result
        else:
            uncertainty = result["measurementUncertaintyUnivariate"]["expandedMU"]
            close(float(uncertainty["valueExpandedMU"]), stated[0] * factor)
            close(float(uncertainty["coverageFactor"]), stated[1])
            close(float(uncertainty["coverageProbability"]), stated[2])


def test_dates_are_those_of_the_measurements():
    client, _ = dcc_clients.pydcc_results(to_xml(whole()))
    assert client.calibration_date().date() == date(2026, 3, 5)  # of the roll test as left
    core = client.administrative_data.find("dcc:coreData", NAMESPACES)
    assert core.findtext("dcc:beginPerformanceDate", None, NAMESPACES) == "2026-03-02"
    assert core.findtext("dcc:receiptDate", None, NAMESPACES) == "2026-03-01"
    assert core.findtext("dcc:issueDate", None, NAMESPACES) == "2026-03-06"


@with_schema
def test_dcc_quantities_reads_every_quantity(tmp_path, schemas, both):
    certificate, written = both
    path = tmp_path / "dcc.xml"
    path.write_bytes(written)
    with warnings.catch_warnings():
        # Student's factors are not those of the normal distribution that it takes where none is stated
        warnings.filterwarnings("ignore", "Normal distribution mismatch")
        warnings.filterwarnings("ignore", "Parsing a correctly marked non D-SI unit")
        warnings.filterwarnings("ignore", PER)
        read = dcc_clients.quantities(path, schemas)
    expected = [each for each in all_quantities(certificate) if each.value is not None]

    read = sorted(read, key=lambda q: (q.data.label, str(q.dsi_unit).lstrip("|"), q.values[0]))
    expected.sort(key=lambda q: (q.id, UNITS[q.unit][0].lstrip("|"), q.value * UNITS[q.unit][1]))
    assert [each.data.label for each in read] == [each.id for each in expected]
    for each, result in zip(expected, read, strict=True):
        unit, factor = UNITS[each.unit]
        assert str(result.dsi_unit).lstrip("|") == unit.lstrip("|")
        close(result.values[0], each.value * factor)
        if (stated := coverage(each)) is None:
            assert math.isnan(result.uncertainties[0])
        else:
            close(result.uncertainties[0] * stated[1], stated[0] * factor)


def test_what_is_undetermined_has_text_and_no_number():
    written = to_xml(whole())
    assert b"NaN" not in written
    assert b">None<" not in written
    root = ElementTree.fromstring(written)
    texts = root.findall(".//dcc:text[@refType]", NAMESPACES)
    budget = ["inclination", "toolface", "azimuth", "azimuth"]  # of a source, of the sums
    open_ones = ["dip", "toolface zero", "rotation x", *budget, "toolface"]
    assert [each.findtext("dcc:name/dcc:content", None, NAMESPACES) for each in texts] == open_ones
    assert all("Undetermined" in "".join(each.itertext()) for each in texts)
    labels = {each.text for each in root.iter(f"{{{NAMESPACES['si']}}}label")}
    none = {"accelerometer/toolface-zero", "free/rotation-x", "budget/dip/inclination"}
    assert labels.isdisjoint({*none, "condition/dip", "as-found/toolface"})
    assert {"accelerometer/bias-x", "as-found/toolface/limit", "condition/gravity"} <= labels


def test_labels_are_unique(issued):
    root = ElementTree.fromstring(issued[1])
    labels = [each.text for each in root.iter(f"{{{NAMESPACES['si']}}}label")]
    assert len(labels) == len(set(labels)) > 100
