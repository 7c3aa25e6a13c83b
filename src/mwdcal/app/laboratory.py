"""The laboratory's settings for a command: looked for above its table, as defaults of its options, said in one line.

`mwdcal.toml` is looked for in the folder of the first file that the command reads and in those above it, then in the
current folder and those above it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

if TYPE_CHECKING:
    from mwdcal.files.profiles import LaboratorySettings, SettingsInUse

SETTINGS_FILE = "mwdcal.toml"
SETTING_OF = {
    "tool": "tool",
    "limits": "limits",
    "database": "registry",
    "registry": "registry",
    "key": "keys",
    "laboratory": "laboratory",
    "countersign": "countersign",
}
"""The setting that is the default of an option, by the name of its variable."""
WITHOUT_SETTINGS = ("init", "list", "example", "completion")
"""Commands that no setting concerns."""
NOTED_BY_READER = ("limits",)
"""Settings that count as used when their file is read: an option may have them and not need them."""
_LOCAL = ("tool", "limits", "registry", "laboratory", "countersign")
_GIVEN = {ParameterSource.COMMANDLINE: "given as {}", ParameterSource.ENVIRONMENT: "given by ${}"}


def settings_of(
    command: click.Command, context: click.Context, args: Sequence[str]
) -> SettingsInUse | None:
    """The settings for a command line, whose values become defaults of the command's options."""
    helped = {*context.help_option_names} & {*args}
    if helped or context.resilient_parsing or command.name in WITHOUT_SETTINGS:
        return None
    path = find(_folders(command, context, args))
    if path is None:
        return None
    used = load(path)
    context.default_map = _defaults(command, used, path.parent)
    return used


def _folders(command: click.Command, context: click.Context, args: Sequence[str]) -> list[Path]:
    """The folder of the first file that a command line names as an argument, if any, and the current one."""
    try:
        values = command.make_parser(context).parse_args([*args])[0]
    except click.UsageError:  # said when the line is parsed in earnest
        values = {}
    named = [
        values.get(str(param.name))
        for param in command.params
        if isinstance(param, click.Argument) and isinstance(param.type, click.Path)
    ]
    first = next((word for word in named if isinstance(word, str)), "")
    folders = [Path(first.partition("#")[0]).absolute().parent] if first else []
    return [*folders, Path.cwd()]


def find(folders: Iterable[Path]) -> Path | None:
    """The nearest settings file in a folder or above it, of the first folder that has one."""
    for folder in folders:
        for place in (folder, *folder.parents):
            path = place / SETTINGS_FILE
            if _is_file(path):
                return path
    return None


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def load(path: Path) -> SettingsInUse:
    """The settings in a file, checked.

    Raises:
        InputError: it is not one, or a value is impossible.
    """
    from mwdcal.files.profiles import LaboratorySettings, SettingsInUse, decoded_toml

    settings, digest = decoded_toml(str(path), LaboratorySettings, "", "settings file", "Settings")
    _check(settings, str(path))
    return SettingsInUse(str(path), digest, _local(settings, path.parent))


def _check(settings: LaboratorySettings, source: str) -> None:
    """Refuse a stand and standards that cannot be."""
    from mwdcal.errors import InputError
    from mwdcal.files.profiles import check_profile
    from mwdcal.sensor.profile import Profile

    check_profile(Profile(name=SETTINGS_FILE, stand=settings.stand), source)
    for each in settings.standards:
        if not each.name.strip() or (each.issued and each.due and each.due < each.issued):
            raise InputError(
                f"{source}: a standard must have a name, and be due after it was issued; got {each.name!r}, issued "
                f"{each.issued}, due {each.due}. Correct it."
            )


def checked_settings(values: Mapping[str, Any], folder: Path) -> LaboratorySettings:
    """Settings by their keys, as typed; files are seen from a folder.

    Raises:
        InputError: a key or value is impossible, or profile or limits cannot be read.
    """
    import msgspec

    from mwdcal.errors import InputError
    from mwdcal.files.limits import load_limits
    from mwdcal.files.profiles import LaboratorySettings, load_profile

    try:
        settings = msgspec.convert(values, LaboratorySettings)
    except msgspec.ValidationError as error:
        raise InputError(f"an answer is impossible: {error}. Correct it.") from None
    _check(settings, SETTINGS_FILE)
    local = _local(settings, folder)
    if settings.tool:
        load_profile(local.tool)
    if settings.limits:
        load_limits(local.limits)
    return settings


def _local(settings: LaboratorySettings, folder: Path) -> LaboratorySettings:
    """Settings whose files are seen from anywhere; names of what is built in, and URLs, stay."""
    from msgspec.structs import replace

    from mwdcal.files.profiles import built_in

    names = {"tool": built_in("profiles"), "limits": built_in("limits")}

    def seen(name: str, value: str) -> str:
        kept = not value or value in names.get(name, ()) or "://" in value
        return value if kept else str(folder / value)

    files = {name: seen(name, getattr(settings, name)) for name in _LOCAL}
    return replace(settings, **files, keys=tuple(str(folder / key) for key in settings.keys))


def _defaults(command: click.Command, used: SettingsInUse, folder: Path) -> dict[str, Any]:
    """Values of a command's options by the settings.

    Limits of a roll test are no limits of surveys. Keys count only where the command runs in the folder of the
    settings or below it: trust does not come with the data.
    """
    values: dict[str, Any] = {}
    for param in command.params:
        name = SETTING_OF.get(str(param.name), "")
        value = getattr(used.settings, name) if name else ""
        if not value or isinstance(param, click.Argument):
            continue
        if name == "limits" and param.default != "roll-test":
            continue
        if name == "keys" and not (param.multiple and Path.cwd().is_relative_to(folder.resolve())):
            continue
        values[str(param.name)] = [*value] if name == "keys" else value
    return values


@contextmanager
def using(used: SettingsInUse | None) -> Iterator[None]:
    """Run a command with its settings, if there are any."""
    if used is None:
        yield
        return
    from mwdcal.files import profiles

    with profiles.using(used):
        yield


def note_options(context: click.Context, used: SettingsInUse) -> None:
    """Note which settings the options of a command line have taken, and which were given otherwise."""
    for name in context.default_map or ():
        source, setting = context.get_parameter_source(name), SETTING_OF[name]
        if source is ParameterSource.DEFAULT_MAP and setting not in NOTED_BY_READER:
            used.take(setting)
        elif source in _GIVEN:
            option = next(p for p in context.command.params if p.name == name)
            word = option.opts[-1] if source is ParameterSource.COMMANDLINE else option.envvar
            used.pass_over(setting, _GIVEN[source].format(word))


def line_on(used: SettingsInUse) -> str:
    """The sentence on what settings were used; empty where none were."""
    if not used.taken and not used.passed_over:
        return ""
    taken = ", ".join(used.taken) or "nothing"
    passed = [f"{', '.join(names)} ({reason})" for reason, names in used.passed_over.items()]
    others = f"; not {', '.join(passed)}" if passed else ""
    return f"settings of {used.file}: {taken}{others}"
