"""Plans: what they will give against simulated calibrations, and the best stations against theory."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from importlib.resources import files
from itertools import combinations, groupby

import numpy as np
import pytest
from msgspec.structs import replace as with_changes
from scipy.stats import chi2

import mwdcal as library
from cli_support import mwdcal, read_csv, refused
from mwdcal.calibration import results
from mwdcal.calibration.diagnosis.detection import detections
from mwdcal.calibration.diagnosis.plausibility import misfit_chances, stations_to_reshoot
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import ASSUMED, settings_of
from mwdcal.calibration.results import accuracy_at, readings_at
from mwdcal.errors import FitError, InputError
from mwdcal.files.documents import read
from mwdcal.files.formats.table import Table, write
from mwdcal.files.formats.table import read as read_table
from mwdcal.files.profiles import built_in, load_profile
from mwdcal.geometry.vectors import reference_vectors
from mwdcal.planning import planned
from mwdcal.planning.expected import expected, nominal_run, planned_earth, planned_fit
from mwdcal.planning.optimal import (
    Design,
    Information,
    best,
    evenly,
    least_count,
    least_worst,
    typical_sd,
)
from mwdcal.planning.planned import (
    WORKING_INCLINATIONS,
    Stand,
    best_plan,
    judged,
    measuring_order,
    session_seconds,
    smallest_plan,
)
from mwdcal.planning.plans import load_plan, run_sheet, taken
from mwdcal.sensor.profile import TriadProfile
from simulation import DEG, attitude

SERVO = load_profile("servo")[0]
EXACT = with_changes(
    SERVO, stand=with_changes(SERVO.stand, inclination_deg=0.0, azimuth_deg=0.0, toolface_deg=0.0)
)
ANEW = with_changes(SERVO, stand=with_changes(SERVO.stand, settings="per-station"))
GRAVITY = with_changes(SERVO, magnetometer=TriadProfile())
ANGLES = ("inclination", "azimuth", "toolface")
COUNTS = {
    "acceptance-104": 104, "candidates": 504, "laboratory-thermal": 48, "moosavi-12": 48,
    "moosavi-30": 144, "roll-test": 12, "six-state": 6, "twelve-state": 12, "twenty-four-state": 24,
}  # fmt: skip


def regression(powers, places, repeated=1):
    """Candidates (n,) of an ordinary regression on powers of x, each so many times."""
    x = np.repeat(np.asarray(places, float), repeated)
    rows = np.stack([x**power for power in powers], -1)[:, None]
    return Information(rows, np.zeros((len(powers),) * 2), len(powers)), x


def test_built_in_plans_are_as_described():
    assert {name: load_plan(name).count for name in built_in("plans")} == COUNTS


@pytest.mark.parametrize("name", ["six-state", "twelve-state", "twenty-four-state"])
def test_each_axis_points_up_and_down(name):
    plan = load_plan(name).columns
    angles = (np.radians(plan[f"ref_{angle}_deg"]) for angle in ANGLES)
    gravity, _ = attitude(*angles)(1.0, 1.0, 0.0)
    found = {tuple(row) for row in np.round(gravity, 9).tolist()}
    assert found == {tuple(row) for row in np.vstack([np.eye(3), -np.eye(3)]).tolist()}


def test_the_laboratory_turns_every_axis_of_both_triads_to_its_extremes():
    plan = load_plan("laboratory-thermal").columns
    angles = [np.radians(plan[f"ref_{angle}_deg"][:12]) for angle in ANGLES]
    for vectors in attitude(*angles)(1.0, 1.0, np.radians(plan["ref_dip_deg"][0])):
        np.testing.assert_allclose(vectors.max(0), 1, atol=1e-5)
        np.testing.assert_allclose(vectors.min(0), -1, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "profile", "count"),
    [
        pytest.param(name, profile, count, id=f"{name} {kind}")
        for name, profile, kind, count in (
            ("six-state", EXACT, "exact", 1000),
            ("laboratory-thermal", EXACT, "exact", 1000),
            ("moosavi-30", EXACT, "exact", 1000),
            ("twelve-state", SERVO, "uncertain", 500),
            ("moosavi-12", SERVO, "uncertain", 500),
            ("laboratory-thermal", SERVO, "uncertain", 200),
            ("twelve-state", GRAVITY, "gravity alone", 1000),
        )
    ],
)
def test_expected_covariance_is_that_of_simulated_calibrations(name, profile, count):
    """Errors of all parameters with the expected covariance taken out: χ², in all and along every direction.

    `examples/planning/scatter.py` makes 2,000 to 20,000 of every plan.
    """
    choice, result = planned_fit(load_plan(name), profile)
    readings = choice.readings
    rng = np.random.default_rng(7)
    # the stand is set once for stations of one direction that follow each other; toolface at each
    direction = np.stack([readings.known[name] for name in ANGLES[:2]])
    setting = np.cumsum(np.any(np.diff(direction, prepend=-1.0, axis=1) != 0, 0)) - 1
    number = dict.fromkeys(ANGLES[:2], setting) | {"toolface": np.arange(readings.count)}
    angles = [
        readings.known[name]
        + readings.uncertainty(name) * rng.normal(size=(count, readings.count))[:, number[name]]
        for name in ANGLES
    ]
    field, dip = (readings.known[name][0] for name in ("field", "dip"))
    noisy = [
        vectors + readings.sd[kind] * rng.normal(size=vectors.shape)
        for kind, vectors in zip(readings.triads, attitude(*angles)(1.0, field, dip), strict=False)
    ]
    many = replace(readings, **dict(zip(readings.triads, noisy, strict=False)))
    fitted = fit(many, choice.options)
    reference = choice.profile.reference_temperature_c
    values, nominal = (
        np.einsum("bij,bj->bi", results.to_file(each, reference), each.state.params)
        for each in (fitted, result)
    )
    calibration = expected(load_plan(name), profile)
    covariance, size = calibration.parameter_covariance, values.shape[-1]
    sd = np.sqrt(np.diag(covariance))
    root = np.linalg.cholesky(covariance / np.outer(sd, sd))
    errors = (values - nominal) / sd
    # χ of `count` degrees of freedom: 1σ is 1 / √(2 count); the largest of 60
    assert np.abs(np.sqrt(np.mean(errors**2, 0)) - 1).max() < 4.5 / np.sqrt(2 * count)
    white = np.linalg.solve(root, errors.T)
    low, high = chi2.ppf([1e-4, 1 - 1e-4], count * size)
    assert low < np.sum(white**2) < high
    ends = np.linalg.svd(white, compute_uv=False)[
        [-1, 0]
    ]  # within √N ± (√k + t), but for 2 exp(-t²/2)
    assert np.sqrt(count) - np.sqrt(size) - 4 < ends[0]
    assert ends[1] < np.sqrt(count) + np.sqrt(size) + 4


def test_twelve_states_halve_the_variance_of_six():
    six, twelve = (
        expected(load_plan(n), EXACT).accelerometer for n in ("six-state", "twelve-state")
    )
    ratio = np.divide(six.standard_uncertainties, twelve.standard_uncertainties)
    np.testing.assert_allclose(ratio, np.sqrt(2), rtol=1e-6)


# The best designs of ordinary regressions are in every textbook (Fedorov 1972, Pukelsheim 1993).


def test_d_optimal_stations_of_a_quadratic():
    information, x = regression([0, 1, 2], np.linspace(-1, 1, 41), repeated=6)
    design = best(information, 12)
    values, counts = np.unique(x[design.chosen], return_counts=True)
    assert dict(zip(values.round(9).tolist(), counts.tolist(), strict=True)) == {-1: 4, 0: 4, 1: 4}
    assert design.efficiency == pytest.approx(1, abs=2e-3)


def test_a_optimal_stations_of_a_quadratic():
    information, x = regression([0, 1, 2], np.linspace(-1, 1, 41), repeated=8)
    design = best(information, 16, wanted=np.eye(3))
    values, counts = np.unique(x[design.chosen], return_counts=True)
    assert dict(zip(values.round(9).tolist(), counts.tolist(), strict=True)) == {-1: 4, 0: 8, 1: 4}


@pytest.mark.parametrize("shared", [0, 2])
@pytest.mark.parametrize("wanted", [None, np.diag([1.0, 4.0, 9.0])], ids=["D", "A"])
@pytest.mark.parametrize("seed", range(5))
def test_an_exchange_comes_close_to_the_best_of_all_choices(seed, wanted, shared):
    rng = np.random.default_rng(seed)
    prior = np.diag([0.0] * 3 + [1.0] * shared)
    information = Information(rng.normal(size=(11, 2, 3 + shared)), prior, 3)

    def value(chosen):
        rows = information.rows[list(chosen)].reshape(-1, 3 + shared)
        covariance = np.linalg.inv(rows.T @ rows + prior)[:3, :3]
        return (
            np.linalg.det(covariance) ** (1 / 3)
            if wanted is None
            else np.trace(wanted @ covariance)
        )

    design = best(information, 5, wanted)
    least = min(map(value, combinations(range(11), 5)))
    assert len(design.chosen) == 5
    assert value(design.chosen) < 1.06 * least
    if wanted is None:
        assert design.efficiency <= least / value(design.chosen) + 1e-9


def test_kept_stations_stay():
    information, _ = regression([0, 1, 2], np.linspace(-1, 1, 21))
    kept = np.isin(np.arange(21), [9, 10])
    design = best(information, 5, kept=kept)
    assert {9, 10} <= set(design.chosen.tolist())
    assert {0, 20} <= set(design.chosen.tolist())


def worst(information, wanted, chosen):
    """The largest variance of a choice, from the definition; infinite where it determines too little."""
    rows = information.rows[list(chosen)].reshape(-1, information.rows.shape[-1])
    whole = rows.T @ rows + information.prior
    if np.linalg.cond(whole) > 1e12:
        return np.inf
    covariance = np.linalg.inv(whole)[: information.size, : information.size]
    return max(np.trace(w @ covariance) for w in wanted)


@pytest.mark.parametrize("shared", [0, 2])
@pytest.mark.parametrize("seed", range(4))
def test_the_fewest_stations_are_those_of_all_choices(seed, shared):
    """Within one of what the look at every choice finds, and the bound is never above it."""
    rng = np.random.default_rng(seed)
    prior = np.diag([0.0] * 3 + [1.0] * shared)
    information = Information(rng.normal(size=(12, 2, 3 + shared)), prior, 3)
    roots = rng.normal(size=(4, 2, 3))
    wanted = roots.mT @ roots / worst(information, roots.mT @ roots, range(12)) / 1.8
    every = {
        n: min(worst(information, wanted, c) for c in combinations(range(12), n))
        for n in range(2, 9)
    }
    fewest = min(n for n, value in every.items() if value <= 1)
    none = np.zeros(12, bool)
    assert fewest - 2 <= least_count(information, wanted, none, 12) <= fewest
    for count in (fewest, fewest + 1):
        members, value = least_worst(information, count, wanted, none)
        assert np.count_nonzero(members) == count
        assert value == pytest.approx(worst(information, wanted, np.flatnonzero(members)), rel=1e-9)
        assert value <= 1 or value < 1.05 * every[count]


def test_a_bound_counts_kept_stations():
    rng = np.random.default_rng(5)
    information = Information(rng.normal(size=(10, 2, 3)), np.zeros((3, 3)), 3)
    wanted = np.eye(3)[None] / 0.3
    kept = np.arange(10) < 3
    every = {
        n: min(worst(information, wanted, {0, 1, 2, *c}) for c in combinations(range(3, 10), n))
        for n in range(7)
    }
    fewest = 3 + min(n for n, value in every.items() if value <= 1)
    assert fewest > 4
    assert fewest - 2 <= least_count(information, wanted, kept, 10) <= fewest
    members, _ = least_worst(information, fewest, wanted, kept)
    assert members[:3].all()


@pytest.mark.parametrize(
    ("seed", "stations"),
    [(0, 5), *(pytest.param(k, 7, marks=pytest.mark.study) for k in (0, 1, 2))],
)
def test_rounding_does_not_choose_between_equal_stations(seed, stations):
    """Other unknowns, turned, round every number otherwise: so do other numbers of threads.

    Those of the parameters among themselves, and those that stations share (settings of the stand) likewise.
    """
    _, result = planned_fit(load_plan("candidates"), SERVO)
    information, _ = Information.of_fit(result)
    size, shared = information.size, information.rows.shape[-1] - information.size
    wanted = np.stack([np.eye(size), np.diag(np.linspace(0.2, 2, size))])
    rng = np.random.default_rng(seed)
    turn, other = (np.linalg.qr(rng.normal(size=(n, n)))[0] for n in (size, shared))
    whole = np.block([[turn, np.zeros((size, shared))], [np.zeros((shared, size)), other]])
    turned = replace(
        information, rows=information.rows @ whole, prior=whole.T @ information.prior @ whole
    )
    none = np.zeros(information.count, bool)
    first, again = (
        least_worst(each, stations, w, none)[0]
        for each, w in ((information, wanted), (turned, turn.T @ wanted @ turn))
    )
    assert np.flatnonzero(first).tolist() == np.flatnonzero(again).tolist()


def test_the_efficiency_is_of_the_better_stations_larger():
    information, _ = regression([0, 1, 2], np.linspace(-1, 1, 21))
    even = np.isin(np.arange(21), [0, 5, 10, 15, 20])
    near = np.isin(np.arange(21), [8, 9, 10, 11, 12])
    assert 0 < Design(information, near).efficiency < Design(information, even).efficiency < 1


@pytest.mark.parametrize(
    "common", [{}, {"azimuth_zero_deg": 0.1, "field_nt": 50.0, "tilt_deg": 0.02}], ids=str
)
def test_planned_information_is_that_of_the_fit(common):
    profile = with_changes(SERVO, stand=with_changes(SERVO.stand, **common))
    _, result = planned_fit(load_plan("moosavi-12"), profile)
    information, turn = Information.of_fit(result)
    assert information.size == turn.shape[1] == 24
    settings = 2 * 4  # inclination and azimuth of four directions
    assert (information.rows.shape[-1] > 24 + settings) is bool(common)
    whole = np.linalg.inv(information.of(np.ones(information.count)))[:24, :24]
    covariance = result.analysis.covariance[0]
    sd = np.sqrt(np.diag(covariance))
    size = np.outer(sd, sd)
    np.testing.assert_allclose(turn @ whole @ turn.T / size, covariance / size, atol=1e-6)


STAND = Stand(degrees_per_second=2.0, settle_seconds=10.0, soak_minutes=60.0)


def session(attitudes, temperatures, stand):
    """Seconds of a session of stations (n, 3) at temperatures, °C."""
    names = ("ref_inclination_deg", "ref_azimuth_deg", "ref_toolface_deg")
    columns = dict(zip(names, np.transpose(np.asarray(attitudes, float)), strict=True))
    columns |= {"temperature_c": np.asarray(temperatures, float)}
    return session_seconds(Table(columns), stand)


def test_seconds_of_a_session():
    stations = [[0, 0, 0], [90, 0, 0], [90, 350, 20]]
    # 90° at 2°/s, then 20° (azimuth the short way: 10°), three readings after 10 s each, one soak
    assert session(stations, [20, 20, 20], STAND) == 45 + 10 + 30 + 3600
    assert session(stations, [20, 20, 60], STAND) == 45 + 10 + 30 + 7200


@pytest.mark.parametrize(
    ("temperatures", "soaks"),
    [([20, 20, 21], 0), ([np.nan] * 3, 0), ([120] * 3, 1), ([-20] * 3, 1), ([20, 60, 20], 3)],
)
def test_a_session_that_needs_an_oven_soaks_for_90_minutes(temperatures, soaks):
    """The stand is in a room of 20 °C: at 120 °C or -20 °C alone the tool takes as long to get there."""
    usual = replace(STAND, soak_minutes=None)
    stations = [[0, 0, 0], [90, 0, 0], [90, 350, 20]]
    assert session(stations, temperatures, usual) == 45 + 10 + 30 + soaks * 5400


def test_an_axis_with_ends_goes_back_the_long_way():
    stations, warmth = [[90, 350, 0], [90, 10, 0]], [20, 20]
    ended = replace(STAND, reach={"azimuth": (0.0, 360.0)})
    assert session(stations, warmth, STAND) == 10 + 20 / 2 + 10 + 3600
    assert session(stations, warmth, ended) == 10 + 340 / 2 + 10 + 3600
    across = replace(STAND, reach={"azimuth": (-180.0, 180.0)})
    assert session(stations, warmth, across) == 10 + 20 / 2 + 10 + 3600


def test_what_a_stand_reaches():
    stand = Stand(reach={"inclination": (0.0, 120.0), "azimuth": (-90.0, 90.0), "toolface": (0, 0)})
    stations = np.array([[0.0, 0, 0], [120, 270, 360], [121, 90, 0], [90, 180, 0], [90, 0, 1]])
    assert stand.within(stations).tolist() == [
        [True, True, True], [True, True, True], [False, True, True], [True, False, True], [True, True, False],
    ]  # fmt: skip


@pytest.mark.parametrize(
    "reach", [{"roll": (0, 1)}, {"inclination": (-10, 90)}, {"azimuth": (90, 0)}, {"toolface": (-300, 100)},
              {"azimuth": (0, np.nan)}], ids=str,
)  # fmt: skip
def test_a_stand_reaches_from_the_least_setting_to_the_largest(reach):
    with pytest.raises(InputError, match="from the least setting to the largest"):
        Stand(reach=reach)


def test_a_slow_trend_does_not_keep_step_with_attitude():
    """Of a linear trend over the session gravity along the axes explains little."""
    inclination, azimuth, toolface = np.meshgrid(
        [20.0, 70.0, 110.0], [0.0, 120.0], np.arange(0, 360, 45.0)
    )
    stations = np.stack([inclination.ravel(), azimuth.ravel(), toolface.ravel()], -1)
    place = np.linspace(-1, 1, len(stations))

    def explained(order):
        i, _, t = np.radians(stations[order]).T
        axes = [np.ones(len(i)), np.sin(i) * np.sin(t), np.sin(i) * np.cos(t), np.cos(i)]
        design = np.stack(axes, -1)
        left = place - design @ np.linalg.lstsq(design, place, rcond=None)[0]
        return 1 - left @ left / (place @ place)

    by_direction = np.lexsort(stations.T[::-1])
    assert explained(by_direction) > 0.8
    assert explained(measuring_order(stations, np.zeros(len(stations), int))) < 0.2


def test_soaks_keep_their_order():
    stations = np.random.default_rng(0).uniform(0, 180, (30, 3))
    soak = np.repeat([2, 0, 1], 10)
    order = measuring_order(stations, soak)
    assert soak[order].tolist() == soak.tolist()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("name = 'x'\nstations = []", "from 1 to 20000 stations; this one has 0"),
        ("name = 'x'\n[[stations]]\ninclination_deg = [200]", "between 0 and 180"),
        ("name = 'x'\n[[stations]]\nazimuth_deg = 1", "inclination_deg"),
        ("name = 'x'\n[[stations]]\ninclination_deg = 1\nroll = 2", "roll"),
        ("name =", "is not a plan"),
        (
            "name = 'x'\ntemperature_c = nan\n[[stations]]\ninclination_deg = 1",
            "'temperature_c': must be",
        ),
        ("name = 'x'\ngravity_g = nan\n[[stations]]\ninclination_deg = 1", "'gravity_g': must be"),
        ("name = 'x'\n[[stations]]\ninclination_deg = [1, 200]", "between 0 and 180 °; got 200"),
        ("name = 'x'\ndip_deg = 95\n[[stations]]\ninclination_deg = 1", "'dip_deg': must be"),
        ("name = 'x'\n[[stations]]\ninclination_deg = [1, inf]", "'inclination_deg': must be"),
        (
            f"name = 'x'\n[[stations]]\ninclination_deg = {list(range(180))}\n"
            f"azimuth_deg = {list(range(300))}\n",
            "this one has 54000",
        ),
        (
            f"name = 'x'\n[[stations]]\ninclination_deg = {[0] * 1000}\nazimuth_deg = {[0] * 1000}\n"
            f"toolface_deg = {[0] * 1000}\n",
            "this one has 1000000000",
        ),
    ],
)
def test_bad_plans_end_in_one_sentence(tmp_path, text, words):
    path = tmp_path / "plan.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        nominal_run(load_plan(str(path)), SERVO)


def test_stations_of_one_attitude_are_no_plan():
    plan = load_plan("six-state")
    one = taken(plan, np.zeros(24, int))
    with pytest.raises(FitError, match=r"would read the same at all 24 stations.*Add stations"):
        expected(one, SERVO)


def test_a_search_that_would_take_hours_is_refused():
    whole = load_plan("candidates")
    many = taken(whole, np.arange(1001) % whole.count)
    with pytest.raises(InputError, match="must not exceed 1000000"):
        best_plan(many, 1000, SERVO, criterion="D")


HOT = """
name = "hot"
temperature_c = [20, 60, 100, 140]
[[stations]]
inclination_deg = [0, 90, 180]
azimuth_deg = [0, 90, 180, 270]
toolface_deg = [0, 90, 180, 270]
"""


@pytest.mark.parametrize("criterion", ["D", "A", "I"])
def test_the_best_stations_carry_the_temperature_terms_of_all_candidates(tmp_path, criterion):
    (tmp_path / "hot.toml").write_text(HOT)
    result = best_plan(load_plan(str(tmp_path / "hot.toml")), 24, SERVO, None, criterion)
    triad = result.calibration.accelerometer
    assert (triad.order, triad.rank, triad.size) == (3, 30, 30)
    assert set(result.plan.columns["temperature_c"]) == {20, 60, 100, 140}


def test_the_next_stations_are_at_the_place_and_the_temperatures_of_the_run():
    run = load_plan("six-state")
    warm = {"temperature_c": np.full(6, 80.0), "ref_dip_deg": np.full(6, -70.0)}
    measured = replace(run, columns={**run.columns, **warm})
    more = best_plan(None, 3, SERVO, None, "I", measured=measured).plan.columns
    assert more["ref_dip_deg"].tolist() == [-70] * 3
    assert more["temperature_c"].tolist() == [80] * 3


def test_the_smallest_plan_is_redundant_and_says_what_it_costs():
    """Five stations give 0.1° of azimuth, with three degrees of freedom."""
    result = smallest_plan(None, {"azimuth": 0.1}, SERVO)
    assert result.freedom.min() >= 8
    assert not {"inclination", "azimuth", "toolface"} & set(result.hidden)
    said = {finding.id: finding.text for finding in result.findings}
    assert "4 stations give the accuracy" in said["redundancy"]
    few = smallest_plan(None, {"azimuth": 0.1}, SERVO, count=5)
    assert (
        np.degrees(accuracy_at(few.calibration, WORKING_INCLINATIONS.tolist())["azimuth"]).max()
        < 0.1
    )
    assert few.freedom.max() < 4
    assert {"few-degrees-of-freedom", "hidden-errors"} <= {finding.id for finding in few.findings}


@pytest.mark.parametrize(("wanted", "known"), [(0.05, 9), (0.04, 11)])
def test_the_search_finds_plans_as_small_as_are_known(wanted, known):
    result = smallest_plan(None, {"azimuth": wanted}, SERVO)
    assert result.bound <= result.plan.count <= known
    reached = accuracy_at(result.calibration, WORKING_INCLINATIONS.tolist())["azimuth"]
    assert np.degrees(reached).max() <= wanted


def test_a_plan_says_how_well_its_uncertainties_will_be_known():
    """s² of simulated runs scatters twice as much as the finding says of s; `calibrate` reports it too."""
    plan = load_plan("six-state")
    planned_ = judged(plan, SERVO)
    [text] = [f.text for f in planned_.findings if f.id == "few-degrees-of-freedom"]
    stated = float(text.partition(" %")[0].rpartition(" ")[2])
    fitted = noisy_runs(plan, SERVO, 1500)
    scatter = 50 * np.std(fitted.analysis.variance_factor, axis=0)  # half of that of s²
    assert scatter.max() == pytest.approx(stated, rel=0.12)
    assert {f.id for f in expected(plan, SERVO).findings} == {"few-degrees-of-freedom", "no-serial"}


def noisy_runs(plan, profile, count, errors=(), seed=0):
    """Fits of simulated runs by a plan, with errors (observable, station, size) of single stations.

    Stations of one setting share its errors of inclination and azimuth, as the plan takes it.
    """
    choice, _ = planned_fit(plan, profile)
    readings, rng = choice.readings, np.random.default_rng(seed)
    shared, each = settings_of(readings), np.arange(readings.count)
    true = {
        name: readings.known[name]
        + readings.uncertainty(name)
        * rng.normal(size=(count, readings.count))[:, each if name == "toolface" else shared]
        for name in ANGLES
    } | {name: np.tile(readings.known[name], (count, 1)) for name in ("gravity", "field", "dip")}
    for name, station, size in errors:
        true[name][:, station] += size
    vectors = attitude(*(true[n] for n in ANGLES))(
        true["gravity"][..., None], true["field"][..., None], true["dip"]
    )
    read = {
        kind: v + readings.sd[kind] * rng.normal(size=v.shape)
        for kind, v in zip(readings.triads, vectors, strict=True)
    }
    return fit(replace(readings, **read), choice.options)


@pytest.mark.parametrize("observable", ["inclination", "azimuth", "gravity", "field"])
@pytest.mark.parametrize(
    ("name", "profile"), [("six-state", SERVO), ("twelve-state", EXACT)], ids=["6", "12"]
)
def test_an_error_is_noticed_from_the_size_that_a_plan_says(name, profile, observable):
    """In 80 % of simulated runs, and in few at a third of it; a station that is never named is not."""
    plan = load_plan(name)
    detection = detections(planned_fit(plan, profile)[1])[observable]
    noticed, named = detection.noticed[0], detection.named[0]
    station = int(np.argmax(noticed))

    def shares(size):
        result = noisy_runs(plan, profile, 500, [(observable, station, size)])
        marked = stations_to_reshoot(result)
        large = (misfit_chances(result) < 1e-3).any(-1)
        return np.mean(marked.any(-1) | large), np.mean(marked[:, station])

    assert 0.72 < shares(noticed[station])[0] < 0.95
    assert shares(noticed[station] / 3)[0] < 0.3
    if name == "six-state":
        assert np.isinf(named).all()
        assert shares(20 * noticed[station])[1] < 0.02
    else:
        assert 0.72 < shares(named[station])[1] < 0.95


def test_a_search_computes_the_information_once(monkeypatch):
    fits = []
    counted = planned.planned_fit
    monkeypatch.setattr(planned, "planned_fit", lambda *a: fits.append(a) or counted(*a))
    smallest_plan(None, {"inclination": 0.02}, SERVO)
    assert len(fits) == 1


def test_a_plan_needs_the_noise():
    with pytest.raises(InputError, match="noise of the accelerometer"):
        expected(load_plan("six-state"), load_profile("generic")[0])


def test_a_run_file_is_a_plan(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text(
        "station,temperature_c,ref_inclination_deg,ref_azimuth_deg,ref_toolface_deg,ax,ay,az\n"
        "A,20,90,0,0,,,\nB,20,45,10,30,,,\n"
    )
    plan = load_plan(str(path))
    assert list(plan.columns["station"]) == ["A", "B"]
    assert "ax" not in plan.columns
    readings, _ = nominal_run(plan, SERVO)
    gravity, field = reference_vectors(
        np.array([90, 45]) * DEG,
        np.array([0, 10]) * DEG,
        np.array([0, 30]) * DEG,
        1.0,
        48e3,
        63 * DEG,
    )
    np.testing.assert_allclose(readings.accelerometer, gravity, atol=1e-12)
    np.testing.assert_allclose(readings.magnetometer, field, atol=1e-6)


def test_a_plan_states_every_attitude(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("ref_inclination_deg,ref_azimuth_deg,ref_toolface_deg\n90,0,0\n45,,30\n")
    with pytest.raises(InputError, match="station 2 has no ref_azimuth_deg"):
        nominal_run(load_plan(str(path)), SERVO)


ATTITUDES = (
    "0,0,0", "180,0,0", "90,0,0", "90,0,90", "90,0,180", "90,0,270", "60,120,40", "120,240,200",
)  # fmt: skip


def written_plan(path, names="", cells=("",)):
    """A run file of `ATTITUDES` with further columns, whose cells come in turn."""
    head = "ref_inclination_deg,ref_azimuth_deg,ref_toolface_deg" + names
    rows = [each + cells[k % len(cells)] for k, each in enumerate(ATTITUDES)]
    path.write_text("\n".join([head, *rows, ""]))
    return load_plan(str(path))


@pytest.mark.parametrize(
    ("names", "cell"),
    [("", ""), (",temperature_c", ","), (",ref_gravity_g,ref_field_nt,ref_dip_deg", ",,,")],
)
def test_a_plan_without_temperatures_or_place_is_one_at_the_usual(tmp_path, names, cell):
    """The candidates have temperatures, the plan none: its efficiency among them is the same."""
    usual = ",temperature_c,ref_gravity_g,ref_field_nt,ref_dip_deg"
    whole = judged(written_plan(tmp_path / "whole.csv", usual, (",25,1,48000,63",)), SERVO)
    bare = judged(written_plan(tmp_path / "bare.csv", names, (cell,)), SERVO)
    assert bare.efficiency == pytest.approx(whole.efficiency, rel=1e-9)
    np.testing.assert_allclose(
        bare.calibration.parameter_covariance, whole.calibration.parameter_covariance, rtol=1e-6,
        atol=1e-22,
    )  # fmt: skip


def test_a_run_without_temperatures_has_next_stations(tmp_path):
    done = written_plan(tmp_path / "run.csv")
    assert best_plan(load_plan("candidates"), 2, SERVO, measured=done).plan.count == 2


def test_blank_cells_of_the_place_take_the_mean_of_the_others(tmp_path):
    cells = (",0.99,52000,-70", ",,,", ",0.992,54000,-72", ",,,")
    plan = written_plan(tmp_path / "p.csv", ",ref_gravity_g,ref_field_nt,ref_dip_deg", cells)
    place = [values[1] for values in planned_earth(plan)]
    np.testing.assert_allclose(place, [0.991, 53_000, -71 * DEG])


def test_where_the_field_is_vertical_no_azimuth_is_known():
    plan = load_plan("twelve-state")
    vertical = replace(plan, columns={**plan.columns, "ref_dip_deg": np.full(plan.count, 90.0)})
    sd = accuracy_at(expected(vertical, SERVO), [45 * DEG])
    assert np.isnan(sd["azimuth"]).all()
    assert sd["inclination"] < 0.01 * DEG


def test_a_stand_turned_by_hand_moves_its_slow_axes_last():
    """Three inclinations at two azimuths: five moves of them are the fewest, however the plan is shuffled."""
    grid = np.array(
        [(i, a, t) for i in (5, 45, 90) for a in (0, 90) for t in (0, 90, 180, 270)], float
    )
    for seed in range(20):
        shuffled = np.random.default_rng(seed).permutation(np.concatenate([grid, grid]))
        soak = np.repeat([0, 1], 24)
        attitude = np.concatenate([shuffled[np.unique(shuffled, axis=0, return_index=True)[1]]] * 2)
        order = measuring_order(attitude, soak)
        assert sorted(order.tolist()) == list(range(48))
        assert (np.diff(soak[order]) >= 0).all()
        for some in (order[:24], order[24:]):
            moved = np.any(np.diff(attitude[some, :2], axis=0) != 0, axis=-1)
            assert moved.sum() == 5
            assert np.count_nonzero(np.diff(attitude[some, :2], axis=0)) == 5  # one axis at a time


@pytest.mark.usefixtures("without_pictures")
def test_a_sheet_has_room_for_six_readings_and_no_banner_of_simulated_data(tmp_path):
    sheet = tmp_path / "sheet.html"
    assert (
        mwdcal("plan", "--plan", "laboratory-thermal", "--tool", "servo", "--report", sheet).code
        == 0
    )
    page = sheet.read_text("utf-8")
    assert "SIMULATED" not in page
    assert page.count('<td class="reading">') == 6 * 49
    assert "<th>ax, raw</th>" in page
    temperatures = re.findall(r'<td class="tick"></td><td>\d+</td><td>(\d+)</td>', page)
    planned_ones = load_plan("laboratory-thermal").columns["temperature_c"].tolist()
    visits = [key for key, _ in groupby(map(float, temperatures))]
    assert visits == [key for key, _ in groupby(planned_ones)]  # there and back, as the plan has it


def test_file_screen_and_sheet_have_one_order_and_the_sheet_repeats_the_first_station(tmp_path):
    profile, plan, sheet = (tmp_path / name for name in ("p.toml", "plan.csv", "sheet.html"))
    text = (files("mwdcal") / "profiles" / "servo.toml").read_text("utf-8")
    columns = "".join(f'{c} = {{name = "{c}", unit = "V"}}\n' for c in ("ax", "ay", "az"))
    profile.write_text(f"{text}\n[columns]\n{columns}", "utf-8")
    ran = mwdcal("plan", "--stations", 24, "--tool", profile, "-o", plan, "--report", sheet)
    assert ran.code == 0, ran
    written = read_csv(plan)
    angles = [written[f"ref_{name}_deg"] for name in ("inclination", "azimuth", "toolface")]
    stations = [
        [name, "25", *(f"{float(cell):g}" for cell in cells)]
        for name, *cells in zip(written["station"], *angles, strict=True)
    ]
    assert [row[0] for row in stations] == [str(k) for k in range(1, 25)]
    shown = ran.out[ran.out.index("station   T") :].splitlines()[2:26]
    assert [line.split() for line in shown] == stations
    page = sheet.read_text("utf-8")
    rows = re.findall(r'<td class="tick"></td>' + r"<td>([^<]*)</td>" * 5, page)
    assert [list(row) for row in rows] == [*stations, ["1 again", *stations[0][1:]]]
    assert page.count("not in the file: add it to the run's end under its own label, <i>1 ag") == 1
    assert re.findall(r"<th>([am][xyz], [^<]+)</th>", page) == [
        "ax, V", "ay, V", "az, V", "mx, raw", "my, raw", "mz, raw"
    ]  # fmt: skip
    blocks = [float(key) for key, _ in groupby(row[3] for row in stations)]
    assert sorted(blocks) != blocks != sorted(blocks, reverse=True)


def test_the_last_row_shows_a_drift_that_the_inclinations_would_hide():
    """All of 5°, then all of 90°: one of 0.5 mg along the tool axis over the run is found by the row."""
    stand = Stand(reach={"inclination": (0, 90)})
    plan = best_plan(None, 24, SERVO, criterion="I", stand=stand).plan
    found = dict.fromkeys((24, 25), 0)
    for stations in (plan, taken(plan, np.append(np.arange(24), 0))):
        for seed in range(4):
            run = library.simulate(stations, SERVO, seed=seed)
            drifting = run.accelerometer.copy()
            drifting[:, 2] += 0.5e-3 * np.linspace(-0.5, 0.5, run.count)
            made = library.calibrate(replace(run, accelerometer=drifting), SERVO)
            found[run.count] += "accelerometer-drift" in {each.id for each in made.findings}
    assert found[24] <= 1
    assert found[25] >= 3


def test_a_plan_of_few_inclinations_says_why_and_what_more_would_cost(tmp_path):
    """The figure is that of the angles of a plan with six stations at each of four inclinations."""
    sheet = tmp_path / "sheet.html"
    line = ("plan", "--stations", 24, "--tool", "servo")
    ran = mwdcal(*line, "--reach", "inclination=0:90", "--report", sheet)
    said = next(each for each in ran.out.splitlines() if each.startswith("Only "))
    assert said.startswith("Only 5° and 90° of 4 inclinations to choose from")
    assert "not linear along the tool axis" in said
    assert said in sheet.read_text("utf-8")
    cost = float(re.search(r"([\d.]+) times the 1σ of the angles", said)[1])
    assert 1.0 < cost < 1.2
    assert "\nOnly " not in mwdcal(*line).out  # six of seven
    three = mwdcal(*line, "--reach", "inclination=0:120", "--criterion", "D").out
    assert "Only 5°, 90° and 120° of 5" in three
    assert "times the 1σ of the parameters.\n" in three


def test_an_even_plan_is_even_and_no_better_than_the_best():
    """Straight line by 8 of 3 × 8 places: at the ends 1, evenly sqrt(3/2) of the slope (by hand); D is between."""
    information, x = regression((0, 1), (-1, 0, 1), repeated=8)
    ends = best(information, 6).members
    assert set(x[ends]) == {-1, 1}
    even = evenly(information, ends, None, x.astype(int) + 1)
    assert np.bincount(x[even].astype(int) + 1).tolist() == [2, 2, 2]
    ratio = typical_sd(information, even, None) / typical_sd(information, ends, None)
    assert ratio == pytest.approx(1.5**0.25)
    slope = np.diag([0.0, 1.0])
    ratio = typical_sd(information, even, slope) / typical_sd(information, ends, slope)
    assert ratio == pytest.approx(1.5**0.5)


def test_the_screen_says_which_drift_the_order_of_the_stations_would_hide(tmp_path):
    """A plan that only warms cannot tell a drift from temperature; one that returns to its first temperature can."""
    plan = tmp_path / "plan.toml"
    for levels, hidden in (("25, 55, 85", True), ("25, 55, 85, 55, 25", False)):
        plan.write_text(
            f'name = "p"\ntemperature_c = [{levels}]\n[[stations]]\ninclination_deg = [5, 45, 90, 135]\n'
            "azimuth_deg = 0\ntoolface_deg = [0, 60, 120, 180, 240, 300]\n",
            "utf-8",
        )
        made = mwdcal("plan", "--plan", plan, "--tool", "servo", "--order", 2)
        assert made.code == 0, made
        words = "as the order of the stations would hide a drift: accelerometer offsets"
        assert (words in made.out) == hidden
        assert ("0.1 mg of the accelerometer" in made.out) == hidden


def test_the_screen_says_what_is_assumed_and_how_long_the_soak_is(tmp_path):
    plan = tmp_path / "p.toml"
    plan.write_text('name = "p"\ndip_deg = 60\n[[stations]]\ninclination_deg = [5, 60, 120]\n'
                    "azimuth_deg = [0, 120]\ntoolface_deg = [0, 90, 180, 270]\n", "utf-8")  # fmt: skip
    shown = mwdcal("plan", "--plan", plan, "--tool", "servo", "--soak", 90).out
    assert "the plan does not state the place; assumed: field 48,000 nT\n" in shown
    assert re.search(r"of which soak \(no oven: --soak 0\) +1\.5 h", shown)
    without = mwdcal("plan", "--plan", plan, "--tool", "servo").out
    assert re.search(r"of which soak \(--soak\) +0\.0 h", without)
    assert "SIMULATED" not in shown
    assert "the plan does not state the place; assumed: field 48,000 nT, dip 63°\n" in mwdcal(
        "plan", "--plan", "six-state", "--tool", "servo"
    ).out  # fmt: skip


FAR = "Inclinations up to {}°. If your stand reaches less, add --reach inclination_deg=0:120 to"


@pytest.mark.parametrize(
    ("line", "most"),
    [
        (("--stations", 8), 175),
        (("--stations", 8, "--reach", "toolface_deg=0:330"), 175),
        (("--plan", "moosavi-12", "--plan", "twenty-four-state"), 180),
        (("--plan", "moosavi-12"), None),
        (("--stations", 8, "--reach", "inclination_deg=0:120"), None),
        (("--stations", 8, "--reach", "inclination_deg=0:180"), None),
    ],
)
def test_a_plan_beyond_many_stands_names_the_option_for_them(line, most):
    """The suggested option keeps the plan within 120°."""
    shown = mwdcal("plan", *line, "--tool", "servo").out
    assert shown.count("If your stand reaches less") == (most is not None)
    assert most is None or FAR.format(most) in shown
    if "inclination_deg=0:120" in line:
        rows = re.findall(r"^\d+ +25 +(\S+) ", shown, re.MULTILINE)
        assert len(rows) == 8
        assert max(map(float, rows)) <= 120


def test_a_profile_without_noise_is_planned_with_that_of_a_servo_instrument(tmp_path):
    """The same as with the noise of the built-in servo tool, 0.1 mg and 15 nT, stated in the profile's raw units."""
    path, plan = tmp_path / "p.toml", ("plan", "--plan", "moosavi-12", "--json", "--tool")
    text = 'name = "p"\n[accelerometer]\nscale = 988.4\n{}\n[magnetometer]\nscale = 1.018\n{}\n'
    path.write_text(text.format("", ""), "utf-8")
    assumed = mwdcal(*plan, path)
    said = "the noise of the accelerometer and magnetometer; assumed is that of a servo instrument, 0.1 mg and 15 nT"
    assert said in " ".join(assumed.err.split())
    assert "noise-assumed" in {each["id"] for each in assumed.json["findings"]}
    servo = load_profile("servo")[0]
    stated = [each.noise / each.scale for each in (servo.accelerometer, servo.magnetometer)]
    raw = [f"noise = {x * k!r}" for x, k in zip(stated, (988.4, 1.018), strict=True)]
    path.write_text(text.format(*raw), "utf-8")
    known = mwdcal(*plan, path).json
    assert "noise-assumed" not in {each["id"] for each in known["findings"]}
    for angle, sd in assumed.json["accuracy_deg"].items():
        assert sd == pytest.approx(known["accuracy_deg"][angle], rel=1e-6)


@pytest.mark.parametrize("many", [(), ("--repeat", 2, "--workers", 1)])
def test_a_simulation_says_the_assumed_noise_in_the_words_of_the_plan(tmp_path, many):
    planned = mwdcal("plan", "--tool", "sap6", "--plan", "moosavi-12")
    [line] = [each for each in planned.err.splitlines() if "the noise of" in each]
    command = ("simulate", *many, "--plan", "moosavi-12", "-o", tmp_path / "out.csv", "--tool")
    assert mwdcal(*command, "sap6").err.splitlines() == [line.replace("moosavi-12: ", "")]
    assert [each["id"] for each in mwdcal(*command, "sap6", "--json").json["findings"]] == [
        "noise-assumed"
    ]
    assert mwdcal(*command, "servo").err == ""


@pytest.mark.parametrize("suffix", ["csv", "xlsx"])
def test_a_plan_file_names_the_tool_and_so_does_its_calibration(tmp_path, suffix):
    sheet, page = tmp_path / f"plan.{suffix}", tmp_path / "sheet.html"
    line = ("plan", "--plan", "twenty-four-state", "--tool", "servo", "-o", sheet)
    assert library.plan("servo", plan="six-state").serial == ""
    assert mwdcal(*line).code == 0
    assert read_table(sheet).metadata["serial"] == ""
    assert mwdcal(*line, "--serial", "12.10", "--report", page, "--json").json["serial"] == "12.10"
    assert "<dt>Serial</dt><dd>12.10</dd>" in page.read_text("utf-8")
    assert library.plan("servo", plan=sheet).serial == "12.10"
    table, run = read_table(sheet), library.simulate(sheet, "servo", seed=1)
    cells = {name: run.columns[name] for name in table.columns}
    write(tmp_path / "run.csv", replace(table, columns=cells))
    assert library.calibrate(tmp_path / "run.csv", "servo").tool["serial"] == "12.10"


def test_the_place_of_a_plan_is_shown_with_names_and_units(tmp_path):
    plan = tmp_path / "p.toml"
    place = "gravity_g = 1.0003\nfield_nt = 51000\ndip_deg = 66.2\n"
    angles = "inclination_deg = [5, 60, 120]\nazimuth_deg = [0, 120]\ntoolface_deg = [0, 90, 180]\n"
    plan.write_text(f'name = "p"\n{place}[[stations]]\n{angles}', "utf-8")
    shown = mwdcal("plan", "--plan", plan, "--tool", "servo").out
    assert "place: field 51,000 nT, dip 66.2°, gravity 1.0003 g\n" in shown


@pytest.mark.usefixtures("without_pictures")
def test_a_plan_says_on_which_practice_of_the_stand_it_rests(tmp_path):
    """The same figures as from a profile that states the practice, and the sheet asks the operator for it."""
    text = (files("mwdcal") / "profiles" / "servo.toml").read_text("utf-8")
    assert "\n[stand]\n" in text
    profile, sheet = tmp_path / "p.toml", tmp_path / "sheet.html"
    command = ("plan", "--plan", "moosavi-12", "--tool")
    profile.write_text(text, "utf-8")
    open_ = mwdcal(*command, profile, "--json").json
    shown = mwdcal(*command, profile).out
    assert open_["settings"] == "assumed"
    assert ASSUMED in shown
    assert "azimuth, 1σ if set at every station" in shown
    by_practice = {}
    asked = {"per-direction": "turn the toolface alone", "per-station": "anew at every station"}
    for practice, words in asked.items():
        stand = f'\n[stand]\nsettings = "{practice}"\n'
        profile.write_text(text.replace("\n[stand]\n", stand), "utf-8")
        each = mwdcal(*command, profile, "--report", sheet, "--json").json
        assert each["settings"] == practice
        assert "accuracy_per_station_deg" not in each
        assert [w for w in asked.values() if w in sheet.read_text("utf-8")] == [words]
        by_practice[practice] = each["accuracy_deg"]
    assert by_practice["per-direction"] == open_["accuracy_deg"]
    assert by_practice["per-station"] == open_["accuracy_per_station_deg"]
    assert open_["accuracy_deg"] != open_["accuracy_per_station_deg"]


def test_a_plan_lists_the_inclinations_in_reach_and_the_time_of_a_station(tmp_path):
    sheet, line = tmp_path / "sheet.html", ("plan", "--tool", "servo", "--stations", 12)
    reach = ("--reach", "inclination_deg=0:90")
    document = mwdcal(*line, *reach, "--report", sheet, "--json").json
    assert document["inclinations_deg"] == [5.0, 30.0, 60.0, 90.0]
    assert {len(sd) for sd in document["accuracy_by_inclination_deg"].values()} == {4}
    assert mwdcal(*line, "--json").json["inclinations_deg"][-1] == 120.0
    by_hand = document["session_hours"] + 12 * 2 / 60
    seconds = 3600 * (document["session_hours"] - document["soak_hours"]) / 12
    assert f"{seconds:.0f} s a station; {by_hand:.1f} h by hand" in sheet.read_text("utf-8")
    assert document["soak_hours"] == 0.0
    said = " ".join(mwdcal(*line, *reach).out.split())
    assert f"per station (--speed, --settle) {seconds:.0f} s" in said
    assert f"by hand, 2 min a station more {by_hand:.1f} h" in said
    mwdcal(*line, *reach, "--soak", 90, "--report", sheet)
    assert f"and 1.5 h of soak; {by_hand + 1.5:.1f} h by hand" in sheet.read_text("utf-8")


@pytest.mark.parametrize(("stations", "whole"), [(24, True), (25, False)])
def test_a_sheet_of_25_rows_is_one_page(tmp_path, stations, whole):
    sheet = tmp_path / "sheet.html"
    assert mwdcal("plan", "--tool", "servo", "--stations", stations, "--report", sheet).code == 0
    page = sheet.read_text("utf-8")
    assert ('<section id="sheet" class="page">' in page) == whole
    assert page.count("@page { size: A4 landscape") == 1


def test_a_sheet_asks_for_the_place(tmp_path):
    """Without field and dip `calibrate` would give another accuracy than the plan has stated."""
    bare = run_sheet(load_plan("six-state")).columns
    assert all(np.isnan(bare[f"ref_{name}"]).all() for name in ("gravity_g", "field_nt", "dip_deg"))
    stated = run_sheet(load_plan("laboratory-thermal")).columns
    assert set(stated["ref_dip_deg"]) == {70.5}


def test_a_profile_without_magnetometer_is_of_a_tool_without_one(tmp_path):
    """Plan, sheet, simulated run and its calibration: gravity alone, and what a plan says comes true."""
    profile = tmp_path / "gravity.toml"
    profile.write_text('name = "gravity"\n[accelerometer]\nnoise = 1e-4\n', "utf-8")
    planned = mwdcal(*("plan", "--tool", profile, "-o", tmp_path / "sheet.csv", "--json"))
    assert planned.code == 0, planned
    document = json.loads(planned.out)
    assert document["magnetometer"] is None
    assert document["size"] == 12
    assert "has no [magnetometer]" in planned.err
    sheet = (tmp_path / "sheet.csv").read_text("utf-8")
    assert "ax,ay,az" in sheet
    assert not any(word in sheet for word in ("mx", "field", "dip"))
    for name, command in {
        "run.csv": ("simulate", "--tool", profile),
        "cal.json": ("calibrate", tmp_path / "run.csv", "--tool", profile, "--order", "0"),
    }.items():
        ran = mwdcal(*command, "-o", tmp_path / name)
        assert ran.code == 0, ran
    record = read(tmp_path / "cal.json")
    assert record.magnetometer is None
    assert record.accelerometer.rank == 12
    wanted = mwdcal("plan", "--tool", profile, "--accuracy", "azimuth=0.1")
    assert "cannot be wanted" in refused(wanted, 2)


@pytest.mark.parametrize("name", ["Temp", "Temperature_C", "DIP", "ref_Field_nT"])
def test_columns_under_other_names_are_not_left_out_of_a_plan(tmp_path, name):
    """As of a run: a plan at two temperatures is not taken for one at none."""
    with pytest.raises(InputError, match=name):
        written_plan(tmp_path / "plan.csv", f",{name}", (",20", ",90"))


def test_the_fewest_stations_carry_the_temperature_terms_of_all_candidates(tmp_path):
    """And the accuracy holds between the soaks and at their ends, not at the reference temperature alone."""
    path = tmp_path / "warm.toml"
    path.write_text(
        "name = 'warm'\ntemperature_c = [20, 90, 160]\n[[stations]]\ninclination_deg = [5, 90, 175]\n"
        "azimuth_deg = [0, 120, 240]\ntoolface_deg = [0, 120, 240]\n"
    )
    wanted = {"azimuth": 0.25}
    result = smallest_plan(load_plan(str(path)), wanted, SERVO)
    assert [triad.order for triad in result.calibration.triads] == [2, 2]
    for temperature in np.linspace(20, 160, 15):
        each = accuracy_at(result.calibration, WORKING_INCLINATIONS, temperature=temperature)
        # the temperatures that are looked at lie 23 °C apart
        assert np.degrees(each["azimuth"]).max() < 1.02 * wanted["azimuth"]


def test_why_24_stations_cannot_beat_the_48_of_the_textbook():
    """Not even 24 stations that serve the azimuth at 5° inclination alone are as good there as the 48.

    The bound is of a convex function by its tangent: of any weights w of sum 24, tr(W V) - (24 max g - w·g),
    g being the slopes tr(M V W V).
    """
    low = [np.radians(5.0)]
    textbook = accuracy_at(expected(load_plan("moosavi-12"), ANEW), low)["azimuth"][0]
    candidates = load_plan("candidates")
    choice, result = planned_fit(candidates, ANEW)
    information, turn = Information.of_fit(result)
    to_file = results.to_file(result, choice.profile.reference_temperature_c)[0]
    made = expected(candidates, ANEW)
    faces, azimuths = np.meshgrid(np.arange(12) * 30 * DEG, np.arange(12) * 30 * DEG)
    at = readings_at(made, low[0], azimuths.ravel(), faces.ravel())
    seen = made.sensitivity("azimuth", at) @ to_file @ turn
    wanted = seen.T @ seen / len(seen)
    weights, bound = np.full(candidates.count, 24 / candidates.count), 0.0
    for _ in range(200):
        covariance = np.linalg.inv(information.of(weights))
        slopes = np.einsum(
            "nmi,ij,nmj->n",
            information.rows,
            covariance @ wanted @ covariance,
            information.rows,
            optimize=True,
        )
        value = np.trace(wanted @ covariance)
        bound = max(bound, value - (24 * slopes.max() - weights @ slopes))
        weights = weights * np.sqrt(slopes)
        weights *= 24 / weights.sum()
    assert np.degrees(np.sqrt(bound)) > 1.05 * np.degrees(textbook)
