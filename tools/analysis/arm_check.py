"""What an arm asks of its buses and of the loops of its joints: bus budgets, inertias and gravity over the poses."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from jointctl.drivers.can.frames import bus_load, highest_rate_Hz
from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.arm_model import newton_euler
from jointctl.firmware_py.kernel import bound
from jointctl.firmware_py.motion_records import Reference, TrajectoryConstants
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.trajectory import reference_at
from jointctl.tools.analysis.linear_loop import LoopSettings, RigidJoint, loop_settings
from jointctl.tools.analysis.margins import Margins, margins
from jointctl.tools.configuration.arm import ArmConfig
from jointctl.tools.configuration.canopen import cycle_bytes
from jointctl.tools.configuration.config import Config

# of a bus by the cyclic frames at worst-case stuffing; above that of one joint, whose rate is seldom as high as the bus
# allows: the rest carries the same few heartbeats and emergencies
HIGHEST_LOAD = 0.85
RATES_Hz = (4000, 2000, 1000, 500, 250, 200, 125, 100)  # that a clock divides well
MOST_POSES = 3000
FINE_GRID = 9  # points a joint
MOTION_SAMPLES = 400  # of a motion whose torques are looked at
GOLDEN_RATIO = 0.5 * (math.sqrt(5.0) - 1.0)
SHORTEST_SHARE = 1e-4  # of the motion: from there on its beginning is looked at more closely


@dataclass(frozen=True)
class BusBudget:
    """The cyclic frames of one bus at the rate of the loop."""

    channel: str
    joints: tuple[str, ...]
    bits: int  # of a cycle, at worst
    load: float
    fitting_Hz: float  # the highest rate of `RATES_Hz` that fits; 0 if none does
    buses: tuple[tuple[str, ...], ...]  # on which the joints fit at the loop's rate, in their order; () if on none


@dataclass(frozen=True)
class PoseRange:
    """Of one joint over a grid of poses within the limits."""

    least_kgm2: float  # M_ii
    greatest_kgm2: float
    gravity_Nm: float  # greatest magnitude


@dataclass(frozen=True)
class JointOfArm:
    """The loop of one joint, with the worst of the inertias that the poses give."""

    name: str
    config: Config
    poses: PoseRange
    settings: LoopSettings
    margins: Margins


def bus_budgets(arm: ArmConfig) -> list[BusBudget]:
    """One for each bus; SYNC counts once."""
    buses: dict[tuple[str, str, int], list[tuple[str, Config]]] = {}
    for name, config in zip(arm.names, arm.joints, strict=True):
        bus = config.bus
        buses.setdefault((bus.interface, bus.channel, bus.bitrate_bitps), []).append((name, config))
    budgets = []
    for (_, channel, bitrate), joints in buses.items():
        lengths = [0, *(n for _, config in joints for n in cycle_bytes(config)[1:])]
        load = bus_load(lengths, arm.rate_Hz, bitrate)
        most_Hz = highest_rate_Hz(lengths, bitrate, HIGHEST_LOAD)
        fitting = next((rate for rate in RATES_Hz if rate <= most_Hz), 0)
        bits = round(load * bitrate / arm.rate_Hz)
        names, split = tuple(name for name, _ in joints), _split(joints, arm.rate_Hz, bitrate)
        budgets.append(BusBudget(channel, names, bits, load, float(fitting), split))
    return budgets


def _split(joints: list[tuple[str, Config]], rate_Hz: float, bitrate: int) -> tuple[tuple[str, ...], ...]:
    """The joints' names on as few buses as carry them, neighbours together; () where one is too much for a bus."""
    buses: list[list[str]] = []
    lengths: list[int] = []
    for name, config in joints:
        own = cycle_bytes(config)[1:]
        if not buses or bus_load([*lengths, *own], rate_Hz, bitrate) > HIGHEST_LOAD:
            buses.append([])
            lengths = [0]
        lengths += own
        buses[-1].append(name)
        if bus_load(lengths, rate_Hz, bitrate) > HIGHEST_LOAD:
            return ()
    return tuple(map(tuple, buses))


def require_budgets(arm: ArmConfig) -> list[BusBudget]:
    """The budgets; `ConfigurationError` for a bus that cannot carry its joints at this rate."""
    budgets = bus_budgets(arm)
    full = [budget for budget in budgets if budget.load > HIGHEST_LOAD]
    if full:
        worst = max(full, key=lambda budget: budget.load)
        fits = f"{worst.fitting_Hz:g} Hz fits" if worst.fitting_Hz else "no rate of [100..4000] fits"
        more = "at this rate one of them alone is too much for a bus"
        if worst.buses:
            split = " + ".join(str(len(names)) for names in worst.buses)
            more = f"at this rate they fit on {len(worst.buses)} buses, as {split} joints"
        raise ConfigurationError(
            f"{arm.path}: bus {worst.channel}: {len(worst.joints)} joints ({', '.join(worst.joints)}) need "
            f"{worst.bits} bits a cycle, {worst.load:.1%} of the bus at loop.rate_Hz (={arm.rate_Hz:g}), "
            f"{HIGHEST_LOAD:.0%} allowed",
            f"{fits} in every joint's file; {more}: bus.channel of each",
        )
    return budgets


def poses(arm: ArmConfig) -> Iterator[tuple[float, ...]]:
    """A grid within the joints' limits, their ends included; the middle is among them.

    Of more than three joints it is coarse, and ends that are turns apart are one pose: as many again fill the space.
    """
    axes = len(arm.joints)
    low, high = (np.array([getattr(c.limits, f"position_{end}_rad") for c in arm.joints]) for end in ("min", "max"))
    count = int(MOST_POSES ** (1.0 / axes)) // 2 * 2 + 1
    if 3**axes <= MOST_POSES:
        yield from itertools.product(*np.linspace(low, high, count).T)
    else:
        yield tuple(0.5 * (low + high))
    if count < FINE_GRID:
        golden = max(np.roots([1.0, *[0.0] * (axes - 1), -1.0, -1.0]).real)  # of that many dimensions
        steps = golden ** -np.arange(1.0, axes + 1.0)
        for k in range(MOST_POSES):
            yield tuple(low + (high - low) * ((0.5 + k * steps) % 1.0))


def pose_models(arm: ArmConfig) -> tuple[np.ndarray, np.ndarray]:
    """M, float64 (poses, N, N), and gravity's torques, (poses, N), over the grid of poses."""
    memory = arm.model.memory()
    axes = len(arm.joints)
    gravity_mps2 = memory.constants["gravity_mps2"][0]  # views: thousands of poses would wait for records
    position_rad, acceleration_radps2, torque_Nm = (
        memory.motion[name][:axes] for name in ("position_rad", "acceleration_radps2", "torque_Nm")
    )
    find_torques = bound(newton_euler, memory)
    inertias, loads = [], []
    for pose in poses(arm):
        position_rad[:] = pose
        gravity_mps2[:] = arm.arm.gravity_mps2
        acceleration_radps2[:] = 0.0
        find_torques()
        loads.append(torque_Nm.copy())
        gravity_mps2[:] = 0.0
        inertia = np.zeros((axes, axes))
        for axis in range(axes):
            acceleration_radps2[:] = 0.0
            acceleration_radps2[axis] = 1.0
            find_torques()
            inertia[axis] = torque_Nm
        inertias.append(inertia)
    return np.array(inertias), np.array(loads)


def pose_ranges(arm: ArmConfig) -> list[PoseRange]:
    """Inertias M_ii and gravity of each joint over the grid of poses."""
    inertias, loads = pose_models(arm)
    own = np.diagonal(inertias, axis1=1, axis2=2)
    low, high, load = own.min(axis=0), own.max(axis=0), np.abs(loads).max(axis=0)
    return [PoseRange(float(low[i]), float(high[i]), float(load[i])) for i in range(len(load))]


def load_torques(arm: ArmConfig) -> None:
    """Compile or load what `require_torques` calls: that may take seconds."""
    newton_euler(arm.model.memory())
    reference_at(new(TrajectoryConstants)[0], np.zeros((1, 5)), 0, 0.0, new(Reference)[0])


def moments_s(duration_s: float) -> np.ndarray:
    """`MOTION_SAMPLES` of them, in order: half spread over the motion, half over ever shorter beginnings of it.

    The steps never repeat, so that none coincides with the period of a sine; a short move with a long rest is seen too.
    """
    spread = np.modf(np.arange(1, MOTION_SAMPLES // 2 + 1) * GOLDEN_RATIO)[0]
    return np.sort(np.concatenate((spread * duration_s, duration_s * SHORTEST_SHARE**spread)))


def require_torques(
    arm: ArmConfig, trajectories: Sequence[Any], tables: np.ndarray, duration_s: float, alive: Callable[[], None],
    what: str = "the motion",
) -> None:  # fmt: skip
    """`ConfigurationError` where the model asks more of a joint than its limit, at one of `MOTION_SAMPLES` moments.

    `trajectories`: TrajectoryConstants of each joint, `tables` their rows; `alive` is called in between;
    `what` they are.
    """
    memory = arm.model.memory()
    motion: Any = memory.motion
    reference: Any = new(Reference)[0]
    find_torques = bound(newton_euler, memory)
    rows = [0] * len(trajectories)
    times_s = moments_s(duration_s)
    torques_Nm = np.zeros((len(times_s), len(trajectories)))
    for time_s, torques in zip(times_s, torques_Nm, strict=True):
        alive()
        for axis, trajectory in enumerate(trajectories):
            rows[axis] = reference_at(trajectory, tables[axis], rows[axis], float(time_s), reference)
            own = motion[axis]
            own.position_rad, own.velocity_radps = reference.position_rad, reference.velocity_radps
            own.acceleration_radps2 = reference.acceleration_radps2
        find_torques()
        torques[:] = motion.torque_Nm[: len(torques)]
    for name, config, torques in zip(arm.names, arm.joints, torques_Nm.T, strict=True):
        worst, limit_Nm = int(np.argmax(np.abs(torques))), config.limits.torque_max_Nm
        if not abs(torques[worst]) <= limit_Nm:
            raise ConfigurationError(
                f"{name}: {what} takes {torques[worst]:.3g} Nm at {times_s[worst]:.3g} s by the arm's model, "
                f"must be in [{-limit_Nm:g}..{limit_Nm:g}], limits.torque_max_Nm"
            )


def joint_loop(name: str, config: Config, found: PoseRange, delay_s: float | None = None) -> JointOfArm:
    """Margins of a joint's loop with the least and the greatest inertia; of a flexible one the link's goes with it."""
    reducer, inertia = config.reducer, config.joint.inertia_kgm2
    config = config.changed(joint__gravity_Nm=found.gravity_Nm)  # the arm's, in the worst pose
    ends = found.least_kgm2, found.greatest_kgm2
    if reducer is not None:
        motor = reducer.motor_inertia_kgm2
        low, high = ((end - motor) / (inertia - motor) for end in ends)
        known = config.margin.payload_range  # what a single joint must bear, besides
        factors = min(low, known[0]), max(high, known[1])
        config = config.changed(margin__payload_range=factors)
        settings, _ = loop_settings(config, delay_s)
    else:
        settings, _ = loop_settings(config, delay_s)
        rigid = tuple(RigidJoint(end, f"inertia {end:.3g} kg m2") for end in ends)
        settings = replace(settings, joints=rigid)
    return JointOfArm(name, config, found, settings, margins(settings))


def not_held(arm: ArmConfig, ranges: Sequence[PoseRange]) -> Iterator[str]:
    """Joints whose torque gravity exceeds in poses within the limits."""
    for name, config, found in zip(arm.names, arm.joints, ranges, strict=True):
        if found.gravity_Nm >= config.limits.torque_max_Nm:
            yield (
                f"joint {name}: gravity reaches {found.gravity_Nm:.3g} Nm within the joints' limits, and "
                f"limits.torque_max_Nm (={config.limits.torque_max_Nm:g}) of {config.path.name} must be more"
            )


def require_held(arm: ArmConfig) -> list[PoseRange]:
    """The ranges of the poses within the limits; `ConfigurationError` where gravity exceeds a joint's torque."""
    ranges = pose_ranges(arm)
    for problem in not_held(arm, ranges):
        raise ConfigurationError(
            f"{arm.path}: {problem}", "or let no joint reach such poses: narrow the limits.position_*_rad"
        )
    return ranges


def joint_loops(arm: ArmConfig, delay_s: float | None = None) -> list[JointOfArm]:
    """One for each joint, over the poses within the limits; `ConfigurationError` as of `require_held`."""
    return [
        joint_loop(name, config, found, delay_s)
        for name, config, found in zip(arm.names, arm.joints, require_held(arm), strict=True)
    ]
