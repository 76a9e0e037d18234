"""What the check is going to do: a soft spring between joint and reference pulls it a little to and fro.

The spring is the loop's own law with gains that are made for it, so every limit, watchdog and stop of a run is in
force.  Its torque grows with the distance of the reference and is limited to a small share; a joint that is free
follows as soon as the torque exceeds its friction, one that is stuck does not, and one with a wrong sign runs into
the velocity limit or the following error of the check, which are as narrow as the encoder's counts allow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from jointctl.drivers.drive import CommissioningReport
from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.states import TrajectoryKind
from jointctl.firmware_py.trajectory import spline_table
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import joint_rad_per_count, static_friction_Nm, velocity_of_a_count_radps
from jointctl.tools.configuration.records import APPROACH_MIN_S, axis_constants
from jointctl.tools.recording.log_folder import log_path
from jointctl.tools.session.plan import Placed, RunPlan, joint_lines, remark_lines

TRAVEL_rad, TRAVEL_MAX_rad = 0.04, 0.3  # of the reference, to each side
TRAVEL_COUNTS = 60.0  # so coarse an encoder takes more travel
REACH = 2.5  # times the travel: where the position limits of the check are
VELOCITY_MAX_radps = 0.5
COUNTS_IN_VELOCITY = 2.0  # what a coarse encoder may add to it, in steps of its reading
PEAK = 1.875  # of the velocity over its mean, in a minimum-jerk ramp
STATIC_FRICTIONS = 2.0  # torque limit of the check, over the static friction that is configured
TORQUE_SHARE = 0.1  # of limits.torque_max_Nm, where no friction is configured
# The spring reaches the limit at 0.7 of the travel.  Friction that takes half of the limit lets go at 0.36; on the way
# back the spring has to turn round first, and it takes twice that, with friction as strong as the push 1.07 travels.
SPRING_SHARE = 1.4  # of the torque limit that gravity leaves, at full travel
PUSH_SHARE = 0.75  # of it: a joint that stands still under that is stuck, or its reading is
MOST_PUSH = 0.95  # of the torque limit, where gravity takes nearly all of it
STANDING_WAY = 1.2  # travels of the reference past a reading that stands still
DAMPING = 0.5
RAMP_s, REST_s = 0.4, 0.4  # a longer travel takes a longer ramp
STOPS = (1.0, 0.0, -1.0, 0.0)  # where the reference goes, in travels
_ROWS_PER_RAMP = 16


@dataclass(frozen=True)
class CheckPlan:
    """The numbers that the user reads before anything moves; joint side."""

    torque_Nm: float
    travel_rad: float
    velocity_radps: float
    static_friction_Nm: float | None  # that is configured
    gravity_Nm: float  # that the law holds, at most

    @property
    def spring_Nm(self) -> float:
        """What gravity leaves of the torque."""
        return max(self.torque_Nm - self.gravity_Nm, 0.2 * self.torque_Nm)

    @property
    def ramp_s(self) -> float:
        """Of one ramp: longer travel is no faster."""
        return RAMP_s * max(1.0, self.travel_rad / TRAVEL_rad)

    @property
    def reach_rad(self) -> float:
        """How far to each side the joint may come before it is braked."""
        return REACH * self.travel_rad

    @property
    def duration_s(self) -> float:
        return APPROACH_MIN_S + len(STOPS) * (self.ramp_s + REST_s)


def make_plan(config: Config, torque_Nm: float | None) -> CheckPlan:
    """`torque_Nm` is the user's; else twice the static friction, or a tenth of what a run may use."""
    limits, static_Nm = config.limits, static_friction_Nm(config)
    if torque_Nm is None:
        own_Nm = STATIC_FRICTIONS * static_Nm if static_Nm else TORQUE_SHARE * limits.torque_max_Nm
        torque_Nm = min(own_Nm + abs(config.joint.gravity_Nm), limits.torque_max_Nm)
    elif not 0.0 < torque_Nm <= limits.torque_max_Nm:
        raise ConfigurationError(
            f"--torque (={torque_Nm:g}) must be in (0..{limits.torque_max_Nm:g}], which is limits.torque_max_Nm"
        )
    resolutions = [abs(joint_rad_per_count(config))]
    if config.joint_encoder is not None:
        resolutions.append(math.tau / config.joint_encoder.counts_per_turn)
    travel = min(max(TRAVEL_rad, TRAVEL_COUNTS * max(resolutions)), TRAVEL_MAX_rad)
    steps_radps = COUNTS_IN_VELOCITY * velocity_of_a_count_radps(config)
    velocity = min(max(VELOCITY_MAX_radps, steps_radps + PEAK * TRAVEL_rad / RAMP_s), limits.velocity_max_radps)
    return CheckPlan(torque_Nm, travel, velocity, static_Nm, abs(config.joint.gravity_Nm))


def config_of_check(config: Config, plan: CheckPlan) -> Config:
    """The configuration with the limits and the law of the check; the drive's own torque limit follows from it."""
    limits = config.limits.model_copy(
        update={
            "torque_max_Nm": plan.torque_Nm,
            "velocity_max_radps": plan.velocity_radps,
            "following_error_max_rad": 1.25 * plan.travel_rad,
        }
    )
    kp = SPRING_SHARE * plan.spring_Nm / plan.travel_rad / config.joint.inertia_kgm2
    law = {
        "kind": "computed_torque", "kp": kp, "kv": 2.0 * DAMPING * math.sqrt(kp), "feed_forward": "none",
        "learning": None,
    }  # fmt: skip
    control = config.control.model_copy(update=law)
    drive = config.drive.free_of_torque_limit()
    return config.model_copy(update={"limits": limits, "control": control, "drive": drive})


def motion_table(plan: CheckPlan, start_rad: float) -> np.ndarray:
    """Rows of `trajectory.reference_at`, float64 (N, 5): smooth ramps from stop to stop, and a rest at each."""
    times_s, places, end_s, place = [0.0], [0.0], 0.0, 0.0
    for stop in STOPS:
        for share in np.linspace(0.0, 1.0, _ROWS_PER_RAMP + 1)[1:]:
            times_s.append(end_s + share * plan.ramp_s)
            places.append(place + (stop - place) * share**3 * (10.0 - 15.0 * share + 6.0 * share**2))
        for share in (0.5, 1.0):
            times_s.append(end_s + plan.ramp_s + share * REST_s)
            places.append(stop)
        end_s, place = times_s[-1], stop
    position_rad = start_rad + plan.travel_rad * np.array(places)
    return spline_table(np.array(times_s), position_rad)


@dataclass(frozen=True)
class CheckMotion:
    """The motion of the check; see `session.plan.Motion`.  `config` is that of `config_of_check`."""

    config: Config
    plan: CheckPlan

    @property
    def table(self) -> np.ndarray:
        """See `Motion`."""
        return motion_table(self.plan, 0.0)

    def placed(self, report: CommissioningReport) -> Placed:
        """See `Motion`; about the place where the joint stands."""
        table = motion_table(self.plan, report.start_position_rad)
        return Placed(self.constants(report, table), table, tuple(self._envelope(report)))

    def require_start(self, start_position_rad: float) -> None:
        """`ConfigurationError` if the joint stands too near to a limit."""
        limits, travel_rad = self.config.limits, self.plan.travel_rad
        low, high = limits.position_min_rad + travel_rad, limits.position_max_rad - travel_rad
        if not low <= start_position_rad <= high:
            raise ConfigurationError(
                f"the joint stands at {start_position_rad:.4f} rad; the check moves it by up to {travel_rad:g} rad to "
                f"both sides and needs [{low:g}..{high:g}]",
                "turn it by hand with the power off, or correct limits.position_*, encoder.zero_counts",
            )

    def _envelope(self, report: CommissioningReport) -> list[str]:
        """What is about to happen, in lines."""
        plan, start = self.plan, report.start_position_rad
        return [
            *joint_lines(report),
            f"motion     a soft spring pulls the joint towards {start + plan.travel_rad:+.3f}, then "
            f"{start - plan.travel_rad:+.3f} rad, {plan.duration_s:.0f} s",
            f"limits     {plan.torque_Nm:.1f} Nm, {plan.velocity_radps:.2f} rad/s; it is braked beyond "
            f"{plan.reach_rad:.2g} rad to either side: keep it free and unloaded, a hand on the emergency stop",
            "watch      which way it turns first: it must be the one that you call positive",
            *remark_lines(report.remarks),
        ]

    def constants(self, report: CommissioningReport, table: np.ndarray) -> Any:
        """`AxisConstants` of the check along `table`."""
        config, plan, start_rad = self.config, self.plan, report.start_position_rad
        hold = config.model_copy(update={"sequence": config.sequence.model_copy(update={"approach_s": APPROACH_MIN_S})})
        constants = axis_constants(hold, table, start_position_rad=start_rad)
        axis = constants[0]
        axis.trajectory.kind, axis.trajectory.repeats = TrajectoryKind.TABLE, 0
        axis.trajectory.table_rows, axis.trajectory.duration_s = len(table), float(table[-1, 0])
        axis.limits.position_min_rad = max(axis.limits.position_min_rad, start_rad - plan.reach_rad)
        axis.limits.position_max_rad = min(axis.limits.position_max_rad, start_rad + plan.reach_rad)
        axis.limits.frozen_max_rad = STANDING_WAY * plan.travel_rad
        axis.limits.frozen_torque_Nm = min(plan.gravity_Nm + PUSH_SHARE * plan.spring_Nm, MOST_PUSH * plan.torque_Nm)
        return constants


def check_run(config: Config, plan: CheckPlan) -> RunPlan:
    """The plan of a session; `config` is the user's own."""
    inner = config_of_check(config, plan)
    return RunPlan(inner, CheckMotion(inner, plan), log_path(config))
