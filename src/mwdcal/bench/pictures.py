"""Drawings of the bench: the tool's angles, the stations on the unit sphere, the accuracy as stations come in. Plain SVG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from markupsafe import Markup

from mwdcal.bench.session import ANGLES, Part
from mwdcal.geometry.vectors import reference_vectors
from mwdcal.presentation.numbers import number

FULL = {"inclination": 180, "toolface": 360, "azimuth": 360}
STEEP = 0.7
"""How steeply the sphere is looked at, radians."""


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


def sphere(part: Part, bad: Sequence[int], label: str) -> Markup:
    """Directions of gravity in the tool at all positions: measured, next, not fitting, still to come.

    Above the tool's end that looks downhole; what lies behind is pale. The marks differ in shape, not in colour alone.
    """
    angles = np.radians([part.attitude(i) for i in range(part.count)]).T.reshape(3, -1)
    g, _ = reference_vectors(*angles, 1.0, 1.0, 0.0)
    x, y, z = g.T
    across, up = x, z * np.cos(STEEP) + y * np.sin(STEEP)
    front = y * np.cos(STEEP) - z * np.sin(STEEP) <= 0
    done, order = part.done, part.order
    marks = []
    for i in range(part.count):
        u, v = 100 * float(across[i]), -100 * float(up[i])
        side = "" if front[i] else " behind"
        if i in bad:
            shape = (
                f'<path class="badmark{side}" d="M{u - 5:.1f},{v - 5:.1f} l10,10 m0,-10 l-10,10"/>'
            )
        elif i in done:
            shape = f'<circle class="done{side}" cx="{u:.1f}" cy="{v:.1f}" r="4"/>'
        else:
            shape = f'<circle class="leftmark{side}" cx="{u:.1f}" cy="{v:.1f}" r="4"/>'
        marks.append(shape)
        if i == order:
            marks.append(
                f'<rect class="nextmark" x="{u - 8:.1f}" y="{v - 8:.1f}" width="16" height="16"/>'
            )
    ring = f'<ellipse class="axis" rx="100" ry="{100 * np.sin(STEEP):.1f}"/>'
    return Markup(
        f'<svg viewBox="-110 -110 220 220" width="260" role="img" aria-label="{label}">'
        f'<circle class="axis" r="100"/>{ring}{"".join(marks)}</svg>'
    )


def course(
    points: Sequence[tuple[int, Mapping[str, float | None]]], expected: Mapping[str, float | None],
    count: int, names: Mapping[str, str], label: str,
) -> Markup:  # fmt: skip
    """1σ of the three angles over the number of stations, in logarithm; circles are what the whole plan will give."""
    values = [v for _, row in points for v in row.values() if v] + [
        v for v in expected.values() if v
    ]
    if not values:
        return Markup("")
    low, high = np.log10(min(values)) - 0.1, np.log10(max(values)) + 0.1
    left, right, top, bottom = 48.0, 300.0, 10.0, 150.0

    def across(stations: float) -> float:
        return left + (right - left) * min(stations / max(count, 1), 1.0)

    def down(value: float) -> float:
        return float(top + (bottom - top) * (high - np.log10(value)) / (high - low))

    ticks = [
        10.0**p * m for p in range(-5, 3) for m in (1, 3) if low <= np.log10(10.0**p * m) <= high
    ]
    parts = [
        f'<line class="axis" x1="{left}" x2="{right}" y1="{down(v):.1f}" y2="{down(v):.1f}"/>'
        f'<text x="{left - 5}" y="{down(v) + 4:.1f}" text-anchor="end">{number(v)}°</text>'
        for v in ticks
    ]
    ends: list[float] = []
    for place, name in enumerate(ANGLES):
        line = [(n, row[name]) for n, row in sorted(points, key=lambda p: p[0]) if row.get(name)]
        if line:
            path = " ".join(f"{across(n):.1f},{down(v):.1f}" for n, v in line if v)
            parts.append(f'<polyline class="course c{place}" points="{path}"/>')
            n, v = line[-1]
            height = down(v or 1) + 4
            while any(abs(height - other) < 13 for other in ends):
                height -= 1
            ends.append(height)
            parts.append(f'<text x="{across(n) + 8:.1f}" y="{height:.1f}">{names[name]}</text>')
        if final := expected.get(name):
            parts.append(
                f'<circle class="course c{place}" cx="{right}" cy="{down(final):.1f}" r="4"/>'
            )
    for n in (0, count):
        parts.append(f'<text x="{across(n):.1f}" y="{bottom + 15}" text-anchor="middle">{n}</text>')
    return Markup(
        f'<svg viewBox="0 0 380 170" width="380" role="img" aria-label="{label}">{"".join(parts)}</svg>'
    )
