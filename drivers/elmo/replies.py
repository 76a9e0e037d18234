"""What the received bytes mean: one byte at a time, whole lines matched with the commands that wait for a reply.

A reply is only taken if its echo is the whole command (echo on), else by its order (echo off).
"""

from __future__ import annotations

import numpy as np

from jointctl.drivers.elmo.characters import CR, MINUS, NINE, PLUS, POINT, QUESTION_MARK, SEMICOLON, ZERO
from jointctl.drivers.elmo.codes import (
    AMPLIFIER_MASK,
    FAULT_LATCHED,
    SERVO_ON,
    UNIT_MODE_MASK,
    UNIT_MODE_SHIFT,
    UnitMode,
)
from jointctl.drivers.elmo.line_budget import BITS_PER_CHARACTER
from jointctl.drivers.elmo.port import EXPECTED_MAX, LINE_MAX, ElmoPort, Question
from jointctl.drivers.position_counts import WRAP, take_counts
from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.records import Sample
from jointctl.firmware_py.states import DriveState

NOTHING = -1
FAULT_CAUSE_CYCLES = 4  # status replies to wait for MF before a fault is told without its cause
USUAL_STEP_NS = 20_000  # in a cycle
UNEVEN_SHARE = 16  # a position may come a 16th of a period later than usual
LEFT_OUT_MAX = 3  # in a row
_DIGITS_MAX = 17


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

    The first status counts as well: commissioning has read the unit mode back.
    """
    port.status = status
    port.no_status_cycles = 0
    sample.status_word = status & 0x7FFFFFFF
    mode = status >> UNIT_MODE_SHIFT & UNIT_MODE_MASK
    run_mode = UnitMode.SPEED if port.target_is_velocity != 0 else UnitMode.TORQUE
    if mode != run_mode and (port.unit_mode == run_mode or port.unit_mode == 0):
        sample.restarts += 1
    port.unit_mode = mode
    if status & (FAULT_LATCHED | AMPLIFIER_MASK) != 0:
        # the cause (MF) is asked for before the fault is told; the power stage is off already
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
        port.last_error = port.line[start] if length == 2 else 0
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
