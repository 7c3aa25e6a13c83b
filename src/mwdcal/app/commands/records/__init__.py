"""Commands for certificates and for the registry of tools."""
