"""Drawings of the bench in plain SVG: the tool's angles, stations on the unit sphere, the accuracy as it shrinks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from markupsafe import Markup

from mwdcal.bench.positions import ORDERED_ANGLES, Positions
from mwdcal.geometry.vectors import Array, reference_vectors, tool_from_earth
from mwdcal.presentation.numbers import number

FULL = {"inclination": 180, "toolface": 360, "azimuth": 360}
VIEW = 0.7
"""How steeply the sphere is looked at, radians."""
NORTH = (0.45, -0.35)
"""Where north points in the drawing of the tool: to the right, and back."""

LEFT, RIGHT, TOP, BOTTOM = 48.0, 300.0, 10.0, 150.0
"""The frame of the course."""


def dial(name: str, goal_deg: float) -> Markup:
    """A dial with the ordered angle as a broad mark; the needle is turned by the live figures."""
    half = FULL[name] == 180
    box = "-30 -55 110 110" if half else "-55 -55 110 110"
    rim = "M0,-50 A50,50 0 0 1 0,50" if half else "M0,-50 A50,50 0 1 1 -0.01,-50"
    marks = "".join(
        f'<line class="axis" y1="-50" y2="-44" transform="rotate({angle})"/>'
        for angle in range(0, FULL[name] + 1, 30)
    )
    turned = 180 - goal_deg if half else goal_deg
    return Markup(
        f'<svg viewBox="{box}" aria-hidden="true"><path class="axis" d="{rim}"/>{marks}'
        f'<line class="goal" y1="-28" y2="-50" transform="rotate({turned:.2f})"/>'
        f'<line class="needle" y2="-40" data-turn="{name}" transform="rotate({turned:.2f})"/></svg>'
    )


def attitude(angles_deg: tuple[float, float, float], label: str) -> Markup:
    """The tool as it should lie, on the axes north, east and down."""
    inclination, azimuth, toolface = np.radians(angles_deg)
    earth_axes = np.asarray(tool_from_earth(inclination, azimuth, toolface))
    _, high, along = (_projected(axis) for axis in earth_axes)
    (x, y), (u, v) = 85 * along, 26 * high
    axes = "".join(
        f'<line class="axis" x2="{a:.1f}" y2="{b:.1f}"/><text x="{1.13 * a:.1f}" y="{1.13 * b + 4:.1f}">{name}</text>'
        for name, axis in zip("NE", np.eye(3), strict=False)
        for a, b in [70 * _projected(axis)]
    )
    return Markup(
        f'<svg viewBox="-120 -110 240 220" width="240" role="img" aria-label="{label}">{axes}'
        f'<line class="axis" y1="-100" y2="100"/>'
        f'<line class="body" x1="{-x:.1f}" y1="{-y:.1f}" x2="{x:.1f}" y2="{y:.1f}"/>'
        f'<line class="side" x1="{0.3 * x:.1f}" y1="{0.3 * y:.1f}" x2="{0.3 * x + u:.1f}" y2="{0.3 * y + v:.1f}"/>'
        f'<circle class="head-end" cx="{x:.1f}" cy="{y:.1f}" r="9"/></svg>'
    )


def _projected(axis: Array) -> Array:
    """A direction north, east, down on the drawing: to the right, and down."""
    north, east, down = axis
    return np.array([east + NORTH[0] * north, down + NORTH[1] * north])


def sphere(part: Positions, order: int | None, bad: Sequence[int], label: str) -> Markup:
    """Directions of gravity in the tool at all positions: measured, next, not fitting, still to come.

    Above the tool's end that looks downhole; what lies behind is pale. The marks differ in shape, not in colour alone.
    """
    inclination, azimuth, toolface = np.radians([part.attitude(i) for i in range(part.count)]).T
    g, _ = reference_vectors(inclination, azimuth, toolface)
    x, y, z = g.T
    across, up = x, z * np.cos(VIEW) + y * np.sin(VIEW)
    front = y * np.cos(VIEW) - z * np.sin(VIEW) <= 0
    done = part.done
    marks = {"left": "", "done": "", "bad": "", "next": ""}
    for i, (u, v) in enumerate(zip(100 * across, -100 * up, strict=True)):
        side = "" if front[i] else " behind"
        kind = "done" if i in done else "left"
        marks[kind] += f'<circle class="{kind}mark{side}" cx="{u:.1f}" cy="{v:.1f}" r="4"/>'
        if i in bad:
            marks["bad"] += (
                f'<path class="badmark" d="M{u - 8:.1f},{v - 8:.1f} l16,16 m0,-16 l-16,16"/>'
            )
        if i == order:
            marks["next"] = (
                f'<rect class="nextmark" x="{u - 9:.1f}" y="{v - 9:.1f}" width="18" height="18"/>'
            )
    ring = f'<ellipse class="axis" rx="100" ry="{100 * np.sin(VIEW):.1f}"/>'
    return Markup(
        f'<svg viewBox="-110 -110 220 220" width="260" role="img" aria-label="{label}">'
        f'<circle class="axis" r="100"/>{ring}{"".join(marks.values())}</svg>'
    )


def course(
    points: Sequence[tuple[int, Mapping[str, float | None]]], expected: Mapping[str, float | None],
    count: int, names: Mapping[str, str], label: str,
) -> Markup:  # fmt: skip
    """1σ of the three angles over the number of stations, in logarithm; circles are what the whole plan will give."""
    values = [v for row in (*(row for _, row in points), expected) for v in row.values() if v]
    if not values:
        return Markup("")
    low, high = np.log10(min(values)) - 0.1, np.log10(max(values)) + 0.1

    def place(stations: float, value: float) -> tuple[float, float]:
        across = LEFT + (RIGHT - LEFT) * min(stations / max(count, 1), 1.0)
        return across, float(TOP + (BOTTOM - TOP) * (high - np.log10(value)) / (high - low))

    steps = (10.0**power * m for power in range(-5, 3) for m in (1, 3))
    parts = []
    for value in steps:
        if low <= np.log10(value) <= high:
            _, y = place(0, value)
            parts.append(
                f'<line class="axis" x1="{LEFT}" x2="{RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
                f'<text x="{LEFT - 5}" y="{y + 4:.1f}" text-anchor="end">{number(value)}°</text>'
            )
    heights: list[float] = []
    for index, name in enumerate(ORDERED_ANGLES):
        line = [
            place(n, v) for n, row in sorted(points, key=lambda p: p[0]) if (v := row.get(name))
        ]
        ring = [place(count, v)] if (v := expected.get(name)) else []
        parts.append(_curve(index, names[name], line, ring, heights))
    ends = ((LEFT, 0), (RIGHT, count))
    parts += [f'<text x="{x}" y="{BOTTOM + 15}" text-anchor="middle">{n}</text>' for x, n in ends]
    return Markup(
        f'<svg viewBox="0 0 380 170" width="380" role="img" aria-label="{label}">{"".join(parts)}</svg>'
    )


def _curve(
    index: int, name: str, line: Sequence[tuple[float, float]], ring: Sequence[tuple[float, float]],
    heights: list[float],
) -> str:  # fmt: skip
    """The course of one angle, its name at a height that no other name has, and a ring at its end."""
    parts = [f'<circle class="course c{index}" cx="{x}" cy="{y:.1f}" r="4"/>' for x, y in ring]
    if len(line) == 1:  # the first fit: no line yet
        parts += [
            f'<circle class="course c{index}" cx="{x}" cy="{y:.1f}" r="1.5"/>' for x, y in line
        ]
    if line:
        corners = " ".join(f"{x:.1f},{y:.1f}" for x, y in line)
        parts.append(f'<polyline class="course c{index}" points="{corners}"/>')
        x, y = max(line[-1][0] + 8, RIGHT + 8), line[-1][1] + 4
        while any(abs(y - other) < 13 for other in heights):
            y -= 1
        heights.append(y)
        parts.append(f'<text x="{x:.1f}" y="{y:.1f}">{name}</text>')
    return "".join(parts)
