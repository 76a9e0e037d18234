"""What every drive offers, whatever its make: slow work in Python, and memory for the compiled cyclic exchange."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

UNTOUCHED = "untouched"  # of `Drive.make_safe`: this program has not taken the drive over
SAFE_STATES = ("switch on disabled", "fault", "off")


def is_safe(state: str) -> bool:
    """Whether the drive's words for its state mean that its power stage is off ("fault reaction active" does not)."""
    return state.partition(",")[0] in SAFE_STATES


@dataclass(frozen=True)
class DriveIdentity:
    """Who answered; empty strings where the drive does not tell."""

    vendor: str
    product: str
    revision: str
    serial: str
    name: str = ""


@dataclass(frozen=True)
class CommissioningReport:
    """What commissioning found and set, for the user and for the run log."""

    identity: DriveIdentity
    mode: str
    start_position_rad: float
    torque_resolution_Nm: float  # at the joint
    position_resolution_rad: float
    settings: dict[str, str] = field(default_factory=dict)  # name -> value read back
    remarks: tuple[str, ...] = ()
    loop_delay_s: float | None = None  # measured, position sample to torque command; None = not measured
    measures_torque: bool = True  # False: the drive does not tell its torque in the cyclic exchange, it reads as zero


@dataclass(frozen=True)
class Reading:
    """What has come of one request: `temperature_degC` is None where nothing has, and `problem` says why."""

    time_ns: int  # CLOCK_MONOTONIC, when the answer came
    temperature_degC: float | None
    problem: str = ""


class Thermometer(Protocol):
    """Reads a temperature now and then, at its own pace."""

    def poll(self) -> Reading | None:
        """What is new, or None.  Never waits and never raises for what the drive or its line does."""
        ...


class Drive(Protocol):
    """A drive on the way from unknown to commissioned, and back to safe."""

    def commission(self) -> CommissioningReport:
        """Identify the drive, write and read back limits, arm its watchdog; leaves it disabled.

        Raises `NoDeviceError` if nobody answers, `DeviceError` if it refuses or differs from the configuration.
        """
        ...

    def start_cyclic(self) -> None:
        """Let the drive take part in the cyclic exchange; still disabled."""
        ...

    def port(self) -> Any:
        """The record array for the cyclic exchange, without a file descriptor; valid after `commission`."""
        ...

    def thermometer(self) -> Thermometer | None:
        """What reads the drive's temperature beside the cyclic exchange; None where nothing can.

        Valid from `start_cyclic` until `make_safe`.
        """
        ...

    def make_safe(self) -> str:
        """Disable the drive whatever its state and confirm it; returns the state in words.  Never raises."""
        ...

    def clear_fault(self) -> str:
        """Reset the drive's own fault; it stays disabled.  Returns what was done, in words.

        Raises `DeviceError` if the fault comes back, `BusError` while another controller is active.
        """
        ...

    def close(self) -> None:
        """Release the bus."""
        ...
