"""From a checked configuration to the controller's records; every unit is converted here, and only here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.flexible_joint import SEEN_Hz
from jointctl.firmware_py.kernel import plain
from jointctl.firmware_py.law import solve_lyapunov_p
from jointctl.firmware_py.live_change import gains_of
from jointctl.firmware_py.motion_records import ChangeConstants, Gains, StreamConstants, TrajectoryConstants
from jointctl.firmware_py.observers import low_pass_gain, set_kalman_gains
from jointctl.firmware_py.records import (
    FED_HISTORY,
    NEURONS,
    AdaptationConstants,
    AxisConstants,
    FlexibleConstants,
    LawConstants,
    LimitConstants,
    SequenceConstants,
    SwingConstants,
    VelocityConstants,
)
from jointctl.firmware_py.safety import PUSHED_CYCLES
from jointctl.firmware_py.schema import dtype_of, new
from jointctl.firmware_py.states import (
    CommandKind,
    ControllerKind,
    Encoders,
    FeedForward,
    LimitSource,
    TrajectoryKind,
    ZeroSpeedRule,
)
from jointctl.firmware_py.trajectory import approach_duration_s, approach_start, ends_meet, peak_of
from jointctl.tools.configuration.checks import extremes_problems
from jointctl.tools.configuration.config import Adaptation, Config, Control, raise_if
from jointctl.tools.configuration.conversions import (
    acceleration_beside_gravity_radps2,
    fill_series,
    friction_constants,
    law_resolution_rad,
    link_period_s,
    period_s,
    static_friction_Nm,
)
from jointctl.tools.configuration.load import table_from_csv
from jointctl.tools.configuration.sections import Hold, Reducer, Section, Trapezoid

# the paper's centres, in rad and in rad/s: -c_p, 0, c_p with c_p = 1e-2 [-5 -3 -1 -0.8 -0.4 -0.1 -0.05]
_PAPER_HALF = (0.05, 0.03, 0.01, 0.008, 0.004, 0.001, 0.0005)
PAPER_CENTRES = (*_PAPER_HALF, 0.0, *(-c for c in _PAPER_HALF))
APPROACH_MIN_S = 1.0
ROUNDING_CYCLES = 10  # that the acceleration of a trapezoid with limited jerk changes in, at least
MOVE_MIN_S = 0.2  # of a move to a new set-point, however near
# way of the reference at a standing reading, as a share of the following error that is allowed: without friction
# feed-forward a healthy joint stands that long before it breaks away
FROZEN_SHARE, FROZEN_SHARE_WITHOUT_MODEL = 0.1, 0.5
HUNTING_COUNTS, HUNTING_rad = 4.0, 1e-4  # peak to peak
FROZEN_FRICTION = 1.5  # times the static friction: what a healthy joint does not stand still under
FROZEN_WAYS = 2.0  # of the tolerance, that what is beyond the friction moves a rigid joint by before it counts
HEARTBEATS_MISSED = 3  # periods of the drive's own heartbeat until it counts as silent
MOVED_COUNTS = 4  # encoder counts by which a joint that nobody has moved may seem to have moved
FROZEN_COUNTS = 4  # encoder counts by which a standing reading may flicker
NOISE_S = 0.25  # that the mean change of the torque command is taken over
# share of the rate limit that is noise too, where the limit is lower than the noise that is allowed
NOISE_OF_RATE = 0.6
FOLLOWING_SHARE = 0.3  # of the torque limit, that goes at most into the kinematic error of a reducer
RIPPLE_MOST = 4.0  # of what the adaptation takes for torque ripple, times what is expected
RIPPLE_SHARE = 0.7 / 60.0  # of limits.torque_max_Nm, that is expected of it
# what the adaptation cannot explain: of joints of usual size, and the least and most of other ones, static frictions
UNEXPLAINED_Nm, LEAST_UNEXPLAINED, MOST_UNEXPLAINED = 5.0, 0.2, 4.0
WARMING_S = 2.0  # in which the friction feed-forward follows a new reading of the temperature
APPROACH_SPEED = 0.25  # share of limits.velocity_max_radps that an automatic approach may use


def axis_constants(config: Config, table: np.ndarray, *, start_position_rad: float | None = None) -> Any:
    """A record array of one `AxisConstants`; `table` is that of `trajectory_table`.

    `start_position_rad` is where the joint stands; a joint that is elsewhere at the start ends the run.  Where it is
    not known, that is not checked, and `approach_s = "auto"` takes the whole range of motion as the distance.
    """
    constants = new(AxisConstants)
    axis = constants[0]
    _fill_law(axis.law, config)
    _fill_velocity(axis.velocity, config, config.control.velocity_cutoff_Hz)
    fill_trajectory(axis.trajectory, config, table)
    _fill_limits(axis.limits, config)
    _fill_sequence(axis.sequence, config, table, start_position_rad)
    fill_change(axis.change, axis.law, config)
    _fill_stream(axis.stream, config)
    _fill_own_loop(axis, config)
    return constants


def table_constants(config: Config, table: np.ndarray, duration_s: float, start_position_rad: float) -> Any:
    """As `axis_constants`, for `duration_s` along `table`, once, instead of the configured motion."""
    constants = axis_constants(config, table, start_position_rad=start_position_rad)
    trajectory = constants[0].trajectory
    trajectory.kind, trajectory.repeats = TrajectoryKind.TABLE, 0
    trajectory.table_rows, trajectory.duration_s = len(table), duration_s
    return constants


def _fill_own_loop(axis: AxisConstants, config: Config) -> None:
    """What a drive gets that closes its position or velocity loop itself."""
    sent, record = config.drive.sent_with_target(config.loop.rate_Hz), axis.velocity_command
    if sent is None:
        return
    axis.command_kind = config.drive.own_loop()
    record.position_gain_ps, record.lead_s = sent.position_gain_ps, sent.lead_s
    record.feeds_torque = int(sent.torque_offset)
    # no less than a stop is planned with: a target that fell behind it would go on beyond the limits of position
    record.acceleration_max_radps2 = max(acceleration_beside_gravity_radps2(config), config.sequence.brake_radps2)
    second = config.joint_encoder
    record.from_second = int(second is not None and second.law == "joint_encoder")


def free_constants(config: Config, start_rad: float) -> Any:
    """A record array of one `AxisConstants`: at rest at `start_rad`, for set-points; no one need be alive."""
    hold = Hold(kind="hold", duration_s=0.0, position_rad=start_rad)
    held = config.changed(trajectory=hold, sequence__approach_s=0.0)
    constants = axis_constants(held, np.zeros((1, 5)), start_position_rad=start_rad)
    constants[0].trajectory.kind = TrajectoryKind.STREAM
    return constants


def expect_client(constants: np.recarray, config: Config) -> None:
    """The loop ends the run when the program that commands the joint has been silent for `stream.client_timeout_s`."""
    constants["stream"]["client_timeout_ns"] = round(config.stream.client_timeout_s * 1e9)


def trajectory_table(config: Config) -> np.ndarray:
    """Rows (N, 5) of a table trajectory, checked against the limits; for the other kinds one row of zeros.

    This reads trajectory.file: once for each run (`tools.session.plan`).
    """
    path, trajectory = config.table_path, config.trajectory
    if path is None or trajectory.kind != "table":
        return np.zeros((1, 5))
    try:
        table = table_from_csv(path, trajectory.column)
    except (ValueError, OSError) as error:
        raise ConfigurationError(f"{config.path}: trajectory.file: {error}") from None
    if trajectory.repeat and not ends_meet(table):
        raise ConfigurationError(f"{config.path}: trajectory.repeat (=True) needs a table that ends where it begins")
    constants = new(TrajectoryConstants)
    constants[0].kind, constants[0].table_rows = TrajectoryKind.TABLE, len(table)
    peak = peak_of(constants[0], table)
    problems = extremes_problems(config, peak.position_min_rad, peak.position_max_rad, peak.velocity_radps)
    raise_if([f"{config.path}: {line}" for line in problems])
    return table


def stacked_tables(tables: Sequence[np.ndarray]) -> np.ndarray:
    """float64 (axes, rows, 5): the tables of several axes; a shorter one ends with rows that no one reads."""
    rows = max(len(table) for table in tables)
    return np.stack([np.pad(table, ((0, rows - len(table)), (0, 0))) for table in tables])


def _copy(record: object, section: Section, *names: str) -> None:
    """Values that record and section have by the same name, hence in the same unit."""
    for name in names:
        setattr(record, name, getattr(section, name))


def _fill_law(law: LawConstants, config: Config) -> None:
    control, joint = config.control, config.joint
    law.kind = ControllerKind[control.kind.upper()]
    law.feed_forward = FeedForward[control.feed_forward.upper()]
    law.zero_rule = ZeroSpeedRule[control.zero_rule.upper()]
    _copy(law, control, "filtered_error_rate", "kp", "kv", "ki", "integral_limit_rads", "zero_band_radps")
    _copy(law, joint, "inertia_kgm2", "coriolis_Nmspr", "gravity_Nm", "gravity_zero_rad", "reduction_ratio")
    law.period_s = period_s(config)
    law.observer.bandwidth_radps = control.observer_radps
    law.observer.delay_cycles = control.observer_delay_cycles
    law.observer.paired = control.observer_paired
    if control.velocity_filter == "kalman":
        law.observer.kalman = 1
        law.observer.cutoff_Hz = control.velocity_cutoff_Hz
        plain(set_kalman_gains)(law.observer, period_s(config))
    if control.learning is not None:
        _copy(law.learning, control.learning, "gain", "error_gain_ps2", "lead_cycles", "blend_s")
        law.learning.half_width = control.learning.half_width_cycles
        law.learning.growth = config.limits.learning_growth
    law.feed_forward_lead_s = lead_s = _feed_forward_lead_s(config)
    if control.adaptation is not None:
        _fill_adaptation(law.adaptation, config, control.adaptation)
        if control.observer_paired or control.kind == "flexible_joint":
            cycles = round(lead_s * config.loop.rate_Hz) or control.observer_delay_cycles + 1
            law.adaptation.late_cycles = min(cycles, FED_HISTORY - 1)
    if config.friction is not None:
        law.friction = friction_constants(config.friction, joint.reduction_ratio)[0]
        law.temperature.gain = -math.expm1(-period_s(config) / WARMING_S)
        if config.friction.lugre is not None:
            _copy(law.lugre, config.friction.lugre, "stiffness_Nmprad", "damping_Nmspr")
    if config.reducer is not None:
        _fill_flexible(law.flexible, config, config.reducer)
    ripple = config.ripple
    if ripple is not None:
        series = law.flexible.torque_ripple
        fill_series(series, joint.reduction_ratio, (ripple.torque_Nm, ripple.per_motor_turn, ripple.phase_rad))
    network = law.network
    _, p12, p22 = solve_lyapunov_p(control.kp, control.kv, control.lyapunov_q[0], control.lyapunov_q[-1])
    network.p_b[0] = p12 / joint.inertia_kgm2
    network.p_b[1] = p22 / joint.inertia_kgm2
    centres, widths = hidden_layer(control)
    for i in range(NEURONS):
        network.centres[i, 0], network.centres[i, 1] = centres[i]
        network.inverse_width[i] = 0.5 / widths[i] ** 2
    _copy(network, control, "learning_rate", "dead_zone_rad")
    network.initial_weight = control.initial_weight_Nm
    network.leakage = control.leakage_1ps
    network.weight_limit = control.weight_limit_Nm


def _feed_forward_lead_s(config: Config) -> float:
    """From a command to its torque, held for a period, where it is not given."""
    lead_s = config.control.feed_forward_lead_s
    if lead_s != "auto":
        return lead_s
    if config.drive.own_loop() is not CommandKind.TORQUE:
        return 0.0  # what is sent there leads as a whole
    delay_s = config.margin.loop_delay_s
    if delay_s is None:
        delay_s = config.drive.assumed_delay(config)[0]
    return delay_s + 0.5 * period_s(config) + config.margin.current_lag_s


def _fill_adaptation(record: AdaptationConstants, config: Config, adaptation: Adaptation) -> None:
    ratio = config.joint.reduction_ratio
    record.enabled = 1
    _fill_velocity(record.seen, config, SEEN_Hz)
    _copy(record, adaptation, "friction_error", "reach")
    ripple_Nm = adaptation.ripple_Nm
    record.ripple_Nm = RIPPLE_SHARE * config.limits.torque_max_Nm if isinstance(ripple_Nm, str) else ripple_Nm
    record.count_rad = 0.0 if config.control.kind == "flexible_joint" else law_resolution_rad(config)
    record.ripple_max_Nm = RIPPLE_MOST * record.ripple_Nm
    static_Nm = static_friction_Nm(config) or UNEXPLAINED_Nm
    record.noise_Nm = min(max(UNEXPLAINED_Nm, LEAST_UNEXPLAINED * static_Nm), MOST_UNEXPLAINED * static_Nm)
    record.ripples = len(adaptation.ripple_per_motor_turn)
    for i, order in enumerate(adaptation.ripple_per_motor_turn):
        record.ripple_turns_prad[i] = ratio * order / math.tau


def _fill_flexible(record: FlexibleConstants, config: Config, reducer: Reducer) -> None:
    """What the law of a flexible joint reads and believes; the others have no use for it."""
    control, ratio = config.control, config.joint.reduction_ratio
    record.encoders = encoders_of_law(config)
    record.motor_inertia_kgm2 = reducer.motor_inertia_kgm2
    record.link_inertia_kgm2 = config.link_kgm2
    record.link_friction_share = reducer.link_friction_share
    record.following_Nm = FOLLOWING_SHARE * config.limits.torque_max_Nm
    record.compliance_radpNm = compliance = 1.0 / reducer.stiffness_Nmprad
    for i, (knee_Nm, stiffness) in enumerate(zip(reducer.knees_Nm, reducer.stiffness_beyond_Nmprad, strict=True)):
        record.knee_Nm[i] = knee_Nm
        record.stiffening_radpNm[i] = compliance - 1.0 / stiffness
        compliance = 1.0 / stiffness
    record.twist_gain = -math.expm1(-control.twist_radps * period_s(config))
    _fill_velocity(record.motor_velocity, config, control.velocity_cutoff_Hz)
    both = record.encoders == Encoders.BOTH
    _fill_velocity(record.link_velocity, config, control.link_cutoff_Hz if both else control.velocity_cutoff_Hz)
    if reducer.map is not None:
        for name, unit in (("kinematic_error", "rad"), ("torque_ripple", "Nm")):
            made = tuple(getattr(reducer.map, f"{name}_{rest}") for rest in (unit, "per_motor_turn", "phase_rad"))
            fill_series(getattr(record, name), ratio, made)


def _fill_velocity(record: VelocityConstants, config: Config, cutoff_Hz: float) -> None:
    record.period_s = period_s(config)
    record.cutoff_Hz = cutoff_Hz
    record.period_gain = plain(low_pass_gain)(cutoff_Hz, period_s(config))


def encoders_of_law(config: Config) -> Encoders:
    """What there is for the law of a flexible joint to read."""
    if config.joint_encoder is not None and config.joint_encoder.law == "joint_encoder":
        return Encoders.BOTH
    return Encoders.MOTOR if config.encoder.side == "motor" else Encoders.LINK


def hidden_layer(control: Control) -> tuple[tuple[tuple[float, float], ...], tuple[float, ...]]:
    """Centres and widths of all neurons; without centres those of the paper, one width is that of all."""
    centres = control.centres or tuple((c, c) for c in PAPER_CENTRES)
    return centres, control.widths if len(control.widths) > 1 else control.widths * NEURONS


def fill_change(record: ChangeConstants, law: LawConstants, config: Config) -> None:
    """The room for changes while the joint moves; moves are as quick as an automatic approach."""
    factor = config.live.gain_factor
    for gains in (record.low, record.high):
        plain(gains_of)(law, gains)
    for name in dtype_of(Gains).names or ():
        setattr(record.low, name, getattr(record.low, name) / factor)
        setattr(record.high, name, getattr(record.high, name) * factor)
    record.ramp_s = config.live.ramp_s
    record.q1, record.q2 = config.control.lyapunov_q[0], config.control.lyapunov_q[-1]
    record.move_speed_radps = APPROACH_SPEED * config.limits.velocity_max_radps
    record.move_acceleration_radps2 = config.sequence.brake_radps2
    record.move_min_s = MOVE_MIN_S


def _fill_stream(record: StreamConstants, config: Config) -> None:
    """Without a sign of life of the program that sends set-points: only a run that follows one asks for it."""
    stream, limits = config.stream, config.limits
    record.delay_ns, record.timeout_ns = round(stream.delay_s * 1e9), round(stream.timeout_s * 1e9)
    for key, automatic in (
        ("acceleration_max_radps2", 0.5 * acceleration_beside_gravity_radps2(config)),
        ("jump_max_rad", limits.following_error_max_rad),
        ("torque_max_Nm", 0.2 * limits.torque_max_Nm),
        ("torque_rate_max_Nmps", 0.1 * limits.torque_rate_max_Nmps),
    ):
        chosen = getattr(stream, key)
        setattr(record, key, automatic if isinstance(chosen, str) else chosen)


def trajectory_constants(config: Config, table: np.ndarray) -> TrajectoryConstants:
    """One record of [trajectory]."""
    record: TrajectoryConstants = new(TrajectoryConstants)[0]
    fill_trajectory(record, config, table)
    return record


def fill_trajectory(record: TrajectoryConstants, config: Config, table: np.ndarray) -> None:
    """`TrajectoryConstants` of [trajectory]; `table` as in `axis_constants`."""
    trajectory = config.trajectory
    record.kind = TrajectoryKind[trajectory.kind.upper()]
    record.duration_s = trajectory.duration_s
    if trajectory.kind == "sine":
        _copy(record, trajectory, "amplitude_rad", "offset_rad", "shift_s")
        record.omega_radps = math.tau * trajectory.frequency_Hz
        second = trajectory.switch
        if second is not None:
            record.switch_s = second.at_s
            record.amplitude2_rad, record.offset2_rad = second.amplitude_rad, second.offset_rad
            record.omega2_radps, record.shift2_s = math.tau * second.frequency_Hz, second.shift_s
    elif trajectory.kind == "hold":
        record.start_rad = record.target_rad = trajectory.position_rad
    elif trajectory.kind == "table":
        record.repeats = int(trajectory.repeat)
        record.table_rows = len(table)
    else:
        record.repeats = int(trajectory.repeat)
        ways = {"min_jerk": ("move_s",), "trapezoid": ("speed_radps", "acceleration_radps2")}
        _copy(record, trajectory, "start_rad", "target_rad", "dwell_s", *ways[trajectory.kind])
        if trajectory.kind == "trapezoid":
            record.rounding_s = _rounding_s(config, trajectory)


def _rounding_s(config: Config, trajectory: Trapezoid) -> float:
    """Over which its acceleration changes: in one period of the heaviest link, which hardly swings afterwards."""
    reducer = config.reducer
    if trajectory.jerk_radps3 != "auto":  # what is sent ahead takes the jerk as lasting
        return max(trajectory.acceleration_radps2 / trajectory.jerk_radps3, ROUNDING_CYCLES * period_s(config))
    if reducer is None:
        return 0.0
    return link_period_s(config, reducer)


def _cycles(config: Config, time_s: float) -> int:
    return max(1, round(time_s * config.loop.rate_Hz))


def _fill_limits(record: LimitConstants, config: Config) -> None:
    limits = config.limits
    _copy(
        record, limits, "position_min_rad", "position_max_rad", "velocity_max_radps", "torque_max_Nm",
        "torque_rate_max_Nmps", "following_error_max_rad", "position_jump_max_rad", "standstill_radps",
    )  # fmt: skip
    share = FROZEN_SHARE_WITHOUT_MODEL if config.control.feed_forward == "none" else FROZEN_SHARE
    record.frozen_tolerance_rad = FROZEN_COUNTS * law_resolution_rad(config)
    record.frozen_cycles = PUSHED_CYCLES
    static_Nm = static_friction_Nm(config)
    if static_Nm is not None:
        record.frozen_torque_Nm = FROZEN_FRICTION * static_Nm + abs(config.joint.gravity_Nm)
        if static_Nm > 0.0:  # a heavy joint leaves the tolerance later
            pushes_radps2 = (FROZEN_FRICTION - 1.0) * static_Nm / config.joint.inertia_kgm2
            leaves_s = math.sqrt(2.0 * FROZEN_WAYS * record.frozen_tolerance_rad / pushes_radps2)
            record.frozen_cycles = max(PUSHED_CYCLES, math.ceil(leaves_s * config.loop.rate_Hz))
    second = config.joint_encoder
    if second is not None:
        record.disagreement_max_rad = second.disagreement_max_rad
        record.twist_radpNm = 1.0 / second.stiffness_Nmprad if second.stiffness_Nmprad is not None else 0.0
        record.limit_source = LimitSource.BOTH
        if second.limits != "both":
            record.limit_source = LimitSource.LAW if second.limits == second.law else LimitSource.OTHER
    record.frozen_max_rad = max(share * limits.following_error_max_rad, 5.0 * record.frozen_tolerance_rad)
    record.frozen_ahead_rad = record.frozen_max_rad
    record.sample_age_max_cycles = _cycles(config, limits.sample_age_max_s)
    record.saturation_max_cycles = _cycles(config, limits.saturation_max_s)
    record.skipped_max_cycles = _cycles(config, limits.skipped_max_s)
    _fill_swing(record.swing, config)
    heartbeat_s = config.drive.silence_s()
    if heartbeat_s is not None:
        record.heartbeat_age_max_cycles = _cycles(config, HEARTBEATS_MISSED * heartbeat_s)


def _fill_swing(record: SwingConstants, config: Config) -> None:
    limits = config.limits
    record.torque_Nm = 2.0 * limits.swing_torque_share * limits.torque_max_Nm
    record.error_rad = limits.swing_error_share * limits.following_error_max_rad
    record.slowest_cycles = _cycles(config, limits.swing_slowest_s)
    rate_Nm = limits.torque_rate_max_Nmps * period_s(config)  # a command cannot change by more
    record.noise_Nm = min(limits.torque_noise_share * limits.torque_max_Nm, NOISE_OF_RATE * rate_Nm)
    record.noise_gain = 1.0 / _cycles(config, NOISE_S)
    record.hunting_rad = max(HUNTING_COUNTS * law_resolution_rad(config), HUNTING_rad)


def _fill_sequence(
    record: SequenceConstants, config: Config, table: np.ndarray, start_position_rad: float | None
) -> None:
    sequence = config.sequence
    record.approach_s = approach_s(config, table, start_position_rad)
    if start_position_rad is not None:
        record.start_rad = start_position_rad
        record.moved_max_rad = max(config.limits.following_error_max_rad, MOVED_COUNTS * law_resolution_rad(config))
    _copy(record, sequence, "brake_radps2", "release_s")
    record.settle_cycles = _cycles(config, sequence.settle_s)
    record.wait_max_cycles = _cycles(config, sequence.wait_timeout_s)
    record.enable_max_cycles = _cycles(config, sequence.enable_timeout_s)
    record.begin_max_cycles = _cycles(config, min(sequence.enable_timeout_s, config.drive.begins_within_s))
    record.stop_max_cycles = _cycles(config, sequence.stop_timeout_s)
    record.off_max_cycles = _cycles(config, sequence.off_timeout_s)
    record.may_enable = 1
    record.supervisor_max_cycles = _cycles(config, sequence.supervisor_timeout_s)


def approach_s(config: Config, table: np.ndarray, start_position_rad: float | None = None) -> float:
    """Time of the approach; "auto": the shortest within a quarter of the velocity limit, and 1 s at least.

    Where the trajectory itself begins faster than that, its own speed at the start plus a fifth is allowed.  Without
    `start_position_rad` it is the time from the farther end of the range of motion.
    """
    chosen = config.sequence.approach_s
    if not isinstance(chosen, str):
        return float(chosen)
    limits = config.limits
    start = approach_start(trajectory_constants(config, table), table)
    speed = max(APPROACH_SPEED * limits.velocity_max_radps, 1.2 * abs(float(start.velocity_radps)))
    acceleration = max(config.sequence.brake_radps2, 1.2 * abs(float(start.acceleration_radps2)))
    ends = (limits.position_min_rad, limits.position_max_rad)
    origins = ends if start_position_rad is None else (start_position_rad,)
    try:
        return max(
            approach_duration_s(origin, start, min(speed, limits.velocity_max_radps), acceleration, APPROACH_MIN_S)
            for origin in origins
        )
    except ValueError as error:
        raise ConfigurationError(f"{config.path}: sequence.approach_s (=auto): {error}") from None
