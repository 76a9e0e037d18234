"""The motions of a tune, one of which each scenario of `fault-campaign --tune` breaks.

The law, the limits and the table are those of the step itself; a response has one pair of legs, a friction step few
plateaus.  Where the joint stands is drawn: a step begins from anywhere.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from jointctl.firmware_py.friction import friction_curve_Nm
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import friction_constants, static_friction_Nm
from jointctl.tools.experiments.fault_scenarios import PlacedSweep, TuneStep, placed_sweep
from jointctl.tools.inspection.motion_check import CheckMotion, config_of_check, make_plan
from jointctl.tools.lockstep import LockstepJoint
from jointctl.tools.session.plan import Motion
from jointctl.tools.tuning.excitation import SPEED_radps, motor_fed
from jointctl.tools.tuning.found_values import with_break_away, with_sliding
from jointctl.tools.tuning.measured_response import response_task
from jointctl.tools.tuning.tune_options import AS_IT_FITS


def placed_step(config: Config, joint: LockstepJoint, step: TuneStep, start_rad: float) -> PlacedSweep:
    """`step` of a tune of the joint, which stands at `start_rad`."""
    motion: Motion
    # what the step of the direction finds, on this joint
    static_Nm = static_friction_Nm(config) or 0.0
    unknown = with_break_away(config, static_Nm)
    if step.name == "friction":
        if config.friction is not None:  # and what the response adds
            curve = friction_constants(config.friction, config.joint.reduction_ratio)
            at_radps = np.array([SPEED_radps, -SPEED_radps])
            sliding = config.joint.reduction_ratio * friction_curve_Nm(curve, at_radps)
            unknown = with_sliding(config, static_Nm, (float(sliding[0]), float(sliding[1])), 0.0)
        return placed_sweep(unknown, joint, step.strokes, start_rad)
    if step.name == "direction":
        moving = motor_fed(config)
        plan = make_plan(moving, None)
        motion = CheckMotion(config_of_check(moving, plan), plan)
    else:
        task = response_task(unknown, AS_IT_FITS)
        motion = task.motion(step.share * task.largest_Nm, 1)
    placed = motion.placed(replace(joint.report, start_position_rad=start_rad))
    constants: Any = placed.constants
    return PlacedSweep(constants, placed.table, start_rad, float(constants[0].trajectory.duration_s))
