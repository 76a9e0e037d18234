"""Homing and the set-point handshake of the virtual drive (CiA 402, modes 6 and 1)."""

from __future__ import annotations

import math
from typing import Any

import pytest

from jointctl.hil.canopen.records import HomingState
from tests.virtual_drive import NODE, Rig

HOMING = 6
BITS = 0x3400  # 10 target reached, 12 attained, 13 error
SEARCHING, INTERRUPTED, ATTAINED, FAILED = 0x0000, 0x0400, 0x1400, 0x2400
TURN = 2**19 / 121.0  # counts of a motor turn


def homing_rig(method: int, offset: int = 0, **plant: Any) -> Rig:
    rig = Rig(step_s=1e-3, encoder_offset_counts=10_000, **plant)
    rig.set(0x6098, 0, method, 1)
    rig.set(0x607C, 0, offset, 4)
    rig.enable(HOMING)
    assert rig.get(0x6041) & BITS == INTERRUPTED
    return rig


def bits(rig: Rig) -> int:
    return rig.get(0x6041) & BITS


@pytest.mark.parametrize("method", [35, 37])
@pytest.mark.parametrize("offset", [0, -777])
def test_the_present_position_becomes_home(method: int, offset: int) -> None:
    rig = homing_rig(method, offset)
    assert rig.get(0x6064) == 10_000
    rig.control(0x1F)
    rig.run(2)
    assert bits(rig) == ATTAINED
    assert rig.get(0x6064) == offset
    rig.control(0x0F)
    rig.run(2)
    assert bits(rig) == ATTAINED  # stays until the next start
    assert abs(rig.speed_radps) < 1e-3


@pytest.mark.parametrize(("method", "pulse"), [(33, 2), (34, 3)])
@pytest.mark.parametrize("direction", [1, -1])
def test_the_next_index_pulse_becomes_home(method: int, pulse: int, direction: int) -> None:
    """At 10 000 counts, the pulses around are those of turns 2 (8666) and 3 (12999)."""
    rig = homing_rig(method, 500, encoder_direction=direction)
    rig.control(0x1F)
    assert bits(rig) == SEARCHING
    rig.run(2500)
    assert bits(rig) == ATTAINED
    home = math.floor(pulse * TURN + 0.5)
    encoder = 10_000 + rig.device.plant_state[0].joint_position_rad * rig.device.device[0].counts_per_rad
    assert rig.get(0x6064) - 500 == pytest.approx(encoder - home, abs=1.0)
    assert abs(rig.get(0x6064) - 500) < 100  # it stopped close to the pulse
    rig.set(0x6060, 0, 1, 1)  # and positions count from there
    rig.set(0x607A, 0, 500, 4)
    rig.control(0x0F)
    rig.control(0x1F)
    rig.run(1500)
    encoder = 10_000 + rig.device.plant_state[0].joint_position_rad * rig.device.device[0].counts_per_rad
    assert encoder == pytest.approx(home, abs=20.0)


@pytest.mark.parametrize("word", [0x0F, 0x011F])
def test_bit_4_falling_and_halt_interrupt_the_search(word: int) -> None:
    rig = homing_rig(34)
    rig.control(0x1F)
    rig.run(100)
    assert bits(rig) == SEARCHING
    assert rig.speed_radps > 0.01
    rig.control(word)
    rig.run(500)
    assert bits(rig) == INTERRUPTED
    assert abs(rig.speed_radps) < 1e-3
    assert rig.get(0x6064) < 12_000
    rig.control(0x0F, 0x1F)
    rig.run(2500)
    assert bits(rig) == ATTAINED


def test_leaving_the_mode_interrupts_the_search() -> None:
    rig = homing_rig(33)
    rig.control(0x1F)
    rig.run(50)
    rig.set(0x6060, 0, 3, 1)
    rig.run(50)
    assert rig.device.device[0].homing == HomingState.IDLE


def test_method_0_and_a_blocked_joint_are_homing_errors() -> None:
    rig = homing_rig(0)
    rig.control(0x1F)
    assert bits(rig) == FAILED
    rig = homing_rig(33, end_stops=True, end_stop_min_rad=-0.005, end_stop_max_rad=1.0)
    rig.set(0x6072, 0, 50, 2)
    rig.control(0x1F)
    rig.run(2000)
    assert bits(rig) == SEARCHING
    rig.run(1500)
    assert bits(rig) == FAILED
    assert rig.get(0x6064) != 0


def test_the_home_position_is_lost_with_a_reset_of_the_node_only() -> None:
    rig = homing_rig(37)
    rig.control(0x1F)
    rig.run(2)
    assert rig.get(0x6064) == 0
    rig.send(0, bytes([0x82, NODE]))
    rig.run(2)
    assert rig.get(0x6064) == 0
    rig.send(0, bytes([0x81, NODE]))
    rig.run(2)
    assert rig.get(0x6064) == 10_000


@pytest.mark.parametrize("relative", [0x00, 0x40])
def test_a_command_right_after_enabling_is_not_lost(relative: int) -> None:
    """No substep of the plant lies between the two: the master is as fast as the bus."""
    rig = Rig(step_s=1e-3, encoder_offset_counts=10_000)
    rig.set(0x6060, 0, 1, 1)
    rig.set(0x607A, 0, 12_000, 4)
    for word in (0x06, 0x07, 0x0F, 0x1F | relative):
        rig.set(0x6040, 0, word, 2)
    rig.run(1500)
    assert rig.get(0x6064) == pytest.approx(22_000 if relative else 12_000, abs=100)
    rig.set(0x6098, 0, 37, 1)
    for word in (0x00, 0x06, 0x07, 0x0F):
        rig.set(0x6040, 0, word, 2)
    rig.set(0x6060, 0, HOMING, 1)
    rig.set(0x6040, 0, 0x1F, 2)
    rig.run(3)
    assert bits(rig) == ATTAINED


def acknowledged(rig: Rig) -> bool:
    return bool(rig.get(0x6041) & 0x1000)


def reached(rig: Rig) -> bool:
    return bool(rig.get(0x6041) & 0x0400)


def position_rig() -> Rig:
    rig = Rig(step_s=1e-3)
    rig.enable(1)
    return rig


def test_a_second_set_point_waits_for_the_first() -> None:
    rig = position_rig()
    rig.set(0x607A, 0, 20_000, 4)
    rig.control(0x1F)
    assert acknowledged(rig)
    rig.control(0x0F)
    assert not acknowledged(rig)
    rig.set(0x607A, 0, -5_000, 4)
    rig.control(0x1F)
    rig.control(0x0F)
    assert acknowledged(rig)  # one waits: no room for a third
    rig.set(0x607A, 0, 77_000, 4)
    rig.control(0x1F, 0x0F)
    highest = 0
    while acknowledged(rig):
        rig.run(1)
        highest = max(highest, rig.get(0x6064))
    assert highest == pytest.approx(20_000, abs=600)
    assert not reached(rig)
    rig.run(2000)
    assert reached(rig)
    assert rig.get(0x6064) == pytest.approx(-5_000, abs=100)


def test_change_set_immediately_replaces_the_target_under_way() -> None:
    rig = position_rig()
    rig.set(0x607A, 0, 60_000, 4)
    rig.control(0x1F, 0x0F)
    rig.run(300)
    rig.set(0x607A, 0, -5_000, 4)
    rig.control(0x3F)
    assert acknowledged(rig)
    rig.control(0x2F)
    assert not acknowledged(rig)
    highest = 0
    for _ in range(2500):
        rig.run(1)
        highest = max(highest, rig.get(0x6064))
    assert highest < 45_000
    assert reached(rig)
    assert rig.get(0x6064) == pytest.approx(-5_000, abs=100)


def test_relative_set_points_add_up() -> None:
    rig = position_rig()
    rig.set(0x607A, 0, 3_000, 4)
    for _ in range(3):
        rig.control(0x5F, 0x4F)
        rig.run(800)
        assert reached(rig)
    assert rig.get(0x6064) == pytest.approx(9_000, abs=100)


def test_halt_stops_a_profile_and_its_end_resumes_it() -> None:
    rig = position_rig()
    rig.set(0x607A, 0, 60_000, 4)
    rig.control(0x1F)
    rig.run(300)
    rig.control(0x011F)
    rig.run(500)
    halted = rig.get(0x6064)
    assert 10_000 < halted < 50_000
    assert reached(rig)  # with halt: standstill
    rig.run(300)
    assert rig.get(0x6064) == pytest.approx(halted, abs=20)
    rig.control(0x1F)
    rig.run(1500)
    assert rig.get(0x6064) == pytest.approx(60_000, abs=100)
