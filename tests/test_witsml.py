"""WITSML: published examples are read, nothing is lost on the way out and back, attacks are refused."""

import os
import re
import subprocess
import sys
import time
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cli_support import mwdcal, stations
from mwdcal import extras
from mwdcal.errors import InputError
from mwdcal.files.exchange import description, witsml
from mwdcal.files.formats.table import Table, read, rendered, write
from simulation import attitude, plan

defusedxml = pytest.importorskip("defusedxml")
DATA = os.environ.get("MWDCAL_DATA")
quick = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
SERIES = "{http://www.witsml.org/schemas/1series}"
RAW = """<rawData><gravAxialRaw uom="m/s2">9.80665</gravAxialRaw><gravTran1Raw uom="mgn">-20</gravTran1Raw>
<gravTran2Raw uom="ft/s2">32.17404855643044</gravTran2Raw><magAxialRaw uom="gauss">0.5</magAxialRaw>
<magTran1Raw uom="uT">-25</magTran1Raw><magTran2Raw uom="nT">17</magTran2Raw></rawData>"""


def trajectory(inside, namespace="http://www.witsml.org/schemas/1series", head=""):
    return (
        f'<?xml version="1.0"?>{head}<trajectorys xmlns="{namespace}" version="1.4.1.1">'
        f"<trajectory><nameWell>W</nameWell>{inside}</trajectory></trajectorys>"
    ).encode()


def station(inside, uid="1"):
    return f'<trajectoryStation uid="{uid}"><md uom="ft">1000</md>{inside}</trajectoryStation>'


def ideal_calibration(folder):
    """A calibration of a tool without errors, whose readings are in g and nT."""
    inc, azi, face = plan((5, 60, 120), 6)
    g, b = attitude(inc, azi, face)(1.0, 50_000.0, np.radians(60.0))
    raw = zip(["ax", "ay", "az", "mx", "my", "mz"], np.concatenate([g, b], -1).T, strict=True)
    columns = {
        k: np.asarray(v, float)
        for k, v in stations(inc, azi, face, earth=(1.0, 50_000.0, 60.0)).items()
    }
    write(folder / "run.parquet", Table({**columns, **dict(raw)}))
    ran = mwdcal("calibrate", folder / "run.parquet", "-o", folder / "cal.json")
    assert ran.code == 0, ran.err
    return folder / "cal.json"


def same(table, again):
    assert list(again.columns) == list(table.columns)
    for name, column in table.columns.items():
        if isinstance(column, list):
            assert again.columns[name] == column, name
        else:
            np.testing.assert_array_equal(again.columns[name], column, name)
    assert again.metadata == table.metadata


def round_trip(folder, table, name="t.xml"):
    path = folder / name
    write(path, table)
    return read(path)


@pytest.mark.skipif(not DATA, reason="needs the published examples")
@pytest.mark.parametrize("version", ["1311", "1411"])
def test_the_published_examples(tmp_path, version):
    table = read(Path(DATA) / "survey" / f"witsml_trajectory_{version}.xml")
    assert table.columns["station"] == ["34ht5"]
    assert table.columns["md_m"].tolist() == [0.0]
    gravity = [float(table.columns[name][0]) for name in ("ax", "ay", "az")]
    # ft/s² in g: 0.3048 m in a foot, 9.80665 m/s² in g
    np.testing.assert_allclose(gravity, np.array([-0.168, -1654, 0.116]) * 0.3048 / 9.80665, 1e-15)
    assert [float(table.columns[name][0]) for name in ("mx", "my", "mz")] == [22.5, 27.05, 22.77]
    assert table.columns["witsml incl (dega)"] == ["0"]
    assert table.columns["witsml corUsed/stnGridCorUsed (dega)"] == ["-0.4917"]
    assert table.columns["witsml location[2]/easting (m)"] == ["427710.69"]
    assert table.metadata["well"] == "6507/7-A-42"
    assert table.metadata["witsml aziRef"] == "grid north"
    again = round_trip(tmp_path, table)
    assert again.metadata == table.metadata
    assert list(again.columns) == list(table.columns)
    for (
        name,
        column,
    ) in table.columns.items():  # numbers in text become numbers, as in every typed format
        assert [float(c) if _numeric(c) else c for c in column] == [*again.columns[name]], name


def _numeric(cell):
    try:
        return np.isfinite(float(cell))
    except ValueError:
        return False


def test_units_are_those_of_the_attribute_and_axes_those_of_the_tool(tmp_path):
    path = tmp_path / "t.xml"
    path.write_bytes(trajectory(station(RAW) + station("", "2")))
    columns = read(path).columns
    values = {name: columns[name][0] for name in ("md_m", "ax", "ay", "az", "mx", "my", "mz")}
    assert values == pytest.approx(
        {"md_m": 304.8, "ax": -0.02, "ay": 1.0, "az": 1.0, "mx": -25_000, "my": 17, "mz": 50_000},
        rel=1e-15,
    )
    assert all(np.isnan(columns[name][1]) for name in ("ax", "mz"))  # no rawData: blank


@pytest.mark.parametrize(
    "encoding", ["utf-7", "utf-16-le", "utf-32", "big5", "shift_jis", "idna", "rot13", "no-such"]
)
def test_an_encoding_that_xml_readers_lack_is_refused(tmp_path, encoding):
    path = tmp_path / "t.xml"
    path.write_bytes(
        f'<?xml version="1.0" encoding="{encoding}"?>'.encode() + trajectory(station(""))
    )
    with pytest.raises(InputError, match=r"t\.xml: (XML must be UTF-8|expected well-formed XML)"):
        read(path)


@pytest.mark.parametrize(
    ("content", "part"),
    [
        (station('<rawData><gravAxialRaw uom="V">3</gravAxialRaw></rawData>'), "got 'V'"),
        (station("<rawData><gravAxialRaw>3</gravAxialRaw></rawData>"), "got ''"),
        (station('<rawData><gravAxialRaw uom="nT">3</gravAxialRaw></rawData>'), "gn, mgn, m/s2"),
        (station('<rawData><magAxialRaw uom="nT">NaN</magAxialRaw></rawData>'), "got 'NaN'"),
        (station('<rawData><magAxialRaw uom="nT">1e999</magAxialRaw></rawData>'), "finite"),
        ("", "no stations"),
        (station("") + "</trajectory><trajectory>", "at most 1 elements 'trajectory'"),
        (station("<a>" * 30 + "</a>" * 30), "levels of elements"),
        (station(f"<a>{'x' * 1_100_000}</a>"), "characters in an element"),
        (station(f'<a b="{"x" * 1_200_000}"/>'), "bytes in a tag"),
        (station("<a>"), "well-formed"),
        (station("\x01"), "well-formed"),
        (station("&undefined;"), "well-formed"),
    ],
)
def test_what_is_refused_in_one_sentence(tmp_path, content, part):
    path = tmp_path / "t.xml"
    path.write_bytes(trajectory(content))
    with pytest.raises(InputError) as refusal:
        read(path)
    assert part in str(refusal.value)
    assert str(refusal.value).startswith("t.xml")
    assert "\n" not in str(refusal.value)
    assert str(refusal.value).isprintable()


def test_a_unit_of_measure_is_refused_with_its_line(tmp_path):
    path = tmp_path / "t.xml"
    path.write_bytes(
        trajectory("\n\n" + station('\n<rawData><magAxialRaw uom="V">3</magAxialRaw></rawData>'))
    )
    with pytest.raises(InputError, match=r"t\.xml, line 4, 'magAxialRaw'"):
        read(path)


BOMB = '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">' + "".join(
    f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in zip("abcdefghi", "bcdefghij", strict=True)
)
ATTACKS = {
    "entity bomb": trajectory(station("<n>&j;</n>"), head=BOMB + "]>"),
    "external entity": trajectory(
        station("<n>&x;</n>"), head='<!DOCTYPE x [<!ENTITY x SYSTEM "file:///etc/passwd">]>'
    ),
    "parameter entity": trajectory(
        station(""), head='<!DOCTYPE x [<!ENTITY % x SYSTEM "http://127.0.0.1:9/x"> %x;]>'
    ),
    "document type": trajectory(station(""), head='<!DOCTYPE x SYSTEM "http://127.0.0.1:9/x.dtd">'),
    "unparsed entity": trajectory(
        station(""), head='<!DOCTYPE x [<!NOTATION n SYSTEM "n"><!ENTITY x SYSTEM "x" NDATA n>]>'
    ),
    "unknown encoding": trajectory(station("")).replace(
        b'version="1.0"', b'version="1.0" encoding="x-7"'
    ),
    "other namespace": trajectory(station(""), "http://example.org"),
    "version 2": b'<Trajectory xmlns="http://www.energistics.org/energyml/data/witsmlv2"/>',
    "another object": b'<logs xmlns="http://www.witsml.org/schemas/1series"><log/></logs>',
    "a page": b"<!DOCTYPE html><html><body>no</body></html>",
    "nothing": b"",
    "blanks": b"   \n",
    "binary": bytes(range(256)) * 4,
    "cut": trajectory(station(RAW))[:300],
    "two roots": trajectory(station("")) * 2,
    "deep": b"<a>" * 1_000_000,
    "names": b"<" + b"a" * 3_000_000,
    "attributes": b"<a " + b" ".join(b'a%d="1"' % k for k in range(300_000)) + b"/>",
}


@pytest.mark.parametrize("attack", ATTACKS)
def test_attacks_are_refused_in_one_sentence_and_at_once(tmp_path, attack):
    path = tmp_path / "t.xml"
    path.write_bytes(ATTACKS[attack])
    begun = time.process_time()
    with pytest.raises(InputError) as refusal:
        read(path)
    assert time.process_time() - begun < 5.0
    assert str(refusal.value).isprintable()
    assert "root:" not in str(refusal.value)
    assert len(str(refusal.value)) < 400


def test_a_flood_of_elements_takes_bounded_memory(tmp_path):
    """Empty elements in a file as large as may be: the tree of an ordinary parser takes gigabytes."""
    path = tmp_path / "t.xml"
    path.write_bytes(trajectory(station("<a/>" * 11_000_000)))
    code = (
        "import sys\nfrom mwdcal.files.exchange import witsml_reader\n"
        "from mwdcal.errors import InputError\nfrom mwdcal.files.formats.table import read\n"
        "witsml_reader.MOST_ELEMENTS = 200_000\n"
        "try: read(sys.argv[1])\nexcept InputError as error: print(error)\n"
        "print(next(line.split()[1] for line in open('/proc/self/status') if line.startswith('VmHWM')))"
    )
    ran = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True
    )
    message, peak = ran.stdout.splitlines()
    assert "200000 elements" in message
    assert int(peak) * 1024 < 400_000_000


def test_a_sparse_table_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(description, "MAX_VALUES", 1000)
    path = tmp_path / "t.xml"
    path.write_bytes(trajectory("".join(station(f"<a{k}>1</a{k}>", k) for k in range(40))))
    with pytest.raises(InputError, match="at most 1000 values"):
        read(path)


def test_a_missing_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "defusedxml", None)
    path = tmp_path / "t.xml"
    path.write_bytes(trajectory(station(RAW)))
    with pytest.raises(InputError, match=re.escape(extras.command("survey"))):
        read(path)


texts = st.text(
    st.characters(exclude_categories=["Cs", "Cc"], exclude_characters="\ufffe\uffff")
) | st.sampled_from(
    [
        "",
        " ",
        " a ",
        "a\nb",
        "a\r\nb",
        "\t",
        "</value>",
        "&amp;",
        "]]>",
        "<!--",
        '"',
        "'",
        "#",
        "ü\u2028é",
        "007",
        "=1+1",
    ]
)
kinds = st.sampled_from(["gravity", "magnetic"])
words = texts.filter(lambda text: not text.strip() or not _numeric(text.replace("_", "x")))
finite = st.floats(allow_nan=False, allow_infinity=False)
cells = finite | st.just(np.nan)
KNOWN = [
    *witsml._OURS,
    "azimuth_deg",
    "azimuth_grid_deg",
    "azimuth_true_deg",
    "azimuth_magnetic_deg",
]
KNOWN += [
    "ax",
    "ay",
    "az",
    "mx",
    "my",
    "mz",
    "temperature_c",
    "witsml incl (dega)",
    "witsml azi (dega)",
]
KNOWN += ["witsml dls (dega/ft)", "witsml nonsense (V)", "gx_g", "sd_azimuth_deg"]
LABELLED = [
    "station",
    "finding",
    "toolface_kind",
    "witsml typeTrajStation",
    "witsml dTimStn",
    "note <&>",
]
states = st.dictionaries(
    st.sampled_from(["code", "well", "accelerometer_unit", "magnetometer_unit", "field_unit", "witsml aziRef"])
    | st.text(min_size=1, max_size=8).filter(lambda key: key.isprintable()),
    st.sampled_from(["g", "nT", "m/s²", "µT", "relative", "grid north"])
    | st.integers(-9, 9) | finite | st.booleans() | st.lists(st.integers(0, 9))
    | st.text(max_size=9).filter(str.isprintable),
)  # fmt: skip


@st.composite
def tables(draw):
    count = draw(st.integers(1, 4))

    def numbers(values):
        return np.array(draw(st.lists(values, min_size=count, max_size=count)))

    columns = {"md_m": numbers(finite)}
    names = draw(st.lists(st.sampled_from(KNOWN), unique=True))
    columns |= {name: numbers(cells) for name in names if name != "md_m"}
    for name in draw(st.lists(st.sampled_from(LABELLED), unique=True)):
        columns[name] = draw(
            st.lists(kinds if name == "toolface_kind" else words, min_size=count, max_size=count)
        )
        if name not in ("station",) and not any(cell.strip() for cell in columns[name]):
            columns[name][0] = (
                "x"  # a wholly blank column of text becomes one of numbers in typed formats
            )
    order = draw(st.permutations(list(columns)))
    return Table({name: columns[name] for name in order}, draw(states))


@quick
@given(tables())
def test_what_is_written_is_read(tmp_path, table):
    same(table, round_trip(tmp_path, table))
    assert rendered("t.xml", table) == rendered("t.xml", table)
    ElementTree.fromstring(rendered("t.xml", table))  # well-formed for others, too


def test_elements_are_in_the_order_of_the_schema_with_their_units(tmp_path):
    count = 2
    metric = [name for name in witsml._OURS if not name.endswith(("ft", "ft2"))]
    names = [*metric, "azimuth_deg", "ax", "ay", "az", "mx", "my", "mz", "station", "gx_g"]
    columns = {name: np.arange(count) + 0.5 for name in names} | {"station": ["a", "b"]}
    units = {"accelerometer_unit": "m/s²", "magnetometer_unit": "µT"}
    root = ElementTree.fromstring(rendered("t.xml", Table(columns, units)))
    first = root.find(f".//{SERIES}trajectoryStation")
    assert first.get("uid") == "a"
    tags = [element.tag.removeprefix(SERIES) for element in first]
    assert tags == [
        *(
            "typeTrajStation",
            "md",
            "tvd",
            "incl",
            "azi",
            "mtf",
            "gtf",
            "dispNs",
            "dispEw",
            "vertSect",
        ),
        *("gravTotalUncert", "dipAngleUncert", "magTotalUncert", "gravTotalFieldReference"),
        *(
            "magTotalFieldReference",
            "magDipAngleReference",
            "rawData",
            "valid",
            "matrixCov",
            "extensionNameValue",
        ),
    ]
    assert root.find(f".//{SERIES}aziRef").text == "magnetic north"
    raw = {e.tag.removeprefix(SERIES): e.get("uom") for e in first.find(f"{SERIES}rawData")}
    assert list(raw) == [
        f"{k}{axis}Raw" for k in ("grav", "mag") for axis in ("Axial", "Tran1", "Tran2")
    ]
    assert raw["gravAxialRaw"] == "m/s2"
    assert raw["magAxialRaw"] == "uT"


def test_a_magnetic_toolface_is_not_called_a_gravity_toolface(tmp_path):
    columns = {"md_m": np.ones(3), "toolface_deg": np.array([10.0, 20.0, np.nan])}
    table = Table(columns | {"toolface_kind": ["gravity", "magnetic", "magnetic"]})
    root = ElementTree.fromstring(rendered("t.xml", table))
    first, second, third = root.iter(f"{SERIES}trajectoryStation")
    assert (first.findtext(f"{SERIES}gtf"), first.find(f"{SERIES}mtf")) == ("10.0", None)
    assert (second.find(f"{SERIES}gtf"), second.findtext(f"{SERIES}mtf")) == (None, "20.0")
    assert (third.find(f"{SERIES}gtf"), third.find(f"{SERIES}mtf")) == (None, None)
    same(table, round_trip(tmp_path, table))
    both = Table({**table.columns, "magnetic_toolface_deg": np.array([30.0, 20.0, np.nan])})
    first = next(ElementTree.fromstring(rendered("t.xml", both)).iter(f"{SERIES}trajectoryStation"))
    assert (first.find(f"{SERIES}gtf"), first.findtext(f"{SERIES}mtf")) == (None, "30.0")
    same(both, round_trip(tmp_path, both))


def test_raw_channels_of_unknown_unit_are_not_called_a_gravity(tmp_path):
    columns = {name: np.ones(2) for name in ("md_m", "ax", "ay", "az", "mx", "my", "mz")}
    text = rendered("t.xml", Table(columns)).decode()
    assert "rawData" not in text
    same(Table(columns), round_trip(tmp_path, Table(columns)))


def test_a_relative_field_is_not_called_nanotesla():
    columns = {"md_m": np.ones(1), "field_nt": np.ones(1)}
    assert "magTotalFieldCalc" in rendered("t.xml", Table(columns)).decode()
    assert (
        "magTotalFieldCalc"
        not in rendered("t.xml", Table(columns, {"field_unit": "relative"})).decode()
    )


@pytest.mark.parametrize(
    ("columns", "part"),
    [
        ({"ax": np.ones(1)}, "must have a measured depth"),
        ({"md_m": np.array([np.nan])}, "must have a measured depth"),
        ({"md_m": np.ones(1), "note": ["a\x1bb"]}, "control characters"),
        ({"md_m": np.ones(1), "a\x00b": np.ones(1)}, "control characters"),
        ({"md_m": np.ones(1), "ax": np.array([np.inf])}, "finite"),
    ],
)
def test_what_cannot_be_written(tmp_path, columns, part):
    with pytest.raises(InputError, match=part):
        write(tmp_path / "t.xml", Table(columns))
    assert not [*tmp_path.iterdir()]


def test_a_file_that_was_changed_by_another_program(tmp_path):
    table = Table({"md_m": np.array([10.0]), "incl": np.ones(1)})
    text = rendered("t.xml", table).decode()
    path = tmp_path / "t.xml"
    path.write_text(text.replace('<md uom="m">10.0', '<md uom="ft">10.0'), "utf-8")
    assert read(path).columns["md_m"].tolist() == [3.048]
    path.write_text(text.replace("columns = [", "columns = [3, "), "utf-8")
    with pytest.raises(InputError, match="another program has changed"):
        read(path)


def test_extensions_of_other_programs_are_kept(tmp_path):
    extension = (
        '<extensionNameValue><name>Temp</name><value uom="degC">81</value></extensionNameValue>'
    )
    path = tmp_path / "t.xml"
    path.write_bytes(trajectory(station(RAW + extension)))
    assert read(path).columns["witsml extension Temp (degC)"] == ["81"]


@quick
@given(st.binary(max_size=200), st.integers(0, 900))
def test_damaged_files_are_refused_or_read(tmp_path, noise, place):
    whole = rendered("t.xml", Table({"md_m": np.ones(2), "note": ["a", "b"]}, {"serial": "X"}))
    path = tmp_path / "t.xml"
    path.write_bytes(whole[:place] + noise + whole[place + len(noise) :])
    try:
        table = read(path)
    except InputError:
        return
    assert table.count > 0


def test_apply_to_a_trajectory_keeps_depths_and_gives_its_angles(tmp_path):
    """Readings in g and nT, of a tool without errors, through a calibration from a run in V."""
    inc, azi, face = np.radians([[10.0, 45.0, 100.0], [45.0, 120.0, 300.0], [30.0, 200.0, 350.0]])
    g, b = attitude(inc, azi, face)(1.0, 50_000.0, np.radians(60.0))
    raw = zip(["ax", "ay", "az", "mx", "my", "mz"], np.concatenate([g, b], -1).T, strict=True)
    units = {"accelerometer_unit": "g", "magnetometer_unit": "nT", "well": "A-1", "serial": "77"}
    surveys = Table({"md_m": np.array([0.1, 1.0 / 3.0, 900.0]), **dict(raw)}, units)
    write(tmp_path / "surveys.xml", surveys)
    cal = ideal_calibration(tmp_path)
    ran = mwdcal("apply", cal, tmp_path / "surveys.xml", "-o", tmp_path / "out.xml")
    assert ran.code == 0, ran.err
    out = read(tmp_path / "out.xml")
    np.testing.assert_array_equal(out.columns["md_m"], surveys.columns["md_m"])
    np.testing.assert_array_equal(out.columns["az"], surveys.columns["az"])
    assert out.metadata["well"] == "A-1"
    for name, angle in (("inclination_deg", inc), ("azimuth_deg", azi), ("toolface_deg", face)):
        np.testing.assert_allclose(out.columns[name], np.degrees(angle), atol=1e-6)
    root = ElementTree.parse(tmp_path / "out.xml").getroot()
    assert [float(e.text) for e in root.iter(f"{SERIES}incl")] == out.columns[
        "inclination_deg"
    ].tolist()
    assert len([*root.iter(f"{SERIES}gravAxialRaw")]) == 3
    assert mwdcal("apply", cal, tmp_path / "surveys.xml", "-o", tmp_path / "out.csv").code == 0
    csv = read(tmp_path / "out.csv")
    assert [float(cell) for cell in csv.columns["dip_deg"]] == out.columns["dip_deg"].tolist()
