"""The documents of a session's folder: what the commands make of the same files, byte for byte but for the time."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mwdcal
from mwdcal.bench.opening import PREVIOUS_FILE
from mwdcal.calibration.diagnosis.findings import LARGEST_DEVIATION
from mwdcal.calibration.diagnosis.flags import spaced
from mwdcal.calibration.residuals import REASONS, shown_in
from mwdcal.calibration.results import typical_accuracy
from mwdcal.errors import FitError, InputError, MwdcalError
from mwdcal.files.profiles import setting
from mwdcal.geometry.observables import TITLES
from mwdcal.presentation.diagnosis import next_step
from mwdcal.presentation.diagnosis import verdict as cause_in_words
from mwdcal.presentation.numbers import capital, signed

if TYPE_CHECKING:
    from mwdcal.calibration.readings import Readings
    from mwdcal.calibration.record import Calibration, StationRow
    from mwdcal.library.papers import Paper
    from mwdcal.use.verification import Verdict

FEWEST_STATIONS = 8
"""Stations before which no fit is tried."""
AS_FOUND = "as-found.json"
ENTERED = ("tool.json", "verification.json", "certificate.json")
"""Files of the session that go into the registry."""


@dataclass(frozen=True)
class RunFit:
    """A calibration by the stations so far, or the reason why they do not give one yet."""

    calibration: Calibration | None = None
    reason: str = ""
    accuracy_deg: dict[str, float | None] = field(default_factory=dict)
    bad: dict[str, str] = field(default_factory=dict)
    """The problem of each station to measure again, by label."""


def fit(folder: Path, stations: int) -> RunFit:
    """The calibration of the run in a folder, as `mwdcal calibrate` makes it of run.csv and tool.toml.

    A bad station hides another, and several together may prevent a calibration: a robust fit names the others.
    """
    if stations < FEWEST_STATIONS:
        return RunFit()
    try:
        return fit_of(mwdcal.read_run(folder / "run.csv", folder / "tool.toml"))
    except MwdcalError as error:
        return RunFit(reason=str(error))


def fit_of(readings: Readings) -> RunFit:
    """The calibration of readings, or why they give none."""
    try:
        run = _fitted(mwdcal.calibrate(readings))
        return replace(run, bad=_suspects(readings) | run.bad) if run.bad else run
    except FitError as error:
        return RunFit(reason=str(error), bad=_suspects(readings))


def _fitted(calibration: Calibration) -> RunFit:
    return RunFit(
        calibration, accuracy_deg=typical_accuracy(calibration), bad=_to_remeasure(calibration)
    )  # fmt: skip


def _to_remeasure(calibration: Calibration) -> dict[str, str]:
    relative = "field-unknown" in {finding.id for finding in calibration.findings}
    return {row.station: _misfit(row, relative) for row in calibration.station_rows if row.reshoot}


def _misfit(row: StationRow, relative: bool) -> str:
    """The fault of a station, in words."""
    worst = row.worst or "gravity"
    _, unit = shown_in(worst, relative)
    size = f"{min(row.deviation, LARGEST_DEVIATION):.1f}"
    value = f"{signed(row.errors.get(worst, math.nan), 2)}{spaced(unit)}"
    return f"off by {size}σ, mostly in {TITLES.get(worst, worst)} ({value}): {REASONS[worst]}"


def _suspects(readings: Readings) -> dict[str, str]:
    """Stations that do not fit those that fit each other, by a fit that a few bad ones do not spoil.

    Each is judged by itself: where a roll shares its setting, a bad station looks like a bad setting.
    """
    each = replace(readings, settings="per-station")
    try:
        return _to_remeasure(mwdcal.calibrate(each, robust="student-t"))
    except MwdcalError:
        return {}


def saved_fit(folder: Path) -> RunFit:
    """The calibration that was saved."""
    return _fitted(mwdcal.load(folder / "tool.json"))


def save_calibration(calibration: Calibration, folder: Path) -> dict[str, str]:
    """Write the calibration; its file by what it is."""
    mwdcal.save(calibration, folder / "tool.json")
    return {"calibration": "tool.json"}


def judged(calibration: Calibration, rolltest: Path) -> Verdict:
    """The verdict on a roll test."""
    return mwdcal.verify(calibration, rolltest, setting("limits") or "roll-test")


def verify(
    calibration: Calibration, folder: Path, rolltest: str = "rolltest.csv"
) -> tuple[Verdict, dict[str, str]]:
    """The verdict on the roll test in a folder, and its file by what it is."""
    verdict = judged(calibration, folder / rolltest)
    mwdcal.save(verdict, folder / "verification.json")
    return verdict, {"verification": "verification.json"}


@dataclass(frozen=True)
class Failure:
    """Why a roll test has failed: `stations` farthest off, by label, with what exceeds its limit there.

    `cause` says what the readings look like and what to do, `missing` why a limit could not be judged.
    """

    stations: dict[str, str] = field(default_factory=dict)
    cause: str = ""
    missing: str = ""


def failure(verdict: Verdict, calibration: Calibration, rolltest: Path) -> Failure:
    """Why a roll test has failed, as `mwdcal verify` and `mwdcal diagnose` say."""
    failed = [row for row in verdict.rows if not row.passed]
    farthest: dict[str, list[str]] = {}
    for row in failed:
        off = {
            each.station: abs(each.departures.get(row.name, 0.0)) for each in verdict.station_rows
        }
        if row.value is not None and off:
            farthest.setdefault(max(off, key=off.__getitem__), []).append(row.name)
    missing = "; ".join(f"{row.name}: {row.note}" for row in failed if row.value is None)
    try:
        likeness = mwdcal.diagnose(calibration, rolltest)
        cause = f"{capital(cause_in_words(likeness))}. {capital(next_step(likeness))}."
    except MwdcalError:
        cause = ""
    stations = {label: ", ".join(names) for label, names in farthest.items()}
    return Failure(stations, cause, missing)


def judge_as_found(folder: Path) -> Verdict | None:
    """The verdict on the same roll test by the calibration before, if there is one: the tool as found.

    A calibration changes figures, not the tool: its readings as found are those of the roll test.
    """
    if not (folder / PREVIOUS_FILE).exists():
        return None
    verdict = judged(mwdcal.load(folder / PREVIOUS_FILE), folder / "rolltest.csv")
    mwdcal.save(verdict, folder / AS_FOUND)
    return verdict


def signers_name(key: Path) -> str:
    """The owner of a private key, as its public key beside it states; empty if it states none."""
    from mwdcal.certificate.signature import PUBLIC_SUFFIX, read_public

    return read_public(Path(f"{key}{PUBLIC_SUFFIX}")).owner


def countersign(folder: Path, key: Path, passphrase: str, operator: str) -> str:
    """Sign the certificate with the key of a second person; who that is, in words.

    Raises:
        InputError: the key or its passphrase is wrong, or its owner is the operator.
    """
    owner = signers_name(key)
    if owner.strip().casefold() == operator.strip().casefold():
        whose = f"that of the operator, {operator}" if owner else "of nobody: it states no owner"
        raise InputError(
            f"the key {key.name} is {whose}. A second person signs, with a key of their own."
        )
    signed = mwdcal.sign(folder / "certificate.json", key, passphrase=passphrase, replace=True)
    return f"{owner}, key {signed.key}"


def asks_passphrase(key: Path) -> bool:
    """Whether a private key needs its passphrase; one that cannot be read may."""
    from mwdcal.certificate.signature import is_encrypted

    try:
        return is_encrypted(key)
    except InputError:
        return True


def certify(folder: Path, number: str, laboratory: Path | None) -> dict[str, str]:
    """Issue the certificate; its file by what it is."""
    mwdcal.save(_paper(folder, number, laboratory), folder / "certificate.json")
    return {"certificate": "certificate.json"}


def _paper(folder: Path, number: str, laboratory: Path | None, **chosen: Any) -> Paper:
    """The certificate of the session's files."""
    as_found = folder / AS_FOUND
    return mwdcal.certificate(
        folder / "tool.json", verification=folder / "verification.json", laboratory=laboratory, number=number,
        as_found=as_found if as_found.exists() else None, folder=folder, **chosen,
    )  # fmt: skip


def draw_certificate(
    folder: Path, laboratory: Path | None, kind: str, **signing: Any
) -> dict[str, str]:
    """Write the issued certificate in another form, "html" or "pdf"; its file by what it is.

    Raises:
        InputError: it would no longer be the one that was issued; what draws this form is not installed.
    """
    name = f"certificate.{kind}"
    issued = json.loads((folder / "certificate.json").read_bytes())
    paper = _paper(folder, issued["number"], laboratory, date=issued["issued"], **signing)
    unsigned, written = (
        {k: v for k, v in d.items() if k != "signature"} for d in (paper.to_dict(), issued)
    )
    if json.loads(json.dumps(unsigned, default=str)) != written:
        raise InputError(
            f"{name} is not written: files of the session changed after the certificate. Send certificate.json."
        )
    mwdcal.save(paper, folder / name)
    return {f"certificate_{kind}": name}


def enter(folder: Path, registry: str) -> str:
    """Enter the documents in the registry; what was entered, in words."""
    with mwdcal.registry(registry, create=True) as tools:
        return tools.add(*(folder / name for name in ENTERED)).summary().splitlines()[0]


def draw(result: Any, folder: Path, name: str) -> dict[str, str]:
    """Write the page of a result, "report" or "rolltest", where what draws it is installed; its file by what it is."""
    try:
        result.report(folder / f"{name}.html")
    except InputError:
        return {}
    return {f"{name}_html": f"{name}.html"}
