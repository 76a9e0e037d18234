"""Records of the desired motion, and of what may change of it and of the gains while the joint moves."""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated

import numpy as np

from jointctl.firmware_py.schema import array_of, f8, i4, i8, record


@record
class Reference:
    position_rad: f8
    velocity_radps: f8
    acceleration_radps2: f8
    jerk_radps3: f8  # 0 where the motion has jumps of acceleration, or where it is not known
    snap_radps4: f8  # fourth derivative; 0 where the motion has jumps in it, or where it is not known


@record
class TrajectoryConstants:
    """One trajectory; which fields matter depends on `kind`."""

    kind: i4  # TrajectoryKind
    repeats: i4  # point-to-point kinds and tables: start again at the end
    table_rows: i4
    duration_s: f8  # of the run; 0 = until stopped
    # SINE: offset + amplitude sin(omega (t + shift)), with a second set from switch_s on (0 = no switch)
    amplitude_rad: f8
    omega_radps: f8
    shift_s: f8
    offset_rad: f8
    switch_s: f8
    amplitude2_rad: f8
    omega2_radps: f8
    shift2_s: f8
    offset2_rad: f8
    # MIN_JERK, TRAPEZOID: from start to target and, when repeated, back, resting dwell_s at each end
    start_rad: f8
    target_rad: f8
    move_s: f8  # MIN_JERK: duration of one move
    speed_radps: f8  # TRAPEZOID
    acceleration_radps2: f8  # TRAPEZOID
    rounding_s: f8  # TRAPEZOID: over which its acceleration changes
    dwell_s: f8


# --- What may change while the joint moves: gains and the motion; see `live_change` ---


class ChangeKind(IntEnum):
    """What a request asks for."""

    GAINS = 1
    MOTION = 2


class ChangeAnswer(IntEnum):
    """What the loop did with the newest request."""

    NONE = 0
    TAKEN = 1
    WRONG_KIND = 2
    WRONG_PHASE = 3  # not while the joint is under way, or it is being stopped
    GAIN_LIMIT = 4  # not finite, or outside of the limits of the configuration
    MOTION_LIMIT = 5  # position or speed outside of the limits, or not finite
    NOT_FROM_REST = 6  # the new motion does not begin at rest


class MotionChange(IntEnum):
    """Where a change of the motion is; the phase stays TRACKING."""

    NONE = 0
    BRAKING = 1  # the reference comes to rest
    MOVING = 2  # from there to the start of the new motion


@record
class Gains:
    """Those of `LawConstants` that may change; what the kind of law does not use has no room to change."""

    kp: f8  # [1/s^2]
    kv: f8  # [1/s]
    ki: f8  # [1/s^3], PID
    observer_radps: f8
    learning_rate: f8  # of the network


@record
class ChangeRequest:
    """Written by the supervisor before it counts `ChangeConstants.order` up, and never while a request is open."""

    first: i8  # the order's number; with `last` it shows that the whole request has arrived
    kind: i4  # ChangeKind
    gains: Gains
    trajectory: TrajectoryConstants
    move_s: f8  # the way to the motion's beginning takes so long at least: that of the other joints of an arm
    last: i8


@record
class ChangeConstants:
    """The limits of a change, and the letter box: the only part of the constants that changes after the start."""

    low: Gains
    high: Gains
    ramp_s: f8  # duration of a change of gains
    q1: f8  # Q = diag(q1, q2) of the Lyapunov equation
    q2: f8
    move_speed_radps: f8  # peak of a move to the start of a new motion
    move_acceleration_radps2: f8
    move_min_s: f8
    request: ChangeRequest
    order: Annotated[np.ndarray, array_of(i8, 1)]  # number of the newest request, 0 = none


@record
class ChangeState:
    order: i8  # number of the newest request that has come for all joints
    answered: i8  # number of the newest request that was answered
    answer: i4  # ChangeAnswer
    ramping: i4  # 1 while gains change
    ramp_s: f8  # since the change of gains began
    motion: i4  # MotionChange
    start: Gains
    target: Gains
    now: Gains  # between the two
    goal: Reference  # of the new motion at its start, at rest
    move_s: f8  # that the way there takes, at least until it begins
    next_trajectory: TrajectoryConstants


# --- Set-points that come while the joint moves: see `live_change` ---

SET_POINTS = 256  # on their way from a program to the loop


@record
class SetPoint:
    time_ns: i8  # CLOCK_MONOTONIC; the joint is to be there `StreamConstants.delay_ns` later
    position_rad: f8
    velocity_radps: f8
    acceleration_radps2: f8  # NaN: that between the velocities of two set-points
    torque_Nm: f8  # on top of the law's


@record
class StreamConstants:
    """Limits of set-points, and the ring that they come through: `written` is counted up behind each of them.

    The limits never change after the start; ring, `written` and `alive_ns` belong to the program outside.
    """

    delay_ns: i8
    timeout_ns: i8  # between two set-points
    client_timeout_ns: i8  # of the program's sign of life; 0 = none is expected
    acceleration_max_radps2: f8
    jump_max_rad: f8
    torque_max_Nm: f8
    torque_rate_max_Nmps: f8
    written: Annotated[np.ndarray, array_of(i8, 1)]  # set-points since the start
    alive_ns: Annotated[np.ndarray, array_of(i8, 1)]  # CLOCK_MONOTONIC of the newest sign of life
    time_ns: Annotated[np.ndarray, array_of(i8, SET_POINTS)]
    values: Annotated[np.ndarray, array_of(f8, SET_POINTS, 4)]  # position, velocity, acceleration, torque


@record
class StreamState:
    written: i8  # set-points that have come for all joints since the start
    taken: i8  # set-points taken out of the ring
    refused: i8  # of them those that the loop did not follow
    following: i4  # 1 between two set-points, 0 at rest or braking
    before: SetPoint
    after: SetPoint
    coming: SetPoint  # on its way from the ring
    torque_Nm: f8  # on top of the law's, in this cycle
