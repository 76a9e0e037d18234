"""Every record of the controller: constants (`*Constants`, set once), state (`*State`), and what passes between blocks.

SI units throughout.  `joint_` is the low-velocity side of the reducer, `motor_` the other one.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np

from firmware_py.schema import array_of, f8, i4, i8, record, u4

NEURONS = 15
TORQUE_HISTORY = 16  # cycles that an observer can look back
LEARNING_BINS = 1 << 14


@record
class FrictionBranch:
    """One direction of the multi-stage model (11), mirrored to positive speed and friction.

    Speeds are those of the joint [rad/s], torques those at the motor [Nm].
    """

    coulomb_Nm: f8
    static_Nm: f8
    stribeck_speed_radps: f8
    viscous_Nmspr: f8
    cubic: Annotated[np.ndarray, array_of(f8, 4)]  # a0..a3 of a0 + a1 v + a2 v^2 + a3 v^3
    knee_radps: f8  # the Stribeck stage holds up to here, the cubic one beyond
    max_radps: f8  # beyond here the end slope is held


@record
class FrictionConstants:
    positive: FrictionBranch
    negative: FrictionBranch


@record
class LuGreConstants:
    """Bristle stiffness and damping at the joint; the sliding curve comes from (11)."""

    stiffness_Nmprad: f8
    damping_Nmspr: f8


@record
class NetworkConstants:
    """The radial basis function network of (14) and its adaptation law (24)."""

    centres: Annotated[np.ndarray, array_of(f8, NEURONS, 2)]  # [rad, rad/s]
    inverse_width: Annotated[np.ndarray, array_of(f8, NEURONS)]  # 1 / (2 b^2)
    learning_rate: f8  # beta
    p_b: Annotated[np.ndarray, array_of(f8, 2)]  # P B = [P12, P22] / M0
    initial_weight: f8
    leakage: f8  # sigma-modification [1/s], 0 = off
    weight_limit: f8  # projection |w_i| <= limit [Nm], 0 = off
    dead_zone_rad: f8  # no adaptation while |e| is below, 0 = off


@record
class NetworkState:
    weights: Annotated[np.ndarray, array_of(f8, NEURONS)]  # [Nm]
    hidden: Annotated[np.ndarray, array_of(f8, NEURONS)]  # h(x), kept for the log


@record
class ObserverConstants:
    """See `disturbance_observer`."""

    bandwidth_radps: f8  # 0 = off
    delay_cycles: i8  # from the command to the torque that it becomes


@record
class ObserverState:
    integral_Nms: f8
    disturbance_Nm: f8
    newest: i8
    sent_torque_Nm: Annotated[np.ndarray, array_of(f8, TORQUE_HISTORY)]


@record
class LearningConstants:
    """See `iterative_learning`."""

    gain: f8  # 0 = off
    error_gain_ps2: f8  # J error_gain e is learned on top of what feedback and observer added [1/s^2]
    lead_cycles: i8
    half_width: i8  # of the smoothing, in bins
    blend_s: f8


@record
class LearningState:
    epoch: i8
    bins: i8
    filled: i8  # bins written since the epoch began
    present_bin: i8
    last_bin: i8
    weight: f8
    torque_Nm: f8  # what is fed forward now
    learned_Nm: Annotated[np.ndarray, array_of(f8, LEARNING_BINS)]
    recorded_Nm: Annotated[np.ndarray, array_of(f8, LEARNING_BINS)]


@record
class LawConstants:
    kind: i4  # ControllerKind
    feed_forward: i4  # FeedForward
    zero_rule: i4  # ZeroSpeedRule
    matched_filter: i4  # e' from the filtered error difference instead of filtered velocity minus desired velocity
    period_s: f8
    inertia_kgm2: f8  # M0
    coriolis_Nmspr: f8  # C0
    gravity_Nm: f8  # G0(q) = gravity_Nm sin(q - gravity_zero_rad)
    gravity_zero_rad: f8
    kp: f8  # [1/s^2]
    kv: f8  # [1/s]
    ki: f8  # [1/s^3], PID
    integral_limit_rads: f8  # PID, 0 = none
    reduction_ratio: f8
    zero_band_radps: f8
    friction: FrictionConstants
    lugre: LuGreConstants
    network: NetworkConstants
    observer: ObserverConstants
    learning: LearningConstants


@record
class LawState:
    network: NetworkState
    observer: ObserverState
    learning: LearningState
    lugre_deflection_rad: f8
    integral_rads: f8
    # kept for the log: the parts of the torque at the joint
    inertia_torque_Nm: f8
    feedback_torque_Nm: f8
    friction_torque_Nm: f8
    gravity_torque_Nm: f8
    network_torque_Nm: f8  # fhat, which is subtracted
    observer_torque_Nm: f8
    learned_torque_Nm: f8


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
class Reference:
    position_rad: f8
    velocity_radps: f8
    acceleration_radps2: f8


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
    dwell_s: f8


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
    sample_age_max_cycles: i8
    saturation_max_cycles: i8
    skipped_max_cycles: i8  # in one overrun
    standstill_radps: f8


@record
class SequenceConstants:
    """Times of the run's phases."""

    approach_s: f8  # 0 = start the trajectory at once, where the joint stands
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


@record
class Sample:
    """One reading of the drive, in the units of the joint; filled by a driver."""

    position_rad: f8
    torque_Nm: f8
    time_ns: i8  # when it was received
    count: i8  # samples received so far: unchanged means that nothing new arrived
    drive_state: i4  # DriveState
    status_word: i4  # as the drive sent it, for the log
    drive_error: i4  # the drive's own error code, 0 = none
    restarts: i4  # boot-ups of the drive seen since the loop began
    bus_errors: i4  # sends that failed in a row


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
    cycle: i8
    phase_cycle: i8  # cycles since the phase began
    good_samples: i8
    sample_count: i8
    sample_age_cycles: i8
    saturated_cycles: i8
    still_cycles: i8
    restarts_at_start: i4
    table_row: i4  # search hint of the trajectory table
    fault_value: f8  # the value that tripped the limit
    trajectory_s: f8
    measured_position_rad: f8
    measured_torque_Nm: f8
    command_torque_Nm: f8
    unlimited_torque_Nm: f8  # the law's output before limits, kept for the log
    command_velocity_radps: f8  # CommandKind.VELOCITY only
    approach: Annotated[np.ndarray, array_of(f8, 6)]  # quintic coefficients
    reference: Reference
    velocity: VelocityState
    law: LawState


@record
class LogRecord:
    """One cycle, as it stands in the ring and in the run log."""

    time_ns: i8  # CLOCK_MONOTONIC at the deadline
    cycle: i8
    trajectory_s: f8
    position_rad: f8
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
