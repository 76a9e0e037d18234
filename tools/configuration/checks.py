"""Checks between sections of a configuration: the values are each in range, but do they fit together?"""

from __future__ import annotations

import itertools
import math

from jointctl.firmware_py.records import KNEES
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import RADPS_PER_UNIT, velocity_of_a_count_radps
from jointctl.tools.configuration.sections import (
    Encoder,
    Friction,
    FrictionAngle,
    FrictionDirection,
    Reducer,
    ReducerMap,
    Ripple,
    Trajectory,
)

OBSERVING = ("computed_torque_observer", "flexible_joint")  # laws with a disturbance observer
SWING_PERIODS = 4.0  # that half a swing takes at least: a faster one no sampled loop can follow
LARGEST_SHARE = 0.9  # of the friction that may go with the angle
LARGEST_SLOPE = 0.5  # of the kinematic error against the angle: beyond 1 the link would turn against the motor
ANOTHER_UNIT = 10.0  # factor between two values of the same thing beyond which one is in another unit
LIGHTEST_MOTOR = 0.001  # of the joint's inertia; with 1 : 32 and more, that of the motor itself is less
CURVE_POINTS = 200  # at which a friction curve is looked at
SWITCH_rad, SWITCH_radps = 1e-3, 1e-2  # what rounding of the numbers in a file may leave at a switch


def trajectory_extremes(trajectory: Trajectory) -> tuple[float, float, float] | None:
    """(lowest position [rad], highest position [rad], highest speed [rad/s]); None where a file must be read first.

    A sine is taken with its full amplitude even if `duration_s` ends before the peak.
    """
    if trajectory.kind == "sine":
        parts = [trajectory] + ([trajectory.switch] if trajectory.switch else [])
        low = min(p.offset_rad - abs(p.amplitude_rad) for p in parts)
        high = max(p.offset_rad + abs(p.amplitude_rad) for p in parts)
        return low, high, max(abs(p.amplitude_rad) * math.tau * p.frequency_Hz for p in parts)
    if trajectory.kind == "hold":
        return trajectory.position_rad, trajectory.position_rad, 0.0
    if trajectory.kind == "table":
        return None
    ends = trajectory.start_rad, trajectory.target_rad
    distance = abs(ends[1] - ends[0])
    if trajectory.kind == "min_jerk":
        # the quintic's peak speed is 15/8 of its mean
        return min(ends), max(ends), 1.875 * distance / trajectory.move_s
    peak = min(trajectory.speed_radps, math.sqrt(distance * trajectory.acceleration_radps2))
    return min(ends), max(ends), peak


def extremes_problems(
    config: Config, low_rad: float, high_rad: float, speed_radps: float, start_rad: float | None = None
) -> list[str]:
    """A trajectory against the limits; also called once a table has been read.

    `start_rad`: where the joint stands already, from which it may come back without the room that the motor needs.
    """
    limits = config.limits
    allowed = f"[{limits.position_min_rad:g}..{limits.position_max_rad:g}]"
    found = []
    ends = {"position": low_rad} if low_rad == high_rad else {"lowest position": low_rad, "highest position": high_rad}
    for end, value in ends.items():
        if not limits.position_min_rad <= value <= limits.position_max_rad:
            found.append(f"trajectory: {end} (={value:g} rad) must be in {allowed}, the limits.position_*_rad")
    if not found:
        found += _room_problems(config, low_rad, high_rad, start_rad)
    if not speed_radps <= limits.velocity_max_radps:
        found.append(
            f"trajectory: peak speed (={speed_radps:g} rad/s) must be in [0..{limits.velocity_max_radps:g}], "
            "up to limits.velocity_max_radps"
        )
    return found


def switch_problems(trajectory: Trajectory) -> list[str]:
    """The second sine must go on where the first one is, and as fast: a step of the reference asks for all torque."""
    if trajectory.kind != "sine" or (switch := trajectory.switch) is None:
        return []
    if 0.0 < trajectory.duration_s <= switch.at_s:
        return []
    places, speeds = [], []
    for part in (trajectory, switch):
        omega = math.tau * part.frequency_Hz
        angle = omega * (switch.at_s + part.shift_s)
        places.append(part.offset_rad + part.amplitude_rad * math.sin(angle))
        speeds.append(part.amplitude_rad * omega * math.cos(angle))
    found = []
    for name, (before, after), allowed, unit in (
        ("position", places, SWITCH_rad, "rad"), ("speed", speeds, SWITCH_radps, "rad/s"),
    ):  # fmt: skip
        if not abs(after - before) <= allowed:
            found.append(
                f"trajectory.switch.at_s (={switch.at_s:g}): the {name} would jump from {before:.4f} to {after:.4f} "
                f"{unit}; it may by {allowed:g}: correct shift_s, offset_rad or amplitude_rad of the second sine"
            )
    return found


def problems_between_sections(config: Config) -> list[str]:
    """One line for each contradiction, without the file name."""
    return [
        *_limit_problems(config),
        *_control_problems(config),
        *_friction_problems(config),
        *_reducer_problems(config),
        *_ripple_problems(config),
        *_drive_problems(config),
    ]


def range_problems(low_rad: float, high_rad: float) -> list[str]:
    """What is wrong with the ends of the range of motion."""
    if low_rad < high_rad:
        return []
    return [f"limits.position_min_rad (={low_rad:g}) must be less than limits.position_max_rad (={high_rad:g})"]


def _limit_problems(config: Config) -> list[str]:
    limits, loop = config.limits, config.loop
    low, high = limits.position_min_rad, limits.position_max_rad
    found = []
    if out_of_order := range_problems(low, high):
        return out_of_order
    if limits.following_error_max_rad >= high - low:
        error = limits.following_error_max_rad
        found.append(
            f"limits.following_error_max_rad (={error:g}) must be less than the range of motion, {high - low:g}"
        )
    if limits.standstill_radps >= limits.velocity_max_radps:
        found.append(
            f"limits.standstill_radps (={limits.standstill_radps:g}) must be less than "
            f"limits.velocity_max_radps (={limits.velocity_max_radps:g})"
        )
    of_a_count = velocity_of_a_count_radps(config)
    if limits.velocity_max_radps <= of_a_count:
        found.append(
            f"limits.velocity_max_radps (={limits.velocity_max_radps:g}) must be more than {of_a_count:.3g}, what one "
            f"count of the encoder reads behind control.velocity_cutoff_Hz (={config.control.velocity_cutoff_Hz:g})"
        )
    step = limits.velocity_max_radps / loop.rate_Hz
    if limits.position_jump_max_rad < step:
        found.append(
            f"limits.position_jump_max_rad (={limits.position_jump_max_rad:g}) must be at least {step:g}, "
            "one period at limits.velocity_max_radps"
        )
    for key in ("sample_age_max_s", "saturation_max_s", "skipped_max_s"):
        value = getattr(limits, key)
        if value * loop.rate_Hz < 1.0:
            found.append(f"limits.{key} (={value:g}) must be at least one period, {1.0 / loop.rate_Hz:g} s")
    if limits.swing_slowest_s * loop.rate_Hz < SWING_PERIODS:
        found.append(
            f"limits.swing_slowest_s (={limits.swing_slowest_s:g}) must be at least {SWING_PERIODS:g} periods, "
            f"{SWING_PERIODS / loop.rate_Hz:g} s"
        )
    extremes = trajectory_extremes(config.trajectory)
    if extremes is not None:
        found += extremes_problems(config, *extremes)
    found += switch_problems(config.trajectory)
    braking = limits.velocity_max_radps / config.sequence.brake_radps2
    if braking >= config.sequence.stop_timeout_s:
        found.append(
            f"sequence.stop_timeout_s (={config.sequence.stop_timeout_s:g}) must be more than {braking:g}, "
            "the braking time from limits.velocity_max_radps"
        )
    return found


def _control_problems(config: Config) -> list[str]:
    control, rate = config.control, config.loop.rate_Hz
    found = []
    if control.velocity_cutoff_Hz >= rate / 2.0:
        found.append(
            f"control.velocity_cutoff_Hz (={control.velocity_cutoff_Hz:g}) must be in [0..{rate / 2.0:g}), "
            "below half of loop.rate_Hz"
        )
    # explicit integration of the error dynamics: beyond this even the ideal sampled loop is unstable
    if control.kv + control.kp / rate >= 2.0 * rate:
        found.append(f"control.kv (={control.kv:g}) and control.kp (={control.kp:g}) are too high for {rate:g} Hz")
    if (control.kind in OBSERVING) != (control.observer_radps > 0.0):
        found.append(
            f"control.observer_radps (={control.observer_radps:g}) must be more than 0 with control.kind "
            f'"computed_torque_observer" or "flexible_joint" and 0 with any other (={control.kind})'
        )
    if control.velocity_filter == "kalman" and (
        control.kind != "computed_torque_observer" or not control.velocity_cutoff_Hz
    ):
        found.append(
            'control.velocity_filter (=kalman) needs control.kind "computed_torque_observer" '
            f"(={control.kind}) and control.velocity_cutoff_Hz above 0 (={control.velocity_cutoff_Hz:g})"
        )
    if control.observer_paired and (control.kind != "computed_torque_observer" or control.velocity_filter == "kalman"):
        found.append(
            'control.observer_paired (=true) needs control.kind "computed_torque_observer" '
            f'(={control.kind}) with control.velocity_filter "low_pass" (={control.velocity_filter})'
        )
    if control.kind != "pid" and control.ki:
        found.append(f'control.ki (={control.ki:g}) must be 0 unless control.kind is "pid" (={control.kind})')
    if control.learning is not None and control.kind not in OBSERVING:
        found.append(
            f'[control.learning] needs control.kind "computed_torque_observer" or "flexible_joint" (={control.kind}): '
            "the observer takes over when learning starts anew"
        )
    if control.adaptation is not None and (control.kind not in OBSERVING or control.feed_forward != "lugre_desired"):
        found.append(
            '[control.adaptation] needs control.kind "computed_torque_observer" or "flexible_joint" '
            f'(={control.kind}) and control.feed_forward "lugre_desired" (={control.feed_forward})'
        )
    if control.zero_rule == "linear" and control.zero_band_radps == 0.0:
        found.append('control.zero_band_radps (=0) must be more than 0 for control.zero_rule = "linear"')
    if control.weight_limit_Nm and abs(control.initial_weight_Nm) > control.weight_limit_Nm:
        found.append(
            f"control.initial_weight_Nm (={control.initial_weight_Nm:g}) must be in "
            f"[{-control.weight_limit_Nm:g}..{control.weight_limit_Nm:g}], the control.weight_limit_Nm"
        )
    return found


def _reducer_problems(config: Config) -> list[str]:
    """[reducer] and the law that needs it."""
    reducer, control = config.reducer, config.control
    if reducer is None:
        return ["[reducer] is missing: control.kind (=flexible_joint) needs it"] if _is_flexible(config) else []
    found = []
    low, high = config.margin.payload_range
    if not low <= 1.0 <= high:
        found.append(
            f"margin.payload_range (=[{low:g}, {high:g}]) must be two factors in ascending order with 1 between them"
        )
    if reducer.motor_inertia_kgm2 >= config.joint.inertia_kgm2:
        found.append(
            f"reducer.motor_inertia_kgm2 (={reducer.motor_inertia_kgm2:g}) must be less than joint.inertia_kgm2 "
            f"(={config.joint.inertia_kgm2:g}), which is that of motor and link together"
        )
    knees, beyond = reducer.knees_Nm, reducer.stiffness_beyond_Nmprad
    slopes = (reducer.stiffness_Nmprad, *beyond)
    if len(knees) > KNEES or list(knees) != sorted(set(knees)) or (knees and knees[0] <= 0.0):
        found.append(f"reducer.knees_Nm (={list(knees)}) must be at most {KNEES} torques in ascending order, above 0")
    elif len(beyond) != len(knees):
        found.append(f"reducer.stiffness_beyond_Nmprad (={list(beyond)}) must be {len(knees)}, one for each knee")
    elif list(slopes) != sorted(slopes):
        found.append(
            f"reducer.stiffness_beyond_Nmprad (={list(beyond)}) must rise from reducer.stiffness_Nmprad "
            f"(={reducer.stiffness_Nmprad:g})"
        )
    elif (twist := _most_twist_rad(config)) >= config.limits.following_error_max_rad:
        found.append(
            f"limits.following_error_max_rad (={config.limits.following_error_max_rad:g}) must be more than "
            f"{twist:.4g}, by which the reducer twists at limits.torque_max_Nm"
        )
    found += _unit_problems(config, reducer)
    if reducer.map is not None:
        found += _map_problems(config, reducer.map)
    if not _is_flexible(config):
        return found
    if control.feed_forward == "measured":
        found.append(
            'control.feed_forward (=measured) must be none, desired or lugre_desired for control.kind "flexible_joint"'
        )
    if not control.filtered_error_rate:
        found.append('control.filtered_error_rate (=false) must be true for control.kind "flexible_joint"')
    if config.joint_encoder is not None and config.encoder.side != "motor":
        found.append(
            'encoder.side (=joint) must be "motor" for control.kind "flexible_joint" beside [joint_encoder]: '
            "are the two encoders swapped?"
        )
    return found


def _is_flexible(config: Config) -> bool:
    return config.control.kind == "flexible_joint"


def _unit_problems(config: Config, reducer: Reducer) -> list[str]:
    """What is so far from the rest that it is in another unit: `check` would not see the resonance."""
    softest, stiffest = reducer.stiffness_Nmprad, max((reducer.stiffness_Nmprad, *reducer.stiffness_beyond_Nmprad))
    loop, second, found = reducer.loop_stiffness_Nmprad, config.joint_encoder, []
    if reducer.motor_inertia_kgm2 < (least := LIGHTEST_MOTOR * config.joint.inertia_kgm2):
        found.append(
            f"reducer.motor_inertia_kgm2 (={reducer.motor_inertia_kgm2:g}) must be at least {least:g}, "
            f"{LIGHTEST_MOTOR:g} of joint.inertia_kgm2: it is at the joint, that of the motor times the ratio squared"
        )
    if stiffest > ANOTHER_UNIT * softest:
        found.append(
            f"reducer.stiffness_beyond_Nmprad (={list(reducer.stiffness_beyond_Nmprad)}) must be at most "
            f"{ANOTHER_UNIT * softest:g}, {ANOTHER_UNIT:g} times reducer.stiffness_Nmprad (={softest:g})"
        )
    if loop is not None and loop > ANOTHER_UNIT * stiffest:
        found.append(
            f"reducer.loop_stiffness_Nmprad (={loop:g}) must be at most {ANOTHER_UNIT * stiffest:g}, "
            f"{ANOTHER_UNIT:g} times that of a steady torque: hysteresis doubles it at most"
        )
    critical = math.sqrt((loop or softest) * config.joint.inertia_kgm2)  # with the inertia halved it is greatest
    if reducer.damping_Nmspr > critical:
        found.append(
            f"reducer.damping_Nmspr (={reducer.damping_Nmspr:g}) must be at most {critical:.4g}, the critical one of "
            "two equal masses: reducers have 2 to 6 % of it"
        )
    if second is not None and second.stiffness_Nmprad is not None:
        least, most = softest / ANOTHER_UNIT, stiffest * ANOTHER_UNIT
        if not least <= second.stiffness_Nmprad <= most:
            found.append(
                f"joint_encoder.stiffness_Nmprad (={second.stiffness_Nmprad:g}) must be in [{least:g}..{most:g}]: "
                f"reducer.stiffness_Nmprad (={softest:g}) is of the same reducer"
            )
    return found


def _most_twist_rad(config: Config) -> float:
    """By which the motor is ahead of the link at the torque limit, kinematic error included; 0 for a rigid joint."""
    reducer, torque_Nm = config.reducer, config.limits.torque_max_Nm
    if reducer is None or not _is_flexible(config):
        return 0.0
    slopes = (reducer.stiffness_Nmprad, *reducer.stiffness_beyond_Nmprad)
    parts = itertools.pairwise((0.0, *reducer.knees_Nm, math.inf))
    twist = sum(max(min(torque_Nm, b) - a, 0.0) / slope for (a, b), slope in zip(parts, slopes, strict=False))
    return twist + (0.0 if reducer.map is None else sum(map(abs, reducer.map.kinematic_error_rad)))


def _room_problems(config: Config, low_rad: float, high_rad: float, start_rad: float | None) -> list[str]:
    """Whether the motor, which is ahead of the link by the twist, stays inside the limits as well (theta_d)."""
    limits, twist = config.limits, _most_twist_rad(config)
    if config.encoder.side == "joint" and config.joint_encoder is None:
        return []
    found = []
    for key, end, needed, enough in (
        ("position_min_rad", low_rad, low_rad - twist, limits.position_min_rad <= low_rad - twist),
        ("position_max_rad", high_rad, high_rad + twist, limits.position_max_rad >= high_rad + twist),
    ):
        if not enough and end != start_rad:
            found.append(
                f"limits.{key} (={getattr(limits, key):g}) must leave room for the motor, which is ahead of the link "
                f"by up to {twist:.4g}: {needed:.5g} is reached"
            )
    return found


def _mounting_problems(
    section: str, made: ReducerMap | Ripple | FrictionAngle, encoder: Encoder, why: str
) -> list[str]:
    return [
        f"{section}.{key} (={getattr(made, key)}) differs from encoder.{key} (={getattr(encoder, key)}): {why}"
        for key in ("direction", "zero_counts")
        if getattr(made, key) not in (None, getattr(encoder, key))  # None: not checked
    ]


def _map_problems(config: Config, made: ReducerMap) -> list[str]:
    """A map belongs to one mounting of the motor's encoder, and its lists to each other."""
    encoder = config.encoder
    if encoder.side != "motor":
        return ['[reducer.map] needs encoder.side = "motor": it is a map of the motor angle']
    found = _mounting_problems("reducer.map", made, encoder, "the map was made for another mounting; make a new one")
    for name, unit in (("kinematic_error", "rad"), ("torque_ripple", "Nm")):
        counts = [len(getattr(made, f"{name}_{rest}")) for rest in (unit, "per_motor_turn", "phase_rad")]
        if len(set(counts)) > 1:
            found.append(
                f"reducer.map.{name}_{unit} must be as long a list as its per_motor_turn and phase_rad, "
                f"{' and '.join(map(str, counts))} are given"
            )
    waves = zip(made.kinematic_error_rad, made.kinematic_error_per_motor_turn, strict=False)
    slope = config.joint.reduction_ratio * sum(abs(amplitude * order) for amplitude, order in waves)
    if slope > LARGEST_SLOPE:
        found.append(
            f"reducer.map.kinematic_error_rad (={list(made.kinematic_error_rad)}) must be so small that the link never "
            f"turns against the motor: times periods and joint.reduction_ratio it is {slope:.3g}, {LARGEST_SLOPE:g} is "
            "allowed"
        )
    return found + _ripple_torque_problems("reducer.map.torque_ripple_Nm", made.torque_ripple_Nm, config)


def _ripple_torque_problems(name: str, amplitudes_Nm: tuple[float, ...], config: Config) -> list[str]:
    """It is fed forward: it must leave torque to move the joint with."""
    torque_Nm, largest_Nm = sum(map(abs, amplitudes_Nm)), config.limits.torque_max_Nm
    if torque_Nm < largest_Nm:
        return []
    return [f"{name} (={list(amplitudes_Nm)}) must be less than limits.torque_max_Nm (={largest_Nm:g}), added up"]


def _length_problems(key: str, amplitudes: tuple[float, ...], series: Ripple | FrictionAngle) -> list[str]:
    counts = [len(values) for values in (amplitudes, series.per_motor_turn, series.phase_rad)]
    if len(set(counts)) == 1:
        return []
    given = ", ".join(map(str, counts))
    return [f"{key}, per_motor_turn and phase_rad (={given}) must be equally many numbers"]


def _ripple_problems(config: Config) -> list[str]:
    """[ripple] belongs to one mounting of the encoder, to a law that takes the joint as rigid, and is fed once."""
    made, encoder = config.ripple, config.encoder
    if made is None:
        return []
    why = "it was measured with another mounting; `jointctl map` measures anew"
    found = _mounting_problems("ripple", made, encoder, why)
    found += _length_problems("ripple.torque_Nm", made.torque_Nm, made)
    found += _ripple_torque_problems("ripple.torque_Nm", made.torque_Nm, config)
    if _is_flexible(config):
        found.append('[ripple] is not for control.kind "flexible_joint": there it is torque_ripple of [reducer.map]')
    adaptation = config.control.adaptation
    if adaptation is not None and adaptation.ripple_per_motor_turn:
        found.append("[ripple] does not go with control.adaptation.ripple_per_motor_turn: it would be fed twice")
    return found


def _cubic(d: FrictionDirection, v: float) -> float:
    return d.a0 + v * (d.a1 + v * (d.a2 + v * d.a3))


def _friction_problems(config: Config) -> list[str]:
    friction, found = config.friction, []
    if friction is None:
        if config.control.feed_forward != "none":
            found.append(f"[friction] is missing: control.feed_forward (={config.control.feed_forward}) needs it")
        if config.virtual is not None and config.virtual.friction_kind != "none" and config.virtual.friction is None:
            found.append(f"[friction] is missing: virtual.friction_kind (={config.virtual.friction_kind}) needs it")
    elif config.control.feed_forward == "lugre_desired" and friction.lugre is None:
        found.append("[friction.lugre] is missing: control.feed_forward (=lugre_desired) needs it")
    if friction is not None:
        shape = _shape_problems("friction", friction) + _angle_problems("friction", friction, config.encoder)
        found += shape or _feed_forward_problems(config, friction)
    if config.virtual is not None and config.virtual.friction is not None:
        true = config.virtual.friction
        found += _shape_problems("virtual.friction", true) + _angle_problems("virtual.friction", true, config.encoder)
    return found


def _sliding_Nm(d: FrictionDirection, sign: float, speed: float) -> float:
    """Of the curve as the law continues it, `speed` > 0 in its own unit; positive where it opposes the motion."""
    if speed <= sign * d.knee:
        return d.tc_Nm + (d.ts_Nm - d.tc_Nm) * math.exp(-speed / d.ws) + d.tv * speed
    inside = sign * min(speed, sign * d.max)
    slope = d.a1 + inside * (2.0 * d.a2 + 3.0 * d.a3 * inside)
    return sign * _cubic(d, inside) + max(speed - sign * d.max, 0.0) * slope


def _feed_forward_problems(config: Config, friction: Friction) -> list[str]:
    """It must oppose the motion up to the velocity limit: where it does not, LuGre has no steady state."""
    if config.control.feed_forward == "none":
        return []
    ratio = config.joint.reduction_ratio if friction.velocity_side == "motor" else 1.0
    top = config.limits.velocity_max_radps * ratio / RADPS_PER_UNIT[friction.velocity_unit]
    found = []
    for name, direction, sign in (("positive", friction.positive, 1.0), ("negative", friction.negative, -1.0)):
        speeds = [top * k / CURVE_POINTS for k in range(1, CURVE_POINTS + 1)]
        against = next((v for v in speeds if not _sliding_Nm(direction, sign, v) >= 0.0), None)
        if against is not None:
            found.append(
                f"friction.{name}: the curve must oppose the motion up to limits.velocity_max_radps "
                f"(={config.limits.velocity_max_radps:g}); at {against:.4g} {friction.velocity_unit} it does not"
            )
    return found


def _angle_problems(section: str, friction: Friction, encoder: Encoder) -> list[str]:
    """[friction.angle]: as many numbers each, friction stays against the motion, and the mounting is that of then."""
    made = friction.angle
    if made is None:
        return []
    found = _length_problems(f"{section}.angle.share", made.share, made)
    if not sum(map(abs, made.share)) <= LARGEST_SHARE:
        found.append(f"{section}.angle.share (={list(made.share)}) must add up to {LARGEST_SHARE:g} at most, unsigned")
    return found + _mounting_problems(f"{section}.angle", made, encoder, "it was identified with another mounting")


def _shape_problems(section: str, friction: Friction) -> list[str]:
    found = []
    for name, direction, sign in (("positive", friction.positive, 1.0), ("negative", friction.negative, -1.0)):
        knee, maximum = sign * direction.knee, sign * direction.max
        if not 0.0 <= knee <= maximum or maximum == 0.0:
            order = "0 <= knee <= max" if sign > 0.0 else "max <= knee <= 0"
            found.append(f"{section}.{name}.knee (={direction.knee:g}) and max (={direction.max:g}) must be {order}")
        elif sign * _cubic(direction, direction.knee) < 0.0 or sign * _cubic(direction, direction.max) < 0.0:
            found.append(f"{section}.{name}: a0..a3 must give friction that opposes the motion from knee to max")
    return found


def _drive_problems(config: Config) -> list[str]:
    found = config.drive.problems(config)
    if abs(config.joint.gravity_Nm) < config.limits.torque_max_Nm:
        return found
    return [
        f"joint.gravity_Nm (={config.joint.gravity_Nm:g}) must be less than limits.torque_max_Nm "
        f"(={config.limits.torque_max_Nm:g}): the joint could not be held",
        *found,
    ]
