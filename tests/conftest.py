"""One BLAS thread per test process: many processes of many threads only wait for each other.

A job in the background ignores Ctrl-C, and so would the commands that the tests start.
"""

import gc
import os
import pickle
import signal
from functools import wraps

import pytest

import pictures

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # else every command compiles the package anew

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_xdist_auto_num_workers():
    """Half as many again as cores: while one waits for a process, a port or a browser, another computes."""
    return max((os.cpu_count() or 1) * 3 // 2, 1)


def pytest_configure(config):
    config.addinivalue_line("markers", "slow: takes seconds; `make test-quick` leaves it out")
    config.addinivalue_line(
        "markers", "study: the large version of a test that always runs; `make test-studies`"
    )


def pytest_collection_modifyitems(config, items):
    """Leaves the studies out, unless `-m` names them."""
    if "study" not in config.option.markexpr:
        config.hook.pytest_deselected(
            items=[each for each in items if each.get_closest_marker("study")]
        )
        items[:] = [each for each in items if not each.get_closest_marker("study")]


def pytest_collection_finish():
    """The thousands of tests stay to the end: looking for garbage does not go over them each time."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True, scope="session")
def templates_compiled_once():
    """Not once for each page, as in a command: what is compiled depends on the text alone."""
    try:
        from jinja2 import Environment
    except ImportError:
        yield
        return
    compiled, from_text = {}, Environment.compile

    def once(self, *given, **named):
        key = (given, *named.items())
        if key not in compiled:
            compiled[key] = from_text(self, *given, **named)
        return compiled[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Environment, "compile", once)
        yield


@pytest.fixture
def without_pictures(monkeypatch):
    """Pages with empty pictures: drawing takes most of the time of a page that is read for its text."""
    pictures.leave_out(monkeypatch.setattr)


@pytest.fixture
def without_layout(monkeypatch):
    """Pictures whose panels stay where they begin: to find them places takes most of drawing."""
    from matplotlib.figure import Figure

    monkeypatch.setattr(Figure, "set_layout_engine", lambda self, layout=None, **options: None)


def remembered(function, results):
    """The function, which computes once for equal arguments, and says of its progress the same again."""

    @wraps(function)
    def once(*given, **named):
        speakers = {name: named.pop(name) for name in ("progress", "say") if name in named}
        key = function.__qualname__, pickle.dumps((given, named))
        if key not in results:
            said = []
            listeners = dict.fromkeys(speakers, lambda *each: said.append(each))
            results[key] = function(*given, **named, **listeners), said
        result, said = results[key]
        for speaker in speakers.values():
            for each in said:
                speaker(*each)
        return result

    return once


@pytest.fixture(scope="module")
def results():
    """Of what takes long, by its arguments."""
    return {}


@pytest.fixture
def computed_once(results, monkeypatch):
    """What takes most of the time of a command is computed once for all tests of what it shows."""
    from mwdcal.comparison import compare
    from mwdcal.logs import allan, noise
    from mwdcal.planning import planned

    long = (
        (planned, "judged"),
        (planned, "best_plan"),
        (planned, "smallest_plan"),
        (compare, "compare"),
        (noise, "find_noise"),
        (allan, "fit"),
    )
    for module, name in long:
        monkeypatch.setattr(module, name, remembered(getattr(module, name), results))


@pytest.fixture(scope="session")
def postgresql():
    """The URL of a PostgreSQL server for this process, started when the first test needs it."""
    from registry_support import postgresql_server

    with postgresql_server(durable=False) as url:
        yield url
