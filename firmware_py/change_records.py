"""Records of what may change while the joint moves: gains and the motion; see `live_change`.

Import them from `firmware_py.records`, which has every record.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated

import numpy as np

from jointctl.firmware_py.motion_records import Reference, TrajectoryConstants
from jointctl.firmware_py.schema import array_of, f8, i4, i8, record


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
    answered: i8  # number of the newest request that was answered
    answer: i4  # ChangeAnswer
    ramping: i4  # 1 while gains change
    ramp_s: f8  # since the change of gains began
    motion: i4  # MotionChange
    start: Gains
    target: Gains
    now: Gains  # between the two
    goal: Reference  # of the new motion at its start, at rest
    move_s: f8
    next_trajectory: TrajectoryConstants
