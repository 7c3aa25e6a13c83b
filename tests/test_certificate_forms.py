"""The certificate for people: page and PDF say the same as the certificate, read back by other programs."""

import io
import re
import shutil
import subprocess
import sys
from decimal import ROUND_HALF_EVEN, Decimal
from functools import cache
from html.parser import HTMLParser

import msgspec
import pytest
from msgspec.structs import replace

import mwdcal
from certificate_sample import ANGLES, BUDGET, PARAMETERS, SAMPLE, quantity
from cli_support import EXAMPLE, process
from mwdcal import extras
from mwdcal.calibration.record import Finding
from mwdcal.certificate.document import Certificate, Item, Party, ResultTable, SourceFile
from mwdcal.errors import InputError
from mwdcal.files.documents import laid_out

pypdf = pytest.importorskip("pypdf", reason="pypdf is not installed")
typst = pytest.importorskip("typst", reason="typst is not installed")
pytest.importorskip("matplotlib", reason="matplotlib is not installed")

from mwdcal.presentation.certificate import (  # noqa: E402
    certificate_pictures,
    certificate_text,
    probability,
    quantity_numbers,
    render_page,
    render_pdf,
)

MM = 72 / 25.4
HOSTILE = [
    "#panic()",
    "*bold* _it_ `raw`",
    "$x^2$ \\u{41} \\#",
    "= head",
    "// gone",
    "@ref <label>",
    '"quoted" -- --- ... \'s ~',
    "<script>alert(1)</script>&amp;",
    "] } ) #]",
    "https://x.example/a_b",
    "{{ 7 * 7 }} {% raw %}",
]
"""Texts that would act where they are taken for markup."""


def changed(**fields):
    return replace(SAMPLE, **fields)


def pages(pdf):
    return [page.extract_text() for page in pypdf.PdfReader(io.BytesIO(pdf)).pages]


def squeezed(text):
    """Text without blanks."""
    return re.sub(r"\s+", "", text)


class Words(HTMLParser):
    """What a page says, without styles, script and pictures."""

    def __init__(self, page):
        super().__init__()
        self.hidden, self.words = 0, []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.hidden += tag in ("style", "script", "svg", "head")

    def handle_endtag(self, tag):
        self.hidden -= tag in ("style", "script", "svg", "head")

    def handle_data(self, data):
        if not self.hidden:
            self.words.append(data)


def test_the_symbol_of_the_standard_uncertainty_stays_small():
    page = render_page(SAMPLE, [])
    assert "u: standard uncertainty; U: expanded uncertainty" in page
    assert "U: standard uncertainty" not in page


def test_the_page_names_the_factor_of_each_roll_test_where_they_differ():
    first, *others = SAMPLE.as_found.decisions
    few = replace(
        first,
        quantity=replace(first.quantity, coverage_factor=2.57, expanded_uncertainty=2.57 * 0.01),
    )
    test = replace(SAMPLE.as_found, decisions=[few])
    assert f"{others[0].quantity.coverage_factor:.2f}" == "2.00"
    text = squeezed(render_page(changed(as_found=test), []))
    assert "(asfound:k=2.57,95.45%;asleft:k=2.00,95.45%)" in text


def page_text(certificate):
    return squeezed("".join(Words(render_page(certificate)).words))


def pdf_text(certificate):
    return squeezed("".join(pages(render_pdf(certificate))))


FORMS = pytest.mark.parametrize("said", [page_text, pdf_text])

# ------------------------------------------------------------------ numbers


def two_digits(number):
    """A number at two significant digits, by decimal arithmetic."""
    exact = Decimal(number)
    step = Decimal(1).scaleb(exact.adjusted() - 1)
    rounded = exact.quantize(step, ROUND_HALF_EVEN)
    return rounded.quantize(Decimal(1).scaleb(rounded.adjusted() - 1), ROUND_HALF_EVEN)


def written(number):
    return f"{number:f}".replace("-", "−")


@pytest.mark.parametrize(
    ("value", "u", "k"),
    [(3.0123456, 1.2e-4, 2.0), (-0.0123987, 2.1e-4, 2.0), (45.0, 0.098, 2.11), (7.0, 0.4996, 2.0)],
)
def test_value_and_uncertainty_end_at_the_same_decimal(value, u, k):
    expanded = two_digits(k * u)
    value_text, u_text, expanded_text = quantity_numbers(quantity("scale", "g", value, u, k))
    assert expanded_text == f"{written(expanded)} g"
    assert value_text == f"{written(Decimal(value).quantize(expanded, ROUND_HALF_EVEN))} g"
    assert u_text == f"{written(two_digits(u))} g"


def test_numbers_without_uncertainty_or_value_say_so():
    assert quantity_numbers(quantity("humidity", "%", 41.0)) == ("41 %", "not stated", "not stated")
    assert quantity_numbers(quantity("zero", "°", None))[0] == "undetermined"
    assert quantity_numbers(quantity("m", "1", 0.5, 0.1))[0] == "0.50"


@pytest.mark.parametrize("missing", [0.3, 0.04, 1.3e-3, 4.4e-5, 2e-6])
def test_a_probability_shows_two_digits_of_what_is_missing_to_one(missing):
    shown = Decimal(probability(1 - missing))
    assert abs((1 - shown) - Decimal(missing)) <= Decimal(missing) / 20
    assert len((1 - shown).normalize().as_tuple().digits) <= 2


def test_a_probability_is_never_rounded_to_certainty():
    assert probability(1 - 1e-12) == "> 0.999999"
    assert probability(1.0) == "> 0.999999"


# ------------------------------------------------------------------ both forms say what the JSON says


def texts(data, skipped=("id", "command", "unit", "when")):
    """All texts of the JSON but its ids."""
    if isinstance(data, str):
        yield data
    elif isinstance(data, dict):
        for key, value in data.items():
            if key not in skipped:
                yield from texts(value, skipped)
    elif isinstance(data, list):
        for value in data:
            yield from texts(value, skipped)


def stated_numbers(certificate):
    """Every number of the certificate as it must be written, with its unit."""
    quantities = [*certificate.conditions, *(q for t in certificate.results for q in t.quantities)]
    decisions = [d for t in (certificate.as_found, certificate.as_left) for d in t.decisions]
    for each in [*quantities, *(d.quantity for d in decisions)]:
        symbol = "" if each.unit == "1" else each.unit
        if each.expanded_uncertainty:
            expanded = two_digits(each.expanded_uncertainty)
            yield f"{written(expanded)}{symbol}"
            yield f"{written(Decimal(each.value).quantize(expanded))}{symbol}"
            yield f"k={each.coverage_factor:.2f}"
    for each in decisions:
        yield f"{Decimal(repr(each.limit)):f}{each.quantity.unit}"
        yield "PASS" if each.passed else "FAIL"
    budget = certificate.budget
    for line in [*budget.lines, budget.combined, budget.expanded]:
        for number in (line.inclination_deg, line.toolface_deg, line.azimuth_deg):
            if number:
                yield f"{written(two_digits(number))}°"
    yield from ["95.45%", "undetermined", "OVERDUE", "risk0.00013", "0.99987", "0.0057"]


@FORMS
def test_every_text_and_number_of_the_certificate_is_shown(said):
    shown = said(SAMPLE).casefold()
    missing = {t for t in texts(msgspec.to_builtins(SAMPLE)) if squeezed(t).casefold() not in shown}
    assert not missing
    absent = {n for n in stated_numbers(SAMPLE) if squeezed(n).casefold() not in shown}
    assert not absent


def test_page_and_pdf_say_the_same_words():
    text = msgspec.to_builtins(certificate_text(SAMPLE))
    page, pdf = page_text(SAMPLE).casefold(), pdf_text(SAMPLE).casefold()
    each = {squeezed(t).casefold() for t in texts(text, ("id", "kind", "level", "mark"))} - {""}
    assert {t for t in each if t not in page} == {t for t in each if t not in pdf} == set()


def test_every_page_has_the_number_and_its_place_and_says_that_data_are_simulated():
    for simulated in (True, False):
        shown = pages(render_pdf(changed(simulated=simulated)))
        assert len(shown) > 1
        for place, page in enumerate(shown, 1):
            assert SAMPLE.number in page
            assert f"Page {place} of {len(shown)}" in page
            assert ("SIMULATED DATA" in page) == simulated
        page = render_page(changed(simulated=simulated))
        assert ("SIMULATED DATA" in page) == simulated


@FORMS
def test_what_is_empty_is_left_out_or_said_to_be_not_stated(said):
    bare = changed(
        laboratory=None,
        customer=None,
        place="",
        next_due="",
        item=Item(type="", serial=""),
        conditions=[],
        results=[],
        traceability=[],
        as_found=None,
        as_left=None,
        measured_by=None,
        authorised_by=None,
        statements=[],
        findings=[],
        files=[],
        signature=msgspec.UNSET,
    )
    shown = said(bare)
    for label in ("Customer", "At", "Nextdue", "Serialnumber", "Type"):
        assert f"{label}notstated" in shown
    for label in ("Manufacturer", "Received", "Condition", "Digitalsignature", "Results", "None"):
        assert label not in shown.replace("Methodandconditions", "")
    assert "nothingisstatedaboutconformity" in shown
    assert "notshowntobetraceable" in shown


def test_no_heading_stands_alone_at_the_foot_of_a_page():
    titles = [re.sub(r"^\d+\s", "", section.title) for section in certificate_text(SAMPLE).sections]
    for count in range(0, 44, 6):
        rows = [quantity(f"parameter {place}", "g", 1.0, 0.01) for place in range(count)]
        extra = ResultTable(id="more", title="More", quantities=rows)
        pdf = render_pdf(changed(results=[extra, *SAMPLE.results]))
        for page in pages(pdf):
            lines = [line.strip() for line in page.splitlines() if line.strip()]
            feet = [n for n, line in enumerate(lines) if line == SAMPLE.number]
            body = lines[: feet[-1]] if feet else lines
            assert not any(body[-1].endswith(title) for title in titles), body[-3:]


# ------------------------------------------------------------------ texts of others


@FORMS
@pytest.mark.parametrize("text", HOSTILE)
def test_texts_of_others_are_shown_as_they_are(said, text):
    certificate = changed(
        number=text,
        item=Item(type=text, serial=text),
        laboratory=Party(name=text, address=[text]),
        statements=[text],
        findings=[Finding(id="x", text=text)],
        files=[SourceFile(id="run", name=text, sha256="00" * 32)],
        results=[ResultTable(id="x", title=text, quantities=[quantity(text, "g", 1.0, 0.1)])],
    )
    assert said(certificate).count(squeezed(text)) >= 8


@FORMS
def test_control_characters_are_shown_as_escapes(said):
    shown = said(changed(item=Item(type="a\x1b[2Jb", serial="x\u202ey\x00")))
    assert "a\\x1b[2Jb" in shown
    assert "x\\u202ey\\x00" in shown


def test_characters_that_no_font_of_the_pdf_has_are_shown_by_their_code():
    certificate = changed(item=Item(type="Bohrgerät Ж Σ 中文😀", serial="\ue000x\U000e0041"))
    pdf = render_pdf(certificate)
    shown = squeezed("".join(pages(pdf)))
    assert "BohrgerätЖΣ[U+4E2D][U+6587][U+1F600]" in shown
    assert "[U+E000]x" in shown
    assert "中文😀" in page_text(certificate)
    assert attached(pdf) == certificate


# ------------------------------------------------------------------ the file


def attached(pdf):
    """The certificate that is attached to its PDF, as the command writes JSON."""
    ((name, [data]),) = pypdf.PdfReader(io.BytesIO(pdf)).attachments.items()
    assert name == "certificate.json"
    certificate = msgspec.json.decode(data, type=Certificate)
    assert data == laid_out(msgspec.json.encode(certificate))
    return certificate


def test_the_pdf_carries_its_json_and_says_that_it_is_for_archives():
    pdf = render_pdf(SAMPLE)
    reader = pypdf.PdfReader(io.BytesIO(pdf))
    assert attached(pdf) == SAMPLE
    xmp = reader.xmp_metadata.stream.get_data().decode()
    assert re.search(r"pdfaid:part>3<|pdfaid:part=\"3\"", xmp)
    assert re.search(r"pdfaid:conformance>A<|pdfaid:conformance=\"A\"", xmp)
    assert reader.metadata.title == f"{SAMPLE.title} {SAMPLE.number}"
    assert reader.metadata.creation_date.date().isoformat() == SAMPLE.issued
    assert reader.trailer["/Root"]["/Lang"] == "en"


@pytest.fixture(scope="module")
def material(tmp_path_factory):
    """A calibration and the verdict of a roll test."""
    from mwdcal.files import documents, runs
    from mwdcal.files.limits import load_limits
    from mwdcal.use.verification import verify

    path = tmp_path_factory.mktemp("certificate") / "tool.json"
    tool = "--tool", EXAMPLE / "tool.toml"
    ran = process("calibrate", EXAMPLE / "run.csv", *tool, "-o", path)
    assert ran.returncode == 0, ran.stderr
    calibration, _ = documents.load(path)
    readings, _ = runs.read_run(EXAMPLE / "rolltest.csv", calibration.profile)
    return calibration, verify(calibration, readings, load_limits("roll-test")[0])


@pytest.fixture(scope="module")
def pictures(material):
    calibration, verdict = material
    return certificate_pictures(calibration, as_left=verdict, as_found=verdict)


def test_the_same_certificate_gives_the_same_bytes(material, pictures):
    calibration, verdict = material
    some = ("errors-after", "accuracy", "as-left")
    few = [each for each in pictures if each.id in some]
    again = [each for each in certificate_pictures(calibration, verdict) if each.id in some]
    assert [each.id for each in few] == [each.id for each in again]
    assert render_pdf(SAMPLE, few) == render_pdf(SAMPLE, again)
    page = render_page(SAMPLE, few)
    assert page == render_page(SAMPLE, again)
    assert page.count("<figure>") == len(few)
    assert not re.search(r"\b(src|href)=\"(?!#)", page)


def test_pictures_have_titles_and_texts_for_those_who_do_not_see_them(pictures):
    ids = [picture.id for picture in pictures]
    assert len({*ids}) == len(ids)
    assert {"residuals", "accuracy", "as-found", "as-left", "errors-after", "errors-before"} <= {
        *ids
    }
    assert [p.alt for p in pictures if len(p.alt) < 15] == []
    reader = pypdf.PdfReader(io.BytesIO(render_pdf(SAMPLE, pictures)))
    shown = squeezed("".join(page.extract_text() for page in reader.pages))
    assert [p.title for p in pictures if squeezed(p.title) not in shown] == []


def test_the_answer_is_on_two_pages_and_the_rest_in_an_annex(material, pictures):
    calibration, verdict = material
    paper = mwdcal.certificate(
        calibration, verification=verdict, laboratory=EXAMPLE / "laboratory.toml"
    )
    read = [
        squeezed(page.extract_text())
        for page in pypdf.PdfReader(io.BytesIO(paper.form("C.pdf"))).pages
    ]
    (annex,) = [k for k, text in enumerate(read) if squeezed("Annex to certificate") in text]
    assert annex == 2
    main = "".join(read[:2])
    for words in (
        "Expanded uncertainty",
        "noise-free value",
        "raw",
        "traceability",
        "Authorised by",
    ):
        assert squeezed(words) in main


@pytest.mark.parametrize(
    "advice",
    [
        "State its uncertainty in [stand] of the tool profile, and calibrate again.",
        "Re-shoot it, or --exclude 7.",
        "What the failure looks like says: mwdcal diagnose before.json rolltest.csv.",
        "Measure there and back, or declare the drift in the tool profile;",
        "Give its public key by `key`, if you have it.",
    ],
)
def test_a_customer_reads_no_advice_about_the_program(advice):
    said = Finding(id="doubt", text=f"the dip is assumed exact. {advice} The rest stays.")
    text = page_text(replace(SAMPLE, findings=[said]))
    assert squeezed("The dip is assumed exact. The rest stays.") in text
    assert squeezed(advice) not in squeezed(text)


def test_without_typst_one_sentence_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "typst", None)
    with pytest.raises(InputError, match=re.escape(extras.command("certificate"))) as refused:
        render_pdf(SAMPLE)
    assert "\n" not in str(refused.value)


# ------------------------------------------------------------------ much, and long


def long_certificate():
    """As much as a certificate may have to show, and words without a place to break."""
    word = "Unbreakable" * 20
    factors = [
        quantity(f"SF {place} {word if place == 7 else ''}", "raw/g/°C²", 1.5 + place, 1e-7)
        for place in range(60)
    ]
    lines = [replace(line, source=f"{line.source} {word}") for line in BUDGET.lines]
    return changed(
        number="CAL-" + "7" * 60,
        laboratory=Party(name=word, address=[word] * 3),
        serial="S" * 300,
        item=Item(type=word, serial="S" * 300, identification={word: word}),
        results=[
            ResultTable(id="many", title="Factors", quantities=factors),
            PARAMETERS,
            ANGLES,
            ResultTable(
                id="odd",
                title=word,
                quantities=[
                    quantity(word, word, 1.0, 0.1, at=word),
                    quantity("x", "g", 1e300, 1e280),
                ],
            ),
        ],
        budget=replace(BUDGET, lines=lines),
        findings=[
            Finding(id="f", text=f"finding {n} begins {'words ' * (n % 60)} and {n} ends")
            for n in range(200)
        ],
        files=[SourceFile(id="run", name=word, sha256="ab" * 32)],
    )


LONG = cache(long_certificate)
LONG_PDF = cache(lambda: render_pdf(LONG()))


def test_long_contents_are_not_cut_off():
    certificate, shown = LONG(), squeezed("".join(pages(LONG_PDF())))
    for text in texts(msgspec.to_builtins(replace(certificate, findings=[]))):
        assert squeezed(text).casefold() in shown.casefold()
    for n in range(200):  # the foot of a page may stand between
        assert f"inding{n}begins" in shown
        assert f"and{n}ends" in shown
    assert page_text(certificate).count("Unbreakable") >= 150


def test_no_text_leaves_the_page(monkeypatch):
    from PIL import Image

    compiled, taken = typst.compile, []

    def spy(source, **given):
        taken.append((source, given))
        return compiled(source, **given)

    monkeypatch.setattr(typst, "compile", spy)
    render_pdf(LONG())
    source, given = taken[-1]
    images = compiled(source, **{**given, "format": "png", "ppi": 50.0, "pdf_standards": []})
    assert len(images) > 5
    for data in images:
        with Image.open(io.BytesIO(data)) as image:
            grey, step = image.convert("L"), image.width / 210
            edges = [(0, 0, 15 * step, image.height), (195 * step, 0, image.width, image.height)]
            edges += [(0, 0, image.width, 8 * step), (0, 290 * step, image.width, image.height)]
            darkest = [grey.crop(tuple(map(int, edge))).getextrema()[0] for edge in edges]
        assert darkest == [255] * 4


def neighbours(boxes):
    """Pairs of boxes, sorted by their left edges, of which one begins before the other ends."""
    for place, box in enumerate(boxes):
        for other in boxes[place + 1 :]:
            if other[0] >= box[2]:
                break
            yield box, other


@pytest.mark.skipif(shutil.which("pdftotext") is None, reason="poppler is not installed")
def test_no_text_lies_on_another(tmp_path):
    for pdf in (render_pdf(SAMPLE), LONG_PDF()):
        path = tmp_path / "c.pdf"
        path.write_bytes(pdf)
        boxes = subprocess.run(
            ["pdftotext", "-bbox", str(path), "-"],
            capture_output=True,
            check=True,
            encoding="utf-8",
        ).stdout
        number = r'"([\d.]+)"'
        pattern = rf"<word xMin={number} yMin={number} xMax={number} yMax={number}>(.*?)</word>"
        for page in boxes.split("<page ")[1:]:
            words = sorted(
                (float(x0), float(y0), float(x1), float(y1), word)
                for x0, y0, x1, y1, word in re.findall(pattern, page)
            )
            for a, b in neighbours(words):
                wide, high = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
                assert wide < 1 or high < 3, (a, b)
