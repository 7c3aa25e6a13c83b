"""What a registry refuses, in one sentence that says what to do, and without passwords."""

import contextlib
import os
import shutil
import sqlite3
import tempfile
from contextlib import closing, contextmanager
from pathlib import Path, PurePosixPath, PureWindowsPath

import pytest
import sqlalchemy as sa

from cli_support import mwdcal
from mwdcal.errors import InputError
from mwdcal.files import documents
from mwdcal.registry import checking, exports, lookup
from mwdcal.registry.database import connections
from mwdcal.registry.store import Entry, create, open_registry, upgrade
from registry_support import calibration

ENTRY = Entry("calibration", calibration("A-1"), "a.json")
MISTYPED = [
    "postgresql//ada:s3cret@localhost/tools",
    "https://ada:s3cret@localhost/tools",
    "postgesql:/ada:s3cret@localhost/tools",
    "postgresql/ada:s3cret@localhost/tools",
    "//ada:s3/s3cret@localhost/tools",
    "ada:s3cret@localhost/tools",
    "mysql://ada:k@s3cret@127.0.0.1/tools",
    "postgresql//ada:my s3cret@localhost/tools",
]
"""URLs that lack a sign, or are of another database."""


@contextmanager
def refused(*words):
    """The block is refused in one line that has these words and no password."""
    with pytest.raises(InputError) as refusal:
        yield
    text = str(refusal.value)
    assert "\n" not in text
    assert "Traceback" not in text
    assert "s3cret" not in text
    assert text.endswith(".")
    for word in words:
        assert word in text, text


def opened(database):
    with open_registry(database) as registry:
        registry.add([ENTRY], "Ada")


@pytest.fixture
def registry_file(tmp_path):
    create(tmp_path / "tools.registry", "Ada")
    return tmp_path / "tools.registry"


def test_no_file(tmp_path):
    with refused("no.registry", "no such file"):
        opened(tmp_path / "no.registry")
    assert list(tmp_path.iterdir()) == []
    with refused("folder"):
        opened(tmp_path)
    with refused("folder does not exist"):
        create(tmp_path / "no" / "tools.registry", "Ada")


@pytest.mark.parametrize("content", [b"", b"serial,ax\n" * 400, b"SQLite format 3\0" + bytes(4000)])
def test_files_that_are_no_registry(tmp_path, content):
    path = tmp_path / "other.db"
    path.write_bytes(content)
    for call in (opened, lambda p: upgrade(p, "Ada")):
        with refused("other.db"):
            call(path)
    assert path.read_bytes() == content


def test_a_database_of_another_program(tmp_path):
    with closing(sqlite3.connect(tmp_path / "other.db")) as connection:
        connection.execute("CREATE TABLE records (number)")
    with refused("is not a registry"):
        opened(tmp_path / "other.db")
    with refused("is not empty"):
        create(tmp_path / "other.db", "Ada")


def test_a_registry_is_not_created_twice(registry_file):
    opened(registry_file)
    before = registry_file.read_bytes()
    with refused("is not empty"):
        create(registry_file, "Ada")
    with refused("is not empty"):
        exports.restore(registry_file, registry_file, "Ada")
    assert registry_file.read_bytes() == before


def test_a_locked_registry(registry_file, monkeypatch):
    monkeypatch.setattr(connections, "LONGEST_WAIT", 0.1)
    with closing(sqlite3.connect(registry_file, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        with refused("locked", "Try again"):
            opened(registry_file)


def test_a_full_disk(registry_file, monkeypatch):
    def small(*arguments):
        connection = whole(*arguments)
        connection.execute("PRAGMA max_page_count=1")  # no more than there are
        return connection

    whole = connections._opened
    with monkeypatch.context() as patch:
        patch.setattr(connections, "_opened", small)
        with refused("full", "Make room"), open_registry(registry_file) as registry:
            registry.add([Entry("run", os.urandom(500_000), "run.bin")], "Ada")
    with open_registry(registry_file) as registry:
        assert registry.head()[0] == 1  # the creation alone


@contextmanager
def another_user():
    """Without the rights of the superuser, who may write anywhere."""
    if os.geteuid():
        yield
        return
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


@pytest.mark.skipif(os.name == "nt", reason="permissions of folders are POSIX")
@pytest.mark.parametrize(("file", "folder"), [(0o444, 0o777), (0o444, 0o555), (0o666, 0o555)])
def test_a_registry_that_may_not_be_written(file, folder):
    place = Path(tempfile.mkdtemp())
    try:
        create(place / "tools.registry", "Ada")
        (place / "tools.registry").chmod(file)
        place.chmod(folder)
        with another_user(), refused("tools.registry", "Give yourself the right"):
            opened(place / "tools.registry")
        with another_user(), refused("new.registry" if folder == 0o555 else "tools.registry"):
            create(place / ("new.registry" if folder == 0o555 else "tools.registry"), "Ada")
    finally:
        place.chmod(0o755)
        shutil.rmtree(place)


@pytest.mark.skipif(os.name == "nt", reason="permissions of folders are POSIX")
@pytest.mark.parametrize("in_use", [False, True])
@pytest.mark.parametrize(("file", "folder"), [(0o444, 0o777), (0o444, 0o555), (0o644, 0o555)])
def test_a_registry_that_may_not_be_written_is_read(file, folder, in_use):
    place = Path(tempfile.mkdtemp())
    path = place / "tools.registry"
    try:
        create(path, "Ada")
        opened(path)
        with contextlib.ExitStack() as stack:
            if in_use:  # with the log beside it that a writer keeps
                other = stack.enter_context(closing(sqlite3.connect(path)))
                other.execute("SELECT * FROM tools").fetchall()
            path.chmod(file)
            place.chmod(folder)
            with another_user(), open_registry(path) as registry:
                assert lookup.tools_page(registry).total == 1
                assert checking.check(registry) == []
                assert lookup.document(registry, "A-1")[1] == ENTRY.data
    finally:
        place.chmod(0o755)
        shutil.rmtree(place)


@pytest.mark.skipif(os.name == "nt", reason="permissions of folders are POSIX")
def test_what_others_write_to_while_it_is_read_without_locks_is_refused():
    place = Path(tempfile.mkdtemp())
    try:
        create(place / "tools.registry", "Ada")
        place.chmod(0o555)
        with another_user(), open_registry(place / "tools.registry") as registry:
            user = os.geteuid()
            with refused("while it was read", "Try again"), registry.reading():
                os.seteuid(os.getuid())
                os.utime(place / "tools.registry", ns=(1, 1))
                os.seteuid(user)
    finally:
        place.chmod(0o755)
        shutil.rmtree(place)


def test_network_drives(registry_file, monkeypatch, tmp_path):
    mounts = tmp_path / "mounts"
    folder = str(tmp_path).replace(" ", "\\040")
    mounts.write_text(f"disk / ext4 rw 0 0\nnas:/tools {folder} nfs4 rw 0 0\n")
    monkeypatch.setattr(connections, "_MOUNTS", mounts)
    for call in (opened, lambda p: create(p, "Ada")):
        with refused("network drive", "PostgreSQL"):
            call(registry_file)
    monkeypatch.setattr(connections, "_MOUNTS", tmp_path / "none")  # not Linux
    opened(registry_file)


@pytest.mark.parametrize(
    ("place", "kind"),
    [("/mnt/my nas/a/b", "cifs"), ("/mnt/my", "ext4"), ("/srv/x", "xfs"), ("/srv", "xfs")],
)
def test_the_file_system_of_a_place(place, kind):
    mounts = "d / ext4 rw 0 0\n//nas/x /mnt/my\\040nas cifs rw 0 0\nd /srv nfs rw 0 0\nd /srv xfs rw 0 0\n"
    assert connections.file_system(Path(place), mounts) == kind


def test_paths_of_windows_are_no_urls():
    assert not connections.is_url(str(PureWindowsPath("C:/tools/tools.registry")))
    assert not connections.is_url("\\\\nas\\tools.registry")
    assert connections.is_url("postgresql://localhost/tools")


@pytest.mark.parametrize(
    ("path", "uri"),
    [
        (PureWindowsPath("C:\\a b\\50%#?.db"), "file:///C:/a%20b/50%25%23%3F.db"),
        (PureWindowsPath("\\\\nas\\tools\\x.db"), "file:////nas/tools/x.db"),
        (PurePosixPath("/tmp/größe.db"), "file:///tmp/gr%C3%B6%C3%9Fe.db"),
    ],
)
def test_files_as_sqlite_opens_them(path, uri):
    """Reference: the URI forms that SQLite's documentation of URI file names gives."""
    assert connections.file_uri(path) == uri


@pytest.mark.parametrize("name", ["a b#c?d%20.registry", "größe.registry"])
def test_odd_names_of_files(tmp_path, name):
    create(tmp_path / name, "Ada")
    opened(tmp_path / name)
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(
    "url",
    [
        "mysql://ada:s3cret@host/tools",
        "postgresql://ada:s3cret@host:port/tools",
        "postgresql://ada:s3cret@127.0.0.1:1/tools",
        "postgresql://127.0.0.1:1/tools?user=ada&password=s3cret",
        "postgresql+asyncpg://ada:s3cret@127.0.0.1:1/tools",
        "postgresql://ada:s3cret@127.0.0.1:1/tools?sslmode=s3cret",
        "postgresql://ada:s3cret@[::1/tools",
        "postgresql://ada:key@s3cret@127.0.0.1/tools",
        "postgresql://ada:key@s3cret:x@127.0.0.1/tools",
        "postgresql:ada:s3cret@127.0.0.1",
        "postgres:/ada:s3cret@127.0.0.1/tools",
        " postgresql://ada:s3cret@127.0.0.1/tools",
        "jdbc:postgresql://ada:s3cret@127.0.0.1/tools",
        "host=127.0.0.1 user=ada password=s3cret",
        *MISTYPED,
    ],
)
def test_urls_that_lead_nowhere(url):
    for call in (opened, lambda u: create(u, "Ada"), lambda u: upgrade(u, "Ada")):
        with refused():
            call(url)


@pytest.mark.parametrize("url", MISTYPED)
def test_no_command_prints_the_password_of_a_mistyped_url(url, tmp_path, monkeypatch):
    readings = tmp_path / "s.csv"
    readings.write_text("ax,ay,az,mx,my,mz\n0,0,1,0,0,1\n")
    monkeypatch.chdir(tmp_path)
    for words in (
        ("registry", "--registry", url, "list"),
        ("registry", url, "list"),
        ("registry", "--registry", "r.sqlite", "restore", url),
        ("registry", "--registry", "r.sqlite", "add", url),
        ("apply", f"{url}#S", readings, "-o", "o.csv"),
        ("verify", f"{url}#S", readings),
        ("calibrate", url, "--tool", "servo", "-o", "o.json"),
        ("convert", url, "--notation", "forward"),
    ):
        ran = mwdcal(*words)
        assert ran.code == 2
        assert "s3cret" not in ran.out + ran.err, words


def test_a_file_may_have_the_name_of_a_url(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    create("run:1", "Ada")
    Path("run:1").rename("run:1@lab")
    opened("run:1@lab")


def test_a_calibration_is_not_read_from_a_server():
    with refused("mwdcal registry get"):
        documents.load("postgresql:/ada:s3cret@127.0.0.1/tools#SIM-0001")


def test_servers_that_refuse(postgresql):
    url = sa.make_url(postgresql)
    for changed, word in (
        (url.set(database="nowhere"), "nowhere"),
        (url.set(username="nobody", password="s3cret"), "nobody"),
        (url, "is not a registry"),
    ):
        with refused(word):
            opened(changed.render_as_string(hide_password=False))


@pytest.mark.parametrize("actor", ["", "  \t", "x" * 201])
def test_who_acts_must_have_a_name(registry_file, actor):
    with refused("`actor`"), open_registry(registry_file) as registry:
        registry.add([ENTRY], actor)


def test_entries_that_are_refused(registry_file):
    entries = {
        "kind": Entry("letter", b"", "a.txt"),
        "cannot be read as a calibration": Entry("calibration", b"[1]", "a.json"),
        "not 'A-2'": ENTRY._replace(serial="A-2"),
        "201 characters": ENTRY._replace(data=calibration("x" * 201)),
    }
    with open_registry(registry_file) as registry:
        for words, entry in entries.items():
            with refused(entry.name, words):
                registry.add([ENTRY, entry], "Ada")
        assert registry.head()[0] == 1  # nothing of any call was kept
        with refused("there is no record 7"):
            registry.withdraw(7, "wrong", "Ada")
        number = registry.add([ENTRY], "Ada")[0].number
        with refused("`reason`"):
            registry.withdraw(number, " ", "Ada")
        registry.withdraw(number, "wrong", "Ada")
        with refused("withdrawn already"):
            registry.withdraw(number, "wrong", "Ada")


def test_text_that_databases_refuse_is_escaped(registry_file):
    odd = "A\0\ud800'; DROP TABLE records; --\x1b[31m"
    with open_registry(registry_file) as registry:
        added = registry.add([ENTRY._replace(data=calibration(odd), name=odd)], odd)[0]
        assert added.serial == "A\\x00\\ud800'; DROP TABLE records; --\x1b[31m"
