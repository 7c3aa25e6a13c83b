"""Wrong axes in the profile: refused, with the axes that fit; fields and errors nowhere on Earth."""

from dataclasses import replace
from itertools import permutations, product

import numpy as np
import pytest

from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.diagnosis.flags import FittedRuns
from mwdcal.calibration.diagnosis.plausibility import excessive_errors, straying
from mwdcal.calibration.diagnosis.refusals import explaining, fit_refusals, named
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import TRIADS, Readings
from mwdcal.errors import FitError
from mwdcal.sensor.profile import Profile, StandProfile
from simulation import DEG, attitude, factor_readings, factors_within_limits, plan

PROFILE = Profile(name="test tool")
NOISE = {"accelerometer": np.array(1e-4), "magnetometer": np.array(15.0)}
FIELD, DIP = 50_000.0, 65 * DEG
WRONG = [
    np.eye(3)[list(order)] * np.array(signs)[:, None]
    for order in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
][1:]
"""The signed permutations but the first, which is none."""
REVERSED = [q for q in WRONG if np.array_equal(q, -np.eye(3))]


def miswired(triad, unknown=(), order=0, wrong=WRONG):
    """Runs (B, n) of tools whose profiles have the wrong axes: what they take for x, y, z is Q v."""
    rng = np.random.default_rng(order)
    inc, azi, face = plan((5, 45, 90, 135), 6)
    soaks = (20.0,) if order == 0 else (0.0, 50.0, 100.0, 150.0)
    warmth = np.repeat(soaks, len(inc))
    inc, azi, face = (np.tile(v, len(soaks)) for v in (inc, azi, face))
    vectors = np.concatenate(attitude(inc, azi, face)(1.0, FIELD, DIP), -1)
    raw = factor_readings(factors_within_limits(rng, len(wrong)), warmth, vectors[None])
    raw = raw + np.repeat([1e-4, 15.0], 3) * rng.normal(size=raw.shape)
    parts = [raw[..., :3], raw[..., 3:]]
    parts[triad] = np.einsum("bij,bnj->bni", np.array(wrong), parts[triad])
    known = {"inclination": inc, "azimuth": azi, "toolface": face}
    known |= {"field": np.full(len(inc), FIELD), "dip": np.full(len(inc), DIP)}
    known = {k: v + np.zeros((len(wrong), 1)) for k, v in known.items() if k not in unknown}
    return Readings(*parts, temperature=warmth + np.zeros((len(wrong), 1)), known=known, sd=NOISE)


def one(runs, index):
    """One run of a batch."""
    known = {k: v[index] for k, v in runs.known.items()}
    names = ("accelerometer", "magnetometer", "temperature")
    return replace(runs, known=known, **{n: getattr(runs, n)[index] for n in names})


def right(wrong):
    """The axes that a profile has to state, of channels that read Q v: channel c is v's axis."""
    return tuple(
        ("+" if row.sum() > 0 else "-") + "xyz"[int(np.flatnonzero(row)[0])] for row in wrong
    )


CASES = [
    (0, None, (), WRONG),
    (0, None, ("dip", "field"), WRONG[::4] + REVERSED),
    (3, "factors", (), WRONG[::6]),
    (3, "factors", ("dip", "field"), WRONG[3::16] + REVERSED),
    (3, "polynomial", ("dip",), WRONG[5::16] + REVERSED),
]


@pytest.mark.parametrize("triad", [0, 1], ids=TRIADS)
@pytest.mark.parametrize(("order", "model", "unknown", "wrong"), CASES)
def test_wrong_axes_are_refused_and_the_right_ones_named(triad, order, model, unknown, wrong):
    runs, options = miswired(triad, unknown, order, wrong), Options(order=order, model=model)
    result = fit(runs, options)
    fitted = FittedRuns(runs, PROFILE, options, result, lambda i: (one(runs, i), PROFILE))
    refusals = [*fit_refusals(fitted)]
    for index, each in enumerate(wrong):
        first = next(refusal for refusal in refusals if refusal.members[index])
        axes = ", ".join(f'"{axis}"' for axis in right(each))
        assert first.sentence(index).endswith(
            f" The run fits with axes = [{axes}] of [{TRIADS[triad]}]."
        )


@pytest.mark.parametrize("wrong", WRONG[1::9])
def test_axes_count_from_those_that_the_profile_states(wrong):
    """Channels of known wiring, read with another: the axes named are those of the wiring."""
    wiring = ("-z", "+x", "-y")
    runs = miswired(1, wrong=[wrong])
    accelerometer, magnetometer = PROFILE.accelerometer, PROFILE.magnetometer
    stated = type(magnetometer)(axes=wiring)
    profile = Profile(name="wired", accelerometer=accelerometer, magnetometer=stated)
    channels = one(runs, 0).magnetometer @ stated.permutation
    found = explaining(one(runs, 0), profile)["magnetometer"]
    truth = np.array(wrong).T @ stated.permutation  # tool axes from channels
    assert named(truth) == found
    corrected = replace(
        one(runs, 0), magnetometer=channels @ type(stated)(axes=found).permutation.T
    )
    assert explaining(corrected, Profile(name="t", magnetometer=type(stated)(axes=found))) == {}
    calibrate(corrected, PROFILE)


def test_right_axes_are_not_doubted():
    runs = miswired(0, ("dip",), wrong=[np.eye(3)])
    assert explaining(one(runs, 0), PROFILE) == {}
    calibrate(one(runs, 0), PROFILE)


def test_a_reversed_magnetometer_is_refused_by_its_dip():
    run = one(miswired(1, ("dip",), wrong=REVERSED), 0)
    with pytest.raises(FitError, match=r"the dip comes out at -11[45]\.\d°, beyond vertical"):
        calibrate(run, PROFILE)


def scaled(field):
    """A sound run in another field, readings in its nanotesla."""
    run = one(miswired(0, wrong=[np.eye(3)]), 0)
    known = {**run.known, "field": run.known["field"] * field / FIELD}
    return replace(run, magnetometer=run.magnetometer * field / FIELD, known=known)


@pytest.mark.parametrize("field", [14_000.0, 81_000.0, 120_000.0])
def test_a_field_that_is_nowhere_on_earth_needs_a_coil(field):
    with pytest.raises(
        FitError, match=rf"field of {field / 1e3:g} µT .*coil = true under \[stand\]"
    ):
        calibrate(scaled(field), PROFILE)
    coil = Profile(name="test tool", stand=StandProfile(coil=True))
    assert calibrate(scaled(field), coil).earth["field"] == pytest.approx(field)


@pytest.mark.parametrize("field", [16_000.0, 79_000.0, 1.0])
def test_fields_on_earth_and_relative_ones_need_none(field):
    run = scaled(field)
    if field == 1.0:
        run = replace(run, sd={**NOISE, "magnetometer": np.array(15.0 / FIELD)})
    calibrate(run, PROFILE)


def test_a_gravity_that_is_nowhere_on_earth():
    run = one(miswired(0, wrong=[np.eye(3)]), 0)
    gravity = replace(run, known={**run.known, "gravity": np.full(run.count, 1.15)})
    with pytest.raises(FitError, match=r"gravity of 1.15 g \(0.9…1.1\): 'ref_gravity_g' gives so"):
        calibrate(gravity, PROFILE)


def test_errors_that_the_misfit_does_not_explain():
    """Reversed, its vectors fit to the noise and its azimuths point the other way."""
    run = one(miswired(1, ("dip",), wrong=REVERSED), 0)
    result = fit(run)
    assert result.analysis.variance_factor[0, 1] < 2
    after, expected = excessive_errors(run, result)["azimuth"]
    assert after > 90 * DEG
    assert expected < 0.1 * DEG
    sound = one(miswired(1, ("dip",), wrong=[np.eye(3)]), 0)
    assert excessive_errors(sound, fit(sound)) == {}


@pytest.mark.parametrize("declared", [True, False], ids=["declared", "estimated"])
def test_runs_whose_errors_are_not_looked_at_have_none_that_the_misfit_does_not_explain(declared):
    """Angles misread by all sizes: at one station, at a third of them, at all."""
    sound = one(miswired(1, ("dip",), wrong=[np.eye(3)]), 0)
    sound = sound if declared else replace(sound, sd={})
    rng, passed, looked = np.random.default_rng(3), 0, 0
    for size in np.radians(np.geomspace(0.05, 30, 12)):
        for share in (1 / sound.count, 0.3, 1.0):
            for name in ("inclination", "azimuth", "toolface"):
                off = size * (rng.permutation(sound.count) < share * sound.count)
                known = {**sound.known, name: sound.known[name] + off}
                run = replace(sound, known=known)
                result = fit(run)
                if straying(result)[0]:
                    looked += 1
                else:
                    passed += 1
                    assert excessive_errors(run, result) == {}
    assert passed > 20
    assert looked > 5
