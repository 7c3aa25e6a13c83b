"""Every option of `calibrate` in a fleet: choices, figures and refusals as one by one.

All tools and all drift here are simulated.
"""

import re

import numpy as np
import pytest

from cli_support import mwdcal, refused, servo_run
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.results import typical_accuracy
from mwdcal.estimation.batch import take
from mwdcal.files import documents
from mwdcal.fleet.calibrate import column
from simulation import DEG, Tool, plan
from test_fleet import bad_tools, calibrated, roll_run, short_run, write_fleet

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

SOAKS = (20.0, 60.0, 100.0, 140.0)
QUIET = """
name = "declares own-axis terms, and no noise"
reference_temperature_c = 30.0
[accelerometer]
axes = ["+x", "+y", "+z"]
scale = 3.0
nonlinearity = 0.005
[accelerometer.datasheet]
scale = 0.0289
bias = 0.00577
misalignment_deg = 0.0662
[magnetometer]
axes = ["+x", "+y", "+z"]
scale = 5e-5
nonlinearity = 0.005
[stand]
inclination_deg = 0.01
azimuth_deg = 0.05
toolface_deg = 0.02
"""


def both(folder, runs, *options, tool="servo"):
    """Rows of a fleet, and of each tool by itself the calibration or the run that refused it.

    Not the records of the fleet, which are calibrations of each tool by itself once more.
    """
    if tool == "quiet":
        tool = folder / "quiet.toml"
        tool.write_text(QUIET)
    path, output = write_fleet(folder / "runs.parquet", runs), folder / "cals.parquet"
    given = ("--tool", tool, "--workers", 1, "--no-records")
    ran = mwdcal("fleet", path, "-o", output, *given, *options)
    assert ran.code == 0, ran
    rows = {row["serial"]: row for row in pq.read_table(output).to_pylist()}
    table, alone = pq.read_table(path), {}
    for name, default in (("--nonlinearity", "none"), ("--order", 0)):
        options = options if name in options else (*options, name, default)
    for serial in runs:
        one, cal = folder / "one.parquet", folder / f"{serial}.json"
        own = table.filter(pa.array([s == serial for s in table.column("serial").to_pylist()]))
        blank = [n for n in own.column_names if own.column(n).null_count == own.num_rows]
        pq.write_table(own.drop_columns(blank), one)
        ran = mwdcal("calibrate", one, "-o", cal, "--tool", tool, *options)
        alone[serial] = documents.read(cal) if ran.code == 0 else ran
    return rows, alone


def check_all(rows, alone, tolerance=1e-7):
    """Each row says what the tool's calibration file says, or that it was refused as well."""
    assert list(rows) == list(alone)
    for serial, cal in alone.items():
        row = rows[serial]
        if hasattr(cal, "triads"):
            check(row, cal, tolerance)
            continue
        assert (row["status"] == "bad-input") == (cal.code == 2), (row["status"], cal)
        assert row["status"] != "ok"
        assert row["accelerometer_rank"] is None
        if row["status"] not in ("bad-input", "failed"):
            source = f"serial {serial} of runs.parquet"
            message = row["message"].replace(source, "one.parquet")
            for name in re.findall(r"`(\w+)`", message):
                message = message.replace(f"`{name}`", f"--{name.replace('_', '-')}")
            assert message in cal.err


def check(row, cal, tolerance):
    assert row["status"] == "ok", row["message"]
    free = {u.id for triad in cal.triads for u in triad.undetermined}
    assert row["findings"] == list(dict.fromkeys(f.id for f in cal.findings if f.id not in free))
    assert row["reshoot"] == [each.station for each in cal.station_rows if each.reshoot]
    filled = {n for n, v in row.items() if v is not None and n.endswith(("_sd", "radius"))}
    for triad in cal.triads:
        name = triad.name
        assert [row[f"{name}_{fact}"] for fact in ("order", "rank", "size", "undetermined")] == [
            triad.order, triad.rank, triad.size, [u.id for u in triad.undetermined]
        ]  # fmt: skip
        for fact in ("noise", "variance_factor", "degrees_of_freedom"):
            assert row[f"{name}_{fact}"] == pytest.approx(getattr(triad, fact), tolerance)
        for parameter, value, sd in zip(
            triad.parameter_names, triad.parameters, triad.standard_uncertainties, strict=True
        ):
            own = column(name, parameter)
            assert row[own] == pytest.approx(value, 1e-9, tolerance * (sd or 1e-3)), own
            assert row[f"{own}_sd"] == close(sd, tolerance)
            filled.discard(f"{own}_sd")
        if triad.curved:
            ends = [row[f"{name}_{end}"] for end in ("centre_x", "centre_y", "centre_z", "radius")]
            assert ends == pytest.approx([*triad.centre, triad.radius], 1e-9, 1e-9)
            filled.remove(f"{name}_radius")
    assert not filled
    found = {f"{angle}_sd_deg": sd for angle, sd in typical_accuracy(cal).items()} | cal.earth
    found |= {n: getattr(cal.stand, n) for n in cal.stand.__struct_fields__ if n in row}
    for name, value in found.items():
        assert row[name] == close(value, 10 * tolerance), name


def close(value, tolerance):
    return value if value is None else pytest.approx(value, tolerance, 1e-12)


# Temperature orders


def drifting(seed, power=0, soaks=SOAKS):
    """A warm run whose scales and biases, of the magnetometer alone if odd, drift with powers."""
    columns = servo_run(seed, (10, 60, 90, 130), 6, temperatures=soaks)
    warmth = (columns["temperature_c"] - 80) / 60
    for channel in ("ax", "ay", "az", "mx", "my", "mz")[3 * (seed % 2) :]:
        for k in range(1, power + 1):
            columns[channel] = columns[channel] * (1 + 0.003 * warmth**k) + 0.002 * warmth**k
    return columns


SOME = {"T0": (0, 0), "T3": (0, 2), "T4": (2, 2)}
"""Orders of the usual tools that every option meets; the default meets two more."""


def temperatures(odd=0, of=1):
    """Tools that come to have different orders, some of which cannot be judged, or are bad.

    Of these odd ones every `of`-th from the one of number `odd` on; all by default. Where not all
    are asked for, the usual ones are `SOME`.
    """
    usual = {f"T{seed}": drifting(seed, power) for seed, power in enumerate((0, 1, 1, 2, 2))}
    usual = {name: run for name, run in usual.items() if of == 1 or name in SOME}
    runs = {"two": drifting(5, 1, (20.0, 80.0))}
    runs["two-still"] = drifting(6, 0, (20.0, 80.0))
    runs["six"] = drifting(7, 3, (10.0, 35.0, 60.0, 85.0, 110.0, 135.0))
    runs["narrow"] = drifting(8, 1, (20.0, 24.0, 28.0, 29.0))
    runs["alike"] = {**drifting(9), "temperature_c": np.full(96, 20.0)}
    runs["none"] = short_run(11, temperature_c=None)
    runs["few"] = {n: v[:9] for n, v in short_run(12).items()}
    runs |= {name: bad_tools()[name] for name in ("bad-input", "channel", "gain")}
    runs["too-few"] = bad_tools()["too-few-stations"]
    angles = ("inclination", "azimuth", "toolface")
    runs["blind"] = drifting(13, 1) | {f"ref_{a}_deg": np.full(96, np.nan) for a in angles}
    return usual | dict(list(runs.items())[odd::of])


@pytest.mark.parametrize(
    ("tool", "options", "odd"),
    [
        ("servo", (), (0, 1)),
        ("quiet", ("--model", "polynomial"), (0, 6)),
        ("generic", ("--method", "scalar"), (1, 6)),
        ("servo", ("--method", "newton"), (2, 6)),
        ("servo", ("--prior", "datasheet", "--parameters", 9), (3, 6)),
    ],
    ids=str,
)
def test_orders_are_chosen_as_for_each_tool_alone(tmp_path, tool, options, odd):
    """Every kind of tool with the default and with another way."""
    rows, alone = both(tmp_path, temperatures(*odd), "--order", "auto", *options, tool=tool)
    check_all(rows, alone)
    chosen = {(r["accelerometer_order"], r["magnetometer_order"]) for r in rows.values()}
    assert {*SOME.values(), *([] if options else [(0, 1), (1, 1)])} <= chosen
    for row in rows.values():
        orders = [row["accelerometer_order"], row["magnetometer_order"]]
        assert row["order"] == (None if row["status"] != "ok" else max(orders))
        assert (
            row["order"] is None
            or "--model" in options
            or row["model"] == ("factors" if row["order"] else "polynomial")
        )


def test_a_given_order_is_fitted_over_each_tools_own_range(tmp_path):
    """A narrow range beside wide ones: alone, it is conditioned for itself."""
    runs = {"wide": drifting(1, 2), "narrow": drifting(2, 2, (20.0, 32.0, 44.0))}
    check_all(*both(tmp_path, runs, "--order", 2))


def test_an_order_too_low_is_stated_as_for_each_tool_alone(tmp_path):
    """With what it leaves out in findings and uncertainties; temperatures differ in number."""
    runs = {"three": drifting(2, 2, (20.0, 60.0, 100.0, 100.5)), "four": drifting(4, 2)}
    rows, alone = both(tmp_path, runs, "--order", 1)
    check_all(rows, alone)
    for row in rows.values():
        assert "accelerometer-temperature-misfit" in row["findings"]
        assert row["inclination_sd_deg"] > 0.01


def test_the_order_of_a_method_without_any(tmp_path):
    runs = {"still": drifting(0), "two": drifting(5, 1, (20.0, 80.0))}
    rows, alone = both(tmp_path, runs, "--order", "auto", "--method", "swarm")
    check_all(rows, alone)
    assert [row["order"] for row in rows.values()] == [0, 0]
    assert "magnetometer-temperature-misfit" in rows["two"]["findings"]


def test_a_trial_that_stops_the_batch_does_not_stop_the_others(tmp_path, monkeypatch):
    import mwdcal.calibration.automatic.auto as selection

    def fragile(readings, *given):
        if readings.accelerometer[..., 0, 0].max() > 5:
            raise np.linalg.LinAlgError("no convergence")
        return fit(readings, *given)

    monkeypatch.setattr(selection, "fit", fragile)
    runs = {f"T{seed}": drifting(seed, 1) for seed in range(3)}
    runs["T1"]["ax"][0] = 50.0
    path = write_fleet(tmp_path / "runs.parquet", runs)
    output = tmp_path / "cals.parquet"
    ran = mwdcal("fleet", path, "-o", output, "--tool", "servo", "--workers", 1, "--order", "auto")
    assert ran.code == 0
    rows = pq.read_table(output).to_pylist()
    assert [row["status"] for row in rows] == ["ok", "failed", "ok"]
    assert [row["order"] for row in rows] == [1, None, 1]


# The other options


def bent(seed, size=0.0):
    """A run of 42 stations whose accelerometer reads too much by a share of the squared field."""
    columns = servo_run(seed, (10, 40, 65, 90, 115, 140), 7)
    for channel in ("ax", "ay", "az"):
        columns[channel] = columns[channel] + size * columns[channel] ** 2 / 3
    return columns


def handful(curved):
    """Tools of many kinds: a bad station, no field, no magnetometer, too few stations.

    And one whose accelerometer is bent, or one of roll sets.
    """
    kicked = {name: np.array(values) for name, values in short_run(3).items()}
    kicked["ax"][5] += 0.05
    kicked["mz"][9] *= 1.02
    return {
        "T0": short_run(0),
        "kicked": kicked,
        "no-field": short_run(5, ref_field_nt=np.full(28, np.nan)),
        "alone": short_run(6, **dict.fromkeys(("mx", "my", "mz"))),
        "scarce": {n: v[:11] for n, v in short_run(7).items()},
        "few": {n: v[:3] for n, v in short_run(7).items()},
        "bad": bad_tools()["bad-input"],
        **({"bent": bent(8, 0.004)} if curved else {"rolls": roll_run(4)}),
    }


@pytest.mark.parametrize(
    ("tool", "options"),
    [
        ("quiet", ("--robust", "huber")),
        ("servo", ("--robust", "student-t")),
        ("generic", ("--robust", "student-t", "--method", "scalar")),
        ("quiet", ("--parameters", 9)),
        ("servo", ("--parameters", 6, "--model", "factors")),
        ("servo", ("--estimate", "azimuth-zero")),
        ("quiet", ("--estimate", "azimuth-zero,tilt")),
        ("servo", ("--ignore", "gravity,field")),
        ("quiet", ("--ignore", "dip")),
        ("quiet", ("--method", "newton", "--paper-weights")),
        ("servo", ("--method", "scalar", "--paper-weights")),
        ("quiet", ("--method", "least-squares", "--paper-weights")),
        ("servo", ("--method", "toolface-inclination", "--paper-weights")),
        ("servo", ("--prior", "datasheet")),
        ("quiet", ("--prior", "datasheet", "--robust", "huber")),
        ("servo", ("--nonlinearity", "accelerometer,magnetometer")),
        ("quiet", ("--nonlinearity", "accelerometer", "--order", "auto")),
        ("quiet", ("--nonlinearity", "auto")),
    ],
    ids=str,
)
def test_each_option_gives_what_it_gives_alone(tmp_path, tool, options):
    rows, alone = both(tmp_path, handful("--nonlinearity" in options), *options, tool=tool)
    check_all(rows, alone, 1e-7)
    assert rows["few"]["status"] in ("too-few-stations", "channel", "weak-geometry")
    assert rows["bad"]["status"] == "bad-input"
    assert rows["T0"]["status"] == "ok"
    if options == ("--nonlinearity", "auto"):
        curved = [serial for serial, row in rows.items() if row["accelerometer_radius"] is not None]
        assert curved == ["bent"]
    if "--estimate" in options:
        assert rows["rolls"]["status"] == "inseparable"


@pytest.mark.usefixtures("without_pictures")
def test_the_page_and_the_screen_of_a_fleet_whose_tools_differ(tmp_path):
    runs = temperatures() | {f"x{i}": drifting(20 + i, i % 3) for i in range(3)}
    runs["bent"] = bent(8, 0.01)
    path = write_fleet(tmp_path / "runs.parquet", runs, {"simulated": True})
    page, output = tmp_path / "fleet.html", tmp_path / "cals.parquet"
    given = ("--workers", 1, "--no-records", "--order", "auto", "--nonlinearity", "accelerometer")
    ran = mwdcal("fleet", path, "-o", output, "--tool", "servo", *given, "--report", page)
    assert ran.code == 0, ran
    orders = [row["magnetometer_order"] for row in pq.read_table(output).to_pylist()]
    counts = [orders.count(k) for k in range(4)]
    assert ["magnetometer", *map(str, counts)] in [line.split() for line in ran.out.splitlines()]
    text = page.read_text("utf-8")
    assert "SIMULATED DATA" in text
    cells = "".join(f"<td>{count}</td>" for count in counts)
    assert f'<td class="text">magnetometer</td>{cells}' in text
    assert all(name in text for name in ("square x", "gain xx", "misalignment xy", "scale x·τ²"))
    assert "nan" not in text


# A tool among others


def of_different_noise(count, known=()):
    """Tools from quiet to loud, some stations of each misread; noise is not declared."""
    rng, place = np.random.default_rng(3), plan()
    a, m = Tool.random(7).readings(rng, count, *place)
    a += rng.normal(size=a.shape) * np.logspace(-5, -2, count)[:, None, None]
    for member in range(count):
        a[member, rng.choice(48, member % 4)] += 0.01
    names = ("inclination", "azimuth", "toolface")
    values = {n: np.tile(v, (count, 1)) for n, v in zip(names, place, strict=True)}
    values |= {"field": np.full((count, 48), Tool.random(7).field)}
    spread = {n: np.full((count, 48), 0.02 * DEG) for n in names}
    return Readings(a, m, known=values, sd=spread)


@pytest.mark.parametrize(
    "options",
    [
        Options(),
        Options(robust="huber"),
        Options(robust="student-t"),
        Options("newton"),
        Options("newton", paper_weights=True),
        Options("scalar", paper_weights=True),
        Options("toolface-inclination", paper_weights=True),
        Options("least-squares"),
    ],
    ids=lambda o: f"{o.method}-{o.robust}-{o.paper_weights}",
)
def test_a_tool_does_not_depend_on_its_neighbours(options):
    """Every member ends by its own criterion."""
    readings = of_different_noise(20)
    many = fit(readings, options)
    for index in range(1, 20, 6):
        one = fit(take(readings, np.array([index])), options)
        sd = np.sqrt(np.diagonal(one.analysis.covariance[0]))
        assert np.abs((many.state.params[index] - one.state.params[0]) / sd).max() < 1e-6
        np.testing.assert_allclose(many.noise[index], one.noise[0], 1e-7)
        np.testing.assert_allclose(many.trust[index], one.trust[0], 1e-6)
        alike = np.sqrt(np.diagonal(many.analysis.covariance[index]))
        np.testing.assert_allclose(alike, sd, 1e-6)


# Refusals


def test_what_could_be_right_for_no_tool_is_refused_at_once(tmp_path):
    path = write_fleet(tmp_path / "runs.parquet", {"T1": short_run(1)})
    output = tmp_path / "out.parquet"

    def message(*options, code=2, tool="servo"):
        return refused(mwdcal("fleet", path, "-o", output, "--tool", tool, *options), code)

    assert "--order must be 0, 1, 2, 3 or auto; got '4'" in message("--order", 4)
    assert "of one tool: use it with mwdcal calibrate" in message("--prior", "T1.json")
    assert "has none" in message("--prior", "datasheet", tool="generic")
    assert "cannot weigh" in message("--robust", "huber", "--method", "newton")
    assert "does not come from a paper" in message("--paper-weights")
    assert "--ignore must be of" in message("--ignore", "toolface")
    assert "needs --method joint" in message("--ignore", "dip", "--method", "scalar")
    assert "--estimate must be of" in message("--estimate", "dip")
    assert "index mark" in message("--estimate", "toolface-zero", code=3)
    assert "must be auto, none" in message("--nonlinearity", "gyro")
    curved = ("--nonlinearity", "accelerometer")
    assert "--model polynomial" in message(*curved, "--order", 1)
    assert "need their prior" in message(*curved, "--method", "newton")
    assert "cannot be combined" in message(*curved, "--prior", "datasheet")
    assert "finds all" in message("--parameters", 9, "--method", "swarm")
    assert not output.exists()


def test_an_option_that_both_commands_have_is_one():
    from mwdcal.app.commands import calibrate as run
    from mwdcal.app.commands import fleet as table

    calibrate, fleet = ({p.name: p for p in module.command.params} for module in (run, table))
    own = {"runs", "workers", "scheduler", "records", "calibrations"}
    assert set(fleet) - set(calibrate) == own
    assert set(calibrate) - set(fleet) == {
        "run", "exclude", "decimal", "rolltest", "rolltest_sheet",
        "rolltest_column", "limits", "serial", "date", "operator", "registry",
    }  # fmt: skip
    for name in ("method", "robust", "estimate", "ignore", "parameters", "order", "nonlinearity"):
        assert fleet[name].help == calibrate[name].help


SAID = {
    "too weak to fit": "weak-geometry",
    "gain on tool axis": "gain",
    "residuals are": "residuals",
    "has no redundancy": "no-redundancy",
    "did not settle": "not-converged",
    "does not move": "channel",
    "moves by": "channel",
    "needs": "too-few-stations",
    "cannot tell it from": "inseparable",
}


def broken(rng):
    """A run of few stations with one or two things wrong."""
    good = servo_run(int(rng.integers(1000)), (10, 40, 65, 90, 115, 140), 6)
    some = np.sort(rng.permutation(36)[: rng.choice([6, 8, 12, 30])])
    run = {name: np.array(values)[some] for name, values in good.items()}
    for _ in range(rng.integers(1, 3)):
        one, other = rng.permutation(["ax", "ay", "az", "mx", "my", "mz"])[:2]
        wrong = rng.integers(5)
        if wrong == 0:
            run[one], run[other] = run[other], run[one]
        if wrong == 1:
            run[one] = -run[one]
        if wrong == 2:
            run[one] = run[one] * 10 ** rng.uniform(-2, 2)
        if wrong == 3:
            run[one] = run[one] + rng.normal(0, 10 ** rng.uniform(-3, 0.5), len(some))
        if wrong == 4:
            run["ref_toolface_deg"] = run["ref_toolface_deg"][::-1].copy()
    return run


@pytest.mark.parametrize(("tool", "options"), [
    ("servo", ("--estimate", "azimuth-zero")), ("generic", ("--method", "newton")),
])  # fmt: skip
def test_a_status_says_what_its_message_says(tmp_path, tool, options):
    rng = np.random.default_rng(1)
    path = write_fleet(tmp_path / "runs.parquet", {f"B{k}": broken(rng) for k in range(50)})
    rows = calibrated(path, *options, tool=tool)
    bad = [row for row in rows.values() if row["status"] != "ok"]
    for row in bad:
        assert row["status"] == next(s for words, s in SAID.items() if words in row["message"])
    assert len({row["status"] for row in bad}) >= 4
