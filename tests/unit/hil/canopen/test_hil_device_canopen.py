"""The virtual drive seen by the `canopen` library, and in real time on a socket."""

from __future__ import annotations

import logging
import socket
import struct
from typing import Any

import canopen
import pytest

from jointctl.hil.canopen.device import Cia402Device, DeviceSettings
from jointctl.hil.device_loop import SEND_ERRORS_WORD
from jointctl.hil.plant.joint import plant
from jointctl.hil.realtime_device import RealtimeDevice
from tests.places import EDS
from tests.virtual_drive import NODE, Network


@pytest.fixture
def node() -> Any:
    network = Network(Cia402Device(EDS, DeviceSettings(node_id=NODE, serial_number=77), *plant()))
    remote = network.add_node(NODE, str(EDS))
    remote.sdo.RESPONSE_TIMEOUT = 0.5
    network.run(1)
    return remote


def test_eds_loads_without_a_word(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "canopen"):
        canopen.import_od(str(EDS), node_id=NODE)
    assert [r for r in caplog.records if r.levelno >= logging.INFO] == []


def test_strings_and_settings_are_there(node: Any) -> None:
    assert node.sdo[0x1008].raw == "jointctl virtual joint"
    assert node.sdo[0x1018][4].raw == 77
    assert node.sdo[0x608F][1].raw == 2**19
    node.sdo[0x2100].raw = "elbow of the left arm"
    assert node.sdo[0x2100].raw == "elbow of the left arm"


def test_remap_sync_and_torque_through_pdos(node: Any) -> None:
    network = node.network
    node.tpdo.read()
    node.rpdo.read()
    node.tpdo[1].clear()
    for index in (0x6041, 0x6064, 0x6077):
        node.tpdo[1].add_variable(index)
    node.tpdo[1].trans_type = 1
    node.tpdo[1].enabled = True
    node.rpdo[1].clear()
    for index in (0x6040, 0x6071):
        node.rpdo[1].add_variable(index)
    node.rpdo[1].trans_type = 1
    node.rpdo[1].enabled = True
    node.tpdo.save()
    node.rpdo.save()
    node.sdo[0x6060].raw = 10
    node.nmt.state = "OPERATIONAL"
    for word in (0x06, 0x07, 0x0F, 0x0F):
        node.rpdo[1][0].raw = word
        node.rpdo[1][1].raw = 50 if word == 0x0F else 0
        node.rpdo[1].transmit()
        network.sync.transmit()
        network.run(1)
    network.run(100)
    network.sync.transmit()
    assert node.tpdo[1][0].raw & 0x6F == 0x27
    assert node.tpdo[1][1].raw > 100
    assert node.tpdo[1][2].raw == 50


@pytest.mark.parametrize("alive", [True, False])
def test_heartbeat_loss_is_an_emergency_and_stops_the_joint(node: Any, alive: bool) -> None:
    network = node.network
    node.sdo[0x1016][1].raw = 0x7F << 16 | 20
    node.sdo[0x1029][1].raw = 2
    node.sdo[0x6007].raw = 3
    node.sdo[0x6060].raw = 9
    node.nmt.state = "OPERATIONAL"
    for word in (0x06, 0x07, 0x0F):
        node.sdo[0x6040].raw = word
    node.sdo[0x60FF].raw = 50_000
    network.send_message(0x77F, b"\x05")
    for _ in range(100):
        network.run(10)
        if alive:
            network.send_message(0x77F, b"\x05")
    assert [error.code for error in node.emcy.log] == ([] if alive else [0x8130])
    speed_radps = network.device.plant_state[0].joint_velocity_radps
    assert bool(abs(speed_radps) > 0.5) is alive
    assert network.device.device[0].nmt == (5 if alive else 4)


def test_real_time_device_boots_answers_and_stops() -> None:
    device = Cia402Device(
        EDS, DeviceSettings(node_id=NODE), *plant(step_s=1e-3)
    )  # coarse: keeps up without the JIT too
    ours, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.settimeout(10.0)

    def frame(identifier: int, data: bytes) -> bytes:
        return struct.pack("<IB3x8s", identifier, len(data), data)

    with ours, its, RealtimeDevice(device, its.fileno()) as running:
        assert ours.recv(16) == frame(0x705, b"\x00")
        for word, status in ((6, 0x21), (7, 0x23), (15, 0x27)):
            ours.send(frame(0x605, struct.pack("<BHBI", 0x2B, 0x6040, 0, word)))
            assert ours.recv(16) == frame(0x585, struct.pack("<BHB4x", 0x60, 0x6040, 0))
            ours.send(frame(0x605, struct.pack("<BHB4x", 0x40, 0x6041, 0)))
            answer = ours.recv(16)
            assert struct.unpack_from("<H", answer, 12)[0] & 0x6F == status
        ours.send(frame(0, b"\x01\x05"))
        identifier, size = struct.unpack_from("<IB", ours.recv(16))
        assert (identifier, size) == (0x185, 2)
        ours.send(frame(0, b"\x81\x05"))
        assert ours.recv(16) == frame(0x705, b"\x00")
    assert running.words[SEND_ERRORS_WORD] == 0
