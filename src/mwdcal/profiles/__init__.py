"""The built-in tool profiles, one TOML file each; `mwdcal.files.profiles` reads them."""
