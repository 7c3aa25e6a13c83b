"""`mwdcal init`: the laboratory's settings, asked once."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import click

from mwdcal.app.commands import options
from mwdcal.app.messages import print_result
from mwdcal.errors import FitError, InputError

STAND_UNCERTAINTIES = tuple(
    f"{kind}{angle}_deg"
    for kind in ("", "repeatability_")
    for angle in ("inclination", "azimuth", "toolface")
)
"""Values of `--stand`."""


class SettingsQuestion(NamedTuple):
    """A question of `init`: the option that answers it, its default, and what the answer changes."""

    option: str
    question: str
    default: str
    changes: str

    @property
    def name(self) -> str:
        """The option as a variable."""
        return self.option.lstrip("-").replace("-", "_")

    @property
    def lines(self) -> list[str]:
        """The question and what it changes, as it is asked."""
        return [f"{self.question} ({self.option})", f"   {self.changes}"]


QUESTIONS = (
    SettingsQuestion(
        "--stand",
        "How well is the stand set, 1σ of one setting in degrees?",
        "inclination_deg=0.05,azimuth_deg=0.05,toolface_deg=0.05",
        "Every uncertainty and verdict rests on it. Too small, and sound tools fail and accuracies look too good.",
    ),
    SettingsQuestion(
        "--settings",
        "Is the stand set once per direction and the tool rolled (per-direction), or at every station (per-station)?",
        "per-direction",
        "per-station: errors of the stand average down over a roll set.",
    ),
    SettingsQuestion(
        "--reference",
        "Which references, each as QUANTITY=NAME,CERTIFICATE,DUE with semicolons between them?",
        "",
        "Certificates name them; one that is overdue is reported. Quantities: stand, gravity, field, dip, temperature.",
    ),
    SettingsQuestion(
        "--limits",
        "Limits of the roll test, a name or a file?",
        "roll-test",
        "They decide PASS or FAIL.",
    ),
    SettingsQuestion(
        "--decision",
        "Rule of decision, simple or guarded?",
        "simple",
        "guarded: the value plus its expanded uncertainty must be within the limit, so that fewer bad tools pass.",
    ),
    SettingsQuestion(
        "--tool",
        "Tool profile where a command names none, a name or a file?",
        "",
        "Axes, scales and noise of the tool. Blank: the built-in generic.",
    ),
    SettingsQuestion(
        "--registry",
        "Registry of tools, a file or URL?",
        "",
        "calibrate enters each calibration there. Blank: it does not.",
    ),
    SettingsQuestion(
        "--key",
        "Public keys to trust, with commas between them?",
        "",
        "Signatures by others are reported as not trusted.",
    ),
    SettingsQuestion(
        "--length-unit",
        "Unit of length, m, ft or usft (US survey feet)?",
        "m",
        "How survey reads a column MD, and what it writes.",
    ),
    SettingsQuestion(
        "--temperature-unit",
        "Unit of temperatures that state none, °C, °F or K?",
        "°C",
        "profile asks no more where a temperature may be °C or °F.",
    ),
)


ALLOWED = {
    "settings": ("per-direction", "per-station"),
    "decision": ("simple", "guarded"),
    "length_unit": ("m", "ft", "usft"),
    "temperature_unit": ("°C", "°F", "K"),
}
"""Answers by the name of their option, where only some are possible."""


def _options(function: options.Function) -> options.Function:
    """The option of each question."""
    for each in reversed(QUESTIONS):
        words = each.question[0] + each.question[1:]
        shown = f" Default: {each.default}." if each.default else ""
        function = click.option(each.option, metavar="TEXT", help=words + shown)(function)
    return function


@options.command()
@options.argument("folder", metavar="[DIR]", required=False, default=".")
@_options
@click.option(
    "--defaults", is_flag=True, help="Take the default of every question that is not answered."
)
@click.option("--replace", is_flag=True, help="Replace settings that exist.")
@options.JSON
def command(
    folder: Path, defaults: bool, replace: bool, as_json: bool, **answers: str | None
) -> None:
    """Write the laboratory's settings, mwdcal.toml, into DIR: every command there and below uses them.

    Asks ten questions on a terminal, each with a default and what it changes. Elsewhere the options answer them.

    \b
    Example: mwdcal init --stand inclination_deg=0.02,azimuth_deg=0.05,toolface_deg=0.05 --defaults
    Exit: 0 written, 2 an answer is impossible, or settings exist, 3 questions are open (nothing is written).
    """
    from mwdcal.app import inputs, laboratory
    from mwdcal.files.formats import atomic
    from mwdcal.files.profiles import settings_toml
    from mwdcal.presentation.envelope import WrittenSettings, json_document
    from mwdcal.presentation.text import one_line

    path = folder / laboratory.SETTINGS_FILE
    if path.exists() and not replace:
        raise InputError(f"'{path}' exists. Edit it, or add --replace.")
    if not folder.is_dir():
        raise InputError(f"'{folder}' is not a folder. Name the folder of the laboratory's tables.")
    given = {name: text for name, text in answers.items() if text is not None}
    settings_of_answers(given, folder)
    open_ones = [each for each in QUESTIONS if each.name not in given]
    if defaults:
        given |= {each.name: each.default for each in open_ones}
    elif open_ones and not inputs.on_terminal():
        raise _open_questions(open_ones)
    for each in [] if defaults else open_ones:
        given[each.name] = inputs.ask(each.lines, each.default, partial(_check, each, folder))
    settings = settings_of_answers(given, folder)
    atomic.write(path, settings_toml(settings))
    written = WrittenSettings(file=str(path), settings=settings)
    shown = f"wrote {one_line(path)} (settings)   edit it, or answer again: mwdcal init --replace"
    print_result(json_document("init", written) if as_json else shown)


def _check(question: SettingsQuestion, folder: Path, text: str) -> None:
    """Refuse an impossible answer."""
    settings_of_answers({question.name: text}, folder)


def _open_questions(missing: list[SettingsQuestion]) -> FitError:
    """All open questions, each with the option that answers it."""
    error = FitError(
        f"{len(missing)} questions are open. Answer them by these options, or take the defaults of all by --defaults."
    )
    for each in missing:
        error.add_note(f"{each.option} {each.default!r}   {each.question} {each.changes}")
    return error


def settings_of_answers(answers: Mapping[str, str], folder: Path) -> Any:
    """The settings that answers are, by the name of the option, seen from a folder.

    Raises:
        InputError: an answer is impossible.
    """
    from mwdcal.app.laboratory import checked_settings

    values: dict[str, Any] = {}
    stand: dict[str, Any] = {}
    for name, text in answers.items():
        if text and text not in (known := ALLOWED.get(name, (text,))):
            option = f"--{name.replace('_', '-')}"
            raise InputError(f"{option} {text!r}: must be one of {', '.join(known)}. Correct it.")
        if name == "stand":
            stand |= _angles(text)
        elif name == "settings":
            stand |= {"settings": text} if text else {}
        elif name == "reference":
            values["standards"] = [_standard(part) for part in text.split(";") if part.strip()]
        elif name == "key":
            values["keys"] = [part.strip() for part in text.split(",") if part.strip()]
        else:
            values[name] = text
    return checked_settings({**values, "stand": stand}, folder)


def _angles(text: str) -> dict[str, float]:
    """Standard uncertainties such as azimuth_deg=0.1, with commas between them."""
    values = {}
    for part in filter(str.strip, text.split(",")):
        name, sign, number = (word.strip() for word in part.partition("="))
        try:
            values[name] = float(number)
        except ValueError:
            sign = ""
        if not sign or name not in STAND_UNCERTAINTIES:
            raise InputError(
                f"--stand {part.strip()!r}: expected one of {', '.join(STAND_UNCERTAINTIES)} and a number, such as "
                "azimuth_deg=0.05."
            )
    return values


def _standard(text: str) -> dict[str, str]:
    """A reference as QUANTITY=NAME,CERTIFICATE,DUE."""
    quantity, _, rest = text.partition("=")
    name, certificate, due = ([word.strip() for word in rest.split(",")] + ["", "", ""])[:3]
    standard = {"quantity": quantity.strip(), "name": name, "certificate": certificate, "due": due}
    if not name or rest.count(",") > 2:
        raise InputError(
            f"--reference {text.strip()!r}: expected QUANTITY=NAME,CERTIFICATE,DUE, such as "
            "stand=Rotary table 3,C-118,2027-01-31."
        )
    return {key: value for key, value in standard.items() if value}
