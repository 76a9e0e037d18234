"""The virtual drive at injected time, for tests: asked frame by frame, or as a network of the `canopen` library."""

from __future__ import annotations

import struct
from typing import Any

import canopen

from jointctl.hil.canopen.device import Cia402Device, DeviceSettings
from jointctl.hil.plant import plant
from tests.places import EDS

NODE = 5
MS = 1_000_000
REMOTE = 0x40000000


class Rig:
    """A device and a clock; `send` and `run` collect what it sends."""

    def __init__(self, device_settings: DeviceSettings | None = None, **settings: Any) -> None:
        self.device = Cia402Device(EDS, device_settings or DeviceSettings(node_id=NODE), *plant(**settings))
        self.now_ns = 1000 * MS
        self.sent: list[tuple[int, bytes]] = []
        self._collect(self.device.advance(self.now_ns))

    def _collect(self, frames: list[bytes]) -> list[tuple[int, bytes]]:
        got = []
        for frame in frames:
            identifier, size, data = struct.unpack("<IB3x8s", frame)
            got.append((identifier, data[:size]))
        self.sent += got
        return got

    def run(self, ms: int, keep_alive: int | None = None) -> list[tuple[int, bytes]]:
        got = []
        for _ in range(ms):
            self.now_ns += MS
            got += self._collect(self.device.advance(self.now_ns))
            if keep_alive is not None:
                got += self.send(0x700 + keep_alive, b"\x05")
        return got

    def send(self, identifier: int, data: bytes) -> list[tuple[int, bytes]]:
        frame = struct.pack("<IB3x8s", identifier, len(data), data)
        return self._collect(self.device.handle(frame, self.now_ns))

    def write(self, index: int, sub: int, value: int, size: int) -> int:
        """SDO download; the abort code, 0 = accepted."""
        command = 0x23 | (4 - size) << 2
        data = (value & (1 << 8 * size) - 1).to_bytes(4, "little")
        answer = [d for i, d in self.send(0x600 + NODE, struct.pack("<BHB", command, index, sub) + data) if i > 0x580]
        return struct.unpack("<I", answer[0][4:])[0] if answer[0][0] == 0x80 else 0

    def set(self, index: int, sub: int, value: int, size: int) -> None:
        assert self.write(index, sub, value, size) == 0

    def get(self, index: int, sub: int = 0) -> int:
        return self.device.objects.value(index, sub)

    def state(self) -> int:
        return int(self.device.device[0].state)

    def control(self, *words: int) -> None:
        for word in words:
            self.set(0x6040, 0, word, 2)
        self.run(1)

    def enable(self, mode: int) -> None:
        self.set(0x6060, 0, mode, 1)
        self.control(0x06, 0x07, 0x0F)
        assert self.get(0x6041) & 0x6F == 0x27

    def operational(self) -> None:
        self.send(0, bytes([1, NODE]))

    def emergencies(self) -> list[int]:
        return [struct.unpack_from("<H", d)[0] for i, d in self.sent if i == 0x80 + NODE]

    @property
    def speed_radps(self) -> float:
        return float(self.device.plant_state[0].joint_velocity_radps)


class Network(canopen.Network):
    """A network whose only other member is the device, at injected time."""

    def __init__(self, device: Cia402Device) -> None:
        super().__init__()
        self.device = device
        self.now_ns = 1_000_000

    def _notify(self, frames: list[bytes]) -> None:
        for frame in frames:
            identifier, size, data = struct.unpack("<IB3x8s", frame)
            self.notify(identifier, bytearray(data[:size]), self.now_ns * 1e-9)

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:
        word = can_id | (REMOTE if remote else 0)
        frame = struct.pack("<IB3x8s", word, len(data), bytes(data))
        self._notify(self.device.handle(frame, self.now_ns))

    def run(self, ms: int) -> None:
        for _ in range(ms):
            self.now_ns += 1_000_000
            self._notify(self.device.advance(self.now_ns))
