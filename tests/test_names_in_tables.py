"""Names of columns in other words, the sense of angles, and lines that say what columns are."""

import numpy as np
import pytest

import mwdcal as library
from cli_support import servo_run, write_csv
from mwdcal.files.formats import table as tables
from mwdcal.identification.columns import is_of_tool, meaning, meanings_of
from test_headers import taken
from test_tables_as_they_come import table, written

CHANNELS = ("ax", "ay", "az", "mx", "my", "mz")
INCLINATIONS = (
    *(
        "Eğim açısı",
        "Zenit açısı",
        "Kuyu eğimi",
        "Düşeyden açı",
        "Kąt zenitalny",
        "Sudut kemiringan",
    ),
    *(
        "Sudut dari vertikal",
        "Angolo di inclinazione",
        "Angolo zenitale",
        "Inclinatiehoek",
        "Hellingshoek",
    ),
    *(
        "Unghi de înclinare",
        "Úhel sklonu",
        "Inklinace",
        "Zenitový úhel",
        "Көлбеу бұрышы",
        "Inklin.",
    ),
)
AZIMUTHS = (
    *(
        "Azimut açısı",
        "Semt açısı",
        "Yön",
        "Kąt azymutu",
        "Azimut magnetik",
        "Sudut azimut",
        "Arah",
    ),
    *(
        "Angolo di azimut",
        "Direzione",
        "Acim. mag.",
        "Azimuthoek",
        "Magnetische richting",
        "Unghi de azimut",
    ),
    *("Azimut magnetický", "Směr", "Azimuth Mag. North", "Hole Direction", "Магниттік азимут"),
)
TOOLFACES = (
    *("Toolface açısı", "Takım açısı", "Alet yüzü", "Yuvarlanma açısı", "Dönme açısı", "TF açısı"),
    *(
        "Kąt toolface",
        "Kąt skręcenia",
        "Kąt TF",
        "Sudut muka alat",
        "Sudut putar",
        "Angolo di rollio",
    ),
    *("Rotazione", "Angle de toolface", "Orient. outil", "Face da ferr.", "Ângulo toolface"),
    *(
        "Cara herram.",
        "Cara de herram.",
        "Cara htta.",
        "Orient. herram.",
        "Toolface-hoek",
        "Rolhoek",
    ),
    *("Rotatiehoek", "Fața sculei", "Unghi de ruliu", "Úhel natočení", "Čelo nástroje"),
    *("Бұрылу бұрышы", "Ауытқытқыш бұрышы", "Grav. TF", "Roll Ang."),
)
"""Headings of laboratories in Turkish, Polish, Indonesian, Italian, French, Portuguese, Spanish, Dutch, Romanian,
Czech, Kazakh and the English of the Gulf."""


def numbers(path, column):
    """A column of the run that the proposed profile makes of a table."""
    return tables.numbers(taken(path), column)


@pytest.mark.parametrize(
    ("name", "column", "unit"),
    [
        ("INC desejada (graus)", "ref_inclination_deg", "°"),
        ("TF deseado", "ref_toolface_deg", ""),
        ("AZM gewünscht", "ref_azimuth_deg", ""),
        ("fixture_gtf_deg", "ref_toolface_deg", "°"),
        ("Sollwerte Drehtisch Zenitwinkel (°)", "ref_inclination_deg", "°"),
        ("Sollwerte Drehtisch Rolllage (°)", "ref_toolface_deg", "°"),
        ("Drehtisch (°)", "ref_azimuth_deg", "°"),
        ("stativ_verktøyside_grader", "ref_toolface_deg", "°"),
        ("Stativ vinkel fra lodd (grader)", "ref_inclination_deg", "°"),
        ("Stativ rulling (grader)", "ref_toolface_deg", "°"),
        ("Winkel vom Lot", "ref_inclination_deg", ""),
        ("inclinaison du banc (deg)", "ref_inclination_deg", "°"),
        ("Odch. (°)", "ref_inclination_deg", "°"),
        ("鉛直からの角度(deg)", "ref_inclination_deg", "°"),
        ("磁北からの角度(deg)", "ref_azimuth_deg", "°"),
        ("stol_inkl", "ref_inclination_deg", ""),
        ("stol_azym", "ref_azimuth_deg", ""),
        ("stol_obrót", "ref_toolface_deg", ""),
        ("面角/°", "ref_toolface_deg", "°"),
        ("Задано УВО", "ref_toolface_deg", ""),
        ("Richtung (mgn.) °", "ref_azimuth_deg", "°"),
        ("重力计输出 X轴 (mV)", "ax", "mV"),
        ("磁力计输出 X轴 (mV)", "mx", "mV"),
        ("Gravity sensors Gx / g", "ax", "g"),
        ("Field sensors Fx / gamma", "mx", "nT"),
        ("Gravitasjon GravX, m/s2", "ax", "m/s²"),
        ("Magnetfelt MagnX, nT", "mx", "nT"),
        ("accelerometres x (V)", "ax", "V"),
        ("Magn. eje X [G]", "mx", "gauss"),
        ("fluks_x_mV", "mx", "mV"),
        ("Vmx", "mx", ""),
        ("Gx lido (g)", "ax", "g"),
        ("Hx gelesen (nT)", "mx", "nT"),
        ("Gx målt (mg)", "ax", "mg"),
        ("Ts(C)", "temperature_c", "°C"),
        ("Giro (toolface) graus", "ref_toolface_deg", "°"),
        *((f"{n} (°)", "ref_inclination_deg", "°") for n in INCLINATIONS),
        *((f"{n} (°)", "ref_azimuth_deg", "°") for n in AZIMUTHS),
        *((f"{n} (°)", "ref_toolface_deg", "°") for n in TOOLFACES),
        ("İvme ölçer X (V)", "ax", "V"),
        ("Versnellingsmeter X (V)", "ax", "V"),
        ("Aksel. X (V)", "ax", "V"),
        ("Үдеу X (V)", "ax", "V"),
        ("Indukcja X (V)", "mx", "V"),
        ("Magnetisch veld X (V)", "mx", "V"),
        ("Câmp magnetic X (V)", "mx", "V"),
        ("Магнит өрісі X (V)", "mx", "V"),
        ("Azimute (mag) graus", "ref_azimuth_deg", "°"),
        ("Inclinação (dev) graus", "ref_inclination_deg", "°"),
        ("maz_deg", "ref_azimuth_deg", "°"),
        ("maz/deg", "ref_azimuth_deg", "°"),
        ("mag az", "ref_azimuth_deg", ""),
        ("Orient. cara alta", "ref_toolface_deg", ""),
        ("Áng. de cara °", "ref_toolface_deg", "°"),
        ("Fall (°)", "ref_dip_deg", "°"),
        ("Gravity (ft/s²)", "ref_gravity_g", "ft/s²"),
        ("Serienr.", "serial", ""),
        ("Зав. №", "serial", ""),
        ("N/S", "serial", ""),
        ("GX axial (g)", "ax", "g"),
        ("HX axial (nT)", "mx", "nT"),
    ],
)
def test_stands_and_channels_in_other_words(name, column, unit):
    assert meaning(name) == (column, unit)


@pytest.mark.parametrize(
    "name", ["Betrag H nT", "合磁场/nT", "Somme B (nT)", "Sum F (gamma)", "合重力 (g)"]
)
def test_a_sum_is_computed_and_no_reference(name):
    assert meaning(name) is None
    assert is_of_tool(name)


@pytest.mark.parametrize("name", ["Odch. std. (°)", "odchylenie standardowe (°)"])
def test_a_standard_deviation_is_no_inclination(name):
    assert meaning(name) is None


def test_the_french_word_for_a_time_is_no_temperature():
    assert (meaning("temps (s)"), meaning("temps (°C)").column) == (None, "temperature_c")


@pytest.mark.parametrize(
    "sense",
    [
        "sens anti-horaire",
        "sens trigonométrique",
        "sentido antihorario",
        "anti-horário",
        "gegen den Uhrzeigersinn",
        "mot klokka",
        "против часовой стрелки",
        "逆时针",
        "przeciwnie do ruchu wskazówek zegara",
    ],
)
def test_a_toolface_that_counts_anticlockwise_in_other_languages(tmp_path, sense):
    """In brackets behind its name, and in a line above."""
    toolface = np.asarray(table()["TF (deg)"])
    named = table(ref_toolface_deg=None) | {f"Roll ({sense})": -toolface % 360}
    above = table(ref_toolface_deg=-toolface % 360)
    for path in (
        written(tmp_path / "named.csv", named),
        written(tmp_path / "above.csv", above, f"Toolface: {sense}"),
    ):
        found = numbers(path, "ref_toolface_deg")
        assert np.allclose(np.cos(np.radians(found - toolface)), 1)


def test_a_name_that_says_an_angle_where_no_other_column_is_it(tmp_path):
    run = table()
    run = {{"Inc (deg)": "DESVIO (°)", "TF (deg)": "Face (°)"}.get(n, n): v for n, v in run.items()}
    found = library.propose_profile(written(tmp_path / "run.csv", run)).profile.columns
    assert found["ref_inclination_deg"].name == "DESVIO (°)"
    assert found["ref_toolface_deg"].name == "Face (°)"
    beside = {**table(), "Desvio (°)": run["DESVIO (°)"]}
    found = library.propose_profile(written(tmp_path / "beside.csv", beside)).profile.columns
    assert found["ref_inclination_deg"].name == "Inc (deg)"


def test_a_line_says_of_what_an_angle_is(tmp_path):
    """Mergulho is the dip, unless it is the axis that dips; theta and phi mean nothing alone."""
    run = table(ref_dip_deg=None)
    run = {"Mergulho (graus)" if n == "Inc (deg)" else n: v for n, v in run.items()}
    down = {**run, "Mergulho (graus)": 90 - np.asarray(run["Mergulho (graus)"])}
    line = "Mergulho = ângulo do eixo abaixo da horizontal (negativo: para cima)"
    found = numbers(written(tmp_path / "down.csv", down, line), "ref_inclination_deg")
    assert np.allclose(found, run["Mergulho (graus)"])
    names = {"Inc (deg)": "theta(deg)", "Azi (deg)": "phi_mag(deg)"}
    names |= {f"{old} (V)": f"V{new}{n}(V)" for old, new, n in zip(
        ("Gx", "Gy", "Gz", "Hx", "Hy", "Hz"), "aaabbb", (1, 2, 3) * 2, strict=True)}  # fmt: skip
    greek = {names.get(n, n): v for n, v in table().items()}
    path = written(tmp_path / "greek.csv", greek, "theta: tool axis from vertical; 1=x 2=y 3=z")
    columns = library.propose_profile(path).profile.columns
    assert {c: columns[c].name for c in ("ref_inclination_deg", "ref_azimuth_deg", "ay", "mz")} == {
        "ref_inclination_deg": "theta(deg)",
        "ref_azimuth_deg": "phi_mag(deg)",
        "ay": "Va2(V)",
        "mz": "Vb3(V)",
    }


def test_a_line_says_which_axis_a_number_is():
    names = ["acc1 (g)", "acc2 (g)", "acc3 (g)"]
    assert [m.column for m in meanings_of(names, [""] * 3, ["1 = Z, 2 = X, 3 = Y"]).values()] == [
        "az",
        "ax",
        "ay",
    ]


def test_seconds_as_a_quote_in_a_row_of_units(tmp_path):
    """A cell that is nothing but a quote is no quote."""
    run = table()
    angles = {}
    for angle, name in (("Desv", "Inc (deg)"), ("Az", "Azi (deg)")):
        values = np.asarray(run.pop(name), float)
        angles |= {
            f"{angle}_G": np.floor(values),
            f"{angle}_M": 0 * values,
            f"{angle}_S": 0 * values,
        }
    units = ["°", "'", '"'] * 2 + ["" for _ in run]
    path = tmp_path / "run.tsv"
    write_csv(path, {**angles, **run}, delimiter="\t")
    names, *rows = path.read_text("utf-8").splitlines()
    path.write_text("\n".join([names, "\t".join(units), *rows]), "utf-8")
    assert np.allclose(numbers(path, "ref_inclination_deg"), angles["Desv_G"])
    assert np.allclose(numbers(path, "ref_azimuth_deg"), angles["Az_G"])


@pytest.mark.parametrize(
    ("word", "words", "axes", "between"),
    [
        ("colonne", "colonnes", "x, y, z", "-"),
        ("column", "columns", "x, y and z", " to "),
        ("Spalte", "Spalten", "x y z", " bis "),
        ("columna", "columnas", "x, y y z", "-"),
        ("столбец", "столбцы", "x, y, z", "–"),
        ("列", "列", "x/y/z", "-"),
    ],
)
def test_lines_that_say_what_each_column_is(tmp_path, word, words, axes, between):
    """A table without names, below a line for each column or for those of a triad."""
    run = servo_run()
    order = ["time", "ref_inclination_deg", "ref_azimuth_deg", "ref_toolface_deg", *CHANNELS]
    run["time"] = np.arange(len(run["ax"])) * 47.25
    write_csv(tmp_path / "run.txt", {name: run[name] for name in order}, delimiter="\t")
    rows = (tmp_path / "run.txt").read_text("utf-8").splitlines()[1:]
    legend = [
        f"% {word} 1 : temps (s)", f"% {word} 2 : inclination (deg, 0 = vertical)",
        f"% {word} 3 : azimuth (deg)", f"% {word} 4 : toolface (deg)",
        f"% {words} 5{between}7 : accelerometers {axes} (V)", f"% {words} 8{between}10 : fluxgates {axes} (V)",
    ]  # fmt: skip
    (tmp_path / "run.txt").write_text("\n".join(["% tool : F-23", *legend, *rows]), "utf-8")
    whole = taken(tmp_path / "run.txt")
    assert all(np.allclose(tables.numbers(whole, name), run[name]) for name in order[1:])


def test_a_unit_behind_a_title_is_that_of_its_columns(tmp_path):
    """A unit behind a number is that of the number, in a line above the names."""
    run = {n: v for n, v in table().items() if n not in ("Local G (g)", "Btotal (nT)")}
    rename = {f"{c} (V)": f"{c[1].upper()}轴" for c in ("Gx", "Gy", "Gz")}
    names = [rename.get(n, f"{n[1].upper()}轴" if n[0] == "H" else n) for n in run]
    titles = [
        "重力计输出 mV" if n == "Gx (V)" else "磁力计输出 mV" if n == "Hx (V)" else "" for n in run
    ]
    stated = ["Campo: 44.900 nT", "Gravedad: 9,7998 m/s2", "Fecha: 27/06/2024"]
    path = tmp_path / "run.csv"
    write_csv(path, run)
    rows = path.read_text("utf-8").splitlines()[1:]
    path.write_text(
        "\n".join([";".join(stated), ",".join(titles), ",".join(names), *rows]), "utf-8"
    )
    columns = library.propose_profile(path).profile.columns
    assert (columns["ay"].name, columns["mz"].name) == ("重力计输出 Y轴 mV", "磁力计输出 Z轴 mV")
    above = written(tmp_path / "above.csv", table(), "Campo: 44.900 nT,Gravedad: 9,7998 m/s2")
    assert library.propose_profile(above).profile.columns["ay"].name == "Gy (V)"
