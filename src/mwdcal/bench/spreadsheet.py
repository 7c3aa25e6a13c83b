"""A run from a table as a laboratory keeps it: what its columns are, what is open, then calibration and documents.

The files lie in the folder `table` of the session: what was dropped in `table/given`, and beside it what the commands
`profile`, `calibrate`, `verify` and `certificate` make of it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING, Any

import mwdcal
from mwdcal.bench import documents
from mwdcal.errors import InputError, MwdcalError, QuestionError, QuestionsError
from mwdcal.files.contract import CHANNELS
from mwdcal.files.formats import atomic
from mwdcal.files.formats import table as tables
from mwdcal.library.answers import Answers

if TYPE_CHECKING:
    from mwdcal.calibration.record import Calibration
    from mwdcal.files.formats.layout import Layout
    from mwdcal.library.planning import ProposedProfile
    from mwdcal.use.verification import Verdict

STATE_FILE = "table.json"
LAYOUT_ANSWERS = ("sheet", "header_row", "decimal")
"""Answers that say where the table is and how its numbers are written."""


class DroppedTable:
    """A table of a run that somebody dropped on the page, and all that was made of it."""

    def __init__(self, folder: Path, registry: str | None, laboratory: Path | None) -> None:
        self.folder, self.registry, self.laboratory = folder, registry, laboratory
        self.lock, self.answers, self.name, self.rolltest = RLock(), Answers(), "", ""
        self.message = ""
        self._forget()
        if (folder / STATE_FILE).exists():
            self._restore()

    def _forget(self) -> None:
        """Nothing is known of the table yet."""
        self.proposal: ProposedProfile | None = None
        self.questions: tuple[QuestionError, ...] = ()
        self.reason = ""
        self.sheet: Layout | None = None
        self.axes: dict[str, Any] = {}
        self._forget_fit()

    def _forget_fit(self) -> None:
        self.fit: documents.RunFit | None = None
        self.verdict: Verdict | None = None
        self._diagnosis: tuple[Verdict, documents.Failure] | None = None
        self.papers: dict[str, str] = {}

    def _restore(self) -> None:
        """Go on after a restart: what was decided is in a file, the rest follows from it."""
        state = json.loads((self.folder / STATE_FILE).read_text("utf-8"))
        self.name, self.rolltest = state["name"], state["rolltest"]
        self.answers = Answers(state["answers"])
        self._propose()
        try:
            if "calibration" in state["papers"]:
                self.fit = documents.saved_fit(self.folder)
                self.papers = state["papers"]
            if self.rolltest and self.fit is not None and self.fit.calibration is not None:
                self.verdict = documents.judged(self.fit.calibration, self._given(self.rolltest))
        except MwdcalError as error:
            self.message = str(error)

    def _keep(self) -> None:
        """Write what was decided, and what there is."""
        state = {
            "name": self.name,
            "rolltest": self.rolltest,
            "answers": self.answers,
            "papers": self.papers,
        }
        atomic.write(self.folder / STATE_FILE, json.dumps(state))

    def _given(self, name: str) -> Path:
        return self.folder / "given" / name

    def _store(self, name: str, data: bytes) -> str:
        """Write a file that was dropped; its name here."""
        name = re.sub(r"[^\w. ()+-]", "_", Path(name.replace("\\", "/")).name)[-80:].lstrip(".")
        if not name or not data:
            raise InputError("the file is empty, or has no name. Choose another one.")
        self._given(name).parent.mkdir(parents=True, exist_ok=True)
        atomic.write(self._given(name), data)
        return name

    def drop(self, name: str, data: bytes) -> None:
        """Take the table of a run, in place of the one before."""
        with self.lock:
            self.name, self.rolltest, self.answers = self._store(name, data), "", Answers()
            self._forget()
            self._keep()
            self._propose()

    def answer(self, question: int, place: int, numbers: Mapping[str, float | None]) -> None:
        """Answer an open question by one of its answers, and propose again."""
        with self.lock:
            try:
                chosen = self.questions[question].answers[place]
            except IndexError:
                raise InputError("this question is not open. Open the page again.") from None
            for argument, value in chosen.arguments:
                self.answers.take(argument, value)
            for name in chosen.numbers:
                if numbers.get(name) is None:
                    raise InputError(f"{name} is missing. Type degrees, east positive.")
                self.answers[name] = numbers[name]
            self._keep()
            self._propose()

    def state_serial(self, serial: str) -> None:
        """State the serial of the tool, where the table does not."""
        with self.lock:
            if not serial.strip() or not self.name:
                raise InputError("the serial is missing. Type it.")
            self.answers["serial"] = serial.strip()
            self._forget_fit()
            self._keep()
            self._propose()

    def take_back(self) -> None:
        """Forget all answers, and ask again."""
        with self.lock:
            self.answers = Answers()
            self._forget_fit()
            self._keep()
            self._propose()

    def _propose(self) -> None:
        """Work out a profile of the table, or the questions that are open."""
        path = self._given(self.name)
        self.proposal, self.questions, self.reason, self.axes = None, (), "", {}
        self.sheet = self._laid_out(path)
        try:
            proposal = mwdcal.propose_profile(path, **self.answers)
            proposal.save(self.folder / "tool.toml")
            self.proposal = proposal
            profile = proposal.profile  # refused where its axes are open
            self.axes = {kind: getattr(profile, kind).axes for kind in CHANNELS}
        except QuestionsError as error:
            self.questions, self.reason = error.questions, str(error)
        except QuestionError as error:
            self.questions, self.reason = (error,), str(error)
        except MwdcalError as error:
            self.reason = str(error)

    def _laid_out(self, path: Path) -> Layout | None:
        """The table as it stands in the file, if it is clear where it is."""
        said: dict[str, Any] = {k: v for k, v in self.answers.items() if k in LAYOUT_ANSWERS}
        try:
            return tables.laid_out(path, **said)
        except MwdcalError:
            return None

    @property
    def serial(self) -> str:
        """Serial of the tool, by the table or by what was typed; blank if neither says it."""
        return str(self.proposal.proposal.metadata.get("serial", "")) if self.proposal else ""

    def calibrate(self) -> None:
        """Calibrate as `mwdcal calibrate` does, and judge the roll test, if there is one."""
        with self.lock:
            if self.proposal is None or self.reason:
                raise InputError("the table leaves something open. Answer it first.")
            if not self.serial:
                raise InputError(
                    "the serial of the tool is missing. Every document names the tool by it: type it."
                )
            metadata = {"serial": self.serial} if "serial" in self.answers else None
            readings = mwdcal.read_run(
                self._given(self.name), self.folder / "tool.toml", metadata=metadata
            )
            self._forget_fit()
            self.fit = documents.fit_of(readings)
            calibration = self.fit.calibration
            if calibration is None:
                return
            self.papers = documents.save_calibration(calibration, self.folder)
            self.papers |= documents.draw(calibration, self.folder, "report")
            if self.rolltest:
                self._judge(calibration)
            self._keep()

    def drop_rolltest(self, name: str, data: bytes) -> None:
        """Take the table of the roll test, and judge the calibration by it."""
        with self.lock:
            calibration = self.fit.calibration if self.fit else None
            if calibration is None:
                raise InputError("the roll test needs the calibration. Press Calibrate first.")
            self.rolltest = self._store(f"rolltest {name}" if name == self.name else name, data)
            self._judge(calibration)
            self._keep()

    def _judge(self, calibration: Calibration) -> None:
        self.verdict = None
        self.verdict, files = documents.verify(calibration, self.folder, f"given/{self.rolltest}")
        self.papers = {k: v for k, v in self.papers.items() if "certificate" not in k} | files
        self.papers |= documents.draw(self.verdict, self.folder, "rolltest")

    @property
    def failure(self) -> documents.Failure:
        """Why the roll test has failed, worked out once for each verdict; empty if it has not."""
        calibration, verdict = self.fit.calibration if self.fit else None, self.verdict
        if calibration is None or verdict is None or verdict.passed:
            return documents.Failure()
        if self._diagnosis is None or self._diagnosis[0] is not verdict:
            failure = documents.failure(verdict, calibration, self._given(self.rolltest))
            self._diagnosis = verdict, failure
        return self._diagnosis[1]

    def certify(self, number: str) -> None:
        """Issue the certificate, and enter all in the registry, where one is named."""
        with self.lock:
            if self.verdict is None:
                raise InputError("the certificate needs the roll test. Drop its table first.")
            self.papers |= documents.certify(self.folder, number, self.laboratory)
            for kind in ("html", "pdf"):
                try:
                    self.papers |= documents.draw_certificate(self.folder, self.laboratory, kind)
                except InputError as error:
                    self.message = str(error)
            if self.registry is not None:
                self.papers["registry"] = documents.enter(self.folder, self.registry)
            self._keep()
