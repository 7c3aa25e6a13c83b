"""Tables of invented laboratories, made without a look at the reader: what it takes them for."""

import re

import numpy as np
import pytest

import mwdcal
from cli_support import EXAMPLE
from laboratories import laboratories, mutated
from mwdcal.errors import InputError
from mwdcal.files.formats import table as tables
from mwdcal.files.formats import workbook
from mwdcal.files.formats.title_references import doubtful_in, references_in
from mwdcal.files.formats.titles import titles
from mwdcal.files.runs import read_export, run_table

LABORATORIES = {each.name: each for each in laboratories()}
OPEN = {
    "anchorage_true_north": "true azimuths by a declination in the title: the readings have magnetic ones",
    "clausthal_clz7": "a serial with a blank in a sentence",
    "izhevsk": "angles have letters for names",
    "midland_88-115": "the day 3/9/26 may be read in two ways",
}
"""Those that are asked about, or of which a fact is not read, though a person could tell: why."""
UNSEEN = re.compile("stands twice|deleted")
"""Mutations that leave a sound table: `calibrate` names copies of stations, and a blank reference is an unknown one."""
TURNING = ("ref_azimuth_deg", "ref_toolface_deg")
FACTS = ("serial", "date")


def taken(path, **answers):
    """The table of a laboratory under the names of a run file, by the profile proposed for it."""
    profile = mwdcal.propose_profile(path, **answers).profile
    return run_table(read_export(path, profile), profile)


def differences(run, truth):
    """What of a table is not as it is known to be."""
    for name, expected in truth.items():
        if name in FACTS:
            stated = run.metadata.get(name) or (tables.labels(run, "serial") or [None])[0]
            if stated != expected:
                yield f"{name}: {stated}"
        elif name in run.columns and np.size(expected) not in (1, run.count):
            yield f"{run.count} rows of {np.size(expected)}"
        elif name in run.columns:
            off = tables.numbers(run, name) - np.asarray(expected, float)
            off = (off + 180) % 360 - 180 if name in TURNING else off
            if np.isnan(off).any() or np.abs(off).max() > 1e-6 * np.abs(expected).max():
                yield name


TAKEN = [n for n, each in LABORATORIES.items() if each.expected == "taken" and n not in OPEN]
ASKED = [n for n, each in LABORATORIES.items() if each.expected == "asks"]


@pytest.mark.parametrize("name", TAKEN)
def test_a_table_is_taken_as_it_comes(tmp_path, name):
    laboratory = LABORATORIES[name]
    path = tmp_path / laboratory.file
    path.write_bytes(laboratory.content)
    assert [*differences(taken(path), laboratory.truth)] == []


def test_an_error_in_a_cell_of_any_workbook_names_its_row(tmp_path):
    laboratory = next(each for each in LABORATORIES.values() if each.file.endswith(".ods"))
    path = tmp_path / laboratory.file
    path.write_bytes(laboratory.content)
    assert ", row " in str(tables.cell_error(taken(path), "gx", 0, "no number"))


@pytest.mark.parametrize(
    ("line", "dip"),
    [
        ("Ref|50400 nT||70.00 deg dip||9.8170 m/s2", 70.0),
        ("#REF: 50400 nT / 70.00 deg / 9.8170 m/s2", 70.0),
        ("Feld 50400 nT, Inkl. 70,00°, g 9,8170", 70.0),
        ("FIELD 50400 NT||DIP 70.00||G 9.8170", 70.0),
        ("T. Leblanc||Bt=50400 nT; Inkl=70,00 Grad; g=9,8170 m/s2", 70.0),
        ("F (µT)|50,4||Incl. (°)|70||g (m/s²)|9,817", 70.0),
        ("Field 50400 nT, dip 70.00 deg up, g 9.8170", -70.0),
        ("磁场强度(nT)|50400|磁倾角|70.0°|重力加速度(m/s2)|9.8170", 70.0),
    ],
)
def test_the_references_of_a_place_stand_in_one_line(line, dip):
    stated = references_in([line.split("|")])
    assert stated == {
        "ref_field_nt": 50400.0,
        "ref_dip_deg": dip,
        "ref_gravity_g": pytest.approx(9.8170 / 9.80665),
    }


@pytest.mark.parametrize(
    "line",
    [
        "Cradle inclination 90 deg, field 50400 nT",
        "50400 nT / 3.5 deg declination / 9.8170 m/s2",
        "sensor range 60000 nT, 9.81 m/s2, 45 deg",
        "Inc 45 deg",
    ],
)
def test_another_angle_is_no_dip(line):
    assert "ref_dip_deg" not in references_in([[line]])


def test_a_reference_that_is_not_understood_is_named():
    assert doubtful_in([["Geomagnet 50400 nT"]]) == {"ref_field_nt": "Geomagnet 50400 nT"}


@pytest.mark.parametrize(
    ("cells", "serial"),
    [
        (["Sonde", "SD-9 n° 112"], "112"),
        (["Ferramenta: DIR-175 nº 44"], "44"),
        (["Serial / الرقم التسلسلي", "SA-5520", "Date / التاريخ", "2024-01-22"], "SA-5520"),
        (["Matricola", "IT-0914"], "IT-0914"),
        (["инклинометр ИММН-42 зав. № 1187"], "1187"),
    ],
)
def test_a_serial_is_the_one_behind_its_mark(cells, serial):
    assert titles([cells]).metadata["serial"] == serial


@pytest.mark.parametrize("sign", [";", "point"])
def test_a_decimal_sign_of_no_number_is_refused(sign):
    with pytest.raises(InputError, match="must be '.' or ','"):
        mwdcal.propose_profile(EXAMPLE / "run.csv", decimal=sign)


def test_a_workbook_is_opened_once(tmp_path, monkeypatch):
    """Ten thousand rows take a second each time: 2.4 s of processor time for `profile` at ten thousand rows."""
    laboratory = LABORATORIES["aberdeen_job_0117"]
    path, opened, read_sheets = tmp_path / laboratory.file, [], workbook.read_sheets
    path.write_bytes(laboratory.content)
    monkeypatch.setattr(workbook, "read_sheets", lambda *a: opened.append(a) or read_sheets(*a))
    monkeypatch.setattr(workbook, "read_rows", lambda *a: pytest.fail("opened again"))
    profile = mwdcal.propose_profile(path).profile
    assert len(opened) == 1
    read_export(path, profile)
    assert len(opened) == 2


@pytest.mark.parametrize(
    ("between", "respelt", "rows"),
    [((), False, 20), ((), True, 20), ((["Tool S/N", "V-2"],), False, 0)],
)
def test_names_that_are_repeated_on_the_next_page_lose_no_row(tmp_path, between, respelt, rows):
    """Names in another spelling go on with the table; below the serial of another tool it is another table."""
    names = ["Pt", "Temp (C)", "Gx (V)", "Gy (V)", "Gz (V)", "Inc (deg)", "TF (deg)"]
    again = [n.upper().replace("(", "[").replace(")", "]") for n in names] if respelt else names
    angles = [(i, t) for i in (20, 60, 100, 140) for t in (0, 72, 144, 216, 288)]
    noise = np.random.default_rng(3).normal(0, 0.02, (20, 3))
    readings = [
        [
            n + 1,
            25.0,
            noise[n, 0] - 3 * np.sin(i) * np.sin(t),
            noise[n, 1] - 3 * np.sin(i) * np.cos(t),
            noise[n, 2] + 3 * np.cos(i),
            *each,
        ]
        for n, each in enumerate(angles)
        for i, t in [np.radians(each)]
    ]
    page = [["Tool S/N", "V-1"], names, *readings[:10], *between, again, *readings[10:]]
    path = tmp_path / "pages.csv"
    path.write_text("\n".join(",".join(map(str, row)) for row in page), "utf-8")
    if not rows:
        with pytest.raises(mwdcal.FitError, match="2 tables of like columns"):
            mwdcal.propose_profile(path)
        return
    assert taken(path).count == rows


@pytest.mark.parametrize("name", ASKED)
def test_what_is_open_is_asked(tmp_path, name):
    path = tmp_path / LABORATORIES[name].file
    path.write_bytes(LABORATORIES[name].content)
    with pytest.raises((mwdcal.FitError, mwdcal.InputError)):
        mwdcal.propose_profile(path)


def test_no_mutation_changes_a_number_in_silence(tmp_path):
    """Of tables with one change each: what holds no more is refused or asked, never read otherwise."""
    rng, wrong, read = np.random.default_rng(7), [], 0
    for name in [*LABORATORIES] * 3:
        changed = mutated(LABORATORIES[name], rng)
        if changed is None or UNSEEN.search(changed.mutation) or name in OPEN:
            continue
        path = tmp_path / changed.file
        path.write_bytes(changed.content)
        try:
            run = taken(path)
        except (mwdcal.FitError, mwdcal.InputError):
            continue
        read += 1
        off = [d for d in differences(run, changed.truth) if not d.startswith(FACTS)]
        wrong += [(changed.name, changed.mutation, off)] if off else []
    assert wrong == []
    assert read > 30


def test_tools_side_by_side_are_asked_about_one_by_one(tmp_path):
    """The answers take all channels of one tool; neither tool is believed to have channels of the other."""
    rows = (EXAMPLE / "run.csv").read_text("utf-8").splitlines()
    body = [row.split(",") for row in rows if row and not row.startswith("#")]
    names = body[0]
    raw = [names.index(f"{triad}{axis}") for triad in "am" for axis in "xyz"]
    ends = ["Gx", "Gy", "Gz", "Bx", "By", "Bz"]
    angles = [names.index(f"ref_{n}_deg") for n in ("inclination", "azimuth", "toolface")]
    head = ["Inc", "Azi", "TF", *(f"S/N {tool} {end}" for tool in ("11A", "12B") for end in ends)]
    cells = [[*(r[k] for k in angles), *(r[k] for k in raw * 2)] for r in body[1:]]
    path = tmp_path / "two.csv"
    path.write_text("\n".join(map(",".join, [head, *cells])), "utf-8")
    with pytest.raises(mwdcal.FitError, match="stand side by side: 'S/N 11A', 'S/N 12B'") as error:
        mwdcal.propose_profile(path)
    assert "ax=S/N 11A Gx" in str(error.value)
    columns = {f"{'am'[k // 3]}{'xyz'[k % 3]}": f"S/N 12B {end}" for k, end in enumerate(ends)}
    assert mwdcal.propose_profile(path, column=columns).profile.columns["mz"].name == "S/N 12B Bz"


def test_angles_in_gons_under_degrees_are_named(tmp_path):
    path = tmp_path / "run.csv"
    names, *rows = [
        row.split(",")
        for row in (EXAMPLE / "run.csv").read_text("utf-8").splitlines()
        if not row.startswith("#")
    ]
    place = names.index("ref_inclination_deg")
    for row in rows:
        row[place] = repr(float(row[place]) / 0.9)
    path.write_text("\n".join(map(",".join, [names, *rows])), "utf-8")
    proposal = mwdcal.propose_profile(path)
    assert proposal.profile.columns["ref_inclination_deg"].unit == "gon"
    assert "told-by-readings" in [finding.id for finding in proposal.findings]


def test_a_total_that_varies_is_no_reference_beside_the_field_of_the_place(tmp_path):
    """A channel of another scale hides that the column is computed; the field of a place hardly varies."""
    names, *rows = [
        row.split(",")
        for row in (EXAMPLE / "run.csv").read_text("utf-8").splitlines()
        if not row.startswith("#")
    ]
    place = names.index("ref_field_nt")
    names[place] = "Btot (nT)"
    for k, row in enumerate(rows):
        row[place] = str(49000 + 700 * (k % 3))
    path = tmp_path / "run.csv"
    path.write_text(
        "\n".join(map(",".join, [["Total field (nT)", "50000"], names, *rows])), "utf-8"
    )
    proposal = mwdcal.propose_profile(path)
    assert "ref_field_nt" not in proposal.profile.columns
    assert "not-used" in [finding.id for finding in proposal.findings]


@pytest.mark.parametrize(
    ("off", "repeats", "asked"), [(0.03, 1, True), (0.0002, 1, False), (0.03, 9, False)]
)
def test_two_readings_at_one_attitude_are_asked_about(tmp_path, off, repeats, asked):
    """Not where they differ by noise, nor where repeated rows are usual; the second is believed."""
    names, *rows = [
        row.split(",")
        for row in (EXAMPLE / "run.csv").read_text("utf-8").splitlines()
        if not row.startswith("#")
    ]
    place, every, rows = names.index("ax"), [], [row for row in rows if all(row)]
    for k, row in enumerate(rows):
        row[0] = str(k)
        again = [str(100 + k), *row[1:]]
        again[place] = repr(float(row[place]) + 3 * off)
        every += [row, again] if 5 <= k < 5 + repeats else [row]
    path = tmp_path / "run.csv"
    path.write_text("\n".join(map(",".join, [names, *every])), "utf-8")
    if not asked:
        mwdcal.propose_profile(path)
        return
    with pytest.raises(
        mwdcal.FitError, match="at one attitude, and their readings differ"
    ) as error:
        mwdcal.propose_profile(path)
    first, *_ = error.value.answers[0].arguments
    assert first == ("leave_out", "station=5")
    assert taken(path, leave_out={"station": ["5"]}).count == len(rows)
    assert taken(path, keep={"station": ["5"]}).count == len(rows) + 1


@pytest.mark.parametrize("numbered", [True, False])
def test_a_line_that_numbers_the_columns_names_them(tmp_path, numbered):
    """A script writes no names above its numbers; a line that skips a column is not understood."""
    rows = [
        row.split(",")
        for row in (EXAMPLE / "run.csv").read_text("utf-8").splitlines()
        if not row.startswith("#")
    ]
    names, *rows = [[*row[8:11], *row[2:8], row[1]] for row in rows if all(row)]
    line = "# cols: 1 inc(deg) 2 az(deg, mag) 3 gtf(deg) 4-6 accel x y z (V) 7-9 mag x y z (V) 10 temp(C)"
    path = tmp_path / "run.dat"
    text = [line if numbered else line.replace(" 10 ", " 11 "), "# z is down the tool axis"]
    path.write_text("\n".join([*text, *map(" ".join, rows)]), "utf-8")
    if not numbered:
        with pytest.raises((mwdcal.FitError, InputError)):
            mwdcal.propose_profile(path)
        return
    run = taken(path)
    for column, cells in zip(names, zip(*rows, strict=True), strict=True):
        assert np.allclose(tables.numbers(run, column), np.array(cells, float))


def test_a_column_of_another_decimal_sign_is_read_by_its_own(tmp_path):
    """In a table of decimal commas 2.248 may be 2248, but not in a column that has 0.254."""
    laboratory = LABORATORIES["pau"]
    lines = laboratory.content.decode("cp850").split("\r\n")
    rows = [k for k, line in enumerate(lines) if line.count(";") == 10 and line[0].isdigit()][:20]
    for k in rows:
        cells = lines[k].split(";")
        cells[7:10] = [f"{int(cell) / 1000:.3f}" for cell in cells[7:10]]
        lines[k] = ";".join(cells)
    path = tmp_path / "pau.txt"
    path.write_bytes("\r\n".join(lines[: rows[-1] + 1]).encode("cp850"))
    run = taken(path)
    assert np.allclose(tables.numbers(run, "mx"), np.array(laboratory.truth["mx"]) / 1000)
