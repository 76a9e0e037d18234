"""The first code of `jointctl`: Ctrl-C during the imports of the command line ends it without a traceback."""

from __future__ import annotations

import signal


def main() -> None:
    """Nothing is open yet that would have to be closed: the signal may simply end the process (130 in a shell)."""
    ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # a script's background job ignores it
    if ours:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from tools.cli.main import main as run

    if ours:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    run()
