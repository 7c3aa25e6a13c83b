"""The cases of the selftest: each compares what mwdcal computes with a published figure or a second formula."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata, resources
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from mwdcal.certificate.decisions import student_factor
from mwdcal.certificate.signature import public_key
from mwdcal.digests import sha256_of
from mwdcal.errors import InputError
from mwdcal.files.profiles import PACKAGE
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import Array
from mwdcal.library import face
from mwdcal.logs import allan
from mwdcal.survey import references
from mwdcal.survey.error_model import Hole, load_error_model
from mwdcal.survey.path import position_covariance, well_path
from mwdcal.use.verification import probability_within

Outcome = Literal["PASS", "FAIL", "not run"]
Attitudes = tuple[Array, Array, Array]
"""Inclination, azimuth and toolface (n,), radians."""
Both = tuple[Any, Any]
"""Expected and computed values."""


class SelftestRow(msgspec.Struct, frozen=True, kw_only=True):
    """One case: whose figures, how many, the first one, the largest difference, what is allowed, and the outcome."""

    name: str
    authority: str
    unit: str
    allowed: float
    outcome: Outcome
    count: int = 0
    expected: float | None = None
    computed: float | None = None
    difference: float | None = None
    note: str = ""


@dataclass(frozen=True)
class SelftestCase:
    """A case before it is run: `allowed` is the largest difference, which the printed digits of the authority set."""

    name: str
    authority: str
    unit: str
    allowed: float
    values: Callable[[], Both]

    def run(self) -> SelftestRow:
        """Compare; a case that needs what is not installed is not run."""
        try:
            expected, computed = (np.ravel(np.asarray(v, float)) for v in self.values())
        except InputError as error:
            return self._row(outcome="not run", note=str(error))
        except Exception as error:
            return self._row(outcome="FAIL", note=f"{type(error).__name__}: {error}")
        same = expected.shape == computed.shape and expected.size > 0
        difference = float(np.abs(expected - computed).max()) if same else np.nan
        return self._row(
            count=expected.size,
            expected=float(expected[0]) if expected.size else None,
            computed=float(computed[0]) if computed.size else None,
            difference=difference if np.isfinite(difference) else None,
            outcome="PASS" if difference <= self.allowed else "FAIL",
        )

    def _row(self, **outcomes: Any) -> SelftestRow:
        """The row of the case, with what came of it."""
        stated: dict[str, Any] = {
            name: getattr(self, name) for name in ("name", "authority", "unit", "allowed")
        }
        return SelftestRow(**stated, **outcomes)


def published(name: str) -> dict[str, Any]:
    """Published figures that are shipped with the package."""
    text = resources.files("mwdcal.selftest").joinpath("reference.json").read_text("utf-8")
    figures: dict[str, Any] = json.loads(text)[name]
    return figures


def _digest() -> Both:
    figures = published("sha256")
    computed = sha256_of(figures["message"].encode())
    return [*bytes.fromhex(figures["digest"])], [*bytes.fromhex(computed)]


def _installed_files() -> Both:
    """Files that are as the wheel had them, by the SHA-256 in its record, against all of them."""
    try:
        listed = metadata.files("mwdcal") or []
    except metadata.PackageNotFoundError:
        listed = []
    hashed = [file for file in listed if file.hash and PACKAGE in Path(str(file.locate())).parents]
    if not hashed:
        raise InputError("the package is not installed from a wheel: no record of its files")
    same = 0
    for file in hashed:
        digest = bytes.fromhex(sha256_of(Path(str(file.locate()))))
        same += base64.urlsafe_b64encode(digest).rstrip(b"=").decode() == (
            file.hash and file.hash.value
        )
    return [len(hashed)], [same]


def _textbook(attitudes: Attitudes, dip: float) -> tuple[Array, Array]:
    """Gravity and field in tool axes, written out component by component, of strength 1; radians."""
    inclination, azimuth, toolface = attitudes
    si, ci, st, ct = np.sin(inclination), np.cos(inclination), np.sin(toolface), np.cos(toolface)
    sa, ca, north, down = np.sin(azimuth), np.cos(azimuth), np.cos(dip), np.sin(dip)
    g = np.stack([-si * st, -si * ct, ci], -1)
    x = north * (ci * ca * st + sa * ct) - down * si * st
    y = north * (ci * ca * ct - sa * st) - down * si * ct
    return g, np.stack([x, y, north * si * ca + down * ci], -1)


def _attitudes(count: int = 48) -> Attitudes:
    """Attitudes all over the sphere, radians, from golden ratios."""
    steps = np.arange(1, count + 1)
    inclination = np.arccos(1 - 2 * (steps - 0.5) / count)
    azimuth, toolface = (
        np.asarray(2 * np.pi * (steps * k % 1), float) for k in (0.618034, 0.414214)
    )
    return np.asarray(inclination), azimuth, toolface


def _angles() -> Both:
    """Angles from vectors, in degrees, against the angles of which the vectors were made."""
    attitudes, dip = _attitudes(), np.radians(63.0)
    g, b = _textbook(attitudes, float(dip))
    names = ("inclination", "azimuth", "toolface")
    computed = [OBSERVABLES[name].value(g, b) for name in names]
    expected = [*attitudes, np.full(len(g), dip)]
    return np.degrees(expected), np.degrees([*computed, OBSERVABLES["dip"].value(g, b)])


def _calibrated(triad: int) -> Both:
    """Corrected readings of a known tool without noise, in shares of gravity and field, at attitudes not in the fit."""
    rng, dip = np.random.default_rng(1), np.radians(63.0)
    matrix = np.eye(3) + 0.02 * rng.uniform(-1, 1, (2, 3, 3))
    offset = rng.uniform(-1, 1, (2, 3)) * np.array([[0.01], [300.0]])
    sizes = 1.0, 48_000.0

    def raw(attitudes: Attitudes) -> list[Array]:
        vectors = _textbook(attitudes, float(dip))
        return [
            v * s @ m.swapaxes(0, 1) + o
            for v, s, m, o in zip(vectors, sizes, matrix, offset, strict=True)
        ]

    first, second, third = (0.9 * angle for angle in _attitudes(24))
    fitted, other = _attitudes(), (first, second, third)
    inclination, azimuth, toolface = fitted
    a, m = raw(fitted)
    run = face.readings(
        a, m, inclination=inclination, azimuth=azimuth, toolface=toolface, field=sizes[1], dip=float(dip)
    )  # fmt: skip
    calibration = face.calibrate(run, order=0)
    computed = calibration.fields(face.readings(*raw(other)))
    return _textbook(other, float(dip))[triad], np.asarray(computed[triad]) / sizes[triad]


def _main_field() -> Both:
    """Strength and components north, east and down of the 100 places, nT."""
    expected, computed = [], []
    for year, altitude, latitude, longitude, *official in published("wmm2025")["rows"]:
        model = references.field_model("wmm2025", year)
        field = references.main_field(model, latitude, longitude, 1000 * altitude, year)
        dip, turn = np.radians(field.dip_deg), np.radians(field.declination_deg)
        level = field.field_nt * np.cos(dip)
        computed.append(
            [
                level * np.cos(turn),
                level * np.sin(turn),
                field.field_nt * np.sin(dip),
                field.field_nt,
            ]
        )
        expected.append(official)
    return expected, computed


def _normal_gravity() -> Both:
    figures = published("normal_gravity")
    return figures["gravity_ms2"], references.normal_gravity(figures["latitude_deg"], 0.0)


def _allan(kind: Literal["overlapping", "modified"]) -> Both:
    number, values = 1234567890, []
    for _ in range(1000):
        values.append(number / 2147483647)
        number = 16807 * number % 2147483647
    return published("nist_sp1065")[kind], allan.deviation(np.array(values), [1, 10, 100], kind)


def _student() -> Both:
    figures = published("student_t")
    return figures["factor"], student_factor(figures["degrees_of_freedom"])


def _within() -> Both:
    """One side at 0, 1, 2 and 3 standard uncertainties, two sides at 1, 2 and 3."""
    one = [probability_within(0.0, 1.0, limit, False) for limit in (0.0, 1.0, 2.0, 3.0)]
    two = [probability_within(0.0, 1.0, limit, True) for limit in (1.0, 2.0, 3.0)]
    return [0.5, 0.84134, 0.97725, 0.99865, 0.68269, 0.95450, 0.99730], [*one, *two]


def _arc() -> Both:
    """The end of a quarter circle of 1000 m from vertical to horizontal: north and depth are both its radius."""
    share = np.linspace(0, 1, 31)
    path = well_path(1000 * share, share * np.pi / 2, np.full(31, np.radians(30.0)))
    radius = 2000 / np.pi
    return [radius * np.cos(np.radians(30)), radius * np.sin(np.radians(30)), radius], path[-1]


def _position() -> Both:
    """Covariances of every term and their total at the end of the well, by the method of the published figures."""
    figures = published("iscwsa_well_3")
    md, inclination, azimuth = (
        np.asarray(figures["md_m"]),
        np.radians(figures["inclination_deg"]),
        np.radians(figures["azimuth_deg"]),
    )
    tvd, declination = (
        well_path(md, inclination, azimuth)[:, 2],
        np.radians(figures["declination_deg"]),
    )
    earth = figures["field_nt"], float(np.radians(figures["dip_deg"]))
    hole = Hole.along(md, tvd, inclination, azimuth, azimuth - declination, *earth)
    ours = {name: c[-1][[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]] for name, c in _terms(hole)}
    ours["TOTAL"] = np.sum(list(ours.values()), 0)
    names = sorted(figures["covariances"])
    return [figures["covariances"][name] for name in names], [ours[name] for name in names]


def _terms(hole: Hole) -> Iterator[tuple[str, Array]]:
    """Covariances (n, 3, 3) of each term by the balanced tangential method, the first station as the second."""
    model, path = load_error_model(), (hole.md, hole.inclination, hole.azimuth)
    for name, shift in model.shifts(hole, "lasting").items():
        shift[0, :2] = shift[1, :2]
        yield name, position_covariance(*path, shift[:, None], balanced=True)
    for name, shift in model.shifts(hole, "random").items():
        each, place = np.zeros((len(shift), len(shift) - 1, 3)), np.arange(1, len(shift))
        each[place, place - 1] = shift[1:]
        each[0, 0, :2] = shift[1, :2]
        yield name, position_covariance(*path, each, balanced=True)
    for name, shift in model.shifts(hole, "course").items():
        course = shift[:, :2, None] * shift[:, None, :2]
        yield name, position_covariance(*path, balanced=True, course=course)


def _signature() -> Both:
    """A published signature is that of its message, and not of another."""
    figures = published("ed25519")
    key, value, message = (
        bytes.fromhex(figures[name]) for name in ("public", "signature", "message")
    )
    trusted = public_key(key)
    return [1, 0], [trusted.verifies(value, message), trusted.verifies(value, message + b"\0")]


def cases() -> Sequence[SelftestCase]:
    """All cases, in the order of the work."""
    well = "ISCWSA, example well 3"
    formulas = "components of both vectors, written out"
    return (
        SelftestCase(
            "files as the wheel had them", "record of the wheel", "", 0.0, _installed_files
        ),
        SelftestCase("SHA-256", "FIPS 180-4", "", 0.0, _digest),
        SelftestCase("angles from vectors", formulas, "°", 1e-9, _angles),
        SelftestCase("accelerometer, known tool", formulas, "g", 1e-9, lambda: _calibrated(0)),
        SelftestCase(
            "magnetometer, known tool", formulas, "of the field", 1e-9, lambda: _calibrated(1)
        ),
        SelftestCase("probability within limits", "normal distribution, tables", "", 5e-6, _within),
        SelftestCase("coverage factors", published("student_t")["source"], "", 5e-3, _student),
        SelftestCase(
            "Allan deviation", "NIST SP 1065, 12.4", "", 5.1e-8, lambda: _allan("overlapping")
        ),
        SelftestCase(
            "modified Allan deviation", "NIST SP 1065, 12.4", "", 5.1e-8, lambda: _allan("modified")
        ),
        SelftestCase("normal gravity", "NIMA TR8350.2", "m/s²", 1e-9, _normal_gravity),
        SelftestCase("main field, WMM2025", "NOAA and BGS, test values", "nT", 1e-3, _main_field),
        SelftestCase("path of a circular arc", "closed form", "m", 1e-9, _arc),
        SelftestCase("position covariances", well, "m²", 5.1e-5, _position),
        SelftestCase("signature", "RFC 8032, test 3", "", 0.0, _signature),
    )
