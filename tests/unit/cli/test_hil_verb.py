"""`jointctl hil`: in which order it starts."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest

from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.output import Output
from jointctl.tools.verbs import hil, hil_serial


@pytest.mark.parametrize("serial", [False, True])
def test_only_what_is_compiled_and_runs_becomes_realtime(monkeypatch: pytest.MonkeyPatch, serial: bool) -> None:
    """A compiler under SCHED_FIFO takes a core from every other loop on the computer."""
    module = hil_serial if serial else hil
    happened: list[str] = []
    given: list[Sequence[int]] = []

    @contextmanager
    def serve(*_: Any) -> Iterator[SimpleNamespace]:
        happened.append("compiled and started")
        ended = threading.Event()
        worker = threading.Thread(target=ended.wait)
        worker.start()
        yield SimpleNamespace(words=[0, 0, 1, 0], path="/dev/null", baud_rate_bitps=115_200, worker=worker.native_id)
        assert worker.native_id in given[0]
        ended.set()
        worker.join()

    def realtime(cpu: int | None, priority: int | None, threads: Sequence[int] = ()) -> list[str]:
        happened.append("realtime")
        given.append(threads)
        return []

    monkeypatch.setattr(module, "serve_virtual_elmo" if serial else "serve_virtual_joint", serve)
    monkeypatch.setattr(hil, "become_realtime", realtime)
    monkeypatch.setattr(hil, "_reader_gone", lambda _: True)
    config = load_config(shipped_config("elmo_serial" if serial else "virtual"))
    assert (hil_serial.hil_serial if serial else hil.hil)(config, Output(quiet=True)) == 0
    assert happened == ["compiled and started", "realtime"]
