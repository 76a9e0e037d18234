"""The virtual joint: one substep of motor, reducer, friction and load.

    J q'' = actuator - friction - load - gravity         (2), (3), every torque at the joint

A substep is drift - kick - drift (leapfrog): torques that depend on position are taken half a substep ahead, so that a
constant torque is integrated exactly and a spring neither gains nor loses energy.  The joint is rigid; optionally it
is two masses joined by the reducer's stiffness and damping, the friction on the motor's side and load, gravity and
end stops on the other.

Not modelled: backlash, hysteresis of the reducer, Coriolis torque (C0 = 0 for one joint), faults of the drive.
"""

from __future__ import annotations

import math
from typing import Any

from jointctl.firmware_py.friction import paper_friction
from jointctl.firmware_py.kernel import inlined, kernel
from jointctl.firmware_py.schema import new
from jointctl.hil.plant.actuator import step_current, torque_ripple_Nm
from jointctl.hil.plant.encoder import encoder_counts
from jointctl.hil.plant.friction import advance
from jointctl.hil.plant.records import EncoderSide, FrictionKind, PlantConstants, PlantState
from jointctl.hil.plant.settings import PlantSettings, decay

__all__ = ["R1", "EncoderSide", "FrictionKind", "PlantSettings", "encoder_counts", "plant", "step_plant"]

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
def _end_stop_torque_Nm(c: PlantConstants, position_rad: float, velocity_radps: float) -> float:
    """Torque of the stiff spring and damper behind either end stop; it pushes, it never pulls."""
    if position_rad > c.end_stop_max_rad:
        depth = position_rad - c.end_stop_max_rad
        return max(c.end_stop_stiffness_Nmprad * depth + c.end_stop_damping_Nmspr * velocity_radps, 0.0)
    if position_rad < c.end_stop_min_rad:
        depth = position_rad - c.end_stop_min_rad
        return min(c.end_stop_stiffness_Nmprad * depth + c.end_stop_damping_Nmspr * velocity_radps, 0.0)
    return 0.0


@inlined
def step_plant(c: PlantConstants, s: PlantState, target_joint_torque_Nm: float) -> None:
    """Advance the plant by one substep of `c.step_s`.

    `target_joint_torque_Nm` is what the drive asks of its current loop, at the joint, positive towards positive angle.
    """
    half_step_s = 0.5 * c.step_s
    current = step_current(c, s, target_joint_torque_Nm)

    joint_velocity = s.joint_velocity_radps
    joint_middle = s.joint_position_rad + half_step_s * joint_velocity
    load = c.load_torque_Nm + s.added_load_torque_Nm
    if s.substep >= c.load_step_substep:
        load += c.load_step_Nm
    resisting = load
    gravity = 0.0
    if c.gravity_Nm != 0.0:
        gravity = c.gravity_Nm * math.sin(joint_middle)
        resisting += gravity
    if c.end_stops != 0:
        resisting += _end_stop_torque_Nm(c, joint_middle, joint_velocity)

    if c.flexible == 0:
        actuator = c.torque_per_current_NmpA * current + torque_ripple_Nm(c, joint_middle)
        velocity, travel, friction = advance(c, s, joint_velocity, joint_middle, actuator - resisting)
        position = s.joint_position_rad + travel
        s.joint_position_rad = position
        s.joint_velocity_radps = velocity
        s.motor_position_rad = position
        s.motor_velocity_radps = velocity
    else:
        motor_velocity = s.motor_velocity_radps
        motor_middle = s.motor_position_rad + half_step_s * motor_velocity
        actuator = c.torque_per_current_NmpA * current + torque_ripple_Nm(c, motor_middle)
        twist = motor_middle - joint_middle
        through = c.reducer_stiffness_Nmprad * twist + c.reducer_damping_Nmspr * (motor_velocity - joint_velocity)
        velocity, travel, friction = advance(c, s, motor_velocity, motor_middle, actuator - through)
        s.motor_position_rad += travel
        s.motor_velocity_radps = velocity
        joint_velocity += c.step_s * (through - resisting) * c.inverse_link_inertia
        s.joint_position_rad = joint_middle + half_step_s * joint_velocity
        s.joint_velocity_radps = joint_velocity
        s.reducer_torque_Nm = through

    s.actuator_torque_Nm = actuator
    s.friction_torque_Nm = friction
    s.load_torque_Nm = load
    s.gravity_torque_Nm = gravity
    if c.thermal != 0:
        steady = c.ambient_degC + c.heating_KpA2 * current * current
        s.motor_temperature_degC += (steady - s.motor_temperature_degC) * c.thermal_gain
    s.substep += 1
    s.time_s = s.substep * c.step_s


def _fill_friction(c: Any, settings: PlantSettings) -> None:
    ratio = settings.reduction_ratio
    c.friction_kind = settings.friction_kind
    c["friction"] = paper_friction() if settings.friction is None else settings.friction
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
    c.friction_per_kelvin = settings.friction_per_kelvin


def _fill_actuator(c: Any, settings: PlantSettings) -> None:
    torque_per_current = settings.reduction_ratio * settings.torque_constant_NmpA
    c.torque_per_current_NmpA = torque_per_current
    c.current_per_torque_ApNm = 1.0 / torque_per_current
    c.current_limit_A = settings.current_limit_A
    c.current_decay = decay(settings.step_s, settings.current_lag_s)
    c.delay_substeps = round(settings.command_delay_s / settings.step_s)
    c.torque_ripples = len(settings.torque_ripple_Nm)
    phases = settings.torque_ripple_phase_rad or (0.0,) * len(settings.torque_ripple_Nm)
    ripples = zip(settings.torque_ripple_Nm, settings.torque_ripple_per_motor_turn, phases, strict=True)
    for i, (amplitude, order, phase) in enumerate(ripples):
        c.torque_ripple_Nm[i] = amplitude
        c.torque_ripple_turns_prad[i] = order * settings.reduction_ratio / (2.0 * math.pi)
        c.torque_ripple_phase_turns[i] = phase / (2.0 * math.pi)


def _fill_mechanics(c: Any, settings: PlantSettings) -> None:
    c.step_s = settings.step_s
    c.inverse_step_Hz = 1.0 / settings.step_s
    driven = settings.motor_side_inertia_kgm2 if settings.flexible else settings.inertia_kgm2
    c.driven_inertia_kgm2 = driven
    c.inverse_driven_inertia = 1.0 / driven
    c.inverse_link_inertia = 1.0 / (settings.inertia_kgm2 - driven) if settings.flexible else 0.0
    for name in (
        "flexible",
        "reducer_stiffness_Nmprad",
        "reducer_damping_Nmspr",
        "load_torque_Nm",
        "load_step_Nm",
        "gravity_Nm",
        "end_stops",
        "end_stop_min_rad",
        "end_stop_max_rad",
        "end_stop_stiffness_Nmprad",
        "end_stop_damping_Nmspr",
    ):
        c[name] = getattr(settings, name)
    c.load_step_substep = round(settings.load_step_at_s / settings.step_s)


def _fill_encoder(c: Any, settings: PlantSettings) -> None:
    motor_side = settings.encoder_side == EncoderSide.MOTOR
    shaft_turns = settings.reduction_ratio if motor_side else 1.0
    c.encoder_motor_side = motor_side
    c.counts_prad = settings.encoder_direction * settings.encoder_counts_per_turn * shaft_turns / (2.0 * math.pi)
    c.encoder_offset_counts = settings.encoder_offset_counts
    c.encoder_noise_counts = settings.encoder_noise_counts


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
    s.joint_position_rad = s.motor_position_rad = checked.initial_position_rad
    s.motor_temperature_degC = checked.ambient_degC
    s.noise_state = checked.encoder_seed
    return constants, state
