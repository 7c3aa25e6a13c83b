"""What a missing library says: the command that installs it from where mwdcal came from."""

import json
import shlex
import sys

import pytest

from mwdcal import extras
from mwdcal.errors import InputError
from oldest_versions import declared, lowest


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Metadata of an installed mwdcal, with a record of where it came from (PEP 610) or without."""

    def install(**stated):
        folder = tmp_path / "mwdcal-9.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: mwdcal\nVersion: 9\n")
        if stated:
            (folder / "direct_url.json").write_text(json.dumps(stated))
        monkeypatch.syspath_prepend(tmp_path)
        extras._source.cache_clear()

    yield install
    extras._source.cache_clear()


@pytest.mark.parametrize(("editable", "option"), [(True, ["-e"]), (False, [])])
def test_the_command_names_the_folder_of_the_sources(installed, tmp_path, editable, option):
    folder = tmp_path / "a folder, 100 %"
    folder.mkdir()
    installed(url=folder.as_uri(), dir_info={"editable": editable})
    words = shlex.split(extras.command("xlsx"))
    assert words == ["pip", "install", *option, f"{folder}[xlsx]"]


def test_the_command_names_the_wheel(installed, tmp_path):
    wheel = tmp_path / "mwdcal-9-py3-none-any.whl"
    wheel.touch()
    installed(url=wheel.as_uri(), archive_info={})
    assert shlex.split(extras.command("survey")) == ["pip", "install", f"{wheel}[survey]"]


@pytest.mark.parametrize(
    "stated",
    [
        {},
        {"url": "file:///no/such/folder", "dir_info": {}},
        {"url": "https://example.org/mwdcal.whl", "archive_info": {}},
    ],
)
def test_an_unknown_place_is_asked_for(installed, stated):
    installed(**stated)
    message = extras.command("xlsx")
    assert message.startswith('pip install "PATH[xlsx]", where PATH is')


def test_the_refusal_names_use_and_library(monkeypatch):
    monkeypatch.setitem(sys.modules, "typst", None)
    with pytest.raises(InputError) as refused:
        extras.load("typst", "a certificate as PDF", "certificate")
    assert str(refused.value) == (
        "a certificate as PDF needs typst, which is not installed. Install it with: "
        f"{extras.command('certificate')}"
    )


def test_every_requirement_has_a_lowest_version():
    named = [each for each in declared() if not each.startswith("mwdcal")]
    assert len([*lowest(named)]) == len(named)
    assert "psycopg==3.2.1" in lowest(named)
