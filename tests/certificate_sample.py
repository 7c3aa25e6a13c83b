"""Certificates made by hand, as those of a laboratory: what its forms show is known from here alone."""

from mwdcal.calibration.record import Finding
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
)
from mwdcal.sensor.profile import Person

GUARDED = "guarded acceptance: noise-free value + 2 × its 1σ must not exceed the limit"


def quantity(name, unit, value, u=None, k=2.0, **more):
    """A quantity whose expanded uncertainty is k times u."""
    stated = {} if u is None else {"expanded_uncertainty": k * u, "coverage_factor": k}
    return Quantity(
        id=name.replace(" ", "-"),
        name=name,
        unit=unit,
        value=value,
        standard_uncertainty=u,
        coverage_probability=0.9545 if u else None,
        **stated,
        **more,
    )


def decision(name, unit, value, u, limit, within=0.99987, **more):
    passed = value + 2 * u <= limit
    return LimitDecision(
        quantity=quantity(name, unit, value, u),
        limit=limit,
        acceptance_limit=limit - 2 * u,
        passed=passed,
        probability_within=within,
        risk=1 - within if passed else within,
        **more,
    )


def roll_test(when, *decisions, **more):
    return ConformityTest(
        when=when,
        passed=all(each.passed for each in decisions),
        date="2026-03-02" if when == "as found" else "2026-03-05",
        run=f"rolltest-{when.replace(' ', '-')}.csv",
        stations=24,
        limits="roll-test",
        source="laboratory procedure 7",
        rule="guarded",
        rule_text=GUARDED,
        calibration_sha256=("0f" if when == "as found" else "a7") * 32,
        decisions=[*decisions],
        **more,
    )


PARAMETERS = ResultTable(
    id="accelerometer",
    title="Parameters of the accelerometer",
    note="Raw reading = S · field + o, in tool axes at 20 °C.",
    quantities=[
        quantity("scale x", "raw/g", 3.0123456, 0.00012),
        quantity("scale y", "raw/g", 2.9871234, 0.00013),
        quantity("scale z", "raw/g", 3.0011111, 0.00011),
        quantity("bias x", "raw", -0.0123987, 0.00021),
        quantity("bias y", "raw", 0.0045678, 0.00022),
        quantity("misalignment xy", "1", 1.23e-4, 3.4e-6),
        quantity("toolface zero", "°", None),
        quantity("bias z", "raw", 0.0034),
    ],
)
ANGLES = ResultTable(
    id="angles",
    title="Angles at typical attitudes",
    quantities=[
        quantity("inclination", "°", 5.0, 0.0123, at="I 5°, 20 °C"),
        quantity("toolface", "°", 45.0, 0.098, 2.11, at="I 5°, 20 °C"),
        quantity("azimuth", "°", 90.0, 0.31, at="I 45°, 120 °C"),
    ],
)
BUDGET = Budget(
    at="inclination 45°, 20 °C",
    lines=[
        BudgetLine(
            id="noise",
            source="sensor noise",
            kind="A",
            basis="residuals of 24 stations",
            inclination_deg=0.0031,
            toolface_deg=0.0042,
            azimuth_deg=0.0512,
        ),
        BudgetLine(
            id="stand",
            source="angles of the stand",
            kind="B",
            basis="its certificate",
            inclination_deg=0.01,
            toolface_deg=0.02,
            azimuth_deg=0.05,
        ),
        BudgetLine(
            id="dip",
            source="dip of the field",
            kind="B",
            basis="model of the field",
            inclination_deg=0.0,
            toolface_deg=0.0,
            azimuth_deg=None,
        ),
    ],
    combined=BudgetLine(
        id="combined",
        source="combined",
        kind="B",
        basis="root of the sum of squares",
        inclination_deg=0.010469,
        toolface_deg=0.020436,
        azimuth_deg=0.071563,
    ),
    expanded=BudgetLine(
        id="expanded",
        source="expanded",
        kind="B",
        basis="k times the combined",
        inclination_deg=0.020939,
        toolface_deg=0.040873,
        azimuth_deg=0.143126,
    ),
    coverage_factor=2.0,
    coverage_probability=0.9545,
)
SAMPLE = Certificate(
    software="mwdcal 1.2.3",
    serial="T-7",
    simulated=True,
    number="CAL-2026-00042",
    issued="2026-03-06",
    laboratory=Party(
        name="Nordlicht Calibration Laboratory",
        address=["Am Polarkreis 7", "12345 Bäreninsel"],
        contact="lab@nordlicht.example",
        accreditation="D-K-00000-01-00",
    ),
    place="Hall 2, stand 1",
    customer=Party(name="Åland Drilling Oy", address=["Rantatie 3", "22100 Mariehamn"]),
    item=Item(
        type="servo tool",
        serial="T-7",
        manufacturer="Σ Instruments",
        identification={"firmware": "4.1", "housing": "H-99"},
        condition="scratch on the housing, connector sound",
        received="2026-03-01",
    ),
    calibrated="2026-03-04",
    next_due="2027-03-04",
    method=Method(
        name="joint",
        text="Least squares over all stations and references at once.",
        software="mwdcal 1.2.3",
        model="polynomial of order 1 in temperature",
        stations=24,
        references=["laboratory procedure 7", "JCGM 100:2008"],
    ),
    conditions=[
        quantity("temperature", "°C", 21.34, 0.25),
        quantity("strength of the field", "nT", 48712.3, 12.0),
        quantity("humidity", "%", 41.0),
    ],
    results=[PARAMETERS, ANGLES],
    budget=BUDGET,
    traceability=[
        TracedStandard(
            quantity="inclination and toolface",
            name="rotary stand RS-3",
            serial="881",
            certificate="PTB 20417",
            issuer="PTB",
            date="2025-01-10",
            due="2026-01-10",
            overdue=True,
            standard_uncertainty="inclination 0.01°, azimuth 0.05°, toolface 0.02°",
        ),
        TracedStandard(
            quantity="field",
            name="proton magnetometer",
            certificate="NPL 77-1",
            due="2027-05-01",
            standard_uncertainty="2 nT",
        ),
        TracedStandard(quantity="gravity", name="national gravity network"),
    ],
    as_found=roll_test(
        "as found",
        decision("spread of inclination", "°", 0.1312, 0.0123, 0.1, within=0.0057),
        decision("error of azimuth", "°", 0.2212, 0.0312, 0.5),
        decision("error of gravity", "g", 0.00071, 0.00012, 0.003, note="near vertical alone"),
        findings=[Finding(id="weak-test", text="the test is weak.")],
    ),
    as_left=roll_test(
        "as left",
        decision("spread of inclination", "°", 0.0312, 0.0123, 0.1),
        decision("error of azimuth", "°", 0.1212, 0.0312, 0.5, within=1.0),
    ),
    measured_by=Person(name="Ada Byström", function="metrologist"),
    authorised_by=Person(name="Émile Noether", function="head of laboratory"),
    statements=[
        "The results are of the item named above alone.",
        "This certificate must not be copied except in full without approval of the laboratory.",
    ],
    findings=[
        Finding(
            id="overdue", text="the stand's own calibration was overdue when the tool was measured."
        )
    ],
    files=[
        SourceFile(id="calibration", name="tool.json", sha256="12" * 32),
        SourceFile(id="run", name="run.csv", sha256="3c" * 32),
    ],
    signature=Signature(key="0123456789abcdef", time="2026-03-06T09:00:00Z", value="QUJD" * 22),
)
