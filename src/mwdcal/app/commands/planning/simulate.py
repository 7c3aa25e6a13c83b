"""`mwdcal simulate`: a run of a known tool and its truth, or a whole procedure many times."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

import click
from click.core import ParameterSource

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result, to_json
from mwdcal.errors import InputError

if TYPE_CHECKING:
    from mwdcal.calibration.options import Options
    from mwdcal.calibration.record import Calibration
    from mwdcal.files.formats.table import Table
    from mwdcal.geometry.vectors import AnyArray
    from mwdcal.planning.effects import Effects
    from mwdcal.planning.procedure import Procedure
    from mwdcal.planning.simulate import Truth
    from mwdcal.sensor.profile import Profile

MOST_TOOLS = 100_000
"""Repetitions of a procedure."""
ALWAYS = ("plan", "tool", "calibration", "order", "effects", "seed", "output", "as_json")
"""Options of one run and of many repetitions."""


@options.command()
@options.preset(
    "--plan",
    metavar="NAME|FILE",
    default="twenty-four-state",
    help="A built-in plan, a TOML file of attitudes, or a run file.",
)
@options.tool(help="Profile from whose tolerances the tool is drawn. Default: servo.")
@click.option(
    "--calibration",
    type=options.FILE,
    metavar="CAL.json",
    help="The tool that this calibration describes, instead of one drawn.",
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
    type=click.IntRange(1, MOST_TOOLS),
    metavar="N",
    help="The whole procedure for N tools: run, fit, roll test, verdict. The options of the fit count only here.",
)
@options.preset(
    "--rolltest", metavar="NAME|FILE", default="roll-test", help="Plan of the roll test."
)
@options.preset("--limits", metavar="NAME|FILE", default="roll-test", help="Limits of the verdict.")
@click.option(
    "--workers", type=click.IntRange(1), metavar="N", help="Processes. Default: one per core."
)
@options.plot(help="Also draw errors and figures of all tools.")
@options.fit_options("auto", "none", "datasheet", "the tolerances in the tool profile")
@options.JSON
def command(
    plan: str, tool: str | None, calibration: Path | None, effects: str | None, output: Path,
    truth: Path | None, repeat: int | None, rolltest: str, limits: str, workers: int | None,
    plot: Path | None, as_json: bool, **typed: Unpack[options.Typed],
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
    _check(repeat, truth, calibration, tool)
    options.check_outputs(
        [output, truth], [plan, tool, calibration, effects, rolltest, limits], plot
    )
    scene = _scene(plan, tool, calibration, effects, typed)
    if repeat:
        _repeat(scene, typed["seed"], repeat, rolltest, limits, workers, output, plot, as_json)
    else:
        _simulate(scene, typed["seed"], output, truth, as_json)


def _check(
    repeat: int | None, truth: Path | None, calibration: Path | None, tool: str | None
) -> None:
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
    if calibration and (tool or "order" in typed):
        raise InputError(
            "`calibration` brings its own profile and order. Leave out `tool` and `order`."
        )
    inert = [name for name in typed if name not in (*ALWAYS, "truth")]
    if not repeat and inert:
        raise InputError(f"`{inert[0]}` goes with `repeat`. Leave it out, or add `repeat`.")


@dataclass(frozen=True)
class _Scene:
    """What is simulated: plan, profile, effects, the tool of a calibration, the fit; digests of their files."""

    plan: Table
    profile: Profile
    effects: Effects
    options: Options
    digests: dict[str, str]
    record: Calibration | None = None
    tool: Truth | None = None

    @property
    def order(self) -> int | None:
        """The order of a tool drawn; None: as the plan allows."""
        return None if self.options.order == "auto" else max(self.options.orders)


def _scene(
    plan: str, tool: str | None, calibration: Path | None, effects: str | None,
    typed: options.Typed,
) -> _Scene:  # fmt: skip
    """The files that the command names, read."""
    from mwdcal.app.choices import options_of, prior_of
    from mwdcal.files import profiles
    from mwdcal.planning.effects import load_effects
    from mwdcal.planning.plans import load_plan
    from mwdcal.planning.session import calibrated_tool
    from mwdcal.registry.calibration_source import calibration_of

    chosen = options_of(typed, prior_of(typed["prior"])[0])
    table = load_plan(plan)
    physics, digest = load_effects(effects or "none")
    digests = {"plan": table.digest, "effects": digest if effects else ""}
    if calibration:
        record, digests["calibration"] = calibration_of(calibration)
        true, profile = calibrated_tool(record)
        return _Scene(table, profile, physics, chosen, digests, record, true)
    profile, digests["profile"] = profiles.load_profile(tool or "servo")
    return _Scene(table, profile, physics, chosen, digests)


def _simulate(scene: _Scene, seed: int, output: Path, truth: Path | None, as_json: bool) -> None:
    """One run."""
    import numpy as np

    from mwdcal.calibration.readings import serial_of
    from mwdcal.files.formats import atomic, table
    from mwdcal.planning import session as sessions
    from mwdcal.planning.simulate import drawn
    from mwdcal.screens import simulation as screen

    rng = np.random.default_rng([seed, 2])
    session = sessions.Session.of(scene.plan, scene.profile, scene.effects)
    order = session.highest_order if scene.order is None else scene.order
    tool = scene.tool or drawn(rng, scene.profile, order)
    known = serial_of(scene.record.tool) if scene.record else None
    serial = known or f"SIM-{seed}"
    run, facts = sessions.simulated_run(session, tool, seed, rng, serial)
    facts |= sessions.tool_facts(tool, session.profile, scene.record)
    document = screen.document(session, facts, scene.digests, serial, output=output, truth=truth)
    rendered = table.rendered(output, run)
    atomic.write_all([(output, rendered), (truth, to_json(document) + "\n")])
    print_result(document if as_json else screen.screen(document))


def _repeat(
    scene: _Scene, seed: int, count: int, rolltest: str, limits: str, workers: int | None, output: Path,
    plot: Path | None, as_json: bool,
) -> None:  # fmt: skip
    """A whole procedure many times."""
    from mwdcal import pool

    with pool.preparing(workers):  # these imports, in the workers too
        from mwdcal.files.formats import atomic, table
        from mwdcal.files.limits import load_limits
        from mwdcal.pages.pictures import picture
        from mwdcal.pages.repetition import figure
        from mwdcal.planning.plans import load_plan
        from mwdcal.planning.procedure import Procedure
        from mwdcal.planning.repetition import as_table, summarised
        from mwdcal.screens import simulation as screen

    test, (bounds, digest) = load_plan(rolltest), load_limits(limits)
    procedure = Procedure.of(
        scene.plan, test, scene.profile, scene.options, bounds,
        seed, scene.effects, scene.order, scene.tool,
    )  # fmt: skip
    digests = {**scene.digests, "rolltest": test.digest, "limits": digest}
    columns = _columns(procedure, count, workers)
    summary = summarised(columns, procedure.judged, procedure.guard)
    facts = {
        "seed": seed, "order": procedure.order, "repetition": summary,
        "reference_temperature_c": scene.profile.reference_temperature_c,
    }  # fmt: skip
    document = screen.document(
        procedure.calibrating, facts, digests, None, output=output, plot=plot
    )
    rendered = table.rendered(output, as_table(columns, procedure))
    title = scene.plan.source, procedure.guard
    drawn = picture(figure(columns, procedure.judged, *title), plot.suffix) if plot else b""
    atomic.write_all([(output, rendered), (plot, drawn)])
    print_result(document if as_json else screen.repeated(document))


def _columns(procedure: Procedure, count: int, workers: int | None) -> dict[str, AnyArray]:
    """The columns of all tools, by all cores; they do not depend on how many these are."""
    import pickle
    from functools import partial

    from mwdcal import pool
    from mwdcal.app import progress
    from mwdcal.planning.procedure import solved
    from mwdcal.planning.repetition import joined
    from mwdcal.use.correction_numba import cores

    parts, done = procedure.parts(count), {}
    steps = pool.Steps(tuple, partial(solved, procedure))
    with progress.bar("simulating") as show:
        for index, result in pool.results(steps, parts, workers or cores(), None):
            done[index] = pickle.loads(result)  # of our own workers
            show(len(done), len(parts))
    return joined([done[index] for index in range(len(parts))])
