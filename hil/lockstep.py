"""Deterministic simulation of controller, codec, drive and joint in one compiled function, faster than real time.

The controller's cycle, the driver's frame codec and the virtual drive are the very functions of the real-time run;
only bus and clock are replaced: a frame arrives in the instant in which it was sent, in order, and none is lost.  The
computer's own delay is not modelled either: with a synchronous RPDO (transmission type 1) a command takes effect one
period after the sample it was computed from, as on a real bus whose round trip fits into the period.

With faults (`hil.faults`) every frame goes through the wire of `hil.faults`; late frames arrive at
the beginning of a cycle.
After the axis has finished, the controller is silent, and drive and joint may go on for a while: nobody sends a
heartbeat then.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jointctl.firmware_py.cycle import Clock, CycleMemory, Exchange, Slot, Word, step_cycle
from jointctl.firmware_py.kernel import inlined, kernel
from jointctl.firmware_py.libc import load_acquire, store_release
from jointctl.firmware_py.motion_records import SET_POINTS, StreamConstants
from jointctl.firmware_py.records import AxisState, Sample
from jointctl.firmware_py.states import StopRequest
from jointctl.hil.arm_plant import ArmPlant, no_arm_plant
from jointctl.hil.canopen.device_core import accept_frame, advance, advance_together
from jointctl.hil.canopen.records import Device
from jointctl.hil.faults import (
    FaultKind,
    any_active,
    clock_step_cycles,
    collect,
    hand_over,
    is_active,
    kind_active,
    step_faults,
    stop_requested,
    take_due,
    to_drive,
)
from jointctl.hil.plant_records import PlantState
from jointctl.hil.virtual_bus import FRAME_SIZE, FrameQueue

# columns of the array of true values that a run may leave
TRUE_POSITION_rad, TRUE_VELOCITY_radps, TRUE_FRICTION_Nm, TRUE_ACTUATOR_Nm, TRUE_POWER_STATE, TRUE_WARMTH_degC = range(
    6
)
TRUTHS = 6
# columns of the set-points that a program sends in a run: when, as it goes on, and what
POINT_TIME_s, POINT_VALUES = 0, 1  # position, velocity, acceleration, torque: four columns
NO_POINTS = np.zeros((0, 5))

# slots of the frame memory, agreed with the caller that passes the codec: sent in begin (up to two), RPDO, received,
# and the RPDO with an offset, if its identifier is not 0
RPDO_SLOT = 2
RECEIVED_SLOT = 3
OFFSET_SLOT = 4
# No delay is modelled, but with the time of the request an answer would be that of an earlier one.
_ANSWER_NS = 1
_READ_EVERY_NS = 1_000_000_000  # the temperature
# elements of `CycleMemory.timespec`, the scratch of the loop's clock: here it is the clock
_NOW_NS, _OFF_BUS = 0, 1


class Codec(NamedTuple):
    """The driver's codec as C functions, and its memory; `frame_bytes` uint8[slots, 16] is that of its frames."""

    begin: Callable[[Any], int]  # (link) -> how many frames to send
    accept: Callable[[Any, int, int, np.ndarray, int], bool]  # (link, axis, slot, samples, now_ns)
    end: Callable[[Any, int, np.ndarray, np.ndarray], None]  # (link, axis, samples, commands)
    link: Any
    frame_bytes: np.ndarray


ONE_BUS = np.zeros(64, np.int64)


class World(NamedTuple):
    """The virtual drives, operational, with their joints and the wires to them; arrays of one record an axis.

    Faults are those of an axis: its wire, drive and plant.  What is the computer's (clock, processor, supervisor) is
    all axes' at once, an adapter that is off the bus that of all axes on its bus.
    """

    device: np.ndarray
    plant_constants: np.ndarray
    plant: np.ndarray
    queue: np.ndarray  # FrameQueue
    faults: np.ndarray  # FaultConstants[axes, M]; M = 0: nothing of them is carried out
    fault_memory: np.ndarray
    arm: ArmPlant = no_arm_plant()  # through which the joints move one another
    bus: np.ndarray = ONE_BUS  # int64[axes or more]: of each axis the first one on the same bus


class Scenario(NamedTuple):
    """What happens in a run, besides faults; times in cycles."""

    start_ns: int
    period_ns: int
    cycles: int  # at most
    stop_cycle: int = -1  # in which `stop_request` is made; negative: never
    stop_request: int = int(StopRequest.RAMP)
    tail_cycles: int = 0  # for which drive and joint go on without a controller
    log_every: int = 1  # every so many cycles a record and a row of true values are kept; 0: none
    ideal_velocity: bool = False  # bypasses encoder and velocity filter: for textbook experiments only
    supervisor_beats: bool = True  # else its sign of life ages from what `memory.words` holds
    lost_to_drive: bool = False
    lost_from_drive: bool = False
    set_points: np.ndarray = NO_POINTS  # float64 (N, 5), of a program: times since the start, ascending
    thermometer: bool = False  # the drive reports its motor's temperature, once a second


class _Link(NamedTuple):
    """What moving frames in memory works on."""

    codec: Codec
    world: World
    scenario: Scenario
    memory: CycleMemory


@kernel
def _write_truth(row: np.ndarray, device: Device, plant: PlantState) -> None:
    row[TRUE_POSITION_rad] = plant.joint_position_rad
    row[TRUE_VELOCITY_radps] = plant.joint_velocity_radps
    row[TRUE_FRICTION_Nm] = plant.friction_torque_Nm
    row[TRUE_ACTUATOR_Nm] = plant.actuator_torque_Nm
    row[TRUE_POWER_STATE] = device.state
    row[TRUE_WARMTH_degC] = plant.motor_temperature_degC


@kernel
def _perfect_measurement(state: AxisState, sample: Sample, plant: PlantState, period_s: float) -> None:
    """Replace the reading by the true position, and prepare the velocity filter so that it gives the true velocity.

    With v = the true velocity and the last position one period of v back, v + gain ((q - q_last) / T - v) is v
    whatever the gain.  The filtered error rate of e' has no such preparation: it is for `filtered_error_rate` = 0.
    """
    sample.position_rad = plant.joint_position_rad
    state.velocity.velocity_radps = plant.joint_velocity_radps
    state.velocity.last_position_rad = plant.joint_position_rad - plant.joint_velocity_radps * period_s


# --- The exchange: frames are moved in memory ---


@inlined
def _is_off_bus(link: _Link, axis: int) -> bool:
    """Whether the adapter of this axis' bus is off it."""
    world = link.world
    return world.faults.size > 0 and link.memory.timespec[_OFF_BUS] >> world.bus[axis] & 1 != 0


@inlined
def _to_drive(link: _Link, axis: int, slot: int, sample: Sample) -> None:
    """One frame of the controller; its answers are in the queue of the drive, with faults in that of the wire."""
    world, now_ns = link.world, link.memory.timespec[_NOW_NS]
    device, joint_c, joint, outgoing = (
        world.device[axis], world.plant_constants[axis], world.plant[axis], world.queue[axis]
    )  # fmt: skip
    frame = link.codec.frame_bytes[slot]
    faulty, off_bus = world.faults.size > 0, _is_off_bus(link, axis)
    if faulty:
        sample.bus_errors = sample.bus_errors + 1 if off_bus else 0
    if link.scenario.lost_to_drive or off_bus:
        return
    if faulty:
        to_drive(world.faults[axis], world.fault_memory[axis], frame, device, joint_c, joint, outgoing, now_ns)
    else:
        accept_frame(device, joint_c, joint, frame, now_ns, outgoing)


@inlined
def _empty_mailbox(mailbox: FrameQueue, codec: Codec, axis: int, samples: np.ndarray, now_ns: int) -> None:
    """Everything that has arrived goes to the driver's codec."""
    received = int(RECEIVED_SLOT)
    for index in range(mailbox.count):
        for byte in range(FRAME_SIZE):
            codec.frame_bytes[RECEIVED_SLOT, byte] = mailbox.frames[index, byte]
        codec.accept(codec.link, axis, received, samples, now_ns)
    mailbox.count = 0


@inlined
def _receive(link: _Link, samples: np.ndarray, now_ns: int, until_ns: int) -> int:
    """SYNC to the drives, their answers into the samples; nothing is waited for."""
    world, codec = link.world, link.codec
    faulty = world.faults.size > 0
    if faulty:  # what was late comes before SYNC, as in a real cycle
        for axis in range(len(samples)):
            if link.scenario.lost_from_drive or _is_off_bus(link, axis):
                world.fault_memory[axis].to_controller.count = 0
            _empty_mailbox(world.fault_memory[axis].to_controller, codec, axis, samples, now_ns)
    count = codec.begin(codec.link)
    for axis in range(len(samples)):
        for slot in range(count):
            _to_drive(link, axis, slot, samples[axis])
        if link.scenario.lost_from_drive or _is_off_bus(link, axis):
            world.queue[axis].count = 0
            world.fault_memory[axis].to_controller.count = 0
        if faulty:
            _empty_mailbox(world.fault_memory[axis].to_controller, codec, axis, samples, now_ns + _ANSWER_NS)
        else:
            _empty_mailbox(world.queue[axis], codec, axis, samples, now_ns + _ANSWER_NS)
        state, period_s = link.memory.state[axis], link.memory.constants[axis].law.period_s
        if link.scenario.ideal_velocity and state.velocity.primed != 0:
            _perfect_measurement(state, samples[axis], world.plant[axis], period_s)
    return 0


@inlined
def _send(link: _Link, samples: np.ndarray, commands: np.ndarray) -> int:
    codec = link.codec
    for axis in range(len(samples)):
        codec.end(codec.link, axis, samples, commands)
        if codec.frame_bytes[OFFSET_SLOT, 0] != 0 or codec.frame_bytes[OFFSET_SLOT, 1] != 0:
            _to_drive(link, axis, OFFSET_SLOT, samples[axis])
        _to_drive(link, axis, RPDO_SLOT, samples[axis])
    return 0


@inlined
def _clock_ns(timespec: np.ndarray) -> int:
    return int(timespec[_NOW_NS])


@inlined
def _never_slept_ns(words: np.ndarray, timespec: np.ndarray) -> int:
    """A simulated computer is not suspended."""
    return 0


# --- The run ---


@kernel
def _put_set_points(
    stream: StreamConstants, world: World, points: np.ndarray, start_ns: int, put: int, now_ns: int
) -> int:
    """What the program does by `now_ns`, with its faults; how many of its set-points it has come to by then."""
    faults, memory = world.faults[0], world.fault_memory[0]
    silent = kind_active(faults, memory, FaultKind.PROGRAM_SILENT, now_ns)
    while put < len(points) and start_ns + round(points[put, POINT_TIME_s] * 1e9) <= now_ns:
        if not silent:
            slot = stream.written[0] % SET_POINTS
            stream.time_ns[slot] = now_ns
            for column in range(4):
                stream.values[slot, column] = points[put, POINT_VALUES + column]
            for i in range(len(faults)):
                if faults[i].kind == FaultKind.PROGRAM_WILD and is_active(faults[i], memory, now_ns):
                    stream.values[slot, 0] += faults[i].magnitude
            store_release(stream.alive_ns, 0, now_ns)
            store_release(stream.written, 0, stream.written[0] + 1)
        put += 1
    return put


@inlined
def _step_world(world: World, now_ns: int) -> None:
    """Drives and joints up to now; what has come out of the wire by now is handed over."""
    faulty = world.faults.size > 0
    if faulty:
        for axis in range(len(world.device)):
            device, joint_c, joint = world.device[axis], world.plant_constants[axis], world.plant[axis]
            step_faults(world.faults[axis], world.fault_memory[axis], device, joint_c, joint, now_ns)
    if len(world.device) > 1 or len(world.arm.links) > 0:
        advance_together(world.device, world.plant_constants, world.plant, now_ns, world.queue, world.arm)
    else:
        advance(world.device[0], world.plant_constants[0], world.plant[0], now_ns, world.queue[0])
    if faulty:
        for axis in range(len(world.device)):
            device, joint_c, joint = world.device[axis], world.plant_constants[axis], world.plant[axis]
            faults, memory, outgoing = world.faults[axis], world.fault_memory[axis], world.queue[axis]
            collect(faults, memory, device, outgoing, now_ns)
            take_due(memory, False, now_ns, False, memory.to_controller)
            take_due(memory, True, now_ns, False, memory.ready)
            hand_over(faults, memory, device, joint_c, joint, outgoing, now_ns)


@kernel
def _buses_off(world: World, now_ns: int) -> int:
    """One bit for each bus whose adapter is off it: that of its first axis."""
    off = 0
    for axis in range(len(world.faults)):
        if kind_active(world.faults[axis], world.fault_memory[axis], FaultKind.BUS_OFF, now_ns):
            off |= 1 << world.bus[axis]
    return off


@inlined
def _clear(world: World) -> None:
    for axis in range(len(world.queue)):
        world.queue[axis].count = 0


@kernel
def part_of_a_run(
    memory: CycleMemory, codec: Codec, world: World, scenario: Scenario, part: np.ndarray, truth: np.ndarray
) -> tuple[int, int]:
    """`run_lockstep`, or one of the many short parts that a run is made of (`kernel.bound`).

    `part` int64[2]: when it begins and its cycles, instead of the scenario's, to be set before.  One kernel for both:
    compiling it takes longer than most simulations.
    """
    words, clock_memory, period_ns = memory.words, memory.timespec, scenario.period_ns
    start_ns, cycles = part[0], part[1]
    faults, fault_memory = world.faults, world.fault_memory
    faulty = faults.size > 0
    link = _Link(codec, world, scenario, memory)
    exchange = Exchange(_receive, _send, link)
    clock = Clock(_clock_ns, _never_slept_ns)
    for axis in range(len(fault_memory)):
        if fault_memory[axis].epoch_ns < 0:
            fault_memory[axis].epoch_ns = start_ns
    if scenario.supervisor_beats:
        store_release(words, Word.SUPERVISOR_NS, start_ns - period_ns)
    _clear(world)
    first, rows, missed, elapsed, put = load_acquire(words, Word.HEAD), 0, 0, 1, 0
    finished_at = cycles
    for cycle in range(cycles + scenario.tail_cycles):
        if cycle >= finished_at + scenario.tail_cycles:
            break
        now_ns = start_ns + cycle * period_ns
        _step_world(world, now_ns)
        logged = scenario.log_every > 0 and cycle % scenario.log_every == 0
        if logged and rows < len(truth):
            for axis in range(len(world.device)):
                columns = truth[rows, TRUTHS * axis : TRUTHS * (axis + 1)]
                _write_truth(columns, world.device[axis], world.plant[axis])
            rows += 1
        if cycle >= finished_at:
            _clear(world)
            continue
        if cycle == scenario.stop_cycle:
            store_release(words, Word.STOP, scenario.stop_request)
        if scenario.supervisor_beats and not any_active(faults, fault_memory, FaultKind.SUPERVISOR_SILENT, now_ns):
            store_release(words, Word.SUPERVISOR_NS, now_ns)
            if faulty:
                request = stop_requested(faults, fault_memory, now_ns)
                store_release(words, Word.STOP, max(load_acquire(words, Word.STOP), request))
        clock_memory[_NOW_NS] = now_ns
        if len(scenario.set_points) > 0:
            put = _put_set_points(memory.constants[0].stream, world, scenario.set_points, start_ns, put, now_ns)
        if scenario.thermometer and now_ns % _READ_EVERY_NS < period_ns:
            for axis in range(len(world.device)):
                reading = memory.constants[axis].law.temperature
                reading.degC[0] = world.plant[axis].motor_temperature_degC
                reading.time_ns[0] = now_ns
        if faulty:
            if any_active(faults, fault_memory, FaultKind.LOOP_KILLED, now_ns):
                finished_at = cycle
                continue
            missed += clock_step_cycles(faults, fault_memory, now_ns, period_ns)
            if any_active(faults, fault_memory, FaultKind.LOOP_HELD_UP, now_ns):
                missed += 1
                continue
            elapsed = 1 + missed
            missed = 0
            clock_memory[_OFF_BUS] = _buses_off(world, now_ns)
        head = load_acquire(words, Word.HEAD)
        slot = Slot(period_ns, now_ns, now_ns, 0, elapsed, now_ns)
        if step_cycle(memory, exchange, clock, slot):
            finished_at = cycle + 1
        if not logged:
            store_release(words, Word.HEAD, head)  # the next record takes its place
    return load_acquire(words, Word.HEAD) - first, rows


def run_lockstep(
    memory: CycleMemory, codec: Codec, world: World, scenario: Scenario, truth: np.ndarray | None = None
) -> tuple[int, int]:
    """Run until all axes are FINISHED, `scenario.cycles` at most, then `tail_cycles` without a controller.

    `memory` is at power off; its ring holds as many records as it has room for, the newest ones, one an axis and cycle.
    `truth` float64[N, TRUTHS * axes], or None, takes what the joints truly did in the same periods (columns TRUE_* of
    each), and in those in which the controller was held up or silent, while there is room.  Returns the numbers of log
    records and of rows of `truth` written.
    """
    truth = np.zeros((0, TRUTHS)) if truth is None else truth
    part = np.array((scenario.start_ns, scenario.cycles), np.int64)
    written, rows = part_of_a_run(memory, codec, world, scenario, part, truth)
    return int(written), int(rows)
