"""The dialogue of an independent driver with the virtual serial drive, command by command.

Recorded in November 2026 with the Elmo Whistle controller of `bliss` 2.4.0 (PyPI; the motor control of the ESRF) and
its own serial line code at 19200 baud: it switched the virtual drive on, moved it, stopped it in motion, jogged it,
set its position and switched it off, without an error of its own.  It is too heavy to be installed for a test, so what
it says, and what it takes for an answer, is kept here.  Its configuration service and its process database were
replaced by stubs; the controller class and the serial line were its own.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
import serial

from jointctl.hil.elmo.device import ElmoDevice
from jointctl.hil.elmo.interpreter import ElmoDeviceSettings, ElmoInterpreter
from jointctl.hil.plant.joint import plant

COUNTS = 2**19
SERVO_ON, MOVING = 1 << 4, 0x3 << 14
TIMEOUT_S = 20.0


class OtherDriver:
    """Its rules: a reply ends with `;` and begins with the command and CR; `?` at its end asks for EC."""

    def __init__(self, path: str) -> None:
        self.port = serial.Serial(path, 19_200, timeout=5.0)

    def ask(self, command: str) -> str:
        sent = command + "\r"
        self.port.write(sent.encode())
        reply = self.port.read_until(b";").decode()
        assert reply.startswith(sent), reply
        value = reply[len(sent) : -1]
        if value.endswith("?"):
            raise RuntimeError(f"error {self.ask('EC')}")
        return value

    def says(self, *commands: str) -> None:
        """Each is answered by nothing but its echo."""
        for command in commands:
            assert self.ask(command) == "", command

    def state(self) -> int:
        """SR and, as it always does, IP after it."""
        status = int(self.ask("SR"))
        assert int(self.ask("IP")) & 0x1C00 == 0  # no limit switch, no inhibit
        assert status & 1 == 0  # its test for a drive in trouble
        return status

    def position(self) -> float:
        """The encoder while the drive moves, else the target."""
        return float(self.ask("PX" if self.ask("MS") == "2" else "PA"))

    def start(self, target: int) -> None:
        status = int(self.ask("SR"))
        assert status & SERVO_ON
        assert status >> 7 & 7 == 5
        assert self.ask("IP") == "0"
        self.says(f"PA={target}", "BG")


@pytest.fixture
def device() -> Iterator[ElmoDevice]:
    constants, state = plant(encoder_counts_per_turn=COUNTS, initial_position_rad=0.1)
    with ElmoDevice(ElmoInterpreter(ElmoDeviceSettings(), constants, state), 19_200) as running:
        yield running


def test_it_switches_the_drive_on_and_moves_it(device: ElmoDevice) -> None:
    driver = OtherDriver(device.path)
    with driver.port:
        assert driver.ask("VR").startswith("Whistle")
        assert (driver.ask("UM"), driver.ask("MO")) == ("5", "0")
        driver.says("MO=1")
        assert driver.ask("UM") == "5"
        assert driver.state() & (SERVO_ON | MOVING) == SERVO_ON
        start = int(driver.position())
        driver.says("SP=80000", "AC=400000", "DC=400000")
        assert (driver.ask("SP"), driver.ask("AC")) == ("80000", "400000")

        driver.start(start + 20_000)
        seen, give_up_s = [], time.monotonic() + TIMEOUT_S
        while driver.state() & MOVING and time.monotonic() < give_up_s:
            seen.append(driver.position())
        assert seen == sorted(seen)
        assert len(seen) > 3
        assert int(driver.ask("PX")) == pytest.approx(start + 20_000, abs=3)

        driver.start(start)
        while int(driver.ask("PX")) > start + 15_000 and time.monotonic() < give_up_s:
            pass
        driver.says("ST")
        while driver.ask("MS") != "0" and time.monotonic() < give_up_s:
            pass
        stopped = int(driver.ask("PX"))
        driver.says(f"PA={stopped}")  # its way around a target that stays behind after ST
        assert start < stopped < start + 20_000
        assert driver.position() == stopped


def test_it_jogs_sets_the_position_and_switches_off(device: ElmoDevice) -> None:
    driver = OtherDriver(device.path)
    with driver.port:
        driver.says("MO=1", "AC=400000", "DC=400000", "MO=0", "UM=2", "PM=1", "MO=1")
        assert driver.ask("UM") == "2"
        assert float(driver.ask("VL[2]")) < -30_000 < 30_000 < float(driver.ask("VH[2]"))
        driver.says("JV=30000", "BG")
        give_up_s = time.monotonic() + TIMEOUT_S
        while int(driver.ask("VX")) < 25_000 and time.monotonic() < give_up_s:
            pass
        status = driver.state()
        assert (status >> 7 & 7, status & MOVING != 0) == (2, True)
        driver.says("JV=0", "BG")
        while driver.ask("MS") == "2" and time.monotonic() < give_up_s:
            pass
        driver.says("MO=0", "UM=5", "MO=1")
        driver.says(f"PA={int(driver.ask('PX'))}")
        assert (driver.ask("UM"), driver.ask("MO")) == ("5", "1")

        driver.says("MO=0", "PX=1000", "MO=1", "PA=1000")
        assert driver.position() == 1000.0
        with pytest.raises(RuntimeError, match="error 57"):
            driver.ask("UM=9")
        driver.says("MO=0")
        assert driver.ask("MO") == "0"
        assert driver.state() & SERVO_ON == 0
