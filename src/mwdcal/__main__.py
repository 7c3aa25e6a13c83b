"""`python -m mwdcal`: the command, where its folder is not on the path."""

from mwdcal.app.cli import main

main()
