"""Every tool's past in a database: tools, runs, calibrations, certificates, and an append-only history."""

from importlib.util import find_spec

from mwdcal.errors import InputError

if not (find_spec("sqlalchemy") and find_spec("alembic")):
    raise InputError(
        'the registry needs SQLAlchemy and Alembic. Install them with: pip install "mwdcal[registry]"'
    )
