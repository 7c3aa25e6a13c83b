"""Elements of a WITSML 1.4.1.1 trajectory in the order of its schema, and its units of measure."""

from __future__ import annotations

from typing import NamedTuple

from mwdcal.errors import InputError
from mwdcal.files.formats.columns import looks_numeric, shown
from mwdcal.files.synonyms import FACTORS
from mwdcal.geometry.units import FOOT


class Leaf(NamedTuple):
    """An element without elements inside: its name, text, unit of measure and line."""

    name: str
    text: str
    uom: str
    line: int


NAMESPACE = "http://www.witsml.org/schemas/1series"
"""Of version 1.4.1.1."""
OLD_NAMESPACE = "http://www.witsml.org/schemas/131"
"""Of version 1.3.1.1."""

OF_TRAJECTORY = (
    *("dTimTrajStart", "dTimTrajEnd", "mdMn", "mdMx", "serviceCompany", "magDeclUsed"),
    *("gridCorUsed", "gridConUsed", "aziVertSect", "dispNsVertSectOrig", "dispEwVertSectOrig"),
    *("definitive", "memory", "finalTraj", "aziRef"),
)
"""Elements of a trajectory after its names."""
_TRANSVERSE = ("Axial", "Tran1", "Tran2")
_COVARIANCES = ("NN", "NE", "NVert", "EE", "EVert", "VertVert")
OF_STATION = (
    *("dTimStn", "typeTrajStation", "typeSurveyTool", "calcAlgorithm", "md", "tvd", "incl", "azi"),
    *("mtf", "gtf", "dispNs", "dispEw", "vertSect", "dls", "rateTurn", "rateBuild", "mdDelta"),
    *("tvdDelta", "modelToolError", "iscwsaToolErrorModel", "gravTotalUncert", "dipAngleUncert"),
    *("magTotalUncert", "gravAccelCorUsed", "magXAxialCorUsed", "sagCorUsed", "magDrlstrCorUsed"),
    *("infieldRefCorUsed", "interpolatedInfieldRefCorUsed", "inHoleRefCorUsed"),
    *("axialMagInterferenceCorUsed", "cosagCorUsed", "MSACorUsed", "gravTotalFieldReference"),
    *("magTotalFieldReference", "magDipAngleReference", "magModelUsed", "magModelValid"),
    *("geoModelUsed", "statusTrajStation"),
    *(f"rawData/{kind}{axis}Raw" for kind in ("grav", "mag") for axis in _TRANSVERSE),
    *(f"corUsed/grav{axis}AccelCor" for axis in _TRANSVERSE),
    *(f"corUsed/mag{axis}DrlstrCor" for axis in _TRANSVERSE),
    *("corUsed/magTran1MSACor", "corUsed/magTran2MSACor", "corUsed/magAxialMSACor"),
    *("corUsed/sagIncCor", "corUsed/sagAziCor", "corUsed/stnMagDeclUsed", "corUsed/stnGridCorUsed"),
    *("corUsed/stnGridConUsed", "corUsed/dirSensorOffset"),
    *("valid/magTotalFieldCalc", "valid/magDipAngleCalc", "valid/gravTotalFieldCalc"),
    *(f"matrixCov/variance{axes}" for axes in _COVARIANCES),
    *("matrixCov/biasN", "matrixCov/biasE", "matrixCov/biasVert"),
)
"""Paths of the elements of a station that a column may be."""

_PER_MS2 = FACTORS["m/s²"][0]
_UOMS = {
    "m": {"m": 1.0, "cm": 0.01, "mm": 1e-3, "km": 1e3, "ft": FOOT, "ftUS": 1200 / 3937},
    "m2": {"m2": 1.0, "cm2": 1e-4, "ft2": FOOT**2, "ftUS2": (1200 / 3937) ** 2},
    "dega": {"dega": 1.0, "rad": FACTORS["rad"][0], "gon": 0.9, "mina": 1 / 60, "seca": 1 / 3600},
    "gn": {
        **{"gn": 1.0, "mgn": FACTORS["mg"][0], "m/s2": _PER_MS2, "cm/s2": 0.01 * _PER_MS2},
        **{"Gal": 0.01 * _PER_MS2, "mGal": 1e-5 * _PER_MS2, "ft/s2": FOOT * _PER_MS2},
    },
    "nT": {
        **{"nT": 1.0, "uT": FACTORS["µT"][0], "mT": FACTORS["mT"][0], "T": 1e9},
        **{"gauss": FACTORS["gauss"][0], "mgauss": 1e-3 * FACTORS["gauss"][0]},
    },
}
"""Units of measure of each quantity, in the one that we use."""
UOM_OF_LENGTH = {"m": "m", "ft": "ft", "usft": "ftUS"}
"""Units of measure by the units of lengths."""
UOM_OF_UNIT = {
    **{"g": "gn", "mg": "mgn", "m/s²": "m/s2"},
    **{"nT": "nT", "µT": "uT", "mT": "mT", "gauss": "gauss"},
}
"""Units of measure by the units of raw channels."""


def converted(leaf: Leaf, uom: str, source: str) -> float:
    """The number of an element in a unit of measure; one that already is in it keeps every digit."""
    where = f"{source}, line {leaf.line}, {shown(leaf.name)}"
    text = leaf.text.strip()
    if not looks_numeric(text):
        raise InputError(f"{where}: expected a number; got {shown(text)}. Correct the file.")
    value = float(text)
    if not abs(value) < float("inf"):
        raise InputError(f"{where}: expected a finite number; got {shown(text)}.")
    if leaf.uom == uom:
        return value
    factors = next((units for units in _UOMS.values() if uom in units), {})
    if leaf.uom not in factors:
        raise InputError(
            f"{where}: the attribute uom must be one of {', '.join(factors) or 'none'}; got {shown(leaf.uom)}. "
            "Convert the values, or correct the attribute."
        )
    return value * factors[leaf.uom] / factors[uom]
