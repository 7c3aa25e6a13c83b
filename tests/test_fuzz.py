"""A short part of `make fuzz`: what is promised of every command holds on damaged files."""

import math

import click
import pytest

import fuzz


@pytest.mark.slow
def test_no_promise_is_broken(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    counts, findings = fuzz.work(range(60), math.inf, keep=False)
    assert counts.total() == 60
    assert not findings


@pytest.mark.parametrize("name", sorted(fuzz.COMMANDS))
def test_the_fuzzer_has_files_for_every_argument(name):
    """Of this command: a new one says in `fuzz.SAMPLES` what its arguments take."""
    for p in fuzz.COMMANDS[name].params:
        takes_file = isinstance(p.type, click.Path) or "FILE" in str(getattr(p, "metavar", ""))
        assert not takes_file or p.name in {*fuzz.SAMPLES, *fuzz.OUTPUTS}
