"""The command line: a thin twin of the library. Results on stdout, messages on stderr."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, Unpack

import click

from mwdcal import __version__
from mwdcal.app.asked import Asked, standstill_options
from mwdcal.errors import InputError, MwdcalError

if TYPE_CHECKING:
    from mwdcal.app.choices import Chosen, Typed
    from mwdcal.calibration import Calibration, Finding
    from mwdcal.notation import Notation
    from mwdcal.profile import Profile
    from mwdcal.readings import Readings

INTERNAL = 70
INTERRUPTED = 130
COLDEST, HOTTEST = -273.15, 1000.0


class Digests(TypedDict):
    """What the calibration file says about its sources."""

    profile_sha256: str
    run_sha256: str


FILE = click.Path(path_type=Path)
as_json = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
decimal_sign = click.option(
    "--decimal",
    default=".",
    show_default=True,
    metavar="SIGN",
    help="Decimal sign of numbers in text files.",
)


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="mwdcal")
def cli() -> None:
    """Calibrate MWD directional sensors, verify the result, and apply it to readings.

    \b
    mwdcal calibrate run.csv --tool servo -o tool.json --report tool.html
    mwdcal verify tool.json rolltest.csv
    mwdcal apply tool.json surveys.csv -o corrected.csv
    """


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
@click.argument("run", type=FILE)
@click.option(
    "-o",
    "--output",
    type=FILE,
    required=True,
    metavar="CAL.json",
    help="Calibration file to write.",
)
@click.option("--tool", metavar="NAME|FILE", help="Tool profile: a shipped name or a TOML file.")
@click.option(
    "--method", default="joint", show_default=True, metavar="METHOD",
    help="joint: all evidence, weighted. least-squares: reference vectors only. swarm: the same "
    "by particle swarm. newton: Newton-Raphson on |g| and inclination. toolface-inclination: the "
    "accelerometer by angles alone. scalar: |g| and |b| alone.",
)  # fmt: skip
@click.option(
    "--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of the swarm."
)
@click.option(
    "--paper-weights", is_flag=True,
    help="Sum the squares as the method's paper does, unweighted, instead of by their uncertainty.",
)  # fmt: skip
@click.option(
    "--robust", type=click.Choice(["huber", "student-t"]),
    help="Bound what a bad station can do: huber keeps a little of its pull, student-t loses it.",
)  # fmt: skip
@click.option(
    "--prior", metavar="CAL.json|datasheet",
    help="What is known beforehand: a previous calibration of this tool, with its covariance, or "
    "the tolerances in the tool profile.",
)  # fmt: skip
@click.option(
    "--estimate", default="", metavar="NAMES",
    help="Errors of the stand to find as well: azimuth-zero, tilt, or both with a comma.",
)  # fmt: skip
@click.option(
    "--model",
    type=click.Choice(["polynomial", "factors"]),
    help="Default: polynomial at order 0, factors above.",
)
@click.option(
    "--parameters", type=click.Choice(["12", "9", "6"]), default="12", show_default=True,
    help="Per triad at one temperature. 9: the sensor frame, without mounting rotation. "
    "6: scale and bias alone.",
)  # fmt: skip
@click.option(
    "--order",
    default="auto",
    show_default=True,
    metavar="0…3|auto",
    help="Order of temperature terms.",
)
@click.option(
    "--nonlinearity", default="auto", show_default=True, metavar="auto|none|NAMES",
    help="Own-axis quadratic and cubic terms. auto: of the triads whose profile declares them, "
    "where left-out stations improve. NAMES: accelerometer, magnetometer, or both with a comma.",
)  # fmt: skip
@click.option(
    "--exclude", multiple=True, metavar="STATION", help="Leave a station out; may be repeated."
)
@click.option(
    "--report", type=FILE, metavar="R.html", help="Also write a self-contained HTML report."
)
@decimal_sign
@as_json
def calibrate(
    run: Path, output: Path, tool: str | None, exclude: tuple[str, ...], report: Path | None,
    decimal: str, as_json: bool, **typed: Unpack[Typed],
) -> None:  # fmt: skip
    """Fit the sensor model to a calibration RUN (CSV, TSV, Parquet or XLSX).

    \b
    Example: mwdcal calibrate run.csv --tool servo -o tool.json --report tool.html
    Exit: 0 calibrated, 2 input cannot be read, 3 fit failed or refused.
    """
    from mwdcal.app.choices import choose
    from mwdcal.calibrate import calibrate as fit
    from mwdcal.files import documents

    _check_outputs([output, report], [run, Path(tool or ""), Path(typed["prior"] or "")])
    readings, profile, digests = _load(run, tool, decimal)
    readings = _without(readings, exclude)
    chosen = choose(readings, profile, typed, say)
    made = fit(readings, profile, chosen.options, orders=chosen.orders, **digests)
    if report:
        from mwdcal.app.report import write_report

        write_report(report, made)
    documents.write(output, made)
    if as_json:
        print_json(
            {
                **_summary(made),
                "orders": made.orders,
                "nonlinearity": chosen.curves,
                "calibration": str(output),
                "report": str(report or ""),
            }
        )
    else:
        _show(made, chosen, output, report)


def _check_outputs(outputs: list[Path | None], inputs: list[Path]) -> None:
    """Refuse, before any work, an output that cannot be written or would replace an input."""
    from mwdcal.files import atomic

    taken = [path.resolve() for path in inputs if path.is_file()]
    for path in filter(None, outputs):
        target = atomic.target(path)
        if target in taken:
            raise InputError(
                f"cannot write '{path}': it is named twice, or is an input that would be lost. "
                "Name another file."
            )
        taken.append(target)


def _load(run: Path, tool: str | None, decimal: str) -> tuple[Readings, Profile, Digests]:
    from mwdcal.files import profiles, runs, table

    profile, profile_sha256 = profiles.load_profile(tool)
    read = table.read(run, decimal=decimal)
    readings, profile = runs.to_readings(read, profile)
    digests = Digests(profile_sha256=profile_sha256, run_sha256=read.digest)
    return readings, profile, digests


def _without(readings: Readings, exclude: tuple[str, ...]) -> Readings:
    import numpy as np

    twice = [label for label in exclude if readings.station.count(label) > 1]
    if twice:
        raise InputError(
            f"--exclude {twice[0]}: {readings.station.count(twice[0])} stations of {readings.source} "
            "have this label. Give each its own in the column 'station'."
        )
    missing = [label for label in exclude if label not in readings.station]
    if missing:
        raise InputError(
            f"--exclude {missing[0]}: no such station in {readings.source}; "
            f"stations are {readings.station[0]} … {readings.station[-1]}."
        )
    return readings.select(np.array([label not in exclude for label in readings.station]))


def _summary(made: Calibration) -> dict[str, Any]:
    from mwdcal.predict import typical_accuracy

    triads = {
        t.name: {
            "rank": t.rank,
            "size": t.size,
            "undetermined": t.undetermined,
            "variance_factor": t.variance_factor,
        }
        for t in made.triads
    }
    return {
        "run": made.run, "stations": made.stations, "method": made.method, "triads": triads,
        "errors": made.errors, "accuracy_1sigma_deg": typical_accuracy(made), "constants": made.constants,
        "stand": made.stand,
        "findings": made.findings,
    }  # fmt: skip


def _show(made: Calibration, chosen: Chosen, output: Path, report: Path | None) -> None:
    from mwdcal.app import text
    from mwdcal.predict import typical_accuracy

    click.echo(text.heading(made) + "\n")
    if made.orders:
        click.echo(text.orders(made.orders) + "\n")
    if chosen.curves:
        click.echo(text.curves(chosen.curves) + "\n")
    click.echo(text.errors(made.errors) + "\n")
    accuracy = "  ".join(
        f"{n} {text.number(v)}{'°' if v is not None else ''}"
        for n, v in typical_accuracy(made).items()
    )
    click.echo(f"accuracy to expect (1σ, calibration alone, typical): {accuracy}")
    for constant in made.constants:
        value = f"{constant.value:.6g} ± {constant.standard_uncertainty:.2g} {constant.unit}"
        click.echo(f"estimated constant of the run: {constant.name} {value}")
    for line in text.stand(made.stand) + text.findings(made.findings):
        click.echo(line)
    wrote = f"wrote {output} (calibration)" + (f"   {report} (report)" if report else "")
    click.echo(f"{wrote}   next: mwdcal verify {output} ROLLTEST.csv")


@cli.command()
@click.argument("run", type=FILE)
@click.option("--tool", metavar="NAME|FILE", help="Tool profile: a shipped name or a TOML file.")
@click.option(
    "--order", type=click.IntRange(0, 3), default=0, show_default=True, help="Temperature order."
)
@decimal_sign
@as_json
def compare(run: Path, tool: str | None, order: int, decimal: str, as_json: bool) -> None:
    """Calibrate a RUN by every method, side by side, judged by stations left out.

    \b
    Example: mwdcal compare run.csv --tool servo
    Exit: 0 compared, 2 input cannot be read.
    """
    from mwdcal.app import text
    from mwdcal.compare import compare as side_by_side

    readings, profile, _ = _load(run, tool, decimal)
    say("every method, and each again with an eighth of the stations left out in turn")
    found = side_by_side(readings, profile, order)
    if as_json:
        print_json(text.plain(found))
    else:
        click.echo(text.comparison(found))


@cli.command()
@standstill_options
def stations(**asked: Unpack[Asked]) -> None:
    """Find the standstills in a continuous LOG and write each as a station of a run file.

    \b
    Example: mwdcal stations log.csv -o run.csv --plot log.png
    Exit: 0 written, 2 input cannot be read or never stands still.
    """
    from mwdcal.app import standstills

    _check_outputs([asked["output"], asked["plot"]], [asked["log"]])
    findings, result = standstills.run(asked, say)
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
    "--outside", type=click.Choice(["blank", "refuse", "extrapolate"]), default="blank", show_default=True,
    help="Rows outside the calibrated temperature range.",
)  # fmt: skip
@decimal_sign
@as_json
def apply(
    calibration: Path, readings: Path, output: Path, outside: str, decimal: str, as_json: bool
) -> None:
    """Correct READINGS with a CALIBRATION: adds vectors, angles and strengths as columns.

    \b
    Example: mwdcal apply tool.json surveys.csv -o corrected.csv
    Exit: 0 written, 2 input cannot be read.
    """
    from mwdcal.app.tables import apply_to_table
    from mwdcal.files import documents, table

    _check_outputs([output], [calibration])
    made = documents.read(calibration)
    source = table.read(readings, decimal=decimal)
    result, findings = apply_to_table(made, source, outside)
    table.write(output, result)
    tell(findings)
    if as_json:
        print_json({"rows": source.count, "output": str(output), "findings": findings})
    else:
        click.echo(f"{source.count} rows corrected   wrote {output}")


@cli.command()
@click.argument("calibration", type=FILE)
@click.argument("run", type=FILE)
@click.option(
    "--limits", default="roll-test", show_default=True, metavar="NAME|FILE", help="Limits profile."
)
@click.option(
    "--report", type=FILE, metavar="R.html", help="Also write the report, with this verdict."
)
@decimal_sign
@as_json
def verify(
    calibration: Path, run: Path, limits: str, report: Path | None, decimal: str, as_json: bool
) -> None:
    """Prove a CALIBRATION by a roll test: a RUN whose stations were not in the fit.

    \b
    Example: mwdcal verify tool.json rolltest.csv --limits roll-test
    Exit: 0 pass, 1 fail, 2 input cannot be read or is not independent.
    """
    from mwdcal.app import text
    from mwdcal.files import documents, runs, table
    from mwdcal.files.limits import load_limits
    from mwdcal.quality import verify as judge

    _check_outputs([report], [calibration, run])
    made = documents.read(calibration)
    readings, _ = runs.to_readings(table.read(run, decimal=decimal), made.profile)
    result = judge(made, readings, load_limits(limits))
    if report:
        from mwdcal.app.report import write_report

        write_report(report, made, result)
    if as_json:
        print_json(result)
    else:
        click.echo(text.verdict(result))
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
@as_json
def convert(
    calibration: Path, notation: str, temperature: str | None, output: Path | None, as_json: bool
) -> None:
    """Print a CALIBRATION in another notation, in raw units, with covariance.

    \b
    forward: raw = S·field + o    affine: field = M·raw + b    factors: SF, B, m (Moosavi)
    Example: mwdcal convert tool.json --notation forward --json
    Example: mwdcal convert tool.json --notation forward --temperature course
    """
    from mwdcal.app import text
    from mwdcal.files import atomic, documents
    from mwdcal.notation import COURSE
    from mwdcal.notation import convert as rewrite

    _check_outputs([output], [calibration])
    at = _temperature(temperature)
    made = documents.read(calibration)
    found = rewrite(made, notation, at)
    if not as_json and output is None:
        click.echo(text.notation(found, made.reference_temperature if at == COURSE else None))
        return
    document = _notation_document(made, notation, at, found)
    if output is None:
        print_json(document)
    else:
        import msgspec

        atomic.write(output, msgspec.json.format(msgspec.json.encode(document), indent=2) + b"\n")
        click.echo(f"wrote {output}")


def _temperature(option: str | None) -> float | str | None:
    """A temperature in °C if it is a number; a word is left to `notation.convert`."""
    try:
        value = None if option is None else float(option)
    except ValueError:
        return option
    if value is not None and not COLDEST <= value <= HOTTEST:
        raise InputError(
            f"--temperature must be between {COLDEST:g} and {HOTTEST:g} °C; got {value:g}."
        )
    return value


def _notation_document(
    made: Calibration, notation: str, temperature: float | str | None, found: dict[str, Notation]
) -> dict[str, Any]:
    document: dict[str, Any] = {"notation": notation, "temperature_c": temperature}
    if isinstance(temperature, str):
        document["powers_of"] = "T - reference_temperature_c"
    elif notation == "factors" or temperature is None:
        document["temperature_c"] = made.reference_temperature
    for name, item in found.items():
        profile = getattr(made.profile, name)
        document[name] = {
            **{k: v.tolist() for k, v in item.values.items()},
            "reference_temperature_c": made.reference_temperature,
            "axes": profile.axes,
            "standard_uncertainty": {k: v.tolist() for k, v in item.uncertainty.items()},
            "covariance": item.covariance.tolist(),
        }
    return document


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


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; no traceback ever reaches the user."""
    try:
        code = cli.main(arguments, prog_name="mwdcal", standalone_mode=False)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except click.Abort:
        say("mwdcal: interrupted. Files are as they were before.")
        sys.exit(INTERRUPTED)
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
