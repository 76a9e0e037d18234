"""From the drive's counts and per mille to radians and newton metres of the joint, and back."""

from __future__ import annotations

import math
from typing import Any

from jointctl.drivers.canopen.cia402 import State
from jointctl.drivers.canopen.cyclic import AlignTo, CanopenPort, centred
from jointctl.drivers.canopen.identifiers import EMERGENCY_ID, HEARTBEAT_ID, SYNC_ID, TPDO1_ID, TPDO2_ID
from jointctl.drivers.canopen.pdo_layout import PdoLayout, own_layout
from jointctl.drivers.canopen.settings import DRIVE_RANGE_COUNTS, CanopenSettings, JointEncoderSettings
from jointctl.firmware_py.schema import new

PERMILLE = 1000.0
# units of 60FF besides the encoder's counts per second: motor speed [rad/s] of one unit
VELOCITY_UNITS = {"counts/s": None, "r/min": math.tau / 60.0, "0.1 r/min": math.tau / 600.0}


def joint_torque_per_permille_Nm(settings: CanopenSettings, rated_torque_mNm: int, rated_current_mA: int) -> float:
    """Joint torque [Nm] of 1/1000 of rated in objects 6071 and 6077, without the direction."""
    if settings.torque_reference == "rated_torque":
        motor_Nm = rated_torque_mNm * 1e-3
    else:
        motor_Nm = rated_current_mA * 1e-3 * settings.torque_constant_NmpA
    return motor_Nm * settings.reduction_ratio / PERMILLE


def joint_angle_per_count_rad(settings: CanopenSettings) -> float:
    """Joint angle [rad] of one count of 6064, without the direction."""
    ratio = settings.reduction_ratio if settings.encoder_on_motor else 1.0
    return 2.0 * math.pi / (settings.counts_per_turn * ratio)


def joint_velocity_per_unit_radps(settings: CanopenSettings) -> float:
    """Joint velocity [rad/s] of one unit of 60FF, 606C and 607F, without the direction."""
    motor_radps = VELOCITY_UNITS[settings.velocity_unit]
    if motor_radps is None:
        return joint_angle_per_count_rad(settings)
    return motor_radps / settings.reduction_ratio


def new_port(
    settings: CanopenSettings,
    torque_per_permille_Nm: float,
    max_permille: int,
    *,
    velocity: bool = False,
    layout: PdoLayout | None = None,
    heartbeat_watched: bool = True,
    second_range_counts: int = DRIVE_RANGE_COUNTS,
) -> Any:
    """A `CanopenPort` record array of one record; the file descriptor is still missing.

    `velocity`: the drive is in a velocity mode and the RPDO carries 60FF.  `layout`: of the PDOs (None: our own).
    `heartbeat_watched`: the drive sends its own heartbeat.
    """
    layout = layout or own_layout(settings.node, velocity=velocity)
    ports = new(CanopenPort)
    port = ports[0]
    port.fd = -1
    port.node = settings.node
    port.sync_id = SYNC_ID
    port.emergency_id = EMERGENCY_ID + settings.node
    port.heartbeat_id = HEARTBEAT_ID + settings.node
    port.own_heartbeat_id = HEARTBEAT_ID + settings.master_node
    # three heartbeats within the drive's time-out, so that one or two lost ones do not stop the joint
    port.heartbeat_cycles = max(1, int(settings.heartbeat_s * settings.rate_Hz / 3.0))
    port.heartbeat_watched = int(heartbeat_watched)
    for key in (
        "tpdo_id", "rpdo_id", "tpdo_length", "rpdo_length",
        "status_at", "position_at", "torque_at", "control_at", "target_at",
    ):  # fmt: skip
        setattr(port, key, getattr(layout, key))
    for i, value in enumerate(layout.fill):
        port.rpdo_filler[i] = value
    port.target_is_velocity = int(velocity)
    # the drive counts speed in the direction of its encoder
    port.velocity_radpspunit = joint_velocity_per_unit_radps(settings) * settings.encoder_direction
    port.position_radpcount = joint_angle_per_count_rad(settings) * settings.encoder_direction
    port.zero_counts = settings.zero_counts
    port.torque_Nmppermille = torque_per_permille_Nm * settings.torque_direction
    port.max_permille = max_permille
    port.state = State.UNDEFINED
    if settings.joint_encoder is not None:
        _fill_second(port.second, settings, settings.joint_encoder, second_range_counts)
    return ports


def _fill_second(second: Any, settings: CanopenSettings, encoder: JointEncoderSettings, range_counts: int) -> None:
    """The second encoder of the joint."""
    if encoder.node is None:
        second.tpdo_id = TPDO2_ID + settings.node
    else:
        second.tpdo_id = TPDO1_ID + encoder.node
        second.emergency_id = EMERGENCY_ID + encoder.node
        second.heartbeat_id = HEARTBEAT_ID + encoder.node
    second.tpdo_length = 4
    second.position_at = 0
    second.range_counts = range_counts
    second.zero_counts = encoder.zero_counts
    second.radpcount = encoder.rad_per_count
    second.feeds_law = int(encoder.feeds_law)
    if encoder.incremental:
        second.align = AlignTo.FIRST
    elif settings.encoder_incremental:
        second.align = AlignTo.SECOND


def start_position_rad(settings: CanopenSettings, first_counts: int, second_counts: int, range_counts: int) -> float:
    """Where the joint stands by the encoder that feeds the law; an incremental one takes the other's angle."""
    first_rad = (first_counts - settings.zero_counts) * joint_angle_per_count_rad(settings) * settings.encoder_direction
    encoder = settings.joint_encoder
    if encoder is None:
        return first_rad
    second_rad = centred(second_counts - encoder.zero_counts, range_counts) * encoder.rad_per_count
    if encoder.incremental:
        return first_rad
    if settings.encoder_incremental or encoder.feeds_law:
        return second_rad
    return first_rad
