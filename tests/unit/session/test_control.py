"""A program's right to a joint: what its stops ask for, and how long it may take to end."""

from __future__ import annotations

import os
import signal
from typing import Any

import pytest

from jointctl.drivers.bus_lock import BusLock
from jointctl.firmware_py.states import StopRequest
from jointctl.tools.output import Output
from jointctl.tools.session import control
from jointctl.tools.session.control import (
    FILES_S,
    STOP_COMMAND,
    STOP_SIGNALS,
    StopSignals,
    control_of,
    in_control,
    stop_signals,
    stop_within_s,
)


@pytest.mark.parametrize(
    ("count", "commanded", "request_"),
    [
        (0, False, StopRequest.NONE), (1, False, StopRequest.RAMP), (2, False, StopRequest.QUICK_STOP),
        (3, False, StopRequest.OFF), (4, False, StopRequest.OFF), (0, True, StopRequest.QUICK_STOP),
        (1, True, StopRequest.QUICK_STOP), (2, True, StopRequest.QUICK_STOP), (3, True, StopRequest.OFF),
    ],
)  # fmt: skip
def test_asking_again_asks_for_more(count: int, commanded: bool, request_: StopRequest) -> None:
    signals = StopSignals()
    assert (signals.count, signals.commanded_ns, signals.raising, signals.by_command) == (0, 0, False, "")
    signals.leave_if_asked()
    for _ in range(count):
        signals.on_signal(signal.SIGINT, None)
    signals.commanded_ns = int(commanded)
    assert signals.request is request_
    assert signals.by_command == (f" by {STOP_COMMAND}" if commanded else "")
    if count or commanded:
        with pytest.raises(KeyboardInterrupt):
            signals.leave_if_asked()


def test_the_first_signal_is_the_one_that_is_named() -> None:
    signals = StopSignals()
    signals.on_signal(signal.SIGHUP, None)
    signals.on_signal(signal.SIGINT, None)
    assert (signals.name, signals.count) == ("SIGHUP", 2)


def test_where_something_must_come_to_its_end_a_signal_raises_nothing() -> None:
    with stop_signals(raising=True) as signals:
        with signals.held():
            signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert signals.count == 2
    with stop_signals() as signals, signals.held():
        signal.raise_signal(signal.SIGINT)
    assert not signals.raising


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_the_programs_own_handlers_are_back_afterwards(number: signal.Signals) -> None:
    handler = signal.getsignal(number)
    with stop_signals() as signals:
        signal.raise_signal(number)
        assert signals.name == number.name
    assert signal.getsignal(number) == handler


def test_a_stop_command_reaches_the_loop_and_wakes_the_main_thread() -> None:
    reached: list[StopRequest] = []
    with stop_signals() as signals:
        signals.on_command = reached.append
        signals.on_stop_command()
        assert (reached, signals.count) == ([StopRequest.QUICK_STOP], 1)
    assert signals.commanded_ns > 1
    assert signals.name == STOP_COMMAND


def test_it_may_take_as_long_as_everything_that_follows_a_stop(virtual_config: Any) -> None:
    sequence = virtual_config.sequence
    assert stop_within_s(virtual_config) == sequence.stop_timeout_s + sequence.off_timeout_s + 1.0 + 1.0 + FILES_S


@pytest.mark.parametrize("configured", [True, False])
def test_in_control_the_lock_is_held_and_its_remarks_are_told(
    virtual_config: Any, monkeypatch: pytest.MonkeyPatch, capsys: Any, configured: bool
) -> None:
    times_s: list[float] = []

    class Lock(BusLock):
        def __init__(self, interface: str, channel: str, on_stop: Any, within_s: float) -> None:
            super().__init__("socketcan", f"controlled-{os.getpid()}", on_stop, within_s)
            times_s.append(within_s)
            self.remarks.append("a remark")

    monkeypatch.setattr(control, "BusLock", Lock)
    held = in_control(virtual_config, Output()) if configured else control_of("virtual", "x", Output(), 3.0)
    with held as ours:
        assert ours.marker_fd is not None
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
    assert times_s == [stop_within_s(virtual_config) if configured else 3.0]
    assert "a remark" in capsys.readouterr().err
