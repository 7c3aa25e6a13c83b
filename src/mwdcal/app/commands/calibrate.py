"""`mwdcal calibrate`: a run to a calibration file."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, Unpack

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import lines, print_result, say
from mwdcal.errors import InputError, MwdcalError, QuestionError, QuestionsError

if TYPE_CHECKING:
    from mwdcal.calibration.readings import Readings
    from mwdcal.calibration.record import Calibration
    from mwdcal.use.verification import Verdict


_Judgement: TypeAlias = "tuple[Verdict | None, tuple[str, str], MwdcalError | None]"
NOT_JUDGED: _Judgement = (None, ("", ""), None)
"""A calibration without a verdict."""


@options.command()
@options.RUN
@options.output(metavar="CAL.json", help="Calibration file to write.")
@options.tool()
@options.fit_options(
    "auto",
    "auto",
    "CAL.json|datasheet",
    "a previous calibration of this tool, with its covariance, or the tolerances in the tool profile",
)
@click.option(
    "--exclude", multiple=True, metavar="STATION", help="Leave a station out; may be repeated."
)
@click.option(
    "--rolltest",
    type=options.FILE,
    metavar="TABLE",
    help="Verify the result by this roll test at once; the RUN itself where a sheet or a column marks it.",
)
@options.LIMITS
@click.option(
    "--registry",
    metavar="URL|FILE",
    help="Enter calibration, run, tool profile and verdict in this registry.",
)
@options.report()
@partial(options.of_roll_test, beside_run=True)
@options.of_run
@options.DECIMAL
@options.JSON
def command(
    run: Path, output: Path, tool: str | None, exclude: tuple[str, ...], rolltest: Path | None, limits: str,
    registry: str | None, report: Path | None, decimal: str, as_json: bool, **typed: Unpack[options.FitArguments],
) -> None:  # fmt: skip
    """Fit the sensor model to a calibration RUN (CSV, TSV, Parquet, XLSX, WITSML or LAS).

    \b
    Example: mwdcal calibrate run.csv --tool servo -o tool.json --rolltest roll.csv
    Exit: 0 calibrated (and passed), 1 the roll test fails, 2 input cannot be read or not verified, 3 fit failed.
    """
    from mwdcal.app.inputs import load_runs, prior_of
    from mwdcal.calibration.calibrate import chosen_fit, recorded
    from mwdcal.calibration.options import options_of
    from mwdcal.files import documents
    from mwdcal.files.formats import atomic
    from mwdcal.presentation import calibration as screen

    inputs = [run, tool, typed["prior"], rolltest, limits, registry]
    options.check_outputs([output], inputs, page=report, calibration=True, form=".json")
    _enter(registry)
    prior, digest = prior_of(typed["prior"])
    readings, profile, test, beside = load_runs(run, rolltest, tool, prior, options.said(decimal))
    bounds, turned = None, None
    if rolltest or report:
        from mwdcal.files.limits import load_limits

        bounds = load_limits(limits)[0]
    if test:
        with _roll_test_as_input():
            turned = test.readings(profile)
    choice, result = chosen_fit(readings, profile, options_of(typed, prior, exclude, digest), say)
    calibration = recorded(choice, result)
    verdict, judged, refusal = NOT_JUDGED
    if turned is not None and rolltest:
        verdict, judged, refusal = _judged(calibration, turned, limits, (output, rolltest))
    noted = _with_refusal(calibration, refusal) if refusal else calibration
    rendered = ""
    if report:
        from mwdcal.presentation.calibration_page import render

        tested = [turned.metadata] if turned else []
        names = {"file": output.name, "rolltest": run.name if beside else screen.NEXT_ROLL_TEST}
        rendered = render(noted, verdict, *tested, limits=bounds, **names)
    files = output, report
    shown = (
        screen.summary(noted, choice.curves, *files, _for_machines(verdict, output, rolltest))
        if as_json
        else screen.screen(calibration, choice.curves, *files, judged, run if beside else None)
    )
    atomic.write_all([(output, documents.encode(calibration)), (report, rendered)])
    _enter(registry, output, run, tool, rolltest, verdict)
    print_result(shown, calibration.findings + (verdict.findings if verdict else []))
    if refusal:
        raise refusal
    sys.exit(0 if verdict is None or verdict.passed else 1)


def _judged(
    calibration: Calibration, rolltest: Readings, limits: str, files: tuple[Path, Path]
) -> _Judgement:
    """The verdict of a roll test, its text on screen with what to do next, and the error without a verdict.

    `files` of calibration and roll test.
    """
    from mwdcal.library.tasks import verify
    from mwdcal.presentation.verification import next_step, screen

    try:
        verdict = verify(calibration, rolltest, Path(limits))
    except MwdcalError as error:
        error.args = (f"not verified: {error}",)
        return *NOT_JUDGED[:2], error
    return verdict, (screen(verdict, None), next_step(verdict, *files)), None


def _with_refusal(calibration: Calibration, refusal: MwdcalError) -> Calibration:
    """The calibration for page and JSON: a finding says why the roll test could not be judged."""
    from msgspec.structs import replace

    from mwdcal.calibration.record import Finding

    finding = Finding(id="not-verified", text=str(refusal))
    return replace(calibration, findings=[*calibration.findings, finding])


@contextmanager
def _roll_test_as_input() -> Iterator[None]:
    """Refuse a roll test as an input that cannot be read, before anything is written."""
    try:
        yield
    except MwdcalError as error:
        problem = _with_options_on_roll_test(error)
        problem.exit_code = InputError.exit_code
        raise problem from None


def _with_options_on_roll_test(error: MwdcalError) -> MwdcalError:
    """An error; of questions on a roll test with the options that answer them beside a run."""
    if isinstance(error, QuestionsError):
        each = [_with_options_on_roll_test(question) for question in error.questions]
        return QuestionsError(error.source, [q for q in each if isinstance(q, QuestionError)])
    if not isinstance(error, QuestionError):
        return error
    answers = [
        answer._replace(
            arguments=tuple((options.BESIDE_RUN + name, v) for name, v in answer.arguments)
        )
        for answer in error.answers
    ]
    return QuestionError(error.text, answers)


def _for_machines(
    verdict: Verdict | None, calibration: Path, rolltest: Path | None
) -> Verdict | None:
    """A verdict in the words of the command, with what to do after a failure."""
    if verdict is None or rolltest is None:
        return verdict
    from msgspec.structs import replace

    from mwdcal.presentation.typed import findings_with_option_names
    from mwdcal.presentation.verification import with_next_step

    said = replace(verdict, findings=findings_with_option_names(verdict.findings))
    return with_next_step(said, calibration, rolltest)


def _enter(registry: str | None, *items: Path | str | Verdict | None) -> None:
    """Enter the files of a calibration in a registry, if one is named; without any see that it can be opened."""
    if not registry:
        return
    from mwdcal.library.registries import registry as open_tools
    from mwdcal.library.shown import VerdictFile

    files = dict.fromkeys(each for each in items if isinstance(each, Path))
    profiles = [Path(each) for each in items if isinstance(each, str) and Path(each).is_file()]
    verdicts = [
        VerdictFile(each) for each in items if each is not None and not isinstance(each, str | Path)
    ]
    with open_tools(registry) as tools:
        if items:
            answer = tools.add(*profiles, *verdicts, *files)
            for line in (answer.summary().strip().splitlines()[0], *lines(answer.findings)):
                say(line)
