"""Pages as a reader has them: in Chromium, wide and narrow, light and dark, printed, without the network.

Skips where Chromium or what drives it (the extra `dev`) is missing; `page_faults.js` says what a
reader could not read.
"""

import io
import re
from functools import cached_property
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

import chromium
from chromium import AXE, CHROMIUM, RUN_AXE
from cli_support import EXAMPLE, called, commands, mwdcal, read_csv, servo_run, write_csv

pypdf = pytest.importorskip("pypdf", reason="pypdf is not installed")
pytest.importorskip("matplotlib", reason="matplotlib is not installed")

from matplotlib.patheffects import withStroke  # noqa: E402
from PIL import Image  # noqa: E402

from mwdcal.presentation.page import environment  # noqa: E402
from mwdcal.use import plots  # noqa: E402

browser = chromium.browser
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed: no page was looked at"),
]
FAULTS = (Path(__file__).parent / "page_faults.js").read_text("utf-8")
WIDTHS = (1280, 420)
SCHEMES = ("light", "dark")
MOST_SHEETS = 16
"""Of paper, for any sample."""
TOOL = ("--tool", EXAMPLE / "tool.toml")
SAMPLES = {
    "calibrate": ("calibrate", "moved.csv", *TOOL, "-o", "new.json"),
    "calibrate-soaks": ("calibrate", "soaks.csv", *TOOL, "--order", "1", "-o", "new.json"),
    "verify": ("verify", "tool.json", EXAMPLE / "rolltest.csv"),
    "verify-failed": ("verify", "tool.json", EXAMPLE / "rolltest.csv", "--limits", "tight.toml"),
    "diagnose": ("diagnose", "tool.json", EXAMPLE / "rolltest.csv"),
    "diagnose-named": ("diagnose", "tool.json", "knocked.csv"),
    "compare": ("compare", EXAMPLE / "run.csv", *TOOL),
    "fleet": ("fleet", "fleet.parquet", *TOOL, "-o", "new.parquet", "--workers", "1"),
    "noise": ("noise", EXAMPLE / "static.csv", *TOOL),
    "noise-moving": ("noise", EXAMPLE / "log.csv", *TOOL),
    "stations": ("stations", EXAMPLE / "log.csv", "-o", "new.csv"),
    "plan": ("plan", *TOOL, "--plan", "laboratory-thermal", "--plan", "moosavi-12"),
    "survey": ("survey", "tool.json", EXAMPLE / "well.csv", "-o", "new.csv"),
    "certificate": (
        *("certificate", "tool.json", "--laboratory", EXAMPLE / "laboratory.toml"),
        *("--verification", "left.json", "--as-found", "found.json"),
    ),
    "registry-drift": ("registry", "drift", "SIM-0001", "--registry", "tools.sqlite"),
    "registry-drift-fleet": ("registry", "drift", "--registry", "tools.sqlite"),
    "survey-rejected": ("survey", "tool.json", "iron.csv", "-o", "new.csv"),
}
"""Commands that also write a page, by the name of the sample."""


def page_options(command):
    """Options of a command that name a page to write, the usual ones first."""
    options = [(option.opts[0], option.metavar or "") for option in command.params]
    usual = [name for name, _ in options if name == "--report"]
    return usual or [name for name, metavar in options if ".html" in metavar]


def with_a_page():
    """Commands that can write a page."""
    return {name for name, command in commands().items() if page_options(command)}


PAGES = [name for name, typed in SAMPLES.items() if called(typed) in with_a_page()]


def test_every_command_with_a_page_has_a_sample():
    missing = with_a_page() - {called(typed) for typed in SAMPLES.values()}
    assert not missing, f"add a sample of {', '.join(missing)} to SAMPLES, so that its page is seen"


# ------------------------------------------------------------------ the pages


def moved(source, target):
    """The run of the example with one station that moved."""
    columns = read_csv(source)
    columns["az"][6] = f"{float(columns['az'][6]) + 0.0039:.6f}"
    return write_csv(target, columns, 'simulated = "yes"', 'serial = "T-7"')


def fleet(target):
    """Thirty tools, some with a fault."""
    fleets = pytest.importorskip("test_fleet", reason="pyarrow is not installed")
    tools = {f"T{seed:03}": fleets.short_run(seed) for seed in range(27)}
    tools["T027"] = fleets.short_run(27, mx=np.zeros(28))
    tools["T028"] = {k: v[:3] for k, v in fleets.short_run(28).items()}
    tools["T029"] = fleets.short_run(29, ref_field_nt=np.full(28, np.nan))
    fleets.write_fleet(target, tools, {"simulated": True})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pages")
    moved(EXAMPLE / "run.csv", folder / "moved.csv")
    soaks = servo_run(3, (10, 60, 110), 6, (20.0, 60.0, 100.0, 140.0))
    write_csv(folder / "soaks.csv", soaks, 'simulated = "yes"', 'serial = "T-8"')
    limits = 'name = "tight"\n[error]\ninclination_deg = 0.001\nazimuth_deg = 2\n'
    (folder / "tight.toml").write_text(limits, "utf-8")
    ran = mwdcal("calibrate", EXAMPLE / "run.csv", *TOOL, "-o", folder / "tool.json")
    assert ran.code == 0, ran
    before = ("--method", "least-squares", "-o", folder / "before.json")
    assert mwdcal("calibrate", EXAMPLE / "run.csv", *TOOL, *before).code == 0
    tight = ("--limits", folder / "tight.toml")
    for when, name, *limits in (("left", "tool"), ("found", "before", *tight)):
        ran = mwdcal("verify", folder / f"{name}.json", EXAMPLE / "rolltest.csv", *limits, "--json")
        (folder / f"{when}.json").write_text(ran.out, "utf-8")
    fleet(folder / "fleet.parquet")
    registry = ("registry", "--registry", folder / "tools.sqlite")
    assert mwdcal(*registry, "init").code == 0
    assert mwdcal(*registry, "add", folder / "tool.json", folder / "before.json").code == 0
    knocked = read_csv(EXAMPLE / "rolltest.csv")
    knocked["ay"] = [f"{float(v) + 0.015:.6f}" for v in knocked["ay"]]
    write_csv(folder / "knocked.csv", knocked, 'simulated = "yes"', 'serial = "SIM-0001"')
    iron = read_csv(EXAMPLE / "well.csv")
    iron["mz"] = [f"{float(v) + 0.06:.6f}" for v in iron["mz"]]
    write_csv(folder / "iron.csv", iron, 'simulated = "yes"')
    return folder


class Sheet:
    """A printed page."""

    def __init__(self, page):
        self.page = page

    @cached_property
    def text(self):
        """Blanks may be as they like; a page of pictures takes seconds to read."""
        return " ".join(self.page.extract_text().split())

    @property
    def blank(self):
        """Whether nothing is on it but the foot: little is drawn, and few words."""
        return len(self.page.get_contents().get_data()) < 1500 and len(self.text) < 150


class Seen:
    """A page in the browser, what it asked for and what the browser complained of."""

    def __init__(self, browser, path, **options):
        self.context = browser.new_context(**options)
        self.page = self.context.new_page()
        self.complaints = []
        self.page.on("console", lambda message: self.complaints.append(message.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", self._request)
        self.path = path
        self.page.goto(path.as_uri())

    def _request(self, request):
        if request.url != self.path.as_uri():
            self.complaints.append(request.url)

    def look(self, width, scheme):
        self.page.set_viewport_size({"width": width, "height": 900})
        self.page.emulate_media(color_scheme=scheme)

    def unfold(self):
        """Opens what is folded."""
        self.page.eval_on_selector_all(
            "details", "all => all.forEach((fold) => (fold.open = true))"
        )

    def faults(self):
        self.unfold()
        return self.page.evaluate(FAULTS)

    def accessibility_faults(self):
        """Every fault that axe-core finds, good practice too."""
        found = self.page.evaluate(RUN_AXE)["violations"]
        return [f"{rule['id']}: {rule['nodes'][0]['html'][:200]}" for rule in found]

    def shorten(self):
        """Leaves out what axe-core would look at for minutes: the insides of pictures, rows like others."""
        self.page.evaluate(AXE)
        self.page.evaluate(
            """() => {
                document.querySelectorAll("svg").forEach((svg) => svg.replaceChildren());
                for (const body of document.querySelectorAll("tbody"))
                    [...body.rows].slice(6).forEach((row) => row.className || row.remove());
            }"""
        )

    def paper(self):
        """The printed pages."""
        printed = pypdf.PdfReader(io.BytesIO(self.page.pdf(prefer_css_page_size=True)))
        return [Sheet(page) for page in printed.pages]

    def paper_faults(self):
        """What is missing on the first sheet, and sheets with nothing on them."""
        headlines = self.page.locator(".headline").all_inner_texts()[:1]
        first = [" ".join(text.split()) for text in headlines]
        if self.page.locator("#signatures").count():
            first += ["Calibrated by", "Approved by", "name", "signature", "date"]
        paper = self.paper()
        faults = [
            f"not on the first sheet: {words}" for words in first if words not in paper[0].text
        ]
        faults += [f"blank: sheet {number}" for number, sheet in enumerate(paper, 1) if sheet.blank]
        return faults + [f"{len(paper)} sheets"] * (len(paper) > MOST_SHEETS)

    def light(self, selector, *view):
        """Mean lightness of an element, 0 to 255."""
        self.look(*view)
        shot = self.page.locator(selector).first.screenshot()
        return float(np.mean(Image.open(io.BytesIO(shot)).convert("L")))


@pytest.fixture
def open_page(browser):
    """Opens files, and closes them at the end."""
    seen = []

    def opened(path, **options):
        seen.append(Seen(browser, path, **options))
        return seen[-1]

    yield opened
    for each in seen:
        each.context.close()


@pytest.fixture
def written(folder, monkeypatch):
    """The page of a sample."""
    monkeypatch.chdir(folder)

    def page(name):
        path = folder / f"{name}.html"
        if not path.exists():
            option, *_ = page_options(commands()[called(SAMPLES[name])])
            ran = mwdcal(*SAMPLES[name], option, path)
            assert path.exists(), ran
        return path

    return page


@pytest.mark.parametrize("name", PAGES)
def test_a_page_can_be_read_by_everybody(written, open_page, name):
    seen = open_page(written(name))
    views = [*zip(WIDTHS, SCHEMES, strict=True)]
    faults = {"printed": seen.paper_faults()}
    if seen.page.locator("figure").count():
        light, dark = (seen.light("figure", WIDTHS[0], scheme) for scheme in SCHEMES)
        assert light > 200, light
        assert dark < 90, dark
    for view in views:  # a place does not depend on the colours
        seen.look(*view)
        faults[view] = seen.faults()
    seen.shorten()
    for view in views:
        seen.look(*view)
        faults[view] += seen.accessibility_faults()
    assert faults == {"printed": [], **{view: [] for view in views}}
    assert seen.complaints == []


@pytest.mark.parametrize("sheet", ["presentation/templates/style.css", "bench/static/bench.css"])
def test_only_colours_change_in_the_dark(sheet):
    """So faults of places are looked for in one scheme at each width."""
    style = (files("mwdcal") / sheet).read_text("utf-8")
    _, dark, _ = re.split(
        r"@media \(prefers-color-scheme: dark\) \{(.*?\}\s*)\}\n", style, flags=re.DOTALL
    )
    assert "prefers-color-scheme" not in style.replace(dark, "", 1).partition("dark) {")[2]
    declared = re.findall(r"([\w-]+):\s*([^;]+);", dark)
    assert len(declared) > 8
    for name, value in declared:
        is_colour = name.startswith("--") and re.fullmatch(r"#[0-9a-f]{3,8}", value)
        assert is_colour or name in ("filter", "mix-blend-mode", "color-scheme"), name


def test_the_table_of_a_verification_fits_a_narrow_page(written, open_page):
    seen = open_page(written("verify"))
    seen.look(WIDTHS[1], "light")
    wide = (
        "e => [e, ...e.querySelectorAll('td, caption')].map((x) => x.getBoundingClientRect().right)"
    )
    rights = seen.page.eval_on_selector("#verdict", wide)
    assert len(rights) > 10
    assert max(rights) <= WIDTHS[1]
    assert "noise-free" in seen.page.inner_text("#verdict caption")


def test_a_page_says_the_same_without_its_script(written, open_page):
    plain = open_page(written("calibrate"), java_script_enabled=False)
    helped = open_page(written("calibrate"))
    assert plain.page.inner_text("main") == helped.page.inner_text("main")


def test_a_station_is_shown_in_every_picture_and_table(written, open_page):
    """Under the pointer, and by a click that opens the folded table of its row."""
    seen = open_page(written("calibrate"))
    seen.look(1280, "light")
    points = seen.page.locator("#residuals figure use[data-name^='station 7:']")
    points.first.scroll_into_view_if_needed()
    box = points.first.bounding_box()
    seen.page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    linked = seen.page.locator(".linked")
    assert linked.count() > 8  # spheres, six errors after and before, the misfit, and rows
    names = seen.page.eval_on_selector_all(
        ".linked", "all => all.map((e) => e.dataset.name ?? e.dataset.point)"
    )
    assert {name.split(":")[0] for name in names} == {"station 7"}
    row = seen.page.locator("#stations tr[data-point='station 7']")
    assert not row.is_visible()
    seen.page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    assert row.is_visible()
    assert seen.complaints == []


def test_folded_tables_are_printed(written, open_page):
    sheets = open_page(written("calibrate"), java_script_enabled=False).paper()
    assert any("SHA-256" in sheet.text for sheet in sheets)
    assert any("largest change" in sheet.text for sheet in sheets)


# ------------------------------------------------------------------ planted faults are found


@pytest.fixture
def planted(tmp_path, open_page):
    """Opens a page with our layout and this content."""

    def opened(content, **options):
        blocks = {"title": "T", "footer": "f", "kind": "k", "name": "n", "side": "s"}
        template = "{% extends 'layout.html' %}" + "".join(
            f"{{% block {name} %}}{text}{{% endblock %}}"
            for name, text in {**blocks, "content": content}.items()
        )
        path = tmp_path / "planted.html"
        path.write_text(environment().from_string(template).render(simulated=False, **options))
        seen = open_page(path)
        seen.look(420, "light")
        return seen

    return opened


@plots.style()
def picture(*places, **look):
    figure, [[axes]] = plots.new_figure("two texts", 2)
    for place in places:
        axes.annotate("a word in a picture", place, xycoords="figure fraction", **look)
    return figure


PLACED = "<p style='position: absolute; margin: 0; left: {}px; top: {}px'>words that stand here</p>"
PICTURE = "<figure>{{ drawn | svg('planted') }}</figure>"


@pytest.mark.parametrize(
    ("fault", "content", "drawn"),
    [
        ("overlap", PLACED.format(20, 200) + PLACED.format(60, 208), None),
        ("overlap", PICTURE, ((0.3, 0.5), (0.35, 0.53))),
        ("cut", "<div style='overflow: hidden; height: 6px'>cut off</div>", None),
        ("cut", PICTURE, ((0.95, 0.5),)),
        ("out of its cell", "<table style='table-layout: fixed; width: 40px'><tr><td>far too wide a cell", None),
        ("beyond the page", PLACED.format(-30, 200), None),
        ("the page is", "<div style='width: 600px'>wide</div>", None),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_found(planted, fault, content, drawn):
    options = {"drawn": picture(*drawn)} if drawn else {}
    found = planted(content, **options).faults()
    assert any(line.startswith(fault) for line in found), found


def test_words_with_a_halo_are_words(planted):
    halo = {"path_effects": [withStroke(linewidth=2, foreground="white")]}
    assert planted(PICTURE, drawn=picture((0.3, 0.5), (0.35, 0.53), **halo)).faults()
    assert not planted(PICTURE, drawn=picture((0.3, 0.5), (0.3, 0.7), **halo)).faults()


def test_words_side_by_side_are_no_fault(planted):
    apart = PLACED.format(20, 200) + PLACED.format(20, 222)
    assert planted(apart).faults() == []
    drawn = picture((0.1, 0.5), (0.16, 0.5), (0.6, 0.5), rotation=60)
    assert planted(PICTURE, drawn=drawn).faults() == []


def test_inaccessible_content_is_found(planted):
    seen = planted("<p style='color: #aaa'>pale</p>")
    seen.shorten()
    (fault,) = seen.accessibility_faults()
    assert fault.startswith("color-contrast")


@pytest.mark.parametrize(
    "content",
    [
        "<img src='http://127.0.0.1:9/a.png' alt=''>",
        "<script src='http://127.0.0.1:9/a.js'></script>",
        "<script>document.title = 'run'</script>",
        "<p onclick='alert(1)'>text</p><script>document.querySelector('p').click()</script>",
    ],
)
def test_a_page_may_ask_for_nothing_and_run_nothing_but_its_script(planted, content):
    seen = planted(content)
    assert any("Content Security Policy" in line for line in seen.complaints)
    assert seen.page.title() == "T"


def test_a_blank_sheet_is_found(planted):
    seen = planted("<p>one</p><div class='page'></div><p class='page'>" + "words " * 60 + "</p>")
    assert [sheet.blank for sheet in seen.paper()] == [True, True, False]


def test_heads_are_repeated_on_paper(planted):
    rows = [(f"P{number}", str(number)) for number in range(120)]
    paper = planted(table_of(rows)).paper()
    assert len(paper) > 2
    assert all("label" in sheet.text and "first" in sheet.text for sheet in paper)


def test_a_caption_is_on_the_sheet_of_its_picture(planted):
    """Even if a table follows that has no room there."""
    picture = "<figure>picture<div style='height: 120mm'></div></figure><p class='soft'>caption</p>"
    table = f"<div class='keep' style='height: 150mm'>{table_of([('P1', '1')])}</div>"
    paper = planted(picture + table).paper()
    assert len(paper) == 2
    assert "picture" in paper[0].text
    assert "caption" in paper[0].text


def test_a_narrow_screen_shows_the_values_of_a_table_of_few_columns(planted):
    content = "<div class='scroll'>" + table_of([("a quantity", "1")]) + "</div>"
    few = planted(content.replace("<table", "<table class='full'")).page
    assert few.locator("td").last.bounding_box()["x"] < 420


# ------------------------------------------------------------------ a closer look


CELLS = ["10", "−2.5", "–", "3.0×10⁻²", "7", "1e-3", "9", "8", "−11"]
UPWARDS = ["−11", "−2.5", "1e-3", "3.0×10⁻²", "7", "8", "9", "10", "–"]
LABELS = ["P10", "P9", "P1", "P2", "P3", "P4", "P5", "P6", "P7"]
HEADS = "<tr><th rowspan=2>label</th><th colspan=2>values</th></tr><tr><th>first</th><th></th></tr>"


def table_of(rows):
    body = "".join(f"<tr><td>{label}</td><td>{cell}</td><td>x</td></tr>" for label, cell in rows)
    return f"<table><thead>{HEADS}</thead><tbody>{body}</tbody></table>"


def column(page, number):
    return page.locator(f"tbody td:nth-child({number})").all_inner_texts()


def test_tables_are_sorted_by_numbers_with_dashes_last(planted):
    page = planted(table_of(zip(LABELS, CELLS, strict=True))).page
    assert page.locator("th [role=button]").all_inner_texts() == ["label", "first"]
    head = page.locator("th", has_text="first")
    states = []
    for _ in range(3):
        head.get_by_role("button").click()
        states.append((head.get_attribute("aria-sort"), column(page, 2)))
    assert states == [
        ("ascending", UPWARDS),
        ("descending", [*UPWARDS[-2::-1], "–"]),
        ("none", CELLS),
    ]


def test_tables_are_sorted_by_the_keyboard_and_by_labels(planted):
    page = planted(table_of(zip(LABELS, CELLS, strict=True))).page
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    assert column(page, 1) == ["P1", "P2", "P3", "P4", "P5", "P6", "P7", "P9", "P10"]


@pytest.mark.parametrize(
    "content",
    [
        table_of([*zip(LABELS, CELLS, strict=True)][:5]),
        table_of(zip(LABELS, CELLS, strict=True)).replace("<td>x", "<td rowspan=2>x", 1),
    ],
)
def test_short_and_grouped_tables_stay(planted, content):
    assert planted(content).page.get_by_role("button").count() == 0


def number(text):
    return float(re.search(r"[−\d.]+", text)[0].replace("−", "-"))


def test_points_of_a_picture_say_their_station_and_value(written, open_page):
    seen = open_page(written("calibrate"))
    page = seen.page
    rows = page.locator("#stations tbody tr")
    seen.unfold()
    expected = {row.split("\t")[0]: row.split("\t") for row in rows.all_inner_texts()}
    picture = page.locator("figure svg", has=page.locator("use[data-name]")).last
    picture.focus()
    told = []
    for _ in range(8):
        page.keyboard.press("ArrowRight")
        told.append(page.inner_text(".tip"))
    labels = [re.fullmatch(r"station (\S+): (\S+) σ", line)[1] for line in told]
    misfits = [number(line.partition(":")[2]) for line in told]
    shown = [number(expected[label][-2]) for label in labels]
    assert misfits == pytest.approx(shown, abs=0.0501)
    assert len(set(labels)) == 8
    page.keyboard.press("Escape")
    assert page.inner_text(".tip") == ""
    box = picture.locator("use[data-name]").nth(4).bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2 + 2, box["y"] + box["height"] / 2)
    assert page.inner_text(".tip") == told[4]
    assert seen.faults() == [] or page.locator(".tip").count() == 1


def test_names_of_points_are_escaped(planted):
    figure = picture((0.1, 0.1))
    plots.named_points(figure.axes[0], np.arange(2), np.array([1.0, np.nan]), ["<b>&", "lost"], "o")
    page = planted(PICTURE, drawn=figure).page
    assert page.locator("use[data-name]").evaluate_all("all => all.map((x) => x.dataset.name)") == [
        "<b>&"
    ]
