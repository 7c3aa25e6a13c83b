"""The command line: a thin twin of the library. Results on stdout, messages on stderr."""

from __future__ import annotations

import os
import re
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import click

from mwdcal import __version__
from mwdcal.app.block_pandas import without_pandas
from mwdcal.app.commands.fleet_options import Asked as FleetAsked
from mwdcal.app.commands.fleet_options import fleet_options
from mwdcal.app.commands.noise_options import Asked as AskedForNoise
from mwdcal.app.commands.noise_options import noise_options
from mwdcal.app.commands.options import (
    DECIMAL,
    FILE,
    JSON,
    Asked,
    AskedToCompare,
    calibration_options,
    comparison_options,
    standstill_options,
)
from mwdcal.errors import FitError, InputError, MwdcalError

if TYPE_CHECKING:
    from mwdcal.app.commands.choices import Typed
    from mwdcal.calibration.record import Finding

INTERNAL = 70
SIGNAL = 128
"""Exit status of an ended command, less the number of the signal that ended it."""
PATIENCE = 5.0
"""Seconds after which another signal ends at once a command that is still tidying up."""


class Command(click.Command):
    """A command whose errors name its options as they are typed: the library has arguments in backticks."""

    def invoke(self, context: click.Context) -> Any:
        """Run the command."""
        options = {p.name: p.opts[-1] for p in self.params if isinstance(p, click.Option)}
        try:
            return super().invoke(context)
        except MwdcalError as error:
            error.args = (re.sub(r"`(\w+)`", lambda m: options.get(m[1], m[0]), str(error)),)
            raise


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="mwdcal")
def cli() -> None:
    """Calibrate MWD directional sensors, verify the result, and apply it to readings.

    \b
    mwdcal calibrate run.csv --tool servo -o tool.json --report tool.html
    mwdcal verify tool.json rolltest.csv
    mwdcal apply tool.json surveys.csv -o corrected.csv
    """


cli.command_class = Command


def say(text: str) -> None:
    """A message for people, on stderr."""
    click.echo(text, err=True)


def tell(findings: list[Finding]) -> None:
    """Findings, on stderr."""
    for finding in findings:
        say(f"! {finding.text}")


def print_json(value: Any) -> None:
    """A result for machines, on stdout."""
    import msgspec

    click.echo(msgspec.json.format(msgspec.json.encode(value), indent=2).decode())


@cli.command()
@calibration_options
def calibrate(
    run: Path, output: Path, tool: str | None, exclude: tuple[str, ...], report: Path | None,
    decimal: str, as_json: bool, **typed: Unpack[Typed],
) -> None:  # fmt: skip
    """Fit the sensor model to a calibration RUN (CSV, TSV, Parquet or XLSX).

    \b
    Example: mwdcal calibrate run.csv --tool servo -o tool.json --report tool.html
    Exit: 0 calibrated, 2 input cannot be read, 3 fit failed or refused.
    """
    from mwdcal.app.commands import calibrate
    from mwdcal.calibration.diagnosis.findings import UNUSED

    _check_outputs([output, report], [run, Path(tool or ""), Path(typed["prior"] or "")])
    chosen, made = calibrate.run(run, tool, exclude, decimal, typed, say)
    calibrate.write(made, output, report)
    tell([finding for finding in made.findings if finding.id == UNUSED])
    if as_json:
        print_json(calibrate.summary(made, chosen, output, report))
    else:
        click.echo(calibrate.screen(made, chosen, output, report))


def _check_outputs(outputs: list[Path | None], inputs: list[Path]) -> None:
    """Refuse, before any work, an output that cannot be written or would replace an input."""
    from mwdcal.files.formats import atomic

    taken = [path.resolve() for path in inputs if path.is_file()]
    for path in filter(None, outputs):
        target = atomic.target(path)
        if target in taken:
            raise InputError(
                f"cannot write '{path}': it is named twice, or is an input that would be lost. "
                "Name another file."
            )
        taken.append(target)


@cli.command()
@comparison_options
def compare(**asked: Unpack[AskedToCompare]) -> None:
    """Calibrate a RUN by every method, side by side, judged by stations left out.

    \b
    Example: mwdcal compare run.csv --tool servo --report methods.html
    Exit: 0 compared, 2 input cannot be read, 3 every method refused.
    """
    from mwdcal.app.commands import calibrate, compare
    from mwdcal.calibration.diagnosis.findings import unused_columns

    _check_outputs([asked["report"]], [asked["run"], Path(asked["tool"] or "")])
    readings, profile, digests = calibrate.load(asked["run"], asked["tool"], asked["decimal"])
    tell(unused_columns(readings.unused))
    sound, result = compare.run(asked, readings, profile, say, **digests)
    (print_json if asked["as_json"] else click.echo)(result)
    sys.exit(0 if sound else FitError.exit_code)


@cli.command()
@standstill_options
def stations(**asked: Unpack[Asked]) -> None:
    """Find the standstills in a continuous LOG and write each as a station of a run file.

    \b
    Example: mwdcal stations log.csv -o run.csv --plot log.png
    Exit: 0 written, 2 input cannot be read or never stands still.
    """
    from mwdcal.app.commands import stations

    _check_outputs([asked["output"], asked["plot"]], [asked["log"]])
    findings, result = stations.run(asked, say)
    tell(findings)
    (print_json if asked["as_json"] else click.echo)(result)


@cli.command()
@click.argument("calibration", type=FILE)
@click.argument("readings", type=FILE)
@click.option(
    "-o",
    "--output",
    type=FILE,
    required=True,
    metavar="OUT",
    help="Table to write; format by suffix.",
)
@click.option(
    "--outside", default="blank", show_default=True, metavar="blank|refuse|extrapolate",
    help="Results of rows more than 1 °C (without temperature terms: 5 °C) outside the calibrated "
    "temperatures: none; refuse the file; or extrapolated, and marked in a column 'extrapolated'.",
)  # fmt: skip
@click.option(
    "--missing", type=click.Choice(["refuse", "blank"]), default="refuse", show_default=True,
    help="Rows with a blank reading or temperature: refuse the file, or leave their results blank.",
)  # fmt: skip
@DECIMAL
@JSON
def apply(
    calibration: Path, readings: Path, output: Path, outside: str, missing: str, decimal: str,
    as_json: bool,
) -> None:  # fmt: skip
    """Correct READINGS (CSV, TSV, Parquet or XLSX) with the CALIBRATION of their tool.

    Writes the columns of READINGS as they are and, beside them: gravity and field along the tool
    axes, inclination, azimuth (magnetic), toolface, dip and strengths.

    \b
    Example: mwdcal apply tool.json surveys.csv -o corrected.csv
    Exit: 0 written, 2 input cannot be read, or does not belong to the calibration.
    """
    from mwdcal.app.commands.apply import apply_to_any
    from mwdcal.app.progress import bar
    from mwdcal.calibration.readings import simulated
    from mwdcal.files import documents
    from mwdcal.files.runs import BlankReadingError

    _check_outputs([output], [calibration, readings])
    made = documents.read(calibration)
    try:
        with bar("correcting") as advance:
            told = apply_to_any(made, readings, output, outside, missing, decimal, advance)
    except BlankReadingError as error:
        advice = "Or leave the results of such rows blank: --missing blank."
        raise InputError(f"{error} {advice}") from None
    tally, findings = told
    tell(findings)
    blank = tally.blank(outside)
    found = {"rows": tally.rows, "blank": blank, "output": str(output), "findings": findings}
    if as_json:
        print_json(found)
    else:
        none = f", {blank} of them blank" if blank else ""
        corrected = f"{tally.rows} rows corrected{none}   wrote {output}"
        click.echo("   ".join([corrected, *simulated(made.tool)]))


@cli.command()
@click.argument("calibration", type=FILE)
@click.argument("run", type=FILE)
@click.option(
    "--limits", default="roll-test", show_default=True, metavar="NAME|FILE", help="Limits profile."
)
@click.option(
    "--report", type=FILE, metavar="R.html", help="Also write the report, with this verdict."
)
@DECIMAL
@JSON
def verify(
    calibration: Path, run: Path, limits: str, report: Path | None, decimal: str, as_json: bool
) -> None:
    """Prove a CALIBRATION by a roll test: a RUN whose stations were not in the fit.

    \b
    Example: mwdcal verify tool.json rolltest.csv --limits roll-test
    Exit: 0 pass, 1 fail, 2 input cannot be read or is not independent.
    """
    import msgspec

    from mwdcal.app import text
    from mwdcal.calibration.diagnosis.findings import unused_columns
    from mwdcal.files import documents, runs
    from mwdcal.files.limits import load_limits
    from mwdcal.use.verification import verify as judge

    _check_outputs([report], [calibration, run])
    made = documents.read(calibration)
    readings, _ = runs.read_run(run, made.profile, decimal=decimal)
    result = judge(made, readings, load_limits(limits))
    seen = [*result.findings, *unused_columns(readings.unused)]
    result = msgspec.structs.replace(result, findings=seen)
    if report:
        from mwdcal.app.pages.report import write_report

        write_report(report, made, result)
    if as_json:
        print_json(result)
    else:
        click.echo(text.verdict(result, made.tool, readings.metadata))
    tell(result.findings)
    sys.exit(0 if result.passed else 1)


@cli.command()
@click.argument("calibration", type=FILE)
@click.option(
    "--notation",
    required=True,
    type=click.Choice(["factors", "forward", "affine"]),
    help="Form to print.",
)
@click.option(
    "--temperature",
    metavar="°C|course",
    help="One temperature, or 'course': coefficients by power of T - reference. "
    "Default: the reference temperature.",
)
@click.option(
    "-o", "--output", type=FILE, metavar="OUT.json", help="Write JSON here instead of printing."
)
@JSON
def convert(
    calibration: Path, notation: str, temperature: str | None, output: Path | None, as_json: bool
) -> None:
    """Print a CALIBRATION in another notation, in raw units, with covariance.

    \b
    forward: raw = S·field + o    affine: field = M·raw + b    factors: SF, B, m (Moosavi)
    Example: mwdcal convert tool.json --notation forward --json
    Example: mwdcal convert tool.json --notation forward --temperature course
    """
    from mwdcal.app.commands import convert

    _check_outputs([output], [calibration])
    made = convert.run(calibration, notation, _temperature(temperature))
    tell(made.findings)
    if output is not None:
        import msgspec

        from mwdcal.files.formats import atomic

        content = msgspec.json.encode(convert.document(made))
        atomic.write(output, msgspec.json.format(content, indent=2) + b"\n")
        click.echo(f"wrote {output}")
    elif as_json:
        print_json(convert.document(made))
    else:
        click.echo(convert.screen(made))


def _temperature(option: str | None) -> float | str | None:
    """A temperature in °C if it is a number; a word is left to `notation.convert`."""
    try:
        value = None if option is None else float(option)
    except ValueError:
        return option
    from mwdcal.files.contract import TEMPERATURE

    low, high = TEMPERATURE.low, TEMPERATURE.high
    if value is not None and not low <= value <= high:
        raise InputError(f"--temperature must be between {low:g} and {high:g} °C; got {value:g}.")
    return value


@cli.command()
@fleet_options
def fleet(**asked: Unpack[FleetAsked]) -> None:
    """Calibrate many tools: RUNS is a Parquet table, or a folder of them, with a column `serial`.

    Interrupted, the same command goes on where it was: finished parts are kept beside the output.

    \b
    Example: mwdcal fleet runs.parquet -o cals.parquet --tool servo --report fleet.html
    Exit: 0 at least one tool calibrated, 2 input cannot be read, 3 not a single one.
    """
    from mwdcal.app import pool

    with pool.preparing(1 if asked["scheduler"] else asked["workers"]):
        from mwdcal.app.commands import fleet

    _check_outputs([asked["output"], asked["report"]], [asked["runs"], Path(asked["tool"] or "")])
    try:
        sound, result = fleet.run(asked, say)
    except KeyboardInterrupt as stop:
        stop.add_note("Finished parts are kept: the same command goes on from there.")
        raise
    (print_json if asked["as_json"] else click.echo)(result)
    sys.exit(0 if sound else fleet.REFUSED)


@cli.command()
@noise_options
def noise(**asked: Unpack[AskedForNoise]) -> None:
    """Noise of every raw channel of a LOG of a tool at rest, by Allan deviation.

    \b
    Example: mwdcal noise static.csv --tool servo --plot noise.png
    Exit: 0 found, 2 input cannot be read or used.
    """
    from mwdcal.app.commands import noise

    inputs = [asked["log"], Path(asked["tool"] or "")]
    _check_outputs([asked["plot"], asked["report"]], inputs)
    findings, result = noise.run(asked, say)
    tell(findings)
    (print_json if asked["as_json"] else click.echo)(result)


@cli.command()
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion(shell: str) -> None:
    """Print the completion script of a SHELL.

    \b
    Example: mwdcal completion bash >> ~/.bashrc
    """
    from click.shell_completion import get_completion_class

    found = get_completion_class(shell)
    if found is not None:
        click.echo(found(cli, {}, "mwdcal", "_MWDCAL_COMPLETE").source())


class Ended(KeyboardInterrupt):
    """Somebody asks to end, by Ctrl-C or otherwise; the argument is the signal's number."""


@contextmanager
def _orderly_end() -> Iterator[None]:
    """Meanwhile, the first signal to end is an interruption, and others do not disturb the tidying."""
    asked: list[float] = []

    def end(number: int, frame: object) -> None:
        if not asked:
            asked.append(time.monotonic())
            raise Ended(number)
        if time.monotonic() - asked[0] > PATIENCE:
            os._exit(SIGNAL + number)

    usual = (signal.SIG_DFL, signal.default_int_handler)
    known = [getattr(signal, name, None) for name in ("SIGINT", "SIGTERM", "SIGHUP")]
    before = {each: signal.getsignal(each) for each in known if each}
    found = {each: handler for each, handler in before.items() if handler in usual}
    try:
        for each in found:
            signal.signal(each, end)
    except ValueError:  # signals belong to the main thread
        found = {}
    try:
        yield
    finally:
        for each, handler in found.items():
            signal.signal(each, signal.SIG_IGN if asked else handler)  # only the exit is left


def _interrupted(stop: BaseException) -> int:
    """Say what an interruption leaves, and which; the exit status."""
    left = getattr(stop, "__notes__", ["Files are as they were before."])
    number = stop.args[0] if isinstance(stop, Ended) else signal.SIGINT
    say(f"mwdcal: {'interrupted' if number == signal.SIGINT else 'terminated'}. {' '.join(left)}")
    return SIGNAL + int(number)


def _run(arguments: list[str] | None) -> object:
    """Run a command; without arguments that of this process, which is then ours alone."""
    if arguments is None:
        without_pandas()
    with _orderly_end():
        return cli.main(arguments, prog_name="mwdcal", standalone_mode=False)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; no traceback ever reaches the user."""
    try:
        code = _run(arguments)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except (click.Abort, KeyboardInterrupt) as stop:
        sys.exit(_interrupted(stop.__cause__ or stop))
    except MwdcalError as error:
        say(f"mwdcal: {error}")
        sys.exit(error.exit_code)
    except MemoryError:
        say("mwdcal: not enough memory for this input. Split the file, or use a larger machine.")
        sys.exit(2)
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            say(f"mwdcal: cannot write the result: {error.strerror or error}. Send it elsewhere.")
        sys.exit(2)
    except Exception as error:
        if os.environ.get("MWDCAL_DEBUG"):
            raise
        say(
            f"mwdcal: internal error ({type(error).__name__}: {error}). This is a defect of "
            "mwdcal: please report it with the command and the file. MWDCAL_DEBUG=1 shows where."
        )
        sys.exit(INTERNAL)
    if isinstance(code, int):
        sys.exit(code)
