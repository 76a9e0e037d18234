"""The virtual drive at injected time, for tests: asked frame by frame, or as a network of the `canopen` library."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import canopen

from jointctl.hil.canopen.device import Cia402Device, DeviceSettings
from jointctl.hil.plant import plant
from tests.places import EDS

NODE = 5
MS = 1_000_000
REMOTE = 0x40000000
_FRAME = struct.Struct("<IB3x8s")


def virtual_drive(device_settings: DeviceSettings | None = None, **settings: Any) -> Cia402Device:
    """The drive of the shipped EDS, with settings of the plant."""
    return Cia402Device(EDS, device_settings or DeviceSettings(node_id=NODE), *plant(**settings))


def frame(identifier: int, data: bytes) -> bytes:
    """A `struct can_frame`."""
    return _FRAME.pack(identifier, len(data), data)


class Rig:
    """A device and a clock; `send` and `run` collect what it sends."""

    def __init__(
        self, device_settings: DeviceSettings | None = None, *, device: Cia402Device | None = None, **settings: Any
    ) -> None:
        self.device = device or virtual_drive(device_settings, **settings)
        self.now_ns = 1000 * MS
        self.sent: list[tuple[int, bytes]] = []
        self._collect(self.device.advance(self.now_ns))

    def _collect(self, frames: list[bytes]) -> list[tuple[int, bytes]]:
        got = []
        for identifier, size, data in map(_FRAME.unpack, frames):
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
        return self._collect(self.device.handle(frame(identifier, data), self.now_ns))

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
    """A network whose only other member is the device, at injected time; `lose` may swallow frames of either way."""

    def __init__(
        self, device: Cia402Device, lose: Callable[[int, bytes], bool] = lambda identifier, data: False
    ) -> None:
        super().__init__()
        self.device, self.lose = device, lose
        self.now_ns = 1_000_000

    def _notify(self, frames: list[bytes]) -> None:
        for identifier, size, data in map(_FRAME.unpack, frames):
            if not self.lose(identifier, data):
                self.notify(identifier, bytearray(data[:size]), self.now_ns * 1e-9)

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:
        if not self.lose(can_id, bytes(data)):
            self._notify(self.device.handle(frame(can_id | (REMOTE if remote else 0), bytes(data)), self.now_ns))

    def run(self, ms: int) -> None:
        for _ in range(ms):
            self.now_ns += 1_000_000
            self._notify(self.device.advance(self.now_ns))


def network_node(network: Network, timeout_s: float) -> Any:
    """The device as a node of the library, booted."""
    remote = network.add_node(NODE, str(EDS))
    remote.sdo.RESPONSE_TIMEOUT = timeout_s
    network.run(1)
    return remote
