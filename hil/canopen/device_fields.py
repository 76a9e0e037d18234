"""Which field of the virtual drive's memory holds which object; others are constants of the EDS or strings."""

from __future__ import annotations

from jointctl.hil.canopen.device_records import CONSUMERS, HISTORY, MAPPED, PDOS


def _fields() -> dict[tuple[int, int], str]:
    fields = {
        (0x1001, 0): "error_register",
        (0x1003, 0): "error_count",
        (0x1005, 0): "sync_cob_id",
        (0x1006, 0): "sync_period_us",
        (0x100C, 0): "guard_time_ms",
        (0x100D, 0): "life_time_factor",
        (0x1014, 0): "emcy_cob_id",
        (0x1015, 0): "emcy_inhibit_100us",
        (0x1017, 0): "producer_heartbeat_ms",
        (0x1019, 0): "sync_overflow",
        (0x1029, 1): "error_behaviour",
        (0x2102, 0): "sync_timeout_ms",
        (0x2103, 0): "motor_temperature_ddegC",
        (0x6007, 0): "abort_option",
        (0x603F, 0): "error_code",
        (0x6040, 0): "controlword",
        (0x6041, 0): "statusword",
        (0x605A, 0): "quick_stop_option",
        (0x605B, 0): "shutdown_option",
        (0x605C, 0): "disable_option",
        (0x605D, 0): "halt_option",
        (0x605E, 0): "fault_reaction_option",
        (0x6060, 0): "mode",
        (0x6061, 0): "mode_display",
        (0x6062, 0): "demand_position",
        (0x6064, 0): "position",
        (0x6065, 0): "following_window",
        (0x6066, 0): "following_timeout_ms",
        (0x6067, 0): "position_window",
        (0x606B, 0): "demand_velocity",
        (0x606C, 0): "velocity",
        (0x606D, 0): "velocity_window",
        (0x6071, 0): "target_torque",
        (0x6072, 0): "max_torque",
        (0x6073, 0): "max_current",
        (0x6074, 0): "demand_torque",
        (0x6075, 0): "rated_current_mA",
        (0x6076, 0): "rated_torque_mNm",
        (0x6077, 0): "torque",
        (0x6078, 0): "current",
        (0x6079, 0): "dc_link_mV",
        (0x607A, 0): "target_position",
        (0x607C, 0): "home_offset",
        (0x607D, 1): "position_limit[0]",
        (0x607D, 2): "position_limit[1]",
        (0x607F, 0): "max_profile_velocity",
        (0x6080, 0): "max_motor_speed_rpm",
        (0x6081, 0): "profile_velocity",
        (0x6083, 0): "profile_acceleration",
        (0x6084, 0): "profile_deceleration",
        (0x6085, 0): "quick_stop_deceleration",
        (0x6086, 0): "motion_profile",
        (0x6087, 0): "torque_slope",
        (0x6088, 0): "torque_profile",
        (0x608F, 1): "encoder_resolution[0]",
        (0x608F, 2): "encoder_resolution[1]",
        (0x6098, 0): "homing_method",
        (0x6099, 1): "homing_speed[0]",
        (0x6099, 2): "homing_speed[1]",
        (0x609A, 0): "homing_acceleration",
        (0x60B2, 0): "torque_offset",
        (0x60C2, 1): "interpolation_time",
        (0x60C2, 2): "interpolation_exponent",
        (0x60E4, 1): "second_position",
        (0x60F4, 0): "following_error",
        (0x60FF, 0): "target_velocity",
        (0x6502, 0): "supported_modes",
    }
    fields |= {(0x1003, 1 + i): f"error_history[{i}]" for i in range(HISTORY)}
    fields |= {(0x1016, 1 + i): f"consumer_heartbeat[{i}]" for i in range(CONSUMERS)}
    fields |= {(0x1018, 1 + i): f"identity[{i}]" for i in range(4)}
    for pdo in range(PDOS):
        for way, base in (("rpdo", 0x1400), ("tpdo", 0x1800)):
            fields[base + pdo, 1] = f"{way}_cob_id[{pdo}]"
            fields[base + pdo, 2] = f"{way}_type[{pdo}]"
            fields[base + pdo, 5] = f"{way}_timer_ms[{pdo}]"
            fields[base + 0x200 + pdo, 0] = f"{way}_count[{pdo}]"
            for entry in range(MAPPED):
                fields[base + 0x200 + pdo, 1 + entry] = f"{way}_mapping[{pdo * MAPPED + entry}]"
        fields[0x1800 + pdo, 3] = f"tpdo_inhibit_100us[{pdo}]"
        fields[0x1800 + pdo, 6] = f"tpdo_sync_start[{pdo}]"
    return fields


FIELDS = _fields()  # (index, sub) -> "field" or "field[flat element]" of the group that the index belongs to
