"""Units of the configuration into those of the kernels: joint radians, motor newton metres, the drive's ampere."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.sections import Friction, FrictionDirection, FrictionTemperature, Reducer, Section

if TYPE_CHECKING:
    from jointctl.firmware_py.records import FrictionConstants, HarmonicSeries


RADPS_PER_UNIT = {"deg/s": math.pi / 180.0, "rad/s": 1.0, "r/min": math.tau / 60.0}
TWIST_SHARE = 0.35  # of what a soft reducer's twist may reach, where a motion that measures turns round or is excited
SWINGS_s = 0.125  # period of a link that still swings where a plateau begins to be measured
HELD_BEYOND_K = 40.0  # of the reference: the factors of friction are held there where no range is given


def shared(settings: type[Any], *sections: Section) -> dict[str, Any]:
    """Keyword arguments for a dataclass: its fields that the sections have by the same name, hence in the same unit."""
    names = {field.name for field in fields(settings)}
    return {name: getattr(section, name) for section in sections for name in names & set(type(section).model_fields)}


def joint_settings(settings: type[Any], config: Config, drive: Section) -> dict[str, Any]:
    """What the settings of every driver take from [drive], [limits], [sequence], [loop], [joint] and [encoder]."""
    encoder = config.encoder
    return {
        **shared(settings, drive, config.limits, config.sequence, config.loop, config.joint, encoder),
        "torque_constant_NmpA": torque_constant_NmpA(config),
        "encoder_on_motor": encoder.side == "motor",
        "encoder_direction": encoder.direction,
    }


def period_s(config: Config) -> float:
    return 1.0 / config.loop.rate_Hz


def torque_constant_NmpA(config: Config) -> float:
    """Motor torque per ampere as the drive counts amperes (rms, or amplitude of the sine = sqrt(2) rms)."""
    factor = {("rms", "sine_amplitude"): math.sqrt(0.5), ("sine_amplitude", "rms"): math.sqrt(2.0)}
    return config.joint.torque_constant_NmpA * factor.get(
        (config.joint.torque_constant_ampere, config.drive.ampere), 1.0
    )


def joint_rad_per_count(config: Config) -> float:
    """Joint angle of one encoder count, direction included."""
    turns = config.encoder.counts_per_turn * (config.joint.reduction_ratio if config.encoder.side == "motor" else 1.0)
    return config.encoder.direction * math.tau / turns


def law_resolution_rad(config: Config) -> float:
    """One count of the encoder that feeds the law, at the joint."""
    second = config.joint_encoder
    if second is not None and second.law == "joint_encoder":
        return math.tau / second.counts_per_turn
    return abs(joint_rad_per_count(config))


def velocity_of_a_count_radps(config: Config) -> float:
    """What the filter of the velocity (`firmware_py.axis`) gives when the encoder counts one on."""
    return velocity_of_a_step_1ps(config) * law_resolution_rad(config)


def velocity_of_a_step_1ps(config: Config) -> float:
    """What that filter gives at once for a step of the position, over the step.

    Without its compiled function, which takes 0.2 s to load: a configuration is read by every verb.
    """
    cutoff_Hz, rate_Hz = config.control.velocity_cutoff_Hz, config.loop.rate_Hz
    return rate_Hz * (-math.expm1(-math.tau * cutoff_Hz / rate_Hz) if cutoff_Hz else 1.0)


def link_period_s(config: Config, reducer: Reducer) -> float:
    """Of the heaviest link on a soft reducer whose motor stands still."""
    return math.tau * math.sqrt(config.margin.payload_range[1] * config.link_kgm2 / reducer.stiffness_Nmprad)


def most_twist_s2(config: Config, reducer: Reducer) -> float:
    """Largest steady twist of the reducer over the acceleration of its link: J_l / K.

    Of the heaviest link of margin.payload_range on a reducer that is softer by margin.stiffness_error.  The stiffness
    is that of a steady torque: hysteresis, which stiffens a small motion, adds nothing to a large one.
    """
    margin = config.margin
    return margin.payload_range[1] * config.link_kgm2 / ((1.0 - margin.stiffness_error) * reducer.stiffness_Nmprad)


def acceleration_beside_gravity_radps2(config: Config) -> float:
    """With the torque that gravity leaves; friction may help to brake, and is left out."""
    return (config.limits.torque_max_Nm - abs(config.joint.gravity_Nm)) / config.joint.inertia_kgm2


def turning_of(config: Config, acceleration_radps2: float) -> tuple[float, float]:
    """(acceleration, time in which it changes) of a motion that measures, which may have that acceleration.

    It twists a soft reducer by `most_twist_s2` of it: by TWIST_SHARE of joint_encoder.disagreement_max_rad at most.
    Where it jumps the law of a flexible joint, which compares the motor with the twist that is believed at once,
    answers with J (kp + kv filter) of that, and the link swings about it: it changes within a period of the link where
    that is more than TWIST_SHARE of limits.torque_max_Nm, or where the link is slow to come to rest.  0: it may jump.
    A link that is slower by a fifth, on a reducer softer by 30 %, swings by 0.19 of it then.
    """
    reducer, second, control = config.reducer, config.joint_encoder, config.control
    if reducer is None:
        return acceleration_radps2, 0.0
    if second is not None:
        most_radps2 = TWIST_SHARE * second.disagreement_max_rad / most_twist_s2(config, reducer)
        acceleration_radps2 = min(acceleration_radps2, most_radps2)
    rounding_s, answered_Nm = link_period_s(config, reducer), 0.0
    if control.kind == "flexible_joint" and (second is not None or config.encoder.side == "motor"):
        answered_ps2 = control.kp + control.kv * velocity_of_a_step_1ps(config)
        twist_rad = config.link_kgm2 / reducer.stiffness_Nmprad * acceleration_radps2
        answered_Nm = config.joint.inertia_kgm2 * answered_ps2 * twist_rad
    jumps = rounding_s < SWINGS_s and answered_Nm <= TWIST_SHARE * config.limits.torque_max_Nm
    return acceleration_radps2, 0.0 if jumps else rounding_s


def friction_constants(friction: Friction, reduction_ratio: float) -> Any:
    """`FrictionConstants` (joint rad/s, motor Nm) from the table as the user gave it."""
    from jointctl.firmware_py import friction as friction_model  # its kernels: `stop` does without them

    speed = RADPS_PER_UNIT[friction.velocity_unit] / (reduction_ratio if friction.velocity_side == "motor" else 1.0)
    scale = 1.0 / reduction_ratio if friction.torque_side == "joint" else 1.0

    def branch(d: FrictionDirection, negative: bool) -> Any:
        cubic = (d.a0, d.a1, d.a2, d.a3)
        printed = friction_model.PrintedBranch(d.tc_Nm, d.ts_Nm, d.ws, d.tv, cubic, d.knee, d.max)
        return friction_model.branch_constants(printed, negative=negative, radps_per_unit=speed, torque_scale=scale)

    constants = friction_model.friction_constants(branch(friction.positive, False), branch(friction.negative, True))
    _fill_condition(constants[0], friction, reduction_ratio)
    return constants


def _fill_condition(record: FrictionConstants, friction: Friction, reduction_ratio: float) -> None:
    load, warm, angle = friction.load, friction.temperature, friction.angle
    if load is not None:
        record.load_coulomb, record.load_viscous_spr = load.coulomb, load.viscous_spr
    if warm is not None:
        record.temperature_coulomb_pK, record.temperature_viscous_pK = warm.coulomb_pK, warm.viscous_pK
        record.reference_degC = warm.reference_degC
        record.lowest_degC, record.highest_degC = held_beyond_degC(warm)
    if angle is not None:
        fill_series(record.of_angle, reduction_ratio, (angle.share, angle.per_motor_turn, angle.phase_rad))
    warming = record.temperature_coulomb_pK, record.temperature_viscous_pK
    record.conditioned = int(any((record.load_coulomb, record.load_viscous_spr, *warming, record.of_angle.count)))


def fill_series(series: HarmonicSeries, ratio: float, waves: tuple[tuple[float, ...], ...]) -> None:
    """A `HarmonicSeries`; `waves`: amplitudes, periods a motor turn, phases [rad]."""
    series.count = len(waves[0])
    for i, (amplitude, per_motor_turn, phase_rad) in enumerate(zip(*waves, strict=True)):
        series.amplitude[i] = amplitude
        series.turns_prad[i] = ratio * per_motor_turn / math.tau
        series.phase_turns[i] = phase_rad / math.tau


def held_beyond_degC(warm: FrictionTemperature) -> tuple[float, float]:
    """The temperatures beyond which the factors of friction are held."""
    low, high = warm.lowest_degC, warm.highest_degC
    reference = warm.reference_degC
    return reference - HELD_BEYOND_K if low is None else low, reference + HELD_BEYOND_K if high is None else high


def static_frictions_Nm(config: Config, friction: Friction) -> tuple[float, float]:
    """Of either direction at the joint, both positive; without what load, temperature and angle do to it."""
    ratio = config.joint.reduction_ratio if friction.torque_side == "motor" else 1.0
    return abs(friction.positive.ts_Nm) * ratio, abs(friction.negative.ts_Nm) * ratio


def free_torque_Nm(config: Config) -> float:
    """What static friction and gravity leave of limits.torque_max_Nm; negative where they take more than that."""
    return config.limits.torque_max_Nm - (static_friction_Nm(config) or 0.0) - abs(config.joint.gravity_Nm)


def friction_fall_Nmspr(config: Config) -> float:
    """How steeply friction falls where the joint begins to slide, of the steeper direction; 0 where none is known."""
    if config.friction is None:
        return 0.0
    ratio = config.joint.reduction_ratio
    constants = friction_constants(config.friction, ratio)[0]
    sides = (constants.positive, constants.negative)
    return max(ratio * float((one.static_Nm - one.coulomb_Nm) / one.stribeck_speed_radps) for one in sides)


def static_friction_Nm(config: Config) -> float | None:
    """The larger one of both directions, at the joint, under gravity and at the temperature at which it is greatest.

    None where no friction is configured.
    """
    friction = config.friction
    if friction is None:
        return None
    static_Nm = max(static_frictions_Nm(config, friction))
    if friction.load is not None:
        static_Nm += friction.load.coulomb * abs(config.joint.gravity_Nm)
    if friction.temperature is not None:
        warm = friction.temperature
        ends = held_beyond_degC(warm)
        static_Nm *= max(math.exp(-warm.coulomb_pK * (end - warm.reference_degC)) for end in ends)
    if friction.angle is not None:
        static_Nm *= 1.0 + sum(map(abs, friction.angle.share))
    return static_Nm
