"""The virtual joint: one substep of motor, reducer, friction and load.

    J q'' = actuator - friction - load - gravity         (2), (3), every torque at the joint

A substep is drift - kick - drift (leapfrog): torques that depend on position are taken half a substep ahead, so that a
constant torque is integrated exactly and a spring neither gains nor loses energy.  The joint is rigid; optionally it
is two masses with the reducer between them, load, gravity and end stops on the link's side:

    Jm theta'' = actuator - motor friction - torsion (1 + eps'(theta))     theta = motor angle / n
    Jl q''     = torsion - link friction - load - gravity                  q = link angle
    torsion    = spring(twist) + hysteresis(twist) + D twist'              twist = theta + eps(theta) - q

Not modelled: backlash, Coriolis torque (C0 = 0 for one joint), faults of the drive."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from jointctl.firmware_py.flexible_joint import series_at, sine_of_turns, value_at
from jointctl.firmware_py.friction import (
    Condition,
    condition_of,
    conditioned_torque_Nm,
    friction_motor_torque_Nm,
    paper_friction,
)
from jointctl.firmware_py.kernel import inlined, kernel
from jointctl.firmware_py.records import KNEES, HarmonicSeries
from jointctl.firmware_py.schema import new
from jointctl.hil.plant_records import (
    DELAY_SLOTS,
    EccentricityConstants,
    EncoderSide,
    FrictionKind,
    PlantConstants,
    PlantSettings,
    PlantState,
    decay,
)

# --- Random numbers whose state the caller keeps, so that a run repeats bit by bit: xorshift64 ---
# Marsaglia's full-period triple of shifts (Xorshift RNGs, 2003); no product, which would overflow aloud in plain
# Python.


_TO_UNIT = 2.0**-53
_SHIFTS = (np.uint64(13), np.uint64(7), np.uint64(17))
_DROP = np.uint64(11)


@kernel
def next_state(state: int) -> np.uint64:
    """The state after this one; never 0 unless `state` is."""
    x = np.uint64(state)
    x = x ^ (x << _SHIFTS[0])
    x = x ^ (x >> _SHIFTS[1])
    return x ^ (x << _SHIFTS[2])


@kernel
def unit_number(state: np.uint64) -> float:
    """The number in [0, 1) of a state."""
    return float(state >> _DROP) * _TO_UNIT


# --- The virtual encoder: joint angle to the counts that the drive reports ---
# Nearest count (a half count either way, no bias), multi-turn, signed, at the joint or at the motor.  Noise is white,
# normal, in counts, from a xorshift64 generator in the plant's state, so that a run repeats bit by bit.  An eccentric
# disc reads a sine too much, once a turn of its shaft.
#
# Not modelled: interpolation error, sampling delay (the drive model has it), loss of counts.


@kernel
def _uniform(s: PlantState) -> float:
    """The next number in [0, 1)."""
    x = next_state(s.noise_state)
    s.noise_state = x  # type: ignore[assignment]
    return unit_number(x)


@kernel
def _normal(s: PlantState) -> float:
    """A standard normal number (Box-Muller, one of the pair)."""
    radius = math.sqrt(-2.0 * math.log(1.0 - _uniform(s)))
    return radius * math.cos(2.0 * math.pi * _uniform(s))


@inlined
def _read_too_much_rad(disc: EccentricityConstants, position_rad: float) -> float:
    """By an eccentric disc [rad at the joint]."""
    if disc.joint_rad == 0.0:
        return 0.0
    return disc.joint_rad * sine_of_turns(disc.turns_prad * position_rad + disc.phase_turns)


@kernel
def link_reading_rad(c: PlantConstants, s: PlantState) -> float:
    """Link angle as an encoder on the joint sees it."""
    return s.joint_position_rad + _read_too_much_rad(c.joint_eccentricity, s.joint_position_rad)


@kernel
def shaft_velocity_radps(c: PlantConstants, s: PlantState) -> float:
    """Velocity, at the joint, of the shaft that the drive's encoder sits on."""
    return s.motor_velocity_radps if c.encoder_motor_side != 0 else s.joint_velocity_radps


@kernel
def shaft_position_rad(c: PlantConstants, s: PlantState) -> float:
    """Joint angle as the encoder sees it, its present faults included."""
    if c.encoder_motor_side != 0:
        position_rad = s.motor_position_rad + _read_too_much_rad(c.motor_eccentricity, s.motor_position_rad)
    else:
        position_rad = link_reading_rad(c, s)
    if s.encoder_stuck != 0:
        return s.encoder_stuck_rad
    if s.encoder_reversed != 0:
        position_rad = 2.0 * s.encoder_pivot_rad - position_rad
    return position_rad + s.encoder_error_rad


@kernel
def encoder_counts(c: PlantConstants, s: PlantState) -> int:
    """Position as the drive reports it [counts].  With noise on, every call draws anew: call it once a sample."""
    counts = shaft_position_rad(c, s) * c.counts_prad + c.encoder_offset_counts
    if c.encoder_noise_counts > 0.0:
        counts += c.encoder_noise_counts * _normal(s)
    return math.floor(counts + 0.5)


# --- Friction of the virtual joint, and the motion of the mass it acts on ---
# All kinds share the sliding curve (11), which is motor side; here it is times the reduction ratio and the scale of
# its direction, so that it is at the joint, positive against positive motion.
#
# * SIGN: the curve at the velocity at the start of the substep; 0 at exactly zero velocity.  It chatters around zero.
# * STICK_SLIP: set-valued at zero velocity.  At rest it holds while the net torque is within the static friction of
# either direction.  Where the velocity reaches zero inside a substep, that instant is worked out and the rest of the
# substep is at rest, or in the other direction.
# * LUGRE: dz/dt = v - sigma0 |v| z / g(v), friction = sigma0 z +
# sigma1 dz/dt (Canudas de Wit et al. 1995), g the magnitude of the sliding curve, viscous part included, so that
# steady sliding gives (11).  z takes an implicit step, which is stable at any stiffness and has the exact steady
# state.
#
# Its break-away depends on the rate (a few per cent below the static friction for a quick rise), and it creeps under
# vibration, as LuGre does.
#
# Where the curve depends on load and temperature (`friction.conditioned_torque_Nm`), the load is the torque through the
# reducer, that of a rigid joint what the actuator has left over for inertia, gravity and load.  It follows in 10 ms:
# the bristles' damping answers a change of g for some milliseconds, which would swing without a delay.
#
# Not modelled: dwell-time dependence of the static friction, position-dependent stiction.


FRICTION_LOAD_s = 0.01
_LEAST_FRICTION_Nm = 1e-9  # a curve that touches zero must not divide by it


@inlined
def modulation(c: PlantConstants, s: PlantState, position_rad: float) -> float:
    """Factor on friction: ``1 + a sin(k q)`` times the temperature's ``1 + b (T - ambient)`` (at least 0.05)."""
    factor = 1.0
    if c.friction_modulated != 0:
        factor += c.friction_ripple * sine_of_turns(c.friction_ripple_turns_prad * position_rad)
        if c.thermal != 0:
            warm = 1.0 + c.friction_per_kelvin * (s.motor_temperature_degC - c.ambient_degC)
            factor *= max(warm, 0.05)
    return factor


@inlined
def sliding_torque_Nm(c: PlantConstants, velocity_radps: float, condition: Condition) -> float:
    """(11) at the joint for velocity != 0, with its sign; the factor of `modulation` is not in it."""
    factor = c.positive_factor if velocity_radps > 0.0 else c.negative_factor
    return factor * friction_motor_torque_Nm(c.friction, velocity_radps, condition)


@inlined
def lugre_torque_Nm(
    c: PlantConstants, z: float, velocity_radps: float, factor: float, condition: Condition
) -> tuple[float, float]:
    """LuGre friction at the joint, and the bristle deflection after the substep that was z [rad] before it."""
    z_next = z
    if velocity_radps != 0.0:
        g = max(abs(sliding_torque_Nm(c, velocity_radps, condition)) * factor, _LEAST_FRICTION_Nm)
        travel = c.step_s * velocity_radps
        z_next = (z + travel) * g / (g + c.bristle_stiffness_Nmprad * abs(travel))
    torque = c.bristle_stiffness_Nmprad * z_next + c.bristle_damping_Nmspr * c.inverse_step_Hz * (z_next - z)
    return torque, z_next


@kernel
def _from_rest(
    c: PlantConstants, mass: Mass, net_torque_Nm: float, time_s: float, factor: float, condition: Condition
) -> tuple[float, float, float]:
    """Velocity, travel and friction `time_s` after standstill under a constant torque, for the set-valued kind."""
    static_Nm = conditioned_torque_Nm(c.friction, c.friction.positive, 0.0, condition)
    forward = c.positive_factor * factor * mass.friction_share * static_Nm
    static_Nm = conditioned_torque_Nm(c.friction, c.friction.negative, 0.0, condition)
    backward = -c.negative_factor * factor * mass.friction_share * static_Nm
    if net_torque_Nm > forward:
        friction = forward
    elif net_torque_Nm < backward:
        friction = backward
    else:
        return 0.0, 0.0, net_torque_Nm
    velocity = (net_torque_Nm - friction) * mass.inverse_inertia * time_s
    return velocity, 0.5 * velocity * time_s, friction


class Mass(NamedTuple):
    """A mass that friction acts on."""

    inverse_inertia: float  # [1/(kg m^2)]
    friction_share: float  # of the joint's friction


@inlined
def advance(
    c: PlantConstants,
    mass: Mass,
    velocity_radps: float,
    bristle_rad: float,
    net_torque_Nm: float,
    factor: float,
    condition: Condition,
) -> tuple[float, float, float, float]:
    """One substep of a mass: new velocity [rad/s], travel [rad], friction [Nm at the joint], bristle deflection [rad].

    `net_torque_Nm` is everything but friction, constant over the substep, so that the travel is exact; `factor` is that
    of `modulation`.
    """
    step_s = c.step_s
    friction = 0.0
    kind = c.friction_kind
    if kind == FrictionKind.LUGRE:
        friction, bristle_rad = lugre_torque_Nm(c, bristle_rad, velocity_radps, factor, condition)
        friction *= mass.friction_share
    elif kind != FrictionKind.NONE:
        if velocity_radps != 0.0:
            friction = mass.friction_share * (factor * sliding_torque_Nm(c, velocity_radps, condition))
        elif kind == FrictionKind.STICK_SLIP:
            velocity, travel, friction = _from_rest(c, mass, net_torque_Nm, step_s, factor, condition)
            return velocity, travel, friction, bristle_rad
    acceleration = (net_torque_Nm - friction) * mass.inverse_inertia
    new_velocity = velocity_radps + step_s * acceleration
    if kind == FrictionKind.STICK_SLIP and (
        velocity_radps > 0.0 >= new_velocity or velocity_radps < 0.0 <= new_velocity
    ):
        # the velocity changed, so that the acceleration is not zero, and standstill comes within the substep
        until_rest_s = min(-velocity_radps / acceleration, step_s)
        travel_to_rest = 0.5 * velocity_radps * until_rest_s
        rest_velocity, rest_travel, rest_friction = _from_rest(
            c, mass, net_torque_Nm, step_s - until_rest_s, factor, condition
        )
        return rest_velocity, travel_to_rest + rest_travel, rest_friction, bristle_rad
    return new_velocity, 0.5 * step_s * (velocity_radps + new_velocity), friction, bristle_rad


# --- The virtual drive's current loop and motor: target torque in, delivered joint torque out ---
# Delay, then limit, then a first-order lag with the exact discrete step (the target is held over a substep), then ``n
# K_m i`` (2) plus torque ripple.  The ripple does not depend on the current: it is the cogging of the motor and the
# error of the reducer, and it is there with the power off.
#
# Not modelled: voltage limit, back-EMF, the current loop's own dynamics beyond one pole, i^2 t limits.


@inlined
def step_current(c: PlantConstants, s: PlantState, target_joint_torque_Nm: float) -> float:
    """Motor current [A] at the end of this substep, after delay, limit and lag; a NaN target counts as zero."""
    target = target_joint_torque_Nm * c.current_per_torque_ApNm
    limit = c.current_limit_A
    if s.current_capped != 0:
        limit = min(limit, s.current_cap_A)
    if target > limit:
        target = limit
    elif target < -limit:
        target = -limit
    elif target != target:
        target = 0.0
    delay = c.delay_substeps
    if delay > 0:
        slot = s.delay_slot
        oldest = s.delayed_current_A[slot]
        s.delayed_current_A[slot] = target
        target = oldest
        slot += 1
        s.delay_slot = 0 if slot >= delay or slot >= DELAY_SLOTS else slot
    current = target + (s.current_A - target) * c.current_decay
    s.current_A = current
    return current


# --- The reducer of a flexible joint ---
# The spring is stiffer the more torque it transmits: three slopes, with knees.  The hysteresis is a bristle that slides
# at half the loop's width: dz = dtwist - |dtwist| z / (width / 2), torque K1 z; it depends on the way alone, not on the
# speed, and near a reversal adds its own stiffness K1 to the spring's.  z takes a step that is exact to second order.
#
# Not modelled: a stiffness that depends on the angle, play.


@inlined
def spring_torque_Nm(c: PlantConstants, twist_rad: float) -> float:
    """Of the three slopes, without hysteresis and damping."""
    size = abs(twist_rad)
    torque = c.reducer_stiffness_Nmprad * size
    for i in range(KNEES):
        torque += c.reducer_stiffening_Nmprad[i] * max(size - c.reducer_knee_rad[i], 0.0)
    return math.copysign(torque, twist_rad)


@inlined
def hysteresis_torque_Nm(c: PlantConstants, s: PlantState, twist_rad: float) -> float:
    """Of the bristle, which goes along to `twist_rad`."""
    if c.hysteresis_slide_rad == 0.0:
        return 0.0
    way = twist_rad - s.twist_rad
    half = 0.5 * abs(way)
    z = (s.hysteresis_rad * (c.hysteresis_slide_rad - half) + c.hysteresis_slide_rad * way) / (
        c.hysteresis_slide_rad + half
    )
    s.twist_rad = twist_rad
    s.hysteresis_rad = z
    return c.reducer_stiffness_Nmprad * z


# --- The virtual joint: one substep of motor, reducer, friction and load ---


__all__ = ["R1", "EncoderSide", "FrictionKind", "PlantSettings", "encoder_counts", "plant", "step_plant"]

_LOOSENING_STEPS = 40  # each divides the twist that is left by a hundred or so

# The realistic plant of the reference figures; its friction is 10 % above Table 3, which the controller believes.
R1: dict[str, Any] = {
    "friction_kind": FrictionKind.LUGRE,
    "friction_positive_scale": 1.1,
    "friction_negative_scale": 1.1,
    "friction_ripple": 0.05,
    "friction_ripple_per_joint_turn": 18.0,
    "torque_ripple_Nm": (0.5, 0.3),
    "torque_ripple_per_motor_turn": (2.0, 10.0),
    "current_lag_s": 0.5e-3,
    "command_delay_s": 1e-3,
    "encoder_counts_per_turn": 2**19,
}


@kernel
def end_stop_torque_Nm(c: PlantConstants, position_rad: float, velocity_radps: float) -> float:
    """Torque of the stiff spring and damper behind either end stop; it pushes, it never pulls."""
    if position_rad > c.end_stop_max_rad:
        depth = position_rad - c.end_stop_max_rad
        return max(c.end_stop_stiffness_Nmprad * depth + c.end_stop_damping_Nmspr * velocity_radps, 0.0)
    if position_rad < c.end_stop_min_rad:
        depth = position_rad - c.end_stop_min_rad
        return min(c.end_stop_stiffness_Nmprad * depth + c.end_stop_damping_Nmspr * velocity_radps, 0.0)
    return 0.0


@inlined
def load_torque_Nm(c: PlantConstants, s: PlantState) -> float:
    """Constant, step and added load, against positive motion."""
    load = c.load_torque_Nm + s.added_load_torque_Nm
    if s.substep >= c.load_step_substep:
        load += c.load_step_Nm
    return load


@inlined
def rigid_actuator_Nm(c: PlantConstants, current_A: float, motor_rad: float) -> float:
    """Of the motor at its angle / n, ripple included."""
    return c.torque_per_current_NmpA * current_A + value_at(c.torque_ripple, motor_rad)


@inlined
def turn_motor(
    c: PlantConstants, s: PlantState, current_A: float, joint_middle: float, condition: Condition
) -> tuple[float, float, float, float]:
    """A substep of the motor of a flexible joint: torque through the reducer, the actuator's, friction, its factor."""
    motor_velocity = s.motor_velocity_radps
    motor_middle = s.motor_position_rad + 0.5 * c.step_s * motor_velocity
    actuator = rigid_actuator_Nm(c, current_A, motor_middle)
    error, slope, _ = series_at(c.kinematic_error, motor_middle)
    twist = motor_middle + error - joint_middle
    twist_rate = motor_velocity * (1.0 + slope) - s.joint_velocity_radps
    through = spring_torque_Nm(c, twist) + c.reducer_damping_Nmspr * twist_rate + hysteresis_torque_Nm(c, s, twist)
    factor = modulation(c, s, motor_middle)
    motor = Mass(c.inverse_driven_inertia, c.motor_friction_share)
    velocity, travel, friction, s.bristle_deflection_rad = advance(
        c, motor, motor_velocity, s.bristle_deflection_rad, actuator - through * (1.0 + slope), factor, condition
    )
    s.motor_position_rad += travel
    s.motor_velocity_radps = velocity
    return through, actuator, friction, factor


@inlined
def finish_substep(
    c: PlantConstants, s: PlantState, current_A: float, actuator: float, friction: float, load: float, gravity: float,
    through: float,
) -> None:  # fmt: skip
    """What a substep leaves: the torques [Nm], the friction's load, the temperature, the time."""
    s.friction_load_Nm += c.friction_load_gain * (through - s.friction_load_Nm)
    s.actuator_torque_Nm = actuator
    s.friction_torque_Nm = friction
    s.load_torque_Nm = load
    s.gravity_torque_Nm = gravity
    if c.thermal != 0:
        steady = c.ambient_degC + c.heating_KpA2 * current_A * current_A
        s.motor_temperature_degC += (steady - s.motor_temperature_degC) * c.thermal_gain
    s.substep += 1
    s.time_s = s.substep * c.step_s


@inlined
def step_plant(c: PlantConstants, s: PlantState, target_joint_torque_Nm: float) -> None:
    """Advance the plant by one substep of `c.step_s`.

    `target_joint_torque_Nm` is what the drive asks of its current loop, at the joint, positive towards positive angle.
    """
    current = step_current(c, s, target_joint_torque_Nm)
    joint_velocity = s.joint_velocity_radps
    joint_middle = s.joint_position_rad + 0.5 * c.step_s * joint_velocity
    load = load_torque_Nm(c, s)
    resisting = load
    gravity = 0.0
    if c.gravity_Nm != 0.0:
        gravity = c.gravity_Nm * math.sin(joint_middle - c.gravity_zero_rad)
        resisting += gravity
    if c.end_stops != 0:
        resisting += end_stop_torque_Nm(c, joint_middle, joint_velocity)

    load_Nm = s.friction_load_Nm * c.inverse_ratio
    condition = condition_of(c.friction, load_Nm, s.motor_temperature_degC, s.motor_position_rad)
    if c.flexible == 0:
        actuator = rigid_actuator_Nm(c, current, joint_middle)
        factor = modulation(c, s, joint_middle)
        whole = Mass(c.inverse_driven_inertia, 1.0)
        velocity, travel, friction, s.bristle_deflection_rad = advance(
            c, whole, joint_velocity, s.bristle_deflection_rad, actuator - resisting, factor, condition
        )
        through = actuator - friction
        position = s.joint_position_rad + travel
        s.joint_position_rad = position
        s.joint_velocity_radps = velocity
        s.motor_position_rad = position
        s.motor_velocity_radps = velocity
    else:
        through, actuator, friction, factor = turn_motor(c, s, current, joint_middle, condition)
        link = Mass(c.inverse_link_inertia, 1.0 - c.motor_friction_share)
        link_velocity, link_travel, link_friction, s.link_bristle_deflection_rad = advance(
            c, link, joint_velocity, s.link_bristle_deflection_rad, through - resisting, factor, condition
        )
        s.joint_position_rad += link_travel
        s.joint_velocity_radps = link_velocity
        s.reducer_torque_Nm = through
        friction += link_friction
    finish_substep(c, s, current, actuator, friction, load, gravity, through)


def _fill_friction(c: PlantConstants, settings: PlantSettings) -> None:
    ratio = settings.reduction_ratio
    c.friction_kind = settings.friction_kind
    c.friction = paper_friction() if settings.friction is None else settings.friction
    c.positive_factor = ratio * settings.friction_positive_scale
    c.negative_factor = ratio * settings.friction_negative_scale
    c.friction_ripple = settings.friction_ripple
    c.friction_ripple_turns_prad = settings.friction_ripple_per_joint_turn / (2.0 * math.pi)
    c.friction_modulated = settings.friction_ripple != 0.0 or settings.thermal
    c.bristle_stiffness_Nmprad = settings.bristle_stiffness_Nmprad
    c.bristle_damping_Nmspr = settings.bristle_damping_Nmspr
    c.thermal = settings.thermal
    c.ambient_degC = settings.ambient_degC
    c.heating_KpA2 = settings.heating_KpA2
    c.thermal_gain = -math.expm1(-settings.step_s / settings.thermal_time_s)
    of_curve = float(c.friction.temperature_coulomb_pK) != 0.0 or float(c.friction.temperature_viscous_pK) != 0.0
    c.friction_per_kelvin = 0.0 if of_curve else settings.friction_per_kelvin
    c.inverse_ratio = 1.0 / ratio
    c.friction_load_gain = -math.expm1(-settings.step_s / FRICTION_LOAD_s)


def _fill_actuator(c: PlantConstants, settings: PlantSettings) -> None:
    torque_per_current = settings.reduction_ratio * settings.torque_constant_NmpA
    c.torque_per_current_NmpA = torque_per_current
    c.current_per_torque_ApNm = 1.0 / torque_per_current
    c.current_limit_A = settings.current_limit_A
    c.current_decay = decay(settings.step_s, settings.current_lag_s)
    c.delay_substeps = round(settings.command_delay_s / settings.step_s)
    _fill_waves(
        c.torque_ripple, settings, settings.torque_ripple_Nm, settings.torque_ripple_per_motor_turn,
        settings.torque_ripple_phase_rad,
    )  # fmt: skip


def _fill_waves(
    waves: HarmonicSeries,
    settings: PlantSettings,
    amplitudes: tuple[float, ...],
    orders: tuple[float, ...],
    phases: tuple[float, ...],
) -> None:
    waves.count = len(amplitudes)
    for i, (amplitude, order, phase) in enumerate(
        zip(amplitudes, orders, phases or (0.0,) * len(amplitudes), strict=True)
    ):
        waves.amplitude[i] = amplitude
        waves.turns_prad[i] = order * settings.reduction_ratio / (2.0 * math.pi)
        waves.phase_turns[i] = phase / (2.0 * math.pi)


def _fill_reducer(c: PlantConstants, settings: PlantSettings) -> None:
    c.motor_friction_share = 1.0 - settings.link_friction_share
    c.hysteresis_slide_rad = 0.5 * settings.hysteresis_width_rad
    _fill_waves(
        c.kinematic_error, settings, settings.kinematic_error_rad, settings.kinematic_error_per_motor_turn,
        settings.kinematic_error_phase_rad,
    )  # fmt: skip
    slope, twist, torque = settings.reducer_stiffness_Nmprad, 0.0, 0.0
    steeper = zip(settings.reducer_knees_Nm, settings.reducer_stiffness_beyond_Nmprad, strict=True)
    for i, (knee_Nm, beyond) in enumerate(steeper):
        twist += (knee_Nm - torque) / slope
        c.reducer_knee_rad[i] = twist
        c.reducer_stiffening_Nmprad[i] = beyond - slope
        slope, torque = beyond, knee_Nm


def _fill_mechanics(c: PlantConstants, settings: PlantSettings) -> None:
    c.step_s = settings.step_s
    c.inverse_step_Hz = 1.0 / settings.step_s
    driven = settings.motor_side_inertia_kgm2 if settings.flexible else settings.inertia_kgm2
    c.driven_inertia_kgm2 = driven
    c.inverse_driven_inertia = 1.0 / driven
    c.inverse_link_inertia = 1.0 / (settings.inertia_kgm2 - driven) if settings.flexible else 0.0
    for name in (
        "flexible", "reducer_stiffness_Nmprad", "reducer_damping_Nmspr", "load_torque_Nm", "load_step_Nm",
        "gravity_Nm", "gravity_zero_rad", "end_stops", "end_stop_min_rad", "end_stop_max_rad",
        "end_stop_stiffness_Nmprad", "end_stop_damping_Nmspr",
    ):  # fmt: skip
        setattr(c, name, getattr(settings, name))
    c.load_step_substep = round(settings.load_step_at_s / settings.step_s)


def _fill_encoder(c: PlantConstants, settings: PlantSettings) -> None:
    motor_side = settings.encoder_side == EncoderSide.MOTOR
    shaft_turns = settings.reduction_ratio if motor_side else 1.0
    c.encoder_motor_side = motor_side
    c.counts_prad = settings.encoder_direction * settings.encoder_counts_per_turn * shaft_turns / (2.0 * math.pi)
    c.encoder_offset_counts = settings.encoder_offset_counts
    c.encoder_noise_counts = settings.encoder_noise_counts
    for disc, turns, amplitude_rad, phase_rad in (
        (
            c.motor_eccentricity, settings.reduction_ratio,
            settings.motor_encoder_eccentricity_rad, settings.motor_encoder_eccentricity_phase_rad,
        ),
        (
            c.joint_eccentricity, 1.0,
            settings.joint_encoder_eccentricity_rad, settings.joint_encoder_eccentricity_phase_rad,
        ),
    ):  # fmt: skip
        disc.joint_rad = amplitude_rad / turns
        disc.turns_prad = turns / (2.0 * math.pi)
        disc.phase_turns = phase_rad / (2.0 * math.pi)


def plant(**settings: Any) -> tuple[Any, Any]:
    """Constants and initial state, record arrays of shape (1,), of the plant with these `PlantSettings`.

    ``c, s = plant(**R1)`` and then ``step_plant(c[0], s[0], torque_Nm)``.  ValueError names a bad setting.
    """
    known = set(PlantSettings.__dataclass_fields__)
    for name, value in settings.items():
        if name not in known:
            allowed = ", ".join(sorted(known))
            raise ValueError(f"{name} (={value}) is not a setting of the virtual joint; allowed: {allowed}")
    checked = PlantSettings(**settings)
    constants, state = new(PlantConstants), new(PlantState)
    c, s = constants[0], state[0]
    _fill_mechanics(c, checked)
    _fill_actuator(c, checked)
    _fill_friction(c, checked)
    _fill_encoder(c, checked)
    _fill_reducer(c, checked)
    s.joint_position_rad = s.motor_position_rad = checked.initial_position_rad
    for _ in range(_LOOSENING_STEPS):  # the reducer's spring is slack at the start
        s.motor_position_rad = checked.initial_position_rad - value_at(c.kinematic_error, s.motor_position_rad)
    s.motor_temperature_degC = checked.ambient_degC
    s.noise_state = checked.encoder_seed
    return constants, state
