"""The fixed-rate loop with a stub drive: schedule, stop word, supervisor, log ring, and no allocation per cycle."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.cycle import HISTOGRAM_BINS, Histogram, Word, count
from jointctl.firmware_py.states import AxisPhase, DriveRequest, Fault
from tests.python_process import run_python
from tests.unit.firmware_py.stub_loop import (
    BUSY_CYCLE,
    CYCLE,
    SENT,
    STOP,
    STOP_CYCLE,
    ANSWER_ns,
    BUSY_ns,
    HEARD_AT_ns,
    LATEST_ns,
    Loop,
    PERIOD_ns,
)


@pytest.fixture
def loop(axis_constants: Any) -> Callable[..., Loop]:
    """Builds a compiled loop."""

    def build(**settings: int) -> Loop:
        built = Loop(axis_constants, **settings)
        assert built.run(0) == 0
        return built

    return build


def test_with_no_cycles_nothing_happens(loop: Callable[..., Loop]) -> None:
    built = loop()
    assert (built.stub[CYCLE], built.stub[SENT], built.words[Word.HEAD]) == (0, 0, 0)
    assert not built.histograms.any()


def test_every_deadline_is_a_whole_number_of_periods_after_the_last(loop: Callable[..., Loop]) -> None:
    built = loop()
    assert built.run(200) == 200
    log = built.ring[:200]
    np.testing.assert_array_equal(np.diff(log.time_ns), PERIOD_ns * (1 + log.skipped[1:].astype(np.int64)))
    assert log.time_ns[-1] - log.time_ns[0] == PERIOD_ns * (log.cycle[-1] - log.cycle[0])
    assert np.all(log.wake_late_ns >= 0)  # never before its deadline
    assert built.words[Word.SKIPPED] == log.skipped.sum()
    assert (built.stub[CYCLE], built.stub[SENT]) == (200, 200)


def test_the_sample_may_come_until_a_time_counted_from_the_deadline(loop: Callable[..., Loop]) -> None:
    built = loop()
    built.run(5, receive_ns=600_000)
    assert built.stub[LATEST_ns] == built.ring[4].time_ns + 600_000
    assert built.stub[HEARD_AT_ns] >= built.ring[4].time_ns


def test_an_overrun_skips_slots_and_keeps_the_phase(loop: Callable[..., Loop]) -> None:
    built = loop()
    built.stub[BUSY_CYCLE], built.stub[BUSY_ns] = 20, 5_000_000
    built.run(60)
    log = built.ring[:60]
    assert log.skipped[21] >= 4
    assert log.work_ns[20] >= 4_900_000
    assert np.all((log.time_ns - log.time_ns[0]) % PERIOD_ns == 0)
    # no burst: one cycle for each slot at most, and the axis was told how much time has gone
    assert np.all(np.diff(log.time_ns) >= PERIOD_ns)
    assert log.cycle[21] - log.cycle[20] == 1 + log.skipped[21]
    assert built.words[Word.SKIPPED] == log.skipped.sum()


@pytest.mark.parametrize("answer_ns", [1, -1], ids=["after SYNC", "of an earlier SYNC"])
def test_the_axis_is_told_how_late_its_sample_was_asked_for(loop: Callable[..., Loop], answer_ns: int) -> None:
    built = loop()
    built.stub[ANSWER_ns] = answer_ns
    last_ns = 0
    for _ in range(5):
        built.run(1)
        record = built.ring[built.words[Word.HEAD] - 1]
        asked_ns = int(built.stub[HEARD_AT_ns]) if answer_ns > 0 else last_ns
        assert built.state[0].sample_late_s == ((asked_ns - record.time_ns) * 1e-9 if asked_ns else 0.0)
        assert not asked_ns or (asked_ns > record.time_ns) == (answer_ns > 0)
        last_ns = int(built.stub[HEARD_AT_ns])


@pytest.mark.realtime  # cycles must not be skipped
@pytest.mark.parametrize(("stop", "phase"), [(1, AxisPhase.RAMPING), (2, AxisPhase.QUICK_STOPPING), (3, None)])
def test_the_stop_word_is_seen_in_the_same_cycle(loop: Callable[..., Loop], stop: int, phase: AxisPhase | None) -> None:
    built = loop()
    built.constants[0].trajectory.amplitude_rad = 0.0
    built.stub[STOP_CYCLE], built.stub[STOP] = 60, stop
    executed = built.run(2000)
    log = built.ring[:executed]
    assert executed < 200
    assert log.phase[59] == AxisPhase.TRACKING
    assert log.phase[60] == (AxisPhase.DISABLING if phase is None else phase)
    assert log.phase[-1] == AxisPhase.FINISHED
    assert built.state[0].fault == Fault.NONE
    assert built.command[0].request == DriveRequest.OFF


@pytest.mark.parametrize("beating", [True, False])
def test_the_age_of_the_supervisor(loop: Callable[..., Loop], beating: bool) -> None:
    built = loop()
    built.constants[0].sequence.supervisor_max_cycles = 20_000
    built.words[Word.SUPERVISOR_NS] = time.monotonic_ns() - (0 if beating else 30_000 * PERIOD_ns)
    built.run(50)
    assert built.state[0].fault == (Fault.NONE if beating else Fault.SUPERVISOR_LOST)


def test_the_ring_wraps_and_record_k_is_at_k_modulo_its_length(loop: Callable[..., Loop]) -> None:
    built = loop(ring=16)
    built.run(40)
    assert built.words[Word.HEAD] == 40
    order = [k % 16 for k in range(24, 40)]
    cycles = built.ring.cycle[order]
    assert np.all(np.diff(cycles) >= 1)
    assert cycles[-1] == built.state[0].cycle
    assert built.words[Word.LOOP_NS] >= built.ring[39 % 16].time_ns


def test_the_loop_goes_on_where_it_was_left(loop: Callable[..., Loop]) -> None:
    built = loop()
    built.run(10)
    built.run(10)
    assert built.words[Word.HEAD] == 20
    assert built.state[0].cycle == built.ring[19].cycle >= 20


def test_histograms_count_every_cycle_once(loop: Callable[..., Loop]) -> None:
    built = loop()
    built.run(150)
    counts = dict(zip(Histogram, built.histograms.sum(axis=1), strict=True))
    assert counts == dict.fromkeys(Histogram, 150) | {Histogram.SYNC_SPREAD: 0}  # which is of several buses
    assert built.histograms[Histogram.ROUND_TRIP, 1] == 150  # the stub says 1.5 us


@pytest.mark.parametrize(
    ("duration_ns", "bin_us"),
    [(-5, 0), (0, 0), (999, 0), (1000, 1), (4_095_999, 4095), (4_096_000, 4096), (10**15, 4096)],
)
def test_bins(duration_ns: int, bin_us: int) -> None:
    histograms = np.zeros((len(Histogram), HISTOGRAM_BINS), np.int64)
    count(histograms, Histogram.WORK, duration_ns)
    assert histograms[Histogram.WORK, bin_us] == 1
    assert histograms.sum() == 1


def test_the_log_tells_what_the_axis_did(loop: Callable[..., Loop]) -> None:
    built = loop()
    built.run(100)
    log, state = built.ring[99], built.state[0]
    assert log.phase == state.phase == AxisPhase.TRACKING
    assert log.command_torque_Nm == state.command_torque_Nm == built.command[0].torque_Nm
    assert log.error_rad == log.position_rad - log.desired_position_rad
    parts = log.inertia_torque_Nm + log.feedback_torque_Nm + log.friction_torque_Nm + log.gravity_torque_Nm
    assert log.unlimited_torque_Nm == pytest.approx(parts - log.network_torque_Nm)
    assert list(log.weights) == list(state.law.network.weights)
    angle = 0.2 * math.pi * log.trajectory_s
    assert log.desired_position_rad == pytest.approx(0.35 * math.sin(angle), abs=1e-12)


# --- no allocation per cycle -----------------------------------------------------------------------------------


_COUNT_ALLOCATIONS = """
import socket, sys
import numba
import numpy as np
from numba.core.runtime import rtsys
from tests.axis_on_stub_joint import small_axis_constants
from tests.unit.firmware_py import stub_loop as stub

loop = stub.Loop(small_axis_constants(), period_ns=10_000)
sequence = loop.constants[0].sequence
sequence.begin_max_cycles = 1 << 40
sequence.wait_max_cycles = sequence.enable_max_cycles = 1 << 40  # of 10 us: a busy computer uses up 30 at once
sequence.approach_s = 0.01

def stub_run(cycles):
    return loop.run(cycles)

ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
ours.setblocking(False)

def driver_run(cycles):
    from jointctl.drivers.canopen.exchange import link_of, receive, send
    from jointctl.drivers.canopen.cyclic import CanopenPort
    from jointctl.firmware_py.cycle import Exchange
    from jointctl.firmware_py.schema import new
    from jointctl.firmware_py.cycle import run_loop
    global link, memory
    if "link" not in globals():
        port = new(CanopenPort)
        port[0].fd, port[0].heartbeat_cycles, port[0].tpdo_length = ours.fileno(), 3, 8
        port[0].torque_Nmppermille = 0.06
        link, memory = link_of(port), loop.memory()
    return run_loop(memory, Exchange(receive, send, link), 10_000, 0, cycles)

run = {"stub": stub_run, "driver": driver_run}[sys.argv[1]]

def allocations(cycles):
    before = rtsys.get_allocation_stats()
    assert run(cycles) == cycles
    after = rtsys.get_allocation_stats()
    return after.alloc - before.alloc, after.free - before.free

@numba.njit
def allocating(count):
    return np.zeros(count)[0]

allocating(1)
before = rtsys.get_allocation_stats().alloc
allocating(1)
assert rtsys.get_allocation_stats().alloc == before + 1  # the statistics are alive
run(0)
allocations(100)
print(loop.state[0].phase, *allocations(20_000))
"""


@pytest.mark.parametrize("exchange", ["stub", "driver"])
def test_no_memory_is_allocated_per_cycle(exchange: str) -> None:
    """Neither when the loop begins nor afterwards, tracking with every part of the law."""
    phase, *counts = map(int, run_python(_COUNT_ALLOCATIONS, exchange, NUMBA_NRT_STATS="1").split())
    assert phase == (AxisPhase.TRACKING if exchange == "stub" else AxisPhase.WAITING)
    assert counts == [0, 0]
