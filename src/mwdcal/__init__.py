"""Calibration of the accelerometers and magnetometers of MWD directional tools.

Frame: right-handed tool axes, z along the tool and downhole, y at the toolface scribe, x to the left
of y looking downhole. Gravity points down: a vertical tool reads gz = +1 g. Dip is positive down.
Azimuths are magnetic.

Units: radians, g, nT and °C. Keywords that end in `_deg` take degrees.

Axes of arrays: the component axis (x, y, z) is last, stations before it, repetitions lead: readings
are (n, 3), angles (n,). NaN is unknown.

A first script::

    run = mwdcal.readings(a, m, temperature=t, inclination=inc, azimuth=azi, toolface=tf, field=48_000.0)
    cal = mwdcal.calibrate(run)
    g, b = cal.fields(survey)
    cal.uncertainty("azimuth", survey, noise=True)
    mwdcal.verify(cal, rolltest).passed
    mwdcal.save(cal, "tool.json")
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mwdcal.library.face import *  # noqa: F403

__version__ = "0.2.0"

__all__ = [  # noqa: F405 - imported when first used: `import mwdcal` loads no NumPy
    "Calibration",
    "FitError",
    "InputError",
    "Options",
    "Profile",
    "Readings",
    "apply",
    "calibrate",
    "certificate",
    "check_signature",
    "compare",
    "convert",
    "diagnose",
    "export",
    "fleet",
    "load",
    "load_profile",
    "noise",
    "plan",
    "propose_profile",
    "read_run",
    "readings",
    "reference",
    "registry",
    "save",
    "sign",
    "simulate",
    "stations",
    "survey",
    "verify",
]


class _PublicNames(ModuleType):
    """The package, whose rooms do not take the place of the functions of the same name, as `mwdcal.fleet`."""

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in __all__ and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _PublicNames


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module 'mwdcal' has no attribute {name!r}")
    from mwdcal.library import face

    return getattr(face, name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
