"""The table of tools: what pages and lists show of each, computed from its records."""

import sqlalchemy as sa
from alembic import op

from mwdcal.registry.database.models import plain_text
from mwdcal.registry.database.schema import refresh_all

revision = "0002"
down_revision = "0001"


def upgrade() -> None:
    """Create the table, and fill it from the records."""
    op.create_table(
        "tools",
        sa.Column("serial", plain_text(), primary_key=True),
        sa.Column("type", plain_text()),
        sa.Column("first_seen", plain_text(), nullable=False),
        *(sa.Column(n, sa.Integer, nullable=False) for n in ("records", "calibrations")),
        sa.Column("latest", sa.Integer),
        sa.Column("calibrated", plain_text()),
        *(sa.Column(f"{angle}_deg", sa.Double) for angle in ("inclination", "toolface", "azimuth")),
        sa.Column("next_due", plain_text()),
        sa.Column("status", plain_text()),
        sa.Column("simulated", sa.Integer, nullable=False),
    )
    op.create_index("tools_type", "tools", ["type", "serial"])
    op.create_index("tools_next_due", "tools", ["next_due"])
    op.create_index("tools_calibrated", "tools", ["calibrated"])
    refresh_all(op.get_bind())


def downgrade() -> None:
    """Drop the table, which holds nothing that the records do not."""
    op.drop_table("tools")
