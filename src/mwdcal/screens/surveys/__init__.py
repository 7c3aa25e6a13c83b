"""What is printed of surveys in a well."""
