"""The npm package `canopen` as master of the virtual joint; needs node and the package (found through NODE_PATH)."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import threading
from pathlib import Path
from typing import Any

import pytest

from jointctl.drivers.can.open import open_cyclic_end

SCRIPT = Path(__file__).with_name("master.js")


def installed() -> bool:
    node = shutil.which("node")
    return bool(node) and subprocess.run([node, "-e", "require('canopen')"], capture_output=True).returncode == 0


def bridge(channel: str, process: subprocess.Popen[bytes]) -> None:
    """Frames of the bus to the process's stdin and those of its stdout to the bus, until the process ends."""
    with open_cyclic_end("jointctl", channel) as end:
        end.setblocking(True)

        def to_process() -> None:
            try:
                while frame := end.recv(16):
                    process.stdin.write(frame)  # type: ignore[union-attr]
            except OSError:  # the process has ended
                pass

        reader = threading.Thread(target=to_process, daemon=True)
        reader.start()
        part = b""
        while more := process.stdout.read(16 - len(part)):  # type: ignore[union-attr]
            part += more
            if len(part) == 16:
                end.send(part)
                part = b""
        end.shutdown(socket.SHUT_RDWR)
        reader.join()


@pytest.mark.skipif(not installed(), reason="node.js with the npm package canopen is not installed")
def test_the_npm_master_enables_homes_and_moves_the_joint(joint: Any) -> None:
    command = ["node", str(SCRIPT), str(joint.node_id), str(joint.eds)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, bufsize=0) as process:
        bridge(joint.channel, process)
        told = process.stderr.read().decode()
    assert process.returncode == 0, told
    seen: dict[str, Any] = json.loads(told.splitlines()[-1])
    assert seen.pop("edsObjects") > 80
    assert seen.pop("pdos") >= 4
    assert seen.pop("position") == pytest.approx(15_000, abs=150)
    assert seen == {
        "name": "jointctl virtual joint",
        "productCode": 1,
        "modes": 0x3AD,
        "block": True,
        "segmented": True,
        "refused": 0x06090030,
        "enabled": True,
        "velocity": True,
        "homed": True,
        "acknowledged": True,
        "reached": True,
        "torque": True,
        "disabled": True,
    }
