"""Verification rows: what is judged, how sure, and what is left out."""

import re

import msgspec
import numpy as np
import pytest

from mwdcal.calibration.calibrate import calibrate
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import STATE_STAND
from mwdcal.errors import InputError
from mwdcal.presentation.verification import after_failure, screen
from mwdcal.use.verification import Bounds, Limits, verify
from simulation import DEG, Tool, plan
from test_calibrate import NOISE, PROFILE, make, msgspec_replace

BOTH = Limits(
    name="both",
    spread=Bounds(inclination_deg=0.1, azimuth_deg=1, gravity_g=0.003),
    error=Bounds(inclination_deg=0.25, azimuth_deg=2),
)
SPREADS = Limits(name="spreads", spread=Bounds(inclination_deg=0.1, azimuth_deg=1, gravity_g=0.003))


@pytest.fixture(scope="module")
def record():
    return calibrate(make(), PROFILE)


def roll(inclination, seed=9, sd=NOISE, tool=None, toolfaces=None, **known):
    """Readings of one direction at twelve toolfaces, or others (degrees), with references."""
    tool = tool or Tool.random(7)
    face = plan((45,))[2] if toolfaces is None else np.asarray(toolfaces) * DEG
    inc, azi = np.full(len(face), inclination * DEG), np.full(len(face), 1.0)
    a, m = tool.readings(np.random.default_rng(seed), 1, inc, azi, face)
    values = {"inclination": inc, "azimuth": azi, "toolface": face, **known}
    return Readings(a[0], m[0], known=values, sd=sd, source="roll.csv")


def knocked(mg=8.0, nanotesla=600.0, **others):
    """The tool of the calibration after a knock: biases across its axis."""
    tool = Tool.random(7, **others)
    tool.offset = tool.offset + np.array([[mg * 1e-3, 0, 0], [nanotesla, 0, 0]])
    return tool


def rows_of(result):
    return {row.name: row for row in result.rows}


def ids(result):
    """Findings, but for those of every calibration here: its run states neither temperature nor serial."""
    return [f.id for f in result.findings if f.id not in ("no-temperature", "no-serial")]


def texts(result):
    """All findings in one."""
    return " ".join(f.text for f in result.findings)


def test_a_good_tool_passes(record):
    rows = [verify(record, roll(45, seed), SPREADS) for seed in range(40)]
    assert all(result.passed for result in rows)
    assert {row.name for row in rows[0].rows} == {
        "spread of inclination",
        "spread of azimuth",
        "spread of gravity",
    }


def test_an_error_common_to_the_run_cancels_in_a_spread_and_counts_in_an_error(record):
    common = {**NOISE, "gravity": np.array(0.01)}
    limits = Limits(name="g", spread=Bounds(gravity_g=0.003), error=Bounds(gravity_g=0.003))
    exact, loose = (
        {
            row.name: row.uncertainty
            for row in verify(record, roll(45, sd=sd, gravity=np.ones(12)), limits).rows
        }
        for sd in (NOISE, common)
    )
    assert loose["spread of gravity"] == pytest.approx(exact["spread of gravity"])
    assert loose["error of gravity"] == pytest.approx(np.hypot(exact["error of gravity"], 0.01))


@pytest.mark.parametrize("inclination", [0, 2, 179])
def test_azimuth_is_not_judged_near_vertical_and_it_says_so(record, inclination):
    result = verify(record, roll(inclination), SPREADS)
    assert result.passed
    assert "spread of azimuth" not in [row.name for row in result.rows]
    assert any("spread of azimuth" in f.text for f in result.findings if f.id == "not-judged")


def test_limits_that_could_not_be_judged_are_named(record):
    bare = roll(45)
    bare = msgspec_replace(
        bare, magnetometer=None, known={"inclination": bare.known["inclination"]}
    )
    result = verify(record, bare, SPREADS)
    assert [f for f in result.findings if f.id == "not-judged" and "azimuth" in f.text]


def test_guarded_rule_takes_the_uncertainty_off_the_limit(record):
    simple = verify(record, roll(45), SPREADS)
    row = next(r for r in simple.rows if r.name == "spread of inclination")
    tight = Bounds(inclination_deg=row.value + row.uncertainty)
    assert verify(record, roll(45), Limits(name="t", spread=tight)).passed
    assert not verify(record, roll(45), Limits(name="t", spread=tight, rule="guarded")).passed


UNROLLED = {
    "one": np.full(12, 40),
    "three close ones": np.array([0, 5, 10]),
    "half a circle": np.arange(12) * 15,
}
KNOWN = {
    "group": {},
    "nothing": {},
    "references": {"inclination", "azimuth", "toolface"},
    "group and references": {"inclination", "azimuth"},
}


@pytest.mark.parametrize("known", KNOWN)
@pytest.mark.parametrize("toolfaces", UNROLLED.values(), ids=UNROLLED)
def test_a_tool_that_was_not_rolled_cannot_pass(record, toolfaces, known):
    """Knocked by 8 mg and 600 nT: 0.65° of inclination over a turn, next to nothing at one toolface."""
    for seed in range(4):
        test = roll(45, seed, tool=knocked(), toolfaces=toolfaces)
        group = np.zeros(len(toolfaces), int) if known.startswith("group") else None
        kept = {k: v for k, v in test.known.items() if k in KNOWN[known]}
        test = msgspec_replace(test, known=kept, group=group)
        if known == "nothing":  # it does not even say that it is a roll test
            with pytest.raises(
                InputError, match=r"is no roll test.* leave a gap of .*Add toolfaces there"
            ):
                verify(record, test, BOTH)
            continue
        result = verify(record, test, BOTH)
        assert not result.passed
        for row in result.rows:
            assert not row.passed
            assert row.value is row.uncertainty is None
            assert "leave a gap of" in row.note
            assert "Add toolfaces there" in row.note
    turned = verify(record, roll(45, tool=knocked()), BOTH)
    assert rows_of(turned)["spread of inclination"].value == pytest.approx(0.65, abs=0.04)


def test_a_group_that_was_not_rolled_fails_beside_one_that_was(record):
    inc, azi, face = (
        np.tile(v, 2) for v in (np.full(12, 45 * DEG), np.full(12, 1.0), np.arange(12))
    )
    face = np.where(np.arange(24) < 12, face * 30 * DEG, 40 * DEG)
    a, m = Tool.random(7).readings(np.random.default_rng(2), 1, inc, azi, face)
    group = np.repeat([0, 1], 12)
    test = Readings(a[0], m[0], sd=NOISE, source="roll.csv", group=group)
    assert not verify(record, test, SPREADS).passed
    known = {"inclination": inc, "azimuth": np.where(group == 0, azi, 1.5)}
    apart = verify(record, msgspec_replace(test, group=None, known=known), SPREADS)
    assert apart.passed
    assert ids(apart).count("partly-judged") == 3


def test_errors_at_four_right_angles_say_what_they_do_not_show(record):
    test = roll(45, toolfaces=np.arange(4) * 90)
    limits = Limits(name="e", error=Bounds(inclination_deg=0.25))
    result = verify(record, test, limits)
    assert result.passed
    assert ids(result) == ["harmonic-unseen"]
    assert ids(verify(record, roll(45), limits)) == []


def test_a_perfect_tool_at_half_a_milligram_passes(record):
    """Noise of 0.5 mg: 0.029° of inclination. The raw spread of twelve fails 0.1° in two of five."""
    noise = {"accelerometer": np.array(5e-4), "magnetometer": np.array(15.0)}
    limits = Limits(name="i", spread=Bounds(inclination_deg=0.1))
    tool = Tool.random(7, noise=(5e-4, 15.0))
    found = [verify(record, roll(45, s, noise, tool), limits).rows[0] for s in range(100)]
    assert np.mean([row.raw > 0.1 for row in found]) > 0.2
    assert np.mean([row.passed for row in found]) > 0.97


def test_the_uncertainty_is_that_of_the_test_not_of_the_calibration():
    """A poor calibration of 12 stations: its error is part of what is found, not a doubt about it."""
    poor = calibrate(make(3, (10, 60, 120), 4), PROFILE)
    truth = Tool.random(7)
    inc, azi, face = np.full(720, 45 * DEG), np.full(720, 1.0), np.arange(720) * 0.5 * DEG
    clean = [v[None] for v in truth.clean(inc, azi, face)]
    g, _ = poor.fields(Readings(clean[0][0], clean[1][0]))
    wanted = np.ptp(np.degrees(np.arctan2(np.hypot(g[:, 0], g[:, 1]), g[:, 2])))
    limits = Limits(name="i", spread=Bounds(inclination_deg=0.1))
    rows = [verify(poor, roll(45, s), limits).rows[0] for s in range(120)]
    departure = [(row.value - wanted) / row.uncertainty for row in rows]
    assert 0.8 < np.sqrt(np.mean(np.square(departure))) < 1.2
    assert abs(np.mean(departure)) < 0.4


def test_the_harmonics_name_the_cause(record):
    """8 mg across: a first harmonic of 8e-3 cos 45° rad. Scales of x and y 1 % apart: a second one.

    Those move inclination by sin 45° cos 45° 0.01 sin² T: a range of 0.286°, half of it as amplitude.
    """
    first = verify(record, roll(45, tool=knocked(nanotesla=0)), SPREADS)
    row = rows_of(first)["spread of inclination"]
    assert row.harmonics == pytest.approx((np.degrees(8e-3 * np.sqrt(0.5)), 0), abs=0.01)
    text = next(f.text for f in first.findings if f.id == "roll-harmonics")
    assert "first harmonic 0.32° (a bias" in text
    assert "second" not in text
    tool = Tool.random(7)
    tool.matrix = tool.matrix * np.array([[[1.01], [1], [1]], [[1], [1], [1]]])
    tool.offset = tool.offset * np.array([[1.01, 1, 1], [1, 1, 1]])
    second = verify(record, roll(45, tool=tool), SPREADS)
    row = rows_of(second)["spread of inclination"]
    assert row.harmonics == pytest.approx((0, 0.143), abs=0.01)
    text = next(f.text for f in second.findings if f.id == "roll-harmonics")
    assert "second harmonic 0.14° (a difference in scale" in text
    assert "first" not in text


@pytest.mark.parametrize("inclination", [0.3, 1, 179.5])
@pytest.mark.parametrize("angle", ["azimuth", "toolface"])
def test_errors_are_not_judged_near_vertical(record, inclination, angle):
    limits = Limits(name="e", error=Bounds(inclination_deg=0.25, **{f"{angle}_deg": 0.2}))
    for seed in range(5):
        result = verify(record, roll(inclination, seed), limits)
        assert result.passed
        assert list(rows_of(result)) == ["error of inclination"]
        assert ids(result) == ["not-judged"]
        assert f"error of {angle} (every station within 5° of vertical)" in texts(result)


def test_stations_near_vertical_are_left_out_of_an_error(record):
    inc, azi, face = (
        np.repeat([2, 45], 12) * DEG,
        np.full(24, 1.0),
        np.tile(np.arange(12) * 30, 2) * DEG,
    )
    a, m = Tool.random(7).readings(np.random.default_rng(1), 1, inc, azi, face)
    known = {"inclination": inc, "azimuth": azi, "toolface": face}
    test = Readings(a[0], m[0], known=known, sd=NOISE, source="roll.csv")
    result = verify(record, test, Limits(name="e", error=Bounds(azimuth_deg=0.2)))
    assert result.passed
    assert [f.text for f in result.findings if f.id == "partly-judged"] == [
        "error of azimuth: 12 of 24 stations lie within 5° of vertical."
    ]


def test_gravity_field_and_dip_are_judged_by_references_of_the_test_alone():
    """Gravity of 0.9967 g: a good tool is not 3.3 mg wrong because a test says nothing of it."""
    tool = Tool.random(7, gravity=0.9967)
    run = make(tool=tool)
    known = {**run.known, "gravity": np.full(48, 0.9967)}
    own = calibrate(msgspec_replace(run, known=known), PROFILE)
    bounds = Bounds(gravity_g=0.002, field_nt=200, dip_deg=0.2, inclination_deg=0.25)
    limits = Limits(name="g", error=bounds)
    silent = verify(own, roll(45, tool=tool), limits)
    assert silent.passed
    assert list(rows_of(silent)) == ["error of inclination"]
    for column in ("ref_gravity_g", "ref_field_nt", "ref_dip_deg"):
        assert f"(no {column})" in texts(silent)
    given = {
        "gravity": np.full(12, 0.9967),
        "field": np.full(12, 5e4),
        "dip": np.full(12, tool.dip),
    }
    assert len(verify(own, roll(45, tool=tool, **given), limits).rows) == 4
    assert verify(own, roll(45, tool=tool, **given), limits).passed
    assert not verify(own, roll(45, tool=tool, **{**given, "gravity": np.ones(12)}), limits).passed


def test_soaks_are_not_pooled(record):
    """Between two soaks |g| moves by 4 mg; within each it does not."""
    one, other = (roll(45, seed, toolfaces=np.arange(6) * 60) for seed in (1, 2))
    join = {k: np.concatenate([one.known[k], other.known[k]]) for k in one.known}
    test = Readings(
        np.concatenate([one.accelerometer, 1.004 * other.accelerometer]),
        np.concatenate([one.magnetometer, other.magnetometer]),
        known=join, sd=NOISE, source="roll.csv",
    )  # fmt: skip
    assert not verify(record, test, SPREADS).passed
    for group in (None, np.zeros(12, int)):
        warmth = np.repeat([20.0, 40.0], 6) + np.tile(np.arange(6) / 2, 2)
        apart = verify(record, msgspec_replace(test, temperature=warmth, group=group), SPREADS)
        assert apart.passed
        assert all("°C" in row.note for row in apart.rows)


def test_equal_inclinations_without_azimuth_are_not_one_direction(record):
    """Four azimuths: inclination and |g| depend on toolface alone, azimuth is what differs."""
    inc, face = np.full(24, 45 * DEG), np.tile(np.arange(6) * 60 * DEG, 4)
    azi = np.repeat([0, 90, 180, 270], 6) * DEG
    a, m = Tool.random(7).readings(np.random.default_rng(1), 1, inc, azi, face)
    test = Readings(a[0], m[0], known={"inclination": inc}, sd=NOISE, source="roll.csv")
    result = verify(record, test, SPREADS)
    assert result.passed
    assert list(rows_of(result)) == ["spread of inclination", "spread of gravity"]
    assert "need group or ref_azimuth_deg" in texts(result)
    known = {"inclination": inc, "azimuth": azi}
    assert len(verify(record, msgspec_replace(test, known=known), SPREADS).rows) == 3


def test_a_guarded_failure_within_the_limit_says_so(record):
    value = rows_of(verify(record, roll(45, tool=knocked(2)), SPREADS))["spread of inclination"]
    tight = Bounds(inclination_deg=value.value + value.uncertainty)
    row = verify(
        record, roll(45, tool=knocked(2)), Limits(name="t", spread=tight, rule="guarded")
    ).rows[0]
    assert not row.passed
    assert row.value < row.limit < row.value + 2 * row.uncertainty
    assert "within the limit, but not by twice its uncertainty" in row.note
    over = Bounds(inclination_deg=value.value / 2)
    row = verify(
        record, roll(45, tool=knocked(2)), Limits(name="t", spread=over, rule="guarded")
    ).rows[0]
    assert "within" not in row.note


def test_a_station_that_moved_is_judged_as_it_is(record):
    """One reading of twelve off by 0.3°: a curve would show a part of it."""
    test = roll(45)
    bent = test.accelerometer.copy()
    bent[4] = bent[4] + [0, 0, 0.3 * DEG / np.sin(45 * DEG)]
    row = rows_of(verify(record, msgspec_replace(test, accelerometer=bent), SPREADS))[
        "spread of inclination"
    ]
    assert row.value == row.raw > 0.2
    assert row.judged_raw
    assert "raw figure judged" in row.note


def test_nothing_is_taken_off_the_raw_figure_of_two_sets_that_are_not_smooth(record):
    """One reading of each set off by 0.3°. Neither set alone passes 0.25°, so both together do not."""
    test = several(2, 1, 0.0, record)
    bent = test.accelerometer.copy()
    bent[[4, 16], 2] += 0.4 * DEG
    spread = Limits(name="t", spread=Bounds(inclination_deg=0.25))
    result = verify(record, msgspec_replace(test, accelerometer=bent), spread)
    (row,) = result.rows
    assert [each.judged_raw for each in row.sets] == [True, True]
    assert row.value == max(each.raw for each in row.sets) > row.limit
    assert not row.passed
    assert "taken off" not in row.note
    assert "not-smooth" in ids(result)
    assert "weak-test" not in ids(result)


def test_a_test_too_noisy_for_its_limit_is_a_finding(record):
    noise = {"accelerometer": np.array(2e-3), "magnetometer": np.array(15.0)}
    result = verify(record, roll(45, 1, noise, Tool.random(7, noise=(2e-3, 15.0))), SPREADS)
    text = [f.text for f in result.findings if f.id == "weak-test"]
    assert any("spread of inclination" in t and "more than half of the limit" in t for t in text)
    assert "weak-test" not in ids(verify(record, roll(45), SPREADS))


def test_setting_the_stand_each_time_adds_its_repeatability_and_a_roll_in_place_does_not(record):
    """σ of 0.05° per setting, beside 0.006° of noise: a spread is uncertain by it only where set."""
    sd = {**NOISE, "inclination": np.array(0.05 * DEG)}
    limits = Limits(
        name="i", spread=Bounds(inclination_deg=0.1), error=Bounds(inclination_deg=0.25)
    )
    turned = roll(45 + 0.05 * np.random.default_rng(1).normal(size=12), sd=sd)
    known = {**turned.known, "inclination": np.full(12, 45 * DEG)}
    each = rows_of(verify(record, msgspec_replace(turned, known=known), limits))
    still = msgspec_replace(roll(45, sd=sd), group=np.zeros(12, int))
    shared = rows_of(verify(record, still, limits))
    assert each["spread of inclination"].uncertainty > 0.03
    assert shared["spread of inclination"].uncertainty < 0.01
    assert shared["error of inclination"].uncertainty == pytest.approx(0.05, rel=0.05)


@pytest.mark.parametrize("kind", ["spread", "error"])
def test_uncertainties_without_any_weight_are_refused(record, kind):
    """Settings of the stand so uncertain that their weights are zero: no curve, and no verdict."""
    sd = {**NOISE, "inclination": np.full(12, 1e200)}
    limits = Limits(name="i", **{kind: Bounds(inclination_deg=0.1)})
    run = msgspec_replace(roll(45, sd=sd), settings="per-station")
    with pytest.raises(InputError, match=r"roll.csv: .* too far apart to judge its inclination"):
        verify(record, run, limits)


@pytest.mark.parametrize("ratio", [1e2, 1e3, 1e7, 1e9])
def test_uncertainties_too_far_apart_are_refused_and_others_judged(record, ratio):
    """Four settings of twelve that are much better known do not determine a curve of five coefficients.

    At ratios that leave digits they are judged.
    """
    sd = {**NOISE, "inclination": np.where(np.arange(12) % 3 == 0, 1.0, ratio) * 1e-4}
    limits = Limits(name="i", error=Bounds(inclination_deg=0.1))
    known = {**roll(45).known, "inclination": np.full(12, 45 * DEG)}
    run = msgspec_replace(roll(45, sd=sd), known=known, settings="per-station")
    if ratio > 1e4:
        with pytest.raises(InputError, match="too far apart to judge its inclination"):
            verify(record, run, limits)
    else:
        assert rows_of(verify(record, run, limits))["error of inclination"].value is not None


@pytest.mark.parametrize(
    ("order", "temperature", "outside"),
    [(0, 25.0, None), (0, 28.5, "finding"), (0, 31.0, "refused"), (1, 51.5, "refused")],
)
def test_how_far_outside_its_temperatures_a_calibration_is_verified(order, temperature, outside):
    """Without temperature terms up to a soak's 5 °C with a finding; with them 1 °C."""
    warmth = np.repeat([0.0, 50.0], 48) if order else np.full(48, 25.0)
    parts = [make(seed) for seed in range(2 if order else 1)]
    run = msgspec_replace(
        parts[0],
        accelerometer=np.concatenate([p.accelerometer for p in parts]),
        magnetometer=np.concatenate([p.magnetometer for p in parts]),
        known={k: np.concatenate([p.known[k] for p in parts]) for k in parts[0].known},
        temperature=warmth,
    )
    own = calibrate(run, PROFILE, Options(order=order))
    test = msgspec_replace(roll(45), temperature=np.full(12, temperature))
    if outside == "refused":
        with pytest.raises(InputError, match="12 stations lie outside the calibrated range"):
            verify(own, test, SPREADS)
        one = np.where(np.arange(12) == 4, temperature, 25.0)
        with pytest.raises(InputError, match=r"1 station lies outside .* \(first: station 5\)"):
            verify(own, msgspec_replace(test, temperature=one), SPREADS)
        return
    result = verify(own, test, SPREADS)
    assert result.passed
    assert ids(result) == (["outside-temperature"] if outside else [])


def test_a_calibration_without_temperatures_says_so_at_any(record):
    hot = verify(record, msgspec_replace(roll(45), temperature=np.full(12, 150.0)), SPREADS)
    mild = verify(record, roll(45), SPREADS)
    for result, said in ((hot, "the test alone, 150.0 °C."), (mild, "the test alone.")):
        assert {finding.id for finding in result.findings} == {"no-serial", "no-temperature"}
        (text,) = [finding.text for finding in result.findings if finding.id == "no-temperature"]
        assert "its run recorded no temperature" in text
        assert text.endswith(said)


def test_common_errors_of_the_stand_count_in_errors_and_not_in_spreads(record):
    """A lean of the stand towards any azimuth turns azimuths by cot I and toolfaces by 1 / sin I."""
    bounds = Bounds(inclination_deg=0.3, azimuth_deg=2, toolface_deg=2)
    limits = Limits(name="i", spread=Bounds(inclination_deg=0.1), error=bounds)
    plain = rows_of(verify(record, roll(30), limits))
    zeros = {**NOISE, "inclination-zero": np.full(12, 0.05 * DEG), "tilt": np.full(12, 0.04 * DEG)}
    shared = rows_of(verify(record, roll(30, sd=zeros), limits))
    assert shared["spread of inclination"] == plain["spread of inclination"]
    lean = 0.04**2 / 2
    own = {"inclination": 0.05**2 + lean, "azimuth": 3 * lean, "toolface": 4 * lean}
    for name, added in own.items():
        before = plain[f"error of {name}"].uncertainty
        after = shared[f"error of {name}"].uncertainty
        assert after == pytest.approx((before**2 + added) ** 0.5, rel=5e-3)


# ------------------------------------------------------------------ settings, sets and degrees of freedom

STAND = {"inclination": np.full(12, 0.1 * DEG), "azimuth": np.full(12, 0.3 * DEG)}
ERRORS = Limits(name="errors", error=Bounds(inclination_deg=0.25, azimuth_deg=2))


@pytest.mark.parametrize(
    ("settings", "group", "share"),
    [
        ("", None, 1),
        ("per-direction", None, 1),
        ("per-station", None, 12),
        ("", np.zeros(12, int), 1),
    ],
)
def test_the_error_of_a_setting_does_not_average_down(record, settings, group, share):
    """1σ of an error: √(σ²/share + noise), the noise of a mean and harmonics being small beside 0.1°."""
    run = msgspec_replace(roll(45, sd={**NOISE, **STAND}), settings=settings, group=group)
    result = verify(record, run, ERRORS)
    for name, sd in (("inclination", 0.1), ("azimuth", 0.3)):
        row = rows_of(result)[f"error of {name}"]
        if share == 1:
            assert row.uncertainty == pytest.approx(sd, rel=0.05)
        else:  # the farthest point of a curve of which the mean has σ/√12, each part of a harmonic √2 times that
            part = sd / np.sqrt(12) * np.random.default_rng(1).normal(size=(2000, 5))
            turn = plan((45,), 180)[2]
            waves = np.stack([f(k * turn) for k in (1, 2) for f in (np.cos, np.sin)])
            farthest = np.abs(part[:, :1] + np.sqrt(2) * part[:, 1:] @ waves).max(-1)
            assert sd / np.sqrt(12) < row.uncertainty < 1.05 * np.sqrt(np.mean(farthest**2))
    assert result.settings == (settings or ("assumed" if group is None else ""))


def test_a_direction_set_twice_has_two_settings(record):
    """Two passes over one direction, another in between: the mean has σ/√2 of the setting."""
    first = roll(45, sd={**NOISE, **STAND})
    parts = [first, roll(60, 3, sd={**NOISE, **STAND}), roll(45, 5, sd={**NOISE, **STAND})]
    known = {k: np.concatenate([each.known[k] for each in parts]) for k in first.known}
    run = Readings(
        np.concatenate([each.accelerometer for each in parts]),
        np.concatenate([each.magnetometer for each in parts]),
        known=known,
        sd={**NOISE, "inclination": np.full(36, 0.1 * DEG)},
        source="roll.csv",
        settings="per-direction",
    )
    limits = Limits(name="errors", error=Bounds(inclination_deg=0.25))
    (row,) = verify(record, run, limits).rows
    by_label = {each.label.partition(",")[0]: each for each in row.sets}
    assert by_label["inclination 45°"].uncertainty == pytest.approx(0.1 / np.sqrt(2), rel=0.1)
    assert by_label["inclination 60°"].uncertainty == pytest.approx(0.1, rel=0.05)


def test_a_scatter_that_contradicts_one_setting_is_named_and_counted(record):
    """Each station set anew by a stand of 0.1°, and nobody says so."""
    rng = np.random.default_rng(1)
    inclination = (45 + 0.1 * rng.normal(size=12)) * DEG
    face = plan((45,))[2]
    a, m = Tool.random(7).readings(rng, 1, inclination, np.full(12, 1.0), face)
    known = {"inclination": np.full(12, 45 * DEG), "azimuth": np.full(12, 1.0), "toolface": face}
    run = Readings(a[0], m[0], known=known, sd={**NOISE, **STAND}, source="roll.csv")
    result = verify(record, run, BOTH)
    assert "settings-doubted" in ids(result)
    assert "raw figure judged" not in rows_of(result)["spread of inclination"].note
    once = verify(record, msgspec_replace(run, settings="per-direction"), BOTH)
    assert "raw figure judged" in rows_of(once)["spread of inclination"].note
    apart = verify(record, msgspec_replace(run, settings="per-station"), BOTH)
    assert "settings-doubted" not in ids(apart)
    single, both = (rows_of(each)["error of inclination"].uncertainty for each in (apart, result))
    assert single < both


def test_the_raw_figure_stands_beside_each_value(record):
    """Of each roll set: largest less smallest departure, or the largest; the row has the largest of all."""
    result = verify(record, several(3, 1, 0.0, record), BOTH)
    for row in result.rows:
        departures = np.array([station.departures[row.name] for station in result.station_rows])
        for each in row.sets:
            part = departures[each.stations]
            raw = np.ptp(part) if row.name.startswith("spread") else np.abs(part).max()
            assert each.raw == pytest.approx(raw)
        assert row.raw == max(each.raw for each in row.sets)


@pytest.mark.parametrize(
    ("name", "factor", "shift", "shown"),
    [("dip", -1, 0, "dip by [+]130°"), ("field", 1e-3, 0, "field by [+]5e[+]04 nT"),
     ("toolface", 1, 30 * DEG, "toolface by -30°"), ("gravity", 0.98, 0, "gravity by [+]0.02 g")],
)  # fmt: skip
def test_references_that_no_limit_judges_and_the_readings_contradict_are_named(
    record, name, factor, shift, shown
):
    """Of a sound tool at dip 65° in 50,000 nT, whose inclination and azimuth are right."""
    face = plan((45,))[2]
    known = {"dip": np.full(12, 65 * DEG), "field": np.full(12, 5e4), "gravity": np.ones(12)}
    right = roll(45, **known, toolface=face)
    assert "contradicted" not in ids(verify(record, right, BOTH))
    wrong = msgspec_replace(right, known={**right.known, name: right.known[name] * factor + shift})
    result = verify(record, wrong, BOTH)
    assert result.passed
    [text] = [f.text for f in result.findings if f.id == "contradicted"]
    assert re.search(shown, text)
    errors = {
        "dip": "dip_deg",
        "field": "field_nt",
        "toolface": "toolface_deg",
        "gravity": "gravity_g",
    }
    judged = Limits(name="all", error=Bounds(**{errors[name]: 1.0}))
    assert "contradicted" not in ids(verify(record, wrong, judged))


@pytest.mark.parametrize(
    ("name", "off", "shown"),
    [("field", 900.0, "field {field:.0f} nT and {other:.0f} nT"), ("field", 150.0, ""),
     ("dip", 1.0 * DEG, "dip 65.00° and 66.00°"), ("dip", 0.1 * DEG, ""),
     ("gravity", 1e-3, "gravity 1.0000 g and 1.0010 g"), ("gravity", 4e-4, "")],
)  # fmt: skip
def test_references_of_one_day_that_differ_are_named(record, name, off, shown):
    """Of the calibration's run and the test: by more than a day and rounding change them."""
    field = record.earth["field"]
    dated = msgspec.structs.replace(
        record, tool={**record.tool, "date": "2026-03-14"}, gravity_stated=True, constants=[]
    )
    known = {"dip": np.full(12, 65 * DEG), "field": np.full(12, field), "gravity": np.ones(12)}
    known[name] = known[name] + off
    test = roll(45, **known, toolface=plan((45,))[2])
    for day, sd, differs in (
        ("2026-03-14", {}, bool(shown)),
        ("2026-03-15", {}, False),
        ("", {}, False),
        ("2026-03-14", {name: np.full(12, 2 * off)}, False),
    ):
        readings = msgspec_replace(test, metadata={"date": day}, sd={**test.sd, **sd})
        texts = [
            each.text
            for each in verify(dated, readings, BOTH).findings
            if each.id == "contradicted-by-run"
        ]
        assert bool(texts) == differs, (day, sd)
        if differs:
            assert f"references: {shown.format(field=field, other=field + off)}. " in texts[0]


@pytest.mark.parametrize(
    ("name", "shift", "size", "hint"),
    [
        ("azimuth", 180, "180°", "the opposite direction"),
        ("azimuth", 12, "-12°", "another zero, north or sense"),
        ("toolface", -90, "+90°", "another zero, north or sense"),
        ("inclination", 8, "-8°", "another zero, north or sense"),
    ],
)
def test_a_reference_that_is_wrong_at_all_toolfaces_is_named_and_no_harmonic(
    record, name, shift, size, hint
):
    """Noise of a sound tool lies on both sides of half a turn: no jump of 360° is an error."""
    right = roll(45, toolface=plan((45,))[2])
    limits = Limits(name="e", error=Bounds(**{f"{name}_deg": 2.0}))
    assert verify(record, right, limits).passed
    wrong = msgspec_replace(right, known={**right.known, name: right.known[name] + shift * DEG})
    result = verify(record, wrong, limits)
    [row] = result.rows
    assert row.value == pytest.approx(abs(shift), abs=0.2)
    assert row.uncertainty < 0.1
    assert max(row.harmonics) < 0.2
    assert ids(result) == ["constant-error"]
    text = next(f.text for f in result.findings if f.id == "constant-error")
    assert text.startswith(f"error of {name}: every station is off by {size[:-1]}")
    assert f"wrong by as much: {hint}? Correct it" in text
    again, command, _ = after_failure(result, "tool.json", "roll.csv")
    assert again.startswith("nothing to measure again")
    assert command == "mwdcal verify tool.json roll.csv"


def test_few_degrees_of_freedom_are_explained_on_the_screen(record):
    few = calibrate(msgspec_replace(make(3, (10, 60, 120), 4), sd={}), PROFILE)
    for calibration, said in ((record, False), (few, True)):
        shown = screen(verify(calibration, roll(45, sd={}), SPREADS), None)
        assert ("DoF, degrees of freedom of the 1σ" in shown) == said


def test_errors_that_are_far_apart_stay_within_half_a_turn(record):
    """x and y of the magnetometer are exchanged: the error of azimuth goes to and fro with the toolface."""
    right = roll(45)
    exchanged = right.magnetometer[:, [1, 0, 2]]
    known = {**right.known, "azimuth": right.known["azimuth"] + 135 * DEG}
    result = verify(record, msgspec_replace(right, magnetometer=exchanged, known=known), BOTH)
    assert rows_of(result)["error of azimuth"].raw <= 180
    assert "constant-error" not in ids(result)


def test_a_large_bias_is_no_wrong_reference(record):
    """A hundred times the limit: its error changes sign over the turn."""
    result = verify(record, roll(45, tool=knocked(nanotesla=12_000)), BOTH)
    assert "constant-error" not in ids(result)
    assert "roll-harmonics" in ids(result)


def several(count, seed, size, record, toolfaces=12, sd=NOISE):
    """Roll sets of one direction at 45°, each a group, of a tool knocked across its axis: a run."""
    face = np.tile(np.arange(toolfaces) * 360 / toolfaces, count) * DEG
    inc, azi = np.full(len(face), 45 * DEG), np.full(len(face), 1.0)
    tool = knocked(size, 0.0)
    a, m = tool.readings(np.random.default_rng(seed), 1, inc, azi, face)
    group = np.repeat(np.arange(count), toolfaces)
    return Readings(a[0], m[0], known={}, sd=sd, source="roll.csv", group=group)


def test_equal_sets_at_the_limit_pass_in_half_of_the_tests(record):
    """The limit is the true spread, by 360 toolfaces. By the largest set alone one in 64 would pass."""
    quiet = several(1, 0, 8.0, record, 360)
    true = rows_of(verify(record, quiet, SPREADS))["spread of inclination"].value
    limits = Limits(name="i", spread=Bounds(inclination_deg=true))
    verdicts = [verify(record, several(6, seed, 8.0, record), limits) for seed in range(60)]
    passed = np.mean([each.passed for each in verdicts])
    assert 0.25 < passed < 0.75
    assert 0.15 < np.mean([each.risk for each in verdicts]) < 0.4
    (row,) = verdicts[0].rows
    assert row.value < max(each.value for each in row.sets)
    assert "the largest of 6 roll sets" in row.note
    again = verify(record, several(6, 0, 8.0, record), limits)
    assert again == verdicts[0]


def test_four_toolfaces_are_judged_by_a_mean_and_one_harmonic(record):
    run = roll(45, tool=knocked(8.0, 0.0), toolfaces=np.arange(4) * 90 + 20)
    result = verify(record, run, SPREADS)
    row = rows_of(result)["spread of inclination"]
    # 8 mg across the axis at 45°: an amplitude of 8e-3 cos 45° rad, twice that from end to end
    assert row.value == pytest.approx(np.degrees(2 * 8e-3 * np.cos(45 * DEG)), abs=0.05)
    assert "harmonic-unseen" in ids(result)
    assert row.sets[0].harmonics == 1
    assert row.sets[0].coefficients[2] == row.sets[0].coefficients[4] == 0


def test_an_estimated_noise_has_degrees_of_freedom_and_its_risk_is_never_certain(record):
    """Six toolfaces, noise not declared: those of the calibration and one for each curve."""
    bare = calibrate(msgspec_replace(make(), sd={}), PROFILE)
    run = roll(45, toolfaces=np.arange(6) * 60)
    undeclared = msgspec_replace(run, sd={})
    row = rows_of(verify(bare, undeclared, SPREADS))["spread of inclination"]
    assert row.degrees_of_freedom == pytest.approx(bare.accelerometer.degrees_of_freedom + 1)
    assert rows_of(verify(record, run, SPREADS))["spread of inclination"].degrees_of_freedom is None


@pytest.mark.parametrize(("noise", "word"), [(NOISE, "stated"), ({}, "estimated")])
def test_readings_that_scatter_too_little_name_the_noise_they_are_compared_with(noise, word):
    made = calibrate(make(sd=noise), PROFILE)
    quiet = roll(45, sd=noise)
    mean, turn = quiet.accelerometer.mean(0), plan((45,))[2]
    waves = np.stack([np.ones(12), *(f(k * turn) for k in (1, 2) for f in (np.cos, np.sin))], -1)
    smooth = waves @ np.linalg.lstsq(waves, quiet.accelerometer - mean, rcond=None)[0] + mean
    result = verify(made, msgspec_replace(quiet, accelerometer=smooth), BOTH)
    (text,) = (each.text for each in result.findings if each.id == "little-scatter")
    assert STATE_STAND in text
    assert (
        "too large, or the tool moved, during the run of the calibration or as readbacks say"
        in text
    )
    assert f"less about the curves than the {word} noise explains" in text
    assert text.endswith(f"The 1σ comes from the {word} noise.")
