"""Members of a batch: taken out of nested dataclasses of arrays, and put back."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mwdcal.calibration.diagnosis.flags import FittedRuns
from mwdcal.calibration.diagnosis.refusals import check, fit_refusals, reading_refusals
from mwdcal.calibration.estimate import fit
from mwdcal.calibration.options import Options
from mwdcal.calibration.readings import Readings
from mwdcal.errors import FitError, InputError
from mwdcal.estimation.batch import (
    batch_of_one,
    for_all,
    held_once,
    is_once,
    join,
    kind_of,
    put,
    take,
)
from mwdcal.sensor.profile import Profile, TriadProfile
from simulation import Tool, plan


@dataclass(frozen=True)
class Leaf:
    rows: np.ndarray
    name: str = "x"


@dataclass
class Tree:
    leaf: Leaf
    pair: tuple[Leaf, ...]
    by_name: dict[str, np.ndarray]
    nothing: None = None
    order: int = 2
    memo: list[int] = field(init=False, default_factory=list)


def tree(members, offset=0.0):
    rows = np.arange(members * 6.0).reshape(members, 2, 3) + offset
    return Tree(Leaf(rows), (Leaf(rows[..., 0] > 2), Leaf(rows[:, 0])), {"a": rows[:, 1, 1]})


def arrays(one):
    return [one.leaf.rows, *(leaf.rows for leaf in one.pair), one.by_name["a"]]


@given(st.data())
def test_members_taken_out_are_indexed_and_put_back_make_the_batch_again(data):
    count = data.draw(st.integers(1, 6))
    index = np.array(data.draw(st.permutations(range(count))))[: data.draw(st.integers(0, count))]
    index = index.astype(int)
    whole, other = tree(count), tree(count, offset=100.0)
    whole.memo.append(1)
    some = take(whole, index)
    assert all((a[index] == b).all() for a, b in zip(arrays(whole), arrays(some), strict=True))
    assert (some.order, some.nothing, some.leaf.name, some.memo) == (2, None, "x", [])
    mixed = put(other, index, some)
    rest = np.setdiff1d(np.arange(count), index)
    for ours, first, second in zip(*map(arrays, (mixed, whole, other)), strict=True):
        assert (ours[index] == first[index]).all()
        assert (ours[rest] == second[rest]).all()
        assert ours.dtype == first.dtype
    unchanged = zip(arrays(other), arrays(tree(count, offset=100.0)), strict=True)
    assert all((a == b).all() for a, b in unchanged)


def test_parts_of_a_batch_join_if_they_are_of_a_kind():
    batch = {"a": np.arange(6.0).reshape(3, 2), "b": (np.arange(3), "name")}
    parts = [take(batch, np.array([0])), take(batch, np.array([1, 2]))]
    assert kind_of(parts[0]) == kind_of(parts[1])
    whole = join(parts)
    np.testing.assert_array_equal(whole["a"], batch["a"])
    np.testing.assert_array_equal(whole["b"][0], batch["b"][0])
    assert kind_of({**batch, "b": (np.arange(3), "other")}) != kind_of(batch)
    assert kind_of({**batch, "a": np.zeros((3, 3))}) != kind_of(batch)


def test_a_batch_of_one_has_its_member_first():
    one = Leaf(np.arange(6.0).reshape(2, 3))
    assert batch_of_one(one).rows.shape == (1, 2, 3)
    assert (take(batch_of_one(one), 0).rows == one.rows).all()


def test_what_members_have_in_common_is_held_once_and_stays_so():
    common, own = np.tile([1.0, np.nan, 3.0], (4, 1)), np.arange(12.0).reshape(4, 3)
    level = np.broadcast_to(np.arange(4.0)[:, None], (4, 3))
    whole = held_once({"common": common, "own": own, "level": level})
    some = take(whole, np.array([2, 0, 2, 1, 1]))
    parts = join([take(whole, np.array([0, 1])), take(whole, np.array([2, 3]))])
    for each, index in ((whole, range(4)), (some, [2, 0, 2, 1, 1]), (parts, range(4))):
        assert is_once(each["common"])
        assert not is_once(each["own"], each["common"])
        assert not each["level"].strides[1]
        for name, values in (("common", common), ("own", own), ("level", level)):
            np.testing.assert_array_equal(each[name], values[list(index)])
    assert is_once(put(whole, np.array([1]), take(whole, np.array([3])))["common"])
    other = put(whole, np.array([1]), {**take(whole, np.array([3])), "common": np.zeros((1, 3))})
    np.testing.assert_array_equal(other["common"][:3], [[1, np.nan, 3], [0, 0, 0], [1, np.nan, 3]])


def test_parts_that_hold_different_values_once_do_not_join_as_one():
    parts = [held_once({"a": np.full((2, 3), value)}) for value in (1.0, 2.0)]
    np.testing.assert_array_equal(join(parts)["a"][:, 0], [1, 1, 2, 2])


def test_work_on_what_is_held_once_is_done_once():
    seen = []

    def doubled(*arrays):
        seen.append(len(arrays[0]))
        return 2 * arrays[0]

    once, own = np.broadcast_to(np.arange(3.0), (5, 3)), np.ones((5, 3))
    np.testing.assert_array_equal(for_all(doubled, once), 2 * once)
    np.testing.assert_array_equal(for_all(doubled, once, own), 2 * once)
    assert seen == [1, 5]


NOMINAL = TriadProfile(scale=1.0)
PROFILE = Profile(name="test tool", accelerometer=NOMINAL, magnetometer=NOMINAL)


def runs(count=4):
    """Sound runs (B, n) with all references."""
    inc, azi, face = plan((5, 45, 90, 135), 6)
    tool = Tool.random(2)
    a, m = tool.readings(np.random.default_rng(2), count, inc, azi, face)
    known = {"inclination": inc, "azimuth": azi, "toolface": face}
    known |= {"field": np.full(len(inc), tool.field), "dip": np.full(len(inc), tool.dip)}
    known = {name: value + np.zeros((count, 1)) for name, value in known.items()}
    sd = {"accelerometer": np.array(tool.noise[0]), "magnetometer": np.array(tool.noise[1])}
    sd = {name: np.broadcast_to(value, a.shape) for name, value in sd.items()}
    return Readings(a, m, known=known, sd=sd)


def refused(flags, count):
    """The first refusal of each member."""
    flags = [*flags]
    first = [next((f for f in flags if f.members[place]), None) for place in range(count)]
    return [flag and (flag.id, flag.sentence(place)) for place, flag in enumerate(first)]


def test_members_are_refused_before_the_fit_as_each_would_be_alone():
    data = runs()
    data.accelerometer[1, :, 2] = 0.5  # dead
    data.magnetometer[1] *= 100.0  # comes second
    data.magnetometer[2, :, 0] *= 1e-4  # sees no field
    data.known["toolface"][3, 5] = np.nan
    options = Options(method="least-squares")
    found = refused(reading_refusals(data, options, lambda place: take(data, place)), 4)
    assert [each and each[0] for each in found] == [None, "channel", "channel", "missing-reference"]
    assert "accelerometer channel on tool axis z does not move" in found[1][1]
    assert "magnetometer channel on tool axis x moves by" in found[2][1]
    assert "blank at 1 of 24 (first: station 6)" in found[3][1]
    for place, each in enumerate(found):
        one = take(data, place)
        alone = reading_refusals(batch_of_one(one), options, lambda _, one=one: one)
        assert refused(alone, 1) == [each]


def test_a_single_run_is_refused_with_the_error_of_its_status():
    one = take(runs(), 0)
    with pytest.raises(InputError, match="`order` 2 needs the column"):
        check(reading_refusals(batch_of_one(one), Options(order=2), lambda _: one))
    few = one.select(np.arange(24) < 3)
    with pytest.raises(FitError, match="3 stations; the model has 12 .* needs 4 or more"):
        check(reading_refusals(batch_of_one(few), Options(), lambda _: few))


def test_members_are_refused_after_the_fit_as_each_would_be_alone():
    """A reversed accelerometer, a magnetometer of another scale, and readings mixed up."""
    data, options = runs(), Options()
    data.accelerometer[1] *= -1
    data.magnetometer[2] *= 3.5
    data.accelerometer[3] = np.roll(data.accelerometer[3], 5, axis=0)
    result = fit(data, options)

    def alone(place):
        return take(data, place), PROFILE

    fitted = FittedRuns(data, PROFILE, options, result, alone)
    found = refused(fit_refusals(fitted), 4)
    assert found[0] is None
    assert [each[0] for each in found[1:]] == ["gain", "gain", "residuals"]
    for place, each in enumerate(found):
        one = take(data, place)
        single = FittedRuns(
            batch_of_one(one),
            PROFILE,
            options,
            fit(one, options),
            lambda _, one=one: (one, PROFILE),
        )
        assert refused(fit_refusals(single), 1) == [each]
        sub = fitted.take(np.array([place]))
        assert refused(fit_refusals(sub), 1) == [each]
