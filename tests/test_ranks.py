"""What each evidence determines: the table of theory, by a formula of its own and by the command."""

import csv
import os
import re
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import pytest

from cli_support import SERVO_NOISE, channels, mwdcal, refused, write_csv
from cli_support import stations as references
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration
from mwdcal.estimation.uncertainty import marginal_rank
from mwdcal.files.profiles import load_profile
from mwdcal.files.runs import read_run
from simulation import (
    DEG,
    Tool,
    attitude,
    complex_steps,
    factor_fields,
    factor_readings,
    factors_within_limits,
    information,
    plan,
)
from test_observables import complex_value

ATTITUDES = plan((0.5, 45, 90, 135))
SOAKS = {0: [30.0], 3: [25.0, 56.25, 87.5, 118.75, 150.0]}
EARTH = (1.0, 50_000.0, 65.0)
IDEAL = np.tile(np.concatenate([np.tile([1.0, 0, 0, 0], 3), np.zeros(18)]), 2)
DRIFTING = factors_within_limits(np.random.default_rng(4), 1)[0]
TOLERANCE = 2e-2
TRIADS = ("accelerometer", "magnetometer")
ROTATIONS = ("rotation-x", "rotation-y", "toolface-zero")
COURSE = ("scale-temperature-1", "scale-temperature-2", "scale-temperature-3")


@dataclass(frozen=True)
class Evidence:
    """A row of the table: what is known, rank of 12 and of 30, what is free, and how to ask for it.

    `known` are the observables of the formula. `blank` are reference columns left empty in the run
    file, `lone` leaves the magnetometer out. Where no method uses this evidence alone, `absent`
    are the strengths (and dip) that the command is told to ignore.
    """

    known: tuple[str, ...]
    ranks: tuple[int, int]
    free: tuple[str, ...] = ()
    method: str = "joint"
    blank: tuple[str, ...] = ()
    lone: bool = True
    absent: tuple[str, ...] = ()

    @property
    def triad(self):
        return 0 if self.lone else 1


TABLE = {
    "vector": Evidence(("gravity", "inclination", "toolface"), (12, 30), method="least-squares"),
    "|g|": Evidence(("gravity",), (9, 27), ROTATIONS, "scalar"),
    "inclination": Evidence(
        ("inclination",), (10, 25), ("toolface-zero", "scale", *COURSE),
        blank=("toolface",), absent=("gravity",),
    ),
    "toolface + inclination": Evidence(
        ("toolface", "inclination"), (11, 26), ("scale", *COURSE), "toolface-inclination"
    ),
    "|g| + inclination": Evidence(("gravity", "inclination"), (11, 29), ROTATIONS[2:], "newton"),
    "|g| + inclination, jointly": Evidence(
        ("gravity", "inclination"), (11, 29), ROTATIONS[2:], blank=("toolface",)
    ),
    "|g| + toolface": Evidence(("gravity", "toolface"), (12, 30), blank=("inclination",)),
    "|g| + inclination + toolface": Evidence(("gravity", "inclination", "toolface"), (12, 30)),
    "|b|": Evidence(("field",), (9, 27), ROTATIONS, "scalar", lone=False),
    "azimuth": Evidence(
        ("azimuth",), (11, 26), ("scale", *COURSE), lone=False, absent=("field", "dip")
    ),
    "|b| + dip": Evidence(("field", "dip"), (12, 30), blank=("azimuth",), lone=False),
    "dip": Evidence(
        ("dip",), (11, 26), ("scale", *COURSE), blank=("azimuth",), lone=False, absent=("field",)
    ),
}  # fmt: skip
ROWS = pytest.mark.parametrize("evidence", TABLE.values(), ids=TABLE)
ORDERS = pytest.mark.parametrize("order", [0, 3])


# ── The formula ──────────────────────────────────────────────────────────────────────────────


def vectors(angles):
    gravity, field, dip = EARTH
    return np.concatenate(attitude(*angles)(gravity, field, dip * DEG), -1)


def chebyshev(order):
    """Powers of T - 30 °C (4) from Chebyshev polynomials over the soaks (order + 1)."""
    low, high = (SOAKS[3][k] - 30 for k in (0, -1))
    basis = [np.polynomial.Chebyshev.basis(k, [low, high]) for k in range(order + 1)]
    powers = [b.convert(kind=np.polynomial.Polynomial).coef for b in basis]
    return np.stack([np.pad(p, (0, 4 - len(p))) for p in powers], -1)


def jacobian(known, triad, tool, order, attitudes=ATTITUDES):
    """Whitened observables of a triad by its factors (12 or 30), columns of length one."""
    angles = np.tile(np.stack(attitudes), len(SOAKS[order]))
    warmth = np.repeat(SOAKS[order], len(attitudes[0]))
    true = vectors(angles)
    raw = factor_readings(tool, warmth, true)

    def observed(x):
        return np.stack([complex_value(n, factor_fields(x, warmth, raw)) for n in known], -1)

    own = np.s_[3 * triad : 3 * triad + 3]
    slope = [complex_steps(lambda v, n=n: complex_value(n, v), true)[..., own] for n in known]
    slope = np.stack(slope, -2)
    root = np.linalg.cholesky(slope @ np.swapaxes(slope, -1, -2))
    columns = complex_steps(observed, tool)[..., 30 * triad : 30 * triad + 30]
    count = 6 * (order + 1)
    mixed = np.zeros((30, count + 6))
    mixed[:24, :count], mixed[24:, count:] = np.kron(np.eye(6), chebyshev(order)), np.eye(6)
    rows = np.linalg.solve(root, columns @ mixed).reshape(-1, count + 6)
    size = np.linalg.norm(rows, axis=0)
    return rows / np.where(size > 1e-9 * size.max(), size, 1.0)


def singular_values(*arguments):
    values = np.linalg.svd(jacobian(*arguments), compute_uv=False)
    return values / values[0]


@ORDERS
@ROWS
def test_the_formula_gives_the_table(evidence, order):
    """`dip` alone has 11, not the 12 of theory.md: an angle does not know the scale."""
    values = singular_values(evidence.known, evidence.triad, IDEAL, order)
    rank = evidence.ranks[order > 0]
    assert np.sum(values > TOLERANCE) == rank
    assert np.sum(values > 1e-9) == rank


# ── The command ──────────────────────────────────────────────────────────────────────────────


def run_file(folder, tool, temperatures, angles=ATTITUDES, blank=(), lone=False, seed=1, **columns):
    """A run of the servo tool's scales and noise, some reference columns empty."""
    angles = np.tile(np.stack(angles), len(temperatures))
    warmth = np.repeat(temperatures, angles.shape[-1] // len(temperatures))
    raw = factor_readings(tool, warmth, vectors(angles))
    noise = np.repeat(SERVO_NOISE, 3) * np.random.default_rng(seed).normal(size=raw.shape)
    raw = raw + noise
    run = references(*angles, earth=EARTH, temperature_c=warmth, **columns)
    run |= channels(raw[:, :3], raw[:, 3:])
    run |= {f"ref_{name}_deg": np.full(len(warmth), np.nan) for name in blank}
    lost = ("mx", "my", "mz", "ref_field_nt", "ref_dip_deg") if lone else ()
    return write_csv(folder / "run.csv", {k: v for k, v in run.items() if k not in lost})


def calibrated(folder, evidence, tool, order):
    """The calibration by one row's evidence, as the command makes it."""
    run = run_file(folder, tool, SOAKS[order], blank=evidence.blank, lone=evidence.lone)
    options = ["--method", evidence.method, "--order", order, "-o", folder / "cal.json"]
    options += ["--ignore", ",".join(evidence.absent)] if evidence.absent else []
    ran = mwdcal("calibrate", run, "--tool", "servo", *options)
    assert ran.code == 0, ran
    name, size = TRIADS[evidence.triad], (12, 30)[order > 0]
    assert f"{name} {evidence.ranks[order > 0]} of {size} determined" in ran.out
    return read(folder / "cal.json")


def read(path):
    return msgspec.json.decode(path.read_bytes(), type=Calibration)


@ORDERS
@ROWS
def test_the_command_gives_the_table_and_names_what_is_free(tmp_path, evidence, order):
    record = calibrated(tmp_path, evidence, IDEAL, order)
    triad, rank = record.triads[evidence.triad], evidence.ranks[order > 0]
    free = {name for name in evidence.free if order or "temperature" not in name}
    assert (triad.rank, triad.size) == (rank, (12, 30)[order > 0])
    assert {u.id for u in triad.undetermined} == free
    assert len(triad.undetermined) == triad.size - rank
    assert sum(value > TOLERANCE for value in triad.singular_values) == rank
    if not evidence.lone and evidence.method != "scalar":
        assert record.accelerometer.rank == record.accelerometer.size


USELESS = ("inclination", "toolface + inclination", "|g| + inclination")


@pytest.mark.parametrize("name", USELESS)
def test_a_drifting_tool_has_no_more_and_nothing_is_quoted_for_what_is_free(tmp_path, name):
    """Formally more is determined, by values of 5e-6 to 5e-3: no uncertainty rests on them."""
    evidence = TABLE[name]
    values = singular_values(evidence.known, 0, DRIFTING, 3)
    rank = evidence.ranks[1]
    print(name, values[rank - 1 :])
    assert np.sum(values > TOLERANCE) == rank
    assert (values[rank:] < 5e-3).all()
    record = calibrated(tmp_path, evidence, DRIFTING, 3)
    triad = record.accelerometer
    assert triad.rank == rank
    assert {u.id for u in triad.undetermined} == set(evidence.free)
    scale, turn = ("scale" in evidence.free), ("toolface-zero" in evidence.free)
    stated = dict(zip(triad.parameter_names, triad.standard_uncertainties, strict=True))
    turned = ("misalignment-xy", "misalignment-yx")
    for parameter in (p for p in stated if p.startswith(("scale", "misalignment"))):
        moved = turn if parameter in turned else scale and parameter.startswith("scale")
        assert (stated[parameter] is None) == moved, parameter
    probe, _ = read_run(tmp_path / "run.csv", record.profile)
    probe = probe.select(probe.accelerometer[:, 2] < 0.8)  # well away from vertical
    for observable, free in (("gravity", scale), ("toolface", turn), ("inclination", False)):
        assert np.isnan(record.uncertainty(observable, probe)).all() == free
        assert np.isfinite(record.uncertainty(observable, probe)).all() != free


def test_by_a_tolerance_of_1e_7_the_free_scale_of_a_drifting_tool_would_be_determined():
    values = singular_values(("toolface", "inclination"), 0, DRIFTING, 3)
    assert np.sum(values > 1e-7) > 26
    assert np.sum(values > TOLERANCE) == 26


# ── Roll groups ──────────────────────────────────────────────────────────────────────────────

UNKNOWN = ("inclination", "azimuth", "toolface", "dip")


def rolls(inclinations):
    """Twelve toolfaces in each of some directions, and which direction each station has."""
    inc, azi, face = plan(inclinations)
    return (inc, np.repeat(azi[::12], 12), face), np.repeat(np.arange(len(inclinations)), 12)


def free_of_groups(inclinations):
    """Directions (24, k) of S, o that groups of unknown direction leave free, columns normalised."""
    ideal = Tool(np.stack([np.eye(3)] * 2), np.zeros((2, 3)), noise=SERVO_NOISE)
    angles, group = rolls(inclinations)
    count, member = len(group), np.eye(group.max() + 1)[group]
    joined = np.zeros((24 + 3 * count + 1, 24 + 2 * member.shape[1] + count + 1))
    joined[:24, :24], joined[-count - 1 :, -count - 1 :] = np.eye(24), np.eye(count + 1)
    for place in (0, 1):
        rows = np.s_[24 + place * count : 24 + (place + 1) * count]
        first = 24 + place * member.shape[1]
        joined[rows, first : first + member.shape[1]] = member
    whole = joined.transpose() @ information(ideal, *angles, UNKNOWN) @ joined
    size = np.sqrt(np.diag(whole))
    whole = whole / np.outer(size, size)
    cross = whole[24:, :24]
    reduced = whole[:24, :24] - cross.transpose() @ np.linalg.solve(whole[24:, 24:], cross)
    values, directions = np.linalg.eigh(reduced)
    return directions[:, values < (TOLERANCE**2) * values[-1]]


def marginal(free):
    """Rank of each triad: 12 less the dimension of the free space as it sees it."""
    places = [[*range(9), 18, 19, 20], [*range(9, 18), 21, 22, 23]]
    return [12 - np.linalg.matrix_rank(free[place], tol=0.05) for place in places]


def share(free, triad, name):
    """Share of one parameter of S or o in the free space; `gain` and `offset` are S⁻¹ and -S⁻¹o."""
    kind, axes = name.split("-")
    places = ["xyz".index(axis) for axis in axes]
    where = (
        18 + 3 * triad + places[0] if kind == "offset" else 9 * triad + 3 * places[0] + places[-1]
    )
    return np.sum(free[where] ** 2)


@pytest.mark.parametrize(
    ("inclinations", "rank"), [((35, 100), 10), ((30, 80, 130), 11), ((20, 60, 100, 150), 11)]
)
def test_the_formula_for_groups(inclinations, rank):
    assert marginal(free_of_groups(inclinations)) == [rank, rank]


@pytest.mark.parametrize(("order", "rank"), [(0, 11), (3, 29)])
def test_three_groups_leave_toolface_zero(tmp_path, order, rank):
    angles, group = rolls((30, 80, 130))
    group = [f"roll {k}" for k in np.tile(group, len(SOAKS[order]))]
    run = run_file(tmp_path, IDEAL, SOAKS[order], angles, UNKNOWN, group=group)
    cal = tmp_path / "cal.json"
    ran = mwdcal("calibrate", run, "--tool", "servo", "--order", order, "-o", cal)
    assert ran.code == 0, ran
    for triad in read(cal).triads:
        assert triad.rank == rank
        assert [u.id for u in triad.undetermined] == ["toolface-zero"]


def parameters_in(message):
    """Triad and id of each parameter that a message names in words: y scale, z-y misalignment, x offset."""
    words = r"(accelerometer|magnetometer) ([xyz])(?:-([xyz]))? (scale|misalignment|offset)"
    return [
        (triad, f"offset-{one}" if kind == "offset" else f"gain-{one}{other or one}")
        for triad, one, other, kind in re.findall(words, message)
    ]


def test_two_groups_are_refused_and_what_they_leave_free_is_named(tmp_path):
    angles, group = rolls((35, 100))
    run = run_file(tmp_path, IDEAL, SOAKS[0], angles, UNKNOWN, group=[f"roll {k}" for k in group])
    ran = mwdcal("calibrate", run, "--tool", "servo", "-o", tmp_path / "cal.json")
    message = refused(ran, 3)
    assert "too weak" in message
    assert "Add stations" in message
    named = parameters_in(message)
    free = free_of_groups((35, 100))
    assert {triad for triad, _ in named} == set(TRIADS)
    for triad, name in named:
        assert share(free, TRIADS.index(triad), name) > 0.1
    readings, _ = read_run(run, load_profile("servo")[0])
    result = fit(readings)
    for where in result.problem.slices():
        assert marginal_rank(result.analysis.determined, where) == 10


@pytest.mark.slow
def test_a_group_at_exactly_vertical_converges_for_every_tool(tmp_path):
    angles, group = rolls((0, 45, 90, 135))
    group = [f"roll {k}" for k in group]
    found = []
    for seed, tool in enumerate(factors_within_limits(np.random.default_rng(60), 30)):
        run = run_file(tmp_path, tool, SOAKS[0], angles, UNKNOWN, seed=seed, group=group)
        ran = mwdcal("calibrate", run, "--tool", "servo", "-o", tmp_path / "cal.json")
        assert ran.code == 0, ran
        found += read(tmp_path / "cal.json").triads
    assert {triad.rank for triad in found} == {11}
    assert {u.id for triad in found for u in triad.undetermined} == {"toolface-zero"}
    freedom = np.mean([triad.degrees_of_freedom for triad in found])
    mean = np.mean([triad.variance_factor for triad in found])
    assert abs(mean - 1) < 4 * np.sqrt(2 / freedom / len(found))


# ── Weak designs ─────────────────────────────────────────────────────────────────────────────

FOUR = [plan(inclinations, 4) for inclinations in ((5, 45, 90), (45, 90, 135), (0, 45, 90))]
WEAK = pytest.mark.parametrize("angles", FOUR, ids=["5-45-90", "45-90-135", "0-45-90"])
STEADY = np.r_[0:24:4, 24:30]
"""Places of the twelve factors of one temperature among the thirty."""
CROSSED = [
    *(("scalar", ("gravity",), angles, 8) for angles in FOUR),
    ("newton", ("gravity", "inclination"), plan((5, 45, 90, 135), 4), 10),
]


@pytest.mark.parametrize(
    ("method", "known", "angles", "rank"),
    CROSSED,
    ids=["scalar 5-45-90", "scalar 45-90-135", "scalar 0-45-90", "newton 5-45-90-135"],
)
def test_noise_determines_nothing(method, known, angles, rank):
    """Toolfaces a right angle apart have gx gy = 0: strengths say nothing of the xy cross terms."""
    assert np.sum(singular_values(known, 0, IDEAL, 0, angles) > TOLERANCE) == rank
    clean = factor_readings(IDEAL, np.full(len(angles[0]), 30.0), vectors(angles))[:, :3]
    noise = SERVO_NOISE[0] * np.random.default_rng(1).normal(size=(200, *clean.shape))
    sd = {"accelerometer": np.array(SERVO_NOISE[0])}
    result = fit(Readings(clean + noise, known={"inclination": angles[0]}, sd=sd), Options(method))
    settled = result.status == 0
    assert np.flatnonzero(settled & (result.analysis.determined.rank != rank)).tolist() == []


@pytest.mark.parametrize("lone", [True, False], ids=["alone", "with magnetometer"])
def test_newton_with_toolfaces_a_right_angle_apart_is_refused(tmp_path, lone):
    """Its accelerometer has |g| and inclination alone, whatever the magnetometer would add."""
    asked = ("--tool", "servo", "--method", "newton", "-o", tmp_path / "cal.json")
    accepted = []
    for seed, tool in enumerate(factors_within_limits(np.random.default_rng(4), 20)):
        angles = plan((5, 45, 90, 135), 4)
        run = run_file(tmp_path, tool, SOAKS[0], angles, lone=lone, seed=seed)
        ran = mwdcal("calibrate", run, *asked)
        if ran.code != 3 or "too weak" not in ran.err:
            accepted.append((seed, ran.code, ran.err[:60]))
    assert accepted == []


@WEAK
def test_what_a_refusal_names_is_free_indeed(tmp_path, angles):
    """Knowing a parameter that is named adds to what the stations determine."""
    rows = jacobian(("gravity",), 0, IDEAL, 0, angles)
    factors = [f"{w}-{i}{i if w == 'gain' else ''}" for w in ("gain", "offset") for i in "xyz"]
    factors += [f"gain-{i}{j}" for i in "xyz" for j in "xyz" if i != j]
    units = dict(zip(factors, np.eye(12), strict=True))
    adds = {n for n in factors if np.linalg.matrix_rank([*rows, units[n]], TOLERANCE) > 8}
    assert {"gain-xy", "gain-yx"} <= adds
    asked = ("--tool", "servo", "--method", "scalar", "-o", tmp_path / "cal.json")
    wrong = []
    for seed in range(20):
        run = run_file(tmp_path, IDEAL, SOAKS[0], angles, lone=True, seed=seed)
        ran = mwdcal("calibrate", run, *asked)
        named = {name for _, name in parameters_in(ran.err)}
        if ran.code != 3 or not named or named - adds:
            wrong.append((seed, ran.code, named))
    assert wrong == []


# ── Measured ─────────────────────────────────────────────────────────────────────────────────

FACES = {
    "x_p": (90, 270), "x_a": (90, 90), "y_p": (90, 180), "y_a": (90, 0), "z_p": (0, 0), "z_a": (180, 0)
}  # fmt: skip
"""Inclination and toolface of imucal's six faces, degrees."""


@pytest.mark.skipif(
    "MWDCAL_DATA" not in os.environ, reason="measured sets: set MWDCAL_DATA to a local copy"
)
def test_imucals_six_faces_are_too_weak_for_angles_alone(tmp_path):
    """A face along an axis does not turn when the axis stretches: three scales are free."""
    angles = np.array(list(FACES.values()), float).transpose()
    inc, face = angles * DEG
    x, y, z = -np.sin(inc) * np.sin(face), -np.sin(inc) * np.cos(face), np.cos(inc)
    raw = np.stack([x, y, z, x, y, z], -1)

    def directions(factors):
        g = factor_fields(factors, np.full(6, 30.0), raw)[..., :3]
        return g / np.sqrt(np.sum(g**2, -1, keepdims=True))

    columns = complex_steps(directions, IDEAL)[..., STEADY].reshape(18, 12)
    np.testing.assert_allclose(columns[:, :3], 0, atol=1e-15)
    assert np.linalg.matrix_rank(columns, TOLERANCE) == 9

    session = Path(os.environ["MWDCAL_DATA"]) / "imucal" / "annotated_session.csv"
    with session.open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    means = [
        np.mean([[float(r[f"acc_{a}"]) for a in "xyz"] for r in rows if r["part"] == face], 0)
        for face in FACES
    ]
    angles = np.array(list(FACES.values()), float).transpose()
    run = {
        "station": list(FACES),
        **dict(zip(("ax", "ay", "az"), np.array(means).transpose(), strict=True)),
    }
    run |= {"ref_inclination_deg": angles[0], "ref_toolface_deg": angles[1]}
    tool = tmp_path / "imucal.toml"
    tool.write_text('name = "imucal"\n[accelerometer]\nscale = 2045.0\nnoise = 20.0\n')
    asked = ("--tool", tool, "-o", tmp_path / "cal.json", "--method")
    path = write_csv(tmp_path / "run.csv", run)
    message = refused(mwdcal("calibrate", path, *asked, "toolface-inclination"), 3)
    assert "too weak" in message
    named = {name for _, name in parameters_in(message)}
    assert named < {"gain-xx", "gain-yy", "gain-zz"}
    assert len(named) == 2
    assert mwdcal("calibrate", path, *asked, "least-squares").code == 0
