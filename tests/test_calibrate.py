"""From readings to a record: stated intervals, findings, refusals, rounding, temperature."""

import msgspec
import numpy as np
import pytest
from scipy.special import stdtrit
from scipy.stats import chi2

from mwdcal.calibration.automatic.auto import choose_order
from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings, highest_order, soaks
from mwdcal.calibration.record import Calibration
from mwdcal.calibration.results import readings_at
from mwdcal.errors import FitError, InputError
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import reference_vectors
from mwdcal.planning.plans import grid, run, servo
from mwdcal.sensor.profile import Profile, TriadProfile
from simulation import Tool, plan

PROFILE = Profile(name="test tool")
NOISE = {"accelerometer": np.array(1e-4), "magnetometer": np.array(15.0)}


def make(seed=0, inclinations=(5, 45, 90, 135), toolfaces=12, unknown=(), sd=NOISE, tool=None):
    tool = tool or Tool.random(7)
    inc, azi, face = plan(inclinations, toolfaces)
    a, m = tool.readings(np.random.default_rng(seed), 1, inc, azi, face)
    known = {
        "inclination": inc, "azimuth": azi, "toolface": face,
        "field": np.full(len(inc), tool.field), "dip": np.full(len(inc), tool.dip),
    }  # fmt: skip
    return Readings(a[0], m[0], known={k: v for k, v in known.items() if k not in unknown}, sd=sd)


def many_runs(count, seed, inclinations, toolfaces, unknown=(), sd=NOISE):
    """Readings of `count` runs of one tool."""
    tool = Tool.random(7)
    inc, azi, face = plan(inclinations, toolfaces)
    a, m = tool.readings(np.random.default_rng(seed), count, inc, azi, face)
    known = {
        "inclination": inc, "azimuth": azi, "toolface": face,
        "field": np.full(len(inc), tool.field), "dip": np.full(len(inc), tool.dip),
    }  # fmt: skip
    return Readings(a, m, known={k: v for k, v in known.items() if k not in unknown}, sd=sd)


def half_widths(result, raw):
    """Errors' 95 % half widths (runs, 5, n) at raw readings, written once more.

    Per triad s² times the covariance; Student's t with the degrees of freedom of the triad with the
    fewest, of those that an observable needs. A declared noise never shrinks, and is known where the
    residuals agree with it (chance above 0.05). Also the corrected vectors (runs, n, 6).
    """
    triads = list(zip(result.problem.triads, result.problem.slices(), strict=True))
    size, runs = triads[-1][1].stop, len(result.state.params)
    fields, slopes, scale = [], np.zeros((runs, len(raw[0]), 6, size)), np.ones((runs, size))
    for t, (triad, where) in enumerate(triads):
        params, warmth = result.state.params[:, where], np.zeros((1, len(raw[t])))
        fields.append(triad.model.fields(params, raw[t], warmth))
        slopes[:, :, 3 * t : 3 * t + 3, where] = triad.model.jacobian(params, raw[t], warmth)
        scale[:, where] = np.sqrt(result.analysis.variance_factor[:, t, None])
    square, freedom = (
        result.analysis.variance_factor * result.analysis.freedom,
        result.analysis.freedom,
    )
    confirmed = np.isnan(result.noise) & (chi2.sf(square, freedom) > 0.05)
    scale = np.where(np.isnan(result.noise).any(), np.maximum(scale, 1.0), scale)
    freedoms = np.where(confirmed, np.inf, result.analysis.freedom)
    covariance = result.analysis.covariance * scale[:, :, None] * scale[:, None, :]
    widths = []
    for name in SHOWN:
        rows = np.einsum("bni,bnip->bnp", OBSERVABLES[name].gradient(*fields), slopes)
        square = np.einsum("bnp,bpq,bnq->bn", rows, covariance, rows)
        needed = 1 if name in ("gravity", "inclination") else 2
        freedom = freedoms[:, :needed].min(-1)
        widths.append(np.sqrt(square) * stdtrit(freedom, 0.975)[:, None])
    return np.stack(widths, 1), np.concatenate(fields, -1)


SHOWN = ("gravity", "inclination", "azimuth", "field", "dip")
RUNS = 500


@pytest.mark.slow
@pytest.mark.parametrize("sd", [NOISE, {}], ids=["declared", "estimated"])
@pytest.mark.parametrize(
    "unknown", [(), ("toolface", "dip")], ids=["whole", "toolface and dip unknown"]
)
def test_stated_95_percent_intervals_cover(unknown, sd):
    """12 stations only, so that Student's t matters: 24 degrees of freedom or fewer per triad.

    500 runs fitted at once: the coverage has a standard deviation below 0.4 %. That `calibrate`
    states these intervals is seen on three of them.
    """
    tool = Tool.random(7)
    attitudes = np.radians([[20.0, 60, 100, 150], [10.0, 100, 200, 300], [15.0, 75, 160, 301]])
    g, b = reference_vectors(*attitudes, tool.gravity, tool.field, tool.dip)
    raw = [v @ s.T + o for v, s, o in zip((g, b), tool.matrix, tool.offset, strict=True)]
    data = many_runs(RUNS, 3, (10, 60, 120), 4, unknown, sd)
    result = fit(data, Options())
    assert (result.status == 0).all()
    half, fields = half_widths(result, raw)
    true = np.stack([OBSERVABLES[name].value(g, b) for name in SHOWN])
    found = [OBSERVABLES[name].value(fields[..., :3], fields[..., 3:]) for name in SHOWN]
    covered = np.abs(np.stack(found, 1) - true) < half
    assert covered.mean((1, 2)).std() / np.sqrt(RUNS) < 0.004
    assert 0.938 < covered.mean() < (0.975 if sd else 0.962)
    probe = Readings(*raw)
    for index in (0, 1, 2):
        pair = (data.accelerometer[index], data.magnetometer[index])
        record = calibrate(Readings(*pair, known=data.known, sd=sd), PROFILE)
        stated = [record.expanded_uncertainty(name, probe) for name in SHOWN]
        np.testing.assert_allclose(stated, half[index], rtol=1e-5)


def test_undetermined_outputs_have_no_uncertainty():
    record = calibrate(make(unknown=("toolface",)), PROFILE)
    probe = readings_at(record, np.radians([30.0, 80.0]), 1.0, 0.7)
    assert np.isnan(record.uncertainty("toolface", probe)).all()
    assert np.isnan(record.expanded_uncertainty("toolface", probe)).all()
    for name in ("inclination", "azimuth", "gravity", "field", "dip"):
        assert np.isfinite(record.uncertainty(name, probe)).all()
    assert record.accelerometer.rank == record.magnetometer.rank == 11
    assert [u.id for u in record.accelerometer.undetermined] == ["toolface-zero"]
    assert None in record.accelerometer.standard_uncertainties


def test_a_station_that_moved_is_named():
    data = make()
    raw = data.accelerometer.copy()
    raw[6] += [1e-3, 0, 0]
    record = calibrate(msgspec_replace(data, accelerometer=raw), PROFILE)
    assert [f.station for f in record.findings if f.id == "reshoot"] == ["7"]
    assert [row.station for row in record.station_rows if row.reshoot] == ["7"]


def msgspec_replace(data, **changes):
    from dataclasses import replace

    return replace(data, **changes)


def test_wrong_noise_figure_is_a_finding_and_scales_the_uncertainty():
    honest = calibrate(make(3), PROFILE)
    small = {"accelerometer": np.array(1e-5), "magnetometer": np.array(15.0)}
    record = calibrate(make(3, sd=small), PROFILE)
    assert any(f.id == "accelerometer-residuals" for f in record.findings)
    probe = readings_at(record, 0.8, 1.0, 0.7)
    ratio = record.uncertainty("gravity", probe) / honest.uncertainty("gravity", probe)
    assert 0.8 < ratio < 1.25


def test_every_number_has_twelve_digits_and_a_file_is_the_record():
    record = calibrate(make(), PROFILE)
    again = msgspec.json.decode(msgspec.json.encode(record), type=Calibration)
    assert again == record

    def check(value):
        if isinstance(value, float):
            assert value == float(f"{value:.11e}")
        elif isinstance(value, dict):
            [check(v) for v in value.values()]
        elif isinstance(value, list):
            [check(v) for v in value]

    check(msgspec.to_builtins(record))


REFUSED = {
    "few": (lambda: (make(inclinations=(45,), toolfaces=3), {}), FitError, "stations"),
    "one direction": (lambda: (make(inclinations=(45,), unknown=("toolface",)), {}), FitError, "other inclinations"),
    "dead": (lambda: (dead(), {}), FitError, "does not move"),
    "order without temperature": (lambda: (make(), {"order": 1}), InputError, "temperature_c"),
    "least squares without toolface": (
        lambda: (make(unknown=("toolface",)), {"method": "least-squares"}), FitError, "ref_toolface_deg",
    ),
    "unknown method": (lambda: (make(), {"method": "magic"}), InputError, "joint"),
    "wrong sign": (lambda: (flipped(), {}), FitError, "sign"),
    "no redundancy": (lambda: (make(inclinations=(10, 100), toolfaces=2, sd={}), {}), FitError, "Add stations"),
}  # fmt: skip


def dead():
    data = make()
    raw = data.accelerometer.copy()
    raw[:, 1] = 0.123
    return msgspec_replace(data, accelerometer=raw)


def flipped():
    data = make()
    return msgspec_replace(data, accelerometer=data.accelerometer * [1, 1, -1])


@pytest.mark.parametrize("case", REFUSED)
def test_refusals_say_why(case):
    build, kind, word = REFUSED[case]
    data, options = build()
    with pytest.raises(kind, match=word):
        calibrate(data, PROFILE, Options(**options))


def test_field_known_nowhere_is_calibrated_to_one_and_said_so():
    record = calibrate(make(unknown=("field",)), PROFILE)
    _, b = record.fields(make(5, unknown=("field",)))
    assert np.linalg.norm(b, axis=-1).mean() == pytest.approx(1.0, abs=1e-3)
    assert record.field_unit == "relative (field = 1)"
    assert any(f.id == "field-unknown" for f in record.findings)


def test_gravity_stated_nowhere_is_taken_as_1_g_and_said_so():
    data = make()
    (said,) = [f.text for f in calibrate(data, PROFILE).findings if f.id == "gravity-unknown"]
    assert said.startswith("no station states gravity: 1 g (9.80665 m/s²) is assumed")
    assert said.endswith("Give ref_gravity_g.")
    once = np.where(np.arange(48) == 3, 1.0, np.nan)
    stated = msgspec_replace(data, known={**data.known, "gravity": once})
    for given, options in ((stated, Options()), (data, Options(ignore=("gravity",)))):
        assert not any(
            f.id == "gravity-unknown" for f in calibrate(given, PROFILE, options).findings
        )


def test_unknown_dip_is_a_constant_with_uncertainty():
    found = [calibrate(make(seed, unknown=("dip",)), PROFILE).constants[0] for seed in range(60)]
    errors = np.array([c.value - 65.0 for c in found])
    assert {c.name for c in found} == {"dip"}
    stated = np.mean([c.standard_uncertainty for c in found])
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(stated, rel=0.25)


def hot(seed=1, soak=(25, 55, 85, 115, 145)):
    """A simulated tool with cubic temperature terms over five soaks."""
    rng = np.random.default_rng(seed)
    truth = servo(rng)
    stations = grid([5, 45, 90, 135], 6, [0, 90, 180, 270], list(map(float, soak)))
    data = run(truth, stations, rng)
    return truth, msgspec_replace(data, sd=NOISE, station=())


@pytest.mark.parametrize("course", [0, 1, 2, 3])
def test_temperature_order_is_chosen_by_leaving_soaks_out_simulated(course):
    """The tool drifts by a polynomial of known degree: that degree comes out."""
    rng = np.random.default_rng(course)
    truth = servo(rng)
    linear = np.zeros((2, 6, 4))
    for index, params in enumerate((truth.accelerometer, truth.magnetometer)):
        linear[index] = params[:24].reshape(6, 4)
        linear[index, :, 1:] = 0.0
        for power in range(1, course + 1):
            size = np.array([[0.01] * 3 + [(0.01, 500.0)[index]] * 3]).reshape(6, 1)
            linear[index, :, power : power + 1] = size * rng.choice([-1, 1], (6, 1)) / 60.0**power
    triads = [
        np.concatenate([linear[i].ravel(), p[24:]])
        for i, p in enumerate((truth.accelerometer, truth.magnetometer))
    ]
    truth = msgspec_replace(truth, accelerometer=triads[0], magnetometer=triads[1])
    soak = [25.0, 50.0, 75.0, 100.0, 125.0, 150.0]
    data = run(truth, grid([5, 45, 90, 135], 6, [0, 90, 180, 270], soak), rng)
    data = msgspec_replace(data, sd=NOISE, station=())
    order, table = choose_order(data, Options(), lambda text: None)
    assert order == (course, course)
    chosen = [row for row in table if row.chosen]
    assert [(row.triad, row.order) for row in chosen] == [
        ("accelerometer", course),
        ("magnetometer", course),
    ]
    assert all(row.inside == pytest.approx(1.0, abs=0.5) for row in chosen)
    cold = msgspec_replace(data, temperature=None)
    assert choose_order(cold, Options(), lambda text: None) == (0, [])


def test_each_triad_has_its_own_order_simulated():
    """Only the accelerometer drifts: only it gets temperature terms."""
    rng = np.random.default_rng(5)
    truth = servo(rng)
    still = truth.magnetometer.copy()
    still[:24].reshape(6, 4)[:, 1:] = 0.0
    truth = msgspec_replace(truth, magnetometer=still)
    soak = [25.0, 60.0, 95.0, 130.0]
    data = run(truth, grid([5, 45, 90, 135], 6, [0, 90, 180, 270], soak), rng)
    data = msgspec_replace(data, sd=NOISE, station=())
    order, _ = choose_order(data, Options(), lambda text: None)
    assert order[0] >= 1
    assert order[1] == 0
    record = calibrate(data, PROFILE, Options(order=order))
    assert (record.accelerometer.model, record.magnetometer.model) == ("factors", "polynomial")
    assert record.magnetometer.variance_factor == pytest.approx(1.0, abs=0.35)


def test_factors_of_order_three_recover_the_truth_simulated():
    truth, data = hot(2)
    record = calibrate(data, PROFILE, Options(order=3))
    assert record.accelerometer.size == record.magnetometer.size == 30
    for triad, true in (
        (record.accelerometer, truth.accelerometer),
        (record.magnetometer, truth.magnetometer),
    ):
        assert triad.rank == 30
        sd = np.array(triad.standard_uncertainties, float)
        assert np.sqrt(np.mean(((np.array(triad.parameters) - true) / sd) ** 2)) < 1.6


def test_temperature_outside_and_missing():
    _, data = hot(3)
    record = calibrate(data, PROFILE, Options(order=1))
    assert not record.outside(data).any()
    assert record.outside(msgspec_replace(data, temperature=data.temperature + 200)).all()
    hottest = msgspec_replace(data, temperature=np.full(data.count, data.temperature.max()))
    for added, beyond in ((0.9, False), (1.1, True)):
        moved = msgspec_replace(hottest, temperature=hottest.temperature + added)
        assert record.outside(moved).all() == record.outside(moved).any() == beyond
    with pytest.raises(InputError, match="temperature_c"):
        record.fields(msgspec_replace(data, temperature=None))


def test_without_temperature_terms_a_calibration_holds_for_its_soak():
    """Temperatures up to 5 °C apart are one soak: as far as that from the calibrated ones."""
    data = msgspec_replace(make(), temperature=np.full(48, 25.0))
    record = calibrate(data, PROFILE)
    for temperature, beyond in ((20.1, False), (29.9, False), (19.9, True), (30.1, True)):
        moved = msgspec_replace(data, temperature=np.full(48, temperature))
        assert record.outside(moved).all() == record.outside(moved).any() == beyond


def test_soaks_are_told_apart_by_gaps():
    assert soaks(np.array([100.0, 22.4, 22.6, 101.0, 60.0])).tolist() == [2, 0, 0, 2, 1]


@pytest.mark.parametrize("step", [0.5, 1.0, 2.0, 4.0])
def test_a_ramp_is_cut_into_parts_of_equal_width_that_count_as_soaks(step):
    """A sixth of 120 °C is 20 °C, so that seven parts of 120/7 °C are narrower: by hand, without the program."""
    ramp = np.random.default_rng(0).permutation(np.arange(25.0, 145.1, step))
    assert soaks(ramp).tolist() == np.minimum((ramp - 25) // (120 / 7), 6).tolist()
    assert highest_order(ramp) >= 3
    both = soaks(np.stack([ramp, np.where(ramp > 85, 145.0, 25.0)]))
    assert both[0].tolist() == soaks(ramp).tolist()
    assert both[1].tolist() == (ramp > 85).astype(int).tolist()


def test_what_wanders_around_one_temperature_is_one_soak():
    """A room, a noisy thermometer, a soak that creeps: order 0, and no part of a soak is a soak."""
    rng = np.random.default_rng(1)
    assert highest_order(rng.uniform(20, 22, 48)) == 0
    assert highest_order(rng.uniform(20, 29.9, 48)) == 0
    two = np.repeat([25.0, 145.0], 24) + rng.uniform(-4, 4, 48)
    assert soaks(two).tolist() == [0] * 24 + [1] * 24
    assert highest_order(two) == 1


def test_narrow_span_is_refused_for_a_high_order():
    _, data = hot(4, (20, 22, 24, 25))
    with pytest.raises(FitError, match="span"):
        calibrate(data, PROFILE, Options(order=3))


def test_own_axis_terms_of_the_profile_are_found():
    tool = Tool.random(7)
    inc, azi, face = plan()
    a, m = tool.readings(np.random.default_rng(0), 1, inc, azi, face)
    _, b = reference_vectors(inc, azi, face, 1.0, tool.field, tool.dip)
    bent = m[0] + 300.0 * (b / tool.field) ** 2
    data = msgspec_replace(make(), accelerometer=a[0], magnetometer=bent)
    straight = calibrate(data, PROFILE)
    curved = calibrate(data, Profile(name="bent", magnetometer=TriadProfile(nonlinearity=0.01)))
    assert straight.magnetometer.variance_factor > 5
    assert curved.magnetometer.variance_factor == pytest.approx(1.0, abs=0.4)
    assert curved.magnetometer.size == 18


def test_order_is_chosen_with_groups_of_unknown_direction_in_one_soak_simulated():
    """A left-out group's own direction is found before it is judged."""
    rng = np.random.default_rng(6)
    truth = servo(rng)
    stations = grid([5, 45, 90, 135], 6, [0, 90, 180, 270], [25.0, 60.0, 95.0, 130.0])
    data = run(truth, stations, rng)
    group = np.full(data.count, -1)
    inclination = data.known["inclination"].copy()
    azimuth = data.known["azimuth"].copy()
    for number, first in enumerate((6, 30, 54, 78)):
        group[first : first + 6] = number
        inclination[first : first + 6] = azimuth[first : first + 6] = np.nan
    known = {**data.known, "inclination": inclination, "azimuth": azimuth}
    data = msgspec_replace(data, sd=NOISE, station=(), known=known, group=group)
    order, table = choose_order(data, Options(), lambda text: None)
    assert min(order) >= 1
    assert min(row.inside for row in table if row.order < 3) < 3


def test_two_temperatures_get_a_linear_course_where_it_is_needed_simulated():
    _, data = hot(7, (25, 145))
    said = []
    assert choose_order(data, Options(), said.append)[0] == (1, 1)
    assert "third temperature" in said[-1]


def test_gravity_given_at_some_stations_holds_for_all():
    data = make()
    gravity = np.full(48, np.nan)
    gravity[3] = 0.9978
    partly = msgspec_replace(data, known={**data.known, "gravity": gravity})
    np.testing.assert_allclose(partly.reference("gravity"), 0.9978)


@pytest.mark.parametrize("what", ["columns", "azimuths"])
def test_what_no_sensor_explains_is_refused(what):
    data = make(2)
    if what == "columns":
        data = msgspec_replace(data, magnetometer=5e4 * data.accelerometer)
    else:
        azimuth = np.random.default_rng(0).permutation(data.known["azimuth"])
        data = msgspec_replace(data, known={**data.known, "azimuth": azimuth})
    with pytest.raises(FitError):
        calibrate(data, PROFILE)


def four_faces():
    """Four stations that span space, no more: 12 numbers for 12 parameters of each triad."""
    tool = Tool.random(7)
    inc, azi, face = np.radians([[0.0, 90, 90, 120], [0.0, 20, 140, 260], [0.0, 0, 90, 215]])
    a, m = tool.readings(np.random.default_rng(0), 1, inc, azi, face)
    known = {"inclination": inc, "azimuth": azi, "toolface": face}
    known |= {"field": np.full(4, tool.field), "dip": np.full(4, tool.dip)}
    return Readings(a[0], m[0], known=known, sd=NOISE)


def test_no_redundancy_is_a_finding():
    record = calibrate(four_faces(), PROFILE)
    assert any(f.id == "no-redundancy" for f in record.findings)


@pytest.mark.parametrize("times", [1.0, 10.0])
def test_noise_declared_far_too_large_is_named(times):
    sd = {name: times * np.asarray(value) for name, value in NOISE.items()}
    found = {f.id for f in calibrate(make(sd=sd), PROFILE).findings}
    named = {"accelerometer-noise", "magnetometer-noise"} & found
    assert len(named) == (2 if times > 1 else 0)


def test_stations_that_are_copies_are_named():
    data = make()
    assert not any(f.id == "repeated-readings" for f in calibrate(data, PROFILE).findings)
    place = np.arange(48)
    place[[9, 20]] = 2
    a, m = data.accelerometer[place], data.magnetometer[place]
    known = {name: values[place] for name, values in data.known.items()}
    copied = msgspec_replace(data, accelerometer=a, magnetometer=m, known=known)
    found = calibrate(copied, PROFILE).findings
    [copies] = [f.text for f in found if f.id == "repeated-readings"]
    assert copies.startswith("station 10, 21: the same readings as an earlier station")


def test_free_turn_and_its_course_with_temperature_are_named_simulated():
    _, data = hot(8)
    blank = np.full(data.count, np.nan)
    data = msgspec_replace(data, known={**data.known, "toolface": blank})
    record = calibrate(data, PROFILE, Options(model="polynomial", order=2))
    assert [u.id for u in record.accelerometer.undetermined] == [
        "toolface-zero",
        "toolface-zero-temperature-1",
        "toolface-zero-temperature-2",
    ]
    assert record.accelerometer.rank == 33
