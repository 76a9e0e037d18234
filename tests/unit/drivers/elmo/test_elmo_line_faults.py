"""Bytes that the line loses, changes or delays, and what any bytes do to the cyclic exchange."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointctl.drivers.elmo.cyclic import (
    EXPECTED_MAX,
    LINE_MAX,
    Question,
    begin_cycle,
    end_cycle,
    note_written,
    put_command,
    take_byte,
)
from jointctl.drivers.elmo.dialogue import ReplyKind, parse_reply
from jointctl.firmware_py.records import LINE_GONE
from jointctl.firmware_py.states import DriveRequest, DriveState
from tests.unit.drivers.elmo.talk import Talk


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

    def test_the_dead_man_commands_zero_torque_and_its_twin_does_not(self) -> None:
        talk = Talk().enabled()
        talk.cycle(torque_Nm=12.1)
        talk.port.no_sample_cycles = talk.port.dead_man_cycles
        end_cycle(talk.port, talk.sample, talk.command)
        assert b"TC=1.000\r" in bytes(talk.port.out[: talk.port.out_length])
        talk.port.no_sample_cycles += 1
        end_cycle(talk.port, talk.sample, talk.command)
        assert b"TC=0.000\r" in bytes(talk.port.out[: talk.port.out_length])

    @pytest.mark.parametrize("noise", [b"", b"\x55\x13"], ids=["silent", "chattering"])
    def test_the_dead_man_speaks_on_a_silent_and_on_a_chattering_line(self, talk: Talk, noise: bytes) -> None:
        talk.enabled().cycle(torque_Nm=24.2, count=4)
        assert talk.device.m.torque_A == 2.0
        talk.mute = True
        zero_said = []
        for _ in range(24):
            talk.hear(noise)
            zero_said.append(b"TC=0.000" in talk.cycle(torque_Nm=24.2))
            talk.hear(noise)
        dead_man = int(talk.port.dead_man_cycles)
        assert not any(zero_said[:dead_man])
        if noise:
            assert all(a or b for a, b in itertools.pairwise(zero_said[dead_man:]))
        else:
            assert all(zero_said[dead_man:])
        assert talk.device.m.torque_A == 0.0

    @pytest.mark.parametrize("lost_cycles", range(1, 18))
    def test_its_twin_a_line_that_comes_back_is_used_again(self, talk: Talk, lost_cycles: int) -> None:
        talk.enabled().cycle(torque_Nm=24.2, count=4)
        talk.mute = True
        said = [line for _ in range(lost_cycles) for line in talk.cycle(torque_Nm=24.2)]
        assert (b"TC=0.000" in said) == (lost_cycles > talk.port.dead_man_cycles)
        talk.mute = False
        talk.cycle(torque_Nm=24.2, count=5)
        assert (talk.port.no_sample_cycles, talk.device.m.torque_A) == (0, 2.0)

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

    @settings(max_examples=150, deadline=None)
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

    @settings(max_examples=150, deadline=None)
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


@pytest.mark.parametrize(("late_ms", "counts"), [(0.5, True), (0.52, False), (-0.9, True)])
def test_a_position_that_comes_unusually_late_is_left_out(late_ms: float, counts: bool) -> None:
    """Nobody knows when it was read: 1.9 ms late at 0.83 rad/s it looked like 1.03 rad/s."""
    assert positions_taken([1.0] * 5 + [1.0 + late_ms] + [1.0] * 3) == [True] * 5 + [counts] + [True] * 3


@pytest.mark.parametrize("late", [2, 3])
def test_a_few_late_positions_in_a_row_are_left_out(late: int) -> None:
    """Of two in a row the second was taken: 1.24 rad/s were seen at 0.83."""
    assert positions_taken([1.0] * 5 + [3.0] * late + [1.0] * 2) == [True] * 5 + [False] * late + [True] * 2


def test_many_late_positions_in_a_row_are_the_way_of_the_line() -> None:
    assert positions_taken([1.0] * 5 + [3.0] * 6) == [True] * 5 + [False] * 3 + [True] + [False] * 2
    assert all(positions_taken([1.0] * 5 + [3.0] * 400)[-200:])  # it has become usual
    assert all(positions_taken([1.0, 3.0, 3.0], period_ns=0))
