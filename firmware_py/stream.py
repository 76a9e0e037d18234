"""Set-points that come while the joint moves: a cubic through them, a little later than they say; rest without them.

A program writes set-points into the ring of `StreamConstants`.  The loop follows the cubic (Hermite) through two of
them at a time, `delay_ns` behind their times, so that the next one is there before it is needed.  Of set-points that
lie closer than a third of that, the last one counts: over so short a time positions and velocities that do not quite
belong together would make a jolt.  For the same reason the acceleration is that between their velocities, not the
cubic's own.

Nothing is extrapolated: where no set-point is there in time, the reference brakes as in a controlled stop, and the next
one is approached from wherever the reference is then.  The loop trusts nobody: a set-point that breaks a limit
(`safety.set_point_problem`), comes late or while another motion is under way is left out and counted.
"""

from __future__ import annotations

import math

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.motion_records import MotionChange, Reference
from jointctl.firmware_py.records import SET_POINTS, AxisConstants, AxisState, SetPoint, StreamConstants, StreamState
from jointctl.firmware_py.safety import set_point_problem
from jointctl.firmware_py.states import AxisPhase, SetPointProblem, TrajectoryKind
from jointctl.firmware_py.trajectory import brake_step, cubic

CLOSE_SHARE = 3  # of the delay: set-points nearer than that are one


@kernel
def reset_stream(state: StreamState) -> None:
    """Begin a run: nothing has come."""
    state.written = 0
    state.taken = 0
    state.refused = 0
    state.following = 0
    state.torque_Nm = 0.0


@kernel
def _fetch(stream: StreamConstants, number: int, point: SetPoint) -> None:
    slot = number % SET_POINTS
    point.time_ns = stream.time_ns[slot]
    point.position_rad = stream.values[slot, 0]
    point.velocity_radps = stream.values[slot, 1]
    point.acceleration_radps2 = stream.values[slot, 2]
    point.torque_Nm = stream.values[slot, 3]


@kernel
def _copy(source: SetPoint, target: SetPoint) -> None:
    target.time_ns = source.time_ns
    target.position_rad = source.position_rad
    target.velocity_radps = source.velocity_radps
    target.acceleration_radps2 = source.acceleration_radps2
    target.torque_Nm = source.torque_Nm


@kernel
def between(before: SetPoint, after: SetPoint, time_ns: int, reference: Reference) -> float:
    """Fill `reference` at a time between two set-points; returns the torque there [Nm]."""
    duration_s, c2, c3 = cubic(before, after)
    d = (time_ns - before.time_ns) * 1e-9
    share = d / duration_s
    reference.position_rad = before.position_rad + d * (before.velocity_radps + d * (c2 + d * c3))
    reference.velocity_radps = before.velocity_radps + d * (2.0 * c2 + 3.0 * d * c3)
    given = before.acceleration_radps2 + share * (after.acceleration_radps2 - before.acceleration_radps2)
    mean = (after.velocity_radps - before.velocity_radps) / duration_s
    reference.acceleration_radps2 = mean if math.isnan(given) else given
    reference.jerk_radps3 = 0.0
    reference.snap_radps4 = 0.0
    return before.torque_Nm + share * (after.torque_Nm - before.torque_Nm)


@kernel
def _next(constants: AxisConstants, state: AxisState, time_ns: int, elapsed_ns: int) -> bool:
    """Go on to the first set-point after `time_ns` that may be followed; False if there is none yet.

    `elapsed_ns`: since the reference was as `state` has it.
    """
    stream, own = constants.stream, state.stream
    written = own.written
    while own.taken < written:
        _fetch(stream, own.taken, own.coming)
        own.taken += 1
        if own.following == 0:  # from wherever the reference is
            own.after.time_ns = time_ns - elapsed_ns
            own.after.position_rad = state.reference.position_rad
            own.after.velocity_radps = state.reference.velocity_radps
            own.after.acceleration_radps2 = math.nan
            own.after.torque_Nm = own.torque_Nm
        if own.taken < written and own.coming.time_ns - own.after.time_ns < stream.delay_ns // CLOSE_SHARE:
            continue
        brake_radps2 = constants.sequence.brake_radps2
        if set_point_problem(constants.limits, stream, brake_radps2, own.after, own.coming) != SetPointProblem.NONE:
            own.refused += 1
            continue
        _copy(own.after, own.before)
        _copy(own.coming, own.after)
        own.following = 1
        if own.after.time_ns > time_ns:
            return True
    return False


@kernel
def step_stream(constants: AxisConstants, state: AxisState, elapsed_cycles: int) -> None:
    """The reference of this cycle, and the torque that goes with it."""
    own, reference = state.stream, state.reference
    time_ns = state.slot_ns - constants.stream.delay_ns
    elapsed_ns = round(elapsed_cycles * constants.law.period_s * 1e9)
    if (own.following != 0 and time_ns < own.after.time_ns) or _next(constants, state, time_ns, elapsed_ns):
        _turn_torque(constants, state, between(own.before, own.after, time_ns, reference), elapsed_cycles)
        return
    period_s = constants.law.period_s
    braked_s = elapsed_cycles * period_s
    if own.following != 0:  # from the last set-point on
        between(own.before, own.after, own.after.time_ns, reference)
        braked_s = (time_ns - own.after.time_ns) * 1e-9
        own.following = 0
    while braked_s > 0.0:
        brake_step(reference, constants.sequence.brake_radps2, min(braked_s, period_s))
        braked_s -= period_s
    _turn_torque(constants, state, 0.0, elapsed_cycles)


@kernel
def _turn_torque(constants: AxisConstants, state: AxisState, torque_Nm: float, elapsed_cycles: int) -> None:
    """The torque on top of the law's goes where it is to go, within its rate."""
    step = constants.stream.torque_rate_max_Nmps * constants.law.period_s * elapsed_cycles
    now = state.stream.torque_Nm
    state.stream.torque_Nm = min(max(torque_Nm, now - step), now + step)


@kernel
def following_set_points(constants: AxisConstants, state: AxisState) -> bool:
    """Whether set-points are the motion of this cycle."""
    by_stream = state.change.motion == MotionChange.NONE and constants.trajectory.kind == TrajectoryKind.STREAM
    return state.phase == AxisPhase.TRACKING and by_stream


@kernel
def step_other_motion(constants: AxisConstants, state: AxisState, elapsed_cycles: int) -> None:
    """Of a cycle in which no set-point is followed: from rest they may be; else what comes is left out."""
    own, reference = state.stream, state.reference
    if own.torque_Nm != 0.0:
        _turn_torque(constants, state, 0.0, elapsed_cycles)
    own.following = 0
    written = own.written
    if own.taken == written:
        return
    still = reference.velocity_radps == 0.0 and reference.acceleration_radps2 == 0.0
    if state.phase == AxisPhase.TRACKING and state.change.motion == MotionChange.NONE and still:
        constants.trajectory.kind = TrajectoryKind.STREAM
        return
    own.refused += written - own.taken
    own.taken = written
