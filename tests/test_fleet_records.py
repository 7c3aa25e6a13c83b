"""Records of a fleet: rows of the batch with the bytes of each tool by itself, written by the workers."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cli_support import EXAMPLE, mwdcal, servo_run
from mwdcal.calibration import calibrate
from mwdcal.calibration.automatic import auto
from mwdcal.calibration.automatic.auto import choose_orders
from mwdcal.calibration.options import Options
from mwdcal.calibration.record import DIGITS, figures, rounded
from mwdcal.calibration.residuals import rms
from mwdcal.estimation.batch import batch_of_one, join
from mwdcal.files.profiles import load_profile
from mwdcal.files.runs import read_run
from test_fleet import many, roll_run, write_fleet
from test_fleet_findings import troubled
from test_fleet_options import bent, drifting

pq = pytest.importorskip("pyarrow.parquet")

from mwdcal import pool  # noqa: E402
from mwdcal.files.formats.members import RECORD  # noqa: E402
from mwdcal.fleet import kept  # noqa: E402

STAND = EXAMPLE / "tool.toml"


def walking(seed):
    """A run whose accelerometer wanders, by more or less."""
    columns = servo_run(seed)
    steps = np.random.default_rng(seed).normal(size=48)
    return {**columns, "ax": columns["ax"] + np.cumsum(steps) * 2e-4 * (seed % 3)}


def without_azimuth(seed):
    """A run of which some stations, or all, have no reference azimuth."""
    columns = servo_run(seed)
    known = np.arange(48) < 24 * (seed % 2)
    return {**columns, "ref_azimuth_deg": np.where(known, columns["ref_azimuth_deg"], np.nan)}


def of_seeds(run, *arguments):
    return {f"tool {seed}": run(seed, *arguments) for seed in range(5)}


FLEETS = {
    "sound": (of_seeds(servo_run), STAND, ()),
    "troubled": (troubled(), "servo", ()),
    "guessed scales": (troubled(), "generic", ()),
    "walking": (of_seeds(walking), "servo", ()),
    "no azimuth": (of_seeds(without_azimuth), STAND, ()),
    "vertical": (of_seeds(servo_run, (0, 45, 90, 180)), STAND, ()),
    "roll sets": (of_seeds(roll_run), "servo", ()),
    "robust": (of_seeds(walking), STAND, ("--robust", "huber")),
    "own axes": (of_seeds(bent, 0.004), "servo", ("--nonlinearity", "auto")),
    "orders": (of_seeds(drifting, 2), "servo", ("--order", "auto")),
}


@pytest.mark.parametrize("name", FLEETS)
def test_a_record_of_a_batch_has_the_bytes_of_a_batch_of_one(tmp_path, monkeypatch, name):
    runs, tool, options = FLEETS[name]
    of, batches = calibrate.Records.of, []

    def both(records, place, choice):
        made = of(records, place, choice)
        if records.fitted.count > 1:
            run = choice.readings, choice.profile
            alone = calibrate.record_of(choice, records.fitted.alone_as(place, run))
            both_ways = [msgspec.structs.replace(each, time="") for each in (made, alone)]
            assert msgspec.json.encode(both_ways[0]) == msgspec.json.encode(both_ways[1])
            assert msgspec.json.encode(rounded(made)) == msgspec.json.encode(made)
            batches.append(records.fitted.count)
        return made

    monkeypatch.setattr(calibrate.Records, "of", both)
    path = write_fleet(tmp_path / "runs.parquet", runs)
    output = tmp_path / "cals.parquet"
    ran = mwdcal("fleet", path, "-o", output, "--tool", tool, "--workers", 1, "--records", *options)
    assert ran.code == 0, ran.err
    assert len(batches) >= 2
    records = pq.read_table(output).column(RECORD).to_pylist()
    assert sum(record is not None for record in records) >= len(batches)


@given(st.lists(st.floats(), min_size=1), st.integers(10**11, 10**12), st.integers(-40, 40))
def test_a_figure_is_the_double_of_its_decimal(values, whole, power):
    halfway = [sign * float(f"{whole}5e{power}") for sign in (1, -1)]
    every = np.array([*values, *halfway, float(f"1e{power}"), -0.0])
    spelled = [float(f"{value:.{DIGITS - 1}e}") for value in every.tolist()]
    assert np.array(figures(every)).tobytes() == np.array(spelled).tobytes()


def test_a_root_mean_square_is_that_of_each_row_by_itself():
    values = np.random.default_rng(1).normal(size=(30, 48))
    values[3:20, 5] = values[7, :] = values[9, 11:] = np.nan
    each = rms(values)
    assert np.isnan(each[7])
    for row, found in zip(np.delete(values, 7, 0), np.delete(each, 7), strict=True):
        assert found == np.sqrt(np.mean(row[~np.isnan(row)] ** 2))


def test_orders_without_a_fit_are_those_of_all_fits(tmp_path, monkeypatch):
    profile, runs = load_profile(STAND)[0], []
    for seed, power in enumerate((0, 1, 2, 3, 3, 2)):
        path = tmp_path / f"{seed}.parquet"
        run = drifting(seed, power, (20.0, 50.0, 80.0, 110.0, 140.0))
        readings, _ = read_run(write_fleet(path, {"one": run}), profile)
        runs.append(replace(batch_of_one(readings), station=(), digest=(), metadata={}, source=""))
    runs = [replace(run, run_sha256="", others={}, table={}, profile=None) for run in runs]
    fits, options = [], Options(order="auto")
    whole = auto.fit

    def counted(readings, *arguments):
        stand = any(name not in readings.triads and sd.any() for name, sd in readings.sd.items())
        fits.append(len(readings.accelerometer) * stand)
        return whole(readings, *arguments)

    monkeypatch.setattr(auto, "fit", counted)
    quick, few = choose_orders(join(runs), options), sum(fits)
    fits.clear()
    monkeypatch.setattr(auto, "_bare_stand", lambda readings, options: None)
    assert choose_orders(join(runs), options).tolist() == quick.tolist()
    assert len({*map(tuple, quick.tolist())}) > 3
    assert few < 0.7 * sum(fits)


@pytest.mark.slow
def test_workers_write_their_own_parts(tmp_path, monkeypatch):
    path, results, parts = many(tmp_path / "runs.parquet", tools=700), pool.results, []
    output, folder = tmp_path / "cals.parquet", tmp_path / "cals.parquet.parts"

    def watched(steps, tasks, workers, scheduler):
        for index, result in results(steps, tasks, workers, scheduler):
            assert result is None
            assert kept.read_part(tasks[index].path) is not None
            assert tasks[index].path.parent == folder
            parts.append(index)
            yield index, result

    monkeypatch.setattr(pool, "results", watched)
    ran = mwdcal("fleet", path, "-o", output, "--tool", "servo", "--workers", 2)
    assert ran.code == 0, ran.err
    assert len(parts) >= 2
    assert not folder.exists()


def test_a_worker_that_does_not_see_the_folder_says_so(tmp_path):
    with pytest.raises(Exception, match="no such folder on this machine"):
        kept.write_part(tmp_path / "elsewhere" / "part.arrow", b"")
