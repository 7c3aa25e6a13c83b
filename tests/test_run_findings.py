"""Findings about what a run cannot show: copies of stations, the hemisphere, unknown gravity."""

import re
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from scipy import stats

from mwdcal.calibration.automatic.auto import choose_order
from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.copies import (
    AGREEING,
    agreement,
    in_fit,
    repeated,
    resolution,
)
from mwdcal.calibration.diagnosis.plausibility import stations_to_reshoot
from mwdcal.calibration.diagnosis.structure import shown_effects
from mwdcal.calibration.estimate import fit, solve
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings, fingerprints
from mwdcal.calibration.record import STATE_STAND
from mwdcal.calibration.residuals import chances
from mwdcal.errors import FitError
from mwdcal.estimation.uncertainty import analyse, left_out_variances
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.presentation.typed import leading_findings
from mwdcal.sensor.profile import Profile
from mwdcal.survey.well import unknown_gravity
from simulation import DEG, Tool, attitude, plan

PROFILE = Profile(name="test tool")
NOISE = {"accelerometer": np.array(1e-4), "magnetometer": np.array(15.0)}


def run(
    seed=0,
    repeats=1,
    counts=None,
    unknown=(),
    toolfaces=12,
    sd=NOISE,
    inclinations=(5, 45, 90, 135),
    turning=1.0,
):
    """A run, each of its attitudes measured `repeats` times, rounded to `counts` times the noise."""
    tool = Tool.random(seed + 3)
    inc, azi, face = (np.tile(each, repeats) for each in plan(inclinations, toolfaces))
    azi = turning * azi
    rng = np.random.default_rng(seed)
    triads = [each[0] for each in tool.readings(rng, 1, inc, azi, face)]
    if counts:
        steps = [counts * noise for noise in tool.noise]
        triads = [np.round(t / step) * step for t, step in zip(triads, steps, strict=True)]
        sd = {name: np.hypot(1.0, counts / np.sqrt(12)) * noise for name, noise in sd.items()}
    known = {"inclination": inc, "azimuth": azi, "toolface": face}
    known |= {"field": np.full(len(inc), tool.field), "dip": np.full(len(inc), tool.dip)}
    return Readings(*triads, known={k: v for k, v in known.items() if k not in unknown}, sd=sd)


def found(data):
    return {finding.id: finding.text for finding in calibrate(data, PROFILE).findings}


def copied(data, times, step, of=slice(None)):
    """The run with copies of some stations appended that differ by `step` noises each."""
    grow = [np.concatenate([getattr(data, n)] + [getattr(data, n)[of] + (k + 1) * step * float(NOISE[n])
            for k in range(times)]) for n in NOISE]  # fmt: skip
    known = {n: np.concatenate([v] + [v[of]] * times) for n, v in data.known.items()}
    return Readings(*grow, known=known, sd=data.sd)


@pytest.mark.parametrize("sd", [NOISE, {}], ids=["declared", "estimated"])
@pytest.mark.parametrize("step", [0.0, 1e-5, 5e-3])
def test_copies_are_named_whatever_their_last_digits(step, sd):
    assert "repeated-readings" not in found(run(sd=sd))
    assert "repeated-readings" in found(copied(run(sd=sd), 3, step))
    text = found(copied(run(sd=sd), 1, step, of=slice(4, 5)))["repeated-readings"]
    assert text.startswith("station 49: ")


@pytest.mark.parametrize("counts", [None, 0.3, 1.0, 3.0, 20.0])
@pytest.mark.parametrize("times", [1.0, 10.0])
def test_repeated_attitudes_are_no_copies(counts, times):
    """Three measurements at each attitude, with noise as it is and declared ten times too large.

    In coarse counts they often agree to the last digit.
    """
    for seed in range(3):
        data = run(seed, repeats=3, counts=counts)
        data = replace(data, sd={name: times * sd for name, sd in data.sd.items()})
        assert "repeated-readings" not in found(data)


def test_one_copied_station_in_counts_finer_than_the_noise_is_named():
    data = run(counts=0.3)
    assert "repeated-readings" in found(copied(data, 1, 0.0, of=slice(7, 8)))


def repeating(data, place, step=0.0):
    """A run whose stations are those of `place`, later ones of the same number off by `step` noises."""
    again = np.array([n in place[:i] for i, n in enumerate(place)])[:, None]
    triads = {n: getattr(data, n)[place] + again * step * float(NOISE[n]) for n in NOISE}
    rows = {n: v[place] for n in ("group", "temperature") if (v := getattr(data, n)) is not None}
    known, sd = (
        {n: v[place] if np.ndim(v) else v for n, v in x.items()} for x in (data.known, data.sd)
    )
    return replace(
        data, **triads, **rows, known=known, sd=sd, digest=fingerprints([*triads.values()])
    )


def drifting(data):
    """The run with offsets that drift by twenty noises."""
    course = np.linspace(0, 20, data.count)[:, None]
    return replace(data, **{n: getattr(data, n) + course * NOISE[n] for n in NOISE})


def warmed(seed):
    """A run at three temperatures, whose offsets follow these."""
    data = run(seed, repeats=3, toolfaces=8)
    temperature = np.repeat([20.0, 60.0, 100.0], 32)
    moved = {n: getattr(data, n) + 0.5 * temperature[:, None] * NOISE[n] for n in NOISE}
    return replace(data, **moved, temperature=temperature)


def on_stand(seed, practice):
    """A run on a stand with errors, whose settings of inclination and azimuth serve twelve stations each."""
    data = run(seed, turning=0.0)
    sd = {name: np.full(48, 2e-3) for name in ("inclination", "azimuth")}
    return replace(data, sd={**data.sd, **sd, "tilt": np.full(48, 1e-3)}, settings=practice)


def partly_known(seed):
    """Roll sets in directions that a few stations know, gravity stated at some."""
    data = roll_sets(63, known=("azimuth", "dip"))
    gravity = np.where(np.arange(48) % 5 == 0, 1 + np.arange(48) * 1e-5, np.nan)
    return replace(data, known={**data.known, "gravity": gravity}, sd={})


RUNS = {
    "declared": (run, {}),
    "estimated": (lambda seed: run(seed, sd={}), {}),
    "robust": (run, {"robust": "huber"}),
    "order": (warmed, {"exclude": ("5", "40")}),
    "drift": (lambda seed: drifting(run(seed)), {}),
    "drift, estimated": (lambda seed: drifting(run(seed, sd={})), {}),
    "settings of directions": (lambda seed: on_stand(seed, "per-direction"), {}),
    "settings, unstated": (lambda seed: on_stand(seed, ""), {}),
    "stand": (run, {"estimate": ("azimuth-zero",)}),
    "groups": (partly_known, {}),
    "least squares": (run, {"method": "least-squares"}),
}  # fmt: skip


@pytest.mark.parametrize("step", [0.0, 1e-5])
@pytest.mark.parametrize("name", RUNS)
def test_a_run_with_copies_is_calibrated_as_the_run_without_them(name, step):
    """Copies of some stations behind these, or of all at the end: all figures of the record, to 12 digits."""
    make, chosen = RUNS[name]
    data, options = make(1), Options(**chosen)
    digest = fingerprints([data.accelerometer, data.magnetometer])
    data = replace(data, station=data.labels, digest=digest)
    bare, every = calibrate(data, PROFILE, options), np.arange(data.count)
    fitted = np.array([name not in options.exclude for name in data.labels])
    for place in (np.sort(np.append(every, [3, 3, 20])), np.append(every, every[fitted])):
        first = np.unique(place, return_index=True)[1]
        label = [f"{n + 1}" if i in first else f"{n + 1} again, {i}" for i, n in enumerate(place)]
        copied = replace(repeating(data, place, step), station=tuple(label))
        made = calibrate(copied, PROFILE, options)
        left = [name for name in label if "again" in name]
        [said] = [f for f in made.findings if f.id == "repeated-readings"]
        assert said.text.startswith(f"station {', '.join(left[:3])}")
        assert f": {len(left)} of {len(label) - len(options.exclude)} stations" in said.text
        assert made.excluded == [*options.exclude, *left]
        assert made.used(copied.digest) == [name not in options.exclude for name in label]
        same = {n: getattr(bare, n) for n in ("excluded", "copies", "time", "sha256")}
        rest = [finding for finding in made.findings if finding != said]
        assert msgspec.structs.replace(made, findings=rest, **same) == bare


def test_a_run_that_cannot_do_without_its_copies_is_refused():
    """Copies at another temperature, which alone make an order of 1."""
    data, every = run(), np.arange(48)
    warm = replace(data, temperature=np.full(48, 20.0))
    twice = repeating(warm, np.append(every, every))
    twice = replace(twice, temperature=np.repeat([20.0, 60.0], 48))
    with pytest.raises(FitError, match="too little for `order` 1"):
        calibrate(twice, PROFILE, Options(order=1))


def test_resolution_is_the_step_of_counts_and_none_of_real_numbers():
    rng = np.random.default_rng(0)
    for step in (0.02, 0.7, 5.0):
        counts = rng.integers(-30000, 30000, 48) * step + 0.123
        assert resolution(counts) == pytest.approx(step, rel=1e-6)
    assert resolution(rng.normal(0, 1e4, 48)) == 0.0
    assert resolution(np.ones(5)) == 0.0


def roll_sets(dip, sign=1.0, known=()):
    """Six roll sets in unknown directions; `sign` turns the magnetometer's."""
    tool = replace_dip(Tool.random(5), dip)
    rng = np.random.default_rng(5)
    inc = np.repeat([12.0, 48, 88, 91, 133, 60], 8) * DEG
    azi = np.repeat(rng.uniform(0, 360, 6), 8) * DEG
    face = np.tile(np.arange(8) * 45.0, 6) * DEG
    a, m = (each[0] for each in tool.readings(rng, 1, inc, azi, face))
    values = {
        "azimuth": np.where(np.arange(48) < 8, azi, np.nan),
        "dip": np.full(48, sign * tool.dip),
    }
    group = np.repeat(np.arange(6), 8)
    return Readings(a, sign * m, known={n: values[n] for n in known}, sd=NOISE, group=group)


def replace_dip(tool, dip):
    return Tool(tool.matrix, tool.offset, dip=dip * DEG)


@pytest.mark.parametrize(("dip", "sign", "site"), [(63, 1, "northern"), (63, -1, "southern"),
                                                   (-55, 1, "southern"), (-55, -1, "northern")])  # fmt: skip
def test_the_hemisphere_that_only_signs_tell_is_never_chosen_in_silence(dip, sign, site):
    record = calibrate(roll_sets(dip, sign), PROFILE)
    named = [f for f in record.findings if f.id == "hemisphere"]
    assert record.earth["dip_deg"] == pytest.approx(sign * dip, abs=0.2)
    assert bool(named) == (site == "southern")
    assert f"signs of the magnetometer at a {site} site" in record.assumed_exact


@pytest.mark.parametrize("known", ["azimuth", "dip"])
def test_a_reference_of_dip_or_azimuth_confirms_the_hemisphere(known):
    record = calibrate(roll_sets(-55, known=(known,)), PROFILE)
    assert not any(f.id == "hemisphere" for f in record.findings)
    assert not any("signs" in name for name in record.assumed_exact)


@pytest.mark.parametrize("gravity", [None, np.ones(48), np.full(48, 0.9985)])
def test_gravity_of_one_that_is_stated_is_known(gravity):
    data = run()
    known = data.known if gravity is None else {**data.known, "gravity": gravity}
    record = calibrate(replace(data, known=known), PROFILE)
    assert unknown_gravity(record) == (gravity is None)


@pytest.mark.parametrize("count", [20, 256, 600])
def test_copies_are_the_stations_near_an_earlier_one(count):
    """Against a tree of neighbours; some stations are there twice, and one three times."""
    from scipy.spatial import KDTree

    rng = np.random.default_rng(count)
    rows = 300.0 * rng.standard_normal((count, 6))
    rows[[3, count // 2, count - 1]] = rows[[1, 0, 0]]
    rows[count - 2] = rows[2] + 0.9 * AGREEING * rng.choice([-1, 1], 6)
    rows[count - 3] = rows[2] + 1.1 * AGREEING
    pairs = KDTree(rows).query_pairs(AGREEING * 6**0.5)
    expected = np.isin(np.arange(count), [max(pair) for pair in pairs])
    np.testing.assert_array_equal(repeated(rows), expected)
    assert expected.sum() == 4
    assert not repeated(300.0 * rng.standard_normal((count, 6))).any()


@pytest.mark.parametrize("steps", [(0, 0, 0), (2, 0, 0), (0.6, 2, 0)])
def test_the_chance_that_two_measurements_agree_is_that_of_pairs_that_are_drawn(steps, monkeypatch):
    """Of readings in counts, by the largest chance at any place between two counts."""
    monkeypatch.setattr("mwdcal.calibration.copies.AGREEING", 0.15)
    rng, size = np.random.default_rng(0), 400_000
    drawn = []
    for place in (0.0, 0.5):
        pair = rng.standard_normal((2, size, 3)) + place * np.array(steps)
        for k, step in enumerate(steps):
            if step:
                pair[..., k] = np.round(pair[..., k] / step) * step
        drawn.append(np.mean(np.sum((pair[0] - pair[1]) ** 2, -1) <= 3 * 0.15**2))
    chance = agreement(np.array(steps, float))
    assert chance > max(drawn) - 3 * np.sqrt(max(drawn) / size)
    assert chance < 2.5 * max(drawn)


def test_a_run_pasted_twice_is_calibrated_as_it_was_measured_once():
    """Last digits changed by a hundredth of the noise, by a tenth of it, and by all of it."""
    data, rng, labels = run(sd={}), np.random.default_rng(1), []
    for share in (0.02, 1.0):
        jitter = {n: share * float(NOISE[n]) * rng.standard_normal((48, 3)) for n in NOISE}
        triads = {
            n: np.concatenate([getattr(data, n), getattr(data, n) + jitter[n]]) for n in NOISE
        }
        known = {n: np.tile(v, 2) for n, v in data.known.items()}
        made = calibrate(replace(data, **triads, known=known), PROFILE)
        labels.append(made.excluded)
    assert labels == [[str(n) for n in range(49, 97)], []]


TEST = np.arange(12, 24)
"""Stations of the run of 48 that a roll test repeats: a turn of toolface at 45°."""


def rolled_again(data, change):
    """A calibration of a run, and readings of `TEST` after a `change` of both triads."""
    digest = fingerprints([data.accelerometer, data.magnetometer])
    record = calibrate(replace(data, digest=digest), PROFILE)
    triads = [change(getattr(data, name)[TEST], float(NOISE[name])) for name in NOISE]
    known = {n: v[TEST] for n, v in data.known.items()}
    return record, Readings(*triads, known=known, digest=fingerprints(triads))


CHANGES = {
    "as it is": lambda v, noise: v,
    "rounded to a tenth of the noise": lambda v, noise: np.round(v / noise, 1) * noise,
    "another unit and back": lambda v, noise: np.round(v * 9.80665, 7) / 9.80665,
    "backwards, with jitter": lambda v, noise: v[::-1] + 1e-2 * noise * np.sin(np.arange(36)).reshape(12, 3),
    "one triad rounded to the noise": lambda v, noise: np.round(v / noise, 1 if noise > 1 else 0) * noise,
}  # fmt: skip


@pytest.mark.parametrize("sd", [NOISE, {}], ids=["declared", "estimated"])
@pytest.mark.parametrize("change", CHANGES)
def test_rows_of_the_fit_are_known_whatever_their_digits(change, sd):
    record, test = rolled_again(run(sd=sd), CHANGES[change])
    assert in_fit(record, test).all()
    rows = [msgspec.structs.replace(r, readings=msgspec.UNSET) for r in record.station_rows]
    earlier = msgspec.structs.replace(record, station_rows=rows)
    assert in_fit(earlier, test).all() == (change == "as it is")


@pytest.mark.parametrize(("counts", "times"), [(None, 1), (None, 9), (0.3, 1), (1.0, 1)])
def test_readings_anew_at_the_settings_of_the_fit_are_no_copies(counts, times):
    """Also where they repeat nine times better than the noise that is declared, and residuals show."""
    for seed in range(20):
        data, rng = run(seed, counts=counts), np.random.default_rng(100 + seed)

        def anew(values, noise, rng=rng):
            clean = values + np.sqrt(2) / times * noise * rng.standard_normal(values.shape)
            return np.round(clean / (counts * noise)) * counts * noise if counts else clean

        record, test = rolled_again(data, anew)
        assert not in_fit(record, test).any()


def test_the_chance_that_a_sound_test_is_refused_is_the_one_stated():
    """At readings that repeat as well as `REPEATING` allows, of both triads and of one, in many draws."""
    from mwdcal.calibration.copies import _agreeing

    rng, draws = np.random.default_rng(5), 4000
    for size in (3, 6):
        others = 1e4 * rng.standard_normal((48, size))
        refused = sum(
            _agreeing(
                others[TEST] + np.sqrt(2) * rng.standard_normal((12, size)), others, 0.05
            ).any()
            for _ in range(draws)
        )
        assert 0.1 * 0.05 < refused / draws < 0.05 + 3 * np.sqrt(0.05 / draws)


def with_noise(data, seed, **times):
    """The run with so many times the noise on the axes of some triads."""
    rng = np.random.default_rng(seed)
    moved = {
        name: getattr(data, name)
        + np.sqrt(np.array(more) ** 2 - 1.0) * float(NOISE[name]) * rng.standard_normal((48, 3))
        for name, more in times.items()
    }
    return replace(data, **moved)


@pytest.mark.parametrize("sd", [NOISE, {}], ids=["declared", "estimated"])
@pytest.mark.parametrize(
    ("triad", "times"), [("accelerometer", (1, 1, 4)), ("magnetometer", (2, 5, 1))]
)
def test_an_axis_of_another_noise_is_named(triad, times, sd):
    """With the ratio that regressions of each channel on the reference vectors leave, and SciPy's F."""
    data = with_noise(run(sd=sd), 1, **{triad: times})
    text = found(data)[f"{triad}-axis-noise"]
    vectors = attitude(*(data.known[n] for n in ("inclination", "azimuth", "toolface")))
    vector = vectors(1.0, 1.0, data.known["dip"][0])[triad == "magnetometer"]
    design = np.c_[vector, np.ones(48)]
    left = np.linalg.lstsq(design, getattr(data, triad))[1] / 44
    most, least = "xyz"[left.argmax()], "xyz"[left.argmin()]
    ratio = left.max() / left.min()
    figures = r".* along (.) are ([0-9.]+) times those along (.) \(chance in equal noise (.*?)\)"
    larger, times, smaller, chance = re.match(figures, text).groups()
    assert (larger, smaller) == (most, least)
    assert float(times) == pytest.approx(ratio**0.5, rel=0.1)  # stations to re-shoot are left out
    assert np.log(float(chance)) == pytest.approx(np.log(6 * stats.f.sf(ratio, 44, 44)), rel=0.1)
    other = {"accelerometer": "magnetometer", "magnetometer": "accelerometer"}[triad]
    assert f"{other}-axis-noise" not in found(data)


def test_an_unstated_stand_is_named_before_other_causes():
    """Of unequal axes, of residuals beyond the declared noise, and among what is assumed exact."""
    data = with_noise(run(sd=NOISE), 1, accelerometer=(1, 1, 4))
    stated = replace(data, sd={**data.sd, "toolface": np.full(48, 1e-6)})
    for each, named in ((data, True), (stated, False)):
        texts = found(each)
        for name in ("axis-noise", "residuals"):
            assert (STATE_STAND in texts[f"accelerometer-{name}"]) == named
        assumed = calibrate(each, PROFILE).assumed_exact
        assert (assumed[0] == "angles of the stand") == named


ERROR, PER = 0.02, np.degrees(1.0)


@pytest.mark.parametrize("sd", [NOISE, {}], ids=["declared", "estimated"])
@pytest.mark.parametrize("name", ["inclination", "azimuth", "toolface"])
def test_degrees_that_were_given_as_radians_are_named(name, sd):
    """A stand with errors of 0.02° at every station, of which one σ is 0.02 rad: 57 times too much."""
    data, errors = run(sd=sd), np.random.default_rng(7)
    known = {n: each.copy() for n, each in data.known.items()}
    angles = ("inclination", "azimuth", "toolface")
    for each in angles:
        known[each] += errors.normal(0, ERROR / PER, 48)
    known["inclination"] = np.abs(known["inclination"])
    right = {**data.sd, **{each: np.full(48, ERROR / PER) for each in angles}}
    data = replace(data, known=known, settings="per-station")
    assert "stand-too-large" not in found(replace(data, sd=right))
    wrong = replace(data, sd={**right, name: np.full(48, ERROR)})
    assert "radians" not in found(wrong)["stand-too-large"]
    text = found(replace(wrong, in_radians=angles))["stand-too-large"]
    assert f"{name} {ERROR * PER:.2g}° (errors 0.0" in text
    assert f"'{name}' is in radians: 0.02 rad is 1.15°" in text
    assert [each for each in angles if f"{each} 1.1°" in text] == [name]


def test_a_coarse_stand_whose_errors_are_as_large_is_not_too_large():
    for seed in range(5):
        data, rng = run(seed, sd=NOISE), np.random.default_rng(seed)
        known, size = dict(data.known), 1.0 / PER
        known["toolface"] = known["toolface"] + rng.normal(0, size, 48)
        sd = {**data.sd, "toolface": np.full(48, size)}
        assert "stand-too-large" not in found(replace(data, known=known, sd=sd))


def test_angles_without_uncertainty_beside_uncertain_ones_are_assumed_exact():
    data = run(sd={**NOISE, "inclination": np.full(48, 1e-4)})
    assert calibrate(data, PROFILE).assumed_exact[:2] == [
        "azimuth of the stand",
        "toolface of the stand",
    ]
    without = calibrate(replace(data, magnetometer=None), PROFILE).assumed_exact
    assert "azimuth of the stand" not in without
    assert "toolface of the stand" in without


def test_axes_of_one_noise_are_not_named():
    for seed in range(10):
        for sd in (NOISE, {}):
            assert not [name for name in found(run(seed, sd=sd)) if name.endswith("axis-noise")]


def test_noise_by_axis_that_is_declared_is_not_named():
    times = {"accelerometer": (1, 1, 4)}
    sd = {**NOISE, "accelerometer": np.tile([1e-4, 1e-4, 4e-4], (48, 1))}
    assert "accelerometer-axis-noise" not in found(with_noise(run(sd=sd), 1, **times))


@pytest.mark.parametrize("own", [False, True], ids=["of the run", "of the readings"])
def test_readings_have_the_noise_that_the_run_shows(own):
    """Not the third of it that the run declares; where residuals agree with what is declared, just that."""
    loud = dict.fromkeys(NOISE, (3, 3, 3))
    for data, times in ((with_noise(run(), 1, **loud), 3.0), (run(), 1.0)):
        record = calibrate(data, PROFILE)
        still = replace(data[20:21], known={}, sd=NOISE if own else {})
        many = Readings(*(np.repeat(getattr(still, n), 4000, 0) for n in NOISE), sd=still.sd)
        noisy = {
            n: getattr(many, n)
            + times * float(NOISE[n]) * np.random.default_rng(k).standard_normal((4000, 3))
            for k, n in enumerate(NOISE)
        }
        for name in ("inclination", "azimuth", "gravity", "field"):
            scatter = np.std(OBSERVABLES[name].value(*record.fields(replace(many, **noisy))))
            sd = [record.uncertainty(name, still, noise=noise)[0] for noise in (True, False)]
            assert np.sqrt(sd[0] ** 2 - sd[1] ** 2) == pytest.approx(scatter, rel=0.15)


def few_stations(seeds, sd, error=0.0, inclinations=(45, 100)):
    """Runs of four toolfaces, one station of which is off by `error` noises on every axis of the magnetometer."""
    runs = [run(seed, toolfaces=4, inclinations=inclinations, sd=sd) for seed in range(seeds)]
    station = np.arange(seeds) % runs[0].count
    magnetometer = np.stack([data.magnetometer for data in runs])
    magnetometer[np.arange(seeds), station] += error * float(NOISE["magnetometer"])
    known = {name: np.stack([data.known[name] for data in runs]) for name in runs[0].known}
    sd = {name: np.full((seeds, 1, 1), value) for name, value in sd.items()}
    accelerometer = np.stack([data.accelerometer for data in runs])
    return Readings(accelerometer, magnetometer, known=known, sd=sd), station


def chance_left_out(raw, target, station):
    """Chance of a station's residual by the linear fits with it and without: Fisher's F of the extra sum of squares."""
    design = np.column_stack([target, np.ones(len(target))])
    squares = []
    for rows in (np.ones(len(raw), bool), np.arange(len(raw)) != station):
        left = raw[rows] - design[rows] @ np.linalg.lstsq(design[rows], raw[rows])[0]
        squares.append(np.sum(left**2))
    rest = 3 * (len(raw) - 1 - 4)
    return stats.f.sf((squares[0] - squares[1]) / 3 / (squares[1] / rest), 3, rest)


def test_a_station_is_judged_by_the_noise_in_the_fit_without_it():
    """The model of a triad is its inverse: what the readings are of the field, to first order the same F."""
    data, station = few_stations(6, {}, 20.0)
    found = chances(fit(data))
    inc, azi, face = (data.known[name][0] for name in ("inclination", "azimuth", "toolface"))
    dip, field = data.known["dip"][0, 0], data.known["field"][0, 0]
    targets = attitude(inc, azi, face)(1.0, field, dip)
    raws = data.accelerometer, data.magnetometer
    for place, bad in enumerate(station):
        pair = [chance_left_out(raw[place], t, bad) for raw, t in zip(raws, targets, strict=True)]
        assert np.log(found[place, bad]) == pytest.approx(np.log(2 * min(pair)), abs=0.1)


@pytest.mark.parametrize("stand", [0.0, 0.02])
def test_noise_without_a_station_is_that_of_a_fit_without_it(stand):
    data, station = few_stations(3, {}, 20.0)
    data = replace(
        data, sd={name: np.full((3, 8), stand * DEG) for name in ("inclination", "azimuth")}
    )
    result, tools = fit(data), np.arange(3)
    problem, state = result.problem, result.state
    found = left_out_variances(problem, state, result.analysis, tools, station)
    include = problem.evidence.include.copy()
    include[tools, station] = 0.0
    fewer = replace(problem, evidence=replace(problem.evidence, include=include))
    again = analyse(fewer, solve(fewer, state, Options()).state)
    np.testing.assert_allclose(found[0], again.variance_factor, rtol=2e-3)
    np.testing.assert_allclose(found[1], again.freedom, rtol=1e-3)


@pytest.mark.parametrize("sd", [NOISE, {}], ids=["declared", "estimated"])
def test_a_gross_error_of_one_of_eight_stations_is_named(sd):
    data, station = few_stations(40, sd, 50.0)
    named = stations_to_reshoot(fit(data))
    assert named[np.arange(40), station].all()


def test_sound_runs_of_eight_stations_rarely_name_one():
    """One in a hundred: more than 12 of 400 would happen with a chance of 0.1 %."""
    named = stations_to_reshoot(fit(few_stations(400, {})[0])).any(-1)
    assert 0 < named.sum() <= 12


def test_a_wrong_station_is_no_structure_of_the_other_triad():
    """Its error is in the noise of the magnetometer: beside that the accelerometer looks worse than it is."""
    data, station = few_stations(100, {}, 50.0, inclinations=(5, 60, 120))
    result = fit(data)
    assert stations_to_reshoot(result)[np.arange(100), station].all()
    assert sum(map(bool, shown_effects(result, {}))) <= 1
    assert stations_to_reshoot(result)[np.arange(100), station].all()


@pytest.mark.parametrize(("curved", "orders"), [(200.0, (2, 2)), (0.0, (2, 0))])
def test_a_precise_accelerometer_does_not_hide_terms_of_the_magnetometer(curved, orders):
    """Offsets follow the square of the temperature on an uncertain stand; 1e-8 g is far less than its angles show."""
    tool, rng = Tool.random(0, noise=(1e-8, 15.0)), np.random.default_rng(5)
    angles = [np.tile(each, 5) for each in plan((5, 60, 120), 6)]
    warmth = np.repeat([20.0, 45.0, 70.0, 95.0, 120.0], 18)
    stand = 0.02 * DEG
    attitudes = [each + stand * rng.normal(size=90) for each in angles]
    course = np.outer((warmth - 70) / 50, [1, -1, 0.5]) + np.outer(
        ((warmth - 70) / 50) ** 2, [0.5, 0.6, -0.4]
    )
    accelerometer, magnetometer = (each[0] for each in tool.readings(rng, 1, *attitudes))
    known = dict(zip(("inclination", "azimuth", "toolface"), angles, strict=True))
    sd = dict.fromkeys(known, np.full(90, stand))
    known |= {"field": np.full(90, tool.field), "dip": np.full(90, tool.dip)}
    data = Readings(
        accelerometer + 1e-3 * course,
        magnetometer + curved * course,
        known={**known, "gravity": np.ones(90)},
        sd={**sd, "accelerometer": np.array(1e-8), "magnetometer": np.array(15.0)},
        temperature=warmth,
    )
    chosen, _ = choose_order(data, Options(model="polynomial"), lambda text: None)
    assert chosen == orders


@pytest.mark.parametrize("gravity", [1.0, 0.9965, 1.0036, 1.0123, 0.98066])
def test_a_gravity_that_no_place_on_land_has_is_named(gravity):
    """On land 9.764 to 9.834 m/s²: Hirt et al., Geophys. Res. Lett. 40 (2013) 4279."""
    data = run()
    data = replace(data, known={**data.known, "gravity": np.full(data.count, gravity)})
    outside = not 9.764 <= 9.80665 * gravity <= 9.834
    assert ("gravity-reference" in found(data)) == (outside and gravity != 1.0036)


UNSTATED = {"gravity-unknown", "no-serial"}
"""Findings on what the runs here do not state."""


def on_directions(data, azimuths=(0, 90, 180, 270)):
    """The run with one azimuth for the toolfaces of each inclination; the tool is read where it stands."""
    tool, count = Tool.random(3), data.count // len(azimuths)
    inc, face = data.known["inclination"], data.known["toolface"]
    azi = np.repeat(np.asarray(azimuths) * DEG, count)
    triads = [each[0] for each in tool.readings(np.random.default_rng(1), 1, inc, azi, face)]
    return replace(
        data,
        accelerometer=triads[0],
        magnetometer=triads[1],
        known={
            **data.known,
            "azimuth": azi,
            "field": np.full(data.count, tool.field),
            "dip": np.full(data.count, tool.dip),
        },
    )


def misread(data, error, of, angle="azimuth"):
    """The run with the stand's `angle` of some stations typed wrong by an `error`, degrees."""
    wrong = data.known[angle].copy()
    wrong[of] += error * DEG
    return replace(data, known={**data.known, angle: wrong})


def test_of_several_stations_to_take_again_the_worst_comes_first():
    data = misread(misread(run(), 1.5, 9), 2.0, 40)
    again = [f.station for f in calibrate(data, PROFILE).findings if f.id == "reshoot"]
    assert again == ["41", "10"]


@pytest.mark.parametrize("sd", [NOISE, {}], ids=["declared", "estimated"])
@pytest.mark.parametrize("error", [0.5, 1.0, 10.0])
def test_a_wrong_setting_is_named_first_with_its_error(error, sd):
    """A setting declared to 0.06° and typed wrong at all of its twelve stations, or at one of them."""
    stand = {name: np.full(48, 1e-3) for name in ("inclination", "azimuth")}
    data = replace(run(), sd={**sd, **stand}, settings="per-direction")
    turned = on_directions(data)
    whole = calibrate(misread(turned, error, slice(24, 36)), PROFILE).findings
    first = leading_findings(whole)[0][0]
    assert first.id == "settings"
    [value] = re.findall(r"azimuth of stations 25 to 36 (\S+)° from", first.text)
    assert float(value) == pytest.approx(-error, rel=0.15)
    one = calibrate(misread(turned, error, 30), PROFILE).findings
    assert leading_findings(one)[0][0].station == "31"


@pytest.mark.parametrize("angle", ["azimuth", "inclination"])
def test_residuals_that_look_like_settings_name_the_one_to_check(angle):
    data = run(sd={}, inclinations=(5, 40, 75, 110, 145))
    turned = on_directions(data, (0, 72, 144, 216, 288))
    assert (
        f"Check the {angle} of stations 25 to 36 first."
        in found(misread(turned, 0.5, slice(24, 36), angle))["looks-like-settings"]
    )


def test_the_size_of_an_effect_is_in_the_unit_that_it_states():
    """In a run without field strength per mille of the field: as many nT of 48,000 nT, by the same run with it."""
    data = run(sd={}, inclinations=(5, 40, 75, 110, 145))
    wrong = misread(on_directions(data, (0, 72, 144, 216, 288)), 0.5, slice(24, 36))
    without = {name: values for name, values in wrong.known.items() if name != "field"}
    sizes = [
        found(each)["looks-like-settings"]
        for each in (wrong, replace(wrong, known=without, magnetometer=wrong.magnetometer))
    ]
    [nt] = re.findall(r"and (\S+) nT rms", sizes[0])
    [share] = re.findall(r"and (\S+) ‰ of the field rms", sizes[1])
    field = np.median(wrong.known["field"])
    assert float(share) == pytest.approx(float(nt) / field * 1e3, rel=0.3)
    assert all("first state their 1σ" in text for text in sizes)


@pytest.mark.parametrize("error", [0.0, 1.0])
def test_two_directions_hide_a_wrong_angle_and_the_run_says_so(error):
    """At 45° and at 90° inclination, a quarter of a turn apart, the sensors take up a wrong setting."""
    data = on_directions(run(inclinations=(45, 90)), (0, 90))
    for angle in ("azimuth", "inclination"):
        named = found(misread(data, error, slice(12, 24), angle)).keys()
        assert named - UNSTATED == {"few-directions"}


@pytest.mark.parametrize("inclinations", [(5, 60, 120), (5, 45, 90, 135)])
def test_more_directions_are_not_few(inclinations):
    data = on_directions(run(inclinations=inclinations), 90 * np.arange(len(inclinations)))
    assert found(data).keys() <= UNSTATED
