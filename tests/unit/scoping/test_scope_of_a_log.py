"""`jointctl scope LOG` controls no joint."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from jointctl.drivers.bus_lock import STARTING, is_marked
from jointctl.tools.output import Output
from jointctl.tools.scoping import server
from jointctl.tools.verbs import scope as scope_module


@pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="no memory files here")
def test_a_stop_does_not_wait_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.memfd_create(STARTING)
    assert is_marked(os.getpid(), STARTING)
    monkeypatch.setattr(scope_module, "read_run_log", lambda _: None)
    monkeypatch.setattr(scope_module, "scope_order", lambda *_, **__: SimpleNamespace(url=""))
    monkeypatch.setattr(server, "serve", lambda _: None)
    assert scope_module.scope(tmp_path / "run.mcap", Output(quiet=True)) == 0
    assert not is_marked(os.getpid(), STARTING)
