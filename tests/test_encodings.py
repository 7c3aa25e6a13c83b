"""Texts that do not state their encoding: title blocks and rows of names in the languages of laboratories."""

import numpy as np
import pytest

import mwdcal as library
from cli_support import servo_run, write_csv
from mwdcal.files.formats.encodings import encoding_of

WESTERN = ("cp1252", "cp850", "mac-roman", "utf-16", "utf-16-le", "utf-16-be")
CYRILLIC = ("cp1251", "koi8-r", "cp866", "iso8859-5", "utf-16-le", "utf-16-be")
TEXTS = {
    "Calibration sheet – tool 0042\nDip;67.1°;total field;49.2 µT\nInc (°);Az (°);TF (°);Temp (°C)": (
        "cp1252", "utf-16-le",
    ),
    "Inc (°);Azi (°);TF (°);Gx (g);Gy (g);Gz (g);Temp (°C)": WESTERN,
    "Prüfprotokoll Richtungssonde;Nr. 14-08\nTotalintensität;49.720 nT\nStellung;Neigung °;Temp °C": WESTERN,
    "Nr;Neigung;Azimut;Hochseite;Kanäle;Höhe": WESTERN,
    "PRÜFPROTOKOLL;GERÄT;NEIGUNG °": WESTERN,
    "Calibración herramienta 3318 - Poza Rica\nB total;429,80;mG;echado mag.;49,2;grados\n"
    "Estación;Inclinación °;Azimut magnético °;Temp °C;Condición\n14;PERTURBADO - pasó montacargas": WESTERN,
    "Punto;Inclinación;Azimut;Cara;Ax;Ay": WESTERN,
    "Procès-verbal d'étalonnage\nOpérateur;Lefèvre\nN° de série;0042\nà vérifier;Température (°C)": WESTERN,
    "Numéro;Inclinaison;Azimut;Face outil;Accéléromètre X;Température": WESTERN,
    "Relatório de calibração;Ferramenta 00412;Macaé - RJ\nInclinação (graus);Temperatura (°C)": WESTERN,
    "Ponto;Inclinação;Azimute;Rotação;Ax;Ay": WESTERN,
    "Verktøy:\tSN 3309-B\nReferanse:\tB = 51,240 µT\tdip = 74,1°\nInkl (grader)\tT_verktøy (°C)": WESTERN,
    "Måling;Helning;Asimut;Høyside;Akselerometer X;Temperatur": WESTERN,
    "Świadectwo wzorcowania narzędzia\nPole całkowite;49 800 nT\nKąt odchylenia [°];Azymut [°]": ("cp1250",),
    "Lp.;Nachylenie [°];Czułość;Próbka;Ciśnienie;Ax": ("cp1250",),
    "Přístroj;Poznámka;Natočení;měřeno;Sklon;Azimut": ("cp1250",),
    "Sorszám;Irány;Hőmérséklet (°C)": ("cp1250",),
    "Kalibrasyon raporu\nEğim (°);Azimut (°);Takım yüzü (°);Sıcaklık (°C)": ("cp1254",),
    "# регистратор ИНКЛ-2, файл 0071.DAT\n# прибор N 2207, 03.10.2016\n"
    "# поле 52790 нТл, наклонение 71.1 град, g 9.8154 м/с2\nвремя;зен;азм;апс;КодAx;КодAy;КодAz;Тпр,C": CYRILLIC,
    "зен;азм;апс;акс;маг;тпр": CYRILLIC,
    "стол;крен;курс;тангаж;Gx;Gy": CYRILLIC,
    "ПОКАЗАНИЯ ДАТЧИКОВ;СТЕНД;КРЕН;КУРС": CYRILLIC,
    "Прилад;Кут нахилу;Азимут;Прискорення": ("cp1251", "iso8859-5"),
    "探管号,TG-0552\n地磁场强度(nT),52210\n井斜(°),方位(°),工具面(°),加速度X,温度": ("gb18030",),
    "序号,井斜,方位,工具面,重力X,磁场X": ("gb18030",),
    "傾斜角[deg],方位角[deg],ツールフェース[deg],加速度X[V]": ("cp932",),
}  # fmt: skip


@pytest.mark.parametrize(
    ("text", "encoding"), [(text, e) for text, encodings in TEXTS.items() for e in encodings]
)
def test_a_text_is_read_in_the_encoding_that_it_was_written_in(text, encoding):
    lines = text + "\n1;2;3;4" * 20
    assert lines.encode(encoding).decode(encoding_of(lines.encode(encoding))) == lines


@pytest.mark.parametrize(
    "text", ["Nr;Neigung °;Übersicht;Größe", "Estación;Inclinación °;Condición", "m²;Temp °C"]
)
def test_letters_that_the_first_encoding_of_dos_has_are_read_as_its_successor(text):
    data = text.encode("cp437")
    assert data.decode(encoding_of(data)) == text


@pytest.mark.parametrize(
    ("encoding", "above", "names"),
    [
        (
            "koi8-r",
            "# поле {field} нТл, наклонение {dip} град, g {gravity} м/с2",
            ("зен", "азм", "апс", "КодA{}", "КодM{}", "Темп,C"),
        ),
        (
            "cp850",
            "B total;{milligauss};mG;echado mag.;{dip};grados;g local;{gravity};m/s²",
            ("Inclinación °", "Azimut magnético °", "Toolface °", "G{} g", "B{} mG", "Temp °C"),
        ),
        (
            "cp949",
            "전자기장 {field} nT, 복각 {dip}도, 중력 {gravity} m/s2",
            ("경사각(도)", "방위각(도)", "툴페이스(도)", "가속도{}(V)", "자기{}(V)", "온도(°C)"),
        ),
        (
            "utf-16-le",
            "Field {field} nT, dip {dip}°, g {gravity} m/s²",
            ("Inc °", "Azi °", "TF °", "G{} (V)", "H{} (V)", "Temp °C"),
        ),
    ],
)
def test_a_title_block_of_any_encoding_states_the_place(tmp_path, encoding, above, names):
    run, columns = servo_run(), {}
    angles = ("ref_inclination_deg", "ref_azimuth_deg", "ref_toolface_deg")
    columns |= {name: run[angle] for name, angle in zip(names, angles, strict=False)}
    for name, triad in zip(names[3:], "am", strict=False):
        columns |= {name.format(axis): run[f"{triad}{axis}"] for axis in "xyz"}
    columns[names[-1]] = run["temperature_c"]
    field, dip, gravity = (run[f"ref_{n}"][0] for n in ("field_nt", "dip_deg", "gravity_g"))
    stated = above.format(field=field, milligauss=field / 100, dip=dip, gravity=9.80665 * gravity)
    path = write_csv(tmp_path / "run.csv", columns, delimiter=";")
    path.write_bytes(f"{stated}\n{path.read_text('utf-8')}".encode(encoding))
    read = library.read_run(path, library.propose_profile(path).profile)
    assert read.temperature == pytest.approx(run["temperature_c"])
    assert read.reference("field") == pytest.approx(field)
    assert np.degrees(read.reference("dip")) == pytest.approx(dip)
    assert read.reference("gravity") == pytest.approx(gravity)
