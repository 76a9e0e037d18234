"""The word about a slow start comes when it is slow, and never after its end."""

from __future__ import annotations

import contextlib
import threading

from jointctl.tools.session.loop_process import slow_start


def test_a_slow_start_is_told_once() -> None:
    told = threading.Event()
    with slow_start(lambda _: told.set(), "loop", 0.01):
        assert told.wait(10.0)


def test_a_quick_one_is_not() -> None:
    told = threading.Event()
    with slow_start(lambda _: told.set(), "loop", 0.2) as started:
        started()
        assert not told.wait(0.4)


def test_one_that_fails_leaves_nothing_behind_that_speaks_later() -> None:
    told = threading.Event()
    with contextlib.suppress(ValueError), slow_start(lambda _: told.set(), "loop", 0.2):
        raise ValueError
    assert not told.wait(0.4)
