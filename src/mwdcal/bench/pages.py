"""The page of the bench: what it says of a session, and its live figures."""

from __future__ import annotations

import tomllib
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from mwdcal.bench import pictures
from mwdcal.bench.session import ANGLES, FEWEST, RUN, Part, Session
from mwdcal.presentation.numbers import fixed, number, signed
from mwdcal.presentation.text import one_line

if TYPE_CHECKING:
    from jinja2 import Environment

DECIMALS = {"inclination": 2, "toolface": 2, "azimuth": 2, "gravity": 5, "field": 0, "dip": 2}
UNITS = {
    "inclination": "°",
    "toolface": "°",
    "azimuth": "°",
    "gravity": " g",
    "field": " nT",
    "dip": "°",
}
LEAST_WARMING = 0.05
"""°C a minute below which a temperature counts as steady."""
EARTH = ("gravity_g", "field_nt", "dip_deg")


@cache
def texts() -> dict[str, str]:
    """The texts of the page by key."""
    return tomllib.loads(files("mwdcal.bench").joinpath("texts.toml").read_text("utf-8"))


@cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("mwdcal.bench"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip


def page(session: Session, token: str) -> str:
    """The whole page."""
    from markupsafe import Markup

    with session.lock:
        return _environment().get_template("page.html").render(
            t=texts(), head=f"{session.profile.name} · {session.plan_name}", simulated=session.simulated,
            source=source_text(session, ""), lost="The bench does not answer. Nothing accepted is lost.",
            fragment=Markup(fragment(session, token)),
        )  # fmt: skip


def fragment(session: Session, token: str) -> str:
    """All of the page that decisions change."""
    with session.lock:
        return (
            _environment()
            .get_template("main.html")
            .render(t=texts(), token=token, **_offered(session), **_shown(session))
        )


def _offered(session: Session) -> dict[str, Any]:
    """What can be done now."""
    part = session.part
    measuring = not session.waiting and part.order is not None
    measuring = measuring and (session.testing or not session.calibrated)
    run = not session.testing and not session.calibrated
    return {
        "starting": not session.facts, "waiting": session.waiting, "auto": session.auto,
        "paused": session.paused, "manual": session.source == "manual",
        "can_undo": bool(part.stations) and (run or (session.testing and session.verdict is None)),
        "can_calibrate": run and session.fit.calibration is not None,
        "can_test": session.calibrated and not session.testing,
        "can_certify": session.verdict is not None and "certificate" not in session.papers,
        "bad": bool(session.bad), "measuring": measuring, "serial": "DEMO-1" if session.simulated else "",
        "earth": [(name, number(session.earth.get(name), 6) if name in session.earth else "") for name in EARTH],
    }  # fmt: skip


def _shown(session: Session) -> dict[str, Any]:
    """What the page says."""
    t, part = texts(), session.part
    order = part.order if not (session.calibrated and not session.testing) else None
    figures = []
    if order is not None and not session.waiting:
        angles = zip(ANGLES, part.attitude(order), strict=True)
        figures = [
            (name, f"{number(angle)}°", pictures.dial(name, angle)) for name, angle in angles
        ]
        figures = [figures[i] for i in (0, 2, 1)]
    heading, style = _heading(session)
    fit = session.fit
    if fit.calibration is None:
        note = (
            t["no_fit"].format(reason=fit.reason)
            if fit.reason
            else t["first_fit"].format(count=FEWEST)
        )
    else:
        note = ""
    bad = [int(label) - 1 for label in session.bad]
    latest = session.course[-1][1] if session.course else {}
    expected = session.expected
    return {
        "heading": heading, "heading_class": style, "order": _order_text(session, order),
        "note": _note(session), "figures": figures, "fit_note": note,
        "accuracy": [
            (name, f"{number(latest[name], 2)}°" if latest.get(name) else "–",
             f"{number(expected.get(name), 2)}°" if expected.get(name) else "–")
            for name in ("inclination", "toolface", "azimuth") if latest
        ],
        "course": pictures.course(session.course, expected, session.parts[RUN].count, t, t["accuracy"]),
        "sphere": pictures.sphere(part, bad, t["sphere"]),
        "rows": _rows(session, part), "count": f"{len(part.stations)} / {part.count}",
        "readings": _reading_names(session), "papers": _papers(session),
    }  # fmt: skip


def _heading(session: Session) -> tuple[str, str]:
    """The result, if there is one, and how it is drawn."""
    t = texts()
    if session.verdict is not None:
        return (t["passed"], "pass") if session.verdict.passed else (t["failed"], "fail")
    if session.calibrated:
        return t["calibrated"].format(serial=session.facts.get("serial", "")), ""
    return "", ""


def _order_text(session: Session, order: int | None) -> str:
    """Where to go, or what comes next."""
    t = texts()
    if session.waiting:
        return t["resume"] if session.facts else t["start"]
    if session.verdict is not None:
        if session.verdict.passed:
            return t["finished"] if "certificate" in session.papers else t["next_certificate"]
        return t["next_failed"].format(command="mwdcal diagnose tool.json rolltest.csv")
    if session.calibrated and not session.testing:
        return t["next_rolltest"]
    if order is None:
        bad = ", ".join(session.bad)
        return t["all_bad"].format(labels=bad) if bad else t["all_measured"]
    part = session.part
    inclination, azimuth, toolface = (f"{number(v)}°" for v in part.attitude(order))
    text = t["roll" if session.testing else "turn"].format(
        inclination=inclination, toolface=toolface, azimuth=azimuth
    )
    place = f"{t['station']} {order + 1}. "
    temperature = part.temperature(order)
    if temperature is not None and part.is_new_soak(order):
        place += t["soak"].format(temperature=number(temperature)) + " "
    return place + text


def _note(session: Session) -> str:
    """What went wrong, or which station does not fit."""
    t = texts()
    if session.message:
        return session.message
    if session.bad:
        return " ".join(t["bad_station"].format(label=label) for label in session.bad)
    return t["paused"] if session.paused else ""


def _rows(session: Session, part: Part) -> list[dict[str, Any]]:
    """The table of positions."""
    t, rows, done, order = texts(), [], part.done, part.order
    for position in range(part.count):
        label = str(position + 1)
        inclination, azimuth, toolface = (f"{number(v)}°" for v in part.attitude(position))
        bad = label in session.bad
        if position in part.again:
            text = t["again_due"]
        elif bad:
            text = session.bad[label]
        elif position in done:
            judged = session.fit.calibration is not None and not session.testing
            text = t["ok"] if judged else t["open"]
        elif position in part.skipped:
            text = t["skipped"]
        else:
            text = t["next"] if position == order else t["left"]
        rows.append(
            {"label": label, "inclination": inclination, "toolface": toolface, "azimuth": azimuth, "text": text,
             "bad": bad}
        )  # fmt: skip
    return rows


def _reading_names(session: Session) -> list[str]:
    """Live figures beside the angles."""
    names = ["gravity", "field", "dip"] if session.profile.has_magnetometer else ["gravity"]
    return [*names, "temperature"]


def _papers(session: Session) -> list[tuple[str, str]]:
    """Documents by name, with their file."""
    shown = []
    for name, value in session.papers.items():
        is_file = (session.folder / value).is_file()
        shown.append((f"{name}: {value}" if is_file else one_line(value), value if is_file else ""))
    return shown


def source_text(session: Session, note: str, drops: int = 0) -> str:
    """The source and what is wrong with it."""
    t, parts = texts(), [note or session.source]
    if drops:
        parts.append(t["drops"].format(count=drops))
    if session.stream.garbage:
        parts.append(t["garbage"].format(count=session.stream.garbage))
    return " · ".join(parts)


def live(session: Session, note: str = "", drops: int = 0) -> dict[str, Any]:
    """Figures that change all the time, as text by name."""
    t = texts()
    with session.lock:
        values, state = session.live(), session.state
        settling = session.settling
        left = settling.seconds_left if settling else 0.0
        there = session.is_there
        warmth, warming = session.warmth[-1:], session.warming
        measuring = session.part.order is not None
    result: dict[str, Any] = {"state": state, "source": source_text(session, note, drops)}
    text = t[state] if state != "settling" else f"{t['settling']}: {fixed(left, 0)} s"
    if state == "waiting":
        text = t["wait_source"]
    elif measuring and not there:
        text, result["state"] = f"{text} – {t['not_there']}", "moving"
    result["state_text"] = text
    for name, value in values.items():
        shown = fixed(value, DECIMALS[name]) + UNITS[name] if value == value else "–"
        result[name if name in ANGLES else f"live_{name}"] = shown
        if name in ANGLES and value == value:
            result[f"turn_{name}"] = round(180 - value if name == "inclination" else value, 1)
    if warmth:
        moving = warming is not None and abs(warming) >= LEAST_WARMING
        rate = f" ({signed(warming, 1)} °C/min)" if moving and warming is not None else ""
        result["live_temperature"] = f"{fixed(warmth[0][1], 1)} °C{rate}"
    return result
