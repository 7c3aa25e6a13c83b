"""Pages of surveys in a well."""
