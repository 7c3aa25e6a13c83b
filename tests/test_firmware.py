"""`mwdcal convert --to`: C that compiles without warnings and meets `mwdcal apply` within its stated errors."""

import ast
import csv
import json
import re
import shutil
import subprocess

import msgspec
import numpy as np
import pytest

from cli_support import (
    EXAMPLE,
    RAW,
    ROOT,
    calibrated,
    mwdcal,
    numbers,
    read_csv,
    refused,
    servo_run,
    write_csv,
)
from mwdcal import calibrate, load, read_run, save
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import StationRow, rounded
from mwdcal.files import documents
from simulation import Tool, attitude
from test_notation import AXES, SCALES, TRIADS, made, signed

WARNINGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
FORMS = {"c-header": "double", "fixed-point": "fixed"}
COMPILER = shutil.which("gcc") or shutil.which("cc")
VERTICAL, NO_GRAVITY, NO_NORTH, AXIAL_FIELD, OUTSIDE, SATURATED = 1, 2, 4, 8, 16, 32
COUNT = 3000
REFERENCE = 20.0
EARTH = (1.0, 50_000.0, np.radians(60.0))
VECTORS = ("gx_g", "gy_g", "gz_g", "bx_nt", "by_nt", "bz_nt")
ANGLES = ("inclination_deg", "azimuth_deg", "toolface_deg", "magnetic_toolface_deg")
DOUBLE_DRIVER = """
#include "mwdcal_double.h"
#include <stdio.h>
int main(void)
{
    double a[3], m[3], t;
    mwdcal_double_result r;
    while (scanf("%lf %lf %lf %lf %lf %lf %lf", &a[0], &a[1], &a[2], &m[0], &m[1], &m[2], &t) == 7) {
        unsigned status = mwdcal_double(a, m, t, &r);
        printf("%u %.17g %.17g %.17g %.17g %.17g %.17g %.17g %.17g %.17g %.17g\\n", status,
               r.gravity[0], r.gravity[1], r.gravity[2], r.field[0], r.field[1], r.field[2],
               r.inclination_deg, r.azimuth_deg, r.toolface_deg, r.magnetic_toolface_deg);
    }
    return 0;
}
"""
FIXED_DRIVER = """
#include "mwdcal_fixed.h"
#include <stdio.h>
int main(void)
{
    long v[7];
    mwdcal_word a[3], m[3];
    mwdcal_fixed_result r;
    while (scanf("%ld %ld %ld %ld %ld %ld %ld", &v[0], &v[1], &v[2], &v[3], &v[4], &v[5], &v[6]) == 7) {
        int i;
        unsigned status;
        for (i = 0; i < 3; i++)
            a[i] = (mwdcal_word)v[i], m[i] = (mwdcal_word)v[3 + i];
        status = mwdcal_fixed(a, m, (mwdcal_word)v[6], &r);
        printf("%u %ld %ld %ld %ld %ld %ld %lu %lu %lu %lu\\n", status,
               (long)r.gravity[0], (long)r.gravity[1], (long)r.gravity[2],
               (long)r.field[0], (long)r.field[1], (long)r.field[2],
               (unsigned long)r.inclination, (unsigned long)r.azimuth,
               (unsigned long)r.toolface, (unsigned long)r.magnetic_toolface);
    }
    return 0;
}
"""
DRIVERS = {"double": DOUBLE_DRIVER, "fixed": FIXED_DRIVER}
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C compiler here")

CASES = {
    "polynomial 0": ("polynomial", (0, 0), "straight"),
    "polynomial 1 and 3": ("polynomial", (1, 3), "turned"),
    "polynomial 2 and 1": ("polynomial", (2, 1), "left-handed"),
    "factors 0": ("factors", (0, 0), "turned"),
    "factors 1 and 2": ("factors", (1, 2), "flipped and permuted"),
    "factors 3": ("factors", (3, 3), "left-handed"),
}


def whole(record):
    """The record of `test_notation` with what a file must have, and 12 digits in every number."""
    row = StationRow(
        station="1", digest="0", temperature_c=None, inclination_deg=None, toolface_deg=None,
        azimuth_deg=None, errors={}, errors_before={}, deviation=0.0,
    )  # fmt: skip
    sd = np.sqrt(np.diag(record.parameter_covariance))
    triads = {}
    for triad in record.triads:
        names = list(triad.functions(REFERENCE).names)
        own = sd[record.places()[triad.name]].tolist()
        triads[triad.name] = msgspec.structs.replace(
            triad, parameter_names=names, standard_uncertainties=own
        )
    return rounded(msgspec.structs.replace(record, station_rows=[row], **triads))


def saved(folder, calibration):
    """The calibration file of a whole record."""
    path = folder / "cal.json"
    documents.write(path, calibration)
    return path


def sources(folder, calibration, form, *options):
    """The stated result of a conversion into a new folder, which is returned with it."""
    out = folder / "-".join([form, *map(str, options)])
    ran = mwdcal("convert", calibration, "--to", form, *options, "-o", out, "--json")
    assert ran.code == 0, ran
    return out, ran.json


def compiled(folder, kind, text=None, *flags):
    """An executable of the sources with their test, or with a driver of ours."""
    test = f"mwdcal_{kind}_test.c"
    if text is not None:
        test = "driver.c"
        (folder / test).write_text(text)
    command = [COMPILER, *WARNINGS, *flags, f"mwdcal_{kind}.c", test, "-lm", "-o", "a.out"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    return folder / "a.out"


def run(executable, rows=""):
    return subprocess.run([executable], input=rows, capture_output=True, text=True, check=False)


def readings(calibration, axes, count=COUNT, seed=5, earth=EARTH):
    """Raw channels of random attitudes and temperatures, by steps on the record's own fields."""
    rng = np.random.default_rng(seed)
    inc, (azi, face) = np.arccos(rng.uniform(-1, 1, count)), rng.uniform(0, 2 * np.pi, (2, count))
    low, high = calibration.temperature_c
    warmth = np.round(rng.uniform(low, high, count), 3)
    wanted = attitude(inc, azi, face)(*earth)
    nominal = [np.zeros((count, 3)), np.zeros((count, 3))]
    for _ in range(8):
        fields = calibration.fields(Readings(*nominal, temperature=warmth))
        nominal = [n + w - f for n, w, f in zip(nominal, wanted, fields, strict=True)]
    columns = {"temperature_c": warmth}
    for triad, own, scale, values in zip(TRIADS, axes, SCALES, nominal, strict=True):
        names = RAW[:3] if triad == TRIADS[0] else RAW[3:]
        columns |= dict(zip(names, np.round(values @ signed(own) * scale, 9).T, strict=True))
    return columns


def applied(folder, calibration, columns):
    """What `mwdcal apply` makes of raw channels: vectors (n, 6), angles (n, 4) with NaN for none."""
    table = write_csv(folder / "readings.csv", columns)
    ran = mwdcal("apply", calibration, table, "-o", folder / "applied.csv")
    assert ran.code == 0, ran
    found = read_csv(folder / "applied.csv")
    return [np.stack([numbers(found[n]) for n in names], -1) for names in (VECTORS, ANGLES)]


def by_c(folder, kind, columns, stated):
    """Status, vectors and angles of the C function, in g, nT and degrees."""
    raw = np.stack(
        [columns.get(n, np.zeros(len(columns["ax"]))) for n in (*RAW, "temperature_c")], -1
    )
    if kind == "fixed":
        power = stated["powers_of_two"]
        powers = (
            [power["accelerometer"]] * 3
            + [power.get("magnetometer", 0)] * 3
            + [power["temperature"]]
        )
        raw = np.rint(raw * 2.0 ** np.array(powers)).astype(int)
    rows = "\n".join(" ".join(map(repr, row)) for row in raw.tolist())
    done = run(compiled(folder, kind, DRIVERS[kind]), rows)
    values = np.array([line.split() for line in done.stdout.splitlines()], float)
    assert len(values) == len(raw)
    status, vectors, angles = values[:, 0].astype(int), values[:, 1:7], values[:, 7:]
    if kind == "fixed":
        shrink = [power["gravity"]] * 3 + [power.get("field", 0)] * 3
        vectors = vectors / 2.0 ** np.array(shrink)
        angles = angles * 360 / 2.0 ** stated["word_bits"]
    return status, vectors, angles


def worst(stated, found, expected):
    """Largest error of each quantity as a share of the stated one; angles weighted as the header says."""
    (status, vectors, angles), (fields, directions) = found, expected
    g, b = fields[:, :3], fields[:, 3:]
    errors = stated["errors"]
    shares = {"gravity_g": np.abs(vectors[:, :3] - g).max() / errors["gravity_g"]}
    shares["field_nt"] = np.abs(vectors[:, 3:] - b).max() / errors["field_nt"]
    across = np.hypot(g[:, 0], g[:, 1]) / np.linalg.norm(g, axis=-1)
    axial = np.hypot(b[:, 0], b[:, 1]) / np.linalg.norm(b, axis=-1)
    lacking = {"inclination_deg": 0, "magnetic_toolface_deg": AXIAL_FIELD}
    for index, name in enumerate(ANGLES):
        weight = {"inclination_deg": 1.0, "magnetic_toolface_deg": axial}.get(name, across)
        off = (angles[:, index] - directions[:, index] + 180) % 360 - 180
        there = status & lacking.get(name, VERTICAL | NO_NORTH) == 0
        shares[name] = np.abs(off * weight)[there].max() / errors[name]
    return shares


@pytest.fixture(scope="module", params=CASES)
def case(request, tmp_path_factory):
    """A calibration file, raw readings, and what apply makes of them."""
    model, orders, axes = CASES[request.param]
    folder = tmp_path_factory.mktemp("case")
    record = whole(made(model, orders, axes))
    calibration = saved(folder, record)
    columns = readings(record, AXES[axes])
    return calibration, columns, applied(folder, calibration, columns)


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("bits", [None, 32, 24, 16, 13])
def test_the_c_function_meets_apply_within_the_stated_error(tmp_path, case, bits):
    """Thousands of random readings; and the bound is not idle: some quantity comes to a tenth of it."""
    calibration, columns, expected = case
    options = () if bits is None else ("--word-bits", bits)
    form = "c-header" if bits is None else "fixed-point"
    folder, stated = sources(tmp_path, calibration, form, *options)
    found = by_c(folder, FORMS[form], columns, stated)
    shares = worst(stated, found, expected)
    assert max(shares.values()) <= 1, shares
    plain = found[0] & ~(VERTICAL | AXIAL_FIELD | NO_NORTH) == 0
    assert plain.all()
    if bits is None:
        assert (found[0] == 0).all()
    else:
        assert max(shares.values()) > 0.1, shares


@needs_compiler
@pytest.mark.parametrize("name", ["polynomial 2 and 1", "factors 3"])
@pytest.mark.parametrize("bits", [32, 16])
def test_the_whole_working_range_fits_the_words(tmp_path, name, bits):
    """Just below the largest strengths that are stated nothing saturates, and vectors keep their error."""
    model, orders, axes = CASES[name]
    record = whole(made(model, orders, axes))
    calibration = saved(tmp_path, record)
    folder, stated = sources(tmp_path, calibration, "fixed-point", "--word-bits", bits)
    assert stated["strongest"] == {"accelerometer": 1.1, "magnetometer": 80_000.0}
    columns = readings(record, AXES[axes], 2000, earth=(1.0999, 79_990.0, 1.0))
    fields, _ = applied(tmp_path, calibration, columns)
    status, vectors, _ = by_c(folder, "fixed", columns, stated)
    assert not (status & SATURATED).any()
    off = np.abs(vectors - fields).max(0)
    assert off[:3].max() <= stated["errors"]["gravity_g"]
    assert off[3:].max() <= stated["errors"]["field_nt"]


@needs_compiler
@pytest.mark.parametrize("form", FORMS)
def test_the_vectors_are_met_and_a_wrong_coefficient_is_noticed(tmp_path, case, form):
    folder, _ = sources(tmp_path, case[0], form)
    kind = FORMS[form]
    done = run(compiled(folder, kind))
    assert done.returncode == 0, done.stdout
    assert re.fullmatch(r"30 vectors, 0 values off\n", done.stdout)
    header = folder / f"mwdcal_{kind}.h"
    text = header.read_text()
    at = text.index("/* gain */")
    first = re.search(r"-?\d[\d.e-]*\d", text[at:])
    changed = (
        repr(ast.literal_eval(first[0]) * 1.001) if kind == "double" else str(int(first[0]) + 2**20)
    )
    header.write_text(text[:at] + text[at:].replace(first[0], changed, 1))
    done = run(compiled(folder, kind))
    assert done.returncode == 1
    assert "vector 1, gravity: " in done.stdout


@needs_compiler
@pytest.mark.parametrize("form", FORMS)
def test_no_undefined_behaviour_even_for_impossible_words(tmp_path, case, form):
    """All extremes of the inputs under the sanitizer; a word beyond the largest is reported."""
    folder, _ = sources(tmp_path, case[0], form)
    kind = FORMS[form]
    flags = ("-fsanitize=undefined", "-fno-sanitize-recover=all")
    try:
        executable = compiled(folder, kind, DRIVERS[kind], *flags)
    except AssertionError:
        pytest.skip("no sanitizer here")
    extremes = (-(2**31), 2**31 - 1, 0) if kind == "fixed" else (-1e15, 1e15, 0.0)
    rng = np.random.default_rng(3)
    rows = rng.choice(extremes, (500, 7))
    done = run(executable, "\n".join(" ".join(map(repr, row)) for row in rows.tolist()))
    assert done.returncode == 0, done.stderr
    status = np.array([int(line.split()[0]) for line in done.stdout.splitlines()])
    assert len(status) == 500
    if kind == "fixed":
        beyond = np.any(rows[:, :6] == -(2**31), -1)
        assert (status[beyond] & SATURATED != 0).all()


@needs_compiler
@pytest.mark.parametrize("form", FORMS)
def test_vertical_and_outside_are_said_by_the_status(tmp_path, form):
    """Exactly vertical, up and down; beyond the calibrated temperatures; no gravity."""
    record = whole(made("polynomial", (0, 0), "straight"))
    calibration = saved(tmp_path, record)
    folder, stated = sources(tmp_path, calibration, form)
    matrix = np.array(record.accelerometer.parameters[:9]).reshape(3, 3)
    offset = np.array(record.accelerometer.parameters[9:])
    wanted = np.array([[0, 0, 1], [0, 0, -1], [0, 0, 0], [0, 0.6, 0.8], [0, 0.6, 0.8]])
    raw = np.linalg.solve(matrix, (wanted - offset).T).T * SCALES[0]
    columns = dict(zip(RAW[:3], raw.T, strict=True))
    columns |= {"mx": np.full(5, 1.0), "my": np.full(5, 0.5), "mz": np.full(5, 2.0)}
    columns["temperature_c"] = np.array([20.0, 20, 20, 90, -6])
    status, _, angles = by_c(folder, FORMS[form], columns, stated)
    assert status[:2].tolist() == [VERTICAL, VERTICAL]
    assert status[3:].tolist() == [OUTSIDE, OUTSIDE]
    assert angles[:2, 0] == pytest.approx([0.0, 180.0], abs=1e-5)
    assert (angles[:2, 1:3] == 0).all()
    assert (angles[:2, 3] > 0).all()
    if form == "fixed-point":
        assert status[2] == NO_GRAVITY


@needs_compiler
def test_beyond_the_temperatures_double_extrapolates_and_fixed_point_stays_inside(tmp_path):
    record = whole(made("factors", (2, 1), "turned"))
    calibration = saved(tmp_path, record)
    columns = readings(record, AXES["turned"], 200)
    hot, edge = ({**columns, "temperature_c": np.full(200, t)} for t in (120.0, 81.0))
    table = write_csv(tmp_path / "hot.csv", hot)
    ran = mwdcal("apply", calibration, table, "-o", tmp_path / "o.csv", "--outside", "extrapolate")
    assert ran.code == 0, ran
    found = read_csv(tmp_path / "o.csv")
    folder, stated = sources(tmp_path, calibration, "c-header")
    status, vectors, _ = by_c(folder, "double", hot, stated)
    assert (status == OUTSIDE).all()
    expected = np.stack([numbers(found[n]) for n in VECTORS], -1)
    np.testing.assert_allclose(vectors, expected, rtol=1e-11, atol=1e-9)
    folder, stated = sources(tmp_path, calibration, "fixed-point")
    first, second = (by_c(folder, "fixed", each, stated) for each in (hot, edge))
    assert (first[0] == OUTSIDE).all()
    assert not second[0].any()
    np.testing.assert_array_equal(first[1], second[1])


def test_the_table_of_vectors_is_a_run_that_apply_takes(tmp_path, case):
    """Another computation of the same: `apply` on the table gives the expected columns to their decimals.

    It blanks a direction whose 1σ is above a third of a radian: an uncertainty that firmware does not have.
    """
    folder, _ = sources(tmp_path, case[0], "c-header")
    table = folder / "mwdcal_double_vectors.csv"
    ran = mwdcal("apply", case[0], table, "-o", tmp_path / "out.csv")
    assert ran.code == 0, ran
    found = read_csv(tmp_path / "out.csv")
    assert len(found["ax"]) == 30
    record = load(case[0])
    run = read_run(table, record.profile)
    vertical = np.array(found["expected_status"], int) == VERTICAL
    assert vertical.sum() == 6
    for name in (*VECTORS, *ANGLES):
        error = 6e-6 if name.endswith("nt") else 6e-9
        expected, stated = (
            np.array([bool(cell) for cell in found[column]])
            for column in (f"expected_{name}", name)
        )
        if name in ("azimuth_deg", "toolface_deg"):
            assert (~expected == vertical).all()
        valued = expected.copy()
        if name in ANGLES[1:]:
            valued &= record.uncertainty(name.removesuffix("_deg"), run, noise=True) <= 1 / 3
        assert (stated == valued).all()
        off = numbers(found[name]) - numbers(found[f"expected_{name}"])
        assert np.abs(off[stated]).max(initial=0.0) < error


def test_the_header_has_the_numbers_of_the_file(tmp_path):
    """Every coefficient stands in the header as the calibration file has it; nothing has more than 12 digits."""
    calibration = calibrated(tmp_path, servo_run(temperatures=(25.0, 80.0, 130.0)), "--order", "2")
    folder, _ = sources(tmp_path, calibration, "c-header")
    text = (folder / "mwdcal_double.h").read_text()
    body = text[text.index("#ifdef MWDCAL_DOUBLE_COEFFICIENTS") :]
    written = [float(word) for word in re.findall(r"-?\d+\.\d+(?:e[+-]?\d+)?", body)]
    record = json.loads(calibration.read_text())
    for triad in TRIADS:
        count = 6 * 3
        parameters = record[triad]["parameters"]
        assert set(parameters[:count]) <= set(written)
        assert {-value for value in parameters[count:]} <= set(written)
    digits = [
        re.sub(r"e.*|[-.]", "", word).lstrip("0")
        for word in re.findall(r"-?\d+\.\d+(?:e[+-]?\d+)?", text)
    ]
    assert max(map(len, digits)) <= 12
    cells = csv.reader(
        s for s in (folder / "mwdcal_double_vectors.csv").read_text().splitlines() if s[0] != "#"
    )
    words = [re.sub(r"e.*|[-.]", "", cell).lstrip("0") for row in list(cells)[1:] for cell in row]
    assert max(map(len, words)) <= 15


NASTY = [
    '*/ #error "',
    "a??/",
    'b"; int x = 1; //',
    "line\nbreak",
    "\\",
    "°\x1b[2J\u202e",
    "/*",
    "%s%n",
    "x" * 9000,
]


@needs_compiler
@pytest.mark.parametrize("text", NASTY)
@pytest.mark.parametrize("form", FORMS)
def test_text_of_others_stays_text(tmp_path, text, form):
    """Serial, run and profile may be anything; the serial comes back from the string, byte for byte."""
    record = whole(made("factors", (1, 1)))
    profile = msgspec.structs.replace(record.profile, name=text)
    record = msgspec.structs.replace(record, tool={"serial": text}, run=text, profile=profile)
    folder, _ = sources(tmp_path, saved(tmp_path, record), form)
    kind = FORMS[form]
    show = f'#define main test\n#include "mwdcal_{kind}_test.c"\n#undef main\n'
    show += "int main(void) { int failed = test(); putchar('\\f'); "
    show += f"fputs(MWDCAL_{kind.upper()}_SERIAL, stdout); return failed; }}\n"
    done = subprocess.run([compiled(folder, kind, show)], capture_output=True, check=True)
    kept = text if len(text) < 200 else text[:200] + " ..."
    assert done.stdout.decode().split("\f")[1] == kept
    assert all(byte < 127 for path in folder.glob("*.[ch]") for byte in path.read_bytes())


@needs_compiler
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("model", ["polynomial", "factors"])
def test_counts_of_a_converter_and_iron_beyond_the_field(tmp_path, form, model):
    """A run of 10⁶ counts per g, 2000 per nT, with offsets of up to 120 000 nT."""
    run_columns = servo_run(tool=Tool.random(4, iron=120_000, noise=(1e-4, 15.0)))
    text = 'name = "counts"\n'
    for triad, names, scale, per_unit in zip(
        TRIADS, (RAW[:3], RAW[3:]), SCALES, (1e6, 2e3), strict=True
    ):
        run_columns |= {n: np.round(run_columns[n] / scale * per_unit) for n in names}
        text += (
            f"[{triad}]\nscale = {per_unit}\nnoise = {per_unit * (15.0 if scale < 1 else 1e-4)}\n"
        )
    (tmp_path / "tool.toml").write_text(text)
    calibration = calibrated(tmp_path, run_columns, "--model", model, tool=tmp_path / "tool.toml")
    folder, stated = sources(tmp_path, calibration, form)
    columns = {name: run_columns[name] for name in (*RAW, "temperature_c")}
    found = by_c(folder, FORMS[form], columns, stated)
    assert not found[0].any()
    shares = worst(stated, found, applied(tmp_path, calibration, columns))
    assert max(shares.values()) <= 1, shares
    assert run(compiled(folder, FORMS[form])).returncode == 0


@needs_compiler
@pytest.mark.parametrize("form", FORMS)
def test_each_triad_keeps_its_model_and_order(tmp_path, form):
    run_columns = servo_run(
        inclinations=(5, 60, 110), toolfaces=6, temperatures=(25.0, 80.0, 130.0)
    )
    table, calibration = write_csv(tmp_path / "run.csv", run_columns), tmp_path / "cal.json"
    fit = calibrate(read_run(table, "servo"), order=(2, 0))
    save(fit, calibration)
    models = [(t.model, t.order) for t in documents.read(calibration).triads]
    assert models == [("factors", 2), ("polynomial", 0)]
    folder, stated = sources(tmp_path, calibration, form)
    columns = {name: run_columns[name] for name in (*RAW, "temperature_c")}
    found = by_c(folder, FORMS[form], columns, stated)
    shares = worst(stated, found, applied(tmp_path, calibration, columns))
    assert max(shares.values()) <= 1, shares
    assert run(compiled(folder, FORMS[form])).returncode == 0


@needs_compiler
@pytest.mark.parametrize("form", FORMS)
def test_an_accelerometer_alone_has_no_azimuth(tmp_path, form):
    run_columns = {k: v for k, v in servo_run().items() if not k.startswith("m")}
    calibration = calibrated(tmp_path, run_columns)
    folder, stated = sources(tmp_path, calibration, form)
    kind = FORMS[form]
    done = run(compiled(folder, kind))
    assert done.returncode == 0, done.stdout
    assert "azimuth_deg" not in stated["errors"]
    columns = {n: run_columns[n][:20] for n in ("ax", "ay", "az")} | {
        "temperature_c": np.full(20, 25.0)
    }
    ran = mwdcal(
        "apply", calibration, write_csv(tmp_path / "r.csv", columns), "-o", tmp_path / "o.csv"
    )
    assert ran.code == 0, ran
    found = read_csv(tmp_path / "o.csv")
    status, vectors, angles = by_c(folder, kind, columns, stated)
    assert (status == NO_NORTH | AXIAL_FIELD).all()
    expected = np.stack([numbers(found[n]) for n in VECTORS[:3]], -1)
    assert np.abs(vectors[:, :3] - expected).max() <= stated["errors"]["gravity_g"]
    off = angles[:, 0] - numbers(found["inclination_deg"])
    assert np.abs(off).max() <= stated["errors"]["inclination_deg"]
    assert (vectors[:, 3:] == 0).all()


@needs_compiler
@pytest.mark.parametrize("form", FORMS)
def test_a_relative_magnetometer_says_so(tmp_path, form):
    run_columns = servo_run()
    del run_columns["ref_field_nt"]
    calibration = calibrated(tmp_path, run_columns)
    folder, stated = sources(tmp_path, calibration, form)
    kind = FORMS[form]
    assert (
        "field relative, 1 where the tool was calibrated, not nT"
        in (folder / f"mwdcal_{kind}.h").read_text()
    )
    done = run(compiled(folder, kind))
    assert done.returncode == 0, done.stdout
    assert "field" in stated["errors"]
    assert "field_nt" not in stated["errors"]


@needs_compiler
def test_own_axis_terms_go_into_double_and_not_into_whole_numbers(tmp_path):
    base = servo_run()
    bent = {**base, **{a: base[a] + 1e-4 * base[a] ** 3 for a in ("ax", "ay", "az")}}
    calibration = calibrated(tmp_path, bent, "--nonlinearity", "accelerometer")
    assert documents.read(calibration).accelerometer.curved
    folder, stated = sources(tmp_path, calibration, "c-header")
    columns = {name: bent[name] for name in (*RAW, "temperature_c")}
    shares = worst(
        stated, by_c(folder, "double", columns, stated), applied(tmp_path, calibration, columns)
    )
    assert max(shares.values()) <= 1, shares
    done = run(compiled(folder, "double"))
    assert done.returncode == 0, done.stdout
    message = refused(
        mwdcal("convert", calibration, "--to", "fixed-point", "-o", tmp_path / "f"), 2
    )
    assert "own-axis quadratic and cubic terms" in message
    assert "--to c-header" in message
    assert not (tmp_path / "f").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ((), "--notation or --to must be given"),
        (("--notation", "affine", "--to", "c-header", "-o", "x"), "not both"),
        (("--to", "c-header"), "--to needs the folder"),
        (
            ("--to", "c-header", "--temperature", "20", "-o", "x"),
            "--temperature goes with --notation",
        ),
        (
            ("--to", "c-header", "--word-bits", "24", "-o", "x"),
            "--word-bits goes with --to fixed-point",
        ),
        (
            ("--to", "fixed-point", "--word-bits", "11", "-o", "x"),
            "--word-bits must be between 12 and 32; got 11",
        ),
        (
            ("--to", "fixed-point", "--word-bits", "64", "-o", "x"),
            "--word-bits must be between 12 and 32; got 64",
        ),
        (("--to", "c-header", "-o", "no/where"), "does not exist. Create it"),
        (("--to", "c-header", "-o", "cal.json"), "it is not a folder"),
    ],
)
def test_what_does_not_go_together_is_refused(tmp_path, monkeypatch, options, words):
    monkeypatch.chdir(tmp_path)
    saved(tmp_path, whole(made("polynomial")))
    assert words in refused(mwdcal("convert", "cal.json", *options), 2)
    assert [path.name for path in tmp_path.iterdir()] == ["cal.json"]


def test_words_in_which_north_has_no_direction_are_refused(tmp_path):
    """Test vectors too close to tell were left out, all of them: C without any does not compile."""
    record = whole(made("polynomial"))
    for dip in (87.0, 88.0, 89.0, 89.5):
        earth = {**record.earth, "dip_deg": dip}
        calibration = saved(tmp_path, msgspec.structs.replace(record, earth=earth))
        ran = mwdcal(
            "convert", calibration, "--to", "fixed-point", "--word-bits", 12, "-o", tmp_path / "c"
        )
        assert "has no azimuth. Use more --word-bits" in refused(ran, 2)
        assert not (tmp_path / "c").exists()
        sources(tmp_path, calibration, "fixed-point", "--word-bits", 32)


def test_files_are_replaced_together_and_an_input_stays(tmp_path):
    calibration = saved(tmp_path, whole(made("factors")))
    folder, stated = sources(tmp_path, calibration, "c-header")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert sorted(before) == sorted(stated["files"])
    again, _ = sources(tmp_path, calibration, "c-header")
    assert {path.name: path.read_bytes() for path in again.iterdir()} == before
    (folder / "mwdcal_double.c").unlink()
    (folder / "mwdcal_double.c").symlink_to(calibration)
    message = refused(mwdcal("convert", calibration, "--to", "c-header", "-o", folder), 2)
    assert "it is an input" in message
    assert documents.read(calibration)


def test_the_screen_states_identity_errors_and_files(tmp_path):
    calibration = calibrated(tmp_path, servo_run())
    ran = mwdcal(
        "convert", calibration, "--to", "fixed-point", "--word-bits", 24, "-o", tmp_path / "fw"
    )
    assert ran.code == 0, ran
    stated = mwdcal(
        "convert",
        calibration,
        "--to",
        "fixed-point",
        "--word-bits",
        24,
        "-o",
        tmp_path / "fw",
        "--json",
    )
    errors = stated.json["errors"]
    assert f"{errors['gravity_g'] * 1000:.3g} mg" in ran.out
    assert f"{errors['inclination_deg']:.3g}°" in ran.out
    assert "fixed-point   24 bits" in ran.out
    assert f"wrote {tmp_path / 'fw'}: mwdcal_fixed.h" in ran.out
    header = (tmp_path / "fw" / "mwdcal_fixed.h").read_text()
    assert f"gravity            {errors['gravity_g'] * 1000:.3g} mg" in header
    assert stated.json["calibration_sha256"] in header


def test_the_documented_errors_are_those_of_the_example(tmp_path):
    """The table of `docs/reference/converted.md`, to its two digits."""
    run_file, profile = EXAMPLE / "run.csv", EXAMPLE / "tool.toml"
    ran = mwdcal("calibrate", run_file, "--tool", profile, "-o", tmp_path / "cal.json")
    assert ran.code == 0, ran
    text = (ROOT / "docs" / "reference" / "converted.md").read_text("utf-8")
    rows = re.findall(r"\| (\d\d) bits \| (\S+) mg \| (\S+) nT \| (\S+)° \| (\S+)° \|", text)
    assert [bits for bits, *_ in rows] == ["32", "24", "16"]
    for bits, gravity, *others in rows:
        errors = sources(tmp_path, tmp_path / "cal.json", "fixed-point", "--word-bits", bits)[1][
            "errors"
        ]
        assert float(gravity) == pytest.approx(1000 * errors["gravity_g"], rel=0.05)
        names = ("field_nt", "inclination_deg", "azimuth_deg")
        assert [float(other) for other in others] == pytest.approx(
            [errors[n] for n in names], rel=0.05
        )
