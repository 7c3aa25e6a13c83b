"""Terms of the industry's error models: what they do to a survey, and how large they are for a calibrated tool.

An error model states a tool's sensors by a bias and a scale error of each axis: AB and AS of the accelerometers,
MB and MS of the magnetometers. The two axes across the tool are taken together, independently of toolface ("TI").
"""

from __future__ import annotations

import json
import os
import uuid
from collections.abc import Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np

from mwdcal.calibration.record import FREE_SHARE, SOFTWARE, Calibration, stated
from mwdcal.calibration.results import CORNERS, CalibratedTools
from mwdcal.errors import FitError
from mwdcal.files.formats import atomic
from mwdcal.geometry.units import STANDARD_GRAVITY
from mwdcal.geometry.vectors import Array, ArrayLike, reference_vectors
from mwdcal.survey.acceptance import SensorTerms, load_survey_limits
from mwdcal.survey.path import direction_gradient


class TermKind(NamedTuple):
    """A sensor term of every axis: its triad, whether of scale, its unit, and its name in `SensorTerms`."""

    triad: int
    scale: bool
    unit: str
    generic: str


SENSOR_KINDS = {
    "AB": TermKind(0, False, "m/s2", "accelerometer_bias_ms2"),
    "AS": TermKind(0, True, "-", "accelerometer_scale"),
    "MB": TermKind(1, False, "nT", "magnetometer_bias_nt"),
    "MS": TermKind(1, True, "-", "magnetometer_scale"),
}
FORMULAS: dict[str, tuple[str, ...]] = {
    "ABXY-TI1S": ("-Cos(Inc) / Gfield", "Tan(Dip) * Cos(Inc) * Sin(AzM) / Gfield"),
    "ABXY-TI2S": (
        "0", "(Tan(pi / 2 - Inc) - Tan(Dip) * Cos(AzM)) / Gfield",
        "-Sin(AzT) / Gfield", "Cos(AzT) / Gfield",
    ),
    "ABZ": ("-Sin(Inc) / Gfield", "Tan(Dip) * Sin(Inc) * Sin(AzM) / Gfield"),
    "ASXY-TI1S": ("Sin(Inc) * Cos(Inc) / Sqr(2)", "-Tan(Dip) * Sin(Inc) * Cos(Inc) * Sin(AzM) / Sqr(2)"),
    "ASXY-TI2S": ("Sin(Inc) * Cos(Inc) / 2", "-Tan(Dip) * Sin(Inc) * Cos(Inc) * Sin(AzM) / 2"),
    "ASXY-TI3S": ("0", "(Tan(Dip) * Sin(Inc) * Cos(AzM) - Cos(Inc)) / 2"),
    "ASZ": ("-Sin(Inc) * Cos(Inc)", "Tan(Dip) * Sin(Inc) * Cos(Inc) * Sin(AzM)"),
    "MBXY-TI1S": ("0", "-Cos(Inc) * Sin(AzM) / (BField * Cos(Dip))"),
    "MBXY-TI2S": ("0", "Cos(AzM) / (BField * Cos(Dip))"),
    "MBZ": ("0", "-Sin(Inc) * Sin(AzM) / (BField * Cos(Dip))"),
    "MSXY-TI1S": ("0", "Sin(Inc) * Sin(AzM) * (Tan(Dip) * Cos(Inc) + Sin(Inc) * Cos(AzM)) / Sqr(2)"),
    "MSXY-TI2S": (
        "0", "Sin(AzM) * (Tan(Dip) * Sin(Inc) * Cos(Inc) - Cos(Inc) * Cos(Inc) * Cos(AzM) - Cos(AzM)) / 2",
    ),
    "MSXY-TI3S": (
        "0", "(Cos(Inc) * (Cos(AzM) * Cos(AzM) - Sin(AzM) * Sin(AzM)) - Tan(Dip) * Sin(Inc) * Cos(AzM)) / 2",
    ),
    "MSZ": ("0", "-(Sin(Inc) * Cos(AzM) + Tan(Dip) * Cos(Inc)) * Sin(Inc) * Sin(AzM)"),
}  # fmt: skip
"""Error of inclination and of azimuth by one unit of a term, as tool models write it; the shifts north and east
at vertical, where one is infinite. `term_shifts` has the same from the geometry.
Reference: SPE 67616; ISCWSA MWD Rev 5."""


_ACROSS_AZIMUTH = "(Cos(Inc) * Sin(AzM) * {a} {sign} Cos(AzM) * {b})"
"""Part of the azimuth's error by a sensor across the tool, whose direction is {a} upward and {b} sideways."""


def formulas_at(toolface: float) -> dict[str, tuple[str, ...]]:
    """The same as `FORMULAS` for every axis of a tool that stays at one gravity toolface, rad: nothing is averaged.

    Reference: SPE 67616, table 1.
    """
    sine, cosine = (f"({v:.12g})" for v in np.round([np.sin(toolface), np.cos(toolface)], 15) + 0.0)
    result: dict[str, tuple[str, ...]] = {}
    for axis, a, b, sign, back in (("X", sine, cosine, "-", "+"), ("Y", cosine, sine, "+", "-")):
        across = _ACROSS_AZIMUTH.format(a=a, b=b, sign=sign)
        level = f"(Cos(AzM) * {b} {sign} Cos(Inc) * Sin(AzM) * {a})"
        start = "" if axis == "X" else "-"
        north = f"-({a} * Cos(AzT) {back} {b} * Sin(AzT)) / Gfield"
        east = f"({back}{b} * Cos(AzT) - {a} * Sin(AzT)) / Gfield"
        result |= {
            f"AB{axis}": (
                f"-Cos(Inc) * {a} / Gfield",
                f"({across} * Tan(Dip) {back} {b} * Tan(pi / 2 - Inc)) / Gfield", north, east,
            ),
            f"AS{axis}": (
                f"Cos(Inc) * Sin(Inc) * {a} * {a}",
                f"-(Tan(Dip) * Sin(Inc) * {across} {back} Cos(Inc) * {b}) * {a}",
            ),
            f"MB{axis}": ("0", f"{start}{level} / (BField * Cos(Dip))"),
            f"MS{axis}": (
                "0",
                f"{start}(Cos(Inc) * Cos(AzM) * {a} - Tan(Dip) * Sin(Inc) * {a} {back} Sin(AzM) * {b}) * {level}",
            ),
        }  # fmt: skip
    return {**result, **{name: texts for name, texts in FORMULAS.items() if name.endswith("Z")}}


class SensorTerm(msgspec.Struct, frozen=True, kw_only=True):
    """1σ of one sensor term of a calibrated tool, and its ratio to that of the OWSG model; None: undetermined.

    Of an axis ("ABX"), or of both axes across the tool ("ABXY"), as error models use it: root mean square.
    """

    name: str
    unit: str
    value: float | None
    owsg: float
    ratio: float | None


def term_shifts(
    inclination: ArrayLike,
    azimuth: ArrayLike,
    field: ArrayLike,
    dip: ArrayLike,
    gravity: ArrayLike = STANDARD_GRAVITY,
) -> dict[str, Array]:
    """Shifts (…, 2) of the hole's direction, upward and sideways, by one unit of each sensor term.

    Definition: with c the shifts by a change of each component at toolface zero, and v the components there, biases
    across the tool shift by c_y (TI1) and c_x (TI2); scale errors, averaged over toolface, by
    (v_y c_y + v_x c_x)/√2, (v_y c_y - v_x c_x)/2 and (v_y c_x + v_x c_y)/2.
    Units: rad per m/s², nT or 1; `field` nT, `gravity` m/s², `azimuth` magnetic. Singular: finite at vertical.
    Reference: SPE 67616; the terms of ISCWSA MWD Rev 5.
    """
    vectors = reference_vectors(inclination, azimuth, 0.0, gravity, field, dip)
    _, gradient = direction_gradient(*vectors)
    result: dict[str, Array] = {}
    for kind, (triad, scale, *_) in SENSOR_KINDS.items():
        x, y, z = (gradient[..., 3 * triad + axis] for axis in range(3))
        vx, vy, vz = (vectors[triad][..., axis, None] for axis in range(3))
        across = [y, x]
        if scale:
            across = [(vy * y + vx * x) / np.sqrt(2), (vy * y - vx * x) / 2, (vy * x + vx * y) / 2]
            z = vz * z
        result |= {f"{kind}XY-TI{n}S": each for n, each in enumerate(across, 1)}
        result[f"{kind}Z"] = z
    return result


def sensor_terms(calibration: Calibration, temperature: float | None = None) -> list[SensorTerm]:
    """Sensor terms of a calibrated tool: X, Y, both together and Z of AB, AS, MB and MS.

    Definition: an error of the calibration is a bias of every axis and a 3 × 3 matrix times the field. The scale
    term of an axis is the root sum of squares of its row: misalignment has no term, and over all directions of the
    field adds as much. A turn of both triads about the tool axis moves no hole and is left out.
    At `temperature`, °C, by default `prediction.middle_temperature`. None: undetermined, without a magnetometer, and
    MB without a known field. Correlations between terms are lost.
    """
    sd = _axis_sds(calibration, temperature)
    generic: SensorTerms = load_survey_limits()[0].sensor
    terms = []
    for kind, (triad, scale, unit, name) in SENSOR_KINDS.items():
        x, y, z = sd[triad, int(scale)].tolist()
        usual = getattr(generic, name)
        for axes, value in {"X": x, "Y": y, "XY": np.hypot(x, y) / np.sqrt(2), "Z": z}.items():
            each = stated(value), stated(value / usual)
            terms.append(
                SensorTerm(name=kind + axes, unit=unit, value=each[0], owsg=usual, ratio=each[1])
            )
    return terms


def _axis_sds(calibration: Calibration, temperature: float | None) -> Array:
    """1σ (2, 2, 3) of bias, m/s² and nT, and scale of every axis of both triads; NaN: undetermined."""
    rows = _rows(calibration, temperature)
    variance = np.einsum("taqi,ij,taqj->qta", rows, calibration.parameter_covariance, rows)
    moved = np.abs(np.einsum("taqi,ki->kqta", rows, calibration.free_directions))
    variance = np.where(moved.max(0, initial=0.0) > FREE_SHARE, np.nan, variance)
    field = np.nan if calibration.relative else calibration.earth.get("field", np.nan)
    strength = np.array([[STANDARD_GRAVITY * calibration.earth["gravity_g"]], [field]])[: len(rows)]
    result = np.full((2, 2, 3), np.nan)
    result[: len(rows), 0] = np.sqrt(variance[0]) * strength
    result[: len(rows), 1] = np.sqrt(variance[1:].sum(0))
    return result


def _rows(calibration: Calibration, temperature: float | None) -> Array:
    """Changes (t, 3, 4, p) of each axis by the parameters: bias and three factors of the field's components.

    In units of the strength of the field. Without the turn of both triads about the tool axis.
    """
    tools = CalibratedTools.of(calibration, temperature)
    strengths = tools.earth[0, : len(tools.models)]
    change = tools.changes([s * CORNERS[None] for s in strengths], False)[0]
    change = change / strengths[:, None, None, None]
    rows = np.concatenate([change[:, :1], change[:, 1:] - change[:, :1]], 1).swapaxes(1, 2)
    turn = (rows[0, 1, 1] - rows[0, 0, 2]) / 2
    rows[:, 1, 1] -= turn
    rows[:, 0, 2] += turn
    return rows


def tool_model(
    terms: Sequence[SensorTerm], name: str, source: str, date: str = "", simulated: bool = False,
    toolface: float | None = None,
) -> dict[str, Any]:  # fmt: skip
    """The terms as a tool model in ISCWSA's JSON form, which welleng takes as an `error_model`.

    Of sensors alone: errors of depth, alignment, reference and interference are not the calibration's. `date`: as the
    calibration states its time. `toolface`, rad, of a tool that does not turn: terms of each axis at it, where they are
    averaged over toolface otherwise.

    Raises:
        FitError: a term is undetermined.
    """
    formulas = FORMULAS if toolface is None else formulas_at(toolface)
    values = {term.name: term for term in terms}
    exported = {each: values[each.partition("-")[0]] for each in formulas}
    lacking = sorted({term.name for term in exported.values() if term.value is None})
    if lacking:
        raise FitError(
            f"the calibration leaves {', '.join(lacking)} undetermined, and a tool model needs every sensor term. "
            "Calibrate both triads with references for inclination, azimuth and field."
        )
    tags = ["calibration", *(["simulated"] if simulated else [])]
    space = uuid.uuid5(uuid.NAMESPACE_URL, f"mwdcal:{name}:{source}:{date}")
    metadata = {
        "schema_uuid": str(uuid.UUID(int=0)),
        "model_uuid": str(space),
        "model_id": name,
        "short_name": name,
        "long_name": f"{name}, sensors as calibrated",
        "revision_number": 5,
        "revision_date": date[:10],
        "revision_comment": "1 sigma of each sensor term from the covariance of a calibration.",
        "source": source,
        "application": "Sensor terms alone: add depth, alignment, reference and interference."
        + (
            "" if toolface is None else f" Of a tool at gravity toolface {np.degrees(toolface):g}°."
        ),
        "tool_type": "Magnetic",
        "author": SOFTWARE,
        "framework": "ISCWSA Rev5",
        "tags": tags,
    }
    rows = [_row(space, each, term, formulas[each]) for each, term in exported.items()]
    return {
        "$schema": "https://github.com/iscwsa/error-models/blob/main/schemas/draft.json",
        "metadata": metadata,
        "parameters": {"inc_min": 0, "inc_max": 180},
        "terms": rows,
        "hash_function": "none",
        "hash_value": "none",
    }


def _row(
    space: uuid.UUID, name: str, term: SensorTerm, formulas: tuple[str, ...]
) -> dict[str, Any]:
    inclination, azimuth, *vertical = formulas
    north, east = vertical or (None, None)
    return {
        "uuid": str(uuid.uuid5(space, name)),
        "name": name,
        "value": term.value,
        "units": term.unit,
        **{"depth_factor": 0, "inclination_factor": 1, "azimuth_factor": 1},
        "propagation_mode": "Systematic",
        "depth_formula": "0",
        "inclination_formula": inclination,
        "azimuth_formula": azimuth,
        "north_singularity": north,
        "east_singularity": east,
        "vertical_singularity": None,
        "hash_value": "none",
    }


def tool_model_text(
    calibration: Calibration, name: str = "", temperature: float | None = None, toolface: float | None = None
) -> str:  # fmt: skip
    """The tool model of a calibrated tool as JSON; `name`: by default the tool's. `toolface` as of `tool_model`.

    Raises:
        FitError: a term is undetermined.
    """
    tool = name or " ".join(filter(None, ("mwdcal", calibration.tool.get("serial"))))
    terms = sensor_terms(calibration, temperature)
    source = f"calibration of {calibration.run_name}, SHA-256 {calibration.run_sha256}"
    model = tool_model(terms, tool, source, calibration.time, calibration.simulated, toolface)
    return json.dumps(model, indent=1) + "\n"


def write_tool_model(
    path: str | os.PathLike[str],
    calibration: Calibration,
    name: str = "",
    temperature: float | None = None,
) -> None:
    """Write `tool_model_text`, whole or not at all."""
    atomic.write(path, tool_model_text(calibration, name, temperature))
