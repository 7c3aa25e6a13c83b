"""The choices of the software where an option says `auto`: order, nonlinearity."""
