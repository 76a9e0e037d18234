"""A virtual joint in real time on a virtual bus of its own, for masters that others wrote."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import canopen
import pytest

from jointctl.drivers.can.open import open_cyclic_end
from jointctl.hil.canopen.device import Cia402Device, DeviceSettings
from jointctl.hil.plant import plant
from jointctl.hil.realtime_device import RealtimeDevice
from jointctl.hil.virtual_bus import VirtualBusHub
from tests.hil.bench import client
from tests.hil.conftest import bench as bench
from tests.places import EDS

NODE = 5


@dataclass
class Joint:
    """The device, and the socket path that names its bus for python-can (`interface="jointctl"`)."""

    device: Cia402Device
    channel: str
    eds: Path = EDS
    node_id: int = NODE

    def network(self) -> canopen.Network:
        return client(self.channel)

    @property
    def status(self) -> int:
        return self.device.objects.value(0x6041, 0)


@pytest.fixture
def joint(tmp_path: Path) -> Iterator[Joint]:
    """A drive with an ideal plant, just booted."""
    path = tmp_path / "bus.sock"
    device = Cia402Device(EDS, DeviceSettings(node_id=NODE), *plant(step_s=2e-4))
    with VirtualBusHub(path), open_cyclic_end("jointctl", str(path)) as end, RealtimeDevice(device, end.fileno()):
        yield Joint(device, str(path))
