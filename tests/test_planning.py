"""Plans: what they will give against simulated calibrations, and the best stations against theory."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, pairwise, permutations

import numpy as np
import pytest
from msgspec.structs import replace as with_changes

from mwdcal.calibration import results
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.prediction import accuracy_at, readings_at
from mwdcal.errors import InputError
from mwdcal.files.profiles import built_in, load_profile
from mwdcal.geometry.vectors import reference_vectors
from mwdcal.planning.expected import expected, nominal_run, planned_earth, planned_fit
from mwdcal.planning.moves import Stand, move_seconds, session_seconds, shortest_order
from mwdcal.planning.optimal import Information, best, efficiency
from mwdcal.planning.planned import WORKING_INCLINATIONS, best_plan, judged, smallest_plan
from mwdcal.planning.plans import load_plan, run_sheet
from simulation import DEG, attitude

SERVO = load_profile("servo")[0]
EXACT = with_changes(
    SERVO, stand=with_changes(SERVO.stand, inclination_deg=0.0, azimuth_deg=0.0, toolface_deg=0.0)
)
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
    ("name", "profile"),
    [
        pytest.param(name, profile, id=f"{name} {kind}")
        for name in ("six-state", "twelve-state", "laboratory-thermal", "moosavi-12", "moosavi-30")
        for kind, profile in (("exact", EXACT), ("uncertain", SERVO))
    ],
)
def test_expected_uncertainties_are_the_scatter_of_simulated_calibrations(name, profile):
    choice, planned = planned_fit(load_plan(name), profile)
    readings, count = choice.readings, 2000 if planned.problem.evidence.include.size < 100 else 500
    rng = np.random.default_rng(7)
    angles = [
        readings.known[name] + readings.uncertainty(name) * rng.normal(size=(count, readings.count))
        for name in ANGLES
    ]
    field, dip = (readings.known[name][0] for name in ("field", "dip"))
    fields = attitude(*angles)(1.0, field, dip)
    noisy = [
        field + readings.sd[kind] * rng.normal(size=field.shape)
        for kind, field in zip(("accelerometer", "magnetometer"), fields, strict=True)
    ]
    many = replace(readings, accelerometer=noisy[0], magnetometer=noisy[1])
    fitted = fit(many, choice.options)
    reference = choice.profile.reference_temperature_c
    values = np.einsum("bij,bj->bi", results.to_file(fitted, reference), fitted.state.params)
    stated = np.array(
        [sd for t in expected(load_plan(name), profile).triads for sd in t.standard_uncertainties]
    )
    ratio = values.std(0, ddof=1) / stated
    # χ of `count` - 1 degrees of freedom: 1σ is 1 / √(2 count); the largest of 60
    assert np.abs(ratio - 1).max() < 4.5 / np.sqrt(2 * count), ratio


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


def test_the_efficiency_is_of_the_better_stations_larger():
    information, _ = regression([0, 1, 2], np.linspace(-1, 1, 21))
    even = np.isin(np.arange(21), [0, 5, 10, 15, 20])
    near = np.isin(np.arange(21), [8, 9, 10, 11, 12])
    assert 0 < efficiency(information, near) < efficiency(information, even) < 1


@pytest.mark.parametrize(
    "common", [{}, {"azimuth_zero_deg": 0.1, "field_nt": 50.0, "tilt_deg": 0.02}], ids=str
)
def test_planned_information_is_that_of_the_fit(common):
    profile = with_changes(SERVO, stand=with_changes(SERVO.stand, **common))
    _, planned = planned_fit(load_plan("moosavi-12"), profile)
    information, turn = Information.of_fit(planned)
    assert information.size == turn.shape[1] == 24
    assert (information.rows.shape[-1] > 24) is bool(common)
    whole = np.linalg.inv(information.of(np.ones(information.count)))[:24, :24]
    covariance = planned.analysis.covariance[0]
    sd = np.sqrt(np.diag(covariance))
    size = np.outer(sd, sd)
    np.testing.assert_allclose(turn @ whole @ turn.T / size, covariance / size, atol=1e-6)


STAND = Stand(degrees_per_second=2.0, settle_seconds=10.0, soak_minutes=60.0)


def test_seconds_of_a_session():
    stations = np.array([[0.0, 0, 0], [90, 0, 0], [90, 350, 20]])
    # 90° at 2°/s, then 20° (azimuth the short way: 10°), three readings after 10 s each, one soak
    assert session_seconds(stations, np.zeros(3, int), STAND) == 45 + 10 + 30 + 3600
    assert session_seconds(stations, np.array([0, 0, 1]), STAND) == 45 + 10 + 30 + 7200


@pytest.mark.parametrize("seed", range(8))
def test_an_order_with_short_moves(seed):
    stations = np.random.default_rng(seed).integers(0, 13, (7, 3)) * 15.0
    soak = np.zeros(7, int)
    order = shortest_order(stations, soak, STAND)
    assert sorted(order.tolist()) == list(range(7))
    every = [(0, *rest) for rest in permutations(range(1, 7))]
    seconds = move_seconds(stations, STAND)
    least = min(sum(seconds[a, b] for a, b in pairwise(o)) for o in every)
    found = sum(seconds[a, b] for a, b in pairwise(order))
    assert least <= found <= 1.15 * least


def test_soaks_keep_their_order():
    stations = np.random.default_rng(0).uniform(0, 180, (30, 3))
    soak = np.repeat([2, 0, 1], 10)
    order = shortest_order(stations, soak, STAND)
    assert soak[order].tolist() == soak.tolist()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("name = 'x'\nstations = []", "from 1 to 20000 stations; this one has 0"),
        ("name = 'x'\n[[stations]]\ninclination_deg = [200]", "between 0 and 180"),
        ("name = 'x'\n[[stations]]\nazimuth_deg = 1", "inclination_deg"),
        ("name = 'x'\n[[stations]]\ninclination_deg = 1\nroll = 2", "roll"),
        ("name =", "is not a plan"),
        ("name = 'x'\ntemperature_c = nan\n[[stations]]\ninclination_deg = 1", "must be finite"),
        ("name = 'x'\ngravity_g = nan\n[[stations]]\ninclination_deg = 1", "must be finite"),
        ("name = 'x'\n[[stations]]\ninclination_deg = [1, inf]", "must be finite"),
        (
            f"name = 'x'\n[[stations]]\ninclination_deg = {list(range(180))}\n"
            f"azimuth_deg = {list(range(300))}\n",
            "this one has 54000",
        ),
    ],
)
def test_bad_plans_end_in_one_sentence(tmp_path, text, words):
    path = tmp_path / "plan.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        nominal_run(load_plan(str(path)), SERVO)


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


def test_a_sheet_asks_for_the_place(tmp_path):
    """Without field and dip `calibrate` would give another accuracy than the plan has stated."""
    bare = run_sheet(load_plan("six-state")).columns
    assert all(np.isnan(bare[f"ref_{name}"]).all() for name in ("gravity_g", "field_nt", "dip_deg"))
    stated = run_sheet(load_plan("laboratory-thermal")).columns
    assert set(stated["ref_dip_deg"]) == {70.5}


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
    textbook = accuracy_at(expected(load_plan("moosavi-12"), SERVO), low)["azimuth"][0]
    candidates = load_plan("candidates")
    choice, planned = planned_fit(candidates, SERVO)
    information, turn = Information.of_fit(planned)
    to_file = results.to_file(planned, choice.profile.reference_temperature_c)[0]
    made = expected(candidates, SERVO)
    faces, azimuths = np.meshgrid(np.arange(12) * 30 * DEG, np.arange(12) * 30 * DEG)
    at = readings_at(made, low[0], azimuths.ravel(), faces.ravel())
    seen = made.sensitivity("azimuth", at) @ to_file @ turn
    wanted = seen.T @ seen / len(seen)
    weights, bound = np.full(candidates.count, 24 / candidates.count), 0.0
    for _ in range(200):
        covariance = np.linalg.inv(information.of(weights))
        slopes = np.einsum(
            "nmi,ij,nmj->n", information.rows, covariance @ wanted @ covariance, information.rows
        )
        value = np.trace(wanted @ covariance)
        bound = max(bound, value - (24 * slopes.max() - weights @ slopes))
        weights = weights * np.sqrt(slopes)
        weights *= 24 / weights.sum()
    assert np.degrees(np.sqrt(bound)) > 1.05 * np.degrees(textbook)
