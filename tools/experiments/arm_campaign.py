"""The campaign on an arm: one joint has the fault, all joints move, and what must then hold for each and for all.

Scenario `number` of a seed has the fault that a single joint's scenario of that number has (`fault_scenarios`), on one
joint after the other; torques are scaled to that joint's limit.  Every joint has a motion and a plant of its own.  The
second fault of a pair is any joint's.

What holds for a single joint (`judge`) must hold for each of them.  Besides:

- no joint has torque before the drives of all are enabled;
- whatever stops one joint stops all, in the same cycle, or where its command is the cause in the next one;
- the first fault is that of the joint that has it, with its cause; after it another joint may report only what the
  first one's stop does to it.

How far and how fast a joint may get follows from `judge` with the arm's mass matrix M: until the reaction has begun,
every drive may push with all that it has, each gravity torque, ripple and added load in the worst direction,

    a = max over the poses of sum_j |M^-1_ij| (drive_j + ripple_j + gravity_j + load_j)

for the reaction time of the fault on its joint, for that of a measured limit on the others.  A joint whose brake closes
throws the others: |M_ij| / M_ii of its speed.  The virtual arm's brakes hold, so there is no friction to be braked by:
quick stop and ramp brake with 6085 or sequence.brake_radps2, the smaller one.  A motor that yields too little lets its
joint fall until the drive has given up its stop ramp.

Where joints have no brake, Coulomb friction F, less ripple and gravity, takes the kinetic energy T = v' M v / 2:

    |v_i| <= sqrt(2 T (M^-1)_ii),   x_i <= T / F_i
    dT/dt <= -sum_i F_i |v_i| <= -c sqrt(T),   c = min_i F_i / sqrt(M_ii / 2),   so that all stand after 2 sqrt(T) / c
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.motion_records import Reference
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, Fault, Reaction
from jointctl.firmware_py.trajectory import reference_at
from jointctl.hil.canopen.records import PowerState
from jointctl.hil.faults import FaultKind
from jointctl.hil.lockstep import TRUE_POWER_STATE, TRUE_VELOCITY_radps
from jointctl.hil.plant_records import FrictionKind
from jointctl.tools.analysis.arm_check import pose_models
from jointctl.tools.configuration.arm import ArmConfig
from jointctl.tools.configuration.config import Config, first_on_bus
from jointctl.tools.experiments.fault_scenarios import (
    LATE_CAUSES,
    MOTION,
    REACH_RAD,
    Event,
    Scenario,
    draw_plant,
    draw_scenario,
    draw_trajectory,
    fitted,
    kinds_during,
    plant_of,
)
from jointctl.tools.experiments.judge import (
    BLIND_RAD,
    BLIND_RADPS,
    APPROACH_s,
    BRAKE_SPARE_s,
    Envelope,
    RIPPLE_Nm,
    SIZED_FOR_Nm,
    SPARE_s,
    TAIL_s,
    Verdict,
    beyond_rad,
    causes_of,
    fault_row_of,
    friction_floor_Nm,
    largest_drive_Nm,
    magnitude_of,
    reaction_s,
    require_joint_fits,
    wrong_cause,
    wrong_of_joint,
)
from jointctl.tools.lockstep import LockstepArm, LockstepRun
from jointctl.tools.virtual_joint import arm_plant_of

# --- the scenario ---

SIZED_FOR_rad = 0.7  # the position limit for which `fault_scenarios` draws
SPEED_SHARE = 0.35  # of limits.velocity_max_radps: with a filter of 200 Hz twice that must still be harmless
RIPPLE_SHARE = 0.4  # of what is drawn for that joint, at the same torque
PAPER_BRISTLE_Nmprad = 8e4
INERTIA_SCALES = (0.95, 1.05)
OF_TORQUE = frozenset({FaultKind.TORQUE_SATURATED, FaultKind.LOAD_JUMP})  # magnitudes in Nm
# of the computer, so of all joints at once; BUS_OFF is an adapter's, so of all on its bus
COMMON = frozenset(
    {
        FaultKind.LOOP_HELD_UP, FaultKind.CLOCK_STEP, FaultKind.SUPERVISOR_SILENT, FaultKind.STOP_REQUESTED,
        FaultKind.LOOP_KILLED,
    }
)  # fmt: skip
LEFT_ALONE_SPEEDS = 4.0  # of limits.velocity_max_radps: what a joint reaches until its drive has given up the loop
WEAK = frozenset({FaultKind.TORQUE_SATURATED, FaultKind.CURRENT_LOOP_DEAD})  # the motor yields too little


@dataclass(frozen=True)
class ArmScenario:
    """What happens to each joint; the first fault is in the scenario of joint `faulty`, a second one in any."""

    faulty: int
    joints: tuple[Scenario, ...]
    inertia_scales: tuple[float, ...]

    @property
    def fault(self) -> Scenario:
        return self.joints[self.faulty]

    @property
    def second(self) -> tuple[int, Event] | None:
        """Of a pair: the joint, and what it has."""
        return next(((k, one.second) for k, one in enumerate(self.joints) if one.second is not None), None)

    @property
    def twin(self) -> bool:
        return self.fault.harmless and self.second is None

    def touching(self, joints: Sequence[Config]) -> list[list[Event]]:
        """Of each joint, the events that it has at once."""
        buses = first_on_bus(joints)
        touching: list[list[Event]] = [[] for _ in joints]
        for axis, joint in enumerate(self.joints):
            for event in joint.events:
                for other, events in enumerate(touching):
                    of_bus = event.kind is FaultKind.BUS_OFF and buses[other] == buses[axis]
                    if other == axis or event.kind in COMMON or of_bus:
                        events.append(event)
        return touching

    def describe(self) -> dict[str, Any]:
        """For JSON and people."""
        joints = [
            {"inertia_scale": scale, **{k: v for k, v in joint.describe().items() if k in ("trajectory", "plant")}}
            for scale, joint in zip(self.inertia_scales, self.joints, strict=True)
        ]
        fault = {k: v for k, v in self.fault.describe().items() if k not in ("trajectory", "plant", "second")}
        then = {} if self.second is None else {"second": {**self.second[1].describe(), "joint": self.second[0]}}
        return {**fault, "joint": self.faulty, **then, "joints": joints}


def draw_arm_scenario(arm: ArmConfig, seed: int, number: int, *, pairs: bool = False) -> ArmScenario:
    """Scenario `number` of the campaign with this seed."""
    base = draw_scenario(seed, number, pairs=pairs)
    faulty = number // len(kinds_during("run", pairs=pairs)) % len(arm.joints)
    random = np.random.default_rng([seed, number, 1])
    has_second = int(np.random.default_rng([seed, number, 3]).integers(len(arm.joints)))
    joints, scales = [], []
    for axis, config in enumerate(arm.joints):
        limits, size = config.limits, config.limits.torque_max_Nm / SIZED_FOR_Nm
        reach_rad = REACH_RAD / SIZED_FOR_rad * min(limits.position_max_rad, -limits.position_min_rad)
        trajectory = draw_trajectory(
            random, base.trajectory.duration_s, reach_rad, SPEED_SHARE * limits.velocity_max_radps
        )
        joint = replace(base, trajectory=trajectory, plant=_plant(random, config, size),
                        start_offset_rad=float(random.uniform(-0.1, 0.1)))  # fmt: skip
        scales.append(float(random.uniform(*INERTIA_SCALES)))
        joint = _sized(joint, size) if axis == faulty else replace(joint, kind=FaultKind.NONE)
        second = _sized(base.second, size) if base.second is not None and axis == has_second else None
        joint, second = _leaping(joint, arm), None if second is None else _leaping(second, arm)
        if not has_brake(config):
            joint, second = _held(joint, config), None if second is None else _held(second, config)
        joints.append(fitted(config, replace(joint, second=second)))
    return ArmScenario(faulty, tuple(joints), tuple(scales))


AnEvent = TypeVar("AnEvent", Event, Scenario)


def _sized(event: AnEvent, size: float) -> AnEvent:
    return replace(event, magnitude=size * event.magnitude) if event.kind in OF_TORQUE else event


def _leaping(event: AnEvent, arm: ArmConfig) -> AnEvent:
    """The references leap with the clock: where that is harmless, by less than a joint's following error may be."""
    if event.kind is not FaultKind.CLOCK_STEP or not event.harmless:
        return event
    limits = [joint.limits for joint in arm.joints]
    most_s = min(one.following_error_max_rad / (SPEED_SHARE * one.velocity_max_radps) for one in limits)
    return replace(event, magnitude=min(event.magnitude, 0.8 * most_s))


def _held(event: AnEvent, config: Config) -> AnEvent:
    """A harmless load that stays must not move a joint without a brake once its power is off."""
    if event.kind is not FaultKind.LOAD_JUMP or not event.harmless:
        return event
    most_Nm = 0.5 * least_friction_Nm(config)
    return replace(event, magnitude=min(max(event.magnitude, -most_Nm), most_Nm))


def _plant(random: np.random.Generator, config: Config, size: float) -> dict[str, Any]:
    """Settings of `plant_of`: a joint of an arm has no stick-slip friction, and the arm has the inertias."""
    drawn = draw_plant(random)
    del drawn["inertia_kgm2"]
    assert config.friction is not None
    bristles = config.friction.lugre.stiffness_Nmprad if config.friction.lugre is not None else PAPER_BRISTLE_Nmprad
    return {
        **drawn,
        "friction_kind": FrictionKind.LUGRE,
        "bristle_stiffness_Nmprad": drawn["bristle_stiffness_Nmprad"] * bristles / PAPER_BRISTLE_Nmprad,
        "torque_ripple_Nm": tuple(RIPPLE_SHARE * size * ripple for ripple in drawn["torque_ripple_Nm"]),
    }


# --- the run ---


def moving(arm: ArmConfig, scenario: ArmScenario) -> ArmConfig:
    """The arm with the scenario's motions and inertias."""
    joints = []
    for config, joint, scale in zip(arm.joints, scenario.joints, scenario.inertia_scales, strict=True):
        shown = {"trajectory": joint.trajectory, "sequence__approach_s": APPROACH_s}
        joints.append(config.changed(**shown, virtual__inertia_scale=scale))
    return replace(arm, joints=tuple(joints))


def run_arm_scenario(joints: LockstepArm, scenario: ArmScenario) -> tuple[list[LockstepRun], Any]:
    """The runs of the joints, and the `AxisConstants` that they used."""
    arm = moving(joints.arm, scenario)
    at_zero = [0.0] * len(arm.joints)
    first, starts = new(Reference)[0], []
    for axis, constants in enumerate(arm.axis_constants(list(joints.tables), at_zero)):
        reference_at(constants.trajectory, joints.tables[axis], 0, 0.0, first)
        limits = arm.joints[axis].limits
        start = float(first.position_rad) + scenario.joints[axis].start_offset_rad
        starts.append(min(max(start, limits.position_min_rad + 0.05), limits.position_max_rad - 0.05))
    constants = arm.axis_constants(list(joints.tables), starts)
    parts = [plant_of(*one) for one in zip(arm.joints, scenario.joints, starts, strict=True)]
    plants = tuple(np.concatenate([part[i] for part in parts]).view(np.recarray) for i in (0, 1))
    runs = joints.run_with_faults(
        [joint.faults() for joint in scenario.joints], constants, (plants[0], plants[1]), arm_plant_of(arm),
        longest_s=APPROACH_s + scenario.fault.trajectory.duration_s + SPARE_s, tail_s=_tail_s(joints),
    )  # fmt: skip
    return runs, constants


def _tail_s(joints: LockstepArm) -> float:
    """For how long it is watched: a drive that is left alone brakes along 6085, however slow that is."""
    speeds = [config.limits.velocity_max_radps for config in joints.arm.joints]
    return TAIL_s + LEFT_ALONE_SPEEDS * float((speeds / joints.quick_stop_radps2).max())


# --- the envelope ---


@dataclass(frozen=True)
class Masses:
    """Over the poses: the greatest |M^-1|, the greatest |M_ij| / M_ii, the greatest gravity [Nm], the greatest |M|."""

    inverse: np.ndarray
    throw: np.ndarray
    gravity_Nm: np.ndarray
    inertia: np.ndarray


def masses_of(arm: ArmConfig) -> Masses:
    """With what a scenario's inertias may add."""
    inertias, gravity = pose_models(arm)
    low, high = INERTIA_SCALES
    own = np.diagonal(inertias, axis1=1, axis2=2)
    throw = (np.abs(inertias) / own[:, :, np.newaxis]).max(axis=0) * high / low
    np.fill_diagonal(throw, 0.0)
    inverse = np.abs(np.linalg.inv(inertias)).max(axis=0) / low
    return Masses(inverse, throw, np.abs(gravity).max(axis=0) * high, np.abs(inertias).max(axis=0) * high)


def envelopes(
    joints: LockstepArm,
    masses: Masses,
    scenario: ArmScenario,
    constants: np.recarray,
    reached_radps: float | np.ndarray = np.inf,
) -> list[Envelope]:
    """Of each joint, see the module; `reached_radps`: the greatest speed of each in the run."""
    arm, touching = joints.arm, scenario.touching(joints.arm.joints)
    loads = masses.gravity_Nm + [magnitude_of(joint.events, FaultKind.LOAD_JUMP) for joint in scenario.joints]
    pushes = loads + [sum(joint.plant["torque_ripple_Nm"]) for joint in scenario.joints]
    pushes += [largest_drive_Nm(config) for config in arm.joints]
    push = masses.inverse @ pushes
    speed_limits = np.array([config.limits.velocity_max_radps for config in arm.joints])
    waits = np.array([reaction_s(config, events) for config, events in zip(arm.joints, touching, strict=True)])
    brakes = np.minimum([config.sequence.brake_radps2 for config in arm.joints], joints.quick_stop_radps2)
    alone = speed_limits + push * waits
    fall_s = np.zeros(len(alone))
    for axis, joint in enumerate(scenario.joints):
        for event in joint.events:
            if event.kind in WEAK:
                fall_s[axis] += (alone / brakes)[axis] + BRAKE_SPARE_s
            elif event.kind is FaultKind.LOAD_JUMP:
                fall_s[axis] += event.duration_s
    alone = alone + masses.inverse @ loads * fall_s
    speeds = alone + masses.throw @ alone
    ways = speed_limits * waits + 0.5 * push * waits**2 + speeds * fall_s + speeds**2 / (2.0 * brakes)
    stops = waits + fall_s + np.minimum(speeds, reached_radps) / brakes + BRAKE_SPARE_s
    if not all(map(has_brake, arm.joints)):
        frictions = np.array([
            least_friction_Nm(config) - masses.gravity_Nm[axis] for axis, config in enumerate(arm.joints)
        ])  # fmt: skip
        energy = 0.5 * speeds @ masses.inertia @ speeds
        slowed = np.minimum(speeds, reached_radps)
        least = np.min(frictions / np.sqrt(0.5 * np.diagonal(masses.inertia)))
        stops = stops + 2.0 * np.sqrt(0.5 * slowed @ masses.inertia @ slowed) / least
        ways = ways + energy / frictions
        speeds = np.maximum(speeds, np.sqrt(2.0 * energy * np.diagonal(masses.inverse)))
    found = []
    for axis, config in enumerate(arm.joints):
        shift, speed = _misread(config, scenario, constants[axis], axis, float(ways[axis]))
        found.append(
            _envelope(config, constants[axis], float(ways[axis]) + shift, float(speeds[axis]) + speed, stops.max())
        )
    return found


def _misread(
    config: Config, scenario: ArmScenario, constants: np.recarray, axis: int, way: float
) -> tuple[float, float]:
    """What a wrong reading adds to the joint that has it: (rad, rad/s)."""
    joint = scenario.joints[axis]
    wrong, faster = magnitude_of(joint.events, FaultKind.ENCODER_JUMP), 0.0
    for event in joint.events:
        if event.kind is FaultKind.ENCODER_DRIFT:
            run_s = APPROACH_s + joint.trajectory.duration_s + config.sequence.stop_timeout_s
            wrong += abs(event.magnitude) * min(event.duration_s, run_s + 1.0)
            faster += abs(event.magnitude)
        elif event.kind is FaultKind.ENCODER_REVERSED:
            wrong += 2.0 * config.limits.following_error_max_rad + way
        elif event.kind is FaultKind.ENCODER_STUCK:  # blind, pushed by what a healthy joint does not stand still under
            friction, limits = constants.law.friction, constants.limits
            viscous = min(friction.positive.viscous_Nmspr, friction.negative.viscous_Nmspr)
            blind = float(limits.frozen_torque_Nm / (viscous * config.joint.reduction_ratio))
            blind += largest_drive_Nm(config) / config.joint.inertia_kgm2 * limits.frozen_cycles / config.loop.rate_Hz
            wrong += BLIND_RAD * blind / BLIND_RADPS
            faster += blind
    return wrong, faster


def _envelope(config: Config, constants: np.recarray, way: float, speed: float, stop_s: float) -> Envelope:
    limits, sequence = constants.limits, config.sequence
    return Envelope(
        position_min_rad=limits.position_min_rad - way,
        position_max_rad=limits.position_max_rad + way,
        velocity_max_radps=speed,
        command_max_Nm=limits.torque_max_Nm,
        command_step_Nm=limits.torque_rate_max_Nmps * constants.law.period_s,
        stop_s=float(stop_s),
        ramp_s=sequence.stop_timeout_s + sequence.release_s + float(stop_s),
    )


def has_brake(config: Config) -> bool:
    return config.virtual is not None and config.virtual.brake


def least_friction_Nm(config: Config) -> float:
    """The Coulomb friction at the joint in the worst scenario, less what its motor may add to it."""
    size = config.limits.torque_max_Nm / SIZED_FOR_Nm
    return friction_floor_Nm(config) - RIPPLE_SHARE * size * RIPPLE_Nm


def require_arm_fits(arm: ArmConfig) -> None:
    """`ConfigurationError` for an arm whose campaign would prove nothing."""
    for config in arm.joints:
        require_joint_fits(config)
    if all(map(has_brake, arm.joints)):
        return
    for name, config, gravity_Nm in zip(arm.names, arm.joints, masses_of(arm).gravity_Nm, strict=True):
        if gravity_Nm >= (held_Nm := least_friction_Nm(config)):
            raise ConfigurationError(
                f"{config.path}: gravity at {name} (={gravity_Nm:.2f} Nm) must be less than {held_Nm:.2f} Nm, what its "
                "friction holds in the worst scenario, where a joint of the arm has no brake"
            )


# --- the invariants ---


def judge_arm(joints: LockstepArm, masses: Masses, scenario: ArmScenario) -> Verdict:
    """Run a scenario and check every invariant; `masses` as of `masses_of`.

    Speed, way and time in the verdict are the greatest of all joints; fault and reaction those of the first that
    reported one.
    """
    runs, constants = run_arm_scenario(joints, scenario)
    period_ns, start_ns = round(float(constants[0].law.period_s) * 1e9), int(joints.start_ns)
    peaks = np.array([np.abs(run.truth[:, TRUE_VELOCITY_radps]).max() for run in runs])
    allowed = envelopes(joints, masses, scenario, constants, peaks)
    fault_rows = [fault_row_of(run, start_ns, period_ns) for run in runs]
    first = min((row for row in fault_rows if row >= 0), default=-1)
    found, off_s = [], []
    touching, second = scenario.touching(joints.arm.joints), scenario.second
    for axis, name in enumerate(joints.arm.names):
        wrong, off = wrong_of_joint(runs[axis], allowed[axis], touching[axis], first, start_ns, period_ns)
        found += [f"{name}: {line}" for line in wrong]
        off_s.append(off)
    found += _torque_before_all(runs, start_ns, period_ns) + _not_together(runs)
    found += _wrong_report(runs, scenario, joints.arm, fault_rows, start_ns, period_ns)
    fault, named = scenario.fault, runs[fault_rows.index(first)]
    beyond = [beyond_rad(run, one.limits) for run, one in zip(runs, constants, strict=True)]
    worst = int(np.argmax(beyond))
    return Verdict(
        number=fault.number,
        kind=fault.kind.name.lower(),
        harmless=scenario.twin,
        then="" if second is None else f"{fault.then(second[1])}, {joints.arm.names[second[0]]}",
        fault=named.fault.name,
        reaction=Reaction(int(named.state.reaction)).name,
        violations=tuple(found),
        peak_radps=float(peaks.max()),
        beyond_rad=beyond[worst],
        allowed_rad=allowed[worst].position_max_rad - float(constants[worst].limits.position_max_rad),
        off_s=max((value for value in off_s if value is not None), default=None),
    )


def _torque_before_all(runs: list[LockstepRun], start_ns: int, period_ns: int) -> list[str]:
    """Torque that a joint got before the drives of all were enabled."""
    commanded = np.array([run.log.command_torque_Nm != 0.0 for run in runs]).any(axis=0)
    rows = np.flatnonzero(commanded)
    if not len(rows):
        return []
    row = (int(runs[0].log.time_ns[rows[0]]) - start_ns) // period_ns
    off = [
        axis
        for axis, run in enumerate(runs)
        if not (run.truth[: row + 1, TRUE_POWER_STATE] == PowerState.OPERATION_ENABLED).any()
    ]
    return [f"torque commanded before the drive of joint {axis} was enabled" for axis in off]


def _not_together(runs: list[LockstepRun]) -> list[str]:
    """Joints that went on when another one had begun to stop."""
    stopping = [np.flatnonzero(run.log.phase >= AxisPhase.RAMPING) for run in runs]
    begun = [int(rows[0]) if len(rows) else len(runs[0].log) for rows in stopping]
    late = max(begun) - min(begun)
    return [f"a joint went on for {late} cycles after another had begun to stop"] if late > 1 else []


def _wrong_report(
    runs: list[LockstepRun], scenario: ArmScenario, arm: ArmConfig, fault_rows: list[int], start_ns: int,
    period_ns: int,
) -> list[str]:  # fmt: skip
    """The joint and the cause that are reported first, and what others report after it."""
    faulty, names, touching = scenario.faulty, arm.names, scenario.touching(arm.joints)
    first = min((row for row in fault_rows if row >= 0), default=-1)
    earliest = [axis for axis, row in enumerate(fault_rows) if row == first]
    shaking = any(Fault.LIMIT_CYCLE in causes_of(events) for events in touching)
    if first < 0 or faulty in earliest:
        reported = faulty
    elif common := [axis for axis in earliest if touching[axis]]:
        reported = common[0]
    elif shaking and runs[earliest[0]].fault is Fault.LIMIT_CYCLE:
        reported = earliest[0]  # a joint that swings shakes the others, and a lighter one shows it first
    else:
        return [f"the fault is reported as that of {names[earliest[0]]}, {runs[earliest[0]].fault.name}"]
    everything = [event for joint in scenario.joints for event in joint.events]
    at_once = (touching[reported] if first >= 0 else []) or everything
    # where the drive of a joint does not receive us, the heartbeat is withheld from all
    withheld = LATE_CAUSES & causes_of(everything) if scenario.second is not None else frozenset()
    wrong = wrong_cause(runs[reported], at_once, period_ns * 1e-9, start_ns, twin=scenario.twin, also=withheld)
    found = [f"{names[reported]}: {line}" for line in wrong]
    if scenario.twin:
        return found or [f"{names[axis]}: a harmless fault of {names[faulty]} tripped {run.fault.name}"
                         for axis, run in enumerate(runs) if run.fault is not Fault.NONE]  # fmt: skip
    return found + [
        f"{names[axis]}: reported {run.fault.name} after it"
        for axis, run in enumerate(runs)
        if axis != reported
        and run.fault is not Fault.NONE
        and run.fault not in MOTION | LATE_CAUSES | causes_of(touching[axis])
    ]
