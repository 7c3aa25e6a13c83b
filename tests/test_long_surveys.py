"""Surveys of long tables, part by part: what comes of them is what comes of the table as a whole."""

from __future__ import annotations

import csv
import io
import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cli_support import EXAMPLE, refused
from cli_support import mwdcal as cli
from mwdcal.calibration.results import readings_at
from mwdcal.files import streams
from mwdcal.files.documents import read
from mwdcal.files.formats import text
from mwdcal.survey import acceptance, long_table, surveying
from mwdcal.survey.path import calibrated_path, continued_path
from mwdcal.survey.references import declination_sd

ROWS = 700


@pytest.fixture(scope="module")
def tool(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tool")
    fit = ("calibrate", EXAMPLE / "run.csv", "--tool", EXAMPLE / "tool.toml")
    assert cli(*fit, "-o", folder / "tool.json").code == 0
    return folder / "tool.json"


@pytest.fixture(autouse=True)
def _without_contributions(monkeypatch):
    """Long tables have none: these short ones stand for them."""
    monkeypatch.setattr(surveying, "MOST_CONTRIBUTED", 0)


@pytest.fixture
def in_parts(monkeypatch):
    """Every table is surveyed in parts of a few dozen rows."""

    def switch_on():
        monkeypatch.setattr(long_table, "LONG_TEXT", 1)
        monkeypatch.setattr(long_table, "LONG_ROWS", 1)
        monkeypatch.setattr(long_table, "_TEXT_ROWS", 60)
        monkeypatch.setattr(streams, "PIECE", 8000)
        monkeypatch.setattr(streams, "PART_ROWS", 60)

    return switch_on


def well(tool, seed=0):
    """Columns of a well that starts vertical and builds up, with noise, as texts."""
    rng, calibration = np.random.default_rng(seed), read(tool)
    md = np.linspace(0.0, 3000.0, ROWS)
    angles = np.radians([0.01 + 85 * (md / 3000), 40 + md / 60, rng.uniform(0, 360, ROWS)])
    shown = readings_at(calibration, *angles, 22 + 6 * rng.random(ROWS))
    columns = {"station": [f"S{i}" for i in range(ROWS)], "md_m": [f"{d:.3f}" for d in md]}
    for kind, names in (
        ("accelerometer", ("ax", "ay", "az")),
        ("magnetometer", ("mx", "my", "mz")),
    ):
        triad = getattr(calibration.profile, kind)
        raw = getattr(shown, kind) @ triad.permutation * (triad.scale or 1.0)
        raw *= 1 + 1e-4 * rng.standard_normal(raw.shape)
        columns |= {n: [f"{x:.6f}" for x in raw[:, i]] for i, n in enumerate(names)}
    columns["temperature_c"] = [f"{t:.2f}" for t in shown.temperature]
    earth = {"ref_gravity_g": 1.0, "ref_field_nt": 48000.0, "ref_dip_deg": 63.0}
    columns |= {name: [str(value)] * ROWS for name, value in earth.items()}
    return columns | {"note": ["ok"] * ROWS}


def written(path, columns, metadata=()):
    stream = io.StringIO()
    stream.writelines(f"# {line}\n" for line in metadata)
    writer = csv.writer(
        stream, delimiter="\t" if path.suffix == ".tsv" else ",", lineterminator="\n"
    )
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    path.write_text(stream.getvalue())
    return path


def gaps(columns, rng):
    for name in ("md_m", "ref_gravity_g", "ref_field_nt", "ref_dip_deg", "station"):
        for row in rng.integers(0, ROWS, 90):
            columns[name][row] = ""
    columns["ref_dip_deg"][200:500] = [""] * 300
    for row in rng.integers(0, ROWS, 60):
        columns["note"][row] = rng.choice(["a,b", 'say "x"', "=1+1", "  lead", "ü°"])


def hot(columns, rng):
    for row in rng.integers(0, ROWS, 30):
        columns["temperature_c"][row] = "55"
    for row in rng.integers(0, ROWS, 30):
        columns["ref_field_nt"][row] = "51000"
    columns["serial"] = ["SIM-0001"] * (ROWS - 1) + ["OTHER"]


def bare(columns, rng):
    for name in [*columns]:
        if name.startswith(("ref_", "md_m", "station")):
            del columns[name]
    columns["simulated"] = [""] * (ROWS - 1) + ["true"]


def swapped(columns, rng):
    columns["mx"], columns["my"] = columns["my"], columns["mx"]
    columns["declination_deg"] = [repr(value) for value in np.linspace(-2, 1, ROWS).tolist()]
    for name in ("ref_gravity_g", "ref_field_nt", "ref_dip_deg"):
        del columns[name]


def unmagnetic(columns, rng):
    for name in ("mx", "my", "mz"):
        columns[name] = [""] * ROWS


def norths(columns, rng):
    columns["ref_declination_deg"] = [repr(value) for value in np.linspace(1, 3, ROWS).tolist()]
    columns["sd_random_ref_declination_deg"] = ["0.2"] * ROWS


def repeated(columns, rng):
    """Two surveys at each depth, 8.6 m apart: below 10 m a term grows as the course gets shorter."""
    columns["md_m"] = [columns["md_m"][row - row % 2] for row in range(ROWS)]


CASES = {
    "gaps": (gaps, ["declination_deg = 2.5"], ("--json",)),
    "reference": (gaps, ["declination_deg = 2.5", 'date = "2024-05-01"'], ("--reference",)),
    "hot": (hot, ["declination_deg = 2", "convergence_deg = -1"], ("--outside", "extrapolate", "--tie-in", "1,2,3")),
    "switch": (hot, [], ("--switch", "10,20", "--limits", "fixed")),
    "bare": (bare, ["declination_deg = 2.5"], ()),
    "swapped": (swapped, [], ()),
    "unmagnetic": (unmagnetic, [], ()),
    "norths": (norths, [], ()),
    "repeated": (repeated, ["declination_deg = 2"], ("--tie-in", "0,0,40,0,0,0")),
}  # fmt: skip


def place(folder):
    made = cli(
        "reference", "--latitude", "60", "--longitude", "3.5", "--altitude-m", "40", "--date", "2026-07-01", "--json"
    )  # fmt: skip
    path = folder / "here.json"
    path.write_text(made.out)
    return path


def shown_last(screen):
    """Whether the last of the surveys stands behind the first thirty, by its label or number."""
    last = screen.partition(f"\n… {ROWS - 31} more")[2].partition("\n")[2]
    return last.split()[0] in (f"S{ROWS - 1}", str(ROWS))


@pytest.mark.parametrize("name", CASES)
def test_a_table_in_parts_gives_the_same_bytes(tool, tmp_path, in_parts, name):
    change, metadata, options = CASES[name]
    columns = well(tool)
    change(columns, np.random.default_rng(1))
    suffix = ".tsv" if name == "hot" else ".csv"
    source = written(tmp_path / f"well{suffix}", columns, metadata)
    if "--reference" in options:
        options = ("--reference", place(tmp_path))
    out = tmp_path / f"out{suffix}"
    whole = cli("survey", tool, source, "-o", out, *options)
    before = out.read_bytes()
    in_parts()
    parts = cli("survey", tool, source, "-o", out, *options)
    assert (whole.code, whole.out, whole.err) == (parts.code, parts.out, parts.err)
    assert parts.code == 0
    assert out.read_bytes() == before
    assert "--json" in options or shown_last(parts.out)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_parquet_in_parts_has_the_same_values(tool, tmp_path, in_parts, suffix):
    columns = well(tool)
    typed = {n: c if n in ("station", "note") else np.array(c, float) for n, c in columns.items()}
    typed |= {"count": np.arange(ROWS), "flag": np.arange(ROWS) % 2 == 0}
    described = {b"mwdcal": json.dumps({"declination_deg": 1.5}).encode()}
    source, out = tmp_path / "well.parquet", tmp_path / f"out{suffix}"
    pq.write_table(pa.table(typed).replace_schema_metadata(described), source)
    whole = cli("survey", tool, source, "-o", out)
    before = pq.read_table(out) if suffix == ".parquet" else out.read_bytes()
    in_parts()
    parts = cli("survey", tool, source, "-o", out)
    assert (parts.code, parts.out, parts.err) == (0, whole.out, whole.err)
    assert shown_last(parts.out)
    if suffix == ".csv":
        assert out.read_bytes() == before
    else:
        assert pq.read_table(out).equals(before, check_metadata=True)
        assert pq.ParquetFile(out).metadata.num_row_groups > 1


@pytest.mark.parametrize(
    ("column", "row", "cell", "message"),
    [
        ("md_m", 600, "100.0", "line 602, column 'md_m': must not decrease from station to station; got 100."),
        ("md_m", 600, "x", "line 602, column 'md_m': expected a number; got 'x'."),
        ("ax", 500, "", "line 502, column 'ax': must be filled in; got a blank cell."),
        ("ref_dip_deg", 650, "nan", "line 652, column 'ref_dip_deg': expected a number; got 'nan'."),
        ("temperature_c", slice(300, ROWS), "", "column 'temperature_c': must be filled in; got a blank cell."),
    ],
)  # fmt: skip
def test_what_is_refused_names_its_line(tool, tmp_path, in_parts, column, row, cell, message):
    columns = well(tool)
    if isinstance(row, slice):
        columns[column][row] = [cell] * (ROWS - row.start)
    else:
        columns[column][row] = cell
    source, out = written(tmp_path / "well.csv", columns), tmp_path / "out.csv"
    in_parts()
    assert message in refused(cli("survey", tool, source, "-o", out), 2)
    assert [path.name for path in tmp_path.iterdir()] == ["well.csv"]


def test_numbers_are_spelt_as_by_repr():
    rng = np.random.default_rng(0)
    ends = [0.0, -0.0, 1e10, 1e10 + 0.5, 9999999999.5, 1e-4, 9.999e-5, 1e16, 5e-324, 1e22, np.nan]
    drawn = rng.standard_normal(20_000) * 10.0 ** rng.integers(-12, 18, 20_000)
    values = np.concatenate([drawn, rng.integers(-(10**6), 10**6, 1000) / 1.0, ends])
    expected = ["" if value != value else repr(value) for value in values.tolist()]
    assert text.spelt(values, pa).to_pylist() == expected
    assert text.spelt(np.full(2, -48000.0), pa).to_pylist() == ["-48000.0"] * 2


def test_the_first_fault_is_named_though_references_are_read_first(tool, tmp_path, in_parts):
    columns = well(tool)
    columns["ax"][5], columns["ref_field_nt"][600] = "x", "-1"
    source, out = written(tmp_path / "well.csv", columns), tmp_path / "out.csv"
    in_parts()
    assert "line 7, column 'ax'" in refused(cli("survey", tool, source, "-o", out), 2)
    columns["ax"][5] = columns["ax"][6]
    written(source, columns)
    assert "line 602, column 'ref_field_nt'" in refused(cli("survey", tool, source, "-o", out), 2)


def test_the_horizontal_field_of_a_long_table_is_the_median_of_its_references(
    tool, tmp_path, in_parts
):
    """By which a declination without a stated uncertainty is uncertain."""
    columns = well(tool)
    fields = 47_000.0 + 2_000.0 * np.linspace(0.0, 1.0, ROWS) ** 2
    columns["ref_field_nt"] = [repr(field) for field in fields.tolist()]
    source, out = tmp_path / "well.csv", tmp_path / "out.csv"
    written(source, columns, ["declination_deg = 2.4"])
    in_parts()
    assert cli("survey", tool, source, "-o", out).code == 0
    (line,) = (line for line in out.read_text().splitlines() if "sd_declination_deg =" in line)
    level = np.median(fields) * np.cos(np.radians(63.0))
    shared, _ = declination_sd(level)
    assert float(line.partition("=")[2]) == pytest.approx(shared, rel=1e-12)


@pytest.mark.parametrize("delimiter", [",", "\t"])
def test_lines_are_those_of_the_csv_module(delimiter):
    words = ["a", "b,c", 'q"x"', "", '"', " lead", "tail ", "x;y", "°é", "t\ty"]
    stream = io.StringIO()
    csv.writer(stream, delimiter=delimiter, lineterminator="\n").writerows(
        zip(words, words[::-1], strict=True)
    )
    cells = [text.quoted(pa.array(each), delimiter) for each in (words, words[::-1])]
    assert bytes(text.joined(cells, delimiter, pa)).decode() == stream.getvalue()


def test_two_digits_are_those_of_the_format():
    rng = np.random.default_rng(0)
    halves = [float(f"{d}.5e{e}") for d in range(10, 100) for e in range(-5, 3)]
    values = np.concatenate([10.0 ** rng.uniform(-7, 4, 20_000), halves, [0.0, 180.0, 99.5]])
    expected = [f"{value:.2g}" for value in values.tolist()]
    assert [f"{value:.2g}" for value in acceptance.two_digits(values).tolist()] == expected


def test_a_path_in_parts_is_that_of_the_whole(tool):
    calibration, count = read(tool), 9000
    md = np.linspace(0.0, 4000.0, count)
    shown = readings_at(calibration, np.radians(md / 50), np.radians(30 + md / 40), md % 6.28)
    place, covariance = calibrated_path(calibration, shown, md, 0.1, 0.01, (1.0, 2.0, 3.0), 0.02)
    before, places, covariances = (1.0, 2.0, 3.0), [], []
    for rows in (slice(0, 1), slice(1, 5000), slice(5000, count)):
        part = readings_at(
            calibration, np.radians(md[rows] / 50), np.radians(30 + md[rows] / 40), md[rows] % 6.28
        )
        some, shared, before = continued_path(
            calibration, part, md[rows], (0.1, 0.01, 0.02), before
        )
        places.append(some)
        covariances.append(shared)
    np.testing.assert_allclose(np.concatenate(places), place, rtol=1e-13, atol=1e-12)
    np.testing.assert_allclose(np.concatenate(covariances), covariance, rtol=1e-12, atol=1e-15)
