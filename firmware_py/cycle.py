"""One cycle of the control loop, for all axes at once, and the fixed-rate loop around it.

The cycle is the same function in real time, in plain Python and in lockstep.

    receive -> samples -> suspension, stop word, sign of life -> desired motions -> arm -> laws -> send -> log records

What differs is handed in: an `Exchange` moves frames or bytes, a `Clock` gives the time, and the front end decides when
a cycle begins (`Slot`).  Front ends: `run_loop` on a descriptor, the same loop in plain Python over python-can
(`tools.session.portable_loop`), and simulated time (`hil.lockstep`).

Every array of records has one element an axis.  The axes share SYNC, stop word, start and end: none is enabled before
all can be, none gets torque before all are enabled, whatever brakes one brakes the others in the same cycle, and torque
is released when all stand (`hold_back`, `stop_others`); the loop goes on until the last one is FINISHED.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from jointctl.firmware_py.arm_model import Arm, feed_arm
from jointctl.firmware_py.axis import command_axis, move_axis, sense_axis
from jointctl.firmware_py.kernel import inlined, kernel, shared
from jointctl.firmware_py.libc import boottime_ns, load_acquire, monotonic_ns, sleep_until_ns, store_release
from jointctl.firmware_py.records import AxisState, Command, LogRecord, Sample
from jointctl.firmware_py.safety import check_suspension, is_astray
from jointctl.firmware_py.schema import INT32_MAX
from jointctl.firmware_py.sequence import end_sinking, is_enabled, request_stop, write_command
from jointctl.firmware_py.states import AxisPhase, DriveRequest, DriveState, Fault, StopRequest

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
    BUS = 88  # the supervisor: the bus is there, and may be opened


WORDS = 96
LINE_WORDS = 8  # int64 in a cache line
_RAMP = int(StopRequest.RAMP)
SUSPENDED_MIN_NS = 1_000_000  # shorter is how far apart two clocks can be read


class Histogram(IntEnum):
    """Row of the histogram array int64[4, HISTOGRAM_BINS]."""

    WAKE = 0
    ROUND_TRIP = 1
    WORK = 2
    SYNC_SPREAD = 3  # from the first bus's SYNC to the last one's, of an arm on several buses


@kernel
def count(histogram: np.ndarray, row: int, duration_ns: int) -> None:
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
    record.notices = state.notices


# --- What a cycle works on, and what its front end hands in ---


class CycleMemory(NamedTuple):
    """The memory of a loop; arrays of records have one element an axis, and nothing here is allocated in a cycle."""

    constants: np.ndarray  # AxisConstants
    state: np.ndarray  # AxisState, reset
    tables: np.ndarray  # float64[axes, rows, 5]: the rows of a table trajectory
    sample: np.ndarray  # Sample
    command: np.ndarray  # Command
    words: np.ndarray  # int64[WORDS]
    ring: np.ndarray  # LogRecord[R]; record k is at k % R once HEAD > k
    histograms: np.ndarray  # int64[4, HISTOGRAM_BINS]
    timespec: np.ndarray  # int64[2]: scratch of the clock
    arm: Arm | None = None  # that the axes are the joints of, in their order; None: nothing of arms is compiled


class Exchange(NamedTuple):
    """How frames or bytes are moved; `link` is the driver's memory and is only passed through.

    `receive` asks for samples and waits for them until `until_ns`; it returns how long it waited [ns].  A sample that
    answers an earlier request gets `now_ns` as its time, one that answers this one a later time.
    """

    receive: Callable[[Any, np.ndarray, int, int], int]  # (link, samples, now_ns, until_ns)
    send: Callable[[Any, np.ndarray, np.ndarray], int]  # (link, samples, commands)
    link: Any


class Near(NamedTuple):
    """Memory that an exchange keeps in the processor's cache while it waits, for what comes after; may be empty.

    Between two frames the core is another program's, and what it displaces would be missing after the last sample.
    """

    words: np.ndarray  # int64
    parts: np.ndarray  # int64[P, 2]: index of the first word, and the one after the last


def nothing_near() -> Near:
    return Near(np.zeros(0, np.int64), np.zeros((0, 2), np.int64))


@kernel
def fetch(near: Near) -> int:
    """Read a word of each cache line; the caller stores the sum, which means nothing, so that all of it is read."""
    words, total = near.words, 0
    for part in range(len(near.parts)):
        for index in range(near.parts[part, 0], near.parts[part, 1], LINE_WORDS):
            total += words[index]
    return total


class Clock(NamedTuple):
    """The loop's time [ns]; `timespec` is int64[2] scratch."""

    now_ns: Callable[[np.ndarray], int]
    slept_ns: Callable[[np.ndarray, np.ndarray], int]  # (words, timespec): the computer since the run began


class Slot(NamedTuple):
    period_ns: int
    deadline_ns: int  # a whole number of periods after the last one
    wake_ns: int
    late_ns: int  # from the deadline that was slept for, which an overrun leaves behind
    elapsed_cycles: int  # periods since the last cycle, 1 without an overrun
    until_ns: int  # until then a sample may come


@inlined
def load_word(words: np.ndarray, index: int) -> int:
    """`load_acquire`, also for callers in Python."""
    return load_acquire(words, index)


@inlined
def store_word(words: np.ndarray, index: int, value: int) -> None:
    """`store_release`, also for callers in Python."""
    store_release(words, index, value)


# --- The cycle ---


# No joint of an arm has torque while another has none, as far as the loop can see to it: their drives are prepared
# together once all joints could be enabled, enabled together once all are prepared, get torque together once all are
# enabled, brake together, and release their torque together once all stand.


@inlined
def is_stopping(state: AxisState) -> int:
    """1 for an axis that has tripped, or brakes."""
    return 1 if state.fault != Fault.NONE or state.phase >= AxisPhase.RAMPING else 0


@kernel
def count_stopping(states: np.ndarray) -> int:
    """How many axes have tripped, or brake: where it is another one, an axis ramps down too."""
    stopping = 0
    for axis in range(len(states)):
        stopping += is_stopping(states[axis])
    return stopping


@kernel
def hold_back(states: np.ndarray) -> None:
    """Which axes must stay in WAITING or RAMPING although they are `ready`: another one is not.

    An axis that has just become ready waits for the next cycle too, so that all go on in the same one.  One that is
    switched off by its fault is ahead, and holds no one back.
    """
    last, missing = INT32_MAX, 0  # the phase of those that are behind all others, and whether one of them is not ready
    for axis in range(len(states)):
        phase = states[axis].phase
        if phase < last:
            last, missing = phase, 0
        if phase == last and states[axis].ready == 0:
            missing = 1
    for axis in range(len(states)):
        states[axis].held_back = 1 if states[axis].phase > last else missing


@kernel
def note_astray(constants: np.ndarray, states: np.ndarray) -> None:
    """Which axes another one may shake."""
    astray = 0
    for axis in range(len(states)):
        astray += is_astray(constants[axis].limits, states[axis])
    for axis in range(len(states)):
        states[axis].shaken = 1 if astray > is_astray(constants[axis].limits, states[axis]) else 0


@kernel
def stop_others(states: np.ndarray, samples: np.ndarray) -> bool:
    """Ramp every axis down once another one has tripped, or brakes; True where the drives of all axes are enabled."""
    all_enabled, stopping = True, count_stopping(states)
    for axis in range(len(states)):
        own = is_stopping(states[axis])
        if stopping > own:
            request_stop(states[axis], _RAMP)
            stopping += is_stopping(states[axis]) - own
        all_enabled = all_enabled and is_enabled(states[axis], samples[axis])
    return all_enabled


@kernel
def all_prepared(samples: np.ndarray) -> bool:
    """Whether no drive is farther than one step from enabled: an enabled joint without torque falls, its brake open."""
    for axis in range(len(samples)):
        state = samples[axis].drive_state
        if state != DriveState.PREPARED and state != DriveState.ENABLED:
            return False
    return True


@kernel
def wait_for_all(states: np.ndarray) -> None:
    """A set-point or a change counts once there is one for every axis: all begin in the same cycle, or none does."""
    written, order = states[0].stream.written, states[0].change.order
    for axis in range(len(states)):
        written = min(written, states[axis].stream.written)
        order = min(order, states[axis].change.order)
    for axis in range(len(states)):
        states[axis].stream.written, states[axis].change.order = written, order


@shared
def log_cycle(memory: CycleMemory, slot: Slot, waited_ns: int, end_ns: int) -> bool:
    """A record of each axis, the histograms and the words; True once every axis is FINISHED."""
    words, ring, histograms = memory.words, memory.ring, memory.histograms
    head = load_word(words, Word.HEAD)
    work_ns = end_ns - slot.wake_ns - waited_ns
    finished, sync_spread_ns = True, 0
    for axis in range(len(memory.state)):
        state, sample = memory.state[axis], memory.sample[axis]
        sync_spread_ns = max(sync_spread_ns, sample.sync_late_ns)
        fresh = state.sample_age_cycles == 0
        round_trip_ns = waited_ns
        if 0 < sample.time_ns <= slot.wake_ns:
            # it answers an earlier SYNC and came between the cycles: without this the delay would look shorter
            round_trip_ns += slot.elapsed_cycles * slot.period_ns
        record = ring[(head + axis) % len(ring)]
        write_log(record, state, sample, memory.command[axis])
        record.time_ns = slot.deadline_ns
        record.wake_late_ns = min(slot.late_ns, INT32_MAX)
        record.round_trip_ns = min(round_trip_ns, INT32_MAX) if fresh else 0
        record.work_ns = min(work_ns, INT32_MAX)
        record.skipped = min(slot.elapsed_cycles - 1, INT32_MAX)
        if fresh:
            count(histograms, Histogram.ROUND_TRIP, round_trip_ns)
        finished = finished and state.phase == AxisPhase.FINISHED
    count(histograms, Histogram.WAKE, slot.late_ns)
    count(histograms, Histogram.WORK, work_ns)
    if sync_spread_ns > 0:
        count(histograms, Histogram.SYNC_SPREAD, sync_spread_ns)
    store_word(words, Word.SKIPPED, load_word(words, Word.SKIPPED) + slot.elapsed_cycles - 1)
    store_word(words, Word.HEAD, head + len(memory.state))
    store_word(words, Word.LOOP_NS, end_ns)
    return finished


@kernel
def _feed(arm: Arm | None, memory: CycleMemory) -> None:
    if arm is not None:
        feed_arm(arm, memory.constants, memory.state)


@shared
def step_cycle(memory: CycleMemory, exchange: Exchange, clock: Clock, slot: Slot) -> bool:
    """One cycle of every axis; True once every axis is FINISHED."""
    words, samples, commands = memory.words, memory.sample, memory.command
    waited_ns = exchange.receive(exchange.link, samples, slot.wake_ns, slot.until_ns)
    stop_request = load_word(words, Word.STOP)
    supervisor_age_cycles = (slot.wake_ns - load_word(words, Word.SUPERVISOR_NS)) // slot.period_ns
    slept_ns = clock.slept_ns(words, memory.timespec)
    several = len(memory.state) > 1
    if several:
        hold_back(memory.state)
        note_astray(memory.constants, memory.state)
    stopping = count_stopping(memory.state)
    for axis in range(len(memory.state)):
        state, sample = memory.state[axis], samples[axis]
        state.slot_ns = slot.deadline_ns
        asked_ns = slot.wake_ns + int(sample.sync_late_ns)
        # what came before this SYNC answers the last one: so far from this slot, it would look like a leap
        of_sync_ns = asked_ns if sample.time_ns > slot.wake_ns else state.asked_ns
        state.sample_late_s = (of_sync_ns - slot.deadline_ns) * 1e-9 if of_sync_ns > 0 else 0.0
        state.asked_ns = asked_ns
        if slept_ns > SUSPENDED_MIN_NS:
            check_suspension(state, slept_ns * 1e-9)
        own = is_stopping(state)
        request = max(stop_request, _RAMP) if stopping > own else stop_request
        sense_axis(memory.constants[axis], state, sample, slot.elapsed_cycles, request, supervisor_age_cycles)
        stopping += is_stopping(state) - own
    if several:
        wait_for_all(memory.state)
        end_sinking(memory.constants, memory.state, samples)
    together, all_enabled = all_prepared(samples), stop_others(memory.state, samples)
    for axis in range(len(memory.state)):
        move_axis(
            memory.constants[axis], memory.state[axis], memory.tables[axis], samples[axis], slot.elapsed_cycles,
            together, all_enabled,
        )  # fmt: skip
    stop_others(memory.state, samples)
    _feed(memory.arm, memory)
    for axis in range(len(memory.state)):
        command_axis(
            memory.constants[axis], memory.state[axis], memory.tables[axis], samples[axis], commands[axis],
            slot.elapsed_cycles,
        )  # fmt: skip
    if several:
        stop_others(memory.state, samples)
        for axis in range(len(memory.state)):
            write_command(memory.state[axis], commands[axis])
            if (
                commands[axis].request == DriveRequest.ENABLE
                and memory.state[axis].phase == AxisPhase.ENABLING
                and not together
            ):
                commands[axis].request = DriveRequest.PREPARE
    exchange.send(exchange.link, samples, commands)
    return log_cycle(memory, slot, waited_ns, clock.now_ns(memory.timespec))


# --- The fixed-rate loop: one compiled function from before enabling until every drive is off ---
#
#     sleep until the absolute deadline -> step_cycle
#
# No Python object is touched inside, no memory is allocated, the GIL is not held.  An overrun skips slots and keeps
# the phase of the schedule; it never sends a burst.  The loop ends by itself when every axis is FINISHED.


@kernel
def slept_ns(words: np.ndarray, timespec: np.ndarray) -> int:
    """How long the computer has slept since ASLEEP_NS was written; 0 there: since the first call.

    CLOCK_MONOTONIC stands still then, so that no deadline shows it.  Between two readings the processor may be
    lost: with this order the slept time then seems shorter, never longer, and the next cycle sees it.
    """
    before_ns = load_word(words, Word.ASLEEP_NS)
    if before_ns == 0:
        start_ns = monotonic_ns(timespec)
        store_word(words, Word.ASLEEP_NS, boottime_ns(timespec) - start_ns)
        return 0
    boot_ns = boottime_ns(timespec)
    return boot_ns - monotonic_ns(timespec) - before_ns


@shared
def run_cycles(
    memory: CycleMemory,
    exchange: Exchange,
    clock: Clock,
    sleep_until_ns: Callable[[int, np.ndarray], None],
    period_ns: int,
    receive_ns: int,
    max_cycles: int,
) -> int:
    """Run until FINISHED or `max_cycles` slots; returns the number of cycles executed.

    `sleep_until_ns` (deadline_ns, timespec) waits; `receive_ns` is how long a cycle may wait for its sample, counted
    from the deadline.  In plain Python this is the portable loop.
    """
    executed = 0
    last_slot_ns = clock.now_ns(memory.timespec)
    deadline_ns = last_slot_ns + period_ns
    while executed < max_cycles:
        sleep_until_ns(deadline_ns, memory.timespec)
        wake_ns = clock.now_ns(memory.timespec)
        late_ns = wake_ns - deadline_ns
        if late_ns >= period_ns:
            deadline_ns += late_ns // period_ns * period_ns
        elapsed_cycles = (deadline_ns - last_slot_ns) // period_ns
        last_slot_ns = deadline_ns
        slot = Slot(period_ns, deadline_ns, wake_ns, late_ns, elapsed_cycles, deadline_ns + receive_ns)
        executed += 1
        if step_cycle(memory, exchange, clock, slot):
            break
        deadline_ns += period_ns
    return executed


@kernel
def run_loop(memory: CycleMemory, exchange: Exchange, period_ns: int, receive_ns: int, max_cycles: int) -> int:
    """`run_cycles` on the computer's clock.  With max_cycles = 0 nothing is sent: that call compiles."""
    clock = Clock(monotonic_ns, slept_ns)
    return run_cycles(memory, exchange, clock, sleep_until_ns, period_ns, receive_ns, max_cycles)
