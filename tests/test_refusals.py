"""Refusals that name cause and remedy.

Elsewhere: unknown method, model, order and tool, orders without temperatures, contradicting
references, dead and swapped channels (test_cli_ugly); few stations, no redundancy, gains
(test_calibrate); stand errors that cannot be told apart (test_stand); a singular design that is
accepted, and what its message names (test_ranks).
"""

import re

import numpy as np
import pytest

from cli_support import (
    RAW,
    SCALE,
    SERVO_NOISE,
    Tool,
    channels,
    mwdcal,
    refused,
    servo_run,
    stations,
    write_csv,
)
from simulation import DEG, attitude

METHODS = ("joint", "least-squares", "swarm", "newton", "toolface-inclination", "scalar")


def calibrate(folder, run, *options):
    path = write_csv(folder / "run.csv", run)
    return mwdcal("calibrate", path, "--tool", "servo", "-o", folder / "cal.json", *options)


def said(folder, run, *options):
    """The message of a refusal that leaves no calibration behind."""
    message = refused(calibrate(folder, run, *options), 3)
    assert not (folder / "cal.json").exists()
    return message


def one_attitude(station=20):
    """Forty-eight noisy readings of one and the same station."""
    run = servo_run()
    rng = np.random.default_rng(0)
    noise = np.repeat(np.multiply(SCALE, SERVO_NOISE), 3)
    for name, sd in zip(RAW, noise, strict=True):
        run[name] = np.full(48, run[name][station]) + sd * rng.normal(size=48)
    for name in (n for n in run if n.startswith("ref_")):
        run[name] = np.full(48, run[name][station])
    return run


@pytest.mark.parametrize("method", METHODS)
def test_one_attitude_does_not_move_the_channels(tmp_path, method):
    message = said(tmp_path, one_attitude(), "--method", method)
    assert "accelerometer channel on tool axis x moves by 0.0" in message
    assert (
        "too little to calibrate it (all 48 stations have inclination 45° and toolface" in message
    )
    assert "Add stations at other inclinations" in message
    assert "and other toolfaces" in message


ANGLES_OF_STAND = {"inclination": (10.0, 170.0), "azimuth": (0.0, 360.0), "toolface": (0.0, 360.0)}


def at_one_angle(name, degrees):
    """Thirty-six noisy readings at angles of the stand that all vary but one."""
    tool, rng = Tool.random(1, noise=SERVO_NOISE), np.random.default_rng(3)
    angles = {each: rng.uniform(*limits, 36) for each, limits in ANGLES_OF_STAND.items()}
    angles[name] = np.full(36, degrees)
    turned = [np.radians(each) for each in angles.values()]
    g, b = (each[0] for each in tool.readings(rng, 1, *turned))
    earth = (tool.gravity, tool.field, np.degrees(tool.dip))
    return {**stations(*turned, earth=earth), **channels(g, b)}


@pytest.mark.parametrize("known", [True, False])
def test_one_toolface_is_named_and_asked_for_alone(tmp_path, known):
    """Thirty-six inclinations need no others. Without a reference the readings show the toolface."""
    run = at_one_angle("toolface", 40.0)
    run = {name: each for name, each in run.items() if known or name != "ref_toolface_deg"}
    message = said(tmp_path, run)
    cause = r"\(all 36 stations have toolface (about )?(\d+)°\): nothing determines accelerometer"
    about, angle = re.search(cause, message).groups()
    assert abs(float(angle) - 40) <= (0 if known else 5)
    assert (about is None) == known
    assert "Add stations at other toolfaces (six or more)." in message
    assert "gain" not in message
    assert "inclinations" not in message


def test_one_inclination_is_named_and_asked_for_alone(tmp_path):
    message = said(tmp_path, at_one_angle("inclination", 60.0))
    assert "on tool axis z" in message
    assert "(all 36 stations have inclination 60°). Add stations at other inclinations" in message
    assert "toolface" not in message


def test_one_azimuth_alone_is_enough(tmp_path):
    assert calibrate(tmp_path, at_one_angle("azimuth", 30.0)).code == 0


@pytest.mark.parametrize("model", ["polynomial", "factors"])
@pytest.mark.parametrize("inclinations", [(5, 45, 90), (45, 90, 135), (20, 45, 70)])
def test_three_inclinations_by_four_toolfaces_are_too_weak_for_strengths(
    tmp_path, inclinations, model
):
    run = servo_run(inclinations=inclinations, toolfaces=4)
    message = said(tmp_path, run, "--method", "scalar", "--model", model)
    assert "too weak to fit the model: nothing determines accelerometer" in message
    assert "Add stations at other inclinations" in message
    assert "six or more toolfaces" in message


def test_the_same_stations_with_all_references_are_enough(tmp_path):
    for inclinations in ((5, 45, 90), (45, 90, 135), (20, 45, 70)):
        run = servo_run(inclinations=inclinations, toolfaces=4)
        assert calibrate(tmp_path, run).code == 0


def blank_toolface(place=17):
    run = servo_run()
    return {
        **run,
        "ref_toolface_deg": np.where(np.arange(48) == place, np.nan, run["ref_toolface_deg"]),
    }


@pytest.mark.parametrize("method", ["least-squares", "swarm", "toolface-inclination"])
def test_one_missing_toolface_stops_what_needs_it(tmp_path, method):
    message = said(tmp_path, blank_toolface(), "--method", method)
    assert f"method {method} needs inclination, toolface" in message
    assert "'ref_toolface_deg' is blank at 1 of 48 (first: station 18)" in message
    assert "Fill it in, or use --method joint" in message


@pytest.mark.parametrize(("method", "rank"), [("joint", 12), ("newton", 11), ("scalar", 9)])
def test_one_missing_toolface_stops_nothing_else(tmp_path, method, rank):
    made = calibrate(tmp_path, blank_toolface(), "--method", method, "--json")
    assert made.code == 0
    assert [t["rank"] for t in made.json["triads"].values()] == [rank, rank]


@pytest.mark.parametrize("temperatures", [(20, 25), (20, 21, 23, 25), np.linspace(20, 25, 8)])
def test_order_3_over_five_degrees(tmp_path, temperatures):
    message = said(tmp_path, servo_run(temperatures=temperatures), "--order", 3)
    assert "spans 5.0 °C" in message
    assert "--order 3, which needs 4 of them over 30 °C or more" in message
    assert "Add temperatures, or lower --order." in message


@pytest.mark.parametrize("order", [1, 2, 3])
def test_the_swarm_knows_no_temperature(tmp_path, order):
    run = servo_run(temperatures=(20.0, 60.0, 100.0, 140.0))
    message = said(tmp_path, run, "--order", order, "--method", "swarm")
    assert "swarm finds the 12 parameters of one temperature" in message
    assert "use --order 0 for it, or --method joint" in message


@pytest.mark.parametrize("names", ["toolface-zero", "azimuth-zero,toolface-zero,tilt"])
def test_toolface_zero_is_not_to_be_had(tmp_path, names):
    message = said(tmp_path, servo_run(), "--estimate", names)
    assert "can never be told from a rotation of the sensors in the tool" in message
    assert "Set it by an index mark." in message


@pytest.mark.parametrize("weights", [[], ["--paper-weights"]], ids=["likelihood", "paper"])
def test_nine_strengths_for_nine_parameters_leave_no_noise_to_estimate(tmp_path, weights):
    """The rest of such a fit is rounding; the noise of the profile `generic` is not declared."""
    rng, designs = np.random.default_rng(4), []
    for _ in range(300):
        angles = np.arccos(rng.uniform(-1, 1, 9)), *rng.uniform(0, 2 * np.pi, (2, 9))
        unit = attitude(*angles)(1.0, 1.0, 65 * DEG)
        features = [np.column_stack([v, v**2, v * np.roll(v, 1, -1)]) for v in unit]
        designs.append((min(np.linalg.svd(f)[1][-1] for f in features), angles))
    angles = max(designs, key=lambda each: each[0])[1]
    vectors = attitude(*angles)(1.0, 50_000.0, 65 * DEG)
    run, clean = servo_run(inclinations=(20, 60, 100), toolfaces=3), channels(*vectors)
    for name, sd in zip(RAW, np.repeat(np.multiply(SCALE, SERVO_NOISE), 3), strict=True):
        run[name] = clean[name] + sd * rng.normal(size=9)
    run["sd_ref_field_nt"] = np.full(9, 30.0)
    path = write_csv(tmp_path / "run.csv", run)
    options = ("--method", "scalar", "--order", "0", "-o", tmp_path / "cal.json")
    message = refused(mwdcal("calibrate", path, *options, *weights), 3)
    assert "no redundancy (0.0 degrees of freedom)" in message
    assert not (tmp_path / "cal.json").exists()


@pytest.mark.parametrize(("unit", "field"), [("µT", 48.0), ("G", 0.48)])
def test_a_field_in_another_unit_is_named_and_no_channel(tmp_path, unit, field):
    message = said(tmp_path, servo_run() | {"ref_field_nt": np.full(48, field)})
    assert f"ref_field_nt is {field:g} nT" in message, unit
    assert "Is the reference in another unit?" in message
    assert "wrong column" not in message


def test_a_channel_that_moves_too_much_is_named_where_the_reference_is_good(tmp_path):
    run = servo_run()
    run["mx"] = 100 * np.asarray(run["mx"])
    assert "more than any field explains" in said(tmp_path, run)
