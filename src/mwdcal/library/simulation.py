"""Simulated runs with their truth, and whole procedures many times."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Unpack, overload

import numpy as np
from msgspec import convert

from mwdcal.calibration.options import Options, Orders, SeedlessFitChoices
from mwdcal.calibration.readings import Readings, serial_of
from mwdcal.calibration.record import Calibration, Finding
from mwdcal.errors import InputError
from mwdcal.files import runs
from mwdcal.files.formats.table import Table
from mwdcal.geometry.vectors import ArrayLike
from mwdcal.library.arrays import nearest, without_mask
from mwdcal.library.planning import (
    FilePath,
    PlanResult,
    PlanSource,
    ToolSource,
    check_whole,
    loaded_tool,
    plan_table,
    profile_of,
    silent,
)
from mwdcal.library.results import Result, arrays_of
from mwdcal.library.tasks import with_choices
from mwdcal.planning import plans as simulation
from mwdcal.planning.plans import Truth
from mwdcal.sensor.profile import Profile
from mwdcal.use.verification import Limits

if TYPE_CHECKING:
    from mwdcal.planning.plans import Effects
    from mwdcal.planning.procedure import Part, Procedure, Repetition, Share, Tools

    Mapper = Callable[[Callable[[Part], Tools], Sequence[Part]], Iterable[Tools]]


@dataclass(frozen=True, eq=False, repr=False)
class SimulatedReadings(Readings, Result):
    """The readings of a simulated run, and its `truth`: what the command's truth file holds.

    `run_table` is the run as its file has it, `tool_name` the name or path of the tool profile, if it has one.
    """

    truth: dict[str, Any] = field(default_factory=dict)
    run_table: Table = field(default_factory=lambda: Table({}))
    tool_name: str = ""

    def save(self, path: FilePath, truth: FilePath | None = None) -> None:
        """Write the run (CSV, TSV, Parquet or XLSX) and, where it is named, the truth (JSON): both or none.

        Raises:
            InputError: a file cannot be written.
        """
        from mwdcal.files.formats import atomic, table
        from mwdcal.presentation.text import to_json

        output, rendered = Path(path), table.rendered(Path(path), self.run_table)
        facts = None if truth is None else Path(truth)
        self.truth.update(output=str(output), truth=str(facts or ""))
        atomic.write_all([(output, rendered), (facts, to_json(self.truth) + "\n")])

    @property
    def findings(self) -> list[Finding]:
        """The noise that is assumed, where the profile states none."""
        return convert(self.truth.get("findings", []), list[Finding])

    def _text(self) -> str:
        from mwdcal.presentation.simulation import screen

        return screen(self.truth, self.tool_name)

    def _document(self) -> dict[str, Any]:
        return dict(self.truth)


@dataclass(frozen=True, eq=False, repr=False)
class RepeatedProcedure(Result):
    """A whole procedure for many tools: a row of `columns` for each, and in `repetition` what they show."""

    procedure: Procedure
    rows: Tools
    repetition: Repetition
    digests: Mapping[str, str]
    assumed: list[Finding] = field(default_factory=list)
    files: dict[str, Path] = field(default_factory=dict)

    @property
    def findings(self) -> list[Finding]:
        """The noise that is assumed, where the profile states none."""
        return self.assumed

    @property
    def columns(self) -> Tools:
        """Figures, verdicts and parameters of the tools by the names of the command's table."""
        return self.rows

    @property
    def risk(self) -> dict[str, Share]:
        """The shares of wrong verdicts, of all tools, each with its 95 % interval.

        "wrong_pass", the consumer's risk: passed and not good. "wrong_fail", the producer's risk: good and not passed.
        """
        return {name: getattr(self.repetition, name) for name in ("wrong_pass", "wrong_fail")}

    def save(self, path: FilePath, plot: FilePath | None = None) -> None:
        """Write the table of all tools and, where it is named, a picture of it (PNG or SVG): both or none.

        Raises:
            InputError: a file cannot be written, or Matplotlib is not installed.
        """
        from mwdcal.files.formats import atomic, table
        from mwdcal.planning.procedure import as_table

        named = {"output": Path(path), "plot": None if plot is None else Path(plot)}
        rendered = table.rendered(Path(path), as_table(self.columns, self.procedure))
        drawn = self._picture(named["plot"].suffix) if named["plot"] else b""
        atomic.write_all([(named["output"], rendered), (named["plot"], drawn)])
        self.files.update({name: file for name, file in named.items() if file})

    def _picture(self, suffix: str) -> bytes:
        from mwdcal.presentation.page import picture
        from mwdcal.presentation.simulation import figure

        procedure = self.procedure
        title = procedure.calibrating.plan.source, procedure.guard
        return picture(figure(self.columns, procedure.judged, *title), suffix)

    def _text(self) -> str:
        from mwdcal.presentation.simulation import repeated

        return repeated(self._document())

    def _document(self) -> dict[str, Any]:
        from mwdcal.presentation.simulation import document

        procedure = self.procedure
        facts = {
            "seed": procedure.seed, "order": procedure.order, "repetition": self.repetition,
            "reference_temperature_c": procedure.calibrating.profile.reference_temperature_c,
            "findings": self.findings,
        }  # fmt: skip
        return document(procedure.calibrating, facts, self.digests, None, **self.files)


@overload
def simulate(
    inclination_deg: Sequence[float] = ...,
    toolfaces: int = ...,
    azimuth_deg: Sequence[float] = ...,
    temperature: Sequence[float] = ...,
    *,
    tool: int | tuple[ArrayLike, ArrayLike] | Truth = ...,
    noise: tuple[float, float] = ...,
    stand_deg: tuple[float, float, float] = ...,
    settings: Literal["per-direction", "per-station"] | None = ...,
    drift: float = ...,
    seed: int | np.random.Generator = ...,
) -> Readings: ...


@overload
def simulate(
    plan: PlanSource,
    tool: ToolSource | None = None,
    *,
    seed: int = 0,
    repeat: None = None,
    calibration: FilePath | Calibration | None = None,
    effects: FilePath | Effects | None = None,
    order: Orders | Literal["auto"] = "auto",
) -> SimulatedReadings: ...


@overload
def simulate(
    plan: PlanSource,
    tool: ToolSource | None = None,
    *,
    repeat: int,
    seed: int = 0,
    calibration: FilePath | Calibration | None = None,
    effects: FilePath | Effects | None = None,
    rolltest: PlanSource = "roll-test",
    limits: FilePath | Limits = "roll-test",
    options: Options | None = None,
    mapper: Mapper = map,
    progress: Callable[[int, int], None] = silent,
    **choices: Unpack[SeedlessFitChoices],
) -> RepeatedProcedure: ...


def simulate(*arguments: Any, **choices: Any) -> Any:
    """Simulate a run of a known tool, or a whole procedure many times. Always marked as simulated.

    With a plan: `simulate(plan, tool, seed=0)` carries it out with a `tool` drawn from the tolerances of a profile
    (by default servo), or the tool that a `calibration` describes, on a stand with its errors. A calibration, also as
    `tool`, gives the gravity, field and dip that the plan does not state. The readings have `.truth`. `effects` are a
    file of what happens besides noise; `order` is that of the tool's temperature terms, by default the highest that
    the plan's soaks carry.

    With `repeat` the run, fit, roll test and verdict of so many tools, in `.columns`, and how often verdicts are
    wrong in `.risk`. `rolltest` is a plan, `limits` those of the verdict; `options` and further keywords are those of
    `calibrate`. The tools do not depend on `mapper`, by which parts of them are computed: `map`, or that of a
    `concurrent.futures` executor.

    Without a plan every toolface at every inclination and temperature: `simulate(inclination_deg, toolfaces,
    azimuth_deg, temperature)`. Azimuths come in turn, one to each inclination. `tool` is a number, the same one for
    the same tool; or the true factors (30,) of accelerometer and magnetometer, SF (3 × 4) and B (3 × 4) by
    power of T - 30 °C, then m (6). `noise` is of one reading, g and nT; `stand_deg` how far inclination,
    azimuth and toolface are off their references, the same for stations that follow each other with one
    direction unless `settings` says that the stand is set at each; `drift` the temperature by which the tool warms
    during the run; `seed` that of noise and stand, or a generator.

    Raises:
        InputError: a plan, profile, calibration or keyword that cannot be read.
        FitError: with `repeat`, the plan cannot give a calibration.

    >>> import mwdcal
    >>> run = mwdcal.simulate("moosavi-12", "servo", seed=1)
    >>> run.count, run.truth["serial"]
    (48, 'SIM-1')
    """
    first = arguments[0] if arguments else choices.get("plan")
    is_plan = isinstance(first, str | os.PathLike | PlanResult | Table | Mapping)
    if is_plan or hasattr(first, "columns"):
        task: Callable[..., Any] = _run
        if choices.get("repeat") is not None:
            task = _repeated
        else:
            choices.pop("repeat", None)
    else:
        task = _grid
    _check_names(task, choices)
    return task(*arguments, **choices)


def _check_names(task: Callable[..., Any], choices: Mapping[str, object]) -> None:
    """Refuse keywords of `simulate` that it does not have, or that go with others."""
    names = [*inspect.signature(task).parameters]
    names += [*Options.__dataclass_fields__] if task is _repeated else []
    for name in choices:
        if name in names:
            continue
        if task is _run and name in (
            *inspect.signature(_repeated).parameters, *Options.__dataclass_fields__,
        ):  # fmt: skip
            raise InputError(f"`{name}` goes with `repeat`. Leave it out, or add `repeat`.")
        raise InputError(
            f"unknown keyword '{name}'; expected one of {', '.join(names)}.{nearest(name, names)}"
        )


def _grid(
    inclination_deg: Sequence[float] = (5, 45, 90, 135),
    toolfaces: int = 12,
    azimuth_deg: Sequence[float] = (0, 90, 180, 270),
    temperature: Sequence[float] = (25.0,),
    *,
    tool: int | tuple[ArrayLike, ArrayLike] | Truth = 0,
    noise: tuple[float, float] = (1e-4, 15.0),
    stand_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
    settings: Literal["per-direction", "per-station"] | None = None,
    drift: float = 0.0,
    seed: int | np.random.Generator = 0,
) -> Readings:
    """Every toolface at every inclination and temperature: see `simulate`."""
    if not all(0 <= angle <= 180 for angle in inclination_deg) or toolfaces < 1:
        raise InputError(
            "`inclination_deg` must be between 0 and 180, and `toolfaces` 1 or more; got "
            f"{list(inclination_deg)} and {toolfaces}."
        )
    plan = simulation.grid([*inclination_deg], toolfaces, [*azimuth_deg], [*temperature])
    warmed = plan.temperature + drift * np.linspace(-0.5, 0.5, len(plan.temperature))
    plan = replace(plan, temperature=warmed)
    if isinstance(seed, np.random.Generator):
        rng = seed
    else:
        check_whole("seed", seed, 0)
        rng = np.random.default_rng([seed, 1])
    inclination, azimuth, toolface = np.radians(stand_deg)
    off = inclination, azimuth, toolface
    return simulation.run(_truth(tool), plan, rng, noise, off, settings or "")


def _truth(tool: int | tuple[ArrayLike, ArrayLike] | Truth) -> Truth:
    """A tool to simulate: by its number, or by its factors."""
    if isinstance(tool, Truth):
        return tool
    if isinstance(tool, int):
        return simulation.servo(np.random.default_rng(tool))
    accelerometer, magnetometer = (
        without_mask(np.ma.array(factors, dtype=float)) for factors in tool
    )
    for factors in (accelerometer, magnetometer):
        if factors.shape != (30,):
            raise InputError(
                f"`tool` must be a number, or 30 factors of each triad; got {factors.shape}. Give SF "
                "(3 × 4), B (3 × 4) and m (6) in one row."
            )
    return Truth(accelerometer, magnetometer)


@dataclass(frozen=True)
class _Scene:
    """The subject of a simulation: a plan, a profile, effects, the tool of a calibration; digests of their files."""

    plan: Table
    profile: Profile
    effects: Effects
    digests: dict[str, str]
    record: Calibration | None = None
    tool: Truth | None = None
    tool_name: str = ""

    @classmethod
    def of(
        cls, plan: PlanSource, tool: ToolSource | None, calibration: FilePath | Calibration | None,
        effects: FilePath | Effects | None, seed: int,
    ) -> _Scene:  # fmt: skip
        """All that is named, read."""
        from mwdcal.planning.plans import Effects, at_place_of, load_effects
        from mwdcal.planning.session import calibrated_tool
        from mwdcal.presentation.calibration_source import calibration_of

        check_whole("seed", seed, 0)
        table = plan_table(plan)
        if isinstance(effects, Effects):
            physics, digest = effects, ""
        else:
            physics, digest = load_effects(os.fspath(effects or "none"))
        digests = {"plan": table.digest, "effects": digest if effects else ""}
        if calibration is None:
            tool = loaded_tool("servo" if tool is None else tool)
            profile, digests["profile"] = profile_of(tool)
            if isinstance(tool, Calibration):
                table = at_place_of(table, tool)
            name = os.fspath(tool) if isinstance(tool, str | os.PathLike) else ""
            return cls(table, profile, physics, digests, tool_name=name)
        if tool is not None:
            raise InputError(
                "`calibration` brings its own profile and order. Leave out `tool` and `order`."
            )
        if not isinstance(calibration, Calibration):
            calibration, digests["calibration"] = calibration_of(Path(calibration))
        true, profile = calibrated_tool(calibration)
        return cls(at_place_of(table, calibration), profile, physics, digests, calibration, true)


def _order(options: Options) -> int | None:
    """The order of a tool to be drawn; None: as the plan allows."""
    return None if options.order == "auto" else max(options.orders)


def _run(
    plan: PlanSource,
    tool: ToolSource | None = None,
    *,
    seed: int = 0,
    calibration: FilePath | Calibration | None = None,
    effects: FilePath | Effects | None = None,
    order: Orders | Literal["auto"] = "auto",
) -> SimulatedReadings:
    """One run of one tool: see `simulate`."""
    from mwdcal.planning import session as sessions
    from mwdcal.planning.expected import assumed_noise
    from mwdcal.presentation.simulation import document

    scene, wanted = _Scene.of(plan, tool, calibration, effects, seed), _order(Options(order=order))
    rng = np.random.default_rng([seed, 2])
    session = sessions.Session.of(scene.plan, scene.profile, scene.effects)
    highest = session.highest_order if wanted is None else wanted
    true = scene.tool or simulation.drawn(rng, scene.profile, highest)
    serial = (serial_of(scene.record.tool) if scene.record else None) or f"SIM-{seed}"
    table, facts = sessions.simulated_run(session, true, seed, rng, serial)
    facts |= sessions.tool_facts(true, session.profile, scene.record)
    facts["findings"] = assumed_noise(scene.profile)
    readings, profile = runs.read_run(table, session.profile)
    read = {each.name: getattr(readings, each.name) for each in fields(Readings)}
    read |= {"profile": profile, "profile_sha256": scene.digests.get("profile", "")}
    read |= {"table": arrays_of(table)}
    return SimulatedReadings(
        **read, truth=document(session, facts, scene.digests, serial), run_table=table,
        tool_name=scene.tool_name,
    )  # fmt: skip


def _repeated(
    plan: PlanSource,
    tool: ToolSource | None = None,
    *,
    repeat: int,
    seed: int = 0,
    calibration: FilePath | Calibration | None = None,
    effects: FilePath | Effects | None = None,
    rolltest: PlanSource = "roll-test",
    limits: FilePath | Limits = "roll-test",
    options: Options | None = None,
    mapper: Mapper = map,
    progress: Callable[[int, int], None] = silent,
    **choices: Unpack[SeedlessFitChoices],
) -> RepeatedProcedure:
    """A whole procedure for many tools: see `simulate`."""
    from mwdcal.files.limits import load_limits
    from mwdcal.planning.expected import assumed_noise
    from mwdcal.planning.procedure import Procedure, joined, summarised

    check_whole("repeat", repeat, 1)
    chosen = replace(with_choices(options, choices) or Options(), seed=seed)
    scene, test = _Scene.of(plan, tool, calibration, effects, seed), plan_table(rolltest)
    bounds, digest = (limits, "") if isinstance(limits, Limits) else load_limits(limits)
    procedure = Procedure.of(
        scene.plan, test, scene.profile, chosen, bounds,
        seed, scene.effects, _order(chosen), scene.tool,
    )  # fmt: skip
    parts, done = procedure.parts(repeat), []
    for each in mapper(procedure.repeated, parts):
        done.append(each)
        progress(len(done), len(parts))
    columns = joined(done)
    shown = summarised(columns, procedure.judged, procedure.guard)
    digests = {**scene.digests, "rolltest": test.digest, "limits": digest}
    return RepeatedProcedure(procedure, columns, shown, digests, assumed_noise(scene.profile))
