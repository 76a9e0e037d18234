"""The process of the plain Python loop: which rates it takes, and that it ends with one line."""

from __future__ import annotations

import json
import os
import sys

import pytest

from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.session import loop_process, loops
from jointctl.tools.session.loop_handle import SharedBlock
from jointctl.tools.session.portable_loop import HIGHEST_RATE_HZ, check_portable_rate, held_rate_Hz, portable_note


@pytest.mark.parametrize("rate_Hz", [1.0, 499.0, 500.0])
def test_rates_that_are_allowed(rate_Hz: float) -> None:
    check_portable_rate("slcan", rate_Hz)


@pytest.mark.parametrize("rate_Hz", [500.001, 501.0, 1000.0])
def test_rates_that_are_refused(rate_Hz: float) -> None:
    with pytest.raises(ConfigurationError, match=r"loop\.rate_Hz .*must be at most 500 .*slcan"):
        check_portable_rate("slcan", rate_Hz)


def order(interface: str, period_ns: int, block: SharedBlock) -> str:
    channel = "no-such-bus"
    fd = os.dup(block.fd)
    return loop_process.LoopOrder(os.getpid(), fd, 1, interface, channel, period_ns, 600_000, None, None).argument()


@pytest.mark.parametrize(
    ("interface", "period_ns", "code", "text"),
    [
        ("nonsense", 10_000_000, 4, "interface (='nonsense') must be one of"),
        ("udp_multicast", 1_000_000, 3, "loop.rate_Hz (=1000) must be at most 500"),
        ("jointctl", 1_000_000, 4, "no virtual bus at"),
    ],
)
def test_the_process_ends_with_one_line(
    interface: str,
    period_ns: int,
    code: int,
    text: str,
    block: SharedBlock,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(loop_process, "_block_signals", lambda: None)
    monkeypatch.setattr(loops, "compiled_call", lambda *_: lambda cycles: cycles)
    monkeypatch.setattr(sys, "argv", ["loop", order(interface, period_ns, block)])
    assert loop_process.main() == code
    lines = capsys.readouterr().err.splitlines()
    assert text in lines[-1]
    assert sum("plain Python loop over" in line for line in lines[:-1]) == len(lines) - 1


def test_an_unexpected_exception_is_one_line_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(loop_process, "_block_signals", lambda: None)
    monkeypatch.setattr(sys, "argv", ["loop", json.dumps({"surprise": 1})])
    assert loop_process.main() == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("loop: TypeError at loop_process.py:")
    assert "surprise" in line


def test_the_rate_that_is_held_is_told_and_one_beyond_it_warned_of() -> None:
    assert "holds about 400 Hz now; expect" in portable_note("slcan", 400.0, 400.0)
    assert "holds about 400 Hz now, LESS than loop.rate_Hz (=401)" in portable_note("slcan", 401.0, 400.0)


def test_the_rate_that_is_held_follows_from_wake_up_and_work() -> None:
    assert 0.0 < held_rate_Hz(0.6) <= HIGHEST_RATE_HZ
    assert held_rate_Hz(0.999) < 100.0  # of a period, 10 us and less are left for both
