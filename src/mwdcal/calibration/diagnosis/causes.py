"""The possible causes of a refusal: a station, wrong axes, a column that is not used, the span of temperatures."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from mwdcal.calibration.automatic.courses import orders_of
from mwdcal.calibration.diagnosis.axes import explaining
from mwdcal.calibration.diagnosis.flags import FittedRuns
from mwdcal.calibration.diagnosis.structure import COLUMN, described
from mwdcal.calibration.readings import HIGHEST, highest_order
from mwdcal.calibration.residuals import shown_in
from mwdcal.estimation.uncertainty import station_misfit

CULPRIT_SHARE = 0.3
"""Share of all misfit at which a single station is named as the cause."""


def _axes(fitted: FittedRuns, place: int) -> str:
    """The axes with which a run would fit, in words; nothing if there are none."""
    each = [
        f"axes = {json.dumps(axes)} of [{name}]"
        for name, axes in explaining(*fitted.alone(place)).items()
    ]
    return f" The run fits with {' and '.join(each)}." if each else ""


def _culprit(fitted: FittedRuns, place: int) -> str:
    """The station to look at first, if a single one has most of the misfit."""
    square = station_misfit(fitted.member(place).analysis)[0][0]
    worst = int(np.argmax(square))
    share = square[worst] / max(float(square.sum()), 1e-300)
    if share < CULPRIT_SHARE:
        return ""
    label = fitted.alone(place)[0].labels[worst]
    return (
        f" Station {label} alone has {share:.0%} of the misfit: `exclude` {label}, or fit with "
        "`robust` student-t."
    )


def _column(fitted: FittedRuns, place: int) -> str:
    """The column that the run does not use and that explains most of the residuals, in words."""
    if not fitted.readings.others:
        return ""
    unit = shown_in("field", fitted.readings.relative)[1]
    named = [effect for effect in fitted.effects(place) if effect.name.startswith(COLUMN)]
    return "".join(f" {described(effect, unit)}" for effect in named[:1])


REFUSAL_ENDINGS = {"culprit": _culprit, "axes": _axes, "column": _column}
"""The possible ends of a refusal, for one run."""


def spanned(fitted: FittedRuns, index: int) -> dict[str, Any]:
    """The order of a triad, the span of temperatures, and what to do."""
    temperature, order = fitted.result.problem.temperature, orders_of(fitted.result)[index]
    higher = np.minimum(highest_order(temperature), HIGHEST) > order
    remedy = np.where(
        higher & (fitted.options.method != "swarm"),
        "Use `order` auto, or a higher one",
        "Measure over a narrower range, or let the tool come to rest at each temperature",
    )
    return {"order": order, "span": np.ptp(temperature, axis=-1), "remedy": remedy}
