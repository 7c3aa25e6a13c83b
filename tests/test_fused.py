"""The compiled loops against the formulas they repeat: every model, every singular attitude."""

import os
import subprocess
import sys

import msgspec
import numpy as np
import pytest

from cli_support import servo_run
from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.readings import Readings
from mwdcal.files.formats.table import Table
from mwdcal.files.profiles import load_profile
from mwdcal.files.runs import to_readings
from mwdcal.sensor.models import Basis, Factors, Polynomial
from mwdcal.use import correction, correction_numba

pytest.importorskip("numba")
pytestmark = pytest.mark.skipif(not correction_numba.available(), reason="MWDCAL_NUMPY is set")

SIZE = {"accelerometer": 1.0, "magnetometer": 5e4}
MODELS = [
    *(("factors", order, False) for order in range(4)),
    *(("polynomial", order, False) for order in range(4)),
    ("polynomial", 0, True),
    ("polynomial", 2, True),
]
PAIRS = [(MODELS[i], MODELS[(7 * i + 3) % len(MODELS)]) for i in range(len(MODELS))]
SINGULAR = np.array(
    [
        *([0, 0, 1, 2e4, 1e4, 4e4], [0, 0, -1, 2e4, 1e4, 4e4], [-0.0, -0.0, 1, -0.0, -0.0, 1e4]),
        *([1e-7, 0, 1, 0, 3e4, 1e4], [0, -1e-7, -1, 3e4, 0, 1e4], [0, 1, 0, 0, 5e4, 0]),
        *([0, -1, 0, 0, -5e4, 0], [1, 0, 0, 0, 0, 5e4], [-1, 0, -0.0, 0, 0, -5e4]),
        *([0, 0, 0, 1, 2, 3], [0.6, 0.8, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0]),
        *([np.nan, 0, 1, 1, 2, 3], [0, 1, 0, 1, np.nan, 3], [0.5, 0.5, 0.5, 5e4, 5e4, 5e4]),
    ]
)


@pytest.fixture(scope="module")
def sound():
    run = {k: v for k, v in servo_run().items() if k != "station"}
    readings, profile = to_readings(Table(run), load_profile("servo")[0])
    return calibrate(readings, profile)


def triad(calibration, name, kind, order, curved, rng, perfect=False):
    """The triad with another model of random, or of perfect, parameters."""
    size, spread = SIZE[name], 0.0 if perfect else 1.0
    basis = Basis(order, calibration.reference_temperature)
    if kind == "factors":
        model = Factors(basis)
        params = np.zeros(model.size)
        params[: 3 * (order + 1) : order + 1] = 1.0
        drift = np.tile([1e-2, 1e-4, 1e-6, 1e-8][: order + 1], 6)
        drift[3 * (order + 1) :] *= size
        steps = np.concatenate([drift, np.full(6, 3e-3)])
        centre, radius = [0.0] * 3, 1.0
    else:
        centre, radius = ([0.1 * size] * 3, size) if curved else ([0.0] * 3, 1.0)
        model = Polynomial(basis, np.array([centre]), np.full((1, 3), radius), curved)
        params = np.zeros(model.size)
        params[[0, 4, 8]] = radius
        courses = np.array([1e-2, 1e-4, 1e-6, 1e-8])[: order + 1, None]
        one = np.concatenate([np.full(9, radius), np.full(3, size)])
        steps = np.concatenate([(courses * one).ravel(), np.full(6 * curved, 1e-3 * size)])
    params = params + spread * steps * rng.normal(size=len(params))
    return msgspec.structs.replace(
        getattr(calibration, name),
        **{"model": kind, "order": order, "curved": curved, "centre": centre, "radius": radius},
        parameters=params.tolist(),
    )


def changed(calibration, first, second, seed=0, perfect=False):
    rng = np.random.default_rng(seed)
    triads = {
        name: triad(calibration, name, *kind, rng, perfect)
        for name, kind in (("accelerometer", first), ("magnetometer", second))
    }
    variance = 1e-8 * np.eye(sum(len(each.parameters) for each in triads.values()))
    return msgspec.structs.replace(
        calibration, **triads, temperature_c=(-10.0, 120.0), covariance_rows=variance.tolist()
    )


def random_readings(shape, seed=1):
    rng = np.random.default_rng(seed)
    g = rng.normal(size=(*shape, 3))
    g /= np.linalg.norm(g, axis=-1, keepdims=True)
    return Readings(g, 3e4 * rng.normal(size=(*shape, 3)), rng.uniform(-10, 120, shape))


def assert_equal(found, wanted):
    """Vectors and strengths to 1e-12 of their size; angles too, times what they turn by."""
    g, b = (np.stack([wanted[n] for n in names], -1) for names in (VECTOR_G, VECTOR_B))
    strength, field = wanted["gravity_g"], wanted["field_nt"]
    with np.errstate(invalid="ignore", divide="ignore"):
        across = np.hypot(g[..., 0], g[..., 1]) / strength
        lever = {
            "azimuth_deg": across * np.cos(np.radians(wanted["dip_deg"])),
            "toolface_deg": across,
            "magnetic_toolface_deg": np.hypot(b[..., 0], b[..., 1]) / field,
        }
    for name, value in wanted.items():
        np.testing.assert_array_equal(np.isnan(found[name]), np.isnan(value), err_msg=name)
        error = found[name] - value
        if name.endswith("_deg"):
            error = (error + 180.0) % 360.0 - 180.0
            error = np.radians(error) * lever.get(name, 1.0)
        else:
            error = error / np.maximum(strength if name.endswith("_g") else field, 1e-300)
        assert np.nanmax(np.abs(error), initial=0.0) < 1e-12, name


VECTOR_G, VECTOR_B = correction.RESULTS[:3], correction.RESULTS[3:6]


@pytest.mark.parametrize(("first", "second"), PAIRS, ids=lambda m: f"{m[0]}{m[1]}{'c' * m[2]}")
def test_every_model_gives_what_numpy_gives(sound, first, second):
    calibration = changed(sound, first, second)
    readings = random_readings((1500,))
    found = correction.compiled(calibration, readings, least=0)
    assert_equal(found, correction.reference(calibration, readings))


@pytest.mark.parametrize("shape", [(1,), (0,), (127,), (128,), (129,), (3, 1, 50), (2, 0)], ids=str)
def test_every_shape(sound, shape):
    calibration = changed(sound, ("factors", 3, False), ("polynomial", 1, False))
    readings = random_readings(shape)
    found = correction.compiled(calibration, readings, least=0)
    assert {v.shape for v in found.values()} == {shape}
    assert_equal(found, correction.reference(calibration, readings))


@pytest.mark.parametrize("kind", ["factors", "polynomial"])
def test_singular_rows_of_a_perfect_tool(sound, kind):
    perfect = changed(sound, (kind, 3, False), (kind, 0, False), perfect=True)
    rows = np.tile(SINGULAR, (20, 1))
    readings = Readings(rows[:, :3], rows[:, 3:], np.linspace(-10, 120, len(rows)))
    found = correction.compiled(perfect, readings, least=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        wanted = correction.reference(perfect, readings)
    assert_equal(found, wanted)
    for name in ("inclination_deg", "toolface_deg"):  # the same side of 0 and 360
        np.testing.assert_allclose(found[name], wanted[name], atol=1e-12)


@pytest.mark.parametrize("lacking", ["magnetometer", "temperature"])
def test_readings_without(sound, lacking):
    calibration = changed(sound, ("factors", 0, False), ("polynomial", 0, True))
    readings = random_readings((300,))
    readings = Readings(
        readings.accelerometer,
        None if lacking == "magnetometer" else readings.magnetometer,
        None if lacking == "temperature" else readings.temperature,
    )
    found = correction.compiled(calibration, readings, least=0)
    assert_equal(found, correction.reference(calibration, readings))


def test_a_tool_without_magnetometer(sound):
    calibration = msgspec.structs.replace(sound, magnetometer=None)
    readings = random_readings((300,))
    found = correction.compiled(calibration, readings, least=0)
    assert_equal(found, correction.reference(calibration, readings))


def test_units_signs_and_order_of_channels(sound):
    calibration = changed(sound, ("factors", 2, False), ("factors", 1, False))
    readings = random_readings((1000,))
    units = np.array([-3.0, 2.0, 0.5, 5e-5, -4e-5, 1e-3])
    nominal = np.concatenate([readings.accelerometer, readings.magnetometer], -1)
    columns = [*(nominal * units).T, readings.temperature]
    zero = calibration.reference_temperature
    found = correction_numba.run(columns, correction.numbers(calibration), zero, units)
    named = dict(zip(correction.RESULTS, found.columns, strict=True))
    assert_equal(named, correction.reference(calibration, readings))


def test_a_row_has_the_same_digits_wherever_it_stands_and_however_many_compute(sound):
    calibration = changed(sound, ("factors", 3, False), ("polynomial", 2, True))
    readings = random_readings((100_003,))
    columns = [*readings.accelerometer.T, *readings.magnetometer.T, readings.temperature]
    plain = [np.ascontiguousarray(c) for c in columns]
    triads, zero = correction.numbers(calibration), calibration.reference_temperature
    one = correction_numba.run(plain, triads, zero, workers=1).columns
    np.testing.assert_array_equal(correction_numba.run(plain, triads, zero, workers=3).columns, one)
    np.testing.assert_array_equal(correction_numba.run(columns, triads, zero).columns, one)
    shifted = correction_numba.run([c[77:500] for c in plain], triads, zero).columns
    np.testing.assert_array_equal(shifted, one[:, 77:500])


def test_what_is_remarkable_is_counted(sound):
    calibration = changed(sound, ("factors", 0, False), ("factors", 0, False), perfect=True)
    readings = random_readings((1000,))
    columns = [*readings.accelerometer.T.copy(), *readings.magnetometer.T.copy()]
    columns.append(np.linspace(0.0, 99.9, 1000))
    columns[0][5], columns[4][7], columns[5][8] = np.nan, 1e20, -np.inf
    limits = correction_numba.RowLimits((-1e15, 1e15), (5.0, 1000.0), (20.0, 80.0), blank=True)
    found = correction_numba.run(columns, correction.numbers(calibration), 30.0, limits=limits)
    assert found.unsound == 3 + int((columns[6] < 5.0).sum())
    beyond = (columns[6] < 20.0) | (columns[6] > 80.0)
    assert found.beyond == beyond.sum()
    assert np.isnan(found.columns[:, beyond]).all()
    assert found.empty == np.isnan(found.columns).sum()


def test_vectors_are_the_fields_of_the_calibration(sound):
    calibration = changed(sound, ("factors", 3, False), ("factors", 3, False))
    readings = random_readings((1000,))
    columns = [*readings.accelerometer.T, *readings.magnetometer.T, readings.temperature]
    results = correction_numba.run(columns, correction.numbers(calibration), 30.0).columns
    wanted = np.concatenate(calibration.fields(readings), -1).T
    np.testing.assert_allclose(results[:6], wanted, rtol=1e-12, atol=1e-12 * 5e4)


def test_long_arrays_take_the_loops_and_the_result_is_the_same(sound, monkeypatch):
    calibration = changed(sound, ("factors", 3, False), ("factors", 3, False))
    readings = random_readings((4000,))
    monkeypatch.setattr(correction, "COMPILED_ROWS", 1000)
    assert correction.compiled(calibration, readings) is not None
    plain, said = correction.correct(calibration, readings, "blank")
    monkeypatch.setattr(correction, "compiled", lambda *given: None)
    wanted, told = correction.correct(calibration, readings, "blank")
    assert said == told
    assert_equal(plain, wanted)


def test_loops_are_left_alone_where_they_cannot_or_must_not(sound, monkeypatch):
    readings = random_readings((100,))
    assert correction.compiled(sound, readings) is None
    cold = msgspec.structs.replace(
        sound, accelerometer=triad(sound, "accelerometer", *MODELS[3], np.random.default_rng(0))
    )
    without = Readings(readings.accelerometer, readings.magnetometer)
    assert correction.compiled(cold, without, least=0) is None
    assert correction_numba.numbers(Factors(Basis(4, 30.0)), np.ones(36)) is None
    monkeypatch.setenv("MWDCAL_NUMPY", "1")
    assert correction.compiled(sound, readings, least=0) is None


def test_numba_is_not_loaded_before_it_is_needed():
    code = "import sys, mwdcal.app.cli, mwdcal.app.correction; sys.exit('numba' in sys.modules)"
    environment = {k: v for k, v in os.environ.items() if k != "MWDCAL_NUMPY"}
    assert (
        subprocess.run([sys.executable, "-c", code], env=environment, check=False).returncode == 0
    )


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """Two files of machine code with their checksums, in a folder of their own."""
    from mwdcal.use import correction_kernels as kernels

    monkeypatch.setattr(kernels, "_folder", lambda: tmp_path)
    version = f"py{sys.version_info.major}{sys.version_info.minor}"
    names = (
        f"correction_kernels.rows-1.{version}.nbi",
        f"correction_kernels.rows-1.{version}.1.nbc",
    )
    for name in names:
        (tmp_path / name).write_bytes(b"machine code")
    kernels.write_checksums.cache_clear()
    kernels.write_checksums(1)
    yield [tmp_path / name for name in names]
    kernels.write_checksums.cache_clear()


@pytest.mark.parametrize("damage", [b"machine cod", b"machine codf", bytes(12), b""])
def test_damaged_machine_code_is_removed_and_reported(kept, damage):
    from mwdcal.use.correction_kernels import check_kept

    assert check_kept()
    kept[1].write_bytes(damage)
    assert not check_kept()
    assert not any(path.exists() for path in kept)


def test_machine_code_without_checksums_is_removed_silently(kept):
    """Of a process that was interrupted, or still compiles."""
    from mwdcal.use.correction_kernels import check_kept

    (checksums,) = kept[0].parent.glob("*.json")
    checksums.unlink()
    assert check_kept()
    assert not any(path.exists() for path in kept)


def test_checksums_that_cannot_be_read_count_as_damage(kept):
    from mwdcal.use.correction_kernels import check_kept

    (checksums,) = kept[0].parent.glob("*.json")
    checksums.write_text("{")
    assert not check_kept()


def test_vectors_alone_are_those_beside_the_angles(sound):
    rng = np.random.default_rng(5)
    columns = [*rng.normal(size=(3, 1000)), *3e4 * rng.normal(size=(3, 1000)), np.full(1000, 25.0)]
    vectors = np.empty((6, 1000))
    arguments = (columns, correction.numbers(sound), sound.reference_temperature)
    result = correction_numba.run(*arguments, out=vectors)
    assert result.columns is vectors
    np.testing.assert_array_equal(vectors, correction_numba.run(*arguments).columns[:6])
