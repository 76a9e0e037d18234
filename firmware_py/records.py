"""Every record of the controller, in SI units: constants (`*Constants`, set once), state (`*State`), what passes on.

`joint_` is the low-velocity side of the reducer, `motor_` the other one."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from jointctl.firmware_py.motion_records import (
    ChangeConstants,
    ChangeState,
    Reference,
    StreamConstants,
    StreamState,
    TrajectoryConstants,
)
from jointctl.firmware_py.schema import array_of, f8, i4, i8, record, u4

# --- Friction: the model and what it depends on, its bristles, and what adapts (`friction`) ---

BRISTLES = 4  # of different stiffness, that the adaptation of the friction weighs
RIPPLES = 2  # sines of the motor angle that it finds
ADAPTED_PARTS = 2 * BRISTLES + 2 * RIPPLES
HARMONICS = 4  # of a series of the motor angle
FED_HISTORY = 16  # cycles for which what was fed forward is kept


@record
class HarmonicSeries:
    """A sum of sines of the motor angle."""

    count: i4  # how many of the following are in use
    amplitude: Annotated[np.ndarray, array_of(f8, HARMONICS)]
    turns_prad: Annotated[np.ndarray, array_of(f8, HARMONICS)]  # order per joint turn / 2 pi
    phase_turns: Annotated[np.ndarray, array_of(f8, HARMONICS)]


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
    """Both directions, and what they share: see `friction.conditioned_torque_Nm`."""

    positive: FrictionBranch
    negative: FrictionBranch
    conditioned: i4  # whether friction depends on load, temperature or angle: any of the following is not zero
    load_coulomb: f8  # Coulomb friction for each Nm that the reducer transmits
    load_viscous_spr: f8  # viscous friction for the same, joint rad/s
    temperature_coulomb_pK: f8
    temperature_viscous_pK: f8
    reference_degC: f8  # where the curve holds as it stands
    lowest_degC: f8  # the factors are those of these temperatures beyond them
    highest_degC: f8
    of_angle: HarmonicSeries  # share of the friction by which it is greater


@record
class TemperatureConstants:
    """The newest reading of the drive's temperature: written by the supervisor while the loop runs."""

    gain: f8  # of one period: a new reading does not jump into the torque
    degC: Annotated[np.ndarray, array_of(f8, 1)]
    time_ns: Annotated[np.ndarray, array_of(i8, 1)]  # CLOCK_MONOTONIC of the reading; 0 = there was none


@record
class LuGreConstants:
    """Bristle stiffness and damping at the joint; the sliding curve comes from (11)."""

    stiffness_Nmprad: f8
    damping_Nmspr: f8


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
    error_rate_radps: f8  # the filtered error rate's e'


@record
class AdaptationConstants:
    """See `friction`, the feed-forward that adapts."""

    enabled: i4
    ripples: i4  # sines in use
    friction_error: f8  # of the weight of each kind of bristles at first, 1 = the configured friction
    late_cycles: i4  # from what is fed forward to the friction that the observer compares it with
    reach: f8  # by which all of them together may leave the configured friction
    count_rad: f8  # of the encoder that feeds the law of a rigid joint; 0 = not rigid, or no adaptation
    seen: VelocityConstants  # of the speeds that a flexible joint is seen to have
    ripple_Nm: f8  # of the sines at first
    ripple_max_Nm: f8
    noise_Nm: f8  # of the regression: what friction and ripple do not explain, and its samples are not independent
    ripple_turns_prad: Annotated[np.ndarray, array_of(f8, RIPPLES)]  # order per joint turn / 2 pi


@record
class AdaptationState:
    weights: Annotated[np.ndarray, array_of(f8, ADAPTED_PARTS)]
    covariance: Annotated[np.ndarray, array_of(f8, ADAPTED_PARTS, ADAPTED_PARTS)]
    gain: Annotated[np.ndarray, array_of(f8, ADAPTED_PARTS)]
    filtered_Nm: Annotated[np.ndarray, array_of(f8, ADAPTED_PARTS)]
    desired_deflection_rad: Annotated[np.ndarray, array_of(f8, BRISTLES)]
    deflection_rad: Annotated[np.ndarray, array_of(f8, BRISTLES)]  # as measured
    fed_filtered_Nm: f8
    fed_Nm: Annotated[np.ndarray, array_of(f8, FED_HISTORY)]
    newest: i4  # in it
    mean_disturbance_Nm: Annotated[np.ndarray, array_of(f8, 2)]  # the observer's, of each direction
    moved_s: Annotated[np.ndarray, array_of(f8, 2)]  # in each direction
    rest_disturbance_Nm: f8  # of the observer's, what it keeps at rest
    rest_friction_Nm: f8  # of the bristles, when the desired motion came to rest
    rest_error_rad: f8  # the furthest in the direction of that torque since
    behind_rad: f8  # what is added to the error at rest, so that the joint stands a little behind
    to_let_go_Nm: f8  # what of their torque the bristles have still to give up
    resting: i4  # cycles since, 0 while it goes on
    cycle: i4
    seen_motor: VelocityState  # from here on: not rigid, both encoders, see `flexible_joint`; rates of its errors
    seen_link: VelocityState
    seen_integral_Nms: f8  # of the observer
    seen_disturbance_Nm: f8
    seen_fed_Nm: f8  # what was fed forward, behind the low-pass of its speeds
    link_deflection_rad: Annotated[np.ndarray, array_of(f8, BRISTLES)]  # on the link's side, as desired
    link_share: f8  # of the friction that the reducer transmits, as found
    used_link_share: f8  # as fed forward, which comes after
    twist_offset_rad: f8  # of the twist, that is no friction
    twist_covariance: Annotated[np.ndarray, array_of(f8, 2, 2)]  # of offset and share


# --- The control law: network, observer, learning, and the law that holds them ---

NEURONS = 15
TORQUE_HISTORY = 16  # cycles that an observer can look back
LEARNING_BINS = 1 << 14
KNEES = 2  # of the reducer's stiffness
LEAD_HISTORY = 32  # cycles by which the feed-forward of a flexible joint can lead


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
    """See `observers.step_observer`; what follows the delay is that of `observers.step_kalman`."""

    bandwidth_radps: f8  # 0 = off
    delay_cycles: i8  # from the command to the torque that it becomes
    paired: i4  # what was fed forward is compared with the torque of its own command
    kalman: i4  # the Kalman filter takes the place of observer and filtered error rate
    cutoff_Hz: f8  # of its velocity
    error_gain: f8
    rate_gain_1ps: f8
    disturbance_gain_1ps2: f8


@record
class ObserverState:
    integral_Nms: f8
    disturbance_Nm: f8
    newest: i8
    sent_torque_Nm: Annotated[np.ndarray, array_of(f8, TORQUE_HISTORY)]
    known_torque_Nm: f8  # of the command of the cycle before: what was fed forward
    known_Nm: Annotated[np.ndarray, array_of(f8, TORQUE_HISTORY)]  # friction, gravity and what is learned, of each
    speed_radps: f8  # average of the desired one
    primed: i4  # 0 until the first reading; of the Kalman filter alone, as the next two
    error_rad: f8
    error_rate_radps: f8


@record
class LearningConstants:
    """See `law.learning_torque_Nm`."""

    gain: f8  # 0 = off
    error_gain_ps2: f8  # J error_gain e is learned on top of what feedback and observer added [1/s^2]
    lead_cycles: i8
    half_width: i8  # of the smoothing, in bins
    blend_s: f8
    growth: f8  # of the error from one repetition to the next that counts as growing; 0 = not watched


@record
class LearningState:
    epoch: i8
    bins: i8
    filled: i8  # bins written since the epoch began
    present_bin: i8
    last_bin: i8
    weight: f8
    torque_Nm: f8  # what is fed forward now
    squares_rad2: f8  # sum of the squared errors of this repetition
    samples: i8  # in that sum
    error_rad: f8  # root mean square of the repetition before; 0 = there was none
    grown: i4  # repetitions in a row whose error was greater than that of the one before
    stopped: i4  # switched off for the rest of the run, because the error grew
    learned_Nm: Annotated[np.ndarray, array_of(f8, LEARNING_BINS)]
    recorded_Nm: Annotated[np.ndarray, array_of(f8, LEARNING_BINS)]


@record
class FlexibleConstants:
    """See `flexible_joint`: a joint with a reducer that is not rigid; every value at the joint."""

    encoders: i4  # Encoders
    motor_inertia_kgm2: f8
    link_inertia_kgm2: f8
    link_friction_share: f8
    compliance_radpNm: f8  # up to the first knee
    stiffening_radpNm: Annotated[np.ndarray, array_of(f8, KNEES)]  # by which the compliance falls at each knee
    knee_Nm: Annotated[np.ndarray, array_of(f8, KNEES)]
    kinematic_error: HarmonicSeries  # [rad]
    following_Nm: f8  # that the motor may take to make up for it
    torque_ripple: HarmonicSeries  # [Nm]; the laws of a rigid joint feed it forward as well
    twist_gain: f8  # of the slow correction of the twist, of one period
    motor_velocity: VelocityConstants
    link_velocity: VelocityConstants


@record
class FlexibleState:
    primed: i4
    target_rad: f8  # theta_d
    target_radps: f8
    motor_rad: f8  # theta_d of the motion that is fed forward
    ahead_rad: f8  # that and the kinematic error there
    ahead_radps: f8  # its speed
    followed: HarmonicSeries  # the part of the kinematic error that the motor makes up for
    link_friction_Nm: f8  # of that motion
    whole_friction_Nm: f8  # what it would be if the link had all the friction
    friction_twist_rad: f8  # by which that would twist the reducer
    link_deflection_rad: f8  # of its bristles
    motor_per_link: f8  # slope of the one against the other
    apart_rad: Annotated[np.ndarray, array_of(f8, LEAD_HISTORY)]  # of each cycle, motor from link in that motion
    newest: i4  # in it
    twist_error_rad: f8  # b
    motor_velocity: VelocityState
    link_velocity: VelocityState


@record
class LawConstants:
    kind: i4  # ControllerKind
    feed_forward: i4  # FeedForward
    zero_rule: i4  # ZeroSpeedRule
    filtered_error_rate: i4  # e' from the filtered error difference instead of filtered velocity minus desired velocity
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
    temperature: TemperatureConstants
    lugre: LuGreConstants
    network: NetworkConstants
    observer: ObserverConstants
    learning: LearningConstants
    flexible: FlexibleConstants
    adaptation: AdaptationConstants
    feed_forward_lead_s: f8  # friction and inertia are fed forward for the motion that is desired so much later
    of_arm: i4  # gravity and Coriolis torque are the arm's, `LawState.arm_torque_Nm`


@record
class LawState:
    network: NetworkState
    observer: ObserverState
    learning: LearningState
    flexible: FlexibleState
    adaptation: AdaptationState
    temperature_degC: f8  # as the friction feed-forward takes it; it follows the newest reading
    lugre_deflection_rad: f8
    integral_rads: f8
    outside_torque_Nm: f8  # ControllerKind.OUTSIDE only
    arm_torque_Nm: f8  # what the arm asks beyond the joint's inertia, see `arm_model`; `LawConstants.of_arm` only
    # kept for the log: the parts of the torque at the joint
    inertia_torque_Nm: f8
    feedback_torque_Nm: f8
    friction_torque_Nm: f8
    gravity_torque_Nm: f8
    network_torque_Nm: f8  # fhat, which is subtracted
    observer_torque_Nm: f8
    learned_torque_Nm: f8


# --- One joint: limits, phases, samples, commands ---


@record
class SwingConstants:
    """See `safety.swing_fault`; amplitudes are peak to peak."""

    torque_Nm: f8  # of the torque beyond the reference's inertia torque; 0 = not watched
    error_rad: f8  # of the tracking error; 0 = not watched
    slowest_cycles: i8  # that half a swing may take; what is slower is a motion
    noise_Nm: f8  # mean change of the command from cycle to cycle that is worth a warning; 0 = not watched
    noise_gain: f8  # weight of a new change in that mean
    hunting_rad: f8  # of the error of a joint that is to rest; 0 = not watched


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
    rest_error: Swing  # the same while the reference rests
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
    frozen_ahead_rad: f8  # of that way, so much at most does not count while the joint is ahead of its reference
    frozen_torque_Nm: f8  # that a healthy joint would not stand still under; 0 = not watched
    frozen_cycles: i8  # of that torque, at least PUSHED_CYCLES
    frozen_bias_Nm: f8  # what it takes to hold it where it stands; that torque pushes no joint
    frozen_tolerance_rad: f8  # a reading that changes by no more stands still
    sample_age_max_cycles: i8
    heartbeat_age_max_cycles: i8  # of the drive's own heartbeat; 0 = not watched
    saturation_max_cycles: i8
    skipped_max_cycles: i8  # in one overrun
    standstill_radps: f8
    disagreement_max_rad: f8  # of the joint's two encoders; 0 = there is only one
    twist_radpNm: f8  # by how much they may differ more for each Nm of torque: the reducer's compliance
    limit_source: i4  # LimitSource
    swing: SwingConstants


@record
class SequenceConstants:  # times of the run's phases
    approach_s: f8  # 0 = start the trajectory at once, where the joint stands
    start_rad: f8  # where the joint stood when the motion was shown, which `approach_s` was made for
    moved_max_rad: f8  # by which it may be elsewhere when it is enabled; 0 = not checked, `start_rad` is not known
    brake_radps2: f8  # deceleration of a controlled stop
    release_s: f8  # torque ramp to zero at standstill
    settle_cycles: i8  # consecutive good samples before enabling
    wait_max_cycles: i8  # without good samples, or without a sign of life of the supervisor
    begin_max_cycles: i8  # until the drive has left "off" on its way to enabled
    enable_max_cycles: i8
    stop_max_cycles: i8
    off_max_cycles: i8
    supervisor_max_cycles: i8  # 0 = not supervised
    may_enable: i4  # 0 holds the run in WAITING until the supervisor has checked the measured delay


@record
class VelocityCommandConstants:  # for a drive that closes the velocity loop, or the position loop as well: `axis`
    position_gain_ps: f8  # CommandKind.VELOCITY only
    acceleration_max_radps2: f8
    lead_s: f8  # the motion that is desired so much later is sent; 0 = that of now, without torque offset
    feeds_torque: i4  # the law's feed-forward is sent as torque offset
    from_second: i4  # the drive closes its loop on the encoder that does not feed the law


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
    stream: StreamConstants


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
    sends_none: i4  # 1: by the drive's last word it has left the state in which it takes commands and sends samples
    bus_errors: i4  # sends that failed in a row; LINE_GONE where nothing will ever be heard or said again
    heartbeat_age_cycles: i4  # since the drive's own last heartbeat; 0 where it sends none
    sync_late_ns: i4  # how long after the first bus of an arm this drive's bus got its SYNC


@record
class Command:
    torque_Nm: f8  # CommandKind.TORQUE; of a drive that closes its own loop the torque offset
    velocity_radps: f8  # CommandKind.VELOCITY; with POSITION that of the target position, for the velocity offset
    position_rad: f8  # CommandKind.POSITION only
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
    ready: i4  # to go on to the next phase, as far as this axis is concerned
    began: i4  # 1: the drive has left Switch On Disabled, or what it has instead, on its way to enabled
    held_back: i4  # by another axis that is not; set before the cycle, 0 for a single joint
    shaken: i4  # 1 while another axis is astray; set before the cycle, 0 for a single joint
    stood_rad: f8  # when its drive was enabled, from then on without torque, or when it came to rest after braking
    good_samples: i8
    sample_count: i8
    gap_cycles: i8  # periods since the sample before this cycle's, 0 where there is no new one
    sample_age_cycles: i8
    missing_samples: i8  # in this phase, less those that came
    missed_slots: i8  # in this phase, less those that were in time
    unsent_cycles: i8  # in this phase, less those whose command was sent
    saturated_cycles: i8
    still_cycles: i8
    frozen_samples: i8  # in a row, without a gap, that did not change
    pushed_cycles: i8  # of them with more torque than frozen_torque_Nm
    pushed_max_cycles: i8  # that are allowed while the reading stands still; 0 = no push since it does
    frozen_way_rad: f8  # how far the reference has moved since the reading last changed
    frozen_reference_rad: f8  # where the reference was when that was last looked at
    frozen_at_rad: f8  # that reading
    table_row: i4  # search hint of the trajectory table
    fault_value: f8  # the value that tripped the limit
    fault_slot_ns: i8  # `slot_ns` of its cycle: of several axes the first one's is the cause
    trajectory_s: f8
    slot_ns: i8  # the loop's time of this cycle
    asked_ns: i8  # when the sample of the last cycle was asked for; 0 before the first one
    sample_late_s: f8  # from the slot to the request that this cycle's sample answers; set by a real-time loop, else 0
    measured_position_rad: f8  # at the slot
    second_position_rad: f8
    measured_torque_Nm: f8
    command_torque_Nm: f8
    unlimited_torque_Nm: f8  # the law's output before limits, kept for the log
    command_velocity_radps: f8  # CommandKind.VELOCITY; with POSITION that of the target position
    command_position_rad: f8  # the target of the last cycle, of the encoder that the drive closes its loop on
    has_target: i4  # 1 from the first target that was made of the desired motion
    ahead: Reference  # the desired motion `VelocityCommandConstants.lead_s` later
    approach: Annotated[np.ndarray, array_of(f8, 6)]  # quintic coefficients
    reference: Reference
    velocity: VelocityState
    law: LawState
    change: ChangeState
    stream: StreamState
    swing: SwingState


@record
class LogRecord:
    """One cycle, as it stands in the ring and, byte for byte, in the run log: no padding, at the end neither."""

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
    skipped: i4  # cycles left out before this one
    notices: i4  # bits of `Notice`, so far in this run
