"""`mwdcal simulate`: a run of a known tool, and its truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result, to_json
from mwdcal.errors import InputError


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
    "--order",
    type=click.IntRange(0, 3),
    metavar="0…3",
    help="Order of temperature terms of a tool drawn. Default: the highest that the plan's soaks carry.",
)
@click.option(
    "--effects",
    metavar="NAME|FILE",
    help="What happens besides noise, a TOML file: turn-on bias, wandering, resolution, backlash, lag, variation "
    "of the field; 'none' is a template.",
)
@options.preset("--seed", type=click.IntRange(0), default=0, help="Seed of all that is drawn.")
@options.output(metavar="RUN.csv", help="Run file to write: .csv, .tsv, .parquet or .xlsx.")
@click.option(
    "--truth", type=options.FILE, metavar="TRUTH.json", help="Also write what is true of the run."
)
@options.JSON
def command(
    plan: str, tool: str | None, calibration: Path | None, order: int | None, effects: str | None,
    seed: int, output: Path, truth: Path | None, as_json: bool,
) -> None:  # fmt: skip
    """Simulate a run: a tool, a plan, a stand with its errors, noise. The same seed, the same run.

    Always labelled as simulated. --json prints the truth.

    \b
    Example: mwdcal simulate --plan moosavi-12 --tool servo --seed 1 -o run.csv --truth truth.json
    Exit: 0 written, 2 input cannot be read.
    """
    from mwdcal.app.screens import simulation as screen
    from mwdcal.files.formats import atomic, table

    options.check_outputs([output, truth], [plan, tool, calibration, effects])
    run, document = _simulated(plan, tool, calibration, order, effects, seed, output, truth)
    rendered = table.rendered(output, run)
    atomic.write_all([(output, rendered), (truth, to_json(document) + "\n")])
    print_result(document if as_json else screen.screen(document))


def _simulated(
    plan: str, tool: str | None, calibration: Path | None, order: int | None, effects: str | None,
    seed: int, output: Path, truth: Path | None,
) -> tuple[Any, dict[str, Any]]:  # fmt: skip
    """The run, and the document of its truth."""
    import numpy as np

    from mwdcal.app.screens import simulation as screen
    from mwdcal.calibration.readings import serial_of
    from mwdcal.files import documents, profiles
    from mwdcal.planning import session as sessions
    from mwdcal.planning.effects import load_effects
    from mwdcal.planning.plans import load_plan
    from mwdcal.planning.simulate import drawn

    if calibration and (tool or order is not None):
        raise InputError(
            "`calibration` brings its own profile and order. Leave out `tool` and `order`."
        )
    chosen, effects_sha256 = load_effects(effects or "none")
    table, rng = load_plan(plan), np.random.default_rng([seed, 2])
    digests = {"plan": table.digest, "effects": effects_sha256 if effects else ""}
    serial = f"SIM-{seed}"
    if calibration:
        record, digests["calibration"] = documents.load(calibration)
        true, profile = sessions.calibrated_tool(record)
        session = sessions.Session.of(table, profile, chosen)
        serial = serial_of(record.tool) or serial
    else:
        record = None
        profile, digests["profile"] = profiles.load_profile(tool or "servo")
        session = sessions.Session.of(table, profile, chosen)
        true = drawn(rng, profile, session.highest_order if order is None else order)
    run, facts = sessions.simulated_run(session, true, seed, rng, serial)
    facts |= sessions.tool_facts(true, session.profile, record)
    return run, screen.truth(session, run, facts, digests, output=output, truth=truth)
