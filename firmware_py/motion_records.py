"""Records of the desired motion.  Import them from `firmware_py.records`, which has every record."""

from __future__ import annotations

from jointctl.firmware_py.schema import f8, i4, record


@record
class Reference:
    position_rad: f8
    velocity_radps: f8
    acceleration_radps2: f8


@record
class TrajectoryConstants:
    """One trajectory; which fields matter depends on `kind`."""

    kind: i4  # TrajectoryKind
    repeats: i4  # point-to-point kinds and tables: start again at the end
    table_rows: i4
    duration_s: f8  # of the run; 0 = until stopped
    # SINE: offset + amplitude sin(omega (t + shift)), with a second set from switch_s on (0 = no switch)
    amplitude_rad: f8
    omega_radps: f8
    shift_s: f8
    offset_rad: f8
    switch_s: f8
    amplitude2_rad: f8
    omega2_radps: f8
    shift2_s: f8
    offset2_rad: f8
    # MIN_JERK, TRAPEZOID: from start to target and, when repeated, back, resting dwell_s at each end
    start_rad: f8
    target_rad: f8
    move_s: f8  # MIN_JERK: duration of one move
    speed_radps: f8  # TRAPEZOID
    acceleration_radps2: f8  # TRAPEZOID
    dwell_s: f8
