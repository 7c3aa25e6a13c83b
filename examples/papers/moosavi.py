"""Reproduce Moosavi et al.: figures 5 to 8 with SIMULATED instruments, and equation 12.

Writes docs/evidence/papers/moosavi.md and its figures. Same version, same bytes.
It is about the estimators, and imports the core.

    python examples/papers/moosavi.py
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from mwdcal.estimation.minimisers.newton import Local, Newton, compared, cost, local, newton
from mwdcal.estimation.solvers import Status
from mwdcal.geometry.vectors import Array, centred, reference_vectors
from mwdcal.planning.plans import StationPlan, Truth, grid, reading, servo
from mwdcal.sensor.models import Basis, Factors

PAGES = Path(__file__).parents[2] / "docs" / "evidence" / "papers"
SEED, SEEDS = 123, 200
NOISE, STAND = 1e-4, np.radians(0.01)
POSITIONS, SOAKS = [0, 45, 90, 135], [25.0, 36.0, 47.0, 58.0, 69.0, 80.0]
TWELVE, THIRTY = Factors(Basis(0, 25.0)), Factors(Basis(3, 52.5, 27.5, chebyshev=True))
COLD, HOT = grid(POSITIONS, 12, [0], [25.0]), grid(POSITIONS, 9, [0], SOAKS)
BEFORE, AFTER, PRINTED = "#6b7280", "#0072b2", "#d55e00"
STYLE = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.labelsize": 8,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 8.5,
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "grid.color": "#e5e7eb",
    "grid.linewidth": 0.5,
    "legend.frameon": False,
    "lines.linewidth": 0.8,
    "lines.markersize": 3.2,
    "svg.fonttype": "path",
    "svg.hashsalt": "mwdcal",
    "text.parse_math": False,
}


# Calibration


def measure(truth: Truth, plan: StationPlan, rng: np.random.Generator) -> Array:
    """Accelerometer readings (n, 3) of a plan, at a stand that is a little off."""
    count = len(plan.inclination)
    stood = plan.inclination + STAND * rng.normal(size=count)
    clean = reading(truth, replace(plan, inclination=stood))[0]
    return np.asarray(clean + NOISE * rng.normal(size=clean.shape))


def datasheet(model: Factors) -> Array:
    """Where the iteration starts: nominal scale, no bias, no misalignment."""
    return model.start(np.eye(3), np.zeros(3))


def errors(model: Factors, params: Array, raw: Array, plan: StationPlan) -> tuple[Array, Array]:
    """Errors (..., n) of |g| in g and of tilt in degrees."""
    g = model.fields(params, raw, plan.temperature)
    tilt = np.arctan2(np.hypot(g[..., 0], g[..., 1]), g[..., 2])
    return np.linalg.norm(g, axis=-1) - 1, np.degrees(tilt - plan.inclination)


def fit(model: Factors, raw: Array, plan: StationPlan) -> Newton:
    """The paper's method from the datasheet."""
    return newton(model, datasheet(model), raw, plan.temperature, 1.0, plan.inclination)


@dataclass(frozen=True)
class Case:
    """One of the paper's two calibrations of one instrument: errors (2, n), before and after."""

    name: str
    plan: StationPlan
    found: Newton
    strength: Array
    tilt: Array
    spread: Array

    @classmethod
    def of(cls, name: str, model: Factors, plan: StationPlan, check: StationPlan) -> Case:
        """Simulate, calibrate, and roll the tool at 45° in a test of its own."""
        rng = np.random.default_rng(SEED)
        truth = servo(rng)
        raw, rolled = measure(truth, plan, rng), measure(truth, check, rng)
        found = fit(model, raw[None], plan)
        both = np.stack([datasheet(model), found.params[0]])[:, None, :]
        pair = [errors(model, params[0], raw, plan) for params in both]
        rolls = [errors(model, params[0], rolled, check) for params in both]
        spread = np.array([[np.ptp(t), np.ptp(s)] for s, t in rolls])
        strength, tilt = (np.stack([p[k] for p in pair]) for k in (0, 1))
        return cls(name, plan, found, strength, tilt, spread)


# Many instruments


def fleet(plan: StationPlan, seeds: int = SEEDS) -> tuple[Array, list[Truth]]:
    """Readings (seeds, n, 3) of as many instruments, and the instruments."""
    generators = [np.random.default_rng(seed) for seed in range(seeds)]
    truths = [servo(rng) for rng in generators]
    pairs = zip(truths, generators, strict=True)
    return np.stack([measure(truth, plan, rng) for truth, rng in pairs]), truths


def turn(model: Factors, params: Array, raw: Array, plan: StationPlan) -> Array:
    """Turn about the tool axis (...) of the mean gain, degrees."""
    gain = model.slope(params, raw, plan.temperature).mean(-3)
    sine, cosine = gain[..., 0, 1] - gain[..., 1, 0], gain[..., 0, 0] + gain[..., 1, 1]
    return np.degrees(np.arctan2(sine, cosine))


def pseudo_inverse(
    raw: Array, plan: StationPlan, cutoff: float, steps: int = 20
) -> tuple[Array, Array]:
    """Twelve parameters by the formula as printed, pseudo-inverse for inverse; and the cost."""
    stations = compared(raw, plan.temperature, 1.0, plan.inclination)
    params = np.broadcast_to(datasheet(TWELVE), (len(raw), 12))
    for _ in range(steps):
        here: Local = local(TWELVE, params, stations)
        back = np.linalg.pinv(here.hessian, rcond=cutoff, hermitian=True)
        params = params - (back @ here.gradient[..., None])[..., 0]
    return params, cost(TWELVE, params, stations)


def ramp(kind: str) -> StationPlan:
    """36 stations, nine at a position, while a heater changes the temperature."""
    plan, up = grid(POSITIONS, 9, [0], [25.0]), np.linspace(25, 80, 9)
    course = {
        "heated from 25 to 80 °C once in each position": np.tile(up, 4),
        "heated in one position, cooled in the next": np.tile([*up, *up[::-1]], 2),
        "heated once from the first station to the last": np.linspace(25, 80, 36),
    }
    return replace(plan, temperature=course[kind])


def elsewhere(plan: StationPlan, seeds: int = 50) -> list[str]:
    """Rank, iterations, and errors on a dense noise-free grid after 30 factors from a plan."""
    check = grid([10, 30, 45, 70, 90, 120, 150], 7, [0], [30.0, 40.0, 50.0, 60.0, 70.0, 80.0])
    raw, truths = fleet(plan, seeds)
    found = fit(THIRTY, raw, plan)
    clean = np.stack([reading(truth, check)[0] for truth in truths])
    strength, tilt = (np.abs(e).max(-1) for e in errors(THIRTY, found.params, clean, check))
    return [
        str(len(plan.inclination)),
        " or ".join(map(str, np.unique(found.determined.rank))),
        str(found.iterations.max()),
        f"{1e3 * np.median(strength):.2g}",
        f"{np.median(tilt):.2g}",
    ]


# Equation 12


def azimuth(g: Array, b: Array, sign: float, signs: tuple[int, ...] = (1,) * 6) -> Array:
    """Equation 12 in the paper's axes, G = (-gx, -gy, gz), H = b; `sign` is +1 or, printed, -1."""
    GA, GB, GC = np.moveaxis(g * np.array([-1, -1, 1]) * signs[:3], -1, 0)
    HX, HY, HZ = np.moveaxis(b * signs[3:], -1, 0)
    east = np.linalg.norm(g, axis=-1) * (HX * GB - HY * GA)
    return np.arctan2(east, GC * (HX * GA + sign * HY * GB) + HZ * (GA**2 + GB**2))


def attitudes() -> tuple[Array, Array, Array]:
    """Azimuth (i, a, t) and both vectors at inclination × azimuth × toolface, dip 63°."""
    degrees = [5, 30, 45, 60, 90, 120], range(0, 360, 30), range(0, 360, 15)
    inclination, azi, toolface = np.meshgrid(*map(np.radians, degrees), indexing="ij")
    return azi, *reference_vectors(inclination, azi, toolface, dip=np.radians(63.0))


def turning(found: Array) -> Array:
    """How far (...) the azimuth moves, degrees, while only the toolface (last axis) changes."""
    return np.degrees(np.abs(centred(found - found[..., :1])).max(-1))


def best_of_signs(sign: float) -> tuple[int, float, float]:
    """Of 64 assignments of axis signs: how many are right; smallest median error and turning."""
    azi, g, b = attitudes()
    found = [azimuth(g, b, sign, signs) for signs in product((1, -1), repeat=6)]
    wrong = np.degrees(np.abs([centred(one - azi) for one in found]))
    turned = [np.median(turning(one)) for one in found]
    right = int(np.sum(wrong.max((1, 2, 3)) < 1e-6))
    return right, float(np.median(wrong, (1, 2, 3)).min()), float(min(turned))


# Figures


def save(figure: Figure, name: str) -> None:
    """An SVG without date and version."""
    stream = io.StringIO()
    figure.savefig(stream, format="svg", metadata=dict.fromkeys(("Date", "Creator")))
    text = re.sub(r'\b(d|x|y)="[^"]*"', shortened, stream.getvalue())
    text = re.sub(r"<g([^<>]*)>\s*((?:<use [^<>]*/>\s*)+)</g>", gathered, text)
    lines = [line.rstrip() for line in text.splitlines()]
    (PAGES / f"moosavi-{name}.svg").write_text("\n".join(lines) + "\n", encoding="utf-8")


def shortened(path: re.Match[str]) -> str:
    """Coordinates of a path to a hundredth of a point."""
    return re.sub(r"(\.\d\d)\d+", r"\1", path[0])


def gathered(group: re.Match[str]) -> str:
    """Markers of one series: their style said once."""
    styles = set(re.findall(r' style="[^"]*"', group[2]))
    if len(styles) != 1:
        return group[0]
    style = styles.pop()
    return f"<g{group[1]}{style}>\n{group[2].replace(style, '')}</g>"


def draw_errors(case: Case, name: str, numbers: tuple[int, int], marks: dict[float, str]) -> None:
    """Absolute errors per station before and after, as the paper's pairs of figures."""
    figure = Figure(figsize=(7.1, 4.6), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True)
    titles = f"Figure {numbers[0]}: |g|", f"Figure {numbers[1]}: tilt"
    values = 1e3 * case.strength, case.tilt
    for axes, title, pair, unit in zip(panels, titles, values, ("mg", "°"), strict=True):
        station = np.arange(1, pair.shape[-1] + 1)
        looks = (BEFORE, "o", "before: datasheet"), (AFTER, "s", f"after: {case.name}")
        for row, (colour, marker, label) in zip(np.abs(pair), looks, strict=True):
            axes.plot(station, row, color=colour, marker=marker, linestyle="none", label=label)
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.set_ylim(top=8 * np.abs(pair).max())
        axes.set_title(f"{title}, absolute error, simulated instrument")
        axes.set_ylabel(unit)
        for at, text in marks.items():
            axes.axvline(at, color="#9ca3af", linewidth=0.6)
            place = axes.get_xaxis_transform()
            axes.text(at, 0.91, f" {text}", transform=place, fontsize=7, color="#4b5563")
    panels[-1].set_xlabel("station")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=2)
    save(figure, name)


def draw_azimuth() -> None:
    """The error of equation 12 against toolface, printed and corrected."""
    toolface = np.arange(0.0, 361.0, 3.0)
    figure = Figure(figsize=(7.1, 3.0), layout="constrained")
    axes = figure.subplots()
    looks = zip((10, 45, 80), ("-", "--", ":"), strict=True)
    for inclination, dashes in looks:
        angles = np.radians([inclination, 60.0])
        g, b = reference_vectors(*angles, np.radians(toolface), dip=np.radians(63.0))
        for sign, colour, text in ((-1.0, PRINTED, "printed"), (1.0, AFTER, "with plus")):
            wrong = np.degrees(centred(azimuth(g, b, sign) - angles[1]))
            broken = np.where(np.abs(np.diff(wrong, prepend=wrong[:1])) > 180, np.nan, wrong)
            label = f"{text}, {inclination}°" if sign < 0 else None
            if inclination == 80 and sign > 0:
                label = "with plus, all three"
            axes.plot(
                toolface, broken, color=colour, linestyle=dashes if sign < 0 else "-", label=label
            )
    axes.set_xlim(0, 360)
    axes.set_xticks(np.arange(0, 361, 45))
    axes.set_xlabel("toolface, °")
    axes.set_ylabel("error of azimuth, °")
    axes.set_title("Equation 12 while the tool is rolled: inclination 10, 45, 80°, azimuth 60°")
    figure.legend(loc="outside right upper")
    save(figure, "azimuth")


# Page


def table(head: list[str], rows: list[list[str]]) -> list[str]:
    """A Markdown table."""
    lines = ["| " + " | ".join(line) + " |" for line in (head, *rows)]
    return [lines[0], "|---" * len(head) + "|", *lines[1:], ""]


def rms(values: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def power(value: float) -> str:
    """A number as 2.5e-3."""
    return re.sub(r"e-0?", "e-", f"{value:.1e}").replace("e+00", "")


def summary(cases: list[Case]) -> list[str]:
    """Before and after, per calibration."""
    rows = []
    for case in cases:
        for k, when in enumerate(("before", "after")):
            s, t = 1e3 * np.abs(case.strength[k]), np.abs(case.tilt[k])
            figures = f"{rms(s):.3g}", f"{s.max():.3g}", f"{rms(t):.2g}", f"{t.max():.2g}"
            rolled = f"{case.spread[k, 0]:.2g}", f"{1e3 * case.spread[k, 1]:.2g}"
            rows.append([case.name, when, *figures, *rolled])
    head = ["calibration", "", "g error rms, mg", "max", "tilt error rms, °", "max"]
    return table([*head, "roll test: tilt, °", "roll test: g, mg"], rows)


def history(cases: list[Case]) -> list[str]:
    """Cost and criterion 22 after each iteration."""
    rows = []
    for k in range(max(int(case.found.iterations[0]) for case in cases) + 1):
        cells = [str(k)]
        for case in cases:
            change = np.nan if k == 0 else case.found.criterion[0, k - 1]
            cells += ["" if np.isnan(x) else power(x) for x in (case.found.cost[0, k], change)]
        rows.append(cells)
    pairs = [f"{what}, {case.name}" for case in cases for what in ("E", "criterion 22")]
    return table(["iteration", *pairs], rows)


def counts(found: Newton) -> str:
    """How many instruments needed how many iterations."""
    assert np.all(found.status == Status.OK), "an instrument did not converge"
    numbers, many = np.unique(found.iterations, return_counts=True)
    return ", ".join(f"{n} in {m}" for n, m in zip(numbers, many, strict=True))


def wandering(raw: Array, truths: list[Truth], found: Newton) -> list[str]:
    """Toolface zero of each way to take the step, over all instruments at one temperature."""
    ours = turn(TWELVE, found.params, raw, COLD)
    pairs = zip(truths, raw, strict=True)
    true = np.array([turn(t.model, t.accelerometer, one, COLD) for t, one in pairs])
    last = np.nanmin(found.cost, -1)

    def row(name: str, turns: Array, reached: Array) -> list[str]:
        off = np.abs(turns - true)
        close = int(np.sum(reached <= last * (1 + 1e-6)))
        figures = f"{np.abs(turns).max():.3g}°", str(np.sum(np.abs(turns) > 0.1))
        return [name, *figures, f"{off.max():.3g}°", f"{close} of {len(turns)}"]

    rows = [row("row space, absolute eigenvalues (here)", ours, last)]
    for cutoff in (1e-10, 1e-4, 1e-3, 1e-2):
        params, reached = pseudo_inverse(raw, COLD, cutoff)
        name = f"pseudo-inverse of H, cut-off {cutoff:g}"
        rows.append(row(name, turn(TWELVE, params, raw, COLD), reached))
    head = ["step", "largest turn from the datasheet", "over 0.1°", "largest turn from the truth"]
    return table([*head, "same minimum of E"], rows)


def azimuths() -> list[str]:
    """Equation 12: error and turning for the printed sign, the corrected one, and all axis signs."""
    azi, g, b = attitudes()
    rows = []
    for name, sign in (("minus (printed)", -1.0), ("plus", 1.0)):
        found = azimuth(g, b, sign)
        wrong = np.degrees(np.abs(centred(found - azi)))
        right, least, least_turning = best_of_signs(sign)
        own = [f"{x:.3g}°" for x in (np.median(wrong), wrong.max(), np.median(turning(found)))]
        others = [f"{x:.3g}°" for x in (least, least_turning)]
        rows.append([name, *own, f"{right} of 64", *others])
    rows = [[c if "e-" not in c else "0°" for c in row] for row in rows]
    head = ["sign", "error, median", "error, worst", "turns with toolface by, median"]
    best = ["right", "least median error", "least median turning"]
    return table([*head, *(f"axis signs: {text}" for text in best)], rows)


def page(cases: list[Case]) -> str:
    """The documentation page, with every number computed here."""
    (cold, truths), (hot, _) = fleet(COLD), fleet(HOT)
    twelve, thirty = fit(TWELVE, cold, COLD), fit(THIRTY, hot, HOT)
    values = ", ".join(f"{v:.2f}" for v in cases[0].found.determined.values[0])
    kinds = (
        "heated from 25 to 80 °C once in each position",
        "heated in one position, cooled in the next",
        "heated once from the first station to the last",
    )
    plans = [["36 stations at each of six temperatures", *elsewhere(HOT)]]
    plans += [[kind, *elsewhere(ramp(kind))] for kind in kinds]
    head = ["temperatures", "stations", "rank of 30", "iterations, most"]
    text = TEXT.split("@")
    parts: dict[str, list[str]] = {
        "summary": summary(cases),
        "history": history(cases),
        "many": [
            f"12 parameters: {counts(twelve)}. 30 factors: {counts(thirty)}. All converged.",
            "",
        ],
        "rank": [f"> {values}", ""],
        "wandering": wandering(cold, truths, twelve),
        "plans": table([*head, "g error elsewhere, mg", "tilt error elsewhere, °"], plans),
        "azimuth": azimuths(),
    }
    lines = [
        chunk for k, piece in enumerate(text) for chunk in (parts[piece] if k % 2 else [piece])
    ]
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines)).rstrip() + "\n"


TEXT = """# Moosavi et al., recomputed

The method of S. M. Seyed Moosavi, B. Moaveni, B. Moshiri, M. R. Arvan, *Error Analysis in Accelerometers
Calibration of Measurement while Drilling Instrument used in Directional Drilling Operations* (full reference and
errata: [Errata](../errata.md)): twelve parameters of an accelerometer triad at one temperature, thirty over
temperature, from the strength of gravity and the inclination, by Newton–Raphson.

**All data on this page are simulated.** The paper's raw data are not available. The instruments are drawn within
its Table 1. Every number and figure is written by `python examples/papers/moosavi.py`.

| | here | paper |
|---|---|---|
| scale, bias, alignment, drifts | drawn uniformly within the limits of Table 1 | Table 1; the instrument MWD123 |
| positions | inclination 0, 45, 90, 135°, turned about the tool axis | the same |
| stations, 12 parameters | 12 per position, 25 °C | 12 per position "typical", about 25 °C |
| stations, 30 factors | 9 per position at each of six temperatures | 9 per position "typical", about 25 to 80 °C |
| start | datasheet: nominal scale, no bias, no misalignment | the same |
| noise of a station | 0.1 mg, *inferred* (Table 1 gives a current) | not stated |
| stand | 0.01° in inclination, *inferred* | not stated |
| temperatures | 25, 36, 47, 58, 69, 80 °C, *inferred*; see below | "changed by heater" |
| curvature of the drift | *inferred*: a tenth, a hundredth of the drift over 100 °C | not stated |

## Figures 5 to 8

@summary@

*Roll test*: twelve toolfaces at 45° that are not in the fit, at 25 °C and, for the thirty factors, at 62 °C; largest
less smallest value, as in criteria 13 and 15, which ask for 0.1° and 3 mg.

![Absolute errors of gravity and tilt per station, twelve parameters](moosavi-12.svg)

![Absolute errors of gravity and tilt per station, thirty factors](moosavi-30.svg)

Reproduced: the error of gravity falls to what the paper calls "nearly 0", and that of tilt "to a large extent". The
rest is noise and stand. The paper's text gives no numbers, and its plots were not available: no digits are
compared.

## Iterations

"Less than ten iterations are generally sufficient": so it is, with the exact Hessian.

@history@

E is the paper's unweighted sum (g⁴ and rad²). Criterion 22 is that of the undamped step, with a floor under its
denominator: as printed it divides by a parameter that may be zero. Two hundred instruments of Table 1 from the
datasheet, iterations needed:

@many@

The stations at exactly 0° are in the sum as they are. Inclination has no gradient there; its square has.

## Eleven of twelve

Rotating the tool about its axis at several tilts, the paper says, gives the twelve parameters. It gives eleven. Turn
the whole triad about the tool axis: neither |g| nor the inclination changes, and toolface zero is free. Singular
values of the column-normalised Jacobian after calibration, as a share of the largest:

@rank@

Equation 21 inverts the Hessian. At the minimum that is a division by zero. Before it the Hessian is *regular*
along the free direction, because its gradient is not zero yet, and the inverse takes real steps along it. A
pseudo-inverse does the same unless its cut-off happens to lie in the right place. Two hundred instruments, twelve
parameters:

@wandering@

All ways reach the same E and the same tilts; the toolface zero of a wanderer is off by whatever the path added. The
truth itself is up to 0.11° from the datasheet (alignment 2 mrad), and no method of this evidence can know that.

## Temperature plans

The text can be read as six soaks of 36 stations or as 36 stations during which a heater runs. Thirty factors, fifty
instruments, errors (median of the largest) on a dense grid of attitudes and temperatures from 30 to 80 °C, free of
noise, that is not in the fit:

@plans@

Of thirty, 29 can be determined. A single slow heating ties temperature to attitude: the fit looks as good, and is
wrong elsewhere. `determined` shows it before use.

## Equation 12

Azimuth, in the paper's axes, from perfect vectors (dip 63°; inclination 5 to 120°, all azimuths and toolfaces):

@azimuth@

With the printed minus the azimuth turns as the tool is rolled, and no assignment of signs to the six axes is right.
With a plus in the denominator it is exact (three of the other assignments leave the formula as it is). An azimuth
must not depend on toolface: that is the test of such a formula, and it needs no reference.

![Error of equation 12 against toolface](moosavi-azimuth.svg)
"""


def main() -> None:
    """Compute everything, write page and figures."""
    roll = grid([45], 12, [0], [25.0])
    cases = [
        Case.of("12 parameters", TWELVE, COLD, roll),
        Case.of("30 factors", THIRTY, HOT, replace(roll, temperature=np.full(12, 62.0))),
    ]
    PAGES.mkdir(exist_ok=True)
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(STYLE)
        positions = {0.5 + 12 * k: f"{angle}°" for k, angle in enumerate(POSITIONS)}
        draw_errors(cases[0], "12", (5, 6), positions)
        soaks = {0.5 + 36 * k: f"{soak:.0f} °C" for k, soak in enumerate(SOAKS)}
        draw_errors(cases[1], "30", (7, 8), soaks)
        draw_azimuth()
    (PAGES / "moosavi.md").write_text(page(cases), encoding="utf-8")
    print(f"wrote {PAGES / 'moosavi.md'}")


if __name__ == "__main__":
    main()
