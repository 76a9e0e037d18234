"""The user's word before something is done to a joint or its drive."""

from __future__ import annotations

import sys

from jointctl.drivers.drive import Approval
from jointctl.drivers.errors import UsageError
from jointctl.tools.output import Output

MOVE = "Move the joint?"


def require_terminal(
    why: str = "this moves the joint and there is no terminal to ask on", hint: str = "give -y to move without asking"
) -> None:
    """`UsageError` where nobody can be asked."""
    if not sys.stdin.isatty():
        raise UsageError(why, hint)


def agreed(output: Output, question: str = MOVE) -> bool:
    """Whether the user says yes; everything else is no."""
    output.note(f"{question} [y/N] ")
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def approval(output: Output, *, assume_yes: bool) -> Approval:
    """Asks the user, or says yes."""

    def approve(question: str) -> bool:
        if assume_yes:
            output.note(f"{question} yes (-y)")
        return assume_yes or agreed(output, question)

    return approve
