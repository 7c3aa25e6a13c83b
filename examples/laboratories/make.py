"""Three laboratories' tables and a roll test of each tool in the same form; and a table that leaves a question open.

Written by `PYTHONPATH=tests python examples/laboratories/make.py`.

The tables are those of `tests/laboratories.py`. A roll test has the readings that the same tool, as the table shows it,
gives at other attitudes: twelve toolfaces at 40° inclination.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from laboratories import ABERDEEN, CELLE, XIAN, Laboratory, directions_of, laboratories, rendered

FOLDER = Path(__file__).resolve().parent
PLACES = {"aberdeen_job_0117": ABERDEEN, "celle_c1187": CELLE, "xian_2309": XIAN}
QUESTION = "tulsa_pair"
ATTITUDES = np.array([(40.0, 155.0, 30.0 * k + 4.0) for k in range(12)])
ANGLES = dict(
    zip(("ref_inclination_deg", "ref_azimuth_deg", "ref_toolface_deg"), ATTITUDES.T, strict=True)
)
RAW = ("ax", "ay", "az", "mx", "my", "mz")


def rolled(each: Laboratory) -> dict[str, np.ndarray]:
    """Raw readings at the attitudes of the roll test: each channel as a straight line of gravity or field."""
    truth = each.truth
    ones = np.ones(len(truth["ax"]))
    angles = np.radians(np.array([truth[name] for name in ANGLES]).T)
    dip = np.radians(np.asarray(truth.get("ref_dip_deg", PLACES[each.name].dip)) * ones)
    field = np.asarray(truth.get("ref_field_nt", PLACES[each.name].field)) * ones
    rng, turned = np.random.default_rng(11), np.radians(ATTITUDES)
    before, after = directions_of(angles, dip), directions_of(turned, np.full(12, dip.mean()))
    raw = {}
    for name in RAW:
        kind = name[0] == "m"
        known, new = (
            v[kind] * (s[:, None] if kind else 1)
            for v, s in ((before, field), (after, np.full(12, field.mean())))
        )
        line = np.linalg.lstsq(np.column_stack([known, ones]), truth[name], rcond=None)[0]
        noise = np.std(truth[name] - np.column_stack([known, ones]) @ line)
        raw[name] = np.column_stack([new, np.ones(12)]) @ line + rng.normal(0, noise, 12)
    return raw


def retested(each: Laboratory) -> Laboratory:
    """The laboratory's table with the readings of a roll test in its first twelve rows alone, on a sheet called so."""
    form, values = each.form, {**rolled(each), **ANGLES}
    grid = [list(row) for row in form.sheets[form.at].grid]
    for place, line in enumerate(form.rows[:12]):
        for column, key in enumerate(form.keys):
            if key in values:
                grid[line][column] = like(grid[line][column], values[key][place])
    kept = tuple(tuple(row) for line, row in enumerate(grid) if line <= form.rows[11])
    name = "Roll test" if form.sheets[form.at].name else ""
    sheets = [
        s._replace(grid=kept, name=name) if k == form.at else s for k, s in enumerate(form.sheets)
    ]
    return replace(
        each, content=rendered(replace(form, sheets=tuple(sheets), rows=form.rows[:12]), each.file)
    )


def like(cell, value):
    """A number as the cell that it replaces is written."""
    if not isinstance(cell, str):
        return round(float(value), 6)
    decimals = len(cell.replace(",", ".").partition(".")[2])
    text = f"{value:.{decimals}f}"
    return text.replace(".", ",") if "," in cell else text


if __name__ == "__main__":
    for each in laboratories():
        path = FOLDER / each.file
        if each.name in (*PLACES, QUESTION):
            path.write_bytes(each.content)
        if each.name in PLACES:
            path.with_stem(path.stem + "_roll").write_bytes(retested(each).content)
