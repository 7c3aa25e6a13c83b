"""In the well: references, surveys with their uncertainty, acceptance, well path, interference."""
