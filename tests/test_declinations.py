"""Declinations above a table: unit and sense behind the word, and lines that are not understood."""

from __future__ import annotations

import pytest

from mwdcal.files.formats.title_references import stated_above
from mwdcal.files.formats.titles import titles


@pytest.mark.parametrize(
    ("words", "number", "degrees"),
    [
        ("Declination [deg]", "2.40", 2.4),
        ("Declination [degrees]", "2.40", 2.4),
        ("Declination deg", "2.40", 2.4),
        ("Declination, deg", "-2.40", -2.4),
        ("Magnetic declination [deg]", "2.40", 2.4),
        ("Declination E [deg]", "2.40", 2.4),
        ("Declination E [deg]", "-2.40", -2.4),
        ("Declination W [deg]", "2.40", -2.4),
        ("Declination [deg W]", "2.40", -2.4),
        ("Declination west (deg)", "2.40", -2.4),
        ("Declination (east positive) [deg]", "-2.40", -2.4),
        ("Declination [deg, W positive]", "2.40", -2.4),
        ("Declination (west pier) [deg]", "2.40", 2.4),
        ("Misvisning [grader]", "2,4", 2.4),
        ("Deklination [Grad]", "2,4 O", 2.4),
        ("Misvisning", "2,35 V", -2.35),
        ("Misvisning", "2,35° V", -2.35),
        ("Misvisning (V)", "2,35", -2.35),
        ("Misvisning", "2,35 grader vest", -2.35),
        ("Misvisning", "2,35 mot vest", -2.35),
        ("Misvisning", "2,35 Ø", 2.35),
        ("Missvisning", "2,35 O", 2.35),
        ("Deklination", "2,35° V", -2.35),
        ("Déclinaison", "2,35 O", -2.35),
        ("Declinación", "2,35 O", -2.35),
        ("Declinação", "2,35 L", 2.35),
        ("Deklinace", "2,35 Z", -2.35),
        ("Deklinácia", "2,35 Z", -2.35),
        ("Deklinacija", "2,35 zahod", -2.35),
        ("Склонение", "2,35 З", -2.35),
        ("Склонение", "2,35 В", 2.35),
        ("磁偏角", "2.35° 西", -2.35),
        ("Declination", "2.35 F 50612 nT", 2.35),
        ("Declination", "1.2 W 2025", -1.2),
        ("Declination", "4.2° W, 51234 nT", -4.2),
        ("Declination", "4.2 W (2025)", -4.2),
        ("Declination", "4.2 deg. W 0.1/yr", -4.2),
        ("Declination", "-4.2 (W +)", 4.2),
        ("Manyetik sapma", "2.35 B 2025", -2.35),
    ],
)
def test_a_declination_is_read_behind_its_unit_and_sense(
    words: str, number: str, degrees: float
) -> None:
    assert titles([[words, number]]).metadata["declination_deg"] == pytest.approx(degrees)


@pytest.mark.parametrize(
    "line",
    [
        "Declination [deg] 240",
        "Declination [rad] 0.04",
        "Declination (min) 144",
        "Declination σ 0.1",
        "Declination 2.35 O",
        "Declination 2.35 V",
        "Declination 2.35 V 2025",
        "Deklinácia 5 V",
        "Deklinacija 4.2 V",
        "Deklinacja 2,35 W",
        "Misvisning 2,35 N",
    ],
)
def test_a_declination_that_is_not_understood_is_listed(line: str) -> None:
    """Nothing is read of it as degrees."""
    block = stated_above([[line]])
    assert "declination_deg" not in block.metadata
    assert block.not_taken == {"declination_deg": line}


@pytest.mark.parametrize(
    ("row", "day"),
    [
        (["Dato", 46350], "2026-11-24"),
        (["Date", "45658"], "2025-01-01"),
        (["Datum:", 43890], "2020-02-29"),
        (["Date", 20261], None),
        (["Order", 46350], None),
        (["Field (nT)", "Nominal", 50500, "Measured", 50000], None),
        (["Data", 46350], None),
        (["Logged: 46350"], None),
        (["Measured", "12.03.2026"], "2026-03-12"),
    ],
)
def test_a_number_beside_a_word_for_the_date_is_the_day_that_a_workbook_stores(row, day) -> None:
    """Days of LibreOffice Calc: =DATE(2026;11;24) as a number is 46350."""
    assert titles([row]).metadata.get("date") == day


def test_a_day_beside_its_label_comes_before_a_number() -> None:
    for row in (["Field (nT)", "Nominal", 50500, "Measured", 50000], ["Datum", 50000]):
        rows = [row, ["Date of calibration", "2026-03-12"]]
        assert titles(rows).metadata["date"] == "2026-03-12"
