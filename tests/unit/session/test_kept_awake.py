"""The lock against standby during a run on a serial line, with a stand-in for systemd-inhibit."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.output import Output
from jointctl.tools.session import guard as module
from jointctl.tools.session.guard import kept_awake
from tests.places import ROOT

GRANTS = """#!/bin/sh
echo "asked $*" >>"$0.log"
while [ "${1#--}" != "$1" ]; do shift; done
"$@"
echo released >>"$0.log"
"""
REFUSES = "#!/bin/sh\necho 'Failed to inhibit: Access denied' >&2\nexit 1\n"
HANGS = "#!/bin/sh\nexec sleep 60\n"


@pytest.fixture
def stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "systemd-inhibit"
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    return path


def install(path: Path, text: str) -> None:
    path.write_text(text)
    path.chmod(0o755)


def log_of(stand_in: Path) -> list[str]:
    path = Path(f"{stand_in}.log")
    return path.read_text().splitlines() if path.exists() else []


def serial() -> Config:
    return load_config(shipped_config("elmo_serial"))


def test_the_lock_is_held_for_the_run_and_told(stand_in: Path) -> None:
    install(stand_in, GRANTS)
    err = io.StringIO()
    with kept_awake(serial(), Output(stderr=err)) as held:
        assert held
        assert len(log_of(stand_in)) == 1
        assert "--what=sleep:handle-lid-switch" in log_of(stand_in)[0]
        assert "--mode=block" in log_of(stand_in)[0]
    assert log_of(stand_in)[1:] == ["released"]
    assert "kept from falling asleep until the end of the run" in err.getvalue()


def test_its_twin_a_drive_with_a_watchdog_needs_none(stand_in: Path) -> None:
    install(stand_in, GRANTS)
    err = io.StringIO()
    with kept_awake(load_config(shipped_config("virtual")), Output(stderr=err)) as held:
        assert not held
    assert (log_of(stand_in), err.getvalue()) == ([], "")


@pytest.mark.parametrize("text", [REFUSES, HANGS, None], ids=["refused", "no answer", "not there"])
def test_without_the_lock_the_run_goes_on_and_the_user_is_told(
    stand_in: Path, text: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    if text is None:
        monkeypatch.setenv("PATH", str(stand_in.parent))
    else:
        install(stand_in, text)
    monkeypatch.setattr(module, "HELD_TIMEOUT_S", 0.3)
    monkeypatch.setattr(module, "ENDED_S", 0.1)
    err = io.StringIO()
    with kept_awake(serial(), Output(stderr=err)) as held:
        assert not held
    assert "not kept from falling asleep" in " ".join(err.getvalue().split())


def test_a_run_that_is_killed_releases_it(stand_in: Path) -> None:
    install(stand_in, GRANTS)
    code = (
        "import sys, time\nfrom tests.unit.session.test_kept_awake import Output, kept_awake, serial\n"
        "with kept_awake(serial(), Output()):\n    print('held', flush=True)\n    time.sleep(60)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as run:
        assert run.stdout is not None
        assert run.stdout.readline() == b"held\n"
        assert "released" not in log_of(stand_in)
        run.send_signal(signal.SIGKILL)
        run.wait()
    until_s = time.monotonic() + 10.0
    while "released" not in log_of(stand_in):
        assert time.monotonic() < until_s
        time.sleep(0.02)
