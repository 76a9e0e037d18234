"""An axis that takes changes while it moves, and what is asked of it."""

from __future__ import annotations

from typing import Any

from jointctl.firmware_py.live_change import gains_of
from jointctl.firmware_py.motion_records import ChangeAnswer, ChangeKind, TrajectoryConstants
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import TrajectoryKind

GAINS = ("kp", "kv", "ki", "observer_radps", "learning_rate")
RAMP_s = 0.05


def live(run: Any) -> Any:
    """The rig with limits for changes: gains by a factor of 2, moves at 2 rad/s."""
    change, law = run.axis.change, run.axis.law
    gains_of(law, change.low)
    gains_of(law, change.high)
    for name in GAINS:
        setattr(change.low, name, getattr(change.low, name) / 2.0)
        setattr(change.high, name, getattr(change.high, name) * 2.0)
    change.ramp_s, change.q1, change.q2 = RAMP_s, 1800.0, 1800.0
    change.move_speed_radps, change.move_acceleration_radps2, change.move_min_s = 2.0, 20.0, 0.05
    return run


def post(run: Any, what: int, /, **fields: Any) -> int:
    """What the supervisor does: the request first, its number last."""
    change = run.axis.change
    number = int(change.order[0]) + 1
    request = change.request
    request.first = request.last = number
    request.kind = what
    gains_of(run.axis.law, request.gains)
    target = request.gains if what == ChangeKind.GAINS else request.trajectory
    for name, value in fields.items():
        setattr(target, name, value)
    change.order[0] = number
    return number


def answered(run: Any, number: int) -> ChangeAnswer:
    run.tick()
    assert run.state.change.answered == number
    return ChangeAnswer(int(run.state.change.answer))


def hold(run: Any, at_rad: float) -> int:
    run.axis.change.request.trajectory = new(TrajectoryConstants)[0]
    return post(run, ChangeKind.MOTION, kind=TrajectoryKind.HOLD, start_rad=at_rad, target_rad=at_rad)
