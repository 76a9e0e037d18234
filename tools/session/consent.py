"""Before anything moves: what must hold, what is shown, and who says yes."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from jointctl.drivers.drive import Approval, CommissioningReport
from jointctl.drivers.errors import MotionFault, UsageError
from jointctl.firmware_py.states import Fault
from jointctl.tools.configuration.config import Config
from jointctl.tools.output import Output
from jointctl.tools.recording.run_log import remove_oldest, require_room
from jointctl.tools.session.fault_words import fault_text

# --- The one conversation before something is done to a joint or its drive: what is shown, and who says yes ---


MOVE = "Move the joint?"


class Consent(Protocol):
    """Whose word lets a session move the joint."""

    @property
    def dry_run(self) -> bool:
        """The envelope is shown, and that is all."""

    @property
    def brake(self) -> Approval | None:
        """Asked before a drive that is found enabled is braked; None: it is left as it is."""

    def show(self, lines: Sequence[str]) -> None:
        """The motion envelope."""

    def agreed(self, lines: Sequence[str]) -> bool:
        """Whether the joint may move as these lines say."""


class TerminalConsent:
    """The user at the terminal, or the flag -y.  One yes is for one command: nothing is shown or asked twice."""

    def __init__(self, output: Output, *, assume_yes: bool, dry_run: bool = False) -> None:
        self._output, self._assume_yes, self.dry_run = output, assume_yes, dry_run
        self.brake: Approval | None = None if dry_run else self._may_brake
        self._given = False

    def show(self, lines: Sequence[str]) -> None:
        for line in () if self._given else lines:
            self._output.fact(line)

    def agreed(self, lines: Sequence[str]) -> bool:
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


# --- What must hold before the user is asked whether the joint may move: a yes must not be refused afterwards ---


def require_ready(config: Config, report: CommissioningReport, log_path: Path) -> None:
    """`MotionFault` if the joint stands outside its limits, `DataError` if the log could not be written."""
    limits, start_rad = config.limits, report.start_position_rad
    if not limits.position_min_rad <= start_rad <= limits.position_max_rad:
        text = fault_text(Fault.POSITION_LIMIT, start_rad, 0)
        raise MotionFault(
            f"{Fault.POSITION_LIMIT.name} ({int(Fault.POSITION_LIMIT)}): the joint stands at {start_rad:.4f} rad, "
            f"which must be in [{limits.position_min_rad:g}..{limits.position_max_rad:g}], the limits.position_*",
            text.advice,
        )
    require_room(config, log_path)


def prepare_log(config: Config, log_path: Path, output: Output) -> None:
    """Make way for a new log; one that cannot be removed is no reason not to run."""
    try:
        removed = remove_oldest(config, log_path)
    except OSError as error:
        output.warning(f"{log_path.parent}: an old log cannot be removed: {error.strerror or error}")
        return
    if removed:
        files = "1 file" if len(removed) == 1 else f"{len(removed)} files"
        output.note(f"{log_path.parent}: {files} of older runs removed (log.keep = {config.log.keep})")
