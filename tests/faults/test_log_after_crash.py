"""The last two seconds before a fault are in a log, whatever crashed; a reader that stalls disturbs nobody."""

from __future__ import annotations

import os
import signal
import time
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.canopen.cyclic import CanopenPort
from jointctl.firmware_py.cycle import Word
from jointctl.firmware_py.states import AxisPhase, Fault, StopRequest
from jointctl.tools.configuration.load import load_config
from jointctl.tools.configuration.records import trajectory_table
from jointctl.tools.recording.run_log_reader import read_run_log
from jointctl.tools.session.canopen_drive import CanopenSession
from jointctl.tools.session.loop_handle import LoopHandle
from jointctl.tools.session.loop_memory import RING_RECORDS, SharedBlock
from tests.hil.moving_run import Moving, gone
from tests.sessions import constants_of


@pytest.fixture
def moving(bench: Any) -> Any:
    moving = Moving(bench)
    time.sleep(2.2)  # two seconds to keep
    yield moving
    moving.close()


def covered_s(records: Any) -> float:
    return float(records.time_ns[-1] - records.time_ns[0]) * 1e-9


def test_supervisor_killed_the_loop_saves_what_it_has(moving: Any) -> None:
    killed_ns = time.monotonic_ns()
    moving.run.signal(signal.SIGKILL)
    assert gone(moving.loop, 20.0)
    (path,) = moving.bench.folder.glob("runs/*.tail.mcap")
    tail = read_run_log(path)
    assert tail.complete
    records = tail.records
    assert records.time_ns[0] < killed_ns - 2_000_000_000
    assert records.phase[-1] == AxisPhase.FINISHED
    assert records.fault[-1] == Fault.SUPERVISOR_LOST
    gaps = np.diff(records.time_ns)
    assert (gaps == 1_000_000 * (1 + records.skipped[1:])).all()  # without a hole up to the end
    assert any("supervising process" in event.text for event in tail.events)


def test_loop_killed_the_supervisor_saves_the_ring(moving: Any) -> None:
    os.kill(moving.loop, signal.SIGKILL)
    killed_ns = time.monotonic_ns()
    done = moving.run.finished(20.0)
    assert done.code == 7
    log = moving.bench.log()
    assert log.complete
    assert covered_s(log.records) > 2.0
    # up to the very last cycles: the ring outlives the process that wrote it
    assert killed_ns - log.records.time_ns[-1] < 100_000_000
    assert log.records.phase[-1] == AxisPhase.TRACKING


def test_a_reader_that_stalls_loses_records_which_are_counted_and_the_loop_goes_on(bench: Any) -> None:
    """The loop runs for longer than the ring holds while nobody reads."""
    path = bench.folder / bench.config(trajectory__duration_s=60.0, sequence__supervisor_timeout_s=10.0)
    bench.joint(path.name)
    config = load_config(path)
    table = trajectory_table(config)
    seconds = RING_RECORDS / config.loop.rate_Hz + 1.5
    with LoopHandle(config, table, CanopenPort) as loop:
        drive = CanopenSession().open(config)
        try:
            report = drive.commission()
            loop.bus_is_there()
            loop.wait_ready()
            drive.start_cyclic()
            loop.go(constants_of(config, start_position_rad=report.start_position_rad), drive.port())
            give_up = time.monotonic() + 2.0 * seconds
            while loop.cycles < RING_RECORDS + 1000:
                assert loop.running()
                assert time.monotonic() < give_up
                loop.beat()
                time.sleep(0.05)
            records = loop.new_records()
            assert loop.lost_records >= 1000
            assert (
                RING_RECORDS // 2 < len(records) <= RING_RECORDS
            )  # less by what was written over while they were read
            assert (np.diff(records.cycle) >= 1).all()
            assert loop.phase is AxisPhase.TRACKING
            loop.request_stop(StopRequest.RAMP)
            while loop.running():
                loop.beat()
                time.sleep(0.02)
            assert loop.block.state[0].fault == Fault.NONE
            last = loop.new_records()
            assert last.cycle[0] > records.cycle[-1]
            assert loop.lost_records + len(records) + len(last) == loop.cycles
        finally:
            drive.make_safe()
            drive.close()


def test_what_is_written_over_while_it_is_read_is_lost_and_counted() -> None:
    block = SharedBlock.create(1, CanopenPort)
    block.ring.cycle = np.arange(RING_RECORDS)
    block.words[Word.HEAD] = RING_RECORDS + 4  # by the time that the copy is made
    records, lost = block.new_records(0, RING_RECORDS)
    assert (records.cycle[0], len(records), lost) == (5, RING_RECORDS - 5, 5)  # number 4 may be in the making


@pytest.mark.parametrize(
    ("written", "lost"), [(RING_RECORDS, 0), (RING_RECORDS + 1, 1), (3 * RING_RECORDS, 2 * RING_RECORDS)]
)
def test_the_ring_at_its_boundary(written: int, lost: int) -> None:
    block = SharedBlock.create(1, CanopenPort)
    for number in range(max(0, written - RING_RECORDS), written):
        block.ring[number % RING_RECORDS].cycle = number
    records, counted = block.new_records(0, written)
    assert counted == lost
    assert records.cycle[0] == lost
    assert records.cycle[-1] == written - 1
