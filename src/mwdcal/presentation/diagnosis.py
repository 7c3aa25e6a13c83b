"""A diagnosis on the screen and as a page: the verdict, what moved, how likely each fault is, what to do next."""

from __future__ import annotations

from collections.abc import Mapping

from mwdcal.calibration.readings import simulated
from mwdcal.faults.diagnosis import Diagnosis, Rival
from mwdcal.faults.likelihood import FALSE_ALARMS, NONE, SURROUNDINGS
from mwdcal.presentation.numbers import capital, estimate, measured, number
from mwdcal.presentation.page import banner, rendered
from mwdcal.presentation.text import chance, one_line, plural, table

MEANINGS = {
    NONE: "as calibrated",
    "impact": "a sensor, or a triad, that a blow has moved",
    "dead-channel": "a channel that stands still",
    "heat": "bias and scale drift with temperature beyond the calibration",
    "magnetised": "interference of a string or collar, fixed in the tool",
    "casing": "casing or steel nearby, or a field reference that is off",
    "turn-on": "biases of all channels after switching on",
}
"""Each fault in words."""
ADVICE = {
    NONE: "use the calibration as it is",
    "impact": "do not use the tool before it is calibrated again; look for a loose sensor or board",
    "dead-channel": "take the tool out of service: replace the sensor or its channel",
    "heat": "calibrate again over the whole range of temperatures; hold a suspect channel at the highest one",
    "magnetised": "verify without string and collar, or demagnetise them; mwdcal survey --msa corrects surveys",
    "casing": "the calibration may be sound: check the references, and measure again away from casing and steel",
    "turn-on": "switch off and on and read again; calibrate again if the biases come back",
}
"""The advice for each."""
CHECK_FIRST = "check tool, units and references, then repeat the readings on a stand"
CHECK_STAND = "check the zero of the stand and the references, then repeat the roll test"
IN_HOLE = "run mwdcal survey --msa on these surveys: it estimates a field fixed in the tool and corrects for it"
NOT_YET = "do not judge the tool by these readings alone"
"""The advice where no single fault explains readings, of surveys, and where a sound tool is not excluded."""
UNLESS_FAILED = "if these readings fail verify, repeat them with less noise or a better-known stand"
"""The advice beside a sound calibration: an uncertainty that explains all may be too large for a limit."""
LEAST_LIKELIHOOD = 0.0005
"""Likelihoods below are shown as less than this."""
MOVED_TITLES = ["channel", "by", "1σ", "unit"]
"""Titles of the table of sizes of a fault, but for the first."""
NONE_FITS = "none fits; the closest first"
"""In place of likelihoods where no single fault explains the readings: they would compare poor explanations."""


def screen(result: Diagnosis, *metadata: Mapping[str, object]) -> str:
    """The verdict first, then what moved, and the likelihoods; `metadata` of calibration and readings."""
    head = [verdict(result), result.run, plural(result.stations, "station"), *simulated(*metadata)]
    parts = ["   ".join(one_line(text) for text in head)]
    if result.parameters:
        parts.append(table(_moved(result), _moved_titles(result)))
    parts.append(table(_likelihoods(result), ["", _likelihood_title(result)]))
    parts.append("\n".join(one_line(line) for line in _last(result)))
    return "\n\n".join(parts)


def render(result: Diagnosis, sha256: Mapping[str, str], *metadata: Mapping[str, object]) -> str:
    """The diagnosis as HTML; `sha256` of the calibration and the readings, `metadata` as of the screen."""
    sound = result.fault == NONE or _by_stand(result)
    certain = is_fine(result)
    word, level = ("OK", "good") if certain else ("Attention", "attention" if sound else "bad")
    return rendered(
        "diagnosis.html",
        *metadata,
        result=result,
        banner=banner(level, word, capital(verdict(result)), f"{capital(next_step(result))}."),
        findings=result.findings,
        moved=_moved(result),
        moved_titles=_moved_titles(result),
        likelihood_title=_likelihood_title(result),
        likelihoods=_likelihoods(result),
        last=_last(result)[:-1],
        sha256=sha256,
    )


def verdict(result: Diagnosis) -> str:
    """One sentence: no change, or the fault, where, and by how much; and what else it may be."""
    unexplained = _unexplained(result)
    if _by_stand(result):
        return f"{_offset(result)} explains these readings; the tool may be as calibrated"
    if result.fault == NONE:
        if unexplained:
            return "no single fault explains these readings, and none is named"
        return "no change found: noise and uncertainty explain the readings"
    if unexplained:
        suspects: list[Diagnosis | Rival] = [result, *result.rivals]
        closest = [f"{each.fault}{_where(each)}" for each in suspects]
        return f"no single fault explains these readings; closest: {' or '.join(closest)}"
    causes = [_cause(result), *map(_cause, result.rivals)]
    if result.rivals:
        return f"cannot tell {' from '.join(causes)}"
    return causes[0]


def is_fine(result: Diagnosis) -> bool:
    """Whether nothing has changed: no fault, nothing left to explain, no offset of the stand."""
    return result.fault == NONE and not _unexplained(result) and result.stand_offset is None


def _by_stand(result: Diagnosis) -> bool:
    """Whether an offset of the stand explains what no fault does."""
    return result.stand_offset is not None and (result.fault == NONE or _unexplained(result))


def _offset(result: Diagnosis) -> str:
    """The offset of the stand and its size."""
    offset = result.stand_offset
    return (
        f"an offset of the stand's {offset.parameter} of {estimate(offset.size, offset.uncertainty, '°')}"
        if offset
        else ""
    )


def _unexplained(result: Diagnosis) -> bool:
    """Whether even the closest fault leaves more than noise."""
    return any(finding.id == "unexplained" for finding in result.findings)


def _likelihood_title(result: Diagnosis) -> str:
    return NONE_FITS if _unexplained(result) else "likelihood"


def _moved_titles(result: Diagnosis) -> list[str]:
    """Titles of the table of sizes of the fault."""
    return [f"moved, if {result.fault} alone" if _unexplained(result) else "moved", *MOVED_TITLES]


def _where(cause: Diagnosis | Rival) -> str:
    return f" on {_place(cause.channel)}" if cause.channel else ""


def _cause(cause: Diagnosis | Rival) -> str:
    """A fault, where it shows, and its largest size."""
    where = _where(cause)
    if cause.size is None:
        return f"{cause.fault}{where}"
    size = _size(cause.size, cause.size_uncertainty, cause.unit)
    if cause.fault == "dead-channel":
        onset = cause.above_c if isinstance(cause, Diagnosis) else None
        above = "" if onset is None else f" from {number(onset)} °C upwards"
        return f"{cause.fault}{where}: reads a constant {size}{above}"
    first = cause.parameters[0].channel if isinstance(cause, Diagnosis) else None
    whose = f" of {first}" if first and not cause.channel else ""
    return f"{cause.fault}{where}: {cause.parameter}{whose} moved by {size}"


def _place(channel: str) -> str:
    return f"the {channel}" if len(channel) > 2 else f"channel {channel}"


def _size(size: float, uncertainty: float | None, unit: str | None) -> str:
    return estimate(size, uncertainty, unit or "")


def _moved(result: Diagnosis) -> list[list[str]]:
    """All sizes of the fault."""
    return [
        [row.parameter, row.channel or "", *measured(row.size, row.uncertainty), row.unit]
        for row in result.parameters
    ]


def _likelihoods(result: Diagnosis) -> list[list[str]]:
    """All faults, the most likely first."""
    ordered = sorted(result.likelihoods.items(), key=lambda pair: -pair[1])
    poor = _unexplained(result)
    return [[f"{n}: {MEANINGS[n]}", "" if poor else _share(share)] for n, share in ordered]


def _share(share: float) -> str:
    return (
        f"{100 * share:.1f} %" if share >= LEAST_LIKELIHOOD else f"< {100 * LEAST_LIKELIHOOD:g} %"
    )


def _last(result: Diagnosis) -> list[str]:
    """The rule, the gaps of these readings, and the advice."""
    lines = [
        f"rule: a healthy tool looks this bad with a probability of {chance(result.probability)}; a fault is reported "
        f"at {100 * FALSE_ALARMS:g} % or less"
    ]
    if result.stand_offset and not _by_stand(result):
        lines.append(f"{_offset(result)} explains these readings as well")
    if result.unseen:
        lines.append(f"not shown by these readings, at its usual size: {', '.join(result.unseen)}")
    for name in result.confounded_with:
        texts = [row.reading for row in result.tell_apart if row.fault == name and row.reading]
        tells = f"; {texts[0]} would tell" if texts else "; no further reading that was tried would"
        lines.append(f"cannot be told from {name} by these readings{tells}")
    return [*lines, f"next: {next_step(result)}"]


def next_step(result: Diagnosis) -> str:
    """The advice: a tool is taken out of use only where readings exclude that it is sound."""
    if _by_stand(result):
        return CHECK_STAND
    if _unexplained(result):
        return CHECK_FIRST
    steps = [IN_HOLE if result.fault == "magnetised" and result.surveys else ADVICE[result.fault]]
    if result.fault in SURROUNDINGS and result.rivals:
        steps.append(NOT_YET)
    if result.fault == NONE and not result.surveys:
        steps.append(UNLESS_FAILED)
    return "; ".join(steps)
