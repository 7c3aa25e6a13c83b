"""Tool profiles by name (built in) or path (TOML), checked, with messages that name the key."""

from __future__ import annotations

import datetime
import difflib
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Literal, TypeVar, get_args, get_origin

import msgspec

from mwdcal.calibration.readings import TRIADS
from mwdcal.digests import sha256_of
from mwdcal.errors import InputError, reason, shell_word
from mwdcal.files.contract import CHANNELS, MAPPED, TEMPERATURE, units_of
from mwdcal.files.formats.table import shown
from mwdcal.files.metadata import LARGEST_TOML, load_toml, toml
from mwdcal.sensor.profile import (
    ColumnSource,
    Datasheet,
    MeasurementStandard,
    Profile,
    StandProfile,
    StreamForm,
    TableFormat,
    TriadProfile,
)

_Decoded = TypeVar("_Decoded", bound=msgspec.Struct)
PACKAGE = Path(__file__).parents[1]
"""The folder of this package: `importlib.resources` takes longer to load than its profiles to read."""
_SUFFIX = ".toml"
_DATES = (datetime.datetime, datetime.date, datetime.time)
_SECTIONS: dict[str, type[msgspec.Struct]] = {
    **dict.fromkeys(TRIADS, TriadProfile),
    "datasheet": Datasheet,
    "stand": StandProfile,
    "table": TableFormat,
    "columns": ColumnSource,
}
_WORDS = {
    "float": "a number",
    "int": "a whole number",
    "str": "text",
    "bool": "true or false",
    "array": "a list",
    "object": "a section",
    "date": "a date",
    "datetime": "a date with time",
    "time": "a time of day",
}
_OPEN_AXES = re.compile(r"\s*axes\s*=\s*\[\s*\]")
_ALL = (1e-15, 1e15)
_UNKNOWN = "leave it out where it is unknown."
_SHARE = "1 sigma as a share of the field, such as 0.005; leave it out for a linear axis."
_ANGLE = (0.0, 180.0, "1 sigma, in degrees.")
_LIMITS: dict[type[msgspec.Struct], dict[str, tuple[float, float, str]]] = {
    StreamForm: {},
    Profile: {"reference_temperature_c": (TEMPERATURE.low, TEMPERATURE.high, "In °C.")},
    TriadProfile: {
        "scale": (*_ALL, f'Put the sign into `axes`, for example "-x"; {_UNKNOWN}'),
        "noise": (*_ALL, f"1 sigma in raw units; {_UNKNOWN}"),
        "nonlinearity": (1e-9, 1.0, _SHARE),
        **dict.fromkeys(
            ("repeatability", "drift"), (0.0, 1e15, f"1 sigma in raw units; {_UNKNOWN}")
        ),
    },
    Datasheet: dict.fromkeys(
        Datasheet.__struct_fields__, (*_ALL, f"1 sigma, more than zero; {_UNKNOWN}")
    ),
    StandProfile: {
        **{name: _ANGLE for name in StandProfile.__struct_fields__ if name.endswith("_deg")},
        "gravity_g": (0.0, 2.0, "1 sigma, in g."),
        **dict.fromkeys(("field_nt", "field_drift_nt"), (0.0, 200_000.0, "1 sigma, in nT.")),
    },
    TableFormat: dict.fromkeys(("header_line", "first_line"), (1, 1e6, "Lines count from 1.")),
}
"""Least and greatest value of each number, and what to do about another one."""


CHOICE_OF_AXES = {
    "accelerometer": (
        "Gravity counts downwards: a channel that reads positive when its axis points up has a minus.",
        "Reversing z turns inclination upside down; exchanging x and y, or reversing one, turns toolface.",
    ),
    "magnetometer": (
        "The field counts along itself: in the north it dips down (dip north), in the south up (dip south).",
        "Reversing all three axes exchanges dip north and south, and turns azimuth by 180 degrees.",
    ),
}
"""The meaning of the axes of a triad: what is changed by choosing others."""


def load_profile(name_or_path: str | None = None) -> tuple[Profile, str]:
    """A tool profile and the SHA-256 of its bytes: built in by name, or a TOML file by path.

    None is the built-in `generic`: channels along the tool axes, nothing else known. In a command the laboratory's
    settings complete it.
    """
    name = "generic" if name_or_path is None else name_or_path
    data, digest = read_toml(name, "profiles", "tool profile")
    return completed(decoded_profile(data, Path(name).name)), digest


def built_in(folder: str) -> list[str]:
    """Names of the TOML files in a folder of the package; no folder has none.

    >>> "generic" in built_in("profiles")
    True
    """
    if not folder:
        return []
    files = (file.name for file in PACKAGE.joinpath(folder).iterdir())
    return sorted(name.removesuffix(_SUFFIX) for name in files if name.endswith(_SUFFIX))


def read_toml(name: str, folder: str, kind: str) -> tuple[bytes, str]:
    """The text of a TOML file, built in by name in a folder of the package, or by path.

    Without a byte order mark; with it the SHA-256 of the file. `kind` is what the file should hold.
    """
    path = Path(name)
    if name in built_in(folder):
        path = PACKAGE.joinpath(folder, name + _SUFFIX)
    try:
        if path.is_file():
            with path.open("rb") as stream:
                data = stream.read(LARGEST_TOML + 1)
            if len(data) <= LARGEST_TOML:
                return data.removeprefix(b"\xef\xbb\xbf"), sha256_of(data)
        exists = path.exists()
    except (OSError, ValueError) as error:
        raise InputError(
            f"cannot read the {kind} '{name}': {reason(error)}. Check its permissions."
        ) from error
    if exists:
        raise InputError(
            f"'{name}' is not a {kind}: expected a TOML file of at most {LARGEST_TOML} bytes. "
            "Name a file such as tool.toml."
        )
    if path.suffix.lower() == _SUFFIX:
        remedy = (
            f", or make one: mwdcal profile TABLE -o {shell_word(name)}"
            if folder == "profiles"
            else ""
        )
        raise InputError(f"{kind}: there is no file '{name}'. Check the path{remedy}.")
    names = built_in(folder)
    near = difflib.get_close_matches(name.lower(), names, n=2)
    meant = f" Did you mean {' or '.join(repr(n) for n in near)}?" if near else ""
    if not names:
        raise InputError(
            f"{kind} must be the path of a TOML file; got '{name}', which does not exist. Check the path."
        )
    raise InputError(
        f"{kind} must be a built-in name ({', '.join(names)}) or the path of a TOML "
        f"file; got '{name}', which is neither.{meant} Check the name or the path."
    )


def decoded_toml(
    name: str, struct: type[_Decoded], folder: str, kind: str, page: str
) -> tuple[_Decoded, str]:
    """A TOML file as a `struct`, and the file's SHA-256; `name`, `folder`, `kind` as of `read_toml`.

    `page` of the documentation says what such a file holds.
    """
    data, digest = read_toml(name, folder, kind)
    try:
        return _decoded(data, struct), digest
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        names = ", ".join(built_in(folder))
        compared = (
            f"Compare it with the built-in ones: {names} (docs" if names else "Correct it (docs"
        )
        problem = f"{toml_problem(error)}. {_section_line(str(error), struct)}"
        raise InputError(f"{name} is not a {kind}: {problem}{compared}, '{page}').") from None


def _section_line(problem: str, struct: type[msgspec.Struct]) -> str:
    """The sentence on the line that belongs above an unknown key, where a section of the `struct` has it."""
    unknown = re.match(r"Object contains unknown field `(.*)`$", problem)
    for section in msgspec.structs.fields(struct) if unknown else ():
        kinds = (section.type, *get_args(section.type))
        keys = [key for each in kinds for key in getattr(each, "__struct_fields__", ())]
        if unknown and unknown[1] in keys:
            title = section.encode_name
            line = f"[[{title}]]" if get_origin(section.type) is list else f"[{title}]"
            return f"'{unknown[1]}' belongs below a line {line}. "
    return ""


def _decoded(data: bytes, struct: type[_Decoded]) -> _Decoded:
    """The values of TOML text, checked, as a `struct`."""
    return msgspec.convert(load_toml(data.decode()), struct, builtin_types=_DATES, str_keys=True)


def decoded_profile(data: bytes, source: str) -> Profile:
    """The checked profile in the bytes of a TOML file, without a byte order mark."""
    try:
        _check_axes_stated(data.decode(), source)
        profile = _decoded(data, Profile)
    except msgspec.ValidationError as error:
        raise _invalid(str(error), source) from None
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        if Path(source).suffix.lower() != _SUFFIX:
            raise InputError(
                f"{source} is no tool profile, which is a TOML file. For a table make one: mwdcal profile "
                f"{shell_word(source)} -o tool.toml."
            ) from None
        raise _unreadable(data, error, source) from None
    check_profile(profile, source)
    return profile


def _unreadable(data: bytes, error: Exception, source: str) -> InputError:
    """Why the bytes of a TOML file hold no profile."""
    if isinstance(error, UnicodeDecodeError):
        line = data.count(b"\n", 0, error.start) + 1
        return InputError(
            f"{source}, line {line}: expected UTF-8 text; got byte 0x{data[error.start]:02X}. "
            "Save the file as UTF-8."
        )
    return InputError(
        f"{source}: a tool profile must be TOML; {_lower_first(toml_problem(error))}. Correct the "
        'file; text needs quotes, numbers a decimal point, axes are a list such as ["+x", "+y", "+z"].'
    )


def _check_axes_stated(text: str, source: str) -> None:
    """Refuse a proposed profile whose axes are still to be filled in."""
    sections = load_toml(text)
    lacking = [kind for kind in TRIADS if _axes_of(sections.get(kind)) == []]
    if not lacking:
        return
    lines = [n for n, line in enumerate(text.splitlines(), 1) if _OPEN_AXES.match(line)]
    where = (
        f", line{'s' if len(lines) > 1 else ''} {' and '.join(map(str, lines))}" if lines else ""
    )
    changes = " ".join(line for kind in lacking for line in CHOICE_OF_AXES[kind])
    raise InputError(
        f"{source}{where}: the axes of {' and '.join(lacking)} are open. Fill in axes = "
        f'["+x", "+y", "+z"] or another order and signs: the tool axis that each channel measures. {changes}'
    )


def _axes_of(section: object) -> object:
    return section.get("axes") if isinstance(section, dict) else None


def toml_problem(error: Exception) -> str:
    """Message of the TOML decoder, also of values that Python itself refuses."""
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    if "integer string conversion" in str(error):
        return "a whole number has more than 4300 digits"
    return str(error)


def _lower_first(text: str) -> str:
    return text[:1].lower() + text[1:]


def _invalid(message: str, source: str) -> InputError:
    """Message of the decoder about structure and types, with the key and what to do."""
    problem, _, path = message.partition(" - at `$.")
    where = path.rstrip("`")
    unknown = re.fullmatch(r"Object contains unknown field `(.*)`", problem, re.DOTALL)
    if unknown:
        return _unknown_key(unknown[1], where, source)
    missing = re.fullmatch(r"Object missing required field `(.*)`", problem)
    if missing:
        return InputError(
            f"{source}: key '{missing[1]}' must be present; got none. "
            f'Add a line such as {missing[1]} = "my tool".'
        )
    if where == "stand.settings":
        got = problem.partition("got ")[2].strip("`") or problem.rpartition(" ")[2]
        return InputError(
            f'{source}, key \'{where}\': must be "per-direction" or "per-station"; got '
            f"{_WORDS.get(got, got[:80])}. Say whether the operator sets inclination and azimuth once for a "
            "roll set, or at every station."
        )
    if "axes" in where:
        return _axes_error(where, _axes_got(problem), source)
    return InputError(
        f"{source}, key '{where}': {_plain_types(problem)}. Write numbers without quotes, text "
        "in quotes, and the triads as sections, such as [accelerometer]."
    )


def _plain_types(problem: str) -> str:
    """The decoder's sentence on types in the words of a profile's author."""
    types = re.fullmatch(r"Expected `(\w+).*`, got `(\w+)`", problem)
    if types is None:
        return _lower_first(problem)
    expected, got = (_WORDS.get(word, word) for word in types.groups())
    return f"must be {expected}; got {got}"


def _unknown_key(key: str, section: str, source: str) -> InputError:
    struct = _SECTIONS.get(section.rpartition(".")[2], Profile)
    known = [field.encode_name for field in msgspec.structs.fields(struct)]
    near = difflib.get_close_matches(key.lower(), known, n=1)
    meant = f" Did you mean '{near[0]}'?" if near else ""
    full = f"{section}.{key}" if section else key
    if key in StandProfile.__struct_fields__:
        return InputError(
            f"{source}, key '{full}': it belongs below a line [stand]. Take the # away from that line, or write it."
        )
    return InputError(
        f"{source}, key '{full[:80]}': must be one of {', '.join(known)}; got an unknown "
        f"key.{meant} Rename or remove it."
    )


def _axes_error(key: str, problem: str, source: str) -> InputError:
    return InputError(
        f"{source}, key '{key}': must be three of +x, -x, +y, -y, +z, -z, each letter once; "
        f"got {problem}. State for each channel the tool axis it "
        'measures, such as ["+x", "+y", "+z"].'
    )


def _axes_got(problem: str) -> str:
    """What stands in `axes`, out of the decoder's sentence."""
    value = re.search(r"(?:got|value) (.*)", problem, re.DOTALL)
    got = value[1].strip("`") if value else problem
    return f"{got} of them" if got.isdigit() else _WORDS.get(got, got[:80])


def check_profile(profile: Profile, source: str) -> None:
    """Refuse values that no tool can have."""
    if not profile.name.strip():
        raise InputError(f"{source}, key 'name': must not be blank; got ''. Name the tool.")
    _check_section(profile, source)
    if not isinstance(profile.columns, msgspec.UnsetType):
        _check_columns(profile.columns, source)
    if not isinstance(profile.stream, msgspec.UnsetType):
        _check_stream(profile.stream, source)
    form = profile.table
    if isinstance(form, msgspec.UnsetType) or form.find:
        return
    if form.first_line <= form.header_line:
        raise InputError(
            f"{source}, key 'table.first_line': must be below the names in line {form.header_line}; got "
            f"{form.first_line}. Correct it."
        )


def _check_stream(form: StreamForm, source: str) -> None:
    """Refuse a stream whose lines name no accelerometer, or an invalid pattern."""
    try:
        names = {*form.columns, *re.compile(form.pattern).groupindex}
    except re.error as error:
        raise InputError(
            f"{source}, key 'stream.pattern': is no regular expression ({error}). Correct it."
        ) from None
    missing = {*CHANNELS["accelerometer"]} - names
    if missing or (form.columns and form.pattern):
        raise InputError(
            f"{source}, section 'stream': must name ax, ay and az, in `columns` or as groups of `pattern`. Correct it."
        )


def _check_section(section: msgspec.Struct, source: str, prefix: str = "") -> None:
    """Refuse axes of fewer than three letters, and numbers outside their limits; None is not stated."""
    if isinstance(section, TriadProfile) and len({axis[1] for axis in section.axes}) < 3:
        raise _axes_error(f"{prefix}axes", " ".join(section.axes), source)
    for key, (low, high, advice) in _LIMITS[type(section)].items():
        value = getattr(section, key)
        if value is not None and not low <= value <= high:
            raise InputError(
                f"{source}, key '{prefix}{key}': must be between {low:g} and {high:g}; "
                f"got {shown(value)}. {advice}"
            )
    for key in section.__struct_fields__:
        inner = getattr(section, key)
        if isinstance(inner, msgspec.Struct):
            _check_section(inner, source, f"{prefix}{key}.")


def _check_columns(columns: Mapping[str, ColumnSource], source: str) -> None:
    """Refuse names that no run file has, units that are not of their quantity, and a column named twice."""
    taken: dict[str, str] = {}
    for column, each in columns.items():
        key = f"{source}, key 'columns.{column[:40]}'"
        if column not in MAPPED:
            near = difflib.get_close_matches(column.lower(), MAPPED, n=1)
            meant = f" Did you mean '{near[0]}'?" if near else ""
            raise InputError(
                f"{key}: must be a column of a run file, such as ax or ref_inclination_deg.{meant} Rename or "
                "remove it."
            )
        allowed = units_of(column)
        if each.unit and allowed and each.unit not in allowed:
            raise InputError(
                f"{key}: the unit must be one of {', '.join(allowed)}; got {shown(each.unit)}. Correct it, or "
                "convert the column in the table."
            )
        if each.name in taken:
            raise InputError(
                f"{key}: the column {shown(each.name)} is '{taken[each.name]}' already. Name each column once."
            )
        taken[each.name] = column


# --------------------------------------------------------------------------
# Settings of a laboratory for all its commands, in `mwdcal.toml`, and those that the running command has used.


class LaboratorySettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The content of `mwdcal.toml`: nothing in it is mandatory.

    `tool` and `limits` are names or files, `registry` a file or URL, `keys` public keys to trust, `laboratory` the
    laboratory file of certificates, `countersign` the private key with which a second person signs the certificate of
    a bench; files as seen from the folder of `mwdcal.toml`. `decision` is the rule for limits
    that state none. The units are those of columns whose unit nothing else tells. `stand` and `standards` complete
    tool profiles that do not state them.
    """

    tool: str = ""
    limits: str = ""
    decision: Literal["", "simple", "guarded"] = ""
    registry: str = ""
    keys: tuple[str, ...] = ()
    laboratory: str = ""
    countersign: str = ""
    length_unit: Literal["", "m", "ft", "usft"] = ""
    temperature_unit: Literal["", "°C", "°F", "K"] = ""
    stand: StandProfile = StandProfile()
    standards: tuple[MeasurementStandard, ...] = ()


@dataclass
class SettingsInUse:
    """Settings of a file, and what the command has taken from it, or has not as something else comes first."""

    file: str
    sha256: str
    settings: LaboratorySettings
    taken: list[str] = field(default_factory=list)
    passed_over: dict[str, list[str]] = field(default_factory=dict)

    def take(self, name: str) -> None:
        """Note that a setting is used."""
        self.taken += [] if name in self.taken else [name]

    def pass_over(self, name: str, reason: str) -> None:
        """Note that a setting is not used, and what comes first."""
        names = self.passed_over.setdefault(reason, [])
        names += [] if name in names else [name]


_IN_USE: ContextVar[SettingsInUse | None] = ContextVar("settings in use", default=None)


@contextmanager
def using(used: SettingsInUse | None) -> Iterator[None]:
    """Use settings for what is done inside."""
    before = _IN_USE.set(used)
    try:
        yield
    finally:
        _IN_USE.reset(before)


def in_use() -> SettingsInUse | None:
    """The settings of the running command; None without settings, and outside of commands."""
    return _IN_USE.get()


def source_of_settings() -> tuple[str, str]:
    """Path and SHA-256 of the settings, where the running command has used any; else empty."""
    used = in_use()
    return (used.file, used.sha256) if used and used.taken else ("", "")


def setting(name: str) -> str:
    """A setting of the running command, which counts as used; empty where it is not stated."""
    used = in_use()
    value = str(getattr(used.settings, name)) if used else ""
    if used and value:
        used.take(name)
    return value


def stand_in_settings() -> bool:
    """Whether the settings of the running command state anything of the stand."""
    used = in_use()
    return used is not None and used.settings.stand != StandProfile()


def standards_of(profile: Profile) -> tuple[MeasurementStandard, ...] | msgspec.UnsetType:
    """The standards that a roll test rests on: the laboratory's of today, else those of the tool profile."""
    used = in_use()
    if used and used.settings.standards:
        used.take("standards")
        return used.settings.standards
    return profile.standards


def completed(profile: Profile) -> Profile:
    """A tool profile with the stand and the standards of the laboratory, where it states none itself."""
    used = in_use()
    if not used:
        return profile
    usual, changed = StandProfile(), {}
    for name in StandProfile.__struct_fields__:
        theirs, stated = getattr(used.settings.stand, name), getattr(profile.stand, name)
        if theirs == getattr(usual, name):
            continue
        if stated == getattr(usual, name):
            used.take(f"stand.{name}")
            changed[name] = theirs
        elif stated != theirs:
            used.pass_over(f"stand.{name}", "the tool profile's own")
    profile = msgspec.structs.replace(
        profile, stand=msgspec.structs.replace(profile.stand, **changed)
    )
    if not used.settings.standards:
        return profile
    if isinstance(profile.standards, tuple):
        used.pass_over("standards", "the tool profile's own")
        return profile
    used.take("standards")
    return msgspec.structs.replace(profile, standards=used.settings.standards)


def settings_toml(settings: LaboratorySettings) -> str:
    """The text of a settings file; what is not stated stands in it as a comment."""
    plain = {
        k: v for k, v in msgspec.structs.asdict(settings).items() if k not in ("stand", "standards")
    }
    lines = ["# Settings of the laboratory, for every mwdcal command in this folder and below.", ""]
    for name, value in plain.items():
        written = toml(value)
        lines.append(f"{name} = {written}" if value else f"# {name} = {written}")
    usual = msgspec.structs.asdict(StandProfile())
    stand = {k: v for k, v in msgspec.structs.asdict(settings.stand).items() if v != usual[k]}
    sections = [("[stand]   # 1σ of one setting, as in a tool profile", stand)]
    sections += [("[[standards]]", _stated_of(each)) for each in settings.standards]
    for head, values in sections:
        lines += ["", head, *(f"{name} = {_entry(value)}" for name, value in values.items())]
    return "\n".join(lines) + "\n"


def _stated_of(standard: MeasurementStandard) -> dict[str, object]:
    return {name: value for name, value in msgspec.structs.asdict(standard).items() if value}


def _entry(value: object) -> str:
    return value.isoformat() if isinstance(value, date) else toml(value)
