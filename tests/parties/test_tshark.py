"""Wireshark's CANopen dissector reads the traffic of the virtual joint and finds no malformed frame.

A session that uses every service (NMT, boot-up, heartbeat, node guarding, SYNC, PDO, EMCY, SDO in all its transfers,
aborts) is recorded on the bus, written in candump's text format and read by tshark.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

import can
import canopen
import pytest

from jointctl.tools.recording.ros_messages import frame_array
from jointctl.tools.recording.run_log_reader import candump_lines


def lines(messages: list[can.Message]) -> str:
    """The messages as `jointctl log export` writes those of a log."""
    return "".join(candump_lines(frame_array([(round(m.timestamp * 1e9), m) for m in messages]), 0, "can0"))


def use_every_service(joint: Any, network: canopen.Network) -> None:
    node = network.add_node(joint.node_id, str(joint.eds))
    node.sdo[0x1017].raw = 20
    node.sdo[0x1017].raw = 0
    node.nmt.start_node_guarding(0.01)
    for command in ("OPERATIONAL", "STOPPED", "PRE-OPERATIONAL", "OPERATIONAL"):
        node.nmt.state = command
        time.sleep(0.03)
    node.nmt.stop_node_guarding()
    node.tpdo.read()
    node.tpdo[2].enabled = True
    node.tpdo[2].save()
    node.rpdo.read()
    node.sdo[0x6060].raw = 3
    for word in (0x06, 0x07, 0x0F):
        node.rpdo[1][0].raw = word
        node.rpdo[1].transmit()
        network.sync.transmit()
        time.sleep(0.01)
    for block in (False, True):
        text = b"elbow, " * 20
        with node.sdo.open(0x2100, 0, "wb", size=len(text), block_transfer=block) as stream:
            stream.write(text)
        with node.sdo.open(0x2100, 0, "rb", block_transfer=block) as stream:
            assert stream.read() == text
    for index, data in ((0x6041, b"\0\0"), (0x2345, b"\0"), (0x6060, b"\2"), (0x1010, b"\0")):
        with pytest.raises(canopen.SdoAbortedError):
            node.sdo.download(index, 0, data)
    joint.device.device[0].inject_fault_code = 0x2340
    assert node.emcy.wait(0x2340, 2.0).code == 0x2340
    joint.device.device[0].inject_fault_code = 0
    node.sdo[0x6040].raw = 0x80
    node.nmt.send_command(0x81)
    time.sleep(0.05)


def dissect(path: Path) -> list[dict[str, str]]:
    """One row per frame: its number, what CANopen calls it, malformed and expert texts."""
    fields = ("frame.number", "_ws.col.Info", "_ws.malformed", "_ws.expert.message")
    command = ["tshark", "-r", str(path), "-d", "can.subdissector,canopen", "-T", "json", "-e", fields[0]]
    for field in fields[1:]:
        command += ["-e", field]
    told = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    packets = json.loads(told.stdout)
    return [
        {name: values[0] for name, values in packet["_source"]["layers"].items()}  # the first of each
        for packet in packets
    ]


@pytest.mark.skipif(shutil.which("tshark") is None, reason="tshark is not installed")
def test_no_frame_is_malformed(joint: Any, tmp_path: Path) -> None:
    messages: list[can.Message] = []
    with can.Bus(interface="jointctl", channel=joint.channel) as recorder:
        network = joint.network()
        use_every_service(joint, network)
        network.disconnect()
        while (message := recorder.recv(0.2)) is not None:
            messages.append(message)
    path = tmp_path / "session.log"
    path.write_text(lines(messages))
    packets = dissect(path)
    assert len(packets) == len(messages) > 150
    for packet, message in zip(packets, messages, strict=True):
        if message.is_remote_frame:  # node guarding: Wireshark leaves remote frames to its CAN dissector
            assert message.arbitration_id == 0x700 + joint.node_id
        else:
            assert not packet["_ws.col.Info"].startswith("ID:"), (packet, message)  # CANopen has a name for it
        assert "_ws.malformed" not in packet, (packet, message)
        assert "_ws.expert.message" not in packet, (packet, message)
    told = " ".join(packet.get("_ws.col.Info", "") for packet in packets)
    for service in ("NMT", "SYNC", "EMCY", "PDO1 (tx)", "PDO1 (rx)", "PDO2 (tx)", "Default-SDO", "Boot-up"):
        assert service.lower() in told.lower(), (service, told[:3000])


@pytest.mark.skipif(shutil.which("tshark") is None, reason="tshark is not installed")
def test_no_frame_of_a_real_run_is_malformed(bench: Any) -> None:
    """`run` on the joint of another process: its log, exported as docs/virtual-joint.md says, and read by tshark."""
    config = bench.with_joint(trajectory__duration_s=1.0, log__frames=True)
    assert bench.run("run", config, "-y").code == 0
    (log,) = bench.folder.glob("runs/*.mcap")
    exported = bench.run("log", "export", str(log), "--format", "candump", "-o", "run.log")
    assert exported.code == 0, exported.err
    packets = dissect(bench.folder / "run.log")
    assert len(packets) > 3000  # SYNC, RPDO and TPDO at 1 kHz
    for packet in packets:
        assert not packet["_ws.col.Info"].startswith("ID:"), packet
        assert "_ws.malformed" not in packet, packet
        assert "_ws.expert.message" not in packet, packet
    told = {packet["_ws.col.Info"].split(" 0x")[0] for packet in packets}
    assert any("SYNC" in text for text in told), told
    assert any("PDO1 (tx)" in text for text in told), told


@pytest.mark.skipif(shutil.which("tshark") is None, reason="tshark is not installed")
@pytest.mark.parametrize(("data", "malformed"), [(bytes.fromhex("4018100100000000"), False), (b"\x40\x18", True)])
def test_a_malformed_frame_would_be_seen(tmp_path: Path, data: bytes, malformed: bool) -> None:
    path = tmp_path / "one.log"
    path.write_text(lines([can.Message(arbitration_id=0x605, data=data, is_extended_id=False, timestamp=1.0)]))
    (packet,) = dissect(path)
    assert ("_ws.malformed" in packet or "_ws.expert.message" in packet) is malformed, packet
