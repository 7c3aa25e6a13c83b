"""A table and a tool profile to `Readings`, and back: every conversion of unit and axis.

Raw channels become nominal g and nT along the tool axes, nominal = P (raw / scale); degrees
become radians; true and grid azimuths become magnetic ones.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import replace

import msgspec
import numpy as np

from mwdcal.core.vectors import Array, Ints
from mwdcal.errors import InputError
from mwdcal.files import azimuths, table as tables
from mwdcal.files.columns import Column
from mwdcal.files.contract import (
    CHANNELS,
    RAW_RANGE,
    RAW_SPREAD,
    REFERENCES,
    TEMPERATURE,
    Range,
    check_columns,
)
from mwdcal.files.table import Table, cell_error, labels, numbers, shown
from mwdcal.profile import Profile, TriadProfile
from mwdcal.readings import ANGLES, Readings
