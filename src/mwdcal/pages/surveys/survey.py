"""The page of the surveys of a well."""

from __future__ import annotations

from collections.abc import Mapping

from mwdcal import __version__
from mwdcal.calibration.readings import is_simulated, serial_of
from mwdcal.calibration.record import Finding
from mwdcal.pages.page import banner, environment
from mwdcal.pages.surveys import survey_figures as figures
from mwdcal.screens.surveys.survey import (
    SurveySummary,
    declination_in_words,
    end_in_words,
    sources_in_words,
    summary,
    survey_rows,
)
from mwdcal.screens.text import plural
from mwdcal.survey.well import Well

MOST_ROWS_OF_PAGE = 2000
"""Surveys in the table of a page."""


def render(well: Well, findings: list[Finding], sha256: Mapping[str, str]) -> str:
    """The surveys as HTML; `sha256` of the files they come from, by what these are."""
    facts = summary(well, "", "")
    stated = well.readings.metadata, well.calibration.tool
    header, rows = survey_rows(well, MOST_ROWS_OF_PAGE)
    has_path = figures.has_path(well.position)
    return (
        environment()
        .get_template("survey.html")
        .render(
            facts=facts,
            modelled=well.limits.probability is not None,
            readings=well.readings.source,
            serial=next(filter(None, map(serial_of, stated)), None),
            simulated=any(map(is_simulated, stated)),
            banner=_banner(facts),
            findings=findings,
            strengths=figures.strengths(well) if facts.not_judged < facts.rows else None,
            angles=figures.angles(well),
            path=figures.path(well) if has_path else None,
            enlarged=figures.enlargement(well.position) if has_path and well.position else 1.0,
            terms=well.terms.sentence,
            declination=declination_in_words(facts),
            sources=sources_in_words(facts).partition("   ")[2],
            end=end_in_words(facts.end, facts.north) if facts.end else "",
            header=header,
            rows=rows,
            more=facts.rows - len(rows),
            calibration=well.calibration.run_name,
            sha256=sha256,
            version=__version__,
        )
    )


def _banner(facts: SurveySummary) -> dict[str, str]:
    """How many surveys may be used."""
    headline = (
        f"{facts.accepted} of {plural(facts.rows, 'survey')} within the limits {facts.limits}"
    )
    north = f"Azimuths count from {facts.north} north"
    if facts.rejected:
        return banner("bad", "Rejected", headline, f"{facts.rejected} outside. {north}")
    if facts.not_judged or facts.blank:
        return banner("attention", "Attention", headline, f"{facts.not_judged} not judged. {north}")
    if facts.blind:
        return banner(
            "attention", "Attention", headline, f"{facts.blind} blind to interference. {north}"
        )
    if any(finding.id == "partly-judged" for finding in facts.findings):
        return banner("attention", "Attention", headline, f"Judged in part. {north}")
    return banner("good", "Accepted", headline, north)
