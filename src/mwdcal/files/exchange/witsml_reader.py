"""One WITSML trajectory out of XML that nobody vouches for, part by part and without building a tree.

Refused in one sentence: XML that is not well formed, document types and with them entities of every
kind, deep nesting, floods of elements, long elements, other objects and other versions.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

from mwdcal import extras
from mwdcal.errors import InputError
from mwdcal.files.exchange.witsml_schema import NAMESPACE, OLD_NAMESPACE, Leaf
from mwdcal.files.formats.columns import shown

_DEEPEST_ELEMENT = 24
MOST_ELEMENTS = 1_000_000
_LONGEST_PART = 1 << 20
_PIECE_OF_XML = 1 << 16
_ROOT = ("trajectorys", "trajectory")
_STATION = (*_ROOT, "trajectoryStation")
_EXTENSIONS = "extensionNameValue"


@dataclass
class Station:
    """A station: its identifier, its leaves by path, its extensions by name, and its line."""

    uid: str
    line: int
    leaves: dict[str, Leaf] = field(default_factory=dict)
    extensions: dict[str, Leaf] = field(default_factory=dict)


@dataclass
class Trajectory:
    """A trajectory: its identifiers, its leaves by path, its extensions by name, its stations."""

    uids: dict[str, str] = field(default_factory=dict)
    leaves: dict[str, Leaf] = field(default_factory=dict)
    extensions: dict[str, list[Leaf]] = field(default_factory=dict)
    stations: list[Station] = field(default_factory=list)


def read_trajectory(data: bytes, source: str) -> Trajectory:
    """The trajectory in the bytes of a WITSML file."""
    elements, forbidden = _modules(source)
    collector = _Collector(source)
    parser = elements.XMLParser(target=collector, forbid_dtd=True)
    collector.expat = parser.parser
    try:
        for start in range(0, len(data), _PIECE_OF_XML):
            piece = data[start : start + _PIECE_OF_XML]
            parser.feed(piece)
            waiting = start + len(piece) - parser.parser.CurrentByteIndex
            collector.at_most(waiting, _LONGEST_PART, "bytes in a tag")
        parser.close()
    except elements.ParseError as error:
        raise InputError(
            f"{source}: expected well-formed XML; {_problem(error)}. Export the file again."
        ) from None
    except (forbidden, ValueError, LookupError) as error:
        raise InputError(
            f"{source}: XML must be UTF-8 without a document type and entities of its own; got "
            f"{type(error).__name__}. Remove the DOCTYPE, and export the file as UTF-8."
        ) from None
    return collector.trajectory


def _problem(error: Exception) -> str:
    return str(error).partition("\n")[0][:120] or "it is damaged"


def _modules(source: str) -> tuple[Any, type[Exception]]:
    """The parser that refuses attacks, and its refusals; or what to install."""
    refusal = extras.load("defusedxml", f"{source}: a WITSML file", "survey").DefusedXmlException
    return import_module("defusedxml.ElementTree"), refusal


@dataclass
class _Open:
    """An element that is not closed yet."""

    name: str
    uom: str
    line: int
    text: list[str] = field(default_factory=list)
    size: int = 0
    children: Counter[str] = field(default_factory=Counter)


class _Collector:
    """Receives the elements of a file one by one and keeps those of the trajectory."""

    def __init__(self, source: str) -> None:
        self.trajectory = Trajectory()
        self.expat: Any = None
        self._source = source
        self._open: list[_Open] = []
        self._path: list[str] = []
        self._count = 0
        self._namespace = ""
        self._extension: dict[str, Leaf] = {}
        self._trajectories = 0

    def at_most(self, count: int, most: int, what: str) -> None:
        """Refuse more of something than a trajectory has."""
        if count > most:
            raise InputError(
                f"{self._source}, line {self.expat.CurrentLineNumber}: a trajectory must have at most {most} "
                f"{what}. Split the file."
            )

    def start(self, tag: str, given: dict[str, str]) -> None:
        """An element begins."""
        namespace, _, name = tag.removeprefix("{").rpartition("}")
        self._count += 1
        self.at_most(self._count, MOST_ELEMENTS, "elements")
        self.at_most(len(self._open) + 1, _DEEPEST_ELEMENT, "levels of elements")
        if not self._open:
            self._check_root(namespace, name)
        if namespace != self._namespace:
            name = f"{{{namespace}}}{name}"
        line = int(self.expat.CurrentLineNumber)
        part = name
        if self._open:
            siblings = self._open[-1].children
            siblings[name] += 1
            if siblings[name] > 1 and len(self._open) >= len(_STATION) - 1:
                part = f"{name}[{siblings[name]}]" if name not in _STATION else name
        self._open.append(_Open(name, given.get("uom", ""), line))
        self._path.append(part)
        place = tuple(self._path) if len(self._path) <= len(_STATION) else ()
        if place == _ROOT:
            self._trajectories += 1
            self.at_most(self._trajectories, 1, "elements 'trajectory'")
            self.trajectory.uids = dict(given)
        elif place == _STATION:
            self.trajectory.stations.append(Station(given.get("uid", ""), line))

    def _check_root(self, namespace: str, name: str) -> None:
        self._namespace = namespace
        if name != _ROOT[0] or namespace not in (NAMESPACE, OLD_NAMESPACE):
            raise InputError(
                f"{self._source}: expected the element 'trajectorys' of WITSML 1.4.1.1 or 1.3.1.1 (namespace "
                f"{NAMESPACE} or {OLD_NAMESPACE}); got {shown(name)} of {shown(namespace)}. Export the surveys "
                "as a trajectory of one of these versions."
            )

    def data(self, text: str) -> None:
        """Text of the innermost element."""
        element = self._open[-1]
        if element.children:
            return
        element.size += len(text)
        self.at_most(element.size, _LONGEST_PART, "characters in an element")
        element.text.append(text)

    def end(self, tag: str) -> None:
        """The innermost element ends."""
        element = self._open.pop()
        path = self._path
        at_station = len(path) > len(_STATION) and path[2] == _STATION[2] and path[1] == _ROOT[1]
        inside = path[len(_STATION) :] if at_station else path[len(_ROOT) :]
        outside = path[1:2] != [_ROOT[1]] or path[-1] == _STATION[2]
        self._path = path[:-1]
        if outside or not inside:
            return
        if any(each.name == _EXTENSIONS for each in self._open):
            self._extension[element.name] = self._leaf(element)
        elif element.name == _EXTENSIONS:
            self._keep_extension(at_station)
        elif not element.children:
            leaves = self.trajectory.stations[-1].leaves if at_station else self.trajectory.leaves
            leaves["/".join(inside)] = self._leaf(element)

    def _leaf(self, element: _Open) -> Leaf:
        return Leaf(element.name, "".join(element.text), element.uom, element.line)

    def _keep_extension(self, at_station: bool) -> None:
        """Keep the extension that has ended, under its name."""
        parts, self._extension = self._extension, {}
        name, value = parts.get("name"), parts.get("value")
        if name is None or value is None:
            return
        if at_station:
            self.trajectory.stations[-1].extensions[name.text] = value
        else:
            self.trajectory.extensions.setdefault(name.text, []).append(value)

    def close(self) -> None:
        """The file ends."""
