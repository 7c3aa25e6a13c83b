"""Tables as CSV, TSV, Parquet and XLSX, and files that are written whole or not at all."""
