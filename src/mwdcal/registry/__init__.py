"""Every tool's past in a database: tools, runs, calibrations, certificates, and an append-only history."""

from importlib.util import find_spec

from mwdcal import extras

for _library in ("sqlalchemy", "alembic"):
    if find_spec(_library) is None:
        raise extras.missing(_library, "the registry", "registry")
