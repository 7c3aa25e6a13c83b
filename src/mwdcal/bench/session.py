"""A calibration session: the order of the day, and what each accepted station tells.

The state is what the events of the journal make of it: the same after a restart as before. All files of the folder are those
that the commands make and take.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING, Any

import numpy as np

import mwdcal
from mwdcal.bench.journal import Event, Journal
from mwdcal.bench.settling import Settling, Standstill
from mwdcal.bench.stream import TEMPERATURE, Stream
from mwdcal.errors import InputError, MwdcalError
from mwdcal.files.formats import table as tables
from mwdcal.files.formats.table import Table
from mwdcal.files.runs import to_nominal
from mwdcal.geometry.observables import OBSERVABLES
from mwdcal.geometry.vectors import Array, reference_vectors

if TYPE_CHECKING:
    from mwdcal.calibration.record import Calibration
    from mwdcal.sensor.profile import Profile

RUN, ROLLTEST = "run", "rolltest"
ANGLES = ("inclination", "azimuth", "toolface")
FAR_DEG, FAR_FIELD_DEG = 10.0, 30.0
"""Nominal gravity, and nominal field, farther from those of the order: the tool is not there."""
FEWEST = 8
"""Stations before which no fit is tried."""
LEAST = {"accelerometer": 2e-5, "magnetometer": 1.0}
"""Noise of a sample, g and nT, below which none is believed."""
RESHOOT = "reshoot"
"""The finding that names a station to measure again."""
HISTORY = 120.0
"""Seconds of which the temperature's course is looked at."""


@dataclass(frozen=True)
class Station:
    """An accepted station: its position in the plan from 0, and its row of the run file."""

    position: int
    row: Mapping[str, Any]


@dataclass
class Part:
    """The run, or the roll test: the positions of a plan and what was measured at them."""

    plan: Mapping[str, Any]
    name: str
    stations: list[Station] = field(default_factory=list)
    again: list[int] = field(default_factory=list)
    skipped: set[int] = field(default_factory=set)

    @property
    def count(self) -> int:
        """Positions of the plan."""
        return len(self.plan["ref_inclination_deg"])

    @property
    def done(self) -> dict[int, Station]:
        """Stations by position."""
        return {station.position: station for station in self.stations}

    @property
    def order(self) -> int | None:
        """The position to go to; None where all is measured."""
        if self.again:
            return self.again[0]
        done = self.done
        return next((i for i in range(self.count) if i not in done and i not in self.skipped), None)

    def attitude(self, position: int) -> tuple[float, float, float]:
        """Inclination, azimuth and toolface of a position, degrees; what the plan does not state is 0."""
        values = (float(self.plan[f"ref_{name}_deg"][position]) for name in ANGLES)
        inclination, azimuth, toolface = (0.0 if v != v else v for v in values)
        return inclination, azimuth, toolface

    def temperature(self, position: int) -> float | None:
        """The oven's temperature at a position, °C; None where the plan states none."""
        values = self.plan.get(TEMPERATURE)
        value = float("nan") if values is None else float(values[position])
        return value if value == value else None

    def is_new_soak(self, position: int) -> bool:
        """Whether the oven has to be set before a position: the station before had another temperature, if any."""
        now = self.temperature(position)
        before = self.temperature(self.stations[-1].position) if self.stations else None
        several = {self.temperature(i) for i in range(self.count)}
        return now is not None and now != before and len(several) > 1

    def accept(self, station: Station) -> None:
        """Take a station; one that was measured before gives way."""
        self.stations = [s for s in self.stations if s.position != station.position] + [station]
        self.again = [position for position in self.again if position != station.position]
        self.skipped.discard(station.position)

    def table(self, facts: Mapping[str, Any]) -> Table:
        """The run file, in the order of measurement."""
        names = list(dict.fromkeys(name for station in self.stations for name in station.row))
        columns: dict[str, Any] = {}
        for name in names:
            cells = [station.row.get(name) for station in self.stations]
            labels = any(isinstance(cell, str) for cell in cells)
            columns[name] = (
                [str(c or "") for c in cells] if labels else np.array(cells, dtype=float)
            )
        return Table(columns, facts, f"{self.name}.csv")


@dataclass(frozen=True)
class Fit:
    """What the stations so far tell: a calibration, or why there is none yet."""

    stations: int
    calibration: Calibration | None = None
    reason: str = ""

    @property
    def bad(self) -> dict[str, str]:
        """What is wrong with stations, by label."""
        found = self.calibration.findings if self.calibration else []
        return {
            str(each.station): each.text for each in found if each.id == RESHOOT and each.station
        }


class Session:
    """One tool at one stand. Its methods may be called from several threads."""

    def __init__(
        self, folder: Path, profile: Profile, plans: Mapping[str, Mapping[str, Any]], *,
        source: str = "manual", window: float = 5.0, registry: Path | str | None = None,
        laboratory: Path | None = None, earth: Mapping[str, float] | None = None,
        simulated: bool = False, plan_name: str = "", expected: Mapping[str, float | None] | None = None,
    ) -> None:  # fmt: skip
        self.folder, self.profile, self.source, self.registry = folder, profile, source, registry
        self.laboratory, self.simulated, self.plan_name = laboratory, simulated, plan_name
        self.earth, self.expected = dict(earth or {}), dict(expected or {})
        self.lock = RLock()
        self.parts = {name: Part(plan, name) for name, plan in plans.items()}
        self.stream = Stream(None if not hasattr(profile.stream, "columns") else profile.stream)
        self.window = window
        self.settling: Settling | None = None
        self.sample: tuple[float, ...] = ()
        self.warmth: list[tuple[float, float]] = []
        self.facts: dict[str, Any] = {}
        self.auto = self.paused = False
        self.calibrated = self.testing = False
        self.attempts = 0
        self.version = 0
        self.message = ""
        self.fit, self.verdict = Fit(0), None
        self.papers: dict[str, str] = {}
        self.course: list[tuple[int, dict[str, float | None]]] = []
        self._accepted_at = -np.inf
        self._fitting: Future[None] | None = None
        self._stale = False
        self._pool = ThreadPoolExecutor(1)
        self.journal = Journal(folder)
        for event in self.journal.events:
            self._apply(event)
        self.resumed = bool(self.journal.events)
        self.waiting = self.resumed or not self.facts
        if self.resumed:
            self._write_tables()
            self._refit()

    # ------------------------------------------------------------------ what has happened

    def _record(self, kind: str, **facts: Any) -> None:
        """Write an event, then let it happen."""
        event: Event = {"event": kind, "at": datetime.now().astimezone().isoformat(), **facts}
        self.journal.add(event)
        self._apply(event)
        self.version += 1

    def _apply(self, event: Event) -> None:
        """Let an event happen, now or again after a restart."""
        kind = event["event"]
        part = self.parts.get(event.get("part", RUN), self.parts[RUN])
        position = int(event.get("position", 0))
        if kind == "started":
            self.facts = dict(event["facts"])
            self.earth |= event["earth"]
        elif kind == "station":
            part.accept(Station(position, event["row"]))
            self.attempts += 1
        elif kind == "undone":
            part.stations = part.stations[:-1]
        elif kind == "again":
            part.again = [*part.again, position]
        elif kind == "skipped":
            part.again = [p for p in part.again if p != position]
            part.skipped.add(position)
        elif kind in ("auto", "paused"):
            setattr(self, kind, bool(event["on"]))
        elif kind in ("calibrated", "testing"):
            setattr(self, kind, True)
        elif kind == "papers":
            self.papers |= event["files"]

    @property
    def part(self) -> Part:
        """The part that is being measured."""
        return self.parts[ROLLTEST if self.testing else RUN]

    @property
    def state(self) -> str:
        """ "waiting", "moving", "settling", "settled", or "manual" where lines are typed."""
        if self.settling is None:
            return "waiting"
        return self.settling.state

    # ------------------------------------------------------------------ the stream

    def line(self, time: float, line: str) -> None:
        """Take a line of the stream; never raises for what it holds."""
        with self.lock:
            sample = self.stream.take(line)
            if sample is None or len(sample.values) < 3:
                return
            if self.settling is None:
                self.settling = self._settling()
            now = time if sample.time is None else sample.time
            self.sample = sample.values
            self.settling.take(now, sample.values)
            self._warm(now)
            if self._ready_by_itself():
                try:
                    self.accept()
                except MwdcalError as error:
                    self.say(str(error))

    def _settling(self) -> Settling:
        """The judge of standstills, by the channels of the stream."""
        sensors = [name for name in self.stream.channels if name != TEMPERATURE]
        least = []
        for name in sensors:
            triad = "accelerometer" if name[0] == "a" else "magnetometer"
            scale = getattr(self.profile, triad).scale
            least.append(LEAST[triad] * scale if scale else 0.0)
        return Settling(len(sensors), self.window, least)

    def _warm(self, now: float) -> None:
        """Take note of the temperature, once a second."""
        if TEMPERATURE in self.stream.channels and (
            not self.warmth or now - self.warmth[-1][0] >= 1
        ):
            self.warmth = [w for w in self.warmth if 0 <= now - w[0] <= HISTORY]
            self.warmth.append((now, self.sample[self.stream.channels.index(TEMPERATURE)]))

    @property
    def warming(self) -> float | None:
        """How fast the tool warms, °C a minute; None before half a minute has passed."""
        if len(self.warmth) < 2 or self.warmth[-1][0] - self.warmth[0][0] < 30:
            return None
        time, value = np.array(self.warmth).T
        return float(np.polyfit((time - time[0]) / 60, value, 1)[0])

    def _ready_by_itself(self) -> bool:
        settling = self.settling
        return (
            self.auto and not self.paused and not self.waiting and settling is not None
            and settling.state == "settled" and settling.began > self._accepted_at
            and self.part.order is not None and not (self.calibrated and not self.testing)
            and self.is_there
        )  # fmt: skip

    def nominal(self) -> tuple[Array, Array | None]:
        """Gravity, g, and field, nT, along the tool axes, of the latest sample by the nominal scales."""
        raw = dict(zip(self.stream.channels, self.sample, strict=False))
        return nominal(raw, self.profile)

    def live(self) -> dict[str, float]:
        """Angles in degrees and strengths of the latest sample, by the calibration if there is one yet."""
        if not self.sample:
            return {}
        g, b = self.nominal()
        return observed(g, b)

    @property
    def is_there(self) -> bool:
        """Whether the tool is about where it was ordered, by nominal readings and the dip of the stand."""
        order = self.part.order
        if order is None or not self.sample:
            return False
        dip = self.earth.get("dip_deg")
        angles = np.radians(self.part.attitude(order))
        wanted = reference_vectors(*angles, 1.0, 1.0, np.radians(dip or 0.0))
        g, b = self.nominal()
        if b is None or dip is None:
            return _angle_deg(g, wanted[0]) < FAR_DEG
        return _angle_deg(g, wanted[0]) < FAR_DEG and _angle_deg(b, wanted[1]) < FAR_FIELD_DEG

    # ------------------------------------------------------------------ decisions

    def start(self, serial: str, operator: str = "", **earth: float | None) -> None:
        """Begin: the tool's serial, who measures, and gravity, field and dip of the stand, where they are known."""
        with self.lock:
            if not serial.strip():
                raise InputError(
                    "the serial of the tool is missing. Every document names the tool by it."
                )
            known = {name: value for name, value in earth.items() if value is not None}
            facts: dict[str, Any] = {
                "serial": serial.strip(),
                "date": datetime.now().date().isoformat(),
            }
            facts |= {"operator": operator.strip()} if operator.strip() else {}
            facts |= {"plan": self.plan_name} if self.plan_name else {}
            facts |= {"simulated": True} if self.simulated else {}
            self._record("started", facts=facts, earth=known)
            self.waiting = False

    def resume(self) -> None:
        """Go on with a session that was begun before."""
        with self.lock:
            self.waiting, self.message = False, ""
            self.version += 1

    def accept(self, typed: Mapping[str, float] | None = None) -> None:
        """Accept the standstill as the station that is asked for; `typed` readings instead, by channel.

        Raises:
            InputError: there is nothing to accept, or the disk is full: then nothing is accepted.
        """
        with self.lock:
            part, order = self.part, self.part.order
            if self.waiting:
                raise InputError("the session has not started. Press Start.")
            if order is None or (self.calibrated and not self.testing):
                raise InputError(
                    "no station is asked for: all are measured. Choose one to measure again."
                )
            row = self._row(part, order, typed)
            self._record("station", part=part.name, position=order, row=row)
            if self.settling is not None:
                self._accepted_at = self.settling.time
            self.message = ""
            self._write_tables()
            self._refit()

    def _row(self, part: Part, order: int, typed: Mapping[str, float] | None) -> dict[str, Any]:
        """The row of the run file."""
        row: dict[str, Any] = {"station": str(order + 1)}
        if typed is None:
            if self.settling is None or self.settling.state != "settled":
                raise InputError("the tool does not stand still yet. Wait until it has settled.")
            row |= _measured(self.settling.station(), self.stream.channels)
        else:
            row |= {"samples": 1.0, **typed}
        for name in ANGLES:
            value = float(part.plan[f"ref_{name}_deg"][order])
            row[f"ref_{name}_deg"] = value if value == value else None
        return row | {f"ref_{name}": value for name, value in self.earth.items()}

    def undo(self) -> None:
        """Take the last station back."""
        with self.lock:
            if not self.part.stations:
                raise InputError("there is no station to take back.")
            self._record("undone", part=self.part.name)
            self._write_tables()
            self._refit()

    def measure_again(self, position: int | None = None) -> None:
        """Ask for a station again: the one named, a bad one, or the last."""
        with self.lock:
            part = self.part
            if position is None:
                bad = [int(label) - 1 for label in self.bad]
                waiting = [p for p in bad if p not in part.again]
                last = [station.position for station in part.stations[-1:]]
                position = next(iter(waiting or last), None)
            if position is None or position not in part.done:
                raise InputError("there is no station to measure again.")
            if position not in part.again:
                self._record("again", part=part.name, position=position)

    def skip(self) -> None:
        """Leave a position out."""
        with self.lock:
            if (order := self.part.order) is None:
                raise InputError("no station is asked for.")
            self._record("skipped", part=self.part.name, position=order)

    def switch(self, name: str, on: bool) -> None:
        """Turn "auto", accept when settled, or "paused" on or off."""
        with self.lock:
            self._record(name, on=on)

    # ------------------------------------------------------------------ results

    @property
    def bad(self) -> dict[str, str]:
        """What is wrong with stations of the run, by label."""
        return {} if self.testing else self.fit.bad

    def _write_tables(self) -> None:
        """The run files, from the events."""
        for part in self.parts.values():
            if part.stations:
                path = self.folder / f"{part.name}.csv"
                tables.write(path, part.table(self.facts))

    def _refit(self) -> None:
        """Fit what there is, beside the stream; what comes meanwhile is fitted afterwards."""
        if self.testing:
            self._submit(self._judge)
        else:
            self._submit(self._fit_run)

    def _submit(self, task: Callable[[], None]) -> None:
        self._fitting = self._pool.submit(self._guarded, task)

    def _guarded(self, task: Callable[[], None]) -> None:
        try:
            task()
        except MwdcalError as error:
            self.say(str(error))
        except Exception as error:  # the session must go on
            self.say(
                f"internal error ({type(error).__name__}: {error}). Nothing accepted is lost; please report it."
            )
        with self.lock:
            self.version += 1

    def say(self, message: str) -> None:
        """Show a message on the page."""
        with self.lock:
            if message != self.message:
                self.message, self.version = message, self.version + 1

    def settle_fits(self) -> None:
        """Wait until all that was asked for is fitted."""
        self._pool.submit(lambda: None).result()

    def _fit_run(self) -> None:
        count = len(self.parts[RUN].stations)
        if count < FEWEST:
            fit = Fit(count)
        else:
            try:
                fit = Fit(count, calibrated(self.folder))
            except MwdcalError as error:
                fit = Fit(count, reason=str(error))
        with self.lock:
            self.fit = fit
            if fit.calibration is not None:
                self.course = [c for c in self.course if c[0] != count]
                self.course.append((count, accuracy(fit.calibration)))

    def calibrate(self) -> None:
        """Write the calibration of the run and its report."""
        with self.lock:
            if len(self.parts[RUN].stations) < FEWEST:
                raise InputError(f"a calibration needs {FEWEST} stations at least. Measure more.")
            self._submit(self._calibrate)

    def _calibrate(self) -> None:
        cal = calibrated(self.folder)
        mwdcal.save(cal, self.folder / "tool.json")
        files = {"calibration": "tool.json", **_page(cal, self.folder / "report.html")}
        with self.lock:
            self.fit = Fit(len(self.parts[RUN].stations), cal)
            self._record("papers", files=files)
            self._record("calibrated")

    def start_rolltest(self) -> None:
        """Go on to the roll test."""
        with self.lock:
            if not self.calibrated:
                raise InputError("the roll test needs the calibration. Press Calibrate first.")
            self._record("testing")

    def _judge(self) -> None:
        """The verdict of the roll test, once all its stations are there."""
        if self.fit.calibration is None and (self.folder / "tool.json").exists():
            self.fit = Fit(len(self.parts[RUN].stations), mwdcal.load(self.folder / "tool.json"))
        part, cal = self.parts[ROLLTEST], self.fit.calibration
        if cal is None or part.order is not None or not part.stations:
            with self.lock:
                self.verdict = None
            return
        verdict = mwdcal.verify(cal, self.folder / "rolltest.csv")
        mwdcal.save(verdict, self.folder / "verification.json")
        files = {
            "verification": "verification.json",
            **_page(verdict, self.folder / "rolltest.html", "rolltest"),
        }
        with self.lock:
            self.verdict = verdict
            if "verification" not in self.papers:
                self._record("papers", files=files)

    def certify(self, number: str = "") -> None:
        """Issue the certificate, and enter all in the registry, where one is named."""
        with self.lock:
            if self.verdict is None:
                raise InputError("the certificate needs the roll test. Measure it first.")
            self._submit(lambda: self._certify(number))

    def _certify(self, number: str) -> None:
        folder = self.folder
        chosen: dict[str, Any] = {"number": number} if number else {}
        if self.laboratory is not None:
            chosen["laboratory"] = self.laboratory
        paper = mwdcal.certificate(
            folder / "tool.json", verification=folder / "verification.json", **chosen
        )
        mwdcal.save(paper, folder / "certificate.json")
        files = {"certificate": "certificate.json"}
        for suffix in (".html", ".pdf"):
            try:
                mwdcal.save(paper, folder / f"certificate{suffix}")
                files[f"certificate{suffix}"] = f"certificate{suffix}"
            except InputError as error:
                self.say(str(error))
        with self.lock:
            self._record("papers", files=files)
        if self.registry is not None:
            documents = [
                folder / name for name in ("tool.json", "verification.json", "certificate.json")
            ]
            with mwdcal.registry(self.registry, create=True) as tools:
                answer = tools.add(*documents)
            with self.lock:
                self._record("papers", files={"registry": answer.summary().splitlines()[0]})

    def close(self) -> None:
        """End: what is written stays."""
        self._pool.shutdown(wait=True)
        self.journal.close()


def nominal(raw: Mapping[str, float], profile: Profile) -> tuple[Array, Array | None]:
    """Gravity and field along the tool axes of raw channels, by the nominal scales of a profile."""
    g = to_nominal(np.array([raw[name] for name in ("ax", "ay", "az")]), profile.accelerometer)
    if "mx" not in raw:
        return g, None
    return g, to_nominal(np.array([raw[name] for name in ("mx", "my", "mz")]), profile.magnetometer)


def _angle_deg(one: Array, other: Array) -> float:
    """The angle between two vectors; 180 where one of them is zero."""
    size = float(np.linalg.norm(one) * np.linalg.norm(other))
    return float(np.degrees(np.arccos(np.clip(one @ other / size, -1, 1)))) if size else 180.0


def observed(g: Array, b: Array | None) -> dict[str, float]:
    """Angles in degrees and strengths of gravity and field; without field only those of gravity."""
    names = (
        "inclination",
        "toolface",
        "gravity",
        *(("azimuth", "field", "dip") if b is not None else ()),
    )
    values = {name: float(OBSERVABLES[name].value(g, g if b is None else b)) for name in names}
    angles = {"inclination", "toolface", "azimuth", "dip"}
    return {k: float(np.degrees(v)) if k in angles else v for k, v in values.items()}


def calibrated(folder: Path) -> Calibration:
    """The calibration of the run in a folder, as `mwdcal calibrate run.csv --tool tool.toml` makes it."""
    return mwdcal.calibrate(mwdcal.read_run(folder / "run.csv", folder / "tool.toml"))


def accuracy(calibration: Calibration) -> dict[str, float | None]:
    """1σ of each angle at 45° inclination, degrees."""
    from mwdcal.calibration.prediction import typical_accuracy

    return typical_accuracy(calibration)


def _measured(still: Standstill, channels: Sequence[str]) -> dict[str, Any]:
    """Cells of the run file of a standstill."""
    row: dict[str, Any] = dict(zip(channels, still.means, strict=True))
    row |= {
        f"sd_{name}": sd for name, sd in zip(channels, still.sd, strict=True) if name != TEMPERATURE
    }
    return row | {"samples": float(still.samples), "start_s": still.start, "end_s": still.end}


def _page(result: Any, path: Path, name: str = "report") -> dict[str, str]:
    """The page of a result, where what draws it is installed."""
    try:
        result.report(path)
    except InputError:
        return {}
    return {name: path.name}
