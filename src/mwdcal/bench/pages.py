"""The page of the bench: the texts, drawings and buttons that fit a session now, and its live figures."""

from __future__ import annotations

import tomllib
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from mwdcal.bench import pictures
from mwdcal.bench.documents import FEWEST_STATIONS, Failure, asks_passphrase, signers_name
from mwdcal.bench.opening import FROM_REGISTRY, ToolPast
from mwdcal.bench.positions import ORDERED_ANGLES, Positions
from mwdcal.bench.session import RUN_PART, BenchSession
from mwdcal.bench.sources import LineSource
from mwdcal.bench.stream import TEMPERATURE_COLUMN
from mwdcal.errors import MwdcalError
from mwdcal.files.profiles import built_in
from mwdcal.geometry.observables import TITLES
from mwdcal.presentation.numbers import capital, fixed, number, quantity, signed
from mwdcal.presentation.text import one_line
from mwdcal.presentation.verification import noise_free, outcome_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from jinja2 import Environment

    from mwdcal.calibration.record import ErrorRow
    from mwdcal.use.verification import Verdict, VerdictRow

SHOWN_ANGLES = ("inclination", "toolface", "azimuth")
"""In the order in which a stand is set."""
LIVE_DECIMALS = {"inclination": 2, "toolface": 2, "azimuth": 2, "gravity": 5, "field": 0, "dip": 2}
LIVE_UNITS = {**dict.fromkeys((*ORDERED_ANGLES, "dip"), "°"), "gravity": " g", "field": " nT"}
LEAST_WARMING = 0.05
"""°C a minute below which no rate is shown."""
SHOWN_RECORDS = 12
"""Records of the past of a tool that are shown."""
STAND_REFERENCES = ("gravity_g", "field_nt", "dip_deg")
NOT_OF_RUNS = ("candidates", "roll-test")
"""Built-in plans that are not the plan of a run."""
FEWEST_PLAN = "fewest"
"""The plan of the fewest stations for an accuracy, in the form."""
BEST = ("best-12", "best-24", "best-48")
"""Plans that mwdcal chooses for the tool."""


@cache
def texts() -> dict[str, str]:
    """The texts of the page by key."""
    return tomllib.loads(files("mwdcal.bench").joinpath("texts.toml").read_text("utf-8"))


@cache
def environment() -> Environment:
    """The templates of the bench."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("mwdcal.bench"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip


def page(session: BenchSession, token: str, has_table: bool = False) -> str:
    """The whole page."""
    from markupsafe import Markup

    with session.lock:
        template = environment().get_template("page.html")
        return template.render(
            t=texts(),
            simulated=session.simulated,
            fragment=Markup(fragment(session, token, has_table)),
        )


def fragment(session: BenchSession, token: str, has_table: bool = False) -> str:
    """All of the page that decisions change; `has_table`: a table was dropped."""
    with session.lock:
        template = environment().get_template("main.html")
        return template.render(
            t=texts(), token=token, has_table=has_table, **_buttons(session), **_start_form(session), **_words(session),
            **_results(session), **_stations(session),
        )  # fmt: skip


def _buttons(session: BenchSession) -> dict[str, Any]:
    """The buttons and fields that the page offers now."""
    is_run = not session.testing and not session.calibrated
    measuring = not session.waiting and session.order is not None
    finished = "certificate" in session.papers
    some = bool(session.part.taken) and not finished
    channels = session.stream.channels
    return {
        "starting": not session.facts, "waiting": session.waiting, "auto": session.auto, "paused": session.paused,
        "manual": session.source == "manual", "position": session.order,
        "asks_temperature": measuring and channels != () and TEMPERATURE_COLUMN not in channels,
        "typed_temperature": "" if session.typed_temperature is None else f"{session.typed_temperature:g}",
        "can_undo": some and (is_run or session.testing),
        "can_repeat": some and session.testing and session.verdict is not None,
        "can_calibrate": is_run and session.fit.calibration is not None,
        "can_reopen": session.calibrated and not finished,
        "can_test": session.calibrated and not session.testing,
        "can_certify": session.verdict is not None and not finished,
        "signer": _signer(session),
        "asks_passphrase": session.countersign is not None and asks_passphrase(session.countersign),
        "can_enter": finished and not session.waits_for_signature and session.registry is not None
        and "registry" not in session.papers,
        "bad": bool(session.bad), "measuring": measuring, "passed": bool(session.verdict and session.verdict.passed),
    }  # fmt: skip


def _signer(session: BenchSession) -> str:
    """Whose key signs the certificate next; empty if nobody's does."""
    if session.countersign is None or not session.waits_for_signature:
        return ""
    try:
        return signers_name(session.countersign) or session.countersign.name
    except MwdcalError:
        return session.countersign.name


def _start_form(session: BenchSession) -> dict[str, Any]:
    """Fields of the start page, and the past of the laboratory's tools."""
    if session.facts:
        return {
            "serial": "",
            "plans": [],
            "profiles": [],
            "earth": [],
            "stand": [],
            "settings_used": "",
            "tools": [],
            "past": None,
            "chosen": "",
        }
    plans = [session.plan.name, *BEST, *(n for n in built_in("plans") if n not in NOT_OF_RUNS)]
    past = session.past
    shown = [(name, name) for name in dict.fromkeys(plans)]
    return {
        "serial": past.serial if past else "DEMO-1" if session.simulated else "",
        "chosen": past.serial if past else "", "plans": [shown[0], (FEWEST_PLAN, texts()["fewest"]), *shown[1:]],
        "profiles": _profiles(session), "past": _past(past),
        "earth": [
            (name, number(session.earth[name], 6) if name in session.earth else "") for name in STAND_REFERENCES
        ],
        "stand": stand_fields(session), "settings_used": capital(session.settings_used),
        "tools": [
            (tool.serial, tool.calibrated or "–", tool.next_due or "–", tool.status or "–")
            for tool in session.tools
        ],
    }  # fmt: skip


def stand_fields(session: BenchSession) -> list[tuple[str, str]]:
    """The 1σ of the stand by the tool profile that is shown first, in the order of a stand's angles."""
    known = session.past.profile if session.past and not session.simulated else None
    stand = (known or session.profile).stand
    return [(f"stand_{name}_deg", f"{stand.of(f'{name}_deg'):g}") for name in SHOWN_ANGLES]


def _profiles(session: BenchSession) -> list[tuple[str, str]]:
    """The tool profiles to choose from: that of the registry, that of the session, and the built-in ones."""
    if session.simulated:
        return []
    known = session.past.profile if session.past else None
    registry = (
        [(FROM_REGISTRY, texts()["profile_of_registry"].format(name=known.name))] if known else []
    )
    return [
        *registry,
        ("", session.profile.name),
        *((n, n) for n in built_in("profiles") if n != session.profile.name),
    ]


def _past(past: ToolPast | None) -> dict[str, Any] | None:
    """The past of the chosen tool: what is due, and its records."""
    if past is None:
        return None
    t = texts()
    shown = past.records[:SHOWN_RECORDS]
    rows = [
        ((each.time or "–")[:10], t.get(f"record_{each.kind}", each.kind), each.status or "–")
        for each in shown
    ]
    due = t["past_due"].format(day=past.next_due) if past.next_due else t["past_no_due"]
    return {
        "serial": past.serial,
        "due": due,
        "rows": [(time[:10], kind, status) for time, kind, status in rows],
    }


def _words(session: BenchSession) -> dict[str, Any]:
    """The result, the order, what is wrong, and the figures of the order."""
    order = None if session.waiting else session.order
    figures, drawing = [], ""
    if order is not None:
        angles = dict(zip(ORDERED_ANGLES, session.part.attitude(order), strict=True))
        drawing = pictures.attitude(session.part.attitude(order), texts()["attitude"])
        figures = [
            (name, f"{number(angles[name])}°", pictures.dial(name, angles[name]))
            for name in SHOWN_ANGLES
        ]
    heading, style = _heading(session)
    head = [
        session.profile.name,
        session.plan.name,
        session.facts.get("serial", ""),
        session.facts.get("operator", ""),
    ]
    return {
        "heading": heading, "heading_class": style, "order": _order_text(session), "note": _note(session),
        "figures": figures, "head": " · ".join(filter(None, head)), "drawing": drawing,
    }  # fmt: skip


def _heading(session: BenchSession) -> tuple[str, str]:
    """The result, if there is one, and how it is drawn."""
    t = texts()
    if session.verdict is not None:
        return verdict_heading(session.verdict)
    if session.calibrated:
        return t["calibrated"].format(serial=session.facts.get("serial", "")), ""
    return "", ""


def verdict_heading(verdict: Verdict) -> tuple[str, str]:
    """The verdict of a roll test, with the limits that it does not cover, and how it is drawn."""
    return outcome_of(verdict.passed, verdict.not_judged), "pass" if verdict.passed else "fail"


def _order_text(session: BenchSession) -> str:
    """Where to go, or what comes next."""
    t = texts()
    if session.waiting:
        return t["press_resume"] if session.facts else t["press_start"]
    if session.verdict is not None:
        if session.waits_for_signature:
            return t["next_signature"]
        if "certificate" in session.papers:
            return t["signed" if "signature" in session.papers else "finished"]
        if session.verdict.passed:
            return t["next_certificate"]
        return after_failure(session.failure, "next_failed")
    if session.calibrated and not session.testing:
        return t["next_rolltest"]
    if (order := session.order) is None:
        return t[_done_text(session)]
    part = session.part
    angles = zip(ORDERED_ANGLES, part.attitude(order), strict=True)
    turn = t["roll" if session.testing else "turn"].format(
        **{n: f"{number(v)}°" for n, v in angles}
    )
    soak = part.temperature(order)
    oven = f"{t['soak'].format(temperature=number(soak))} " if part.is_new_soak(order) else ""
    return f"{t['station']} {order + 1}. {oven}{turn}"


def after_failure(failure: Failure, advice: str) -> str:
    """The next step after a failed roll test: `advice` with the stations farthest off, or why none is named."""
    t, labels = texts(), [*failure.stations]
    if not labels:
        return t["next_missing"].format(reason=failure.missing)
    word = t["at_station" if len(labels) == 1 else "at_stations"]
    return t[advice].format(stations=word.format(labels=", ".join(labels)))


def _done_text(session: BenchSession) -> str:
    """The text that says what comes after the last station."""
    if session.is_fitting:
        return "fitting"
    if session.bad:
        return "measure_bad"
    return "all_measured" if session.fit.calibration is not None else "no_calibration"


def _note(session: BenchSession) -> str:
    """The latest message, else the stations that do not fit."""
    t = texts()
    if session.message:
        return session.message
    if session.testing:
        return session.failure.cause
    if session.bad:
        labels = [*session.bad]
        key = "bad_station" if len(labels) == 1 else "bad_stations"
        return t[key].format(labels=", ".join(labels))
    if (
        session.profile.has_magnetometer
        and session.stream.channels
        and "mx" not in session.stream.channels
    ):
        return t["no_magnetometer"]
    return t["paused"] if session.paused else ""


def _results(session: BenchSession) -> dict[str, Any]:
    """The accuracy so far, before and after, the verdict, and the documents."""
    t, fit, expected = texts(), session.fit, session.plan.accuracy_deg
    reason = (
        t["no_fit"].format(reason=fit.reason)
        if fit.reason
        else t["first_fit"].format(count=FEWEST_STATIONS)
    )
    latest = fit.accuracy_deg

    def degrees(value: float | None) -> str:
        return f"{number(value, 2)}°" if value else "–"

    shown = session.calibrated or session.order is None
    errors = fit.calibration.errors if fit.calibration and shown else []
    verdict = session.verdict.rows if session.verdict else []
    return {
        "fit_note": "" if fit.calibration else reason,
        "accuracy": [(n, degrees(latest[n]), degrees(expected.get(n))) for n in SHOWN_ANGLES if n in latest],
        "course": pictures.course(session.course, expected, session.parts[RUN_PART].count, t, t["accuracy"]),
        "errors": error_rows(errors), "limits": limit_rows(verdict),
        "found": limit_rows(session.as_found.rows if session.as_found else []),
        "found_passed": bool(session.as_found and session.as_found.passed),
        "papers": papers(session.papers, session.folder, session.pending),
    }  # fmt: skip


def error_rows(errors: Sequence[ErrorRow]) -> list[tuple[str, str, str]]:
    """Errors before and after, with their names."""
    return [
        (TITLES.get(row.observable, row.observable), quantity(row.before, row.unit), quantity(row.after, row.unit))
        for row in errors
    ]  # fmt: skip


def limit_rows(rows: Sequence[VerdictRow]) -> list[tuple[str, str, str, str, str, bool]]:
    """Values of a roll test, with their limits."""
    t = texts()
    return [
        (row.name, *noise_free(row, row.unit), quantity(row.limit, row.unit), t["ok" if row.passed else "bad"],
         row.passed)
        for row in rows
    ]  # fmt: skip


def papers(
    files_by_name: Mapping[str, str], folder: Path, pending: Sequence[str] = ()
) -> list[tuple[str, str]]:
    """Documents by name, with their file; those that are `pending` without."""
    t, shown = texts(), []
    for name, value in files_by_name.items():
        is_file = (folder / value).is_file()
        title = t.get(f"paper_{name}", name)
        shown.append((f"{title}: {one_line(value)}", value if is_file else ""))
    new = [name for name in pending if name not in files_by_name]
    return [*shown, *((f"{t[f'paper_{name}']}: {t['pending']}", "") for name in new)]


def _stations(session: BenchSession) -> dict[str, Any]:
    """The table and the picture of the stations, and the names of live figures."""
    part = session.part
    names = ["gravity", "field", "dip"] if session.profile.has_magnetometer else ["gravity"]
    bad = [int(label) - 1 for label in session.bad]
    return {
        "rows": [_row(session, part, position) for position in range(part.count)],
        "count": f"{len(part.done)} / {part.count}", "readings": [*names, "temperature"],
        "sphere": pictures.sphere(part, session.order, bad, texts()["sphere"]),
    }  # fmt: skip


def _row(session: BenchSession, part: Positions, position: int) -> dict[str, Any]:
    """A row of the table of stations."""
    t, label = texts(), str(position + 1)
    angles = dict(zip(ORDERED_ANGLES, part.attitude(position), strict=True))
    bad = session.bad.get(label, "")
    if bad and session.testing:
        bad = t["farthest"].format(limits=bad)
    judged = session.fit.calibration is not None and not session.testing
    states = (
        (bool(bad), bad),
        (position in part.again, t["again_due"]),
        (position in part.done, t["ok" if judged else "measured"]),
        (position in part.skipped, t["skipped"]),
        (position == session.order, t["next"]),
    )
    text = next((words for holds, words in states if holds), t["left"])
    return {
        "label": label, **{name: f"{number(angle)}°" for name, angle in angles.items()}, "text": text,
        "bad": bool(bad), "is_next": position == session.order,
    }  # fmt: skip


def live(session: BenchSession, source: LineSource) -> dict[str, Any]:
    """Figures that change all the time, as text by name."""
    with session.lock:
        values, away = session.live(), session.away
        settling, channels, warmth = session.settling, session.stream.channels, session.warmth
        state = settling.state if settling else "waiting"
        result: dict[str, Any] = {
            "state": "moving" if away else state, "source": _source_text(session, source),
            "state_text": _state_text(session, state, away),
            "still_note": texts()["wanders"] if state == "settled" and settling and settling.wanders else "",
            "ready": state == "settled" and not session.waiting and session.order is not None,
        }  # fmt: skip
    for name in LIVE_DECIMALS:
        value = values.get(name, float("nan"))
        shown = fixed(value, LIVE_DECIMALS[name]) + LIVE_UNITS[name] if value == value else "–"
        result[name if name in ORDERED_ANGLES else f"live_{name}"] = shown
        if name in ORDERED_ANGLES and value == value:
            result[f"turn_{name}"] = round(180 - value if name == "inclination" else value, 1)
    if TEMPERATURE_COLUMN in channels:
        rate = warmth.rate
        changing = rate is not None and abs(rate) >= LEAST_WARMING
        words = f" ({signed(rate, 1)} °C/min)" if changing else ""
        result["live_temperature"] = f"{fixed(warmth.value, 1)} °C{words}"
    return result


def _state_text(session: BenchSession, state: str, away: str) -> str:
    """Whether the tool stands still where it was ordered."""
    t = texts()
    if session.source == "manual":
        return t["type_readings"]
    if state == "waiting" or session.settling is None:
        return t["learning"] if session.stream.garbage else t["wait_source"]
    left = f": {fixed(session.settling.seconds_left, 0)} s" if state == "settling" else ""
    text = t[state] + left
    if away == "not_warm" and (minutes := session.warmth.minutes_left) is not None:
        return f"{text} – {t['warm_in'].format(minutes=number(max(minutes, 1.0), 2))}"
    before = session.station_before
    station = before[1].position + 1 if before else ""
    return f"{text} – {t[away].format(station=station)}" if away else text


def _source_text(session: BenchSession, source: LineSource) -> str:
    """The source and what is wrong with it."""
    t, parts = texts(), [source.note or session.source]
    if source.drops:
        parts.append(t["drops"].format(count=source.drops))
    if session.stream.garbage:
        parts.append(t["garbage"].format(count=session.stream.garbage))
    return " · ".join(parts)
