"""Tool profiles: the built-in ones, files by path, and what is refused with which advice."""

import hashlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mwdcal.errors import InputError
from mwdcal.files.profiles import built_in, load_profile
from mwdcal.sensor.profile import Profile, TriadProfile


def load(folder, text, name="tool.toml"):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return load_profile(str(path))


def refusal(folder, text):
    with pytest.raises(InputError) as caught:
        load(folder, text)
    assert str(caught.value).startswith("tool.toml")
    return str(caught.value)


def test_the_built_in_profiles():
    conventions = ["halliburton", "inverted-xy", "schlumberger", "standard", "tensor"]
    names = [f"convention-{name}" for name in conventions]
    names += ["distox", "generic", "moosavi-servo", "sap5", "sap6", "servo"]
    assert built_in("profiles") == names
    for name in names:
        profile, digest = load_profile(name)
        assert len(digest) == 64
        for triad in (profile.accelerometer, profile.magnetometer):
            np.testing.assert_array_equal(triad.permutation @ triad.permutation.T, np.eye(3))


def test_no_name_is_the_generic_tool():
    assert load_profile() == load_profile("generic")
    assert load_profile()[0] == Profile(name="generic")


def test_a_profile_by_path(tmp_path):
    text = '\ufeffname = "my tool"\n[accelerometer]\naxes = ["-z", "+x", "+y"]\nscale = 3\n'
    profile, digest = load(tmp_path, text)
    assert profile.accelerometer == TriadProfile(axes=("-z", "+x", "+y"), scale=3.0)
    assert digest == hashlib.sha256(text.encode()).hexdigest()


def test_a_left_handed_instrument_is_a_real_one(tmp_path):
    profile = load(tmp_path, 'name = "a"\n[magnetometer]\naxes = ["+y", "+x", "+z"]\n')[0]
    assert np.linalg.det(profile.magnetometer.permutation) == -1.0


@pytest.mark.parametrize(
    ("name", "part"),
    [
        ("servoo", "distox, generic, moosavi-servo, sap5, sap6, servo)"),
        ("servoo", "Did you mean 'servo'"),
        ("nowhere/tool.toml", "there is no file 'nowhere/tool.toml'"),
        ("", "is not a tool profile"),
        ("x" * 5000, "File name too long"),
    ],
)
def test_unknown_names(name, part):
    with pytest.raises(InputError) as caught:
        load_profile(name)
    assert part in str(caught.value)


A = 'name = "a"\n[accelerometer]\n'
REFUSALS = {
    "no name": ("", "key 'name' must be present"),
    "blank name": ('name = " "', "key 'name': must not be blank"),
    "name of wrong type": ("name = 1", "key 'name': must be text; got a whole number"),
    "unknown key": (A + "scal = 1", "key 'accelerometer.scal': must be one of axes, scale"),
    "values below # [stand]": (
        A + "# [stand]\ninclination_deg = 0.01",
        "key 'accelerometer.inclination_deg': it belongs below a line [stand]. Take the # away",
    ),
    "its near match": (A + "scal = 1", "Did you mean 'scale'?"),
    "unknown section": ('name = "a"\n[accelerometers]', "Did you mean 'accelerometer'?"),
    "unknown letter": (A + 'axes = ["+w", "+y", "+z"]', "key 'accelerometer.axes[0]': must be"),
    "two axes": (A + 'axes = ["+x", "+y"]', "each letter once; got 2 of them"),
    "axes as text": (A + 'axes = "+x"', "each letter once; got text"),
    "repeated axis": (A + 'axes = ["+x", "-x", "+z"]', "each letter once; got +x -x +z"),
    "negative scale": (A + "scale = -3.0", "got -3. Put the sign into `axes`"),
    "zero scale": (A + "scale = 0", "key 'accelerometer.scale': must be between"),
    "tiny scale": (A + "scale = 1e-320", "key 'accelerometer.scale': must be between"),
    "endless scale": (A + "scale = inf", "got inf"),
    "no scale": (A + "scale = nan", "got nan"),
    "quoted scale": (A + 'scale = "3"', "must be a number; got text. Write numbers without"),
    "scale of truth": (A + "scale = true", "must be a number; got true or false"),
    "zero noise": (A + "noise = 0.0", "key 'accelerometer.noise': must be between"),
    "negative repeatability": (A + "repeatability = -1e-9", "accelerometer.repeatability"),
    "negative drift": (A + "drift = -1e-9", "accelerometer.drift"),
    "no drift": (A + "drift = nan", "key 'accelerometer.drift': must be between 0"),
    "no field drift": ('name = "a"\n[stand]\nfield_drift_nt = nan', "'stand.field_drift_nt'"),
    "huge nonlinearity": (A + "nonlinearity = 5", "accelerometer.nonlinearity"),
    "negative stand": ('name = "a"\n[stand]\ntoolface_deg = -1', "'stand.toolface_deg'"),
    "practice of the stand": (
        'name = "a"\n[stand]\nsettings = "daily"',
        """key 'stand.settings': must be "per-direction" or "per-station"; got 'daily'""",
    ),
    "practice as number": ('name = "a"\n[stand]\nsettings = 3', "got a whole number"),
    "cold": ('name = "a"\nreference_temperature_c = -300', "'reference_temperature_c'"),
    "date": ('name = "a"\nreference_temperature_c = 2020-01-01', "a number; got a date"),
    "triad as number": ('name = "a"\naccelerometer = 3', "must be a section; got a whole number"),
    "no TOML": ("name = my tool\n", "must be TOML; invalid value (at line 1, column 8)"),
    "repeated key": ('name = "a"\nname = "b"\n', "at line 2, column 11"),
    "Latin-1": (b'name = "a"\n# 30 \xb0C\n', "line 2: expected UTF-8 text; got byte 0xB0"),
    "NUL": (b'name = "a\0"', "must be TOML"),
    "deep": ("name = " + "[" * 50_000, "must be TOML"),
}


@pytest.mark.parametrize(("text", "part"), REFUSALS.values(), ids=REFUSALS)
def test_refusals_name_the_file_the_key_and_the_remedy(tmp_path, text, part):
    assert part in refusal(tmp_path, text)


def test_a_folder_and_a_huge_file_are_no_profiles(tmp_path):
    with pytest.raises(InputError, match="is not a tool profile"):
        load_profile(str(tmp_path))
    with pytest.raises(InputError, match="at most 1000000 bytes"):
        load(tmp_path, b"#" * 1_000_001)


def test_a_profile_that_may_not_be_read(tmp_path, monkeypatch):
    def refuse(self, *mode):
        raise PermissionError(13, "Permission denied", str(self))

    path = tmp_path / "tool.toml"
    path.write_text('name = "a"')
    monkeypatch.setattr(type(path), "open", refuse)
    with pytest.raises(InputError, match=r"Permission denied\. Check its permissions"):
        load_profile(str(path))


PIECES = st.sampled_from(
    [
        *("[accelerometer]", "[stand]", "axes = ", '["+x", "+y", "+z"]', "scale = 3", "noise"),
        *("=", '"', "'", "[", "]", "{", "}", "name = 'a'", "1e999", "nan", "-1"),
        *("\n", "\0", "é", " "),
    ]
)


@settings(max_examples=150, deadline=None)
@given(content=st.binary(max_size=60) | st.lists(PIECES, max_size=15).map("".join))
def test_arbitrary_bytes_are_a_profile_or_an_input_error(tmp_path_factory, content):
    folder = tmp_path_factory.getbasetemp()
    try:
        profile = load(folder, content)[0]
    except InputError:
        return
    assert profile.name
