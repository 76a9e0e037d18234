"""Every record of the controller: constants (`*Constants`, set once), state (`*State`), and what passes between blocks.

SI units throughout.  `joint_` is the low-velocity side of the reducer, `motor_` the other one.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np

from jointctl.firmware_py.change_records import ChangeConstants as ChangeConstants
from jointctl.firmware_py.change_records import ChangeRequest as ChangeRequest
from jointctl.firmware_py.change_records import ChangeState as ChangeState
from jointctl.firmware_py.change_records import Gains as Gains
from jointctl.firmware_py.law_records import LEARNING_BINS as LEARNING_BINS
from jointctl.firmware_py.law_records import NEURONS as NEURONS
from jointctl.firmware_py.law_records import TORQUE_HISTORY as TORQUE_HISTORY
from jointctl.firmware_py.law_records import FrictionBranch as FrictionBranch
from jointctl.firmware_py.law_records import FrictionConstants as FrictionConstants
from jointctl.firmware_py.law_records import LawConstants as LawConstants
from jointctl.firmware_py.law_records import LawState as LawState
from jointctl.firmware_py.law_records import LearningConstants as LearningConstants
from jointctl.firmware_py.law_records import LearningState as LearningState
from jointctl.firmware_py.law_records import LuGreConstants as LuGreConstants
from jointctl.firmware_py.law_records import NetworkConstants as NetworkConstants
from jointctl.firmware_py.law_records import NetworkState as NetworkState
from jointctl.firmware_py.law_records import ObserverConstants as ObserverConstants
from jointctl.firmware_py.law_records import ObserverState as ObserverState
from jointctl.firmware_py.motion_records import Reference as Reference
from jointctl.firmware_py.motion_records import TrajectoryConstants as TrajectoryConstants
from jointctl.firmware_py.schema import array_of, f8, i4, i8, record, u4


@record
class VelocityConstants:
    period_s: f8
    cutoff_Hz: f8  # first-order low-pass on the difference quotient; 0 = none
    period_gain: f8  # velocity.low_pass_gain(cutoff_Hz, period_s), computed once


@record
class VelocityState:
    primed: i4  # 0 until the first sample
    last_position_rad: f8
    velocity_radps: f8
    last_error_rad: f8
    error_rate_radps: f8  # the matched filter's e'


@record
class SwingConstants:
    """See `safety.swing_fault`; amplitudes are peak to peak."""

    torque_Nm: f8  # of the torque beyond the reference's inertia torque; 0 = not watched
    error_rad: f8  # of the tracking error; 0 = not watched
    slowest_cycles: i8  # that half a swing may take; what is slower is a motion
    noise_Nm: f8  # mean change of the command from cycle to cycle that is worth a warning; 0 = not watched
    noise_gain: f8  # weight of a new change in that mean


@record
class Swing:
    """One quantity that may swing: where it last turned, and how often in a row."""

    direction: i4  # +1 after it has risen, -1 after it has fallen, 0 at the beginning
    low: f8  # since it last turned
    high: f8
    amplitude: f8  # of the last half swing, peak to peak
    count: i8  # half swings in a row
    growing: i8  # of them in a row greater than the one before
    last_cycle: i8  # when it last turned
    half_cycles: i8  # that the last half swing took


@record
class SwingState:
    torque: Swing
    error: Swing
    faint_error: Swing  # the same error, half as large swings counted: do they grow?
    reference_direction: i4  # of the last desired motion that was no standstill
    rest_rad: f8  # greatest step of the position from sample to sample before the power was on
    rest_position_rad: f8
    noise_Nm: f8  # mean change of the command from cycle to cycle
    noise_told_Nm: f8  # the same when it was reported


@record
class LimitConstants:
    """What the loop allows; every one is at the joint."""

    position_min_rad: f8
    position_max_rad: f8
    velocity_max_radps: f8
    torque_max_Nm: f8
    torque_rate_max_Nmps: f8
    following_error_max_rad: f8
    position_jump_max_rad: f8  # between two consecutive samples
    frozen_max_rad: f8  # way of the reference while the reading stands still; 0 = not watched
    frozen_torque_Nm: f8  # that a sound joint would not stand still under; 0 = not watched
    frozen_tolerance_rad: f8  # a reading that changes by no more stands still
    sample_age_max_cycles: i8
    heartbeat_age_max_cycles: i8  # of the drive's own heartbeat; 0 = not watched
    saturation_max_cycles: i8
    skipped_max_cycles: i8  # in one overrun
    standstill_radps: f8
    # a second encoder of the joint; 0 = there is none
    disagreement_max_rad: f8
    twist_radpNm: f8  # by how much they may differ more for each Nm of torque: the reducer's compliance
    limit_source: i4  # LimitSource
    swing: SwingConstants


@record
class SequenceConstants:
    """Times of the run's phases."""

    approach_s: f8  # 0 = start the trajectory at once, where the joint stands
    start_rad: f8  # where the joint stood when the motion was shown, which `approach_s` was made for
    moved_max_rad: f8  # by which it may be elsewhere when it is enabled; 0 = not checked, `start_rad` is not known
    brake_radps2: f8  # deceleration of a controlled stop
    release_s: f8  # torque ramp to zero at standstill
    settle_cycles: i8  # consecutive good samples before enabling
    wait_max_cycles: i8
    enable_max_cycles: i8
    stop_max_cycles: i8
    off_max_cycles: i8
    supervisor_max_cycles: i8  # 0 = not supervised
    may_enable: i4  # 0 holds the run in WAITING until the supervisor has checked the measured delay


@record
class VelocityCommandConstants:
    """See `velocity_command`."""

    position_gain_ps: f8
    acceleration_max_radps2: f8


@record
class AxisConstants:
    law: LawConstants
    velocity: VelocityConstants
    trajectory: TrajectoryConstants
    limits: LimitConstants
    sequence: SequenceConstants
    command_kind: i4  # CommandKind
    velocity_command: VelocityCommandConstants
    change: ChangeConstants


LINE_GONE = 1_000_000  # of `Sample.bus_errors`: more than any limit
ENCODER_RESTARTED = 0x1_0000  # of `Sample.encoder_error`: more than any EMCY error code


@record
class Sample:
    """One reading of the drive, in the units of the joint; filled by a driver."""

    position_rad: f8
    second_position_rad: f8  # of the encoder that does not feed the law, where there is one
    torque_Nm: f8
    time_ns: i8  # when it was received
    count: i8  # samples received so far: unchanged means that nothing new arrived
    drive_state: i4  # DriveState
    status_word: i4  # as the drive sent it, for the log
    drive_error: i4  # the drive's own error code, 0 = none
    encoder_error: i4  # the same of an encoder node; ENCODER_RESTARTED: it has lost its count
    restarts: i4  # boot-ups of the drive seen since it was commissioned
    bus_errors: i4  # sends that failed in a row; LINE_GONE where nothing will ever be heard or said again
    heartbeat_age_cycles: i4  # since the drive's own last heartbeat; 0 where it sends none


@record
class Command:
    torque_Nm: f8
    velocity_radps: f8  # CommandKind.VELOCITY only
    request: i4  # DriveRequest


@record
class AxisState:
    phase: i4  # AxisPhase
    fault: i4  # Fault, the first one
    reaction: i4  # Reaction in force
    fault_drive_error: i4
    notices: i4  # bits of `Notice`
    fault_encoder_error: i4  # `Sample.encoder_error` in the cycle of the fault, or of the last cycle if there is none
    cycle: i8
    phase_cycle: i8  # cycles since the phase began
    held_up_cycles: i8  # of them those that the loop skipped in overruns beyond skipped_max_cycles
    good_samples: i8
    sample_count: i8
    sample_age_cycles: i8
    saturated_cycles: i8
    still_cycles: i8
    frozen_samples: i8  # in a row, without a gap, that did not change
    pushed_cycles: i8  # of them with more torque than frozen_torque_Nm
    frozen_way_rad: f8  # how far the reference has moved since the reading last changed
    frozen_reference_rad: f8  # where the reference was when that was last looked at
    frozen_at_rad: f8  # that reading
    table_row: i4  # search hint of the trajectory table
    fault_value: f8  # the value that tripped the limit
    trajectory_s: f8
    sample_late_s: f8  # from the slot to the request of this cycle's sample; set by a real-time loop, else 0
    measured_position_rad: f8  # at the slot
    second_position_rad: f8
    measured_torque_Nm: f8
    command_torque_Nm: f8
    unlimited_torque_Nm: f8  # the law's output before limits, kept for the log
    command_velocity_radps: f8  # CommandKind.VELOCITY only
    approach: Annotated[np.ndarray, array_of(f8, 6)]  # quintic coefficients
    reference: Reference
    velocity: VelocityState
    law: LawState
    change: ChangeState
    swing: SwingState


@record
class LogRecord:
    """One cycle, as it stands in the ring and in the run log."""

    time_ns: i8  # CLOCK_MONOTONIC at the deadline
    cycle: i8
    trajectory_s: f8
    position_rad: f8
    second_position_rad: f8  # of the encoder that does not feed the law, where there is one
    velocity_radps: f8
    desired_position_rad: f8
    desired_velocity_radps: f8
    desired_acceleration_radps2: f8
    error_rad: f8
    error_rate_radps: f8
    command_torque_Nm: f8
    unlimited_torque_Nm: f8
    measured_torque_Nm: f8
    command_velocity_radps: f8
    inertia_torque_Nm: f8
    feedback_torque_Nm: f8
    friction_torque_Nm: f8
    gravity_torque_Nm: f8
    network_torque_Nm: f8
    observer_torque_Nm: f8
    learned_torque_Nm: f8
    weights: Annotated[np.ndarray, array_of(f8, NEURONS)]
    wake_late_ns: i4  # wake-up after the deadline
    round_trip_ns: i4  # SYNC sent to sample received; 0 = none in this cycle
    work_ns: i4  # compute, without waiting
    sample_age_cycles: i4
    phase: i4
    fault: i4
    request: i4
    drive_state: i4
    status_word: u4
    drive_error: u4
    skipped: i4
