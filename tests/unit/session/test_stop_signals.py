"""Stop signals that come where an exception does not get through."""

from __future__ import annotations

import ctypes
import signal
import sys
import time
from collections.abc import Iterator
from typing import Any

import pytest

from jointctl.tools.session.control import AGAIN_S, stop_signals


@ctypes.CFUNCTYPE(None)
def stopped_in_a_callback() -> None:
    """As the compiler's, while it runs."""
    signal.raise_signal(signal.SIGINT)


class StoppedAtItsEnd:
    def __del__(self) -> None:
        signal.raise_signal(signal.SIGINT)


@pytest.fixture
def terminated() -> Iterator[list[int]]:
    """SIGTERM that comes when nobody collects stop signals; it would end the program."""
    came: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, _: came.append(number))
    yield came
    signal.signal(signal.SIGTERM, before)


@pytest.mark.parametrize("stopped", [stopped_in_a_callback, lambda: StoppedAtItsEnd() and None])
def test_a_stop_that_a_library_swallows_is_raised_again(stopped: Any, capsys: Any) -> None:
    with stop_signals(raising=True) as signals:
        with pytest.raises(KeyboardInterrupt):  # noqa: PT012  (it is raised by the second line)
            stopped()
            time.sleep(5.0)
        assert (signals.count, signals.name) == (1, "SIGINT")
    assert "Traceback" not in capsys.readouterr().err


def test_it_is_raised_neither_while_signals_are_held_nor_afterwards(terminated: list[int]) -> None:
    hook = sys.unraisablehook
    with stop_signals(raising=True) as signals:
        stopped_in_a_callback()
        with signals.held():
            time.sleep(2.0 * AGAIN_S)
        stopped_in_a_callback()
    time.sleep(2.0 * AGAIN_S)
    assert signals.count == 2
    assert terminated == []
    assert sys.unraisablehook is hook


def test_what_else_goes_wrong_there_is_shown_as_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[Any] = []
    monkeypatch.setattr(sys, "unraisablehook", shown.append)

    @ctypes.CFUNCTYPE(None)
    def wrong() -> None:
        raise ValueError

    with stop_signals(raising=True) as signals:
        wrong()
    assert [lost.exc_type for lost in shown] == [ValueError]
    assert signals.count == 0
    shown.clear()
