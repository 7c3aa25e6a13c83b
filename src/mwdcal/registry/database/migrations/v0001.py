"""Objects, records, withdrawals and the history, none of which changes once it is written."""

import sqlalchemy as sa
from alembic import op

from mwdcal.registry.database.models import plain_text
from mwdcal.registry.database.schema import drop_statements, guard_statements

revision = "0001"
down_revision = None

_APPEND_ONLY = ("objects", "records", "withdrawals", "history")


def upgrade() -> None:
    """Create the tables and the triggers that keep them append-only."""
    _create_objects_and_records()
    op.create_table(
        "withdrawals",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),
        sa.Column("record", sa.Integer, sa.ForeignKey("records.number"), nullable=False),
        sa.Column("reason", plain_text(), nullable=False),
        sa.UniqueConstraint("record", name="withdrawals_record"),
    )
    op.create_table(
        "history",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),
        *(sa.Column(n, plain_text(), nullable=False) for n in ("time", "actor", "action", "kind")),
        sa.Column("subject", plain_text(), nullable=False),
        sa.Column("sha256", plain_text()),
        sa.Column("row_sha256", plain_text()),
        sa.Column("previous", plain_text(), nullable=False),
        sa.Column("hash", plain_text(), nullable=False),
    )
    for statement in guard_statements(op.get_bind().dialect.name, _APPEND_ONLY):
        op.execute(sa.text(statement))


def _create_objects_and_records() -> None:
    op.create_table(
        "objects",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),
        sa.Column("sha256", plain_text(), nullable=False),
        sa.Column("size", sa.Integer, nullable=False),
        sa.Column("data", sa.LargeBinary, nullable=False),
        sa.UniqueConstraint("sha256", name="objects_sha256"),
    )
    op.create_table(
        "records",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),
        sa.Column("kind", plain_text(), nullable=False),
        sa.Column("sha256", plain_text(), sa.ForeignKey("objects.sha256"), nullable=False),
        sa.Column("name", plain_text(), nullable=False),
        *(sa.Column(n, plain_text()) for n in ("serial", "type", "label", "time")),
        *(sa.Column(n, plain_text()) for n in ("run", "calibration", "previous")),
        sa.Column("next_due", plain_text()),
        sa.Column("status", plain_text()),
        *(sa.Column(f"{angle}_deg", sa.Double) for angle in ("inclination", "toolface", "azimuth")),
        sa.Column("simulated", sa.Integer, nullable=False),
        sa.Column("facts_version", sa.Integer, nullable=False),
        sa.UniqueConstraint("sha256", "kind", name="records_sha256"),
    )
    op.create_index("records_serial", "records", ["serial", "kind", "time"])
    op.create_index("records_time", "records", ["kind", "time", "number"])
    op.create_index("records_calibration", "records", ["calibration"])
    op.create_index("records_run", "records", ["run"])


def downgrade() -> None:
    """Drop the tables with all that is in them."""
    for statement in drop_statements(op.get_bind().dialect.name, _APPEND_ONLY):
        op.execute(sa.text(statement))
    for table in reversed(_APPEND_ONLY):
        op.drop_table(table)
