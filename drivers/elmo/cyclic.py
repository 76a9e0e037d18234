"""The cyclic exchange as pure functions on memory: which bytes to send, what the received bytes mean.

    begin_cycle  ->  PX                                  position, at the start of the cycle
    take_byte    <-  replies, one byte at a time
    end_cycle    ->  TC=.. or JV=.., BG (or MO=1; TC=0 or JV=0, BG; ST, MO=0), then SR, IQ or MF in turn

The command follows the position as fast as the line allows; status and current use the rest of the cycle.

A reply is only taken if its echo is the whole command (echo on), else by its order (echo off).  After three cycles
without a reply that is due, the driver says nothing until the line is silent for a cycle, and starts again; the zero
target of the dead-man and a stop are said all the same.

A quick stop is no braking here: in torque mode (UM=1) the drive knows no other torque than the commanded one, and UM
cannot change with the motor on.  So TC=0, ST and MO=0 follow each other, and friction (or a brake) stops the joint.
In speed mode (UM=2) it is the same with JV=0, BG: a drive that hears only the first half brakes along DC and stands.
"""

from __future__ import annotations

import math

import numpy as np

from jointctl.drivers.elmo.characters import CR, EQUALS, MINUS, POINT, ZERO
from jointctl.drivers.elmo.codes import SERVO_ON, UnitMode
from jointctl.drivers.elmo.port import EXPECTED_MAX, OUT_MAX, TEXT_MAX, ElmoPort, Question
from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.records import LINE_GONE, Command, Sample
from jointctl.firmware_py.states import DriveRequest, DriveState

SILENT_CYCLES = 3
STATUS_SPARE_CYCLES = 8  # SR is asked every other cycle, and a lost reply must not stop the joint
_LETTERS = np.array([[ord(c) for c in q.name] for q in Question], np.uint8)


# --- commands ---


@kernel
def _put(port: ElmoPort, slot: int, byte: int) -> None:
    """Append one character to the next write and to the text that its echo must have."""
    if port.out_length < OUT_MAX and port.expected_length[slot] < TEXT_MAX:
        port.out[port.out_length] = byte
        port.out_length += 1
        port.expected[slot, port.expected_length[slot]] = byte
        port.expected_length[slot] += 1


@kernel
def put_command(port: ElmoPort, question: int, value_milli: int, decimals: int) -> bool:
    """Append a command to the next write; False where too many wait for a reply.

    `decimals` < 0: no value; 0: value_milli / 1000 as a whole number; 3: with three digits after the point.
    """
    if port.expected_count >= EXPECTED_MAX or port.out_length + TEXT_MAX > OUT_MAX:
        return False
    slot = (port.expected_first + port.expected_count) % EXPECTED_MAX
    port.expected_length[slot] = 0
    port.expected_question[slot] = question
    port.expected_window_ns[slot] = port.window_ns
    port.expected_asked_ns[slot] = port.asked_ns
    port.expected_count += 1
    _put(port, slot, _LETTERS[question, 0])
    _put(port, slot, _LETTERS[question, 1])
    if decimals >= 0:
        _put(port, slot, EQUALS)
        if value_milli < 0:
            _put(port, slot, MINUS)
        size = abs(value_milli)
        whole = size // 1000
        divisor = 1
        while whole // divisor >= 10:
            divisor *= 10
        while divisor > 0:
            _put(port, slot, ZERO + whole // divisor % 10)
            divisor //= 10
        if decimals > 0:
            _put(port, slot, POINT)
            _put(port, slot, ZERO + size // 100 % 10)
            _put(port, slot, ZERO + size // 10 % 10)
            _put(port, slot, ZERO + size % 10)
    _put(port, slot, CR)
    return True


@kernel
def current_mA(port: ElmoPort, torque_Nm: float) -> int:
    """Joint torque [Nm] as the value of TC [mA], saturated before the cast; 0 if not finite."""
    value = 1000.0 * torque_Nm / port.torque_NmpA
    if not math.isfinite(value):
        return 0
    limit = float(port.max_current_mA)
    return round(min(max(value, -limit), limit))


@kernel
def velocity_cps(port: ElmoPort, velocity_radps: float) -> int:
    """Joint velocity [rad/s] as the value of JV [counts/s], saturated before the cast; 0 if not finite."""
    value = velocity_radps / port.position_radpcount
    if not math.isfinite(value):
        return 0
    limit = float(port.max_velocity_cps)
    return round(min(max(value, -limit), limit))


@kernel
def _put_target(port: ElmoPort, command: Command, live: bool) -> None:
    """Torque or velocity of this cycle, zero unless `live`.  No BG in another unit mode: it begins another motion."""
    if port.target_is_velocity != 0:
        put_command(port, Question.JV, 1000 * velocity_cps(port, command.velocity_radps) if live else 0, 0)
        if port.unit_mode == UnitMode.SPEED:
            put_command(port, Question.BG, 0, -1)
    else:
        put_command(port, Question.TC, current_mA(port, command.torque_Nm) if live else 0, 3)


@kernel
def _forget_expected(port: ElmoPort) -> None:
    port.expected_count = 0
    port.line_length = 0
    port.line_overflow = 0


@kernel
def _become_quiet(port: ElmoPort) -> None:
    port.silent_cycles = 0
    port.resyncs += 1
    port.lost += port.expected_count
    port.quiet = 1
    _forget_expected(port)


@kernel
def begin_cycle(port: ElmoPort, sample: Sample) -> None:
    """The question for the position; says nothing while the line must become silent."""
    port.cycle += 1
    port.out_length = 0
    port.no_sample_cycles += 1
    port.no_status_cycles += 1
    # positions alone do not tell whether the motor is on: an old status is none (a silent line is told by the sample)
    old_cycles = 2 * port.dead_man_cycles + STATUS_SPARE_CYCLES
    if port.no_status_cycles > old_cycles and port.no_sample_cycles <= port.dead_man_cycles:
        sample.drive_state = DriveState.UNKNOWN
    if port.quiet != 0:
        _forget_expected(port)
        port.quiet = 0 if port.heard_bytes == 0 else port.quiet + 1
    elif port.expected_count > 0:
        port.silent_cycles += 1
        if port.silent_cycles > SILENT_CYCLES:
            _become_quiet(port)
    else:
        port.silent_cycles = 0
    port.heard_bytes = 0
    if port.quiet == 0:
        put_command(port, Question.PX, 0, -1)
    sample.bus_errors = LINE_GONE if port.gone != 0 else port.consecutive_failures


@kernel
def _put_stop(port: ElmoPort, command: Command) -> None:
    """Target zero, stop, motor off: said whatever else waits for a reply, and in every cycle until it is off."""
    if port.expected_count > EXPECTED_MAX - 4 or port.quiet != 0:
        _forget_expected(port)
        port.quiet = 0
    if port.status & SERVO_ON != 0:
        _put_target(port, command, False)
        put_command(port, Question.ST, 0, -1)
    put_command(port, Question.MO, 0, 0)


@kernel
def _put_dead_man(port: ElmoPort, command: Command) -> None:
    """Target zero where the line is in disorder or full of commands without a reply; its own reply is not waited for.

    In every other cycle of a disorder that lasts: the replies must not keep the line from becoming silent.
    """
    if port.status & SERVO_ON == 0:
        return
    if port.quiet == 0 and port.expected_count > EXPECTED_MAX - 2:
        _become_quiet(port)
    if port.quiet % 2 != 0:
        _put_target(port, command, False)
        _forget_expected(port)


@kernel
def end_cycle(port: ElmoPort, sample: Sample, command: Command) -> None:
    """What the drive is told in this cycle, and one of the slower questions."""
    port.out_length = 0
    if command.request == DriveRequest.ENABLE:
        if port.no_sample_cycles > port.dead_man_cycles:
            _put_dead_man(port, command)
        if port.quiet != 0:
            return
        if port.status & SERVO_ON != 0:
            heard = port.no_sample_cycles <= port.dead_man_cycles
            _put_target(port, command, heard and sample.drive_state == DriveState.ENABLED)
        elif port.has_been_on != 0 or port.fault_seen > 0:
            pass  # the drive switched itself off: never on again without the user
        elif port.unit_mode == 0 or sample.restarts != 0:
            pass  # its unit mode is not known, or not the one that it was commissioned for
        elif port.enable_wait_cycles == 0:
            port.enable_wait_cycles = port.enable_retry_cycles
            put_command(port, Question.MO, 1000, 0)
        else:
            port.enable_wait_cycles -= 1
    elif (
        command.request == DriveRequest.QUICK_STOP
        or sample.drive_state != DriveState.OFF
        or port.enable_wait_cycles > 0  # MO=1 was said: a status that says "off" may be older than that
    ):
        _put_stop(port, command)
    if port.quiet != 0:
        return  # the answer to a question would keep the line from becoming silent
    if port.fault_seen > 0 and port.motor_fault == 0:
        put_command(port, Question.MF, 0, -1)
    if port.cycle % 2 == 0 or port.fault_seen > 0:
        put_command(port, Question.SR, 0, -1)
    else:
        put_command(port, Question.IQ, 0, -1)


@kernel
def note_written(port: ElmoPort, sample: Sample, error: int) -> None:
    """Count failed writes in a row."""
    if error == 0:
        port.consecutive_failures = 0
    else:
        port.consecutive_failures += 1
        port.send_failures += 1
        port.last_errno = error
    sample.bus_errors = LINE_GONE if port.gone != 0 else port.consecutive_failures
