"""Counts and per mille of the drive against radians and newton metres of the joint."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest

from jointctl.drivers.canopen.cia402 import State
from jointctl.drivers.canopen.pdo import joint_angle_per_count_rad, joint_torque_per_permille_Nm, new_port
from jointctl.drivers.canopen.settings import CanopenSettings

SETTINGS = CanopenSettings(
    node=5, eds_path=Path("drive.eds"), mode="cst", rate_Hz=1000.0, heartbeat_s=0.2, master_node=127,
    quick_stop_option=2, rpdo_transmission_type=1, torque_reference="rated_torque", torque_direction=1,
    torque_max_Nm=60.0, torque_constant_NmpA=0.1, reduction_ratio=121.0, counts_per_turn=2**19,
    encoder_on_motor=False, encoder_direction=1, zero_counts=0,
)  # fmt: skip


def test_torque_by_rated_torque() -> None:
    """500 mNm at the motor are 60.5 Nm at the joint, so a thousandth is 60.5 mNm."""
    assert joint_torque_per_permille_Nm(SETTINGS, 500, 9999) == pytest.approx(0.0605)


def test_torque_by_rated_current() -> None:
    """5 A at 0.1 Nm/A are 0.5 Nm at the motor."""
    settings = dataclasses.replace(SETTINGS, torque_reference="rated_current")
    assert joint_torque_per_permille_Nm(settings, 9999, 5000) == pytest.approx(0.0605)


@pytest.mark.parametrize(("on_motor", "turns"), [(False, 1.0), (True, 121.0)])
def test_angle_of_a_count(on_motor: bool, turns: float) -> None:
    settings = dataclasses.replace(SETTINGS, encoder_on_motor=on_motor)
    assert joint_angle_per_count_rad(settings) * 2**19 * turns == pytest.approx(2.0 * math.pi)


@pytest.mark.parametrize("node", [1, 5, 127])
def test_the_port_has_the_standard_identifiers_and_layout(node: int) -> None:
    port = new_port(dataclasses.replace(SETTINGS, node=node), 0.0605, 1000)[0]
    identifiers = (port.sync_id, port.emergency_id, port.tpdo_id, port.rpdo_id, port.heartbeat_id)
    assert identifiers == (0x80, 0x80 + node, 0x180 + node, 0x200 + node, 0x700 + node)
    assert port.own_heartbeat_id == 0x77F
    assert (port.tpdo_length, port.status_at, port.position_at, port.torque_at) == (8, 0, 2, 6)
    assert (port.rpdo_length, port.control_at, port.target_at) == (4, 0, 2)
    assert (port.fd, port.state, port.primed, port.max_permille) == (-1, State.UNDEFINED, 0, 1000)


@pytest.mark.parametrize("direction", [1, -1])
def test_directions_are_in_the_scale(direction: int) -> None:
    settings = dataclasses.replace(SETTINGS, encoder_direction=direction, torque_direction=-direction)
    port = new_port(settings, 0.0605, 1000)[0]
    assert port.position_radpcount == direction * joint_angle_per_count_rad(settings)
    assert port.torque_Nmppermille == -direction * 0.0605


@pytest.mark.parametrize(
    ("heartbeat_s", "rate_Hz", "cycles"), [(0.2, 1000.0, 66), (0.003, 1000.0, 1), (0.001, 500.0, 1), (1.0, 250.0, 83)]
)
def test_three_heartbeats_fit_into_the_time_out(heartbeat_s: float, rate_Hz: float, cycles: int) -> None:
    port = new_port(dataclasses.replace(SETTINGS, heartbeat_s=heartbeat_s, rate_Hz=rate_Hz), 0.06, 1000)[0]
    assert port.heartbeat_cycles == cycles
