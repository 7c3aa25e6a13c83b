"""The tables of a registry. `migrations` create them; a test compares the two.

Every row of `records` and `withdrawals` has the number of the event in `history` that made it, and
so has an object the number of the event that first brought it. Only `tools` is ever updated.
"""

from __future__ import annotations

import sqlalchemy as sa

ACCURACY = ("inclination_deg", "toolface_deg", "azimuth_deg")
"""Columns of the accuracy to expect, 1σ at the typical attitude, in degrees."""


def plain_text() -> sa.types.TypeEngine[str]:
    """Text that both databases sort by its code points."""
    return sa.Text().with_variant(sa.Text(collation="C"), "postgresql")


def _text(name: str, nullable: bool = True) -> sa.Column[str]:
    return sa.Column(name, plain_text(), nullable=nullable)


def _number() -> sa.Column[int]:
    return sa.Column("number", sa.Integer, primary_key=True, autoincrement=False)


metadata = sa.MetaData()

objects = sa.Table(
    "objects",
    metadata,
    _number(),
    _text("sha256", False),
    sa.Column("size", sa.Integer, nullable=False),
    sa.Column("data", sa.LargeBinary, nullable=False),
    sa.UniqueConstraint("sha256", name="objects_sha256"),
)

records = sa.Table(
    "records",
    metadata,
    _number(),
    _text("kind", False),
    sa.Column("sha256", plain_text(), sa.ForeignKey("objects.sha256"), nullable=False),
    _text("name", False),
    *(_text(n) for n in ("serial", "type", "label", "time", "run", "calibration", "previous")),
    *(_text(n) for n in ("next_due", "status")),
    *(sa.Column(name, sa.Double) for name in ACCURACY),
    sa.Column("simulated", sa.Integer, nullable=False),
    sa.Column("facts_version", sa.Integer, nullable=False),
    sa.UniqueConstraint("sha256", "kind", name="records_sha256"),
    sa.Index("records_serial", "serial", "kind", "time"),
    sa.Index("records_time", "kind", "time", "number"),
    sa.Index("records_calibration", "calibration"),
    sa.Index("records_run", "run"),
)

withdrawals = sa.Table(
    "withdrawals",
    metadata,
    _number(),
    sa.Column("record", sa.Integer, sa.ForeignKey("records.number"), nullable=False),
    _text("reason", False),
    sa.UniqueConstraint("record", name="withdrawals_record"),
)

history = sa.Table(
    "history",
    metadata,
    _number(),
    *(_text(name, False) for name in ("time", "actor", "action", "kind", "subject")),
    *(_text(name) for name in ("sha256", "row_sha256")),
    *(_text(name, False) for name in ("previous", "hash")),
)

tools = sa.Table(
    "tools",
    metadata,
    sa.Column("serial", plain_text(), primary_key=True),
    _text("type"),
    _text("first_seen", False),
    *(sa.Column(name, sa.Integer, nullable=False) for name in ("records", "calibrations")),
    sa.Column("latest", sa.Integer),
    _text("calibrated"),
    *(sa.Column(name, sa.Double) for name in ACCURACY),
    _text("next_due"),
    _text("status"),
    sa.Column("simulated", sa.Integer, nullable=False),
    sa.Index("tools_type", "type", "serial"),
    sa.Index("tools_next_due", "next_due"),
    sa.Index("tools_calibrated", "calibrated"),
)

GUARDED = (objects, records, withdrawals, history)
"""Tables in which nothing is ever changed or removed."""
