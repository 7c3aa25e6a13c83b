"""Every tool's past in a database: tools, runs, calibrations, certificates, and an append-only history."""
