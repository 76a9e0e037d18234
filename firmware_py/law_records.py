"""Records of the control law: friction model, network, observer, learning, and the law that holds them.

Constants are set once, state changes in every cycle.  SI units; `joint_` is the low-velocity side of the reducer.
Import them from `firmware_py.records`, which has every record.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np

from jointctl.firmware_py.schema import array_of, f8, i4, i8, record

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
