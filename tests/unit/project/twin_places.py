"""Where the test of each fault and each watcher of docs/safety.md is, and its twin just inside the limit.

A place is `file::test`, below `tests/`, and after a bar words of that test (its parameters as they are written there):
the case that trips, or the one just inside the limit.
"""

from __future__ import annotations

from jointctl.firmware_py.states import Fault

SAFETY = "unit/firmware_py/axis/test_safety.py::"
EDGES = "unit/firmware_py/axis/test_supervision_edges.py::"
SUPERVISION = "unit/firmware_py/axis/test_supervision.py::"
ELMO_CYCLIC = "unit/drivers/elmo/test_elmo_cyclic.py::"
HANGS = "unit/session/test_hang_limits.py::"
AXIS_LIMITS = "unit/firmware_py/axis/test_axis_limits.py::"
AXIS_SWING = "unit/firmware_py/axis/test_axis_swing.py::"
AXIS_SAMPLES = "unit/firmware_py/axis/test_axis_samples.py::"
AXIS_DRIVE_FAULTS = "unit/firmware_py/axis/test_axis_drive_faults.py::"
AXIS_TIME_LIMITS = "unit/firmware_py/axis/test_axis_time_limits.py::"
SEQUENCE_START = "unit/firmware_py/axis/test_sequence_start.py::"
SEQUENCE_END = "unit/firmware_py/axis/test_sequence_end.py::"
CYCLIC_SENT = "unit/drivers/canopen/test_cyclic_sent.py::"
EDGE = EDGES + "test_each_limit_at_its_edge_in_each_phase | "
DENSE = AXIS_LIMITS + "test_velocity_and_following_error_are_dense_at_their_limits | "

FAULTS: dict[Fault, tuple[str, str]] = {  # what trips, and its twin
    Fault.POSITION_LIMIT: (
        AXIS_LIMITS + "test_position_limit | (1.001, Fault.POSITION_LIMIT)",
        AXIS_LIMITS + "test_position_limit | (0.999, Fault.NONE)",
    ),
    Fault.VELOCITY_LIMIT: (DENSE + "(1e-9, True)", DENSE + "(0.0, False)"),
    Fault.REFERENCE_LIMIT: (
        SAFETY + "test_a_reference_must_be_able_to_brake_inside_the_limits | (1e-9, Fault.REFERENCE_LIMIT)",
        SAFETY + "test_a_reference_must_be_able_to_brake_inside_the_limits | (-1e-9, Fault.NONE)",
    ),
    Fault.FOLLOWING_ERROR: (DENSE + "(1e-9, True)", DENSE + "(0.0, False)"),
    Fault.STALE_SAMPLE: (
        AXIS_SAMPLES + "test_stale_sample | (6, True)",
        AXIS_SAMPLES + "test_stale_sample | (5, False)",
    ),
    Fault.NOT_FINITE: (
        AXIS_LIMITS + "test_a_law_that_is_not_finite_sends_zero_and_stops | Fault.NOT_FINITE",
        AXIS_LIMITS + "test_its_twin_a_law_of_an_enormous_but_finite_torque_is_limited | 1e300",
    ),
    Fault.TORQUE_SATURATED: (
        AXIS_LIMITS + "test_saturation | (21, True)",
        AXIS_LIMITS + "test_saturation | (20, False)",
    ),
    Fault.LIMIT_CYCLE: (
        AXIS_SWING + "test_torque_that_reverses_between_its_shares | (30.0 + 1e-9, Fault.LIMIT_CYCLE)",
        AXIS_SWING + "test_torque_that_reverses_between_its_shares | (30.0, Fault.NONE)",
    ),
    Fault.DRIVE_FAULT: (
        AXIS_DRIVE_FAULTS + "test_drive_fault_in_each_phase | Fault.DRIVE_FAULT",
        AXIS_DRIVE_FAULTS + "test_its_twin_a_warning_of_the_drive_is_no_fault",
    ),
    Fault.DRIVE_NOT_ENABLED: (
        EDGE + '("drive_state", DriveState.ENABLED, DriveState.STOPPING, Fault.DRIVE_NOT_ENABLED)',
        EDGE + "((within, False), (beyond, counts))",
    ),
    Fault.DRIVE_RESTARTED: (
        AXIS_DRIVE_FAULTS + "test_a_restart_before_the_first_cycle_ends_the_run_without_power | Fault.DRIVE_RESTARTED",
        AXIS_DRIVE_FAULTS
        + "test_a_restart_before_the_first_cycle_ends_the_run_without_power | twin.until(AxisPhase.TRACKING)",
    ),
    Fault.ENABLE_TIMEOUT: (
        SEQUENCE_START + "test_enable_timeout | (31, Fault.ENABLE_TIMEOUT)",
        SEQUENCE_START + "test_enable_timeout | (30, Fault.NONE)",
    ),
    Fault.SUPERVISOR_LOST: (
        AXIS_TIME_LIMITS + "test_supervisor_lost | (11, True)",
        AXIS_TIME_LIMITS + "test_supervisor_lost | (10, False)",
    ),
    Fault.BUS_ERROR: (
        AXIS_DRIVE_FAULTS + "test_bus_errors | (6, True)",
        AXIS_DRIVE_FAULTS + "test_bus_errors | (5, False)",
    ),
    Fault.STOP_TIMEOUT: (
        AXIS_TIME_LIMITS + "test_standstill_is_complete_in_the_last_cycle_or_one_too_late | Fault.STOP_TIMEOUT",
        AXIS_TIME_LIMITS
        + "test_standstill_is_complete_in_the_last_cycle_or_one_too_late | (AxisPhase.RELEASING, Fault.NONE)",
    ),
    Fault.OFF_TIMEOUT: (
        SEQUENCE_END + "test_off_timeout | (21, AxisPhase.FINISHED, Fault.OFF_TIMEOUT)",
        SEQUENCE_END + "test_off_timeout | (20, AxisPhase.DISABLING, Fault.NONE)",
    ),
    Fault.NO_SAMPLES: (
        SEQUENCE_START + "test_waiting_ends | (0, 0.0, 1, Fault.NO_SAMPLES, 0.0)",
        SEQUENCE_START + "test_waiting_ends | (AxisPhase.WAITING, Fault.NONE)",
    ),
    Fault.SAMPLES_MISSING: (
        SEQUENCE_START + "test_the_wait_for_the_supervisors_word_ends | (5, Fault.SAMPLES_MISSING)",
        SEQUENCE_START + "test_the_wait_for_the_supervisors_word_ends | (4, Fault.SUPERVISOR_LOST)",
    ),
    Fault.NOT_AT_STANDSTILL: (
        SEQUENCE_START + "test_waiting_ends | (4, 0.5, 0, Fault.NOT_AT_STANDSTILL, 0.5)",
        SEQUENCE_START
        + "test_enabling_is_only_asked_at_standstill_inside_the_limits | (1.0, 0.02, 4, AxisPhase.ENABLING",
    ),
    Fault.OVERRUN: (AXIS_TIME_LIMITS + "test_overrun | (9, True)", AXIS_TIME_LIMITS + "test_overrun | (8, False)"),
    Fault.POSITION_JUMP: (
        AXIS_SAMPLES + "test_position_jump_scales_with_the_gap | 1.001 if trips",
        AXIS_SAMPLES + "test_position_jump_scales_with_the_gap | else 0.999",
    ),
    Fault.DRIVE_STAYS_ENABLED: (
        SEQUENCE_START + "test_a_drive_that_is_enabled_already_is_not_taken_over | Fault.DRIVE_STAYS_ENABLED",
        SEQUENCE_START + "test_a_drive_that_is_enabled_already_is_not_taken_over | (AxisPhase.WAITING, Fault.NONE)",
    ),
    Fault.POSITION_FROZEN: (
        EDGES + "test_the_way_behind_a_reading_that_stands_still | (0.501, True)",
        EDGES + "test_the_way_behind_a_reading_that_stands_still | (0.5, False)",
    ),
    Fault.SUSPENDED: (
        SUPERVISION + "test_standby_just_shorter_and_just_longer_than_it_can_be_measured | (100_000, True)",
        SUPERVISION + "test_standby_just_shorter_and_just_longer_than_it_can_be_measured | (-100_000, False)",
    ),
    Fault.DRIVE_SILENT: (
        SUPERVISION + "test_a_drive_whose_heartbeat_stays_away | (600, 601, True)",
        SUPERVISION + "test_a_drive_whose_heartbeat_stays_away | (600, 600, False)",
    ),
    Fault.POSITION_DISAGREEMENT: (
        AXIS_SAMPLES + "test_the_other_encoder | (0.0101, True)",
        AXIS_SAMPLES + "test_the_other_encoder | (0.0099, False)",
    ),
    Fault.MOVED_BEFORE_START: (
        SEQUENCE_START + "test_a_joint_that_was_moved_since_the_motion_was_shown_is_not_driven | 0.375 + 1e-12, True",
        SEQUENCE_START + "test_a_joint_that_was_moved_since_the_motion_was_shown_is_not_driven | 0.375, False",
    ),
}

# (watcher, watches) of the tables of docs/safety.md; for those that watch for a member of `Fault`, the fault
CAN: dict[tuple[str, str], tuple[str, str] | tuple[Fault, ...]] = {
    ("drive", "the loop"): (
        "unit/hil/canopen/test_hil_device.py::test_heartbeat_loss_reacts_as_6007_says | rig.run(1)",
        "unit/hil/canopen/test_hil_device.py::test_heartbeat_that_keeps_coming_changes_nothing | rig.run(49)",
    ),
    ("driver", "that watchdog"): (
        "unit/drivers/canopen/test_watchdog_proof.py::test_a_watchdog_that_does_nothing_is_refused",
        "unit/drivers/canopen/test_watchdog_proof.py::test_a_working_watchdog_is_seen",
    ),
    ("driver", "that the drive says how it stops"): (
        "unit/drivers/canopen/test_connection_loss.py::test_a_drive_without_any_reaction_to_a_lost_connection_is_refused",
        "unit/drivers/canopen/test_connection_loss.py::test_the_twins_that_say_how_they_stop",
    ),
    ("drive", "the loop's RPDOs"): (
        "faults/test_fault_regressions.py::test_a_joint_that_holds_while_its_rpdos_stay_away_is_stopped_by_the_deadline"
        "_of_the_drive | (0.102, True)",
        "faults/test_fault_regressions.py::test_a_joint_that_holds_while_its_rpdos_stay_away_is_stopped_by_the_deadline"
        "_of_the_drive | (0.098, False)",
    ),
    ("loop", "that it is heard"): (
        CYCLIC_SENT + "test_a_drive_that_stays_enabled_loses_the_heartbeat | (IGNORED_MAX_CYCLES + 1, 1)",
        CYCLIC_SENT + "test_a_drive_that_stays_enabled_loses_the_heartbeat | (IGNORED_MAX_CYCLES, 2)",
    ),
    ("loop", "the drive"): (Fault.DRIVE_FAULT, Fault.DRIVE_NOT_ENABLED, Fault.DRIVE_RESTARTED),
    ("loop", "the drive's communication"): (Fault.DRIVE_SILENT,),
    ("loop", "the samples"): (
        Fault.STALE_SAMPLE, Fault.NO_SAMPLES, Fault.SAMPLES_MISSING, Fault.POSITION_JUMP, Fault.POSITION_FROZEN,
    ),
    ("loop", "that the joint stands where it stood when the motion was shown"): (Fault.MOVED_BEFORE_START,),
    ("loop", "old values"): (
        "faults/test_late_samples.py::test_the_age_counts_on_although_old_frames_come",
        "faults/test_late_samples.py::test_the_twins_with_a_sound_encoder_go_on",
    ),
    ("loop", "one encoder by the other"): (Fault.POSITION_DISAGREEMENT,),
    ("loop", "the motion"): (
        Fault.POSITION_LIMIT, Fault.VELOCITY_LIMIT, Fault.REFERENCE_LIMIT, Fault.FOLLOWING_ERROR,
        Fault.TORQUE_SATURATED, Fault.NOT_AT_STANDSTILL,
    ),
    ("loop", "its own law"): (Fault.NOT_FINITE,),
    ("loop", "that the joint settles"): (Fault.LIMIT_CYCLE,),
    ("loop", "what it learns"): (
        "unit/firmware_py/test_learning_growth.py::test_an_error_that_grows_in_three_repetitions_switches_learning_off"
        " | (1.05 + 1e-9, True)",
        "unit/firmware_py/test_learning_growth.py::test_an_error_that_grows_in_three_repetitions_switches_learning_off"
        " | (1.05 - 1e-9, False)",
    ),
    ("loop", "the noise of its command"): (
        "faults/test_limit_cycle.py::test_a_coarse_encoder_is_reported_as_torque_noise | (16, True)",
        "faults/test_limit_cycle.py::test_a_coarse_encoder_is_reported_as_torque_noise | (17, False)",
    ),
    ("loop", "the bus"): (Fault.BUS_ERROR,),
    ("loop", "the schedule"): (Fault.OVERRUN,),
    ("loop", "the computer"): (Fault.SUSPENDED,),
    ("loop", "the supervisor"): (Fault.SUPERVISOR_LOST,),
    ("supervisor", "the loop process"): (
        HANGS + "test_the_supervisor_ends_a_loop_that_hangs_and_no_other | (MICROSECOND_ns, True)",
        HANGS + "test_the_supervisor_ends_a_loop_that_hangs_and_no_other | (0, False)",
    ),
    ("supervisor", "the user"): (
        "hil/test_run_cli.py::test_one_stop_signal_while_tracking_ramps_down",
        "hil/test_run_cli.py::test_two_runs_on_one_joint_and_it_is_disabled_after_each",
    ),
    ("user", "everything"): (
        "hil/test_stop_and_clear.py::test_stop_ends_a_run_of_another_terminal",
        "hil/test_stop_and_clear.py::test_stop_of_a_resting_joint_is_harmless",
    ),
}  # fmt: skip
SERIAL: dict[tuple[str, str], tuple[str, str] | tuple[Fault, ...]] = {
    ("loop", "that positions come"): (
        ELMO_CYCLIC + "test_the_dead_man_commands_a_stop_and_its_twin_does_not | (1, b\"JV=0\\r\")",
        ELMO_CYCLIC + "test_the_dead_man_commands_a_stop_and_its_twin_does_not | (0, b\"JV=41722\\r\")",
    ),
    ("loop", "its own end, however it comes about"): (
        "hil/test_elmo_run.py::test_a_killed_supervisor_is_seen_by_the_loop",
        "hil/test_elmo_run.py::test_a_run_tracks_the_sine_and_ends_with_the_motor_off",
    ),
    ("supervisor", "the loop process"): (
        "hil/test_elmo_run.py::test_a_killed_loop_is_switched_off_by_its_supervisor",
        HANGS + "test_the_supervisor_ends_a_loop_that_hangs_and_no_other | (0, False)",
    ),
    ("guard", "loop and supervisor"): (
        "hil/test_line_guard.py::test_loop_and_supervisor_killed_the_guard_switches_off",
        "hil/test_line_guard.py::test_a_run_that_ends_well_leaves_no_guard_behind",
    ),
    ("guard", "a loop that hangs"): (
        HANGS + "test_the_guard_switches_off_behind_a_loop_that_hangs_and_behind_no_other"
        " | (MICROSECOND_ns, True)",
        HANGS + "test_the_guard_switches_off_behind_a_loop_that_hangs_and_behind_no_other"
        " | (-MICROSECOND_ns, False)",
    ),
    ("guard", "a drive that was not reached at the end of a run"): (
        "hil/test_line_guard.py::test_a_port_that_comes_back_is_told_to_switch_off",
        "hil/test_line_guard.py::test_a_run_that_ends_well_leaves_no_guard_behind",
    ),
    ("user", "everything"): (
        HANGS + "test_a_run_that_does_not_obey_a_stop_is_ended_by_force_and_not_before"
        " | (OBEY_S + 0.01, True, True)",
        HANGS + "test_a_run_that_does_not_obey_a_stop_is_ended_by_force_and_not_before"
        " | (OBEY_S - 0.01, True, False)",
    ),
    ("drive", "current, speed, position"): (
        "unit/hil/test_elmo_device.py::test_leaving_the_position_limits_switches_off | (9_999, MF_POSITION_LIMIT)",
        "unit/hil/test_elmo_device.py::test_leaving_the_position_limits_switches_off | (10_001, 0)",
    ),
}  # fmt: skip
