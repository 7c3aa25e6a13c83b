"""Logs whose columns are in files: what comes of them is what comes of columns in memory."""

from __future__ import annotations

import numpy as np
import pytest

from cli_support import EXAMPLE
from cli_support import mwdcal as cli
from mwdcal.files import logs


@pytest.mark.parametrize(
    "command",
    [
        ("noise", EXAMPLE / "static.csv", "--json"),
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
