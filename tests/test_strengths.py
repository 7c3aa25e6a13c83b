"""Strengths after correction: units that are not the calibration's, shocks, iron, coils, references."""

from types import SimpleNamespace

import numpy as np
import pytest

from cli_support import calibrated, channels, mwdcal, read_csv, refused, servo_run, write_csv
from mwdcal.app import correction
from mwdcal.app.correction import apply_to_file
from mwdcal.errors import InputError
from mwdcal.files import documents
from mwdcal.use import strengths
from simulation import Tool

TOOL = Tool.random(4)
COUNT = 40
WAYS = {"whole": ".csv", "in parts, text": ".csv", "in parts, Parquet": ".parquet"}


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    return calibrated(tmp_path_factory.mktemp("fit"), servo_run(tool=TOOL))


@pytest.fixture(params=WAYS)
def way(request, monkeypatch):
    """Suffix of the table; text in parts where the way says so."""
    if request.param == "in parts, text":
        monkeypatch.setitem(correction.TABLE_SIZES, ".csv", 1)
    return WAYS[request.param]


def surveys(gain=(1.0, 1.0), some=None):
    """Raw channels of sound surveys; those of `some` rows, by default all, times the gains."""
    rng = np.random.default_rng(3)
    inc, azi, face = np.arccos(rng.uniform(-1, 1, COUNT)), *rng.uniform(0, 2 * np.pi, (2, COUNT))
    g, b = TOOL.clean(inc, azi, face)
    rows = np.isin(np.arange(COUNT), np.arange(COUNT) if some is None else some)[:, None]
    g, b = (np.where(rows, v * k, v) for v, k in zip((g, b), gain, strict=True))
    return {"temperature_c": np.full(COUNT, 25.0), **channels(g, b)}


def written(folder, columns, suffix):
    """The table, by a writer that is not the package's own."""
    if suffix == ".csv":
        return write_csv(folder / "surveys.csv", columns)
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    parquet.write_table(arrow.table(dict(columns)), folder / "surveys.parquet")
    return folder / "surveys.parquet"


def apply(calibration, source, folder, *options):
    out = folder / f"out{source.suffix}"
    return mwdcal("apply", calibration, source, "-o", out, *options), out


STRENGTH_UNITS = {
    "a calibration in volts on a table in g": ((1 / 3.0, 1.0), "readings in g."),
    "m/s² in the place of volts": ((9.80665 / 3.0, 1.0), "readings in m/s²."),
    "mg": ((1000 / 3.0, 1.0), "readings in mg."),
    "a calibration in volts on a table in nT": ((1.0, 1 / 5e-5), "readings in nT."),
    "µT": ((1.0, 1e-3 / 5e-5), "readings in µT."),
    "some other amplifier": ((1.3, 1.0), "3 raw units per g. Give"),
}


@pytest.mark.parametrize(("gain", "words"), STRENGTH_UNITS.values(), ids=STRENGTH_UNITS)
def test_readings_in_other_units_are_refused_and_nothing_is_written(
    tmp_path, calibration, way, gain, words
):
    source = written(tmp_path, surveys(gain), way)
    ran, out = apply(calibration, source, tmp_path)
    message = refused(ran, 2)
    assert words in message
    assert "at 40 of 40 rows corrected" in message
    assert "run.csv" in message
    assert not out.exists()
    assert sorted(p.name for p in tmp_path.iterdir()) == [source.name]
    out.write_text("old")
    apply(calibration, source, tmp_path)
    assert out.read_text() == "old"


@pytest.mark.parametrize(("off", "told"), [(0, False), (1, True), (20, True), (21, None)])
def test_up_to_half_of_the_rows_it_is_a_finding_with_their_number(
    tmp_path, calibration, way, off, told
):
    """Shaken readings: gravity is doubled at some rows. Their results stay."""
    source = written(tmp_path, surveys((2.0, 1.0), np.arange(off)), way)
    ran, out = apply(calibration, source, tmp_path, "--json")
    if told is None:
        assert "at 21 of 40 rows" in refused(ran, 2)
        return
    assert ran.code == 0, ran.err
    found = {finding["id"]: finding["text"] for finding in ran.json["findings"]}
    assert ("implausible-gravity" in found) == told
    assert ran.json["blank"] == 0
    if told:
        assert f"{off} of 40 rows: corrected gravity" in found["implausible-gravity"]
        assert found["implausible-gravity"] in ran.err
        assert "implausible-field" not in found
        if way == ".csv":
            assert found["implausible-gravity"].partition(":")[0] in out.read_text("utf-8")


def test_the_table_s_own_references_count_too(tmp_path, calibration, way):
    """A field of 60 µT is one of the Earth, but not the one that the table states; blanks say nothing."""
    own = np.full(COUNT, TOOL.field)
    own[5:] = np.nan
    columns = {**surveys((1.0, 1.2)), "ref_field_nt": own}
    ran, _ = apply(calibration, written(tmp_path, columns, way), tmp_path, "--json")
    assert ran.code == 0, ran.err
    (text,) = [f["text"] for f in ran.json["findings"] if f["id"] == "implausible-field"]
    assert text.startswith("5 of 40 rows: ")
    assert "ref_field_nt" in text
    columns["ref_field_nt"] = np.full(COUNT, TOOL.field)
    message = refused(apply(calibration, written(tmp_path, columns, way), tmp_path)[0], 2)
    assert "at 40 of 40 rows" in message
    assert "5% off its reference ref_field_nt" in message
    assert message.endswith("Or are latitude and longitude of the reference those of the place?")
    columns["ref_field_nt"] = np.full(COUNT, TOOL.field * 1.2)
    ran, _ = apply(calibration, written(tmp_path, columns, way), tmp_path, "--json")
    assert [f["id"] for f in ran.json["findings"]] == ["no-serial"]


def test_blank_results_are_not_judged(tmp_path, calibration, way):
    """A row outside the calibrated temperatures has no strength that could be off."""
    columns = surveys((2.0, 1.0), np.arange(30))
    columns["temperature_c"] = np.where(np.arange(COUNT) < 30, 90.0, 25.0)
    ran, _ = apply(calibration, written(tmp_path, columns, way), tmp_path, "--json")
    assert [f["id"] for f in ran.json["findings"]] == ["no-serial", "outside-temperature"]


def stub(**changes):
    """As much of a calibration as is asked for strengths."""
    triad = SimpleNamespace(undetermined=[], name="accelerometer")
    stand = SimpleNamespace(coil=changes.get("coil", False))
    free = [SimpleNamespace(id="scale")] if changes.get("free") else []
    magnetometer = SimpleNamespace(undetermined=free, name="magnetometer")
    return SimpleNamespace(
        triads=[triad, magnetometer],
        relative=changes.get("relative", False),
        profile=SimpleNamespace(stand=stand),
    )


CASES = {
    "a coil has any field": ({"coil": True}, 5000.0, np.nan, 0),
    "but its reference counts": ({"coil": True}, 5000.0, 6000.0, 3),
    "a relative field is not judged": ({"relative": True}, 1.0, 50_000.0, None),
    "the Earth's weakest": ({}, 15_001.0, np.nan, 0),
    "weaker": ({}, 14_999.0, np.nan, 3),
    "the Earth's strongest": ({}, 79_999.0, np.nan, 0),
    "stronger": ({}, 80_001.0, np.nan, 3),
    "within 5 % of its reference": ({}, 52_400.0, 50_000.0, 0),
    "more than that": ({}, 47_400.0, 50_000.0, 3),
    "a free scale is not compared": ({"free": True}, 47_400.0, 50_000.0, 0),
}


@pytest.mark.parametrize(("changes", "field", "reference", "off"), CASES.values(), ids=CASES)
def test_which_fields_are_off(changes, field, reference, off):
    columns = {"gravity_g": np.ones(3), "field_nt": np.full(3, field)}
    found = strengths.judged(stub(**changes), columns, {"field": np.full(3, reference)})
    assert found["gravity"].off == 0
    assert (found["field"].off if "field" in found else None) == off


def test_parts_of_a_table_add_up(tmp_path, calibration):
    """Findings of a table in parts of seven rows are those of the whole."""
    pytest.importorskip("pyarrow")
    source = written(tmp_path, surveys((2.0, 0.1), [0, 9, 30, 39]), ".parquet")
    made = documents.read(calibration)
    tally, found = apply_to_file(made, source, tmp_path / "a.parquet", "blank", rows=7)
    again, wanted = apply_to_file(made, source, tmp_path / "b.parquet", "blank")
    assert [f.text for f in found] == [f.text for f in wanted]
    assert tally.strengths == again.strengths
    assert {name: each.off for name, each in tally.strengths.items()} == {"gravity": 4, "field": 4}
    assert {name: each.rows for name, each in tally.strengths.items()} == {
        "gravity": 40,
        "field": 40,
    }


def test_a_calibration_without_temperatures_on_warm_readings_is_a_finding(tmp_path, way):
    bare = {k: v for k, v in servo_run(tool=TOOL).items() if k != "temperature_c"}
    made = calibrated(tmp_path, bare)
    columns = surveys()
    columns["temperature_c"] = np.linspace(20.0, 150.0, COUNT)
    ran, _ = apply(made, written(tmp_path, columns, way), tmp_path, "--json")
    assert ran.code == 0, ran.err
    found = {f["id"]: f["text"] for f in ran.json["findings"]}
    assert list(found) == ["no-serial", "no-temperature"]
    assert "20.0…150.0 °C" in found["no-temperature"]
    del columns["temperature_c"]
    ran, _ = apply(made, written(tmp_path, columns, way), tmp_path, "--json")
    found = {f["id"]: f["text"] for f in ran.json["findings"]}
    assert list(found) == ["no-serial", "no-temperature"]
    assert found["no-temperature"].endswith("its run recorded no temperature.")


def test_python_refuses_what_the_command_refuses(tmp_path, calibration):
    from mwdcal.files import runs
    from mwdcal.use.correction import correct

    made = documents.read(calibration)
    source = written(tmp_path, surveys((1 / 3.0, 1.0)), ".csv")
    readings, _ = runs.read_run(source, made.profile)
    with pytest.raises(InputError, match="no place on Earth"):
        correct(made, readings)
    assert read_csv(source)
