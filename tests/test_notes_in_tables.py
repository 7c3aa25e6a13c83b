"""Notes in a table on which rows, columns and values count, and short forms of hand-written tables."""

import math

import numpy as np
import openpyxl
import pytest

import mwdcal
from mwdcal.files.formats import table as tables
from mwdcal.files.formats.figures import is_figure
from mwdcal.files.formats.title_references import stated_above
from test_arrangements import CHANNELS, NAMES, lines_of, written
from test_headers import same, stations, taken

WARM_UP = [*stations()[0][:3], 0.5, *stations()[0][4:]]
"""A station with a reading that no other has."""


def noted(rows, name, cells):
    """The lines of a table with a column more behind the others."""
    return lines_of([[*row, cell] for row, cell in zip(rows, cells, strict=True)], [*NAMES, name])


@pytest.mark.parametrize(
    "note",
    [
        "warm-up, not to be used",
        "oppvarming, brukes ikke",
        "Aufwärmen – nicht verwenden",
        "calentamiento; no usar",
        "aquecimento (não usar)",
        "прогрев, не использовать",
        "预热，不用",
    ],
)
def test_a_row_that_does_not_count_by_its_note_is_left_out(tmp_path, note):
    rows = stations()
    lines = noted([WARM_UP, *rows], "Remark", [note, *[""] * len(rows)])
    assert same(taken(written(tmp_path / "run.csv", lines)), rows)


@pytest.mark.parametrize("note", ["first shot of 7 not used", "repeat, first one not used"])
def test_a_note_that_may_speak_of_another_row_is_asked_about(tmp_path, note):
    rows = stations()
    lines = noted(rows, "Remark", [note, *[""] * (len(rows) - 1)])
    with pytest.raises(mwdcal.FitError, match="rejected station"):
        mwdcal.propose_profile(written(tmp_path / "run.csv", lines))


def in_motion(tmp_path, *legend):
    """A table in which every second row is marked M, below a legend."""
    rows = stations()
    pairs = [
        each for row in rows for each in (row, [*row[:3], *(c + 0.3 for c in row[3:9]), row[9]])
    ]
    lines = noted(pairs, "State", ["S", "M"] * len(rows))
    return written(tmp_path / "run.csv", [*legend, "", *lines]), rows


@pytest.mark.parametrize(
    "legend",
    [
        ["S = stable", "State M = stand moving, not for calibration"],
        ["M = bad, S = good"],
        ["State: S = good, M = stand moving (reject), D = duplicate line of a retry"],
        ["State: S = good, M = duplicate line of a retry"],
    ],
)
def test_a_legend_says_which_rows_do_not_count(tmp_path, legend):
    path, rows = in_motion(tmp_path, *legend)
    assert same(taken(path), rows)


@pytest.mark.parametrize(
    "legend",
    ["State M = perhaps not for calibration", "M = manual", "M = repeat of rejected, S = good"],
)
def test_another_legend_leaves_the_question(tmp_path, legend):
    path, _ = in_motion(tmp_path, legend)
    with pytest.raises(mwdcal.FitError, match="rejected station"):
        mwdcal.propose_profile(path)


@pytest.mark.parametrize("mark", ['"', "〃", "''", "- '' -", "ditto", "idem", "то же"])
def test_a_ditto_mark_is_the_cell_above(tmp_path, mark):
    rows = stations()
    book = openpyxl.Workbook()
    sheet = book.active
    sheet.append(NAMES)
    for k, row in enumerate(rows):
        above = rows[k - 1] if k else ["", ""]
        sheet.append([*(mark if row[n] == above[n] else row[n] for n in (0, 1)), *row[2:]])
    book.save(tmp_path / "run.xlsx")
    assert same(taken(tmp_path / "run.xlsx"), rows)
    lines = lines_of(map(list, sheet.iter_rows(min_row=2, values_only=True)))
    if mark != '"':  # which quotes in a text
        assert same(taken(written(tmp_path / "run.csv", lines)), rows)


def test_a_line_of_settings_is_no_dip():
    """The inclination beside an azimuth is the stand's; alone it may be the field's, where no line names its dip."""
    above = [["Champ total : 46195 nT", "Inclinaison magnétique (dip) : 59,71°"]]
    settings = [["Inclinaison 10° – Azimut 20°"], ["Inclinaison 50° – Azimut 20°"]]
    metadata = stated_above([*above, settings[0]], settings[1:]).metadata
    assert metadata["ref_dip_deg"] == 59.71
    assert metadata["ref_field_nt"] == 46195
    assert stated_above([*above, ["Inclinaison 10°"]]).metadata["ref_dip_deg"] == 59.71
    assert "ref_dip_deg" in stated_above(settings).not_taken


def test_gravity_in_a_unit_without_signs():
    metadata = stated_above([["#gravity_m_s2=9.7940"]]).metadata
    assert metadata["ref_gravity_g"] == pytest.approx(9.7940 / 9.80665, rel=1e-15)


@pytest.mark.parametrize(
    ("stand", "tool"), [("台架{}", "探管{}"), ("Bench {}", "Probe {}"), ("{} стенда", "{} прибора")]
)
def test_angles_of_the_tool_beside_those_of_the_stand(tmp_path, stand, tool):
    words = {"台": ("井斜(°)", "方位(°)", "工具面(°)")}.get(
        stand[0], ("Inc (deg)", "Azi (deg)", "Toolface (deg)")
    )
    rows = stations()
    names = [*(tool.format(w) for w in words), *(stand.format(w) for w in words), *NAMES[3:]]
    lines = lines_of([[*(a + 0.4 for a in row[:3]), *row] for row in rows], names)
    assert same(taken(written(tmp_path / "run.csv", lines)), rows)


def test_the_spread_of_samples_is_no_uncertainty_of_their_mean(tmp_path):
    rows = stations()
    names = [*NAMES, *(f"{name[:2]} std (V)" for name in CHANNELS)]
    lines = lines_of([[*row, *[0.001] * 6] for row in rows], names)
    of_samples = written(
        tmp_path / "run.csv", ["mean and standard deviation of 200 samples", "", *lines]
    )
    proposal = mwdcal.propose_profile(of_samples)
    assert not [name for name in proposal.profile.columns if name.startswith("sd_")]
    plain = mwdcal.propose_profile(written(tmp_path / "plain.csv", lines))
    assert len([name for name in plain.profile.columns if name.startswith("sd_")]) == 6


@pytest.mark.parametrize(
    "form",
    [
        "20/05/2026 08:31:{0:02d} ",
        "2026-03-11T08:41:{0:02d} ",
        "[08:41:{0:02d}] ",
        "08:41:{0:02d}.25, ",
    ],
)
@pytest.mark.parametrize("suffix", ["txt", "log", "out"])
def test_records_behind_a_time(tmp_path, form, suffix):
    rows = stations()
    names = ("INC", "AZI", "TF", "AX", "AY", "AZ", "BX", "BY", "BZ", "TEMP")
    path = tmp_path / f"run.{suffix}"
    lines = [
        form.format(k % 60) + " ".join(f"{n}={v}" for n, v in zip(names, row, strict=True))
        for k, row in enumerate(rows)
    ]
    path.write_text("\n".join(["; INC AZI TF in deg; AX AY AZ in V; TEMP in C", *lines]), "utf-8")
    assert same(taken(path), rows)


def test_minutes_and_seconds_below_a_few_names(tmp_path):
    """Whole minutes of each angle."""
    rows = [[*(math.floor(a * 60) / 60 for a in row[:3]), *row[3:]] for row in stations()]

    def written_out(angle):
        minutes = round(angle * 60)
        return f"{minutes // 60}°{minutes % 60:02d}'00\""

    book = openpyxl.Workbook()
    sheet = book.active
    sheet.append(["Inclination", "Azimuth", "Toolface", *NAMES[3:]])
    sheet.append(["° ' \""] * 3)
    for row in rows:
        sheet.append([*map(written_out, row[:3]), *row[3:]])
    book.save(tmp_path / "run.xlsx")
    assert same(taken(tmp_path / "run.xlsx"), rows)


@pytest.mark.parametrize("form", ["{} ({})", "{}, {}"])
def test_stations_in_columns_below_long_names(tmp_path, form):
    rows = stations()
    words = [f"{each} {axis}" for each in ("Accéléromètre", "Magnétomètre") for axis in "XYZ"]
    names = [
        *(form.format(word, "°") for word in ("Inclinaison", "Azimut", "Toolface")),
        *(form.format(word, "V") for word in words),
        form.format("Température", "°C"),
    ]
    book = openpyxl.Workbook()
    sheet = book.active
    for name, *values in zip(names, *rows, strict=True):
        sheet.append([name, *values])
    book.save(tmp_path / "run.xlsx")
    assert same(taken(tmp_path / "run.xlsx"), rows)


@pytest.mark.parametrize(
    "name",
    [
        *("Toolface gravité (°)", "Toolface de gravité (°)", "Toolface gravitatorio (°)"),
        *("Tool face de gravedad (°)", "Toolface (grav.) (°)"),
    ],
)
def test_a_toolface_by_gravity_is_no_gravity(tmp_path, name):
    """Its name tells, without a look at the readings."""
    rows = stations()
    path = written(tmp_path / "run.csv", lines_of(rows, [*NAMES[:2], name, *NAMES[3:]]))
    proposal = mwdcal.propose_profile(path)
    assert proposal.profile.columns["ref_toolface_deg"].name == name
    assert "told-by-readings" not in {finding.id for finding in proposal.findings}
    assert same(taken(path), rows)


def test_tools_by_number_one_below_the_other_are_asked_about(tmp_path):
    rows = stations()
    tools = [[tool, k, *row] for tool in (2301, 2302) for k, row in enumerate(rows, 1)]
    path = written(tmp_path / "run.csv", lines_of(tools, ["Sonda", "Station", *NAMES]))
    with pytest.raises(mwdcal.FitError, match="Are these tools"):
        mwdcal.propose_profile(path)
    on = [[2301 + (k > len(rows)), k, *row[2:]] for k, row in enumerate(tools, 1)]
    path = written(tmp_path / "on.csv", lines_of(on[: len(rows)], ["Sonda", "Station", *NAMES]))
    assert taken(path).count == len(rows)


@pytest.mark.parametrize("mark", ["NODATA", "keine Daten", "sin datos", "нет данных"])
def test_a_row_without_data_is_left_out(tmp_path, mark):
    rows = stations()
    empty = [*rows[0][:3], *[-999.25] * 7]
    lines = noted([empty, *rows], "status", [mark, *["OK"] * len(rows)])
    assert same(taken(written(tmp_path / "run.csv", lines)), rows)


@pytest.mark.parametrize("cell", ["-9999", "-999.25", "99999.0", "S/L", "k.A."])
@pytest.mark.parametrize("places", [range(3, 9), range(3, 6), [7], [9]])
def test_a_row_with_a_number_or_a_code_for_no_reading_is_left_out_and_named(tmp_path, cell, places):
    rows = stations()
    lost = [cell if k in places else value for k, value in enumerate(rows[0])]
    path = written(tmp_path / "run.csv", lines_of([lost, *rows], NAMES))
    proposal = mwdcal.propose_profile(path)
    assert same(taken(path), rows)
    assert cell in f"{proposal.summary()} {proposal.findings}"


@pytest.mark.parametrize(
    "note",
    ["bumped, rejected", "støtte borti stativet, forkastet - omtatt under", "mobil i lomma!! forkastet",
     "受干扰，作废", "помеха, брак", "DESCARTAR: pasó un camión", "отбросить"],
)  # fmt: skip
def test_a_row_that_is_rejected_behind_a_reason_is_left_out(tmp_path, note):
    rows = stations()
    lines = noted([WARM_UP, *rows], "Remark", [note, *[""] * len(rows)])
    assert same(taken(written(tmp_path / "run.csv", lines)), rows)


@pytest.mark.parametrize("note", ["gestört, LKW", "PERTURBADO - pasó montacargas", "受干扰"])
def test_a_row_said_to_be_disturbed_is_left_out_where_its_readings_show_it(tmp_path, note):
    rows = stations()
    disturbed = [*rows[0][:3], *(value + 0.05 for value in rows[0][3:6]), *rows[0][6:]]
    notes = [note, *[""] * len(rows)]
    bad = written(tmp_path / "bad.csv", noted([disturbed, *rows], "Remark", notes))
    assert same(taken(bad), rows)
    good = written(tmp_path / "good.csv", noted(rows, "Remark", notes[:-1]))
    with pytest.raises(mwdcal.FitError, match="rejected station"):
        taken(good)


@pytest.mark.parametrize(
    ("line", "kelvin"),
    [
        ("温度为K", True),
        ("All temperatures in K", True),
        ("temperatures in kelvin", True),
        ("", False),
    ],
)
def test_a_line_says_that_temperatures_are_in_kelvin(tmp_path, line, kelvin):
    rows = stations()
    names = [*NAMES[:-1], "温度"]
    lines = lines_of([[*row[:9], row[9] + 273.15] for row in rows], names)
    path = written(tmp_path / "run.csv", [line, "", *lines])
    if kelvin:
        assert same(taken(path), rows)
    else:
        with pytest.raises(mwdcal.FitError, match="°F or K"):
            mwdcal.propose_profile(path)


def test_a_number_with_a_unit_in_cyrillic_letters_is_no_name():
    assert is_figure("53500 нТл")
    assert not is_figure("Поле 53500")


def test_a_constant_inclination_of_the_reference_is_the_dip(tmp_path):
    rows = stations()
    lines = [",".join([*NAMES, "Fref/nT", "Iref/deg"])]
    lines += [",".join(map(str, [*row, 50000, 63.0])) for row in rows]
    run = taken(written(tmp_path / "run.csv", lines))
    assert np.all(tables.numbers(run, "ref_dip_deg") == 63.0)
    assert same(run, rows)


@pytest.mark.parametrize("marks", ["AB", ["front", "rear"]])
def test_readings_of_two_tools_in_turn_are_asked_about(tmp_path, marks):
    """The second tool reads 1 % more, with other offsets; repeats of one tool differ by noise alone."""
    rows = stations()
    other = [[*row[:3], *(1.01 * v + 0.02 for v in row[3:9]), row[9]] for row in rows]
    noise = np.random.default_rng(5).normal(0, 1e-3, (len(rows), 6))
    again = [[*row[:3], *(np.add(row[3:9], e)), row[9]] for row, e in zip(rows, noise, strict=True)]

    def table_of(second):
        pairs = [
            [k, mark, *row]
            for k, both in enumerate(zip(rows, second, strict=True))
            for mark, row in zip(marks, both, strict=True)
        ]
        return written(tmp_path / "run.csv", lines_of(pairs, ["Pos", "Unit", *NAMES]))

    path = table_of(other)
    with pytest.raises(mwdcal.FitError, match="differ by 'Unit'") as caught:
        taken(path)
    assert [answer.name for answer in caught.value.answers][:2] == [*marks]
    assert same(taken(path, leave_out={"Unit": [marks[1]]}), rows)
    assert taken(path, keep={"Unit": [marks[0]]}).count == len(rows)
    assert taken(table_of(again)).count == len(rows)


def test_a_roll_test_above_the_run_is_no_part_of_it(tmp_path):
    rows = stations()
    lines = lines_of(rows, NAMES)
    path = written(
        tmp_path / "run.csv",
        ["一、滚转测试（仅检查，不参加标定）", *lines[:9], "", "二、标定数据", *lines],
    )
    assert same(taken(path), rows)


def test_a_roll_test_to_the_right_of_the_run_is_no_part_of_it(tmp_path):
    rows, names = stations(), [*NAMES]
    blank = [""] * len(names)
    head = [["标定数据(静态)", *blank, "滚转试验(仅供检验,不参与标定)"], [*names, "", *names]]
    both = [[*row, "", *(rows[k] if k < 12 else blank)] for k, row in enumerate(rows)]
    lines = [";".join(map(str, row)) for row in [*head, *both]]
    assert same(taken(written(tmp_path / "run.csv", lines)), rows)


def test_raw_channels_are_taken_beside_those_of_a_previous_calibration(tmp_path):
    rows = stations()
    titles = [
        "",
        "",
        "",
        *["Leitura bruta"] * 6,
        "",
        *["Valor corrigido (calibração anterior)"] * 6,
    ]
    names = [*NAMES, *NAMES[3:9]]
    corrected = [[*row, *(v * 1.01 for v in row[3:9])] for row in rows]
    lines = [";".join(map(str, row)) for row in [titles, names, *corrected]]
    assert same(taken(written(tmp_path / "run.csv", lines)), rows)


@pytest.mark.parametrize(
    "note",
    ["ok - removed clamp", "row before: bad", "shot above - bad", "earlier shot (rejected)", "ok, bad weather",
     "second attempt, discarded first", "fixed (bad cable replaced)", "opened door (removed cap)",
     "checked: no data lost", "stable; bad light outside"],
)  # fmt: skip
def test_a_remark_on_another_row_or_thing_rejects_no_row_by_itself(tmp_path, note):
    rows = stations()
    lines = noted(rows, "Remark", [*[""] * 7, note, *[""] * (len(rows) - 8)])
    path, asked = written(tmp_path / "run.csv", lines), ""
    try:
        run = taken(path)
    except mwdcal.FitError as error:
        asked = str(error)
    assert "rejected station" in asked if asked else same(run, rows)


def test_points_of_the_compass_between_two_are_no_codes_for_no_reading(tmp_path):
    rows = stations()
    cells = [["NE" if k == 0 else row[1], *row[2:]] for k, row in enumerate(rows)]
    lines = lines_of([[row[0], *each] for row, each in zip(rows, cells, strict=True)], NAMES)
    with pytest.raises(mwdcal.FitError, match="'NE'"):
        taken(written(tmp_path / "run.csv", lines))


def test_labels_in_turn_are_of_tools_and_number_no_stations(tmp_path):
    rows = stations()
    other = [[*row[:3], *(1.01 * v + 0.02 for v in row[3:9]), row[9]] for row in rows]
    pairs = [
        [label, *row]
        for both in zip(rows, other, strict=True)
        for label, row in zip(("S1", "S2"), both, strict=True)
    ]
    path = written(tmp_path / "run.csv", lines_of(pairs, ["ID", *NAMES]))
    with pytest.raises(mwdcal.FitError, match="differ by 'ID'"):
        taken(path)
    assert same(taken(path, leave_out={"ID": ["S2"]}), rows)


def test_uncal_channels_are_taken_beside_cal_ones(tmp_path):
    rows = stations()
    names = [*NAMES[:3], *(f"{n.split()[0]} uncal {n.split()[1]}" for n in NAMES[3:9]), NAMES[9]]
    names += [f"{n.split()[0]} cal {n.split()[1]}" for n in NAMES[3:9]]
    corrected = [[*row, *(v * 1.01 for v in row[3:9])] for row in rows]
    assert same(taken(written(tmp_path / "run.csv", lines_of(corrected, names))), rows)


def test_which_of_two_rows_at_one_attitude_counts_is_asked_though_the_readings_fit_one(tmp_path):
    rows = stations()
    bad = [*rows[5][:3], *(v + 0.3 for v in rows[5][3:9]), rows[5][9]]
    both = [[k, *row] for k, row in enumerate([*rows[:5], bad, *rows[5:]])]
    path = written(tmp_path / "run.csv", lines_of(both, ["Pos", *NAMES]))
    with pytest.raises(mwdcal.FitError, match="Which counts"):
        taken(path)
    assert same(taken(path, leave_out={"Pos": ["5"]}), rows)
