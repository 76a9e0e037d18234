"""Changes while the joint moves: gains along a straight line, a new motion by way of rest, set-points of a program.

The supervisor writes one `ChangeRequest` and then counts `order` up; the loop takes it at the beginning of a cycle, in
an arm once there is one for every joint, and answers with the same number.  Until then the supervisor writes nothing,
so that a request is never half old and half new.  The loop trusts nobody: what is not finite, outside of the limits,
not from rest, or comes while the joint is being stopped, is refused and changes nothing.  That the control loop is
stable with new gains, and on the way to them, is for the supervisor to know (`tools.analysis.margin_gate`).

A new motion brakes the reference as a controlled stop does, moves it along the quintic of least jerk to the start of
the new motion, where it is at rest, and begins it; `trajectory_s` is negative until then.  In each cycle the reference
is checked as ever, and a stop request brakes from wherever it is.
"""

from __future__ import annotations

import math

import numpy as np

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.law import reset_learning, right_column_of_p
from jointctl.firmware_py.motion_records import (
    SET_POINTS,
    ChangeAnswer,
    ChangeConstants,
    ChangeKind,
    ChangeRequest,
    ChangeState,
    Gains,
    MotionChange,
    Reference,
    SetPoint,
    StreamConstants,
    StreamState,
    TrajectoryConstants,
)
from jointctl.firmware_py.observers import set_kalman_gains
from jointctl.firmware_py.records import AxisConstants, AxisState, LawConstants, LawState, LimitConstants
from jointctl.firmware_py.safety import set_point_problem, within
from jointctl.firmware_py.states import AxisPhase, ControllerKind, SetPointProblem, TrajectoryKind
from jointctl.firmware_py.trajectory import (
    QUINTIC_PEAK_ACCELERATION,
    QUINTIC_PEAK_SPEED,
    approach_at,
    brake_step,
    cubic,
    plan_approach,
    reference_at,
    trapezoid_times_s,
)

REST_radps = 1e-9  # what rounding leaves of the velocity at a crest
_LONGEST_s = 1e9


@kernel
def reset_change(state: ChangeState) -> None:
    """Begin a run: nothing has been asked for."""
    state.order = 0
    state.answered = 0
    state.answer = ChangeAnswer.NONE
    state.ramping = 0
    state.ramp_s = 0.0
    state.motion = MotionChange.NONE


@kernel
def gains_allowed(low: Gains, high: Gains, gains: Gains) -> bool:
    """Every gain inside its limits; a NaN never is."""
    return (
        within(gains.kp, low.kp, high.kp)
        and within(gains.kv, low.kv, high.kv)
        and within(gains.ki, low.ki, high.ki)
        and within(gains.observer_radps, low.observer_radps, high.observer_radps)
        and within(gains.learning_rate, low.learning_rate, high.learning_rate)
    )


@kernel
def trajectory_allowed(limits: LimitConstants, c: TrajectoryConstants, table_rows: int) -> bool:
    """Whether the whole motion stays inside the position and velocity limits.

    The rows of a table are checked by the supervisor, when it writes them; each reference by `check_reference` as ever.
    """
    low, high, top = limits.position_min_rad, limits.position_max_rad, limits.velocity_max_radps
    if not within(c.duration_s, 0.0, _LONGEST_s):
        return False
    if c.kind == TrajectoryKind.TABLE:
        return 2 <= c.table_rows <= table_rows
    if c.kind == TrajectoryKind.SINE:
        swing = abs(c.amplitude_rad)
        inside = within(c.offset_rad - swing, low, high) and within(c.offset_rad + swing, low, high)
        return (
            inside and within(swing * abs(c.omega_radps), 0.0, top) and c.switch_s == 0.0 and math.isfinite(c.shift_s)
        )
    if c.kind == TrajectoryKind.HOLD or c.kind == TrajectoryKind.STREAM:
        return within(c.start_rad, low, high)
    if not (within(c.start_rad, low, high) and within(c.target_rad, low, high) and within(c.dwell_s, 0.0, _LONGEST_s)):
        return False
    distance = abs(c.target_rad - c.start_rad)
    if c.kind == TrajectoryKind.MIN_JERK:
        return within(c.move_s, 0.0, _LONGEST_s) and within(QUINTIC_PEAK_SPEED * distance, 0.0, top * c.move_s)
    if c.kind == TrajectoryKind.TRAPEZOID:
        sizes = within(c.speed_radps, 0.0, 1e9) and within(c.acceleration_radps2, 0.0, 1e9)
        if not (sizes and within(c.rounding_s, 0.0, _LONGEST_s)):
            return False
        if c.speed_radps == 0.0 or c.acceleration_radps2 == 0.0:
            return False
        ramp_s, _ = trapezoid_times_s(distance, c.speed_radps, c.acceleration_radps2)
        return within(c.acceleration_radps2 * ramp_s, 0.0, top)
    return False


@kernel
def move_duration_s(constants: ChangeConstants, distance_rad: float) -> float:
    """Of a move from rest to rest within the speed and acceleration of moves; 0 where it is there already."""
    if distance_rad == 0.0:
        return 0.0
    by_speed_s = QUINTIC_PEAK_SPEED * abs(distance_rad) / constants.move_speed_radps
    by_acceleration_s = math.sqrt(QUINTIC_PEAK_ACCELERATION * abs(distance_rad) / constants.move_acceleration_radps2)
    return max(by_speed_s, by_acceleration_s, constants.move_min_s)


@kernel
def gains_of(law: LawConstants, gains: Gains) -> None:
    """Fill `gains` with those in force."""
    gains.kp, gains.kv, gains.ki = law.kp, law.kv, law.ki
    gains.observer_radps, gains.learning_rate = law.observer.bandwidth_radps, law.network.learning_rate


@kernel
def set_gains(constants: ChangeConstants, law: LawConstants, state: LawState, gains: Gains) -> None:
    """Put gains into force without a jump of the torque that has been integrated; P B follows from kp and kv."""
    if law.kind == ControllerKind.PID and law.ki > 0.0 and gains.ki > 0.0:
        state.integral_rads *= law.ki / gains.ki
    before, now = law.observer.bandwidth_radps, gains.observer_radps
    if before > 0.0 and now > 0.0:
        state.observer.integral_Nms += state.observer.disturbance_Nm * (1.0 / now - 1.0 / before)
    law.kp, law.kv, law.ki = gains.kp, gains.kv, gains.ki
    law.observer.bandwidth_radps = now
    if law.observer.kalman != 0:
        set_kalman_gains(law.observer, law.period_s)
    law.network.learning_rate = gains.learning_rate
    p12, p22 = right_column_of_p(gains.kp, gains.kv, constants.q1, constants.q2)
    law.network.p_b[0] = p12 / law.inertia_kgm2
    law.network.p_b[1] = p22 / law.inertia_kgm2


@kernel
def _take_gains(constants: AxisConstants, state: AxisState, request: ChangeRequest) -> int:
    if state.phase != AxisPhase.APPROACH and state.phase != AxisPhase.TRACKING:
        return ChangeAnswer.WRONG_PHASE
    if not gains_allowed(constants.change.low, constants.change.high, request.gains):
        return ChangeAnswer.GAIN_LIMIT
    change = state.change
    gains_of(constants.law, change.start)
    change.target = request.gains
    change.ramp_s = 0.0
    change.ramping = 1
    return ChangeAnswer.TAKEN


@kernel
def _take_motion(constants: AxisConstants, state: AxisState, table: np.ndarray, request: ChangeRequest) -> int:
    if state.phase != AxisPhase.TRACKING:
        return ChangeAnswer.WRONG_PHASE
    allowed = trajectory_allowed(constants.limits, request.trajectory, table.shape[0])
    if not (allowed and within(request.move_s, 0.0, _LONGEST_s)):
        return ChangeAnswer.MOTION_LIMIT
    change = state.change
    reference_at(request.trajectory, table, 0, 0.0, change.goal)
    if not abs(change.goal.velocity_radps) <= REST_radps:
        return ChangeAnswer.NOT_FROM_REST
    change.next_trajectory = request.trajectory
    change.move_s = request.move_s
    change.motion = MotionChange.BRAKING
    speed = state.reference.velocity_radps
    brake_s = abs(speed) / constants.sequence.brake_radps2
    rest_rad = state.reference.position_rad + 0.5 * speed * brake_s
    move_s = move_duration_s(constants.change, change.goal.position_rad - rest_rad)
    state.trajectory_s = -brake_s - max(change.move_s, move_s)
    return ChangeAnswer.TAKEN


@kernel
def _ramp_gains(constants: AxisConstants, state: AxisState, elapsed_cycles: int) -> None:
    change = state.change
    change.ramp_s += elapsed_cycles * constants.law.period_s
    if change.ramp_s >= constants.change.ramp_s:
        change.ramping = 0
        set_gains(constants.change, constants.law, state.law, change.target)
        return
    share = change.ramp_s / constants.change.ramp_s
    a, b = change.start, change.target
    now = change.now
    now.kp, now.kv = a.kp + share * (b.kp - a.kp), a.kv + share * (b.kv - a.kv)
    now.ki = a.ki + share * (b.ki - a.ki)
    now.observer_radps = a.observer_radps + share * (b.observer_radps - a.observer_radps)
    now.learning_rate = a.learning_rate + share * (b.learning_rate - a.learning_rate)
    set_gains(constants.change, constants.law, state.law, now)


@kernel
def step_change(constants: AxisConstants, state: AxisState, table: np.ndarray, elapsed_cycles: int) -> None:
    """Take a request, if there is a whole one, and go on with a change of gains; a stop freezes them as they are."""
    request = constants.change.request
    order = state.change.order
    if order != state.change.answered and request.first == order and request.last == order:
        answer: int = ChangeAnswer.WRONG_KIND
        if request.kind == ChangeKind.GAINS:
            answer = _take_gains(constants, state, request)
        elif request.kind == ChangeKind.MOTION:
            answer = _take_motion(constants, state, table, request)
        state.change.answer = answer
        state.change.answered = order
    if state.change.ramping != 0 and (state.phase == AxisPhase.APPROACH or state.phase == AxisPhase.TRACKING):
        _ramp_gains(constants, state, elapsed_cycles)


@kernel
def step_new_motion(constants: AxisConstants, state: AxisState, table: np.ndarray, elapsed_cycles: int) -> None:
    """The reference of this cycle on the way to the new motion, and its first one when it is there."""
    change = state.change
    if change.motion == MotionChange.BRAKING:
        for _ in range(elapsed_cycles):
            brake_step(state.reference, constants.sequence.brake_radps2, constants.law.period_s)
        if state.reference.velocity_radps == 0.0:
            at_rad = state.reference.position_rad
            change.goal.velocity_radps = 0.0
            change.goal.acceleration_radps2 = 0.0  # the move ends at rest; the new motion's acceleration sets in then
            move_s = move_duration_s(constants.change, change.goal.position_rad - at_rad)
            change.move_s = max(change.move_s, move_s)
            plan_approach(at_rad, change.goal, change.move_s, state.approach)
            state.trajectory_s = -change.move_s
            change.motion = MotionChange.MOVING
        return
    if state.trajectory_s < 0.0:
        approach_at(state.approach, state.trajectory_s + change.move_s, state.reference)
        return
    constants.trajectory = change.next_trajectory
    reset_learning(state.law.learning)  # what was learned belongs to the motion before; its torque has faded out
    state.table_row = reference_at(constants.trajectory, table, 0, state.trajectory_s, state.reference)
    change.motion = MotionChange.NONE  # last: who sees that in another process takes the trajectory for the new one


# --- Set-points that come while the joint moves: a cubic through them, a little later than they say ---
#
# A program writes set-points into the ring of `StreamConstants`.  The loop follows the cubic (Hermite) through two of
# them at a time, `delay_ns` behind their times, so that the next one is there before it is needed.  Of set-points that
# lie closer than a third of that, the last one counts: over so short a time positions and velocities that do not quite
# belong together would make a jolt.  For the same reason the acceleration is that between their velocities, not the
# cubic's own.
#
# Nothing is extrapolated: where no set-point is there in time, the reference brakes as in a controlled stop, and the
# next one is approached from wherever the reference is then.  The loop trusts nobody: a set-point that breaks a limit
# (`safety.set_point_problem`), comes late or while another motion is under way is left out and counted.

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
        own.before = own.after
        own.after = own.coming
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
