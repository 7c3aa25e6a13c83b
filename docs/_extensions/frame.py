"""Draw docs/reference/frame.svg: the tool frame, its two vectors and its angles.

    python docs/_extensions/frame.py

The drawing has a background of its own, so that it reads the same in light and dark pages.
"""

from __future__ import annotations

from math import cos, pi, sin
from pathlib import Path

WIDTH, HEIGHT, PANEL = 760, 300, 190
INK, TOOL, GRAVITY, FIELD, ANGLE = "#1f2937", "#0072b2", "#b45309", "#7c3aed", "#4b5563"
STYLE = "font-family='DejaVu Sans, Helvetica, Arial, sans-serif'"


def line(x1: float, y1: float, x2: float, y2: float, colour: str, dashed: bool = False) -> str:
    dash = " stroke-dasharray='4 4'" if dashed else ""
    return (
        f"<line x1='{x1:.1f}' y1='{y1:.1f}' x2='{x2:.1f}' y2='{y2:.1f}' stroke='{colour}' "
        f"stroke-width='1.5'{dash}/>"
    )


def arrow(x: float, y: float, angle: float, length: float, colour: str, name: str) -> str:
    """An arrow from a point; `angle` clockwise from up, radians."""
    dx, dy = sin(angle), -cos(angle)
    x2, y2 = x + length * dx, y + length * dy
    base = [(x2 - 9 * dx + s * 4 * dy, y2 - 9 * dy - s * 4 * dx) for s in (1, -1)]
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in [(x2, y2), *base])
    stem = f"<line x1='{x:.1f}' y1='{y:.1f}' x2='{x2 - 6 * dx:.1f}' y2='{y2 - 6 * dy:.1f}' "
    return (
        f"{stem}stroke='{colour}' stroke-width='2.2'/><polygon points='{points}' fill='{colour}'/>"
        + text(x2 + 13 * dx, y2 + 13 * dy + 4, name, colour, bold=True)
    )


def text(
    x: float, y: float, words: str, colour: str = INK, bold: bool = False, size: int = 13
) -> str:
    weight = " font-weight='bold'" if bold else ""
    return (
        f"<text x='{x:.1f}' y='{y:.1f}' fill='{colour}' font-size='{size}' "
        f"text-anchor='middle'{weight}>{words}</text>"
    )


def arc(x: float, y: float, start: float, end: float, radius: float, name: str) -> str:
    """An angle from `start` to `end`, clockwise from up, with an arrowhead at its end."""
    ends = [(x + radius * sin(a), y - radius * cos(a)) for a in (start, end)]
    middle = (start + end) / 2
    (x1, y1), (x2, y2) = ends
    turn = end if end > start else end + pi
    dx, dy = cos(turn), sin(turn)
    head = [(x2 - 7 * dx + s * 3.2 * dy, y2 - 7 * dy - s * 3.2 * dx) for s in (1, -1)]
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in [(x2, y2), *head])
    sweep = 1 if end > start else 0
    return (
        f"<path d='M{x1:.1f} {y1:.1f}A{radius} {radius} 0 0 {sweep} {x2:.1f} {y2:.1f}' fill='none' "
        f"stroke='{ANGLE}' stroke-width='1.3'/><polygon points='{points}' fill='{ANGLE}'/>"
        + text(
            x + (radius + 13) * sin(middle), y - (radius + 13) * cos(middle) + 5, name, ANGLE, True
        )
    )


def tool_in_its_vertical_plane(x: float) -> list[str]:
    y, inclination = 110.0, 0.7
    along = pi - inclination  # right and down
    return [
        line(x, y - 40, x, y + 90, ANGLE, dashed=True),
        line(x - 45 * sin(inclination), y - 45 * cos(inclination), x, y, TOOL),
        arrow(x, y, along, 120, TOOL, "z"),
        arrow(x, y, pi, 95, GRAVITY, "g"),
        arc(x, y, pi, along, 58, "I"),
        text(x + 18, 268, "z downhole; g points down", size=11),
        text(x + 18, 286, "gz = |g| cos I", ANGLE, size=11),
    ]


def cross_section(x: float) -> list[str]:
    y, toolface, radius = 140.0, 0.75, 62
    return [
        f"<circle cx='{x}' cy='{y}' r='{radius}' fill='none' stroke='{INK}' stroke-width='1.5'/>",
        line(x, y + 20, x, y - 88, ANGLE, dashed=True),
        text(x, y - 94, "high side", ANGLE, size=11),
        arrow(x, y, toolface, 92, TOOL, "y"),
        arrow(x, y, toolface - pi / 2, 92, TOOL, "x"),
        arc(x, y, 0, toolface, 40, "T"),
        f"<circle cx='{x}' cy='{y}' r='8' fill='white' stroke='{TOOL}' stroke-width='1.6'/>",
        *(line(x - 5.6, y - s * 5.6, x + 5.6, y + s * 5.6, TOOL) for s in (1, -1)),
        text(x, 250, "looking downhole, along z", size=11),
        text(x, 268, "y at the scribe, x left of y", size=11),
        text(x, 286, "gx = −|g| sin I sin T", ANGLE, size=11),
    ]


def plan(x: float) -> list[str]:
    y, azimuth = 150.0, 0.95
    return [
        line(x, y + 30, x, y, ANGLE, dashed=True),
        line(x - 70, y, x, y, ANGLE, dashed=True),
        arrow(x, y, 0, 92, INK, "N"),
        arrow(x, y, pi / 2, 72, INK, "E"),
        arrow(x, y, azimuth, 92, TOOL, ""),
        text(x + 72, y - 62, "hole", TOOL),
        arc(x, y, 0, azimuth, 50, "A"),
        text(x, 268, "from above; N is magnetic", size=11),
        text(x, 286, "A clockwise from N", ANGLE, size=11),
    ]


def field(x: float) -> list[str]:
    y, dip, start = 110.0, 1.0, x - 40
    return [
        line(start, y, start, y + 100, ANGLE, dashed=True),
        arrow(start, y, pi / 2, 92, INK, "N"),
        arrow(start, y, pi / 2 + dip, 108, FIELD, "b"),
        arc(start, y, pi / 2, pi / 2 + dip, 50, "D"),
        text(x, 268, "from the east; D positive down", size=11),
        text(x, 286, "b along the field", ANGLE, size=11),
    ]


def drawing() -> str:
    """The whole drawing as SVG."""
    panels = (
        ("inclination", tool_in_its_vertical_plane),
        ("toolface", cross_section),
        ("azimuth", plan),
        ("dip", field),
    )
    parts = [f"<rect width='{WIDTH}' height='{HEIGHT}' rx='8' fill='white' stroke='#d1d5db'/>"]
    for index, (name, draw) in enumerate(panels):
        middle = (index + 0.5) * PANEL
        parts += [text(middle, 24, name, INK, True, 14), *draw(middle - (18 if index == 0 else 0))]
    body = "\n".join(parts)
    title = "Tool axes x, y, z, gravity g, field b, and the angles inclination, toolface, azimuth and dip"
    return (
        f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {WIDTH} {HEIGHT}' {STYLE} role='img' "
        f"aria-label='{title}'>\n{body}\n</svg>\n"
    )


if __name__ == "__main__":
    Path(__file__).parents[1].joinpath("reference", "frame.svg").write_text(
        drawing(), encoding="utf-8"
    )
