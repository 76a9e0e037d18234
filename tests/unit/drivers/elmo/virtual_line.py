"""The virtual drive's interpreter behind a port in memory, or behind the cyclic exchange and a line of its own."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

from jointctl.drivers.elmo.cyclic import ElmoPort, begin_cycle, end_cycle, take_byte
from jointctl.drivers.elmo.drive import ElmoDrive
from jointctl.drivers.elmo.settings import ElmoSettings
from jointctl.drivers.errors import JointctlError
from jointctl.firmware_py.records import Command, Sample
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import DriveRequest, DriveState
from jointctl.hil.elmo_drive import ElmoDeviceSettings, ElmoInterpreter
from jointctl.hil.plant import plant

# --- The virtual drive's interpreter behind a port that is memory, with a time of its own ---
COUNTS = 2**19
SETTINGS = ElmoSettings(
    port="memory", baud_rate_bitps=115_200, echo=True, reply_timeout_s=0.1, rate_Hz=150.0, torque_max_Nm=60.0,
    torque_constant_NmpA=0.1, torque_direction=1, reduction_ratio=121.0, counts_per_turn=COUNTS,
    encoder_on_motor=False, encoder_direction=1, zero_counts=0, continuous_current_A=5.0, peak_current_A=6.0,
    peak_time_s=2.0, velocity_max_radps=1.0, position_min_rad=-0.7, position_max_rad=0.7, limit_margin=0.2,
    speed_error_radps=1.0, position_error_rad=0.2, dead_man_s=0.04, ramp_radps2=8.0,
)  # fmt: skip


class MemoryPort:
    """The virtual drive's interpreter behind a port whose clock only moves when somebody waits."""

    def __init__(self, **settings: Any) -> None:
        constants, state = plant(encoder_counts_per_turn=COUNTS, initial_position_rad=0.1)
        self.device = ElmoInterpreter(ElmoDeviceSettings(**settings), constants, state)
        self.now_s = 0.0
        self.character_s = 10 / 115_200
        self.answer: Callable[[bytes, bytes], bytes] = lambda line, reply: reply
        self.commands: list[bytes] = []
        self.failure: JointctlError | None = None
        self.closed = False
        self._line = b""
        self._waiting = b""

    def write(self, data: bytes) -> None:
        if self.failure is not None:
            raise self.failure
        self._line += data
        *lines, self._line = self._line.split(b"\r")
        for line in lines:
            self.commands.append(line)
            echo = line + b"\r" if self.device.echo else b""
            reply = self.answer(line, echo + self.device.execute(line))
            self.now_s += (len(line) + 1 + len(reply)) * self.character_s
            self._waiting += reply

    def read(self, timeout_s: float) -> bytes:
        if self.failure is not None:
            raise self.failure
        data, self._waiting = self._waiting, b""
        if not data:
            self.now_s += max(timeout_s, 1e-3)
        return data

    def discard(self) -> None:
        self._waiting = b""

    def close(self) -> None:
        self.closed = True

    def drive(self, **changes: Any) -> ElmoDrive:
        settings = dataclasses.replace(SETTINGS, **changes)
        return ElmoDrive(settings, open_port=lambda path, baud: self, clock=lambda: self.now_s)

    def commissioned(self, **changes: Any) -> ElmoDrive:
        drive = self.drive(**changes)
        drive.commission()
        return drive


# --- The cyclic exchange and the virtual drive's interpreter, with a line of memory between them ---
PERIOD_S = 1.0 / 150.0
PER_RAD = 2**19 / math.tau
RAMP_CPS2 = round(8.0 * PER_RAD)


class Talk:
    """A port in torque or speed mode, the virtual drive at its other end; `spoil` may change what comes back."""

    def __init__(self, echo: bool = True, *, speed: bool = False) -> None:
        constants, state = plant(initial_position_rad=0.1, encoder_counts_per_turn=2**19)
        self.device = ElmoInterpreter(ElmoDeviceSettings(), constants, state)
        for line in (b"UM=2", b"AC=%d" % RAMP_CPS2, b"DC=%d" % RAMP_CPS2) if speed else (b"UM=1",):
            assert self.device.execute(line) == b";"
        self.port = new(ElmoPort)[0]
        self.sample, self.command = new(Sample)[0], new(Command)[0]
        port = self.port
        port.echo, port.torque_NmpA, port.max_current_mA = int(echo), 12.1, 5000
        port.position_radpcount, port.zero_counts = math.tau / 2**19, 0
        port.target_is_velocity, port.max_velocity_cps = int(speed), 80_000
        port.enable_retry_cycles, port.dead_man_cycles = 75, 6
        self.said: list[bytes] = []
        self.mute = False
        self.spoil: Any = lambda reply: reply
        self.cycle_number = 0

    def _exchange(self) -> None:
        out = bytes(self.port.out[: self.port.out_length])
        self.port.out_length = 0
        lines = out.split(b"\r")[:-1]
        self.said += lines
        for line in lines:
            reply = (line + b"\r" if self.port.echo else b"") + self.device.execute(line)
            self.hear(b"" if self.mute else self.spoil(reply))

    def hear(self, data: bytes) -> bool:
        got = False
        for byte in data:
            got = bool(take_byte(self.port, byte, self.sample, 1)) or got
        return got

    def cycle(
        self,
        request: DriveRequest = DriveRequest.ENABLE,
        torque_Nm: float = 0.0,
        count: int = 1,
        velocity_radps: float = 0.0,
    ) -> list[bytes]:
        """Whole cycles; returns what was said in the last one."""
        for _ in range(count):
            self.said = []
            self.command.request, self.command.torque_Nm = request, torque_Nm
            self.command.velocity_radps = velocity_radps
            begin_cycle(self.port, self.sample)
            self._exchange()
            end_cycle(self.port, self.sample, self.command)
            self._exchange()
            self.cycle_number += 1
            self.device.advance_to(self.cycle_number * PERIOD_S)
        return self.said

    def enabled(self) -> Talk:
        self.cycle(DriveRequest.OFF, count=4)
        self.cycle(count=4)
        assert self.sample.drive_state == DriveState.ENABLED
        return self
