"""`python -m jointctl.tools.verbs`: the command line without the installed script."""

from jointctl.tools.verbs.start import main

main()
