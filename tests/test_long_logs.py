"""Logs whose columns are in files: what comes of them is what comes of columns in memory."""

from __future__ import annotations

import numpy as np
import pytest

from cli_support import EXAMPLE
from cli_support import mwdcal as cli
from mwdcal.files import logs
from mwdcal.logs.standstill import StoredCells
from mwdcal.logs.stations import find_stations


@pytest.mark.parametrize(
    "command",
    [
        ("noise", EXAMPLE / "static.csv", "--json", "--quiet"),
        ("stations", EXAMPLE / "log.csv", "-o", "{out}", "--json"),
    ],
)
def test_columns_in_files_give_the_same_results(tmp_path, monkeypatch, command):
    outputs = []
    for least in (logs._LONG_LOG, 1):
        monkeypatch.setattr(logs, "_LONG_LOG", least)
        out = tmp_path / "out.csv"
        ran = cli(*(out if each == "{out}" else each for each in command))
        assert ran.code == 0, ran
        outputs.append((ran.out, ran.err, out.read_bytes() if out.exists() else b""))
    assert outputs[0] == outputs[1]


def test_a_column_in_a_file_is_what_was_added(monkeypatch):
    monkeypatch.setattr(logs, "_LONG_LOG", 1)
    table = logs.read(EXAMPLE / "static.csv")
    assert isinstance(table.columns, logs.StoredColumns)
    lines = (EXAMPLE / "static.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines if not line.startswith("#")]
    for place, name in enumerate(rows[0]):
        expected = [float(row[place]) for row in rows[1:]]
        assert np.asarray(table.columns[name]).tolist() == expected
    assert [*table.columns] == rows[0]
    assert len(table.columns) == len(rows[0])


def test_cells_of_a_long_log_share_their_clock_and_keep_their_levels_in_files(monkeypatch):
    medians = find_stations(logs.read(EXAMPLE / "log.csv")).activity.cells
    monkeypatch.setattr(logs, "_LONG_LOG", 1)
    cells = find_stations(logs.read(EXAMPLE / "log.csv")).activity.cells
    assert isinstance(cells, StoredCells)
    assert [*cells] == [*medians]
    first = cells["ax"]
    for name, stored in cells.items():
        assert stored.start is first.start
        assert stored.end is first.end
        assert stored.level is not cells[name].level
        assert stored.level.tolist() == medians[name].level.tolist()


def test_whether_a_long_log_has_a_column_does_not_read_it(monkeypatch):
    monkeypatch.setattr(logs, "_LONG_LOG", 1)
    columns = logs.read(EXAMPLE / "log.csv").columns
    monkeypatch.setattr(logs.StoredNumbers, "read", None)
    assert "ax" in columns
    assert "temperature_c" not in columns


@pytest.mark.parametrize("cell", ["nan", "INF", '"1"', "1\x00"])
def test_odd_cells_are_seen(tmp_path, cell):
    text = (EXAMPLE / "static.csv").read_text().splitlines()
    cells = text[200].split(",")
    text[200] = ",".join([*cells[:-1], cell])
    path = tmp_path / "log.csv"
    path.write_text("\n".join(text))
    if cell == '"1"':
        assert logs.read(path).columns["mz"][200 - 5] == 1.0
        return
    with pytest.raises(logs.InputError, match="line 201"):
        logs.read(path)


ROWS = {
    "blanks": "0,1,,\n0.1,,2.5,\n0.2,,,3\n",
    "spellings": "0,1e-3,-.5,5.\n0.1,+1,2E2,1e-320\n0.2,123456789.123456789,0.1,-0\n",
    "line-ends": "0,1,2,3\r\n0.1,4,5,6\r\n",
    "no-end": "0,1,2,3\n0.1,4,5,6",
    "blank-lines": "0,1,2,3\n0.1,4,5,6\n\n\n",
    "blanks-around": "0, 1,2 ,3\n0.1,4,5, 6\n",
    "too-few": "0,1,2,3\n0.1,4,5\n",
    "too-many": "0,1,2,3\n0.1,4,5,6,7\n",
    "too-large": "0,1,2,3\n0.1,4,5,1e999\n",
    "two-numbers": "0,1,2,3\n0.1,4,5,6 7\n",
    "letters": "0,1,2,3\n0.1,4,5,6e\n",
    "line-of-blanks": "0,1,2,3\n   \n0.1,4,5,6\n",
    "returns": "0,1,2,3\r0.1,4,5,6\r",
}


@pytest.mark.parametrize("rows", ROWS.values(), ids=ROWS)
@pytest.mark.parametrize("piece", [8, logs._PIECE])
def test_a_long_log_is_read_like_a_short_one(tmp_path, monkeypatch, rows, piece):
    path = tmp_path / "log.csv"
    path.write_bytes(b"time_s,ax,ay,az\n" + rows.encode())
    monkeypatch.setattr(logs, "_PIECE", piece)
    found = []
    for least in (logs._LONG_LOG, 1):
        monkeypatch.setattr(logs, "_LONG_LOG", least)
        try:
            table = logs.read(path)
            columns = {n: np.asarray(column).tobytes() for n, column in table.columns.items()}
            found.append((columns, list(table.lines)))
        except logs.InputError as error:
            found.append(str(error))
    assert found[0] == found[1]


def test_plain_pieces_of_a_long_log_are_read_by_arrow(tmp_path, monkeypatch):
    monkeypatch.setattr(logs, "_LONG_LOG", 1)
    monkeypatch.setattr(logs, "_piece", None)  # the reader of short logs is not called
    assert len(logs.read(EXAMPLE / "static.csv").columns["ax"]) > 1000
