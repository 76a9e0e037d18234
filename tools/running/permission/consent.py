"""The one conversation before something is done to a joint or its drive: what is shown, and who says yes."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Protocol

from jointctl.drivers.drive import Approval
from jointctl.drivers.errors import UsageError
from jointctl.tools.output import Output

MOVE = "Move the joint?"


class Consent(Protocol):
    """Whose word lets a session move the joint."""

    @property
    def dry_run(self) -> bool:
        """The envelope is shown, and that is all."""
        ...

    @property
    def brake(self) -> Approval | None:
        """Asked before a drive that is found enabled is braked; None: it is left as it is."""
        ...

    def show(self, lines: Sequence[str]) -> None:
        """The motion envelope."""

    def agreed(self, lines: Sequence[str]) -> bool:
        """Whether the joint may move as these lines say."""
        ...


class TerminalConsent:
    """The user at the terminal, or the flag -y.  One yes is for one command: nothing is shown or asked twice."""

    def __init__(self, output: Output, *, assume_yes: bool, dry_run: bool = False) -> None:
        self._output, self._assume_yes, self.dry_run = output, assume_yes, dry_run
        self.brake: Approval | None = None if dry_run else self._may_brake
        self._given = False

    def show(self, lines: Sequence[str]) -> None:
        """See `Consent`."""
        for line in () if self._given else lines:
            self._output.fact(line)

    def agreed(self, lines: Sequence[str]) -> bool:
        """See `Consent`."""
        self._given = self._given or self._assume_yes or agreed(self._output)
        return self._given

    def _may_brake(self, question: str) -> bool:
        if self._assume_yes:
            self._output.note(f"{question} yes (-y)")
        return self._assume_yes or agreed(self._output, question)


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
