"""The cyclic exchange on memory, against the virtual drive's interpreter: no port and no time."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointctl.drivers.elmo.cyclic import (
    ElmoPort,
    Question,
    begin_cycle,
    current_mA,
    end_cycle,
    parse_number,
    put_command,
    velocity_cps,
)
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import DriveRequest, DriveState
from jointctl.hil.elmo.motor import switch_off
from tests.unit.drivers.elmo.talk import PER_RAD, PERIOD_S, RAMP_CPS2, Talk


class TestNormal:
    def test_off_asks_for_position_status_and_current_and_nothing_else(self, talk: Talk) -> None:
        said = [tuple(talk.cycle(DriveRequest.OFF)) for _ in range(8)]
        assert set(said[4:]) == {(b"PX", b"SR"), (b"PX", b"IQ")}
        assert talk.sample.count == 8
        assert talk.sample.position_rad == pytest.approx(0.1, abs=2e-5)
        assert talk.sample.drive_state == DriveState.OFF
        assert (talk.port.garbled, talk.port.lost, talk.port.unexpected) == (0, 0, 0)

    def test_enable_switches_on_once_and_then_commands_torque(self, talk: Talk) -> None:
        talk.cycle(DriveRequest.OFF, count=4)
        assert talk.cycle()[1] == b"MO=1"
        assert talk.cycle()[1] != b"MO=1"  # the retry comes much later
        talk.cycle(count=2)
        assert talk.cycle(torque_Nm=-24.2)[1] == b"TC=-2.000"
        assert talk.device.m.torque_A == -2.0
        talk.cycle(torque_Nm=-24.2, count=2)
        assert talk.sample.torque_Nm == pytest.approx(-24.2, rel=1e-3)

    @pytest.mark.parametrize("request_", [DriveRequest.QUICK_STOP, DriveRequest.OFF])
    def test_a_stop_is_torque_zero_stop_and_motor_off(self, talk: Talk, request_: DriveRequest) -> None:
        talk.enabled()
        assert talk.cycle(request_)[1:4] == [b"TC=0.000", b"ST", b"MO=0"]
        talk.cycle(request_, count=2)
        assert talk.sample.drive_state == DriveState.OFF
        assert talk.device.m.motor_on == 0

    def test_the_position_unwraps_32_bits(self) -> None:
        talk = Talk()
        for counts in (2**31 - 5, -(2**31) + 5, 2**31 - 5):
            begin_cycle(talk.port, talk.sample)
            talk.port.out_length = 0
            assert talk.hear(b"PX\r%d;" % counts)
        assert talk.port.counts == 2**31 - 5
        begin_cycle(talk.port, talk.sample)
        talk.hear(b"PX\r%d;" % (-(2**31) + 5))
        assert talk.sample.position_rad == pytest.approx((2**31 + 5) * math.tau / 2**19)


@pytest.fixture(params=[True, False], ids=["echo", "no echo"])
def jog(request: pytest.FixtureRequest) -> Talk:
    return Talk(request.param, speed=True).enabled()


class TestSpeedMode:
    def test_every_cycle_says_jog_and_begin_and_the_joint_follows(self, jog: Talk) -> None:
        said = [tuple(jog.cycle(velocity_radps=-0.5)) for _ in range(150)]
        assert set(said) == {(b"PX", b"JV=-41722", b"BG", b"SR"), (b"PX", b"JV=-41722", b"BG", b"IQ")}
        assert jog.device.speed_cps() == pytest.approx(-0.5 * PER_RAD, rel=0.01)
        assert jog.sample.position_rad < 0.1 - 0.3
        assert (jog.port.garbled, jog.port.lost, jog.port.unexpected, jog.port.refused) == (0, 0, 0, 0)

    def test_nothing_moves_before_the_drive_says_that_it_is_enabled(self) -> None:
        talk = Talk(speed=True)
        talk.cycle(DriveRequest.OFF, count=4)
        said = []
        while talk.sample.drive_state != DriveState.ENABLED:
            said += talk.cycle(velocity_radps=0.5)
        assert b"MO=1" in said
        assert not {line for line in said if line.startswith(b"JV")} - {b"JV=0"}
        assert talk.cycle(velocity_radps=0.5)[1:3] == [b"JV=41722", b"BG"]

    @pytest.mark.parametrize("request_", [DriveRequest.QUICK_STOP, DriveRequest.OFF])
    def test_a_stop_is_jog_zero_begin_stop_and_motor_off(self, jog: Talk, request_: DriveRequest) -> None:
        jog.cycle(velocity_radps=0.5, count=20)
        assert jog.cycle(request_, velocity_radps=0.5)[1:5] == [b"JV=0", b"BG", b"ST", b"MO=0"]
        jog.cycle(request_, count=2)
        assert (jog.sample.drive_state, jog.device.m.motor_on) == (DriveState.OFF, 0)

    def test_a_stop_whose_motor_off_is_lost_brakes_all_the_same(self, jog: Talk) -> None:
        jog.cycle(velocity_radps=0.5, count=60)
        execute = jog.device.execute
        jog.device.execute = lambda line: b";" if line == b"MO=0" else execute(line)  # type: ignore[method-assign]
        jog.cycle(DriveRequest.QUICK_STOP, count=60)
        assert jog.device.m.motor_on
        assert abs(jog.device.speed_cps()) < 0.01 * PER_RAD

    def test_the_dead_man_commands_a_stop_and_its_twin_does_not(self, jog: Talk) -> None:
        jog.cycle(velocity_radps=0.5)
        for late, word in ((0, b"JV=41722\r"), (1, b"JV=0\r")):
            jog.port.expected_count = 0
            jog.port.no_sample_cycles = jog.port.dead_man_cycles + late
            end_cycle(jog.port, jog.sample, jog.command)
            assert bytes(jog.port.out[: jog.port.out_length]).startswith(word + b"BG\r")

    @pytest.mark.parametrize("noise", [b"", b"\x55\x13"], ids=["silent", "chattering"])
    def test_the_dead_man_stops_the_jog_on_a_silent_and_on_a_chattering_line(self, jog: Talk, noise: bytes) -> None:
        jog.cycle(velocity_radps=0.5, count=4)
        jog.mute = True
        said = []
        for _ in range(24):
            jog.hear(noise)
            said.append(b"JV=0 BG" in b" ".join(jog.cycle(velocity_radps=0.5)))
            jog.hear(noise)
        dead_man = int(jog.port.dead_man_cycles)
        assert not any(said[:dead_man])
        assert all(a or (noise and b) for a, b in itertools.pairwise(said[dead_man:]))
        assert jog.device.m.jog_cps == 0.0

    @pytest.mark.parametrize("lost_cycles", range(1, 18))
    def test_its_twin_a_line_that_comes_back_jogs_on(self, jog: Talk, lost_cycles: int) -> None:
        jog.cycle(velocity_radps=0.5, count=4)
        jog.mute = True
        said = [line for _ in range(lost_cycles) for line in jog.cycle(velocity_radps=0.5)]
        assert (b"JV=0" in said) == (lost_cycles > jog.port.dead_man_cycles)
        jog.mute = False
        jog.cycle(velocity_radps=0.5, count=5)
        assert (jog.port.no_sample_cycles, jog.device.m.jog_cps) == (0, 41722)

    def test_a_restart_shows_by_the_unit_mode_and_nothing_is_begun_in_another_one(self, jog: Talk) -> None:
        jog.cycle(velocity_radps=0.5, count=4)
        assert jog.sample.restarts == 0
        jog.device.restart()
        jog.device.execute(b"MO=1")  # position mode: a BG would begin another motion
        jog.cycle(count=4)
        assert jog.sample.restarts == 1
        assert b"BG" not in jog.cycle(velocity_radps=0.5) + jog.cycle(DriveRequest.QUICK_STOP)

    def test_its_twin_a_drive_that_goes_off_and_stays_in_speed_mode_has_not_restarted(self, jog: Talk) -> None:
        jog.device.execute(b"MO=0")
        jog.cycle(count=4)
        assert jog.sample.restarts == 0

    @pytest.mark.parametrize("speed_cps", [99_000, 101_000])
    def test_a_damaged_jog_is_bounded_by_the_drives_speed_limit_and_its_ramp(self, jog: Talk, speed_cps: int) -> None:
        jog.device.execute(b"HL[2]=100000")
        jog.cycle(velocity_radps=0.1, count=60)
        before_cps = jog.device.speed_cps()
        jog.device.execute(b"JV=%d" % speed_cps)
        jog.device.execute(b"BG")
        assert jog.device.m.jog_cps == (99_000 if speed_cps == 99_000 else round(0.1 * PER_RAD))
        jog.device.advance_to((jog.cycle_number + 1) * PERIOD_S)
        gained = jog.device.speed_cps() - before_cps
        assert (gained if speed_cps == 99_000 else 0.0) <= RAMP_CPS2 * PERIOD_S
        jog.cycle(velocity_radps=0.1)
        assert jog.device.m.jog_cps == round(0.1 * PER_RAD)  # the next one, a period later


class TestNumbers:
    @pytest.mark.parametrize(
        ("velocity_radps", "cps"),
        [(0.0, 0), (0.5, 41722), (-0.5, -41722), (1.0, 80_000), (-1e9, -80_000), (math.nan, 0), (math.inf, 0)],
    )
    @pytest.mark.parametrize("direction", [1, -1])
    def test_velocity_is_saturated_before_the_cast(self, velocity_radps: float, cps: int, direction: int) -> None:
        port = new(ElmoPort)[0]
        port.position_radpcount, port.max_velocity_cps = direction / PER_RAD, 80_000
        assert velocity_cps(port, velocity_radps) == direction * cps

    @pytest.mark.parametrize(
        ("torque_Nm", "milli"),
        [(0.0, 0), (12.1, 1000), (60.5, 5000), (60.6, 5000), (-1e9, -5000), (math.nan, 0), (math.inf, 0), (0.00605, 0),
         (0.0061, 1)],
    )  # fmt: skip
    def test_torque_is_saturated_before_the_cast(self, torque_Nm: float, milli: int) -> None:
        port = new(ElmoPort)[0]
        port.torque_NmpA, port.max_current_mA = 12.1, 5000
        assert current_mA(port, torque_Nm) == milli

    @pytest.mark.parametrize("milli", [0, 1, -1, 9, 10, 999, 1000, -1001, 12345, -99999, 123456])
    def test_the_text_of_a_current_reads_back(self, milli: int) -> None:
        port = new(ElmoPort)[0]
        assert put_command(port, Question.TC, milli, 3)
        text = bytes(port.out[: port.out_length])
        assert text[-1:] == b"\r"
        assert float(text[3:-1]) == milli / 1000.0

    @settings(max_examples=150, deadline=None)
    @given(st.from_regex(rb"[+-]?[0-9]{1,9}(\.[0-9]{0,6})?", fullmatch=True))
    def test_decimal_numbers(self, text: bytes) -> None:
        good, value, whole = parse_number(np.frombuffer(text, np.uint8), 0, len(text))
        assert good
        assert value == pytest.approx(float(text), rel=1e-12, abs=1e-12)
        assert whole == (b"." not in text)

    @pytest.mark.parametrize("text", [b"", b"-", b".", b"1-", b"1.2.3", b"nan", b"1e5", b" 1", b"1\xfe", b"9" * 18])
    def test_anything_else_is_no_number(self, text: bytes) -> None:
        assert not parse_number(np.frombuffer(text + b"x", np.uint8), 0, len(text))[0]


class TestFaultsOfTheDrive:
    def test_a_motor_fault_is_told_with_its_cause_and_nothing_is_enabled_again(self, talk: Talk) -> None:
        talk.enabled()
        switch_off(talk.device.m, 0x20000)
        said = [line for _ in range(8) for line in talk.cycle()]
        assert (talk.sample.drive_state, talk.sample.drive_error) == (DriveState.FAULT, 0x20000)
        assert b"MO=1" not in said
        assert b"MF" in said

    def test_a_fault_without_cause_is_told_as_well(self, talk: Talk) -> None:
        talk.enabled()
        talk.device.amplifier = 3
        talk.cycle(count=14)
        assert (talk.sample.drive_state, talk.sample.drive_error) == (DriveState.FAULT, 0)

    def test_a_motor_that_is_switched_off_by_others_stays_off(self, talk: Talk) -> None:
        talk.enabled()
        talk.device.execute(b"MO=0")
        said = [line for _ in range(2 * int(talk.port.enable_retry_cycles)) for line in talk.cycle()]
        assert talk.sample.drive_state == DriveState.OFF
        assert b"MO=1" not in said

    def test_a_restart_shows_by_the_unit_mode(self) -> None:
        talk = Talk().enabled()
        assert talk.sample.restarts == 0
        talk.device.restart()
        talk.cycle(count=4)
        assert talk.sample.restarts == 1
        assert talk.sample.drive_state == DriveState.OFF

    def test_a_restart_before_the_first_status_is_one_and_nothing_is_switched_on(self, talk: Talk) -> None:
        talk.device.execute(b"UM=5")
        talk.cycle(DriveRequest.OFF, count=2)
        assert talk.sample.restarts == 1
        said = [line for _ in range(2 * int(talk.port.enable_retry_cycles)) for line in talk.cycle()]
        assert (b"MO=1" in said, talk.device.m.motor_on, talk.sample.restarts) == (False, 0, 1)

    def test_without_a_status_nothing_is_switched_on(self, talk: Talk) -> None:
        assert b"MO=1" not in talk.cycle()

    def test_its_twin_a_drive_that_goes_off_and_stays_in_torque_mode_has_not_restarted(self) -> None:
        talk = Talk().enabled()
        talk.device.execute(b"MO=0")
        talk.cycle(count=4)
        assert talk.sample.restarts == 0
