"""`python -m jointctl.tools.cli`: the command line without the installed script."""

from jointctl.tools.cli.start import main

main()
