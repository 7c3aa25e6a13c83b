"""One module for each command: its options, what it runs, what it prints."""
