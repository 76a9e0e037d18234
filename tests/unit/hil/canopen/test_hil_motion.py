"""States and modes of the virtual drive (CiA 402), frame by frame: quick stop, modes, homing."""

from __future__ import annotations

import math
from typing import Any

import pytest

from jointctl.hil.canopen.records import HomingState
from tests.virtual_drive import MS, NODE, Rig

# States and modes of the virtual drive (CiA 402), frame by frame: quick stop, torque, speed, position.


@pytest.mark.parametrize(("option", "status"), [(0, 0x40), (1, 0x40), (2, 0x40), (5, 0x07), (6, 0x07)])
def test_quick_stop_brakes_and_ends_as_605a_says(rig: Rig, option: int, status: int) -> None:
    rig.set(0x605A, 0, option, 2)
    rig.enable(10)
    rig.set(0x6071, 0, 500, 2)
    rig.run(100)
    before = rig.speed_radps
    assert before > 1.0
    rig.control(0x02)
    rig.run(1500)
    assert rig.get(0x6041) & 0x4F == status
    assert (abs(rig.speed_radps) < 0.02) is (option != 0)
    if option >= 5:
        rig.set(0x6071, 0, 0, 2)
        rig.control(0x0F)
        assert rig.get(0x6041) & 0x6F == 0x27


def test_cyclic_torque_scales_by_rated_torque_and_moves_the_plant(rig: Rig) -> None:
    rig.enable(10)
    rig.set(0x6071, 0, 100, 2)
    rig.set(0x60B2, 0, 20, 2)
    rig.run(50)
    joint_Nm = 0.120 * 0.5 * 121.0
    assert rig.get(0x6077) == 120
    assert rig.device.plant_state[0].actuator_torque_Nm == pytest.approx(joint_Nm, rel=1e-9)
    assert rig.speed_radps == pytest.approx(joint_Nm / 2.1 * 0.05, rel=0.05)


def test_the_reported_torque_is_that_of_the_current_without_the_ripple(rig: Rig) -> None:
    rig.enable(10)
    plant = rig.device.plant_constants[0]
    plant.torque_ripple.count = 1
    plant.torque_ripple.amplitude[0] = 6.0
    plant.torque_ripple.phase_turns[0] = 0.25  # its crest, at any angle
    rig.set(0x6071, 0, 100, 2)
    rig.run(50)
    assert rig.get(0x6077) == 100
    assert rig.get(0x6078) == 100  # rated current yields rated torque
    joint_Nm = 0.100 * 0.5 * 121.0
    assert rig.device.plant_state[0].actuator_torque_Nm == pytest.approx(joint_Nm + 6.0, rel=1e-9)


@pytest.mark.parametrize(("target", "limit", "limited"), [(299, 300, 0), (300, 300, 0), (301, 300, 1), (-301, 300, 1)])
@pytest.mark.parametrize("index", [0x6072, 0x6073])
def test_torque_limits_set_bit_11_only_beyond(rig: Rig, index: int, target: int, limit: int, limited: int) -> None:
    rig.set(index, 0, limit, 2)
    rig.enable(10)
    rig.set(0x6071, 0, target, 2)
    rig.run(2)
    assert abs(rig.get(0x6074)) == min(abs(target), limit)
    assert rig.get(0x6041) >> 11 & 1 == limited


def test_torque_mode_follows_the_slope(rig: Rig) -> None:
    rig.enable(4)
    rig.set(0x6071, 0, 200, 2)
    rig.run(100)
    assert rig.get(0x6074) == pytest.approx(100, abs=3)
    rig.run(150)
    assert rig.get(0x6074) == 200
    assert rig.get(0x6041) & 0x400


@pytest.mark.parametrize("mode", [3, 9])
def test_velocity_modes_reach_the_target(rig: Rig, mode: int) -> None:
    rig.enable(mode)
    rig.set(0x60FF, 0, -50_000, 4)
    rig.run(1000)
    assert rig.get(0x606C) == pytest.approx(-50_000, abs=500)


def _braking_ms(rig: Rig, word: int) -> int:
    """How long the joint needs to come to rest once this controlword has come."""
    rig.control(word)
    return next(ms for ms in range(5000) if abs(rig.speed_radps) < 0.01 or rig.run(1) is None)


@pytest.mark.parametrize("mode", [1, 3])
@pytest.mark.parametrize(("option", "rate"), [(1, 200_000), (2, 1_000_000)])
def test_halt_brakes_along_the_ramp_that_605d_names(rig: Rig, mode: int, option: int, rate: int) -> None:
    """6084 or 6085, and the drive stays enabled; without halt the motion goes on."""
    rig.set(0x6084, 0, 200_000, 4)
    rig.set(0x605D, 0, option, 2)
    rig.enable(mode)
    rig.set(0x60FF, 0, 100_000, 4)
    rig.set(0x607A, 0, 1_000_000, 4)
    rig.control(0x1F)
    rig.run(1000)
    assert rig.get(0x606C) == pytest.approx(100_000, rel=0.02)
    assert _braking_ms(rig, 0x11F) == pytest.approx(1e3 * 100_000 / rate, rel=0.1, abs=15)
    assert rig.get(0x6041) & 0x6F == 0x27
    rig.control(0x1F)
    rig.run(1000)
    assert rig.get(0x606C) == pytest.approx(100_000, rel=0.02)


def test_halt_in_torque_mode_takes_the_torque_slope(rig: Rig) -> None:
    rig.set(0x605D, 0, 2, 2)
    rig.enable(4)
    rig.set(0x6071, 0, 50, 2)
    rig.run(100)
    assert rig.get(0x6074) == 50
    rig.control(0x10F)
    rig.run(24)
    assert rig.get(0x6074) == pytest.approx(25, abs=3)


def test_the_velocity_demand_is_that_of_the_velocity_loop(rig: Rig) -> None:
    """606B: the ramp in the velocity modes, zero where no velocity is controlled, the stop ramp of any mode."""
    rig.set(0x6083, 0, 100_000, 4)
    assert rig.get(0x606B) == 0
    rig.enable(3)
    rig.set(0x60FF, 0, -50_000, 4)
    rig.run(250)
    assert rig.get(0x606B) == pytest.approx(-25_000, abs=300)
    rig.run(500)
    assert rig.get(0x606B) == -50_000
    rig.set(0x605A, 0, 2, 2)
    rig.control(0x02)
    rig.run(20)
    assert -40_000 < rig.get(0x606B) < -20_000
    rig.run(200)
    assert rig.get(0x606B) == 0
    rig.control(0x00)
    rig.enable(10)
    rig.set(0x6071, 0, 300, 2)
    rig.run(100)
    assert abs(rig.get(0x606C)) > 10_000
    assert rig.get(0x606B) == 0
    rig.control(0x02)
    rig.run(1)
    assert rig.get(0x606B) == pytest.approx(rig.get(0x606C), rel=0.2)


def test_the_supply_is_there_and_can_be_mapped(rig: Rig) -> None:
    assert rig.get(0x6079) == 48_000  # mV
    rig.set(0x1A02, 0, 0, 1)
    rig.set(0x1A02, 1, 0x60790020, 4)
    rig.set(0x1A02, 2, 0x606B0020, 4)
    rig.set(0x1A02, 0, 2, 1)
    rig.set(0x1802, 1, 0x40000385, 4)
    rig.operational()
    assert (0x385, (48_000).to_bytes(4, "little") + bytes(4)) in rig.send(0x80, b"")


@pytest.mark.parametrize("mode", [1, 8])
def test_position_modes_reach_the_target(rig: Rig, mode: int) -> None:
    rig.enable(mode)
    for target in range(0, 20_001, 50) if mode == 8 else [20_000]:
        rig.set(0x607A, 0, target, 4)
        rig.run(1)
    if mode == 1:
        rig.control(0x1F)
        assert rig.get(0x6041) & 0x1000
        rig.control(0x0F)
        assert not rig.get(0x6041) & 0x1000
    rig.run(1500)
    assert rig.get(0x6064) == pytest.approx(20_000, abs=100)
    assert mode == 8 or rig.get(0x6041) & 0x400


def _pushed_until_unheard(reaction: int, mode: int, calls: int) -> Rig:
    """Pushed in this mode for 300 ms, in so many calls; the controller's heartbeat is lost after 50 ms."""
    rig = Rig()
    rig.set(0x1016, 1, 0x7F << 16 | 50, 4)
    rig.set(0x6007, 0, reaction, 2)
    rig.operational()
    rig.enable(mode)
    rig.set(0x6071, 0, 300, 2)
    rig.send(0x77F, b"\x05")
    for _ in range(calls):
        rig.now_ns += 300 * MS // calls
        rig.device.advance(rig.now_ns)
    return rig


@pytest.mark.parametrize("mode", [10, 4])
@pytest.mark.parametrize(("reaction", "state"), [(0, 4), (1, 7), (2, 1), (3, 1)])
def test_a_torque_is_not_held_beyond_what_ends_it(reaction: int, state: int, mode: int) -> None:
    """In cyclic torque mode it is worked out once a frame: as if it were in each substep, also where a stop begins."""
    whole, stepped = (_pushed_until_unheard(reaction, mode, calls) for calls in (1, 3000))
    assert whole.device.plant_state[0].joint_position_rad > 0.001
    assert whole.device.plant_state.tobytes() == stepped.device.plant_state.tobytes()
    assert whole.device.device[0].demand == stepped.device.device[0].demand
    assert whole.state() == stepped.state() == state


# --- Homing and the set-point handshake of the virtual drive (CiA 402, modes 6 and 1) ---
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
