"""The guard of speed: what it calls lost, and that a disturbance is not."""

from importlib import import_module

import numpy as np
import pytest

from cli_support import ROOT

pytest.importorskip("pyarrow")


@pytest.fixture
def guard(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return import_module("guard")


@pytest.fixture
def path(guard, monkeypatch):
    """A path whose calls, and those of its reference, take the seconds that two functions give of their number."""

    def timed(ours, theirs):
        counts = {"ours": 0, "theirs": 0}

        def seconds(call):
            name = call()
            counts[name] += 1
            return (ours if name == "ours" else theirs)(counts[name])

        monkeypatch.setattr(guard, "processor_seconds", seconds)
        return guard.Guarded("p", "r", lambda: "theirs", lambda: "ours")

    return timed


def judged(guard, found):
    return guard.judged(found, 2.0, guard.TRIES)


def test_a_path_that_takes_twice_as_long_has_lost_in_every_try(guard, path):
    assert judged(guard, path(lambda k: 0.4, lambda k: 0.1)) == 4.0 > guard.LOST * 2.0


@pytest.mark.parametrize("slow", [lambda k: k % 3 == 0, lambda k: k < 30, lambda k: k > 1])
def test_a_disturbance_of_either_or_both_is_no_loss(guard, path, slow):
    """Of every third call; of both for a long time and then not; of both for ever."""
    found = path(lambda k: 0.2 * (1 + slow(k)), lambda k: 0.1 * (1 + slow(k)))
    assert judged(guard, found) == pytest.approx(2.0, rel=0.01)
    alone = path(lambda k: 0.2 * (1 + (k % 3 == 0)), lambda k: 0.1)
    assert judged(guard, alone) == pytest.approx(2.0, rel=0.01)


def test_a_path_without_a_stored_ratio_is_measured_once(guard, path):
    calls = []
    found = path(lambda k: calls.append(k) or 9.0, lambda k: 0.1)
    assert guard.judged(found, np.inf, guard.TRIES) == 90.0
    assert len(calls) == 1 + guard.MORE[0]


def test_a_command_that_fails_stops_the_guard(guard):
    with pytest.raises(SystemExit, match="ended with 2"):
        guard.command("apply", "no.json", "no.csv")
    with pytest.raises(SystemExit, match="python -c"):
        guard.python("-c", "raise SystemExit(3)")


def test_kinds_of_paths_are_prepared_only_where_the_word_begins_with_one_of_theirs(
    guard, monkeypatch
):
    prepared = []

    def kind(*names):
        def paths(_):
            prepared.extend(names)
            yield from (guard.Guarded(name, "r", None, None) for name in names)

        return paths

    kinds = {
        "fleet": kind("fleet, small", "fleet, large"),
        "apply noise": kind("apply, 9", "noise, 9"),
    }
    monkeypatch.setattr(guard, "KINDS", kinds)

    def named(word):
        prepared.clear()
        return [each.name for each in guard.asked_paths(word, None)]

    assert named("fleet, large") == ["fleet, large"]
    assert prepared == ["fleet, small", "fleet, large"]
    assert named("large") == ["fleet, large"]
    assert named("9") == ["apply, 9", "noise, 9"]
    assert named("") == prepared == ["fleet, small", "fleet, large", "apply, 9", "noise, 9"]


def test_the_names_of_paths_begin_with_those_of_their_kind(guard):
    """Without preparing any: names stand in the code of a kind."""
    words = [name for names in guard.KINDS for name in names.split()]
    stored = guard.json.loads(guard.STORED.read_text())
    assert all(any(name.startswith(word) for word in words) for name in stored)


def test_a_figure_reaches_what_it_is_at_least_or_aimed_at(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    wait = import_module("waits").Wait
    small = [wait("w", found, 5.0, 3.0, "ms").verdict for found in (2.0, 4.0, 6.0)]
    large = [wait("w", found, 50, 100, "x", more=True).verdict for found in (101, 60, 40)]
    assert small == large == ["aim", "at least", "**short of it**"]


def test_rows_in_which_another_is_faster_say_why(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    bench = import_module("bench")
    rows = [bench.Row(f"{name}; other", 2.0, 1.0, 0.5) for name in ("24 shots by strength", "odd")]
    rows.append(bench.Row("fast; other", 1.0, 2.0, 2.0))
    first, second = bench.slower({"peers": bench.Group(rows)})
    assert "24 shots" in first
    assert bench.CLOSED in first
    assert second.endswith("**no reason known**.")
    table = bench.group_table(rows)
    assert [("slower" in line) for line in table.splitlines()[2:]] == [True, True, False]
