"""One set of rules for calibrations that are written and that are read, and the hash of their contents."""

import hashlib
import json

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import mwdcal
from cli_support import EXAMPLE, calibrated, refused, servo_run, write_csv
from cli_support import mwdcal as command
from mwdcal.calibration.diagnosis.plausibility import invertible, is_covariance, mirrored
from mwdcal.calibration.record import LARGEST_ANGLE_SD
from mwdcal.errors import InputError
from simulation import DEG
from test_fleet import write_fleet

PROFILE = (EXAMPLE / "tool.toml").read_text("utf-8")
STRENGTHS = ("ref_inclination_deg", "ref_azimuth_deg", "ref_toolface_deg", "ref_dip_deg")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A calibration file, and a roll test of the same tool."""
    folder = tmp_path_factory.mktemp("sound")
    return calibrated(folder, servo_run(1)), write_csv(
        folder / "roll.csv", servo_run(1, inclinations=(46, 91), toolfaces=6)
    )


@pytest.fixture
def document(files):
    return json.loads(files[0].read_bytes())


def saved(folder, document):
    path = folder / "edited.json"
    path.write_text(json.dumps(document))
    return path


def commands(calibration, roll, folder):
    """Every way to use a calibration file, each with the exit codes of one that is accepted."""
    return [
        (("apply", calibration, roll, "-o", folder / "out.csv", "--json"), (0,)),
        (("verify", calibration, roll, "--report", folder / "page.html", "--json"), (0, 1)),
        (("convert", calibration, "--notation", "forward", "--json"), (0,)),
        (("convert", calibration, "--notation", "factors", "--json"), (0,)),
    ]


# What is written


def noisy(folder, noise):
    path = folder / "noise.toml"
    path.write_text(PROFILE.replace("noise = 7.5e-4", f"noise = {noise}"))
    return path


def strengths_alone():
    return {name: values for name, values in servo_run().items() if name not in STRENGTHS}


@pytest.mark.parametrize("noise", ["15", "300", "1e12"], ids="{} V".format)
def test_noise_in_nanotesla_instead_of_volts_is_named(tmp_path, noise):
    run, output = write_csv(tmp_path / "run.csv", strengths_alone()), tmp_path / "cal.json"
    ran = command("calibrate", run, "--tool", noisy(tmp_path, noise), "-o", output)
    message = refused(ran, 3)
    assert "the declared noise of the magnetometer is" in message
    assert "'noise' and 'repeatability' of [magnetometer]" in message
    assert not output.exists()


def test_a_fleet_refuses_the_same_noise_in_the_same_words(tmp_path):
    pq = pytest.importorskip("pyarrow.parquet")
    run, output = strengths_alone(), tmp_path / "cals.parquet"
    tool = noisy(tmp_path, "15")
    alone = refused(
        command(
            "calibrate",
            write_csv(tmp_path / "r.csv", run),
            "--tool",
            tool,
            "-o",
            tmp_path / "cal.json",
        ),
        3,
    )
    runs = write_fleet(tmp_path / "runs.parquet", {"A": run})
    command("fleet", runs, "-o", output, "--tool", tool, "--workers", 1)
    (row,) = pq.read_table(output).to_pylist()
    assert row["status"] == "noise"
    assert alone.endswith(row["message"])


@pytest.mark.parametrize("noise", ["0.35", "0.05", "5e-7"], ids="{} V".format)
def test_a_covariance_of_very_different_noise_is_written_so_that_it_can_be_read(tmp_path, noise):
    """A sound covariance, whose rounding is of the size of its smaller entries."""
    run, output = write_csv(tmp_path / "run.csv", strengths_alone()), tmp_path / "cal.json"
    tool = noisy(tmp_path, noise)
    tool.write_text(tool.read_text().replace("noise = 3e-4", "noise = 1e-3"))
    ran = command("calibrate", run, "--tool", tool, "-o", output)
    assert ran.code == 0 or "residuals are" in refused(ran, 3)
    if ran.code == 0:
        covariance = mwdcal.load(output).parameter_covariance
        sd = np.sqrt(np.diag(covariance))
        assert np.abs(covariance - covariance.T).max() <= 2e-6 * np.outer(sd, sd).max()
        assert np.linalg.eigvalsh(covariance / np.outer(sd, sd))[0] > -1e-6


def test_a_calibration_that_no_command_would_read_is_not_saved(tmp_path, files):
    calibration = mwdcal.load(files[0])
    triad = msgspec.structs.replace(calibration.accelerometer, noise=np.nan)
    spoilt = msgspec.structs.replace(calibration, accelerometer=triad)
    path = tmp_path / "cal.json"
    with pytest.raises(InputError, match=r"'accelerometer.noise' must be a finite number"):
        mwdcal.save(spoilt, path)
    assert not path.exists()


# What is read


def at(*keys):
    def place(document):
        for key in keys[:-1]:
            document = document[key]
        return document, keys[-1]

    return place


def zero_covariance(document):
    document["covariance"] = [[0.0] * 24] * 24


def no_uncertainty(document):
    zero_covariance(document)
    for name in ("accelerometer", "magnetometer"):
        document[name]["standard_uncertainties"] = [0.0] * 12


def half_covariance(document):
    document["covariance"] = (np.array(document["covariance"]) / 4).tolist()


def mirrored_axis(document):
    document["magnetometer"]["parameters"][6:9] = [
        -value for value in document["magnetometer"]["parameters"][6:9]
    ]


def exchanged_axes(document):
    values = document["accelerometer"]["parameters"]
    values[0:3], values[3:6] = values[3:6], values[0:3]


def forget_stations(document):
    document["station_rows"] = []
    document["stations"] = 0


def setting(*keys, value):
    def change(document):
        entry, key = at(*keys)(document)
        entry[key] = value

    return change


INCONSISTENT = {
    "variance factor negative": (setting("accelerometer", "variance_factor", value=-0.2), "-0.2"),
    "noise negative": (setting("magnetometer", "noise", value=-1.0), "noise"),
    "noise of nowhere": (setting("magnetometer", "noise_source", value="guess"), "guess"),
    "probability above one": (setting("accelerometer", "misfit_probability", value=1.5), "1.5"),
    "rank above size": (setting("accelerometer", "rank", value=13), "rank 13"),
    "rank without a direction": (setting("accelerometer", "rank", value=11), "undetermined"),
    "size above parameters": (setting("accelerometer", "size", value=40), "size 40"),
    "direction without a name": (setting("free", value=[[1.0] + [0.0] * 23]), "'free'"),
    "uncertainty blank": (
        setting("accelerometer", "standard_uncertainties", 0, value=None),
        "lacks a standard uncertainty",
    ),
    "covariance zero": (zero_covariance, "zero everywhere"),
    "covariance zero, uncertainties too": (no_uncertainty, "zero everywhere"),
    "covariance of another size": (half_covariance, "standard uncertainties"),
    "stations forgotten": (setting("station_rows", value=[]), "'station_rows' lists 0"),
    "stations forgotten and none said": (forget_stations, "'stations' is 0"),
    "stations miscounted": (setting("stations", value=47), "'stations' is 47"),
    "gravity zero": (setting("earth", "gravity_g", value=0.0), "gravity_g"),
    "radius of no sensor": (setting("accelerometer", "radius", value=1e-300), "cannot be inverted"),
    "axis mirrored": (mirrored_axis, "left-handed"),
    "axes exchanged": (exchanged_axes, "left-handed"),
}


@pytest.mark.parametrize(("change", "word"), INCONSISTENT.values(), ids=INCONSISTENT)
def test_what_does_not_fit_together_is_refused_in_one_sentence(
    tmp_path, files, document, change, word
):
    change(document)
    path = saved(tmp_path, document)
    for arguments, _ in commands(path, files[1], tmp_path):
        message = refused(command(*arguments), 2)
        assert message.startswith("mwdcal: edited.json: ")
        assert word in message
        assert "calibrate again" in message
    assert not (tmp_path / "out.csv").exists()
    assert not (tmp_path / "page.html").exists()


TEXTS = {
    "a key twice": (lambda text: text.replace("{", '{"stations": 3,', 1), "'stations' stands 2 times"),
    "a key twice inside": (
        lambda text: text.replace('"accelerometer": {', '"accelerometer": {"noise": 1e-4,'),
        "'noise' stands 2 times",
    ),
    "an integer of 400 digits": (
        lambda text: text.replace('"stations": ', f'"stations": {"9" * 400}'),
        "402 digits",
    ),
    "a number of 400 digits": (
        lambda text: text.replace('"noise": ', f'"noise": {"9" * 400}', 1),
        "out of range",
    ),
    "objects 100 000 deep": (
        lambda text: text.replace("{", '{"deep":' + '{"a":' * 100_000 + "1" + "}" * 100_000 + ",", 1),
        "not a calibration file",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("change", "word"), TEXTS.values(), ids=TEXTS)
def test_what_json_allows_and_a_calibration_does_not_is_refused(tmp_path, files, change, word):
    path = tmp_path / "edited.json"
    path.write_text(change(files[0].read_text("utf-8")))
    for arguments, _ in commands(path, files[1], tmp_path):
        assert word in refused(command(*arguments), 2)


def places(value, path=()):
    """Every place of a document where a number, a text or a null stands."""
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, item in items:
        if isinstance(item, dict | list) and item:
            yield from places(item, (*path, key))
        else:
            yield (*path, key)


VALUES = st.one_of(
    st.sampled_from([None, 0, 0.0, -1, 1, 1e-300, 1e29, -1e29, 1e300, "", "x", [], {}, True]),
    st.floats(-1e6, 1e6),
    st.integers(-3, 50),
)


def numbers(value):
    if isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            yield from numbers(item)
    elif isinstance(value, float):
        yield value


@settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_a_changed_field_is_refused_or_does_no_harm(tmp_path, files, data):
    """Of any single field: one sentence at exit 2, or finite results and the finding that it was changed."""
    document = json.loads(files[0].read_bytes())
    fields = sorted(places(document), key=str)
    kinds = sorted({tuple(key for key in path if isinstance(key, str)) for path in fields})
    kind = data.draw(st.sampled_from(kinds))
    path = data.draw(
        st.sampled_from([p for p in fields if tuple(k for k in p if isinstance(k, str)) == kind])
    )
    entry, key = at(*path)(document)
    before, entry[key] = entry[key], data.draw(VALUES)
    edited, report = saved(tmp_path, document), ("--report", tmp_path / "page.html")
    for arguments, codes in commands(edited, files[1], tmp_path):
        ran = command(*(each for each in arguments if each not in report))
        if ran.code == 2:
            refused(ran, 2)
            continue
        assert ran.code in codes, ran
        assert np.isfinite(list(numbers(ran.json))).all()
        ids = [finding["id"] for finding in ran.json["findings"]]
        same = before == entry[key] or path[0] == "time"
        assert ("changed" in ids) != same, path


# Whether it was changed


def other_program(fields):
    """The hash as the page on files describes it."""
    kept = {name: value for name, value in fields.items() if name not in ("time", "sha256")}
    return hashlib.sha256(
        json.dumps(kept, sort_keys=True, separators=(",", ":")).encode()
    ).hexdigest()


def test_the_hash_is_that_of_all_other_fields_but_time(files, document):
    assert document["sha256"] == other_program(document)
    assert not mwdcal.load(files[0]).changed


def edited_parameter(document):
    document["accelerometer"]["parameters"][9] += 1e-9


def changed(ran):
    return [finding["id"] for finding in ran.json["findings"]].count("changed")


@pytest.mark.usefixtures("without_pictures")
def test_a_changed_file_says_so_wherever_it_is_used(tmp_path, files, document):
    edited_parameter(document)
    path = saved(tmp_path, document)
    for arguments, codes in commands(path, files[1], tmp_path):
        ran = command(*arguments)
        assert ran.code in codes
        assert changed(ran) == 1
        assert ran.err.count("! the calibration was changed after mwdcal calibrate made it") == 1
        assert changed(command(arguments[0], files[0], *arguments[2:])) == 0
    assert mwdcal.load(path).changed


def test_what_does_not_change_the_contents_is_no_change(tmp_path, document):
    """White space, the order of keys, 1 for 1.0, and the time."""
    document["time"] = "2001-01-01T00:00:00+00:00"
    shuffled = dict(reversed(document.items()))
    shuffled["profile"]["reference_temperature_c"] = 30
    path = tmp_path / "other.json"
    path.write_text(json.dumps(shuffled))
    assert not mwdcal.load(path).changed


@pytest.mark.usefixtures("without_pictures")
def test_a_file_of_an_earlier_version_is_read_without_complaint(tmp_path, files, document):
    del document["sha256"]
    edited_parameter(document)
    path = saved(tmp_path, document)
    for arguments, _ in commands(path, files[1], tmp_path):
        assert changed(command(*arguments)) == 0
    mwdcal.save(mwdcal.load(path), tmp_path / "again.json")
    assert json.loads((tmp_path / "again.json").read_bytes()) == document


@pytest.mark.parametrize("later", [True, False])
def test_a_file_with_the_fields_of_another_version_is_not_taken_for_a_changed_one(
    tmp_path, document, later
):
    """A later version may add fields, an earlier one lacks some: each has the hash of its own."""
    if later:
        document["accelerometer"]["settling"] = document["vibration"] = 1.5
    else:
        del document["assumed_exact"], document["options"]["robust"]
    document["sha256"] = other_program(document)
    path = saved(tmp_path, document)
    assert not mwdcal.load(path).changed
    mwdcal.save(mwdcal.load(path), tmp_path / "again.json")
    assert not mwdcal.load(tmp_path / "again.json").changed
    edited_parameter(document)
    assert mwdcal.load(saved(tmp_path, document)).changed


def test_saving_does_not_hide_a_change(tmp_path, files, document):
    mwdcal.save(mwdcal.load(files[0]), tmp_path / "same.json")
    assert (tmp_path / "same.json").read_bytes() == files[0].read_bytes()
    edited_parameter(document)
    path = saved(tmp_path, document)
    mwdcal.save(mwdcal.load(path), tmp_path / "again.json")
    assert json.loads((tmp_path / "again.json").read_bytes()) == document
    assert mwdcal.load(tmp_path / "again.json").changed


def test_two_fits_of_one_run_have_one_hash(tmp_path, files):
    folder = tmp_path / "again"
    folder.mkdir()
    again = mwdcal.load(calibrated(folder, servo_run(1)))
    assert again.sha256 == mwdcal.load(files[0]).sha256


# Arrays of matrices, as a fleet has them


def test_covariance_matrices_are_told_from_others():
    sound = np.diag([1e-12, 4.0, 0.0])
    sound[0, 1] = sound[1, 0] = 1e-6
    one_sided, negative, indefinite, infinite = (sound.copy() for _ in range(4))
    one_sided[0, 1] = 0.0
    negative[2, 2] = -1e-20
    indefinite[0, 1] = indefinite[1, 0] = 2.1e-6
    infinite[1, 1] = np.inf
    stack = np.stack([sound, one_sided, negative, indefinite, infinite, sound * np.nan])
    assert is_covariance(stack).tolist() == [True, False, False, False, False, False]


def test_gains_that_mirror_or_cannot_be_inverted_are_told_from_others():
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    flat = np.diag([1.0, 1.0, 1e-5])
    stack = np.stack([np.eye(3), turned, -np.eye(3), flat, np.full((3, 3), np.nan)])[:, None]
    assert mirrored(stack)[:4].tolist() == [False, False, True, False]
    assert mirrored(stack[:4] * 1e300).tolist() == [False, False, True, False]
    assert not mirrored(stack[:4] * 0.0).any()
    assert not invertible(stack[:2] * 1e31).any()
    assert not invertible(stack[:2] * 1e-31).any()
    assert invertible(stack).tolist() == [True, True, True, False, False]


# Python


def test_a_calibration_is_equal_to_its_copy_and_has_its_hash(files):
    first, second = mwdcal.load(files[0]), mwdcal.load(files[0])
    assert first == second
    assert len({first, second}) == 1


def test_readings_are_equal_to_themselves_alone():
    first, second = (mwdcal.simulate(seed=1) for _ in range(2))
    assert first == first
    assert first != second
    assert len({first, second}) == 2


@pytest.mark.parametrize("name", ["azimuth", "toolface"])
def test_an_angle_that_a_noisy_vertical_reading_does_not_have_has_no_uncertainty(files, name):
    """Known to 1 / tilt of it; beyond half a radian nothing is stated."""
    calibration = mwdcal.load(files[0])
    tilt = np.array([0.0, 1e-12, 1e-9, 1e-3, 45.0]) * DEG
    g = np.stack([-np.sin(tilt), np.zeros(5), np.cos(tilt)], -1)
    b = 50_000 * np.array([0.4, 0.1, 0.9]) * np.ones((5, 1))
    sd = calibration.uncertainty(name, inverse_readings(calibration, g, b), noise=True)
    np.testing.assert_array_equal(np.isnan(sd), [True, True, True, True, False])
    assert sd[-1] < 0.1 * DEG


def test_the_largest_uncertainty_of_a_direction_is_a_fifth_too_small():
    """The direction of a vector in even noise, twice as long as that: drawn, against 1 / length."""
    x, y = np.random.default_rng(1).normal(size=(2, 1_000_000))
    seen = np.sqrt(np.mean(np.arctan2(y, 1 / LARGEST_ANGLE_SD + x) ** 2))
    assert 1.2 < seen / LARGEST_ANGLE_SD < 1.25


def inverse_readings(calibration, g, b):
    """Nominal readings of fields, by the documented formula: field = A x + c."""
    raw = []
    for triad, field in ((calibration.accelerometer, g), (calibration.magnetometer, b)):
        values = np.array(triad.parameters)
        raw.append(np.linalg.solve(values[:9].reshape(3, 3), (field - values[9:]).T).T)
    return mwdcal.readings(*raw, temperature=25.0)
