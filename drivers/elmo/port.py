"""The memory of the cyclic exchange with one serial drive."""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated

import numpy as np

from jointctl.firmware_py.schema import array_of, f8, i4, i8, record, u1

TEXT_MAX = 16  # longest cyclic command: JV=-12345678901 and CR
EXPECTED_MAX = 8  # commands that wait for their reply
LINE_MAX = 64  # longest cyclic reply, echo included
OUT_MAX = 64  # bytes of one write
READ_MAX = 256
SCRATCH_WORDS = 8
SERIAL = "serial"  # stands for such a line where a CAN bus has the name of its python-can interface


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
    unit_mode: i4  # of the last status; 0 = none yet
    has_been_on: i4  # 1: MO=1 has done its work; it is never said again
    enable_wait_cycles: i8
    no_sample_cycles: i8
    no_status_cycles: i8
    silent_cycles: i8  # cycles since a reply came although one was due
    quiet: i4  # cycles in which it says nothing until the line is silent: old replies are not taken for new ones
    heard_bytes: i8  # in this cycle
    window_ns: i8  # when the window of this cycle ends: by it cycles are told apart
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
    last_error: i4  # error byte of the last refusal
    resyncs: i8
    send_failures: i8
    consecutive_failures: i4
    last_errno: i4
    bits_sent: i8  # from the drive to the PC, the busier direction
