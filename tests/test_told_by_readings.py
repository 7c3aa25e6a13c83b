"""Units, angles, north and columns of the stand that are found from the readings, and references in unusual words.

Expected values are those of the simulated run, rewritten as another laboratory would have it.
"""

import re

import numpy as np
import pytest
from openpyxl import Workbook

import mwdcal as library
from cli_support import RAW, mwdcal, refused, servo_run, write_csv
from mwdcal.errors import FitError
from mwdcal.files.formats.title_references import doubtful_in, references_in, stated_above
from mwdcal.files.formats.titles import titles
from mwdcal.identification.columns import meaning
from test_tables_as_they_come import (
    ANGLES,
    calibrated,
    findings_of,
    mixed,
    read,
    table,
    written,
)

FIELD, DIP, GRAVITY = 50_123.0, 66.12, 9.8123 / 9.80665
WORDS = (
    [["Earth field: 50.123 uT", "Field dip: 66.12 deg", "9.8123 m/s2"]],
    [["Magnetfält (totalt)", 50.123, "µT"], ["Inklination", "66,12 grader"], ["Tyngdacceleration", "9,8123 m/s²"]],
    [["Toplam manyetik alan: 50.123 nT; eğim 66,12°; yerçekimi 9,8123 m/s²"]],
    [["Kenttävoimakkuus 50,123 µT; inklinaatio 66,12°; painovoima 9,8123 m/s2"]],
    [["Bez. pole geomagn. 50123 nT, sklon 66,12°, tíhové zrychlení 9,8123 m/s2"]],
    [["地磁总强度：50123nT，磁倾角：66.12°，g=9.8123m/s²"]],
    [["Campo terrestre (IGRF) : 0,50123 G / 66,12 ° / 981,23 gal"]],
    [["F_ref=50123"], ["I_ref=66.12"], ["g_ref=9.8123"]],
    [["B0 [nT]", "I0 [deg]", "g0 [m/s^2]"], ["50123", "66.12", "9.8123"]],
    [["Магнітна індукція, нТл", 50123, "", "Магнітне нахилення, °", 66.12, "", "g, м/с²", 9.8123]],
    [["Feldstärke 501.23 mG", "Inkl. 66°07'12\"", "Erdschwere 9,8123 m/s²"]],
)  # fmt: skip
GAMMAS = (
    ["Intensidad del campo", "50 123 gamma"], ["Mag field (kγ)", 50.123], ["Field", "50123 gammas"], ["F (γ)", 50123],
)  # fmt: skip
NO_PLACE = (
    "Horizontal intensity 20123 nT", "Bias field 20000 nT", "Coil field: 25000 nT", "field 50120 nT, end 50131 nT",
    "Mean field measured 50123 nT", "sensitivity 20000 nT/V", "Total field (uT) 50630", "dip 97.2", "Gravity 1.0123 g",
)  # fmt: skip


@pytest.mark.parametrize("rows", WORDS)
def test_references_of_a_place_are_told_by_unit_and_size_in_whatever_words(rows):
    stated = references_in(rows)
    expected = {"ref_field_nt": FIELD, "ref_dip_deg": DIP, "ref_gravity_g": GRAVITY}
    assert stated == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("row", GAMMAS)
def test_a_gamma_is_a_nanotesla(row):
    assert references_in([row]) == {"ref_field_nt": pytest.approx(FIELD, rel=1e-12)}
    assert references_in([["Gamma ray probe 20311"], ["Serial 20311 gamma ray"]]) == {}


def test_the_dip_of_a_hole_is_its_inclination_from_the_horizontal(tmp_path):
    columns = table()
    columns["Hole dip (deg)"] = np.asarray(columns.pop("Inc (deg)")) - 90
    path = written(tmp_path / "a.csv", columns)
    inclination = np.asarray(servo_run()["ref_inclination_deg"])
    assert reference(path, "inclination") == pytest.approx(inclination)


@pytest.mark.parametrize("line", NO_PLACE)
def test_what_is_no_reference_of_the_place_is_not_read(line):
    assert references_in([[line]]) == {}


@pytest.mark.parametrize(
    "line", ["Total field (uT);50630", "Dip;97.2", "Gravity;1.0123;g", "Coil field;25000 nT"]
)
def test_a_reference_that_no_place_has_is_named_by_profile_and_calibrate(tmp_path, line):
    assert len(doubtful_in([line.split(";")])) == 1
    absent = dict.fromkeys(("ref_field_nt", "ref_dip_deg", "ref_gravity_g"))
    path = written(tmp_path / "a.csv", table(**absent), line, delimiter=";")
    tool = tmp_path / "t.toml"
    for ran in (
        mwdcal("profile", path, "-o", tool),
        mwdcal("calibrate", path, "--tool", tool, "-o", tmp_path / "c.json"),
    ):
        assert ran.code == 0
        said = ran.err.partition(f"{line.replace(';', ' ')}' is nominal or unclear")[2]
        assert ", and not taken" in said
        assert line[:4] != "Grav" or "no gravity on Earth (9.76 to 9.84 m/s²)" in said


def test_a_remark_beside_the_first_row_states_the_place(tmp_path):
    """As a logger's comment does, in a column that is otherwise blank, or a line below the table."""
    absent = dict.fromkeys(("ref_field_nt", "ref_dip_deg"))
    remark = "Bt 50123 nT dip 66.12"
    columns = table(**absent, Comment=[remark, *[""] * 47])
    run = read(written(tmp_path / "a.csv", columns))
    assert run.reference("field") == pytest.approx(np.full(48, FIELD))
    path = written(tmp_path / "b.csv", table(**absent))
    path.write_text(f"{path.read_text()}\n{remark}\n")
    assert np.degrees(read(path).reference("dip")) == pytest.approx(np.full(48, DIP))


@pytest.mark.parametrize(
    ("cells", "serial"),
    [
        (["Инклинометр ИН-60, заводской номер 60-0318"], "60-0318"),
        (["Sonden-SN", "FR-3008"], "FR-3008"),
        (["Appareil : sonde DIR 4, numéro 4-118"], "4-118"),
        (["Stand S/N 44", "Tool S/N 45"], "45"),
        (["Reference magnetometer s/n 3344"], None),
    ],
)
def test_a_serial_is_the_tools_anywhere_in_a_line(cells, serial):
    assert titles([cells]).metadata.get("serial") == serial


def reference(path, name="toolface", **answers):
    return np.degrees(read(path, **answers).reference(name))


def rounded(step, seed=4):
    """Angles of the stand to the next step, as it was to be set, beside where it stopped."""
    rng = np.random.default_rng(seed)
    run = servo_run()
    names = ("ref_inclination_deg", "ref_azimuth_deg", "ref_toolface_deg")
    return [np.asarray(run[n]) + rng.uniform(-step, step, 48) for n in names]


SET_AND_READ = (
    ("Soll", "Ist"), ("Soll", "actual"), ("Target", "Encoder"), ("Set", "Read"), ("Nom", "Act"),
    ("consigne", "mesurée"), ("comandada", "medida (banco)"), ("zadane", "zmierzone"),
    ("börvärde", "ärvärde"), ("指令値", "実測値"),
)  # fmt: skip


@pytest.mark.parametrize(("word", "other"), SET_AND_READ)
def test_of_what_a_stand_was_set_to_and_shows_it_is_what_it_shows(tmp_path, word, other):
    columns = table()
    for name, values in zip(("Inc", "Azi", "TF"), rounded(0.5), strict=True):
        shown = columns.pop(f"{name} (deg)")
        columns |= {f"{name} {word} (deg)": np.round(values), f"{name} {other} (deg)": shown}
    path = written(tmp_path / "a.csv", columns)
    assert reference(path) == pytest.approx(np.asarray(servo_run()["ref_toolface_deg"]))


def test_measured_angles_beside_commanded_ones_may_be_the_tools_and_are_asked_about(tmp_path):
    columns = table()
    for name, values in zip(("Inc", "Azi", "TF"), rounded(0.5), strict=True):
        columns[f"Meas {name} (deg)"] = columns.pop(f"{name} (deg)")
        columns[f"Cmd {name} (deg)"] = np.round(values)
    message = refused(
        mwdcal("profile", written(tmp_path / "a.csv", columns), "-o", tmp_path / "t"), 3
    )
    assert "'Cmd TF (deg)' and 'Meas TF (deg)' may each be" in message
    behind = {
        " ".join([*reversed(n.partition(" (")[0].split()), "(deg)"])
        if n[:4] in ("Cmd ", "Meas")
        else n: v
        for n, v in columns.items()
    }  # Inc Meas, Inc Cmd
    message = refused(
        mwdcal("profile", written(tmp_path / "b.csv", behind), "-o", tmp_path / "t.toml"), 3
    )
    assert "3 questions are open" in message
    for name in ("Inc", "Azi", "TF"):
        assert (
            f"'{name} Cmd (deg)' is what the stand was to be set to. Did the stand measure"
            in message
        )


# ---------------------------------------------------------- what the readings contradict

SOUTHERN = (
    ["Dip 66.12 S"], ["Dip", 66.12, "S"], ["Dip (S)", "66.12 deg"], ["Mergulho magnético", "66,12° Sul"],
    ["Inclinación magnética 66,12 grados (sur)"], ["Inklination 66,12° Süd"], ["Dip -66.12 S"], ["磁倾角 66.12° 南"],
)  # fmt: skip


@pytest.mark.parametrize("row", SOUTHERN)
def test_a_dip_in_the_south_is_negative(row):
    assert references_in([row]) == {"ref_dip_deg": pytest.approx(-DIP, rel=1e-12)}


@pytest.mark.parametrize(
    "row",
    [
        ["Dip 66.12 N"],
        ["Dip 66.12 S/N 4471"],
        ["Dip", 66.12, "S/N", "4471"],
        ["Inclinaison magnétique : 66,12 degrés"],
    ],
)
def test_other_words_behind_a_dip_do_not_turn_it(row):
    assert references_in([row]) == {"ref_dip_deg": pytest.approx(DIP, rel=1e-12)}


TWO_PLACES = (
    ["Field: 50123 / 48210 nT"], ["Field at Lab A 50123 nT, at Lab B 48210 nT"], ["Field (nT)", 50123, 48210],
    ["Dip: 66.12° / 58.30°"], ["Dip 66.12 and 58.30"], ["Dip", 66.12, 58.3], ["gravity 9.81234 and 9.79321"],
    ["g, м/с2", "9.8141; 9.7931"], ["Campo de referencia (nT)", "44870 / 42178"],
)  # fmt: skip


@pytest.mark.parametrize("row", TWO_PLACES)
def test_of_two_places_in_one_line_none_is_taken_and_the_line_is_named(row):
    assert references_in([row]) == {}
    assert len(doubtful_in([row])) == 1


@pytest.mark.parametrize(
    "row", [["Dip", 66.12, "25 °C"], ["Dip 66.12 12.03.2024"], ["Dip 66.12, decl 3.2"]]
)
def test_a_number_of_another_kind_behind_a_dip_is_no_second_one(row):
    assert references_in([row]) == {"ref_dip_deg": pytest.approx(DIP, rel=1e-12)}


@pytest.mark.parametrize("wrong", [5.0, -10.0, -30.0, None])
@pytest.mark.parametrize("titled", [True, False], ids=["title", "column"])
def test_a_dip_of_another_place_or_sign_is_asked_about_by_the_readings(tmp_path, wrong, titled):
    """The stations determine the dip themselves; left out, it is estimated."""
    dip = float(servo_run()["ref_dip_deg"][0])
    stated = -dip if wrong is None else dip + wrong
    lines = [f"Dip {stated:.3f} deg"] if titled else []
    columns = table(ref_dip_deg=None if titled else np.full(48, stated))
    path = written(tmp_path / "a.csv", columns, *lines)
    with pytest.raises(FitError, match="by the readings the dip is .* leaves the dip out") as error:
        library.propose_profile(path)
    assert float(re.search(r"the dip is (\S+)°", str(error.value))[1]) == pytest.approx(
        dip, abs=0.2
    )
    assert f"{stated:.1f}°" in str(error.value)
    assert np.isnan(reference(path, "dip", column={"ref_dip_deg": ""})).all()
    _, calibration = calibrated(tmp_path, path, "--column", "ref_dip_deg=")
    [estimated] = [c for c in calibration["constants"] if c["name"] == "dip"]
    assert calibration["earth"]["dip_deg"] == pytest.approx(dip, abs=0.1), estimated


def test_a_dip_that_differs_by_less_is_taken(tmp_path):
    dip = float(servo_run()["ref_dip_deg"][0]) + 1.0
    path = written(tmp_path / "a.csv", table(ref_dip_deg=None), f"Dip {dip:.3f} deg")
    assert reference(path, "dip") == pytest.approx(np.full(48, dip), abs=1e-3)


def test_rolls_in_whole_degrees_count_beside_angles_in_words_that_are_not_understood(tmp_path):
    """The readings identify inclination and azimuth, so the rolls are not the only angles of the stand."""
    words = {"Inc (deg)": "Tilt of cradle (deg)", "Azi (deg)": "Way of cradle (deg)"}
    columns = {words.get(name, name): values for name, values in table().items()}
    columns["TF (deg)"] = np.round(np.asarray(columns["TF (deg)"], float))
    path = written(tmp_path / "a.csv", columns)
    assert reference(path) == pytest.approx(columns["TF (deg)"])
    for name in ("inclination", "azimuth"):
        assert reference(path, name) == pytest.approx(np.asarray(servo_run()[f"ref_{name}_deg"]))


def test_a_column_of_dips_that_is_blank_is_no_other_place(tmp_path):
    path = written(tmp_path / "a.csv", table(ref_dip_deg=np.full(48, np.nan)))
    assert np.isnan(reference(path, "dip")).all()


UNITS_OF_OTHERS = ("Dip 1.1540 rad", "Dose 12 rad/h", "Radian Sensors Ltd", "Dip 73.467 gon")


@pytest.mark.parametrize("line", UNITS_OF_OTHERS)
def test_a_unit_of_angles_in_a_title_is_not_that_of_columns_which_it_cannot_be(tmp_path, line):
    path = written(tmp_path / "a.csv", table(ref_dip_deg=None), line)
    columns = {n.replace(" (deg)", ""): v for n, v in table(ref_dip_deg=None).items()}
    bare = written(tmp_path / "b.csv", columns, line)
    for each in (path, bare):
        assert reference(each) == pytest.approx(np.asarray(servo_run()["ref_toolface_deg"]))


@pytest.mark.parametrize(
    ("line", "units"),
    [("Angles en grades (400 gr = 1 tour)", ("gr", "gr", "gr")), ("", ("gon", "", ""))],
)
def test_gons_of_a_line_or_of_one_angle_are_those_of_all(tmp_path, line, units):
    columns = table(ref_dip_deg=None)
    for column, unit in zip(ANGLE_COLUMNS.values(), units, strict=True):
        angles = np.asarray(columns.pop(f"{column} (deg)")) / 0.9
        columns[f"{column}({unit})" if unit else column] = angles
    path = written(tmp_path / "a.csv", columns, line)
    findings = library.propose_profile(path).findings
    assert "told-by-readings" not in [each.id for each in findings]
    for name in ANGLE_COLUMNS:
        assert reference(path, name) == pytest.approx(np.asarray(servo_run()[f"ref_{name}_deg"]))


@pytest.mark.parametrize(
    ("word", "turned"), [("Inklinacja", False), ("Inklinasi", False), ("Dip", True)]
)
def test_a_dip_that_turns_counts_from_the_horizontal_in_english_alone(tmp_path, word, turned):
    """Beside no other inclination; elsewhere the word of both is inclination, which counts from the vertical."""
    columns = table(ref_dip_deg=None)
    angles = np.asarray(columns.pop("Inc (deg)"))
    columns[f"{word} (°)"] = angles - 90 if turned else angles
    path = written(tmp_path / "a.csv", columns)
    wanted = np.asarray(servo_run()["ref_inclination_deg"])
    assert reference(path, "inclination") == pytest.approx(wanted)


def test_gons_of_a_title_that_the_readings_do_not_fit_are_asked_about(tmp_path):
    columns = {n.replace(" (deg)", ""): v for n, v in table(ref_dip_deg=None).items()}
    path = written(tmp_path / "a.csv", columns, "theodolite with gon circle")
    message = refused(mwdcal("profile", path, "-o", tmp_path / "t.toml"), 3)
    assert "'TF' is in gons by a line above the table, and the readings do not fit" in message
    answers = {f"ref_{n}_deg": f"{c} (°)" for n, c in ANGLE_COLUMNS.items()}
    assert reference(path, column=answers) == pytest.approx(
        np.asarray(servo_run()["ref_toolface_deg"])
    )


ANGLE_COLUMNS = {"inclination": "Inc", "azimuth": "Azi", "toolface": "TF"}


@pytest.mark.parametrize(
    "name", ["Ref total field, base station (nT)", "Campo total de referencia (nT)"]
)
def test_a_reference_field_of_each_row_is_taken_in_whatever_words(tmp_path, name):
    field = np.round(50_100 + 5 * np.sin(np.arange(48)), 1)
    columns = table(**{"ref_field_nt": None, name: field})
    assert read(written(tmp_path / "a.csv", columns)).reference("field") == pytest.approx(field)


@pytest.mark.parametrize("spread", ["s {}", "СКО {}", "σ({})", "s({})"])
def test_the_scatter_of_a_channel_is_no_channel(tmp_path, spread):
    columns = table()
    for name in [n for n in columns if n[0] in "GH" and n[1] in "xyz"]:
        columns[spread.format(name[:2])] = np.full(48, 1e-4)
    run = read(written(tmp_path / "a.csv", columns))
    assert run.accelerometer == pytest.approx(
        read(written(tmp_path / "b.csv", table())).accelerometer
    )


def test_a_unit_may_stand_behind_a_preposition(tmp_path):
    columns = {
        n.replace(" (V)", " in V").replace(" (deg)", " in deg"): v for n, v in table().items()
    }
    path = written(tmp_path / "a.csv", columns)
    assert library.propose_profile(path).profile.columns["ax"].unit == "V"


def test_azimuths_from_geographic_north_with_a_stated_declination_are_true(tmp_path):
    azimuth = np.asarray(servo_run()["ref_azimuth_deg"]) + 5.86
    columns = {
        ("Azimut, coğrafi kuzeyden (°)" if n == "Azi (deg)" else n): v for n, v in table().items()
    }
    columns["Azimut, coğrafi kuzeyden (°)"] = np.round(azimuth, 2) % 360
    run = read(written(tmp_path / "a.csv", columns, "Manyetik sapma (°. doğu +),5.86"))
    turned = np.degrees(run.reference("azimuth")) - (azimuth - 5.86)
    assert (turned + 180) % 360 - 180 == pytest.approx(0, abs=0.006)


def test_an_angle_that_was_set_among_others_that_the_stand_shows_is_named(tmp_path):
    columns = {n.replace(" (deg)", " Ist (deg)"): v for n, v in table().items()}
    columns["Azi Soll (deg)"] = columns.pop("Azi Ist (deg)")
    columns["Dip (deg)"] = columns.pop("Dip Ist (deg)")
    columns |= {
        "Inc Soll (deg)": columns["Inc Ist (deg)"],
        "TF Soll (deg)": columns["TF Ist (deg)"],
    }
    proposal = library.propose_profile(written(tmp_path / "a.csv", columns))
    assert "ref_azimuth_deg=Azi Soll (deg)" in findings_of(proposal)["told-by-readings"]
    columns["Azi Ist (deg)"] = columns["Azi Soll (deg)"]
    whole = library.propose_profile(written(tmp_path / "b.csv", columns))
    assert "told-by-readings" not in findings_of(whole)


def test_an_angle_that_the_readings_fit_far_worse_than_its_twin_is_asked_about(tmp_path):
    """The column that a stand shows has lost its name; the ones that it was set to have theirs."""
    columns = table()
    for name, values in zip(("Inc", "Azi", "TF"), rounded(0.5), strict=True):
        columns[f"{name} 2"] = columns.pop(f"{name} (deg)")
        columns[f"{name} set (deg)"] = values
    path = written(tmp_path / "a.csv", columns)
    message = refused(mwdcal("profile", path, "-o", tmp_path / "t.toml"), 3)
    assert "'TF 2' and 'TF set (deg)' tell one angle" in message
    assert '--column "ref_toolface_deg=TF 2" or --column' in message


def test_what_the_tool_gives_of_the_dip_is_no_reference(tmp_path):
    """It follows the biases of the channels from station to station; the dip of a place does not."""
    run = servo_run()
    g, b = (np.array([run[n] for n in names]) for names in (("ax", "ay", "az"), ("mx", "my", "mz")))
    norms = np.linalg.norm(g, axis=0) * np.linalg.norm(b, axis=0)
    computed = np.degrees(np.arcsin(np.sum(g * b, 0) / norms))
    columns = table(**{"ref_dip_deg": None, "Dip angle (deg)": np.round(computed, 2)})
    proposal = library.propose_profile(written(tmp_path / "a.csv", columns))
    assert "ref_dip_deg" not in proposal.profile.columns
    assert "computed from the channels" in findings_of(proposal)["not-used"]


@pytest.mark.parametrize("sign", [1, -1])
def test_negative_inclinations_count_from_the_horizontal(tmp_path, sign):
    columns = table()
    columns["Inc (deg)"] = sign * (90 - np.asarray(columns["Inc (deg)"]))
    inclination = reference(written(tmp_path / "a.csv", columns), "inclination")
    assert inclination == pytest.approx(np.asarray(servo_run()["ref_inclination_deg"]))


def test_an_unknown_word_for_degrees_is_told_by_the_values_and_gons_by_the_readings(tmp_path):
    """Grade is Romanian for degrees, and French for gons."""
    columns = {n.replace("(deg)", "[grade]"): v for n, v in table(ref_dip_deg=None).items()}
    path = written(tmp_path / "a.csv", columns)
    face = np.asarray(servo_run()["ref_toolface_deg"])
    assert reference(path) == pytest.approx(face)
    hot = servo_run(temperatures=(25.0, 90.0, 150.0), toolfaces=4)
    hot["ref_inclination_deg"] = np.asarray(hot["ref_inclination_deg"]) / 0.9
    proposal = library.propose_profile(write_csv(tmp_path / "b.csv", hot))
    assert (
        "ref_inclination_deg=ref_inclination_deg (gon)" in findings_of(proposal)["told-by-readings"]
    )


def test_temperatures_of_a_unit_that_is_none_are_fahrenheit_where_they_can_be_no_other(tmp_path):
    hot = servo_run(temperatures=(25.0, 90.0, 150.0), toolfaces=4)
    celsius = np.asarray(hot.pop("temperature_c"))
    hot["Temp (deg)"] = celsius * 9 / 5 + 32
    assert read(write_csv(tmp_path / "a.csv", hot)).temperature == pytest.approx(celsius)
    hot["Temp (deg)"] = np.minimum(hot["Temp (deg)"], 100)
    with pytest.raises(FitError, match="whether it is in °C or °F or K"):
        library.propose_profile(write_csv(tmp_path / "b.csv", hot))


def test_the_temperature_of_the_oven_is_named(tmp_path):
    columns = {("Oven temp (C)" if n == "Temp (C)" else n): v for n, v in table().items()}
    proposal = library.propose_profile(written(tmp_path / "a.csv", columns))
    assert "'Oven temp (C)' is taken" in findings_of(proposal)["oven-temperature"]
    plain = library.propose_profile(written(tmp_path / "b.csv", table()))
    assert "oven-temperature" not in findings_of(plain)


def test_the_only_column_in_degrees_celsius_is_the_temperature_and_is_named(tmp_path):
    """Whatever it is called; not if the user says otherwise, nor with a blank cell."""
    columns = {("Probe heat (C)" if n == "Temp (C)" else n): v for n, v in table().items()}
    path = written(tmp_path / "a.csv", columns)
    proposal = library.propose_profile(path)
    assert "'Probe heat (C)' is taken" in findings_of(proposal)["temperature-by-unit"]
    assert read(path).temperature == pytest.approx(np.asarray(table()["Temp (C)"]))
    said = library.propose_profile(path, column="temperature_c=Probe heat (C)")
    assert "temperature-by-unit" not in findings_of(said)
    assert said.profile.columns["temperature_c"] == proposal.profile.columns["temperature_c"]
    none = library.propose_profile(path, column="temperature_c=")
    assert "temperature_c" not in none.profile.columns
    assert "temperature-by-unit" not in findings_of(none)
    columns["Probe heat (C)"] = ["", *list(columns["Probe heat (C)"])[1:]]
    blank = library.propose_profile(written(tmp_path / "b.csv", columns))
    assert "temperature_c" not in blank.profile.columns
    assert "temperature_c=Probe heat (C)" in findings_of(blank)["temperature-by-unit"]


@pytest.mark.parametrize("names", [("Air (C)",), ("Heat (F)",), ("Top (C)", "Bottom (C)")])
def test_a_column_in_a_unit_of_temperatures_is_named_with_the_option_that_takes_it(tmp_path, names):
    """That of the air, one whose unit has another meaning, or two: the run has no temperature by itself."""
    columns = table()
    columns |= dict.fromkeys(names, columns.pop("Temp (C)"))
    path = written(tmp_path / "a.csv", columns)
    ran = mwdcal("profile", path, "-o", tmp_path / "t.toml")
    assert ran.code == 0, ran
    for name in names:
        assert f'--column "temperature_c={name}"' in ran.err
    taken = mwdcal(
        "profile", path, "-o", tmp_path / "u.toml", "--column", f"temperature_c={names[0]}"
    )
    assert f'temperature_c = {{name = "{names[0]}"' in (tmp_path / "u.toml").read_text("utf-8")
    assert "--column" not in taken.err


@pytest.mark.parametrize(
    "name",
    ["Heat at the end of the probe, by the sensor of March (C)", "'Probe heat' (C)"],
)
def test_a_name_that_messages_cut_or_quote_is_whole_in_the_option_that_takes_it(tmp_path, name):
    columns = table() | {name: np.asarray(table()["Temp (C)"]), "Heat (C)": np.full(48, 20.0)}
    del columns["Temp (C)"]
    said = findings_of(library.propose_profile(written(tmp_path / "a.csv", columns)))
    del columns["Heat (C)"]
    columns[name][0] = np.nan
    columns[name] = ["" if cell != cell else cell for cell in columns[name].tolist()]
    alone = findings_of(library.propose_profile(written(tmp_path / "b.csv", columns)))
    assert f'"temperature_c={name}"' in alone["temperature-by-unit"]
    assert "temperature-by-unit" in said


OF_OTHER_THINGS = (
    "Stand electronics (°C)", "Power supply (°C)", "PSU temp (C)", "Oven set point (°C)", "T_set (°C)", "PTemp_C",
    "Logger temp (C)", "Netzteil (°C)", "Rack temp (C)", "Bench electronics (°C)", "Coil temp (C)",
)  # fmt: skip
AROUND = (
    "Oven temp (C)", "Room (°C)", "Ambient (°C)", "Lab (°C)", "Thermostat temp (C)", "Raumtemperatur (°C)",
    "Turntable temp (C)", "Prüfstand Temperatur (°C)", "Темп. стенда (°C)",
)  # fmt: skip


@pytest.mark.parametrize("name", OF_OTHER_THINGS)
def test_the_temperature_of_another_thing_is_asked_about_and_never_before_one_of_the_tool(
    tmp_path, name
):
    """Alone it is asked about; beside an oven's that is taken, and beside the tool's this."""
    columns = table()
    warm = np.asarray(columns.pop("Temp (C)"))
    path = written(tmp_path / "a.csv", columns | {name: warm})
    with pytest.raises(FitError, match="not the temperature of the tool, and no other") as error:
        library.propose_profile(path)
    (question,) = error.value.questions
    assert [each.arguments[0][1] for each in question.answers] == [
        "temperature_c=",
        f"temperature_c={name}",
    ]
    assert read(path, column=f"temperature_c={name}").temperature == pytest.approx(warm)
    assert read(path, column="temperature_c=").temperature is None
    for other in ("Oven temp (C)", "Tool temp (C)", "Board temp (C)"):
        beside = columns | {name: warm + 3, other: warm}
        assert read(written(tmp_path / "b.csv", beside)).temperature == pytest.approx(warm), other


@pytest.mark.parametrize("name", AROUND)
def test_what_is_around_the_tool_has_its_temperature_where_nothing_else_has(tmp_path, name):
    columns = table()
    warm = np.asarray(columns.pop("Temp (C)"))
    proposal = library.propose_profile(written(tmp_path / "a.csv", columns | {name: warm}))
    assert proposal.profile.columns["temperature_c"].name == name
    assert f"{name!r} is taken" in findings_of(proposal)["oven-temperature"]


@pytest.mark.parametrize(
    "name",
    ["Gx temp comp (g)", "Temp comp Hx (nT)", "Bx (nT) temp corrected", "Temp X (g)", "Tmep (g)", "Tool T (uT)",
     "Sensor temp (m/s2)", "Temperatur (mG)"],
)  # fmt: skip
def test_a_channel_in_units_of_gravity_or_field_is_no_temperature(tmp_path, name):
    """Not beside one, nor where the table has none."""
    columns = table() | {name: np.asarray(table()["Hx (V)"])}
    assert read(written(tmp_path / "a.csv", columns)).temperature == pytest.approx(
        np.asarray(columns.pop("Temp (C)"))
    )
    assert read(written(tmp_path / "b.csv", columns)).temperature is None


def in_minutes(angles):
    """Angles as degrees and minutes: 13-59."""
    minutes = [round(60 * angle) for angle in np.asarray(angles)]
    return [f"{each // 60}-{each % 60:02d}" for each in minutes], np.array(minutes) / 60


@pytest.mark.parametrize(
    "names",
    [("θ", "φ", "ψ"), ("θ", "ψ", "φ"), ("Θ", "Φмагн", "Ψ (отклонитель)"), ("ϑ (°)", "ϕ (°)", "ψ (°)"),
     ("Ι", "α", "β"), ("Inc", "φ", "ψ"), ("Inc", "Azi", "φ")],
)  # fmt: skip
def test_greek_letters_of_angles_in_minutes_are_told_by_the_readings(tmp_path, names):
    """Any letter may stand for any angle; other columns of such codes are not angles."""
    columns, exact = table(), {}
    for name, angle in zip(names, ("Inc (deg)", "Azi (deg)", "TF (deg)"), strict=True):
        columns[name], exact[angle] = in_minutes(columns.pop(angle))
    columns["γ"] = [f"{1 + k // 8}-{1 + k % 8:02d}" for k in range(48)]
    run = read(written(tmp_path / "a.csv", columns))
    for name, angle in (("inclination", "Inc (deg)"), ("azimuth", "Azi (deg)"), ("toolface", "TF (deg)")):  # fmt: skip
        assert np.degrees(run.reference(name)) == pytest.approx(exact[angle], abs=1e-9)


@pytest.mark.parametrize("name", ["τ", "No", "Date of θ", "θx"])
def test_other_cells_of_that_form_stay_what_they_are(tmp_path, name):
    cells, _ = in_minutes(table()["Inc (deg)"])
    proposal = library.propose_profile(written(tmp_path / "a.csv", table(**{name: cells})))
    assert f"'{name} (°)'" not in findings_of(proposal).get("unused-columns", "")


OTHERS_BESIDE = (
    (("Field at observatory 50210 nT", "Field here 50123 nT"), "ref_field_nt", 50123, 50210),
    (("Field today 50123 nT", "Field last year 50010 nT"), "ref_field_nt", 50123, 50010),
    (("Calibrated at: Xian", "Field Beijing 54800 nT", "Field Xian 50123 nT"), "ref_field_nt", 50123, 54800),
    (("Field (IGRF) 50210 nT", "Field measured at stand 50123 nT"), "ref_field_nt", 50123, 50210),
    (("Dip here 66.12 deg", "Dip of customer 58.9 deg"), "ref_dip_deg", 66.12, 58.9),
    (("Field here 50123 nT", "H 20300 nT", "Z 45800 nT"), "ref_field_nt", 50123, None),
    (("Field here 50123 nT", "Field uncertainty 50 nT", "Field limits 49000 nT"), "ref_field_nt", 50123, None),
    (("Field here 50.123 uT", "Mag sensitivity 50000 nT/V"), "ref_field_nt", 50123, None),
)  # fmt: skip


@pytest.mark.parametrize(("lines", "column", "value", "other"), OTHERS_BESIDE)
def test_of_two_references_the_one_that_is_not_taken_is_named(
    tmp_path, lines, column, value, other
):
    """By its value; not what is no other reference of the same quantity."""
    columns = table(ref_field_nt=None, ref_dip_deg=None, ref_gravity_g=None)
    path = written(tmp_path / "a.csv", columns, *lines)
    texts = [
        f.text for f in library.propose_profile(path).findings if f.id == "reference-not-taken"
    ]
    named = [text for text in texts if text.startswith(f"{column}: {value} is taken")]
    assert len(named) == (other is not None)
    assert all(f"and not {other} of the line" in text for text in named)
    known = read(path).reference(column.split("_")[1])
    known = np.degrees(known) if "dip" in column else known
    assert known == pytest.approx(np.full(48, value))


@pytest.mark.parametrize("name", ["Dew point (C)", "Probe heat SD (C)", "Set point (C)"])
def test_another_thing_in_degrees_celsius_is_no_temperature_of_the_tool(tmp_path, name):
    columns = {(name if n == "Temp (C)" else n): v for n, v in table().items()}
    proposal = library.propose_profile(written(tmp_path / "a.csv", columns))
    assert "temperature_c" not in proposal.profile.columns
    assert "temperature-by-unit" not in findings_of(proposal)


def test_a_number_that_stands_for_no_reading_is_left_out_among_readings_of_its_size(tmp_path):
    columns = table()
    columns["Hy (V)"] = np.round(np.asarray(columns["Hy (V)"]) * 20_000, 1)
    columns["Hx (V)"], columns["Hz (V)"] = (
        np.asarray(columns[n]) * 20_000 for n in ("Hx (V)", "Hz (V)")
    )
    columns["Hy (V)"][5] = 9999.99
    path = written(tmp_path / "a.csv", columns)
    assert "line 7 ('Hy (V)': 9999.99)" in findings_of(library.propose_profile(path))["marked-rows"]
    assert read(path).count == 47


@pytest.mark.parametrize("indices", ["XYZ", "123", "012"])
def test_a_table_of_words_that_no_one_knows_is_told_by_the_readings(tmp_path, indices):
    """Triads by their spheres, angles by what they explain; the temperature stays unknown, and is named."""
    words = {
        "Inc (deg)": "Kallistus", "Azi (deg)": "Suunta", "TF (deg)": "Kierto", "Temp (C)": "Lampo",
        "Gx (V)": f"Voima {indices[0]}", "Gy (V)": f"Voima {indices[1]}", "Gz (V)": f"Voima {indices[2]}",
        "Hx (V)": f"Rauta {indices[0]}", "Hy (V)": f"Rauta {indices[1]}", "Hz (V)": f"Rauta {indices[2]}",
    }  # fmt: skip
    columns = {words.get(n, n): v for n, v in mixed(table()).items()}
    path = written(tmp_path / "a.csv", columns)
    proposal = library.propose_profile(path)
    assert "told-by-readings" in findings_of(proposal)
    assert "Lampo" in findings_of(proposal)["unused-columns"]
    run, names = library.read_run(path, proposal.profile), proposal.profile.columns
    assert [names[c].name for c in ("ax", "ay", "az")] == [words[f"G{i} (V)"] for i in "xyz"]
    assert [names[c].name for c in ("mx", "my", "mz")] == [words[f"H{i} (V)"] for i in "xyz"]
    for angle, name in (
        ("inclination", "Kallistus"),
        ("azimuth", "Suunta"),
        ("toolface", "Kierto"),
    ):
        assert np.degrees(run.reference(angle)) == pytest.approx(np.asarray(columns[name]))


def test_abbreviations_with_points_are_read(tmp_path):
    columns = {("T.F. (°)" if n == "TF (deg)" else n): v for n, v in table().items()}
    assert reference(written(tmp_path / "a.csv", columns)) == pytest.approx(
        np.asarray(servo_run()["ref_toolface_deg"])
    )


@pytest.mark.parametrize(
    ("row", "stated"),
    [
        (["Total field: 56", "870 nT"], {"ref_field_nt": 56870.0}),
        (["Total field", "56", "870.5", "nT"], {"ref_field_nt": 56870.5}),
        (["Field: 56", "9 µT"], {"ref_field_nt": 56900.0}),
        (["Gravity: 1", "0006 g"], {"ref_gravity_g": 1.0006}),
        (["Dip: 70", "5 deg"], {"ref_dip_deg": 70.5}),
        (["Declination: 1", "5 W"], {"declination_deg": -1.5}),
        (["Declination (W): 3.5"], {"declination_deg": -3.5}),
        (["Declination: 3° 30' W"], {"declination_deg": -3.5}),
        (["Convergence 1° 12' West"], {"convergence_deg": -1.2}),
        (["Declination 2010: 3.5, 2026: 1.9 W"], {}),
        (["Total field at site: 56870 +/- 45 nT"], {"ref_field_nt": 56870.0}),
    ],
)
def test_title_lines_whose_numbers_commas_split_and_turns_to_the_west(row, stated):
    assert stated_above([row]).metadata == stated


@pytest.mark.parametrize(
    "line",
    ["Horizontal field 18980 nT", "Hz: 53000 nT", "Expected field 48,000-58,000 nT", "Gravity: 0.9986 kg",
     "Gravity correction: 0.9986 g"],
)  # fmt: skip
def test_components_ranges_and_corrections_are_no_references(line):
    assert stated_above([[line]]).metadata == {}


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("Type", ("CAL", "VER")), ("Status", ("OK", "CHECK")), ("Art", ("", "Prüfung")),
        ("Mode", ("CAL", "ROLLTEST")), ("Test", ("CAL", "ROLL")),
        ("Вид", ("калибровка", "контроль (вращение)")), ("用途", ("标定", "滚转检验")),
        ("Formål", ("kal", "rulletest")),
    ],
)  # fmt: skip
def test_rows_that_check_a_calibration_are_no_part_of_it_and_are_named(tmp_path, name, words):
    columns = {name: [words[k >= 42] for k in range(48)], **table()}
    path = written(tmp_path / "a.csv", columns)
    proposal = library.propose_profile(path)
    assert f"'{name}': {words[1]}" in findings_of(proposal)["marked-rows"]
    assert library.read_run(path, proposal.profile).count == 42
    assert read(path, keep={name: [words[1]]}).count == 48


def test_codes_of_check_rows_by_a_legend(tmp_path):
    columns = {"Art": ["KR"[k >= 42] for k in range(48)], **table()}
    line = "# Art: K = Kalibrierlage, R = Rolltest (Kontrolle)"
    assert read(written(tmp_path / "a.csv", columns, line)).count == 42
    assert read(written(tmp_path / "b.csv", columns)).count == 48


def test_rows_below_a_line_that_calls_them_check_shots_are_no_part_of_the_run(tmp_path):
    path = written(tmp_path / "a.csv", table())
    lines = path.read_text().splitlines()
    line = '"Check shots - for verification only, not to be used in the calibration"'
    path.write_text("\n".join([*lines[:43], line, *lines[43:]]))
    assert read(path).count == 42
    assert "Check shots" in mwdcal("profile", path, "-o", tmp_path / "t.toml").out


def test_a_rejected_row_is_left_out_beside_check_rows(tmp_path):
    status = ["void" if k == 5 else "CHECK" if k >= 42 else "OK" for k in range(48)]
    path = written(tmp_path / "a.csv", {"Status": status, **table()})
    assert read(path).count == 41


@pytest.mark.parametrize(
    "line", ["Total field: 56,870 nT", "# Btotal: 56,870 nT, Dip: 74.6 deg", "F = 56,870.0 gamma"]
)
def test_a_number_that_a_comma_table_cuts_at_its_thousands_is_one(line):
    assert stated_above([[c.strip() for c in line.split(",")]]).metadata["ref_field_nt"] == 56_870


@pytest.mark.parametrize("comment", [True, False])
def test_a_line_above_says_what_the_channels_of_a_logger_are(tmp_path, comment):
    channels = ("Gx (V)", "Gy (V)", "Gz (V)", "Hx (V)", "Hy (V)", "Hz (V)", "Temp (C)")
    ours = {name: f"CH{k}" for k, name in enumerate(channels, 1)}
    columns = {ours.get(n, n): v for n, v in table().items()}
    line = "CH1=Gx CH2=Gy CH3=Gz (V); CH4=Hx; CH5=Hy; CH6=Hz, V; CH7 = temperature of probe, degC"
    path = written(tmp_path / "a.csv", columns, f"# {line}" if comment else f'"{line}"')
    proposal = library.propose_profile(path)
    names = proposal.profile.columns
    assert [names[c].name for c in ("ax", "mz", "temperature_c")] == ["CH1", "CH6", "CH7"]
    assert [names[c].unit for c in ("ax", "mx")] == ["V", "V"]


def test_sheets_of_one_temperature_each_are_one_run_with_the_temperature_above_them(tmp_path):
    columns = servo_run(temperatures=(25.0, 85.0), toolfaces=4)
    celsius = np.asarray(columns["temperature_c"])
    names = [n for n in columns if n not in ("temperature_c", "group")]
    book = Workbook()
    book.remove(book.active)
    for warmth in (25, 85):
        sheet = book.create_sheet(f"+{warmth} °C")
        sheet.append(["Temperature, °C", warmth])
        sheet.append(names)
        for row in np.flatnonzero(np.abs(celsius - warmth) < 10).tolist():
            sheet.append([float(columns[n][row]) for n in names])
    book.save(tmp_path / "a.xlsx")
    assert {*read(tmp_path / "a.xlsx").temperature} == {25.0, 85.0}


def test_an_angle_that_was_set_beside_one_that_was_measured_is_asked_about(tmp_path):
    """The stand or the tool may have measured it: nothing but the laboratory knows."""
    columns = {("Set " + n if n == "Inc (deg)" else n): v for n, v in table().items()}
    columns["Measured Inc (deg)"] = [x + 0.1 for x in columns["Set Inc (deg)"]]
    path = written(tmp_path / "a.csv", columns)
    stated = refused(mwdcal("profile", path, "-o", tmp_path / "t.toml"), 3)
    assert "Set Inc (deg)" in stated
    assert "Measured Inc (deg)" in stated
    answer = ("--column", "ref_inclination_deg=Measured Inc (deg)")
    assert mwdcal("profile", path, "-o", tmp_path / "t.toml", *answer).code == 0


def test_angles_that_the_stand_shows_count_beside_those_it_was_set_to(tmp_path):
    """In whatever words: the ends of their names are alike."""
    shown = {"Inc (deg)": "Avlest på bukk (Ink)", "Azi (deg)": "Ist-Asi", "TF (deg)": "Ist Rull"}
    asked = ("Innstilt (Ink)", "Soll-Asi", "Soll Rull")
    run = table()
    columns = {n: np.round(run[o], -1) for n, o in zip(asked, shown, strict=True)}
    columns |= {shown.get(n, n): v for n, v in run.items()}
    used = library.propose_profile(written(tmp_path / "a.csv", columns)).profile.columns
    assert [used[f"ref_{n}_deg"].name for n in ("inclination", "azimuth", "toolface")] == [
        *shown.values()
    ]


def test_strengths_of_the_place_in_columns_of_other_names(tmp_path):
    """One value throughout, in a unit of gravity; and the field beside the totals that a program computed."""
    run = table()
    raw = [np.asarray(run[f"H{n} (V)"]) for n in "xyz"]
    proton = np.asarray(run["Btotal (nT)"]) / 1000 + 0.001 * np.arange(48)
    columns = {n: v for n, v in run.items() if n not in ("Local G (g)", "Btotal (nT)")}
    columns |= {"g, м/с²": [9.8054] * 48, "Proton total field (µT)": proton}
    columns |= {"B total (nT)": 5e4 * np.linalg.norm(raw, axis=0)}
    proposal = library.propose_profile(written(tmp_path / "a.csv", columns))
    used = proposal.profile.columns
    assert used["ref_gravity_g"].name == "g, м/с²"
    assert used["ref_field_nt"].name == "Proton total field (µT)"
    gravity = library.read_run(tmp_path / "a.csv", proposal.profile).reference("gravity")
    assert gravity == pytest.approx(9.8054 / 9.80665, rel=1e-12)


def test_residuals_of_an_older_calibration_are_no_channels(tmp_path):
    run = table()
    noise = np.random.default_rng(1).normal(size=(6, 48))
    old = [f"Restfehler alte Kal., {t} {n}" for t in ("Beschl.", "Magn.") for n in "XYZ"]
    units = dict.fromkeys(old[:3], " (mg)") | dict.fromkeys(old[3:], " (nT)")
    names = {"G": "Rohwerte Beschleunigungsmesser", "H": "Rohwerte Magnetometer"}
    raw = {n: f"{names[n[0]]} {n[1].upper()} (V)" for n in run if n[0] in names}
    columns = {n + units[n]: v for n, v in zip(old, noise, strict=True)}
    columns |= {raw.get(n, n): v for n, v in run.items()}
    used = library.propose_profile(written(tmp_path / "a.csv", columns)).profile.columns
    assert [used[c].name for c in ("ax", "mz")] == [raw["Gx (V)"], raw["Hz (V)"]]


def test_names_one_blank_apart_above_columns_more_blanks_apart(tmp_path):
    run = {n: v for n, v in servo_run().items() if n not in ("station", "group")}
    rows = [[f"  {v:14.6f}" for v in row] for row in zip(*run.values(), strict=True)]
    names = [n.replace("ref_", "") for n in run]
    head = f"{' '.join(names[:4])}  {' '.join(names[4:])}"
    path = tmp_path / "a.txt"
    path.write_text("\n".join(["Laboratory of the university", "", head, *map("".join, rows)]))
    plain = read(written(tmp_path / "b.csv", dict(zip(names, np.transpose(rows), strict=True))))
    np.testing.assert_array_equal(read(path).accelerometer, plain.accelerometer)


@pytest.mark.parametrize(
    "line", ["Felt hos kunde, Hammerfest: 53800 nT", "Field at customer 53800 nT", "Campo do cliente 53800 nT"]
)  # fmt: skip
def test_references_of_another_place_do_not_count(line):
    field = stated_above([[line], ["Field here in the lab 50550 nT"]]).metadata
    assert field == {"ref_field_nt": 50_550.0}


def test_angles_called_a_survey_are_the_stands_where_they_are_whole_and_asked_about_else(tmp_path):
    """A tool measures no whole degrees at all stations; what it measures fits its readings whatever the stand shows."""
    names = {"Inc (deg)": "Survey Inc", "Azi (deg)": "Survey Azi", "TF (deg)": "Survey TF"}
    columns = {names.get(n, n): np.round(v) if n in names else v for n, v in table().items()}
    path = written(tmp_path / "a.csv", columns)
    assert library.propose_profile(path).profile.columns["ref_azimuth_deg"].name == "Survey Azi"
    measured = {n: v + 0.013 * np.arange(48) * (n in names.values()) for n, v in columns.items()}
    with pytest.raises(
        FitError, match=r"the tool has measured 'Survey Inc'.*ref_inclination_deg=' or"
    ):
        library.propose_profile(written(tmp_path / "b.csv", measured))


def test_channels_named_by_axis_and_triad_in_two_blocks_of_the_same_stations(tmp_path):
    run = table()
    names = {
        f"{t}{n} (V)": f"{n.upper()}{m} (V)" for t, m in (("G", "A"), ("H", "M")) for n in "xyz"
    }
    angles = {n: v for n, v in run.items() if n in ("Pos", "Inc (deg)", "Azi (deg)", "TF (deg)")}
    blocks = [
        written(tmp_path / f"{t}.csv", angles | {names[n]: run[n] for n in names if n[0] == t})
        for t in "GH"
    ]
    path = tmp_path / "a.csv"
    path.write_text("\n\n".join(f"{p.stem} sensors\n{p.read_text()}" for p in blocks))
    used = library.propose_profile(path).profile.columns
    assert [used[c].name for c in ("ax", "mz")] == ["XA (V)", "ZM (V)"]


def test_a_row_with_a_remark_counts_where_its_readings_fit_and_is_left_out_where_it_alone_does_not(
    tmp_path,
):
    note = ["forklift moved, waited" if k == 20 else "" for k in range(48)]
    path = written(tmp_path / "a.csv", table(Note=note))
    proposal = library.propose_profile(path)
    assert library.read_run(path, proposal.profile).count == 48
    assert "'Note' says 'forklift moved, waited'" in findings_of(proposal)["marked-rows"]
    note[30] = "table knocked, went on"
    proposal = library.propose_profile(written(tmp_path / "two.csv", table(Note=note)))
    told = findings_of(proposal)["marked-rows"]
    assert (
        "'Note' says 'forklift moved, waited'; line 32: 'Note' says 'table knocked, went on'"
        in told
    )
    left_out = read(path, leave_out={"Note": [note[20]]})
    assert left_out.count == 47
    run = table(Note=note)
    run["Hx (V)"] = np.array(run["Hx (V)"])
    run["Hx (V)"][20] += 0.3
    assert read(written(tmp_path / "b.csv", run)).count == 46
    run["Hx (V)"][25] += 0.3
    with pytest.raises(FitError, match="keep='Note=forklift moved, waited'"):
        library.propose_profile(written(tmp_path / "c.csv", run))


@pytest.mark.parametrize(
    ("lines", "stated"),
    [
        (["Tyngde i Stavanger (brukssted) 9,81873 m/s²", "Tyngde i Trondheim (lab, målt) 9,82152 m/s²"],
         {"ref_gravity_g": 9.82152 / 9.80665}),
        (["Field at stand, 2016 survey 48655 nT", "Field at stand, today (Overhauser) 48890 nT"],
         {"ref_field_nt": 48_890}),
        (["Calibrated at: Midland TX", "Gravity Houston (office) 9.7930 m/s2", "Gravity Midland 9.7914 m/s2"],
         {"ref_gravity_g": 9.7914 / 9.80665}),
        (["Ref field 57.480 uT", "spec: Gtot 9.81 +/-0.03, Btot 57.5 +/-0.3"], {"ref_field_nt": 57_480}),
    ],
)  # fmt: skip
def test_of_two_references_the_one_of_here_and_today_holds(lines, stated):
    found = stated_above([[line] for line in lines]).metadata
    assert {k: v for k, v in found.items() if k.startswith("ref_")} == pytest.approx(
        stated, rel=1e-9
    )


def test_blocks_below_the_names_of_the_triads_are_one_table(tmp_path):
    """Accelerometers, then magnetometers at the same points, both called X, Y and Z."""
    run = table()
    angles = {n: v for n, v in run.items() if n[0] not in "GHT" or n == "TF (deg)"}
    text = ["Tool shop"]
    for title, triad in (
        ("BLOCK 1 - ACCELEROMETERS (V)", "G"),
        ("BLOCK 2 - MAGNETOMETERS (V), same points", "H"),
    ):
        block = angles | {n.upper(): run[f"{triad}{n} (V)"] for n in "xyz"}
        text += [f'"{title}"', written(tmp_path / "b.csv", block).read_text()]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(text))
    one, whole = read(path), read(written(tmp_path / "c.csv", table(temperature_c=None)))
    np.testing.assert_array_equal(one.accelerometer, whole.accelerometer)
    np.testing.assert_array_equal(one.magnetometer, whole.magnetometer)


@pytest.mark.parametrize(
    ("name", "column"),
    [("Toolface, a/cw (deg)", "ref_toolface_deg"), ("Зенит расч., град", None),
     ("Stand setting T/F (deg)", "ref_toolface_deg"), ("Cara hta.", "ref_toolface_deg"), ("IncCalc", None),
     ("K1 AccX/V", "ax"), ("TFH", "ref_toolface_deg"), ("Verdr. (°)", "ref_toolface_deg"),
     ("Peil.", "ref_azimuth_deg"), ("Rot.", None), ("Pos.", None),
     ("Inc mesa (º)", "ref_inclination_deg"), ("Roll (Teilkopf) °", "ref_toolface_deg"),
     ("Bohrlochrichtung", "ref_azimuth_deg"), ("Boreh.inkl. (°)", "ref_inclination_deg"),
     ("Inc'n", "ref_inclination_deg"), ("Az'th", "ref_azimuth_deg"), ("Дип, °", "ref_dip_deg"),
     ("Termopar", "temperature_c"), ("Inc (desired) deg", None), ("Roll (previous) °", None)],
)  # fmt: skip
def test_more_names_of_angles(name, column):
    alike = meaning(name)
    assert (alike.column if alike else None) == column


def test_letters_that_tell_the_readings_of_a_station_are_no_groups(tmp_path):
    """Station 1 A, 1 B, 2 A, 2 B: the means are the stations, without groups."""
    run = table()
    twice = {n: np.repeat(v, 2) for n, v in run.items()}
    twice["Gx (V)"] = twice["Gx (V)"] + 1e-4 * np.tile([-1, 1], 48)
    path = written(tmp_path / "a.csv", {"серия": [*"AB"] * 48, **twice})
    one, whole = read(path), read(written(tmp_path / "b.csv", run))
    assert one.count == 48
    assert one.group is None or len({*one.group}) == len({*(whole.group or [0])})
    np.testing.assert_allclose(one.accelerometer, whole.accelerometer, rtol=0, atol=1e-9)


def test_names_between_single_blanks_behind_the_mark_of_a_comment(tmp_path):
    """Day and time are two columns, by the names above them."""
    run = {n: v for n, v in table().items() if n[0] not in "DBL"}
    head = "# Datum Zeit " + " ".join(n.replace(" (", "[").replace(")", "]") for n in run)
    rows = [
        f"2023-03-08 08:{k:02d}:00   " + "  ".join(f"{v:12.6f}" for v in row)
        for k, row in enumerate(zip(*run.values(), strict=True))
    ]
    path = tmp_path / "a.dat"
    path.write_text("\n".join(["# g = 9.8070 m/s2", head, *rows]))
    one = read(path)
    assert one.count == 48
    assert one.reference("gravity") == pytest.approx(9.807 / 9.80665)


def test_a_supply_of_some_volts_is_no_reference(tmp_path):
    run = table(**{"Vref": [5.001] * 24 + [5.002] * 24, "Btotal (nT)": None, "Local G (g)": None})
    run = {n: v for n, v in run.items() if n not in ("Btotal (nT)", "Local G (g)")}
    used = library.propose_profile(written(tmp_path / "a.csv", run)).profile.columns
    assert not {"ref_field_nt", "ref_gravity_g"} & {*used}


def test_az_is_the_azimuth_beside_an_acceleration_called_so(tmp_path):
    names = {"Azi (deg)": "az", "Gx (V)": "ax", "Gy (V)": "ay", "Gz (V)": "az_acel"}
    columns = {names.get(n, n): v for n, v in table().items()}
    used = library.propose_profile(written(tmp_path / "a.csv", columns)).profile.columns
    assert [used[c].name for c in ("az", "ref_azimuth_deg")] == ["az_acel", "az"]


def test_a_field_in_amperes_per_metre_at_the_stand(tmp_path):
    field = np.asarray(servo_run()["ref_field_nt"]) / (400 * np.pi)
    run = {n: v for n, v in table().items() if n != "Btotal (nT)"} | {"Поле на стенде, А/м": field}
    proposal = library.propose_profile(written(tmp_path / "a.csv", run))
    assert proposal.profile.columns["ref_field_nt"].name == "Поле на стенде, А/м"
    stated = library.read_run(tmp_path / "a.csv", proposal.profile).reference("field")
    assert stated == pytest.approx(servo_run()["ref_field_nt"], rel=1e-9)


def test_az_is_the_azimuth_where_residuals_stand_between_the_channels(tmp_path):
    run = {("Az." if n == "Azi (deg)" else n): v for n, v in table().items()}
    columns = {}
    for name, values in run.items():
        if name[0] in "GH":
            columns[f"res. {name}"] = np.random.default_rng(1).normal(size=48)
        columns[name] = values
    used = library.propose_profile(written(tmp_path / "a.csv", columns)).profile.columns
    assert [used[c].name for c in ("az", "ref_azimuth_deg")] == ["Gz (V)", "Az."]


def test_set_and_shown_angles_of_a_logger(tmp_path):
    run = table()
    names = {"Inc (deg)": "inc", "Azi (deg)": "azi", "TF (deg)": "tf"}
    columns = {f"{names[n]}_set": np.round(run[n], -1) for n in names}
    columns |= {(f"{names[n]}_act" if n in names else n): v for n, v in run.items()}
    used = library.propose_profile(written(tmp_path / "a.csv", columns)).profile.columns
    assert [used[f"ref_{n}_deg"].name for n in ("inclination", "azimuth", "toolface")] == [
        "inc_act",
        "azi_act",
        "tf_act",
    ]


def test_temperatures_that_many_stations_lack_are_asked_about(tmp_path):
    warm = ["" if k % 3 else 25.0 for k in range(48)]
    path = written(tmp_path / "a.csv", table(temperature_c=warm))
    with pytest.raises(FitError, match="at 32 of 48 stations.*column='temperature_c='"):
        library.propose_profile(path)
    run = read(path, column={"temperature_c": ""})
    assert (run.count, run.temperature) == (48, None)


def test_units_of_which_the_first_column_has_none_stand_below_their_names(tmp_path):
    names = ("inc", "mag az", "toolface", "Gx", "Gy", "Gz", "Hx", "Hy", "Hz", "probe temp")
    units = (*["deg"] * 3, *"ggg", *["gauss"] * 3, "deg F")
    lines = [
        "sta " + "".join(f"{n:>13}" for n in names),
        "    " + "".join(f"{u:>13}" for u in units),
    ]
    run = servo_run()
    scales = {"ax": 1 / 3, "ay": 1 / 3, "az": 1 / 3}
    kept = (*ANGLES, *RAW)
    for k in range(48):
        values = "".join(f"{run[n][k] * scales.get(n, 1):13.4f}" for n in kept)
        lines.append(f"{k + 1:<4d}{values}{75.0 + k / 100:13.1f}")
    path = tmp_path / "a.txt"
    path.write_text("\n".join(["Survey tools, Casper", "", *lines]))
    used = library.propose_profile(path).profile.columns
    assert [used[n].unit for n in ("ref_toolface_deg", "az", "mx", "temperature_c")] == [
        "°",
        "g",
        "gauss",
        "°F",
    ]


def test_the_dip_is_what_is_called_so_beside_inclinations_of_blocks():
    rows = [
        ["Lokal B (nT)", 51100, "Dip (°)", 72.7],
        ["Serie 1: inklinasjon 30,0°"],
        ["Serie 2: inklinasjon 75,0°"],
    ]
    assert stated_above(rows).metadata["ref_dip_deg"] == 72.7


def test_names_of_a_field_and_a_toolface_that_look_like_channels(tmp_path):
    """ВУ is not By: it is in degrees."""
    names = {"TF (deg)": "ВУ, °", "Btotal (nT)": "F_nT", "Dip (deg)": "Накл. эт., °"}
    columns = {names.get(n, n): v for n, v in table().items()}
    columns |= {f"B{n} (V)": columns.pop(f"H{n} (V)") for n in "xyz"}
    used = library.propose_profile(written(tmp_path / "a.csv", columns)).profile.columns
    assert [used[f"ref_{n}"].name for n in ("toolface_deg", "field_nt", "dip_deg")] == [
        *names.values()
    ]


def test_a_declination_to_the_west_by_its_whole_word():
    rows = [["Declinación magnética", "1.25° W"], ["Acimut geográfico (norte verdadero)"]]
    assert titles(rows).metadata["declination_deg"] == -1.25


def test_a_declination_at_a_place():
    rows = [["Pier azimuths from TRUE north. Mag declination at pier 8.62 deg E (May 2024)"]]
    assert titles(rows).metadata == {"declination_deg": 8.62, "azimuth_reference": "true"}


@pytest.mark.parametrize("absent", [(), ("Azi (deg)",)])
def test_an_inclination_that_is_exchanged_with_the_toolface_is_named(tmp_path, absent):
    """Its range refuses it, and the readings fit with both exchanged."""
    run = table(**dict.fromkeys(absent))
    right = library.propose_profile(write_csv(tmp_path / "right.csv", run)).findings
    run["Inc (deg)"], run["TF (deg)"] = run["TF (deg)"], run["Inc (deg)"]
    path = write_csv(tmp_path / "a.csv", run)
    message = refused(mwdcal("profile", path, "-o", tmp_path / "tool.toml"), 3)
    assert "got 210 °" in message
    assert "The readings fit with 'Inc (deg)' and 'TF (deg)' exchanged." in message
    said = ["ref_inclination_deg=TF (deg)", "ref_toolface_deg=Inc (deg)"]
    assert f'--column "{said[0]}" --column "{said[1]}"' in message
    assert library.propose_profile(path, column=said).findings == right


def test_an_angle_out_of_range_is_not_called_exchanged_where_the_readings_deny_it(tmp_path):
    run = table()
    run["Inc (deg)"] = 2.5 * run["Inc (deg)"]
    message = refused(
        mwdcal("profile", write_csv(tmp_path / "a.csv", run), "-o", tmp_path / "t"), 2
    )
    assert "exchanged" not in message


@pytest.mark.parametrize(
    ("row", "serial"),
    [
        (["Alat: MWD-22"], "MWD-22"), (["Alat", "MWD-22"], "MWD-22"), (["Nomor Seri: 1234"], "1234"),
        (["No. Alat:", "77-A"], "77-A"), (["Alet: 4471"], "4471"), (["Cihaz: T-2209"], "T-2209"),
        (["Cihaz No", "4471"], "4471"), (["Seri Numarası: A-17"], "A-17"),
        (["Alat ukur: 12"], None), (["Cihaz sıcaklığı: 25"], None), (["Referans cihaz: X-9"], None),
        (["Kalibrasyon cihazı: K-12"], None), (["Sonda de referencia: Q-5"], None), (["Referenzgerät: Q-5"], None),
    ],
)  # fmt: skip
def test_the_serial_stands_behind_the_word_for_the_tool_in_indonesian_and_turkish(row, serial):
    assert titles([row]).metadata.get("serial") == serial


LOW_SIDES = (
    "Rullvinkel: 0 når merket peker NED (lavside)", "Toolface zero = low side", "TF 0 with the scribe down",
    "Rollwinkel ab Tiefseite gezählt", "Toolface: cero con la marca hacia abajo", "Toolface: lado baixo = 0",
    "Toolface 0: repère en bas", "High side = 180, toolface zero at low side", "Toolface high side = 180, low side = 0",
    "Угол установки отклонителя: 0, когда метка внизу", "工具面角：从低边算起",
)  # fmt: skip


@pytest.mark.parametrize("line", LOW_SIDES)
@pytest.mark.parametrize("turned", [False, True])
def test_a_toolface_that_counts_from_the_low_side_by_a_line(tmp_path, line, turned):
    """A toolface at the low side is 180°, whichever way the angle counts."""
    face = servo_run()["ref_toolface_deg"]
    cells = (180 - face if turned else face + 180) % 360
    above = [line, "Toolface counts anticlockwise"] if turned else [line]
    path = written(tmp_path / "a.csv", table(ref_toolface_deg=cells), *above, delimiter=";")
    assert np.cos(read(path).reference("toolface") - np.radians(face)) == pytest.approx(1)


@pytest.mark.parametrize(
    "line",
    [
        "Toolface 0 at high side, 180 at low side", "Roll 0 = ritslijn boven", "TF from high side",
        "Toolface counted from high side clockwise towards low side", "Toolface zero at high side (not low side)",
        "Rollwinkel von Oberseite über rechts zur Unterseite",
        "Low side of the stand repaired 2023", "Toolface 180 = mark down",
    ],
)  # fmt: skip
def test_a_toolface_that_counts_from_the_high_side(tmp_path, line):
    path = written(tmp_path / "a.csv", table(), line, delimiter=";")
    turns = read(path).reference("toolface") - np.radians(servo_run()["ref_toolface_deg"])
    assert np.cos(turns) == pytest.approx(1)


def test_a_dutch_toolface_counts_anticlockwise_by_its_name():
    assert meaning("rol linksom [gr]").unit == "° anticlockwise"


@pytest.mark.parametrize(
    "doubt", ["Azi (T/M?) (deg)", "Declination 1.2 W (applied to stand azimuth? - confirm)"]
)
def test_a_north_with_a_question_mark_is_asked_about(tmp_path, doubt):
    columns, above = table(), []
    if doubt.startswith("Azi"):
        columns = {doubt if name == "Azi (deg)" else name: v for name, v in columns.items()}
    else:
        above = [doubt]
    path = written(tmp_path / "a.csv", columns, *above)
    with pytest.raises(FitError, match="which north .* counts from"):
        library.propose_profile(path)
    assert read(path, north="magnetic").count == 48


@pytest.mark.parametrize("line", ["Azimut magn?tico", "Declination 1.2? E"])
def test_a_question_mark_for_a_letter_that_was_lost_asks_nothing(tmp_path, line):
    assert read(written(tmp_path / "a.csv", table(), line)).count == 48


def test_a_dip_behind_a_field_is_no_second_field():
    stated = stated_above([["Feldstärke / Inklination:", "48,61 µT / 64,6°"]])
    assert stated.metadata == pytest.approx({"ref_field_nt": 48610.0, "ref_dip_deg": 64.6})
    assert not stated.choices


@pytest.mark.parametrize(
    ("row", "dip"),
    [
        (["Câmp total 48420 nT, înclinarea câmpului 64,1°"], 64.1), (["Góc từ khuynh", "+2.4°"], 2.4),
        (["복각(도)", 53.3], 53.3),
    ],
)  # fmt: skip
def test_the_dip_in_romanian_vietnamese_and_korean(row, dip):
    assert references_in([row])["ref_dip_deg"] == pytest.approx(dip)


def test_a_russian_declination_in_degrees_by_its_name():
    row = ["Магнитное склонение, град", "+15,3 (восточное)"]
    assert titles([row]).metadata["declination_deg"] == 15.3
