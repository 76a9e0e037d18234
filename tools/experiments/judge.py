"""One scenario run and judged: the invariants that hold whatever happens, as lines that name what was violated.

How far and how fast the joint may get is limits plus a derived stopping distance.  The loop reacts when a measured
value passes its limit.  Until the reaction has begun, `t` later, the motor may push with all that the drive allows in
the worst direction, and friction is not counted on:

    a = (torque limit of the drive + ripple + loads) / J
    v1 = v_max + a t                     the greatest speed
    x1 = v_max t + a t^2 / 2             the way until then

From then on the joint is braked by at least its own Coulomb friction F, the weakest of the reactions (power off), less
the ripple and the load L of the configuration (gravity with its whole lever), or, under an added load, by the drive's
quick stop with what the load leaves of it:

    d = (F - ripple - L) / J,   x2 = v1^2 / (2 d)

or by the drive's quick stop along 6085 where that is slower still: such a ramp holds the joint up against its friction.
The time until it is off and at rest is that of the speed that it did reach.

`t` is `REACTION_s` where the loop measures and the drive receives, or more where these take longer: one period each for
sample and command, the velocity filter (three time constants, 5 ms at 100 Hz) and the motor's delay and lag.  Where the
drive does not receive from the loop it holds the last torque, or in a sweep the last velocity, until its own watchdog
acts: age limit of the samples + IGNORED_MAX_CYCLES + drive.heartbeat_s.

A reading that is wrong by w (jump, drift) shifts the true position by w.  Behind a stuck encoder the joint is blind
until POSITION_FROZEN: it is pushed with at most frozen_torque_Nm for longer than PUSHED_CYCLES, 16 Nm more than the
Coulomb friction, which the viscous part (18 Nm s/rad below the knee) balances at 0.9 rad/s; the pushed cycles with
full torque add (60 - 13) Nm / J x 20 ms = 0.5 rad/s.  `BLIND_RADPS` is that and a quarter.
Of two faults each may come in the worst moment of the other: what `t`, loads and wrong readings add up to counts.  A
loop that is killed is given up by the drive after drive.heartbeat_s.
Not covered: more than two faults at a time, a drive that applies torque by itself, a load greater than the friction
for good (it needs a brake).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from jointctl.drivers.canopen.cyclic import IGNORED_MAX_CYCLES
from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.motion_records import Reference
from jointctl.firmware_py.records import AxisConstants, LimitConstants
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, CommandKind, DriveRequest, Fault, Reaction
from jointctl.firmware_py.trajectory import reference_at
from jointctl.hil.canopen.records import PowerState
from jointctl.hil.faults import FaultKind
from jointctl.hil.lockstep import (
    NO_POINTS,
    POINT_VALUES,
    TRUE_POWER_STATE,
    POINT_TIME_s,
    TRUE_POSITION_rad,
    TRUE_VELOCITY_radps,
)
from jointctl.tools.configuration.canopen import canopen_section
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.records import axis_constants, expect_client, free_constants
from jointctl.tools.experiments.fault_scenarios import (
    FAULT_CLASSES,
    LATE_CAUSES,
    BEFORE_s,
    Event,
    LONGEST_s,
    PlacedSweep,
    PlaceStep,
    Program,
    Scenario,
    SweepStrokes,
    TuneStep,
    fitted,
    placed_sweep,
    plant_of,
    set_points_of,
)
from jointctl.tools.lockstep import NO_STOP, LockstepJoint, LockstepRun

# --- the envelope ---

REACTION_s = 0.010
FILTER_CONSTANTS = 3.0
MOTOR_s = 0.0013  # the longest delay and lag that a scenario draws
BLIND_RADPS = 1.8
BLIND_RAD = 1.0
BRAKE_SPARE_s = 1.0  # a quick stop of the virtual drive may end so much late
STANDSTILL_RADPS = 0.02
_UNHEARD = frozenset(
    {
        FaultKind.FRAMES_LOST, FaultKind.SYNC_LOST, FaultKind.RPDO_LOST, FaultKind.BUS_OFF, FaultKind.RPDO_LENGTH,
        FaultKind.RPDO_DELAYED, FaultKind.TPDO_DELAYED, FaultKind.LOOP_HELD_UP,
    }
)  # fmt: skip
_BLIND_FOR_A_WHILE = frozenset({FaultKind.TPDO_LOST, FaultKind.TPDO_LENGTH})


@dataclass(frozen=True)
class Envelope:
    """What must hold in every period of a scenario."""

    position_min_rad: float
    position_max_rad: float
    velocity_max_radps: float
    command_max_Nm: float
    command_step_Nm: float
    stop_s: float  # from the latched fault to power off and standstill, by quick stop or power off
    ramp_s: float  # the same by a controlled ramp
    command_max_radps: float = math.inf  # of the velocity command, where there is one
    command_step_radps: float = math.inf  # in one period


def _measuring_s(config: Config) -> float:
    """Longest time from passing a limit to a reaction, with samples and a drive that hears."""
    cutoff_Hz = config.control.velocity_cutoff_Hz
    filter_s = FILTER_CONSTANTS / (math.tau * cutoff_Hz) if cutoff_Hz else 0.0
    return max(REACTION_s, 2.0 / config.loop.rate_Hz + filter_s + MOTOR_s)


def reaction_s(config: Config, events: Sequence[Event]) -> float:
    """Longest time from passing a limit to the beginning of the reaction."""
    age_s, ignored_s = config.limits.sample_age_max_s, IGNORED_MAX_CYCLES / config.loop.rate_Hz
    waits_s = {kind: age_s + ignored_s + canopen_section(config).heartbeat_s for kind in _UNHEARD}
    waits_s |= dict.fromkeys(_BLIND_FOR_A_WHILE, age_s)
    waits_s[FaultKind.LOOP_KILLED] = canopen_section(config).heartbeat_s
    return _measuring_s(config) + sum(waits_s.get(event.kind, 0.0) for event in events)


def magnitude_of(events: Sequence[Event], kind: FaultKind) -> float:
    """The sum of those of that kind, whatever their signs."""
    return sum(abs(event.magnitude) for event in events if event.kind is kind)


def load_Nm(config: Config) -> float:
    """The greatest load at the joint that is there without a fault."""
    virtual = config.virtual
    assert virtual is not None
    return abs(virtual.gravity_Nm) + abs(virtual.load_torque_Nm) + abs(virtual.load_step_Nm)


def _friction_floor_Nm(config: Config, positive_scale: float, negative_scale: float) -> float:
    """The least Coulomb friction at the joint, of the slower direction and with its ripple."""
    virtual = config.virtual
    assert virtual is not None
    friction = virtual.friction or config.friction
    assert friction is not None
    curves = abs(friction.positive.tc_Nm) * positive_scale, abs(friction.negative.tc_Nm) * negative_scale
    return config.joint.reduction_ratio * min(curves) * (1.0 - virtual.friction_ripple)


def largest_drive_Nm(config: Config) -> float:
    """At the joint: what the drive gives at most."""
    section = canopen_section(config)
    share = 1e-3 * (section.max_torque_permille or 1000)
    return share * (section.rated_torque_Nm or 0.0) * config.joint.reduction_ratio


def envelope(
    config: Config, scenario: Scenario, constants: AxisConstants, quick_stop_radps2: float = math.inf,
    reached_radps: float = math.inf,
) -> Envelope:  # fmt: skip
    """See the module; `constants` is the AxisConstants record of the scenario, the quick stop that of the drive.

    `reached_radps` is the greatest speed of the run: from more it was not braked.
    """
    limits, events = constants.limits, scenario.events
    inertia = scenario.plant["inertia_kgm2"]
    ripple = sum(scenario.plant["torque_ripple_Nm"])
    load = magnitude_of(events, FaultKind.LOAD_JUMP)
    drive_Nm = largest_drive_Nm(config)
    constant_Nm = load_Nm(config)
    scales = (scenario.plant[f"friction_{side}_scale"] for side in ("positive", "negative"))
    floor = _friction_floor_Nm(config, *scales) - ripple - constant_Nm
    wait_s = reaction_s(config, events)
    push = (drive_Nm + ripple + load + constant_Nm) / inertia
    speed = limits.velocity_max_radps + push * wait_s
    brake = min((min(floor, drive_Nm + floor - load) if load else floor) / inertia, quick_stop_radps2)
    way = limits.velocity_max_radps * wait_s + 0.5 * push * wait_s**2 + speed**2 / (2.0 * brake)
    stop_s = wait_s + min(speed, reached_radps) / brake + BRAKE_SPARE_s
    if load > floor:  # after power off it moves the joint for the rest of its time
        loaded_s = sum(event.duration_s for event in events if event.kind is FaultKind.LOAD_JUMP)
        pushed = (load - floor) / inertia * loaded_s
        way += 0.5 * pushed * loaded_s + pushed**2 / (2.0 * brake)
        speed = max(speed, pushed)
        stop_s += loaded_s + min(pushed, reached_radps) / brake
    shift = magnitude_of(events, FaultKind.ENCODER_JUMP)
    for event in events:
        if event.kind is FaultKind.ENCODER_DRIFT:
            run_s = constants.sequence.approach_s + constants.trajectory.duration_s + config.sequence.stop_timeout_s
            shift += abs(event.magnitude) * min(event.duration_s, run_s + 1.0)
            speed += abs(event.magnitude)
        elif event.kind is FaultKind.ENCODER_STUCK:
            shift, speed = shift + BLIND_RAD, max(speed, BLIND_RADPS)
            stop_s += min(speed, reached_radps) / brake
        elif event.kind is FaultKind.ENCODER_REVERSED:
            shift += 2.0 * limits.following_error_max_rad + way
    return Envelope(
        position_min_rad=limits.position_min_rad - way - shift,
        position_max_rad=limits.position_max_rad + way + shift,
        velocity_max_radps=speed,
        command_max_Nm=limits.torque_max_Nm,
        command_step_Nm=limits.torque_rate_max_Nmps * constants.law.period_s,
        stop_s=stop_s,
        ramp_s=config.sequence.stop_timeout_s + config.sequence.release_s + stop_s,
        command_max_radps=limits.velocity_max_radps,
        command_step_radps=constants.velocity_command.acceleration_max_radps2 * constants.law.period_s,
    )


# --- configurations that a campaign can judge: what its sizes and its envelope assume ---

LEAST_SCALE = 0.9  # of the friction, RIPPLE_Nm the most of the motor: what a scenario draws
RIPPLE_Nm = 1.4


SIZED_FOR_Nm = 60.0  # limits.torque_max_Nm that the torques of scenarios are drawn for


def _demands(config: Config, torque_Nm: float) -> list[tuple[str, float, float]]:
    """(key, value, least value): harmless sizes are just inside these limits, trajectories use that much room."""
    limits, sequence = config.limits, config.sequence
    return [
        ("limits.position_max_rad", limits.position_max_rad, 0.7),
        ("-limits.position_min_rad", -limits.position_min_rad, 0.7),
        ("limits.velocity_max_radps", limits.velocity_max_radps, 1.0),
        ("limits.torque_max_Nm", limits.torque_max_Nm, torque_Nm),
        ("limits.following_error_max_rad", limits.following_error_max_rad, 0.05),
        ("limits.position_jump_max_rad", limits.position_jump_max_rad, 0.02),
        ("limits.sample_age_max_s", limits.sample_age_max_s, 0.05),
        ("limits.skipped_max_s", limits.skipped_max_s, 0.05),
        ("sequence.supervisor_timeout_s", sequence.supervisor_timeout_s, 1.0),
        ("drive.heartbeat_s", canopen_section(config).heartbeat_s, 0.2),
    ]


def require_joint_fits(config: Config, torque_Nm: float = 0.0) -> None:
    """`ConfigurationError` for a joint, alone or of an arm, for which the scenarios are not made."""
    virtual = config.virtual
    if virtual is None:
        raise ConfigurationError(f"{config.path}: [virtual] is missing: the campaign needs a virtual joint")
    if virtual.friction is None and config.friction is None:
        raise ConfigurationError(f"{config.path}: [friction] is missing, and so is [virtual.friction]")
    if virtual.faults:
        raise ConfigurationError(f"{config.path}: [[virtual.faults]] must be empty: the campaign brings its own")
    for key, value, least in _demands(config, torque_Nm):
        if value < least:
            raise ConfigurationError(
                f"{config.path}: {key} (={value:g}) must be at least {least:g}: the campaign's harmless faults and its "
                "trajectories are made for the limits of configs/virtual.toml"
            )


def friction_floor_Nm(config: Config) -> float:
    """The least Coulomb friction at the joint of all scenarios."""
    return _friction_floor_Nm(config, LEAST_SCALE, LEAST_SCALE)


def require_fit(config: Config) -> None:
    """`ConfigurationError` for a configuration whose campaign would prove nothing, or find what is no violation."""
    require_joint_fits(config, SIZED_FOR_Nm)
    held_Nm = friction_floor_Nm(config) - RIPPLE_Nm
    if load_Nm(config) >= held_Nm:
        raise ConfigurationError(
            f"{config.path}: the loads of [virtual] (={load_Nm(config):g} Nm) must be less than {held_Nm:.2f} Nm, what "
            "friction holds in the worst scenario: beyond, the joint needs a brake, and no envelope can be derived"
        )


# --- the invariants ---

APPROACH_s = 1.0
SPARE_s = 14.0  # for waiting, enabling and stopping
NEVER_s = 1e6
TAIL_s = 2.5  # watched after the controller has ended
AFTER_s = 0.1  # after its last set-point, a program stops the joint
NOTICED_s = 0.35  # a certain fault that begins so long before the last torque must be noticed, or its least duration
SAMPLES_LOST = frozenset({FaultKind.FRAMES_LOST, FaultKind.SYNC_LOST, FaultKind.TPDO_LOST, FaultKind.BUS_OFF})
GAP_BEGINS_s = 0.002  # a gap has the last sample before it as well
HIDDEN_rad = 0.05  # limits.following_error_max_rad: what is more is noticed after the gap
POWERED = (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT_REACTION_ACTIVE)


@dataclass(frozen=True)
class Verdict:
    """What one scenario showed; plain values, for other processes and for JSON."""

    number: int
    kind: str
    harmless: bool
    fault: str
    reaction: str
    then: str  # the second event of a pair
    violations: tuple[str, ...]
    peak_radps: float
    beyond_rad: float  # how far the joint got beyond its position limits
    allowed_rad: float  # how far it may
    off_s: float | None  # from the latched fault to power off and standstill; None without a fault


def _placed(config: Config, joint: LockstepJoint, scenario: Scenario, place: PlaceStep | None) -> PlacedSweep | None:
    """The motion of a sweep, or of a step of a tune; None of all others."""
    if isinstance(scenario.trajectory, SweepStrokes):
        return placed_sweep(config, joint, scenario.trajectory, scenario.start_offset_rad)
    if isinstance(scenario.trajectory, TuneStep):
        assert place is not None
        return place(config, joint, scenario.trajectory, scenario.start_offset_rad)
    return None


def run_scenario(
    config: Config, joint: LockstepJoint, scenario: Scenario, place: PlaceStep | None = None
) -> tuple[LockstepRun, Any]:
    """The run, and the AxisConstants record array that it used; the joint's table is the scenario's afterwards."""
    placed = _placed(config, joint, scenario, place)
    if placed is not None:
        joint.table = placed.table
        return _carry_out(
            joint, scenario, placed.constants, placed.duration_s, plant_of(config, scenario, placed.start_rad)
        )
    if isinstance(scenario.trajectory, Program):
        points = set_points_of(scenario.trajectory, config, joint.table)
        start = float(points[0, POINT_VALUES])
        constants = free_constants(config, start)
        expect_client(constants, config)
        lasts_s = float(points[-1, POINT_TIME_s]) + AFTER_s
        return _carry_out(joint, scenario, constants, lasts_s, plant_of(config, scenario, start), points)
    shown = config.changed(trajectory=scenario.trajectory, sequence__approach_s=APPROACH_s)
    first = new(Reference)
    reference_at(axis_constants(shown, joint.table)[0].trajectory, joint.table, 0, 0.0, first[0])
    limits = config.limits
    start = float(first[0].position_rad) + scenario.start_offset_rad
    start = min(max(start, limits.position_min_rad + 0.05), limits.position_max_rad - 0.05)
    constants = axis_constants(shown, joint.table, start_position_rad=start)
    duration_s = scenario.trajectory.duration_s
    return _carry_out(joint, scenario, constants, duration_s, plant_of(shown, scenario, start))


def in_time(config: Config, joint: LockstepJoint, scenario: Scenario, place: PlaceStep | None = None) -> Scenario:
    """A sweep's fault, drawn for the longest one, begins as early in this one: after its end it would prove nothing."""
    placed = _placed(config, joint, scenario, place)
    if placed is None:
        return scenario
    at_s = scenario.at_s * (BEFORE_s + placed.duration_s) / (BEFORE_s + LONGEST_s)
    if (second := scenario.second) is not None:
        second = replace(second, at_s=second.at_s - scenario.at_s + at_s)
    return replace(scenario, at_s=at_s, second=second)


def _carry_out(
    joint: LockstepJoint,
    scenario: Scenario,
    constants: np.recarray,
    duration_s: float,
    plant: tuple[Any, Any],
    set_points: np.ndarray = NO_POINTS,
) -> tuple[LockstepRun, Any]:
    """`duration_s`: of the motion, or, with set-points, until the program stops the joint."""
    run = joint.run_with_faults(
        scenario.faults(), constants,
        plant_constants=plant[0], plant_state=plant[1], epoch_at_start=True, set_points=set_points,
        stop_cycle=round(duration_s / float(constants[0].law.period_s)) if len(set_points) else NO_STOP,
        longest_s=float(constants[0].sequence.approach_s) + duration_s + SPARE_s, tail_s=TAIL_s,
    )  # fmt: skip
    return run, constants


def _commands(run: LockstepRun, allowed: Envelope, *, by_position: bool = False) -> list[str]:
    log, found = run.log, []
    torque = np.asarray(log.command_torque_Nm)
    powered = (log.phase >= AxisPhase.APPROACH) & (log.phase <= AxisPhase.RELEASING)
    if not np.isfinite(torque).all() or np.abs(torque).max() > allowed.command_max_Nm:
        found.append(f"torque command {np.abs(torque).max():.2f} Nm exceeds {allowed.command_max_Nm:g}")
    steps = np.abs(np.diff(torque))[powered[1:]]
    if len(steps) and steps.max() > allowed.command_step_Nm * (1.0 + 1e-9):
        found.append(f"torque command steps by {steps.max():.2f} Nm, allowed {allowed.command_step_Nm:g}")
    if torque[~powered].any():
        found.append("torque commanded in a phase without power")
    speed = np.asarray(log.command_velocity_radps)
    if not np.isfinite(speed).all() or np.abs(speed).max() > allowed.command_max_radps:
        found.append(f"velocity command {np.abs(speed).max():.3f} rad/s exceeds {allowed.command_max_radps:g}")
    skipped = np.asarray(log.skipped)[1:]
    steps = (np.abs(np.diff(speed)) / (1.0 + skipped))[powered[1:]]
    if by_position:  # while the loop is held up, the drive's set-point stands still: the target starts from there
        steps = steps[skipped[powered[1:]] == 0]
    if len(steps) and steps.max() > allowed.command_step_radps * (1.0 + 1e-9):
        found.append(f"velocity command steps by {steps.max():.4f} rad/s, allowed {allowed.command_step_radps:g}")
    if speed[~powered].any():
        found.append("a velocity commanded in a phase without power")
    return found


def _motion(run: LockstepRun, allowed: Envelope) -> list[str]:
    found = []
    position, velocity = run.truth[:, TRUE_POSITION_rad], run.truth[:, TRUE_VELOCITY_radps]
    if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
        return ["the plant's state is not finite"]
    if position.min() < allowed.position_min_rad or position.max() > allowed.position_max_rad:
        found.append(
            f"position {position.min():.3f}..{position.max():.3f} rad leaves "
            f"{allowed.position_min_rad:.3f}..{allowed.position_max_rad:.3f}"
        )
    peak = np.abs(velocity).max()
    if peak > allowed.velocity_max_radps:
        found.append(f"speed {peak:.2f} rad/s exceeds {allowed.velocity_max_radps:.2f}")
    return found


def _off_row(run: LockstepRun) -> int:
    """The first row from which on the power stage is off and the joint stands."""
    busy = np.isin(run.truth[:, TRUE_POWER_STATE], POWERED)
    busy |= np.abs(run.truth[:, TRUE_VELOCITY_radps]) > STANDSTILL_RADPS
    rows = np.flatnonzero(busy)
    return int(rows[-1]) + 1 if len(rows) else 0


def _time_off(
    run: LockstepRun, allowed: Envelope, events: Sequence[Event], fault_row: int, period_s: float
) -> tuple[list[str], float | None]:
    """From the latched fault, or the death of the loop, until the power is off and the joint stands."""
    off_row = _off_row(run)
    longest = allowed.ramp_s if (run.log.phase == AxisPhase.RAMPING).any() else allowed.stop_s
    what, begin = "fault", fault_row
    killed_s = min((event.at_s for event in events if event.kind is FaultKind.LOOP_KILLED), default=math.inf)
    if off_row * period_s > killed_s and run.state.phase != AxisPhase.FINISHED:  # what it would have done, it cannot
        what, begin, longest = "death of the loop", math.ceil(killed_s / period_s), allowed.stop_s
    if begin < 0:
        return [], None
    off_s = max(off_row - begin, 0) * period_s
    # a load that comes later moves the joint, whether it has power or not
    loaded_s = max((event.at_s for event in events if event.kind is FaultKind.LOAD_JUMP), default=0.0)
    longest += max(loaded_s - begin * period_s, 0.0)
    if off_s > longest:
        return [f"off and at rest {off_s:.3f} s after the {what}, allowed {longest:.3f}"], off_s
    return [], off_s


def _ending(run: LockstepRun, events: Sequence[Event]) -> list[str]:
    found = []
    killed = any(event.kind is FaultKind.LOOP_KILLED for event in events)
    if run.state.phase != AxisPhase.FINISHED and not killed:
        found.append(f"the axis did not finish, phase {AxisPhase(int(run.state.phase)).name}")
    if _off_row(run) >= len(run.truth):
        found.append("the joint is not off and at rest in the end")
    requests = np.asarray(run.log.request)
    asked = np.flatnonzero(requests == DriveRequest.ENABLE)
    # before it moves, an arm waits at PREPARE again for a joint that has fallen back
    asking = (requests == DriveRequest.ENABLE) | (
        (requests == DriveRequest.PREPARE) & (run.log.phase == AxisPhase.ENABLING)
    )
    if len(asked) and not asking[asked[0] : asked[-1]].all():
        found.append("the loop asked to enable again after it had asked to stop")
    return found


def _enabled_again(run: LockstepRun, events: Sequence[Event], start_ns: int, period_ns: int) -> list[str]:
    """The power stage comes on at most once, but for what the wire does by itself.

    A frame may have been under way when the loop gave up, one cycle longer where its successor overtakes it; a
    corrupted one may say "enable", until a sound one comes.
    """
    enabled = run.truth[:, TRUE_POWER_STATE] == PowerState.OPERATION_ENABLED
    rises = np.flatnonzero(enabled[1:] & ~enabled[:-1]) + 1
    asked = np.flatnonzero(np.asarray(run.log.request) == DriveRequest.ENABLE)
    if not len(rises):
        return []
    if not len(asked):
        return [f"enabled although the loop never asked ({len(rises)} times)"]
    last_row = (int(run.log.time_ns[asked[-1]]) - start_ns) // period_ns
    wire_s = magnitude_of(events, FaultKind.RPDO_DELAYED)
    wire_s += sum(event.duration_s for event in events if event.kind is FaultKind.RPDO_CORRUPTED)
    overtaken = any(event.kind is FaultKind.RPDO_REORDERED for event in events)
    late = 2 + overtaken + int(wire_s * 1e9 / period_ns)
    if rises[-1] > last_row + late:
        return [f"enabled again {(rises[-1] - last_row) * period_ns * 1e-6:.0f} ms after the loop had stopped asking"]
    return []


def causes_of(events: Sequence[Event]) -> frozenset[Fault]:
    """What the loop may name."""
    classes = [FAULT_CLASSES[event.kind] for event in events]
    late = LATE_CAUSES if any(item.on_wire for item in classes) else frozenset()
    return late.union(*(item.causes for item in classes))


def _not_noticed(run: LockstepRun, event: Event, period_s: float, start_ns: int) -> bool:
    if event.harmless or not FAULT_CLASSES[event.kind].certain:
        return False
    powered = (run.log.phase >= AxisPhase.APPROACH) & (run.log.phase <= AxisPhase.RELEASING)
    watched = (np.asarray(run.log.time_ns)[powered] - start_ns) * 1e-9
    sizes = FAULT_CLASSES[event.kind].harmful
    noticed_s = NOTICED_s if sizes is None else max(NOTICED_s, sizes.duration_s[0])
    noticed_s += event.duration_s if event.kind is FaultKind.LOOP_HELD_UP else 0.0
    return len(watched) > 0 and watched[0] < event.at_s - period_s and event.at_s + noticed_s < watched[-1]


def _hidden(event: Event, events: Sequence[Event]) -> bool:
    """Whether a jump need not be noticed: the reading stands still, or it fits into a gap in the samples."""

    def hides(other: Event) -> bool:
        within = other.at_s - GAP_BEGINS_s <= event.at_s < other.at_s + other.duration_s
        in_gap = other.kind in SAMPLES_LOST and within and abs(event.magnitude) <= HIDDEN_rad
        return other.kind is FaultKind.ENCODER_STUCK or in_gap

    return event.kind is FaultKind.ENCODER_JUMP and any(map(hides, events))


def wrong_cause(
    run: LockstepRun, events: Sequence[Event], period_s: float, start_ns: int, *, twin: bool = False,
    also: frozenset[Fault] = frozenset(),
) -> list[str]:  # fmt: skip
    """`events`: of the joint, and of the computer; `twin`: the only one is harmless; `also`: causes besides theirs."""
    fault, code = run.fault, int(run.state.fault_drive_error)
    if fault is Fault.NONE:
        unnoticed = any(_not_noticed(run, event, period_s, start_ns) for event in events if not _hidden(event, events))
        return ["the fault was not noticed"] if unnoticed else []
    if twin:
        return [f"a harmless fault tripped {fault.name} (={run.state.fault_value:.4f})"]
    if fault not in causes_of(events) | also:
        return [f"the cause is reported as {fault.name} (={run.state.fault_value:.4f})"]
    codes = {FAULT_CLASSES[one.kind].emergency for one in events if fault in FAULT_CLASSES[one.kind].causes}
    if fault is Fault.DRIVE_NOT_ENABLED and codes and not codes & {0, code}:
        return [f"the drive's error code is reported as {code:04X}h, not {min(codes):04X}h"]
    of_drive = {one.magnitude for one in events if one.kind is FaultKind.DRIVE_FAULT}
    if of_drive and fault is Fault.DRIVE_FAULT and code not in of_drive and len(events) == 1:
        return [f"the drive's error code is reported as {code:04X}h"]
    return []


def fault_row_of(run: LockstepRun, start_ns: int, period_ns: int) -> int:
    """The row of the true values in which the loop latched its fault; -1 without one."""
    tripped = np.flatnonzero(run.log.fault != Fault.NONE)
    return (int(run.log.time_ns[tripped[0]]) - start_ns) // period_ns if len(tripped) else -1


def wrong_of_joint(
    run: LockstepRun, allowed: Envelope, events: Sequence[Event], fault_row: int, start_ns: int, period_ns: int,
    *, by_position: bool = False,
) -> tuple[list[str], float | None]:  # fmt: skip
    """What holds for any joint, whatever the fault: (violations, time from `fault_row` until off and at rest)."""
    late, off_s = _time_off(run, allowed, events, fault_row, period_ns * 1e-9)
    found = [*_commands(run, allowed, by_position=by_position), *_motion(run, allowed), *_ending(run, events), *late]
    return found + _enabled_again(run, events, start_ns, period_ns), off_s


def beyond_rad(run: LockstepRun, limits: LimitConstants) -> float:
    """How far the joint truly got beyond its position limits."""
    position = run.truth[:, TRUE_POSITION_rad]
    return float(max(position.max() - limits.position_max_rad, limits.position_min_rad - position.min(), 0.0))


def _ends_by_itself(
    config: Config, joint: LockstepJoint, scenario: Scenario, fault: Fault, place: PlaceStep | None
) -> bool:
    """A harmless fault in a step of a tune that ends in the same way without it: its law knows no friction yet."""
    if not (scenario.twin and fault is not Fault.NONE and isinstance(scenario.trajectory, TuneStep)):
        return False
    alone, _ = run_scenario(config, joint, replace(scenario, at_s=NEVER_s), place)
    return alone.fault is fault


def judge(config: Config, joint: LockstepJoint, scenario: Scenario, place: PlaceStep | None = None) -> Verdict:
    """Run a scenario and check every invariant."""
    scenario = in_time(config, joint, fitted(config, scenario), place)
    run, constants = run_scenario(config, joint, scenario, place)
    axis = constants[0]
    period_s = float(axis.law.period_s)
    period_ns = round(period_s * 1e9)
    start_ns = int(joint.start_ns)
    peak_radps = float(np.abs(run.truth[:, TRUE_VELOCITY_radps]).max())
    allowed = envelope(config, scenario, axis, joint.quick_stop_radps2, peak_radps)
    fault_row = fault_row_of(run, start_ns, period_ns)
    by_position = int(axis.command_kind) == CommandKind.POSITION
    events = scenario.events
    wrong, off_s = wrong_of_joint(run, allowed, events, fault_row, start_ns, period_ns, by_position=by_position)
    if not _ends_by_itself(config, joint, scenario, run.fault, place):
        wrong += wrong_cause(run, events, period_s, start_ns, twin=scenario.twin)
    return Verdict(
        number=scenario.number,
        kind=scenario.kind.name.lower(),
        harmless=scenario.twin,
        then=scenario.then(scenario.second),
        fault=run.fault.name,
        reaction=Reaction(int(run.state.reaction)).name,
        violations=tuple(wrong),
        peak_radps=peak_radps,
        beyond_rad=beyond_rad(run, axis.limits),
        allowed_rad=allowed.position_max_rad - float(axis.limits.position_max_rad),
        off_s=off_s,
    )
