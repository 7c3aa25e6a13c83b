"""Words, document and page on the results of tasks that are records of their own: what their commands print.

They are put here on the classes, as `use.plots` puts figures there, so that a record needs no screen.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from html import escape
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
from msgspec import UNSET

from mwdcal.calibration.readings import Readings
from mwdcal.calibration.record import Calibration, html_table
from mwdcal.comparison.compare import Comparison
from mwdcal.digests import sha256_of
from mwdcal.errors import InputError
from mwdcal.faults.diagnosis import Diagnosis
from mwdcal.files import documents, runs
from mwdcal.files.formats import atomic
from mwdcal.geometry.vectors import AnyArray
from mwdcal.library.results import arrays_of, brief, frame
from mwdcal.logs.noise import Noise
from mwdcal.logs.stations import Stations
from mwdcal.presentation.text import to_json
from mwdcal.sensor.profile import NOMINAL
from mwdcal.use.correction import tallied
from mwdcal.use.verification import Verdict, VerdictRow

_Shown = TypeVar("_Shown")
_INPUTS = "_inputs"


class Inputs(NamedTuple):
    """The inputs of a result: what inputs say of themselves, and the SHA-256 of those that are files."""

    metadata: tuple[Mapping[str, object], ...] = ()
    digests: Mapping[str, str] = {}
    calibration: Calibration | None = None
    test: Readings | None = None


def with_inputs(
    result: _Shown,
    *metadata: Mapping[str, object],
    of: Calibration | None = None,
    test: Readings | None = None,
    **digests: str,
) -> _Shown:
    """A result that knows its inputs, the calibration and the roll test that it shows; equal to the one without."""
    result.__dict__[_INPUTS] = Inputs(metadata, digests, of, test)
    return result


def digest_of(calibration: Calibration) -> str:
    """The SHA-256 of a calibration's file, as it is or would be written."""
    return sha256_of(documents.encode(calibration))


def _inputs(result: Any) -> Inputs:
    inputs: Inputs = getattr(result, _INPUTS, Inputs())
    return inputs


def _enveloped(command: str, result: Any, content: object) -> dict[str, Any]:
    from mwdcal.presentation.envelope import json_document

    metadata, digests, *_ = _inputs(result)
    return json_document(command, content, *metadata, **digests)


def _calibration_text(calibration: Calibration) -> str:
    from mwdcal.presentation.calibration import body

    return body(calibration, [])


def _calibration_document(calibration: Calibration) -> dict[str, Any]:
    from mwdcal.presentation.calibration import summary

    return summary(calibration, [], None, None)


def _calibration_page(calibration: Calibration) -> str:
    from mwdcal.presentation.calibration_page import render

    return render(calibration)


def _verdict_text(verdict: Verdict) -> str:
    from mwdcal.presentation.verification import screen

    return screen(verdict, None, *_inputs(verdict).metadata)


def _verdict_document(verdict: Verdict) -> dict[str, Any]:
    return _enveloped("verify", verdict, verdict)


def _verdict_page(verdict: Verdict) -> str:
    from mwdcal.presentation.calibration_page import render

    metadata, _, calibration, _ = _inputs(verdict)
    if calibration is None:
        raise InputError(
            "a verdict read from a file has no page. Verify again by mwdcal.verify(…)."
        )
    return render(calibration, verdict, *metadata)


def _verdict_columns(verdict: Verdict) -> dict[str, AnyArray]:
    """The stations of the roll test, corrected by the calibration, with 1σ, by the names of `apply`."""
    *_, calibration, test = _inputs(verdict)
    if calibration is None or test is None:
        raise InputError(
            "a verdict read from a file has no columns. Verify again by mwdcal.verify(…)."
        )
    corrected, _ = tallied(calibration, test, "blank", uncertainty=True)
    return {**stations_of(test), **corrected}


def stations_of(readings: Readings) -> dict[str, AnyArray]:
    """Labels and temperatures of the rows of one run, where it has them."""
    if readings.accelerometer.ndim != 2:
        return {}
    labels = {"station": np.array(readings.station)} if readings.station else {}
    warmth = readings.temperature
    return labels | ({} if warmth is None else {"temperature_c": np.asarray(warmth, float)})


def _diagnosis_text(diagnosis: Diagnosis) -> str:
    from mwdcal.presentation.diagnosis import screen

    return screen(diagnosis, *_inputs(diagnosis).metadata)


def _diagnosis_document(diagnosis: Diagnosis) -> dict[str, Any]:
    return _enveloped("diagnose", diagnosis, diagnosis)


def _diagnosis_page(diagnosis: Diagnosis) -> str:
    from mwdcal.presentation.diagnosis import render

    metadata, digests, *_ = _inputs(diagnosis)
    return render(diagnosis, digests, *metadata)


def _comparison_text(comparison: Comparison) -> str:
    from mwdcal.presentation.comparison import text

    return text(comparison)


def _comparison_document(comparison: Comparison) -> dict[str, Any]:
    from mwdcal.presentation.comparison import document

    return _enveloped("compare", comparison, document(comparison, [], None))


def _comparison_page(comparison: Comparison) -> str:
    from mwdcal.presentation.comparison import render

    return render(comparison)


def _noise_text(noise: Noise) -> str:
    from mwdcal.presentation.noise import screen

    return screen(noise, None, None)


def _noise_document(noise: Noise) -> dict[str, Any]:
    from mwdcal.presentation.noise import document

    return _enveloped("noise", noise, document(noise, None, None))


def _noise_page(noise: Noise) -> str:
    from mwdcal.presentation.noise import render

    return render(noise)


def _stations_text(stations: Stations) -> str:
    from mwdcal.presentation.stations import body

    return body(stations)


def _stations_document(stations: Stations) -> dict[str, Any]:
    from mwdcal.presentation.stations import summary

    return _enveloped(
        "stations", stations, summary(stations, dict.fromkeys(("output", "plot", "report"), ""))
    )


def _stations_page(stations: Stations) -> str:
    from mwdcal.presentation.stations import render

    return render(stations, _inputs(stations).digests.get("log", ""))


def _columns(readings: Readings) -> Mapping[str, AnyArray]:
    """All columns of the table that was read; of readings made otherwise those of a run file."""
    if readings.table:
        return readings.table
    table = runs.from_readings(readings, readings.profile or NOMINAL)
    return {**arrays_of(table), **readings.others}


def _to_pandas(readings: Readings) -> Any:
    """The columns as a table of pandas, with the metadata in `attrs`."""
    return frame(readings.columns, readings.metadata)


def _limit_columns(verdict: Verdict) -> dict[str, AnyArray]:
    """A row for each limit, as narrow as a screen, with U, the expanded uncertainty (95 %); NaN: not stated."""
    from mwdcal.certificate.decisions import expanded_of

    rows = verdict.rows
    return {
        "name": np.array([row.name for row in rows]),
        "raw": np.array([row.raw for row in rows], float),
        "value": np.array([row.value for row in rows], float),
        "U": np.array([expanded_of(row) for row in rows], float),
        "limit": np.array([row.limit for row in rows]),
        "unit": np.array([row.unit for row in rows]),
        "verdict": np.array(["pass" if row.passed else "FAIL" for row in rows]),
    }


def _limits_stated(verdict: Verdict) -> dict[str, dict[str, object]]:
    """The rest of each limit, by name of the limit: 1σ, its degrees of freedom, and the set and curve judged."""
    return {
        "sd": {row.name: row.uncertainty for row in verdict.rows},
        "degrees_of_freedom": {row.name: _freedom(row) for row in verdict.rows},
        "where": {row.name: row.note for row in verdict.rows},
    }


def _freedom(row: VerdictRow) -> float:
    """Degrees of freedom of the uncertainty of a limit: infinite where the noise is declared; NaN: not stated."""
    if row.uncertainty is None or row.degrees_of_freedom is UNSET:
        return np.nan
    return np.inf if row.freedom is None else row.freedom


def _verdict_to_pandas(verdict: Verdict, rows: Literal["stations", "limits"] = "stations") -> Any:
    """The corrected stations, or a row for each limit, as a table of pandas, which must be installed."""
    tables = {"stations": _verdict_columns, "limits": _limit_columns}
    if rows not in tables:
        raise InputError(f"`rows` must be {' or '.join(tables)}; got {rows!r}. Correct it.")
    return frame(tables[rows](verdict), _limits_stated(verdict) if rows == "limits" else None)


@dataclass(frozen=True)
class VerdictFile:
    """A verdict as the file that `verify` writes of it."""

    verdict: Verdict

    @property
    def serial(self) -> str | None:
        """The serial of the tool."""
        serial: str | None = _verdict_document(self.verdict)["serial"]
        return serial

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the document."""
        atomic.write(path, to_json(_verdict_document(self.verdict)) + "\n")


def _show(
    kind: type,
    text: Callable[[Any], str],
    document: Callable[[Any], dict[str, Any]],
    page: Callable[[Any], str],
) -> None:
    """Put `summary`, `to_dict`, `report` and a short `repr` on a class."""

    def summary(self: object) -> str:
        """The text that the command prints."""
        return text(self)

    def to_dict(self: object) -> dict[str, Any]:
        """The command's JSON as a dictionary."""
        return document(self)

    def report(self: object, path: str | os.PathLike[str]) -> None:
        """Write the page of the command: self-contained HTML."""
        atomic.write(os.fspath(path), page(self))

    def short(self: object) -> str:
        return brief(self, lambda: text(self))

    def html(self: object) -> str:
        return f"<pre>{escape(text(self))}</pre>"

    methods: dict[str, Callable[..., object]] = {
        "summary": summary, "to_dict": to_dict, "report": report,
    }  # fmt: skip
    methods |= {} if "_repr_html_" in vars(kind) else {"__repr__": short, "_repr_html_": html}
    for name, method in methods.items():
        setattr(kind, name, method)


def _readings_html(readings: Readings) -> str:
    """The readings at a glance."""
    words = repr(readings).strip("<>").removeprefix("Readings: ")
    return html_table("Readings", [(words,)])


Readings._repr_html_ = _readings_html  # type: ignore[attr-defined]
Readings.columns = property(_columns)  # type: ignore[assignment]
Readings.to_pandas = _to_pandas  # type: ignore[attr-defined]
Verdict.columns = property(_verdict_columns)  # type: ignore[assignment]
Verdict.to_pandas = _verdict_to_pandas
_show(Calibration, _calibration_text, _calibration_document, _calibration_page)
_show(Verdict, _verdict_text, _verdict_document, _verdict_page)
_show(Diagnosis, _diagnosis_text, _diagnosis_document, _diagnosis_page)
_show(Comparison, _comparison_text, _comparison_document, _comparison_page)
_show(Noise, _noise_text, _noise_document, _noise_page)
_show(Stations, _stations_text, _stations_document, _stations_page)
