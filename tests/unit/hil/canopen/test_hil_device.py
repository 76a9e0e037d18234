"""The virtual drive, frame by frame, with injected time: NMT, PDO, timers, faults."""

from __future__ import annotations

import logging
import socket
import struct
from typing import Any

import canopen
import pytest

from jointctl.hil.canopen.device import DeviceSettings
from jointctl.hil.realtime_device import SEND_ERRORS_WORD, RealtimeDevice
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.virtual_joint import new_device
from tests.places import EDS
from tests.virtual_drive import NODE, Network, Rig, frame, network_node, virtual_drive


# --- The virtual drive, frame by frame, with injected time: NMT, PDO, timers, faults ---
def test_boot_up_then_heartbeat_tells_the_nmt_state(rig: Rig) -> None:
    assert rig.sent == [(0x705, b"\x00")]
    rig.set(0x1017, 0, 10, 2)
    assert [d for i, d in rig.run(30) if i == 0x705] == [b"\x7f"] * 3
    rig.send(0, b"\x01\x00")
    assert (0x705, b"\x05") in rig.run(11)
    rig.send(0, b"\x02\x05")
    assert (0x705, b"\x04") in rig.run(11)
    assert rig.send(0x605, bytes.fromhex("4018100100000000")) == []  # no SDO while stopped
    rig.send(0, b"\x80\x06")  # another node
    assert rig.device.device[0].nmt == 4


def test_reset_restores_the_defaults_and_boots_again(rig: Rig) -> None:
    rig.set(0x1017, 0, 10, 2)
    rig.set(0x6072, 0, 55, 2)
    rig.send(0, bytes([0x82, NODE]))
    rig.run(1)
    assert (rig.get(0x1017), rig.get(0x6072)) == (0, 55)
    rig.enable(10)
    rig.send(0, bytes([0x81, NODE]))
    rig.run(1)
    assert rig.get(0x6072) == 1000
    assert rig.get(0x6041) & 0x4F == 0x40
    assert rig.sent.count((0x705, b"\x00")) == 3


def test_injected_fault_latches_until_the_cause_is_gone_and_bit_7_rises(rig: Rig) -> None:
    rig.enable(10)
    rig.device.device[0].inject_fault_code = 0x2340
    rig.run(10)
    assert rig.emergencies() == [0x2340]
    assert (rig.get(0x603F), rig.get(0x1001), rig.get(0x1003, 1)) == (0x2340, 0x03, 0x2340)
    rig.control(0x00, 0x80)
    assert rig.get(0x6041) & 0x4F == 0x08
    rig.device.device[0].inject_fault_code = 0
    rig.control(0x80)
    assert rig.get(0x6041) & 0x4F == 0x08  # no edge
    rig.control(0x00, 0x80)
    assert rig.get(0x6041) & 0x4F == 0x40
    assert rig.emergencies() == [0x2340, 0x0000]
    assert rig.get(0x1001) == 0


@pytest.mark.parametrize(("limit", "tripped"), [(999, True), (1000, False), (1001, False)])
def test_software_position_limit(limit: int, tripped: bool) -> None:
    rig = Rig(encoder_offset_counts=1000)
    rig.run(5)
    assert rig.emergencies() == []  # both limits 0: off
    rig.set(0x607D, 1, -5000, 4)
    rig.set(0x607D, 2, limit, 4)
    rig.run(5)
    assert rig.emergencies() == ([0x8680] if tripped else [])


@pytest.mark.parametrize(("window", "tripped"), [(300, True), (0xFFFFFFFF, False)])
def test_following_error(rig: Rig, window: int, tripped: bool) -> None:
    rig.set(0x6065, 0, window, 4)
    rig.set(0x6066, 0, 5, 2)
    rig.set(0x6072, 0, 10, 2)  # too weak to follow
    rig.enable(8)
    rig.set(0x607A, 0, 3000, 4)
    rig.run(30)
    assert (0x8611 in rig.emergencies()) is tripped


@pytest.mark.trips("drive: the loop", "rig.run(1)")
@pytest.mark.parametrize("option", [0, 1, 2, 3])
def test_heartbeat_loss_reacts_as_6007_says(rig: Rig, option: int) -> None:
    rig.set(0x1016, 1, 0x7F << 16 | 50, 4)
    rig.set(0x6007, 0, option, 2)
    rig.operational()
    rig.enable(10)
    rig.run(100)
    assert rig.emergencies() == []  # not watched before it was heard
    rig.send(0x77F, b"\x05")
    rig.run(49)
    assert rig.emergencies() == []
    rig.run(1)
    assert rig.emergencies() == [0x8130]
    rig.run(20)
    assert rig.device.device[0].nmt == 127  # 1029 = 0
    assert rig.get(0x6041) & 0x4F == {0: 0x07, 1: 0x08, 2: 0x40, 3: 0x40}[option]
    rig.send(0x77F, b"\x05")
    assert rig.emergencies() == [0x8130] if option == 1 else [0x8130, 0]


@pytest.mark.stays("drive: the loop", "rig.run(49)")
def test_heartbeat_that_keeps_coming_changes_nothing(rig: Rig) -> None:
    rig.set(0x1016, 1, 0x7F << 16 | 50, 4)
    rig.operational()
    rig.enable(10)
    for _ in range(10):
        rig.send(0x77F, b"\x05")
        rig.run(49)
    assert rig.emergencies() == []
    assert rig.get(0x6041) & 0x6F == 0x27


@pytest.mark.parametrize(("silence_ms", "tripped"), [(19, False), (20, True)])
@pytest.mark.parametrize(
    ("place", "identifier", "data", "code"),
    [((0x1400, 5), 0x205, b"\x06\x00", 0x8250), ((0x2102, 0), 0x80, b"", 0x8700)],
    ids=["RPDO", "SYNC"],
)
def test_what_stays_away_too_long_is_reported(
    rig: Rig, place: tuple[int, int], identifier: int, data: bytes, code: int, silence_ms: int, tripped: bool
) -> None:
    rig.set(*place, 20, 2)
    rig.operational()
    rig.run(50)
    rig.send(identifier, data)
    rig.run(silence_ms)
    assert rig.emergencies() == ([code] if tripped else [])


def test_the_motors_temperature_in_tenths_of_a_degree(rig: Rig) -> None:
    assert rig.get(0x2103) == 250
    rig.device.plant_state[0].motor_temperature_degC = -12.34
    rig.run(1)
    assert rig.get(0x2103) == -123
    assert rig.write(0x2103, 0, 0, 2) == 0x06010002


def test_synchronous_pdos(rig: Rig) -> None:
    """Type 2: every second SYNC; a synchronous RPDO waits for the SYNC, which reports the state before it."""
    rig.set(0x1801, 1, 0x285, 4)
    rig.set(0x1801, 2, 2, 1)
    rig.set(0x1400, 2, 0, 1)
    rig.operational()
    rig.send(0x205, b"\x06\x00")
    assert rig.get(0x6040) == 0
    assert [i for i, _ in rig.send(0x80, b"") if i == 0x285] == []
    assert rig.get(0x6040) == 6
    got = [d for i, d in rig.send(0x80, b"") if i == 0x285]
    assert len(got) == 1
    status, position, torque = struct.unpack("<Hih", got[0])
    assert (status & 0x6F, position, torque) == (0x21, 0, 0)


def test_event_driven_tpdo_inhibit_and_event_timer(rig: Rig) -> None:
    rig.set(0x1800, 1, 0xC0000185, 4)
    rig.set(0x1800, 3, 100, 2)  # 10 ms
    rig.set(0x1800, 5, 40, 2)
    rig.set(0x1800, 1, 0x40000185, 4)
    rig.operational()
    assert [i for i, _ in rig.sent].count(0x185) == 1
    rig.send(0x205, b"\x06\x00")
    assert [i for i, _ in rig.sent].count(0x185) == 1  # inhibited
    rig.run(9)
    assert [i for i, _ in rig.sent].count(0x185) == 1
    rig.run(1)
    assert [i for i, _ in rig.sent].count(0x185) == 2
    assert [i for i, _ in rig.run(80)].count(0x185) == 2


def test_the_same_frames_give_the_same_bits() -> None:
    def history() -> tuple[bytes, list[tuple[int, bytes]]]:
        rig = Rig(encoder_noise_counts=2.0)
        rig.operational()
        rig.enable(9)
        rig.set(0x60FF, 0, 20_000, 4)
        rig.run(50)
        return rig.device.plant_state.tobytes(), rig.sent

    assert history() == history()


def test_settings_out_of_range_are_named() -> None:
    with pytest.raises(ValueError, match=r"node_id \(=128\) must be in \[1\.\.127\]"):
        DeviceSettings(node_id=128)


# --- The virtual drive seen by the `canopen` library, and in real time on a socket ---
@pytest.fixture
def node() -> Any:
    return network_node(Network(virtual_drive(DeviceSettings(node_id=NODE, serial_number=77))), 0.5)


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


def test_real_time_device_boots_answers_and_stops() -> None:
    device = virtual_drive(step_s=1e-3)  # coarse: keeps up without the JIT too
    ours, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.settimeout(10.0)
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


@pytest.mark.parametrize("name", ["virtual", "realistic", "arm/wrist"])
def test_its_ramps_are_the_same_at_the_joint_whatever_encoder_the_drive_counts(name: str) -> None:
    """6085 of the soft joints, whose drives count the motor's encoder, was 0.8 rad/s2 at the joint."""
    device = new_device(load_config(shipped_config(name)))
    drive = device.device[0].drive
    counts_prad = abs(float(device.device[0].counts_per_rad))
    assert int(drive.quick_stop_deceleration) / counts_prad == pytest.approx(11.98, abs=0.01)
    assert int(drive.profile_deceleration) / counts_prad == pytest.approx(4.79, abs=0.01)
