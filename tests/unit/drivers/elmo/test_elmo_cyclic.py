"""The cyclic exchange on memory, against the virtual drive's interpreter, and on a line that loses bytes."""

from __future__ import annotations

import contextlib
import itertools
import math
import socket
import struct
import threading
import time
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointctl.drivers.elmo.cyclic import (
    EXPECTED_MAX,
    LINE_MAX,
    ElmoPort,
    Question,
    begin_cycle,
    current_mA,
    end_cycle,
    note_written,
    parse_number,
    put_command,
    take_byte,
    velocity_cps,
)
from jointctl.drivers.elmo.dialogue import SERVO_ON, UNIT_MODE_SHIFT, ReplyKind, parse_reply
from jointctl.drivers.elmo.exchange import link_of, receive
from jointctl.firmware_py.records import LINE_GONE, Sample
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import DriveRequest, DriveState
from jointctl.hil.elmo_drive import AMPLIFIER_NOT_READY, switch_off
from tests.unit.drivers.elmo.virtual_line import PER_RAD, PERIOD_S, RAMP_CPS2, Talk


# --- The cyclic exchange on memory, against the virtual drive's interpreter: no port and no time ---
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


@dataclass
class Moving:
    """A drive that is commanded to move, and how its stop is said."""

    talk: Talk
    command: dict[str, float]
    value: float
    stop: bytes

    def commanded(self) -> float:
        return float(self.talk.device.m.jog_cps if b"JV" in self.stop else self.talk.device.m.torque_A)


@pytest.fixture(params=[(speed, echo) for speed in (True, False) for echo in (True, False)])
def moving(request: pytest.FixtureRequest) -> Moving:
    speed, echo = request.param
    if speed:
        return Moving(Talk(echo, speed=True).enabled(), {"velocity_radps": 0.5}, 41722, b"JV=0 BG")
    return Moving(Talk(echo).enabled(), {"torque_Nm": 24.2}, 2.0, b"TC=0.000")


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


class TestDeadMan:
    @pytest.mark.trips("serial loop: that positions come", r"JV=0\r")
    @pytest.mark.stays("serial loop: that positions come", r"JV=41722\r")
    @pytest.mark.parametrize("late", [0, 1])
    def test_the_dead_man_commands_a_stop_and_its_twin_does_not(self, jog: Talk, late: int) -> None:
        talk = Talk().enabled()
        jog.cycle(velocity_radps=0.5)
        talk.cycle(torque_Nm=12.1)
        for moving, words in ((jog, (b"JV=41722\rBG\r", b"JV=0\rBG\r")), (talk, (b"TC=1.000\r", b"TC=0.000\r"))):
            moving.port.expected_count = 0
            moving.port.no_sample_cycles = moving.port.dead_man_cycles + late
            end_cycle(moving.port, moving.sample, moving.command)
            assert bytes(moving.port.out[: moving.port.out_length]).startswith(words[late])

    @pytest.mark.parametrize("noise", [b"", b"\x55\x13"], ids=["silent", "chattering"])
    def test_the_dead_man_speaks_on_a_silent_and_on_a_chattering_line(self, moving: Moving, noise: bytes) -> None:
        talk = moving.talk
        talk.cycle(**moving.command, count=4)
        assert moving.commanded() == moving.value
        talk.mute = True
        said = []
        for _ in range(24):
            talk.hear(noise)
            said.append(moving.stop in b" ".join(talk.cycle(**moving.command)))
            talk.hear(noise)
        dead_man = int(talk.port.dead_man_cycles)
        assert not any(said[:dead_man])
        assert all(a or (noise and b) for a, b in itertools.pairwise(said[dead_man:]))
        assert moving.commanded() == 0.0

    @pytest.mark.parametrize("lost_cycles", range(1, 18))
    def test_its_twin_a_line_that_comes_back_is_used_again(self, moving: Moving, lost_cycles: int) -> None:
        talk = moving.talk
        talk.cycle(**moving.command, count=4)
        talk.mute = True
        said = [line for _ in range(lost_cycles) for line in talk.cycle(**moving.command)]
        assert (moving.stop.split()[0] in said) == (lost_cycles > talk.port.dead_man_cycles)
        talk.mute = False
        talk.cycle(**moving.command, count=5)
        assert (talk.port.no_sample_cycles, moving.commanded()) == (0, moving.value)


class TestNumbers:
    @pytest.mark.parametrize(
        ("torque_Nm", "milli"),
        [(0.0, 0), (12.1, 1000), (60.5, 5000), (60.6, 5000), (-1e9, -5000), (math.nan, 0), (math.inf, 0), (0.00605, 0),
         (0.0061, 1)],
    )  # fmt: skip
    @pytest.mark.parametrize("direction", [1, -1])
    def test_torque_and_velocity_are_saturated_before_the_cast(
        self, torque_Nm: float, milli: int, direction: int
    ) -> None:
        port = new(ElmoPort)[0]
        port.torque_NmpA, port.max_current_mA = 12.1 * direction, 5000
        assert current_mA(port, torque_Nm) == direction * milli
        port.position_radpcount, port.max_velocity_cps = direction * 0.0121, 5000
        assert velocity_cps(port, torque_Nm) == direction * milli

    @pytest.mark.parametrize("milli", [0, 1, -1, 9, 10, 999, 1000, -1001, 12345, -99999, 123456])
    def test_the_text_of_a_current_reads_back(self, milli: int) -> None:
        port = new(ElmoPort)[0]
        assert put_command(port, Question.TC, milli, 3)
        text = bytes(port.out[: port.out_length])
        assert text[-1:] == b"\r"
        assert float(text[3:-1]) == milli / 1000.0

    @settings(max_examples=150)
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

    @pytest.mark.parametrize(("changed", "on"), [(False, 0), (True, 1)])
    def test_a_drive_that_refuses_is_not_asked_again_and_its_twin_whose_line_changed_it_is(
        self, talk: Talk, changed: bool, on: int
    ) -> None:
        """Its STO is open, say, and no bit of SR shows that: what is closed later begins no motion."""
        talk.cycle(DriveRequest.OFF, count=4)
        switch_on = talk.device.execute
        talk.device.execute = lambda line: (  # type: ignore[method-assign]
            switch_on(line) if line != b"MO=1" else b";" if changed else bytes([AMPLIFIER_NOT_READY]) + b"?;"
        )
        talk.cycle()
        talk.device.execute = switch_on  # type: ignore[method-assign]
        talk.cycle(count=3 * int(talk.port.enable_retry_cycles))
        assert (talk.device.m.motor_on, talk.port.refused) == (on, int(not changed))

    def test_a_motor_that_is_switched_off_by_others_stays_off(self, talk: Talk) -> None:
        talk.enabled()
        talk.device.execute(b"MO=0")
        said = [line for _ in range(2 * int(talk.port.enable_retry_cycles)) for line in talk.cycle()]
        assert talk.sample.drive_state == DriveState.OFF
        assert b"MO=1" not in said

    @pytest.mark.parametrize("restarted", [True, False])
    def test_a_restart_shows_by_the_unit_mode_and_its_twin_that_only_goes_off_does_not(self, restarted: bool) -> None:
        talk = Talk()
        assert b"MO=1" not in talk.cycle()  # without a status nothing is switched on
        talk.enabled()
        assert talk.sample.restarts == 0
        if restarted:
            talk.device.restart()
        else:
            talk.device.execute(b"MO=0")
        talk.cycle(count=4)
        assert (talk.sample.restarts, talk.sample.drive_state) == (int(restarted), DriveState.OFF)

    def test_a_restart_before_the_first_status_is_one_and_nothing_is_switched_on(self, talk: Talk) -> None:
        talk.device.execute(b"UM=5")
        talk.cycle(DriveRequest.OFF, count=2)
        assert (talk.sample.restarts, talk.port.unit_mode) == (0, 0)  # one reply alone: it is asked again
        assert talk.cycle(DriveRequest.OFF)[-1] == b"SR"
        assert talk.sample.restarts == 1
        said = [line for _ in range(2 * int(talk.port.enable_retry_cycles)) for line in talk.cycle()]
        assert (b"MO=1" in said, talk.device.m.motor_on, talk.sample.restarts) == (False, 0, 1)

    @pytest.mark.parametrize("replies", [1, 2])
    @pytest.mark.parametrize("speed", [False, True])
    def test_one_damaged_status_is_no_restart_and_begins_nothing(self, speed: bool, replies: int) -> None:
        """Without an echo nothing shows that a digit was changed; the next reply does."""
        talk = Talk(echo=False, speed=speed).enabled()
        status, left = talk.device.execute(b"SR").rstrip(b";"), [replies]
        other = b"%d;" % (int(status) ^ 7 << UNIT_MODE_SHIFT ^ SERVO_ON)  # another unit mode, motor off

        def spoil(reply: bytes) -> bytes:
            if reply.rstrip(b";") != status or not left[0]:
                return reply
            left[0] -= 1
            return other

        talk.spoil = spoil
        said = [line for _ in range(2) for line in talk.cycle()]
        assert said[-1] == b"SR"
        assert (talk.sample.restarts, talk.sample.drive_state) == (0, DriveState.ENABLED)
        again = talk.cycle()
        assert b"BG" not in again
        assert again[-1] == b"SR"
        talk.cycle(count=4)
        assert (talk.sample.restarts, talk.sample.drive_state) == (int(replies == 2), DriveState.ENABLED)


# --- The compiled exchange on a descriptor: a cycle that was held up, and its twin in time ---
REPLY = b"PX\r42;"
LOOK_S = struct.pack("ll", 0, 1000)  # how long a look at an empty line takes: its descriptor is one that blocks


class Line:
    """The loop's end of a line that may be full; its other end answers before it takes the question."""

    def __init__(self) -> None:
        self.ours, self.its = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        self.ours.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, LOOK_S)
        self.its.setblocking(False)
        self.port, self.sample = new(ElmoPort, 1), new(Sample, 1)
        port = self.port[0]
        port.fd, port.echo, port.position_radpcount = self.ours.fileno(), 1, 1e-3
        self._link = link_of(self.port)

    def __enter__(self) -> Line:
        self.cycle(0)  # compiled, or loaded, by now: the first one takes long
        self._empty()
        self.port[0].expected_count = 0
        return self

    def __exit__(self, *_: object) -> None:
        self.ours.close()
        self.its.close()

    def fill(self) -> None:
        """The next write waits until somebody reads."""
        with contextlib.suppress(BlockingIOError):
            while True:
                self.ours.send(bytes(4096), socket.MSG_DONTWAIT)

    def _empty(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                self.its.recv(1 << 20)

    def answer_after(self, delay_s: float) -> threading.Thread:
        def answer() -> None:
            time.sleep(delay_s)
            self.its.send(REPLY)
            self._empty()

        drive = threading.Thread(target=answer)
        drive.start()
        return drive

    def reply(self, data: bytes) -> None:
        self.its.send(data)

    def slot(self, window_end_ns: int) -> int:
        """The same for a window that ends then."""
        before = int(self.sample[0].count)
        receive(self._link, self.sample, time.monotonic_ns(), window_end_ns)
        return int(self.sample[0].count) - before

    def cycle(self, window_ns: int) -> int:
        """How many samples one cycle brings that waits for its own until `window_ns` after its wake-up."""
        before, now_ns = int(self.sample[0].count), time.monotonic_ns()
        receive(self._link, self.sample, now_ns, now_ns + window_ns)
        return int(self.sample[0].count) - before


@pytest.mark.parametrize(("window_ns", "samples"), [(20_000_000, 0), (10_000_000_000, 1)])
def test_a_cycle_held_up_past_its_window_leaves_the_position_to_the_next(window_ns: int, samples: int) -> None:
    with Line() as line:
        line.fill()
        drive = line.answer_after(0.1)
        assert line.cycle(window_ns) == samples
        drive.join()
        taken_from_ns = time.monotonic_ns()
        assert line.cycle(1_000_000) == 1 - samples
        assert line.sample[0].position_rad == pytest.approx(0.042)
        assert (line.sample[0].time_ns >= taken_from_ns) == (samples == 0)


PERIOD_NS = 100_000_000


def asked_once(line: Line, slots_later: float) -> int:
    """The window's end of a cycle that comes `slots_later` after one whose reply came after it."""
    line.port[0].period_ns = PERIOD_NS
    asked_ns = time.monotonic_ns() + 1_000_000
    assert line.slot(asked_ns) == 0
    line.reply(REPLY)
    return asked_ns + int(slots_later * PERIOD_NS)


@pytest.mark.parametrize(("slots_later", "samples"), [(1, 1), (2, 0), (13, 0)])
def test_a_position_asked_for_two_slots_ago_does_not_pass_for_one_of_now(slots_later: int, samples: int) -> None:
    with Line() as line:
        window_ns = asked_once(line, slots_later)
        time.sleep(max(0.0, 1e-9 * (window_ns - time.monotonic_ns()) - 0.02))
        assert line.slot(window_ns) == samples
        assert line.port[0].lost == 1 - samples


def test_a_late_position_is_none_in_a_cycle_that_is_late_itself() -> None:
    with Line() as line:
        window_ns = asked_once(line, 1)
        time.sleep(1e-9 * (window_ns - time.monotonic_ns()) + 0.01)
        assert line.slot(window_ns) == 0


def test_the_late_position_of_the_last_slot_is_no_reason_not_to_wait_for_the_new_one() -> None:
    with Line() as line:
        line.port[0].usual_answer_ns = PERIOD_NS  # neither of them comes unusually late
        window_ns = asked_once(line, 1)
        answer = threading.Timer(0.03, line.reply, [b"PX\r50;"])
        answer.start()
        assert line.slot(window_ns) == 2
        assert line.sample[0].position_rad == pytest.approx(0.05)
        answer.join()


# --- Bytes that the line loses, changes or delays, and what any bytes do to the cyclic exchange ---
class TestFaultsOfTheLine:
    def test_nothing_is_lost_by_a_garbled_reply_but_its_value(self) -> None:
        talk = Talk().enabled()
        before = int(talk.sample.count)
        talk.spoil = lambda reply: b"\xfe" + reply[1:]
        talk.cycle()
        assert talk.sample.count == before
        assert talk.port.garbled >= 1
        talk.spoil = lambda reply: reply
        talk.cycle(count=3)
        assert talk.sample.count == before + 3
        assert talk.port.silent_cycles == 0

    def test_with_echo_a_reply_is_never_taken_for_another(self) -> None:
        talk = Talk().enabled()
        position = float(talk.sample.position_rad)
        talk.spoil = lambda reply: b"" if reply.startswith(b"PX") else reply  # position replies vanish, others come
        talk.cycle(count=8)
        assert talk.sample.position_rad == position
        assert talk.sample.drive_state == DriveState.ENABLED

    def test_half_a_reply_spoils_the_next_one_only(self) -> None:
        talk = Talk().enabled()
        begin_cycle(talk.port, talk.sample)
        talk.port.out_length = 0
        assert not talk.hear(b"PX\r83")  # the rest never comes
        end_cycle(talk.port, talk.sample, talk.command)
        talk.port.out_length = 0
        begin_cycle(talk.port, talk.sample)
        talk.port.out_length = 0
        assert not talk.hear(b"TC=0.000\r;")
        assert talk.hear(b"PX\r8344;")

    def test_a_silent_drive_is_asked_again_after_a_pause(self, talk: Talk) -> None:
        talk.enabled()
        talk.mute = True
        said = [tuple(talk.cycle()) for _ in range(9)]
        assert () in said
        assert talk.port.resyncs >= 1
        talk.mute = False
        count = int(talk.sample.count)
        talk.cycle(count=6)
        assert talk.sample.count > count

    def test_a_stop_is_said_even_while_the_line_is_in_disorder(self, talk: Talk) -> None:
        talk.enabled()
        talk.mute = True
        talk.cycle(count=5)
        for _ in range(12):
            assert b"MO=0" in talk.cycle(DriveRequest.QUICK_STOP)
        assert talk.device.m.motor_on == 0

    def test_memory_is_bounded(self) -> None:
        talk = Talk()
        assert not talk.hear(b"x" * (10 * LINE_MAX) + b";")
        assert talk.port.line_length == 0
        count = 0
        while put_command(talk.port, Question.PX, 0, -1):
            talk.port.out_length = 0
            count += 1
        assert count == EXPECTED_MAX

    def test_a_vanished_port_is_a_bus_error_at_once(self) -> None:
        talk = Talk()
        note_written(talk.port, talk.sample, 5)
        assert talk.sample.bus_errors == 1
        talk.port.gone = 1
        begin_cycle(talk.port, talk.sample)
        assert talk.sample.bus_errors == LINE_GONE

    @settings(max_examples=150)
    @given(st.lists(st.binary(max_size=24), max_size=20), st.booleans())
    def test_any_bytes_leave_the_exchange_able_to_go_on(self, chunks: list[bytes], echo: bool) -> None:
        talk = _shared(echo)
        for chunk in chunks:
            begin_cycle(talk.port, talk.sample)
            talk.hear(chunk)
            end_cycle(talk.port, talk.sample, talk.command)
        assert 0 <= talk.port.expected_count <= EXPECTED_MAX
        assert 0 <= talk.port.line_length <= LINE_MAX
        assert math.isfinite(talk.sample.position_rad)
        count = int(talk.sample.count)
        talk.cycle(DriveRequest.OFF, count=8)
        assert talk.sample.count > count

    @settings(max_examples=150)
    @given(st.binary(max_size=20), st.booleans())
    def test_the_kernel_takes_no_position_that_the_slow_parser_would_not(self, body: bytes, echo: bool) -> None:
        frame = ((b"PX\r" if echo else b"") + body).replace(b";", b"")
        talk = _shared(echo)
        talk.port.expected_count = talk.port.line_length = talk.port.line_overflow = talk.port.quiet = 0
        put_command(talk.port, Question.PX, 0, -1)
        if talk.hear(frame + b";"):
            reply = parse_reply(b"PX\r", frame, echo)
            assert reply.kind is ReplyKind.VALUE
            assert int(reply.text) == talk.port.last_counts
        talk.port.primed = 0


_TALKS: dict[bool, Talk] = {}


def _shared(echo: bool) -> Talk:
    """One for all examples: a new plant each would take longer than the test."""
    return _TALKS.setdefault(echo, Talk(echo))


def test_a_digit_that_the_line_changed_is_taken_because_nothing_shows_it() -> None:
    talk = Talk().enabled()
    before_rad = float(talk.sample.position_rad)
    talk.spoil = lambda reply: reply.replace(b"PX\r8", b"PX\r9")  # 8344 becomes 9344: the loop's jump limit is next
    talk.cycle()
    assert talk.sample.position_rad - before_rad == pytest.approx(1000 * math.tau / 2**19, rel=1e-3)


@pytest.mark.parametrize("current_A", [9.9, 10.1])
def test_a_damaged_torque_command_is_bounded_by_the_drives_peak_current(current_A: float) -> None:
    talk = Talk().enabled()  # PL[1] is 10 A
    talk.cycle(torque_Nm=12.1)
    talk.device.execute(b"TC=%.1f" % current_A)
    assert talk.device.m.torque_A == (current_A if current_A < 10.0 else 1.0)
    talk.cycle(torque_Nm=12.1)
    assert talk.device.m.torque_A == 1.0  # the next one, a period later


def positions_taken(answers_ms: list[float], period_ns: int = 8_000_000) -> list[bool]:
    """Which positions count that come so long after their cycle began."""
    talk = Talk()
    port, taken = talk.port, []
    port.period_ns = period_ns
    for cycle, answer_ms in enumerate(answers_ms, 1):
        port.asked_ns = cycle * 8_000_000
        port.window_ns = port.asked_ns + 4_800_000
        begin_cycle(port, talk.sample)
        now_ns = int(port.asked_ns) + round(answer_ms * 1e6)
        taken.append([bool(take_byte(port, byte, talk.sample, now_ns)) for byte in b"PX\r42;"][-1])
        assert port.answered_window_ns == port.window_ns  # it is not waited for any longer
    return taken


@pytest.mark.parametrize(
    ("late_ms", "late", "counts"), [(0.5, 1, True), (0.52, 1, False), (-0.9, 1, True), (2.0, 2, False), (2.0, 3, False)]
)
def test_a_few_positions_that_come_unusually_late_are_left_out(late_ms: float, late: int, counts: bool) -> None:
    """Nobody knows when it was read: 1.9 ms late at 0.83 rad/s it looked like 1.03 rad/s; of two, the second 1.24."""
    assert positions_taken([1.0] * 5 + [1.0 + late_ms] * late + [1.0] * 3) == [True] * 5 + [counts] * late + [True] * 3


def test_many_late_positions_in_a_row_are_the_way_of_the_line() -> None:
    assert positions_taken([1.0] * 5 + [3.0] * 6) == [True] * 5 + [False] * 3 + [True] + [False] * 2
    assert all(positions_taken([1.0] * 5 + [3.0] * 400)[-200:])  # it has become usual
    assert all(positions_taken([1.0, 3.0, 3.0], period_ns=0))
