"""A calibration session: the order of the day, and what each accepted station tells.

The events of the journal make the state: it is the same after a restart as before. All files of the folder are those
that the commands make and take.
"""

from __future__ import annotations

import contextvars
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path
from threading import Lock, RLock
from time import monotonic
from typing import TYPE_CHECKING, Any

import numpy as np

from mwdcal.bench import documents, opening
from mwdcal.bench.attitude import has_turned, is_near, live_values
from mwdcal.bench.journal import Event, Journal
from mwdcal.bench.positions import PLAN_COLUMNS, Positions, SessionPlan, TakenStation, measured_rows
from mwdcal.bench.settling import Settling, Standstill
from mwdcal.bench.stream import TEMPERATURE_COLUMN, TIME_COLUMN, Stream
from mwdcal.bench.warmth import Warmth
from mwdcal.errors import InputError, MwdcalError
from mwdcal.files.contract import CHANNELS
from mwdcal.files.formats import atomic
from mwdcal.files.formats import table as tables
from mwdcal.sensor.profile import StreamForm

if TYPE_CHECKING:
    from mwdcal.sensor.profile import Profile
    from mwdcal.use.verification import Verdict

RUN_PART, ROLLTEST_PART = "run", "rolltest"
NOISE_SHARE = 2e-5
"""Noise of a sample, as a share of the strength of gravity or field, below which none is believed."""
PRESSED_AGAIN = 1.0, 60.0
"""Seconds after which, and before which, a second press means that it is meant: a pedal bounces sooner."""
WARM_C = 3.0
"""The tool's temperature is farther from that of the order: the oven is not there."""


class BenchSession:
    """One tool at one stand. Its methods may be called from several threads.

    `options` is what the bench was opened with, for the journal; `tools` are those of the registry; `countersign` is
    the private key with which a second person signs the certificate; `on_change` is called when `version` has grown,
    `settings_used` says what was taken from the laboratory's settings.
    """

    def __init__(
        self, folder: Path, profile: Profile, plan: SessionPlan, rolltest: SessionPlan, *,
        window: float = 5.0, registry: str | None = None, laboratory: Path | None = None,
        countersign: Path | None = None, earth: Mapping[str, float] | None = None,
        options: Mapping[str, Any] | None = None, tools: Sequence[Any] = (),
    ) -> None:  # fmt: skip
        self.folder, self.profile, self.plan = folder, profile, plan
        self.registry, self.laboratory, self.countersign = registry, laboratory, countersign
        self.options = dict(options or {})
        self.past: opening.ToolPast | None = None
        self.source = str(self.options.get("source", "manual"))
        self.settings_used = ""
        self.tools, self.earth = tools, dict(earth or {})
        self.lock, self._starting = RLock(), Lock()
        self.parts = {
            RUN_PART: Positions(RUN_PART, plan.columns),
            ROLLTEST_PART: Positions(ROLLTEST_PART, rolltest.columns),
        }
        self.stream = Stream(profile.stream if isinstance(profile.stream, StreamForm) else None)
        self.window, self.warmth = window, Warmth()
        self.settling: Settling | None = None
        self.sample: tuple[float, ...] = ()
        self.facts: dict[str, Any] = {}
        self.auto = self.paused = self.calibrated = self.testing = False
        self.typed_temperature: float | None = None
        self.attempts, self.version, self.message = 0, 0, ""
        self.on_change: Callable[[], object] = lambda: None
        self.fit = documents.RunFit()
        self.verdict: Verdict | None = None
        self.as_found: Verdict | None = None
        self.failure = documents.Failure()
        self.papers: dict[str, str] = {}
        self.pending: list[str] = []
        self.course: list[tuple[int, dict[str, float | None]]] = []
        self._used: tuple[int, int] = (-1, -1)
        self._agreed = 0
        self._question: tuple[object, float] = (None, 0.0)
        self._requested = self._fitted = 0
        self._unwritten = False
        self._pool, self._context = ThreadPoolExecutor(1), contextvars.copy_context()
        self.journal = Journal(folder)
        for event in self.journal.events:
            self._apply(event)
        self.waiting = True
        if self.facts:
            self._refit()
        if "certificate" in self.papers:
            self._draw_certificate()

    @property
    def simulated(self) -> bool:
        """Whether the readings are simulated."""
        return self.source == "demo"

    # ------------------------------------------------------------------ what has happened

    def _record(self, kind: str, **facts: Any) -> None:
        """Write an event, then let it happen."""
        event: Event = {"event": kind, "at": datetime.now().astimezone().isoformat(), **facts}
        self.journal.add(event)
        self._apply(event)
        self._change()

    def _change(self) -> None:
        """Tell who watches that the page is another one."""
        self.version += 1
        self.on_change()

    def _apply(self, event: Event) -> None:
        """Let an event happen, now or again after a restart."""
        kind = event["event"]
        part = self.parts[event.get("part", RUN_PART)]
        if part.name == ROLLTEST_PART:
            self._forget_verdict()
        if kind == "started":
            plan = SessionPlan(**event["plan"])
            self.plan, self.facts = plan, dict(event["facts"])
            self.earth |= event["earth"]
            self.parts[RUN_PART] = Positions(RUN_PART, plan.columns)
        elif kind == "station":
            position, row = event["position"], event["row"]
            part.accept(TakenStation(position, row, event.get("samples", {})))
            self._agreed += 1 if self._is_near(part, position, row) else -1
            self.attempts += 1
        elif kind == "undone":
            part.undo()
        elif kind == "again":
            part.measure_again(event["positions"])
        elif kind == "skipped":
            part.skip(event["position"])
        elif kind == "cleared":
            part.clear()
            self.papers.pop("verification", None)
        else:
            self._switch(kind, event)

    def _switch(self, kind: str, event: Event) -> None:
        """Let an event happen that is not of a station."""
        if kind in ("auto", "paused"):
            setattr(self, kind, bool(event["on"]))
        elif kind in ("calibrated", "testing"):
            setattr(self, kind, True)
        elif kind == "reopened":
            self.calibrated = self.testing = False
            self.papers = {}
            self._forget_verdict()
        elif kind == "temperature":
            self.typed_temperature = event["value"]
        elif kind == "papers":
            self.papers |= event["files"]

    def _forget_verdict(self) -> None:
        self.verdict = self.as_found = None
        self.failure = documents.Failure()

    @property
    def part(self) -> Positions:
        """The part that is being measured."""
        return self.parts[ROLLTEST_PART if self.testing else RUN_PART]

    @property
    def order(self) -> int | None:
        """The position to go to; None while there is none."""
        if not self.facts or (self.calibrated and not self.testing):
            return None
        return self.part.order

    # ------------------------------------------------------------------ the stream

    def line(self, time: float, line: str) -> None:
        """Take a line of the stream; never raises for what it holds."""
        with self.lock:
            sample = self.stream.take(line)
            if sample is None:
                return
            now = time if sample.time is None else sample.time
            self.sample = sample.values
            if self.settling is None:
                self.settling = self._new_settling()
                self._change()
            self.settling.take(now, sample.values)
            if TEMPERATURE_COLUMN in self.stream.channels:
                self.warmth.take(now, self.raw[TEMPERATURE_COLUMN])
            if self._ready_by_itself():
                try:
                    self.accept()
                except MwdcalError as error:
                    self.say(str(error))

    @property
    def raw(self) -> dict[str, float]:
        """The latest sample by channel."""
        return dict(zip(self.stream.channels, self.sample, strict=False))

    def _new_settling(self) -> Settling:
        """The judge of standstills, for the sensors in the stream."""
        raw, least = self.raw, []
        for names in CHANNELS.values():
            strength = float(np.linalg.norm([raw[name] for name in names if name in raw]))
            least += [NOISE_SHARE * strength for name in names if name in raw]
        return Settling(len(least), self.window, least)

    def _ready_by_itself(self) -> bool:
        return (
            self.auto and not self.paused and not self.waiting and self.order is not None
            and self.settling is not None and self.settling.state == "settled"
            and self.settling.moves != self._used[0] and not self.away
        )  # fmt: skip

    @property
    def away(self) -> str:
        """Why the tool is not where it was ordered: "not_there", "not_turned", "not_warm"; empty if it is."""
        order = self.order
        if order is None or not self.sample:
            return ""
        ordered, known = self.part.temperature(order), self.temperature
        is_cold = None not in (ordered, known) and abs((known or 0) - (ordered or 0)) > WARM_C
        if is_cold or (ordered is not None and not self.warmth.is_steady):
            return "not_warm"
        return self._doubt(order, self.reading)

    def _doubt(self, order: int, reading: Mapping[str, float]) -> str:
        """Why a reading is hardly that of a position: "not_turned", "not_there"; empty if it may be."""
        part, before = self.part, self.station_before
        if before is not None:
            other = before[0].attitude(before[1].position)
            ends = part.attitude(order), other
            if not has_turned(
                reading, before[1].row, self.profile, ends, self.earth.get("dip_deg")
            ):
                return "not_turned"
        return "" if self._is_plausible(order, reading) else "not_there"

    def _is_plausible(self, position: int, reading: Mapping[str, float]) -> bool:
        """Whether a reading may be that of a position. Nominal scales that most stations contradict do not judge."""
        return self._agreed < 0 or self._is_near(self.part, position, reading)

    def _is_near(self, part: Positions, position: int, reading: Mapping[str, Any]) -> bool:
        """Whether a reading is about that of a position, by the nominal calibration."""
        return is_near(reading, self.profile, part.attitude(position), self.earth.get("dip_deg"))

    @property
    def station_before(self) -> tuple[Positions, TakenStation] | None:
        """The latest station, with its part; None before the first."""
        both = (self.part, self.parts[RUN_PART])
        return next(((part, part.taken[-1]) for part in both if part.taken), None)

    @property
    def reading(self) -> dict[str, float]:
        """The standstill by channel once the tool has settled, else the latest sample."""
        settling = self.settling
        if settling is None or settling.state != "settled":
            return self.raw
        return dict(zip(self.stream.channels, settling.means, strict=False))

    @property
    def temperature(self) -> float | None:
        """The tool's temperature, °C: that of the stream, else what was typed."""
        return self.raw.get(TEMPERATURE_COLUMN, self.typed_temperature)

    def live(self) -> dict[str, float]:
        """Angles in degrees and strengths of the latest sample by the nominal scales."""
        return live_values(self.raw, self.profile) if self.sample else {}

    # ------------------------------------------------------------------ decisions

    def choose(self, serial: str) -> None:
        """Show the past of a tool of the registry, and take its serial and profile for the start."""
        past = opening.past_of(self.registry, serial)
        with self.lock:
            self._check_new()
            self.past = past
            self._change()

    def _check_new(self) -> None:
        if self.facts:
            raise InputError("the session has begun already.")

    def _chosen_plan(self, profile: Profile, name: str, file: tuple[str, str]) -> SessionPlan:
        """The plan of a name, or one from a file, by its name and text."""
        if file[1]:
            return opening.plan_of_text(self.folder, *file, profile)
        is_other = name not in ("", self.plan.name) or profile is not self.profile
        return opening.session_plan(profile, name or self.plan.name) if is_other else self.plan

    def start(
        self, serial: str, operator: str = "", plan: str = "", earth: Mapping[str, float | None] | None = None, *,
        tool: str = "", tool_text: str = "", plan_file: tuple[str, str] = ("", ""),
        stand: Mapping[str, float] | None = None,
    ) -> None:  # fmt: skip
        """Begin: the tool's serial, who measures, the plan, and gravity, field and dip where they are known.

        `tool` is another profile by its name, `tool_text` the text of one, `plan_file` name and text of a plan, `stand`
        other 1σ of the stand than those of the profile.
        """
        if not (serial := serial.strip()):
            raise InputError(
                "the serial of the tool is missing. Every document names the tool by it: type it."
            )
        with self._starting:
            self._check_new()
            profile = self.profile
            if self.simulated:
                tool = tool_text = ""
            if is_other := bool(tool or tool_text or stand):
                profile, data = opening.chosen_profile(
                    self.folder, tool, tool_text, self.past, stand or {}
                )
            chosen = self._chosen_plan(profile, plan, plan_file)
            opening.keep_previous(self.folder, self.registry, serial, self.simulated)
            if is_other:
                atomic.write(self.folder / opening.TOOL_FILE, data)
            self._begin(serial, operator, earth or {}, profile, chosen)

    def _begin(
        self, serial: str, operator: str, earth: Mapping[str, float | None], profile: Profile, chosen: SessionPlan
    ) -> None:  # fmt: skip
        """Begin with a tool and a plan."""
        with self.lock:
            if profile.stream != self.profile.stream:
                self.settling = None
                self.stream = Stream(
                    profile.stream if isinstance(profile.stream, StreamForm) else None
                )
            self.profile = profile
            facts = {"serial": serial, "date": datetime.now().date().isoformat()}
            facts |= {"operator": operator.strip()} if operator.strip() else {}
            facts |= {"plan": chosen.name} if chosen.name else {}
            stated: dict[str, Any] = {**facts, "simulated": True} if self.simulated else {**facts}
            self._record(
                "started", facts=stated, earth={k: v for k, v in earth.items() if v is not None},
                plan={"name": chosen.name, "columns": chosen.columns, "accuracy_deg": chosen.accuracy_deg},
                options=self.options,
            )  # fmt: skip
            self.waiting = False

    def resume(self) -> None:
        """Go on after a restart."""
        with self.lock:
            if not self.facts:
                raise InputError("the session has not begun. Press Start.")
            self.waiting = False
            self._change()

    def accept(self, position: int | None = None) -> None:
        """Take the standstill as the station that is asked for; `position`: the one that the page has shown."""
        with self.lock:
            order = self._expected(position)
            settling, attitude = self.settling, self.part.attitude(order)
            if settling is None or settling.state != "settled":
                raise InputError("the tool does not stand still yet. Wait until it has settled.")
            moves, place = self._used
            if settling.moves == moves and self.part.attitude(place) != attitude:
                raise InputError(
                    f"the tool has not moved since station {place + 1}. Move it to the next position."
                )
            samples = _samples(settling.station(), self.stream.channels)
            row = _measured(samples, self.reading)
            doubt = self._doubt(order, row)
            self._ask({order: doubt}, settling.moves)
            self._take(order, row, doubt, samples)
            self._used = settling.moves, order

    def accept_typed(
        self, rows: Sequence[Mapping[str, float]], position: int | None = None
    ) -> None:
        """Take readings by hand as the stations that are asked for, one after the other."""
        with self.lock:
            self._expected(position)
            if len(rows) > (many := len(self.part.open_positions)):
                raise InputError(
                    f"{len(rows)} readings, but only {many} positions are left. Paste fewer."
                )
            positions = self.part.open_positions[: len(rows)]
            pairs = [*zip(positions, rows, strict=True)]
            doubts = {positions[0]: self._doubt(*pairs[0])} if pairs else {}
            for place, row in pairs[1:]:
                doubts[place] = "" if self._is_plausible(place, row) else "not_there"
            self._ask(doubts, rows)
            for row in rows:
                place = self._expected(None)
                self._take(place, {"samples": 1.0, **row}, doubts.get(place, ""))

    def _ask(self, doubts: Mapping[int, str], reading: object) -> None:
        """Refuse readings that are hardly those of their positions, unless the same are pressed a second time."""
        doubtful = [place for place, doubt in doubts.items() if doubt]
        if not doubtful:
            return
        (soon, late), (question, since), now = PRESSED_AGAIN, self._question, monotonic()
        is_new = question != (doubts, reading) or now - since > late
        if not is_new and now - since > soon:
            return
        if is_new:
            self._question = ((doubts, reading), now)
        names, before = ", ".join(str(place + 1) for place in doubtful), self.station_before
        if before is not None and doubts[doubtful[0]] == "not_turned":
            raise InputError(
                f"the tool still stands at station {before[1].position + 1}. Turn it to station {names}, or press "
                "again to take it as it is."
            )
        raise InputError(
            f"the tool is not at station {names} by its nominal calibration. Check inclination, toolface and azimuth, "
            "or press again to take it as it is."
        )

    def _expected(self, position: int | None) -> int:
        """The position that is asked for, which must be the one that the page has shown."""
        if self.waiting:
            raise InputError("the session waits. Press Start or Resume first.")
        if (order := self.order) is None:
            raise InputError("no station is asked for: all are measured. Press Re-measure for one.")
        if position is not None and position != order:
            raise InputError(
                f"the page has shown station {position + 1}; station {order + 1} is next. Try again."
            )
        return order

    def _take(
        self, order: int, measured: Mapping[str, Any], doubt: str, samples: Mapping[str, Any] | None = None
    ) -> None:  # fmt: skip
        """Take a station; its row holds what the plan and the stand state, and what was measured.

        The journal keeps the `samples` of the standstill, and a `doubt` in spite of which the operator took it.
        """
        part = self.part
        row = {"station": str(order + 1), **measured}
        if TEMPERATURE_COLUMN not in row and self.typed_temperature is not None:
            row[TEMPERATURE_COLUMN] = self.typed_temperature
        row |= {name: part.columns[name][order] for name in PLAN_COLUMNS[:3]}
        row |= {f"ref_{name}": value for name, value in self.earth.items()}
        more = {name: value for name, value in (("doubt", doubt), ("samples", samples)) if value}
        self._record("station", part=part.name, position=order, row=row, **more)
        self.message = ""
        self._refit()

    def undo(self) -> None:
        """Take the last station back."""
        with self.lock:
            self._check_open()
            if not self.part.taken:
                raise InputError("there is no station to take back.")
            self._record("undone", part=self.part.name)
            self._used = (-1, -1)
            self._refit()

    def measure_again(self, position: int | None = None) -> None:
        """Ask for stations again: the one named, else all bad ones, else the last."""
        with self.lock:
            self._check_open()
            part, done = self.part, self.part.done
            bad = [int(label) - 1 for label in self.bad]
            wanted = [position] if position is not None else bad or [*done][-1:]
            wanted = [each for each in wanted if each in done and each not in part.again]
            if not wanted:
                raise InputError(
                    "there is no station to measure again, or it is asked for already."
                )
            self._record("again", part=part.name, positions=wanted)

    def skip(self) -> None:
        """Leave a position out."""
        with self.lock:
            self._record("skipped", part=self.part.name, position=self._expected(None))
            self._refit()

    def switch(self, name: str, on: bool) -> None:
        """Turn "auto", accept when settled, or "paused" on or off."""
        with self.lock:
            self._record(name, on=on)

    def state_temperature(self, value: float) -> None:
        """State the tool's temperature, where the stream has none."""
        with self.lock:
            self._record("temperature", value=value)

    def _check_open(self) -> None:
        """Refuse to change what is done."""
        if self.calibrated and not self.testing:
            raise InputError("the run is calibrated. Press Back to the run to change its stations.")
        if "certificate" in self.papers:
            raise InputError("the certificate is issued: this session is over. Begin another one.")

    def reopen(self) -> None:
        """Go back to the run after its calibration. The roll test stays, and is judged by the next calibration."""
        with self.lock:
            if "certificate" in self.papers:
                self._check_open()
            self._record("reopened")
            self._refit()

    def repeat_rolltest(self) -> None:
        """Measure the roll test again from its beginning."""
        with self.lock:
            self._check_open()
            if not self.testing:
                raise InputError("there is no roll test to measure again.")
            self._record("cleared", part=ROLLTEST_PART)
            self._used = (-1, -1)
            self._refit()

    # ------------------------------------------------------------------ results

    @property
    def bad(self) -> dict[str, str]:
        """The problem of each bad station of the part, by label, but for those asked for again.

        Stations of the run that do not fit, or those of a failed roll test that are farthest off.
        """
        again, suspects = self.part.again, self.failure.stations if self.testing else self.fit.bad
        named = sorted(suspects.items(), key=lambda item: int(item[0]))
        return {label: text for label, text in named if int(label) - 1 not in again}

    def _write_tables(self) -> None:
        """Write the run files from the events. The stations are in the journal already: a full disk loses none."""
        with self.lock:
            parts = [replace(part, taken=[*part.taken]) for part in self.parts.values()]
            self._unwritten = False
        try:
            earlier: list[TakenStation] = []
            for part in parts:
                path = self.folder / f"{part.name}.csv"
                if part.taken:
                    tables.write(path, part.table(self.facts, earlier))
                    earlier = [*part.done.values()]
                else:
                    path.unlink(missing_ok=True)
        except (MwdcalError, OSError) as error:
            self._unwritten = True
            self.say(f"{error} The station is safe in session.jsonl.")

    def _refit(self) -> None:
        """Write the run files, and fit what there is, beside the stream."""
        self._unwritten = True
        self._requested += 1
        task = self._judge if self.testing else self._fit_run
        self._submit(partial(self._if_latest, self._requested, task))

    def _if_latest(self, number: int, task: Callable[[], None]) -> None:
        """Leave a fit out if a later one is requested already."""
        if number == self._requested:
            try:
                task()
            finally:
                self._fitted = number

    @property
    def is_fitting(self) -> bool:
        """Whether a fit is still to come that knows the latest station."""
        return self._fitted != self._requested

    def _submit(self, task: Callable[[], None], *papers: str) -> None:
        """Have a task done beside the stream; `papers` are pending until then."""
        self.pending += papers
        self._pool.submit(self._context.copy().run, self._guarded, task, papers)

    def _guarded(self, task: Callable[[], None], papers: Sequence[str]) -> None:
        """Do a task; what goes wrong is shown, and the session goes on."""
        try:
            if self._unwritten:
                self._write_tables()
            task()
        except MwdcalError as error:
            self.say(str(error))
        except Exception as error:  # the session must go on
            self.say(
                f"internal error ({type(error).__name__}: {error}). Nothing accepted is lost; please report it."
            )
        with self.lock:
            for name in papers:
                self.pending.remove(name)
            self._change()

    def say(self, message: str) -> None:
        """Show a message on the page."""
        with self.lock:
            if message != self.message:
                self.message = message
                self._change()

    def wait_for_fits(self) -> None:
        """Wait until all that was requested is done, and what that has requested."""
        for _ in range(3):
            self._pool.submit(lambda: None).result()

    def _fit_run(self) -> None:
        count = len(self.parts[RUN_PART].done)
        fit = documents.fit(self.folder, count)
        with self.lock:
            self.fit = fit
            if fit.calibration is not None:
                self.course = [point for point in self.course if point[0] != count]
                self.course.append((count, fit.accuracy_deg))

    def calibrate(self) -> None:
        """Write the calibration of the run and its report."""
        with self.lock:
            if (count := len(self.parts[RUN_PART].done)) < documents.FEWEST_STATIONS:
                raise InputError(
                    f"a calibration needs {documents.FEWEST_STATIONS} stations at least, got {count}. Measure more."
                )
            if self.calibrated:
                raise InputError("the run is calibrated already.")
            self._submit(self._calibrate)

    def _calibrate(self) -> None:
        fit = documents.fit(self.folder, len(self.parts[RUN_PART].done))
        if fit.calibration is None:
            raise InputError(fit.reason)
        files = documents.save_calibration(fit.calibration, self.folder)
        with self.lock:
            self.fit = fit
            if not self.calibrated:
                self._record("papers", files=files)
                self._record("calibrated")
        self._submit(partial(self._draw, fit.calibration, "report"), "report_html")

    def _draw(self, result: object, name: str) -> None:
        """Write the page of a result, which takes longer than the result."""
        files = documents.draw(result, self.folder, name)
        with self.lock:
            if not files.items() <= self.papers.items():
                self._record("papers", files=files)

    def start_rolltest(self) -> None:
        """Go on to the roll test. One measured before the run was changed is judged at once."""
        with self.lock:
            if not self.calibrated:
                raise InputError("the roll test needs the calibration. Press Calibrate first.")
            if not self.testing:
                self._record("testing")
                self._refit()

    def _judge(self) -> None:
        """The verdict of the roll test, once all its stations are there."""
        if self.fit.calibration is None:
            self.fit = documents.saved_fit(self.folder)
        part, calibration = self.parts[ROLLTEST_PART], self.fit.calibration
        if calibration is None or part.order is not None or not part.taken:
            with self.lock:
                self._forget_verdict()
            return
        verdict, files = documents.verify(calibration, self.folder)
        before, failure = self._judge_as_found(), documents.Failure()
        if not verdict.passed:
            failure = documents.failure(verdict, calibration, self.folder / "rolltest.csv")
        with self.lock:
            if part.open_positions:  # asked for again meanwhile
                return
            self.verdict, self.as_found, self.failure = verdict, before, failure
            if not files.items() <= self.papers.items():
                self._record("papers", files=files)
        self._submit(partial(self._draw, verdict, "rolltest"), "rolltest_html")

    def _judge_as_found(self) -> Verdict | None:
        """The verdict by the calibration before, if there is one that can judge."""
        try:
            return documents.judge_as_found(self.folder)
        except MwdcalError as error:
            self.say(f"no result as found: {error}")
            return None

    def certify(self, number: str = "") -> None:
        """Issue the certificate, and enter all in the registry, where one is named."""
        with self.lock:
            if self.verdict is None:
                raise InputError("the certificate needs the roll test. Measure it first.")
            if "certificate" in self.papers:
                raise InputError("the certificate is issued already.")
            if self.is_fitting:
                raise InputError("the roll test is being judged. Try again in a moment.")
            self._record("papers", files=documents.certify(self.folder, number, self.laboratory))
            if self.countersign is None:
                self._enter()
            self._draw_certificate()

    def _draw_certificate(self) -> None:
        """Write the certificate as a page and as a PDF, which take longer than the certificate."""
        for kind in ("html", "pdf"):
            if (name := f"certificate_{kind}") not in self.papers:
                self._submit(partial(self._draw_form, kind), name)

    def _draw_form(self, kind: str, **signing: Any) -> None:
        files = documents.draw_certificate(self.folder, self.laboratory, kind, **signing)
        with self.lock:
            self._record("papers", files=files)

    @property
    def waits_for_signature(self) -> bool:
        """Whether a second person has still to sign the certificate."""
        return (
            self.countersign is not None
            and "certificate" in self.papers
            and "signature" not in self.papers
        )

    def sign(self, passphrase: str = "") -> None:
        """Sign the certificate with the key of a second person, and enter all in the registry."""
        with self.lock:
            if self.countersign is None or not self.waits_for_signature:
                raise InputError("there is no certificate that waits for a signature.")
            who = documents.countersign(
                self.folder, self.countersign, passphrase, self.facts.get("operator", "")
            )
            self._record("papers", files={"signature": who})
            self._enter()
            signing = {"private_key": self.countersign, "passphrase": passphrase}
            self._submit(partial(self._draw_form, "pdf", **signing))

    def enter(self) -> None:
        """Enter all in the registry, where that failed before."""
        with self.lock:
            if (
                self.registry is None
                or "certificate" not in self.papers
                or self.waits_for_signature
            ):
                raise InputError("there is nothing to enter, or no registry is named.")
            self._enter()

    def _enter(self) -> None:
        if self.registry is not None:
            self._submit(partial(self._add_to, self.registry), "registry")

    def _add_to(self, registry: str) -> None:
        text = documents.enter(self.folder, registry)
        with self.lock:
            self._record("papers", files={"registry": text})

    def close(self) -> None:
        """End: what is written stays."""
        self._pool.shutdown(wait=True)
        self.journal.close()


def _samples(still: Standstill, channels: Sequence[str]) -> dict[str, Any]:
    """A standstill as the journal holds it."""
    columns = zip(channels, still.samples.T.tolist(), strict=True)
    steps = dict(
        zip([name for name in channels if name != TEMPERATURE_COLUMN], still.steps, strict=True)
    )
    return {TIME_COLUMN: still.time.tolist(), **dict(columns), "steps": steps}


def _measured(samples: Mapping[str, Any], reading: Mapping[str, float]) -> dict[str, Any]:
    """Cells of the run file of a standstill alone, with its mean `reading`."""
    [row] = measured_rows([TakenStation(0, dict(reading), samples)])
    time = samples[TIME_COLUMN]
    return row | {"samples": float(len(time)), "start_s": time[0], "end_s": time[-1]}
