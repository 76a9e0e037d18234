"""The virtual drive's interpreter behind a port that is memory, with a time of its own."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from jointctl.drivers.elmo.drive import ElmoDrive
from jointctl.drivers.elmo.settings import ElmoSettings
from jointctl.drivers.errors import JointctlError
from jointctl.hil.elmo.interpreter import ElmoDeviceSettings, ElmoInterpreter
from jointctl.hil.plant.joint import plant

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
