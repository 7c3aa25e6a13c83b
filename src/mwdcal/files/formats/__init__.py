"""Tables as CSV, TSV, Parquet, XLSX and in any laboratory's `layout`; files that are written whole or not at all."""
