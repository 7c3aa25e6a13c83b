"""`mwdcal convert`: three notations, one calibration; recomputed by hand from the printed numbers."""

import hashlib
import json

import numpy as np
import pytest

from cli_support import calibrated, mwdcal, numbers, read_csv, refused, servo_run, write_csv
from simulation import Tool

NOTATIONS = ("forward", "affine", "factors")
TRIADS = {
    "accelerometer": (("ax", "ay", "az"), ("gx_g", "gy_g", "gz_g")),
    "magnetometer": (("mx", "my", "mz"), ("bx_nt", "by_nt", "bz_nt")),
}
AXES = {
    "straight": (("+x", "+y", "+z"), ("+x", "+y", "+z")),
    "turned": (("+z", "-x", "-y"), ("+y", "+z", "+x")),
    "left-handed": (("+y", "+x", "+z"), ("-x", "-y", "-z")),
    "flipped and permuted": (("-z", "-y", "+x"), ("+z", "-y", "+x")),
}
SCALES = (3.0, 5e-5)
TOOL = Tool.random(6)


def profile(folder, axes):
    parts = ['name = "own"', "reference_temperature_c = 20.0"]
    for triad, own, scale, noise in zip(TRIADS, axes, SCALES, (3e-4, 7.5e-4), strict=True):
        parts += [f"[{triad}]", f"axes = {json.dumps(own)}", f"scale = {scale}", f"noise = {noise}"]
    path = folder / "tool.toml"
    path.write_text("\n".join(parts) + "\n")
    return path


def rewired(run, axes):
    """The run as channels in the order and polarity of `axes` would have logged it."""
    changed = dict(run)
    for (names, _), own in zip(TRIADS.values(), axes, strict=True):
        along = dict(zip("xyz", names, strict=True))
        for name, (sign, axis) in zip(names, own, strict=True):
            changed[name] = run[along[axis]] * (1 if sign == "+" else -1)
    return changed


def permutation(axes):
    """P with field = P · channels for a perfect tool."""
    matrix = np.zeros((3, 3))
    for channel, (sign, axis) in enumerate(axes):
        matrix["xyz".index(axis), channel] = 1 if sign == "+" else -1
    return matrix


def converted(calibration, notation, *options):
    ran = mwdcal("convert", calibration, "--notation", notation, "--json", *options)
    assert ran.code == 0, ran
    return ran.json


def corrected(folder, calibration, run):
    """Raw channels and corrected vectors (n, 3) of both triads, as `apply` writes them."""
    source = write_csv(folder / "readings.csv", run)
    ran = mwdcal("apply", calibration, source, "-o", folder / "out.csv", "--outside", "extrapolate")
    assert ran.code == 0, ran
    found = read_csv(folder / "out.csv")
    return {
        triad: tuple(np.stack([numbers(found[n]) for n in names], -1) for names in pair)
        for triad, pair in TRIADS.items()
    }


@pytest.fixture(scope="module", params=AXES)
def case(request, tmp_path_factory):
    """A calibration of order 0, a run of its tool, and the axes."""
    folder, axes = tmp_path_factory.mktemp("case"), AXES[request.param]
    run = rewired(servo_run(tool=TOOL), axes)
    return calibrated(folder, run, tool=profile(folder, axes)), run, axes


def test_all_notations_give_what_apply_gives(tmp_path, case):
    calibration, run, axes = case
    results = corrected(tmp_path, calibration, run)
    documents = {name: converted(calibration, name) for name in NOTATIONS}
    for (triad, (raw, field)), own in zip(results.items(), axes, strict=True):
        forward, affine, factors = (documents[name][triad] for name in NOTATIONS)
        scale = np.abs(raw).max()
        again = field @ np.transpose(forward["S"]) + np.array(forward["o"])
        np.testing.assert_allclose(again, raw, rtol=0, atol=1e-10 * scale)
        again = raw @ np.transpose(affine["M"]) + np.array(affine["b"])
        np.testing.assert_allclose(again, field, rtol=0, atol=1e-10 * np.abs(field).max())
        unit = raw / np.array(factors["SF"])[:, 0] - np.array(factors["B"])[:, 0]
        again = unit @ (np.eye(3) - np.array(factors["m"])).T @ permutation(own).T
        np.testing.assert_allclose(again, field, rtol=0, atol=1e-10 * np.abs(field).max())
        assert np.diag(factors["m"]).tolist() == [0.0] * 3
        assert factors["axes"] == list(own)


def test_the_forward_notation_is_the_tool_as_it_was_built(case):
    """raw = scale · Pᵀ (matrix · field + offset): within five standard uncertainties, entry by entry."""
    document = converted(case[0], "forward")
    for index, (triad, own) in enumerate(zip(TRIADS, case[2], strict=True)):
        back = SCALES[index] * permutation(own).T
        for name, truth in (("S", back @ TOOL.matrix[index]), ("o", back @ TOOL.offset[index])):
            sd = np.array(document[triad]["standard_uncertainty"][name])
            assert (np.abs(np.array(document[triad][name]) - truth) < 5 * sd).all()
            size = SCALES[index] * (50_000 if name == "o" and index else 1)
            assert (sd < 1e-2 * size).all()


@pytest.mark.parametrize("notation", NOTATIONS)
def test_the_covariance_is_one(case, notation):
    for triad in TRIADS:
        entry = converted(case[0], notation)[triad]
        covariance = np.array(entry["covariance"])
        np.testing.assert_allclose(covariance, covariance.T, rtol=0, atol=1e-12 * covariance.max())
        names = [k for k in entry if k in ("S", "o", "M", "b", "SF", "B", "m")]
        sd = np.concatenate([np.ravel(entry["standard_uncertainty"][n]) for n in names])
        np.testing.assert_allclose(np.sqrt(np.diag(covariance)), sd, rtol=1e-9)
        used = sd > 0
        correlation = (covariance / np.outer(sd + ~used, sd + ~used))[np.ix_(used, used)]
        assert np.linalg.eigvalsh(correlation)[0] > -1e-9
        assert used.sum() == 12


def test_the_forward_covariance_is_that_of_drawn_affine_parameters(case):
    """2000 draws: a standard deviation is known to 1.6 %, a correlation to 0.022."""
    rng = np.random.default_rng(12)
    affine, forward = converted(case[0], "affine"), converted(case[0], "forward")
    for triad in TRIADS:
        mean = np.concatenate([np.ravel(affine[triad]["M"]), affine[triad]["b"]])
        covariance = np.array(affine[triad]["covariance"])
        sd = np.sqrt(np.diag(covariance))
        drawn = rng.multivariate_normal(0 * mean, covariance / np.outer(sd, sd), 2000) * sd + mean
        matrix = np.linalg.inv(drawn[:, :9].reshape(-1, 3, 3))
        offset = -np.einsum("nij,nj->ni", matrix, drawn[:, 9:])
        found = np.concatenate([matrix.reshape(-1, 9), offset], -1)
        claimed = np.array(forward[triad]["covariance"])
        spread = np.sqrt(np.diag(claimed))
        np.testing.assert_allclose(found.std(0, ddof=1), spread, rtol=0.08)
        correlation = claimed / np.outer(spread, spread)
        np.testing.assert_allclose(np.corrcoef(found.T), correlation, atol=0.11)


@pytest.fixture(scope="module", params=["polynomial", "factors"])
def warm(request, tmp_path_factory):
    """A calibration with temperature terms of a left-handed tool, and readings at three temperatures."""
    folder, axes = tmp_path_factory.mktemp("warm"), AXES["left-handed"]
    run = rewired(servo_run(tool=TOOL, temperatures=(0.0, 30.0, 60.0)), axes)
    drift = 1 + 2e-4 * (run["temperature_c"] - 20)
    run = {**run, "ax": run["ax"] * drift, "my": run["my"] * drift}
    options = ("--model", request.param, "--order", 2)
    return calibrated(folder, run, *options, tool=profile(folder, axes)), run, axes, request.param


@pytest.mark.parametrize("temperature", [0.0, 20.0, 60.0])
def test_at_a_temperature_all_notations_give_what_apply_gives(tmp_path, warm, temperature):
    calibration, run, axes, model = warm
    run = {**run, "temperature_c": np.full(len(run["ax"]), temperature)}
    option = () if temperature == 20 else ("--temperature", temperature)
    for (triad, (raw, field)), own in zip(
        corrected(tmp_path, calibration, run).items(), axes, strict=True
    ):
        document = converted(calibration, "forward", *option)
        assert document["temperature_c"] == temperature
        forward, affine = document[triad], converted(calibration, "affine", *option)[triad]
        assert forward["reference_temperature_c"] == 20.0
        again = field @ np.transpose(forward["S"]) + np.array(forward["o"])
        np.testing.assert_allclose(again, raw, rtol=0, atol=1e-9 * np.abs(raw).max())
        again = raw @ np.transpose(affine["M"]) + np.array(affine["b"])
        np.testing.assert_allclose(again, field, rtol=0, atol=1e-9 * np.abs(field).max())
        if model == "factors":
            factors = converted(calibration, "factors")[triad]
            assert np.shape(factors["SF"]) == np.shape(factors["B"]) == (3, 3)
            powers = (temperature - 20.0) ** np.arange(3)
            unit = raw / (np.array(factors["SF"]) @ powers) - np.array(factors["B"]) @ powers
            again = unit @ (np.eye(3) - np.array(factors["m"])).T @ permutation(own).T
            np.testing.assert_allclose(again, field, rtol=0, atol=1e-9 * np.abs(field).max())


COURSES = {"factors": "forward", "polynomial": "affine"}


def test_a_course_gives_what_apply_gives_at_every_temperature(tmp_path, warm):
    """raw = Σ (S_k · field + o_k) τᵏ, or field = Σ (M_k · raw + b_k) τᵏ, at 48 temperatures."""
    calibration, run, _, model = warm
    temperature = np.linspace(-10, 80, len(run["ax"]))
    results = corrected(tmp_path, calibration, {**run, "temperature_c": temperature})
    document = converted(calibration, COURSES[model], "--temperature", "course")
    assert document["temperature_c"] == "course"
    assert document["powers_of"] == "T - reference_temperature_c"
    names = ("S", "o") if model == "factors" else ("M", "b")
    for triad, (raw, field) in results.items():
        entry, tau = document[triad], temperature - document[triad]["reference_temperature_c"]
        source, target = (field, raw) if model == "factors" else (raw, field)
        matrix, offset = (np.array(entry[name]) for name in names)
        assert matrix.shape == (3, 3, 3)
        assert offset.shape == (5 if model == "factors" else 3, 3)
        again = np.einsum("kij,nj,nk->ni", matrix, source, tau[:, None] ** np.arange(3))
        again = again + tau[:, None] ** np.arange(len(offset)) @ offset
        np.testing.assert_allclose(again, target, rtol=0, atol=1e-9 * np.abs(target).max())
        count = matrix.size + offset.size
        assert np.shape(entry["covariance"]) == (count, count)
        for name in names:
            assert np.shape(entry["standard_uncertainty"][name]) == np.shape(entry[name])


def test_the_steady_part_of_a_course_is_the_reference_temperature(warm):
    notation = COURSES[warm[3]]
    steady, course = (
        converted(warm[0], notation),
        converted(warm[0], notation, "--temperature", "course"),
    )
    assert steady["temperature_c"] == 20.0
    assert "powers_of" not in steady
    for triad in TRIADS:
        for name in {"S", "o", "M", "b"} & set(steady[triad]):
            value = np.array(steady[triad][name])
            np.testing.assert_allclose(course[triad][name][0], value, rtol=1e-9)
            spread = steady[triad]["standard_uncertainty"][name]
            np.testing.assert_allclose(
                course[triad]["standard_uncertainty"][name][0], spread, rtol=1e-9
            )


@pytest.mark.parametrize("notation", NOTATIONS)
def test_without_temperature_terms_a_course_is_one_power(case, notation):
    steady = converted(case[0], notation)
    course = converted(case[0], notation, "--temperature", "course")
    for triad in TRIADS:
        for name in {"S", "o", "M", "b", "SF", "B", "m"} & set(steady[triad]):
            value = np.array(steady[triad][name])
            lead = value if notation == "factors" else value[None]
            np.testing.assert_allclose(course[triad][name], lead, rtol=1e-12)


def test_a_course_that_is_no_polynomial_is_refused(warm):
    other = {"factors": "affine", "polynomial": "forward"}[warm[3]]
    ran = mwdcal("convert", warm[0], "--notation", other, "--temperature", "course")
    message = refused(ran, 2)
    remedy = {"factors": "polynomial", "polynomial": "factors"}[warm[3]]
    assert f"`model` {remedy}" in message
    assert "accelerometer" in message
    assert "°C" in message


def test_the_text_of_a_course_names_the_powers(warm):
    notation = COURSES[warm[3]]
    said = mwdcal("convert", warm[0], "--notation", notation, "--temperature", "course").out
    assert "\n\nτ = T - 20 °C\n\naccelerometer\n" in said
    blocks = dict(zip(TRIADS, said.split("\n\nmagnetometer\n"), strict=True))
    document = converted(warm[0], notation, "--temperature", "course")
    for triad, block in blocks.items():
        rows = {
            row[0]: row[1:] for line in block.splitlines() if "[" in line for row in [line.split()]
        }
        entry, count = document[triad], 0
        for name in {"S", "o", "M", "b"} & set(entry):
            value, spread = np.array(entry[name]), np.array(entry["standard_uncertainty"][name])
            count += value.size
            for index in np.ndindex(value.shape):
                power = ("", "·τ", "·τ²", "·τ³", "·τ⁴")[index[0]]
                label = name + "".join(f"[{i}]" for i in index[1:]) + power
                assert rows[label] == [f"{value[index]:.12g}", f"{spread[index]:.2g}"]
        assert len(rows) == count


def test_a_polynomial_of_temperature_has_no_factors(warm):
    if warm[3] == "factors":
        pytest.skip("has factors")
    message = refused(mwdcal("convert", warm[0], "--notation", "factors"), 2)
    assert "`model` factors" in message


@pytest.mark.parametrize("notation", NOTATIONS)
def test_the_text_holds_the_numbers_of_the_json(case, notation):
    said = mwdcal("convert", case[0], "--notation", notation)
    blocks = dict(zip(TRIADS, said.out.split("\n\nmagnetometer\n"), strict=True))
    for triad, entry in converted(case[0], notation).items():
        if triad not in TRIADS:
            continue
        rows = [line.split() for line in blocks[triad].splitlines() if "[" in line]
        names = [k for k in entry if k in ("S", "o", "M", "b", "SF", "B", "m")]
        values = np.concatenate([np.ravel(entry[n]) for n in names])
        spread = np.concatenate([np.ravel(entry["standard_uncertainty"][n]) for n in names])
        assert [row[1] for row in rows] == [f"{v + 0.0:.12g}" for v in values]
        assert [row[2] for row in rows] == [f"{s:.2g}" for s in spread]


def test_written_and_printed_are_the_same(tmp_path, case):
    out = tmp_path / "affine.json"
    assert mwdcal("convert", case[0], "--notation", "affine", "-o", out).code == 0
    assert json.loads(out.read_bytes()) == converted(case[0], "affine")
    before = case[0].read_bytes()
    refused(mwdcal("convert", case[0], "--notation", "affine", "-o", case[0]), 2)
    assert case[0].read_bytes() == before


@pytest.mark.parametrize("options", [("matrix",), ("affine", "--temperature", "nan")], ids=str)
def test_options_that_cannot_be_meant(case, options):
    refused(mwdcal("convert", case[0], "--notation", *options), 2)


@pytest.mark.parametrize("word", ["warm", "20,5", "Course", ""])
def test_a_word_that_is_no_temperature(case, word):
    message = refused(mwdcal("convert", case[0], "--notation", "affine", "--temperature", word), 2)
    assert "'course'" in message
    assert f"got {word!r}" in message


def test_undetermined_values_have_no_uncertainty(tmp_path):
    """No toolface reference: what turns with the tool axis has none to state, what does not has."""
    run = servo_run(tool=TOOL)
    del run["ref_toolface_deg"]
    calibration = calibrated(tmp_path, run)
    found = converted(calibration, "affine")["accelerometer"]["standard_uncertainty"]["M"]
    assert found[0][0] is None or found[0][1] is None
    assert found[2][2] is not None
    said = mwdcal("convert", calibration, "--notation", "affine").out
    assert "nan" not in said.lower()


def test_undetermined_values_of_a_course_have_no_uncertainty(tmp_path):
    """No toolface reference: what turns with the tool axis has none to state, the zeros have."""
    run = servo_run(tool=TOOL, temperatures=(0.0, 30.0, 60.0))
    del run["ref_toolface_deg"], run["ref_azimuth_deg"]
    calibration = calibrated(tmp_path, run, "--model", "factors", "--order", 1)
    free = [u["id"] for u in json.loads(calibration.read_bytes())["accelerometer"]["undetermined"]]
    assert free == ["toolface-zero"]
    options = ("--notation", "forward", "--temperature", "course")
    ran = mwdcal("convert", calibration, *options, "--json")
    stated = ran.json["accelerometer"]["standard_uncertainty"]
    assert None in (stated["S"][0][0][1], stated["S"][0][1][0])
    assert stated["S"][0][2][2] is not None
    assert None not in np.ravel(stated["o"])
    said = mwdcal("convert", calibration, *options).out
    assert "nan" not in said.lower()
    assert "undetermined" in said


@pytest.fixture(scope="module")
def identified(tmp_path_factory):
    """A simulated tool of known serial, calibrated from 25 to 105 °C."""
    folder = tmp_path_factory.mktemp("warm")
    run = write_csv(
        folder / "run.csv", servo_run(toolfaces=4, temperatures=(25.0, 65.0, 105.0)),
        "serial = SIM-7", "simulated = true",
    )  # fmt: skip
    made = folder / "cal.json"
    ran = mwdcal("calibrate", run, "--tool", "servo", "--order", "1", "-o", made)
    assert ran.code == 0, ran.err
    return made


@pytest.mark.parametrize("notation", NOTATIONS)
def test_a_document_says_whose_it_is_in_which_units(identified, notation):
    made = json.loads(identified.read_bytes())
    document = converted(identified, notation)
    assert document["schema_version"] == 1
    assert document["serial"] == document["tool"]["serial"] == "SIM-7"
    assert document["simulated"] is True
    assert document["run"] == "run.csv"
    assert document["run_sha256"] == made["run_sha256"]
    assert document["calibration"] == "cal.json"
    assert document["calibration_sha256"] == hashlib.sha256(identified.read_bytes()).hexdigest()
    assert document["software"] == made["software"]
    assert document["field_unit"] == "nT"
    assert document["calibrated_temperature_c"] == [25.0, 105.0]
    units = {
        triad: (document[triad]["unit"], document[triad]["nominal_raw_per_unit"])
        for triad in TRIADS
    }
    assert units == {"accelerometer": ("g", 3.0), "magnetometer": ("nT", 5e-5)}
    assert document["findings"] == []
    screen = mwdcal("convert", identified, "--notation", notation).out
    for word in ("SIM-7", "run.csv", document["calibration_sha256"], "SIMULATED DATA", "30 °C"):
        assert word in screen


def test_a_temperature_outside_the_calibrated_range_is_a_finding(identified):
    for asked, told in ((400, True), (106.5, True), (105.5, False), (25, False), ("course", False)):
        notation = "factors" if asked == "course" else "affine"
        ran = mwdcal(
            "convert", identified, "--notation", notation, "--json", "--temperature", asked
        )
        assert ran.code == 0, ran.err
        ids = [finding["id"] for finding in ran.json["findings"]]
        assert ids == (["outside-temperature"] if told else []), asked
        assert ("25.0…105.0 °C" in ran.err) == told
    ran = mwdcal("convert", identified, "--notation", "forward", "--temperature", 400)
    assert "400 °C" in ran.err
    assert "temperature 400 °C   extrapolated: calibrated at 25.0…105.0 °C" in ran.out


def test_the_reference_temperature_may_be_outside_too(tmp_path):
    hot = servo_run(toolfaces=4, temperatures=(90.0, 120.0, 150.0))
    made = calibrated(tmp_path, hot, "--order", "1")
    assert [f["id"] for f in converted(made, "affine")["findings"]] == ["outside-temperature"]
    assert converted(made, "affine", "--temperature", "100")["findings"] == []
    steady = calibrated(tmp_path, hot, "--order", "0")
    assert converted(steady, "affine")["findings"] == []


def test_a_temperature_asked_of_a_calibration_without_any_is_a_finding(tmp_path):
    bare = {k: v for k, v in servo_run(toolfaces=4).items() if k != "temperature_c"}
    made = calibrated(tmp_path, bare)
    found = converted(made, "affine", "--temperature", "150")
    assert [f["id"] for f in found["findings"]] == ["no-temperature"]
    assert converted(made, "affine")["findings"] == []
