"""Command lines of a page of the documentation, with the output that the page shows; standard library alone."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]


def lines_of(page):
    """The lines of a page, each with the lines that the page shows of its output, None where it shows none."""
    text = (ROOT / page).read_text("utf-8")
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    of_line = re.compile(r"^(\$ )?mwdcal (.*)\n((?:(?!\$ |mwdcal ).*\n)*)", re.MULTILINE)
    joined = [re.sub(r"\\\n *", "", block) for language, block in blocks if not language]
    runs = [run for block in joined for run in of_line.findall(block)]
    return [(line, shown.split("\n")[:-1] if dollar else None) for dollar, line, shown in runs]


def follow_each_other(shown, printed):
    """Whether lines are those that were printed, in that order, with any lines in the place of dots."""
    pieces = "\n".join(shown).split("…\n")
    pattern = r"(?:.*\n)*".join(
        re.escape(piece) for piece in [*pieces[:-1], pieces[-1].rstrip("…")]
    )
    return re.fullmatch(pattern + (r"(?:.*\n?)*" if shown[-1] == "…" else r"\n*"), printed)
