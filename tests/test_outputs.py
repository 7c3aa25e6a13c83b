"""No output of a command replaces a key, a calibration, or a file that a certificate lists."""

import shutil

import pytest

from cli_support import EXAMPLE, calibrated, mwdcal, refused, servo_run

pytest.importorskip("cryptography")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Calibrations, a certificate that lists one of them and a roll test, and keys."""
    path = tmp_path_factory.mktemp("laboratory")
    (path / "issued").mkdir()
    calibrated(path, servo_run(1)).rename(path / "listed.json")
    calibrated(path, servo_run(1)).rename(path / "other.json")
    shutil.copy(path / "other.json", path / "input.json")
    ran = mwdcal("verify", path / "listed.json", EXAMPLE / "rolltest.csv", "--json")
    (path / "roll.json").write_text(ran.out, "utf-8")
    for words in (
        ("listed.json", "--verification", path / "roll.json", "-o", path / "issued" / "C.json"),
        ("key", "create", "-o", path / "lab.key", "--owner", "laboratory"),
        ("key", "trust", path / "keys.json", path / "lab.key.pub"),
    ):
        ran = mwdcal("certificate", *(path / w if w == "listed.json" else w for w in words))
        assert ran.code == 0, ran.err
    return path


def commands(folder, output):
    """Commands that would write to an output, none of which has it as an input."""
    calibration, readings = folder / "input.json", EXAMPLE / "rolltest.csv"
    return {
        "apply": ("apply", calibration, readings, "-o", output),
        "report": ("verify", calibration, readings, "--report", output),
        "convert": ("convert", calibration, "--notation", "forward", "-o", output),
        "sign": (
            "certificate",
            "sign",
            calibration,
            "--private-key",
            folder / "lab.key",
            "-o",
            output,
        ),
        "calibrate": (
            "calibrate",
            EXAMPLE / "run.csv",
            "--tool",
            EXAMPLE / "tool.toml",
            "-o",
            output,
        ),
        "backup": ("registry", "--registry", folder / "no.sqlite", "backup", output),
    }


@pytest.mark.parametrize("name", ["lab.key", "lab.key.pub", "keys.json", "other.json"])
@pytest.mark.parametrize("command", ["apply", "report", "convert", "sign", "calibrate", "backup"])
def test_keys_and_calibrations_stay(folder, command, name):
    before = (folder / name).read_bytes()
    ran = mwdcal(*commands(folder, folder / name)[command])
    if (command, name) == ("calibrate", "other.json"):
        assert ran.code == 0  # a calibration takes the place of another
        return
    words = "it is a calibration" if name == "other.json" else "it is a key"
    if not (command == "sign" and name == "lab.key"):  # an input of the command
        assert words in refused(ran, 2)
    assert ran.code == 2
    assert (folder / name).read_bytes() == before


@pytest.mark.parametrize("name", ["listed.json", "roll.json"])
@pytest.mark.parametrize("command", ["apply", "report", "convert", "sign", "calibrate"])
def test_what_a_certificate_beside_it_lists_stays(folder, tmp_path, command, name):
    work = tmp_path / "work"
    shutil.copytree(folder, work)
    text = (work / "issued" / "C.json").read_text("utf-8")
    (work / "C.json").write_text(text.replace('"../', '"'), "utf-8")
    before = (work / name).read_bytes()
    said = refused(mwdcal(*commands(work, work / name)[command]), 2)
    assert "C.json" in said or "it is a calibration" in said
    assert (work / name).read_bytes() == before


@pytest.mark.parametrize("name", ["listed.json", "roll.json"])
def test_a_signed_certificate_replaces_nothing_that_it_lists_wherever_it_is(folder, name):
    document, key = folder / "issued" / "C.json", folder / "lab.key"
    before = (folder / name).read_bytes()
    sign = ("certificate", "sign", document, "--private-key", key)
    said = refused(mwdcal(*sign, "-o", folder / name), 2)
    assert "it is a calibration" in said or "'C.json' lists it" in said
    assert (folder / name).read_bytes() == before
    assert mwdcal(*sign, "-o", folder / "signed.json").code == 0


@pytest.mark.parametrize(
    ("command", "name", "better"),
    [
        ("calibrate", "e.jsn", "e.json"),
        ("calibrate", "e.jsonn", "e.json"),
        ("calibrate", "e.json.csv", "e.json.json"),
        ("convert", "e.jsn", "e.json"),
        ("sign", "e.jsn", "e.json"),
        *(
            ("calibrate", f"e.v2.{x}", "e.v2.json")
            for x in ("josn", "tml", "cvs", "htm", "xls", "tonl")
        ),
        ("report", "e.hmtl", "e.html"),
    ],
)
def test_a_misspelt_suffix_is_refused_with_the_right_one(folder, tmp_path, command, name, better):
    said = refused(mwdcal(*commands(folder, tmp_path / name)[command]), 2)
    assert f"Write to '{tmp_path / better}'." in said
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize(
    "name", ["e", "e.JSON", "e.json.new", "MWD 1.5", "e.v2", "e_SN.A12", "e.new"]
)
def test_a_name_without_another_suffix_is_written(folder, tmp_path, name):
    assert mwdcal(*commands(folder, tmp_path / name)["calibrate"]).code == 0
    assert (tmp_path / name).exists()
