"""What a fleet keeps between two commands: damage is noticed, changes are refused, others' files stay."""

import errno
import os
import random
import shutil

import pytest

from cli_support import mwdcal, refused
from mwdcal import pool
from mwdcal.files.formats import atomic, parquet
from mwdcal.fleet import kept
from mwdcal.fleet import tables as fleet_tables
from test_fleet import pa, pq, short_run, write_fleet

TOOLS = 6


def interleaved(path):
    """A fleet whose rows change from tool to tool, so that they have to be dealt."""
    table = pq.read_table(path)
    order = [row for start in range(28) for row in range(start, table.num_rows, 28)]
    pq.write_table(table.take(pa.array(order)), path)
    return path


@pytest.fixture
def small_parts(monkeypatch):
    monkeypatch.setattr(fleet_tables, "PARTITION_ROWS", (50, 100))


def small_fleet(folder, mixed=False):
    """Six tools in three parts."""
    runs = {f"T{seed}": short_run(seed) for seed in range(TOOLS)}
    path = write_fleet(folder / "runs.parquet", runs)
    return interleaved(path) if mixed else path


def fleet(path, *options):
    output = path.with_name("cals.parquet")
    given = ("--tool", "servo", "--method", "least-squares", "--workers", 1)
    given += ("--no-records", *options)
    return mwdcal("fleet", path, "-o", output, *given), output


def parts_of(path):
    return path.with_name("cals.parquet.parts")


def interrupted(path):
    """The folder of parts that a command leaves which ends just before its output is there."""
    with pytest.MonkeyPatch.context() as patch:

        def stop(writer):
            raise KeyboardInterrupt

        patch.setattr(parquet, "close", stop)
        ran, output = fleet(path)
    assert ran.code == 130, ran
    output.unlink(missing_ok=True)
    return parts_of(path)


def lose_power(folder, dice):
    """Leave of some files what a loss of power may: their names, and some of their blocks."""
    for path in sorted(each for each in folder.rglob("*") if each.is_file()):
        data = bytearray(path.read_bytes())
        at = dice.randrange(len(data) + 1)
        kind = dice.randrange(7)
        if kind == 0:
            data = data[:at]
        elif kind == 1:
            data[at:] = bytes(len(data) - at)
        elif kind == 2:
            data = data[: at - at % 512] + bytes(len(data) - at + at % 512)
        elif kind == 3:
            data = bytearray(dice.choice([0, len(data)]))
        if kind == 4:
            path.unlink()
        else:
            path.write_bytes(data)


def with_unfinished(folder, dice):
    """The folder with what a killed command would leave beside its parts."""
    part = next(folder.glob("*.arrow"))
    name = f".mwdcal-{atomic._machine()}-{dice.getrandbits(64):016x}.tmp"
    shutil.copy(part, folder / name)
    for dealt in folder.glob("sorted-*"):
        shutil.copytree(dealt, dealt.with_suffix(".tmp"))


def after_power_losses(path, seeds, expected):
    """How many parts were computed again, over many losses of power: the table is always the same."""
    folder = interrupted(path)
    whole = folder.with_name("whole")
    folder.rename(whole)
    repaired = 0
    for seed in seeds:
        dice = random.Random(seed)
        shutil.copytree(whole, folder)
        with_unfinished(folder, dice)
        lose_power(folder, dice)
        atomic.sweep.cache_clear()
        ran, output = fleet(path)
        assert ran.code == 0, (seed, ran)
        assert output.read_bytes() == expected, seed
        assert not folder.exists(), (seed, list(folder.rglob("*")))
        repaired += "damaged" in ran.err
    return repaired


@pytest.mark.parametrize("losses", [9, pytest.param(50, marks=pytest.mark.study)])
@pytest.mark.parametrize("mixed", [False, True], ids=["in order", "dealt"])
def test_no_loss_of_power_changes_the_table(tmp_path, small_parts, mixed, losses):
    path = small_fleet(tmp_path, mixed)
    ran, output = fleet(path)
    assert ran.code == 0, ran
    repaired = after_power_losses(path, range(losses), output.read_bytes())
    assert repaired > losses / 2


@pytest.mark.parametrize("damage", ["truncated", "zeroed", "changed", "other part"])
def test_a_damaged_part_is_computed_again_and_reported(tmp_path, small_parts, damage):
    path = small_fleet(tmp_path)
    _, output = fleet(path)
    expected = output.read_bytes()
    first, second, _ = sorted(interrupted(path).glob("*.arrow"))
    data = bytearray(first.read_bytes())
    if damage == "truncated":
        data = data[:-100]
    elif damage == "zeroed":
        data[-600:] = bytes(600)
    elif damage == "changed":
        data[len(data) // 2] ^= 1
    else:
        data = second.read_bytes()
    first.write_bytes(data)
    ran, output = fleet(path)
    assert ran.code == 0
    assert "2 done before" in ran.err
    assert "1 part done before, but damaged: computed again" in ran.err
    assert output.read_bytes() == expected


def test_parts_without_a_checksum_are_not_used(tmp_path, small_parts):
    """As versions before left them; they are ours by name and content, and are removed at the end."""
    path = small_fleet(tmp_path)
    _, output = fleet(path)
    expected = output.read_bytes()
    folder = interrupted(path)
    for part in folder.glob("*.arrow"):
        part.write_bytes(part.read_bytes()[kept.HEAD :])
    (folder / f"{'0' * 32}.arrow").write_bytes(next(folder.glob("*.arrow")).read_bytes())
    ran, output = fleet(path)
    assert ran.code == 0
    assert "0 done before" in ran.err
    assert output.read_bytes() == expected
    assert not folder.exists()


def test_the_seal_of_a_part_is_its_length_and_checksum():
    content = bytes(range(256)) * 9
    whole = kept.with_checksum(content, "a")
    assert bytes(kept.unsealed(whole, "a")) == content
    assert kept.unsealed(whole, "b") is None
    rng = random.Random(3)
    for _ in range(300):
        damaged = bytearray(whole)
        damaged[rng.randrange(len(whole))] ^= 1 << rng.randrange(8)
        assert kept.unsealed(bytes(damaged), "a") is None
    assert all(kept.unsealed(whole[:n], "a") is None for n in range(len(whole)))
    assert kept.unsealed(whole + b"\0", "a") is None


# An input that changes meanwhile


def replaced(path):
    other = path.with_name("other")
    table = pq.read_table(path)
    place = table.column_names.index("ax")
    pq.write_table(table.set_column(place, "ax", table.column("az")), other)
    other.replace(path)


def replaced_with_the_old_time(path):
    """Another content of the same size and time."""
    status = path.stat()
    data = bytearray(path.read_bytes())
    data[200:220] = bytes(20)
    other = path.with_name("other")
    other.write_bytes(data)
    os.utime(other, ns=(status.st_atime_ns, status.st_mtime_ns))
    other.replace(path)


def grown(path):
    with path.open("ab") as stream:
        stream.write(b"more")


def truncated(path):
    with path.open("r+b") as stream:
        stream.truncate(1000)


CHANGES = [replaced, replaced_with_the_old_time, grown, truncated, os.unlink]


@pytest.mark.skipif(os.name == "nt", reason="open files cannot be replaced")
@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)
@pytest.mark.parametrize("when", [0, 2])
def test_an_input_that_changes_meanwhile_is_refused(
    tmp_path, small_parts, monkeypatch, change, when
):
    path = small_fleet(tmp_path)
    real = pool.results

    def changing(*given):
        if not when:
            change(path)
        for count, each in enumerate(real(*given), 1):
            if count == when:
                change(path)
            yield each

    monkeypatch.setattr(pool, "results", changing)
    ran, output = fleet(path)
    assert "has changed while its tools were calibrated" in refused(ran, 2)
    assert f"'{path}'" in ran.err
    assert not output.exists()


def test_an_input_that_changes_after_the_last_part_is_refused(tmp_path, small_parts, monkeypatch):
    path = small_fleet(tmp_path)
    real = parquet.close

    def close(writer):
        real(writer)
        grown(path)

    monkeypatch.setattr(parquet, "close", close)
    ran, output = fleet(path)
    assert "has changed" in refused(ran, 2)
    assert not output.exists()


# What others put there


def test_files_of_others_in_the_folder_of_parts_stay(tmp_path):
    path = small_fleet(tmp_path)
    folder = parts_of(path)
    theirs = {
        "mine.arrow": b"p",
        f"{'a' * 32}.arrow": b"my notes",
        "sorted-photos/1": b"p",
        f"sorted-{'b' * 16}/1.jpg": b"p",
        f"sorted-{'c' * 16}/0000.parquet": b"my notes",
        "keep": b"",
    }
    for name, content in theirs.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    ran, _ = fleet(path)
    assert ran.code == 0, ran
    left = {each.relative_to(folder).as_posix() for each in folder.rglob("*") if each.is_file()}
    assert left == set(theirs)
    for name, content in theirs.items():
        assert (folder / name).read_bytes() == content


def links(folder, target):
    """Names of the folder of parts, or in it, that stand for something of others."""
    folder.mkdir()
    yield folder / kept.LOCK
    yield folder / f"{'a' * 32}.arrow"
    yield folder / f"sorted-{'a' * 16}"


@pytest.mark.skipif(os.name == "nt", reason="links need rights there")
def test_links_in_the_folder_of_parts_are_not_followed(tmp_path):
    path, other = small_fleet(tmp_path), tmp_path / "other"
    other.mkdir()
    (other / "theirs").write_text("x")
    for link in links(parts_of(path), other):
        link.symlink_to(other)
        assert "is not a file of mwdcal" in refused(fleet(path)[0], 2)
        link.unlink()
    parts_of(path).rmdir()
    parts_of(path).symlink_to(other)
    assert "it is a link" in refused(fleet(path)[0], 2)
    parts_of(path).unlink()
    assert (other / "theirs").read_text() == "x"
    assert len(list(other.iterdir())) == 1


def test_a_file_in_place_of_the_folder_of_parts_is_refused(tmp_path):
    path = small_fleet(tmp_path)
    parts_of(path).write_text("x")
    assert "not a folder" in refused(fleet(path)[0], 2)
    assert parts_of(path).read_text() == "x"
    parts_of(path).unlink()
    parts_of(path).mkdir()
    (parts_of(path) / kept.LOCK).write_text("my keys")
    assert "is not a file of mwdcal" in refused(fleet(path)[0], 2)
    assert (parts_of(path) / kept.LOCK).read_text() == "my keys"


def test_no_output_replaces_a_file_of_the_input_folder(tmp_path):
    runs = tmp_path / "runs"
    runs.mkdir()
    inside = runs / "a.parquet"
    write_fleet(inside, {"T1": short_run(1)})
    before = inside.read_bytes()
    for options in (("-o", inside), ("-o", tmp_path / "o.parquet", "--report", inside)):
        ran = mwdcal("fleet", runs, "--tool", "servo", "--workers", 1, *options)
        assert "input" in refused(ran, 2)
        assert inside.read_bytes() == before
    assert not (tmp_path / "o.parquet").exists()


# A full disk


def full(*given, **also):
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_full_disk_leaves_no_rows_dealt_by_half(tmp_path, small_parts, monkeypatch):
    path = small_fleet(tmp_path, mixed=True)
    monkeypatch.setattr(pq.ParquetWriter, "write_table", full)
    message = refused(fleet(path)[0], 2)
    assert f"'{parts_of(path)}': No space left on device" in message
    assert not parts_of(path).exists()


def test_a_full_disk_at_the_end_keeps_the_parts(tmp_path, small_parts, monkeypatch):
    path = small_fleet(tmp_path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pq.ParquetWriter, "write_table", full)
        ran, output = fleet(path)
    message = refused(ran, 2)
    assert f"'{output}': No space left on device. Finished parts are kept" in message
    assert {each.name for each in tmp_path.iterdir()} == {path.name, parts_of(path).name}
    assert all(each.suffix == ".arrow" for each in parts_of(path).iterdir())
    ran, _ = fleet(path)
    assert ran.code == 0
    assert ", 0 done" not in ran.err


def test_an_interruption_while_rows_are_dealt_leaves_nothing(tmp_path, small_parts, monkeypatch):
    path = small_fleet(tmp_path, mixed=True)

    def stop(*given, **also):
        raise KeyboardInterrupt

    monkeypatch.setattr(pq.ParquetWriter, "write_table", stop)
    assert fleet(path)[0].code == 130
    assert not parts_of(path).exists()


# Damaged and odd tables are blamed by name


def odd_columns(table):
    count = table.num_rows
    doubled = [*table.column_names]
    doubled[-1] = "ax"
    yield "column names must be unique; got 'ax' more", table.rename_columns(doubled)
    kinds = {
        "serial": (pa.array([[1.0]] * count), "must be text or whole numbers"),
        "station": (pa.array([["a"]] * count), "must be text, numbers or times"),
        "group": (pa.array([{"a": 1}] * count), "must be text, numbers or times"),
        "ax": (pa.array([[1.0]] * count), "expected numbers"),
    }
    for name, (cells, words) in kinds.items():
        yield f"column '{name}': {words}", replaced_column(table, name, cells)
    large = pa.array([2**64 - 1] * count, pa.uint64())
    yield "column 'serial': must be text or whole numbers", replaced_column(table, "serial", large)


def replaced_column(table, name, cells):
    rest = table.drop_columns([name]) if name in table.column_names else table
    return rest.append_column(name, cells)


def test_odd_columns_are_blamed_by_file_and_column(tmp_path):
    path = write_fleet(tmp_path / "runs.parquet", {"T1": short_run(1)})
    for words, table in odd_columns(pq.read_table(path)):
        pq.write_table(table, path)
        message = refused(fleet(path)[0], 2)
        assert "runs.parquet" in message
        assert words in message, message
        assert "complete Parquet" not in message
        assert not parts_of(path).exists()


@pytest.mark.parametrize(
    ("first", "kind"),
    [
        (1, pa.timestamp("ns", "Europe/Oslo")),
        (1, pa.timestamp("us", "Mars/Olympus")),
        (2**62, pa.timestamp("us")),
    ],
)
def test_stations_named_by_odd_times_are_labels(tmp_path, first, kind):
    """In nanoseconds, of a time zone that nobody knows, in years beyond the calendar."""
    path = write_fleet(tmp_path / "runs.parquet", {"T1": short_run(1)})
    table = pq.read_table(path)
    times = pa.array(range(first, first + 2 * table.num_rows, 2), kind)
    pq.write_table(replaced_column(table, "station", times), path)
    assert fleet(path)[0].code == 0


@pytest.mark.parametrize("name", ["serial", "station", "group"])
@pytest.mark.parametrize("kind", [pa.string(), pa.large_string()])
@pytest.mark.parametrize("encoded", [False, True])
def test_labels_of_broken_utf_8_are_refused_by_name(tmp_path, name, kind, encoded):
    path = write_fleet(tmp_path / "runs.parquet", {"T1": short_run(1)})
    table = pq.read_table(path)
    raw = pa.array(
        [b"\xff"] * table.num_rows, pa.binary() if kind == "string" else pa.large_binary()
    )
    cells = pa.Array.from_buffers(kind, len(raw), raw.buffers())
    if encoded:
        cells = pa.DictionaryArray.from_arrays(pa.array([0] * len(raw)), cells.slice(0, 1))
    pq.write_table(replaced_column(table, name, cells), path)
    message = refused(fleet(path)[0], 2)
    assert f"runs.parquet, column '{name}': expected labels that can be written as text" in message


def test_a_pipe_among_the_files_of_a_folder_is_no_table(tmp_path):
    if not hasattr(os, "mkfifo"):
        pytest.skip("no named pipes on this system")
    runs = tmp_path / "runs"
    runs.mkdir()
    write_fleet(runs / "a.parquet", {"T1": short_run(1)})
    os.mkfifo(runs / "b.parquet")
    ran = mwdcal("fleet", runs, "--tool", "servo", "--workers", 1, "-o", tmp_path / "o.parquet")
    assert ran.code == 0, ran


def test_infinite_temperatures_of_a_refused_tool_are_blank(tmp_path):
    good = short_run(1)
    hot = good["temperature_c"].copy()
    hot[0] = float("inf")
    path = write_fleet(
        tmp_path / "runs.parquet", {"T1": {**good, "temperature_c": hot}, "T2": good}
    )
    ran, output = fleet(path)
    assert ran.code == 0
    bad, _ = pq.read_table(output).to_pylist()
    assert bad["status"] == "bad-input"
    assert bad["temperature_max_c"] is None


@pytest.mark.parametrize("serial", ["[/x]", "[bold]", "[/]", "\\[red]"])
def test_serials_with_marks_of_a_markup_language_are_shown_as_they_are(tmp_path, serial):
    good = short_run(1)
    runs = {serial: {n: v[:3] for n, v in good.items()}, "T2": good}
    ran, _ = fleet(write_fleet(tmp_path / "runs.parquet", runs))
    assert ran.code == 0, ran
    assert any(serial in line for line in ran.out.splitlines() if "too-few" in line), ran.out
