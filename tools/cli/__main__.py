"""`python -m tools.cli`: the command line without the installed script."""

from tools.cli.start import main

main()
