"""Tools, stands and readings by a forward model of this file alone, and tables of how often intervals cover.

Readings are raw = SF(T) ((1 - m)⁻¹ field + B(T)), with SF and B polynomials of T - 30 °C. Frame: z downhole,
y the toolface scribe, x to the left of y looking downhole; angles in degrees, g and nT. NumPy alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

Array = np.ndarray
FIELD, DIP = 48_000.0, 63.0
DOCS = Path(__file__).resolve().parents[2] / "docs" / "evidence" / "coverage"


def axes(inclination: Array, azimuth: Array, toolface: Array) -> Array:
    """Rows x, y, z of the tool in north, east, down (..., 3, 3)."""
    i, a, t = (np.radians(v) for v in np.broadcast_arrays(inclination, azimuth, toolface))
    zero = np.zeros(i.shape)
    along = np.stack([np.sin(i) * np.cos(a), np.sin(i) * np.sin(a), np.cos(i)], -1)
    high = np.stack([np.cos(i) * np.cos(a), np.cos(i) * np.sin(a), -np.sin(i)], -1)
    right = np.stack([-np.sin(a), np.cos(a), zero], -1)
    scribe = np.cos(t)[..., None] * high + np.sin(t)[..., None] * right
    return np.stack([np.cross(scribe, along), scribe, along], -2)


def vectors(
    inclination: Array,
    azimuth: Array,
    toolface: Array,
    gravity: Array | float = 1.0,
    field: Array | float = FIELD,
    dip: Array | float = DIP,
) -> tuple[Array, Array]:
    """Gravity (g) and field (nT) along the axes of a tool (..., 3)."""
    turn, d = axes(inclination, azimuth, toolface), np.radians(dip)
    north = (
        np.stack(np.broadcast_arrays(np.cos(d), 0.0, np.sin(d)), -1) * np.asarray(field)[..., None]
    )
    down = np.asarray(gravity)[..., None] * np.array([0.0, 0.0, 1.0])
    return np.einsum("...ij,...j->...i", turn, down), np.einsum("...ij,...j->...i", turn, north)


def angles(g: Array, b: Array) -> dict[str, Array]:
    """Inclination, azimuth, toolface, dip (degrees) and strengths of vectors (..., 3), by cross products."""
    strength = np.linalg.norm(g, axis=-1)
    down = g / strength[..., None]
    east = np.cross(down, b)
    east = east / np.linalg.norm(east, axis=-1, keepdims=True)
    north = np.cross(east, down)
    along = np.sum(b * down, -1)
    return {
        "inclination": np.degrees(np.arctan2(np.hypot(g[..., 0], g[..., 1]), g[..., 2])),
        "azimuth": np.degrees(np.arctan2(east[..., 2], north[..., 2])) % 360,
        "toolface": np.degrees(np.arctan2(-g[..., 0], -g[..., 1])) % 360,
        "dip": np.degrees(np.arctan2(along, np.sum(b * north, -1))),
        "gravity": strength,
        "field": np.linalg.norm(b, axis=-1),
    }


def turned(difference: Array) -> Array:
    """A difference of angles in -180° … 180°."""
    return (np.asarray(difference) + 180.0) % 360.0 - 180.0


@dataclass(frozen=True)
class Triad:
    """Sensors of one triad: scales and biases (3, k) by power of T - 30 °C, and cross-axis terms m (3, 3)."""

    scale: Array
    bias: Array
    cross: Array

    @classmethod
    def drawn(
        cls, rng: np.random.Generator, strength: float = 1.0, order: int = 0, bias: float = 0.01
    ) -> Triad:
        """A triad with scales within 3 %, cross-axis terms within 3 mrad and drifts of a servo tool."""
        powers = np.array([1.0, 8e-3, 5e-5])[:order]
        scale = np.concatenate(
            [1 + 0.03 * rng.uniform(-1, 1, (3, 1)), 2e-4 * powers * rng.uniform(-1, 1, (3, order))],
            1,
        )
        offset = [bias * rng.uniform(-1, 1, (3, 1)), 1e-4 * powers * rng.uniform(-1, 1, (3, order))]
        cross = 3e-3 * rng.uniform(-1, 1, (3, 3)) * (1 - np.eye(3))
        return cls(scale, strength * np.concatenate(offset, 1), cross)

    def raw(self, field: Array, temperature: Array | float = 30.0) -> Array:
        """Noise-free readings (..., 3) of a field (..., 3) at temperatures (...)."""
        cold = np.asarray(temperature)[..., None] - 30.0
        power = cold ** np.arange(self.scale.shape[1])
        seen = field @ np.linalg.inv(np.eye(3) - self.cross).T
        return (power @ self.scale.T) * (seen + power @ self.bias.T)


def tool(rng: np.random.Generator, order: int = 0) -> tuple[Triad, Triad]:
    """Accelerometer (raw in g) and magnetometer (raw in nT) of one tool."""
    return Triad.drawn(rng, 1.0, order), Triad.drawn(rng, FIELD, order)


def grid(
    inclinations: Sequence[float] = (5, 45, 90, 135),
    toolfaces: int = 12,
    azimuths: Sequence[float] = (0, 90, 180, 270),
) -> tuple[Array, Array, Array]:
    """Attitudes of roll sets: one direction for each inclination, turned through so many toolfaces."""
    inclination = np.repeat(np.asarray(inclinations, float), toolfaces)
    azimuth = np.repeat(np.resize(azimuths, len(inclinations)).astype(float), toolfaces)
    return (
        inclination,
        azimuth,
        np.tile(np.arange(toolfaces) * 360.0 / toolfaces, len(inclinations)),
    )


def covered(errors: Array, sd: Array, factor: Array | float = 1.96) -> float:
    """Share of errors within so many stated standard uncertainties; those without one do not count."""
    known = np.isfinite(errors) & np.isfinite(sd) & (sd > 0)
    return float(np.mean(np.abs(errors[known]) <= (np.asarray(factor) * sd)[known]))


def table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    return "\n".join([*lines, *("| " + " | ".join(map(str, row)) + " |" for row in rows)]) + "\n"


def percent(share: float) -> str:
    """A share as a percentage with one decimal."""
    return f"{100 * share:.1f} %"


def write(
    name: str,
    title: str,
    *parts: str,
    facts: Mapping[str, object] | None = None,
    simulated: bool = True,
) -> None:
    """Write one page of the study into the documentation; `facts` head it: number of runs, seed."""
    said = "".join(f"{key}: {value}. " for key, value in (facts or {}).items())
    data = "All data are simulated. " if simulated else ""
    note = f"Written by `examples/coverage/{name}.py`. {data}{said}".strip()
    DOCS.mkdir(exist_ok=True)
    (DOCS / f"{name}.md").write_text(f"# {title}\n\n{note}\n\n" + "\n".join(parts), "utf-8")
