"""The cyclic exchange and the virtual drive's interpreter, with a line of memory between them."""

from __future__ import annotations

import math
from typing import Any

from jointctl.drivers.elmo.cyclic import ElmoPort, begin_cycle, end_cycle, take_byte
from jointctl.firmware_py.records import Command, Sample
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import DriveRequest, DriveState
from jointctl.hil.elmo.interpreter import ElmoDeviceSettings, ElmoInterpreter
from jointctl.hil.plant.joint import plant

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
