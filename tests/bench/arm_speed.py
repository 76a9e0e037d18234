"""The arm's model, and an arm of three joints in the lockstep simulation."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np

from jointctl.firmware_py.arm_model import Arm, newton_euler
from jointctl.firmware_py.kernel import kernel
from jointctl.tools.configuration.arm import SHIPPED_ARM, load_arm
from jointctl.tools.lockstep import LockstepArm
from tests.arms import arm_of, random_links, set_motion
from tests.bench.paired import Row, interleaved, measured

TICKS = 20_000
MODEL_GOAL_us = 1.0  # for seven joints
LOCKSTEP_S, LOCKSTEP_GOAL_S = 100.0, 0.6  # three joints


@kernel
def run_model(arm: Arm, ticks: int) -> None:
    """So many poses, one after the other."""
    for i in range(ticks):
        arm.motion[0].position_rad = 1e-3 * i
        newton_euler(arm)


def model_us(joints: int) -> Callable[[], float]:
    """Time of one call for a chain of revolute joints with skew axes."""
    random = np.random.default_rng(joints)
    links = random_links(random, joints, prismatic=0.0)
    links.parent[:] = np.arange(joints) - 1
    arm = arm_of(links)
    set_motion(arm, *random.normal(size=(3, joints)))
    run_model(arm, 1)  # compiles

    def measure() -> float:
        begin_s = time.perf_counter()
        run_model(arm, TICKS)
        return (time.perf_counter() - begin_s) * 1e6 / TICKS

    return measure


def arm_rows(*, pairs: int, runs: int) -> Iterator[Row]:
    """Recursive Newton-Euler for three and seven joints; 100 s of three coupled joints."""
    three, seven = interleaved(pairs, model_us(3), model_us(7))
    yield measured("arm", "model of 3 joints", three, "us", note=f"best {min(three):.2f} us")
    yield measured("arm", "model of 7 joints", seven, "us", goal=MODEL_GOAL_us, note=f"best {min(seven):.2f} us")
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
