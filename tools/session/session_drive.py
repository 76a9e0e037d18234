"""What a session does with a drive, whatever its kind: the second part of a drive's plug-in (see `DriveSection`)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Protocol

import numpy as np

from jointctl.drivers.drive import Drive, DriveGroup
from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.records import AxisState
from jointctl.firmware_py.states import DriveState, Fault, in_words
from jointctl.tools.configuration.config import Config
from jointctl.tools.output import Output
from jointctl.tools.session.fault_words import FaultText

if TYPE_CHECKING:
    from jointctl.tools.session.loop_handle import LoopHandle


class Guard(Protocol):
    """A process that switches the drive off when this program and the loop have both died."""

    @property
    def pid(self) -> int: ...

    def wait_ready(self) -> None:
        """Until it watches; without it nothing may be enabled."""

    def just_ended(self) -> bool:
        """True once, if it has gone before it was released."""

    def release(self, state: str) -> None:
        """The drive's state as the supervisor knows it; the guard ends, or tries on by itself where it is unknown."""


class SessionDrive(ABC):
    """One for each kind of drive; `session_drive` gives it."""

    @abstractmethod
    def check_rate(self, config: Config) -> None:
        """`ConfigurationError` if bus or line do not carry the rate; before anything is opened."""

    @abstractmethod
    def open(self, config: Config, gate: Callable[[], None] = lambda: None, private: bool = False) -> Drive:
        """The drive of the configuration, its bus or port open; nothing has been sent to it.

        `private`: on a virtual bus that was started a moment ago for this program alone.

        `gate` is called before each step until the loop runs, and raises where none may follow.  The caller holds the
        lock.
        """

    def open_all(
        self, configs: Sequence[Config], gate: Callable[[], None] = lambda: None, private: bool = False
    ) -> DriveGroup:
        """`open` for the joints of an arm, in their order; `ConfigurationError` where they cannot share a loop."""
        if len(configs) > 1:
            kind = configs[1].drive.kind
            raise ConfigurationError(f"{configs[1].path}: drive.kind (={kind}) must be canopen in an arm")
        return DriveGroup([self.open(configs[0], gate, private)])

    @abstractmethod
    def loop_delay_s(self, config: Config, histograms: np.ndarray) -> float:
        """The loop delay as measured in the first cycles, with the drive off."""

    def guard(self, config: Config, loop: LoopHandle) -> Guard | None:
        """Started; None where the drive itself watches over the loop."""
        return None

    def kept_awake(self, output: Output) -> AbstractContextManager[bool]:
        """Keeps the computer from falling asleep where the drive would hold its last command; gives whether it does."""
        return nullcontext(False)

    def refuse_beside_run(self, config: Config) -> None:  # noqa: B027  (most need nothing)
        """`BusError` while a run has the line, where the lock of the bus does not tell."""

    @abstractmethod
    def fault_text(
        self, config: Config, fault: Fault, value: float, drive_error: int, encoder_error: int = 0
    ) -> FaultText:
        """A fault in the words that fit the drive, its line and the joint's encoders."""

    @abstractmethod
    def error_text(self, code: int) -> str:
        """An error that the drive reports by itself."""

    def state_text(self, status_word: int) -> str | None:
        """The state that a status word tells, with more detail than the loop's own; None: it tells no more."""
        return None

    def in_fault(self, status_word: int) -> bool:
        """Whether the status word alone tells of a fault."""
        return False

    def bits_sent(self, ports: np.recarray, axis: int = 0) -> float:
        """On the joint's bus or line in this run, `ports` the records of the exchange of all joints."""
        return float(ports[0].bits_sent)

    def refuse_others(self, port: np.recarray) -> None:  # noqa: B027  (a serial line has one user)
        """`BusError` where set-points have reached the drive that the loop has not sent; `port`: its record."""

    @abstractmethod
    def load_row(self, share: float) -> tuple[str, str]:
        """Name and text of the measured load of bus or line, for the summary of a run."""


def drive_state_name(drive: SessionDrive, status_word: int, drive_state: int) -> str:
    """`operation enabled` and so on; where the status word tells no more, the loop's own name of the state."""
    if drive_state == DriveState.UNKNOWN:
        return "not heard yet"
    return drive.state_text(status_word) or in_words(DriveState(drive_state))


def _canopen() -> SessionDrive:
    from jointctl.tools.session.canopen_drive import CanopenSession

    return CanopenSession()


def _elmo_serial() -> SessionDrive:
    from jointctl.tools.session.elmo_drive import ElmoSession

    return ElmoSession()


_DRIVES: dict[str, Callable[[], SessionDrive]] = {"canopen": _canopen, "elmo_serial": _elmo_serial}


def session_drive(kind: str) -> SessionDrive:
    """For drive.kind; only that drive's modules are loaded."""
    return _DRIVES[kind]()


def latched_text(config: Config, state: AxisState) -> FaultText | None:
    """The fault that a loop has latched in the words of a session; None where there is none."""
    if state.fault == Fault.NONE:
        return None
    errors = int(state.fault_drive_error), int(state.fault_encoder_error)
    return session_drive(config.drive.kind).fault_text(
        config, Fault(int(state.fault)), float(state.fault_value), *errors
    )
