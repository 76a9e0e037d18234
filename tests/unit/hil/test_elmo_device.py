"""The virtual Elmo drive: what its commands do, its limits, and its line."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from typing import Any

import pytest
import serial

from jointctl.hil.elmo.device import ElmoDevice
from jointctl.hil.elmo.interpreter import ElmoDeviceSettings, ElmoInterpreter
from jointctl.hil.elmo.motor import MF_OVERSPEED, MF_POSITION_LIMIT, MF_SPEED_ERROR
from jointctl.hil.plant.joint import plant

COUNTS = 2**19
PER_RAD = COUNTS / 6.283185307179586


def interpreter(**settings: Any) -> ElmoInterpreter:
    constants, state = plant(encoder_counts_per_turn=COUNTS, **settings)
    return ElmoInterpreter(ElmoDeviceSettings(), constants, state)


@pytest.fixture
def drive() -> ElmoInterpreter:
    """A frictionless joint at rest."""
    return interpreter()


def say(drive: ElmoInterpreter, *lines: str) -> bytes:
    reply = b""
    for line in lines:
        reply = drive.execute(line.encode())
    return reply


def refused(drive: ElmoInterpreter, line: str) -> int:
    reply = drive.execute(line.encode())
    assert reply[1:] == b"?;", (line, reply)
    assert drive.execute(b"EC") == b"%d;" % reply[0]
    return reply[0]


class TestCommands:
    @pytest.mark.parametrize(
        ("line", "code"),
        [
            ("XX", 2), ("px", 19), ("PX[1]", 3), ("CL", 3), ("CL[7]", 3), ("CL[1]=", 19), ("CL[1]=abc", 19),
            ("VR=1", 23), ("SR=1", 23), ("UM=9", 21), ("UM=3", 60), ("MO=2", 21), ("TC=1", 58), ("BG", 58),
            ("CL[1]=0", 21), ("CL[1]=21", 21), ("CL[1]=11", 28), ("PL[1]=4.9", 28), ("AC=0", 21), ("RM=2", 21),
            ("MC=5", 23), ("CA[18]=4", 23), ("EO=2", 21),
        ],
    )  # fmt: skip
    def test_what_is_refused_and_why(self, drive: ElmoInterpreter, line: str, code: int) -> None:
        assert refused(drive, line) == code

    @pytest.mark.parametrize(("line", "code"), [("UM=2", 57), ("RM=1", 57), ("PX=0", 57)])
    def test_some_need_the_motor_off(self, drive: ElmoInterpreter, line: str, code: int) -> None:
        say(drive, "UM=1", "MO=1")
        assert refused(drive, line) == code
        say(drive, "MO=0")
        assert drive.execute(line.encode()) == b";"

    def test_torque_only_in_its_unit_mode_and_up_to_the_peak(self, drive: ElmoInterpreter) -> None:
        say(drive, "UM=2", "MO=1")
        assert refused(drive, "TC=1") == 12
        say(drive, "MO=0", "UM=1", "MO=1", "PL[1]=6")
        assert refused(drive, "TC=6.001") == 28
        assert say(drive, "TC=6") == b";"
        assert say(drive, "TC") == b"6.000;"
        assert say(drive, "ST", "TC") == b"0.000;"

    def test_an_amplifier_that_is_not_ready_does_not_switch_on(self, drive: ElmoInterpreter) -> None:
        drive.amplifier = 3
        assert refused(drive, "MO=1") == 66
        assert int(say(drive, "SR")[:-1]) & 0xF == 3
        drive.amplifier = 0
        assert say(drive, "MO=1", "MO") == b"1;"

    def test_the_status_word(self, drive: ElmoInterpreter) -> None:
        assert say(drive, "UM=1", "SR") == b"%d;" % (1 << 7)
        assert say(drive, "MO=1", "SR") == b"%d;" % (1 << 7 | 1 << 4)

    def test_a_restart_forgets_what_was_set(self, drive: ElmoInterpreter) -> None:
        say(drive, "UM=1", "EO=0", "CL[1]=1", "MO=1")
        drive.restart()
        assert (say(drive, "UM"), say(drive, "MO"), say(drive, "EO"), say(drive, "CL[1]")) == (
            b"5;", b"0;", b"1;", b"5.0000;",
        )  # fmt: skip


class TestMotion:
    def test_torque_accelerates_the_joint(self, drive: ElmoInterpreter) -> None:
        say(drive, "UM=1", "MO=1", "TC=1")
        drive.advance_to(0.1)
        acceleration = float(drive.constants[0].torque_per_current_NmpA * drive.constants[0].inverse_driven_inertia)
        assert int(say(drive, "VX")[:-1]) == pytest.approx(0.1 * acceleration * PER_RAD, rel=0.01)
        assert say(drive, "IQ") == b"1.0000;"

    def test_speed_mode_follows_jog_along_the_ramp(self) -> None:
        drive = interpreter(friction_kind=2)
        say(drive, "UM=2", "AC=100000", "DC=100000", "MO=1", "JV=20000")
        drive.advance_to(0.2)
        assert abs(int(say(drive, "VX")[:-1])) < 10  # not before BG
        say(drive, "BG")
        drive.advance_to(0.3)
        assert 1000 < int(say(drive, "VX")[:-1]) < 12000
        drive.advance_to(1.2)
        assert int(say(drive, "VX")[:-1]) == pytest.approx(20000, abs=300)
        say(drive, "ST")
        drive.advance_to(2.0)
        assert abs(int(say(drive, "VX")[:-1])) < 300

    @pytest.mark.parametrize(("command", "ramp"), [("ST", "SD"), ("JV=0", "DC")])
    def test_st_brakes_along_sd_and_jog_zero_along_dc(self, drive: ElmoInterpreter, command: str, ramp: str) -> None:
        say(drive, "UM=2", "AC=400000", "DC=400000", "SD=400000", f"{ramp}=20000", "MO=1", "JV=20000", "BG")
        drive.advance_to(1.0)
        say(drive, command, "BG" if command == "JV=0" else "SR")
        drive.advance_to(1.5)
        assert int(say(drive, "VX")[:-1]) == pytest.approx(10_000, rel=0.1)
        drive.advance_to(3.0)
        assert abs(int(say(drive, "VX")[:-1])) < 300

    def test_after_st_the_jog_is_kept_and_another_bg_goes_on(self, drive: ElmoInterpreter) -> None:
        say(drive, "UM=2", "MO=1", "JV=20000", "BG")
        drive.advance_to(0.5)
        say(drive, "ST")
        drive.advance_to(1.5)
        assert say(drive, "JV") == b"20000;"
        say(drive, "BG")
        drive.advance_to(2.5)
        assert int(say(drive, "VX")[:-1]) == pytest.approx(20_000, rel=0.05)

    def test_a_jog_goes_on_without_commands_until_the_drives_position_limit(self) -> None:
        drive = interpreter(friction_kind=2)
        say(drive, "HL[3]=40000", "UM=2", "MO=1", "JV=20000", "BG")
        drive.advance_to(1.5)
        assert say(drive, "MO") == b"1;"  # its twin: inside the limit nothing ends it
        assert int(say(drive, "VX")[:-1]) == pytest.approx(20_000, rel=0.05)
        drive.advance_to(4.0)
        assert (say(drive, "MO"), say(drive, "MF")) == (b"0;", b"%d;" % MF_POSITION_LIMIT)
        assert int(say(drive, "PX")[:-1]) == pytest.approx(40_000, rel=0.05)

    def test_position_mode_arrives(self, drive: ElmoInterpreter) -> None:
        say(drive, "MO=1", "SP=50000", "AC=200000", "DC=200000", "PA=20000", "BG")
        drive.advance_to(0.1)
        assert say(drive, "MS") == b"2;"
        drive.advance_to(3.0)
        assert int(say(drive, "PX")[:-1]) == pytest.approx(20000, abs=3)
        assert say(drive, "MS") == b"0;"

    @pytest.mark.parametrize(("time_s", "limited"), [(0.99, False), (1.01, True)])
    def test_above_the_continuous_current_only_for_the_peak_time(self, time_s: float, limited: bool) -> None:
        drive = interpreter(load_torque_Nm=36.3)
        say(drive, "CL[1]=2", "PL[1]=4", "PL[2]=1", "UM=1", "MO=1", "TC=3")
        drive.advance_to(time_s)
        assert float(say(drive, "IQ")[:-1]) == pytest.approx(2.0 if limited else 3.0)
        assert bool(int(say(drive, "SR")[:-1]) & 1 << 13) == limited

    @pytest.mark.parametrize(("speed", "fault"), [(39_000, MF_OVERSPEED), (41_000, 0)])
    def test_overspeed_switches_off(self, drive: ElmoInterpreter, speed: int, fault: int) -> None:
        say(drive, f"HL[2]={speed}", "UM=1", "MO=1", "TC=1")
        drive.state[0].joint_velocity_radps = 40_000 / PER_RAD
        drive.advance_to(2 * 50e-6 + 1e-9)
        assert say(drive, "MF") == b"%d;" % fault
        assert say(drive, "MO") == (b"0;" if fault else b"1;")

    @pytest.mark.parametrize(("end", "fault"), [(9_999, MF_POSITION_LIMIT), (10_001, 0)])
    def test_leaving_the_position_limits_switches_off(self, drive: ElmoInterpreter, end: int, fault: int) -> None:
        say(drive, f"HL[3]={end}", "UM=1", "MO=1")
        drive.state[0].joint_position_rad = 10_000 / PER_RAD
        drive.advance_to(2 * 50e-6 + 1e-9)
        assert say(drive, "MF") == b"%d;" % fault

    def test_a_blocked_joint_trips_the_speed_error_and_mo_clears_it(self) -> None:
        drive = interpreter(load_torque_Nm=400.0, end_stops=True, end_stop_min_rad=-0.001, end_stop_max_rad=0.001)
        say(drive, "ER[2]=5000", "UM=2", "AC=1000000", "DC=1000000", "MO=1", "JV=20000", "BG")
        drive.advance_to(0.3)
        assert say(drive, "MF") == b"%d;" % MF_SPEED_ERROR
        assert int(say(drive, "SR")[:-1]) & 1 << 6
        assert say(drive, "MO=1", "MF") == b"0;"


class Client:
    """Independent of the project's driver: written as a public driver of this drive family talks to it.

    CR ends a command, the reply is read up to `;`, must begin with the echo, and `?` at its end asks for EC.
    """

    def __init__(self, path: str, baud_rate: int) -> None:
        self.port = serial.Serial(path, baud_rate, timeout=5.0)

    def query(self, text: str) -> str:
        sent = f"{text}\r".encode()
        self.port.write(sent)
        reply = self.port.read_until(b";")
        assert reply.startswith(sent), reply
        assert reply.endswith(b";"), reply
        body = reply[len(sent) : -1].decode("latin-1")
        if body.endswith("?"):
            raise RuntimeError(f"error {self.query('EC')}")
        return body


@pytest.fixture
def device() -> Iterator[ElmoDevice]:
    with ElmoDevice(interpreter(initial_position_rad=0.1), 19_200) as running:
        yield running


class TestLine:
    def test_an_independent_client_switches_on_and_moves_the_joint(self, device: ElmoDevice) -> None:
        client = Client(device.path, 19_200)
        with client.port:
            assert "Whistle" in client.query("VR")
            assert client.query("UM") == "5"
            with pytest.raises(RuntimeError, match="error 58"):
                client.query("BG")
            client.query("MO=1")
            start = int(client.query("PX"))
            assert start == round(0.1 * PER_RAD)
            for line in ("SP=80000", "AC=400000", "DC=400000", f"PA={start + 5000}", "BG"):
                assert client.query(line) == ""
            assert int(client.query("SR")) & 0x3 << 14
            give_up = time.monotonic() + 20.0
            while client.query("MS") == "2" and time.monotonic() < give_up:
                pass
            assert int(client.query("PX")) == pytest.approx(start + 5000, abs=3)
            for line in ("MO=0", "UM=2", "PM=1", "MO=1", "JV=10000", "BG"):
                client.query(line)
            assert int(client.query("SR")) >> 7 & 7 == 2
            while int(client.query("VX")) < 5000 and time.monotonic() < give_up:
                pass
            assert int(client.query("VX")) >= 5000
            for line in ("JV=0", "BG", "MO=0"):
                client.query(line)
            assert client.query("MO") == "0"

    def test_a_character_takes_its_time(self, device: ElmoDevice) -> None:
        client = Client(device.path, 19_200)
        with client.port:
            started = time.monotonic()
            for _ in range(5):
                client.query("VR")
            # VR, CR out, 29 characters and ; back: a lower bound, which a busy computer cannot break
            assert time.monotonic() - started >= 5 * (3 + 29) * 10 / 19_200

    def test_semicolon_ends_a_command_as_well_and_echo_can_be_off(self, device: ElmoDevice) -> None:
        with serial.Serial(device.path, 19_200, timeout=5.0) as port:
            port.write(b"EO=0\r")
            assert port.read_until(b";") == b"EO=0\r;"
            port.write(b"UM;MO;")
            assert port.read_until(b";") + port.read_until(b";") == b"5;0;"

    def test_another_baud_rate_is_garbage_both_ways(self, device: ElmoDevice) -> None:
        with serial.Serial(device.path, 9600, timeout=0.2) as port:
            port.write(b"MO=1\r")
            assert b"MO=1" not in port.read(20)
            assert device.interpreter.m.motor_on == 0

    def test_a_vanished_port_leaves_the_drive_going(self, device: ElmoDevice) -> None:
        fd = os.open(device.path, os.O_RDWR | os.O_NOCTTY)
        device.vanish()
        give_up = time.monotonic() + 5.0
        gone = False
        while not gone and time.monotonic() < give_up:  # the thread may still wait on its end for a moment
            try:
                os.write(fd, b"PX\r")
                time.sleep(0.001)
            except OSError:
                gone = True
        os.close(fd)
        assert gone
        before = float(device.interpreter.state[0].time_s)
        give_up = time.monotonic() + 5.0
        while device.interpreter.state[0].time_s <= before and time.monotonic() < give_up:
            time.sleep(0.005)
        assert device.interpreter.state[0].time_s > before
