"""The calibration certificate: its contents, budget, decision rule, signature, and its form as DCC XML."""
