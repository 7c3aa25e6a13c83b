"""What is shown of a result: on the screen, for machines, as a page with its figures."""
