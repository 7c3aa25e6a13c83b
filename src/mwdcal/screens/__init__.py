"""What is printed of a result, for people and for machines."""
