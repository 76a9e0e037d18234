"""Records of friction: the model and what it depends on, its bristles, and what adapts; see `friction_adaptation`."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from jointctl.firmware_py.schema import array_of, f8, i4, i8, record

BRISTLES = 4  # of different stiffness, that the adaptation of the friction weighs
RIPPLES = 2  # sines of the motor angle that it finds
ADAPTED_PARTS = 2 * BRISTLES + 2 * RIPPLES
FED_HISTORY = 16  # cycles for which what was fed forward is kept


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
    conditioned: i4  # whether friction depends on load or temperature: any of the following is not zero
    load_coulomb: f8  # Coulomb friction for each Nm that the reducer transmits
    load_viscous_spr: f8  # viscous friction for the same, joint rad/s
    temperature_coulomb_pK: f8
    temperature_viscous_pK: f8
    reference_degC: f8  # where the curve holds as it stands
    lowest_degC: f8  # the factors are those of these temperatures beyond them
    highest_degC: f8


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
class AdaptationConstants:
    """See `friction_adaptation`."""

    enabled: i4
    ripples: i4  # sines in use
    friction_error: f8  # of the weight of each kind of bristles at first, 1 = the configured friction
    late_cycles: i4  # from what is fed forward to the friction that the observer compares it with
    reach: f8  # by which all of them together may leave the configured friction
    ripple_Nm: f8  # of the sines at first
    ripple_max_Nm: f8
    ripple_turns_prad: Annotated[np.ndarray, array_of(f8, RIPPLES)]  # order per joint turn / 2 pi


@record
class AdaptationState:
    weights: Annotated[np.ndarray, array_of(f8, ADAPTED_PARTS)]
    covariance: Annotated[np.ndarray, array_of(f8, ADAPTED_PARTS, ADAPTED_PARTS)]
    gain: Annotated[np.ndarray, array_of(f8, ADAPTED_PARTS)]
    filtered_Nm: Annotated[np.ndarray, array_of(f8, ADAPTED_PARTS)]
    desired_deflection_rad: Annotated[np.ndarray, array_of(f8, BRISTLES)]
    deflection_rad: Annotated[np.ndarray, array_of(f8, BRISTLES)]  # as measured
    bristle: LuGreConstants  # of one kind of bristles, while they are computed
    fed_filtered_Nm: f8
    fed_Nm: Annotated[np.ndarray, array_of(f8, FED_HISTORY)]
    newest: i4  # in it
    rest_disturbance_Nm: f8  # the observer's, when the desired motion came to rest
    resting: i4
    cycle: i4
