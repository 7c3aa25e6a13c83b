"""The published JSON Schemas, from the definitions in code. Run as a script, it writes them."""

from __future__ import annotations

import inspect
import json
from pathlib import Path
from typing import Any

import msgspec

import mwdcal
from mwdcal.app import correction
from mwdcal.calibration.record import DOCUMENT_VERSION, SCHEMA_VERSION, Calibration
from mwdcal.certificate.document import Certificate
from mwdcal.faults.diagnosis import Diagnosis
from mwdcal.presentation import (
    builtin,
    calibration,
    comparison,
    conversion,
    drift,
    fleet,
    noise,
    plan,
    proposal,
    reference,
    registry,
    signature,
    simulation,
    stations,
    survey,
)
from mwdcal.presentation.envelope import INPUTS, Envelope, ExampleDocument, WrittenSettings
from mwdcal.registry.lookup import Listing
from mwdcal.use.verification import Verdict

DIALECT = "https://json-schema.org/draft/2020-12/schema"
CONTENTS: dict[str, type] = {
    "apply": correction.Applied,
    "calibrate": calibration.CalibrationSummary,
    "certificate": Certificate,
    **dict.fromkeys(
        (n for n in INPUTS if n.startswith("certificate key ")), signature.KeysDocument
    ),
    "certificate sign": signature.SignedDocument,
    "certificate verify": signature.CheckedDocument,
    "compare": comparison.ComparisonSummary,
    "convert": conversion.ConversionSummary,
    "diagnose": Diagnosis,
    "example": ExampleDocument,
    "init": WrittenSettings,
    "list": builtin.BuiltInSummary,
    "fleet": fleet.FleetDocument,
    "noise": noise.NoiseSummary,
    "plan": plan.PlanDocument,
    "profile": proposal.ProposalSummary,
    "reference": reference.ReferenceSummary,
    "registry add": registry.RegistryAdded,
    "registry backup": registry.RegistryCopied,
    "registry check": registry.RegistryChecked,
    "registry drift": drift.RegistryDrift,
    "registry export": registry.RegistryExported,
    "registry get": registry.RegistryDocument,
    "registry history": Listing,
    "registry init": registry.RegistryCreated,
    "registry list": Listing,
    "registry restore": registry.RegistryCopied,
    "registry upgrade": registry.RegistryUpgraded,
    "registry withdraw": registry.RegistryWithdrawn,
    "simulate": simulation.SimulationSummary,
    "stations": stations.StationsSummary,
    "survey": survey.SurveySummary,
    "verify": Verdict,
}
"""What follows the envelope in the document of each command."""
DIGEST = {"anyOf": [{"type": "string", "pattern": "^[0-9a-f]{64}$"}, {"type": "null"}]}


def of_calibration_files() -> dict[str, Any]:
    """JSON Schema of a calibration file, from its definition in code."""
    described = plain(msgspec.json.schema(Calibration))
    title = f"mwdcal calibration file, schema version {SCHEMA_VERSION}"
    return {"$schema": DIALECT, "title": title, **described}


def of_command(command: str) -> dict[str, Any]:
    """JSON Schema of the document of a command: its envelope and its content; nothing else may be there."""
    types = (Envelope, CONTENTS[command])
    _, parts = msgspec.json.schema_components(types, ref_template="#/$defs/{name}")
    head, content = (closed(plain(parts.pop(each.__name__))) for each in types)
    digests = {f"{name}_sha256": DIGEST for name in INPUTS[command]}
    if "calibration" not in INPUTS[command]:
        del head["properties"]["calibration_signature"]
        parts.pop("SignatureCheck", None)
    properties = {**head["properties"], **digests, **content["properties"]}
    properties["schema_version"] = {"const": DOCUMENT_VERSION}
    properties["command"] = {"const": command}
    required = [*head["required"], *digests, *content["required"]]
    return {
        "$schema": DIALECT,
        "title": f"mwdcal {command}, schema version {DOCUMENT_VERSION}",
        "description": content["description"],
        "type": "object",
        "properties": properties,
        "required": list(dict.fromkeys(required)),
        "additionalProperties": False,
        "$defs": {name: closed(plain(part)) for name, part in parts.items()},
    }


def plain(value: Any) -> Any:
    """As JSON has it; descriptions without the indent that docstrings have before Python 3.13."""
    value = json.loads(msgspec.json.encode(value))

    def cleaned(value: Any) -> Any:
        if isinstance(value, dict):
            return {
                key: inspect.cleandoc(item)
                if key == "description" and isinstance(item, str)
                else cleaned(item)
                for key, item in value.items()
            }
        return [cleaned(item) for item in value] if isinstance(value, list) else value

    return cleaned(value)


def closed(part: dict[str, Any]) -> dict[str, Any]:
    """An object with the keys that it declares and no others; what has a default is written too."""
    if "properties" not in part:
        return part
    fields = part["properties"].items()
    required = [k for k, field in fields if k in part["required"] or "default" in field]
    return {**part, "required": required, "additionalProperties": False}


def write() -> None:
    """Write all schemas into the package."""
    package = Path(mwdcal.__file__).parent
    (package / "schemas").mkdir(exist_ok=True)
    files = {
        f"schemas/{command.replace(' ', '-')}.schema.json": of_command(command)
        for command in CONTENTS
    }
    for name, schema in {**files, "calibration.schema.json": of_calibration_files()}.items():
        text = json.dumps(schema, indent=2)
        (package / name).write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    write()
