"""A program's control of a joint, from before anything is sent to the drive until the program ends.

It holds the lock of the bus, collects the user's stops, and passes `jointctl stop` on to whatever it is doing.  One for
each verb that moves a joint or changes its drive, around all that it does: a stop between two motions counts too.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from jointctl.drivers.bus_lock import STOP_WITHIN_S, BusLock
from jointctl.drivers.canopen.switch_off import OFF_S, QUICK_STOP_S
from jointctl.tools.configuration.config import Config
from jointctl.tools.output import Output
from jointctl.tools.running.stop_signals import StopSignals, stop_signals

FILES_S = 4.0  # for log and messages, after the drive is off


@dataclass(frozen=True)
class Control:
    """`signals` raise KeyboardInterrupt except while the joint may have torque; `marker_fd` is for child processes."""

    signals: StopSignals
    marker_fd: int | None = None


def stop_within_s(config: Config) -> float:
    """How long the program may take to end after `jointctl stop`: quick stop, switching off, read back, files."""
    sequence = config.sequence
    return sequence.stop_timeout_s + sequence.off_timeout_s + QUICK_STOP_S + OFF_S + FILES_S


@contextmanager
def in_control(config: Config, output: Output) -> Iterator[Control]:
    """`BusError` names the program that has the bus."""
    with control_of(config.bus.interface, config.bus.channel, output, stop_within_s(config)) as control:
        yield control


@contextmanager
def control_of(interface: str, channel: str, output: Output, within_s: float = STOP_WITHIN_S) -> Iterator[Control]:
    """Of a bus; `within_s`: how long the program may take to end after `jointctl stop`."""
    with (
        stop_signals(raising=True) as signals,
        BusLock(interface, channel, signals.on_stop_command, within_s) as lock,
    ):
        for remark in lock.remarks:
            output.warning(remark)
        yield Control(signals, lock.marker_fd)
