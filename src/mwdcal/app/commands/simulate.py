"""`mwdcal simulate`: a run of a known tool and its truth, or a whole procedure many times."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

import click
from click.core import ParameterSource

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result
from mwdcal.errors import InputError

if TYPE_CHECKING:
    from mwdcal.planning.procedure import Part, Tools

MOST_TOOLS = 100_000
"""Repetitions of a procedure."""
ALWAYS = ("plan", "tool", "calibration", "order", "effects", "seed", "output", "as_json")
"""Options of one run and of many repetitions."""


@options.command()
@options.preset(
    "--plan",
    shell_complete=options.offers("plans"),
    metavar="NAME|FILE",
    default="twenty-four-state",
    help="A built-in plan, a TOML file of attitudes, or a run file.",
)
@options.tool(
    help="Profile, or that of a calibration, from whose tolerances the tool is drawn. Default: servo."
)
@click.option(
    "--calibration",
    type=options.FILE,
    metavar="CAL.json",
    help="The tool that this calibration describes, instead of one drawn. It gives the gravity, field and dip that the "
    "plan does not state.",
)
@click.option(
    "--effects",
    metavar="NAME|FILE",
    help="What happens besides noise, a TOML file: turn-on bias, wandering, resolution, backlash, lag, variation "
    "of the field; 'none' is a template.",
)
@options.output(metavar="RUN.csv", help="Run file to write; with --repeat a table of all tools.")
@click.option(
    "--truth", type=options.FILE, metavar="TRUTH.json", help="Also write what is true of the run."
)
@click.option(
    "--repeat",
    type=options.Whole(1, MOST_TOOLS),
    metavar="N",
    help="The whole procedure for N tools: run, fit, roll test, verdict. The options of the fit count only here.",
)
@options.preset(
    "--rolltest", metavar="NAME|FILE", default="roll-test", help="Plan of the roll test."
)
@options.preset(
    "--limits",
    shell_complete=options.offers("limits"),
    metavar="NAME|FILE",
    default="roll-test",
    help="Limits of the verdict.",
)
@click.option(
    "--workers", type=options.Whole(1), metavar="N", help="Processes. Default: one per core."
)
@options.plot(help="Also draw errors and figures of all tools.")
@options.fit_options("auto", "none", "datasheet", "the tolerances in the tool profile")
@options.JSON
def command(
    plan: str, tool: str | None, calibration: Path | None, effects: str | None, output: Path,
    truth: Path | None, repeat: int | None, rolltest: str, limits: str, workers: int | None,
    plot: Path | None, as_json: bool, **typed: Unpack[options.FitArguments],
) -> None:  # fmt: skip
    """Simulate a run: a tool, a plan, a stand with its errors, noise. The same seed, the same run.

    Always labelled as simulated. --order is that of the tool, by default the highest that the plan's soaks
    carry; --json prints the truth. With --repeat the distribution of the errors of many tools, and how often
    the verdict of their roll test is wrong.

    \b
    Example: mwdcal simulate --plan moosavi-12 --tool servo --seed 1 -o run.csv --truth truth.json
    Example: mwdcal simulate --plan moosavi-12 --tool servo --repeat 1000 -o tools.parquet
    Exit: 0 written, 2 input cannot be read, 3 the plan cannot give a calibration.
    """
    from mwdcal import pool

    _check(repeat, truth, calibration)
    tool = None if calibration else tool
    options.check_outputs(
        [output, truth], [plan, tool, calibration, effects, rolltest, limits], plot
    )
    with pool.preparing(workers) if repeat else nullcontext():  # these imports, in the workers too
        from mwdcal.app.inputs import prior_of
        from mwdcal.calibration.options import options_of
        from mwdcal.library import simulation
    chosen = options_of(typed, prior_of(typed["prior"])[0])
    result: simulation.RepeatedProcedure | simulation.SimulatedReadings
    if repeat:
        result = simulation.simulate(
            plan, tool, repeat=repeat, seed=typed["seed"], calibration=calibration, effects=effects,
            rolltest=rolltest, limits=limits, options=chosen, mapper=partial(_by_workers, workers),
        )  # fmt: skip
        result.save(output, plot)
    else:
        result = simulation.simulate(
            plan,
            tool,
            seed=typed["seed"],
            calibration=calibration,
            effects=effects,
            order=chosen.order,
        )
        result.save(output, truth)
    print_result(result.to_dict() if as_json else result.summary(), result.findings)


def _check(repeat: int | None, truth: Path | None, calibration: Path | None) -> None:
    """Refuse options that do not go together."""
    context = click.get_current_context()
    typed = [
        name
        for name in context.params
        if context.get_parameter_source(name) is ParameterSource.COMMANDLINE
    ]
    if repeat and truth:
        raise InputError(
            "`truth`: with `repeat` the table holds what is true of each tool. Leave it out."
        )
    if calibration and {"tool", "order"} & {*typed}:
        raise InputError(
            "`calibration` brings its own profile and order. Leave out `tool` and `order`."
        )
    inert = [name for name in typed if name not in (*ALWAYS, "truth")]
    if not repeat and inert:
        raise InputError(f"`{inert[0]}` goes with `repeat`. Leave it out, or add `repeat`.")


def _by_workers(
    workers: int | None, repeated: Callable[[Part], Tools], parts: Sequence[Part]
) -> list[Tools]:
    """The columns of all parts, by all cores; they do not depend on how many these are."""
    import pickle

    from mwdcal import pool
    from mwdcal.app import messages
    from mwdcal.planning.procedure import solved
    from mwdcal.use.correction_numba import cores

    steps, done = pool.Steps(tuple, partial(solved, repeated)), {}
    with messages.bar("simulating") as show:
        for index, result in pool.results(steps, parts, workers or cores(), None):
            done[index] = pickle.loads(result)  # of our own workers
            show(len(done), len(parts))
    return [done[index] for index in range(len(parts))]
