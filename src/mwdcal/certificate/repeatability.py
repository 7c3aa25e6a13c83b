"""Repeatability of one reading, from the roll tests: scatter about the curves over toolface that were judged."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from mwdcal.certificate.decisions import PROBABILITY, When, student_factor
from mwdcal.certificate.document import Quantity, ResultTable
from mwdcal.files.verifications import Verification
from mwdcal.use.roll_test import FITTED, basis
from mwdcal.use.verification import VerdictRow

ABOUT_THE_CURVE = (
    "Standard deviation of one reading about the mean and harmonics over a turn of toolface, noise of the "
    "reading and setting of the stand included; by statistics of the roll test (type A)."
)


def repeatability(tests: Mapping[When, Verification | None]) -> list[ResultTable]:
    """A table of the repeatability that roll tests show; none where no test was rolled far enough."""
    quantities = [each for when, test in tests.items() if test for each in _of_test(when, test)]
    if not quantities:
        return []
    title = "Repeatability of a reading"
    return [
        ResultTable(id="repeatability", title=title, note=ABOUT_THE_CURVE, quantities=quantities)
    ]


def _of_test(when: When, test: Verification) -> Iterator[Quantity]:
    """A quantity for each observable, by its limit on the error where there is one, else on the spread."""
    by_observable = {row.name.rpartition(" ")[2]: row for row in test.rows}
    for name, row in by_observable.items():
        squares, freedom = scatter(test, row)
        if freedom > 0:
            value = float(np.sqrt(squares / freedom))
            sd, k = value / float(np.sqrt(2 * freedom)), float(student_factor(freedom))
            yield Quantity(
                id=f"repeatability-{name}-{when.replace(' ', '-')}",
                name=f"repeatability of {name}, {when}",
                unit=row.unit,
                value=value,
                standard_uncertainty=sd,
                expanded_uncertainty=k * sd,
                coverage_factor=k,
                coverage_probability=PROBABILITY,
                at=f"{test.stations} stations, {freedom} degrees of freedom",
            )


def scatter(test: Verification, row: VerdictRow) -> tuple[float, int]:
    """Sum of squares of a row's departures about the curves of its roll sets, and its degrees of freedom.

    Definition: of a set of n stations n - 5; n - 3 of a curve of one harmonic. Reference: JCGM 100:2008, 4.2 and H.3.
    """
    squares, freedom = 0.0, 0
    for each in row.sets:
        stations = [test.station_rows[place] for place in each.stations]
        known = [s for s in stations if s.toolface_deg is not None and row.name in s.departures]
        count = len(FITTED[each.harmonics])
        if each.coefficients is None or len(known) <= count:
            continue
        turn = np.radians([s.toolface_deg for s in known if s.toolface_deg is not None])
        departures = np.array([s.departures[row.name] for s in known])
        left = departures - basis(turn) @ np.array(each.coefficients)
        squares += float(np.sum(left**2))
        freedom += len(known) - count
    return squares, freedom
