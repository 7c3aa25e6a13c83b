"""What a fleet says of itself: options, choices, errors of the stand, noise that nobody declared."""

import json

import numpy as np
import pytest

from cli_support import EXAMPLE, mwdcal
from test_fleet import short_run, write_fleet
from test_fleet_findings import said
from test_fleet_options import bent, drifting

pq = pytest.importorskip("pyarrow.parquet")

from mwdcal.app.pages import fleet_report  # noqa: E402
from mwdcal.files.formats import table as tables  # noqa: E402
from mwdcal.use import plots  # noqa: E402


def test_table_screen_page_and_summary_name_the_options(tmp_path):
    runs = {f"T{i}": short_run(i) for i in range(2)}
    options = ("--robust", "huber", "--parameters", 9, "--ignore", "dip", "--nonlinearity", "none")
    ran, page = said(tmp_path, runs, *options)
    line = "options: 9 parameters, without dip, robust (huber)"
    assert line in ran.out.splitlines()
    assert "9 parameters; without dip; robust (huber)" in page
    made = tables.read(tmp_path / "o.parquet").metadata["options"]
    ran, _ = said(tmp_path, runs, *options, "--json")
    assert ran.json["options"] == made
    alone = tmp_path / "alone.json"
    of_one = ("calibrate", EXAMPLE / "run.csv", "--tool", EXAMPLE / "tool.toml", *options, "-o")
    assert mwdcal(*of_one, alone).code == 0
    expected = json.loads(alone.read_bytes())
    assert {name: made[name] for name in expected["options"]} == expected["options"]
    assert (made["method"], made["order"], made["nonlinearity"]) == ("joint", 0, "none")
    ran, page = said(tmp_path, runs)
    assert "options:" not in ran.out
    assert "<dt>options</dt><dd>defaults</dd>" in page


def test_errors_of_the_stand_are_on_screen_and_page(tmp_path):
    runs = {f"T{i}": short_run(i) for i in range(5)}
    ran, page = said(tmp_path, runs, "--estimate", "azimuth-zero,tilt")
    for name in ("azimuth zero", "azimuth zero uncertainty", "tilt", "tilt azimuth"):
        assert f"stand: {name}, °" in ran.out
        assert f'<td class="text">{name}</td>' in page
    zeros = [row["azimuth_zero_deg"] for row in pq.read_table(tmp_path / "o.parquet").to_pylist()]
    assert f"{np.median(zeros):.2g}".replace("-", "−")[:3] in page


def test_tools_that_took_own_axis_terms_are_counted(tmp_path):
    runs = {"T0": short_run(0), "bent": bent(8, 0.004)}
    path = write_fleet(tmp_path / "runs.parquet", runs)
    given = ("--tool", EXAMPLE / "tool.toml", "--workers", 1, "--nonlinearity", "accelerometer")
    ran = mwdcal("fleet", path, "-o", tmp_path / "o.parquet", *given)
    assert "own-axis terms in 2 tools: accelerometer" in ran.out
    ran = mwdcal("fleet", path, "-o", tmp_path / "o.parquet", *given, "--json")
    assert ran.json["nonlinear"] == {"accelerometer": 2}


def test_a_tool_without_a_magnetometer_has_model_and_order(tmp_path):
    bare = drifting(4, 2) | dict.fromkeys(("mx", "my", "mz"), np.full(96, np.nan))
    _, page = said(tmp_path, {"whole": drifting(2, 2), "bare": bare}, "--order", "auto")
    whole, bare = pq.read_table(tmp_path / "o.parquet").to_pylist()
    assert (bare["status"], bare["magnetometer_order"]) == ("ok", None)
    assert bare["order"] == bare["accelerometer_order"] == 2
    assert bare["model"] == whole["model"] == "factors"
    assert "Chosen orders" in page


@pytest.mark.parametrize(("tool", "declared"), [("servo", True), ("generic", False)])
def test_estimated_noise_is_shown_where_residuals_cannot_be_judged(
    tmp_path, monkeypatch, tool, declared
):
    drawn = []

    def quality(panels):
        drawn.extend(panels)
        return plots.new_figure("", 1.0)[0]

    monkeypatch.setattr(fleet_report, "draw_quality", quality)
    _, page = said(tmp_path, {f"T{i}": short_run(i) for i in range(4)}, "--tool", tool)
    triads = [] if declared else ["accelerometer", "magnetometer"]
    assert tables.read(tmp_path / "o.parquet").metadata["noise_estimated"] == triads
    assert ("No tool has residuals more" in page) == declared
    assert ("accelerometer and magnetometer is not declared" in page) == (not declared)
    made = pq.read_table(tmp_path / "o.parquet")
    if declared:
        assert set(drawn[0][2]) == {"accelerometer s", "magnetometer s"}
        return
    shown = {name: values for _, _, series in drawn[:2] for name, values in series.items()}
    for triad, factor in zip(triads, (1e3, 1.0), strict=True):
        expected = made.column(f"{triad}_noise").to_numpy() * factor
        np.testing.assert_allclose(shown[triad], expected)
