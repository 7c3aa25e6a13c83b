"""The Earth at the place and date of a survey: gravity, magnetic field, norths, and their uncertainties."""
