"""`jointctl demo` in an empty folder: the main job from the first frame to the picture."""

from __future__ import annotations

import json
import signal
import struct
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.states import AxisPhase, DriveState
from tests.hil.moving_run import gone
from tests.python_process import eventually

ROWS = (
    "tracking error", "RMSE", "wake-up late, p50/p99/p99.9/max", "work, p50/p99/p99.9/max", "skipped", "bus load",
    "friction feed-forward", "network torque", "drive afterwards", "log", "picture",
)  # fmt: skip
PNG_HEAD = struct.Struct(">8s4x4sII")


def test_demo_tells_what_happened_and_leaves_log_and_picture(bench: Any) -> None:
    done = bench.run("demo", "--duration", "1.0")
    assert done.code == 0, done.err
    assert "Traceback" not in done.err
    for row in ROWS:
        assert row in done.out, row
    assert "switch on disabled" in done.out
    assert sorted(path.suffix for path in bench.folder.glob("runs/*")) == [".mcap", ".png"]

    log = bench.log()
    phases = [AxisPhase(p) for i, p in enumerate(log.records.phase) if i == 0 or p != log.records.phase[i - 1]]
    assert phases == [p for p in AxisPhase if p is not AxisPhase.QUICK_STOPPING]
    assert log.complete
    assert log.records.drive_state[-1] == DriveState.OFF
    tracking = log.records[log.records.phase == AxisPhase.TRACKING]
    assert np.max(np.abs(tracking.error_rad)) < 5e-3
    off = log.records[log.records.drive_state != DriveState.ENABLED]
    assert np.all(off.command_torque_Nm[off.phase < AxisPhase.APPROACH] == 0.0)

    picture = next(bench.folder.glob("runs/*.png"))
    signature, chunk, width, height = PNG_HEAD.unpack(picture.read_bytes()[: PNG_HEAD.size])
    assert (signature, chunk) == (b"\x89PNG\r\n\x1a\n", b"IHDR")
    assert 600 <= width <= 4000
    assert 400 <= height <= 4000
    assert 20_000 < picture.stat().st_size < 2_000_000


def test_json_is_one_document_and_nothing_else(bench: Any) -> None:
    done = bench.run("demo", "--duration", "1.0", "--json")
    assert done.code == 0, done.err
    data = json.loads(done.out)
    assert data["fault"] is None
    assert data["stopped_by"] is None
    assert data["drive_state"] == "switch on disabled"
    assert 0.2 < data["bus_load"] < 0.4  # 28.5 % at 1 kHz and 1 Mbit/s without skipped slots
    assert (bench.folder / data["log"]).is_file()
    assert (bench.folder / data["picture"]).is_file()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_demo_that_is_killed_while_it_starts_leaves_no_process_behind(bench: Any, number: int) -> None:
    started = bench.start("demo").saw("starting the virtual joint")
    children = eventually(started.children)
    started.signal(number)
    started.process.wait(10.0)
    assert all(gone(pid, 120.0) for pid in children)  # the first start compiles before it looks around
    assert "Traceback" not in started.err


def test_a_stop_finds_the_program_of_a_demo(bench: Any) -> None:
    """Which has its lock before its virtual bus is there."""
    started = bench.start("demo", "--duration", "60").saw("tracking")
    pid = started.process.pid
    stopped = bench.run("stop", "virtual", "-c", f"demo-{pid}")
    assert stopped.code == 0, stopped.err
    assert f"stopping the program that controls the bus (pid {pid})" in stopped.err
    assert started.process.wait(30.0) == 130
