"""A diagnosis on the screen: the verdict, what moved, how likely each fault is, what to do next."""

from __future__ import annotations

from collections.abc import Mapping

from mwdcal.app.screens.numbers import estimate, measured
from mwdcal.app.text import chance, number, one_line, plural, table
from mwdcal.calibration.readings import simulated
from mwdcal.faults.diagnosis import Diagnosis
from mwdcal.faults.physics import NONE
from mwdcal.faults.weighing import FALSE_ALARMS

MEANINGS = {
    NONE: "as calibrated",
    "impact": "a sensor, or a triad, that a blow has moved",
    "dead-channel": "a channel that stands still",
    "heat": "bias and scale drift with temperature beyond the calibration",
    "magnetised": "a magnetised collar or package, fixed in the tool",
    "casing": "casing or steel nearby, fixed in the Earth",
    "turn-on": "biases of all channels after switching on",
}
"""Each fault in words."""
ADVICE = {
    NONE: "use the calibration as it is",
    "impact": "do not use the tool before it is calibrated again; look for a loose sensor or board",
    "dead-channel": "take the tool out of service: replace the sensor or its channel",
    "heat": "calibrate again over the whole range of temperatures; hold a suspect channel at the highest one",
    "magnetised": "demagnetise or replace the collar, then verify; correct surveys for drillstring interference",
    "casing": "the calibration may be sound: read again away from casing and steel",
    "turn-on": "switch off and on and read again; calibrate again if the biases come back",
}
"""What to do about each."""
LEAST_LIKELIHOOD = 0.0005
"""Likelihoods below are shown as less than this."""


def screen(result: Diagnosis, *metadata: Mapping[str, object]) -> str:
    """The verdict first, then what moved, and the likelihoods; `metadata` of calibration and readings."""
    head = [verdict(result), result.run, plural(result.stations, "station"), *simulated(*metadata)]
    parts = ["   ".join(one_line(text) for text in head)]
    if result.parameters:
        parts.append(_moved(result))
    parts.append(_likelihoods(result))
    parts.append("\n".join(one_line(line) for line in _last(result)))
    return "\n\n".join(parts)


def verdict(result: Diagnosis) -> str:
    """One sentence: still fine, or the fault, where, and by how much."""
    if result.fault == NONE:
        return "still fine: the readings are as the calibration says"
    where = f" on {_place(result.channel)}" if result.channel else ""
    if result.size is None:
        return f"{result.fault}{where}"
    size = _size(result.size, result.size_uncertainty, result.unit)
    if result.fault == "dead-channel":
        above = "" if result.above_c is None else f" from {number(result.above_c)} °C upwards"
        return f"{result.fault}{where}: reads a constant {size}{above}"
    first = result.parameters[0]
    whose = f" of {first.channel}" if first.channel and not result.channel else ""
    return f"{result.fault}{where}: {result.parameter}{whose} moved by {size}"


def _place(channel: str) -> str:
    return f"the {channel}" if len(channel) > 2 else f"channel {channel}"


def _size(size: float, uncertainty: float | None, unit: str | None) -> str:
    return estimate(size, uncertainty, unit or "")


def _moved(result: Diagnosis) -> str:
    """Table of all sizes of the fault."""
    rows = [
        [row.parameter, row.channel or "", *measured(row.size, row.uncertainty), row.unit]
        for row in result.parameters
    ]
    return table(rows, ["moved", "channel", "by", "1σ", "unit"])


def _likelihoods(result: Diagnosis) -> str:
    """Table of all faults, the most likely first."""
    ordered = sorted(result.likelihoods.items(), key=lambda pair: -pair[1])
    rows = [[f"{name}: {MEANINGS[name]}", _share(share)] for name, share in ordered]
    return table(rows, ["", "likelihood"])


def _share(share: float) -> str:
    return (
        f"{100 * share:.1f} %" if share >= LEAST_LIKELIHOOD else f"< {100 * LEAST_LIKELIHOOD:g} %"
    )


def _last(result: Diagnosis) -> list[str]:
    """What it rests on, what these readings leave open, and what to do."""
    lines = [
        f"rule: a fault is named where a sound tool gives as much evidence for one with a probability of at most "
        f"{100 * FALSE_ALARMS:g} %; here {chance(result.probability)}"
    ]
    if result.unseen:
        lines.append(f"not shown by these readings, at its usual size: {', '.join(result.unseen)}")
    for name in result.confounded_with:
        texts = [row.reading for row in result.tell_apart if row.fault == name and row.reading]
        tells = f"; {texts[0]} would tell" if texts else ""
        lines.append(f"cannot be told from {name} by these readings{tells}")
    return [*lines, f"next: {ADVICE[result.fault]}"]
