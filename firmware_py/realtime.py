"""The fixed-rate loop: one compiled function from before enabling until the drive is off.

    sleep until the absolute deadline -> receive -> tick -> send -> log record

No Python object is touched inside, no memory is allocated, the GIL is not held.  An overrun skips slots and keeps
the phase of the schedule; it never sends a burst.  The loop ends by itself when the axis is FINISHED.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import numpy as np

from jointctl.firmware_py.axis import step_axis
from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.libc import boottime_ns, load_acquire, monotonic_ns, sleep_until_ns, store_release
from jointctl.firmware_py.records import AxisConstants, AxisState, Command, LogRecord, Sample
from jointctl.firmware_py.safety import check_suspension
from jointctl.firmware_py.schema import INT32_MAX
from jointctl.firmware_py.states import AxisPhase

HISTOGRAM_BINS = 4097  # 1 us each; the last one holds everything later


class Word(IntEnum):
    """Index of a shared int64 word; eight apart, so that no two lie in one cache line."""

    GO = 0  # the supervisor lets the loop begin
    STOP = 8  # a StopRequest
    SUPERVISOR_NS = 16  # CLOCK_MONOTONIC of the supervisor's last sign of life
    HEAD = 24  # log records written since the start
    LOOP_NS = 32  # CLOCK_MONOTONIC of the last finished cycle
    READY = 40  # the loop is compiled and warm
    SKIPPED = 48  # slots skipped so far
    ENDED = 56  # the loop has returned
    LISTEN = 64  # the supervisor: what the bus says from now on is for the run
    ASLEEP_NS = 72  # CLOCK_BOOTTIME - CLOCK_MONOTONIC when the run began: how long the computer has been suspended
    HELD_UP_NS = 80  # how long the guard of a serial line saw the loop do nothing, when it switched the drive off


WORDS = 88
SUSPENDED_MIN_NS = 1_000_000  # shorter is how far apart two clocks can be read


class Histogram(IntEnum):
    """Row of the histogram array int64[3, HISTOGRAM_BINS]."""

    WAKE = 0
    ROUND_TRIP = 1
    WORK = 2


@kernel
def count(histogram: np.ndarray, row: int, duration_ns: int) -> None:
    """Add one duration to a row."""
    bin_us = duration_ns // 1000
    histogram[row, min(max(bin_us, 0), HISTOGRAM_BINS - 1)] += 1


@kernel
def write_log(record: LogRecord, state: AxisState, sample: Sample, command: Command) -> None:
    """Copy one cycle into a log record; the loop adds the times."""
    record.cycle = state.cycle
    record.trajectory_s = state.trajectory_s
    record.position_rad = state.measured_position_rad
    record.second_position_rad = state.second_position_rad
    record.velocity_radps = state.velocity.velocity_radps
    record.desired_position_rad = state.reference.position_rad
    record.desired_velocity_radps = state.reference.velocity_radps
    record.desired_acceleration_radps2 = state.reference.acceleration_radps2
    record.error_rad = state.measured_position_rad - state.reference.position_rad
    record.error_rate_radps = state.velocity.velocity_radps - state.reference.velocity_radps
    record.command_torque_Nm = state.command_torque_Nm
    record.unlimited_torque_Nm = state.unlimited_torque_Nm
    record.measured_torque_Nm = state.measured_torque_Nm
    record.command_velocity_radps = state.command_velocity_radps
    record.inertia_torque_Nm = state.law.inertia_torque_Nm
    record.feedback_torque_Nm = state.law.feedback_torque_Nm
    record.friction_torque_Nm = state.law.friction_torque_Nm
    record.gravity_torque_Nm = state.law.gravity_torque_Nm
    record.network_torque_Nm = state.law.network_torque_Nm
    record.observer_torque_Nm = state.law.observer_torque_Nm
    record.learned_torque_Nm = state.law.learned_torque_Nm
    for i in range(len(record.weights)):
        record.weights[i] = state.law.network.weights[i]
    record.sample_age_cycles = state.sample_age_cycles
    record.phase = state.phase
    record.fault = state.fault
    record.request = command.request
    record.drive_state = sample.drive_state
    record.status_word = sample.status_word
    record.drive_error = sample.drive_error


@kernel
def note_suspension(words: np.ndarray, state: AxisState, timespec: np.ndarray) -> None:
    """Trip SUSPENDED if the computer has slept since ASLEEP_NS was written; 0 there: since the first call.

    CLOCK_MONOTONIC stands still meanwhile, so that no deadline shows it.  Between two readings the processor may be
    lost: with this order the slept time then seems shorter, never longer, and the next cycle sees it.
    """
    before_ns = load_acquire(words, Word.ASLEEP_NS)
    if before_ns == 0:
        start_ns = monotonic_ns(timespec)
        store_release(words, Word.ASLEEP_NS, boottime_ns(timespec) - start_ns)
        return
    boot_ns = boottime_ns(timespec)
    slept_ns = boot_ns - monotonic_ns(timespec) - before_ns
    if slept_ns > SUSPENDED_MIN_NS:
        check_suspension(state, slept_ns * 1e-9)


@kernel
def run_loop(
    receive: Any,
    send: Any,
    port: np.ndarray,
    frames: np.ndarray,
    scratch: np.ndarray,
    constants: np.ndarray,
    state: np.ndarray,
    table: np.ndarray,
    sample: np.ndarray,
    command: np.ndarray,
    words: np.ndarray,
    ring: np.ndarray,
    histograms: np.ndarray,
    timespec: np.ndarray,
    period_ns: int,
    receive_ns: int,
    max_cycles: int,
) -> int:
    """Run until FINISHED or `max_cycles` slots; returns the number of cycles executed.

    `receive(port, frames, scratch, sample, now_ns, deadline_ns) -> int64` waited [ns] (0: no sample came) and
    `send(port, frames, sample, command) -> int32` are the driver's, as C function types; `port`, `frames` and
    `scratch` are its memory and are only passed through.  Arrays of one record: `constants` AxisConstants, `state`
    AxisState (reset), `sample`, `command`.  `ring` LogRecord[N]; record k is at k % N once HEAD > k.
    `timespec` int64[2] is scratch of the clock calls.
    `receive_ns` is how long a cycle may wait for its sample, counted from the deadline.
    With max_cycles = 0 nothing is sent: that call compiles.
    """
    axis: AxisConstants = constants[0]
    now_state: AxisState = state[0]
    executed = 0
    deadline_ns = monotonic_ns(timespec) + period_ns
    last_slot_ns = deadline_ns - period_ns
    while executed < max_cycles:
        sleep_until_ns(deadline_ns, timespec)
        wake_ns = monotonic_ns(timespec)
        late_ns = wake_ns - deadline_ns
        if late_ns >= period_ns:
            deadline_ns += late_ns // period_ns * period_ns
        elapsed_cycles = (deadline_ns - last_slot_ns) // period_ns
        last_slot_ns = deadline_ns
        waited_ns = receive(port, frames, scratch, sample, np.int64(wake_ns), np.int64(deadline_ns + receive_ns))
        # a sample that answers an earlier SYNC belongs to no slot that could be told
        now_state.sample_late_s = (wake_ns - deadline_ns) * 1e-9 if sample[0].time_ns > wake_ns else 0.0
        stop_request = load_acquire(words, Word.STOP)
        supervisor_age = (wake_ns - load_acquire(words, Word.SUPERVISOR_NS)) // period_ns
        note_suspension(words, now_state, timespec)
        step_axis(axis, now_state, table, sample[0], command[0], elapsed_cycles, stop_request, supervisor_age)
        send(port, frames, sample, command)
        round_trip_ns = waited_ns
        if 0 < sample[0].time_ns <= wake_ns:
            # it answers an earlier SYNC and came between the cycles: without this the delay would look shorter
            round_trip_ns += elapsed_cycles * period_ns
        end_ns = monotonic_ns(timespec)
        head = load_acquire(words, Word.HEAD)
        record = ring[head % len(ring)]
        write_log(record, now_state, sample[0], command[0])
        record.time_ns = deadline_ns
        record.wake_late_ns = min(late_ns, INT32_MAX)
        record.round_trip_ns = min(round_trip_ns, INT32_MAX) if now_state.sample_age_cycles == 0 else 0
        record.work_ns = min(end_ns - wake_ns - waited_ns, INT32_MAX)
        record.skipped = min(elapsed_cycles - 1, INT32_MAX)
        count(histograms, Histogram.WAKE, late_ns)
        if now_state.sample_age_cycles == 0:
            count(histograms, Histogram.ROUND_TRIP, round_trip_ns)
        count(histograms, Histogram.WORK, end_ns - wake_ns - waited_ns)
        store_release(words, Word.SKIPPED, load_acquire(words, Word.SKIPPED) + elapsed_cycles - 1)
        store_release(words, Word.HEAD, head + 1)
        store_release(words, Word.LOOP_NS, end_ns)
        executed += 1
        if now_state.phase == AxisPhase.FINISHED:
            break
        deadline_ns += period_ns
    return executed
