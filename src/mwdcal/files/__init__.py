"""Files: tables (CSV, TSV, Parquet, XLSX), runs, tool profiles, atomic writing.

All conversion of units and axes happens here: outside are raw channels and degrees,
inside nominal g and nT along the tool axes, and radians.

- `atomic`: the whole file or none.
- `table`: the raw table and its four formats (`text`, `parquet`, `workbook`).
- `contract`: the columns of a run file, their ranges and their near misses.
- `logs`: continuous logs, of any length, with or without column names.
- `runs`: a table and a tool profile to `Readings`, and back.
- `profiles`: tool profiles by name or path.
"""
