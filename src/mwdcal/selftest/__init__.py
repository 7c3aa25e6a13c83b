"""The selftest: what an installation computes, against published figures and closed forms, and a record of it."""
