"""What the software chooses where an option says `auto`: order, nonlinearity."""
