"""The arm's model, the whole tick of its loop, and an arm of three joints in the lockstep simulation."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from jointctl.drivers.errors import JointctlError
from jointctl.firmware_py.arm_model import Arm, ArmFeedForward, newton_euler
from jointctl.firmware_py.cycle import HISTOGRAM_BINS, WORDS, Clock, CycleMemory, Exchange, Histogram, Slot, step_cycle
from jointctl.firmware_py.kernel import inlined, kernel
from jointctl.firmware_py.records import AxisState, Command, LogRecord, Sample
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.sequence import reset_axis
from jointctl.firmware_py.states import AxisPhase, DriveRequest, DriveState
from jointctl.tools.configuration.arm import SHIPPED_ARM, load_arm
from jointctl.tools.configuration.records import axis_constants, trajectory_table
from jointctl.tools.lockstep import LockstepArm
from tests.arms import arm_of, random_links, set_motion
from tests.bench.paired import Row, interleaved, measured

TICKS = 20_000
AT_ONCE = 500  # ticks: about a millisecond, so that other programs come between two measurements and not into one
MODEL_GOAL_us = 1.0  # for seven joints
TICK_GOAL_us = 3.0  # for seven joints
PERIOD_NS, TO_TRACKING = 1_000_000, 3000  # cycles until the joints track, at most
LOCKSTEP_S, LOCKSTEP_GOAL_S = 100.0, 0.6  # three joints


@kernel
def run_model(arm: Arm, ticks: int) -> None:
    """So many poses, one after the other."""
    for i in range(ticks):
        arm.motion[0].position_rad = 1e-3 * i
        newton_euler(arm)


def chain(joints: int) -> Arm:
    """Revolute joints with skew axes, on one another."""
    random = np.random.default_rng(joints)
    links = random_links(random, joints, prismatic=0.0)
    links.parent[:] = np.arange(joints) - 1
    arm = arm_of(links)
    arm.constants[0].feed_forward = ArmFeedForward.WHOLE
    set_motion(arm, *random.normal(size=(3, joints)))
    return arm


def model_us(joints: int) -> Callable[[], float]:
    """Time of one call for a chain."""
    arm = chain(joints)
    run_model(arm, 1)  # compiles

    def measure() -> float:
        begin_s = time.perf_counter()
        run_model(arm, TICKS)
        return (time.perf_counter() - begin_s) * 1e6 / TICKS

    return measure


@inlined
def _answer(memory: CycleMemory, samples: np.ndarray, now_ns: int, until_ns: int) -> int:
    """Drives that obey at once, on joints that are where they should be."""
    for axis in range(len(samples)):
        sample = samples[axis]
        sample.count += 1
        sample.time_ns = now_ns + 1
        sample.position_rad = memory.state[axis].reference.position_rad
        request = memory.command[axis].request
        sample.drive_state = DriveState.OFF
        if request == DriveRequest.PREPARE:
            sample.drive_state = DriveState.PREPARED
        elif request == DriveRequest.ENABLE:
            sample.drive_state = DriveState.ENABLED
    return 1


@inlined
def _taken(memory: CycleMemory, samples: np.ndarray, commands: np.ndarray) -> int:
    return 0


@inlined
def _now_ns(timespec: np.ndarray) -> int:
    return int(timespec[0])


@inlined
def _never_slept_ns(words: np.ndarray, timespec: np.ndarray) -> int:
    return 0


@kernel
def run_ticks(memory: CycleMemory, ticks: int) -> None:
    """So many whole cycles: samples, supervision, motions, model, laws, limits, log records; no frames, no waiting."""
    exchange, clock = Exchange(_answer, _taken, memory), Clock(_now_ns, _never_slept_ns)
    for _ in range(ticks):
        now_ns = memory.timespec[0] + PERIOD_NS
        memory.timespec[0] = now_ns
        step_cycle(memory, exchange, clock, Slot(PERIOD_NS, now_ns, now_ns, 0, 1, now_ns))


def tracking_arm(joints: int) -> CycleMemory:
    """Joints of the shipped arm's shoulder, each with law and adaptation, in a chain whose model is fed forward."""
    config = load_arm(SHIPPED_ARM).joints[0]
    one = axis_constants(config, trajectory_table(config), start_position_rad=0.0)
    constants: Any = np.concatenate([one] * joints).view(np.recarray)
    constants.sequence.supervisor_max_cycles[:] = 0
    constants.trajectory.duration_s[:] = 1e9
    constants.law.of_arm[:] = 1
    constants.limits.torque_max_Nm[:] = 1e6  # the links are none that this joint could carry
    constants.limits.frozen_torque_Nm[:] = 0.0
    state = new(AxisState, joints)
    for axis in range(joints):
        reset_axis(constants[axis], state[axis])
    memory = CycleMemory(
        constants, state, np.zeros((joints, 1, 5)), new(Sample, joints), new(Command, joints),
        np.zeros(WORDS, np.int64), new(LogRecord, 1 << 14), np.zeros((len(Histogram), HISTOGRAM_BINS), np.int64),
        np.zeros(2, np.int64), chain(joints),
    )  # fmt: skip
    run_ticks(memory, TO_TRACKING)
    return memory


def tick_us(joints: int) -> Callable[[], float]:
    """Time of one whole cycle while all joints track; `JointctlError` if they do not."""
    memory = tracking_arm(joints)

    def measure() -> float:
        begin_s = time.perf_counter()
        run_ticks(memory, AT_ONCE)
        took_us = (time.perf_counter() - begin_s) * 1e6 / AT_ONCE
        if (memory.state["phase"] != AxisPhase.TRACKING).any():
            raise JointctlError(f"the joints do not track: phases {memory.state['phase']}")
        return took_us

    return measure


def arm_rows(*, pairs: int, runs: int) -> Iterator[Row]:
    """Recursive Newton-Euler and the whole tick for three and seven joints; 100 s of three coupled joints."""
    three, seven = interleaved(pairs, model_us(3), model_us(7))
    yield measured("arm", "model of 3 joints", three, "us", note=f"best {min(three):.2f} us")
    yield measured("arm", "model of 7 joints", seven, "us", goal=MODEL_GOAL_us, note=f"best {min(seven):.2f} us")
    three, seven = interleaved(20 * pairs, tick_us(3), tick_us(7))
    yield measured("arm", "tick of 3 joints", three, "us", note=f"best {min(three):.2f} us")
    yield measured("arm", "tick of 7 joints", seven, "us", goal=TICK_GOAL_us, note=f"best {min(seven):.2f} us")
    arm = LockstepArm(load_arm(SHIPPED_ARM))
    constants = arm.constants()
    constants.trajectory.duration_s[:] = 2.0 * LOCKSTEP_S
    arm.run(constants, longest_s=0.1)  # compiles
    bare = []
    for _ in range(runs):
        begin_s = time.perf_counter()
        arm.run(constants, longest_s=LOCKSTEP_S, log_every=1000)
        bare.append(time.perf_counter() - begin_s)
    note = f"best {min(bare):.3f} s"
    yield measured("arm", f"{LOCKSTEP_S:g} s of lockstep, 3 joints", bare, "s", goal=LOCKSTEP_GOAL_S, note=note)
