"""`python -m tools.cli`: the command line without the installed script."""

from tools.cli.main import main

main()
