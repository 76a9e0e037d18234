"""The cyclic exchange as pure functions on memory: which bytes to send, what the received bytes mean.

    begin_cycle  ->  PX                                  position, at the start of the cycle
    take_byte    <-  replies, one byte at a time
    end_cycle    ->  TC=.. or JV=.., BG (or MO=1; TC=0 or JV=0, BG; ST, MO=0), then SR, IQ or MF in turn

The command follows the position as fast as the line allows; status and current use the rest of the cycle.

A reply is only taken if its echo is the whole command (echo on), else by its order (echo off).  After three cycles
without a reply that is due, the driver sends nothing until the line is silent for a cycle, and starts again; the zero
target of the dead-man and a stop are sent all the same.

A quick stop is no braking here: in torque mode (UM=1) the drive knows no other torque than the commanded one, and UM
cannot change with the motor on.  So TC=0, ST and MO=0 follow each other, and friction (or a brake) stops the joint.
In speed mode (UM=2) it is the same with JV=0, BG: a drive that receives only the first half brakes along DC and
stands.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated

import numpy as np

from jointctl.drivers.drive import WRAP, saturated, take_counts
from jointctl.drivers.elmo.dialogue import (
    AMPLIFIER_MASK,
    CR,
    EQUALS,
    FAULT_LATCHED,
    MINUS,
    NINE,
    PLUS,
    POINT,
    QUESTION_MARK,
    SEMICOLON,
    SERVO_ON,
    UNIT_MODE_MASK,
    UNIT_MODE_SHIFT,
    ZERO,
    UnitMode,
)
from jointctl.drivers.elmo.settings import BITS_PER_CHARACTER
from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.records import LINE_GONE, Command, Sample
from jointctl.firmware_py.schema import array_of, f8, i4, i8, record, u1
from jointctl.firmware_py.states import DriveRequest, DriveState

TEXT_MAX = 16  # longest cyclic command: JV=-12345678901 and CR
EXPECTED_MAX = 8  # commands that wait for their reply
LINE_MAX = 64  # longest cyclic reply, echo included
OUT_MAX = 64  # bytes of one write
READ_MAX = 256
SCRATCH_WORDS = 8
SILENT_CYCLES = 3
STATUS_SPARE_CYCLES = 8  # SR is asked every other cycle, and a lost reply must not stop the joint
NOTHING = -1
FAULT_CAUSE_CYCLES = 4  # status replies to wait for MF before a fault is reported without its cause
USUAL_STEP_NS = 20_000  # in a cycle
UNEVEN_SHARE = 16  # a position may come a 16th of a period later than usual
LEFT_OUT_MAX = 3  # in a row
_DIGITS_MAX = 17


class Question(IntEnum):
    """The commands of the cyclic exchange; index into the table of their letters."""

    PX = 0
    TC = 1
    SR = 2
    IQ = 3
    MF = 4
    MO = 5
    ST = 6
    JV = 7
    BG = 8


@record
class ElmoPort:
    """Scaling and limits (set by commissioning), and what has been said on the line."""

    fd: i4
    echo: i4  # 1: every reply carries its command, which proves what it belongs to
    # scaling, directions included: all at the joint
    position_radpcount: f8
    zero_counts: i8
    torque_NmpA: f8
    max_current_mA: i8
    target_is_velocity: i4  # JV and BG (UM=2) instead of TC (UM=1)
    max_velocity_cps: i8  # of JV
    enable_retry_cycles: i8
    dead_man_cycles: i8  # without a sample for so long the torque command is zero
    period_ns: i8  # of the loop; 0: the age of a reply is not looked at
    # commands that wait for their reply, oldest first in a ring
    expected: Annotated[np.ndarray, array_of(u1, EXPECTED_MAX, TEXT_MAX)]
    expected_length: Annotated[np.ndarray, array_of(i4, EXPECTED_MAX)]
    expected_question: Annotated[np.ndarray, array_of(i4, EXPECTED_MAX)]
    expected_window_ns: Annotated[np.ndarray, array_of(i8, EXPECTED_MAX)]  # of the cycle that asked; see window_ns
    expected_asked_ns: Annotated[np.ndarray, array_of(i8, EXPECTED_MAX)]  # when that cycle began
    expected_first: i4
    expected_count: i4
    # the line being received, and the bytes of the next write
    line: Annotated[np.ndarray, array_of(u1, LINE_MAX)]
    line_length: i4
    line_overflow: i4
    out: Annotated[np.ndarray, array_of(u1, OUT_MAX)]
    out_length: i4
    # state
    primed: i4
    last_counts: i8
    counts: i8
    cycle: i8
    status: i8  # SR
    motor_fault: i8  # MF
    fault_seen: i4  # status replies that showed a fault
    unit_mode: i4  # of the last status that is believed; 0 = none yet
    odd_modes: i4  # status replies in a row with another unit mode than that of the run
    has_been_on: i4  # 1: MO=1 has done its work; it is never said again
    denied: i4  # 1: MO=1 was refused; it is not said again, a motion must not begin because STO is closed
    enable_wait_cycles: i8
    no_sample_cycles: i8
    no_status_cycles: i8
    silent_cycles: i8  # cycles since a reply came although one was due
    quiet: i4  # cycles in which it says nothing until the line is silent: old replies are not taken for new ones
    heard_bytes: i8  # in this cycle
    window_ns: i8  # when the window of this cycle ends: by it cycles are distinguished
    asked_ns: i8  # when this cycle began
    usual_answer_ns: i8  # from there to the position, its median followed slowly; 0 = none yet
    left_out: i4  # how many positions in a row came unusually late and were left out
    window_over: i4  # 1: it was over before the cycle began
    answered_window_ns: i8  # of the cycle that asked for the last position
    gone: i4  # the port has vanished
    # counters
    garbled: i8
    lost: i8
    unexpected: i8
    refused: i8
    resyncs: i8
    send_failures: i8
    consecutive_failures: i4
    last_errno: i4
    bits_sent: i8  # from the drive to the PC, the busier direction


# --- replies: whole lines, matched with the commands that wait for one ---


@kernel
def _echo_matches(port: ElmoPort, slot: int) -> bool:
    length = port.expected_length[slot]
    if port.line_length < length:
        return False
    differences = 0
    for i in range(length):
        differences += port.line[i] != port.expected[slot, i]
    return differences == 0


@kernel
def _match(port: ElmoPort) -> int:
    """Which of the waiting commands the received line answers, as its place in the queue; NOTHING if none."""
    if port.echo == 0:
        for i in range(port.line_length):
            # a CR may only be an error byte (code 13); elsewhere it is an echo that must not be there
            if port.line[i] == CR and port.line_length != 2:
                return NOTHING
        return 0 if port.expected_count > 0 else NOTHING
    for place in range(port.expected_count):
        if _echo_matches(port, (port.expected_first + place) % EXPECTED_MAX):
            return place
    return NOTHING


@kernel
def parse_number(line: np.ndarray, start: int, end: int) -> tuple[bool, float, bool]:
    """(is a number, its value, has no point) of the characters from `start` to `end`; plain decimal notation only."""
    at = start
    negative = False
    if at < end and (line[at] == MINUS or line[at] == PLUS):
        negative = line[at] == MINUS
        at += 1
    digits, scale, value, whole = 0, 1.0, 0.0, True
    while at < end:
        byte = line[at]
        if byte == POINT and whole:
            whole = False
        elif byte >= ZERO and byte <= NINE and digits < _DIGITS_MAX:
            digits += 1
            value = value * 10.0 + (byte - ZERO)
            if not whole:
                scale *= 10.0
        else:
            return False, 0.0, False
        at += 1
    value /= scale
    return digits > 0, -value if negative else value, whole


@kernel
def _take_status(port: ElmoPort, sample: Sample, status: int) -> None:
    """SR: servo, fault, and the unit mode, which is another one after a restart of the drive.

    The first status counts as well: commissioning has read the unit mode back.  The line has no checksum: a reply with
    another mode may be a damaged one, and nothing of it is believed until that of the next cycle says the same.
    """
    mode = status >> UNIT_MODE_SHIFT & UNIT_MODE_MASK
    run_mode = UnitMode.SPEED if port.target_is_velocity != 0 else UnitMode.TORQUE
    port.odd_modes = port.odd_modes + 1 if mode != run_mode else 0
    if port.odd_modes == 1:
        return
    if port.odd_modes == 2:
        sample.restarts += 1
    port.unit_mode = mode
    port.status = status
    port.no_status_cycles = 0
    sample.status_word = status & 0x7FFFFFFF
    if status & (FAULT_LATCHED | AMPLIFIER_MASK) != 0:
        # the cause (MF) is asked for before the fault is reported; the power stage is off already
        port.fault_seen += 1
        if port.motor_fault != 0 or port.fault_seen > FAULT_CAUSE_CYCLES:
            sample.drive_state = DriveState.FAULT
            sample.drive_error = port.motor_fault & 0x7FFFFFFF
        return
    port.fault_seen = 0
    port.motor_fault = 0
    if status & SERVO_ON != 0:
        port.has_been_on = 1
    sample.drive_state = DriveState.ENABLED if status & SERVO_ON != 0 else DriveState.OFF


@kernel
def _too_late(port: ElmoPort, asked_window_ns: int) -> bool:
    """Whether a position is of a slot too long ago to pass for one of this slot: it would be a leap.

    A drive may answer in the next cycle, each time; more than that was a pause, of the PC or of its serial port.
    """
    late_ns = port.window_ns - asked_window_ns
    return port.period_ns > 0 and late_ns > 0 and (port.window_over != 0 or 2 * late_ns > 3 * port.period_ns)


@kernel
def _uneven(port: ElmoPort, answer_ns: int) -> bool:
    """Whether a position came so much later than usual that the time at which it was read is not known.

    The drive reads it when its interpreter comes to the question.  1 ms late of 8 ms would be a leap of an eighth of
    the speed.  A few in a row are left out, as a computer held up for three cycles makes them; more are the way of this
    line, and its usual time follows.
    """
    if port.period_ns == 0:
        return False
    if port.usual_answer_ns == 0:
        port.usual_answer_ns = answer_ns
    late_ns = answer_ns - port.usual_answer_ns
    port.usual_answer_ns += min(max(late_ns, -USUAL_STEP_NS), USUAL_STEP_NS)
    late = late_ns * UNEVEN_SHARE > port.period_ns
    port.left_out = port.left_out + 1 if late and port.left_out < LEFT_OUT_MAX else 0
    return port.left_out != 0


@kernel
def _take_value(port: ElmoPort, sample: Sample, question: int, start: int, now_ns: int, slot: int) -> bool:
    """Take the value of one reply; True if it was a position."""
    if question >= Question.MO or question == Question.TC:
        return False
    good, value, whole = parse_number(port.line, start, port.line_length)
    if not good or (not whole and question != Question.IQ):
        port.garbled += 1
        return False
    if question == Question.PX:
        if abs(value) >= WRAP:
            port.garbled += 1
            return False
        take_counts(port, int(value))
        asked_window_ns = port.expected_window_ns[slot]
        if _too_late(port, asked_window_ns):
            port.lost += 1
            return False
        port.answered_window_ns = asked_window_ns
        if _uneven(port, now_ns - port.expected_asked_ns[slot]):
            port.lost += 1
            return False
        sample.position_rad = (port.counts - port.zero_counts) * port.position_radpcount
        sample.time_ns = now_ns
        sample.count += 1
        port.no_sample_cycles = 0
        return True
    if question == Question.IQ:
        sample.torque_Nm = value * port.torque_NmpA
    elif abs(value) < WRAP:
        if question == Question.SR:
            _take_status(port, sample, int(value))
        else:
            port.motor_fault = int(value)
    return False


@kernel
def _take_line(port: ElmoPort, sample: Sample, now_ns: int) -> bool:
    """The line up to `;` is complete."""
    if port.line_overflow != 0:
        port.garbled += 1
        return False
    place = _match(port)
    if place == NOTHING:
        if port.expected_count > 0:
            port.garbled += 1
        else:
            port.unexpected += 1
        return False
    slot = (port.expected_first + place) % EXPECTED_MAX
    question = port.expected_question[slot]
    start = port.expected_length[slot] if port.echo != 0 else 0
    port.lost += place
    port.expected_first = (port.expected_first + place + 1) % EXPECTED_MAX
    port.expected_count -= place + 1
    port.silent_cycles = 0
    length = port.line_length - start
    if length >= 1 and length <= 2 and port.line[port.line_length - 1] == QUESTION_MARK:
        port.refused += 1
        port.denied |= int(question == Question.MO)
        return False
    return _take_value(port, sample, question, start, now_ns, slot)


@kernel
def take_byte(port: ElmoPort, byte: int, sample: Sample, now_ns: int) -> bool:
    """Take one received character; True if it completed a new position."""
    port.heard_bytes += 1
    port.bits_sent += BITS_PER_CHARACTER
    if byte == SEMICOLON:
        got = False
        if port.quiet == 0:
            got = _take_line(port, sample, now_ns)
        port.line_length = 0
        port.line_overflow = 0
        return got
    if port.line_length < LINE_MAX:
        port.line[port.line_length] = byte
        port.line_length += 1
    else:
        port.line_overflow = 1
    return False


# --- commands, and what a cycle sends ---

_LETTERS = np.array([[ord(c) for c in q.name] for q in Question], np.uint8)


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
    """Joint torque [Nm] as the value of TC [mA]."""
    return saturated(1000.0 * torque_Nm / port.torque_NmpA, float(port.max_current_mA))


@kernel
def velocity_cps(port: ElmoPort, velocity_radps: float) -> int:
    """Joint velocity [rad/s] as the value of JV [counts/s]."""
    return saturated(velocity_radps / port.position_radpcount, float(port.max_velocity_cps))


@kernel
def _put_target(port: ElmoPort, command: Command, live: bool) -> None:
    """Torque or velocity of this cycle, zero unless `live`.  No BG in another unit mode: it begins another motion."""
    if port.target_is_velocity != 0:
        put_command(port, Question.JV, 1000 * velocity_cps(port, command.velocity_radps) if live else 0, 0)
        if port.unit_mode == UnitMode.SPEED and port.odd_modes == 0:
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
    # positions alone do not show whether the motor is on: an old status is none (a silent line shows in the sample)
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
    """What is sent to the drive in this cycle, and one of the slower questions."""
    port.out_length = 0
    if command.request == DriveRequest.ENABLE:
        if port.no_sample_cycles > port.dead_man_cycles:
            _put_dead_man(port, command)
        if port.quiet != 0:
            return
        if port.status & SERVO_ON != 0:
            heard = port.no_sample_cycles <= port.dead_man_cycles
            _put_target(port, command, heard and sample.drive_state == DriveState.ENABLED)
        elif port.has_been_on != 0 or port.denied != 0 or port.fault_seen > 0:
            pass  # the drive switched itself off, or refused: never on again without the user
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
    if port.cycle % 2 == 0 or port.fault_seen > 0 or port.odd_modes == 1:
        put_command(port, Question.SR, 0, -1)
    else:
        put_command(port, Question.IQ, 0, -1)


@kernel
def note_written(port: ElmoPort, sample: Sample, error: int) -> None:
    if error == 0:
        port.consecutive_failures = 0
    else:
        port.consecutive_failures += 1
        port.send_failures += 1
        port.last_errno = error
    sample.bus_errors = LINE_GONE if port.gone != 0 else port.consecutive_failures
