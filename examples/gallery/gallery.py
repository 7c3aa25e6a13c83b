"""Pictures of every page that mwdcal makes: writes docs/gallery.md and docs/gallery/*.png.

    make gallery        (two minutes; needs Chromium, Playwright and pdftoppm)

`--check` says whether a command, an input or what draws the pages has changed since the pictures were taken.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from playwright.sync_api import Page

ROOT = Path(__file__).resolve().parents[2]
PICTURES = ROOT / "docs" / "gallery"
STATE = PICTURES / "sources.json"
INPUTS = ("examples/servo/*.*", "examples/registry/*.py", "src/mwdcal/presentation/templates/*")
"""Files that the pictures rest on besides the commands."""
WIDE, HIGH, SHOWN = 860, 900, 860
"""Usual pixels of the browser's window, and width of a picture."""
LARGEST = 150_000
FIGURES = 8
"""Most figures of a page that get a picture of their own."""


@dataclass(frozen=True)
class Item:
    """A page and the lines that make it; the last line writes `page`."""

    title: str
    page: str
    lines: tuple[str, ...]
    wide: int = WIDE
    """Pixels of the browser's window."""

    @property
    def name(self) -> str:
        """Stem of its pictures."""
        return Path(self.page).stem

    @property
    def digest(self) -> str:
        """SHA-256 of the lines and of what they rest on."""
        paths = sorted({path for pattern in INPUTS for path in ROOT.glob(pattern)})
        parts = [
            "\n".join(self.lines).replace(str(ROOT), "").encode(),
            *(p.read_bytes() for p in paths if p.is_file()),
        ]
        return hashlib.sha256(b"\0".join(parts)).hexdigest()


RUN = "demo/run.csv --tool demo/tool.toml"
REGISTRY = "mwdcal registry --registry tools.sqlite"
ITEMS = (
    Item(
        "Report of a calibration",
        "report.html",
        (
            "mwdcal example demo",
            f"mwdcal calibrate {RUN} -o demo/tool.json --report report.html",
        ),
    ),
    Item(
        "Roll test",
        "rolltest.html",
        ("mwdcal verify demo/tool.json demo/rolltest.csv --report rolltest.html",),
    ),
    Item(
        "Calibration over temperature",
        "temperature.html",
        (
            "mwdcal simulate --plan laboratory-thermal --tool servo --seed 1 -o soaks.csv",
            "mwdcal calibrate soaks.csv --tool servo --order 1 -o soaks.json --report temperature.html",
        ),
    ),
    Item("Methods side by side", "methods.html", (f"mwdcal compare {RUN} --report methods.html",)),
    Item(
        "Run sheet of a plan",
        "sheet.html",
        ("mwdcal plan --stations 24 --tool demo/tool.toml -o plan.csv --report sheet.html",),
        wide=1125,
    ),
    Item(
        "A procedure, a hundred times",
        "tools.png",
        (
            "mwdcal simulate --plan moosavi-12 --tool servo --repeat 100 -o tools.parquet --plot tools.png",
        ),
    ),
    Item(
        "Stations of a log",
        "log.html",
        ("mwdcal stations demo/log.csv -o stations.csv --report log.html",),
    ),
    Item(
        "Noise of a tool at rest",
        "noise.html",
        ("mwdcal noise demo/static.csv --tool demo/tool.toml --report noise.html",),
    ),
    Item(
        "Surveys of a well",
        "well.html",
        ("mwdcal survey demo/tool.json demo/well.csv -o well.csv --report well.html",),
    ),
    Item(
        "Interference of the drill string",
        "msa.html",
        ("mwdcal survey demo/tool.json demo/well.csv --msa -o msa.csv --report msa.html",),
    ),
    Item(
        "Diagnosis",
        "diagnosis.html",
        ("mwdcal diagnose demo/tool.json demo/rolltest.csv --report diagnosis.html",),
    ),
    Item(
        "Certificate, page",
        "C.html",
        (
            "mwdcal verify demo/tool.json demo/rolltest.csv --json > test.json",
            "mwdcal certificate demo/tool.json --verification test.json --laboratory demo/laboratory.toml -o C.html",
        ),
    ),
    Item(
        "Certificate, PDF",
        "sheets.pdf",
        (
            "mwdcal certificate demo/tool.json --verification test.json --laboratory demo/laboratory.toml "
            "-o sheets.pdf",
        ),
    ),
    Item(
        "Fleet",
        "fleet.html",
        (
            f"python {ROOT}/examples/registry/laboratory.py laboratory --tools 30",
            "mwdcal fleet laboratory/runs/2022 -o 2022.parquet --tool laboratory/tool.toml",
            "mwdcal fleet laboratory/runs/2023 -o 2023.parquet --tool laboratory/tool.toml",
            "mwdcal fleet laboratory/runs/2024 -o 2024.parquet --tool laboratory/tool.toml --report fleet.html",
        ),
    ),
    Item(
        "Drift of a tool",
        "drift.html",
        (
            f"{REGISTRY} init",
            f"{REGISTRY} add laboratory/tool.toml laboratory/runs 2022.parquet 2023.parquet 2024.parquet",
            f"{REGISTRY} drift SIM-0001 --date 2024-12-01 --report drift.html",
        ),
    ),
    Item(
        "Drift of a laboratory's tools",
        "due.html",
        (f"{REGISTRY} drift --date 2024-12-01 --report due.html",),
    ),
)  # fmt: skip


def run(line: str, folder: Path) -> None:
    """Run a line in a folder; PASS or FAIL, both make a page."""
    words, _, target = line.partition(" > ")
    program, _, rest = words.partition(" ")
    command = [sys.executable, *(["-m", "mwdcal"] if program == "mwdcal" else []), *rest.split()]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 1):
        sys.exit(f"{line}\n{done.stderr}")
    if target:
        (folder / target).write_text(done.stdout, "utf-8")


def store(name: str, data: bytes) -> str:
    """Write a picture with few colours and a file of at most `LARGEST` bytes; its name."""
    from PIL import Image

    picture = Image.open(io.BytesIO(data)).convert("RGB")
    if picture.width > SHOWN:
        height = round(picture.height * SHOWN / picture.width)
        picture = picture.resize((SHOWN, height), Image.Resampling.LANCZOS)
    for colours in (128, 64, 32, 16):
        out = io.BytesIO()
        picture.quantize(colours, dither=Image.Dither.NONE).save(out, "PNG", optimize=True)
        if out.tell() <= LARGEST:
            break
    (PICTURES / f"{name}.png").write_bytes(out.getvalue())
    return f"{name}.png"


def pictures(item: Item, folder: Path, browser: Page) -> Iterator[str]:
    """Names of the pictures of a page: its top, then its figures."""
    path = folder / item.page
    if path.suffix == ".png":
        yield store(item.name, path.read_bytes())
    elif path.suffix == ".pdf":
        command = ["pdftoppm", "-png", "-r", "90", "-f", "1", "-l", "1", path]
        yield store(item.name, subprocess.run(command, capture_output=True, check=True).stdout)
    else:
        browser.set_viewport_size({"width": item.wide, "height": HIGH})
        browser.goto(path.as_uri())
        browser.wait_for_timeout(300)
        yield store(item.name, browser.screenshot())
        figures = [f for f in browser.locator("figure").all() if f.is_visible()]
        for number, figure in enumerate(figures[:FIGURES], 1):
            yield store(f"{item.name}-{number}", figure.screenshot())


HEAD = """# Gallery

Each page that mwdcal makes, with the lines that make it. Every tool here is **simulated**. `make gallery` takes the
pictures.

## The bench

![The bench asks for a station](bench/measuring-1280-light.png)

```
mwdcal bench --demo
```

[A session at the bench](tutorials/bench.md)
"""


def section(item: Item, names: list[str]) -> str:
    """Heading, pictures and lines of a page."""
    lines = "\n".join(line.replace(f"{ROOT}/", "") for line in item.lines)
    shown = "\n\n".join(
        f"![{item.title}{f', figure {i}' if i else ''}](gallery/{name})"
        for i, name in enumerate(names)
    )
    return f"\n## {item.title}\n\n{shown}\n\n```\n{lines}\n```\n"


def old() -> list[str]:
    """Titles of the items whose pictures are older than what they show."""
    state = json.loads(STATE.read_text("utf-8")) if STATE.exists() else {}
    return [item.title for item in ITEMS if state.get(item.name) != item.digest]


def take() -> None:
    """Run every line, and write pictures, page and state."""
    from playwright.sync_api import sync_playwright

    PICTURES.mkdir(exist_ok=True)
    for picture in PICTURES.glob("*.png"):
        picture.unlink()
    text = HEAD
    with tempfile.TemporaryDirectory() as name, sync_playwright() as driver:
        chromium = driver.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        browser = chromium.new_page(viewport={"width": WIDE, "height": HIGH})
        for item in ITEMS:
            for line in item.lines:
                run(line, Path(name))
            text += section(item, [*pictures(item, Path(name), browser)])
        chromium.close()
    (PICTURES.parent / "gallery.md").write_text(text, "utf-8")
    state = {item.name: item.digest for item in ITEMS}
    STATE.write_text(json.dumps(state, indent=2) + "\n", "utf-8")


def main() -> None:
    """Take the pictures, or say which are old."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing")
    if not parser.parse_args().check:
        take()
    elif found := old():
        sys.exit(f"the gallery is old: make gallery ({', '.join(found)})")


if __name__ == "__main__":
    main()
